"""Overview of an instrument in operation, for the daily report.

It summarises the estimate of `twin.operate.estimate.operation_filter` and the alarms of the record in sentences and
table rows: whether the requirements are met, what changed, and how good the predictions were. Nothing is estimated
here. Single readings of the monitor are selected for the figures: the first, the last and evenly chosen ones.
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
from twin.operate.estimate.learned_model import moves_of
from twin.operate.estimate.reported_estimate import name_of, percent, with_current_interval, with_sigma
from twin.operate.record.entries import MICRO, utc_text
from twin.operate.record.history import History, content_of
from twin.operate.record.schema import ENTRY, SOURCE

if TYPE_CHECKING:
    from twin.operate.estimate.operation_filter import Operation
    from twin.operate.estimate.reported_estimate import Course, DetectedJump, FilterResult, RequirementStatus
    from twin.operate.record.history import History

_BATCH = 400
"""Number of rows in one query of the database."""


def _rows() -> Select[Any]:
    """Return the database query for readings, joined with the files they came from."""
    return select(*ENTRY.c, SOURCE.c.file).join(SOURCE, ENTRY.c.source_id == SOURCE.c.id)


def reading_span(history: History, kind: str = "monitor") -> tuple[int, int]:
    """Return the times of the first and the newest reading of a kind; 0 if there are none.

    Times are in microseconds of TAI since 2000.
    """
    query = select(func.min(ENTRY.c.time_us), func.max(ENTRY.c.time_us)).where(ENTRY.c.kind == kind)
    with history.reading() as connection:
        first, last = connection.execute(query).one()
    return int(first or 0), int(last or 0)


def readings(history: History, begin: int, end: int, most: int, kind: str = "monitor") -> list[dict[str, Any]]:
    """Return the readings of a kind in a time span, or ``most`` evenly chosen ones, in the order of time.

    Parameters
    ----------
    history : History
        Record of the instrument in operation.
    begin : int
        First time of the span, in microseconds of TAI since 2000.
    end : int
        Last time of the span, inclusive.
    most : int
        Largest number of readings.
    kind : str
        Kind of the readings: ``monitor`` or ``focus``.

    Returns
    -------
    list[dict[str, Any]]
        Rows as yielded by `History.entries`, with ``content`` as plain data.
    """
    c = ENTRY.c
    query = select(c.id).where(c.kind == kind, c.time_us >= begin, c.time_us <= end).order_by(c.time_us, c.id)
    with history.reading() as connection:
        ids = list(connection.execute(query).scalars())
        step = max(1, -(-len(ids) // most))
        chosen = ids[::-1][::step][::-1]  # the newest reading is always included
        rows: list[dict[str, Any]] = []
        for k in range(0, len(chosen), _BATCH):
            part = connection.execute(_rows().where(c.id.in_(chosen[k : k + _BATCH])).order_by(c.time_us, c.id))
            rows += map(dict, part.mappings())
    return [{**row, "content": content_of(row)} for row in rows]


DAY = 86_400 * MICRO
"""One day, in microseconds."""
CONFIDENCE = 0.95
"""Confidence level of the intervals given for the shares of readings within multiples of sigma."""
WITHIN: Mapping[int, float] = FrozenMap({k: float(2.0 * norm.cdf(k) - 1.0) for k in (1, 2)})
"""Multiple of sigma -> expected share of normally distributed components within it."""
_ESTIMATORS = ("posterior", "model")
"""Estimators whose values represent a single monitor reading in figures, in order of preference."""


def group_name(group: str) -> str:
    """Return the display name of a quantity's group (a camera, the intersection angle or the ground)."""
    return {ANGLE_GROUP: "angle between the cameras", GROUND_GROUP: "ground"}.get(group, group)


def day_text(time: int) -> str:
    """Return the UTC date of a time in microseconds of TAI since 2000."""
    return utc_text(time)[:10]


def minute_text(time: int) -> str:
    """Return the UTC date, hour and minute of a time in microseconds of TAI since 2000."""
    return utc_text(time)[:16].replace("T", " ")


