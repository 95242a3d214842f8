"""A course of temperatures: the same as single renders of its states, whole in the run folder, or not there at all."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr

import twin.render as command
from analysis.units import ARCSEC
from optics.thermal.heat import Temperature
from scenes.specs.course import moment
from scenes.specs.job import checked_nodes
from scenes.specs.load import load_job
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from tests.tiers import quick
from tests.twin.commands import invoke
from twin.main_job.monitor_reading import stated
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import Observing, observe, one_detector
from twin.monitor.time_series import run_series, series_states
from twin.monitor.truth import trace_truth

run = partial(invoke, command.app)
ROOT = Path(__file__).resolve().parents[2]
LEFT = "base/forward/monitor/left/prism_180"
JOB = f"""instrument: gf7_pair
perturb:
  base/backward/focal_plane: {{rotate: [2 arcsec, -1.5 arcsec, 10 arcsec], pivot: rear_node}}
  {LEFT}: {{temperature: 0.5 K}}
course:
  times: [0 min, 12 min, 0.5 h]
  detail: 12 min
  temperature:
    base/forward: {{change: [0 K, 0.1 K, -0.2 K]}}
    {LEFT}:
      change: [0 K, 0.1 K, 0.2 K]
      gradient: [[0 K/m, 0 K/m, 0 K/m], [0 K/m, 10 mK/m, 0 K/m], [0 K/m, 20 mK/m, 0 K/m]]
render: {{frames: 2, seed: 7}}
"""


def written(folder: Path, text: str = JOB) -> Path:
    path = folder / "job.yaml"
    path.write_text(text, "utf-8")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A run of the command."""
    place = tmp_path_factory.mktemp("course")
    result = run(written(place), "--out", place / "run", "--json")
    assert result.exit_code == 0, result.stderr
    return place / "run"


@pytest.fixture(scope="module")
def prepared(experiment) -> MonitorExperiment:
    """The experiment of the run."""
    return experiment("gf7_pair")


@pytest.fixture(scope="module")
def found(folder) -> dict:
    return json.loads((folder / "course.json").read_text())


# --- what a course means ----------------------------------------------------------------------------------------------


def test_temperatures_of_a_time_add_to_the_perturbation(tmp_path) -> None:
    job = load_job(written(tmp_path))
    assert job.course is not None
    assert job.course.times == (0.0, 720.0, 1800.0)
    assert job.course.shown == 1
    assert job.fields() == {LEFT: Temperature(0.5)}
    assert job.fields(2) == {LEFT: Temperature(0.7, (0.0, 0.02, 0.0)), "base/forward": Temperature(-0.2)}
    assert [moment(t) for t in job.course.times] == ["0 min", "12 min", "30 min"]


