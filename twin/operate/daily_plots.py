"""Figures of an instrument in operation: courses of quantities with their bands, innovations against their limit."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.limits import Quantity
from analysis.statistics import limit_of
from twin.operate.overview import Overview, Trend, group_name
from twin.operate.record.entries import MICRO, utc_text
from twin.run import svg

BANDS = ((1.9600, 0.22, "95 %"), (0.9945, 0.42, "68 %"))
"""Sigmas, opacity and name of the bands, the wide one first."""
_FEW = 60
"""Single readings that are drawn with their sigma; more would hide the course."""
_SEEN = 3.0
"""A limit is drawn where it lies within so many times the reach of the course; farther out it would flatten it."""


def dates(times: np.ndarray) -> np.ndarray:
    """Matplotlib's dates of times in microseconds of TAI since 2000, in UTC as it is at the first of them.

    A leap second within a figure moves what comes after it by a second, which no figure shows.
    """
    if not len(times):
        return np.zeros(0)
    text = utc_text(int(times[0])).replace(":60", ":59").rstrip("Z")
    first = datetime.fromisoformat(text).replace(tzinfo=UTC)
    return np.asarray(date2num(first), np.float64) + (times - times[0]) / (86_400.0 * MICRO)


def courses_svg(name: str, overview: Overview, trend: Trend, quantities: Sequence[Quantity], wide: int = 1) -> str:
    """Courses of quantities over one span, a panel each.

    Args:
        name: of the figure.
        overview: of the operation, for requirements, jumps and events.
        trend: of all quantities.
        quantities: that are drawn.
        wide: panels beside each other.
    """
    with svg.look(f"operate-{name}"):
        height = 2.3 if wide == 1 else 1.9
        figure, panels = svg.panels([height] * len(quantities), wide)
        figure.set_figheight(figure.get_figheight() + 0.5)
        for axes, quantity in zip(panels, quantities, strict=True):
            _course(axes, overview, trend, quantity)
        svg.shared_legend(figure, panels[0], columns=4)
        return svg.to_svg(figure)


def _course(axes: Axes, overview: Overview, trend: Trend, quantity: Quantity) -> None:
    q = overview.quantities.index(quantity)
    parts = [("estimate", trend.past, svg.BLUE, svg.SKY, "-")]
    if trend.future is not None:
        parts.append(("forecast", trend.future, svg.VERMILION, svg.ORANGE, "--"))
    reach = 0.0
    for what, course, line, band, style in parts:
        at, value, sigma = dates(course.times), course.values[:, q], course.sigmas[:, q]
        for times, alpha, share in BANDS:
            low, high = value - times * sigma, value + times * sigma
            axes.fill_between(at, low, high, color=band, alpha=alpha, lw=0, label=f"{share} of the {what}")
            reach = max(reach, float(np.nanmax(np.abs(np.concatenate([low, high])), initial=0.0)))
        axes.plot(at, value, style, color=line, lw=1.1, label=what)
    _points(axes, trend, q)
    _happened(axes, overview, trend)
    required = overview.required(quantity)
    title = f"{group_name(quantity.group)} {quantity.parameter.label}"
    if required is not None:
        if required.limit <= _SEEN * reach:
            for sign in (1.0, -1.0):
                label = "requirement" if sign > 0.0 else None
                axes.axhline(sign * required.limit, color=svg.INK, lw=1.0, ls=(0, (6, 3)), label=label)
        else:
            title += f", limit ±{required.limit:g} beyond the figure"
    axes.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
    axes.set_title(title, loc="left")
    _dated(axes)


def _points(axes: Axes, trend: Trend, q: int) -> None:
    points = trend.points
    known = np.isfinite(points.values[:, q])
    if not known.any():
        return
    at, value, sigma = dates(points.times)[known], points.values[known, q], points.sigmas[known, q]
    label = "each reading by itself"
    if len(at) <= _FEW:
        axes.errorbar(at, value, sigma, fmt="o", color=svg.GREY, ms=2.5, elinewidth=0.7, label=f"{label}, ±σ")
    else:
        axes.plot(at, value, ".", color=svg.GREY, ms=2.0, alpha=0.6, label=label)


def _happened(axes: Axes, overview: Overview, trend: Trend) -> None:
    """Jumps as bands from the reading before to the one after, events as lines."""
    begin, end = int(trend.past.times[0]), int(trend.past.times[-1])
    jumps = [jump for jump in overview.following.jumps if begin <= jump.until_us and jump.after_us <= end]
    for k, jump in enumerate(jumps):
        low, high = dates(np.array([jump.after_us, jump.until_us]))
        axes.axvspan(low, high, color=svg.PURPLE, alpha=0.35, lw=1.0, label=None if k else "jump")
    events = [time for time, *_ in overview.events if begin <= time <= end]
    for k, time in enumerate(events):
        axes.axvline(dates(np.array([time]))[0], color=svg.GREEN, lw=0.9, ls=":", label=None if k else "event")


def _dated(axes: Axes) -> None:
    locator = AutoDateLocator(minticks=3, maxticks=9)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes.margins(x=0.01)
    svg.gridded(axes, "y")


def innovations_svg(overview: Overview) -> str:
    """What the newest readings departed from their predictions by, chi-square with its limit."""
    with svg.look("operate-innovations"):
        told = overview.following.innovations
        times = np.array([one[0] for one in told], np.int64)
        chi = np.array([one[1] for one in told], np.float64)
        degrees = np.array([one[2] for one in told], np.float64)
        limit = np.array([limit_of(FALSE_ALARM, one) for one in degrees])
        figure = svg.new_figure(2.6)
        axes = figure.subplots()
        at, above = dates(times), chi > limit
        axes.plot(at, limit, color=svg.INK, lw=1.0, ls=(0, (6, 3)), label="limit, chance 0.1 %")
        axes.plot(at, degrees, color=svg.GREY, lw=0.9, label="mean where predictions are right")
        axes.plot(at[~above], chi[~above], ".", color=svg.BLUE, ms=4, label="reading")
        axes.plot(at[above], chi[above], "D", color=svg.VERMILION, ms=4, label="above the limit")
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylabel("chi-square")
        _dated(axes)
        svg.shared_legend(figure, axes)
        return svg.to_svg(figure)
