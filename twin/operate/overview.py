"""What readers are told of an instrument in operation, for the daily report.

An overview takes the estimate as `twin.operate.estimate.operation_filter` gives it, with the alarms of the record, and
says in words and rows what holds, what changed and whether predictions came true. Nothing is estimated here.

Return single readings of the monitor as the report shows them: the first and last times, and evenly chosen ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import norm
from sqlalchemy import Select, func, select

from analysis.monitor.limits import Quantity
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from analysis.statistics import proportion_interval
from optics.numerics.number_tree import FrozenMap
from twin.framework.artefact import SAME
from twin.operate.estimate.reported_estimate import name_of, percent, with_sigma
from twin.operate.record.entries import MICRO, utc_text
from twin.operate.record.history import History, content_of
from twin.operate.record.schema import ENTRY, SOURCE

if TYPE_CHECKING:
    from twin.operate.estimate.operation_filter import Operation
    from twin.operate.estimate.reported_estimate import Course, DetectedJump, FilterResult, RequirementStatus
    from twin.operate.record.history import History

KIND = "monitor"
_BATCH = 400
"""Rows asked for at once."""


def _rows() -> Select[Any]:
    return select(*ENTRY.c, SOURCE.c.file).join(SOURCE, ENTRY.c.source_id == SOURCE.c.id).where(ENTRY.c.kind == KIND)


def span_of(history: History) -> tuple[int, int]:
    """Times of the first and the newest reading of the monitor, microseconds of TAI since 2000; 0 without any."""
    query = select(func.min(ENTRY.c.time_us), func.max(ENTRY.c.time_us)).where(ENTRY.c.kind == KIND)
    with history.reading() as connection:
        first, last = connection.execute(query).one()
    return int(first or 0), int(last or 0)


def readings(history: History, begin: int, end: int, most: int) -> list[dict[str, Any]]:
    """Readings of the monitor in a span, in the order of time; evenly chosen if there are more than ``most``.

    Parameters
    ----------
    history : History
        The record.
    begin : int
        Microseconds of TAI since 2000.
    end : int
        Likewise; both ends belong to the span.
    most : int
        readings.

    Returns
    -------
    list[dict[str, Any]]
        Rows as `History.entries` yields them, with ``content`` as plain data.
    """
    c = ENTRY.c
    query = select(c.id).where(c.kind == KIND, c.time_us >= begin, c.time_us <= end).order_by(c.time_us, c.id)
    with history.reading() as connection:
        found = list(connection.execute(query).scalars())
        step = max(1, -(-len(found) // most))
        chosen = found[::-1][::step][::-1]  # the newest is always among them
        rows: list[dict[str, Any]] = []
        for k in range(0, len(chosen), _BATCH):
            part = connection.execute(_rows().where(c.id.in_(chosen[k : k + _BATCH])).order_by(c.time_us, c.id))
            rows += map(dict, part.mappings())
    return [{**row, "content": content_of(row)} for row in rows]


DAY = 86_400 * MICRO
"""Microseconds."""
CONFIDENCE = 0.95
"""Of the intervals within which shares of predictions are known."""
WITHIN: Mapping[int, float] = FrozenMap({k: float(2.0 * norm.cdf(k) - 1.0) for k in (1, 2)})
"""Sigmas -> share of components that lie within, where predictions are right."""
_ESTIMATORS = ("posterior", "model")
"""By which a single reading is shown, the first that it has."""


def group_name(group: str) -> str:
    """Of what a quantity is, in words."""
    return {ANGLE_GROUP: "angle between the cameras", GROUND_GROUP: "ground"}.get(group, group)


def day_text(time: int) -> str:
    """UTC date of a time in microseconds of TAI since 2000."""
    return utc_text(time)[:10]


def minute_text(time: int) -> str:
    """UTC date, hour and minute."""
    return utc_text(time)[:16].replace("T", " ")


@dataclass(frozen=True)
class Coverage:
    """How many components of readings lay within so many sigmas of their predictions.

    Attributes
    ----------
    sigmas : int
        1 or 2.
    expected : float
        Share where predictions are right.
    count : int
        components.
    share : float
        Of them within; NaN without any.
    low : float
        End of the interval within which the share is known with `CONFIDENCE`, of Clopper and Pearson.
    high : float
        Its other end.
    """

    sigmas: int
    expected: float
    count: int
    share: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether the share that is expected lies in the interval."""
        return self.count == 0 or self.low <= self.expected <= self.high


