"""Daily report of an instrument in operation: one self-contained page, to be stored or sent by mail.

Its figures show the time series of the quantities with their confidence bands, and the chi-square of the innovations
(readings minus predictions) against its limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

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

BANDS = ((1.9600, 0.22, "95 %"), (0.9945, 0.42, "68 %"))
"""Confidence bands of a figure: multiple of sigma, opacity and name of each, the widest first."""
_MOST_ERROR_BARS = 60
"""Largest number of single readings drawn with error bars; more would hide the curve."""
_LIMIT_EXTENTS = 3.0
"""Largest ratio of a requirement's limit to the range of the time series for which the limit is drawn.

If a larger limit were drawn, the curve would look flat.
"""


def dates(times: np.ndarray) -> np.ndarray:
    """Return times in microseconds of TAI since 2000 as Matplotlib dates, in the UTC of the first of them.

    A leap second within a figure shifts later times by one second, which is not visible.
    """
    if not len(times):
        return np.zeros(0)
    text = utc_text(int(times[0])).replace(":60", ":59").rstrip("Z")
    first = datetime.fromisoformat(text).replace(tzinfo=UTC)
    return np.asarray(date2num(first), np.float64) + (times - times[0]) / (86_400.0 * MICRO)


def courses_svg(name: str, overview: Overview, trend: Trend, quantities: Sequence[Quantity], wide: int = 1) -> str:
    """Draw the time series of quantities over one span, one panel each.

    Parameters
    ----------
    name : str
        Name of the figure.
    overview : Overview
        Overview of the operation, with its requirements, jumps and events.
    trend : Trend
        Time series of all quantities.
    quantities : Sequence[Quantity]
        Quantities to draw.
    wide : int
        Number of panels side by side.
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
    """Draw the time series of one quantity with its bands, readings, jumps, events and requirement."""
    q = overview.quantities.index(quantity)
    parts = [("estimate", trend.past, svg.BLUE, svg.SKY, "-")]
    if trend.future is not None:
        parts.append(("forecast", trend.future, svg.VERMILION, svg.ORANGE, "--"))
    extent = 0.0
    for what, course, line, band, style in parts:
        at, value, sigma = dates(course.times), course.values[:, q], course.sigmas[:, q]
        for times, alpha, share in BANDS:
            low, high = value - times * sigma, value + times * sigma
            axes.fill_between(at, low, high, color=band, alpha=alpha, lw=0, label=f"{share} of the {what}")
            extent = max(extent, float(np.nanmax(np.abs(np.concatenate([low, high])), initial=0.0)))
        axes.plot(at, value, style, color=line, lw=1.1, label=what)
    _points(axes, trend, q)
    _mark_jumps_and_events(axes, overview, trend)
    required = overview.required(quantity)
    title = f"{group_name(quantity.group)} {quantity.parameter.label}"
    if required is not None:
        if required.limit <= _LIMIT_EXTENTS * extent:
            for sign in (1.0, -1.0):
                label = "requirement" if sign > 0.0 else None
                axes.axhline(sign * required.limit, color=svg.INK, lw=1.0, ls=(0, (6, 3)), label=label)
        else:
            title += f", limit ±{required.limit:g} outside the plot"
    axes.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
    axes.set_title(title, loc="left")
    _dated(axes)


def _points(axes: Axes, trend: Trend, q: int) -> None:
    """Draw the values of a quantity from single readings of the monitor, with error bars if there are few."""
    points = trend.points
    known = np.isfinite(points.values[:, q])
    if not known.any():
        return
    at, value, sigma = dates(points.times)[known], points.values[known, q], points.sigmas[known, q]
    label = "single readings"
    if len(at) <= _MOST_ERROR_BARS:
        axes.errorbar(at, value, sigma, fmt="o", color=svg.GREY, ms=2.5, elinewidth=0.7, label=f"{label}, ±σ")
    else:
        axes.plot(at, value, ".", color=svg.GREY, ms=2.0, alpha=0.6, label=label)