@dataclass(frozen=True)
class Coverage:
    """Share of the readings' decorrelated components that lie within a multiple of sigma of their predictions.

    Attributes
    ----------
    sigmas : int
        Multiple of sigma, 1 or 2.
    expected : float
        Expected share, for normal errors.
    count : int
        Number of components.
    share : float
        Observed share; NaN without components.
    low : float
        Lower end of the Clopper-Pearson interval of the share at the level `CONFIDENCE`.
    high : float
        Upper end of this interval.
    """

    sigmas: int
    expected: float
    count: int
    share: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """True if the confidence interval of the share contains the expected share."""
        return self.count == 0 or self.low <= self.expected <= self.high


def coverage(sigmas: int, within: int, count: int) -> Coverage:
    """Return the share of components within a multiple of sigma, with its exact binomial interval.

    Parameters
    ----------
    sigmas : int
        Multiple of sigma, 1 or 2.
    within : int
        Number of components within it.
    count : int
        Number of all components.
    """
    low, high = proportion_interval(within, count, CONFIDENCE)
    return Coverage(sigmas, WITHIN[sigmas], count, within / count if count else math.nan, low, high)


@dataclass(frozen=True, eq=False)
class SingleReadings:
    """Values of single readings of the monitor.

    Array dimensions: N readings, Q quantities.

    Attributes
    ----------
    times : (N,) ndarray of int64
        Microseconds of TAI since 2000.
    values : (N, Q) ndarray
        Values in each quantity's unit; NaN where a reading lacks the quantity.
    sigmas : (N, Q) ndarray
        Standard deviations that the readings report, in the same units.
    """

    times: np.ndarray
    values: np.ndarray
    sigmas: np.ndarray


def single_readings(entries: Sequence[Mapping[str, Any]], quantities: Sequence[Quantity]) -> SingleReadings:
    """Return the quantities and sigmas estimated from single readings of the monitor, without the filter.

    Parameters
    ----------
    entries : Sequence[Mapping[str, Any]]
        Entries of kind ``monitor`` or ``focus``, with ``content`` as plain data.
    quantities : Sequence[Quantity]
        The Q quantities.
    """
    values = np.full((len(entries), len(quantities)), np.nan)
    sigmas = values.copy()
    for n, entry in enumerate(entries):
        if entry["kind"] == "focus":
            content, unit = entry["content"], quantities[0].parameter.per_si
            values[n, 0], sigmas[n, 0] = unit * content["values"][0], unit * content["sigma"]
            continue
        numbers = entry["content"]["numbers"]
        for q, quantity in enumerate(quantities):
            group = numbers.get("cameras", {}).get(quantity.group) or numbers.get(quantity.group) or {}
            reading: Mapping[str, float] = next((group[name] for name in _ESTIMATORS if name in group), {})
            if quantity.key in reading:
                values[n, q] = reading[quantity.key]
                sigmas[n, q] = reading.get(f"{quantity.key}_sigma", np.nan)
    return SingleReadings(np.array([entry["time_us"] for entry in entries], np.int64), values, sigmas)


def evenly_spaced(begin: int, end: int, count: int) -> np.ndarray:
    """Return at most ``count`` evenly spaced, distinct times from a beginning to an end, in microseconds."""
    return np.unique(np.linspace(begin, end, count).round().astype(np.int64))


@dataclass(frozen=True, eq=False)
class Occurrence:
    """Occurrence in an operation at a time: a jump, event, fault of a sensor, alarm or exclusion of a reading.

    Attributes
    ----------
    time : int
        Microseconds of TAI since 2000.
    kind : str
        ``jump``, ``event``, ``sensor``, ``alarm`` or ``excluded``.
    text : str
        Description.
    again : bool
        True if it duplicates another occurrence, as the alarm of a jump does.
    """

    time: int
    kind: str
    text: str
    again: bool = False


