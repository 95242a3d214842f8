"""State of an estimator after some entries of a record, and its serialisation.

An `EstimatorState` holds the filter's state, the scores of its predictions and the condition of the temperature
sensors. `EntryFilter` updates it with the entries of a record (readings and events) in the order of time. `packed` and
`unpacked` serialise it as bytes without any loss: equal numbers give equal bytes.
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
from analysis.monitor.parameters import ANGLE, CAMERA_PARAMETERS, FOCUS, GROUND, Parameter
from analysis.monitor.state_space import HeatInputs
from analysis.statistics import limit_of
from twin.operate.estimate.operation_model import OperationModel
from twin.operate.record.entries import MICRO

_FILTER = (PendingReading, BadReading, FilterState, Disturbances, HeatInputs, Innovation, Jump, Observed, Quantity)
"""Classes of the filter that a serialised estimate may contain."""
_CLASSES = (*_FILTER, SeriesFilter, TimeLaw, Track)
_PARAMETERS = ChainMap(CAMERA_PARAMETERS, {parameter.key: parameter for parameter in (ANGLE, FOCUS, *GROUND)})


def packed(value: Any) -> bytes:
    """Serialise a value of frozen data classes, sequences, mappings, arrays, numbers and texts as bytes."""
    arrays: dict[str, np.ndarray] = {}

    def plain(item: Any) -> Any:
        if isinstance(item, np.ndarray):
            arrays[name := f"array_{len(arrays)}"] = item
            return {"array": name}
        if isinstance(item, Parameter):
            return {"parameter": item.key}
        if is_dataclass(item) and not isinstance(item, type):
            content = {each.name: plain(getattr(item, each.name)) for each in fields(item) if each.init}
            return {"class": type(item).__name__, "of": content}
        if isinstance(item, Mapping):
            return {"mapping": [[plain(key), plain(each)] for key, each in item.items()]}
        return [plain(each) for each in item] if isinstance(item, tuple | list) else item

    text, file = json.dumps(plain(value)).encode(), io.BytesIO()
    np.savez(file, allow_pickle=False, plain=np.frombuffer(text, np.uint8), **arrays)
    return file.getvalue()


def unpacked(content: bytes, *classes: type) -> Any:
    """Return the value that was serialised by `packed`, with sequences as tuples.

    Parameters
    ----------
    content : bytes
        Output of `packed`.
    classes : type
        Data classes that occur in the value, in addition to those of the filter.
    """
    known: dict[str, Any] = {item.__name__: item for item in (*_CLASSES, *classes)}

    def value(item: Any) -> Any:
        if isinstance(item, list):
            return tuple(value(each) for each in item)
        if not isinstance(item, dict):
            return item
        if "class" in item:
            return known[item["class"]](**{name: value(each) for name, each in item["of"].items()})
        if "mapping" in item:
            return {value(key): value(each) for key, each in item["mapping"]}
        return arrays[item["array"]] if "array" in item else _PARAMETERS[item["parameter"]]

    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return value(json.loads(arrays.pop("plain").tobytes()))


SPANS = (1, 3, 10)
"""Numbers of consecutive readings for each of which the summed chi-square of the innovations is tested."""
HISTORY_LENGTH = 200
"""Number of the latest innovations (readings minus predictions), and of the latest excluded entries, that the state
stores.
"""
OUTLIER_SIGMAS = 6.0
"""Residual of a sensor's reading, in standard deviations, beyond which the reading is not used."""
SENSOR_WINDOW = 10
"""Number of a sensor's latest readings from which its condition (ok, stuck, doubtful) is determined."""
INFLATION_SIGMAS = 3.0
"""Residual of a temperature reading, in standard deviations, above which the prior sigmas of temperatures are enlarged.

This is done only where several sensors disagree with the prior.
"""
DOUBTFUL_OUTLIERS = 3
"""Number of outliers within `SENSOR_WINDOW` readings that makes a sensor doubtful."""
SILENT_INTERVALS = 10.0
"""Time without a reading, in mean intervals of the sensor, after which the sensor is considered dead."""
STUCK_PROBABILITY = 1e-4
"""Probability that a working sensor repeats a value as often as observed, below which the sensor is considered stuck.
"""


