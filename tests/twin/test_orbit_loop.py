"""The monitor in a loop: commands against a recursion of its own, and rendered courses against the exact trace."""

import json
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import twin.orbit.__main__ as command
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.unseen_motions import unseen_modes
from scenes.models.disturbances import state_of
from scenes.specs.orbit.loop import CorrectionSpec, LoopImagesSpec
from scenes.specs.orbit.setup import LoopSetup, resolve_loop
from scenes.specs.resolved import line_detector
from tests.twin.commands import invoke, refused
from twin.monitor.image_quality import image_quality
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.orbit.loop.loop_course import Commands, LoopCourse, drifting_states, gone_through, reader
from twin.orbit.loop.loop_model import FOCUS_FIELDS, Corrector, LoopModel, defocus, loop_model
from twin.orbit.loop.loop_numbers import LOOP
from twin.orbit.loop.loop_report import _warnings as loop_warnings
from twin.orbit.loop.loop_report import loop_report
from twin.orbit.loop.loop_run import LoopRun, run_loop
from twin.run.provenance import negative_verdicts

run = partial(invoke, command.app)
ARCSEC = np.pi / 648000.0
SMALL = """
name: small
instrument: gf7_pair
frames: 2
disturbances:
  file: orbit
  without: [base_heat, camera_heat, mirror_mounts, prism_180_heat, prism_0_heat, prism_mounts, central_prism_heat]
  causes:
    metering: {bodies: base/*/M2, shift: [0 um, 0 um, 15 um], time: {period: 94.6 min, drift: 20 h}, reason: rods}
readings: {every: 10 min, count: 3}
corrections:
  tilt: {camera: forward, quantity: d_alpha, mechanism: base/forward rotate y, gain: 1}
  roll: {camera: backward, quantity: d_beta, gain: 1}
  focus: {camera: forward, quantity: defocus, mechanism: base/forward/focal_plane shift z, gain: 1}
orbit: {epoch: 2021-06-21T02:40:00Z, before: 2 min, after: 42 min, passing: {longitude: 116 deg, latitude: 60 deg}}
ground: {points: 6, first: 1500, last: 31267}
seed: 3
"""


def loop_of(*specs: dict) -> LoopModel:
    """Loops without an instrument: mechanism k moves quantity k by 2 k + 1, and a little of the next one's."""
    count = len(specs)
    correctors = []
    for k, given in enumerate(specs):
        spec = CorrectionSpec(camera="one", quantity="d_alpha", mechanism="body rotate y", **given)
        effect = np.zeros(count)
        effect[k], effect[(k + 1) % count] = 2.0 * k + 1.0, 0.1 * (count > 1)
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
        commands = commands.given(row)
        out.append(commands.standing)
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
    # eigenvalues of the size of the root of the gain: 1.1^30 and 0.9^30 over sixty readings
    grown = commanded(loop_of({"gain": 1.1, "delay": 1}), course)[:, 0] + ARCSEC
    calm = commanded(loop_of({"gain": 0.9, "delay": 1}), course)[:, 0] + ARCSEC
    assert np.abs(grown[-8:]).max() > 8.0 * ARCSEC
    assert np.abs(calm[-8:]).max() < 0.1 * ARCSEC
    model = loop_of({"gain": 1.1, "delay": 1, "range": "3 arcsec"})
    held = commanded(model, course)[:, 0]
    assert np.abs(held).max() == pytest.approx(3.0 * ARCSEC)
    commands = Commands.none(model, False)
    ends = []
    for row in course:
        commands = commands.given(row)
        ends.append(bool(commands.held[0]))
    assert any(ends)


def test_gain_nothing_dead_bands_and_the_open_loop_leave_mechanisms_alone() -> None:
    course = np.random.default_rng(1).standard_normal((10, 2)) * ARCSEC
    assert not commanded(loop_of({"gain": 0.0}, {"gain": 0.0}), course).any()
    assert not commanded(loop_of({"gain": 0.5, "dead_band": "9 arcsec"}, {"gain": 0.0}), course).any()
    commands = Commands.none(loop_of({"gain": 0.5}, {"gain": 0.5}), True)
    assert not commands.given(course[0]).given(course[1]).standing.any()


def test_a_swing_is_left_as_the_transfer_says() -> None:
    """The filter is not in this: with the state known, what images see is |1 - g z^-d / (1 - 1/z + g z^-(d+1))|."""
    k, gain = np.arange(400), 0.6
    course = np.cos(2.0 * np.pi * 0.05 * k)[:, None] * ARCSEC
    left = course[:, 0] + commanded(loop_of({"gain": gain, "delay": 1}), course)[:, 0]
    z = np.exp(2j * np.pi * 0.05)
    share = abs(1.0 - gain * z**-1 / (1.0 - 1.0 / z + gain * z**-2))
    assert np.abs(left[-200:]).max() / ARCSEC == pytest.approx(share, rel=0.02)


@pytest.fixture(scope="module")
def setup(tmp_path_factory) -> LoopSetup:
    file = tmp_path_factory.mktemp("loop") / "small.yaml"
    file.write_text(SMALL, "utf-8")
    return resolve_loop(file)


