"""Tables of readings of orbit and attitude, and their interpolation between the readings.

This is what a satellite transmits and what an analysis uses, for a simulated pass as for a real one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline, KroghInterpolator
from scipy.spatial.transform import Rotation

from analysis.arrays import Array
from optics.numerics.array_math import UnphysicalError, in_span
from twin.orbit.flight.sensor import earth_rotation_velocity
from twin.orbit.flight.trajectory import Attitude, Trajectory, readings

Interpolation = Literal["spline", "lagrange"]

_SPLINE_ERROR = 1e-3
"""Largest error of a cubic spline between the readings of a smooth orbit, in metres."""
_FOURTH_DERIVATIVE = 1.1e-5
"""Fourth derivative of a coordinate of a low circular orbit, in m/s^4: r n^4 at 300 km, with the Earth's rotation."""
_LAGRANGE_NODES = 10
"""Number of readings through which an interpolating Lagrange polynomial goes."""
_LEAST_ROWS = 12
"""Smallest number of readings for which every fourth reading still defines an interpolating curve."""
_GROWS = 4.0
"""Factor by which the interpolation error must grow when the step is doubled to be attributed to the interpolation and
not to the noise of the readings.
"""
_SURELY = 1e3
"""Interpolation error, in metres, that is too large to be attributed to the noise of the readings."""
_GAP = 5.0
"""Interval between readings, in units of the median interval, above which it is a gap that is not interpolated."""
_UNIT_TOLERANCE = 1e-3
"""Largest accepted deviation of a quaternion's norm from 1: it accepts numbers with four decimals and rejects other
rotation parameters.
"""


@dataclass(frozen=True, eq=False)
class PlatformTable:
    """Readings of orbit and attitude of one pass.

    Attributes
    ----------
    epoch : str
        UTC, ISO 8601 ending in Z; all times are SI seconds from it, leap seconds counted.
    orbit_time : (N,) ndarray for N orbit readings
        Times of the orbit readings, seconds, increasing.
    position : (N, 3) ndarray
        Position of the body's origin in the ITRS, metres.
    velocity : (N, 3) ndarray or None
        Velocity relative to the rotating Earth in axes of the ITRS, m/s; None where it was not measured.
    attitude_time : (M,) ndarray for M attitude readings
        Times of the attitude readings, seconds, increasing.
    quaternion : (M, 4) ndarray
        Unit quaternions x, y, z, w (scalar last) with continuous signs, which rotate body axes to ITRS axes: v_itrs =
        R(q) v_body.
    usable : tuple of float
        Two times, seconds, between which the orbit may be used; readings beyond them only support the interpolation.
    """

    epoch: str
    orbit_time: Array
    position: Array
    velocity: Array | None
    attitude_time: Array
    quaternion: Array
    usable: tuple[float, float] = (-np.inf, np.inf)

    @classmethod
    def of(
        cls,
        epoch: str,
        orbit_time: ArrayLike,
        position: ArrayLike,
        velocity: ArrayLike | None,
        attitude_time: ArrayLike,
        quaternion: ArrayLike,
    ) -> PlatformTable:
        """Make the table from readings, with checks; quaternions are normalised and get continuous signs.

        Parameters
        ----------
        epoch : str
            UTC, ISO 8601.
        orbit_time : (N,) array_like for N orbit readings
            Times of the orbit readings, seconds.
        position : (N, 3) array_like
            Positions in the ITRS, metres.
        velocity : (N, 3) array_like or None
            Velocities relative to the Earth-fixed axes, m/s, or None.
        attitude_time : (M,) array_like for M attitude readings
            Times of the attitude readings, seconds.
        quaternion : (M, 4) array_like
            x, y, z, w, body to ITRS, either sign.

        Raises
        ------
        ValueError
            Shapes do not match, values are not finite, times do not increase, there are fewer than two readings, or
            four numbers are not a rotation.
        """
        times, looks = (np.array(v, np.float64) for v in (orbit_time, attitude_time))
        positions, rotation = np.array(position, np.float64), np.array(quaternion, np.float64)
        speed = None if velocity is None else np.array(velocity, np.float64)
        rows = (("position", times, positions, 3), ("velocity", times, speed, 3), ("quaternion", looks, rotation, 4))
        for what, time, values, width in rows:
            if values is None:
                continue
            if time.ndim != 1 or len(time) < 2 or values.shape != (len(time), width):
                raise ValueError(f"platform: {what} must be (n, {width}) for n >= 2 times, found {values.shape}")
            if not (np.all(np.isfinite(time)) and np.all(np.isfinite(values))):
                raise ValueError(f"platform: a {what} or its time is not finite")
            if not np.all(np.diff(time) > 0.0):
                raise ValueError(f"platform: times of {what} do not increase")
        norm = np.linalg.norm(rotation, axis=1)
        if np.any(np.abs(norm - 1.0) > _UNIT_TOLERANCE):
            raise ValueError("platform: a quaternion is not of unit length")
        return cls(epoch, times, positions, speed, looks, continuous_quaternions(rotation / norm[:, None]))

    @classmethod
    def sampled(cls, trajectory: Trajectory, orbit_interval: float, attitude_interval: float) -> PlatformTable:
        """Sample a trajectory at whole multiples of the intervals, in seconds, and at both ends of its span."""
        fixes, looks = (_moments(trajectory, step) for step in (orbit_interval, attitude_interval))
        rotation = Rotation.from_matrix(trajectory.body_to_itrs(looks)).as_quat(canonical=False)
        positions, speed = trajectory.position(fixes), trajectory.velocity(fixes)
        return cls.of(str(trajectory.orbit.epoch), fixes, positions, speed, looks, rotation)


