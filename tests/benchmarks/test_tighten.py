"""Limits stand on what was reached: narrower by themselves, wider only by name and with a reason."""

from pathlib import Path

import pytest

from tests.benchmarks.limits import FILE, Limit, Limits, Origin, beyond
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.registry import BENCHMARKS
from tests.benchmarks.yardsticks import YARDSTICKS, pace
from twin.run.cli import InputErrorText

REFERENCE = {"python": 0.01}
TODAY = Origin("2026-01-02", "0123456789ab", "some processor, 2 cores")


def rounds(*values: float, least: bool = False, clock: bool = False, others: float = 0.0, slow: float = 1.0):
    """Rounds of a benchmark of one number that is limited, and one that is not."""
    return [
        {
            "some": Speed(
                (
                    Number("ms", value, "a time", "ms", pace(python=1.0), least, limited=True, clock=clock),
                    Number("free_ms", value, "without a limit", "ms", pace(python=1.0)),
                ),
                (),
                {"python": slow * 0.01},
                others,
            )
        }
        for value in values
    ]


def limits(**bounds: float) -> Limits:
    return Limits("reference", REFERENCE, {f"some.{key}": Limit(bound, least=False) for key, bound in bounds.items()})


def test_a_limit_is_the_middle_of_the_rounds_and_a_fifth() -> None:
    found, lines = limits().tightened(rounds(10.4, 10.0, 10.2), TODAY, {})
    assert found.limits.keys() == {"some.ms"}
    one = found.limits["some.ms"]
    assert (one.bound, one.reached, one.scatter, one.why) == (13.0, 10.2, 0.04, "")
    assert (one.date, one.commit, one.machine) == ("2026-01-02", "0123456789ab", "some processor, 2 cores")
    assert one.yardsticks == {"python": 0.01}
    assert lines == ["some.ms: new -> <= 13, reached 10.2"]


def test_it_is_stated_for_the_machine_of_reference() -> None:
    found, _ = limits().tightened(rounds(20.0, slow=2.0), TODAY, {})
    assert found.limits["some.ms"].reached == 10.0
    assert found.limits["some.ms"].bound == 12.0


def test_what_scatters_stands_on_the_worst_round() -> None:
    found, _ = limits().tightened(rounds(10.0, 11.0, 12.0), TODAY, {})
    assert found.limits["some.ms"].bound == 15.0  # 14.4
    assert "scatters by 20%" in found.limits["some.ms"].why
    rate, _ = limits().tightened(rounds(10.0, 11.0, 12.0, least=True), TODAY, {})
    assert rate.limits["some.ms"].bound == 8.3
    assert rate.limits["some.ms"].text == ">= 8.3"


def test_no_limit_becomes_wider_by_itself() -> None:
    before = limits(ms=12.0)
    after, lines = before.tightened(rounds(11.0), TODAY, {})
    assert after == before
    assert lines == ["some.ms: stays <= 12, reached 11 (--loosen some.ms --why TEXT)"]
    narrower, lines = before.tightened(rounds(9.0), TODAY, {})
    assert narrower.limits["some.ms"].bound == 11.0
    assert lines == ["some.ms: <= 12 -> <= 11, reached 9"]


def test_a_limit_becomes_wider_by_name_and_keeps_the_reason() -> None:
    after, _ = limits(ms=12.0).tightened(rounds(20.0), TODAY, {"some.ms": "more rays"})
    assert after.limits["some.ms"].bound == 24.0
    assert after.limits["some.ms"].why == "loosened from 12: more rays"
    again, lines = after.tightened(rounds(20.0), TODAY, {})
    assert again == after
    assert lines[0].startswith("some.ms: stays <= 24")
    with pytest.raises(InputErrorText, match=r"no limit some\.other; there are some\.ms"):
        limits().tightened(rounds(1.0), TODAY, {"some.other": "why not"})


def test_times_of_the_clock_are_left_beside_other_programs() -> None:
    before = limits(ms=12.0)
    after, lines = before.tightened(rounds(1.0, clock=True, others=0.5), TODAY, {"some.ms": "more rays"})
    assert after == before
    assert "other programs were at work" in lines[0]


@pytest.mark.parametrize(
    ("reached", "least", "bound"),
    [(10.0, False, 12.0), (8.04, False, 9.7), (0.3301, False, 0.4), (1234.0, False, 1500.0), (17.0, True, 14.0)],
)
def test_two_digits_that_leave_more_room(reached: float, least: bool, bound: float) -> None:
    assert beyond(reached, least) == bound


def test_the_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    found, _ = limits(old=3.0).tightened(rounds(10.0, 13.0), TODAY, {})
    found.write(tmp_path / "limits.json")
    assert Limits.read(tmp_path / "limits.json") == found


def test_the_project_file_has_a_reference_for_every_yardstick(tmp_path: Path) -> None:
    stated = Limits.read()
    assert stated.machine
    assert stated.yardsticks.keys() == YARDSTICKS.keys()
    assert {key.partition(".")[0] for key in stated.limits} <= {one.name for one in BENCHMARKS}
    for key, one in stated.limits.items():
        assert one.reached is None or one.met(one.reached), key
    stated.write(tmp_path / "limits.json")
    assert (tmp_path / "limits.json").read_text("utf-8") == FILE.read_text("utf-8")
