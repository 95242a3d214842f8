"""The intersection angle in orbit from ground points (paper 000), as a file in scenes/orbit gives it, and with the
camera that it refers to.
"""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from scenes.errors import Problem, names_text, nearest
from scenes.load import LIBRARY, library_names
from scenes.orbit_spec import AttitudeSpec, EarthSpec, OrbitSpec
from scenes.quantity import Quantity, Vector, Wavelength
from scenes.spec import Name, Named, Number, Reference, Seed, Source, Spec, Text, Whole
from scenes.three_line_camera import ORBIT, Misalignment, ThreeLineCameraSpec
from scenes.translate import validate
from scenes.units import DISTANCE, LENGTH, MOMENT, format_quantity
from scenes.yaml_file import dump_yaml, read_yaml

LINES = ("forward", "nadir", "aft")
"""Lines that a camera must have: alpha lies between the first two, beta between the last two."""
LEAST_POINTS = 3

Moment = Annotated[float, Quantity(MOMENT, largest="240 h")]
GroundSigma = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 km")]
DatumShift = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, largest="1 km"))]
TerrainHeight = Annotated[float, Quantity(LENGTH, smallest="-500 m", largest="9 km")]
Relief = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="2 km")]
ReliefLength = Annotated[float, Quantity(DISTANCE, smallest="10 m", largest="1000 km")]
Points = Annotated[Whole, Field(le=2000)]
Passes = Annotated[Whole, Field(ge=2, le=5000)]
Flag = Annotated[bool, Field(strict=True)]


