"""Every pair of the factors and responses that matter most."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy import stats

from twin.report.svg import BLUE, GREEN, GREY, INK, SKY, VERMILION, new_figure, plain_axes
from twin.study.report.analysis import StudyAnalysis
from twin.study.report.panels import finish, jitter, name_texts, positions, some
from twin.study.report.study_runs import Factor, Response

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
    axes.spines[:].set_color("#d9dde3")
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
