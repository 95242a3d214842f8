"""``import twin`` gives what the commands give, explains mistakes, and changes nothing behind one's back."""

import json
import os
import re
import subprocess
import sys
import time
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import twin
from analysis.monitor.estimators import ESTIMATORS
from analysis.monitor.monitor_formulas import PARAMETERS
from scenes.specs.job import PerturbationSpec
from scenes.specs.load import LIBRARY
from scenes.specs.perturbation import perturbation_text
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.errors import InputError, Problem
from tests.twin.commands import files, invoke
from tests.twin.study_bench import TEXTS, refusals, without_mtf_and_many_rays
from twin.main_job.monitor_reading import rounded
from twin.monitor.truth import trace_truth
from twin.study import scripted
from twin.study.runs.setup import study_from_text
from twin.study.scripted import config_text, pipe_progress

DESPACE = {"base/forward/M2": {"shift": "0 0 3 um"}}
JOBS = Path(__file__).resolve().parents[1] / "golden/jobs"
TURN = {"base/backward/focal_plane": {"rotate": "2 -1.5 10 arcsec", "pivot": "rear_node"}}


@pytest.fixture(scope="module")
def pair() -> twin.InstrumentTwin:
    return twin.load("gf7_pair", disturbances="launch")


@pytest.fixture(scope="module")
def shot(pair: twin.InstrumentTwin) -> twin.Shot:
    return pair.perturbed(DESPACE).perturbed(TURN).render(frames=9, seed=1)


@pytest.mark.second
@pytest.mark.drawn
def test_it_is_what_the_command_gives(pair: twin.InstrumentTwin, shot: twin.Shot, tmp_path: Path) -> None:
    """The library's example is scenes/examples/perturb.yaml: frames to the byte, readings to what files state."""
    out = tmp_path / "run"
    command = [sys.executable, "-m", "twin.render", "scenes/examples/perturb.yaml", "--out", str(out), "--quiet"]
    subprocess.run(command, check=True)
    import tifffile

    for key in shot.after.channel.values:
        assert np.array_equal(
            tifffile.imread(out / f"images/{key.replace('/', '_')}_after.tiff"), shot.after.sel(channel=key)
        )
    recovered = json.loads((out / "recovered.json").read_text())
    found = pair.recover(shot.before, shot.after)
    assert found.disturbances == recovered["disturbances"]["name"] == "launch"
    for camera in pair.cameras:
        for name in ESTIMATORS:
            parts = {"": found.values, "_sigma": found.sigma, "_sigma_noise": found.sigma_noise}
            one = {"camera": camera, "estimator": name}
            own = {f"{key}{end}": float(v.sel(parameter=key, **one)) for end, v in parts.items() for key in PARAMETERS}
            assert rounded(own) == {key: recovered["cameras"][camera][name][key] for key in own}
    # and the run folder that it saves is the command's
    saved = twin.load("scenes/examples/perturb.yaml").render().save(tmp_path / "saved")
    listed = [json.loads((folder / "manifest.json").read_text())["sha256"] for folder in (out, saved)]
    assert listed[0].keys() == listed[1].keys()
    assert {name for name in listed[0] if listed[0][name] != listed[1][name]} <= {"report.html"}  # it names durations
    assert shot.verdict == recovered["verdict"]
    truth = json.loads((out / "truth.json").read_text())
    for key in PARAMETERS:
        for camera in pair.cameras:
            assert float(shot.truth[key].sel(camera=camera)) == truth["cameras"][camera][key]
    table = found.compare(shot.truth)
    row = table.loc["forward", "d_f_um"]
    assert (row["error"], row["in_sigma"]) == (row["posterior"] - row["true"], row["error"] / row["sigma"])
    for axis in ("along", "across", "height"):
        row, name = table.loc["ground", f"ground_{axis}_m"], f"{axis}_m"
        assert row["true"] == truth["ground"][name]
        own = [recovered["ground"]["posterior"][f"{name}{ending}"] for ending in ("", "_sigma", "_sigma_noise")]
        assert [row["posterior"], row["sigma"], row["sigma_noise"]] == pytest.approx(own, rel=1e-5)
    assert table.loc["both", "angle_change_arcsec"]["true"] == truth["intersection_angle"]["change_arcsec"]


