"""Search for jitter in a simulated pass.

Several lines of a camera image the same ground one after the other; jitter shows in the differences of their images.
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


def _require_lines(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
    if names is not None and (len(names) < 2 or len(set(names)) < len(names)):
        raise Problem("too few lines, or a repeated line", names_text(names) or "none", "two lines or more, each once")
    return names


def _require_axes(names: tuple[Axis, ...]) -> tuple[Axis, ...]:
    if not names or len(set(names)) < len(names):
        raise Problem("no axis, or a repeated axis", names_text(names) or "none", "roll, pitch, yaw, each once at most")
    return names


Axes = Annotated[tuple[Axis, ...], AfterValidator(_require_axes)]
LineNames = Annotated[tuple[Name, ...] | None, AfterValidator(_require_lines)]


class SplineSpec(Spec):
    """Attitude over time as a cubic spline, for jitter without spectral lines.

    Attributes
    ----------
    interval : float
        Interval of the knots, in seconds.
    sigma : float
        Prior standard deviation of a coefficient, in radians.
    """

    interval: Annotated[float, Quantity(TIME, above_zero=True, largest="100 s")]
    sigma: Annotated[AngleSigma, Field(gt=0.0)]


class JitterSearchSpec(Spec):
    """Settings of the search for jitter.

    Attributes
    ----------
    lowest : float
        Lowest frequency of the search, in hertz.
    highest : float
        Highest frequency of the search, in hertz.
    axes : tuple[{'roll', 'pitch', 'yaw'}, ...]
        Body axes about which jitter is searched.
    false_alarm : float
        Probability of reporting jitter if there is none, over all frequencies together.
    trend : int
        Degree of the polynomial in time that represents slow changes, for each line separately.
    interior : int
        Degree of the polynomial along each line that represents errors of its interior orientation.
    height : float
        Height of tie points above the ellipsoid, in metres.
    height_sigma : float
        Standard deviation of that height, in metres.
    spline : SplineSpec | None
        Attitude as a spline; by default there is none.
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
            value = f"{format_quantity(self.lowest, FREQUENCY)} to {format_quantity(self.highest, FREQUENCY)}"
            raise Problem("the range of frequencies is empty", value, "`highest` above `lowest`", within=("highest",))
        return self


PointNoise = Annotated[Number, Field(gt=0.0, le=10.0)]


class BandPointsSpec(Spec):
    """Ground points that all lines observe.

    Attributes
    ----------
    count : int
        Number of points.
    duration : float
        Duration of the flight over the strip with the points, in seconds.
    noise : float
        Standard deviation of an image coordinate, independent from line to line, in pixels.
    line_noise : dict[str, float]
        Line -> true standard deviation, in pixels, where it differs from `noise`, which the analysis assumes for all
        lines.
    rows : float | None
        Time of flight between the rows across the track on which the points lie, in seconds; by default they lie
        anywhere.
    row_spread : float
        Standard deviation of a point's time about its row, in seconds.
    height : float
        Mean height of the ground, in metres.
    relief : float
        Half range of the heights, which are uniformly distributed about the mean, in metres.
    wrong : float
        Fraction of image points with gross errors of up to 20 pixels.
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
    """Search for jitter in a simulated pass, by ground points that several lines observed.

    Attributes
    ----------
    lines : tuple[str, ...] | None
        Names of the lines that are used; by default all.
    earth : EarthSpec
        Earth rotation.
    orbit : OrbitSpec
        True orbit.
    attitude : AttitudeSpec
        True attitude with its jitter.
    effects : LightEffectsSpec
        Effects on the light path between ground and camera.
    line_time : float
        Time from one image line to the next, in seconds.
    time : float
        Time of the strip's middle from the orbit's epoch, in seconds.
    points : BandPointsSpec
        Ground points that all lines observe, and their noise.
    errors : ErrorsSpec
        Errors of the satellite's orbit and attitude measurements.
    search : JitterSearchSpec
        Settings of the search: frequencies, axes, false-alarm probability and models.
    seed : int
        Seed of all random numbers.
    """

    lines: LineNames = None
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
