"""Instants in UTC, Earth, orbit, attitude and their errors, as files in scenes/orbit give them.

Body axes are those of a base: X forward, Z toward the scene (down), Y = Z x X (right). Components along body or orbital
axes are written in this order.

Jitter of a satellite's attitude as files in scenes/orbit state it: lines and bands of its spectrum.
"""

import re
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from scenes.yaml.errors import Problem, shown
from scenes.yaml.spec import Number, Ref, Spec, TitledSpec, one_given
from scenes.yaml.unit_fields import AngleSigmas, Quantity, Vector
from scenes.yaml.units import ANGLE, ANGLE_SPECTRUM, DISTANCE, FREQUENCY, LENGTH, MOMENT, SPEED, TIME, format_quantity

Frequency = Annotated[float, Quantity(FREQUENCY, above_zero=True, largest="10 kHz")]
Amplitudes = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, smallest="0 arcsec", largest="0.1 deg"))]
Phases = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="360 deg"), alike=True)]
Levels = Annotated[
    tuple[float, float, float], Vector(Quantity(ANGLE_SPECTRUM, smallest="0 arcsec^2/Hz", largest="1e6 arcsec^2/Hz"))
]


class JitterLineSpec(Spec):
    """An oscillation: amplitude x sin(2 pi frequency x time + phase) about each axis of the body.

    Attributes
    ----------
    frequency : Frequency
        In hertz.
    amplitude : Amplitudes
        About body X, Y and Z (roll, pitch, yaw), half of what it swings from end to end, radians.
    phase : Phases | None
        About each axis, or one for all, radians, time counting from the orbit's epoch; None for random ones.
    """

    frequency: Frequency
    amplitude: Amplitudes
    phase: Phases | None = None


class JitterBandSpec(Spec):
    """A random motion with an even spectrum between two frequencies, Gaussian at every time.

    Attributes
    ----------
    first, last : Frequency
        Ends of the band, hertz.
    level : Levels
        One-sided spectral density about body X, Y and Z, rad^2/Hz; level x (last - first) is the variance.
    """

    first: Frequency
    last: Frequency
    level: Levels

    @model_validator(mode="after")
    def _has_a_width(self) -> "JitterBandSpec":
        if not self.first < self.last:
            found = f"{format_quantity(self.first, FREQUENCY)} to {format_quantity(self.last, FREQUENCY)}"
            raise Problem("the band is empty", found, "`last` above `first`", within=("last",))
        return self


class JitterSpec(Spec):
    """Small fast turns of the body about its own axes, after all else that the attitude says; nothing by default.

    Attributes
    ----------
    lines : tuple[JitterLineSpec, ...]
        oscillations.
    bands : tuple[JitterBandSpec, ...]
        Of noise.
    """

    lines: tuple[JitterLineSpec, ...] = Field(default=(), max_length=100)
    bands: tuple[JitterBandSpec, ...] = Field(default=(), max_length=20)

    @property
    def stated(self) -> bool:
        """Whether there is any."""
        return any(any(line.amplitude) for line in self.lines) or any(any(band.level) for band in self.bands)


FIRST_YEAR, LAST_YEAR = 1972, 2099
"""UTC has whole leap seconds since 1972."""
ALLOWED = f"date and time in UTC, ISO 8601 and ending in Z, {FIRST_YEAR} to {LAST_YEAR}, e.g. '2011-03-05T03:05:00Z'"
PATTERN = r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}(:[0-9]{2}(\.[0-9]{1,6})?)?Z$"


def parse_utc(text: Any) -> str:
    """Check the text of an instant; a value that is written another way than the pattern is refused, also a leap
    second.

    Raises
    ------
    Problem
        No text, another form, without its zone, or no such instant.
    """
    if not isinstance(text, str):
        raise Problem("not a date and time", shown(text), ALLOWED)
    stripped = text.strip()
    if re.fullmatch(PATTERN.replace("Z$", "$"), stripped):
        raise Problem("a date and time without its zone", shown(text), ALLOWED)
    if not re.fullmatch(PATTERN, stripped):
        raise Problem("not a date and time", shown(text), ALLOWED)
    try:
        time = datetime.fromisoformat(stripped).astimezone(UTC)
    except ValueError:
        raise Problem("no such date or time", shown(text), ALLOWED) from None
    if not FIRST_YEAR <= time.year <= LAST_YEAR:
        raise Problem("outside the years of this time scale", shown(text), ALLOWED)
    return stripped


UtcTime = Annotated[
    str,
    BeforeValidator(parse_utc),
    WithJsonSchema(
        {"type": "string", "pattern": PATTERN, "description": ALLOWED, "examples": ["2011-03-05T03:05:00Z"]}
    ),
]
"""An instant in UTC, ISO 8601 text ending in Z."""


