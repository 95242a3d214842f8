"""Figures of spots, residuals and motions, and ``summary.png``, which shows spots and recovered parameters of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import cycle
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm, Normalize, SymLogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from analysis.arrays import ARCSEC
from analysis.monitor import parameters
from analysis.monitor.estimators import ESTIMATORS
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from scenes.specs.instrument import BASE
from twin.framework import svg
from twin.framework.artefact import FAR, MINUS, SAME, Marked, Table, residual, significant, tick_text, unit_for_reports
from twin.framework.frame_store import mean_of
from twin.framework.report import sentence
from twin.main_job.render_results import RenderRun
from twin.main_job.result_sections import part_title, result_tables
from twin.main_job.systematics import assumed
from twin.main_job.verdict import limited
from twin.monitor.crosstalk import CameraCrosstalk
from twin.monitor.reading_table import Reading
from twin.monitor.time_series import TimeSeries

PEAK_TO_LINEAR = 150.0
"""Ratio of the peak to the level up to which the asinh stretch of images is linear."""
_LEGEND: dict[str, Any] = {"frameon": True, "facecolor": "black", "edgecolor": "none", "framealpha": 0.7}
_LEAST_CORE = 7.0
"""Smallest half-width, in pixels, of the image section that shows the core of a spot."""


def mean_images(run: RenderRun) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean frame of every channel before and after, in DN, each (C, rows, columns) for C channels."""
    return mean_of(run.before), mean_of(run.after)


def asinh_scale(images: np.ndarray) -> Normalize:
    """Return the asinh stretch of grey values that several images have in common, from background to peak."""
    low, high = float(np.percentile(images, 5)), float(images.max())
    high = max(high, low + 1.0)
    return AsinhNorm(linear_width=(high - low) / PEAK_TO_LINEAR, vmin=low, vmax=high)


def cross(axes: Axes, at: np.ndarray, colour: str, size: float, label: str | None = None) -> None:
    """Draw a cross with an open middle at a pixel position, so that the core of the spot stays visible."""
    (row, column), inner = at, 0.3 * size
    xs, ys = [], []
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        xs += [column + dx * inner, column + dx * size, np.nan]
        ys += [row + dy * inner, row + dy * size, np.nan]
    axes.plot(xs, ys, color=colour, lw=1.3, solid_capstyle="butt", label=label)


def core_window(before: np.ndarray, after: np.ndarray, radius: float) -> tuple[float, float, float]:
    """Return the centre (row, column) and half-width of a square that contains both spot centres, in pixels."""
    centre = 0.5 * (before + after)
    half = max(_LEAST_CORE, 0.5 * float(np.max(np.abs(after - before))) + 0.75 * radius)
    return float(centre[0]), float(centre[1]), half


def airy_radius(run: RenderRun) -> float:
    """Return the radius, in pixels, of the first dark ring of a spot, whose light the prism's return face limits."""
    path = run.experiment.path
    camera = next(iter(run.experiment.instrument.cameras.values()))
    focal = float(camera.first_order.principal_distance[0])
    return float(1.2197 * path.wavelength * focal / (2.0 * float(np.min(path.face_radius))) / path.pitch)


def spots_svg(run: RenderRun, camera: str) -> str:
    """Draw the spots of one camera, a row for each channel."""
    with svg.look(f"spots-{camera}"):
        return svg.to_svg(_draw(run, camera))


