"""What is known of the ground before a pass: an orthophoto of another date and a reference elevation model.

Both carry the same error in plan, a constant shift and a smooth part: what the map shows at a place lies on the ground
at that place minus the error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import numpy as np
from scipy.ndimage import gaussian_filter, spline_filter

from twin.orbit.ground.grid import GroundFrame, SplineGrid, Terrain, correlated_field
from twin.orbit.ground.texture import Extent, apparent, reflectance
from twin.run.random_streams import stream

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import ControlSpec, TextureSpec

SCALE = 10_000.0
"""Grey values of an orthophoto for a reflectance of 1."""
_PER_LENGTH = 8.0
"""Cells of the smooth error in plan, in its correlation length."""
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

    Attributes:
        orthophoto: grey values; of a simulated one uint16, 10 000 for an apparent reflectance of 1.
        dem: heights above the ellipsoid, metres.
    """

    orthophoto: M
    dem: M


@dataclass(frozen=True, eq=False)
class Raster:
    """A map on a regular grid of longitude and latitude.

    Attributes:
        values: (rows, columns); rows go to the south, columns to the east.
        frame: plane coordinates in which the grid is regular; exact longitude and latitude by `GroundFrame`.
        west, north: of the first row's first column, its middle, metres.
        spacing: of rows and columns, metres.
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

    Attributes:
        shift: constant error in plan, map minus true, east and north, metres; belongs to the truth.
        smooth: the rest of the error in plan, east and north, metres, over true coordinates; belongs to the truth.
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

    Args:
        frame: coordinates of the ground.
        extent: of the true ground that is imaged; the map covers a little less.
        terrain: the true one.
        texture: the true ground's.
        spec: what the file says.
        ground: seed of the true ground.
        seed: of all errors.
    """
    plan_seed, noise_seed, dem_seed = (stream(seed, k) for k in range(3))
    worst = max(abs(v) for v in spec.shift) + 10.0 * spec.sigma + spec.spacing * 8.0
    inside = extent.grown(-worst)
    smooth = _plan_error(extent, spec, plan_seed)
    full = apparent(reflectance(extent, texture, ground, spec.changed), terrain, spec.light)

    def shifted(east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (east - spec.shift[0] - smooth[0](east, north), north - spec.shift[1] - smooth[1](east, north))

    east, north = inside.axes(spec.spacing)
    values = np.empty((len(north), len(east)), np.float32)
    for part in _parts(len(north)):
        values[part] = full(*shifted(*np.meshgrid(east, north[::-1][part])))
    # a Gaussian has the transfer exp(-2 (pi sigma f)^2), at Nyquist f = 1/2
    values = gaussian_filter(values, np.sqrt(-2.0 * np.log(spec.mtf)) / np.pi, mode="nearest")
    random = np.random.Generator(np.random.SFC64(noise_seed))
    values += np.float32(spec.noise) * random.standard_normal(values.shape, dtype=np.float32)
    grey = np.clip(np.rint(SCALE * values), 0, 65535).astype(np.uint16)
    photo = Raster(grey, frame, float(east[0]), float(north[-1]), spec.spacing)

    post = spec.dem.post
    east, north = inside.axes(post)
    heights = np.empty((len(north), len(east)), np.float32)
    for part in _parts(len(north)):
        heights[part] = terrain.height(*shifted(*np.meshgrid(east, north[::-1][part])))
    heights += np.float32(spec.dem.sigma) * correlated_field(heights.shape, post, spec.dem.correlation, dem_seed)
    dem = Raster(heights, frame, float(east[0]), float(north[-1]), post)
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


def _parts(rows: int, at_once: int = 256) -> list[slice]:
    return [slice(i, i + at_once) for i in range(0, rows, at_once)]