def test_a_file_loads_as_its_perturbations(pair: twin.InstrumentTwin, tmp_path: Path) -> None:
    job = twin.load("scenes/examples/perturb.yaml")
    same = pair.perturbed(TURN).perturbed(DESPACE)
    assert job.perturbations == same.perturbations
    # and back through the file that it writes
    file = tmp_path / "config.yaml"
    file.write_text(same.to_yaml())
    assert twin.load(file).perturbations == same.perturbations
    assert twin.load("scenes/library/instruments/gf7_pair.yaml").resolved.cameras == pair.resolved.cameras


def test_what_a_state_is_does_not_depend_on_how_it_was_said(pair: twin.InstrumentTwin) -> None:
    one, other = pair.perturbed(DESPACE).perturbed(TURN), pair.perturbed({**TURN, **DESPACE})
    listed = pair.perturbed({"base/forward/M2": {"shift": ["0 mm", "0 nm", "0.003 mm"]}}).perturbed(TURN)
    assert one.state == other.state == listed.state
    assert (pair.state, one.experiment) == ({}, pair.experiment)  # the instrument is built once, and stays as it is
    # the text of all perturbations makes them again
    assert pair.perturbed(one.perturbed_by.split("; ")).state == one.state
    assert f"perturbed by {one.perturbed_by}>" in repr(one)


def test_a_further_perturbation_adds_to_those_before(pair: twin.InstrumentTwin) -> None:
    """Component by component, in texts, mappings and lists of them; `with_perturbations` replaces a body's."""
    first = pair.perturbed("forward/M2 shift z 20 um", "base temperature 2 K")
    more = ["forward/M2 shift z 3 um", {"forward/M2": {"rotate": "1 0 0 arcsec", "figure": {"Z5": "10 nm"}}}]
    both = first.perturbed(more).perturbed("forward/M2 figure Z6 5 nm", "base gradient z 1 K/m", "base temperature 1 K")
    assert both.perturbed_by == (
        "base/forward/M2 rotate x 1 arcsec; base/forward/M2 shift z 23 um; base/forward/M2 figure Z5 10 nm; "
        "base/forward/M2 figure Z6 5 nm; base temperature 3 K; base gradient z 1 K/m"
    )
    assert first.perturbed_by == "base/forward/M2 shift z 20 um; base temperature 2 K"
    assert first.with_perturbations({"forward/M2": {"shift": "9 0 0 um"}, "base": {}}).perturbed_by == (
        "base/forward/M2 shift x 9 um"
    )
    # sums that no float has exactly: 3.0999999999999967 arcsec, and 1.7e-21 m where nothing is left
    small = pair.perturbed("forward/M2 rotate x 3 arcsec", "forward/M2 shift x 0.3 um")
    small = small.perturbed("forward/M2 rotate x 0.1 arcsec", "forward/M2 shift x -0.1 um")
    small = small.perturbed("forward/M2 shift x -0.2 um")
    assert small.perturbed_by == "base/forward/M2 rotate x 3.1 arcsec"
    turned = pair.perturbed("forward/focal_plane rotate x 2 arcsec about rear_node")
    assert turned.perturbed("forward/focal_plane shift z 3 um").perturbed_by.startswith(
        "base/forward/focal_plane rotate x 2 arcsec about rear_node; base/forward/focal_plane shift z 3 um"
    )
    for motion, told in (
        ("forward/focal_plane rotate y 1 arcsec", "about another pivot already.*found origin, allowed: rear_node"),
        ({"forward/M2": {}, "base/forward/M2": {}}, "this node is perturbed twice"),
        (3, "perturb: not a perturbation; found 3"),
    ):
        with pytest.raises(twin.InputError, match=told):
            turned.perturbed(motion)


