"""Which factors move a response, and every pair of those that matter most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy import stats

from twin.run.svg import BLUE, GREEN, GREY, INK, LIGHT, SKY, VERMILION, new_figure, plain_axes
from twin.study.report.sensitivity_indices import Indices
from twin.study.report.study_analysis import StudyAnalysis
from twin.study.report.study_plots import finish, jitter, name_texts, positions, short, some
from twin.study.report.study_runs import Factor, Response, typeset

MOST_BARS = 10


def _columns(rows: Sequence[int], wide: int = 2) -> tuple[Figure, list[Axes]]:
    """Panels as high as their bars need."""
    wide = min(wide, len(rows))
    heights = [max(rows[k : k + wide]) for k in range(0, len(rows), wide)]
    inches = [0.95 + 0.3 * max(h, 2) for h in heights]
    figure = new_figure(sum(inches))
    grid = figure.subplots(len(inches), wide, squeeze=False, height_ratios=inches).ravel()
    for axes in grid[len(rows) :]:
        axes.set_axis_off()
    return figure, list(grid[: len(rows)])


def with_tornado(found: StudyAnalysis) -> list[Response]:
    """Responses and sigmas of which there is something to draw."""
    return [r for r in found.runs.everything if found.effects[r.name] or found.linear[r.name] is not None]


def tornado_figure(found: StudyAnalysis) -> Figure:
    """Swing of each response over each factor, the largest first."""
    things = with_tornado(found)
    rows = [min(len(found.effects[r.name]) or _effects(found, r.name), MOST_BARS) for r in things]
    figure, grid = _columns(rows)
    for axes, response in zip(grid, things, strict=True):
        if found.runs.sampled:
            _swings(axes, found, response)
        else:
            _main_effects(axes, found, response)
    return figure


def _effects(found: StudyAnalysis, name: str) -> int:
    model = found.linear[name]
    return len(model.effects) if model is not None else 0


def _swings(axes: Axes, found: StudyAnalysis, response: Response) -> None:
    model = found.linear[response.name]
    assert model is not None
    shown = model.effects[:MOST_BARS][::-1]
    y = np.arange(len(shown))
    values = np.array([e.swing.value for e in shown])
    texts = np.array([e.coefficient is None for e in shown])
    colours = [GREY if text else BLUE if v >= 0 else VERMILION for v, text in zip(values, texts, strict=True)]
    axes.barh(y, values, 0.66, color=colours)
    ends = np.array([[e.swing.value if end is None else end for end in e.swing.interval] for e in shown])
    axes.errorbar(values, y, xerr=np.abs(ends.T - values), fmt="none", ecolor=INK, elinewidth=1.0, capsize=2.5)
    _name_bars(axes, [e.factor for e in shown], f"change of {response.label}")


def _main_effects(axes: Axes, found: StudyAnalysis, response: Response) -> None:
    """From the smallest to the largest mean of a factor's values, about the mean of all."""
    shown = found.effects[response.name][:MOST_BARS][::-1]
    mean = float(np.mean(response.known))
    y = np.arange(len(shown))
    for place, effect in zip(y, shown, strict=True):
        low, high = float(effect.means.min()) - mean, float(effect.means.max()) - mean
        rising = effect.means[-1] >= effect.means[0]
        numeric = effect.levels.dtype.kind == "f"
        colour = GREY if not numeric else BLUE if rising else VERMILION
        axes.barh(place, high - low, 0.66, left=low, color=colour)
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


def with_indices(found: StudyAnalysis) -> list[Response]:
    """Responses and sigmas that have indices."""
    return [r for r in found.runs.everything if isinstance(found.indices.get(r.name), Indices)]