def _draw(run: RenderRun, camera: str) -> Figure:
    channels = [i for i, c in enumerate(run.experiment.path.channels) if c.camera == camera]
    before, after = mean_images(run)
    norm = asinh_scale(np.stack([before[channels], after[channels]]))
    difference = after - before
    largest = max(float(np.abs(difference[channels]).max()), 1.0)
    figure = svg.new_figure(0.5 + 2.62 * len(channels), {"w_pad": 0.03, "h_pad": 0.03, "wspace": 0.01, "hspace": 0.02})
    grid = figure.subplots(len(channels), 4, squeeze=False)
    positions = run.recovery.before[0], run.recovery.after[0]
    radius = airy_radius(run)
    shown = map_of = None
    for line, i in enumerate(channels):
        start, end = positions[0][i], positions[1][i]
        moved = end - start
        row = grid[line]
        for axes, image in ((row[0], before[i]), (row[1], after[i])):
            shown = axes.imshow(image, cmap=svg.GRAY, norm=norm, interpolation="none")
        size = 0.11 * before.shape[-1]
        cross(row[0], start, svg.BEFORE, size)
        cross(row[1], end, svg.AFTER, size)
        row[2].imshow(after[i], cmap=svg.GRAY, norm=norm, interpolation="none")
        y, x, half = core_window(start, end, radius)
        cross(row[2], start, svg.BEFORE, 0.3 * half, "before")
        cross(row[2], end, svg.AFTER, 0.3 * half, "after")
        row[2].xaxis.set_major_locator(MaxNLocator(5, integer=True))
        row[2].yaxis.set_major_locator(MaxNLocator(5, integer=True))
        row[2].set(xlim=(x - half, x + half), ylim=(y + half, y - half))
        map_of = svg.signed_map(row[3], difference[i], largest, interpolation="none")
        channel = run.experiment.path.channels[i].name
        row[0].set_ylabel(f"{channel} channel\nrow [px]")
        title = f"moved {moved[0]:+.3f} px in row, {moved[1]:+.3f} px in column".replace("-", "\N{MINUS SIGN}")
        row[2].set_title(title, fontsize=8.5)
        if line == 0:
            row[0].set_title("before")
            row[1].set_title("after")
            row[3].set_title("after \N{MINUS SIGN} before")
            row[2].legend(loc="upper left", labelcolor="white", handlelength=1.2, borderaxespad=0.3, **_LEGEND)
        for axes in row[[1, 3]]:
            axes.tick_params(labelleft=False)
        for axes in row:
            if line == len(channels) - 1:
                axes.set_xlabel("column [px]")
            elif axes is not row[2]:
                axes.tick_params(labelbottom=False)
    assert shown is not None
    assert map_of is not None
    bars: dict[str, Any] = {"orientation": "horizontal", "fraction": 0.05, "pad": 0.01}
    bar = figure.colorbar(
        shown, ax=list(grid[:, :3].ravel()), label="mean frame [DN], asinh stretch", aspect=40, **bars
    )
    ticks = _dn_ticks(norm)
    bar.set_ticks(ticks, labels=[f"{t:.0f}" for t in ticks])
    bar.minorticks_off()
    figure.colorbar(map_of, ax=list(grid[:, 3]), label="difference [DN]", aspect=13, ticks=MaxNLocator(4), **bars)
    for axes in grid.ravel():
        axes.tick_params(length=2.5, color=svg.INK)
    return figure


def _dn_ticks(norm: Normalize) -> list[float]:
    """Return round grey values (DN) within the range of the stretch for the colour bar, at most three per decade."""
    assert norm.vmin is not None
    assert norm.vmax is not None
    candidates = [float(m * 10**k) for k in range(1, 8) for m in (1, 2, 5)]
    span = norm.vmax - norm.vmin
    return [t for t in candidates if norm.vmin + 0.004 * span <= t <= norm.vmax]


_MARKS = (
    *(("s", svg.ORANGE), ("^", svg.VERMILION), ("D", svg.GREEN), ("o", svg.BLUE)),
    *(("v", svg.PURPLE), ("P", svg.SKY), ("X", svg.GREY), ("*", svg.INK)),
)


