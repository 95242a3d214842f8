"""How large a jump has to be to be found: of each body, by simulation of the test that finds it.

After many readings at even intervals, what a step does to the next ones no longer depends on when it comes. With the
information J of n readings on a step of the outputs (`series_filter`), the score of n readings after a step a is

    b(n) = b(n-1) + N((J(n) - J(n-1)) a, J(n) - J(n-1)),

so that the readings themselves need not be drawn. Directions of a are random as the prior states them, and its size is
the root mean square of its motions over their stated standard deviations. The jump is found with the first reading at
which any candidate passes the limit of the search, that of the place before the first reading after it alone: places
beside it can only find it earlier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.arrays import Array
from analysis.covariance_root import covariance_root
from analysis.monitor.filter_state import Observed
from analysis.monitor.jump_detection import UNSEEN
from analysis.monitor.series_filter import SeriesFilter
from analysis.statistics import limit_of

READINGS, SHARES = (1, 3, 10), (0.5, 0.95)
"""Numbers of readings after a jump within which it is found, and in which share of cases."""
_SIZES = np.geomspace(0.03, 100.0, 71)
"""Sizes that are tried, over those stated: 12 percent apart."""
_DRAWS, _BEFORE = 400, 20
"""Jumps of each size, by which 95 percent are known to 1.1; and readings before, by which information is steady."""


@dataclass(frozen=True, eq=False)
class Power:
    """Smallest jumps of a body that are found.

    Attributes:
        body: whose they are.
        sizes: (readings, shares) the smallest of which so many are found within so many readings, root mean square of
            its motions over their stated standard deviations; NaN where the largest that is tried is not.
    """

    body: str
    sizes: Array

    @property
    def plain(self) -> dict[str, float | None]:
        """Share and number of readings -> size; None for none."""
        keys = [f"{round(100 * share)}_percent_within_{n}" for n in READINGS for share in SHARES]
        return {
            key: size if size == size else None for key, size in zip(keys, self.sizes.ravel().tolist(), strict=True)
        }


def detection_power(how: SeriesFilter, interval: float, noise: Array, seed: int = 0) -> tuple[Power, ...]:
    """Return the smallest jump of each body that is found in half and in 95 % of cases within 1, 3 and 10 readings.

    Args:
        how: the filter that looks for jumps.
        interval: seconds from one reading of the spots to the next.
        noise: (D, D) px^2 of a reading.
        seed: of the drawn jumps.
    """
    informations, may = _informations(how, interval, noise), how.candidates
    if not may:
        return ()
    looks = float(how.looks(interval))
    tests = [[_test(one.spots, j, how.stated.jump_false_alarm / looks) for one in may] for j in informations]
    out: list[Power] = []
    for body in dict.fromkeys(one.body for one in may):
        own = max((one for one in may if one.body == body), key=lambda one: len(one.motions))
        found = _found(own.spots, informations, tests, np.random.default_rng([seed, len(out)]))
        out.append(Power(body, np.array([[_smallest(found[n - 1], share) for share in SHARES] for n in READINGS])))
    return tuple(out)


def _informations(how: SeriesFilter, interval: float, noise: Array) -> Array:
    """(N, q, q) on a step, by 1 to N readings after it."""
    belief, nothing = how.start(0.0), np.zeros(len(noise))
    out: list[Array] = []
    for k in range(_BEFORE + READINGS[-1]):
        belief, _ = how.update(belief, Observed(k * interval, nothing, noise))
        if k >= _BEFORE and len(belief.until):
            out.append(belief.looking.information[-1 - (k - _BEFORE)])
    return np.array(out)


def _test(spots: Array, information: Array, chance: float) -> tuple[Array, float]:
    """(r, q) what makes independent numbers of a score, and the limit of the sum of their squares."""
    values, vectors = np.linalg.eigh(spots.T @ information @ spots)
    seen = values > UNSEEN * values.max()
    return (vectors[:, seen] / np.sqrt(values[seen])).T @ spots.T, float(limit_of(chance, int(np.sum(seen))))


def _found(
    spots: Array, informations: Array, tests: Sequence[Sequence[tuple[Array, float]]], rng: np.random.Generator
) -> Array:
    """(N, S) shares of jumps of each size that are found with 1 to N readings."""
    amounts = rng.standard_normal((_DRAWS, spots.shape[1]))
    amounts *= np.sqrt(spots.shape[1]) / np.linalg.norm(amounts, axis=1, keepdims=True)
    step, noise, before = amounts @ spots.T, np.zeros((_DRAWS, len(spots))), np.zeros_like(informations[0])
    told, out = np.zeros((len(_SIZES), _DRAWS), bool), []
    for information, those in zip(informations, tests, strict=True):
        drawn = rng.standard_normal(noise.shape) @ covariance_root(information - before).T
        noise, before = noise + drawn, information
        score = _SIZES[:, None, None] * (step @ information) + noise
        for away, limit in those:
            told |= np.sum((score @ away.T) ** 2, axis=2) > limit
        out.append(told.mean(axis=1))
    return np.array(out)


def _smallest(found: Array, share: float) -> float:
    """Size from which on a share of jumps is found; NaN for none."""
    less = np.flatnonzero(found < share)
    first = less[-1] + 1 if len(less) else 0
    if first == len(_SIZES):
        return float("nan")
    if first == 0:
        return float(_SIZES[0])
    part = (share - found[first - 1]) / (found[first] - found[first - 1])
    return float(_SIZES[first - 1] * (_SIZES[first] / _SIZES[first - 1]) ** part)
