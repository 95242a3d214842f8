"""Do the stated sigmas hold? Random states of the stated disturbances, rendered, exposed, recovered and compared with
the truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv, ndtr

from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.estimators import Shifts, applicable
from analysis.monitor.limits import ANGLE_GROUP, GROUND_GROUP, Quantity
from analysis.monitor.monitoring import PARAMETERS, PER_SI
from analysis.monitor.recovery import Recovery
from analysis.units import ARCSEC
from optics.numerics.threads import cores
from scenes.models.disturbances import state_of
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import Observing, observe
from twin.monitor.truth import Truth
from twin.run.procedure import Advance, silent
from twin.run.random_streams import stream

LEVELS = (0.68, 0.95)
"""Of the intervals whose coverage is counted."""
HALF_WIDTHS = tuple(float(np.sqrt(2.0 * gammaincinv(0.5, level))) for level in LEVELS)
"""The same in standard deviations of a normal error."""
FALSE = 1e-2
"""Chance that any of all counts falls out of its limits though every sigma is right."""
CHUNK = 32
"""States that are rendered at once; the numbers do not depend on it."""
STATES = "random states"
_DRAWN, _DETECTOR, _BEFORE, _AFTER = 9, 10, 11, 12
"""Numbers of the random streams of the states, of their detectors and of the noise before and after."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """N measured states.

    Attributes:
        quantities: Q of them.
        drawn: how many states were drawn; those in which a spot leaves its CCD, or comes too near its edge, are not
            measured.
        truth: (N, Q).
        errors: estimator -> (N, Q) reading minus truth.
        sigmas: estimator -> (N, Q) total standard deviations.
        expected: estimator -> (levels, Q) share of intervals that should hold the truth: the levels themselves where
            all states are measured. The measured ones of others move the spots less than is stated, which makes
            errors that go with the spots smaller; of the posterior none do.
        chi_square: (N,) predictive chi-square of the shifts.
        alarms: in how many states it was beyond its limit.
        doubted: in how many the spots were not as calibrated, or the readings not linear and not worked out anew.
    """

    quantities: tuple[Quantity, ...]
    drawn: int
    truth: np.ndarray
    errors: Mapping[str, np.ndarray]
    sigmas: Mapping[str, np.ndarray]
    expected: Mapping[str, np.ndarray]
    chi_square: np.ndarray
    alarms: int
    doubted: int = 0

    @property
    def measured(self) -> int:
        """N."""
        return len(self.truth)

    def rms(self, estimator: str) -> np.ndarray:
        """(Q,) of the errors."""
        return np.asarray(np.sqrt(np.mean(self.errors[estimator] ** 2, axis=0)))

    def ratio(self, estimator: str) -> np.ndarray:
        """(Q,) rms of error over sigma; 1 where the sigmas are right."""
        return np.asarray(np.sqrt(np.mean((self.errors[estimator] / self.sigmas[estimator]) ** 2, axis=0)))

    def held(self, estimator: str, level: int) -> np.ndarray:
        """(Q,) number of states whose interval holds the truth.

        Args:
            estimator: its name.
            level: number in ``LEVELS``.
        """
        inside = np.abs(self.errors[estimator]) <= HALF_WIDTHS[level] * self.sigmas[estimator]
        return np.asarray(np.sum(inside, axis=0))

    @property
    def counts(self) -> int:
        """How many coverages there are."""
        return len(self.errors) * len(self.quantities) * len(LEVELS)

    def limits(self, estimator: str, level: int) -> np.ndarray:
        """(2, Q) smallest and largest count that agree with what is expected, ``FALSE`` for all counts together.

        Args:
            estimator: its name.
            level: number in ``LEVELS``.
        """
        from scipy.stats import binom  # takes long, and only a report of random states needs it

        tail = 0.5 * FALSE / self.counts
        return np.stack([binom.ppf(end, self.measured, self.expected[estimator][level]) for end in (tail, 1.0 - tail)])

    @property
    def alarm_limit(self) -> int:
        """Largest number of alarms that agrees with their false-alarm rate, at a chance of ``FALSE``."""
        from scipy.stats import binom

        return int(binom.ppf(1.0 - FALSE, self.measured, FALSE_ALARM))

    @property
    def outliers(self) -> tuple[tuple[str, str, str, float, int], ...]:
        """Estimator, group and key of a quantity, level and count of all counts beyond their limits."""
        out = []
        for name in self.errors:
            for k, level in enumerate(LEVELS):
                ends = self.limits(name, k).T
                for quantity, count, (low, high) in zip(self.quantities, self.held(name, k), ends, strict=True):
                    if not low <= count <= high:
                        out.append((name, quantity.group, quantity.key, level, int(count)))
        return tuple(out)


def run_states(
    experiment: MonitorExperiment,
    quantities: tuple[Quantity, ...],
    count: int,
    frames: int,
    seed: int,
    advance: Advance = silent,
) -> Coverage:
    """Draw, render, expose and recover states; every state has detectors and a nominal measurement of its own.

    Args:
        experiment: the instrument, with stated disturbances.
        quantities: whose errors are wanted.
        count: how many states are drawn.
        frames: of each measurement.
        seed: of all that is drawn.
        advance: told how many states are done.
    """
    stated, disturbances = experiment.stated, experiment.disturbances
    assert stated is not None
    assert disturbances is not None
    amounts = stated.draw(np.random.default_rng(stream(seed, _DRAWN)), count)
    half = 0.5 * (np.array(experiment.path.shape) - 1)
    true: list[np.ndarray] = []
    read: dict[str, list[np.ndarray]] = {}
    sigma: dict[str, list[np.ndarray]] = {}
    chances: dict[str, list[np.ndarray]] = {}
    squares: list[float] = []
    alarms = doubted = 0

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _exposed(experiment, photons, frames, seed, numbers)

    # what cannot be measured is left out, and counted by the difference to what is drawn
    how = Observing(record, experiment.resolved.job.analysis.centroid, CHUNK, leave=lambda number, why: None)
    for first in range(0, count, CHUNK):
        advance(STATES, first, count)
        states = [state_of(row, stated.components, experiment.thermal) for row in amounts[first : first + CHUNK]]
        place = experiment.path.coarse_trace(states).place
        kept = np.flatnonzero(np.all(np.abs(place) <= half, axis=(0, 2)))
        # streams of its own for each state, whichever others were lost
        for found in observe(experiment, [states[k] for k in kept], how, first + kept):
            true.append(_true(found.truth, experiment, quantities))
            for name, values, sigmas in _read(found.recovery, quantities):
                read.setdefault(name, []).append(values)
                sigma.setdefault(name, []).append(sigmas)
            for name, chance in _chances(found.recovery, experiment, quantities).items():
                chances.setdefault(name, []).append(chance)
            for k in range(len(found.numbers)):
                told = found.recovery.consistency(disturbances, k)
                squares.append(told.chi_square)
                alarms += not told.agrees
                fits = found.recovery.evidence is None or bool(found.recovery.evidence.holds[k])
                doubted += not (fits and all(curvature.holds[k] for curvature in found.recovery.curvature.values()))
    advance(STATES, count, count)
    truth = np.concatenate(true) if true else np.empty((0, len(quantities)))
    readings = {name: np.concatenate(parts) for name, parts in read.items()}
    levels = np.repeat(np.array(LEVELS)[:, None], len(quantities), axis=1)
    every = len(truth) == count
    return Coverage(
        quantities=quantities,
        drawn=count,
        truth=truth,
        errors={name: values - truth for name, values in readings.items()},
        sigmas={name: np.concatenate(parts) for name, parts in sigma.items()},
        expected={
            name: levels if every else np.concatenate(parts, axis=1).mean(axis=1) for name, parts in chances.items()
        },
        chi_square=np.array(squares),
        alarms=alarms,
        doubted=doubted,
    )


def _exposed(
    experiment: MonitorExperiment, photons: np.ndarray, frames: int, seed: int, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frames of the nominal state and of states of these numbers, (S, C, frames, rows, columns), each pair by detectors
    of its own: with one detector for all, what its pattern does to the nominal spots would be the same error in all.
    """
    detector, channels = experiment.detector, len(experiment.path.channels)
    before = np.empty((*photons.shape[:2], frames, *photons.shape[2:]), np.uint16)
    after = np.empty_like(before)

    def expose(k: int) -> None:
        number = int(numbers[k])
        pattern = detector.fixed_pattern((channels, *experiment.path.shape), stream(seed, _DETECTOR, number))
        for kind, light, out in ((_BEFORE, experiment.nominal_photons, before), (_AFTER, photons[k], after)):
            own = stream(seed, kind, number)
            out[k] = detector.expose(light, pattern, frames, experiment.exposure, own, threads=1)

    with ThreadPoolExecutor(min(cores(), 8)) as pool:
        list(pool.map(expose, range(len(photons))))
    return before, after


