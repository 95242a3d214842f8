"""Simulated ground and its control data: reflectance, orthophoto of another date, reference elevation model.

Orthophoto and elevation model have a common error in plan, a constant shift and a smooth part: the true position of the
ground shown at a position of the map is that position minus the error.

The reflectance is random: a fractal for wild vegetation, agricultural fields in blocks of one direction each, roads. It
is a cubic B-spline on a grid of cells, whose spectrum falls with sinc^4 of frequency times the cells' side: it is
defined at every position, and has no content near the sampling frequencies of cameras and orthophotos.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, spline_filter

from twin.framework.procedure import stream
from twin.orbit.ground.grid import GroundFrame, SplineGrid, Terrain, correlated_field, fractal_field

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import ControlSpec, LightSpec, TextureSpec

_DARKEST, _BRIGHTEST = 0.02, 0.85
_EXPONENT = 1.25
"""Exponent of the amplitude spectrum of the reflectance of wild vegetation, a fractal.

Images of land have power spectra near frequency^-2 to frequency^-3 (Burton and Moorhead, Appl. Opt. 26, 157 (1987):
natural scenes in general).
"""
_WILD = 2.5
"""Longest wavelength of the reflectance of wild vegetation, in units of the mean side of an agricultural field."""
_BLOCK = 8.0
"""Side of a block of agricultural fields of one direction, in units of the mean side of a field."""
_LANE = 0.97
"""Share of an agricultural field's side that is cultivated; the rest are lanes between the fields."""
_ROAD_WIDTH = 8.0
"""Width of a road, in metres."""
_ROAD_BRIGHTNESS = 1.8
"""Reflectance of a road, relative to the mean reflectance of the ground."""
_SHIFT_BITS = 4
"""Number of fractional bits of polygon coordinates in OpenCV's drawing functions."""
_ROWS = 512
"""Number of rows of the ground's grid processed at a time, to limit memory."""
_SPARE = 4
"""Number of cells by which the drawn ground extends beyond the requested extent."""


