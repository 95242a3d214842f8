"""`python -m twin.render` as a user runs it: results, exit codes, messages, and nothing left behind when it fails.

Few tests start a process, since each needs seconds to begin; the others call the same command inside this one.
"""

import hashlib
import json
import os
import pickle
import re
import resource
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

import twin.main_job.render_command
import twin.main_job.render_drawings
import twin.main_job.render_folder
import twin.render as command
from optics.numerics.threads import LIMIT
from scenes.specs.load import EXAMPLES
from tests.tiers import quick
from tests.twin.commands import files, invoke
from twin.main_job.render_drawings import (
    IRRADIANCE,
    SCENE,
    SUMMARY,
    _tried,
    drawings,
    instrument_drawings,
    limits_drawing,
    without_failed,
)
from twin.main_job.render_job import render_job

run = partial(invoke, command.app)
"""The command inside this process."""

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = EXAMPLES / "perturb.yaml"
FRAMES = 2
CAMERAS, SIDES, STATES = ("forward", "backward"), ("left", "right"), ("before", "after")
PARAMETERS = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")
ESTIMATORS = ("paper_single", "paper_joint", "derived", "model", "posterior")
IMAGES = {f"images/{c}_{s}_{t}" for c in CAMERAS for s in SIDES for t in STATES}
FILES = {
    "manifest.json",
    "config.yaml",
    "truth.json",
    "recovered.json",
    "crosstalk.json",
    "uncertainty.json",
    *("artefacts/limits.svg", "artefacts/limits-remedies.csv", "artefacts/limits-hidden.csv"),
    "artefacts/limits-motions.csv",
    "irradiance.nc",
    "report.html",
    "scene.glb",
    "summary.png",
    *(f"{image}.tiff" for image in IMAGES),
    *(f"{image}.png" for image in IMAGES),
}
# Signals that a shell set to "ignore" for a background job stay so in its children; a user's terminal has the default.
AS_FROM_A_TERMINAL = (
    "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "runpy.run_module('twin.render', run_name='__main__', alter_sys=True)"
)


