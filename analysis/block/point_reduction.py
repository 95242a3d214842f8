"""Normal equations of packets and priors with the ground points eliminated, in pieces of bounded memory.

A ground point meets only its own packets, so that its (3, 3) block is inverted alone (Schur complement). Points whose
packets meet the same unknowns in the same order form a bundle: their rows make one dense matrix, and one product of
matrices reduces them all. Rows are linearised anew whenever they are needed, a piece of the points at a time; what is
kept of a point is its (3, 3) covariance at known x. Time and memory are so linear in the points, and what does not grow
with them is the reduced matrix.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from analysis.block.packets import Packets
from analysis.block.processes import BlockError

__all__ = ["Bundle", "PriorGroup", "Reduced", "Reduction", "Rows"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
_PIECE = 4_000
"""Points that are linearised at once."""
_FLUSH = 4_000_000
"""Entries of the reduced matrix that are collected before they are added up."""
_WHOLE = 10_000
"""Unknowns up to which they are added up in a whole matrix, of 0.8 GB."""
_LOOSE = 1e-10
"""1/m^2: a point's own weight where nothing else holds it; 100 km in each coordinate."""


@dataclass(frozen=True, eq=False)
class PriorGroup:
    """What is known beforehand of some unknowns: precision (k, k) sparse of x[columns] - mean.

    Attributes:
        group: variance group.
        columns: (k,).
        precision: (k, k).
        mean: (k,).
    """

    group: str
    columns: Indices
    precision: sparse.csr_matrix
    mean: Array


@dataclass(frozen=True, eq=False)
class Bundle:
    """Points whose packets meet the same unknowns.

    Attributes:
        points: (n,).
        members: set and its packets (n,), in order.
        columns: (W,) unknowns of all packets of a point, each once.
        places: of each member, where its unknowns stand among the columns.
    """

    points: Indices
    members: tuple[tuple[int, Indices], ...]
    columns: Indices
    places: tuple[Indices, ...]


@dataclass(frozen=True, eq=False)
class Rows:
    """Weighted rows of a bundle: by x (n, D, W), by the point (n, D, 3), misclosures (n, D)."""

    bundle: Bundle
    by_x: Array
    by_point: Array
    miss: Array


