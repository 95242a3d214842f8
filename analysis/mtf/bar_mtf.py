"""MTF at one frequency from a group of bars, in one frame or in several.

Bars of equal width and spacing between the levels `bright` and `dark` are a square wave, whose fundamental has the
amplitude (2 / pi) (bright - dark). In the image it is multiplied by the MTF:

    MTF = pi A / (2 (bright - dark))

A, the phase and the two-dimensional frequency are fitted to all pixels of the region by least squares, with the
harmonics 3, 5 and 7 where their aliases can be separated from the fundamental. Slightly tilted bars pass through all
sampling phases, so that this also holds at Nyquist, where the contrast of untilted bars depends on their phase against
the pixels. Weights fall to the region's edge as half a sine: near the group's ends the missing bars beyond change level
and amplitude a little, and the fit would take the change of level for bars (3e-4 of A in a region of 20 x 35 px, 6 px
from the ends).

The levels are those of areas so wide that no blur reaches their middle. Diffraction at a pupil's rim extends far: at
the distance d from a straight edge, lambda N / (15.5 d) of the step is missing, half a per cent at 10 px of 7 um and
F/9. Patches beside the bars are therefore too dark or too bright by about a per cent, and the MTF is too high by it.
Frames of an even bright field and of the closed shutter give the right levels.

For comparison with practice, the contrast (max - min) / (max + min) and Coltman's correction pi / 4 (J. Opt. Soc. Am.
44, 468 (1954), first term of his series) are given; the correction is exact where the third harmonic is not passed.

Phases of single pages are those of their differences from the mean, which contain only noise that is new in each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array, MeasurementError
from analysis.mtf.edge_location import LARGEST_GREY, grey_plane
from analysis.mtf.edge_pages import different_pages, mean_page, rounding_residual
from analysis.mtf.slanted_edge import EdgeMtf
from analysis.spots.noise import NoiseModel
from analysis.statistics import measured_bias, p_value_of, rice_sigma, signal_modulus

_HARMONICS = (3, 5, 7)
_LEAST_SIDE = 12
_LEAST_PATCH = 16
# Two frequencies are separated if they differ by this many cycles over the region in some direction.
_APART = 1.5
# Significance of the fundamental, in sigmas; the false-alarm rate over the 1e3 cells of a spectrum is 1 in 300 regions.
_LEAST_AMPLITUDE = 5.0
# Fraction of the amplitude by which a quarter of the region may differ from the whole.
_UNEVEN = 0.15
_STEPS = 8
# Relative difference of light that is allowed for even fields: diffraction moves 0.7 % of the bars' mean level out of
# the group (32 px at F/9). For patches, which lie elsewhere, any significant difference counts.
_LEAST_LIGHT = 0.01


class BarError(MeasurementError, ValueError):
    """Error raised for a region without measurable bars; the message says what is wrong and what to change."""


@dataclass(frozen=True, eq=False)
class BarMtf:
    """MTF of one group of bars.

    Attributes
    ----------
    frequency, frequency_sigma : (2,) ndarray
        Frequency (component down the column, component along the row) and its standard deviation, cycles/pixel. The
        frequencies f and (0, 1) - f give the same pixels, so at Nyquist the direction of the tilt is not known.
    mtf, sigma : float
        MTF at that frequency and its standard deviation.
    noise_bias : float
        Mean amount by which noise lengthens `mtf`, >= 0.
    amplitude, phase : float
        Amplitude of the fundamental, grey values, and phase at the region's middle, rad: A cos(2 pi f . r + phase).
    harmonics : dict of int to float
        Amplitude, grey values, of each harmonic that could be separated.
    dark, dark_sigma, bright, bright_sigma : float
        Grey values of the reference patches, offset included, and their standard deviations.
    contrast : float
        (max - min) / (max + min) of the region, offset subtracted. Noise raises it.
    contrast_transfer : float
        Contrast over that of the patches.
    coltman : float
        pi / 4 of `contrast_transfer`.
    light, light_sigma : float
        Relative excess of the light on the bars over that on the patches, from the mean level in the bars, and its
        standard deviation. A light that acts on both levels moves the mean level in proportion.
    uneven : bool
        True if that excess is significant; `sigma` then includes it.
    page_noise : tuple of float or None
        Rms noise of one pixel in one page of the region and of the two patches, where pages were measured.
    same : int
        Number of pages of the region that are identical copies of another one.
    """

    frequency: Array
    frequency_sigma: Array
    mtf: float
    sigma: float
    noise_bias: float
    amplitude: float
    phase: float
    harmonics: dict[int, float]
    dark: float
    dark_sigma: float
    bright: float
    bright_sigma: float
    contrast: float
    contrast_transfer: float
    coltman: float
    light: float
    light_sigma: float
    uneven: bool
    page_noise: tuple[float, float, float] | None = None
    same: int = 0

    @property
    def cycles_per_pixel(self) -> float:
        """Length of the frequency vector, cycles/pixel."""
        return float(np.hypot(*self.frequency))


def bar_mtf(
    region: ArrayLike,
    dark: ArrayLike,
    bright: ArrayLike,
    frequency: ArrayLike | None = None,
    *,
    noise: NoiseModel | None = None,
    frames: int = 1,
    saturation: float | None = None,
    offset: float = 0.0,
    rounding: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> BarMtf:
    """Measure the MTF at the frequency of bars that fill a region, also at Nyquist if the bars are tilted.

    The region may be one frame or the mean of several; `measure_bar_pages` compares several frames with each other.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    region : (H, W) array_like
        Grey values, linear in light, inside the group.
    dark : array_like
        Pixels, of any shape, with the level of the spaces: the same region in frames of an even field, or even patches
        far from edges.
    bright : array_like
        Pixels, of any shape, with the level of the bars: the same region in frames of an even field, or even patches
        far from edges.
    frequency : array_like, optional
        Approximate frequency, good to one cycle over the region: (2,) cycles per pixel (down the column, along the
        row), or one number, its length. By default the strongest below Nyquist.
    noise : NoiseModel, optional
        Noise of the detector. By default the variance is that of the residuals and of the patches.
    frames : int
        Number of averaged frames.
    saturation : float, optional
        Grey value of saturation; by default that of `noise`.
    offset : float
        Grey value without light, for the contrast only.
    rounding : tuple of float
        Rms of the rounding error that remains in a pixel of the region and in the two levels, in grey values.

    Returns
    -------
    BarMtf
        `mtf` and `sigma`, the fitted `frequency` vector, the levels and the Coltman estimate.

    Raises
    ------
    ValueError
        There are no bars; the region is saturated, too small or not filled; the bars are at Nyquist without tilt; or
        the patches have no contrast.

    Notes
    -----
    A square wave between the levels has a fundamental of (2 / pi) times their difference: MTF = pi A / (2 (bright -
    dark)) for the fitted amplitude A (Coltman, J. Opt. Soc. Am. 44, 468 (1954)).

    Examples
    --------
    Bars between 200 and 1000 grey values have a fundamental of (2 / pi) 800. A camera that leaves 40 % of it:

    >>> import numpy as np
    >>> import analysis
    >>> row, column = np.mgrid[:64, :64]
    >>> wave = np.cos(2 * np.pi * (0.02 * row + 0.3 * column))
    >>> image = 600 + 0.4 * (2 / np.pi) * 800 * wave
    >>> bars = analysis.bar_mtf(image, np.full(100, 200.0), np.full(100, 1000.0), frequency=0.3)
    >>> round(bars.mtf, 4), round(bars.cycles_per_pixel, 4)
    (0.4, 0.3007)
    """
    if saturation is None and noise is not None:
        saturation = noise.saturation_dn
    grey = _checked(region, saturation)
    window = np.outer(*(np.sin(np.pi * (np.arange(n) + 0.5) / n) for n in grey.shape))
    # levels that fill the region count where the bars do
    patches = (("dark", dark), ("bright", bright))
    levels = [_level(name, patch, noise, frames, saturation, window) for name, patch in patches]
    (low, low_sigma), (high, high_sigma) = (
        (level, math.hypot(sigma, least)) for (level, sigma), least in zip(levels, rounding[1:], strict=True)
    )
    step, step_sigma = high - low, math.hypot(low_sigma, high_sigma)
    if step <= 5.0 * step_sigma or step <= 0:
        raise BarError(
            f"the patches have no contrast: bright {high:g} +- {high_sigma:.2g}, dark {low:g} +- {low_sigma:.2g}; "
            "choose even areas of the target's two levels, the brighter one as bright"
        )
    position = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2.0 for n in grey.shape), indexing="ij")).reshape(2, -1)
    weight = window.ravel()
    value = grey.ravel()
    start = _start(grey, frequency)
    _check_phases(start, grey.shape)
    numbers = _separable(start, grey.shape)
    fitted, parameters = _fit(position, value, weight, start, numbers)
    other = _other_alias(fitted, frequency)
    if other is not None:
        fitted, parameters = _fit(position, value, weight, other, numbers)
    design = _design(position, fitted, numbers, parameters)
    model = parameters @ design[:-2]
    inverse = np.linalg.inv(_gram(design * weight, design))
    if noise is None:
        scatter = float(np.sum((value - model) ** 2)) / (value.size - design.shape[0])
        variance = np.full(value.size, max(scatter, rounding[0] ** 2))
    else:
        variance = noise.temporal_variance_dn2(model, frames) + noise.fixed_variance_dn2(model)
    covariance = inverse @ _gram(design * (weight**2 * variance), design) @ inverse
    c, s = parameters[1], parameters[2]
    amplitude = math.hypot(c, s)
    unit = np.array([c, s]) / max(amplitude, 1e-300)
    square = covariance[1:3, 1:3]
    across = np.array([-unit[1], unit[0]])
    along_sigma, across_sigma = math.sqrt(unit @ square @ unit), math.sqrt(across @ square @ across)
    if amplitude < _LEAST_AMPLITUDE * along_sigma:
        raise BarError(
            f"no bars in the region: the amplitude of {amplitude:.3g} at {np.hypot(*fitted):.3f} cycles/pixel is only "
            f"{amplitude / along_sigma:.1f} times its sigma; move the region, give the frequency, or average frames"
        )
    _check_filled(position, grey.shape, value - model, fitted, amplitude, float(np.mean(variance)))
    scale = math.pi / (2.0 * step)
    signal = signal_modulus(amplitude, along_sigma, across_sigma)
    mtf = scale * amplitude
    # the mean of bars of equal width is the mean of the two levels; another light changes both levels in proportion
    light = 2.0 * (float(parameters[0]) - low) / step - 1.0
    light_sigma = math.sqrt(4.0 * float(covariance[0, 0]) + low_sigma**2 + high_sigma**2) / step
    least = _LEAST_LIGHT if np.shape(dark) == np.shape(bright) == grey.shape else 0.0
    uneven = p_value_of((light / light_sigma) ** 2, 1) < FALSE_ALARM and abs(light) > least
    relative = math.hypot(step_sigma / step, light if uneven else 0.0)
    sigma = math.hypot(scale * float(rice_sigma(signal, along_sigma, across_sigma)), mtf * relative)
    largest, least = float(grey.max()) - offset, float(grey.min()) - offset
    contrast = (largest - least) / (largest + least) if largest + least > 0 else math.nan
    transfer = contrast * (high + low - 2.0 * offset) / step
    return BarMtf(
        frequency=fitted,
        frequency_sigma=np.sqrt(np.diag(covariance)[-2:]),
        mtf=mtf,
        sigma=sigma,
        noise_bias=scale * float(measured_bias(amplitude, across_sigma)),
        amplitude=amplitude,
        phase=math.atan2(-s, c),
        harmonics={h: math.hypot(*parameters[3 + 2 * k : 5 + 2 * k]) for k, h in enumerate(numbers)},
        dark=low,
        dark_sigma=low_sigma,
        bright=high,
        bright_sigma=high_sigma,
        contrast=contrast,
        contrast_transfer=transfer,
        coltman=math.pi / 4.0 * transfer,
        light=light,
        light_sigma=light_sigma,
        uneven=bool(uneven),
    )


def _checked(region: ArrayLike, saturation: float | None) -> Array:
    allowed = f"{_LEAST_SIDE} x {_LEAST_SIDE} px inside the group"
    return grey_plane(region, (_LEAST_SIDE, _LEAST_SIDE), allowed, saturation, BarError)


def _level(
    name: str, patch: ArrayLike, noise: NoiseModel | None, frames: int, saturation: float | None, window: Array
) -> tuple[float, float]:
    """Return the mean of a patch, weighted by the window if it has its shape, and its sigma, grey values."""
    pixels = np.asarray(patch, dtype=np.float64).ravel()
    finite = int(np.count_nonzero(np.abs(pixels) <= LARGEST_GREY))
    if finite < max(_LEAST_PATCH, pixels.size):
        raise BarError(
            f"the {name} patch needs at least {_LEAST_PATCH} pixels, all of them finite, found {finite} finite of "
            f"{pixels.size}; move or enlarge it"
        )
    if saturation is not None and np.any(pixels >= saturation):
        raise BarError(
            f"the {name} patch reaches the saturation level of {saturation:g}: lower the exposure or the light"
        )
    share = window.ravel() if np.shape(patch) == window.shape else np.ones(pixels.size)
    share = share / share.sum()
    mean = float(share @ pixels)
    if noise is None:
        variance = float(pixels.var(ddof=1))
    else:
        variance = float(noise.temporal_variance_dn2(mean, frames) + noise.fixed_variance_dn2(mean))
    return mean, math.sqrt(variance * float(share @ share))


def _start(grey: Array, frequency: ArrayLike | None) -> Array:
    """Return the frequency of the strongest peak of the windowed spectrum near a given one, (2,) cycles/pixel.

    Frequencies are (down the column, along the row). Of the frequencies that give the same pixels, the one nearest to
    the given one is returned.
    """
    shape = np.array(grey.shape)
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in grey.shape))
    flat = grey - np.average(grey, weights=window)
    size = 4 * shape
    power = np.abs(np.fft.fft2(flat * window, s=tuple(size)))
    cells = np.stack(np.meshgrid(*(np.fft.fftfreq(n) for n in size), indexing="ij"))
    if frequency is None:
        # not the window's main lobe about zero, half a plane
        allowed = np.any(np.abs(cells) * shape[:, None, None] > 2.0, axis=0)
        allowed &= (cells[1] > 0) | ((cells[1] == 0) & (cells[0] > 0)) | (cells[1] == -0.5) | (cells[0] == -0.5)
        return _peak(power, cells, allowed)
    target = np.asarray(frequency, dtype=np.float64)
    if target.shape not in ((), (2,)) or not np.all(np.isfinite(target)) or not np.any(target):
        raise BarError(
            "the frequency must be one number or two (down the column, along the row), in cycles/pixel, not 0"
        )
    if target.shape == (2,):
        near = cells + np.round(target[:, None, None] - cells)
        allowed = np.all(np.abs(near - target[:, None, None]) * shape[:, None, None] <= 1.0, axis=0)
        return _peak(power, near, allowed)
    periods = np.arange(-math.ceil(abs(target)), math.ceil(abs(target)) + 1)
    best, strongest = np.zeros(2), -1.0
    for row_periods in periods:
        for column_periods in periods:
            shifted = cells + np.array([row_periods, column_periods])[:, None, None]
            allowed = np.abs(np.hypot(*shifted) - abs(target)) * shape.min() <= 1.0
            allowed &= (shifted[1] > 0) | ((shifted[1] == 0) & (shifted[0] > 0))
            if allowed.any() and power[allowed].max() > strongest * (1.0 + 1e-9):
                best, strongest = _peak(power, shifted, allowed), float(power[allowed].max())
    return best


def _other_alias(fitted: Array, frequency: ArrayLike | None) -> Array | None:
    """Return the other frequency that gives the same pixels near Nyquist, if its length is nearer to the given one.

    The result is (2,) in cycles/pixel; None if there is no such frequency.
    """
    if frequency is None or np.ndim(frequency) != 0:
        return None
    length = abs(float(np.asarray(frequency)))
    multiple = np.round(2.0 * fitted)
    other = multiple - fitted
    return other if abs(np.hypot(*other) - length) < abs(np.hypot(*fitted) - length) - 1e-6 else None


def _peak(power: Array, cells: Array, allowed: NDArray[np.bool]) -> Array:
    index = int(np.argmax(np.where(allowed, power, -1.0)))
    return cells.reshape(2, -1)[:, index].copy()


def _apart(difference: Array, shape: tuple[int, ...]) -> bool:
    wrapped = difference - np.round(difference)
    return bool(np.any(np.abs(wrapped) * np.array(shape) >= _APART))


def _check_phases(frequency: Array, shape: tuple[int, ...]) -> None:
    if not _apart(frequency, shape):
        raise BarError(
            f"{np.hypot(*frequency):.3f} cycles/pixel is not a frequency of bars in {shape[0]} x {shape[1]} px: less "
            "than two periods; take a larger region or give the frequency"
        )
    if not _apart(2.0 * frequency, shape):
        raise BarError(
            "the bars are at the Nyquist frequency and parallel to the pixels, so that their contrast depends on how "
            "they fall on the pixels: tilt the target by 2 to 10 deg, or take a region that is longer along the bars"
        )


def _separable(frequency: Array, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return which of the harmonics 3, 5 and 7 can be separated from zero, from the fundamental and from each other.

    Sampling by the pixels maps a harmonic to another frequency (its alias), which must differ from theirs.
    """
    separable: list[int] = []
    for h in _HARMONICS:
        others = [1, *separable]
        both = [(h - k) * frequency for k in others] + [(h + k) * frequency for k in others]
        if all(_apart(each, shape) for each in (*both, h * frequency, 2 * h * frequency)):
            separable.append(h)
    return tuple(separable)


