"""The three-line model against a synthetic pass whose rays are built the other way, from image to ground, with SciPy's
rotations; its partials against a complex step; forward intersection against the points of the pass."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from analysis.orbit.calibration_parameters import CalibrationError, CalibrationField, Noise
from analysis.orbit.forward_intersection import check_errors, intersect
from analysis.orbit.three_line_model import LineModel, Rays, bias_rotation, misclosure, partials
from scenes.specs.orbit.setup import load_three_line_camera
from tests.analysis.refusals import refuses
from tests.twin.orbit_bench import CirclePlatform
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import line_cameras
from twin.orbit.flight.sensor import NO_EFFECTS, Sensor

ARCSEC = np.pi / 648000
PITCH = 6.5e-6
RADIUS, RATE, EARTH_RATE, INCLINATION = 6378137.0 + 500e3, 1.1068e-3, 7.292115e-5, np.radians(97.4)
LOOKS = {"forward": 25.0, "nadir": 0.0, "backward": -25.0}
MOUNTED = {
    "forward": (12, -20, 35),
    "nadir": (-8, 15, -10),
    "backward": (5, 18, -28),
}  # arcsec, as scenes/library/payloads/th1.yaml
DISTORTION = {"forward": 0.045, "nadir": 0.040, "backward": -0.038}
INTERIOR = {"forward": (0.65, 8e-6, -13e-6), "nadir": (0.65, -5e-6, 10e-6), "backward": (0.65, 12e-6, 6e-6)}
POSITION = (0.3, -0.1, 0.2)


def mounting(line, mounted=True):
    turn = Rotation.from_rotvec([0.0, np.radians(LOOKS[line]), 0.0])
    return (turn * Rotation.from_rotvec(np.array(MOUNTED[line]) * ARCSEC * mounted)).as_matrix()


def cameras(change=None, mounted=True):
    """Line models; change: line -> (df, dx, dy)."""
    change = change or {}
    return {
        k: LineModel.of(
            mounting(k, mounted),
            np.array(INTERIOR[k]) + change.get(k, (0.0, 0.0, 0.0)),
            POSITION,
            DISTORTION[k],
            half_length=6000 * PITCH,
        )
        for k in LOOKS
    }


@dataclass(frozen=True, eq=False)
class Pass:
    """Points (m, 3) of a field and, for each line, exposure times (m,), image y (m,), stations and attitudes."""

    points: np.ndarray
    time: dict
    y: dict
    node: float


def orbit(node, time):
    """Stations (n, 3) and yaw-steered nadir attitudes (n, 3, 3), ITRS, circular orbit from argument `node`."""
    angle = node + RATE * time
    place = (
        np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1) @ Rotation.from_euler("x", INCLINATION).as_matrix().T
    )
    ahead = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], -1)
    ahead = ahead @ Rotation.from_euler("x", INCLINATION).as_matrix().T
    spin = Rotation.from_rotvec(-EARTH_RATE * time[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    place, ahead = (np.einsum("nij,nj->ni", spin, v) for v in (place, ahead))
    ahead = RATE * ahead - EARTH_RATE * np.cross([0.0, 0.0, 1.0], place)  # yaw steered: as the ground moves
    ahead -= place * np.sum(ahead * place, axis=-1, keepdims=True)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    return RADIUS * place, np.stack([ahead, np.cross(-place, ahead), -place], axis=-1)


def look(line, y, camera):
    """Directions in the body frame from image places, with the signs of twin/orbit/flight/line_camera.py."""
    f, x0, y0 = camera.interior
    x, y = np.full_like(y, -x0), y - y0
    grown = 1 + camera.k1 * (x**2 + y**2)
    return np.stack([-x * grown, -y * grown, np.full_like(y, f)], -1) @ mounting(line).T


def field_points(rng, count, node, relief=2000.0, half=26e3, plane=False):
    """Points around the subsatellite point; flat means one ellipsoidal height, `plane` square to the nadir."""
    station, attitude = orbit(node, np.zeros(1))
    along, across = rng.uniform(-half, half, (2, count))
    height = rng.uniform(0.0, relief, count) if relief else np.full(count, 500.0)
    if plane:
        return station[0] + np.column_stack([along, across, 500e3 - height]) @ attitude[0].T
    down = station[0] / np.linalg.norm(station)
    direction = down + (along[:, None] * attitude[0, :, 0] + across[:, None] * attitude[0, :, 1]) / 6371e3
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    sine = direction[:, 2]
    return direction * (6378137.0 * (1 - sine**2 / 298.257) + height)[:, None]


def observe(points, node, true_cameras, bias=(0, 0, 0), offset=(0, 0, 0), drift=None):
    """Exact exposure times and image places of points: Newton on the angle between look and point.

    drift: line -> d_alpha, d_beta, d_gamma, d_f.
    """
    turn = Rotation.from_euler("XYZ", bias).as_matrix()
    times, places = {}, {}
    for line, camera in true_cameras.items():
        d_alpha, d_beta, d_gamma, d_f = (drift or {}).get(line, np.zeros(4))
        mount = mounting(line) @ Rotation.from_euler("XYZ", [d_beta, d_alpha, d_gamma]).as_matrix()
        camera = camera.with_interior(camera.interior + np.array([d_f, 0.0, 0.0]))

        def gap(time, y, line=line, camera=camera, mount=mount):
            station, attitude = orbit(node, time)
            station = station + offset + np.einsum("nij,j->ni", attitude, turn @ camera.position)
            seen = np.einsum("nji,nj->ni", attitude @ turn, points - station) @ mount
            there = look(line, y, camera) @ mounting(line)
            return seen[:, :2] / seen[:, 2:] - there[:, :2] / there[:, 2:]

        time = np.full(len(points), -np.tan(np.radians(LOOKS[line])) * 500e3 / 7000.0)
        y = np.zeros(len(points))
        for _ in range(12):
            miss = gap(time, y)
            by = np.stack([(gap(time + 1e-2, y) - miss) / 1e-2, (gap(time, y + 1e-5) - miss) / 1e-5], -1)
            step = np.linalg.solve(by, miss[..., None])[..., 0]
            time, y = time - step[:, 0], y - step[:, 1]
        assert np.abs(gap(time, y)).max() < 1e-14
        assert np.abs(y).max() < 6000 * PITCH
        times[line], places[line] = time, y
    return Pass(points, times, places, node)


def make_rays(seen, rng=None, noise=None):
    """Rays of a pass as they are measured: x, y and the attitude and station of each exposure with their noise.

    It is drawn for each exposure, or for each reading and joined by SciPy's spline where the noise has intervals.
    """
    noise = noise or Noise(0.0)
    rays = {}
    every = np.concatenate(list(seen.time.values()))
    shared = {}
    if rng is not None:
        shared = {
            t.group: spline(rng, t.sigma, t.interval, every.min(), every.max()) for t in noise.terms if t.interval
        }
    for line, time in seen.time.items():
        station, attitude = orbit(seen.node, time)
        image = np.column_stack([np.zeros_like(time), seen.y[line]])
        if rng is not None:
            image = image + noise.image * rng.standard_normal(image.shape)
            turn = np.zeros_like(station)
            for term in noise.terms:
                error = shared[term.group](time) if term.interval else term.sigma * rng.standard_normal(station.shape)
                turn, station = (turn + error, station) if term.kind == "attitude" else (turn, station + error)
            attitude = attitude @ Rotation.from_rotvec(turn).as_matrix()
        rays[line] = Rays.of(np.arange(len(time)), image, station, attitude, time)
    return rays


def spline(rng, sigma, interval, first, last):
    """Independent values at whole multiples of the interval, with eight to spare, joined as by a user of the data."""
    time = interval * np.arange(np.floor(first / interval) - 8, np.ceil(last / interval) + 9)
    return CubicSpline(time, sigma * rng.standard_normal((len(time), 3)))


BIAS = np.array([40.0, -60.0, 90.0]) * ARCSEC
OFFSET = np.array([3.0, -2.0, 1.0])
SEEN = observe(field_points(np.random.default_rng(1), 40, 2.4), 2.4, cameras(), BIAS, OFFSET)


def test_rays_built_from_the_image_close():
    """Newton of the scene ends at 1e-14 of a tangent; ITRS coordinates of 7e6 m are rounded to 1e-9 m, 1e-15 m here."""
    for line, rays in make_rays(SEEN).items():
        miss = misclosure(cameras()[line], rays, SEEN.points, BIAS, OFFSET)
        assert np.abs(miss).max() < 1e-14
        # a wrong sign anywhere is a thousand times larger than this
        assert np.abs(misclosure(cameras()[line], rays, SEEN.points, -BIAS, OFFSET)).max() > 1e-5


@pytest.mark.parametrize("line", LOOKS)
def test_signs_are_those_of_the_simulated_sensor(line):
    """Points from the twin's pixel to ground through th1.yaml, 1e-9 m of rounding each: 1e-15 m in the image."""
    spec = load_three_line_camera("th1")
    one = spec.lines[line]
    model = LineModel.of(mounting(line), (one.principal_distance, *one.principal_point), one.position, one.k1, one.k2)
    platform = CirclePlatform(wobble=5.0 * ARCSEC)
    sensor = Sensor(line_cameras(spec)[line], platform, Earth(), 0.7e-3, -3.0, 10_000, NO_EFFECTS)
    lines, pixels = np.random.default_rng(9).uniform(0, 9999, (2, 30))
    points = sensor.ground(lines, pixels, np.linspace(0.0, 2000.0, 30))
    moments = sensor.time(lines)
    image = np.column_stack([np.zeros(30), (pixels - 0.5 * (spec.pixels - 1)) * spec.pitch])
    rays = Rays.of(np.arange(30), image, platform.position(moments), platform.body_to_itrs(moments))
    assert np.abs(misclosure(model, rays, points, np.zeros(3), np.zeros(3))).max() < 1e-13


