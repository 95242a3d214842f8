"""Figures of measured spots: frames with their centres, what the fit leaves over, changes over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from twin.main_job.spot_plots import DIVERGING, GRAY, cross, stretch
from twin.recover.channel_measurement import SpotResult
from twin.recover.recover_run import RecoverRun
from twin.run.svg import AFTER, BEFORE, BLUE, GREY, INK, ORANGE, look, new_figure, plain_axes, to_svg

LIMIT = 5.0
"""Of the colour scale of residuals, sigmas."""


def _panels(run: RecoverRun, camera: str) -> list[tuple[str, list[tuple[str, SpotResult, np.ndarray]]]]:
    """Side -> before and the last state after, with the centre on the CCD."""
    out = []
    for i, result in enumerate(run.channels):
        name, side = result.channel.name.split("/")
        if name != camera:
            continue
        r = run.last.recovery
        states = result.states()
        last = states[-1]
        out.append((side, [("before", states[0][1], r.before[0, i]), (last[0], last[1], r.after[0, i])]))
    return out


def _extent(spot: SpotResult) -> tuple[float, float, float, float]:
    """Of an image on the CCD."""
    (row, column), (height, width) = spot.frames.offset, spot.mean.shape
    return column - 0.5, column + width - 0.5, row + height - 0.5, row - 0.5


def _mark_unused(axes: Axes, spot: SpotResult) -> None:
    row, column = np.nonzero(~spot.used)
    at = spot.frames.offset
    axes.plot(column + at[1], row + at[0], "s", ms=2.2, mfc="none", mec=ORANGE, mew=0.6, ls="none")


def spots_svg(run: RecoverRun, camera: str) -> str:
    """Mean frames of one camera, a row per channel."""
    with look(f"measured-{camera}"):
        panels = _panels(run, camera)
        norm = stretch(np.concatenate([spot.mean.ravel() for _, states in panels for _, spot, _ in states]))
        figure, grid = _grid(len(panels))
        shown = None
        for line, (side, states) in enumerate(panels):
            for axes, (name, spot, place) in zip(grid[line], states, strict=True):
                shown = axes.imshow(spot.mean, cmap=GRAY, norm=norm, interpolation="none", extent=_extent(spot))
                _mark_unused(axes, spot)
                cross(axes, place, BEFORE if name == "before" else AFTER, 0.11 * spot.mean.shape[1])
                _labels(axes, f"{side}, {name}", line == len(panels) - 1)
        assert shown is not None
        _bar(figure, shown, grid, "mean frame [DN], asinh stretch")
        return to_svg(figure)


def residuals_svg(run: RecoverRun, camera: str) -> str:
    """Residuals of one camera's spots in standard deviations, a row per channel."""
    with look(f"left-{camera}"):
        panels = _panels(run, camera)
        figure, grid = _grid(len(panels))
        shown = None
        for line, (side, states) in enumerate(panels):
            for axes, (name, spot, _) in zip(grid[line], states, strict=True):
                left = np.zeros_like(spot.mean) if spot.residual is None else spot.residual
                shown = axes.imshow(
                    left, cmap=DIVERGING, vmin=-LIMIT, vmax=LIMIT, interpolation="none", extent=_extent(spot)
                )
                _mark_unused(axes, spot)
                _labels(axes, f"{side}, {name}", line == len(panels) - 1)
        assert shown is not None
        _bar(figure, shown, grid, "frame \N{MINUS SIGN} fit [σ]")
        return to_svg(figure)


def _grid(rows: int) -> tuple[Figure, Any]:
    figure = new_figure(0.7 + 4.3 * rows, {"w_pad": 0.03, "h_pad": 0.03})
    return figure, figure.subplots(rows, 2, squeeze=False)


def _labels(axes: Axes, title: str, last: bool) -> None:
    axes.set_title(title)
    axes.set_ylabel("row [px]")
    if last:
        axes.set_xlabel("column [px]")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.tick_params(length=2.5, color=INK)


def _bar(figure: Figure, shown: Any, grid: Any, label: str) -> None:
    figure.colorbar(shown, ax=list(grid.ravel()), label=label, fraction=0.03, pad=0.02)


def changes_svg(series: Sequence[tuple[float, Mapping[tuple[str, str], tuple[float, float]]]]) -> str:
    """Changes over time.

    Args:
        series: (time, (camera, symbol) -> value and sigma) in order of time.
    """
    with look("measured-series"):
        keys = [key for key in series[0][1] if key[0]]
        cameras, symbols = (list(dict.fromkeys(part)) for part in zip(*keys, strict=True))
        figure = new_figure(2.2 * len(symbols))
        rows = figure.subplots(len(symbols), 1, squeeze=False, sharex=True)[:, 0]
        times = [time for time, _ in series]
        for axes, symbol in zip(rows, symbols, strict=True):
            axes.axhline(0.0, color=GREY, lw=0.8)
            for k, camera in enumerate(cameras):
                values, sigmas = zip(*(found[camera, symbol] for _, found in series), strict=True)
                axes.errorbar(
                    times, values, sigmas, fmt="o-", ms=4, lw=1, capsize=2, color=(BLUE, AFTER)[k % 2], label=camera
                )
            axes.set_ylabel(f"{symbol} [{'µm' if symbol == 'Δf' else 'arcsec'}]")
            plain_axes(axes)
        rows[0].legend()
        rows[-1].set_xlabel("time [s]")
        return to_svg(figure)
