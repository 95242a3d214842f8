"""Report of a turntable test: the main table, figures, sections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.units import ARCSEC
from scenes.yaml.units import ANGLE, format_quantity
from twin.laboratory.turntable_numbers import turntable_numbers
from twin.laboratory.turntable_run import SimulatedTurntable, TurntableRun
from twin.run.artefact import SvgFigure, Table
from twin.run.report import Report, Section, one_sentence
from twin.run.svg import BLUE, GREEN, GREY, INK, LIGHT, ORANGE, PURPLE, VERMILION, look, new_figure, plain_axes, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIT_NAMES = {
    "piecewise_linear": "piecewise linear",
    "polynomial": "polynomial",
    "cubic_spline": "cubic spline",
    "fourier": "Fourier series",
    "network": "network",
}
"""Names of the fits for readers."""
COLOURS = {
    "piecewise_linear": ORANGE,
    "polynomial": PURPLE,
    "cubic_spline": BLUE,
    "fourier": GREEN,
    "network": VERMILION,
}
_CURVE_POINTS = 801


def comparison_figure(run: TurntableRun) -> Figure:
    """All comparisons about the mean of those that are kept, and the RMS at each angle before and after rejection."""
    series = run.series
    angle = np.degrees(series.angle)
    off = (series.comparisons - series.mean[:, None]) / ARCSEC
    spread = np.linspace(-0.12, 0.12, series.repeats) * np.degrees(series.step)
    places = angle[:, None] + spread
    keep = series.keep
    figure = new_figure(5.2)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    top.plot(places[keep], off[keep], ".", color=BLUE, ms=3.5, label=f"kept, {np.sum(keep)}")
    gone = series.taken & ~keep
    top.plot(places[gone], off[gone], "x", color=VERMILION, ms=5.5, label=f"rejected, {series.rejected}")
    top.set(title="Comparisons, minus the mean of those kept at their angle", ylabel="arcsec")
    top.margins(y=0.18)
    top.legend(loc="upper right", ncols=2)
    bottom.plot(angle, series.rms_before / ARCSEC, "o-", color=GREY, ms=3.5, lw=0.9, label="all repeats")
    bottom.plot(angle, series.rms_after / ARCSEC, "o-", color=BLUE, ms=3.5, lw=0.9, label="after Chauvenet's criterion")
    bottom.axhline(series.averaging_alone / ARCSEC, color=INK, lw=0.8, ls="--", label="averaging alone, largest")
    bottom.set(title="RMS of single comparisons", ylabel="arcsec", xlabel="reading of the table [deg]")
    bottom.set_ylim(0.0, 1.35 * float(np.max(series.rms_before)) / ARCSEC)
    bottom.legend(loc="upper right", ncols=3)
    _finish(top, bottom)
    return figure


def curve_figure(run: TurntableRun) -> Figure:
    """The measured dividing error with the chosen fit and, of a simulated table, the true curve."""
    series, held = run.series, run.held_out
    chosen = run.choice.chosen
    at = np.linspace(*run.compensation.region, _CURVE_POINTS)
    figure = new_figure(3.6)
    axes = figure.subplots()
    if isinstance(run, SimulatedTurntable):
        axes.plot(np.degrees(at), _slow_truth(run, at) / ARCSEC, color=INK, lw=2.4, alpha=0.35, label="truth")
    fitted = run.fits[chosen](at) / ARCSEC
    axes.plot(np.degrees(at), fitted, color=COLOURS[chosen], lw=1.1, label=f"chosen fit: {FIT_NAMES[chosen]}")
    for points, mark, colour, label in ((series, "o", INK, "calibrated"), (held, "s", VERMILION, "held out")):
        if points is None:
            continue
        axes.errorbar(
            np.degrees(points.angle),
            points.mean / ARCSEC,
            points.sigma / ARCSEC,
            fmt=mark,
            color=colour,
            mfc="white" if points is held else colour,
            ms=3.5,
            lw=0.8,
            capsize=1.5,
            label=f"{label}, mean ± σ",
        )
    axes.set(title="Dividing error, reading − true angle", ylabel="arcsec", xlabel="reading of the table [deg]")
    axes.margins(x=0.01, y=0.12)
    axes.legend(loc="best", ncols=2)
    _finish(axes)
    return figure


def residual_figure(run: TurntableRun) -> Figure:
    """For each fit, ranked: the held-out points and, of a simulated table, the true curve, both minus the fit."""
    at = np.linspace(*run.compensation.region, _CURVE_POINTS)
    held = run.held_out
    assert held is not None
    truth = _slow_truth(run, at) if isinstance(run, SimulatedTurntable) else None
    most = 1.15 * max(float(np.max(np.abs(run.held_out_residual(name)))) for name in run.ranking) / ARCSEC
    figure = new_figure(1.35 * len(run.ranking) + 0.5)
    panels = np.atleast_1d(figure.subplots(len(run.ranking), 1, sharex=True, sharey=True))
    for name, axes in zip(run.ranking, panels, strict=True):
        fit = run.fits[name]
        residual = run.held_out_residual(name)
        axes.axhline(0.0, color=GREY, lw=0.7)
        if truth is not None:
            axes.plot(np.degrees(at), (truth - fit(at)) / ARCSEC, color=COLOURS[name], lw=1.3)
        axes.errorbar(
            np.degrees(held.angle),
            residual / ARCSEC,
            held.sigma / ARCSEC,
            fmt="s",
            color=INK,
            mfc="white",
            ms=3,
            lw=0.7,
        )
        rms = float(np.sqrt(np.mean(residual**2))) / ARCSEC
        axes.set_title(f"{FIT_NAMES[name]}: {rms:.4f} arcsec RMS at the held-out readings", loc="left")
        axes.set_ylabel("arcsec")
        axes.set_ylim(-most, most)
    panels[-1].set_xlabel("reading of the table [deg]")
    panels[-1].margins(x=0.01)
    _finish(*panels)
    return figure


def figure_svg(name: str, run: TurntableRun) -> str:
    """One figure as SVG; name: ``comparisons``, ``curve`` or ``residuals``."""
    draw = {"comparisons": comparison_figure, "curve": curve_figure, "residuals": residual_figure}[name]
    with look(f"turntable-{name}"):
        return to_svg(draw(run))


def _slow_truth(run: SimulatedTurntable, at: np.ndarray) -> np.ndarray:
    """True dividing error without the subdivision error, whose period is far below what a figure can show."""
    error = run.model.error
    return error(at) - error.parts["subdivision"](at)


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.grid(color=LIGHT, lw=0.5)
        plain_axes(axes)


def sections(run: SimulatedTurntable, result: Mapping[str, Any]) -> tuple[Section, ...]:
    """Comparison, and fits; result: the run's numbers."""
    return comparison_section(run, result, _steps(run)), _fits(run, result)


