"""What commands take of memory and processor time, against what they say of it before they start."""

from __future__ import annotations

from pathlib import Path

import pytest

from scenes.specs.load import SCENES
from tests.limits.test_extremes import FACTOR, run

SHARED = 2.0
"""Further factor of time: programs that share a core's caches make imports and figures slower than the pace says."""
COMMAND, FILE = "distortion", SCENES / "lab/distortion.yaml"
EDITS = (("points: 55 ", "points: 40 "), ("sets: 10 ", "sets: 20 "))
"""Texts of the file, and what stands in their place: 800 spots."""


@pytest.mark.second
def test_a_command_takes_what_it_says(tmp_path: Path) -> None:
    text = FILE.read_text("utf-8")
    for old, new in EDITS:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    for other in FILE.parent.iterdir():  # beside the files that it names
        (tmp_path / other.name).symlink_to(other)
    (tmp_path / FILE.name).unlink()
    (tmp_path / FILE.name).write_text(text, "utf-8")
    took, said = run(tmp_path, "twin.lab", COMMAND, str(tmp_path / FILE.name))
    assert took["code"] == 0, said
    assert took["told_bytes"] / FACTOR < took["used"] < FACTOR * took["told_bytes"], took
    assert took["processor"] < FACTOR * SHARED * took["told_seconds"], took  # nobody waits longer than was said
