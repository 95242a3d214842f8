"""Where an estimate stands after some of a record's entries: what is believed, how good its predictions were, what the
sensors are worth. It can be kept and taken up again, to the bit.

Serialisation of an estimate and of its model: the same bytes for the same numbers, and back to the bit.
"""

from __future__ import annotations

import io
import json
import math
from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from analysis.arrays import Array
from analysis.monitor.disturbances import FALSE_ALARM, Disturbances, TimeLaw
from analysis.monitor.filter_state import BadReading, FilterState, Innovation, Observed, PendingReading, Track
from analysis.monitor.jump_detection import Jump
from analysis.monitor.kalman_filter import SeriesFilter
from analysis.monitor.limits import Quantity
from analysis.monitor.parameters import ANGLE, CAMERA_PARAMETERS, GROUND, Parameter
from analysis.monitor.state_space import HeatInputs
from analysis.statistics import limit_of
from twin.operate.estimate.operation_model import OperationModel
from twin.operate.record.entries import MICRO

_FILTER = (PendingReading, BadReading, FilterState, Disturbances, HeatInputs, Innovation, Jump, Observed, Quantity)
_CLASSES = (*_FILTER, SeriesFilter, TimeLaw, Track)
_PARAMETERS = ChainMap(CAMERA_PARAMETERS, {one.key: one for one in (ANGLE, *GROUND)})


def packed(value: Any) -> bytes:
    """Return a value of frozen data classes, sequences, mappings, arrays, numbers and texts as bytes."""
    arrays: dict[str, np.ndarray] = {}

    def plain(one: Any) -> Any:
        if isinstance(one, np.ndarray):
            arrays[name := f"array_{len(arrays)}"] = one
            return {"array": name}
        if isinstance(one, Parameter):
            return {"parameter": one.key}
        if is_dataclass(one) and not isinstance(one, type):
            own = {each.name: plain(getattr(one, each.name)) for each in fields(one) if each.init}
            return {"class": type(one).__name__, "of": own}
        if isinstance(one, Mapping):
            return {"mapping": [[plain(key), plain(each)] for key, each in one.items()]}
        return [plain(each) for each in one] if isinstance(one, tuple | list) else one

    text, file = json.dumps(plain(value)).encode(), io.BytesIO()
    np.savez(file, allow_pickle=False, plain=np.frombuffer(text, np.uint8), **arrays)
    return file.getvalue()


def unpacked(content: bytes, *classes: type) -> Any:
    """Return the value that `packed` was given, sequences as tuples.

    Parameters
    ----------
    content : bytes
        The bytes.
    classes : type
        Data classes that are in it, beside those of the filter.
    """
    known: dict[str, Any] = {one.__name__: one for one in (*_CLASSES, *classes)}

    def value(one: Any) -> Any:
        if isinstance(one, list):
            return tuple(value(each) for each in one)
        if not isinstance(one, dict):
            return one
        if "class" in one:
            return known[one["class"]](**{name: value(each) for name, each in one["of"].items()})
        if "mapping" in one:
            return {value(key): value(each) for key, each in one["mapping"]}
        return arrays[one["array"]] if "array" in one else _PARAMETERS[one["parameter"]]

    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return value(json.loads(arrays.pop("plain").tobytes()))


SPANS = (1, 3, 10)
"""Readings in a row that are held together against what was expected of them."""
HISTORY_LENGTH = 200
"""Innovations and readings that were left out, of which the last are kept."""
OUTLIER_SIGMAS = 6.0
"""Standard deviations of a sensor's reading from what was expected, beyond which it is not used."""
SENSOR_WINDOW = 10
"""Readings of a sensor by which it is judged."""
INFLATION_SIGMAS = 3.0
"""Standard deviations beyond which a reading widens what is stated of temperatures, where several sensors disagree."""
DOUBTFUL_OUTLIERS = 3
"""Of these, how many far ones make a sensor doubtful."""
SILENT_INTERVALS = 10.0
"""Intervals after which a sensor from which nothing came is dead."""
STUCK_PROBABILITY = 1e-4
"""Of as many equal readings in a row by a sensor that works, below which it is called stuck."""


