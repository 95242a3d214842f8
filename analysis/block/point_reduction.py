"""Normal equations of observations and priors with the ground points eliminated, in pieces of bounded memory.

**Packets.** A packet is the d equations that one measurement of one ground point gives: they depend on the point p and
on w of the unknowns x. Packet sets of one kind are linearised together and whitened by their a-priori covariance; a
packet is then its misclosure, the derivatives with respect to x times a step of x, and those with respect to p times a
step of p. The elimination knows nothing of cameras.

**Elimination.** A ground point occurs only in its own packets, so that its (3, 3) block is inverted alone (Schur
complement). Points whose packets depend on the same unknowns in the same order form a bundle: their equations make one
dense matrix, and one matrix product eliminates them all. Equations are linearised again whenever they are needed, for
some of the points at a time; only the (3, 3) covariance of a point for known x is stored. Time and memory are thus
linear in the number of points, and only the reduced matrix does not depend on it.

**Parallel elimination.** `SharedReduction` distributes the points over several processes. The packets of a share are
sent once. Unknowns, coordinates of the points and weights go to the shares; the reduced equations come back and are
added in the order of the shares, so that the same number of shares gives bit-identical results, and another number the
same sums to rounding.
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
from analysis.block.block import ModelScene
from analysis.block.error_processes import Corrections, cross, rotated, rotated_back, rotation_vector_derivatives
from analysis.block.reweighting import standardised_packets
from analysis.orbit.rational_polynomial import coefficient_rows
from analysis.orbit.three_line_model import LineModel, Rays


class Packets(Protocol):
    """Interface of a set of packets (the equations of one measurement of one ground point) of one kind."""

    @property
    def name(self) -> str:
        """Name of the set of observations, such as that of the scene, for messages."""

    @property
    def group(self) -> str:
        """Name of the variance group of the set; measurements of a group share one variance factor."""

    @property
    def rows(self) -> int:
        """Number d of equations of each packet (measurement of a ground point)."""

    @property
    def point(self) -> Indices:
        """Index of the ground point that each of the n measurements (packets) observes, (n,)."""

    @property
    def columns(self) -> Indices:
        """Indices, among all unknowns, of the w unknowns on which each of n measurements depends, (n, w)."""

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """Return whitened misclosures of k measurements, and their derivatives with respect to unknowns and points.

        Each measurement gives one packet of d equations. The misclosures are (k, d), the derivatives (k, d, w) with
        respect to the w unknowns of `columns` and (k, d, 3) with respect to the ground points.

        Parameters
        ----------
        which : (k,) ndarray of int
            Indices of the measurements.
        x : (P,) ndarray
            Values of all P unknowns.
        ground : (k, 3) ndarray
            Ground points of these measurements, ITRS, in metres.
        """

    def taken(self, which: Indices, point: Indices) -> Packets:
        """Return selected measurements as a new set.

        Parameters
        ----------
        which : (k,) ndarray of int
            Indices of the measurements.
        point : (k,) ndarray of int
            New indices of their ground points.
        """


@dataclass(frozen=True, eq=False)
class LineImage:
    """Image points of one line camera in one pass, n in number.

    Attributes
    ----------
    name : str
        Name of the scene.
    camera : LineModel
        Camera before its change in this pass.
    rays : Rays
        Image points with readings of station and attitude.
    white : (n, 2, 2) ndarray
        Matrices that whiten the misclosures.
    corrections : Corrections
        Corrections of the readings.
    change : (4,) ndarray of int
        Indices, among all unknowns, of the camera's changes d_alpha, d_beta, d_gamma (rotations about its Y, X and Z
        axes) and d_f (principal distance).
    unit : (4,) ndarray
        Scale of each of these unknowns: the change, in radians or metres, for a value of 1.
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
        """Index of the ground point that each of the n image points shows, (n,)."""
        return self.rays.point

    @property
    def columns(self) -> Indices:
        """Indices (n, w) of the w unknowns on which each of n image points depends.

        They are the corrections of the readings and the camera changes.
        """
        change = np.broadcast_to(self.change, (len(self.rays.point), len(self.change)))
        return np.concatenate([self.corrections.columns, change], axis=1)

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """Return whitened collinearity misclosures of image points, with derivatives for unknowns and ground points."""
        rays, camera = self.rays, self.camera.drifted(self.unit * x[self.change])
        corrections = self.corrections.taken(which)
        rotation, shift = corrections.at(x)
        attitude = rays.attitude[which]
        arm = ground - rays.station[which] - shift @ corrections.axes.T
        body = rotated_back(rotation, np.einsum("nji,nj->ni", attitude, arm))
        projection = camera.seen(body, rays.image[which])
        white = self.white[which]
        by_body = white @ projection.by_body
        by_measured = rotated(rotation, by_body)
        by_ground = by_measured @ np.swapaxes(attitude, 1, 2)
        # a small rotation s of the body moves the arm by arm x s, and t . (arm x s) = (t x arm) . s
        by_turn = rotation_vector_derivatives(rotation, cross(by_body, body[:, None]))
        slopes = corrections.slopes(by_turn, -by_ground)
        return (
            np.einsum("nij,nj->ni", white, projection.miss),
            np.concatenate([slopes, white @ (projection.by_drift * self.unit)], axis=2),
            by_ground,
        )

    def taken(self, which: Indices, point: Indices) -> LineImage:
        """Return selected image points as a new set, with the given indices of their ground points."""
        rays = replace(self.rays.taken(which), point=point)
        return replace(self, rays=rays, white=self.white[which], corrections=self.corrections.taken(which))


