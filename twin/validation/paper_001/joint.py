"""Paper 001's joint form: superposition (8), symmetry (9), separation (10) and (11), Table 1's last column on all four
changes at once, and Fig. 4's change of the intersection angle.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.units import ARCSEC
from twin.run.artefact import Cell, SvgFigure, Table
from twin.validation.checks.check import CheckResult
from twin.validation.checks.group import Context
from twin.validation.checks.printed import group_of
from twin.validation.paper_001 import formulas_images
from twin.validation.paper_001.formulas import INSTRUMENT, without_cos2
from twin.validation.paper_001.formulas_images import FRAMES, PARAMETERS, Ratio, ratios_svg
from twin.validation.paper_001.joint_images import AMOUNTS, JointMotions


def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group; the images of all states are one batch."""
    images = measured(context)
    ratios: dict[str, Ratio] = {}
    for identifier, ratio, how in _spots(images):
        if identifier in context.selected:
            yield context.check(identifier).evaluate(ratio.value, ratio.sigma, f"{how} By camera: {ratio.text}.")
            ratios[identifier] = ratio
    shown = {identifier: ratio.value for identifier, ratio in ratios.items()}
    if context.wants("001.table1"):
        for result in _table_1(context, images):
            shown[result.id] = float(result.measured or 0.0)
            yield result
    if "001.fig4.angle" in context.selected:
        result = _angle(context, images)
        shown[result.id] = float(result.measured or 0.0)
        yield result
    exact = {i: (context.check(i).equation, v) for i, v in shown.items() if context.check(i).printed == 1.0}
    if exact:
        caption = "Measured from images, mean of both cameras; the noise is below the size of the marks."
        title = "The joint form: what was found over what should be"
        context.add(SvgFigure("joint-ratios", title, caption, ratios_svg(exact)))


def measured(context: Context) -> JointMotions:
    """The images of all states and their spots."""
    context.progress(0.1, f"build {INSTRUMENT}")
    rounds = context.count(full=6, fast=1)
    experiment = context.experiment(INSTRUMENT)
    return JointMotions(experiment, rounds, context.seed, lambda done, text: context.progress(0.2 + 0.7 * done, text))


def _spots(images: JointMotions) -> Iterator[tuple[str, Ratio, str]]:
    """Id, what was found and how, of (8) to (11)."""
    sizes = (
        f"line CCD along X and Y by {AMOUNTS['d_alpha'] * 1e6:g} µm, about Z by {AMOUNTS['d_gamma'] / ARCSEC:g} "
        f"arcsec, camera grown by {AMOUNTS['d_f'] * 1e6:g} ppm"
    )
    frames = f"{FRAMES} frames before and after each"
    how = f"Spots of rendered images of each change and of both ({sizes}), {frames}; the worse side of each camera."
    yield "001.eq8.y", images.superposition("d_f", "d_beta", "Y", formulas_images.superposed), how
    yield "001.eq8.x", images.superposition("d_alpha", "d_gamma", "X", formulas_images.superposed), how
    how = (
        f"Spots of rendered images of the one change ({sizes}), {frames}. Reticle and area CCD stand 3 mm apart across "
        "the line, so that the spots have a lever arm of half that; the ratio is it over L/2."
    )
    yield "001.eq8.d_gamma_alone", images.stray("d_gamma", "Y", "X"), how
    yield "001.eq8.d_f_alone", images.stray("d_f", "X", "Y"), how
    how = f"Camera grown by {AMOUNTS['d_f'] * 1e6:g} ppm, {frames}."
    yield "001.eq9.d_f", images.symmetry("d_f", "Y", formulas_images.right_of_focal_length), how
    how = f"Line CCD moved along Y by {AMOUNTS['d_beta'] * 1e6:g} µm, {frames}."
    yield "001.eq9.d_beta", images.symmetry("d_beta", "Y", formulas_images.right_of_rotation), how
    parts = ((10, "Y", "d_f", 0), (10, "Y", "d_beta", 1), (11, "X", "d_alpha", 0), (11, "X", "d_gamma", 1))
    how = (
        f"Spots of rendered images of all four changes at once and of the one alone ({sizes}), {frames}. What is left "
        "is the lever arm of 001.eq8.d_gamma_alone and 001.eq8.d_f_alone."
    )
    for number, axis, parameter, part in parts:
        form = formulas_images.parts_along if number == 10 else formulas_images.parts_across
        yield f"001.eq{number}.{parameter}", images.separated(parameter, axis, part, form), how


