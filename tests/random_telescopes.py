"""Telescopes drawn at random, legal by paraxial optics: mirrors, lenses, flats, sections off the axis, and their edges.

Every kind solves for what belongs together: conics without spherical aberration on the axis, the focal length and the
focal plane by rays of ``tests.own_trace``; a defocus of some tenths of a wave is added. Edges do not have to make
sense: they stand where they like, but leave some light.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scenes.specs.camera import CameraSpec
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.own_trace import OwnCamera

F2 = """{name: F2, formula: 2, range: [320 nm, 2500 nm],
    coefficients: [1.34533359, 0.00997743871, 0.209073176, 0.0470450767, 0.937357162, 111.886764]}"""
GLASS = {"N-BK7": "N-BK7", "fused silica": "fused silica", "F2": F2}

Surface = dict[str, str]
Drawn = tuple[dict[str, Surface], str, float, float, float, float, float]
"""Surfaces, the stop, pupil's diameter, bias and half of the field (radians), about where the image is, wavelength."""


def _m(value: float) -> str:
    return f"{value:.12f} m"


def two_mirrors(rng: np.random.Generator) -> tuple[dict[str, Surface], float, float, float]:
    """A telescope between a Cassegrain and an aplanat: surfaces, diameter, focal length of its primary, image."""
    diameter, ratio, m, k = rng.uniform(0.1, 1.5), rng.uniform(2.0, 4.0), rng.uniform(2.5, 5.0), rng.uniform(0.2, 0.35)
    f1 = ratio * diameter
    away, beta = (1.0 - k) * f1, m * k - (1.0 - k)
    aplanat = rng.uniform(0.0, 1.0)
    k1 = -1.0 - aplanat * 2.0 * (1.0 + beta) / (m**2 * (m - beta))
    k2 = -(((m + 1.0) / (m - 1.0)) ** 2) - aplanat * 2.0 * m * (m + 1.0) / ((m - beta) * (m - 1.0) ** 3)
    surfaces = {
        "M1": {"z": "0 m", "radius": _m(-2.0 * f1), "conic": f"{k1:.12f}"},
        "M2": {"z": _m(-away), "radius": _m(-2.0 * m * k * f1 / (m - 1.0)), "conic": f"{k2:.12f}"},
    }
    return surfaces, diameter, f1, beta * f1


def cassegrain(rng: np.random.Generator) -> Drawn:
    """Two mirrors, some behind a window, some with a weak doublet of named glasses before the image."""
    surfaces, diameter, f1, image = two_mirrors(rng)
    away = -float(surfaces["M2"]["z"].split()[0])
    if rng.uniform() < 0.3:
        z = -away - 0.3 * f1
        surfaces = {
            "W1": {"z": _m(z), "radius": "flat", "light": "refracts", "glass": GLASS["fused silica"]},
            "W2": {"z": _m(z + 0.05 * diameter), "radius": "flat", "light": "refracts", "index": "1"},
        } | surfaces
    if rng.uniform() < 0.4:
        # a corrector without power: a meniscus of nearly concentric faces a tenth of the way before the image
        thick = 0.02 * diameter
        z, bend = image - 0.15 * f1, rng.uniform(0.8, 3.0) * f1 * rng.choice([-1.0, 1.0])
        surfaces |= {
            "L1": {"z": _m(z), "radius": _m(bend), "light": "refracts", "glass": GLASS["N-BK7"]},
            "L2": {"z": _m(z + thick), "radius": _m(bend), "light": "refracts", "index": "1"},
        }
    return surfaces, "M1", diameter, 0.0, rng.uniform(2e-4, 8e-4), image, 650e-9


