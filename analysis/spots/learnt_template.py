"""The calibrated shape of a spot learnt from frames of the spot itself, where its optics are not modelled.

The mean image without its level is low-passed where it holds more noise than light: a radial Wiener filter of its own
power spectrum, real and even, so that it moves nothing. Noise is what is new in every frame and the pattern of the
pixels, which has all frequencies as well. Beyond the image the shape is zero. What is left of the noise stands in the
covariance of a shift by `learnt_noise`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.spots import spot_image
from analysis.spots.frame_screening import Finding, ScreenedFrames
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_positions import SpotError
from analysis.spots.spot_template import SpotTemplate

__all__ = ["MARGIN_PX", "LearntTemplate", "learn_template", "without_slopes"]

Array = NDArray[np.float64]
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

    Args:
        screened: frames of the state that the shape is learnt from.
        noise: of the detector.
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

    Attributes:
        shape: of the spot.
        light: DN, what the samples that the shape is made of sum to.
        passed: (H, W) share of each frequency that is kept, in the order of the discrete Fourier transform.
        good: (H, W) pixels that were used.
        fills: (n, H, W) frequencies by which the others were filled, step by step.
    """

    shape: SpotTemplate
    light: float
    passed: Array
    good: NDArray[np.bool_]
    fills: tuple[NDArray[np.bool_], ...]

    def impulse(self, pixel: tuple[int, int]) -> Array:
        """(H, W) what 1 DN in a pixel of the image adds to what is learnt, holes and edges aside.

        Args:
            pixel: row and column.
        """
        image = np.zeros(self.good.shape)
        image[pixel] = 1.0
        return _filtered(image, self.passed)

    def returned(self, maps: Array) -> Array:
        """What pixels of the image do to numbers that the shape's samples make: the transpose of learning, (n, H, W).

        Args:
            maps: (n, M, N) derivatives of the numbers by the samples, which sum to `light`.
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

    Args:
        screened: frames of the state.
        noise: of the detector.

    Raises:
        SpotError: there is no spot, or one so narrow that pixels do not sample it.
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
    if not (core.sum() > 0.0 and wide.sum() > 0.0):
        raise SpotError({0: "no spot: too little light is left to learn its shape from"})
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
