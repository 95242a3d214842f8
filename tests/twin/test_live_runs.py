"""Run folders in the live twin: what was saved is what is shown, and what cannot be shown says so with a remedy."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import twin
import twin.live.__main__ as command
from scenes.models.monitor_layout import MonitorDesignSetup
from scenes.specs.load import EXAMPLES, SCENES
from scenes.specs.monitor_frames import MeasurementSetup
from scenes.specs.orbit.setup import AngleSetup, MonitorSetup
from scenes.specs.resolved import TurntableSetup, resolve, resolve_camera
from scenes.yaml.errors import InputError
from tests.twin.study_bench import REFUSED
from twin.framework.run_folder import RunFolder, write_manifest
from twin.live.camera_design import _with_targets
from twin.live.computer import job_text
from twin.live.live_bench import LiveBench
from twin.live.messages import MOST_FRAMES, AskedState
from twin.live.source import Source, read_source
from twin.main_job.monitor_reading import rounded
from twin.main_job.render_files import config_text
from twin.main_job.render_job import render_job
from twin.orbit.monitoring.monitor_series import states_of
from twin.scripting.instrument_twin import InstrumentTwin
from twin.study.runs.base_job import with_values
from twin.study.runs.plan import Plan
from twin.study.runs.render_base import read_job
from twin.study.runs.setup import resolve_study

ROOT = Path(__file__).resolve().parents[2]
JOB = """instrument: gf7_pair
perturb:
  base/forward/M2: {shift: [0 um, 1 um, 3 um], figure: {Z7: 4 nm}}
  base/backward/focal_plane: {rotate: [2 arcsec, -1.5 arcsec, 10 arcsec], pivot: rear_node}
  base/central_prism: {temperature: {change: 0.1 K, gradient: [0 K/m, 0 K/m, 30 mK/m]}}
disturbances: launch
render: {frames: 2, seed: 1}
"""
STUDY = """name: choices
base: {command: render, file: job.yaml}
factors:
  despace: {key: [job, perturb, base/forward/M2, shift, 2], normal: {mean: 0 um, sigma: 2 um}}
  light: {scales: [{key: [instrument, monitor, reticle, photons_per_frame], power: 2}], uniform: [0.5, 2]}
  aperture:
    key: [instrument, monitor, return_face, aperture]
    uniform: [3 cm, 5 cm]
    scales: [{key: [instrument, monitor, reticle, photons_per_frame], power: 2}]
  frames: {key: [job, render, frames], values: [1, 4]}
  centroid: {key: [job, analysis, centroid], values: [ml, gaussian]}
