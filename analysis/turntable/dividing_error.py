"""Dividing error of a turntable from comparisons with a reference: outliers, curve fits, compensation.

Sign, everywhere: **dividing error = reading - true angle**, e(R) = R - phi. A corrected angle is R - e(R).

The table is stopped at a set of readings; at each of them a reference (indexed polygon and autocollimator) gives the
true angle, so that every comparison gives e(R) + the error of the reference at that position + noise. The comparisons
are repeated (paper 004, Li et al. 2020, section 3.3).

1. `CalibrationSeries`: gross errors are rejected by Chauvenet's criterion; mean, RMS of the repeats before and after,
   sigma.
2. `choose`: five fits, of which the one with the smallest cross-validation error is chosen.
3. `DividingCompensation`: corrects readings and gives the covariance of the corrected angles.

**Chauvenet's criterion.** Of n readings one is rejected if fewer than half a reading is expected at its deviation from
the mean or beyond:

    n P(|z| > |x - mean| / s) < 1/2,    s^2 = sum (x - mean)^2 / (n - 1),

with the two-sided tail P of the normal distribution. The rule is applied once, as in textbooks. Applied again to the
rest, it would find errors masked by a larger one, but also reject more good readings. The rule always rejects some good
readings (of ten normal ones 0.28 on average), and those the outermost, so that the RMS of the rest is too small.
`normal_reduction` gives this factor.

The paper reports a largest RMS of ten repeats of 0.081 arcsec, and after Chauvenet's criterion 0.037 arcsec. The second
is the RMS of single readings that were kept, not of their mean: without any rejection the mean of ten readings has at
most 0.081 / sqrt(10) = 0.026 arcsec, less than 0.037, and with it some 0.037 / sqrt(9) = 0.012 arcsec.

**Fits** of a curve over a range of angles, with a common interface and cross-validation:

- `piecewise_linear`: straight lines through the points.
- `polynomial`: weighted least squares in Chebyshev polynomials; the order by leave-one-out.
- `cubic_spline`: natural cubic smoothing spline, the smoothing by leave-one-out; without smoothing it interpolates.
- `fourier`: weighted least squares in a Fourier series whose fundamental period is longer than the range, since an arc
  is not a full circle and the curve's ends need not meet; period and order by leave-one-out.
- `network`: the paper's back-propagation network: one hidden layer of tanh, standardised, with weight decay; mean of
  several trainings from random starts.

Every fit gives its dependence on the points, `AngleFit.weights` (M, N), the derivative of the M predictions with
respect to the N values. For the first four the prediction is `weights @ value` (for the selected order). The network is
linearised at its minimum. So noise propagates to any combination of predictions.

Angles are in radians; values are in any unit, their sigmas in the same one. The module does not know the turntable's
true error.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.stats import beta, chi2, norm

from analysis.arrays import Array, MeasurementError, UndeterminedError

Curve = Callable[[Array], Array]

NEURONS, RESTARTS = 20, 4
DECAY, GAIN = 1e-2, 5.0
"""Weight decay of the network, and standard deviation to which its input angles are scaled.

The scale makes the network's initial curves steep enough for an error with many turns. Both were chosen on simulated
turntables, seeds 0 to 3 of a model like that of scenes/lab/turntable.yaml.
"""
FLATTEST = 0.1
"""Smallest curvature of the network's loss, in units of the decay, that its linearisation uses. Between 0.1 and 1 the
propagated sigma changes by 6 % and agrees with the scatter of networks trained on fresh noise.
"""
MOST_ITERATIONS, TOLERANCE = 8000, 1e-4


class NotConvergedError(MeasurementError, RuntimeError):
    """Error raised if no training of the network converged."""


def network(x: Array, y: Array, s: Array, seed: int) -> tuple[dict[str, float], Curve, Curve]:
    """Train the network on N points that the caller has validated.

    Parameters
    ----------
    x : (N,) ndarray
        Angles, in radians.
    y : (N,) ndarray
        Values.
    s : (N,) ndarray
        Standard deviations of the values.
    seed : int
        Seed of the random starts.

    Returns
    -------
    tuple of (dict of str to float, callable, callable)
        Settings of the training; function from M angles to values of the curve, (M,); function from M angles to the
        derivatives of the curve with respect to the N training values, (M, N).

    Raises
    ------
    NotConvergedError
        No training converged.
    """
    # imported here because the import takes a second and only this fit needs it
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor

    neurons = min(NEURONS, (len(x) - 1) // 2)
    middle, scale = float(np.mean(x)), GAIN / float(np.std(x))
    mean, scale_of_values = float(np.mean(y)), float(np.std(y)) or 1.0
    weight = s**-2 / np.mean(s**-2)
    nets: list[Any] = []
    for state in np.random.SeedSequence(seed).generate_state(RESTARTS):
        net = MLPRegressor(
            hidden_layer_sizes=(neurons,),
            activation="tanh",
            solver="lbfgs",
            alpha=DECAY,
            tol=TOLERANCE,
            max_iter=MOST_ITERATIONS,
            max_fun=2 * MOST_ITERATIONS,
            random_state=int(state),
        )
        with warnings.catch_warnings():
            # a training that does not converge is excluded, and counted in the settings
            warnings.simplefilter("error", ConvergenceWarning)
            try:
                nets.append(net.fit(scale * (x[:, None] - middle), (y - mean) / scale_of_values, sample_weight=weight))
            except ConvergenceWarning:
                continue
    if not nets:
        raise NotConvergedError(
            f"network: none of {RESTARTS} trainings converged in {MOST_ITERATIONS} iterations; check the "
            "values for gross errors, or choose another fit"
        )

    def curve(a: Array) -> Array:
        """Return the mean of the trained networks' predictions at given angles."""
        return mean + scale_of_values * np.mean([net.predict(scale * (a[:, None] - middle)) for net in nets], axis=0)

    solves = [response(net, scale * (x - middle), (y - mean) / scale_of_values, weight) for net in nets]

    def derivative(a: Array) -> Array:
        """Return the derivatives of the predictions at angles with respect to the training values."""
        at = scale * (a - middle)
        return np.asarray(np.mean([gradient(net, at) @ solve for net, solve in zip(nets, solves, strict=True)], axis=0))

    return {"hidden": neurons, "trainings": RESTARTS, "converged": len(nets)}, curve, derivative


