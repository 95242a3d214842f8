"""Legal instruments nobody would draw: optics, beams, detectors and fields edited by anything from 1e-5 to a half."""

from __future__ import annotations

import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optics.numerics.backend import load_backend
from scenes.models.camera_model import derive_camera
from scenes.specs.camera import CameraSpec
from scenes.specs.load import DETECTORS, LIBRARY
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.units import LENGTH, format_quantity
from scenes.yaml.yaml_file import YamlFile, dump_yaml, parse_yaml
from tests.robustness.tree_edits import editable, scaled, trees

LARGEST = 0.5
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
            focal_length = derive_camera(spec, load_backend("llvm"), stated=False).line_principal_distance
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
    size = LARGEST * 10.0 ** chance.uniform(-4.5, 0.0)
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
