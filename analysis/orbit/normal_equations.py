"""Normal equations of a three-line calibration, the ground points eliminated.

Rows are whitened by the covariance of their image point: image measurement plus what noise of attitude and station does
in the image. A ground point meets only its own rays and its control coordinates, so that its (3, 3) block is inverted
alone and the reduced equations of the unknowns are N_xx - N_xp N_pp^-1 N_px (Schur complement).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from analysis.orbit.calibration_parameters import CalibrationError, CalibrationField, Noise, Parameters, Prior, index
from analysis.orbit.three_line_model import LineModel, misclosure, partials

__all__ = ["Equations", "Residuals", "Weights", "assemble"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Weights:
    """image: (M,) robust weights of the image points, 0 to 1. factor: group -> variance factor (1: as given)."""

    image: Array
    factor: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Of the observations, whitened by the a-priori covariances: image (M, 2), control (m, 3), prior (K,)."""

    image: Array
    control: Array
    prior: Array


@dataclass(frozen=True, eq=False)
class Equations:
    """Linearised system at one state.

    Attributes:
        design: (2M, P) sparse, by the unknowns, and `design_point` (2M, 3m) by the points: whitened, not weighted.
        row_weight: (2M,) weight of each row.
        design_prior: (K, P) whitened. prior_weight: (K,).
        control_weight: (3m, 3m) sparse, weights of the control coordinates with the factor; 0 for tie points.
        residuals: at this state.
        reduced: (P, P) normal matrix with the points eliminated. right: (P,) its negative right side.
        length: (P,) root of the diagonal, of the image points alone and before the ground points were eliminated.
        point_inverse: (3m, 3m) sparse block inverse. cross: (3m, P) N_px. right_point: (3m,).
        movable: (m,) points that are unknown.
    """

    design: sparse.csr_matrix
    design_point: sparse.csr_matrix
    row_weight: Array
    design_prior: Array
    prior_weight: Array
    control_weight: sparse.csr_matrix
    residuals: Residuals
    reduced: Array
    right: Array
    length: Array
    point_inverse: sparse.bsr_matrix
    cross: sparse.csr_matrix
    right_point: Array
    movable: NDArray[np.bool_]

    def point_step(self, step: Array) -> Array:
        """(m, 3) change of the ground points that goes with a change (P,) of the unknowns."""
        return np.asarray(-self.point_inverse @ (self.right_point + self.cross @ step)).reshape(-1, 3)

    def through_points(self) -> Array:
        """(2M, P) change of the rows with the unknowns when the ground points follow."""
        return (self.design - self.design_point @ (self.point_inverse @ self.cross)).toarray()

    def image_cofactors(self, covariance: Array) -> Array:
        """(M, 2, 2) covariance of the adjusted, whitened image points, from that (P, P) of the unknowns."""
        followed = self.through_points().reshape(-1, 2, covariance.shape[0])
        from_points = np.zeros((len(followed), 2, 2))
        half = (self.design_point @ self.point_inverse).tocsr()
        for i in range(2):
            for j in range(2):
                rows = half[i::2].multiply(self.design_point[j::2]).sum(axis=1)
                from_points[:, i, j] = np.asarray(rows).ravel()
        return np.asarray(followed @ covariance @ np.swapaxes(followed, 1, 2) + from_points)

    def point_covariance(self, covariance: Array) -> Array:
        """(m, 3, 3) of the adjusted ground points, zero for those that are held."""
        count = len(self.movable)
        own = self.point_inverse.toarray().reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count), :]
        carried = np.asarray((self.point_inverse @ self.cross).toarray()).reshape(count, 3, -1)
        total = own + carried @ covariance @ np.swapaxes(carried, 1, 2)
        return np.where(self.movable[:, None, None], total, 0.0)


