"""The shape of a spot learnt from frames of the spot itself, and what the noise of that shape does to a shift.

The mean image without its level is low-passed where it holds more noise than light: a radial Wiener filter of its own
power spectrum, real and even, so that it moves nothing. Noise is what is new in every frame and the pattern of the
pixels, which has all frequencies as well. Beyond the image the shape is zero. What is left of the noise stands in the
covariance of a shift by `learnt_noise`.

The shape is T = L F, with the mean image before F and the linear operations L of learning it. To first order the places
before and after, of influence g1 and g2 on their images F and D, move with noise n of F and m of D by

    e1 = g1 (n - A1 n),     e2 = g2 (m - A2 n),     A = (fitted model of the state) by T, times L,

for the model that is held against an image has noise itself: A is the smeared, interpolated, brightened shape, wherever
the state has one. So the image before has the influence b = g1 - g1 A1 + g2 A2 on the shift, with the sign of a place
before, and the shift's covariance is that of two independent images with the maps b and g2. Where both states are alike
b = g1. Where after is brighter or the middle of its spot is left out the noise of the shape counts for more than that
of the image that it is held against.

The next order counts where a spot is narrow or faint, since learning leaves noise that is as fine as the spot is:

- **Curvature.** The noise's own slopes stand in the normal matrix I as if they were the spot's, with N = sum of
  w cov(n', n'), and the residuals take them off again: the fit has the curvature I - N, and answers by I / (I - N).
- **Lean.** The noise of the shape is least half way between pixels, and pattern of the pixels is in both images: the
  fit is drawn there, by (I - N)^-1 sum of w (cov(n', m) - cov(n', n)). The place is not moved by it; the covariance of
  the shift gets the square of it.

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
from analysis.spots.spot_positions import NoiseParts, SpotError, SpotPositions, noise_parts
from analysis.spots.spot_template import SmearedShape, SpotTemplate

MARGIN_PX = 40
"""By which the shape is larger than the image, so that it can be shifted over it."""
_TAPER_PX = 4
_CORE = 0.05
_LOOKS, _FILLS = 3, 40
"""How often the frequencies of the light are looked for, and steps by which missing pixels are filled with them."""
_UNEVEN = 0.5
"""Rms of a slope, in sigmas of a pixel, from which it is the background's; rings of the spot at the edge make less."""