def marks(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return estimator -> (marker, colour) for plots; both differ for up to eight estimators.

    Parameters
    ----------
    names : Iterable[str]
        Estimators in a figure; the marker of an estimator does not depend on the others.
    """
    all_marks = dict(zip(ESTIMATORS, cycle(_MARKS), strict=False))
    return {name: all_marks[name] for name in names}


def residuals_svg(run: RenderRun) -> str:
    """Draw the errors of all estimators divided by their sigmas, a panel for each camera, the angle and the ground."""
    names = {name: estimator.title for name, estimator in run.estimators.items()}
    panels: dict[str, dict[str, dict[str, float | None]]] = {}
    for same in run.reading.table.by_change():
        panel = panels.setdefault(part_title(run, same[0]), {})
        panel[same[0].parameter.symbol] = {
            reading.estimator: residual(reading.error, reading.sigma) for reading in same
        }
    with svg.look("residuals"):
        rows = [len(panel) for panel in panels.values()]
        figure = svg.new_figure(1.0 + 0.36 * sum(rows) + 0.32 * len(rows))
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
            axes.grid(axis="x", color=svg.LIGHT, lw=0.6)
            axes.set_axisbelow(True)
        label = "(recovered \N{MINUS SIGN} true) / sigma        linear inside the band, logarithmic outside"
        all_axes[-1].set_xlabel(label)
        svg.shared_legend(figure, all_axes[0])
        return svg.to_svg(figure)


def _panel(axes: Axes, title: str, panel: dict[str, dict[str, float | None]], names: dict[str, str]) -> None:
    axes.axvspan(-FAR, FAR, color=svg.SHADE, lw=0)
    axes.axvline(0.0, color=svg.GREY, lw=0.8)
    row_of = {label: k for k, label in enumerate(panel)}
    marks_by_estimator = marks(names)
    for j, (estimator, (marker, colour)) in enumerate(marks_by_estimator.items()):
        points = [(r, row_of[label]) for label, row in panel.items() if (r := row.get(estimator)) is not None]
        offset = (j - 0.5 * (len(marks_by_estimator) - 1)) * min(0.19, 0.76 / len(marks_by_estimator))
        x, y = [p[0] for p in points], [p[1] + offset for p in points]
        axes.plot(x, y, marker, color=colour, ms=5.5, mec="white", mew=0.5, ls="none", label=names[estimator])
    axes.set_yticks(list(row_of.values()), list(row_of))
    axes.set_ylim(len(row_of) - 0.5, -0.5)
    axes.set_title(title, loc="left", fontweight="bold")
    for k in range(1, len(row_of)):
        axes.axhline(k - 0.5, color=svg.LIGHT, lw=0.6)
    axes.tick_params(axis="y", length=0)
    svg.plain_axes(axes)


ROW = 0.168
"""Height of one motion's row in the map of spot shifts, in inches."""
_DECADES = 3
"""Number of decades below the largest number that the colour scale shows logarithmically."""
_MOST_LEVEL = 4
"""Largest number of column names that are written horizontally side by side; more are rotated."""
_STRONG = 0.55
"""Colour intensity of a cell, from 0 to 1, above which the number in it is written in white."""


def motion_map_svg(run: RenderRun) -> str:
    """Draw the spot shifts in micrometres per unit of motion as a coloured table.

    Each motion has a row, each camera a panel.
    """
    pitch = 1e6 * run.experiment.path.pitch
    tables = list(run.crosstalk.items())
    largest = max(float(np.abs(table.spot_shift).max()) for _, table in tables) * pitch
    norm = SymLogNorm(largest * 10.0**-_DECADES, linscale=0.4, vmin=-largest, vmax=largest)
    rows = max(len(table.motions) for _, table in tables)
    labels = [_labels(table) for _, table in tables]
    with svg.look("motions"):
        figure = svg.new_figure(1.1 + ROW * rows, {"w_pad": 0.03, "h_pad": 0.03, "wspace": 0.01})
        panels = figure.subplots(1, len(tables), squeeze=False)[0]
        for k, (axes, (name, table)) in enumerate(zip(panels, tables, strict=True)):
            _motion_panel(axes, pitch * table.spot_shift.T, table.coordinates, norm)
            axes.set_yticks(range(len(table.motions)), labels[k])
            # labelled once where all cameras have the same motions
            axes.tick_params(labelleft=k == 0 or labels[k] != labels[0])
            axes.set_title(f"Camera {name}", fontweight="bold", pad=4)
        return svg.to_svg(figure)


def _labels(table: CameraCrosstalk) -> list[str]:
    return [f"{motion.label}, 1 {unit_for_reports(motion.unit)}" for motion in table.motions]


def _motion_panel(axes: Axes, values: np.ndarray, names: Sequence[str], norm: SymLogNorm) -> None:
    axes.imshow(values, cmap=svg.DIVERGING, norm=norm, aspect="auto", interpolation="nearest")
    axes.xaxis.set_ticks_position("top")
    # many labels are written vertically
    rotation = 90.0 if len(names) > _MOST_LEVEL else 0.0
    axes.set_xticks(range(values.shape[1]), [f"{name} [µm]" for name in names], rotation=rotation)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    deep = np.abs(np.asarray(norm(values)) - 0.5) * 2.0
    for (row, column), value in np.ndenumerate(values):
        # on the colours of the map in the dark, too, where INK would become light
        colour = "white" if deep[row, column] > _STRONG else "black"
        text = significant(float(value), 2, floor=SAME)
        # the text is inside its panel and must not affect the layout
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=colour, in_layout=False)


