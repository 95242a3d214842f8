"""A quantity over the size of a change, and the size at which it first passes a limit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

ROUNDS, NEAR = 3, 1e-3
"""Refinement steps at most; and how near a point to a limit, relative to the size, makes another one needless."""

Sample = Callable[[np.ndarray], Mapping[str, np.ndarray]]
"""Sizes (N,) -> name -> values (N,), not negative; 1 is the limit."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Quantities over the size of a change.

    Attributes:
        size: (N,), ascending, > 0.
        value: name -> (N,), as shares of what is allowed.
    """

    size: np.ndarray
    value: Mapping[str, np.ndarray]

    def bracket(self, name: str) -> int | None:
        """Index of the first size at which the limit is passed, None where it is not."""
        beyond = np.flatnonzero(self.value[name] > 1.0)
        return int(beyond[0]) if len(beyond) else None

    def crossing(self, name: str) -> float | None:
        """Size at which the limit is first passed, interpolated on logarithmic axes; None where it is not.

        0 where it is passed at the smallest size already.
        """
        k = self.bracket(name)
        if k is None:
            return None
        if k == 0:
            return 0.0
        (low, high), (a, b) = np.log(self.size[k - 1 : k + 1]), self.value[name][k - 1 : k + 1]
        start, end = math.log(max(a, 1e-9)), math.log(b)
        return math.exp(low - start * (high - low) / (end - start))

    def merged(self, size: np.ndarray, value: Mapping[str, np.ndarray]) -> Curves:
        """With more points."""
        every = np.concatenate([self.size, size])
        order = np.argsort(every)
        return Curves(every[order], {n: np.concatenate([v, value[n]])[order] for n, v in self.value.items()})


@dataclass(frozen=True, eq=False)
class Domain:
    """How far something holds: followed in images as far as they go, traced on from there, until the beam is lost.

    Attributes:
        images, traced: curves over the size; both have the same names.
        lost: size beyond which the beam is lost or not followed.
        lost_why: which of the two.
    """

    images: Curves
    traced: Curves
    lost: float
    lost_why: str

    def limit(self, name: str) -> tuple[float, str]:
        """Largest size within a limit, and whence it is known: "images", "trace" or why there is none."""
        for curves, whence in ((self.images, "images"), (self.traced, "trace")):
            found = curves.crossing(name)
            if found is not None:
                return found, whence
        return self.lost, self.lost_why


def sampled(sample: Sample, sizes: Sequence[float], names: Sequence[str] | None = None) -> Curves:
    """Curves at given sizes, with points added where they pass the limit.

    Args:
        sample: what is sampled.
        sizes: to begin with, ascending.
        names: whose limits are refined; all by default.
    """
    first = np.array(sizes, dtype=float)
    curves = Curves(first, sample(first))
    wanted = tuple(curves.value) if names is None else names
    for _ in range(ROUNDS):
        new: list[float] = []
        for x in sorted(x for x in (curves.crossing(name) for name in wanted) if x):
            if np.min(np.abs(curves.size / x - 1.0)) > NEAR and (not new or x > (1.0 + NEAR) * new[-1]):
                new.append(x)
        if not new:
            break
        curves = curves.merged(np.array(new), sample(np.array(new)))
    return curves
