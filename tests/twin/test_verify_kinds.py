"""Which files a run has read, as its manifest names them for `python -m twin.verify`."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.golden.jobs import ROOT
from twin.verify.folder_state import folder_state

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
