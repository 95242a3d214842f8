"""The turntable test of paper 004 (section 3.3): a table with a dividing error that nobody knows, and its calibration.

Dividing error = reading - true angle. With `measured:` the comparisons are those of a real bench, from files.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from scenes.yaml.errors import Problem
from scenes.yaml.spec import Number, Reference, Seed, Spec, TitledSpec, Whole
from scenes.yaml.unit_fields import AngleSigma, Quantity
from scenes.yaml.units import ANGLE, format_quantity

TableAngle = Annotated[float, Quantity(ANGLE, largest="360 deg")]
Step = Annotated[float, Quantity(ANGLE, above_zero=True, largest="30 deg")]
MOST_LINES = 10_000_000


class GraduationSpec(Spec):
    """Errors of the grating's lines: a random curve from harmonics of the turn.

    Attributes
    ----------
    rms : AngleSigma
        Over the full circle, expected, radians.
    first, last : Whole
        Harmonics; the shortest wave is 360 deg / last.
    slope : Number
        The amplitude of harmonic k falls as k^-slope.
    """

    rms: AngleSigma
    first: Annotated[Whole, Field(ge=1, le=10_000)] = 3
    last: Annotated[Whole, Field(ge=1, le=10_000)]
    slope: Annotated[Number, Field(ge=0.0, le=4.0)]

    @model_validator(mode="after")
    def _in_order(self) -> GraduationSpec:
        if self.last < self.first:
            raise Problem(
                "the last harmonic is below the first", str(self.last), f"{self.first} or more", within=("last",)
            )
        return self


class SubdivisionSpec(Spec):
    """Error of the interpolation within one period of the grating's signal.

    Attributes
    ----------
    rms : AngleSigma
        Expected, radians.
    lines : Whole
        Periods of the signal in a full turn.
    harmonics : tuple[Whole, ...]
        Of the signal that carry it, equal in the mean.
    """

    rms: AngleSigma
    lines: Annotated[Whole, Field(ge=100, le=MOST_LINES)]
    harmonics: Annotated[tuple[Annotated[Whole, Field(ge=1, le=64)], ...], Field(min_length=1, max_length=16)] = (
        1,
        2,
        4,
    )

    @property
    def period(self) -> float:
        """Period of the signal, radians."""
        return 2.0 * math.pi / self.lines


class DividingErrorSpec(Spec):
    """What the dividing error is made of. Sizes are RMS values over the full circle that the draws have in the mean;
    the amplitude and phase of each harmonic are drawn from the seed.

    Attributes
    ----------
    axis : AngleSigma
        Wobble of the axis, first and second harmonic, radians.
    eccentricity : AngleSigma
        Of the grating, first harmonic, radians.
    graduation : GraduationSpec
        Of the lines.
    subdivision : SubdivisionSpec
        Within a period of the signal.
    repeatability : AngleSigma
        Standard deviation of one reading, radians.
    """

    axis: AngleSigma
    eccentricity: AngleSigma
    graduation: GraduationSpec
    subdivision: SubdivisionSpec
    repeatability: AngleSigma


class ReferenceSpec(Spec):
    """The reference: a polygon on an indexing table, seen by an autocollimator.

    Attributes
    ----------
    calibration : AngleSigma
        Standard deviation of what its certificate leaves unknown at each position, the same in all repeats, radians.
    noise : AngleSigma
        Standard deviation of one reading of the autocollimator, radians.
    gross_error : AngleSigma
        Size of a gross error (a shock, a draught), either sign, radians.
    gross_probability : Number
        Of one in a comparison.
    """

    calibration: AngleSigma
    noise: AngleSigma
    gross_error: AngleSigma
    gross_probability: Annotated[Number, Field(ge=0.0, le=0.2)]


class HeldOutSpec(Spec):
    """Angles that no fit sees, in the middle of the calibration's steps, measured in a series of their own.

    Attributes
    ----------
    repeats : Whole
        Of each.
    spread : AngleSigma
        The table is set off the middle by a random amount within +- this, radians, so that readings fall at all phases
        of the grating's signal, as in use.
    """

    repeats: Annotated[Whole, Field(ge=2, le=1000)]
    spread: AngleSigma


class CalibrationPlanSpec(Spec):
    """Which readings are compared how often.

    Attributes
    ----------
    first, last, step : TableAngle
        Of the readings, radians.
    repeats : Whole
        Of each.
    folds : Whole
        Of the cross-validation.
    held_out : HeldOutSpec
        The angles for the comparison of the fits.
    """

    first: TableAngle
    last: TableAngle
    step: Step
    repeats: Annotated[Whole, Field(ge=1, le=1000)]
    folds: Annotated[Whole, Field(ge=2, le=1000)] = 10
    held_out: HeldOutSpec

    @property
    def count(self) -> int:
        """Number of calibrated readings."""
        return round((self.last - self.first) / self.step) + 1

    @model_validator(mode="after")
    def _makes_sense(self) -> CalibrationPlanSpec:
        shown = {name: format_quantity(getattr(self, name), ANGLE) for name in ("first", "last", "step")}
        if self.last == self.first:
            raise Problem("all angles would be the same", shown["last"], "an angle beyond the first", within=("last",))
        if self.last < self.first:
            raise Problem(
                "the last angle is before the first", shown["last"], f"above {shown['first']}", within=("last",)
            )
        steps = (self.last - self.first) / self.step
        if abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
            allowed = f"a whole part of the region, {math.degrees(self.last - self.first):.6g} deg"
            raise Problem("the region is no whole number of steps", shown["step"], allowed, within=("step",))
        if self.repeats < 2:
            raise Problem(
                "one repeat only: its noise cannot be told",
                str(self.repeats),
                "2 or more, and 5 or more for Chauvenet's criterion to reject any",
                within=("repeats",),
            )
        if self.held_out.spread >= 0.5 * self.step:
            raise Problem(
                "held-out angles would reach the calibrated ones",
                format_quantity(self.held_out.spread, ANGLE),
                f"below half a step, {format_quantity(0.5 * self.step, ANGLE)}",
                within=("held_out", "spread"),
            )
        return self


class TurntableTestSpec(TitledSpec):
    """The turntable test.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    dividing_error : DividingErrorSpec
        Of the table; the analysis does not know it.
    reference : ReferenceSpec
        What the table is compared with.
    calibration : CalibrationPlanSpec
        What is compared.
    camera_angle : TableAngle
        Reading of the table at the middle of the camera's field in the distortion test, radians.
    seed : Seed
        Of everything that is drawn.
    """

    dividing_error: DividingErrorSpec
    reference: ReferenceSpec
    calibration: CalibrationPlanSpec
    camera_angle: TableAngle
    seed: Seed = 1

    @model_validator(mode="after")
    def _camera_is_calibrated(self) -> TurntableTestSpec:
        plan = self.calibration
        if not plan.first < self.camera_angle < plan.last:
            region = f"between {format_quantity(plan.first, ANGLE)} and {format_quantity(plan.last, ANGLE)}"
            raise Problem(
                "outside of the calibrated region",
                format_quantity(self.camera_angle, ANGLE),
                region,
                within=("camera_angle",),
            )
        return self


class TurntableFiles(Spec):
    """Readings of a turntable that were compared with a reference.

    Attributes
    ----------
    comparisons : Reference
        Table of the calibrated readings, a CSV file.
    held_out : Reference | None
        Table of readings between them, measured in a series of their own, by which the fits are judged; without it
        cross-validation judges them, and an error of a period below the step stays unseen.
    reference : AngleSigma
        Standard deviation of what the reference's certificate leaves unknown at each position, the same in all repeats,
        radians.
    folds : Whole
        Of the cross-validation.
    """

    comparisons: Reference
    held_out: Reference | None = None
    reference: AngleSigma
    folds: Annotated[Whole, Field(ge=2, le=1000)] = 10


class MeasuredTurntableSpec(TitledSpec):
    """The turntable test on measured readings.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    measured : TurntableFiles
        The readings.
    seed : Seed
        Of the network's starts.
    """

    measured: TurntableFiles
    seed: Seed = 1
