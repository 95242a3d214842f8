"""The laboratory's collimator and the tests of a camera in front of it: focal-plane alignment, interior orientation."""

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.frozen_map import FrozenMap
from optics.targets.collimator import Collimator
from scenes.specs.course import Term, noll
from scenes.specs.instrument import Frames
from scenes.specs.job import FigureTerm, PlainPerturbationSpec
from scenes.yaml.errors import Problem
from scenes.yaml.quantity import PositiveLength, Quantity, Vector, Vector3
from scenes.yaml.spec import Name, Number, Paths, Reference, Seed, Spec, Text, Whole
from scenes.yaml.units import ANGLE, LENGTH, SCALE, format_quantity


class CollimatorSpec(Spec):
    """A long collimator with its target at the focus.

    Attributes:
        focal_length: metres.
        aperture: diameter, metres.
        wavefront: its error over the aperture by Zernike terms, Noll's numbering, metres rms.
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

    Attributes:
        camera: prescription, by name or path.
        as_built: how it departs from the prescription: ``M1``, ``M2`` ... or ``focal_plane`` -> perturbation, as in a
            job; figures of mirrors for the most part.
    """

    camera: Reference
    as_built: Paths[PlainPerturbationSpec] = Field(default_factory=FrozenMap)

    @model_validator(mode="after")
    def _cold(self) -> "CameraUnderTestSpec":
        for path, what in self.as_built.items():
            if "temperature" in what.uses():
                raise Problem(
                    "temperatures are not modelled in the laboratory",
                    "temperature",
                    "rotate, shift, scale or figure",
                    within=("as_built", path, "temperature"),
                )
        return self


EdgeAngle = Annotated[float, Quantity(ANGLE, smallest="2 deg", largest="15 deg")]
Tilt = Annotated[float, Quantity(ANGLE, largest="30 deg")]
AngleSigma = Annotated[float, Quantity(ANGLE, smallest="0 arcsec", largest="1 deg")]
AngleSigmas = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, smallest="0 arcsec", largest="1 deg"))]
LengthSigma = Annotated[float, Quantity(LENGTH, smallest="0 um", largest="5 mm")]
LengthSigmas = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, smallest="0 um", largest="5 mm"))]
Light = Annotated[float, Quantity(SCALE, smallest="0.1 percent", largest="150 percent")]
Share = Annotated[Number, Field(ge=-1.0, le=1.0)]


class EdgeSpec(Spec):
    """The slanted knife edge, turned to measure along the line and along the track.

    Attributes:
        angle: between the edge and the pixel columns or rows, radians.
        region: side of the square region around it that is analysed, pixels.
    """

    angle: EdgeAngle
    region: Annotated[Whole, Field(ge=32, le=512)] = 64


class ScanSpec(Spec):
    """How the target is moved through focus; lengths are those by which the image moves.

    Attributes:
        reach: the first scan goes from -reach to +reach, metres.
        step: of the first scan, metres.
        points: of the second scan, about the peak that the first one found; fewer than seven would leave no room for an
            error of the first.
        depth: half width of the second scan as a share of the defocus at which geometric blur takes all contrast at the
            Nyquist frequency.
    """

    reach: PositiveLength
    step: PositiveLength
    points: Annotated[Whole, Field(ge=7, le=101)] = 9
    depth: Annotated[Number, Field(ge=0.2, le=1.5)] = 0.6


class MountSpec(Spec):
    """How the focal-plane assembly is screwed to its mounting surface.

    Attributes:
        holes: their places in the assembly's frame O'-X'Y'Z', metres.
        tilt: of the mounting surface's normal from Z', about Y', radians.
        clearance: by which the screws leave each hole free to slide, metres.
        thickness: of the shims before the work, metres.
        step: to which the workshop grinds a shim, metres.
    """

    holes: Annotated[tuple[Vector3, ...], Field(min_length=3)]
    tilt: Tilt = 0.0
    clearance: PositiveLength
    thickness: PositiveLength
    step: PositiveLength


class MissetSpec(Spec):
    """Standard deviations of how the focal-plane assembly stands at the beginning, against the optics.

    Attributes:
        rotate: about X', Y', Z' through the middle of the panchromatic line, radians.
        shift: along X', Y', Z', metres.
        chips: of the height of each line CCD above the assembly, which no shim can change, metres.
    """

    rotate: AngleSigmas
    shift: LengthSigmas
    chips: LengthSigma = 0.0


class FocusTestSpec(CameraUnderTestSpec):
    """A focal-plane alignment.

    Attributes:
        name: as the file is called.
        description: for people.
        camera: prescription, by name or path.
        as_built: how it departs from the prescription, ``M1`` ... or ``focal_plane`` -> perturbation as in a job.
        collimator: what the camera looks into.
        edge: the target.
        fields: where along the line it is imaged, as shares of half the line's length, -1 to 1.
        white: signal of the bright side, as a share of the full well.
        frames: images of each position of the target that are averaged.
        scan: how the target is moved.
        misset: how the assembly stands at the beginning.
        mount: how it is mounted.
        level: standard deviation of the theodolite's reading of the line's level, radians.
        rounds: of shimming.
        seed: of everything that is drawn.
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

    Attributes:
        name: as the file is called.
        description: for people.
        camera: prescription, by name or path.
        as_built: how it departs from the prescription, ``M1`` ... or ``focal_plane`` -> perturbation as in a job.
        collimator: what the camera looks into.
        turntable: its dividing error and calibration, by name or path.
        pinhole: diameter of the target, metres.
        band: whose line CCD is measured.
        points: over the field.
        reach: of the first and last point, as a share of half the line's length.
        sets: how often all points are measured.
        light: of the brightest pixel, as a share of the full well.
        frames: images of each point that are averaged.
        window: side of the square region around the spot, pixels.
        zero: standard deviation with which the middle of the line is put on the collimator's axis at the turntable's
            middle angle, radians.
        axis_tilt: standard deviation of the turntable's axis against the camera's X, radians.
        setting: standard deviation with which the table stops at a wanted reading, radians.
        seed: of everything that is drawn.
    """

    name: Name
    description: Text = ""
    collimator: CollimatorSpec
    turntable: Reference
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
