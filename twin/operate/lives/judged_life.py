"""A simulated life followed reading by reading, as it would have been, and what was said of it held against the truth.

Four ways to know the cameras are compared at every reading: the calibration on the ground, kept; each reading by
itself; the operation with the readings up to then; and the operation with all readings. What was forecast at a reading
is compared with what came. The truth is read after all that.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.monitor.limits import Quantity
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from scenes.specs.operation import OperationSetup
from scenes.yaml.input_file import read_json
from twin.operate.estimate.following import Course, Following
from twin.operate.estimate.operation import Operation
from twin.operate.record.entries import MICRO, Entry, Given
from twin.operate.record.history import History, initialised
from twin.operate.record.run_readings import RESULTS
from twin.operate.record.telemetry import read_table_file, read_telemetry, tables_of
from twin.run.procedure import Advance

FOLLOW = "follow the readings"
WAYS = {
    "ground": "calibration on the ground, kept",
    "single": "each reading by itself",
    "filtered": "operation, readings so far",
    "smoothed": "operation, all readings",
}
"""Way to know the cameras -> what it is called."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What one way says at T times: values and standard deviations, (T, Q) in each quantity's unit; NaN for nothing."""

    values: Array
    sigmas: Array

    @classmethod
    def of(cls, courses: Sequence[Course]) -> Estimate:
        """Of courses that follow each other."""
        return cls(np.concatenate([one.values for one in courses]), np.concatenate([one.sigmas for one in courses]))


@dataclass(frozen=True, eq=False)
class JudgedLife:
    """Four ways to know a simulated instrument, and the truth.

    Attributes:
        times: (T,) microseconds of TAI since 2000 of the readings.
        quantities: Q of them.
        true: (T, Q) in each quantity's unit.
        ways: as `WAYS` -> what it says.
        horizon: of the forecasts, seconds.
        forecast: made at each reading for the first reading that is not nearer than the horizon, (T, Q).
        came: (T, Q) what then was; NaN where the life is over before.
        interrupted: (T,) whether an event came in between, which no forecast knows of.
        following: after the last reading.
    """

    times: NDArray[np.int64]
    quantities: tuple[Quantity, ...]
    true: Array
    ways: Mapping[str, Estimate]
    horizon: float
    forecast: Estimate
    came: Array
    interrupted: NDArray[np.bool_]
    following: Following

    def errors(self, way: str) -> Array:
        """(T, Q) of one way, in each quantity's unit."""
        return self.ways[way].values - self.true

    def number(self, group: str, key: str) -> int:
        """Of a quantity.

        Args:
            group: camera, ``intersection_angle`` or ``ground``.
            key: which of its readings.
        """
        return next(k for k, one in enumerate(self.quantities) if (one.group, one.key) == (group, key))


def judged(plan: OperationSetup, files: Path, truth: Mapping[str, Any], advance: Advance) -> JudgedLife:
    """Follow a life in a record of its own, reading by reading.

    Args:
        plan: of the operation.
        files: that says what the tables of the life hold.
        truth: of the life, plain data of its file.
        advance: told of the progress.
    """
    with tempfile.TemporaryDirectory() as place:
        initialised(place, plan.model, simulated=True)
        with History(place) as history:
            steps = Steps(history, files)
            times = steps.times
            horizon = plan.operation.horizon
            ahead = np.searchsorted(times, times + round(horizon * MICRO))
            now: list[Course] = []
            later: list[Course] = []
            operation: Operation | None = None
            advance(FOLLOW, 0, len(times))
            for k, moment in enumerate(times.tolist()):
                steps.take(moment)
                operation = Operation(history, plan) if operation is None else operation.again()
                following = operation.follow()
                now.append(following.now)
                target = times[ahead[k]] if ahead[k] < len(times) else moment + round(horizon * MICRO)
                later.append(operation.forecast(np.array([target])))
                advance(FOLLOW, k + 1, len(times))
            assert operation is not None  # a life has a reading
            smoothed = operation.smoothed(times)
            ground = _prior(operation, times)
    # the record keeps no errors on the ground of a reading, the run that read it does
    single = _single(read_json(files.parent / RESULTS["monitor"])["series"], operation.quantities)
    quantities = operation.quantities
    true = true_changes(truth, quantities, times)
    came = np.full_like(true, np.nan)
    there = ahead < len(times)
    came[there] = true[ahead[there]]
    targets = np.where(there, times[np.minimum(ahead, len(times) - 1)], times)
    dates = np.array([time for time, *_ in following.events], np.int64)
    interrupted = np.any((dates > times[:, None]) & (dates <= targets[:, None]), axis=1)
    ways = {"ground": ground, "single": single, "filtered": Estimate.of(now), "smoothed": Estimate.of([smoothed])}
    return JudgedLife(times, quantities, true, ways, horizon, Estimate.of(later), came, interrupted, following)


