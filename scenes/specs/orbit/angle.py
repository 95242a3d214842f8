"""Intersection angles in orbit from ground points (paper 000, Liu and Huang 2014), as in a file of scenes/orbit."""

from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, OrbitSpec, PayloadTestSpec
from scenes.specs.perturbation import PlainPerturbationSpec
from scenes.yaml.errors import Problem
from scenes.yaml.spec import Flag, Name, Named, Number, Paths, Seed, Spec, Whole, short_for
from scenes.yaml.unit_fields import Quantity, Vector, Wavelength
from scenes.yaml.units import DISTANCE, LENGTH, MOMENT

LINES = ("forward", "nadir", "backward")
"""Names of the lines of a three-line camera."""
LEAST_POINTS = 3

Moment = Annotated[float, Quantity(MOMENT, largest="240 h")]
GroundSigma = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 km")]
DatumShift = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, largest="1 km"))]
TerrainHeight = Annotated[float, Quantity(LENGTH, smallest="-500 m", largest="9 km")]
Relief = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="2 km")]
Points = Annotated[Whole, Field(le=2000)]
Passes = Annotated[Whole, Field(ge=2, le=5000)]


Change = Annotated[PlainPerturbationSpec, short_for("rotate", list)]
"""Perturbation of a body or line; a list `[1 arcsec, 4 arcsec, -3 arcsec]` means a rotation."""


def _angles(angles: Mapping[str, tuple[str, str]] | None) -> Mapping[str, tuple[str, str]] | None:
    if angles is not None and not angles:
        raise Problem("no angles", "an empty mapping", "alpha: [forward, nadir], or no key for the default angles")
    for name, (first, second) in (angles or {}).items():
        if first == second:
            problem = "an angle needs two different lines"
            raise Problem(problem, f"{first} twice", "two different lines", within=(name,))
    return angles


Angles = Annotated[Named[tuple[Name, Name]] | None, AfterValidator(_angles)]


def usual_angles(lines: Sequence[str]) -> Mapping[str, tuple[str, str]] | None:
    """Return the two lines of each default intersection angle, by its name; None for cameras without defaults.

    Cameras with the lines forward, nadir and backward, and cameras with two lines, have defaults.
    """
    if set(LINES) <= set(lines):
        return {"alpha": LINES[:2], "beta": LINES[1:]}
    return {"alpha": (lines[0], lines[1])} if len(lines) == 2 else None


def check_ends(first: float, last: float, problem: str) -> None:
    """Raise `Problem` if the first pixel of a part of a line is not before the last one."""
    if not first < last:
        raise Problem(problem, f"first {first:g}, last {last:g}", "a last pixel after the first", within=("last",))


class StripsSpec(Spec):
    """Strips of ground points on the footprint of each line at the moment of exposure, evenly spaced along the line.

    Positions are pixels, counted from 0, of the camera's standard line: one with the payload's number of pixels, or an
    instrument's first line. On a line with more or fewer pixels they are scaled to its length.

    Attributes
    ----------
    points : int
        Number of points on each strip, at least three.
    first : float
        Position of the first point on the line, in pixels.
    last : float
        Position of the last point on the line, in pixels.
    """

    points: Points
    first: Number
    last: Number

    @model_validator(mode="after")
    def _is_a_strip(self) -> "StripsSpec":
        if self.points < LEAST_POINTS:
            allowed = f"{LEAST_POINTS} or more; paper 000 asks for n >= {LEAST_POINTS}"
            problem = "too few points to fit a plane"
            raise Problem(problem, f"{self.points} on each strip", allowed, within=("points",))
        check_ends(self.first, self.last, "the strip has no length")
        return self


