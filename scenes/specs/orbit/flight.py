"""Instants in UTC, Earth rotation, orbit, attitude with its jitter, and their measurement errors.

Body axes are those of a base: X forward, Z toward the scene (down), Y = Z x X (right). Components along body or orbital
axes are written in this order. Jitter is described by lines and bands of its spectrum.
"""

import re
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from scenes.yaml.errors import Problem, shown
from scenes.yaml.spec import Number, Ref, Spec, TitledSpec, require_one
from scenes.yaml.unit_fields import AngleSigmas, Quantity, Vector
from scenes.yaml.units import ANGLE, ANGLE_SPECTRUM, DISTANCE, FREQUENCY, LENGTH, MOMENT, SPEED, TIME, format_quantity

Frequency = Annotated[float, Quantity(FREQUENCY, above_zero=True, largest="10 kHz")]
Amplitudes = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, smallest="0 arcsec", largest="0.1 deg"))]
Phases = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="360 deg"), alike=True)]
Levels = Annotated[
    tuple[float, float, float], Vector(Quantity(ANGLE_SPECTRUM, smallest="0 arcsec^2/Hz", largest="1e6 arcsec^2/Hz"))
]


class JitterLineSpec(Spec):
    """Oscillation of the attitude: amplitude x sin(2 pi frequency x time + phase) about each body axis.

    Attributes
    ----------
    frequency : float
        Frequency, in hertz.
    amplitude : tuple[float, float, float]
        Amplitudes (half of peak to peak) about body X, Y and Z (roll, pitch, yaw), in radians.
    phase : tuple[float, float, float] | None
        Phases about the three axes, or one for all, in radians, for time from the orbit's epoch; random by default.
    """

    frequency: Frequency
    amplitude: Amplitudes
    phase: Phases | None = None


class JitterBandSpec(Spec):
    """Gaussian random motion of the attitude with a constant spectral density between two frequencies.

    Attributes
    ----------
    first : float
        Lower end of the band, in hertz.
    last : float
        Upper end of the band, in hertz.
    level : tuple[float, float, float]
        One-sided spectral density about body X, Y and Z, in rad^2/Hz; level x (last - first) is the variance.
    """

    first: Frequency
    last: Frequency
    level: Levels

    @model_validator(mode="after")
    def _has_a_width(self) -> "JitterBandSpec":
        if not self.first < self.last:
            value = f"{format_quantity(self.first, FREQUENCY)} to {format_quantity(self.last, FREQUENCY)}"
            raise Problem("the band is empty", value, "`last` above `first`", within=("last",))
        return self


class JitterSpec(Spec):
    """Jitter: small, fast rotations of the body about its axes, added to the rest of the attitude.

    Attributes
    ----------
    lines : tuple[JitterLineSpec, ...]
        Oscillations of single frequencies (lines of the spectrum); none by default.
    bands : tuple[JitterBandSpec, ...]
        Bands of frequencies with random motion; none by default.
    """

    lines: tuple[JitterLineSpec, ...] = Field(default=(), max_length=100)
    bands: tuple[JitterBandSpec, ...] = Field(default=(), max_length=20)

    @property
    def present(self) -> bool:
        """True if there is any jitter."""
        return any(any(line.amplitude) for line in self.lines) or any(any(band.level) for band in self.bands)


FIRST_YEAR, LAST_YEAR = 1972, 2099
"""First and last year of the times that files may have: since 1972 UTC differs from TAI by whole leap seconds."""
ALLOWED = f"date and time in UTC, ISO 8601 and ending in Z, {FIRST_YEAR} to {LAST_YEAR}, e.g. '2011-03-05T03:05:00Z'"
PATTERN = r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}(:[0-9]{2}(\.[0-9]{1,6})?)?Z$"