GLANCE = 5.9
"""Width of the figure beside the main table of the page, in inches."""


def glance_svg(run: RenderRun) -> str:
    """Draw the cores of all spots before and after with their shifts, a column for each channel."""
    with svg.look("glance"):
        channels = run.experiment.path.channels
        before, after = mean_images(run)
        norm = asinh_scale(before)
        starts, ends = run.recovery.before[0], run.recovery.after[0]
        windows, half = _windows(run)
        across = min(max(len(channels), 1), 4)
        lines = -(-len(channels) // across)
        figure = svg.new_figure(lines * (2.0 * GLANCE / across + 0.82), {"w_pad": 0.02, "h_pad": 0.02, "wspace": 0.01})
        figure.set_figwidth(GLANCE)
        grid = figure.subplots(2 * lines, across, squeeze=False)
        for axes in grid.ravel():
            axes.set_axis_off()
        for i, channel in enumerate(channels):
            row, column, _ = windows[i]
            for k, (image, when) in enumerate(((before[i], "before"), (after[i], "after"))):
                axes = grid[2 * (i // across) + k, i % across]
                axes.set_axis_on()
                axes.set_anchor("NS"[k == 0])
                _core(axes, image, norm, (row, column, half), when)
                cross(axes, starts[i], svg.BEFORE, 0.22 * half)
            cross(axes, ends[i], svg.AFTER, 0.22 * half)
            _scale_bar(axes, run, column, row, half)
            moved = ends[i] - starts[i]
            text = f"row {moved[0]:+.3f} px\ncolumn {moved[1]:+.3f} px".replace("-", MINUS)
            axes.set_xlabel(text, fontsize=9.5)
            grid[2 * (i // across), i % across].set_title(f"{channel.camera}\n{channel.name}", fontsize=9.5)
        return svg.to_svg(figure)


def _windows(run: RenderRun) -> tuple[list[tuple[float, float, float]], float]:
    """Return the window on the core of each channel, and the half-width that all pictures share, in pixels."""
    radius = MARGIN * airy_radius(run) / 0.75
    windows = [core_window(*ends, radius) for ends in zip(run.recovery.before[0], run.recovery.after[0], strict=True)]
    return windows, max((window[2] for window in windows), default=1.0)


def _core(axes: Axes, image: np.ndarray, norm: Normalize, window: tuple[float, float, float], when: str) -> None:
    """Draw the part of a frame in a window (centre and half-width, pixels), labelled with its time."""
    row, column, half = window
    first = [max(int(np.floor(centre - half)), 0) for centre in (row, column)]
    last = [int(np.ceil(centre + half)) + 1 for centre in (row, column)]
    part = image[first[0] : last[0], first[1] : last[1]]
    extent = (first[1] - 0.5, first[1] + part.shape[1] - 0.5, first[0] + part.shape[0] - 0.5, first[0] - 0.5)
    axes.imshow(part, cmap=svg.GRAY, norm=norm, interpolation="none", extent=extent)
    axes.set(xlim=(column - half, column + half), ylim=(row + half, row - half), xticks=[], yticks=[])
    axes.text(0.03, 0.97, when, color="white", transform=axes.transAxes, fontsize=9.5, va="top")


WIDTH, DPI = 14.0, 100
"""Width of the picture in inches, and dots per inch: 1400 px wide."""
NOTE, LONGEST_NOTE = 0.85, 150
"""Height of a line of notes below the table, in heights of a table row, and number of characters per line."""
FIRST = 0.22
"""Right edge of the column of true values, as a fraction of the picture's width."""
MARGIN = 2.2
"""Margin of the spot images around the two spot centres (before and after), in Airy radii."""


def summary_png(run: RenderRun) -> bytes:
    """Return the picture that summarises a run, its spots and recovered changes, as PNG."""
    with svg.look("summary"):
        return svg.to_png(_drawn_summary(run), DPI)


def _drawn_summary(run: RenderRun) -> Figure:
    channels = run.experiment.path.channels
    columns = max(len(channels), 1)
    table = result_tables(run)[-1]
    lines, notes = 1 + len(table.bands) + len(table.rows), _notes(run)
    picture = WIDTH / columns
    heights = (2.0 * picture + 0.5, 0.27 * (lines + NOTE * len(notes)) + 0.27)
    figure = Figure(figsize=(WIDTH, sum(heights)), facecolor="white")
    top = heights[0] / sum(heights)
    before, after = mean_images(run)
    norm = asinh_scale(before)
    positions = run.recovery.before[0], run.recovery.after[0]
    height = picture / sum(heights)
    windows, half = _windows(run)
    for i, channel in enumerate(channels):
        row, column, _ = windows[i]
        for k, (image, when) in enumerate(((before[i], "before"), (after[i], "after"))):
            bottom = 1.0 - (k + 1) * height - 0.36 / sum(heights) + (0.02 * height)
            axes = figure.add_axes((i / columns + 0.004, bottom, 1.0 / columns - 0.008, 0.96 * height))
            axes.imshow(image, cmap=svg.GRAY, norm=norm, interpolation="none")
            cross(axes, positions[0][i], svg.BEFORE, 0.22 * half)
            if k:
                cross(axes, positions[1][i], svg.AFTER, 0.22 * half)
            axes.set(xlim=(column - half, column + half), ylim=(row + half, row - half), xticks=[], yticks=[])
            axes.text(0.03, 0.03, when, color="white", transform=axes.transAxes, fontsize=12)
            if k:
                _scale_bar(axes, run, column, row, half)
            else:
                # with many pictures each is narrow
                text = "{} camera, {} spot" if columns <= 4 else "{}, {}"
                axes.set_title(text.format(channel.camera, channel.name), fontsize=13 if columns <= 4 else 10, pad=7)
    _table(figure, table, 1.0 - top - 0.1 / sum(heights), run, notes)
    return figure


def _notes(run: RenderRun) -> list[str]:
    """Return the lines below the summary's table: what sigma includes, and what the signs in the table mean."""
    limit = f" {sentence(limited(run))}" if limited(run) else ""
    texts = f"{assumed(run.reading)}.", f"± is one σ; ● within {FAR:g} σ of the truth, ▲ beyond.{limit}"
    return [line for text in texts for line in wrap(text, LONGEST_NOTE)]


def _scale_bar(axes: Axes, run: RenderRun, column: float, row: float, half: float) -> None:
    """Draw a bar of ten pixels, labelled with its length in micrometres."""
    y, x = row + 0.86 * half, column + 0.9 * half
    axes.plot([x - 10.0, x], [y, y], color="white", lw=2.5, solid_capstyle="butt")
    text = f"10 px = {1e7 * run.experiment.path.pitch:.4g} µm"
    axes.text(x, y - 0.05 * half, text, color="white", ha="right", va="bottom", fontsize=10)


def _table(figure: Figure, table: Table, top: float, run: RenderRun, notes: Sequence[str]) -> None:
    """Draw the table of recovered and true changes into the summary picture, with notes below."""
    axes = figure.add_axes((0.0, 0.0, 1.0, top), xlim=(0.0, 1.0))
    axes.set_axis_off()
    count = 1 + len(table.bands) + len(table.rows)
    axes.set_ylim(count + 0.35 + NOTE * len(notes), 0.0)
    estimators = list(run.estimators.values())
    # columns divide the width beside the names and the true values
    step = (0.99 - FIRST) / len(estimators)
    edges = [FIRST, *(FIRST + step * (k + 1) for k in range(len(estimators)))]
    heads = ["true", *(estimator.title for estimator in estimators)]
    y = 0.6
    axes.text(
        0.01, y, f"{run.resolved.instrument.name}, {run.frames} frames", fontsize=12.5, va="center", color=svg.GREY
    )
    for x, head in zip(edges, heads, strict=True):
        axes.text(x, y, head, fontsize=12.5, fontweight="bold", ha="right", va="center")
    for k, (name, true, *cells) in enumerate(table.rows):
        if k in table.bands:
            y += 1.0
            axes.axhline(y - 0.5, color=svg.LIGHT, lw=1)
            axes.text(0.01, y, table.bands[k], fontsize=12.5, fontweight="bold", va="center")
        y += 1.0
        axes.text(0.02, y, str(name), fontsize=12.5, va="center")
        axes.text(edges[0], y, str(true), fontsize=12.5, ha="right", va="center", fontweight="bold")
        for x, cell in zip(edges[1:], cells, strict=False):
            assert isinstance(cell, Marked)
            axes.text(x - 0.013, y, cell, fontsize=12.5, ha="right", va="center", color=svg.INK)
            mark, colour = ("▲", svg.VERMILION) if cell.look == "far" else ("●", svg.BLUE)
            axes.text(x, y, mark, fontsize=10, ha="right", va="center", color=colour)
    y = count + 0.7
    for line in notes:
        axes.text(0.01, y, line, fontsize=10.5, ha="left", va="center", color=svg.GREY)
        y += NOTE


COLOURS = (svg.BLUE, svg.VERMILION, svg.GREEN, svg.ORANGE, svg.SKY, svg.PURPLE, svg.INK, svg.GREY)
"""Colours of the curves, one per body; after the last, they repeat with the next line style."""
STYLES = ("-", "--", ":")
"""Line styles: the first for the first bodies, the others for bodies whose colour is already in use."""
_BESIDE = 0.12
"""Horizontal distance between the markers of two estimators at the same time, as a fraction of the time step."""
UNITS = ((2.0 * 86400.0, 86400.0, "d"), (6.0 * 3600.0, 3600.0, "h"), (180.0, 60.0, "min"), (0.0, 1.0, "s"))
"""Time units of the axis: (shortest duration of a series drawn in the unit, in seconds; the unit in seconds; its name).
"""


def time_unit(times: np.ndarray) -> tuple[float, str]:
    """Return a unit that suits a time series' duration, in seconds, and its name.

    Parameters
    ----------
    times : (T,) ndarray
        The T times of the series, in seconds, ascending.
    """
    span = float(times[-1] - times[0])
    return next((size, unit) for least, size, unit in UNITS if span >= least)


def _time_axis(series: TimeSeries) -> tuple[np.ndarray, str]:
    """Return the times of a series in a unit that suits its duration, and the axis label."""
    size, unit = time_unit(series.times)
    return series.times / size, f"time [{unit}]"


def temperatures_svg(series: TimeSeries) -> str:
    """Draw the temperatures and motions over time that the job specifies.

    Panels show the change at the origin and the gradient along each axis of every body's temperature, and below them
    rotation and shift.
    """
    with svg.look("temperatures"):
        time, label = _time_axis(series)
        nodes = list(dict.fromkeys((*series.temperatures, *series.motions)))
        looks = {
            path: {"color": COLOURS[k % len(COLOURS)], "ls": STYLES[k // len(COLOURS) % len(STYLES)], "lw": 1.4}
            for k, path in enumerate(nodes)
        }
        rows = 2 * bool(series.temperatures) + bool(series.motions)
        figure = svg.new_figure(0.6 + 1.75 * rows + 0.2 * -(-len(nodes) // 3))
        panels = figure.subplots(rows, 2, sharex=True, squeeze=False)
        titles: list[str] = []
        if series.temperatures:
            panels[0, 1].sharey(panels[1, 0])
            panels[1, 1].sharey(panels[1, 0])
            titles += ["change at the origin [K]", *(f"gradient along {axis} [mK/m]" for axis in "XYZ")]
        for path, fields in series.temperatures.items():
            change = np.array([[field.change] for field in fields])
            values = np.concatenate([change, 1e3 * np.array([field.gradient for field in fields])], axis=1)
            for axes, value in zip(panels.flat, values.T, strict=False):
                axes.plot(time, value, **looks[path])
        if series.motions:
            titles += ["rotation [arcsec]", "shift [µm]"]
        for path, motions in series.motions.items():
            rotations = np.array([motion.rotate for motion in motions]) / ARCSEC
            shifts = 1e6 * np.array([motion.shift for motion in motions])
            for axes, values in zip(panels[-1], (rotations, shifts), strict=True):
                for axis in np.flatnonzero(values.any(axis=0)):
                    axes.plot(time, values[:, axis], **looks[path])
                    text_position = {"xytext": (3, 0), "textcoords": "offset points", "va": "center", "fontsize": 8.0}
                    axes.annotate(
                        "XYZ"[axis], (time[-1], values[-1, axis]), color=looks[path]["color"], **text_position
                    )
        for axes, title in zip(panels.flat, titles, strict=True):
            _frame(axes, series, time)
            axes.set_title(title, loc="left")
        for axes in panels[-1]:
            axes.set_xlabel(label)
        handles = [panels[0, 0].plot([], [], label=path.removeprefix(f"{BASE}/"), **looks[path])[0] for path in nodes]
        figure.legend(handles=handles, loc="outside upper center", ncols=3)
        return svg.to_svg(figure)


def parameters_svg(series: TimeSeries, names: dict[str, str]) -> str:
    """Draw true parameters as lines and estimates as markers, camera by camera, and the angle between two cameras.

    Parameters
    ----------
    series : TimeSeries
        Time series to draw.
    names : dict of str to str
        Estimator -> its title.
    """
    time, _ = _time_axis(series)
    return _changes_svg(series, "course", 1.5, lambda axes, same: _course_panel(axes, series, time, same, names))


def smoothed_svg(series: TimeSeries) -> str:
    """Draw errors of the smoothed changes with their total sigma, at the times of the series and between them.

    The band of sigma narrows at each measurement and widens between two. Errors are known only at the measured times.

    Parameters
    ----------
    series : TimeSeries
        Time series with smoothed changes.
    """
    smoothed = series.smoothed
    assert smoothed is not None
    size, _ = time_unit(series.times)
    times = np.append(series.times, smoothed.times)
    order = np.argsort(times)

    def panel(axes: Axes, rows: list[Reading]) -> None:
        reading = rows[0]
        at, between = (
            part.row(reading.group, reading.parameter.key, "smoothed") for part in (smoothed.changes, smoothed.between)
        )
        sigma = np.append(at.sigma, between.sigma)[order]
        time = times[order] / size
        _frame(axes, series, series.times / size)
        axes.fill_between(time, -2.0 * sigma, 2.0 * sigma, color=svg.SKY, alpha=0.25, lw=0, label="2σ, smoothed")
        axes.fill_between(time, -sigma, sigma, color=svg.SKY, alpha=0.45, lw=0, label="σ, smoothed")
        axes.plot(series.times / size, at.value - reading.true, "o", color=svg.INK, ms=3.0, label="smoothed − true")

    return _changes_svg(series, "smoothed", 1.3, panel, ground=True)


def _changes_svg(
    series: TimeSeries, name: str, height: float, panel: Callable[[Axes, list[Reading]], None], ground: bool = False
) -> str:
    """Draw a panel for each change: cameras side by side, below them the angle between them.

    With ``ground``, the height of points on the ground follows.
    """
    with svg.look(name):
        groups: dict[str, list[list[Reading]]] = {}
        for same in series.readings.by_change():
            groups.setdefault(same[0].group, []).append(same)
        cameras = [group for group in groups if group not in (ANGLE_GROUP, GROUND_GROUP)]
        rows, wide = len(parameters.CAMERA_PARAMETERS) + (ANGLE_GROUP in groups), 2 if ground else 1
        figure = svg.new_figure(0.7 + height * rows)
        grid = figure.add_gridspec(rows, wide * len(cameras))

        def put(cell: Any, same: list[Reading], title: str, label: str, last: bool = True) -> None:
            axes = figure.add_subplot(cell)
            panel(axes, same)
            axes.set_ylabel(label)
            if title:
                axes.set_title(title, loc="left", fontweight="bold")
            axes.tick_params(labelbottom=last)
            if last:
                axes.set_xlabel(_time_axis(series)[1])

        for column, camera in enumerate(cameras):
            for row, same in enumerate(groups[camera]):
                label, title = same[0].parameter.label if column == 0 else "", f"Camera {camera}" if row == 0 else ""
                put(grid[row, wide * column : wide * (column + 1)], same, title, label, row == rows - 1)
        half = len(cameras) if GROUND_GROUP in groups else wide * len(cameras)
        for same in groups.get(ANGLE_GROUP, ()):
            put(grid[-1, :half], same, "Angle between the cameras", same[0].parameter.label)
        for same in groups.get(GROUND_GROUP, ())[-1:] if ground else ():
            put(grid[-1, len(cameras) :], same, "Height on the ground", f"[{same[0].parameter.unit}]")
        svg.shared_legend(figure, figure.axes[0])
        figure.align_ylabels()
        return svg.to_svg(figure)


def _course_panel(axes: Axes, series: TimeSeries, time: np.ndarray, rows: list[Reading], names: dict[str, str]) -> None:
    _frame(axes, series, time)
    # side by side, since overlapping bars would hide each other
    step = _BESIDE * float(np.min(np.diff(time), initial=np.inf)) if len(time) > 1 else 0.0
    for j, (estimator, (marker, colour)) in enumerate(marks(names).items()):
        reading = next(row for row in rows if row.estimator == estimator)
        offset_time = time + (j - 0.5 * (len(names) - 1)) * step
        axes.errorbar(
            offset_time, reading.value, reading.sigma, fmt=marker, color=colour, ms=4.0, mec="white", mew=0.4,
            elinewidth=0.8, label=names[estimator],
        )  # fmt: skip
    axes.plot(time, rows[0].true, color=svg.INK, lw=1.5, label="true", zorder=1.5)
    low, high = axes.get_ylim()
    # a panel must not be scaled to noise alone
    least = 6.0 * max(float(np.max(reading.sigma)) for reading in rows)
    if high - low < least:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * least, middle + 0.5 * least)


def _frame(axes: Axes, series: TimeSeries, time: np.ndarray) -> None:
    axes.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
    axes.axvline(time[series.shown], color=svg.GREY, lw=0.9, ls=(0, (1, 2)), zorder=0)
    svg.gridded(axes, "y")
    axes.yaxis.set_major_formatter(_number_text)


def _number_text(value: float, position: float) -> str:
    return f"{round(value, 9) + 0.0:g}".replace("-", MINUS)