@dataclass(frozen=True)
class Extent:
    """Rectangle of ground, by its bounds in metres east and north."""

    west: float
    east: float
    south: float
    north: float

    @property
    def side(self) -> float:
        """Length of the longer side of the rectangle, in metres."""
        return max(self.east - self.west, self.north - self.south)

    def grown(self, by: float) -> Extent:
        """Return the extent enlarged on every side by `by` metres."""
        return Extent(self.west - by, self.east + by, self.south - by, self.north + by)

    def axes(self, spacing: float, spare: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the east coordinates of columns and north coordinates of rows of a grid over the extent, in metres.

        They are whole multiples of `spacing`, in metres; `spare` is the number of additional cells on every side.
        """
        ends = ((self.west, self.east), (self.south, self.north))
        cells = [(int(np.floor(first / spacing)), int(np.ceil(last / spacing))) for first, last in ends]
        east, north = (spacing * np.arange(first - spare, last + spare + 1) for first, last in cells)
        return east, north


def around(extents: Sequence[Extent]) -> Extent:
    """Return the smallest extent that contains all the given extents."""
    west, east, south, north = zip(*((e.west, e.east, e.south, e.north) for e in extents), strict=True)
    return Extent(min(west), max(east), min(south), max(north))


def reflectance(extent: Extent, spec: TextureSpec, seed: np.random.SeedSequence, changed: float = 0.0) -> SplineGrid:
    """Draw a random map of reflectance over an extent of ground.

    Parameters
    ----------
    extent : Extent
        Extent of the ground.
    spec : TextureSpec
        Texture of the input file.
    seed : SeedSequence
        Seed of the ground; the same seed and extent give the same ground.
    changed : float
        Share of the agricultural fields, 0 to 1, whose reflectance differs from that for `changed` = 0; which fields,
        and how, depends on the same seed.
    """
    wild, plots, mask, roads = (stream(seed, k) for k in range(4))
    east, north = extent.axes(spec.spacing, _SPARE)
    shape = (len(north), len(east))
    longest = max(0.5 * extent.side, 2.0 * spec.parcel_size)
    relative = fractal_field(shape, spec.spacing, _EXPONENT, _WILD * spec.parcel_size, wild)
    if spec.parcels > 0.0:
        fields, covered = _fields(extent, spec, shape, (east[0], north[0]), plots, changed)
        where = fractal_field(shape, spec.spacing, 2.0, longest, mask)
        covered &= where < np.quantile(where[::16, ::16], spec.parcels)
        del where
        # A field is uniform, with a little of the soil's pattern.
        relative[covered] = 0.97 * fields[covered] + 0.25 * relative[covered]
    level = spec.mean * (1.0 + spec.contrast * relative)
    _draw_roads(level, extent, spec, (east[0], north[0]), roads)
    np.clip(level, _DARKEST, _BRIGHTEST, out=level)
    return SplineGrid(level, (spec.spacing, spec.spacing), (float(east[0]), float(north[0])))


def apparent(ground: SplineGrid, terrain: Terrain, light: LightSpec) -> SplineGrid:
    """Return the apparent reflectance: that of level ground without atmosphere with the same radiance upward.

    The model has Lambert's law for the Sun on the slopes, uniform light from the sky, an atmospheric transmission and a
    constant path radiance. Cast shadows are not modelled.

    Parameters
    ----------
    ground : SplineGrid
        Reflectance.
    terrain : Terrain
        Terrain under it.
    light : LightSpec
        Sun and air.

    Returns
    -------
    SplineGrid
        Apparent reflectance in the ground's cells. For level ground and the Sun at the zenith it is the reflectance
        times the transmission, plus the contribution of path radiance.
    """
    rows, columns = ground.coefficients.shape
    east = ground.first[0] + ground.spacing[0] * np.arange(columns)
    north = ground.first[1] + ground.spacing[1] * np.arange(rows)
    sine, cosine = np.sin(light.elevation), np.cos(light.elevation)
    sun = cosine * np.sin(light.azimuth), cosine * np.cos(light.azimuth), sine
    out = np.empty((rows, columns), dtype=np.float32)
    for part in (slice(i, i + _ROWS) for i in range(0, rows, _ROWS)):
        to_east, to_north = terrain.slopes(east, north[part])
        incidence = (sun[2] - to_east * sun[0] - to_north * sun[1]) / np.sqrt(1.0 + to_east**2 + to_north**2)
        illumination = (1.0 - light.sky) * np.maximum(incidence, 0.0) + light.sky * sine
        out[part] = light.transmission * illumination * ground.coefficients[part] + light.path
    return SplineGrid(out, ground.spacing, ground.first)


def _fields(
    extent: Extent,
    spec: TextureSpec,
    shape: tuple[int, int],
    first: tuple[float, float],
    seed: np.random.SeedSequence,
    changed: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the brightness of agricultural fields (zero mean, unit RMS) and the mask of ground that they cover."""
    random = np.random.default_rng(seed)
    fields, covered = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    block = _BLOCK * spec.parcel_size
    columns, rows = (int(np.ceil(d / block)) + 1 for d in (extent.east - extent.west, extent.north - extent.south))
    for k in range(rows * columns):
        middle = np.array([extent.west + (k % columns) * block, extent.south + (k // columns) * block])
        rotation = random.normal(0.2, 0.25)
        axes = np.array([[np.cos(rotation), -np.sin(rotation)], [np.sin(rotation), np.cos(rotation)]])
        for west, east, south, north in _split(0.5 * block, spec.parcel_size, random):
            old, new, change = random.standard_normal(), random.standard_normal(), random.random()
            corners = _LANE * np.array([[west, south], [east, south], [east, north], [west, north]])
            corners += (1.0 - _LANE) * 0.5 * np.array([west + east, south + north])
            corner_pixels = (corners @ axes.T + middle - first) / spec.spacing
            points = np.rint(corner_pixels * 2**_SHIFT_BITS).astype(np.int32)
            value = float(np.clip(new if change < changed else old, -2.5, 2.5))
            cv2.fillConvexPoly(fields, points, value, shift=_SHIFT_BITS)
            cv2.fillConvexPoly(covered, points, 1, shift=_SHIFT_BITS)
    return fields, covered.astype(bool)


def _split(half: float, size: float, random: np.random.Generator) -> Iterator[tuple[float, float, float, float]]:
    """Divide a square about the origin into random rectangles of mean area `size`^2, agricultural fields.

    The square has the half side `half`; each rectangle is given as west, east, south and north, in metres.
    """
    waiting = [(-half, half, -half, half)]
    while waiting:
        west, east, south, north = waiting.pop()
        width, height = east - west, north - south
        if width * height < 1.4 * size**2 * random.uniform(0.5, 1.5):
            yield west, east, south, north
            continue
        share = random.uniform(0.3, 0.7)
        if width > 0.8 * height:
            middle = west + share * width
            waiting += [(west, middle, south, north), (middle, east, south, north)]
        else:
            middle = south + share * height
            waiting += [(west, east, south, middle), (west, east, middle, north)]


def _draw_roads(
    level: np.ndarray, extent: Extent, spec: TextureSpec, first: tuple[float, float], seed: np.random.SeedSequence
) -> None:
    """Draw winding roads in both directions into a map, at mean distances given by the texture's key `roads`."""
    random = np.random.default_rng(seed)
    value = float(min(_ROAD_BRIGHTNESS * spec.mean, _BRIGHTEST))
    step = 0.1 * spec.roads
    for axis, length, width in (
        (0, extent.north - extent.south, extent.east - extent.west),
        (1, extent.east - extent.west, extent.north - extent.south),
    ):
        count = int(np.ceil(length / step)) + 3
        for k in range(int(np.ceil(width / spec.roads))):
            path = (k + random.uniform(0.1, 0.9)) * spec.roads + np.cumsum(
                random.normal(0.0, 0.12 * step, count).cumsum()
            )
            along = step * (np.arange(count) - 1)
            path_pixels = np.stack([path, along] if axis == 0 else [along, path], axis=-1)
            path_pixels = (path_pixels + np.array([extent.west - first[0], extent.south - first[1]])) / spec.spacing
            points = np.rint(path_pixels * 2**_SHIFT_BITS).astype(np.int32)
            thickness = max(1, round(_ROAD_WIDTH / spec.spacing))
            cv2.polylines(level, [points], False, value, thickness=thickness, shift=_SHIFT_BITS)


SCALE = 10_000.0
"""Grey value of an orthophoto for an apparent reflectance of 1."""
_PER_LENGTH = 8.0
"""Number of grid cells per correlation length for the smooth error in plan of the maps."""
_ROWS_AT_ONCE = 256
"""Number of rows of a map sampled at a time, to limit memory."""
_MARGIN = 50.0
"""Margin, beyond the true ground, of the grid on which the smooth error in plan of the maps is drawn, in metres."""


class Map(Protocol):
    """Interface of a georeferenced raster: an orthophoto's grey values or an elevation model's heights."""

    @property
    def values(self) -> np.ndarray:
        """Values of the raster: grey values or heights in metres, (rows, columns)."""

    @property
    def valid(self) -> np.ndarray | None:
        """Mask of valid values, (rows, columns) bool; None if all are valid."""

    @property
    def spacing(self) -> float:
        """Spacing of rows and of columns on the ground, in metres."""

    def east_north(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return east and north, in metres, at real-valued rows and columns, which are broadcast together."""

    def row_column(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the real-valued row and column of coordinates east and north, in metres, which are broadcast."""


M = TypeVar("M", bound=Map, covariant=True)


@dataclass(frozen=True, eq=False)
class Maps(Generic[M]):
    """Control data of a patch of ground: orthophoto and elevation model.

    Attributes
    ----------
    orthophoto : Map
        Grey values; of a simulated one uint16, 10 000 for an apparent reflectance of 1.
    dem : Map
        Heights above the ellipsoid, metres.
    """

    orthophoto: M
    dem: M


@dataclass(frozen=True, eq=False)
class Raster:
    """Map on a regular grid of longitude and latitude.

    Attributes
    ----------
    values : (rows, columns) ndarray
        Grey values or heights in metres; rows go to the south, columns to the east.
    frame : GroundFrame
        Plane coordinates in which the grid is regular; gives exact longitude and latitude.
    west, north : float
        Centre of the first row's first column, metres.
    spacing : float
        Spacing of rows and columns, metres.
    """

    values: np.ndarray
    frame: GroundFrame
    west: float
    north: float
    spacing: float

    @property
    def valid(self) -> None:
        """Mask of valid values, always None: every value is valid."""

    def east_north(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return east and north, in metres, at real-valued rows and columns, which are broadcast together."""
        return self.west + self.spacing * np.asarray(column), self.north - self.spacing * np.asarray(row)

    def row_column(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the real-valued row and column of coordinates east and north, in metres, which are broadcast."""
        return (self.north - np.asarray(north)) / self.spacing, (np.asarray(east) - self.west) / self.spacing


@dataclass(frozen=True, eq=False)
class Control(Maps[Raster]):
    """Orthophoto and elevation model of a simulated patch of ground, with their true errors in plan.

    Attributes
    ----------
    shift : tuple of float
        Constant error in plan, map minus true, east and north, metres; not known to the user.
    smooth : tuple of SplineGrid
        Smooth error in plan, east and north, metres, over true coordinates; not known to the user.
    """

    shift: tuple[float, float]
    smooth: tuple[SplineGrid, SplineGrid]

    def error(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the error in plan at positions of the map, map minus true, in metres."""
        return self.shift[0] + self.smooth[0](east, north), self.shift[1] + self.smooth[1](east, north)


def make_control(
    frame: GroundFrame,
    extent: Extent,
    terrain: Terrain,
    texture: TextureSpec,
    spec: ControlSpec,
    ground: np.random.SeedSequence,
    seed: np.random.SeedSequence,
) -> Control:
    """Make orthophoto and elevation model of a patch of ground, with their errors.

    Parameters
    ----------
    frame : GroundFrame
        Coordinates of the ground.
    extent : Extent
        Extent of the true ground that is imaged; the map covers a little less.
    terrain : Terrain
        True terrain.
    texture : TextureSpec
        Texture of the true ground.
    spec : ControlSpec
        Control of the input file.
    ground : SeedSequence
        Seed of the true ground.
    seed : SeedSequence
        Seed of all errors.
    """
    plan_seed, noise_seed, dem_seed = (stream(seed, k) for k in range(3))
    worst = max(abs(v) for v in spec.shift) + 10.0 * spec.sigma + spec.spacing * 8.0
    inside = extent.grown(-worst)
    smooth = _plan_error(extent, spec, plan_seed)
    full = apparent(reflectance(extent, texture, ground, spec.changed), terrain, spec.light)

    def sampled(ground: Callable[..., np.ndarray], spacing: float) -> Raster:
        """Sample the ground at the true positions of a map's grid points, rows from the north."""
        east, north = inside.axes(spacing)
        values = np.empty((len(north), len(east)), np.float32)
        for first in range(0, len(north), _ROWS_AT_ONCE):
            part = slice(first, first + _ROWS_AT_ONCE)
            x, y = np.meshgrid(east, north[::-1][part])
            values[part] = ground(x - spec.shift[0] - smooth[0](x, y), y - spec.shift[1] - smooth[1](x, y))
        return Raster(values, frame, float(east[0]), float(north[-1]), spacing)

    photo, dem = sampled(full, spec.spacing), sampled(terrain.height, spec.dem.post)
    # A Gaussian has the transfer exp(-2 (pi sigma f)^2), at Nyquist f = 1/2.
    values = gaussian_filter(photo.values, np.sqrt(-2.0 * np.log(spec.mtf)) / np.pi, mode="nearest")
    random = np.random.Generator(np.random.SFC64(noise_seed))
    values += np.float32(spec.noise) * random.standard_normal(values.shape, dtype=np.float32)
    grey = np.clip(np.rint(SCALE * values), 0, 65535).astype(np.uint16)
    rough = correlated_field(dem.values.shape, spec.dem.post, spec.dem.correlation, dem_seed)
    dem = replace(dem, values=dem.values + np.float32(spec.dem.sigma) * rough)
    photo = replace(photo, values=grey)
    return Control(photo, dem, spec.shift, smooth)


def _plan_error(extent: Extent, spec: ControlSpec, seed: np.random.SeedSequence) -> tuple[SplineGrid, SplineGrid]:
    """Draw the smooth error in plan of the maps, as splines of its east and north component, in metres."""
    spacing = spec.correlation / _PER_LENGTH
    east, north = extent.grown(_MARGIN).axes(spacing, 3)
    grids = []
    for k in range(2):
        error = spec.sigma * correlated_field((len(north), len(east)), spacing, spec.correlation, stream(seed, k))
        coefficients = spline_filter(error.astype(np.float64), order=3, mode="mirror")
        grids.append(SplineGrid(coefficients, (spacing, spacing), (float(east[0]), float(north[0])), "mirror"))
    return grids[0], grids[1]
