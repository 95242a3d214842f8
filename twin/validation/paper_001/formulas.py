"""Checks of paper 001's formulas for single changes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from analysis.monitor.monitoring import MonitorGeometry
from analysis.units import ARCSEC
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree
from optics.numerics.backend import Backend
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from twin.run.artefact import Cell, SvgFigure, Table
from twin.validation.checks.check import CORRECTED, REFUTED, Check, CheckResult, Explanation
from twin.validation.checks.group import CheckGroup, Context
from twin.validation.paper_001.formulas_images import (
    FACE,
    FRAMES,
    PISTON,
    SCALE,
    SHIFT,
    TURN,
    Ratio,
    SingleMotions,
    ratios_svg,
)

MIRROR_TURNS = tuple(math.radians(angle) for angle in (1 / 3600, 1 / 60, 0.5, 2.0, 10.0))
INSTRUMENT = "monitor_pair"
"""The camera that Table 5 implies: f = 7.7 m, area CCDs 0.73 m apart."""

ANGLE_DIGIT = "1 % of a change of 5 arcsec is the 0.05 arcsec of Table 5"
_COS2 = "a quarter of 1 − cos²β"
ROLL_DIGIT = "1 % of a change of 215 arcsec is the 2.15 arcsec of Table 5"
FOCAL_DIGIT = "1 % of a change of 4 mm is the 0.04 mm of Table 5"

CHECKS = (
    Check(
        "001.eq1.turn", "section 1.1", "A plane mirror turned by θ turns the reflected ray by 2θ", "1", 2.0, 1e-6,
        "rounding in the smallest angle",
        separation=1.0, alternative="once the turn",
    ),
    Check(
        "001.eq1.displacement", "eq. (1)", "The image then moves by L = f tan 2θ: θ read / θ made", "1", 1.0, 0.01,
        "the camera's distortion at the field of the area CCDs is below 1 %",
        separation=0.5, alternative="θ in place of 2θ",
    ),
    Check(
        "001.eq2", "eq. (2)", "Line CCD moved along Y: Δβ read / true turn of the line of sight about X", "1", 1.0,
        5e-4, _COS2, expected=CORRECTED,
        separation=0.00225, alternative="a reading without the factor cos²β",
    ),
    Check(
        "001.eq2.cos2", "eq. (2)", "The factor cos²β in (2): true Δβ · 2f / (mean spot shift)", "1",
        None, 5e-4, _COS2, expected=CORRECTED,
        separation=0.00225, alternative="no factor",
    ),
    Check(
        "001.eq3", "eq. (3)", "Line CCD moved along X: Δα read / true turn of the line of sight about Y", "1", 1.0,
        0.01, ANGLE_DIGIT, expected=CORRECTED,
        separation=0.03, alternative="the other focal length, f across the line",
    ),
    Check(
        "001.eq3.cos2", "eq. (3)", "The factor cos²α in (3): true Δα · 2f / (mean spot shift)", "1",
        None, 0.001, "0.1 %, a tenth of what Table 5 can tell", expected=CORRECTED,
        separation=0.029, alternative="f over f across the line",
    ),
    Check(
        "001.eq5", "eqs. (4), (5)",
        "Line CCD turned about the line of sight: Δγ read / turn of the line CCD, and by (4) Δx / L₁ of its ends", "1",
        1.0, 0.01, ROLL_DIGIT, expected=CORRECTED,
        separation=1.0, alternative="twice as much: the doubling by the reflection", also=("001.eq4",),
    ),
    Check(
        "001.eq7", "eqs. (6), (7)",
        "Camera grown with its focus kept: Δf read / true change of the principal distance, and by (6) Δy / (LΔf/f)",
        "1", 1.0, 0.01, FOCAL_DIGIT,
        separation=0.5, alternative="half of it, as Table 1 has it", also=("001.eq6",),
    ),
    Check(
        "001.eq7.piston", "section 2.4, eq. (7)",
        "Line CCD moved parallel to itself changes the focal length by as much: Δf read / motion", "1", 1.0, 0.02,
        "1 µm in a motion of 50 µm", expected=REFUTED,
        separation=0.9, alternative="a motion that is defocus",
    ),
)  # fmt: skip


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
    if not context.selected - {"001.eq1.turn"}:
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


def measured(context: Context) -> SingleMotions:
    """The images of all motions and their spots."""
    experiment = context.experiment(INSTRUMENT)
    return SingleMotions(experiment, context.seed, lambda done, text: context.progress(0.2 + 0.6 * done, text))


@dataclass(frozen=True)
class _Finding:
    """What the images say for one check, before it is evaluated; equations that say the same share a check."""

    id: str
    ratio: Ratio
    how: str
    explanations: tuple[Explanation, ...] = ()
    implied: float | None = None


def _row(check: Check, finding: _Finding) -> CheckResult:
    ratio = finding.ratio
    how = f"{finding.how} By camera: {ratio.text}."
    return check.evaluate(ratio.value, ratio.sigma, how, finding.implied, finding.explanations)


def without_cos2(geometry: MonitorGeometry, local: float) -> Explanation:
    """Why (2) and Table 1 read a turn about X too small; local: focal length at the line's centre over f."""
    return Explanation(
        math.cos(geometry.field_beta_rad) ** 2 * local,
        CORRECTED,
        "The factor cos²β does not belong there, see 001.eq2.cos2; the rest is the focal length at the middle of the "
        f"line, where Δβ is taken, {local:.5f} of the f over the whole line that (7) needs.",
    )