class StripsSpec(Spec):
    """Ground points on what each line sees at the moment of exposure, evenly spaced along the line.

    Attributes:
        points: on each strip, three or more.
        first: place of the first point on the line, counted in pixels from 0.
        last: place of the last point.
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
        if not self.first < self.last:
            found = f"first {self.first:g}, last {self.last:g}"
            raise Problem("the strip has no length", found, "a last pixel after the first", within=("last",))
        return self


class TerrainSpec(Spec):
    """Heights of the ground points above the ellipsoid.

    Attributes:
        height: mean, metres.
        relief: standard deviation about it, metres.
        length: along the strip over which heights are alike (correlation exp(-(distance/length)^2/2)), metres.
    """

    height: TerrainHeight = 0.0
    relief: Relief = 0.0
    length: ReliefLength = 5e3


class EffectsSpec(Spec):
    """What happens to the light between ground and camera.

    Attributes:
        light_time: the Earth turns while the light is under way.
        aberration: the satellite's velocity tilts what it sees.
        refraction: the standard atmosphere bends the light.
        wavelength: in vacuum, for the refraction, metres.
        corrected: the analysis takes the effects that are on out of the ground points, by its models of them.
    """

    light_time: Flag = True
    aberration: Flag = True
    refraction: Flag = True
    wavelength: Wavelength = 650e-9
    corrected: Flag = True


class AngleErrorsSpec(Spec):
    """Errors of what is measured.

    Attributes:
        station: standard deviation of each coordinate of the measured orbit, metres.
        points: standard deviation of each coordinate of a ground point, matching and aerial triangulation together,
            metres.
        datum: shift that all ground points share, east, north and up, unknown to the analysis, metres.
    """

    station: GroundSigma = 0.5
    points: GroundSigma = 1.5
    datum: DatumShift = (0.0, 0.0, 0.0)


class OrbitAngleSpec(Spec):
    """The intersection angles of a three-line camera from one moment's ground points.

    Attributes:
        name: as the file is called.
        description: for people.
        camera: name in scenes/orbit or path of a file, with lines forward, nadir and aft.
        changes: line -> how it has turned since the laboratory, rotation vector in body axes, radians; the analysis
            does not know it.
        earth: its rotation.
        orbit: true orbit.
        attitude: true attitude.
        time: moment of exposure, seconds from the orbit's epoch.
        strips: where the points lie.
        terrain: their heights.
        effects: on the light.
        errors: of the measured station and points.
        passes: how often the measurement is repeated with errors drawn anew, for the scatter.
        seed: of every random number.
    """

    name: Name
    description: Text = ""
    camera: Reference
    changes: Named[Misalignment] = Field(default_factory=dict, validate_default=True)
    earth: EarthSpec = EarthSpec()
    orbit: OrbitSpec
    attitude: AttitudeSpec = AttitudeSpec()
    time: Moment = 0.0
    strips: StripsSpec
    terrain: TerrainSpec = TerrainSpec()
    effects: EffectsSpec = EffectsSpec()
    errors: AngleErrorsSpec = AngleErrorsSpec()
    passes: Passes = 200
    seed: Seed = 0

    @model_validator(mode="after")
    def _is_in_the_orbit(self) -> "OrbitAngleSpec":
        first, last = -self.orbit.before, self.orbit.after
        if not first < self.time < last:
            allowed = f"between {format_quantity(first, MOMENT)} and {format_quantity(last, MOMENT)}, or a longer orbit"
            found = format_quantity(self.time, MOMENT)
            raise Problem("outside the orbit data", found, allowed, within=("time",))
        return self


class AngleSetup(Spec):
    """The test together with its camera, so that one file says all that went into a run.

    Attributes:
        test: what the test's file says.
        camera: the payload.
    """

    test: OrbitAngleSpec
    camera: ThreeLineCameraSpec

    def with_seed(self, seed: int) -> Self:
        """The same with another seed, for one that a command overrides."""
        return self.model_copy(update={"test": self.test.model_copy(update={"seed": seed})})

    def to_yaml(self) -> str:
        """Text of a config.yaml; `resolve_angle` reads it back to the same values."""
        return dump_yaml(self.plain())


def resolve_angle(path: str | Path) -> AngleSetup:
    """Read a test and the camera it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or test and camera do not fit.
    """
    yaml = read_yaml(path)
    if isinstance(yaml.data, dict) and "test" in yaml.data:
        setup = validate(AngleSetup, yaml)
        test = setup.test.with_source(Source(setup.source.file, setup.source.lines, ("test",)))
        setup = setup.model_copy(update={"test": test})
    else:
        test = validate(OrbitAngleSpec, yaml)
        camera = validate(ThreeLineCameraSpec, read_yaml(_camera_file(test)))
        setup = AngleSetup.model_construct(test=test, camera=camera)
    _require_fit(setup.test, setup.camera)
    return setup


def _camera_file(test: OrbitAngleSpec) -> Path:
    text = test.camera
    if "/" in text or text.endswith((".yaml", ".yml")):
        path = Path(test.source.file).parent / text
        if not path.is_file():
            raise test.error(f"no such file: {path}", ("camera",))
        return path
    if text not in library_names(ORBIT):
        # the folder holds tests as well
        every = {name: read_yaml(LIBRARY / ORBIT / f"{name}.yaml").data for name in library_names(ORBIT)}
        names = tuple(name for name, data in every.items() if isinstance(data, dict) and "lines" in data)
        allowed = f"{names_text(names)}, or the path of a .yaml file"
        suggestion = nearest(text, names)
        raise test.error("no such camera", ("camera",), found=text, allowed=allowed, suggestion=suggestion)
    return LIBRARY / ORBIT / f"{text}.yaml"


def _require_fit(test: OrbitAngleSpec, camera: ThreeLineCameraSpec) -> None:
    """InputError unless the camera has the three lines, and the strips and changes lie on them."""
    if missing := [name for name in LINES if name not in camera.lines]:
        found = f"{names_text(tuple(camera.lines))} in {camera.name}"
        problem = f"the camera has no {' and no '.join(missing)} line"
        raise test.error(problem, ("camera",), found=found, allowed="a camera with lines forward, nadir and aft")
    for name in test.changes:
        if name not in LINES:
            raise test.error(
                "no such line", ("changes", name), allowed=names_text(LINES), suggestion=nearest(name, LINES)
            )
    last = camera.pixels - 0.5
    for key in ("first", "last"):
        pixel = getattr(test.strips, key)
        if not -0.5 <= pixel <= last:
            allowed = f"-0.5 to {last:g}, the ends of the lines of {camera.name}"
            raise test.error("outside the line", ("strips", key), found=f"pixel {pixel:g}", allowed=allowed)
