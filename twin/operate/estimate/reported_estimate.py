"""Reported estimate of an instrument in operation: values with sigmas over time, jumps, sensors and alarms.

An alarm reports that a requirement is or was violated or may be, that a body jumped, that a sensor fails, or that
readings contradict the prior. Each alarm is raised once, and stays open in the record until somebody acknowledges it. A
continuing condition, such as a requirement that stays violated, is not raised again while its alarm is open, nor within
a month of an acknowledged alarm.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from analysis.arrays import Array
from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.limits import Quantity
from analysis.monitor.parameters import ANGLE_GROUP, FOCUS, GROUND_GROUP
from analysis.statistics import limit_of, p_value_of
from scenes.specs.operation import OperationSpec
from twin.framework.artefact import decimals_for, fixed, plain
from twin.operate.estimate.estimate_snapshot import SAME_SPAN, SPANS, Scores, Violation
from twin.operate.estimate.learned_model import LearnedTerm
from twin.operate.record.entries import MICRO, Alarm, utc_text
from twin.operate.record.history import History

MOST_BAD = 2
"""Largest number of outliers among the latest 200 readings without a warning.

By chance, three of 200 are rejected with a probability of 0.001.
"""


@dataclass(frozen=True, eq=False)
class Course:
    """Estimate of all quantities, with standard deviations, at T times.

    Attributes
    ----------
    times : (T,) ndarray of int64
        Microseconds of TAI since 2000.
    quantities : tuple[Quantity, ...]
        The Q estimated quantities.
    values : (T, Q) ndarray
        Changes since the calibration, each in its quantity's unit.
    sigmas : (T, Q) ndarray
        Total standard deviations of the values.
    changes : (T, 4 K) ndarray
        Rotations d_alpha, d_beta, d_gamma (rad) and changes d_f of the principal distance (m) of K cameras, one camera
        after the other.
    covariance : (T, 4 K, 4 K) ndarray
        Covariance of the errors of `changes`.
    """

    times: NDArray[np.int64]
    quantities: tuple[Quantity, ...]
    values: Array
    sigmas: Array
    changes: Array
    covariance: Array

    @property
    def utc(self) -> tuple[str, ...]:
        """Times of the estimate in UTC, ISO 8601 texts."""
        return tuple(utc_text(int(time)) for time in self.times)

    def number(self, name: str) -> int:
        """Return the index of the quantity with a name, "group key"."""
        return [quantity.name for quantity in self.quantities].index(name)

    def exceedance(self, name: str, limit: float) -> Array:
        """Return the probability that the absolute change of a quantity exceeds a limit in its unit, (T,)."""
        k = self.number(name)
        return beyond(self.values[:, k], self.sigmas[:, k], limit)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data: group -> key -> values at all times, with the sigmas beside them."""
        out: dict[str, Any] = {"times_utc": list(self.utc)}
        for k, quantity in enumerate(self.quantities):
            group = out.setdefault(quantity.group, {})
            group |= {quantity.key: self.values[:, k].tolist(), f"{quantity.key}_sigma": self.sigmas[:, k].tolist()}
        return out


class _Dated:
    """Base of data classes whose times (fields ``..._us``, microseconds) become UTC texts in plain data."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain data, times as UTC."""
        out = vars(self).copy()
        for key in [name for name in out if name.endswith("_us")]:
            time = out.pop(key)
            out[f"{key.removesuffix('us')}utc"] = None if time is None else utc_text(time)
        return out


