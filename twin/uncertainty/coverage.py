"""Computation of ``python -m twin.uncertainty``: limits of a monitor, and coverage of its sigmas in random states.

Random states are drawn from the prior on disturbances, rendered, exposed, recovered and compared with the truth.
"""

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
from twin.framework.procedure import Advance, silent, stream
from twin.monitor.monitor_beams import ImageChecks
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import ObservationOptions, observe
from twin.monitor.reading_table import reading_table
from twin.sensors.area_detector import coarse_warnings
from twin.uncertainty.monitor_limits import MonitorLimits, expected_covariance, find_limits, unobserved_texts

LEVELS = (0.68, 0.95)
"""Confidence levels of the intervals whose coverage is counted."""
HALF_WIDTHS = tuple(float(np.sqrt(2.0 * gammaincinv(0.5, level))) for level in LEVELS)
"""Half-widths of the intervals, in standard deviations of a normal error."""
FALSE = 1e-2
"""Probability that any count of covered intervals is outside its limits although every sigma is right."""
CHUNK, _PIXELS = 32, 10_000_000
"""Largest numbers of states, and of pixels of their images, that are rendered together, to limit memory to 2 GB.

Results do not depend on them.
"""
STATES = "random states"
_DRAWN, _DETECTOR, _BEFORE, _AFTER = 9, 10, 11, 12
"""Numbers of the random streams of a seed.

They are for the random states, their detectors, and the image noise before and after the change.
"""


