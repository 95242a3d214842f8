"""Circular and linear errors of ground points: from their covariances, and from errors that are known.

CE90 is the radius in plan that holds nine points in ten, LE90 the height that does. Of a set of points with different
covariances they hold for a point that is drawn from the set; `analysis.orbit.ground_errors` has those of one point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import erf

from analysis.orbit.calibration_parameters import vertical

__all__ = ["Accuracy", "circle_of_points", "interval_of_points", "level_axes", "predicted", "realised"]

Array = NDArray[np.float64]
_SHARE = 0.9
_ANGLES = np.pi * (np.arange(64) + 0.5) / 64


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


def circle_of_points(covariance: Array, share: float = _SHARE) -> float:
    """Radius, metres, of the share of points with covariances (m, 2, 2) in plan, m^2.

    The share within R of a normal with variances a and b is the mean over directions of 1 - exp(-R^2 q / 2), weighed by
    1 / (q sqrt(a b)), q = cos^2 / a + sin^2 / b; 64 directions are exact to 1e-6 for axes of up to 1 : 20.
    """
    values = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    values = np.maximum(values, 2.5e-3 * values.max(axis=1, keepdims=True, initial=1e-300))
    q = np.cos(_ANGLES) ** 2 / values[:, :1] + np.sin(_ANGLES) ** 2 / values[:, 1:]
    weight = 1.0 / q / np.sqrt(np.prod(values, axis=1))[:, None]

    def missing(radius: float) -> float:
        return float(np.mean(weight * -np.expm1(-0.5 * radius**2 * q))) - share

    return float(brentq(missing, 0.0, 10.0 * float(np.sqrt(values.max())), xtol=1e-9))


def interval_of_points(variance: Array, share: float = _SHARE) -> float:
    """Distance, metres, that holds the share of points with variances (m,), m^2."""
    sigma = np.sqrt(np.maximum(variance, 1e-300))

    def missing(size: float) -> float:
        return float(np.mean(erf(size / sigma / np.sqrt(2.0)))) - share

    return float(brentq(missing, 0.0, 10.0 * float(sigma.max()), xtol=1e-9))


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
