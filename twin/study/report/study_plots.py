"""Figures of a study: distributions, response curves, effects, pairs and Pareto fronts."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from twin.framework import svg
from twin.framework.artefact import plain
from twin.framework.svg import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, SKY, VERMILION
from twin.study.report.study_analysis import StudyAnalysis
from twin.study.report.study_statistics import Description, Factor, Response, Series, mean_interval, typeset

COLOURS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
MARKS = ("o", "s", "^", "D", "v", "P")
MOST_POINTS = 500
"""Largest number of points in a scatter plot, to limit the size of the page and overplotting."""
STEPS = (1, 2, 2.5, 5, 10)
"""Allowed spacings of an axis' ticks, apart from a power of ten."""
LONGEST = 18
"""Largest number of characters of a text at a tick of an axis; longer texts are cut."""


def finish(axes: Axes, x_ticks: int | None = 6, y_ticks: int | None = 5) -> None:
    """Format the axes of a panel with at most ``x_ticks`` and ``y_ticks`` ticks; None leaves that axis unchanged."""
    svg.gridded(axes)
    if x_ticks is not None:
        axes.xaxis.set_major_locator(MaxNLocator(x_ticks, steps=STEPS))
        _plain_numbers(axes, "x")
    if y_ticks is not None:
        axes.yaxis.set_major_locator(MaxNLocator(y_ticks, steps=STEPS))
        _plain_numbers(axes, "y")


def _plain_numbers(axes: Axes, axis: str) -> None:
    """Show full numbers at the ticks instead of an offset, as long as they are short."""
    low, high = axes.get_xlim() if axis == "x" else axes.get_ylim()
    short = abs(high - low) > 1e-4 * max(abs(low), abs(high))
    axes.ticklabel_format(axis=axis, style="sci", scilimits=(-3, 5), useOffset=not short)  # type: ignore[arg-type]


def short(text: str) -> str:
    """Return a text cut to fit on an axis."""
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def positions(series: Series) -> np.ndarray:
    """Return the coordinate of each run's value along a plot axis, (runs,): a number itself, texts at 0, 1, ..."""
    if not series.numeric:
        return np.array([np.flatnonzero(series.levels == value)[0] for value in series.values], np.float64)
    return series.values


def name_texts(axes: Axes, series: Series, axis: str) -> None:
    """Label the ticks of an axis with the text values of a series that ``positions`` placed; do nothing for numbers."""
    if series.numeric:
        return
    ticks, names = np.arange(len(series.levels)), [short(str(level)) for level in series.levels]
    if axis == "x":
        rotated = sum(len(name) for name in names) > 34
        axes.set_xticks(ticks, names, rotation=30 if rotated else 0, ha="right" if rotated else "center")
        axes.set_xlim(-0.6, len(names) - 0.4)
    else:
        axes.set_yticks(ticks, names)
        axes.set_ylim(-0.6, len(names) - 0.4)


def thinned(good: np.ndarray, most: int = MOST_POINTS) -> np.ndarray:
    """Return the indices of up to ``most`` of the runs for which ``good`` is True, evenly spaced through the study."""
    indices = np.flatnonzero(good)
    return indices if len(indices) <= most else indices[np.linspace(0, len(indices) - 1, most).astype(int)]


def dot_size(count: int) -> float:
    """Return the size of each of so many points, in points: large for few, small where many overlap."""
    return float(np.clip(60.0 / np.sqrt(max(count, 1)), 2.5, 7.0))


def jitter(series: Series, seed: int) -> np.ndarray:
    """Return random offsets of plotted points, (runs,), that keep points with the same text from hiding each other."""
    if not series.numeric:
        return np.random.default_rng(np.random.SeedSequence(seed)).uniform(-0.2, 0.2, len(series.values))
    return np.zeros(len(series.values))


MOST_LEVELS = 12
"""Largest number of values of a factor whose runs are averaged value by value."""


def histogram_figure(analysis: StudyAnalysis, names: Sequence[str]) -> Figure:
    """Plot the histograms of the named responses."""
    responses = [r for r in analysis.runs.responses if r.name in names]
    figure, grid = svg.panels([3.0] * len(responses), min(len(responses), 2))
    for axes, response in zip(grid, responses, strict=True):
        _histogram(axes, response, analysis.descriptions[response.name], analysis.runs.sampled)
    return figure


