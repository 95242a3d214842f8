"""Pairs of images with known displacement, of regimes that mislead matching: what runs along one direction, what is
fixed to the pixels, what moves otherwise than the ground.

A scene is drawn on a grid of a quarter of a pixel without a limit of its frequencies, blurred by a lens and integrated
over pixels, so that edges alias as a camera's do. Displacements are whole steps of the grid: exact.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy import ndimage

from tests.analysis.stereo_pairs import Pair

_UP, _PAD, _LENS, _WINDOW = 4, 8, 0.45, 25
"""Grid steps to a pixel; pixels about the image; rms of the lens, px; side of a window of matching, px."""


@dataclass(frozen=True)
class Regime:
    """What a pair shows; grey values in DN about 1000.

    Attributes:
        kind: ground, stripes, checks or edges.
        period: of stripes and checks, px.
        angle: of stripes and checks against the columns, degrees.
        contrast: half step of stripes and checks, step of edges.
        texture: rms of the random texture.
        noise: of each image.
        shift: rows and columns, px, multiples of a quarter.
        prnu: relative response of the pixels, rms, the same in both images; of whole columns if ``columns``.
        columns: whether columns have one response.
        seam: DN by which every second stretch of 40 columns of the second image is brighter.
        bits: of whole numbers from 300 to 2000; None for none.
        quality: of JPEG, with 8 bit; None for none.
        cloud: px by which clouds move against the ground.
    """

    kind: str = "ground"
    period: float = 20.0
    angle: float = 0.0
    contrast: float = 200.0
    texture: float = 20.0
    noise: float = 8.0
    shift: tuple[float, float] = (0.25, -0.5)
    prnu: float = 0.0
    columns: bool = False
    seam: float = 0.0
    bits: int | None = None
    quality: int | None = None
    cloud: float = 0.0


@dataclass(frozen=True, eq=False)
class RegimePair(Pair):
    """A pair, and what else its windows may show.

    Attributes:
        others: (k, n, 2) other places at which the second image shows some of what the window does, NaN for none.
    """

    others: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 2)))

    def error(self, place: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Return errors (n, 2) of places (n, 2) against what they are of: the truth of the least chi-square."""
        errors = place - np.concatenate([self.true[None], self.others])
        with np.errstate(invalid="ignore"):
            square = np.einsum("kni,nij,knj->kn", errors, np.linalg.pinv(np.nan_to_num(covariance)), errors)
        which = np.argmin(np.where(np.isfinite(square), square, np.inf), axis=0)
        return np.take_along_axis(errors, which[None, :, None], axis=0)[0]


def pair_of(regime: Regime, seed: int, size: int = 320) -> RegimePair:
    """Return a pair of images (size, size) with points 34 px apart."""
    rng = np.random.default_rng(seed)
    count = (size + 2 * _PAD) * _UP
    row, column = np.mgrid[:count, :count] / _UP
    scene = 1000.0 + _drawn(regime, row, column, rng) + regime.texture * _texture(count, rng, 1.2)
    step = np.arange(24, size - 24, 34)
    places = np.stack([g.ravel() for g in np.meshgrid(step, step, indexing="ij")], axis=1)
    places = (places + rng.integers(-6, 7, places.shape)).astype(float)
    true, others, second = places - regime.shift, np.zeros((0, len(places), 2)), scene
    if regime.cloud:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        move = np.rint(regime.cloud * np.array([np.cos(angle), np.sin(angle)]) * _UP).astype(int)
        cover = 1.0 / (1.0 + np.exp(-20.0 * (_texture(count, rng, 2.5) - 0.6)))
        bright = 1500.0 + 60.0 * _texture(count, rng, 1.5)
        layers = [(np.roll(cover, by, (0, 1)), np.roll(bright, by, (0, 1))) for by in (np.zeros(2, int), move)]
        scene, second = ((1.0 - share) * scene + share * grey for share, grey in layers)
        share, at = _pixels(layers[0][0], (0.0, 0.0), size), tuple(places.astype(int).T)
        clear, covered = (
            ndimage.maximum_filter(share, _WINDOW)[at] < 0.02,
            ndimage.minimum_filter(share, _WINDOW)[at] > 0.98,
        )
        other = np.where(clear[:, None], np.nan, true + move / _UP)
        true, others = np.where(covered[:, None], other, true), np.where(covered[:, None], np.nan, other)[None]
    first, second = _pixels(scene, (0.0, 0.0), size), _pixels(second, regime.shift, size)
    second = second + regime.seam * (np.arange(size) % 80 > 40)
    response = 1.0 + regime.prnu * rng.standard_normal((1 if regime.columns else size, size))
    images = [_recorded(regime, response * image, rng) for image in (first, second)]
    return RegimePair(*images, places, true, others)


