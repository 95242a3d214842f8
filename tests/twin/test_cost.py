"""What a command says of memory and time before it starts; that it takes so much is in tests/limits/test_costs.py."""

from io import StringIO

import pytest
from rich.console import Console

from scenes.specs.load import ORBIT, load_named
from scenes.specs.orbit.adjust import OrbitAdjustSpec
from scenes.yaml.errors import InputError
from twin.run import cost
from twin.run.cli import time_text
from twin.run.command import tell_cost
from twin.run.cost import LONG, MUCH_MEMORY, Cost, Lowered, require_memory, told
from twin.run.memory import LIMIT


@pytest.fixture
def measured_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "pace", lambda: 2.0)


@pytest.mark.usefixtures("measured_machine")
def test_much_is_told_and_little_is_not() -> None:
    """Seconds are of this machine, here half as fast as the measured one."""
    assert told(Cost(MUCH_MEMORY, LONG / 2.0), time_text) == ""
    assert told(Cost(3.2e9, 1.0), time_text) == "this takes about 3.2 GB of memory"
    assert told(Cost(1e9, 0.51 * LONG), time_text) == "this takes about 5 min"
    assert told(Cost(3.2e9, 3000.0), time_text) == "this takes about 3.2 GB of memory and 100 min"


@pytest.mark.usefixtures("measured_machine")
def test_it_is_said_before_the_work_begins() -> None:
    for quiet, text in ((False, "note: this takes about 17 min\n"), (True, "")):
        errors = StringIO()
        tell_cost(Cost(0.0, 510.0), Console(file=errors), quiet)
        assert errors.getvalue() == text


def test_the_pace_of_this_machine() -> None:
    """Any machine that runs these tests is within a factor of ten of the measured one, and the pace is a matter of a
    moment.
    """
    assert 0.1 < cost.pace() < 10.0


def test_more_memory_than_there_is_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = load_named(OrbitAdjustSpec, ORBIT, "adjust")
    lower = Lowered(spec, ("points", "tie"), 120, "tie points", lambda number: 1e7 * number, 0)
    monkeypatch.setenv(LIMIT, "1 GB")
    require_memory(Cost(1e9, 1.0, lower))
    with pytest.raises(InputError) as caught:
        require_memory(Cost(1.2e9, 1.0, lower))
    (issue,) = caught.value.issues
    assert (issue.key, issue.found) == (("points", "tie"), "120")
    assert issue.line is not None
    assert "this needs about 1.2 GB of memory, and 1 GB may be taken" in issue.problem
    assert (issue.allowed or "").startswith("at most 100 tie points, or more memory")
    # so little is always there, whatever is said to be
    monkeypatch.setenv(LIMIT, "100 MB")
    require_memory(Cost(0.5e9, 1.0, lower))
