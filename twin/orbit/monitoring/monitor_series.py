"""Readings of the monitor of a stereo pair over a course, counted from its reference images."""

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
from analysis.spots.spot_positions import SeriesNoise, SpotError
from optics.geometry.tree import State, compose
from optics.numerics.backend import cores, one_blas_thread
from optics.thermal.heat import Temperature
from scenes.models.job_state import motions_of
from scenes.models.thermal_model import TemperatureError
from scenes.specs.course import moment
from scenes.specs.instrument import CENTRAL_PRISM
from twin.framework.procedure import BenchError
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import Observing, Record, light_of, read
from twin.monitor.truth import Truth
from twin.orbit.monitoring.pair_flight import TOO_FAR, moves_at

if TYPE_CHECKING:
    from scenes.specs.orbit.monitor import OrbitMonitorSpec

CHUNK = 25
"""States rendered at once, to bound memory."""


def states_of(
    experiment: MonitorExperiment,
    spec: OrbitMonitorSpec,
    numbers: Sequence[int] | None = None,
    only: tuple[str, str] | None = None,
) -> list[State]:
    """States at times of the course.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    spec : OrbitMonitorSpec
        The test.
    numbers : Sequence[int] | None
        Of the times, all by default.
    only : tuple[str, str] | None
        "temperature" or "motion", and the node of the course that alone has one; the others of the course have
        temperatures of 0 K, so that nothing is inherited. What `perturb` says stays.

    Raises
    ------
    InputError
        a temperature at or below 0 K at some time, or one at which a glass's index is not known.
    """
    job, bodies = spec.job, {body.path: body for body in experiment.instrument.assembly.tree.bodies}
    course, out = spec.course, []
    assert course is not None
    for k in range(len(course.times)) if numbers is None else numbers:
        time, fields = course.times[k], job.fields(k)
        if only is not None:
            fields = {path: field if only == ("temperature", path) else Temperature() for path, field in fields.items()}
        try:
            experiment.thermal.check(fields)
            state = experiment.thermal.state(fields, motions_of(job))
        except TemperatureError as error:
            own = error.origin in course.temperature
            key = ("course", *course.key(error.origin, k)) if own else ("perturb", error.origin, "temperature")
            raise spec.error(f"{error} at {moment(time)}", key, allowed=error.allowed) from error
        moves = {} if only is not None and only[0] == "temperature" else moves_at(spec, time, only and only[1])
        out.append(compose(state, moves, bodies))
    return out


@dataclass(frozen=True, eq=False)
class Readings:
    """Changes of two cameras since the reference at T times.

    Attributes
    ----------
    cameras : tuple[str, str]
        Names of the two.
    values : np.ndarray
        (T, 8) d_alpha, d_beta, d_gamma (rad), d_f (m) of the first, then of the second.
    noise : np.ndarray
        (T, 8, 8) covariance of their errors by the noise of the images.
    total : np.ndarray | None
        Likewise of the whole error; None where nothing is stated to move.
    """

    cameras: tuple[str, str]
    values: np.ndarray
    noise: np.ndarray
    total: np.ndarray | None

    def _part(self, camera: str) -> slice:
        at = 4 * self.cameras.index(camera)
        return slice(at, at + 4)

    def __getitem__(self, camera: str) -> CameraParameters:
        """One camera's."""
        part = self._part(camera)
        total = None if self.total is None else self.total[:, part, part]
        return CameraParameters.from_vector(self.values[:, part], self.noise[:, part, part], total)

    @property
    def across(self) -> tuple[np.ndarray, np.ndarray | None]:
        """(T, 4, 4) covariances of the first camera's with the second's errors: by noise, and of the whole error."""
        return self.noise[:, :4, 4:], None if self.total is None else self.total[:, :4, 4:]