def _waves(position: Array, frequency: Array, numbers: tuple[int, ...]) -> Array:
    """Return the terms of the model at every pixel: 1, then cosine and sine of each wave, (3 + 2 K, N).

    The waves are the fundamental and its harmonics.

    Dimensions: K harmonics, N pixels.
    """
    phase = 2.0 * np.pi * (frequency @ position)
    rotated = np.outer((1, *numbers), phase)
    pairs = np.stack([np.cos(rotated), np.sin(rotated)], axis=1).reshape(-1, phase.size)
    return np.concatenate([np.ones((1, phase.size)), pairs])


def _design(position: Array, frequency: Array, numbers: tuple[int, ...], parameters: Array) -> Array:
    """Return the model's terms, then its derivatives with respect to both components of the frequency, (P, N).

    Dimensions: P parameters, N pixels.
    """
    waves = _waves(position, frequency, numbers)
    slope = np.zeros(waves.shape[1])
    for k, h in enumerate((1, *numbers)):
        cosine, sine = waves[1 + 2 * k], waves[2 + 2 * k]
        slope += 2.0 * np.pi * h * (parameters[2 + 2 * k] * cosine - parameters[1 + 2 * k] * sine)
    return np.concatenate([waves, slope * position])


def _gram(first: Array, second: Array) -> Array:
    """Return the matrix of scalar products of two sets of functions, summed over pixels.

    A matrix product is not used, since its threads wait for each other on a busy machine.
    """
    return np.asarray(np.einsum("in,jn->ij", first, second))


