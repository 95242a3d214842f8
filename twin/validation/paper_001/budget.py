"""Checks of the error budget of paper 001 (Wang et al. 2018): Tables 3 to 5, eq. (12), section 3.2.3; a figure.

The budget converts errors of the monitor's spots, due to its thermal and mechanical causes, to errors of the cameras'
parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, replace
from math import hypot, log, sqrt
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.monitor import monitor_formulas
from analysis.monitor.monitor_formulas import MonitorGeometry
from analysis.monitor.recovery import measure_spots
from optics.geometry.tree import Motion
from optics.numerics.backend import cores, one_blas_thread
from scenes.specs.instrument import BASE
from scenes.specs.load import load_error_budget
from scenes.specs.resolved import resolve_budget
from twin.framework.artefact import Cell
from twin.framework.svg import BLUE, INK
from twin.monitor.simulated_budget import BudgetLine, CombinedErrors, ErrorBudget
from twin.monitor.truth import line_points
from twin.validation.check import SIGMAS, CheckResult, Chosen, Supposed
from twin.validation.group import Context, drawing, group_of, load_printed

FRAMES = 9
"""Number of frames averaged in one measurement, as in eq. (12)."""
BUDGET = "monitor_pair"
TABLE_3 = load_printed("001").numbers("table3.spot_arcsec")
TABLE_4 = load_printed("001").number("table4.spot_arcsec")
FOCAL_PLANE, LONG_PRISM = "coordinate_thermal", "prism_180_thermal"
"""Names of two causes of the error budget whose inputs are also applied by themselves, at three sigmas.

They are the temperatures of the focal planes and of the long prisms.
"""
FEW_DRAWS = (FOCAL_PLANE, "central_prism_thermal")
"""Causes with only two or three random numbers per state.

They need more random states than the causes that act on a prism in every channel.
"""
ROLL = load_printed("001").number("table5.d_gamma_arcsec") * ARCSEC
"""Error of the roll d_gamma that Table 5 prints, radians."""
FROM_ALL_CAUSES = frozenset(
    f"001.{name}"
    for name in (
        *("eq12", "table4.together", "table5.d_f.field", "table5.x_and_y"),
        *(f"table5.{parameter}" for parameter in ("d_beta", "d_alpha", "d_gamma", "d_f")),
    )
)
"""Ids of the checks that need a simulation in which all causes act together."""
_CHUNK = 40
_LARGEST = ("prism_180_thermal", "prism_0_rotation")
"""The two causes that contribute most to the total of eq. (12)."""
_INPUT_OF = {
    "centroid": "light",
    "coordinate_thermal": "temperature of the focal plane",
    "prism_180_thermal": "gradient in the 180° prism",
    "prism_0_thermal": "gradient in the 0° prism",
    "prism_180_rotation": "rotation of the 180° prism",
    "prism_0_rotation": "rotation of the 0° prism",
    "central_prism_thermal": "gradient in the central prism",
}
"""Cause of the error budget -> its main input.

