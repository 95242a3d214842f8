"""What an estimate of an instrument in operation tells: courses with their sigmas, jumps, sensors, requirements.

What of an estimate a person has to know: requirements that are broken or will be, jumps, sensors that fail, readings
that contradict all that is stated. Each is raised once, and waits in the record until somebody has seen it.

What goes on, as a requirement that stays broken, is not told again while its alarm waits, nor within a month of an
alarm that somebody has seen.
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
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from analysis.statistics import chance_beyond, limit_of
from scenes.specs.operation import OperationSpec
from twin.framework.artefact import decimals_for, fixed, plain
from twin.operate.estimate.estimate_snapshot import SPANS, Scores
from twin.operate.record.entries import MICRO, Alarm, utc_text
from twin.operate.record.history import History

MOST_BAD = 2
"""Readings taken for bad ones, above which it is said: 3 of 200 come by chance once in a thousand times."""


@dataclass(frozen=True, eq=False)
class Course:
    """Estimate at T times.

    Attributes
    ----------
    times : NDArray[np.int64]
        (T,) microseconds of TAI since 2000.
    quantities : tuple[Quantity, ...]
        Q that are read.
    values : Array
        (T, Q) in each one's unit, changes since the calibration.
    sigmas : Array
        (T, Q) their total standard deviations.
    changes : Array
        (T, 4 K) d_alpha, d_beta, d_gamma (rad), d_f (m) of one camera after the other.
    covariance : Array
        (T, 4 K, 4 K) of their errors.
    """

    times: NDArray[np.int64]
    quantities: tuple[Quantity, ...]
    values: Array
    sigmas: Array
    changes: Array
    covariance: Array

    @property
    def utc(self) -> tuple[str, ...]:
        """The times."""
        return tuple(utc_text(int(time)) for time in self.times)

    def to_dict(self) -> dict[str, Any]:
        """Plain data: group -> key -> values at all times, with sigmas beside them."""
        out: dict[str, Any] = {"times_utc": list(self.utc)}
        for k, one in enumerate(self.quantities):
            own = out.setdefault(one.group, {})
            own |= {one.key: self.values[:, k].tolist(), f"{one.key}_sigma": self.sigmas[:, k].tolist()}
        return out


class _Dated:
    """Data of which fields ``..._us`` are ``..._utc`` in plain data."""

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        out = vars(self).copy()
        for key in [one for one in out if one.endswith("_us")]:
            time = out.pop(key)
            out[f"{key.removesuffix('us')}utc"] = None if time is None else utc_text(time)
        return out


@dataclass(frozen=True)
class DetectedJump(_Dated):
    """A jump that was told.

    Attributes
    ----------
    body : str
        That explains it best; rivals: others -> their log likelihood ratio.
    after_us, until_us : int
        Between which readings it came; told_us: at which it was told.
    sizes : tuple[tuple[str, str, float, float], ...]
        (motion, unit, size, sigma).
    log_ratio : float
        Of the likelihoods with it and without it, when it was told.
    false_alarm : float
        Chance of as large a ratio anywhere in the whole life without a jump, at most.
    carried : Mapping[str, tuple[float, float, float]]
        Quantity -> (read, changed, sigma): what the spots alone say of it if the camera moved as a whole, what it did
        to the line by the bodies that can have made it, and the sigma of that. A part that moves spots need not move
        the line as much.
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
    def found(self) -> str:
        """When it came and how large it is, in words."""
        own = (f"{n.removeprefix(f'{self.body} ')} {with_sigma(z, s, u, sign=True)}" for n, u, z, s in self.sizes)
        return f"between {utc_text(self.after_us)} and {utc_text(self.until_us)}: {', '.join(own)}"

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
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
    """What a sensor of temperature is worth.

    Attributes
    ----------
    body : str
        Where it is.
    state : str
        ``ok``, ``dead``, ``stuck`` or ``doubtful``.
    since_us : int
        Since when; last_us: its newest reading.
    reason : str
        Why, empty where it is ok.
    """

    body: str
    state: str
    since_us: int
    last_us: int
    reason: str


