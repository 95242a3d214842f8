"""Commands on spoilt files: never a traceback, a hang, a file left behind, or a message that names no file.

A few mutants run by default; thousands of them, for all kinds of files and to the reports of what can still be run:

    python -m pytest tests/robustness -m slow
    python -m tests.robustness 10000 --processes 2

A failure prints the command that makes and runs its mutant again.
"""

import subprocess
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import typer

from tests.robustness import spoilt_run
from tests.robustness.__main__ import Tally, campaign, numbers, run_many
from tests.robustness.case import Case
from tests.robustness.cases import cases
from tests.robustness.mutate import Mutant, form_of
from tests.robustness.spoilt_run import mutant, run_mutant

QUICK = (
    "table ",
    "file ",
    "config",
    "measured",
    "OEM",
    "GeoJSON",
    "GCP",
    "Zemax",
    "CODE V",
    "batoid",
    "journal",
    "study",
)
"""Beginnings of the kinds of files of which one mutant each is run by default: those that cost least."""
MANY = 10_000
KINDS = 35


@pytest.fixture(scope="module")
def table() -> dict[str, Case]:
    return cases()


def told(tally: Tally) -> str:
    return "\n\n".join(map(str, tally.bad))


@pytest.mark.second
def test_spoilt_files_are_refused_or_taken(table, tmp_path) -> None:
    cheap = {name: case for name, case in table.items() if case.kind.startswith(QUICK)}
    tally = run_many([(name, 3) for name in cheap], tmp_path, table)
    assert not tally.bad, told(tally)
    # neither are all mutants so spoilt that nothing is built, nor are they all good
    assert tally.codes["refused"] > 0.4 * tally.count
    assert tally.codes["refused"] < 0.95 * tally.count


def test_kinds_of_files(table) -> None:
    assert len({case.kind for case in table.values()}) >= KINDS
    assert {form_of(case.target) for case in table.values()} >= {"yaml", "json", "table", "image", "text"}


@pytest.mark.second
def test_mutants_are_the_same_every_time(table) -> None:
    for name in ("lab-turntable", "check-geojson", "table-course", "frames-b", "lens-codev-wide", "mtf-fits"):
        case = table[name]
        found = [mutant(case, k) for k in range(8)]
        assert found == [mutant(case, k) for k in range(8)]
        assert len({one.content for one in found}) > 5
        assert sum(one.content != case.files[case.target] for one in found) > 5


@pytest.mark.slow
def test_every_case_is_good_as_it_is(tmp_path) -> None:
    """Else its mutants would test one refusal again and again."""
    tally, table = Tally(), cases(tmp_path / "bases")
    for case in table.values():
        unchanged = Mutant(case.files[case.target], "unchanged")
        one = run_mutant(case, 0, tmp_path, unchanged, "soon")
        if one.end not in ("built", "ran") and not one.wrong:
            one.wrong = "the unchanged file is refused"
        tally.add(one)
    assert not tally.bad, told(tally)


@pytest.mark.slow
def test_ten_thousand_spoilt_files(tmp_path, capsys) -> None:
    """About an hour of two cores."""
    table = cases(tmp_path / "bases")
    with capsys.disabled():
        tally = campaign(numbers(MANY, 0, table), tmp_path / "bases", table, processes=2)
        print(f"\n{tally.table()}")  # noqa: T201 - the test's result
    assert tally.count >= MANY
    assert not tally.bad, told(tally)


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


@pytest.mark.parametrize(
    ("behaviour", "words"),
    [
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
    ],
)
def test_the_judge_sees(behaviour, words, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(spoilt_run, "SECONDS", {"soon": 0.5})
    monkeypatch.setattr(spoilt_run, "PATIENCE", 2.0)
    wrong = run_mutant(_bad(behaviour), 1, tmp_path, Mutant(b"x: 1\n", "unchanged")).wrong
    _KEPT.clear()
    assert words in wrong
    assert bool(wrong) == bool(words)