Rotations act through the residual angle errors of the prisms, which are chosen here too.
"""
_ANGLE, _LENGTH = ("arcsec", ARCSEC), ("mm", 1e-3)
_PARAMETERS = {
    "d_beta": ("d_beta_rad", "Δβ, 3σ", *_ANGLE),
    "d_alpha": ("d_alpha_rad", "Δα, 3σ", *_ANGLE),
    "d_gamma": ("d_gamma_rad", "Δγ by (5), 3σ", *_ANGLE),
    "d_f": ("d_f_m", "Δf by (7), 3σ", *_LENGTH),
}
"""Parameter of Table 5 -> attribute of the simulated errors, column head, unit, and the unit in SI."""


def frame_mean(error: float, frames: int = FRAMES) -> float:
    """Return the random error of the mean of ``frames`` frames from that of one, the first term of eq. (12)."""
    return error / sqrt(frames)


def root_sum(errors: Mapping[str, float]) -> float:
    """Return the total error of eq. (12) from the errors of Table 3, in their unit.

    It is the root of the sum of squares, with the centroid's error divided by the root of the number of frames.
    """
    return sqrt(sum((frame_mean(e) if name == "centroid" else e) ** 2 for name, e in errors.items()))


def root_sum_of_squares(lines: Mapping[str, BudgetLine]) -> tuple[float, float]:
    """Return the total error of eq. (12) from the simulated errors, and its standard deviation, radians."""
    total = root_sum({name: line.three_sigma for name, line in lines.items()})
    weight = {name: frame_mean(1.0) ** 2 if name == "centroid" else 1.0 for name in lines}
    sigma = sqrt(sum((weight[n] * line.three_sigma * line.sigma) ** 2 for n, line in lines.items())) / total
    return total, sigma


def propagated(spot: float, geometry: MonitorGeometry, estimator: str = "paper_single") -> dict[str, float]:
    """Return the errors of Table 5 from the error of one spot coordinate (Table 4); all coordinates are independent.

    Parameters
    ----------
    spot : float
        Error of a spot coordinate as an angle, radians.
    geometry : MonitorGeometry
        Geometry of the camera.
    estimator : str
        Estimator whose factors are used: those of eqs. (2), (3), (5), (7) or, as ``paper_joint``, of Table 1's last
        column.

    Returns
    -------
    dict[str, float]
        d_alpha, d_beta, d_gamma in radians and d_f in metres.
    """
    pixels = spot * geometry.principal_distance_m / geometry.pitch_m
    factors = np.sqrt(np.sum(monitor_formulas.coefficients(estimator, geometry) ** 2, axis=1))
    return dict(zip(("d_alpha", "d_beta", "d_gamma", "d_f"), (float(v) for v in factors * pixels), strict=True))


@dataclass(frozen=True, eq=False)
class BudgetImages:
    """Errors simulated with rendered images; parts that are not requested are empty or None.

    Attributes
    ----------
    geometry : MonitorGeometry
        Geometry of the first camera; the second has the same.
    inputs : (int, int, int)
        Trials per cause (twice as many for FEW_DRAWS), trials with all causes, and groups of frames.
    lines : dict of str to BudgetLine
        Cause of Table 3 -> its simulated error.
    focal_plane : (float, float) or None
        True and estimated change of d_f due to the focal plane's temperature, metres.
    halved : (float, float, float) or None
        Glass path of the 180-deg prism before and after halving, metres, and the ratio of its errors.
    together : CombinedErrors or None
        Errors with all causes at once.
    scatter : pair of (float, float) or None
        Scatter of the centroid in single frames and in means of FRAMES, radians, each with its standard deviation.
    line_pixel : float
        Pixel pitch of the line CCD, metres.
    roll_pixels : float or None
        Displacement of the line of sight at the line's end due to a rotation by ROLL, in pixels of the line CCD.
    """

    geometry: MonitorGeometry
    inputs: tuple[int, int, int]
    lines: dict[str, BudgetLine]
    focal_plane: tuple[float, float] | None
    halved: tuple[float, float, float] | None
    together: CombinedErrors | None
    scatter: tuple[tuple[float, float], tuple[float, float]] | None
    line_pixel: float
    roll_pixels: float | None


def measured(context: Context) -> BudgetImages:
    """Simulate the errors that the selected checks of the budget need."""
    spec = load_error_budget(BUDGET)
    trials, together, groups = context.count(400, 60), context.count(1500, 80), context.count(400, 80)
    spec = spec.model_copy(update={"trials": trials, "all_together": together})
    context.progress(0.0, f"build {spec.instrument}")
    budget = ErrorBudget(spec, resolve_budget(spec), context.backend, context.seed)
    all_lines = bool(context.selected & {"001.eq12", "001.table4.root_sum"})
    wanted = [name for name in budget.lines if all_lines or f"001.table3.{name}" in context.selected]
    lines = {}
    for i, name in enumerate(wanted):
        context.progress(0.05 + 0.4 * i / len(wanted), name)
        lines[name] = more_trials(budget, 2 if name in FEW_DRAWS else 1).line(name)
    grown = budget.warmed_focal_planes(three_sigma(budget, FOCAL_PLANE)) if FOCAL_PLANE in lines else None
    halved = None
    if "001.table3.prism_180_thermal.halved" in context.selected:
        context.progress(0.45, "half the glass path")
        halved = budget.halved_glass(three_sigma(budget, LONG_PRISM))
    scatter = None
    if "001.eq12.frames" in context.selected:
        context.progress(0.5, "means of frames")
        scatter = centroid_scatter(budget, groups)
    roll = line_end_shift(budget) if "001.table5.d_gamma.positioning" in context.selected else None
    causes = None
    if context.selected & FROM_ALL_CAUSES:
        causes = budget.together(lambda done, text: context.progress(0.55 + 0.4 * done, text))
    geometry = next(iter(budget.experiment.calibration.cameras.values())).geometry
    inputs = (trials, together, groups)
    pitch = next(iter(budget.experiment.instrument.cameras.values())).spec.line.pitch
    return BudgetImages(geometry, inputs, lines, grown, halved, causes, scatter, pitch, roll)


def three_sigma(budget: ErrorBudget, cause: str) -> float:
    """Return three standard deviations of a cause whose components have equal sigmas, in SI units."""
    return 3.0 * budget.prior.of_causes((cause,)).components[0].sigma


def more_trials(budget: ErrorBudget, factor: int) -> ErrorBudget:
    """Return an error budget with ``factor`` times as many random states for each cause."""
    other = copy(budget)
    other.spec = budget.spec.model_copy(update={"trials": factor * budget.spec.trials})
    return other


def centroid_scatter(budget: ErrorBudget, groups: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return three sigma of the energy centroid in single frames, and in means of FRAMES frames.

    Both are in radians, each with its standard deviation; they are computed from the same frames.
    """
    setup = budget.experiment
    pattern = setup.pattern(budget.seed)
    single, mean = [], []
    for first in range(0, groups, _CHUNK):
        count = min(_CHUNK, groups - first)
        stream = np.random.SeedSequence(budget.seed, spawn_key=(12, first))
        frames = setup.detector.expose(setup.nominal_photons, pattern, count * FRAMES, setup.exposure, stream)
        grouped = frames.reshape(len(frames), count, FRAMES, *frames.shape[2:]).mean(axis=2)
        single.append(_positions(budget, frames, 1))
        mean.append(_positions(budget, grouped, FRAMES))
    out = []
    for positions in (np.concatenate(single), np.concatenate(mean)):
        freedom = (len(positions) - 1) * positions[0].size
        variance = float(np.sum((positions - positions.mean(axis=0)) ** 2)) / freedom
        value = 3.0 * float(np.sqrt(variance)) * budget.radians_per_pixel
        out.append((value, value / float(np.sqrt(2.0 * freedom))))
    return out[0], out[1]


