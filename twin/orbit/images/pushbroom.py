"""Images of the ground that a line camera in orbit records.

Every sample of the ground, several for each pixel, is looked at by the rigorous sensor on the terrain; the transfer
function of lens, pixels and motion takes the samples to the pixels; the detector's model makes frames of them. All of
it runs in strips of lines, and the result does not depend on how it is cut.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import fft

from optics.threads import cores
from twin.orbit.ground.frame import GroundFrame
from twin.orbit.ground.terrain import Terrain
from twin.orbit.ground.texture import Extent
from twin.orbit.images.line_optics import ImageMotion, LineOptics
from twin.orbit.images.look_map import LookMap, SteepTerrainError
from twin.orbit.sensor import Sensor

MARGIN = 24
"""Pixels and lines about a window that its image needs; the point spread function ends there."""
LARGEST_ERROR = 0.002
"""Pixels: of the interpolated places, against the rigorous sensor on the terrain."""
_NEAR = 2
"""Points beyond the samples for cubic interpolation."""
BORDER = MARGIN + _NEAR + 1
"""Lines and pixels between a window and the ends of an image, at least."""
_SAMPLES_AT_ONCE = 4_000_000
_CHECKS = 400


class GroundImage(Protocol):
    """What the ground looks like from above: apparent reflectance at east and north, metres, any equal shapes."""

    def __call__(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Values, of the places' shape."""


@dataclass(frozen=True, eq=False)
class PushbroomScene:
    """What there is to see.

    Attributes:
        frame: coordinates of the ground.
        terrain: heights.
        image: apparent reflectance, light and air included.
    """

    frame: GroundFrame
    terrain: Terrain
    image: GroundImage


@dataclass(frozen=True)
class Window:
    """A part of an image: whole lines and pixels, counted in the image.

    Attributes:
        first_line, first_pixel: of its first sample.
        lines, pixels: its size.
    """

    first_line: int
    first_pixel: int
    lines: int
    pixels: int

    @property
    def middle(self) -> tuple[float, float]:
        """Line and pixel of its middle."""
        return self.first_line + 0.5 * (self.lines - 1), self.first_pixel + 0.5 * (self.pixels - 1)

    def fits(self, sensor: Sensor, margin: int = BORDER) -> bool:
        """Whether it lies inside a sensor's image with the margin that rendering needs."""
        return (
            self.first_line >= margin
            and self.first_pixel >= margin
            and self.first_line + self.lines + margin <= sensor.lines
            and self.first_pixel + self.pixels + margin <= sensor.camera.pixels
        )


@dataclass(frozen=True, eq=False)
class RenderedPatch:
    """Noise-free image of a window.

    Attributes:
        photons: expected photons in every pixel, (lines, pixels).
        window: which pixels.
        motion: of the image in its middle.
        error: largest difference of an interpolated place from the rigorous one on the terrain that was found, pixels.
    """

    photons: np.ndarray
    window: Window
    motion: ImageMotion
    error: float


def look_map(sensor: Sensor, frame: GroundFrame, terrain: Terrain, window: Window) -> LookMap:
    """The looks that an image of a window needs.

    Raises:
        ValueError: the window, with its margin, is not all inside the image.
    """
    if not window.fits(sensor):
        raise ValueError(
            f"a window of {window.lines} lines from {window.first_line} and {window.pixels} pixels from "
            f"{window.first_pixel} does not lie {BORDER} inside the image of {sensor.lines} lines and "
            f"{sensor.camera.pixels} pixels"
        )
    reach = BORDER
    lines = window.first_line - reach, window.first_line + window.lines - 1 + reach
    pixels = window.first_pixel - reach, window.first_pixel + window.pixels - 1 + reach
    return LookMap.prepare(sensor, frame, terrain, lines, pixels)