@dataclass(frozen=True, eq=False)
class ModelImage:
    """Image points of an image that is a function of the ground, n in number.

    Attributes
    ----------
    scene : ModelScene
        Image with its points and the terms of its correction.
    white : (n, 2, 2) ndarray
        Matrices that whiten the misclosures.
    change : (2 K,) ndarray of int
        Indices, among all unknowns, of the K coefficients of the correction of the line, then of the sample.
    unit : (2 K,) ndarray
        Scale of each of these unknowns: the coefficient, in pixels, for a value of 1.
    group : str
        Variance group.
    """

    scene: ModelScene
    white: Array
    change: Indices
    unit: Array
    group: str = "image"
    rows: int = 2

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.scene.name

    @property
    def point(self) -> Indices:
        """Index of the ground point that each of the n image points shows, (n,)."""
        return self.scene.rays.point

    @property
    def columns(self) -> Indices:
        """Indices (n, 2 K) of the unknowns, the coefficients of the correction, on which each image point depends."""
        return np.broadcast_to(self.change, (len(self.point), len(self.change)))

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """Return whitened misclosures of image points, with derivatives for unknowns and ground points."""
        position, slope = self.scene.model.seen(ground)
        basis, white = self.scene.basis(position), self.white[which]
        coefficients = (self.unit * x[self.change]).reshape(2, -1)
        miss = position + basis @ coefficients.T - self.scene.rays.image[which]
        by_x = coefficient_rows(basis) * self.unit
        by_ground = (np.eye(2) + self.scene.jacobian(coefficients)) @ slope
        return np.einsum("nij,nj->ni", white, miss), white @ by_x, white @ by_ground

    def taken(self, which: Indices, point: Indices) -> ModelImage:
        """Return selected image points as a new set, with the given indices of their ground points."""
        rays = replace(self.scene.rays.taken(which), point=point)
        return replace(self, scene=replace(self.scene, rays=rays), white=self.white[which])


