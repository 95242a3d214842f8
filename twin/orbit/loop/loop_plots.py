"""Figures of a loop: what is left over the orbit, where mechanisms stand, the open loop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.monitor.control_loop import open_loop, rejection
from analysis.units import ARCSEC
from twin.orbit.loop.loop_numbers import focus_told, focus_true, positions
from twin.orbit.loop.loop_run import LoopRun
from twin.run import svg

_COLOURS = (svg.BLUE, svg.VERMILION, svg.GREEN, svg.PURPLE, svg.ORANGE, svg.SKY)
_UNITS = {"um": "µm", "arcsec": "arcsec"}


def _course_figure(run: LoopRun) -> Figure:
    """Angle, height and foci over the orbit, with the loop open and closed."""
    minutes = run.closed.course.times / 60.0
    figure = svg.new_figure(2.2 * (2 + len(run.pair)))
    panels = figure.subplots(2 + len(run.pair), 1, sharex=True)

    def draw(axes: Axes, true: tuple[np.ndarray, np.ndarray], told: tuple[tuple[np.ndarray, np.ndarray], ...]) -> None:
        axes.axhline(0.0, color=svg.GREY, lw=0.7)
        for label, style, colour, value, (middle, sigma) in zip(
            ("open", "closed"), ("s--", "o-"), (svg.VERMILION, svg.BLUE), true, told, strict=True
        ):
            axes.fill_between(minutes, middle - sigma, middle + sigma, color=colour, alpha=0.2, lw=0)
            axes.plot(minutes, value, style, color=colour, ms=3.0, lw=1.1, label=f"loop {label}, true")

    def scaled(pair: tuple[np.ndarray, np.ndarray], size: float) -> tuple[np.ndarray, np.ndarray]:
        return pair[0] / size, pair[1] / size

    both = (run.open, run.closed)
    draw(
        panels[0],
        tuple(one.true(one.angle) / ARCSEC for one in both),  # type: ignore[arg-type]
        tuple(scaled(one.told(one.angle), ARCSEC) for one in both),
    )
    panels[0].set_ylabel("angle [arcsec]")
    draw(panels[1], (run.open.heights.camera, run.closed.heights.camera), tuple(one.told(one.slopes) for one in both))
    panels[1].set_ylabel("height by the\ncameras [m]")
    for axes, name in zip(panels[2:], run.pair, strict=True):
        draw(
            axes,
            tuple(focus_true(run, one, name) * 1e6 for one in both),  # type: ignore[arg-type]
            tuple(scaled(focus_told(run, one, name), 1e-6) for one in both),
        )
        axes.set_ylabel(f"defocus of\n{name} [µm]")
    panels[0].legend(loc="best")
    panels[-1].set_xlabel("time [min]; bands: what the posterior says, ±σ")
    _finish(*panels)
    return figure


def _positions_figure(run: LoopRun) -> Figure:
    """Where the mechanisms stand."""
    units = list(dict.fromkeys(one.unit[0] for one in run.model.correctors))
    figure = svg.new_figure(1.0 + 2.2 * len(units))
    panels = np.atleast_1d(figure.subplots(len(units), 1, sharex=True))
    minutes = run.closed.course.times / 60.0
    for axes, unit in zip(panels, units, strict=True):
        own = [one for one in run.model.correctors if one.unit[0] == unit]
        for k, one in enumerate(own):
            colour = _COLOURS[k % len(_COLOURS)]
            axes.step(minutes, positions(run, one.name), where="post", color=colour, lw=1.2, label=one.name)
            for moment in run.loops[one.name].ends:
                axes.axvline(minutes[moment], color=colour, lw=0.8, ls=":")
        axes.set_ylabel(f"position [{_UNITS[unit]}]")
        axes.legend(loc="best", ncols=2)
    panels[-1].set_xlabel("time [min]; dotted: held by the end of a range")
    _finish(*panels)
    return figure


def _loop_figure(run: LoopRun) -> Figure:
    """The open loop in the complex plane, and what the closed one leaves of a swing."""
    figure = svg.new_figure(4.2)
    left, right = figure.subplots(1, 2)
    every = run.setup.test.readings.every
    frequency = np.geomspace(1e-3, 0.5, 400)
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 200))
    left.plot(turn.real, turn.imag, color=svg.LIGHT, lw=1.0)
    left.plot([-1.0], [0.0], "x", color=svg.INK, ms=7)
    drawn: dict[tuple[float, int], list[str]] = {}
    for name, one in run.loops.items():
        if one.loop_gain:
            drawn.setdefault((one.loop_gain, one.corrector.spec.delay), []).append(name)
    for k, ((gain, delay), names) in enumerate(drawn.items()):
        colour, label = _COLOURS[k % len(_COLOURS)], ", ".join(names)
        at = open_loop(gain, delay, frequency)
        left.plot(at.real, at.imag, color=colour, lw=1.2, label=f"gain {gain:.3g}, delay {delay}")
        right.loglog(
            frequency / every * 3600.0,
            np.maximum(rejection(gain, delay, frequency), 1e-4),
            color=colour,
            lw=1.2,
            label=label,
        )
    left.set(xlim=(-2.5, 1.5), ylim=(-2.5, 1.5), xlabel="real part of L", ylabel="imaginary part of L", aspect="equal")
    right.axhline(1.0, color=svg.GREY, lw=0.7)
    right.set(xlabel="frequency of the drift [1/h]", ylabel="share that is left", ylim=(1e-3, 5.0))
    if drawn:
        left.legend(loc="lower right")
        right.legend(loc="lower right")
    _finish(left, right)
    return figure


FIGURES: dict[str, Callable[[LoopRun], Figure]] = {
    "course": _course_figure,
    "positions": _positions_figure,
    "open-loop": _loop_figure,
}


def figure_svg(name: str, run: LoopRun) -> str:
    """One of `FIGURES` as SVG."""
    with svg.look(f"loop-{name}"):
        return svg.to_svg(FIGURES[name](run))


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.grid(color=svg.LIGHT, lw=0.5)
        svg.plain_axes(axes)
