"""`python -m twin.lab` as a user runs it: results, the run folder, exit codes, messages."""

import re
from functools import partial
from pathlib import Path

import pytest

import twin.lab as command
from scenes.specs.load import LAB, LIBRARY, SCENES
from tests.tiers import quick
from tests.twin.commands import invoke, refused
from tests.twin.study_bench import REFUSED

run = partial(invoke, command.app)
FOCUS = SCENES / LAB / "focus.yaml"
BANDS, FIELDS = ("B1", "B4"), ("-0.9", "0.9")
CHANGES = {
    "camera: gf7\n": "camera: own_camera.yaml\n",
    "fields: [-0.9, -0.45, 0, 0.45, 0.9]": "fields: [-0.9, 0.9]",
    "points: 9": "points: 7",
    "half_range: 1.4 mm": "half_range: 0.5 mm",
    "step: 0.08 mm": "step: 0.15 mm",
    "shift: [0.2 mm, 0.2 mm, 0.3 mm]": "shift: [0.1 mm, 0.1 mm, 0.1 mm]",
}


def write_focus(folder: Path, **changes: str) -> Path:
    """A focus test of two narrow bands and two fields, with more changes of its text."""
    camera = (LIBRARY / "cameras" / "gf7.yaml").read_text("utf-8")
    for band in ("P", "B2", "B3"):
        camera, count = re.subn(rf"  {band}:\n.*\n.*\n", "", camera, count=1)
        assert count == 1
    (folder / "own_camera.yaml").write_text(camera.replace("name: gf7", "name: own_camera"), "utf-8")
    text = FOCUS.read_text("utf-8")
    for old, new in {**CHANGES, **changes}.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "small.yaml"
    path.write_text(text, "utf-8")
    return path


@pytest.mark.parametrize("name", quick(3, REFUSED["focus_tests"]))
def test_bad_input(name: str, tmp_path: Path) -> None:
    changes, key, words = REFUSED["focus_tests"][name]
    path = write_focus(tmp_path, **changes)
    line = refused(run, "focus", path, key, words)
    # the line it names is the one that holds the key
    assert key.split(".")[-1] in path.read_text("utf-8").splitlines()[line - 1]


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    result = run("focus", tmp_path / "none.yaml", "--out", tmp_path / "run")
    assert result.exit_code == 2
    assert "none.yaml: no such file" in result.stderr
    assert list(tmp_path.iterdir()) == []