@dataclass(frozen=True)
class DetectedJump(_Dated):
    """Jump (sudden motion) of one body that was detected in the readings.

    Attributes
    ----------
    body : str
        Body that explains the jump best.
    after_us, until_us : int
        Times of the readings between which it occurred, in microseconds of TAI since 2000.
    detected_us : int
        Time of the reading at which it was detected.
    sizes : tuple[tuple[str, str, float, float], ...]
        (motion, unit, size, sigma) of every motion of the body.
    log_ratio : float
        Log likelihood ratio of the readings with and without the jump, when it was detected.
    false_alarm : float
        Upper bound of the probability that so large a ratio occurs at any time in a mission without jumps.
    rivals : Mapping[str, float]
        Other bodies that could have jumped -> log likelihood ratio of a jump of that body.
    line_changes : Mapping[str, tuple[float, float, float]]
        Quantity -> (read, changed, sigma) in the quantity's unit: the change that the spots indicate if every camera
        moves as a whole; the estimated change of the line of sight, averaged over the bodies that can have jumped; and
        its standard deviation. The first two differ because a part can affect the spots more than the line of sight.
    """

    body: str
    after_us: int
    until_us: int
    detected_us: int
    sizes: tuple[tuple[str, str, float, float], ...]
    log_ratio: float
    false_alarm: float
    rivals: Mapping[str, float]
    line_changes: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    @property
    def summary(self) -> str:
        """Time and size of the jump, in words."""
        sizes = (f"{n.removeprefix(f'{self.body} ')} {with_sigma(z, s, u, sign=True)}" for n, u, z, s in self.sizes)
        return f"between {utc_text(self.after_us)} and {utc_text(self.until_us)}: {', '.join(sizes)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the jump's body, times, sizes and effects as plain data, times as UTC."""
        return {
            **super().to_dict(),
            "sizes": [{"name": n, "unit": u, "size": z, "sigma": s} for n, u, z, s in self.sizes],
            "rivals": [{"body": body, "log_ratio": ratio} for body, ratio in self.rivals.items()],
            "carried": [
                {
                    "quantity": name,
                    "read": read,
                    "changed": changed,
                    "sigma": sigma,
                    "share": shown,
                    "share_sigma": wide,
                }
                for name, (read, changed, sigma) in self.line_changes.items()
                for shown, wide in [(changed / read, sigma / abs(read)) if read else (None, None)]
            ],
        }


@dataclass(frozen=True)
class SensorState(_Dated):
    """Condition of a temperature sensor.

    Attributes
    ----------
    body : str
        Path of the body that carries the sensor.
    state : str
        ``ok``, ``dead``, ``stuck`` or ``doubtful``.
    since_us : int
        Time since which it is in this condition, in microseconds of TAI since 2000.
    last_us : int
        Time of its newest reading.
    reason : str
        Reason as text; empty if the state is ``ok``.
    """

    body: str
    state: str
    since_us: int
    last_us: int
    reason: str


@dataclass(frozen=True)
class RequirementStatus(_Dated):
    """Status of a requirement of the plan: limit of a quantity's change, and probability of exceeding it.

    Attributes
    ----------
    quantity : str
        Group and key of the quantity.
    unit : str
        Unit of the limit.
    limit : float
        Limit of the absolute change.
    probability : float
        Required probability that the change is within the limit.
    chance_now : float
        Probability that the limit is exceeded now.
    holds_now : bool
        True if the requirement is met now.
    breaks_us : int | None
        First time within the horizon of the forecast at which it is violated, in microseconds of TAI since 2000; None
        if it is always met.
    """

    quantity: str
    unit: str
    limit: float
    probability: float
    chance_now: float
    holds_now: bool
    breaks_us: int | None