@dataclass(frozen=True, eq=False)
class Reduced:
    """Equations at one state.

    Attributes:
        data: (P, P) sparse, of the packets alone, points eliminated.
        prior: (P, P) sparse, with the factors.
        right: (P,) gradient of half the squares, with the priors, points eliminated.
        spread: (m, 3, 3) covariance of the points at known x. start: (m, 3) their steps where x stays.
        square: weighted squares of the packets by group.
    """

    data: sparse.csc_matrix
    prior: sparse.csc_matrix
    right: Array
    spread: Array
    start: Array
    square: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Reduction:
    """Packets and priors of a block.

    Attributes:
        sets: of packets.
        priors: of the unknowns, which must leave none free.
        size: P, number of unknowns. count: m, number of points.
    """

    sets: Sequence[Packets]
    priors: Sequence[PriorGroup]
    size: int
    count: int

    @cached_property
    def bundles(self) -> tuple[Bundle, ...]:
        """All points that any packet observes."""
        points, codes, owners, places, tables = [], [], [], [], []
        first = 0
        for k, one in enumerate(self.sets):
            columns = one.columns
            if not len(columns):
                continue
            where, code = _distinct(columns)
            points.append(one.point)
            codes.append(first + code)
            owners.append(np.full(len(columns), k, np.int32))
            places.append(np.arange(len(columns)))
            tables += list(columns[where])
            first += len(where)
        if not points:
            raise BlockError("block: no observations")
        point, code, owner, place = (np.concatenate(v) for v in (points, codes, owners, places))
        order = np.lexsort((code, point))
        point, code, owner, place = point[order], code[order], owner[order], place[order]
        starts = np.flatnonzero(np.diff(point, prepend=-1))
        counts = np.diff(np.append(starts, len(point)))
        found = []
        for count in np.unique(counts).tolist():
            at = starts[counts == count][:, None] + np.arange(count)
            kinds, kind = _distinct(code[at])
            sort = np.argsort(kind, kind="stable")
            for piece in np.split(sort, np.cumsum(np.bincount(kind, minlength=len(kinds)))[:-1]):
                rows = at[piece]
                met = [tables[c] for c in code[rows[0]].tolist()]
                columns = np.unique(np.concatenate(met))
                where = tuple(np.searchsorted(columns, one) for one in met)
                # a long bundle is cut, so that its rows have bounded memory
                for a in range(0, len(rows), _PIECE):
                    part = rows[a : a + _PIECE]
                    members = tuple((int(owner[part[0, j]]), place[part[:, j]]) for j in range(count))
                    found.append(Bundle(point[part[:, 0]], members, columns, where))
        return tuple(found)

    @cached_property
    def pieces(self) -> tuple[tuple[Bundle, ...], ...]:
        """Bundles in pieces of bounded memory."""
        found: list[list[Bundle]] = [[]]
        size = 0
        for one in self.bundles:
            if size and size + len(one.points) > _PIECE:
                found.append([])
                size = 0
            found[-1].append(one)
            size += len(one.points)
        return tuple(tuple(piece) for piece in found)

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(m,) which points any packet observes."""
        found = np.zeros(self.count, bool)
        for one in self.sets:
            found[one.point] = True
        return found

    def rows(
        self, x: Array, ground: Array, weight: Sequence[Array], factor: Mapping[str, float], weighted: bool = True
    ) -> Iterator[Rows]:
        """Rows of all bundles, in the order of `pieces`.

        Args:
            x: unknowns, (P,).
            ground: points, (m, 3), ITRS, metres.
            weight: set -> robust weights of its packets.
            factor: group -> variance factor.
            weighted: whether rows are multiplied by the roots of their weights.
        """
        for piece in self.pieces:
            wanted: dict[int, list[Indices]] = {}
            for one in piece:
                for k, which in one.members:
                    wanted.setdefault(k, []).append(which)
            parts, used = {}, dict.fromkeys(wanted, 0)
            for k, several in wanted.items():
                which = np.concatenate(several)
                packets = self.sets[k]
                miss, by_x, by_point = packets.linearised(which, x, ground[packets.point[which]])
                if weighted:
                    root = np.sqrt(weight[k][which] / factor.get(packets.group, 1.0))
                    miss, by_x, by_point = (
                        root[:, None] * miss,
                        root[:, None, None] * by_x,
                        root[:, None, None] * by_point,
                    )
                parts[k] = (miss, by_x, by_point)
            for one in piece:
                n, width = len(one.points), len(one.columns)
                depth = sum(self.sets[k].rows for k, _ in one.members)
                rows = Rows(one, np.zeros((n, depth, width)), np.empty((n, depth, 3)), np.empty((n, depth)))
                d = 0
                for (k, which), place in zip(one.members, one.places, strict=True):
                    a = used[k]
                    used[k] = b = a + len(which)
                    miss, by_x, by_point = (v[a:b] for v in parts[k])
                    rows.miss[:, d : d + miss.shape[1]] = miss
                    rows.by_point[:, d : d + miss.shape[1]] = by_point
                    rows.by_x[:, d : d + miss.shape[1], place] = by_x
                    d += miss.shape[1]
                yield rows

    def reduced(self, x: Array, ground: Array, weight: Sequence[Array], factor: Mapping[str, float]) -> Reduced:
        """Equations at a state.

        Args:
            x: unknowns, (P,).
            ground: points, (m, 3), ITRS, metres.
            weight: set -> robust weights of its packets.
            factor: group -> variance factor.
        """
        data = _Collected(self.size)
        right = np.zeros(self.size)
        spread, start = np.zeros((self.count, 3, 3)), np.zeros((self.count, 3))
        square = dict.fromkeys((one.group for one in self.sets), 0.0)
        for rows in self.rows(x, ground, weight, factor):
            a, b, m = rows.by_x, rows.by_point, rows.miss
            turned = np.swapaxes(b, 1, 2)
            own = turned @ b + _LOOSE * np.eye(3)
            inverse = np.linalg.inv(own)
            pull = np.einsum("nij,nj->ni", turned, m)
            cross = turned @ a
            root = np.linalg.cholesky(inverse)
            n, depth, width = a.shape
            flat = a.reshape(n * depth, width)
            half = (np.swapaxes(root, 1, 2) @ cross).reshape(3 * n, width)
            step = np.einsum("nij,nj->ni", inverse, pull)
            data.add(rows.bundle.columns, flat.T @ flat - half.T @ half)
            right[rows.bundle.columns] += flat.T @ m.ravel() - cross.reshape(3 * n, width).T @ step.ravel()
            spread[rows.bundle.points], start[rows.bundle.points] = inverse, -step
            d = 0
            for k, _ in rows.bundle.members:
                depth = self.sets[k].rows
                square[self.sets[k].group] += float(np.sum(m[:, d : d + depth] ** 2))
                d += depth
        prior = self.prior(factor)
        departed = np.zeros(self.size)
        for one in self.priors:
            pull = one.precision @ (x[one.columns] - one.mean) / factor.get(one.group, 1.0)
            np.add.at(departed, one.columns, pull)
        return Reduced(data.total(), prior, right + departed, spread, start, square)

    def prior(self, factor: Mapping[str, float]) -> sparse.csc_matrix:
        """(P, P) precision of the unknowns beforehand, with the factors."""
        rows, columns, values = [], [], []
        for one in self.priors:
            some = one.precision.tocoo()
            rows.append(one.columns[some.row])
            columns.append(one.columns[some.col])
            values.append(some.data / factor.get(one.group, 1.0))
        where = (np.concatenate(rows), np.concatenate(columns))
        return sparse.csc_matrix((np.concatenate(values), where), shape=(self.size, self.size))

    def prior_square(self, x: Array, factor: Mapping[str, float]) -> dict[str, float]:
        """Group -> weighted squares of what is known beforehand."""
        found: dict[str, float] = {}
        for one in self.priors:
            departed = x[one.columns] - one.mean
            value = float(departed @ (one.precision @ departed)) / factor.get(one.group, 1.0)
            found[one.group] = found.get(one.group, 0.0) + value
        return found

    def point_steps(
        self, x: Array, ground: Array, weight: Sequence[Array], factor: Mapping[str, float], at: Reduced, step: Array
    ) -> Array:
        """(m, 3) change of the points that goes with a change of the unknowns.

        Args:
            x: unknowns, (P,).
            ground: points, (m, 3), ITRS, metres.
            weight: set -> robust weights of its packets.
            factor: group -> variance factor.
            at: equations of this state.
            step: change of the unknowns, (P,).
        """
        found = at.start.copy()
        for rows in self.rows(x, ground, weight, factor):
            moved = rows.by_x @ step[rows.bundle.columns]
            pull = np.einsum("nij,ni->nj", rows.by_point, moved)
            found[rows.bundle.points] -= np.einsum("nij,nj->ni", at.spread[rows.bundle.points], pull)
        return found


def _distinct(rows: Indices) -> tuple[Indices, Indices]:
    """Where each distinct row (n, w) of whole numbers stands first (k,), and which of them each row is (n,)."""
    if not rows.shape[1]:
        return np.zeros(1, np.intp), np.zeros(len(rows), np.intp)
    # a product of odd numbers wraps around and tells rows apart all but surely; whether it did is looked at
    factors = np.random.default_rng(0).integers(1, 2**62, rows.shape[1]) * 2 + 1
    with np.errstate(over="ignore"):
        key = rows.astype(np.int64) @ factors
    _, where, code = np.unique(key, return_index=True, return_inverse=True)
    code = code.ravel()
    if not np.array_equal(rows[where][code], rows):
        _, where, code = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return np.asarray(where, np.intp), np.asarray(code, np.intp).ravel()


class _Collected:
    """A sum of dense blocks at indices, whole where the unknowns are few and else in a sparse matrix."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.whole = np.zeros((size, size)) if size <= _WHOLE else None
        self.sum = sparse.csc_matrix((size, size))
        self.parts: list[tuple[Indices, Indices, Array]] = []
        self.entries = 0

    def add(self, columns: Indices, block: Array) -> None:
        """Add a block (w, w) at its columns, of which none stands twice."""
        if self.whole is not None:
            self.whole[columns[:, None], columns] += block
            return
        width = len(columns)
        self.parts.append((np.repeat(columns, width), np.tile(columns, width), block.ravel()))
        self.entries += width**2
        if self.entries > _FLUSH:
            self.flush()

    def flush(self) -> None:
        """Add up what was collected."""
        if self.parts:
            row, column, value = (np.concatenate(v) for v in zip(*self.parts, strict=True))
            self.sum = self.sum + sparse.csc_matrix((value, (row, column)), shape=(self.size, self.size))
        self.parts, self.entries = [], 0

    def total(self) -> sparse.csc_matrix:
        """The sum, made symmetric."""
        self.flush()
        found = self.sum if self.whole is None else sparse.csc_matrix(self.whole)
        return 0.5 * (found + found.T)
