"""Figures of measured spots: mean frames with spot centres, fit residuals, changes over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

from twin.framework import svg
from twin.main_job.series_plots import time_unit
from twin.main_job.spot_plots import asinh_scale, cross
from twin.recover.channel_measurement import SpotResult
from twin.recover.recover_run import RecoverRun, state_name

LIMIT = 5.0
"""Limit of the colour scale of fit residuals, in standard deviations of a pixel."""


def _panels(run: RecoverRun, camera: str) -> list[tuple[str, list[tuple[str, SpotResult, np.ndarray]]]]:
    """Return the images to be drawn of a camera: for each channel the states before and last after.

    An entry has the channel's name and, for each of the two states, its name, the measured spot, and the spot's centre
    on the CCD, in pixels.
    """
    out = []
    for i, result in enumerate(run.channels):
        name, channel = result.channel.name.split("/")
        if name != camera:
            continue
        r = run.last.recovery
        states = result.states()
        name = state_name(run.times, len(states) - 1)
        out.append((channel, [("before", states[0][1], r.before[0, i]), (name, states[-1][1], r.after[0, i])]))
    return out


def _extent(spot: SpotResult) -> tuple[float, float, float, float]:
    """Return the region of the CCD that a spot's image shows, in pixels, as Matplotlib's ``extent``."""
    (row, column), (height, width) = spot.frames.offset, spot.mean.shape
    return column - 0.5, column + width - 0.5, row + height - 0.5, row - 0.5


def _mark_unused(axes: Axes, spot: SpotResult) -> None:
    row, column = np.nonzero(~spot.used)
    at = spot.frames.offset
    axes.plot(column + at[1], row + at[0], "s", ms=2.2, mfc="none", mec=svg.ORANGE, mew=0.6, ls="none")


def spots_svg(run: RecoverRun, camera: str) -> str:
    """Draw the mean frames of one camera, a row for each channel."""
    norm = asinh_scale(np.concatenate([s.mean.ravel() for _, states in _panels(run, camera) for _, s, _ in states]))

    def draw(axes: Axes, name: str, spot: SpotResult, place: np.ndarray) -> AxesImage:
        shown = axes.imshow(spot.mean, cmap=svg.GRAY, norm=norm, interpolation="none", extent=_extent(spot))
        cross(axes, place, svg.BEFORE if name == "before" else svg.AFTER, 0.11 * spot.mean.shape[1])
        return shown

    return _images_svg(run, camera, "measured", "mean frame [DN], asinh stretch", draw)


def residuals_svg(run: RecoverRun, camera: str) -> str:
    """Draw the fit residuals of one camera's spots in standard deviations, a row for each channel."""

    def draw(axes: Axes, _name: str, spot: SpotResult, _place: np.ndarray) -> AxesImage:
        residual = np.zeros_like(spot.mean) if spot.residual is None else spot.residual
        return svg.signed_map(axes, residual, LIMIT, interpolation="none", extent=_extent(spot))

    return _images_svg(run, camera, "left", "frame \N{MINUS SIGN} fit [σ]", draw)


def _images_svg(
    run: RecoverRun, camera: str, name: str, label: str, draw: Callable[[Axes, str, SpotResult, np.ndarray], AxesImage]
) -> str:
    """Draw an image of every spot of a camera before and after, with marks on the pixels that are not used."""
    with svg.look(f"{name}-{camera}"):
        panels = _panels(run, camera)
        figure = svg.new_figure(0.7 + 4.3 * len(panels), {"w_pad": 0.03, "h_pad": 0.03})
        grid = figure.subplots(len(panels), 2, squeeze=False)
        for line, (channel, states) in enumerate(panels):
            for axes, (state, spot, place) in zip(grid[line], states, strict=True):
                shown = draw(axes, state, spot, place)
                _mark_unused(axes, spot)
                _labels(axes, f"{channel}, {state}", line == len(panels) - 1)
        figure.colorbar(shown, ax=list(grid.ravel()), label=label, fraction=0.03, pad=0.02)
        return svg.to_svg(figure)


def _labels(axes: Axes, title: str, last: bool) -> None:
    axes.set_title(title)
    axes.set_ylabel("row [px]")
    if last:
        axes.set_xlabel("column [px]")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.tick_params(length=2.5, color=svg.INK)


@dataclass(frozen=True, eq=False)
class Line:
    """One change of a camera over time, as the figure of a time series draws it.

    Attributes
    ----------
    camera : str
        Name of the camera; empty for a change of both cameras together, such as that of their angle.
    name : str
        Name of the change with its unit.
    marks : (3, T) ndarray
        For each of T measured times: time in seconds, value and standard deviation, estimated from that time alone.
    band : (3, F) ndarray or None
        For F times at and between the measured ones: time, value and standard deviation, estimated from all times
        together; None without a prior.
    """

    camera: str
    name: str
    marks: np.ndarray
    band: np.ndarray | None


def changes_svg(lines: Sequence[Line]) -> str:
    """Draw changes over time, cameras side by side, and below them the changes of both together.

    Parameters
    ----------
    lines : Sequence[Line]
        All changes.
    """
    with svg.look("measured-series"):
        size, unit = time_unit(lines[0].marks[0])
        cameras = list(dict.fromkeys(line.camera for line in lines if line.camera))
        lines_of_camera = {camera: [line for line in lines if line.camera == camera] for camera in cameras}
        shared = [line for line in lines if not line.camera]
        rows = max(map(len, lines_of_camera.values())) + len(shared)
        figure = svg.new_figure(0.7 + 1.5 * rows)
        grid = figure.add_gridspec(rows, len(cameras))
        for column, camera in enumerate(cameras):
            for row, line in enumerate(lines_of_camera[camera]):
                axes = figure.add_subplot(grid[row, column])
                _change(axes, line, size)
                axes.set_ylabel(line.name if column == 0 else "")
                axes.tick_params(labelbottom=row == rows - 1)
                if row == 0:
                    axes.set_title(f"Camera {camera}", loc="left", fontweight="bold")
                if row == rows - 1:
                    axes.set_xlabel(f"time [{unit}]")
        for k, line in enumerate(shared):
            axes = figure.add_subplot(grid[rows - len(shared) + k, :])
            _change(axes, line, size)
            axes.set_ylabel(line.name)
            axes.set_title("Angle between the cameras", loc="left", fontweight="bold")
            axes.set_xlabel(f"time [{unit}]")
        svg.shared_legend(figure, figure.axes[0])
        figure.align_ylabels()
        return svg.to_svg(figure)


def _change(axes: Axes, line: Line, size: float) -> None:
    axes.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
    if line.band is not None:
        time, value, sigma = line.band
        for times, alpha in ((2.0, 0.25), (1.0, 0.45)):
            low, high = value - times * sigma, value + times * sigma
            label = f"{'2' if times > 1.0 else ''}σ, smoothed"
            axes.fill_between(time / size, low, high, color=svg.SKY, alpha=alpha, lw=0, label=label)
        axes.plot(time / size, value, color=svg.BLUE, lw=1.0, label="smoothed")
    time, value, sigma = line.marks
    axes.errorbar(
        time / size, value, sigma, fmt="o", color=svg.INK, ms=3.0, elinewidth=0.8, capsize=2, label="each time alone"
    )
    svg.gridded(axes, "y")
