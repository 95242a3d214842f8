"""Noise of an image point by measured attitude and station, of which cubic splines join readings at fixed intervals.

Attitude and station of an exposure are interpolated between readings. The correction at time t is a cubic B-spline sum

    sigma * sum over k of beta(t / h - k) z_k,    readings at whole multiples of h,

which is the cubic spline through its own values at the readings (z_{k-1} + 4 z_k + z_{k+1}) / 6. Readings independent
with unit variance make z a stationary second-order autoregression with the double root -rho, rho = 2 - sqrt 3; its
covariance is 3 (-rho)^n (n + (1 + rho^2) / (1 - rho^2)), and the precision of a stretch of it has five diagonals.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import toeplitz

from analysis.orbit.calibration_parameters import CalibrationError, Noise
from analysis.orbit.three_line_model import Partials, Rays

Array = NDArray[np.float64]
_RHO = 2.0 - np.sqrt(3.0)
_NEEDED = 4
"""Neighbouring z that one moment needs: no stretch is shorter."""


def reading_variance(time: Array, interval: float) -> Array:
    """(n,) variance of the spline at times (n,) for readings of unit variance: 1 at a reading, 0.76 halfway."""
    _, blend = spline_blend(time, interval)
    return np.asarray(np.einsum("ni,ij,nj->n", blend, _covariance(_NEEDED), blend))


def ray_covariance(noise: Noise, rays: Rays, by: Partials, *, shared: bool) -> Array:
    """(n, 2, 2) covariance of image points, metres^2.

    Args:
        noise: model of the errors.
        rays: n image points.
        by: derivatives of their misclosures.
        shared: with the noise that they share, as for one point alone; otherwise without what SharedNoise carries.
    """
    unit = np.eye(2) if rays.spread is None else rays.spread
    spread = np.broadcast_to(noise.image**2 * unit, (len(rays.point), 2, 2))
    for term in noise.terms:
        part = {"attitude": by.attitude, "station": by.ground}[term.kind]
        variance = np.full(len(rays.point), term.sigma**2)
        if term.walks:
            if rays.time is None:
                raise CalibrationError("calibration: a random walk of the attitude needs the times of all rays")
            since = np.abs(rays.time - np.mean(rays.time)) if len(rays.time) else rays.time
            variance = variance * since * shared
        elif term.interval is not None and rays.time is not None:
            variance = variance * (reading_variance(rays.time, term.interval) if shared else 0.0)
        spread = spread + variance[:, None, None] * (part @ np.swapaxes(part, 1, 2))
    return np.asarray(spread)


def spline_blend(time: Array, interval: float) -> tuple[NDArray[np.intp], Array]:
    """Number (n,) of the first of four cubic B-splines at times, and their values (n, 4)."""
    place = np.asarray(time, np.float64) / interval
    reading = np.floor(place)
    u = place - reading
    values = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 3 * u * (1 + u - u**2) + 1, u**3], axis=-1)
    return np.asarray(reading, np.intp) - 1, np.asarray(values / 6.0, np.float64)


def _covariance(count: int) -> Array:
    """(count, count) of neighbouring z, for readings of unit variance."""
    n = np.arange(count)
    return np.asarray(toeplitz(3.0 * (-_RHO) ** n * (n + (1 + _RHO**2) / (1 - _RHO**2))))


def spline_precision(count: int) -> sparse.csr_matrix:
    """Inverse of `_covariance`, for four or more: inside the square of (1 4 1) / 6, special in two rows at each end."""
    bands = [np.full(count - abs(k), v / 36.0) for k, v in ((0, 18.0), (1, 8.0), (2, 1.0))]
    matrix = sparse.diags([bands[2], bands[1], bands[0], bands[1], bands[2]], [-2, -1, 0, 1, 2]).tolil()
    corner = np.linalg.inv(_covariance(_NEEDED))
    matrix[:2, :2], matrix[-2:, -2:] = corner[:2, :2], corner[-2:, -2:]
    return sparse.csr_matrix(matrix)
