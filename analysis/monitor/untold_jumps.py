"""Jumps that the readings hint at and that are not told, since chance might explain them: their chances, and what they
add to the state.

A jump is told where hardly any series without one would look like it; long before that, and where it stays too small
for ever, one is likelier than none. Score b and information J of a step of independent amounts at one place, of
variance s^2 each, make it

    B = exp(b' (J + I/s^2)^-1 b / 2) / det(I + s^2 J)^(1/2)

times likelier than none (`jump_detection` has b and J), its amounts then being normal about (J + I/s^2)^-1 b. The
statement gives the root mean square of the sizes alone, of which few large ones make nearly all: s is one of several
sizes down to an eighth of that, each as likely. With the gap between readings over the mean time between two jumps as
chance beforehand, and one jump at most within a window, the chance of one at a place is

    p = w / (1 + sum w),   w = B gap / every,

sums over the places of the window and over bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.arrays import Array
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.jump_detection import Amounts, Candidate

_SCALES = (0.125, 0.25, 0.5, 1.0, 2.0)
"""Sizes of jumps over those stated."""
_AGAIN = 2.0
"""Factor of what a hinted jump adds for a smoother: the readings that said that it came, and how large, pull at it once
more."""


@dataclass(frozen=True, eq=False)
class Jumper:
    """A body that jumps at a stated rate.

    Attributes:
        motions: r numbers of all its motions that jump.
        spots: (q, r) what independent amounts of unit variance do that make the stated motions.
        root: (r, r) the motions by these amounts.
        every_s: mean time between two jumps, seconds.
    """

    motions: tuple[int, ...]
    spots: Array
    root: Array
    every_s: float


def jumpers(stated: Disturbances, may: Sequence[Candidate], otherwise: float | None = None) -> tuple[Jumper, ...]:
    """Bodies of which all motions that jump do so at a stated rate.

    Args:
        stated: disturbances.
        may: what may jump.
        otherwise: seconds between two jumps of a motion of which no rate is stated; None for bodies with a rate alone.
    """
    out = []
    for body in dict.fromkeys(one.body for one in may):
        one = max((one for one in may if one.body == body), key=lambda one: len(one.motions))
        rates = [otherwise if (rate := stated.laws[k].every_s) is None else rate for k in one.motions]
        every = [rate for rate in rates if rate is not None]
        if len(every) == len(rates):
            out.append(Jumper(one.motions, one.spots, one.root, min(every)))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Hint:
    """Of a jump of a body whose size is not known, for each of L places.

    Attributes:
        log_weight: (L,) logarithm of w.
        mean: (L, r) of the amounts if it came there.
        covariance: (L, r, r) of them.
    """

    log_weight: Array
    mean: Array
    covariance: Array

    @classmethod
    def of(cls, looked: tuple[Array, Array], own: tuple[Array, Array], outputs: Array, expected: Array) -> Hint:
        """From scores and information.

        Args:
            looked: score (L, q) and information (L, q, q) by which it is judged.
            own: likewise, by which its amounts are.
            outputs: (q, r) what unit amounts do.
            expected: (L,) mean number of jumps in the gap of each place; 0 where there is no gap.
        """
        logs, means, squares = [], [], []
        for times in _SCALES:
            amounts = Amounts.of(*own, outputs, times)
            judged = amounts if looked is own else Amounts.of(*looked, outputs, times)
            logs.append(judged.log_weight)
            means.append(amounts.mean)
            squares.append(amounts.covariance + amounts.mean[:, :, None] * amounts.mean[:, None, :])
        together = np.logaddexp.reduce(logs, axis=0)
        share = np.exp(np.array(logs) - together)
        mean = np.einsum("sk,ski->ki", share, means)
        square = np.einsum("sk,skij->kij", share, squares)
        with np.errstate(divide="ignore"):
            weight = together - np.log(len(_SCALES)) + np.log(expected)
        return cls(weight, mean, square - mean[:, :, None] * mean[:, None, :])


def _chances(hints: Sequence[Hint], window: int | None = None) -> list[Array]:
    """(L,) chance p of a jump of each body at each place, one at most among so many places on either side, or all."""
    every = np.logaddexp.reduce([one.log_weight for one in hints], axis=0)
    if window is None:
        total = np.logaddexp(0.0, np.logaddexp.reduce(every))
    else:
        padded = np.pad(every, window, constant_values=-np.inf)
        near = np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1)
        total = np.logaddexp(0.0, np.logaddexp.reduce(near, axis=1))
    return [np.exp(one.log_weight - total) for one in hints]


def blended(mean: Array, covariance: Array, hints: Sequence[Hint], moved: Sequence[Array]) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of states where a jump that is not told counts by its chance.

    Args:
        mean: (n,) of the states without one.
        covariance: (n, n) likewise.
        hints: of each body.
        moved: (L, n, r) of each body, what unit amounts at each place have done to the states by now.
    """
    found = _chances(hints)
    away = [np.einsum("knr,kr->kn", m, one.mean) for m, one in zip(moved, hints, strict=True)]
    shift = np.asarray(sum(p @ a for p, a in zip(found, away, strict=True)))
    out = covariance - np.outer(shift, shift)
    for chance, each, m, one in zip(found, away, moved, hints, strict=True):
        inner = np.matmul(chance[:, None, None] * m, one.covariance)
        out = out + (chance[:, None] * each).T @ each + np.tensordot(inner, m, axes=([0, 2], [0, 2]))
    return mean + shift, 0.5 * (out + out.T)


def added(
    score: Sequence[Array], information: Sequence[Array], gap: Array, bodies: Sequence[Jumper], window: int
) -> list[Array]:
    """(N, r) of each body, what a smoother takes jumps to add that were not told, over the mean square that the motions
    are stated to have at their rate.

    Args:
        score: (N, r) of each body, of unit amounts before each of N readings, by all readings.
        information: (N, r, r) of each, likewise.
        gap: (N,) seconds from the reading before, 0 where none is.
        bodies: that jump.
        window: readings among which one jump is looked for.
    """
    if not bodies:
        return []
    hints = []
    for one, b, j in zip(bodies, score, information, strict=True):
        own = b, j
        hints.append(Hint.of(own, own, np.eye(len(one.motions)), gap / one.every_s))
    out = []
    for one, hint, chance in zip(bodies, hints, _chances(hints, window // 2), strict=True):
        square = (hint.mean @ one.root.T) ** 2 + np.einsum("ij,kjl,il->ki", one.root, hint.covariance, one.root)
        over = np.divide(chance * one.every_s, gap, out=np.zeros_like(gap), where=gap > 0.0)
        out.append(_AGAIN * over[:, None] * square)
    return out