def _mark_jumps_and_events(axes: Axes, overview: Overview, trend: Trend) -> None:
    """Draw jumps as bands between the readings before and after them, and events as lines."""
    begin, end = int(trend.past.times[0]), int(trend.past.times[-1])
    jumps = [jump for jump in overview.filter_result.jumps if begin <= jump.until_us and jump.after_us <= end]
    for k, jump in enumerate(jumps):
        low, high = dates(np.array([jump.after_us, jump.until_us]))
        axes.axvspan(low, high, color=svg.PURPLE, alpha=0.35, lw=1.0, label=None if k else "jump")
    events = [time for time, *_ in overview.events if begin <= time <= end]
    for k, time in enumerate(events):
        axes.axvline(dates(np.array([time]))[0], color=svg.GREEN, lw=0.9, ls=":", label=None if k else "event")


def _dated(axes: Axes) -> None:
    """Format the time axis of a panel with UTC dates."""
    locator = AutoDateLocator(minticks=3, maxticks=9)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes.margins(x=0.01)
    svg.gridded(axes, "y")


def innovations_svg(overview: Overview) -> str:
    """Draw the chi-square of the newest innovations (readings minus predictions) with its critical value."""
    with svg.look("operate-innovations"):
        innovations = overview.filter_result.innovations
        times = np.array([innovation[0] for innovation in innovations], np.int64)
        chi = np.array([innovation[1] for innovation in innovations], np.float64)
        degrees = np.array([innovation[2] for innovation in innovations], np.float64)
        limit = np.array([limit_of(FALSE_ALARM, innovation) for innovation in degrees])
        figure = svg.new_figure(2.6)
        axes = figure.subplots()
        at, above = dates(times), chi > limit
        axes.plot(at, limit, color=svg.INK, lw=1.0, ls=(0, (6, 3)), label="limit (p = 0.001)")
        axes.plot(at, degrees, color=svg.GREY, lw=0.9, label="expected")
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
"""Time before the newest reading that the second figure of time series shows, in microseconds."""
MOST_EXPLAINED = 4
"""Largest number of quantities for which the summary gives the share of the scatter that temperatures explain."""
MOST_MOTIONS = 12
"""Number of the most significant motions of bodies that the report lists."""
MOST_SHOWN = 40
"""Number of rows shown in the report of a table that lists the newest first; its CSV has all rows."""
_NOT = "\N{EM DASH}"
_JUMP_HEADS = ("log likelihood ratio", "false-alarm probability", "other candidates")


def daily_report(history: History, overview: Overview, end: int) -> Report:
    """Return the daily report of an instrument in operation.

    Parameters
    ----------
    history : History
        Record of the instrument in operation.
    overview : Overview
        Overview of the record at the end of the day.
    end : int
        End of the day, in microseconds of TAI since 2000.
    """
    result = overview.filter_result
    begin = end - DAY
    last = min(end, overview.time)
    first, *others = overview.headline()
    verdict, lead = answer(
        first,
        overview.change_sentence(begin, end, f"on {day_text(begin)}"),
        *others,
        overview.score_sentence(),
        _explained_sentence(overview),
    )
    sections = (
        _changed_section(overview, begin, end),
        _trend_section(history, overview, last),
        _motion_section(overview),
        _prediction_section(overview),
        _jump_section(overview),
        _sensor_section(overview),
        _alarm_section(overview),
        _excluded_section(history, overview),
    )
    facts = (
        ("Instrument", f"{history.name} ({history.sha256[:12]})"),
        ("Record", history.url),
        ("Readings", f"{result.readings_text}, the newest entry of {minute_text(overview.time)} UTC"),
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
        unmet=overview.unmet,
    )


