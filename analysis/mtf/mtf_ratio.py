"""Ratio of the MTFs of two images of one unknown scene, such as two exposures in different positions of focus.

The spectrum of an image is that of the scene times the transfer function, so that the scene cancels in the ratio of two
images. Spectra are those of patches with Hann windows that overlap by half (Welch, IEEE Trans. Audio Electroacoust. 15,
70, 1967). The ratio is that of the modulus of the cross-spectrum to the power of the image that is sharper in the
direction, without its noise, which is small. It does not depend on the scene's position; the coherence shows whether
the scene is the same.

A window mixes neighbouring frequencies in the proportion of the scene's power there. To the first order the ratio is
therefore that at the mean frequency of the power in a bin, which the product of the spectrum with that of the window's
derivative gives exactly; the second order, for a power that is even within a bin, is removed as well. The logarithms of
all bins of a ring about the frequency are fitted by a smooth function of frequency and direction, whose values along
rows and columns are the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array, UndeterminedError
from analysis.matching.correlation import Reason, checked_image, search
from analysis.spots.noise import NoiseModel
from analysis.statistics import robust_sigma

_CYCLES, _LEAST_SIDE = 10.0, 32
"""Least number of cycles in a patch, and its least side, pixels."""
_WIDTH, _LEAST_WIDTH = 0.15, 1.5
"""Half width of the ring of frequencies, as a share of the frequency and in bins; the larger of both is used."""
_LEAST_PATCHES = 16
_HANN_BINS = 3.0**-0.5
"""Standard deviation of the frequencies that a Hann window mixes, in bins: weights 1, 1/4 and 1/4 of their power."""
_OVERLAP = 1.11
"""Variance of a mean over patches that overlap by half, relative to that of independent ones.

Spectra of adjacent patches have a correlation of 1/6 (Hann window), so that their products have 1/36; each has four
neighbours.
"""
_SIGNAL = 5.0
"""Least power of the scene in a bin, in standard deviations of the noise's mean power over all patches."""
_BINS = 0.7
"""Least share of a ring's bins with a signal."""
_EVEN = 0.01
"""Variance of the logarithm of a bin's ratio, relative to one of no coherence, that is assumed besides its noise."""
_COHERENT, _SAME = 0.5, 0.8
"""Least coherence of both images, and least coherence of what is left without the specified noise."""
_TEMPLATE, _RADIUS, _POINTS, _LEAST_POINTS = 63, 24, 6, 5
"""Side of the windows that are matched, largest displacement of the scene, windows a side, and least number of them."""
_ALIKE, _UNIQUE = 0.5, 0.9
"""Least correlation of a window, and least ratio of the second best peak to the best one at which it is ambiguous."""
_SCATTER = 1.5
"""Largest robust scatter of the windows' displacements, pixels."""
_CLIPPED, _MOST_SATURATED = 1e-3, 0.3
"""Share of equal largest values that are taken for saturation, and largest share of saturated pixels."""
_SAME_SIGN = 0.5
"""Least real part of the cross-spectrum, relative to its modulus."""


@dataclass(frozen=True, eq=False)
class MtfRatio:
    """Ratio of the MTF of an image to that of a reference image of the same scene, at F frequencies.

    Attributes
    ----------
    frequency : (F,) ndarray
        Frequencies, cycles/pixel.
    ratio : (F, 2) ndarray
        Ratios along the rows of the image and along its columns.
    log_covariance : (F, 2, 2) ndarray
        Covariance of the logarithms of both ratios, from noise, from the scatter of patches, and from what only one of
        the images may show.
    coherence : (F,) ndarray
        Squared coherence of both images, noise included, in the worse direction.
    displacement : (2,) ndarray
        Displacement of the scene from the reference to the other image, rows and columns, pixels.
    light : float
        Ratio of the mean light, by which the ratios are divided.
    patches : int
        Number of patches.
    """

    frequency: Array
    ratio: Array
    log_covariance: Array
    coherence: Array
    displacement: Array
    light: float
    patches: int

    @property
    def sigma(self) -> Array:
        """Standard deviations of the ratios, (F, 2)."""
        return np.asarray(self.ratio * np.sqrt(np.diagonal(self.log_covariance, axis1=1, axis2=2)))


