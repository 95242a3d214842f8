"""What is known of the ground before a pass: an orthophoto of another date and a reference elevation model.

Both carry the same error in plan, a constant shift and a smooth part: what the map shows at a place lies on the ground
at that place minus the error.

Reflectance of the ground, and how bright it looks from above.

The ground is drawn: a fractal for what grows wild, fields in blocks of one direction each, roads. It is kept in cells
and used as the cubic B-spline of the cells' numbers, whose spectrum falls with sinc^4 of frequency times the cells'
side: what a camera or an orthophoto samples is defined at every place, and has nothing left near the sampling
frequencies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, spline_filter

from twin.framework.random_streams import stream
from twin.orbit.ground.grid import GroundFrame, SplineGrid, Terrain, correlated_field, fractal_field

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import ControlSpec, LightSpec, TextureSpec

_DARKEST, _BRIGHTEST = 0.02, 0.85
_EXPONENT = 1.25
"""Exponent of the fractal's amplitude spectrum. Images of land have power spectra near frequency^-2 to frequency^-3
(Burton and Moorhead, Appl. Opt. 26, 157 (1987): natural scenes in general)."""
_WILD = 2.5
"""Longest wavelength of what grows wild, in fields."""
_BLOCK = 8.0
"""Side of a block of fields of one direction, in fields."""
_LANE = 0.97
"""Share of a field's side that is left between lanes."""
_ROAD_WIDTH = 8.0
_ROAD_BRIGHTNESS = 1.8
"""Brightness of a road over the mean."""
_SHIFT_BITS = 4
_ROWS = 512
_SPARE = 4
"""Cells kept beyond the ground that is asked for."""