def gradient(net: Any, x: Array) -> Array:
    """Return the derivatives of the network's output at M inputs with respect to its weights, (M, 3 H + 1).

    The output is c + v . tanh(w x + b), and the weights are in the order w, b, v (H each), c.

    Parameters
    ----------
    net : MLPRegressor
        Network of scikit-learn with one hidden layer of H; only `coefs_` and `intercepts_` are used.
    x : (M,) ndarray
        Standardised angles.
    """
    w, b, v = net.coefs_[0][0], net.intercepts_[0], net.coefs_[1][:, 0]
    t = np.tanh(np.outer(x, w) + b)
    slope = v * (1.0 - t**2)
    return np.concatenate([slope * x[:, None], slope, t, np.ones((len(x), 1))], axis=-1)


def response(net: Any, x: Array, y: Array, weight: Array) -> Array:
    """Return the derivatives of the 3 H + 1 trained weights with respect to the N training values.

    They follow from the implicit function theorem at the minimum of 1/2 sum weight (net - y)^2 + DECAY/2 (|w|^2 +
    |v|^2).

    Parameters
    ----------
    net : MLPRegressor
        Trained network, as for `gradient`.
    x : (N,) ndarray
        Inputs of the network.
    y : (N,) ndarray
        Training values.
    weight : (N,) ndarray
        Weights of the values.
    """
    w, b, v, c = net.coefs_[0][0], net.intercepts_[0], net.coefs_[1][:, 0], net.intercepts_[1][0]
    n = len(w)
    t = np.tanh(np.outer(x, w) + b)
    slopes = 1.0 - t**2
    jacobian = gradient(net, x)
    residual = weight * (c + t @ v - y)
    hessian = jacobian.T @ (weight[:, None] * jacobian)
    # contribution of the residuals: second derivatives of the output, nonzero within one hidden unit only
    by_input, by_bias = residual @ (slopes * x[:, None]), residual @ slopes
    second = -2.0 * v * t * slopes
    i = np.arange(n)
    for row, column, term in (
        (0, 0, residual @ (second * x[:, None] ** 2)),
        (0, n, residual @ (second * x[:, None])),
        (n, n, residual @ second),
        (0, 2 * n, by_input),
        (n, 2 * n, by_bias),
    ):
        hessian[row + i, column + i] += term
        if row != column:
            hessian[column + i, row + i] += term
    hessian[i, i] += DECAY
    hessian[2 * n + i, 2 * n + i] += DECAY
    # Trainings stop slightly before the minimum, where flat directions may have negative curvature; a lower bound
    # relative to the decay keeps the response from becoming arbitrarily large.
    level, direction = np.linalg.eigh(hessian)
    return (direction / np.maximum(level, FLATTEST * DECAY)) @ (direction.T @ (jacobian.T * weight))


MOST_ORDER = 30
"""Largest polynomial order and number of Fourier harmonics that are tried."""
PERIODS = (1.05, 1.1, 1.25, 1.5, 2.0)
"""Fundamental periods of the Fourier series that are tried, in lengths of the range."""
SMOOTHINGS = (0.0, *np.logspace(-8.0, 1.0, 46))
"""Smoothing parameters of the spline that are tried, for angles in units of the mean step and weights with a mean of
one.
"""
SLACK = 1e-9
"""Tolerance, in radians, within which an angle counts as equal to that of a fitted point."""
GAP_ORDER = {"piecewise_linear": 2, "polynomial": 0, "cubic_spline": 4, "fourier": 0, "network": 0}
"""Exponent p with which the error of a fit between points, h apart, decreases as h^p for a smooth curve: 2 and 4 for
the local fits. The error of the others is due to missing terms and does not depend on the step (0).
"""