def without_slopes(screened: ScreenedFrames, noise: NoiseModel) -> ScreenedFrames:
    """Frames of which an uneven background is taken off, by a plane through the pixels at the edge, lest it is learnt
    as the spot's and goes with it; the same where there is none.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of the state that the shape is learnt from.
    noise : NoiseModel
        Of the detector.
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
    told = Finding("uneven background", f"its slopes, {rise}, are taken off before the shape is learnt")
    return replace(screened, mean=mean - slopes, findings=(*screened.findings, told))


def _edge(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    out = np.ones(shape, dtype=bool)
    out[_TAPER_PX:-_TAPER_PX, _TAPER_PX:-_TAPER_PX] = False
    return out


@dataclass(frozen=True, eq=False)
class LearntTemplate:
    """A shape, and what every pixel of the image that it is from has to do with it.

    Attributes
    ----------
    shape : SpotTemplate
        Of the spot.
    light : float
        DN, what the samples that the shape is made of sum to.
    passed : Array
        (H, W) share of each frequency that is kept, in the order of the discrete Fourier transform.
    good : NDArray[np.bool_]
        (H, W) pixels that were used.
    fills : tuple[NDArray[np.bool_], ...]
        (n, H, W) frequencies by which the others were filled, step by step.
    """

    shape: SpotTemplate
    light: float
    passed: Array
    good: NDArray[np.bool_]
    fills: tuple[NDArray[np.bool_], ...]

    def impulse(self, pixel: tuple[int, int]) -> Array:
        """(H, W) what 1 DN in a pixel of the image adds to what is learnt, holes and edges aside.

        Parameters
        ----------
        pixel : tuple[int, int]
            Row and column.
        """
        image = np.zeros(self.good.shape)
        image[pixel] = 1.0
        return _filtered(image, self.passed)

    def returned(self, maps: Array) -> Array:
        """What pixels of the image do to numbers that the shape's samples make: the transpose of learning, (n, H, W).

        Parameters
        ----------
        maps : Array
            (n, M, N) derivatives of the numbers by the samples, which sum to `light`.
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
    """The shape of the spot in one state's frames.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of the state.
    noise : NoiseModel
        Of the detector.

    Raises
    ------
    SpotError
        There is no spot, or one so narrow that pixels do not sample it.
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
    # holes that are not filled to the last leave noise of all frequencies, which no light is
    if np.all(screened.good) and (passed[light.shape[0] // 2, 0] > 0.0 or passed[0, light.shape[1] // 2] > 0.0):
        raise SpotError({0: "too narrow: a light with detail finer than two pixels has no shape between pixels"})
    light = _filtered(light, passed)
    wide = np.pad(light * _taper(light.shape), MARGIN_PX)
    core = np.where(wide > _CORE * wide.max(), wide, 0.0)
    row = float(core.sum(axis=1) @ np.arange(wide.shape[0]) / core.sum())
    column = float(core.sum(axis=0) @ np.arange(wide.shape[1]) / core.sum())
    share = math.sqrt(float(np.median(noise.temporal_variance_dn2(image, 1) / screened.counts))) / float(peak[0])
    shape = SpotTemplate.from_image(wide, row, column, light.shape, tolerance=min(0.1 * share, 1e-3))
    return LearntTemplate(shape, float(wide.sum()), passed, screened.good, fills)


def _taper(shape: tuple[int, ...]) -> Array:
    """1 inside, falling to 0 at the edge like a raised cosine."""
    parts = []
    for size in shape:
        away = np.minimum(np.arange(size) + 1, size - np.arange(size)) / (_TAPER_PX + 1.0)
        parts.append(0.5 - 0.5 * np.cos(np.pi * np.minimum(away, 1.0)))
    return np.outer(*parts)


def _filtered(image: Array, passed: NDArray[Any]) -> Array:
    """Images (..., H, W) in the share of each frequency that is passed."""
    return np.asarray(np.real(np.fft.ifft2(np.fft.fft2(image) * passed)))


def _completed(light: Array, good: NDArray[np.bool_], variance: Array) -> tuple[Array, tuple[NDArray[np.bool_], ...]]:
    """The image with its holes filled by what the light in the other pixels says, which optics let through up to a
    frequency only: the hole takes the value of the low-passed image again and again (Papoulis, IEEE Trans. Circuits
    Syst. 22, 735 (1975); Gerchberg, Opt. Acta 21, 709 (1974)). With the frequencies of each look.
    """
    fills = []
    frequency = np.hypot(np.fft.fftfreq(light.shape[0])[:, None], np.fft.fftfreq(light.shape[1])[None, :])
    ring = np.rint(frequency * min(light.shape)).astype(np.intp)
    for _ in range(_LOOKS):
        # holes that are not filled well yet make noise of all frequencies
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
    """(H, W) share of each frequency that is kept: those in which the image stands above its noise."""
    power = np.abs(np.fft.fft2(light)) ** 2
    floor = float(variance.sum())
    frequency = np.hypot(np.fft.fftfreq(light.shape[0])[:, None], np.fft.fftfreq(light.shape[1])[None, :])
    ring = np.rint(frequency * min(light.shape)).astype(np.intp)
    mean = np.bincount(ring.ravel(), power.ravel()) / np.maximum(np.bincount(ring.ravel()), 1)
    # beyond the optics' cut-off there is nothing: the first rings that are noise end it
    noisy = np.flatnonzero(mean < 2.0 * floor)
    last = int(noisy[0]) if noisy.size else mean.size
    gain = np.clip(1.0 - floor / np.maximum(mean, 1e-300), 0.0, 1.0)
    gain[last:] = 0.0
    return np.asarray(gain[ring])


_LEAST = 0.4
"""Least share of the normal matrix that is no noise, in any direction: below it the theory, which is of first order in
that, ends."""


@dataclass(frozen=True, eq=False)
class FittedSpot:
    """One spot in one state, to which the learnt shape was fitted.

    Attributes
    ----------
    positions : SpotPositions
        Of the spot in its image, with their maps.
    counts : Array
        (H, W) frames that each pixel is the mean of.
    jitter : Array
        (2, 2) px^2, what movement between frames adds to the covariance of the place.
    others : Array
        (G, 3) row, column (px) and share of the light of what else was fitted with the same shape.
    smear : Array
        (2, 2) px^2 by which the shape was smeared.
    offset : tuple[int, int]
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
        """(2, H, W) px/DN."""
        assert self.positions.gain_maps is not None
        return self.positions.gain_maps[0]

    @property
    def light(self) -> Array:
        """(H, W) DN."""
        assert self.positions.light_dn is not None
        return self.positions.light_dn[0]

    def temporal(self, noise: NoiseModel) -> Array:
        """(H, W) DN^2, variance of the mean by what is new in every frame."""
        return np.asarray(noise.temporal_variance_dn2(self.light + noise.dark_level_dn, 1) / self.counts)

    def fixed(self, noise: NoiseModel) -> Array:
        """(H, W) DN^2, variance by the detector's pattern."""
        return np.asarray(noise.fixed_variance_dn2(self.light + noise.dark_level_dn))


