"""What a search for jitter takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.orbit.jitter_spectrum import OVERSAMPLING
from scenes.specs.orbit.setup import JitterSetup
from twin.run.cost import Cost, Lowered

if TYPE_CHECKING:
    from scenes.specs.measured.orbit_data_setup import AnyJitter

STARTED, STARTED_SECONDS = 226e6, 2.6
"""Of a search in few points: what draws its report, most of all; bytes and seconds."""
SIGHT = 6.3e3
"""Bytes per point in each line."""
SIGHT_SECONDS, FREQUENCY_SECONDS = 1.5e-4, 7.2e-7
"""Seconds per point in each line, and per frequency that is looked at for each of them."""


def jitter_cost(setup: AnyJitter) -> Cost:
    """What `run_jitter` and its report take; of measured passes, whose tables are not read yet, the least.

    Args:
        setup: the test.
    """
    if not isinstance(setup, JitterSetup):
        return Cost(STARTED, STARTED_SECONDS)
    test = setup.test
    lines = len(test.lines or setup.camera.lines)
    sights = test.points.count * lines
    frequencies = OVERSAMPLING * test.points.duration * (test.search.highest - test.search.lowest)

    def needed(points: int) -> float:
        return STARTED + points * lines * SIGHT

    seconds = STARTED_SECONDS + sights * (SIGHT_SECONDS + frequencies * FREQUENCY_SECONDS)
    return Cost(
        needed(test.points.count), seconds, Lowered(test, ("points", "count"), test.points.count, "points", needed, 30)
    )