def indices_figure(found: StudyAnalysis) -> Figure:
    """First order and total index of each factor."""
    things = with_indices(found)
    parts = [found.indices[r.name] for r in things]
    rows = [min(2 * len(part.axes), 2 * MOST_BARS) for part in parts if isinstance(part, Indices)]
    figure, grid = _columns([int(0.7 * row) + 1 for row in rows])
    for axes, response, part in zip(grid, things, parts, strict=True):
        assert isinstance(part, Indices)
        shown = part.axes[:MOST_BARS][::-1]
        y = np.arange(len(shown))
        for shift, colour, label, estimates in (
            (0.19, BLUE, "first order", [index.first for index in shown]),
            (-0.19, SKY, "total", [index.total for index in shown]),
        ):
            values = np.array([e.value for e in estimates])
            axes.barh(y + shift, values, 0.36, color=colour, label=label)
            if part.method == "chaos":
                ends = np.array([e.interval for e in estimates], np.float64)
                error = np.abs(ends.T - values)
                axes.errorbar(values, y + shift, xerr=error, fmt="none", ecolor=INK, elinewidth=1.0, capsize=2.0)
        _name_bars(axes, [index.name for index in shown], f"share of the variance of {response.name}")
        axes.set_xlim(0.0, 1.08)
        axes.set_xticks([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
        axes.legend(loc="lower right")
    return figure


MOST_RESPONSES, MOST = 3, 6


def chosen(found: StudyAnalysis) -> list[Factor | Response]:
    """The first three responses that vary, and as many factors as have room, by their influence on these."""
    responses = [r for r in found.runs.responses if not r.constant][:MOST_RESPONSES]
    weight = {factor.name: 0.0 for factor in found.runs.factors}
    for response in responses:
        influence = found.influence(response.name)
        for name, value in influence.items():
            weight[name] = max(weight[name], value)
    factors = [factor for factor in found.runs.factors if len(factor.levels) > 1]
    best = sorted(factors, key=lambda factor: -weight[factor.name])[: MOST - len(responses)]
    return [*(factor for factor in found.runs.factors if factor in best), *responses]


def matrix_figure(found: StudyAnalysis) -> Figure:
    """Points below the diagonal, rank correlations above it, distributions on it."""
    things = chosen(found)
    n = len(things)
    figure = new_figure(min(1.65 * n + 0.6, 10.2), {"h_pad": 0.03, "w_pad": 0.03, "hspace": 0.02, "wspace": 0.02})
    grid = figure.subplots(n, n, squeeze=False)
    seed = found.runs.study.design.seed
    for i, row in enumerate(things):
        for j, column in enumerate(things):
            axes = grid[i, j]
            if j > i:
                _correlation(axes, column, row)
                continue
            if i == j:
                values = positions(row)
                count = len(row.levels) if isinstance(row, Factor) and len(row.levels) < 20 else 20
                axes.hist(values[np.isfinite(values)], bins=count, color=SKY, edgecolor="white", linewidth=0.3)
                axes.set_yticks([])
                plain_axes(axes)
                axes.xaxis.set_major_locator(MaxNLocator(3))
            else:
                x, y = positions(column) + jitter(column, seed), positions(row) + jitter(row, seed + 1)
                shown = some(np.isfinite(x) & np.isfinite(y), 300)
                axes.plot(x[shown], y[shown], ".", color=BLUE, ms=2.0, alpha=0.6)
                finish(axes, 3, 3)
                name_texts(axes, row, "y")
            name_texts(axes, column, "x")
            if i < n - 1:
                axes.tick_params(labelbottom=False)
                axes.xaxis.offsetText.set_visible(False)
            if j > 0:
                axes.tick_params(labelleft=False)
                axes.yaxis.offsetText.set_visible(False)
    for k, thing in enumerate(things):
        label = thing.label.replace(", ", ",\n")
        grid[n - 1, k].set_xlabel(label)
        grid[k, 0].set_ylabel(label)
    return figure


def _correlation(axes: Axes, x: Factor | Response, y: Factor | Response) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_color(LIGHT)
    if any(isinstance(thing, Factor) and not thing.numeric for thing in (x, y)):
        axes.set_axis_off()
        return
    good = np.isfinite(x.values) & np.isfinite(y.values)
    if good.sum() < 3 or np.ptp(x.values[good]) == 0.0 or np.ptp(y.values[good]) == 0.0:
        return
    rank = float(stats.spearmanr(x.values[good], y.values[good]).statistic) + 0.0
    strong = abs(rank) > 0.3
    text = f"{rank:+.2f}".replace("-", "\N{MINUS SIGN}")
    colour = INK if strong else GREY
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=colour, fontsize=9 + 4 * strong)
    edge = VERMILION if rank < 0 else GREEN
    if strong:
        axes.spines[:].set_color(edge)
        axes.spines[:].set_linewidth(0.6 + 1.4 * abs(rank))
