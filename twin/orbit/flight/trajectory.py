"""Position and attitude of a satellite, their measurement errors, and jitter.

The orbital frame has Z down, X forward and Y = Z x X, which lies to the right of the track and against the orbit's
angular momentum.

Readings come at a fixed interval. Random errors are drawn for every reading of the span beforehand and interpolated by
a cubic spline, as a user of the data would do: at a reading the error has the specified standard deviation, halfway
between two it is somewhat smaller. Each error term has its own random stream, so that switching one off does not change
the others.

Jitter is small fast rotations of the body about its own axes, specified by frequency. It is a sum of sinusoids and is
evaluated, never interpolated. The noise of a frequency band consists of sinusoids, too: the band is divided into equal
parts, and each part gets one frequency drawn uniformly within it, with normally distributed sine and cosine amplitudes
whose variance is the specified power spectral density times the part's width. The motion is then Gaussian at every time
with exactly the specified variance, its expected spectrum is exactly the specified one, and it does not repeat. Over
times longer than the inverse width of a part, some seconds, the single lines of its spectrum can be resolved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from optics.geometry.pose import rotation_matrix
from twin.framework.procedure import BenchError, stream
from twin.orbit.flight.earth import Earth, curvature_radii, east_north_up
from twin.orbit.flight.orbit import Orbit, propagate
from twin.sensors.line_ccd import Collection

if TYPE_CHECKING:
    from scenes.specs.orbit.flight import AttitudeSpec, ErrorsSpec, JitterSpec

JITTER_STREAM = 2**31
"""Number of the random stream of jitter among those of a pass, far above the numbers of the other streams."""
_RESOLVED = 10.0
"""Duration over which the single sinusoids that make up the noise of a band can be distinguished, in seconds."""
_LEAST, _MOST = 64, 4096
"""Smallest and largest number of sinusoids that represent the noise of a frequency band."""
_AT_ONCE = 4_000_000
"""Largest number of sine phases that are evaluated at a time, to limit memory."""
_MOMENTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
"""Numbers of moments within the light collection of a pixel that are tried in turn, until position and smear of the
image are accurate enough.
"""


@dataclass(frozen=True, eq=False)
class Jitter:
    """Rotations of the satellite's body over time as a sum of sinusoids, instantaneous or averaged over the exposure.

    Attributes
    ----------
    frequency : (K,) ndarray for K sinusoids
        Frequencies, hertz.
    sine, cosine : (K, 3) ndarray
        Amplitudes as rotation vectors about body X, Y and Z, radians.
    collection : Collection or None
        Light collection (exposure) over which the rotation is averaged; None for instantaneous values.
    """

    frequency: np.ndarray
    sine: np.ndarray
    cosine: np.ndarray
    collection: Collection | None = None

    @classmethod
    def of(cls, spec: JitterSpec, seed: np.random.SeedSequence) -> Jitter | None:
        """Make the jitter that an input file specifies; return None where it specifies none.

        Parameters
        ----------
        spec : JitterSpec
            Lines (single frequencies) and bands of the spectrum.
        seed : SeedSequence
            Seed of random phases and of bands. Each line and each band has its own stream.
        """
        if not spec.present:
            return None
        streams, terms = seed.spawn(len(spec.lines) + len(spec.bands)), []
        for line, generator in zip(spec.lines, streams, strict=False):
            drawn = np.random.default_rng(generator).uniform(0.0, 2.0 * np.pi, 3)
            phase = drawn if line.phase is None else np.array(line.phase)
            both = (np.array([line.amplitude]) * function(phase) for function in (np.cos, np.sin))
            terms.append((np.array([line.frequency]), *both))
        for band, generator in zip(spec.bands, streams[len(spec.lines) :], strict=True):
            random, width = np.random.default_rng(generator), band.last - band.first
            count = int(np.clip(np.ceil(_RESOLVED * width), _LEAST, _MOST))
            frequency = band.first + width * (np.arange(count) + random.uniform(size=count)) / count
            sigma = np.sqrt(np.array(band.level) * width / count)
            terms.append((frequency, *(sigma * random.standard_normal((count, 3)) for _ in range(2))))
        frequencies, sines, cosines = (np.concatenate(part) for part in zip(*terms, strict=True))
        return cls(frequencies, sines, cosines)

    def __call__(self, seconds: np.ndarray) -> np.ndarray:
        """Return rotation vectors in body axes at times (...), seconds: (..., 3), in radians."""
        t = np.asarray(seconds, np.float64)
        # Each image line is requested at many pixels.
        moments, index = np.unique(t, return_inverse=True)
        gain = 1.0 if self.collection is None else self.collection.mean(self.frequency)[:, None]
        sine, cosine = gain * self.sine, gain * self.cosine
        rotation = np.empty((len(moments), 3))
        size = max(_AT_ONCE // len(self.frequency), 1)
        for part in (slice(k, k + size) for k in range(0, len(moments), size)):
            angle = 2.0 * np.pi * (moments[part, None] * self.frequency)
            rotation[part] = np.sin(angle) @ sine + np.cos(angle) @ cosine
        return np.asarray(rotation[index.reshape(t.shape)])

    @property
    def amplitude(self) -> np.ndarray:
        """Amplitude of each of K sinusoids, root sum square over the axes, (K,), in radians."""
        return np.sqrt(np.sum(self.sine**2 + self.cosine**2, axis=1))

    def later(self, seconds: float) -> Jitter:
        """Return the jitter whose value at time t is the value of this one at t + seconds."""
        angle = 2.0 * np.pi * self.frequency[:, None] * seconds
        sine = self.sine * np.cos(angle) - self.cosine * np.sin(angle)
        cosine = self.sine * np.sin(angle) + self.cosine * np.cos(angle)
        return replace(self, sine=sine, cosine=cosine)

    def over(self, collection: Collection) -> Jitter:
        """Return the jitter averaged over the exposure about each time, which displaces the image of a TDI line."""
        return replace(self, collection=collection)

    def exposures(self, collection: Collection, pixel: float, tolerance: float) -> list[tuple[float, Jitter]]:
        """Divide a light collection into moments; return the weight of each in the image, and the jitter at it.

        Parameters
        ----------
        collection : Collection
            Light collection (exposure) of the line.
        pixel : float
            Angle of a pixel, radians.
        tolerance : float
            Tolerance of the image's position and smear, pixels.

        Raises
        ------
        ValueError
            An oscillation is so fast and large that no reasonable number of moments is enough.
        """
        instantaneous, size = replace(self, collection=None), self.amplitude / pixel
        exact = [collection.mean(k * self.frequency) for k in (1, 2)]
        for count in _MOMENTS:
            moments, weights = collection.gauss_rule(count)
            angle = 2.0 * np.pi * self.frequency[:, None] * moments
            # The rule is symmetric, so only parts even in time have an error.
            off = [np.abs(np.cos(k * angle) @ weights - w) for k, w in zip((1, 2), exact, strict=True)]
            # At Nyquist the second harmonic of an oscillation of A pixels has the weight J_2(pi A), about (pi A)^2 / 8.
            if np.sqrt(np.sum((size * off[0] + np.minimum(1.25 * size**2, size) * off[1]) ** 2)) <= tolerance:
                return [(float(w), instantaneous.later(float(s))) for s, w in zip(moments, weights, strict=True)]
        highest = float(np.max(self.frequency))
        raise ValueError(
            f"jitter of up to {highest:g} Hz and {float(np.max(size)):.3g} pixels within {collection.length:.3g} s of "
            "collection is too fast to be averaged over moments of the collection"
        )

    def read(self, times: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Return the jitter, as a function of time, that a cubic spline through its values at K reading times shows.

        Jitter faster than half of the readings' rate is aliased to a lower frequency.
        """
        return CubicSpline(times, self(times))