def _solved(design: Array, value: Array, weight: Array) -> Array:
    """Return the parameters of a weighted linear least-squares fit."""
    weighted = design * weight
    return np.asarray(np.linalg.solve(_gram(weighted, design), weighted @ value))


def _fit(position: Array, value: Array, weight: Array, start: Array, numbers: tuple[int, ...]) -> tuple[Array, Array]:
    """Fit frequency (2,) and amplitudes (3 + 2 K,) by Gauss-Newton steps.

    Dimensions: K harmonics.
    """
    frequency = start
    limit: Array = np.asarray(0.5 / np.ptp(position, axis=1))
    for _ in range(_STEPS):
        waves = _waves(position, frequency, numbers)
        parameters = _solved(waves, value, weight)
        step = _solved(_design(position, frequency, numbers, parameters), value - parameters @ waves, weight)[-2:]
        frequency = np.asarray(frequency + np.clip(step, -limit, limit))
        if np.all(np.abs(step) < 1e-7 * limit):
            break
    return frequency, _solved(_waves(position, frequency, numbers), value, weight)


def _check_filled(
    position: Array, shape: tuple[int, ...], residual: Array, frequency: Array, amplitude: float, variance: float
) -> None:
    wave = np.exp(-2j * np.pi * (frequency @ position))
    quarter = (position[0] > 0) * 2 + (position[1] > 0)
    for number in range(4):
        part = quarter == number
        rest = 2.0 * abs(np.mean(residual[part] * wave[part]))
        if rest > max(_UNEVEN * amplitude, 6.0 * math.sqrt(2.0 * variance / np.count_nonzero(part))):
            where = f"{('upper', 'lower')[number // 2]} {('left', 'right')[number % 2]}"
            raise BarError(
                f"the bars do not fill the region of {shape[0]} x {shape[1]} px evenly: their amplitude in its {where} "
                f"quarter is off by {rest / amplitude:.0%}; choose a region inside one group"
            )


