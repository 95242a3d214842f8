"""Distributions and scales that measurements are judged by: chi-square, shares, robust scales, and Rice's distribution;
the inverse of least squares.

The functions of chi-square are what ``scipy.stats.chi2`` calls, to the bit, without that package's import, which is a
tenth of a short command.

A modulation is the modulus of a Fourier coefficient. Noise makes the modulus longer on average: where the signal is
gone, sigma sqrt(pi/2) is left (Rice, Bell Syst. Tech. J. 24, 46 (1945)).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, gammaln, i0e, i1e, xlogy

from analysis.arrays import Array

_NORMAL_SIZE = 1.4826
"""Standard deviation of a normal distribution over the median of the sizes."""


def chance_beyond(chi_square: Any, degrees: Any) -> Any:
    """Probability of a larger chi-square.

    Parameters
    ----------
    chi_square : Any
        At least 0, a number or an array of any shape.
    degrees : Any
        Of freedom, likewise.
    """
    return chdtrc(degrees, chi_square)


def limit_of(chance: Any, degrees: Any) -> Any:
    """Chi-square that is exceeded with a probability.

    Parameters
    ----------
    chance : Any
        Above 0 and at most 1, a number or an array of any shape.
    degrees : Any
        Of freedom, likewise.
    """
    return chdtri(degrees, chance)


def density(chi_square: Any, degrees: Any) -> Any:
    """Probability density.

    Parameters
    ----------
    chi_square : Any
        At least 0, a number or an array of any shape.
    degrees : Any
        Of freedom, likewise.
    """
    half = 0.5 * np.asarray(degrees, dtype=np.float64)
    return np.exp(xlogy(half - 1.0, chi_square) - 0.5 * np.asarray(chi_square) - gammaln(half) - np.log(2.0) * half)


def p_value(chi_square: float, degrees: int) -> float:
    """Return the probability of such a chi-square or a larger one; 1 without degrees of freedom."""
    return float(chdtrc(degrees, chi_square)) if degrees > 0 else 1.0


def gain(columns: np.ndarray, root: np.ndarray | None = None, cutoff: float = 1e-15) -> np.ndarray:
    """Return the least-squares inverse: G of the estimates G y of observations y, with covariance G C G'.

    The columns are scaled to length one, as their units may differ by many orders of magnitude.

    Parameters
    ----------
    columns : np.ndarray
        Derivatives of the observations by the unknowns, (..., N, P).
    root : np.ndarray | None
        Cholesky factor of the observations' covariance, (..., N, N); None where all are alike.
    cutoff : float
        Share of the largest singular value below which a combination of unknowns is none.

    Returns
    -------
    np.ndarray
        (..., P, N).
    """
    white: np.ndarray = columns
    if root is not None:
        white = np.linalg.solve(root, np.broadcast_to(columns, (*root.shape[:-2], *columns.shape[-2:])))
    length = np.linalg.norm(white, axis=-2, keepdims=True)
    inverse = np.linalg.pinv(white / length, rcond=cutoff) / np.swapaxes(length, -1, -2)
    return np.asarray(inverse if root is None else inverse @ np.linalg.inv(root), dtype=np.float64)


def share_interval(met: int, count: int, confidence: float) -> tuple[float, float]:
    """Return the interval of Clopper and Pearson (Biometrika 26, 404 (1934)) of a share; 0 to 1 of none.

    Parameters
    ----------
    met : int
        How many of the trials succeeded.
    count : int
        trials.
    confidence : float
        With which the interval holds the share, at least.
    """
    if count == 0:
        return 0.0, 1.0
    # not at the top: this import takes longer than short commands
    from scipy.stats import binomtest

    interval = binomtest(met, count).proportion_ci(confidence, "exact")
    return float(interval.low), float(interval.high)


def robust_sigma(residuals: ArrayLike) -> float:
    """Return the standard deviation of normal residuals by the median of their sizes, of which half may be wrong.

    Parameters
    ----------
    residuals : ArrayLike
        About their middle, of any shape.
    """
    return _NORMAL_SIZE * float(np.median(np.abs(np.asarray(residuals))))


def robust_variance(squares: ArrayLike) -> float:
    """Return the variance of normal residuals in a plane, in each direction, by the median: half of them may be wrong.

    Parameters
    ----------
    squares : ArrayLike
        Of their lengths, (n,).
    """
    # median of chi-square with two degrees of freedom is 2 ln 2
    return float(np.median(np.asarray(squares)) / (2.0 * np.log(2.0)))


def rice_bias(modulus: ArrayLike, sigma: ArrayLike) -> Array:
    """Mean of |m + noise| minus |m|, >= 0.

    modulus: |m|, true value. sigma: rms of the noise in the direction across m, same unit; the noise along m moves the
    mean only to higher order. About sigma^2 / (2 m) where m is large.
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
    """What to expect of `rice_bias` from a measured |m + noise| alone: its mean is the bias at the true |m|, nearly.

    |m + noise|^2 is (m + along)^2 + across^2. Less the mean of across^2 its root has the mean |m| but for terms of
    sigma^4 / m^3, so that r - sqrt(r^2 - sigma_across^2) is the bias. `rice_bias` of `signal_modulus` is not: that
    guess scatters, and the mean of a convex function is more than the function of the mean, 0.2 sigma to 0.3 sigma
    more from 0.7 sigma to 2 sigma. Where r is below sigma there is no root, and the bias is that without a signal.

    The mean of any function of r is an analytic function of m^2, which |m| at 0 is not: no estimate is right at all
    |m|. The mean of this one is right to 0.03 sigma from |m| = 3 sigma on, to 0.09 sigma from 0.6 sigma on, and too
    small below, by half a sigma where there is no signal. It falls from sigma sqrt(pi/2) at r = 0 on.

    Parameters
    ----------
    modulus : ArrayLike
        |m + noise|, any shape.
    sigma_across : ArrayLike
        Rms of the noise across m, of that shape, same unit.
    """
    r, s = np.broadcast_arrays(np.asarray(modulus, dtype=np.float64), np.asarray(sigma_across, dtype=np.float64))
    root = np.sqrt(np.maximum(r - s, 0.0) * (r + s))
    # not as the difference of two long numbers; without signal and noise it is 0
    long = r + root
    return np.where(r < s, np.sqrt(np.pi / 2.0) * s, s * (s / np.where(long > 0.0, long, 1.0)))