class TerrainSpec(Spec):
    """Heights of the ground points above the ellipsoid.

    Attributes
    ----------
    height : float
        Mean height above the ellipsoid, in metres.
    relief : float
        Standard deviation of the heights about the mean, in metres.
    length : float
        Correlation length of the heights along the strip, in metres: their correlation at a distance is
        exp(-(distance/length)^2/2).
    """

    height: TerrainHeight = 0.0
    relief: Relief = 0.0
    length: Annotated[float, Quantity(DISTANCE, smallest="10 m", largest="1000 km")] = 5e3


class LightEffectsSpec(Spec):
    """Effects on the light path between ground and camera.

    Attributes
    ----------
    light_time : bool
        True to include the Earth's rotation during the light travel time.
    aberration : bool
        True to include aberration by the satellite's velocity.
    refraction : bool
        True to include refraction by the standard atmosphere.
    wavelength : float
        Vacuum wavelength for the refraction, in metres.
    """

    light_time: Flag = True
    aberration: Flag = True
    refraction: Flag = True
    wavelength: Wavelength = 650e-9


class EffectsSpec(LightEffectsSpec):
    """Effects on the light path between ground and camera, and their correction in the analysis.

    Attributes
    ----------
    corrected : bool
        True if the analysis corrects the included effects by its models of them.
    """

    corrected: Flag = True


class AngleErrorsSpec(Spec):
    """Measurement errors of the satellite's position and of the ground points.

    Attributes
    ----------
    station : float
        Standard deviation of each coordinate of the measured satellite position, in metres.
    points : float
        Standard deviation of each coordinate of a ground point, matching and aerial triangulation together, in metres.
    datum : tuple[float, float, float]
        Common shift of all ground points to the east, north and up, unknown to the analysis, in metres.
    """

    station: GroundSigma = 0.5
    points: GroundSigma = 1.5
    datum: DatumShift = (0.0, 0.0, 0.0)


class OrbitAngleSpec(PayloadTestSpec):
    """Measurement of the intersection angles of a camera with two or more lines from ground points of one moment.

    Attributes
    ----------
    camera
        Name in scenes/library/payloads or scenes/library/instruments, or path of such a file. The lines of a payload
        are ideal projections; those of an instrument are ray-traced, one for each of its cameras.
    angles : Mapping[str, tuple[str, str]] | None
        Name -> the two lines between which the angle lies; by default alpha [forward, nadir] and beta [nadir, backward]
        if the camera has these lines, or alpha between the lines of a camera with two.
    perturb : Mapping[str, PlainPerturbationSpec]
        Change since the laboratory, unknown to the analysis: for a payload line -> rotation vector in body axes, for an
        instrument node path -> perturbation as in a job.
    earth : EarthSpec
        Earth rotation.
    orbit : OrbitSpec
        True orbit.
    attitude : AttitudeSpec
        True attitude.
    time : float
        Time of exposure from the orbit's epoch, in seconds.
    strips : StripsSpec
        Positions of the ground points on the lines.
    terrain : TerrainSpec
        Heights of the ground points.
    effects : EffectsSpec
        Effects on the light path.
    errors : AngleErrorsSpec
        Measurement errors of the satellite's position and of the ground points.
    passes : int
        Number of repetitions with new random errors, from which the scatter of the angles is computed.
    seed : int
        Seed of all random numbers.
    """

    angles: Angles = None
    perturb: Paths[Change] = Field(default_factory=dict, validate_default=True)
    earth: EarthSpec = EarthSpec.model_construct()
    orbit: OrbitSpec
    attitude: AttitudeSpec = AttitudeSpec.model_construct()
    time: Moment = 0.0
    strips: StripsSpec
    terrain: TerrainSpec = TerrainSpec.model_construct()
    effects: EffectsSpec = EffectsSpec.model_construct()
    errors: AngleErrorsSpec = AngleErrorsSpec.model_construct()
    passes: Passes = 200
    seed: Seed = 0

    @model_validator(mode="after")
    def _is_in_the_orbit(self) -> "OrbitAngleSpec":
        if wrong := self.orbit.misses(self.time):
            raise wrong.below("time")
        return self
