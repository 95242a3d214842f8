"""Which commands are frozen, and how they are run: one after the other in a process that imports the packages once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import tifffile

ROOT = Path(__file__).resolve().parents[2]
JOBS = "tests/golden/jobs"
"""Of the files that the commands are given, relative to the project's folder, where every command runs."""
LIMIT = 900.0
"""Seconds for one command; most take a few."""
Finder = Callable[[str], Path]
"""Name of another job -> its run folder; it is run if it has not been."""


def _folder(folder: Path, run_folder: Finder) -> None:
    """Make the folder in which a command writes files that is no run folder."""
    (folder / "out").mkdir()


def _edge(folder: Path, run_folder: Finder) -> None:
    """A slanted edge with even noise, in 16 bits. Rounded to whole numbers it is the same on every processor."""
    (folder / "out").mkdir()  # where the command writes its curve; it makes no run folder
    rows, columns = np.mgrid[0:96, 0:96]
    across = columns - 47.6 - np.tan(np.radians(5.0)) * (rows - 48)
    light = 4000.0 + 20000.0 * (1.0 + np.tanh(across / 1.3))
    noise = np.random.default_rng(1).integers(-60, 61, (2, *light.shape))
    tifffile.imwrite(folder / "edge.tiff", (np.rint(light) + noise).astype(np.uint16))


def _bars(folder: Path, run_folder: Finder) -> None:
    """Bars of period 4 pixels, slightly tilted, beside an even dark and an even bright patch."""
    (folder / "out").mkdir()
    rows, columns = np.mgrid[0:96, 0:128]
    wave = 0.5 + 0.3 * np.sin(2.0 * np.pi * (columns + 0.05 * rows) / 4.0)
    wave = np.where(columns >= 112, 1.0, np.where(columns >= 96, 0.0, wave))
    tifffile.imwrite(folder / "bars.tiff", np.rint(2000.0 + 40000.0 * wave).astype(np.uint16))


def _frames(folder: Path, run_folder: Finder) -> None:
    """Frames of a small course as somebody might have recorded them: packed, a part of the CCD at the later times, with
    a column and a few pixels that are bad, whole numbers all of them; and the measurement's file.
    """
    course = run_folder("render_course")
    text = "instrument: gf7_pair\ndisturbances: launch\ntimes: [0 min, 12 min, 30 min]\nframes:\n"
    for camera in ("forward", "backward"):
        for side in ("left", "right"):
            name = f"{camera}_{side}"
            before, after = (tifffile.imread(course / f"images/{name}_{k}.tiff") for k in ("before", "course"))
            if name == "forward_left":
                for frames in (before, after):
                    frames[:, :, 20] = 100
                    frames[:, 60:62, 70] += 900
            tifffile.imwrite(folder / f"{name}_b.tiff", before, compression="lzw", photometric="minisblack")
            for k, frame in enumerate(after[:, 4:90, 6:92]):
                tifffile.imwrite(folder / f"{name}_{k}.tiff", frame, photometric="minisblack")
            files = ", ".join(f"{name}_{k}.tiff" for k in range(len(after)))
            text += f"  {camera}/{side}: {{before: {name}_b.tiff, after: [{files}], offset_after: [4, 6]}}\n"
    (folder / "frames.yaml").write_text(text)


