"""A search for jitter in what the lines of a camera saw one after the other, simulated, as files in scenes/orbit give
it.
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.angle import LightEffectsSpec, Moment, TerrainHeight
from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, ErrorsSpec, Frequency, OrbitSpec, PayloadTestSpec
from scenes.specs.orbit.scene import LineTime
from scenes.yaml.errors import Problem, names_text
from scenes.yaml.spec import Name, Number, Seed, Spec, Whole
from scenes.yaml.unit_fields import AngleSigma, Quantity
from scenes.yaml.units import FREQUENCY, LENGTH, TIME, format_quantity

HeightSigma = Annotated[float, Quantity(LENGTH, smallest="0.001 m", largest="10 km")]
Axis = Literal["roll", "pitch", "yaw"]
AXES: tuple[Axis, ...] = ("roll", "pitch", "yaw")


def _some_lines(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
    if names is not None and (len(names) < 2 or len(set(names)) < len(names)):
        raise Problem("no two lines, or one twice", names_text(names) or "none", "two lines or more, each once")
    return names


def _some_axes(names: tuple[Axis, ...]) -> tuple[Axis, ...]:
    if not names or len(set(names)) < len(names):
        raise Problem("no axis, or one twice", names_text(names) or "none", "roll, pitch, yaw, each once at most")
    return names


Axes = Annotated[tuple[Axis, ...], AfterValidator(_some_axes)]
SomeLines = Annotated[tuple[Name, ...] | None, AfterValidator(_some_lines)]


class SplineSpec(Spec):
    """The attitude over time as a cubic spline, for jitter that is no lines.

    Attributes
    ----------
    interval : float
        Of its knots, seconds.
    sigma : AngleSigma
        Standard deviation of a coefficient before the observations, radians.
    """

    interval: Annotated[float, Quantity(TIME, above_zero=True, largest="100 s")]
    sigma: Annotated[AngleSigma, Field(gt=0.0)]


class JitterSearchSpec(Spec):
    """How jitter is sought.

    Attributes
    ----------
    lowest, highest : Frequency
        Frequencies, hertz.
    axes : Axes
        Of the body about which it is sought.
    false_alarm : Number
        Probability of finding any where there is none, over all frequencies together.
    trend : Whole
        Degree in time of what changes slowly, of each line by itself.
    interior : Whole
        Degree along each line of what is wrong with its interior orientation.
    height : TerrainHeight
        Of tie points, above the ellipsoid, metres.
    height_sigma : HeightSigma
        How wrong that may be, metres.
    spline : SplineSpec | None
        None for none.
    """

    lowest: Frequency = 0.1
    highest: Frequency
    axes: Axes = ("roll", "pitch")
    false_alarm: Annotated[Number, Field(ge=1e-9, le=0.5)] = 1e-3
    trend: Annotated[Whole, Field(ge=0, le=8)] = 2
    interior: Annotated[Whole, Field(ge=0, le=6)] = 3
    height: TerrainHeight = 0.0
    height_sigma: HeightSigma = 100.0
    spline: SplineSpec | None = None

    @model_validator(mode="after")
    def _looks_somewhere(self) -> "JitterSearchSpec":
        if not self.lowest < self.highest:
            found = f"{format_quantity(self.lowest, FREQUENCY)} to {format_quantity(self.highest, FREQUENCY)}"
            raise Problem("no frequencies to look at", found, "`highest` above `lowest`", within=("highest",))
        return self


PointNoise = Annotated[Number, Field(gt=0.0, le=10.0)]


class BandPointsSpec(Spec):
    """Places that all lines see.

    Attributes
    ----------
    count : Whole
        How many.
    duration : float
        Of the strip that they are spread over, seconds of flight.
    noise : PointNoise
        Standard deviation of an image coordinate, pixels, independent from line to line.
    line_noise : dict[Name, PointNoise]
        Line -> its standard deviation where it differs from `noise`, which the measurements state of all.
    rows : float | None
        Interval of the rows that the places lie on, seconds of flight; None for places anywhere.
    row_spread : float
        Standard deviation of a place's moment about its row, seconds.
    height : TerrainHeight
        Mean height of the ground, metres.
    relief : float
        Heights are even between height - relief and height + relief, metres.
    wrong : Number
        Share of image points that lie somewhere else within 20 pixels.
    """

    count: Annotated[Whole, Field(ge=30, le=20_000)] = 1000
    duration: Annotated[float, Quantity(TIME, above_zero=True, largest="1000 s")]
    noise: PointNoise = 0.1
    line_noise: Annotated[dict[Name, PointNoise], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)
    rows: Annotated[float, Quantity(TIME, above_zero=True, largest="1000 s")] | None = None
    row_spread: Annotated[float, Quantity(TIME, smallest="0 s", largest="10 s")] = 0.0
    height: TerrainHeight = 0.0
    relief: Annotated[float, Quantity(LENGTH, smallest="0 m", largest="5 km")] = 0.0
    wrong: Annotated[Number, Field(ge=0.0, le=0.4)] = 0.0


class OrbitJitterSpec(PayloadTestSpec):
    """A pass whose jitter is sought in places that several lines saw.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file.
    lines : SomeLines
        That are used, by name; None for all.
    earth : EarthSpec
        Its rotation.
    orbit : OrbitSpec
        True orbit.
    attitude : AttitudeSpec
        True attitude, with its jitter.
    effects : LightEffectsSpec
        What happens to the light between ground and camera.
    line_time : LineTime
        From one image line to the next, seconds.
    time : Moment
        Middle of the strip, seconds from the orbit's epoch.
    points : BandPointsSpec
        That are measured.
    errors : ErrorsSpec
        Of what the satellite measures of itself.
    search : JitterSearchSpec
        How jitter is sought.
    seed : Seed
        Of every random number.
    """

    lines: SomeLines = None
    earth: EarthSpec = EarthSpec.model_construct()
    orbit: OrbitSpec
    attitude: AttitudeSpec = AttitudeSpec.model_construct(steering="yaw")
    effects: LightEffectsSpec = LightEffectsSpec.model_construct()
    line_time: LineTime = 0.7e-3
    time: Moment = 0.0
    points: BandPointsSpec
    errors: ErrorsSpec = ErrorsSpec.model_construct()
    search: JitterSearchSpec
    seed: Seed = 0

    @model_validator(mode="after")
    def _is_in_the_orbit(self) -> "OrbitJitterSpec":
        for end in (self.time - 0.5 * self.points.duration, self.time + 0.5 * self.points.duration):
            if wrong := self.orbit.misses(end):
                raise wrong.below("time")
        return self
