"""Figures of a search for jitter: disparities over time, spectrum, course."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.statistics import robust_sigma
from twin.orbit.jitter.jitter_run import JitterRun, PassJitter
from twin.run import svg

_MOST = 4000
_SIGMAS = 5.0


def _disparity_figure(run: JitterRun, one: PassJitter) -> Figure:
    """Disparities of the widest pair of neighbours over time."""
    pair, (seconds, moved) = max(one.sights.pairs.items(), key=lambda item: abs(one.sights.gaps[item[0]][1]))
    figure = svg.new_figure(4.0)
    panels = figure.subplots(2, 1, sharex=True)
    step = max(len(seconds) // _MOST, 1)
    for axes, column, words in zip(panels, moved.T, ("along the line", "along the track"), strict=True):
        axes.plot(seconds[::step], column[::step], ".", color=svg.BLUE, ms=2.5)
        middle = np.median(column)
        spread = robust_sigma(column - middle)
        axes.set_ylim(middle - _SIGMAS * spread, middle + _SIGMAS * spread)
        axes.set_ylabel(f"{words} [px]")
    panels[1].set_xlabel(f"time of the sight by {pair[0]}, before {pair[1]} [s]")
    _finish(*panels)
    return figure


def _spectrum_figure(run: JitterRun, one: PassJitter) -> Figure:
    """Amplitude over frequency, before and after the oscillations found are taken out."""
    found = one.found
    figure = svg.new_figure(2.0 + 2.0 * len(run.axes))
    panels = np.atleast_1d(figure.subplots(len(run.axes), 1, sharex=True))
    f = found.before.frequency
    for k, (axes, name) in enumerate(zip(panels, run.axes, strict=True)):
        for which, colour, label in ((found.before, svg.SKY, "observed"), (found.after, svg.BLUE, "beside all found")):
            shown = np.where(which.blind, np.nan, which.amplitude[:, k] / ARCSEC)
            axes.semilogy(which.frequency, shown, color=colour, lw=0.9, label=label)
        least = np.where(np.isfinite(found.detectable[:, k]), found.detectable[:, k] / ARCSEC, np.nan)
        axes.semilogy(f, least, color=svg.VERMILION, lw=1.0, ls="--", label="would be found")
        for first, last in found.before.intervals():
            axes.axvspan(first, last, color=svg.LIGHT, lw=0)
        for value in found.lines.frequency:
            axes.axvline(value, color=svg.INK, lw=0.6, ls=":")
        axes.set_ylabel(f"{name} [arcsec]")
    panels[0].legend(loc="best")
    panels[-1].set_xlabel("frequency [Hz]; shaded: blind")
    _finish(*panels)
    return figure


def _course_figure(run: JitterRun, one: PassJitter) -> Figure:
    """Attitude over time by the oscillations, and by the spline."""
    first, last = one.sights.observations.ends
    seconds = np.linspace(first, last, 1200)
    figure = svg.new_figure(1.5 + 1.7 * len(run.axes))
    panels = np.atleast_1d(figure.subplots(len(run.axes), 1, sharex=True))
    value, spread = one.found.lines.course(seconds)
    for k, (axes, name) in enumerate(zip(panels, run.axes, strict=True)):
        if one.course is not None:
            spline, own = (v[:, k] if v.ndim == 2 else v[:, k, k] for v in one.course.at(seconds))
            sigma = np.sqrt(own)
            axes.fill_between(seconds, (spline - sigma) / ARCSEC, (spline + sigma) / ARCSEC, color=svg.LIGHT, lw=0)
            axes.plot(seconds, spline / ARCSEC, color=svg.GREEN, lw=0.9, label="spline, with σ")
        sigma = np.sqrt(spread[:, k, k])
        axes.fill_between(
            seconds, (value[:, k] - sigma) / ARCSEC, (value[:, k] + sigma) / ARCSEC, color=svg.SKY, alpha=0.6, lw=0
        )
        axes.plot(seconds, value[:, k] / ARCSEC, color=svg.BLUE, lw=1.0, label="oscillations found, with σ")
        if one.truth is not None:
            axes.plot(seconds, one.truth(seconds)[:, run.columns[k]] / ARCSEC, color=svg.INK, lw=0.5, label="true")
        axes.set_ylabel(f"{name} [arcsec]")
    panels[0].legend(loc="best")
    panels[-1].set_xlabel("time [s]")
    _finish(*panels)
    return figure


FIGURES: dict[str, Callable[[JitterRun, PassJitter], Figure]] = {
    "disparity": _disparity_figure,
    "spectrum": _spectrum_figure,
    "course": _course_figure,
}


def figure_svg(name: str, run: JitterRun, one: PassJitter) -> str:
    """One of `FIGURES` as SVG."""
    with svg.look(f"jitter-{name}"):
        return svg.to_svg(FIGURES[name](run, one))


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.grid(color=svg.LIGHT, lw=0.5)
        svg.plain_axes(axes)