def _positions(budget: ErrorBudget, images: np.ndarray, frames: int) -> np.ndarray:
    """Return energy centroids of N images for each of C channels, (N, C, 2), in pixels.

    The images are (C, N, H, W), of H rows and W columns.
    """
    count, spots = images.shape[1], images.shape[0]
    flat = np.swapaxes(images, 0, 1).reshape(-1, *images.shape[2:]).astype(np.float64)
    with one_blas_thread():
        measured = measure_spots(flat, frames, budget.experiment.calibration, "energy", cores())
    return np.asarray(measured.position.reshape(count, spots, 2))


def line_end_shift(budget: ErrorBudget) -> float:
    """Return the displacement of the line of sight at the line CCD's end due to a rotation by ROLL, in its pixels."""
    experiment = budget.experiment
    camera = next(iter(experiment.instrument.cameras))
    state = {f"{BASE}/{camera}/focal_plane": Motion(rotate=(0.0, 0.0, ROLL))}
    sight = experiment.sight.trace([{}, state])[0]
    ends = line_points(experiment.instrument, camera)[-2:]
    pixel = experiment.instrument.cameras[camera].spec.line.pitch
    per_pixel = float(np.linalg.norm(sight[0, -1] - sight[0, -2])) / float(ends[1] - ends[0]) * pixel
    return float(np.linalg.norm(sight[1, -1] - sight[0, -1])) / per_pixel


