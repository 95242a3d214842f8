"""From the on-board monitor to heights on the ground, end to end and as a user runs it. The monitor in a loop: commands
against a recursion of its own, and rendered courses against the exact trace.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.monitor.disturbances import Disturbances
from analysis.monitor.model_fit import unobservable_modes
from analysis.orbit.forward_intersection import CalibratedLine, IntersectionError, Sightings, intersect_pair
from analysis.statistics import rms
from optics.geometry.tree import Motion
from scenes.models.disturbances import state_of
from scenes.specs.course import CourseSpec
from scenes.specs.orbit.monitor import CorrectionSpec, MotionSpec
from scenes.specs.orbit.setup import MonitorSetup
from twin.framework.procedure import silent
from twin.framework.provenance import negative_verdicts
from twin.monitor.image_quality import image_quality
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import trace_truth
from twin.orbit.flight.line_camera import traced_line_cameras
from twin.orbit.monitoring import closed_loop, monitoring_report
from twin.orbit.monitoring.closed_loop import FOCUS_FIELDS, Commands, Corrector, LoopCourse, LoopModel, defocus
from twin.orbit.monitoring.loop_run import LoopRun
from twin.orbit.monitoring.monitoring_numbers import CORRECTION, LOOP
from twin.orbit.monitoring.monitoring_report import monitor_report
from twin.orbit.monitoring.monitoring_run import run_monitor

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
    later = np.arange(5) != stated.spec.reference_index
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
    assert "the predicted sigma" in " ".join(monitor_report(stated).lead)
    # errors far below or beyond their sigma are told as they are
    tiny = replace(chosen, error=0.01 * chosen.sigma)
    large = replace(chosen, error=1.1 * chosen.limit * chosen.sigma)
    for smoothing, words in (
        (tiny, "the errors are 0.01 σ RMS"),
        (replace(chosen, error=chosen.sigma), "the errors are 1 σ RMS, 1.0 σ at most"),
        (large, f"{1.1 * chosen.limit:.1f} σ at most (limit {chosen.limit:.1f} σ)"),
    ):
        run = replace(stated)
        run.__dict__["smoothing"] = {**stated.smoothing, stated.spec.cadence: smoothing}
        assert words in monitoring_report._gain(run)
    assert chosen.factor == stated.cases["interval"].camera_height_rms / stated.cases["smoothed"].camera_height_rms
    # the linear error is the intersected one but for products of two arcseconds
    assert chosen.error == pytest.approx(chosen.case.camera, abs=2e-3)
    for one in stated.smoothing.values():
        assert one.sigma[0] == one.error[0] == 0.0
        assert len(one.ratios) == 4
        assert one.agrees
        assert one.consistency.agrees
        assert one.consistency.degrees % 8 == 0


# --- the monitor in a loop --------------------------------------------------------------------------------------------


def loop_of(*specs: dict) -> LoopModel:
    """Loops without an instrument: mechanism k moves quantity k by 2 k + 1, and a little of the next one's."""
    count = len(specs)
    correctors = []
    for k, given in enumerate(specs):
        spec = CorrectionSpec(camera="one", quantity="d_alpha", mechanism="body rotate y", **given)
        effect = np.zeros(count)
        effect[(k + 1) % count] = 0.1
        effect[k] = 2.0 * k + 1.0
        correctors.append(Corrector(f"c{k}", spec, None, k, effect, np.zeros(2)))
    nothing = Disturbances(
        "none", (), (), (), np.zeros(0), (), np.zeros((2, 0)), np.zeros((count, 0)), np.zeros((0, 0)), ()
    )
    return LoopModel(None, nothing, tuple(correctors))  # type: ignore[arg-type]


def commanded(model: LoopModel, course: np.ndarray) -> np.ndarray:
    """(T, n) where mechanisms stand after each reading of a course (T, n)."""
    commands, out = Commands.none(model, False), []
    for row in course:
        commands = commands.after_reading(row)
        out.append(commands.positions_now)
    return np.array(out)


@pytest.mark.parametrize("delay", [0, 2])
def test_commands_are_those_of_an_integrator_with_a_delay(delay: int) -> None:
    course = np.random.default_rng(delay).standard_normal((30, 2)) * ARCSEC
    specs = ({"gain": 0.4, "delay": delay}, {"gain": 0.2, "step": "0.3 arcsec"})
    found = commanded(loop_of(*specs), course)
    effect = np.array([[1.0, 0.1], [0.1, 3.0]])
    first, second, stands = [0.0] * (delay + 1), 0.0, np.zeros(2)
    for row, seen in zip(course, found, strict=True):
        left = row + effect @ stands
        first.append(first[-1] - 0.4 * left[0])
        second -= 0.2 * left[1] / 3.0
        step = 0.3 * ARCSEC
        stands = np.array([first[-1 - delay], step * round(second / step)])
        np.testing.assert_allclose(seen, stands, rtol=1e-12, atol=1e-18)


