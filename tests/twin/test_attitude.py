"""Orbital frame, yaw steering, and the errors of measured orbits and attitudes. Statistical tests have a false-alarm
rate of 1e-6 each.
"""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.stats import chi2

from optics.geometry.pose import rotation_vector
from scenes.specs.orbit.flight import AttitudeSpec, ErrorsSpec, OrbitSpec
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.trajectory import TERMS, Attitude, Trajectory

EARTH = Earth()
FALSE_ALARM = 1e-6
ARCSEC = math.pi / 648000
ERRORS = yaml.safe_load(Path(__file__).with_name("attitude_errors.yaml").read_text("utf-8"))
SPEC = ErrorsSpec.model_validate(ERRORS)


@cache
def trajectory(
    nadir: str = "geodetic", steering: str = "none", latitude: float = 40.0, offset: tuple = ()
) -> Trajectory:
    place = {"longitude": "116 deg", "latitude": f"{latitude} deg"}
    spec = OrbitSpec.model_validate({"epoch": "2011-03-05T03:05:00Z", "passing": place})
    attitude = {"nadir": nadir, "steering": steering, **({"offset": list(offset)} if offset else {})}
    law = Attitude.from_spec(AttitudeSpec.model_validate(attitude))
    return Trajectory(propagate(spec, EARTH), law)


def inside(samples: np.ndarray, sigma: float) -> bool:
    """Is the variance of independent samples of zero mean the stated one? Two-sided chi-square."""
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], samples.size)
    return bool(low < np.sum(samples**2) / sigma**2 < high)


@pytest.mark.parametrize("nadir", ["geodetic", "geocentric"])
@pytest.mark.parametrize("steering", ["none", "yaw"])
def test_axes(nadir: str, steering: str) -> None:
    path = trajectory(nadir, steering)
    t = np.linspace(-600.0, 600.0, 60).reshape(6, 10)
    axes = path.body_to_itrs(t)
    assert axes.shape == (6, 10, 3, 3)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, -1, -2), np.broadcast_to(np.eye(3), axes.shape), atol=2e-15)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-14)
    position, velocity, inertial = path.position(t), path.velocity(t), path.inertial_velocity(t)
    # Z looks down: straight below lies the point of the same longitude and latitude, or the Earth's centre
    lon, lat, height = EARTH.geodetic(position)
    below = EARTH.ecef(lon, lat) if nadir == "geodetic" else np.zeros_like(position)
    distance = np.linalg.norm(below - position, axis=-1, keepdims=True)
    np.testing.assert_allclose(position + distance * axes[..., 2], below, rtol=0, atol=2e-8)
    if nadir == "geodetic":
        np.testing.assert_allclose(distance[..., 0], height, atol=2e-8)
    # X is forward, and against the stars the velocity has no part along Y
    assert np.all(np.sum(axes[..., 0] * velocity, axis=-1) > 7000.0)
    across = np.sum(axes[..., 1] * inertial, axis=-1)
    if steering == "none":
        np.testing.assert_allclose(across, 0.0, atol=1e-8)
    else:
        # the Earth turns below at 500 m/s x cos(latitude), here at most 79 degrees
        assert np.min(np.abs(across)) > 80.0
    # Y is to the right, on the descending pass the west
    assert np.all(np.sum(axes[..., 1] * np.cross(position, inertial), axis=-1) < 0.0)
    west = np.stack([np.sin(lon), -np.cos(lon), 0 * lon], axis=-1)
    assert np.all(np.sum(axes[..., 1] * west, axis=-1) > 0.0)


def nadir_drift(path: Trajectory, t: float) -> np.ndarray:
    """Motion (x, y) of the image of the ground point below, as tangents per second, by differences."""
    axis = path.body_to_itrs(t)[:, 2]
    point = EARTH.intersect(path.position(t), axis)
    tangents = []
    for step in (-0.01, 0.01):
        seen = (point - path.position(t + step)) @ path.body_to_itrs(t + step)
        tangents.append(seen[:2] / seen[2])
    return np.asarray((tangents[1] - tangents[0]) / 0.02)


@pytest.mark.second
@pytest.mark.parametrize("nadir", ["geodetic", "geocentric"])
@pytest.mark.parametrize("latitude", [0.0, 40.0, -60.0])
def test_yaw_steering_stops_the_drift_along_the_line(nadir: str, latitude: float) -> None:
    for t in (-300.0, 0.0, 250.0):
        along, across = nadir_drift(trajectory(nadir, "yaw", latitude), t)
        # 7 km/s at 500 km; the ground moves backward
        assert along == pytest.approx(-7.06 / 500, rel=0.05)
        # rounding of the points, 2e-9 m / 500 km / 0.02 s = 2e-13 per second, and second differences
        assert abs(across) < 1e-9 * abs(along)
        along, across = nadir_drift(trajectory(nadir, "none", latitude), t)
        # up to 4 degrees at the equator, with cos(latitude); these are below 80 degrees
        assert abs(across / along) > 0.01


def test_offset_is_a_turn_of_the_body() -> None:
    path = trajectory(offset=("1 deg", "-2 deg", "3 deg"))
    turn = np.swapaxes(path.orbital_to_itrs([0.0, 9.0]), -1, -2) @ path.body_to_itrs([0.0, 9.0])
    np.testing.assert_allclose(np.degrees(rotation_vector(turn)), [[1.0, -2.0, 3.0]] * 2, atol=1e-12)
    # a pitch about +Y lifts the view forward: Z toward +X
    pitched = trajectory(offset=("0 deg", "1 deg", "0 deg"))
    assert (pitched.orbital_to_itrs(0.0).T @ pitched.body_to_itrs(0.0))[0, 2] == pytest.approx(math.sin(math.pi / 180))