def korsch(rng: np.random.Generator) -> Drawn:
    """Three mirrors, each pair of foci shared, a field beside the axis; one or two flats more fold them."""
    surfaces, diameter, f1, first = two_mirrors(rng)
    reach = rng.uniform(0.5, 0.9) * f1
    m3 = rng.uniform(0.6, 1.1)
    s, back = reach, m3 * reach
    conic = -(((s - back) / (s + back)) ** 2)
    z3 = first + reach
    surfaces["M3"] = {"z": _m(z3), "radius": _m(-2.0 * s * back / (s + back)), "conic": f"{conic:.12f}"}
    image = z3 - back
    for name in [("M4", "M5")[k] for k in range(rng.integers(0, 3))]:
        # a flat half of the way to the image turns it back along the axis
        last = list(surfaces)[-1]
        z = float(surfaces[last]["z"].split()[0])
        there = z + rng.uniform(0.3, 0.6) * (image - z)
        turn = rng.normal(0.0, 2e-4, 2)
        surfaces[name] = {"z": _m(there), "radius": "flat",
                          "rotate": f"[{turn[0]:.9f} rad, {turn[1]:.9f} rad, 0 rad]"}  # fmt: skip
        image = 2.0 * there - image
    bias, half = rng.uniform(5e-4, 2e-3), rng.uniform(1e-4, 4e-4)
    return surfaces, "M1", diameter, bias, half, image, 650e-9


def off_axis(rng: np.random.Generator) -> Drawn:
    """A section off the axis of two mirrors, its stop a plane of its own beside the axis."""
    surfaces, diameter, _, image = two_mirrors(rng)
    away = -float(surfaces["M2"]["z"].split()[0])
    part = rng.uniform(0.25, 0.4) * diameter
    beside = rng.uniform(0.55, 0.7) * part + 0.2 * diameter
    stop = {"z": _m(-1.2 * away), "radius": "flat", "light": "passes", "decentre": f"[0 m, {beside:.12f} m]"}
    return {"S": stop} | surfaces, "S", part, 0.0, rng.uniform(1e-4, 3e-4), image, 650e-9


def lens(rng: np.random.Generator) -> Drawn:
    """A singlet or an achromat of named glasses, the stop before it, on it or behind it."""
    scale, ratio = rng.uniform(0.05, 1.0), rng.uniform(0.6, 1.0)
    radii = (600.0, -440.0, -437.0, -2342.0)
    z = (0.0, 15.0, 16.0, 24.0)
    names = [GLASS["N-BK7"], None, GLASS["F2"], None]
    count = 4 if rng.uniform() < 0.7 else 2
    surfaces: dict[str, Surface] = {}
    for k in range(count):
        own = {"z": _m(1e-3 * scale * z[k]), "radius": _m(1e-3 * scale * radii[k]), "light": "refracts"}
        surfaces[f"L{k + 1}"] = own | ({"index": "1"} if names[k] is None else {"glass": names[k]})
    pupil = (0.1 if count == 4 else 0.03) * ratio * scale
    image = (1.1412 if count == 4 else 0.5) * scale
    choice = rng.integers(0, 3)
    stop = "L1"
    if choice:
        at = {"z": _m(-0.1 * scale if choice == 1 else 0.06 * scale), "radius": "flat", "light": "passes"}
        surfaces = {"S": at} | surfaces if choice == 1 else surfaces | {"S": at}
        stop = "S"
    return surfaces, stop, pupil, 0.0, rng.uniform(1e-3, 6e-3), image, 587.5618e-9