def _histogram(axes: Axes, response: Response, about: Description, sampled: bool) -> None:
    values = response.known
    axes.set(xlabel=response.label, ylabel="runs")
    if response.constant or about.mean is None or about.std is None:
        text = "no run has a value" if len(values) == 0 else f"all {len(values)} runs: {values[0]:.6g}"
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center")
        finish(axes, None, None)
        axes.set_xticks([])
        axes.set_yticks([])
        return
    edges = np.histogram_bin_edges(values, bins=_bin_count(values))
    axes.hist(values, bins=list(edges), color=SKY, edgecolor="white", linewidth=0.4)
    mean, std = about.mean.value, about.std.value
    axes.axvline(mean, color=INK, lw=1.3, label="mean")
    if sampled:
        for k, position in enumerate((mean - 3.0 * std, mean + 3.0 * std)):
            axes.axvline(position, color=VERMILION, lw=1.2, ls="--", label="mean ± 3σ" if k == 0 else None)
        normal = about.normality is None or about.normality.normal
        if not normal and about.tails is not None:
            for k, position in enumerate(about.tails):
                axes.axvline(position, color=GREEN, lw=1.4, ls=":", label="0.135% and 99.865%" if k == 0 else None)
        if normal and about.normality is not None:
            x = np.linspace(mean - 3.5 * std, mean + 3.5 * std, 200)
            bell = np.exp(-0.5 * ((x - mean) / std) ** 2) / (np.sqrt(2.0 * np.pi) * std)
            axes.plot(x, bell * len(values) * (edges[1] - edges[0]), color=GREEN, lw=1.1, label="normal distribution")
    finish(axes)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize=7.5, columnspacing=1.0)


def _bin_count(values: np.ndarray) -> int:
    """Return the number of bins by the rule of Freedman and Diaconis, limited to 5 to 50."""
    low, high = np.quantile(values, (0.25, 0.75))
    width = 2.0 * (high - low) / len(values) ** (1.0 / 3.0)
    return int(np.clip(np.ceil(np.ptp(values) / width), 5, 50)) if width > 0.0 else 10


MOST_LINES = 6
"""Largest number of lines in one panel of a response curve figure."""
MOST_PANELS = 6
"""Largest number of factors for which a response curve is drawn."""


def curve_figure(analysis: StudyAnalysis, response: Response) -> Figure:
    """Plot a response against each of the most important factors, up to six."""
    order = list(analysis.influence(response.name))
    factors = sorted(analysis.runs.factors, key=lambda factor: order.index(factor.name))
    factors = [factor for factor in factors if len(factor.levels) > 1][:MOST_PANELS]
    if not factors:
        factors = list(analysis.runs.factors[:1])
    wide = min(len(factors), 3)
    figure, grid = svg.panels([3.5 if wide < 3 else 3.0] * len(factors), wide)
    for k, (axes, factor) in enumerate(zip(grid, factors, strict=True)):
        # the most important of the other factors, whose values are shown as separate lines or bar groups
        others = () if analysis.runs.sampled else (f for f in factors if f is not factor and len(f.levels) > 1)
        other = next(iter(others), None)
        if not factor.numeric:
            _means_of_texts(axes, factor, other, response)
        elif analysis.runs.sampled:
            _fitted(axes, factor, response)
        else:
            _lines(axes, factor, other, response)
        axes.set_xlabel(factor.label)
        if k % wide == 0:
            axes.set_ylabel(response.label)
        finish(axes, 5 if factor.numeric else None)
        name_texts(axes, factor, "x")
        # all panels of a drawn design have the same lines
        if axes.get_legend_handles_labels()[0] and (k == 0 or not analysis.runs.sampled):
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.04), fontsize=7.5, ncols=3, columnspacing=0.9)
    return figure


def _fitted(axes: Axes, factor: Factor, response: Response) -> None:
    """Plot runs and the curve of their mean with its band of one standard deviation, from the first run to the last."""
    shown = thinned(response.good)
    axes.plot(
        factor.values[shown], response.values[shown], ".", color=GREY, ms=dot_size(len(shown)), alpha=0.7, zorder=1
    )
    known, values = factor.values[response.good], response.values[response.good]
    x = np.unique(known)
    if len(x) > MOST_LEVELS:
        x = np.linspace(x[0], x[-1], _CURVE_POINTS)
        mean, spread = local_fit(known, values, x)
        axes.plot(x, mean, color=BLUE, lw=1.4, label="mean")
    else:
        parts = [values[known == level] for level in x]
        if len(parts) < 2 or min(map(len, parts)) < 3:
            return
        mean, spread = np.array([(part.mean(), part.std()) for part in parts]).T
        style: dict[str, Any] = {"fmt": "o-", "color": BLUE, "ms": 3, "lw": 1.2, "capsize": 2, "label": "mean, 95%"}
        svg.interval_bars(axes, x, mean, [mean_interval(part) for part in parts], **style)
    axes.fill_between(x, mean - spread, mean + spread, color=SKY, alpha=0.35, lw=0, label="± 1 standard deviation")


