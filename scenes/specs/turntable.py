"""Turntable test of paper 004 (Li et al. 2020, section 3.3): calibration of an unknown dividing error.

Dividing error = reading - true angle. With `measured:` the comparisons come from files of a real bench.
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
    """Errors of the lines of the turntable's grating: a random curve of harmonics of the full circle.

    Attributes
    ----------
    rms : float
        Expected rms of the curve over the full circle, in radians.
    first : int
        Lowest harmonic of the curve; harmonic 1 has one period in the full circle.
    last : int
        Highest harmonic of the curve, whose period is 360 deg / last.
    slope : float
        Exponent of the spectrum: the amplitude of harmonic k falls as k^-slope.
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
    rms : float
        Expected rms of the interpolation error, in radians.
    lines : int
        Number of signal periods in a full circle.
    harmonics : tuple[int, ...]
        Harmonics of the signal with this error; they are equal on average.
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
        """Angle of one period of the grating's signal, in radians."""
        return 2.0 * math.pi / self.lines


class DividingErrorSpec(Spec):
    """Components of the dividing error.

    Sizes are expected RMS values over the full circle; the amplitude and phase of each harmonic are drawn from the
    seed.

    Attributes
    ----------
    axis : float
        Expected rms of the error due to wobble of the axis, first and second harmonic, in radians.
    eccentricity : float
        Expected rms of the error due to eccentricity of the grating, first harmonic, in radians.
    graduation : GraduationSpec
        Errors of the grating's lines.
    subdivision : SubdivisionSpec
        Interpolation error within a period of the signal.
    repeatability : float
        Standard deviation of a single reading, in radians.
    """

    axis: AngleSigma
    eccentricity: AngleSigma
    graduation: GraduationSpec
    subdivision: SubdivisionSpec
    repeatability: AngleSigma


class ReferenceSpec(Spec):
    """Reference standard: a polygon on an indexing table, read by an autocollimator.

    Attributes
    ----------
    calibration : float
        Standard uncertainty of the reference's certificate at each position, the same error in all repeats, in radians.
    noise : float
        Standard deviation of a single reading of the autocollimator, in radians.
    gross_error : float
        Size of a gross error (a shock, a draught), of either sign, in radians.
    gross_probability : float
        Probability of a gross error in a comparison.
    """

    calibration: AngleSigma
    noise: AngleSigma
    gross_error: AngleSigma
    gross_probability: Annotated[Number, Field(ge=0.0, le=0.2)]


class HeldOutSpec(Spec):
    """Held-out angles, in the middle of the calibration's steps, which no fit uses.

    They are measured in a separate series.

    Attributes
    ----------
    repeats : int
        Number of repeats of each angle.
    spread : float
        Half range of a random offset of the turntable from the middle of a step, in radians, so that readings cover all
        phases of the grating's signal, as in use.
    """

    repeats: Annotated[Whole, Field(ge=2, le=1000)]
    spread: AngleSigma


class CalibrationPlanSpec(Spec):
    """Plan of the calibration: the readings that are compared with the reference.

    Attributes
    ----------
    first : float
        First reading that is calibrated, in radians.
    last : float
        Last reading that is calibrated, in radians.
    step : float
        Step between the readings that are calibrated, in radians.
    repeats : int
        Number of repeats of each comparison.
    folds : int
        Number of folds of the cross-validation.
    held_out : HeldOutSpec
        Held-out angles by which the fits are compared.
    """

    first: TableAngle
    last: TableAngle
    step: Step
    repeats: Annotated[Whole, Field(ge=1, le=1000)]
    folds: Annotated[Whole, Field(ge=2, le=1000)] = 10
    held_out: HeldOutSpec

    @property
    def count(self) -> int:
        """Number of readings of the turntable that are calibrated."""
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
            allowed = f"a whole fraction of the region, {math.degrees(self.last - self.first):.6g} deg"
            raise Problem("the region is not a whole number of steps", shown["step"], allowed, within=("step",))
        if self.repeats < 2:
            raise Problem(
                "a single repeat does not determine the noise",
                str(self.repeats),
                "2 or more, and 5 or more for Chauvenet's criterion to reject any",
                within=("repeats",),
            )
        if self.held_out.spread >= 0.5 * self.step:
            raise Problem(
                "held-out angles would overlap the calibrated ones",
                format_quantity(self.held_out.spread, ANGLE),
                f"below half a step, {format_quantity(0.5 * self.step, ANGLE)}",
                within=("held_out", "spread"),
            )
        return self


class TurntableTestSpec(TitledSpec):
    """Test of a simulated turntable: calibration of its dividing error against a reference.

    Attributes
    ----------
    dividing_error : DividingErrorSpec
        True dividing error of the simulated turntable; the analysis does not use it.
    reference : ReferenceSpec
        Errors of the reference standard of angles: a polygon on an indexing table, read by an autocollimator.
    calibration : CalibrationPlanSpec
        Readings that are compared with the reference, and number of repeats.
    camera_angle : float
        Reading of the turntable at the centre of the camera's field in the distortion test, in radians.
    seed : int
        Seed of all random numbers.
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
    """Files with readings of a turntable and their comparisons with a reference.

    Attributes
    ----------
    comparisons : str
        CSV file of the calibrated readings.
    held_out : str | None
        CSV file of readings between the calibrated ones, from a separate series, by which the fits are judged. Without
        it, cross-validation judges them and does not detect an error with a period below the step.
    reference : float
        Standard uncertainty of the reference's certificate at each position, the same error in all repeats, in radians.
    folds : int
        Number of folds of the cross-validation.
    """

    comparisons: Reference
    held_out: Reference | None = None
    reference: AngleSigma
    folds: Annotated[Whole, Field(ge=2, le=1000)] = 10


class MeasuredTurntableSpec(TitledSpec):
    """Turntable test on measured readings.

    Attributes
    ----------
    measured : TurntableFiles
        Comparisons of readings with a reference.
    seed : int
        Seed of the neural network's starting values.
    """

    measured: TurntableFiles
    seed: Seed = 1
