"""Five fits of a curve over a range of angles under one interface, and their cross-validation (paper 004, section 3.3).

    piecewise_linear   straight lines through the points
    polynomial         weighted least squares in Chebyshev polynomials; the order by leave-one-out
    cubic_spline       natural cubic smoothing spline, the smoothing by leave-one-out; it interpolates if that is none
    fourier            weighted least squares in a Fourier series whose fundamental period is longer than the range,
                       since an arc is no full circle and the curve's ends need not meet; period and order by
                       leave-one-out
    network            the paper's back-propagation network: one hidden layer of tanh, standardised, with weight decay;
                       mean of several trainings from random starts

Every fit knows how it depends on its points: `AngleFit.weights` (M, N), the derivative of the M predictions with
respect to the N values. For the first four the prediction is `weights @ value` (the order that was selected is taken
as given). The network is linearised at the minimum that was found. So noise propagates to any combination of
predictions.

Angles in radians; values in any unit, their sigmas in the same one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from analysis.arrays import Array
from analysis.measurement_error import UndeterminedError
from analysis.turntable.angle_network import Curve, network

MOST_ORDER = 30
"""Polynomial order, and number of Fourier harmonics, that are tried at most."""
PERIODS = (1.05, 1.1, 1.25, 1.5, 2.0)
"""Fundamental periods of the Fourier series that are tried, in lengths of the range."""
SMOOTHINGS = (0.0, *np.logspace(-8.0, 1.0, 46))
"""Smoothing parameters that are tried, for angles in units of the mean step and weights of mean one."""
SLACK = 1e-9
"""Radians within which an angle is that of a point."""
GAP_ORDER = {"piecewise_linear": 2, "polynomial": 0, "cubic_spline": 4, "fourier": 0, "network": 0}
"""With which power of the step the error between points falls for a smooth curve: h^2 and h^4 for the local fits. The
others miss what they have no terms for, wherever the points are.
"""


@dataclass(frozen=True, eq=False)
class AngleFit:
    """A fitted curve.

    Attributes:
        name: one of `FITS`.
        angle, value, sigma: the points, (N,) each; angles increase.
        settings: what was selected, for people (order, period, smoothing, trainings).
        curve: angles (M,) -> predictions (M,).
        derivative: angles (M,) -> weights (M, N).
    """

    name: str
    angle: Array
    value: Array
    sigma: Array
    settings: Mapping[str, float]
    curve: Curve = field(repr=False)
    derivative: Curve = field(repr=False)

    @property
    def range(self) -> tuple[float, float]:
        """First and last angle of the points, radians."""
        return float(self.angle[0]), float(self.angle[-1])

    def __call__(self, angle: ArrayLike) -> Array:
        """Predictions, in the shape of the angles. Raises ValueError outside of the range of the points."""
        at = np.asarray(angle, np.float64)
        return self.curve(self._inside(at).ravel()).reshape(at.shape)

    def weights(self, angle: ArrayLike) -> Array:
        """Derivative of the predictions at angles (M,) with respect to the points' values, (M, N)."""
        return self.derivative(self._inside(np.atleast_1d(np.asarray(angle, np.float64))))

    def covariance(self, angle: ArrayLike, other: ArrayLike | None = None) -> Array:
        """Covariance (M, L) of the predictions at angles (M,) and (L,), or (M, M), from the points' independent sigmas.

        It holds the noise alone: not what the fit misses of the curve (see `analysis.turntable.dividing_error`).
        """
        first = self.weights(angle)
        second = first if other is None else self.weights(other)
        return (first * self.sigma**2) @ second.T

    @property
    def effective_parameters(self) -> float:
        """Trace of the weights at the points: how many unknowns the fit in effect has."""
        return float(np.trace(self.weights(self.angle)))

    def step_at(self, angle: ArrayLike) -> Array:
        """Return the distance of the two points between which each angle lies, in the shape of the angles, radians."""
        at = np.asarray(angle, np.float64)
        steps = np.diff(self.angle)
        # a point belongs to the smaller of its two steps
        below, above = (np.searchsorted(self.angle, at + side, side="right") for side in (-SLACK, SLACK))
        return np.asarray(np.minimum(*(steps[np.clip(k, 1, len(steps)) - 1] for k in (below, above))))

    def _inside(self, angle: Array) -> Array:
        low, high = self.range
        slack = 1e-9 * (high - low)
        if not np.all((angle >= low - slack) & (angle <= high + slack)):
            raise UndeterminedError(
                f"{self.name}: {np.degrees(np.min(angle)):.4f} to {np.degrees(np.max(angle)):.4f} deg asked for, but "
                f"calibrated from {np.degrees(low):.4f} to {np.degrees(high):.4f} deg; calibrate the whole range of use"
            )
        return angle


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """How well a fit predicts points that it has not seen.

    Attributes:
        name: of the fit.
        angle: of the left-out points, (K,), radians.
        residual: left-out value - prediction from the others, (K,).
        variance: of the residual by noise alone, (K,): the point's own and the prediction's.
    """

    name: str
    angle: Array
    residual: Array
    variance: Array

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def excess(self) -> float:
        """Mean square of the residuals beyond the noise, not below zero."""
        return max(0.0, float(np.mean(self.residual**2 - self.variance)))


