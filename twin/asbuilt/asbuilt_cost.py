"""What an instrument as built takes of memory and time, from what its file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.asbuilt.asbuilt_run import ALONG
from twin.run.cost import Cost, Lowered
from twin.tolerance.tolerance_cost import different_fields

if TYPE_CHECKING:
    from scenes.specs.asbuilt import AsBuiltSetup

STARTED, STARTED_SECONDS = 290e6, 5.9
"""Of an estimate with few draws: kernels, and what draws its report; bytes and seconds."""
DRAW, DRAW_SECONDS = 7e4, 4.1e-4
"""Bytes of a draw, with its states of the prior, of the posterior and after the next move; seconds for each field."""
_ALONG = len(ALONG)


def asbuilt_cost(setup: AsBuiltSetup) -> Cost:
    """What `run_asbuilt` and its report take.

    Args:
        setup: the measurements.
    """
    test = setup.test
    fields = different_fields(test.merits.values()) + _ALONG

    def needed(draws: int) -> float:
        return STARTED + draws * DRAW

    lower = Lowered(test, ("draws",), test.draws, "draws", needed, 20)
    return Cost(needed(test.draws), STARTED_SECONDS + test.draws * fields * DRAW_SECONDS, lower)
