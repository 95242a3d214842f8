"""`python -m twin.verify` on the run folder of every command: small runs, those that tests/golden freezes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scenes.yaml.errors import InputError
from tests.golden.jobs import BY_NAME, ROOT, SET, UNSET, run
from twin.run.owned_files import MANIFEST
from twin.verify.folder_state import folder_state
from twin.verify.verification import obstacle

KINDS = (
    *("render", "render_targets", "render_course", "render_stray", "render_deformed", "recover", "uncertainty"),
    *("study_render", "study_lab", "study_orbit", "study_gradient", "design", "design_monitor", "camera"),
    *("lab_focus", "lab_distortion", "lab_turntable", "lab_focus_measured", "lab_turntable_measured"),
    *(
        "orbit_simulate",
        "orbit_adjust",
        "orbit_adjust_measured",
        "orbit_angle",
        "orbit_angle_measured",
        "orbit_calibrate",
        "orbit_calibrate_measured",
    ),
    *(
        "orbit_check",
        "orbit_match",
        "orbit_jitter",
        "orbit_jitter_measured",
        "orbit_loop",
        "orbit_monitor",
        "orbit_export",
        "export",
        "validate",
    ),
)
"""Of the golden jobs, each kind of run folder once; those of twin.compare are in test_verify.py."""
ROUNDED = ("render_stray",)
"""Sums of stray light add up in the order in which threads come to them."""


def verify(*words: object) -> subprocess.CompletedProcess:
    """The command, with the linear algebra that the golden jobs are run with."""
    environment = {key: value for key, value in os.environ.items() if key not in UNSET} | SET
    command = [sys.executable, "-m", "twin.verify", *map(str, words)]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


def changed_bytes_are_found(folder: Path) -> int:
    """Flip a byte in the middle of each file, one file after the other; number of files."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    for name in names:
        kept = (folder / name).read_bytes()
        content = bytearray(kept or b"x")
        content[len(content) // 2] ^= 1
        (folder / name).write_bytes(content)
        try:
            found = folder_state(folder).changed
        except InputError as error:
            found = (Path(error.issues[0].file).name,)
            assert found == (MANIFEST,)
        assert name in found, name
        (folder / name).write_bytes(kept)
    assert folder_state(folder).whole
    return len(names)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_changed_byte_is_found_and_the_run_comes_out_the_same(name, tmp_path) -> None:
    done = run(BY_NAME[name], tmp_path)
    assert (done.out / MANIFEST).exists(), done.stderr
    assert obstacle(folder_state(done.out)) == ""
    assert changed_bytes_are_found(done.out) >= 4
    found = verify(done.out, "--json")
    assert found.returncode == 0, found.stdout + found.stderr
    told = json.loads(found.stdout)["made_again"]
    assert told["state"] in ("same", *(("rounding",) if name in ROUNDED else ())), told
    assert told["other_program"] == told["other_processor"] == []


AUDITED = """
import json, os, runpy, sys
opened = []
def hook(event, told):
    if event == "open" and isinstance(told[0], (str, bytes)) and not told[2] & (os.O_WRONLY | os.O_RDWR):
        opened.append(os.path.abspath(os.fsdecode(told[0])))
sys.addaudithook(hook)
sys.path.insert(0, os.getcwd())
place, sys.argv = sys.argv[1], sys.argv[2:]
try:
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
finally:
    with open(place, "w") as file:
        json.dump(opened, file)
"""
"""Runs a module and writes down which files were opened to be read."""
MEASURED = ("orbit check", "orbit angle", "orbit calibrate", "lab focus", "lab turntable", "lab distortion")


@pytest.mark.slow
@pytest.mark.parametrize("command", MEASURED)
def test_every_file_that_was_read_is_an_input(command, tmp_path) -> None:
    """Whatever a test opens of its measurements stands in the manifest; its own YAML is in config.yaml."""
    program, test = command.split()
    shutil.copytree(ROOT / "scenes" / program / "measured", tmp_path / "in")
    words = [f"twin.{program}", test, tmp_path / f"in/{test}.yaml", "--out", tmp_path / "out", "--quiet"]
    ran = [sys.executable, "-c", AUDITED, tmp_path / "opened.json", *words]
    subprocess.run(list(map(str, ran)), cwd=ROOT, check=True)
    opened = {Path(name) for name in json.loads((tmp_path / "opened.json").read_text())}
    read = {str(path) for path in opened if tmp_path / "in" in path.parents and path.suffix != ".yaml"}
    state = folder_state(tmp_path / "out")
    assert read
    assert read == set(state.manifest.inputs)


@pytest.mark.slow
def test_other_sums_are_told_from_other_results(tmp_path) -> None:
    """The same run with the linear algebra of another processor: the same but for rounding, and said to be elsewhere;
    the main job's recovered.json the same to the byte, as docs/architecture.md says.
    """
    done = run(BY_NAME["render"], tmp_path)
    kernels = SET["OPENBLAS_CORETYPE"]
    try:
        SET["OPENBLAS_CORETYPE"] = "Nehalem"
        found = verify(done.out, "--json")
    finally:
        SET["OPENBLAS_CORETYPE"] = kernels
    told = json.loads(found.stdout)
    assert any("kernels for Haswell then, Nehalem now" in text for text in told["made_again"]["other_processor"])
    states = {one["file"]: one["state"] for one in told["made_again"]["files"]}
    assert states["recovered.json"] == "same"
    assert {states["truth.json"], states["irradiance.nc"]} <= {"same", "rounding"}