Latitude = Annotated[float, Quantity(ANGLE, largest="90 deg")]
Longitude = Annotated[float, Quantity(ANGLE, largest="360 deg")]
Inclination = Annotated[float, Quantity(ANGLE, smallest="0 deg", largest="180 deg")]
Altitude = Annotated[float, Quantity(DISTANCE, smallest="150 km", largest="2000 km")]
Span = Annotated[float, Quantity(MOMENT, smallest="0 s", largest="240 h")]
Interval = Annotated[float, Quantity(TIME, above_zero=True, largest="1000 s")]
AngleErrors = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="1 deg"))]
LengthSigmas = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, smallest="0 m", largest="10 km"))]
SpeedSigmas = Annotated[tuple[float, float, float], Vector(Quantity(SPEED, smallest="0 m/s", largest="100 m/s"))]
Position = Annotated[tuple[float, float, float], Vector(Quantity(DISTANCE, largest="100000 km"))]
Velocity = Annotated[tuple[float, float, float], Vector(Quantity(SPEED, largest="20 km/s"))]

_ZERO = (0.0, 0.0, 0.0)


class EarthSpec(Spec):
    """What is not predicted of the Earth's rotation (IERS bulletins).

    Attributes
    ----------
    ut1_utc : float
        UT1 - UTC at the epoch, seconds.
    polar_motion : tuple[float, float]
        x and y of the pole, radians (x toward Greenwich, y toward 90 degrees west).
    """

    ut1_utc: Annotated[float, Quantity(TIME, largest="0.9 s")] = 0.0
    polar_motion: Annotated[tuple[float, float], Vector(Quantity(ANGLE, largest="2 arcsec"), 2)] = (0.0, 0.0)


class PassingSpec(Spec):
    """An orbit that passes a place at the epoch; the osculating orbit is a circle there.

    Attributes
    ----------
    longitude, latitude : Longitude
        Geodetic, of the place vertically below the satellite, radians.
    altitude : Altitude
        Of the satellite above the ellipsoid there, metres.
    direction : Literal['descending', 'ascending']
        Of the pass, to the south or to the north.
    inclination : Inclination | None
        Osculating, radians; without it the orbit is sun-synchronous.
    """

    longitude: Longitude
    latitude: Latitude
    altitude: Altitude = 500e3
    direction: Literal["descending", "ascending"] = "descending"
    inclination: Inclination | None = None


class ElementsSpec(Spec):
    """Osculating elements at the epoch, against the true equator of the epoch.

    Attributes
    ----------
    altitude : Altitude
        Semi-major axis less the equatorial radius, metres.
    eccentricity : Number
        At most 0.1.
    inclination : Inclination | None
        Radians; without it the orbit is sun-synchronous.
    node : Longitude | None
        Right ascension of the ascending node from the celestial intermediate origin, radians.
    node_local_time : float | None
        Local mean solar time of the descending node instead of `node`, seconds of the day.
    perigee : Longitude
        Argument of the perigee, radians.
    argument : Longitude
        Argument of latitude (perigee + true anomaly) at the epoch, radians.
    """

    altitude: Altitude
    eccentricity: Number = 0.0
    inclination: Inclination | None = None
    node: Longitude | None = None
    node_local_time: Annotated[float, Quantity(MOMENT, smallest="0 h", largest="24 h")] | None = None
    perigee: Longitude = 0.0
    argument: Longitude

    @model_validator(mode="after")
    def _is_complete(self) -> "ElementsSpec":
        if not 0.0 <= self.eccentricity <= 0.1:
            found = str(self.eccentricity)
            raise Problem("outside the limits", found, "a number from 0 to 0.1", within=("eccentricity",))
        if (self.node is None) == (self.node_local_time is None):
            raise Problem("the node is given twice or not at all", None, "either node or node_local_time")
        return self


class StateSpec(Spec):
    """State vector at the epoch.

    Attributes
    ----------
    position : Position
        In the GCRS, metres.
    velocity : Velocity
        In the GCRS, m/s.
    """

    position: Position
    velocity: Velocity


class OrbitSpec(Spec):
    """An orbit: exactly one of `passing`, `elements` and `state`.

    Attributes
    ----------
    epoch : UtcTime
        UTC; all times of the orbit are seconds from it.
    before, after : Span
        How long the orbit is followed to either side of the epoch, seconds.
    passing : PassingSpec | None
        a place that it passes.
    elements : ElementsSpec | None
        Its osculating elements.
    state : StateSpec | None
        a state vector.
    """

    epoch: UtcTime
    before: Span = 600.0
    after: Span = 600.0
    passing: PassingSpec | None = None
    elements: ElementsSpec | None = None
    state: StateSpec | None = None

    @model_validator(mode="after")
    def _is_one_orbit(self) -> "OrbitSpec":
        names = ("passing", "elements", "state")
        one_given(self, names, "the orbit is not given once", "one of passing, elements, state")
        if self.before + self.after == 0.0:
            found = f"before and after are {format_quantity(0.0, MOMENT)}"
            raise Problem("the orbit has no length", found, "a time before or after the epoch", within=("after",))
        return self

    def misses(self, time: float) -> Problem | None:
        """What is wrong with a moment, seconds from the epoch, that lies outside the orbit; None within it."""
        first, last = (format_quantity(end, MOMENT) for end in (-self.before, self.after))
        if -self.before < time < self.after:
            return None
        allowed = f"between {first} and {last}, or a longer orbit"
        return Problem("outside the orbit data", format_quantity(time, MOMENT), allowed)