@dataclass(frozen=True, eq=False)
class AngleFit:
    """Curve fitted to values at N angles, with its dependence on these values.

    Attributes
    ----------
    name : str
        Name of the fit, a key of `FITS`.
    angle, value, sigma : (N,) ndarray
        Points of the fit; angles increase.
    settings : mapping of str to float
        Selected parameters, for display (order, period, smoothing, trainings).
    curve : callable
        Function from M angles to predicted values (M,).
    derivative : callable
        Function from M angles to the derivatives of the predictions with respect to the N values, (M, N).
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
        """First and last angle of the points, in radians."""
        return float(self.angle[0]), float(self.angle[-1])

    def __call__(self, angle: ArrayLike) -> Array:
        """Return the values of the fitted curve at the angles, in the shape of the angles.

        Raises
        ------
        UndeterminedError
            An angle lies outside the range of the points.
        """
        angles = np.asarray(angle, np.float64)
        return self.curve(self._inside(angles).ravel()).reshape(angles.shape)

    def weights(self, angle: ArrayLike) -> Array:
        """Return the derivatives of the predictions at M angles with respect to the N fitted values, (M, N)."""
        return self.derivative(self._inside(np.atleast_1d(np.asarray(angle, np.float64))))

    def covariance(self, angle: ArrayLike, other: ArrayLike | None = None) -> Array:
        """Return the covariance of the predictions at M angles, or between those at M and at L other angles.

        It is (M, M) or (M, L), and is propagated from the sigmas of the points.

        It includes the noise alone, not the error of the fitted form; see `DividingCompensation.covariance`.
        """
        first = self.weights(angle)
        second = first if other is None else self.weights(other)
        return (first * self.sigma**2) @ second.T

    @property
    def effective_parameters(self) -> float:
        """Effective number of parameters of the fit.

        It is the sum of the derivatives of each prediction at a point with respect to the value of that point.
        """
        return float(np.trace(self.weights(self.angle)))

    def step_at(self, angle: ArrayLike) -> Array:
        """Return the distance between the two fitted points on either side of each angle, in radians."""
        angles = np.asarray(angle, np.float64)
        steps = np.diff(self.angle)
        # a point belongs to the smaller of its two steps
        below, above = (np.searchsorted(self.angle, angles + side, side="right") for side in (-SLACK, SLACK))
        return np.asarray(np.minimum(*(steps[np.clip(k, 1, len(steps)) - 1] for k in (below, above))))

    def _inside(self, angle: Array) -> Array:
        """Return the angles; raise UndeterminedError if one lies outside the range of the points."""
        low, high = self.range
        slack = 1e-9 * (high - low)
        if not np.all((angle >= low - slack) & (angle <= high + slack)):
            raise UndeterminedError(
                f"{self.name}: {np.degrees(np.min(angle)):.4f} to {np.degrees(np.max(angle)):.4f} deg requested, but "
                f"calibrated from {np.degrees(low):.4f} to {np.degrees(high):.4f} deg; calibrate the whole range of use"
            )
        return angle


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Prediction errors of a fit at points that it has not used.

    Attributes
    ----------
    name : str
        Name of the fit.
    angle : (K,) ndarray
        Angles of the K excluded points, in radians.
    residual : (K,) ndarray
        Value of an excluded point minus its prediction from the others.
    variance : (K,) ndarray
        Variance of the residual due to noise alone, of the point and of the prediction.
    """

    name: str
    angle: Array
    residual: Array
    variance: Array

    @property
    def rms(self) -> float:
        """RMS of the prediction errors at the excluded points, in the unit of the values."""
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def excess(self) -> float:
        """Mean square of the prediction errors minus that expected from noise, at least zero."""
        return max(0.0, float(np.mean(self.residual**2 - self.variance)))


def widest_step(angle: ArrayLike) -> float:
    """Return the widest distance of neighbouring points, in radians, over which cross-validation has tested a fit.

    Cross-validation bridges the two steps beside a point that it excludes. Wider gaps are untested, and no sigma is
    valid in them. A quarter of the points may lie beside such gaps.

    Parameters
    ----------
    angle : (N,) array_like
        Angles of the N points of the fit, increasing, in radians.
    """
    x = np.asarray(angle, np.float64)
    bridged = x[2:] - x[:-2]
    if not len(bridged):
        return float(np.ptp(x)) + SLACK
    tried = np.percentile(bridged, 75.0, method="lower")
    return float(max(tried, 2.0 * np.median(np.diff(x))) * (1.0 + 1e-6))


def fit_dividing_error(
    angle: ArrayLike, value: ArrayLike, sigma: ArrayLike, method: str = "cubic_spline", seed: int = 0
) -> AngleFit:
    """Fit the dividing error of a turntable as a curve over the angle.

    The order or the smoothing of the curve is chosen by leave-one-out cross-validation.

    Parameters
    ----------
    angle : (N,) array_like
        Angles of N points, in radians, increasing.
    value : (N,) array_like
        Dividing error (reading minus true angle) at these angles, in any unit.
    sigma : float or (N,) array_like
        Standard deviations of the values, in the same unit, greater than zero.
    method : {"cubic_spline", "piecewise_linear", "polynomial", "fourier", "network"}
        Kind of curve.
    seed : int
        Seed of the random starts of "network"; the other methods do not use it.

    Returns
    -------
    AngleFit
        The curve. Call it with angles; `weights` and `covariance` give its derivative with respect to the values and
        its covariance; `settings` are the chosen order, period or smoothing.

    Raises
    ------
    ValueError
        Another method, arrays of other shapes, angles that do not increase, or fewer angles than the method needs.
    NotConvergedError
        The network found no minimum.

    Examples
    --------
    A dividing error of 2 arcsec with one period over the calibrated range, at 41 angles with 0.1 arcsec of noise:

    >>> import numpy as np
    >>> import analysis
    >>> arcsec = np.pi / 648000
    >>> angle = np.radians(np.linspace(0, 20, 41))
    >>> true = lambda a: 2 * arcsec * np.sin(2 * np.pi * a / np.radians(20))
    >>> error = true(angle) + 0.1 * arcsec * np.random.default_rng(6).standard_normal(41)
    >>> curve = analysis.fit_dividing_error(angle, error, 0.1 * arcsec)
    >>> between = angle[:-1] + np.radians(0.25)
    >>> bool(np.sqrt(np.mean((curve(between) - true(between)) ** 2)) < 0.06 * arcsec)
    True
    >>> sigma = np.sqrt(np.diag(curve.covariance(between)))
    >>> round(float(np.median(sigma) / arcsec), 3)
    0.043
    """
    if method not in FITS:
        raise ValueError(f"there is no fit {method!r}; known are {', '.join(FITS)}")
    x, y, s = _points(method, angle, value, sigma)
    settings, curve, derivative = FITS[method](x, y, s, seed)
    return AngleFit(method, x, y, s, settings, curve, derivative)


def fewest(name: str) -> int:
    """Return the smallest number of angles to which a kind of curve can be fitted.

    It is the number of its unknowns, plus one where its order is selected.
    """
    return {"piecewise_linear": 2, "polynomial": 4, "cubic_spline": 4, "fourier": 5, "network": 10}[name]


