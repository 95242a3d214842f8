"""From the on-board monitor to heights on the ground, end to end, and as a user runs it."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.orbit.forward_intersection import CalibratedLine, IntersectionError, Sightings, intersect_pair
from optics.geometry.tree import Motion
from scenes.specs.orbit.setup import MonitorSetup
from twin.framework.procedure import silent
from twin.monitor.truth import trace_truth
from twin.orbit.flight.line_camera import traced_line_cameras
from twin.orbit.monitoring.monitoring_run import run_monitor
from twin.orbit.monitoring.pair_flight import rms

ARCSEC = np.pi / 648000
FALSE_ALARM = 1e-6
JOB = (Path(__file__).parents[1] / "golden/jobs/monitor.yaml").read_text("utf-8")
for old, new in (
    ("repeats: 8", "repeats: 30"),
    ("points: 20", "points: 60"),
    ("intervals: .*\n", ""),
    (r"\d+ mK/m", "0 K/m"),
    ("change: .*", "change: [0 K, 0 K, 0 K, 0 K, 0 K]"),
):
    assert re.search(old, JOB)
    JOB = re.sub(old, new, JOB)
HOT = "[0 K/m, 0 K/m, 0 K/m], [0 K/m, 0 K/m, 0 K/m],\n        [0 K/m, 0 K/m, 0 K/m]]"
WARM = JOB.replace(HOT, "[2 mK/m, 9 mK/m, 5 mK/m], [4 mK/m, 18 mK/m, 10 mK/m],\n        [8 mK/m, 20 mK/m, 30 mK/m]]")
assert WARM != JOB


def write(folder: Path, text: str) -> Path:
    path = folder / "small.yaml"
    path.write_text(text, "utf-8")
    return path


def changed(setup: MonitorSetup, **errors) -> MonitorSetup:
    test = setup.test
    update = {"errors": test.errors.model_copy(update=errors)}
    return setup.model_copy(update={"test": test.model_copy(update=update)})


@pytest.fixture(scope="module")
def setup(tmp_path_factory) -> MonitorSetup:
    return MonitorSetup.read(write(tmp_path_factory.mktemp("monitor"), JOB))


@pytest.fixture(scope="module")
def quiet(setup, backend):
    """No noise at all, no temperatures."""
    return run_monitor(changed(setup, switched_on=False), backend, 3, silent)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory, backend):
    """Noise everywhere, a prism that warms unevenly at the end, and nothing stated: the monitor is read by `model`."""
    text = WARM + "disturbances: none\n"
    return run_monitor(MonitorSetup.read(write(tmp_path_factory.mktemp("noisy"), text)), backend, 3, silent)


@pytest.fixture(scope="module")
def stated(tmp_path_factory, backend):
    """The same with the instrument's disturbances."""
    return run_monitor(MonitorSetup.read(write(tmp_path_factory.mktemp("stated"), WARM)), backend, 3, silent)


# The correction


TURN = 10.0 * ARCSEC
MOTIONS = {
    "camera about X": {"base/forward": Motion((TURN, 0.0, 0.0))},
    "camera about Y": {"base/forward": Motion((0.0, TURN, 0.0))},
    "camera about Z": {"base/forward": Motion((0.0, 0.0, TURN))},
    "scaled, but for the line": {"base/forward": Motion(scale=20e-6)},
    "line along X": {"base/forward/focal_plane": Motion(shift=(50e-6, 0.0, 0.0))},
    "line along Y": {"base/forward/focal_plane": Motion(shift=(0.0, 50e-6, 0.0))},
    "line about Z": {"base/forward/focal_plane": Motion((0.0, 0.0, TURN))},
    "M1 tilted": {"base/forward/M1": Motion((0.5 * ARCSEC, 0.3 * ARCSEC, 0.0), pivot="centre")},
    "M2 shifted": {"base/forward/M2": Motion(shift=(2e-6, 3e-6, 2e-6))},
}
EXACT = 1e-9
"""Rad, 0.2 mas or 0.5 mm on the ground: products of two of 10 arcsec (2e-9), and 1e-9 of the line itself."""