def corrected(rng: np.random.Generator) -> Drawn:
    """A Maksutov or a Schmidt camera with its corrector of glass in front."""
    scale = rng.uniform(0.3, 3.0)
    if rng.uniform() < 0.5:
        z, radii = (-0.4, -0.385, 0.0, -0.37), (-0.2326391309942, -0.2421599911645, -1.0, -0.3848977982915)
        names = ("L1", "L2", "M1", "M2")
        surfaces = {n: {"z": _m(scale * a), "radius": _m(scale * r)} for n, a, r in zip(names, z, radii, strict=True)}
        surfaces["L1"] |= {"light": "refracts", "index": "1.51509"}
        surfaces["L2"] |= {"light": "refracts", "index": "1"}
        return surfaces, "L1", 0.15 * scale * rng.uniform(0.7, 1.0), 0.0, 1e-3, 0.1424 * scale, 633e-9
    surfaces = {
        "L1": {"z": _m(-0.01 * scale), "radius": "flat", "light": "refracts", "glass": GLASS["fused silica"]},
        "L2": {"z": "0 m", "radius": _m(-130.0 * scale), "aspheric": f"{{A4: {0.0685 / scale**3:.12g} 1/m^3}}",
               "light": "refracts", "index": "1"},
        "M1": {"z": _m(2.0 * scale), "radius": _m(-2.0 * scale)},
    }  # fmt: skip
    return (
        surfaces,
        "L1",
        0.2 * scale * rng.uniform(0.6, 1.0),
        0.0,
        rng.uniform(1e-3, 4e-3),
        1.0035 * scale,
        587.5618e-9,
    )


KINDS: tuple[Callable[[np.random.Generator], Drawn], ...] = (cassegrain, korsch, off_axis, lens, korsch, corrected)


def front_edges(rng: np.random.Generator, radius: float) -> list[str]:
    """What stands before the pupil: a disk or a ring on or off the axis, vanes, a housing, a box."""
    beside = rng.normal(0.0, 0.02, 2) * radius
    out = []
    if rng.uniform() < 0.8:
        out.append(f"{{blocks: circle, radius: {rng.uniform(0.15, 0.45) * radius:.6f} m, "
                   f"centre: [{beside[0]:.6f} m, {beside[1]:.6f} m]}}")  # fmt: skip
    first, count = rng.uniform(0.0, 360.0), rng.integers(0, 5)
    for k in range(count):
        turn = (first + k * 360.0 / count) % 360.0
        out.append(f"{{blocks: ray, width: {rng.uniform(0.01, 0.04) * radius:.6f} m, rotation: {turn:.4f} deg}}")
    if rng.uniform() < 0.3:
        out.append(f"{{clear: circle, radius: {rng.uniform(0.9, 1.0) * radius:.6f} m, "
                   f"centre: [{rng.normal(0.0, 0.05) * radius:.6f} m, 0 m]}}")  # fmt: skip
    if rng.uniform() < 0.2:
        out.append(f"{{clear: circle, radius: {1.2 * radius:.6f} m, inner: {rng.uniform(0.1, 0.3) * radius:.6f} m}}")
    if rng.uniform() < 0.3:
        out.append(f"{{blocks: rectangle, half: [{rng.uniform(0.05, 0.2) * radius:.6f} m, "
                   f"{rng.uniform(0.05, 0.2) * radius:.6f} m], centre: [{rng.uniform(0.0, 0.8) * radius:.6f} m, 0 m], "
                   f"rotation: {rng.uniform(0.0, 90.0):.4f} deg}}")  # fmt: skip
    if rng.uniform() < 0.15:
        out.append(f"{{clear: ellipse, half: [{radius:.6f} m, {rng.uniform(0.6, 0.9) * radius:.6f} m]}}")
    return out