def rice_sigma(modulus: ArrayLike, sigma_along: ArrayLike, sigma_across: ArrayLike) -> Array:
    """Standard deviation of |m + noise|.

    Exact for equal noise along and across m, and in the limit of a large m, where only the noise along it counts.

    Parameters
    ----------
    modulus : ArrayLike
        |m|, any shape.
    sigma_along : ArrayLike
        Of the noise along m, of that shape.
    sigma_across : ArrayLike
        Across m, likewise.
    """
    m, along, across = np.broadcast_arrays(
        np.asarray(modulus, dtype=np.float64), np.asarray(sigma_along), np.asarray(sigma_across)
    )
    mean = m + rice_bias(m, across)
    # E|z|^2 - mean^2, written without the cancelling squares
    rice = 2.0 * across**2 - (mean - m) * (mean + m)
    return np.sqrt(np.maximum(rice + along**2 - across**2, 0.0))


def signal_modulus(modulus: ArrayLike, sigma_along: ArrayLike, sigma_across: ArrayLike) -> Array:
    """Best guess of |m| from a measured |m + noise|: its square less the mean square of the noise, not below 0.

    Parameters
    ----------
    modulus : ArrayLike
        |m + noise|, any shape.
    sigma_along : ArrayLike
        Of the noise along m, of that shape.
    sigma_across : ArrayLike
        Across m, likewise.
    """
    square = np.square(modulus) - np.square(sigma_along) - np.square(sigma_across)
    return np.sqrt(np.maximum(square, 0.0))
