"""Figures of a monitored orbit: the angle, heights with and without monitoring, the interval, what is left; of a closed
loop what is left over the orbit, where mechanisms stand, the open loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.monitor.control_loop import open_loop, rejection
from twin.orbit.monitoring.loop_run import LoopPass, LoopRun
from twin.orbit.monitoring.monitoring_numbers import positions
from twin.orbit.monitoring.monitoring_run import MonitorRun
from twin.orbit.monitoring.pair_flight import rms
from twin.run import svg
from twin.run.artefact import SvgFigure, shown_unit

PARTS = {
    "prisms": ("temperatures of the monitor's prisms", svg.VERMILION),
    "other_systematic": ("other errors of the monitor without noise", svg.ORANGE),
    "noise": ("noise of the monitor", svg.GREY),
    "not_applied": ("parameters that are not applied", svg.PURPLE),
    "beyond_parameters": ("beyond the four parameters", svg.SKY),
    "interpolation": ("interpolation over the interval", svg.GREEN),
}
"""Part of the height error -> how reports call it, and its colour."""
_LEAST = 5e-3
"""Metres; parts that are smaller at all times are not drawn."""
_COLOURS = (svg.BLUE, svg.VERMILION, svg.GREEN, svg.PURPLE, svg.ORANGE, svg.SKY)
_BESIDE = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
"""Where a legend stands that would hide curves."""


def _panels(height: float, rows: int, **how: Any) -> tuple[Figure, list[Axes]]:
    """A figure of panels below each other, with one axis of time."""
    figure = svg.new_figure(height)
    return figure, list(np.ravel(figure.subplots(rows, 1, sharex=True, **how)))


def _band(axes: Axes, minutes: np.ndarray, middle: Any, sigma: np.ndarray, colour: str, **how: Any) -> None:
    axes.fill_between(minutes, middle - sigma, middle + sigma, color=colour, lw=0, **how)


def _angle_figure(run: MonitorRun) -> Figure:
    """Change of the intersection angle, true and monitored, and their difference."""
    minutes = run.flight.times / 60.0
    figure, (above, below) = _panels(4.4, 2, height_ratios=(2.2, 1.0))
    true, monitored = run.angle_change / ARCSEC, run.angle / ARCSEC
    above.plot(minutes, true, color=svg.INK, lw=1.3, label="true, traced")
    above.plot(minutes, monitored, "o", color=svg.BLUE, ms=4, label="monitored")
    above.set_ylabel("change of the angle [arcsec]")
    _band(below, minutes, 0.0, run.angle_sigma / ARCSEC, svg.SKY, alpha=0.4, label="σ")
    below.plot(minutes, monitored - true, "o-", color=svg.VERMILION, ms=3, lw=1.0)
    below.set(ylabel="monitored − true,\narcsec", xlabel="time [min]")
    _legends(above, below)
    return figure


def _height_figure(run: MonitorRun) -> Figure:
    """Mean height error of the cameras alone, and the points' RMS, over the orbit."""
    minutes, cases = run.flight.times / 60.0, run.cases
    figure, (above, below) = _panels(5.2, 2)
    for name, colour, style, label in (
        ("none", svg.VERMILION, "o-", "without monitoring"),
        ("interval", svg.GREEN, "s--", f"monitored every {run.flight.spec.every / 60.0:g} min, linear between"),
        ("monitored", svg.BLUE, "o-", "monitored at every time"),
    ):
        above.plot(minutes, cases[name].camera, style, color=colour, ms=3.5, lw=1.2, label=label)
        below.plot(minutes, cases[name].height, style, color=colour, ms=3.5, lw=1.2)
    below.plot(minutes, cases["true"].height, ":", color=svg.INK, lw=1.3, label="true cameras: image, orbit, attitude")
    above.set_ylabel("mean height error\nby the cameras [m]")
    below.set(ylabel="RMS in height of\nall errors [m]", xlabel="time [min]")
    below.set_ylim(bottom=0.0)
    _legends(above, below)
    return figure