def mtf_ratio(
    reference: ArrayLike, other: ArrayLike, frequency: ArrayLike, *, noise: NoiseModel | None = None
) -> MtfRatio:
    """Measure the ratio of the MTFs of two images of one scene, which may be unknown.

    Parameters
    ----------
    reference, other : (H, W) array_like
        Images of the same size, H rows and W columns, linear in light. The scene may be displaced by up to 24 px.
    frequency : float or (F,) array_like
        Frequencies, cycles/pixel, 0.03 to 0.25: beyond, aliases of the scene count.
    noise : NoiseModel, optional
        Noise of both images, with black level and saturation. Without it grey values are proportional to light, and
        what the images do not have in common is noise of the same variance in both, with a larger standard deviation.

    Returns
    -------
    MtfRatio
        Ratios along rows and columns with their covariance.

    Raises
    ------
    ValueError
        The images differ in size or are too small, or a frequency is out of range.
    UndeterminedError
        The images do not show the same scene, it has no contrast at a frequency, or one image reverses the contrast.

    Examples
    --------
    Two images of one random texture; the second one has a Gaussian blur of 1 px more, exp(-2 pi^2 f^2):

    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> import analysis
    >>> rng = np.random.default_rng(4)
    >>> scene = 1000 + 2000 * gaussian_filter(rng.standard_normal((400, 400)), 1.5)
    >>> pair = [gaussian_filter(scene, s) + 2 * rng.standard_normal(scene.shape) for s in (1.0, 2**0.5)]
    >>> found = analysis.mtf_ratio(*pair, 0.1)
    >>> bool(np.all(np.abs(found.ratio - np.exp(-0.02 * np.pi**2)) < 4 * found.sigma)), bool(found.sigma.max() < 0.01)
    (True, True)
    """
    frequencies = np.atleast_1d(np.asarray(frequency, np.float64))
    if frequencies.ndim != 1 or not np.all((frequencies >= 0.03) & (frequencies <= 0.25)):
        raise ValueError(f"MTF ratio: frequencies must be 0.03 to 0.25 cycles/pixel, found {frequencies}")
    pair = [checked_image(image, "MTF ratio") for image in (reference, other)]
    if pair[0].shape != pair[1].shape:
        raise ValueError(f"MTF ratio: the images have different sizes, {pair[0].shape} and {pair[1].shape} px")
    saturation = math.inf if noise is None else noise.saturation_dn
    images = [_unsaturated(image.astype(np.float64), saturation) for image in pair]
    displacement = _displacement(*images)
    first, second = _overlapping(images, np.rint(displacement).astype(int))
    rest = displacement - np.rint(displacement)
    parts = [_Ring.of(first, second, f, noise).result(f, rest) for f in frequencies.tolist()]
    ratios, covariances, coherences, lights, counts = zip(*parts, strict=True)
    return MtfRatio(
        frequencies, np.stack(ratios), np.stack(covariances), np.array(coherences), displacement, lights[0], counts[0]
    )


def _unsaturated(grey: Array, saturation: float) -> Array:
    """Return an image with NaN in saturated pixels, and where many have the largest value without a specified one."""
    bad = ~(grey < saturation)
    largest = grey == np.max(grey, initial=-math.inf, where=~bad)
    if _CLIPPED < np.mean(largest) < _MOST_SATURATED:
        bad |= largest
    grey = np.where(bad, np.nan, grey)
    share = float(np.mean(np.isnan(grey)))
    if share > _MOST_SATURATED:
        raise UndeterminedError(
            f"MTF ratio: {100 * share:.0f} % of the pixels of an image are saturated or not finite; expose it shorter"
        )
    return grey


