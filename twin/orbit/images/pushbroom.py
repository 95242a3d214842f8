"""Rendering of pushbroom images: ground points that pixels see, and the expected photons of each pixel.

The rigorous sensor is evaluated at Chebyshev nodes over lines, pixels and heights. Between them, east and north are
Chebyshev series, with as many nodes as keep the measured interpolation error below a tolerance. The intersection of a
line of sight with the terrain follows from its east and north over height, by bracketed secant steps.

Every sample of the ground, several for each pixel, is located by the rigorous sensor on the terrain; the samples are
convolved with the point spread function of lens, pixels and motion; the detector's model converts the photons to
frames. The computation is divided into strips of lines, and the result does not depend on this division.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy import fft

from optics.numerics.array_math import PhysicalError, UnphysicalError
from optics.numerics.backend import cores, one_blas_thread
from twin.orbit.flight.sensor import Sensor
from twin.orbit.ground.grid import GroundFrame, Terrain
from twin.orbit.ground.orthophoto import Extent
from twin.orbit.images.line_optics import ImageMotion, LineOptics, exposures, without_jitter

TOLERANCE = 2e-4
"""Largest interpolation error of a line of sight's position at a given height, in metres."""
_COUNTS = (4, 6, 8, 12, 16, 24, 32, 48)
"""Numbers of Chebyshev nodes along lines and along pixels that are tried in turn until the interpolation is accurate.
"""
_JITTERING = (96, 192, 384, 768, 1536)
"""Numbers of nodes along the image lines that are tried where the attitude varies faster than `_COUNTS` can resolve."""
_HEIGHTS = 4
"""Number of nodes over height: a line of sight, in plane coordinates over height, is curved by 3 cm in 500 m at most,
due to the ellipsoid's curvature.
"""
_MET = 1e-4
"""Tolerance of the height difference between a line of sight and the terrain at their intersection, in metres."""
_MOST_STEPS = 40
"""Largest number of secant steps for the intersection of a line of sight with the terrain."""


class SteepTerrainError(PhysicalError, ValueError):
    """Error raised for terrain that is steeper than a line of sight, so that a part of it is hidden."""


