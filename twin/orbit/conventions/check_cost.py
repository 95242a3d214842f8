"""What a check of conventions takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.run.cost import Cost

if TYPE_CHECKING:
    from scenes.specs.measured.orbit_data_setup import CheckSetup

STARTED, STARTED_SECONDS = 172e6, 5.0
"""Of a check by few points: what draws its report, most of all; bytes and seconds."""
POINT_SECONDS = 0.0135
"""Seconds of a point under all readings, in each line."""


def check_cost(setup: CheckSetup) -> Cost:
    """What `run_check` and its report take.

    Args:
        setup: the test.
    """
    seen = setup.test.points * len(setup.camera.lines)
    return Cost(STARTED, STARTED_SECONDS + seen * POINT_SECONDS)