def cross_validate(
    name: str, angle: ArrayLike, value: ArrayLike, sigma: ArrayLike, seed: int = 0, folds: int = 10
) -> CrossValidation:
    """Compute the K-fold cross-validation of a fit; every fold selects order or smoothing again.

    Fold k excludes the inner points k, k + folds, ...: the neighbours of an excluded point stay, and the gap that is
    bridged is two steps. The first and the last point are never excluded, because no fit is used outside its points.

    Parameters
    ----------
    name : str
        Name of the fit.
    angle : (N,) array_like
        Angles of the N points, in radians.
    value : (N,) array_like
        Values of the points.
    sigma : float or (N,) array_like
        Standard deviations of the values, in their unit.
    seed : int
        Seed of fits with random starts.
    folds : int
        Number of folds, K.

    Raises
    ------
    ValueError
        The arguments are invalid, or too few points are left without a fold.
    NotConvergedError
        The network does not converge.
    """
    x, y, s = _points(name, angle, value, sigma)
    if not 2 <= folds:
        raise ValueError(f"cross-validation: {folds} folds; take 2 or more")
    remaining_count = angles_left(len(x), folds)
    if remaining_count < fewest(name) or len(x) < 3:
        raise ValueError(
            f"{name}: cross-validation leaves {remaining_count} of {len(x)} angles, but at least {fewest(name)} are "
            "needed and one to exclude; calibrate more angles, use more folds, or choose another fit"
        )
    inner = np.arange(1, len(x) - 1)
    residual, variance = np.empty(len(x)), np.empty(len(x))
    for k in range(min(folds, len(inner))):
        excluded = inner[k::folds]
        remaining = np.setdiff1d(np.arange(len(x)), excluded)
        fit = fit_dividing_error(x[remaining], y[remaining], s[remaining], name, seed)
        weights = fit.weights(x[excluded])
        residual[excluded] = y[excluded] - fit(x[excluded])
        variance[excluded] = s[excluded] ** 2 + (weights**2) @ s[remaining] ** 2
    return CrossValidation(name, x[inner], residual[inner], variance[inner])


def angles_left(count: int, folds: int) -> int:
    """Return the number of angles that remain for the fit in cross-validation when the largest fold is excluded."""
    return count - -(-max(count - 2, 0) // folds)


def _points(name: str, angle: ArrayLike, value: ArrayLike, sigma: ArrayLike) -> tuple[Array, Array, Array]:
    """Return validated angles, values and sigmas of N points as arrays (N,)."""
    x, y = np.asarray(angle, np.float64), np.asarray(value, np.float64)
    if x.ndim != 1 or y.shape != x.shape:
        raise ValueError(f"{name}: angles and values must be (N,) and of equal shape, found {x.shape} and {y.shape}")
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
            f"{name}: {len(x)} angles, but at least {need} are needed; calibrate more angles, or choose another fit"
        )
    return x, y, np.array(s)


# Result of a fit: settings, curve, derivative
_FitResult = tuple[dict[str, float], Curve, Curve]


def _linear(basis: Curve, solve: Array, value: Array) -> tuple[Curve, Curve]:
    """Return the curve of a fit that is linear in the values, and its derivatives with respect to the values.

    `basis` gives K basis functions at M angles, (M, K); `solve` (K, N) gives their coefficients from the N values.
    """
    coefficients = solve @ value
    return lambda a: np.asarray(basis(a) @ coefficients), lambda a: np.asarray(basis(a) @ solve)


def _cross_validation(hat: Array, value: Array) -> float:
    """Return the mean square of the leave-one-out residuals of the inner points.

    It follows from the hat matrix H, (N, N), which gives the predictions at N points from their values y.

    It is exact for least squares and smoothing splines: (y - H y) / (1 - H_ii). Infinite if a point is always fitted
    exactly.
    """
    free = 1.0 - np.diag(hat)[1:-1]
    if np.min(free) < 1e-9:
        return np.inf
    return float(np.mean(((value - hat @ value)[1:-1] / free) ** 2))


def _piecewise_linear(x: Array, y: Array, s: Array, seed: int) -> _FitResult:
    """Fit straight lines through the points."""

    def hats(a: Array) -> Array:
        return np.stack([np.interp(a, x, unit) for unit in np.eye(len(x))], axis=-1)

    return {}, *_linear(hats, np.eye(len(x)), y)


def _least_squares(design: Array, s: Array) -> Array:
    """Return the matrix (K, N) that gives K weighted least-squares coefficients from N values.

    Combinations of coefficients that the points hardly determine are omitted.
    """
    return np.linalg.pinv(design / s[:, None], rcond=1e-10) / s


def _polynomial(x: Array, y: Array, s: Array, seed: int) -> _FitResult:
    """Fit Chebyshev polynomials of the order with the smallest leave-one-out error."""
    middle, half = 0.5 * (x[0] + x[-1]), 0.5 * (x[-1] - x[0])
    best: tuple[float, int, Array] = (np.inf, 0, np.empty(0))
    for order in range(1, min(MOST_ORDER, len(x) - 2) + 1):
        design = np.polynomial.chebyshev.chebvander((x - middle) / half, order)
        solve = _least_squares(design, s)
        best = min(best, (_cross_validation(design @ solve, y), order, solve), key=lambda b: b[0])
    order = best[1]
    basis = _chebyshev(middle, half, order)
    return {"order": order}, *_linear(basis, best[2], y)


def _chebyshev(middle: float, half: float, order: int) -> Curve:
    """Return a function that gives the Chebyshev polynomials of an interval at angles."""
    return lambda a: np.asarray(np.polynomial.chebyshev.chebvander((a - middle) / half, order), np.float64)