def _steps(run: SimulatedTurntable) -> str:
    """Which readings were compared."""
    plan = run.spec.calibration
    region = f"{format_quantity(plan.first, ANGLE)} to {format_quantity(plan.last, ANGLE)}"
    return f"{region} in steps of {format_quantity(plan.step, ANGLE)}: {plan.count} readings, {plan.repeats} repeats"


def comparison_section(run: TurntableRun, result: Mapping[str, Any], readings: str) -> Section:
    """The comparisons; readings: which were compared, in words."""
    series = run.series
    text = [
        f"The dividing error is the table's reading minus its true angle. It is compared with a polygon and an "
        f"autocollimator from {readings}.",
        f"Chauvenet's criterion rejects {series.rejected} of {np.sum(series.taken)} comparisons. It would reject "
        f"{result['rejected_expected_of_good']:.0f} on average if all were good: it trims normal noise, and the RMS "
        f"that remains is that of trimmed readings. All angles together, corrected for this, one comparison has "
        f"σ = {result['repeatability_arcsec']:.4f} arcsec.",
    ]
    if result["suspect_angles"]:
        text.append(
            f"At {result['suspect_angles']} of the angles the kept repeats scatter more than their number allows: "
            "gross errors that hide each other. Those angles are given the sigma of their own repeats; "
            "measure them again."
        )
    names = {
        "repeat_rms_arcsec": "repeats, as read",
        "chauvenet_rms_arcsec": "repeats, after Chauvenet's criterion",
        "averaging_alone_rms_arcsec": "mean of all repeats, nothing rejected",
        "mean_rms_arcsec": "mean of the kept repeats",
    }
    rows = [(text_, result[key]) for key, text_ in names.items()]
    table = Table(
        "turntable-repeats",
        "Repeats: the largest RMS of any angle",
        "An RMS of the kept repeats is one of single readings, not of their mean.",
        ("RMS of", "arcsec"),
        rows,
        (None, 3),
    )
    figure = SvgFigure(
        "turntable-comparisons",
        "Comparisons with the reference",
        "Above, all repeats; below, their RMS at each angle, and what the mean of all repeats would have at worst.",
        figure_svg("comparisons", run),
    )
    return Section("Regional comparison of the turntable", tuple(text), (figure, table))