def _smoothed_figure(run: MonitorRun) -> Figure:
    """Mean height error of the cameras smoothed and interpolated, with the sigma that the smoother states."""
    spec, minutes, chosen = run.flight.spec, run.flight.times / 60.0, run.smoothed
    figure, (axes,) = _panels(3.8, 1)
    for many, alpha, label in ((2.0, 0.2, "2σ as the smoother states it"), (1.0, 0.4, "σ as the smoother states it")):
        _band(axes, minutes, 0.0, many * chosen.sigma, svg.SKY, alpha=alpha, label=label)
    axes.plot(minutes, run.cases["interval"].camera, "s--", color=svg.GREEN, ms=3.5, lw=1.0, label="linear between")
    axes.plot(minutes, chosen.case.camera, "o-", color=svg.PURPLE, ms=3.5, lw=1.2, label="smoothed")
    at = spec.measured(spec.every)
    low = axes.get_ylim()[0]
    axes.plot(minutes[at], np.full(len(at), low), "|", color=svg.INK, ms=9, mew=1.4, label="measurements")
    axes.set_ylim(bottom=low)
    axes.set(xlabel="time [min]", ylabel="mean height error\nby the cameras [m]")
    axes.legend(**_BESIDE)
    return figure


def _interval_figure(run: MonitorRun) -> Figure:
    """RMS in height against the interval."""
    figure, (axes,) = _panels(3.6, 1)
    minutes, intervals = np.array(list(run.intervals)) / 60.0, run.intervals.values()
    curves = [
        ([case.height_rms for case in intervals], "o-", svg.BLUE, 5, "all errors"),
        ([case.camera_height_rms for case in intervals], "s--", svg.GREEN, 4, "by the cameras alone, linear between"),
    ]
    if run.smoothing:
        chosen = [run.smoothing[interval] for interval in run.intervals]
        smoothed = [one.case.camera_height_rms for one in chosen]
        curves.append((smoothed, "D-", svg.PURPLE, 4, "by the cameras alone, smoothed"))
        curves.append(([rms(one.sigma) for one in chosen], ":", svg.PURPLE, 4, "σ that the smoother states"))
    for values, style, colour, size, label in curves:
        axes.loglog(minutes, values, style, color=colour, ms=size, lw=1.2, label=label)
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
    return figure


def _parts_figure(run: MonitorRun) -> Figure:
    """Height error of the corrected cameras, in parts."""
    minutes = run.flight.times / 60.0
    figure, (axes,) = _panels(3.8, 1)
    axes.plot(minutes, run.cases["interval"].camera, color=svg.INK, lw=1.6, label="together, with the file's interval")
    for name, part in run.parts.items():
        if np.abs(part).max() > _LEAST:
            label, colour = PARTS[name]
            axes.plot(minutes, part, "o-", color=colour, ms=3, lw=1.0, label=label)
    axes.set(xlabel="time [min]", ylabel="mean height error [m]")
    axes.legend(**_BESIDE)
    return figure


def _course_figure(run: LoopRun) -> Figure:
    """Angle, height and foci over the orbit, with the loop open and closed."""
    minutes = run.closed.course.times / 60.0
    figure, panels = _panels(2.2 * (2 + len(run.pair)), 2 + len(run.pair))

    def angle(one: LoopPass) -> tuple[np.ndarray, np.ndarray, float]:
        return one.true(one.angle), one.angle, ARCSEC

    def height(one: LoopPass) -> tuple[np.ndarray, np.ndarray, float]:
        return one.heights.camera, one.slopes, 1.0

    def focus(camera: str) -> Callable[[LoopPass], tuple[np.ndarray, np.ndarray, float]]:
        row = run.model.unit(camera, "defocus")
        return lambda one: (one.true(row), row, 1e-6)

    shown: dict[str, Callable[[LoopPass], tuple[np.ndarray, np.ndarray, float]]]
    shown = {"angle [arcsec]": angle, "height by the\ncameras [m]": height}
    shown |= {f"defocus of\n{name} [µm]": focus(name) for name in run.pair}
    for axes, (label, quantity) in zip(panels, shown.items(), strict=True):
        for state, one, style, colour in (
            ("open", run.open, "s--", svg.VERMILION),
            ("closed", run.closed, "o-", svg.BLUE),
        ):
            true, rows, size = quantity(one)
            middle, sigma = one.posterior(rows)
            _band(axes, minutes, middle / size, sigma / size, colour, alpha=0.2)
            axes.plot(minutes, true / size, style, color=colour, ms=3.0, lw=1.1, label=f"loop {state}, true")
        axes.set_ylabel(label)
    panels[0].legend(loc="best")
    panels[-1].set_xlabel("time [min]; bands: what the posterior says, ±σ")
    return figure


