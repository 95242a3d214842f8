"""Commands on corrupted files: never a traceback, a hang, a file left behind, or a message that names no file.

Kept cases and new ones of the day run in the second tier; thousands, also of run folders, by hand:

    python -m tests.robustness 10000

A failure prints the command that makes and runs its mutant again.
"""

import subprocess
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import typer

from tests.daily import first_of_today, require_good
from tests.robustness import spoilt_run
from tests.robustness.__main__ import run_many, spread
from tests.robustness.case import Case
from tests.robustness.cases import cases
from tests.robustness.mutate import Mutant, form_of
from tests.robustness.spoilt_run import mutant, run_mutant

pytestmark = pytest.mark.second

QUICK = ("table ", "file ", "config", "measured", "Zemax", "CODE V", "batoid", "study")
"""Beginnings of the kinds of files of which a kept mutant is run: those that cost least."""
KEPT = 3
"""Number of the mutant of each cheap case."""
FAILED: list[tuple[str, int]] = []
"""Mutants that were taken wrongly once: case and number."""
NEW = 60


@pytest.fixture(scope="module")
def table() -> dict[str, Case]:
    return cases()


def test_spoilt_files_are_refused_or_taken(table, tmp_path) -> None:
    cheap = [name for name, case in table.items() if case.kind.startswith(QUICK)]
    ends = require_good(run_many([(name, KEPT) for name in cheap], tmp_path, table))
    # neither are all mutants so corrupted that nothing is built, nor are they all good
    assert 0.4 * ends.total() < ends["refused"] < 0.95 * ends.total()
    new = spread(NEW, first_of_today(), table)
    require_good(run_many([*FAILED, *new[:: max(1, len(new) // NEW)]], tmp_path, table, "soon"))


def test_every_case_is_good_as_it_is(table, tmp_path) -> None:
    """Else its mutants would test one refusal again and again. Of each kind of file the last case."""
    last = {case.kind: case for case in table.values() if case.kind.startswith(QUICK)}
    for case in last.values():
        one = run_mutant(case, 0, tmp_path, Mutant(case.files[case.target], "unchanged"), "soon")
        assert not one.wrong, str(one)
        assert one.end in ("built", "ran"), f"{case.name}: {one.text}"


def test_mutants_are_the_same_every_time(table) -> None:
    assert len({case.kind for case in table.values()}) > 70
    assert {form_of(case.target) for case in table.values()} >= {"yaml", "json", "table", "image", "text"}
    for name in ("lab-turntable", "check-points.geojson", "table-course", "frames-b", "lens-codev-wide", "mtf-fits"):
        case = table[name]
        found = [mutant(case, k) for k in range(8)]
        assert found == [mutant(case, k) for k in range(8)]
        assert len({one.content for one in found}) > 5
        assert sum(one.content != case.files[case.target] for one in found) > 5


# --- the judge itself: it must see what it is there for


def _bad(behaviour) -> Case:
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

    @app.command()
    def main(file: Path, out: Path = Path("out")) -> None:
        behaviour(file)

    return Case("bad", "bad", app, (), {"a.yaml": b"x: 1\n"}, "a.yaml")


def _refuse(text: str, code: int = 2):
    def refuse(file: Path) -> None:
        typer.echo(text.format(file=file), err=True)
        raise typer.Exit(code)

    return refuse


def _then_refuse(work):
    def both(file: Path) -> None:
        work(file)
        _refuse("error: {file}:1: x: no")(file)

    return both


def _crash(file: Path) -> None:
    raise KeyError("x")


def _hang(file: Path) -> None:
    while True:
        time.sleep(0.01)


def _compute(file: Path) -> None:
    while True:
        pass


_KEPT = []
BEHAVIOURS = [
    (_refuse("error: {file}:1: x: no"), ""),
    (_refuse("error: {file}:7: x: no"), "names line 7"),
    (_refuse("error: x: no"), "names no file"),
    (_refuse("error: too dark", 1), ""),
    (_refuse("error: {file}: 1 validation error for JobSpec"), "validation error"),
    (_refuse("error: {file}: \x07red"), "control characters"),
    (_refuse("{file} is bad"), "no error message"),
    (lambda file: None, "no run folder"),
    (_crash, "raised KeyError"),
    (lambda file: bytearray(8_000_000_000), "raised MemoryError"),
    (_hang, "took more than"),
    (_compute, "took more than"),
    (_then_refuse(lambda file: file.with_name("new").write_text("x")), "left files"),
    (_then_refuse(lambda file: (file.parent / "tmp/new").write_text("x")), "left files"),
    (_then_refuse(lambda file: (file.parent.parent / "new").write_text("x")), "beyond its folder"),
    (_then_refuse(lambda file: subprocess.run(["true"], check=True)), "beyond its folder"),
    (_then_refuse(lambda file: _KEPT.append(file.open())), "still open"),
    (_then_refuse(lambda file: np.float64(1.0) / np.float64(0.0)), "prints RuntimeWarning"),
    (_then_refuse(lambda file: warnings.warn("old", DeprecationWarning, stacklevel=1)), ""),
    (_then_refuse(lambda file: spoilt_run.os.write(2, b"TIFFOpen: no")), "a library writes"),
]


def test_the_judge_sees(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(spoilt_run, "SECONDS", {"soon": 0.5})
    monkeypatch.setattr(spoilt_run, "PATIENCE", 2.0)
    for k, (behaviour, words) in enumerate(BEHAVIOURS):
        wrong = run_mutant(_bad(behaviour), 1, tmp_path, Mutant(b"x: 1\n", "unchanged")).wrong
        _KEPT.clear()
        assert words in wrong, f"behaviour {k}"
        assert bool(wrong) == bool(words), f"behaviour {k}: {wrong}"
