"""Normal equations of a three-line calibration, with ground points and shared noise eliminated.

Equations are whitened by the covariance of their image point: image measurement plus the effect of independent noise of
attitude and station in the image. Noise that image points share enters as unknowns z with a prior (`SharedNoise`). A
ground point occurs only in its own rays and control coordinates, so that its (3, 3) block is inverted alone and the
equations of the rest are N_yy - N_yp N_pp^-1 N_py (Schur complement). The block of z is then sparse, too; it is
factorised and eliminated in the same way, which leaves the equations of the unknowns x.

**Shared noise.** Points exposed within a few readings of attitude or station share their errors. The unknowns of the
readings' error models (`analysis.block.error_processes`) are unknowns of the adjustment with a sparse prior, and the
correlation of any two image points is exact.
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
    """Error models of the readings of all fields, and the dependence of the rays on their unknowns.

    Attributes
    ----------
    parts : mapping of str to tuple of Part
        Error models of the attitude and station readings of each field. Station corrections are along the axes of the
        ITRS.
    corrections : mapping of (str, str) to Corrections
        Corrections of the rays of each (field, line), as functions of the unknowns; lines without times have none.
    spans : tuple of (int, int)
        Index of the first unknown of each field, and one beyond its last.
    groups : mapping of str to ndarray of int
        Indices of the unknowns of each variance group.
    precision : (K, K) csr_matrix
        A-priori precision (inverse covariance) of all K unknowns.
    """

    parts: Mapping[str, tuple[Part, ...]]
    corrections: Mapping[tuple[str, str], Corrections]
    spans: tuple[tuple[int, int], ...]
    groups: Mapping[str, NDArray[np.intp]]
    precision: sparse.csr_matrix

    @classmethod
    def of(cls, fields: Sequence[CalibrationField], noise: Noise) -> SharedNoise:
        """Return the shared noise of all rays with times; it is empty without times or without intervals."""
        parts: dict[str, tuple[Part, ...]] = {}
        corrections: dict[tuple[str, str], Corrections] = {}
        spans, blocks, column = [], [], 0
        groups: dict[str, list[NDArray[np.intp]]] = {}
        for site in fields:
            times = {line: r.time for line, r in site.rays.items() if r.time is not None and r.point.size}
            begin, field_parts = column, []
            for term in noise.terms if times else ():
                if term.interval is None:
                    continue
                support = Support.of(_law(term, term.interval), np.concatenate(list(times.values())))
                field_parts.append(Part(term.kind == "attitude", column, support))
                blocks.append(sparse.kron(support.precision, sparse.eye(3)))
                groups.setdefault(term.group, []).append(np.arange(column, column + support.size))
                column += support.size
            parts[site.name] = tuple(field_parts)
            for line, time in times.items():
                corrections[site.name, line] = Corrections(tuple(field_parts), np.eye(3), time)
            spans.append((begin, column))
        precision = sparse.csr_matrix(sparse.block_diag(blocks)) if blocks else sparse.csr_matrix((0, 0))
        return cls(parts, corrections, tuple(spans), {k: np.concatenate(v) for k, v in groups.items()}, precision)

    @property
    def size(self) -> int:
        """Number K of unknowns of the shared noise."""
        return self.precision.shape[0]

    def corrected(self, name: str, line: str, rays: Rays, shared: Array) -> Rays:
        """Return a line's rays in a field with attitude and station corrected by the shared noise.

        Parameters
        ----------
        name : str
            Name of the field.
        line : str
            Name of the line camera.
        rays : Rays
            Rays of that line.
        shared : (K,) ndarray
            Values of the K unknowns of the shared noise.
        """
        return _moved(rays, self.corrections.get((name, line)), shared)

    def corrected_at(self, name: str, rays: Rays, shared: Array) -> Rays:
        """Return any rays of a field with attitude and station corrected by the shared noise.

        Parameters
        ----------
        name : str
            Name of the field.
        rays : Rays
            Rays with times.
        shared : (K,) ndarray
            Values of the K unknowns of the shared noise.
        """
        assert rays.time is not None
        return _moved(rays, Corrections(self.parts[name], np.eye(3), rays.time), shared)

    def rows(self, name: str, line: str, white: Array, by: Partials) -> sparse.csr_matrix:
        """Return the whitened Jacobian of a line's n rays with respect to the K shared-noise unknowns, (2n, K).

        Parameters
        ----------
        name : str
            Name of the field.
        line : str
            Name of the line camera.
        white : (n, 2, 2) ndarray
            Matrices that whiten the misclosures of n rays.
        by : Partials
            Derivatives of the misclosures.
        """
        count, corrections = len(white), self.corrections.get((name, line))
        if corrections is None:
            return sparse.csr_matrix((2 * count, self.size))
        slopes, columns = corrections.slopes(white @ by.attitude, -white @ by.ground), corrections.columns
        indices = np.repeat(columns[:, None], 2, axis=1).ravel()
        starts = columns.shape[1] * np.arange(2 * count + 1)
        return sparse.csr_matrix((slopes.ravel(), indices, starts), shape=(2 * count, self.size))


def _law(term: NoiseTerm, interval: float) -> Law:
    """Return the stochastic process that describes a noise term of attitude or station readings."""
    return Law(term.group, "walk" if term.walks else "white", (term.sigma,) * 3, interval)


def _moved(rays: Rays, corrections: Corrections | None, shared: Array) -> Rays:
    """Return rays with attitude and station corrected by the shared noise; unchanged without corrections."""
    if corrections is None or not corrections.parts:
        return rays
    rotation, shift = corrections.at(shared)
    rotations = Rotation.from_rotvec(rotation).as_matrix()
    return replace(rays, attitude=rays.attitude @ rotations, station=rays.station + shift @ corrections.axes.T)


_CHUNK = 512
"""Number of points or image points whose covariances are computed at once."""


@dataclass(frozen=True, eq=False)
class Weights:
    """Robust weights of the image points, and variance factors of the groups of observations.

    Attributes
    ----------
    image : (M,) ndarray
        Robust weights of the M image points, 0 to 1.
    factor : mapping of str to float
        Variance factor of each group; 1 for the a-priori sigmas.
    """

    image: Array
    factor: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class State:
    """State of the iteration: values of unknowns, ground points and shared noise.

    Attributes
    ----------
    values : (P,) ndarray
        Values of the P unknowns, in metres and radians.
    grounds : tuple of (m, 3) ndarray
        Coordinates of the m points of each field, ITRS, in metres.
    shared : (S,) ndarray
        Values of the S unknowns of the shared noise.
    """

    values: Array
    grounds: tuple[Array, ...]
    shared: Array

    def moved(self, equations: Equations, step: Array) -> State:
        """Return the state after a step of the P unknowns and the steps of points and noise that follow from it."""
        cuts = np.cumsum([len(g) for g in self.grounds])[:-1]
        points = np.split(equations.point_step(step), cuts)
        grounds = tuple(g + d for g, d in zip(self.grounds, points, strict=True))
        return State(self.values + step, grounds, self.shared + equations.shared_step(step))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of the observations, whitened by the a-priori covariances.

    Attributes
    ----------
    image : (M, 2) ndarray
        Residuals of the M image points in x and y.
    control : (m, 3) ndarray
        Residuals of the coordinates of the m points; zero for tie points.
    prior : (K,) ndarray
        Residuals of the K priors.
    shared : mapping of str to float
        Sum of squares of the corrections of attitude and station readings, by variance group.
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
    design : (2M, P) csr_matrix
        Whitened, unweighted derivatives with respect to x.
    design_shared : (2M, S) csr_matrix
        Whitened, unweighted derivatives with respect to z.
    design_point : (2M, 3m) csr_matrix
        Whitened, unweighted derivatives with respect to p.
    row_weight : (2M,) ndarray
        Robust weight, with variance factor, of each row of the design matrices.
    design_prior : (K, P) ndarray
        Whitened derivatives of the K priors with respect to x.
    prior_weight : (K,) ndarray
        Weights of the priors.
    control_weight : (3m, 3m) csr_matrix
        Weights of the control coordinates with the variance factor; 0 for tie points.
    residuals : Residuals
        Residuals at this state.
    reduced : (P, P) ndarray
        Normal matrix with z and p eliminated.
    right : (P,) ndarray
        Negative right side of the reduced equations.
    length : (P,) ndarray
        Square root of the diagonal of the normal matrix from the image points alone, before elimination.
    shared : SharedNoise
        Shared noise that z describes.
    shared_weight : (S, S) csr_matrix
        Precision of the prior of z with the variance factors.
    shared_normal : (S, S) csr_matrix
        Normal matrix of z with p eliminated.
    follow : (S, P) ndarray
        Derivatives of z with respect to x.
    shared_start : (S,) ndarray
        Step of z for unchanged x.
    point_inverse : (3m, 3m) bsr_matrix
        Inverse of the points' normal blocks.
    cross : (3m, P + S) csr_matrix
        Block of the normal matrix that couples the points p with the unknowns x and z.
    right_point : (3m,) ndarray
        Right side of the points' normal equations.
    movable : (m,) ndarray of bool
        True for points that are unknown.
    row_spans, point_spans : tuple of (int, int)
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
        """Return the step of the S shared-noise unknowns that follows from a step of the P unknowns."""
        return np.asarray(self.shared_start + self.follow @ step)

    def point_step(self, step: Array) -> Array:
        """Return the step of the m ground points, (m, 3), in metres, that follows from a step of the P unknowns."""
        change = np.concatenate([step, self.shared_step(step)])
        return np.asarray(-self.point_inverse @ (self.right_point + self.cross @ change)).reshape(-1, 3)

    def through_points(self) -> Array:
        """Return the Jacobian (2M, P) of the M image points with shared noise and ground points eliminated.

        It holds the total derivatives with respect to the P unknowns, while noise and points follow them.
        """
        by_x, by_z = self._carried
        fixed = (self.design - self.design_point @ by_x).toarray()
        return np.asarray(fixed + (self.design_shared - self.design_point @ by_z) @ self.follow)

    @cached_property
    def shared_inverse(self) -> tuple[Array, ...]:
        """Covariance (s, s), for each field, of its s unknowns of shared noise, given all other unknowns.

        These unknowns model errors of attitude and station readings, which are common to many observations of the
        field.
        """
        return tuple(_inverse(self.shared_normal[a:b, a:b].toarray()) for a, b in self.shared.spans)

    def image_cofactors(self, covariance: Array) -> Array:
        """Return the covariance of the M adjusted, whitened image points, from that of the P unknowns."""
        derivatives = self.through_points().reshape(len(self.row_weight) // 2, 2, covariance.shape[0])
        cofactors = derivatives @ covariance @ np.swapaxes(derivatives, 1, 2)
        cofactors += _products((self.design_point @ self.point_inverse).tocsr(), self.design_point, 2)
        if self.shared.size:
            rows = (self.design_shared - self.design_point @ self._carried[1]).tocsr()
            cofactors += self._of_shared(rows, self.row_spans, 2)
        return np.asarray(cofactors)

    def point_covariance(self, covariance: Array) -> Array:
        """Return the covariances of the m adjusted ground points, (m, 3, 3), in m^2; zero for fixed points."""
        by_x, by_z = self._carried
        derivatives = np.asarray(by_x.toarray() + by_z @ self.follow).reshape(len(self.movable), 3, len(covariance))
        total = self.point_inverse.data + derivatives @ covariance @ np.swapaxes(derivatives, 1, 2)
        if self.shared.size:
            total = total + self._of_shared(by_z, self.point_spans, 3)
        return np.where(self.movable[:, None, None], total, 0.0)

    def tests(
        self, covariance: Array, cofactors: Array, weights: Weights, priors: Sequence[Prior]
    ) -> dict[str, GroupTest]:
        """Return the chi-square tests of the residuals of each variance group after an adjustment, by its name.

        Parameters
        ----------
        covariance : (P, P) ndarray
            Covariance of the P unknowns, SI units.
        cofactors : (M, 2, 2) ndarray
            Covariances of the M adjusted image points, whitened.
        weights : Weights
            Weights of the observations.
        priors : sequence of Prior
            Pseudo-observations of the unknowns.
        """
        residuals, factor = self.residuals, weights.factor
        squares = weights.image * np.sum(residuals.image**2, axis=1) / factor["image"]
        adjusted = weights.image * np.trace(cofactors, axis1=1, axis2=2) / factor["image"]
        rows: dict[str, tuple[float, float, float]] = {}
        rows["image"] = (2.0 * np.sum(weights.image > 0), np.sum(adjusted), np.sum(squares))
        # control_weight is block diagonal: the sum of products is the trace with the points' covariance blocks
        control_blocks = self.control_weight.tobsr((3, 3))
        point_blocks = self.point_covariance(covariance)[control_blocks.indices]
        control = np.sum(residuals.control**2) / factor["control"]
        taken = np.sum(control_blocks.data * point_blocks)
        rows["control"] = (np.sum(self.control_weight.diagonal() > 0), taken, control)
        determined = self.prior_weight * np.einsum("kp,pq,kq->k", self.design_prior, covariance, self.design_prior)
        square = self.prior_weight * residuals.prior**2
        for group in dict.fromkeys(p.group for p in priors):
            member = np.array([p.group == group for p in priors])
            rows[group] = (np.sum(member), np.sum(determined[member]), np.sum(square[member]))
        for group, unchecked in self._taken(covariance).items():
            rows[group] = (len(self.shared.groups[group]), unchecked, residuals.shared[group] / factor[group])
        return {g: GroupTest(int(n), float(n - t), float(v), float(factor[g])) for g, (n, t, v) in rows.items()}

    def _taken(self, covariance: Array) -> dict[str, float]:
        """Return the number of readings of each shared-noise group that the image points do not check."""
        unchecked = np.zeros(self.shared.size)
        for (a, b), inverse in zip(self.shared.spans, self.shared_inverse, strict=True):
            posterior = inverse + self.follow[a:b] @ covariance @ self.follow[a:b].T
            unchecked[a:b] = np.asarray(self.shared_weight[a:b, a:b].multiply(posterior).sum(axis=1)).ravel()
        return {g: float(np.sum(unchecked[c])) for g, c in self.shared.groups.items()}

    @cached_property
    def _carried(self) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        """Negative derivatives of the m ground points' coordinates with respect to all unknowns.

        They are (3m, P) for the P unknowns and (3m, S) for the S unknowns of the shared noise, while the points follow
        them.
        """
        both, count = (self.point_inverse @ self.cross).tocsc(), self.design.shape[1]
        return both[:, :count].tocsr(), both[:, count:].tocsr()

    def _of_shared(self, rows: sparse.csr_matrix, spans: Sequence[tuple[int, int]], size: int) -> Array:
        """Return the n diagonal blocks of A C A', with the covariance C of the S shared-noise unknowns.

        The result is (n, size, size).

        A is the matrix `rows`, (n size, S). C is for known other unknowns.
        """
        blocks = np.zeros((rows.shape[0] // size, size, size))
        for (first, last), (a, b), inverse in zip(spans, self.shared.spans, self.shared_inverse, strict=True):
            if b == a:
                continue
            values, columns = _padded(rows[first:last, a:b].tocoo(), size)
            for begin in range(0, len(values), _CHUNK):
                chunk, columns_of_chunk = values[begin : begin + _CHUNK], columns[begin : begin + _CHUNK]
                spread = inverse[columns_of_chunk[:, :, None], columns_of_chunk[:, None, :]]
                blocks[first // size + begin :][: len(chunk)] = chunk @ spread @ np.swapaxes(chunk, 1, 2)
        return blocks


def assemble(
    fields: Sequence[CalibrationField],
    cameras: Mapping[str, LineModel],
    parameters: Parameters,
    state: State,
    noise: Noise,
    priors: Sequence[Prior],
    weights: Weights,
    shared: SharedNoise,
    omitted: OmittedTermsModel | None = None,
) -> Equations:
    """Return the equations linearised at a state.

    Image rows are ordered by field, line and ray, x before y; points and shared unknowns by field. Omitted terms
    `omitted`, zero at this state, are unknowns after those of the parameters.
    """
    parameter_count = len(state.values)
    count = parameter_count + (0 if omitted is None else omitted.size)
    rows, points, misses, point_indices, shared_rows = [], [], [], [], []
    spans: list[list[tuple[int, int]]] = [[], []]
    first = row = 0
    for site, ground in zip(fields, state.grounds, strict=True):
        axes, begin = site.axes, row
        for line, measured in site.rays.items():
            rays = shared.corrected(site.name, line, measured, state.shared)
            rays = parameters.rotated(state.values, site.name, line, rays)
            camera, bias, offset = parameters.parts(state.values, site.name, line, cameras[line])
            points_of_rays, shift = ground[rays.point], axes @ offset
            by = partials(camera, rays, points_of_rays, bias, shift)
            white = np.linalg.inv(np.linalg.cholesky(ray_covariance(noise, rays, by, shared=False)))
            block = np.zeros((len(rays.point), 2, count))
            since = parameters.since_middle(site.name, rays)[:, None, None]
            parts = (by.interior, by.bias, -by.ground @ axes, by.drift, by.attitude * since)
            for indices, part in zip(parameters.columns[site.name, line], parts, strict=True):
                if indices[0] >= 0:
                    block[:, :, indices] = part
            if omitted is not None:
                block[:, :, parameter_count:] = omitted.columns(site, line, rays, by)
            rows.append(sparse.csr_matrix((white @ block).reshape(2 * len(block), count)))
            shared_rows.append(shared.rows(site.name, line, white, by))
            points.append(white @ by.ground)
            misses.append(np.einsum("nij,nj->ni", white, misclosure(camera, rays, points_of_rays, bias, shift)))
            point_indices.append(first + rays.point)
            row += 2 * len(rays.point)
        spans[0].append((begin, row))
        spans[1].append((3 * first, 3 * (first + len(ground))))
        first += len(ground)
    image_rows = _Rows(
        sparse.vstack(rows).tocsr(),
        sparse.vstack(shared_rows).tocsr(),
        np.concatenate(points),
        np.concatenate(misses),
        np.concatenate(point_indices),
        (tuple(spans[0]), tuple(spans[1])),
    )
    design, residual, weight = _priors(parameters, state.values, priors, weights)
    design = np.pad(design, ((0, 0), (0, count - parameter_count)))
    return _reduce(fields, state, image_rows, (design, residual, weight), weights, shared)


class OmittedTermsModel(Protocol):
    """Interface of error terms (drift rates, slow variations, steps) that an adjustment does not estimate but tests."""

    @property
    def size(self) -> int:
        """Number of terms that are omitted from the model and tested."""

    def columns(self, field: CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """Return the derivatives of n image points' misclosures (x, y) with respect to the terms, (n, 2, size).

        Parameters
        ----------
        field : CalibrationField
            Pass over a test field.
        line : str
            Name of the line camera.
        rays : Rays
            Image points of the line, n of them.
        by : Partials
            Derivatives of the misclosures of these image points with respect to the model's parameters.
        """


@dataclass(frozen=True, eq=False)
class _Rows:
    """Whitened, linearised equations of all M image points, before weighting.

    Attributes
    ----------
    design : (2M, P) csr_matrix
        Derivatives with respect to the P unknowns.
    design_shared : (2M, S) csr_matrix
        Derivatives with respect to the S unknowns of the shared noise.
    point : (M, 2, 3) ndarray
        Derivatives with respect to the ground point.
    miss : (M, 2) ndarray
        Misclosures.
    point_row : (M,) ndarray of int
        Index of the ground point.
    spans : tuple
        Row and coordinate ranges of each field.
    """

    design: sparse.csr_matrix
    design_shared: sparse.csr_matrix
    point: Array
    miss: Array
    point_row: NDArray[np.intp]
    spans: tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]


def _reduce(
    fields: Sequence[CalibrationField],
    state: State,
    rows: _Rows,
    prior: tuple[Array, Array, Array],
    weights: Weights,
    shared: SharedNoise,
) -> Equations:
    """Return the normal equations of the unknowns, with ground points and shared noise eliminated."""
    exact = np.concatenate([f.control & ~np.any(f.covariance, axis=(1, 2)) for f in fields])
    control = np.concatenate([f.control for f in fields]) & ~exact
    total, count = len(exact), rows.design.shape[1]
    point = np.where(exact[rows.point_row][:, None, None], 0.0, rows.point)
    # one (2, 3) block for each image point
    pattern = (point, rows.point_row, np.arange(len(rows.point_row) + 1))
    design_point = sparse.bsr_matrix(pattern, shape=(2 * len(rows.point_row), 3 * total)).tocsr()
    image_weight = weights.image / weights.factor.get("image", 1.0)
    row_weight = np.repeat(image_weight, 2)
    inverse = np.zeros((total, 3, 3))
    inverse[control] = np.linalg.inv(np.concatenate([f.covariance for f in fields])[control])
    departure = np.concatenate([g - f.ground for g, f in zip(state.grounds, fields, strict=True)])
    control_residual = np.einsum("nji,nj->ni", _root(inverse, control), departure)
    control_precision = _blocks(inverse * (1.0 / weights.factor.get("control", 1.0)))
    full_design = sparse.hstack([rows.design, rows.design_shared]).tocsr()
    weighted = (sparse.diags(row_weight) @ full_design).tocsr()
    cross = (design_point.T @ weighted).tocsr()
    normal_blocks = _point_blocks(point, rows.point_row, image_weight, total) + control_precision.data
    # rejected points have no ray with weight
    normal_blocks[exact | ~np.any(normal_blocks, axis=(1, 2))] = np.eye(3)
    point_inverse = _blocks(np.asarray(np.linalg.inv(normal_blocks), np.float64))
    miss = rows.miss.ravel()
    right_point = np.asarray(design_point.T @ (row_weight * miss) + control_precision @ departure.ravel())
    normal = (full_design.T @ weighted - cross.T @ (point_inverse @ cross)).tocsc()
    right = np.asarray(weighted.T @ miss - cross.T @ (point_inverse @ right_point))
    design_prior, prior_residual, prior_weight = prior
    reduced = normal[:count, :count].toarray() + design_prior.T @ (prior_weight[:, None] * design_prior)
    right_x = right[:count] + design_prior.T @ (prior_weight * prior_residual)
    scale = np.ones(shared.size)
    for group, columns in shared.groups.items():
        scale[columns] = 1.0 / weights.factor.get(group, 1.0)
    prior_shared = (sparse.diags(scale) @ shared.precision).tocsr()
    weighted_shared = shared.precision @ state.shared
    normal_shared = (normal[count:, count:] + prior_shared).tocsc()
    follow, shared_start = np.zeros((0, count)), np.zeros(0)
    if shared.size:
        mixed = normal[count:, :count].toarray()
        factor = splu(normal_shared, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        shared_start = -factor.solve(right[count:] + scale * weighted_shared)
        follow = -factor.solve(mixed) if count else np.zeros((shared.size, 0))
        reduced, right_x = reduced + mixed.T @ follow, right_x + mixed.T @ shared_start
    squares = weighted[:, :count].multiply(rows.design)
    shared_squares = {g: float(state.shared[c] @ weighted_shared[c]) for g, c in shared.groups.items()}
    return Equations(
        design=rows.design,
        design_shared=rows.design_shared,
        design_point=design_point,
        row_weight=row_weight,
        design_prior=design_prior,
        prior_weight=prior_weight,
        control_weight=control_precision.tocsr(),
        residuals=Residuals(rows.miss, control_residual, prior_residual, shared_squares),
        reduced=0.5 * (reduced + reduced.T),
        right=right_x,
        length=np.sqrt(np.asarray(squares.sum(axis=0)).ravel()),
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
    """Return the whitened Jacobian (K, P), residuals (K,) and weights (K,) of the K priors of P unknowns."""
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
    """Return the lower Cholesky factors of the weight matrices of m points, (m, 3, 3), zero for unused points."""
    root = np.zeros_like(inverse)
    root[used] = np.linalg.cholesky(inverse[used])
    return root


def _blocks(blocks: Array) -> sparse.bsr_matrix:
    """Return a block diagonal matrix (3m, 3m) from m blocks (m, 3, 3)."""
    count = len(blocks)
    return sparse.bsr_matrix((blocks, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count))


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a positive definite matrix."""
    if not len(matrix):
        return matrix
    root, failed = dpotrf(matrix, lower=1, clean=1)
    half, wrong = dpotri(root, lower=1)  # zero above the diagonal, as the root is
    if failed or wrong:
        raise CalibrationError("calibration: the shared noise cannot be estimated; are its sigmas of the right size?")
    half[np.diag_indices(len(half))] *= 0.5
    return np.asarray(half + half.T)