@dataclass(frozen=True, eq=False)
class Pointings:
    """Laser altimeter footprints, n of them: range, and direction of the beam in the body frame.

    Attributes
    ----------
    name : str
        Name of the set.
    point : (n,) ndarray of int
        Indices of the footprints' points.
    station : (n, 3) ndarray
        Measured positions, ITRS, in metres.
    attitude : (n, 3, 3) ndarray
        Measured rotations from the body to ITRS.
    aim : (n, 3) ndarray
        Unit vectors of the beam in the body frame.
    distance : (n,) ndarray
        Measured ranges, in metres.
    corrections : Corrections
        Corrections of the readings.
    sigma : tuple of float
        Sigma of the range, in metres, and of the pointing including the beam's width about each of two axes, in
        radians.
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
        """Indices (n, w) of the w unknowns, corrections of the readings, on which each of n footprints depends."""
        return self.corrections.columns

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """Return whitened misclosures of range and beam direction, with derivatives for unknowns and ground points."""
        corrections = self.corrections.taken(which)
        rotation, shift = corrections.at(x)
        attitude = self.attitude[which]
        arm = ground - self.station[which] - shift @ corrections.axes.T
        arm = rotated_back(rotation, np.einsum("nji,nj->ni", attitude, arm))
        distance = np.linalg.norm(arm, axis=1)
        unit = arm / distance[:, None]
        aim = self.aim[which]
        first = np.cross(aim, np.eye(3)[np.abs(aim[0]).argmin()])
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
        across = np.stack([first, np.cross(aim, first)], axis=1)
        miss = np.concatenate(
            [
                (distance - self.distance[which])[:, None] / self.sigma[0],
                np.einsum("nij,nj->ni", across, unit) / self.sigma[1],
            ],
            axis=1,
        )
        projection = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        by_arm = np.concatenate(
            [unit[:, None] / self.sigma[0], across @ projection / (self.sigma[1] * distance[:, None, None])], axis=1
        )
        by_turn = rotation_vector_derivatives(rotation, cross(by_arm, arm[:, None]))
        by_point = rotated(rotation, by_arm) @ np.swapaxes(attitude, 1, 2)
        return miss, corrections.slopes(by_turn, -by_point), by_point

    def taken(self, which: Indices, point: Indices) -> Pointings:
        """Return selected footprints as a new set, with the given indices of their ground points."""
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
    """Surveyed coordinates of n control points as observations, with a common shift as an optional unknown.

    Attributes
    ----------
    name : str
        Name of the set.
    point : (n,) ndarray of int
        Indices of the points.
    surveyed : (n, 3) ndarray
        Surveyed coordinates, ITRS, in metres.
    white : (n, 3, 3) ndarray
        Matrices that whiten the misclosures.
    datum : (0,) or (3,) ndarray of int
        Indices, among all unknowns, of the shift in metres along the ITRS axes that all surveyed coordinates have in
        common; empty for none.
    group : str
        Variance group.
    """

    name: str
    point: Indices
    surveyed: Array
    white: Array
    datum: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    group: str = "control"
    rows: int = 3

    @property
    def columns(self) -> Indices:
        """Indices of the common shift for each of n control points, (n, 3), or (n, 0) if it is not estimated."""
        return np.broadcast_to(self.datum, (len(self.point), len(self.datum)))

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """Return whitened misclosures of surveyed coordinates, with derivatives for the common shift and points."""
        white = self.white[which]
        shift = x[self.datum] if len(self.datum) else np.zeros(3)
        miss = np.einsum("nij,nj->ni", white, ground - self.surveyed[which] + shift)
        return miss, white[:, :, : len(self.datum)], white

    def taken(self, which: Indices, point: Indices) -> FixedPoints:
        """Return selected control points as a new set, with the given indices of their ground points."""
        return replace(self, point=point, surveyed=self.surveyed[which], white=self.white[which])


@dataclass(frozen=True, eq=False)
class Heights:
    """Terrain model heights at n points, with a common error of the model.

    Attributes
    ----------
    name : str
        Name of the set.
    point : (n,) ndarray of int
        Indices of the points.
    place : (n, 3) ndarray
        Positions on the model's surface at the points' start values, ITRS, in metres.
    normal : (n, 3) ndarray
        Unit normals of the surface at these positions.
    sigma : (n,) ndarray
        Sigma of the independent height errors, in metres.
    common : (1,) ndarray of int
        Index, among all unknowns, of the model's common height error.
    unit : float
        Scale of that unknown: the common height error, in metres, for a value of 1.
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
        """Index of the unknown common height error for each of n points, (n, 1)."""
        return np.broadcast_to(self.common, (len(self.point), 1))

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """Return whitened misclosures of heights, with derivatives for their common error and the points."""
        normal, sigma = self.normal[which], self.sigma[which]
        above = np.sum(normal * (ground - self.place[which]), axis=1) - self.unit * float(x[self.common[0]])
        by_x = np.broadcast_to(-self.unit / sigma[:, None, None], (len(which), 1, 1))
        return (above / sigma)[:, None], by_x, (normal / sigma[:, None])[:, None]

    def taken(self, which: Indices, point: Indices) -> Heights:
        """Return selected terrain heights as a new set, with the given indices of their ground points."""
        place, normal, sigma = self.place[which], self.normal[which], self.sigma[which]
        return replace(self, point=point, place=place, normal=normal, sigma=sigma)


_PIECE = 4_000
"""Largest number of points of a bundle."""
_AT_ONCE = 4_000_000
"""Number of derivatives that are linearised at once, which limits the memory to some times 32 MB. A set is linearised
once for each piece that sees it, so that small pieces would cost time where many images have few points each.
"""
_FLUSH = 4_000_000
"""Number of contributions to entries of the reduced matrix that are collected before they are summed, which limits the
memory.
"""
_WHOLE = 10_000
"""Number of unknowns up to which a dense matrix, of 0.8 GB, accumulates the sums."""
_LOOSE = 1e-10
"""Weight in 1/m^2 that keeps undetermined points invertible; sigma of 100 km in each coordinate."""


@dataclass(frozen=True, eq=False)
class PriorGroup:
    """Prior of k unknowns: mean and precision of a normal distribution.

    Attributes
    ----------
    group : str
        Variance group.
    columns : (k,) ndarray of int
        Indices of the k unknowns among all unknowns.
    precision : (k, k) csr_matrix
        Precision matrix, the inverse of the covariance.
    mean : (k,) ndarray
        Expected values.
    """

    group: str
    columns: Indices
    precision: sparse.csr_matrix
    mean: Array


