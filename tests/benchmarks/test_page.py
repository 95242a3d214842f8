"""What the command promises: output, exit codes, limits. Times are not judged here, other processes may be at work."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.benchmarks.__main__ import app
from tests.benchmarks.machine import Machine
from tests.benchmarks.number import Limit, Number, Speed
from tests.benchmarks.page import Page, shown
from tests.benchmarks.registry import BENCHMARKS
from tests.benchmarks.stopwatch import Work, in_turns

ROOT = Path(__file__).resolve().parents[2]


def command(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "tests.benchmarks", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=300
    )


@pytest.fixture(scope="module")
def quick() -> subprocess.CompletedProcess:
    return command("--quick", "--json", "--only", "psf, trace")


@pytest.mark.slow
def test_json_is_all_of_stdout_and_progress_is_on_stderr(quick) -> None:
    assert quick.returncode == 0, quick.stderr
    data = json.loads(quick.stdout)
    assert set(data) == {"trace", "psf", "machine", "quick", "notes", "limits"}
    assert data["trace"]["ray_surfaces_per_s"] > 0.0
    assert data["psf"]["seconds"] > 0.0
    assert data["machine"]["cores"] >= 1
    assert data["machine"]["versions"]["numpy"] != "not installed"
    assert "s left" in quick.stderr


@pytest.mark.second
def test_absent_peers_are_named_and_the_others_compared(quick) -> None:
    data = json.loads(quick.stdout)
    for part, peer in (("trace", "batoid"), ("trace", "optiland"), ("psf", "poppy")):
        named = any(note.startswith(f"{peer} not installed") for note in data["notes"])
        assert (f"ratio_{peer}" in data[part]) != named


@pytest.mark.second
def test_a_quick_run_judges_no_limit(quick) -> None:
    limits = json.loads(quick.stdout)["limits"]
    assert all(limit["met"] is None for limit in limits)
    for limit in limits:
        assert limit["number"].startswith("trace.")
        assert limit["at_least"] == 15.0


def test_names_are_listed_and_unknown_ones_refused() -> None:
    listed = CliRunner().invoke(app, ["--list"])
    assert listed.exit_code == 0
    assert [line.split()[0] for line in listed.stdout.splitlines()] == [one.name for one in BENCHMARKS]
    wrong = CliRunner().invoke(app, ["--only", "trace,lens"])
    assert wrong.exit_code == 2
    assert "no benchmark lens; choose from trace" in wrong.stderr
    assert wrong.stdout == ""


def test_absence_is_a_remark(monkeypatch) -> None:
    """Without the others the twin is measured alone."""
    from tests.benchmarks import psf_speed, trace_speed
    from tests.benchmarks.workbench import Workbench

    bench = Workbench()
    for module in (trace_speed, psf_speed):
        monkeypatch.setattr(module, "installed", lambda peer: False)
    speeds = [module.measure(bench, True) for module in (trace_speed, psf_speed)]
    assert [note.split()[0] for speed in speeds for note in speed.notes] == ["batoid", "optiland", "poppy"]
    assert not [key for speed in speeds for key in speed.data if "ratio" in key]


def page(value: float, quick: bool = False) -> Page:
    numbers = (Number("ms_per_state", value, "a state", "ms", Limit(20.0)), Number("threads", 2.0, "threads"))
    return Page(Machine.here(), {"monitor": Speed(numbers)}, quick)


@pytest.mark.parametrize(("value", "met"), [(20.0, True), (20.1, False), (float("nan"), False)])
def test_limits(value: float, met: bool) -> None:
    assert page(value).missed is not met
    assert page(value).data["limits"][0]["met"] is met
    assert not page(value, quick=True).missed
    assert Limit(15.0, least=True).met(15.0)
    assert not Limit(15.0, least=True).met(14.9)


@pytest.mark.parametrize(
    ("value", "text"), [(123456.0, "123,000"), (12.345, "12.3"), (0.00987, "0.00987"), (3e-9, "3.0e-09"), (0.0, "0")]
)
def test_three_digits(value: float, text: str) -> None:
    assert shown(value) == text


def test_works_are_taken_in_turns_until_enough() -> None:
    order: list[str] = []
    works = {"a": Work(lambda _: order.append("a"), repeats=2), "b": Work(order.append, lambda: "b")}
    in_turns(works, 2)
    assert order == ["a", "a", "b"] * 2
    order.clear()
    in_turns(works, 1, 5, lambda best: len(order) >= 9)
    assert order == ["a", "a", "b"] * 3
