"""The daily report of an instrument in operation: one page that needs no other file, to be kept or sent by mail.

Figures of an instrument in operation: courses of quantities with their bands, innovations against their limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.limits import Quantity
from analysis.statistics import limit_of
from scenes.models.disturbances import HEAT
from scenes.yaml.errors import Problem
from twin.framework import svg
from twin.framework.artefact import Artefact, Cell, DecimalNumber, Marked, SvgFigure, Table, Text, decimals_for
from twin.framework.report import Report, Section, answer
from twin.operate.estimate.reported_estimate import name_of, percent, with_sigma
from twin.operate.overview import (
    CONFIDENCE,
    DAY,
    Overview,
    Trend,
    best_known_motion,
    day_text,
    group_name,
    line_change_text,
    minute_text,
    trend,
)
from twin.operate.record.entries import MICRO, micros, utc_text
from twin.operate.record.history import History

if TYPE_CHECKING:
    pass

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

    Parameters
    ----------
    name : str
        Of the figure.
    overview : Overview
        Of the operation, for requirements, jumps and events.
    trend : Trend
        Of all quantities.
    quantities : Sequence[Quantity]
        That are drawn.
    wide : int
        Panels beside each other.
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
    jumps = [jump for jump in overview.filter_result.jumps if begin <= jump.until_us and jump.after_us <= end]
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
        told = overview.filter_result.innovations
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


RECENT = 30 * DAY
"""Before the newest reading, of the second figure of courses."""
MOST_EXPLAINED = 4
"""Quantities of which the lead says how much of their scatter temperatures explain."""
MOST_MOTIONS = 12
"""Motions of bodies that are listed."""
MOST_SHOWN = 40
"""Rows of a table in which the newest are shown; CSV has them all."""
_NOT = "\N{EM DASH}"


def daily_report(history: History, overview: Overview, end: int) -> Report:
    """What there is to say of a day.

    Parameters
    ----------
    history : History
        The record.
    overview : Overview
        Of it, at the day's end.
    end : int
        Of the day, microseconds of TAI since 2000.
    """
    told = overview.filter_result
    begin = end - DAY
    last = min(end, overview.time)
    verdict, lead = answer(
        overview.state_sentence(),
        overview.change_sentence(begin, end, f"on {day_text(begin)}"),
        *overview.break_sentences(),
        overview.score_sentence(),
        _explained(overview),
    )
    sections = (
        _changed_section(overview, begin, end),
        _trend_section(history, overview, last),
        _motion_section(overview),
        _prediction_section(overview),
        _jump_section(overview),
        _sensor_section(overview),
        _alarm_section(overview),
        _left_out_section(history, overview),
    )
    facts = (
        ("Instrument", f"{history.name} ({history.sha256[:12]})"),
        ("Record", history.url),
        ("Readings", f"{told.readings}, the newest of {minute_text(overview.time)} UTC"),
        ("Disturbances", str(overview.operation.plan.operation.disturbances)),
        ("Forecast", f"{overview.horizon / DAY:g} d"),
    )
    return Report(
        f"{history.name} in operation, {day_text(begin)}",
        verdict,
        lead,
        facts,
        state_table(overview),
        tuple(section for section in sections if section is not None),
        warnings=_warnings(overview, end),
    )


def end_of_day(text: str | None, newest: int) -> int:
    """The end of a day of UTC, microseconds of TAI since 2000; by default of the newest reading's.

    Raises
    ------
    Problem
        Not a date.
    """
    name = day_text(newest) if text is None else text.strip()
    allowed = "a date of UTC: 2028-03-05"
    if len(name) != len("2028-03-05"):
        raise Problem("not a day", repr(name), allowed)
    try:
        return micros(f"{name}T00:00:00Z", seconds=86_400.0)
    except Problem:
        raise Problem("not a day", repr(name), allowed) from None


def state_table(overview: Overview) -> Table:
    """Every quantity now: value, sigma, requirement, chance, and when it is expected to break."""
    now = overview.filter_result.now
    heads = ("change", "now", "σ", "limit", "beyond it [%]", "allowed [%]", "holds", "expected to break")
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    bands: dict[int, str] = {}
    for q, quantity in enumerate(overview.quantities):
        value, sigma, group = float(now.values[0, q]), float(now.sigmas[0, q]), group_name(quantity.group)
        if group not in bands.values():
            bands[q] = group
        places = decimals_for(sigma)
        row: list[Cell] = [quantity.parameter.label, DecimalNumber(value, places), DecimalNumber(sigma, places)]
        row += _required_cells(overview, quantity)
        rows.append(row)
        full.append([group, *(str(cell) if isinstance(cell, Marked) else cell for cell in row)])
    caption = (
        f"Changes since the reference images at {minute_text(overview.time)} UTC, with all readings until then. A "
        "requirement holds while the chance that the size of the change is beyond its limit is not larger than what "
        "is allowed. It is expected to break when that chance of the forecast is."
    )
    name = "state"
    digits = Table(name, "State", "", ("of", *heads), full, within="")
    return Table(name, "State", caption, heads, rows, within="", full=digits, bands=bands)


def _required_cells(overview: Overview, quantity: Quantity) -> list[Cell]:
    one = overview.required(quantity)
    if one is None:
        return ["", "", "", "", ""]
    horizon = overview.horizon / DAY
    when = day_text(one.breaks_us) if one.breaks_us is not None else f"not within {horizon:g} d"
    look = "text" if one.holds_now else "text wrong"
    return [
        f"±{one.limit:g}",
        percent(one.chance_now).removesuffix(" %"),
        percent(1.0 - one.probability).removesuffix(" %"),
        Marked("yes" if one.holds_now else "no", look=look, key=quantity.name),
        when if one.holds_now else "broken",
    ]


def _changed_section(overview: Overview, begin: int, end: int) -> Section:
    found = [occurrence for occurrence in overview.changed(begin, end) if not occurrence.again]
    lines = tuple(f"{minute_text(one.time)}: {one.text}" for one in found)
    what = f"Between {minute_text(begin)} and {minute_text(end)} UTC.{'' if lines else ' Nothing occurrences.'}"
    shown = (Text("changed", "", "", lines[-MOST_SHOWN:], within=""),) if lines else ()
    return Section("What changed", (what,), shown, name="changed")


def _trend_section(history: History, overview: Overview, last: int) -> Section:
    quantities = overview.quantities
    chosen = [quantity for quantity in quantities if overview.required(quantity) is not None] or list(quantities)[:3]
    others = [quantity for quantity in quantities if quantity not in chosen]
    first = overview.begin
    recent = trend(history, overview, max(first, last - RECENT), last + overview.horizon)
    figures: list[Artefact] = []
    if last - first > RECENT:
        life = trend(history, overview, first, last)
        figures.append(_figure("life", "Since the record began", courses_svg("life", overview, life, chosen)))
    title = f"The last {min(RECENT, last - first) / DAY:.0f} days, and the forecast"
    figures.append(_figure("recent", title, courses_svg("recent", overview, recent, chosen)))
    if others:
        more = courses_svg("others", overview, recent, others, 2)
        figures.append(_figure("others", "All other changes", more))
    words = (
        "Lines are the estimate with all readings, bands hold the true change with a chance of 68 and 95 %. Jumps "
        "stand between the readings before and after them, events where the record has them.",
    )
    return Section("Trends", words, tuple(figures), int(bool(others)), name="trends")


def _figure(name: str, title: str, svg: str) -> SvgFigure:
    return SvgFigure(name, title, "", svg, within="")


def _motion_section(overview: Overview) -> Section | None:
    """Return the motions of bodies that are known best, all causes of a motion together; None without any."""
    found, stated = overview.operation.motions(overview.time), overview.operation.experiment.stated
    moving = () if stated is None else [component for component in stated.components if component.kind not in HEAT]
    rows: list[tuple[float, list[Cell]]] = []
    for name, unit in {one.name: one.unit for one in moving}.items():
        own = np.array([label == name for label in found.labels], np.float64)
        mean, sigma = float(own @ found.mean), math.sqrt(max(float(own @ found.covariance @ own), 0.0))
        places = decimals_for(sigma)
        ratio = abs(mean) / sigma if sigma else 0.0
        numbers = DecimalNumber(mean, places), DecimalNumber(sigma, places), DecimalNumber(ratio, 1)
        rows.append((ratio, [f"{name} [{unit}]", *numbers]))
    if not rows:
        return None
    best = [cells for _, cells in sorted(rows, key=lambda row: -row[0])[:MOST_MOTIONS]]
    caption = (
        f"The {len(best)} motions of most sigmas of {len(rows)}, at {minute_text(overview.time)} UTC, with all "
        "readings until then; twin.operate products writes all of them with their covariance."
    )
    heads = ("motion", "now", "σ", "sigmas")
    return Section("Motions of bodies", (), (Table("motions", "", caption, heads, best, within=""),), name="motions")


def _prediction_section(overview: Overview) -> Section:
    told = overview.filter_result
    rows: list[list[Cell]] = []
    for coverage in overview.coverages:
        if coverage.count:
            look = "text" if coverage.holds else "text wrong"
            interval = f"{100.0 * coverage.low:.1f} to {100.0 * coverage.high:.1f}"
            words = Marked("yes" if coverage.holds else "no", look=look, key=f"coverage {coverage.sigmas}")
            row: list[Cell] = [f"within {coverage.sigmas}σ", DecimalNumber(100.0 * coverage.expected, 2)]
            rows.append([*row, DecimalNumber(100.0 * coverage.share, 2), interval, coverage.count, words])
    heads = ("components", "expected [%]", "found [%]", f"interval of {100.0 * CONFIDENCE:.0f} % [%]", "of", "in it")
    caption = (
        "Each reading was predicted from all before it. Its components, made independent and of unit variance, lie "
        "within 1 and 2σ as often as a normal distribution has it where the plan's disturbances are right; the "
        "interval is the exact binomial one."
    )
    artefacts: list[Artefact] = []
    score = f"Mean log score of a reading: {told.scores.log_score:.3f}, larger is better."
    text = [score if told.scores.readings else "Nothing was predicted yet."]
    if told.innovations:
        above = sum(chi > limit_of(FALSE_ALARM, degrees) for _, chi, degrees in told.innovations)
        text.append(
            f"Of the last {len(told.innovations)} readings {above} "
            f"{'is' if above == 1 else 'are'} above the limit, of {FALSE_ALARM * len(told.innovations):.1f} expected."
        )
        artefacts.append(_figure("innovations", "Departures from predictions", innovations_svg(overview)))
    if rows:
        artefacts.append(Table("coverage", "Coverage so far", caption, heads, rows, within=""))
    return Section("Predictions", tuple(text), tuple(artefacts), name="predictions")


def _explained(overview: Overview) -> str:
    known = {name: share for name, share in overview.filter_result.explained.items() if math.isfinite(share)}
    if not known:
        return ""
    parts = [
        f"{100.0 * known[quantity.name]:.0f} % of that of {name_of(quantity.name, overview.quantities)}"
        for quantity in overview.quantities
        if known.get(quantity.name, 0.0) >= 0.005
        and (overview.required(quantity) or not overview.filter_result.requirements)
    ]
    if not parts:
        return "Temperatures explain nothing of the scatter of what is required"
    return f"Of the readings' scatter temperatures explain {', '.join(parts[:MOST_EXPLAINED])}"


def _jump_section(overview: Overview) -> Section | None:
    told = overview.filter_result
    heads = ("came until", "told", "body", "best known part", "did to the line", "log ratio", "false alarm", "or else")
    digits = ("after", "until", "told", "body", "part", "size", "sigma", "unit", "log ratio", "false alarm", "or else")
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    for jump in sorted(told.jumps, key=lambda one: -one.until_us):
        label, unit, size, sigma = best_known_motion(jump)
        part, rivals = label.removeprefix(f"{jump.body} "), sorted(jump.rivals.items(), key=lambda one: -one[1])
        others = ", ".join(f"{body} ({ratio:.1f})" for body, ratio in rivals[:3])
        row: list[Cell] = [Marked(minute_text(jump.until_us), f"after {minute_text(jump.after_us)}", "text")]
        row += [minute_text(jump.detected_us), jump.body]
        row += [Marked(part, with_sigma(size, sigma, unit), "text"), line_change_text(overview, jump) or _NOT]
        rows.append([*row, DecimalNumber(jump.log_ratio, 1), f"{jump.false_alarm:.1g}", others or _NOT])
        when = [utc_text(time) for time in (jump.after_us, jump.until_us, jump.detected_us)]
        full.append([*when, jump.body, part, size, sigma, unit, jump.log_ratio, jump.false_alarm, others])
    events = [
        f"{minute_text(time)}: {name.replace('_', ' ')}" + (f", which may step {', '.join(causes)}" if causes else "")
        for time, name, causes in overview.events
    ]
    artefacts: list[Artefact] = []
    if rows:
        caption = (
            "A jump is a step of one body that the readings show and no event explains, at a time between two "
            "readings. What it did to the line is by all bodies that can have made it, which stand at the end with "
            "their log ratios. Times are UTC."
        )
        own = Table("jumps", "Jumps that were found", "", digits, full, within="")
        artefacts.append(replace(_newest("jumps", own.title, caption, heads, rows), full=own))
    if events:
        artefacts.append(Text("events", "Events of the record", "", events[::-1][:MOST_SHOWN], within=""))
    words = () if artefacts else ("No jump was found, and the record has no event.",)
    return Section("Jumps and events", words, tuple(artefacts), name="jumps")


def _newest(name: str, title: str, caption: str, heads: Sequence[str], rows: list[list[Cell]]) -> Table:
    """A table of the newest rows, which stand first, with all of them to be taken away."""
    if len(rows) <= MOST_SHOWN:
        return Table(name, title, caption, heads, rows, within="")
    full = Table(name, title, "", heads, rows, within="")
    caption = f"The newest {MOST_SHOWN} of {len(rows)}. {caption}".strip()
    return Table(name, title, caption, heads, rows[:MOST_SHOWN], within="", full=full)


def _sensor_section(overview: Overview) -> Section:
    rows: list[list[Cell]] = [
        [
            one.body,
            Marked(one.state, look="text" if one.state == "ok" else "text wrong", key=f"sensor {one.body}"),
            minute_text(one.since_us),
            minute_text(one.last_us),
            one.reason or _NOT,
        ]
        for one in sorted(overview.filter_result.sensors, key=lambda one: (one.state == "ok", one.body))
    ]
    heads = ("body", "state", "since", "last reading", "why")
    if not rows:
        return Section("Sensors", ("The record has no temperature.",), name="sensors")
    caption = (
        "Sensors of temperatures as their own readings show them, those that are not in order first. Times are UTC."
    )
    return Section("Sensors", (), (Table("sensors", "", caption, heads, rows, within=""),), name="sensors")


def _alarm_section(overview: Overview) -> Section:
    if not overview.alarms:
        return Section("Alarms", ("No alarm has been raised.",), name="alarms")
    waiting = {id(alarm) for alarm in overview.open_alarms()}
    rows: list[list[Cell]] = []
    for one in sorted(overview.alarms, key=lambda one: (id(one) not in waiting, -int(one["time_us"]))):
        known = one["acknowledged"]
        who = "open" if known is None else _who(known)
        state = Marked(who, look="text wrong" if known is None else "text", key=f"alarm {one['id']}")
        rows.append([minute_text(int(one["time_us"])), str(one["kind"]).replace("_", " "), str(one["text"]), state])
    heads = ("time", "sort", "alarm", "acknowledged")
    words = (
        f"{len(waiting)} of {len(overview.alarms)} wait for an acknowledgement." if waiting else "All are acknowledged."
    )
    return Section("Alarms", (words,), (_newest("alarms", "", "Times are UTC.", heads, rows),), name="alarms")


def _who(ack: Mapping[str, Any]) -> str:
    note = f": {ack['note']}" if ack.get("note") else ""
    return f"{ack['by']}, {str(ack['acknowledged_utc'])[:16].replace('T', ' ')}{note}"


def _left_out_section(history: History, overview: Overview) -> Section:
    rows: list[list[Cell]] = [
        [minute_text(time), kind, subject, reason]
        for time, kind, subject, reason in sorted(overview.filter_result.excluded, key=lambda one: -one[0])
    ]
    refused = [refusal for refusal in history.refusals() if not refusal["taken_since"]]
    artefacts: list[Artefact] = []
    if rows:
        caption = "In the record, but not used for the estimate. Times are UTC."
        artefacts.append(_newest("left-out", "Left out", caption, ("time", "sort", "of", "why"), rows))
    if refused:
        own: list[list[Cell]] = [
            [one["refused_utc"], f"{one['file']}{'' if one['line'] is None else ':' + str(one['line'])}", one["reason"]]
            for one in refused[::-1]
        ]
        caption = "Refused when their files were taken, and not in the record."
        artefacts.append(_newest("refused", "Refused", caption, ("refused [UTC]", "in", "why"), own))
    words = () if artefacts else ("Nothing was left out or refused.",)
    return Section("What was left out", words, tuple(artefacts), name="left-out")


def _warnings(overview: Overview, end: int) -> tuple[str, ...]:
    out = overview.filter_result.warnings
    age = (end - overview.time) / DAY
    if age > 1.0:
        out.append(f"the newest reading is {age:.0f} d older than the end of the day")
    waiting = overview.open_alarms()
    if waiting:
        count = "one alarm waits" if len(waiting) == 1 else f"{len(waiting)} alarms wait"
        out.append(f"{count} for an acknowledgement; the newest: {waiting[0]['text']}")
    bad = [sensor for sensor in overview.filter_result.sensors if sensor.state != "ok"]
    if bad:
        out.append("sensors that are not in order: " + ", ".join(f"{one.body} ({one.state})" for one in bad))
    return tuple(out)
