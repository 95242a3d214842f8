"""What commands take of memory and time, against what they say of it before they start.

The time is that of the processor, since a machine that does something else as well gives any wall time; it is compared
on the scale of `twin.run.cost.pace`, and a machine on which several programs share a core's caches makes imports and
figures slower than the pace says. No size here is one at which the rates of a model were fitted: `docs/limits.md` lists
both.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import tifffile

from scenes.specs.load import EXAMPLES, SCENES
from scenes.specs.procedures import Brief
from tests.limits.test_extremes import FACTOR, run
from twin.run.command_costs import every_cost


@dataclass(frozen=True)
class Sized:
    """A run of some size.

    Attributes:
        command: after ``camtwin``.
        file: below ``scenes``; the name of an instrument where there is none.
        edits: texts of it, each of which occurs once, and what stands in their place.
        options: further words.
        others: whether the processes that it starts take much of the time.
    """

    command: str
    file: str
    edits: tuple[tuple[str, str], ...] = ()
    options: tuple[str, ...] = ()
    others: bool = False


SIZES = {
    "patch of 500 x 500 pixels": Sized(
        "orbit simulate", "orbit/simulate.yaml", (("lines: 1000, pixels: 1000", "lines: 500, pixels: 500"),)
    ),
    "patch of 200 x 900 pixels": Sized(
        "orbit simulate", "orbit/simulate.yaml", (("lines: 1000, pixels: 1000", "lines: 200, pixels: 900"),)
    ),
    "2500 tie points": Sized("orbit adjust", "orbit/adjust.yaml", (("tie: 120", "tie: 2500"),)),
    "20 000 tie points": Sized("orbit adjust", "orbit/adjust.yaml", (("tie: 120", "tie: 20000"),)),
    "30 random states": Sized("uncertainty", "gf7_pair", options=("--states", "30")),
    "three campaigns": Sized("orbit calibrate", "orbit/calibrate.yaml", (("repeats: 12", "repeats: 3"),)),
    "jitter in 2000 points up to 30 Hz": Sized(
        "orbit jitter", "orbit/jitter.yaml", (("count: 800", "count: 2000"), ("highest: 15 Hz", "highest: 30 Hz"))
    ),
    "300 passes of 200 points": Sized(
        "orbit angle", "orbit/angle.yaml", (("points: 60,", "points: 200,"), ("passes: 200", "passes: 300"))
    ),
    "conventions by 100 points": Sized("orbit check", "orbit/measured/check.yaml", (("points: 40 ", "points: 100 "),)),
    "loop of 20 readings": Sized(
        "orbit loop",
        "orbit/loop.yaml",
        (("count: 25", "count: 20"), ("[40 min, 76 min], side: 400", "[40 min], side: 200")),
    ),
    "monitored orbit repeated 100 times": Sized(
        "orbit monitor", "orbit/monitor.yaml", (("repeats: 40", "repeats: 100"),)
    ),
    "alignment in three fields": Sized(
        "lab focus",
        "lab/focus.yaml",
        (("fields: [-0.9, -0.45, 0, 0.45, 0.9]", "fields: [-0.5, 0, 0.5]"), ("points: 9 ", "points: 11 ")),
    ),
    "800 spots": Sized(
        "lab distortion", "lab/distortion.yaml", (("points: 55 ", "points: 40 "), ("sets: 10 ", "sets: 20 "))
    ),
    "three starts": Sized("design camera", "examples/design_gf7_short.yaml", (("starts: 6", "starts: 3"),)),
    "monitor of eight beams": Sized(
        "design monitor",
        "examples/design_monitor_two.yaml",
        (
            (
                "{beams: 60, layouts: 2000, rounds: 6, changed: 20, exact: 6}",
                "{beams: 8, layouts: 40, rounds: 1, changed: 4, exact: 2}",
            ),
            ("ghost_paths: 100000", "ghost_paths: 10000"),
        ),
        ("--workers", "1"),
        others=True,
    ),
    "1500 cameras": Sized(
        "tolerance",
        "examples/tolerance_cassegrain.yaml",
        options=("--workers", "1", "--samples", "1500"),
        others=True,
    ),
    "800 draws as built": Sized(
        "asbuilt estimate", "examples/asbuilt_gf7.yaml", (("prior: assembled", "draws: 800\nprior: assembled"),)
    ),
    "life of 100 readings": Sized(
        "operate simulate",
        "examples/operation.yaml",
        options=("--from", "2027-01-01T00:00:00Z", "--days", "100", "--every", "1d", "--frames", "20"),
    ),
}
ELSEWHERE = {"render", "recover", "operate judge"}
"""Commands whose models are compared below or in `test_extremes`."""
UNCOMPARED = {"study", "orbit match", "validate", "lab turntable"}
"""Commands of which a run would need hours, or whose time no number of the file decides, as `docs/limits.md` says."""


def near(took: dict[str, float], others: bool = False) -> None:
    took = took | {"processor": took["processor"] + others * took["others"]}
    for told, used in (("told_bytes", "used"), ("told_seconds", "processor")):
        assert took[told] / FACTOR < took[used] < FACTOR * took[told], (told, took)


def test_every_model_has_a_size() -> None:
    models = {name for name, cost in every_cost().items() if not isinstance(cost, Brief)}
    assert models == {one.command for one in SIZES.values()} | ELSEWHERE | UNCOMPARED


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZES)
def test_a_command_takes_what_it_says(name: str, tmp_path: Path) -> None:
    one = SIZES[name]
    program, _, command = one.command.partition(" ")
    file = one.file
    if "/" in one.file:
        source = SCENES / one.file
        text = source.read_text("utf-8")
        for old, new in one.edits:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        # beside the files that it names
        for other in source.parent.iterdir():
            (tmp_path / other.name).symlink_to(other)
        (tmp_path / source.name).unlink()
        file = str(tmp_path / source.name)
        Path(file).write_text(text, "utf-8")
    module = "twin.lab" if program == "lab" else f"twin.{program}.__main__"
    words = (command, file) if command else (file,)
    took, said = run(tmp_path, module, *words, *one.options)
    assert took["code"] == 0, said
    near(took, one.others)


@pytest.mark.slow
def test_stray_light(tmp_path: Path) -> None:
    job = tmp_path / "job.yaml"
    job.write_text("instrument: gf7_pair\nrender: {frames: 3, seed: 1, stray: {paths: 200000}}\n", "utf-8")
    took, said = run(tmp_path, "twin.render", job)
    assert took["code"] == 0, said
    near(took)


@pytest.mark.slow
def test_measured_frames(tmp_path: Path) -> None:
    """Thirty times of twelve frames, each of other noise."""
    _rendered(tmp_path, frames=12 * 31)
    text = f"instrument: gf7_pair\ntimes: [{', '.join(f'{k} min' for k in range(30))}]\nframes:\n"
    for name in ("forward/left", "forward/right", "backward/left", "backward/right"):
        stem = tmp_path / "made" / "out" / "images" / name.replace("/", "_")
        frames = tifffile.imread(f"{stem}_before.tiff").reshape(31, 12, 96, 96)
        files = []
        for k, some in enumerate(frames):
            files.append(f"{stem}_{k}.tiff")
            tifffile.imwrite(files[-1], some, photometric="minisblack")
        after = ", ".join(f"[{one}]" for one in files[1:])
        text += f"  {name}: {{before: {files[0]}, after: [{after}]}}\n"
    (tmp_path / "measurement.yaml").write_text(text, "utf-8")
    took, said = run(tmp_path, "twin.recover.__main__", tmp_path / "measurement.yaml")
    assert took["code"] == 0, said
    near(took)


@pytest.mark.slow
def test_ten_thousand_measured_frames_take_no_more_than_a_gibibyte(tmp_path: Path) -> None:
    _rendered(tmp_path, frames=10_000)
    (tmp_path / "measurement.yaml").write_text("instrument: gf7_pair\nframes: made/out/images\n", "utf-8")
    took, said = run(tmp_path, "twin.recover.__main__", tmp_path / "measurement.yaml")
    assert took["code"] == 0, said
    near(took)
    assert took["used"] < 2**30


@pytest.mark.slow
def test_a_life_that_is_judged(tmp_path: Path) -> None:
    words = ("--from", "2027-01-01T00:00:00Z", "--days", "40", "--every", "1d", "--frames", "3")
    (tmp_path / "made").mkdir()
    made, said = run(tmp_path / "made", "twin.operate.__main__", "simulate", EXAMPLES / "operation.yaml", *words)
    assert made["code"] == 0, said
    took, said = run(tmp_path, "twin.operate.__main__", "judge", tmp_path / "made" / "out")
    assert took["code"] == 0, said
    near(took)


def _rendered(folder: Path, frames: int) -> None:
    """Frames of gf7_pair before and after, which did not move."""
    (folder / "made").mkdir()
    made, said = run(folder / "made", "twin.render", EXAMPLES / "aligned.yaml", "--frames", str(frames))
    assert made["code"] == 0, said
