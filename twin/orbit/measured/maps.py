"""Maps and coordinate reference systems: rasters, geoids and transformations to the ITRS.

Rasters are GeoTIFF and other files that GDAL reads; they are read in parts, since an orthophoto may be larger than the
memory. The part of a user's map that images show is used in the plane coordinates of the ground without resampling.

Coordinates of any reference system are transformed to the ITRS and back, and heights above a geoid to heights above the
ellipsoid. PROJ provides the systems. Approximate (ballpark) transformations are excluded, and a missing grid is an
error. WGS 84 is treated as the ITRS, as everywhere in the program. So is CGCS2000, for which PROJ has no
transformation: it is ITRF97 at epoch 2000.0, and tectonic plates have moved since by some 3 cm a year.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
from pyproj.crs import GeocentricCRS
from pyproj.exceptions import CRSError, ProjError
from scipy.ndimage import map_coordinates

from scenes.yaml.errors import InputError, Issue, Problem, shown
from scenes.yaml.input_file import no_file
from twin.orbit.ground.grid import GroundFrame

if TYPE_CHECKING:
    from scenes.specs.orbit.measurements import RasterFileSpec

LARGEST_PART = 100_000_000
"""Largest number of pixels of a raster that are read at a time."""
_DRIVERS = ("GTiff", "GTX", "COG")
"""GDAL drivers that are allowed, those of plain grids; other drivers can open further files and network addresses that
a raster names.
"""


@dataclass(frozen=True, eq=False)
class GeoRaster:
    """Georeferenced raster file, opened by `open_raster`; its values are read on request.

    Attributes
    ----------
    file : str
        Path of the file.
    crs : pyproj.CRS
        Coordinate reference system.
    transform : tuple of float
        (a, b, c, d, e, f): x = a column + b row + c and y = d column + e row + f, (0, 0) being the middle of the first
        pixel.
    shape : tuple of int
        Rows and columns.
    band : int
        Number of the band that is read, counted from 1.
    dtype : str
        Data type of the values.
    """

    file: str
    crs: pyproj.CRS
    transform: tuple[float, float, float, float, float, float]
    shape: tuple[int, int]
    band: int
    dtype: str

    def coordinates_of(self, row: Any, column: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y in the raster's system at real-valued rows and columns (...)."""
        a, b, c, d, e, f = self.transform
        return a * np.asarray(column) + b * np.asarray(row) + c, d * np.asarray(column) + e * np.asarray(row) + f

    def row_column_of(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the real-valued row and column of coordinates x and y (...) in the raster's system."""
        a, b, c, d, e, f = self.transform
        u, v, area = np.asarray(x) - c, np.asarray(y) - f, a * e - b * d
        with np.errstate(invalid="ignore"):  # coordinates outside the system are infinite
            return (a * v - d * u) / area, (e * u - b * v) / area

    def read(self, rows: slice | None = None, columns: slice | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the values of a part, in the raster's data type, and the mask of valid ones, (rows, columns) each.

        Parameters
        ----------
        rows : slice or None
            Rows of the part, within the raster; None for all.
        columns : slice or None
            Columns of the part; None for all.

        Raises
        ------
        InputError
            The part is too large, or the file is damaged.
        """
        part = rows or slice(0, self.shape[0]), columns or slice(0, self.shape[1])
        size = [s.stop - s.start for s in part]
        if size[0] * size[1] > LARGEST_PART:
            value = f"{size[0]} x {size[1]} pixels"
            allowed = f"at most {LARGEST_PART:.0e} pixels at once; a map that is cut to the images"
            raise InputError(Issue("the part of a map is too large", self.file, None, (), value, allowed))
        with opened(self.file) as source:
            from rasterio.windows import Window

            window = Window(part[1].start, part[0].start, size[1], size[0])
            values = source.read(self.band, window=window)
            valid = source.read_masks(self.band, window=window) > 0
        if np.issubdtype(values.dtype, np.floating):
            valid &= np.isfinite(values)
        return values, valid


def open_raster(path: str | Path, band: int = 1, crs: str | None = None) -> GeoRaster:
    """Read the georeference and size of a raster.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    band : int
        Number of the band to be read, counted from 1.
    crs : str or None
        Coordinate reference system of a file that does not specify it.

    Raises
    ------
    InputError
        The file does not exist, is not a plain grid that GDAL reads, has no georeference, or has complex or no values.
    """
    file = str(path)
    with opened(file) as source:
        affine, tags = source.transform, source.crs
        shape, count, dtypes = (source.height, source.width), source.count, source.dtypes
        text = None if tags is None else tags.to_wkt()
        ground = source.gcps[0]
    if not 1 <= band <= count:
        raise InputError(Issue("no such band", file, None, ("band",), str(band), f"1 to {count}"))
    dtype = dtypes[band - 1]
    if np.dtype(dtype).kind not in "uif":
        raise InputError(Issue("not grey values or heights", file, None, (), str(dtype), "real numbers"))
    if affine.is_identity or affine.determinant == 0.0:
        value = "ground control points only" if ground else "no georeference"
        raise InputError(Issue("a raster without georeference", file, None, (), value, "a GeoTIFF with a geotransform"))
    if text is None and crs is None:
        raise InputError(
            Issue("a raster without a coordinate reference system", file, None, ("crs",), None, "`crs:`, EPSG:32650")
        )
    try:
        system = pyproj.CRS.from_wkt(text) if text is not None else pyproj.CRS(str(crs))
        if text is not None and crs is not None and not system.to_2d().equals(pyproj.CRS(crs).to_2d(), True):
            raise InputError(Issue("the file has another system", file, None, ("crs",), str(crs), system.name))
    except pyproj.exceptions.CRSError:
        raise InputError(Issue("a system unknown to PROJ", file, None, ("crs",), crs, "EPSG:32650, ...")) from None
    a, b, c, d, e, f = affine[:6]
    middle = (a, b, c + 0.5 * (a + b), d, e, f + 0.5 * (d + e))
    return GeoRaster(file, system, middle, shape, band, str(dtype))


@contextmanager
def opened(file: str) -> Iterator[Any]:
    """Open a file as rasterio's dataset, for the duration of a `with` block.

    Raises
    ------
    InputError
        The file cannot be opened, or an error occurs while it is read.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    # Refuse names that GDAL takes for addresses or archives.
    wrong = no_file(Path(file))
    if wrong is not None:
        raise InputError(Issue(wrong, file, allowed="a GeoTIFF"))
    try:
        # GDAL must not read files beside the raster.
        with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                source = rasterio.open(Path(file).resolve(), sharing=False)
        with source:
            if source.driver not in _DRIVERS:
                raise InputError(Issue("unsupported raster format", file, None, (), source.driver, "GeoTIFF or GTX"))
            yield source
    except RasterioError as error:
        reason = str(error).replace(str(Path(file).resolve()), "").strip(" :'") or "damaged"
        raise InputError(Issue(f"the raster cannot be read: {reason}", file, allowed="a GeoTIFF")) from None


_ALLOWED = "a code or a text that PROJ knows, as EPSG:4979 (WGS 84 with ellipsoidal height), EPSG:32650, OGC:CRS84"
CGCS2000 = "China 2000"
"""Name of the datum of CGCS2000 in EPSG's registry."""


@dataclass(frozen=True, eq=False)
class Geoid:
    """Heights of a geoid above the ellipsoid on a grid of longitude and latitude, interpolated bilinearly.

    Attributes
    ----------
    raster : GeoRaster
        Grid of heights, in metres.
    """

    raster: GeoRaster

    @classmethod
    def read(cls, path: str | Path) -> Geoid:
        """Read a user's geoid from a GeoTIFF or GTX file; InputError if it is not a grid of longitude and latitude."""
        raster = open_raster(path)
        if not raster.crs.is_geographic:
            name = raster.crs.name
            raise InputError(Issue("a geoid in another system", str(path), None, (), name, "longitude and latitude"))
        return cls(raster)

    @cached_property
    def _values(self) -> np.ndarray:
        values, valid = self.raster.read()
        if np.any(np.abs(values[valid]) > 150.0):
            value = f"{np.max(np.abs(values[valid])):g}"
            raise InputError(Issue("not heights of a geoid", self.raster.file, None, (), value, "metres, within 150 m"))
        known = np.where(valid, values, np.nan).astype(np.float64)
        # Append the first column to a whole circle, otherwise repeat the last one, which then has no weight.
        return np.pad(known, ((0, 0), (0, 1)), mode="wrap" if self._is_global else "edge")

    @property
    def _is_global(self) -> bool:
        """True where the grid spans all 360 degrees of longitude."""
        step = abs(self.raster.transform[0])
        return abs(self.raster.shape[1] * step - 360.0) < 0.6 * step

    def __call__(self, longitude: Any, latitude: Any) -> np.ndarray:
        """Return the height of the geoid above the ellipsoid, in metres, (...).

        Parameters
        ----------
        longitude : array_like
            Degrees, in any range, (...).
        latitude : array_like
            Degrees, (...).

        Raises
        ------
        Problem
            A position lies outside the grid.
        """
        lon, lat = np.broadcast_arrays(np.asarray(longitude, float), np.asarray(latitude, float))
        rows, columns = self.raster.shape
        first, around = self.raster.transform[2], self._is_global
        offset = (lon - first) % 360.0
        row, column = self.raster.row_column_of(first + offset, lat)
        inside = (row >= -1e-6) & (row <= rows - 1.0 + 1e-6)
        if not around:
            inside &= (column >= -1e-6) & (column <= columns - 1.0 + 1e-6)
        if not np.all(inside):
            k = int(np.argmin(np.ravel(inside)))
            value = f"{np.ravel(lat)[k]:.6g} deg N, {np.ravel(lon)[k]:.6g} deg E"
            raise Problem("a position outside the grid of the geoid", value, self.raster.file)
        at = np.clip(row, 0.0, rows - 1.0), column % columns if around else np.clip(column, 0.0, columns - 1.0)
        height = map_coordinates(self._values, at, order=1, mode="nearest")
        if not np.all(np.isfinite(height)):
            raise Problem("a position without a value in the grid of the geoid", None, self.raster.file)
        return np.asarray(height)


@dataclass(frozen=True, eq=False)
class Datum:
    """Coordinate reference system with the reference surface of its heights, from `Datum.of`.

    Attributes
    ----------
    crs : pyproj.CRS
        System of the input: two coordinates or three.
    geoid : Geoid or None
        Geoid to which heights refer; None for the ellipsoid.
    forward : pyproj.Transformer
        Transformation to geocentric coordinates of the ITRS.
    geographic : pyproj.Transformer
        Transformation to longitude and latitude, degrees, of the same system.
    """

    crs: pyproj.CRS
    geoid: Geoid | None
    forward: pyproj.Transformer
    geographic: pyproj.Transformer

    @classmethod
    def of(cls, text: str, heights: str | None, geoid: Geoid | None) -> Datum:
        """Make the datum of a coordinate reference system.

        Parameters
        ----------
        text : str
            Code or text of the system, for PROJ.
        heights : str or None
            Reference of the heights, ``ellipsoid`` or ``geoid``; None where the system itself defines it.
        geoid : Geoid or None
            Geoid to which heights refer.

        Raises
        ------
        Problem
            The system is unknown, the reference of the heights is missing or specified twice, or no exact
            transformation to the ITRS exists.
        """
        try:
            crs = pyproj.CRS(text)
        except CRSError:
            raise Problem("no such coordinate reference system", shown(text), _ALLOWED) from None
        if not (crs.is_geographic or crs.is_projected or crs.is_geocentric or crs.is_compound):
            raise Problem("not a coordinate system of the Earth", crs.name, _ALLOWED)
        if len(crs.axis_info) == 3 and heights is not None:
            allowed = "a system of two coordinates, or no `heights:`"
            raise Problem(f"{crs.name} defines its heights itself", heights, allowed)
        if len(crs.axis_info) == 2 and heights is None:
            problem = f"{crs.name} does not define the reference surface of heights"
            raise Problem(problem, text, "heights: ellipsoid, heights: geoid with geoid: FILE, or EPSG:4979")
        whole = crs if len(crs.axis_info) == 3 else crs.to_3d()
        try:
            forward = _to_itrs(whole)
            flat = crs.sub_crs_list[0] if crs.is_compound else crs
            geodetic = flat.geodetic_crs
            assert geodetic is not None
            near = geodetic if geodetic.is_geographic else pyproj.CRS("EPSG:4326")
            geographic = pyproj.Transformer.from_crs(flat.to_2d() if not flat.is_geocentric else near.to_2d(),
                                                     near.to_2d(), always_xy=True)  # fmt: skip
        except ProjError as error:
            reason = str(error).rsplit("(", 1)[-1].rstrip(") ")
            allowed = "a system that needs no grid of PROJ's: EPSG:4979, EPSG:4326 with heights, a zone of UTM"
            raise Problem(f"PROJ has no exact transformation from {crs.name}: {reason}", text, allowed) from None
        return cls(crs, geoid, forward, geographic)

    def itrs(self, x: Any, y: Any, z: Any) -> np.ndarray:
        """Return ITRS coordinates (..., 3), in metres.

        Parameters
        ----------
        x : array_like
            Longitude in degrees, easting, or geocentric x, (...).
        y : array_like
            Latitude in degrees, northing, or geocentric y, (...).
        z : array_like
            Height, or geocentric z, metres, (...).

        Raises
        ------
        Problem
            Coordinates lie outside the system's range, or beyond the geoid's grid.
        """
        x, y, z = (np.asarray(v, np.float64) for v in np.broadcast_arrays(x, y, z))
        if self.crs.is_geographic and (np.any(np.abs(y) > 90.0) or np.any(np.abs(x) > 540.0)):
            k = int(np.argmax((np.abs(y) > 90.0) | (np.abs(x) > 540.0)))
            value = f"longitude {np.ravel(x)[k]:g}, latitude {np.ravel(y)[k]:g}"
            raise Problem("not a longitude and latitude", value, "degrees, and longitude before latitude", within=(k,))
        height = z
        if self.geoid is not None:
            height = z + self.geoid(*self.geographic.transform(x, y))
        positions = np.stack(self.forward.transform(x, y, height), axis=-1)
        good = np.all(np.isfinite(positions), axis=-1)
        if not np.all(good):
            k = int(np.argmin(np.ravel(good)))
            text = f"{np.ravel(x)[k]:g}, {np.ravel(y)[k]:g}"
            raise Problem(f"not coordinates in {self.crs.name}", text, "coordinates of that system", within=(k,))
        return positions

    @property
    def accuracy(self) -> float | None:
        """Accuracy of the transformation to the ITRS according to its authority (such as EPSG), in metres.

        It is None if it is unknown, or before `itrs` is called.
        """
        accuracy = self.forward.accuracy
        if accuracy < 0.0:
            try:
                accuracy = float(self.forward.get_last_used_operation().accuracy)
            except ProjError:
                return None
        return accuracy if accuracy >= 0.0 else None


def _to_itrs(crs: pyproj.CRS) -> pyproj.Transformer:
    """Return the transformation from a coordinate reference system to geocentric coordinates of the ITRS."""
    geodetic, target = crs.geodetic_crs, pyproj.CRS("EPSG:4978")
    if geodetic is not None and geodetic.datum is not None and geodetic.datum.name == CGCS2000:
        target = GeocentricCRS(datum=geodetic.datum)
    return pyproj.Transformer.from_crs(crs, target, always_xy=True, allow_ballpark=False, only_best=True)


MOST_HEIGHT = 2.0e4
"""Largest plausible height or depth of ground relative to any ellipsoid or geoid, in metres."""
_SAMPLED = 512
"""Number of rows and of columns at which an elevation model is sampled to find its extreme heights."""
_WGS84 = "EPSG:4326"


@dataclass(frozen=True, eq=False)
class MapPart:
    """Part of a map; has the interface of `twin.orbit.ground.orthophoto.Map`.

    Attributes
    ----------
    values : (rows, columns) ndarray
        Grey values as float32 with NaN where there are none, or heights above the ellipsoid in metres.
    valid : (rows, columns) ndarray of bool or None
        Mask of valid values; None if all are.
    raster : GeoRaster
        Raster from which the part is cut.
    first : tuple of int
        Row and column of the first value in the raster.
    frame : GroundFrame
        Plane coordinates of the ground.
    to_geographic : pyproj.Transformer
        Transformation from the raster's system to longitude and latitude, degrees.
    spacing : float
        Spacing of rows and columns on the ground, metres, their geometric mean.
    """

    values: np.ndarray
    valid: np.ndarray | None
    raster: GeoRaster
    first: tuple[int, int]
    frame: GroundFrame
    to_geographic: pyproj.Transformer
    spacing: float

    def east_north(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return east and north, in metres, at real-valued rows and columns, which are broadcast together."""
        row, column = np.broadcast_arrays(np.asarray(row, float), np.asarray(column, float))
        x, y = self.raster.coordinates_of(row + self.first[0], column + self.first[1])
        return self.frame.plane(*np.radians(self.to_geographic.transform(x, y)))

    def row_column(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the real-valued row and column of plane coordinates east and north, in metres."""
        east, north = np.broadcast_arrays(np.asarray(east, float), np.asarray(north, float))
        longitude, latitude = np.degrees(self.frame.geographic(east, north))
        x, y = self.to_geographic.transform(longitude, latitude, direction="INVERSE")
        if self.raster.crs.is_geographic:
            # Bring longitudes to the range of the map.
            middle = self.raster.coordinates_of(0.5 * self.raster.shape[0], 0.5 * self.raster.shape[1])[0]
            x = middle + (x - middle + 180.0) % 360.0 - 180.0
        row, column = self.raster.row_column_of(x, y)
        return row - self.first[0], column - self.first[1]


@dataclass(frozen=True, eq=False)
class UserMap:
    """Orthophoto or elevation model in a file, of which parts are read; opened by `UserMap.open`.

    Attributes
    ----------
    raster : GeoRaster
        Raster file of the map.
    to_geographic : pyproj.Transformer
        Transformation from the raster's system to longitude and latitude, degrees.
    geoid : Geoid or None
        Geoid to which the values refer; None for the ellipsoid, or for grey values.
    """

    raster: GeoRaster
    to_geographic: pyproj.Transformer
    geoid: Geoid | None

    @classmethod
    def open(cls, spec: RasterFileSpec, folder: Path, heights: bool = False) -> UserMap:
        """Open the map of a file.

        Parameters
        ----------
        spec : RasterFileSpec
            Path of the file, and what the file itself does not specify.
        folder : Path
            Folder to which relative paths refer.
        heights : bool
            True for an elevation model, whose heights need a reference surface.

        Raises
        ------
        InputError
            The file cannot be read, no exact transformation from its system exists, or heights lack a reference
            surface.
        """
        raster = open_raster(folder / spec.file, spec.band, spec.crs)
        flat = raster.crs.sub_crs_list[0] if raster.crs.is_compound else raster.crs
        itself = len(raster.crs.axis_info) == 3 and not raster.crs.is_compound
        if heights and spec.heights is None and not itself:
            problem = "the reference surface of the heights is not specified"
            allowed = "heights: ellipsoid, or heights: geoid with geoid: FILE"
            raise spec.error(problem, ("heights",), allowed=allowed)
        geoid = None if spec.geoid is None else Geoid.read(folder / spec.geoid)
        try:
            geodetic, target = flat.geodetic_crs, pyproj.CRS(_WGS84)
            if geodetic is not None and geodetic.datum is not None and geodetic.datum.name == CGCS2000:
                target = geodetic.to_2d()
            transformer = pyproj.Transformer.from_crs(
                flat.to_2d(), target, always_xy=True, allow_ballpark=False, only_best=True
            )
        except ProjError as error:
            raise InputError(Issue(f"no exact transformation from {flat.name}: {error}", raster.file)) from None
        return cls(raster, transformer, geoid)

    def limits(self) -> tuple[float, float]:
        """Return the smallest and largest height, in metres, sampled over the whole elevation model.

        Raises
        ------
        InputError
            There are no values, or they are not heights of ground.
        """
        shape = tuple(min(n, _SAMPLED) for n in self.raster.shape)
        with opened(self.raster.file) as source:
            sample = source.read(self.raster.band, out_shape=shape, masked=True)
        with np.errstate(invalid="ignore"):  # a damaged file can hold malformed NaN
            values = np.asarray(sample.compressed(), float)
        values = values[np.isfinite(values)]
        if not len(values):
            raise InputError(Issue("a map without values", self.raster.file))
        low, high = float(values.min()), float(values.max())
        if max(-low, high) > MOST_HEIGHT:
            value, allowed = f"{low:.6g} to {high:.6g} m", f"up to {MOST_HEIGHT:g} m; empty pixels as nodata"
            raise InputError(Issue("values are not ground heights", self.raster.file, value=value, allowed=allowed))
        return low, high

    def part(self, frame: GroundFrame, ends: tuple[float, float, float, float], heights: bool = False) -> MapPart:
        """Return the part of the map within bounds.

        Parameters
        ----------
        frame : GroundFrame
            Plane coordinates of the ground.
        ends : tuple of float
            West, east, south and north, metres.
        heights : bool
            True where the values are heights.

        Raises
        ------
        InputError
            The map does not cover the bounds, the part is too large for the memory, or the geoid does not cover it.
        """
        side = np.linspace(0.0, 1.0, 21)
        east = ends[0] + (ends[1] - ends[0]) * np.concatenate([side, side, 0.0 * side, 0.0 * side + 1.0])
        north = ends[2] + (ends[3] - ends[2]) * np.concatenate([0.0 * side, 0.0 * side + 1.0, side, side])
        whole = MapPart(np.empty((0, 0)), None, self.raster, (0, 0), frame, self.to_geographic, 1.0)
        row, column = whole.row_column(east, north)
        good = np.isfinite(row) & np.isfinite(column)
        if not good.any():
            raise InputError(Issue("the images lie outside the coordinate system of this map", self.raster.file))
        bounds = []
        for coordinate, count in ((row[good], self.raster.shape[0]), (column[good], self.raster.shape[1])):
            low, high = int(max(np.floor(coordinate.min()) - 2, 0)), int(min(np.ceil(coordinate.max()) + 3, count))
            if high - low < 4:
                lon, lat = np.degrees((frame.longitude, frame.latitude))
                value = f"images near {lat:.4f} deg N, {lon:.4f} deg E"
                allowed = "a map of the ground in the images; the centre of this one is at "
                x, y = self.to_geographic.transform(*self.raster.coordinates_of(*(0.5 * n for n in self.raster.shape)))
                raise InputError(
                    Issue("the map does not cover the images", self.raster.file, None, (), value,
                          f"{allowed}{float(x):.4f} deg E, {float(y):.4f} deg N")
                )  # fmt: skip
            bounds.append(slice(low, high))
        values, valid = self.raster.read(*bounds)
        first = (bounds[0].start, bounds[1].start)
        middle = np.array([0.5 * n for n in values.shape])
        part = MapPart(values, None if valid.all() else valid, self.raster, first, frame, self.to_geographic, 1.0)
        e, n = part.east_north(middle[0] + np.array([0.0, 1.0, 0.0]), middle[1] + np.array([0.0, 0.0, 1.0]))
        area = abs((e[1] - e[0]) * (n[2] - n[0]) - (e[2] - e[0]) * (n[1] - n[0]))
        if heights:
            shown = self._heights(part)
        else:
            shown = values.astype(np.float32)
            shown[~valid] = np.nan
        return MapPart(shown, part.valid, self.raster, first, frame, self.to_geographic, float(np.sqrt(area)))

    def _heights(self, part: MapPart) -> np.ndarray:
        """Return the heights of a part of an elevation model above the ellipsoid, in metres."""
        values = part.values.astype(np.float64)
        if self.geoid is not None:
            rows, columns = (np.arange(n, dtype=float) for n in values.shape)
            for k in range(0, len(rows), 256):  # in parts, because a geoid needs several numbers per post
                east, north = part.east_north(rows[k : k + 256, None], columns[None])
                try:
                    values[k : k + 256] += self.geoid(*np.degrees(part.frame.geographic(east, north)))
                except Problem as problem:
                    raise InputError(problem.at(self.raster.file)) from None
        known = values if part.valid is None else values[part.valid]
        if known.size and (known.min() < -1000.0 or known.max() > 10000.0):
            value = f"{known.min():g} to {known.max():g} m"
            allowed = "heights within -1000 m to 10 000 m; is a nodata value missing in the file?"
            raise InputError(Issue("values are not ground heights", self.raster.file, None, (), value, allowed))
        return values
