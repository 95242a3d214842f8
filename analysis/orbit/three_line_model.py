"""Rigorous model of a three-line camera in orbit (paper 003, Mo et al. 2015): collinearity at the exposure time.

    ground = station + offset + R_body R_bias (position + scale R_camera l),

    l = [-(x - x0)(1 + d), -(y - y0)(1 + d), f],    d = k1 r^2 + k2 r^4,  r from the principal point.

R_body (measured attitude, body to ITRS) and station belong to the exposure time of the image line, R_bias to a field,
R_camera and `position` to a line camera. Solved for the image, the condition of one image point is

    x: (x - x0)(1 + d) + f a / c = 0        y: (y - y0)(1 + d) + f b / c = 0

with (a, b, c) the ground point in the camera's axes (X along the track, Y along the line, Z toward the scene). Image
coordinates are those of the real, inverted image: a point at +y sees the scene at -Y. x is the position of the CCD line
in the focal plane, normally 0: the measurement of the image line is in the exposure time. An error of one image line
acts as an error of one pixel in x at nadir, where lines have the spacing of pixels, and of cos^2 of the look angle
(0.82) in the outer lines.

A camera that has drifted since its reference state is rotated in its own axes, R_camera Rx(d_beta) Ry(d_alpha)
Rz(d_gamma), and has the principal distance f + d_f: d_gamma is a rotation about the line of sight, + d_alpha moves it
toward +X, + d_beta toward -Y.

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
    """Line camera with its known mounting and its interior orientation, which is to be calibrated.

    Attributes
    ----------
    to_body : (3, 3) ndarray
        Rotation from the camera's axes to the body's.
    interior : (3,) ndarray
        Principal distance f and principal point x0, y0, in metres.
    position : (3,) ndarray
        Projection centre in the body frame, in metres.
    k1, k2 : float
        Radial distortion, in 1/m^2 and 1/m^4.
    drift : (4,) ndarray
        d_alpha, d_beta, d_gamma (radians) and d_f (metres) against the reference state; zero in that state.
    half_length : float
        Distance from the middle of the line to its ends, where a change of f moves the image most, in metres; 0 if
        unknown.

    Examples
    --------
    A camera that looks 20 deg forward. Its axis, and a change of its pitch by 1 mrad:

    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> import analysis
    >>> mount = Rotation.from_euler("Y", 20, degrees=True).as_matrix()
    >>> camera = analysis.LineModel.of(mount, interior=[1.7, 0.0, 0.0])
    >>> np.round(camera.directions(np.zeros((1, 2))), 4)
    array([[0.342 , 0.    , 0.9397]])
    >>> tilted = camera.drifted([1e-3, 0, 0, 0]).directions(np.zeros((1, 2)))
    >>> round(float(np.degrees(np.arctan2(tilted[0, 0], tilted[0, 2]))), 4)
    20.0573
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
        """Return the model of a line camera after checking its values.

        Parameters
        ----------
        to_body : (3, 3) array_like
            Rotation from the camera's axes to the body's.
        interior : (3,) array_like
            f, x0 and y0, in metres.
        position : (3,) array_like
            Projection centre in the body frame, in metres.
        k1 : float
            Radial distortion, in 1/m^2.
        k2 : float
            Radial distortion, in 1/m^4.
        half_length : float
            Distance from the middle of the line to its ends, in metres; 0 if unknown.

        Raises
        ------
        ValueError
            A shape is wrong, a value is not finite, f is not positive, to_body is not a rotation, or the length is
            negative.
        """
        rotation, interior_values, centre = (np.array(v, np.float64) for v in (to_body, interior, position))
        if rotation.shape != (3, 3) or interior_values.shape != (3,) or centre.shape != (3,):
            raise ValueError("line model: to_body must be (3, 3), interior and position (3,)")
        if (
            not np.all(np.isfinite(np.concatenate([rotation.ravel(), interior_values, centre, [k1, k2, half_length]])))
            or interior_values[0] <= 0
        ):
            raise ValueError("line model: all numbers must be finite and f positive")
        if half_length < 0:
            raise ValueError("line model: half_length must not be negative")
        if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0):
            raise ValueError("line model: to_body must be a rotation")
        return cls(rotation, interior_values, centre, float(k1), float(k2), half_length=float(half_length))

    def with_interior(self, interior: ArrayLike) -> LineModel:
        """Return the camera with its interior orientation replaced: f, x0, y0 in metres."""
        return replace(self, interior=np.array(interior, np.float64))

    def drifted(self, drift: ArrayLike) -> LineModel:
        """Return the camera after a drift from its reference state: d_alpha, d_beta, d_gamma (radians), d_f (metres).

        The drift replaces an earlier one.

        Raises
        ------
        ValueError
            The shape is not (4,).
        """
        change = np.asarray(drift)
        if change.shape != (4,):
            raise ValueError(f"line model: a drift is (4,) {', '.join(DRIFT)}, found {change.shape}")
        return replace(self, drift=change)

    @cached_property
    def axes(self) -> Array:
        """Rotation (3, 3) from the axes of the drifted camera to the body's."""
        return np.asarray(self.to_body @ self._rotated)

    @property
    def principal_distance(self) -> Array:
        """Principal distance of the drifted camera, f + d_f, in metres."""
        return np.asarray(self.interior[0] + self.drift[3])

    def directions(self, image: Array) -> Array:
        """Return the unit vectors toward the scene, in the body frame, (n, 3), of n image points."""
        at = image - self.interior[1:]
        square = np.sum(at**2, axis=1)
        at = at * (1.0 + square * (self.k1 + self.k2 * square))[:, None]
        look = np.column_stack([-at, np.full(len(at), self.principal_distance)]) @ self.axes.T
        return np.asarray(look / np.linalg.norm(look, axis=1, keepdims=True))

    def seen(self, body: Array, image: Array) -> Seen:
        """Return collinearity misclosures of image points, with derivatives, for ground points in the body frame.

        Parameters
        ----------
        body : (n, 3) ndarray
            Ground points, n of them, from the body's origin, in its true axes, in metres.
        image : (n, 2) ndarray
            x and y in the focal plane, in metres.

        Raises
        ------
        UndeterminedError
            A ground point is behind the camera.
        """
        f, mounted = self.principal_distance, (body - self.position) @ self.to_body
        a, b, c = np.ascontiguousarray((mounted @ self._rotated).T)
        if np.any(c <= 0):
            raise UndeterminedError("three-line model: a ground point lies behind a camera")
        position = image - self.interior[1:]
        square = np.sum(position**2, axis=1)
        scale = 1.0 + square * (self.k1 + self.k2 * square)
        along = np.stack([a / c, b / c], axis=1)
        by_camera = np.zeros((len(c), 2, 3), np.result_type(c, f))
        by_camera[:, 0, 0] = by_camera[:, 1, 1] = f / c
        by_camera[:, :, 2] = (-f / c)[:, None] * along
        slopes = np.concatenate(self._rotated_slopes, axis=1)
        slopes = (mounted @ slopes).reshape(-1, 3, 3).swapaxes(1, 2)
        by_drift = np.concatenate([by_camera @ slopes, along[:, :, None]], axis=2)
        return Seen(
            position * scale[:, None] + f * along, (by_camera.reshape(-1, 3) @ self.axes.T).reshape(-1, 2, 3), by_drift
        )

    @cached_property
    def _rotated(self) -> Array:
        """Rotation matrix (3, 3) of the camera's drift: Rx(d_beta) Ry(d_alpha) Rz(d_gamma)."""
        return bias_rotation(self._angles)

    @cached_property
    def _rotated_slopes(self) -> tuple[Array, ...]:
        """Derivatives of the drift's rotation matrix with respect to d_alpha, d_beta, d_gamma, per radian."""
        slopes = _rotation_slopes(self._angles)
        return tuple(slopes[axis] for axis in _DRIFT_AXIS)

    @property
    def _angles(self) -> Array:
        """Rotation angles (3,) of the drift about x, y and z, in radians."""
        angles = np.empty(3, self.drift.dtype)
        angles[list(_DRIFT_AXIS)] = self.drift[:3]
        return angles


