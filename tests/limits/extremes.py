"""Extreme instruments and studies: what is changed in the reference ones, as text of their files."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from scenes.specs.load import CAMERAS, DETECTORS, EXAMPLES, INSTRUMENTS, LIBRARY

Edit = tuple[str, str]
"""Pattern that occurs in a file, and what stands in its place."""


@dataclass(frozen=True)
class Extreme:
    """An instrument that nobody would build.

    Attributes:
        instrument, camera, detector: edits of gf7_pair, gf7 and monitor_ccd.
        frames: of each state.
        render: further keys of the job's ``render``.
    """

    instrument: tuple[Edit, ...] = ()
    camera: tuple[Edit, ...] = ()
    detector: tuple[Edit, ...] = ()
    frames: int = 3
    render: str = ""

    def write(self, folder: Path) -> Path:
        """Its files in a folder; the path of the job."""
        edits = (*self.instrument, (r"camera: gf7\b", "camera: ./camera.yaml"), ("monitor_ccd", "./detector.yaml"))
        (folder / "instrument.yaml").write_text(edited(LIBRARY / INSTRUMENTS / "gf7_pair.yaml", edits), "utf-8")
        (folder / "camera.yaml").write_text(edited(LIBRARY / CAMERAS / "gf7.yaml", self.camera), "utf-8")
        (folder / "detector.yaml").write_text(edited(LIBRARY / DETECTORS / "monitor_ccd.yaml", self.detector), "utf-8")
        job = folder / "job.yaml"
        job.write_text(
            f"instrument: ./instrument.yaml\nrender: {{frames: {self.frames}, seed: 1{self.render}}}\n", "utf-8"
        )
        return job


def edited(path: Path, edits: tuple[Edit, ...]) -> str:
    """Text of a file with edits, each of which has to change something."""
    text = path.read_text("utf-8")
    for pattern, new in edits:
        text, count = re.subn(pattern, new, text)
        if not count:
            raise ValueError(f"{path}: no {pattern!r}")
    return text


def with_ccd(side: int, frames: int = 3) -> Extreme:
    """The reference instrument with square area CCDs of another size."""
    return Extreme(((r"rows: 96, columns: 96", f"rows: {side}, columns: {side}"),), frames=frames)


def _monitor(key: str, value: str) -> Extreme:
    return Extreme(((rf"\b{key}: [-\d.e+]+( \w+)?", f"{key}: {value}"),))


def _mirror(mirror: str, key: str, factor: float, focal_length: str = "5.52 m") -> Extreme:
    """A number of a mirror; ``focal_length``: that the file states, that of its surfaces where it is not to be refused
    for another one.
    """
    text = (LIBRARY / CAMERAS / "gf7.yaml").read_text("utf-8")
    found = re.search(rf"  {mirror}:\n(.*\n)*?    {key}: (-?[\d.]+)", text)
    assert found is not None
    edits = ((re.escape(f"{key}: {found[2]}"), f"{key}: {factor * float(found[2])!r}"),)
    return Extreme(camera=(*edits, (r"focal_length: 5\.52 m", f"focal_length: {focal_length}")))


def _scaled(factor: float) -> Extreme:
    """Every length of the camera's prescription, aspheric terms aside."""
    names = "focal_length|entrance_pupil|z|radius"
    text = (LIBRARY / CAMERAS / "gf7.yaml").read_text("utf-8")
    edits = {
        rf"\b{re.escape(one[0])}(?! ?\w)": f"{one[1]}: {factor * float(one[2])!r} m"
        for one in re.finditer(rf"\b({names}): (-?[\d.]+) m\b", text)
    }
    return Extreme(camera=tuple(edits.items()))


def _sheet(key: str, value: str) -> Extreme:
    return Extreme(detector=((rf"\b{key}: [\d.]+", f"{key}: {value}"),))


INSTRUMENTS_BEYOND: Mapping[str, Extreme] = {
    "CCD of 24 x 24 pixels": with_ccd(24),
    "CCD of 1024 x 1024 pixels": with_ccd(1024),
    "CCD of 4096 x 4096 pixels": with_ccd(4096),
    "CCD of 8192 x 8192 pixels": with_ccd(8192),
    "one frame": with_ccd(96, 1),
    "10 000 frames": with_ccd(96, 10_000),
    "pinhole of 1 nm": _monitor("pinhole", "1 nm"),
    "pinhole of 200 um": _monitor("pinhole", "200 um"),
    "pinhole of 1 m": _monitor("pinhole", "1 m"),
    "pitch of 0.5 um": _monitor("pitch", "0.5 um"),
    "pitch of 120 um": _monitor("pitch", "120 um"),
    "pitch of 1 mm": _monitor("pitch", "1 mm"),
    "camera a thousandth as large": _scaled(1e-3),
    "camera a thousand times as large": _scaled(1e3),
    "radius of M1 a thousandth": _mirror("M1", "radius", 1e-3),
    "radius of M1 a thousand times": _mirror("M1", "radius", 1e3),
    "radius of M3 40 percent less": _mirror("M3", "radius", 0.6, "3.21 m"),
    "conic of M1 a thousand times": _mirror("M1", "conic", 1e3, "3.12 m"),
    "conic of M2 a thousand times, turned": _mirror("M2", "conic", -1e3),
    "field of 1 arcsec": _monitor("field", "1 arcsec"),
    "field of 44 deg": _monitor("field", "44 deg"),
    "aperture of 1 um": _monitor("aperture", "1 um"),
    "prism 1 um away": _monitor("distance", "1 um"),
    "prism 100 km away": _monitor("distance", "100 km"),
    "wavelength of 10 nm": _monitor("wavelength", "10 nm"),
    "wavelength of 20 um": _monitor("wavelength", "20 um"),
    "temperature of 1 K": Extreme(((r"altitude: 505 km", "temperature: 1 K\naltitude: 505 km"),)),
    "noise of 100 000 electrons": _sheet("dark_noise_e", "100000"),
    "one bit": _sheet("bit_depth", "1"),
    "light of 1e12 photons": _monitor("photons_per_frame", "1.0e+12"),
}
"""What is extreme -> the instrument: more than the twenty-nine of the audit."""


