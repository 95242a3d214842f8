"""The laboratory's collimator and the tests of a camera in front of it: focal-plane alignment, interior orientation; on
the simulated bench and, with `measured:`, on files of a real one (docs/measured_laboratory.md).
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from optics.targets.collimator import Collimator
from scenes.specs.course import Term, noll
from scenes.specs.instrument import Frames
from scenes.specs.perturbation import FigureTerm, PlainPerturbationSpec
from scenes.specs.turntable import TableAngle, TurntableFiles
from scenes.yaml.errors import Problem
from scenes.yaml.spec import Name, Number, Paths, Ref, Reference, Seed, Spec, Text, TitledSpec, Whole, one_given
from scenes.yaml.unit_fields import (
    Angle,
    AngleSigma,
    AngleSigmas,
    LengthSigma,
    PositiveLength,
    Quantity,
    Vector,
    Vector3,
)
from scenes.yaml.units import ANGLE, LENGTH, SCALE, format_quantity


class CollimatorSpec(Spec):
    """A long collimator with its target at the focus.

    Attributes
    ----------
    focal_length : PositiveLength
        metres.
    aperture : PositiveLength
        Diameter, metres.
    wavefront : dict[Term, FigureTerm]
        Its error over the aperture by Zernike terms, Noll's numbering, metres rms.
    """

    focal_length: PositiveLength
    aperture: PositiveLength
    wavefront: Annotated[dict[Term, FigureTerm], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)

    @property
    def model(self) -> Collimator:
        """The collimator."""
        terms = {noll(term): size for term, size in self.wavefront.items()}
        return Collimator(self.focal_length, 0.5 * self.aperture, terms)


class CameraUnderTestSpec(Spec):
    """The camera under test, alone in front of the collimator.

    Attributes
    ----------
    camera : Ref
        Prescription, or an instrument as built to one, by name or path.
    as_built : Paths[PlainPerturbationSpec]
        How it departs from the prescription: ``M1``, ``M2`` ... or ``focal_plane`` -> perturbation, as in a job;
        figures of mirrors for the most part.
    """

    camera: Ref
    as_built: Paths[PlainPerturbationSpec] = Field(default_factory=FrozenMap)

    @model_validator(mode="after")
    def _cold(self) -> "CameraUnderTestSpec":
        for path, what in self.as_built.items():
            if "temperature" in what.needs():
                problem, within = "temperatures are not modelled in the laboratory", ("as_built", path, "temperature")
                raise Problem(problem, "temperature", "rotate, shift, scale or figure", within=within)
        return self


EdgeAngle = Annotated[float, Quantity(ANGLE, smallest="2 deg", largest="15 deg")]
Tilt = Annotated[float, Quantity(ANGLE, largest="30 deg")]
LengthSigmas = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, smallest="0 um", largest="5 mm"))]
Light = Annotated[float, Quantity(SCALE, smallest="0.1 percent", largest="150 percent")]
Share = Annotated[Number, Field(ge=-1.0, le=1.0)]


class EdgeSpec(Spec):
    """The slanted knife edge, turned to measure along the line and along the track.

    Attributes
    ----------
    angle : EdgeAngle
        Between the edge and the pixel columns or rows, radians.
    region : Whole
        Side of the square region around it that is analysed, pixels.
    """

    angle: EdgeAngle
    region: Annotated[Whole, Field(ge=32, le=512)] = 64


class ScanSpec(Spec):
    """How the target is moved through focus; lengths are those by which the image moves.

    Attributes
    ----------
    reach : PositiveLength
        The first scan goes from -reach to +reach, metres.
    step : PositiveLength
        Of the first scan, metres.
    points : Whole
        Of the second scan, about the peak that the first one found; fewer than seven would leave no room for an error
        of the first.
    depth : Number
        Half width of the second scan as a share of the defocus at which geometric blur takes all contrast at the
        Nyquist frequency.
    """

    reach: PositiveLength
    step: PositiveLength
    points: Annotated[Whole, Field(ge=7, le=101)] = 9
    depth: Annotated[Number, Field(ge=0.2, le=1.5)] = 0.6


class MountSpec(Spec):
    """How the focal-plane assembly is screwed to its mounting surface.

    Attributes
    ----------
    holes : tuple[Vector3, ...]
        Their places in the assembly's frame O'-X'Y'Z', metres.
    tilt : Tilt
        Of the mounting surface's normal from Z', about Y', radians.
    clearance : PositiveLength
        By which the screws leave each hole free to slide, metres.
    thickness : PositiveLength
        Of the shims before the work, metres.
    step : PositiveLength
        To which the workshop grinds a shim, metres.
    """

    holes: Annotated[tuple[Vector3, ...], Field(min_length=3)]
    tilt: Tilt = 0.0
    clearance: PositiveLength
    thickness: PositiveLength
    step: PositiveLength


class MissetSpec(Spec):
    """Standard deviations of how the focal-plane assembly stands at the beginning, against the optics.

    Attributes
    ----------
    rotate : AngleSigmas
        About X', Y', Z' through the middle of the panchromatic line, radians.
    shift : LengthSigmas
        Along X', Y', Z', metres.
    chips : LengthSigma
        Of the height of each line CCD above the assembly, which no shim can change, metres.
    """

    rotate: AngleSigmas
    shift: LengthSigmas
    chips: LengthSigma = 0.0


class FocusTestSpec(CameraUnderTestSpec):
    """A focal-plane alignment.

    Attributes
    ----------
    name : Name
        As the file is called.
    description : Text
        For people.
    camera
        Prescription, by name or path.
    as_built
        How it departs from the prescription, ``M1`` ... or ``focal_plane`` -> perturbation as in a job.
    collimator : CollimatorSpec
        What the camera looks into.
    edge : EdgeSpec
        The target.
    fields : tuple[Share, ...]
        Where along the line it is imaged, as shares of half the line's length, -1 to 1.
    white : Light
        Signal of the bright side, as a share of the full well.
    frames : Frames
        Images of each position of the target that are averaged.
    scan : ScanSpec
        How the target is moved.
    misset : MissetSpec
        How the assembly stands at the beginning.
    mount : MountSpec
        How it is mounted.
    level : AngleSigma
        Standard deviation of the theodolite's reading of the line's level, radians.
    rounds : Whole
        Of shimming.
    seed : Seed
        Of everything that is drawn.
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
    level: AngleSigma
    rounds: Annotated[Whole, Field(ge=1, le=10)] = 1
    seed: Seed = 1

    @model_validator(mode="after")
    def _scan_has_steps(self) -> "FocusTestSpec":
        if 2.0 * self.scan.reach < 5.0 * self.scan.step:
            found = f"{format_quantity(self.scan.step, LENGTH)} over +-{format_quantity(self.scan.reach, LENGTH)}"
            raise Problem("fewer than six positions through focus", found, "a smaller step", within=("scan", "step"))
        if len(set(self.fields)) < len(self.fields):
            raise Problem("a field is given twice", str(list(self.fields)), "different fields", within=("fields",))
        return self