def _displacement(reference: Array, other: Array) -> Array:
    """Return the displacement of the scene between two images, rows and columns, pixels; (2,)."""
    half = _TEMPLATE // 2
    radius = min(_RADIUS, (min(reference.shape) - _TEMPLATE) // 2 - half)
    if radius < 2:
        raise ValueError(f"MTF ratio: images of {reference.shape} px are too small; give 200 x 200 px or more")
    axes = [np.linspace(half + radius, size - 1 - half - radius, _POINTS).astype(int) for size in reference.shape]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    templates = np.stack([reference[r - half : r + half + 1, c - half : c + half + 1] for r, c in points])
    peaks = search(other, templates, points, radius)
    alike = (peaks.reason == Reason.ACCEPTED) & (peaks.value > _ALIKE) & (peaks.ratio < _UNIQUE)
    moved = (peaks.position - points)[alike]
    middle = np.median(moved, axis=0) if len(moved) else np.zeros(2)
    if len(moved) < _LEAST_POINTS or robust_sigma(moved - middle) > _SCATTER:
        raise UndeterminedError(
            f"MTF ratio: the images do not show one scene displaced by at most {radius} px ({len(moved)} of"
            f" {len(points)} windows are found again): give two images of the same scene, which has contrast and does"
            " not repeat itself"
        )
    return np.asarray(middle)


def _overlapping(images: list[Array], move: Array) -> tuple[Array, Array]:
    """Return the parts of two images that show the same scene, displaced by whole pixels between them."""
    size = np.array(images[0].shape)
    ahead, behind = np.maximum(move, 0), np.maximum(-move, 0)
    first = images[0][behind[0] : size[0] - ahead[0], behind[1] : size[1] - ahead[1]]
    second = images[1][ahead[0] : size[0] - behind[0], ahead[1] : size[1] - behind[1]]
    return first, second


_Result = tuple[Array, Array, float, float, int]
"""Both ratios, the covariance of their logarithms, the coherence, the ratio of light, and the number of patches."""


@dataclass(frozen=True, eq=False)
class _Ring:
    """Spectra of P patches of two images in K bins of a ring of frequencies.

    Attributes
    ----------
    frequency : (K, 2) ndarray
        Frequencies of the bins, along columns and along rows, cycles/pixel.
    power : (2, P, K) ndarray
        Power of both images.
    cross : (P, K) ndarray
        Cross-spectra.
    noise : (2, P) ndarray
        Power of the noise of both images in any bin; NaN if it is not specified.
    mixed : (2, P, K, 2) ndarray
        Products of the power of both images with the distance of its mean frequency from the bin's.
    light : (2, P) ndarray
        Mean light of both images.
    blur : float
        Standard deviation of the frequencies that the window mixes, along each axis, cycles/pixel.
    """

    frequency: Array
    power: Array
    cross: Array
    noise: Array
    mixed: Array
    light: Array
    blur: float

    @classmethod
    def of(cls, first: Array, second: Array, frequency: float, noise: NoiseModel | None) -> _Ring:
        """Compute the spectra of all patches without unusable pixels about one frequency, cycles/pixel."""
        side = max(_LEAST_SIDE, 2 * math.ceil(0.5 * _CYCLES / frequency))
        phase = 2.0 * np.pi * (np.arange(side) + 0.5) / side
        hann, slope = 0.5 - 0.5 * np.cos(phase), np.pi / side * np.sin(phase)
        window = np.outer(hann, hann)
        slopes = np.outer(slope, hann), np.outer(hann, slope)
        axis = np.fft.fftfreq(side)
        grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        width = max(_WIDTH * frequency, _LEAST_WIDTH / side)
        # spectra of real images are symmetric: half of the plane
        half = (grid[..., 0] > 0.0) | ((grid[..., 0] == 0.0) & (grid[..., 1] > 0.0))
        ring = (np.abs(np.hypot(*np.moveaxis(grid, -1, 0)) - frequency) <= width) & half
        columns: list[tuple[Array, ...]] = []
        starts = [range(0, size - side + 1, side // 2) for size in first.shape]
        for row in starts[0]:
            for column in starts[1]:
                pair = [image[row : row + side, column : column + side] for image in (first, second)]
                if not (np.all(np.isfinite(pair[0])) and np.all(np.isfinite(pair[1]))):
                    continue
                means = np.array([np.sum(window * patch) / np.sum(window) for patch in pair])
                flat = np.stack(pair) - means[:, None, None]
                both = np.fft.fft2(window * flat)[:, ring]
                parts = [(both.conj() * np.fft.fft2(w * flat)[:, ring]).imag / (-2.0 * np.pi) for w in slopes]
                random = [np.nan if noise is None else np.sum(window**2 * _variance(noise, patch)) for patch in pair]
                dark = 0.0 if noise is None else noise.dark_level_dn
                mixed = np.stack(parts, axis=-1)
                columns.append((np.abs(both) ** 2, both[0].conj() * both[1], np.array(random), mixed, means - dark))
        if len(columns) < _LEAST_PATCHES:
            raise UndeterminedError(
                f"MTF ratio: {len(columns)} patches of {side} px without saturated pixels, {_LEAST_PATCHES} are"
                f" needed at {frequency:g} cycles/pixel; give larger images"
            )
        power, cross, variance, mixed, light = (np.stack(part) for part in zip(*columns, strict=True))
        power, mixed = np.moveaxis(power, 1, 0), np.moveaxis(mixed, 1, 0)
        return cls(grid[ring], power, cross, variance.T, mixed, light.T, _HANN_BINS / side)

    @property
    def directions(self) -> Array:
        """Weights of the bins along the rows of an image and along its columns, (2, K)."""
        squares = self.frequency[:, ::-1] ** 2
        return np.asarray((squares / np.sum(squares, axis=1, keepdims=True)).T ** 2)

    def result(self, frequency: float, shift: Array) -> _Result:
        """Return the ratio of the second image to the first one.

        Parameters
        ----------
        frequency : float
            Frequency, cycles/pixel.
        shift : (2,) ndarray
            Displacement of the scene, pixels.
        """
        patches = len(self.cross)
        power, cross, light = self.power.sum(axis=1), self.cross.sum(axis=0), self.light.sum(axis=1)
        if not np.all(light > 0.0):
            raise UndeterminedError("MTF ratio: an image has no light above its black level; check the black level")
        specified = bool(np.all(np.isfinite(self.noise)))
        noise = self.noise.sum(axis=1) if specified else _uncorrelated(power, cross, light)
        signal = power - noise[:, None]
        used = np.all(signal > _SIGNAL * noise[:, None] / math.sqrt(patches), axis=0)
        if np.mean(used) < _BINS:
            raise UndeterminedError(
                f"MTF ratio: the scene has no contrast beyond the noise at {frequency:g} cycles/pixel in every"
                f" direction ({100 * np.mean(used):.0f} % of the spectrum); choose a lower frequency, less defocus or"
                " another scene"
            )
        whole = (np.prod(power, axis=0), np.prod(signal if specified else power, axis=0))
        weights = self.directions * used
        total, same = (np.minimum(weights @ np.abs(cross) ** 2 / (weights @ part), 1.0) for part in whole)
        if np.min(total) < _COHERENT or np.min(same) < _SAME:
            raise UndeterminedError(
                f"MTF ratio: the images have a coherence of {np.min(same):.2f} at {frequency:g} cycles/pixel, {_SAME:g}"
                " is needed: they show different scenes, or too much noise or aliasing"
            )
        self._require_sign(cross * np.exp(2j * np.pi * self.frequency @ shift), frequency)
        weight = 1.0 / (_EVEN + np.sum(noise[:, None] / np.where(used, signal, 1.0), axis=0)) * used

        # noise and what the images do not share matter least beside the sharper one
        second = signal[1] * light[0] ** 2 > signal[0] * light[1] ** 2
        sign = np.where(second, -1.0, 1.0)

        def logarithm(chosen: Array) -> Array:
            """Return the logarithms of both ratios from the patches with a weight of 1, (2,)."""
            random = self.noise @ chosen if specified else noise / patches * chosen.sum()
            part = np.maximum(np.tensordot(chosen, self.power, (0, 1)) - random[:, None], 1e-9 * signal)
            mean = self.frequency + np.tensordot(chosen, self.mixed, (0, 1)) / part[..., None]
            at, sharper = np.where(second[:, None], mean[1], mean[0]), np.where(second, part[1], part[0])
            values = sign * np.log(np.maximum(np.abs(chosen @ self.cross), 1e-300) / sharper)
            gain = math.log((self.light[1] @ chosen) / (self.light[0] @ chosen))
            return _fitted(at[used], values[used] - gain, weight[used], frequency, self.blur)

        all_patches = np.ones(patches)
        without = np.array([logarithm(all_patches - patch) for patch in np.eye(patches)])
        without -= without.mean(axis=0)
        scatter = (patches - 1) / patches * without.T @ without * (patches - 1) / (patches - 3) * _OVERLAP
        result = logarithm(all_patches)
        # what only one of the images shows may belong to either
        unknown = -0.5 * np.log(same) / math.sqrt(3.0) * np.where(result > 0.0, -1.0, 1.0)
        covariance = scatter + np.outer(unknown, unknown)
        return np.exp(result), covariance, float(np.min(total)), float(light[1] / light[0]), patches

    def _require_sign(self, cross: Array, frequency: float) -> None:
        """Raise UndeterminedError if the images have opposite contrast in a direction."""
        for weight, name in zip(self.directions, ("rows", "columns"), strict=True):
            if float(np.real(weight @ cross)) < _SAME_SIGN * float(weight @ np.abs(cross)):
                raise UndeterminedError(
                    f"MTF ratio: an image reverses the contrast at {frequency:g} cycles/pixel along the {name};"
                    " choose a lower frequency or less defocus"
                )


def _variance(noise: NoiseModel, grey: Array) -> Array:
    """Return the variance of recorded grey values, with patterns of the pixels, DN^2."""
    return np.asarray(noise.frame_variance_dn2(grey) + noise.fixed_variance_dn2(grey))


def _uncorrelated(power: Array, cross: Array, light: Array) -> Array:
    """Return the power of noise, (2,), that makes two images incoherent if it is proportional to their light.

    It solves (P1 - N1) (P2 - N2) = |C|^2 for the sum over K bins with powers (2, K) and cross-spectra (K,).
    """
    each = light / light.mean()
    a, b = float(each[0] * each[1] * power.shape[1]), float(np.sum(each[1] * power[0] + each[0] * power[1]))
    c = max(float(np.sum(power[0] * power[1] - np.abs(cross) ** 2)), 0.0)
    return np.asarray(each * 2.0 * c / (b + math.sqrt(max(b * b - 4.0 * a * c, 0.0))))


def _fitted(at: Array, values: Array, weight: Array, frequency: float, blur: float) -> Array:
    """Return the logarithms of the ratio at one frequency along rows and columns, (2,), from K bins of a ring.

    Parameters
    ----------
    at : (K, 2) ndarray
        Mean frequencies of the bins, cycles/pixel.
    values : (K,) ndarray
        Logarithms of the ratio.
    weight : (K,) ndarray
        Their weights.
    frequency : float
        Frequency, cycles/pixel.
    blur : float
        Standard deviation of the frequencies that the window mixes, along each axis, cycles/pixel.
    """

    def table(f: Array) -> Array:
        square = np.sum(f**2, axis=1)
        u = square / frequency**2 - 1.0
        twice = ((f[:, 1] + 1j * f[:, 0]) / np.sqrt(square)) ** 2
        around = [np.ones_like(u), twice.real, twice.imag, (twice**2).real, (twice**2).imag]
        return np.stack([power * part for power in (np.ones_like(u), u, u * u) for part in around], axis=-1)

    root = np.sqrt(weight)
    terms = np.linalg.lstsq(root[:, None] * table(at), root * values, rcond=None)[0]
    # the ratio to the sharper image is its mean over the frequencies that a bin mixes: half of its Laplacian too much
    points, step = frequency * np.eye(2)[::-1], 0.1 * frequency
    result = table(points) @ terms
    around = np.stack([table(points + sign * step * axis) @ terms for sign in (-1.0, 1.0) for axis in np.eye(2)])
    sign = np.where(result > 0.0, -1.0, 1.0)
    excess = 2.0 * (blur / step) ** 2 * np.mean(np.expm1(sign * (around - result)), axis=0)
    return np.asarray(result - sign * np.log1p(np.maximum(excess, -0.5)))
