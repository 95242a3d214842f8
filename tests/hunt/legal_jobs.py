"""Legal jobs for an instrument: what moves, from nothing up to the limits, and what is stated of it, true or wrong.

Legal instruments nobody would draw: optics, beams, detectors and fields edited by anything from 1e-5 to a half.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optics.numerics.backend import load_backend
from scenes.models.camera_model import derive_camera
from scenes.specs.camera import CameraSpec
from scenes.specs.load import DETECTORS, LIBRARY
from scenes.specs.perturbation import NodeInfo
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.units import LENGTH, format_quantity
from scenes.yaml.yaml_file import YamlFile, dump_yaml, parse_yaml
from tests.robustness.tree_edits import editable, scaled, trees

STATEMENTS = ("orbit", "orbit", "launch", "launch", "paper_001", "none")
TERMS = ("Z4", "Z5", "Z6", "Z7", "Z8", "Z9", "Z11", "Z22")
LARGEST = {"arcsec": 300.0, "um": 200.0, "nm": 5000.0, "ppm": 1000.0, "K": 60.0}
"""Of what a job may state and a monitor may still follow, and beyond."""


def legal_statement(instrument: int) -> tuple[str, Any]:
    """What is stated to move in all jobs of an instrument: its name, and as plain data if it is not of the library."""
    chance = random.Random(f"hunted statement {instrument}")
    name = chance.choice(STATEMENTS)
    if name != "none" and chance.random() < 0.25:
        return "./stated.yaml", _wrong(chance, name)
    return name, None


def legal_job(instrument: int, number: int, nodes: Mapping[str, NodeInfo]) -> dict[str, Any]:
    """The job of that number for an instrument, the same every time."""
    chance = random.Random(f"hunted job {instrument} {number}")
    job: dict[str, Any] = {
        "instrument": "./instrument.yaml",
        "disturbances": legal_statement(instrument)[0],
        "render": {
            "images": ["spots"],
            "frames": chance.choice((1, 3, 9, 9, 30, 100)),
            "seed": chance.randrange(10**6),
        },
    }
    if chance.random() < 0.15:
        job["analysis"] = {"centroid": chance.choice(("gaussian", "energy"))}
    size = chance.choice((0.0, 1e-3, 1e-2, 1e-2, 0.1, 0.3, 1.0))
    moved = chance.sample(sorted(nodes), chance.choice((1, 1, 1, 2, 4))) if size else []
    job["perturb"] = {path: _moved(chance, nodes[path], size) for path in moved}
    return job


def _moved(chance: random.Random, node: NodeInfo, size: float) -> dict[str, Any]:
    """One to two things that are done to a body, of up to a share of the largest."""

    def number(unit: str) -> str:
        return f"{LARGEST[unit] * size * 10.0 ** chance.uniform(-1.0, 0.0) * chance.choice((-1, 1)):.4g} {unit}"

    def vector(unit: str) -> list[str]:
        parts = [f"0 {unit}"] * 3
        for axis in chance.sample(range(3), chance.choice((1, 1, 3))):
            parts[axis] = number(unit)
        return parts

    def figure() -> dict[str, str]:
        return {term: number("nm") for term in chance.sample(TERMS, chance.choice((1, 1, 2)))}

    make = {
        "rotate": lambda: vector("arcsec"),
        "shift": lambda: vector("um"),
        "scale": lambda: number("ppm"),
        "temperature": lambda: number("K"),
        "figure": figure,
    }
    known = sorted(name for name in make if name in node.allows)
    return {name: make[name]() for name in chance.sample(known, min(len(known), chance.choice((1, 1, 2))))}


def _wrong(chance: random.Random, name: str) -> Any:
    """A statement of the library of which causes are forgotten, or taken for ten or a hundred times less or more."""
    stated = parse_yaml((LIBRARY / "disturbances" / f"{name}.yaml").read_text("utf-8")).data
    causes = stated["causes"]
    for cause in chance.sample(sorted(causes), chance.choice((1, 2, len(causes) - 1))):
        factor = chance.choice((0.0, 0.01, 0.1, 10.0))
        if factor == 0.0:
            del causes[cause]
        else:
            causes[cause] = {
                key: _scaled(value, factor) if key in MOVED else value for key, value in causes[cause].items()
            }
    return stated


MOVED = ("shift", "rotate", "scale", "figure", "temperature")


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, dict):
        return {key: _scaled(part, factor) for key, part in value.items()}
    if isinstance(value, list):
        return [_scaled(part, factor) for part in value]
    number, unit = str(value).split(" ", 1)
    return f"{float(number) * factor:g} {unit}"


# ---  instruments -----------------------------------------------------------------------------------------------------

LARGEST_EDIT = 0.5
"""Relative edit of a number; half of them are below a hundredth of a percent of it."""


@dataclass(frozen=True)
class LegalInstrument:
    """An instrument of the library with edits.

    Attributes:
        camera, instrument, detector: files as plain data.
        text: what was changed.
    """

    camera: dict[str, Any]
    instrument: dict[str, Any]
    detector: dict[str, Any]
    text: str

    def write(self, folder: Path) -> None:
        """Its files, for jobs beside them; the camera states the focal length that its surfaces have, or it would be
        refused for that alone.
        """
        try:
            spec = validate(CameraSpec, YamlFile("", self.camera, {}))
            focal_length = derive_camera(spec, load_backend("llvm"), check_stated=False).line_principal_distance
            self.camera["focal_length"] = format_quantity(float(f"{focal_length:.3g}"), LENGTH)
        except InputError:
            pass  # that is told by whoever reads it
        for name in ("camera", "instrument", "detector"):
            (folder / f"{name}.yaml").write_text(dump_yaml(getattr(self, name)), "utf-8")


def legal_instrument(number: int) -> LegalInstrument:
    """The instrument of that number, the same every time."""
    chance = random.Random(f"hunted instrument {number}")
    camera, instrument = trees(chance.choice(("gf7_pair", "gf7_pair", "monitor_pair")))
    detector = parse_yaml((LIBRARY / DETECTORS / "monitor_ccd.yaml").read_text("utf-8")).data
    ccd = instrument["monitor"]["area_ccd"]
    ccd["detector"] = "./detector.yaml"
    said = [str(instrument["name"])]
    if chance.random() < 0.5:
        gone = chance.choice(list(instrument["cameras"]))
        del instrument["cameras"][gone]
        del instrument["baffles"]
        said.append(f"without {gone}")
    for edit in chance.sample((_optics, _blur, _beam, _detector), chance.choice((0, 1, 1, 1, 2, 3))):
        said += edit(chance, camera, instrument, detector)
    return LegalInstrument(camera, instrument, detector, ", ".join(said))


def _optics(chance: random.Random, camera: dict[str, Any], instrument: dict[str, Any], _: Any) -> list[str]:
    """A prescription, a look, a place or a prism."""
    keys = editable(camera, instrument)
    size = LARGEST_EDIT * 10.0 ** chance.uniform(-4.5, 0.0)
    said = []
    for file, key in chance.sample(keys, chance.choice((1, 1, 1, 2, 3))):
        change = size * chance.choice((-1.0, 1.0, chance.uniform(-1.0, 1.0)))
        scaled(camera if file == "camera" else instrument, key, change)
        said.append(f"{file} {'.'.join(map(str, key))} {change:+.3g}")
    return said


def _blur(chance: random.Random, camera: dict[str, Any], instrument: dict[str, Any], _: Any) -> list[str]:
    """A camera far out of focus or of figure, as none is built: in a narrow beam there is a spot all the same."""
    chosen = chance.choice(
        (("image", "z"), *((mirror, key) for mirror in camera["mirrors"] for key in ("radius", "conic")))
    )
    key = chosen if chosen[0] == "image" else ("mirrors", *chosen)
    change = chance.choice((-1.0, 1.0)) * 10.0 ** chance.uniform(-3.0, -0.3)
    scaled(camera, key, change)
    return [f"camera {'.'.join(key)} {change:+.3g}"]


def _beam(chance: random.Random, _: Any, instrument: dict[str, Any], __: Any) -> list[str]:
    """What the monitor's light is, and what it falls on."""
    monitor, said = instrument["monitor"], []

    def log(low: float, high: float) -> float:
        return float(f"{low * (high / low) ** chance.random():.4g}")

    edits = {
        "wavelength": lambda: {"wavelength": f"{log(400.0, 1000.0)} nm"},
        "pinhole": lambda: {"reticle": monitor["reticle"] | {"pinhole": f"{log(1.0, 400.0)} um"}},
        "light": lambda: {"reticle": monitor["reticle"] | {"photons_per_frame": log(1e4, 1e8)}},
        "aperture": lambda: {"return_face": {"aperture": f"{log(10.0, 60.0)} mm"}},
        "pitch": lambda: {"area_ccd": monitor["area_ccd"] | {"pitch": f"{log(3.0, 60.0)} um"}},
        "size": lambda: {
            "area_ccd": monitor["area_ccd"]
            | {axis: chance.choice((32, 48, 64, 128, 160)) for axis in ("rows", "columns")}
        },
        "field": lambda: {"field": f"{log(0.5, 1.3)} deg"},
    }
    for name in chance.sample(sorted(edits), chance.choice((1, 1, 2))):
        change = edits[name]()
        monitor.update(change)
        said.append(f"{name} of {change}")
    return said


