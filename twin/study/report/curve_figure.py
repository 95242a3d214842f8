"""Responses against factors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.report.numbers import plain
from twin.report.svg import BLUE, GREY, SKY
from twin.study.report.analysis import StudyAnalysis
from twin.study.report.panels import COLOURS, MARKS, bins, finish, jitter, name_texts, panels, positions, short, some
from twin.study.report.statistics import mean_interval
from twin.study.report.study_runs import Factor, Response

MOST_LINES = 6
MOST_PANELS = 6


def curve_figure(found: StudyAnalysis, response: Response) -> Figure:
    """A panel for each of the factors that matter most, up to six."""
    order = list(found.influence(response.name))
    factors = sorted(found.runs.factors, key=lambda factor: order.index(factor.name))
    factors = [factor for factor in factors if len(factor.levels) > 1][:MOST_PANELS]
    if not factors:
        factors = list(found.runs.factors[:1])
    wide = min(len(factors), 3)
    figure, grid = panels(len(factors), wide, 3.5 if wide < 3 else 3.0)
    for k, (axes, factor) in enumerate(zip(grid, factors, strict=True)):
        other = _partner(factor, factors) if not found.runs.drawn else None
        if not factor.numeric:
            _bars(axes, factor, other, response)
        elif found.runs.drawn:
            _binned(axes, factor, response)
        else:
            _lines(axes, factor, other, response)
        axes.set_xlabel(factor.label)
        if k % wide == 0:
            axes.set_ylabel(response.label)
        finish(axes, 5 if factor.numeric else None)
        name_texts(axes, factor, "x")
        # all panels of a drawn design have the same lines
        if axes.get_legend_handles_labels()[0] and (k == 0 or not found.runs.drawn):
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.04), fontsize=7.5, ncols=3, columnspacing=0.9)
    return figure


def _partner(factor: Factor, factors: Sequence[Factor]) -> Factor | None:
    """The most important other factor that takes several values, for lines or groups."""
    return next((f for f in factors if f is not factor and len(f.levels) > 1), None)


def _binned(axes: Axes, factor: Factor, response: Response) -> None:
    """Mean of neighbouring runs, its interval, the middle 68% of the runs, and the runs."""
    shown = some(response.good)
    axes.plot(factor.values[shown], response.values[shown], ".", color=GREY, ms=2.0, alpha=0.5, zorder=1)
    groups = list(bins(factor, response.good))
    if len(groups) < 2 or min(len(group) for group in groups) < 3:
        return
    x = np.array([factor.values[group].mean() for group in groups])
    parts = [response.values[group] for group in groups]
    low, high = np.array([np.quantile(part, (0.1587, 0.8413)) for part in parts]).T
    ends = np.array([mean_interval(part) for part in parts], np.float64)
    mean = np.array([part.mean() for part in parts])
    axes.fill_between(x, low, high, color=SKY, alpha=0.35, lw=0, label="middle 68%")
    error = np.abs(ends.T - mean)
    axes.errorbar(x, mean, error, fmt="o-", color=BLUE, ms=3, lw=1.2, capsize=2, label="mean, 95%")


def _groups(other: Factor | None, response: Response) -> list[tuple[str, np.ndarray]]:
    """(label, runs) of each value of the other factor."""
    if other is None:
        return [("", response.good)]
    number = (lambda level: plain(level, 4)) if other.numeric else (lambda level: short(str(level)))
    head = f"{other.name} "
    count = len(other.levels)
    shown = other.levels[np.unique(np.linspace(0, count - 1, min(count, MOST_LINES)).round().astype(int))]
    return [
        (f"{head if k == 0 else ''}{number(level)}", response.good & (other.values == level))
        for k, level in enumerate(shown)
    ]


def _lines(axes: Axes, factor: Factor, other: Factor | None, response: Response) -> None:
    """Means at the values of a grid, a line for each value of the other factor."""
    for k, (label, runs) in enumerate(_groups(other, response)):
        means = [(v, response.values[runs & (factor.values == v)]) for v in factor.levels]
        points = np.array([(v, part.mean()) for v, part in means if len(part)])
        if len(points):
            mark, colour = MARKS[k % len(MARKS)], COLOURS[k % len(COLOURS)]
            axes.plot(*points.T, f"{mark}-", color=colour, ms=3.5, lw=1.2, label=label or None)


def _bars(axes: Axes, factor: Factor, other: Factor | None, response: Response) -> None:
    """Means for each text, with one standard deviation of the runs as whiskers; bars where zero is in sight, otherwise
    points.
    """
    groups = _groups(other, response)
    width = 0.8 / len(groups)
    means = [[response.values[runs & (factor.values == level)] for level in factor.levels] for _, runs in groups]
    every = np.array([part.mean() for row in means for part in row if len(part)])
    spread = float(np.std(response.known)) if len(response.known) else 0.0
    from_zero = len(every) > 0 and np.max(np.abs(every)) < 8.0 * max(spread, np.ptp(every))
    for k, ((label, _), row) in enumerate(zip(groups, means, strict=True)):
        x = np.array([j for j, part in enumerate(row) if len(part)], np.float64)
        x += (k - 0.5 * (len(groups) - 1)) * width
        y = np.array([part.mean() for part in row if len(part)])
        whisker = [float(np.std(part, ddof=1)) if len(part) > 1 else 0.0 for part in row if len(part)]
        colour = COLOURS[k % len(COLOURS)]
        style = {"capsize": 2.5, "ecolor": "#1b1f24", "elinewidth": 0.9, "label": label or None}
        if from_zero:
            bar = {name: style[name] for name in ("capsize", "ecolor", "label")}
            axes.bar(x, y, 0.92 * width, yerr=whisker, color=colour, alpha=0.85, **bar)  # type: ignore[arg-type]
        else:
            axes.errorbar(x, y, whisker, fmt=MARKS[k % len(MARKS)], color=colour, ms=5, **style)  # type: ignore[arg-type]


def scatter_figure(found: StudyAnalysis, pairs: Sequence[tuple[str, str]]) -> Figure:
    """The pairs that the study asks for."""
    wide = min(len(pairs), 3)
    figure, grid = panels(len(pairs), wide, 3.5)
    for axes, (x_name, y_name) in zip(grid, pairs, strict=True):
        x, y = found.runs.find(x_name), found.runs.find(y_name)
        _points(axes, x, y, found.runs.study.design.seed)
        axes.set(xlabel=x.label, ylabel=y.label)
        finish(axes, 5, 5)
        name_texts(axes, x, "x")
        name_texts(axes, y, "y")
    return figure


def _points(axes: Axes, x: Factor | Response, y: Factor | Response, seed: int, size: float = 3.0) -> None:
    places, heights = positions(x) + jitter(x, seed), positions(y) + jitter(y, seed + 1)
    shown = some(np.isfinite(places) & np.isfinite(heights))
    axes.plot(places[shown], heights[shown], ".", color=BLUE, ms=size, alpha=0.6)