FALSE_ALARM = 1e-4
"""Probability that pages are refused although the bars do not move in them."""
_ROUGH = 0.3
"""Ratio of noise to the step of grey values below which a tenth of the rounding error does not average out."""


def measure_bar_pages(
    region: Array,
    dark: Array,
    bright: Array,
    frequency: ArrayLike | None = None,
    *,
    saturation: float | None = None,
    offset: float = 0.0,
    step: float = 0.0,
) -> BarMtf:
    """Measure the MTF from the bars that fill a region in all pages.

    Dimensions: P pages, H rows, W columns, Q pages of the level.

    Parameters
    ----------
    region : (P, H, W) ndarray
        Grey values, linear in light; identical copies of a page do not count.
    dark : (Q, ...) ndarray
        Pages with the level of the spaces: the same region in frames of an even field, or even patches far from edges.
    bright : (Q, ...) ndarray
        Pages with the level of the bars.
    frequency : array_like or None
        Approximate frequency, cycles per pixel: (down the column, along the row), or its length; None for the
        strongest.
    saturation : float or None
        Grey value of saturation; one page that reaches it is enough for a refusal.
    offset : float
        Grey value without light, for the contrast only.
    step : float
        Step between the grey values of a page, to which they are rounded; 0 for real numbers.

    Raises
    ------
    BarError
        The mean of the pages shows no measurable bars (`bar_mtf`), or the bars move from page to page.
    """
    unique = different_pages(region)
    pages, patches = region[unique], [patch[different_pages(patch)] for patch in (dark, bright)]
    mean = mean_page(pages, saturation)
    low, high = (mean_page(patch, saturation) for patch in patches)
    # sums of huge real numbers may overflow; values that are not finite are refused below
    with np.errstate(over="ignore", invalid="ignore"):
        noise = [float(np.sqrt(np.mean(np.var(patch.reshape(len(patch), -1), axis=1)))) for patch in patches]
        page_noise = math.inf if len(pages) == 1 else float(np.sqrt(np.mean(np.var(pages, axis=0, ddof=1))))
    rounding = [rounding_residual(rms, step) if math.isfinite(rms) else 0.0 for rms in (page_noise, *noise)]

    def measured(rounding_error: float) -> BarMtf:
        return bar_mtf(
            mean,
            low,
            high,
            frequency,
            saturation=saturation,
            offset=offset,
            rounding=(rounding_error, rounding[1], rounding[2]),
        )

    result = measured(rounding[0])
    if len(pages) == 1:
        page_noise = _scatter(mean, result)
        if rounding_residual(page_noise, step) > page_noise:
            result = measured(rounding_residual(page_noise, step))
    else:
        _check_drift(pages, mean, result, step)
    return replace(result, page_noise=(page_noise, noise[0], noise[1]), same=len(region) - len(pages))


