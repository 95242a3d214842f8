"""Checks of paper 001's formulas for single changes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.monitoring import MonitorGeometry
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from twin.run.artefact import Cell
from twin.validation.checks.check import Check, CheckResult
from twin.validation.checks.group import Context, group_of
from twin.validation.paper_001 import formulas_images as motions

MIRROR_TURNS = tuple(math.radians(angle) for angle in (1 / 3600, 1 / 60, 0.5, 2.0, 10.0))
INSTRUMENT = "monitor_pair"
"""The camera that Table 5 implies: f = 7.7 m, area CCDs 0.73 m apart."""


def plane_mirror(check: Check, backend: Backend) -> CheckResult:
    """Whether the reflected ray turns by twice the turn of the mirror."""
    turns = np.array(MIRROR_TURNS)
    turned, moved = mirror_turns(backend, turns)
    ratio = turned / turns
    worst = float(ratio[np.argmax(np.abs(ratio - 2.0))])
    screen = float(np.max(np.abs(moved / np.tan(2 * turns) - 1.0)))
    how = (
        f"Exact trace of a ray off a plane mirror at {len(turns)} angles from 1 arcsec to 10°; the ratio farthest from "
        f"2 counts. On a screen at distance f the ray moves by f tan 2θ, as (1) says, to {screen:.0e} of it."
    )
    return check.evaluate(worst, None, how)


def mirror_turns(backend: Backend, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn of the reflected ray, radians, and how far it moves on a screen at unit distance, for turns of a mirror."""
    mirror = Element("mirror", "mirror", plane(), Interaction.REFLECT)
    assembly = Assembly(RigidTree((Body("mirror"),)), {"mirror": mirror}, {"path": ("mirror",)})
    states = [{"mirror": Motion(rotate=(float(turn), 0.0, 0.0))} for turn in (0.0, *turns)]
    rays = make_rays(backend, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]))
    traced = trace(backend, assemble(assembly, ["path"], states), rays, world=True)
    _, direction, _, _ = traced.numpy(traced.world)
    start, after = direction[0, 0], direction[1:, 0]
    turned = np.arctan2(np.linalg.norm(np.cross(start, after), axis=-1), after @ start)
    return turned, np.linalg.norm(after / (after @ start)[:, None] - start, axis=-1)


def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group; the images of all motions are one batch."""
    if "001.eq1.turn" in context.selected:
        context.progress(0.0, "trace a plane mirror")
        yield plane_mirror(context.check("001.eq1.turn"), context.backend)
        if len(context.selected) == 1:
            return
    context.progress(0.1, f"build {INSTRUMENT}")
    images = measured(context)
    shown = {}
    findings: dict[str, list[_Finding]] = {}
    for finding in _findings(images):
        findings.setdefault(finding.id, []).append(finding)
    for identifier, same in findings.items():
        if identifier in context.selected:
            check = context.check(identifier)
            yield check.worse(*(_row(check, finding) for finding in same))
            shown[identifier] = same[0].ratio
    context.progress(0.9, "draw")
    if shown:
        _show(context, shown)


def measured(context: Context) -> motions.SingleMotions:
    """The images of all motions and their spots."""
    experiment = context.experiment(INSTRUMENT)
    return motions.SingleMotions(experiment, context.seed, lambda done, text: context.progress(0.2 + 0.6 * done, text))


@dataclass(frozen=True)
class _Finding:
    """What the images say for one check, before it is evaluated; equations that say the same share a check."""

    id: str
    ratio: motions.Ratio
    how: str
    explained: tuple[float | None, ...] = ()
    implied: float | None = None
    facts: Mapping[str, float] = FrozenMap()


def _row(check: Check, finding: _Finding) -> CheckResult:
    ratio = finding.ratio
    how = f"{finding.how} By camera: {ratio.text}."
    return check.evaluate(ratio.value, ratio.sigma, how, finding.implied, finding.explained, facts=finding.facts)


def without_cos2(geometry: MonitorGeometry, local: float) -> float:
    """What (2) and Table 1 read of a turn about X without cos²β; local: focal length at the line's centre over f."""
    return math.cos(geometry.field_beta_rad) ** 2 * local