@pytest.mark.second
def test_true_parameters_reproduce_the_traced_line(quiet, backend, gf7_pair) -> None:
    """Signs and order of the turns, by the trace. A whole camera's turn is in the four parameters entirely. A line that
    moves in its camera, or one that stays as long while the camera grows, looks through another field, with other
    distortion: 1% of the change is left at most."""
    change = trace_truth(gf7_pair, backend, list(MOTIONS.values())).cameras["forward"]
    nominal = traced_line_cameras(gf7_pair, backend, {})["forward"]
    calibrated = CalibratedLine(
        nominal.pixels, nominal.directions, nominal.origins, gf7_pair.camera_axes("forward"), change.nominal_distance
    )
    pixel = np.linspace(0.0, nominal.pixels - 1.0, 201)
    for k, (case, state) in enumerate(MOTIONS.items()):
        values = [float(v[k]) for v in (change.d_alpha, change.d_beta, change.d_gamma, change.d_f)]
        true = traced_line_cameras(gf7_pair, backend, state)["forward"]
        moved = np.linalg.norm(true.look(pixel) - nominal.look(pixel), axis=1).max()
        left = np.linalg.norm(true.look(pixel) - calibrated.corrected(values).look(pixel), axis=1).max()
        assert moved > 10.0 * EXACT, case
        assert left < (EXACT if case.startswith("camera") else 0.01 * moved + EXACT), case


def test_intersection_of_two_rays_is_exact_and_knows_its_limits() -> None:
    """Two stations 100 km apart over a point: by hand."""
    axes = np.diag([1.0, -1.0, -1.0])  # X forward, Z down
    line = CalibratedLine(1001, np.array([[0.0, 0.0, 1.0], [0.0, -0.01, 0.0]]), np.zeros((1, 3)), np.eye(3), 5.0)
    tilt = np.arctan2(100e3, 500e3)
    turn = np.array([[np.cos(tilt), 0.0, np.sin(tilt)], [0.0, 1.0, 0.0], [-np.sin(tilt), 0.0, np.cos(tilt)]])
    middle = np.array([500.0])
    back = Sightings(middle, np.array([[-100e3, 0.0, 500e3]]), (axes @ turn)[None])
    down = Sightings(middle, np.array([[0.0, 0.0, 500e3]]), axes[None])
    found = intersect_pair(line, line, back, down)
    assert found.ground == pytest.approx(np.zeros((1, 3)), abs=1e-8)  # rounding of 500 km
    assert found.miss == pytest.approx([0.0], abs=1e-8)
    # the forward ray one arcsec flatter: 1 arcsec x slant range / cos(tilt) over the base-to-height ratio
    flatter = intersect_pair(line.corrected([ARCSEC, 0.0, 0.0, 0.0]), line, back, down)
    slant = np.hypot(100e3, 500e3)
    assert flatter.ground[0, 2] == pytest.approx(ARCSEC * slant / np.cos(tilt) / np.tan(tilt), rel=1e-3)
    with pytest.raises(IntersectionError, match="parallel"):
        intersect_pair(line, line, down, down)
    with pytest.raises(ValueError, match="four finite numbers"):
        line.corrected([0.0, np.nan, 0.0, 0.0])


# What monitoring buys


@pytest.mark.second
def test_monitoring_takes_out_nearly_all(quiet) -> None:
    """Without noise and temperatures. The estimator is linear, with the Jacobian of the nominal camera: arcseconds of
    the focal plane's turn about X and Y, which it does not assume, leave 1e-3 of themselves; 1% of all is asked."""
    none, monitored = (quiet.cases[name].camera_height_rms for name in ("none", "monitored"))
    assert none > 5.0
    assert monitored < 0.01 * none
    assert rms(quiet.cases["monitored"].camera_plan) < 0.05 * rms(quiet.cases["none"].camera_plan)
    # exact data by the true cameras: what is left is rounding and the sensor's 1e-7 pixel
    assert quiet.cases["true"].height_rms < 1e-5
    # true parameters: second order and what the four cannot say
    assert quiet.cases["parameters"].camera_height_rms < 2e-3