def _drawn(regime: Regime, row: np.ndarray, column: np.ndarray, rng: np.random.Generator) -> np.ndarray | float:
    """Structure of the scene at places in pixels."""
    turn = np.radians(regime.angle)
    along = column * np.cos(turn) + row * np.sin(turn)
    across = row * np.cos(turn) - column * np.sin(turn)
    waves = [np.where(np.sin(2.0 * np.pi * (x + 0.01) / regime.period) > 0.0, 1.0, -1.0) for x in (along, across)]
    if regime.kind == "stripes":
        return regime.contrast * waves[0]
    if regime.kind == "checks":
        return regime.contrast * waves[0] * waves[1]
    if regime.kind == "edges":
        # one straight edge of any direction in each cell of 40 px
        cell = (row // 40).astype(int), (column // 40).astype(int)
        shape = cell[0].max() + 1, cell[1].max() + 1
        angle, off = rng.uniform(0.0, np.pi, shape)[cell], rng.uniform(-4.0, 4.0, shape)[cell]
        return regime.contrast * ((column % 40 - 20) * np.cos(angle) + (row % 40 - 20) * np.sin(angle) > off)
    return 0.0


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
    if regime.bits is None:
        return noisy
    top = 2.0**regime.bits - 1.0
    whole = np.clip(np.rint((noisy - 300.0) / 1700.0 * top), 0.0, top)
    if regime.quality is None:
        return whole.astype(np.uint8 if regime.bits <= 8 else np.uint16)
    _, file = cv2.imencode(".jpg", whole.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, regime.quality])
    return cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)


REGIMES = {
    **{f"stripes of {p} px": Regime("stripes", p) for p in (20, 30, 40, 60)},
    **{f"stripes at {a} deg": Regime("stripes", 23.0, a) for a in (0.3, 1.0, 90.0, 30.0)},
    **{f"stripes, texture {t}": Regime("stripes", texture=t) for t in (10, 40)},
    "stripes, little noise": Regime("stripes", noise=2.0),
    "stripes of little contrast": Regime("stripes", contrast=50.0),
    **{f"checks of {p} px": Regime("checks", p) for p in (20, 40)},
    "checks of 12 px, noise 4": Regime("checks", 12.0, noise=4.0),
    "checks at 0.5 deg": Regime("checks", 24.0, 0.5),
    **{f"edges, texture {t}": Regime("edges", texture=t) for t in (5, 20, 60)},
    **{f"seams of {s}": Regime(texture=60.0, seam=s) for s in (20, 200)},
    **{f"PRNU of {p:.1%}": Regime(noise=4.0, prnu=p) for p in (0.003, 0.01)},
    **{f"PRNU of 1%, noise {n}": Regime(texture=60.0, noise=n, prnu=0.01) for n in (1, 4)},
    "PRNU of columns": Regime(noise=4.0, prnu=0.01, columns=True),
    "PRNU, two pixels off": Regime(noise=4.0, prnu=0.01, shift=(1.25, -2.5)),
    **{f"JPEG {q}": Regime(texture=100.0, bits=8, quality=q) for q in (30, 60, 95)},
    "JPEG 30 of little texture": Regime(texture=30.0, bits=8, quality=30),
    **{f"{b} bit": Regime(texture=60.0, noise=1.0, bits=b) for b in (8, 12, 16)},
    "8 bit of little texture": Regime(noise=0.5, bits=8),
    **{f"clouds by {c} px": Regime(texture=60.0, cloud=c) for c in (2, 4, 10)},
    "texture": Regime(texture=60.0),
    "texture, noise 30": Regime(texture=60.0, noise=30.0),
}
"""Name -> regime."""