@dataclass(frozen=True, eq=False)
class Bundle:
    """Group of n ground points that depend on the same unknowns, so that they are eliminated together.

    Attributes
    ----------
    points : (n,) ndarray of int
        Indices of the points.
    members : tuple of (int, (n,) ndarray of int)
        For each set of observations that sees the points: its index, and the index of each point's packet (measurement)
        in it.
    columns : (W,) ndarray of int
        Indices of the W unknowns on which the measurements of each point depend, each once.
    places : tuple of ndarray of int
        For each member, positions of its unknowns within `columns`.
    """

    points: Indices
    members: tuple[tuple[int, Indices], ...]
    columns: Indices
    places: tuple[Indices, ...]


@dataclass(frozen=True, eq=False)
class Rows:
    """Linearised, weighted observation equations of a bundle of points.

    Attributes
    ----------
    bundle : Bundle
        Bundle of n points with D equations each.
    by_x : (n, D, W) ndarray
        Derivatives of the D equations with respect to the W unknowns of the bundle.
    by_point : (n, D, 3) ndarray
        Derivatives of the D equations with respect to the point's coordinates, 1/m.
    miss : (n, D) ndarray
        Misclosures.
    """

    bundle: Bundle
    by_x: Array
    by_point: Array
    miss: Array


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Normal equations of all measurements, linearised at one state, with the ground points eliminated.

    Attributes
    ----------
    data : (P, P) csc_matrix
        Normal matrix of the P unknowns after elimination of the m points.
    right : (P,) ndarray
        Gradient of half the sum of squares.
    spread : (m, 3, 3) ndarray
        Covariance of the points for known x, in m^2.
    start : (m, 3) ndarray
        Steps of the points for unchanged x, in metres.
    square : mapping of str to float
        Weighted sum of squared residuals of each variance group.
    """

    data: sparse.csc_matrix
    right: Array
    spread: Array
    start: Array
    square: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Reduced(Eliminated):
    """Normal equations of measurements and priors with the ground points eliminated.

    `right` includes the priors; `data` does not.

    Attributes
    ----------
    prior : (P, P) csc_matrix
        Precision of the P unknowns by the priors, with the variance factors.
    """

    prior: sparse.csc_matrix


@dataclass(frozen=True, eq=False)
class State:
    """State of the iteration: unknowns, points, robust weights and variance factors.

    Attributes
    ----------
    x : (P,) ndarray
        Values of the P unknowns, in units of their a-priori sigmas.
    ground : (m, 3) ndarray
        Coordinates of the m points, ITRS, in metres.
    weight : tuple of ndarray
        Robust weights of the packets (measurements) of each set.
    factor : mapping of str to float
        Variance factor of each group.
    """

    x: Array
    ground: Array
    weight: tuple[Array, ...]
    factor: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Checked:
    """Standardised residuals of all measurements, and the redundancy of the variance groups.

    Attributes
    ----------
    standard : tuple of (n, d) ndarray
        Standardised residuals of the n packets (measurements), d equations each, of each set.
    taken : mapping of str to float
        Number of observations of each group minus its redundancy.
    """

    standard: tuple[Array, ...]
    taken: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Reduction:
    """Observation equations and priors of a block, with methods that eliminate the ground points from them.

    Attributes
    ----------
    sets : sequence of Packets
        Sets of packets (the equations of one measurement of one ground point).
    priors : sequence of PriorGroup
        Priors, which must cover every unknown.
    size : int
        Number of unknowns, P.
    count : int
        Number of points, m.
    """

    sets: Sequence[Packets]
    priors: Sequence[PriorGroup]
    size: int
    count: int

    @cached_property
    def bundles(self) -> tuple[Bundle, ...]:
        """Groups (bundles) of observed points whose measurements depend on the same unknowns."""
        points, codes, owners, places, tables = [], [], [], [], []
        first = 0
        for k, packets in enumerate(self.sets):
            columns = packets.columns
            if not len(columns):
                continue
            where, code = _distinct(columns)
            points.append(packets.point)
            codes.append(first + code)
            owners.append(np.full(len(columns), k, np.int32))
            places.append(np.arange(len(columns)))
            tables += list(columns[where])
            first += len(where)
        if not points:
            return ()
        order = np.lexsort((np.concatenate(codes), np.concatenate(points)))
        sorted_columns: list[Indices] = [
            np.concatenate(v).astype(np.intp)[order] for v in (points, codes, owners, places)
        ]
        point, code, owner, place = sorted_columns
        starts: Indices = np.flatnonzero(np.diff(point, prepend=-1))
        counts = np.diff(np.append(starts, len(point)))
        bundles = []
        for count in np.unique(counts).tolist():
            at = starts[counts == count][:, None] + np.arange(count)
            kinds, kind = _distinct(code[at])
            sort = np.argsort(kind, kind="stable")
            for piece in np.split(sort, np.cumsum(np.bincount(kind, minlength=len(kinds)))[:-1]):
                rows = at[piece]
                tables_met = [tables[c] for c in code[rows[0]].tolist()]
                columns_met = np.asarray(np.unique(np.concatenate(tables_met)), np.intp)
                positions = tuple(np.searchsorted(columns_met, packets) for packets in tables_met)
                # a long bundle is split to bound the memory of its rows
                for a in range(0, len(rows), _PIECE):
                    part = rows[a : a + _PIECE]
                    members = tuple((int(owner[part[0, j]]), place[part[:, j]]) for j in range(count))
                    bundles.append(Bundle(point[part[:, 0]], members, columns_met, positions))
        return tuple(bundles)

    @cached_property
    def pieces(self) -> tuple[tuple[Bundle, ...], ...]:
        """Bundles grouped into parts of some million derivatives, each of which is linearised at once."""
        pieces: list[list[Bundle]] = [[]]
        size = 0
        for bundle in self.bundles:
            members = zip(bundle.members, bundle.places, strict=True)
            derivatives = len(bundle.points) * sum(self.sets[k].rows * (3 + len(place)) for (k, _), place in members)
            if size and size + derivatives > _AT_ONCE:
                pieces.append([])
                size = 0
            pieces[-1].append(bundle)
            size += derivatives
        return tuple(tuple(piece) for piece in pieces)

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Mask of those of the m ground points that have at least one measurement, (m,)."""
        mask = np.zeros(self.count, bool)
        for packets in self.sets:
            mask[packets.point] = True
        return mask

    def rows(self, state: State, weighted: bool = True) -> Iterator[Rows]:
        """Yield the equations of all bundles, in the order of `pieces`.

        Parameters
        ----------
        state : State
            State at which the equations are linearised.
        weighted : bool
            True to multiply the equations by the square roots of their weights.
        """
        for piece in self.pieces:
            parts = self._linearised(piece, state)
            used: dict[int, int] = {}
            if weighted:
                for k, (which, *equations) in parts.items():
                    root = np.sqrt(state.weight[k][which] / state.factor.get(self.sets[k].group, 1.0))
                    parts[k] = (which, *(root.reshape(-1, *[1] * (part.ndim - 1)) * part for part in equations))
            for bundle in piece:
                n, width = len(bundle.points), len(bundle.columns)
                depth = sum(self.sets[k].rows for k, _ in bundle.members)
                rows = Rows(bundle, np.zeros((n, depth, width)), np.empty((n, depth, 3)), np.empty((n, depth)))
                d = 0
                for (k, which), position in zip(bundle.members, bundle.places, strict=True):
                    a = used.get(k, 0)
                    used[k] = b = a + len(which)
                    miss, by_x, by_point = (v[a:b] for v in parts[k][1:])
                    rows.miss[:, d : d + miss.shape[1]] = miss
                    rows.by_point[:, d : d + miss.shape[1]] = by_point
                    rows.by_x[:, d : d + miss.shape[1], position] = by_x
                    d += miss.shape[1]
                yield rows

    @cached_property
    def _last(self) -> list[tuple[Array, Array, dict[int, tuple[Any, ...]]]]:
        """Unknowns and points of the last linearisation, and its equations, of measurements that make one piece."""
        return []

    def _linearised(self, piece: Sequence[Bundle], state: State) -> dict[int, tuple[Any, ...]]:
        """Return indices of measurements, misclosures and derivatives by unknowns and points, of each set of a piece.

        Normal equations, steps of the points and residuals need the same ones, which are kept where they are few.
        """
        for x, ground, kept in self._last:
            if x is state.x and ground is state.ground:
                return dict(kept)
        selected: dict[int, list[Indices]] = {}
        for bundle in piece:
            for k, which in bundle.members:
                selected.setdefault(k, []).append(which)
        needed = {k: np.concatenate(selections) for k, selections in selected.items()}
        parts = {
            k: (which, *self.sets[k].linearised(which, state.x, state.ground[self.sets[k].point[which]]))
            for k, which in needed.items()
        }
        if len(self.pieces) == 1:
            self._last[:] = [(state.x, state.ground, parts)]
        return dict(parts)

    def reduced(self, state: State) -> Reduced:
        """Return the normal equations of measurements and priors at a state, with the ground points eliminated."""
        return self.with_priors(self.eliminated(state), state)

    def with_priors(self, equations: Eliminated, state: State) -> Reduced:
        """Return the normal equations of the measurements with the priors of the unknowns added."""
        gradient = np.zeros(self.size)
        for prior in self.priors:
            pull = prior.precision @ (state.x[prior.columns] - prior.mean) / state.factor.get(prior.group, 1.0)
            np.add.at(gradient, prior.columns, pull)
        right = equations.right + gradient
        return Reduced(
            equations.data, right, equations.spread, equations.start, equations.square, self.prior(state.factor)
        )

    def eliminated(self, state: State) -> Eliminated:
        """Return the normal equations of the measurements at a state, with the ground points eliminated."""
        data = _Collected(self.size)
        right = np.zeros(self.size)
        spread, start = np.zeros((self.count, 3, 3)), np.zeros((self.count, 3))
        square = dict.fromkeys((packets.group for packets in self.sets), 0.0)
        for rows in self.rows(state):
            a, b, m = rows.by_x, rows.by_point, rows.miss
            transposed = np.swapaxes(b, 1, 2)
            point_normal = transposed @ b + _LOOSE * np.eye(3)
            inverse = np.linalg.inv(point_normal)
            pull = np.einsum("nij,nj->ni", transposed, m)
            cross = transposed @ a
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
        """Return the a-priori precision (P, P) of the P unknowns, scaled by the variance factors of the groups."""
        rows, columns, values = [], [], []
        for prior in self.priors:
            precision = prior.precision.tocoo()
            rows.append(prior.columns[precision.row])
            columns.append(prior.columns[precision.col])
            values.append(precision.data / factor.get(prior.group, 1.0))
        where = (np.concatenate(rows), np.concatenate(columns))
        return sparse.csc_matrix((np.concatenate(values), where), shape=(self.size, self.size))

    def prior_square(self, x: Array, factor: Mapping[str, float]) -> dict[str, float]:
        """Return, for each variance group, the sum of squared residuals of its priors, weighted by their precision."""
        squares: dict[str, float] = {}
        for prior in self.priors:
            deviation = x[prior.columns] - prior.mean
            value = float(deviation @ (prior.precision @ deviation)) / factor.get(prior.group, 1.0)
            squares[prior.group] = squares.get(prior.group, 0.0) + value
        return squares

    def point_steps(self, state: State, equations: Eliminated, step: Array) -> Array:
        """Return the steps of the m points, (m, 3), in metres, that correspond to a step of the unknowns.

        Parameters
        ----------
        state : State
            State at which the equations are linearised.
        equations : Eliminated
            Normal equations of this state.
        step : (P,) ndarray
            Step of the P unknowns.
        """
        steps = equations.start.copy()
        for rows in self.rows(state):
            by_step = np.einsum("nij,j->ni", rows.by_x, step[rows.bundle.columns])
            pull = np.einsum("nij,ni->nj", rows.by_point, by_step)
            steps[rows.bundle.points] -= np.einsum("nij,nj->ni", equations.spread[rows.bundle.points], pull)
        return steps

    def checked(self, state: State, spread: Array, covariance: Callable[[Indices], Array]) -> Checked:
        """Return the standardised residuals and the redundancy of the observations.

        Parameters
        ----------
        state : State
            State at which the equations are linearised.
        spread : (m, 3, 3) ndarray
            Covariances of the m points for known unknowns x, in m^2.
        covariance : callable
            Function from the indices of w unknowns to their covariance (w, w).
        """
        sets = self.sets
        standard = [np.zeros((len(packets.point), packets.rows)) for packets in sets]
        absorbed = dict.fromkeys((packets.group for packets in sets), 0.0)
        for rows in self.rows(state, weighted=False):
            where = rows.bundle.points
            weights = np.concatenate(
                [
                    np.repeat((state.weight[k][w] / state.factor[sets[k].group])[:, None], sets[k].rows, axis=1)
                    for k, w in rows.bundle.members
                ],
                axis=1,
            )
            inner = spread[where]
            coupling = inner @ np.swapaxes(rows.by_point * weights[:, :, None], 1, 2) @ rows.by_x
            projected = rows.by_x - rows.by_point @ coupling
            shared = covariance(rows.bundle.columns)
            d = 0
            for k, which in rows.bundle.members:
                depth = sets[k].rows
                part, by_point = projected[:, d : d + depth], rows.by_point[:, d : d + depth]
                product = np.tensordot(part, shared, 1)
                cofactor = product @ np.swapaxes(part, 1, 2) + by_point @ inner @ np.swapaxes(by_point, 1, 2)
                weight, unit = state.weight[k][which], state.factor[sets[k].group]
                standard[k][which] = standardised_packets(rows.miss[:, d : d + depth], cofactor, weight, unit)
                absorbed[sets[k].group] += float(np.sum(weight * np.trace(cofactor, axis1=1, axis2=2)) / unit)
                d += depth
        return Checked(tuple(standard), absorbed)

    def packets_at(self, points: Indices) -> tuple[Indices, ...]:
        """Return, for each set of observations, the indices of the measurements of k selected points."""
        selected = np.zeros(self.count, bool)
        selected[points] = True
        return tuple(np.flatnonzero(selected[packets.point]) for packets in self.sets)

    def restricted(self, points: Indices) -> Reduction:
        """Return the measurements of k selected points alone, the points renumbered in this order, without priors."""
        number = np.full(self.count, -1)
        number[points] = np.arange(len(points))
        packets = self.packets_at(points)
        sets = tuple(
            packets_of_set.taken(which, number[packets_of_set.point[which]])
            for packets_of_set, which in zip(self.sets, packets, strict=True)
        )
        return Reduction(sets, (), self.size, len(points))

    def state_of(self, points: Indices, state: State) -> State:
        """Return the part of a state that concerns selected points: coordinates and weights of their measurements."""
        weight = tuple(w[which] for w, which in zip(state.weight, self.packets_at(points), strict=True))
        return State(state.x, state.ground[points], weight, state.factor)