def coverage(sigmas: int, within: int, count: int) -> Coverage:
    """The share of components within so many sigmas, with its exact binomial interval.

    Parameters
    ----------
    sigmas : int
        1 or 2.
    within : int
        Components that lay within.
    count : int
        All components.
    """
    low, high = proportion_interval(within, count, CONFIDENCE)
    return Coverage(sigmas, WITHIN[sigmas], count, within / count if count else math.nan, low, high)


@dataclass(frozen=True, eq=False)
class SingleReadings:
    """What single readings say of the quantities, each by itself.

    Attributes
    ----------
    times : np.ndarray
        (N,) microseconds of TAI since 2000.
    values : np.ndarray
        (N, Q) in each quantity's unit; NaN where a reading does not have it.
    sigmas : np.ndarray
        (N, Q) standard deviations that the readings state, likewise.
    """

    times: np.ndarray
    values: np.ndarray
    sigmas: np.ndarray


def single_readings(entries: Sequence[Mapping[str, Any]], quantities: Sequence[Quantity]) -> SingleReadings:
    """Readings of the monitor as points.

    Parameters
    ----------
    entries : Sequence[Mapping[str, Any]]
        Of kind ``monitor``, with ``content`` as plain data.
    quantities : Sequence[Quantity]
        Q of them.
    """
    values = np.full((len(entries), len(quantities)), np.nan)
    sigmas = values.copy()
    for n, entry in enumerate(entries):
        numbers = entry["content"]["numbers"]
        for q, quantity in enumerate(quantities):
            of = numbers.get("cameras", {}).get(quantity.group) or numbers.get(quantity.group) or {}
            read: Mapping[str, float] = next((of[name] for name in _ESTIMATORS if name in of), {})
            if quantity.key in read:
                values[n, q] = read[quantity.key]
                sigmas[n, q] = read.get(f"{quantity.key}_sigma", np.nan)
    return SingleReadings(np.array([entry["time_us"] for entry in entries], np.int64), values, sigmas)


def spread(begin: int, end: int, count: int) -> np.ndarray:
    """Evenly spread times from a beginning to an end, microseconds, at most ``count`` of them and each once."""
    return np.unique(np.linspace(begin, end, count).round().astype(np.int64))


@dataclass(frozen=True, eq=False)
class Occurrence:
    """Something that happened at a time.

    Attributes
    ----------
    time : int
        Microseconds of TAI since 2000.
    kind : str
        ``jump``, ``event``, ``sensor``, ``alarm`` or ``left out``.
    text : str
        what.
    again : bool
        Whether another one says the same, as of a jump and of its alarm.
    """

    time: int
    kind: str
    text: str
    again: bool = False