def _detector(chance: random.Random, _: Any, instrument: Any, detector: Any) -> list[str]:
    """Data sheets from an 8-bit toy to a cooled camera, with light for a part of a full well; the gain brings that to
    the converter's end or not.
    """
    bits = chance.choice((8, 8, 10, 12, 14, 16))
    well = float(f"{10.0 ** chance.uniform(3.5, 6.0):.3g}")
    gain = float(f"{(2**bits - 1) / well * chance.choice((0.05, 0.5, 0.9, 0.9, 2.0)):.3g}")
    reticle = instrument["monitor"]["reticle"]
    light = reticle["photons_per_frame"] * well / detector["full_well_e"] * chance.choice((0.01, 0.1, 0.5, 0.9, 1.5))
    reticle["photons_per_frame"] = float(f"{light:.3g}")
    detector |= {
        "bit_depth": bits,
        "full_well_e": well,
        "system_gain_dn_per_e": gain,
        "dark_noise_e": float(f"{10.0 ** chance.uniform(-1.0, 2.0):.3g}"),
        "offset_dn": float(chance.choice((0, 5, 20, 100))),
        "prnu": float(f"{10.0 ** chance.uniform(-4.0, -1.5):.3g}"),
        "dsnu_e": float(f"{10.0 ** chance.uniform(-1.0, 1.5):.3g}"),
    }
    return [
        f"detector of {bits} bit, {well:g} e, {gain:g} DN/e, noise {detector['dark_noise_e']:g} e, {light:.3g} photons"
    ]
