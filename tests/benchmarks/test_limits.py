"""Every benchmark in full, held against its limits. Needs a machine that does nothing else."""

import pytest

from tests.benchmarks.registry import BENCHMARKS
from tests.benchmarks.workbench import Workbench


@pytest.fixture(scope="module")
def bench() -> Workbench:
    return Workbench()


@pytest.mark.slow
@pytest.mark.parametrize("one", BENCHMARKS, ids=lambda one: one.name)
def test_limits_are_met(bench, one) -> None:
    if one.name in ("trace", "psf"):
        pytest.importorskip("batoid" if one.name == "trace" else "poppy", reason="the comparison needs it")
    speed = one.measure(bench, False)
    limits = [number for number in speed.numbers if number.limit is not None]
    assert limits or one.name in ("psf", "live")
    missed = {number.key: (number.value, number.limit.text) for number in limits if not number.met}
    assert not missed
