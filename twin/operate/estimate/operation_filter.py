"""Estimate of an instrument's state from its record: now, at any past time and ahead, with standard deviations.

The work for a new reading does not depend on the length of the record: the estimator's state is stored in the record
beside the readings, and filtering continues from there. After a reading that arrived late, it continues from the newest
checkpoint (stored state) before it. The result is identical to the bit, however often and whenever it is computed.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import groupby
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import pdtrc

from analysis.arrays import Array
from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.filter_state import FilterState, Observed
from analysis.monitor.jump_detection import Jump, Step
from analysis.monitor.kalman_filter import (
    DetectionPower,
    SeriesFilter,
    detection_power,
    smooth_jointly,
    smoothed,
    with_indicated_jumps,
)
from analysis.monitor.learned_terms import Move, Terms
from analysis.monitor.limits import Quantity
from optics.numerics.backend import load_backend, one_blas_thread
from scenes.specs.operation import OperationSetup
from scenes.yaml.errors import Problem
from twin.framework.provenance import source_digest
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.estimate.estimate_snapshot import EntryFilter, EstimatorState, Violation, packed, unpacked
from twin.operate.estimate.learned_model import (
    MOVE,
    NEAR,
    LearnedTerm,
    contradicted_moves,
    excluded_moves,
    learned_terms,
    terms_of,
)
from twin.operate.estimate.operation_model import OperationModel, focus_model, plan_digest, traced_model
from twin.operate.estimate.reported_estimate import (
    Course,
    DetectedJump,
    FilterResult,
    Motions,
    RequirementStatus,
    SensorState,
    inflation_factors,
)
from twin.operate.record.entries import MICRO, digest_of_data, utc_text
from twin.operate.record.history import USED, History, content_of

DAY = 86_400 * MICRO
"""One day, in microseconds."""
CHECKPOINT_READINGS = 1000
"""Number of readings between two permanent checkpoints of the estimator's state."""
HEAD_READINGS = 16
"""Number of new readings after which the newest state is saved.

Filtering so many readings again takes as long as saving the state.
"""
CHECKED_READINGS = 2000
"""Number of the latest readings among which commanded moves are compared with the readings."""
MOST_PASSES, READINGS_RATIO = 6, 1.25
"""Largest number of linearisations at one number of readings, and ratio of that number to the next one."""
_MODEL, _HEAD = -1, 0
"""Numbers of two checkpoints in the record: the traced model, and the newest state of the estimator."""