class DistortionTestSpec(CameraUnderTestSpec):
    """The camera on a turntable looks at a pinhole in the collimator, point by point along its line.

    Attributes
    ----------
    name : Name
        As the file is called.
    description : Text
        For people.
    camera
        Prescription, by name or path.
    as_built
        How it departs from the prescription, ``M1`` ... or ``focal_plane`` -> perturbation as in a job.
    collimator : CollimatorSpec
        What the camera looks into.
    turntable : Ref
        Its dividing error and calibration, by name or path.
    pinhole : PositiveLength
        Diameter of the target, metres.
    band : Name
        Whose line CCD is measured.
    points : Whole
        Over the field.
    reach : Number
        Of the first and last point, as a share of half the line's length.
    sets : Whole
        How often all points are measured.
    light : Light
        Of the brightest pixel, as a share of the full well.
    frames : Frames
        Images of each point that are averaged.
    window : Whole
        Side of the square region around the spot, pixels.
    zero : AngleSigma
        Standard deviation with which the middle of the line is put on the collimator's axis at the turntable's middle
        angle, radians.
    axis_tilt : AngleSigma
        Standard deviation of the turntable's axis against the camera's X, radians.
    setting : AngleSigma
        Standard deviation with which the table stops at a wanted reading, radians.
    seed : Seed
        Of everything that is drawn.
    """

    name: Name
    description: Text = ""
    collimator: CollimatorSpec
    turntable: Ref
    pinhole: PositiveLength
    band: Name
    points: Annotated[Whole, Field(ge=3, le=1001)]
    reach: Annotated[Number, Field(ge=0.05, lt=1.0)]
    sets: Annotated[Whole, Field(ge=1, le=1000)]
    light: Light
    frames: Frames = 4
    window: Annotated[Whole, Field(ge=24, le=128)] = 32
    zero: AngleSigma
    axis_tilt: AngleSigma
    setting: AngleSigma = 0.0
    seed: Seed = 1