@dataclass(frozen=True, eq=False)
class Coverage:
    """Errors and sigmas of N measured random states, with the coverage of their intervals.

    Attributes
    ----------
    quantities : tuple of Quantity
        The Q quantities.
    drawn : int
        Number of states that were drawn; those in which a spot leaves its CCD, or is too near its edge, are not
        measured.
    truth : (N, Q) ndarray
        True values.
    errors : Mapping[str, (N, Q) ndarray]
        Estimator -> estimate minus truth.
    sigmas : Mapping[str, (N, Q) ndarray]
        Estimator -> total standard deviations.
    expected : Mapping[str, (levels, Q) ndarray]
        Estimator -> expected fraction of intervals that contain the truth. It is the confidence level itself if all
        states drawn are measured. Otherwise the states with large spot shifts are missing, so that errors that are
        correlated with the shifts are smaller than the prior predicts; those of the posterior are not correlated with
        them.
    chi_square : (N,) ndarray
        Predictive chi-square of the spot shifts.
    alarms : int
        Number of states whose chi-square exceeds its limit.
    doubted : int
        Number of states in which spots differ from their calibrated shape, or in which the changes are too large for
        the linear estimate and it was not relinearised.
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
        """Number N of measured states."""
        return len(self.truth)

    def rms(self, estimator: str) -> np.ndarray:
        """Return the (Q,) RMS errors of the Q quantities over all measured states."""
        return np.asarray(np.sqrt(np.mean(self.errors[estimator] ** 2, axis=0)))

    def ratio(self, estimator: str) -> np.ndarray:
        """Return, for each of the Q quantities, the (Q,) RMS of error over sigma; 1 where the sigmas are right."""
        return np.asarray(np.sqrt(np.mean((self.errors[estimator] / self.sigmas[estimator]) ** 2, axis=0)))

    def covered(self, estimator: str, level: int) -> np.ndarray:
        """Return, for each of the Q quantities, the (Q,) number of states whose interval contains the truth.

        Parameters
        ----------
        estimator : str
            Name of the estimator.
        level : int
            Index in ``LEVELS``.
        """
        inside = np.abs(self.errors[estimator]) <= HALF_WIDTHS[level] * self.sigmas[estimator]
        return np.asarray(np.sum(inside, axis=0))

    @property
    def counts(self) -> int:
        """Number of counts of covered intervals: estimators times confidence levels times quantities."""
        return len(self.errors) * len(self.quantities) * len(LEVELS)

    def limits(self, estimator: str, level: int) -> np.ndarray:
        """Return the (2, Q) smallest and largest counts that agree with the expected coverage of the Q quantities.

        The probability that any count is outside by chance is ``FALSE`` for all counts together.

        Parameters
        ----------
        estimator : str
            Name of the estimator.
        level : int
            Index in ``LEVELS``.
        """
        from scipy.stats import binom  # slow to import, and only a report of random states needs it

        tail = 0.5 * FALSE / self.counts
        return np.stack([binom.ppf(end, self.measured, self.expected[estimator][level]) for end in (tail, 1.0 - tail)])

    @property
    def alarm_limit(self) -> int:
        """Largest number of chi-square alarms that agrees with the false-alarm rate, at a probability of ``FALSE``."""
        from scipy.stats import binom

        return int(binom.ppf(1.0 - FALSE, self.measured, FALSE_ALARM))

    @property
    def sigma_agrees(self) -> bool:
        """True if no count of covered intervals is outside its limits and sigma is doubted in no state."""
        return not self.outliers and self.alarms <= self.alarm_limit and not self.doubted

    @property
    def outliers(self) -> tuple[tuple[str, str, str, float, int], ...]:
        """Counts outside their limits: estimator, group and key of the quantity, level, and count of each."""
        out = []
        for name in self.errors:
            for k, level in enumerate(LEVELS):
                ends = self.limits(name, k).T
                for quantity, count, (low, high) in zip(self.quantities, self.covered(name, k), ends, strict=True):
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
    """Draw, render, expose and recover random states.

    Every state has its own detectors and its own nominal measurement.

    Parameters
    ----------
    experiment : MonitorExperiment
        Instrument, with a prior on disturbances.
    quantities : tuple of Quantity
        Quantities whose errors are computed.
    count : int
        Number of states to draw.
    frames : int
        Number of frames of each measurement.
    seed : int
        Seed of all random numbers.
    advance : Advance
        Called with the number of states done.
    """
    prior, disturbances = experiment.prior, experiment.disturbances
    assert prior is not None
    assert disturbances is not None
    amounts = prior.draw(np.random.default_rng(stream(seed, _DRAWN)), count)
    half = 0.5 * (np.array(experiment.path.shape) - 1)
    true: list[np.ndarray] = []
    read: dict[str, list[np.ndarray]] = {}
    sigma: dict[str, list[np.ndarray]] = {}
    probabilities: dict[str, list[np.ndarray]] = {}
    squares: list[float] = []
    alarms = doubted = 0

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _exposed(experiment, photons, frames, seed, numbers)

    estimators = applicable(experiment.cameras, disturbances)
    chunk = max(1, min(CHUNK, _PIXELS // experiment.nominal_photons.size))
    # states that cannot be measured are omitted; their number is the difference to the states drawn
    observing = ObservationOptions(
        record, experiment.resolved.job.analysis.centroid, chunk, omit=lambda number, why: None
    )
    for first in range(0, count, chunk):
        advance(STATES, first, count)
        states = states_of(amounts[first : first + chunk], prior.components, experiment.thermal)
        position = experiment.path.coarse_trace(states).centre
        inside = np.flatnonzero(np.all(np.abs(position) <= half, axis=(0, 2)))
        # each state has its own random streams, independent of lost states
        for observation in observe(experiment, [states[k] for k in inside], observing, first + inside):
            table = reading_table(
                observation.recovery, experiment.cameras, observation.truth, experiment.ground, experiment.disturbances
            )
            for name in estimators:
                rows = [table.row(quantity.group, quantity.key, name) for quantity in quantities]
                read.setdefault(name, []).append(np.stack([row.value for row in rows], axis=1))
                sigma.setdefault(name, []).append(np.stack([row.sigma for row in rows], axis=1))
            true.append(np.stack([row.true for row in rows], axis=1))
            for name, probability in _probabilities(observation.recovery, experiment, quantities).items():
                probabilities.setdefault(name, []).append(probability)
            for k in range(len(observation.numbers)):
                test = observation.recovery.consistency(disturbances, k)
                squares.append(test.chi_square)
                alarms += not test.agrees
                fits = observation.recovery.evidence is None or bool(observation.recovery.evidence.consistent[k])
                doubted += not (
                    fits and all(curvature.valid[k] for curvature in observation.recovery.curvature.values())
                )
    advance(STATES, count, count)
    truth = np.concatenate(true) if true else np.empty((0, len(quantities)))
    readings = {name: np.concatenate(parts) for name, parts in read.items()}
    levels = np.repeat(np.array(LEVELS)[:, None], len(quantities), axis=1)
    all_measured = len(truth) == count
    return Coverage(
        quantities=quantities,
        drawn=count,
        truth=truth,
        errors={name: values - truth for name, values in readings.items()},
        sigmas={name: np.concatenate(parts) for name, parts in sigma.items()},
        expected={
            name: levels if all_measured else np.concatenate(parts, axis=1).mean(axis=1)
            for name, parts in probabilities.items()
        },
        chi_square=np.array(squares),
        alarms=alarms,
        doubted=doubted,
    )


def _exposed(
    experiment: MonitorExperiment, photons: np.ndarray, frames: int, seed: int, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return frames of the nominal state and of S states, each (S, C, frames, rows, columns) for C channels.

    Each pair of states has its own detectors: with one detector for all, the effect of its pixel pattern on the nominal
    spots would be the same error in all states.
    """
    detector, channels = experiment.detector, len(experiment.path.channels)
    before = np.empty((*photons.shape[:2], frames, *photons.shape[2:]), np.uint16)
    after = np.empty_like(before)

    def expose(k: int) -> None:
        number = int(numbers[k])
        pattern = detector.fixed_pattern((channels, *experiment.path.shape), stream(seed, _DETECTOR, number))
        for kind, light, out in ((_BEFORE, experiment.nominal_photons, before), (_AFTER, photons[k], after)):
            random_stream = stream(seed, kind, number)
            out[k] = detector.expose(light, pattern, frames, experiment.exposure, random_stream, threads=1)

    with ThreadPoolExecutor(min(cores(), 8)) as pool:
        list(pool.map(expose, range(len(photons))))
    return before, after


