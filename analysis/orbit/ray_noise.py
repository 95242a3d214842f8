"""Noise of an image point by measured attitude and station, of which cubic splines join readings at fixed intervals.

Attitude and station of an exposure are interpolated between readings. The correction at time t is a cubic B-spline sum

    sigma * sum over k of beta(t / h - k) z_k,    readings at whole multiples of h,

which is the cubic spline through its own values at the readings (z_{k-1} + 4 z_k + z_{k+1}) / 6. Readings independent
with unit variance make z a stationary second-order autoregression with the double root -rho, rho = 2 - sqrt 3; its
covariance is 3 (-rho)^n (n + (1 + rho^2) / (1 - rho^2)), and the precision of a stretch of it has five diagonals.

Quality of an orbit or attitude series by its third differences (paper 003, Table 2).

A third difference x[k+3] - 3 x[k+2] + 3 x[k+1] - x[k] removes a smooth motion, up to its third derivative times dt^3,
and leaves noise: of white noise with standard deviation s it has the RMS s sqrt(1 + 9 + 9 + 1) = s sqrt(20), and
neighbours correlate by -15/20. It says nothing of a bias, of a drift or of noise that is slower than a few samples, and
data that were smoothed before look better than they are. The smooth part is not always small: along a circular orbit at
500 km the third derivative is 8.4e-3 m/s^3, so 8 mm at 1 s but 8 m at 10 s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.linalg import toeplitz

from analysis.arrays import Array
from analysis.orbit.calibration_parameters import CalibrationError, Noise
from analysis.orbit.three_line_model import Partials, Rays

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


WHITE_GAIN = float(np.sqrt(20.0))
# Steps of time that differ by more are gaps: third differences over them mean something else.
_UNEVEN = 1e-3


@dataclass(frozen=True, eq=False)
class ThirdDifference:
    """Quality of one series.

    Attributes:
        rms: (k,) of the third differences of each column, as in Table 2.
        white_sigma: (k,) rms / sqrt(20), standard deviation of one sample if the noise is white.
    """

    rms: Array
    white_sigma: Array


def third_difference(time: ArrayLike, series: ArrayLike) -> ThirdDifference:
    """Third differences of an evenly sampled series.

    Args:
        time: (n,) seconds.
        series: (n,) or (n, k), metres or radians.

    Raises:
        ValueError: fewer than five samples, values that are not finite, gaps.
    """
    t, x = np.asarray(time, np.float64), np.asarray(series, np.float64)
    x = x[:, None] if x.ndim == 1 else x
    if t.ndim != 1 or x.ndim != 2 or len(t) != len(x) or len(t) < 5:
        raise ValueError(f"third differences: need five samples or more, found times {t.shape} and series {x.shape}")
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(x))):
        raise ValueError("third differences: times and values must be finite")
    steps = np.diff(t)
    typical = float(np.median(steps))
    bad = np.flatnonzero(np.abs(steps - typical) > _UNEVEN * abs(typical))
    if typical <= 0 or len(bad):
        where = f"; the step after sample {bad[0]} is {steps[bad[0]]:.6g} s" if len(bad) else ""
        raise ValueError(f"third differences: times must rise evenly, by {typical:.6g} s{where}")
    change = np.diff(x, n=3, axis=0)
    rms = np.sqrt(np.mean(change**2, axis=0))
    return ThirdDifference(rms, rms / WHITE_GAIN)
