"""Test with two autocollimators and two mirrors on a turntable.

It is the principle experiment of paper 001 (Wang et al. 2018, section 3.1), which is cited in docs/conventions.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, model_validator

from scenes.specs.detector import DetectorSpec
from scenes.specs.instrument import AreaCcdSpec, Frames, GlassName, ReticleSpec
from scenes.yaml.errors import Problem
from scenes.yaml.spec import Number, Spec, TitledSpec, Whole
from scenes.yaml.unit_fields import AngleSigma, Length, PositiveLength, Quantity, Wavelength
from scenes.yaml.units import ANGLE, LENGTH, SCALE, format_quantity

HalfAngle = Annotated[float, Quantity(ANGLE, above_zero=True, largest="44 deg")]
Step = Annotated[float, Quantity(ANGLE, above_zero=True, largest="1 deg")]
ScaleSigma = Annotated[float, Quantity(SCALE, smallest="0 ppm", largest="1 percent")]
SMALLEST_WINDOW, LARGEST_WINDOW = 48, 512


class LensSpec(Spec):
    """Lens of the collimator: one element with a conic front surface.

    A radius is positive if its centre of curvature lies on the side of the focal plane.

    Attributes
    ----------
    front_radius : float
        Radius of curvature of the surface toward the mirrors, in metres.
    front_conic : float
        Conic constant of the front surface.
    back_radius : float
        Radius of curvature of the surface toward the focal plane, in metres.
    thickness : float
        Thickness of the lens on its axis, in metres.
    glass : str
        Name of the lens's glass in the catalogue.
    diameter : float
        Clear aperture of both surfaces, in metres.
    focal_distance : float
        Distance from the back vertex to the focal plane, in metres.
    """

    front_radius: Length
    front_conic: Number
    back_radius: Length
    thickness: PositiveLength
    glass: GlassName
    diameter: PositiveLength
    focal_distance: PositiveLength

    @model_validator(mode="after")
    def _is_curved(self) -> LensSpec:
        for name in ("front_radius", "back_radius"):
            radius = getattr(self, name)
            if 2.0 * abs(radius) <= self.diameter:
                found, allowed = format_quantity(radius, LENGTH), "a length above half the diameter in size"
                raise Problem("the surface is too strongly curved for its diameter", found, allowed, within=(name,))
        return self


class AutocollimatorSpec(Spec):
    """Digital autocollimator; both of the test are identical.

    The pinhole and the area CCD are side by side, symmetric about the lens's axis, so that a mirror perpendicular to
    the axis sends the pinhole's image to the centre of the CCD.

    Attributes
    ----------
    wavelength : float
        Wavelength of the source, in metres.
    lens : LensSpec
        Lens of the collimator.
    reticle : ReticleSpec
        Light source: an illuminated pinhole in the focal plane.
    area_ccd : AreaCcdSpec
        Detector; its offset counts from the pinhole to the centre of the pixel grid along the system's Y (horizontal)
        and X (up), in metres.
    window : int
        Side of the square region around the spot that is read out, in pixels.
    distance : float
        Distance from the lens's front vertex to the turntable's centre, in metres.
    frames : int
        Number of frames averaged in a reading.
    """

    wavelength: Wavelength
    lens: LensSpec
    reticle: ReticleSpec
    area_ccd: AreaCcdSpec
    window: Annotated[Whole, Field(ge=SMALLEST_WINDOW, le=LARGEST_WINDOW)] = 64
    distance: PositiveLength
    frames: Frames = 9

    @model_validator(mode="after")
    def _window_fits(self) -> AutocollimatorSpec:
        side = min(self.area_ccd.rows, self.area_ccd.columns)
        if self.window > side:
            raise Problem("larger than the area CCD", str(self.window), f"at most {side}", within=("window",))
        half = [0.5 * n * self.area_ccd.pitch for n in (self.area_ccd.columns, self.area_ccd.rows)]
        room = 0.5 * self.reticle.pinhole
        if all(abs(o) < h + room for o, h in zip(self.area_ccd.offset, half, strict=True)):
            least = format_quantity(max(half) + room, LENGTH)
            raise Problem(
                "the pinhole lies on the area CCD",
                ", ".join(format_quantity(o, LENGTH) for o in self.area_ccd.offset),
                f"{least} or more along one of the axes",
                within=("area_ccd", "offset"),
            )
        return self


class MirrorsSpec(Spec):
    """Two plane mirrors on the turntable.

    Attributes
    ----------
    aperture : float
        Diameter of each mirror, in metres; it limits the beam.
    radius : float
        Distance of the mirrors' centres from the turntable's centre, in metres.
    """

    aperture: PositiveLength
    radius: PositiveLength


class StandSpec(Spec):
    """Half of the angle between the two mirrors on the turntable in the main series, by axis of rotation.

    Attributes
    ----------
    X : float
        Half of the angle between the mirrors for rotations of the turntable about X, in radians.
    Y : float
        Half of the angle between the mirrors for rotations of the turntable about Y, in radians.
    Z : float
        Half of the angle between the mirrors for rotations of the turntable about Z, in radians.
    """

    X: HalfAngle
    Y: HalfAngle
    Z: HalfAngle


class ProgrammeSpec(Spec):
    """Programme of rotations of the turntable, between which the autocollimators take readings.

    Attributes
    ----------
    steps : int
        Number of steps after the first reading at zero.
    small : float
        Step of the turntable in a series with smaller steps than the main series, in radians.
    table : float
        Step of the turntable in the main series, in radians.
    large : float
        Step of the turntable in a series with larger steps than the main series, in radians.
    narrow : float
        Half of the angle between the mirrors in the narrow arrangement, in radians.
    wide : float
        Half of the angle between the mirrors in the wide arrangement, in radians.
    stands : StandSpec
        Half of the angle between the mirrors in the main series about each axis.
    """

    steps: Annotated[Whole, Field(ge=1, le=100)]
    small: Step
    table: Step
    large: Step
    narrow: HalfAngle
    wide: HalfAngle
    stands: StandSpec


class BenchErrorsSpec(Spec):
    """Standard deviations of the errors of the test set-up.

    All errors are independent and normally distributed, and are drawn from the seed.

    Attributes
    ----------
    focal_length : float
        Relative error of an autocollimator's focal length against its calibration.
    ccd_rotation : float
        Rotation of an area CCD in its focal plane, in radians.
    reading : float
        Instability of an autocollimator about its X and Y from one reading to the next, in radians.
    turntable_step : float
        Error of each position of the turntable, in radians.
    axis_tilt : float
        Tilt of each axis of the turntable toward the two others, in radians.
    mirror_mount : float
        Mounting error of each mirror about its X and Y, in radians.
    """

    focal_length: ScaleSigma
    ccd_rotation: AngleSigma
    reading: AngleSigma
    turntable_step: AngleSigma
    axis_tilt: AngleSigma
    mirror_mount: AngleSigma


class AutocollimatorTestSpec(TitledSpec):
    """Test with two autocollimators.

    Attributes
    ----------
    autocollimator : AutocollimatorSpec
        Properties of the autocollimators; both are identical.
    mirrors : MirrorsSpec
        Mirrors on the turntable.
    programme : ProgrammeSpec
        Programme of rotations.
    errors : BenchErrorsSpec
        Errors of the test set-up.
    """

    autocollimator: AutocollimatorSpec
    mirrors: MirrorsSpec
    programme: ProgrammeSpec
    errors: BenchErrorsSpec

    @model_validator(mode="after")
    def _mirrors_fit(self) -> AutocollimatorTestSpec:
        least = min(self.programme.narrow, *self._pose_angles())
        # neighbouring rims touch where the mirrors' planes intersect: at radius tan(theta) from either centre
        from_middle = self.mirrors.radius * math.tan(least)
        if 0.5 * self.mirrors.aperture >= from_middle:
            raise Problem(
                "the mirrors overlap",
                format_quantity(self.mirrors.aperture, LENGTH),
                f"below {format_quantity(round(2.0 * from_middle, 6), LENGTH)} at this radius and angle",
                within=("mirrors", "aperture"),
            )
        if self.mirrors.radius >= self.autocollimator.distance:
            raise Problem(
                "the mirrors are behind the autocollimator's lens",
                format_quantity(self.mirrors.radius, LENGTH),
                f"less than the distance, {format_quantity(self.autocollimator.distance, LENGTH)}",
                within=("mirrors", "radius"),
            )
        return self

    def _pose_angles(self) -> tuple[float, float, float]:
        angles = self.programme.stands
        return angles.X, angles.Y, angles.Z


@dataclass(frozen=True)
class AutocollimatorSetup:
    """Test with two autocollimators and the data sheet to which it refers.

    Attributes
    ----------
    spec : AutocollimatorTestSpec
        The test.
    detector : DetectorSpec
        Data sheet of the area CCDs.
    """

    spec: AutocollimatorTestSpec
    detector: DetectorSpec
