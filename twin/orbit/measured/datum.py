"""Coordinates of any reference system to the ITRS and back, and heights above a geoid to heights above the ellipsoid.

PROJ knows the systems. It is never let guess: no ballpark transformation, and where it lacks a grid it says so. WGS 84
counts as the ITRS, as everywhere here. So does CGCS2000, from which PROJ has no way: it is ITRF97 at epoch 2000.0, and
plates have moved since by some 3 cm a year.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from pyproj.crs import GeocentricCRS
from pyproj.exceptions import CRSError, ProjError
from scipy.ndimage import map_coordinates

from scenes.yaml.errors import InputError, Issue, Problem, shown
from twin.orbit.measured.geotiff import GeoRaster, open_raster

_ALLOWED = "a code or a text that PROJ knows, as EPSG:4979 (WGS 84 with ellipsoidal height), EPSG:32650, OGC:CRS84"
CGCS2000 = "China 2000"
"""Name of the datum of CGCS2000 in EPSG's registry."""


@dataclass(frozen=True, eq=False)
class Geoid:
    """Heights of a geoid above the ellipsoid on a grid of longitude and latitude, bilinear between its nodes.

    Attributes:
        raster: the grid.
    """

    raster: GeoRaster

    @classmethod
    def read(cls, path: str | Path) -> Geoid:
        """From a GeoTIFF or GTX file of one's own; InputError if it is none, or no grid over the Earth."""
        raster = open_raster(path)
        if not raster.crs.is_geographic:
            name = raster.crs.name
            raise InputError(Issue("a geoid in another system", str(path), None, (), name, "longitude and latitude"))
        return cls(raster)

    @cached_property
    def _values(self) -> np.ndarray:
        values, valid = self.raster.read()
        if np.any(np.abs(values[valid]) > 150.0):
            found = f"{np.max(np.abs(values[valid])):g}"
            raise InputError(Issue("no heights of a geoid", self.raster.file, None, (), found, "metres, within 150 m"))
        known = np.where(valid, values, np.nan).astype(np.float64)
        # beyond the last column the first one comes again, or that column itself, which then has no weight
        return np.pad(known, ((0, 0), (0, 1)), mode="wrap" if self._whole_turn else "edge")

    @property
    def _whole_turn(self) -> bool:
        step = abs(self.raster.transform[0])
        return abs(self.raster.shape[1] * step - 360.0) < 0.6 * step

    def __call__(self, longitude: Any, latitude: Any) -> np.ndarray:
        """Height of the geoid, metres, (...).

        Args:
            longitude: degrees, any turn, (...).
            latitude: degrees, (...).

        Raises:
            Problem: a place beyond the grid.
        """
        lon, lat = np.broadcast_arrays(np.asarray(longitude, float), np.asarray(latitude, float))
        rows, columns = self.raster.shape
        first, around = self.raster.transform[2], self._whole_turn
        turn = (lon - first) % 360.0
        row, column = self.raster.row_column_of(first + turn, lat)
        inside = (row >= -1e-6) & (row <= rows - 1.0 + 1e-6)
        if not around:
            inside &= (column >= -1e-6) & (column <= columns - 1.0 + 1e-6)
        if not np.all(inside):
            k = int(np.argmin(np.ravel(inside)))
            found = f"{np.ravel(lat)[k]:.6g} deg N, {np.ravel(lon)[k]:.6g} deg E"
            raise Problem("a place beyond the grid of the geoid", found, self.raster.file)
        at = np.clip(row, 0.0, rows - 1.0), column % columns if around else np.clip(column, 0.0, columns - 1.0)
        height = map_coordinates(self._values, at, order=1, mode="nearest")
        if not np.all(np.isfinite(height)):
            raise Problem("a place where the grid of the geoid holds nothing", None, self.raster.file)
        return np.asarray(height)


