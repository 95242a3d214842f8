"""Normal equations of packets and priors with the ground points eliminated, in pieces of bounded memory.

A ground point meets only its own packets, so that its (3, 3) block is inverted alone (Schur complement). Points whose
packets meet the same unknowns in the same order form a bundle: their rows make one dense matrix, and one product of
matrices reduces them all. Rows are linearised anew whenever they are needed, a piece of the points at a time; what is
kept of a point is its (3, 3) covariance at known x. Time and memory are so linear in the points, and what does not grow
with them is the reduced matrix.

The points' reduction on several processes, each of which holds the packets of a share of the points.

What grows with the points stays where it is: the packets of a share are sent once. Unknowns, places of the points and
weights go to the shares, reduced equations come back and are added in the order of the shares, so that the same number
of shares gives the same bits, and another one the same sums to rounding.

Observations of ground points in packets: rows that one measurement of one point gives, and what they depend on.

A packet of d rows observes one point p and w of the unknowns x. Sets of packets of one kind are linearised together,
whitened by their a-priori covariance: miss + by_x dx + by_point dp. The core (`point_reduction`) knows no cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from analysis.arrays import Array, Indices
from analysis.block.error_processes import Corrections, by_rotation_vector, cross, turned, turned_back
from analysis.block.reweighting import standardised_packets
from analysis.orbit.three_line_model import LineModel, Rays


class Packets(Protocol):
    """A set of packets."""

    @property
    def name(self) -> str:
        """Of the set, for messages: the scene."""

    @property
    def group(self) -> str:
        """Variance group."""

    @property
    def rows(self) -> int:
        """d, of each packet."""

    @property
    def point(self) -> Indices:
        """(n,) ground point that each packet observes."""

    @property
    def columns(self) -> Indices:
        """(n, w) unknowns that each packet meets."""

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """Misclosures (k, d), their derivatives by the columns (k, d, w) and by the points (k, d, 3), whitened.

        Parameters
        ----------
        which : Indices
            Packets, (k,).
        x : Array
            All unknowns, (P,).
        ground : Array
            Points of these packets, (k, 3), ITRS, metres.
        """

    def taken(self, which: Indices, point: Indices) -> Packets:
        """Some of the packets, (k,), whose points have other numbers, (k,)."""


@dataclass(frozen=True, eq=False)
class LineImage:
    """Image points of one line camera in one pass.

    Attributes
    ----------
    name : str
        Of the scene.
    camera : LineModel
        As it is known, before its changes in this pass.
    rays : Rays
        Image points with readings of station and attitude.
    white : Array
        (n, 2, 2) whitens their misclosures.
    corrections : Corrections
        Of the readings.
    change : Indices
        (4,) unknowns of the camera's d_alpha, d_beta, d_gamma, d_f.
    unit : Array
        (4,) size of each, radians and metres.
    group : str
        Variance group.
    """

    name: str
    camera: LineModel
    rays: Rays
    white: Array
    corrections: Corrections
    change: Indices
    unit: Array
    group: str = "image"
    rows: int = 2

    @property
    def point(self) -> Indices:
        """(n,)."""
        return self.rays.point

    @property
    def columns(self) -> Indices:
        """(n, w)."""
        own = np.broadcast_to(self.change, (len(self.rays.point), len(self.change)))
        return np.concatenate([self.corrections.columns, own], axis=1)

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """See `Packets`.

        Parameters
        ----------
        which : Indices
            Packets, (k,).
        x : Array
            All unknowns, (P,).
        ground : Array
            Points of these packets, (k, 3), ITRS, metres.
        """
        rays, camera = self.rays, self.camera.drifted(self.unit * x[self.change])
        corrections = self.corrections.taken(which)
        turn, shift = corrections.at(x)
        attitude = rays.attitude[which]
        arm = ground - rays.station[which] - shift @ corrections.axes.T
        body = turned_back(turn, np.einsum("nji,nj->ni", attitude, arm))
        seen = camera.seen(body, rays.image[which])
        white = self.white[which]
        by_body = white @ seen.by_body
        by_measured = turned(turn, by_body)
        by_ground = by_measured @ np.swapaxes(attitude, 1, 2)
        # a small turn s of the body moves the arm by arm x s, and t . (arm x s) = (t x arm) . s
        by_turn = by_rotation_vector(turn, cross(by_body, body[:, None]))
        slopes = corrections.slopes(by_turn, -by_ground)
        return (
            np.einsum("nij,nj->ni", white, seen.miss),
            np.concatenate([slopes, white @ (seen.by_drift * self.unit)], axis=2),
            by_ground,
        )

    def taken(self, which: Indices, point: Indices) -> LineImage:
        """See `Packets`."""
        rays = replace(self.rays.taken(which), point=point)
        return replace(self, rays=rays, white=self.white[which], corrections=self.corrections.taken(which))


@dataclass(frozen=True, eq=False)
class Pointings:
    """Laser altimeter footprints: range, and where the beam points in the body frame.

    Attributes
    ----------
    name : str
        Of the pass.
    point : Indices
        (n,) footprints.
    station : Array
        (n, 3) readings, ITRS, metres. attitude: (n, 3, 3) body to ITRS.
    aim : Array
        (n, 3) unit vectors of the beam in the body frame.
    distance : Array
        (n,) measured, metres.
    corrections : Corrections
        Of the readings.
    sigma : tuple[float, float]
        Of the range, metres, and of the pointing about each of two axes, radians, with the beam's width.
    group : str
        Variance group.
    """

    name: str
    point: Indices
    station: Array
    attitude: Array
    aim: Array
    distance: Array
    corrections: Corrections
    sigma: tuple[float, float]
    group: str = "laser"
    rows: int = 3

    @property
    def columns(self) -> Indices:
        """(n, w)."""
        return self.corrections.columns

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """See `Packets`: range, then the beam's two components.

        Parameters
        ----------
        which : Indices
            Packets, (k,).
        x : Array
            All unknowns, (P,).
        ground : Array
            Points of these packets, (k, 3), ITRS, metres.
        """
        corrections = self.corrections.taken(which)
        turn, shift = corrections.at(x)
        attitude = self.attitude[which]
        arm = ground - self.station[which] - shift @ corrections.axes.T
        arm = turned_back(turn, np.einsum("nji,nj->ni", attitude, arm))
        far = np.linalg.norm(arm, axis=1)
        unit = arm / far[:, None]
        aim = self.aim[which]
        first = np.cross(aim, np.eye(3)[np.abs(aim[0]).argmin()])
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
        across = np.stack([first, np.cross(aim, first)], axis=1)
        miss = np.concatenate(
            [
                (far - self.distance[which])[:, None] / self.sigma[0],
                np.einsum("nij,nj->ni", across, unit) / self.sigma[1],
            ],
            axis=1,
        )
        flat = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        by_arm = np.concatenate(
            [unit[:, None] / self.sigma[0], across @ flat / (self.sigma[1] * far[:, None, None])], axis=1
        )
        by_turn = by_rotation_vector(turn, cross(by_arm, arm[:, None]))
        by_point = turned(turn, by_arm) @ np.swapaxes(attitude, 1, 2)
        return miss, corrections.slopes(by_turn, -by_point), by_point

    def taken(self, which: Indices, point: Indices) -> Pointings:
        """See `Packets`."""
        rows = (self.station, self.attitude, self.aim, self.distance)
        station, attitude, aim, distance = (row[which] for row in rows)
        return replace(
            self,
            point=point,
            station=station,
            attitude=attitude,
            aim=aim,
            distance=distance,
            corrections=self.corrections.taken(which),
        )


@dataclass(frozen=True, eq=False)
class FixedPoints:
    """Given coordinates of control points, with a shift that they may have in common.

    Attributes
    ----------
    name : str
        Of the set.
    point : Indices
        (n,).
    given : Array
        (n, 3) ITRS, metres.
    white : Array
        (n, 3, 3) whitens their misclosures.
    datum : Indices
        (0,) or (3,) unknowns of what all given coordinates are too large by, along ITRS axes, metres.
    group : str
        Variance group.
    """

    name: str
    point: Indices
    given: Array
    white: Array
    datum: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    group: str = "control"
    rows: int = 3

    @property
    def columns(self) -> Indices:
        """(n, 0) or (n, 3)."""
        return np.broadcast_to(self.datum, (len(self.point), len(self.datum)))

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """See `Packets`.

        Parameters
        ----------
        which : Indices
            Packets, (k,).
        x : Array
            All unknowns, (P,).
        ground : Array
            Points of these packets, (k, 3), ITRS, metres.
        """
        white = self.white[which]
        shift = x[self.datum] if len(self.datum) else np.zeros(3)
        miss = np.einsum("nij,nj->ni", white, ground - self.given[which] + shift)
        return miss, white[:, :, : len(self.datum)], white

    def taken(self, which: Indices, point: Indices) -> FixedPoints:
        """See `Packets`."""
        return replace(self, point=point, given=self.given[which], white=self.white[which])


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights of a terrain model at points, with an error that the model has everywhere.

    Attributes
    ----------
    name : str
        Of the model.
    point : Indices
        (n,).
    place : Array
        (n, 3) where the model's surface lies at the point's first place, ITRS, metres.
    normal : Array
        (n, 3) of the surface there; unit vectors.
    sigma : Array
        (n,) of a height, independent from point to point, metres.
    common : Indices
        (1,) unknown of the model's common error. unit: its size, metres.
    group : str
        Variance group.
    """

    name: str
    point: Indices
    place: Array
    normal: Array
    sigma: Array
    common: Indices
    unit: float
    group: str = "terrain"
    rows: int = 1

    @property
    def columns(self) -> Indices:
        """(n, 1)."""
        return np.broadcast_to(self.common, (len(self.point), 1))

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """See `Packets`.

        Parameters
        ----------
        which : Indices
            Packets, (k,).
        x : Array
            All unknowns, (P,).
        ground : Array
            Points of these packets, (k, 3), ITRS, metres.
        """
        normal, sigma = self.normal[which], self.sigma[which]
        above = np.sum(normal * (ground - self.place[which]), axis=1) - self.unit * float(x[self.common[0]])
        by_x = np.broadcast_to(-self.unit / sigma[:, None, None], (len(which), 1, 1))
        return (above / sigma)[:, None], by_x, (normal / sigma[:, None])[:, None]

    def taken(self, which: Indices, point: Indices) -> Heights:
        """See `Packets`."""
        place, normal, sigma = self.place[which], self.normal[which], self.sigma[which]
        return replace(self, point=point, place=place, normal=normal, sigma=sigma)


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

    Attributes
    ----------
    group : str
        Variance group.
    columns : Indices
        (k,).
    precision : sparse.csr_matrix
        (k, k).
    mean : Array
        (k,).
    """

    group: str
    columns: Indices
    precision: sparse.csr_matrix
    mean: Array


@dataclass(frozen=True, eq=False)
class Bundle:
    """Points whose packets meet the same unknowns.

    Attributes
    ----------
    points : Indices
        (n,).
    members : tuple[tuple[int, Indices], ...]
        Set and its packets (n,), in order.
    columns : Indices
        (W,) unknowns of all packets of a point, each once.
    places : tuple[Indices, ...]
        Of each member, where its unknowns stand among the columns.
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
class Eliminated:
    """Equations of packets at one state, their points eliminated.

    Attributes
    ----------
    data : sparse.csc_matrix
        (P, P) sparse.
    right : Array
        (P,) gradient of half the squares.
    spread : Array
        (m, 3, 3) covariance of the points at known x. start: (m, 3) their steps where x stays.
    square : Mapping[str, float]
        Weighted squares of the packets by group.
    """

    data: sparse.csc_matrix
    right: Array
    spread: Array
    start: Array
    square: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Reduced(Eliminated):
    """Equations of packets and priors: `right` has the priors, too.

    Attributes
    ----------
    prior : sparse.csc_matrix
        (P, P) sparse, with the factors.
    """

    prior: sparse.csc_matrix