def end_of_day(text: str | None, newest: int) -> int:
    """Return the end of a UTC day, in microseconds of TAI since 2000.

    Parameters
    ----------
    text : str or None
        Date, ISO 8601; None for the day of the newest reading.
    newest : int
        Time of the newest reading, in microseconds of TAI since 2000.

    Raises
    ------
    Problem
        The text is not a date.
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
    """Return the table of all quantities: value, sigma, requirement, its probability and first possible violation."""
    now = overview.filter_result.now
    heads = ("change", "now", "σ", "limit", "P(exceeded) [%]", "allowed [%]", "holds", "may be violated from")
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    bands: dict[int, str] = {}
    for q, quantity in enumerate(overview.quantities):
        value, sigma, group = float(now.values[0, q]), float(now.sigmas[0, q]), group_name(quantity.group)
        if group not in bands.values():
            bands[q] = group
        decimals = decimals_for(sigma)
        row: list[Cell] = [quantity.parameter.label, DecimalNumber(value, decimals), DecimalNumber(sigma, decimals)]
        row += _required_cells(overview, quantity)
        rows.append(row)
        full.append([group, *(str(cell) if isinstance(cell, Marked) else cell for cell in row)])
    what = "Amounts" if overview.operation.reading_kind == "focus" else "Changes since the reference images"
    caption = (
        f"{what} at {minute_text(overview.time)} UTC, from all readings until then. A "
        "requirement holds while the probability that the change exceeds its limit is at most the allowed one. "
        "It may be violated from the first day of the forecast on which the probability is larger."
    )
    name = "state"
    digits = Table(name, "State", "", ("of", *heads), full, within="")
    return Table(name, "State", caption, heads, rows, within="", full=digits, bands=bands)


def _required_cells(overview: Overview, quantity: Quantity) -> list[Cell]:
    """Return the table cells on a quantity's requirement; empty cells for a quantity without one."""
    requirement = overview.required(quantity)
    if requirement is None:
        return ["", "", "", "", ""]
    horizon = overview.horizon / DAY
    when = day_text(requirement.breaks_us) if requirement.breaks_us is not None else f"not within {horizon:g} d"
    style = "text" if requirement.holds_now else "text wrong"
    return [
        f"±{requirement.limit:g}",
        percent(requirement.chance_now).removesuffix(" %"),
        percent(1.0 - requirement.probability).removesuffix(" %"),
        Marked("yes" if requirement.holds_now else "no", look=style, key=quantity.name),
        when if requirement.holds_now else "violated",
    ]


def _changed_section(overview: Overview, begin: int, end: int) -> Section:
    """Return the section on the changes of the day."""
    occurrences = [occurrence for occurrence in overview.changed(begin, end) if not occurrence.again]
    lines = tuple(f"{minute_text(event.time)}: {event.text}" for event in occurrences)
    what = f"Between {minute_text(begin)} and {minute_text(end)} UTC.{'' if lines else ' Nothing happened.'}"
    shown = (Text("changed", "", "", lines[-MOST_SHOWN:], within=""),) if lines else ()
    return Section("What changed", (what,), shown, name="changed")


def _trend_section(history: History, overview: Overview, last: int) -> Section:
    """Return the section with the time series of the quantities."""
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
        "Lines show the estimate from all readings; bands contain the true change with probabilities of 68 and 95 %. "
        "Jumps are shown between the readings before and after them, events at their recorded times.",
    )
    return Section("Trends", words, tuple(figures), int(bool(others)), name="trends")


def _figure(name: str, title: str, svg: str) -> SvgFigure:
    return SvgFigure(name, title, "", svg, within="")


def _motion_section(overview: Overview) -> Section | None:
    """Return the section of the most significant motions of bodies, all causes together; None without any."""
    motions, prior = overview.operation.motions(overview.time), overview.operation.experiment.prior
    moving = () if prior is None else [component for component in prior.components if component.kind not in HEAT]
    rows: list[tuple[float, list[Cell]]] = []
    for name, unit in {moving_component.name: moving_component.unit for moving_component in moving}.items():
        selected = np.array([label == name for label in motions.labels], np.float64)
        mean = float(selected @ motions.mean)
        sigma = math.sqrt(max(float(selected @ motions.covariance @ selected), 0.0))
        decimals = decimals_for(sigma)
        ratio = abs(mean) / sigma if sigma else 0.0
        numbers = DecimalNumber(mean, decimals), DecimalNumber(sigma, decimals), DecimalNumber(ratio, 1)
        rows.append((ratio, [f"{name} [{unit}]", *numbers]))
    if not rows:
        return None
    best = [cells for _, cells in sorted(rows, key=lambda row: -row[0])[:MOST_MOTIONS]]
    caption = (
        f"The {len(best)} most significant of {len(rows)} motions at {minute_text(overview.time)} UTC, from all "
        "readings until then; twin.operate products writes all of them with their covariance."
    )
    heads = ("motion", "now", "σ", "value / σ")
    return Section("Motions of bodies", (), (Table("motions", "", caption, heads, best, within=""),), name="motions")


