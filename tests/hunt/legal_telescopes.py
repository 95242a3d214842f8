"""Telescopes on their axis as other programs' files have them: stop planes, dummies, folds, holes, stated edges.

What of them stands in their beam and what a figure error does to their wavefront follow from similar triangles.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from scenes.models.camera_model import derive_camera
from scenes.specs.load import load_camera
from scenes.specs.tolerance import ToleranceSetup
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.hunt.hunt import BAD_REFUSAL, RIGHT, WRONG_READING, Outcome
from twin.camera.first_order_data import obscuration
from twin.tolerance.tolerance_bench import ToleranceBench

AMOUNT = 30e-9
"""Astigmatism that is put on a mirror, metres rms of sag."""
SHARES = 0.003
"""Error of a share of the beam: rays are counted."""
PARAXIAL = 0.04
"""Relative error of sizes by similar triangles, and of wavefronts by 2 x the sag: slopes here are up to 0.2."""


@dataclass(frozen=True)
class LegalTelescope:
    """A telescope of two mirrors.

    Attributes:
        camera: its file as plain data.
        shadow: share of the beam that its secondary takes.
        hole: whether its file leaves out the hole that the light needs in the primary.
        waves: mirror -> waves rms that ``AMOUNT`` gives.
        text: what is in its path beside the mirrors.
    """

    camera: dict[str, Any]
    shadow: float
    hole: bool
    waves: dict[str, float]
    text: str


def legal_telescope(number: int) -> LegalTelescope:
    """Return the telescope of that number, the same every time: Cassegrain, or Gregory's."""
    chance = random.Random(f"hunted telescope {number}")
    radius, speed = chance.uniform(0.1, 0.5), chance.uniform(2.5, 4.0)
    first = 2.0 * radius * speed
    share = chance.uniform(0.2, 0.35) * chance.choice((1.0, 1.0, -1.0))
    size = chance.uniform(1.15, 1.6) * (1.0 - share) / share
    before, behind = first * (1.0 - share), share * first * size
    curvature = 2.0 * share * first * size / (size - 1.0)
    half = np.deg2rad(chance.uniform(0.02, 0.2))
    margin = chance.choice((0.0, 1e-3, 5e-3, 1e-2))
    image = behind - before
    mirrors: dict[str, Any] = {
        "M1": {"z": "0 m", "radius": f"{-2.0 * first} m", "conic": -1},
        "M2": {"z": f"{-before} m", "radius": f"{-curvature} m", "conic": -(((size + 1.0) / (size - 1.0)) ** 2)},
    }
    said, stop, ahead = ["Cassegrain" if share > 0.0 else "Gregory"], "M1", 0.0
    # the beam of the whole field at the primary, and at the secondary
    wander = np.tan(half) * np.sqrt(2.0)
    beams = {"M1": radius, "M2": radius * abs(share) + before * wander + margin}
    plane = {"radius": "flat", "light": "passes"}
    if chance.random() < 0.5:
        stop, ahead = "STOP", chance.choice((0.0, 0.0, 0.5 * before, before))
        mirrors = {"STOP": {"z": f"{-ahead} m", **plane}, **mirrors}
        beams["M1"] = radius + ahead * wander + margin
        beams["M2"] += ahead * wander * share
        said.append(f"stop plane {ahead:.3g} m before")
    for k in range(chance.choice((0, 1, 1, 2, 3))):
        place, z = chance.choice(
            (("M1", 0.0), ("M1", -1.2 * before), ("M2", -0.5 * before), ("M2", -before), ("", 0.0))
        )
        order = list(mirrors)
        at = order.index(place) if place else len(order)
        order.insert(at, f"D{k}")
        mirrors = {name: mirrors.get(name, {"z": f"{z} m", **plane}) for name in order}
        said.append(f"dummy at {z:.3g} m before {place or 'the image'}")
    z, aside = 0.2 * image, 0.5 * image
    if chance.random() < 0.4 and aside > 2.5 * beams["M2"]:  # else the second fold stands in the first one's light
        turn = {"radius": "flat", "rotate": ["45 deg", "0 deg", "0 deg"]}
        mirrors["F1"] = {"z": f"{z} m", **turn}
        mirrors["F2"] = {"z": f"{z} m", "decentre": ["0 m", f"{aside} m"], **turn}
        image -= aside
        said.append("two folds")
    if chance.random() < 0.3:
        beams["M2"] *= chance.uniform(1.05, 1.3)
        mirrors["M2"]["edges"] = [{"clear": "circle", "radius": f"{beams['M2']} m"}]
        said.append("edge of M2 stated")
    open_share = 0.0  # of the beam, that goes through the hole and is not the camera's
    # of the light through the primary: the axial beam, and chief rays that come from the secondary
    needed = radius * abs(share) * (behind - before) / behind + first * abs(size) * wander * before / behind
    hole = chance.random() < 0.4 and 1.1 * needed < 0.9 * beams["M2"]
    if hole:
        open_share = (0.9 * beams["M2"] / radius) ** 2
        mirrors["M1"]["edges"] = [{"blocks": "circle", "radius": f"{0.9 * beams['M2']} m"}]
        said.append("hole stated")
    camera = {
        "name": "telescope",
        "focal_length": f"{first * abs(size)} m",
        "entrance_pupil": f"{2.0 * radius} m",
        "field_bias": "0 deg",
        "field": {"x": f"{half} rad", "y": f"{half} rad"},
        "wavelength": "650 nm",
        "stop": stop,
        "mirrors": mirrors,
        "image": {"z": f"{image} m"},
        "line": {"pixels": 1000, "pitch": "7 um"},
        "edge_margin": f"{1e3 * margin} mm",
    }
    lit = {"M1": radius, "M2": radius * abs(share)}
    # of astigmatism, as r^2, over the ring that a hole leaves
    ring = np.sqrt((1.0 - open_share**3) / (1.0 - open_share))
    waves = {name: ring * 2.0 * AMOUNT / 650e-9 * (lit[name] / beams[name]) ** 2 for name in lit}
    shadow = ((beams["M2"] / radius) ** 2 - open_share) / (1.0 - open_share)
    return LegalTelescope(camera, shadow, not hole, waves, ", ".join(said))


