"""Normal equations of a three-line calibration, the ground points and the noise that image points share eliminated.

Rows are whitened by the covariance of their image point: image measurement plus what independent noise of attitude and
station does in the image. Noise that image points share enters as unknowns z with a prior (`SharedNoise`). A ground
point meets only its own rays and its control coordinates, so that its (3, 3) block is inverted alone and the equations
of the rest are N_yy - N_yp N_pp^-1 N_py (Schur complement). The block of z is sparse then, too; it is factorised and
eliminated in the same way, and what is left are the equations of the unknowns x.

Noise of measured attitude and station that image points of a pass share, by the laws of its readings.

Points exposed within a few readings have errors in common. The unknowns of the laws
(`analysis.block.error_processes`) are unknowns of an adjustment with a sparse prior, and the correlation of any two
image points is exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from analysis.arrays import Array
from analysis.block.error_processes import Corrections, Law, Part, Support
from analysis.block.reweighting import GroupTest
from analysis.orbit.calibration_parameters import (
    CalibrationError,
    CalibrationField,
    Noise,
    NoiseTerm,
    Parameters,
    Prior,
    index,
)
from analysis.orbit.forward_intersection import ray_covariance
from analysis.orbit.three_line_model import LineModel, Partials, Rays, misclosure, partials


@dataclass(frozen=True, eq=False)
class SharedNoise:
    """The laws of all fields, and how the rays meet their unknowns.

    Attributes
    ----------
    parts : Mapping[str, tuple[Part, ...]]
        Field -> its laws. Station and offsets of it are along the axes of the ITRS.
    met : Mapping[tuple[str, str], Corrections]
        (field, line) -> the corrections of its rays; lines without times have none.
    spans : tuple[tuple[int, int], ...]
        First and last + 1 unknown of each field.
    groups : Mapping[str, NDArray[np.intp]]
        Variance group -> its unknowns.
    precision : sparse.csr_matrix
        (K, K) sparse, of all unknowns.
    """

    parts: Mapping[str, tuple[Part, ...]]
    met: Mapping[tuple[str, str], Corrections]
    spans: tuple[tuple[int, int], ...]
    groups: Mapping[str, NDArray[np.intp]]
    precision: sparse.csr_matrix

    @classmethod
    def of(cls, fields: Sequence[CalibrationField], noise: Noise) -> SharedNoise:
        """What the rays with times share; no unknowns where there are no times or no intervals."""
        parts: dict[str, tuple[Part, ...]] = {}
        met: dict[tuple[str, str], Corrections] = {}
        spans, blocks, column = [], [], 0
        groups: dict[str, list[NDArray[np.intp]]] = {}
        for one in fields:
            times = {line: r.time for line, r in one.rays.items() if r.time is not None and r.point.size}
            begin, mine = column, []
            for term in noise.terms if times else ():
                if term.interval is None:
                    continue
                support = Support.of(_law(term, term.interval), np.concatenate(list(times.values())))
                mine.append(Part(term.kind == "attitude", column, support))
                blocks.append(sparse.kron(support.precision, sparse.eye(3)))
                groups.setdefault(term.group, []).append(np.arange(column, column + support.size))
                column += support.size
            parts[one.name] = tuple(mine)
            met |= {(one.name, line): Corrections(tuple(mine), np.eye(3), time) for line, time in times.items()}
            spans.append((begin, column))
        precision = sparse.csr_matrix(sparse.block_diag(blocks)) if blocks else sparse.csr_matrix((0, 0))
        return cls(parts, met, tuple(spans), {k: np.concatenate(v) for k, v in groups.items()}, precision)

    @property
    def size(self) -> int:
        """K, unknowns."""
        return self.precision.shape[0]

    def corrected(self, name: str, line: str, rays: Rays, shared: Array) -> Rays:
        """Rays of a line of a field with the corrections (K,) applied.

        Parameters
        ----------
        name : str
            Of the field.
        line : str
            Of the camera.
        rays : Rays
            Of that line.
        shared : Array
            Corrections of the noise that points share, (K,).
        """
        return _moved(rays, self.met.get((name, line)), shared)

    def corrected_at(self, name: str, rays: Rays, shared: Array) -> Rays:
        """Other rays of a field, with times.

        Parameters
        ----------
        name : str
            Of the field.
        rays : Rays
            With times.
        shared : Array
            Corrections of the noise that points share, (K,).
        """
        assert rays.time is not None
        return _moved(rays, Corrections(self.parts[name], np.eye(3), rays.time), shared)

    def rows(self, name: str, line: str, white: Array, by: Partials) -> sparse.csr_matrix:
        """Whitened rows (2n, K) of the rays of a line of a field.

        Parameters
        ----------
        name : str
            Of the field.
        line : str
            Of the camera.
        white : Array
            (n, 2, 2) whitens the misclosures of n rays.
        by : Partials
            Their derivatives.
        """
        count, met = len(white), self.met.get((name, line))
        if met is None:
            return sparse.csr_matrix((2 * count, self.size))
        slopes, columns = met.slopes(white @ by.attitude, -white @ by.ground), met.columns
        indices = np.repeat(columns[:, None], 2, axis=1).ravel()
        starts = columns.shape[1] * np.arange(2 * count + 1)
        return sparse.csr_matrix((slopes.ravel(), indices, starts), shape=(2 * count, self.size))


def _law(term: NoiseTerm, interval: float) -> Law:
    return Law(term.group, "walk" if term.walks else "white", (term.sigma,) * 3, interval)


def _moved(rays: Rays, met: Corrections | None, shared: Array) -> Rays:
    if met is None or not met.parts:
        return rays
    turn, shift = met.at(shared)
    turns = Rotation.from_rotvec(turn).as_matrix()
    return replace(rays, attitude=rays.attitude @ turns, station=rays.station + shift @ met.axes.T)


_CHUNK = 512
"""Points or image points whose covariances are made at once."""


@dataclass(frozen=True, eq=False)
class Weights:
    """image: (M,) robust weights of the image points, 0 to 1. factor: group -> variance factor (1: as given)."""

    image: Array
    factor: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class State:
    """Where an iteration stands.

    values: (P,) unknowns. grounds: points (m, 3) of each field. shared: (S,) unknowns of the shared noise.
    """

    values: Array
    grounds: tuple[Array, ...]
    shared: Array

    def moved(self, equations: Equations, step: Array) -> State:
        """After a step (P,) of the unknowns, all else following."""
        cuts = np.cumsum([len(g) for g in self.grounds])[:-1]
        points = np.split(equations.point_step(step), cuts)
        grounds = tuple(g + d for g, d in zip(self.grounds, points, strict=True))
        return State(self.values + step, grounds, self.shared + equations.shared_step(step))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of the observations, whitened by the a-priori covariances: image (M, 2), control (m, 3), prior (K,).

    shared: group -> sum of squares of its readings' corrections.
    """

    image: Array
    control: Array
    prior: Array
    shared: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Equations:
    """Linearised system at one state: P unknowns x, S unknowns z of the shared noise, m points p, M image points.

    Attributes
    ----------
    design : sparse.csr_matrix
        (2M, P) sparse by x, design_shared: (2M, S) by z, design_point: (2M, 3m) by p; whitened, not weighted.
    row_weight : Array
        (2M,) weight of each row.
    design_prior : Array
        (K, P) whitened. prior_weight: (K,).
    control_weight : sparse.csr_matrix
        (3m, 3m) sparse, weights of the control coordinates with the factor; 0 for tie points.
    residuals : Residuals
        At this state.
    reduced : Array
        (P, P) normal matrix with z and p eliminated. right: (P,) its negative right side.
    length : Array
        (P,) root of the diagonal, of the image points alone and before anything was eliminated.
    shared : SharedNoise
        What z stands for. shared_weight: (S, S) sparse, their prior with the factors. shared_normal: (S, S) sparse,
        their normal matrix with p eliminated.
    follow : Array
        (S, P) change of z with x. shared_start: (S,) change of z where x stays.
    point_inverse : sparse.bsr_matrix
        (3m, 3m) sparse block inverse. cross: (3m, P + S) N_py. right_point: (3m,).
    movable : NDArray[np.bool_]
        (m,) points that are unknown.
    row_spans, point_spans : tuple[tuple[int, int], ...]
        First and last + 1 row (of 2M) and coordinate (of 3m) of each field.
    """

    design: sparse.csr_matrix
    design_shared: sparse.csr_matrix
    design_point: sparse.csr_matrix
    row_weight: Array
    design_prior: Array
    prior_weight: Array
    control_weight: sparse.csr_matrix
    residuals: Residuals
    reduced: Array
    right: Array
    length: Array
    shared: SharedNoise
    shared_weight: sparse.csr_matrix
    shared_normal: sparse.csr_matrix
    follow: Array
    shared_start: Array
    point_inverse: sparse.bsr_matrix
    cross: sparse.csr_matrix
    right_point: Array
    movable: NDArray[np.bool_]
    row_spans: tuple[tuple[int, int], ...]
    point_spans: tuple[tuple[int, int], ...]

    def shared_step(self, step: Array) -> Array:
        """(S,) change of the shared noise that goes with a change (P,) of the unknowns."""
        return np.asarray(self.shared_start + self.follow @ step)

    def point_step(self, step: Array) -> Array:
        """(m, 3) change of the ground points that goes with a change (P,) of the unknowns."""
        change = np.concatenate([step, self.shared_step(step)])
        return np.asarray(-self.point_inverse @ (self.right_point + self.cross @ change)).reshape(-1, 3)

    def through_points(self) -> Array:
        """(2M, P) change of the rows with the unknowns when shared noise and ground points follow."""
        by_x, by_z = self._carried
        fixed = (self.design - self.design_point @ by_x).toarray()
        return np.asarray(fixed + (self.design_shared - self.design_point @ by_z) @ self.follow)

    @cached_property
    def shared_inverse(self) -> tuple[Array, ...]:
        """Covariance (s, s) of the z of each field at known x."""
        return tuple(_inverse(self.shared_normal[a:b, a:b].toarray()) for a, b in self.shared.spans)

    def image_cofactors(self, covariance: Array) -> Array:
        """(M, 2, 2) covariance of the adjusted, whitened image points, from that (P, P) of the unknowns."""
        followed = self.through_points().reshape(len(self.row_weight) // 2, 2, covariance.shape[0])
        found = followed @ covariance @ np.swapaxes(followed, 1, 2)
        found += _products((self.design_point @ self.point_inverse).tocsr(), self.design_point, 2)
        if self.shared.size:
            rows = (self.design_shared - self.design_point @ self._carried[1]).tocsr()
            found += self._of_shared(rows, self.row_spans, 2)
        return np.asarray(found)

    def point_covariance(self, covariance: Array) -> Array:
        """(m, 3, 3) of the adjusted ground points, zero for those that are held."""
        by_x, by_z = self._carried
        moved = np.asarray(by_x.toarray() + by_z @ self.follow).reshape(len(self.movable), 3, len(covariance))
        total = self.point_inverse.data + moved @ covariance @ np.swapaxes(moved, 1, 2)
        if self.shared.size:
            total = total + self._of_shared(by_z, self.point_spans, 3)
        return np.where(self.movable[:, None, None], total, 0.0)

    def tests(
        self, covariance: Array, cofactors: Array, weights: Weights, priors: Sequence[Prior]
    ) -> dict[str, GroupTest]:
        """Variance groups after an adjustment.

        Parameters
        ----------
        covariance : Array
            Of the P unknowns, (P, P), SI.
        cofactors : Array
            Of the adjusted image points, (M, 2, 2), whitened.
        weights : Weights
            Of the observations.
        priors : Sequence[Prior]
            Further observations of the unknowns.
        """
        residuals, factor = self.residuals, weights.factor
        squares = weights.image * np.sum(residuals.image**2, axis=1) / factor["image"]
        adjusted = weights.image * np.trace(cofactors, axis1=1, axis2=2) / factor["image"]
        rows: dict[str, tuple[float, float, float]] = {}
        rows["image"] = (2.0 * np.sum(weights.image > 0), np.sum(adjusted), np.sum(squares))
        # control_weight is block diagonal: the sum of products is the trace with the points' own blocks
        given = self.control_weight.tobsr((3, 3))
        own = self.point_covariance(covariance)[given.indices]
        control = np.sum(residuals.control**2) / factor["control"]
        rows["control"] = (np.sum(self.control_weight.diagonal() > 0), np.sum(given.data * own), control)
        told = self.prior_weight * np.einsum("kp,pq,kq->k", self.design_prior, covariance, self.design_prior)
        square = self.prior_weight * residuals.prior**2
        for group in dict.fromkeys(p.group for p in priors):
            member = np.array([p.group == group for p in priors])
            rows[group] = (np.sum(member), np.sum(told[member]), np.sum(square[member]))
        for group, taken in self._taken(covariance).items():
            rows[group] = (len(self.shared.groups[group]), taken, residuals.shared[group] / factor[group])
        return {g: GroupTest(int(n), float(n - t), float(v), float(factor[g])) for g, (n, t, v) in rows.items()}

    def _taken(self, covariance: Array) -> dict[str, float]:
        """Group of the shared noise -> how many of its readings the image points do not check."""
        taken = np.zeros(self.shared.size)
        for (a, b), inverse in zip(self.shared.spans, self.shared_inverse, strict=True):
            found = inverse + self.follow[a:b] @ covariance @ self.follow[a:b].T
            taken[a:b] = np.asarray(self.shared_weight[a:b, a:b].multiply(found).sum(axis=1)).ravel()
        return {g: float(np.sum(taken[c])) for g, c in self.shared.groups.items()}

    @cached_property
    def _carried(self) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        """(3m, P) and (3m, S): the points move by their negative with x and z."""
        both, count = (self.point_inverse @ self.cross).tocsc(), self.design.shape[1]
        return both[:, :count].tocsr(), both[:, count:].tocsr()

    def _of_shared(self, rows: sparse.csr_matrix, spans: Sequence[tuple[int, int]], size: int) -> Array:
        """Diagonal blocks (n, size, size) of rows (n size, S) times the covariance of z at known x times rows'."""
        found = np.zeros((rows.shape[0] // size, size, size))
        for (first, last), (a, b), inverse in zip(spans, self.shared.spans, self.shared_inverse, strict=True):
            if b == a:
                continue
            values, columns = _padded(rows[first:last, a:b].tocoo(), size)
            for begin in range(0, len(values), _CHUNK):
                some, where = values[begin : begin + _CHUNK], columns[begin : begin + _CHUNK]
                spread = inverse[where[:, :, None], where[:, None, :]]
                found[first // size + begin :][: len(some)] = some @ spread @ np.swapaxes(some, 1, 2)
        return found


def assemble(
    fields: Sequence[CalibrationField],
    cameras: Mapping[str, LineModel],
    parameters: Parameters,
    state: State,
    noise: Noise,
    priors: Sequence[Prior],
    weights: Weights,
    shared: SharedNoise,
    hidden: Hidden | None = None,
) -> Equations:
    """Linearise at a state.

    Image rows run by field, line and ray, x before y; points and shared unknowns by field. `hidden` terms, zero at this
    state, are unknowns after those of the parameters.
    """
    known = len(state.values)
    count = known + (0 if hidden is None else hidden.size)
    rows, points, misses, places, shares = [], [], [], [], []
    spans: list[list[tuple[int, int]]] = [[], []]
    first = row = 0
    for one, ground in zip(fields, state.grounds, strict=True):
        axes, begin = one.axes, row
        for line, measured in one.rays.items():
            rays = shared.corrected(one.name, line, measured, state.shared)
            rays = parameters.turned(state.values, one.name, line, rays)
            camera, bias, offset = parameters.parts(state.values, one.name, line, cameras[line])
            shown, moved = ground[rays.point], axes @ offset
            by = partials(camera, rays, shown, bias, moved)
            white = np.linalg.inv(np.linalg.cholesky(ray_covariance(noise, rays, by, shared=False)))
            block = np.zeros((len(rays.point), 2, count))
            since = parameters.since_middle(one.name, rays)[:, None, None]
            parts = (by.interior, by.bias, -by.ground @ axes, by.drift, by.attitude * since)
            for where, part in zip(parameters.columns[one.name, line], parts, strict=True):
                if where[0] >= 0:
                    block[:, :, where] = part
            if hidden is not None:
                block[:, :, known:] = hidden.columns(one, line, rays, by)
            rows.append(sparse.csr_matrix((white @ block).reshape(2 * len(block), count)))
            shares.append(shared.rows(one.name, line, white, by))
            points.append(white @ by.ground)
            misses.append(np.einsum("nij,nj->ni", white, misclosure(camera, rays, shown, bias, moved)))
            places.append(first + rays.point)
            row += 2 * len(rays.point)
        spans[0].append((begin, row))
        spans[1].append((3 * first, 3 * (first + len(ground))))
        first += len(ground)
    found = _Rows(
        sparse.vstack(rows).tocsr(),
        sparse.vstack(shares).tocsr(),
        np.concatenate(points),
        np.concatenate(misses),
        np.concatenate(places),
        (tuple(spans[0]), tuple(spans[1])),
    )
    design, residual, weight = _priors(parameters, state.values, priors, weights)
    design = np.pad(design, ((0, 0), (0, count - known)))
    return _reduce(fields, state, found, (design, residual, weight), weights, shared)


class Hidden(Protocol):
    """Terms that the model leaves out."""

    @property
    def size(self) -> int:
        """Number of terms."""

    def columns(self, field: CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) change of the misclosures with each of them.

        Parameters
        ----------
        field : CalibrationField
            The pass.
        line : str
            Of the camera.
        rays : Rays
            n image points of it.
        by : Partials
            Derivatives of their misclosures.
        """


@dataclass(frozen=True, eq=False)
class _Rows:
    """Whitened rows: by x (2M, P), z (2M, S) and the point (M, 2, 3); misclosures (M, 2); which point (M,); spans."""

    design: sparse.csr_matrix
    design_shared: sparse.csr_matrix
    point: Array
    miss: Array
    place: NDArray[np.intp]
    spans: tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]


def _reduce(
    fields: Sequence[CalibrationField],
    state: State,
    rows: _Rows,
    prior: tuple[Array, Array, Array],
    weights: Weights,
    shared: SharedNoise,
) -> Equations:
    exact = np.concatenate([f.control & ~np.any(f.covariance, axis=(1, 2)) for f in fields])
    control = np.concatenate([f.control for f in fields]) & ~exact
    total, count = len(exact), rows.design.shape[1]
    point = np.where(exact[rows.place][:, None, None], 0.0, rows.point)
    # one (2, 3) block for each image point
    pattern = (point, rows.place, np.arange(len(rows.place) + 1))
    design_point = sparse.bsr_matrix(pattern, shape=(2 * len(rows.place), 3 * total)).tocsr()
    row_weight = np.repeat(weights.image, 2) / weights.factor.get("image", 1.0)
    inverse = np.zeros((total, 3, 3))
    inverse[control] = np.linalg.inv(np.concatenate([f.covariance for f in fields])[control])
    departure = np.concatenate([g - f.ground for g, f in zip(state.grounds, fields, strict=True)])
    control_residual = np.einsum("nji,nj->ni", _root(inverse, control), departure)
    held = _blocks(inverse * (1.0 / weights.factor.get("control", 1.0)))
    every = sparse.hstack([rows.design, rows.design_shared]).tocsr()
    weighted = (sparse.diags(row_weight) @ every).tocsr()
    cross = (design_point.T @ weighted).tocsr()
    own_blocks = _point_blocks(point, rows.place, weights.image / weights.factor.get("image", 1.0), total) + held.data
    # of what was given up no ray has any weight
    own_blocks[exact | ~np.any(own_blocks, axis=(1, 2))] = np.eye(3)
    point_inverse = _blocks(np.asarray(np.linalg.inv(own_blocks), np.float64))
    miss = rows.miss.ravel()
    right_point = np.asarray(design_point.T @ (row_weight * miss) + held @ departure.ravel())
    normal = (every.T @ weighted - cross.T @ (point_inverse @ cross)).tocsc()
    right = np.asarray(weighted.T @ miss - cross.T @ (point_inverse @ right_point))
    design_prior, prior_residual, prior_weight = prior
    reduced = normal[:count, :count].toarray() + design_prior.T @ (prior_weight[:, None] * design_prior)
    right_x = right[:count] + design_prior.T @ (prior_weight * prior_residual)
    scale = np.ones(shared.size)
    for group, columns in shared.groups.items():
        scale[columns] = 1.0 / weights.factor.get(group, 1.0)
    prior_shared = (sparse.diags(scale) @ shared.precision).tocsr()
    departed = shared.precision @ state.shared
    normal_shared = (normal[count:, count:] + prior_shared).tocsc()
    follow, shared_start = np.zeros((0, count)), np.zeros(0)
    if shared.size:
        mixed = normal[count:, :count].toarray()
        factor = splu(normal_shared, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        shared_start = -factor.solve(right[count:] + scale * departed)
        follow = -factor.solve(mixed) if count else np.zeros((shared.size, 0))
        reduced, right_x = reduced + mixed.T @ follow, right_x + mixed.T @ shared_start
    seen = weighted[:, :count].multiply(rows.design)
    return Equations(
        design=rows.design,
        design_shared=rows.design_shared,
        design_point=design_point,
        row_weight=row_weight,
        design_prior=design_prior,
        prior_weight=prior_weight,
        control_weight=held.tocsr(),
        residuals=Residuals(
            rows.miss,
            control_residual,
            prior_residual,
            {g: float(state.shared[c] @ departed[c]) for g, c in shared.groups.items()},
        ),
        reduced=0.5 * (reduced + reduced.T),
        right=right_x,
        length=np.sqrt(np.asarray(seen.sum(axis=0)).ravel()),
        shared=shared,
        shared_weight=prior_shared,
        shared_normal=normal_shared.tocsr(),
        follow=follow,
        shared_start=shared_start,
        point_inverse=point_inverse,
        cross=cross,
        right_point=right_point,
        movable=~exact,
        row_spans=rows.spans[0],
        point_spans=rows.spans[1],
    )


def _priors(
    parameters: Parameters, values: Array, priors: Sequence[Prior], weights: Weights
) -> tuple[Array, Array, Array]:
    """Whitened rows (K, P), residuals (K,) and weights (K,) of the pseudo-observations."""
    rows = np.zeros((len(priors), len(values)))
    for row, prior in zip(rows, priors, strict=True):
        if not (np.isfinite(prior.value) and np.isfinite(prior.sigma) and prior.sigma > 0):
            raise CalibrationError(f"calibration: a prior needs a finite value and a positive sigma, found {prior}")
        for name, weight in prior.weights.items():
            row[index(parameters.names, name)] = weight / prior.sigma
    value = np.array([p.value / p.sigma for p in priors])
    factor = np.array([weights.factor.get(p.group, 1.0) for p in priors])
    return rows, rows @ values - value, 1.0 / factor


def _root(inverse: Array, used: NDArray[np.bool_]) -> Array:
    """(m, 3, 3) lower Cholesky factors of weights, zero where not used."""
    root = np.zeros_like(inverse)
    root[used] = np.linalg.cholesky(inverse[used])
    return root


def _blocks(blocks: Array) -> sparse.bsr_matrix:
    """Block diagonal (3m, 3m)."""
    count = len(blocks)
    return sparse.bsr_matrix((blocks, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count))


def _inverse(matrix: Array) -> Array:
    """Inverse of a positive definite matrix."""
    if not len(matrix):
        return matrix
    root, failed = dpotrf(matrix, lower=1, clean=1)
    half, wrong = dpotri(root, lower=1)  # zero above the diagonal, as the root is
    if failed or wrong:
        raise CalibrationError("calibration: the shared noise cannot be solved for; are its sigmas of the right size?")
    half[np.diag_indices(len(half))] *= 0.5
    return np.asarray(half + half.T)


def _point_blocks(point: Array, place: NDArray[np.intp], weight: Array, count: int) -> Array:
    """(m, 3, 3) normal matrices of the points from the (M, 2, 3) blocks of their image points."""
    blocks = np.zeros((count, 3, 3))
    np.add.at(blocks, place, weight[:, None, None] * (np.swapaxes(point, 1, 2) @ point))
    return blocks


def _padded(rows: sparse.coo_matrix, size: int) -> tuple[Array, NDArray[np.intp]]:
    """Sparse rows (n size, K), taken by `size`: values (n, size, w) of the columns (n, w) that any of them meets."""
    count, width = rows.shape[0] // size, rows.shape[1]
    key = (rows.row // size).astype(np.int64) * width + rows.col
    used, slot = np.unique(key, return_inverse=True)
    group = used // width
    place = np.arange(len(used)) - np.searchsorted(group, group)
    most = int(place.max(initial=0)) + 1
    values, columns = np.zeros((count, size, most)), np.zeros((count, most), np.intp)
    values[rows.row // size, rows.row % size, place[slot]] = rows.data
    columns[group, place] = used % width
    return values, columns


def _products(left: sparse.csr_matrix, right: sparse.csr_matrix, size: int) -> Array:
    """Diagonal blocks (n, size, size) of left right', both (n size, K)."""
    found = np.empty((left.shape[0] // size, size, size))
    for i in range(size):
        for j in range(size):
            found[:, i, j] = np.asarray(left[i::size].multiply(right[j::size]).sum(axis=1)).ravel()
    return found