def parse_utc(text: Any) -> str:
    """Return the text of a UTC time after a check of its format; leap seconds are refused.

    Raises
    ------
    Problem
        The value is not text, has another format or no time zone, or there is no such instant.
    """
    if not isinstance(text, str):
        raise Problem("not a date and time", shown(text), ALLOWED)
    stripped = text.strip()
    if re.fullmatch(PATTERN.replace("Z$", "$"), stripped):
        raise Problem("a date and time without a time zone", shown(text), ALLOWED)
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
"""Time in UTC, as ISO 8601 text that ends in Z."""


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
    """Earth rotation parameters that cannot be predicted, from IERS bulletins.

    Attributes
    ----------
    ut1_utc : float
        UT1 - UTC at the epoch, in seconds.
    polar_motion : tuple[float, float]
        Coordinates x and y of the pole, in radians (x toward Greenwich, y toward 90 degrees west).
    """

    ut1_utc: Annotated[float, Quantity(TIME, largest="0.9 s")] = 0.0
    polar_motion: Annotated[tuple[float, float], Vector(Quantity(ANGLE, largest="2 arcsec"), 2)] = (0.0, 0.0)


class PassingSpec(Spec):
    """Orbit that passes over a place at the epoch, where the osculating orbit is a circle.

    Attributes
    ----------
    longitude : float
        Longitude of the place vertically below the satellite, in radians; east is positive.
    latitude : float
        Geodetic latitude of the place vertically below the satellite, in radians; north is positive.
    altitude : float
        Altitude of the satellite above the ellipsoid there, in metres.
    direction : {'descending', 'ascending'}
        Direction of flight: descending to the south, ascending to the north.
    inclination : float | None
        Osculating inclination, in radians; by default that of a sun-synchronous orbit.
    """

    longitude: Longitude
    latitude: Latitude
    altitude: Altitude = 500e3
    direction: Literal["descending", "ascending"] = "descending"
    inclination: Inclination | None = None


class ElementsSpec(Spec):
    """Osculating elements at the epoch, relative to the true equator of the epoch.

    Attributes
    ----------
    altitude : float
        Semi-major axis minus the equatorial radius, in metres.
    eccentricity : float
        Eccentricity, at most 0.1.
    inclination : float | None
        Inclination, in radians; by default that of a sun-synchronous orbit.
    node : float | None
        Right ascension of the ascending node from the celestial intermediate origin, in radians.
    node_local_time : float | None
        Local mean solar time of the descending node, 0 h to 24 h, instead of `node`, in seconds.
    perigee : float
        Argument of the perigee, in radians.
    argument : float
        Argument of latitude (perigee + true anomaly) at the epoch, in radians.
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
            raise Problem("outside the limits", f"{self.eccentricity}", "from 0 to 0.1", None, ("eccentricity",))
        if (self.node is None) == (self.node_local_time is None):
            raise Problem("the node must be given in exactly one way", None, "either node or node_local_time")
        return self


class StateSpec(Spec):
    """Position and velocity of the satellite at the epoch.

    Attributes
    ----------
    position : tuple[float, float, float]
        Position in the GCRS, in metres.
    velocity : tuple[float, float, float]
        Velocity in the GCRS, in m/s.
    """

    position: Position
    velocity: Velocity


class OrbitSpec(Spec):
    """Orbit, defined by exactly one of `passing`, `elements` and `state`.

    Attributes
    ----------
    epoch : str
        UTC epoch, from which all times of the orbit are counted.
    before : float
        Duration of the orbit data before the epoch, in seconds.
    after : float
        Duration of the orbit data after the epoch, in seconds.
    passing : PassingSpec | None
        Place over which the orbit passes at the epoch.
    elements : ElementsSpec | None
        Osculating elements at the epoch.
    state : StateSpec | None
        Position and velocity at the epoch.
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
        require_one(self, names, "the orbit must be given in exactly one way", "one of passing, elements, state")
        if self.before + self.after == 0.0:
            value = f"before and after are {format_quantity(0.0, MOMENT)}"
            raise Problem("the orbit has no length", value, "a time before or after the epoch", within=("after",))
        return self

    def misses(self, time: float) -> Problem | None:
        """Return the problem of a time outside the orbit data, in seconds from the epoch; None if it is inside."""
        first, last = (format_quantity(end, MOMENT) for end in (-self.before, self.after))
        if -self.before < time < self.after:
            return None
        allowed = f"between {first} and {last}, or a longer orbit"
        return Problem("outside the orbit data", format_quantity(time, MOMENT), allowed)


