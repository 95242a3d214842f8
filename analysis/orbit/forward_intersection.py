"""Forward intersection of points from all rays that see them, without ground control, and its errors at check points.

Each ray weighs by what noise of image, attitude and station does in its image. The covariance is that of this noise,
for each point by itself: that points exposed within a few readings of the attitude share errors is not in it, and is
what `strip_adjustment` uses. Errors of the calibration, which all points share, are in neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.orbit.calibration_parameters import CalibrationError, Noise, vertical
from analysis.orbit.shared_noise import ray_covariance
from analysis.orbit.three_line_model import LineModel, Rays, bias_rotation, misclosure, partials

__all__ = ["CheckErrors", "Intersection", "check_errors", "intersect"]

Array = NDArray[np.float64]
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