def test_tables_of_nodes_are_kept_but_not_added() -> None:
    bent, moved = ({"deformation": "m2.csv", "temperature": "t.csv"}, {"shift": "0 0 3 um", "temperature": "1 K"})
    first, second = (PerturbationSpec.model_validate(keys) for keys in (bent, moved))
    parts = "base/M2 shift z 3 um; base/M2 temperature t.csv; base/M2 temperature 1 K; base/M2 deformation m2.csv"
    assert perturbation_text({"base/M2": first.plus(second)}) == parts
    with pytest.raises(Problem, match="this body has a table of nodes already"):
        first.plus(first)


@pytest.mark.second
def test_a_camera_is_refocused_and_described_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `python -m twin.camera FILE --refocus` does, of a file that is 50 um out of focus."""
    without_mtf_and_many_rays(monkeypatch)
    text = (LIBRARY / "cameras/gf7_conic.yaml").read_text("utf-8")
    file = tmp_path / "blurred.yaml"
    file.write_text(text.replace("z: -5216.4137 mm", "z: -5216.3637 mm"), "utf-8")
    nominal, blurred = twin.load_camera("gf7_conic"), twin.load_camera(file)
    sharp = blurred.refocused()
    assert blurred.wavefront().rms > 1.5 * sharp.wavefront().rms
    assert sharp.first_order["focal_length_m"] == blurred.first_order["focal_length_m"]
    # the same plane, wherever the search begins
    assert sharp.model.spec.image.z == pytest.approx(nominal.refocused().model.spec.image.z, abs=1e-9)
    plain, command = (twin.perform("camera", file, perturb=["M2 shift z 20 um"], refocus=on) for on in (False, True))
    moved = blurred.perturbed("M2 shift z 20 um")
    assert plain.numbers["first_order"] == moved.first_order
    assert command.run.refocus.errors_before.max() > command.run.errors.max()
    assert command._facts.options == ("--refocus",)  # of the command that repeats the run
    # in another state the focal plane moves, also one that is moved already
    assert "focal_plane shift z" in moved.refocused().twin.perturbed_by
    best = moved.refocused().wavefront().rms
    assert best < 0.5 * moved.wavefront().rms
    again = moved.perturbed("focal_plane shift z 30 um").refocused()
    assert again.wavefront().rms == pytest.approx(best, rel=1e-3)


@pytest.mark.second
def test_recover_takes_channels_by_name_and_refuses_other_frames(pair: twin.InstrumentTwin, shot: twin.Shot) -> None:
    found = pair.recover(shot.before, shot.after)
    turned = pair.recover(
        shot.before.isel(channel=[3, 1, 0, 2]), shot.after.transpose("frame", "row", "column", "channel")
    )
    plain = pair.recover(shot.before.values, shot.after.values)
    assert found.values.equals(turned.values)
    assert found.values.equals(plain.values)
    assert found.covariance.equals(turned.covariance)
    few, cut = shot.before.isel(channel=[1, 2, 3]), shot.after.values[..., :-1]
    for before, after, centroid, words in (
        (few, shot.after, "ml", "no frames of the channels forward/left"),
        (shot.before, cut, "ml", r"after: frames are .* = \(4, frames, 96, 96\), found \(4, 9, 96, 95\)"),
        (shot.before, shot.after, "mean", "no centroid 'mean'"),
    ):
        with pytest.raises(ValueError, match=words):
            pair.recover(before, after, centroid=centroid)


@pytest.mark.second
def test_another_statement_makes_other_sigmas_of_the_same_instrument(pair: twin.InstrumentTwin, shot) -> None:
    """Readings of the formulas and all noise stay; without a statement sigma is the noise's."""
    orbit, alone = pair.with_disturbances("orbit"), pair.with_disturbances("none")
    first, second, none = (one.recover(shot.before, shot.after) for one in (pair, orbit, alone))
    assert [found.disturbances for found in (first, second, none)] == ["launch", "orbit", ""]
    assert orbit.experiment.instrument is pair.experiment.instrument
    formulas = first.values.estimator.values != "posterior"
    assert second.values[:, formulas].equals(first.values[:, formulas])
    assert second.covariance_noise[:, formulas].equals(first.covariance_noise[:, formulas])
    assert not np.any(np.isclose(second.sigma, first.sigma, rtol=1e-3))
    assert none.judged == "model"
    assert "posterior" not in none.values.estimator
    assert none.covariance.equals(none.covariance_noise)
    # a study of it reads what it is judged by
    for one, name in ((pair, "posterior"), (alone, "model")):
        text = config_text(one, {"base/forward/M2": {"shift": "0 0 (-5 .. 5) um"}}, 4, 1, "sobol")
        assert study_from_text(text).study.responses["forward_d_alpha"].key[3] == name
    for statement, told in (("launhc", "launhc"), ({"without": ["gremlins"]}, "no such cause")):
        with pytest.raises(InputError, match=told):
            pair.with_disturbances(statement)