@pytest.fixture(scope="module")
def model(setup: LoopSetup, backend) -> LoopModel:
    return loop_model(setup, MonitorExperiment(setup.resolved, backend))


def course_of(setup: LoopSetup, model: LoopModel, still: bool = False, **changed: dict) -> LoopCourse:
    """A rendered course, with other keys of some corrections."""
    own = tuple(replace(one, spec=one.spec.model_copy(update=changed.get(one.name, {}))) for one in model.correctors)
    loop = LoopModel(model.experiment, model.stated, own)
    states = drifting_states(setup.test, model.experiment, 3)
    return gone_through(loop, setup.test, states, reader(loop, setup.test, 7), still)


@pytest.fixture(scope="module")
def left_alone(setup: LoopSetup, model: LoopModel) -> LoopCourse:
    return course_of(setup, model, still=True)


@pytest.fixture(scope="module")
def perfect(setup: LoopSetup, model: LoopModel) -> LoopCourse:
    return course_of(setup, model)


@pytest.fixture(scope="module")
def idle(setup: LoopSetup, backend) -> LoopRun:
    """A whole run, with images, whose corrections all have gain 0."""
    test = setup.test
    still = {name: one.model_copy(update={"gain": 0.0}) for name, one in test.corrections.items()}
    images = LoopImagesSpec.model_validate(
        {"times": ["10 min"], "side": 200, "points": {"control": 0, "tie": 20, "reach": 10}}
    )
    readings = test.readings.model_copy(update={"count": 2})
    parts = {"test": test.model_copy(update={"corrections": still, "images": images, "readings": readings})}
    sheets = {name: line_detector(one) for name, one in setup.cameras.items()}
    return run_loop(setup.model_copy(update={**parts, "line_detectors": sheets}), backend, 3)


@pytest.mark.second
def test_a_loop_near_its_limit_or_that_makes_anything_worse_leads_the_verdict(idle: LoopRun) -> None:
    """Changes of cameras a fifth larger with the loop closed, and foci half of a percent, of which nobody speaks."""
    told = loop_report(idle)
    assert not told.warnings
    near = loop_report(replace(idle, margin=1.03, radius=0.99))
    assert near.verdict.startswith("The loop is barely stable; with the loop closed")
    assert near.warnings[0].startswith(
        "the loop is barely stable: gains of 1.03 times the stated ones make it unstable"
    )
    assert negative_verdicts(LOOP(replace(idle, margin=1.03, radius=0.99))) == ["margins_hold"]
    assert loop_report(replace(idle, margin=0.9, radius=1.1)).verdict.startswith("The loop is unstable; ")
    larger = np.ones(idle.open.truth.shape[1])
    cameras = len(idle.model.cameras)
    larger[: 4 * cameras], larger[4 * cameras :] = 1.2, 1.005
    worse = replace(idle, closed=replace(idle.closed, truth=larger * idle.open.truth))
    moved = np.sqrt(np.mean(idle.open.truth**2, axis=0)) > 1e-9
    assert {name.partition(" ")[0] for name in worse.worse} >= {"angle", "d_alpha", "d_beta", "d_gamma"}
    assert len(worse.worse) == 1 + moved[: 4 * cameras].sum()
    for free, left in worse.worse.values():
        assert left == pytest.approx(1.2 * free, rel=1e-12)
    told = loop_report(worse)
    assert told.verdict.startswith("The loop makes angle, d_alpha of forward, ")
    assert "the loop makes angle worse: its error, RMS over the moments, is 1.20 times" in told.warnings[0]
    assert LOOP(worse)["made_worse"] == list(worse.worse)


def quiet_loop(**changes) -> SimpleNamespace:
    """Return the parts of a run that warnings look at, with nothing to warn of."""
    one = SimpleNamespace(course=SimpleNamespace(times=[0.0, 600.0], jumps=(), agrees=True, evidence=None), images=())
    model = SimpleNamespace(cameras={}, experiment=SimpleNamespace(path=SimpleNamespace(channels=[])))
    loops = {"tilt": SimpleNamespace(ends=(), cycle=SimpleNamespace(steps=1))}
    parts = {"setup": None, "model": model, "loops": loops, "closed": one, "open": deepcopy(one)}
    return SimpleNamespace(**parts | {"ratios": {"angle": 3.9, "height": 4.0}, "ratio_limit": 4.0} | changes)


