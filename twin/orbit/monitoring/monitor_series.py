"""Measurements of a stereo pair's on-board monitor over time, relative to its reference images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.monitor.disturbances import Consistency
from analysis.monitor.estimators import LeastSquares, Posterior, Shifts
from analysis.monitor.jump_detection import Jump
from analysis.monitor.monitor_formulas import CameraParameters
from analysis.monitor.recovery import MeasuredSpots, Recovery, SpotEvidence, judged_spots
from analysis.monitor.series_smoother import smooth_series, window_of
from analysis.spots.centroid import mean_frames
from analysis.spots.spot_image import SeriesNoise, SpotError
from optics.geometry.tree import State, compose
from optics.numerics.backend import cores, one_blas_thread
from optics.thermal.heat import Temperature
from scenes.models.job_state import motions_of
from scenes.models.thermal_model import TemperatureError
from scenes.specs.course import moment
from scenes.specs.instrument import CENTRAL_PRISM
from twin.framework.procedure import BenchError
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import ObservationOptions, Record, light_of, read
from twin.monitor.truth import Truth
from twin.orbit.monitoring.pair_flight import TOO_FAR, motions_at

if TYPE_CHECKING:
    from scenes.specs.orbit.monitor import OrbitMonitorSpec

CHUNK = 25
"""Number of states rendered at a time, to limit memory."""


def states_of(
    experiment: MonitorExperiment,
    spec: OrbitMonitorSpec,
    numbers: Sequence[int] | None = None,
    only: tuple[str, str] | None = None,
) -> list[State]:
    """Return the states of the instrument at the times of the test.

    Parameters
    ----------
    experiment : MonitorExperiment
        Instrument with its monitor.
    spec : OrbitMonitorSpec
        Content of the test file.
    numbers : sequence of int, optional
        Indices of the times; all by default.
    only : tuple of str, optional
        Pair of "temperature" or "motion" and the path of the only node to which it is applied. Other nodes in the
        file's tables over time get temperature changes of 0 K, so that they do not inherit any; the key `perturb` still
        applies.

    Raises
    ------
    InputError
        A temperature is at or below 0 K at some time, or outside the range in which a glass's index is known.
    """
    job, bodies = spec.job, {body.path: body for body in experiment.instrument.assembly.tree.bodies}
    course, states = spec.course, []
    assert course is not None
    for k in range(len(course.times)) if numbers is None else numbers:
        time, fields = course.times[k], job.fields(k)
        if only is not None:
            fields = {path: field if only == ("temperature", path) else Temperature() for path, field in fields.items()}
        try:
            experiment.thermal.check(fields)
            state = experiment.thermal.state(fields, motions_of(job))
        except TemperatureError as error:
            of_course = error.origin in course.temperature
            key = ("course", *course.key(error.origin, k)) if of_course else ("perturb", error.origin, "temperature")
            raise spec.error(f"{error} at {moment(time)}", key, allowed=error.allowed) from error
        moves = {} if only is not None and only[0] == "temperature" else motions_at(spec, time, only and only[1])
        states.append(compose(state, moves, bodies))
    return states


@dataclass(frozen=True, eq=False)
class Readings:
    """Changes of two cameras since the reference that the monitor measured at T times, with their covariances.

    Attributes
    ----------
    cameras : tuple of str
        Names of the two cameras.
    values : (T, 8) ndarray
        Rotations d_alpha, d_beta, d_gamma (rad) and change d_f of the principal distance (m) of the first camera, then
        of the second.
    noise : (T, 8, 8) ndarray
        Covariance of the errors of `values` due to the noise of the images.
    total : (T, 8, 8) ndarray or None
        Covariance of the total error of `values`, with unmodelled disturbances; None without a prior of disturbances.
    """

    cameras: tuple[str, str]
    values: np.ndarray
    noise: np.ndarray
    total: np.ndarray | None

    def _part(self, camera: str) -> slice:
        at = 4 * self.cameras.index(camera)
        return slice(at, at + 4)

    def __getitem__(self, camera: str) -> CameraParameters:
        """Return the changes (T, 4) of one camera at T times: three rotations (rad) and principal distance (m)."""
        part = self._part(camera)
        total = None if self.total is None else self.total[:, part, part]
        return CameraParameters.from_vector(self.values[:, part], self.noise[:, part, part], total)

    @property
    def across(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Cross-covariances of the errors of the two cameras at T times, (T, 4, 4): due to noise, and total."""
        return self.noise[:, :4, 4:], None if self.total is None else self.total[:, :4, 4:]