@dataclass(frozen=True, eq=False)
class LearntShift:
    """What noise does to after - before.

    Attributes
    ----------
    covariance : Array
        (2, 2) px^2.
    lean : Array
        (2,) px, by which the fit is drawn, and which stands in the covariance.
    parts : tuple[NoiseParts, NoiseParts]
        Of images before and after, for the covariance of several shifts against the same image before. What this one
        does differs from shift to shift, and stands in those after.
    """

    covariance: Array
    lean: Array
    parts: tuple[NoiseParts, NoiseParts]


def learnt_shift(
    learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, noise: NoiseModel, ccd: tuple[int, int]
) -> LearntShift:
    """Noise of one spot's shift.

    Parameters
    ----------
    learnt : LearntTemplate
        The shape.
    before : FittedSpot
        The spot in the image that it was learnt from.
    after : FittedSpot
        The same spot in another one.
    noise : NoiseModel
        Of the detector.
    ccd : tuple[int, int]
        (H, W) of the detector.

    Raises
    ------
    SpotError
        The shape is mostly noise.
    """
    more, lean = _second_order(learnt, before, after, noise)
    own = np.tensordot(more, after.maps, 1)
    maps = before.maps - _by_image(learnt, before, before.maps) + _by_image(learnt, after, own)
    temporal = before.temporal(noise)
    new = after.jitter + _spread(own, after.temporal(noise)) + before.jitter
    brought = maps * np.sqrt(temporal)
    first = _on_ccd(before, maps, ccd)
    second = _on_ccd(after, own, ccd)
    pattern = noise_parts(second, noise).pattern - noise_parts(first, noise).pattern
    whole = np.concatenate([pattern[0], brought.reshape(2, -1), lean[:, None]], axis=1)
    parts = (
        NoiseParts(before.jitter[None], np.zeros((1, *whole.shape), np.float32)),
        NoiseParts((new - before.jitter)[None], whole.astype(np.float32)[None]),
    )
    fixed = pattern[0].astype(np.float64)
    covariance = new + _spread(maps, temporal) + fixed @ fixed.T + np.outer(lean, lean)
    return LearntShift(covariance, lean, parts)


def _spread(maps: Array, variance: Array) -> Array:
    flat = maps.reshape(2, -1)
    return np.asarray((flat * variance.ravel()) @ flat.T)


def _shape_of(learnt: LearntTemplate, spot: FittedSpot) -> SpotTemplate:
    height, width = spot.light.shape
    return replace(learnt.shape, shape=(height, width))


