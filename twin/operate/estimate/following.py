"""What an estimate of an instrument in operation tells: courses with their sigmas, jumps, sensors, requirements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from analysis.arrays import Array
from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.limits import Quantity
from analysis.statistics import limit_of
from twin.operate.estimate.standing import SPANS, Scores
from twin.operate.record.entries import utc_text

MOST_BAD = 2
"""Readings taken for bad ones, above which it is said: 3 of 200 come by chance once in a thousand times."""


@dataclass(frozen=True, eq=False)
class Course:
    """Estimate at T times.

    Attributes:
        times: (T,) microseconds of TAI since 2000.
        quantities: Q that are read.
        values: (T, Q) in each one's unit, changes since the calibration.
        sigmas: (T, Q) their total standard deviations.
        changes: (T, 4 K) d_alpha, d_beta, d_gamma (rad), d_f (m) of one camera after the other.
        covariance: (T, 4 K, 4 K) of their errors.
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

    def column(self, group: str, key: str) -> int:
        """Number of a quantity. Raises ValueError."""
        return [(one.group, one.key) for one in self.quantities].index((group, key))

    def to_dict(self) -> dict[str, Any]:
        """Plain data: group -> key -> values at all times, with sigmas beside them."""
        out: dict[str, Any] = {"times_utc": list(self.utc)}
        for k, one in enumerate(self.quantities):
            own = out.setdefault(one.group, {})
            own |= {one.key: self.values[:, k].tolist(), f"{one.key}_sigma": self.sigmas[:, k].tolist()}
        return out


@dataclass(frozen=True)
class FoundJump:
    """A jump that was told.

    Attributes:
        body: that explains it best; rivals: others -> their log likelihood ratio.
        after_us, until_us: between which readings it came; told_us: at which it was told.
        sizes: (motion, unit, size, sigma).
        log_ratio: of the likelihoods with it and without it, when it was told.
        false_alarm: chance of as large a ratio anywhere in the whole life without a jump, at most.
        carried: quantity -> (read, changed, sigma): what the spots alone say of it if the camera moved as a whole, what
            it did to the line by the bodies that can have made it, and the sigma of that. A part that moves spots need
            not move the line as much.
    """

    body: str
    after_us: int
    until_us: int
    told_us: int
    sizes: tuple[tuple[str, str, float, float], ...]
    log_ratio: float
    false_alarm: float
    rivals: Mapping[str, float]
    carried: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "body": self.body,
            "after_utc": utc_text(self.after_us),
            "until_utc": utc_text(self.until_us),
            "told_utc": utc_text(self.told_us),
            "sizes": [{"name": n, "unit": u, "size": z, "sigma": s} for n, u, z, s in self.sizes],
            "log_ratio": self.log_ratio,
            "false_alarm": self.false_alarm,
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
                for name, (read, changed, sigma) in self.carried.items()
                for shown, wide in [(changed / read, sigma / abs(read)) if read else (None, None)]
            ],
        }


@dataclass(frozen=True)
class SensorState:
    """What a sensor of temperature is worth.

    Attributes:
        body: where it is.
        state: ``ok``, ``dead``, ``stuck`` or ``doubtful``.
        since_us: since when; last_us: its newest reading.
        reason: why, empty where it is ok.
    """

    body: str
    state: str
    since_us: int
    last_us: int
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        times = {"since_utc": utc_text(self.since_us), "last_utc": utc_text(self.last_us)}
        return {"body": self.body, "state": self.state, "reason": self.reason, **times}


@dataclass(frozen=True)
class Break:
    """A requirement.

    Attributes:
        quantity: group and key; unit: of its limit.
        limit: that the size of its change must not exceed; probability: with which.
        chance_now: that it does now.
        holds_now: whether that is rare enough.
        breaks_us: time from which on it is not, within the horizon; None if it does not come.
    """

    quantity: str
    unit: str
    limit: float
    probability: float
    chance_now: float
    holds_now: bool
    breaks_us: int | None

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        own = {key: value for key, value in vars(self).items() if key != "breaks_us"}
        return {**own, "breaks_utc": None if self.breaks_us is None else utc_text(self.breaks_us)}