def differences(measured: Trajectory, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position and velocity errors in the orbital frame, rotation vectors in the body's, each (N, 3)."""
    true = replace(measured, errors=None)
    axes = true.orbital_to_itrs(t)
    place = np.einsum("nji,nj->ni", axes, measured.position(t) - true.position(t))
    speed = np.einsum("nji,nj->ni", axes, measured.inertial_velocity(t) - true.inertial_velocity(t))
    turn = rotation_vector(np.swapaxes(true.body_to_itrs(t), -1, -2) @ measured.body_to_itrs(t))
    return place, speed, turn


FIXES = np.arange(-598.0, 600.0, 2.0)
LOOKS = np.arange(-599.75, 600.0, 0.25)


def test_white_noise() -> None:
    path = trajectory("geodetic", "yaw")
    place, speed, _ = differences(path.with_errors(SPEC, 5, ["gps_noise", "gps_velocity"]), FIXES)
    turn = differences(path.with_errors(SPEC, 5, ["attitude_noise"]), LOOKS)[2]
    for series, sigmas in ((place, (1, 2, 3)), (speed, (0.01, 0.02, 0.03)), (turn / ARCSEC, (2, 3, 15))):
        for k, sigma in enumerate(sigmas):
            x = series[:, k]
            assert inside(x, sigma)
            assert not inside(x, 1.3 * sigma)
            # white: neighbours' correlation has the deviation 1/sqrt(N); 4.9 sigma for the false-alarm rate
            assert abs(np.mean(x[1:] * x[:-1])) < 4.9 * sigma**2 / math.sqrt(x.size - 1)


@pytest.mark.second
def test_slow_orbit_errors_have_their_deviation_and_correlation_time() -> None:
    kept, count = math.exp(-2.0 / 60.0), 40
    start, innovations = [], []
    for seed in range(count):
        x = differences(trajectory().with_errors(SPEC, seed, ["gps_drift"]), FIXES)[0]
        start.append(x[0])
        innovations.append(x[1:] - kept * x[:-1])
    for k, sigma in enumerate((4.0, 5.0, 6.0)):
        assert inside(np.array(start)[:, k], sigma)
        # of a Gauss-Markov process they are white with variance sigma^2 (1 - kept^2)
        white = np.array(innovations)[..., k]
        assert inside(white.ravel(), sigma * math.sqrt(1 - kept**2))
        product = white[:, 1:] * white[:, :-1]
        assert abs(np.mean(product)) < 4.9 * sigma**2 * (1 - kept**2) / math.sqrt(product.size)


def test_bias_and_thermal_drift() -> None:
    path = trajectory()
    t = np.linspace(-600.0, 600.0, 25)
    bias = differences(path.with_errors(SPEC, 1, ["attitude_bias"]), t)[2]
    np.testing.assert_allclose(bias / ARCSEC, np.broadcast_to([10.0, -20.0, 30.0], (25, 3)), atol=1e-9)
    thermal = differences(path.with_errors(SPEC, 1, ["attitude_thermal"]), t)[2]
    lat = EARTH.geodetic(path.position(t))[1]
    assert np.ptp(lat) > 1.0
    np.testing.assert_allclose(
        thermal / ARCSEC, np.sin(lat - math.radians(40.0))[:, None] * [1.0, -2.0, 3.0], rtol=0, atol=1e-9
    )
    # at the place of the epoch, 40 N, it vanishes
    np.testing.assert_allclose(thermal[12], 0.0, atol=1e-9 * ARCSEC)


def test_terms_are_switched_one_by_one_and_do_not_touch_each_other() -> None:
    path, t = trajectory(), np.linspace(-100.0, 100.0, 41)
    alone = [differences(path.with_errors(SPEC, 7, [term]), t) for term in TERMS]
    together = differences(path.with_errors(SPEC, 7), t)
    np.testing.assert_allclose(together[0], sum(one[0] for one in alone), atol=1e-8)
    np.testing.assert_allclose(together[1], sum(one[1] for one in alone), atol=1e-10)
    np.testing.assert_allclose(together[2], sum(one[2] for one in alone), atol=1e-13)
    acts = [
        tuple(bool(np.max(np.abs(part)) > limit) for part, limit in zip(one, (1e-3, 1e-5, 1e-8), strict=True))
        for one in alone
    ]
    # the last two, a drift and a random walk of the attitude, are not stated here
    told, silent = [(False, False, True)] * 4, [(False, False, False)] * 2
    assert acts == [(True, False, False)] * 2 + [(False, True, False)] + told + silent
    # the true velocity against the ground gets the same error as that against the stars
    measured = path.with_errors(SPEC, 7)
    np.testing.assert_allclose(
        measured.velocity(t) - path.velocity(t), measured.inertial_velocity(t) - path.inertial_velocity(t), atol=1e-10
    )


def test_mistakes() -> None:
    with pytest.raises(ValueError, match="time outside the orbit"):
        trajectory().with_errors(SPEC, 1).body_to_itrs([0.0, 601.0])
