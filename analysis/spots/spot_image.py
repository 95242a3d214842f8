"""Functions shared by the spot estimators of `centroid`.

They are checks, a first guess, windows, models with their derivatives, and the propagation of noise.

Shapes: images (B, H, W) in DN; positions (B, 2) as (row, column) in px, the centre of the first pixel being (0, 0).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from analysis.arrays import Array, MeasurementError
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_template import SpotTemplate


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
    signal_before = (g_before * (noise.prnu**2 * before.light_dn.reshape(first, 1, -1))).transpose(0, 2, 1)
    dark_before = (noise.dsnu_variance_dn2 * g_before).transpose(0, 2, 1)
    g_after = after.gain_maps.reshape(count, 2, -1)
    light_after = after.light_dn.reshape(count, 1, -1)
    # One state at a time keeps the work in the processor's cache; the loop is over states, not over spots.
    for start in range(0, count, first):
        part = slice(start, start + first)
        cross = (g_after[part] * light_after[part]) @ signal_before + g_after[part] @ dark_before
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
    most_apart : int
        Greatest separation, in images, of two differences for which a covariance is kept, which bounds memory.
    """

    def __init__(self, before: NoiseParts, most_apart: int) -> None:
        self._before, self._most_apart = before, most_apart
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
            self._maps = [*self._maps, pattern][-1 - self._most_apart :]
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
        if np.ptp(images) > self._most_apart:
            raise ValueError(f"series noise: images {np.ptp(images)} apart, at most {self._most_apart} are kept")
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


_BIN = 4
SMALL = 24
"""Side of images, px, below which the first guess works on single pixels; a hot pixel then can be taken for a spot."""
LEAST_SIDE = 6
"""Smallest side of images, px."""
# A 4 x 4 bin must stand this many sigmas above the background to be called a spot: with some 600 bins in an image the
# chance that noise alone does so is below 1e-6.
_DETECTION_SIGMAS = 6.0
_SATURATION_SIGMAS = 4.0
# Spots measured together: few enough that their arrays stay in the processor's cache.
_PIECE = 16


def as_images(mean: ArrayLike) -> Array:
    """Return mean images as float64, (B, H, W), from (B, H, W) or (H, W).

    Dimensions: B spots, H rows, W columns.

    Raises
    ------
    ValueError
        An image is not finite, or smaller than 6 x 6 px.
    """
    image = np.asarray(mean, dtype=np.float64)
    if image.ndim == 2:
        image = image[None]
    if image.ndim != 3 or image.shape[0] < 1 or min(image.shape[1:]) < LEAST_SIDE:
        raise ValueError(f"spots: mean images must be (B, H, W) of at least 6 x 6 px, found shape {image.shape}")
    if not np.isfinite(image.sum()):
        raise ValueError("spots: mean images contain values that are not finite")
    return image


def in_pieces(measure: Callable[[slice], SpotPositions], count: int, threads: int = 1) -> SpotPositions:
    """Measure `count` spots a few at a time and join the results, which limits memory.

    ``measure`` returns the positions of a range of the spots. A SpotError names the bad spots of all ranges.
    """
    reasons: dict[int, str] = {}

    def tried(start: int, end: int) -> SpotPositions | None:
        try:
            return measure(slice(start, end))
        except SpotError as error:
            reasons.update({start + n: reason for n, reason in error.reasons.items()})
        return None

    # two functions, since one that called itself would keep all images until Python looks for what refers to itself
    def piece(start: int) -> SpotPositions | None:
        end = min(start + _PIECE, count)
        result = tried(start, end)
        if result is None and end > start + 1:
            # spots that are bad for another reason are not named yet
            for n in range(start, end):
                tried(n, n + 1)
        return result

    starts = range(0, count, _PIECE)
    if threads == 1:
        parts = [piece(start) for start in starts]
    else:
        with ThreadPoolExecutor(max_workers=threads) as pool:
            parts = list(pool.map(piece, starts))
    if reasons:
        raise SpotError(reasons)
    joined = {}
    for field in fields(SpotPositions):
        values = [getattr(part, field.name) for part in parts if part is not None]
        if field.name == "iterations":
            joined[field.name] = max(values)
        else:
            joined[field.name] = None if values[0] is None else np.concatenate(values)
    return SpotPositions(**joined)


def reject(bad: NDArray[np.bool_], reason: str) -> None:
    """Raise SpotError with one reason for all spots that are marked in `bad`, (B,).

    Dimensions: B spots.
    """
    if np.any(bad):
        raise SpotError({int(n): reason for n in np.flatnonzero(bad)})


