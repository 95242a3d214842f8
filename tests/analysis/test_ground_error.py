"""What changes of a pair do on the ground, against rays from an orbit over a sphere that are intersected exactly.

Circles and intervals that hold a share of errors, against closed forms and draws.
"""

import math

import numpy as np
import pytest
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from analysis.arrays import ARCSEC
from analysis.monitor.monitor_formulas import EARTH_RADIUS_M, GroundGeometry
from analysis.orbit.forward_intersection import (
    CalibratedLine,
    Sightings,
    circle_of_points,
    circular_error,
    intersect_pair,
    interval_of_points,
    linear_error,
    predicted,
    realised,
)
from tests.analysis.refusals import refuses

ALTITUDE, LOOKS, FIELD, FOCAL = 505e3, (math.radians(26.0), math.radians(-5.0)), (0.018, 0.019), (5.5, 5.4)
SMALL = 2.0 * ARCSEC
NAMES = ("d_alpha", "d_beta", "d_gamma", "d_f")


def geometry():
    return GroundGeometry(ALTITUDE, ("one", "two"), LOOKS, FIELD)


def body_axes(angle):
    """Body to Earth at an angle along the circular orbit in the plane X, Z: columns X forward, Y right, Z down."""
    c, s = math.cos(angle), math.sin(angle)
    up, forward = np.array([s, 0.0, c]), np.array([c, 0.0, -s])
    return np.stack([forward, np.cross(-up, forward), -up], axis=1)


def looking(look, change):
    """Camera to body, when it is turned by d_alpha about Y, d_beta about X, d_gamma about Z."""
    alpha, beta, gamma, _ = change
    return (Rotation.from_euler("y", look) * Rotation.from_rotvec([beta, alpha, gamma])).as_matrix()


def sighting(point, look, change, focal):
    """Where on the orbit a changed line sees a ground point, and at which place y / f of its nominal line."""

    def miss(unknown):
        angle, place = unknown
        axes = body_axes(angle)
        ray = looking(look, change).T @ axes.T @ (point - (EARTH_RADIUS_M + ALTITUDE) * -axes[:, 2])
        seen = ray / ray[2]
        return [seen[0], seen[1] - place * focal / (focal + change[3])]

    # flying forward along +X; a forward look sees a point ahead
    start = -math.tan(look) * ALTITUDE / EARTH_RADIUS_M
    angle, place = fsolve(miss, [start, point[1] / ALTITUDE], xtol=1e-12)
    assert np.max(np.abs(miss([angle, place]))) < 1e-13
    return angle, place


def found_minus_true(across, changes):
    """Error along, across, up of a point that is found with the nominal cameras, metres: by least squares of the
    distances from both rays, and by the intersection of twin.orbit, which weighs them by the rays' lengths."""
    forward, side = np.array([1.0, 0.0, 0.0]), math.asin(across / EARTH_RADIUS_M)
    # to the right of who flies toward +X and has +Z above is -Y
    up = np.array([0.0, -math.sin(side), math.cos(side)])
    point = EARTH_RADIUS_M * up
    normal, right, lines, sightings = np.zeros((3, 3)), np.zeros(3), [], []
    for look, change, focal in zip(LOOKS, changes, FOCAL, strict=True):
        angle, place = sighting(point, look, change, focal)
        axes, camera = body_axes(angle), looking(look, np.zeros(4))
        direction, station = camera @ np.array([0.0, place, 1.0]), -(EARTH_RADIUS_M + ALTITUDE) * axes[:, 2]
        ray = axes @ direction / np.linalg.norm(direction)
        square = np.eye(3) - np.outer(ray, ray)
        normal, right = normal + square, right + square @ (station - point)
        # a line of one pixel that looks there
        lines.append(CalibratedLine(1, direction[None], np.zeros((1, 3)), camera, focal))
        sightings.append(Sightings(np.zeros(1), station[None], axes[None]))
    axes = np.stack([forward, np.cross(-up, forward), up])
    found = axes @ np.linalg.solve(normal, right)
    other = axes @ (intersect_pair(lines[0], lines[1], *sightings).ground[0] - point)
    return found, other