@dataclass(frozen=True, eq=False)
class LookMap:
    """Interpolated lines of sight of a part of an image; made by `prepare`.

    Attributes
    ----------
    frame : GroundFrame
        Coordinates of the ground.
    terrain : Terrain
        Terrain of the ground.
    span : (3, 2) ndarray
        First and last line, first and last pixel, lowest and highest height (metres) of the nodes.
    east, north : (heights, K, M) ndarray for K line and M pixel nodes
        Chebyshev coefficients over height, line and pixel, metres.
    error : float
        Largest measured difference to the rigorous sensor between the nodes, metres.
    """

    frame: GroundFrame
    terrain: Terrain
    span: np.ndarray
    east: np.ndarray
    north: np.ndarray
    error: float

    @classmethod
    def prepare(
        cls,
        sensor: Sensor,
        frame: GroundFrame,
        terrain: Terrain,
        lines: tuple[float, float],
        pixels: tuple[float, float],
        tolerance: float = TOLERANCE,
    ) -> LookMap:
        """Interpolate the lines of sight of the part of an image between given lines and pixels, both inclusive.

        Raises
        ------
        ValueError
            The part lies outside the image, a line of sight misses the Earth, or the attitude is too rough.
        """
        low, high = terrain.limits
        span = np.array([lines, pixels, (low - 1.0, high + 1.0)])
        random = np.random.default_rng(0)
        probe = [random.uniform(ends[0], ends[1], 200) for ends in span]
        exact = np.stack(_local(sensor, frame, *probe))
        error = np.inf
        for count, along in [*((n, n) for n in _COUNTS), *((n, _COUNTS[-3]) for n in _JITTERING)]:
            nodes = [_nodes(ends, n) for ends, n in zip(span, (count, along, _HEIGHTS), strict=True)]
            grid = [a.ravel() for a in np.meshgrid(nodes[2], nodes[0], nodes[1], indexing="ij")]
            known = [v.reshape(_HEIGHTS, count, along) for v in _local(sensor, frame, grid[1], grid[2], grid[0])]
            east, north = (_coefficients(v) for v in known)
            interpolation = cls(frame, terrain, span, east, north, error)
            error = float(np.max(np.abs(interpolation._at(*probe) - exact)))
            if error <= tolerance:
                return cls(frame, terrain, span, east, north, error)
        raise UnphysicalError(
            f"the attitude varies too fast: interpolation between {_JITTERING[-1]} nodes along the lines errs by "
            f"{error:.2g} m on the ground, allowed are {tolerance:g} m"
        )

    def ground(self, lines: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return east, north and height of the terrain that L lines and P pixels see, (L, P) each, in metres.

        Raises
        ------
        SteepTerrainError
            The terrain is somewhere as steep as the line of sight.
        """
        with one_blas_thread():
            along = self._basis(0, lines, self.east.shape[1])
            across = self._basis(1, pixels, self.east.shape[2])
            # Convert to polynomials in x, the height over the span, which is -1 at the lowest.
            power = np.zeros((_HEIGHTS, _HEIGHTS))
            for k in range(_HEIGHTS):
                power[k, : k + 1] = chebyshev.cheb2poly([0.0] * k + [1.0])
            east, north = (
                [along @ np.tensordot(power[:, k], c, 1) @ across.T for k in range(_HEIGHTS)]
                for c in (self.east, self.north)
            )
        return self._met(east, north)

    def _met(self, east: list[np.ndarray], north: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Intersect lines of sight, polynomials in the scaled height, with the terrain: east, north, height in m."""
        low, high = self.span[2]
        middle, half = 0.5 * (low + high), 0.5 * (high - low)

        def excess(h: np.ndarray) -> np.ndarray:
            x = (h - middle) / half
            return self.terrain.height(_horner(east, x), _horner(north, x)) - h

        # The terrain lies between the span's ends, so that an intersection lies between `below` and `above`.
        below, above = np.full(east[0].shape, low), np.full(east[0].shape, high)
        before, excess_before = np.full(east[0].shape, middle), excess(np.full(east[0].shape, middle))
        height = before + excess_before
        for k in range(_MOST_STEPS):
            now = excess(height)
            if np.max(np.abs(now)) <= _MET:
                x = (height - middle) / half
                return _horner(east, x), _horner(north, x), height
            np.copyto(below, height, where=now > 0.0)
            np.copyto(above, height, where=now < 0.0)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = height - now * (height - before) / (now - excess_before)
            if k % 4 == 3:  # secants alone may creep toward the intersection from one side
                step[np.abs(now) > 1.0] = np.nan
            inside = (step > below) & (step < above)
            arrived = np.abs(now) <= _MET
            following = np.where(inside, step, 0.5 * (below + above))
            before, excess_before, height = height, now, np.where(arrived, height, following)
        raise SteepTerrainError(
            f"looks and terrain do not meet within {_MET:g} m in {_MOST_STEPS} steps: the terrain is nearly as steep "
            "as the look"
        )

    def run(self) -> tuple[float, float]:
        """Return the displacement east and north of the middle line of sight per metre of height, in m/m."""
        low, high = self.span[2]
        ends = np.full(2, self.span[0].mean()), np.full(2, self.span[1].mean()), np.array([low, high])
        east, north = self._at(*ends)
        return float((east[1] - east[0]) / (high - low)), float((north[1] - north[0]) / (high - low))

    def _at(self, line: np.ndarray, pixel: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Return east and north, in metres, at N image points and heights, (2, N)."""
        count = self.east.shape[1]
        a, b = self._basis(0, line, count), self._basis(1, pixel, self.east.shape[2])
        c = self._basis(2, height, _HEIGHTS)
        return np.stack([np.einsum("hij,nh,ni,nj->n", v, c, a, b, optimize=True) for v in (self.east, self.north)])

    def _basis(self, axis: int, coordinate: np.ndarray, count: int) -> np.ndarray:
        """Return the first `count` Chebyshev polynomials along an axis at positions (...), (..., count)."""
        first, last = self.span[axis]
        return chebyshev.chebvander((2.0 * np.asarray(coordinate) - first - last) / (last - first), count - 1)


def _nodes(ends: np.ndarray, count: int) -> np.ndarray:
    """Return Chebyshev points between two ends, (count,)."""
    return np.asarray(0.5 * (ends[0] + ends[1]) + 0.5 * (ends[1] - ends[0]) * chebyshev.chebpts1(count))


def _coefficients(values: np.ndarray) -> np.ndarray:
    """Return Chebyshev coefficients of values at the nodes, along every axis."""
    for axis, count in enumerate(values.shape):
        to = chebyshev.chebvander(chebyshev.chebpts1(count), count - 1).T * (2.0 / count)
        to[0] *= 0.5
        values = np.moveaxis(np.tensordot(to, values, (1, axis)), 0, axis)
    return values


def _local(
    sensor: Sensor, frame: GroundFrame, line: np.ndarray, pixel: np.ndarray, height: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return east and north of lines of sight at given heights, computed by the rigorous sensor, in metres."""
    points = sensor.ground(line, pixel, height)
    if not np.all(np.isfinite(points)):
        raise UnphysicalError("a line of sight misses the Earth")
    return frame.local(points)[:2]


def _horner(terms: list[np.ndarray], x: np.ndarray) -> np.ndarray:
    """Evaluate a polynomial in x with array coefficients in ascending powers."""
    out = terms[-1] * x
    for term in terms[-2:0:-1]:
        out += term
        out *= x
    out += terms[0]
    return out


MARGIN = 24
"""Margin of ground about a window that its image depends on, in pixels and lines; the point spread function ends there.
"""
LARGEST_ERROR = 0.002
"""Largest accepted error of interpolated positions, relative to the rigorous sensor on the terrain, in pixels."""
_NEAR = 2
"""Number of samples beyond the computed ones that cubic interpolation needs on each side."""
BORDER = MARGIN + _NEAR + 1
"""Smallest number of lines and pixels between a window and the edges of an image."""
_SAMPLES_AT_ONCE = 4_000_000
"""Largest number of ground samples processed at a time, to limit memory."""
_CHECKS = 400
"""Number of samples at which the interpolation of positions is compared with the rigorous sensor."""


GroundImage = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function from east and north, in metres from the frame's middle and of one shape, to apparent reflectance."""


@dataclass(frozen=True, eq=False)
class PushbroomScene:
    """Scene of a pushbroom image: terrain with its apparent reflectance.

    Attributes
    ----------
    frame : GroundFrame
        Coordinates of the ground.
    terrain : Terrain
        Heights.
    image : GroundImage
        Apparent reflectance, light and air included.
    """

    frame: GroundFrame
    terrain: Terrain
    image: GroundImage


@dataclass(frozen=True)
class Window:
    """Part of an image: whole lines and pixels, counted in the image.

    Attributes
    ----------
    first_line, first_pixel : int
        Line and pixel of the first sample.
    lines, pixels : int
        Size of the window.
    """

    first_line: int
    first_pixel: int
    lines: int
    pixels: int

    @property
    def middle(self) -> tuple[float, float]:
        """Line and pixel of the window's middle."""
        return self.first_line + 0.5 * (self.lines - 1), self.first_pixel + 0.5 * (self.pixels - 1)

    def fits(self, sensor: Sensor) -> bool:
        """Return whether the window lies inside a sensor's image, with the border that rendering needs."""
        return (
            min(self.first_line, self.first_pixel) >= BORDER
            and self.first_line + self.lines + BORDER <= sensor.lines
            and self.first_pixel + self.pixels + BORDER <= sensor.camera.pixels
        )

    def sample(self, sensor: Sensor, height: float) -> tuple[float, float]:
        """Return the ground distance of neighbouring pixels and of neighbouring lines at the window's middle, in m."""
        line, pixel = self.middle
        steps = np.array([-0.5, 0.5, 0.0, 0.0])
        points = sensor.ground(line + steps, pixel + np.roll(steps, 2), height)
        return float(np.linalg.norm(points[3] - points[2])), float(np.linalg.norm(points[1] - points[0]))


@dataclass(frozen=True, eq=False)
class RenderedPatch:
    """Noise-free image of a window.

    Attributes
    ----------
    photons : (lines, pixels) ndarray
        Expected photons in every pixel.
    window : Window
        Window of the image.
    motion : ImageMotion
        Motion of the image over the line, in the window's middle.
    error : float
        Largest difference, at check samples, of an interpolated position from the rigorous one on the terrain, pixels.
    """

    photons: np.ndarray
    window: Window
    motion: ImageMotion
    error: float


def look_map(sensor: Sensor, frame: GroundFrame, terrain: Terrain, window: Window) -> LookMap:
    """Return the interpolated lines of sight that the image of a window requires.

    Raises
    ------
    ValueError
        The window with its margin lies partly outside the image.
    """
    lines = window.first_line - BORDER, window.first_line + window.lines - 1 + BORDER
    pixels = window.first_pixel - BORDER, window.first_pixel + window.pixels - 1 + BORDER
    return LookMap.prepare(sensor, frame, terrain, lines, pixels)


def extent_of(looks: LookMap, step: int = 16) -> Extent:
    """Return the extent of the ground that lines of sight see, slightly enlarged.

    Raises SteepTerrainError where the terrain is as steep as a line of sight.
    """
    (first, last), (left, right), _ = looks.span
    lines, pixels = (np.linspace(a, b, int((b - a) / step) + 2) for a, b in ((first, last), (left, right)))
    east, north, _ = looks.ground(lines, pixels)
    # Between two samples the terrain displaces the point by less than their distance.
    spare = max(float(np.max(np.abs(np.diff(v, axis=k)))) for v in (east, north) for k in (0, 1))
    extent = Extent(float(east.min()), float(east.max()), float(north.min()), float(north.max()))
    return extent.grown(spare)


def require_open(looks: LookMap, extent: Extent) -> None:
    """Raise SteepTerrainError if terrain hides a part of itself from the lines of sight.

    Raises
    ------
    SteepTerrainError
        A slope that faces away from the camera is as steep as the line of sight.
    """
    to_east, to_north = looks.run()
    spacing = min(looks.terrain.surface.spacing)
    east, north = extent.axes(max(0.25 * spacing, extent.side / 2000.0))
    steepest = -np.inf
    for part in (slice(i, i + 256) for i in range(0, len(north), 256)):
        slope_east, slope_north = looks.terrain.slopes(east, north[part])
        steepest = max(steepest, float(np.max(slope_east * to_east + slope_north * to_north)))
    # Along the look the ground below it rises by this much per metre.
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
    """Render the expected number of photons in each pixel of a window of an image.

    Parameters
    ----------
    sensor : Sensor
        True sensor.
    optics : LineOptics
        Optics of its line.
    scene : PushbroomScene
        Terrain with its apparent reflectance.
    window : Window
        Lines and pixels of the image.
    oversampling : int
        Number of ground samples along each side of a pixel.
    looks : LookMap or None
        `look_map` of the same sensor and window, if it exists already.

    Raises
    ------
    ValueError
        The window is too near to the image's ends, its ground lies outside the scene, or the terrain is too rough for
        the interpolation.
    SteepTerrainError
        The terrain hides a part of itself.
    """
    looks = looks or look_map(sensor, scene.frame, scene.terrain, window)
    line, pixel = window.middle
    height = float(looks.ground(np.array([line]), np.array([pixel]))[2][0, 0])
    # Blur by jitter differs from line to line and is contained in the moments of the collection.
    motion = ImageMotion.of(without_jitter(sensor), line, pixel, height)
    moments = exposures(sensor, optics)
    if len(moments) > 1 or moments[0][1] is not sensor:
        seen = [
            (share, _expected(moment_sensor, optics, scene, window, oversampling, motion, None))
            for share, moment_sensor in moments
        ]
        photons = np.sum([share * photons for share, (photons, _) in seen], axis=0)
        return RenderedPatch(np.maximum(photons, 0.0), window, motion, max(error for _, (_, error) in seen))
    photons, error = _expected(sensor, optics, scene, window, oversampling, motion, looks)
    # The point spread function on a finite grid rings by 1e-4 of an edge.
    return RenderedPatch(np.maximum(photons, 0.0), window, motion, error)


def _expected(
    sensor: Sensor,
    optics: LineOptics,
    scene: PushbroomScene,
    window: Window,
    oversampling: int,
    motion: ImageMotion,
    looks: LookMap | None,
) -> tuple[np.ndarray, float]:
    """Return the expected photons at one moment of the light collection, and the largest position error in pixels."""
    looks = looks or look_map(sensor, scene.frame, scene.terrain, window)
    # Try samples at pixels first, then finer ones if the terrain needs them.
    for fine in (1, oversampling):
        error = _interpolation_error(sensor, looks, window, oversampling, fine)
        if error <= LARGEST_ERROR:
            break
    else:
        raise UnphysicalError(
            f"terrain so rough that places are {error:.3g} pixels off, more than {LARGEST_ERROR}; take more samples of "
            "a pixel or a smoother terrain"
        )
    kernel = optics.kernel(oversampling, MARGIN, motion)
    count = max(16, int(_SAMPLES_AT_ONCE / oversampling**2 / (window.pixels + 2 * MARGIN)) - 2 * MARGIN)
    count = min(count, max(16, -(-window.lines // cores())))
    photons = np.empty((window.lines, window.pixels))
    pixels = window.first_pixel + np.arange(window.pixels)
    scale = optics.photons_per_reflectance * sensor.camera.relative_illumination(pixels)

    def strip(start: int) -> None:
        part = Window(window.first_line + start, window.first_pixel, min(count, window.lines - start), window.pixels)
        east, north = _samples(looks, part, oversampling, fine)
        values = scene.image(east, north)
        photons[start : start + part.lines] = scale * _filtered(values, kernel, oversampling, part)

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(strip, range(0, window.lines, count)))
    return photons, error


def _samples(looks: LookMap, window: Window, oversampling: int, fine: int) -> tuple[np.ndarray, np.ndarray]:
    """Return east and north, in metres, of all ground samples of a window with its margin.

    For each pixel, `fine` positions along each side are computed on the terrain, and all `oversampling` positions are
    interpolated between them by cubics.
    """
    border = MARGIN + _NEAR
    lines = np.arange((window.lines + 2 * border - 1) * fine + 1) / fine + (window.first_line - border)
    pixels = np.arange((window.pixels + 2 * border - 1) * fine + 1) / fine + (window.first_pixel - border)
    east, north, _ = looks.ground(lines, pixels)
    inner = slice(_NEAR * fine, -_NEAR * fine)
    if fine == oversampling:
        return east[inner, inner], north[inner, inner]
    # With samples at pixels only, interpolation needs one more at either end.
    out = [_spread(_spread(v[1:-1, 1:-1], oversampling, 0), oversampling, 1) for v in (east, north)]
    return out[0], out[1]


def _spread(values: np.ndarray, factor: int, axis: int) -> np.ndarray:
    """Interpolate by Lagrange cubics to `factor` samples per step along an axis, without the outermost steps."""
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
        row = out[k::factor]
        np.multiply(v[:count], weight[0], out=row)
        for j in (1, 2, 3):
            row += weight[j] * v[j : j + count]
    return np.moveaxis(out, 0, axis)


def _filtered(values: np.ndarray, kernel: np.ndarray, oversampling: int, window: Window) -> np.ndarray:
    """Convolve ground samples with the point spread function, and return the values at the pixels."""
    # Wrap-around of the transform falls into the margin alone.
    shape = [fft.next_fast_len(n, True) for n in values.shape]
    spectrum = fft.rfft2(values.astype(np.float32, copy=False), s=shape)
    spectrum *= fft.rfft2(kernel.astype(np.float32), s=shape)
    image = fft.irfft2(spectrum, s=shape, overwrite_x=True)
    # The kernel begins at its corner: the image of a sample lies half a kernel later.
    first = 2 * MARGIN * oversampling
    lines, pixels = (first + oversampling * np.arange(n) for n in (window.lines, window.pixels))
    return np.asarray(image[lines[0] : lines[-1] + 1 : oversampling, pixels[0] : pixels[-1] + 1 : oversampling])


def _interpolation_error(sensor: Sensor, looks: LookMap, window: Window, oversampling: int, fine: int) -> float:
    """Return the largest position error of the samples of `_samples`, checked in parts of the window, in pixels.

    The points on the terrain are imaged by the rigorous sensor and compared with the samples' image coordinates.
    """
    random, size = np.random.default_rng(1), 5
    taken, expected_parts = [], []
    for _ in range(_CHECKS // size**2):
        line = window.first_line + int(random.integers(max(window.lines - size, 1)))
        pixel = window.first_pixel + int(random.integers(max(window.pixels - size, 1)))
        lines = line + np.arange(-3 * fine, (size + 3) * fine + 1) / fine
        pixels = pixel + np.arange(-3 * fine, (size + 3) * fine + 1) / fine
        east, north, _ = looks.ground(lines, pixels)
        if fine < oversampling:
            east, north = (_spread(_spread(v, oversampling, 0), oversampling, 1) for v in (east, north))
            lines, pixels = (v[1] + np.arange(len(east)) / oversampling for v in (lines, pixels))
        index = random.integers(0, len(lines), (2, size**2))
        taken.append(np.stack([lines[index[0]], pixels[index[1]]]))
        expected_parts.append(np.stack([east[index[0], index[1]], north[index[0], index[1]]]))
    (east, north), expected = np.concatenate(expected_parts, axis=1), np.concatenate(taken, axis=1)
    imaged = sensor.image(looks.frame.itrs(east, north, looks.terrain.height(east, north)))
    return float(np.max(np.hypot(imaged[0] - expected[0], imaged[1] - expected[1])))