NotNegative = Annotated[Number, Field(ge=0.0, le=1e9)]
Positive = Annotated[Number, Field(gt=0.0, le=1e9)]


class LineSpec(Spec):
    """A line CCD whose spots are given in pixels.

    Attributes
    ----------
    pitch : PositiveLength
        Of its pixels, metres.
    middle : Number
        Column of the line's middle, where positions count from; the centre of the first pixel is 0.
    """

    pitch: PositiveLength
    middle: Annotated[Number, Field(ge=0.0, le=1e7)]


class DistortionFiles(Spec):
    """Angles and spots of a camera on a turntable.

    Attributes
    ----------
    spots : Reference
        Table of readings of the turntable and places of the spot on the line, a CSV file.
    zero : TableAngle
        Reading at which the middle of the line is imaged, as near as it is known, radians; the fit finds its error.
    line : LineSpec | None
        Pixels of the line, for a table whose places are columns; none for one of lengths.
    reversed : bool
        Readings of the turntable rise where places on the line fall.
    turntable : TurntableFiles | None
        Calibration of the turntable; without it angles count as read.
    angle_sigma : AngleSigma | None
        Without a calibration: standard deviation of the error of each point's angle, independent from point to point
        and the same in all sets, radians.
    """

    spots: Reference
    zero: TableAngle
    line: LineSpec | None = None
    reversed: bool = False
    turntable: TurntableFiles | None = None
    angle_sigma: AngleSigma | None = None

    @model_validator(mode="after")
    def _one_source_of_sigmas(self) -> "DistortionFiles":
        problem = "how good the angles are is told in one way"
        one_given(self, ("turntable", "angle_sigma"), problem, "turntable: or angle_sigma:")
        return self


class MeasuredDistortionSpec(TitledSpec):
    """The distortion test on measured angles and spots.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    principal_distance : PositiveLength
        Of the camera, about, metres; it serves to see the scatter between sets.
    measured : DistortionFiles
        The angles and spots.
    seed : Seed
        Of nothing; the fits of the turntable that compete here draw nothing.
    """

    principal_distance: PositiveLength
    measured: DistortionFiles
    seed: Seed = 1


class NoiseSpec(Spec):
    """Noise of the detector that took images, as a data sheet of EMVA 1288 has it.

    Attributes
    ----------
    gain_dn_per_e : Positive
        Grey values per electron.
    dark_noise_e : NotNegative
        Read noise, electrons rms.
    dark_signal_e : NotNegative
        Dark signal of one exposure, electrons.
    offset_dn : NotNegative
        Black level, grey values.
    prnu : Number
        Non-uniformity of the response, share rms.
    dsnu_e : NotNegative
        Non-uniformity of the dark signal, electrons rms.
    saturation_dn : Positive
        Grey value from which the response is not linear.
    """

    gain_dn_per_e: Positive
    dark_noise_e: NotNegative
    dark_signal_e: NotNegative = 0.0
    offset_dn: NotNegative = 0.0
    prnu: Annotated[Number, Field(ge=0.0, le=1.0)] = 0.0
    dsnu_e: NotNegative = 0.0
    saturation_dn: Positive