def _prediction_section(overview: Overview) -> Section:
    """Return the section on how well the predictions, made before each reading, agreed with the readings."""
    result = overview.filter_result
    rows: list[list[Cell]] = []
    for coverage in overview.coverages:
        if coverage.count:
            look = "text" if coverage.holds else "text wrong"
            interval = f"{100.0 * coverage.low:.1f} to {100.0 * coverage.high:.1f}"
            words = Marked("yes" if coverage.holds else "no", look=look, key=f"coverage {coverage.sigmas}")
            row: list[Cell] = [f"within {coverage.sigmas}σ", DecimalNumber(100.0 * coverage.expected, 2)]
            rows.append([*row, DecimalNumber(100.0 * coverage.share, 2), interval, coverage.count, words])
    confidence = f"{100.0 * CONFIDENCE:.0f} % confidence interval [%]"
    heads = ("components", "expected [%]", "observed [%]", confidence, "number", "consistent")
    caption = (
        "Each reading was predicted from all readings before it. Its normalised, independent components lie "
        "within 1 and 2σ as often as those of a normal distribution if the plan's disturbances are right; the "
        "confidence interval is the exact binomial one."
    )
    artefacts: list[Artefact] = []
    score = f"Mean log score per reading: {result.scores.log_score:.3f} (larger is better)."
    text = [score if result.scores.readings else "No reading has been predicted yet."]
    if result.innovations:
        above = sum(chi > limit_of(FALSE_ALARM, degrees) for _, chi, degrees in result.innovations)
        text.append(
            f"{above} of the last {len(result.innovations)} readings {'exceeds' if above == 1 else 'exceed'} the limit "
            f"of chi-square; {FALSE_ALARM * len(result.innovations):.1f} are expected by chance."
        )
        artefacts.append(_figure("innovations", "Innovations of the readings", innovations_svg(overview)))
    if rows:
        artefacts.append(Table("coverage", "Coverage so far", caption, heads, rows, within=""))
    return Section("Predictions", tuple(text), tuple(artefacts), name="predictions")


def _explained_sentence(overview: Overview) -> str:
    """Return the sentence on the share of the quantities' scatter that measured temperatures explain, or "".

    Readings of focus have none: their temperatures are inputs of the plan's terms.
    """
    known = {name: share for name, share in overview.filter_result.explained.items() if math.isfinite(share)}
    if not known or overview.operation.reading_kind == "focus":
        return ""
    any_of_them = not overview.filter_result.requirements
    parts = [
        f"{100.0 * known[quantity.name]:.0f} % for {name_of(quantity.name, overview.quantities)}"
        for quantity in overview.quantities
        if known.get(quantity.name, 0.0) >= 0.005 and (any_of_them or overview.required(quantity))
    ]
    if not parts:
        return "Temperatures explain none of the scatter of the required quantities"
    return f"Temperatures explain part of the scatter of the readings: {', '.join(parts[:MOST_EXPLAINED])}"


def _jump_section(overview: Overview) -> Section | None:
    """Return the section on detected jumps and events."""
    result = overview.filter_result
    heads = ("occurred before", "detected", "body", "best known motion", "change of the line of sight", *_JUMP_HEADS)
    digits = ("after", "until", "detected", "body", "motion", "size", "sigma", "unit", *_JUMP_HEADS)
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    for jump in sorted(result.jumps, key=lambda item: -item.until_us):
        label, unit, size, sigma = best_known_motion(jump)
        part, rivals = label.removeprefix(f"{jump.body} "), sorted(jump.rivals.items(), key=lambda item: -item[1])
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
            "readings. Its change of the line of sight is averaged over all bodies that can have jumped; others "
            "are listed with their log likelihood ratios. Times are UTC."
        )
        table = Table("jumps", "Detected jumps", "", digits, full, within="")
        artefacts.append(replace(_newest("jumps", table.title, caption, heads, rows), full=table))
    if events:
        artefacts.append(Text("events", "Events of the record", "", events[::-1][:MOST_SHOWN], within=""))
    words = () if artefacts else ("No jump was detected, and the record has no event.",)
    return Section("Jumps and events", words, tuple(artefacts), name="jumps")


def _newest(name: str, title: str, caption: str, heads: Sequence[str], rows: list[list[Cell]]) -> Table:
    """Return a table whose rows are the newest first: the report shows the first ones, a CSV has all."""
    if len(rows) <= MOST_SHOWN:
        return Table(name, title, caption, heads, rows, within="")
    full = Table(name, title, "", heads, rows, within="")
    caption = f"The newest {MOST_SHOWN} of {len(rows)}. {caption}".strip()
    return Table(name, title, caption, heads, rows[:MOST_SHOWN], within="", full=full)


