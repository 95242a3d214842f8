"""Robust weights of measurements, and variance factors of groups of observations, from residuals.

A packet is the d equations that one measurement of one ground point gives; it has one weight.

The module serves adjustments of any kind: a calibration campaign's (`analysis.calibration`) and a block's.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, Protocol, TypeVar

import numpy as np
from scipy.stats import chi2

from analysis.arrays import Array, MeasurementError
from analysis.statistics import robust_variance

S = TypeVar("S", bound="Weighted")
T = TypeVar("T")
SETTLED = 1e-3
"""Largest change of robust weights at convergence, and largest weight of a rejected measurement."""
_ROUNDS = 50
"""Largest number of rounds of reweighting."""
Robust = Literal["huber", "igg"]
_Weigh = Callable[[tuple[Array, ...], tuple[Array, ...]], tuple[Array, ...]]
# Limits of the standardised residual of an image point, which is Rayleigh-distributed for good points. Of these,
# 5 in 100 exceed HUBER and lose weight; 1 in 10 000 exceed REJECT and are excluded (IGG III: Yang, Song and Xu,
# J. Geodesy 76 (2002) 353).
HUBER = float(np.sqrt(chi2.isf(0.05, 2)))
REJECT = float(np.sqrt(chi2.isf(1e-4, 2)))
_LEAST_REDUNDANCY = 10.0
"""Smallest redundancy from which a variance is estimated. With less, the variance is uncertain by 45 % or more, and the
group keeps its factor.
"""
_UNCHECKED = 1e-6
"""Redundancy below which an equation counts as unchecked by the others; its residual cannot be standardised."""
_LARGEST_RATIO = 0.9
"""Largest ratio of successive changes of a variance factor for which its limit is extrapolated."""
LARGEST_FACTOR = 1e2
"""Largest variance factor; the smallest is its inverse. Weights cannot correct sigmas that are wrong by more than a
factor of ten.
"""


@dataclass(frozen=True)
class GroupTest:
    """Test of a variance group after the adjustment.

    Attributes
    ----------
    count : int
        Number of observations.
    redundancy : float
        Redundancy of the group, the number of observations that others check.
    square : float
        Weighted sum of squared residuals, whose expectation is the redundancy.
    factor : float
        Variance factor; 1 if not estimated.
    """

    count: int
    redundancy: float
    square: float
    factor: float

    @property
    def ratio(self) -> float:
        """Ratio of the residuals' variance to that predicted by the sigmas; NaN without redundancy."""
        return self.square / self.redundancy if self.redundancy > 1e-6 else float("nan")

    @property
    def estimated(self) -> float:
        """Next variance factor by Foerstner's estimate, between 1 / `LARGEST_FACTOR` and `LARGEST_FACTOR`.

        It is unbiased for measurements of weight 1 and 0; a weight that decreases with the residual makes it too small.
        """
        return bounded(self.factor * self.ratio) if self.redundancy >= _LEAST_REDUNDANCY else self.factor

    @property
    def p_value(self) -> float:
        """Two-sided p-value of the sum of squares, as a chi-square with the redundancy as its degrees of freedom."""
        if self.redundancy < 1.0:
            return 1.0
        high = float(chi2.sf(self.square, self.redundancy))
        return 2.0 * min(high, 1.0 - high)


class UnsettledError(MeasurementError, ValueError):
    """Error raised if robust weights or variance factors do not converge."""