def test_above_the_limit_commands_grow_until_the_range_ends() -> None:
    course = np.full((60, 1), ARCSEC)
    model = loop_of({"gain": 1.1, "delay": 1, "range": "3 arcsec"})
    assert np.abs(commanded(model, course)).max() == pytest.approx(3.0 * ARCSEC)
    commands = [Commands.none(model, False)]
    for row in course:
        commands.append(commands[-1].after_reading(row))
    assert any(one.held[0] for one in commands)


def test_gain_nothing_dead_bands_and_the_open_loop_leave_mechanisms_alone() -> None:
    course = np.random.default_rng(1).standard_normal((10, 2)) * ARCSEC
    assert not commanded(loop_of({"gain": 0.0}, {"gain": 0.0}), course).any()
    assert not commanded(loop_of({"gain": 0.5, "dead_band": "9 arcsec"}, {"gain": 0.0}), course).any()
    commands = Commands.none(loop_of({"gain": 0.5}, {"gain": 0.5}), True)
    assert not commands.after_reading(course[0]).after_reading(course[1]).positions_now.any()


@pytest.fixture(scope="module")
def loop_setup(tmp_path_factory) -> MonitorSetup:
    return MonitorSetup.read(Path(__file__).with_name("orbit_loop.yaml"))


@pytest.fixture(scope="module")
def model(loop_setup: MonitorSetup, backend) -> LoopModel:
    return closed_loop.loop_model(loop_setup, MonitorExperiment(loop_setup.resolved, backend))


def course_of(loop_setup: MonitorSetup, model: LoopModel, still: bool = False, **changed: dict) -> LoopCourse:
    """A rendered course, with other keys of some corrections."""
    own = tuple(replace(one, spec=one.spec.model_copy(update=changed.get(one.name, {}))) for one in model.correctors)
    loop = LoopModel(model.experiment, model.prior, own)
    states = closed_loop.drifting_states(loop_setup.test, model.experiment, 3)
    return closed_loop.simulate_course(
        loop, loop_setup.test, states, closed_loop.reader(loop, loop_setup.test, 7), still
    )


@pytest.fixture(scope="module")
def left_alone(loop_setup: MonitorSetup, model: LoopModel) -> LoopCourse:
    return course_of(loop_setup, model, still=True)


@pytest.fixture(scope="module")
def perfect(loop_setup: MonitorSetup, model: LoopModel) -> LoopCourse:
    return course_of(loop_setup, model)


@pytest.fixture(scope="module")
def idle(loop_setup: MonitorSetup, backend) -> LoopRun:
    """A whole run whose corrections all have gain 0."""
    test = loop_setup.test
    still = {name: one.model_copy(update={"gain": 0.0}) for name, one in test.loop.corrections.items()}
    readings = test.loop.readings.model_copy(update={"count": 2})
    loop = test.loop.model_copy(update={"corrections": still, "readings": readings})
    parts = {"test": test.model_copy(update={"mechanisms": loop})}
    return run_monitor(loop_setup.model_copy(update=parts), backend, 3)


@pytest.mark.second
def test_a_loop_near_its_limit_or_that_makes_anything_worse_leads_the_verdict(idle: LoopRun) -> None:
    """Changes of cameras a fifth larger with the loop closed, and foci half of a percent, of which nobody speaks."""
    told = monitor_report(idle)
    assert not told.warnings
    gains = {"tilt": 9.0, "roll": 1.03, "focus": 2.0}
    loops = {name: replace(one, margins=replace(one.margins, gain=gains[name])) for name, one in idle.loops.items()}
    near = monitor_report(replace(idle, margin=1.03, radius=0.99, loops=loops))
    assert near.warnings[0].endswith("lower the gains, that of roll first")
    assert near.verdict.startswith("The loop is barely stable; with the loop closed")
    assert near.warnings[0].startswith(
        "the loop is barely stable: gains of 1.03 times the stated ones make it unstable"
    )
    assert negative_verdicts(LOOP(replace(idle, margin=1.03, radius=0.99))) == ["margins_hold"]
    lost = monitor_report(replace(idle, margin=0.9, radius=1.1))
    assert lost.verdict.startswith("The loop is unstable; ")
    assert lost.warnings[0].startswith(
        "the loops together are unstable: largest eigenvalue 1.1; gains below 0.900 times"
    )
    alone = CORRECTION["stable"].warning((idle, "tilt", replace(idle.loops["tilt"], loop_gain=3.0)))
    assert alone.startswith("tilt is unstable by itself: its loop gain of 3 is not below 2, the limit of a delay of 0")
    larger = np.ones(idle.open.truth.shape[1])
    cameras = len(idle.model.cameras)
    larger[: 4 * cameras], larger[4 * cameras :] = 1.2, 1.005
    worse = replace(idle, closed=replace(idle.closed, truth=larger * idle.open.truth))
    moved = np.sqrt(np.mean(idle.open.truth**2, axis=0)) > 1e-9
    assert {name.partition(" ")[0] for name in worse.worse} >= {"angle", "d_alpha", "d_beta", "d_gamma"}
    assert len(worse.worse) == 1 + moved[: 4 * cameras].sum()
    for free, left in worse.worse.values():
        assert left == pytest.approx(1.2 * free, rel=1e-12)
    told = monitor_report(worse)
    assert told.verdict.startswith("The loop makes angle, d_alpha of forward, ")
    assert "the loop makes angle worse: its error, RMS over the moments, is 1.20 times" in told.warnings[0]
    assert LOOP(worse)["made_worse"] == list(worse.worse)