@dataclass(frozen=True, eq=False)
class Motions:
    """Estimate of all M motions specified in the disturbances, at one time.

    Attributes
    ----------
    time : int
        Microseconds of TAI since 2000.
    labels : tuple[str, ...]
        Names of the motions.
    units : tuple[str, ...]
        Unit of each motion.
    mean : (M,) ndarray
        Estimated amounts in these units.
    covariance : (M, M) ndarray
        Covariance of their errors.
    """

    time: int
    labels: tuple[str, ...]
    units: tuple[str, ...]
    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class FilterResult:
    """Result of filtering all readings of a record.

    Attributes
    ----------
    time : int
        Time of the newest entry used, in microseconds of TAI since 2000.
    readings : int
        Number of readings of the monitor that were used.
    now : Course
        Estimate at that time.
    scores : Scores
        Quality of the predictions of the readings.
    innovations : tuple[tuple[int, float, int], ...]
        (time_us, chi-square, degrees of freedom) of the latest readings' innovations (reading minus prediction).
    jumps : tuple[DetectedJump, ...]
        Detected jumps.
    events : tuple[tuple[int, str, tuple[str, ...]], ...]
        (time_us, name, causes whose motions stepped) of the events.
    sensors : tuple[SensorState, ...]
        Condition of the temperature sensors.
    excluded : tuple[tuple[int, str, str, str], ...]
        (time_us, kind, subject, reason) of the latest entries that were not used.
    explained : Mapping[str, float]
        Quantity -> share of its variance over the readings that measured temperatures explain.
    sigma_inflation : float
        Factor by which present sigmas are inflated because the latest readings contradict the prior; 1 if they do not.
    too_many_jumps : bool
        True if significantly more jumps were detected than the plan specifies.
    requirements : tuple[RequirementStatus, ...]
        Status of the plan's requirements.
    bad_readings : tuple[tuple[int, str], ...]
        (time_us, reason) of the latest readings of the monitor that were rejected as outliers.
    undecided : bool
        True if the newest rejected reading may be the first one after a jump; the sigmas then include both cases.
    understated_causes : tuple[str, ...]
        Causes of the prior with which the sensors of several bodies jointly disagree.
    violations : tuple[Violation, ...]
        Spans of readings at which a requirement was violated, past ones and those that last.
    terms : tuple[LearnedTerm, ...]
        Learned terms of the plan, and commanded moves of the record.
    """

    time: int
    readings: int
    now: Course
    scores: Scores
    innovations: tuple[tuple[int, float, int], ...]
    jumps: tuple[DetectedJump, ...]
    events: tuple[tuple[int, str, tuple[str, ...]], ...]
    sensors: tuple[SensorState, ...]
    excluded: tuple[tuple[int, str, str, str], ...]
    explained: Mapping[str, float]
    sigma_inflation: float
    too_many_jumps: bool
    requirements: tuple[RequirementStatus, ...]
    bad_readings: tuple[tuple[int, str], ...] = ()
    undecided: bool = False
    understated_causes: tuple[str, ...] = ()
    violations: tuple[Violation, ...] = ()
    terms: tuple[LearnedTerm, ...] = ()

    @property
    def readings_text(self) -> str:
        """Number of readings of the monitor that were used, and whether the newest one is undecided, as text."""
        what = "focus" if any(quantity.parameter is FOCUS for quantity in self.now.quantities) else "the monitor"
        text = f"1 reading of {what}" if self.readings == 1 else f"{self.readings} readings of {what}"
        return f"{text} (and a newer one that may be an outlier)" if self.undecided else text

    @property
    def warnings(self) -> list[str]:
        """Warnings about the reliability of the estimate, one sentence each."""
        out = []
        if self.sigma_inflation > 1.0:
            text = f"all sigmas are inflated by a factor of {self.sigma_inflation:.3g}"
            out.append(f"the first or the latest readings contradict the prior; {text}")
        if self.too_many_jumps:
            out.append(f"{len(self.jumps)} jumps are more than the plan states: other motions, or larger ones, occur")
        if self.undecided:
            out.append(
                f"the newest reading may be an outlier: {self.bad_readings[-1][1]}; until then sigmas allow for both"
            )
        if len(self.bad_readings) > MOST_BAD:
            text = "either the readings are worse than usual, or the prior is too small"
            out.append(f"{len(self.bad_readings)} readings were rejected as outliers: {text}")
        if self.understated_causes:
            text = "their sigmas in the prior are too small or their time laws are wrong, and no sigma holds"
            out.append(f"sensors of several bodies jointly disagree with {', '.join(self.understated_causes)}: {text}")
        return [*out, *(term.warning for term in self.terms if term.warning)]

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate with jumps, sensors, requirements and warnings as plain data for JSON."""
        return {
            "time_utc": utc_text(self.time),
            "readings": self.readings,
            "agrees": not self.warnings,
            "warnings": self.warnings,
            "now": self.now.to_dict(),
            "scores": vars(self.scores),
            "innovations": _rows("chi_square degrees_of_freedom", self.innovations),
            "jumps": [jump.to_dict() for jump in self.jumps],
            "events": _rows("name causes", self.events),
            "sensors": [sensor.to_dict() for sensor in self.sensors],
            "excluded": _rows("kind subject reason", self.excluded),
            "explained": {name: share if np.isfinite(share) else None for name, share in self.explained.items()},
            "widened": self.sigma_inflation,
            "too_many_jumps": self.too_many_jumps,
            "bad_readings": _rows("reason", self.bad_readings),
            "undecided": self.undecided,
            "understated_causes": list(self.understated_causes),
            "requirements": [requirement.to_dict() for requirement in self.requirements],
            **({"terms": [vars(term) for term in self.terms]} if self.terms else {}),
        }


def _rows(keys: str, rows: Sequence[tuple[Any, ...]]) -> list[dict[str, Any]]:
    """Return tuples, each beginning with a time, as a list of mappings with the given keys, times as UTC."""
    return [dict(zip(("time_utc", *keys.split()), (utc_text(t), *rest), strict=True)) for t, *rest in rows]


def beyond(value: Array, sigma: Array, limit: float) -> Array:
    """Return the probability that the absolute value of a normal quantity exceeds a limit.

    Parameters
    ----------
    value : ndarray
        Mean of the quantity.
    sigma : ndarray
        Standard deviation of the quantity, of the same shape.
    limit : float
        Limit in the same unit.
    """
    scale = np.where(sigma > 0.0, sigma, 1e-300)
    return np.asarray(ndtr((value - limit) / scale) + ndtr((-value - limit) / scale))


def inflation_factors(
    squares: Array, now: Sequence[int] | NDArray[np.intp], centred: bool, lasting: Sequence[tuple[int, Array]] = ()
) -> Array:
    """Return the factors (T,) by which sigmas at T times are enlarged because readings contradict the prior.

    The factor is the root of the innovations' chi-square divided by its degrees of freedom, of the last reading or of
    several consecutive ones, whichever is larger; it is 1 if chance explains them. A contradiction of the first
    readings, or one after a jump, affects all later factors, because the unobservable part of the state depends on it.

    Array dimensions: T times, N readings, n readings after the beginning of a permanent contradiction.

    Parameters
    ----------
    squares : (N, 2) ndarray
        Chi-square and degrees of freedom of the innovation (reading minus prediction) of each reading, in the order of
        time.
    now : (T,) sequence of int
        Number of readings up to each time.
    centred : bool
        True if readings after the time are used as well as those before it.
    lasting : Sequence[tuple[int, ndarray]]
        Permanent contradictions: number of readings after which each applies, and an (n, 2) array of n readings in the
        form of `squares`.
    """
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(squares, axis=0)])
    out, number = np.ones(len(now)), np.asarray(now, int)

    def wider(square: Array, degrees: Array) -> Array:
        known = degrees > 0.0
        limit = limit_of(FALSE_ALARM / len(SPANS), np.where(known, degrees, 1.0))
        return np.where(known & (square > limit), np.sqrt(square / np.where(known, degrees, 1.0)), 1.0)

    for span in SPANS:
        last = np.clip(number + (span // 2 if centred else 0), 1, len(squares))
        out = np.maximum(out, wider(*(sums[last] - sums[np.maximum(last - span, 0)]).T))
        for since, part in lasting:
            out = np.maximum(out, np.where(number >= since, wider(*np.sum(part[:span], axis=0)), 1.0))
    return out


AGAIN = SAME_SPAN
"""Time after an acknowledged alarm from which a continuing condition raises it again, in microseconds."""
LEAST = 1e-6
"""Probability below which reports print "less than" and this bound instead of a number."""
_CLOSE = 3.0
"""Difference of log likelihood ratios below which another body explains a jump nearly as well: a likelihood ratio of
20.
"""
BROKEN, BREAKS, JUMP, SENSOR, CONTRADICTION = "broken", "breaks", "jump", "sensor", "contradiction"
Row = Mapping[str, Any]


def raise_alarms(history: History, plan: OperationSpec, result: FilterResult) -> list[Alarm]:
    """Add the new alarms of an estimate to its record, and return them.

    Parameters
    ----------
    history : History
        Record of the instrument in operation.
    plan : OperationSpec
        Plan under which the readings were filtered.
    result : FilterResult
        Result of filtering all readings.

    Returns
    -------
    list[Alarm]
        Alarms that were added.
    """
    before = history.alarms()
    return [
        alarm for alarm in alarms_of(plan, result) if not _is_repeated(alarm, before) and history.raise_alarm(alarm)
    ]


def alarms_of(plan: OperationSpec, result: FilterResult) -> Iterator[Alarm]:
    """Yield all alarms that follow from the estimate, including those that have been raised before."""
    for requirement in result.requirements:
        since = result.time
        for span in result.violations:
            if (span.quantity, span.limit) != (requirement.quantity, requirement.limit):
                continue  # of another requirement
            if requirement.holds_now or result.time - span.until_us >= SAME_SPAN:
                yield _of_violation(span, requirement, result.now.quantities)
            else:
                since = span.since_us
        if not requirement.holds_now or requirement.breaks_us is not None:
            yield _of_requirement(requirement, since, result.time, result.now.quantities)
    for jump in result.jumps:
        yield _of_jump(jump)
    for sensor in result.sensors:
        if sensor.state != "ok":
            text = f"the sensor of {sensor.body} is {sensor.state} since {utc_text(sensor.since_us)}: {sensor.reason}"
            yield Alarm(SENSOR, sensor.body, sensor.since_us, text, sensor.to_dict())
    if result.understated_causes:
        text = next(warning for warning in result.warnings if result.understated_causes[0] in warning)
        yield Alarm(CONTRADICTION, "temperatures", result.time, text, {"causes": list(result.understated_causes)})
    far = [*_contradictions(plan, result), *_bad_readings(result)]
    yield from sorted(far, key=lambda occurrence: occurrence.time)[-1:]


def _is_repeated(alarm: Alarm, before: Sequence[Row]) -> bool:
    """Return whether an alarm repeats an earlier one of the same kind and subject.

    An earlier alarm counts while it is open and, in general, within the time `AGAIN` of it. A jump is repeated if the
    times in which it may have occurred overlap; a contradiction is not, since each reading can raise one.
    """
    same = [earlier for earlier in before if (earlier["kind"], earlier["subject"]) == (alarm.kind, alarm.subject)]
    if alarm.kind == JUMP:  # later readings determine the time of a jump better
        began, ended = alarm.content["after_us"], alarm.content["until_us"]
        return any(
            earlier["content"]["after_us"] < ended and began < earlier["content"]["until_us"] for earlier in same
        )
    if alarm.kind == BROKEN:  # each span of readings raises its own alarm, which may have been raised at its beginning
        began = alarm.content["since_us"]
        same = [
            earlier
            for earlier in same
            if earlier["time_us"] >= began and earlier["content"].get("since_us", earlier["time_us"]) <= alarm.time
        ]
        if alarm.content["ended"]:
            return bool(same)
    if alarm.kind == CONTRADICTION:  # each reading raises its own alarm
        return any(earlier["acknowledged"] is None or alarm.time <= earlier["time_us"] for earlier in same)
    return any(earlier["acknowledged"] is None or abs(alarm.time - earlier["time_us"]) < AGAIN for earlier in same)


def name_of(quantity: str, quantities: Sequence[Quantity]) -> str:
    """Return the display name of a quantity, such as ``Δf of forward``.

    Parameters
    ----------
    quantity : str
        Group and key of the quantity, such as ``forward d_f_um``.
    quantities : Sequence[Quantity]
        All estimated quantities.
    """
    group = quantity.partition(" ")[0]
    symbol = next(candidate.parameter.symbol for candidate in quantities if candidate.name == quantity)
    return {ANGLE_GROUP: f"{symbol} between the cameras", GROUND_GROUP: f"{symbol} on the ground"}.get(
        group, f"{symbol} of {group}"
    )


def percent(probability: float) -> str:
    """Return a probability as text in percent, with as many decimals as distinguish it from certainty."""
    rest = min(probability, 1.0 - probability)
    if rest < LEAST:
        return "less than 0.0001 %" if probability < 0.5 else "more than 99.9999 %"
    return f"{fixed(100.0 * probability, decimals_for(100.0 * rest))} %"


def _of_violation(span: Violation, requirement: RequirementStatus, quantities: Sequence[Quantity]) -> Alarm:
    """Return the alarm of a requirement that was violated in the past, at the time of the last violating reading."""
    name, allowed = name_of(span.quantity, quantities), percent(1.0 - requirement.probability)
    when = f"between {utc_text(span.since_us)} and {utc_text(span.until_us)}"
    count = f"{span.readings} readings {when}" if span.readings > 1 else f"the reading of {utc_text(span.since_us)}"
    worst = f"{with_sigma(span.value, span.sigma, requirement.unit)} at {utc_text(span.worst_us)}"
    text = (
        f"{name} exceeded {plain(span.limit)} {requirement.unit} at {count} with a probability above {allowed}; the "
        f"largest change was {worst}, beyond the limit with a probability of {percent(span.chance)}"
    )
    return Alarm(BROKEN, span.quantity, span.until_us, text, {**vars(span), "ended": True})


def _of_requirement(requirement: RequirementStatus, since: int, time: int, quantities: Sequence[Quantity]) -> Alarm:
    """Return the alarm of a requirement that is violated, from a time on, or may be."""
    name, allowed = name_of(requirement.quantity, quantities), percent(1.0 - requirement.probability)
    limit = f"{plain(requirement.limit)} {requirement.unit}"
    if not requirement.holds_now:
        text = f"{name} exceeds {limit} with a probability of {percent(requirement.chance_now)}; {allowed} is allowed"
        content = {**requirement.to_dict(), "since_us": since, "ended": False}
        if since < time:
            text += f"; it has been violated since {utc_text(since)}"
        return Alarm(BROKEN, requirement.quantity, time, text, content)
    assert requirement.breaks_us is not None
    day = utc_text(requirement.breaks_us)
    text = f"{name} may exceed {limit} (probability above {allowed}) from {day[:10]} on"
    return Alarm(BREAKS, requirement.quantity, time, text, requirement.to_dict())


def _of_jump(jump: DetectedJump) -> Alarm:
    """Return the alarm of a detected jump."""
    rivals_near = [body for body, ratio in jump.rivals.items() if ratio > jump.log_ratio - _CLOSE][:3]
    rivals = f"; {', '.join(rivals_near)} would explain it nearly as well" if rivals_near else ""
    content = {**jump.to_dict(), "after_us": jump.after_us, "until_us": jump.until_us}
    return Alarm(JUMP, jump.body, jump.until_us, f"{jump.body} jumped {jump.summary}{rivals}", content)


def with_current_interval(alarm: Row, jumps: Sequence[DetectedJump]) -> Row:
    """Return an alarm of the record with the interval and size of its jump as all readings determine them now.

    The record keeps the text of the reading that raised the alarm; a detected jump is that of the alarm if the times
    in which both may have occurred overlap.
    """
    if alarm["kind"] != JUMP:
        return alarm
    began, ended = alarm["content"]["after_us"], alarm["content"]["until_us"]
    now = (j for j in jumps if j.body == alarm["subject"] and j.after_us < ended and began < j.until_us)
    return next(({**alarm, "text": _of_jump(jump).text} for jump in now), alarm)


def with_sigma(value: float, sigma: float, unit: str, sign: bool = False) -> str:
    """Return a value with its standard deviation (to two digits) and unit as text, with a plus sign on request."""
    decimals = decimals_for(sigma)
    return f"{fixed(value, decimals, sign)} ± {fixed(sigma, decimals)} {unit.replace('um', 'µm')}"


def _bad_readings(result: FilterResult) -> Iterator[Alarm]:
    """Yield the alarms of monitor readings that were rejected as outliers, or may be."""
    for k, (time, reason) in enumerate(result.bad_readings, start=1):
        what = "may be" if result.undecided and k == len(result.bad_readings) else "was rejected as"
        text = f"the reading of {utc_text(time)} {what} an outlier: {reason}; exclude --include uses it anyway"
        yield Alarm(CONTRADICTION, "monitor", time, text, {"time_utc": utc_text(time), "reason": reason})


def _contradictions(plan: OperationSpec, result: FilterResult) -> Iterator[Alarm]:
    """Yield alarms of readings that differ too much from their predictions without a detected jump.

    The false-alarm probability of the whole mission is distributed in proportion to time: each reading has the share of
    the interval before it.
    """
    spans = [(jump.after_us, jump.detected_us) for jump in result.jumps]
    innovations = result.innovations
    # the first reading has none before it, and a false-alarm probability of its own
    previous_times = (
        [innovations[0][0] - round(plan.mission * MICRO) if result.readings == len(innovations) else innovations[0][0]]
        if innovations
        else []
    )
    previous_times += [time for time, _, _ in innovations[:-1]]
    for previous, (time, chi_square, degrees) in zip(previous_times, innovations, strict=True):
        share = min((time - previous) / (plan.mission * MICRO), 1.0)
        p_value = float(p_value_of(chi_square, degrees))
        if (
            share <= 0.0
            or p_value >= FALSE_ALARM * share
            or any(after < time <= innovations for after, innovations in spans)
        ):
            continue
        limit = float(limit_of(FALSE_ALARM * share, degrees))
        text = (
            f"the reading of {utc_text(time)} contradicts the prior: chi-square {plain(chi_square, 4)} for "
            f"{degrees} degrees of freedom, limit {plain(limit, 3)}; compare the plan's disturbances with what moves"
        )
        content = {"time_utc": utc_text(time), "chi_square": chi_square, "degrees_of_freedom": degrees, "limit": limit}
        yield Alarm(CONTRADICTION, "monitor", time, text, content)