@dataclass(frozen=True, eq=False)
class Overview:
    """The state of an operation as readers are told it.

    Attributes
    ----------
    operation : Operation
        The estimate.
    following : Following
        What it says now.
    alarms : tuple[Mapping[str, Any], ...]
        Of the record, as `History.alarms` tells them.
    events : tuple[tuple[int, str, tuple[str, ...]], ...]
        All of the record, (time_us, name, causes that may have stepped then).
    begin : int
        Time of the first reading of the monitor, microseconds of TAI since 2000.
    """

    operation: Operation
    filter_result: FilterResult
    alarms: tuple[Mapping[str, Any], ...]
    events: tuple[tuple[int, str, tuple[str, ...]], ...]
    begin: int

    @classmethod
    def of(cls, history: History, operation: Operation) -> Overview:
        """The state after all readings of the record."""
        known = operation.plan.operation.events
        found = ((int(entry["time_us"]), str(entry["subject"])) for entry in history.entries("event"))
        events = tuple((time, name, tuple(known.get(name, ()))) for time, name in found)
        return cls(operation, operation.filter_readings(), tuple(history.alarms()), events, span_of(history)[0])

    @property
    def time(self) -> int:
        """Of the newest entry that was used, microseconds of TAI since 2000."""
        return self.filter_result.time

    @property
    def latest(self) -> int:
        """Of the newest entry or event."""
        return max([self.time, *(time for time, *_ in self.events)])

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What is estimated."""
        return tuple(self.operation.quantities)

    def required(self, quantity: Quantity) -> RequirementStatus | None:
        """The requirement on a quantity with what is known of it; None where nothing is required."""
        return next(
            (requirement for requirement in self.filter_result.requirements if requirement.quantity == quantity.name),
            None,
        )

    @property
    def horizon(self) -> int:
        """Of the forecast, microseconds."""
        return round(self.operation.plan.operation.horizon * MICRO)

    @property
    def coverages(self) -> tuple[Coverage, ...]:
        """Whether predictions came true, within 1 and 2 sigma."""
        scores = self.filter_result.scores
        return (coverage(1, scores.within_one, scores.components), coverage(2, scores.within_two, scores.components))

    def occurrences(self) -> Iterator[Occurrence]:
        """All that happened, in no order: jumps at the end of the interval in which they came."""
        told = self.filter_result
        for jump in told.jumps:
            label, unit, size, sigma = best_known_motion(jump)
            text = f"a jump of {jump.body} between {minute_text(jump.after_us)} and {minute_text(jump.until_us)}"
            text += f": {label} {with_sigma(size, sigma, unit)}"
            yield Occurrence(jump.detected_us, "jump", text)
        for time, name, _ in self.events:
            yield Occurrence(time, "event", f"the event {name.replace('_', ' ')}")
        for sensor in told.sensors:
            if sensor.state != "ok":
                yield Occurrence(sensor.since_us, "sensor", f"the sensor of {sensor.body} is {sensor.state}")
        for alarm in self.alarms:
            # one of what is still to come was raised with the newest reading at the latest
            yield Occurrence(
                min(int(alarm["time_us"]), self.latest),
                "alarm",
                str(alarm["text"]),
                alarm["kind"] in ("jump", "sensor"),
            )
        for time, kind, subject, reason in told.excluded:
            yield Occurrence(time, "left out", f"{kind} of {subject}: {reason}")

    def changed(self, begin: int, end: int) -> list[Occurrence]:
        """What happened from a time on and before another one, in the order of time."""
        found = [occurrence for occurrence in self.occurrences() if begin <= occurrence.time < end]
        return sorted(found, key=lambda one: one.time)

    def state_sentence(self) -> str:
        """Whether the requirements hold, and which is the least sure."""
        requirements = self.filter_result.requirements
        if not requirements:
            return "The plan states no requirement"
        broken = [requirement for requirement in requirements if not requirement.holds_now]
        worst = max(requirements, key=lambda one: one.chance_now / (1.0 - one.probability))
        which = f"{self._now(worst)}, limit {_limit(worst)} (beyond it with a chance of {percent(worst.chance_now)}; "
        which += f"{percent(1.0 - worst.probability)} is allowed)"
        if len(requirements) == 1:
            return f"The requirement {'does not hold' if broken else 'holds'}: {which}"
        if broken:
            verb, link = ("does", "") if len(broken) == 1 else ("do", "the worst: ")
            return f"{len(broken)} of {len(requirements)} requirements {verb} not hold: {link}{which}"
        return f"All {len(requirements)} requirements hold; the least sure: {which}"

    def change_sentence(self, begin: int, end: int, when: str) -> str:
        """What changed in a span, counted by sort.

        Parameters
        ----------
        begin : int
            Of the span, microseconds of TAI since 2000.
        end : int
            Which does not belong to it.
        when : str
            How the sentence calls it.
        """
        found = self.changed(begin, end)
        counts = {kind: sum(one.kind == kind for one in found) for kind in _COUNTED}
        parts = [_counted(n, *_COUNTED[kind]) for kind, n in counts.items() if n]
        if not parts:
            return f"Nothing happened {when}"
        text = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
        return f"{text[0].upper()}{text[1:]} {when}"

    def break_sentences(self) -> list[str]:
        """Which requirements are expected to break, the first to break first."""
        coming = [
            requirement
            for requirement in self.filter_result.requirements
            if requirement.holds_now and requirement.breaks_us is not None
        ]
        return [
            f"{_capital(self._name(one))} is expected to break its requirement of {_limit(one)} on "
            f"{day_text(one.breaks_us or 0)}"
            for one in sorted(coming, key=lambda one: one.breaks_us or 0)
        ]

    def score_sentence(self) -> str:
        """Whether predictions have come true so far."""
        one, two = self.coverages
        if not one.count:
            return "No reading has been predicted yet"
        held = one.holds and two.holds
        return (
            f"Of {one.count} components of {self.filter_result.scores.readings} readings, each predicted before it came, "
            f"{100.0 * one.share:.1f} % lay within 1σ and {100.0 * two.share:.1f} % within 2σ, "
            f"{'as' if held else 'other than'} predictions of the right size have it "
            f"({100.0 * one.expected:.1f} and {100.0 * two.expected:.1f} %)"
        )

    def open_alarms(self) -> list[Mapping[str, Any]]:
        """Alarms that nobody has acknowledged, the newest first."""
        found = [alarm for alarm in self.alarms if alarm["acknowledged"] is None]
        return sorted(found, key=lambda one: -int(one["time_us"]))

    def _name(self, one: RequirementStatus) -> str:
        return name_of(one.quantity, self.quantities)

    def _quantity(self, one: RequirementStatus) -> Quantity:
        return next(quantity for quantity in self.quantities if quantity.name == one.quantity)

    def _now(self, one: RequirementStatus) -> str:
        quantity, now = self._quantity(one), self.filter_result.now
        q = self.quantities.index(quantity)
        value = with_sigma(float(now.values[0, q]), float(now.sigmas[0, q]), quantity.parameter.unit)
        return f"{self._name(one)} is {value}"


_COUNTED: Mapping[str, tuple[str, str]] = FrozenMap(
    {
        "jump": ("one jump was found", "{} jumps were found"),
        "event": ("one event was recorded", "{} events were recorded"),
        "sensor": ("one sensor turned doubtful", "{} sensors turned doubtful"),
        "alarm": ("one alarm was raised", "{} alarms were raised"),
        "left out": ("one reading was left out", "{} readings were left out"),
    }
)


def _counted(count: int, one: str, many: str) -> str:
    return one if count == 1 else many.format(count)


def _capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


def _limit(one: RequirementStatus) -> str:
    """The limit with its unit."""
    return f"{one.limit:g} {one.unit}"


def best_known_motion(jump: DetectedJump) -> tuple[str, str, float, float]:
    """The motion of a jump that is known best: its name, unit, size and sigma."""
    return max(jump.sizes, key=lambda one: abs(one[2]) / one[3] if one[3] > 0.0 else 0.0)


def line_change_text(overview: Overview, jump: DetectedJump) -> str:
    """What a jump did to the line, of what is required; of all where nothing is; empty where nothing is told of it."""
    parts = []
    for quantity in overview.quantities:
        told = jump.line_changes.get(quantity.name)
        if told is not None and (overview.required(quantity) is not None or not overview.filter_result.requirements):
            _, changed, sigma = told
            if abs(changed) + sigma < SAME:  # the body is none of that camera
                continue
            name = name_of(quantity.name, overview.quantities)
            parts.append(f"{name} {with_sigma(changed, sigma, quantity.parameter.unit)}")
    return ", ".join(parts)


@dataclass(frozen=True, eq=False)
class Trend:
    """The course of all quantities over a span.

    Attributes
    ----------
    past : Course
        With all readings, up to the newest.
    future : Course | None
        Forecast from there; None where the span ends before.
    points : Points
        Single readings, some of them where there are too many.
    """

    past: Course
    future: Course | None
    points: SingleReadings


MOST_POINTS = 600
"""Single readings of a trend."""


def trend(history: History, overview: Overview, begin: int, end: int, count: int = 240) -> Trend:
    """The course over a span.

    Parameters
    ----------
    history : History
        The record.
    overview : Overview
        Of it.
    begin : int
        Microseconds of TAI since 2000.
    end : int
        Likewise; what lies after the newest reading is forecast.
    count : int
        Times at most, of past and future each.
    """
    operation, now = overview.operation, overview.time
    edges = [t for jump in overview.filter_result.jumps for t in (jump.after_us, jump.until_us)]
    edges += [t for time, *_ in overview.events for t in (time - 1, time)]
    last = min(end, now)
    own = [t for t in edges if begin <= t <= last]
    past = operation.smoothed(np.unique(np.concatenate([spread(begin, last, count), np.array(own, np.int64)])))
    if past.times[-1] == now:  # as all that is told of now and later
        current = overview.filter_result.now
        parts = ("values", "sigmas", "changes", "covariance")
        joined: dict[str, Any] = {
            part: np.concatenate([getattr(past, part)[:-1], getattr(current, part)]) for part in parts
        }
        past = replace(past, **joined)
    future = operation.forecast(spread(now, end, count)) if end > now else None
    return Trend(past, future, single_readings(readings(history, begin, last, MOST_POINTS), overview.quantities))