@pytest.mark.second
def test_a_perfect_loop_leaves_the_sigma_of_the_posterior(model, left_alone, perfect) -> None:
    rows = [one.row for one in model.correctors]
    # nothing is left of what the posterior says but what mechanisms do to each other's quantities, and what it does not
    # know is as without a loop
    assert np.all(np.abs(perfect.expected[:, rows]) < 1e-2 * perfect.sigma[:, rows])
    np.testing.assert_allclose(perfect.covariance, left_alone.covariance, rtol=1e-2, atol=1e-30)
    # and by the exact trace of the states that the mechanisms have left, it is what the posterior was wrong by
    for course in (left_alone, perfect):
        truth = model.experiment.sight.truth(list(course.states))
        quality = image_quality(
            model.experiment.instrument, model.experiment.backend, list(course.states), FOCUS_FIELDS, obstruction=False
        )
        true = np.concatenate([truth.vector("forward"), truth.vector("backward"), defocus(quality).T], axis=1)
        for k, one in enumerate(model.correctors):
            if one.motion is None:
                true[:, one.row] += course.positions[:, k]
        ratio = (course.expected - true)[:, rows] / course.sigma[:, rows]
        # 18 normal numbers: one in 10^5 is beyond 4.9
        assert np.abs(ratio).max() < 4.9
        if course is perfect:
            assert np.all(np.abs(true[:, rows]) < 4.9 * course.sigma[:, rows])
    tilt = model.row("forward", "d_alpha")
    assert np.abs(left_alone.expected[:, tilt]).max() > 5.0 * left_alone.sigma[:, tilt].max()


@pytest.mark.second
def test_a_loop_takes_back_what_a_course_and_its_motions_do(loop_setup, model) -> None:
    """Readings at the times of a course: a camera that jumps by 2 arcsec is turned back to what the posterior knows."""
    course = CourseSpec.model_validate(
        {"times": ["0 min", "10 min"], "temperature": {"base/forward": {"change": ["0 K", "0.1 K"]}}}
    )
    jump = MotionSpec.model_validate({"rotate": ["0 arcsec", "2 arcsec", "0 arcsec"], "begin": "5 min"})
    loop = loop_setup.test.loop.model_copy(update={"readings": None})
    test = loop_setup.test.model_copy(update={"course": course, "motion": {"base/forward": jump}, "mechanisms": loop})
    own = loop_setup.model_copy(update={"test": test})
    left, free = (course_of(own, model, still=still) for still in (False, True))
    true, free_true = (model.experiment.sight.truth(list(one.states)).vector("forward")[:, 0] for one in (left, free))
    assert free_true[1] - free_true[0] == pytest.approx(2.0 * ARCSEC, rel=0.05)
    assert np.all(np.abs(true) < 4.9 * left.sigma[:, model.row("forward", "d_alpha")])


@pytest.mark.second
def test_a_mode_that_no_spot_shows_moves_heights_by_the_exact_trace(loop_setup, model, backend) -> None:
    experiment = model.experiment
    angle, first, second = np.zeros(10), np.zeros(10), np.zeros(10)
    angle[[model.row("forward", "d_alpha"), model.row("backward", "d_alpha")]] = 1.0, -1.0
    first[model.row("forward", "defocus")] = second[model.row("backward", "defocus")] = 1.0
    modes = unobservable_modes(model.prior, np.stack([angle, first, second]), np.array([ARCSEC, 1e-5, 1e-5]))
    assert len(modes) == 3
    components = experiment.prior.components
    for mode in modes:
        amounts = mode.motions * experiment.prior.sigma
        state = state_of(amounts, components, experiment.thermal)
        spots = experiment.path.mean_spots([{}, state])
        moved = np.abs(spots[1] - spots[0]).max()
        # a reading knows a spot to 1e-3 px; products of two small motions are left
        assert moved < 5e-4
        change = experiment.sight.truth([state])
        angle_moved = float(change.vector("forward")[0, 0] - change.vector("backward")[0, 0])
        foci = defocus(image_quality(experiment.instrument, backend, [{}, state], FOCUS_FIELDS, obstruction=False))
        found = np.array([angle_moved, *(foci[:, 1] - foci[:, 0])])
        np.testing.assert_allclose(found / [ARCSEC, 1e-5, 1e-5], mode.quantities / [ARCSEC, 1e-5, 1e-5], atol=2e-3)