@dataclass(frozen=True)
class Sensor:
    """One sensor of temperature.

    Attributes
    ----------
    body : str
        Where it is.
    readings : int
        That came. first_us, last_us: the times of the first and of the newest, microseconds.
    value : float
        Of the newest, kelvin; repeats: how often it came in a row before it; since_us: first of these.
    step : float
        Smallest difference of two readings that followed each other, kelvin; infinite before there is one.
    sigma : float
        Of its readings, kelvin.
    recent : tuple[float, ...]
        The last readings against what was expected of each, in standard deviations.
    stuck : bool
        Whether it repeats itself.
    """

    body: str
    readings: int = 0
    first_us: int = 0
    last_us: int = 0
    value: float = math.nan
    repeats: int = 0
    since_us: int = 0
    step: float = math.inf
    sigma: float = 0.0
    recent: tuple[float, ...] = ()
    stuck: bool = False

    def updated(self, time: int, value: float, sigma: float) -> Sensor:
        """With one more reading."""
        again = value == self.value
        step = self.step if again or not self.readings else min(self.step, abs(value - self.value))
        repeats = self.repeats + 1 if again else 0
        # two readings of a working sensor agree in its last digit with this chance
        alike = float(erf(0.5 * step / (2.0 * sigma))) if math.isfinite(step) else 0.0
        return replace(
            self,
            readings=self.readings + 1,
            first_us=self.first_us if self.readings else time,
            last_us=time,
            value=value,
            repeats=repeats,
            since_us=self.since_us if again else time,
            step=step,
            sigma=sigma,
            stuck=bool(repeats >= 3 and alike**repeats * max(self.readings, 1) < STUCK_PROBABILITY),
        )

    def with_residual(self, white: float) -> Sensor:
        """With its newest reading against what was expected of it."""
        return replace(self, recent=(*self.recent, white)[-SENSOR_WINDOW:])

    @property
    def outliers(self) -> int:
        """How many of its last readings were far from what was expected."""
        return sum(abs(white) > OUTLIER_SIGMAS for white in self.recent)

    @property
    def disagrees(self) -> bool:
        """Whether its last readings together are further from what was expected than by chance."""
        square = sum(white**2 for white in self.recent)
        return bool(self.recent) and square > float(limit_of(FALSE_ALARM, len(self.recent)))

    def state(self, now: int, alone: bool) -> tuple[str, int, str]:
        """``ok``, ``dead``, ``stuck`` or ``doubtful``; since when, microseconds; and why.

        Parameters
        ----------
        now : int
            Time of the newest reading of all.
        alone : bool
            Whether no other sensor disagrees with what is stated as it does.
        """
        if self.stuck:
            return "stuck", self.since_us, f"{self.repeats + 1} readings in a row of {self.value:.6g} K"
        usual = (self.last_us - self.first_us) / max(self.readings - 1, 1)
        if self.readings > 1 and now - self.last_us > SILENT_INTERVALS * usual:
            stuck_sensors = (now - self.last_us) / MICRO / 86_400.0
            return (
                "dead",
                self.last_us,
                f"nothing came for {stuck_sensors:.3g} days; it used to every {usual / MICRO / 86_400.0:.3g}",
            )
        if self.outliers >= DOUBTFUL_OUTLIERS and alone:
            text = f"{self.outliers} of the last {len(self.recent)} readings far from what was expected"
            return "doubtful", self.last_us, text
        return "ok", self.first_us, ""


@dataclass(frozen=True)
class Scores:
    """How good predictions of readings were that were made before these came.

    Attributes
    ----------
    readings : int
        Of the monitor.
    components : int
        Independent numbers in them.
    within_one, within_two : int
        How many of these were within one and two standard deviations.
    log_score : float
        Mean over the readings of the logarithm of the density stated for what came, px^-D.
    chi_square : float
        Of all.
    """

    readings: int = 0
    components: int = 0
    within_one: int = 0
    within_two: int = 0
    log_score: float = 0.0
    chi_square: float = 0.0

    def updated(self, white: Array, log_score: float) -> Scores:
        """With one more reading."""
        count = self.readings + 1
        return Scores(
            count,
            self.components + len(white),
            self.within_one + int(np.sum(np.abs(white) < 1.0)),
            self.within_two + int(np.sum(np.abs(white) < 2.0)),
            self.log_score + (log_score - self.log_score) / count,
            self.chi_square + float(white @ white),
        )