@dataclass(frozen=True)
class RequirementStatus(_Dated):
    """A requirement.

    Attributes
    ----------
    quantity : str
        Group and key; unit: of its limit.
    limit : float
        That the size of its change must not exceed; probability: with which.
    chance_now : float
        That it does now.
    holds_now : bool
        Whether that is rare enough.
    breaks_us : int | None
        Time from which on it is not, within the horizon; None if it does not come.
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
    """Every stated motion at one time.

    Attributes
    ----------
    time : int
        microseconds.
    labels : tuple[str, ...]
        M names; units: theirs.
    mean : Array
        (M,) in these units. covariance: (M, M) of their errors.
    """

    time: int
    labels: tuple[str, ...]
    units: tuple[str, ...]
    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class FilterResult:
    """What is known after all readings of a record.

    Attributes
    ----------
    time : int
        Of the newest, microseconds.
    readings : int
        Of the monitor that were used.
    now : Course
        The state.
    scores : Scores
        Of predictions made before each reading came.
    innovations : tuple[tuple[int, float, int], ...]
        (time_us, chi-square, degrees of freedom) of the last readings.
    jumps : tuple[FoundJump, ...]
        That were told.
    events : tuple[tuple[int, str, tuple[str, ...]], ...]
        (time_us, name, causes that stepped).
    sensors : tuple[SensorState, ...]
        What those of temperature are worth.
    left_out : tuple[tuple[int, str, str, str], ...]
        (time_us, kind, subject, reason) of the last entries that were not used.
    explained : Mapping[str, float]
        Quantity -> share of its scatter that temperatures explain.
    widened : float
        By how much sigmas now are wider since the last readings contradict what is stated; 1 if they do not.
    too_many_jumps : bool
        Whether more jumps were told than is stated.
    breaks : tuple[Break, ...]
        The requirements.
    bad_readings : tuple[tuple[int, str], ...]
        (time_us, reason) of the last readings of the monitor that were taken for bad ones.
    undecided : bool
        Whether the newest of these may be the first after a jump; sigmas then count with both.
    too_small : tuple[str, ...]
        Causes of the prior with which sensors of several bodies disagree at the same time.
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

    @property
    def warnings(self) -> list[str]:
        """Return what a reader has to know before the numbers are used, one sentence each."""
        out = []
        if self.sigma_inflation > 1.0:
            text = f"all sigmas are {self.sigma_inflation:.3g} times as wide as it would make them"
            out.append(f"the last or the first readings contradict what is stated; {text}")
        if self.too_many_jumps:
            out.append(f"{len(self.jumps)} jumps are more than is stated: something else moves, or more of it")
        if self.undecided:
            out.append(f"the newest reading may be bad: {self.bad_readings[-1][1]}; until then sigmas count with both")
        if len(self.bad_readings) > MOST_BAD:
            text = "either the readings are worse than usual, or the prior is too small"
            out.append(f"{len(self.bad_readings)} readings were taken for bad ones: {text}")
        if self.understated_causes:
            text = "they are stated too small, or of another course in time, and their sigmas do not hold"
            out.append(f"sensors of several bodies together disagree with {', '.join(self.understated_causes)}: {text}")
        return out

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "time_utc": utc_text(self.time),
            "readings": self.readings,
            "agrees": not self.warnings,
            "warnings": self.warnings,
            "now": self.now.to_dict(),
            "scores": vars(self.scores),
            "innovations": _rows("chi_square degrees_of_freedom", self.innovations),
            "jumps": [one.to_dict() for one in self.jumps],
            "events": _rows("name causes", self.events),
            "sensors": [one.to_dict() for one in self.sensors],
            "excluded": _rows("kind subject reason", self.excluded),
            "explained": {name: share if np.isfinite(share) else None for name, share in self.explained.items()},
            "widened": self.sigma_inflation,
            "too_many_jumps": self.too_many_jumps,
            "bad_readings": _rows("reason", self.bad_readings),
            "undecided": self.undecided,
            "understated_causes": list(self.understated_causes),
            "requirements": [one.to_dict() for one in self.requirements],
        }


def _rows(keys: str, rows: Sequence[tuple[Any, ...]]) -> list[dict[str, Any]]:
    """Plain data of rows that begin with their time."""
    return [dict(zip(("time_utc", *keys.split()), (utc_text(t), *rest), strict=True)) for t, *rest in rows]