design: {kind: monte_carlo, runs: 8, seed: 5}
responses: {df: {key: [recovered, cameras, forward, model, d_f_um]}}
"""


@pytest.fixture(scope="module")
def pair() -> InstrumentTwin:
    return twin.load("gf7_pair")


def bench_of(source: Source, pair: InstrumentTwin) -> LiveBench:
    return LiveBench(InstrumentTwin.of(source.resolved, like=pair))


def written(folder: Path, text: str, name: str = "job.yaml") -> Path:
    file = folder / name
    file.write_text(text, "utf-8")
    return file


def run_folder(place: Path, program: str, config: str | None, test: str = "", **files: str) -> Path:
    """A run folder as the commands make them, with a report that says nothing."""
    with RunFolder(place) as folder:
        if config is not None:
            folder.write_text("config.yaml", config)
        folder.write_text("report.html", "<p>report</p>")
        for name, text in files.items():
            folder.write_text(f"artefacts/{name}.yaml", text)
        write_manifest(folder, program, 0.0, 1.0, test=test)
    return place


def told(*arguments: object) -> tuple[int, str]:
    """Exit code of the command and what it says on stderr, in one line."""
    result = CliRunner().invoke(command.app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, " ".join(result.stderr.split())


# --- what was saved ---------------------------------------------------------------------------------------------------


@pytest.mark.second
def test_a_run_opens_in_the_state_that_was_saved(pair, backend, tmp_path, monkeypatch):
    """State, seed and number of frames, the command's own --frames and --seed among them; all frames and readings to
    the bit, however the folder is named.
    """
    own = InstrumentTwin.of(resolve(written(tmp_path, JOB)), like=pair).experiment
    run = render_job(resolve(tmp_path / "job.yaml"), backend, 3, 11, experiment=own)
    folder = run_folder(tmp_path / "run", "twin.render", config_text(run.resolved))
    monkeypatch.chdir(tmp_path)
    for name in (folder, folder / "config.yaml", "run", "run/", "./run/config.yaml"):
        source = read_source(str(name))
        assert source.resolved == resolve(folder / "config.yaml")
        assert source.notes == ()
        assert (source.name, source.about) == ("run", "run: a job of the monitor")
    bench = bench_of(source, pair)
    assert (bench.initial_state.frames, bench.initial_state.seed, bench.initial_state.time) == (3, 11, None)
    shown, after = bench.state(bench.initial_state)
    assert shown["readings"] == rounded(run.recovered_dict())
    assert shown["truth"] == run.truth_dict()
    assert np.array_equal(after, run.after[:, 0])
    assert np.array_equal(bench.before(bench.initial_state), run.before[:, 0])


def test_what_was_changed_after_the_run_is_told(tmp_path):
    text = resolve(written(tmp_path, JOB)).to_yaml()
    folder = run_folder(tmp_path / "run", "twin.render", text)
    assert text.count("seed: 1\n") == 1
    (folder / "config.yaml").write_text(text.replace("seed: 1\n", "seed: 2\n"), "utf-8")
    source = read_source(str(folder))
    assert source.resolved.job.render.seed == 2
    assert "was changed after the run" in source.notes[0]


def test_a_page_takes_so_many_frames_and_says_so(pair, tmp_path):
    many = JOB.replace("frames: 2", f"frames: {MOST_FRAMES + 1}")
    source = read_source(str(written(tmp_path, many)))
    assert source.notes == (f"the page uses {MOST_FRAMES} frames instead of {MOST_FRAMES + 1}",)
    assert bench_of(source, pair).initial_state.frames == MOST_FRAMES
    assert read_source(str(written(tmp_path, JOB.replace("frames: 2", f"frames: {MOST_FRAMES}")))).notes == ()


@pytest.mark.second
def test_a_seed_of_63_bits_is_known_by_its_last_ones(pair, tmp_path):
    """A number in JSON holds 53; the saved job has all."""
    seed = 2**62 + 2**55 + 12345
    bench = bench_of(read_source(str(written(tmp_path, JOB.replace("seed: 1", f"seed: {seed}")))), pair)
    asked = AskedState(**json.loads(bench.initial_state.model_dump_json()))
    assert (asked.seed, bench.greeting()["seed"]) == (12345, 12345)
    other = AskedState(**{**asked.model_dump(), "seed": 12346})
    for one, wanted in ((asked, seed), (other, 12346)):
        assert resolve(written(tmp_path, job_text(bench, one), "saved.yaml")).job.render.seed == wanted


def test_a_server_that_cannot_be_is_told(monkeypatch):
    server = pytest.importorskip("twin.live.server", reason="the extra `live` is not installed")
    with server.listen("127.0.0.1", 0) as taken:
        taken.listen()
        port = taken.getsockname()[1]
        code, said = told("gf7_pair", "--port", port)
    assert (code, f"cannot listen on 127.0.0.1:{port}: Address already in use" in said) == (2, True), said
    monkeypatch.setenv(command.TOKEN, "short")
    assert "TWIN_LIVE_TOKEN needs 22 or more" in told("gf7_pair")[1]
    monkeypatch.setitem(sys.modules, "twin.live.server", None)
    assert "bash setup.sh`" in told("gf7_pair")[1]


def test_a_folder_does_not_hide_an_instrument_of_the_library(tmp_path, monkeypatch):
    (tmp_path / "gf7_pair").mkdir()
    monkeypatch.chdir(tmp_path)
    assert read_source("gf7_pair").resolved.instrument.name == "gf7_pair"


# --- run folders of other commands ------------------------------------------------------------------------------------


def frames_beside(folder: Path) -> Path:
    """A measurement's file with its frames, which nobody reads here."""
    (folder / "frames").mkdir()
    for channel in ("forward_left", "forward_right", "backward_left", "backward_right"):
        for when in ("before", "after"):
            (folder / "frames" / f"{channel}_{when}.tiff").write_bytes(b"")
    text = "instrument: gf7_pair\nframes: frames\ndisturbances: launch\nexposure: 20 ms\n"
    return written(folder, text, "measurement.yaml")


def test_a_run_of_a_study_that_cannot_be_built_names_the_factor(tmp_path, monkeypatch):
    written(tmp_path, JOB)
    file = str(written(tmp_path, STUDY, "study.yaml"))
    assert "despace" in read_source(file, 0).scalars
    place = ("job", "perturb", "base/forward/M2", "shift", 2)
    too_far = [(place, "9 parsec")]
    monkeypatch.setattr("twin.live.source.base_with_factors", lambda setup, scalars: with_values(setup.base, too_far))
    with pytest.raises(InputError, match=r"study\.yaml:4: factors\.despace.*(at job\.perturb.*of the base)"):
        read_source(file, 0)


def test_targets_are_imaged_by_cameras_with_line_ccds():
    assert _with_targets(read_source("gf7_pair").resolved).line_detectors
    with pytest.raises(ValueError, match=r"no targets can be imaged: .*this camera has no bands"):
        _with_targets(read_source("cassegrain").resolved)