@dataclass(frozen=True, eq=False)
class Seen:
    """Collinearity misclosures of n image points, with derivatives with respect to ground points and camera drift.

    Attributes
    ----------
    miss : (n, 2) ndarray
        Misclosures, in metres in the image, as from `misclosure`.
    by_body : (n, 2, 3) ndarray
        Derivatives of the misclosures with respect to the ground point in the body frame, dimensionless.
    by_drift : (n, 2, 4) ndarray
        Derivatives of the misclosures with respect to d_alpha, d_beta, d_gamma (m/rad) and d_f (dimensionless).
    """

    miss: Array
    by_body: Array
    by_drift: Array


@dataclass(frozen=True, eq=False)
class Rays:
    """Image points of one line camera with the measured station and attitude at their exposure times.

    Attributes
    ----------
    point : (n,) ndarray of int
        Index of the ground point that each ray shows.
    image : (n, 2) ndarray
        x and y in the focal plane, from the line's centre, in metres.
    station : (n, 3) ndarray
        Position of the body's origin, ITRS, in metres.
    attitude : (n, 3, 3) ndarray
        Rotation from the body to ITRS.
    time : (n,) ndarray or None
        Exposure times, in seconds, on the time scale of the attitude and station readings. None if unknown; the rays'
        noise then counts as independent.
    spread : (n, 2, 2) ndarray or None
        Covariance of the image points in units of `Noise.image` squared; None for unit matrices.

    Examples
    --------
    Two image points of one line at one moment, from a station on the Earth-fixed X axis:

    >>> import numpy as np
    >>> import analysis
    >>> station = np.tile([6.878e6, 0.0, 0.0], (2, 1))
    >>> attitude = np.tile(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), (2, 1, 1))
    >>> rays = analysis.Rays.of([0, 1], [[0.0, -0.02], [0.0, 0.02]], station, attitude, time=[0.0, 0.0])
    >>> rays.image.shape, rays.taken([True, False]).point
    ((2, 2), array([0]))
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
        """Return image points with station and attitude after checking shapes and values.

        Parameters
        ----------
        point : (n,) array_like of int
            Index of the ground point that each ray shows.
        image : (n, 2) array_like
            x and y in the focal plane, in metres.
        station : (n, 3) array_like
            Position of the body's origin, ITRS, in metres.
        attitude : (n, 3, 3) array_like
            Rotation from the body to ITRS.
        time : (n,) array_like, optional
            Exposure times, in seconds; unknown by default.

        Raises
        ------
        ValueError
            Shapes do not match, a value is not finite, or a point appears twice.
        """
        which = np.array(point)
        if which.ndim != 1 or (which.size and not np.issubdtype(which.dtype, np.integer)):
            raise ValueError("rays: point must be a one-dimensional array of integers")
        n = len(which)
        moments = np.zeros(n) if time is None else time
        rows = [np.array(v, np.float64) for v in (image, station, attitude, moments)]
        shapes = [(n, 2), (n, 3), (n, 3, 3), (n,)]
        for what, row, shape in zip(("image", "station", "attitude", "time"), rows, shapes, strict=True):
            if row.shape != shape:
                raise ValueError(f"rays: {what} must be {shape} for {n} points, found {row.shape}")
            bad = np.flatnonzero(~np.isfinite(row.reshape(n, -1)).all(axis=1))
            if len(bad):
                raise ValueError(f"rays: {what} of ray {bad[0]} is not finite; exclude what was not measured")
        if len(np.unique(which)) != n:
            raise ValueError("rays: a point appears twice in one line")
        images, stations, attitudes, times = rows
        return cls(which.astype(np.intp), images, stations, attitudes, None if time is None else times)

    def taken(self, keep: ArrayLike) -> Rays:
        """Return the rays that a boolean mask or an array of indices selects."""
        where = np.asarray(keep)
        time, spread = (None if v is None else v[where] for v in (self.time, self.spread))
        return Rays(self.point[where], self.image[where], self.station[where], self.attitude[where], time, spread)


@dataclass(frozen=True, eq=False)
class Partials:
    """Derivatives of the collinearity misclosures (metres in the image) of n image points.

    Attributes
    ----------
    interior : (n, 2, 3) ndarray
        Derivatives with respect to f, x0, y0.
    bias : (n, 2, 3) ndarray
        Derivatives with respect to roll, pitch, yaw.
    ground : (n, 2, 3) ndarray
        Derivatives with respect to the ground point; those with respect to the station are their negatives.
    attitude : (n, 2, 3) ndarray
        Derivatives with respect to a small rotation of the measured attitude about the body's axes.
    drift : (n, 2, 4) ndarray
        Derivatives with respect to d_alpha, d_beta, d_gamma, d_f.
    """

    interior: Array
    bias: Array
    ground: Array
    attitude: Array
    drift: Array


def bias_rotation(bias: ArrayLike) -> Array:
    """Return the (3, 3) rotation Rx(roll) Ry(pitch) Rz(yaw) of a bias (3,), in radians."""
    roll, pitch, yaw = np.asarray(bias)
    return np.asarray(_axis_rotation(0, roll) @ _axis_rotation(1, pitch) @ _axis_rotation(2, yaw))


def _rotation_slopes(bias: Array) -> list[Array]:
    """Return the derivatives of the bias rotation matrix with respect to roll, pitch and yaw, 1/rad."""
    rotations = [_axis_rotation(axis, angle) for axis, angle in enumerate(bias)]
    out = []
    for axis, angle in enumerate(bias):
        chain = [*rotations]
        chain[axis] = _axis_rotation_slope(axis, angle)
        out.append(chain[0] @ chain[1] @ chain[2])
    return out


def misclosure(camera: LineModel, rays: Rays, ground: Array, bias: Array, offset: Array) -> Array:
    """Return the (n, 2) left sides of the collinearity conditions, in metres in the image; zero for perfect data.

    Parameters
    ----------
    camera : LineModel
        Interior orientation and mounting of the line.
    rays : Rays
        Image points, n of them.
    ground : (n, 3) ndarray
        Ground point of each ray, ITRS, in metres.
    bias : (3,) ndarray
        Attitude bias, in radians.
    offset : (3,) ndarray
        Offset of the station, ITRS, in metres.
    """
    f, (x0, y0) = camera.principal_distance, camera.interior[1:]
    q = np.einsum("nji,nj->ni", rays.attitude, ground - rays.station - offset)
    camera_frame = (q @ bias_rotation(bias) - camera.position) @ camera.axes
    x, y = rays.image[:, 0] - x0, rays.image[:, 1] - y0
    square = x * x + y * y
    scale = 1.0 + square * (camera.k1 + camera.k2 * square)
    return np.stack(
        [
            x * scale + f * camera_frame[:, 0] / camera_frame[:, 2],
            y * scale + f * camera_frame[:, 1] / camera_frame[:, 2],
        ],
        axis=-1,
    )


def partials(camera: LineModel, rays: Rays, ground: Array, bias: Array, offset: Array) -> Partials:
    """Return the analytic derivatives of the collinearity misclosures with respect to all parameters.

    Parameters
    ----------
    camera : LineModel
        Interior orientation and mounting of the line.
    rays : Rays
        Image points, n of them.
    ground : (n, 3) ndarray
        Ground point of each ray, ITRS, in metres.
    bias : (3,) ndarray
        Attitude bias, in radians.
    offset : (3,) ndarray
        Offset of the station, ITRS, in metres.

    Raises
    ------
    UndeterminedError
        A ground point is behind the camera.
    """
    q = np.einsum("nji,nj->ni", rays.attitude, ground - rays.station - offset)
    rotation = bias_rotation(bias)
    projection = camera.seen(q @ rotation, rays.image)
    x, y = (rays.image - camera.interior[1:]).T
    square = x * x + y * y
    scale = 1.0 + square * (camera.k1 + camera.k2 * square)
    slope = 2.0 * (camera.k1 + 2.0 * camera.k2 * square)
    interior = np.empty((len(x), 2, 3), np.result_type(projection.by_drift, x))
    interior[:, :, 0] = projection.by_drift[:, :, 3]
    interior[:, 0, 1], interior[:, 1, 2] = -(scale + slope * x * x), -(scale + slope * y * y)
    interior[:, 1, 1] = interior[:, 0, 2] = -(slope * x * y)
    rotated = np.stack([q @ by_bias for by_bias in _rotation_slopes(bias)], axis=-1)
    to_measured = (
        projection.by_body @ rotation.T
    )  # with respect to the point in the body frame of the measured attitude
    by_rotation = np.stack([np.cross(q, axis) for axis in _UNIT], axis=-1)
    return Partials(
        interior=interior,
        bias=projection.by_body @ rotated,
        ground=to_measured @ np.swapaxes(rays.attitude, 1, 2),
        attitude=to_measured @ by_rotation,
        drift=projection.by_drift,
    )


def _axis_rotation(axis: int, angle: float | complex) -> np.ndarray:
    """Return the right-handed rotation about a coordinate axis; the angle may be complex."""
    i, j = _NEXT[axis]
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = _UNIT.astype(complex) if np.iscomplexobj(angle) else _UNIT.copy()
    matrix[i, i] = matrix[j, j] = cos
    matrix[i, j], matrix[j, i] = -sin, sin
    return matrix


def _axis_rotation_slope(axis: int, angle: float) -> Array:
    """Return the derivative of the rotation about a coordinate axis with respect to its angle, (3, 3), 1/rad."""
    slope = _axis_rotation(axis, angle + 0.5 * np.pi)
    slope[axis, axis] = 0.0
    return slope
