"""Figures of a time series: temperatures, true changes and the changes by every estimator over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from analysis.arrays import ARCSEC
from analysis.monitor import parameters
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from scenes.specs.instrument import BASE
from twin.framework import svg
from twin.framework.artefact import MINUS
from twin.main_job.spot_plots import marks
from twin.monitor.reading_table import Reading
from twin.monitor.time_series import TimeSeries

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
    return _changes_svg(series, "course", 1.5, lambda axes, same: _panel(axes, series, time, same, names))


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


def _panel(axes: Axes, series: TimeSeries, time: np.ndarray, rows: list[Reading], names: dict[str, str]) -> None:
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