def _fourier(x: Array, y: Array, s: Array, seed: int) -> _FitResult:
    """Fit a Fourier series of the period and order with the smallest leave-one-out error."""
    best: tuple[float, int, float, Array] = (np.inf, 0, 0.0, np.empty(0))
    for period in PERIODS:
        for order in range(1, min(MOST_ORDER, (len(x) - 2) // 2) + 1):
            design = _harmonics(x[0], period * (x[-1] - x[0]), order)(x)
            solve = _least_squares(design, s)
            best = min(
                best, (_cross_validation(design @ solve, y), order, period * (x[-1] - x[0]), solve), key=lambda b: b[0]
            )
    _, order, length, solve = best
    return {"order": order, "period_deg": float(np.degrees(length))}, *_linear(
        _harmonics(x[0], length, order), solve, y
    )


def _harmonics(first: float, period: float, order: int) -> Curve:
    """Return a function that gives a constant, cosines and sines of a fundamental period at angles."""

    def basis(a: Array) -> Array:
        phase = 2.0 * np.pi / period * np.outer(a - first, np.arange(1, order + 1))
        return np.concatenate([np.ones((len(a), 1)), np.cos(phase), np.sin(phase)], axis=-1)

    return basis


def _cubic_spline(x: Array, y: Array, s: Array, seed: int) -> _FitResult:
    """Fit a natural cubic smoothing spline with the smallest leave-one-out error.

    Green and Silverman, Nonparametric Regression (1994), section 2.3: g = (W + a Q R^-1 Q^T)^-1 W y at the points, and
    the natural cubic spline through g.
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
        best = min(best, (_cross_validation(hat, y), smoothing, hat), key=lambda b: b[0])
    smoothing, hat = best[1:]
    if smoothing == SMOOTHINGS[1]:  # the smallest is best: interpolate without smoothing
        smoothing, hat = 0.0, np.eye(n)
    unit = CubicSpline(x, np.eye(n), bc_type="natural")
    return {"smoothing": float(smoothing)}, *_linear(unit, hat, y)


FITS: Mapping[str, Callable[[Array, Array, Array, int], _FitResult]] = {
    "piecewise_linear": _piecewise_linear,
    "polynomial": _polynomial,
    "cubic_spline": _cubic_spline,
    "fourier": _fourier,
    "network": network,
}
"""Functions that fit a curve to a dividing error, by the name of the kind of curve."""


FEWEST = 3
"""Smallest number of repeated readings of which one can be rejected; two readings always deviate by the same amount
from their mean.
"""


def limit(n: ArrayLike) -> Array:
    """Return the largest deviation from the mean that Chauvenet's criterion accepts among n readings.

    It is in units of the readings' sample standard deviation.
    """
    return np.asarray(norm.isf(0.25 / np.asarray(n, np.float64)))


def chauvenet(readings: ArrayLike, present: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Return a mask of the repeated readings that Chauvenet's criterion, applied once, keeps.

    A reading is rejected if fewer than half a reading would be expected at its deviation or beyond.

    Parameters
    ----------
    readings : (..., n) array_like
        Readings, in any unit; the last axis holds the n repeats of one quantity.
    present : (..., n) ndarray of bool, optional
        Readings that were taken, if quantities have different numbers of repeats; the others may hold any finite
        number.

    Returns
    -------
    (..., n) ndarray of bool
        True for readings to keep.

    Raises
    ------
    ValueError
        A reading is not finite.

    Examples
    --------
    The last of six readings deviates by more than 1.73 standard deviations, the limit for six:

    >>> import analysis
    >>> analysis.chauvenet([10.00, 10.02, 9.99, 10.01, 9.98, 10.25]).tolist()
    [True, True, True, True, True, False]
    """
    x = np.asarray(readings, np.float64)
    if not x.size or not np.all(np.isfinite(x)):
        raise ValueError("Chauvenet's criterion: readings must be finite, and at least one; exclude failed readings")
    keep = np.ones(x.shape, bool) if present is None else np.array(present, bool)
    x = np.where(keep, x, 0.0)
    count = keep.sum(-1, keepdims=True)
    deviation = np.abs(x - np.mean(x, -1, keepdims=True, where=keep))
    s = np.sqrt(np.sum(deviation**2, -1, keepdims=True, where=keep) / np.maximum(count - 1, 1))
    # comparison without division: equal readings have s = 0 and are kept
    gross = (deviation > limit(count) * s) & (count >= FEWEST)
    # deviations of rounding size are not gross errors
    gross &= deviation > 8.0 * np.finfo(float).eps * np.max(np.abs(x), -1, keepdims=True)
    return keep & ~gross


def rejection_rate(n: int) -> float:
    """Return the probability that Chauvenet's criterion rejects a particular one of n normal readings.

    (x - mean)^2 / s^2 times n / (n - 1)^2 has the beta distribution (1/2, (n - 2)/2).
    """
    return float(beta.sf(_scaled(n), 0.5, 0.5 * (n - 2))) if n >= FEWEST else 0.0


def expected_rejections(counts: NDArray[np.int64]) -> float:
    """Return the expected number of rejections in N series of normal readings, from their lengths (N,)."""
    sizes, times = np.unique(counts, return_counts=True)
    return float(sum(rejection_rate(int(n)) * (int(n) * int(many)) for n, many in zip(sizes, times, strict=True)))


def normal_reduction(n: int | NDArray[np.int64]) -> float:
    """Return the factor by which Chauvenet's criterion reduces the pooled variance of normal readings.

    It is E[sum of squares left] / E[degrees of freedom left] / sigma^2, by which the pooled variance of cleaned series
    is divided. x - mean over s is independent of s (Basu), so a reading outside the limit takes n/(n - 1) (x - mean)^2
    out of the sum, on average sigma^2 times the tail of the beta distribution (3/2, (n - 2)/2). Two rejections in one
    series, rare for n below some 20, are neglected.

    Parameters
    ----------
    n : int or (N,) ndarray of int
        Number of readings of every series, or of each of N series.
    """
    sizes, times = np.unique(n, return_counts=True)
    parts = [_left(int(size)) for size in sizes]
    if len(parts) == 1:
        return parts[0][0] / parts[0][1]
    square, freedom = (float(times @ np.array(part)) for part in zip(*parts, strict=True))
    return square / freedom


def _left(n: int) -> tuple[float, float]:
    """Return expected sum of squares, in sigma^2, and degrees of freedom of n readings after Chauvenet's criterion."""
    if n < FEWEST:
        return float(max(n - 1, 1)), float(max(n - 1, 1))
    square = float(beta.sf(_scaled(n), 1.5, 0.5 * (n - 2)))
    return n - 1 - n * square, n - 1 - n * rejection_rate(n)


def _scaled(n: int) -> float:
    """Return Chauvenet's limit for n readings, squared and scaled, as an argument of the beta distribution."""
    return min(float(limit(n)) ** 2 * n / (n - 1) ** 2, 1.0)


FALSE_ALARM = 1e-3
"""False-alarm rate of `CalibrationSeries.suspect` in a series without gross errors."""


@dataclass(frozen=True, eq=False)
class CalibrationSeries:
    """Repeated comparisons at N readings of the table.

    Attributes
    ----------
    angle : (N,) ndarray
        Readings of the table, increasing, in radians.
    comparisons : (N, repeats) ndarray
        Reading minus angle of the reference, in radians.
    reference_sigma : float
        Standard deviation of the reference's error at one position from its certificate, in radians. The error is the
        same in all repeats.
    present : (N, repeats) ndarray of bool or None
        True for comparisons that were made, if angles have different numbers of them; the others are ignored. None for
        all.
    """

    angle: Array
    comparisons: Array
    reference_sigma: float = 0.0
    present: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for arrays whose shapes do not match, and for numbers that are out of range."""
        x, y = np.asarray(self.angle, np.float64), np.asarray(self.comparisons, np.float64)
        if x.ndim != 1 or y.ndim != 2 or len(y) != len(x):
            raise ValueError(f"calibration: angles (N,) and comparisons (N, repeats), found {x.shape} and {y.shape}")
        if len(x) > 1 and np.ptp(x) == 0.0:
            raise UndeterminedError(f"calibration: all {len(x)} angles are the same; step the table through the region")
        if np.any(np.diff(x) <= 0.0):
            raise ValueError("calibration: angles must increase; sort them, and put repeats of one angle in one row")
        if y.shape[1] < 2:
            raise ValueError(
                "calibration: one repeat does not determine the noise; use 2 or more, and 5 to reject outliers"
            )
        if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y)) and self.reference_sigma >= 0.0):
            raise ValueError("calibration: angles and comparisons must be finite and reference_sigma not negative")
        if self.present is not None and (self.present.shape != y.shape or np.min(self.present.sum(axis=1)) < 2):
            raise ValueError("calibration: every angle needs two comparisons or more, and `present` (N, repeats)")
        object.__setattr__(self, "angle", x)
        object.__setattr__(self, "comparisons", y)

    @cached_property
    def keep(self) -> NDArray[np.bool_]:
        """Mask of the comparisons at N readings of the table that Chauvenet's criterion keeps, (N, repeats)."""
        return chauvenet(self.comparisons, self.present)

    @property
    def taken(self) -> NDArray[np.bool_]:
        """Mask of the comparisons at N readings of the table that were made, (N, repeats)."""
        return np.ones(self.comparisons.shape, bool) if self.present is None else self.present

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of comparisons at each of N readings of the table, (N,)."""
        return np.asarray(self.taken.sum(axis=1))

    @property
    def repeats(self) -> int:
        """Largest number of comparisons that were made at one angle."""
        return self.comparisons.shape[1]

    @property
    def excluded_comparisons(self) -> NDArray[np.bool_]:
        """Mask of the comparisons at N readings of the table that Chauvenet's criterion rejects, (N, repeats)."""
        return self.taken & ~self.keep

    @property
    def from_mean(self) -> Array:
        """Comparisons minus the mean of the kept ones at each of N angles, (N, repeats), in radians."""
        return self.comparisons - self.mean[:, None]

    @property
    def rejected(self) -> int:
        """Number of comparisons that Chauvenet's criterion rejects."""
        return int(np.sum(self.excluded_comparisons))

    @cached_property
    def mean(self) -> Array:
        """Dividing error at each of N angles, mean of the kept comparisons, (N,), in radians."""
        return np.asarray(np.mean(self.comparisons, axis=1, where=self.keep))

    @cached_property
    def rms_before(self) -> Array:
        """RMS of all n repeats at each of N angles about their mean, with the divisor n - 1, in radians."""
        return np.asarray(
            np.std(self.comparisons, axis=1, ddof=1, where=True if self.present is None else self.present)
        )

    @cached_property
    def rms_after(self) -> Array:
        """RMS of the n kept repeats at each of N angles about their mean, with the divisor n - 1, in radians.

        It is that of single readings, not of their means.
        """
        return np.asarray(np.std(self.comparisons, axis=1, ddof=1, where=self.keep))

    @property
    def averaging_alone(self) -> float:
        """Largest standard deviation of an angle's mean over all repeats: max(rms_before / sqrt(n)), in radians."""
        if self.present is not None:
            return float(np.max(self.rms_before / np.sqrt(self.counts)))
        return float(np.max(self.rms_before) / np.sqrt(self.repeats))

    @property
    def mean_rms(self) -> float:
        """Largest standard deviation of an angle's mean over kept repeats: max(rms_after / sqrt(n)), in radians."""
        return float(np.max(self.rms_after / np.sqrt(self.keep.sum(axis=1))))

    @cached_property
    def suspect(self) -> NDArray[np.bool_]:
        """Mask of those of N angles whose kept repeats scatter significantly more than those of all angles, (N,).

        Two gross errors at one angle widen its RMS so much that Chauvenet's criterion keeps both. The test is a
        chi-square test with a false-alarm rate of 0.1 % for all angles together.
        """
        freedom = self.keep.sum(axis=1) - 1
        most = chi2.isf(FALSE_ALARM / len(self.angle), freedom)
        suspect = np.zeros(len(self.angle), bool)
        for _ in range(len(self.angle)):
            exceeding = freedom * self.rms_after**2 > most * self._pooled(~suspect)
            if np.array_equal(exceeding, suspect) or np.all(exceeding):
                break
            suspect = exceeding
        return suspect

    @cached_property
    def repeatability(self) -> float:
        """Standard deviation of one good comparison, in radians.

        It is pooled over all angles that are not suspect, because one alone has few degrees of freedom, and corrected
        for the effect of Chauvenet's criterion on normal noise.
        """
        return float(np.sqrt(self._pooled(~self.suspect) / normal_reduction(self.counts)))

    def _pooled(self, angles: NDArray[np.bool_]) -> float:
        """Return the pooled variance of the kept repeats at the angles that a mask (N angles) selects, in rad^2."""
        freedom = (self.keep.sum(axis=1) - 1)[angles]
        return float(np.sum(freedom * self.rms_after[angles] ** 2) / np.sum(freedom))

    @property
    def noise_sigma(self) -> Array:
        """Standard deviation of the mean at each of N angles from the scatter of the repeats, (N,), in radians.

        Suspect angles use their own RMS.
        """
        single = np.where(self.suspect, self.rms_after, self.repeatability)
        return np.asarray(single / np.sqrt(self.keep.sum(axis=1)))

    @property
    def sigma(self) -> Array:
        """Standard deviation of the dividing error measured at each of N angles, (N,), in radians.

        It includes the scatter of the repeats and the error of the reference, and is at least the rounding of the
        angles, which remains in a series without noise.
        """
        rounding = np.spacing(np.max(np.abs(self.angle)))
        return np.asarray(np.maximum(np.hypot(self.noise_sigma, self.reference_sigma), rounding))

    @property
    def step(self) -> float:
        """Median distance of neighbouring readings of the table, in radians."""
        return float(np.median(np.diff(self.angle)))


@dataclass(frozen=True, eq=False)
class Trial:
    """Curve fitted to a calibration series, with its cross-validation on the calibration points."""

    fit: AngleFit
    validation: CrossValidation


@dataclass(frozen=True, eq=False)
class Choice:
    """Fits that were tried, and the chosen one.

    Attributes
    ----------
    trials : mapping of str to Trial
        Trials by the name of the fit, in the order of the request.
    failed : mapping of str to str
        Reasons of failed fits by name.
    chosen : str
        Name of the fit with the smallest cross-validation RMS.
    """

    trials: Mapping[str, Trial]
    failed: Mapping[str, str]
    chosen: str

    def __getitem__(self, name: str) -> Trial:
        """Return the fit of a name with its cross-validation.

        Raises
        ------
        KeyError
            There is no fit of that name, or it failed.
        """
        return self.trials[name]


def choose(
    series: CalibrationSeries,
    seed: int = 0,
    names: Sequence[str] = tuple(FITS),
    folds: int = 10,
    progress: Callable[[str], None] | None = None,
) -> Choice:
    """Fit and cross-validate several curves, and choose the one with the smallest cross-validation RMS.

    Only the calibration points are used. The one-standard-error rule is not applied: the fits are of different
    families, so that none is "the simpler one". A network that does not converge is reported as failed.

    Parameters
    ----------
    series : CalibrationSeries
        Calibration series.
    seed : int
        Seed of fits with random starts.
    names : sequence of str
        Names of the fits to try.
    folds : int
        Number of folds of the cross-validation.
    progress : callable, optional
        Function that receives a text before each fit.

    Raises
    ------
    ValueError
        There are fewer angles than a fit needs, or no fit succeeded.
    """
    report = progress or (lambda text: None)
    trials: dict[str, Trial] = {}
    failed: dict[str, str] = {}
    for name in names:
        report(f"fit and cross-validate: {name.replace('_', ' ')}")
        points = series.angle, series.mean, series.sigma
        try:
            trials[name] = Trial(fit_dividing_error(*points, name, seed), cross_validate(name, *points, seed, folds))
        except NotConvergedError as error:
            failed[name] = str(error)
    if not trials:
        raise UndeterminedError(
            f"no fit of the dividing error succeeded: {'; '.join(failed.values()) or 'none requested'}"
        )
    return Choice(trials, failed, min(trials, key=lambda name: trials[name].validation.rms))


@dataclass(frozen=True, eq=False)
class DividingCompensation:
    """Correction of the table's readings by a fitted dividing error.

    The remaining error after correction is systematic, the same for every repetition of a reading. Its covariance has
    four parts:

    - the noise of the calibration points, propagated: A diag(sigma^2) A^T with A = `fit.weights`;
    - `common`^2 everywhere: a constant, for example if all calibration points lie at one phase of the grating's signal;
      it cancels in differences of angles;
    - `smooth`^2 times `step_kernel`: the error of the fit between its points, correlated over one step. It grows with
      the step of the calibration around the reading as the fit's error does (`GAP_ORDER`);
    - `white`^2 on the diagonal: independent errors from reading to reading, such as the subdivision error, whose period
      (arcseconds) is far below the distances of readings in use.

    The repeatability of the readings in use is not included: it is independent in every reading, and averages out.

    Attributes
    ----------
    fit : AngleFit
        Fit of the dividing error.
    step : float
        Step of the calibration, in radians.
    common, smooth, white : float
        Standard deviations, in radians, of the three errors of the fit described above: constant, between points, and
        independent.
    repeatability : float
        Standard deviation of one comparison, in radians; an upper limit for one reading, because it includes the
        reference's noise.
    bridged : float
        Step for which `smooth` is valid, in radians: one step of the calibration, or two if no held-out angles were
        available to assess single steps.
    """

    fit: AngleFit
    step: float
    common: float
    smooth: float
    white: float
    repeatability: float
    bridged: float

    @property
    def region(self) -> tuple[float, float]:
        """First and last reading that can be corrected, in radians."""
        return self.fit.range

    def error(self, reading: ArrayLike) -> Array:
        """Return the estimated dividing error at the readings, in their shape, in radians.

        Raises
        ------
        UndeterminedError
            A reading lies outside the region, or in a gap of the calibration.
        """
        value = self.fit(reading)
        if not np.all(inside := covered(self.fit.angle, reading)):
            at = np.degrees(np.asarray(reading)[~inside].flat[0])
            steps = ", ".join(f"{a:.4f} to {b:.4f}" for a, b in np.degrees(gaps(self.fit.angle)))
            raise UndeterminedError(
                f"{at:.4f} deg lies in a gap of the calibration ({steps} deg); calibrate there, too"
            )
        return value

    def correct(self, reading: ArrayLike) -> Array:
        """Return the true angles of the readings, in their shape, in radians.

        Raises
        ------
        UndeterminedError
            A reading lies outside the region, or in a gap of the calibration.
        """
        return np.asarray(reading, np.float64) - self.error(reading)

    def covariance(self, reading: ArrayLike, other: ArrayLike | None = None) -> Array:
        """Return the covariance of the corrected angles, in rad^2.

        It is (M, M) for M readings, or (M, L) between those at M and at L other readings: the sum of the four parts
        that the class describes. The part `white` counts only between equal readings.
        """
        first = np.atleast_1d(np.asarray(reading, np.float64))
        second = first if other is None else np.atleast_1d(np.asarray(other, np.float64))
        amplitude, other_amplitude = (self._missed(at) for at in (first, second))
        misfit = np.outer(amplitude, other_amplitude) * step_kernel(first, second, self.step)
        same = self.white**2 * (first[:, None] == second)
        return self.fit.covariance(first, second) + self.common**2 + misfit + same

    def _missed(self, reading: Array) -> Array:
        """Return the standard deviation of the fit's error between its points, at each reading, in radians."""
        wide = np.maximum(1.0, self.fit.step_at(reading) / self.bridged)
        return np.asarray(self.smooth * wide ** GAP_ORDER[self.fit.name])

    def sigma(self, reading: ArrayLike) -> Array:
        """Return the standard deviations of the corrected angles at M readings, in radians."""
        return np.sqrt(np.diag(self.covariance(reading)))


def gaps(angle: Array) -> Array:
    """Return first and last angle of each of K gaps in a calibration at N angles, (K, 2), in radians.

    A gap is wider than any step that cross-validation has bridged.
    """
    k = np.flatnonzero(np.diff(angle) > widest_step(angle))
    return np.stack([angle[k], angle[k + 1]], axis=-1)


def covered(angle: Array, reading: ArrayLike) -> NDArray[np.bool_]:
    """Return a mask of the readings that a calibration at N angles covers, in the readings' shape.

    They lie between its first and last angle, and in no gap.
    """
    at, slack = np.asarray(reading, np.float64), SLACK
    inside = (at >= angle[0] - slack) & (at <= angle[-1] + slack)
    for first, last in gaps(angle):
        inside &= (at <= first + slack) | (at >= last - slack)
    return np.asarray(inside)


def step_kernel(first: Array, second: Array, step: float) -> Array:
    """Return the correlation of the fit's error between M and L readings, (M, L), zero beyond one step.

    It falls linearly from 1 to 0 over one step.

    It is an assumption, not a measurement: the error between two points says little about that between the next two.
    The triangle is a valid correlation (its Fourier transform is not negative).

    Parameters
    ----------
    first : (M,) ndarray
        Readings, M of them, in any unit.
    second : (L,) ndarray
        Readings, L of them, in the same unit.
    step : float
        Step of the calibration, in the same unit.
    """
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(first[:, None] - second) / step))


