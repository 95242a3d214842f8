"""Covariances on the ground, against sensors that are really wrong and points that are really intersected."""

from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.setup import SimulateSetup
from twin.orbit.export import ground_accuracy
from twin.orbit.export.ground_accuracy import (
    TOGETHER,
    AccuracyMap,
    CameraUncertainty,
    accuracy_maps,
    intersected_accuracy,
    single_accuracy,
)
from twin.orbit.flight.earth import east_north_up
from twin.orbit.flight.sensor import Sensor
from twin.orbit.images.simulate_run import fly_simulation

HEIGHT = 300.0
PLATFORM = np.array([0.5, 0.8, 0.3, 4e-6, 3e-6, 6e-6])
"""Metres and radians."""
MIDDLE = 6
"""Of the grid: the middle line, a quarter of the line from its end, where the principal distance matters."""
INTERIOR = np.array([0.4, 0.3, 1e-4])


@pytest.fixture(scope="module")
def sensors() -> dict[str, Sensor]:
    return dict(fly_simulation(SimulateSetup.read(SCENES / ORBIT / "simulate.yaml"), 1).sensors)


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground_accuracy, "_GRID", (3, 5))


def uncertainty(**more) -> CameraUncertainty:
    base = CameraUncertainty(np.diag(PLATFORM**2), np.diag(INTERIOR**2), np.diag([0.2, 0.3]) ** 2, 2.0)
    return replace(base, **more)


class Wrong:
    """A platform with an error, written anew."""

    def __init__(self, platform, shift, turn) -> None:
        self.platform, self.shift, self.turn = platform, np.array(shift), rotation_matrix(np.array(turn))

    def position(self, seconds):
        return self.platform.position(seconds) + self.platform.body_to_itrs(seconds) @ self.shift

    def inertial_velocity(self, seconds):
        return self.platform.inertial_velocity(seconds)

    def body_to_itrs(self, seconds):
        return self.platform.body_to_itrs(seconds) @ self.turn


def wrong(sensor: Sensor, error: np.ndarray) -> Sensor:
    return replace(sensor, trajectory=Wrong(sensor.trajectory, error[:3], error[3:]))


def level(sensor: Sensor, ground: np.ndarray) -> np.ndarray:
    longitude, latitude, _ = sensor.earth.geodetic(ground)
    return east_north_up(longitude, latitude)


def test_a_map_of_known_covariances() -> None:
    """RMS of a horizontal axis, the circle and the interval of 90 %, and nothing where nothing is seen."""
    constant, random = (np.array([np.diag(v)] * 2) for v in ([4.0, 8.0, 100.0], [1.0, 3.0, 25.0]))
    place = np.array([0.1, np.nan])
    found = AccuracyMap(place, place, place, place, 300.0, constant, random, 0.0 * random)
    assert found.horizontal() == pytest.approx((np.sqrt(6.0), np.sqrt(2.0)))
    assert found.le90 == pytest.approx([1.6448536 * np.sqrt(125.0), np.nan], nan_ok=True)
    even = replace(found, constant=np.array([np.diag([4.0, 4.0, 9.0])] * 2), random=0.0 * random)
    assert even.ce90 == pytest.approx([2.0 * np.sqrt(2.0 * np.log(10.0)), np.nan], nan_ok=True)


@pytest.mark.parametrize("name", ["position", "attitude", "interior", "scale", "image", "height"])
def test_what_is_not_stated_is_exact(name) -> None:
    one = CameraUncertainty.of(**{name: 3.0})
    assert np.all((one.platform == one.platform.T) & np.isin(one.platform, [0.0, 9.0]))
    found = [np.diag(part) for part in (one.platform[:3, :3], one.platform[3:, 3:], one.interior[:2, :2])]
    found += [one.interior[2:, 2], np.diag(one.image), np.array([one.height**2])]
    names = ["position", "attitude", "interior", "scale", "image", "height"]
    assert [set(part) for part in found] == [{9.0} if other == name else {0.0} for other in names]