def _prior(operation: Operation, times: NDArray[np.int64]) -> Estimate:
    """What is known without any reading: nothing has changed, but for what is stated to move."""
    how, rows = operation.model.how, operation.model.rows
    seconds = ((times - times[0]) / MICRO).tolist()
    start = how.start(seconds[0])
    found = [how.parameters(start, time) for time in seconds]
    values = np.array([mean for mean, _ in found]) @ rows.T
    spread = np.array([covariance for _, covariance in found])
    return Estimate(values, np.sqrt(np.einsum("qi,tij,qj->tq", rows, spread, rows)))


class Steps:
    """The files of a life, taken into a record up to one moment after the other.

    Args:
        history: the record.
        file: that says what the tables hold.
    """

    def __init__(self, history: History, file: Path) -> None:
        self._history, self._taken = history, -(2**62)
        spec = read_telemetry(file, history)
        self._given = [
            read_table_file(table, path, history) for table in spec.readings for path in tables_of(spec, table)
        ]
        every = {one.time for given in self._given for one in _entries(given) if one.kind == "monitor"}
        self.times = np.array(sorted(every), np.int64)

    def take(self, until: int) -> None:
        """Take what came since the last time.

        Args:
            until: microseconds of TAI since 2000.
        """
        for given in self._given:
            own = [one for one in _entries(given) if self._taken < one.time <= until]
            if own:
                self._history.take(Given(given.file, given.sha256, given.meaning, own, given.frames))
        self._taken = until


def _entries(given: Given) -> list[Entry]:
    return [one for one in given.items if isinstance(one, Entry)]


def true_changes(truth: Mapping[str, Any], quantities: Sequence[Quantity], times: NDArray[np.int64]) -> Array:
    """(T, Q) true changes in each quantity's unit.

    Args:
        truth: plain data of a life's file.
        quantities: Q of them.
        times: (T,) at which it is known, microseconds of TAI since 2000.
    """
    at = {moment: k for k, moment in enumerate(truth["times_us"])}
    own = [at[moment] for moment in times.tolist()]
    columns = []
    for one in quantities:
        group = truth[one.group] if one.group in (ANGLE_GROUP, GROUND_GROUP) else truth["cameras"][one.group]
        columns.append(np.array(group[one.key])[own])
    return np.stack(columns, axis=1)


def _single(readings: Sequence[Mapping[str, Any]], quantities: Sequence[Quantity]) -> Estimate:
    """What each reading says by itself: that of the best estimator for stated disturbances."""
    values, sigmas = [], []
    for read in readings:
        groups = {**read["cameras"], **{name: read[name] for name in (ANGLE_GROUP, GROUND_GROUP) if name in read}}
        own = [groups[one.group]["posterior"] for one in quantities]
        values.append([found[one.key] for found, one in zip(own, quantities, strict=True)])
        sigmas.append([found[f"{one.key}_sigma"] for found, one in zip(own, quantities, strict=True)])
    return Estimate(np.array(values), np.array(sigmas))


def covered(error: Array, sigma: Array, times: float) -> tuple[int, int]:
    """How many errors lie within so many sigmas, and of how many; NaN is left out.

    Args:
        error: of any shape.
        sigma: likewise.
        times: sigmas.
    """
    ratio = np.abs(error / sigma)
    known = np.isfinite(ratio)
    return int(np.count_nonzero(ratio[known] <= times)), int(known.sum())


def rms(error: Array) -> float:
    """Root mean square of what is known of errors."""
    return float(np.sqrt(np.nanmean(np.square(error)))) if np.any(np.isfinite(error)) else math.nan
