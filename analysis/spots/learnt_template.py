"""Spot shape learnt from frames of the spot itself, and the effect of its noise on a measured shift.

The mean image without its level is low-passed where it contains more noise than light: a radial Wiener filter of its
own power spectrum, real and even, so that it shifts nothing. The noise comprises temporal noise and the pixels' fixed
pattern, which has all frequencies as well. Beyond the image the shape is zero. The remaining noise enters the
covariance of a shift (`learnt_shift`).

The shape is T = L F, with the mean image before F and the linear operations L of learning it. To first order the
positions before and after, of influence g1 and g2 on their images F and D, move with noise n of F and m of D by

    e1 = g1 (n - A1 n),     e2 = g2 (m - A2 n),     A = (fitted model of the state) by T, times L,

since the model that is compared with an image is noisy itself: A is the smeared, interpolated and scaled shape of the
state. The image before therefore has the influence b = g1 - g1 A1 + g2 A2 on the shift, with the sign of a position
before, and the shift's covariance is that of two independent images with the maps b and g2. Where both states are
alike, b = g1. Where the spot after is brighter, or its middle is excluded, the noise of the shape counts for more than
that of the image that it is compared with.

The next order matters where a spot is narrow or faint, since learning leaves noise that is as fine as the spot is:

- **Curvature.** The slopes of the noise itself enter the normal matrix I as if they were the spot's, with N = sum of
  w cov(n', n'), and the residuals subtract them again: the fit has the curvature I - N, and responds by I / (I - N).
- **Bias.** The noise of the shape is least half way between pixels, and the pixels' fixed pattern is in both images:
  the fit is biased towards these positions by (I - N)^-1 sum of w (cov(n', m) - cov(n', n)). The position is not
  corrected for it; the covariance of the shift contains its square.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from analysis.arrays import Array
from analysis.spots import spot_image
from analysis.spots.frame_screening import Finding, ScreenedFrames
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_image import NoiseParts, SpotError, SpotPositions, noise_parts
from analysis.spots.spot_template import SmearedShape, SpotTemplate

MARGIN_PX = 40
"""Margin by which the shape is larger than the image on every side, px, so that it can be shifted over it."""
_TAPER_PX = 4
_CORE = 0.05
_LOOKS, _FILLS = 3, 40
"""Numbers of iterations that fill missing pixels from a band-limited image.

The first is the number of estimates of the band of the light's frequencies, the second the number of fillings with
each.
"""
_UNEVEN = 0.5
"""Rms of an image's slopes, in sigmas of a pixel, from which on they belong to the background.

