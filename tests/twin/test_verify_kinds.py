"""`python -m twin.verify` on run folders of several commands, and which files a run has read."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.golden.jobs import BY_NAME, ROOT, SET, UNSET, run
from twin.compare.folder_state import folder_state
from twin.framework.owned_files import MANIFEST


@pytest.mark.second
@pytest.mark.parametrize("name", ["lab_turntable", "orbit_adjust", "study_gradient"])
def test_a_changed_byte_is_found_and_the_run_comes_out_the_same(name, tmp_path) -> None:
    """A byte in the middle of each file, one file after the other; then the run is made again."""
    done = run(BY_NAME[name], tmp_path)
    assert (done.out / MANIFEST).exists(), done.stderr
    for path in [path for path in done.out.rglob("*") if path.is_file() and path.name != MANIFEST]:
        kept = path.read_bytes()
        content = bytearray(kept or b"x")
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        assert path.relative_to(done.out).as_posix() in folder_state(done.out).changed
        path.write_bytes(kept)
    environment = {key: value for key, value in os.environ.items() if key not in UNSET} | SET
    command = [sys.executable, "-m", "twin.verify", str(done.out), "--json"]
    found = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    told = json.loads(found.stdout)["made_again"]
    assert (told["state"], told["other_program"], told["other_processor"]) == ("same", [], [])


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


@pytest.mark.second
@pytest.mark.parametrize("command", ["orbit check", "lab focus"])
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