def _by_image(learnt: LearntTemplate, spot: FittedSpot, maps: Array) -> Array:
    """(2, H, W) what the pixels of the image before do to the fitted model of a state, and that to numbers of which the
    derivatives by the state's image are ``maps``.
    """
    shape = SmearedShape(_shape_of(learnt, spot))
    place, flux = spot.positions.position[0], float(spot.positions.flux[0])
    lights = np.vstack([[*place, 1.0], spot.others])
    back = sum(share * shape.returned(maps, row, column, spot.smear) for row, column, share in lights)
    return learnt.returned(np.asarray(back) * (flux / learnt.light))


def _second_order(
    learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, noise: NoiseModel
) -> tuple[Array, Array]:
    """What the answer of the fit is more than the normal matrix says, (2, 2), and lean (2,) px."""
    ratio = float(after.positions.flux[0]) / learnt.light
    # of a pixel at the spot
    at = np.rint(before.positions.position[0]).astype(np.intp)
    middle = int(at[0]), int(at[1])
    kernel = _kernel(learnt, before, after, middle)
    weight = _weight(after, noise)
    brought = before.temporal(noise) + before.fixed(noise)
    # sum over pixels of the model and of the image: of each difference of place how much there is
    size = weight.shape
    meets = signal.fftconvolve(weight, brought[::-1, ::-1], mode="full")
    rows, columns = (slice(n - 1 - m, n - 1 - m + k) for n, m, k in zip(brought.shape, middle, size, strict=True))
    meets = np.maximum(meets[rows, columns], 0.0)
    own = ratio**2 * np.einsum("ipq,pq,pq->i", kernel[1:], kernel[0], meets)
    slopes = ratio**2 * np.einsum("ipq,jpq,pq->ij", kernel[1:], kernel[1:], meets)
    shared = ratio * _shared(kernel[1:], weight, before, after, noise, middle)
    information = np.linalg.inv(after.positions.covariance[0] - after.jitter)
    left = information - slopes
    root = np.linalg.inv(np.linalg.cholesky(information))
    if np.linalg.eigvalsh(root @ left @ root.T).min() < _LEAST:
        raise SpotError({0: "the shape that the frames before show is mostly noise"})
    return np.linalg.solve(left, information), np.linalg.solve(left, shared - own)


def _weight(spot: FittedSpot, noise: NoiseModel) -> Array:
    """(H, W) 1/DN^2; 0 where a pixel was left out."""
    used = np.any(spot.maps != 0.0, axis=0)
    return np.asarray(np.where(used, 1.0 / (spot.temporal(noise) + spot.fixed(noise)), 0.0))


def _kernel(learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, pixel: tuple[int, int]) -> Array:
    """(3, H, W) what a pixel of the image before does to the state's model for equal light, and the derivatives of that
    by the place.
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
    """(2,) sum of weight and covariance of the model's slopes with the image, by the pattern of the pixels in both."""
    # a pixel of the detector stands here in both images
    rows, columns = (slice(max(a, b), None) for a, b in zip(before.offset, after.offset, strict=True))
    one = before.light[rows.start - before.offset[0] :, columns.start - before.offset[1] :]
    two = after.light[rows.start - after.offset[0] :, columns.start - after.offset[1] :]
    own = weight[rows.start - after.offset[0] :, columns.start - after.offset[1] :]
    height, width = (min(sizes) for sizes in zip(one.shape, two.shape, strict=True))
    pattern = noise.prnu**2 * one[:height, :width] * two[:height, :width] + noise.dsnu_variance_dn2
    at = tuple(m + b - a for m, b, a in zip(middle, before.offset, after.offset, strict=True))
    if not all(0 <= k < n for k, n in zip(at, weight.shape, strict=True)):
        return np.zeros(2)
    return np.asarray(slopes[:, at[0], at[1]] * float((own[:height, :width] * pattern).sum()))


def _on_ccd(spot: FittedSpot, maps: Array, ccd: tuple[int, int]) -> SpotPositions:
    """Positions of which maps and light are those of the whole detector."""
    gain, light = np.zeros((1, 2, *ccd)), np.zeros((1, *ccd))
    rows, columns = (slice(a, a + n) for a, n in zip(spot.offset, spot.light.shape, strict=True))
    gain[0, :, rows, columns], light[0, rows, columns] = maps, spot.light
    return replace(spot.positions, gain_maps=gain, light_dn=light)