def extent_of(looks: LookMap, step: int = 16) -> Extent:
    """The ground that looks see, a little enlarged; checks that no slope hides another."""
    (first, last), (left, right), _ = looks.span
    lines, pixels = (np.linspace(a, b, int((b - a) / step) + 2) for a, b in ((first, last), (left, right)))
    east, north, _ = looks.ground(lines, pixels)
    # between two samples the terrain moves the place by less than they lie apart
    spare = max(float(np.max(np.abs(np.diff(v, axis=k)))) for v in (east, north) for k in (0, 1))
    found = Extent(float(east.min()), float(east.max()), float(north.min()), float(north.max()))
    return found.grown(spare)


def require_open(looks: LookMap, extent: Extent) -> None:
    """Refuse terrain that hides a part of itself from the looks.

    Raises:
        SteepTerrainError: a slope that faces away is as steep as the look.
    """
    to_east, to_north = looks.run()
    spacing = min(looks.terrain.surface.spacing)
    east, north = extent.axes(max(0.25 * spacing, extent.side / 2000.0))
    steepest = -np.inf
    for part in (slice(i, i + 256) for i in range(0, len(north), 256)):
        slope_east, slope_north = looks.terrain.slopes(east, north[part])
        steepest = max(steepest, float(np.max(slope_east * to_east + slope_north * to_north)))
    # following the look up by 1 m, the ground below it rises by this much
    if steepest >= 1.0:
        look = np.hypot(to_east, to_north)
        raise SteepTerrainError(
            f"terrain of {np.degrees(np.arctan(steepest / look)):.0f} degrees hides ground from a look that is "
            f"{np.degrees(np.arctan(look)):.0f} degrees off the vertical"
        )


