"""Figures of the intersection angle test: planes and strips, their answers to errors, the scatter over many passes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.orbit.angles import AXES
from analysis.units import ARCSEC
from twin.orbit.angle.angle_run import Scatter, SimulatedAngleRun
from twin.run.svg import (
    BLUE,
    GREEN,
    GREY,
    INK,
    LIGHT,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    look,
    new_figure,
    plain_axes,
    to_svg,
)

COLOURS = (BLUE, GREEN, VERMILION, ORANGE, PURPLE, SKY)
AXIS_COLOURS = dict(zip(AXES, (BLUE, GREEN, VERMILION), strict=True))
_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ"}


_LEAST_ARC = np.radians(5.0)
"""Smaller angles are not marked in the picture, where their lines are one."""


def signs(names: Iterable[str]) -> list[str]:
    """Angles' names as a report writes them."""
    return [_GREEK.get(name, name.replace("_", " ")) for name in names]


def panels(run: SimulatedAngleRun) -> dict[str, list[tuple[str, str]]]:
    """Figure of the sensitivity -> its panels: what is moved, and the angle."""
    pairs = run.flight.pairs
    out = {"station": [("station", name) for name in pairs]}
    out.update({f"{name}-points": [(line, name) for line in pair] for name, pair in pairs.items()})
    return out


def geometry_figure(run: SimulatedAngleRun) -> Figure:
    """Station, planes and strips, seen from the side (along the lines) and from above; orbital axes."""
    flight = run.flight
    figure = new_figure(4.6)
    side, above = figure.subplots(1, 2)
    for k, name in enumerate(flight.lines):
        arm = (run.measurement.strips[name].points - flight.station) @ flight.orbital.T / 1e3
        colour = COLOURS[k % len(COLOURS)]
        middle = arm[len(arm) // 2]
        side.plot([0.0, middle[0]], [0.0, middle[2]], color=colour, lw=1.3)
        side.plot(arm[:, 0], arm[:, 2], ".", color=colour, ms=4)
        above.fill([0.0, arm[0, 0], arm[-1, 0]], [0.0, arm[0, 1], arm[-1, 1]], color=colour, alpha=0.12, lw=0)
        above.plot(arm[:, 0], arm[:, 1], ".", color=colour, ms=3, label=f"{name.replace('_', ' ')}")
    for axes in (side, above):
        axes.plot(0.0, 0.0, "o", color=INK, ms=5)
        axes.set_xlabel("X, forward [km]")
    side.annotate("O", (0.0, 0.0), (8, 2), textcoords="offset points")
    pitch = {
        name: float(np.arctan2(*(c.look(np.array([0.5 * (c.pixels - 1)]))[0, [0, 2]])))
        for name, c in flight.cameras.items()
    }
    for sign, (a, b) in zip(signs(flight.pairs), flight.pairs.values(), strict=True):
        turn = np.linspace(pitch[b], pitch[a], 40)
        if abs(turn[-1] - turn[0]) < _LEAST_ARC:
            continue
        side.plot(150.0 * np.sin(turn), 150.0 * np.cos(turn), color=GREY, lw=0.8)
        half = turn[20]
        side.text(185.0 * np.sin(half), 185.0 * np.cos(half), sign, ha="center", va="center")
    side.invert_yaxis()
    side.set_aspect("equal")
    points = len(run.measurement.strips[flight.lines[0]].points)
    side.set(title="From the side: the planes on edge", ylabel="Z, down [km]")
    above.set(title=f"From above: strips of {points} points, Y stretched", ylabel="Y, right [km]")
    above.legend(loc="upper center", ncols=3, markerscale=2.0)
    above.margins(y=0.35)
    _finish(side, above)
    return figure


def sensitivity_figure(run: SimulatedAngleRun, name: str) -> Figure:
    """Difference of the angles, resection minus planes, over a move of 0 to 10 m, per axis."""
    rows = {(row.what, row.axis): row for row in run.table}
    shows = panels(run)[name]
    wide = min(len(shows), 2)
    high = (len(shows) + 1) // 2
    figure = new_figure(3.2 * high)
    grid = figure.subplots(high, wide, sharey=True, squeeze=False)
    for axes in grid.ravel()[len(shows) :]:
        axes.set_axis_off()
    for axes, (what, angle) in zip(grid.ravel(), shows, strict=False):
        k = run.names.index(angle)
        for axis in AXES:
            row = rows[what, axis]
            shown = (-run.difference[k] - row.change[k]) / ARCSEC
            axes.plot(row.amount, shown, "o-", color=AXIS_COLOURS[axis], ms=3, lw=1.2, label=axis)
        thing = "station" if what == "station" else f"{what.replace('_', ' ')} points"
        axes.set(title=f"{signs([angle])[0]} over the error of the {thing}", xlabel="m")
        axes.legend(loc="best", ncols=3)
        _finish(axes)
    for axes in grid[:, 0]:
        axes.set_ylabel("resection − planes [arcsec]")
    return figure


def scatter_figure(run: SimulatedAngleRun) -> Figure:
    """Angles of all passes about the truth, with what the claimed covariance says: of the first two angles the 95%
    ellipse, of a single one the normal distribution.
    """
    figure = new_figure(4.4 if len(run.names) > 1 else 3.2)
    grid = figure.subplots(1, 2, sharex=True, sharey=True)
    cases = (("Planes, total least squares", run.planes), ("Resection", run.resection))
    names = signs(run.names)
    for axes, (title, scatter) in zip(grid, cases, strict=True):
        off = (scatter.values - scatter.truth) / ARCSEC
        axes.set(title=title, xlabel=f"{names[0]} − truth [arcsec]")
        if len(names) > 1:
            axes.plot(off[:, 0], off[:, 1], ".", color=BLUE, ms=4, label=f"{len(off)} passes")
            axes.plot(*_ellipse(scatter).T, color=VERMILION, lw=1.2, label="95% by propagation")
            axes.plot(0.0, 0.0, "+", color=INK, ms=9)
            axes.set_aspect("equal")
        else:
            sigma = float(scatter.sigma[0] / ARCSEC)
            place = np.linspace(-4.0, 4.0, 161) * sigma
            axes.hist(
                off[:, 0], bins=np.linspace(-4.0, 4.0, 25) * sigma, density=True, color=SKY, label=f"{len(off)} passes"
            )
            bell = np.exp(-0.5 * (place / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
            axes.plot(place, bell, color=VERMILION, lw=1.2, label="by propagation")
        axes.legend(loc="upper right")
    grid[0].set_ylabel(f"{names[1]} − truth [arcsec]" if len(names) > 1 else "share of passes per arcsec")
    grid[0].margins(0.2 if len(names) > 1 else 0.05)
    _finish(*grid)
    return figure


def figure_svg(name: str, run: SimulatedAngleRun) -> str:
    """One figure as SVG; name: ``geometry``, ``scatter`` or one of `panels`."""
    with look(f"angle-{name}"):
        if name in panels(run):
            return to_svg(sensitivity_figure(run, name))
        return to_svg({"geometry": geometry_figure, "scatter": scatter_figure}[name](run))


def _ellipse(scatter: Scatter) -> np.ndarray:
    """(m, 2) of the first two angles, arcsec; chi-square of two degrees of freedom is 5.991 at 95%."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    root = np.linalg.cholesky(scatter.covariance[:2, :2]) / ARCSEC
    return np.asarray(np.sqrt(5.991) * np.stack([np.cos(turn), np.sin(turn)], axis=-1) @ root.T)


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.grid(color=LIGHT, lw=0.5)
        plain_axes(axes)
