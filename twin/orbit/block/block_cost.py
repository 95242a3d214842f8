"""What the adjustment of a block takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.specs.orbit.adjust import OrbitAdjustSpec
from twin.run.cost import Cost, Lowered

if TYPE_CHECKING:
    from scenes.specs.measured.adjust_setup import AnyAdjust

STARTED, STARTED_SECONDS = 197e6, 3.6
"""Of a run with few points: what draws its report, most of all; bytes and seconds."""
OBSERVED = 3.0e3
"""Bytes per image point."""
OBSERVED_SECONDS = 1.3e-4
"""Seconds per image point, for one adjustment."""


def block_cost(setup: AnyAdjust) -> Cost:
    """What `run_adjustment` and its report take; of measured passes, whose tables are not read yet, the least.

    Args:
        setup: the test.
    """
    spec = setup.test
    if not isinstance(spec, OrbitAdjustSpec):
        return Cost(STARTED, STARTED_SECONDS)
    points = spec.points
    scenes, others = len(spec.passes) * len(spec.lines), points.control + points.check
    runs = 2 + sum(one is not None for one in (spec.monitor, spec.laser, spec.terrain)) + bool(spec.angles)
    seconds = STARTED_SECONDS + (points.tie + others) * scenes * OBSERVED_SECONDS * runs

    def needed(ties: int) -> float:
        return STARTED + (ties + others) * scenes * OBSERVED

    return Cost(needed(points.tie), seconds, Lowered(spec, ("points", "tie"), points.tie, "tie points", needed, 0))
