"""Heat map and tornado of the changes of all responses per spread of each factor."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from twin.report.numbers import significant
from twin.report.svg import BLUE, INK, LIGHT, VERMILION, new_figure
from twin.study.gradient import Gradient
from twin.study.report.panels import finish
from twin.study.report.study_runs import typeset

MOST_BARS = 8
LINEAR = 1e-3
"""Share of a response's largest change below which the colours are linear."""
NEGLIGIBLE = 1e-3
"""Share of a response's largest change below which no bar is drawn."""


def normalised(found: Gradient) -> np.ndarray:
    """(R, F) changes per spread as shares of each response's largest; zeros for responses that nothing moves."""
    change = found.change
    largest = np.max(np.abs(change), axis=1, initial=0.0, keepdims=True)
    return np.asarray(np.where(largest > 0.0, change / np.where(largest > 0.0, largest, 1.0), 0.0))


def heat_map(found: Gradient) -> Figure:
    """Responses along x, factors down, coloured by the normalised change."""
    shares = normalised(found).T
    rows, columns = shares.shape
    figure = new_figure(2.1 + 0.21 * max(rows, 4))
    axes = figure.subplots()
    norm = SymLogNorm(LINEAR, vmin=-1.0, vmax=1.0)
    picture = axes.imshow(shares, cmap="RdBu", norm=norm, aspect="auto", interpolation="nearest")
    axes.set_xticks(np.arange(columns), list(found.responses), rotation=45, ha="right", rotation_mode="anchor")
    axes.set_yticks(np.arange(rows), [factor.name for factor in found.factors])
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.grid(which="minor", color=LIGHT, lw=0.5)
    axes.tick_params(which="minor", length=0)
    axes.tick_params(which="major", length=0)
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(picture, ax=axes, ticks=[-1, -0.1, -0.01, 0, 0.01, 0.1, 1], fraction=0.03, pad=0.01)
    bar.ax.set_yticklabels([f"{t:+g}".replace("-", "\N{MINUS SIGN}") if t else "0" for t in bar.get_ticks()])
    bar.set_label("change per spread / largest of the response")
    bar.outline.set_visible(False)
    bar.minorticks_off()
    return figure


def tornado(found: Gradient) -> Figure:
    """Per response the largest changes per spread."""
    change = found.change
    moved = [i for i in range(len(found.responses)) if np.any(change[i])]
    largest = [_largest(change[i]) for i in moved]
    wide = 2
    heights = [0.85 + 0.2 * max(len(one) for one in largest[k : k + wide]) for k in range(0, len(moved), wide)]
    figure = new_figure(max(sum(heights), 1.5))
    grid = figure.subplots(max(len(heights), 1), wide, squeeze=False, height_ratios=heights or None).ravel()
    for axes in grid[len(moved) :]:
        axes.set_axis_off()
    for axes, i, order in zip(grid, moved, largest, strict=False):
        _bars(axes, found, i, order)
    return figure


def _largest(change: np.ndarray) -> np.ndarray:
    order = np.argsort(-np.abs(change), kind="stable")[:MOST_BARS]
    return np.asarray(order[np.abs(change[order]) > NEGLIGIBLE * np.abs(change).max()])


def _bars(axes: Axes, found: Gradient, i: int, order: np.ndarray) -> None:
    values = found.change[i, order][::-1]
    y = np.arange(len(order))
    axes.barh(y, values, 0.66, color=[BLUE if value >= 0 else VERMILION for value in values])
    axes.axvline(0.0, color=INK, lw=0.8)
    axes.set_yticks(y, [found.factors[k].name for k in order[::-1]])
    unit = f", {typeset(found.units[i])}" if found.units[i] else ""
    rss = significant(float(np.linalg.norm(found.change[i])), 3, floor=0.0)
    axes.set_xlabel(f"{found.responses[i]}{unit} (all: {rss})")
    axes.set_ylim(-0.7, max(len(order), 2) - 0.3)
    finish(axes, 5, None)
    axes.grid(False, axis="y")
