"""How far an image's model is off in the image, from control points: a shift, or an affine function of the place.

Each point has a covariance in the image, of its measurement and of its coordinates on the ground. The estimate is the
one of least variance; its covariance follows from those of the points alone, and chi-square of what is left says
whether they can be true. Points that lie beyond their covariances are left out one after the other, the farthest first.
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
"""Chance that any point of a file without gross errors is left out."""
_SAME_PLACE = 1e-6
"""Smallest over largest extent of points that do not lie on one line."""
LEAST_POINTS = {"shift": 1, "affine": 3}


@dataclass(frozen=True, eq=False)
class ImageCorrection:
    """A correction, measured minus predicted.

    Attributes
    ----------
    kind : Kind
        Shift or affine.
    middle, size : Array
        Of the places, line and sample, (2,) each; the function counts from the one in units of the other.
    coefficients : Array
        (2, K) of line and sample; K is 1 for a shift, and 3 for 1, line and sample of an affine function.
    covariance : Array
        (2 K, 2 K) of them, those of the line first.
    residual : Array
        (N, 2) line and sample that is left, of all points, pixels.
    variance : Array
        (N, 2, 2) of what is left at points that were used, and of what lies there of those that were not.
    used : NDArray[np.bool_]
        (N,) whether the points made the estimate.
    chi_square : float
        Of what is left at points that were used, by their covariances.
    freedom : int
        Of it.
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
        """Correction (N, 2) of line and sample at predicted places (N,), pixels."""
        return np.asarray(self._basis(line, sample) @ self.coefficients.T)

    def covariance_at(self, line: ArrayLike, sample: ArrayLike) -> Array:
        """Its covariance there, (N, 2, 2), pixels^2."""
        rows = _rows(self._basis(line, sample))
        return np.asarray(rows @ self.covariance @ np.swapaxes(rows, 1, 2))

    @property
    def factor(self) -> float:
        """By how much the variances of the points would have to grow for what is left; 1 where nothing tells."""
        return self.chi_square / self.freedom if self.freedom else 1.0

    @property
    def probability(self) -> float:
        """Chance of as large a chi-square if the covariances are true; 1 where nothing tells."""
        return statistics.p_value(self.chi_square, self.freedom)

    def _basis(self, line: ArrayLike, sample: ArrayLike) -> Array:
        return _basis(
            self.kind,
            self.middle,
            self.size,
            np.stack(np.broadcast_arrays(np.atleast_1d(line), np.atleast_1d(sample)), axis=-1),
        )


def _basis(kind: Kind, middle: Array, size: Array, place: Array) -> Array:
    """(N, K) functions of places (N, 2)."""
    one = np.ones((len(place), 1))
    return one if kind == "shift" else np.concatenate([one, (place - middle) / size], axis=1)


def _rows(basis: Array) -> Array:
    """(N, 2, 2 K) derivatives of line and sample by the coefficients."""
    nothing = np.zeros_like(basis)
    return np.stack([np.concatenate([basis, nothing], 1), np.concatenate([nothing, basis], 1)], axis=1)


def image_correction(
    predicted: ArrayLike, measured: ArrayLike, covariance: ArrayLike, kind: Kind, screened: bool = True
) -> ImageCorrection:
    """The correction that points tell.

    Parameters
    ----------
    predicted : ArrayLike
        (N, 2) line and sample where the model sees them, pixels.
    measured : ArrayLike
        (N, 2) where they are.
    covariance : ArrayLike
        (N, 2, 2) of the difference, pixels^2.
    kind : Kind
        Shift, from one point on, or affine, from three.
    screened : bool
        Whether points far beyond their covariances are left out.

    Raises
    ------
    ValueError
        Too few points, points on one line, values that are not finite, a covariance that is none.
    """
    place, seen = np.asarray(predicted, np.float64), np.asarray(measured, np.float64)
    spread = np.asarray(covariance, np.float64)
    count = len(place)
    if place.shape != (count, 2) or seen.shape != place.shape or spread.shape != (count, 2, 2):
        raise ValueError("predicted and measured places must be (N, 2), with covariances (N, 2, 2)")
    if count < LEAST_POINTS[kind]:
        raise ValueError(f"{count} points do not determine this: {kind} takes {LEAST_POINTS[kind]} or more")
    if not (np.all(np.isfinite(place)) and np.all(np.isfinite(seen)) and np.all(np.isfinite(spread))):
        raise ValueError("a place or a covariance is not finite")
    if np.any(np.linalg.eigvalsh(spread) <= 0.0):
        raise ValueError("a covariance is not above zero")
    middle = np.mean(place, axis=0)
    size = np.maximum(np.max(np.abs(place - middle), axis=0), 1.0)
    rows = _rows(_basis(kind, middle, size, place))
    off = seen - place
    used = np.ones(count, dtype=bool)
    while True:
        _require_spread(kind, place[used], size)
        found, known = _solved(rows[used], off[used], spread[used])
        left = off - rows @ found
        share = rows @ known @ np.swapaxes(rows, 1, 2)
        # what was used pulls the estimate to itself; what was not is met by an estimate that errs independently
        variance = np.where(used[:, None, None], spread - share, spread + share)
        if not screened or np.sum(used) <= LEAST_POINTS[kind] + 1:
            break
        size_left = _squares(left, variance)
        size_left[~used] = 0.0
        far = int(np.argmax(size_left))
        if size_left[far] <= statistics.limit_of(_FALSE_ALARM / count, 2):
            break
        used[far] = False
    square = float(np.sum(_squares(left, spread)[used]))
    freedom = 2 * int(np.sum(used)) - rows.shape[2]
    return ImageCorrection(kind, middle, size, found.reshape(2, -1), known, left, variance, used, square, freedom)


def _require_spread(kind: Kind, place: Array, size: Array) -> None:
    if kind == "affine":
        extent = np.linalg.svd((place - np.mean(place, axis=0)) / size, compute_uv=False)
        if extent[-1] < _SAME_PLACE * extent[0] or not extent[0] > 0.0:
            raise ValueError("the points lie on one line of the image, which does not determine an affine function")


def _solved(rows: Array, off: Array, spread: Array) -> tuple[Array, Array]:
    """Coefficients (2 K,) and their covariance, through whitened rows."""
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, rows).reshape(-1, rows.shape[2])
    right = np.linalg.solve(root, off[..., None]).reshape(-1)
    inverse = statistics.gain(white)
    return np.asarray(inverse @ right), np.asarray(inverse @ inverse.T)


def _squares(left: Array, variance: Array) -> Array:
    """(N,) squares of residuals by their covariances; pseudo-inverse, as what one point alone determines has none."""
    return np.asarray(np.einsum("ni,nij,nj->n", left, np.linalg.pinv(variance, hermitian=True, rcond=1e-10), left))