def compensate(
    series: CalibrationSeries, choice: Choice, held_out: CalibrationSeries | None = None
) -> DividingCompensation:
    """Return the compensation of a chosen fit, with its misfit estimated from residuals beyond their noise.

    - `smooth` comes from the cross-validation on the calibration points. Cross-validation bridges gaps of two steps and
      the compensation gaps of one, so that for the local fits, whose error falls as h^p, it is divided by 2^p (p = 2
      for lines, 4 for the spline, 0 for the others).
    - `common` is the mean of the residuals at held-out angles beyond its noise.
    - `white` is their mean square beyond noise, common and smooth misfit. Calibration points do not show the
      subdivision error if their step is a whole number of signal periods; held-out angles must lie at other phases.

    Without held-out angles common and white are zero, and the smooth part keeps its full excess.

    Parameters
    ----------
    series : CalibrationSeries
        Calibration series.
    choice : Choice
        Result of `choose`.
    held_out : CalibrationSeries, optional
        Separate series at other angles within the region.

    Raises
    ------
    ValueError
        Held-out angles lie outside the region.
    """
    trial = choice[choice.chosen]
    excess = trial.validation.excess
    common = white = 0.0
    if held_out is not None:
        excess /= 4.0 ** GAP_ORDER[choice.chosen]
        residual = held_out.mean - trial.fit(held_out.angle)
        noise = np.diag(held_out.sigma**2) + trial.fit.covariance(held_out.angle)
        common = max(0.0, float(np.mean(residual) ** 2 - np.mean(noise)))
        white = max(0.0, float(np.mean(residual**2) - np.mean(np.diag(noise))) - common - excess)
    common, smooth, white = np.sqrt([common, excess, white]).tolist()
    bridged = series.step if held_out is not None else 2.0 * series.step
    return DividingCompensation(trial.fit, series.step, common, smooth, white, series.repeatability, bridged)