def test_every_warning_of_a_loop_is_told_when_and_only_when_it_holds() -> None:
    """Ends of ranges, limit cycles, jumps and doubts of either course, and sigmas that errors exceed."""
    assert loop_warnings(quiet_loop()) == ()
    ends, cycle = SimpleNamespace(ends=(1,), cycle=None), SimpleNamespace(ends=(), cycle=SimpleNamespace(steps=2))
    (told,) = loop_warnings(quiet_loop(loops={"tilt": ends}))
    assert "the range of tilt ends: held at 1 of the readings, first at 10 min" in told
    (told,) = loop_warnings(quiet_loop(loops={"tilt": cycle}))
    assert "tilt can go to and fro by 2 steps" in told
    (told,) = loop_warnings(quiet_loop(ratios={"angle": 4.1, "height": 3.0}))
    assert "the posterior's angle is wrong by up to 4.1 of its sigma, limit 4.00" in told
    jump = SimpleNamespace(body="base/M1", labels=["base/M1 x"], sizes=[2.0], sigmas=[0.1], units=["um"], rivals={})
    jump = SimpleNamespace(**vars(jump), after=0.0, until=600.0, log_ratio=50.0)
    doubt = SimpleNamespace(course_doubt=lambda times, spots: f"a doubt at {times[1]}")
    for label in ("closed", "open"):
        for key, value, words in (("jumps", (jump,), "base/M1 jumped"), ("evidence", doubt, "a doubt at 10 min")):
            run = quiet_loop()
            setattr(getattr(run, label).course, key, value)
            (told,) = loop_warnings(run)
            assert told.startswith(f"with the loop {label}"), told
            assert words in told


@pytest.mark.second
def test_heights_of_rendered_line_images_are_those_of_the_cameras(idle: LoopRun) -> None:
    """Orbit and attitude are exact here, so that what is left is the cameras, and the noise of matching."""
    pair, passed = idle.open.images[0], idle.open
    mean, sigma = pair.height
    # the cameras alone move heights by metres; over the swath what they do differs by a few centimetres
    by_cameras = float(passed.heights.camera[pair.moment])
    assert abs(by_cameras) > 0.3
    assert mean == pytest.approx(by_cameras, abs=0.1 + 5.0 * sigma)
    assert np.all(pair.matching < 0.1)
    assert pair.matching == pytest.approx(pair.sigma, rel=0.8)


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
def test_a_mode_that_no_spot_shows_moves_heights_by_the_exact_trace(setup, model, backend) -> None:
    experiment = model.experiment
    angle, first, second = np.zeros(10), np.zeros(10), np.zeros(10)
    angle[[model.row("forward", "d_alpha"), model.row("backward", "d_alpha")]] = 1.0, -1.0
    first[model.row("forward", "defocus")] = second[model.row("backward", "defocus")] = 1.0
    modes = unseen_modes(model.stated, np.stack([angle, first, second]), np.array([ARCSEC, 1e-5, 1e-5]))
    assert len(modes) == 3
    components = experiment.stated.components
    for mode in modes:
        amounts = mode.motions * experiment.stated.sigma
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


BAD = SMALL.replace("gain: 1}\n  roll", "gain: 3}\n  roll").replace(
    "corrections:\n",
    "motion:\n"
    "  base/backward/focal_plane: {rotate: [0 arcsec, 0 arcsec, 60 arcsec], begin: 15 min}\n"
    "corrections:\n"
    "  short: {camera: backward, quantity: d_alpha, mechanism: base/backward rotate y, gain: 0.9, "
    "step: 0.02 arcsec, range: 0.04 arcsec}\n",
)


@pytest.mark.second
def test_what_is_wrong_is_told(tmp_path: Path) -> None:
    """One run whose tilt is unstable, whose other mechanism comes to its end, and in which a body jumps that nobody
    expects to.
    """
    (tmp_path / "bad.yaml").write_text(BAD, "utf-8")
    result = run("loop", tmp_path / "bad.yaml", "--out", tmp_path / "run", "--json")
    assert result.exit_code == 0, result.output
    told = " ".join((tmp_path / "run" / "report.html").read_text("utf-8").split())
    numbers = json.loads((tmp_path / "run" / "loop.json").read_text("utf-8"))
    for words in (
        "tilt is unstable by itself",
        "the loops together are unstable",
        "the range of short ends",
        "contradict what is stated to move",
    ):
        assert words in told, words
    assert "The loop is unstable" in told
    assert not numbers["stable"]
    assert not numbers["closed"]["agrees"]
    # each reading turns what is left round and makes it twice as large, by 1 - 3
    tilt = np.array(numbers["corrections"]["tilt"]["positions"])
    steps = np.abs(np.diff(tilt))
    assert np.all(steps[1:] > 1.5 * steps[:-1])
    assert max(map(abs, numbers["corrections"]["short"]["positions"])) == pytest.approx(0.04)
    # the open loop of the same run is that of a loop with gains below the limit
    assert numbers["open"]["height_camera_rms_m"] > 0.0


@pytest.mark.second
@pytest.mark.parametrize(
    ("mechanism", "words"),
    [
        ("base/forward/M9 rotate y", ("no such node",)),
        ("base/forward rotate y about rear_node", ("no such pivot",)),
        ("base/backward rotate y", ("does nothing to d_alpha of forward",)),
    ],
)
def test_a_mechanism_that_cannot_be_is_refused(tmp_path: Path, mechanism: str, words: tuple[str, ...]) -> None:
    file = tmp_path / "idle.yaml"
    file.write_text(SMALL.replace("base/forward rotate y", mechanism), "utf-8")
    refused(run, "loop", file, "corrections.tilt.mechanism", words)
