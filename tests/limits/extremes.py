"""Extreme instruments and studies: what is changed in the reference ones, as text of their files."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from scenes.specs.load import CAMERAS, DETECTORS, EXAMPLES, INSTRUMENTS, LIBRARY

Edit = tuple[str, str]
"""Pattern that occurs in a file, and what stands in its place."""


@dataclass(frozen=True)
class Extreme:
    """Edits of gf7_pair, gf7 and monitor_ccd for an instrument that nobody would build, and frames of each state."""

    instrument: tuple[Edit, ...] = ()
    camera: tuple[Edit, ...] = ()
    detector: tuple[Edit, ...] = ()
    frames: int = 3

    def write(self, folder: Path) -> Path:
        """Write its files to a folder and return the path of the job."""
        edits = (*self.instrument, (r"camera: gf7\b", "camera: ./camera.yaml"), ("monitor_ccd", "./detector.yaml"))
        for source, name, changes in (
            (LIBRARY / INSTRUMENTS / "gf7_pair.yaml", "instrument.yaml", edits),
            (LIBRARY / CAMERAS / "gf7.yaml", "camera.yaml", self.camera),
            (LIBRARY / DETECTORS / "monitor_ccd.yaml", "detector.yaml", self.detector),
        ):
            text = source.read_text("utf-8")
            for pattern, new in changes:
                text, count = re.subn(pattern, new, text)
                assert count, f"{source}: no {pattern!r}"
            (folder / name).write_text(text, "utf-8")
        job = folder / "job.yaml"
        job.write_text(f"instrument: ./instrument.yaml\nrender: {{frames: {self.frames}, seed: 1}}\n", "utf-8")
        return job


def with_ccd(side: int, frames: int = 3) -> Extreme:
    """Return the reference instrument with square area CCDs of another size."""
    return Extreme(((r"rows: 96, columns: 96", f"rows: {side}, columns: {side}"),), frames=frames)


def _monitor(key: str, value: str) -> Extreme:
    return Extreme(((rf"\b{key}: [-\d.e+]+( \w+)?", f"{key}: {value}"),))


def _mirror(mirror: str, key: str, factor: float, focal_length: str = "5.52 m") -> Extreme:
    """Return the instrument with a number of a mirror changed; ``focal_length`` is what the file states then."""
    found = re.search(
        rf"  {mirror}:\n(.*\n)*?    {key}: (-?[\d.]+)", (LIBRARY / CAMERAS / "gf7.yaml").read_text("utf-8")
    )
    assert found is not None
    edits = ((re.escape(f"{key}: {found[2]}"), f"{key}: {factor * float(found[2])!r}"),)
    return Extreme(camera=(*edits, (r"focal_length: 5\.52 m", f"focal_length: {focal_length}")))


INSTRUMENTS_BEYOND: Mapping[str, Extreme] = {
    "CCD of 8192 x 8192 pixels": with_ccd(8192),
    "10 000 frames of 4096 x 4096 pixels": with_ccd(4096, 10_000),
    "pinhole of 1 nm": _monitor("pinhole", "1 nm"),
    "pinhole of 1 m": _monitor("pinhole", "1 m"),
    "pitch of 120 um": _monitor("pitch", "120 um"),
    "radius of M1 a thousandth": _mirror("M1", "radius", 1e-3),
    "radius of M3 40 percent less": _mirror("M3", "radius", 0.6, "3.21 m"),
    "conic of M1 a thousand times": _mirror("M1", "conic", 1e3, "3.12 m"),
    "field of 44 deg": _monitor("field", "44 deg"),
    "aperture of 1 um": _monitor("aperture", "1 um"),
    "prism 100 km away": _monitor("distance", "100 km"),
    "wavelength of 10 nm": _monitor("wavelength", "10 nm"),
    "wavelength of 20 um": _monitor("wavelength", "20 um"),
    "one bit": Extreme(detector=((r"\bbit_depth: [\d.]+", "bit_depth: 1"),)),
}
"""What is extreme -> the instrument."""


@dataclass(frozen=True)
class Study:
    """A study that nobody would wait for: text of its factors, responses and design, and rows of its table."""

    factors: Callable[[], str]
    design: str = ""
    responses: str = "{f: {key: [recovered, cameras, forward, posterior, d_f_um]}}"
    table: Callable[[], str] | None = None

    def write(self, folder: Path) -> Path:
        """Write its files to a folder and return the path of the study."""
        if self.table is not None:
            (folder / "t.csv").write_text(self.table(), "utf-8")
        study = folder / "study.yaml"
        study.write_text(
            f"name: extreme\nbase: {{command: render, file: {EXAMPLES / 'aligned.yaml'}}}\n{self.design}\n"
            f"factors: {self.factors()}\nresponses: {self.responses}\n",
            "utf-8",
        )
        return study


def _rows(count: int) -> str:
    drawn = random.Random(2)
    return "dz,b,c\n" + "".join(f"{drawn.random():.4f} um,{k},{drawn.random():.5f}\n" for k in range(count))


def _one(values: str) -> Callable[[], str]:
    return lambda: f"{{dz: {{key: [job, perturb, base/forward/M2, shift, 2], {values}}}}}"


def _grid() -> str:
    keys = (
        f"f{k}: {{key: [job, perturb, base/forward/M1, shift, {k}], range: [0 um, 1 um], count: 46416}}"
        for k in range(3)
    )
    return "{" + ", ".join(keys) + "}"


_DRAWN = "design: {{kind: latin_hypercube, runs: {}, seed: 1}}"

STUDIES_BEYOND: Mapping[str, Study] = {
    "ten million runs": Study(_one("uniform: [0 um, 5 um]"), _DRAWN.format(10_000_000)),
    "a grid of 1e15": Study(_grid),
    "a table of 40 MB": Study(_one("table: {file: t.csv, column: dz}"), table=lambda: _rows(1_700_000)),
    "a sigma of 1e300 m": Study(_one("normal: {mean: 0 um, sigma: 1.0e+300 m}"), _DRAWN.format(10)),
}
"""What is extreme -> the study."""