def widest_step(angle: ArrayLike) -> float:
    """Return the widest distance of neighbouring points, radians, over which a fit has been tried on its own points.

    Cross-validation bridges the two steps beside a point that it leaves out. Nothing was tried over a wider gap, and
    no sigma holds in it. A quarter of the points may lie beside such gaps.

    Parameters
    ----------
    angle : (N,) array_like
        Points of the fit, increasing, radians.
    """
    x = np.asarray(angle, np.float64)
    bridged = x[2:] - x[:-2]
    if not len(bridged):
        return float(np.ptp(x)) + SLACK
    tried = np.percentile(bridged, 75.0, method="lower")
    return float(max(tried, 2.0 * np.median(np.diff(x))) * (1.0 + 1e-6))


def fit(name: str, angle: ArrayLike, value: ArrayLike, sigma: ArrayLike, seed: int = 0) -> AngleFit:
    """Fit a curve.

    Args:
        name: one of `FITS`.
        angle: (N,) radians, increasing.
        value: (N,).
        sigma: standard deviations, (N,) or one number, greater than zero.
        seed: of the network's random starts; the others do not use it.

    Raises:
        ValueError: unknown name, wrong shapes, constant or repeated angles, fewer angles than the fit needs.
        NotConvergedError: the network found no minimum.
    """
    if name not in FITS:
        raise ValueError(f"no fit is called {name!r}; there are {', '.join(FITS)}")
    x, y, s = _points(name, angle, value, sigma)
    settings, curve, derivative = FITS[name](x, y, s, seed)
    return AngleFit(name, x, y, s, settings, curve, derivative)


def fewest(name: str) -> int:
    """The fewest angles that a fit can use: its unknowns, and where its order is selected one more to judge by."""
    return {"piecewise_linear": 2, "polynomial": 4, "cubic_spline": 4, "fourier": 5, "network": 10}[name]