def _sensor_section(overview: Overview) -> Section:
    """Return the section on the condition of the temperature sensors."""
    rows: list[list[Cell]] = [
        [
            sensor.body,
            Marked(sensor.state, look="text" if sensor.state == "ok" else "text wrong", key=f"sensor {sensor.body}"),
            minute_text(sensor.since_us),
            minute_text(sensor.last_us),
            sensor.reason or _NOT,
        ]
        for sensor in sorted(overview.filter_result.sensors, key=lambda sensor: (sensor.state == "ok", sensor.body))
    ]
    heads = ("body", "state", "since", "last reading", "reason")
    if not rows:
        return Section("Sensors", ("The record has no temperatures.",), name="sensors")
    caption = "Condition of the temperature sensors, judged from their readings; faulty ones first. Times are UTC."
    return Section("Sensors", (), (Table("sensors", "", caption, heads, rows, within=""),), name="sensors")


def _alarm_section(overview: Overview) -> Section:
    """Return the section on the alarms of the record and their acknowledgements."""
    if not overview.alarms:
        return Section("Alarms", ("No alarm has been raised.",), name="alarms")
    waiting = {id(alarm) for alarm in overview.open_alarms()}
    rows: list[list[Cell]] = []
    for row in sorted(overview.alarms, key=lambda row: (id(row) not in waiting, -int(row["time_us"]))):
        known = row["acknowledged"]
        who = "open" if known is None else _acknowledged_text(known)
        state = Marked(who, look="text wrong" if known is None else "text", key=f"alarm {row['id']}")
        rows.append([minute_text(int(row["time_us"])), str(row["kind"]).replace("_", " "), str(row["text"]), state])
    heads = ("time", "kind", "alarm", "acknowledged")
    words = f"{len(waiting)} of {len(overview.alarms)} alarms are open." if waiting else "All alarms are acknowledged."
    return Section("Alarms", (words,), (_newest("alarms", "", "Times are UTC.", heads, rows),), name="alarms")


def _acknowledged_text(ack: Mapping[str, Any]) -> str:
    """Return a text on the acknowledgement of an alarm: person, time and note."""
    note = f": {ack['note']}" if ack.get("note") else ""
    return f"{ack['by']}, {str(ack['acknowledged_utc'])[:16].replace('T', ' ')}{note}"


def _excluded_section(history: History, overview: Overview) -> Section:
    """Return the section on excluded readings and refusals."""
    rows: list[list[Cell]] = [
        [minute_text(time), kind, subject, reason]
        for time, kind, subject, reason in sorted(overview.filter_result.excluded, key=lambda entry: -entry[0])
    ]
    refused = [refusal for refusal in history.refusals() if not refusal["taken_since"]]
    artefacts: list[Artefact] = []
    if rows:
        caption = "In the record, but not used for the estimate. Times are UTC."
        artefacts.append(_newest("excluded", "Excluded readings", caption, ("time", "kind", "subject", "reason"), rows))
    if refused:
        refused_rows: list[list[Cell]] = []
        for entry in refused[::-1]:
            line = "" if entry["line"] is None else f":{entry['line']}"
            refused_rows.append([entry["refused_utc"], f"{entry['file']}{line}", entry["reason"]])
        caption = "Refused at the ingest of their files, and not in the record."
        artefacts.append(_newest("refused", "Refused", caption, ("refused [UTC]", "file", "reason"), refused_rows))
    words = () if artefacts else ("Nothing was excluded or refused.",)
    return Section("Excluded and refused", words, tuple(artefacts), name="excluded")


def _warnings(overview: Overview, end: int) -> tuple[str, ...]:
    """Return the warnings at the top of the report: doubtful estimate, old readings, open alarms, faulty sensors."""
    out = overview.filter_result.warnings
    age = (end - overview.time) / DAY
    if age > 1.0:
        out.append(f"the newest reading is {age:.0f} d older than the end of the day")
    waiting = overview.open_alarms()
    if waiting:
        count = "one alarm is open" if len(waiting) == 1 else f"{len(waiting)} alarms are open"
        out.append(f"{count}; the newest: {waiting[0]['text']}")
    bad = [sensor for sensor in overview.filter_result.sensors if sensor.state != "ok"]
    if bad:
        out.append("faulty sensors: " + ", ".join(f"{faulty.body} ({faulty.state})" for faulty in bad))
    return tuple(out)
