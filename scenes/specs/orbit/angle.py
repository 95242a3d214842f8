"""The intersection angle in orbit from ground points (paper 000), as a file in scenes/orbit gives it."""

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
"""Lines of a three-line camera."""
LEAST_POINTS = 3

Moment = Annotated[float, Quantity(MOMENT, largest="240 h")]
GroundSigma = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 km")]
DatumShift = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, largest="1 km"))]
TerrainHeight = Annotated[float, Quantity(LENGTH, smallest="-500 m", largest="9 km")]
Relief = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="2 km")]
Points = Annotated[Whole, Field(le=2000)]
Passes = Annotated[Whole, Field(ge=2, le=5000)]


Change = Annotated[PlainPerturbationSpec, short_for("rotate", list)]
"""A perturbation; `[1 arcsec, 4 arcsec, -3 arcsec]` means a rotation."""


def _angles(angles: Mapping[str, tuple[str, str]] | None) -> Mapping[str, tuple[str, str]] | None:
    if angles is not None and not angles:
        raise Problem("no angles", "an empty mapping", "alpha: [forward, nadir], or nothing for the usual ones")
    for name, (first, second) in (angles or {}).items():
        if first == second:
            problem = "a line makes no angle with itself"
            raise Problem(problem, f"{first} twice", "two different lines", within=(name,))
    return angles


Angles = Annotated[Named[tuple[Name, Name]] | None, AfterValidator(_angles)]


def usual_angles(lines: Sequence[str]) -> Mapping[str, tuple[str, str]] | None:
    """Angles of a camera whose test names none: those of three lines, or that of a camera of two; None for others."""
    if set(LINES) <= set(lines):
        return {"alpha": LINES[:2], "beta": LINES[1:]}
    return {"alpha": (lines[0], lines[1])} if len(lines) == 2 else None


def check_ends(first: float, last: float, problem: str) -> None:
    """Refuse a piece of a line, from one pixel to another, that has no length."""
    if not first < last:
        raise Problem(problem, f"first {first:g}, last {last:g}", "a last pixel after the first", within=("last",))


class StripsSpec(Spec):
    """Ground points on what each line sees at the moment of exposure, evenly spaced along the line.

    Places are pixels, counted from 0, of the camera's usual line: one with the payload's own number of pixels, or an
    instrument's first line. On a line with more or fewer pixels they stand at the same share of its length.

    Attributes
    ----------
    points : Points
        On each strip, three or more.
    first : Number
        Place of the first point on the line.
    last : Number
        Place of the last point.
    """

    points: Points
    first: Number
    last: Number

    @model_validator(mode="after")
    def _is_a_strip(self) -> "StripsSpec":
        if self.points < LEAST_POINTS:
            found = f"{self.points} on each strip"
            allowed = f"{LEAST_POINTS} or more; paper 000 asks for n >= {LEAST_POINTS}"
            problem = "too few points to fit a plane"
            raise Problem(problem, found, allowed, within=("points",))
        check_ends(self.first, self.last, "the strip has no length")
        return self


class TerrainSpec(Spec):
    """Heights of the ground points above the ellipsoid.

    Attributes
    ----------
    height : TerrainHeight
        Mean, metres.
    relief : Relief
        Standard deviation about it, metres.
    length : float
        Along the strip over which heights are alike (correlation exp(-(distance/length)^2/2)), metres.
    """

    height: TerrainHeight = 0.0
    relief: Relief = 0.0
    length: Annotated[float, Quantity(DISTANCE, smallest="10 m", largest="1000 km")] = 5e3


class LightEffectsSpec(Spec):
    """What happens to the light between ground and camera.

    Attributes
    ----------
    light_time : Flag
        The Earth turns while the light is under way.
    aberration : Flag
        The satellite's velocity tilts what it sees.
    refraction : Flag
        The standard atmosphere bends the light.
    wavelength : Wavelength
        In vacuum, for the refraction, metres.
    """

    light_time: Flag = True
    aberration: Flag = True
    refraction: Flag = True
    wavelength: Wavelength = 650e-9


class EffectsSpec(LightEffectsSpec):
    """What happens to the light between ground and camera.

    Attributes
    ----------
    light_time
        The Earth turns while the light is under way.
    aberration
        The satellite's velocity tilts what it sees.
    refraction
        The standard atmosphere bends the light.
    wavelength
        In vacuum, for the refraction, metres.
    corrected : Flag
        The analysis takes the effects that are on out of the ground points, by its models of them.
    """

    corrected: Flag = True


class AngleErrorsSpec(Spec):
    """Errors of what is measured.

    Attributes
    ----------
    station : GroundSigma
        Standard deviation of each coordinate of the measured orbit, metres.
    points : GroundSigma
        Standard deviation of each coordinate of a ground point, matching and aerial triangulation together, metres.
    datum : DatumShift
        Shift that all ground points share, east, north and up, unknown to the analysis, metres.
    """

    station: GroundSigma = 0.5
    points: GroundSigma = 1.5
    datum: DatumShift = (0.0, 0.0, 0.0)


class OrbitAngleSpec(PayloadTestSpec):
    """The intersection angles of a camera of two or more lines from one moment's ground points.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or scenes/library/instruments, or path of a file of either sort. The lines of a
        payload are ideal projections, those of an instrument are traced, one for each of its cameras.
    angles : Angles
        Name -> the two lines that the angle lies between; None for alpha [forward, nadir] and beta [nadir, backward]
        where the camera has these lines, or alpha between the lines of a camera that has two.
    perturb : Paths[Change]
        What has changed since the laboratory; the analysis does not know it. For a payload line -> rotation vector in
        body axes, for an instrument node path -> perturbation as in a job.
    earth : EarthSpec
        Its rotation.
    orbit : OrbitSpec
        True orbit.
    attitude : AttitudeSpec
        True attitude.
    time : Moment
        Moment of exposure, seconds from the orbit's epoch.
    strips : StripsSpec
        Where the points lie.
    terrain : TerrainSpec
        Their heights.
    effects : EffectsSpec
        On the light.
    errors : AngleErrorsSpec
        Of the measured station and points.
    passes : Passes
        How often the measurement is repeated with errors drawn anew, for the scatter.
    seed : Seed
        Of every random number.
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
