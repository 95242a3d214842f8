"""The rigorous sensor model: round trips, sizes and directions of its effects, and independent ways to the ground."""

import itertools
import math

import erfa
import numpy as np
import pyproj
import pytest
from scipy.integrate import solve_ivp

from scenes.specs.orbit.flight import OrbitSpec
from scenes.specs.orbit.setup import load_three_line_camera
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from tests.tiers import quick
from tests.twin.orbit_bench import RATE, CirclePlatform, turn
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import LineCamera, line_cameras, traced_line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.sensor import (
    NO_EFFECTS,
    SPEED_OF_LIGHT,
    LightEffects,
    Sensor,
    aberrated,
    refracted,
    refractive_shift,
    standard_refractivity,
    unrefracted,
)
from twin.orbit.flight.trajectory import Trajectory

ARCSEC = math.radians(1.0 / 3600.0)
EARTH = Earth()
CIRCLE = CirclePlatform()
LINES = 10_000
LINE_TIME = {12_000: 0.7e-3, 32_768: 0.1e-3}
TH1 = line_cameras(load_three_line_camera("th1"))
ALL = LightEffects()
EFFECTS = [LightEffects(*on) for on in itertools.product((False, True), repeat=3)]
NAMES = ["th1/forward", "th1/nadir", "th1/backward", "gf7_pair/forward", "gf7_pair/backward"]
HEIGHTS = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)


def words(effects: LightEffects) -> str:
    """Names of the effects that are on."""
    return "+".join(name for name in ("light_time", "aberration", "refraction") if getattr(effects, name)) or "none"


@pytest.fixture(scope="module")
def cameras(gf7_pair, backend) -> dict[str, LineCamera]:
    traced = traced_line_cameras(gf7_pair, backend)
    return {**{f"th1/{k}": v for k, v in TH1.items()}, **{f"gf7_pair/{k}": v for k, v in traced.items()}}


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """A descending pass over 40 N, 116 E."""
    passing = {"longitude": "116 deg", "latitude": "40 deg", "altitude": "500 km"}
    spec = OrbitSpec.model_validate({"epoch": "2012-06-01T03:00:00Z", "passing": passing})
    return Trajectory(propagate(spec, EARTH))


def sensor(camera: LineCamera, effects: LightEffects = NO_EFFECTS, platform=CIRCLE) -> Sensor:
    return Sensor(camera, platform, EARTH, LINE_TIME[camera.pixels], -3.0, LINES, effects)


def places(camera: LineCamera, count: int, seed: int) -> tuple[np.ndarray, ...]:
    """Random lines, pixels (the four corners among them) and heights."""
    rng = np.random.default_rng(seed)
    line = rng.uniform(-0.5, LINES - 0.5, count)
    pixel = rng.uniform(-0.5, camera.pixels - 0.5, count)
    line[:4], pixel[:4] = [-0.5, -0.5, LINES - 0.5, LINES - 0.5], [-0.5, camera.pixels - 0.5] * 2
    return line, pixel, rng.uniform(-100.0, 8000.0, count)


@pytest.mark.second
@pytest.mark.parametrize("effects", EFFECTS, ids=words)
@pytest.mark.parametrize("name", quick(1, NAMES))
def test_round_trip(cameras, trajectory, name: str, effects: LightEffects) -> None:
    model = sensor(cameras[name], effects, trajectory)
    line, pixel, height = places(model.camera, 60, 1)
    point = model.ground(line, pixel, height)
    np.testing.assert_allclose(EARTH.geodetic(point)[2], height, rtol=0, atol=1e-6)
    back = model.image(point)
    np.testing.assert_allclose(back[0], line, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back[1], pixel, rtol=0, atol=1e-6)


def test_round_trip_with_an_unsteady_attitude() -> None:
    """Turns of 5 arcsec at up to 31 Hz, 1 mrad/s: a tenth of the motion of the image, so that it stays one-to-one."""
    model = sensor(TH1["backward"], ALL, CirclePlatform(wobble=5 * ARCSEC))
    line, pixel, height = places(model.camera, 200, 2)
    back = model.image(model.ground(line, pixel, height))
    np.testing.assert_allclose(back, [line, pixel], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["th1/backward", "gf7_pair/forward"])
def test_ground_by_bisection(cameras, trajectory, name: str) -> None:
    """The look is followed until PROJ's geodetic height, nothing else, is the wanted one."""
    camera = cameras[name]
    model = sensor(camera, NO_EFFECTS, trajectory)
    line, pixel, height = places(camera, 12, 3)
    found = model.ground(line, pixel, height)
    for i in range(12):
        t = -3.0 + line[i] * LINE_TIME[camera.pixels]
        axes = trajectory.body_to_itrs(t)
        origin = trajectory.position(t) + axes @ camera.origin(pixel[i : i + 1])[0]
        look = axes @ camera.look(pixel[i : i + 1])[0]
        low, high = 400e3, 700e3
        for _ in range(60):
            middle = 0.5 * (low + high)
            above = HEIGHTS.transform(*(origin + middle * look))[2] > height[i]
            low, high = (middle, high) if above else (low, middle)
        assert (
            np.linalg.norm(origin + low * look - found[i]) < 1e-5
        )  # PROJ's heights are good to 1e-6 m near the ground


