"""Chauvenet's criterion for gross errors among repeated readings (W. Chauvenet, A Manual of Spherical and Practical
Astronomy, 1863, vol. 2, app. sect. 54-60; used in paper 004, section 3.3).

Of n readings one is rejected when so large a deviation from their mean is expected fewer than half a time:

    n P(|z| > |x - mean| / s) < 1/2,    s^2 = sum (x - mean)^2 / (n - 1),

with the two-sided tail P of the normal distribution. The textbook rule is applied once. Applied again to what is left
it finds errors that hid behind a larger one, but it also takes more of the good readings; so it is an option.

The rule always takes some good readings (of ten normal ones 0.28 on average), and takes the outermost, so that the RMS
of those it leaves is too small. `normal_reduction` says by how much.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import beta, norm

__all__ = ["FEWEST", "chauvenet", "expected_rejections", "limit", "normal_reduction", "rejection_rate"]

Array = NDArray[np.float64]
FEWEST = 3
"""Of fewer readings none is rejected: two deviate by the same amount."""


def limit(n: ArrayLike) -> Array:
    """Largest deviation that stays, in units of s, for n readings."""
    return np.asarray(norm.isf(0.25 / np.asarray(n, np.float64)))


def chauvenet(
    readings: ArrayLike, repeated: bool = False, present: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Which readings to keep, (..., n) bool.

    Args:
        readings: (..., n); the last axis holds the repeats of one quantity, in any unit.
        repeated: apply the rule again to what is left, until nothing more goes.
        present: (..., n), which of them were taken, where quantities have different numbers of repeats; the others
            hold any finite number and are not kept. None for all.

    Raises:
        ValueError: not finite.
    """
    x = np.asarray(readings, np.float64)
    if not np.all(np.isfinite(x)):
        raise ValueError("Chauvenet's criterion: readings must be finite; leave failed readings out")
    keep = np.ones(x.shape, bool) if present is None else np.array(present, bool)
    x = np.where(keep, x, 0.0)
    for _ in range(x.shape[-1] if repeated else 1):
        count = keep.sum(-1, keepdims=True)
        deviation = np.abs(x - np.mean(x, -1, keepdims=True, where=keep))
        s = np.sqrt(np.sum(deviation**2, -1, keepdims=True, where=keep) / np.maximum(count - 1, 1))
        # the comparison without a division: equal readings have s = 0 and stay
        gross = keep & (deviation > limit(count) * s) & (count >= FEWEST)
        # deviations of rounding size are not gross errors
        gross &= deviation > 8.0 * np.finfo(float).eps * np.max(np.abs(x), -1, keepdims=True)
        if not np.any(gross):
            break
        keep &= ~gross
    return keep


def rejection_rate(n: int) -> float:
    """Probability that the single pass rejects a given one of n normal readings.

    (x - mean)^2 / s^2 times n / (n - 1)^2 has the beta distribution (1/2, (n - 2)/2).
    """
    return float(beta.sf(_scaled(n), 0.5, 0.5 * (n - 2))) if n >= FEWEST else 0.0


def expected_rejections(counts: NDArray[np.int64]) -> float:
    """How many of series of so many normal readings, (N,), the single pass rejects on average."""
    sizes, times = np.unique(counts, return_counts=True)
    return float(sum(rejection_rate(int(n)) * (int(n) * int(many)) for n, many in zip(sizes, times, strict=True)))


def normal_reduction(n: int | NDArray[np.int64]) -> float:
    """E[sum of squares left] / E[degrees of freedom left] / sigma^2 for n normal readings after the single pass.

    The pooled variance of cleaned series is divided by it. x - mean over s is independent of s (Basu), so a reading
    outside the limit takes n/(n - 1) (x - mean)^2 out of the sum, on average sigma^2 times the tail of the beta
    distribution (3/2, (n - 2)/2). That two readings of one series go at once is left out: rare for n below some 20.

    n: of every series, or (N,) of each of them.
    """
    sizes, times = np.unique(n, return_counts=True)
    parts = [_left(int(size)) for size in sizes]
    if len(parts) == 1:
        return parts[0][0] / parts[0][1]
    square, freedom = (float(times @ np.array(part)) for part in zip(*parts, strict=True))
    return square / freedom


def _left(n: int) -> tuple[float, float]:
    """Expected sum of squares in sigma^2, and degrees of freedom, that the pass leaves of n normal readings."""
    if n < FEWEST:
        return float(max(n - 1, 1)), float(max(n - 1, 1))
    square = float(beta.sf(_scaled(n), 1.5, 0.5 * (n - 2)))
    return n - 1 - n * square, n - 1 - n * rejection_rate(n)


def _scaled(n: int) -> float:
    return min(float(limit(n)) ** 2 * n / (n - 1) ** 2, 1.0)
