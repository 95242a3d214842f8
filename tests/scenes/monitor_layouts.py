"""Instruments whose monitors are laid out otherwise than the library's pair: as files of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from optics.numerics.backend import Backend
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.specs.load import INSTRUMENTS, LIBRARY, load_camera, load_instrument

HOLLOW_180 = {"kind": "hollow_transfer", "material": "CFRP", "distance": "2.4 m", "width": "60 mm"}
HOLLOW_0 = {"kind": "periscope", "material": "SiC", "distance": "0.5 m", "shift": "100 mm", "width": "60 mm"}


class _Plain(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True


def pair() -> dict[str, Any]:
    """The library's pair gf7 as plain data."""
    return dict(yaml.load((LIBRARY / INSTRUMENTS / "gf7_pair.yaml").read_text("utf-8"), yaml.CSafeLoader))


def hollow_pair() -> dict[str, Any]:
    """The pair with mirrors on frames in place of both prisms."""
    data = pair()
    data["monitor"] |= {"prism_180": HOLLOW_180, "prism_0": HOLLOW_0}
    return data


def explicit_pair() -> dict[str, Any]:
    """The pair with its channels written out."""
    data = pair()
    for site in data["cameras"].values():
        offset = site.pop("pupil_offset")
        ends = {"left": "1.22 deg", "right": "-1.22 deg"}
        site["channels"] = {name: {"field": field, "pupil_offset": offset} for name, field in ends.items()}
    return data


def two_beams() -> dict[str, Any]:
    """The pair with a second beam on each side, nearer to the middle of the pupil and somewhat farther out in the
    field; its prisms stand behind the first beam's, its facets farther out on the block. The first beam goes down
    between the backward camera's focal plane and M3's light.
    """
    data = explicit_pair()
    monitor = data["monitor"]
    monitor["prism_180"]["width"] = monitor["prism_0"]["width"] = "40 mm"
    monitor["prism_0"]["shift"] = "245 mm"
    monitor["return_face"]["aperture"] = "34 mm"
    for site, sign in zip(data["cameras"].values(), (-1, 1), strict=True):
        for name, end in (("left", 1), ("right", -1)):
            site["channels"][f"{name}_2"] = {
                "field": f"{end * 1.25} deg",
                "pupil_offset": [f"{sign * 130} mm", "0 mm"],
                "spread": ["60 mm", "110 mm"],
                "prism_180": {**monitor["prism_180"], "distance": "2.65 m"},
                "prism_0": {**monitor["prism_0"], "shift": "100 mm", "distance": "0.65 m"},
            }
    return data


def text_of(data: dict[str, Any]) -> str:
    """Plain data as the text of a file."""
    return str(yaml.dump(data, Dumper=_Plain, sort_keys=False))


def write(data: dict[str, Any], place: Path) -> Path:
    """Plain data as a file."""
    place.write_text(text_of(data), "utf-8")
    return place


def built(data: dict[str, Any], folder: Path, backend: Backend) -> Instrument:
    """An instrument from plain data, by way of a file ``own.yaml``."""
    spec = load_instrument(write(data, folder / "own.yaml"))
    return build_instrument(spec, {site.camera: load_camera(site.camera) for site in spec.cameras.values()}, backend)
