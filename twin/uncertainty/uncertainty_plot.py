"""The figure of what limits a monitor: how much the measurement takes away, and whose motions make up the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.monitor.limits import Split
from twin.run.artefact import significant
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
    YELLOW,
    look,
    new_figure,
    plain_axes,
    shared_legend,
    to_svg,
)
from twin.uncertainty.monitor_limits import BEST, MonitorLimits
from twin.uncertainty.words import part_of, quantity_text, unit_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, YELLOW)
"""Of the bodies that make up most; the others are grey."""
MARKS = "os^vDP*X"


def limits_svg(limits: MonitorLimits) -> str:
    """Left, of every quantity the standard deviations of all estimators over that before the measurement; right, the
    variance that the posterior leaves by bodies.
    """
    with look("limits"):
        return to_svg(_figure(limits))


def _figure(limits: MonitorLimits) -> Figure:
    count = len(limits.quantities)
    figure = new_figure(1.7 + 0.3 * count)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.0, 1.15))
    _reduced(left, limits)
    _by_body(right, limits)
    for axes in (left, right):
        plain_axes(axes)
        groups = [quantity.group for quantity in limits.quantities]
        for q in range(1, count):
            if groups[q] != groups[q - 1]:
                axes.axhline(q - 0.5, color=LIGHT, lw=0.8, zorder=0)
    left.set_yticks(range(count), [quantity_text(quantity) for quantity in limits.quantities])
    left.set_ylim(count - 0.5, -0.5)
    right.tick_params(left=False)
    left.set_title("How much the measurement takes away")
    right.set_title("Whose motions make up the rest")
    shared_legend(figure, left, "lower left", 3, columnspacing=1.2)
    shared_legend(figure, right, "lower right", 4, columnspacing=1.2)
    return figure


def _reduced(axes: Axes, limits: MonitorLimits) -> None:
    """Ratios of standard deviations, with both in their units for the posterior."""
    y = np.arange(len(limits.quantities))
    before = limits.splits[BEST].sigma_before
    for k, (name, split) in enumerate(limits.splits.items()):
        best = name == BEST
        axes.plot(
            split.sigma / before,
            y,
            MARKS[k % len(MARKS)],
            ms=6.5 if best else 4.5,
            color=VERMILION if best else GREY,
            mfc=VERMILION if best else "none",
            zorder=3 if best else 2,
            label=name,
        )
    axes.axvline(1.0, color=INK, lw=0.8, ls=":")
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low, max(high, 1.2) * (max(high, 1.2) / low) ** 0.62)
    for q, quantity in enumerate(limits.quantities):
        ends = [significant(value, 2) for value in (before[q], limits.splits[BEST].sigma[q])]
        text = f"{ends[0]} → {ends[1]} {unit_text(quantity)}"
        axes.annotate(
            text, (1.0, q), xycoords=("axes fraction", "data"), ha="right", va="center", fontsize=8, color=INK
        )
    axes.set_xlabel("standard deviation after over before; numbers: before → after, posterior")


def _by_body(axes: Axes, limits: MonitorLimits) -> None:
    """Stacked shares of the posterior's variance, bodies of both cameras together; negative ones to the left."""
    split = limits.splits[BEST]
    total = split.sigma**2
    parts = {
        name: value / total
        for name, value in Split.by(split.after, [part_of(body) for body in limits.stated.bodies]).items()
    }
    order = sorted(parts, key=lambda name: -float(np.sum(np.abs(parts[name]))))
    named, others = order[: len(PALETTE)], order[len(PALETTE) :]
    bars = [(name, parts[name], colour) for name, colour in zip(named, PALETTE, strict=False)]
    if others:
        bars.append(("other bodies", np.asarray(sum(parts[name] for name in others)), GREY))
    bars.append(("noise of the images", split.noise / total, INK))
    y = np.arange(len(total))
    up, down = np.zeros(len(total)), np.zeros(len(total))
    for name, share, colour in bars:
        axes.barh(
            y,
            100.0 * share,
            left=100.0 * np.where(share >= 0.0, up, down),
            height=0.68,
            color=colour,
            label=name.replace("_", " "),
        )
        up, down = up + np.maximum(share, 0.0), down + np.minimum(share, 0.0)
    axes.set_xlabel("share of the variance that the posterior leaves, %")
    if np.any(down < -1e-3):
        axes.axvline(0.0, color=INK, lw=0.8)
