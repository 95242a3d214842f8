"""Paper 001's error budget: Tables 3 and 4 and (12), with their figure, and Table 5 with section 3.2.3."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import hypot, log, sqrt

from analysis.arrays import ARCSEC
from twin.monitor.simulated_budget import BudgetLine, Together
from twin.run.artefact import Cell, Data
from twin.run.svg import BLUE, INK, look, new_figure, plain_axes, to_svg
from twin.validation.checks.check import SIGMAS, CheckResult, Chosen, Supposed
from twin.validation.checks.group import Context, group_of
from twin.validation.paper_001 import budget
from twin.validation.paper_001.budget import FEW_DRAWS, TABLE_3, BudgetImages

_LARGEST = ("prism_180_thermal", "prism_0_rotation")
"""The two lines that make most of (12)."""
_INPUT_OF = {
    "centroid": "light",
    "coordinate_thermal": "temperature of the focal plane",
    "prism_180_thermal": "gradient in the 180° prism",
    "prism_0_thermal": "gradient in the 0° prism",
    "prism_180_rotation": "rotation of the 180° prism",
    "prism_0_rotation": "rotation of the 0° prism",
    "central_prism_thermal": "gradient in the central prism",
}
"""What a line's input is; those of rotations act through the prisms' residual angle errors, which are chosen too."""


def budget_svg(lines: Mapping[str, tuple[float, float, float]]) -> str:
    """A row per line: text -> (printed, simulated, sigma), arcsec."""
    with look("error-budget"):
        figure = new_figure(1.0 + 0.32 * len(lines))
        axes = figure.subplots()
        for row, (printed, simulated, sigma) in enumerate(lines.values()):
            axes.plot([printed], [row], "|", color=INK, ms=16.0, mew=2.0, label="printed" if row == 0 else None)
            low = max(simulated - 3.0 * sigma, 0.5 * simulated)
            axes.plot([low, simulated + 3.0 * sigma], [row, row], color=BLUE, lw=2.0)
            axes.plot([simulated], [row], "o", color=BLUE, ms=6.0, label="simulated" if row == 0 else None)
        axes.set_xscale("log")
        axes.set_xlim(1e-3, 0.3)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_yticks(range(len(lines)), list(lines))
        axes.set_ylim(len(lines) - 0.5, -0.6)
        axes.set_xlabel("error of one spot, 3σ [arcsec]")
        axes.tick_params(axis="y", length=0)
        figure.legend(loc="outside upper right", ncols=2, frameon=False)
        plain_axes(axes)
        return to_svg(figure)


def run(context: Context) -> Iterator[CheckResult]:
    """Simulate what is wanted; (12) needs all lines."""
    images = measured(context)
    for name, line in images.lines.items():
        if f"001.table3.{name}" in context.selected:
            yield _line(context, images, line)
    if images.halved is not None:
        before, after, ratio = images.halved
        how = (
            f"The rhomboids take over half of the transfer; the glass gets shorter, {after:.3f} m for {before:.3f} m: "
            "the path across the gradient is halved, the ways in and out of the prism stay. Same gradients, rms of "
            "all spots."
        )
        yield context.check("001.table3.prism_180_thermal.halved").evaluate(ratio, None, how, 0.5)
    yield from _totals(context, images)
    yield from _monitored(context, images)
    if images.lines:
        _show(context, images.lines)


def measured(context: Context) -> BudgetImages:
    """What was simulated for the selected checks."""
    return budget.measured(context)


def _line(context: Context, images: BudgetImages, line: BudgetLine) -> CheckResult:
    trials = images.inputs[0] * (2 if line.name in FEW_DRAWS else 1)
    how = (
        f"Input (3σ): {line.value:.4g} {line.unit}. {trials} random states, rendered, spots measured; 3 x rms over all "
        f"spots, along the line {line.by_axis[0] / ARCSEC:.3f}, across {line.by_axis[1] / ARCSEC:.3f} arcsec. "
        f"For 0.1 arcsec: {line.allowed:.3g} {line.unit}."
    )
    if line.name == "coordinate_thermal":
        assert images.focal_plane is not None
        true, read = images.focal_plane
        how += (
            " It moves both spots of a camera apart, not together: all of it is d_f, none of it rotation. The line CCD "
            f"grows with its focal plane, so that this is a true change of {1e6 * true:.2f} um, which (7) reads as "
            f"{1e6 * read:.2f}; an error of the monitor it is where the line CCD does not follow."
        )
    check = context.check(f"001.table3.{line.name}")
    # proportional to the input, but for the centroid's light, whose power the budget's own search tells
    power = log(0.1 * ARCSEC / line.three_sigma) / log(line.allowed / line.value)
    chosen = Chosen.power(_INPUT_OF[line.name], line.value, line.unit, line.three_sigma / ARCSEC, power)
    return check.evaluate(line.three_sigma / ARCSEC, line.sigma / ARCSEC, how, inputs=[chosen])


def _in_sum(images: BudgetImages, name: str, value: float) -> Chosen:
    """The input of one line, on which a root of squares hangs only with the line's share; value: of the root."""
    line = images.lines[name]
    share = (budget.frame_mean(1.0) if name == "centroid" else 1.0) * line.three_sigma / ARCSEC

    def response(factor: float) -> float:
        return sqrt(value**2 + (factor**2 - 1.0) * min(share, value) ** 2)

    return Chosen(_INPUT_OF[name], line.value, line.unit, response)