_CURVE_POINTS = 81
"""Points of the curve of a mean."""
_NEIGHBOURS = 0.3
"""Share of the runs that a local fit uses, those nearest to a point; at least ten."""


def local_fit(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the local mean of y, (N,), over x, (N,), and the standard deviation about it, at M places ``at``, (M,).

    The mean is the value of a parabola fitted to the nearest runs with tricube weights (Cleveland, J. Am. Stat. Assoc.
    74, 829, 1979): unlike means of neighbours it follows slopes and curvature up to both ends.
    """
    count = min(len(x), max(10, round(_NEIGHBOURS * len(x))))
    mean, spread = np.empty(len(at)), np.empty(len(at))
    for k, place in enumerate(at):
        near = np.argpartition(np.abs(x - place), count - 1)[:count]
        away = x[near] - place
        weight = (1.0 - np.minimum(np.abs(away) / (1.001 * np.max(np.abs(away)) or 1.0), 1.0) ** 3) ** 3
        degree = min(2, len(np.unique(away)) - 1)
        rows = np.vander(away, degree + 1)
        line = np.linalg.lstsq(rows * np.sqrt(weight)[:, None], y[near] * np.sqrt(weight), rcond=None)[0]
        mean[k], spread[k] = line[-1], np.sqrt(np.average((y[near] - rows @ line) ** 2, weights=weight))
    return mean, spread


def _groups(other: Factor | None, response: Response) -> list[tuple[str, np.ndarray]]:
    """Return (label, runs) for each value of a second factor, or a single group if there is no second factor."""
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
    """Plot the means at the values of a grid, one line for each value of the other factor."""
    for k, (label, runs) in enumerate(_groups(other, response)):
        means = [(v, response.values[runs & (factor.values == v)]) for v in factor.levels]
        points = np.array([(v, part.mean()) for v, part in means if len(part)])
        if len(points):
            mark, colour = MARKS[k % len(MARKS)], COLOURS[k % len(COLOURS)]
            axes.plot(*points.T, f"{mark}-", color=colour, ms=3.5, lw=1.2, label=label or None)


def _means_of_texts(axes: Axes, factor: Factor, other: Factor | None, response: Response) -> None:
    """Plot the mean of a response for each text value of a factor, with one standard deviation."""
    groups = _groups(other, response)
    for k, (label, runs) in enumerate(groups):
        parts = [response.values[runs & (factor.values == level)] for level in factor.levels]
        x = np.array([j for j, part in enumerate(parts) if len(part)]) + 0.8 * ((k + 0.5) / len(groups) - 0.5)
        y, whisker = np.array([(part.mean(), part.std()) for part in parts if len(part)]).reshape(-1, 2).T
        style: dict[str, Any] = {"capsize": 2.5, "ecolor": INK, "elinewidth": 0.9, "label": label or None}
        axes.errorbar(x, y, whisker, fmt=MARKS[k % len(MARKS)], color=COLOURS[k % len(COLOURS)], ms=5, **style)


def scatter_figure(analysis: StudyAnalysis, pairs: Sequence[tuple[str, str]]) -> Figure:
    """Plot one quantity against another for the pairs of factors and responses that the study's file requests."""
    wide = min(len(pairs), 3)
    figure, grid = svg.panels([3.5] * len(pairs), wide)
    for axes, (x_name, y_name) in zip(grid, pairs, strict=True):
        x, y = analysis.runs.find(x_name), analysis.runs.find(y_name)
        _points(axes, x, y, analysis.runs.study.design.seed)
        axes.set(xlabel=x.label, ylabel=y.label)
        finish(axes, 5, 5)
        name_texts(axes, x, "x")
        name_texts(axes, y, "y")
    return figure


def _points(axes: Axes, x: Series, y: Series, seed: int) -> None:
    x_positions, y_positions = positions(x) + jitter(x, seed), positions(y) + jitter(y, seed + 1)
    shown = thinned(np.isfinite(x_positions) & np.isfinite(y_positions))
    axes.plot(x_positions[shown], y_positions[shown], ".", color=BLUE, ms=dot_size(len(shown)), alpha=0.7)


_BEST_TEXTS = {"min": "small is good", "max": "large is good"}


def pareto_figure(analysis: StudyAnalysis) -> Figure:
    """Plot for each requested pair all runs, the Pareto front and its knee."""
    figure, grid = svg.panels([3.9] * len(analysis.fronts), min(len(analysis.fronts), 2))
    for axes, front in zip(grid, analysis.fronts, strict=True):
        x, y = analysis.runs.find(front.spec.x), analysis.runs.find(front.spec.y)
        shown = thinned(front.ranks > 0, 1000)
        size = dot_size(len(shown))
        axes.plot(x.values[shown], y.values[shown], ".", color=GREY, ms=size, alpha=0.7, label="dominated runs")
        if len(front.runs):
            # nothing is known between two runs of the front, so it is drawn as steps
            axes.step(front.x, front.y, where="post", color=BLUE, lw=1.0)
            axes.plot(front.x, front.y, "o", color=BLUE, ms=5, label=f"front, {len(front.runs)} runs")
        if front.knee is not None:
            point = (front.x[front.knee], front.y[front.knee])
            label = f"knee, run {front.runs[front.knee]}"
            axes.plot(*point, "D", color=VERMILION, ms=8, mfc="none", mew=1.6, label=label)
        axes.set_xlabel(f"{x.label} ({_BEST_TEXTS[front.spec.best_x]})")
        axes.set_ylabel(f"{y.label} ({_BEST_TEXTS[front.spec.best_y]})")
        finish(axes)
        if np.any(front.ranks >= 0):
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.04), ncols=3)
    return figure