def _table_1(context: Context, images: JointMotions) -> Iterator[CheckResult]:
    matrix, sigma = images.response("paper_joint")
    right, _ = images.response("derived")
    g = images.first
    f, f_x = g.focal_length_m, g.focal_length_x_m or g.focal_length_m
    count = len(images.mixtures)
    how = (
        f"{count} random mixtures of all four changes in each camera (line CCD along X, Y, about Z; camera grown), "
        f"rendered, {FRAMES} frames each; readings fitted to the traced changes of line of sight, roll and principal "
        "distance, mean of both cameras."
    )
    facts = {"f": f, "f_x": f_x, "local": images.local_share}
    explained = {
        "d_alpha": f_x / f, "d_beta": without_cos2(g, images.local_share), "d_gamma": 2.0 * f_x / f, "d_f": 0.5,
    }  # fmt: skip
    for k, parameter in enumerate(PARAMETERS):
        identifier = f"001.table1.{parameter}"
        if identifier in context.selected:
            text = f"{how} With the corrected factors: {right[k, k]:.4f}."
            if parameter == "d_f":
                text += (
                    f" Table 1 does not say what Y_L is. (2) has y01 − y11 on the left side, by which this is "
                    f"{-matrix[k, k]:.4f}, and (7) y11 − y01; for X, (3) and (5) agree."
                )
            value, noise = matrix[k, k], sigma[k, k]
            yield context.check(identifier).evaluate(value, noise, text, None, [explained[parameter]], **facts)
    yield from _couplings(context, images, how, matrix, sigma, right)
    rows: list[list[Cell]] = [
        [
            name,
            *(f"{matrix[k, n]:.4f} ± {sigma[k, n]:.4f}" for n in range(4)),
            *(f"{right[k, n]:.4f}" for n in range(4)),
        ]
        for k, name in enumerate(PARAMETERS)
    ]
    context.add(
        Table(
            "table1-response",
            "What Table 1's joint form reads per true change, all four changing",
            "Angles in arcsec, Δf in µm. Left: Table 1 as printed; right: corrected factors and the camera's own "
            "gradients. Perfect is 1 on the diagonal and 0 off it.",
            ("reading", *(f"per {p}" for p in PARAMETERS), *(f"corrected, per {p}" for p in PARAMETERS)),
            rows,
        )
    )


def _couplings(
    context: Context, images: JointMotions, how: str, matrix: np.ndarray, sigma: np.ndarray, right: np.ndarray
) -> Iterator[CheckResult]:
    g = images.first
    f, f_x = g.focal_length_m, g.focal_length_x_m or g.focal_length_m
    cases = (
        ("d_gamma_by_d_beta", 2, 1, -2.0 * f_x / f * g.d_gamma_per_beta),
        ("d_f_by_d_alpha", 3, 0, -0.5 * g.d_f_per_alpha_m * ARCSEC / 1e-6),
    )
    for name, k, n, predicted in cases:
        if f"001.table1.{name}" in context.selected:
            text = f"{how} With that gradient added (corrected form): {right[k, n]:.4f}."
            check = context.check(f"001.table1.{name}")
            yield check.evaluate(matrix[k, n], sigma[k, n], text, None, [predicted])


def _angle(context: Context, images: JointMotions) -> CheckResult:
    slope, sigma, rest = images.angle("paper_joint")
    better = images.angle("derived")
    g = images.first
    f_x = g.focal_length_x_m or g.focal_length_m
    how = (
        f"{len(images.mixtures)} random mixtures of all four changes in each of both cameras, rendered; centres, Table "
        "1, and the angle between the two turned lines of sight, the forward camera's Δα counting plus; slope on the "
        f"traced change, which is {np.std(images.truth.angle_change[images.mixtures]) / ARCSEC:.2f} arcsec rms. Left "
        f"over: {rest / ARCSEC:.4f} arcsec rms; corrected factors: slope {better[0]:.4f}, left over "
        f"{better[2] / ARCSEC:.4f} arcsec rms."
    )
    return context.check("001.fig4.angle").evaluate(slope, sigma, how, None, [f_x / g.focal_length_m])


GROUP = group_of("001.joint", run)
