"""Rigorous model of a three-line camera in orbit (paper 003): collinearity of an image point at its exposure time.

    ground = station + offset + R_body R_bias (position + scale R_camera l),
    l = [-(x - x0)(1 + d), -(y - y0)(1 + d), f],    d = k1 r^2 + k2 r^4,  r from the principal point.

R_body (measured attitude, body to ITRS) and station belong to the exposure time of the image line, R_bias to a field,
R_camera and `position` to a line camera. Solved for the image, the condition of one image point is

    x: (x - x0)(1 + d) + f a / c = 0        y: (y - y0)(1 + d) + f b / c = 0

with (a, b, c) the ground point in the camera's axes (X along the track, Y along the line, Z toward the scene). The
image is the real one: a point at +y sees the scene at -Y. x is the place of the CCD line in the focal plane, normally
0: the measurement of the image line is in the exposure time. An error of one line acts as an error of one pixel in x at
nadir, where lines are spaced as pixels are, and of cos^2 of the look angle (0.82) in the outer lines.

A camera that has drifted since its reference state is turned in its own axes, R_camera Rx(d_beta) Ry(d_alpha)
Rz(d_gamma), and sees with f + d_f: d_gamma is a turn about the line of sight, + d_alpha moves it toward +X, + d_beta
toward -Y.

R_bias = Rx(roll) Ry(pitch) Rz(yaw) about the body's axes. `misclosure` is analytic in all arguments, so that a complex
step through it gives derivatives to rounding; `partials` has them in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array, UndeterminedError

INTERIOR = ("f", "x", "y")
BIAS = ("roll", "pitch", "yaw")
DRIFT = ("d_alpha", "d_beta", "d_gamma", "d_f")
_DRIFT_AXIS = (1, 0, 2)
_NEXT = ((1, 2), (2, 0), (0, 1))
_UNIT = np.eye(3)


@dataclass(frozen=True, eq=False)
class LineModel:
    """One line camera: how it is mounted (known) and its interior orientation (to be calibrated).

    Attributes
    ----------
    to_body : Array
        (3, 3) rotation from the camera's axes to the body's.
    interior : Array
        (3,) principal distance f and principal point x0, y0, metres.
    position : Array
        (3,) projection centre in the body frame, metres.
    k1, k2 : float
        Radial distortion, 1/m^2 and 1/m^4.
    drift : Array
        (4,) d_alpha, d_beta, d_gamma (radians) and d_f (metres) against that state; zero in the reference state.
    half_length : float
        Metres from the middle of the line to its ends, where a change of f moves the image most; 0 where it is not
        known.
    """

    to_body: Array
    interior: Array
    position: Array
    k1: float = 0.0
    k2: float = 0.0
    drift: Array = field(default_factory=lambda: np.zeros(4))
    half_length: float = 0.0

    @classmethod
    def of(
        cls,
        to_body: ArrayLike,
        interior: ArrayLike,
        position: ArrayLike = (0, 0, 0),
        k1: float = 0.0,
        k2: float = 0.0,
        half_length: float = 0.0,
    ) -> LineModel:
        """The model, checked.

        Raises ValueError for shapes, values that are not finite, f <= 0, a to_body that is no rotation, a length
        below zero.

        Parameters
        ----------
        to_body : ArrayLike
            Rotation from the camera's axes to the body's, (3, 3).
        interior : ArrayLike
            f, x0 and y0, (3,), metres.
        position : ArrayLike
            Projection centre in the body frame, (3,), metres.
        k1 : float
            Radial distortion, 1/m^2.
        k2 : float
            Likewise, 1/m^4.
        half_length : float
            From the middle of the line to its ends, metres; 0 where it is not known.
        """
        turn, inner, place = (np.array(v, np.float64) for v in (to_body, interior, position))
        if turn.shape != (3, 3) or inner.shape != (3,) or place.shape != (3,):
            raise ValueError("line model: to_body must be (3, 3), interior and position (3,)")
        if (
            not np.all(np.isfinite(np.concatenate([turn.ravel(), inner, place, [k1, k2, half_length]])))
            or inner[0] <= 0
        ):
            raise ValueError("line model: all numbers must be finite and f positive")
        if half_length < 0:
            raise ValueError("line model: half the length of a line is not below zero")
        if not (np.allclose(turn @ turn.T, np.eye(3), atol=1e-9) and np.linalg.det(turn) > 0):
            raise ValueError("line model: to_body must be a rotation")
        return cls(turn, inner, place, float(k1), float(k2), half_length=float(half_length))

    def with_interior(self, interior: ArrayLike) -> LineModel:
        """The camera with another f, x0, y0."""
        return replace(self, interior=np.array(interior, np.float64))

    def drifted(self, drift: ArrayLike) -> LineModel:
        """The camera in another state: (4,) d_alpha, d_beta, d_gamma, d_f against the reference state.

        It replaces an earlier drift. Raises ValueError for another shape.
        """
        change = np.asarray(drift)
        if change.shape != (4,):
            raise ValueError(f"line model: a drift is (4,) {', '.join(DRIFT)}, found {change.shape}")
        return replace(self, drift=change)

    @cached_property
    def axes(self) -> Array:
        """(3, 3) rotation from the axes of the drifted camera to the body's."""
        return np.asarray(self.to_body @ self._turned)

    @property
    def principal_distance(self) -> Array:
        """Principal distance of the drifted camera, metres."""
        return np.asarray(self.interior[0] + self.drift[3])

    def directions(self, image: Array) -> Array:
        """(n, 3) unit vectors in the body frame that image points (n, 2) look along."""
        at = image - self.interior[1:]
        square = np.sum(at**2, axis=1)
        at = at * (1.0 + square * (self.k1 + self.k2 * square))[:, None]
        look = np.column_stack([-at, np.full(len(at), self.principal_distance)]) @ self.axes.T
        return np.asarray(look / np.linalg.norm(look, axis=1, keepdims=True))

    def seen(self, body: Array, image: Array) -> Seen:
        """What image points see of places in the body frame.

        Parameters
        ----------
        body : Array
            Ground points from the body's origin, in its true axes, (n, 3), metres.
        image : Array
            x and y in the focal plane, (n, 2), metres.

        Raises
        ------
        UndeterminedError
            a ground point behind a camera.
        """
        f, mounted = self.principal_distance, (body - self.position) @ self.to_body
        a, b, c = np.ascontiguousarray((mounted @ self._turned).T)
        if np.any(c <= 0):
            raise UndeterminedError("three-line model: a ground point lies behind a camera")
        place = image - self.interior[1:]
        square = np.sum(place**2, axis=1)
        grown = 1.0 + square * (self.k1 + self.k2 * square)
        along = np.stack([a / c, b / c], axis=1)
        own = np.zeros((len(c), 2, 3), np.result_type(c, f))
        own[:, 0, 0] = own[:, 1, 1] = f / c
        own[:, :, 2] = (-f / c)[:, None] * along
        swung = np.concatenate(self._turned_slopes, axis=1)
        swung = (mounted @ swung).reshape(-1, 3, 3).swapaxes(1, 2)
        by_drift = np.concatenate([own @ swung, along[:, :, None]], axis=2)
        return Seen(place * grown[:, None] + f * along, (own.reshape(-1, 3) @ self.axes.T).reshape(-1, 2, 3), by_drift)

    @cached_property
    def _turned(self) -> Array:
        """Rx(d_beta) Ry(d_alpha) Rz(d_gamma)."""
        return bias_rotation(self._turns)

    @cached_property
    def _turned_slopes(self) -> tuple[Array, ...]:
        """Its derivatives by d_alpha, d_beta, d_gamma."""
        slopes = _rotation_slopes(self._turns)
        return tuple(slopes[axis] for axis in _DRIFT_AXIS)

    @property
    def _turns(self) -> Array:
        """(3,) of the drift about x, y and z."""
        turns = np.empty(3, self.drift.dtype)
        turns[list(_DRIFT_AXIS)] = self.drift[:3]
        return turns