class Operation:
    """Estimate of an instrument's state from its record, under a plan of operation.

    Parameters
    ----------
    history
        Record of the instrument in operation.
    plan
        Plan of operation of the record's instrument.
    advance
        Callback that receives the number of readings filtered so far, and their total.
    previous
        Estimate of the same record before the newest readings, from which this one continues; None if there is none.

    Attributes
    ----------
    epoch
        Time of the first reading of the monitor, in microseconds of TAI since 2000; the filter's seconds count from it.
    key
        SHA-256 of all inputs other than the readings on which the estimate depends (such as plan and program); it
        identifies the checkpoints.

    Raises
    ------
    Problem
        The record has no reading of the monitor.
    InputError
        The plan specifies motions that its instrument cannot make.
    """

    def __init__(
        self,
        history: History,
        plan: OperationSetup,
        advance: Callable[[int, int], None] = lambda done, of: None,
        previous: Operation | None = None,
    ) -> None:
        self.history, self.plan, self._advance = history, plan, advance
        self._previous: tuple[EstimatorState | None, int] = None, 0
        self._newest = self._saved = 0
        self._stuck_sensors: tuple[tuple[str, int], ...] = ()
        focus = plan.operation.focus
        self._kinds = USED if focus is None else ("focus",)
        first = history.first(self.reading_kind)
        if first is None or (focus is not None and focus.camera not in history.subjects("focus")):
            if focus is not None:
                raise Problem(
                    f"the record has no reading of the focus of {focus.camera}", None, "a table of kind focus"
                )
            allowed = "python -m twin.operate ingest RECORD RUN adds a run of twin.recover or twin.render"
            raise Problem("the record has no reading of the monitor", None, allowed)
        self.epoch = int(first["time_us"])
        self._point: Array = np.zeros(0)
        spots = {} if focus is not None else content_of(first)["numbers"]["spots"]
        before = [
            (camera, channel, reading["before"])
            for camera, parts in spots.items()
            for channel, reading in parts.items()
        ]
        self._before = {(camera, channel): reading for camera, channel, reading in before}
        self._sensors = tuple(body for body in history.subjects("temperature") if body in history.bodies["warm"])
        self._plan_digest: str = plan_digest(plan) if previous is None else previous._plan_digest
        order = [list(plan.model.instrument.cameras), list(plan.disturbances.causes)]
        needs = [[each.name, each.largest, each.probability] for each in plan.operation.requirements]
        parts = [self._plan_digest, order, self.epoch, list(self._sensors), [list(reading) for reading in before]]
        self.key = digest_of_data([source_digest(), needs, *parts])
        """SHA-256 of everything besides the readings that the estimate depends on."""
        if previous is not None and previous.key == self.key:
            known = vars(previous)
            vars(self).update({name: known[name] for name in ("experiment", "model") if name in known})
            learns = bool(plan.operation.terms) or history.first(MOVE) is not None
            if "_entry_filter" in known and previous.events == self.events and not learns:
                vars(self)["_entry_filter"] = known["_entry_filter"]
                self._previous, self._saved = (known.get("estimator_state"), previous._newest), previous._saved

    def updated(self) -> Operation:
        """Continue the estimate with the newest readings of the record, which is faster than a new estimate."""
        return Operation(self.history, self.plan, self._advance, self)

    @cached_property
    def experiment(self) -> MonitorExperiment:
        """Monitored instrument with its monitor, ready to be traced."""
        return MonitorExperiment(self.plan.model, load_backend())

    @cached_property
    def model(self) -> OperationModel:
        """Traced effects of all motions on spots and cameras, read from the record if stored there; or on the focus."""
        checkpoint = self.history.checkpoint(self.key, number=_MODEL)
        if checkpoint is not None:
            return cast("OperationModel", unpacked(checkpoint.content, OperationModel))
        if self.plan.operation.focus is not None:
            return focus_model(self.plan, self.experiment)
        sigma = np.array([(spot["row_sigma"], spot["column_sigma"]) for spot in self._before.values()])
        model = traced_model(self.plan, sigma, self._sensors, self.experiment)
        self.history.save_checkpoint(self.key, _MODEL, -(2**62), 0, packed(model))
        return model

    @property
    def reading_kind(self) -> str:
        """Kind of the readings that are filtered: ``monitor`` or ``focus``."""
        return self._kinds[0]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """All estimated quantities (changes of the cameras, of their angle and of ground positions)."""
        return self.model.quantities

    @cached_property
    def events(self) -> tuple[tuple[int, str, tuple[str, ...]], ...]:
        """Events of the record at which motions step according to the plan, each as (time_us, name, causes)."""
        events = ((int(entry["time_us"]), str(entry["subject"])) for entry in self.history.entries("event"))
        known = self.plan.operation.events
        return tuple((time, name, tuple(known[name])) for time, name in events if known.get(name))

    @cached_property
    def _entry_filter(self) -> EntryFilter:
        """Kalman filter that allows for steps of the motions at the record's events."""
        causes = self.model.series_filter.prior.causes
        steps = []
        for time, _, stepping in self.events:
            motions = tuple(k for k, cause in enumerate(causes) if cause in stepping)
            steps.append(Step(((motions, 1.0),), (((time - self.epoch) / MICRO, 1.0),)))
        terms = self._prior_terms
        if terms is not None and len(self._point):
            terms = replace(terms, point=self._point)
        series_filter = replace(self.model.series_filter, steps=tuple(steps), terms=terms)
        spots = [self._before[spot] for spot in self.model.spots if spot in self._before]
        reference = np.array([(spot["row"], spot["column"]) for spot in spots])
        return EntryFilter(self.model, series_filter, self.epoch, reference, self.history.temperature)

    @cached_property
    def _prior_terms(self) -> Terms | None:
        """Terms of the plan and moves of the record, linearised at the prior; None if there are none."""
        operation = self.plan.operation
        return terms_of(operation, self.model.series_filter.prior, self.history, self.epoch, self.reading_kind)

    def _moments(self, after_us: int | None) -> Iterator[list[dict[str, Any]]]:
        """Yield the entries that the estimate uses, grouped by time, in the order of time."""
        focus = self.plan.operation.focus
        used = (
            entry
            for entry in self.history.entries(after_us=after_us)
            if entry["kind"] in self._kinds and (focus is None or entry["subject"] == focus.camera)
        )
        for _, entries in groupby(used, key=lambda row: int(row["time_us"])):
            yield [
                {**entry, "content": content_of(entry), "decided": self._decisions.get(entry["id"])}
                for entry in entries
            ]

    @cached_property
    def _decisions(self) -> dict[int, tuple[bool, str]]:
        """Decisions of persons about entries, read once."""
        return self.history.decisions()

    @cached_property
    def estimator_state(self) -> EstimatorState:
        """State of the estimator after all readings; new readings are filtered on first use."""
        with one_blas_thread():
            return self._latest_state()

    def _latest_state(self) -> EstimatorState:
        """Return the estimator's state after all readings, and save checkpoints on the way."""
        newest = self.history.newest_id()
        self._newest = newest
        state = self._load_state()
        curved = self._prior_terms is not None and bool(self._prior_terms.curved)
        moments = list(self._moments(None if state is None else state.time))
        count = 0
        while count < len(moments):
            entry_filter = self._entry_filter
            if state is None:
                state = entry_filter.start(int(moments[0][0]["time_us"]))
            before = state.scores.readings
            read = any(entry["kind"] == "monitor" for entry in moments[count])
            state = entry_filter.take(state, moments[count])
            count += 1
            if state.newly_stuck:
                state = self._rewind(state)
                moments, count = list(self._moments(None if state is None else state.time)), 0
                if state is None:
                    state = self._entry_filter.start(int(moments[0][0]["time_us"]), self._stuck_sensors)
                continue
            if read:
                state = self._judged(state)
            if curved and state.scores.readings >= state.due:
                linearised = self._relinearised(state)
                if linearised.scores.readings < state.scores.readings:
                    moments, count = list(self._moments(None)), 0
                state = linearised
                continue
            number = 0 if curved else state.scores.readings // CHECKPOINT_READINGS
            if number > before // CHECKPOINT_READINGS:
                self._save_state(state, number, newest)
                state = state.with_counters_reset()
            self._advance(count, len(moments))
        assert state is not None  # there is a reading of the monitor
        if state.scores.readings >= self._saved + HEAD_READINGS:
            self._save_state(state, _HEAD, newest)
            self._saved = state.scores.readings
        return state

    def _relinearised(self, state: EstimatorState) -> EstimatorState:
        """Return the state with the next check of its linearisation, or an initial one with a new linearisation.

        The points depend on the numbers of readings alone, so that the estimate does not depend on when it was asked.
        Permanent checkpoints, which would have other points, are not made.
        """
        series_filter, current = self._entry_filter.series_filter, state.filter_state
        terms, at = series_filter.terms, series_filter.space.term_states
        assert terms is not None
        moved = terms.relinearised(current.mean[at], current.covariance[at, at])
        count = state.scores.readings
        if moved is None or state.passes >= MOST_PASSES:
            return replace(state, due=max(count + 4, round(READINGS_RATIO * count)), passes=0)
        self._point = cast("Array", moved.point)
        vars(self).pop("_entry_filter")
        first = int(next(self._moments(None))[0]["time_us"])
        start = self._entry_filter.start(first, self._stuck_sensors)
        return replace(start, point=self._point, due=state.due, passes=state.passes + 1)

    def _judged(self, state: EstimatorState) -> EstimatorState:
        """Return the estimator's state with every requirement judged at its newest reading of the monitor."""
        if not self.plan.operation.requirements:
            return state
        then = copy.copy(self)  # has nothing yet that depends on the state, which is being computed
        vars(then)["estimator_state"] = state
        now, violations = then.forecast([state.time]), state.violations
        for requirement in self.plan.operation.requirements:
            k, limit = now.number(requirement.name), requirement.largest
            exceedance = float(now.exceedance(requirement.name, limit)[0])
            if exceedance > 1.0 - requirement.probability:
                times, value, sigma = (state.time, state.time, 1, state.time), now.values[0, k], now.sigmas[0, k]
                span = Violation(requirement.name, limit, *times, float(value), float(sigma), exceedance)
                violations = span.appended_to(violations)
        return replace(state, violations=violations)

    def _rewind(self, state: EstimatorState) -> EstimatorState | None:
        """Return the newest checkpoint before a sensor got stuck; None if there is none.

        Filtering continues from there without the readings of this sensor since it got stuck.
        """
        self._stuck_sensors = (*state.stuck_sensors, *state.newly_stuck)
        since = min(time for _, time in state.newly_stuck)
        self.history.drop_checkpoints(self.key, since)
        self._saved, self._point = 0, np.zeros(0)
        vars(self).pop("_entry_filter", None)
        checkpoint = self.history.checkpoint(self.key, before_us=since, valid=True)
        return (
            None
            if checkpoint is None
            else replace(
                EstimatorState.from_bytes(checkpoint.content).with_counters_reset(), stuck_sensors=self._stuck_sensors
            )
        )

    def _load_state(self) -> EstimatorState | None:
        """Return the newest saved state that is still valid; None if there is none."""
        state, newest = self._previous
        if state is not None and not self.history.came_late(newest, state.time):
            return state
        checkpoint = self.history.checkpoint(self.key, valid=True)
        if checkpoint is None:
            return None
        state = EstimatorState.from_bytes(checkpoint.content)
        self._saved = state.scores.readings
        if len(state.point) and self._prior_terms is not None and len(state.point) == len(self._prior_terms.members):
            self._point = state.point
            vars(self).pop("_entry_filter", None)
        if not self._has_same_basis(state):
            self.history.drop_checkpoints(self.key, self.epoch)
            self._saved, self._point = 0, np.zeros(0)
            vars(self).pop("_entry_filter")
            return None
        # a permanent checkpoint lists the entries used before it
        return state.with_counters_reset() if checkpoint.number > _HEAD else state

    def _has_same_basis(self, state: EstimatorState) -> bool:
        """Return whether a saved state has the basis of the state space that this computer's linear algebra gives."""
        basis = self._entry_filter.series_filter.space.basis
        if state.basis.shape != basis.shape:
            return False
        return bool(np.all(np.abs(state.basis - basis) <= 1e-9 * np.abs(basis).max(axis=1, keepdims=True)))

    def _save_state(self, state: EstimatorState, number: int, newest: int) -> None:
        """Save the estimator's state in the record as the checkpoint of the given number."""
        self.history.save_checkpoint(self.key, number, state.time, newest, packed(state))

    def filter_readings(self) -> FilterResult:
        """Filter all new readings; return the present estimate with jumps, sensors and requirements."""
        state = self.estimator_state
        now = self.forecast([state.time])
        jumps = tuple(self._detected_jump(jump.time, jump.jump) for jump in state.jumps)
        sensors = []
        for sensor in state.sensors.values():
            condition, since, reason = sensor.state(state.time, sensor.body not in state.jointly_disagreeing)
            sensors.append(SensorState(sensor.body, condition, since, sensor.last_us, reason))
        return FilterResult(
            state.time,
            state.scores.readings,
            now,
            state.scores,
            state.innovations,
            jumps,
            self.events,
            tuple(sorted(sensors, key=lambda item: item.body)),
            (*state.excluded, *excluded_moves(self.history)),
            {item.name: share for item, share in zip(self.quantities, state.explained.tolist(), strict=True)},
            self._sigma_inflation,
            self.too_many_jumps,
            self._requirement_status(),
            state.bad_readings,
            state.pending is not None,
            self._understated_causes(),
            state.violations,
            self._learned_terms(),
        )

    def _learned_terms(self) -> tuple[LearnedTerm, ...]:
        """Return the estimates of the terms and moves from all readings, with the moves that the readings contradict.

        That test, of moves among the last `CHECKED_READINGS`, assumes all jumps but those near a move, which may be the
        mistake itself.
        """
        series_filter = self._entry_filter.series_filter
        if series_filter.terms is None:
            return ()
        contradicted = {}
        if self.history.first(MOVE) is not None:
            moves = [term.time for term in series_filter.terms.terms if isinstance(term, Move)]
            read = sorted(time for time, _, _ in self._segment_innovations())
            begin = self._begin() if len(read) <= CHECKED_READINGS else read[-CHECKED_READINGS]
            times = [(time - self.epoch) / MICRO for time in read]
            apart = []
            for detected, step in zip(self.estimator_state.jumps, self._steps(), strict=True):
                places = np.searchsorted(times, [detected.jump.after, detected.jump.until, *moves])
                if not np.any((places[2:] > places[0] - NEAR) & (places[2:] < places[1] + NEAR)):
                    apart.append(step)
            with one_blas_thread():
                how, start, observed, _ = self._smoothing_inputs(begin)
                how = replace(how, steps=(*series_filter.steps, *apart), include_undetected=False)
                contradicted = contradicted_moves(
                    how,
                    replace(start, undetected=np.zeros(0)),
                    observed,
                    self._sigma_inflation,
                    lambda seconds: utc_text(self.epoch + round(seconds * MICRO))[:10],
                )
        return learned_terms(series_filter, self._now, self.epoch, contradicted)

    def _segment_innovations(self) -> list[tuple[int, float, int]]:
        """Return (time_us, chi-square, degrees of freedom) of all readings."""
        return [innovation for span in self._segments(None) for innovation in span.new_innovations]

    def power(self) -> tuple[DetectionPower, ...]:
        """Return the smallest detectable jump of each body at the mean interval of the readings so far.

        The result is empty for a single reading.
        """
        count, noise = self.estimator_state.scores.readings, self.model.series_filter.reference_noise
        if self.plan.operation.focus is not None:
            first = cast("dict[str, Any]", self.history.first("focus"))
            noise = np.array([[float(content_of(first)["sigma"]) ** 2]])
        if count < 2 or noise is None:
            return ()
        interval = (self.estimator_state.time - self.epoch) / MICRO / (count - 1)
        with one_blas_thread():
            return detection_power(self.model.series_filter, interval, noise)

    def _understated_causes(self) -> tuple[str, ...]:
        """Return the causes, in the prior, of temperatures with which the sensors of several bodies disagree."""
        prior, heat, disagreeing = (
            self.model.series_filter.prior,
            self.model.series_filter.heat,
            self.estimator_state.disagreeing,
        )
        if heat is None:
            return ()
        lasting = (k for k in heat.motions.tolist() if prior.bodies[k] in disagreeing and not prior.laws[k].white)
        return tuple(dict.fromkeys(prior.causes[k] for k in lasting))

    def _detected_jump(self, detected_us: int, jump: Jump) -> DetectedJump:
        """Return a jump of the filter with its sizes and its effect on every quantity, in reporting units."""
        sizes = tuple(zip(jump.labels, jump.units, jump.sizes, jump.sigmas, strict=True))
        after, until = (self.epoch + round(time * MICRO) for time in (jump.after, jump.until))
        change, spread, rows = np.array(jump.change), np.array(jump.spread), self.model.rows
        width = self.model.series_filter.space.width
        read, changed = rows @ (self.model.reading @ change[:width]), rows @ change[width:]
        sigma = np.sqrt(np.einsum("qi,ij,qj->q", rows, spread[width:, width:], rows))
        each = zip(self.quantities, read.tolist(), changed.tolist(), sigma.tolist(), strict=True)
        line_changes = {quantity.name: (was, now, spread) for quantity, was, now, spread in each}
        return DetectedJump(
            jump.body, after, until, detected_us, sizes, jump.log_ratio, jump.false_alarm, jump.rivals, line_changes
        )

    def _requirement_status(self) -> tuple[RequirementStatus, ...]:
        """Return the status of every requirement of the plan, now and within the horizon of the forecast."""
        operation, start = self.plan.operation, self.estimator_state.time
        if not operation.requirements:
            return ()
        days = max(1, round(operation.horizon * MICRO / DAY))
        ahead = self.forecast([start + round(k * operation.horizon * MICRO / days) for k in range(days + 1)])
        out = []
        for requirement in operation.requirements:
            exceedance = ahead.exceedance(requirement.name, requirement.largest)
            broken = np.flatnonzero(exceedance > 1.0 - requirement.probability)
            breaks_us = int(ahead.times[broken[0]]) if len(broken) else None
            unit = self.quantities[ahead.number(requirement.name)].parameter.unit
            holds = not (len(broken) and broken[0] == 0)
            out.append(
                RequirementStatus(
                    requirement.name,
                    unit,
                    requirement.largest,
                    requirement.probability,
                    float(exceedance[0]),
                    holds,
                    breaks_us,
                )
            )
        return tuple(out)

    def forecast(self, times_us: Sequence[int] | NDArray[np.int64]) -> Course:
        """Return the expected values at future times, given all readings.

        Array dimensions: T times.

        Parameters
        ----------
        times_us : (T,) sequence of int
            Microseconds of TAI since 2000, not before the newest reading.

        Raises
        ------
        Problem
            A time is before the newest reading.
        """
        times = np.asarray(times_us, np.int64)
        if len(times) and times.min() < self.estimator_state.time:
            allowed = f"times from the newest reading, {utc_text(self.estimator_state.time)}, on"
            raise Problem("the time of the forecast is in the past", utc_text(int(times.min())), allowed)
        series_filter = self._entry_filter.series_filter
        with one_blas_thread():
            estimates = [series_filter.parameters(self._now, self._entry_filter.seconds(int(time))) for time in times]
        return self._course(times, estimates, np.full(len(times), self._sigma_inflation))

    @cached_property
    def _now(self) -> FilterState:
        """Filter state after all readings, as the mixture over possible undetected jumps and their probabilities."""
        return self._entry_filter.series_filter.mixture(self.estimator_state.filter_state)

    @cached_property
    def _sigma_inflation(self) -> float:
        """Factor by which present sigmas are inflated if the latest readings contradict the prior; 1 if they do not."""
        squares = self._unexplained(self.estimator_state.innovations)
        times = [time for time, _, _ in self.estimator_state.innovations]
        return float(inflation_factors(squares, [len(squares)], False, self._lasting(times))[0])

    def _lasting(self, times: Sequence[int]) -> list[tuple[int, Array]]:
        """Return contradictions between readings and prior that enlarge the sigmas of all later estimates.

        Each is (number of readings before it, array of chi-square and degrees of freedom). They come from the first
        readings, and from residuals that a detected jump does not explain.
        """
        out = [(0, self._unexplained(self.estimator_state.first_innovations))]
        jumps = [] if self.too_many_jumps else self.estimator_state.jumps
        return out + [(int(np.searchsorted(times, jump.time)) + 1, np.array([jump.jump.rest])) for jump in jumps]

    @cached_property
    def too_many_jumps(self) -> bool:
        """True if significantly more jumps were detected than the plan's rates predict (p-value below 0.001).

        For a body without a specified rate, one jump is expected.
        """
        prior, lasted = self.model.series_filter.prior, (self.estimator_state.time - self.epoch) / MICRO
        mean_intervals = {body: law.every_s for body, law in zip(prior.bodies, prior.laws, strict=True) if law.jump}
        mean = sum(1.0 if rate is None else lasted / rate for rate in mean_intervals.values())
        count = len(self.estimator_state.jumps)
        return bool(count > 1 and pdtrc(count - 1, mean) < FALSE_ALARM)

    def _unexplained(self, innovations: Sequence[tuple[int, float, int]]) -> Array:
        """Return chi-square and degrees of freedom (N, 2) of readings; zero where a detected jump explains them.

        If too many jumps were detected (`too_many_jumps`), none counts as an explanation.

        Array dimensions: N readings.
        """
        jumps = (
            []
            if self.too_many_jumps
            else [self._detected_jump(jump.time, jump.jump) for jump in self.estimator_state.jumps]
        )
        out = np.array([(square, degrees) for _, square, degrees in innovations], np.float64).reshape(-1, 2)
        times = np.array([time for time, _, _ in innovations], np.int64)
        for jump in jumps:
            out[(times > jump.after_us) & (times <= jump.detected_us)] = 0.0
        return out

    def _course(
        self, times: NDArray[np.int64], estimates: Sequence[tuple[Array, Array]], sigma_inflation: Array
    ) -> Course:
        """Convert estimated camera parameters and covariances at given times to all quantities with their sigmas."""
        rows = self.model.rows
        changes = np.array([part for part, _ in estimates]).reshape(len(times), rows.shape[1])
        covariance = np.array([part for _, part in estimates]).reshape(len(times), rows.shape[1], rows.shape[1])
        covariance = covariance * sigma_inflation[:, None, None] ** 2
        variance = np.einsum("qi,tij,qj->tq", rows, covariance, rows)
        sigmas = np.sqrt(np.maximum(variance, 0.0))
        return Course(times, self.quantities, changes @ rows.T, sigmas, changes, covariance)

    def smoothed(self, times_us: Sequence[int] | NDArray[np.int64]) -> Course:
        """Return the smoothed estimate at given times from all readings; after the newest reading it is the forecast.

        Array dimensions: T times.

        Parameters
        ----------
        times_us : (T,) sequence of int
            Microseconds of TAI since 2000, from the first reading on.

        Raises
        ------
        Problem
            A time is before the first reading.
        """
        times = np.asarray(times_us, np.int64)
        estimates = self._states_at(times, self._entry_filter.series_filter.parameters_of)
        return self._course(times, estimates, self._sigma_inflation_at(times))

    def _sigma_inflation_at(self, times: NDArray[np.int64]) -> Array:
        """Return the factors (T,) by which sigmas at given times are inflated where readings contradict the prior.

        After the newest reading it is the present factor. Array dimensions: T times.
        """
        innovations = self._segment_innovations()
        squares = self._unexplained(innovations)
        counts = np.searchsorted([time for time, _, _ in innovations], times, side="right")
        out = inflation_factors(squares, counts, True, self._lasting([time for time, _, _ in innovations]))
        out[times >= self.estimator_state.time] = self._sigma_inflation
        return out

    def motions(self, time_us: int, acting: bool = False) -> Motions:
        """Return the estimates of all specified motions at one time, from all readings.

        Parameters
        ----------
        time_us : int
            Microseconds of TAI since 2000, from the first reading on.
        acting : bool
            True to multiply the temperatures of bodies with sensors by the estimated ratio of their true to their
            computed optical effect, so that the traced effect of the motions agrees with `smoothed`.

        Raises
        ------
        Problem
            The time is before the first reading.
        """
        prior = self.model.series_filter.prior
        series_filter = replace(
            self._entry_filter.series_filter, steps=(*self._entry_filter.series_filter.steps, *self._steps())
        )
        since = self._entry_filter.seconds(self.epoch)
        estimates = self._states_at(
            np.array([time_us], np.int64),
            lambda mean, covariance, time: series_filter.motions_of(mean, covariance, time, since, acting),
        )
        (mean, spread), size = estimates[0], prior.sigmas
        spread = spread * self._sigma_inflation_at(np.array([time_us], np.int64))[0] ** 2
        return Motions(int(time_us), prior.labels, prior.units, size * mean, size[:, None] * spread * size)

    def _steps(self, detected_after: int | None = None) -> tuple[Step, ...]:
        """Return the detected jumps as steps for the filter, optionally only those detected after a time."""
        later_jumps = (
            jump for jump in self.estimator_state.jumps if detected_after is None or jump.time > detected_after
        )
        return tuple(Step.of(detected.jump) for detected in later_jumps)

    def _states_at(
        self, times: NDArray[np.int64], each: Callable[[Array, Array, float], tuple[Array, Array]]
    ) -> list[tuple[Array, Array]]:
        """Evaluate a function of the smoothed (or, after the newest reading, forecast) state at given times."""
        entry_filter, last = self._entry_filter, self.estimator_state
        if len(times) and times.max() >= last.time:
            with one_blas_thread():
                ahead = []
                for second in (entry_filter.seconds(int(time)) for time in times[times >= last.time]):
                    there = entry_filter.series_filter.at(self._now, second)
                    ahead.append(each(there.mean, there.covariance, second))
            past, ahead_of = iter(self._states_at(times[times < last.time], each)), iter(ahead)
            return [next(ahead_of if time >= last.time else past) for time in times]
        if not len(times):
            return []
        self._require_known(int(times.min()))
        with one_blas_thread():
            seconds = [entry_filter.seconds(int(time)) for time in times]
            series_filter, start, observed, left = self._smoothing_inputs(int(times.min()))
            return smoothed(series_filter, start, observed, seconds, left, each)

    def smooth_jointly(self, times_us: Sequence[int] | NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the smoothed estimate at several times with the joint covariance of all times.

        Array dimensions: T times, K cameras with 4 parameters each.

        Parameters
        ----------
        times_us : (T,) sequence of int
            Microseconds of TAI since 2000, ascending, from the first reading on. If one of them is before the newest
            reading, possible jumps that are not yet significant are ignored at the later times.

        Returns
        -------
        tuple of ndarray
            (T, 4 K) rotations d_alpha, d_beta, d_gamma (rad) and changes d_f of the principal distance (m) of one
            camera after the other, and (T, 4 K, T, 4 K) covariance of their errors. At a single time they equal
            `smoothed`.

        Raises
        ------
        Problem
            A time is before the first reading.
        """
        times, entry_filter = np.asarray(times_us, np.int64), self._entry_filter
        seconds = [entry_filter.seconds(int(time)) for time in times]
        with one_blas_thread():
            if not len(times) or times[0] >= self.estimator_state.time:
                values, covariance = smooth_jointly(entry_filter.series_filter, self._now, (), seconds, ())
            else:
                self._require_known(int(times[0]))
                series_filter, start, observed, left = self._smoothing_inputs(int(times[0]))
                values, covariance = smooth_jointly(series_filter, start, observed, seconds, left)
        wide = self._sigma_inflation_at(times)
        return values, covariance * wide[:, None, None, None] * wide[:, None]

    def _require_known(self, time: int) -> None:
        """Raise Problem if a time is before the first reading."""
        if time < (begin := self._begin()):
            allowed = f"times from the first reading, {utc_text(begin)}, on"
            raise Problem("the time is before the first reading", utc_text(time), allowed)

    def _smoothing_inputs(self, time: int) -> tuple[SeriesFilter, FilterState, list[Observed], list[Array]]:
        """Return the inputs of a smoother for the states from a given time on.

        They are the filter with all detected jumps as steps, its initial state, the observations from there on, and,
        before each observation, the share of the mean square of each motion's possible jumps that readings could not
        have detected.
        """
        entry_filter, start = self._entry_filter, self._checkpoint_before(time)
        start_time = None if start is None else start.time
        steps = (*entry_filter.series_filter.steps, *self._steps(start_time))
        used, left = self._used_entries(start_time)
        wanted = set(used.tolist())
        entries_of_moments = (entry for entries in self._moments(start_time) for entry in entries)
        spots_by_id = {
            reading["id"]: entry_filter.observed(reading) for reading in entries_of_moments if reading["id"] in wanted
        }
        observed = [spots_by_id[number] for number in used.tolist()]
        filter_state = (entry_filter.start(self._begin()) if start is None else start).filter_state
        filter_state = _without_search(filter_state)
        knowing = replace(entry_filter.series_filter, steps=steps, window=0)
        filter_state, with_hints = with_indicated_jumps(
            entry_filter.series_filter, knowing, filter_state, observed, list(left)
        )
        return knowing, filter_state, observed, with_hints

    def _used_entries(self, after_us: int | None) -> tuple[NDArray[np.int64], Array]:
        """Return the ids of the entries used after a checkpoint, and the undetectable shares of jumps before each.

        An undetectable share is the share of the mean square of a motion's possible jumps that readings could not have
        detected.
        """
        spans = self._segments(after_us)
        width = len(self._entry_filter.series_filter.walking)
        left = np.concatenate([span.undetected_shares.reshape(len(span.used), width) for span in spans])
        used, pending = np.concatenate([span.used for span in spans]), self.estimator_state.pending
        good = used != (0 if pending is None else pending[0])
        return used[good], left[good]

    def _segments(self, after_us: int | None) -> list[EstimatorState]:
        """Return the estimator's states at the permanent checkpoints after a time, and the newest state.

        Each state lists the entries used since the one before it.
        """
        return [segment for segment in self._all_segments if after_us is None or segment.time > after_us]

    @cached_property
    def _all_segments(self) -> list[EstimatorState]:
        """All permanent checkpoints of the estimator, and its newest state."""
        last = self.estimator_state  # filters new readings and saves their checkpoints first
        checkpoints = (
            EstimatorState.from_bytes(checkpoint.content)
            for checkpoint in self.history.checkpoints(self.key)
            if checkpoint.number > _HEAD
        )
        return [
            *(replace(segment, filter_state=_without_search(segment.filter_state)) for segment in checkpoints),
            last,
        ]

    def _begin(self) -> int:
        """Return the time of the first entry that the estimate uses, in microseconds of TAI since 2000."""
        return min(int(entry["time_us"]) for kind in self._kinds if (entry := self.history.first(kind)) is not None)

    def _checkpoint_before(self, time: int) -> EstimatorState | None:
        """Return the newest permanent checkpoint before a time and all jumps detected since; None if there is none."""
        last = self.estimator_state
        while True:
            checkpoint = self.history.checkpoint(self.key, before_us=time, valid=True)
            if checkpoint is None:
                return None
            earlier = [
                self.epoch + int(jump.jump.time_distribution[0][0] * MICRO)
                for jump in last.jumps
                if jump.time > checkpoint.time_us
            ]
            if not earlier or min(earlier) >= checkpoint.time_us:
                return EstimatorState.from_bytes(checkpoint.content)
            time = min(earlier)


def _without_search(filter_state: FilterState) -> FilterState:
    """Return the filter state without the candidate steps of the jump search, which take most of its memory."""
    state, none = filter_state.state.alone(), filter_state.after[:0]
    return replace(filter_state, state=state, search=None, after=none, until=none, pending=None)
