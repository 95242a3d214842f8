"""Every benchmark in full, held against its limits. Times of the wall clock are judged only where nothing else runs."""

import pytest

from tests.benchmarks.limits import Limits
from tests.benchmarks.registry import BENCHMARKS, measured
from tests.benchmarks.workbench import Workbench


@pytest.fixture(scope="module")
def bench() -> Workbench:
    return Workbench()


@pytest.mark.slow
@pytest.mark.parametrize("one", BENCHMARKS, ids=lambda one: one.name)
def test_limits_are_met(bench, one) -> None:
    if one.name in ("trace", "psf"):
        pytest.importorskip("batoid" if one.name == "trace" else "poppy", reason="the comparison needs it")
    speed, limits = measured(one, bench, False), Limits.read()
    numbers = [number for number in speed.numbers if number.limited]
    assert numbers
    unlimited = [n.key for n in numbers if limits.limit(one.name, n) is None and not n.clock]
    assert not unlimited
    missed = {
        number.key: (limits.value(number, speed), limits.limits[f"{one.name}.{number.key}"].text)
        for number in numbers
        if limits.met(one.name, number, speed) is False
    }
    assert not missed
