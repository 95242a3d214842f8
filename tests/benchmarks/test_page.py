"""What the command promises: output, exit codes, limits. Times are not judged here, other processes may be at work."""

import io
import json
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from tests.benchmarks.__main__ import app
from tests.benchmarks.limits import Limit, Limits
from tests.benchmarks.machine import Machine
from tests.benchmarks.number import Number, Speed, shown
from tests.benchmarks.page import Page
from tests.benchmarks.registry import BENCHMARKS
from tests.benchmarks.stopwatch import Work, in_turns
from tests.benchmarks.yardsticks import pace

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
    others = {"at_reference", "yardsticks", "reference", "machine", "quick", "notes", "limits", "targets"}
    assert set(data) == {"trace", "psf", *others}
    assert data["trace"]["ray_surfaces_per_s"] > 0.0
    assert data["psf"]["seconds"] > 0.0
    slow = data["psf"]["cpu_ms"] / data["at_reference"]["psf"]["cpu_ms"]
    reference = data["reference"]["yardsticks"]
    ratios = [data["yardsticks"]["psf"][name] / reference[name] for name in ("arithmetic", "memory")]
    assert min(ratios) <= slow <= max(ratios)
    assert data["machine"]["cores"] >= 1
    assert data["machine"]["versions"]["numpy"] != "not installed"
    assert "s left" in quick.stderr


@pytest.mark.slow
def test_absent_peers_are_named_and_the_others_compared(quick) -> None:
    data = json.loads(quick.stdout)
    for part, peer in (("trace", "batoid"), ("trace", "optiland"), ("psf", "poppy")):
        named = any(note.startswith(f"{peer} not installed") for note in data["notes"])
        assert (f"ratio_{peer}" in data[part]) != named


@pytest.mark.second
def test_a_quick_run_judges_no_limit(quick) -> None:
    limits = json.loads(quick.stdout)["limits"]
    assert all(limit["met"] is None for limit in limits)
    assert {limit["number"].partition(".")[0] for limit in limits} == {"psf", "trace"}


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


REFERENCE = {"python": 0.01, "arithmetic": 0.001}


def page(value: float, quick: bool = False, slow: float = 1.0, others: float = 0.0, clock: bool = False) -> Page:
    """A page of a number of two kinds of work, with a limit of 20 and a target of 10 on the machine of reference."""
    scales = pace(python=0.5, arithmetic=0.5)
    numbers = (
        Number("ms", value, "a state", "ms", scales, limited=True, target=10.0, clock=clock),
        Number("threads", 2.0, "threads"),
        Number("rate", 1e3 / value, "states", "states/s", scales, least=True),
    )
    now = {name: slow * seconds for name, seconds in REFERENCE.items()}
    limits = Limits("the other one", REFERENCE, {"monitor.ms": Limit(20.0, least=False, scatter=0.3)})
    return Page(Machine.here(), {"monitor": Speed(numbers, (), now, others)}, quick, limits)


@pytest.mark.parametrize(("value", "met"), [(20.0, True), (20.1, False), (float("nan"), False)])
def test_limits(value: float, met: bool) -> None:
    assert page(value).missed is not met
    assert page(value).data["limits"][0]["met"] is met
    assert not page(value, quick=True).missed
    assert page(value, quick=True).data["limits"][0]["met"] is None


def test_numbers_are_judged_on_the_machine_of_reference() -> None:
    """A machine of twice the yardsticks takes twice the time: half of the value, and twice the rate."""
    slow = page(40.0, slow=2.0)
    assert slow.data["monitor"]["ms"] == 40.0
    assert slow.data["at_reference"]["monitor"] == pytest.approx({"ms": 20.0, "rate": 50.0})
    assert slow.data["limits"][0]["met"]
    assert page(21.0, slow=1.0).missed
    assert page(20.0, slow=0.9).missed


@pytest.mark.parametrize(("value", "reached"), [(10.0, True), (10.1, False)])
def test_a_target_that_is_not_reached_is_no_failure(value: float, reached: bool) -> None:
    made = page(value)
    assert made.data["targets"] == [{"number": "monitor.ms", "value": value, "at_most": 10.0, "reached": reached}]
    assert not made.missed
    assert ("not reached" in printed(made)) is not reached


def test_a_time_of_the_clock_is_not_judged_beside_other_programs() -> None:
    assert page(50.0, clock=True).missed
    assert page(50.0, others=0.9).missed  # processor time
    busy = page(50.0, clock=True, others=0.9)
    assert not busy.missed
    assert "monitor: other programs took 90% of the machine" in printed(busy)


def test_the_table_has_both_values_and_what_they_scale_with() -> None:
    text = printed(page(30.0, slow=2.0))
    row = next(line for line in text.splitlines() if line.startswith(" a state"))
    assert row.split() == "a state 30.0 15.0 ms <= 20 met 10 not reached python 50% arithmetic 50%".split()
    assert "monitor.ms: scatters by 30% between rounds" in text
    assert "yardsticks of monitor, times those of reference: python 2.00, arithmetic 2.00" in text
    assert "reference: the other one" in text


def printed(made: Page) -> str:
    console = Console(width=200, record=True, file=io.StringIO())
    made.print(console)
    return console.export_text()


def test_help_has_the_options_of_limits() -> None:
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).stdout
    for option in ("--tighten", "--loosen", "--why", "--beside", "--rounds"):
        assert option in shown


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--loosen", "psf.cpu_ms"], "needs a reason"),
        (["--tighten", "--loosen", "psf.cpu_ms"], "needs a reason"),
        (["--tighten", "--quick"], "without --quick"),
    ],
)
def test_limits_are_not_set_without_reason(options: list[str], says: str) -> None:
    wrong = CliRunner().invoke(app, ["--only", "psf", *options])
    assert wrong.exit_code == 2
    assert says in wrong.stderr


@pytest.mark.parametrize(
    ("value", "text"), [(123456.0, "123,000"), (12.345, "12.3"), (0.00987, "0.00987"), (3e-9, "3.0e-09"), (0.0, "0")]
)
def test_three_digits(value: float, text: str) -> None:
    assert shown(value) == text


def test_works_are_taken_in_turns_with_a_look_before_each() -> None:
    order: list[str] = []
    works = {"a": Work(lambda _: order.append("a"), repeats=2), "b": Work(order.append, lambda: "b")}
    in_turns(works, 2)
    assert order == ["a", "a", "b"] * 2
    order.clear()
    in_turns(works, 2, lambda: order.append("look"))
    assert order == ["look", "a", "a", "look", "b"] * 2