def _totals(context: Context, images: BudgetImages) -> Iterator[CheckResult]:
    """(12) and Table 4."""
    trials, causes, groups = images.inputs
    if "001.eq12" in context.selected:
        assert images.together is not None
        total, sigma = budget.root_sum_of_squares(images.lines)
        value, spread = images.together.spot
        plain = sum(line.three_sigma for line in images.lines.values())
        measured, noise = value / total, value / total * hypot(spread / value, sigma / total)
        # with a correlation of all pairs the square grows by as much of what a plain sum has more
        largest = 1.0 + context.check("001.eq12").tolerance + SIGMAS * noise
        most = ((largest / measured) ** 2 - 1.0) / ((plain / total) ** 2 - 1.0)
        limit_text = f"holds up to a correlation of {max(most, 0.0):.2g} of all pairs"
        independent = Supposed("causes that are independent", limit_text)
        how = (
            f"{causes} random states with all causes, {budget.FRAMES} noisy frames each: "
            f"{value / ARCSEC:.4f} arcsec; (12) over lines of {trials} states each: {total / ARCSEC:.4f}. The causes "
            "are drawn independently, as (12) takes them; the images show that they then add. A drift of temperature "
            f"that all glass shares would break it: the plain sum of the lines is {plain / ARCSEC:.3f} arcsec."
        )
        yield context.check("001.eq12").evaluate(measured, noise, how, inputs=[independent])
    if "001.eq12.frames" in context.selected:
        assert images.scatter is not None
        (single, s_sigma), (mean, m_sigma) = images.scatter
        should = budget.frame_mean(single)
        rest = budget.root_sum({n: v for n, v in TABLE_3.items() if n != "centroid"})
        printed = budget.root_sum(TABLE_3)
        how = (
            f"{groups} groups of {budget.FRAMES} frames, energy centroid: {single / ARCSEC:.5f} arcsec (3σ) "
            f"in single frames, {mean / ARCSEC:.5f} in means. Of the printed lines the centroid's is then the smallest "
            f"but one: without it Table 4 were {rest:.4f} for {printed:.4f} arcsec, so that more frames gain nothing."
        )
        ratio = mean / should
        yield context.check("001.eq12.frames").evaluate(ratio, ratio * hypot(s_sigma / single, m_sigma / mean), how)
    if "001.table4.printed_lines" in context.selected:
        how = "Arithmetic of the printed numbers alone: Table 4 follows from Table 3 by (12) with 9 frames."
        yield context.check("001.table4.printed_lines").evaluate(budget.root_sum(TABLE_3), None, how)
    if "001.table4.root_sum" in context.selected:
        total, sigma = budget.root_sum_of_squares(images.lines)
        how = f"(12) over the seven simulated lines, {budget.FRAMES} frames, {trials} states and more each."
        inputs = [_in_sum(images, name, total / ARCSEC) for name in _LARGEST]
        yield context.check("001.table4.root_sum").evaluate(total / ARCSEC, sigma / ARCSEC, how, inputs=inputs)
    if "001.table4.together" in context.selected:
        assert images.together is not None
        how = f"{causes} random states with all causes, {budget.FRAMES} noisy frames each, energy centroid."
        value, spread = images.together.spot
        chosen = all_causes(value / ARCSEC)
        yield context.check("001.table4.together").evaluate(value / ARCSEC, spread / ARCSEC, how, inputs=[chosen])


