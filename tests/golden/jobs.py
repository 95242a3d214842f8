"""Which commands are frozen, and how they are run: one after the other in a process that imports the packages once."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[2]
JOBS = "tests/golden/jobs"
"""Of the files that the commands are given, relative to the project's folder, where every command runs."""
LIMIT = 900.0
"""Seconds for one command; most take a few."""
Finder = Callable[[str], Path]
"""Name of another job -> its run folder; it is run if it has not been."""


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
    words = ["twin.orbit", "simulate", f"{JOBS}/simulate.yaml", "--out", str(folder / "pass"), "--quiet"]
    words += ["--export", str(folder / "files")]
    subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=True)
    shutil.copy(ROOT / JOBS / "match.yaml", folder)


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
    prepare: Callable[[Path, Finder], Any] | None = None

    @property
    def words(self) -> tuple[str, ...]:
        """The first command."""
        return self.commands[0]


SET = {"COLUMNS": "500", "NO_COLOR": "1", "TERM": "dumb", "PYTHONUTF8": "1", "PYTHONHASHSEED": "0"}
SET |= {"OPENBLAS_CORETYPE": os.environ.get("OPENBLAS_CORETYPE", "Haswell")}
MEASURED = "TWIN_COVERAGE_OUT"
"""Set while the lines of each test are noted: every job then has a process without the memory of another."""
UNSET = ("FORCE_COLOR", "TTY_COMPATIBLE")
"""Of the environment: a terminal's width and colours are no part of the result."""
PREPARE = {
    "recover": _frames,
    "orbit_match": _files,
    "mtf_edge": _edge,
    "mtf_bars": _bars,
    "lens": lambda folder, run_folder: (folder / "out").mkdir(),
}


def _commands(told: str | list[str]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(command.split()) for command in ([told] if isinstance(told, str) else told))


TABLE = YAML(typ="safe").load((ROOT / "tests/golden/jobs.yaml").read_text("utf-8"))
ALL = tuple(Job(name, _commands(told), PREPARE.get(name)) for name, told in TABLE.items())
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
            environment |= {"TWIN_CALIBRATIONS": "off"} if MEASURED in os.environ else {}
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
        if MEASURED in os.environ:
            self.__exit__()
            self._process = None
        return dict(json.loads(answer))


def run(job: Job, here: Path) -> Done:
    """Return what a job leaves below an empty folder, run in a process of its own."""
    with Runner(here) as runner:
        return runner.run(job)
