"""`python -m twin.render` as a user runs it: results, exit codes, messages, and nothing left behind when it fails.

Few tests start a process, since each needs seconds to begin; the others call the same command inside this one.
"""

import hashlib
import json
import os
import pickle
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
from rich.console import Console

import twin.main_job.render_command
import twin.main_job.render_folder
import twin.render as command
from optics.numerics.backend import THREADS_VARIABLE
from scenes.specs.load import EXAMPLES
from tests.tiers import quick
from tests.twin.commands import files, invoke
from tests.twin.study_bench import REFUSED
from twin.main_job.render_folder import (
    IRRADIANCE,
    SCENE,
    SUMMARY,
    _attempt,
    drawings,
    instrument_drawings,
    limits_drawing,
    without_failed,
)
from twin.main_job.render_job import render_job

pytestmark = pytest.mark.drawn

run = partial(invoke, command.app)
"""The command inside this process."""

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = EXAMPLES / "perturb.yaml"
FRAMES = 2
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
        patch.setenv(THREADS_VARIABLE, "1")  # without a second process, which imports once more what is here already
        done = run(EXAMPLE, "--out", place / "run", "--frames", FRAMES, "--seed", 5, "--json")
    assert done.exit_code == 0, done.stderr
    return place / "run", done.stdout, done.stderr, kept[0]


@pytest.fixture
def ready(computed, monkeypatch):
    """The computation is replaced by one that is done already, and what is drawn of it by empty files, for tests of
    what comes before and after it.
    """
    kept = computed[3]
    monkeypatch.setattr(twin.main_job.render_command, "render_job", lambda *arguments, **options: kept)

    def few(run):
        return {SUMMARY: bytes, IRRADIANCE: drawings(run)[IRRADIANCE]}

    monkeypatch.setattr(twin.main_job.render_folder, "instrument_drawings", lambda *_: {SCENE: bytes})
    monkeypatch.setattr(twin.main_job.render_folder, "drawings", few)
    monkeypatch.setattr(twin.main_job.render_folder, "limits_drawing", lambda _: {})
    monkeypatch.setattr(twin.main_job.render_folder, "render_report", lambda *_: "")


def no_font(*_):
    raise RuntimeError("no such font <x>")


def test_a_drawing_that_fails_is_a_note_and_a_file_that_fails_is_left_out():
    made = {"motions": "<svg>1</svg>", "side": _attempt("side", no_font), SUMMARY: _attempt(SUMMARY, no_font)}
    drawn, missing = without_failed(made | {SCENE: _attempt(SCENE, bytes)})
    assert missing == tuple(
        f"{what} could not be drawn: RuntimeError: no such font <x>"
        for what in ("the figure 'side'", "the file summary.png")
    )
    assert (drawn["motions"], drawn[SCENE], SUMMARY in drawn) == ("<svg>1</svg>", b"", False)
    assert drawn["side"].startswith("<svg")
    assert "no such font &lt;x&gt;</text>" in drawn["side"]


@pytest.mark.second
def test_all_that_is_drawn_can_be_sent_to_the_second_process(computed):
    """What cannot is drawn by the first process alone: a run that is right and takes twice as long."""
    kept = computed[3]
    assert kept.recovery.curvature  # also with the motions that were traced again
    early = instrument_drawings(kept.experiment.instrument, kept.experiment.backend, kept.state)
    sent = pickle.loads(pickle.dumps((early, drawings(kept), limits_drawing(kept.limits))))
    assert sent[0]["side"]() == early["side"]()


@pytest.mark.second
def test_what_cannot_be_drawn_costs_nothing_else(ready, tmp_path, monkeypatch):
    """A file that cannot be drawn is not there; all else is, and exit code and manifest say so."""
    monkeypatch.setattr(
        twin.main_job.render_folder, "drawings", lambda _: {SUMMARY: partial(_attempt, SUMMARY, no_font)}
    )
    done = run(EXAMPLE, "--out", tmp_path / "run", "--frames", FRAMES, "--quiet")
    told = "the file summary.png could not be drawn: RuntimeError: no such font <x>"
    assert (done.exit_code, told in " ".join(done.stderr.split())) == (1, True)
    assert {"truth.json", "recovered.json", "report.html"} <= files(tmp_path / "run")
    assert told in json.loads((tmp_path / "run" / "manifest.json").read_text())["warnings"]


def test_brackets_of_a_prior_are_printed(computed, monkeypatch, capsys):
    monkeypatch.setattr(twin.main_job.render_command, "assumed", lambda _: "the prior [draft]")
    twin.main_job.render_command._print_result(computed[3], Console(width=200))
    assert "the prior [draft]." in capsys.readouterr().out


# --- a run that works -------------------------------------------------------------------------------------------------


