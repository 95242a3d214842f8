"""Statistical functions: chi-square, binomial intervals, robust scales, Rice's distribution, least squares.

The chi-square functions are those that ``scipy.stats.chi2`` calls, with results equal to the last bit, without loading
that package, which takes a tenth of the time of a short command.

A modulation is the modulus of a Fourier coefficient. Noise makes the modulus longer on average: where the signal
vanishes, sigma sqrt(pi/2) remains (Rice, Bell Syst. Tech. J. 24, 46 (1945)).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, gammaln, i0e, i1e, xlogy

from analysis.arrays import Array
from optics.numerics.arguments import finite

_NORMAL_SIZE = 1.4826
"""Ratio of a normal distribution's standard deviation to the median of the absolute deviations."""


def p_value_of(chi_square: Any, degrees: Any) -> Any:
    """Return the probability that chi-square exceeds a value by chance (upper tail of its distribution).

    Parameters
    ----------
    chi_square : float or ndarray
        Chi-square, at least 0, of any shape.
    degrees : float or ndarray
        Degrees of freedom, of the same shape or a number.
    """
    return chdtrc(degrees, chi_square)


def limit_of(probability: Any, degrees: Any) -> Any:
    """Return the chi-square that is exceeded with a given probability.

    Parameters
    ----------
    probability : float or ndarray
        Probability, above 0 and at most 1, of any shape.
    degrees : float or ndarray
        Degrees of freedom, of the same shape or a number.
    """
    return chdtri(degrees, probability)


def density(chi_square: Any, degrees: Any) -> Any:
    """Return the probability density of the chi-square distribution.

    Parameters
    ----------
    chi_square : float or ndarray
        Chi-square, at least 0, of any shape.
    degrees : float or ndarray
        Degrees of freedom, of the same shape or a number.
    """
    half = 0.5 * np.asarray(degrees, dtype=np.float64)
    return np.exp(xlogy(half - 1.0, chi_square) - 0.5 * np.asarray(chi_square) - gammaln(half) - np.log(2.0) * half)


def p_value(chi_square: float, degrees: int) -> float:
    """Return the probability of a larger chi-square (p-value) by chance; 1 without degrees of freedom."""
    return float(chdtrc(degrees, chi_square)) if degrees > 0 else 1.0


def gain(columns: np.ndarray, root: np.ndarray | None = None, cutoff: float = 1e-15) -> np.ndarray:
    """Return the least-squares inverse of a design matrix: the matrix from observations to estimated unknowns.

    With the inverse G, the estimates are G y for observations y, and their covariance is G C G' for the covariance C of
    the observations. The columns are scaled to unit length, as their units may differ by many orders of magnitude.

    Parameters
    ----------
    columns : (..., N, P) ndarray
        Derivatives of the N observations with respect to the P unknowns.
    root : (..., N, N) ndarray or None
        Cholesky factor of the observations' covariance; None for equal weights.
    cutoff : float
        Singular values below this fraction of the largest one count as zero.

    Returns
    -------
    (..., P, N) ndarray
        Matrix from N observations to P unknowns.
    """
    white: np.ndarray = columns
    if root is not None:
        white = np.linalg.solve(root, np.broadcast_to(columns, (*root.shape[:-2], *columns.shape[-2:])))
    length = np.linalg.norm(white, axis=-2, keepdims=True)
    inverse = np.linalg.pinv(white / length, rcond=cutoff) / np.swapaxes(length, -1, -2)
    return np.asarray(inverse if root is None else inverse @ np.linalg.inv(root), dtype=np.float64)


def rms(values: ArrayLike) -> float:
    """Return the root mean square of all elements of an array, in its unit."""
    return float(np.sqrt(np.mean(np.square(values))))