Diffraction rings of the spot make smaller slopes.
"""


def without_slopes(screened: ScreenedFrames, noise: NoiseModel) -> ScreenedFrames:
    """Return the frames with a sloping background subtracted; the same frames if there is none.

    The slopes are those of a plane through the pixels at the edge. Otherwise they would be learnt as part of the spot
    and move with it.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of the state that the shape is learnt from.
    noise : NoiseModel
        Noise of the detector.
    """
    mean = screened.mean
    edge = _edge(mean.shape) & screened.good
    v, u = np.meshgrid(*(np.linspace(-1.0, 1.0, size) for size in mean.shape), indexing="ij")
    basis = np.stack([np.ones(np.count_nonzero(edge)), v[edge], u[edge]], axis=1)
    if len(basis) < 10 * basis.shape[1]:
        return screened
    level, down, right = np.linalg.lstsq(basis, mean[edge], rcond=None)[0]
    slopes = down * v + right * u
    variance = noise.temporal_variance_dn2(float(level), 1) / np.median(screened.counts)
    variance += noise.fixed_variance_dn2(float(level))
    if float(np.mean(slopes[edge] ** 2)) < _UNEVEN**2 * float(variance):
        return screened
    rise = f"{np.ptp(slopes):.2g} DN between the corners"
    finding = Finding("uneven background", f"slopes, {rise}, subtracted before the shape is learnt")
    return replace(screened, mean=mean - slopes, findings=(*screened.findings, finding))


def _edge(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    out = np.ones(shape, dtype=bool)
    out[_TAPER_PX:-_TAPER_PX, _TAPER_PX:-_TAPER_PX] = False
    return out


@dataclass(frozen=True, eq=False)
class LearntTemplate:
    """Learnt spot shape, with the linear operator that relates it to the image that it was learnt from.

    Dimensions: H rows, W columns.

    Attributes
    ----------
    shape : SpotTemplate
        Shape of the spot.
    light : float
        Sum of the samples that the shape is made of, DN.
    passed : (H, W) ndarray
        Transmission of the filter at each frequency, in the order of the discrete Fourier transform.
    good : (H, W) ndarray of bool
        Pixels that were used.
    fills : tuple of (H, W) ndarrays of bool
        Frequencies by which the missing pixels were filled, one mask for each pass.
    """

    shape: SpotTemplate
    light: float
    passed: Array
    good: NDArray[np.bool_]
    fills: tuple[NDArray[np.bool_], ...]

    def impulse(self, pixel: tuple[int, int]) -> Array:
        """Return the learnt image, (H, W) DN, of one pixel of 1 DN, ignoring missing pixels and edges.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        pixel : tuple of int
            Row and column of the pixel.
        """
        image = np.zeros(self.good.shape)
        image[pixel] = 1.0
        return _filtered(image, self.passed)

    def returned(self, maps: Array) -> Array:
        """Return the derivatives of n quantities with respect to the pixels of the learnt image, (n, H, W).

        The learnt image is the one from which the shape was learnt.

        They are the given derivatives with respect to the shape's samples times the (transposed) linear operation of
        learning.

        Dimensions: H rows, W columns, M rows of shape samples, N columns of shape samples.

        Parameters
        ----------
        maps : (n, M, N) ndarray
            Derivatives of n quantities with respect to the shape's samples, which sum to `light`.
        """
        inner = maps[:, MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] * _taper(self.good.shape)
        out = _filtered(inner, self.passed)
        if np.all(self.good):
            return out
        known = np.where(self.good, out, 0.0)
        hole = out - known
        for passed in reversed(self.fills):
            for _ in range(_FILLS):
                hole = _filtered(hole, passed)
                known += np.where(self.good, hole, 0.0)
                hole = np.where(self.good, 0.0, hole)
        return known


def learn_template(screened: ScreenedFrames, noise: NoiseModel) -> LearntTemplate:
    """Learn the shape of the spot from one state's frames.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of the state.
    noise : NoiseModel
        Noise of the detector.

    Raises
    ------
    SpotError
        There is no spot, or it is so narrow that the pixels undersample it.
    """
    image = spot_image.filled(screened.mean, screened.good)
    frames = max(int(np.median(screened.counts)), 1)
    _, _, background, peak, _ = spot_image.coarse(image[None], frames, noise)
    edge = _edge(image.shape)
    level = float(np.median(image[edge & screened.good])) if np.any(edge & screened.good) else float(background[0])
    variance = noise.temporal_variance_dn2(image, 1) / screened.counts + noise.fixed_variance_dn2(image)
    light = image - level
    fills: tuple[NDArray[np.bool_], ...] = ()
    if not np.all(screened.good):
        light, fills = _completed(light, screened.good, variance)
    passed = _passed(light, variance)
    # missing pixels that are not filled completely leave noise of all frequencies
    if np.all(screened.good) and (passed[light.shape[0] // 2, 0] > 0.0 or passed[0, light.shape[1] // 2] > 0.0):
        raise SpotError({0: "too narrow: a spot with detail finer than two pixels cannot be interpolated"})
    light = _filtered(light, passed)
    wide = np.pad(light * _taper(light.shape), MARGIN_PX)
    core = np.where(wide > _CORE * wide.max(), wide, 0.0)
    row = float(core.sum(axis=1) @ np.arange(wide.shape[0]) / core.sum())
    column = float(core.sum(axis=0) @ np.arange(wide.shape[1]) / core.sum())
    share = math.sqrt(float(np.median(noise.temporal_variance_dn2(image, 1) / screened.counts))) / float(peak[0])
    shape = SpotTemplate.from_image(wide, row, column, light.shape, tolerance=min(0.1 * share, 1e-3))
    return LearntTemplate(shape, float(wide.sum()), passed, screened.good, fills)


def _taper(shape: tuple[int, ...]) -> Array:
    """Return a window of an image's size that is 1 inside and falls to 0 at the edge as a raised cosine."""
    parts = []
    for size in shape:
        away = np.minimum(np.arange(size) + 1, size - np.arange(size)) / (_TAPER_PX + 1.0)
        parts.append(0.5 - 0.5 * np.cos(np.pi * np.minimum(away, 1.0)))
    return np.outer(*parts)