@dataclass(frozen=True, eq=False)
class Motions:
    """Every stated motion at one time.

    Attributes:
        time: microseconds.
        labels: M names; units: theirs.
        mean: (M,) in these units. covariance: (M, M) of their errors.
    """

    time: int
    labels: tuple[str, ...]
    units: tuple[str, ...]
    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Following:
    """What is known after all readings of a record.

    Attributes:
        time: of the newest, microseconds.
        readings: of the monitor that were used.
        now: the state.
        scores: of predictions made before each reading came.
        innovations: (time_us, chi-square, degrees of freedom) of the last readings.
        jumps: that were told.
        events: (time_us, name, causes that stepped).
        sensors: what those of temperature are worth.
        left_out: (time_us, kind, subject, reason) of the last entries that were not used.
        explained: quantity -> share of its scatter that temperatures explain.
        widened: by how much sigmas now are wider since the last readings contradict what is stated; 1 if they do not.
        too_many_jumps: whether more jumps were told than is stated.
        breaks: the requirements.
        bad_readings: (time_us, reason) of the last readings of the monitor that were taken for bad ones.
        undecided: whether the newest of these may be the first after a jump; sigmas then count with both.
        too_small: causes of the prior with which sensors of several bodies disagree at the same time.
    """

    time: int
    readings: int
    now: Course
    scores: Scores
    innovations: tuple[tuple[int, float, int], ...]
    jumps: tuple[FoundJump, ...]
    events: tuple[tuple[int, str, tuple[str, ...]], ...]
    sensors: tuple[SensorState, ...]
    left_out: tuple[tuple[int, str, str, str], ...]
    explained: Mapping[str, float]
    widened: float
    too_many_jumps: bool
    breaks: tuple[Break, ...]
    bad_readings: tuple[tuple[int, str], ...] = ()
    undecided: bool = False
    too_small: tuple[str, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """Return what a reader has to know before the numbers are used, one sentence each."""
        out = []
        if self.widened > 1.0:
            text = f"all sigmas are {self.widened:.3g} times as wide as it would make them"
            out.append(f"the last or the first readings contradict what is stated; {text}")
        if self.too_many_jumps:
            out.append(f"{len(self.jumps)} jumps are more than is stated: something else moves, or more of it")
        if self.undecided:
            out.append(f"the newest reading may be bad: {self.bad_readings[-1][1]}; until then sigmas count with both")
        if len(self.bad_readings) > MOST_BAD:
            text = "either the readings are worse than usual, or the prior is too small"
            out.append(f"{len(self.bad_readings)} readings were taken for bad ones: {text}")
        if self.too_small:
            text = "they are stated too small, or of another course in time, and their sigmas do not hold"
            out.append(f"sensors of several bodies together disagree with {', '.join(self.too_small)}: {text}")
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
            "innovations": [
                {"time_utc": utc_text(t), "chi_square": square, "degrees_of_freedom": degrees}
                for t, square, degrees in self.innovations
            ],
            "jumps": [one.to_dict() for one in self.jumps],
            "events": [{"time_utc": utc_text(t), "name": name, "causes": list(c)} for t, name, c in self.events],
            "sensors": [one.to_dict() for one in self.sensors],
            "left_out": [
                {"time_utc": utc_text(t), "kind": kind, "subject": subject, "reason": reason}
                for t, kind, subject, reason in self.left_out
            ],
            "explained": {name: share if np.isfinite(share) else None for name, share in self.explained.items()},
            "widened": self.widened,
            "too_many_jumps": self.too_many_jumps,
            "bad_readings": [{"time_utc": utc_text(t), "reason": reason} for t, reason in self.bad_readings],
            "undecided": self.undecided,
            "too_small": list(self.too_small),
            "requirements": [one.to_dict() for one in self.breaks],
        }


def beyond(value: Array, sigma: Array, limit: float) -> Array:
    """Chance that the size of something is larger than a limit.

    Args:
        value: what is expected of it.
        sigma: its standard deviation, likewise.
        limit: in the same unit.
    """
    scale = np.where(sigma > 0.0, sigma, 1e-300)
    return np.asarray(ndtr((value - limit) / scale) + ndtr((-value - limit) / scale))


def widening(
    squares: Array, now: Sequence[int] | NDArray[np.intp], centred: bool, lasting: Sequence[tuple[int, Array]] = ()
) -> Array:
    """(T,) by how much sigmas are wider than what is stated makes them, where readings contradict it: the root of their
    chi-square over its degrees of freedom, over the reading alone or some in a row, whichever is more. 1 where chance
    explains them. What contradicts the first readings, or a jump, is not forgotten: of what the spots do not
    show, the state rests on it for as long as nothing explains it.

    Args:
        squares: (N, 2) chi-square and degrees of freedom of each reading before it came, in the order of time.
        now: (T,) number of readings up to each time.
        centred: whether readings after the time count as well.
        lasting: number of readings from which on it counts, and (n, 2) as ``squares``, of what is not forgotten.
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
