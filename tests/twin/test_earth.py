"""WGS84 against PROJ and first principles, rays against heights, and the rotation's own consistency."""

import erfa
import numpy as np
import pyproj
import pytest

from twin.orbit.flight.earth import (
    DAY,
    EQUATORIAL_RADIUS,
    FLATTENING,
    RATE,
    Earth,
    curvature_radii,
    east_north_up,
    tai_of,
)

EARTH = Earth(-0.15, (4e-7, -2e-6))
EPOCH = "2011-03-05T03:05:00Z"
PROJ = pyproj.Transformer.from_pipeline("+proj=cart +ellps=WGS84")
POLAR_RADIUS = EQUATORIAL_RADIUS * (1.0 - FLATTENING)


def scattered(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Longitudes and latitudes spread evenly over the sphere, with poles, equator and date line."""
    generator = np.random.default_rng(seed)
    lon, lat = generator.uniform(-np.pi, np.pi, count), np.arcsin(generator.uniform(-1.0, 1.0, count))
    lon[:5], lat[:5] = [0.0, 1.0, np.pi, -np.pi / 2, 0.5], [0.0, 0.5, -0.5, 1.57, -1.57]
    return lon, lat


@pytest.mark.parametrize("height", [-10e3, 0.0, 9e3, 500e3, 40e6])
def test_geodetic_coordinates(height: float) -> None:
    lon, lat = scattered(20_000)
    theirs = np.stack(PROJ.transform(lon, lat, np.full_like(lon, height), radians=True), axis=-1)
    # a few roundings of numbers of this size
    rounding = 1e-15 * (EQUATORIAL_RADIUS + height)
    np.testing.assert_allclose(EARTH.ecef(lon, lat, height), theirs, rtol=0, atol=rounding)
    found = EARTH.geodetic(theirs.reshape(100, 200, 3))
    assert found[0].shape == (100, 200)
    back = np.stack([a.ravel() for a in found])
    scale = EQUATORIAL_RADIUS + height
    np.testing.assert_allclose((back[0] - lon) * np.cos(lat) * scale, 0.0, atol=3 * rounding)
    np.testing.assert_allclose((back[1] - lat) * scale, 0.0, atol=3 * rounding)
    np.testing.assert_allclose(back[2], height, rtol=0, atol=3 * rounding)


def test_poles() -> None:
    for sign in (1.0, -1.0):
        _, lat, height = EARTH.geodetic([0.0, 0.0, sign * (POLAR_RADIUS + 700.0)])
        assert lat == pytest.approx(sign * np.pi / 2, abs=1e-15)
        assert height == pytest.approx(700.0, abs=1e-8)


def test_local_axes_and_curvature() -> None:
    lon, lat = scattered(500)
    axes = east_north_up(lon, lat)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, -1, -2), np.broadcast_to(np.eye(3), (500, 3, 3)), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-14)
    # up is the gradient of x^2/a^2 + y^2/a^2 + z^2/b^2
    gradient = EARTH.ecef(lon, lat) / np.array([EQUATORIAL_RADIUS, EQUATORIAL_RADIUS, POLAR_RADIUS]) ** 2
    gradient /= np.linalg.norm(gradient, axis=-1, keepdims=True)
    np.testing.assert_allclose(axes[:, 2], gradient, atol=1e-15)
    # steps of 1e-5 rad: differences are right to step^2 = 1e-10 and rounding 1e-9 m / 60 m
    step = 1e-5
    meridian, normal = curvature_radii(lat)
    for delta, axis, radius in (((step, 0.0), 0, normal * np.cos(lat)), ((0.0, step), 1, meridian)):
        moved = EARTH.ecef(lon + delta[0], lat + delta[1]) - EARTH.ecef(lon - delta[0], lat - delta[1])
        np.testing.assert_allclose(moved / (2 * step), radius[:, None] * axes[:, axis], rtol=0, atol=2e-3)


def rays(count: int, steepest: float = 0.0, flattest: float = 60.0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from 500 km, off nadir by up to 60 degrees (the limb is at 68)."""
    generator = np.random.default_rng(2)
    lon, lat = scattered(count, 3)
    off, azimuth = np.radians(generator.uniform(steepest, flattest, count)), generator.uniform(0, 2 * np.pi, count)
    local = np.stack([np.sin(off) * np.sin(azimuth), np.sin(off) * np.cos(azimuth), -np.cos(off)], axis=-1)
    return EARTH.ecef(lon, lat, 500e3), np.einsum("nij,ni->nj", east_north_up(lon, lat), local)


@pytest.mark.parametrize("height", [-400.0, 0.0, 2500.0, 8848.0])
def test_rays_come_down_to_a_height(height: float) -> None:
    origin, direction = rays(5000)
    points = EARTH.intersect(origin, 7.0 * direction, height)
    assert np.all(np.isfinite(points))
    np.testing.assert_allclose(EARTH.geodetic(points)[2], height, rtol=0, atol=1e-7)
    # PROJ's own inverse is right to 1e-6 m at these heights
    np.testing.assert_allclose(
        PROJ.transform(*points.T, radians=True, direction="INVERSE")[2], height, rtol=0, atol=2e-6
    )
    way = points - origin
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    np.testing.assert_allclose(way / length, direction, rtol=0, atol=1e-12)
    # the nearer of the two places: no lower point on the way
    for share in (0.5, 0.9, 0.99, 0.9999):
        assert np.all(EARTH.geodetic(origin + share * way)[2] > height)


def test_rays_that_miss() -> None:
    # in the plane of the equator the ellipsoid is a circle, whose limb is known
    origin = np.array([EQUATORIAL_RADIUS + 500e3, 0.0, 0.0])
    limb = np.arcsin((EQUATORIAL_RADIUS + 1000.0) / origin[0])
    for off, hits in ((limb - 1e-6, True), (limb + 1e-6, False), (1.5, False), (np.pi, False)):
        found = EARTH.intersect(origin, [-np.cos(off), np.sin(off), 0.0], 1000.0)
        assert np.all(np.isfinite(found)) == hits
    # also from below the surface
    assert np.all(np.isnan(EARTH.intersect([EQUATORIAL_RADIUS, 0.0, 0.0], [-1.0, 0.0, 0.0], 1000.0)))
    # a miss leaves the others alone, and heights are one for each ray
    both = EARTH.intersect(origin, [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [10.0, 20.0])
    np.testing.assert_allclose(both[0], [EQUATORIAL_RADIUS + 10.0, 0.0, 0.0], atol=1e-8)
    assert np.all(np.isnan(both[1]))


def test_atomic_time() -> None:
    # TAI - UTC was 34 s in 2011 and 37 s from 2017 (IERS bulletin C)
    for epoch, julian, offset in (("2011-03-05T12:00:00Z", 2455626.0, 34.0), ("2020-01-01T12:00:00Z", 2458850.0, 37.0)):
        one, two = tai_of(epoch)
        assert (one - julian + two) * DAY == pytest.approx(offset, abs=1e-9)
    with pytest.raises(ValueError, match="zone"):
        tai_of("2011-03-05T12:00:00")
    assert tai_of("2011-03-05T20:00:00+08:00") == tai_of("2011-03-05T12:00:00Z")


def test_interpolated_poles() -> None:
    # against the full series at every instant; 1e-14 rad is 70 nm at the satellite
    seconds = np.linspace(-1.0 * DAY, 1.5 * DAY, 200)
    rotation = Earth().rotation(EPOCH, seconds[0], seconds[-1])
    one, two = tai_of(EPOCH)
    matrix = erfa.c2i06a(one, two + (32.184 + seconds) / DAY)
    np.testing.assert_allclose(rotation.celestial(seconds), matrix, rtol=0, atol=1e-14)


def test_the_earth_turns_east_at_the_known_rate() -> None:
    matrix = EARTH.to_itrs([0.0, 10.0], EPOCH)
    star = matrix @ np.array([1.0, 0.0, 0.0])
    lon = np.arctan2(star[:, 1], star[:, 0])
    # a star moves west; the mean rate is 7.292115e-5 rad/s (GRS80)
    assert (lon[1] - lon[0]) / 10.0 == pytest.approx(-7.292115e-5, rel=1e-7)
    assert pytest.approx(7.292115e-5, rel=1e-7) == RATE
    np.testing.assert_allclose(matrix @ np.swapaxes(matrix, -1, -2), [np.eye(3)] * 2, atol=2e-15)


def test_rate_is_the_derivative_of_the_matrix() -> None:
    rotation = EARTH.rotation(EPOCH, -600.0, 600.0)
    t = np.linspace(-600.0, 600.0, 41)
    rate = rotation.rate(t)
    # fourth-order differences over 30 s: truncation (RATE h)^4 / 30 of RATE = 6e-17 rad/s, rounding 1e-17 rad/s
    h = 30.0
    m = {k: rotation.matrix(t + k * h) for k in (-2, -1, 1, 2)}
    derivative = ((m[1] - m[-1]) * 8.0 - (m[2] - m[-2])) / (12.0 * h)
    cross = -derivative @ np.swapaxes(rotation.matrix(t), -1, -2)
    np.testing.assert_allclose(cross[:, [2, 0, 1], [1, 2, 0]], rate, rtol=0, atol=1e-16)
    assert np.max(np.abs(rate[:, :2])) > 1e-11  # polar motion tilts the axis


def test_a_leap_second_does_not_stop_the_earth() -> None:
    # 2016-12-31 ended in a leap second: 120 s after 23:59:00 it was 00:00:59, and UT1 - UTC had grown by 1 s
    before = Earth(-0.4).to_itrs(120.0, "2016-12-31T23:59:00Z")
    after = Earth(0.6).to_itrs(0.0, "2017-01-01T00:00:59Z")
    np.testing.assert_allclose(before, after, rtol=0, atol=1e-14)


def test_ut1_turns_the_earth() -> None:
    # one millisecond is 0.465 m at the equator
    point = EARTH.ecef(0.0, 0.0)
    moved = (Earth(0.001).to_itrs(0.0, EPOCH) - Earth(0.0).to_itrs(0.0, EPOCH)) @ Earth(0.0).to_itrs(0.0, EPOCH).T
    assert (moved @ point)[1] == pytest.approx(-0.4651, abs=1e-4)
