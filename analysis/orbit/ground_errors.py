"""Errors of points on the ground as map standards count them: circles and intervals that hold a share of them.

CE90 is the radius in plan that holds nine points in ten, LE90 the height that does: of one point by its covariance, of
a set of points with different covariances for a point that is drawn from the set, and of errors that are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, elementwise
from scipy.special import erf, ndtri

from analysis.arrays import Array
from analysis.orbit.calibration_parameters import vertical

_SHARE = 0.9
_DIRECTIONS = 0.5 * np.pi * (np.arange(32) + 0.5) / 32
"""Of the mean over a quarter of a circle, 1e-12 of CE90 for axes of any ratio."""
_FARTHEST = 40.0
"""Radius beyond which nothing lies, in standard deviations."""


@dataclass(frozen=True)
class Accuracy:
    """CE90 and LE90, metres, and of how many points."""

    ce90: float
    le90: float
    count: int


def level_axes(points: Array) -> Array:
    """(m, 3, 3) east, north and up as rows, at points (m, 3), ITRS, metres."""
    up = vertical(points)
    east = np.cross([0.0, 0.0, 1.0], up)
    east = east / np.linalg.norm(east, axis=1, keepdims=True)
    return np.stack([east, np.cross(up, east), up], axis=1)


def linear_error(variance: ArrayLike, share: float = _SHARE) -> Array:
    """Half width (...) of the interval about zero that holds a share of normal errors of these variances (...); LE90
    for 0.9, 1.645 sigma.
    """
    return np.asarray(float(ndtri(0.5 + 0.5 * share)) * np.sqrt(variance))


def circular_error(covariance: ArrayLike, share: float = _SHARE) -> Array:
    """Radius of the circle about zero that holds a share of normal errors in the plane; CE90 for 0.9.

    A round covariance has 2.146 sigma, one along a line 1.645 sigma.

    Args:
        covariance: (..., 2, 2).
        share: of the errors, between 0 and 1.

    Returns:
        (...), in the unit of the covariance's root.

    Raises:
        ValueError: a share that is none, a covariance that is none.
    """
    values = _axes(covariance, share)
    longer = np.sqrt(values[..., 1])
    ratio = np.divide(values[..., 0], values[..., 1], out=np.ones_like(longer), where=longer > 0.0)

    def missing(radius: Array, short: Array) -> Array:
        return share - _within(radius, np.stack([short, np.ones_like(short)], axis=-1))

    found = elementwise.find_root(missing, (np.zeros_like(ratio), np.full_like(ratio, _FARTHEST)), args=(ratio,))
    return np.asarray(longer * found.x)


def circle_of_points(covariance: Array, share: float = _SHARE) -> float:
    """Radius that holds a share of points with covariances (m, 2, 2) in plan; see `circular_error`."""
    values = _axes(covariance, share)

    def missing(radius: float) -> float:
        return float(np.mean(_within(radius, values))) - share

    return float(brentq(missing, 0.0, _FARTHEST * float(np.sqrt(values.max())), xtol=1e-9))


def interval_of_points(variance: Array, share: float = _SHARE) -> float:
    """Distance, metres, that holds the share of points with variances (m,), m^2."""
    sigma = np.sqrt(np.maximum(variance, 1e-300))

    def missing(size: float) -> float:
        return float(np.mean(erf(size / sigma / np.sqrt(2.0)))) - share

    return float(brentq(missing, 0.0, _FARTHEST * float(sigma.max()), xtol=1e-9))


def predicted(points: Array, covariance: Array) -> Accuracy:
    """By covariances (m, 3, 3), ITRS, of points (m, 3)."""
    axes = level_axes(points)
    level = axes @ covariance @ np.swapaxes(axes, 1, 2)
    return Accuracy(circle_of_points(level[:, :2, :2]), interval_of_points(level[:, 2, 2]), len(points))


def realised(points: Array, error: Array) -> Accuracy:
    """By errors (m, 3), ITRS, metres, of points (m, 3): quantiles of the sample."""
    level = np.einsum("nij,nj->ni", level_axes(points), error)
    plan, height = np.linalg.norm(level[:, :2], axis=1), np.abs(level[:, 2])
    return Accuracy(float(np.quantile(plan, _SHARE)), float(np.quantile(height, _SHARE)), len(points))


def _axes(covariance: ArrayLike, share: float) -> Array:
    """(..., 2) variances along the axes of the ellipses, the shorter first."""
    if not 0.0 < share < 1.0:
        raise ValueError("a share lies between 0 and 1")
    values = np.linalg.eigvalsh(np.asarray(covariance, np.float64))
    if not np.all(values >= -1e-12 * np.abs(values[..., -1:])):
        raise ValueError("a covariance has no negative variances")
    return np.asarray(np.maximum(values, 0.0))


def _within(radius: ArrayLike, variances: Array) -> Array:
    """(...) share of normal errors with variances (..., 2) along two axes that lie within radii (...).

    In units of the axes the errors are round: directions are alike, and in each the length is Rayleigh's. The ellipse
    that the circle becomes has the radius R / sqrt(a cos^2 + b sin^2) there.
    """
    along = variances[..., :1] * np.sin(_DIRECTIONS) ** 2 + variances[..., 1:] * np.cos(_DIRECTIONS) ** 2
    square = np.asarray(radius, np.float64)[..., None] ** 2
    return np.asarray(np.mean(-np.expm1(-0.5 * square / np.maximum(along, 1e-300)), axis=-1))