@pytest.mark.second
def test_draws_of_a_wrong_camera_have_the_stated_covariance(sensors) -> None:
    """600 drawn errors of everything at one point: a covariance of N draws is right to sqrt(2 / N), 5.8 %."""
    sensor = sensors["forward"]
    found = single_accuracy(sensor, uncertainty(), HEIGHT)
    k = MIDDLE
    line, pixel = found.line[k], found.pixel[k]
    true = sensor.ground(line, pixel, HEIGHT)
    axes = level(sensor, true)[0]
    random = np.random.default_rng(7)
    away = []
    for _ in range(600):
        error = PLATFORM * random.standard_normal(6)
        own = INTERIOR * random.standard_normal(3) + np.append([0.2, 0.3] * random.standard_normal(2), 0.0)
        up = 2.0 * random.standard_normal()
        at = line + own[0], pixel + own[1] + own[2] * (pixel - 0.5 * (sensor.camera.pixels - 1))
        away.append(axes @ (wrong(sensor, error).ground(*at, HEIGHT + up) - true)[0])
    drawn = np.cov(np.array(away).T)
    scale = np.sqrt(np.diag(found.covariance[k]))
    np.testing.assert_allclose(drawn / np.outer(scale, scale), found.covariance[k] / np.outer(scale, scale), atol=0.23)
    inside = np.mean(np.hypot(*np.array(away)[:, :2].T) < found.ce90[k])
    assert inside == pytest.approx(0.9, abs=0.049)  # 4 sigma of 600 draws
    assert found.le90[k] == pytest.approx(1.6449 * 2.0, rel=1e-4)
    # heights belong to the ground, and not to the model
    level_ground = single_accuracy(sensor, uncertainty(height=0.0), HEIGHT)
    assert found.horizontal() == level_ground.horizontal()
    assert found.ce90[k] > level_ground.ce90[k]


@pytest.mark.second
def test_intersected_points_against_least_squares(sensors) -> None:
    """Each error by itself, found anew: wrong sensors image a point, the right ones intersect it in the images."""
    pair = {name: sensors[name] for name in ("nadir", "forward", "backward")}
    stated = uncertainty()
    found = intersected_accuracy(pair, stated, HEIGHT)
    k = MIDDLE
    first = pair["nadir"]
    point = first.ground(found.line[k], found.pixel[k], HEIGHT)
    assert found.valid[k]
    axes = level(first, point)[0]
    root = np.linalg.cholesky(np.linalg.inv(stated.image))
    there = {name: np.stack(s.image(point), axis=-1)[0] for name, s in pair.items()}

    def images(moves: np.ndarray) -> np.ndarray:
        """Of points (M, 3) moved from the first, (M, 2 for each sensor)."""
        at = point + moves @ axes
        return np.concatenate([np.stack(s.image(at), -1) @ root for s in pair.values()], axis=-1)

    # steps of 10 m: the sensor's own inverse is right to 1e-7 px
    slope = ((images(10.0 * np.eye(3)) - images(-10.0 * np.eye(3))) / 20.0).T

    def intersected(places: list[dict[str, np.ndarray]]) -> np.ndarray:
        """(M, 3) from M points' places in all images."""
        wanted = np.array([np.concatenate([one[name] @ root for name in pair]) for one in places])
        moves = np.zeros((len(places), 3))
        for _ in range(3):
            moves = moves + np.linalg.lstsq(slope, (wanted - images(moves)).T, rcond=None)[0].T
        return moves

    places = []
    for j, sigma in enumerate(PLATFORM):
        moved = np.zeros(6)
        moved[j] = sigma
        places.append({n: np.stack(wrong(s, moved).image(point), -1)[0] for n, s in pair.items()})
    for name, sensor in pair.items():
        middle = there[name][1] - 0.5 * (sensor.camera.pixels - 1)
        for own in ([INTERIOR[0], 0.0], [0.0, INTERIOR[1]], [0.0, INTERIOR[2] * middle]):
            places.append(there | {name: there[name] + own})
    columns = intersected(places)
    constant = sum(np.outer(c, c) for c in columns)
    columns = intersected([there | {name: there[name] + own} for name in pair for own in ([0.2, 0.0], [0.0, 0.3])])
    random = sum(np.outer(c, c) for c in columns)
    for got, wanted in ((found.constant[k], constant), (found.random[k], random)):
        scale = np.sqrt(np.diag(wanted))
        np.testing.assert_allclose(got / np.outer(scale, scale), wanted / np.outer(scale, scale), atol=2e-3)


@pytest.mark.second
def test_maps_of_a_pass(sensors) -> None:
    places = {name: (s, 0, s.camera.pixels) for name, s in sensors.items()}
    maps = accuracy_maps(places, uncertainty(), HEIGHT)
    assert set(maps) == {*sensors, TOGETHER}
    # without a measured place nothing can be intersected
    assert TOGETHER not in accuracy_maps(places, uncertainty(image=np.zeros((2, 2))), HEIGHT)
    with pytest.raises(ValueError, match="two lines"):
        intersected_accuracy({"nadir": sensors["nadir"]}, uncertainty(), HEIGHT)
    short = replace(sensors["forward"], first_line_time=sensors["forward"].first_line_time, lines=20)
    with pytest.raises(ValueError, match="do not overlap"):
        intersected_accuracy({"nadir": replace(sensors["nadir"], lines=20), "forward": short}, uncertainty(), HEIGHT)
