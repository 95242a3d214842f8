"""What a monitor in a loop takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.monitor.monitor_memory import MonitorSize
from twin.orbit.images.simulate_cost import PIXEL, images_seconds
from twin.run.cost import Cost, Lowered
from twin.sensors.area_detector import EmvaDetector

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import LoopSetup

STARTED_SECONDS = 5.0
"""Of a loop of few readings: kernels, and what draws its report."""
READING_SECONDS = 0.5
"""Seconds of a reading, with the loop closed and open."""
_PASSES, _PAIR, _OVERSAMPLING = 2, 2, 3


def loop_cost(setup: LoopSetup) -> Cost:
    """What `run_loop` and its report take. Larger CCDs than the memory takes the monitor itself refuses, at their key.

    Args:
        setup: the test.
    """
    test, images, resolved = setup.test, setup.test.images, setup.resolved
    size = MonitorSize.stated(resolved, resolved.frames)
    exposure = resolved.instrument.autocollimator.area_ccd.exposure
    monitor = size.bytes(EmvaDetector.from_sheet(resolved.area_detector, exposure))
    seconds = STARTED_SECONDS + test.readings.count * READING_SECONDS
    if images is None:
        return Cost(monitor, seconds)

    def needed(side: int) -> float:
        return monitor + side**2 * _PAIR * PIXEL

    pairs = _PASSES * len(images.times)
    seconds += images_seconds(pairs * _PAIR * images.side**2, _OVERSAMPLING, measured=True)
    lower = Lowered(test, ("images", "side"), images.side, "lines and pixels", needed, 100)
    return Cost(needed(images.side), seconds, lower)
