"""Paper 001's formulas: the autocollimation principle (1), the single-change formulas (2), (3), (5), (7) and Table 1's
d_f, each fed with rendered spot images of the one motion that it was derived for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from analysis.monitoring import ARCSEC
from optics.assembly import Assembly
from optics.backend import Backend
from optics.element import Element, Interaction
from optics.surface import plane
from optics.system import assemble
from optics.trace import make_rays, trace
from optics.tree import Body, Motion, RigidTree
from twin.artefact import Cell, SvgFigure, Table
from twin.validation.check import DIFFERS, DOUBTFUL, Check, CheckResult, Explanation
from twin.validation.formulas_001_figure import ratios_svg
from twin.validation.formulas_001_images import FACE, FRAMES, PISTON, SCALE, SHIFT, TURN, Ratio, SingleMotions
from twin.validation.group import CheckGroup, Context

INSTRUMENT = "monitor_pair"
"""The camera that Table 5 implies: f = 7.7 m, area CCDs 0.73 m apart."""
MIRROR_TURNS = tuple(math.radians(angle) for angle in (1 / 3600, 1 / 60, 0.5, 2.0, 10.0))

_ANGLE = "1 % of a change of 5 arcsec is the 0.05 arcsec of Table 5"
_ROLL = "1 % of a change of 215 arcsec is the 2.15 arcsec of Table 5"
_FOCAL = "1 % of a change of 4 mm is the 0.04 mm of Table 5"

CHECKS = (
    Check(
        "001.eq1.turn", "section 1.1", "A plane mirror turned by θ turns the reflected ray by 2θ", "1", 2.0, 1e-6,
        "rounding in the smallest angle",
    ),
    Check(
        "001.eq1.displacement", "eq. (1)", "The image then moves by L = f tan 2θ: moved / (f tan 2θ)", "1", 1.0, 0.01,
        "the camera's distortion at the field of the area CCDs is below 1 %",
    ),
    Check(
        "001.eq2", "eq. (2)", "Line CCD moved along Y: Δβ read / true turn of the line of sight about X", "1", 1.0,
        0.01, _ANGLE,
    ),
    Check(
        "001.eq2.cos2", "eq. (2)", "The factor cos²β in (2): true Δβ · 2f / (mean spot shift)", "1",
        None, 5e-4, "a quarter of 1 − cos²β",
    ),
    Check(
        "001.eq3", "eq. (3)", "Line CCD moved along X: Δα read / true turn of the line of sight about Y", "1", 1.0,
        0.01, _ANGLE,
    ),
    Check(
        "001.eq5", "eq. (5)", "Line CCD turned about the line of sight: Δγ read / turn of the line CCD", "1", 1.0, 0.01,
        _ROLL,
    ),
    Check(
        "001.eq7", "eq. (7)", "Camera grown with its focus kept: Δf read / true change of the principal distance", "1",
        1.0, 0.01, _FOCAL,
    ),
    Check(
        "001.eq7.piston", "section 2.4, eq. (7)",
        "Line CCD moved parallel to itself changes the focal length by as much: Δf read / motion", "1", 1.0, 0.02,
        "1 µm in a motion of 50 µm",
    ),
    Check(
        "001.table1.d_f", "Table 1, uncertain changes",
        "Camera grown with its focus kept: joint Δf read / true change of the principal distance", "1", 1.0, 0.01,
        _FOCAL,
    ),
)  # fmt: skip


def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group; the images of all motions are one batch."""
    if "001.eq1.turn" in context.selected:
        context.progress(0.0, "trace a plane mirror")
        yield _mirror(context)
    if not context.selected - {"001.eq1.turn"}:
        return
    context.progress(0.1, f"build {INSTRUMENT}")
    experiment = context.experiment(INSTRUMENT)
    images = SingleMotions(experiment, context.seed, lambda done, text: context.progress(0.2 + 0.6 * done, text))
    shown = {}
    for finding in _findings(images):
        if finding.id in context.selected:
            ratio = finding.ratio
            how = f"{finding.how} By camera: {ratio.text}."
            check = context.check(finding.id)
            yield check.judge(ratio.value, ratio.sigma, how, finding.expected, finding.explanations)
            shown[finding.id] = ratio
    context.progress(0.9, "draw")
    if shown:
        _show(context, shown)