def standardised_packets(residual: Array, cofactors: Array, weight: Array, unit: float) -> Array:
    """Return the standardised residuals of n measurements (packets) of d equations each, (n, d).

    Let an observation of variance C have the weight w, and G be the variance of the adjusted observation. Without it
    the others would predict it with H = G / (1 - w G / C), and the residual is (1 - w G / C) times observed minus
    predicted. Its variance is (1 - w G / C) (C + (1 - w) G): less than C with full weight, C + G with none. The
    standardised residual therefore does not depend on the observation's own weight, which could otherwise oscillate
    where others hardly check it. It is exact if the weights of the others correspond to their variances.

    Parameters
    ----------
    residual : (n, d) ndarray
        Whitened residuals.
    cofactors : (n, d, d) ndarray
        Covariances of the adjusted measurements, whitened by the a-priori covariances.
    weight : (n,) ndarray
        Robust weights.
    unit : float
        Variance factor of the measurements' group.
    """
    values, axes = np.linalg.eigh(cofactors)
    along = np.einsum("nji,nj->ni", axes, residual)
    weight = weight[:, None]
    left = 1.0 - weight * values / unit
    checked = left > _UNCHECKED
    spread = np.where(checked, left, 1.0) * (unit + (1.0 - weight) * np.maximum(values, 0.0))
    along = np.where(checked, along / np.sqrt(spread), 0.0)
    return np.asarray(np.einsum("nij,nj->ni", axes, along))


def robust_weights(standard: Array, kind: Robust | Literal["accept"]) -> Array:
    """Return the robust weights of n measurements of d equations from their standardised residuals, (n, d).

    The weights are Huber's, IGG III, which decrease to zero, or "accept": 1 up to that zero and 0 beyond.

    Raises
    ------
    ValueError
        The kind is unknown.
    """
    size = np.linalg.norm(standard, axis=1)
    huber, reject = limits(standard.shape[1])
    if kind == "accept":
        return np.asarray(size <= reject, np.float64)
    weight = np.minimum(1.0, huber / np.maximum(size, 1e-300))
    if kind == "huber":
        return np.asarray(weight)
    if kind != "igg":
        raise ValueError(f"robust weights: kind must be huber, igg or accept, found {kind!r}")
    fall = np.clip((reject - size) / (reject - huber), 0.0, 1.0)
    return np.asarray(np.where(size <= huber, 1.0, weight * fall**2))


@cache
def limits(rows: int) -> tuple[float, float]:
    """Return the norms of a measurement's standardised residuals above which it is down-weighted and rejected.

    The first norm is exceeded by 5 %, the second by 1e-4 of good measurements of `rows` equations.
    """
    return float(np.sqrt(chi2.isf(0.05, rows))), float(np.sqrt(chi2.isf(1e-4, rows)))


def bounded(factor: float) -> float:
    """Return a variance factor limited to the range from 1 / `LARGEST_FACTOR` to `LARGEST_FACTOR`."""
    return float(np.clip(factor, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR))


