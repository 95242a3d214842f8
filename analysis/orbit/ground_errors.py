"""Errors of points on the ground as map standards count them: circles and intervals that hold a share of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]
_ANGLES = 400
"""Of the integral over half a circle; it is periodic, so that an ellipse of 1 : 50 has 1e-10."""
_ROUND = 0.02
"""Ratio of an ellipse's axes below which the short one counts as this share of the long one: 5e-4 of the radius."""
_BISECTIONS = 60


def linear_error(variance: ArrayLike, share: float = 0.9) -> Array:
    """Half width (...) of the interval about zero that holds a share of normal errors of these variances (...); LE90
    for 0.9, 1.645 sigma.
    """
    return np.asarray(float(ndtri(0.5 + 0.5 * share)) * np.sqrt(variance))


def circular_error(covariance: ArrayLike, share: float = 0.9) -> Array:
    """Radius of the circle about zero that holds a share of normal errors in the plane; CE90 for 0.9.

    In polar coordinates the radius of a direction is integrated in closed form, which leaves a smooth periodic integral
    over the angle. A round covariance has 2.146 sigma, one along a line 1.645 sigma.

    Args:
        covariance: (..., 2, 2).
        share: of the errors, between 0 and 1.

    Returns:
        (...), in the unit of the covariance's root.

    Raises:
        ValueError: a share that is none, a covariance that is none.
    """
    if not 0.0 < share < 1.0:
        raise ValueError("a share lies between 0 and 1")
    values = np.linalg.eigvalsh(np.asarray(covariance, np.float64))
    if not np.all(values >= -1e-12 * np.abs(values[..., -1:])):
        raise ValueError("a covariance has no negative variances")
    longer = np.sqrt(np.maximum(values[..., 1], 0.0))
    shorter = np.sqrt(np.maximum(values[..., 0], 0.0))
    ratio = np.maximum(np.divide(shorter, longer, out=np.ones_like(longer), where=longer > 0.0), _ROUND)
    angle = np.pi * np.arange(_ANGLES) / _ANGLES
    # inverse variance along each direction, in units of the longer axis
    q = np.cos(angle) ** 2 + (np.sin(angle) / ratio[..., None]) ** 2
    low, high = np.zeros_like(ratio), np.full_like(ratio, 40.0)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        outside = np.mean(np.exp(-0.5 * q * middle[..., None] ** 2) / q, axis=-1) / ratio
        within = 1.0 - outside
        low, high = np.where(within < share, middle, low), np.where(within < share, high, middle)
    return np.asarray(longer * 0.5 * (low + high))