@dataclass(frozen=True)
class Sensor:
    """State of one temperature sensor.

    Attributes
    ----------
    body : str
        Path of the body that carries the sensor.
    readings : int
        Number of readings so far.
    first_us, last_us : int
        Times of the first and of the newest reading, in microseconds of TAI since 2000.
    value : float
        Newest reading, in kelvin.
    repeats : int
        Number of readings directly before the newest that have the same value.
    since_us : int
        Time of the first of these equal readings, in microseconds of TAI since 2000.
    step : float
        Smallest nonzero difference of two consecutive readings (resolution), in kelvin; infinite as long as there is
        none.
    sigma : float
        Standard deviation of a reading, in kelvin.
    recent : tuple[float, ...]
        Residuals of the latest readings (reading minus prediction), in standard deviations.
    stuck : bool
        True if the sensor repeats its value more often than chance explains.
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
        """Return the sensor after one more reading, time in microseconds, value and sigma in kelvin."""
        again = value == self.value
        step = self.step if again or not self.readings else min(self.step, abs(value - self.value))
        repeats = self.repeats + 1 if again else 0
        # probability that two readings of a working sensor agree in the last digit
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
        """Return the sensor with the residual of its newest reading, in standard deviations, added to `recent`."""
        return replace(self, recent=(*self.recent, white)[-SENSOR_WINDOW:])

    @property
    def outliers(self) -> int:
        """Number of the latest readings whose residual exceeds `OUTLIER_SIGMAS`."""
        return sum(abs(white) > OUTLIER_SIGMAS for white in self.recent)

    @property
    def disagrees(self) -> bool:
        """True if the chi-square of the latest residuals exceeds its critical value."""
        square = sum(white**2 for white in self.recent)
        return bool(self.recent) and square > float(limit_of(FALSE_ALARM, len(self.recent)))

    def state(self, now: int, alone: bool) -> tuple[str, int, str]:
        """Return the sensor's condition, the time since which it has it, and the reason.

        The condition is ``ok``, ``dead``, ``stuck`` or ``doubtful``; the time is in microseconds of TAI since 2000.

        Parameters
        ----------
        now : int
            Time of the newest entry of the record, in microseconds of TAI since 2000.
        alone : bool
            True if no other sensor disagrees with the prior at the same time. If several do, the prior is considered
            wrong, and the sensor is not doubtful.
        """
        if self.stuck:
            return "stuck", self.since_us, f"{self.repeats + 1} consecutive readings of {self.value:.6g} K"
        usual = (self.last_us - self.first_us) / max(self.readings - 1, 1)
        if self.readings > 1 and now - self.last_us > SILENT_INTERVALS * usual:
            silence = (now - self.last_us) / MICRO / 86_400.0
            return (
                "dead",
                self.last_us,
                f"no reading for {silence:.3g} days; it normally reports every {usual / MICRO / 86_400.0:.3g} days",
            )
        if self.outliers >= DOUBTFUL_OUTLIERS and alone:
            text = f"{self.outliers} of the last {len(self.recent)} readings are over {OUTLIER_SIGMAS:g} sigma off"
            return "doubtful", self.last_us, text
        return "ok", self.first_us, ""


@dataclass(frozen=True)
class Scores:
    """Quality of the predictions of the monitor's readings, each made before the reading was used.

    Attributes
    ----------
    readings : int
        Number of readings of the monitor.
    components : int
        Number of decorrelated components (such as spot coordinates) of these readings, summed over the readings.
    within_one, within_two : int
        Number of components within one and within two standard deviations of the prediction.
    log_score : float
        Mean over the readings of the natural logarithm of the predicted probability density at the reading; the density
        is per px^D for D spot coordinates.
    chi_square : float
        Sum of squares of all components, each in standard deviations of its prediction.
    """

    readings: int = 0
    components: int = 0
    within_one: int = 0
    within_two: int = 0
    log_score: float = 0.0
    chi_square: float = 0.0

    def updated(self, white: Array, log_score: float) -> Scores:
        """Return the scores with one more reading.

        Parameters
        ----------
        white : ndarray
            Decorrelated components of the reading minus its prediction, in standard deviations.
        log_score : float
            Logarithm of the predicted probability density at the reading.
        """
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
    """Jump of a body, and the time of the reading at which it was detected, in microseconds of TAI since 2000."""

    time: int
    jump: Jump


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """State of the estimator after the record's entries up to a time.

    Array dimensions: Q quantities, D spot coordinates, P camera parameters, n filter states, U used entries, m motions
    that may jump.

    Attributes
    ----------
    filter_state : FilterState
        State of the filter; its seconds count from the epoch.
    time : int
        Time of the newest entry, in microseconds of TAI since 2000.
    scores : Scores
        Quality of the predictions so far.
    innovations : tuple[tuple[int, float, int], ...]
        (time_us, chi-square, degrees of freedom) of the latest readings' innovations (reading minus prediction).
    jumps : tuple[JumpDetection, ...]
        Jumps detected so far.
    sensors : Mapping[str, Sensor]
        Body -> its temperature sensor.
    excluded : tuple[tuple[int, str, str, str], ...]
        (time_us, kind, subject, reason) of the latest entries that were not used.
    scatter_sums : (4, Q) ndarray
        Four sums over the readings, for every quantity: of the quantity, of its square, of the quantity minus the part
        that temperatures explain, and of the square of this difference. `explained` is computed from them.
    basis : (D + P, n) ndarray
        Spot coordinates (px) and camera parameters (rad, m) due to one unit of each filter state. They identify the
        basis of the state space, which depends on the linear algebra library of the computer.
    used : (U,) ndarray of int64
        Ids of the entries used since the last permanent checkpoint, in their order.
    undetected_shares : (U, m) ndarray
        Before each of these entries and for each motion, the share of the mean square of its possible jumps that
        readings could not have detected, 0 to 1.
    new_innovations : tuple[tuple[int, float, int], ...]
        Innovations since the last permanent checkpoint, in the form of `innovations`.
    stuck_sensors : tuple[tuple[str, int], ...]
        (body, time_us) of sensors that repeat their value, with the time of the first equal reading; their readings
        from that time on are not used.
    pending : tuple[int, int] | None
        (id, time_us) of a possible outlier among the monitor's readings, about which the next reading decides; it is
        part of `used`.
    bad_readings : tuple[tuple[int, str], ...]
        (time_us, reason) of the latest readings of the monitor that were rejected as outliers, and of a pending one.
    first_innovations : tuple[tuple[int, float, int], ...]
        Innovations of the first readings of the record, in the form of `innovations`.
    disagreeing : tuple[str, ...]
        Bodies whose sensors have disagreed with the prior at the same time as other sensors.
    violations : tuple[Violation, ...]
        Spans of readings at which a requirement was violated, in the order of their beginnings.
    point : (R,) ndarray
        Point at which the time constants of the R learned terms are linearised; empty for that of the prior.
    due : int
        Number of readings at which the linearisation is checked next.
    passes : int
        Number of passes over the first `due` readings that began with a new linearisation.
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
    violations: tuple[Violation, ...] = ()
    point: Array = field(default_factory=lambda: np.zeros(0))
    due: int = 4
    passes: int = 0

    @property
    def explained(self) -> Array:
        """Share of each quantity's variance over the readings that measured temperatures explain, (Q,), 0 to 1.

        It is NaN as long as there are fewer than two readings.

        Array dimensions: Q quantities.
        """
        count = self.scores.readings
        if count < 2:
            return np.full(self.scatter_sums.shape[1], np.nan)
        total, square, left, left_square = self.scatter_sums
        whole = square / count - (total / count) ** 2
        rest = left_square / count - (left / count) ** 2
        return np.where(whole > 0.0, 1.0 - rest / np.where(whole > 0.0, whole, 1.0), np.nan)

    def excluding(self, time: int, kind: str, subject: str, reason: str) -> EstimatorState:
        """Return the state with one more entry in the list of excluded ones.

        Parameters
        ----------
        time : int
            Time of the entry, in microseconds of TAI since 2000.
        kind, subject : str
            Kind of the entry, and its body or camera.
        reason : str
            Reason for the exclusion.
        """
        return replace(
            self, time=max(self.time, time), excluded=(*self.excluded, (time, kind, subject, reason))[-HISTORY_LENGTH:]
        )

    def with_decision(self, excluded: str) -> EstimatorState:
        """Return the state after the decision about the reading that was a possible outlier.

        Parameters
        ----------
        excluded : str
            Reason for the exclusion; empty if the reading is used.
        """
        assert self.pending is not None
        number, time = self.pending
        entries = [entry for entry in self.excluded if (entry[0], entry[1]) != (time, "monitor")]
        bad = tuple(entry for entry in self.bad_readings if entry[0] != time)
        if not excluded:
            return replace(self, pending=None, excluded=tuple(entries), bad_readings=bad)
        good, bad = self.used != number, (*bad, (time, excluded))
        entries = [*entries, (time, "monitor", "monitor", excluded)]
        return replace(
            self,
            pending=None,
            excluded=tuple(entries),
            bad_readings=bad,
            used=self.used[good],
            undetected_shares=self.undetected_shares[good],
        )

    @property
    def newly_stuck(self) -> tuple[tuple[str, int], ...]:
        """Sensors newly recognised as stuck (repeating a value) after some repeated readings were used.

        Each is (body, time_us of the first equal reading).
        """
        stuck = ((sensor.body, sensor.since_us) for sensor in self.sensors.values() if sensor.stuck)
        return tuple(sensor for sensor in stuck if sensor not in self.stuck_sensors)

    @property
    def jointly_disagreeing(self) -> tuple[str, ...]:
        """Bodies whose sensors disagree with the prior, if there are several; empty otherwise.

        If several sensors disagree at the same time, it is more likely that the prior is wrong than that all these
        sensors are.
        """
        bodies = tuple(sorted(sensor.body for sensor in self.sensors.values() if sensor.disagrees))
        return bodies if len(bodies) > 1 else ()

    def with_innovation(self, time: int, predicted: Innovation) -> EstimatorState:
        """Return the state with the innovation (reading minus prediction) of a monitor reading that was used."""
        innovation = (time, predicted.chi_square, len(predicted.white))
        scores = self.scores.updated(predicted.white, predicted.log_score)
        innovations = (*self.innovations, innovation)[-HISTORY_LENGTH:]
        first = (*self.first_innovations, innovation)[: SPANS[-1]]
        return replace(
            self,
            scores=scores,
            innovations=innovations,
            new_innovations=(*self.new_innovations, innovation),
            first_innovations=first,
        )

    def with_counters_reset(self) -> EstimatorState:
        """Return the state with its lists of entries and innovations since the last permanent checkpoint emptied."""
        return replace(self, used=self.used[:0], undetected_shares=self.undetected_shares[:0], new_innovations=())

    @classmethod
    def from_bytes(cls, content: bytes) -> EstimatorState:
        """Return the estimator's state that was serialised by `packed`."""
        return cast("EstimatorState", unpacked(content, cls, Scores, Sensor, JumpDetection, Violation))


