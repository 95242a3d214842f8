"""Every command states what it takes of memory and time, or why that is never much; more memory than there is every
model refuses in the same way, from the command line.
"""

import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tifffile

from scenes.specs.load import EXAMPLES, LAB, ORBIT, SCENES
from scenes.specs.procedures import Brief
from scenes.yaml.named import Named
from tests.twin.commands import files, invoke
from twin.run import command_costs
from twin.run.command_costs import every_cost
from twin.run.console import PROGRAMS, parser
from twin.run.memory import LIMIT


def commands() -> Iterator[str]:
    """Every command after ``camtwin``; one of several tests is named with it, as ``asbuilt estimate``."""
    for program, (module, _) in PROGRAMS.items():
        below = getattr(parser(module), "commands", {})
        yield from (f"{program} {name}" for name in below) if below else (program,)


def test_every_command_states_its_cost() -> None:
    """A model, or the reason why it needs none; and nothing is stated of what is no command."""
    stated = every_cost()
    assert set(stated) == set(commands())
    assert not set(command_costs.MODELS) & set(command_costs.BRIEF)
    for name, cost in stated.items():
        assert isinstance(cost, Named | Brief), f"{name}: no model of its memory and time, and no reason"
        if isinstance(cost, Brief):
            assert cost.reason.endswith("."), name
        else:
            assert callable(cost.get()), name


BEYOND: dict[str, tuple[str, str, str, str]] = {
    "lab focus": (f"{LAB}/focus.yaml", "frames: 4\n>frames: 9000\n|region: 64>region: 256", "frames", "frames"),
    "lab distortion": (f"{LAB}/distortion.yaml", "points: 55 >points: 900 |sets: 10 >sets: 900 ", "sets", "sets"),
    "orbit adjust": (f"{ORBIT}/adjust.yaml", "tie: 120>tie: 900000", "points.tie", "tie points"),
    "orbit calibrate": (
        f"{ORBIT}/calibrate_images.yaml",
        "  lines: 400>  lines: 9000|  pixels: 400>  pixels: 8000",
        *("images.lines", "lines and pixels"),
    ),
    "orbit simulate": (
        f"{ORBIT}/simulate.yaml",
        "lines: 1000, pixels: 1000>lines: 9000, pixels: 9000",
        *("patch.lines", "lines and pixels"),
    ),
    "tolerance": (f"{EXAMPLES.name}/tolerance_gf7.yaml", "samples: 1000>samples: 9000000", "samples", "samples"),
    "asbuilt estimate": (
        f"{EXAMPLES.name}/asbuilt_gf7.yaml",
        "prior: assembled>draws: 99000\nprior: assembled",
        *("draws", "draws"),
    ),
}
"""Command -> a file of ``scenes``, what stands there for what, the key that is named then, and the number's unit."""


def check_refused(done: object, file: Path | None, key: str, unit: str, folder: Path) -> None:
    """Exit code 2 with file, line, key and the number that fits; nothing was written."""
    assert done.exit_code == 2, done.output  # type: ignore[attr-defined]
    said = " ".join(done.stderr.split())  # type: ignore[attr-defined]
    assert re.search(rf"{re.escape(key)}: this needs about [\d.]+ GB of memory, and 1 GB may be taken", said), said
    assert re.search(rf"allowed: at most \d+ {unit}, or more memory", said), said
    if file is not None:
        assert re.search(rf"{re.escape(file.name)}:\d+: {re.escape(key)}", said), said
    assert files(folder) == ({file.name} if file is not None else set())


@pytest.mark.parametrize("name", BEYOND)
def test_more_memory_than_there_is_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place, edits, key, unit = BEYOND[name]
    text = (SCENES / place).read_text("utf-8")
    for old, new in (edit.split(">") for edit in edits.split("|")):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    file = tmp_path / "test.yaml"
    file.write_text(text, "utf-8")
    monkeypatch.setenv(LIMIT, "1 GB")
    program, _, command = name.partition(" ")
    module = PROGRAMS[program][0]
    app = importlib.import_module(module if module == "twin.lab" else f"{module}.__main__").app
    done = invoke(app, *([command] if command else []), file, "--out", tmp_path / "run")
    check_refused(done, file, key, unit, tmp_path)


def test_a_long_life_is_refused_by_its_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from twin.operate.__main__ import app

    monkeypatch.setenv(LIMIT, "1 GB")
    words = ("--from", "2027-01-01T00:00:00Z", "--days", "4000", "--every", "1h")
    done = invoke(app, "simulate", EXAMPLES / "operation.yaml", *words, "--out", tmp_path / "run")
    check_refused(done, None, "--every", "readings", tmp_path)


def test_a_long_series_of_frames_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the headers of the files, before any frame is read."""
    from twin.recover.__main__ import app

    tifffile.imwrite(tmp_path / "frames.tiff", np.zeros((3, 600, 600), np.uint16), photometric="minisblack")
    times = ", ".join(f"{k} min" for k in range(20))
    geometry = "{principal_distance: 5.5 m, separation: 0.2 m, pitch: 5 um}"
    each = f"{{before: frames.tiff, after: [{', '.join(['[frames.tiff]'] * 20)}]}}"
    file = tmp_path / "measurement.yaml"
    file.write_text(
        f"geometry: {{a: {geometry}}}\ndetector: monitor_ccd\nexposure: 10 ms\ntemplate: measured\n"
        f"times: [{times}]\nframes: {{a/left: {each}, a/right: {each}}}\n",
        "utf-8",
    )
    monkeypatch.setenv(LIMIT, "1 GB")
    done = invoke(app, file, "--out", tmp_path / "run")
    (tmp_path / "frames.tiff").unlink()
    check_refused(done, file, "times", "times", tmp_path)
