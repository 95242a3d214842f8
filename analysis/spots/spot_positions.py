"""Measured spot positions with their uncertainty, and the uncertainty of the difference of two of them.

An estimator is described to first order by its influence maps g: a change n of the image (DN) moves the position by
sum_p g[i, p] n[p] (Hampel et al., Robust Statistics, 1986, sec. 2.1). Temporal noise is independent in two images, but
PRNU and DSNU of the same pixels are the same draw in both, so the covariance of "after - before" is

    cov_after + cov_before - X - X^T,   X[i, j] = sum_p g_after[i, p] g_before[j, p] (prnu^2 s_after s_before + (K
    dsnu)^2)

with s the light signal. A spot that stays on its pixels loses the pattern from its difference; one that moves by more
than its own size keeps it twice. Over a series of images after one "before" the differences at two times are correlated
by the temporal noise of "before" and by the pattern of the pixels that the spot shares at these times.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array, MeasurementError
from analysis.spots.noise import NoiseModel


class SpotError(MeasurementError, ValueError):
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
    core_chi_square: (B,) the same of the spot's core alone; None where no calibrated shape was fitted.
    degrees: (B, 2) degrees of freedom of both, fewer than pixels where the noise is that of few electrons; likewise.
    median_square: (B,) median of the squared residuals over variance, over that of a normal distribution: the noise of
        the frames over the stated one, squared, whatever stands in a few pixels; likewise.
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
    core_chi_square: Array | None = None
    degrees: Array | None = None
    median_square: Array | None = None

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

    Parameters
    ----------
    before : SpotPositions
        Measured with maps.
    after : SpotPositions
        likewise.
    noise : NoiseModel
        Of the detector.
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


@dataclass(frozen=True, eq=False)
class NoiseParts:
    """What makes positions of B spots wrong, apart by what is new in every image and what is not.

    Attributes
    ----------
    temporal : Array
        (B, 2, 2) px^2.
    pattern : NDArray[np.float32]
        (B, 2, Q) px by one standard deviation of each pixel's response and dark signal: products of two images' are the
        covariance of their positions by the pattern. Single precision, for there are many.
    """

    temporal: Array
    pattern: NDArray[np.float32]


def noise_parts(positions: SpotPositions, noise: NoiseModel) -> NoiseParts:
    """Noise of measured positions. Raises ValueError when their maps were not kept.

    Parameters
    ----------
    positions : SpotPositions
        Measured with maps.
    noise : NoiseModel
        Of the detector.
    """
    if positions.gain_maps is None or positions.light_dn is None:
        raise ValueError("noise parts: positions need their gain maps; measure with keep_maps=True")
    count = positions.row.size
    gain = positions.gain_maps.reshape(count, 2, -1)
    size = gain.shape[-1]
    pattern = np.empty((count, 2, 2 * size), np.float32)
    response = noise.prnu * positions.light_dn.reshape(count, 1, -1)
    np.multiply(gain, response, out=pattern[..., :size], casting="same_kind")
    np.multiply(gain, np.sqrt(noise.dsnu_variance_dn2), out=pattern[..., size:], casting="same_kind")
    return NoiseParts(positions.temporal_covariance, pattern)


class SeriesNoise:
    """Covariance of the differences to one "before" over a series of images of C spots, which are added one after the
    other.

    Parameters
    ----------
    before
        C spots.
    reach
        How many images apart two differences may be for their covariance to be kept, which bounds memory.
    """

    def __init__(self, before: NoiseParts, reach: int) -> None:
        self._before, self._reach = before, reach
        self._maps: list[NDArray[np.float32]] = []
        self._rows: list[Array] = []

    @property
    def images(self) -> int:
        """Number of images that have been added."""
        return len(self._rows)

    def add(self, after: NoiseParts) -> None:
        """Append images. Raises ValueError for another number of spots.

        Parameters
        ----------
        after : NoiseParts
            Of S times C spots, image by image.
        """
        count = len(self._before.temporal)
        if len(after.temporal) % count:
            raise ValueError(f"series noise: {len(after.temporal)} positions of {count} spots")
        for start in range(0, len(after.temporal), count):
            own = after.pattern[start : start + count] - self._before.pattern
            self._maps = [*self._maps, own][-1 - self._reach :]
            row = np.stack([own @ earlier.transpose(0, 2, 1) for earlier in self._maps]).astype(np.float64)
            row += self._before.temporal
            row[-1] += after.temporal[start : start + count]
            self._rows.append(row)

    def covariance(self, images: NDArray[np.int_]) -> Array:
        """(n 2 C, n 2 C) px^2 of some images' differences, image by image, spot by spot, row before column.

        Parameters
        ----------
        images : NDArray[np.int_]
            (n,) their numbers, each once. Raises ValueError for images farther apart than the reach.
        """
        if np.ptp(images) > self._reach:
            raise ValueError(f"series noise: images {np.ptp(images)} apart, {self._reach} are kept")
        count, n = len(self._before.temporal), len(images)
        out = np.zeros((n, count, 2, n, count, 2))
        for i, late in enumerate(images):
            for j, early in enumerate(images[: i + 1]):
                a, b = max(late, early), min(late, early)
                block = self._rows[a][b - a - 1]
                block = block if late >= early else block.transpose(0, 2, 1)
                for spot in range(count):
                    out[i, spot, :, j, spot] = block[spot]
                    out[j, spot, :, i, spot] = block[spot].T
        return out.reshape(n * count * 2, -1)