def _point_blocks(point: Array, point_row: NDArray[np.intp], weight: Array, count: int) -> Array:
    """Return the normal matrices of m ground points, (m, 3, 3), from the derivatives (M, 2, 3) of M image points."""
    blocks = np.zeros((count, 3, 3))
    np.add.at(blocks, point_row, weight[:, None, None] * (np.swapaxes(point, 1, 2) @ point))
    return blocks


def _padded(rows: sparse.coo_matrix, size: int) -> tuple[Array, NDArray[np.intp]]:
    """Return a sparse matrix of n groups of `size` rows in dense form: values (n, size, w) and columns (n, w).

    w is the largest number of columns in which a group has entries.
    """
    count, width = rows.shape[0] // size, rows.shape[1]
    key = (rows.row // size).astype(np.int64) * width + rows.col
    used, slot = np.unique(key, return_inverse=True)
    group = used // width
    slot_of_column = np.arange(len(used)) - np.searchsorted(group, group)
    width_needed = int(slot_of_column.max(initial=0)) + 1
    values, columns = np.zeros((count, size, width_needed)), np.zeros((count, width_needed), np.intp)
    values[rows.row // size, rows.row % size, slot_of_column[slot]] = rows.data
    columns[group, slot_of_column] = used % width
    return values, columns


def _products(left: sparse.csr_matrix, right: sparse.csr_matrix, size: int) -> Array:
    """Return the n diagonal blocks of the product left right', (n, size, size), of two sparse matrices (n size, K)."""
    blocks = np.empty((left.shape[0] // size, size, size))
    for i in range(size):
        for j in range(size):
            blocks[:, i, j] = np.asarray(left[i::size].multiply(right[j::size]).sum(axis=1)).ravel()
    return blocks
