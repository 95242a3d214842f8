"""Two commits side by side: the order of runs, the ratios, and what only one of them has. Runs are drawn, not timed."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmarks.beside import ROOT, Pair, commit_here, compared, numbers_of, sources_of
from twin.run.cli import InputErrorText

OLD = Path("/old")


def runs(order: list[tuple[str, str]], slower: float = 2.0):
    """A runner whose machine gets slower by half with every turn, and whose new sources are twice as fast."""

    def run(sources: Path, name: str, quick: bool) -> dict[str, float] | None:
        if name == "later" and sources == OLD:
            return None
        order.append((name, "new" if sources == ROOT else "old"))
        busy = 1.5 ** ((len(order) - 1) // 2)
        return {"ms": busy * 8.0} if sources == OLD else {"ms": busy * 8.0 / slower, "share": 0.5}

    return run


def test_commits_run_in_turns_and_a_busy_machine_is_busy_for_both() -> None:
    order: list[tuple[str, str]] = []
    pairs, remarks = compared(["monitor"], OLD, 3, True, lambda text: None, runs(order))
    assert [who for _, who in order] == ["old", "new", "new", "old", "old", "new"]
    (pair,) = pairs
    assert pair == Pair("monitor.ms", (8.0, 12.0, 18.0), (4.0, 6.0, 9.0))
    assert pair.ratios == [0.5, 0.5, 0.5]
    assert pair.data["ratio"] == {"least": 0.5, "median": 0.5, "most": 0.5}
    assert remarks == ["monitor: the older commit has no share"]


def test_a_benchmark_that_came_later_is_a_remark() -> None:
    order: list[tuple[str, str]] = []
    pairs, remarks = compared(["later", "monitor"], OLD, 2, True, lambda text: None, runs(order))
    assert [pair.key for pair in pairs] == ["monitor.ms"]
    assert remarks[0] == "later: the older commit has no such benchmark"
    assert ("later", "new") not in order


def test_no_ratio_to_nothing() -> None:
    assert Pair("a.b", (0.0, 1.0), (1.0, 1.0)).data == {"old": [0.0, 1.0], "new": [1.0, 1.0]}


def test_a_commit_that_is_not_there_is_bad_input() -> None:
    with pytest.raises(InputErrorText, match="no commit nowhere"), sources_of("nowhere"):
        pass


def test_without_git(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit_here() == ""
    with pytest.raises(InputErrorText, match="--beside needs git"), sources_of("HEAD"):
        pass


def test_a_run_that_breaks_down_is_told_with_its_last_lines(monkeypatch) -> None:
    def broken(command, **_):
        return subprocess.CompletedProcess(command, 1, stdout="", stderr="one\ntwo\nValueError: three\n")

    monkeypatch.setattr("tests.benchmarks.beside.subprocess.run", broken)
    with pytest.raises(InputErrorText, match="ValueError: three"):
        numbers_of(ROOT, "psf", True)


@pytest.mark.slow
def test_a_commit_beside_itself() -> None:
    """From the command line, with the sources of the commit that is checked out."""
    command = [
        sys.executable,
        "-m",
        "tests.benchmarks",
        "--beside",
        "HEAD",
        "--only",
        "psf",
        "--quick",
        "--rounds",
        "1",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "psf.seconds" in done.stdout
    listed = subprocess.run(["git", "worktree", "list"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "(detached HEAD)" not in listed.stdout or "/old" not in listed.stdout
