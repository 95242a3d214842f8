"""What the command `python -m twin.uncertainty` works out: what limits a monitor, and whether the stated sigmas hold in
random states of the stated disturbances, which are rendered, exposed, recovered and compared with the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from scipy.special import gammaincinv, ndtr

from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.estimators import Shifts, applicable
from analysis.monitor.limits import Quantity
from analysis.monitor.recovery import Recovery
from optics.numerics.backend import Backend, cores
from scenes.models.camera_sharpness import blur_warnings
from scenes.models.disturbances import states_of
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import InputError, Issue
from twin.framework.procedure import Advance, silent
from twin.framework.random_streams import stream
from twin.monitor.image_sampling import ImageChecks
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import Observing, observe
from twin.monitor.reading_table import reading_table
from twin.sensors.area_detector import coarse_warnings
from twin.uncertainty.monitor_limits import MonitorLimits, expected_covariance, find_limits, unseen_texts

LEVELS = (0.68, 0.95)
"""Levels of the intervals whose coverage is counted."""
HALF_WIDTHS = tuple(float(np.sqrt(2.0 * gammaincinv(0.5, level))) for level in LEVELS)
"""Half widths of the intervals in standard deviations of a normal error."""
FALSE = 1e-2
"""Chance that any of all counts falls out of its limits though every sigma is right."""
CHUNK, _PIXELS = 32, 10_000_000
"""States, and pixels of their images, that are rendered at once, some 2 GB; the numbers do not depend on it."""
STATES = "random states"
_DRAWN, _DETECTOR, _BEFORE, _AFTER = 9, 10, 11, 12
"""Numbers of the random streams of the states, of their detectors and of the noise before and after."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """N measured states.

    Attributes
    ----------
    quantities : tuple[Quantity, ...]
        Q of them.
    drawn : int
        How many states were drawn; those in which a spot leaves its CCD, or comes too near its edge, are not measured.
    truth : np.ndarray
        (N, Q).
    errors : Mapping[str, np.ndarray]
        Estimator -> (N, Q) reading minus truth.
    sigmas : Mapping[str, np.ndarray]
        Estimator -> (N, Q) total standard deviations.
    expected : Mapping[str, np.ndarray]
        Estimator -> (levels, Q) share of intervals that should hold the truth: the levels themselves where all states
        are measured. The measured ones of others move the spots less than is stated, which makes errors that go with
        the spots smaller; of the posterior none do.
    chi_square : np.ndarray
        (N,) predictive chi-square of the shifts.
    alarms : int
        In how many states it was beyond its limit.
    doubted : int
        In how many the spots were not as calibrated, or the readings not linear and not worked out anew.
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

        Parameters
        ----------
        estimator : str
            Its name.
        level : int
            Number in ``LEVELS``.
        """
        inside = np.abs(self.errors[estimator]) <= HALF_WIDTHS[level] * self.sigmas[estimator]
        return np.asarray(np.sum(inside, axis=0))

    @property
    def counts(self) -> int:
        """How many coverages there are."""
        return len(self.errors) * len(self.quantities) * len(LEVELS)

    def limits(self, estimator: str, level: int) -> np.ndarray:
        """(2, Q) smallest and largest count that agree with what is expected, ``FALSE`` for all counts together.

        Parameters
        ----------
        estimator : str
            Its name.
        level : int
            Number in ``LEVELS``.
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
    def sigma_holds(self) -> bool:
        """Return whether no count is beyond its limits and sigma is doubted in no state."""
        return not self.outliers and self.alarms <= self.alarm_limit and not self.doubted

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

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument, with stated disturbances.
    quantities : tuple[Quantity, ...]
        Whose errors are wanted.
    count : int
        How many states are drawn.
    frames : int
        Of each measurement.
    seed : int
        Of all that is drawn.
    advance : Advance
        Told how many states are done.
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

    estimators = applicable(experiment.cameras, disturbances)
    chunk = max(1, min(CHUNK, _PIXELS // experiment.nominal_photons.size))
    # what cannot be measured is left out, and counted by the difference to what is drawn
    how = Observing(record, experiment.resolved.job.analysis.centroid, chunk, leave=lambda number, why: None)
    for first in range(0, count, chunk):
        advance(STATES, first, count)
        states = states_of(amounts[first : first + chunk], stated.components, experiment.thermal)
        place = experiment.path.coarse_trace(states).place
        kept = np.flatnonzero(np.all(np.abs(place) <= half, axis=(0, 2)))
        # streams of its own for each state, whichever others were lost
        for found in observe(experiment, [states[k] for k in kept], how, first + kept):
            table = reading_table(
                found.recovery, experiment.cameras, found.truth, experiment.ground, experiment.disturbances
            )
            for name in estimators:
                own = [table.row(one.group, one.key, name) for one in quantities]
                read.setdefault(name, []).append(np.stack([row.value for row in own], axis=1))
                sigma.setdefault(name, []).append(np.stack([row.sigma for row in own], axis=1))
            true.append(np.stack([row.true for row in own], axis=1))
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


_SPREAD = "what is stated to move"
"""A part of the work."""


@dataclass(frozen=True, eq=False)
class UncertaintyRun:
    """What was found.

    Attributes
    ----------
    resolved : ResolvedJob
        The job with everything it names.
    limits : MonitorLimits
        Of its instrument under its disturbances.
    seed : int
        Of the random states.
    coverage : Coverage | None
        Of the random states, None if none were asked for.
    warnings : tuple[str, ...]
        Blurred cameras, coarse grey values, and stated motions that no spot sees.
    images : ImageChecks
        What the checks of its images found.
    """

    resolved: ResolvedJob
    limits: MonitorLimits
    seed: int
    coverage: Coverage | None = None
    warnings: tuple[str, ...] = ()
    images: ImageChecks = field(default_factory=ImageChecks)


def run_uncertainty(
    resolved: ResolvedJob, backend: Backend, seed: int = 0, advance: Advance = silent, states: int = 0
) -> UncertaintyRun:
    """Work out what limits the readings of a job's instrument; what the job does to it is not looked at.

    Parameters
    ----------
    resolved : ResolvedJob
        The job.
    backend : Backend
        Where to trace.
    seed : int
        Of the random states.
    advance : Advance
        Told what is being done.
    states : int
        How many random states are drawn, rendered and recovered.

    Raises
    ------
    InputError
        Nothing is stated to move, or what is stated cannot be.
    """
    if resolved.disturbances is None:
        raise InputError(
            Issue(
                "there is no prior on disturbances, so that the noise alone limits the readings",
                allowed="`disturbances: NAME` in the job or the instrument, or --disturbances NAME",
            )
        )
    advance(_SPREAD, 0, 1)
    experiment = MonitorExperiment(resolved, backend)
    noise = expected_covariance(experiment, resolved.frames)
    limits = find_limits(experiment, noise, resolved.frames, second_monitor=True)
    if limits is None:
        raise InputError(
            Issue(
                "nothing that is stated to move changes a camera, so that there is nothing to be measured",
                found=str(resolved.disturbances.name),
                allowed="disturbances of cameras, their mirrors or focal planes",
            )
        )
    advance(_SPREAD, 1, 1)
    coverage = None
    if states:
        coverage = run_states(experiment, limits.quantities, states, resolved.frames, seed, advance)
    hidden = unseen_texts(limits.stated, noise, limits.quantities, limits.gain)
    given = (*blur_warnings(resolved, backend), *coarse_warnings(resolved))
    return UncertaintyRun(resolved, limits, seed, coverage, (*given, *hidden), experiment.path.checked)
