"""The part of a user's map that images show, in the plane coordinates of the ground; its pixels stay as they are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyproj
from pyproj.exceptions import ProjError

from scenes.yaml.errors import InputError, Issue, Problem
from twin.orbit.ground.grid import GroundFrame
from twin.orbit.measured.datum import CGCS2000, Geoid
from twin.orbit.measured.geotiff import GeoRaster, open_raster, opened

if TYPE_CHECKING:
    from scenes.specs.orbit.measurements import RasterFileSpec

MOST_HEIGHT = 2.0e4
"""Metres above or below the ellipsoid or a geoid: farther no ground lies, whatever its datum."""
_SAMPLED = 512
"""Rows and columns at which a map is looked through for its extreme heights."""
_WGS84 = "EPSG:4326"


@dataclass(frozen=True, eq=False)
class MapPart:
    """A part of a map; see `twin.orbit.ground.orthophoto.Map`.

    Attributes:
        values: (rows, columns); grey values float32 with NaN where there are none, or heights above the ellipsoid.
        valid: (rows, columns) bool; None for all.
        raster: that it is cut from.
        first: row and column of its first value there.
        frame: plane coordinates of the ground.
        way: from the raster's system to longitude and latitude, degrees.
        spacing: of rows and columns on the ground, metres, their geometric mean.
    """

    values: np.ndarray
    valid: np.ndarray | None
    raster: GeoRaster
    first: tuple[int, int]
    frame: GroundFrame
    way: pyproj.Transformer
    spacing: float

    def east_north(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of places (row, column), whole or not, metres, broadcast."""
        row, column = np.broadcast_arrays(np.asarray(row, float), np.asarray(column, float))
        x, y = self.raster.coordinates_of(row + self.first[0], column + self.first[1])
        return self.frame.plane(*np.radians(self.way.transform(x, y)))

    def row_column(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse."""
        east, north = np.broadcast_arrays(np.asarray(east, float), np.asarray(north, float))
        longitude, latitude = np.degrees(self.frame.geographic(east, north))
        x, y = self.way.transform(longitude, latitude, direction="INVERSE")
        if self.raster.crs.is_geographic:
            # the turn of longitude that the map has
            middle = self.raster.coordinates_of(0.5 * self.raster.shape[0], 0.5 * self.raster.shape[1])[0]
            x = middle + (x - middle + 180.0) % 360.0 - 180.0
        row, column = self.raster.row_column_of(x, y)
        return row - self.first[0], column - self.first[1]


@dataclass(frozen=True, eq=False)
class UserMap:
    """A map in a file, of which parts are read; made by `UserMap.open`.

    Attributes:
        raster: the file.
        way: from its system to longitude and latitude, degrees.
        geoid: that its values are heights above; None for the ellipsoid, or for grey values.
    """

    raster: GeoRaster
    way: pyproj.Transformer
    geoid: Geoid | None

    @classmethod
    def open(cls, spec: RasterFileSpec, folder: Path, heights: bool = False) -> UserMap:
        """A map of a file.

        Args:
            spec: the file, and what it does not say itself.
            folder: that relative paths start from.
            heights: whether it is an elevation model, whose heights must be said to be above something.

        Raises:
            InputError: it cannot be read, no way from its system without a guess, heights above nothing.
        """
        raster = open_raster(folder / spec.file, spec.band, spec.crs)
        flat = raster.crs.sub_crs_list[0] if raster.crs.is_compound else raster.crs
        itself = len(raster.crs.axis_info) == 3 and not raster.crs.is_compound
        if heights and spec.heights is None and not itself:
            problem = "what the heights are counted from is not said"
            allowed = "heights: ellipsoid, or heights: geoid with geoid: FILE"
            raise spec.error(problem, ("heights",), allowed=allowed)
        geoid = None if spec.geoid is None else Geoid.read(folder / spec.geoid)
        try:
            geodetic, target = flat.geodetic_crs, pyproj.CRS(_WGS84)
            if geodetic is not None and geodetic.datum is not None and geodetic.datum.name == CGCS2000:
                target = geodetic.to_2d()
            way = pyproj.Transformer.from_crs(
                flat.to_2d(), target, always_xy=True, allow_ballpark=False, only_best=True
            )
        except ProjError as error:
            raise InputError(Issue(f"no exact way from {flat.name}: {error}", raster.file)) from None
        return cls(raster, way, geoid)

    def limits(self) -> tuple[float, float]:
        """Least and largest height of some thousand places over the whole elevation model.

        Raises:
            InputError: there are none, or they are no heights of ground.
        """
        shape = tuple(min(n, _SAMPLED) for n in self.raster.shape)
        with opened(self.raster.file) as source:
            some = source.read(self.raster.band, out_shape=shape, masked=True)
        with np.errstate(invalid="ignore"):  # of a damaged file some are not even right NaN
            values = np.asarray(some.compressed(), float)
        values = values[np.isfinite(values)]
        if not len(values):
            raise InputError(Issue("a map without values", self.raster.file))
        low, high = float(values.min()), float(values.max())
        if max(-low, high) > MOST_HEIGHT:
            found, allowed = f"{low:.6g} to {high:.6g} m", f"up to {MOST_HEIGHT:g} m; empty pixels as nodata"
            raise InputError(Issue("no heights of ground", self.raster.file, found=found, allowed=allowed))
        return low, high

    def part(self, frame: GroundFrame, ends: tuple[float, float, float, float], heights: bool = False) -> MapPart:
        """What lies within some ends.

        Args:
            frame: plane coordinates of the ground.
            ends: west, east, south and north, metres.
            heights: whether its values are heights.

        Raises:
            InputError: nothing does, or too much for the memory; a place without a geoid.
        """
        side = np.linspace(0.0, 1.0, 21)
        east = ends[0] + (ends[1] - ends[0]) * np.concatenate([side, side, 0.0 * side, 0.0 * side + 1.0])
        north = ends[2] + (ends[3] - ends[2]) * np.concatenate([0.0 * side, 0.0 * side + 1.0, side, side])
        whole = MapPart(np.empty((0, 0)), None, self.raster, (0, 0), frame, self.way, 1.0)
        row, column = whole.row_column(east, north)
        good = np.isfinite(row) & np.isfinite(column)
        if not good.any():
            raise InputError(Issue("the images lie beyond the system of this map", self.raster.file))
        bounds = []
        for place, count in ((row[good], self.raster.shape[0]), (column[good], self.raster.shape[1])):
            low, high = int(max(np.floor(place.min()) - 2, 0)), int(min(np.ceil(place.max()) + 3, count))
            if high - low < 4:
                lon, lat = np.degrees((frame.longitude, frame.latitude))
                found = f"images near {lat:.4f} deg N, {lon:.4f} deg E"
                allowed = "a map of the ground that the images show; its own longitude and latitude are "
                x, y = self.way.transform(*self.raster.coordinates_of(*(0.5 * n for n in self.raster.shape)))
                raise InputError(
                    Issue("the map does not show what the images show", self.raster.file, None, (), found,
                          f"{allowed}{float(x):.4f} deg E, {float(y):.4f} deg N")
                )  # fmt: skip
            bounds.append(slice(low, high))
        values, valid = self.raster.read(*bounds)
        first = (bounds[0].start, bounds[1].start)
        middle = np.array([0.5 * n for n in values.shape])
        part = MapPart(values, None if valid.all() else valid, self.raster, first, frame, self.way, 1.0)
        e, n = part.east_north(middle[0] + np.array([0.0, 1.0, 0.0]), middle[1] + np.array([0.0, 0.0, 1.0]))
        area = abs((e[1] - e[0]) * (n[2] - n[0]) - (e[2] - e[0]) * (n[1] - n[0]))
        if heights:
            shown = self._heights(part)
        else:
            shown = values.astype(np.float32)
            shown[~valid] = np.nan
        return MapPart(shown, part.valid, self.raster, first, frame, self.way, float(np.sqrt(area)))

    def _heights(self, part: MapPart) -> np.ndarray:
        """Above the ellipsoid."""
        values = part.values.astype(np.float64)
        if self.geoid is not None:
            rows, columns = (np.arange(n, dtype=float) for n in values.shape)
            for k in range(0, len(rows), 256):  # a part at a time: a geoid needs several numbers a post
                east, north = part.east_north(rows[k : k + 256, None], columns[None])
                try:
                    values[k : k + 256] += self.geoid(*np.degrees(part.frame.geographic(east, north)))
                except Problem as problem:
                    raise InputError(
                        Issue(problem.problem, self.raster.file, None, (), problem.found, problem.allowed)
                    ) from None
        known = values if part.valid is None else values[part.valid]
        if known.size and (known.min() < -1000.0 or known.max() > 10000.0):
            found = f"{known.min():g} to {known.max():g} m"
            allowed = "heights within -1000 m to 10 000 m; a nodata value that the file does not say?"
            raise InputError(Issue("no heights of ground", self.raster.file, None, (), found, allowed))
        return values