SAME_SPAN = 30 * 86_400 * MICRO
"""Time between two readings that violate a requirement below which they belong to one span, in microseconds."""


@dataclass(frozen=True)
class Violation:
    """Span of readings at which a requirement was violated, as estimated from the readings up to each of them.

    Attributes
    ----------
    quantity : str
        Group and key of the quantity.
    limit : float
        Limit of its absolute change, in its unit.
    since_us, until_us : int
        Times of the first and the last violating reading, in microseconds of TAI since 2000.
    readings : int
        Number of violating readings.
    worst_us : int
        Time of the largest absolute change.
    value, sigma, chance : float
        This change, its standard deviation, and the probability that it exceeds the limit.
    """

    quantity: str
    limit: float
    since_us: int
    until_us: int
    readings: int
    worst_us: int
    value: float
    sigma: float
    chance: float

    def appended_to(self, earlier: tuple[Violation, ...]) -> tuple[Violation, ...]:
        """Return earlier violations with this one; the spans of a continued violation of one requirement are joined."""
        for k, span in enumerate(earlier):
            same = (span.quantity, span.limit) == (self.quantity, self.limit)
            if same and self.since_us - span.until_us < SAME_SPAN:
                worst = max(span, self, key=lambda violation: abs(violation.value))
                count = span.readings + self.readings
                joined = replace(worst, since_us=span.since_us, until_us=self.until_us, readings=count)
                return (*earlier[:k], joined, *earlier[k + 1 :])
        return (*earlier, self)