def test_bias_is_a_sequence_of_turns():
    expected = Rotation.from_euler("XYZ", [0.1, -0.2, 0.3]).as_matrix()
    assert bias_rotation([0.1, -0.2, 0.3]) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("line", LOOKS)
def test_partials_are_those_of_a_complex_step(line):
    """The step has no truncation: what is left is rounding of the closed forms, 1e-13 of the largest entry."""
    # far larger than real, or the terms would hide in rounding
    camera = replace(cameras()[line], k1=20.0, k2=3e4, drift=np.array([0.02, -0.03, 0.05, 0.01]))
    rays, small = make_rays(SEEN)[line], 1e-40
    by = partials(camera, rays, SEEN.points, BIAS, OFFSET)
    stretched = camera.drifted(camera.drift + 1j * small * np.eye(4)[3])
    close(by.drift[:, :, 3], misclosure(stretched, rays, SEEN.points, BIAS, OFFSET).imag / small)
    for k in range(3):
        unit = 1j * small * np.eye(3)[k]
        stepped = misclosure(replace(camera, interior=camera.interior + unit), rays, SEEN.points, BIAS, OFFSET)
        close(by.interior[:, :, k], stepped.imag / small)
        close(by.bias[:, :, k], misclosure(camera, rays, SEEN.points, BIAS + unit, OFFSET).imag / small)
        close(by.ground[:, :, k], misclosure(camera, rays, SEEN.points + unit, BIAS, OFFSET).imag / small)
        close(-by.ground[:, :, k], misclosure(camera, rays, SEEN.points, BIAS, OFFSET + unit).imag / small)
        drifted = camera.drifted(camera.drift + 1j * small * np.eye(4)[k])
        close(by.drift[:, :, k], misclosure(drifted, rays, SEEN.points, BIAS, OFFSET).imag / small)
        cross = np.cross(np.eye(3), np.eye(3)[k])
        turned = replace(rays, attitude=rays.attitude @ (np.eye(3) + 1j * small * cross))
        close(by.attitude[:, :, k], misclosure(camera, turned, SEEN.points, BIAS, OFFSET).imag / small)


