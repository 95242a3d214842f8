"""A stand-in for the operation of a record: the exact posterior of stated motions given readings of a monitor, as one
system of equations, with the methods that products need of an operation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np

from analysis.monitor.disturbances import Disturbances
from analysis.monitor.limits import quantities
from scenes.specs.operation import OperationSetup, OperationSpec, resolve_operation
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.record.entries import MICRO


@dataclass(frozen=True, eq=False)
class Estimate:
    """As `twin.operate.estimate.operation_filter.Course`."""

    times: np.ndarray
    quantities: tuple
    values: np.ndarray
    sigmas: np.ndarray
    changes: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class StandIn:
    """An operation whose readings are given.

    Attributes:
        experiment: the instrument and what is stated to move.
        times: (N,) of the readings, microseconds of TAI since 2000.
        shifts: (N, D) px.
        noise: (D, D) of each reading, px^2.
        events, jumps, breaks: as `Following` tells them.
    """

    experiment: MonitorExperiment
    times: np.ndarray
    shifts: np.ndarray
    noise: np.ndarray
    events: tuple = ()
    jumps: tuple = ()
    requirements: tuple = ()
    horizon: float = 30.0 * 86400.0

    @property
    def stated(self) -> Disturbances:
        found = self.experiment.disturbances
        assert found is not None
        return found

    @cached_property
    def plan(self) -> OperationSetup:
        plain = {"instrument": "gf7_pair", "disturbances": self.stated.name, "horizon": f"{self.horizon} s"}
        return resolve_operation(OperationSpec.model_validate(plain))

    @property
    def model(self) -> Any:
        cameras = self.experiment.instrument.cameras
        return SimpleNamespace(
            series_filter=SimpleNamespace(prior=self.stated), spots=tuple((c, "left") for c in cameras)
        )

    @cached_property
    def quantities(self) -> tuple:
        return quantities(self.experiment.cameras, self.experiment.ground)

    def filter_readings(self) -> Any:
        newest, count = int(self.times[-1]), len(self.times)
        known = {"events": self.events, "jumps": self.jumps, "requirements": self.requirements, "warnings": []}
        return SimpleNamespace(time=newest, readings=count, readings_text=f"{count} readings of the monitor", **known)

    def smoothed(self, times: list[int]) -> Estimate:
        rows = np.array([one.row for one in self.quantities])
        changes, spread = self._posterior(times, self.stated.parameters)
        sigmas = np.sqrt(np.einsum("qi,tij,qj->tq", rows, spread, rows))
        return Estimate(np.array(times), self.quantities, changes @ rows.T, sigmas, changes, spread)

    def motions(self, time: int, acting: bool = False) -> Any:
        (mean,), (covariance,) = self._posterior([time], np.eye(len(self.stated.labels)))
        unit = self.stated.sigmas
        return SimpleNamespace(
            labels=self.stated.labels,
            units=self.stated.units,
            mean=mean * unit,
            covariance=covariance * np.outer(unit, unit),
        )

    @cached_property
    def _whitened(self) -> tuple[np.ndarray, np.ndarray]:
        seconds = self.times / MICRO
        a, c = self.stated.spots, self.stated.correlation
        blocks = [[(a * self._over(s, t)) @ c @ a.T for t in seconds] for s in seconds]
        spread = np.block(blocks) + np.kron(np.eye(len(self.times)), self.noise)
        return spread, np.linalg.solve(spread, self.shifts.ravel())

    def _over(self, one: float, two: float) -> np.ndarray:
        return np.array([float(law.covariance(one, two)) for law in self.stated.laws])

    def _posterior(self, times: list[int], rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(T, R) and (T, R, R) of rows (R, M) on the motions in standard deviations."""
        spread, weights = self._whitened
        a, c = self.stated.spots, self.stated.correlation
        mean, covariance = [], []
        for time in times:
            t = time / MICRO
            across = np.concatenate([(rows * self._over(t, s)) @ c @ a.T for s in self.times / MICRO], axis=1)
            mean.append(across @ weights)
            prior = (rows * self._over(t, t)) @ c @ rows.T
            covariance.append(prior - across @ np.linalg.solve(spread, across.T))
        return np.array(mean), np.array(covariance)