def _waves_of_page(shape: tuple[int, ...], bars: BarMtf) -> Array:
    """Return 1, the fundamental of unit amplitude, and its derivative with respect to the phase, (3, N).

    Dimensions: N pixels.
    """
    position = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2.0 for n in shape), indexing="ij")).reshape(2, -1)
    phase = 2.0 * np.pi * (bars.frequency @ position) + bars.phase
    return np.stack([np.ones(phase.size), np.cos(phase), -np.sin(phase)])


def _scatter(mean: Array, bars: BarMtf) -> float:
    """Return the rms residual of the fundamental in a page, an upper limit of the noise, as harmonics are in it."""
    waves = _waves_of_page(mean.shape, bars)
    value = mean.ravel()
    rest = value - np.linalg.lstsq(waves.T, value, rcond=None)[0] @ waves
    return float(np.sqrt(np.mean(rest**2)))


def _check_drift(pages: Array, mean: Array, bars: BarMtf, step: float) -> None:
    """Raise BarError if the phase of the bars differs significantly between pages, so that the bars move."""
    waves = _waves_of_page(mean.shape, bars)
    inverse = np.linalg.inv(waves @ waves.T)
    rest = (pages - mean).reshape(len(pages), -1)
    parts = rest @ waves.T @ inverse
    freedom = (rest.shape[1] - 3) * (len(pages) - 1)
    noise = math.sqrt(float(np.sum((rest - parts @ waves) ** 2)) / freedom)
    noise = max(noise, rounding_residual(noise, step), 1e-12 * bars.amplitude)
    phase = parts[:, 2] / bars.amplitude
    sigma = noise * math.sqrt(inverse[2, 2]) / bars.amplitude
    if p_value_of(float(np.sum((phase / sigma) ** 2)), len(pages) - 1) < FALSE_ALARM:
        moved = float(np.std(phase)) / (2.0 * math.pi * bars.cycles_per_pixel)
        raise BarError(
            f"the bars move by {moved:.2g} px rms from page to page (sigma of a page"
            f" {sigma / (2.0 * math.pi * bars.cycles_per_pixel):.1g} px), which lowers the MTF of their mean by about"
            f" {min(0.5 * float(np.var(phase)), 1.0):.1%}: measure single pages, or hold the target still"
        )