@dataclass(frozen=True)
class Extent:
    """A rectangle of ground: its ends, metres."""

    west: float
    east: float
    south: float
    north: float

    @property
    def side(self) -> float:
        """The longer one, metres."""
        return max(self.east - self.west, self.north - self.south)

    def grown(self, by: float) -> Extent:
        """Larger by so much on every side, metres."""
        return Extent(self.west - by, self.east + by, self.south - by, self.north + by)

    def axes(self, spacing: float, spare: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """East of the columns and north of the rows of cells that cover it, metres; whole multiples of the spacing."""
        (west, south), (east, north) = (
            [int(f(v / spacing)) for v in ends]
            for f, ends in ((np.floor, (self.west, self.south)), (np.ceil, (self.east, self.north)))
        )
        return spacing * np.arange(west - spare, east + spare + 1), spacing * np.arange(
            south - spare, north + spare + 1
        )


def around(extents: Sequence[Extent]) -> Extent:
    """The smallest extent that holds all of them."""
    return Extent(
        min(e.west for e in extents),
        max(e.east for e in extents),
        min(e.south for e in extents),
        max(e.north for e in extents),
    )


def reflectance(extent: Extent, spec: TextureSpec, seed: np.random.SeedSequence, changed: float = 0.0) -> SplineGrid:
    """Reflectance over an extent.

    Parameters
    ----------
    extent : Extent
        Of the ground.
    spec : TextureSpec
        What the file says.
    seed : np.random.SeedSequence
        Of the ground; the same seed and extent give the same ground.
    changed : float
        Share of the fields that look different from those of 0; which, and how, is of the same seed.
    """
    wild, plots, mask, ways = (stream(seed, k) for k in range(4))
    east, north = extent.axes(spec.spacing, _SPARE)
    shape = (len(north), len(east))
    longest = max(0.5 * extent.side, 2.0 * spec.parcel_size)
    relative = fractal_field(shape, spec.spacing, _EXPONENT, _WILD * spec.parcel_size, wild)
    if spec.parcels > 0.0:
        fields, covered = _fields(extent, spec, shape, (east[0], north[0]), plots, changed)
        where = fractal_field(shape, spec.spacing, 2.0, longest, mask)
        covered &= where < np.quantile(where[::16, ::16], spec.parcels)
        del where
        # a field is even, with a little of the soil's own pattern
        relative[covered] = 0.97 * fields[covered] + 0.25 * relative[covered]
    level = spec.mean * (1.0 + spec.contrast * relative)
    _draw_roads(level, extent, spec, (east[0], north[0]), ways)
    np.clip(level, _DARKEST, _BRIGHTEST, out=level)
    return SplineGrid(level, (spec.spacing, spec.spacing), (float(east[0]), float(north[0])))


def apparent(ground: SplineGrid, terrain: Terrain, light: LightSpec) -> SplineGrid:
    """What the ground looks like from above the air: the reflectance of level ground, without air, that looks so.

    Lambert's law for the Sun on the slopes, even light from the sky, a transmission and a constant path radiance.
    Slopes throw no shadow on others.

    Parameters
    ----------
    ground : SplineGrid
        reflectance.
    terrain : Terrain
        Under it.
    light : LightSpec
        Sun and air.

    Returns
    -------
    SplineGrid
        Cells as the ground's. Level ground in a high sun of 90 degrees looks as bright as its reflectance times the
        transmission, plus the path's share.
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
        lit = (1.0 - light.sky) * np.maximum(incidence, 0.0) + light.sky * sine
        out[part] = light.transmission * lit * ground.coefficients[part] + light.path
    return SplineGrid(out, ground.spacing, ground.first)


def _fields(
    extent: Extent,
    spec: TextureSpec,
    shape: tuple[int, int],
    first: tuple[float, float],
    seed: np.random.SeedSequence,
    changed: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Fields' brightness, of zero mean and unit rms, and where there are any."""
    random = np.random.default_rng(seed)
    fields, covered = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    block = _BLOCK * spec.parcel_size
    columns, rows = (int(np.ceil(d / block)) + 1 for d in (extent.east - extent.west, extent.north - extent.south))
    for k in range(rows * columns):
        middle = np.array([extent.west + (k % columns) * block, extent.south + (k // columns) * block])
        turn = random.normal(0.2, 0.25)
        axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        for west, east, south, north in _split(0.5 * block, spec.parcel_size, random):
            old, new, change = random.standard_normal(), random.standard_normal(), random.random()
            corners = _LANE * np.array([[west, south], [east, south], [east, north], [west, north]])
            corners += (1.0 - _LANE) * 0.5 * np.array([west + east, south + north])
            place = (corners @ axes.T + middle - first) / spec.spacing
            points = np.rint(place * 2**_SHIFT_BITS).astype(np.int32)
            value = float(np.clip(new if change < changed else old, -2.5, 2.5))
            cv2.fillConvexPoly(fields, points, value, shift=_SHIFT_BITS)
            cv2.fillConvexPoly(covered, points, 1, shift=_SHIFT_BITS)
    return fields, covered.astype(bool)


def _split(half: float, size: float, random: np.random.Generator) -> Iterator[tuple[float, float, float, float]]:
    """Rectangles about the origin (west, east, south, north), of mean area size^2, that fill a square."""
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
    """Wandering lines across the whole ground, one in each `roads` metres, either way."""
    random = np.random.default_rng(seed)
    value = float(min(_ROAD_BRIGHTNESS * spec.mean, _BRIGHTEST))
    step = 0.1 * spec.roads
    for axis, length, width in (
        (0, extent.north - extent.south, extent.east - extent.west),
        (1, extent.east - extent.west, extent.north - extent.south),
    ):
        count = int(np.ceil(length / step)) + 3
        for k in range(int(np.ceil(width / spec.roads))):
            way = (k + random.uniform(0.1, 0.9)) * spec.roads + np.cumsum(
                random.normal(0.0, 0.12 * step, count).cumsum()
            )
            along = step * (np.arange(count) - 1)
            place = np.stack([way, along] if axis == 0 else [along, way], axis=-1)
            place = (place + np.array([extent.west - first[0], extent.south - first[1]])) / spec.spacing
            points = np.rint(place * 2**_SHIFT_BITS).astype(np.int32)
            thickness = max(1, round(_ROAD_WIDTH / spec.spacing))
            cv2.polylines(level, [points], False, value, thickness=thickness, shift=_SHIFT_BITS)


SCALE = 10_000.0
"""Grey values of an orthophoto for a reflectance of 1."""
_PER_LENGTH = 8.0
"""Cells of the smooth error in plan, in its correlation length."""
_ROWS_AT_ONCE = 256
"""Rows of control that are sampled at once, to bound memory."""
_MARGIN = 50.0
"""Metres of true ground that are kept about the map, beside ten sigmas of its error in plan."""


class Map(Protocol):
    """A raster whose places are known."""

    @property
    def values(self) -> np.ndarray:
        """(rows, columns)."""

    @property
    def valid(self) -> np.ndarray | None:
        """(rows, columns) bool: which values there are; None for all."""

    @property
    def spacing(self) -> float:
        """Distance of rows and columns on the ground, metres."""

    def east_north(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of places (row, column), whole or not, metres, broadcast."""

    def row_column(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column (whole or not) of coordinates, metres, broadcast: the inverse of `east_north`."""


M = TypeVar("M", bound=Map, covariant=True)


@dataclass(frozen=True, eq=False)
class Maps(Generic[M]):
    """What is known of the ground.

    Attributes
    ----------
    orthophoto : M
        Grey values; of a simulated one uint16, 10 000 for an apparent reflectance of 1.
    dem : M
        Heights above the ellipsoid, metres.
    """

    orthophoto: M
    dem: M


@dataclass(frozen=True, eq=False)
class Raster:
    """A map on a regular grid of longitude and latitude.

    Attributes
    ----------
    values : np.ndarray
        (rows, columns); rows go to the south, columns to the east.
    frame : GroundFrame
        Plane coordinates in which the grid is regular; exact longitude and latitude by `GroundFrame`.
    west, north : float
        Of the first row's first column, its middle, metres.
    spacing : float
        Of rows and columns, metres.
    """

    values: np.ndarray
    frame: GroundFrame
    west: float
    north: float
    spacing: float

    @property
    def valid(self) -> None:
        """Every value is there."""

    def east_north(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of places (row, column), whole or not, metres, broadcast."""
        return self.west + self.spacing * np.asarray(column), self.north - self.spacing * np.asarray(row)

    def row_column(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of coordinates: the inverse of `east_north`."""
        return (self.north - np.asarray(north)) / self.spacing, (np.asarray(east) - self.west) / self.spacing


@dataclass(frozen=True, eq=False)
class Control(Maps[Raster]):
    """The maps of a simulated patch, with their errors.

    Attributes
    ----------
    shift : tuple[float, float]
        Constant error in plan, map minus true, east and north, metres; belongs to the truth.
    smooth : tuple[SplineGrid, SplineGrid]
        The rest of the error in plan, east and north, metres, over true coordinates; belongs to the truth.
    """

    shift: tuple[float, float]
    smooth: tuple[SplineGrid, SplineGrid]

    def error(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Error in plan at places of the map, map minus true, metres."""
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
    """Control for a patch of ground.

    Parameters
    ----------
    frame : GroundFrame
        Coordinates of the ground.
    extent : Extent
        Of the true ground that is imaged; the map covers a little less.
    terrain : Terrain
        The true one.
    texture : TextureSpec
        The true ground's.
    spec : ControlSpec
        What the file says.
    ground : np.random.SeedSequence
        Seed of the true ground.
    seed : np.random.SeedSequence
        Of all errors.
    """
    plan_seed, noise_seed, dem_seed = (stream(seed, k) for k in range(3))
    worst = max(abs(v) for v in spec.shift) + 10.0 * spec.sigma + spec.spacing * 8.0
    inside = extent.grown(-worst)
    smooth = _plan_error(extent, spec, plan_seed)
    full = apparent(reflectance(extent, texture, ground, spec.changed), terrain, spec.light)

    def sampled(ground: Callable[..., np.ndarray], spacing: float) -> Raster:
        """The ground where the control says that it is, rows from the north."""
        east, north = inside.axes(spacing)
        values = np.empty((len(north), len(east)), np.float32)
        for first in range(0, len(north), _ROWS_AT_ONCE):
            part = slice(first, first + _ROWS_AT_ONCE)
            x, y = np.meshgrid(east, north[::-1][part])
            values[part] = ground(x - spec.shift[0] - smooth[0](x, y), y - spec.shift[1] - smooth[1](x, y))
        return Raster(values, frame, float(east[0]), float(north[-1]), spacing)

    photo, dem = sampled(full, spec.spacing), sampled(terrain.height, spec.dem.post)
    # a Gaussian has the transfer exp(-2 (pi sigma f)^2), at Nyquist f = 1/2
    values = gaussian_filter(photo.values, np.sqrt(-2.0 * np.log(spec.mtf)) / np.pi, mode="nearest")
    random = np.random.Generator(np.random.SFC64(noise_seed))
    values += np.float32(spec.noise) * random.standard_normal(values.shape, dtype=np.float32)
    grey = np.clip(np.rint(SCALE * values), 0, 65535).astype(np.uint16)
    rough = correlated_field(dem.values.shape, spec.dem.post, spec.dem.correlation, dem_seed)
    dem = replace(dem, values=dem.values + np.float32(spec.dem.sigma) * rough)
    photo = replace(photo, values=grey)
    return Control(photo, dem, spec.shift, smooth)


def _plan_error(extent: Extent, spec: ControlSpec, seed: np.random.SeedSequence) -> tuple[SplineGrid, SplineGrid]:
    """The smooth error in plan, east and north."""
    spacing = spec.correlation / _PER_LENGTH
    east, north = extent.grown(_MARGIN).axes(spacing, 3)
    grids = []
    for k in range(2):
        error = spec.sigma * correlated_field((len(north), len(east)), spacing, spec.correlation, stream(seed, k))
        coefficients = spline_filter(error.astype(np.float64), order=3, mode="mirror")
        grids.append(SplineGrid(coefficients, (spacing, spacing), (float(east[0]), float(north[0])), "mirror"))
    return grids[0], grids[1]
