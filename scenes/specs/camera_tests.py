"""Laboratory tests of a camera at the collimator: focal-plane alignment and distortion (interior orientation).

The tests run on the simulated bench or, with `measured:`, on files of a real one (docs/measured_laboratory.md).

Test with two autocollimators and two mirrors on a turntable.

It is the principle experiment of paper 001 (Wang et al. 2018, section 3.1), which is cited in docs/conventions.md.

Turntable test of paper 004 (Li et al. 2020, section 3.3): calibration of an unknown dividing error.

Dividing error = reading - true angle. With `measured:` the comparisons come from files of a real bench.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from optics.targets.collimator import Collimator
from scenes.specs.course import Term, noll
from scenes.specs.detector import DetectorSpec
from scenes.specs.instrument import AreaCcdSpec, Frames, GlassName, ReticleSpec
from scenes.specs.perturbation import FigureTerm, PlainPerturbationSpec
from scenes.yaml import unit_fields
from scenes.yaml.errors import Problem
from scenes.yaml.spec import Name, Number, Paths, Ref, Reference, Seed, Spec, Text, TitledSpec, Whole, require_one
from scenes.yaml.unit_fields import AngleSigma, Quantity
from scenes.yaml.units import ANGLE, LENGTH, SCALE, format_quantity

TableAngle = Annotated[float, Quantity(ANGLE, largest="360 deg")]
CalibrationStep = Annotated[float, Quantity(ANGLE, above_zero=True, largest="30 deg")]
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
    step: CalibrationStep
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


class CollimatorSpec(Spec):
    """Long collimator with its target at the focus.

    Attributes
    ----------
    focal_length : float
        Focal length, in metres.
    aperture : float
        Diameter of the aperture, in metres.
    wavefront : dict[str, float]
        Zernike term (Noll) -> wavefront error over the aperture, in metres rms; by default there is no error.
    """

    focal_length: unit_fields.PositiveLength
    aperture: unit_fields.PositiveLength
    wavefront: Annotated[dict[Term, FigureTerm], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)

    @property
    def model(self) -> Collimator:
        """Optical model of the collimator, which computes its images."""
        terms = {noll(term): size for term, size in self.wavefront.items()}
        return Collimator(self.focal_length, 0.5 * self.aperture, terms)


class CameraUnderTestSpec(Spec):
    """Camera under test, alone in front of the collimator.

    Attributes
    ----------
    camera : str
        Prescription of the camera, or an instrument as built from it, by name or path.
    as_built : Mapping[str, PlainPerturbationSpec]
        Node (``M1``, ``M2`` ... or ``focal_plane``) -> deviation from the prescription, as in a job's `perturb`; mostly
        figure errors of mirrors.
    """

    camera: Ref
    as_built: Paths[PlainPerturbationSpec] = Field(default_factory=FrozenMap)

    @model_validator(mode="after")
    def _cold(self) -> CameraUnderTestSpec:
        for path, what in self.as_built.items():
            if "temperature" in what.needs():
                problem, within = "temperatures are not modelled in the laboratory", ("as_built", path, "temperature")
                raise Problem(problem, "temperature", "rotate, shift, scale or figure", within=within)
        return self


EdgeAngle = Annotated[float, unit_fields.Quantity(ANGLE, smallest="2 deg", largest="15 deg")]
Tilt = Annotated[float, unit_fields.Quantity(ANGLE, largest="30 deg")]
LengthSigmas = Annotated[
    tuple[float, float, float], unit_fields.Vector(unit_fields.Quantity(LENGTH, smallest="0 um", largest="5 mm"))
]
Light = Annotated[float, unit_fields.Quantity(SCALE, smallest="0.1 percent", largest="150 percent")]
Share = Annotated[Number, Field(ge=-1.0, le=1.0)]


class EdgeSpec(Spec):
    """Slanted knife edge, rotated to measure along the line and along the track.

    Attributes
    ----------
    angle : float
        Angle between the edge and the pixel columns or rows, in radians.
    region : int
        Side of the square region around the edge that is analysed, in pixels.
    """

    angle: EdgeAngle
    region: Annotated[Whole, Field(ge=32, le=512)] = 64


class ScanSpec(Spec):
    """Scan of the target through focus. Lengths are the corresponding movements of the image.

    Attributes
    ----------
    half_range : float
        Half range of the first scan, which goes from -half_range to +half_range, in metres.
    step : float
        Step of the first scan, in metres.
    points : int
        Number of points of the second scan, centred on the peak of the first one; with fewer than seven an error of the
        first peak could not be corrected.
    depth : float
        Half width of the second scan as a fraction of the defocus at which geometric blur removes all contrast at the
        Nyquist frequency.
    """

    half_range: unit_fields.PositiveLength
    step: unit_fields.PositiveLength
    points: Annotated[Whole, Field(ge=7, le=101)] = 9
    depth: Annotated[Number, Field(ge=0.2, le=1.5)] = 0.6


class MountSpec(Spec):
    """Mount of the focal-plane assembly: screws with shims on the mounting surface.

    X', Y' and Z' are the axes of the assembly: flight direction, line and normal; O' is the centre of its panchromatic
    line.

    Attributes
    ----------
    holes : tuple[tuple[float, float, float], ...]
        Positions of the screw holes in the assembly's frame O'-X'Y'Z' (X' flight direction, Y' line, Z' normal), in
        metres.
    tilt : float
        Angle of the mounting surface's normal from Z', about Y', in radians.
    clearance : float
        Clearance of the screws in their holes, within which the assembly can slide, in metres.
    thickness : float
        Thickness of the shims before the alignment, in metres.
    step : float
        Resolution to which the workshop grinds a shim, in metres.
    """

    holes: Annotated[tuple[unit_fields.Vector3, ...], Field(min_length=3)]
    tilt: Tilt = 0.0
    clearance: unit_fields.PositiveLength
    thickness: unit_fields.PositiveLength
    step: unit_fields.PositiveLength


class MissetSpec(Spec):
    """Standard deviations of the initial misalignment of the focal-plane assembly relative to the optics.

    X', Y' and Z' are the axes of the assembly: flight direction, line and normal.

    Attributes
    ----------
    rotate : tuple[float, float, float]
        Rotations about X', Y', Z' through the centre of the panchromatic line, in radians.
    shift : tuple[float, float, float]
        Shifts of the assembly along X', Y', Z', in metres.
    chips : float
        Height error of each line CCD relative to the assembly, which no shim can correct, in metres.
    """

    rotate: unit_fields.AngleSigmas
    shift: LengthSigmas
    chips: unit_fields.LengthSigma = 0.0


class FocusTestSpec(CameraUnderTestSpec):
    """Alignment of a focal plane with the through-focus test.

    Attributes
    ----------
    name : str
        Name of the test.
    description : str
        Description for readers; the program does not use it.
    collimator : CollimatorSpec
        Collimator in front of the camera.
    edge : EdgeSpec
        Slanted knife edge at the collimator's focus, the target that is imaged.
    fields : tuple[float, ...]
        Fields along the line, as fractions of half the line's length, -1 to 1.
    white : float
        Signal of the bright side of the edge, as a fraction of the full well.
    frames : int
        Number of frames averaged at each position of the target.
    scan : ScanSpec
        Scan of the target through focus.
    misset : MissetSpec
        Standard deviations of the initial misalignment of the focal-plane assembly.
    mount : MountSpec
        Mount of the focal-plane assembly: screws with shims.
    level : float
        Standard deviation of the theodolite's reading of the line's level, in radians.
    rounds : int
        Number of rounds in which the assembly is measured and then corrected by shims.
    seed : int
        Seed of all random numbers.
    """

    name: Name
    description: Text = ""
    collimator: CollimatorSpec
    edge: EdgeSpec
    fields: Annotated[tuple[Share, ...], Field(min_length=2, max_length=41)]
    white: Light
    frames: Frames = 4
    scan: ScanSpec
    misset: MissetSpec
    mount: MountSpec
    level: unit_fields.AngleSigma
    rounds: Annotated[Whole, Field(ge=1, le=10)] = 1
    seed: Seed = 1

    @model_validator(mode="after")
    def _scan_has_steps(self) -> FocusTestSpec:
        if 2.0 * self.scan.half_range < 5.0 * self.scan.step:
            value = f"{format_quantity(self.scan.step, LENGTH)} over +-{format_quantity(self.scan.half_range, LENGTH)}"
            raise Problem("fewer than six positions through focus", value, "a smaller step", within=("scan", "step"))
        if len(set(self.fields)) < len(self.fields):
            raise Problem("a field is given twice", str(list(self.fields)), "different fields", within=("fields",))
        return self


class DistortionTestSpec(CameraUnderTestSpec):
    """Distortion test: the camera on a turntable images a pinhole in the collimator, point by point along its line.

    Attributes
    ----------
    name : str
        Name of the test.
    description : str
        Description for readers; the program does not use it.
    collimator : CollimatorSpec
        Collimator in front of the camera.
    turntable : str
        Turntable test with the dividing error and the calibration, by name or path.
    pinhole : float
        Diameter of the pinhole target, in metres.
    band : str
        Band whose line CCD is measured.
    points : int
        Number of points over the field.
    extent : float
        Distance of the first and last point from the line's centre, as a fraction of half the line's length.
    sets : int
        Number of times that all points are measured.
    light : float
        Signal of the brightest pixel, as a fraction of the full well.
    frames : int
        Number of frames averaged at each point.
    window : int
        Side of the square region around the spot, in pixels.
    zero : float
        Standard deviation of aligning the line's centre to the collimator's axis at the middle angle of the turntable,
        in radians.
    axis_tilt : float
        Standard deviation of the tilt of the turntable's axis against the camera's X, in radians.
    setting : float
        Standard deviation with which the turntable stops at a required reading, in radians.
    seed : int
        Seed of all random numbers.
    """

    name: Name
    description: Text = ""
    collimator: CollimatorSpec
    turntable: Ref
    pinhole: unit_fields.PositiveLength
    band: Name
    points: Annotated[Whole, Field(ge=3, le=1001)]
    extent: Annotated[Number, Field(ge=0.05, lt=1.0)]
    sets: Annotated[Whole, Field(ge=1, le=1000)]
    light: Light
    frames: Frames = 4
    window: Annotated[Whole, Field(ge=24, le=128)] = 32
    zero: unit_fields.AngleSigma
    axis_tilt: unit_fields.AngleSigma
    setting: unit_fields.AngleSigma = 0.0
    seed: Seed = 1


NotNegative = Annotated[Number, Field(ge=0.0, le=1e9)]
Positive = Annotated[Number, Field(gt=0.0, le=1e9)]


class LineSpec(Spec):
    """Line CCD whose spot positions are given in pixels.

    Attributes
    ----------
    pitch : float
        Pixel pitch, in metres.
    middle : float
        Column of the line's centre, from which positions are counted; the centre of the first pixel is 0.
    """

    pitch: unit_fields.PositiveLength
    middle: Annotated[Number, Field(ge=0.0, le=1e7)]


class DistortionFiles(Spec):
    """Measured angles and spot positions of a camera on a turntable.

    Attributes
    ----------
    spots : str
        CSV file of turntable readings and spot positions on the line.
    zero : float
        Approximate reading at which the line's centre is imaged, in radians; the fit estimates its error.
    line : LineSpec | None
        Pixels of the line, for a table whose positions are columns; omitted if they are lengths.
    reversed : bool
        True if turntable readings increase while positions on the line decrease.
    turntable : TurntableFiles | None
        Calibration of the turntable; without it the readings are used as they are.
    angle_sigma : float | None
        Standard deviation of the angle error of each point without a calibration, in radians: independent from point to
        point and the same in all sets.
    """

    spots: Reference
    zero: TableAngle
    line: LineSpec | None = None
    reversed: bool = False
    turntable: TurntableFiles | None = None
    angle_sigma: unit_fields.AngleSigma | None = None

    @model_validator(mode="after")
    def _one_source_of_sigmas(self) -> DistortionFiles:
        problem = "the accuracy of the angles must be given in exactly one way"
        require_one(self, ("turntable", "angle_sigma"), problem, "turntable: or angle_sigma:")
        return self


class MeasuredDistortionSpec(TitledSpec):
    """Distortion test with measured angles and spot positions.

    Attributes
    ----------
    principal_distance : float
        Approximate principal distance of the camera, in metres; it is used to evaluate the scatter between sets.
    measured : DistortionFiles
        Angles and spot positions.
    seed : int
        Seed, without effect: nothing in this evaluation is random.
    """

    principal_distance: unit_fields.PositiveLength
    measured: DistortionFiles
    seed: Seed = 1


class NoiseSpec(Spec):
    """Noise of the detector that took the images, as in an EMVA 1288 data sheet.

    Attributes
    ----------
    gain_dn_per_e : float
        System gain, in grey values per electron.
    dark_noise_e : float
        Read noise, in electrons rms.
    dark_signal_e : float
        Dark signal of an exposure, in electrons.
    offset_dn : float
        Black level, in grey values.
    prnu : float
        Photo response non-uniformity, relative rms.
    dsnu_e : float
        Dark signal non-uniformity, in electrons rms.
    saturation_dn : float
        Grey value above which the response is not linear.
    """

    gain_dn_per_e: Positive
    dark_noise_e: NotNegative
    dark_signal_e: NotNegative = 0.0
    offset_dn: NotNegative = 0.0
    prnu: Annotated[Number, Field(ge=0.0, le=1.0)] = 0.0
    dsnu_e: NotNegative = 0.0
    saturation_dn: Positive


class LevelSpec(Spec):
    """Level of the line as read by a theodolite.

    Attributes
    ----------
    angle : float
        Rotation of the line from its required direction about Z', the normal of the focal-plane assembly, in radians.
    sigma : float
        Standard deviation of this angle, in radians.
    """

    angle: unit_fields.Angle
    sigma: unit_fields.AngleSigma


class FocusFiles(Spec):
    """Measured through-focus series at several fields.

    Attributes
    ----------
    mtf : str | None
        CSV file of MTF values with their standard deviations; either this or `images` is required.
    images : str | None
        CSV file that lists images of a slanted knife edge; either this or `mtf` is required.
    moved : {'image', 'target', 'focal_plane'}
        Component to which the shifts refer, always along the light: ``image``, ``target`` or ``focal_plane`` (the CCD).
    per_shift : float | None
        Image shift per target shift for ``target``, (f of the camera / f of the collimator)^2; a column `per shift` of
        the table overrides it.
    frequency : float
        Spatial frequency of the MTF that is measured in images, in cycles per pixel.
    noise : dict[str, NoiseSpec]
        Name of a band -> noise of its detector, for images; for other bands the noise is estimated from the image.
    level : LevelSpec | None
        Level of the line; without it the rotation about Z' is not corrected.
    """

    mtf: Reference | None = None
    images: Reference | None = None
    moved: Literal["image", "target", "focal_plane"]
    per_shift: Annotated[Number, Field(gt=0.0, le=1e6)] | None = None
    frequency: Annotated[Number, Field(ge=0.01, le=0.75)] = 0.5
    noise: Annotated[dict[Name, NoiseSpec], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)
    level: LevelSpec | None = None

    @model_validator(mode="after")
    def _one_table(self) -> FocusFiles:
        require_one(self, ("mtf", "images"), "one table is needed", "mtf: or images:")
        if self.noise and self.images is None:
            problem = "sigmas of MTF values are given in their table"
            raise Problem(problem, "noise", "images: in place of mtf:", within=("noise",))
        if self.per_shift is not None and self.moved != "target":
            problem = "a ratio per_shift is possible only if the target is moved"
            raise Problem(problem, allowed="moved: target", within=("per_shift",))
        return self


class MeasuredFocusSpec(TitledSpec):
    """Alignment of a focal plane from a measured through-focus series.

    Attributes
    ----------
    measured : FocusFiles
        Through-focus series.
    mount : MountSpec
        Mount of the focal-plane assembly: screws with shims.
    shims : tuple[float, ...] | None
        Present thickness of the shim at each hole, in metres; by default the `thickness` of `mount`.
    vertex_error : float
        Standard deviation of the error of a best-focus position that the shape of the through-focus curve causes,
        common to all fields, in metres; the default holds for F/8 to F/10 and wavefront errors of 0.2 waves.
    vertex_trend : float
        Standard deviation of the change of that error from the centre to the ends of the fields, in metres.
    seed : int
        Seed, without effect: nothing in this evaluation is random.
    """

    measured: FocusFiles
    mount: MountSpec
    shims: tuple[unit_fields.PositiveLength, ...] | None = None
    vertex_error: unit_fields.LengthSigma = 0.5e-6
    vertex_trend: unit_fields.LengthSigma = 0.15e-6
    seed: Seed = 1

    @model_validator(mode="after")
    def _shim_for_each_hole(self) -> MeasuredFocusSpec:
        if self.shims is not None and len(self.shims) != len(self.mount.holes):
            value, allowed = f"{len(self.shims)} of them", f"{len(self.mount.holes)}, one for each hole"
            raise Problem("the number of shims differs from the number of holes", value, allowed, within=("shims",))
        return self


HalfAngle = Annotated[float, unit_fields.Quantity(ANGLE, above_zero=True, largest="44 deg")]
Step = Annotated[float, unit_fields.Quantity(ANGLE, above_zero=True, largest="1 deg")]
ScaleSigma = Annotated[float, unit_fields.Quantity(SCALE, smallest="0 ppm", largest="1 percent")]
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

    front_radius: unit_fields.Length
    front_conic: Number
    back_radius: unit_fields.Length
    thickness: unit_fields.PositiveLength
    glass: GlassName
    diameter: unit_fields.PositiveLength
    focal_distance: unit_fields.PositiveLength

    @model_validator(mode="after")
    def _is_curved(self) -> LensSpec:
        for name in ("front_radius", "back_radius"):
            radius = getattr(self, name)
            if 2.0 * abs(radius) <= self.diameter:
                value, allowed = format_quantity(radius, LENGTH), "a length above half the diameter in size"
                raise Problem("the surface is too strongly curved for its diameter", value, allowed, within=(name,))
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

    wavelength: unit_fields.Wavelength
    lens: LensSpec
    reticle: ReticleSpec
    area_ccd: AreaCcdSpec
    window: Annotated[Whole, Field(ge=SMALLEST_WINDOW, le=LARGEST_WINDOW)] = 64
    distance: unit_fields.PositiveLength
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

    aperture: unit_fields.PositiveLength
    radius: unit_fields.PositiveLength


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
    ccd_rotation: unit_fields.AngleSigma
    reading: unit_fields.AngleSigma
    turntable_step: unit_fields.AngleSigma
    axis_tilt: unit_fields.AngleSigma
    mirror_mount: unit_fields.AngleSigma


class AutocollimatorTestSpec(TitledSpec):
    """Principle experiment: two autocollimators read two mirrors on a turntable that rotates in known steps.

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