def _show(context: Context, lines: dict[str, BudgetLine]) -> None:
    texts = {n: context.check(f"001.table3.{n}").statement.removesuffix(", error of one spot") for n in lines}
    rows: list[list[Cell]] = []
    for name, line in lines.items():
        rows.append([texts[name], f"{TABLE_3[name]:g}", f"{line.three_sigma / ARCSEC:.4f}",
                     f"{line.sigma / ARCSEC:.4f}", f"{line.value:.4g} {line.unit}",
                     f"{line.allowed:.3g} {line.unit}"])  # fmt: skip
    context.table(
        "table3",
        "Table 3 by mechanism, and what each line would allow",
        "Error of one spot per axis, 3σ, arcsec. Last column: the input at which the line alone is 0.1 arcsec.",
        ("line", "printed", "simulated", "sigma", "input, 3σ", "allowed for 0.1 arcsec"),
        rows,
    )
    data = {n: {"three_sigma_arcsec": l.three_sigma / ARCSEC, "sigma_arcsec": l.sigma / ARCSEC, "input": l.value,
                "unit": l.unit, "input_for_0.1_arcsec": l.allowed} for n, l in lines.items()}  # fmt: skip  # noqa: E741
    context.add(Data("budget", "The budget as data", "Inputs and results of every line.", data))
    shown = {texts[n]: (TABLE_3[n], line.three_sigma / ARCSEC, line.sigma / ARCSEC) for n, line in lines.items()}
    caption = (
        "Printed and simulated error of one spot, 3σ, on a logarithmic scale; bars: three sigma of the simulation."
    )
    context.figure("table3-figure", "Table 3, printed and simulated", caption, budget_svg(shown))


_TABLE_4 = budget.TABLE_4 * ARCSEC
_PARAMETERS = {
    "d_beta": ("d_beta_rad", "Δβ, 3σ", "arcsec"),
    "d_alpha": ("d_alpha_rad", "Δα, 3σ", "arcsec"),
    "d_gamma": ("d_gamma_rad", "Δγ by (5), 3σ", "arcsec"),
    "d_f": ("d_f_m", "Δf by (7), 3σ", "mm"),
}
_UNIT = {"arcsec": ARCSEC, "mm": 1e-3}
_SHOWN = ("paper_single", "paper_joint", "derived")


def _monitored(context: Context, images: BudgetImages) -> Iterator[CheckResult]:
    """Table 5."""
    if images.together is not None:
        for name in _PARAMETERS:
            if f"001.table5.{name}" in context.selected:
                yield _simulated(context, images, images.together, name)
        yield from _claims(context, images.together)
        if any(f"001.table5.{name}" in context.selected for name in _PARAMETERS):
            _show_errors(context, images, images.together)
    for name in _PARAMETERS:
        if f"001.table5.{name}.propagated" in context.selected:
            yield _propagated(context, images, name)
    if "001.table5.d_f.by_table1" in context.selected:
        value = budget.propagated(_TABLE_4, images.geometry, "paper_joint")["d_f"] / 1e-3
        how = "Table 1's joint factors on the printed Table 4; the other three rows come out alike by both columns."
        yield context.check("001.table5.d_f.by_table1").evaluate(value, None, how, None, [0.02])
    if images.roll_pixels is not None:
        how = (
            "Line CCD turned by 2.15 arcsec, traced; the shift of the line of sight of its end. At the middle of the "
            "line it is nothing. For comparison, Table 5's 0.05 arcsec of Δα moves the whole line by "
            f"{0.05 * ARCSEC * images.geometry.principal_distance_m / 7e-6:.2f} px of 7 µm."
        )
        pixel = Chosen.power("pixel of the line CCD", images.line_pixel * 1e6, "µm", images.roll_pixels, -1.0)
        limit = Supposed("one pixel taken for little", f"holds down to {images.roll_pixels:.2f} px")
        check = context.check("001.table5.d_gamma.positioning")
        yield check.evaluate(images.roll_pixels, None, how, 1.0, inputs=[pixel, limit])