def test_drift_has_the_signs_of_the_conventions():
    """d_alpha turns the line of sight about +Y, toward +X; d_beta about +X, toward -Y; d_gamma the line about +Z."""
    camera = replace(cameras()["nadir"], to_body=np.eye(3))
    sight = camera.interior[1:] + np.array([[0.0, 0.0], [0.0, 0.03]])
    angle = 1e-6
    (middle,) = (camera.drifted([angle, 0, 0, 0]).directions(sight[:1]) - camera.directions(sight[:1])) / angle
    assert middle == pytest.approx([1, 0, 0], abs=1e-5)
    (middle,) = (camera.drifted([0, angle, 0, 0]).directions(sight[:1]) - camera.directions(sight[:1])) / angle
    assert middle == pytest.approx([0, -1, 0], abs=1e-5)
    middle, end = (camera.drifted([0, 0, angle, 0]).directions(sight) - camera.directions(sight)) / angle
    assert middle == pytest.approx([0, 0, 0], abs=1e-5)
    # an image at +y looks toward -Y; turned about Z it swings toward +X
    assert end == pytest.approx([0.03 / np.hypot(0.65, 0.03), 0, 0], abs=1e-5)
    looks = camera.drifted([0, 0, 0, 1e-3]).directions(sight)
    assert np.abs(looks[1, 1]) < np.abs(camera.directions(sight)[1, 1])  # longer f, smaller angle
    assert camera.drifted(np.ones(4)).drifted(np.zeros(4)).axes == pytest.approx(np.eye(3))
    refuses(ValueError, "a drift is", camera.drifted, np.zeros(3))