def check_edge(position: Array, height: int, width: int, distance: float) -> None:
    """Raise SpotError for centres nearer than `distance` to the outermost pixel centres.

    Dimensions: B spots.

    Parameters
    ----------
    position : (B, 2) ndarray
        Row and column of the centres, px.
    height : int
        Number of rows H.
    width : int
        Number of columns W.
    distance : float
        Smallest distance, px.
    """
    high = np.array([height, width]) - 1 - distance
    bad = ~np.all((position >= distance) & (position <= high), axis=1)
    if np.any(bad):
        where = f"px is less than {distance:g} px from the edge of the {height} x {width} image"
        positions = {n: position[n] for n in np.flatnonzero(bad).tolist()}
        raise SpotError(
            {n: f"too near the edge: ({row:.2f}, {column:.2f}) {where}" for n, (row, column) in positions.items()}
        )


def coarse(image: Array, frames: int, noise: NoiseModel) -> tuple[Array, Array, Array, Array, Array]:
    """Return a first guess of each spot: row, column, background, peak and area above half peak, (B,) each.

    Row and column are in px, good to about 0.5; background and peak above it in DN; the area in px^2. The guess works
    on 4 x 4 bins, so that one hot pixel does not make a spot, and on single pixels in images of less than 24 px.

    Dimensions: B spots, H rows, W columns.

    Parameters
    ----------
    image : (B, H, W) ndarray
        Mean frames, DN (grey values).
    frames : int
        Number of frames averaged into each image.
    noise : NoiseModel
        Noise of the detector.

    Raises
    ------
    SpotError
        A spot is saturated or absent.
    """
    count, height, width = image.shape
    size = _BIN if min(height, width) >= SMALL else 1
    rows, columns = height // size, width // size
    brightest = image.reshape(count, -1).max(axis=1)
    # The mean of frames of which some are clipped lies below the clipping level, hence the allowance of a few sigmas.
    highest = brightest + _SATURATION_SIGMAS * np.sqrt(noise.temporal_variance_dn2(brightest, 1))
    if saturated := np.flatnonzero(highest >= noise.saturation_dn).tolist():
        limit = f"DN, is within {_SATURATION_SIGMAS:g} sigma of saturation at {noise.saturation_dn:.0f} DN"
        why = f"{limit}; lower the light or the exposure"
        raise SpotError({n: f"saturated: its brightest pixel, {brightest[n]:.0f} {why}" for n in saturated})
    bins = image[:, : rows * size, : columns * size].reshape(count, rows, size, columns * size).sum(axis=2)
    bins = bins.reshape(count, rows, columns, size).sum(axis=3) / size**2
    ring = np.ones((rows, columns), dtype=bool)
    ring[1:-1, 1:-1] = False
    background = np.median(bins[:, ring], axis=1)
    top = bins.reshape(count, -1).argmax(axis=1)
    peak = bins.reshape(count, -1).max(axis=1) - background
    variance = noise.temporal_variance_dn2(background, frames) + noise.fixed_variance_dn2(background)
    absent = peak < _DETECTION_SIGMAS * np.sqrt(variance) / size
    reject(absent, f"no spot: no pixel is {_DETECTION_SIGMAS:g} sigma above the background")
    i, j = np.arange(rows), np.arange(columns)
    bright = bins - background[:, None, None]
    bright *= bright > 0.5 * peak[:, None, None]
    # Only around the brightest bin, lest a second light pulls the guess away.
    bright *= (np.abs(i - (top // columns)[:, None]) <= 4)[:, :, None]
    bright *= (np.abs(j - (top % columns)[:, None]) <= 4)[:, None, :]
    total = bright.sum(axis=(1, 2))
    centre = (size - 1) / 2.0
    row = size * (bright.sum(axis=2) @ i) / total + centre
    column = size * (bright.sum(axis=1) @ j) / total + centre
    area = np.count_nonzero(bright, axis=(1, 2)) * float(size**2)
    return row, column, background, peak, area


def arms(position: Array, height: int, width: int) -> Array:
    """Return the distance of each pixel from the centre of the spot along rows and columns, (B, 2, H, W) px.

    Dimensions: B spots.

    Parameters
    ----------
    position : (B, 2) ndarray
        Row and column of the centres, px.
    height : int
        Number of rows H.
    width : int
        Number of columns W.
    """
    out = np.empty((position.shape[0], 2, height, width))
    out[:, 0] = (np.arange(height) - position[:, :1])[:, :, None]
    out[:, 1] = (np.arange(width) - position[:, 1:])[:, None, :]
    return out


def soft_window(position: Array, height: int, width: int, radius: float) -> tuple[Array, Array]:
    """Return a circular window about each centre and its derivatives with respect to the centre.

    The window, (B, H, W), falls from 1 to 0 over one pixel at `radius`; the derivatives have the shape (B, 2, H, W).

    Dimensions: B spots.

    Parameters
    ----------
    position : (B, 2) ndarray
        Row and column of the centres, px.
    height : int
        Number of rows H.
    width : int
        Number of columns W.
    radius : float
        Radius of the circle, px.
    """
    arm = arms(position, height, width)
    distance = np.hypot(arm[:, 0], arm[:, 1])
    mask = np.clip(radius + 0.5 - distance, 0.0, 1.0)
    edge = (mask > 0) & (mask < 1)
    return mask, arm * (edge / np.maximum(distance, 1e-9))[:, None]


def sane(theta: Array) -> NDArray[np.bool_]:
    """Return the mask (B,) of fitted Gaussians whose parameters are finite, positive and of finite size.

    Dimensions: B spots.
    """
    good = np.all(np.isfinite(theta), axis=1) & (theta[:, 2] > 0) & (theta[:, 4] > 0)
    if theta.shape[1] > 5:
        good &= theta[:, 4] * theta[:, 6] > theta[:, 5] ** 2
    return np.asarray(good)


def gaussian(
    theta: Array, height: int, width: int, radius: float, noise: NoiseModel, frames: int
) -> tuple[Array, Array, Array]:
    """Return derivatives (B, K, P), weighted derivatives and grey values (B, P) of Gaussian spots in a window.

    The derivatives are those of the P pixels with respect to the K parameters: row, column, amplitude, background, and
    the coefficient a, or the coefficients a, b and c, of the squared distance in the exponent. The weight is the soft
    circular window over the model's total variance.

    Dimensions: B spots.

    Parameters
    ----------
    theta : (B, 5) or (B, 7) ndarray
        Parameters, px and DN.
    height : int
        Number of rows H.
    width : int
        Number of columns W.
    radius : float
        Radius of the window, px.
    noise : NoiseModel
        Noise of the detector.
    frames : int
        Number of frames averaged into an image.
    """
    count, size = theta.shape
    arm = arms(theta[:, :2], height, width).reshape(count, 2, -1)
    amplitude, background, a = (theta[:, k, None] for k in (2, 3, 4))
    b, c = (theta[:, 5, None], theta[:, 6, None]) if size > 5 else (np.zeros_like(a), a)
    x, y = arm[:, 0], arm[:, 1]
    u, v = a * x + b * y, b * x + c * y
    bell = np.exp(-0.5 * np.maximum(u * x + v * y, 0.0))
    light = amplitude * bell
    rest = [-0.5 * x * x * light, -x * y * light, -0.5 * y * y * light]
    if size == 5:
        rest = [rest[0] + rest[2]]
    design = np.stack([light * u, light * v, bell, np.ones_like(bell), *rest], axis=1)
    model = background + light
    mask, _ = soft_window(theta[:, :2], height, width, radius)
    return design, design * (mask.reshape(count, -1) / variance(model, noise, frames))[:, None], model


def variance(level: Array, noise: NoiseModel, frames: int) -> Array:
    """Return the variance of a mean of frames at a grey value, temporal and of the fixed pattern, DN^2.

    Parameters
    ----------
    level : ndarray
        Grey values, of any shape, DN.
    noise : NoiseModel
        Noise of the detector.
    frames : int
        Number of frames averaged into an image.
    """
    out: Array = noise.temporal_variance_dn2(level, frames)
    out += noise.fixed_variance_dn2(level)
    return out


def excess(level: Array, weight: Array, noise: NoiseModel, frames: int) -> Array:
    """Return the excess kurtosis that shot noise gives a mean of frames; 0 for a normal distribution.

    Parameters
    ----------
    level : ndarray
        Grey values, of any shape, DN.
    weight : ndarray
        Reciprocal of the variance, of that shape, 1/DN^2.
    noise : NoiseModel
        Noise of the detector.
    frames : int
        Number of frames averaged into an image.
    """
    # the fourth cumulant of Poisson numbers is their mean, of a mean of n of them 1/n^3 of it
    fourth = noise.gain_dn_per_e**3 * noise.light_signal_dn(level) / float(frames) ** 3
    return np.asarray(fourth * weight * weight)


def template_model(
    theta: Array,
    index: NDArray[np.intp],
    template: SpotTemplate,
    part: tuple[NDArray[np.intp], tuple[int, int]] | None = None,
    out: Array | None = None,
) -> tuple[Array, Array]:
    """Return the derivatives (B, 4, P) and the grey values (B, P) of spots that have calibrated shapes.

    The derivatives are those of every pixel with respect to row, column, flux and background.

    Dimensions: B spots, P pixels.

    Parameters
    ----------
    theta : (B, 4) ndarray
        Row, column (px), flux and background (DN, grey values).
    index : (B,) ndarray of int
        Index of each spot's shape.
    template : SpotTemplate
        Shapes of the spots.
    part : tuple or None
        First pixels (B, 2), one for each spot, and number of rows h and columns w of the part of the detector to
        compute; None for all of it.
    out : ndarray or None
        Array (B, 4, P) that receives the derivatives; None to make a new one.
    """
    count, (height, width) = theta.shape[0], template.shape if part is None else part[1]
    design = np.empty((count, 4, height * width)) if out is None else out
    template.fill_design(design.reshape(count, 4, height, width), theta, index, part)
    level = design[:, 2] * theta[:, 2, None]
    level += theta[:, 3, None]
    return design, level


def propagate(maps: Array, level: Array, noise: NoiseModel, frames: int) -> tuple[Array, Array]:
    """Return the covariance of positions due to temporal noise, and that due to fixed pattern, (B, 2, 2) px^2.

    Dimensions: B spots, P pixels.

    Parameters
    ----------
    maps : (B, 2, P) ndarray
        Derivatives of row and column with respect to each pixel, px/DN.
    level : (B, P) ndarray
        Grey values, DN.
    noise : NoiseModel
        Noise of the detector.
    frames : int
        Number of frames averaged into an image.
    """
    transposed = maps.transpose(0, 2, 1)
    temporal = (maps * noise.temporal_variance_dn2(level, frames)[:, None]) @ transposed
    fixed = (maps * noise.fixed_variance_dn2(level)[:, None]) @ transposed
    return temporal, fixed


def positions(
    position: Array, maps: Array, image: Array, frames: int, noise: NoiseModel, keep_maps: bool, **fit: Any
) -> SpotPositions:
    """Return the SpotPositions of a centroid method that has no model of the spot's light.

    The noise is that at the measured image itself: the variance is nearly linear in the grey value, so pixel noise
    averages out, while smoothing would fill the dark rings, where a Gaussian fit has much weight.

    Dimensions: B spots, H rows, W columns.

    Parameters
    ----------
    position : (B, 2) ndarray
        Row and column, px.
    maps : (B, 2, H, W) ndarray
        Derivatives of the position with respect to each pixel, px/DN.
    image : (B, H, W) ndarray
        Mean frames, DN (grey values).
    frames : int
        Number of frames averaged into each image.
    noise : NoiseModel
        Noise of the detector.
    keep_maps : bool
        True to keep `maps` in the result.
    **fit
        Other attributes of `SpotPositions`: flux, background, convergence, iterations and reduced chi-square.
    """
    count = position.shape[0]
    temporal, fixed = propagate(maps.reshape(count, 2, -1), image.reshape(count, -1), noise, frames)
    row, column = position.T.copy()
    light = noise.light_signal_dn(image) if keep_maps else None
    return SpotPositions(row, column, temporal, fixed, gain_maps=maps if keep_maps else None, light_dn=light, **fit)


def filled(mean: Array, good: NDArray[np.bool_]) -> Array:
    """Return an image (H, W) with unusable pixels filled from their surroundings.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    mean : (H, W) ndarray
        Grey values, DN.
    good : (H, W) ndarray of bool
        Usable pixels.
    """
    if np.all(good):
        return mean
    out = np.where(good, mean, 0.0)
    weight = good.astype(np.float64)
    value, width = out.copy(), 1.0
    left = ~good
    # wider and wider, until every hole is bridged
    while np.any(left) and width < max(mean.shape):
        near = ndimage.gaussian_filter(weight, width, mode="nearest")
        bridged = left & (near > 1e-3)
        value[bridged] = ndimage.gaussian_filter(out, width, mode="nearest")[bridged] / near[bridged]
        left &= ~bridged
        width *= 2.0
    return np.asarray(np.where(left, np.median(mean[good]) if np.any(good) else 0.0, value))
