"""The Earth's rotation against astropy and Skyfield, with the same UT1 - UTC and polar motion.

Ellipsoid, level frames and ground coordinates against PROJ.
"""

import numpy as np
import pytest

from twin.orbit.flight.earth import Earth, curvature_radii, east_north_up
from twin.orbit.ground.grid import GroundFrame

pytestmark = pytest.mark.oracle

ARCSEC = np.pi / 648000
EPOCHS = ["1994-09-01T00:00:00Z", "2011-03-05T03:05:00Z", "2020-11-03T03:30:12.25Z"]
SECONDS = np.array([-40000.0, -600.0, 0.0, 12.34567, 600.0, 86000.0])
POLAR_MOTION = (0.2 * ARCSEC, -0.45 * ARCSEC)
DUT1 = -0.4321


def places() -> np.ndarray:
    """Directions all round at the distance of a satellite, metres."""
    generator = np.random.default_rng(3)
    direction = generator.standard_normal((len(SECONDS), 200, 3))
    return 6.878e6 * direction / np.linalg.norm(direction, axis=-1, keepdims=True)


@pytest.mark.parametrize("epoch", EPOCHS)
@pytest.mark.parametrize("polar_motion", [(0.0, 0.0), POLAR_MOTION])
def test_astropy(epoch: str, polar_motion: tuple[float, float]) -> None:
    """It stands on the same library ERFA, so only our use of it is checked, to rounding of times and lengths."""
    pytest.importorskip("astropy")
    from astropy import units
    from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
    from astropy.time import Time, TimeDelta
    from astropy.utils import iers

    class Given(iers.IERS):
        def pm_xy(self, jd1, jd2=0.0, return_status=False):
            given = tuple(np.full(np.shape(jd1), p) * units.rad for p in polar_motion)
            return (*given, np.zeros(np.shape(jd1), int)) if return_status else given

    # no leap second falls into these spans
    time = Time(epoch.removesuffix("Z"), scale="utc") + TimeDelta(SECONDS, format="sec")
    itrs = Earth(DUT1, polar_motion).to_itrs(SECONDS, epoch)
    checked = 0
    with iers.earth_orientation_table.set(Given()):
        for one, matrix, place in zip(time, itrs, places(), strict=True):
            one.delta_ut1_utc = DUT1
            x, y, z = place.T * units.m
            sky = GCRS(CartesianRepresentation(x, y, z), obstime=one)
            theirs = sky.transform_to(ITRS(obstime=one)).cartesian.xyz.to_value(units.m).T
            np.testing.assert_allclose(place @ matrix.T, theirs, rtol=0, atol=1e-6)
            checked += 1
    assert checked == len(SECONDS)


@pytest.mark.parametrize("epoch", EPOCHS)
def test_skyfield(epoch: str) -> None:
    """Independent code and another way (equinox, not celestial origin). 1 mm is 30 microarcsec: Skyfield lacks the
    small corrections that fit the nutation of 2000 to the precession of 2006 (some 15 microarcsec in these years).
    """
    pytest.importorskip("skyfield")
    from datetime import datetime, timedelta

    from skyfield.api import load
    from skyfield.framelib import itrs as frame

    scale = load.timescale(builtin=True)
    x, y = (p / ARCSEC for p in POLAR_MOTION)
    scale.polar_motion_table = np.array([0.0, 1e7]), np.array([x, x]), np.array([y, y])
    checked = 0
    start = datetime.fromisoformat(epoch)
    for second, place in zip(SECONDS[1:-1], places()[1:-1], strict=True):
        # its UT1 is interpolated from a table, so each instant is an epoch of its own
        instant = start + timedelta(seconds=float(second))
        time = scale.from_datetime(instant)
        text = instant.isoformat().replace("+00:00", "Z")
        ours = Earth(float(time.dut1), POLAR_MOTION).to_itrs(0.0, text)
        theirs = frame.rotation_at(time)
        np.testing.assert_allclose(place @ ours.T, place @ theirs.T, rtol=0, atol=1e-3)
        # and what is switched on can be seen: polar motion moves a satellite by metres
        assert np.max(np.abs(place @ (Earth(float(time.dut1)).to_itrs(0.0, text) - theirs).T)) > 5.0
        checked += 1
    assert checked == 4


# --- geodesy oracle ---------------------------------------------------------------------------------------------------

pyproj = pytest.importorskip("pyproj", reason="pyproj not installed")

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
