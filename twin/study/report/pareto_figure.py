"""Best compromises in a plane."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from twin.report.svg import BLUE, GREY, VERMILION
from twin.study.report.analysis import StudyAnalysis
from twin.study.report.panels import finish, panels, some

_WAYS = {"min": "small is good", "max": "large is good"}


def pareto_figure(found: StudyAnalysis) -> Figure:
    """A panel for each pair: all runs, the front, its knee."""
    figure, grid = panels(len(found.fronts), min(len(found.fronts), 2), 3.9)
    for axes, front in zip(grid, found.fronts, strict=True):
        x, y = found.runs.find(front.spec.x), found.runs.find(front.spec.y)
        shown = some(front.ranks > 0, 1000)
        axes.plot(x.values[shown], y.values[shown], ".", color=GREY, ms=3.5, alpha=0.6, label="dominated runs")
        if len(front.runs):
            # between two runs of the front nothing is known: only steps are sure
            axes.step(front.x, front.y, where="post", color=BLUE, lw=1.0)
            axes.plot(front.x, front.y, "o", color=BLUE, ms=5, label=f"front, {len(front.runs)} runs")
        if front.knee is not None:
            place = (front.x[front.knee], front.y[front.knee])
            label = f"knee, run {front.runs[front.knee]}"
            axes.plot(*place, "D", color=VERMILION, ms=8, mfc="none", mew=1.6, label=label)
        axes.set_xlabel(f"{x.label} ({_WAYS[front.spec.best_x]})")
        axes.set_ylabel(f"{y.label} ({_WAYS[front.spec.best_y]})")
        finish(axes)
        if np.any(front.ranks >= 0):
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.04), ncols=3)
    return figure