@dataclass(frozen=True, eq=False)
class Seen:
    """Misclosures (n, 2) of image points, metres in the image as of `misclosure`, and their derivatives: (n, 2, 3) by
    the place in the body frame, (n, 2, 4) by d_alpha, d_beta, d_gamma, d_f.
    """

    miss: Array
    by_body: Array
    by_drift: Array


@dataclass(frozen=True, eq=False)
class Rays:
    """Image points of one line camera with the measured station and attitude of their exposure times.

    Attributes
    ----------
    point : NDArray[np.intp]
        (n,) which ground point each of them shows.
    image : Array
        (n, 2) x and y in the focal plane, metres, counted from the line's centre.
    station : Array
        (n, 3) of the body's origin, ITRS, metres.
    attitude : Array
        (n, 3, 3) body to ITRS.
    time : Array | None
        (n,) of the exposures, seconds, on the scale of the readings of attitude and station; None where unknown, the
        rays' noise then counts as independent.
    spread : Array | None
        (n, 2, 2) covariance of the image points in units of `Noise.image` squared; None for unit matrices.
    """

    point: NDArray[np.intp]
    image: Array
    station: Array
    attitude: Array
    time: Array | None = None
    spread: Array | None = None

    @classmethod
    def of(
        cls, point: ArrayLike, image: ArrayLike, station: ArrayLike, attitude: ArrayLike, time: ArrayLike | None = None
    ) -> Rays:
        """The rays, checked.

        Raises ValueError for shapes that do not match, values that are not finite, points shown twice.

        Parameters
        ----------
        point : ArrayLike
            Which ground point each of n rays shows, (n,).
        image : ArrayLike
            x and y in the focal plane, (n, 2), metres.
        station : ArrayLike
            Of the body's origin, ITRS, (n, 3), metres.
        attitude : ArrayLike
            Body to ITRS, (n, 3, 3).
        time : ArrayLike | None
            Of the exposures, (n,), seconds; None where unknown.
        """
        which = np.array(point)
        if which.ndim != 1 or (which.size and not np.issubdtype(which.dtype, np.integer)):
            raise ValueError("rays: point must be a row of whole numbers")
        n = len(which)
        moments = np.zeros(n) if time is None else time
        rows = [np.array(v, np.float64) for v in (image, station, attitude, moments)]
        shapes = [(n, 2), (n, 3), (n, 3, 3), (n,)]
        for what, row, shape in zip(("image", "station", "attitude", "time"), rows, shapes, strict=True):
            if row.shape != shape:
                raise ValueError(f"rays: {what} must be {shape} for {n} points, found {row.shape}")
            bad = np.flatnonzero(~np.isfinite(row.reshape(n, -1)).all(axis=1))
            if len(bad):
                raise ValueError(f"rays: {what} of ray {bad[0]} is not finite; leave out what was not measured")
        if len(np.unique(which)) != n:
            raise ValueError("rays: a point appears twice in one line")
        places, stations, attitudes, times = rows
        return cls(which.astype(np.intp), places, stations, attitudes, None if time is None else times)

    def taken(self, keep: ArrayLike) -> Rays:
        """Some of the rays, by mask or index."""
        where = np.asarray(keep)
        time, spread = (None if v is None else v[where] for v in (self.time, self.spread))
        return Rays(self.point[where], self.image[where], self.station[where], self.attitude[where], time, spread)