def proportion_interval(successes: int, trials: int, confidence: float) -> tuple[float, float]:
    """Return the Clopper-Pearson confidence interval of a proportion; (0, 1) without trials.

    Parameters
    ----------
    successes : int
        Number of successes.
    trials : int
        Number of trials.
    confidence : float
        Smallest probability with which the interval contains the proportion.

    Returns
    -------
    low, high : float
        Limits of the interval.

    Raises
    ------
    ValueError
        More successes than trials, or a confidence out of range.

    Notes
    -----
    Clopper and Pearson, Biometrika 26, 404 (1934).

    Examples
    --------
    No failure in 60 trials: the rate of failure is below 4.9 % with 95 % confidence (rule of three: 3 / 60):

    >>> import analysis
    >>> low, high = analysis.proportion_interval(0, 60, 0.90)
    >>> low, round(high, 4)
    (0.0, 0.0487)
    """
    if not (0 <= successes <= trials and 0.0 < confidence < 1.0):
        raise ValueError(
            f"proportion: need 0 <= successes <= trials and a confidence between 0 and 1, found {successes},"
            f" {trials}, {confidence}"
        )
    if trials == 0:
        return 0.0, 1.0
    # imported here, as the import takes longer than a short command
    from scipy.stats import binomtest

    interval = binomtest(successes, trials).proportion_ci(confidence, "exact")
    return float(interval.low), float(interval.high)


def null_combinations(design: Array, names: Sequence[str], tolerance: float, least: float) -> tuple[Array, str]:
    """Return the combinations of P unknowns that observations leave undetermined, (k, P), and their text.

    The largest entry of each is 1.

    Parameters
    ----------
    design : (M, P) ndarray
        Derivatives of M observations with respect to the unknowns.
    names : sequence of str
        Names of the unknowns.
    tolerance : float
        Singular value, with columns of unit length and relative to the largest, up to which a combination counts as
        undetermined.
    least : float
        Entry up to which an unknown is omitted from the text.
    """
    length = np.linalg.norm(design, axis=0)
    length = np.where(length > 0, length, 1.0)
    _, values, vt = np.linalg.svd(design / length, full_matrices=True)
    values = np.pad(values, (0, len(vt) - values.size))
    vectors = vt[values <= tolerance * max(float(values[0]), 1e-300)] / length
    vectors = vectors / np.abs(vectors).max(axis=1, keepdims=True)
    text = "; ".join(
        " ".join(f"{v:+.3g} x {name}" for v, name in zip(row, names, strict=True) if abs(v) > least) for row in vectors
    )
    return vectors, text


def robust_sigma(residuals: ArrayLike) -> float:
    """Return the standard deviation of normal residuals from their median absolute value, robust to outliers.

    Parameters
    ----------
    residuals : array_like
        Residuals about their median, of any shape; up to half of them may be outliers.

    Returns
    -------
    float
        Standard deviation, in the unit of the residuals.

    Examples
    --------
    Normal numbers of sigma 2, of which 2 % are replaced by outliers:

    >>> import numpy as np
    >>> import analysis
    >>> residuals = 2 * np.random.default_rng(7).standard_normal(2000)
    >>> residuals[:40] = 1000.0
    >>> round(float(np.std(residuals))), round(analysis.robust_sigma(residuals), 1)
    (140, 2.0)
    """
    values = finite("residuals", residuals, "in one unit")
    if not values.size:
        raise ValueError("robust sigma: need at least one residual")
    return _NORMAL_SIZE * float(np.median(np.abs(values)))


def robust_variance(squares: ArrayLike) -> float:
    """Return the variance per axis of residuals in a plane from their median squared length, robust to outliers.

    Parameters
    ----------
    squares : (n,) array_like
        Squared lengths of n residuals.
    """
    # median of chi-square with two degrees of freedom is 2 ln 2
    return float(np.median(np.asarray(squares)) / (2.0 * np.log(2.0)))


def rice_bias(modulus: ArrayLike, sigma: ArrayLike) -> Array:
    """Return the mean amount by which noise increases the modulus of a complex amplitude m, >= 0.

    It is the mean of |m + noise| minus |m|. The noise along m moves the mean only to higher order. For a large modulus
    the bias is about sigma^2 / (2 m).

    Parameters
    ----------
    modulus : array_like
        True modulus |m|.
    sigma : array_like
        Rms of the noise in the direction perpendicular to m, in the unit of `modulus`.
    """
    m, s = np.broadcast_arrays(np.asarray(modulus, dtype=np.float64), np.asarray(sigma, dtype=np.float64))
    quiet = s <= 1e-9 * m
    s_safe = np.where(quiet, 1.0, s)
    m_safe = np.where(quiet, 0.0, m)
    # Laguerre L_1/2(-2 x) = (1 + 2 x) I0e(x) + 2 x I1e(x), x = m^2 / (4 s^2), without overflow
    x = (m_safe / (2.0 * s_safe)) ** 2
    mean = s_safe * np.sqrt(np.pi / 2.0) * ((1.0 + 2.0 * x) * i0e(x) + 2.0 * x * i1e(x))
    # from x = 1e4 the difference of two long numbers loses digits; the series is exact to 1e-9 of itself there
    far = x > 1e4
    series = s_safe**2 / (2.0 * np.where(far, m_safe, 1.0)) * (1.0 + 1.0 / (16.0 * np.where(far, x, 1.0)))
    bias = np.where(far, series, mean - m_safe)
    return np.where(quiet, 0.0, bias)