def _distinct(rows: Indices) -> tuple[Indices, Indices]:
    """Return the distinct rows of a table of integers with n rows: an example of each, and the class of every row.

    The first array (k,) has the index of one row of each of the k distinct kinds, the second (n,) the kind, 0 to k - 1,
    of each row.
    """
    if not rows.shape[1]:
        return np.zeros(1, np.intp), np.zeros(len(rows), np.intp)
    # hashes by random odd factors almost surely differ for different rows; collisions are checked below
    factors = np.random.default_rng(0).integers(1, 2**62, rows.shape[1]) * 2 + 1
    with np.errstate(over="ignore"):
        key = rows.astype(np.int64) @ factors
    _, where, code = np.unique(key, return_index=True, return_inverse=True)
    code = code.ravel()
    if not np.array_equal(rows[where][code], rows):
        _, where, code = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    # keep the order of the numbers, so that neighbours in time stay neighbours
    order = np.lexsort(rows[where].T[::-1])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return np.asarray(where[order], np.intp), np.asarray(rank[code.ravel()], np.intp)


class _Collected:
    """Accumulator of small dense blocks of a large symmetric matrix, dense for few unknowns and otherwise sparse."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.whole = np.zeros((size, size)) if size <= _WHOLE else None
        self.sum = sparse.csc_matrix((size, size))
        self.parts: list[tuple[Indices, Indices, Array]] = []
        self.entries = 0

    def add(self, columns: Indices, block: Array) -> None:
        """Add a block (w, w) at the rows and columns of w unknowns, which must be distinct."""
        if self.whole is not None:
            self.whole[columns[:, None], columns] += block
            return
        width = len(columns)
        self.parts.append((np.repeat(columns, width), np.tile(columns, width), block.ravel()))
        self.entries += width**2
        if self.entries > _FLUSH:
            self.flush()

    def flush(self) -> None:
        """Add the collected blocks to the total matrix, which frees their memory."""
        if self.parts:
            row, column, value = (np.concatenate(v) for v in zip(*self.parts, strict=True))
            self.sum = self.sum + sparse.csc_matrix((value, (row, column)), shape=(self.size, self.size))
        self.parts, self.entries = [], 0

    def total(self) -> sparse.csc_matrix:
        """Return the sum of all blocks as a symmetric matrix."""
        self.flush()
        total = self.sum if self.whole is None else sparse.csc_matrix(self.whole)
        return 0.5 * (total + total.T)


class Pool(Protocol):
    """Interface of worker processes that store objects and call functions on them."""

    @property
    def count(self) -> int:
        """Number of worker processes."""

    def hold(self, objects: Sequence[Any]) -> Sequence[Any]:
        """Send each object to one process and return handles that stand for it in the arguments of `results`."""

    def results(self, work: Callable[[tuple[Any, ...]], Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Run a function for each of the arguments in the processes and return the results in the same order."""