@pytest.mark.parametrize("name", ["forward", "nadir"])
def test_light_followed_in_space(name: str) -> None:
    """Light time and aberration by another route: in axes that do not turn, from the point at the moment when its light
    left to the camera, then the photon's wave vector through a 4 x 4 Lorentz boost into the satellite's frame.
    """
    model = sensor(TH1[name], LightEffects(refraction=False))
    line, pixel, height = places(model.camera, 20, 4)
    point = model.ground(line, pixel, height)
    for i in range(20):
        t = -3.0 + line[i] * 0.7e-3
        position, velocity, axes = CIRCLE.space(t)
        way = 500e3 / SPEED_OF_LIGHT
        for _ in range(5):
            source = turn(2, RATE * (t - way)) @ point[i]
            way = np.linalg.norm(source - position) / SPEED_OF_LIGHT
        wave = np.array([1.0, *((position - source) / np.linalg.norm(position - source))])
        beta = velocity / SPEED_OF_LIGHT
        gamma = 1.0 / math.sqrt(1.0 - beta @ beta)
        boost = np.eye(4)
        boost[0, 0], boost[0, 1:], boost[1:, 0] = gamma, -gamma * beta, -gamma * beta
        boost[1:, 1:] += (gamma - 1.0) * np.outer(beta, beta) / (beta @ beta)
        seen = -(boost @ wave)[1:]
        look = axes @ model.camera.look(pixel[i : i + 1])[0]
        # a nanometre of rounding in coordinates of 7000 km, seen from 500 km, is 2e-15 rad
        assert np.linalg.norm(seen / np.linalg.norm(seen) - look) < 2e-14


def test_aberration_against_erfa() -> None:
    """ERFA's `ab` is the other way of writing it; its Sun is sent away, since its potential does not belong here."""
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    for speed in (7600.0, 3e7):
        velocity = rng.normal(size=(50, 3)) * speed
        beta = velocity / 299792458.0
        expected = erfa.ab(direction, beta, np.full(50, 1e20), np.sqrt(1.0 - np.sum(beta**2, axis=-1)))
        np.testing.assert_allclose(aberrated(direction, velocity), expected, rtol=0, atol=2e-15)
        np.testing.assert_allclose(aberrated(expected, -velocity), direction, rtol=0, atol=2e-15)


def bent_shift(zenith: float, radius: float, refractivity: float, scale: float) -> float:
    """Shift of the ground point by the ray equation d/ds (n dr/ds) = grad n in a spherical exponential atmosphere, from
    200 km down; plane polar geometry only at the end.
    """
    start = radius + 200e3
    # the straight line that would arrive at (0, radius) under this zenith angle, coming from +x
    direction = -np.array([math.sin(zenith), math.cos(zenith)])
    back = math.sqrt(start**2 - (radius * math.sin(zenith)) ** 2) - radius * math.cos(zenith)
    origin = np.array([0.0, radius]) - back * direction

    def slope(_, y):
        r = math.hypot(y[0], y[1])
        decay = refractivity * math.exp(-(r - radius) / scale)
        return [*(y[2:] / (1.0 + decay)), *(-decay / scale * y[:2] / r)]

    def height(_, y):
        return math.hypot(y[0], y[1]) - radius

    height.terminal = True
    y0 = np.concatenate([origin, direction])
    found = solve_ivp(slope, (0.0, 2 * back), y0, "DOP853", events=height, rtol=1e-13, atol=1e-9, max_step=2e3)
    x, y = found.y_events[0][0][:2]
    return radius * math.atan2(x, y)


@pytest.mark.parametrize("degrees", [5.0, 27.0, 45.0, 65.0])
def test_refraction_against_the_ray_equation(degrees: float) -> None:
    z, radius = math.radians(degrees), 6371e3
    n = standard_refractivity(650e-9)
    scale = 8.31446 * 288.15 / (0.0289644 * 9.80665)
    expected = bent_shift(z, radius, n, scale)
    found = refractive_shift(np.array([z]), np.array([0.0]), np.array([radius]), 650e-9)[0]
    assert found == pytest.approx(expected, rel=2e-5)  # of the ray tracing: rounding of 6571 km against a metre
    # the flat-layer formula, within what the sphere takes away (1/cos^2 times the scale height over the radius)
    flat = math.tan(z) / math.cos(z) ** 2 * n * scale
    assert flat * (1 - 4e-3 / math.cos(z) ** 2) < found < flat


