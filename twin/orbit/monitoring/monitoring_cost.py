"""What a monitored orbit takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.monitor.monitor_memory import MonitorSize
from twin.run.cost import Cost
from twin.sensors.area_detector import EmvaDetector

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import MonitorSetup

STARTED_SECONDS = 6.5
"""Of an orbit with few times: kernels, and what draws its report."""
READING_SECONDS, TIME_SECONDS, POINT_SECONDS = 0.03, 0.1, 5e-5
"""Seconds of a reading beside its frames, of a time of the course beside its reading, and of each point at it."""
EXPOSED_SECONDS = 1e-7
"""Seconds per pixel of a frame."""


def monitoring_cost(setup: MonitorSetup) -> Cost:
    """What `run_monitor` and its report take. More memory than there is the monitor itself refuses, at the key that
    decides it (`twin.monitor.monitor_memory`).

    Args:
        setup: the test.
    """
    test, resolved = setup.test, setup.resolved
    times, frames = len(test.course.times), resolved.frames
    size = MonitorSize.stated(resolved, frames, times)
    readings = times + test.repeats
    seconds = readings * (READING_SECONDS + size.pixels * frames * EXPOSED_SECONDS)
    seconds += times * (TIME_SECONDS + test.ground.points * POINT_SECONDS)
    exposure = resolved.instrument.autocollimator.area_ccd.exposure
    return Cost(size.bytes(EmvaDetector.from_sheet(resolved.area_detector, exposure)), STARTED_SECONDS + seconds)