@dataclass(frozen=True)
class JumpDetection:
    """A jump, and the reading at which it was told, microseconds."""

    time: int
    jump: Jump


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """Where an estimate stands.

    Attributes
    ----------
    filter_state : Belief
        What is believed; seconds count from the epoch.
    time : int
        Of the newest entry, microseconds.
    scores : Scores
        Of predictions.
    innovations : tuple[tuple[int, float, int], ...]
        (time_us, chi-square, degrees of freedom) of the last readings.
    jumps : tuple[Told, ...]
        That were told.
    sensors : Mapping[str, Sensor]
        By body.
    left_out : tuple[tuple[int, str, str, str], ...]
        (time_us, kind, subject, reason) of the last entries that were not used.
    spread : Array
        (4, Q) sums over the readings of all that is read, of its square, of what temperatures leave of it and of that
        one's square; see `explained`.
    basis : Array
        (D + P, n) what the states do, by which it is seen that they are the states of this computer's linear algebra.
    used : NDArray[np.int64]
        (U,) ids of the entries that were used since it was last kept for good, in their order.
    left : Array
        (U, m) what share of the mean square of jumps could not be told before each of them.
    told : tuple[tuple[int, float, int], ...]
        Innovations since then.
    silent : tuple[tuple[str, int], ...]
        (body, time_us) of sensors that repeat themselves, and of the first of their equal readings: none counts from
        there on.
    pending : tuple[int, int] | None
        (id, time_us) of a reading of the monitor that was set aside, of which the next one decides; it is among those
        that were used. None for none.
    bad : tuple[tuple[int, str], ...]
        (time_us, reason) of the last readings of the monitor that were taken for bad ones, and of a pending one.
    first : tuple[tuple[int, float, int], ...]
        As ``innovations``, of the first readings of all.
    accused : tuple[str, ...]
        Bodies whose sensors have disagreed with what is stated at the same time as others.
    """

    filter_state: FilterState
    time: int
    scores: Scores = field(default_factory=Scores)
    innovations: tuple[tuple[int, float, int], ...] = ()
    jumps: tuple[JumpDetection, ...] = ()
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    excluded: tuple[tuple[int, str, str, str], ...] = ()
    scatter_sums: Array = field(default_factory=lambda: np.zeros((4, 0)))
    basis: Array = field(default_factory=lambda: np.zeros((0, 0)))
    used: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    undetected_shares: Array = field(default_factory=lambda: np.zeros((0, 0)))
    new_innovations: tuple[tuple[int, float, int], ...] = ()
    stuck_sensors: tuple[tuple[str, int], ...] = ()
    pending: tuple[int, int] | None = None
    bad_readings: tuple[tuple[int, str], ...] = ()
    first_innovations: tuple[tuple[int, float, int], ...] = ()
    disagreeing: tuple[str, ...] = ()

    @property
    def explained(self) -> Array:
        """(Q,) share of the scatter of all that is read which temperatures of bodies with sensors explain; NaN before
        there are two readings.
        """
        count = self.scores.readings
        if count < 2:
            return np.full(self.scatter_sums.shape[1], np.nan)
        total, square, left, left_square = self.scatter_sums
        whole = square / count - (total / count) ** 2
        rest = left_square / count - (left / count) ** 2
        return np.where(whole > 0.0, 1.0 - rest / np.where(whole > 0.0, whole, 1.0), np.nan)

    def excluding(self, time: int, kind: str, subject: str, reason: str) -> EstimatorState:
        """With an entry that is not used."""
        return replace(
            self, time=max(self.time, time), excluded=(*self.excluded, (time, kind, subject, reason))[-HISTORY_LENGTH:]
        )

    def with_decision(self, excluded: str) -> EstimatorState:
        """With the decision on the reading that was set aside.

        Parameters
        ----------
        left_out : str
            Why it is left out; empty where it is taken after all.
        """
        assert self.pending is not None
        number, time = self.pending
        kept = [one for one in self.excluded if (one[0], one[1]) != (time, "monitor")]
        bad = tuple(one for one in self.bad_readings if one[0] != time)
        if not excluded:
            return replace(self, pending=None, excluded=tuple(kept), bad_readings=bad)
        good, bad = self.used != number, (*bad, (time, excluded))
        kept = [*kept, (time, "monitor", "monitor", excluded)]
        return replace(self, pending=None, excluded=tuple(kept), bad_readings=bad, used=self.used[good], undetected_shares=self.undetected_shares[good])

    @property
    def newly_stuck(self) -> tuple[tuple[str, int], ...]:
        """Sensors that repeat themselves, whose first equal readings have been used: (body, time_us of the first)."""
        stuck = ((one.body, one.since_us) for one in self.sensors.values() if one.stuck)
        return tuple(one for one in stuck if one not in self.stuck_sensors)

    @property
    def jointly_disagreeing(self) -> tuple[str, ...]:
        """Bodies whose sensors disagree with what is stated, where several do: it is then the prior that is wrong, and
        not all of these sensors. Empty where one disagrees, or none.
        """
        found = tuple(sorted(one.body for one in self.sensors.values() if one.disagrees))
        return found if len(found) > 1 else ()

    def with_innovation(self, time: int, found: Innovation) -> EstimatorState:
        """With the innovation of a reading of the monitor that was taken."""
        innovation = (time, found.chi_square, len(found.white))
        scores = self.scores.updated(found.white, found.log_score)
        innovations = (*self.innovations, innovation)[-HISTORY_LENGTH:]
        first = (*self.first_innovations, innovation)[: SPANS[-1]]
        return replace(self, scores=scores, innovations=innovations, new_innovations=(*self.new_innovations, innovation), first_innovations=first)

    def with_counters_reset(self) -> EstimatorState:
        """The same, counting what is used from now on."""
        return replace(self, used=self.used[:0], undetected_shares=self.undetected_shares[:0], new_innovations=())

    @classmethod
    def from_bytes(cls, content: bytes) -> EstimatorState:
        """Return what `packed` made bytes of."""
        return cast("EstimatorState", unpacked(content, cls, Scores, Sensor, JumpDetection))