def start(*arguments: object, **options: object) -> "subprocess.Popen[str]":
    """The command as a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "80"}
    code = [sys.executable, "-c", AS_FROM_A_TERMINAL, *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(code, cwd=ROOT, env=environment, start_new_session=True, **pipes, **options)


def frames_of(folder: Path) -> dict[str, np.ndarray]:
    return {image: tifffile.imread(folder / f"{image}.tiff") for image in sorted(IMAGES)}


@pytest.fixture(scope="module")
def computed(tmp_path_factory):
    """A run: the folder, what was printed, and what was computed."""
    place = tmp_path_factory.mktemp("first")
    kept = []

    def keep(*arguments, **options):
        kept.append(render_job(*arguments, **options))
        return kept[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(twin.main_job.render_command, "render_job", keep)
        done = run(EXAMPLE, "--out", place / "run", "--frames", FRAMES, "--seed", 5, "--json")
    assert done.exit_code == 0, done.stderr
    return place / "run", done.stdout, done.stderr, kept[0]


@pytest.fixture(scope="module")
def first(computed):
    """Its folder and what was printed."""
    return computed[:3]


@pytest.fixture(scope="module")
def repeated(first, tmp_path_factory):
    """Two more runs, one folder each: the first run again, and another seed."""
    place = tmp_path_factory.mktemp("repeated")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(LIMIT, "1")  # without a second process
        again = run(first[0] / "config.yaml", "--out", place / "again", "--quiet")
        patch.delenv(LIMIT)
        other = run(EXAMPLE, "--out", place / "other", "--frames", FRAMES, "--seed", 6)
    return place, again, other


@pytest.fixture
def ready(computed, monkeypatch):
    """The computation is replaced by one that is done already, and what is drawn of it by empty files, for tests of
    what comes before and after it.
    """
    kept = computed[3]
    monkeypatch.setattr(twin.main_job.render_command, "render_job", lambda *arguments, **options: kept)

    def few(run):
        return {SUMMARY: bytes, IRRADIANCE: drawings(run)[IRRADIANCE]}

    monkeypatch.setattr(twin.main_job.render_drawings, "instrument_drawings", lambda *_: {SCENE: bytes})
    monkeypatch.setattr(twin.main_job.render_folder, "drawings", few)
    monkeypatch.setattr(twin.main_job.render_folder, "limits_drawing", lambda _: {})
    monkeypatch.setattr(twin.main_job.render_folder, "render_report", lambda *_: "")


def no_font(*_):
    raise RuntimeError("no such font <x>")


def test_a_drawing_that_fails_is_a_note_and_a_file_that_fails_is_left_out():
    made = {"motions": "<svg>1</svg>", "side": _tried("side", no_font), SUMMARY: _tried(SUMMARY, no_font)}
    drawn, missing = without_failed(made | {SCENE: _tried(SCENE, bytes)})
    assert missing == tuple(
        f"{what} could not be drawn: RuntimeError: no such font <x>"
        for what in ("the figure 'side'", "the file summary.png")
    )
    assert (drawn["motions"], drawn[SCENE], SUMMARY in drawn) == ("<svg>1</svg>", b"", False)
    assert drawn["side"].startswith("<svg")
    assert "no such font &lt;x&gt;</text>" in drawn["side"]


@pytest.mark.slow
def test_what_cannot_be_drawn_costs_nothing_else(computed, tmp_path, monkeypatch):
    """A figure has a note in its place, a file is left out; exit code and manifest say so."""
    kept = computed[3]
    for name in ("summary_plot.summary_png", "spot_plots.motion_map_svg"):
        monkeypatch.setattr(f"twin.main_job.{name}", no_font)
    monkeypatch.setattr(twin.main_job.render_command, "render_job", lambda *arguments, **options: kept)
    done = run(EXAMPLE, "--out", tmp_path / "run", "--frames", FRAMES, "--quiet")
    assert done.exit_code == 1
    told = ["the figure 'motions'", "the file summary.png"]
    told = [f"{what} could not be drawn: RuntimeError: no such font <x>" for what in told]
    assert all(text in " ".join(done.stderr.split()) for text in told)
    assert files(tmp_path / "run") == FILES - {"summary.png"}
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert set(told) <= set(manifest["warnings"])
    assert "no such font &lt;x&gt;</text>" in (tmp_path / "run" / "report.html").read_text("utf-8")


def test_all_that_is_drawn_can_be_sent_to_the_second_process(computed):
    """What cannot is drawn by the first process alone: a run that is right and takes twice as long."""
    kept = computed[3]
    assert kept.recovery.curvature  # also with the motions that were traced again
    early = instrument_drawings(kept.experiment.instrument, kept.experiment.backend, kept.state)
    sent = pickle.loads(pickle.dumps((early, drawings(kept), limits_drawing(kept.limits))))
    assert sent[0]["side"]() == early["side"]()


# --- a run that works -------------------------------------------------------------------------------------------------


def test_the_run_folder_is_complete(first):
    folder, _, _ = first
    assert files(folder) == FILES
    assert files(folder.parent) == {f"run/{name}" for name in FILES}
    manifest = json.loads((folder / "manifest.json").read_text())
    assert set(manifest["sha256"]) == FILES - {"manifest.json"}
    for name, digest in manifest["sha256"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert (manifest["seed"], manifest["frames"], manifest["backend"]) == (5, FRAMES, "llvm")
    assert manifest["wall_time_s"] > 0
    assert {"python", "drjit", "numpy"} <= set(manifest["versions"])


def test_json_is_all_that_is_printed(first):
    folder, out, errors = first
    assert errors == ""
    assert out.count("\n") == 1
    printed = json.loads(out)
    assert set(printed) == {"truth", "recovered", "verdict", "warnings"}
    for name in ("truth", "recovered"):
        assert printed[name] == json.loads((folder / f"{name}.json").read_text())


def test_keys_of_truth(first):
    truth = json.loads((first[0] / "truth.json").read_text())
    assert set(truth["cameras"]) == set(CAMERAS)
    for camera in truth["cameras"].values():
        assert set(PARAMETERS) <= set(camera)
        assert all(np.isfinite(value) for value in camera.values())
    assert np.isfinite(truth["intersection_angle"]["change_arcsec"])
    # 2 arcsec about X, and what 10 arcsec about Z add because the rear node is not straight behind the line
    assert truth["cameras"]["backward"]["d_beta_arcsec"] == pytest.approx(-2.0, abs=0.01)


def test_keys_of_recovered(first):
    recovered = json.loads((first[0] / "recovered.json").read_text())
    endings = ("", "_sigma", "_sigma_noise")
    with_sigma = {f"{key}{ending}" for key in PARAMETERS for ending in endings}
    for camera in CAMERAS:
        assert set(recovered["cameras"][camera]) == set(ESTIMATORS)
        for values in recovered["cameras"][camera].values():
            assert set(values) == with_sigma
            assert all(values[f"{key}_sigma"] > values[f"{key}_sigma_noise"] > 0 for key in PARAMETERS)
        assert set(recovered["spots"][camera]) == set(SIDES)
        for side in SIDES:
            assert set(recovered["spots"][camera][side]) == set(STATES)
            for spot in recovered["spots"][camera][side].values():
                squares = {f"{part}_chi_square{end}" for part in ("reduced", "core") for end in ("", "_sigma_noise")}
                fit = {*squares, "sigma_widened"}
                assert set(spot) == {"row", "column", "row_sigma", "column_sigma", *fit}
                assert 0 < spot["row"] < 95
                assert spot["sigma_widened"] == 1.0
    assert set(recovered["intersection_angle"]) == set(ESTIMATORS)
    for values in recovered["intersection_angle"].values():
        assert set(values) == {f"change_arcsec{ending}" for ending in endings}
    assert set(recovered["ground"]) == set(ESTIMATORS)
    for values in recovered["ground"].values():
        assert {f"{axis}_m{ending}" for axis in ("along", "across", "height") for ending in endings} <= set(values)
    stated = recovered["disturbances"]
    assert (stated["name"], stated["degrees_of_freedom"], stated["agrees"], stated["suspects"]) == (
        "launch",
        8,
        True,
        [],
    )
    assert stated["chi_square"] < stated["limit"]
    assert recovered["sigma_holds"]
    assert recovered["doubts"] == []
    for found in recovered["retraced"].values():
        assert not found["relinearised"]
        assert found["off_in_sigma"] < 0.1
    for camera in CAMERAS:
        assert set(recovered["from_statement"][camera]) == set(PARAMETERS)
        # of the posterior's variance the noise of the images is next to nothing
        assert all(0.99 < share <= 1.0 for share in recovered["from_statement"][camera].values())


def test_images_are_the_frames(first):
    folder, _, _ = first
    for image in sorted(IMAGES):
        with tifffile.TiffFile(folder / f"{image}.tiff") as file:
            assert len(file.pages) == FRAMES
            assert file.pages[0].dtype == np.uint16
            assert file.pages[0].shape == (96, 96)
        assert (folder / f"{image}.png").read_bytes().startswith(b"\x89PNG")


def test_irradiance_opens(first):
    with xr.open_dataset(first[0] / "irradiance.nc", engine="h5netcdf") as data:
        assert data.photons.dims == ("state", "channel", "row", "column")
        assert data.photons.shape == (2, 4, 96, 96)
        assert list(data.state.values) == list(STATES)
        assert list(data.channel.values) == [f"{c}/{s}" for c in CAMERAS for s in SIDES]
        assert bool(np.isfinite(data.photons).all())
        assert bool((data.photons >= 0).all())
        assert data.attrs["wavelength_m"] == 650e-9


def test_report_needs_nothing_from_outside(first):
    text = (first[0] / "report.html").read_text("utf-8")
    assert len(text) > 10_000
    for reference in ('src="http', "src='http", '<link rel="stylesheet"', "@import", "<script src"):
        assert reference not in text


@pytest.mark.second
def test_config_repeats_the_run_bit_for_bit(first, repeated):
    """The config of a run with --seed and --frames holds both, so that it alone repeats the run."""
    folder, _, _ = first
    place, again, _ = repeated
    assert again.exit_code == 0
    for name in ("truth.json", "recovered.json", "config.yaml"):
        assert (place / "again" / name).read_bytes() == (folder / name).read_bytes()
    one, two = frames_of(folder), frames_of(place / "again")
    for image in one:
        assert np.array_equal(one[image], two[image])


@pytest.mark.second
def test_what_is_drawn_does_not_depend_on_who_draws_it(first, repeated):
    """The first run has a second process where there are two cores, the other never. All else is compared above."""
    folder, place = first[0], repeated[0] / "again"
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    drawn = [name for name in files if name.suffix in (".svg", ".png", ".glb", ".nc", ".csv")]
    assert len(drawn) > 10
    for name in drawn:
        assert (place / name).read_bytes() == (folder / name).read_bytes(), name
    assert (place / "report.html").read_text() == (folder / "report.html").read_text()


@pytest.mark.second
def test_quiet_says_nothing(repeated):
    _, again, _ = repeated
    assert (again.stdout, again.stderr) == ("", "")


@pytest.mark.second
def test_another_seed_is_other_noise_on_the_same_truth(first, repeated):
    folder, _, _ = first
    place, _, other = repeated
    assert other.exit_code == 0
    assert (place / "other/truth.json").read_bytes() == (folder / "truth.json").read_bytes()
    one, two = frames_of(folder), frames_of(place / "other")
    for image in one:
        assert np.mean(one[image] != two[image]) > 0.8


@pytest.mark.second
def test_the_table_is_readable_in_a_narrow_terminal(repeated):
    """No number is cut, and the table fits into 80 columns."""
    place, _, other = repeated
    assert "…" not in other.stdout
    assert str(place / "other") in other.stdout.replace("\n", "")
    truth = json.loads((place / "other/truth.json").read_text())
    for camera in CAMERAS:
        assert camera in other.stdout
        assert f"{truth['cameras'][camera]['d_alpha_arcsec']:.4f}" in other.stdout
    table = [
        line
        for line in other.stdout.splitlines()
        if re.match(r"Δ[αβγθ] \[arcsec\] |Δf \[µm\] |(along|across|height) \[m\] ", line)
    ]
    assert len(table) == 2 * 4 + 1 + 3
    assert max(len(line) for line in table) <= 80
    # what the sigmas assume stands below it
    assert "σ: noise and the prior launch; the shifts agree with it (chi-square" in other.stdout


@pytest.mark.slow
def test_a_wide_terminal_also_has_the_noise_and_a_job_without_disturbances_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    shown = run(EXAMPLE, "--out", tmp_path / "wide", "--frames", FRAMES).stdout
    assert "noise" in shown[shown.index("poste-") : shown.index("forward  ")]
    assert max(len(line) for line in shown.splitlines() if "[arcsec] " in line and "Δα [arcsec] " == line[:12]) <= 100
    job = tmp_path / "job.yaml"
    job.write_text(EXAMPLE.read_text().replace("disturbances: launch", "disturbances: none"))
    alone = run(job, "--out", tmp_path / "alone", "--frames", FRAMES)
    assert alone.exit_code == 0, alone.output
    assert "No disturbances are stated: σ is that of the noise of the images alone." in alone.stdout
    recovered = json.loads((tmp_path / "alone" / "recovered.json").read_text())
    assert set(recovered["cameras"]["forward"]) == set(ESTIMATORS) - {"posterior"}
    assert "disturbances" not in recovered
    assert "No disturbances are stated" in (tmp_path / "alone" / "report.html").read_text("utf-8")


@pytest.mark.second
def test_numbers_are_whole_however_narrow_the_terminal(ready, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "30")
    result = run(EXAMPLE, "--out", tmp_path / "run")
    assert result.exit_code == 0
    assert "…" not in result.stdout
    truth = json.loads((tmp_path / "run" / "truth.json").read_text())
    assert f"{truth['cameras']['backward']['d_beta_arcsec']:.4f}" in result.stdout


@pytest.mark.second
def test_default_folder_counts_up(ready, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        assert run(EXAMPLE, "--quiet").exit_code == 0
        assert (tmp_path / f"runs/perturb-00{number}/manifest.json").is_file()


@pytest.mark.second
def test_force_replaces_a_run(ready, tmp_path):
    assert run(EXAMPLE, "--out", tmp_path / "run", "--quiet").exit_code == 0
    (tmp_path / "run/note.txt").touch()
    complains(run(EXAMPLE, "--out", tmp_path / "run", "--quiet", "--force"), "did not write: note.txt", "--out")
    assert files(tmp_path / "run") == {*FILES, "note.txt"}
    (tmp_path / "run/note.txt").unlink()
    assert run(EXAMPLE, "--out", tmp_path / "run", "--quiet", "--force").exit_code == 0
    assert files(tmp_path / "run") == FILES


# --- bad input --------------------------------------------------------------------------------------------------------

HEAD = "instrument: gf7_pair\nperturb:\n"
BOMB = "\n".join(
    ["a: &a [x, x, x]", *(f"{chr(98 + k)}: &{chr(98 + k)} [*{chr(97 + k)}, *{chr(97 + k)}]" for k in range(20))]
)
BAD_FILES = {
    "unknown node": (
        HEAD + "  base/forwards/M2: {shift: [0 um, 0 um, 3 um]}",
        ("no such node", "base/forward/M2", ":3"),
    ),
    "unknown pivot": (HEAD + "  base/forward/focal_plane: {pivot: rear_nod}", ("pivot", "rear_node", ":3")),
    "unknown key": (HEAD + "  base/forward/M2: {shfit: [0 um, 0 um, 3 um]}", ("unknown key", "shift", ":3")),
    "unknown instrument": ("instrument: gf7_par", ("no such name in instruments", "gf7_pair")),
    "unknown unit": (HEAD + "  base/forward/M2: {shift: [0 um, 0 um, 3 umm]}", ("unknown unit", "umm", ":3")),
    "wrong unit": (HEAD + "  base/forward/M2: {shift: [0 um, 0 um, 3 deg]}", ("unit of an angle", ":3")),
    "missing unit": (HEAD + "  base/forward/M2: {shift: [0 um, 0 um, 3]}", ("without a unit", "shift[2]")),
    "NaN": (HEAD + "  base/forward/M2: {shift: [0 um, .nan, 3 um]}", ("not a finite number", "shift[1]")),
    "NaN with a unit": (HEAD + "  base/forward/M2: {shift: [0 um, nan um, 3 um]}", ("not a finite number",)),
    "infinite": (HEAD + "  base/forward/M2: {shift: [0 um, .inf, 3 um]}", ("not a finite number",)),
    "overflow": (HEAD + "  base/forward/M2: {shift: [0 um, 1e999 um, 3 um]}", ("not a finite number",)),
    "absurd": (HEAD + "  base/forward/M2: {shift: [0 um, 0 um, 10 m]}", ("outside the limits", "10 m", "100 mm")),
    "duplicate keys": (HEAD + "  base/forward/M2: {}\n  base/forward/M2: {}", ("duplicate key", "line 3", ":4")),
    "YAML bomb": (BOMB, ("anchors are not allowed",)),
    "tags": ("instrument: !!python/object/apply:os.system ['echo']", ("tags are not allowed",)),
    "not YAML": ("instrument: [", ("not valid YAML",)),
    "empty": ("", ("empty",)),
    "binary": (b"\xff\xfe\x00", ("not UTF-8",)),
    "too large": ("#" * 1_000_001, ("too large", "1 MB")),
}


def complains(result, *words: object) -> str:
    """Exit code 2, one clear message on stderr and nothing else; returns the message."""
    assert result.exit_code == 2, result.stdout + result.stderr
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("error:") == 1
    assert "Traceback" not in result.stderr
    for word in words:
        assert str(word) in result.stderr
    return result.stderr


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files(case, tmp_path):
    content, words = BAD_FILES[case]
    job = tmp_path / "job.yaml"
    job.write_bytes(content if isinstance(content, bytes) else content.encode())
    message = complains(run(job, "--out", tmp_path / "new/run"), job, *words)
    assert len(message.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["job.yaml"]


def test_files_that_cannot_be_read(tmp_path):
    complains(run(tmp_path / "none.yaml", "--out", tmp_path / "run"), "none.yaml: no such file")
    complains(run(tmp_path, "--out", tmp_path / "run"), "is a directory")
    complains(run("/dev/zero", "--out", tmp_path / "run"), "not a regular file")
    locked = tmp_path / "locked.yaml"
    locked.touch(mode=0)
    if not os.access(locked, os.R_OK):  # root reads everything
        complains(run(locked, "--out", tmp_path / "run"), "Permission denied")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--seed", "-1"],
        ["--seed", "1.5"],
        ["--seed", str(2**63)],
        ["--frames", "0"],
        ["--frames", "100000"],
        ["--bakend", "llvm"],
        ["--backend", "nonsense"],
    ],
)
def test_bad_options(options, tmp_path):
    result = run(EXAMPLE, "--out", tmp_path / "run", *options)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert options[0].strip("-") in result.stderr
    assert "Traceback" not in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_no_job_at_all():
    result = run()
    assert result.exit_code == 2
    assert "Missing argument" in result.stderr


def test_output_that_exists(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").touch()
    complains(run(EXAMPLE, "--out", tmp_path / "mine"), "exists", "--force")
    complains(run(EXAMPLE, "--out", tmp_path / "mine", "--force"), "not a run folder")
    (tmp_path / "file").touch()
    complains(run(EXAMPLE, "--out", tmp_path / "file", "--force"), "is not a folder")
    assert files(tmp_path) == {"mine/thesis.txt", "file"}


def test_output_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    for place in (tmp_path / "file/run", tmp_path / ("n" * 300), "/proc/run", "/dev/null/run"):
        complains(run(EXAMPLE, "--out", place), "the output folder")
    assert files(tmp_path) == {"file"}


TOO_MUCH = {
    "beam off the mirrors": "base/forward/M1: {rotate: [3 deg, 0 deg, 0 deg], pivot: centre}",
    "spot off the CCD": "base/forward/focal_plane: {shift: [0.6 mm, 0 um, 0 um]}",
}


@pytest.mark.parametrize("case", quick(1, TOO_MUCH))
def test_a_perturbation_that_loses_the_light_is_explained(case, tmp_path):
    job = tmp_path / "job.yaml"
    job.write_text(HEAD + "  " + TOO_MUCH[case])
    message = complains(run(job, "--out", tmp_path / "run"), job, "base/forward/", "make them smaller")
    assert "nan" not in message.lower()
    assert [path.name for path in tmp_path.iterdir()] == ["job.yaml"]


@pytest.mark.second
def test_a_full_disk(ready, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (1000, 30_000, 100_000, 500_000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            result = run(EXAMPLE, "--out", tmp_path / "new/run")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert result.exit_code == 1  # the disk is at fault, and not what was asked for
        message = " ".join(result.stderr.split())
        assert all(words in message for words in ("cannot write to", "File too large", "nothing was kept"))
        message = result.stderr.strip()
        assert len(message.splitlines()) == 1
        assert list(tmp_path.iterdir()) == []


def test_no_gpu(tmp_path):
    import drjit as dr

    if dr.has_backend(dr.JitBackend.CUDA):
        pytest.skip("there is a GPU")
    result = run(EXAMPLE, "--out", tmp_path / "run", "--backend", "cuda")
    assert result.exit_code == 1
    assert result.stdout == ""
    assert "the cuda backend is not available" in result.stderr
    assert "--backend llvm" in result.stderr
    assert "Traceback" not in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.second
def test_a_missing_library_is_explained(tmp_path, monkeypatch):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nonexistent.so")
    process = start(EXAMPLE, "--out", tmp_path / "run")
    stdout, stderr = process.communicate(timeout=60)
    assert (process.returncode, stdout) == (1, "")
    assert "/nonexistent.so" in stderr
    assert "Traceback" not in stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.second
@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 130), (signal.SIGHUP, 129), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)],
)
def test_an_interrupt_leaves_nothing(number, code, tmp_path):
    # on a busy machine the run may be over before this process sends the signal: once more, sooner
    for number_of_try, wait in enumerate((0.3, 0.1, 0.0)):
        folder = tmp_path / str(number_of_try)
        folder.mkdir()
        process = start(EXAMPLE, "--out", folder / "new/run", "--quiet")
        try:
            deadline = time.monotonic() + 60
            while not list(folder.glob("new/.run.*.partial")):
                assert process.poll() is None, process.stderr.read()
                assert time.monotonic() < deadline
                time.sleep(0.02)
            time.sleep(wait)
            process.send_signal(number)
            out, errors = process.communicate(timeout=60)
        finally:
            process.kill()
        if process.returncode != 0:
            break
        assert (folder / "new/run/manifest.json").exists()
    assert process.returncode == code, errors
    assert out == ""
    assert "Traceback" not in errors
    assert list(folder.iterdir()) == []


def test_the_nodes_of_an_instrument_are_listed(tmp_path) -> None:
    done = run("--list-nodes", EXAMPLE, "--json")
    assert done.exit_code == 0, done.stderr
    data = json.loads(done.stdout)
    assert data["instrument"] == "gf7_pair"
    focal_plane = {"pivots": ["origin", "rear_node", "line_centre"], "allows": ["rotate", "shift", "temperature"]}
    assert data["nodes"]["base/backward/focal_plane"] == focal_plane
    assert data["nodes"]["base/forward/M2"]["allows"] == [
        *("rotate", "shift", "figure", "radius", "conic", "temperature")
    ]
    # what a job may not name is not in the list, and what it may is
    path = tmp_path / "job.yaml"
    path.write_text("instrument: gf7_pair\nperturb: {base/forward/M9: {shift: 0 0 1 um}}\n", "utf-8")
    refused = run(path, "--out", tmp_path / "run")
    assert refused.exit_code == 2
    assert all(name in refused.stderr for name in data["nodes"])
    table = run("--list-nodes", path)
    assert table.exit_code == 0
    assert all(name in table.stdout for name in data["nodes"])
    assert not (tmp_path / "run").exists()


@pytest.mark.second
def test_a_prior_that_moves_one_change_alone_has_a_posterior_of_it_alone(tmp_path) -> None:
    """The paper's ranges move the principal distance alone; every table of the run has its rows all the same."""
    job = tmp_path / "alone.yaml"
    job.write_text(
        "instrument: gf7_pair\ndisturbances: paper_001\n"
        "perturb:\n  base/backward/focal_plane: {rotate: [2 arcsec, -1.5 arcsec, 10 arcsec], pivot: rear_node}\n"
        "render: {images: [spots], frames: 9, seed: 1}\n"
    )
    result = run(job, "--out", tmp_path / "run")
    assert result.exit_code == 0, result.stderr
    camera = json.loads((tmp_path / "run" / "recovered.json").read_text())["cameras"]["backward"]["posterior"]
    assert camera["d_alpha_arcsec"] is None
    assert camera["d_alpha_arcsec_sigma"] is None
    assert camera["d_f_um_sigma"] > 0.0
