"""What random states take of memory and time, from what a job and the command line say."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.monitor.monitor_memory import MonitorSize
from twin.run.cost import Cost

if TYPE_CHECKING:
    from scenes.specs.resolved import ResolvedJob

STARTED, STARTED_SECONDS = 287e6, 8.5
"""Of a run without states: kernels, the limits, and what draws the report; bytes and seconds."""
STATE_SECONDS = 0.1
"""Seconds of a state beside its frames: light, fits, estimators, truth."""
EXPOSED_SECONDS = 1e-7
"""Seconds per pixel of a frame, noise of the light and of the detector with it."""
AT_ONCE = 32
"""States that are rendered together (`twin.uncertainty.coverage.CHUNK`)."""
PIXEL = 219.0
"""Bytes per pixel of the images of the states that are rendered together, before and after."""


def coverage_cost(resolved: ResolvedJob, states: int) -> Cost:
    """What `run_uncertainty` and its report take; more memory than there is, the monitor itself refuses, at its key
    (`twin.monitor.monitor_memory`).

    Args:
        resolved: the job.
        states: random ones.
    """
    monitor = resolved.instrument.monitor
    if monitor is None:
        return Cost(STARTED, STARTED_SECONDS)
    pixels = MonitorSize.stated(resolved, resolved.frames).pixels
    exposed = 2 * resolved.frames * pixels * EXPOSED_SECONDS
    return Cost(STARTED + min(states, AT_ONCE) * pixels * PIXEL, STARTED_SECONDS + states * (STATE_SECONDS + exposed))