@pytest.mark.second
def test_height_without_monitoring_is_the_angle_times_metres_per_arcsec(quiet) -> None:
    """Traced metres of each camera's turn predict the height to 2%: the latitude changes the altitude by 1%, the scale
    and d_gamma add millimetres. Of the angle alone it is 5%, for the cameras do not turn by exactly half each."""
    run = flight = quiet
    height = run.cases["none"].camera
    size = rms(height)
    told = run.conversion
    by_camera = -sum(told.traced[n] * flight.truth[n][:, 0] / ARCSEC for n in flight.pair)
    assert rms(height - by_camera) < 0.02 * size
    assert rms(height + told.of_angle * run.angle_change / ARCSEC) < 0.05 * size
    for name in flight.pair:
        assert told.traced[name] == pytest.approx(
            told.theory[name], rel=0.01
        )  # mean of the points, deflection of the up
    # by hand with flat ground, the paper's way
    flat = 500e3 * ARCSEC * (1.0 + np.tan(np.radians(26.0)) ** 2) / (np.tan(np.radians(26.0)) + np.tan(np.radians(5.0)))
    assert told.traced["forward"] == pytest.approx(flat, rel=0.2)  # the curved Earth


@pytest.mark.second
def test_noise_is_as_large_as_its_sigma(noisy) -> None:
    """Repeats with everything drawn anew, and every time's own measurement, each against its own sigma, for all share
    the reference's noise: false alarm 1e-6 each."""
    seen, free = noisy.scatter, len(noisy.scatter.heights) - 1
    assert seen.spread == pytest.approx(np.std(seen.heights, ddof=1))
    total = free * (seen.spread / seen.sigma) ** 2
    assert chi2.ppf(FALSE_ALARM, free) < total < chi2.isf(FALSE_ALARM, free)
    assert 1e-4 < seen.sigma < 0.01
    # one time has one draw: 4.9 sigmas
    assert np.abs(noisy.parts["noise"] / noisy.sigma).max() < 4.9


# Stated disturbances


@pytest.mark.second
def test_the_noise_is_not_the_whole_error(stated) -> None:
    """The truth is missed by what the spots leave open, as the total sigma says."""
    later = np.arange(5) != stated.spec.referred
    assert np.all(stated.sigma_total[later] > 20.0 * stated.sigma[later])
    wrong = stated.cases["monitored"].camera
    assert rms(wrong) > 5.0 * rms(stated.sigma)
    # 4.9 sigmas: one in a million
    assert np.abs(wrong[later] / stated.sigma_total[later]).max() < 4.9
    assert stated.angle.change_rad[0] == stated.angle.sigma_rad[0] == stated.sigma_total[0] == 0.0


@pytest.mark.second
def test_smoothed_heights(stated) -> None:
    """At every interval no worse than linear between, less sure the fewer the measurements, and sure of the
    reference; with every time measured at least as sure as each measurement alone."""
    sigmas = [rms(one.sigma) for one in stated.smoothing.values()]
    assert sigmas == sorted(sigmas)
    every = stated.smoothing[600.0]
    assert np.all(every.sigma <= stated.sigma_total * (1.0 + 1e-6))
    assert every.factor == pytest.approx(1.0, abs=0.05)
    chosen = stated.smoothing[1200.0]
    assert chosen.factor > 1.1
    assert chosen.case.camera_height_rms == stated.cases["smoothed"].camera_height_rms
    assert chosen.factor == stated.cases["interval"].camera_height_rms / stated.cases["smoothed"].camera_height_rms
    # the linear error is the intersected one but for products of two arcseconds
    assert chosen.error == pytest.approx(chosen.case.camera, abs=2e-3)
    for one in stated.smoothing.values():
        assert one.sigma[0] == one.error[0] == 0.0
        assert len(one.ratios) == 4
        assert one.agrees
        assert one.consistency.agrees
        assert one.consistency.degrees % 8 == 0