def _chances(found: Recovery, experiment: MonitorExperiment, quantities: tuple[Quantity, ...]) -> dict[str, np.ndarray]:
    """Estimator -> (levels, N, Q) chance that an interval holds the truth, given the shifts: against the posterior,
    whose errors do not go with them, the reading is off by (gain - posterior's gain) times the shifts.
    """
    stated, noise = experiment.disturbances, found.shift_covariance
    assert stated is not None
    rows, best = np.stack([quantity.row for quantity in quantities]), stated.best_gain(noise)
    shifts = Shifts(found.before, found.after, noise, experiment.cameras, stated)

    def spread(gain: np.ndarray) -> np.ndarray:
        total = stated.misfit(gain) + gain @ noise @ np.swapaxes(gain, -1, -2)
        return np.sqrt(np.einsum("qi,nij,qj->nq", rows, total, rows))

    left, out = spread(best), {}
    for name, estimator in applicable(experiment.cameras, stated).items():
        gain = estimator.gain(shifts)
        off, sigma = np.einsum("qi,nid,nd->nq", rows, gain - best, found.shift), spread(gain)
        out[name] = np.stack([ndtr((w * sigma - off) / left) - ndtr((-w * sigma - off) / left) for w in HALF_WIDTHS])
    return out


def _true(truth: Truth, experiment: MonitorExperiment, quantities: tuple[Quantity, ...]) -> np.ndarray:
    """(N, Q)."""
    values: dict[tuple[str, str], np.ndarray] = {}
    for name, change in truth.cameras.items():
        rows = (change.d_alpha, change.d_beta, change.d_gamma, change.d_f)
        for key, unit, row in zip(PARAMETERS, PER_SI, rows, strict=True):
            values[name, key] = unit * row
    values[ANGLE_GROUP, "change_arcsec"] = truth.angle_change / ARCSEC
    if experiment.ground is not None:
        for key, row in zip(("along_m", "across_m", "height_m"), truth.ground_error(experiment.ground).T, strict=True):
            values[GROUND_GROUP, key] = row
    return np.stack([values[quantity.group, quantity.key] for quantity in quantities], axis=1)


def _read(found: Recovery, quantities: tuple[Quantity, ...]) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Estimator, its readings and their total sigmas, (N, Q)."""
    cameras = list(found.parameters)
    for name in found.parameters[cameras[0]]:
        groups = {camera: found.parameters[camera][name].to_dict() for camera in cameras}
        if name in found.angle:
            groups[ANGLE_GROUP] = found.angle[name].to_dict()
        if name in found.ground:
            groups[GROUND_GROUP] = found.ground[name].to_dict()
        both = [
            np.stack([np.asarray(groups[quantity.group][quantity.key + ending]) for quantity in quantities], axis=1)
            for ending in ("", "_sigma")
        ]
        yield name, both[0], both[1]
