"""Whether the readings' errors follow their stated laws: serial correlation of what should be independent.

With the right law the whitened unknowns e of a process are independent, of unit variance; those that are estimated have
the covariance S = I - C, with C that of the whitened errors after the adjustment. The sum q of the products of
neighbours in time then has the expectation tr(L S) and the variance 2 tr(L S L S), L the matrix of neighbours: exactly,
however little of the process the observations tell. White noise that is a walk in truth has neighbours that are alike,
a walk that is white noise in truth neighbours that are opposite. The size of the errors is what variances tell
(`GroupTest`), and q is compared at the variance that they have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from analysis.block.assembly import Process
from analysis.block.block_adjustment import BlockAdjustment

Array = NDArray[np.float64]
_KINDS = ("white", "walk", "slow")
_LARGEST = 4000
"""Unknowns of one process above which it is not tested; its matrices are dense."""
_LEAST = 2.0
"""Redundancy of a law below which nothing can be said of neighbours."""


@dataclass(frozen=True)
class LawTest:
    """Neighbours in time of one law's errors, in all its scopes.

    Attributes:
        group: of the law. kind: as stated.
        excess: sum of products of neighbours beyond its expectation, in standard deviations; positive where they are
            alike.
    """

    group: str
    kind: str
    excess: float

    @property
    def p_value(self) -> float:
        """Two-sided chance of such an excess."""
        return float(2.0 * norm.sf(abs(self.excess)))

    def __str__(self) -> str:
        alike = "alike" if self.excess > 0 else "opposite"
        return (
            f"{self.group}: errors that should be independent in a {self.kind} process are {alike} in neighbours"
            f" ({self.excess:+.1f} sigma, chance {self.p_value:.1g}): the stated law is not that of the readings"
        )


def law_tests(found: BlockAdjustment) -> tuple[LawTest, ...]:
    """A test of each law with a course in time that the observations tell something of."""
    sums: dict[str, list[float]] = {}
    kinds: dict[str, str] = {}
    for one in found.assembly.every:
        law = one.support.law
        if law.kind not in _KINDS or one.support.size > _LARGEST or len(one.support.numbers) < 3:
            continue
        value, mean, variance, told = _neighbours(found, one)
        kinds[law.group] = law.kind
        total = sums.setdefault(law.group, [0.0, 0.0, 0.0, 0.0])
        for k, part in enumerate((value, mean, variance, told)):
            total[k] += part
    tests = []
    for group, (value, mean, variance, told) in sums.items():
        if told >= _LEAST and variance > 0.0:
            tests.append(LawTest(group, kinds[group], (value - mean) / float(np.sqrt(variance))))
    return tuple(tests)


def _neighbours(found: BlockAdjustment, one: Process) -> tuple[float, float, float, float]:
    """Sum of products of neighbours, its expectation and variance, and the redundancy of the process."""
    root = np.kron(one.support.whitened(), np.eye(3))
    whitened = root.T @ found.x[one.columns]
    own = found.covariance[np.ix_(one.columns, one.columns)]
    factor = found.factors[one.support.law.group]
    spread = factor * np.eye(len(whitened)) - root.T @ own @ root
    told = float(np.trace(spread)) / factor
    size = float(whitened @ whitened) / max(float(np.trace(spread)), 1e-12)
    near = np.zeros_like(spread)
    rows = np.arange(len(whitened) - 3)
    near[rows, rows + 3] = near[rows + 3, rows] = 0.5
    product = near @ spread
    # at the variance that the errors have: a wrong size alone is no wrong law
    scale = max(size, 1.0) if told > _LEAST else 1.0
    mean, variance = float(np.trace(product)), 2.0 * float(np.sum(product * product.T))
    return float(whitened @ near @ whitened) / scale, mean, variance, told