@dataclass(frozen=True, eq=False)
class Overview:
    """State of an operation, as input of its daily report.

    Attributes
    ----------
    operation : Operation
        Estimate of the record under its plan.
    filter_result : FilterResult
        Result of filtering all readings.
    alarms : tuple[Mapping[str, Any], ...]
        Alarms of the record, as `History.alarms` returns them.
    events : tuple[tuple[int, str, tuple[str, ...]], ...]
        (time_us, name, causes whose motions step) of all events of the record.
    begin : int
        Time of the first reading of the monitor, in microseconds of TAI since 2000.
    """

    operation: Operation
    filter_result: FilterResult
    alarms: tuple[Mapping[str, Any], ...]
    events: tuple[tuple[int, str, tuple[str, ...]], ...]
    begin: int

    @classmethod
    def of(cls, history: History, operation: Operation) -> Overview:
        """Return the overview of a record and its estimate after all readings."""
        known = operation.plan.operation.events
        dated = [(int(entry["time_us"]), str(entry["subject"])) for entry in history.entries("event")]
        dated += [(int(entry["time_us"]), "commanded_move") for entry in moves_of(history)]
        events = tuple((time, name, tuple(known.get(name, ()))) for time, name in sorted(dated))
        begin = reading_span(history, operation.reading_kind)[0]
        result = operation.filter_readings()
        alarms = tuple(with_current_interval(alarm, result.jumps) for alarm in history.alarms())
        return cls(operation, result, alarms, events, begin)

    @property
    def time(self) -> int:
        """Time of the newest entry used, in microseconds of TAI since 2000."""
        return self.filter_result.time

    @property
    def latest(self) -> int:
        """Time of the newest entry or event, in microseconds of TAI since 2000."""
        return max([self.time, *(time for time, *_ in self.events)])

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities that the operation estimates."""
        return tuple(self.operation.quantities)

    def required(self, quantity: Quantity) -> RequirementStatus | None:
        """Return the status of the requirement on a quantity; None without a requirement."""
        return next(
            (requirement for requirement in self.filter_result.requirements if requirement.quantity == quantity.name),
            None,
        )

    @property
    def horizon(self) -> int:
        """Horizon of the forecast, in microseconds."""
        return round(self.operation.plan.operation.horizon * MICRO)

    @property
    def coverages(self) -> tuple[Coverage, ...]:
        """Shares of the readings' components within 1 and 2 sigma of their predictions, with expected shares."""
        scores = self.filter_result.scores
        return (coverage(1, scores.within_one, scores.components), coverage(2, scores.within_two, scores.components))

    def occurrences(self) -> Iterator[Occurrence]:
        """Yield all occurrences (jumps, events, alarms and others), unordered; a jump at the time of its detection."""
        result = self.filter_result
        for jump in result.jumps:
            label, unit, size, sigma = best_known_motion(jump)
            text = f"a jump of {jump.body} between {minute_text(jump.after_us)} and {minute_text(jump.until_us)}"
            text += f": {label} {with_sigma(size, sigma, unit)}"
            yield Occurrence(jump.detected_us, "jump", text)
        for time, name, _ in self.events:
            yield Occurrence(time, "event", f"the event {name.replace('_', ' ')}")
        for sensor in result.sensors:
            if sensor.state != "ok":
                yield Occurrence(sensor.since_us, "sensor", f"the sensor of {sensor.body} is {sensor.state}")
        for alarm in self.alarms:
            # an alarm about the future was raised with the newest reading at the latest
            yield Occurrence(
                min(int(alarm["time_us"]), self.latest),
                "alarm",
                str(alarm["text"]),
                alarm["kind"] in ("jump", "sensor"),
            )
        for time, kind, subject, reason in result.excluded:
            yield Occurrence(time, "excluded", f"{kind} of {subject}: {reason}")

    def changed(self, begin: int, end: int) -> list[Occurrence]:
        """Return the occurrences from `begin` (inclusive) to `end` (exclusive), in the order of time."""
        occurrences = [occurrence for occurrence in self.occurrences() if begin <= occurrence.time < end]
        return sorted(occurrences, key=lambda event: event.time)

    def state_sentence(self) -> str:
        """Return the sentence on the requirements: whether they hold, and which is the most critical."""
        requirements = self.filter_result.requirements
        if not requirements:
            return "The plan states no requirement"
        broken = [requirement for requirement in requirements if not requirement.holds_now]
        worst = max(broken or requirements, key=self._urgency)
        which = f"{self._now(worst)}, limit {_limit(worst)} (exceeded with a probability of "
        which += f"{percent(worst.chance_now)}; {percent(1.0 - worst.probability)} is allowed)"
        if len(requirements) == 1:
            return f"The requirement {'does not hold' if broken else 'holds'}: {which}"
        if broken:
            verb = "does not hold:" if len(broken) == 1 else "do not hold; the worst:"
            return f"{len(broken)} of {len(requirements)} requirements {verb} {which}"
        count = "Both" if len(requirements) == 2 else f"All {len(requirements)}"
        return f"{count} requirements hold now; the most critical: {which}"

    def headline(self) -> tuple[str, ...]:
        """Return the sentences on requirements and alarms, the most urgent first.

        The first sentence is on a requirement that does not hold, otherwise on the next one to be violated, otherwise
        on alarms or on the requirements that hold. It includes the number of open alarms.
        """
        state, *breaks = (self.state_sentence(), *self.break_sentences())
        broken = any(not requirement.holds_now for requirement in self.filter_result.requirements)
        sentences = [state, *breaks] if broken or not breaks else [*breaks, state]
        if waiting := len(self.open_alarms()):
            count = f"{waiting} alarms are open" if waiting > 1 else "1 alarm is open"
            first = sentences[0]
            urgent = broken or bool(breaks)
            sentences[0] = f"{first}; {count}" if urgent else f"{count}; {first[0].lower()}{first[1:]}"
        return tuple(sentences)

    @property
    def unmet(self) -> bool:
        """True if a requirement does not hold or may be violated, or an alarm is open."""
        requirements = self.filter_result.requirements
        coming = any(not requirement.holds_now or requirement.breaks_us is not None for requirement in requirements)
        return coming or bool(self.open_alarms())

    def change_sentence(self, begin: int, end: int, when: str) -> str:
        """Return the sentence on the changes in a span, counted by kind.

        Parameters
        ----------
        begin : int
            Beginning of the span, in microseconds of TAI since 2000.
        end : int
            End of the span, exclusive.
        when : str
            Name of the span in the sentence.
        """
        occurrences = self.changed(begin, end)
        counts = {kind: sum(occurrence.kind == kind for occurrence in occurrences) for kind in _COUNTED}
        parts = [_count_text(n, *_COUNTED[kind]) for kind, n in counts.items() if n]
        if not parts:
            return f"Nothing happened {when}"
        text = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
        return f"{text[0].upper()}{text[1:]} {when}"

    def break_sentences(self) -> list[str]:
        """Return the sentences on requirements that may be violated within the horizon, the earliest first."""
        coming = [
            requirement
            for requirement in self.filter_result.requirements
            if requirement.holds_now and requirement.breaks_us is not None
        ]
        return [
            f"{_capital(self._name(status))} may violate its requirement of {_limit(status)} (probability above "
            f"{percent(1.0 - status.probability)}) from {day_text(status.breaks_us or 0)} on"
            for status in sorted(coming, key=lambda status: status.breaks_us or 0)
        ]

    def score_sentence(self) -> str:
        """Return the sentence on the shares of readings within one and two sigmas of their predictions."""
        inner, outer = self.coverages
        if not inner.count:
            return "No reading has been predicted yet"
        held = inner.holds and outer.holds
        return (
            f"{100.0 * inner.share:.1f} % of the {inner.count} components of "
            f"{self.filter_result.scores.readings} readings lie within 1σ of their predictions "
            f"and {100.0 * outer.share:.1f} % within 2σ, "
            f"{'consistent with' if held else 'different from'} the expected "
            f"{100.0 * inner.expected:.1f} and {100.0 * outer.expected:.1f} %"
        )

    def open_alarms(self) -> list[Mapping[str, Any]]:
        """Return the open alarms, the newest first."""
        alarms = [alarm for alarm in self.alarms if alarm["acknowledged"] is None]
        return sorted(alarms, key=lambda row: -int(row["time_us"]))

    def _urgency(self, requirement: RequirementStatus) -> tuple[float, float]:
        """Return the negative time at which a requirement may be violated, and the share of its limit in use.

        The share is the absolute change plus its sigma, over the limit.
        """
        breaks, q = requirement.breaks_us, self.quantities.index(self._quantity(requirement))
        now = self.filter_result.now
        used = (abs(float(now.values[0, q])) + float(now.sigmas[0, q])) / requirement.limit
        return -math.inf if breaks is None else -float(breaks), used

    def _name(self, requirement: RequirementStatus) -> str:
        return name_of(requirement.quantity, self.quantities)

    def _quantity(self, requirement: RequirementStatus) -> Quantity:
        return next(quantity for quantity in self.quantities if quantity.name == requirement.quantity)

    def _now(self, requirement: RequirementStatus) -> str:
        quantity, now = self._quantity(requirement), self.filter_result.now
        q = self.quantities.index(quantity)
        value = with_sigma(float(now.values[0, q]), float(now.sigmas[0, q]), quantity.parameter.unit)
        return f"{self._name(requirement)} is {value}"