@dataclass(frozen=True, eq=False)
class Partials:
    """Derivatives of `misclosure`, (n, 2, 3): interior by f, x0, y0; bias by roll, pitch, yaw; ground by the point
    (by the station: its negative); attitude by a small turn of the measured attitude about the body's axes; drift,
    (n, 2, 4), by d_alpha, d_beta, d_gamma, d_f.
    """

    interior: Array
    bias: Array
    ground: Array
    attitude: Array
    drift: Array


def bias_rotation(bias: ArrayLike) -> Array:
    """(3, 3) Rx(roll) Ry(pitch) Rz(yaw) from (3,) radians."""
    roll, pitch, yaw = np.asarray(bias)
    return np.asarray(_turn(0, roll) @ _turn(1, pitch) @ _turn(2, yaw))


def _rotation_slopes(bias: Array) -> list[Array]:
    """Derivatives of `bias_rotation` by roll, pitch and yaw."""
    turns = [_turn(axis, angle) for axis, angle in enumerate(bias)]
    out = []
    for axis, angle in enumerate(bias):
        chain = [*turns]
        chain[axis] = _turn_slope(axis, angle)
        out.append(chain[0] @ chain[1] @ chain[2])
    return out


def misclosure(camera: LineModel, rays: Rays, ground: Array, bias: Array, offset: Array) -> Array:
    """Left sides of the two conditions, metres in the image: (n, 2), zero for perfect data.

    Parameters
    ----------
    camera : LineModel
        Interior and mounting of the line.
    rays : Rays
        n image points.
    ground : Array
        (n, 3) of each ray's point, ITRS.
    bias : Array
        (3,) radians.
    offset : Array
        (3,) of the station, ITRS, metres.
    """
    f, (x0, y0) = camera.principal_distance, camera.interior[1:]
    q = np.einsum("nji,nj->ni", rays.attitude, ground - rays.station - offset)
    seen = (q @ bias_rotation(bias) - camera.position) @ camera.axes
    x, y = rays.image[:, 0] - x0, rays.image[:, 1] - y0
    square = x * x + y * y
    grown = 1.0 + square * (camera.k1 + camera.k2 * square)
    return np.stack([x * grown + f * seen[:, 0] / seen[:, 2], y * grown + f * seen[:, 1] / seen[:, 2]], axis=-1)