def close(found, expected):
    assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()


def test_forward_intersection_returns_the_points():
    """A third line adds nothing to exact rays; 1e-14 of a tangent at 500 km is 1e-8 m, rounding of the station 1e-9."""
    for lines in (("forward", "nadir", "backward"), ("forward", "backward"), ("nadir", "backward")):
        rays = {k: make_rays(SEEN)[k] for k in lines}
        found = intersect(rays, cameras(), Noise(PITCH), bias=BIAS, offset=OFFSET)
        assert np.abs(found.ground - SEEN.points).max() < 1e-6
        assert np.all(found.rays == len(lines))
    errors = check_errors(found.ground, SEEN.points)
    assert errors.count == 40
    assert max(errors.plan_rms, errors.height_rms) < 1e-6


def test_errors_are_told_in_east_north_and_up():
    lon, lat = np.radians(116.0), np.radians(40.0)
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    normal = 6378137.0 / np.sqrt(1 - 0.00669437999014 * np.sin(lat) ** 2)
    point = normal * up * [1, 1, 1 - 0.00669437999014]
    errors = check_errors((point + 3 * east + 4 * np.cross(up, east) - 2 * up)[None], point[None])
    assert errors.error[0] == pytest.approx([3, 4, -2], abs=1e-6)
    assert (errors.plan_rms, errors.height_rms) == pytest.approx((5, 2), abs=1e-6)


@pytest.mark.second
def test_intersection_covariance_holds():
    """Mahalanobis squares of 400 points: chi-square of 1200, within 5 of its sigmas (false alarm 6e-7)."""
    noise = Noise(0.3 * PITCH, 0.5 * ARCSEC, 0.3)
    rng = np.random.default_rng(7)
    seen = observe(field_points(rng, 400, 2.4), 2.4, cameras())
    found = intersect(make_rays(seen, rng, noise), cameras(), noise)
    error = found.ground - seen.points
    square = np.einsum("ni,nij,nj->", error, np.linalg.inv(found.covariance), error)
    assert abs(square - 1200) < 5 * np.sqrt(2400)
    assert abs(np.sum(found.chi_square) - 1200) < 5 * np.sqrt(2400)  # 2 x 3 - 3 degrees of freedom each


