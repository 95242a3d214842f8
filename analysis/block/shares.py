"""The points' reduction on several processes, each of which holds the packets of a share of the points.

What grows with the points stays where it is: the packets of a share are sent once. Unknowns, places of the points and
weights go to the shares, reduced equations come back and are added in the order of the shares, so that the same number
of shares gives the same bits, and another one the same sums to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy import sparse

from analysis.arrays import Array, Indices
from analysis.block.point_reduction import Checked, Eliminated, Reduction, State


class Pool(Protocol):
    """Processes that hold things and work on them."""

    @property
    def count(self) -> int:
        """Number of processes."""

    def hold(self, things: Sequence[Any]) -> Sequence[Any]:
        """Give each thing to a process; what is returned stands for it as the first argument of work."""

    def results(self, work: Callable[[tuple[Any, ...]], Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Work done with each of the arguments, in their order."""


@dataclass(frozen=True, eq=False)
class SharedReduction:
    """Packets of a block by shares of the points; see `Reduction`, whose methods these are.

    Attributes:
        whole: packets and priors of the block.
        pool: where the shares are.
        points: of each share, (m_k,).
        packets: of each share, set -> packets.
        held: what stands for each share.
        columns: (w_k,) unknowns that each share meets.
    """

    whole: Reduction
    pool: Pool
    points: tuple[Indices, ...]
    packets: tuple[tuple[Indices, ...], ...]
    held: tuple[Any, ...]
    columns: tuple[Indices, ...]

    @classmethod
    def of(cls, whole: Reduction, pool: Pool) -> SharedReduction:
        """Give each process of a pool a share, of points that the same sets observe as far as that goes."""
        first, last = np.full(whole.count, len(whole.sets)), np.full(whole.count, -1)
        for k, one in enumerate(whole.sets):
            first[one.point] = np.minimum(first[one.point], k)
            last[one.point] = k
        order = np.lexsort((last, first))
        seen = order[last[order] >= 0]
        points = tuple(np.sort(part) for part in np.array_split(seen, min(pool.count, len(seen))))
        packets = tuple(whole.packets_at(part) for part in points)
        held = tuple(pool.hold([whole.restricted(part) for part in points]))
        columns = tuple(pool.results(_columns, [(one,) for one in held]))
        return cls(whole, pool, points, packets, held, columns)

    def _states(self, at: State) -> list[State]:
        return [
            State(at.x, at.ground[points], tuple(w[p] for w, p in zip(at.weight, packets, strict=True)), at.factor)
            for points, packets in zip(self.points, self.packets, strict=True)
        ]

    def eliminated(self, at: State) -> Eliminated:
        """Equations of the packets at a state."""
        size, count = self.whole.size, self.whole.count
        data, right = sparse.csc_matrix((size, size)), np.zeros(size)
        spread, start = np.zeros((count, 3, 3)), np.zeros((count, 3))
        square = dict.fromkeys((one.group for one in self.whole.sets), 0.0)
        parts = self.pool.results(_eliminated, list(zip(self.held, self._states(at), strict=True)))
        for points, part in zip(self.points, parts, strict=True):
            data, right = data + part.data, right + part.right
            spread[points], start[points] = part.spread, part.start
            for group, value in part.square.items():
                square[group] += value
        return Eliminated(data, right, spread, start, square)

    def point_steps(self, at: State, found: Eliminated, step: Array) -> Array:
        """(m, 3) change of the points that goes with a change of the unknowns.

        Args:
            at: state.
            found: equations of this state.
            step: change of the unknowns, (P,).
        """
        moved = np.zeros((self.whole.count, 3))
        arguments = [
            (held, state, found.spread[points], found.start[points], step)
            for held, state, points in zip(self.held, self._states(at), self.points, strict=True)
        ]
        for points, part in zip(self.points, self.pool.results(_stepped, arguments), strict=True):
            moved[points] = part
        return moved

    def checked(self, at: State, spread: Array, covariance: Callable[[Indices], Array]) -> Checked:
        """Residuals over their standard deviations, and what the adjustment took of the observations.

        Args:
            at: state.
            spread: covariance of the points at known x, (m, 3, 3).
            covariance: of some unknowns (w,): (w, w).
        """
        standard = [np.zeros((len(one.point), one.rows)) for one in self.whole.sets]
        taken = dict.fromkeys((one.group for one in self.whole.sets), 0.0)
        arguments = [
            (held, state, spread[points], columns, covariance(columns))
            for held, state, points, columns in zip(self.held, self._states(at), self.points, self.columns, strict=True)
        ]
        for packets, part in zip(self.packets, self.pool.results(_checked, arguments), strict=True):
            for k, which in enumerate(packets):
                standard[k][which] = part.standard[k]
            for group, value in part.taken.items():
                taken[group] += value
        return Checked(tuple(standard), taken)


def _columns(given: tuple[Reduction]) -> Indices:
    return np.unique(np.concatenate([np.zeros(0, np.intp), *(one.columns for one in given[0].bundles)]))


def _eliminated(given: tuple[Reduction, State]) -> Eliminated:
    share, at = given
    return share.eliminated(at)


def _stepped(given: tuple[Reduction, State, Array, Array, Array]) -> Array:
    share, at, spread, start, step = given
    nothing = sparse.csc_matrix((0, 0))
    return share.point_steps(at, Eliminated(nothing, np.zeros(0), spread, start, {}), step)


def _checked(given: tuple[Reduction, State, Array, Indices, Array]) -> Checked:
    share, at, spread, columns, covariance = given

    def some(wanted: Indices) -> Array:
        where = np.searchsorted(columns, wanted)
        return covariance[np.ix_(where, where)]

    return share.checked(at, spread, some)