MOST_BARS = 10
"""Largest number of bars (factors) in one panel of a tornado or sensitivity figure."""


def with_tornado(analysis: StudyAnalysis) -> list[Response]:
    """Return the responses and reported sigmas that have at least one bar in the tornado figure."""
    return [r for r in analysis.runs.everything if analysis.effects[r.name] or analysis.linear[r.name] is not None]


def tornado_figure(analysis: StudyAnalysis) -> Figure:
    """Plot for each response its change over the range of each factor, the largest first, as bars."""
    responses = with_tornado(analysis)
    effects = [analysis.effects[r.name] or getattr(analysis.linear[r.name], "effects", ()) for r in responses]
    heights = [0.95 + 0.3 * max(min(len(bars), MOST_BARS), 2) for bars in effects]
    figure, grid = svg.panels(heights, min(2, len(heights)))
    for axes, response in zip(grid, responses, strict=True):
        (_swings if analysis.runs.sampled else _main_effects)(axes, analysis, response)
    return figure


def _swings(axes: Axes, analysis: StudyAnalysis, response: Response) -> None:
    model = analysis.linear[response.name]
    assert model is not None
    shown = model.effects[:MOST_BARS][::-1]
    y = np.arange(len(shown))
    values = np.array([e.swing.value for e in shown])
    texts = np.array([e.coefficient is None for e in shown])
    colours = [GREY if text else BLUE if v >= 0 else VERMILION for v, text in zip(values, texts, strict=True)]
    axes.barh(y, values, 0.66, color=colours)
    ends = [[e.swing.value if end is None else end for end in e.swing.interval] for e in shown]
    svg.interval_bars(axes, values, y, ends, "x", capsize=2.5)
    _name_bars(axes, [e.factor for e in shown], f"change of {response.label}")


def _main_effects(axes: Axes, analysis: StudyAnalysis, response: Response) -> None:
    """Plot bars from the smallest to the largest mean of a factor's values, relative to the mean of all runs."""
    shown = analysis.effects[response.name][:MOST_BARS][::-1]
    mean = float(np.mean(response.known))
    y = np.arange(len(shown))
    for position, effect in zip(y, shown, strict=True):
        low, high = float(effect.means.min()) - mean, float(effect.means.max()) - mean
        rising = effect.means[-1] >= effect.means[0]
        numeric = effect.levels.dtype.kind == "f"
        colour = GREY if not numeric else BLUE if rising else VERMILION
        axes.barh(position, high - low, 0.66, left=low, color=colour)
    of = f", {typeset(response.unit)}" if response.unit else ""
    _name_bars(axes, [e.factor for e in shown], f"mean of {response.name} − mean of all{of}")


def _name_bars(axes: Axes, names: Sequence[str], label: str) -> None:
    axes.axvline(0.0, color=INK, lw=0.8)
    axes.use_sticky_edges = False
    axes.set_yticks(np.arange(len(names)), [short(name) for name in names])
    axes.set_xlabel(label)
    axes.set_ylim(-0.7, max(len(names), 2) - 0.3)
    finish(axes, 5, None)
    axes.grid(False, axis="y")
