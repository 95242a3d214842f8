"""Commands on spoilt files: never a traceback, a hang, a file outside the run folder, or a message that names no file.

Some hundred mutants run by default. More than 5000 of them, for all commands, on two processes:

    python -m pytest tests/robustness -m slow

A failure prints the command that makes and runs its mutant again.
"""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer

from tests.robustness import fuzz
from tests.robustness.cases import Case, cases
from tests.robustness.fuzz import REACHED, Mutant, mutant, numbers, run_many, run_mutant, write_files
from tests.robustness.mutate import mutate

ROOT = Path(__file__).parents[2]
QUICK = 130
MANY = 5000
SAMPLE = 20


@pytest.fixture(scope="module")
def table() -> dict[str, Case]:
    return cases()


def test_spoilt_files_are_refused_or_taken(table, tmp_path) -> None:
    tally = run_many(numbers(QUICK, 0, table), tmp_path, table)
    assert tally.count >= QUICK
    assert not tally.bad, "\n\n".join(map(str, tally.bad))
    # neither are all mutants so spoilt that nothing is built, nor are they all good
    assert tally.codes["refused"] > 0.4 * tally.count
    assert tally.codes["built"] > 0.05 * tally.count


def test_every_case_is_good_as_it_is(table, tmp_path) -> None:
    """Else its mutants would test one refusal again and again."""
    tally = fuzz.warm_up(tmp_path, table)
    assert not tally.bad, "\n\n".join(map(str, tally.bad))
    assert tally.codes == {"built": len(table)}


def test_mutants_are_the_same_every_time(table) -> None:
    case = table["lab-focus"]
    assert [mutant(case, k) for k in range(40)] == [mutant(case, k) for k in range(40)]
    assert len({mutant(case, k).content for k in range(40)}) > 35


@pytest.mark.slow
def test_thousands_of_spoilt_files(table) -> None:
    """About four minutes on two cores."""
    command = [sys.executable, "-m", "tests.robustness.fuzz", "--mutants", str(MANY), "--first", "100", "--shards", "2"]
    # one thread each: the matrices are small
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, timeout=1800, errors="replace")
    counts = [int(n) for n in re.findall(r"^(\d+) mutants in", done.stdout, re.MULTILINE)]
    assert done.returncode == 0, done.stdout[-20000:] + done.stderr[-5000:]
    assert len(counts) == 2
    assert sum(counts) >= MANY


@pytest.mark.slow
def test_good_mutants_really_run(table, tmp_path) -> None:
    """A sample of those that are built is run to its end, in a process of its own, with its own home."""
    home = tmp_path / "home"
    home.mkdir()
    environment = {**os.environ, "HOME": str(home), "PYTHONPATH": str(ROOT), "MPLCONFIGDIR": str(home / "mpl")}
    programs = {
        "render-perturb": "twin.render",
        "render-steady": "twin.render",
        "render-own-ccd": "twin.render",
        "orbit-angle": "twin.orbit",
        "orbit-angle-own-th1": "twin.orbit",
    }
    count = 0
    for name, program in programs.items():
        case, number, own = table[name], 300, 0
        while own < SAMPLE // len(programs):
            number += 1
            if run_mutant(case, number, tmp_path).code != REACHED:
                continue
            own += 1
            folder = tmp_path / f"{name}-{number}"
            folder.mkdir()
            paths = write_files(case, folder, mutant(case, number).content)
            before = fuzz.listing(tmp_path)
            words = [*case.words, str(paths[0]), *case.options, "--out", str(folder / "out")]
            command = [sys.executable, "-m", program, *words]
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, timeout=300, errors="replace"
            )
            told = f"{name} {number}: {done.stderr[-3000:]}"
            assert done.returncode in (0, 2), told
            assert "Traceback" not in done.stdout + done.stderr, told
            new = {k for k, v in fuzz.listing(tmp_path).items() if before.get(k) != v}
            allowed = (f"{folder.name}/out/", "home/") if done.returncode == 0 else ("home/",)
            assert all(k.startswith(allowed) for k in new), told
            if done.returncode == 2:
                assert done.stderr.startswith("error: "), told
                assert str(folder) in done.stderr, told
            count += 1
    assert count == SAMPLE
    # what is kept between runs, and nothing else: compiled kernels and the fonts that matplotlib found
    assert {path.name for path in home.iterdir()} <= {".drjit", "mpl", ".cache"}


# --- the judge itself: it must see what it is there for


def _bad(behaviour) -> Case:
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

    @app.command()
    def main(file: Path, out: Path = Path("out")) -> None:
        behaviour(file)

    return Case("bad", app, (), {"a.yaml": "x: 1\n"}, "a.yaml")


def _refuse(text: str):
    def refuse(file: Path) -> None:
        typer.echo(text.format(file=file), err=True)
        raise typer.Exit(2)

    return refuse


def _crash(file: Path) -> None:
    raise KeyError("x")


def _hang(file: Path) -> None:
    while True:
        time.sleep(0.01)


def _fill(file: Path) -> None:
    bytearray(8_000_000_000)


def _write_beside(file: Path) -> None:
    file.with_name("new").write_text("x")
    _refuse("error: {file}:1: x: no")(file)


def _write_beyond(file: Path) -> None:
    (file.parent.parent / "new").write_text("x")
    _refuse("error: {file}:1: x: no")(file)


def _start(file: Path) -> None:
    subprocess.run(["true"], check=True)
    _refuse("error: {file}:1: x: no")(file)


@pytest.mark.parametrize(
    ("behaviour", "words"),
    [
        (_refuse("error: {file}:1: x: no"), ""),
        (_refuse("error: {file}:7: x: no"), "names line 7"),
        (_refuse("error: x: no"), "names no file"),
        (_refuse("error: {file}: 1 validation error for JobSpec"), "validation error"),
        (_refuse("error: {file}: \x07red"), "control characters"),
        (_refuse("{file} is bad"), "no error message"),
        (lambda file: None, "exit code 0"),
        (_crash, "raised KeyError"),
        (_fill, "raised MemoryError"),
        (_hang, "took more than"),
        (_write_beside, "left files"),
        (_write_beyond, "beyond its folder"),
        (_start, "beyond its folder"),
    ],
)
def test_the_judge_sees(behaviour, words, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(fuzz, "SECONDS", 1.0)
    wrong = run_mutant(_bad(behaviour), 1, tmp_path, Mutant(b"x: 1\n", "unchanged")).wrong
    assert words in wrong
    assert bool(wrong) == bool(words)


def test_mutators_give_something_else() -> None:
    import random

    text = (ROOT / "scenes/examples/perturb.yaml").read_text("utf-8")
    kinds = [mutate(text, random.Random(k)) for k in range(300)]
    assert sum(one.content != text.encode() for one in kinds) > 280
    assert {one.how.partition(":")[0] for one in kinds} == {"byte", "token", "tree", "path", "yaml"}
