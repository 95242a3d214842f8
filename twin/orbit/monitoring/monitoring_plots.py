"""Figures of a monitored orbit: the angle, heights with and without monitoring, the interval, what is left."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.units import ARCSEC
from twin.orbit.monitoring.monitoring_run import MonitorRun, rms
from twin.run import svg

PART_NAMES = {
    "prisms": "temperatures of the monitor's prisms",
    "other_systematic": "other errors of the monitor without noise",
    "noise": "noise of the monitor",
    "not_applied": "parameters that are not applied",
    "beyond_parameters": "beyond the four parameters",
    "interpolation": "interpolation over the interval",
}
_COLOURS = {
    "prisms": svg.VERMILION,
    "other_systematic": svg.ORANGE,
    "noise": svg.GREY,
    "not_applied": svg.PURPLE,
    "beyond_parameters": svg.SKY,
    "interpolation": svg.GREEN,
}
_LEAST = 5e-3
"""Metres; parts that are smaller at all times are not drawn."""


def _angle_figure(run: MonitorRun) -> Figure:
    """Change of the intersection angle, true and monitored, and their difference."""
    minutes = run.flight.times / 60.0
    figure = svg.new_figure(4.4)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    true, monitored = run.angle_change / ARCSEC, run.angle / ARCSEC
    above.plot(minutes, true, color=svg.INK, lw=1.3, label="true, traced")
    above.plot(minutes, monitored, "o", color=svg.BLUE, ms=4, label="monitored")
    above.set_ylabel("change of the angle [arcsec]")
    above.legend(loc="best")
    below.axhline(0.0, color=svg.GREY, lw=0.7)
    sigma = run.angle_sigma / ARCSEC
    below.fill_between(minutes, -sigma, sigma, color=svg.SKY, alpha=0.4, lw=0, label="σ")
    below.plot(minutes, monitored - true, "o-", color=svg.VERMILION, ms=3, lw=1.0)
    below.legend(loc="best")
    below.set(ylabel="monitored − true,\narcsec", xlabel="time [min]")
    _finish(above, below)
    return figure


def _height_figure(run: MonitorRun) -> Figure:
    """Mean height error of the cameras alone, and the points' RMS, over the orbit."""
    minutes, cases = run.flight.times / 60.0, run.cases
    figure = svg.new_figure(5.2)
    above, below = figure.subplots(2, 1, sharex=True)
    styles = (
        ("none", svg.VERMILION, "o-", "without monitoring"),
        ("interval", svg.GREEN, "s--", f"monitored every {run.flight.spec.interval / 60.0:g} min, linear between"),
        ("monitored", svg.BLUE, "o-", "monitored at every time"),
    )
    above.axhline(0.0, color=svg.GREY, lw=0.7)
    for name, colour, style, label in styles:
        above.plot(minutes, cases[name].camera, style, color=colour, ms=3.5, lw=1.2, label=label)
        below.plot(minutes, cases[name].height, style, color=colour, ms=3.5, lw=1.2)
    below.plot(minutes, cases["true"].height, ":", color=svg.INK, lw=1.3, label="true cameras: image, orbit, attitude")
    above.set_ylabel("mean height error\nby the cameras [m]")
    below.set(ylabel="RMS in height of\nall errors [m]", xlabel="time [min]")
    below.set_ylim(bottom=0.0)
    above.legend(loc="best")
    below.legend(loc="best")
    _finish(above, below)
    return figure