def _simulated(context: Context, images: BudgetImages, together: Together, name: str) -> CheckResult:
    field, _, unit = _PARAMETERS[name]
    size = _UNIT[unit]
    values = {e: tuple(v / size for v in p[field]) for e, p in together.parameters.items()}
    formula = budget.propagated(together.spot[0], images.geometry)[name] / size
    how = (
        f"{images.inputs[1]} random states with all causes through images of {budget.FRAMES} frames, "
        f"printed factor, reading - traced truth. By formula from the simulated error of one spot: {formula:.3g}; "
        f"corrected factors by Monte Carlo: {values['derived'][0]:.3g} ± {values['derived'][1]:.2g} {unit}."
    )
    if name == "d_gamma":
        how += " The printed (5) is twice too large, so the monitor is twice as good as printed."
    if name == "d_f":
        how += " The focal plane's growth is read rightly and is no part of it."
        joint = values["paper_joint"]
        how += f" Table 1's joint form gives half: {joint[0]:.3g} ± {joint[1]:.2g} mm."
    single = values["paper_single"]
    return context.check(f"001.table5.{name}").evaluate(single[0], single[1], how, inputs=[all_causes(single[0])])


def all_causes(value: float) -> Chosen:
    """What all inputs make together, to which every error is proportional."""
    return Chosen.power("errors by all inputs of scenes/library/budgets/monitor_pair.yaml, times", 1.0, "1", value)


def _propagated(context: Context, images: BudgetImages, name: str) -> CheckResult:
    unit = _PARAMETERS[name][2]
    value = budget.propagated(_TABLE_4, images.geometry)[name] / _UNIT[unit]
    g = images.geometry
    how = (
        f"The printed factors on the printed Table 4 of every coordinate of both spots, independent; f = "
        f"{g.principal_distance_m:.3f} m, L = {g.separation_m:.4f} m of the camera made after Table 5."
    )
    inputs = []
    check = context.check(f"001.table5.{name}.propagated")
    if check.basis == "chosen":
        for what, field, size in (
            ("f", "principal_distance_m", g.principal_distance_m),
            ("L", "separation_m", g.separation_m),
        ):

            def response(factor: float, field: str = field, size: float = size) -> float:
                changed = replace(g, **{field: factor * size})
                return budget.propagated(_TABLE_4, changed)[name] / _UNIT[unit]

            inputs.append(Chosen(what, size, "m", response))
    return check.evaluate(value, None, how, inputs=inputs)


def _claims(context: Context, together: Together) -> Iterator[CheckResult]:
    found = together.parameters["paper_single"]
    if "001.table5.x_and_y" in context.selected:
        value, sigma = max(found["d_beta_rad"], found["d_alpha_rad"])
        how = (
            f"All causes at once through images: Δβ {found['d_beta_rad'][0] / ARCSEC:.4f}, Δα "
            f"{found['d_alpha_rad'][0] / ARCSEC:.4f} arcsec. These are errors of the monitor, not of the spot, which "
            "is determined to 0.145 arcsec only."
        )
        chosen = all_causes(value / ARCSEC)
        yield context.check("001.table5.x_and_y").evaluate(value / ARCSEC, sigma / ARCSEC, how, inputs=[chosen])
    if "001.table5.d_f.field" in context.selected:
        value, sigma = found["d_f_m"]
        how = (
            "All causes at once through images, by (7). Paper 001 prints no figure for a field; paper 003 finds the "
            "interior orientation of its fields stable to 0.01 mm."
        )
        chosen = all_causes(value / 1e-3)
        yield context.check("001.table5.d_f.field").evaluate(value / 1e-3, sigma / 1e-3, how, 0.01, inputs=[chosen])


def _show_errors(context: Context, images: BudgetImages, together: Together) -> None:
    formula = budget.propagated(together.spot[0], images.geometry)
    rows: list[list[Cell]] = []
    for name, (field, text, unit) in _PARAMETERS.items():
        size = _UNIT[unit]
        cells = [tuple(v / size for v in together.parameters[e][field]) for e in _SHOWN]
        printed = context.check(f"001.table5.{name}").printed
        rows.append([f"{text} [{unit}]", f"{printed:g}", f"{formula[name] / size:.3g}",
                     *(f"{value:.4g} ± {sigma:.2g}" for value, sigma in cells)])  # fmt: skip
    context.table(
        "table5",
        "Table 5: errors of the monitored parameters, 3σ",
        "By formula: the printed factors times the simulated error of one spot, spots taken as independent. Monte "
        "Carlo: all causes at once, through images and each estimator.",
        ("parameter", "printed", "by formula", "Monte Carlo, (2) (3) (5) (7)", "Table 1, joint", "corrected"),
        rows,
    )


GROUP = group_of("001.budget", run)