@dataclass(frozen=True, eq=False)
class EntryFilter:
    """Takes a record's entries one after the other.

    Attributes
    ----------
    model : OperationModel
        What the estimate rests on.
    how : SeriesFilter
        Its filter, with the events of the record as steps.
    epoch : int
        From which seconds count, microseconds.
    reference : Array
        (C, 2) px that all shifts are counted from.
    temperature : float
        Of the instrument in its calibration, kelvin.
    """

    model: OperationModel
    how: SeriesFilter
    epoch: int
    reference: Array
    temperature: float

    def seconds(self, time: int) -> float:
        """Of a time in microseconds."""
        return (time - self.epoch) / MICRO

    def start(self, time: int, stuck_sensors: tuple[tuple[str, int], ...] = ()) -> EstimatorState:
        """Before any entry.

        Parameters
        ----------
        time : int
            Of the first, microseconds.
        silent : tuple[tuple[str, int], ...]
            Sensors that are known to repeat themselves.
        """
        spread = np.zeros((4, len(self.model.quantities)))
        filter_state, basis = self.how.start(self.seconds(time)), self.how.space.basis
        return EstimatorState(filter_state, time, scatter_sums=spread, basis=basis, stuck_sensors=stuck_sensors)

    def take(self, state: EstimatorState, entries: Sequence[Mapping[str, Any]]) -> EstimatorState:
        """All entries of one moment.

        Parameters
        ----------
        standing : Standing
            before.
        entries : Sequence[Mapping[str, Any]]
            Of one time, each with its content as plain data and, as ``decided``, whether somebody includes it and why;
            None where nobody has decided.
        """
        state = replace(state, time=max(state.time, int(entries[0]["time_us"])))
        for one in entries:
            if (decision := one["decided"]) is not None and not decision[0]:
                reason = f"entry {one['id']} was excluded: {decision[1]}"
                state = state.excluding(
                    int(one["time_us"]), str(one["kind"]), str(one["subject"]), reason
                )
        entries = [one for one in entries if one["decided"] is None or one["decided"][0]]
        warm = sorted((one for one in entries if one["kind"] == "temperature"), key=lambda one: str(one["subject"]))
        for one in warm:
            state = self._temperature(state, one)
        for one in entries:
            if one["kind"] == "monitor":
                state = self._monitor(state, one)
        return state

    def observed(self, entry: Mapping[str, Any]) -> Observed:
        """What an entry that is used says.

        Parameters
        ----------
        entry : Mapping[str, Any]
            Of the monitor, or of a sensor that the filter knows.
        """
        time, content = self.seconds(int(entry["time_us"])), entry["content"]
        if entry["kind"] == "temperature":
            assert self.how.heat is not None
            number = self.how.heat.sensors.index(str(entry["subject"]))
            value, noise = np.array([float(content["values"][0]) - self.temperature]), float(content["sigma"]) ** 2
            return Observed(time, value, np.array([[noise]]), (number,))
        spots = content["numbers"]["spots"]
        found = [spots[camera][channel]["after"] for camera, channel in self.model.spots]
        place = np.array([(one["row"], one["column"]) for one in found])
        sigma = np.array([(one["row_sigma"], one["column_sigma"]) for one in found])
        return Observed(time, (place - self.reference).ravel(), np.diag(sigma.ravel() ** 2))

    def _updated(
        self, state: EstimatorState, entry: Mapping[str, Any], observed: Observed
    ) -> tuple[EstimatorState, Innovation]:
        filter_state, found = self.how.update(state.filter_state, observed, entry["decided"] is not None)
        used = np.append(state.used, np.int64(entry["id"]))
        # of no motion that may jump there is nothing to count rows by
        before = state.undetected_shares.reshape(len(state.used), len(self.how.walking))
        left = np.concatenate([before, state.filter_state.undetected[None]])
        return replace(state, filter_state=filter_state, used=used, undetected_shares=left), found

    def _temperature(self, state: EstimatorState, entry: Mapping[str, Any]) -> EstimatorState:
        time, body, content = int(entry["time_us"]), str(entry["subject"]), entry["content"]
        sensor = state.sensors.get(body, Sensor(body)).updated(
            time, float(content["values"][0]), float(content["sigma"])
        )
        state = replace(state, sensors={**state.sensors, body: sensor})
        if self.how.heat is None or body not in self.how.heat.sensors:
            return state.excluding(time, "temperature", body, "nothing is stated of its temperature")
        included = entry["decided"] is not None
        if not included and (sensor.stuck or (body, sensor.since_us) in state.stuck_sensors):
            return state.excluding(time, "temperature", body, "its sensor repeats itself")
        observed = self.observed(entry)
        there = self.how.at(state.filter_state, observed.time)
        white = float(self.how.whitened(there.state, observed).white[0])
        sensor = sensor.with_residual(white)
        state = replace(state, sensors={**state.sensors, body: sensor})
        if body in state.jointly_disagreeing:  # then it is not the sensor that is wrong
            times = max(abs(white), 1.0)
            loose = self.how.inflated(there, observed, times) if times > INFLATION_SIGMAS else there
            disagreeing = tuple(sorted({*state.disagreeing, *state.jointly_disagreeing}))
            state = replace(state, filter_state=loose, disagreeing=disagreeing)
        elif abs(white) > OUTLIER_SIGMAS and not included:
            reason = f"{abs(white):.3g} standard deviations from what was expected"
            return state.excluding(time, "temperature", body, reason)
        return self._updated(state, entry, observed)[0]

    def _monitor(self, state: EstimatorState, entry: Mapping[str, Any]) -> EstimatorState:
        time = int(entry["time_us"])
        if entry["content"]["numbers"].get("sigma_holds") is False:
            return state.excluding(time, "monitor", "monitor", "its own sigma does not hold")
        observed, before = self.observed(entry), state.filter_state.pending
        state, found = self._updated(state, entry, observed)
        if found.settled and state.pending is not None and before is not None:
            number, when = state.pending
            state = state.with_decision("" if found.earlier else self._outlier_text(number, before.innovation))
            if found.earlier is not None:
                state = state.with_innovation(when, found.earlier)
        if found.bad is not None:
            number = int(entry["id"])
            reason = f"{self._outlier_text(number, found)}; the next reading decides whether it is left out"
            state = replace(
                state, pending=(number, time), bad_readings=(*state.bad_readings, (time, reason))[-HISTORY_LENGTH:]
            )
            return state.excluding(time, "monitor", "monitor", reason)
        filter_state, space, rows = state.filter_state, self.how.space, self.model.rows
        values = rows @ self.how.parameters_of(filter_state.mean, filter_state.covariance, observed.time)[0]
        rest = values - rows @ space.heat_outputs(filter_state.mean, observed.time)[space.width :]
        spread = np.stack([values, values**2, rest, rest**2])
        return replace(
            state.with_innovation(time, found),
            jumps=state.jumps
            if found.jump is None
            else (*state.jumps, JumpDetection(time, found.jump)),
            scatter_sums=state.scatter_sums + (spread if found.earlier is None else 2.0 * spread),
        )

    def _outlier_text(self, number: int, found: Innovation) -> str:
        """Why a reading is taken for a bad one."""
        assert found.bad is not None
        camera, channel = self.model.spots[found.bad.coordinate // 2]
        axis = ("row", "column")[found.bad.coordinate % 2]
        text = f"entry {number}: the {axis} of the spot {camera}/{channel} is {abs(found.bad.z):.3g} sigma from what"
        return f"{text} is expected of it, and no jump of stated size explains that"
