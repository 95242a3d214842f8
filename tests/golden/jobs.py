"""Which commands are frozen, and how one is run: as a user does, by its name, in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import dedent

import numpy as np
import tifffile

ROOT = Path(__file__).resolve().parents[2]
JOBS = "tests/golden/jobs"
"""Of the files that the commands are given, relative to the project's folder, where every command runs."""
LIMIT = 900.0
"""Seconds for one command; most take ten to thirty."""


def _edge(folder: Path) -> None:
    """A slanted edge with even noise, in 16 bits. Rounded to whole numbers it is the same on every processor."""
    (folder / "out").mkdir()  # where the command writes its curve; it makes no run folder
    rows, columns = np.mgrid[0:96, 0:96]
    across = columns - 47.6 - np.tan(np.radians(5.0)) * (rows - 48)
    light = 4000.0 + 20000.0 * (1.0 + np.tanh(across / 1.3))
    noise = np.random.default_rng(1).integers(-60, 61, (2, *light.shape))
    tifffile.imwrite(folder / "edge.tiff", (np.rint(light) + noise).astype(np.uint16))


def _bars(folder: Path) -> None:
    """Bars of period 4 pixels, slightly tilted, beside an even dark and an even bright patch."""
    (folder / "out").mkdir()
    rows, columns = np.mgrid[0:96, 0:128]
    wave = 0.5 + 0.3 * np.sin(2.0 * np.pi * (columns + 0.05 * rows) / 4.0)
    wave = np.where(columns >= 112, 1.0, np.where(columns >= 96, 0.0, wave))
    tifffile.imwrite(folder / "bars.tiff", np.rint(2000.0 + 40000.0 * wave).astype(np.uint16))


def _pass(folder: Path) -> None:
    """The run folder of a small simulated pass."""
    words = ["twin.orbit", "simulate", f"{JOBS}/simulate.yaml", "--out", str(folder / "pass"), "--quiet"]
    subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=True)


def _frames(folder: Path) -> None:
    """Frames of a small course as somebody might have recorded them: packed, a part of the CCD at the later times, with
    a column and a few pixels that are bad, whole numbers all of them; and the measurement's file.
    """
    words = ["twin.render", f"{JOBS}/course.yaml", "--out", str(folder / "run"), "--quiet"]
    subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=True)
    text = "instrument: gf7_pair\ndisturbances: launch\ntimes: [0 min, 12 min, 30 min]\nframes:\n"
    for camera in ("forward", "backward"):
        for side in ("left", "right"):
            name = f"{camera}_{side}"
            before, after = (tifffile.imread(folder / f"run/images/{name}_{k}.tiff") for k in ("before", "course"))
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


def _files(folder: Path) -> None:
    """The same pass as files, with what is to be measured in its images: a test for `match`."""
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


def _course(folder: Path) -> None:
    """The run folder of a small job with a course."""
    words = ["twin.render", f"{JOBS}/course.yaml", "--out", str(folder / "course"), "--quiet"]
    subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=True)


@dataclass(frozen=True)
class Job:
    """One command.

    Attributes:
        name: of the job and of its golden file.
        words: module and arguments; {jobs} is the folder of job files, {out} the run folder, {here} a folder of the
            job's own.
        prepare: makes files in the job's own folder that the command needs.
        promised: files whose numbers hold on other processors, too (docs/architecture.md, the same seed, the same
            bytes), with the relative tolerance there; 0 is the same to the byte.
    """

    name: str
    words: tuple[str, ...]
    prepare: Callable[[Path], None] | None = None
    promised: dict[str, float] = field(default_factory=dict)


def _job(name: str, words: str, **more) -> Job:
    return Job(name, tuple(words.split()), **more)


# What is printed has the truth in it.
# Angles of 1.5" move by 2e-11 of an arc second, images by 2e-15 of their peak, sums over an image by a little more.
PROMISED = {
    "truth.json": 1e-9,
    "recovered.json": 0.0,
    "stdout": 1e-9,
    "irradiance.nc": 1e-12,
    "images/": 0.0,
}
RUN = "{jobs}/%s.yaml --out {out}"
SET = {"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb", "PYTHONUTF8": "1", "OPENBLAS_CORETYPE": "Haswell"}
UNSET = ("FORCE_COLOR", "TTY_COMPATIBLE", "NPY_DISABLE_CPU_FEATURES")
"""Of the environment: linear algebra sums as on a processor with AVX2, whatever the machine has set."""
CHECKS = "000.fig3,001.eq2.cos2,001.eq8,003.equations,004.eq2.solution,004.eq3.solution,004.turntable.range,004.fig1"
ALL = (
    _job("render", f"twin.render {RUN % 'perturb'} --json --seed 5", promised=PROMISED),
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
    _job("lab_turntable", f"twin.lab turntable {RUN % 'turntable'} --json"),
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
    _job("orbit_export", "twin.orbit export {here}/pass --out {out}", prepare=_pass),
    _job("orbit_export_traced", f"twin.orbit export {RUN % 'angle_gf7'}"),
    _job("export", "twin.export {here}/course --out {out}", prepare=_course),
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
    _job("schema", "scenes.schema --out {out}"),
)
BY_NAME = {job.name: job for job in ALL}


@dataclass(frozen=True)
class Done:
    """A command that was run: exit code, what it printed, and where its run folder is (or would be)."""

    code: int
    stdout: str
    stderr: str
    out: Path
    here: Path


def run(job: Job, here: Path) -> Done:
    """The command in a process of its own, started in the project's folder.

    Args:
        job: what to run.
        here: an empty folder for it.

    Raises:
        subprocess.TimeoutExpired: it takes longer than LIMIT.
    """
    out = here / "out"
    if job.prepare is not None:
        job.prepare(here)
    places = {"jobs": JOBS, "out": str(out), "here": str(here)}
    words = [word.format(**places) for word in job.words]
    # a terminal's width and colours are no part of the result
    environment = {key: value for key, value in os.environ.items() if key not in UNSET} | SET
    done = subprocess.run(
        [sys.executable, "-m", *words],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    return Done(done.returncode, done.stdout, done.stderr, out, here)