def _files(folder: Path, run_folder: Finder | None = None) -> None:
    """The same pass as files, with what is to be measured in its images: a test for `match`."""
    if not (folder / "pass").exists():
        words = ["twin.orbit", "simulate", f"{JOBS}/simulate.yaml", "--out", str(folder / "pass"), "--quiet"]
        words += ["--export", str(folder / "files")]
        subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=True)
    lines = json.loads((folder / "pass/simulate.json").read_text())["lines"]
    clock = "time_scale: UTC, epoch: 2011-03-05T03:05:00Z"
    text = f"""
        name: match
        camera: th1
        platform:
          orbit: {{file: files/simulate/orbit.csv, frame: ITRS, {clock}}}
          attitude:
            {{file: files/simulate/attitude.csv, frame: ITRS, {clock}, scalar: last, turns: body_to_frame,
            body_axes: [forward, right, down]}}
        lines: {{file: files/simulate/lines.csv, {clock}, moment: middle}}
        orthophoto: {{file: pass/images/orthophoto.tiff}}
        dem: {{file: pass/images/dem.tiff}}
        control_sigma: [1 m, 2 m]
        points: {{control: 40, check: 20, tie: 30, reach: 40, template: 31}}
        images:
        """
    images = [
        f"  {name}: {{file: pass/images/{name}.tiff, first_line: {line['first_line']}, "
        f"first_pixel: {line['first_pixel']}, first_pixel_sees: right}}\n"
        for name, line in lines.items()
    ]
    (folder / "match.yaml").write_text(dedent(text).lstrip().rstrip(" ") + "".join(images))


@dataclass(frozen=True)
class Job:
    """One command, or several that work on the same files.

    Attributes:
        name: of the job and of its golden file.
        commands: module and arguments of each; {jobs} is the folder of job files, {out} the run folder, {here} a folder
            of the job's own, and the name of another job in braces its run folder.
        prepare: makes files in the job's own folder that the commands need.
    """

    name: str
    commands: tuple[tuple[str, ...], ...]
    prepare: Callable[[Path, Finder], None] | None = None

    @property
    def words(self) -> tuple[str, ...]:
        """The first command."""
        return self.commands[0]


def _job(name: str, *commands: str, **more: Any) -> Job:
    return Job(name, tuple(tuple(command.split()) for command in commands), **more)


