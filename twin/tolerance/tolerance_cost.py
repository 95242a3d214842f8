"""What a tolerance budget takes of memory and time, from what its file says."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from twin.run.cost import Cost, Lowered
from twin.study.runs.plan import CELL
from twin.tolerance.monitor_merit import AT_FIELDS

if TYPE_CHECKING:
    from scenes.specs.tolerance import MeritSpec, ToleranceSetup

STARTED, STARTED_SECONDS = 265e6, 8.0
"""Of a budget of few numbers and cameras: kernels, what draws its report, and a worker; bytes and seconds."""
PAIR, PAIR_SECONDS = 6.6e3, 1.7e-3
"""Bytes and seconds for two numbers that vary together, by which the merits are modelled to the second order."""
CAMERA_SECONDS = 6e-4
"""Seconds of a camera that is drawn, for each field of its merits: light, adjustments and merits."""
DRAWN, MODELLED = 32.0, 40.0
"""Bytes of a number that varies, and of a merit of the models, for each camera."""


def different_fields(merits: Iterable[MeritSpec]) -> int:
    """At how many fields merits need light."""
    return len({place for one in merits if one.kind in AT_FIELDS for place in one.fields})


def tolerance_cost(setup: ToleranceSetup) -> Cost:
    """What `run_tolerance` and its report take, on one core.

    Args:
        setup: the budget.
    """
    test = setup.test
    numbers = sum(max(1, len(one.spectrum)) for one in test.tolerances.values())
    fields = different_fields(test.merits.values())
    columns = len(test.merits) + len(test.compensators)

    def needed(samples: int) -> float:
        return STARTED + numbers**2 * PAIR + samples * (numbers * DRAWN + columns * CELL + len(test.merits) * MODELLED)

    drawn = test.samples * (1 if test.allocation is None else 2)
    seconds = STARTED_SECONDS + numbers**2 * PAIR_SECONDS + drawn * fields * CAMERA_SECONDS
    return Cost(needed(test.samples), seconds, Lowered(test, ("samples",), test.samples, "samples", needed, 20))
