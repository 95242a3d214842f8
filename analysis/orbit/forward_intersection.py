"""Forward intersection of points without ground control, also from line cameras corrected by their on-board monitor.

Each ray weighs by what noise of image, attitude and station does in its image. The covariance is that of this noise,
for each point by itself: that points exposed within a few readings of the attitude share errors is not in it, and is
what `strip_adjustment` uses. Errors of the calibration, which all points share, are in neither.

The monitor says how the line of sight has turned since the calibration (d_alpha about the camera's Y, d_beta about X,
d_gamma about the line of sight) and how the principal distance has grown (d_f). A calibrated look (x, y, z) in the
camera's axes becomes

    Ry(d_alpha) Rx(d_beta) Rz(d_gamma) (x, y f / (f + d_f), z),

which gives the corrected line exactly these four changes as docs/conventions.md defines them: the line of sight is
turned first about the calibrated camera's Y, then about the turned X; a longer f makes the angles along the line
smaller. What the four cannot say, such as a change of distortion, stays as it was calibrated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.measurement_error import MeasurementError
from analysis.orbit.calibration_parameters import CalibrationError, Noise, vertical
from analysis.orbit.ray_noise import ray_covariance
from analysis.orbit.three_line_model import LineModel, Rays, bias_rotation, misclosure, partials

_STEPS = 10
_CONVERGED = 1e-6  # metres; coordinates of 6.4e6 m are rounded to 1e-9 m
# Two rays at less than one arc minute do not meet: a base of 150 m under 500 km.
_PARALLEL = 3e-4


@dataclass(frozen=True, eq=False)
class Intersection:
    """Intersected points.

    Attributes:
        ground: (m, 3) ITRS, metres; NaN where fewer than two rays see a point.
        covariance: (m, 3, 3).
        rays: (m,) how many see it.
        chi_square: (m,) of its rays; degrees of freedom 2 rays - 3.
    """

    ground: Array
    covariance: Array
    rays: NDArray[np.intp]
    chi_square: Array


@dataclass(frozen=True, eq=False)
class CheckErrors:
    """Found minus given at check points: error (m, 3) east, north, up; RMS in plan (both axes) and height, metres."""

    error: Array
    plan_rms: float
    height_rms: float
    count: int


def intersect(
    rays: Mapping[str, Rays],
    cameras: Mapping[str, LineModel],
    noise: Noise,
    *,
    bias: ArrayLike = (0.0, 0.0, 0.0),
    offset: ArrayLike = (0.0, 0.0, 0.0),
    count: int | None = None,
) -> Intersection:
    """Points of one pass from the rays of all lines.

    Args:
        rays: line -> its image points.
        cameras: line -> calibrated camera, in its state during this pass (`LineModel.drifted`).
        noise: of image, attitude and station.
        bias: (3,) roll, pitch, yaw, radians.
        offset: (3,) of the station, ITRS, metres.
        count: of points; from the rays where not given.

    Raises:
        CalibrationError: no point with two rays, rays that are parallel, no convergence.
    """
    turn, shift, small = bias_rotation(bias), np.asarray(offset, np.float64), np.asarray(bias, np.float64)
    total = count or 1 + max((int(r.point.max()) for r in rays.values() if r.point.size), default=-1)
    seen = np.zeros(max(total, 0), np.intp)
    for row in rays.values():
        np.add.at(seen, row.point, 1)
    good = seen >= 2
    if not np.any(good):
        raise CalibrationError("forward intersection: no point is seen by two lines")
    ground = _start(rays, cameras, turn, shift, good)
    for _ in range(_STEPS):
        normal, right, square = np.zeros((total, 3, 3)), np.zeros((total, 3)), np.zeros(total)
        for line, row in rays.items():
            used = row.taken(good[row.point])
            shown = ground[used.point]
            by = partials(cameras[line], used, shown, small, shift)
            white = np.linalg.inv(np.linalg.cholesky(ray_covariance(noise, used, by, shared=True)))
            design = white @ by.ground
            miss = np.einsum("nij,nj->ni", white, misclosure(cameras[line], used, shown, small, shift))
            np.add.at(normal, used.point, np.swapaxes(design, 1, 2) @ design)
            np.add.at(right, used.point, np.einsum("nij,ni->nj", design, miss))
            np.add.at(square, used.point, np.sum(miss**2, axis=1))
        step = -np.linalg.solve(normal[good], right[good][..., None])[..., 0]
        ground[good] += step
        if np.abs(step).max() < _CONVERGED:
            break
    else:
        raise CalibrationError(f"forward intersection: no convergence, the last step is {np.abs(step).max():.3g} m")
    covariance = np.full((total, 3, 3), np.nan)
    covariance[good] = np.linalg.inv(normal[good])
    return Intersection(ground, covariance, seen, np.where(good, square, np.nan))


def check_errors(found: Array, given: ArrayLike) -> CheckErrors:
    """Errors (m, 3) of found points against given ones, ITRS, metres; points that were not found do not count.

    Raises:
        CalibrationError: shapes differ, given coordinates are not finite, no points.
    """
    truth = np.asarray(given, np.float64)
    if truth.shape != found.shape or not np.all(np.isfinite(truth)):
        raise CalibrationError(f"check points: need {found.shape} finite coordinates, found {truth.shape}")
    good = np.isfinite(found).all(axis=1)
    if not np.any(good):
        raise CalibrationError("check points: none was intersected")
    up = vertical(truth[good])
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    axes = np.stack([east, np.cross(up, east), up], axis=1)
    error = np.full_like(truth, np.nan)
    error[good] = np.einsum("nij,nj->ni", axes, found[good] - truth[good])
    square = np.mean(error[good] ** 2, axis=0)
    return CheckErrors(error, float(np.sqrt(square[0] + square[1])), float(np.sqrt(square[2])), int(good.sum()))


def _start(
    rays: Mapping[str, Rays], cameras: Mapping[str, LineModel], turn: Array, shift: Array, good: NDArray[np.bool_]
) -> Array:
    """Points nearest to their rays as lines in space."""
    normal, right = np.zeros((len(good), 3, 3)), np.zeros((len(good), 3))
    for line, row in rays.items():
        camera = cameras[line]
        look = np.einsum("nij,nj->ni", row.attitude, camera.directions(row.image) @ turn.T)
        origin = row.station + shift + np.einsum("nij,j->ni", row.attitude, turn @ camera.position)
        across = np.eye(3) - look[:, :, None] * look[:, None, :]
        np.add.at(normal, row.point, across)
        np.add.at(right, row.point, np.einsum("nij,nj->ni", across, origin))
    smallest = np.linalg.eigvalsh(normal[good])[:, 0]
    if np.any(smallest < _PARALLEL**2 / 2):
        which = np.flatnonzero(good)[np.argmin(smallest)]
        raise CalibrationError(f"forward intersection: the rays of point {which} are parallel")
    ground = np.full((len(good), 3), np.nan)
    ground[good] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    return ground


"""Radians; two rays at less than one arc minute do not meet."""


class IntersectionError(MeasurementError, ValueError):
    """Points cannot be intersected."""


@dataclass(frozen=True, eq=False)
class CalibratedLine:
    """What a calibration knows of a line camera.

    Attributes:
        pixels: of the line; the centre of the first is 0.
        directions: (K, 3) Chebyshev coefficients over the line, from -0.5 to pixels - 0.5, of a vector along the look
            in the body's axes; its length does not matter.
        origins: (J, 3) those of a point on the look, body frame, metres.
        axes: (3, 3) columns X, Y, Z of the camera in the body: Y along the line, Z the line of sight.
        principal_distance: f, metres.
    """

    pixels: int
    directions: Array
    origins: Array
    axes: Array
    principal_distance: float

    def corrected(self, change: ArrayLike) -> CalibratedLine:
        """The line after a change.

        change: (4,) d_alpha, d_beta, d_gamma (rad) and d_f (m) since the calibration.
        Raises ValueError for another shape, numbers that are not finite, and a principal distance of zero or less.
        """
        values = np.asarray(change, np.float64)
        if values.shape != (4,) or not np.all(np.isfinite(values)):
            raise ValueError(f"corrected line: need four finite numbers, found {values!r}")
        distance = self.principal_distance + float(values[3])
        if distance <= 0.0:
            raise ValueError("corrected line: the principal distance must stay positive")
        shrunk = np.diag([1.0, self.principal_distance / distance, 1.0])
        matrix = self.axes @ _turned(*values[:3]) @ shrunk @ self.axes.T
        return replace(self, directions=self.directions @ matrix.T, principal_distance=distance)

    def look(self, pixel: Array) -> Array:
        """(n, 3) unit directions toward the scene in the body's axes, of pixels (n,)."""
        vector = self._series(self.directions, pixel)
        return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))

    def origin(self, pixel: Array) -> Array:
        """(n, 3) points on the looks, body frame, metres."""
        return self._series(self.origins, pixel)

    def _series(self, coefficients: Array, pixel: Array) -> Array:
        place = (2.0 * np.asarray(pixel, np.float64) + 1.0) / self.pixels - 1.0
        return np.asarray(np.moveaxis(chebyshev.chebval(place, coefficients), 0, -1))