def page_warnings(result: EdgeMtf | BarMtf, step: float) -> list[str]:
    """Return the warnings that follow from comparing pages with each other and with the step of their grey values.

    Parameters
    ----------
    result : EdgeMtf or BarMtf
        Result of `measure_bar_pages` or `edge_pages.measure_pages`.
    step : float
        Step between the grey values of a page; 0 for real numbers.
    """
    if isinstance(result, EdgeMtf):
        assert result.pages is not None
        same, noise = result.pages.same, min(result.pages.noise)
    else:
        assert result.page_noise is not None
        same, noise = result.same, min(result.page_noise)
    out = []
    if isinstance(result, BarMtf) and result.uneven:
        out.append(
            f"the mean level in the bars differs by {result.light:+.1%} from that of the light on the patches (sigma"
            f" {result.light_sigma:.1g}): uneven light, or diffraction at the patches. The MTF has the same relative"
            " error, which sigma includes: use even fields at the position of the bars"
        )
    if same:
        out.append(f"{same} pages are identical to another one and do not count: were they copied?")
    if noise < _ROUGH * step:
        out.append(
            f"the noise of a pixel, {noise:.2g} grey values, is below {_ROUGH:g} of the grey-value step of {step:g}, so"
            " that rounding does not average out over pixels and pages; sigma includes rounding. A higher gain helps"
        )
    if isinstance(result, EdgeMtf) and result.doubt:
        out.append(result.doubt)
    if isinstance(result, EdgeMtf) and result.pages is not None and result.pages.aligned:
        pages = result.pages
        apart = np.abs(pages.position - np.mean(pages.position))
        out.append(
            f"the edge moves from page to page, by {pages.drift:.2g} px rms and {float(apart.max()):.2g} px at most"
            f" (chi-square {pages.chi_square:.4g} for {pages.degrees_of_freedom} degrees of freedom): the pages were"
            " aligned, so that the MTF is that of a single page"
        )
    return out