@dataclass(frozen=True)
class Attitude:
    """Attitude law of a satellite.

    Attributes
    ----------
    geodetic : bool
        Z points along the ellipsoid's normal through the satellite; otherwise it points to the Earth's centre.
    yaw_steering : bool
        X lies along the motion of the nadir point over the rotating Earth, so that the image of that point moves
        perpendicular to a line along Y; else along the inertial velocity.
    offset : tuple of float
        Rotation vector of the body relative to the orbital frame, radians.
    """

    geodetic: bool = True
    yaw_steering: bool = False
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def from_spec(cls, spec: AttitudeSpec) -> Attitude:
        """Return the attitude law that an input file specifies."""
        return cls(spec.nadir == "geodetic", spec.steering == "yaw", spec.offset)

    def orbital_to_itrs(self, position: np.ndarray, velocity: np.ndarray, inertial_velocity: np.ndarray) -> np.ndarray:
        """Return the axes of the orbital frame as columns: x_itrs = matrix @ x_orbital.

        Parameters
        ----------
        position : (..., 3) ndarray
            Position in the ITRS, metres.
        velocity : (..., 3) ndarray
            Velocity relative to the rotating Earth, m/s.
        inertial_velocity : (..., 3) ndarray
            Velocity relative to the stars, in axes of the ITRS, m/s.

        Returns
        -------
        (..., 3, 3) ndarray
            Rotation matrices.
        """
        along = velocity if self.yaw_steering else inertial_velocity
        if self.geodetic:
            lon, lat, height = Earth().geodetic(position)
            level = east_north_up(lon, lat)
            up = level[..., 2, :]
            east, north = (np.sum(level[..., k, :] * along, axis=-1) for k in (0, 1))
            if self.yaw_steering:
                # The nadir point moves slower than the satellite, and differently along and across the meridian.
                meridian, normal = curvature_radii(lat)
                east, north = east * normal / (normal + height), north * meridian / (meridian + height)
            forward = east[..., None] * level[..., 0, :] + north[..., None] * level[..., 1, :]
        else:
            # The nadir point moves along its own radius as well, which is along the line of sight only.
            up = position / np.linalg.norm(position, axis=-1, keepdims=True)
            forward = along - np.sum(along * up, axis=-1, keepdims=True) * up
        x = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
        return np.stack([x, np.cross(-up, x), -up], axis=-1)

    def body_to_itrs(self, position: np.ndarray, velocity: np.ndarray, inertial_velocity: np.ndarray) -> np.ndarray:
        """Return the axes of the body as columns, (..., 3, 3): x_itrs = matrix @ x_body.

        Arguments are position (m), velocity relative to the rotating Earth and inertial velocity (m/s), all in axes of
        the ITRS.
        """
        return self.orbital_to_itrs(position, velocity, inertial_velocity) @ rotation_matrix(self.offset)


