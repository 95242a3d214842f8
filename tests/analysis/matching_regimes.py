"""Pairs of images with known displacement, of regimes that mislead matching: what runs along one direction, what is
fixed to the pixels, what moves otherwise than the ground.

A scene is drawn on a grid of a quarter of a pixel without a limit of its frequencies, blurred by a lens and integrated
over pixels, so that edges alias as a camera's do. Displacements are whole steps of the grid: exact.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from tests.analysis.stereo_pairs import Pair

_UP, _PAD, _LENS = 4, 8, 0.45
"""Grid steps to a pixel; pixels about the image; rms of the lens, px."""
SHIFT = (0.25, -0.5)
"""Of the second image, rows and columns, px: multiples of a quarter."""


@dataclass(frozen=True)
class Regime:
    """What a pair shows; grey values in DN about 1000.

    Attributes:
        kind: ground, stripes or checks.
        period: of stripes and checks, px.
        texture: rms of the random texture.
        noise: of each image.
        prnu: relative response of the pixels, rms, the same in both images.
        quality: of JPEG, of 8 bit from 300 to 2000; None for none.
    """

    kind: str = "ground"
    period: float = 20.0
    texture: float = 20.0
    noise: float = 8.0
    prnu: float = 0.0
    quality: int | None = None


def pair_of(regime: Regime, seed: int, size: int = 320) -> Pair:
    """Return a pair of images (size, size) with points 34 px apart."""
    rng = np.random.default_rng(seed)
    count = (size + 2 * _PAD) * _UP
    row, column = np.mgrid[:count, :count] / _UP
    wave = [np.where(np.sin(2.0 * np.pi * (x + 0.01) / regime.period) > 0.0, 200.0, -200.0) for x in (row, column)]
    drawn = {"ground": 0.0, "stripes": wave[1], "checks": wave[0] * wave[1] / 200.0}[regime.kind]
    scene = 1000.0 + drawn + regime.texture * _texture(count, rng, 1.2)
    step = np.arange(24, size - 24, 34)
    places = np.stack([g.ravel() for g in np.meshgrid(step, step, indexing="ij")], axis=1)
    places = (places + rng.integers(-6, 7, places.shape)).astype(float)
    response = 1.0 + regime.prnu * rng.standard_normal((size, size))
    images = [_recorded(regime, response * _pixels(scene, shift, size), rng) for shift in ((0.0, 0.0), SHIFT)]
    return Pair(*images, places, places - SHIFT)


def _texture(count: int, rng: np.random.Generator, slope: float) -> np.ndarray:
    """Random texture (count, count) of rms 1 whose amplitudes fall with the frequency, beyond the sampling limit."""
    frequency = _UP * np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(count)], indexing="ij"))
    gain = np.maximum(frequency, 0.02) ** -slope * np.exp(-0.5 * (frequency / 0.6) ** 2)
    out = np.fft.ifft2(gain * np.fft.fft2(rng.standard_normal((count, count)))).real
    return out / out.std()


def _pixels(fine: np.ndarray, shift: tuple[float, float], size: int) -> np.ndarray:
    """Image (size, size) through lens and pixels of full fill, displaced by rows and columns."""
    soft = ndimage.gaussian_filter(fine, _LENS * _UP)
    first, left = (round((_PAD + by) * _UP) for by in shift)
    cut = soft[first : first + size * _UP, left : left + size * _UP]
    return cut.reshape(size, _UP, size, _UP).mean(axis=(1, 3))


def _recorded(regime: Regime, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy = image + regime.noise * rng.standard_normal(image.shape)
    if regime.quality is None:
        return noisy
    whole = np.clip(np.rint((noisy - 300.0) / 1700.0 * 255.0), 0.0, 255.0).astype(np.uint8)
    _, file = cv2.imencode(".jpg", whole, [cv2.IMWRITE_JPEG_QUALITY, regime.quality])
    return cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)


REGIMES = {
    "stripes, texture 10": Regime("stripes", texture=10),
    "checks of 12 px, noise 4": Regime("checks", 12.0, noise=4.0),
    "PRNU of 1%, noise 4": Regime(texture=60.0, noise=4, prnu=0.01),
    "JPEG 30": Regime(texture=100.0, quality=30),
    "JPEG 30 of little texture": Regime(texture=30.0, quality=30),
}
"""Name -> regime."""