@dataclass(frozen=True, eq=False)
class State:
    """Where an iteration stands.

    Attributes
    ----------
    x : Array
        Unknowns, (P,).
    ground : Array
        Points, (m, 3), ITRS, metres.
    weight : tuple[Array, ...]
        Set -> robust weights of its packets.
    factor : Mapping[str, float]
        Group -> variance factor.
    """

    x: Array
    ground: Array
    weight: tuple[Array, ...]
    factor: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Checked:
    """Packets beside what all others say.

    Attributes
    ----------
    standard : tuple[Array, ...]
        Set -> (n, d) standardised residuals.
    taken : Mapping[str, float]
        Group -> what the adjustment took of its observations: their count less their redundancy.
    """

    standard: tuple[Array, ...]
    taken: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Reduction:
    """Packets and priors of a block.

    Attributes
    ----------
    sets : Sequence[Packets]
        Of packets.
    priors : Sequence[PriorGroup]
        Of the unknowns, which must leave none free.
    size : int
        P, number of unknowns. count: m, number of points.
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
            return ()
        order = np.lexsort((np.concatenate(codes), np.concatenate(points)))
        every: list[Indices] = [np.concatenate(v).astype(np.intp)[order] for v in (points, codes, owners, places)]
        point, code, owner, place = every
        starts: Indices = np.flatnonzero(np.diff(point, prepend=-1))
        counts = np.diff(np.append(starts, len(point)))
        found = []
        for count in np.unique(counts).tolist():
            at = starts[counts == count][:, None] + np.arange(count)
            kinds, kind = _distinct(code[at])
            sort = np.argsort(kind, kind="stable")
            for piece in np.split(sort, np.cumsum(np.bincount(kind, minlength=len(kinds)))[:-1]):
                rows = at[piece]
                met = [tables[c] for c in code[rows[0]].tolist()]
                meets = np.asarray(np.unique(np.concatenate(met)), np.intp)
                standing = tuple(np.searchsorted(meets, one) for one in met)
                # a long bundle is cut, so that its rows have bounded memory
                for a in range(0, len(rows), _PIECE):
                    part = rows[a : a + _PIECE]
                    members = tuple((int(owner[part[0, j]]), place[part[:, j]]) for j in range(count))
                    found.append(Bundle(point[part[:, 0]], members, meets, standing))
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

    def rows(self, at: State, weighted: bool = True) -> Iterator[Rows]:
        """Rows of all bundles, in the order of `pieces`.

        Parameters
        ----------
        at : State
            state.
        weighted : bool
            Whether rows are multiplied by the roots of their weights.
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
                miss, by_x, by_point = packets.linearised(which, at.x, at.ground[packets.point[which]])
                if weighted:
                    root = np.sqrt(at.weight[k][which] / at.factor.get(packets.group, 1.0))
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

    def reduced(self, at: State) -> Reduced:
        """Equations of packets and priors at a state."""
        return self.with_priors(self.eliminated(at), at)

    def with_priors(self, found: Eliminated, at: State) -> Reduced:
        """The equations of the packets with what is known beforehand."""
        departed = np.zeros(self.size)
        for one in self.priors:
            pull = one.precision @ (at.x[one.columns] - one.mean) / at.factor.get(one.group, 1.0)
            np.add.at(departed, one.columns, pull)
        right = found.right + departed
        return Reduced(found.data, right, found.spread, found.start, found.square, self.prior(at.factor))

    def eliminated(self, at: State) -> Eliminated:
        """Equations of the packets at a state."""
        data = _Collected(self.size)
        right = np.zeros(self.size)
        spread, start = np.zeros((self.count, 3, 3)), np.zeros((self.count, 3))
        square = dict.fromkeys((one.group for one in self.sets), 0.0)
        for rows in self.rows(at):
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
        return Eliminated(data.total(), right, spread, start, square)

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

    def point_steps(self, at: State, found: Eliminated, step: Array) -> Array:
        """(m, 3) change of the points that goes with a change of the unknowns.

        Parameters
        ----------
        at : State
            state.
        found : Eliminated
            Equations of this state.
        step : Array
            Change of the unknowns, (P,).
        """
        moved = found.start.copy()
        for rows in self.rows(at):
            pulled = np.einsum("nij,j->ni", rows.by_x, step[rows.bundle.columns])
            pull = np.einsum("nij,ni->nj", rows.by_point, pulled)
            moved[rows.bundle.points] -= np.einsum("nij,nj->ni", found.spread[rows.bundle.points], pull)
        return moved

    def checked(self, at: State, spread: Array, covariance: Callable[[Indices], Array]) -> Checked:
        """Residuals over their standard deviations, and what the adjustment took of the observations.

        Parameters
        ----------
        at : State
            state.
        spread : Array
            Covariance of the points at known x, (m, 3, 3).
        covariance : Callable[[Indices], Array]
            Of some unknowns (w,): (w, w).
        """
        sets = self.sets
        standard = [np.zeros((len(one.point), one.rows)) for one in sets]
        taken = dict.fromkeys((one.group for one in sets), 0.0)
        for rows in self.rows(at, weighted=False):
            where = rows.bundle.points
            weights = np.concatenate(
                [
                    np.repeat((at.weight[k][w] / at.factor[sets[k].group])[:, None], sets[k].rows, axis=1)
                    for k, w in rows.bundle.members
                ],
                axis=1,
            )
            inner = spread[where]
            moved = inner @ np.swapaxes(rows.by_point * weights[:, :, None], 1, 2) @ rows.by_x
            through = rows.by_x - rows.by_point @ moved
            shared = covariance(rows.bundle.columns)
            d = 0
            for k, which in rows.bundle.members:
                depth = sets[k].rows
                part, by_point = through[:, d : d + depth], rows.by_point[:, d : d + depth]
                told = np.tensordot(part, shared, 1)
                cofactor = told @ np.swapaxes(part, 1, 2) + by_point @ inner @ np.swapaxes(by_point, 1, 2)
                weight, unit = at.weight[k][which], at.factor[sets[k].group]
                standard[k][which] = standardised_packets(rows.miss[:, d : d + depth], cofactor, weight, unit)
                taken[sets[k].group] += float(np.sum(weight * np.trace(cofactor, axis1=1, axis2=2)) / unit)
                d += depth
        return Checked(tuple(standard), taken)

    def packets_at(self, points: Indices) -> tuple[Indices, ...]:
        """Set -> which of its packets observe some of the points, (k,)."""
        wanted = np.zeros(self.count, bool)
        wanted[points] = True
        return tuple(np.flatnonzero(wanted[one.point]) for one in self.sets)

    def restricted(self, points: Indices) -> Reduction:
        """The packets of some of the points alone, which are counted in this order; without priors."""
        number = np.full(self.count, -1)
        number[points] = np.arange(len(points))
        packets = self.packets_at(points)
        sets = tuple(one.taken(which, number[one.point[which]]) for one, which in zip(self.sets, packets, strict=True))
        return Reduction(sets, (), self.size, len(points))

    def state_of(self, points: Indices, at: State) -> State:
        """What of a state a restricted reduction has."""
        weight = tuple(w[which] for w, which in zip(at.weight, self.packets_at(points), strict=True))
        return State(at.x, at.ground[points], weight, at.factor)


def _distinct(rows: Indices) -> tuple[Indices, Indices]:
    """Where each distinct row (n, w) of whole numbers stands first (k,), in their order, and which each row is (n,)."""
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
    # in the order of the numbers, so that neighbours in time stay neighbours
    order = np.lexsort(rows[where].T[::-1])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return np.asarray(where[order], np.intp), np.asarray(rank[code.ravel()], np.intp)


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

    Attributes
    ----------
    whole : Reduction
        Packets and priors of the block.
    pool : Pool
        Where the shares are.
    points : tuple[Indices, ...]
        Of each share, (m_k,).
    packets : tuple[tuple[Indices, ...], ...]
        Of each share, set -> packets.
    held : tuple[Any, ...]
        What stands for each share.
    columns : tuple[Indices, ...]
        (w_k,) unknowns that each share meets.
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

        Parameters
        ----------
        at : State
            state.
        found : Eliminated
            Equations of this state.
        step : Array
            Change of the unknowns, (P,).
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

        Parameters
        ----------
        at : State
            state.
        spread : Array
            Covariance of the points at known x, (m, 3, 3).
        covariance : Callable[[Indices], Array]
            Of some unknowns (w,): (w, w).
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
