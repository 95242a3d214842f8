"""What commands say beforehand of their memory and time, at two sizes each, against what they take.

Memory is the largest resident one of a process of its own. Time is that of the processor, since a machine that does
something else as well gives any wall time; it is compared on the scale of `twin.run.cost.pace`, and a machine on which
several programs share a core's caches makes imports and figures slower than the pace says.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from scenes.specs.load import SCENES
from tests.limits.test_extremes import FACTOR, run

ORBIT = SCENES / "orbit"
SIZES: dict[str, tuple[str, str, str]] = {
    "patch of 300 x 300 pixels": ("simulate", "lines: 1000, pixels: 1000", "lines: 300, pixels: 300"),
    "patch of 700 x 700 pixels": ("simulate", "lines: 1000, pixels: 1000", "lines: 700, pixels: 700"),
    "120 tie points": ("adjust", "tie: 120", "tie: 120"),
    "8000 tie points": ("adjust", "tie: 120", "tie: 8000"),
}
"""Name -> the command, whose test stands in scenes/orbit, and a text of it with what stands in its place."""


def near(took: dict[str, float]) -> None:
    for told, used in (("told_bytes", "used"), ("told_seconds", "processor")):
        assert took[told] / FACTOR < took[used] < FACTOR * took[told], (told, took)


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZES)
def test_a_test_in_orbit(name: str, tmp_path: Path) -> None:
    command, old, new = SIZES[name]
    text = (ORBIT / f"{command}.yaml").read_text("utf-8")
    assert text.count(old) == 1
    file = tmp_path / "test.yaml"
    file.write_text(text.replace(old, new), "utf-8")
    took, said = run(tmp_path, "twin.orbit.__main__", command, str(file))
    assert took["code"] == 0, said
    near(took)


@pytest.mark.slow
@pytest.mark.parametrize("states", [8, 72])
def test_random_states(states: int, tmp_path: Path) -> None:
    took, said = run(tmp_path, "twin.uncertainty.__main__", "gf7_pair", "--states", str(states))
    assert took["code"] == 0, said
    near(took)


@pytest.mark.slow
@pytest.mark.parametrize("paths", [100_000, 400_000])
def test_stray_light(paths: int, tmp_path: Path) -> None:
    job = tmp_path / "job.yaml"
    job.write_text(f"instrument: gf7_pair\nrender: {{frames: 3, seed: 1, stray: {{paths: {paths}}}}}\n", "utf-8")
    took, said = run(tmp_path, "twin.render", job)
    assert took["code"] == 0, said
    near(took)
