"""Corrections of attitude and station of a pass at the times of its observations, linear in the unknowns of its laws.

How much of each unknown a time meets is worked out when it is needed, for some of the observations at a time: it would
else be most of what a block takes in memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from analysis.arrays import Array, Indices
from analysis.block.processes import Support


@dataclass(frozen=True, eq=False)
class Part:
    """One law's share of a correction.

    Attributes:
        turns: whether it turns the body, radians; else it shifts the station along the axes of the pass, metres.
        first: of its unknowns, three axes of each number.
        support: of the law.
    """

    turns: bool
    first: int
    support: Support

    @cached_property
    def sigma(self) -> Array:
        """(3,) of the axes."""
        return np.array(self.support.law.sigma)


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections at the times of n observations.

    Attributes:
        parts: of the laws; those that turn come first.
        axes: (3, 3) axes of the pass (along, across, down) as columns, ITRS.
        time: (n,) seconds.
    """

    parts: tuple[Part, ...]
    axes: Array
    time: Array

    def taken(self, which: Indices) -> Corrections:
        """At some of the observations, (k,)."""
        return replace(self, time=self.time[which])

    @cached_property
    def _blends(self) -> tuple[tuple[Indices, Array], ...]:
        return tuple(one.support.blend(self.time) for one in self.parts)

    @property
    def columns(self) -> Indices:
        """(n, w) unknowns of all parts."""
        every = [np.zeros((len(self.time), 0), np.intp)]
        for one, (number, _) in zip(self.parts, self._blends, strict=True):
            columns = one.first + 3 * number[:, :, None] + np.arange(3)
            every.append(columns.reshape(len(number), 3 * number.shape[1]))
        return np.concatenate(every, axis=1)

    def factors(self, turns: bool) -> tuple[Indices, Array]:
        """Unknowns (n, w, 3) of the turns or of the shifts, and their coefficients (n, w, 3), SI."""
        count = len(self.time)
        columns, factors = [np.zeros((count, 0, 3), np.intp)], [np.zeros((count, 0, 3))]
        for one, (number, blend) in zip(self.parts, self._blends, strict=True):
            if one.turns == turns:
                columns.append(one.first + 3 * number[:, :, None] + np.arange(3))
                factors.append(blend[:, :, None] * one.sigma)
        return np.concatenate(columns, axis=1), np.concatenate(factors, axis=1)

    def at(self, x: Array) -> tuple[Array, Array]:
        """Turns (n, 3), radians, and shifts (n, 3) along the axes of the pass, metres, with unknowns x (P,)."""
        turn, shift = np.zeros((2, len(self.time), 3))
        for one, (number, blend) in zip(self.parts, self._blends, strict=True):
            own = one.sigma * x[one.first : one.first + one.support.size].reshape(-1, 3)
            value = np.einsum("nw,nwa->na", blend, own[number])
            if one.turns:
                turn += value
            else:
                shift += value
        return turn, shift

    def slopes(self, by_turn: Array, by_station: Array) -> Array:
        """(n, d, w) derivatives of d rows by the unknowns.

        Args:
            by_turn: derivatives by the rotation vector, (n, d, 3), 1/rad.
            by_station: by the station, ITRS, (n, d, 3), 1/m.
        """
        count, depth = by_turn.shape[:2]
        widths = [3 * blend.shape[1] for _, blend in self._blends]
        found = np.empty((count, depth, sum(widths)))
        along, done = by_station @ self.axes, 0
        for one, (_, blend), width in zip(self.parts, self._blends, widths, strict=True):
            by = (by_turn if one.turns else along) * one.sigma
            for k in range(blend.shape[1]):
                place = done + 3 * k
                np.multiply(by, blend[:, k, None, None], out=found[:, :, place : place + 3])
            done += width
        return found


def turned(turn: Array, vector: Array) -> Array:
    """(n, 3) vectors turned by rotation vectors (n, 3) of up to a degree; of d vectors (n, d, 3) each likewise.

    The series of the rotation to the third order, which leaves out 1e-9 of a degree.
    """
    if vector.ndim == 3:
        turn = turn[:, None]
    square = np.sum(turn**2, axis=-1, keepdims=True)
    once = cross(turn, vector)
    return np.asarray(vector + (1.0 - square / 6.0) * once + (0.5 - square / 24.0) * cross(turn, once))


def turned_back(turn: Array, vector: Array) -> Array:
    """Vectors turned by the inverse of rotations, see `turned`."""
    return turned(-turn, vector)


def cross(a: Array, b: Array) -> Array:
    """Vector product along the last axis; several times faster than numpy's for many short vectors."""
    found = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(a[..., j], b[..., k], out=found[..., i])
        found[..., i] -= a[..., k] * b[..., j]
    return found


def by_rotation_vector(turn: Array, by_turn: Array) -> Array:
    """(n, d, 3) derivatives by the rotation vectors (n, 3), from those by a small turn of the turned body.

    It is the right Jacobian of the rotation, to the second order.
    """
    # t (I - S / 2 + S^2 / 6), where t S = t x turn
    once = cross(by_turn, turn[:, None])
    return np.asarray(by_turn - 0.5 * once + cross(once, turn[:, None]) / 6.0)
