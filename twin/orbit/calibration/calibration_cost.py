"""What an in-orbit calibration takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.specs.orbit.setup import CalibrationSetup
from twin.orbit.images.simulate_cost import images_bytes, images_seconds, sample_step
from twin.run.cost import Cost, Lowered

if TYPE_CHECKING:
    from scenes.specs.measured.orbit_data_setup import AnyCalibration

STARTED, STARTED_SECONDS = 200e6, 5.0
"""Of a calibration over one field with few points: what draws its report, most of all; bytes and seconds."""
POINT = 3e3
"""Bytes per point in each line and field."""
POINT_SECONDS, REPEATED_SECONDS = 1e-3, 1e-3
"""Seconds per point in each line and field, of the campaign itself and of one that is repeated."""


def calibration_cost(setup: AnyCalibration) -> Cost:
    """What `run_calibration` and its report take; of measured passes, whose tables are not read yet, the least.

    Args:
        setup: the test.
    """
    if not isinstance(setup, CalibrationSetup):
        return Cost(STARTED, STARTED_SECONDS)
    test, lines = setup.test, len(setup.camera.lines)
    fields = len(test.fields)
    if test.images is not None:
        plan = test.images
        points = plan.points
        seen = lines * fields * len(plan.patches) * (points.control + points.check + points.tie)
        step, longer = sample_step(test.line_time, plan.ground), "lines" if plan.lines >= plan.pixels else "pixels"

        def needed(side: int) -> float:
            pixels = min(plan.lines, side) * min(plan.pixels, side)
            return STARTED + seen * POINT + images_bytes(pixels, lines, step)

        side = max(plan.lines, plan.pixels)
        imaged = images_seconds(
            fields * len(plan.patches) * lines * plan.lines * plan.pixels, plan.oversampling, measured=True
        )
        lowered = Lowered(test, ("images", longer), side, "lines and pixels", needed, 100)
        return Cost(needed(side), STARTED_SECONDS + seen * POINT_SECONDS + imaged, lowered)
    others = test.points.check + (0 if test.strip is None else test.strip.ties)

    def needed_for(control: int) -> float:
        return STARTED + lines * fields * (control + others) * POINT

    seen = lines * fields * (test.points.control + others)
    seconds = STARTED_SECONDS + seen * (POINT_SECONDS + test.repeats * REPEATED_SECONDS)
    lower = Lowered(test, ("points", "control"), test.points.control, "control points", needed_for)
    return Cost(needed_for(test.points.control), seconds, lower)