def render_patch(
    sensor: Sensor,
    optics: LineOptics,
    scene: PushbroomScene,
    window: Window,
    oversampling: int = 3,
    looks: LookMap | None = None,
) -> RenderedPatch:
    """Expected photons of a window of an image.

    Args:
        sensor: the true one.
        optics: of its line.
        scene: what there is to see.
        window: which lines and pixels.
        oversampling: samples of the ground along each side of a pixel.
        looks: `look_map` of the same, if it is there already.

    Raises:
        ValueError: a window too near to the image's ends, ground that the scene does not know, or terrain so rough that
            the places cannot be interpolated.
        SteepTerrainError: terrain that hides a part of itself.
    """
    looks = looks or look_map(sensor, scene.frame, scene.terrain, window)
    line, pixel = window.middle
    height = float(looks.ground(np.array([line]), np.array([pixel]))[2][0, 0])
    motion = ImageMotion.of(sensor, line, pixel, height)
    # samples at pixels first, then finer if the terrain asks for it
    for fine in (1, oversampling):
        error = _interpolation_error(sensor, looks, window, oversampling, fine)
        if error <= LARGEST_ERROR:
            break
    else:
        raise ValueError(
            f"terrain so rough that places are {error:.3g} pixels off, more than {LARGEST_ERROR}; take more samples of "
            "a pixel or a smoother terrain"
        )
    kernel = optics.kernel(oversampling, MARGIN, motion)
    count = max(16, int(_SAMPLES_AT_ONCE / oversampling**2 / (window.pixels + 2 * MARGIN)) - 2 * MARGIN)
    count = min(count, max(16, -(-window.lines // cores())))
    photons = np.empty((window.lines, window.pixels))
    scale = optics.photons_per_reflectance

    def strip(start: int) -> None:
        part = Window(window.first_line + start, window.first_pixel, min(count, window.lines - start), window.pixels)
        east, north = _samples(looks, part, oversampling, fine)
        values = scene.image(east, north)
        photons[start : start + part.lines] = scale * _filtered(values, kernel, oversampling, part)

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(strip, range(0, window.lines, count)))
    # a point spread function that a grid of samples cuts off rings by 1e-4 of an edge
    return RenderedPatch(np.maximum(photons, 0.0), window, motion, error)


def _samples(looks: LookMap, window: Window, oversampling: int, fine: int) -> tuple[np.ndarray, np.ndarray]:
    """East and north of all samples of a window with its margin; `fine` places for each pixel are found on the terrain,
    the rest is interpolated with cubics.
    """
    reach = MARGIN + _NEAR
    lines = np.arange((window.lines + 2 * reach - 1) * fine + 1) / fine + (window.first_line - reach)
    pixels = np.arange((window.pixels + 2 * reach - 1) * fine + 1) / fine + (window.first_pixel - reach)
    east, north, _ = looks.ground(lines, pixels)
    cut = slice(_NEAR * fine, -_NEAR * fine)
    if fine == oversampling:
        return east[cut, cut], north[cut, cut]
    # at pixels only: from one before the margin, and to one after
    out = [_spread(_spread(v[1:-1, 1:-1], oversampling, 0), oversampling, 1) for v in (east, north)]
    return out[0], out[1]


def _spread(values: np.ndarray, factor: int, axis: int) -> np.ndarray:
    """Cubic (Lagrange) interpolation to `factor` samples per step along an axis, without the outer steps."""
    v = np.moveaxis(values, axis, 0)
    count = len(v) - 3
    out = np.empty((factor * count + 1, *v.shape[1:]))
    out[::factor] = v[1:-1]
    for k in range(1, factor):
        t = k / factor
        weight = (
            -t * (t - 1.0) * (t - 2.0) / 6.0,
            (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
            -(t + 1.0) * t * (t - 2.0) / 2.0,
            (t + 1.0) * t * (t - 1.0) / 6.0,
        )
        place = out[k::factor]
        np.multiply(v[:count], weight[0], out=place)
        for j in (1, 2, 3):
            place += weight[j] * v[j : j + count]
    return np.moveaxis(out, 0, axis)


def _filtered(values: np.ndarray, kernel: np.ndarray, oversampling: int, window: Window) -> np.ndarray:
    """Samples, with a margin, through the point spread function, at the pixels."""
    # what the ring of a transform brings from the far side falls into the margin alone
    shape = [fft.next_fast_len(n, True) for n in values.shape]
    spectrum = fft.rfft2(values.astype(np.float32, copy=False), s=shape)
    spectrum *= fft.rfft2(kernel.astype(np.float32), s=shape)
    image = fft.irfft2(spectrum, s=shape, overwrite_x=True)
    # the kernel begins at its corner: the image of a sample lies half a kernel later
    first = 2 * MARGIN * oversampling
    lines, pixels = (first + oversampling * np.arange(n) for n in (window.lines, window.pixels))
    return np.asarray(image[lines[0] : lines[-1] + 1 : oversampling, pixels[0] : pixels[-1] + 1 : oversampling])


def _interpolation_error(sensor: Sensor, looks: LookMap, window: Window, oversampling: int, fine: int) -> float:
    """Largest error of places that `_samples` gives, on blocks of the window, pixels: the images of the places on the
    terrain, by the sensor's own way back, against where they were taken.
    """
    random, size = np.random.default_rng(1), 5
    taken, places = [], []
    for _ in range(_CHECKS // size**2):
        line = window.first_line + int(random.integers(max(window.lines - size, 1)))
        pixel = window.first_pixel + int(random.integers(max(window.pixels - size, 1)))
        lines = line + np.arange(-3 * fine, (size + 3) * fine + 1) / fine
        pixels = pixel + np.arange(-3 * fine, (size + 3) * fine + 1) / fine
        east, north, _ = looks.ground(lines, pixels)
        if fine < oversampling:
            east, north = (_spread(_spread(v, oversampling, 0), oversampling, 1) for v in (east, north))
            lines, pixels = (v[1] + np.arange(len(east)) / oversampling for v in (lines, pixels))
        some = random.integers(0, len(lines), (2, size**2))
        taken.append(np.stack([lines[some[0]], pixels[some[1]]]))
        places.append(np.stack([east[some[0], some[1]], north[some[0], some[1]]]))
    (east, north), expected = np.concatenate(places, axis=1), np.concatenate(taken, axis=1)
    found = sensor.image(looks.frame.itrs(east, north, looks.terrain.height(east, north)))
    return float(np.max(np.hypot(found[0] - expected[0], found[1] - expected[1])))