def _probabilities(
    recovery: Recovery, experiment: MonitorExperiment, quantities: tuple[Quantity, ...]
) -> dict[str, np.ndarray]:
    """Return the probability, by estimator, that an interval contains the truth, given the spot shifts.

    Each is a (levels, N, Q) array for the confidence levels, N states and Q quantities. Errors of the posterior are
    independent of the shifts; the estimate of another estimator differs from the posterior's by the difference of their
    gains times the shifts.
    """
    prior, noise = experiment.disturbances, recovery.shift_covariance
    assert prior is not None
    rows, best = np.stack([quantity.row for quantity in quantities]), prior.best_gain(noise)
    shifts = Shifts(recovery.before, recovery.after, noise, experiment.cameras, prior)

    def spread(gain: np.ndarray) -> np.ndarray:
        total = prior.misfit(gain) + gain @ noise @ np.swapaxes(gain, -1, -2)
        return np.sqrt(np.einsum("qi,nij,qj->nq", rows, total, rows))

    posterior_sigma, out = spread(best), {}
    for name, estimator in applicable(experiment.cameras, prior).items():
        gain = estimator.gain(shifts)
        bias, sigma = np.einsum("qi,nid,nd->nq", rows, gain - best, recovery.shift), spread(gain)
        out[name] = np.stack(
            [
                ndtr((w * sigma - bias) / posterior_sigma) - ndtr((-w * sigma - bias) / posterior_sigma)
                for w in HALF_WIDTHS
            ]
        )
    return out


_SPREAD = "prior on disturbances"
"""Progress label of the analysis of the prior."""


@dataclass(frozen=True, eq=False)
class UncertaintyRun:
    """Result of ``python -m twin.uncertainty``.

    Attributes
    ----------
    resolved : ResolvedJob
        Job with everything it names.
    limits : MonitorLimits
        Limits of its instrument under its prior on disturbances.
    seed : int
        Seed of the random states.
    coverage : Coverage or None
        Coverage in the random states, None if none were asked for.
    warnings : tuple of str
        Warnings of blurred cameras, coarse grey values, and motions of the prior that the spots do not observe.
    images : ImageChecks
        Checks of its images.
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
    """Analyse what limits the estimated changes of a job's instrument; the job's perturbation is ignored.

    Parameters
    ----------
    resolved : ResolvedJob
        Job that names the instrument and the prior.
    backend : Backend
        Backend that traces rays.
    seed : int
        Seed of the random states.
    advance : Advance
        Called with the progress.
    states : int
        Number of random states to draw, render and recover.

    Raises
    ------
    InputError
        There is no prior on disturbances, or its disturbances are not possible.
    """
    if resolved.disturbances is None:
        raise InputError(
            Issue(
                "there is no prior on disturbances, so that only the noise limits the readings",
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
                "no disturbance of the prior changes a camera, so that there is nothing to measure",
                value=str(resolved.disturbances.name),
                allowed="disturbances of cameras, their mirrors or focal planes",
            )
        )
    advance(_SPREAD, 1, 1)
    coverage = None
    if states:
        coverage = run_states(experiment, limits.quantities, states, resolved.frames, seed, advance)
    unobserved = unobserved_texts(limits.disturbances, noise, limits.quantities, limits.gain)
    sensor_warnings = (*blur_warnings(resolved, backend), *coarse_warnings(resolved))
    return UncertaintyRun(resolved, limits, seed, coverage, (*sensor_warnings, *unobserved), experiment.path.checked)