class AttitudeSpec(Spec):
    """Nominal attitude of the satellite, and its jitter.

    Attributes
    ----------
    nadir : {'geodetic', 'geocentric'}
        Direction of Z: along the ellipsoid's normal (geodetic) or to the Earth's centre (geocentric).
    steering : {'none', 'yaw'}
        Direction of X: along the inertial velocity (none), or along the track on the rotating Earth (yaw), so that the
        image at nadir does not drift along the line.
    offset : tuple[float, float, float]
        Rotation vector of the body relative to the orbital frame (roll, pitch, yaw), in radians.
    jitter : JitterSpec | None
        Small, fast rotations about the body's axes; none by default.
    """

    nadir: Literal["geodetic", "geocentric"] = "geodetic"
    steering: Literal["none", "yaw"] = "none"
    offset: Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="60 deg"))] = _ZERO
    jitter: JitterSpec | None = None


class GpsErrorsSpec(Spec):
    """Errors of the measured orbit along X, Y and Z of the orbital frame.

    Attributes
    ----------
    interval : float
        Interval between fixes, in seconds.
    noise : tuple[float, float, float]
        Standard deviation of a fix, independent from fix to fix, in metres.
    drift : tuple[float, float, float]
        Standard deviation of a slowly varying error, in metres.
    correlation_time : float
        Correlation time of `drift`, at which its correlation has fallen to 1/e, in seconds.
    velocity : tuple[float, float, float]
        Standard deviation of a fix's velocity, independent from fix to fix, in m/s.
    """

    interval: Interval = 1.0
    noise: LengthSigmas = _ZERO
    drift: LengthSigmas = _ZERO
    correlation_time: Annotated[float, Quantity(MOMENT, above_zero=True, largest="240 h")] = 1800.0
    velocity: SpeedSigmas = _ZERO


class ThermalDriftSpec(Spec):
    """Change of the angle between star trackers and cameras with the satellite's temperature along the orbit.

    The angle is amplitude x sin(latitude - reference).

    Attributes
    ----------
    amplitude : tuple[float, float, float]
        Rotation vector about body X, Y and Z, in radians; it is multiplied by sin(latitude - reference).
    reference : float
        Geodetic latitude at which the change is zero, in radians.
    """

    amplitude: AngleErrors = _ZERO
    reference: Latitude = 0.0


class SlowErrorsSpec(Spec):
    """Slow errors of the attitude within a pass: a cubic spline through independent values.

    Attributes
    ----------
    noise : tuple[float, float, float]
        Standard deviation of a value about body X, Y and Z, in radians.
    interval : float
        Interval between the values, in seconds; it covers many readings.
    """

    noise: AngleSigmas = _ZERO
    interval: Interval = 10.0


class StarTrackerErrorsSpec(Spec):
    """Errors of the measured attitude: rotations about body X, Y and Z from the true to the measured attitude.

    Attributes
    ----------
    interval : float
        Interval between readings, in seconds.
    noise : tuple[float, float, float]
        Standard deviation of a reading, independent from reading to reading, in radians.
    bias : tuple[float, float, float]
        Constant error about body X, Y and Z, in radians.
    thermal : ThermalDriftSpec
        Error that changes with the satellite's temperature, and so with the latitude.
    slow : SlowErrorsSpec
        Error that changes within a pass.
    drift : tuple[float, float, float]
        Standard deviation of a constant rate in each pass, as the change in a second, in radians.
    walk : tuple[float, float, float]
        Standard deviation of the increment of a random walk in a second, in radians.
    """

    interval: Interval = 0.125
    noise: AngleSigmas = _ZERO
    bias: AngleErrors = _ZERO
    thermal: ThermalDriftSpec = ThermalDriftSpec.model_construct()
    slow: SlowErrorsSpec = SlowErrorsSpec.model_construct()
    drift: AngleSigmas = _ZERO
    walk: AngleSigmas = _ZERO


class ErrorsSpec(Spec):
    """Errors of the satellite's orbit and attitude measurements; zero by default.

    Attributes
    ----------
    gps : GpsErrorsSpec
        Errors of the measured orbit.
    star_tracker : StarTrackerErrorsSpec
        Errors of the measured attitude.
    """

    gps: GpsErrorsSpec = GpsErrorsSpec.model_construct()
    star_tracker: StarTrackerErrorsSpec = StarTrackerErrorsSpec.model_construct()


class PayloadTestSpec(TitledSpec):
    """Base of tests of a payload (a set of line cameras).

    Attributes
    ----------
    camera : str
        Payload: a name in scenes/library/payloads, or the path of your file.
    """

    camera: Ref
