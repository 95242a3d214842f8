"""Plane coordinates of a patch of ground, in metres, without any approximation.

East and north are longitude and latitude times constant lengths, those of the ellipsoid at the patch's middle. The way
to longitude, latitude and height and back is thus exact wherever one is; only the lengths are not quite true away from
the middle (at 40 degrees of latitude an east metre is 1.3e-4 wrong 1 km to the north). Heights are above the ellipsoid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from twin.orbit.earth import Earth, curvature_radii

_EARTH = Earth()
"""Only the ellipsoid is used."""


@dataclass(frozen=True)
class GroundFrame:
    """Coordinates about a place.

    Attributes:
        longitude, latitude: of the place, geodetic, radians.
    """

    longitude: float
    latitude: float

    @property
    def scale(self) -> tuple[float, float]:
        """Metres east per radian of longitude, and metres north per radian of latitude."""
        meridian, normal = curvature_radii(self.latitude)
        return float(normal * np.cos(self.latitude)), float(meridian)

    def itrs(self, east: Any, north: Any, height: Any) -> np.ndarray:
        """Points in the ITRS: coordinates (...), metres -> (..., 3), metres."""
        per_longitude, per_latitude = self.scale
        longitude = self.longitude + np.asarray(east, dtype=np.float64) / per_longitude
        return _EARTH.ecef(longitude, self.latitude + np.asarray(north, dtype=np.float64) / per_latitude, height)

    def local(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """East, north and height, metres, (...) each, of points (..., 3) in the ITRS; NaN stays NaN."""
        longitude, latitude, height = _EARTH.geodetic(points)
        per_longitude, per_latitude = self.scale
        turn = (longitude - self.longitude + np.pi) % (2.0 * np.pi) - np.pi
        return turn * per_longitude, (latitude - self.latitude) * per_latitude, height
