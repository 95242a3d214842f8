"""Covariance of fitted places when the residuals of neighbouring pixels are correlated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["LAG", "ResidualCorrelation", "residual_correlation"]

Array = NDArray[np.float64]
# Farthest neighbour whose residual counts as correlated, px along rows and columns.
LAG = 3
# Half of the lags; the others follow by symmetry.
_LAGS = [(r, c) for r in range(LAG + 1) for c in range(-LAG, LAG + 1) if r > 0 or c > 0]
# Least variance against that for white residuals: sums of noisy correlations must not make a place better than so.
_LEAST = 0.5


@dataclass(frozen=True, eq=False)
class ResidualCorrelation:
    """Of n fits; lags are half of those within `LAG`.

    Attributes:
        variance: (n,) of the residuals, DN^2, by redundancy.
        white: (n, 2, 2) covariance of the place for residuals that are white with unit variance.
        influence: (n, lags, 2, 2) by how much correlation 1 at a lag and at its opposite raises it.
        correlation: (n, lags) of the residuals, freed of what the fit takes out of white noise.
        pixels, unknowns: (n,) of the fits.
    """

    variance: Array
    white: Array
    influence: Array
    correlation: Array
    pixels: NDArray[np.intp]
    unknowns: NDArray[np.intp]

    @property
    def plain(self) -> Array:
        """(n, 2, 2) px^2, for white residuals."""
        return np.asarray(self.variance[:, None, None] * self.white)

    def covariance(self, good: NDArray[np.bool_]) -> Array:
        """(n, 2, 2) px^2, with the median correlation of points good (n,)."""
        chosen = self.correlation[good & np.isfinite(self.variance)]
        if not len(chosen):
            return self.plain
        matrix = self.white + np.einsum("l,nlij->nij", np.median(chosen, axis=0), self.influence)
        # in units of the white one, so that no direction falls below its share
        (a, b), (_, c) = np.moveaxis(self.white, 0, -1)
        # NaN compares false
        finite = np.isfinite(matrix).all(axis=(1, 2)) & (a * c > b * b)
        matrix[~finite] = np.nan
        root = np.linalg.cholesky(self.white[finite])
        back = np.linalg.inv(root)
        value, vector = np.linalg.eigh(back @ matrix[finite] @ np.swapaxes(back, 1, 2))
        turned = root @ vector
        matrix[finite] = (turned * np.maximum(value, _LEAST)[:, None, :]) @ np.swapaxes(turned, 1, 2)
        return np.asarray(self.variance[:, None, None] * matrix)


def residual_correlation(design: Array, residual: Array, side: int) -> ResidualCorrelation:
    """From designs (n, q, p), the first two columns by place, and residuals (n, p) of square windows; NaN: no fit."""
    count, unknowns, pixels = design.shape
    variance = np.full(count, np.nan)
    white = np.full((count, 2, 2), np.nan)
    influence = np.full((count, len(_LAGS), 2, 2), np.nan)
    correlation = np.full((count, len(_LAGS)), np.nan)
    size = np.full(count, pixels), np.full(count, unknowns)
    scale = np.sqrt(np.einsum("nqp,nqp->nq", design, design))
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all(scale > 0, axis=1))
    if not used.size:
        return ResidualCorrelation(variance, white, influence, correlation, *size)
    scaled = design[used] / scale[used, :, None]
    # a pseudo-inverse, because some unknowns may be open where there is little texture
    inverse = np.linalg.pinv(scaled @ np.swapaxes(scaled, 1, 2), rcond=1e-11, hermitian=True)
    hat = (inverse @ scaled).reshape(len(used), unknowns, side, side)
    place = hat[:, :2] / scale[used, :2, None, None]
    column = scaled.reshape(hat.shape)
    rest = residual[used].reshape(-1, side, side)
    square = np.maximum(np.einsum("nij,nij->n", rest, rest), 1e-300)
    variance[used] = square / (pixels - unknowns)
    white[used] = np.einsum("niab,njab->nij", place, place)
    for k, (r, c) in enumerate(_LAGS):
        here = (..., slice(0, side - r), slice(max(-c, 0), side - max(c, 0)))
        there = (..., slice(r, side), slice(max(c, 0), side - max(-c, 0)))
        pairs = (side - r) * (side - abs(c))
        product = np.einsum("niab,njab->nij", place[here], place[there])
        influence[used, k] = product + np.swapaxes(product, 1, 2)
        # white noise loses this much covariance to the fit
        taken = np.einsum("nqab,nqab->n", hat[here], column[there])
        seen = np.einsum("nab,nab->n", rest[here], rest[there])
        correlation[used, k] = (seen / variance[used] + taken) / pairs
    return ResidualCorrelation(variance, white, influence, correlation, *size)