_COUNTED: Mapping[str, tuple[str, str]] = FrozenMap(
    {
        "jump": ("one jump was detected", "{} jumps were detected"),
        "event": ("one event was recorded", "{} events were recorded"),
        "sensor": ("one sensor became unreliable", "{} sensors became unreliable"),
        "alarm": ("one alarm was raised", "{} alarms were raised"),
        "excluded": ("one reading was excluded", "{} readings were excluded"),
    }
)


def _count_text(count: int, singular: str, plural: str) -> str:
    return singular if count == 1 else plural.format(count)


def _capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


def _limit(requirement: RequirementStatus) -> str:
    """Return the limit of a requirement with its unit."""
    return f"{requirement.limit:g} {requirement.unit}"


def best_known_motion(jump: DetectedJump) -> tuple[str, str, float, float]:
    """Return name, unit, size and sigma of the motion of a jump with the largest ratio of size to sigma."""
    return max(jump.sizes, key=lambda size: abs(size[2]) / size[3] if size[3] > 0.0 else 0.0)


def line_change_text(overview: Overview, jump: DetectedJump) -> str:
    """Return a text on the change of the line of sight due to a jump; empty if it is unknown.

    It lists the quantities that have requirements, or all quantities if none has.
    """
    parts = []
    for quantity in overview.quantities:
        change = jump.line_changes.get(quantity.name)
        if change is not None and (overview.required(quantity) is not None or not overview.filter_result.requirements):
            _, changed, sigma = change
            if abs(changed) + sigma < SAME:  # the body does not belong to that camera
                continue
            name = name_of(quantity.name, overview.quantities)
            parts.append(f"{name} {with_sigma(changed, sigma, quantity.parameter.unit)}")
    return ", ".join(parts)