RUN = "{jobs}/%s.yaml --out {out}"
SET = {"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb", "PYTHONUTF8": "1", "PYTHONHASHSEED": "0"}
SET |= {"OPENBLAS_CORETYPE": os.environ.get("OPENBLAS_CORETYPE", "Haswell")}
UNSET = ("FORCE_COLOR", "TTY_COMPATIBLE")
"""Of the environment: a terminal's width and colours are no part of the result."""
CHECKS = "000.fig3,001.eq2.cos2,001.eq8,003.equations,004.eq2.solution,004.eq3.solution,004.turntable.range,004.fig1"
ALL = (
    _job("render", f"twin.render {RUN % 'perturb'} --json --seed 5"),
    _job("render_energy", f"twin.render {RUN % 'heated'}"),
    _job("render_targets", f"twin.render {RUN % 'targets'}"),
    _job("render_stars", f"twin.render {RUN % 'stars'} --quiet"),
    _job("render_course", f"twin.render {RUN % 'course'} --json"),
    _job("render_stray", f"twin.render {RUN % 'stray'}"),
    _job("render_deformed", f"twin.render {RUN % 'deformed'} --quiet"),
    _job("render_warmed", f"twin.render {RUN % 'warmed'} --quiet"),
    _job("render_refused", f"twin.render {RUN % 'bad'}"),
    _job("recover", "twin.recover {here}/frames.yaml --out {out} --json", prepare=_frames),
    _job("uncertainty", "twin.uncertainty gf7_pair --states 4 --seed 5 --out {out}"),
    _job("lab_focus", f"twin.lab focus {RUN % 'focus'} --seed 5"),
    _job("lab_distortion", f"twin.lab distortion {RUN % 'distortion'}"),
    _job("lab_turntable", f"twin.lab turntable {RUN % 'turntable'} --json --seed 3"),
    _job("lab_focus_measured", "twin.lab focus scenes/lab/measured/focus.yaml --out {out}"),
    _job("lab_turntable_measured", "twin.lab turntable scenes/lab/measured/turntable.yaml --out {out} --json"),
    _job("orbit_simulate", f"twin.orbit simulate {RUN % 'simulate'}"),
    _job("orbit_adjust", f"twin.orbit adjust {RUN % 'adjust'} --without tracker_angles"),
    _job("orbit_angle", f"twin.orbit angle {RUN % 'angle'} --json"),
    _job("orbit_angle_traced", f"twin.orbit angle {RUN % 'angle_gf7'}"),
    _job("orbit_angle_off_axis", f"twin.orbit angle {RUN % 'angle_off_axis'}"),
    _job("orbit_calibrate", f"twin.orbit calibrate {RUN % 'calibrate'}"),
    _job("orbit_calibrate_monitor", f"twin.orbit calibrate {RUN % 'calibrate_monitor'}"),
    _job("orbit_calibrate_strip", f"twin.orbit calibrate {RUN % 'calibrate_strip'}"),
    _job("orbit_calibrate_images", f"twin.orbit calibrate {RUN % 'calibrate_images'}"),
    _job("orbit_adjust_measured", "twin.orbit adjust scenes/orbit/measured/adjust.yaml --out {out} --json"),
    _job("orbit_angle_measured", "twin.orbit angle scenes/orbit/measured/angle.yaml --out {out} --quiet"),
    _job("orbit_calibrate_measured", "twin.orbit calibrate scenes/orbit/measured/calibrate.yaml --out {out}"),
    _job("orbit_check", "twin.orbit check scenes/orbit/measured/check.yaml --out {out}"),
    _job("orbit_jitter", f"twin.orbit jitter {RUN % 'jitter'} --json"),
    _job("orbit_jitter_measured", "twin.orbit jitter scenes/orbit/measured/jitter.yaml --out {out} --quiet"),
    _job("orbit_loop", f"twin.orbit loop {RUN % 'loop'}"),
    _job("orbit_match", "twin.orbit match {here}/match.yaml --out {out}", prepare=_files),
    _job("orbit_monitor", f"twin.orbit monitor {RUN % 'monitor'}"),
    _job("orbit_export", "twin.orbit export {orbit_simulate} --out {out}"),
    _job("orbit_export_traced", f"twin.orbit export {RUN % 'angle_gf7'}"),
    _job("export", "twin.export {render_course} --out {out}"),
    _job("study_render", f"twin.study {RUN % 'study_render'} --workers 1"),
    _job("study_lab", f"twin.study {RUN % 'study_lab'} --workers 1 --quiet"),
    _job("study_orbit", f"twin.study {RUN % 'study_orbit'} --workers 2 --json"),
    _job("study_gradient", f"twin.study {RUN % 'study_gradient'} --gradient"),
    _job("design", f"twin.design {RUN % 'design'}"),
    _job("design_monitor", f"twin.design monitor {RUN % 'design_monitor'} --workers 2 --quiet"),
    _job("camera", "twin.camera --refocus monitor --out {out}"),
    _job("validate", f"twin.validate --fast --only {CHECKS} --out {{out}}"),
    _job("validate_bench", "twin.validate --fast --only 001.table2 --out {out} --json"),
    _job("validate_list", "twin.validate --list --json"),
    _job(
        "mtf_edge",
        "analysis.mtf {here}/edge.tiff --roi 8,8,80,80 --pitch 7um --json --csv {out}/curve.csv --plot {out}/curve.svg",
        prepare=_edge,
    ),
    _job(
        "mtf_bars",
        "analysis.mtf {here}/bars.tiff --roi 16,16,64,64 --pitch 7um --bars 0.25cycles/pixel"
        " --dark 16,98,64,12 --bright 16,114,64,12",
        prepare=_bars,
    ),
    _job("tolerance", f"twin.tolerance {RUN % 'tolerance'} --workers 1"),
    _job(
        "asbuilt",
        f"twin.asbuilt estimate {RUN % 'asbuilt'}",
        "twin.asbuilt check {jobs}/asbuilt_check.yaml --out {out}/checked",
    ),
    _job(
        "operate",
        "twin.operate simulate {jobs}/operation.yaml {out}/record --from 2025-01-01T00:00:00Z --days 120 --every 10d"
        " --frames 1 --event safe_mode@2025-02-14T06:00:00Z",
        "twin.operate status {out}/record --json",
        "twin.operate forecast {out}/record --json",
        "twin.operate exclude {out}/record 3 --why test --json",
        "twin.operate status {out}/record",
        "twin.operate alarms {out}/record --json",
        "twin.operate products {out}/record --time 2025-04-01T00:00:00Z --out {out}/products",
        "twin.operate export {out}/record --out {out}/tables",
        "twin.operate report {out}/record --out {out}/day.html",
        "twin.operate judge {out}/record --out {out}/judged",
        "tests.golden.visit {out}/served twin.operate serve {out}/record",
    ),
    _job(
        "operate_ingest",
        "twin.operate init {here}/record gf7_pair --simulated",
        "twin.operate ingest {here}/record scenes/examples/telemetry.yaml --json",
        "twin.operate ingest {here}/record {render_course} --time 2026-03-05T03:05:00Z",
        "twin.operate export {here}/record --out {out}",
    ),
    _job(
        "lens",
        "scenes.lens read scenes/examples/cassegrain.zmx --out {here}/out/read.yaml",
        "scenes.lens write {here}/out/read.yaml --out {here}/out/again.zmx",
        "scenes.lens write gf7 --out {here}/out/gf7.yaml",
        prepare=_folder,
    ),
    _job("compare", "twin.compare {lab_focus} {lab_focus_measured} --out {out}"),
    _job("verify", "twin.verify {lab_focus_measured} --json", "twin.verify {orbit_angle_measured} --files"),
    _job("live", "tests.golden.visit {out} twin.live gf7_pair --stay"),
    _job("schema", "scenes.schema --out {out}"),
)
BY_NAME = {job.name: job for job in ALL}