def partials(camera: LineModel, rays: Rays, ground: Array, bias: Array, offset: Array) -> Partials:
    """Derivatives of `misclosure` in closed form.

    Parameters
    ----------
    camera : LineModel
        Interior and mounting of the line.
    rays : Rays
        n image points.
    ground : Array
        (n, 3) of each ray's point, ITRS, metres.
    bias : Array
        Of the attitude, (3,), radians.
    offset : Array
        Of the station, (3,), ITRS, metres.

    Raises
    ------
    ValueError
        a ground point behind a camera.
    """
    q = np.einsum("nji,nj->ni", rays.attitude, ground - rays.station - offset)
    turn = bias_rotation(bias)
    seen = camera.seen(q @ turn, rays.image)
    x, y = (rays.image - camera.interior[1:]).T
    square = x * x + y * y
    grown = 1.0 + square * (camera.k1 + camera.k2 * square)
    slope = 2.0 * (camera.k1 + 2.0 * camera.k2 * square)
    interior = np.empty((len(x), 2, 3), np.result_type(seen.by_drift, x))
    interior[:, :, 0] = seen.by_drift[:, :, 3]
    interior[:, 0, 1], interior[:, 1, 2] = -(grown + slope * x * x), -(grown + slope * y * y)
    interior[:, 1, 1] = interior[:, 0, 2] = -(slope * x * y)
    turned = np.stack([q @ by_bias for by_bias in _rotation_slopes(bias)], axis=-1)
    to_measured = seen.by_body @ turn.T  # by the point in the body frame of the measured attitude
    spun = np.stack([np.cross(q, axis) for axis in _UNIT], axis=-1)
    return Partials(
        interior=interior,
        bias=seen.by_body @ turned,
        ground=to_measured @ np.swapaxes(rays.attitude, 1, 2),
        attitude=to_measured @ spun,
        drift=seen.by_drift,
    )


def _turn(axis: int, angle: float | complex) -> np.ndarray:
    """Right-handed rotation about a coordinate axis; the angle may be complex."""
    i, j = _NEXT[axis]
    cos, sin = np.cos(angle), np.sin(angle)
    turn = _UNIT.astype(complex) if np.iscomplexobj(angle) else _UNIT.copy()
    turn[i, i] = turn[j, j] = cos
    turn[i, j], turn[j, i] = -sin, sin
    return turn


def _turn_slope(axis: int, angle: float) -> Array:
    """Derivative of `_turn` by the angle."""
    slope = _turn(axis, angle + 0.5 * np.pi)
    slope[axis, axis] = 0.0
    return slope