def test_bad_input_is_told():
    rays, nadir, still, eye = make_rays(SEEN)["nadir"], cameras()["nadir"], np.zeros(3), np.eye(3)
    lost = np.where(np.arange(40)[:, None] == 3, np.nan, rays.image)
    level = Rays.of(rays.point, rays.image, 0.0 * rays.station, np.tile(eye, (40, 1, 1)))
    beside = np.tile([5e5, 0, 0], (40, 1))  # where the depth is zero
    twice = {"nadir": rays, "again": rays}
    field = partial(CalibrationField.of, "Beijing", {"nadir": rays})
    for said, call, *arguments in (
        ("image of ray 3 is not finite", Rays.of, rays.point, lost, rays.station, rays.attitude),
        ("appears twice", Rays.of, np.zeros(40, int), rays.image, rays.station, rays.attitude),
        (r"image must be \(40, 2\)", Rays.of, rays.point, rays.image[:, :1], rays.station, rays.attitude),
        ("a one-dimensional array of integers", Rays.of, rays.point + 0.5, rays.image, rays.station, rays.attitude),
        ("must be a rotation", LineModel.of, 2 * eye, INTERIOR["nadir"]),
        ("must be a rotation", LineModel.of, np.diag([1.0, 1.0, -1.0]), INTERIOR["nadir"]),
        (r"to_body must be \(3, 3\), interior and position \(3,\)", LineModel.of, eye[:, :2], still, still),
        (r"to_body must be \(3, 3\), interior and position \(3,\)", LineModel.of, eye, still[:2], still),
        (r"to_body must be \(3, 3\), interior and position \(3,\)", LineModel.of, eye, still, np.zeros(4)),
        ("finite and f positive", LineModel.of, eye, still),
        ("finite and f positive", LineModel.of, eye, [0.65, np.nan, 0]),
        ("finite and f positive", LineModel.of, eye, [0.65, 0, 0], [np.inf, 0, 0]),
        ("finite and f positive", LineModel.of, eye, [0.65, 0, 0], still, np.nan),
        ("must not be negative", partial(LineModel.of, half_length=-1.0), eye, [0.65, 0, 0]),
        ("behind a camera", nadir.seen, -nadir.axes[:, 2:], rays.image[:1]),
        ("behind a camera", partials, nadir, rays, 2 * rays.station, still, still),
        ("behind a camera", partials, LineModel.of(eye, [0.65, 0, 0]), level, beside, still, still),
        ("no point is seen by two lines", intersect, {"nadir": rays}, cameras(), Noise(PITCH)),
        ("parallel", intersect, twice, dict.fromkeys(twice, nadir), Noise(PITCH)),
        ("point that does not exist", field, SEEN.points[:10], 1.0),
        ("tie point 0 is seen by 1 lines", field, SEEN.points, 1.0, np.zeros(40, bool)),
        (r"geocentric \(ITRS\) and in metres", field, SEEN.points / 1e3, 1.0),
        ("finite", field, np.full((40, 3), np.nan), 1.0),
        (r"control must be \(40,\)", field, SEEN.points, 1.0, np.ones(3, bool)),
        ("covariances must be", field, SEEN.points, -np.tile(eye, (40, 1, 1))),
        ("covariances must be", field, SEEN.points, eye),
        ("sigma must be finite, and positive or zero for all axes", field, SEEN.points, (1.0, 0.0)),
        ("sigma must be finite, and positive or zero for all axes", field, SEEN.points, np.nan),
    ):
        refuses(CalibrationError if call in (intersect, field) else ValueError, said, call, *arguments)