@dataclass(frozen=True, eq=False)
class SmoothedReadings:
    """All measurements at one interval together.

    Attributes
    ----------
    readings : Readings
        At all times of the course.
    consistency : Consistency
        Chi-square of the measurements.
    jumps : tuple[Jump, ...] | None
        That were found; None where nothing is stated to jump.
    """

    readings: Readings
    consistency: Consistency
    jumps: tuple[Jump, ...] | None = None


@dataclass(frozen=True, eq=False)
class Measured:
    """Shifts of all spots since the reference images, of S states.

    Attributes
    ----------
    positions : np.ndarray
        (2, S, C, 2) before and after, px.
    covariance : np.ndarray
        (S, 2 C, 2 C) px^2 of each state's shifts.
    noise : SeriesNoise | None
        Of the shifts of all states together; None where they are not of one series.
    evidence : SpotEvidence
        What the fits of the spots say of their sigmas.
    truth : tuple[Truth, ...]
        Of the states.
    """

    positions: np.ndarray
    covariance: np.ndarray
    noise: SeriesNoise | None
    evidence: SpotEvidence
    truth: tuple[Truth, ...]

    @classmethod
    def of(cls, found: Sequence[Recovery], noise: SeriesNoise | None, truth: Sequence[Truth]) -> Measured:
        """From what was recovered piece by piece."""
        positions = [np.stack([one.before, one.after]) for one in found]
        evidence = SpotEvidence.joined([one.evidence for one in found if one.evidence is not None])
        spread = np.concatenate([one.shift_covariance for one in found])
        return cls(np.concatenate(positions, axis=1), spread, noise, evidence, tuple(truth))

    def doubts(self, times: Sequence[float], spots: Sequence[str]) -> tuple[str, ...]:
        """A warning where sigma does not hold: at the worst of the states.

        Parameters
        ----------
        times : Sequence[float]
            Of the states, seconds.
        spots : Sequence[str]
            Their names.
        """
        doubt = self.evidence.course_doubt([moment(time) for time in times], spots)
        return () if doubt is None else (doubt,)

    @property
    def shifts(self) -> np.ndarray:
        """(S, 2 C) px."""
        return (self.positions[1] - self.positions[0]).reshape(len(self.covariance), -1)


@dataclass(frozen=True, eq=False)
class _Some:
    """Noise of some measurements of a series."""

    noise: SeriesNoise
    at: np.ndarray

    def covariance(self, images: np.ndarray) -> np.ndarray:
        return self.noise.covariance(self.at[images])