def _positions_figure(run: LoopRun) -> Figure:
    """Where the mechanisms stand."""
    units = list(dict.fromkeys(one.unit[0] for one in run.model.correctors))
    figure, panels = _panels(1.0 + 2.2 * len(units), len(units))
    minutes = run.closed.course.times / 60.0
    for axes, unit in zip(panels, units, strict=True):
        for k, one in enumerate(one for one in run.model.correctors if one.unit[0] == unit):
            colour = _COLOURS[k % len(_COLOURS)]
            axes.step(minutes, positions(run, one.name), where="post", color=colour, lw=1.2, label=one.name)
            for number in run.loops[one.name].ends:
                axes.axvline(minutes[number], color=colour, lw=0.8, ls=":")
        axes.set_ylabel(f"position [{shown_unit(unit)}]")
        axes.legend(loc="best", ncols=2)
    panels[-1].set_xlabel("time [min]; dotted: held by the end of a range")
    return figure


def _loop_figure(run: LoopRun) -> Figure:
    """The open loop in the complex plane, and what the closed one leaves of a swing."""
    figure = svg.new_figure(4.2)
    left, right = figure.subplots(1, 2)
    step, frequency = run.setup.test.step, np.geomspace(1e-3, 0.5, 400)
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 200))
    left.plot(turn.real, turn.imag, color=svg.LIGHT, lw=1.0)
    left.plot([-1.0], [0.0], "x", color=svg.INK, ms=7)
    drawn: dict[tuple[float, int], list[str]] = {}
    for name, one in run.loops.items():
        if one.loop_gain:
            drawn.setdefault((one.loop_gain, one.corrector.spec.delay), []).append(name)
    for k, ((gain, delay), names) in enumerate(drawn.items()):
        colour, at = _COLOURS[k % len(_COLOURS)], open_loop(gain, delay, frequency)
        left.plot(at.real, at.imag, color=colour, lw=1.2, label=f"gain {gain:.3g}, delay {delay}")
        share = np.maximum(rejection(gain, delay, frequency), 1e-4)
        right.loglog(frequency / step * 3600.0, share, color=colour, lw=1.2, label=", ".join(names))
    left.set(xlim=(-2.5, 1.5), ylim=(-2.5, 1.5), xlabel="real part of L", ylabel="imaginary part of L", aspect="equal")
    right.axhline(1.0, color=svg.GREY, lw=0.7)
    right.set(xlabel="frequency of the drift [1/h]", ylabel="share that is left", ylim=(1e-3, 5.0))
    if drawn:
        left.legend(loc="lower right")
        right.legend(loc="lower right")
    return figure


_FIGURES: dict[str, Callable[[Any], Figure]] = {
    "angle": _angle_figure,
    "height": _height_figure,
    "smoothed": _smoothed_figure,
    "interval": _interval_figure,
    "remainder": _parts_figure,
    "course": _course_figure,
    "positions": _positions_figure,
    "open-loop": _loop_figure,
}
_ABOUT_ZERO = ("angle", "height", "smoothed", "remainder", "course")
"""Figures of errors, with a line where there is none."""


def monitoring_figure(name: str, title: str, caption: str, run: MonitorRun | LoopRun) -> SvgFigure:
    """A figure of a report: ``angle``, ``height``, ``smoothed``, ``interval`` or ``remainder``; of a closed loop
    ``course``, ``positions`` or ``open-loop``.
    """
    with svg.look(f"monitor-{name}"):
        figure = _FIGURES[name](run)
        for axes in figure.axes:
            if name in _ABOUT_ZERO:
                axes.axhline(0.0, color=svg.GREY, lw=0.7, zorder=0.5)
            axes.grid(color=svg.LIGHT, lw=0.5)
            svg.plain_axes(axes)
        return SvgFigure(name, title, caption, svg.to_svg(figure))


def _legends(*panels: Axes) -> None:
    for axes in panels:
        axes.legend(loc="best")
