"""Measured spot positions with their uncertainty, and the uncertainty of the difference of two of them.

An estimator is described to first order by its influence maps g: a change n of the image (DN) moves the position by
sum_p g[i, p] n[p] (Hampel et al., Robust Statistics, 1986, sec. 2.1). Temporal noise is independent in two images, but
PRNU and DSNU of the same pixels are the same draw in both, so the covariance of "after - before" is

    cov_after + cov_before - X - X^T,   X[i, j] = sum_p g_after[i, p] g_before[j, p] (prnu^2 s_after s_before + (K
    dsnu)^2)

with s the light signal. A spot that stays on its pixels loses the pattern from its difference; one that moves by more
than its own size keeps it twice. Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.spots.noise import NoiseModel

__all__ = ["SpotError", "SpotPositions", "difference_covariance"]

Array = NDArray[np.float64]


class SpotError(ValueError):
    """Spots that cannot be measured. `reasons` maps the index of each bad spot in the batch to a sentence."""

    def __init__(self, reasons: dict[int, str]) -> None:
        self.reasons = dict(reasons)
        self.indices = sorted(reasons)
        shown = "; ".join(f"spot {n}: {reasons[n]}" for n in self.indices[:4])
        more = f"; and {len(reasons) - 4} more" if len(reasons) > 4 else ""
        super().__init__(shown + more)


@dataclass(frozen=True, eq=False)
class SpotPositions:
    """Positions of B spots.

    row, column: (B,) px. flux: (B,) DN summed over the spot. background: (B,) DN, level under the spot, black level
        included.
    temporal_covariance, fixed_covariance: (B, 2, 2) px^2 in order (row, column): from noise that is new in each frame,
        and from the detector's fixed pattern.
    converged: (B,) whether the iteration ended below its tolerance. iterations: the number of steps of the slowest
        spot.
    reduced_chi_square: (B,) sum of squared residuals over variance and degrees of freedom, near 1 when the spot has
        the shape that was assumed; NaN for an estimator without a shape.
    gain_maps: (B, 2, H, W) px per DN, influence of each pixel on (row, column), or None when not kept.
    light_dn: (B, H, W) expected light signal, DN, that scales PRNU, or None when not kept.
    """

    row: Array
    column: Array
    temporal_covariance: Array
    fixed_covariance: Array
    flux: Array
    background: Array
    converged: NDArray[np.bool_]
    iterations: int
    reduced_chi_square: Array
    gain_maps: Array | None = None
    light_dn: Array | None = None

    @property
    def covariance(self) -> Array:
        """(B, 2, 2) px^2, temporal and fixed pattern together: the uncertainty of one position by itself."""
        return self.temporal_covariance + self.fixed_covariance

    @property
    def position(self) -> Array:
        """(B, 2) px, (row, column)."""
        return np.stack([self.row, self.column], axis=-1)

    @property
    def sigma_row(self) -> Array:
        """(B,) px, standard deviation of row."""
        return np.sqrt(self.covariance[:, 0, 0])

    @property
    def sigma_column(self) -> Array:
        """(B,) px, standard deviation of column."""
        return np.sqrt(self.covariance[:, 1, 1])


def difference_covariance(before: SpotPositions, after: SpotPositions, noise: NoiseModel) -> Array:
    """Covariance (B, 2, 2) px^2 of after - before for spots on the same pixels of the same detector.

    `before` may hold fewer spots, B0 with B = S * B0: it is then taken once for each of S states (spot b against b
    modulo B0). Each result is for one difference; differences that share a `before` are correlated with one another.
    Raises ValueError when the maps were not kept, or the batches do not fit.

    Args:
        before: measured with maps.
        after: likewise.
        noise: of the detector.
    """
    if before.gain_maps is None or after.gain_maps is None or before.light_dn is None or after.light_dn is None:
        raise ValueError("difference covariance: both positions need their gain maps; measure with keep_maps=True")
    count, first = after.row.size, before.row.size
    if count % first or before.gain_maps.shape[1:] != after.gain_maps.shape[1:]:
        raise ValueError(
            f"difference covariance: before {before.gain_maps.shape} does not fit after {after.gain_maps.shape}"
        )
    total = after.covariance + np.tile(before.covariance, (count // first, 1, 1))
    g_before = before.gain_maps.reshape(first, 2, -1)
    # one side carries both terms, so that the other one is worked on once per spot
    lit_before = (g_before * (noise.prnu**2 * before.light_dn.reshape(first, 1, -1))).transpose(0, 2, 1)
    dark_before = (noise.dsnu_variance_dn2 * g_before).transpose(0, 2, 1)
    g_after = after.gain_maps.reshape(count, 2, -1)
    light_after = after.light_dn.reshape(count, 1, -1)
    # One state at a time keeps the work in the processor's cache; the loop is over states, not over spots.
    for start in range(0, count, first):
        part = slice(start, start + first)
        cross = (g_after[part] * light_after[part]) @ lit_before + g_after[part] @ dark_before
        total[part] -= cross + cross.transpose(0, 2, 1)
    return total