def _findings(images: SingleMotions) -> Iterator[_Finding]:
    geometry = images.first
    f, f_x = geometry.focal_length_m, geometry.focal_length_x_m or geometry.focal_length_m
    cos2 = math.cos(geometry.field_beta_rad) ** 2
    field = f"{math.degrees(geometry.field_beta_rad):.2f}°"
    rendered = f"{FRAMES} frames of {INSTRUMENT} before and after"
    both = {direction: images.displacement(direction) for direction in ("along", "across")}
    far = max(both.values(), key=lambda ratio: abs(ratio.value - 1.0))
    yield _Finding(
        "001.eq1.displacement",
        far,
        f"{rendered} a turn of each return face by {FACE / ARCSEC:g} arcsec, θ about either axis, the f of that "
        f"direction: {both['along'].value:.5f} along the line, {both['across'].value:.5f} across; the one farther from "
        f"1 counts. At the area CCDs' field of {field} the tangent alone gives 1/cos²β = {1 / cos2:.5f} along the "
        "line; the rest is distortion.",
    )
    yield _Finding(
        "001.eq2",
        images.over_truth("along Y", "paper_single", "d_beta"),
        f"{rendered} a shift of {SHIFT * 1e6:g} µm. β is not defined in print; taken as the area CCDs' field angle, "
        f"{field}, cos²β alone makes {cos2:.5f}.",
        (without_cos2(geometry, images.local_share),),
    )
    yield _Finding(
        "001.eq2.cos2",
        images.needed_factor("d_beta"),
        f"The images of 001.eq2; f is the focal length along the line at its centre. With β the area CCDs' field angle "
        f"of {field} the print implies cos²β = {cos2:.5f}.",
        (
            Explanation(
                1.0,
                CORRECTED,
                "A shift s of the line CCD moves every spot by 2s whatever its field, so (2) needs no such factor; "
                "cos²β is right for a mirror turned at field β, which is not the motion that (2) is derived for.",
            ),
        ),
        cos2,
    )
    yield _Finding(
        "001.eq3",
        images.over_truth("along X", "paper_single", "d_alpha"),
        f"{rendered} a shift of {SHIFT * 1e6:g} µm; α is not defined in print and taken as 0, the area CCDs' field "
        "across the line.",
        (
            Explanation(
                f_x / f,
                CORRECTED,
                f"The formula knows one f. A field-biased camera is anamorphic: f = {f:.3f} m along the line, f_x = "
                f"{f_x:.3f} m across it, and with f_x the formula holds.",
            ),
        ),
    )
    yield _Finding(
        "001.eq3.cos2",
        images.needed_factor("d_alpha"),
        "The images of 001.eq3. α is not defined in print; the area CCDs stand on the line of sight's plane, so that "
        f"cos²α = 1; with α the camera's field bias of {math.degrees(images.field_bias):.2f}° it would be "
        f"{math.cos(images.field_bias) ** 2:.4f}.",
        (
            Explanation(
                f / f_x,
                CORRECTED,
                "As in (2), the field has no part in it: what is missing from 1 is f/f_x, the camera's own focal "
                "length across the line.",
            ),
        ),
        1.0,
    )
    rolled = images.roll()
    yield _Finding(
        "001.eq5",
        images.over_motion("about Z", "paper_single", "d_gamma", TURN),
        f"{rendered} a turn of {TURN / ARCSEC:g} arcsec. Δx / L₁ by (4), with L₁ = L/2 · tan Δγ: "
        f"{rolled.value:.5f}. The middle of the printed line of (4) has a factor L/2 too many; its end is right in "
        "units.",
        (
            Explanation(
                2.0,
                CORRECTED,
                "A turn Δγ moves the ends of the line CCD by ±LΔγ/2 and the reflected spots by twice that against "
                "them, so X_L − X_R = 2LΔγ/δ: (4), (5) and Table 1 leave out the doubling by the reflection that (2) "
                "and (3) have.",
            ),
        ),
    )
    yield _Finding(
        "001.eq5",
        rolled,
        f"{rendered} a turn of {TURN / ARCSEC:g} arcsec; Δx / L₁ by (4), L₁ = L/2 · tan Δγ.",
        (
            Explanation(
                2.0,
                CORRECTED,
                "The ends of the line CCD move by L₁ and the reflected spots by L₁ the other way, so that they are "
                "seen to move by 2L₁ on the area CCDs: (4) takes Δx for L₁.",
            ),
        ),
    )
    scale = f"{rendered} a growth of the whole camera by {SCALE * 1e6:g} ppm, detectors unchanged."
    grown = images.growth()
    yield _Finding(
        "001.eq7",
        images.over_truth("scale", "paper_single", "d_f"),
        f"{scale} Δy / (LΔf/f) by (6), with the traced Δf: {grown.value:.5f}; each side by itself is within "
        f"{images.growth_by_side():.1e} of the mean.",
    )
    yield _Finding(
        "001.eq7",
        grown,
        f"{scale} Δy / (LΔf/f) by (6); Δf is the traced one.",
    )
    moved = images.over_motion("piston", "paper_single", "d_f", PISTON)
    true = fmean(images.true(camera, "piston", "d_f") for camera in images.cameras) / PISTON
    yield _Finding(
        "001.eq7.piston",
        moved,
        f"{rendered} a motion of {PISTON * 1e6:g} µm away from the optics. The traced principal distance changes by "
        f"{true:.4f} of the motion. The two cameras' monitor beams cross opposite parts of the pupil, where defocus "
        "moves spots differently.",
        (
            Explanation(
                true,
                REFUTED,
                "The paper takes a lens whose chief rays spread from a rear node at distance f. The off-axis "
                "three-mirror camera is nearly telecentric in image space, so that such a motion is mostly defocus and "
                "hardly changes the scale; (7) reads what does change.",
            ),
        ),
    )


def _show(context: Context, ratios: Mapping[str, Ratio]) -> None:
    """Figure, table and data of what was found."""
    exact = {i: (context.check(i).equation, r.value) for i, r in ratios.items() if context.check(i).printed == 1.0}
    if exact:
        context.add(
            SvgFigure(
                "ratios",
                "Readings of paper 001's formulas over what they should be",
                "Measured from images, mean of both cameras; the noise is below the size of the marks.",
                ratios_svg(exact),
            )
        )
    cameras = list(next(iter(ratios.values())).cameras)
    rows: list[list[Cell]] = [
        [i, *(number for name in cameras for number in ratio.cameras[name])] for i, ratio in ratios.items()
    ]
    context.add(
        Table(
            "cameras",
            "The same by camera",
            "Both cameras have the same prescription and noise of their own.",
            ("check", *(head for name in cameras for head in (name, f"{name}, sigma"))),
            rows,
        )
    )


GROUP = CheckGroup("001.formulas", "Formulas (1)–(7) on single motions", 3.0, CHECKS, run)
