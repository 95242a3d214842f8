"""What the life of an instrument takes of memory and time, to simulate it and to judge it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.monitor.monitor_memory import MonitorSize, largest_piece
from twin.run.cli import InputErrorText
from twin.run.cost import Cost, Lowered
from twin.sensors.area_detector import EmvaDetector

if TYPE_CHECKING:
    from scenes.specs.operation import OperationSetup
    from scenes.yaml.errors import KeyPath
    from twin.operate.lives.simulate import Simulation

STARTED_SECONDS = 5.9
"""Of a life of one reading: kernels, and the record; seconds."""
READING, READING_SECONDS = 2e5, 0.14
"""Bytes and seconds of a reading beside its frames: of numbers that are kept, light, fits, estimators, truth."""
EXPOSED_SECONDS = 1e-7
"""Seconds per pixel of a frame."""


class _Options:
    """Options of the command."""

    def error(self, problem: str, key: KeyPath, *, found: object, allowed: str) -> InputErrorText:
        """Of one of them."""
        return InputErrorText(f"{key[0]}: {problem}; {found} readings, allowed: {allowed}")


def simulation_cost(plan: OperationSetup, what: Simulation) -> Cost:
    """What `simulate_into` takes. More memory than there is the monitor itself refuses, at its key.

    Args:
        plan: of the operation.
        what: is simulated.
    """
    resolved, readings = plan.model, len(what.times)
    each = MonitorSize.stated(resolved, what.frames)
    size = MonitorSize.stated(resolved, what.frames, min(readings, largest_piece(each.pixels * what.frames)))
    exposure = resolved.instrument.autocollimator.area_ccd.exposure
    monitor = size.bytes(EmvaDetector.from_sheet(resolved.area_detector, exposure))

    def needed(count: int) -> float:
        return monitor + count * READING

    seconds = READING_SECONDS + size.pixels * what.frames * EXPOSED_SECONDS
    lower = Lowered(_Options(), ("--every",), readings, "readings", needed)
    return Cost(needed(readings), STARTED_SECONDS + readings * seconds, lower)


JUDGED, JUDGED_SECONDS = 305e6, 4.5
"""Of a short life that is followed: kernels, and what draws its report; bytes and seconds."""
FOLLOWED, FOLLOWED_SECONDS = 2.6e6, 0.2
"""Bytes of a reading in the window of the estimate, and seconds of a reading that is followed."""


def judging_cost(plan: OperationSetup, readings: int) -> Cost:
    """What `judged` and its report take.

    Args:
        plan: of the operation.
        readings: of the monitor in the life.
    """
    held = min(readings, plan.operation.window) * FOLLOWED + readings * READING
    return Cost(JUDGED + held, JUDGED_SECONDS + readings * FOLLOWED_SECONDS)
