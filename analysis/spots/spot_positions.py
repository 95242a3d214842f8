"""Measured spot positions with their uncertainty, and the uncertainty of the difference of two of them.

An estimator is described to first order by its influence maps g, the derivatives of row and column with respect to each
pixel: a change n of the image (DN) moves the position by sum_p g[i, p] n[p], i being row or column and p the pixel
(Hampel et al., Robust Statistics, 1986, sec. 2.1). Temporal noise is independent in two images, but PRNU and DSNU of
the same pixels are the same in both, so the covariance of "after - before" is

    cov_after + cov_before - X - X^T,   X[i, j] = sum_p g_after[i, p] g_before[j, p] (prnu^2 s_after s_before + (K
    dsnu)^2)

with s the light signal. A spot that stays on its pixels loses the pattern from its difference; one that moves by more
than its own size keeps it twice. Over a series of images after one "before" the differences at two times are correlated
due to the temporal noise of "before" and to the pattern of the pixels that the spot shares at these times.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array, MeasurementError
from analysis.spots.noise import NoiseModel


class SpotError(MeasurementError, ValueError):
    """Error raised for spots that cannot be measured.

    Attributes
    ----------
    reasons : dict of int to str
        Reason for each bad spot, by its index in the batch.
    """

    def __init__(self, reasons: dict[int, str]) -> None:
        self.reasons = dict(reasons)
        self.indices = sorted(reasons)
        shown = "; ".join(f"spot {n}: {reasons[n]}" for n in self.indices[:4])
        more = f"; and {len(reasons) - 4} more" if len(reasons) > 4 else ""
        super().__init__(shown + more)


@dataclass(frozen=True, eq=False)
class SpotPositions:
    """Positions of B spots with their covariance, and the goodness of the fits.

    Dimensions: H rows, W columns.

    Attributes
    ----------
    row, column : (B,) ndarray
        Position, px.
    temporal_covariance, fixed_covariance : (B, 2, 2) ndarray
        Covariances in order (row, column), px^2: due to noise that is new in each frame, and due to the detector's
        fixed pattern.
    flux : (B,) ndarray
        Signal summed over the spot, DN.
    background : (B,) ndarray
        Level under the spot, black level included, DN.
    converged : (B,) ndarray of bool
        True where the iteration ended below its tolerance.
    iterations : int
        Number of steps of the slowest spot.
    reduced_chi_square : (B,) ndarray
        Sum of squared residuals over variance and degrees of freedom, near 1 when the spot has the assumed shape; NaN
        for an estimator without a shape.
    gain_maps : (B, 2, H, W) ndarray or None
        Influence of each pixel on (row, column), px per DN; None when not kept.
    light_dn : (B, H, W) ndarray or None
        Expected light signal that scales PRNU, DN; None when not kept.
    core_chi_square : (B,) ndarray or None
        Reduced chi-square of the spot's core alone; None where no calibrated shape was fitted.
    degrees : (B, 2) ndarray or None
        Degrees of freedom of both chi-squares, fewer than pixels where the noise is that of few electrons.
    median_square : (B,) ndarray or None
        Median of the squared residuals over variance, relative to that of a normal distribution: the squared ratio of
        the frames' noise to the specified one, insensitive to a few outlying pixels.
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
        """Covariance of one position, temporal noise and fixed pattern together, (B, 2, 2) px^2.

        Dimensions: B spots.
        """
        return self.temporal_covariance + self.fixed_covariance

    @property
    def position(self) -> Array:
        """Position (row, column), (B, 2) px.

        Dimensions: B spots.
        """
        return np.stack([self.row, self.column], axis=-1)

    @property
    def sigma_row(self) -> Array:
        """Standard deviation of the row, (B,) px.

        Dimensions: B spots.
        """
        return np.sqrt(self.covariance[:, 0, 0])

    @property
    def sigma_column(self) -> Array:
        """Standard deviation of the column, (B,) px.

        Dimensions: B spots.
        """
        return np.sqrt(self.covariance[:, 1, 1])


def difference_covariance(before: SpotPositions, after: SpotPositions, noise: NoiseModel) -> Array:
    """Return the covariance of after - before for spots on the same pixels of the same detector, (B, 2, 2) px^2.

    `before` may hold fewer spots, B0 with B = S * B0: it is then used once for each of S states (spot b against b
    modulo B0). Each result is for one difference; differences that share a `before` are correlated with one another.

    Dimensions: B spots.

    Parameters
    ----------
    before : SpotPositions
        Positions before, with their derivatives with respect to every pixel (`gain_maps`).
    after : SpotPositions
        Positions after, with their derivatives with respect to every pixel.
    noise : NoiseModel
        Noise of the detector.

    Raises
    ------
    ValueError
        The maps were not kept, or the batches do not fit.
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
    """Noise of the positions of B spots, separated into the part that is new in every image and the fixed pattern.

    Dimensions: Q pixel properties (response and dark signal of every pixel).

    Attributes
    ----------
    temporal : (B, 2, 2) ndarray
        Covariance due to temporal noise, px^2.
    pattern : (B, 2, Q) ndarray of float32
        Shift by one standard deviation of each pixel's response and dark signal, px. The products of two images' maps
        are the covariance of their positions due to the pattern. Single precision saves memory.
    """

    temporal: Array
    pattern: NDArray[np.float32]


def noise_parts(positions: SpotPositions, noise: NoiseModel) -> NoiseParts:
    """Return the noise of measured positions, separated into that of one image and the fixed pattern.

    Parameters
    ----------
    positions : SpotPositions
        Positions with their derivatives with respect to every pixel (`gain_maps`).
    noise : NoiseModel
        Noise of the detector.

    Raises
    ------
    ValueError
        The maps were not kept.
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
    """Covariance of the differences to one "before" over a series of images of C spots, added one after the other.

    Parameters
    ----------
    before : NoiseParts
        Noise of the C spots before.
    reach : int
        Greatest separation, in images, of two differences for which a covariance is kept, which bounds memory.
    """

    def __init__(self, before: NoiseParts, reach: int) -> None:
        self._before, self._reach = before, reach
        self._maps: list[NDArray[np.float32]] = []
        self._rows: list[Array] = []

    @property
    def images(self) -> int:
        """Number of images that have been added to the series."""
        return len(self._rows)

    def add(self, after: NoiseParts) -> None:
        """Append the noise of further images to the series.

        Parameters
        ----------
        after : NoiseParts
            Noise of S times C spots, image by image.

        Raises
        ------
        ValueError
            The number of spots differs.
        """
        count = len(self._before.temporal)
        if len(after.temporal) % count:
            raise ValueError(f"series noise: {len(after.temporal)} positions of {count} spots")
        for start in range(0, len(after.temporal), count):
            pattern = after.pattern[start : start + count] - self._before.pattern
            self._maps = [*self._maps, pattern][-1 - self._reach :]
            row = np.stack([pattern @ earlier.transpose(0, 2, 1) for earlier in self._maps]).astype(np.float64)
            row += self._before.temporal
            row[-1] += after.temporal[start : start + count]
            self._rows.append(row)

    def covariance(self, images: NDArray[np.int_]) -> Array:
        """Return the covariance of the shifts (after minus before) in some of the images, (n 2 C, n 2 C) px^2.

        The order is image by image, spot by spot, row before column.

        Dimensions: n images, C spots.

        Parameters
        ----------
        images : (n,) ndarray of int
            Indices of the images, each once.

        Raises
        ------
        ValueError
            Images are farther apart than the kept separation.
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
