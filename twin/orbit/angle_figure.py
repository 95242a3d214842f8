"""Figures of the intersection angle test: planes and strips, the paper's Figs. 3-5, the scatter over many passes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.orbit.sensitivity import AXES
from scenes.orbit_angle import LINES
from twin.orbit.angle_analysis import ANGLES, ARCSEC, AngleRun, Scatter
from twin.report.svg import BLUE, GREEN, GREY, INK, LIGHT, VERMILION, look, new_figure, plain_axes, to_svg

COLOURS = {"forward": BLUE, "nadir": GREEN, "aft": VERMILION}
AXIS_COLOURS = dict(zip(AXES, (BLUE, GREEN, VERMILION), strict=True))
SIGNS = {"alpha": "α", "beta": "β"}
PANELS = {
    "station": (("station", "alpha", "3"), ("station", "beta", "3")),
    "alpha-points": (("forward", "alpha", "4"), ("nadir", "alpha", "4")),
    "beta-points": (("nadir", "beta", "5"), ("aft", "beta", "5")),
}
"""Figure -> its panels: what is moved, angle, figure of the paper."""


def geometry_figure(run: AngleRun) -> Figure:
    """Station, planes and strips, seen from the side (along the lines) and from above; orbital axes."""
    flight = run.flight
    figure = new_figure(4.6)
    side, above = figure.subplots(1, 2)
    for name in LINES:
        arm = (run.measurement.strips[name].points - flight.station) @ flight.orbital.T / 1e3
        colour = COLOURS[name]
        middle = arm[len(arm) // 2]
        side.plot([0.0, middle[0]], [0.0, middle[2]], color=colour, lw=1.3)
        side.plot(arm[:, 0], arm[:, 2], ".", color=colour, ms=4)
        above.fill([0.0, arm[0, 0], arm[-1, 0]], [0.0, arm[0, 1], arm[-1, 1]], color=colour, alpha=0.12, lw=0)
        above.plot(arm[:, 0], arm[:, 1], ".", color=colour, ms=3, label=f"{name}, {len(arm)} points")
    for axes in (side, above):
        axes.plot(0.0, 0.0, "o", color=INK, ms=5)
        axes.set_xlabel("X, forward, km")
    side.annotate("O", (0.0, 0.0), (8, 2), textcoords="offset points")
    for name, sign in (("alpha", 1.0), ("beta", -1.0)):
        turn = np.linspace(0.0, sign * run.flight.dihedral[name], 40)
        side.plot(150.0 * np.sin(turn), 150.0 * np.cos(turn), color=GREY, lw=0.8)
        half = turn[20]
        side.text(185.0 * np.sin(half), 185.0 * np.cos(half), SIGNS[name], ha="center", va="center")
    side.invert_yaxis()
    side.set_aspect("equal")
    side.set(title="From the side: the three planes on edge", ylabel="Z, down, km")
    above.set(title="From above: the strips, Y stretched", ylabel="Y, right, km")
    above.legend(loc="upper center", ncols=3, markerscale=2.0)
    above.margins(y=0.25)
    _finish(side, above)
    return figure


def sensitivity_figure(run: AngleRun, name: str) -> Figure:
    """Difference of the angles, resection minus planes, over a move of 0 to 10 m, as the paper draws it."""
    rows = {(row.what, row.axis): row for row in run.table}
    figure = new_figure(3.2)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (what, angle, _) in zip(panels, PANELS[name], strict=True):
        k = ANGLES.index(angle)
        for axis in AXES:
            row = rows[what, axis]
            shown = (-run.difference[k] - row.change[k]) / ARCSEC
            axes.plot(row.amount, shown, "o-", color=AXIS_COLOURS[axis], ms=3, lw=1.2, label=axis)
        thing = "station" if what == "station" else f"{what} points"
        axes.set(title=f"{SIGNS[angle]} over the error of the {thing}", xlabel="m")
        axes.legend(loc="best", ncols=3)
    panels[0].set_ylabel("resection − planes, arcsec")
    _finish(*panels)
    return figure


def scatter_figure(run: AngleRun) -> Figure:
    """Angles of all passes about the truth, with the 95% ellipse of the claimed covariance."""
    figure = new_figure(4.4)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    cases = (("Planes, total least squares", run.planes), ("Resection", run.resection))
    for axes, (title, scatter) in zip(panels, cases, strict=True):
        off = (scatter.values - scatter.truth) / ARCSEC
        axes.plot(off[:, 0], off[:, 1], ".", color=BLUE, ms=4, label=f"{len(off)} passes")
        axes.plot(*_ellipse(scatter).T, color=VERMILION, lw=1.2, label="95% by propagation")
        axes.plot(0.0, 0.0, "+", color=INK, ms=9)
        axes.set(title=title, xlabel="α − truth, arcsec")
        axes.set_aspect("equal")
        axes.legend(loc="upper right")
    panels[0].set_ylabel("β − truth, arcsec")
    panels[0].margins(0.2)
    _finish(*panels)
    return figure


def drawn(name: str, run: AngleRun) -> str:
    """One figure as SVG; name: ``geometry``, ``scatter`` or a key of `PANELS`."""
    with look(f"angle-{name}"):
        if name in PANELS:
            return to_svg(sensitivity_figure(run, name))
        return to_svg({"geometry": geometry_figure, "scatter": scatter_figure}[name](run))


def _ellipse(scatter: Scatter) -> np.ndarray:
    """(m, 2), arcsec; chi-square of two degrees of freedom is 5.991 at 95%."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    root = np.linalg.cholesky(scatter.covariance) / ARCSEC
    return np.asarray(np.sqrt(5.991) * np.stack([np.cos(turn), np.sin(turn)], axis=-1) @ root.T)


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.grid(color=LIGHT, lw=0.5)
        plain_axes(axes)