@dataclass(frozen=True, eq=False)
class Trend:
    """Time series of all quantities over a span.

    Attributes
    ----------
    past : Course
        Estimate from all readings, up to the newest.
    future : Course | None
        Forecast from there on; None if the span ends before.
    points : SingleReadings
        Single readings, a selection if there are too many.
    """

    past: Course
    future: Course | None
    points: SingleReadings


MOST_POINTS = 600
"""Largest number of single readings in a trend."""


def trend(history: History, overview: Overview, begin: int, end: int, count: int = 240) -> Trend:
    """Return the time series of all quantities over a span.

    Parameters
    ----------
    history : History
        Record of the instrument in operation.
    overview : Overview
        Overview of the record.
    begin : int
        Beginning of the span, in microseconds of TAI since 2000.
    end : int
        End of the span; times after the newest reading are forecast.
    count : int
        Largest number of times in the past, and in the future.
    """
    operation, now = overview.operation, overview.time
    edges = [t for jump in overview.filter_result.jumps for t in (jump.after_us, jump.until_us)]
    edges += [t for time, *_ in overview.events for t in (time - 1, time)]
    last = min(end, now)
    edge_times = [t for t in edges if begin <= t <= last]
    past = operation.smoothed(
        np.unique(np.concatenate([evenly_spaced(begin, last, count), np.array(edge_times, np.int64)]))
    )
    if past.times[-1] == now:  # use the same present values as the rest of the report
        current = overview.filter_result.now
        parts = ("values", "sigmas", "changes", "covariance")
        joined: dict[str, Any] = {
            part: np.concatenate([getattr(past, part)[:-1], getattr(current, part)]) for part in parts
        }
        past = replace(past, **joined)
    future = operation.forecast(evenly_spaced(now, end, count)) if end > now else None
    shown = readings(history, begin, last, MOST_POINTS, overview.operation.reading_kind)
    return Trend(past, future, single_readings(shown, overview.quantities))