TERMS = (
    "gps_noise",
    "gps_drift",
    "gps_velocity",
    "attitude_noise",
    "attitude_bias",
    "attitude_thermal",
    "attitude_slow",
    "attitude_drift",
    "attitude_walk",
)
"""Names of the errors of measured orbit and attitude that can be switched on and off."""

_SPARE_READINGS = 8
"""Number of readings simulated beyond either end of the time span, so that end effects of the spline are negligible."""

Series = Callable[[np.ndarray], np.ndarray]
"""Function of times (...), in seconds, that returns vectors (..., 3), such as errors of position or attitude."""


def readings(first: float, last: float, interval: float) -> np.ndarray:
    """Return the times of K readings, (K,), in seconds: multiples of the interval over the span and beyond its ends."""
    begin, end = np.floor(first / interval) - _SPARE_READINGS, np.ceil(last / interval) + _SPARE_READINGS
    return np.asarray(interval * np.arange(begin, end + 1.0))


def _noise(time: np.ndarray, sigma: np.ndarray, seed: np.random.SeedSequence) -> Series:
    """Return a function of time that interpolates white noise of standard deviation `sigma` at the readings."""
    return CubicSpline(time, sigma * np.random.default_rng(seed).standard_normal((time.size, 3)))


def _walk(time: np.ndarray, sigma: np.ndarray, seed: np.random.SeedSequence) -> Series:
    """Return a function of time that interpolates a random walk at the readings.

    It is zero at the reading nearest to time zero; sigma is its standard deviation after one second.
    """
    steps = np.random.default_rng(seed).standard_normal((time.size, 3)) * np.sqrt(time[1] - time[0])
    course = np.cumsum(steps, axis=0)
    return CubicSpline(time, sigma * (course - course[int(np.argmin(np.abs(time)))]))


def _drift(time: np.ndarray, sigma: np.ndarray, seed: np.random.SeedSequence, correlation_time: float) -> Series:
    """Return a function of time that interpolates a stationary first-order Gauss-Markov process at the readings.

    Its correlation over a time dt is exp(-|dt| / correlation_time); sigma is its standard deviation.
    """
    draws = np.random.default_rng(seed).standard_normal((time.size, 3))
    correlation = np.exp(-(time[1] - time[0]) / correlation_time)
    draws[1:] *= np.sqrt(1.0 - correlation * correlation)
    return CubicSpline(time, sigma * lfilter([1.0], [1.0, -correlation], draws, axis=0))


