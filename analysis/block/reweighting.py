"""What residuals say of weights: robust weights of packets of rows, and factors on the variances of groups.

Of an adjustment of any kind: a campaign's (`analysis.calibration`) and a block's.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import numpy as np
from scipy.stats import chi2

from analysis.arrays import Array, MeasurementError
from analysis.statistics import robust_variance

S = TypeVar("S", bound="Weighted")
T = TypeVar("T")
SETTLED = 1e-3
"""Largest change of weights at rest, and the largest weight of a packet that counts as given up."""
_ROUNDS = 50
_FREE_ROUNDS = 12
"""From then on weights that leave packets out only fall: two of a point that are doubted in turns would never rest."""
Robust = Literal["huber", "igg"]
# Lengths of standardised residuals of image points, Rayleigh for good ones. Beyond HUBER lie 5 in 100 good points, they
# lose weight; beyond REJECT 1 in 10 000, they are left out (IGG III: Yang, Song and Xu, J. Geodesy 76 (2002) 353).
HUBER = float(np.sqrt(chi2.isf(0.05, 2)))
REJECT = float(np.sqrt(chi2.isf(1e-4, 2)))
_LEAST_REDUNDANCY = 10.0
"""A variance from fewer redundant observations is uncertain by 45% or more: the group keeps its factor."""
# A part of an image point that no other observation checks has no residual to standardise.
_UNCHECKED = 1e-6
_LARGEST_RATIO = 0.9
LARGEST_FACTOR = 1e2
"""Largest factor on a variance; the smallest is its inverse. Weights cannot correct sigmas that are wrong by more than
a factor of ten.
"""


@dataclass(frozen=True)
class GroupTest:
    """A variance group after the adjustment.

    Attributes
    ----------
    count : int
        observations. redundancy: how many of them the others check.
    square : float
        Their weighted squares, whose expectation is the redundancy.
    factor : float
        On the variances; 1 where not estimated.
    """

    count: int
    redundancy: float
    square: float
    factor: float

    @property
    def ratio(self) -> float:
        """Variance of the residuals over that which the sigmas predict; NaN where nothing checks the group."""
        return self.square / self.redundancy if self.redundancy > 1e-6 else float("nan")

    @property
    def estimated(self) -> float:
        """Next factor on the variances, by Foerstner's estimate, within 1 / `LARGEST_FACTOR` and `LARGEST_FACTOR`.

        It is unbiased for packets of weight 1 and 0; a weight that falls with the residual makes it too small.
        """
        return bounded(self.factor * self.ratio) if self.redundancy >= _LEAST_REDUNDANCY else self.factor

    @property
    def p_value(self) -> float:
        """Two-sided chance of such squares, as of a chi-square with the redundancy for its freedom."""
        if self.redundancy < 1.0:
            return 1.0
        high = float(chi2.sf(self.square, self.redundancy))
        return 2.0 * min(high, 1.0 - high)


class UnsettledError(MeasurementError, ValueError):
    """Weights that do not come to rest."""


def standardised_packets(residual: Array, cofactors: Array, weight: Array, unit: float) -> Array:
    """(n, d) whitened residuals of n packets of d rows over their own standard deviation.

    An observation of variance C that takes part with weight w, G that of the adjusted one: without it the others would
    predict it with H = G / (1 - w G / C), and the residual is (1 - w G / C) times observed minus predicted. Its
    variance is (1 - w G / C) (C + (1 - w) G): less than C with full weight, C + G without any. So the standardised
    residual does not depend on the observation's own weight, which could otherwise swing for ever where others hardly
    check it. It is exact where the weights of the others stand for their variances.

    Parameters
    ----------
    residual : Array
        Whitened, (n, d).
    cofactors : Array
        Covariance of the adjusted packets, whitened, (n, d, d).
    weight : Array
        Robust weights, (n,).
    unit : float
        Variance factor of their group.
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
    """(n,) weights of packets from their standardised residuals (n, d), d = 2 for image points.

    Huber's, IGG III that ends in zero, or "accept": 1 up to that end and zero beyond.
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


def limits(rows: int) -> tuple[float, float]:
    """Lengths of standardised residuals of so many rows from which on a packet loses weight, and is left out."""
    return float(np.sqrt(chi2.isf(0.05, rows))), float(np.sqrt(chi2.isf(1e-4, rows)))


def bounded(factor: float) -> float:
    """A variance factor within its bounds."""
    return float(np.clip(factor, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR))


def extrapolated(factors: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Where three rounds of variance factors lead to, by Aitken's rule in the logarithm.

    Factors of groups that check each other creep: rounds leave up to nine tenths of the way.
    """
    found = {}
    for group in factors[-1]:
        first, middle, last = (float(np.log(max(f[group], 1e-300))) for f in factors)
        ratio = (last - middle) / (middle - first) if middle != first else 0.0
        ratio = min(max(ratio, 0.0), _LARGEST_RATIO)
        found[group] = bounded(float(np.exp(last + (last - middle) * ratio / (1.0 - ratio))))
    return found


