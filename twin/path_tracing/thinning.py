"""How many of the paths that leave nominal light are worth following, learned from the first paths of a run.

Paths that turn away at the same place of the nominal way form a class. Some classes bring light to the detectors, such
as reflections inside a prism; others bring none, and may be long. With v the sum of the squared weights that a class
brings and c the surfaces that it meets, the variance of a run in a given time is least where each class is followed
with a probability that goes as sqrt(v / c) (Neyman, 1934, for strata of unequal costs). Those that go on carry more
weight, so that all sums stay the same on average. Paths that miss a surface of the nominal way are all followed: they
carry most of the light, and are short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LEAST_KEPT = 0.2
"""Least probability of following a path: what the first paths have not found may be there, and is found with at most
five times the variance."""

PRIOR = 0.1
"""Share of the variance that the classes are thought to have together, each as much, before anything is found."""

AT_ONCE = 0.15
"""Time of a surface of the nominal way, in that of a surface that is met anywhere else, as measured."""


@dataclass(frozen=True, eq=False)
class Thinning:
    """Probability of following paths that turn away from nominal light.

    Attributes:
        kept: by the number of surfaces passed.
        first: number of the first path that may be left out.
        seed: of the random numbers; what happens to a path depends on it and on the path's number alone.
    """

    kept: np.ndarray
    first: int
    seed: int

    def chances(self, numbers: np.ndarray, passed: np.ndarray) -> np.ndarray:
        """Probability of following each path that turns away, by its number and the surfaces passed."""
        known = np.minimum(passed, len(self.kept) - 1)
        return np.where((numbers < self.first) | (passed >= len(self.kept)), 1.0, self.kept[known])

    def follows(self, numbers: np.ndarray, chances: np.ndarray) -> np.ndarray:
        """Draw which paths are followed."""
        with np.errstate(over="ignore"):
            # splitmix64 of Steele, Lea and Flood (2014), from another place than the paths' own numbers
            z = (numbers.astype(np.uint64) + np.uint64(self.seed)) * np.uint64(0xD1342543DE82EF95)
            z += np.uint64(0x2545F4914F6CDD1D)
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z ^= z >> np.uint64(31)
        return np.asarray((z >> np.uint64(11)).astype(np.float64) * 2.0**-53 < chances)


@dataclass(frozen=True, eq=False)
class Followed:
    """What a launch has done, path by path.

    Attributes:
        passed: surfaces of the nominal way, (N,).
        turned: whether the path turned away there, (N,); else it missed the next one or came to the detector.
        steps: surfaces met after that, (N,).
    """

    passed: np.ndarray
    turned: np.ndarray
    steps: np.ndarray


def learn(seen: Sequence[tuple[Followed, np.ndarray, np.ndarray]], seed: int) -> Thinning:
    """Probabilities by what the first paths of a run have brought.

    Args:
        seen: launches of these paths, numbered from 0: what they have done, numbers of those that brought light off the
            nominal way to a detector, with repetitions, and the weights of that light.
        seed: of the random numbers that are drawn with them.
    """
    passed, turned, steps = (
        np.concatenate([getattr(done, name) for done, _, _ in seen]) for name in ("passed", "turned", "steps")
    )
    paths, weights = (np.concatenate([one[k] for one in seen]) for k in (1, 2))
    count, classes = len(passed), int(passed.max()) + 1
    brought = np.bincount(paths.astype(np.int64), weights, count) ** 2

    def of_classes(values: np.ndarray) -> np.ndarray:
        return np.bincount(passed[turned], values[turned], classes)

    number, cost, variance = (of_classes(values) for values in (np.ones(count), steps, brought))
    rest = AT_ONCE * passed.sum() + steps.sum() - cost.sum()
    fixed = brought.sum() - variance.sum()
    there = number > 0
    variance = np.where(there, variance + PRIOR * variance.sum() / max(there.sum(), 1), 0.0)
    wish = np.sqrt(variance / np.maximum(cost, 1.0))
    choices = [np.clip(wish / most, LEAST_KEPT, 1.0) for most in np.unique(wish[wish > 0.0])]
    spent = [((variance / kept).sum() + fixed) * ((kept * cost).sum() + rest) for kept in choices]
    kept = choices[int(np.argmin(spent))] if choices else np.ones(classes)
    return Thinning(np.where(there, kept, 1.0), count, seed)
