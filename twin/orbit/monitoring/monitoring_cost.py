"""What a monitored orbit takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.monitor.monitor_memory import MonitorSize
from twin.orbit.images.simulate_cost import PIXEL, images_seconds
from twin.run.cost import Cost, Lowered
from twin.sensors.area_detector import EmvaDetector

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import MonitorSetup

STARTED_SECONDS = 6.5
"""Of an orbit with few times: kernels, and what draws its report."""
READING_SECONDS, TIME_SECONDS, POINT_SECONDS = 0.03, 0.1, 5e-5
"""Seconds of a reading beside its frames, of a time of the course beside its reading, and of each point at it."""
EXPOSED_SECONDS = 1e-7
"""Seconds per pixel of a frame."""
LOOP_SECONDS = 0.5
"""Seconds of a reading with the loop closed and open."""
_PASSES, _PAIR, _OVERSAMPLING = 2, 2, 3


def monitoring_cost(setup: MonitorSetup) -> Cost:
    """What `run_monitor` and its report take. More memory than there is the monitor itself refuses, at the key that
    decides it (`twin.monitor.monitor_memory`).

    Args:
        setup: the test.
    """
    test, resolved = setup.test, setup.resolved
    times, frames = len(test.times), resolved.frames
    size = MonitorSize.stated(resolved, frames, 0 if test.mechanisms is not None else times)
    monitor = size.bytes(
        EmvaDetector.from_sheet(resolved.area_detector, resolved.instrument.autocollimator.area_ccd.exposure)
    )
    if test.mechanisms is None:
        seconds = (times + test.repeats) * (READING_SECONDS + size.pixels * frames * EXPOSED_SECONDS)
        return Cost(monitor, STARTED_SECONDS + seconds + times * (TIME_SECONDS + test.ground.points * POINT_SECONDS))
    seconds, images = STARTED_SECONDS + times * LOOP_SECONDS, test.mechanisms.images
    if images is None:
        return Cost(monitor, seconds)

    def needed(side: int) -> float:
        return monitor + side**2 * _PAIR * PIXEL

    seconds += images_seconds(_PASSES * len(images.times) * _PAIR * images.side**2, _OVERSAMPLING, measured=True)
    lower = Lowered(test, ("mechanisms", "images", "side"), images.side, "lines and pixels", needed, 100)
    return Cost(needed(images.side), seconds, lower)
