"""Ellipsoid, level frames and ground coordinates against PROJ."""

import numpy as np
import pytest

from twin.orbit.flight.earth import Earth, curvature_radii, east_north_up
from twin.orbit.ground.grid import GroundFrame

pyproj = pytest.importorskip("pyproj", reason="pyproj not installed")
pytestmark = pytest.mark.oracle

PLACES = [(116.0, 40.0), (-70.3, -33.4), (179.9, 68.0), (10.0, 0.5)]
COUNT = 4000


def everywhere() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longitude, latitude (degrees) and height (metres) from the sea to a satellite."""
    rng = np.random.default_rng(7)
    latitude = np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, COUNT)))
    return rng.uniform(-180.0, 180.0, COUNT), latitude, np.repeat([-400.0, 0.0, 8800.0, 500e3], COUNT // 4)


def test_geodetic_to_geocentric() -> None:
    """EPSG:4979 to EPSG:4978. A point 7000 km away is rounded to 1e-9 m."""
    longitude, latitude, height = everywhere()
    there = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    want = np.stack(there.transform(longitude, latitude, height), axis=-1)
    got = Earth().ecef(np.radians(longitude), np.radians(latitude), height)
    assert got.shape == (COUNT, 3)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-8)


def test_geocentric_to_geodetic() -> None:
    """PROJ's forward way, which is a closed formula, undone by ours: PROJ's inverse is 2 mm off at 500 km."""
    longitude, latitude, height = everywhere()
    there = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    points = np.stack(there.transform(longitude, latitude, height), axis=-1)
    lon, lat, up = Earth().geodetic(points)
    metres = 6.378e6
    np.testing.assert_allclose(metres * (lat - np.radians(latitude)), np.zeros(COUNT), rtol=0, atol=2e-8)
    east = metres * np.cos(lat) * (lon - np.radians(longitude))
    np.testing.assert_allclose(east, np.zeros(COUNT), rtol=0, atol=2e-8)
    np.testing.assert_allclose(up, height, rtol=0, atol=2e-8)


@pytest.mark.parametrize(("longitude", "latitude"), PLACES)
def test_local_level_frame(longitude: float, latitude: float) -> None:
    """PROJ's topocentric coordinates of points round a place."""
    steps = f"+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 +lon_0={longitude} +lat_0={latitude}"
    theirs = pyproj.Transformer.from_pipeline(f"+proj=pipeline {steps}")
    rng = np.random.default_rng(8)
    lon, lat = (np.radians(a + rng.uniform(-3.0, 3.0, 500)) for a in (longitude, latitude))
    height = rng.uniform(0.0, 500e3, 500)
    want = np.stack(theirs.transform(lon, lat, height, radians=True), axis=-1)
    origin = np.radians([longitude, latitude])
    offset = Earth().ecef(lon, lat, height) - Earth().ecef(*origin)
    got = offset @ east_north_up(*origin).T
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-8)
    assert np.max(np.abs(want)) > 4e5


@pytest.mark.parametrize(("longitude", "latitude"), PLACES)
def test_ground_coordinates_beside_a_transverse_mercator_map(longitude: float, latitude: float) -> None:
    """Near its middle a ground frame is a conformal map of scale 1 but for terms of second order.

    With east x = N cos(lat0) dl, north y = M dp, the map's series (Snyder 1987, 8-9 to 8-10) begins
    X = x - x y tan(lat0) / N and Y = y + x^2 tan(lat0) / (2 N) + 3 e^2 sin cos / (2 (1 - e^2 sin^2)) y^2 / M;
    what is left is of third order, below (r / 6000 km)^2 r times a few.
    """
    frame = GroundFrame(*np.radians([longitude, latitude]))
    definition = f"+proj=tmerc +ellps=WGS84 +k=1 +lon_0={longitude} +lat_0={latitude}"
    to_map = pyproj.Proj(definition)
    rng = np.random.default_rng(9)
    x, y = rng.uniform(-2000.0, 2000.0, (2, 1000))
    lon, lat, _ = Earth().geodetic(frame.itrs(x, y, np.zeros(1000)))
    east, north = to_map(np.degrees(lon), np.degrees(lat))
    meridian, normal = curvature_radii(frame.latitude)
    tangent = np.tan(frame.latitude)
    e2 = 0.00669437999014
    sine, cosine = np.sin(frame.latitude), np.cos(frame.latitude)
    want_east = x - x * y * tangent / normal
    want_north = y + x**2 * tangent / (2.0 * normal)
    want_north += 1.5 * e2 * sine * cosine / (1.0 - e2 * sine**2) * y**2 / meridian
    left = 6.0 * (1.0 + tangent**2) * 2000.0**3 / 6.3e6**2
    np.testing.assert_allclose(east, want_east, rtol=0, atol=left)
    np.testing.assert_allclose(north, want_north, rtol=0, atol=left)
    back = frame.local(frame.itrs(x, y, np.full(1000, 300.0)))
    np.testing.assert_allclose(np.stack(back), [x, y, np.full(1000, 300.0)], rtol=0, atol=2e-8)