@dataclass(frozen=True, eq=False)
class SmoothedReadings:
    """Changes of the cameras, smoothed from all measurements of the monitor at one interval.

    Attributes
    ----------
    readings : Readings
        Smoothed changes at all times of the test.
    consistency : Consistency
        Chi-square test of the measurements against the prior.
    jumps : tuple of Jump or None
        Detected jumps; None where the prior has no jumps.
    """

    readings: Readings
    consistency: Consistency
    jumps: tuple[Jump, ...] | None = None


@dataclass(frozen=True, eq=False)
class Measured:
    """Shifts of all C spots since the reference images, for S states.

    Attributes
    ----------
    positions : (2, S, C, 2) ndarray
        Positions of the C spots at the reference (index 0 of the first axis) and in the S states (index 1), row and
        column, in px.
    covariance : (S, 2 C, 2 C) ndarray
        Covariance of each state's shifts, in px^2.
    noise : SeriesNoise or None
        Joint noise of the shifts of all states; None where the states are not a time series.
    evidence : SpotEvidence
        Test of the spots' sigmas against the residuals of the spots' fits.
    truth : tuple of Truth
        Truth of the states.
    """

    positions: np.ndarray
    covariance: np.ndarray
    noise: SeriesNoise | None
    evidence: SpotEvidence
    truth: tuple[Truth, ...]

    @classmethod
    def of(cls, recoveries: Sequence[Recovery], noise: SeriesNoise | None, truth: Sequence[Truth]) -> Measured:
        """Join the measured spots of successive groups of states."""
        positions = [np.stack([recovery.before, recovery.after]) for recovery in recoveries]
        evidence = SpotEvidence.joined([recovery.evidence for recovery in recoveries if recovery.evidence is not None])
        spread = np.concatenate([recovery.shift_covariance for recovery in recoveries])
        return cls(np.concatenate(positions, axis=1), spread, noise, evidence, tuple(truth))

    def doubts(self, times: Sequence[float], spots: Sequence[str]) -> tuple[str, ...]:
        """Return a warning about the worst state if the residuals of the spots' fits contradict their sigmas.

        Parameters
        ----------
        times : sequence of float
            Times of the states, in seconds.
        spots : sequence of str
            Names of the spots.
        """
        doubt = self.evidence.course_doubt([moment(time) for time in times], spots)
        return () if doubt is None else (doubt,)

    @property
    def shifts(self) -> np.ndarray:
        """Shifts of C spots since the reference images in S states, (S, 2 C), in px."""
        return (self.positions[1] - self.positions[0]).reshape(len(self.covariance), -1)


@dataclass(frozen=True, eq=False)
class _NoiseSubset:
    """Joint covariance of the noise of selected measurements of a time series."""

    noise: SeriesNoise
    at: np.ndarray

    def covariance(self, images: np.ndarray) -> np.ndarray:
        return self.noise.covariance(self.at[images])