def telescopes(first: int, cases: int, folder: Path, backend: Backend) -> Iterator[Outcome]:
    """Outcomes of so many telescopes, from a number on."""
    for number in range(first, first + cases):
        made = legal_telescope(number)
        (folder / "telescope.yaml").write_text(dump_yaml(made.camera), "utf-8")
        try:
            wrong = _wrong(made, folder, backend)
        except InputError as error:
            yield Outcome(str(number), BAD_REFUSAL, f"{made.text}\n  {error}")
            continue
        yield Outcome(str(number), WRONG_READING if wrong else RIGHT, f"{made.text}\n  {wrong}")


def _wrong(made: LegalTelescope, folder: Path, backend: Backend) -> str:
    """What is told of a telescope and is not so; empty for nothing."""
    found = obscuration(derive_camera(load_camera(folder / "telescope.yaml"), backend), backend)
    if list(found.shares) != ["M2"] or abs(found.shares["M2"] - made.shadow) > SHARES + 2.0 * PARAXIAL * made.shadow:
        return f"obscured by {dict(found.shares)}, is {made.shadow:.4f} by M2"
    if list(found.holes) != ["M1"] * made.hole:
        return f"holes {dict(found.holes)}"
    budget = {
        "instrument": "telescope.yaml",
        "tolerances": {name: {"motion": f"{name} figure Z5", "limit": "30 nm"} for name in made.waves},
        "merits": {"wavefront": {"kind": "wavefront", "at_most": 0.3, "fields": [[0.0, 0.0]]}},
    }
    (folder / "budget.yaml").write_text(dump_yaml(budget), "utf-8")
    bench = ToleranceBench(ToleranceSetup.read(folder / "budget.yaml"), backend)
    told = bench.merits[0].values(bench.adjust_cameras(AMOUNT * np.eye(2)).parts)
    off = np.abs(told / np.array(list(made.waves.values())) - 1.0)
    return "" if np.all(off < PARAXIAL) else f"astigmatism gives {told} waves, is {made.waves}"
