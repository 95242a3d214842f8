"""Residuals, recovered minus true, in units of the stated sigma."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from analysis.recovery import ESTIMATORS
from twin.report.numbers import FAR, tick_text
from twin.report.svg import BLUE, GREEN, GREY, LIGHT, ORANGE, VERMILION, look, new_figure, plain_axes, to_svg

MARKS = dict(
    zip(
        ESTIMATORS,
        (("s", ORANGE), ("^", VERMILION), ("D", GREEN), ("o", BLUE)),
        strict=True,
    )
)
"""Estimator -> marker and colour: told apart by shape as well as by colour."""


def residuals_svg(panels: dict[str, dict[str, dict[str, float | None]]], names: dict[str, str]) -> str:
    """Residuals in sigma.

    Args:
        panels: panel title -> row label -> estimator -> residual in sigma (None without noise).
        names: estimator -> its name for readers.
    """
    with look("residuals"):
        rows = [len(panel) for panel in panels.values()]
        figure = new_figure(1.0 + 0.36 * sum(rows) + 0.32 * len(rows))
        heights = [n + 0.4 for n in rows]
        all_axes = figure.subplots(len(rows), 1, squeeze=False, sharex=True, height_ratios=heights)[:, 0]
        largest = max(
            (abs(r) for panel in panels.values() for row in panel.values() for r in row.values() if r is not None),
            default=FAR,
        )
        for axes, (title, panel) in zip(all_axes, panels.items(), strict=True):
            _panel(axes, title, panel, names)
            axes.set_xscale("symlog", linthresh=FAR, linscale=1.0)
            axes.set_xlim(-2.5 * max(largest, 2.0 * FAR), 2.5 * max(largest, 2.0 * FAR))
            axes.xaxis.set_major_formatter(lambda value, _: tick_text(value))
            decades = [10.0**k for k in range(1, int(np.ceil(np.log10(max(largest, 10.0)))) + 1)]
            axes.set_xticks([*(-d for d in decades[::-1]), -FAR, 0.0, FAR, *decades], minor=False)
            axes.minorticks_off()
            axes.grid(axis="x", color=LIGHT, lw=0.6)
            axes.set_axisbelow(True)
        label = "(recovered \N{MINUS SIGN} true) / sigma        linear inside the band, logarithmic outside"
        all_axes[-1].set_xlabel(label)
        handles, labels = all_axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
        return to_svg(figure)


def _panel(axes: Axes, title: str, panel: dict[str, dict[str, float | None]], names: dict[str, str]) -> None:
    axes.axvspan(-FAR, FAR, color="#eef3f8", lw=0)
    axes.axvline(0.0, color=GREY, lw=0.8)
    place = {label: k for k, label in enumerate(panel)}
    for j, estimator in enumerate(MARKS):
        marker, colour = MARKS[estimator]
        points = [(r, place[label]) for label, row in panel.items() if (r := row.get(estimator)) is not None]
        offset = (j - 0.5 * (len(MARKS) - 1)) * 0.19
        x, y = [p[0] for p in points], [p[1] + offset for p in points]
        axes.plot(x, y, marker, color=colour, ms=5.5, mec="white", mew=0.5, ls="none", label=names[estimator])
    axes.set_yticks(list(place.values()), list(place))
    axes.set_ylim(len(place) - 0.5, -0.5)
    axes.set_title(title, loc="left", fontweight="bold")
    for k in range(1, len(place)):
        axes.axhline(k - 0.5, color=LIGHT, lw=0.6)
    axes.tick_params(axis="y", length=0)
    plain_axes(axes)
