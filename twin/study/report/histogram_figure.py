"""Distributions of responses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.report.svg import GREEN, INK, SKY, VERMILION
from twin.study.report.analysis import StudyAnalysis
from twin.study.report.panels import finish, panels
from twin.study.report.statistics import Description
from twin.study.report.study_runs import Response


def histogram_figure(found: StudyAnalysis, names: Sequence[str]) -> Figure:
    """A panel for each of the named responses."""
    things = [r for r in found.runs.responses if r.name in names]
    figure, grid = panels(len(things), min(len(things), 2), 3.0)
    for axes, response in zip(grid, things, strict=True):
        _histogram(axes, response, found.descriptions[response.name], found.runs.drawn)
    return figure


def _histogram(axes: Axes, response: Response, about: Description, drawn: bool) -> None:
    values = response.known
    axes.set(xlabel=response.label, ylabel="runs")
    if response.constant or about.mean is None or about.std is None:
        text = "no run has a number" if len(values) == 0 else f"all {len(values)} runs: {values[0]:.6g}"
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center")
        finish(axes, None, None)
        axes.set_xticks([])
        axes.set_yticks([])
        return
    edges = np.histogram_bin_edges(values, bins=_bin_count(values))
    axes.hist(values, bins=list(edges), color=SKY, edgecolor="white", linewidth=0.4)
    mean, std = about.mean.value, about.std.value
    axes.axvline(mean, color=INK, lw=1.3, label="mean")
    if drawn:
        for k, place in enumerate((mean - 3.0 * std, mean + 3.0 * std)):
            axes.axvline(place, color=VERMILION, lw=1.2, ls="--", label="mean ± 3σ" if k == 0 else None)
        normal = about.normality is None or about.normality.normal
        if not normal and about.tails is not None:
            for k, place in enumerate(about.tails):
                axes.axvline(place, color=GREEN, lw=1.4, ls=":", label="0.135% and 99.865%" if k == 0 else None)
        if normal and about.normality is not None:
            x = np.linspace(mean - 3.5 * std, mean + 3.5 * std, 200)
            bell = np.exp(-0.5 * ((x - mean) / std) ** 2) / (np.sqrt(2.0 * np.pi) * std)
            axes.plot(x, bell * len(values) * (edges[1] - edges[0]), color=GREEN, lw=1.1, label="normal distribution")
    finish(axes)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize=7.5, columnspacing=1.0)


def _bin_count(values: np.ndarray) -> int:
    """Freedman and Diaconis' rule within 5 and 50."""
    low, high = np.quantile(values, (0.25, 0.75))
    width = 2.0 * (high - low) / len(values) ** (1.0 / 3.0)
    return int(np.clip(np.ceil(np.ptp(values) / width), 5, 50)) if width > 0.0 else 10