def cross_validate(
    name: str, angle: ArrayLike, value: ArrayLike, sigma: ArrayLike, seed: int = 0, folds: int = 10
) -> CrossValidation:
    """K-fold cross-validation; whatever a fit selects, it selects anew for each fold.

    Fold k leaves out the inner points k, k + folds, ...: the neighbours of a left-out point stay, and the gap that is
    bridged is two steps. The first and the last point are never left out, for no fit is used outside of its points.

    Args:
        name: of the fit.
        angle: of the points, (N,).
        value: there, (N,).
        sigma: of the values, (N,) or a number, in their unit.
        seed: of fits that draw.
        folds: K.

    Raises:
        ValueError, NotConvergedError: as `fit`; the fit needs enough points without a fold.
    """
    x, y, s = _points(name, angle, value, sigma)
    if not 2 <= folds:
        raise ValueError(f"cross-validation: {folds} folds; take 2 or more")
    left = angles_left(len(x), folds)
    if left < fewest(name) or len(x) < 3:
        raise ValueError(
            f"{name}: cross-validation leaves {left} of {len(x)} angles, but at least {fewest(name)} are needed "
            "and one to leave out; calibrate more, take more folds, or another fit"
        )
    inner = np.arange(1, len(x) - 1)
    residual, variance = np.empty(len(x)), np.empty(len(x))
    for k in range(min(folds, len(inner))):
        out = inner[k::folds]
        rest = np.setdiff1d(np.arange(len(x)), out)
        part = fit(name, x[rest], y[rest], s[rest], seed)
        weights = part.weights(x[out])
        residual[out] = y[out] - part(x[out])
        variance[out] = s[out] ** 2 + (weights**2) @ s[rest] ** 2
    return CrossValidation(name, x[inner], residual[inner], variance[inner])


def angles_left(count: int, folds: int) -> int:
    """How many of so many angles the largest fold of `cross_validate` leaves to fit."""
    return count - -(-max(count - 2, 0) // folds)


def _points(name: str, angle: ArrayLike, value: ArrayLike, sigma: ArrayLike) -> tuple[Array, Array, Array]:
    x, y = np.asarray(angle, np.float64), np.asarray(value, np.float64)
    if x.ndim != 1 or y.shape != x.shape:
        raise ValueError(f"{name}: angles and values must be (N,) alike, found {x.shape} and {y.shape}")
    s = np.broadcast_to(np.asarray(sigma, np.float64), x.shape)
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y)) and np.all(np.isfinite(s)) and np.all(s > 0.0)):
        raise ValueError(f"{name}: angles and values must be finite and sigmas greater than zero")
    if len(x) > 1 and np.ptp(x) == 0.0:
        raise UndeterminedError(f"{name}: all {len(x)} angles are the same; step the table through the region")
    if np.any(np.diff(x) <= 0.0):
        raise ValueError(f"{name}: angles must increase; sort them, and average the repeats of one angle")
    need = fewest(name) if name in FITS else 0
    if len(x) < need:
        raise UndeterminedError(
            f"{name}: {len(x)} angles, but at least {need} are needed; calibrate more, or take another fit"
        )
    return x, y, np.array(s)


# A fit: points, seed -> settings, curve, derivative
_Made = tuple[dict[str, float], Curve, Curve]


def _linear(basis: Curve, solve: Array, value: Array) -> tuple[Curve, Curve]:
    """Curve and derivative of a linear fit: basis (M, K) at the angles, solve (K, N)."""
    coefficients = solve @ value
    return lambda a: np.asarray(basis(a) @ coefficients), lambda a: np.asarray(basis(a) @ solve)


def _left_out(hat: Array, value: Array) -> float:
    """Mean square of the leave-one-out residuals of the inner points, from the fit's matrix (N, N) at its points.

    Exact for least squares and smoothing splines: (y - H y) / (1 - H_ii). Infinite if a point is hit whatever it is.
    """
    free = 1.0 - np.diag(hat)[1:-1]
    if np.min(free) < 1e-9:
        return np.inf
    return float(np.mean(((value - hat @ value)[1:-1] / free) ** 2))


def _piecewise_linear(x: Array, y: Array, s: Array, seed: int) -> _Made:
    def hats(a: Array) -> Array:
        return np.stack([np.interp(a, x, unit) for unit in np.eye(len(x))], axis=-1)

    return {}, *_linear(hats, np.eye(len(x)), y)


def _least_squares(design: Array, s: Array) -> Array:
    """(K, N): coefficients = matrix @ values, weighted; directions that the points hardly see are left out."""
    return np.linalg.pinv(design / s[:, None], rcond=1e-10) / s


