"""Image-space correction of an image's sensor model from control points: a shift or an affine function.

Each point has a covariance in the image, from its measurement and from its ground coordinates. The estimate is the
generalised least-squares one; its covariance follows from those of the points alone, and chi-square of the residuals
tests these covariances. Points whose residuals exceed their covariances are excluded one after the other, the largest
first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis import statistics
from analysis.arrays import Array

Kind = Literal["shift", "affine"]

_FALSE_ALARM = 1e-3
"""Probability that any point is excluded from the control points of one file if none has a gross error."""
_LEAST_EXTENT = 1e-6
"""Smallest ratio of the minor to the major extent of points that do not lie on one line."""
LEAST_POINTS = {"shift": 1, "affine": 3}
"""Smallest number of points that determine each kind of correction."""


@dataclass(frozen=True, eq=False)
class ImageCorrection:
    """Correction of image coordinates, measured minus predicted, from N points.

    Attributes
    ----------
    kind : {'shift', 'affine'}
        Kind of the correction.
    middle, size : (2,) ndarray
        Centre and half extent of the points in line and sample, in pixels; the affine function counts from the centre
        in units of the half extent.
    coefficients : (2, K) ndarray
        Coefficients for line and sample, in pixels; K is 1 for a shift, and 3 (constant, line, sample) for an affine
        function.
    covariance : (2 K, 2 K) ndarray
        Covariance of the coefficients, those of the line first, in pixels^2.
    residual : (N, 2) ndarray
        Residuals of all points in line and sample, in pixels.
    variance : (N, 2, 2) ndarray
        Covariance of the residual of each used point, and of the prediction error at each excluded one, in pixels^2.
    used : (N,) ndarray of bool
        True for points that contributed to the estimate.
    chi_square : float
        Chi-square of the residuals of the used points under their covariances.
    freedom : int
        Degrees of freedom of the chi-square.
    """

    kind: Kind
    middle: Array
    size: Array
    coefficients: Array
    covariance: Array
    residual: Array
    variance: Array
    used: NDArray[np.bool_]
    chi_square: float
    freedom: int

    def at(self, line: ArrayLike, sample: ArrayLike) -> Array:
        """Return the correction of line and sample, in pixels, at N predicted image positions, as (N, 2)."""
        return np.asarray(self._basis(line, sample) @ self.coefficients.T)

    def covariance_at(self, line: ArrayLike, sample: ArrayLike) -> Array:
        """Return the covariance of the correction at N predicted positions, (N, 2, 2), in pixels^2."""
        rows = coefficient_rows(self._basis(line, sample))
        return np.asarray(rows @ self.covariance @ np.swapaxes(rows, 1, 2))

    @property
    def factor(self) -> float:
        """Variance factor, chi-square per degree of freedom; 1 without redundancy."""
        return self.chi_square / self.freedom if self.freedom else 1.0

    @property
    def probability(self) -> float:
        """p-value of the chi-square of the residuals; 1 without redundancy."""
        return statistics.p_value(self.chi_square, self.freedom)

    def _basis(self, line: ArrayLike, sample: ArrayLike) -> Array:
        return _basis(
            self.kind,
            self.middle,
            self.size,
            np.stack(np.broadcast_arrays(np.atleast_1d(line), np.atleast_1d(sample)), axis=-1),
        )


def _basis(kind: Kind, middle: Array, size: Array, position: Array) -> Array:
    """Return the K basis functions of a correction (constant, and scaled line and sample) at N positions, (N, K)."""
    constant = np.ones((len(position), 1))
    return constant if kind == "shift" else np.concatenate([constant, (position - middle) / size], axis=1)


def coefficient_rows(basis: Array) -> Array:
    """Return the derivatives of line and sample at N points with respect to the 2 K coefficients, (N, 2, 2 K)."""
    nothing = np.zeros_like(basis)
    return np.stack([np.concatenate([basis, nothing], 1), np.concatenate([nothing, basis], 1)], axis=1)


def image_correction(
    predicted: ArrayLike, measured: ArrayLike, covariance: ArrayLike, kind: Kind, screened: bool = True
) -> ImageCorrection:
    """Estimate the image-space correction of a sensor model from control points.

    Parameters
    ----------
    predicted : (N, 2) array_like
        Line and sample at which the model sees the N points, in pixels.
    measured : (N, 2) array_like
        Measured line and sample, in pixels.
    covariance : (N, 2, 2) array_like
        Covariance of measured minus predicted, in pixels^2.
    kind : {'shift', 'affine'}
        Shift, which needs one point, or affine function, which needs three.
    screened : bool
        True to exclude points whose residuals far exceed their covariances.

    Raises
    ------
    ValueError
        There are too few points, the points lie on one line, a value is not finite, or a covariance is not positive
        definite.
    """
    position, image = np.asarray(predicted, np.float64), np.asarray(measured, np.float64)
    spread = np.asarray(covariance, np.float64)
    count = len(position)
    if position.shape != (count, 2) or image.shape != position.shape or spread.shape != (count, 2, 2):
        raise ValueError("predicted and measured positions must be (N, 2), with covariances (N, 2, 2)")
    if count < LEAST_POINTS[kind]:
        raise ValueError(f"{count} points are too few: the correction {kind} needs {LEAST_POINTS[kind]} or more")
    if not (np.all(np.isfinite(position)) and np.all(np.isfinite(image)) and np.all(np.isfinite(spread))):
        raise ValueError("a position or a covariance is not finite")
    if np.any(np.linalg.eigvalsh(spread) <= 0.0):
        raise ValueError("a covariance is not positive definite")
    middle = np.mean(position, axis=0)
    size = np.maximum(np.max(np.abs(position - middle), axis=0), 1.0)
    rows = coefficient_rows(_basis(kind, middle, size, position))
    difference = image - position
    used = np.ones(count, dtype=bool)
    while True:
        _require_spread(kind, position[used], size)
        coefficients, cofactor = _solved(rows[used], difference[used], spread[used])
        residual = difference - rows @ coefficients
        share = rows @ cofactor @ np.swapaxes(rows, 1, 2)
        # the residual of a used point correlates with the estimate, that of an excluded point does not
        variance = np.where(used[:, None, None], spread - share, spread + share)
        if not screened or np.sum(used) <= LEAST_POINTS[kind] + 1:
            break
        squares = _squares(residual, variance)
        squares[~used] = 0.0
        farthest = int(np.argmax(squares))
        if squares[farthest] <= statistics.limit_of(_FALSE_ALARM / count, 2):
            break
        used[farthest] = False
    chi_square = float(np.sum(_squares(residual, spread)[used]))
    freedom = 2 * int(np.sum(used)) - rows.shape[2]
    return ImageCorrection(
        kind, middle, size, coefficients.reshape(2, -1), cofactor, residual, variance, used, chi_square, freedom
    )


def _require_spread(kind: Kind, position: Array, size: Array) -> None:
    """Raise ValueError if points on one line do not determine an affine function."""
    if kind == "affine":
        extent = np.linalg.svd((position - np.mean(position, axis=0)) / size, compute_uv=False)
        if extent[-1] < _LEAST_EXTENT * extent[0] or not extent[0] > 0.0:
            raise ValueError("the points lie on one straight line of the image and do not determine an affine function")


def _solved(rows: Array, difference: Array, spread: Array) -> tuple[Array, Array]:
    """Return the 2 K coefficients of a correction and their covariance, by generalised least squares.

    K is the number of coefficients of each of line and sample.
    """
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, rows).reshape(-1, rows.shape[2])
    right = np.linalg.solve(root, difference[..., None]).reshape(-1)
    inverse = statistics.gain(white)
    return np.asarray(inverse @ right), np.asarray(inverse @ inverse.T)


def _squares(residual: Array, variance: Array) -> Array:
    """Return the chi-square contribution of each of N points: its squared residual normalised by its covariance.

    The pseudo-inverse is used because a component that one point alone determines has no residual variance.
    """
    return np.asarray(
        np.einsum("ni,nij,nj->n", residual, np.linalg.pinv(variance, hermitian=True, rcond=1e-10), residual)
    )