class MonitorSeries:
    """A monitor with its reference images. Where disturbances are stated each state is read by `posterior`, with what
    they are expected to change since the reference; else by `model`.

    Parameters
    ----------
    experiment
        The instrument with its calibration on the ground.
    spec
        The test.
    reference
        State at the reference time.
    pair
        The two cameras.
    """

    def __init__(
        self, experiment: MonitorExperiment, spec: OrbitMonitorSpec, reference: State, pair: tuple[str, str]
    ) -> None:
        self.experiment, self.spec, self.pair = experiment, spec, pair
        self.frames: int = spec.frames or experiment.instrument.spec.autocollimator.frames
        self.reference = experiment.path.expected_photons([reference])
        self._clean_reference = self._reference_spots(experiment.expected_frames(self.reference))
        names = list(experiment.instrument.cameras)
        self._own = np.concatenate([np.arange(4) + 4 * names.index(name) for name in pair])

    @property
    def estimator(self) -> str:
        """Name of the estimator that reads each state."""
        return "model" if self.experiment.disturbances is None else "posterior"

    def measured(self, states: Sequence[State], seed: int) -> tuple[Measured, Measured]:
        """From exposed frames, and from expected images without noise.

        Raises
        ------
        BenchError
            a spot cannot be measured.
        AimError, BeamMissedError
            Light is lost.
        """
        # a stream of its own: states are numbered from 0
        first = self._reference_spots(self._exposed(self.reference, seed, len(states)))
        exposed, expected = self._observed(
            states,
            (lambda photons, numbers: (first, self._exposed(photons, seed, numbers)), self._expected),
            series=True,
        )
        return Measured.of(*exposed), Measured.of(*expected)

    def clean(self, states: Sequence[State]) -> Measured:
        """From expected images without noise. Raises as `measured`."""
        return Measured.of(*self._observed(states, (self._expected,))[0])

    def of_prisms(self) -> np.ndarray:
        """(T, 2 C) shifts without noise by temperatures that the file gives to the monitor's prisms themselves."""
        job = self.spec.job
        states = []
        for k in range(len(self.spec.times)):
            own = {p: f for p, f in job.fields(k).items() if "/monitor/" in p or p.startswith(CENTRAL_PRISM)}
            states.append(self.experiment.thermal.state(own, {}))
        shifts = self.clean(states).shifts
        return np.asarray(shifts - shifts[self.spec.referred])

    def repeated(self, state: State, count: int, seed: int, number: int) -> Measured:
        """Measure the reference and one state ``count`` times, each time with another pattern of the detectors.

        ``number`` is that of the state's time.
        """

        def record(k: int) -> Record:
            return lambda photons, numbers: (
                self._exposed(self.reference, seed + k, 1)[0],
                self._exposed(photons, seed + k, 0),
            )

        every = self._observed([state], [record(k) for k in range(count)], [number])
        return Measured.of([one for found, _, _ in every for one in found], None, every[0][2])

    def gains(self, measured: Measured, numbers: Sequence[int]) -> np.ndarray:
        """(S, 8, 2 C) of the estimator, parameters of the pair per pixel.

        Parameters
        ----------
        measured : Measured
            S states.
        numbers : Sequence[int]
            Of their times.
        """
        stated, spec = self.experiment.disturbances, self.spec
        cameras, (before, after) = self.experiment.cameras, measured.positions
        if stated is None:
            every = LeastSquares().gain(Shifts(before, after, measured.covariance, cameras))
            return np.asarray(every[:, self._own])
        out = []
        for k, number in enumerate(numbers):
            one, span = slice(k, k + 1), stated.between(spec.reference_time, spec.times[number])
            shifts = Shifts(before[one], after[one], measured.covariance[one], cameras, span)
            out.append(Posterior().gain(shifts)[0, self._own])
        return np.array(out)

    def readings(self, measured: Measured, numbers: Sequence[int]) -> Readings:
        """Return what the shifts of each state say alone.

        Parameters
        ----------
        measured : Measured
            S states.
        numbers : Sequence[int]
            Of their times.
        """
        gains = self.gains(measured, numbers)
        noise = gains @ measured.covariance @ np.swapaxes(gains, 1, 2)
        values = np.einsum("spd,sd->sp", gains, measured.shifts)
        stated, total = self.experiment.disturbances, None
        if stated is not None:
            left = []
            for gain, number in zip(gains, numbers, strict=True):
                span = stated.between(self.spec.reference_time, self.spec.times[number])
                root = (gain @ span.spots - span.parameters[self._own]) @ span.root
                left.append(root @ root.T)
            total = noise + np.array(left)
        return Readings(self.pair, values, noise, total)

    def smoothed(self, measured: Measured, interval: float) -> SmoothedReadings:
        """From the measurements at one interval, at all times.

        Parameters
        ----------
        measured : Measured
            All times of the course.
        interval : float
            seconds.
        """
        stated, noise = self.experiment.disturbances, measured.noise
        if stated is None or noise is None:
            raise ValueError("smoother: needs stated disturbances and a series")
        at = np.array(self.spec.measured(interval))
        times = np.array(self.spec.times)
        with one_blas_thread():
            found = smooth_series(
                stated, times[at], measured.shifts[at], _Some(noise, at), times, reference=self.spec.reference_time
            )
        own, late = self._own, found.smoothed
        block = np.ix_(np.arange(len(times)), own, own)
        return SmoothedReadings(
            Readings(self.pair, late.values[:, own], late.noise[block], late.total[block]),
            found.consistency,
            found.jumps,
        )

    def by_camera(self, gains: np.ndarray, shifts: np.ndarray) -> Mapping[str, np.ndarray]:
        """Camera -> (S, 4) what an estimator makes of shifts.

        Parameters
        ----------
        gains : np.ndarray
            (S, 8, 2 C) or (8, 2 C).
        shifts : np.ndarray
            (S, 2 C).
        """
        values = np.einsum("...pd,...d->...p", gains, shifts)
        return {name: values[:, 4 * k : 4 * k + 4] for k, name in enumerate(self.pair)}

    def _exposed(self, photons: np.ndarray, seed: int, numbers: int | np.ndarray) -> np.ndarray:
        return mean_frames(self.experiment.frames_after(photons, self.frames, seed, numbers))

    def _expected(self, photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
        """A `Record` of expected images."""
        return self._clean_reference, self.experiment.expected_frames(photons)

    def _reference_spots(self, images: np.ndarray) -> MeasuredSpots:
        """Measure the spots of mean frames (1, C, rows, columns) at the reference."""
        experiment, centroid = self.experiment, self.spec.analysis.centroid
        with self._told([self.spec.referred]), one_blas_thread():
            return judged_spots(images[0], self.frames, experiment.calibration, centroid, cores())

    def _observed(
        self, states: Sequence[State], records: Sequence[Record], numbers: Sequence[int] = (), series: bool = False
    ) -> list[tuple[list[Recovery], SeriesNoise | None, list[Truth]]]:
        """Observe the same states by several ways to record images, piece by piece, as `Measured.of` takes it.

        Parameters
        ----------
        states : Sequence[State]
            To be observed.
        records : Sequence[Record]
            Ways to record.
        numbers : Sequence[int]
            Of the states' times; those of the course if not given.
        series : bool
            Whether the states are those of the course, whose noise is wanted together.
        """
        experiment, spots = self.experiment, self.experiment.calibration.spots
        series = series and experiment.disturbances is not None
        times = numbers or range(len(states))
        noise: list[SeriesNoise | None] = [None] * len(records)
        found: list[list[Recovery]] = [[] for _ in records]
        truths = []
        for first in range(0, len(states), CHUNK):
            piece = slice(first, first + CHUNK)
            some = states[piece]
            photons = experiment.path.expected_photons(some, chunk=CHUNK)
            light = light_of(experiment, some, np.arange(first, first + len(some)), photons=photons)
            truths.append(light.truth)
            for k, record in enumerate(records):
                how = Observing(
                    record, self.spec.analysis.centroid, stated=False, keep_parts=series, frames=self.frames
                )
                with self._told(times[piece]):
                    one = read(experiment, light, how)
                assert one is not None
                if one.recovery.parts is not None:
                    before, after = one.recovery.parts
                    together = noise[k] = noise[k] or SeriesNoise(before, window_of(2 * spots))
                    together.add(after)
                # influence maps of all positions would be large
                found[k].append(replace(one.recovery, parts=None))
        return [(every, own, truths) for every, own in zip(found, noise, strict=True)]

    @contextmanager
    def _told(self, numbers: Sequence[int]) -> Iterator[None]:
        """Spots that cannot be measured as an error of the file, with the number of each state's time."""
        try:
            yield
        except SpotError as error:
            state, spot = divmod(error.indices[0], self.experiment.calibration.spots)
            channel, reason = self.experiment.path.channels[spot].key, error.reasons[error.indices[0]]
            time = moment(self.spec.times[min(numbers[state], len(self.spec.times) - 1)])
            text = f"the spot {channel} cannot be measured at {time} ({reason})"
            raise BenchError(text, ("course",), TOO_FAR) from error