class LevelSpec(Spec):
    """The line's level as a theodolite read it.

    Attributes
    ----------
    angle : Angle
        Of the line out of the direction it is to have, about Z', radians.
    sigma : AngleSigma
        Its standard deviation, radians.
    """

    angle: Angle
    sigma: AngleSigma


class FocusFiles(Spec):
    """A through-focus series of many places.

    Attributes
    ----------
    mtf : Reference | None
        Table of MTF values with sigmas, a CSV file; or
    images : Reference | None
        Table of images of a slanted knife edge, a CSV file.
    moved : Literal['image', 'target', 'focal_plane']
        What was moved through focus. ``image``: shifts are those of the image along the light; ``target``: of the
        target along the light; ``focal_plane``: of the CCD along the light.
    per_shift : Number | None
        With ``target``: move of the image per move of the target, (f of the camera / f of the collimator)^2; a column
        `per shift` of the table overrides it.
    frequency : Number
        Of the MTF that is measured in images, cycles per pixel.
    noise : dict[Name, NoiseSpec]
        With images: name of a band -> its detector; a band without one has its noise estimated from the image.
    level : LevelSpec | None
        Of the line; without it the turn about Z' is left as it is.
    """

    mtf: Reference | None = None
    images: Reference | None = None
    moved: Literal["image", "target", "focal_plane"]
    per_shift: Annotated[Number, Field(gt=0.0, le=1e6)] | None = None
    frequency: Annotated[Number, Field(ge=0.01, le=0.75)] = 0.5
    noise: Annotated[dict[Name, NoiseSpec], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)
    level: LevelSpec | None = None

    @model_validator(mode="after")
    def _one_table(self) -> "FocusFiles":
        one_given(self, ("mtf", "images"), "one table is needed", "mtf: or images:")
        if self.noise and self.images is None:
            problem = "sigmas of MTF values stand in their table"
            raise Problem(problem, "noise", "images: in place of mtf:", within=("noise",))
        if self.per_shift is not None and self.moved != "target":
            problem = "only a target's move is another than the image's"
            raise Problem(problem, allowed="moved: target", within=("per_shift",))
        return self


class MeasuredFocusSpec(TitledSpec):
    """A focal-plane alignment from a measured through-focus series.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    measured : FocusFiles
        The series.
    mount : MountSpec
        How the assembly is mounted.
    shims : tuple[PositiveLength, ...] | None
        Thickness of each hole's shim now, metres; by default all are as thick as `mount` says.
    vertex_error : LengthSigma
        Error that the form of the through-focus curve leaves in all vertices alike, metres; its default is that of F/8
        to F/10 and wavefronts of 0.2 waves.
    vertex_trend : LengthSigma
        By how much that error changes from the middle to the ends of the places, metres.
    seed : Seed
        Of nothing; nothing is drawn.
    """

    measured: FocusFiles
    mount: MountSpec
    shims: tuple[PositiveLength, ...] | None = None
    vertex_error: LengthSigma = 0.5e-6
    vertex_trend: LengthSigma = 0.15e-6
    seed: Seed = 1

    @model_validator(mode="after")
    def _shim_for_each_hole(self) -> "MeasuredFocusSpec":
        if self.shims is not None and len(self.shims) != len(self.mount.holes):
            found, allowed = f"{len(self.shims)} of them", f"{len(self.mount.holes)}, one for each hole"
            raise Problem("another number of shims than of holes", found, allowed, within=("shims",))
        return self
