"""What a test of intersection angles takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.specs.orbit.setup import AngleSetup
from twin.run.cost import Cost

if TYPE_CHECKING:
    from scenes.specs.measured.orbit_data_setup import AnyAngle

STARTED, STARTED_SECONDS = 205e6, 4.4
"""Of a test in few points and passes: what draws its report, most of all; bytes and seconds."""
PASS_SECONDS, SIGHT_SECONDS = 2e-3, 1.25e-5
"""Seconds of a pass that is repeated, and of each point in it on each line."""


def angle_cost(setup: AnyAngle) -> Cost:
    """What `run_angle_test` and its report take; of measured passes, whose tables are not read yet, the least. Its
    points are few enough for any memory.

    Args:
        setup: the test.
    """
    if not isinstance(setup, AngleSetup):
        return Cost(STARTED, STARTED_SECONDS)
    test = setup.test
    seconds = test.passes * (PASS_SECONDS + test.strips.points * len(setup.pixels) * SIGHT_SECONDS)
    return Cost(STARTED, STARTED_SECONDS + seconds)