@dataclass(frozen=True, eq=False)
class MeasurementErrors:
    """Errors of the measured orbit and attitude, measured minus true, as functions of time.

    Attributes
    ----------
    position_terms : tuple of Series
        Functions of time of position errors in the orbital frame, metres; the errors add.
    velocity_terms : tuple of Series
        Functions of time of velocity errors in the orbital frame, m/s.
    attitude_terms : tuple of Series
        Functions of time of rotation vectors in body axes, radians.
    bias : (3,) ndarray
        Constant rotation vector in body axes, radians.
    thermal : (3,) ndarray
        Amplitude of the error that changes with latitude, radians.
    reference : float
        Latitude at which the thermal error vanishes, radians.
    rate : (3,) ndarray
        Rate of a drift that vanishes at time zero, radians per second.
    """

    position_terms: tuple[Series, ...]
    velocity_terms: tuple[Series, ...]
    attitude_terms: tuple[Series, ...]
    bias: np.ndarray
    thermal: np.ndarray
    reference: float
    rate: np.ndarray

    def position(self, seconds: np.ndarray) -> np.ndarray:
        """Return position errors along the orbital frame's axes at times (...), (..., 3), in metres."""
        return _sum(self.position_terms, seconds)

    def velocity(self, seconds: np.ndarray) -> np.ndarray:
        """Return velocity errors along the orbital frame's axes at times (...), (..., 3), in m/s."""
        return _sum(self.velocity_terms, seconds)

    def attitude(self, seconds: np.ndarray, latitude: np.ndarray) -> np.ndarray:
        """Return rotation vectors in body axes, in radians: measured = true @ rotation_matrix(vector).

        Parameters
        ----------
        seconds : (...) ndarray
            Times, seconds.
        latitude : (...) ndarray
            Geodetic latitude of the nadir point, radians.

        Returns
        -------
        (..., 3) ndarray
            Rotation vectors.
        """
        shape = np.sin(np.asarray(latitude) - self.reference)
        drift = np.asarray(seconds, np.float64)[..., None] * self.rate
        return _sum(self.attitude_terms, seconds) + self.bias + shape[..., None] * self.thermal + drift


def _draw_errors(
    spec: ErrorsSpec, first: float, last: float, seed: int, terms: Sequence[str] = TERMS
) -> MeasurementErrors:
    """Draw the errors of the measured orbit and attitude over a span of time.

    Parameters
    ----------
    spec : ErrorsSpec
        Standard deviations and other parameters of the errors.
    first : float
        Start of the span, seconds.
    last : float
        End of the span, seconds.
    seed : int
        Seed of all random numbers.
    terms : sequence of str
        Names, of `TERMS`, of the errors that are on; the others are zero.
    """
    streams = dict(zip(TERMS, np.random.SeedSequence(seed).spawn(len(TERMS)), strict=True))
    gps, star = spec.gps, spec.star_tracker

    def drawn(
        name: str, sigma: Sequence[float], interval: float, make: Callable[..., Series] = _noise, *more: float
    ) -> tuple[Series, ...]:
        """Return the error functions of time of a term as a tuple, empty where the term is switched off."""
        if name not in terms or not any(sigma):
            return ()
        return (make(readings(first, last, interval), np.array(sigma), streams[name], *more),)

    drift = drawn("gps_drift", gps.drift, gps.interval, _drift, gps.correlation_time)
    slow = drawn("attitude_slow", star.slow.noise, star.slow.interval)
    walk = drawn("attitude_walk", star.walk, star.interval, _walk)
    return MeasurementErrors(
        (*drawn("gps_noise", gps.noise, gps.interval), *drift),
        drawn("gps_velocity", gps.velocity, gps.interval),
        (*drawn("attitude_noise", star.noise, star.interval), *slow, *walk),
        np.array(star.bias) * ("attitude_bias" in terms),
        np.array(star.thermal.amplitude) * ("attitude_thermal" in terms),
        star.thermal.reference,
        np.random.default_rng(streams["attitude_drift"]).standard_normal(3)
        * np.array(star.drift)
        * ("attitude_drift" in terms),
    )