def test_the_manifest_has_the_checksum_of_every_file(computed):
    folder, out, errors, _ = computed
    manifest = json.loads((folder / "manifest.json").read_text())
    assert set(manifest["sha256"]) == files(folder) - {"manifest.json"}
    for name, digest in manifest["sha256"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert (manifest["seed"], manifest["frames"], manifest["backend"]) == (5, FRAMES, "llvm")
    assert (errors, out.count("\n")) == ("", 1)
    # 2 arcsec about X, and what 10 arcsec about Z add because the rear node is not straight behind the line
    assert json.loads(out)["truth"]["cameras"]["backward"]["d_beta_arcsec"] == pytest.approx(-2.0, abs=0.01)


@pytest.mark.second
def test_config_repeats_the_run_bit_for_bit(computed, tmp_path):
    """The config of a run with --seed and --frames holds both; the run may have a second process, as here, or none.
    Another seed is other noise on the same truth.
    """
    folder = computed[0]
    again = run(folder / "config.yaml", "--out", tmp_path / "again", "--quiet")
    assert (again.exit_code, again.stdout, again.stderr) == (0, "", "")
    for name in files(folder) - {"manifest.json"}:
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name
    assert run(EXAMPLE, "--out", tmp_path / "other", "--frames", FRAMES, "--seed", 6).exit_code == 0
    assert (tmp_path / "other/truth.json").read_bytes() == (folder / "truth.json").read_bytes()
    for image in folder.glob("images/*.tiff"):
        other = tifffile.imread(tmp_path / "other/images" / image.name)
        assert np.mean(other != tifffile.imread(image)) > 0.8


# --- bad input --------------------------------------------------------------------------------------------------------

HEAD = "instrument: gf7_pair\nperturb:\n"
BAD_FILES = REFUSED["job_files"] | {
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


@pytest.mark.second
@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files(case, tmp_path):
    content, words = BAD_FILES[case]
    job = tmp_path / "job.yaml"
    job.write_bytes(content if isinstance(content, bytes) else content.encode())
    message = complains(run(job, "--out", tmp_path / "new/run"), job, *words)
    assert len(message.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["job.yaml"]


def test_bad_options(tmp_path):
    seeds, frames = ("-1", "1.5", str(2**63)), ("0", "100000")
    cases = [("--seed", seed) for seed in seeds] + [("--frames", count) for count in frames]
    for options in (*cases, ("--bakend", "llvm"), ("--backend", "nonsense"), ()):
        result = run(*((EXAMPLE, "--out", tmp_path / "run", *options) if options else ()))
        assert (result.exit_code, result.stdout) == (2, ""), options
        assert options[0].strip("-") in result.stderr if options else "Missing argument" in result.stderr
        assert "Traceback" not in result.stderr
        assert list(tmp_path.iterdir()) == []


def test_output_that_exists(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").touch()
    complains(run(EXAMPLE, "--out", tmp_path / "mine"), "exists", "--force")
    complains(run(EXAMPLE, "--out", tmp_path / "mine", "--force"), "not a run folder")
    (tmp_path / "file").touch()
    complains(run(EXAMPLE, "--out", tmp_path / "file", "--force"), "is not a folder")
    assert files(tmp_path) == {"mine/thesis.txt", "file"}


TOO_MUCH = {
    "beam off the mirrors": "base/forward/M1: {rotate: [3 deg, 0 deg, 0 deg], pivot: centre}",
    "spot at the edge of the CCD": "base/forward/focal_plane: {shift: [0.27 mm, 0 um, 0 um]}",
    "spot off the CCD": "base/forward/focal_plane: {shift: [0.6 mm, 0 um, 0 um]}",
}


@pytest.mark.parametrize("case", quick(1, TOO_MUCH))
def test_a_perturbation_that_loses_the_light_is_explained(case, tmp_path):
    job = tmp_path / "job.yaml"
    job.write_text(HEAD + "  " + TOO_MUCH[case])
    message = complains(run(job, "--out", tmp_path / "run"), job, "base/forward/", "smaller motions, which keep")
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
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
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
    assert data["nodes"]["base/backward/focal_plane"]["pivots"] == ["origin", "rear_node", "line_centre"]
    # what a job may not name is not in the list, and what it may is
    path = tmp_path / "job.yaml"
    path.write_text("instrument: gf7_pair\nperturb: {base/forward/M9: {shift: 0 0 1 um}}\n", "utf-8")
    refused = run(path, "--out", tmp_path / "run")
    assert refused.exit_code == 2
    assert all(name in refused.stderr for name in data["nodes"])
    assert run("--list-nodes", path, "--backend", "gpu").exit_code == 2
    table = run("--list-nodes", path)
    assert table.exit_code == 0
    assert all(name in table.stdout for name in data["nodes"])
    assert not (tmp_path / "run").exists()