@dataclass(frozen=True)
class Study:
    """A study that nobody would wait for.

    Attributes:
        factors, design, responses: text of these keys.
        options: of the command.
        tables: name of a file -> what writes its rows.
    """

    factors: Callable[[], str]
    design: str = ""
    responses: str = "{f: {key: [recovered, cameras, forward, posterior, d_f_um]}}"
    options: tuple[str, ...] = ("--workers", "1")
    tables: Mapping[str, Callable[[], str]] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Its files in a folder; the path of the study."""
        for name, text in self.tables.items():
            (folder / name).write_text(text(), "utf-8")
        study = folder / "study.yaml"
        study.write_text(
            f"name: extreme\nbase: {{command: render, file: {EXAMPLES / 'aligned.yaml'}}}\n{self.design}\n"
            f"factors: {self.factors()}\nresponses: {self.responses}\n",
            "utf-8",
        )
        return study


_SHIFT = "key: [job, perturb, base/forward/M2, shift, 2]"


def _numbers(count: int, end: str = "") -> str:
    drawn = random.Random(1)
    return ", ".join(f"{5.0 * drawn.random():.2f}{end}" for _ in range(count))


def _rows(count: int) -> str:
    drawn = random.Random(2)
    return "dz,b,c\n" + "".join(f"{drawn.random():.4f} um,{k},{drawn.random():.5f}\n" for k in range(count))


def _figures(count: int) -> str:
    mirrors = [f"base/{camera}/M{k}" for camera in ("forward", "backward") for k in (1, 2, 3)]
    places = [(mirror, f"Z{term}") for mirror in mirrors for term in range(4, 4 + -(-count // len(mirrors)))]
    factors = (
        f"f{k}: {{key: [job, perturb, {mirror}, figure, {term}], uniform: [-1 nm, 1 nm]}}"
        for k, (mirror, term) in enumerate(places[:count])
    )
    return "{" + ", ".join(factors) + "}"


def _one(values: str) -> Callable[[], str]:
    return lambda: f"{{dz: {{{_SHIFT}, {values}}}}}"


_DRAWN = "design: {{kind: latin_hypercube, runs: {}, seed: 1}}"

STUDIES_BEYOND: Mapping[str, Study] = {
    "ten million runs": Study(_one("uniform: [0 um, 5 um]"), _DRAWN.format(10_000_000)),
    "ten million runs, wanted": Study(
        _one("uniform: [0 um, 5 um]"), _DRAWN.format(10_000_000), options=("--yes", "--workers", "1")
    ),
    "a grid of 1e15": Study(
        lambda: (
            "{"
            + ", ".join(
                f"f{k}: {{key: [job, perturb, base/forward/M{1 + k // 3}, shift, {k % 3}], range: [0 um, 1 um], "
                "count: 46416}"
                for k in range(3)
            )
            + "}"
        )
    ),
    "a table of 40 MB": Study(_one("table: {file: t.csv, column: dz}"), tables={"t.csv": lambda: _rows(1_700_000)}),
    "a table of 80 000 rows": Study(_one("table: {file: t.csv, column: dz}"), tables={"t.csv": lambda: _rows(80_000)}),
    "a list of 800 kB": Study(lambda: f"{{dz: {{{_SHIFT}, values: [{_numbers(133_000)}]}}}}"),
    "a list of 50 000 values": Study(lambda: f"{{dz: {{{_SHIFT}, values: [{_numbers(50_000, ' um')}]}}}}"),
    "a table of 20 000 columns": Study(
        _one("table: {file: t.csv, column: c7}"),
        tables={
            "t.csv": lambda: ",".join(f"c{k}" for k in range(20_000)) + "\n" + (",".join(["1 um"] * 20_000) + "\n") * 2
        },
    ),
    "a hundred factors": Study(lambda: _figures(100), _DRAWN.format(2)),
    "three hundred responses": Study(
        _one("values: [0 um, 1 um]"),
        responses="{"
        + ", ".join(f"r{k}: {{key: [recovered, cameras, forward, posterior, d_f_um]}}" for k in range(300))
        + "}",
    ),
    "a sigma of 1e300 m": Study(_one("normal: {mean: 0 um, sigma: 1.0e+300 m}"), _DRAWN.format(10)),
}
"""What is extreme -> the study."""