def _mirror(context: Context) -> CheckResult:
    """Section 1.1's principle on a bare mirror."""
    turns = np.array(MIRROR_TURNS)
    turned, moved = mirror_turns(context.backend, turns)
    ratio = turned / turns
    worst = float(ratio[np.argmax(np.abs(ratio - 2.0))])
    screen = float(np.max(np.abs(moved / np.tan(2 * turns) - 1.0)))
    how = (
        f"Exact trace of a ray off a plane mirror at {len(turns)} angles from 1 arcsec to 10°; the ratio farthest from "
        f"2 counts. On a screen at distance f the ray moves by f tan 2θ, as (1) says, to {screen:.0e} of it."
    )
    return context.check("001.eq1.turn").judge(worst, None, how)


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


@dataclass(frozen=True)
class _Finding:
    """What the images say for one check, before it is judged."""

    id: str
    ratio: Ratio
    how: str
    explanations: tuple[Explanation, ...] = ()
    expected: float | None = None


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
        (Explanation(cos2, DOUBTFUL, "The factor cos²β does not belong there, see 001.eq2.cos2."),),
    )
    yield _Finding(
        "001.eq2.cos2",
        images.needed_factor(),
        f"The images of 001.eq2; f is the focal length along the line at its centre. With β the area CCDs' field angle "
        f"of {field} the print implies cos²β = {cos2:.5f}.",
        (
            Explanation(
                1.0,
                DOUBTFUL,
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
                DIFFERS,
                f"The formula knows one f. A field-biased camera is anamorphic: f = {f:.3f} m along the line, f_x = "
                f"{f_x:.3f} m across it, and with f_x the formula holds.",
            ),
        ),
    )
    yield _Finding(
        "001.eq5",
        images.over_motion("about Z", "paper_single", "d_gamma", TURN),
        f"{rendered} a turn of {TURN / ARCSEC:g} arcsec.",
        (
            Explanation(
                2.0,
                DOUBTFUL,
                "A turn Δγ moves the ends of the line CCD by ±LΔγ/2 and the reflected spots by twice that against "
                "them, so X_L − X_R = 2LΔγ/δ: (4), (5) and Table 1 leave out the doubling by the reflection that (2) "
                "and (3) have.",
            ),
        ),
    )
    scale = f"{rendered} a growth of the whole camera by {SCALE * 1e6:g} ppm, detectors unchanged."
    yield _Finding("001.eq7", images.over_truth("scale", "paper_single", "d_f"), scale)
    moved = images.over_motion("piston", "paper_single", "d_f", PISTON)
    true = float(np.mean([images.true(camera, "piston", "d_f") for camera in images.cameras])) / PISTON
    yield _Finding(
        "001.eq7.piston",
        moved,
        f"{rendered} a motion of {PISTON * 1e6:g} µm away from the optics. The traced principal distance changes by "
        f"{true:.4f} of the motion. The two cameras' monitor beams cross opposite parts of the pupil, where defocus "
        "moves spots differently.",
        (
            Explanation(
                true,
                DIFFERS,
                "The paper takes a lens whose chief rays spread from a rear node at distance f. The off-axis "
                "three-mirror camera is nearly telecentric in image space, so that such a motion is mostly defocus and "
                "hardly changes the scale; (7) reads what does change.",
            ),
        ),
    )
    yield _Finding(
        "001.table1.d_f",
        images.over_truth("scale", "paper_joint", "d_f"),
        f"{scale} Y_L and Y_R are read with the sign of (7).",
        (
            Explanation(
                0.5,
                DOUBTFUL,
                "Table 1 has (Y_L − Y_R)/2 · δf/(2L) where (7), from which it is said to follow, has "
                "(Y_L − Y_R)/2 · δf/L.",
            ),
        ),
    )


def _show(context: Context, ratios: Mapping[str, Ratio]) -> None:
    """Figure, table and data of what was found."""
    drawn = {i: (context.check(i).equation, r.value) for i, r in ratios.items() if context.check(i).printed == 1.0}
    if drawn:
        context.add(
            SvgFigure(
                "ratios",
                "Readings of paper 001's formulas over what they should be",
                "Measured from images, mean of both cameras; the noise is below the size of the marks.",
                ratios_svg(drawn),
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


GROUP = CheckGroup("001.formulas", "Formulas (1)–(7) and Table 1", 3.0, CHECKS, run)
