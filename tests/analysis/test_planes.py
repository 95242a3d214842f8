"""Planes and angles of three CCD lines from ground points (paper 000). The geometry is built here from the orbit's
elements, the WGS84 ellipsoid and rays turned by OpenCV's rotations; no plane is fitted in making it.
"""

import warnings
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from analysis.orbit.planes import (
    METHODS,
    AngleError,
    NearVerticalWarning,
    PlaneError,
    Station,
    Strip,
    angles_between,
    fit_plane,
    height_error,
    intersection_angles,
    line_frame,
    look_angle,
    off_axis_angle,
)
from tests.analysis.refusals import refuses

FALSE_ALARM = 1e-6
ARCSEC = np.pi / 648000
DEG = np.pi / 180
LOOK = 25 * DEG
LINES = {"forward": LOOK, "nadir": 0.0, "backward": -LOOK}
# WGS84, and the Earth's rate (IERS conventions)
A, F, RATE, GM = 6378137.0, 1 / 298.257223563, 7.292115e-5, 3.986004418e14


def rotation(vector):
    return cv2.Rodrigues(np.asarray(vector, dtype=np.float64))[0]


def enu(lon, lat):
    """Rows: east, north, up of the ellipsoid in ECEF."""
    sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    return np.array([[-sl, cl, 0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


@dataclass(frozen=True)
class Pass:
    """One moment of a pass. body: columns X flight, Y, Z down of the body in ECEF; looks: line -> (n,) tangents."""

    station: np.ndarray
    body: np.ndarray
    points: dict
    tangents: dict
    up: np.ndarray

    def strips(self, noise, turn=None):
        turn = np.eye(3) if turn is None else turn
        return [Strip.of(p @ turn.T, noise) for p in self.points.values()]


def descending_pass(
    lon=116 * DEG, lat=40 * DEG, height=500e3, inclination=97.4 * DEG, yaw=True, n=20, relief=1000.0, seed=0,
    looks=LINES, twist=0.0, offset=0.0, half_width=0.06,
):  # fmt: skip
    """Nadir-pointing satellite above (lon, lat) on the way south; X along the ground velocity (yaw) or the inertial.

    twist: turn of the forward line about its own line of sight. offset: tangent of its centre across the track.
    """
    east, north, up = axes = enu(lon, lat)
    radius = A / np.sqrt(1 - F * (2 - F) * np.sin(lat) ** 2)
    station = radius * np.array([1, 1, (1 - F) ** 2]) * up + height * up
    r = np.linalg.norm(station)
    latitude = np.arcsin(station[2] / r)
    # heading of the orbit plane: cos i = cos(geocentric latitude) sin(azimuth)
    speed, azimuth = np.sqrt(GM / r), np.pi - np.arcsin(np.cos(inclination) / np.cos(latitude))
    velocity = speed * (np.sin(azimuth) * east + np.cos(azimuth) * north)
    if yaw:
        velocity = velocity - np.cross([0, 0, RATE], station)
    down = -axes[2]
    forward = velocity - (velocity @ down) * down
    forward /= np.linalg.norm(forward)
    body = np.column_stack([forward, np.cross(down, forward), down])
    rng = np.random.default_rng(seed)
    points, tangents = {}, {}
    for name, look in looks.items():
        w = np.sort(rng.uniform(-half_width, half_width, n))
        ray = np.column_stack([np.zeros(n), w, np.ones(n)])
        if name == "forward":
            ray = ray @ rotation([0, 0, twist]).T
            ray[:, 1] += offset * ray[:, 2]
        ray = ray @ rotation([0, look, 0]).T @ body.T
        points[name] = station + ray * range_to(station, ray, rng.uniform(0, relief, n))[:, None]
        tangents[name] = w
    return Pass(station, body, points, tangents, up)


def range_to(origin, ray, relief):
    """Multiples of `ray` (n, 3) that reach an ellipsoid with axes longer by `relief` (n,)."""
    scale = 1 / np.column_stack([A + relief, A + relief, A * (1 - F) + relief])
    o, d = origin * scale, ray * scale
    a, b, c = np.sum(d * d, 1), np.sum(o * d, 1), np.sum(o * o, 1) - 1
    return (-b - np.sqrt(b * b - a * c)) / a


def fits(scene, method="tls", noise=1.5, sigma_station=0.5, turn=None):
    turn = np.eye(3) if turn is None else turn
    station = Station.of(turn @ scene.station, sigma_station)
    return [fit_plane(station, strip, method) for strip in scene.strips(noise, turn)]


def noisy(scene, rng, sigma_point, sigma_station):
    """A measured copy of the scene."""
    return Pass(
        scene.station + sigma_station * rng.standard_normal(3),
        scene.body,
        {k: p + sigma_point * rng.standard_normal(p.shape) for k, p in scene.points.items()},
        scene.tangents,
        scene.up,
    )


def orbital(scene):
    """ECEF to X forward, Y, Z down: the nadir plane is exactly vertical."""
    return scene.body.T


SCENE = descending_pass()


@pytest.mark.parametrize("method", METHODS)
def test_look_angles_without_errors(method):
    """1e-4 arcsec asked; ECEF coordinates of 7e6 m are rounded to 1e-9 m, over 20 points and 500 km 1e-9 arcsec."""
    angles = intersection_angles(*fits(SCENE, method))
    assert np.abs(angles.values - LOOK).max() < 1e-8 * ARCSEC
    assert np.abs(angles.printed - LOOK).max() < 1e-8 * ARCSEC
    assert not np.any(angles.folded)


def test_printed_equation_turns_every_plane_by_half_a_turn_about_z():
    """Noise or not, the printed normals are the corrected ones turned by pi about z: equal angles, another plane."""
    scene = noisy(SCENE, np.random.default_rng(3), 2.0, 1.0)
    printed, corrected = fits(scene, "printed"), fits(scene, "corrected")
    half = rotation([0, 0, np.pi])
    for one, other in zip(printed, corrected, strict=True):
        assert one.normal == pytest.approx(half @ other.normal, abs=1e-14)
        assert one.covariance == pytest.approx(half @ other.covariance @ half.T, abs=1e-24)
        # both pass through the station, but only one through the ground points
        a0, a1, a2 = one.coefficients
        x, y, z = one.station.position
        assert a0 * x + a1 * y + a2 == pytest.approx(z, abs=1e-8)
        assert np.abs(other.residual).max() < 10.0
        assert np.abs(one.residual).min() > 100e3
        assert one.p_value < FALSE_ALARM < other.p_value
    a, b = intersection_angles(*printed), intersection_angles(*corrected)
    assert a.values == pytest.approx(b.values, abs=1e-14)
    assert a.covariance == pytest.approx(b.covariance, rel=1e-9)
    refuses(
        AngleError,
        "printed cannot be compared with one of corrected",
        intersection_angles,
        printed[0],
        corrected[1],
        printed[2],
    )


def test_coefficients_solve_the_papers_least_squares():
    """a0, a1 against NumPy's lstsq of eq. 2 in undivided coordinates."""
    scene = noisy(SCENE, np.random.default_rng(4), 2.0, 1.0)
    for fit in fits(scene, "corrected"):
        arm = fit.strip.points - fit.station.position
        expected = np.linalg.lstsq(arm[:, :2], arm[:, 2], rcond=None)[0]
        assert fit.coefficients[:2] == pytest.approx(expected, rel=1e-10)


def test_alpha_and_beta_share_the_error_of_the_station():
    """The station moved by each of its sigmas and fitted anew changes both angles together; the covariance is the sum
    of these products beside that of the points. 1.5 m at 500 km are 3e-6 rad: the second order is as small."""
    strips, spread = SCENE.strips(1.5), np.diag([1.0, 4.0, 9.0]) + 0.5

    def planes(place):
        return [fit_plane(Station.of(place, spread), s) for s in strips]

    change = []
    for step in np.linalg.cholesky(spread).T:
        ahead, back = (intersection_angles(*planes(SCENE.station + way * step)).values for way in (1.0, -1.0))
        change.append(0.5 * (ahead - back))
    fitted = planes(SCENE.station)
    found = intersection_angles(*fitted)
    points = np.array([plane.point_covariance for plane in fitted])
    own = np.einsum("mki,kij,lkj->ml", found.gradient, points, found.gradient)
    shared = np.array(change).T @ np.array(change)
    assert found.covariance - own == pytest.approx(shared, rel=1e-3)
    assert abs(shared[0, 1]) > 0.3 * np.sqrt(shared[0, 0] * shared[1, 1])


def test_full_covariances():
    """Errors ten times larger in height than in plan, and different from point to point: the normal minimises the
    weighted distances, whose weights turn with it, and its sigmas are where they grow by one."""
    rng = np.random.default_rng(6)
    local = enu(116 * DEG, 40 * DEG)
    point = local.T @ np.diag([0.5, 0.5, 5.0]) ** 2 @ local * rng.uniform(0.3, 3, 20)[:, None, None]
    place = local.T @ np.diag([0.2, 0.4, 1.0]) ** 2 @ local
    noise = np.einsum("nij,knj->kni", np.linalg.cholesky(point), rng.standard_normal((3, 20, 3)))

    def objective(normal, arm):
        normal = normal / np.linalg.norm(normal)
        spread = np.diag(np.einsum("i,nij,j->n", normal, point, normal)) + normal @ place @ normal
        return arm @ normal @ np.linalg.solve(spread, arm @ normal)

    for points, error in zip(SCENE.points.values(), noise, strict=True):
        plane = fit_plane(Station.of(SCENE.station, place), Strip.of(points + error, point))
        values, axes = np.linalg.eigh(plane.covariance)
        for variance, axis in zip(values[1:], axes.T[1:], strict=True):
            step = np.sqrt(variance) * axis
            ends = [objective(plane.normal + sign * step, points + error - SCENE.station) for sign in (1, -1)]
            # a parabola of unit curvature per sigma: its lowest point lies at this many sigmas
            assert abs(ends[0] - ends[1]) / 4 < 1e-3
            assert sum(ends) / 2 - plane.chi_square == pytest.approx(1.0, abs=0.01)


def test_both_ways_of_total_least_squares_agree():
    """Isotropic errors by the singular vector; all but isotropic ones by Gauss-Helmert steps."""
    scene = noisy(SCENE, np.random.default_rng(7), 1.5, 0.5)
    nearly = np.diag([2.25, 2.25, 2.25 * (1 + 1e-12)])
    iterated = fit_plane(Station.of(scene.station, 0.5), Strip.of(scene.points["backward"], nearly))
    direct = fit_plane(Station.of(scene.station, 0.5), Strip.of(scene.points["backward"], 1.5))
    assert iterated.normal == pytest.approx(direct.normal, abs=1e-13)


def test_nearly_vertical_plane_is_announced():
    """Orbital frame and local frame of the station: the nadir plane is vertical but for noise. Condition, bias and a
    warning say so; ECEF at 40 N is safe, and total least squares needs no warning anywhere.
    """
    scene = noisy(SCENE, np.random.default_rng(9), 2.0, 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        safe = fits(scene, "corrected", 2.0)
        fits(scene, "tls", 2.0, turn=orbital(scene))
    assert not any(plane.near_vertical for plane in safe)
    for turn in (orbital(scene), enu(116 * DEG, 40 * DEG)):
        station = Station.of(turn @ scene.station, 0.5)
        for name, strip in zip(LINES, scene.strips(2.0, turn), strict=True):
            if name == "nadir":
                with pytest.warns(NearVerticalWarning, match="nearly vertical"):
                    plane = fit_plane(station, strip, "corrected")
                assert plane.near_vertical
                # noise is what the weakest direction of eq. 5 consists of
                assert plane.attenuation > 0.2
                assert plane.condition > 1e4 * max(p.condition for p in safe)
            else:
                assert not fit_plane(station, strip, "corrected").near_vertical
    # a bias counts from a tenth of its sigma on
    east = np.array([1.0, 0.0, 0.0])
    for share, near in ((0.09, False), (0.11, True)):
        biased = replace(safe[0], bias=share * east * np.sqrt(safe[0].covariance[0, 0]))
        assert biased.near_vertical == near
    # without noise nothing is left in that direction
    for method in ("printed", "corrected"):
        refuses(PlaneError, "vertical in this frame", fits, Pass(*_local(SCENE, orbital(SCENE))), method)
    assert intersection_angles(*fits(SCENE, "tls", turn=orbital(SCENE))).values == pytest.approx(LOOK, abs=1e-13)
    with pytest.raises(PlaneError, match="has no form z = a0 x"):
        _ = fits(Pass(*_local(SCENE, orbital(SCENE))), "tls")[1].coefficients


def _local(scene, turn):
    """The scene in coordinates from the station, so that the nadir plane is x = 0 to the last bit."""
    points = {k: (p - scene.station) @ turn.T for k, p in scene.points.items()}
    points["nadir"][:, 0] = 0.0
    return np.zeros(3), np.eye(3), points, scene.tangents, turn @ scene.up


@pytest.mark.second
def test_bias_estimate_of_a_steep_plane():
    """A plane 0.02 deg from the vertical of its frame: the mean error of 4000 explicit fits is the bias that they state
    (known to first order of the attenuation), within 5 of its standard errors and a tenth.
    """
    rng = np.random.default_rng(10)
    tilt = 0.02 * DEG
    normal = np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    side, along = np.array([0.0, 1.0, 0.0]), np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    arm = (
        np.linspace(-30e3, 30e3, 12)[:, None] * side - np.linspace(480e3, 520e3, 12)[rng.permutation(12), None] * along
    )
    errors, stated = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearVerticalWarning)
        for _ in range(4000):
            fit = fit_plane(
                Station.of([0, 0, 0]), Strip.of(arm + 20.0 * rng.standard_normal(arm.shape), 20.0), "corrected"
            )
            errors.append(fit.normal[2] - normal[2])
            stated.append(fit.bias[2])
    assert fit.near_vertical
    mean, spread = np.mean(errors), np.std(errors) / np.sqrt(4000)
    assert abs(mean) > 10 * spread
    assert np.mean(stated) == pytest.approx(mean, abs=5 * spread + 0.1 * abs(mean))


def test_small_angles_keep_all_digits():
    """Normals at a known small angle, of which an arccosine would lose half of the digits."""
    rng = np.random.default_rng(11)
    for angle in (1e-2, 1e-6, 1e-9):
        a, side = np.linalg.qr(rng.standard_normal((3, 2)))[0].T
        # components of b are rounded to 1e-16
        assert np.abs(look_angle(a, np.cos(angle) * a + np.sin(angle) * side) - angle) < 4e-16


@pytest.mark.parametrize("twist", [0.0, 10 / 60 * DEG, 1 * DEG])
def test_dihedral_and_look_angle_differ_when_lines_are_not_parallel(twist):
    """cos(dihedral) = cos(twist) cos(look), by spherical trigonometry; the look angle stays."""
    scene = descending_pass(twist=twist)
    forward, nadir, _ = fits(scene)
    dihedral = angles_between((forward, nadir), ((0, 1),)).values[0]
    assert dihedral == pytest.approx(np.arccos(np.cos(twist) * np.cos(LOOK)), abs=1e-13)
    rays = [line_frame(plane, scene.tangents[name]).central for plane, name in ((forward, "forward"), (nadir, "nadir"))]
    assert look_angle(*rays) == pytest.approx(LOOK, abs=1e-12)
    assert np.abs(rays[0] - scene.body @ [np.sin(LOOK), 0, np.cos(LOOK)]).max() < 1e-12
    # counted from the other end of the line
    assert line_frame(forward, -scene.tangents["forward"]).central == pytest.approx(rays[0], abs=1e-12)
    if twist == 10 / 60 * DEG:
        assert (dihedral - LOOK) / ARCSEC == pytest.approx(1.87, abs=0.01)


def test_one_arcsecond_of_angle_is_more_than_five_metres_of_height():
    """Two rays to one ground point in a plane, one along the vertical and one at an incidence; the second turned by an
    arcsecond meets the first at another height, by the law of sines in the triangle of both."""
    slant, incidence = 560e3, 27 * DEG
    wrong = slant * np.sin(ARCSEC) / np.sin(incidence + ARCSEC)
    # the second order is 1 arcsec / tan(angle), 1e-5
    assert float(height_error(ARCSEC, slant, incidence)) == pytest.approx(wrong, rel=3e-5)
    assert 5.0 < wrong < 7.0
    # flat ground: H / (sin a cos a), 6.3 m
    flat = height_error(ARCSEC, 500e3 / np.cos(LOOK), LOOK)
    assert flat == pytest.approx(500e3 * ARCSEC / (np.sin(LOOK) * np.cos(LOOK)), rel=1e-12)


def test_bad_points():
    station, points = Station.of(SCENE.station, 0.5), SCENE.points["forward"]
    for method in METHODS:
        with pytest.raises(PlaneError, match="three or more points on the strip, found 2"):
            fit_plane(station, Strip.of(points[:2], 1.0), method)
        ray = points[0] - SCENE.station
        with pytest.raises(PlaneError, match="on one line through the station"):
            fit_plane(station, Strip.of(SCENE.station + np.linspace(0.9, 1, 5)[:, None] * ray, 1.0), method)
        refuses(PlaneError, "at one place", fit_plane, station, Strip.of(np.repeat(points[:1], 5, axis=0), 1.0), method)
        # the spread that is needed counts in sigmas of an axis, of unequal ones in their root mean square
        for noise, needed in ((1.0, "10"), (np.tile(np.diag([1.0, 1.0, 10.0]), (5, 1, 1)), "20")):
            with pytest.raises(PlaneError, match=rf"10 sigmas \({needed} m\) are needed"):
                fit_plane(station, Strip.of(np.repeat(points[:1], 5, axis=0), noise), method)
        # noise of 2 m does not make a strip of one place
        scatter = points[0] + 2.0 * np.random.default_rng(1).standard_normal((30, 3))
        refuses(PlaneError, "at one place", fit_plane, station, Strip.of(scatter, 2.0), method)
    refuses(PlaneError, "lies at the station", fit_plane, station, Strip.of(np.vstack([points, SCENE.station]), 1.0))
    refuses(PlaneError, "method must be one of", fit_plane, station, Strip.of(points, 1.0), "other")
    lost = points.copy()
    lost[3, 1] = np.nan
    for wrong in (lost, points[:, :2], points[0]):
        refuses(PlaneError, "strip", Strip.of, wrong, 1.0)
    for noise in (
        0.0,
        -1.0,
        np.nan,
        np.ones(7),
        np.zeros((3, 3)),
        np.diag([1.0, 1.0, -1.0]),
        np.diag([1.0, 1.0, np.inf]),
        np.ones((4, 4)),
    ):
        refuses(PlaneError, "strip", Strip.of, points, noise)
    refuses(PlaneError, "symmetric", Strip.of, points, np.array([[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]))
    for wrong in ([1.0, 2.0], [np.nan, 0, 0]):
        refuses(PlaneError, "station", Station.of, wrong)


@pytest.mark.parametrize("method", ["tls", "corrected"])
def test_normals_point_down(method):
    """Whichever way a plane lies and its points are numbered."""
    rng = np.random.default_rng(12)
    for _ in range(20):
        normal = rng.standard_normal(3)
        points = rng.uniform(-1e3, 1e3, (12, 3))
        points -= np.outer(points @ normal, normal) / (normal @ normal)
        found = fit_plane(
            Station.of(np.zeros(3), 0.1), Strip.of(points + rng.normal(0, 0.1, points.shape), 0.1), method
        )
        assert found.normal[2] < 0
        # 0.1 m over some 1000 m, with twelve points
        assert np.linalg.norm(np.cross(found.normal, normal / np.linalg.norm(normal))) < 1e-3


def test_bad_pairs():
    forward, nadir, _ = fits(SCENE)
    other = fit_plane(Station.of(SCENE.station + 1.0, 0.5), nadir.strip)
    refuses(AngleError, "one and the same station", off_axis_angle, forward, other)
    refuses(AngleError, "coincide", off_axis_angle, nadir, nadir)
    refuses(AngleError, "finite tangents", line_frame, nadir, [0.0])
    with pytest.raises(AngleError, match="finite tangents"):
        line_frame(nadir, np.where(np.arange(len(SCENE.tangents["nadir"])) == 1, np.nan, SCENE.tangents["nadir"]))
    refuses(AngleError, r"\(1 is expected\); check the tangents", line_frame, nadir, 2 * SCENE.tangents["nadir"])
    refuses(AngleError, "printed plane", line_frame, fits(SCENE, "printed")[1], SCENE.tangents["nadir"])
