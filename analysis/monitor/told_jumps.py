"""Whose jump it was: a jump that was told, by the chances of all bodies and places that can explain it.

Which body jumped the spots often cannot tell, and what it did to the line depends on it. Each body counts by its
chance, all of its motions being free, before each reading before which the step can have come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.monitor.jump_detection import Amounts, Candidate, Jump, larger

Array = NDArray[np.float64]
_UNLIKELY = 1e-4
"""Of the weight of the likeliest body and place, below which it was not there."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """Bodies that may have jumped, B of them, before each of L readings.

    Attributes:
        own: all motions of each that may jump.
        times: (B,) standard deviations of its jump over those stated.
        weight: (B, L) chances, together 1.
        judged: amounts by the filter that looks for jumps; amounts: by the other.
    """

    own: tuple[Candidate, ...]
    times: tuple[float, ...]
    weight: Array
    judged: tuple[Amounts, ...]
    amounts: tuple[Amounts, ...]

    @classmethod
    def of(
        cls,
        may: Sequence[Candidate],
        jump: Jump,
        until: Array,
        gap: Array,
        looking: tuple[Array, Array],
        state: tuple[Array, Array],
    ) -> Bodies:
        """All that are not much less likely than the likeliest.

        Args:
            may: what may jump.
            jump: that was told.
            until: (L,) times of the readings, seconds.
            gap: (L,) seconds from the reading before each.
            looking: score (L, q) and information (L, q, q) by which bodies and places are judged.
            state: likewise, by which amounts are for the estimate.
        """
        place, found = int(np.argmin(np.abs(until - jump.until))), []
        for body in dict.fromkeys(one.body for one in may):
            one = max((one for one in may if one.body == body), key=lambda one: len(one.motions))
            known = one.spots.T @ looking[1][place] @ one.spots, looking[0][place] @ one.spots
            times = jump.times if body == jump.body else larger(*known)
            found.append((one, times, Amounts.of(*looking, one.spots, times), Amounts.of(*state, one.spots, times)))
        logs = np.array([judged.log_weight for _, _, judged, _ in found])
        weight = np.exp(logs - logs.max()) * gap
        weight = np.where(weight > _UNLIKELY * weight.max(), weight, 0.0)
        kept = np.flatnonzero(weight.sum(axis=1))
        own, times_of, judged, amounts = zip(*(found[b] for b in kept), strict=True)
        return cls(own, times_of, weight[kept] / weight.sum(), judged, amounts)

    @property
    def spots(self) -> list[Array]:
        """(q, r) of each what unit amounts do to the outputs that are read."""
        return [one.spots for one in self.own]

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], float], ...]:
        """Motions of each, and their variance over that stated times the chance that it was this body."""
        chance = self.weight.sum(axis=1)
        every = zip(self.own, chance.tolist(), self.times, strict=True)
        return tuple((one.motions, share * times**2) for one, share, times in every)

    def known(
        self, mean: Array, covariance: Array, response: Array, levels: Sequence[Array], amounts: Sequence[Amounts]
    ) -> tuple[Array, Array]:
        """States of a filter as if it had known of the jump: mean (n,) and covariance (n, n), over bodies and places.

        Args:
            mean: (n,) of the filter.
            covariance: (n, n) of it.
            response: (L, n, q) of the mean to steps of unit outputs at each place.
            levels: (n, r) of each body, what unit amounts do to the states.
            amounts: of each.
        """
        shift, spread = np.zeros(len(mean)), np.zeros(covariance.shape)
        for one, share, level, does in zip(amounts, self.weight, levels, self.spots, strict=True):
            moved = level - response @ does
            each = np.einsum("knr,kr->kn", moved, one.mean)
            shift += share @ each
            spread += (share[:, None] * each).T @ each
            inner = np.matmul(share[:, None, None] * moved, one.covariance)
            spread += np.tensordot(inner, moved, axes=([0, 2], [0, 2]))
        out = covariance + spread - np.outer(shift, shift)
        return mean + shift, 0.5 * (out + out.T)


def mixed(amounts: Sequence[Amounts], does: Sequence[Array], weight: Array) -> tuple[Array, Array]:
    """Mean and covariance of what jumps do, each body and place counting by its chance.

    Args:
        amounts: of B bodies at L places.
        does: (o, r) of each body, what unit amounts do.
        weight: (B, L) chances, together 1.
    """
    each = np.stack([one.mean @ do.T for one, do in zip(amounts, does, strict=True)])
    mean = np.einsum("bk,bko->o", weight, each)
    away = each - mean
    spread = np.einsum("bk,bko,bkp->op", weight, away, away)
    for one, do, share in zip(amounts, does, weight, strict=True):
        spread += do @ np.einsum("k,krs->rs", share, one.covariance) @ do.T
    return mean, spread
