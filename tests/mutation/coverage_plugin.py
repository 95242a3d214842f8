"""A plugin of pytest that notes which lines each test runs; loaded by tests.mutation.coverage_map alone.

The environment says what is measured (TWIN_COVERED, with commas) and where it goes (TWIN_COVERAGE_FILE, with a .json of
the tests' times beside it).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

_PLACES = os.environ["TWIN_COVERED"].split(",")
_FILE = Path(os.environ["TWIN_COVERAGE_FILE"])
_MEASURED = coverage.Coverage(
    data_file=str(_FILE),
    include=[place if place.endswith(".py") else f"{place}/*" for place in _PLACES],
    config_file=False,
)
# Before the first import of what is measured: constants of modules count, too.
_MEASURED.start()
_seconds: dict[str, float] = {}
_passed: dict[str, bool] = {}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """What a test and its fixtures run counts for the test."""
    _MEASURED.switch_context(item.nodeid)
    try:
        return (yield)
    finally:
        _MEASURED.switch_context("")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Times of set-up, call and tear-down together, and whether all of them passed."""
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration
    _passed[report.nodeid] = _passed.get(report.nodeid, True) and report.passed


def pytest_unconfigure() -> None:
    """Write what was seen."""
    _MEASURED.stop()
    _MEASURED.save()
    times = {name: seconds for name, seconds in _seconds.items() if _passed[name]}
    _FILE.with_suffix(".json").write_text(json.dumps(times))