def extrapolated(factors: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the limit of three rounds of variance factors by Aitken's rule, applied to the logarithm.

    Factors of groups that check each other converge slowly: a round may leave up to nine tenths of the distance.
    """
    limits_of_groups = {}
    for group in factors[-1]:
        first, middle, last = (float(np.log(max(f[group], 1e-300))) for f in factors)
        ratio = (last - middle) / (middle - first) if middle != first else 0.0
        ratio = min(max(ratio, 0.0), _LARGEST_RATIO)
        limits_of_groups[group] = bounded(float(np.exp(last + (last - middle) * ratio / (1.0 - ratio))))
    return limits_of_groups


@dataclass(frozen=True)
class Rule:
    """Settings of the reweighting: how weights of measurements and variance factors of groups follow from residuals.

    Attributes
    ----------
    packets : {'huber', 'igg', 'accept'}, callable or None
        Weights of the measurements (packets of equations): Huber's weights, IGG III, or "accept": 1 up to the end of
        IGG III and 0 beyond; or a function from the standardised residuals and the weights of each set to weights 1
        and 0; None for unchanged weights.
    factor : {'median', 'components'} or None
        Factor of the image points from the median of their residuals, or of groups by variance components; None for
        unchanged factors.
    groups : collection of str or None
        Groups whose components are estimated; None for all.
    screening : int
        Number of first rounds with Huber's weights, in which no factor is estimated.
    tolerance : float
        Largest change of a weight, or relative change of a factor, at convergence.
    free : int
        Number of rounds after which rejecting weights can only decrease: two measurements of a point that are rejected
        alternately would otherwise never converge.
    """

    packets: Robust | Literal["accept"] | _Weigh | None = None
    factor: Literal["median", "components"] | None = None
    groups: Collection[str] | None = None
    screening: int = 0
    tolerance: float = SETTLED
    free: int = 12


class Weighted(Protocol):
    """Interface of an adjustment's state that holds robust weights and variance factors."""

    @property
    def weight(self) -> tuple[Array, ...]:
        """Robust weights of the measurements of each set of observations, 0 to 1."""

    @property
    def factor(self) -> Mapping[str, float]:
        """Factor on the a-priori variance of each group of observations, by its name."""


class Reweighted(Protocol[S, T]):
    """Interface of an adjustment that `settled` reweights, with states of type S and solutions of type T."""

    def solve(self, at: S, screening: bool) -> tuple[S, T]:
        """Return state and solution of the adjustment with fixed weights; a rough solution suffices while screening."""

    def judged(self, at: S, solution: T) -> tuple[Array, ...]:
        """Return the standardised residuals of each set of observations, (n, d) for n measurements of d equations."""

    def tests(self, at: S, solution: T) -> Mapping[str, GroupTest]:
        """Return the test of the residuals' variance of each group of observations, by its name."""

    def weighed(self, at: S, weight: tuple[Array, ...], factor: Mapping[str, float]) -> S:
        """Return the state with other weights, and with zero weight at points with too few remaining observations.

        Parameters
        ----------
        at : S
            Current state.
        weight : tuple of (n,) ndarray
            Robust weights of the n measurements of each set of observations, 0 to 1.
        factor : mapping of str to float
            Variance factor of each group.
        """


def settled(problem: Reweighted[S, T], state: S, rule: Rule) -> tuple[S, T]:
    """Solve an adjustment repeatedly until weights and variance factors converge.

    Raises
    ------
    UnsettledError
        The weights or the variance factors do not converge.
    """
    factors: list[Mapping[str, float]] = []
    for round_number in range(_ROUNDS):
        screening = round_number < rule.screening
        state, solution = problem.solve(state, screening)
        if rule.packets is None and rule.factor is None:
            return state, solution
        weight, factor = state.weight, dict(state.factor)
        standard = () if rule.packets is None and rule.factor == "components" else problem.judged(state, solution)
        if rule.factor == "median":
            factor["image"] = bounded(factor["image"] * robust_variance(np.sum(np.concatenate(standard) ** 2, axis=1)))
        elif rule.factor == "components" and not screening:
            tests = problem.tests(state, solution)
            factor |= {g: test.estimated for g, test in tests.items() if rule.groups is None or g in rule.groups}
            factors.append(factor)
        if rule.packets is not None:
            kind = "huber" if screening else rule.packets
            if callable(kind):
                weight = kind(standard, state.weight)
            else:
                weight = tuple(robust_weights(test, kind) for test in standard)
            if kind != "huber" and round_number >= rule.free:
                weight = tuple(
                    np.minimum(new_state, old_weight)
                    for new_state, old_weight in zip(weight, state.weight, strict=True)
                )
        new_state = problem.weighed(state, weight, factor)
        changes = [float(np.abs(a - b).max(initial=0.0)) for a, b in zip(new_state.weight, state.weight, strict=True)]
        change = max(*changes, *(abs(factor[g] / state.factor[g] - 1.0) for g in factor))
        if change < rule.tolerance and not screening:
            return state, solution
        if len(factors) == 3:
            new_state, factors = problem.weighed(new_state, new_state.weight, extrapolated(factors)), []
        state = new_state
    raise UnsettledError(f"weights do not converge in {_ROUNDS} rounds, the last change is {change:.2g}")