def _fits(run: SimulatedTurntable, result: Mapping[str, Any]) -> Section:
    fits, truth = result["fits"], result["truth"]["fits"]
    chosen, best = result["chosen"], result["ranking"][0]
    held = fits[chosen]["heldout_rms_arcsec"]
    subdivision = run.spec.dividing_error.subdivision
    periods = run.spec.calibration.step / subdivision.period
    text = [
        f"Five fits of the means, ranked at {len(run.held_out.angle)} held-out readings in the middle of the steps, "
        f"measured in a series of their own with σ = {result['heldout_sigma_arcsec']:.4f} arcsec each. "
        f"Cross-validation on the calibration points alone chooses the {FIT_NAMES[chosen]}; it has {held:.4f} arcsec "
        "at the held-out readings." + ("" if best == chosen else f" There the {FIT_NAMES[best]} is the best.")
    ]
    if abs(periods - round(periods)) < 1e-6:
        text.append(
            f"A step of the calibration is {round(periods)} whole periods of the grating's signal "
            f"({subdivision.period / ARCSEC:.4g} arcsec), so that all calibration points lie at one phase and cannot "
            "see the subdivision error. The held-out readings lie at all phases, as the readings in use do: what no "
            "fit can follow is in their residuals."
        )
    for name, failure in result["failed"].items():
        text.append(f"The {FIT_NAMES[name]} failed: {failure}.")
    rows = [
        (
            rank,
            FIT_NAMES[name],
            fits[name]["heldout_rms_arcsec"],
            fits[name]["train_rms_arcsec"],
            fits[name]["cross_validation_rms_arcsec"],
            fits[name]["effective_parameters"],
            truth[name]["true_rms_arcsec"],
            truth[name]["true_spread_arcsec"],
        )
        for rank, name in enumerate(result["ranking"], 1)
    ]
    heads = ("rank", "fit", "held out", "training points", "cross-validation", "effective parameters")
    table = Table(
        "turntable-fits",
        "The five fits, ranked at the held-out readings",
        "RMS, arcsec. The last two columns use the true curve, which no test in a laboratory has: over the whole "
        "region and all phases of the signal, and the same without a constant, which differences of angles do not see.",
        (*heads, "truth", "truth, no constant"),
        rows,
        (None, None, 4, 4, 4, 1, 4, 4),
    )
    curve = SvgFigure(
        "turntable-curve",
        "Dividing error",
        "Means with their sigmas (the scatter of the repeats and the reference), the chosen fit and the true curve "
        "without its subdivision error.",
        figure_svg("curve", run),
    )
    residuals = SvgFigure(
        "turntable-residuals",
        "What the fits miss",
        "Squares: held-out readings minus the fit, with the sigma of the measurement. Lines: true curve without "
        "subdivision error minus the fit.",
        figure_svg("residuals", run),
    )
    return Section("Fits of the dividing error", tuple(text), (curve, residuals, table))


def turntable_report(run: SimulatedTurntable) -> Report:
    """Report of a simulated turntable test."""
    data = turntable_numbers(run)
    plan = run.spec.calibration
    chosen = data["chosen"]
    held = data["fits"][chosen]["heldout_rms_arcsec"]
    best = data["ranking"][0]
    also = "" if best == chosen else f"there the {FIT_NAMES[best]} is the best of the five"
    verdict = one_sentence(
        f"Cross-validation chooses the {FIT_NAMES[chosen]}, which misses held-out angles by {held:.3f} arcsec RMS",
        also,
        f"repeats scatter by {data['repeat_rms_arcsec']:.3f} arcsec RMS at worst, {data['chauvenet_rms_arcsec']:.3f} "
        "arcsec after Chauvenet's criterion, see what the fits miss",
    )
    rows = [
        ("repeats, largest RMS of an angle", _text(data["repeat_rms_arcsec"])),
        ("the same after Chauvenet's criterion", _text(data["chauvenet_rms_arcsec"])),
        ("what averaging alone gives", _text(data["averaging_alone_rms_arcsec"])),
    ]
    rows += [
        (
            f"{FIT_NAMES[name]} on held-out angles{', chosen' if name == chosen else ''}",
            _text(data["fits"][name]["heldout_rms_arcsec"]),
        )
        for name in data["ranking"]
    ]
    return Report(
        "Dividing error of the turntable",
        verdict,
        (),
        (
            (
                "Calibration",
                f"{format_quantity(plan.first, ANGLE)} to {format_quantity(plan.last, ANGLE)} every "
                f"{format_quantity(plan.step, ANGLE)}, {plan.repeats} repeats",
            ),
            ("Description", run.spec.description),
        ),
        Table(
            "dividing-error",
            "Result",
            "Fits in the order of their RMS on held-out angles.",
            ("RMS", "arcsec"),
            rows,
        ),
        sections(run, data),
    )


def _text(arcsec: float) -> str:
    return f"{arcsec:.3f}"
