"""Which factors move a response: swings and Sobol's indices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.report.svg import BLUE, GREY, INK, SKY, VERMILION, new_figure
from twin.study.report.analysis import StudyAnalysis
from twin.study.report.panels import finish, short
from twin.study.report.sensitivity_indices import Indices
from twin.study.report.study_runs import Response, typeset

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
        if found.runs.drawn:
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
