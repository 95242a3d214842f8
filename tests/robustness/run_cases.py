"""What is fuzzed of run folders: manifests, results, data sets, images, what a study keeps; for all that opens them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer

from tests.golden.jobs import ROOT, _files
from tests.robustness.case import JOBS, Case, edited, job_of
from twin.camera.__main__ import app as camera
from twin.compare.__main__ import app as compare
from twin.export.__main__ import app as export
from twin.live.__main__ import app as live
from twin.orbit.__main__ import app as orbit
from twin.render import app as render
from twin.study.__main__ import app as study

BASES = {
    "render": "twin.render {jobs}/course.yaml --out {here}/run",
    "angle": "twin.orbit angle {jobs}/angle.yaml --out {here}/run",
    "study": "twin.study {jobs}/study_lab.yaml --workers 1 --out {here}/run",
    "monitored": "twin.study {here}/study.yaml --workers 1 --out {here}/run",
}
"""Run folder -> command that makes it."""
DRAWN = (".html", ".glb", ".png", ".svg", ".pdf")
"""Endings of files that nothing reads again: their beginning stands for them."""


def made(bases: Path, name: str) -> Path:
    """A base's folder; it is made if it is not there, whole or not at all."""
    place = bases / name
    if not place.is_dir():
        here = bases / f".{name}-{os.getpid()}"
        here.mkdir(parents=True)
        if name == "pass":
            _files(here)
        else:
            few = edited(job_of("study_render.yaml"), ("runs: 30", "runs: 5"), ("perturb.yaml", f"{JOBS}/perturb.yaml"))
            (here / "study.yaml").write_bytes(few)
            words = BASES[name].format(jobs=JOBS, here=here).split()
            subprocess.run([sys.executable, "-m", *words, "--quiet"], cwd=ROOT, check=True)
        if place.is_dir():
            shutil.rmtree(here)
        else:
            here.rename(place)
    return place


def _folder(place: Path, under: str = "run") -> dict[str, bytes]:
    """All files of a run folder, as files of a case."""
    found = {}
    for path in sorted(place.rglob("*")):
        if path.is_file():
            content = path.read_bytes()
            found[f"{under}/{path.relative_to(place).as_posix()}"] = content[:100] if path.suffix in DRAWN else content
    return found


def run_cases(bases: Path) -> Iterator[Case]:
    """All of them."""
    yield from _of_render(made(bases, "render") / "run")
    yield from _of_angle(made(bases, "angle") / "run")
    yield from _of_study(made(bases, "study") / "run", made(bases, "monitored") / "run")
    yield from _of_pass(made(bases, "pass"))


Readers = Mapping[str, tuple[typer.Typer, tuple[str, ...], dict[str, Any]]]
EXPORT: tuple[typer.Typer, tuple[str, ...], dict[str, Any]] = (export, (), {"whole": 1})
LIVE: tuple[typer.Typer, tuple[str, ...], dict[str, Any]] = (live, (), {"out": "", "options": ("--port", "0")})
COMPARE: tuple[typer.Typer, tuple[str, ...], dict[str, Any]] = (compare, ("{here}/other",), {"whole": 1})


def _each(prefix: str, files: Mapping[str, bytes], kinds: Mapping[str, str], readers: Readers) -> Iterator[Case]:
    """Every file for every command that opens the folder."""
    for name, (app, words, more) in readers.items():
        for target, kind in kinds.items():
            stem = target.removeprefix("run/").replace("/", "-")
            yield Case(f"{prefix}-{name}-{stem}", kind, app, words, files, target, given="run", weight=0.5, **more)