def assemble(
    fields: Sequence[CalibrationField],
    cameras: Mapping[str, LineModel],
    parameters: Parameters,
    values: Array,
    grounds: Sequence[Array],
    noise: Noise,
    priors: Sequence[Prior],
    weights: Weights,
) -> Equations:
    """Linearise at values (P,) and ground points (each (m, 3)).

    Image rows run by field, line and ray, x before y; points by field.
    """
    count = len(values)
    rows, points, misses, places = [], [], [], []
    first = 0
    for one, ground in zip(fields, grounds, strict=True):
        axes = one.axes
        for line, rays in one.rays.items():
            camera, bias, offset = parameters.parts(values, one.name, line, cameras[line])
            shown, moved = ground[rays.point], axes @ offset
            by = partials(camera, rays, shown, bias, moved)
            spread = noise.image**2 * np.eye(2) + noise.attitude**2 * by.attitude @ np.swapaxes(by.attitude, 1, 2)
            spread = spread + noise.station**2 * by.ground @ np.swapaxes(by.ground, 1, 2)
            white = np.linalg.inv(np.linalg.cholesky(spread))
            block = np.zeros((len(rays.point), 2, count))
            inner, turn, shift = parameters.columns[one.name, line]
            for where, part in ((inner, by.interior), (turn, by.bias), (shift, -by.ground @ axes)):
                if where[0] >= 0:
                    block[:, :, where] = part
            rows.append(sparse.csr_matrix((white @ block).reshape(-1, count)))
            points.append(white @ by.ground)
            misses.append(np.einsum("nij,nj->ni", white, misclosure(camera, rays, shown, bias, moved)))
            places.append(first + rays.point)
        first += len(ground)
    return _reduce(fields, grounds, parameters, values, priors, weights, (rows, points, misses, places))


def _reduce(
    fields: Sequence[CalibrationField],
    grounds: Sequence[Array],
    parameters: Parameters,
    values: Array,
    priors: Sequence[Prior],
    weights: Weights,
    parts: tuple[list[sparse.csr_matrix], list[Array], list[Array], list[NDArray[np.intp]]],
) -> Equations:
    rows, points, misses, places = parts
    design = sparse.vstack(rows).tocsr()
    miss, place, point = np.concatenate(misses), np.concatenate(places), np.concatenate(points)
    exact = np.concatenate([f.control & ~np.any(f.covariance, axis=(1, 2)) for f in fields])
    control = np.concatenate([f.control for f in fields]) & ~exact
    total = len(exact)
    point = np.where(exact[place][:, None, None], 0.0, point)
    # one (2, 3) block for each image point
    blocks = sparse.bsr_matrix((point, place, np.arange(len(place) + 1)), shape=(2 * len(place), 3 * total))
    design_point = blocks.tocsr()
    row_weight = np.repeat(weights.image, 2) / weights.factor.get("image", 1.0)
    spread = np.concatenate([f.covariance for f in fields])
    inverse = np.zeros((total, 3, 3))
    inverse[control] = np.linalg.inv(spread[control])
    departure = np.concatenate([g - f.ground for g, f in zip(grounds, fields, strict=True)])
    control_residual = np.einsum("nji,nj->ni", _root(inverse, control), departure)
    held = _blocks(inverse * (1.0 / weights.factor.get("control", 1.0)))
    design_prior, prior_residual, prior_weight = _priors(parameters, values, priors, weights)
    weighted = sparse.diags(row_weight) @ design
    cross = (design_point.T @ weighted).tocsr()
    own = sparse.bsr_matrix(design_point.T @ (sparse.diags(row_weight) @ design_point) + held, blocksize=(3, 3))
    own_blocks = _diagonal_blocks(own, total)
    own_blocks[exact] = np.eye(3)
    try:
        point_inverse = _blocks(np.asarray(np.linalg.inv(own_blocks), np.float64))
    except np.linalg.LinAlgError:
        raise CalibrationError("calibration: too few good rays are left at a tie point") from None
    right_point = design_point.T @ (row_weight * miss.ravel()) + held @ departure.ravel()
    seen = (design.T @ weighted).toarray()
    full = seen + design_prior.T @ (prior_weight[:, None] * design_prior)
    right = weighted.T @ miss.ravel() + design_prior.T @ (prior_weight * prior_residual)
    reduced = full - (cross.T @ (point_inverse @ cross)).toarray()
    return Equations(
        design=design,
        design_point=design_point,
        row_weight=row_weight,
        design_prior=design_prior,
        prior_weight=prior_weight,
        control_weight=held.tocsr(),
        residuals=Residuals(miss, control_residual, prior_residual),
        reduced=0.5 * (reduced + reduced.T),
        right=np.asarray(right - cross.T @ (point_inverse @ right_point)),
        length=np.sqrt(np.diag(seen)),
        point_inverse=point_inverse,
        cross=cross,
        right_point=np.asarray(right_point),
        movable=~exact,
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


def _diagonal_blocks(matrix: sparse.bsr_matrix, count: int) -> Array:
    blocks = np.zeros((count, 3, 3))
    row = np.repeat(np.arange(count), np.diff(matrix.indptr))
    blocks[row[row == matrix.indices]] = matrix.data[row == matrix.indices]
    return blocks