def _findings(images: motions.SingleMotions) -> Iterator[_Finding]:
    geometry = images.first
    f, f_x = geometry.principal_distance_m, geometry.principal_distance_across_m or geometry.principal_distance_m
    cos2 = math.cos(geometry.field_beta_rad) ** 2
    field = f"{math.degrees(geometry.field_beta_rad):.2f}°"
    rendered = f"{motions.FRAMES} frames of {INSTRUMENT} before and after"
    both = {direction: images.displacement(direction) for direction in ("along", "across")}
    far = max(both.values(), key=lambda ratio: abs(ratio.value - 1.0))
    yield _Finding(
        "001.eq1.displacement",
        far,
        f"{rendered} a turn of each return face by {motions.FACE / ARCSEC:g} arcsec, θ about either axis, the f of "
        f"that direction: {both['along'].value:.5f} along the line, {both['across'].value:.5f} across; the one farther "
        f"from 1 counts. At the area CCDs' field of {field} the tangent alone gives 1/cos²β = {1 / cos2:.5f} along the "
        "line; the rest is distortion.",
    )
    yield _Finding(
        "001.eq2",
        images.over_truth("along Y", "paper_single", "d_beta"),
        f"{rendered} a shift of {motions.SHIFT * 1e6:g} µm. β is not defined in print; taken as the area CCDs' field "
        f"angle, {field}, cos²β alone makes {cos2:.5f}.",
        (without_cos2(geometry, images.local_share),),
        facts={"local": images.local_share},
    )
    yield _Finding(
        "001.eq2.cos2",
        images.needed_factor("d_beta"),
        f"The images of 001.eq2; f is the focal length along the line at its centre. With β the area CCDs' field angle "
        f"of {field} the print implies cos²β = {cos2:.5f}.",
        (1.0,),
        cos2,
    )
    yield _Finding(
        "001.eq3",
        images.over_truth("along X", "paper_single", "d_alpha"),
        f"{rendered} a shift of {motions.SHIFT * 1e6:g} µm; α is not defined in print and taken as 0, the area CCDs' "
        "field across the line.",
        (f_x / f,),
        facts={"f": f, "f_x": f_x},
    )
    yield _Finding(
        "001.eq3.cos2",
        images.needed_factor("d_alpha"),
        "The images of 001.eq3. α is not defined in print; the area CCDs stand on the line of sight's plane, so that "
        f"cos²α = 1; with α the camera's field bias of {math.degrees(images.field_bias):.2f}° it would be "
        f"{math.cos(images.field_bias) ** 2:.4f}.",
        (f / f_x,),
        1.0,
    )
    rolled = images.roll()
    yield _Finding(
        "001.eq5",
        images.over_motion("about Z", "paper_single", "d_gamma", motions.TURN),
        f"{rendered} a turn of {motions.TURN / ARCSEC:g} arcsec. Δx / L₁ by (4), with L₁ = L/2 · tan Δγ: "
        f"{rolled.value:.5f}. The middle of the printed line of (4) has a factor L/2 too many; its end is right in "
        "units.",
        (2.0,),
    )
    yield _Finding(
        "001.eq5",
        rolled,
        f"{rendered} a turn of {motions.TURN / ARCSEC:g} arcsec; Δx / L₁ by (4), L₁ = L/2 · tan Δγ.",
        (None, 2.0),
    )
    scale = f"{rendered} a growth of the whole camera by {motions.SCALE * 1e6:g} ppm, detectors unchanged."
    grown = images.growth()
    yield _Finding(
        "001.eq7",
        images.over_truth("scale", "paper_single", "d_f"),
        f"{scale} Δy / (LΔf/f) by (6), with the traced Δf: {grown.value:.5f}; each side by itself is within "
        f"{images.growth_by_side():.1e} of the mean.",
    )
    yield _Finding("001.eq7", grown, f"{scale} Δy / (LΔf/f) by (6); Δf is the traced one.")
    moved = images.over_motion("piston", "paper_single", "d_f", motions.PISTON)
    true = fmean(images.true(camera, "piston", "d_f") for camera in images.cameras) / motions.PISTON
    yield _Finding(
        "001.eq7.piston",
        moved,
        f"{rendered} a motion of {motions.PISTON * 1e6:g} µm away from the optics. The traced principal distance "
        f"changes by {true:.4f} of the motion. The two cameras' monitor beams cross opposite parts of the pupil, where "
        "defocus moves spots differently.",
        (true,),
    )


def _show(context: Context, ratios: Mapping[str, motions.Ratio]) -> None:
    """Figure, table and data of what was found."""
    title = "Readings of paper 001's formulas over what they should be"
    motions.show_ratios(context, "ratios", title, {identifier: ratio.value for identifier, ratio in ratios.items()})
    cameras = list(next(iter(ratios.values())).cameras)
    rows: list[list[Cell]] = [
        [i, *(number for name in cameras for number in ratio.cameras[name])] for i, ratio in ratios.items()
    ]
    context.table(
        "cameras",
        "The same by camera",
        "Both cameras have the same prescription and noise of their own.",
        ("check", *(head for name in cameras for head in (name, f"{name}, sigma"))),
        rows,
    )


GROUP = group_of("001.formulas", run)