def _of_render(place: Path) -> Iterator[Case]:
    files = _folder(place)
    image = next(name for name in files if name.endswith("_before.tiff"))
    table = next(name for name in files if name.endswith(".csv"))
    kinds = {
        "run/manifest.json": "manifest",
        "run/config.yaml": "config of render",
        "run/recovered.json": "result of a run",
        "run/truth.json": "result of a run",
        "run/irradiance.nc": "netCDF of a run",
        "run/course.nc": "netCDF of a run",
        image: "TIFF of a run",
        table: "table of a run",
    }
    kinds = {target: kind for target, kind in kinds.items() if target in files}
    itself: Readers = {"export": EXPORT, "compare": (compare, ("{here}/run",), {"whole": 1})}
    yield from _each("run", files, kinds, itself)
    opened = {target: kinds[target] for target in ("run/manifest.json", "run/config.yaml")}
    yield from _each("run", files, opened, {"live": LIVE})
    yield Case("run-render-config", "config of render", render, (), files, "run/config.yaml", given="run/config.yaml")
    yield Case("run-camera-config", "config of render", camera, (), files, "run/config.yaml", ("--camera", "forward"),
               given="run/config.yaml", weight=0.5)  # fmt: skip


def _of_angle(place: Path) -> Iterator[Case]:
    files = {**_folder(place), **_folder(place, "other")}
    kinds = {"run/manifest.json": "manifest", "run/config.yaml": "config of an angle test"}
    kinds["run/angle.json"] = "result of a run"
    yield from _each("angles", files, kinds, {"compare": COMPARE, "export": EXPORT})


def _of_study(place: Path, monitored: Path) -> Iterator[Case]:
    files = _folder(place)
    chunk = next(name for name in files if name.endswith(".npz"))
    state = next(name for name in files if name.startswith("run/") and b'"fingerprint"' in files[name])
    kept = {name: files[name] for name in files if name.startswith("run/chunks/") or name == state}
    kept["run/config.yaml"] = files["run/config.yaml"]
    resumed: dict[str, Any] = {
        "options": ("--resume", "--workers", "1", "--out", "{here}/run"), "out": "", "whole": 8, "starts": True,
        "changes": ("run/",),
    }  # fmt: skip
    kinds = {state: "state of a study", "run/chunks/index.txt": "index of chunks", chunk: "chunk of a study"}
    for target, kind in kinds.items():
        own = {"study.yaml": files["run/config.yaml"], **kept}
        yield Case(f"resume-{Path(target).stem}", kind, study, (), own, target, **resumed)
    files = _folder(monitored)
    kinds = {
        "run/manifest.json": "manifest",
        "run/config.yaml": "config of study",
        "run/study.nc": "netCDF of a study",
        "run/study.json": "result of a study",
        "run/study.csv": "table of a run",
    }
    yield from _each("study", files, kinds, {"export": EXPORT, "compare": (compare, ("{here}/run",), {"whole": 1})})
    run = (live, (), {"out": "", "options": ("--port", "0", "--run", "3")})
    opened = {target: kinds[target] for target in ("run/manifest.json", "run/config.yaml")}
    yield from _each("study", files, opened, {"live": run})


def _of_pass(place: Path) -> Iterator[Case]:
    files = _folder(place / "pass")
    image = next(name for name in files if name.startswith("run/images/nadir"))
    kinds = {"run/manifest.json": "manifest", "run/config.yaml": "config of a simulation"}
    kinds |= {"run/simulate.json": "result of a run", image: "TIFF of a run"}
    yield from _each("pass", files, kinds, {"orbit": (orbit, ("export",), {}), "export": EXPORT})
    own = {"match.yaml": (place / "match.yaml").read_bytes()}
    for folder in ("pass/images", "files/simulate"):
        own |= _folder(place / folder, folder)
    kinds = {"match.yaml": "points to be matched", "pass/images/orthophoto.tiff": "GeoTIFF"}
    kinds |= {"pass/images/dem.tiff": "GeoTIFF", "pass/images/nadir.tiff": "line image"}
    for target, kind in kinds.items():
        yield Case(f"match-{Path(target).stem}", kind, orbit, ("match",), own, target, whole=30, weight=0.7)


__all__ = ["run_cases"]
