"""Extreme instruments and studies are refused at once, at a key and with what would do, or they run; and what they take
of the memory is what was estimated.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from optics.numerics.backend import Backend
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from tests.limits.extremes import INSTRUMENTS_BEYOND, STUDIES_BEYOND, with_ccd
from tests.tiers import quick
from twin.monitor.monitor_experiment import MonitorExperiment

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 10.0
"""Of the processor, within which what is not done is refused."""
BYTES = 2**30
"""That it may take for that, beside the imported program."""
FACTOR = 1.5
"""Between an estimate and what is used."""
MEMORY = "4 GB"
"""That the commands may take here, whatever this machine has."""


def run(folder: Path, command: str, file: Path | str, *options: str) -> tuple[dict[str, Any], str]:
    """Return what a command took in a process of its own, and what it said on stderr."""
    arguments = [command, str(file), "--out", str(folder / "out"), "--quiet", *options]
    done = subprocess.run(
        [sys.executable, "-m", "tests.limits.measured", *arguments],
        cwd=ROOT,
        env={**os.environ, "TWIN_MEMORY": MEMORY},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


def refused(code: int, said: str, folder: Path) -> bool:
    """Return whether a command refused its file, rightly so; else it has run to the end."""
    if code == 0:
        assert (folder / "out" / "manifest.json").exists()
        return False
    assert code == 2, said
    assert re.search(r"^error: \S+\.(yaml|csv):\d+: \S+: ", said), said  # file, line and key
    assert "llowed: " in said or "did you mean" in said, said
    assert not (folder / "out").exists()
    return True


@pytest.mark.second
@pytest.mark.parametrize("name", INSTRUMENTS_BEYOND)
def test_an_extreme_instrument(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.twin.commands import invoke
    from twin.render import app

    monkeypatch.setenv("TWIN_MEMORY", MEMORY)
    done = invoke(app, INSTRUMENTS_BEYOND[name].write(tmp_path), "--out", tmp_path / "out", "--quiet")
    assert refused(done.exit_code, done.stderr, tmp_path) == (name != "pinhole of 1 nm")


@pytest.mark.second
@pytest.mark.parametrize("name", STUDIES_BEYOND)
def test_an_extreme_study(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.twin.commands import invoke
    from twin.study.__main__ import app

    monkeypatch.setenv("TWIN_MEMORY", MEMORY)
    file = STUDIES_BEYOND[name].write(tmp_path)
    done = invoke(app, file, "--out", tmp_path / "out", "--quiet", "--workers", 1)
    assert refused(done.exit_code, done.stderr, tmp_path)


@pytest.mark.second
@pytest.mark.parametrize(("side", "frames"), [(256, 100)])
def test_memory_is_what_was_estimated(side: int, frames: int, tmp_path: Path) -> None:
    took, said = run(tmp_path, "twin.render", with_ccd(side, frames).write(tmp_path))
    assert took["code"] == 0, said
    assert took["estimated"] / FACTOR < took["used"] < FACTOR * took["estimated"], took


@pytest.mark.second
def test_an_instrument_beyond_all_is_refused(tmp_path: Path) -> None:
    """Refused before anything of it is computed: little time and memory are taken."""
    took, said = run(tmp_path, "twin.render", INSTRUMENTS_BEYOND["CCD of 8192 x 8192 pixels"].write(tmp_path))
    assert refused(took["code"], said, tmp_path)
    assert took["processor"] < SECONDS
    assert took["used"] < BYTES
    assert re.search(r"monitor\.area_ccd\.rows: this needs about 1\d\d GB of memory", said)
    assert "and 4 GB may be used" in said
    told = re.search(r"at most (\d+) rows and columns", said)
    assert told is not None
    assert 1024 < int(told[1]) < 2048


@pytest.mark.parametrize("name", quick(1, ["conic of M1 a thousand times", "radius of M3 40 percent less"]))
def test_surfaces_that_make_no_image_are_named_first(name: str, tmp_path: Path, backend: Backend) -> None:
    """And not the prism or the baffle that their light then meets."""
    with pytest.raises(InputError) as caught:
        MonitorExperiment(resolve(INSTRUMENTS_BEYOND[name].write(tmp_path)), backend)
    first, *others = caught.value.issues
    assert Path(first.file).name == "camera.yaml"
    assert first.key == ("mirrors",)
    assert first.line is not None
    assert "form no image" in first.problem
    assert first.allowed is not None
    assert all(Path(one.file).name == "instrument.yaml" for one in others)
    assert others