def test_the_standard_atmosphere() -> None:
    # NIST's Engineering Metrology Toolbox, Ciddor's equation: 633 nm, 20 degC, 101325 Pa, dry; an ideal gas to 15 degC
    assert standard_refractivity(633e-9) == pytest.approx(2.71800e-4 * 293.15 / 288.15, rel=1e-4)
    # near the vertical the whole column counts, which the pressure holds up: 701.08 hPa at 3000 m, 226.32 at 11 km
    z, radius = np.full(4, 1e-3), np.full(4, 6371e3)
    shift = refractive_shift(z, np.array([0.0, 3000.0, 11000.0, 15000.0]), radius, 650e-9)
    # 2.7631e-4 at 15 degC times 8434.5 m; higher layers lie on larger spheres; (n - 1)/2 is left out
    assert shift[0] == pytest.approx(1e-3 * 2.7631e-4 * 8434.5 * (1 - 2 * 8434.5 / 6371e3), rel=2e-4)
    np.testing.assert_allclose(shift[1:] / shift[0], np.array([701.08, 226.32, 120.45]) / 1013.25, rtol=2e-3)


@pytest.mark.parametrize("name", ["forward", "nadir", "backward"])
def test_refraction_on_the_ground(name: str) -> None:
    """The ray comes in steeper: the point is nearer to the satellite's nadir by 1.5 m at 25 degrees, no higher."""
    model = sensor(TH1[name], LightEffects(False, False, True))
    off, on = (sensor(TH1[name], e).ground(5000.0, 5999.5, 300.0)[0] for e in (NO_EFFECTS, model.effects))
    nadir = EARTH.ecef(*EARTH.geodetic(CIRCLE.position(0.5))[:2], 300.0)
    assert EARTH.geodetic(on)[2] == pytest.approx(300.0, abs=1e-6)
    shift = np.linalg.norm(on - off)
    if name == "nadir":
        assert shift < 0.02  # geocentric attitude: 0.2 degrees off the vertical
        return
    assert 1.2 < shift < 1.6
    assert (on - off) @ (nadir - off) / (shift * np.linalg.norm(nadir - off)) > 0.999
    station = CIRCLE.position(np.array([0.5]))
    assert np.linalg.norm(refracted(off[None], station, EARTH, 650e-9) - on) < 1e-8
    assert np.linalg.norm(unrefracted(on[None], station, EARTH, 650e-9) - off) < 1e-8


def test_what_the_image_does_not_hold_is_nan(trajectory) -> None:
    model = sensor(TH1["nadir"], ALL, trajectory)
    wide = Sensor(TH1["nadir"], trajectory, EARTH, 0.7e-3, -3.7, LINES + 2000, ALL)
    inside = model.ground(100.0, 50.0)[0]
    beside = wide.ground(np.array([900.0, 11100.0]), 6000.0)  # lines -100 and 10 100 of the smaller image
    lon, lat, _ = EARTH.geodetic(model.ground(5000.0, np.array([-0.5, 11999.5])))
    apart = np.diff(lon) * 0.01
    aside = EARTH.ecef(lon + np.array([-1.0, 1.0]) * apart, lat)  # one percent of the swath outside of either end
    behind = -inside  # on the other side of the Earth, straight below
    above = trajectory.position(0.5) * 1.1
    points = np.stack([inside, *beside, *aside, behind, above, np.full(3, np.nan), inside])
    line, pixel = model.image(points)
    expected = [True, *[False] * 7, True]
    assert np.isfinite(line).tolist() == expected
    assert np.isfinite(pixel).tolist() == expected
    np.testing.assert_allclose([line[0], pixel[0]], [100.0, 50.0], rtol=0, atol=1e-6)


def test_clear_errors_outside_the_image_and_the_orbit(trajectory) -> None:
    model = sensor(TH1["nadir"], ALL, trajectory)
    for line in (-0.6, LINES - 0.4, np.nan):
        with pytest.raises(ValueError, match="line lies outside the image"):
            model.ground(line, 6000.0)
    for pixel in (-0.6, 11999.6):
        with pytest.raises(ValueError, match="pixel lies outside the line"):
            model.ground(0.0, pixel)
    with pytest.raises(ValueError, match="time outside the orbit"):
        Sensor(TH1["nadir"], trajectory, EARTH, 0.7e-3, 595.0, LINES)
    with pytest.raises(ValueError, match="line time above zero"):
        Sensor(TH1["nadir"], trajectory, EARTH, 0.0, 0.0, LINES)


def test_a_look_past_the_earth_is_nan() -> None:
    """From 500 km the horizon lies at 68 degrees."""
    lines = {
        "past": {"look": "70 deg", "principal_distance": "650 mm"},
        "near": {"look": "64 deg", "principal_distance": "650 mm"},
    }
    spec = ThreeLineCameraSpec.model_validate({"name": "own", "pixels": 12000, "pitch": "6.5 um", "lines": lines})
    past, near = (sensor(camera, ALL) for camera in line_cameras(spec).values())
    assert np.all(np.isnan(past.ground(5000.0, 6000.0)))
    point = near.ground(5000.0, 6000.0)
    assert np.all(np.isfinite(point))
    np.testing.assert_allclose(np.ravel(near.image(point)), [5000.0, 6000.0], rtol=0, atol=1e-6)