@drawing("error-budget", lambda lines: 1.0 + 0.32 * len(lines))
def budget_svg(figure: Figure, lines: Mapping[str, tuple[float, float, float]]) -> None:
    """Draw the printed and the simulated error of each cause, with its sigma, in arcsec."""
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


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the selected checks of the budget; eq. (12) needs the simulation of all causes."""
    images = measured(context)
    for name, line in images.lines.items():
        value, trials = line.three_sigma, images.inputs[0] * (2 if name in FEW_DRAWS else 1)
        # proportional to the input, but for the centroid's light, whose power the budget's own search tells
        power = log(0.1 * ARCSEC / value) / log(line.allowed / line.value)
        chosen = Chosen.power(_INPUT_OF[name], line.value, line.unit, value / ARCSEC, power)
        facts: dict[str, Any] = {"line": line, "trials": trials, "images": images}
        row = f"001.table3.{name}"
        yield context.row(row, value / ARCSEC, line.sigma / ARCSEC, inputs=[chosen], **facts)
    if images.halved is not None:
        before, after, ratio = images.halved
        yield context.row("001.table3.prism_180_thermal.halved", ratio, implied=0.5, before=before, after=after)
    yield from _totals(context, images)
    if images.together is not None:
        yield from _monitored(context, images, images.together)
    yield from _propagated(context, images.geometry)
    if images.roll_pixels is not None:
        pixel = Chosen.power("pixel of the line CCD", images.line_pixel * 1e6, "µm", images.roll_pixels, -1.0)
        limit = Supposed("one pixel taken for little", f"holds down to {images.roll_pixels:.2f} px")
        moved = 0.05 * ARCSEC * images.geometry.principal_distance_m / 7e-6
        row = "001.table5.d_gamma.positioning"
        yield context.row(row, images.roll_pixels, implied=1.0, inputs=[pixel, limit], moved=moved)
    if images.lines:
        _show(context, images.lines)


def _in_sum(images: BudgetImages, name: str, value: float) -> Chosen:
    """Return the main input of one cause as an input of a total error, which the paper does not print.

    The total, a root of a sum of squares, depends on it through one term.
    """
    line = images.lines[name]
    share = (frame_mean(1.0) if name == "centroid" else 1.0) * line.three_sigma / ARCSEC

    def response(factor: float) -> float:
        return sqrt(value**2 + (factor**2 - 1.0) * min(share, value) ** 2)

    return Chosen(_INPUT_OF[name], line.value, line.unit, response)


def _totals(context: Context, images: BudgetImages) -> Iterator[CheckResult]:
    """Check the total error by eq. (12), and Table 4."""
    facts: dict[str, Any] = {"images": images, "frames": FRAMES}
    if {"001.eq12", "001.table4.root_sum"} & context.selected:
        total, sigma = root_sum_of_squares(images.lines)
        inputs = [_in_sum(images, name, total / ARCSEC) for name in _LARGEST]
        yield context.row("001.table4.root_sum", total / ARCSEC, sigma / ARCSEC, inputs=inputs, **facts)
    if "001.eq12" in context.selected:
        assert images.together is not None
        value, spread = images.together.spot
        plain = sum(line.three_sigma for line in images.lines.values())
        measured, noise = value / total, value / total * hypot(spread / value, sigma / total)
        # with a correlation of all pairs the square grows by as much of what a plain sum has more
        largest = 1.0 + context.check("001.eq12").tolerance + SIGMAS * noise
        most = ((largest / measured) ** 2 - 1.0) / ((plain / total) ** 2 - 1.0)
        limit = f"holds up to a correlation of {max(most, 0.0):.2g} of all pairs"
        supposed = [Supposed("causes that are independent", limit)]
        yield context.row("001.eq12", measured, noise, inputs=supposed, value=value, total=total, plain=plain, **facts)
    if images.scatter is not None:
        (single, s_sigma), (mean, m_sigma) = images.scatter
        rest = root_sum({n: v for n, v in TABLE_3.items() if n != "centroid"})
        facts = {"single": single, "mean": mean, "rest": rest, "printed": root_sum(TABLE_3), **facts}
        ratio = mean / frame_mean(single)
        yield context.row("001.eq12.frames", ratio, ratio * hypot(s_sigma / single, m_sigma / mean), **facts)
    yield context.row("001.table4.printed_lines", root_sum(TABLE_3))


def _show(context: Context, lines: Mapping[str, BudgetLine]) -> None:
    texts = {n: context.check(f"001.table3.{n}").statement.removesuffix(", error of one spot") for n in lines}
    rows: list[list[Cell]] = []
    for name, line in lines.items():
        rows.append([texts[name], f"{TABLE_3[name]:g}", f"{line.three_sigma / ARCSEC:.4f}",
                     f"{line.sigma / ARCSEC:.4f}", f"{line.value:.4g} {line.unit}",
                     f"{line.allowed:.3g} {line.unit}"])  # fmt: skip
    context.table("table3", rows)
    data = {n: {"three_sigma_arcsec": l.three_sigma / ARCSEC, "sigma_arcsec": l.sigma / ARCSEC, "input": l.value,
                "unit": l.unit, "input_for_0.1_arcsec": l.allowed} for n, l in lines.items()}  # fmt: skip  # noqa: E741
    context.data("budget", data)
    shown = {texts[n]: (TABLE_3[n], line.three_sigma / ARCSEC, line.sigma / ARCSEC) for n, line in lines.items()}
    context.figure("table3-figure", budget_svg(shown))


def _all_causes(value: float) -> list[Chosen]:
    """Return the inputs of all causes, multiplied by one factor, as an input that the paper does not print.

    Every error is proportional to that factor.
    """
    return [Chosen.power("errors by all inputs of scenes/library/budgets/monitor_pair.yaml, times", 1.0, "1", value)]


def _monitored(context: Context, images: BudgetImages, together: CombinedErrors) -> Iterator[CheckResult]:
    """Check the errors with all causes at once, Table 5 among them, by formula and by Monte Carlo."""
    facts: dict[str, Any] = {"images": images, "frames": FRAMES}

    def row(identifier: str, error: tuple[float, float], unit: float, implied: float | None = None) -> CheckResult:
        value, sigma = error[0] / unit, error[1] / unit
        return context.row(identifier, value, sigma, implied, inputs=_all_causes(value), **facts)

    yield row("001.table4.together", together.spot, ARCSEC)
    formula = propagated(together.spot[0], images.geometry)
    rows: list[list[Cell]] = []
    for name, (field, text, unit, size) in _PARAMETERS.items():
        errors = {e: tuple(v / size for v in p[field]) for e, p in together.parameters.items()}
        facts.update(formula=formula[name] / size, errors=errors, unit=unit)
        yield row(f"001.table5.{name}", together.parameters["paper_single"][field], size)
        shown = (f"{errors[e][0]:.4g} ± {errors[e][1]:.2g}" for e in ("paper_single", "paper_joint", "derived"))
        printed = context.check(f"001.table5.{name}").printed
        rows.append([f"{text} [{unit}]", f"{printed:g}", f"{formula[name] / size:.3g}", *shown])
    if any(f"001.table5.{name}" in context.selected for name in _PARAMETERS):
        context.table("table5", rows)
    single = facts["single"] = together.parameters["paper_single"]
    yield row("001.table5.x_and_y", max(single["d_beta_rad"], single["d_alpha_rad"]), ARCSEC)
    yield row("001.table5.d_f.field", single["d_f_m"], 1e-3, 0.01)


def _propagated(context: Context, geometry: MonitorGeometry) -> Iterator[CheckResult]:
    """Check Table 5 by formula from the printed Table 4."""
    for name, (*_, size) in _PARAMETERS.items():

        def error(changed: MonitorGeometry, name: str = name, size: float = size) -> float:
            return propagated(TABLE_4 * ARCSEC, changed)[name] / size

        inputs = []
        if context.check(f"001.table5.{name}.propagated").basis == "chosen":
            for what, field in (("f", "principal_distance_m"), ("L", "separation_m")):
                value = getattr(geometry, field)

                def response(factor: float, field: str = field, value: float = value, error: Any = error) -> float:
                    return float(error(replace(geometry, **{field: factor * value})))

                inputs.append(Chosen(what, value, "m", response))
        yield context.row(f"001.table5.{name}.propagated", error(geometry), inputs=inputs, geometry=geometry)
    value = propagated(TABLE_4 * ARCSEC, geometry, "paper_joint")["d_f"] / 1e-3
    yield context.row("001.table5.d_f.by_table1", value, explained=[0.02])


GROUP = group_of("001.budget", run)
