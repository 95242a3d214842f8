"""A plugin of pytest that notes which lines each test runs, also in processes that it starts.

The environment says where it goes (TWIN_COVERAGE_OUT): a ``.coverage`` file of each process, and a ``.json`` of the
tests' times of each worker.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

PLACES = ("optics", "scenes", "analysis", "twin")
_OUT = Path(os.environ["TWIN_COVERAGE_OUT"])
_ROOT = Path(__file__).resolve().parents[2]
_WORKER = os.environ.get("PYTEST_XDIST_WORKER", f"main{os.getpid()}")
_INSIDE = """
import atexit, os
if os.environ.get("TWIN_TEST"):
    import coverage
    measured = coverage.Coverage(
        data_file=f"{os.environ['TWIN_COVERAGE_OUT']}/process-{os.getpid()}-{os.urandom(4).hex()}.coverage",
        include=os.environ["TWIN_COVERAGE_OF"].split(os.pathsep), context=os.environ["TWIN_TEST"], config_file=False)
    measured.set_option("run:disable_warnings", ["no-data-collected", "module-not-measured", "already-imported"])
    measured.start()
    atexit.register(lambda: (measured.stop(), measured.save()))
"""
_measured = coverage.Coverage(
    data_file=str(_OUT / f"{_WORKER}.coverage"), include=[f"{_ROOT / place}/*" for place in PLACES], config_file=False
)
# Before the first import of what is measured: constants of modules count, too.
_measured.start()
_seconds: dict[str, float] = {}
_passed: dict[str, bool] = {}


def pytest_configure() -> None:
    """Make Python measure itself in every process that a test starts."""
    inside = _OUT / "inside"
    inside.mkdir(parents=True, exist_ok=True)
    (inside / "sitecustomize.py").write_text(_INSIDE)
    paths = [str(inside), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(path for path in paths if path))
    os.environ["TWIN_COVERAGE_OF"] = os.pathsep.join(f"{_ROOT / place}/*" for place in PLACES)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """What a test and its fixtures run counts for the test."""
    _measured.switch_context(item.nodeid)
    os.environ["TWIN_TEST"] = item.nodeid
    try:
        return (yield)
    finally:
        _measured.switch_context("")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Times of set-up, call and tear-down together, and whether all of them passed."""
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration
    _passed[report.nodeid] = _passed.get(report.nodeid, True) and report.passed


def pytest_unconfigure() -> None:
    """Write what was seen."""
    _measured.stop()
    if _measured.get_data().measured_files():
        _measured.save()
    times = {name: seconds for name, seconds in _seconds.items() if _passed[name]}
    (_OUT / f"{_WORKER}.json").write_text(json.dumps(times))
