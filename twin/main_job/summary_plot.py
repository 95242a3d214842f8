"""``summary.png``: the result of a run in one picture, spots before and after and the recovered parameters."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.framework.artefact import FAR, Marked, Table
from twin.framework.report import sentence
from twin.framework.svg import AFTER, BEFORE, BLUE, GRAY, GREY, INK, LIGHT, VERMILION, look, to_png
from twin.main_job.assumptions import assumed
from twin.main_job.render_results import RenderRun
from twin.main_job.result_sections import result_tables
from twin.main_job.spot_plots import airy_radius, core_window, cross, mean_images, stretch
from twin.main_job.verdict import limited

WIDTH, DPI = 14.0, 100
"""Inches and dots per inch: 1400 px wide."""
NOTE, LONGEST_NOTE = 0.85, 150
"""Height of a note's line, in lines of the table, and characters that the width holds."""
FIRST = 0.22
"""Where the column of the truth ends, part of the width."""
REACH = 2.2
"""Half-width of the pictures in Airy radii around both centres."""


def summary_png(run: RenderRun) -> bytes:
    """The picture as PNG."""
    with look("summary"):
        return to_png(_draw(run), DPI)


def _draw(run: RenderRun) -> Figure:
    channels = run.experiment.path.channels
    columns = max(len(channels), 1)
    table = result_tables(run)[-1]
    lines, notes = 1 + len(table.bands) + len(table.rows), _notes(run)
    picture = WIDTH / columns
    heights = (2.0 * picture + 0.5, 0.27 * (lines + NOTE * len(notes)) + 0.27)
    figure = Figure(figsize=(WIDTH, sum(heights)), facecolor="white")
    top = heights[0] / sum(heights)
    before, after = mean_images(run)
    norm = stretch(before)
    positions = run.recovery.before[0], run.recovery.after[0]
    height = picture / sum(heights)
    windows = [core_window(b, a, REACH * airy_radius(run) / 0.75) for b, a in zip(*positions, strict=True)]
    half = max(window[2] for window in windows)  # one scale for all pictures
    for i, channel in enumerate(channels):
        row, column, _ = windows[i]
        for k, (image, when) in enumerate(((before[i], "before"), (after[i], "after"))):
            bottom = 1.0 - (k + 1) * height - 0.36 / sum(heights) + (0.02 * height)
            axes = figure.add_axes((i / columns + 0.004, bottom, 1.0 / columns - 0.008, 0.96 * height))
            axes.imshow(image, cmap=GRAY, norm=norm, interpolation="none")
            cross(axes, positions[0][i], BEFORE, 0.22 * half)
            if k:
                cross(axes, positions[1][i], AFTER, 0.22 * half)
            axes.set(xlim=(column - half, column + half), ylim=(row + half, row - half), xticks=[], yticks=[])
            axes.text(0.03, 0.03, when, color="white", transform=axes.transAxes, fontsize=12)
            if k:
                _scale_bar(axes, run, column, row, half)
            else:
                # many pictures are narrow
                text = "{} camera, {} spot" if columns <= 4 else "{}, {}"
                axes.set_title(text.format(channel.camera, channel.name), fontsize=13 if columns <= 4 else 10, pad=7)
    _table(figure, table, 1.0 - top - 0.1 / sum(heights), run, notes)
    return figure


def _notes(run: RenderRun) -> list[str]:
    """Lines below the table: on what sigma rests, and what the marks say."""
    limit = f" {sentence(limited(run))}" if limited(run) else ""
    texts = f"{assumed(run.reading)}.", f"± is one σ; ● within {FAR:g} σ of the truth, ▲ beyond.{limit}"
    return [line for text in texts for line in wrap(text, LONGEST_NOTE)]


def _scale_bar(axes: Axes, run: RenderRun, column: float, row: float, half: float) -> None:
    """Ten pixels, and how many micrometres they are."""
    y, x = row + 0.86 * half, column + 0.9 * half
    axes.plot([x - 10.0, x], [y, y], color="white", lw=2.5, solid_capstyle="butt")
    text = f"10 px = {1e7 * run.experiment.path.pitch:.4g} µm"
    axes.text(x, y - 0.05 * half, text, color="white", ha="right", va="bottom", fontsize=10)


def _table(figure: Figure, table: Table, top: float, run: RenderRun, notes: Sequence[str]) -> None:
    """Recovered against true, drawn as text on a grid of lines, with notes below."""
    axes = figure.add_axes((0.0, 0.0, 1.0, top), xlim=(0.0, 1.0))
    axes.set_axis_off()
    count = 1 + len(table.bands) + len(table.rows)
    axes.set_ylim(count + 0.35 + NOTE * len(notes), 0.0)
    estimators = list(run.estimators.values())
    # columns share the width that is left by the names and the truth
    step = (0.99 - FIRST) / len(estimators)
    edges = [FIRST, *(FIRST + step * (k + 1) for k in range(len(estimators)))]
    heads = ["true", *(estimator.title for estimator in estimators)]
    y = 0.6
    axes.text(0.01, y, f"{run.resolved.instrument.name}, {run.frames} frames", fontsize=12.5, va="center", color=GREY)
    for x, head in zip(edges, heads, strict=True):
        axes.text(x, y, head, fontsize=12.5, fontweight="bold", ha="right", va="center")
    for k, (name, true, *cells) in enumerate(table.rows):
        if k in table.bands:
            y += 1.0
            axes.axhline(y - 0.5, color=LIGHT, lw=1)
            axes.text(0.01, y, table.bands[k], fontsize=12.5, fontweight="bold", va="center")
        y += 1.0
        axes.text(0.02, y, str(name), fontsize=12.5, va="center")
        axes.text(edges[0], y, str(true), fontsize=12.5, ha="right", va="center", fontweight="bold")
        for x, cell in zip(edges[1:], cells, strict=False):
            assert isinstance(cell, Marked)
            axes.text(x - 0.013, y, cell, fontsize=12.5, ha="right", va="center", color=INK)
            mark, colour = ("▲", VERMILION) if cell.look == "far" else ("●", BLUE)
            axes.text(x, y, mark, fontsize=10, ha="right", va="center", color=colour)
    y = count + 0.7
    for line in notes:
        axes.text(0.01, y, line, fontsize=10.5, ha="left", va="center", color=GREY)
        y += NOTE