class AttitudeSpec(Spec):
    """How the satellite holds itself.

    Attributes
    ----------
    nadir : Literal['geodetic', 'geocentric']
        Z points along the ellipsoid's normal (geodetic) or to the Earth's centre (geocentric).
    steering : Literal['none', 'yaw']
        X lies along the inertial velocity (none), or along the track on the turning Earth (yaw), so that the image at
        nadir does not drift along the line.
    offset : tuple[float, float, float]
        Rotation vector of the body against the orbital frame, radians (roll, pitch, yaw).
    jitter : JitterSpec | None
        Small fast turns about the body's own axes; None for none.
    """

    nadir: Literal["geodetic", "geocentric"] = "geodetic"
    steering: Literal["none", "yaw"] = "none"
    offset: Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="60 deg"))] = _ZERO
    jitter: JitterSpec | None = None


class GpsErrorsSpec(Spec):
    """Errors of the measured orbit, along X, Y and Z of the orbital frame.

    Attributes
    ----------
    interval : Interval
        Between fixes, seconds.
    noise : LengthSigmas
        Standard deviation of a fix, independent from fix to fix, metres.
    drift : LengthSigmas
        Standard deviation of what changes slowly, metres.
    correlation_time : float
        Over which `drift` falls to 1/e in its correlation, seconds.
    velocity : SpeedSigmas
        Standard deviation of a fix's velocity, independent from fix to fix, m/s.
    """

    interval: Interval = 1.0
    noise: LengthSigmas = _ZERO
    drift: LengthSigmas = _ZERO
    correlation_time: Annotated[float, Quantity(MOMENT, above_zero=True, largest="240 h")] = 1800.0
    velocity: SpeedSigmas = _ZERO


class ThermalDriftSpec(Spec):
    """Angle between star trackers and cameras that changes with the satellite's temperature along the orbit:
    amplitude x sin(latitude - reference).

    Attributes
    ----------
    amplitude : AngleErrors
        Rotation vector about body X, Y and Z, radians.
    reference : Latitude
        Geodetic latitude at which it vanishes, radians.
    """

    amplitude: AngleErrors = _ZERO
    reference: Latitude = 0.0


class SlowErrorsSpec(Spec):
    """Errors of the attitude that last for many readings and change within a pass: a cubic spline through independent
    values.

    Attributes
    ----------
    noise : AngleSigmas
        Standard deviation of a value about body X, Y and Z, radians.
    interval : Interval
        Between values, seconds.
    """

    noise: AngleSigmas = _ZERO
    interval: Interval = 10.0


class StarTrackerErrorsSpec(Spec):
    """Errors of the measured attitude, rotations about body X, Y and Z: measured after true.

    Attributes
    ----------
    interval : Interval
        Between readings, seconds.
    noise : AngleSigmas
        Standard deviation of a reading, independent from reading to reading, radians.
    bias : AngleErrors
        Constant, radians.
    thermal : ThermalDriftSpec
        Changes with latitude.
    slow : SlowErrorsSpec
        Changes within a pass.
    drift : AngleSigmas
        Standard deviation of a rate that each pass has, by what it changes in a second, radians.
    walk : AngleSigmas
        Standard deviation of what a random walk gains in a second, radians.
    """

    interval: Interval = 0.125
    noise: AngleSigmas = _ZERO
    bias: AngleErrors = _ZERO
    thermal: ThermalDriftSpec = ThermalDriftSpec.model_construct()
    slow: SlowErrorsSpec = SlowErrorsSpec.model_construct()
    drift: AngleSigmas = _ZERO
    walk: AngleSigmas = _ZERO


class ErrorsSpec(Spec):
    """Errors of what the satellite measures of itself; all zero unless given.

    Attributes
    ----------
    gps : GpsErrorsSpec
        Of the orbit.
    star_tracker : StarTrackerErrorsSpec
        Of the attitude.
    """

    gps: GpsErrorsSpec = GpsErrorsSpec.model_construct()
    star_tracker: StarTrackerErrorsSpec = StarTrackerErrorsSpec.model_construct()


class PayloadTestSpec(TitledSpec):
    """A test of a payload.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera : Ref
        Name in scenes/library/payloads or path of a file.
    """

    camera: Ref