def test_the_jacobian_is_what_small_motions_do(pair: twin.InstrumentTwin) -> None:
    """Central differences of the exact trace; the second order of half a unit is below 1e-3 of the largest entry."""
    motions = TEXTS["moved"]
    found = pair.jacobian(list(motions))
    assert found.per.values.tolist() == ["um", "arcsec", "ppm", "nm"]
    for name, perturb in motions.items():
        texts = [json.dumps(perturb).replace("{}", amount) for amount in ("0.5", "-0.5")]
        states = [pair.perturbed(json.loads(text)).state for text in texts]
        truth = trace_truth(pair.experiment.instrument, pair.experiment.backend, states)
        for camera, change in truth.cameras.items():
            vector = np.stack([change.d_alpha, change.d_beta, change.d_gamma]) * 648000 / np.pi
            own = found.true.sel(camera=camera, motion=name)
            assert own.values[:3] == pytest.approx(vector[:, 0] - vector[:, 1], abs=1e-6)
            assert own.values[3] == pytest.approx(1e6 * (change.d_f[0] - change.d_f[1]), abs=1e-4)


def test_a_study_names_what_it_takes(tmp_path: Path) -> None:
    """A name is loaded, so that a file that is not there is reported; a camera's view is refused in a sentence."""
    vary = {"M2 shift z": "(-5 .. 5) um"}
    camera = twin.load_camera("ritchey_chretien")
    with pytest.raises(twin.InputError, match=r"CameraTwin is not an instrument.*twin\.load\(NAME or FILE\)"):
        twin.study(camera, vary)
    with pytest.raises(twin.InputError, match=r"nowhere\.yaml"):
        twin.study(str(tmp_path / "nowhere.yaml"), vary)
    with pytest.raises(twin.InputError, match="nothing varies"):
        twin.study("ritchey_chretien", {})


def test_an_mtf_shows_the_frequencies_that_were_asked_for() -> None:
    camera = twin.load_camera("ritchey_chretien")
    single, table = repr(camera.mtf((0, 0), "80 cycles/mm")), repr(camera.mtf((0, 0)))
    assert re.search(r"frequency 80 cycles/mm; along line 0\.27\d+; along track 0\.27\d+", single)
    assert "nan" not in single
    assert re.search(r"nyquist 71\.43 cycles/mm; mtf at nyquist \(0\.\d+, 0\.\d+\)", table)


@pytest.mark.parametrize(("motion", "found", "says"), refusals("motions"))
def test_a_wrong_motion_is_explained(pair: twin.InstrumentTwin, motion: str, found: str, says: str) -> None:
    with pytest.raises(twin.InputError) as error:
        pair.jacobian([motion])
    assert found in str(error.value)
    assert says in str(error.value)