@dataclass(frozen=True)
class Printed:
    """What a command left: exit code and what it printed."""

    code: int
    stdout: str
    stderr: str


@dataclass(frozen=True)
class Done:
    """A job that was run: what its commands left, where its run folder is (or would be), and the seconds it took."""

    printed: tuple[Printed, ...]
    out: Path
    here: Path
    seconds: float = 0.0

    @property
    def stderr(self) -> str:
        """What all commands said there."""
        return "".join(one.stderr for one in self.printed)


class Runner:
    """Runs jobs below a folder, in a process that it starts; a job that others need is run once.

    Args:
        folder: that exists.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._done: dict[str, Done] = {}
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            self._process.wait()

    def run(self, job: Job) -> Done:
        """Return what a job leaves."""
        if job.name not in self._done:
            here = self.folder / job.name
            here.mkdir()
            if job.prepare is not None:
                job.prepare(here, lambda name: self.run(BY_NAME[name]).out)
            printed, seconds = [], 0.0
            for words in job.commands:
                needed = {word[1:-1] for word in words if word[1:-1] in BY_NAME}
                places = {name: str(self.run(BY_NAME[name]).out) for name in needed}
                places |= {"jobs": JOBS, "out": str(here / "out"), "here": str(here)}
                told = self._ask([word.format(**places) for word in words])
                seconds += told.pop("seconds")
                printed.append(Printed(**told))
            self._done[job.name] = Done(tuple(printed), here / "out", here, seconds)
        return self._done[job.name]

    def _ask(self, words: list[str]) -> dict[str, Any]:
        """Return what the process answers to a command.

        Raises:
            RuntimeError: the process ended.
        """
        if self._process is None:
            environment = {key: value for key, value in os.environ.items() if key not in UNSET} | SET
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.golden.worker"],
                cwd=ROOT,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        watch = threading.Timer(LIMIT, process.kill)
        watch.start()
        process.stdin.write(json.dumps(words) + "\n")
        process.stdin.flush()
        answer = process.stdout.readline()
        watch.cancel()
        if not answer:
            self._process = None
            raise RuntimeError(f"the process ended, with {process.wait()}, over {' '.join(words)}")
        return dict(json.loads(answer))


def run(job: Job, here: Path) -> Done:
    """Return what a job leaves below an empty folder, run in a process of its own."""
    with Runner(here) as runner:
        return runner.run(job)