def beyond(value: Array, sigma: Array, limit: float) -> Array:
    """Chance that the size of something is larger than a limit.

    Parameters
    ----------
    value : Array
        What is expected of it.
    sigma : Array
        Its standard deviation, likewise.
    limit : float
        In the same unit.
    """
    scale = np.where(sigma > 0.0, sigma, 1e-300)
    return np.asarray(ndtr((value - limit) / scale) + ndtr((-value - limit) / scale))


def inflation_factors(
    squares: Array, now: Sequence[int] | NDArray[np.intp], centred: bool, lasting: Sequence[tuple[int, Array]] = ()
) -> Array:
    """(T,) by how much sigmas are wider than what is stated makes them, where readings contradict it: the root of their
    chi-square over its degrees of freedom, over the reading alone or some in a row, whichever is more. 1 where chance
    explains them. What contradicts the first readings, or a jump, is not forgotten: of what the spots do not
    show, the state rests on it for as long as nothing explains it.

    Parameters
    ----------
    squares : Array
        (N, 2) chi-square and degrees of freedom of each reading before it came, in the order of time.
    now : Sequence[int] | NDArray[np.intp]
        (T,) number of readings up to each time.
    centred : bool
        Whether readings after the time count as well.
    lasting : Sequence[tuple[int, Array]]
        Number of readings from which on it counts, and (n, 2) as ``squares``, of what is not forgotten.
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


AGAIN = 30 * 86_400 * MICRO
"""After which an alarm that somebody has seen is raised again, if what it tells of goes on."""
LEAST = 1e-6
"""Chance below which no number is told."""
_CLOSE = 3.0
"""Difference of log likelihood ratios, below which another body explains a jump nearly as well: 20 to 1."""
BROKEN, BREAKS, JUMP, SENSOR, CONTRADICTION = "broken", "requirements", "jump", "sensor", "contradiction"
Row = Mapping[str, Any]


def raise_alarms(history: History, plan: OperationSpec, result: FilterResult) -> list[Alarm]:
    """Add to a record what of its estimate is to be known and has not been told.

    Parameters
    ----------
    history : History
        The record.
    plan : OperationSpec
        Under which it was followed.
    following : Following
        What is known after all readings.

    Returns
    -------
    list[Alarm]
        The alarms that are new.
    """
    before = history.alarms()
    return [one for one in alarms_of(plan, result) if not _is_told(one, before) and history.raise_alarm(one)]


def alarms_of(plan: OperationSpec, result: FilterResult) -> Iterator[Alarm]:
    """What of an estimate is to be known, whether it has been told or not."""
    for one in result.requirements:
        if not one.holds_now or one.breaks_us is not None:
            yield _of_requirement(one, result.time, result.now.quantities)
    for jump in result.jumps:
        yield _of_jump(jump)
    for sensor in result.sensors:
        if sensor.state != "ok":
            text = f"the sensor of {sensor.body} is {sensor.state} since {utc_text(sensor.since_us)}: {sensor.reason}"
            yield Alarm(SENSOR, sensor.body, sensor.since_us, text, sensor.to_dict())
    if result.understated_causes:
        text = next(one for one in result.warnings if result.understated_causes[0] in one)
        yield Alarm(
            CONTRADICTION, "temperatures", result.time, text, {"causes": list(result.understated_causes)}
        )
    far = [*_contradictions(plan, result), *map(_of_bad, result.bad_readings)]
    yield from sorted(far, key=lambda one: one.time)[-1:]


def _is_told(alarm: Alarm, before: Sequence[Row]) -> bool:
    same = [one for one in before if (one["kind"], one["subject"]) == (alarm.kind, alarm.subject)]
    if alarm.kind == JUMP:  # of a jump the time is known the better the more readings have come
        began, ended = alarm.content["after_us"], alarm.content["until_us"]
        return any(one["content"]["after_us"] < ended and began < one["content"]["until_us"] for one in same)
    if alarm.kind == CONTRADICTION:  # every reading is one of its own
        return any(one["acknowledged"] is None or alarm.time <= one["time_us"] for one in same)
    return any(one["acknowledged"] is None or abs(alarm.time - one["time_us"]) < AGAIN for one in same)


def name_of(quantity: str, quantities: Sequence[Quantity]) -> str:
    """A quantity in words: ``Δf of forward``.

    Parameters
    ----------
    quantity : str
        Group and key.
    quantities : Sequence[Quantity]
        All that are read.
    """
    group = quantity.partition(" ")[0]
    symbol = next(one.parameter.symbol for one in quantities if one.name == quantity)
    return {ANGLE_GROUP: f"{symbol} between the cameras", GROUND_GROUP: f"{symbol} on the ground"}.get(
        group, f"{symbol} of {group}"
    )


def percent(chance: float) -> str:
    """A chance for a sentence, with as many decimals as tell it from certainty."""
    rest = min(chance, 1.0 - chance)
    if rest < LEAST:
        return "less than 0.0001 %" if chance < 0.5 else "more than 99.9999 %"
    return f"{fixed(100.0 * chance, decimals_for(100.0 * rest))} %"


def _of_requirement(one: RequirementStatus, time: int, quantities: Sequence[Quantity]) -> Alarm:
    name, allowed = name_of(one.quantity, quantities), percent(1.0 - one.probability)
    limit = f"{plain(one.limit)} {one.unit}"
    if not one.holds_now:
        text = f"{name} is beyond {limit} with a chance of {percent(one.chance_now)}; {allowed} is allowed"
        return Alarm(BROKEN, one.quantity, time, text, one.to_dict())
    assert one.breaks_us is not None
    text = f"{name} is expected to be beyond {limit} with a chance above {allowed} from {utc_text(one.breaks_us)} on"
    return Alarm(BREAKS, one.quantity, time, text, one.to_dict())


def _of_jump(one: DetectedJump) -> Alarm:
    near = [body for body, ratio in one.rivals.items() if ratio > one.log_ratio - _CLOSE][:3]
    rivals = f"; {', '.join(near)} would explain it nearly as well" if near else ""
    content = {**one.to_dict(), "after_us": one.after_us, "until_us": one.until_us}
    return Alarm(JUMP, one.body, one.until_us, f"{one.body} jumped {one.found}{rivals}", content)


def with_sigma(value: float, sigma: float, unit: str, sign: bool = False) -> str:
    """A number, with its sign or where it is below zero, its standard deviation, two digits of it, and its unit."""
    places = decimals_for(sigma)
    return f"{fixed(value, places, sign)} ± {fixed(sigma, places)} {unit.replace('um', 'µm')}"


def _of_bad(bad: tuple[int, str]) -> Alarm:
    time, reason = bad
    text = f"the reading of {utc_text(time)} is taken for a bad one: {reason}; exclude --include takes it all the same"
    return Alarm(CONTRADICTION, "monitor", time, text, {"time_utc": utc_text(time), "reason": reason})


def _contradictions(plan: OperationSpec, result: FilterResult) -> Iterator[Alarm]:
    """Readings that are too far from their predictions; those at which a jump was found are explained by it.

    Of the chance of a false alarm in the whole life each reading has the share of the time since the one before it.
    """
    spans = [(one.after_us, one.detected_us) for one in result.jumps]
    told = result.innovations
    # the first of all has no other before it, and a chance of a false alarm of its own
    befores = (
        [told[0][0] - round(plan.mission * MICRO) if result.readings == len(told) else told[0][0]]
        if told
        else []
    )
    befores += [time for time, _, _ in told[:-1]]
    for before, (time, chi_square, degrees) in zip(befores, told, strict=True):
        share = min((time - before) / (plan.mission * MICRO), 1.0)
        chance = float(chance_beyond(chi_square, degrees))
        if share <= 0.0 or chance >= FALSE_ALARM * share or any(after < time <= told for after, told in spans):
            continue
        limit = float(limit_of(FALSE_ALARM * share, degrees))
        text = (
            f"the reading of {utc_text(time)} contradicts what is stated: chi-square {plain(chi_square, 4)} of "
            f"{degrees} coordinates, at most {plain(limit, 3)} by chance; what moves more than the plan says?"
        )
        content = {"time_utc": utc_text(time), "chi_square": chi_square, "degrees_of_freedom": degrees, "limit": limit}
        yield Alarm(CONTRADICTION, "monitor", time, text, content)