@dataclass(frozen=True, eq=False)
class EntryFilter:
    """Filter that updates an estimator's state with the entries of a record.

    Array dimensions: C spots.

    Attributes
    ----------
    model : OperationModel
        Model of the instrument and its disturbances (unintended motions and temperature changes), from ray traces.
    series_filter : SeriesFilter
        Kalman filter of this model, in which the record's events are steps of the motions.
    epoch : int
        Origin of the filter's seconds, in microseconds of TAI since 2000.
    reference : (C, 2) ndarray
        Spot positions in the reference images, row and column in pixels; all shifts count from them.
    temperature : float
        Temperature of the instrument in its calibration, in kelvin.
    """

    model: OperationModel
    series_filter: SeriesFilter
    epoch: int
    reference: Array
    temperature: float

    def seconds(self, time: int) -> float:
        """Return the seconds from the epoch to a time in microseconds of TAI since 2000."""
        return (time - self.epoch) / MICRO

    def start(self, time: int, stuck_sensors: tuple[tuple[str, int], ...] = ()) -> EstimatorState:
        """Return the initial state of the estimator, before any entry of the record.

        Parameters
        ----------
        time : int
            Time of the first entry, in microseconds of TAI since 2000.
        stuck_sensors : tuple[tuple[str, int], ...]
            (body, time_us of the first equal reading) of sensors that are known to repeat their value.
        """
        spread = np.zeros((4, len(self.model.quantities)))
        filter_state, basis = self.series_filter.start(self.seconds(time)), self.series_filter.space.basis
        return EstimatorState(filter_state, time, scatter_sums=spread, basis=basis, stuck_sensors=stuck_sensors)

    def take(self, state: EstimatorState, entries: Sequence[Mapping[str, Any]]) -> EstimatorState:
        """Return the state updated with all entries of one moment.

        Parameters
        ----------
        state : EstimatorState
            State before these entries.
        entries : Sequence[Mapping[str, Any]]
            Entries of one time, each with its content as plain data and, under the key ``decided``, the decision of a
            person about it (whether it is used, and why), or None.
        """
        state = replace(state, time=max(state.time, int(entries[0]["time_us"])))
        for entry in entries:
            if (decision := entry["decided"]) is not None and not decision[0]:
                reason = f"entry {entry['id']} was excluded: {decision[1]}"
                state = state.excluding(int(entry["time_us"]), str(entry["kind"]), str(entry["subject"]), reason)
        entries = [entry for entry in entries if entry["decided"] is None or entry["decided"][0]]
        warm = sorted(
            (entry for entry in entries if entry["kind"] == "temperature"), key=lambda reading: str(reading["subject"])
        )
        for reading in warm:
            state = self._temperature(state, reading)
        for reading in entries:
            if reading["kind"] in ("monitor", "focus"):
                state = self._monitor(state, reading)
        return state

    def observed(self, entry: Mapping[str, Any]) -> Observed:
        """Convert an entry of the record to an observation for the Kalman filter.

        Parameters
        ----------
        entry : Mapping[str, Any]
            Reading of the monitor, or of a sensor that the filter knows.
        """
        time, content = self.seconds(int(entry["time_us"])), entry["content"]
        if entry["kind"] == "temperature":
            assert self.series_filter.heat is not None
            number = self.series_filter.heat.sensors.index(str(entry["subject"]))
            value, noise = np.array([float(content["values"][0]) - self.temperature]), float(content["sigma"]) ** 2
            return Observed(time, value, np.array([[noise]]), (number,))
        if entry["kind"] == "focus":
            return Observed(time, np.array(content["values"][:1]), np.array([[float(content["sigma"]) ** 2]]))
        spots = content["numbers"]["spots"]
        spots_after = [spots[camera][channel]["after"] for camera, channel in self.model.spots]
        positions = np.array([(spot["row"], spot["column"]) for spot in spots_after])
        sigma = np.array([(spot["row_sigma"], spot["column_sigma"]) for spot in spots_after])
        return Observed(time, (positions - self.reference).ravel(), np.diag(sigma.ravel() ** 2))

    def _updated(
        self, state: EstimatorState, entry: Mapping[str, Any], observed: Observed
    ) -> tuple[EstimatorState, Innovation]:
        """Return the state updated with one observation, and the innovation (observation minus prediction)."""
        filter_state, innovation = self.series_filter.update(state.filter_state, observed, entry["decided"] is not None)
        used = np.append(state.used, np.int64(entry["id"]))
        # the number of columns is zero if no motion may jump
        before = state.undetected_shares.reshape(len(state.used), len(self.series_filter.walking))
        left = np.concatenate([before, state.filter_state.undetected[None]])
        return replace(state, filter_state=filter_state, used=used, undetected_shares=left), innovation

    def _temperature(self, state: EstimatorState, entry: Mapping[str, Any]) -> EstimatorState:
        """Return the state updated with the reading of a temperature sensor."""
        time, body, content = int(entry["time_us"]), str(entry["subject"]), entry["content"]
        sensor = state.sensors.get(body, Sensor(body)).updated(
            time, float(content["values"][0]), float(content["sigma"])
        )
        state = replace(state, sensors={**state.sensors, body: sensor})
        if self.series_filter.heat is None or body not in self.series_filter.heat.sensors:
            return state.excluding(time, "temperature", body, "the plan states no temperature of this body")
        included = entry["decided"] is not None
        if not included and (sensor.stuck or (body, sensor.since_us) in state.stuck_sensors):
            return state.excluding(time, "temperature", body, "its sensor is stuck")
        observed = self.observed(entry)
        there = self.series_filter.at(state.filter_state, observed.time)
        white = float(self.series_filter.whitened(there.state, observed).white[0])
        sensor = sensor.with_residual(white)
        state = replace(state, sensors={**state.sensors, body: sensor})
        if body in state.jointly_disagreeing:  # the prior is wrong, not the sensor
            times = max(abs(white), 1.0)
            inflated = self.series_filter.inflated(there, observed, times) if times > INFLATION_SIGMAS else there
            disagreeing = tuple(sorted({*state.disagreeing, *state.jointly_disagreeing}))
            state = replace(state, filter_state=inflated, disagreeing=disagreeing)
        elif abs(white) > OUTLIER_SIGMAS and not included:
            reason = f"{abs(white):.3g} standard deviations from its prediction"
            return state.excluding(time, "temperature", body, reason)
        return self._updated(state, entry, observed)[0]

    def _monitor(self, state: EstimatorState, entry: Mapping[str, Any]) -> EstimatorState:
        """Return the estimator's state updated with a reading of the monitor (spot positions) or of focus."""
        time = int(entry["time_us"])
        if entry["content"].get("numbers", {}).get("sigma_holds") is False:
            return state.excluding(time, "monitor", "monitor", "its reported sigma does not hold")
        observed, before = self.observed(entry), state.filter_state.pending
        state, innovation = self._updated(state, entry, observed)
        if innovation.settled and state.pending is not None and before is not None:
            number, when = state.pending
            state = state.with_decision("" if innovation.earlier else self._outlier_text(number, before.innovation))
            if innovation.earlier is not None:
                state = state.with_innovation(when, innovation.earlier)
        if innovation.bad is not None:
            number = int(entry["id"])
            reason = f"{self._outlier_text(number, innovation)}; the next reading decides whether it is excluded"
            state = replace(
                state, pending=(number, time), bad_readings=(*state.bad_readings, (time, reason))[-HISTORY_LENGTH:]
            )
            return state.excluding(time, "monitor", "monitor", reason)
        filter_state, space, rows = state.filter_state, self.series_filter.space, self.model.rows
        values = rows @ self.series_filter.parameters_of(filter_state.mean, filter_state.covariance, observed.time)[0]
        rest = values - rows @ space.heat_outputs(filter_state.mean, observed.time)[space.width :]
        spread = np.stack([values, values**2, rest, rest**2])
        return replace(
            state.with_innovation(time, innovation),
            jumps=state.jumps if innovation.jump is None else (*state.jumps, JumpDetection(time, innovation.jump)),
            scatter_sums=state.scatter_sums + (spread if innovation.earlier is None else 2.0 * spread),
        )

    def _outlier_text(self, number: int, innovation: Innovation) -> str:
        """Return a text with the reason why a reading is rejected as an outlier."""
        assert innovation.bad is not None
        camera, channel = self.model.spots[innovation.bad.coordinate // 2]
        axis = ("row", "column")[innovation.bad.coordinate % 2]
        what = f"the focus of {camera}" if channel == "focus" else f"the {axis} of spot {camera}/{channel}"
        text = f"entry {number}: {what} is {abs(innovation.bad.z):.3g} sigma from its"
        return f"{text} prediction, and no jump of the stated size explains it"