@pytest.mark.second
def test_a_course_is_its_states_one_by_one(folder, found, prepared, tmp_path) -> None:
    """Truth, images and readings, bit for bit, from jobs that each describe the state of one time."""
    experiment, states = prepared, []
    for k in range(3):
        own = f"{{temperature: {{change: {(0.5, 0.6, 0.7)[k]} K, gradient: [0 K/m, {10 * k} mK/m, 0 K/m]}}}}"
        text = JOB[: JOB.index("course:")].replace("{temperature: 0.5 K}", own)
        text += f"  base/forward: {{temperature: {(0.0, 0.1, -0.2)[k]} K}}\n"
        states.append(experiment.state(load_job(written(tmp_path, text))))
    truth = trace_truth(experiment.instrument, experiment.backend, states)
    photons = experiment.path.expected_photons(states)
    after = experiment.frames_after(photons, 2, 7)
    recovery = next(observe(experiment, states, Observing(one_detector(experiment, 2, 7)))).recovery
    with xr.open_dataset(folder / "course.nc", engine="h5netcdf", decode_timedelta=False) as data:
        assert data.photons.dims == ("time", "channel", "row", "column")
        assert list(data.time.values) == [0.0, 720.0, 1800.0]
        assert data.time.attrs["units"] == "s"
        np.testing.assert_array_equal(data.photons.values, photons.astype(np.float32))
    for i, channel in enumerate(experiment.path.channels):
        image = tifffile.imread(folder / f"images/{channel.camera}_{channel.name}_course.tiff")
        assert image.dtype == np.uint16
        np.testing.assert_array_equal(image, after[:, i, 0])
    for name, change in truth.cameras.items():
        true = found["cameras"][name]["true"]
        np.testing.assert_allclose(true["d_alpha_arcsec"], np.degrees(change.d_alpha) * 3600, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(true["d_f_um"], 1e6 * change.d_f, rtol=1e-12, atol=1e-12)
        for estimator, p in recovery.parameters[name].items():
            for key, value in p.to_dict().items():
                np.testing.assert_array_equal(found["cameras"][name][estimator][key], value)
    for estimator, angle in recovery.angle.items():
        told = (angle.change_rad, angle.sigma_rad, angle.noise_rad)
        assert list(found["intersection_angle"][estimator].values()) == [(one / ARCSEC).tolist() for one in told]
    assert "posterior" in recovery.angle
    for estimator, ground in recovery.ground.items():
        assert found["ground"][estimator]["height_m_sigma"] == ground.sigma_m[:, 2].tolist()
        assert found["ground"][estimator]["left_plan_rms_m"] == ground.plan_rms_m.tolist()
    true = np.array([found["ground"]["true"][f"{axis}_m"] for axis in ("along", "across", "height")]).T
    np.testing.assert_allclose(true, truth.ground_error(experiment.ground), atol=1e-9)


@pytest.mark.second
def test_filter_and_smoother_stand_beside_the_readings(found, tmp_path) -> None:
    """The first time knows its own measurement alone, which is the posterior; the last knows all, filtered or smoothed.
    The prisms' half kelvin of this job is seven times what `orbit` states; chi-square says so."""
    groups = [*found["cameras"].values(), found["intersection_angle"], found["ground"]]
    for group in groups:
        for key, first in group["filtered"].items():
            # the pattern's covariance is kept in single precision
            assert first[0] == pytest.approx(group["posterior"][key][0], rel=1e-5, abs=1e-9)
            if not key.startswith("left"):
                assert group["smoothed"][key][-1] == pytest.approx(first[-1], rel=1e-9)
        for key, late in group["smoothed"].items():
            if key.endswith("_sigma"):
                assert np.all(np.array(late) <= np.array(group["filtered"][key]) * (1.0 + 1e-9))
                assert np.all(np.array(late) >= np.array(group["smoothed"][f"{key}_noise"]))
    between = found["between"]
    assert between["times_s"] == pytest.approx(
        [90.0 * k for k in range(1, 8)] + [720.0 + 135.0 * k for k in range(1, 8)]
    )
    for name, camera in between["cameras"].items():
        assert set(camera) == {"filtered", "smoothed"}
        sigma = np.array(camera["smoothed"]["d_alpha_arcsec_sigma"])
        ends = np.array(found["cameras"][name]["smoothed"]["d_alpha_arcsec_sigma"])
        assert np.all(sigma[:7] > ends[:2].min())
        assert sigma[7:].max() > sigma[:7].max()  # 18 min leave more open than 12
    assert set(between) == {"times_s", "cameras", "intersection_angle", "ground"}
    told = found["disturbances"]
    assert told["name"] == "orbit"
    assert told["degrees_of_freedom"] == 3 * 8
    assert sum(told["innovations"]["chi_square"]) == pytest.approx(told["chi_square"])
    assert not told["agrees"]
    assert told["chi_square"] > told["limit"]


@pytest.mark.second
def test_without_disturbances_nothing_is_smoothed(tmp_path, backend) -> None:
    resolved = resolve(written(tmp_path, JOB.replace("course:", "disturbances: none\ncourse:")))
    experiment = MonitorExperiment(resolved, backend)
    series = run_series(experiment, resolved, series_states(experiment, resolved.job))
    assert series.smoothed is None
    told = series.to_dict()
    assert "disturbances" not in told
    assert "between" not in told
    assert "smoothed" not in told["cameras"]["forward"]
    assert "model" in told["ground"]


@pytest.mark.second
def test_the_time_in_detail_is_what_the_rest_of_the_run_shows(folder, found) -> None:
    recovered = json.loads((folder / "recovered.json").read_text())
    truth = json.loads((folder / "truth.json").read_text())
    for name, camera in found["cameras"].items():
        for key, values in camera["true"].items():
            assert values[1] == pytest.approx(truth["cameras"][name][key], abs=1e-8)
        for estimator, values in recovered["cameras"][name].items():
            # recovered.json has the digits that a sigma lets one state, the series all of them
            at_the_time = stated({key: camera[estimator][key][1] for key in values})
            for key, value in values.items():
                assert at_the_time[key] == pytest.approx(value, rel=1e-6, abs=1e-9)
    angle = found["intersection_angle"]
    assert angle["true"]["change_arcsec"][1] == pytest.approx(truth["intersection_angle"]["change_arcsec"], abs=1e-8)
    single = tifffile.imread(folder / "images/forward_left_after.tiff")
    np.testing.assert_array_equal(tifffile.imread(folder / "images/forward_left_course.tiff")[1], single[0])


def test_small_temperatures_act_linearly(prepared) -> None:
    """Spots of doubled and of summed temperatures, to second order."""
    one = {LEFT: Temperature(0.1, (0.0, 0.01, 0.02)), "base/forward": Temperature(0.2)}
    other = {"base/backward": Temperature(-0.3, (0.0, 0.0, 0.0))}
    double = {path: field + field for path, field in one.items()}
    states = [{}, *(prepared.thermal.state(fields) for fields in (one, double, other, one | other))]
    rays = prepared.path.coarse.rays(states)
    share = prepared.path.coarse.nodes.share
    spots = np.einsum("n,bnk->bk", share, rays.position[..., :2]).reshape(4, len(states), 2) / prepared.path.pitch
    moved = spots[:, 1:] - spots[:, :1]
    assert np.abs(moved[:, 0]).max() > 0.05
    # dn/dT itself changes by 1e-3 of its size per kelvin
    np.testing.assert_allclose(moved[:, 1], 2.0 * moved[:, 0], rtol=4e-4, atol=2e-6)
    np.testing.assert_allclose(moved[:, 3], moved[:, 0] + moved[:, 2], rtol=1e-5, atol=2e-6)


@pytest.mark.second
def test_the_series_does_not_depend_on_its_pieces(folder, prepared, monkeypatch) -> None:
    resolved, experiment = resolve(folder / "config.yaml"), prepared
    states = series_states(experiment, resolved.job)
    done: list[int] = []
    monkeypatch.setattr("twin.monitor.monitor_memory.CHUNK", 2)
    pieces = run_series(experiment, resolved, states, done.append)
    assert done == [0, 2, 3]
    whole = json.loads((folder / "course.json").read_text())
    for name, camera in pieces.to_dict()["cameras"].items():
        for which, values in camera.items():
            for key, numbers in values.items():
                np.testing.assert_allclose(numbers, whole["cameras"][name][which][key], rtol=1e-6, atol=1e-8)
    monkeypatch.setattr("twin.monitor.time_series.LARGEST_SERIES", 50_000)
    with pytest.raises(InputError, match="do not fit into memory; found '3 times', allowed: at most 1 "):
        run_series(experiment, resolved, states)


@pytest.mark.second
def test_config_holds_the_course(folder) -> None:
    again, first = resolve(folder / "config.yaml"), resolve(folder.parent / "job.yaml")
    assert again == first
    assert again.to_yaml() == (folder / "config.yaml").read_text()


# --- what is refused --------------------------------------------------------------------------------------------------

COURSE = "instrument: gf7_pair\ncourse:\n  times: [0 min, 1 min]\n  temperature:\n"
NODE = "    base/forward: "
MOTIONS = COURSE.replace("temperature", "motion") + "    base/forward/M2: "
BAD = {
    "lengths": (COURSE + NODE + "{change: [0 K, 1 K, 2 K]}", 5, ("base/forward.change", "3 entries", "2, as many")),
    "gradient": (COURSE + NODE + "{gradient: [[0 K/m, 0 K/m, 0 K/m]]}", 5, ("gradient", "1 entries")),
    "vector": (COURSE + NODE + "{gradient: [[0 K/m, 0 K/m], [0 K/m, 0 K/m]]}", 5, ("gradient[0]", "not a list of 3")),
    "order": (COURSE.replace("1 min", "0 s") + NODE + "{change: [0 K, 1 K]}", 3, ("times[1]", "do not ascend")),
    "one": (COURSE.replace(", 1 min", "") + NODE + "{change: [0 K]}", 3, ("course.times", "2 to 1000 times")),
    "many": (
        COURSE.replace("0 min, 1 min", ", ".join(f"{k} s" for k in range(1001))) + NODE + "{change: [0 K]}",
        3,
        ("course.times", "1001 of them"),
    ),
    "unit": (
        COURSE.replace("1 min", "1") + NODE + "{change: [0 K, 1 K]}",
        3,
        ("times[1]", "without a unit", "'12 min'"),
    ),
    "kind": (COURSE + NODE + "{change: [0 K, 1 deg]}", 5, ("change[1]", "unit of an angle")),
    "key": (COURSE + NODE + "{chnge: [0 K, 1 K]}", 5, ("unknown key", "did you mean 'change'?")),
    "word": (COURSE.replace("times", "time") + NODE + "{change: [0 K, 1 K]}", 3, ("did you mean 'times'?",)),
    "times": (COURSE.replace("  times: [0 min, 1 min]\n", "") + NODE + "{change: [0 K]}", 2, ("'times' is missing",)),
    "motions": (MOTIONS + "{shift: [0 0 1 um]}", 5, ("motion.base/forward/M2.shift", "1 entries", "2, as many")),
    "no motion": (MOTIONS + "{pivot: centre}", 5, ("motion.base/forward/M2", "rotate, shift or scale")),
    "pivot": (MOTIONS + "{shift: [0 0 0 um, 0 0 1 um], pivot: center}", 5, ("no such pivot", "did you mean 'centre'")),
    "moved": (
        COURSE.replace("temperature", "motion") + "    base: {shift: [0 0 0 um, 0 0 1 um]}",
        5,
        ("not allow shift",),
    ),
    "far": (MOTIONS + "{shift: [0 0 0 um, 0 0 30 mm]}", 4, ("at 1 min of the course", "motions of base/forward/M2")),
    "nothing": (COURSE, 4, ("course.temperature", "nothing changes")),
    "empty": (COURSE + NODE + "{}", 5, ("course.temperature.base/forward", "change or gradient")),
    "detail": (COURSE + NODE + "{change: [0 K, 1 K]}\n  detail: 50 s", 6, ("course.detail", "did you mean '1 min'?")),
    "node": (COURSE + "    base/forwards: {change: [0 K, 1 K]}", 5, ("no such node", "did you mean 'base/forward'?")),
    "face": (COURSE + f"    {LEFT}/mirror: {{change: [0 K, 1 K]}}", 5, ("does not allow temperature",)),
    "cold": (COURSE + NODE + "{change: [0 K, -300 K]}", 5, ("change[1]", "-6.85 K", "at 1 min", "absolute zero")),
}


@pytest.mark.parametrize("case", quick(5, BAD))
def test_a_bad_course_is_explained_and_leaves_nothing(case: str, tmp_path) -> None:
    text, line, words = BAD[case]
    job = written(tmp_path, text)
    result = run(job, "--out", tmp_path / "new/run", "--frames", 1)
    assert result.exit_code == 2, result.stdout + result.stderr
    assert result.stdout == ""
    assert f"{job}:{line}: course" in result.stderr
    for word in words:
        assert word in result.stderr
    assert "Traceback" not in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["job.yaml"]


def test_the_cold_of_the_perturbation_is_told_there(prepared, tmp_path) -> None:
    text = COURSE + NODE + "{change: [0 K, 1 K]}\nperturb:\n  base/backward: {temperature: -294 K}"
    job = load_job(written(tmp_path, text))
    checked_nodes(job, prepared.instrument.nodes)
    with pytest.raises(InputError, match=r"base/backward would be at -0\.85 K.* at 0 min") as caught:
        series_states(prepared, job)
    assert caught.value.line == 7


def test_a_time_at_which_the_light_is_lost_is_named(prepared, tmp_path) -> None:
    """Also when it is not the time that is shown in full."""
    gradients = "[[0 K/m, 0 K/m, 0 K/m], [0 K/m, 30 K/m, 0 K/m], [0 K/m, 0 K/m, 0 K/m]]"
    text = COURSE.replace("1 min", "1 min, 2 min") + f"    {LEFT}: {{gradient: {gradients}}}"
    resolved = resolve(written(tmp_path, text)).with_render(1, 1)
    with pytest.raises(InputError, match="at 1 min of the course cannot be rendered"):
        run_series(prepared, resolved, series_states(prepared, resolved.job))


@pytest.mark.second
def test_an_interrupt_leaves_nothing(tmp_path) -> None:
    """Ctrl-C while the times are under way."""
    steps = ", ".join(f"{k} s" for k in range(300))
    warm = ", ".join(["1 K"] * 300)
    job = written(tmp_path, COURSE.replace("0 min, 1 min", steps) + NODE + f"{{change: [{warm}]}}")
    code = (
        "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "runpy.run_module('twin.render', run_name='__main__', alter_sys=True)"
    )
    arguments = [sys.executable, "-c", code, str(job), "--out", str(tmp_path / "new/run"), "--quiet"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(arguments, cwd=ROOT, env=environment, start_new_session=True, **pipes)
    try:
        deadline = time.monotonic() + 60
        while not list(tmp_path.glob("new/.run.*.partial")):
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert [path.name for path in tmp_path.iterdir()] == ["job.yaml"]
