"""A course of temperatures: the same as single renders of its states, whole in the run folder, or not there at all."""

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import twin.render as command
from optics.thermal.heat import Temperature
from scenes.specs.course import moment
from scenes.specs.job import checked_nodes
from scenes.specs.load import load_job
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from tests.tiers import quick
from tests.twin.commands import invoke
from tests.twin.study_bench import REFUSED
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import TimeSeries, _warnings, run_series, series_states

run = partial(invoke, command.app)
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


# --- what is refused --------------------------------------------------------------------------------------------------

COURSE = "instrument: gf7_pair\ncourse:\n  times: [0 min, 1 min]\n  temperature:\n"
NODE = "    base/forward: "
MANY = COURSE.replace("0 min, 1 min", ", ".join(f"{k} s" for k in range(1001))) + NODE + "{change: [0 K]}"
BAD = REFUSED["courses"] | {"many": (MANY, 3, ["course.times", "1001 of them"])}


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
    """Also when it is not the time that is shown in full; and at which a spot is too near the edge of its CCD."""
    gradients = "[[0 K/m, 0 K/m, 0 K/m], [0 K/m, 30 K/m, 0 K/m], [0 K/m, 0 K/m, 0 K/m]]"
    aside = COURSE.replace("temperature", "motion")
    aside += "    base/forward/focal_plane: {shift: [0 0 0 um, 270 0 0 um, 0 0 0 um]}"
    for text, reason in (
        (COURSE + f"    {LEFT}: {{gradient: {gradients}}}", ""),
        (aside, r"the spot forward/left cannot be measured \("),
    ):
        resolved = resolve(written(tmp_path, text.replace("1 min", "1 min, 2 min"))).with_render(1, 1)
        with pytest.raises(InputError, match=f"at 1 min of the course cannot be rendered: {reason}"):
            run_series(prepared, resolved, series_states(prepared, resolved.job))


def test_what_is_wrong_with_a_course_is_told_at_its_first_time(prepared) -> None:
    course, saturated, share = SimpleNamespace(times=(0.0, 60.0, 120.0)), np.zeros((3, 4), bool), np.ones((3, 4))
    assert _warnings(prepared, course, saturated, share) == ()
    saturated[1:, 0], share[2, 3] = True, 0.49
    full, dim = _warnings(prepared, course, saturated, share)
    assert "saturated pixels in the spot forward/left at 2 times, first at 1 min" in full
    assert "backward/right at 2 min: only 49% of the nominal light" in dim
    bent = SimpleNamespace(holds=np.array([True, True, False]), beyond=np.array([False, True, True]))
    evidence = SimpleNamespace(course_doubt=lambda times, spots: f"{spots[0]} at {times[1]}")
    parts = {"smoothed": None, "times": np.array(course.times), "curvature": {"model": bent}, "evidence": evidence}
    first, lost, again = TimeSeries.doubts(SimpleNamespace(**parts), ["a"])
    assert first == "course a at 1 min"
    assert "σ does not hold at 1 times, first at 2 min: the motions that the model reads" in lost
    assert "at 1 times, first at 1 min, the motions that the model reads are not small" in again
