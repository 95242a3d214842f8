"""Paper 001's Table 5, the errors of the monitored parameters, and what section 3.2.3 says of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from analysis.units import ARCSEC
from twin.monitor.simulated_budget import Together
from twin.run.artefact import Cell, Table
from twin.validation.checks.check import CheckResult
from twin.validation.checks.chosen import Chosen, Supposed
from twin.validation.checks.group import Context
from twin.validation.paper_001 import budget
from twin.validation.paper_001.budget import BudgetImages

_TABLE_4 = budget.TABLE_4 * ARCSEC
_PARAMETERS = {
    "d_beta": ("d_beta_rad", "Δβ, 3σ", "arcsec"),
    "d_alpha": ("d_alpha_rad", "Δα, 3σ", "arcsec"),
    "d_gamma": ("d_gamma_rad", "Δγ by (5), 3σ", "arcsec"),
    "d_f": ("d_f_m", "Δf by (7), 3σ", "mm"),
}
_UNIT = {"arcsec": ARCSEC, "mm": 1e-3}
_SHOWN = ("paper_single", "paper_joint", "derived")


def results(context: Context, images: BudgetImages) -> Iterator[CheckResult]:
    """The selected checks of Table 5."""
    if images.together is not None:
        for name in _PARAMETERS:
            if f"001.table5.{name}" in context.selected:
                yield _simulated(context, images, images.together, name)
        yield from _claims(context, images.together)
        if any(f"001.table5.{name}" in context.selected for name in _PARAMETERS):
            _show(context, images, images.together)
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
            f"{0.05 * ARCSEC * images.geometry.focal_length_m / 7e-6:.2f} px of 7 µm."
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
        f"{g.focal_length_m:.3f} m, L = {g.separation_m:.4f} m of the camera made after Table 5."
    )
    inputs = []
    check = context.check(f"001.table5.{name}.propagated")
    if check.basis == "chosen":
        for what, field, size in (("f", "focal_length_m", g.focal_length_m), ("L", "separation_m", g.separation_m)):

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


def _show(context: Context, images: BudgetImages, together: Together) -> None:
    formula = budget.propagated(together.spot[0], images.geometry)
    rows: list[list[Cell]] = []
    for name, (field, text, unit) in _PARAMETERS.items():
        size = _UNIT[unit]
        cells = [tuple(v / size for v in together.parameters[e][field]) for e in _SHOWN]
        printed = context.check(f"001.table5.{name}").printed
        rows.append([f"{text} [{unit}]", f"{printed:g}", f"{formula[name] / size:.3g}",
                     *(f"{value:.4g} ± {sigma:.2g}" for value, sigma in cells)])  # fmt: skip
    context.add(
        Table(
            "table5",
            "Table 5: errors of the monitored parameters, 3σ",
            "By formula: the printed factors times the simulated error of one spot, spots taken as independent. Monte "
            "Carlo: all causes at once, through images and each estimator.",
            ("parameter", "printed", "by formula", "Monte Carlo, (2) (3) (5) (7)", "Table 1, joint", "corrected"),
            rows,
        )
    )
