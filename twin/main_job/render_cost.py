"""What the main job takes of memory and time, from what its files say, before its instrument is built."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.monitor.monitor_memory import MonitorSize
from twin.run.cost import Cost
from twin.sensors.area_detector import EmvaDetector
from twin.targets.target_measurement import target_pixels

if TYPE_CHECKING:
    from scenes.specs.resolved import ResolvedJob

STARTED, STARTED_SECONDS = 400e6, 11.6
"""Of a job of one small state: kernels, and what draws its report; bytes and seconds."""
STATE_SECONDS = 0.05
"""Seconds of a time of a course beside its frames: light, fits, estimators, truth."""
EXPOSED_SECONDS = 1e-7
"""Seconds per pixel of a frame."""
PATH_SECONDS = 1.2e-6
"""Seconds per path of stray light, of each channel."""


def render_cost(resolved: ResolvedJob, frames: int | None = None) -> Cost:
    """What `render_job` and the run folder take. More memory than there is the job itself refuses, at the key that
    decides it (`twin.monitor.monitor_memory`).

    Args:
        resolved: the job.
        frames: of each state, None for as many as the job says.
    """
    monitor, job = resolved.instrument.monitor, resolved.job
    if monitor is None:
        return Cost(STARTED, STARTED_SECONDS)
    count, course = resolved.frames if frames is None else frames, job.course
    times = 0 if course is None else len(course.times)
    size = MonitorSize.stated(resolved, count, times, target_pixels(resolved))
    exposed = size.pixels * count * EXPOSED_SECONDS
    stray = 0.0 if job.render.stray is None else job.render.stray.paths * size.spots * PATH_SECONDS
    seconds = STARTED_SECONDS + 2.0 * exposed + times * (STATE_SECONDS + exposed) + stray
    return Cost(size.bytes(EmvaDetector.from_sheet(resolved.area_detector, monitor.area_ccd.exposure)), seconds)
