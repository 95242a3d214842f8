"""A course of temperatures and motions: as single renders of its states, whole in the run folder or not there."""

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import twin.render as command
from optics.thermal.heat import Temperature
from scenes.models.job_state import motions_of
from scenes.specs.course import moment
from scenes.specs.job import checked_nodes
from scenes.specs.load import load_job
from scenes.specs.resolved import resolve, resolve_job
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
    monkeypatch.setattr("twin.monitor.monitor_experiment.CHUNK", 2)
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
    bent = SimpleNamespace(valid=np.array([True, True, False]), beyond=np.array([False, True, True]))
    evidence = SimpleNamespace(course_doubt=lambda times, spots: f"{spots[0]} at {times[1]}")
    parts = {"smoothed": None, "times": np.array(course.times), "curvature": {"model": bent}, "evidence": evidence}
    first, lost, again = TimeSeries.doubts(SimpleNamespace(**parts), ["a"])
    assert first == "course a at 1 min"
    assert "σ does not hold at 1 times, first at 2 min: the motions estimated by the model" in lost
    assert "at 1 times, first at 1 min, the motions estimated by the model are too large for linear theory" in again


# --- motions of a course, also from a CSV file ------------------------------------------------------------------------


FOCAL, MIRROR, CAMERA = "base/backward/focal_plane", "base/forward/M2", "base/forward"
HEADS = (
    *("time [min]", f"{MIRROR} shift z [um]", f" {FOCAL} rotate x [arcsec] ", f"{FOCAL} rotate z [arcsec]"),
    *(f"{CAMERA} scale [ppm]", f"{CAMERA} temperature [K]"),
)
TABLE = f"""# what the mounts did
{",".join(HEADS)}
0,0,0,0,0,0

12,3,2,10,0.5,0.1
30,-1.5,-1,0.25,0,-0.2
"""
TABLED_JOB = f"""instrument: gf7_pair
course:
  table: motions.csv
  detail: 12 min
  motion: {{{FOCAL}: {{pivot: rear_node}}}}
render: {{frames: 1, seed: 3}}
"""


def tabled(folder: Path, job: str = TABLED_JOB, table: str = TABLE) -> Path:
    (folder / "motions.csv").write_text(table, "utf-8")
    path = folder / "job.yaml"
    path.write_text(job, "utf-8")
    return path


@pytest.fixture(scope="module")
def tabled_experiment(backend, tmp_path_factory) -> MonitorExperiment:
    return MonitorExperiment(resolve(tabled(tmp_path_factory.mktemp("job"))), backend)


@pytest.mark.second
def test_a_table_is_the_same_course_written_out(tmp_path) -> None:
    out = f"""instrument: gf7_pair
course:
  times: [0 min, 12 min, 30 min]
  detail: 12 min
  temperature: {{{CAMERA}: {{change: [0 K, 0.1 K, -0.2 K]}}}}
  motion:
    {MIRROR}: {{shift: [0 0 0 um, 0 0 3 um, [0 um, 0 um, -1500 nm]]}}
    {FOCAL}: {{rotate: [0 0 0 arcsec, 2 0 10 arcsec, -1 0 0.25 arcsec], pivot: rear_node}}
    {CAMERA}: {{scale: [0 ppm, 0.5 ppm, 0 ppm]}}
render: {{frames: 1, seed: 3}}
"""
    table = load_job(tabled(tmp_path))
    assert table == load_job(tabled(tmp_path, out))
    # config.yaml needs the table no longer
    config = tmp_path / "elsewhere" / "config.yaml"
    config.parent.mkdir()
    config.write_text(resolve_job(table).to_yaml(), "utf-8")
    assert resolve(config).job == table


def test_motions_are_added_to_those_under_perturb(tmp_path) -> None:
    fixed = f"  {FOCAL}: {{rotate: [1 arcsec, 0 arcsec, 0 arcsec], shift: 0 1 0 um, pivot: rear_node}}\n"
    fixed += f"  {MIRROR}: {{figure: {{Z5: 20 nm}}, shift: 0 0 1 um}}\n"
    job = load_job(tabled(tmp_path, TABLED_JOB + f"perturb:\n{fixed}"))
    before, after = motions_of(job), motions_of(job, 1)
    arcsec = np.radians(1.0 / 3600.0)
    np.testing.assert_allclose(after[FOCAL].rotate, (3 * arcsec, 0.0, 10 * arcsec), rtol=1e-15)
    assert after[FOCAL].shift == before[FOCAL].shift == (0.0, 1e-6, 0.0)
    assert after[MIRROR].shift == pytest.approx((0.0, 0.0, 4e-6), rel=1e-15)
    assert after[MIRROR].figure == before[MIRROR].figure
    assert motions_of(job, 0)[MIRROR] == before[MIRROR]
    other = fixed.replace("rear_node", "line_centre")
    with pytest.raises(InputError, match=r"differs from that under perturb.*found 'rear_node', allowed: line_centre"):
        load_job(tabled(tmp_path, TABLED_JOB + f"perturb:\n{other}"))


@pytest.mark.second
def test_the_course_tells_its_motions(tabled_experiment, tmp_path) -> None:
    resolved = resolve(tabled(tmp_path))
    found = run_series(tabled_experiment, resolved, series_states(tabled_experiment, resolved.job)).to_dict()
    assert set(found["motions"]) == {MIRROR, FOCAL, CAMERA}
    assert found["motions"][FOCAL]["pivot"] == "rear_node"
    np.testing.assert_allclose(found["motions"][FOCAL]["rotate_arcsec"][1], (2.0, 0.0, 10.0), rtol=1e-14)
    np.testing.assert_allclose(found["motions"][MIRROR]["shift_um"][2], (0.0, 0.0, -1.5), rtol=1e-14)
    np.testing.assert_allclose(found["motions"][CAMERA]["scale_ppm"], (0.0, 0.5, 0.0), rtol=1e-14)
    # what is read in the images follows: a despace of M2 makes the camera longer by some 100 um per 3 um
    true = found["cameras"]["forward"]["true"]["d_f_um"]
    read = found["cameras"]["forward"]["model"]["d_f_um"]
    assert np.ptp(true) > 10.0
    np.testing.assert_allclose(read, true, atol=0.1 * np.ptp(true))


@pytest.mark.parametrize("case", REFUSED["tables_of_motions"])
def test_a_bad_table_is_explained_with_file_and_line(case: str, tmp_path) -> None:
    (old, new), file, line, words = REFUSED["tables_of_motions"][case]
    assert old in TABLE
    job = {
        "file": TABLED_JOB.replace("motions.csv", "none.csv"),
        "both": TABLED_JOB.replace("  detail: 12 min", "  times: [0 min, 1 min]"),
        "pivot": TABLED_JOB.replace(FOCAL, f"{MIRROR}x"),
    }.get(case, TABLED_JOB)
    path = tabled(tmp_path, job, TABLE.replace(old, new, 1) if old else TABLE)
    done = run(path, "--out", tmp_path / "run", "--frames", 1)
    assert (done.exit_code, done.stdout) == (2, ""), done.stderr
    assert f"{path.parent / file}:{line}: " in done.stderr
    for word in words:
        assert word in done.stderr
    assert not (tmp_path / "run").exists()