def measured_bias(modulus: ArrayLike, sigma_across: ArrayLike) -> Array:
    """Return an estimate of `rice_bias` from the measured |m + noise| alone.

    The estimate is that of the bias `rice_bias` of the modulus of a complex amplitude m; "along" and "across" are the
    components of the noise along m and perpendicular to it, and r is the measured modulus. The mean of the estimate is
    nearly the bias at the true |m|. |m + noise|^2 is (m + along)^2 + across^2. The root of this minus the mean of
    across^2 has the mean |m| but for terms of sigma^4 / m^3, so that r - sqrt(r^2 - sigma_across^2) estimates the bias.
    `rice_bias` at `signal_modulus` does not: that estimate scatters, and the mean of a convex function exceeds the
    function of the mean, by 0.2 sigma to 0.3 sigma between 0.7 sigma and 2 sigma. Where r is below sigma there is no
    real root, and the bias is that without a signal.

    The mean of any function of r is an analytic function of m^2, which |m| at 0 is not: no estimator is unbiased
    everywhere. The mean of this one is right to 0.03 sigma for |m| of 3 sigma and more, to 0.09 sigma for 0.6 sigma and
    more, and too small below, by half a sigma where there is no signal. The estimate decreases with r from sigma
    sqrt(pi/2) at r = 0.

    Parameters
    ----------
    modulus : array_like
        Measured modulus |m + noise|, of any shape.
    sigma_across : array_like
        Rms of the noise perpendicular to m, of that shape, in the same unit.
    """
    r, s = np.broadcast_arrays(np.asarray(modulus, dtype=np.float64), np.asarray(sigma_across, dtype=np.float64))
    root = np.sqrt(np.maximum(r - s, 0.0) * (r + s))
    # not as the difference of two long numbers; without signal and noise it is 0
    long = r + root
    return np.where(r < s, np.sqrt(np.pi / 2.0) * s, s * (s / np.where(long > 0.0, long, 1.0)))


def rice_sigma(modulus: ArrayLike, sigma_along: ArrayLike, sigma_across: ArrayLike) -> Array:
    """Return the standard deviation of the measured modulus |m + noise| of a complex amplitude m.

    Exact for equal noise along and across m, and in the limit of a large m, where only the noise along it counts.

    Parameters
    ----------
    modulus : array_like
        True modulus |m|, of any shape.
    sigma_along : array_like
        Rms of the noise along m, of that shape.
    sigma_across : array_like
        Rms of the noise perpendicular to m, of that shape.
    """
    m, along, across = np.broadcast_arrays(
        np.asarray(modulus, dtype=np.float64), np.asarray(sigma_along), np.asarray(sigma_across)
    )
    mean = m + rice_bias(m, across)
    # E|z|^2 - mean^2, written without the cancelling squares
    rice = 2.0 * across**2 - (mean - m) * (mean + m)
    return np.sqrt(np.maximum(rice + along**2 - across**2, 0.0))


def signal_modulus(modulus: ArrayLike, sigma_along: ArrayLike, sigma_across: ArrayLike) -> Array:
    """Return an estimate of the true modulus |m| of a complex amplitude m from the measured modulus |m + noise|.

    The estimate is the root of the square of the measurement minus the mean square of the noise, or 0 if that is
    negative.

    Parameters
    ----------
    modulus : array_like
        Measured modulus |m + noise|, of any shape.
    sigma_along : array_like
        Rms of the noise along m, of that shape.
    sigma_across : array_like
        Rms of the noise perpendicular to m, of that shape.
    """
    square = np.square(modulus) - np.square(sigma_along) - np.square(sigma_across)
    return np.sqrt(np.maximum(square, 0.0))