def _filtered(image: Array, passed: NDArray[Any]) -> Array:
    """Return images (..., H, W) multiplied by a transmission in the frequency domain.

    Dimensions: H rows, W columns.
    """
    return np.asarray(np.real(np.fft.ifft2(np.fft.fft2(image) * passed)))


def _completed(light: Array, good: NDArray[np.bool_], variance: Array) -> tuple[Array, tuple[NDArray[np.bool_], ...]]:
    """Return the image with missing pixels filled from the others, and the masks of frequencies that each pass used.

    Optics transmit light up to a cut-off frequency only: missing pixels repeatedly take the values of the low-passed
    image (Papoulis, IEEE Trans. Circuits Syst. 22, 735 (1975); Gerchberg, Opt. Acta 21, 709 (1974)).
    """
    fills = []
    frequency = np.hypot(np.fft.fftfreq(light.shape[0])[:, None], np.fft.fftfreq(light.shape[1])[None, :])
    ring = np.rint(frequency * min(light.shape)).astype(np.intp)
    for _ in range(_LOOKS):
        # missing pixels that are not filled well yet make noise of all frequencies
        power = np.abs(np.fft.fft2(light)) ** 2
        middle = np.array([np.median(power[ring == k]) for k in range(int(ring.max()) + 1)])
        noise = max(float(variance.sum()), 2.0 * float(np.median(middle[3 * middle.size // 4 :])))
        dark = np.flatnonzero(middle < 2.0 * noise)
        passed = ring < (int(dark[0]) if dark.size else middle.size)
        for _ in range(_FILLS):
            light = np.where(good, light, _filtered(light, passed))
        fills.append(passed)
    return light, tuple(fills)


def _passed(light: Array, variance: Array) -> Array:
    """Return the filter's transmission at each frequency, (H, W): high where the image exceeds its noise.

    Dimensions: H rows, W columns.
    """
    power = np.abs(np.fft.fft2(light)) ** 2
    floor = float(variance.sum())
    frequency = np.hypot(np.fft.fftfreq(light.shape[0])[:, None], np.fft.fftfreq(light.shape[1])[None, :])
    ring = np.rint(frequency * min(light.shape)).astype(np.intp)
    mean = np.bincount(ring.ravel(), power.ravel()) / np.maximum(np.bincount(ring.ravel()), 1)
    # the optics pass no light beyond their cut-off: the first ring that is noise ends the band
    noisy = np.flatnonzero(mean < 2.0 * floor)
    last = int(noisy[0]) if noisy.size else mean.size
    gain = np.clip(1.0 - floor / np.maximum(mean, 1e-300), 0.0, 1.0)
    gain[last:] = 0.0
    return np.asarray(gain[ring])


_LEAST = 0.4
"""Smallest fraction of the normal matrix that is not noise, in any direction, for which the first-order theory holds.
"""


@dataclass(frozen=True, eq=False)
class FittedSpot:
    """Spot in one state of the instrument, with the learnt shape fitted to its image.

    Dimensions: H rows, W columns, G further spots.

    Attributes
    ----------
    positions : SpotPositions
        Position of the spot in its image, with influence maps.
    counts : (H, W) ndarray
        Number of frames averaged in each pixel.
    jitter : (2, 2) ndarray
        Covariance that movement between frames adds to the position, px^2.
    others : (G, 3) ndarray
        Row, column (px) and relative light of further spots that were fitted with the same shape.
    smear : (2, 2) ndarray
        Second moments by which the shape was smeared, px^2.
    offset : tuple of int
        Row and column of the detector at which the image begins.
    """

    positions: SpotPositions
    counts: Array
    jitter: Array
    others: Array
    smear: Array
    offset: tuple[int, int] = (0, 0)

    @property
    def maps(self) -> Array:
        """Derivatives of the position's row and column with respect to each pixel, (2, H, W) px/DN.

        Dimensions: H rows, W columns.
        """
        assert self.positions.gain_maps is not None
        return self.positions.gain_maps[0]

    @property
    def light(self) -> Array:
        """Expected light signal, (H, W) DN.

        Dimensions: H rows, W columns.
        """
        assert self.positions.light_dn is not None
        return self.positions.light_dn[0]

    def temporal(self, noise: NoiseModel) -> Array:
        """Return the variance of the mean image due to temporal noise, (H, W) DN^2.

        Dimensions: H rows, W columns.
        """
        return np.asarray(noise.temporal_variance_dn2(self.light + noise.dark_level_dn, 1) / self.counts)

    def fixed(self, noise: NoiseModel) -> Array:
        """Return the variance of each pixel due to the detector's fixed pattern, (H, W) DN^2.

        Dimensions: H rows, W columns.
        """
        return np.asarray(noise.fixed_variance_dn2(self.light + noise.dark_level_dn))


@dataclass(frozen=True, eq=False)
class LearntShift:
    """Noise of a shift (after - before) that was measured with a learnt shape.

    Attributes
    ----------
    covariance : (2, 2) ndarray
        Covariance of the shift, px^2.
    fit_bias : (2,) ndarray
        Bias of the shift, px: the fit is drawn towards positions half way between pixels; its square is in the
        covariance.
    parts : tuple of NoiseParts
        Noise of the images before and after, for the covariance of several shifts against the same image before. The
        contribution of the image before differs from shift to shift and is therefore in the part after.
    """

    covariance: Array
    fit_bias: Array
    parts: tuple[NoiseParts, NoiseParts]


def learnt_shift(
    learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, noise: NoiseModel, ccd: tuple[int, int]
) -> LearntShift:
    """Compute the covariance and bias of one spot's shift that was measured with a learnt shape.

    Parameters
    ----------
    learnt : LearntTemplate
        Shape of the spot.
    before : FittedSpot
        Spot in the image that the shape was learnt from.
    after : FittedSpot
        The same spot in another image.
    noise : NoiseModel
        Noise of the detector.
    ccd : tuple of int
        Rows and columns (H, W) of the detector.

    Raises
    ------
    SpotError
        The shape is mostly noise.
    """
    gain, fit_bias = _second_order(learnt, before, after, noise)
    after_maps = np.tensordot(gain, after.maps, 1)
    maps = before.maps - _by_image(learnt, before, before.maps) + _by_image(learnt, after, after_maps)
    temporal = before.temporal(noise)
    new = after.jitter + _spread(after_maps, after.temporal(noise)) + before.jitter
    variance_root = maps * np.sqrt(temporal)
    first = _on_ccd(before, maps, ccd)
    second = _on_ccd(after, after_maps, ccd)
    pattern = noise_parts(second, noise).pattern - noise_parts(first, noise).pattern
    whole = np.concatenate([pattern[0], variance_root.reshape(2, -1), fit_bias[:, None]], axis=1)
    parts = (
        NoiseParts(before.jitter[None], np.zeros((1, *whole.shape), np.float32)),
        NoiseParts((new - before.jitter)[None], whole.astype(np.float32)[None]),
    )
    fixed = pattern[0].astype(np.float64)
    covariance = new + _spread(maps, temporal) + fixed @ fixed.T + np.outer(fit_bias, fit_bias)
    return LearntShift(covariance, fit_bias, parts)


def _spread(maps: Array, variance: Array) -> Array:
    flat = maps.reshape(2, -1)
    return np.asarray((flat * variance.ravel()) @ flat.T)


def _shape_of(learnt: LearntTemplate, spot: FittedSpot) -> SpotTemplate:
    height, width = spot.light.shape
    return replace(learnt.shape, shape=(height, width))


def _by_image(learnt: LearntTemplate, spot: FittedSpot, maps: Array) -> Array:
    """Return the derivatives of a position with respect to the image that the shape was learnt from, (2, H, W).

    That image acts on the position through the shape in the fitted model. ``maps`` are the derivatives of the
    position's row and column with respect to the model.

    Dimensions: H rows, W columns.
    """
    shape = SmearedShape(_shape_of(learnt, spot))
    position, flux = spot.positions.position[0], float(spot.positions.flux[0])
    lights = np.vstack([[*position, 1.0], spot.others])
    derivatives = sum(share * shape.returned(maps, row, column, spot.smear) for row, column, share in lights)
    return learnt.returned(np.asarray(derivatives) * (flux / learnt.light))


def _second_order(
    learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, noise: NoiseModel
) -> tuple[Array, Array]:
    """Return the second-order effects of the shape's noise on a fit: the factor on its response, and its bias.

    The factor is a matrix (2, 2): ratio of the fit's response to image noise to that which its normal matrix predicts.
    The bias is (2,) px.
    """
    ratio = float(after.positions.flux[0]) / learnt.light
    # kernel of the pixel at the spot's centre
    at = np.rint(before.positions.position[0]).astype(np.intp)
    middle = int(at[0]), int(at[1])
    kernel = _kernel(learnt, before, after, middle)
    weight = _weight(after, noise)
    variance = before.temporal(noise) + before.fixed(noise)
    # correlation of weight and variance: the weighted variance at each difference of positions
    size = weight.shape
    correlation = signal.fftconvolve(weight, variance[::-1, ::-1], mode="full")
    rows, columns = (slice(n - 1 - m, n - 1 - m + k) for n, m, k in zip(variance.shape, middle, size, strict=True))
    correlation = np.maximum(correlation[rows, columns], 0.0)
    shape_noise = ratio**2 * np.einsum("ipq,pq,pq->i", kernel[1:], kernel[0], correlation)
    slopes = ratio**2 * np.einsum("ipq,jpq,pq->ij", kernel[1:], kernel[1:], correlation)
    shared = ratio * _shared(kernel[1:], weight, before, after, noise, middle)
    information = np.linalg.inv(after.positions.covariance[0] - after.jitter)
    curvature = information - slopes
    root = np.linalg.inv(np.linalg.cholesky(information))
    if np.linalg.eigvalsh(root @ curvature @ root.T).min() < _LEAST:
        raise SpotError({0: "the shape learnt from the frames before is mostly noise"})
    return np.linalg.solve(curvature, information), np.linalg.solve(curvature, shared - shape_noise)


def _weight(spot: FittedSpot, noise: NoiseModel) -> Array:
    """Return the weights of a fit, (H, W) 1/DN^2; 0 for excluded pixels.

    Dimensions: H rows, W columns.
    """
    used = np.any(spot.maps != 0.0, axis=0)
    return np.asarray(np.where(used, 1.0 / (spot.temporal(noise) + spot.fixed(noise)), 0.0))


def _kernel(learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, pixel: tuple[int, int]) -> Array:
    """Return the influence of one pixel of the image before on the state's model, and its two slopes, (3, H, W).

    The influence is for equal light; the slopes are its derivatives with respect to the position.

    Dimensions: H rows, W columns.
    """
    wide = np.pad(learnt.impulse(pixel), MARGIN_PX)
    height, width = after.light.shape
    shape = SpotTemplate.from_image(wide, pixel[0] + MARGIN_PX, pixel[1] + MARGIN_PX, (height, width), tolerance=1e-6)
    smeared = SmearedShape(shape)
    row, column = pixel + after.positions.position[0] - before.positions.position[0]
    return np.asarray(smeared.evaluate(smeared.smeared(after.smear), row, column)[:3] * wide.sum())


def _shared(
    slopes: Array, weight: Array, before: FittedSpot, after: FittedSpot, noise: NoiseModel, middle: tuple[int, int]
) -> Array:
    """Return the covariance of the model's slopes with the image's noise due to their common fixed pattern, (2,).

    It is summed over the pixels with the weights of the fit.
    """
    # the same pixels of the detector in both images
    rows, columns = (slice(max(a, b), None) for a, b in zip(before.offset, after.offset, strict=True))
    light_before = before.light[rows.start - before.offset[0] :, columns.start - before.offset[1] :]
    light_after = after.light[rows.start - after.offset[0] :, columns.start - after.offset[1] :]
    weights = weight[rows.start - after.offset[0] :, columns.start - after.offset[1] :]
    height, width = (min(sizes) for sizes in zip(light_before.shape, light_after.shape, strict=True))
    pattern = noise.prnu**2 * light_before[:height, :width] * light_after[:height, :width] + noise.dsnu_variance_dn2
    at = tuple(m + b - a for m, b, a in zip(middle, before.offset, after.offset, strict=True))
    if not all(0 <= k < n for k, n in zip(at, weight.shape, strict=True)):
        return np.zeros(2)
    return np.asarray(slopes[:, at[0], at[1]] * float((weights[:height, :width] * pattern).sum()))


def _on_ccd(spot: FittedSpot, maps: Array, ccd: tuple[int, int]) -> SpotPositions:
    """Return the positions with their derivative maps and light extended from the image to the whole detector."""
    gain, light = np.zeros((1, 2, *ccd)), np.zeros((1, *ccd))
    rows, columns = (slice(a, a + n) for a, n in zip(spot.offset, spot.light.shape, strict=True))
    gain[0, :, rows, columns], light[0, rows, columns] = maps, spot.light
    return replace(spot.positions, gain_maps=gain, light_dn=light)