def test_a_measurement_opens_its_instrument_as_designed(tmp_path):
    """With its exposure and what it states to move, also when the frames are no longer where they were."""
    file = frames_beside(tmp_path)
    setup = MeasurementSetup.read(file)
    folder = run_folder(tmp_path / "run", "twin.recover", setup.to_yaml(), "recovered")
    for frame in (tmp_path / "frames").iterdir():
        frame.unlink()
    for name in (folder, folder / "config.yaml"):
        source = read_source(str(name))
        assert source.resolved == setup.model
        assert "the measured frames are not shown" in source.notes[0]
    assert source.resolved.instrument.monitor.area_ccd.exposure == pytest.approx(0.02)
    assert source.resolved.disturbances is not None
    assert source.resolved.disturbances.name == "launch"
    assert not source.resolved.job.perturb
    with pytest.raises(InputError, match="no frames of forward/left"):
        read_source(str(file))


def test_a_measurement_without_an_instrument(tmp_path):
    """One that gives the cameras' geometry alone has nothing to be shown."""
    file = frames_beside(tmp_path)
    geometry = "{principal_distance: 5.5 m, separation: 0.24 m, pitch: 12 um}"
    text = file.read_text().replace(
        "instrument: gf7_pair\n", f"geometry: {{forward: {geometry}, backward: {geometry}}}\ntemplate: measured\n"
    )
    text = text.replace("disturbances: launch\n", "detector: monitor_ccd\n")
    config = MeasurementSetup.read(written(tmp_path, text, "measurement.yaml")).to_yaml()
    code, said = told(run_folder(tmp_path / "run", "twin.recover", config, "recovered"))
    assert code == 2
    assert "geometry of the cameras alone" in said


@pytest.mark.second
def test_a_run_of_uncertainty_opens_its_job(tmp_path):
    resolved = resolve(written(tmp_path, JOB))
    folder = run_folder(tmp_path / "run", "twin.uncertainty", resolved.to_yaml(), "uncertainty")
    assert read_source(str(folder)).resolved == resolve(folder / "config.yaml")


@pytest.mark.second
def test_an_orbit_of_drawn_motions_is_no_course():
    with pytest.raises(InputError, match="it has no course to show"):
        read_source(str(SCENES / "orbit" / "loop.yaml"))


def test_a_monitored_orbit_is_a_course_with_the_motions_of_its_mounts(pair, tmp_path):
    """States of the test itself: temperatures, swings and ramps; poses to rounding."""
    setup = MonitorSetup.read(SCENES / "orbit" / "monitor.yaml")
    folder = run_folder(tmp_path / "run", "twin.orbit", setup.to_yaml(), "monitor")
    bench = bench_of(read_source(str(folder)), pair)
    numbers = [0, 9, 14]
    expected = states_of(bench.twin.experiment, setup.test, numbers)
    assembly = bench.twin.experiment.instrument.assembly
    moved = "base/backward/focal_plane"
    for k, state in zip(numbers, expected, strict=True):
        shown = bench.states(AskedState(**{**bench.initial_state.model_dump(), "time": k}))
        assert set(shown) == set(state)
        one, two = assembly.place([shown]), assembly.place([state])
        for path in state:
            assert np.asarray(one.pose(path).translation) == pytest.approx(two.pose(path).translation, abs=1e-15)
            assert np.asarray(one.pose(path).rotation) == pytest.approx(two.pose(path).rotation, abs=1e-15)
            assert shown[path].figure == state[path].figure
        # the settling begins at 40 min; heat turns the body by some nanoradians at all times
        assert (max(map(abs, shown[moved].rotate)) > 1e-7) == (k > 8)


# --- studies ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def studied(tmp_path_factory) -> Path:
    """A study's folder, as it is from the study's beginning."""
    place = tmp_path_factory.mktemp("study")
    written(place, JOB)
    setup = resolve_study(written(place, STUDY, "study.yaml"))
    return run_folder(place / "run", "twin.study", setup.to_yaml())


def test_a_study_folder_opens_its_base_with_factors_as_knobs(studied):
    source = read_source(str(studied))
    assert source.resolved == read_job(resolve_study(studied / "config.yaml").tree)
    factors = {factor.name: factor for factor in source.factors}
    assert set(factors) == {"despace", "light", "aperture", "frames"}
    assert factors["despace"].knobs == {"base/forward/M2 shift z": 1.0}
    assert (factors["despace"].value, factors["light"].value, factors["aperture"].value) == (3.0, 1.0, 5.0)
    assert "base of the study choices" in source.about
    assert (factors["aperture"].low, factors["aperture"].high) == (3.0, 5.0)
    with pytest.raises(InputError, match="aperture"):
        source.with_factors({"apertur": 4.0})


