"""What is fuzzed of run folders: manifests, results, data sets, images, what a study keeps; for all that opens them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer

from tests.golden.jobs import ROOT, _files
from tests.robustness.case import JOBS, Case, file_of

BASES = {
    "render": "twin.render {jobs}/course.yaml --out {here}/run",
    "angle": "twin.orbit angle {jobs}/angle.yaml --out {here}/run",
    "study": "twin.study {jobs}/study_lab.yaml --workers 1 --out {here}/run",
    "monitored": "twin.study {here}/study.yaml --workers 1 --out {here}/run",
}
"""Run folder -> command that makes it."""
DRAWN = (".html", ".glb", ".png", ".svg", ".pdf")
"""Endings of files that nothing reads again: their beginning stands for them."""
OPENED = ("manifest.json", "config.yaml", ".json", ".nc", "_before.tiff", ".csv")
"""Endings of files that are corrupted, one of each."""


def made(bases: Path, name: str) -> Path:
    """A base's folder; it is made if it is not there, whole or not at all."""
    place = bases / name
    if not place.is_dir():
        here = bases / f".{name}-{os.getpid()}"
        here.mkdir(parents=True)
        if name == "pass":
            _files(here)
        else:
            few = (("runs: 30", "runs: 5"), ("perturb.yaml", f"{JOBS}/perturb.yaml"))
            (here / "study.yaml").write_bytes(file_of("study_render.yaml", *few))
            words = BASES[name].format(jobs=JOBS, here=here).split()
            subprocess.run([sys.executable, "-m", *words, "--quiet"], cwd=ROOT, check=True)
        shutil.rmtree(here) if place.is_dir() else here.rename(place)
    return place


def _folder(place: Path, under: str = "run") -> dict[str, bytes]:
    """All files of a run folder, as files of a case."""
    return {
        f"{under}/{path.relative_to(place).as_posix()}": path.read_bytes()[: 100 if path.suffix in DRAWN else None]
        for path in sorted(place.rglob("*"))
        if path.is_file()
    }


def run_cases(bases: Path, app_of: Callable[[str], typer.Typer]) -> Iterator[Case]:
    """Yield one file of each ending for every command that opens the folder; ``app_of`` has the programs by name."""
    names = ("camera", "compare", "export", "live", "orbit", "render", "study")
    camera, compare, export, live, orbit, render, study = map(app_of, names)
    whole: dict[str, Any] = {"whole": 1}
    port = {"out": "", "options": ("--port", "0")}
    readers = {
        "render": ((export, (), whole), (compare, ("{here}/run",), whole), (live, (), port)),
        "angle": ((export, (), whole), (compare, ("{here}/run",), whole)),
        "monitored": ((export, (), whole), (live, (), {"out": "", "options": ("--port", "0", "--run", "3")})),
        "pass": ((export, (), {}), (orbit, ("export",), {})),
    }
    for base, commands in readers.items():
        files = _folder(made(bases, base) / ("pass" if base == "pass" else "run"))
        for ending in OPENED:
            target = next((name for name in files if name.endswith(ending)), None)
            for k, (app, words, more) in enumerate(commands if target else ()):
                name = f"run-{base}-{k}-{target[4:].replace('/', '-')}"
                yield Case(name, f"{ending} of a run", app, words, files, target, given="run", weight=0.5, **more)
        if base == "render":
            given = "run/config.yaml"
            yield Case("run-render-config", "config of render", render, (), files, given, given=given)
            one = ("--camera", "forward")
            yield Case("run-camera-config", "config of render", camera, (), files, given, one, given=given)
    yield from _resumed(_folder(made(bases, "study") / "run"), study)
    place = made(bases, "pass")
    own = {"match.yaml": (place / "match.yaml").read_bytes()}
    for folder in ("pass/images", "files/simulate"):
        own |= _folder(place / folder, folder)
    for target in ("match.yaml", "pass/images/orthophoto.tiff", "pass/images/dem.tiff", "pass/images/nadir.tiff"):
        yield Case(f"match-{Path(target).stem}", "points to be matched", orbit, ("match",), own, target, whole=30)


def _resumed(files: dict[str, bytes], study: typer.Typer) -> Iterator[Case]:
    """A study that goes on from what it kept."""
    target = "run.blocks/blocks.journal"
    own = {"study.yaml": files["run/config.yaml"], "run.blocks/.lock": b"", target: files["run/blocks.journal"]}
    more: dict[str, Any] = {"out": "", "whole": 8, "starts": True, "changes": ("run.blocks/", "run/", ".run.")}
    more["options"] = ("--resume", "--workers", "1", "--out", "{here}/run")
    yield Case("resume-journal", "state of a study", study, (), own, target, **more)