class MonitorSeries:
    """Monitor with its reference images, which measures the changes of the cameras in a series of states.

    With a prior of disturbances, each state is estimated by the estimator `posterior`, with the prior of changes since
    the reference; otherwise by the estimator `model`.

    Parameters
    ----------
    experiment : MonitorExperiment
        Instrument with its calibration on the ground.
    spec : OrbitMonitorSpec
        Content of the test file.
    reference : State
        State at the reference time.
    pair : tuple of str
        Names of the two cameras.
    """

    def __init__(
        self, experiment: MonitorExperiment, spec: OrbitMonitorSpec, reference: State, pair: tuple[str, str]
    ) -> None:
        self.experiment, self.spec, self.pair = experiment, spec, pair
        self.frames: int = spec.frames or experiment.instrument.spec.autocollimator.frames
        self.reference = experiment.path.expected_photons([reference])
        self._clean_reference = self._reference_spots(experiment.expected_frames(self.reference))
        names = list(experiment.instrument.cameras)
        self._pair_rows = np.concatenate([np.arange(4) + 4 * names.index(name) for name in pair])

    @property
    def estimator(self) -> str:
        """Name of the estimator that is used for each state, `posterior` or `model`."""
        return "model" if self.experiment.disturbances is None else "posterior"

    def measured(self, states: Sequence[State], seed: int) -> tuple[Measured, Measured]:
        """Measure the spots' shifts in all states, from noisy frames and from expected images without noise.

        Raises
        ------
        BenchError
            A spot cannot be measured.
        AimError, BeamMissedError
            Light is lost.
        """
        # the number beyond the last state gives a separate random stream
        first = self._reference_spots(self._exposed(self.reference, seed, len(states)))
        exposed, expected = self._observed(
            states,
            (lambda photons, numbers: (first, self._exposed(photons, seed, numbers)), self._expected),
            series=True,
        )
        return Measured.of(*exposed), Measured.of(*expected)

    def clean(self, states: Sequence[State]) -> Measured:
        """Measure the spots' shifts in all states from expected images without noise.

        Raises
        ------
        BenchError
            A spot cannot be measured.
        AimError, BeamMissedError
            Light is lost.
        """
        return Measured.of(*self._observed(states, (self._expected,))[0])

    def prism_shifts(self) -> np.ndarray:
        """Return the shifts of C spots due to the temperatures of the monitor's prisms.

        They are (T, 2 C), in px, for the temperatures that the file gives at T times, without noise.
        """
        job = self.spec.job
        states = []
        for k in range(len(self.spec.times)):
            of_prisms = {p: f for p, f in job.fields(k).items() if "/monitor/" in p or p.startswith(CENTRAL_PRISM)}
            states.append(self.experiment.thermal.state(of_prisms, {}))
        shifts = self.clean(states).shifts
        return np.asarray(shifts - shifts[self.spec.reference_index])

    def repeated(self, state: State, count: int, seed: int, number: int) -> Measured:
        """Measure the reference and one state ``count`` times, each time with new fixed-pattern noise of the detectors.

        Parameters
        ----------
        state : State
            State to measure.
        count : int
            Number of measurements.
        seed : int
            Seed of the detectors.
        number : int
            Index of the state's time.
        """

        def record(k: int) -> Record:
            return lambda photons, numbers: (
                self._exposed(self.reference, seed + k, 1)[0],
                self._exposed(photons, seed + k, 0),
            )

        repeats = self._observed([state], [record(k) for k in range(count)], [number])
        return Measured.of([recovery for recoveries, _, _ in repeats for recovery in recoveries], None, repeats[0][2])

    def gains(self, measured: Measured, numbers: Sequence[int]) -> np.ndarray:
        """Return the estimator's gains for C spots in S states, (S, 8, 2 C), in rad or m per pixel of shift.

        The 8 parameters are the rotations d_alpha, d_beta, d_gamma (rad) and the change d_f of the principal distance
        (m) of the first camera, then of the second.

        Parameters
        ----------
        measured : Measured
            Shifts of S states.
        numbers : sequence of int
            Indices of their times.
        """
        prior, spec = self.experiment.disturbances, self.spec
        cameras, (before, after) = self.experiment.cameras, measured.positions
        if prior is None:
            all_gains = LeastSquares().gain(Shifts(before, after, measured.covariance, cameras))
            return np.asarray(all_gains[:, self._pair_rows])
        gains = []
        for k, number in enumerate(numbers):
            single, span = slice(k, k + 1), prior.between(spec.reference_time, spec.times[number])
            shifts = Shifts(before[single], after[single], measured.covariance[single], cameras, span)
            gains.append(Posterior().gain(shifts)[0, self._pair_rows])
        return np.array(gains)

    def readings(self, measured: Measured, numbers: Sequence[int]) -> Readings:
        """Estimate the changes of the two cameras in each state from the shifts of the spots in that state alone.

        Parameters
        ----------
        measured : Measured
            Shifts of S states.
        numbers : sequence of int
            Indices of their times.
        """
        gains = self.gains(measured, numbers)
        noise = gains @ measured.covariance @ np.swapaxes(gains, 1, 2)
        values = np.einsum("spd,sd->sp", gains, measured.shifts)
        prior, total = self.experiment.disturbances, None
        if prior is not None:
            misfits = []
            for gain, number in zip(gains, numbers, strict=True):
                span = prior.between(self.spec.reference_time, self.spec.times[number])
                root = (gain @ span.spots - span.parameters[self._pair_rows]) @ span.root
                misfits.append(root @ root.T)
            total = noise + np.array(misfits)
        return Readings(self.pair, values, noise, total)

    def smoothed(self, measured: Measured, interval: float) -> SmoothedReadings:
        """Estimate the cameras' changes at all times by smoothing the measurements at one interval.

        Parameters
        ----------
        measured : Measured
            Shifts at all times of the test.
        interval : float
            Interval between measurements, in seconds.
        """
        prior, noise = self.experiment.disturbances, measured.noise
        if prior is None or noise is None:
            raise ValueError("smoother: needs stated disturbances and a series")
        at = np.array(self.spec.measured(interval))
        times = np.array(self.spec.times)
        with one_blas_thread():
            series = smooth_series(
                prior,
                times[at],
                measured.shifts[at],
                _NoiseSubset(noise, at),
                times,
                reference=self.spec.reference_time,
            )
        rows, smoothed = self._pair_rows, series.smoothed
        block = np.ix_(np.arange(len(times)), rows, rows)
        return SmoothedReadings(
            Readings(self.pair, smoothed.values[:, rows], smoothed.noise[block], smoothed.total[block]),
            series.consistency,
            series.jumps,
        )

    def estimates_by_camera(self, gains: np.ndarray, shifts: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return each camera's estimated changes in S states from the shifts of C spots, (S, 4), in rad and m.

        Parameters
        ----------
        gains : (S, 8, 2 C) or (8, 2 C) ndarray
            Gains of the estimator, in rad or m per px.
        shifts : (S, 2 C) ndarray
            Shifts of the spots, in px.
        """
        values = np.einsum("...pd,...d->...p", gains, shifts)
        return {name: values[:, 4 * k : 4 * k + 4] for k, name in enumerate(self.pair)}

    def _exposed(self, photons: np.ndarray, seed: int, numbers: int | np.ndarray) -> np.ndarray:
        return mean_frames(self.experiment.frames_after(photons, self.frames, seed, numbers))

    def _expected(self, photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
        """Return the reference spots and noise-free images, with the interface of a function that records images."""
        return self._clean_reference, self.experiment.expected_frames(photons)

    def _reference_spots(self, images: np.ndarray) -> MeasuredSpots:
        """Measure the C spots in mean frames (1, C, rows, columns) of the reference state."""
        experiment, centroid = self.experiment, self.spec.analysis.centroid
        with self._reporting_spot_errors([self.spec.reference_index]), one_blas_thread():
            return judged_spots(images[0], self.frames, experiment.calibration, centroid, cores())

    def _observed(
        self, states: Sequence[State], records: Sequence[Record], numbers: Sequence[int] = (), series: bool = False
    ) -> list[tuple[list[Recovery], SeriesNoise | None, list[Truth]]]:
        """Measure the spots in the same states with several functions that record images, in groups for `Measured.of`.

        Parameters
        ----------
        states : sequence of State
            States to observe.
        records : sequence of Record
            Functions that record images.
        numbers : sequence of int
            Indices of the states' times; by default those of the test.
        series : bool
            True if the states are those of all times and the joint covariance of their noise is needed.
        """
        experiment, spots = self.experiment, self.experiment.calibration.spots
        series = series and experiment.disturbances is not None
        times = numbers or range(len(states))
        noise: list[SeriesNoise | None] = [None] * len(records)
        recoveries: list[list[Recovery]] = [[] for _ in records]
        truths = []
        for first in range(0, len(states), CHUNK):
            piece = slice(first, first + CHUNK)
            piece_states = states[piece]
            photons = experiment.path.expected_photons(piece_states, chunk=CHUNK)
            light = light_of(experiment, piece_states, np.arange(first, first + len(piece_states)), photons=photons)
            truths.append(light.truth)
            for k, record in enumerate(records):
                observing = ObservationOptions(
                    record, self.spec.analysis.centroid, use_prior=False, keep_parts=series, frames=self.frames
                )
                with self._reporting_spot_errors(times[piece]):
                    result = read(experiment, light, observing)
                assert result is not None
                if result.recovery.parts is not None:
                    before, after = result.recovery.parts
                    together = noise[k] = noise[k] or SeriesNoise(before, window_of(2 * spots))
                    together.add(after)
                # influence maps of all positions would be large
                recoveries[k].append(replace(result.recovery, parts=None))
        return [(recovered, series_noise, truths) for recovered, series_noise in zip(recoveries, noise, strict=True)]

    @contextmanager
    def _reporting_spot_errors(self, numbers: Sequence[int]) -> Iterator[None]:
        """Convert errors about unmeasurable spots to errors about the test's file that name the state's time.

        Parameters
        ----------
        numbers : sequence of int
            Index of each state's time.
        """
        try:
            yield
        except SpotError as error:
            state, spot = divmod(error.indices[0], self.experiment.calibration.spots)
            channel, reason = self.experiment.path.channels[spot].key, error.reasons[error.indices[0]]
            time = moment(self.spec.times[min(numbers[state], len(self.spec.times) - 1)])
            text = f"the spot {channel} cannot be measured at {time} ({reason})"
            raise BenchError(text, ("course",), TOO_FAR) from error