@pytest.mark.second
@pytest.mark.parametrize("number", range(8))
def test_a_run_of_a_study_opens_as_it_was_run(studied, number):
    """Everything that its factors set, texts and ratios among it, and its seed."""
    setup = resolve_study(studied / "config.yaml")
    plan = Plan.of(setup)
    run = plan.run(number)
    expected = read_job(with_values(setup.tree, run.values))
    assert run.seed is not None
    source = read_source(str(studied), number)
    assert source.resolved == expected.with_render(expected.frames, run.seed)
    assert source.notes == ()
    values = {column.name: column.values[number].item() for column in plan.columns}
    for factor in source.factors:
        assert factor.value == values[factor.name]
        assert factor.low <= factor.value <= factor.high
    assert f"run {number} of the study" in source.about
    # another value of one factor: the others stay those of the run, also what follows them
    light, aperture = values["light"], values["aperture"]
    turned = source.with_factors({"aperture": 4.0})
    assert turned.instrument.monitor.return_face.aperture == pytest.approx(0.04)
    photons = source.resolved.instrument.monitor.reticle.photons_per_frame
    assert photons == pytest.approx(4e6 * light**2 * (aperture / 5.0) ** 2)
    assert turned.instrument.monitor.reticle.photons_per_frame == pytest.approx(4e6 * light**2 * 0.8**2)
    assert turned.job == source.resolved.job


def test_a_run_that_a_study_does_not_have(studied, tmp_path):
    none, other = "no such run; found --run {}, allowed: 0 to 7", "--run chooses a run of a study"
    for what, number, words in ((studied, 8, none), ("gf7_pair", 0, other), (JOB, 0, other)):
        place = written(tmp_path, JOB) if what == JOB else what
        code, said = told(place, "--run", number)
        assert (code, words.format(number) in said) == (2, True), said
    with pytest.raises(InputError, match="no such run"):
        read_source(str(studied), -1)


# --- what cannot be shown ---------------------------------------------------------------------------------------------


DATA = {
    "twin.lab": lambda: TurntableSetup.read(SCENES / "lab/turntable.yaml").to_yaml(),
    "twin.orbit": lambda: AngleSetup.read(SCENES / "orbit/angle_gf7.yaml").to_yaml(),
    "twin.camera": lambda: resolve_camera("gf7_pair", "forward").to_yaml(),
    "twin.compare": lambda: "runs: [a, b]\n",
    "twin.export": lambda: "run: a\n",
    "twin.study": lambda: resolve_study(EXAMPLES / "study_interval.yaml").to_yaml(),
}


@pytest.mark.second
@pytest.mark.parametrize(("program", "test", "words"), REFUSED["shown_runs"])
def test_run_folders_without_a_monitors_state(tmp_path, program, test, words):
    folder = run_folder(tmp_path / "run", program, DATA[program]() if program in DATA else None, test)
    for place in (folder, folder / "config.yaml") if program in DATA else (folder,):
        code, said = told(place)
        assert code == 2
        assert all(word in said for word in (*words.split("|"), "allowed:", str(folder))), said


def test_an_instrument_that_a_design_made_is_named(tmp_path):
    """And opened: it is what the folder has to show."""
    made = (SCENES / "library" / "instruments" / "gf7_pair_two.yaml").read_text("utf-8")
    config = MonitorDesignSetup.read(EXAMPLES / "design_monitor_two.yaml").to_yaml()
    folder = run_folder(tmp_path / "run", "twin.design", config, "layouts", l1=made, notes="a: 1\n")
    code, said = told(folder)
    assert code == 2
    assert f"twin.live {folder / 'artefacts' / 'l1.yaml'} opens an instrument that it made" in said
    assert read_source(str(folder / "artefacts" / "l1.yaml")).resolved.instrument.name == "gf7_pair_two"


def test_folders_that_are_none_of_a_run(tmp_path):
    """A folder of run folders names some of them; an empty one says what may be given."""
    (tmp_path / "runs").mkdir()
    cases = [(tmp_path / "runs", "not a run folder: it has no config.yaml"), (tmp_path / "nowhere", "nowhere")]
    cases += [(SCENES / "lab/focus.yaml", "twin.lab"), (EXAMPLES / "study_interval.yaml", "render")]
    for name in ("b", "a"):
        run_folder(tmp_path / "all" / name, "twin.render", "instrument: gf7_pair\n")
    for place, words in (*cases, (tmp_path / "all", f"{tmp_path / 'all/a'}, {tmp_path / 'all/b'}")):
        code, said = told(place)
        assert (code, words in said) == (2, True), said


@pytest.mark.second
def test_a_manifest_of_somebody_else_changes_nothing(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    written(folder, resolve(written(tmp_path, JOB)).to_yaml(), "config.yaml")
    (folder / "manifest.json").write_text('{"program": "twin.camera", "sha256": 3}')
    assert read_source(str(folder)).resolved == resolve(folder / "config.yaml")
