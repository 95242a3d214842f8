"""What an in-orbit calibration takes of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.specs.orbit.setup import CalibrationSetup
from twin.orbit.images.simulate_cost import images_bytes, images_seconds, sample_step
from twin.run.cost import Cost, Lowered

if TYPE_CHECKING:
    from scenes.specs.measured.orbit_data_setup import AnyCalibration

STARTED, STARTED_SECONDS = 230e6, 5.0
"""Of a calibration with few fields and points: what draws its report, most of all; bytes and seconds."""
POINT, POINT_SECONDS = 5.4e3, 5e-4
"""Bytes and seconds per point in each line and field."""
TIE, TIE_SECONDS = 1.7e5, 0.011
"""Bytes and seconds per tie point of a strip in each line and field, with the splines that it determines."""
FIELD_SECONDS, REPEATED_SECONDS = 0.6, 0.3
"""Seconds of a field beside its points, in the campaign itself, with what limits it, and in one that is repeated."""


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
        seconds = STARTED_SECONDS + fields * FIELD_SECONDS + seen * POINT_SECONDS + imaged
        return Cost(needed(side), seconds, lowered)
    assert test.points is not None  # what has no images has points
    control = test.points.control
    others = test.points.check
    ties = lines * fields * (0 if test.strip is None else test.strip.ties)

    def needed_for(count: int) -> float:
        return STARTED + lines * fields * (count + others) * POINT + ties * TIE

    seen = lines * fields * (control + others)
    seconds = STARTED_SECONDS + fields * (FIELD_SECONDS + test.repeats * REPEATED_SECONDS) + seen * POINT_SECONDS
    seconds += ties * TIE_SECONDS
    lower = Lowered(test, ("points", "control"), control, "control points", needed_for)
    return Cost(needed_for(control), seconds, lower)