def telescope(seed: int) -> CameraSpec:
    """The telescope of a seed."""
    rng = np.random.default_rng(seed)
    surfaces, stop, pupil, bias, half, image, wavelength = KINDS[seed % len(KINDS)](rng)
    radius = 0.5 * pupil
    free = file_of(surfaces, stop, pupil, bias, half, image, wavelength, 1.0)
    own = OwnCamera(free)
    heading = own.heading(0.0, 0.0)
    start, axes = own.launch(heading)
    # the focal plane where rays of the middle's beam are closest together
    ring = radius * np.array([[np.cos(t), np.sin(t)] for t in 2.0 * np.pi * np.arange(12) / 12])
    rays = own.trace(start + np.concatenate([np.zeros((1, 2)), 0.7 * ring]) @ axes, heading)
    slope, place = rays.way[:, :2] / rays.way[:, 2:], rays.place[:, :2]
    slope, place = slope - slope[0], place - place[0]
    image -= float(np.sum(slope * place) / np.sum(slope**2))
    aperture = float(np.max(np.abs(slope))) / 0.7
    image += rng.normal(0.0, 0.3) * 2.0 * wavelength / (2.0 * aperture) ** 2 * 4.0 / 2.0
    focused = OwnCamera(file_of(surfaces, stop, pupil, bias, half, image, wavelength, 1.0))
    small = 1e-5
    ends = []
    for x in (-small, small):
        way = focused.heading(x, 0.0)
        begin, _ = focused.launch(way)
        ends.append(focused.trace(begin[None], way).place[0])
    focal = float(np.abs(ends[1][0] - ends[0][0]) / (2.0 * np.tan(small)))
    beside = 0.0
    if "decentre" in surfaces[stop]:
        beside = float(surfaces[stop]["decentre"].split(",")[1].split()[0])
    front = {"z": _m(_first_z(surfaces) - 0.2 * pupil), "radius": "flat", "light": "passes",
             "decentre": f"[0 m, {beside:.12f} m]"}  # fmt: skip
    edges = front_edges(rng, radius)
    if edges:
        front["edges"] = "[" + ", ".join(edges) + "]"
    every = {"P1": front} | surfaces
    if rng.uniform() < 0.4:
        # a rim that vignettes some of a field's light, at the last surface with power
        last = [n for n, s in surfaces.items() if s["radius"] != "flat"][-1]
        met = _footprint(focused, last, radius, half)
        middle, reach = 0.5 * (met.min(axis=0) + met.max(axis=0)), 0.5 * float(np.max(np.ptp(met, axis=0)))
        every = {n: dict(s) for n, s in every.items()}
        every[last]["edges"] = (f"[{{clear: circle, radius: {rng.uniform(0.88, 1.02) * reach:.9f} m, "
                                f"centre: [{middle[0]:.9f} m, {middle[1]:.9f} m]}}]")  # fmt: skip
    return file_of(every, stop, pupil, bias, half, image, wavelength, focal)


def _footprint(own: OwnCamera, name: str, radius: float, half: float) -> np.ndarray:
    """Where beams of the middle and of two corners meet a surface, (N, 2): the stop is moved there."""
    found = []
    spec = own.spec.model_copy(update={"stop": name})
    ring = radius * np.array([[np.cos(t), np.sin(t)] for t in 2.0 * np.pi * np.arange(24) / 24])
    for x, y in ((0.0, 0.0), (half, half), (-half, -half)):
        heading = own.heading(x, y)
        start, axes = own.launch(heading)
        found.append(OwnCamera(spec).trace(start + ring @ axes, heading).stop)
    return np.concatenate(found)


def _first_z(surfaces: dict[str, Surface]) -> float:
    return min(float(s["z"].split()[0]) for s in surfaces.values())


def file_of(
    surfaces: dict[str, Surface],
    stop: str,
    pupil: float,
    bias: float,
    half: float,
    image: float,
    wavelength: float,
    focal: float,
) -> CameraSpec:
    """A camera's file."""
    mirrors = "\n".join(
        f"  {name}: {{" + ", ".join(f"{key}: {value}" for key, value in one.items()) + "}"
        for name, one in surfaces.items()
    )
    text = f"""
name: drawn
focal_length: {focal:.12f} m
entrance_pupil: {pupil:.12f} m
field_bias: {bias:.12f} rad
field: {{x: {half:.12f} rad, y: {half:.12f} rad}}
wavelength: {wavelength * 1e9:.6f} nm
medium: air
stop: {stop}
mirrors:
{mirrors}
image: {{z: {image:.12f} m}}
line: {{pixels: 200, pitch: 7 um}}
edge_margin: 1 mm
"""
    return validate(CameraSpec, parse_yaml(text))