@dataclass(frozen=True, eq=False)
class SharedReduction:
    """Observation equations of a block distributed over processes by ground points.

    The methods are those of `Reduction`. A share is the part of the points that one process holds, with their
    measurements.

    Attributes
    ----------
    whole : Reduction
        Packets (each the equations of one measurement of one ground point) and priors of the block.
    pool : Pool
        Processes that hold the shares.
    points : tuple of (m_k,) ndarray of int
        Indices of the m_k points of each share k.
    packets : tuple of tuple of ndarray of int
        Indices of the measurements of each share, by set of observations.
    held : tuple
        Handle of each share's data in its process.
    columns : tuple of (w_k,) ndarray of int
        Indices of the w_k unknowns on which the measurements of each share k depend.
    """

    whole: Reduction
    pool: Pool
    points: tuple[Indices, ...]
    packets: tuple[tuple[Indices, ...], ...]
    held: tuple[Any, ...]
    columns: tuple[Indices, ...]

    @classmethod
    def of(cls, whole: Reduction, pool: Pool) -> SharedReduction:
        """Distribute a reduction over the processes of a pool.

        Each process receives points that, as far as possible, the same sets observe.
        """
        first, last = np.full(whole.count, len(whole.sets)), np.full(whole.count, -1)
        for k, packets_of_set in enumerate(whole.sets):
            first[packets_of_set.point] = np.minimum(first[packets_of_set.point], k)
            last[packets_of_set.point] = k
        order = np.lexsort((last, first))
        seen = order[last[order] >= 0]
        points = tuple(np.sort(part) for part in np.array_split(seen, min(pool.count, len(seen))))
        packets = tuple(whole.packets_at(part) for part in points)
        held = tuple(pool.hold([whole.restricted(part) for part in points]))
        columns = tuple(pool.results(_columns, [(packets_of_set,) for packets_of_set in held]))
        return cls(whole, pool, points, packets, held, columns)

    def _states(self, state: State) -> list[State]:
        """Return the part of a state (unknowns, points, weights) that each process needs for its share."""
        return [
            State(
                state.x,
                state.ground[points],
                tuple(w[p] for w, p in zip(state.weight, packets, strict=True)),
                state.factor,
            )
            for points, packets in zip(self.points, self.packets, strict=True)
        ]

    def eliminated(self, state: State) -> Eliminated:
        """Return the normal equations of the measurements at a state, with the ground points eliminated."""
        size, count = self.whole.size, self.whole.count
        data, right = sparse.csc_matrix((size, size)), np.zeros(size)
        spread, start = np.zeros((count, 3, 3)), np.zeros((count, 3))
        square = dict.fromkeys((packets.group for packets in self.whole.sets), 0.0)
        parts = self.pool.results(_eliminated, list(zip(self.held, self._states(state), strict=True)))
        for points, part in zip(self.points, parts, strict=True):
            data, right = data + part.data, right + part.right
            spread[points], start[points] = part.spread, part.start
            for group, value in part.square.items():
                square[group] += value
        return Eliminated(data, right, spread, start, square)

    def point_steps(self, at: State, equations: Eliminated, step: Array) -> Array:
        """Return the steps of the m points, (m, 3), in metres, that correspond to a step of the unknowns."""
        steps = np.zeros((self.whole.count, 3))
        arguments = [
            (held, state, equations.spread[points], equations.start[points], step)
            for held, state, points in zip(self.held, self._states(at), self.points, strict=True)
        ]
        for points, part in zip(self.points, self.pool.results(_stepped, arguments), strict=True):
            steps[points] = part
        return steps

    def checked(self, at: State, spread: Array, covariance: Callable[[Indices], Array]) -> Checked:
        """Return the standardised residuals and the redundancy of the observations, computed by all processes."""
        standard = [np.zeros((len(packets_of_set.point), packets_of_set.rows)) for packets_of_set in self.whole.sets]
        absorbed = dict.fromkeys((packets_of_set.group for packets_of_set in self.whole.sets), 0.0)
        arguments = [
            (held, state, spread[points], columns, covariance(columns))
            for held, state, points, columns in zip(self.held, self._states(at), self.points, self.columns, strict=True)
        ]
        for packets, part in zip(self.packets, self.pool.results(_checked, arguments), strict=True):
            for k, which in enumerate(packets):
                standard[k][which] = part.standard[k]
            for group, value in part.taken.items():
                absorbed[group] += value
        return Checked(tuple(standard), absorbed)


def _columns(arguments: tuple[Reduction]) -> Indices:
    """Return the indices of the unknowns on which the measurements of a process's share depend."""
    return np.unique(np.concatenate([np.zeros(0, np.intp), *(bundle.columns for bundle in arguments[0].bundles)]))


def _eliminated(arguments: tuple[Reduction, State]) -> Eliminated:
    """Return the normal equations of a process's share of the measurements, with the points eliminated."""
    share, state = arguments
    return share.eliminated(state)


def _stepped(arguments: tuple[Reduction, State, Array, Array, Array]) -> Array:
    """Return the steps of the m ground points of a process's share, (m, 3), in metres."""
    share, state, spread, start, step = arguments
    no_data = sparse.csc_matrix((0, 0))
    return share.point_steps(state, Eliminated(no_data, np.zeros(0), spread, start, {}), step)


def _checked(arguments: tuple[Reduction, State, Array, Indices, Array]) -> Checked:
    """Return the standardised residuals and the redundancy of a process's share of the measurements."""
    share, state, spread, columns, covariance = arguments

    def part_of(selected: Indices) -> Array:
        position = np.searchsorted(columns, selected)
        return covariance[np.ix_(position, position)]

    return share.checked(state, spread, part_of)