def _smoothed_figure(run: MonitorRun) -> Figure:
    """Mean height error of the cameras smoothed and interpolated, with the sigma that the smoother states."""
    spec = run.flight.spec
    minutes, chosen = run.flight.times / 60.0, run.smoothed
    figure = svg.new_figure(3.8)
    axes = figure.subplots()
    axes.axhline(0.0, color=svg.GREY, lw=0.7)
    for many, alpha in ((2.0, 0.2), (1.0, 0.4)):
        label = f"{'2' if many > 1.0 else ''}σ as the smoother states it"
        axes.fill_between(
            minutes, -many * chosen.sigma, many * chosen.sigma, color=svg.SKY, alpha=alpha, lw=0, label=label
        )
    axes.plot(minutes, run.cases["interval"].camera, "s--", color=svg.GREEN, ms=3.5, lw=1.0, label="linear between")
    axes.plot(minutes, chosen.case.camera, "o-", color=svg.PURPLE, ms=3.5, lw=1.2, label="smoothed")
    at = spec.measured(spec.interval)
    low = axes.get_ylim()[0]
    axes.plot(minutes[at], np.full(len(at), low), "|", color=svg.INK, ms=9, mew=1.4, label="measurements")
    axes.set_ylim(bottom=low)
    axes.set(xlabel="time [min]", ylabel="mean height error\nby the cameras [m]")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    _finish(axes)
    return figure


def _interval_figure(run: MonitorRun) -> Figure:
    """RMS in height against the interval."""
    figure = svg.new_figure(3.6)
    axes = figure.subplots()
    minutes = np.array(list(run.intervals)) / 60.0
    axes.loglog(
        minutes, [c.height_rms for c in run.intervals.values()], "o-", color=svg.BLUE, ms=5, lw=1.2, label="all errors"
    )
    alone = np.array([c.camera_height_rms for c in run.intervals.values()])
    axes.loglog(minutes, alone, "s--", color=svg.GREEN, ms=4, lw=1.2, label="by the cameras alone, linear between")
    if run.smoothing:
        chosen = [run.smoothing[interval] for interval in run.intervals]
        smoothed = [one.case.camera_height_rms for one in chosen]
        axes.loglog(minutes, smoothed, "D-", color=svg.PURPLE, ms=4, lw=1.2, label="by the cameras alone, smoothed")
        stated = [rms(one.sigma) for one in chosen]
        axes.loglog(minutes, stated, ":", color=svg.PURPLE, lw=1.4, label="σ that the smoother states")
    axes.axhline(run.cases["none"].height_rms, color=svg.VERMILION, lw=1.1, label="without monitoring")
    axes.axhline(run.cases["true"].height_rms, color=svg.INK, lw=1.1, ls=":", label="true cameras")
    axes.set_xticks(minutes, [f"{m:g}" for m in minutes])
    axes.minorticks_off()
    low, high = axes.get_ylim()
    marks = [v for v in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0) if low <= v <= high]
    if marks:
        axes.set_yticks(marks, [f"{v:g}" for v in marks])
    axes.set(xlabel="interval between measurements [min]", ylabel="RMS in height [m]")
    axes.legend(loc="best")
    _finish(axes)
    return figure


def _parts_figure(run: MonitorRun) -> Figure:
    """What the corrected cameras are still wrong by, in parts."""
    minutes = run.flight.times / 60.0
    figure = svg.new_figure(3.8)
    axes = figure.subplots()
    axes.axhline(0.0, color=svg.GREY, lw=0.7)
    axes.plot(minutes, run.cases["interval"].camera, color=svg.INK, lw=1.6, label="together, with the file's interval")
    for name, part in run.parts.items():
        if np.abs(part).max() > _LEAST:
            axes.plot(minutes, part, "o-", color=_COLOURS[name], ms=3, lw=1.0, label=PART_NAMES[name])
    axes.set(xlabel="time [min]", ylabel="mean height error [m]")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    _finish(axes)
    return figure


FIGURES: dict[str, Callable[[MonitorRun], Figure]] = {
    "angle": _angle_figure,
    "height": _height_figure,
    "smoothed": _smoothed_figure,
    "interval": _interval_figure,
    "remainder": _parts_figure,
}


def figure_svg(name: str, run: MonitorRun) -> str:
    """One of `FIGURES` as SVG."""
    with svg.look(f"monitor-{name}"):
        return svg.to_svg(FIGURES[name](run))


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.grid(color=svg.LIGHT, lw=0.5)
        svg.plain_axes(axes)