@dataclass(frozen=True)
class Rule:
    """How weights of packets and factors of groups follow from residuals.

    Attributes
    ----------
    packets : Robust | Literal['accept'] | None
        Huber's weights, IGG III, or "accept": 1 up to where IGG III ends and zero beyond; None leaves them.
    factor : Literal['median', 'components'] | None
        Of the image points by the median of their residuals, or of groups by variance components; None leaves them.
    groups : Collection[str] | None
        Whose components are estimated; None for all.
    screening : int
        Rounds with Huber's weights that come first, in which no factor is estimated.
    tolerance : float
        Largest change of a weight, or relative one of a factor, at rest.
    """

    packets: Robust | Literal["accept"] | None = None
    factor: Literal["median", "components"] | None = None
    groups: Collection[str] | None = None
    screening: int = 0
    tolerance: float = SETTLED


class Weighted(Protocol):
    """A state with weights."""

    @property
    def weight(self) -> tuple[Array, ...]:
        """Robust weights of each set of packets, 0 to 1."""

    @property
    def factor(self) -> Mapping[str, float]:
        """Group -> factor on its variances."""


class Reweighted(Protocol[S, T]):
    """An adjustment, as far as its weights are concerned: states S, solutions T."""

    def solve(self, at: S, screening: bool) -> tuple[S, T]:
        """State and solution with the weights of a state; a rough one will do while gross errors are looked for."""

    def judged(self, at: S, found: T) -> tuple[Array, ...]:
        """Standardised residuals of each set of packets."""

    def tests(self, at: S, found: T) -> Mapping[str, GroupTest]:
        """Variance groups."""

    def weighed(self, at: S, weight: tuple[Array, ...], factor: Mapping[str, float]) -> S:
        """The state with other weights, and with none at points that too little is left of.

        Parameters
        ----------
        at : S
            state.
        weight : tuple[Array, ...]
            Robust weights of each set of packets, (n,), 0 to 1.
        factor : Mapping[str, float]
            Group -> factor on its variances.
        """


def settled(problem: Reweighted[S, T], at: S, rule: Rule) -> tuple[S, T]:
    """Solve until weights and factors rest.

    Raises
    ------
    UnsettledError
        They do not.
    """
    factors: list[Mapping[str, float]] = []
    for turn in range(_ROUNDS):
        screening = turn < rule.screening
        at, found = problem.solve(at, screening)
        if rule.packets is None and rule.factor is None:
            return at, found
        weight, factor = at.weight, dict(at.factor)
        standard = () if rule.packets is None and rule.factor == "components" else problem.judged(at, found)
        if rule.factor == "median":
            factor["image"] = bounded(factor["image"] * robust_variance(np.sum(np.concatenate(standard) ** 2, axis=1)))
        elif rule.factor == "components" and not screening:
            tests = problem.tests(at, found)
            factor |= {g: one.estimated for g, one in tests.items() if rule.groups is None or g in rule.groups}
            factors.append(factor)
        if rule.packets is not None:
            kind = "huber" if screening else rule.packets
            weight = tuple(robust_weights(one, kind) for one in standard)
            if kind != "huber" and turn >= _FREE_ROUNDS:
                weight = tuple(np.minimum(new, old) for new, old in zip(weight, at.weight, strict=True))
        new = problem.weighed(at, weight, factor)
        changes = [float(np.abs(a - b).max(initial=0.0)) for a, b in zip(new.weight, at.weight, strict=True)]
        change = max(*changes, *(abs(factor[g] / at.factor[g] - 1.0) for g in factor))
        if change < rule.tolerance and not screening:
            return at, found
        if len(factors) == 3:
            new, factors = problem.weighed(new, new.weight, extrapolated(factors)), []
        at = new
    raise UnsettledError(f"weights do not settle in {_ROUNDS} rounds, the last change is {change:.2g}")