@pytest.mark.second
@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("asbuilt check", JOBS / "asbuilt_check.yaml"),
        ("camera", "monitor"),
        ("design camera", JOBS / "design.yaml"),
        ("recover", "frames.yaml"),
        ("tolerance", JOBS / "tolerance.yaml"),
        ("uncertainty", "gf7_pair"),
    ],
)
def test_a_script_gets_a_commands_run_folder(
    name: str, file: Path | str, shot: twin.Shot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_mtf_and_many_rays(monkeypatch)
    module, *subcommand = name.split()
    if name == "recover":
        file = tmp_path / file
        shot.save(tmp_path / "run")
        file.write_text("instrument: gf7_pair\ndisturbances: launch\nframes: run/images\n", "utf-8")
    folders = tmp_path / "command", tmp_path / "script"
    invoke(import_module(f"twin.{module}.__main__").app, *subcommand, file, "--out", folders[0], "--quiet")
    twin.perform(name, file).save(folders[1])
    assert files(folders[0]) == files(folders[1])
    for kept in ("config.yaml", f"{PROCEDURES[name].kind}.json"):
        assert (folders[0] / kept).read_bytes() == (folders[1] / kept).read_bytes()
    manifests = [json.loads((folder / "manifest.json").read_text("utf-8")) for folder in folders]
    for key in ("program", "test", "seed", "again", "checks", "inputs", "warnings"):
        assert manifests[0].get(key) == manifests[1].get(key), key


def test_options_of_a_command_are_checked() -> None:
    for chosen, words in (({"tilt": True}, "tilt goes with refocus"), ({"refocus": "yes"}, "True or False")):
        with pytest.raises(twin.InputError, match=words):
            twin.perform("camera", "ritchey_chretien", **chosen)


@pytest.mark.second
def test_another_camera_of_a_test_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera that is named is the one that is measured, not that of the file."""
    monkeypatch.setattr("twin.scripting.results.performed", lambda procedure, setup, *_: pytest.fail(setup.camera.name))
    other = tmp_path / "other.yaml"
    other.write_text((LIBRARY / "cameras/gf7.yaml").read_text("utf-8").replace("name: gf7", "name: other"), "utf-8")
    for changes, name in (({}, "gf7"), ({"camera": str(other)}, "other")):
        with pytest.raises(pytest.fail.Exception, match=f"^{name}$"):
            twin.perform("lab focus", "focus", **changes)
    with pytest.raises(twin.InputError, match="no such name"):
        twin.perform("lab focus", "focus", camera="nowhere")


def test_wrong_names_are_explained(pair: twin.InstrumentTwin) -> None:
    for call, words in (
        (lambda: twin.load("gf7_par"), "did you mean 'gf7_pair'"),
        (lambda: twin.load("no_such_file.yaml"), r"no_such_file\.yaml"),
        (lambda: pair.render(frame=3), "did you mean 'frames'"),
        (lambda: pair.perturbed("M2 shift z"), "perturb: the amount with its unit is missing"),
        (lambda: twin.perform("orbit angel", "angle"), "did you mean 'orbit angle'"),
        (lambda: twin.perform("orbit angle", "angle", pases=20), "did you mean 'passes'"),
        (lambda: twin.perform("orbit angle", "angle", passes="many"), "test.passes"),
    ):
        with pytest.raises(twin.InputError, match=words):
            call()
    with pytest.raises(AttributeError, match="no attribute 'laod'"):
        twin.laod  # noqa: B018


def test_ranges_are_factors(pair: twin.InstrumentTwin) -> None:
    vary = {
        "base/forward/M2": {"shift": "0 1 (-5 .. 5) um", "figure": {"Z5": "(0 +- 20) nm"}},
        "base/backward/focal_plane": {"rotate": ["(-2 .. 1) arcsec", "0 arcsec", "0 arcsec"], "pivot": "rear_node"},
        "base": {"temperature": "(-1 .. 1) K"},
    }
    setup = study_from_text(config_text(pair, vary, 12, 3, "sobol"))
    factors = {name: (factor.key, factor.kind, factor.numbers().values) for name, factor in setup.study.factors.items()}
    place = ("job", "perturb")
    assert factors == {
        "forward_M2_shift_z": ((*place, "base/forward/M2", "shift", 2), "uniform", (-5.0, 5.0)),
        "forward_M2_figure_Z5": ((*place, "base/forward/M2", "figure", "Z5"), "normal", (0.0, 20.0)),
        "backward_focal_plane_rotate_x": ((*place, "base/backward/focal_plane", "rotate", 0), "uniform", (-2.0, 1.0)),
        "base_temperature": ((*place, "base", "temperature", "change"), "uniform", (-1.0, 1.0)),
    }
    assert setup.study.design.runs == 12
    assert setup.study.design.seed == 3
    # what does not vary stays, and stands in the base
    assert setup.tree["job"]["perturb"]["base/forward/M2"]["shift"][1] == "1 um"
    assert setup.study.responses["forward_d_f"].units == "um"


@pytest.mark.parametrize(("vary", "says"), refusals("ranges"))
def test_a_wrong_range_is_explained(pair: twin.InstrumentTwin, vary: dict, says: str) -> None:
    with pytest.raises(twin.InputError, match=says):
        config_text(pair, vary, 10, 0, "sobol")


TELLS = (
    "import os, sys, time\n"
    "assert sys.argv[-2] == '--progress-fd'\n"
    "for k in range(3): os.write(int(sys.argv[-1]), f'{k + 1} 3\\n'.encode())\n"
)


def test_a_study_tells_how_far_it_is() -> None:
    """To a function of the caller's, to nobody, and a failure's words where they are not shown."""
    command, told = [sys.executable, "-c", TELLS], []
    assert scripted._run(command, False, lambda done, runs: told.append((done, runs))) == (0, "")
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert scripted._run(command, False, True) == (0, "")
    silent = [sys.executable, "-c", "import sys\nsys.exit('no light')"]
    assert scripted._run(silent, True, True) == (1, "no light\n")


def test_a_function_that_is_told_may_break_off_the_study() -> None:
    """Its error comes out, and the study's process does not go on."""

    def enough(done: int, runs: int) -> None:
        raise RuntimeError("enough")

    begun = time.monotonic()
    with pytest.raises(RuntimeError, match="enough"):
        scripted._run([sys.executable, "-c", f"{TELLS}time.sleep(60)\n"], True, enough)
    assert time.monotonic() - begun < 30.0


def test_the_command_tells_a_pipe() -> None:
    reading, writing = os.pipe()
    told = pipe_progress(writing)
    assert not os.get_inheritable(writing)
    told(1, 2)
    told(2, 2)
    os.close(writing)
    with os.fdopen(reading) as lines:
        assert lines.read() == "1 2\n2 2\n"


@pytest.mark.second
def test_a_camera_is_in_the_state_of_its_instrument(pair: twin.InstrumentTwin) -> None:
    """A despace of M2 shows in the camera that has it and nowhere else; a look of the whole camera is none."""
    bent = pair.perturbed({"base/forward/M2": {"shift": "0 0 30 um"}, "base/backward": {"rotate": "5 5 5 arcsec"}})
    nominal, moved = (one.camera("forward").wavefront(field=(0, 0)) for one in (pair, bent))
    assert moved.rms > 2.0 * nominal.rms
    waves = [one.camera("backward").wavefront(field=(0, 0)).rms for one in (pair, bent)]
    assert waves[1] == pytest.approx(waves[0], abs=1e-6)
    assert moved.plot().axes
    with pytest.raises(twin.InputError, match="did you mean 'forward'"):
        pair.camera("forwards")


@pytest.mark.second
@pytest.mark.parametrize("taken", [True, False])
def test_a_study_that_is_not_completed_is_an_error(pair: twin.InstrumentTwin, tmp_path: Path, taken: bool) -> None:
    """Its folder is there already."""
    vary = {"base/forward/M2": {"shift": "0 0 (-1 .. 1) um"}}
    (tmp_path / "out" / "a" if taken else tmp_path / "b").mkdir(parents=True)
    with pytest.raises(RuntimeError, match=r"exit code 2: .*exists") if taken else nullcontext():
        found = twin.study(pair, vary, n=2, workers=1, quiet=True, out=tmp_path / "out")
        assert found.sizes["run"] == 2
