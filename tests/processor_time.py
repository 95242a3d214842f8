"""Processor time of tests, file by file, after a run: ``python -m pytest -p tests.processor_time``.

Unlike durations it does not depend on what else the machine does. Processes that a test starts and waits for count.
"""

import resource
from collections import Counter
from collections.abc import Iterator

import pytest

SHOWN = 40
"""How many files are listed."""
_USED = pytest.StashKey[float]()
_BY_FILE: Counter[str] = Counter()


def used() -> float:
    """Seconds of this process and of those that it has waited for."""
    every = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in every)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def measured(item: pytest.Item) -> Iterator[None]:
    """A phase of a test, with what it takes in the test's stash."""
    item.stash[_USED] = -used()
    try:
        return (yield)
    finally:
        item.stash[_USED] += used()


pytest_runtest_setup = pytest_runtest_call = pytest_runtest_teardown = measured


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[pytest.TestReport]:
    report = yield
    report.processor_time = item.stash[_USED]  # of this phase; goes from a process of xdist to the one that prints
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _BY_FILE[report.nodeid.partition("::")[0]] += report.processor_time


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    terminalreporter.section(f"processor time: {_BY_FILE.total():.0f} s")
    for file, seconds in _BY_FILE.most_common(SHOWN):
        terminalreporter.line(f"{seconds:7.1f} s  {file}")