@pytest.mark.second
@pytest.mark.parametrize("place", [0, 4, 8])
@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("parameter", range(4), ids=NAMES)
def test_rows_are_those_of_rays_from_an_orbit(place, camera, parameter):
    """The middle and both ends of the line. There the sphere falls away by across / R = 1.5 mrad, which the flat frame
    of the rows leaves out, and so does the slant range across: some 1e-3 of the row's size."""
    ground = geometry()
    reach = min(r * t for r, t in zip(ground.ranges_m, FIELD, strict=True))
    across = np.linspace(-reach, reach, 9)[place]
    size = SMALL * (10.0 * FOCAL[camera] if parameter == 3 else 1.0)
    ends = []
    for sign in (1.0, -1.0):
        changes = np.zeros((2, 4))
        changes[camera, parameter] = sign * size
        ends.append(found_minus_true(across, changes))
    row, other = (np.subtract(*pair) / (2.0 * size) for pair in zip(*ends, strict=True))
    expected = ground.rows(FOCAL)[place, :, 4 * camera + parameter]
    largest = np.abs(ground.rows(FOCAL)[:, :, 4 * camera + parameter]).max()
    assert largest * size > 0.05  # centimetres at least: not a test of nothing
    assert row == pytest.approx(expected, abs=3e-3 * largest)
    # weights of twin.orbit differ by the ranges' squares, which matters where rays pass each other beside
    assert other[[0, 2]] == pytest.approx(expected[[0, 2]], abs=4e-3 * largest)
    assert other[1] == pytest.approx(expected[1], rel=0.15, abs=3e-3 * largest)


# --- ground errors ----------------------------------------------------------------------------------------------------


def test_closed_forms() -> None:
    """Rayleigh's distribution for a round covariance, the normal one along a line."""
    for share in (0.5, 0.9, 0.95, 0.99):
        assert circular_error(4.0 * np.eye(2), share) == pytest.approx(2.0 * np.sqrt(-2.0 * np.log1p(-share)), rel=1e-9)
        line = linear_error(9.0, share)
        assert circular_error(np.diag([9.0, 0.0]), share) == pytest.approx(line, rel=1e-7)
    assert linear_error(1.0) == pytest.approx(1.6448536, rel=1e-7)
    assert circular_error(np.zeros((2, 2))) == 0.0


@pytest.mark.parametrize("ratio", [0.03, 0.2, 0.6])
def test_turned_ellipses_hold_their_share_of_draws(ratio: float) -> None:
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    covariance = turn @ np.diag([2.5, 2.5 * ratio]) ** 2 @ turn.T
    radius = circular_error(np.stack([covariance, 0.25 * covariance]))
    assert radius[1] == pytest.approx(0.5 * radius[0], rel=1e-12)
    draws = np.random.default_rng(2).standard_normal((400_000, 2)) @ np.linalg.cholesky(covariance).T
    # 400 000 draws: the share has a sigma of 5e-4
    assert np.mean(np.hypot(*draws.T) < radius[0]) == pytest.approx(0.9, abs=2e-3)


def test_a_set_of_points_holds_its_share_of_draws() -> None:
    spread = np.stack([np.diag([9.0, 0.0]), np.eye(2)])
    radius = circle_of_points(spread)
    sigma = np.array([[3.0, 0.0], [1.0, 1.0]])
    draws = np.random.default_rng(3).standard_normal((2, 200_000, 2)) * sigma[:, None]
    # 400 000 draws: the share has a sigma of 5e-4
    assert np.mean(np.hypot(draws[..., 0], draws[..., 1]) < radius) == pytest.approx(0.9, abs=2e-3)
    assert circle_of_points(np.stack([spread[0]] * 3)) == pytest.approx(float(circular_error(spread[0])), rel=1e-9)


def test_what_is_no_covariance_or_share() -> None:
    refuses(ValueError, "negative", circular_error, np.diag([1.0, -1.0]))
    for share in (0.0, 1.0, 90.0):
        refuses(ValueError, "share", circular_error, np.eye(2), share)


def test_shares_of_errors_are_those_of_their_prediction() -> None:
    """Errors at the pole of x, where up is x and east is y: shares of draws against the prediction."""
    assert interval_of_points(np.array([9.0])) == pytest.approx(3 * 1.644854, rel=1e-5)
    error = np.random.default_rng(1).standard_normal((40_000, 3)) * [2.0, 1.0, 3.0]
    place = np.tile([6378137.0, 0.0, 0.0], (len(error), 1))
    found, said = realised(place, error), predicted(place[:1], np.diag([4.0, 1.0, 9.0])[None])
    assert (found.ce90, found.le90) == pytest.approx((said.ce90, said.le90), rel=0.02)