def continuous_quaternions(quaternion: Array) -> Array:
    """Return quaternions of the same rotations with signs such that neighbours can be interpolated.

    Parameters
    ----------
    quaternion : (N, 4) ndarray for N quaternions
        Quaternions, of which q and -q are the same rotation.

    Returns
    -------
    (N, 4) ndarray
        Quaternions with consistent signs; the first keeps its sign.
    """
    flip = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0.0, -1.0, 1.0))
    return np.concatenate([quaternion[:1], quaternion[1:] * flip[:, None]])


def _moments(trajectory: Trajectory, step: float) -> Array:
    """Return the times of readings at multiples of `step` within a trajectory, and at both of its ends, in seconds.

    A reading that nearly coincides with an end is dropped.
    """
    first, last = trajectory.first, trajectory.last
    times = readings(first, last, step)
    inside = times[(times > first + 1e-3 * step) & (times < last - 1e-3 * step)]
    return np.concatenate([[first], inside, [last]])


@dataclass(frozen=True, eq=False)
class TabulatedTrajectory:
    """Position and attitude interpolated between the readings of a table.

    Times are seconds from the table's epoch, of any shape (...).

    Positions are interpolated by a cubic spline (not-a-knot) where it is accurate to 1 mm on a smooth orbit, which is
    so for up to 14 s between readings, and by Lagrange's polynomial of ten readings around each time where readings are
    farther apart. Velocities are interpolated likewise, or are the derivative of the positions. Components of
    quaternions are interpolated by a cubic spline and normalised: accurate to 1e-9 rad for a satellite that rotates by
    0.1 deg between readings.

    Every method raises ValueError for a time outside the readings or in a gap of them.

    Attributes
    ----------
    table : PlatformTable
        Readings of orbit and attitude.
    law : Attitude
        Definition of the orbital axes.
    """

    table: PlatformTable
    law: Attitude = field(default_factory=Attitude)

    @property
    def first(self) -> float:
        """Start of the span that both orbit and attitude cover, seconds."""
        return float(max(self.table.orbit_time[0], self.table.attitude_time[0], self.table.usable[0]))

    @property
    def last(self) -> float:
        """End of the span that both orbit and attitude cover, seconds."""
        return float(min(self.table.orbit_time[-1], self.table.attitude_time[-1], self.table.usable[1]))

    @property
    def orbit_interval(self) -> float:
        """Median time between orbit readings, seconds."""
        return float(np.median(np.diff(self.table.orbit_time)))

    @property
    def attitude_interval(self) -> float:
        """Median time between readings of the attitude, seconds."""
        return float(np.median(np.diff(self.table.attitude_time)))

    @property
    def interpolation(self) -> Interpolation:
        """Name, for reports, of the method by which positions are interpolated: spline or Lagrange polynomial."""
        widest = float(np.max(np.diff(self.table.orbit_time)[~self._gaps(self.table.orbit_time)], initial=0.0))
        return "spline" if widest**4 * _FOURTH_DERIVATIVE / 384.0 <= _SPLINE_ERROR else "lagrange"

    def covers(self, seconds: ArrayLike) -> np.ndarray:
        """Return whether readings of orbit and attitude cover times (...), which lie within them and not in a gap."""
        t = np.asarray(seconds, dtype=np.float64)
        covered = in_span(t, self.first, self.last)
        for time in (self.table.orbit_time, self.table.attitude_time):
            after = np.clip(np.searchsorted(time, t, side="right") - 1, 0, len(time) - 2)
            begin, end = time[after], time[after + 1]
            # Readings at the ends of a gap are known themselves.
            covered &= ~self._gaps(time)[after] | in_span(t, begin, begin) | in_span(t, end, end)
        return covered

    def position(self, seconds: Any) -> np.ndarray:
        """Return the position in the ITRS at times (...), (..., 3), in metres."""
        return np.asarray(self._position(self._checked(seconds)))

    def velocity(self, seconds: Any) -> np.ndarray:
        """Return the velocity relative to the rotating Earth in axes of the ITRS at times (...), (..., 3), in m/s."""
        return np.asarray(self._velocity(self._checked(seconds)))

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        """Return the velocity relative to the stars in axes of the ITRS at times (...), (..., 3), in m/s."""
        return np.asarray(self.velocity(seconds) + earth_rotation_velocity(self.position(seconds)))

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        """Return the axes of the body as columns at times (...), (..., 3, 3): x_itrs = matrix @ x_body."""
        t = self._checked(seconds)
        matrix = Rotation.from_quat(self._quaternion(np.ravel(t))).as_matrix()
        return np.asarray(matrix).reshape(*t.shape, 3, 3)

    def orbital_to_itrs(self, seconds: Any) -> np.ndarray:
        """Return the axes of the measured orbit's orbital frame as columns at times (...), (..., 3, 3)."""
        motion = self.position(seconds), self.velocity(seconds), self.inertial_velocity(seconds)
        return self.law.orbital_to_itrs(*motion)

    @cached_property
    def _position(self) -> Any:
        return self._joined(self.table.position)

    @cached_property
    def _velocity(self) -> Any:
        if self.table.velocity is not None:
            return self._joined(self.table.velocity)
        interpolation = self._position
        return interpolation.derivative() if isinstance(interpolation, CubicSpline) else interpolation.slope

    @cached_property
    def _quaternion(self) -> CubicSpline:
        return CubicSpline(self.table.attitude_time, self.table.quaternion)

    def _joined(self, values: Array, stride: int = 1) -> Any:
        """Return a function that interpolates every `stride`-th of the values (N, 3) at the N orbit readings."""
        method = CubicSpline if self.interpolation == "spline" else _Lagrange
        return method(self.table.orbit_time[::stride], values[::stride])

    def _checked(self, seconds: Any) -> np.ndarray:
        """Return the times as an array, or raise UnphysicalError if one of them is not covered by readings."""
        t = np.asarray(seconds, dtype=np.float64)
        covered = self.covers(t)
        if not np.all(covered):
            worst = float(np.ravel(t)[int(np.argmin(np.ravel(covered)))])
            where = f"which cover {self.first:.9g} s to {self.last:.9g} s"
            kind = "in a gap of" if in_span(worst, self.first, self.last) else "outside of"
            raise UnphysicalError(f"the time {worst:.9g} s lies {kind} the readings of orbit and attitude, {where}")
        return t

    @cached_property
    def interpolation_error(self) -> float:
        """RMS error of positions halfway between readings, metres, estimated from the table itself.

        Every second reading is omitted, and its deviation from the interpolation of the others is scaled to the full
        table by the order of the interpolation, 4 or 10. The error is zero where the deviation is the noise of the
        readings, which does not grow with the step.
        """
        time, positions = self.table.orbit_time, self.table.position
        step = np.diff(time)
        if len(time) < _LEAST_ROWS or np.any(np.abs(step - np.median(step)) > 0.01 * np.median(step)):
            return 0.0
        errors = []
        for stride in (2, 4):
            joined = self._joined(positions, stride)
            # Stay one interval from the ends, where any interpolation is worse.
            inner = (time > time[stride]) & (time < time[::stride][-2]) & (np.arange(len(time)) % stride == stride // 2)
            errors.append(float(np.sqrt(np.mean(np.sum((joined(time[inner]) - positions[inner]) ** 2, axis=1)))))
        order = 4 if self.interpolation == "spline" else min(_LAGRANGE_NODES, len(time) // 2)
        return errors[0] / 2.0**order if errors[0] > _SURELY or errors[1] > _GROWS * errors[0] else 0.0

    @staticmethod
    def _gaps(time: Array) -> np.ndarray:
        """Return which intervals between N readings are gaps, (N - 1,) bool."""
        step = np.diff(time)
        return np.asarray(step > _GAP * np.median(step))


class _Lagrange:
    """Interpolation of K quantities (N, K) at N times by the polynomial through the readings around each time."""

    def __init__(self, time: Array, values: Array) -> None:
        self._time, self._values = time, values
        self._count = min(_LAGRANGE_NODES, len(time))

    def __call__(self, seconds: Any) -> np.ndarray:
        return self._evaluated(seconds, 0)

    def slope(self, seconds: Any) -> np.ndarray:
        """Return the derivatives of the interpolated quantities with respect to time, per second."""
        return self._evaluated(seconds, 1)

    def _evaluated(self, seconds: Any, order: int) -> np.ndarray:
        """Return the interpolated values (order 0) or their derivatives (order 1)."""
        t = np.ravel(np.asarray(seconds, dtype=np.float64))
        at = np.searchsorted(self._time, t, side="right") - self._count // 2
        at = np.clip(at, 0, len(self._time) - self._count)
        values = np.empty((len(t), self._values.shape[1]))
        for begin in np.unique(at):
            part = slice(begin, begin + self._count)
            middle = self._time[begin + self._count // 2]
            joined = KroghInterpolator(self._time[part] - middle, self._values[part])
            here = at == begin
            values[here] = joined(t[here] - middle) if order == 0 else joined.derivative(t[here] - middle)
        return values.reshape(*np.shape(seconds), self._values.shape[1])
