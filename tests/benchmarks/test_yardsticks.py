"""Yardsticks: a slower machine has longer ones, and a number is told as on the machine of reference."""

import pytest

from tests.benchmarks.number import Number, Speed
from tests.benchmarks.registry import Benchmark, measured
from tests.benchmarks.stopwatch import OtherPrograms, processor_s
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import INSIDE, OUTSIDE, YARDSTICKS, Watch, interpreted, pace, processor_time

NOW = {"python": 0.01, "arithmetic": 0.001}


def test_twice_the_yardstick_is_half_the_value() -> None:
    time = Number("s", 3.0, "a time", "s", pace(python=1.0))
    rate = Number("per_s", 3.0, "a rate", "1/s", pace(python=1.0), least=True)
    slower = {**NOW, "python": 0.02}
    assert time.at_reference(NOW, NOW) == 3.0
    assert time.at_reference(slower, NOW) == 1.5
    assert rate.at_reference(slower, NOW) == 6.0


def test_a_mix_slows_by_its_shares() -> None:
    mixed = pace(python=0.25, arithmetic=0.75)
    assert mixed.slowness({"python": 0.03, "arithmetic": 0.002}, NOW) == pytest.approx(0.25 * 3.0 + 0.75 * 2.0)
    assert mixed.text == "python 25% arithmetic 75%"
    assert pace(start=1.0).text == "start"


def test_what_no_machine_changes_stays() -> None:
    assert Number("ratio", 3.0, "a ratio").at_reference({}, NOW) == 3.0
    assert Speed((Number("ratio", 3.0, "a ratio"),)).at_reference(NOW) == {}


def test_shares_are_of_yardsticks_and_make_one() -> None:
    with pytest.raises(ValueError, match="no yardstick disk"):
        pace(disk=1.0)
    with pytest.raises(ValueError, match=r"make 0\.9, not 1"):
        pace(python=0.5, memory=0.4)


def test_yardsticks_of_this_process_are_short_and_positive() -> None:
    watch = Watch(INSIDE)
    assert watch.seconds == {}
    for _ in range(3):
        watch.look()
    assert watch.seconds.keys() == set(INSIDE)
    assert all(1e-4 < seconds < 0.5 for seconds in watch.seconds.values())


@pytest.mark.slow  # two programs that share a core take each other's cache and pace
def test_a_yardstick_is_proportional_to_its_work() -> None:
    """Processor time of one, and of two in its place: the least of several, since the machine is not alone."""

    def twice() -> None:
        interpreted()
        interpreted()

    one = min(processor_time(interpreted) for _ in range(7))
    two = min(processor_time(twice) for _ in range(7))
    assert 1.4 < two / one < 2.8


@pytest.mark.second
def test_yardsticks_of_other_processes() -> None:
    """LLVM compiles anew each time, whatever kernels the user's cache has."""
    watch = Watch(OUTSIDE)
    watch.look()
    watch.look()
    assert YARDSTICKS.keys() == set(INSIDE) | set(OUTSIDE)
    assert 0.02 < watch.seconds["start"] < 10.0
    assert 0.01 < watch.seconds["compile"] < 10.0


def test_a_benchmark_has_the_yardsticks_of_its_time() -> None:
    def measure(bench: Workbench, quick: bool) -> Speed:
        bench.look()
        return Speed((Number("s", 1.0, "a time", "s", pace(python=1.0)),))

    found = measured(Benchmark("some", "text", measure, 1.0, 1.0, ("python",)), Workbench(), True)
    assert found.yardsticks.keys() == {"python"}
    assert found["s"] == 1.0
    assert 0.0 <= found.others <= 1.0


def test_processor_time_of_this_process_is_not_that_of_others() -> None:
    others, spent = OtherPrograms(), processor_s()
    processor_time(interpreted, 10)
    assert processor_s() > spent
    assert 0.0 <= others.share <= 1.0