@dataclass(frozen=True, eq=False)
class Sightings:
    """Where one line saw points, in the points' order.

    Attributes:
        pixel: (n,) places on the line.
        station: (n, 3) measured position of the body's origin at their times, ITRS, metres.
        attitude: (n, 3, 3) measured body to ITRS.
    """

    pixel: Array
    station: Array
    attitude: Array


@dataclass(frozen=True, eq=False)
class StereoPoints:
    """Intersected points.

    Attributes:
        ground: (n, 3) ITRS, metres.
        miss: (n,) distance at which the two rays pass each other, metres.
    """

    ground: Array
    miss: Array


def intersect_pair(
    first: CalibratedLine, second: CalibratedLine, seen_first: Sightings, seen_second: Sightings
) -> StereoPoints:
    """Points nearest to their two rays in the sense of angles: each ray's miss counts against its own length.

    Raises:
        IntersectionError: different numbers of sightings, rays that are parallel.
    """
    if len(seen_first.pixel) != len(seen_second.pixel):
        raise IntersectionError("both lines must see the same points")
    origins, looks = [], []
    for camera, seen in ((first, seen_first), (second, seen_second)):
        looks.append(np.einsum("nij,nj->ni", seen.attitude, camera.look(seen.pixel)))
        origins.append(seen.station + np.einsum("nij,nj->ni", seen.attitude, camera.origin(seen.pixel)))
    base = origins[1] - origins[0]
    normal = np.cross(looks[0], looks[1])
    square = np.sum(normal**2, axis=-1)
    if np.any(square < _PARALLEL**2):
        raise IntersectionError(f"the rays of point {int(np.argmin(square))} are parallel")
    # each ray's point nearest to the other one; between them, as far from each as its ray is long
    along = [np.sum(np.cross(base, looks[1 - k]) * normal, axis=-1) / square for k in (0, 1)]
    ends = [o + t[:, None] * u for o, t, u in zip(origins, along, looks, strict=True)]
    weight = along[1] ** 2 / (along[0] ** 2 + along[1] ** 2)
    ground = weight[:, None] * ends[0] + (1.0 - weight[:, None]) * ends[1]
    return StereoPoints(np.asarray(ground), np.linalg.norm(ends[1] - ends[0], axis=-1))


def between(times: ArrayLike, measured: ArrayLike, values: ArrayLike) -> Array:
    """(T, 4) changes at times (T,) from those (m, 4) measured at ascending times (m,): linear, held beyond the ends.

    Args:
        times: (T,), seconds.
        measured: (m,), ascending, seconds.
        values: (m, 4) changes then.
    """
    wanted, at, known = (np.asarray(v, np.float64) for v in (times, measured, values))
    return np.stack([np.interp(wanted, at, column) for column in known.T], axis=-1)


def _turned(alpha: float, beta: float, gamma: float) -> Array:
    """Ry(alpha) Rx(beta) Rz(gamma)."""
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    cg, sg = np.cos(gamma), np.sin(gamma)
    y = np.array([[ca, 0.0, sa], [0.0, 1.0, 0.0], [-sa, 0.0, ca]])
    x = np.array([[1.0, 0.0, 0.0], [0.0, cb, -sb], [0.0, sb, cb]])
    z = np.array([[cg, -sg, 0.0], [sg, cg, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(y @ x @ z)