def _polynomial(x: Array, y: Array, s: Array, seed: int) -> _Made:
    middle, half = 0.5 * (x[0] + x[-1]), 0.5 * (x[-1] - x[0])
    best: tuple[float, int, Array] = (np.inf, 0, np.empty(0))
    for order in range(1, min(MOST_ORDER, len(x) - 2) + 1):
        design = np.polynomial.chebyshev.chebvander((x - middle) / half, order)
        solve = _least_squares(design, s)
        best = min(best, (_left_out(design @ solve, y), order, solve), key=lambda b: b[0])
    order = best[1]
    basis = _chebyshev(middle, half, order)
    return {"order": order}, *_linear(basis, best[2], y)


def _chebyshev(middle: float, half: float, order: int) -> Curve:
    return lambda a: np.asarray(np.polynomial.chebyshev.chebvander((a - middle) / half, order), np.float64)


def _fourier(x: Array, y: Array, s: Array, seed: int) -> _Made:
    best: tuple[float, int, float, Array] = (np.inf, 0, 0.0, np.empty(0))
    for period in PERIODS:
        for order in range(1, min(MOST_ORDER, (len(x) - 2) // 2) + 1):
            design = _harmonics(x[0], period * (x[-1] - x[0]), order)(x)
            solve = _least_squares(design, s)
            best = min(best, (_left_out(design @ solve, y), order, period * (x[-1] - x[0]), solve), key=lambda b: b[0])
    _, order, length, solve = best
    return {"order": order, "period_deg": float(np.degrees(length))}, *_linear(
        _harmonics(x[0], length, order), solve, y
    )


def _harmonics(first: float, period: float, order: int) -> Curve:
    def basis(a: Array) -> Array:
        phase = 2.0 * np.pi / period * np.outer(a - first, np.arange(1, order + 1))
        return np.concatenate([np.ones((len(a), 1)), np.cos(phase), np.sin(phase)], axis=-1)

    return basis


def _cubic_spline(x: Array, y: Array, s: Array, seed: int) -> _Made:
    """Green and Silverman, Nonparametric Regression (1994), section 2.3: g = (W + a Q R^-1 Q^T)^-1 W y at the points,
    and the natural cubic spline through g.
    """
    step = (x[-1] - x[0]) / (len(x) - 1)
    h = np.diff(x) / step
    n = len(x)
    q, r = np.zeros((n, n - 2)), np.zeros((n - 2, n - 2))
    j = np.arange(n - 2)
    q[j, j], q[j + 1, j], q[j + 2, j] = 1.0 / h[:-1], -1.0 / h[:-1] - 1.0 / h[1:], 1.0 / h[1:]
    r[j, j] = (h[:-1] + h[1:]) / 3.0
    r[j[:-1], j[1:]] = r[j[1:], j[:-1]] = h[1:-1] / 6.0
    rough = q @ np.linalg.solve(r, q.T)
    w = s**-2 / np.mean(s**-2)
    best: tuple[float, float, Array] = (np.inf, 0.0, np.empty(0))
    for smoothing in SMOOTHINGS[1:]:
        hat = np.linalg.solve(np.diag(w) + smoothing * rough, np.diag(w))
        best = min(best, (_left_out(hat, y), smoothing, hat), key=lambda b: b[0])
    smoothing, hat = best[1:]
    if smoothing == SMOOTHINGS[1]:  # the least one is best: none at all
        smoothing, hat = 0.0, np.eye(n)
    unit = CubicSpline(x, np.eye(n), bc_type="natural")
    return {"smoothing": float(smoothing)}, *_linear(unit, hat, y)


FITS: Mapping[str, Callable[[Array, Array, Array, int], _Made]] = {
    "piecewise_linear": _piecewise_linear,
    "polynomial": _polynomial,
    "cubic_spline": _cubic_spline,
    "fourier": _fourier,
    "network": network,
}
"""Name -> fit."""