def _sum(series: tuple[Series, ...], seconds: np.ndarray) -> np.ndarray:
    """Return the sum of several error time series at given times.

    Parameters
    ----------
    series : tuple of Series
        Functions of the time that return errors about or along three axes, in the unit of their quantity: metres, m/s
        or radians.
    seconds : (...) ndarray
        Times, in seconds from the orbit's epoch.

    Returns
    -------
    (..., 3) ndarray
        Sum of the errors in the same unit; zero without series.
    """
    t = np.asarray(seconds, dtype=np.float64)
    return sum((term(t) for term in series), np.zeros((*t.shape, 3)))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Position and attitude over the span of an orbit.

    Times are seconds from the orbit's epoch, of any shape (...).

    Every method raises ValueError for a time outside the orbit.

    Attributes
    ----------
    orbit : Orbit
        True orbit.
    attitude : Attitude
        Law that the true attitude follows.
    errors : MeasurementErrors or None
        Errors of the measured orbit and attitude; None for the true trajectory.
    jitter : Series or None
        Rotation of the body relative to the attitude law: rotation vectors (..., 3), in radians, about body axes at
        times (...), seconds; None without jitter. For a measured trajectory it is the jitter that the attitude readings
        show.
    """

    orbit: Orbit
    attitude: Attitude = field(default_factory=Attitude)
    errors: MeasurementErrors | None = None
    jitter: Series | None = None

    @classmethod
    def flown(cls, orbit: Orbit, spec: AttitudeSpec, seed: int | np.random.SeedSequence, *number: int) -> Trajectory:
        """Return the true trajectory of an orbit.

        Parameters
        ----------
        orbit : Orbit
            True orbit.
        spec : AttitudeSpec
            Attitude law and jitter.
        seed : int or SeedSequence
            Seed of the random part of the jitter, which has its own stream.
        number : int
            Number of the pass, where several share a seed.
        """
        jitter = None if spec.jitter is None else Jitter.of(spec.jitter, stream(seed, JITTER_STREAM, *number))
        return cls(orbit, Attitude.from_spec(spec), jitter=jitter)

    @classmethod
    def of_test(cls, spec: Any, seed: int | np.random.SeedSequence) -> Trajectory:
        """Return the true trajectory that a test's file describes.

        Parameters
        ----------
        spec : Spec
            Content of the file, with the sections `earth`, `orbit` and `attitude`.
        seed : int or SeedSequence
            Seed of the random part of the jitter, which has its own stream.

        Raises
        ------
        BenchError
            No such orbit exists.
        """
        try:
            orbit = propagate(spec.orbit, Earth.from_spec(spec.earth))
        except ValueError as error:
            raise BenchError(str(error), ("orbit",), "an orbit that exists and stays above the ground") from error
        return cls.flown(orbit, spec.attitude, seed)

    @property
    def first(self) -> float:
        """Start of the span, seconds."""
        return self.orbit.first

    @property
    def last(self) -> float:
        """End of the span, seconds."""
        return self.orbit.last

    def position(self, seconds: Any) -> np.ndarray:
        """Return the position in the ITRS at times (...), (..., 3), in metres."""
        return self._motion(seconds)[0]

    def velocity(self, seconds: Any) -> np.ndarray:
        """Return the velocity relative to the rotating Earth in axes of the ITRS at times (...), (..., 3), in m/s."""
        return self._motion(seconds)[1]

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        """Return the velocity relative to the stars in axes of the ITRS at times (...), (..., 3), in m/s."""
        return self._motion(seconds)[2]

    def orbital_to_itrs(self, seconds: Any) -> np.ndarray:
        """Return the true axes of the orbital frame as columns at times (...), (..., 3, 3)."""
        return self.attitude.orbital_to_itrs(*self.orbit.itrs(seconds))

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        """Return the axes of the body as columns at times (...), (..., 3, 3): x_itrs = matrix @ x_body."""
        true = self.orbit.itrs(seconds)
        body = self.attitude.body_to_itrs(*true)
        if self.jitter is not None:
            body = body @ rotation_matrix(self.jitter(seconds))
        if self.errors is None:
            return body
        latitude = self.orbit.earth.geodetic(true[0])[1]
        return body @ rotation_matrix(self.errors.attitude(seconds, latitude))

    def with_errors(self, spec: ErrorsSpec, seed: int, terms: Sequence[str] = TERMS) -> Trajectory:
        """Return the trajectory as the satellite measures it.

        The new errors replace those of the trajectory, and the jitter is replaced by that which interpolated attitude
        readings show.

        Parameters
        ----------
        spec : ErrorsSpec
            Standard deviations and other parameters of the errors.
        seed : int
            Seed of all random numbers.
        terms : sequence of str
            Names of the errors that are on, of `twin.orbit.flight.trajectory.TERMS`.
        """
        errors, jitter = _draw_errors(spec, self.first, self.last, seed, terms), self.jitter
        if isinstance(jitter, Jitter):
            jitter = jitter.read(readings(self.first, self.last, spec.star_tracker.interval))
        return replace(self, errors=errors, jitter=jitter)

    def _motion(self, seconds: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position, velocity and inertial velocity, (..., 3) each, in axes of the ITRS."""
        position, velocity, inertial = self.orbit.itrs(seconds)
        if self.errors is None:
            return position, velocity, inertial
        axes = self.attitude.orbital_to_itrs(position, velocity, inertial)
        offset, speed = (
            np.einsum("...ij,...j->...i", axes, error(seconds))
            for error in (self.errors.position, self.errors.velocity)
        )
        return position + offset, velocity + speed, inertial + speed
