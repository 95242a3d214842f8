"""Maps from GeoTIFF and other rasters that GDAL reads, by parts: an orthophoto may be larger than the memory."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from scenes.yaml.errors import InputError, Issue
from scenes.yaml.input_file import no_file

LARGEST_PART = 100_000_000
"""Pixels that are read at once."""
_DRIVERS = ("GTiff", "GTX", "COG")
"""Plain grids; other drivers of GDAL open files and addresses that a raster names."""


@dataclass(frozen=True, eq=False)
class GeoRaster:
    """A raster whose places are known; made by `open_raster`. Nothing is held in memory.

    Attributes:
        file: its path.
        crs: of its coordinates.
        transform: (a, b, c, d, e, f): x = a column + b row + c and y = d column + e row + f, (0, 0) being the middle of
            the first pixel.
        shape: rows and columns.
        band: that is read, counted from 1.
        dtype: of its values.
    """

    file: str
    crs: pyproj.CRS
    transform: tuple[float, float, float, float, float, float]
    shape: tuple[int, int]
    band: int
    dtype: str

    def coordinates_of(self, row: Any, column: Any) -> tuple[np.ndarray, np.ndarray]:
        """X and y in the raster's system of places (row, column), whole or not, (...)."""
        a, b, c, d, e, f = self.transform
        return a * np.asarray(column) + b * np.asarray(row) + c, d * np.asarray(column) + e * np.asarray(row) + f

    def row_column_of(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """The inverse."""
        a, b, c, d, e, f = self.transform
        u, v, area = np.asarray(x) - c, np.asarray(y) - f, a * e - b * d
        with np.errstate(invalid="ignore"):  # of places beyond the system, which are infinite
            return (a * v - d * u) / area, (e * u - b * v) / area

    def read(self, rows: slice | None = None, columns: slice | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Values (r, c) of a part, of the raster's own type, and which of them hold something (bool).

        Args:
            rows: of the part, within the raster; None for all.
            columns: likewise.

        Raises:
            InputError: too large a part, or a file that is damaged.
        """
        part = rows or slice(0, self.shape[0]), columns or slice(0, self.shape[1])
        size = [s.stop - s.start for s in part]
        if size[0] * size[1] > LARGEST_PART:
            found = f"{size[0]} x {size[1]} pixels"
            allowed = f"at most {LARGEST_PART:.0e} pixels at once; a map that is cut to the images"
            raise InputError(Issue("too large a part of a map", self.file, None, (), found, allowed))
        with opened(self.file) as source:
            from rasterio.windows import Window

            window = Window(part[1].start, part[0].start, size[1], size[0])
            values = source.read(self.band, window=window)
            valid = source.read_masks(self.band, window=window) > 0
        if np.issubdtype(values.dtype, np.floating):
            valid &= np.isfinite(values)
        return values, valid


def open_raster(path: str | Path, band: int = 1, crs: str | None = None) -> GeoRaster:
    """A raster's place and size.

    Args:
        path: of the file.
        band: that is to be read, counted from 1.
        crs: of a file that does not say it.

    Raises:
        InputError: no such file, none that GDAL reads as a plain grid, without a place, with complex or no values.
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
        raise InputError(Issue("values that are no grey values or heights", file, None, (), str(dtype), "real numbers"))
    if affine.is_identity or affine.determinant == 0.0:
        found = "ground control points only" if ground else "no georeference"
        raise InputError(Issue("a raster without a place", file, None, (), found, "a GeoTIFF with a geotransform"))
    if text is None and crs is None:
        raise InputError(
            Issue("a raster that does not say its system", file, None, ("crs",), None, "`crs:`, EPSG:32650")
        )
    try:
        system = pyproj.CRS.from_wkt(text) if text is not None else pyproj.CRS(str(crs))
        if text is not None and crs is not None and not system.to_2d().equals(pyproj.CRS(crs).to_2d(), True):
            raise InputError(Issue("the file says another system", file, None, ("crs",), str(crs), system.name))
    except pyproj.exceptions.CRSError:
        raise InputError(Issue("no system that PROJ knows", file, None, ("crs",), crs, "EPSG:32650, ...")) from None
    a, b, c, d, e, f = affine[:6]
    middle = (a, b, c + 0.5 * (a + b), d, e, f + 0.5 * (d + e))
    return GeoRaster(file, system, middle, shape, band, str(dtype))


@contextmanager
def opened(file: str) -> Iterator[Any]:
    """The file as rasterio's dataset. InputError if it is none that can be read, or becomes so while it is read."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    # names that GDAL takes for addresses or archives are none of files
    wrong = no_file(Path(file))
    if wrong is not None:
        raise InputError(Issue(wrong, file, allowed="a GeoTIFF"))
    try:
        # a file beside the raster is not the raster
        with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                source = rasterio.open(Path(file).resolve(), sharing=False)
        with source:
            if source.driver not in _DRIVERS:
                raise InputError(Issue("a raster of another format", file, None, (), source.driver, "GeoTIFF or GTX"))
            yield source
    except RasterioError as error:
        reason = str(error).replace(str(Path(file).resolve()), "").strip(" :'") or "damaged"
        raise InputError(Issue(f"not a raster that can be read: {reason}", file, allowed="a GeoTIFF")) from None
