"""Figures of the turntable test: the comparisons and what Chauvenet's criterion takes, the curve, what fits miss."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.units import ARCSEC
from twin.laboratory.turntable import TurntableRun
from twin.report.svg import (
    BLUE,
    GREEN,
    GREY,
    INK,
    LIGHT,
    ORANGE,
    PURPLE,
    VERMILION,
    look,
    new_figure,
    plain_axes,
    to_svg,
)

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
    top.plot(places[~keep], off[~keep], "x", color=VERMILION, ms=5.5, label=f"rejected, {series.rejected}")
    top.set(title="Comparisons, minus the mean of those kept at their angle", ylabel="arcsec")
    top.margins(y=0.18)
    top.legend(loc="upper right", ncols=2)
    bottom.plot(angle, series.rms_before / ARCSEC, "o-", color=GREY, ms=3.5, lw=0.9, label="all repeats")
    bottom.plot(angle, series.rms_after / ARCSEC, "o-", color=BLUE, ms=3.5, lw=0.9, label="after Chauvenet's criterion")
    bottom.axhline(series.averaging_alone / ARCSEC, color=INK, lw=0.8, ls="--", label="averaging alone, largest")
    bottom.set(title="RMS of single comparisons", ylabel="arcsec", xlabel="reading of the table, deg")
    bottom.set_ylim(0.0, 1.35 * float(np.max(series.rms_before)) / ARCSEC)
    bottom.legend(loc="upper right", ncols=3)
    _finish(top, bottom)
    return figure


def curve_figure(run: TurntableRun) -> Figure:
    """The measured dividing error with the chosen fit and the true curve."""
    series, held = run.series, run.held_out
    chosen = run.choice.chosen
    at = np.linspace(*run.compensation.region, _CURVE_POINTS)
    figure = new_figure(3.6)
    axes = figure.subplots()
    axes.plot(np.degrees(at), _slow_truth(run, at) / ARCSEC, color=INK, lw=2.4, alpha=0.35, label="truth")
    fitted = run.fits[chosen](at) / ARCSEC
    axes.plot(np.degrees(at), fitted, color=COLOURS[chosen], lw=1.1, label=f"chosen fit: {FIT_NAMES[chosen]}")
    for points, mark, colour, label in ((series, "o", INK, "calibrated"), (held, "s", VERMILION, "held out")):
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
    axes.set(title="Dividing error, reading − true angle", ylabel="arcsec", xlabel="reading of the table, deg")
    axes.margins(x=0.01, y=0.12)
    axes.legend(loc="best", ncols=2)
    _finish(axes)
    return figure


def residual_figure(run: TurntableRun) -> Figure:
    """For each fit, ranked: the held-out points and the true curve, both minus the fit."""
    at = np.linspace(*run.compensation.region, _CURVE_POINTS)
    held = run.held_out
    truth = _slow_truth(run, at)
    most = 1.15 * max(float(np.max(np.abs(run.held_out_residual(name)))) for name in run.ranking) / ARCSEC
    figure = new_figure(1.35 * len(run.ranking) + 0.5)
    panels = np.atleast_1d(figure.subplots(len(run.ranking), 1, sharex=True, sharey=True))
    for name, axes in zip(run.ranking, panels, strict=True):
        fit = run.fits[name]
        residual = run.held_out_residual(name)
        axes.axhline(0.0, color=GREY, lw=0.7)
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
        axes.set_title(f"{FIT_NAMES[name]}: {rms:.4f}″ RMS at the held-out readings", loc="left")
        axes.set_ylabel("arcsec")
        axes.set_ylim(-most, most)
    panels[-1].set_xlabel("reading of the table, deg")
    panels[-1].margins(x=0.01)
    _finish(*panels)
    return figure


def drawn(name: str, run: TurntableRun) -> str:
    """One figure as SVG; name: ``comparisons``, ``curve`` or ``residuals``."""
    draw = {"comparisons": comparison_figure, "curve": curve_figure, "residuals": residual_figure}[name]
    with look(f"turntable-{name}"):
        return to_svg(draw(run))


def _slow_truth(run: TurntableRun, at: np.ndarray) -> np.ndarray:
    """True dividing error without the subdivision error, whose period is far below what a figure can show."""
    error = run.model.error
    return error(at) - error.parts["subdivision"](at)


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.grid(color=LIGHT, lw=0.5)
        plain_axes(axes)