@dataclass(frozen=True, eq=False)
class Datum:
    """A coordinate reference system with what its heights are counted from; made by `Datum.of`.

    Attributes:
        crs: as given: two coordinates or three.
        geoid: that heights are above; None for the ellipsoid.
        forward: to geocentric coordinates of the ITRS.
        geographic: to longitude and latitude, degrees, of the same system.
    """

    crs: pyproj.CRS
    geoid: Geoid | None
    forward: pyproj.Transformer
    geographic: pyproj.Transformer

    @classmethod
    def of(cls, text: str, heights: str | None, geoid: Geoid | None) -> Datum:
        """The system of this name.

        Args:
            text: of the system, for PROJ.
            heights: ``ellipsoid`` or ``geoid``; None where the system itself says it.
            geoid: for heights above it.

        Raises:
            Problem: no such system, heights that are not said or said twice, no way to the ITRS without a guess.
        """
        try:
            crs = pyproj.CRS(text)
        except CRSError:
            raise Problem("no such coordinate reference system", shown(text), _ALLOWED) from None
        if not (crs.is_geographic or crs.is_projected or crs.is_geocentric or crs.is_compound):
            raise Problem("a system without a place on the Earth", crs.name, _ALLOWED)
        if len(crs.axis_info) == 3 and heights is not None:
            allowed = "a system of two coordinates, or no `heights:`"
            raise Problem(f"{crs.name} says itself what its heights are", heights, allowed)
        if len(crs.axis_info) == 2 and heights is None:
            problem = f"{crs.name} does not say what heights are counted from"
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
            raise Problem(f"PROJ knows no exact way from {crs.name}: {reason}", text, allowed) from None
        return cls(crs, geoid, forward, geographic)

    def itrs(self, x: Any, y: Any, z: Any) -> np.ndarray:
        """Places (..., 3) in the ITRS, metres.

        Args:
            x: longitude in degrees, easting, or geocentric, (...).
            y: latitude in degrees, northing, or geocentric, (...).
            z: height, or geocentric, metres, (...).

        Raises:
            Problem: a place where the system has none, or beyond the geoid's grid.
        """
        x, y, z = (np.asarray(v, np.float64) for v in np.broadcast_arrays(x, y, z))
        if self.crs.is_geographic and (np.any(np.abs(y) > 90.0) or np.any(np.abs(x) > 540.0)):
            k = int(np.argmax((np.abs(y) > 90.0) | (np.abs(x) > 540.0)))
            found = f"longitude {np.ravel(x)[k]:g}, latitude {np.ravel(y)[k]:g}"
            raise Problem("no longitude and latitude", found, "degrees, and longitude before latitude", within=(k,))
        height = z
        if self.geoid is not None:
            height = z + self.geoid(*self.geographic.transform(x, y))
        places = np.stack(self.forward.transform(x, y, height), axis=-1)
        good = np.all(np.isfinite(places), axis=-1)
        if not np.all(good):
            k = int(np.argmin(np.ravel(good)))
            text = f"{np.ravel(x)[k]:g}, {np.ravel(y)[k]:g}"
            raise Problem(f"no place in {self.crs.name}", text, "coordinates of that system", within=(k,))
        return places

    @property
    def accuracy(self) -> float | None:
        """Accuracy of the way to the ITRS as its authority states it, metres; None if it does not, or before `itrs`."""
        stated = self.forward.accuracy
        if stated < 0.0:
            try:
                stated = float(self.forward.get_last_used_operation().accuracy)
            except ProjError:
                return None
        return stated if stated >= 0.0 else None


def _to_itrs(crs: pyproj.CRS) -> pyproj.Transformer:
    geodetic, target = crs.geodetic_crs, pyproj.CRS("EPSG:4978")
    if geodetic is not None and geodetic.datum is not None and geodetic.datum.name == CGCS2000:
        target = GeocentricCRS(datum=geodetic.datum)
    return pyproj.Transformer.from_crs(crs, target, always_xy=True, allow_ballpark=False, only_best=True)
