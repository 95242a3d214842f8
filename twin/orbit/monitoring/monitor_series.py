"""What the monitor of a stereo pair says over a course, counted from its reference images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.monitor.disturbances import Consistency
from analysis.monitor.estimators import LeastSquares, Posterior, Shifts
from analysis.monitor.monitoring import CameraParameters
from analysis.monitor.recovery import joint, judged_spots
from analysis.monitor.series_smoother import smooth, window_of
from analysis.monitor.spot_evidence import SpotEvidence
from analysis.spots.centroid import mean_frames
from analysis.spots.fit_state import FitStates
from analysis.spots.spot_positions import (
    SeriesNoise,
    SpotError,
    SpotPositions,
    difference_covariance,
    noise_parts,
)
from optics.geometry.tree import State
from optics.numerics.threads import cores, one_blas_thread
from scenes.specs.course import moment
from scenes.specs.instrument import CENTRAL_PRISM
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.run.procedure import BenchError

if TYPE_CHECKING:
    from scenes.specs.orbit.monitor import OrbitMonitorSpec

CHUNK = 25
"""States rendered at once, to bound memory."""
TOO_FAR = "temperatures and motions that keep the beams on the mirrors and the spots on their CCDs"


Judged = tuple[SpotPositions, FitStates]
"""Spots with the sigmas that their fits leave them, and how good these are."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Changes of two cameras since the reference at T times.

    Attributes:
        cameras: names of the two.
        values: (T, 8) d_alpha, d_beta, d_gamma (rad), d_f (m) of the first, then of the second.
        noise: (T, 8, 8) covariance of their errors by the noise of the images.
        total: likewise of the whole error; None where nothing is stated to move.
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

    Attributes:
        readings: at all times of the course.
        consistency: chi-square of the measurements.
    """

    readings: Readings
    consistency: Consistency


@dataclass(frozen=True, eq=False)
class Measured:
    """Shifts of all spots since the reference images, of S states.

    Attributes:
        positions: (2, S, C, 2) before and after, px.
        covariance: (S, 2 C, 2 C) px^2 of each state's shifts.
        noise: of the shifts of all states together; None where they are not of one series.
        evidence: what the fits of the spots say of their sigmas.
    """

    positions: np.ndarray
    covariance: np.ndarray
    noise: SeriesNoise | None
    evidence: SpotEvidence

    def doubts(self, times: Sequence[float], spots: Sequence[str]) -> tuple[str, ...]:
        """A warning where sigma does not hold: at the worst of the states.

        Args:
            times: of the states, seconds.
            spots: their names.
        """
        told = self.evidence.course_doubt([moment(time) for time in times], spots)
        return () if told is None else (told,)

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


class _Collected:
    """Differences to one set of reference images, piece by piece: influence maps of all positions would be large."""

    def __init__(self, experiment: MonitorExperiment, start: Judged, series: bool) -> None:
        before, self.fits = start
        self.detector, self.before = experiment.calibration.noise, before
        self.more: list[FitStates] = []
        self.spots = experiment.calibration.spots
        self.end: list[np.ndarray] = []
        self.spread: list[np.ndarray] = []
        self.noise: SeriesNoise | None = None
        if series and experiment.disturbances is not None:
            self.noise = SeriesNoise(noise_parts(before, self.detector), window_of(2 * self.spots))

    def add(self, found: Judged) -> None:
        after, fits = found
        self.more.append(fits)
        spread = difference_covariance(self.before, after, self.detector)
        self.spread.append(joint(spread.reshape(-1, self.spots, 2, 2)))
        self.end.append(after.position.reshape(-1, self.spots, 2))
        if self.noise is not None:
            self.noise.add(noise_parts(after, self.detector))

    def measured(self) -> Measured:
        end = np.concatenate(self.end)
        start = np.broadcast_to(self.before.position.reshape(1, self.spots, 2), end.shape)
        evidence = SpotEvidence(self.fits, FitStates.joined(self.more))
        return Measured(np.stack([start, end]), np.concatenate(self.spread), self.noise, evidence)


class MonitorSeries:
    """A monitor with its reference images. Where disturbances are stated each state is read by `posterior`, with what
    they are expected to change since the reference; else by `model`.

    Args:
        experiment: the instrument with its calibration on the ground.
        spec: the test.
        reference: state at the reference time.
        pair: the two cameras.
    """

    def __init__(
        self, experiment: MonitorExperiment, spec: OrbitMonitorSpec, reference: State, pair: tuple[str, str]
    ) -> None:
        self.experiment, self.spec, self.pair = experiment, spec, pair
        self.frames: int = spec.frames or experiment.instrument.spec.monitor.frames
        self.reference = experiment.path.expected_photons([reference])
        self._clean_reference = self._spots(experiment.expected_frames(self.reference), None)
        names = list(experiment.instrument.cameras)
        self._own = np.concatenate([np.arange(4) + 4 * names.index(name) for name in pair])

    @property
    def estimator(self) -> str:
        """By which each state is read."""
        return "model" if self.experiment.disturbances is None else "posterior"

    def measured(self, states: Sequence[State], seed: int) -> tuple[Measured, Measured]:
        """From exposed frames, and from expected images without noise.

        Raises:
            BenchError: a spot cannot be measured.
            AimError, BeamMissedError: light is lost.
        """
        experiment = self.experiment
        # a stream of its own: states are numbered from 0
        first = mean_frames(experiment.frames_after(self.reference, self.frames, seed, len(states))[0])
        exposed = _Collected(experiment, self._spots(first, None), True)
        expected = _Collected(experiment, self._clean_reference, True)
        for piece, photons in experiment.path.iterate_photons(states, chunk=CHUNK):
            after = mean_frames(experiment.frames_after(photons, self.frames, seed, piece.start))
            exposed.add(self._spots(after, piece.start))
            expected.add(self._spots(experiment.expected_frames(photons), piece.start))
        return exposed.measured(), expected.measured()

    def clean(self, states: Sequence[State]) -> np.ndarray:
        """(S, 2 C) shifts from expected images without noise, px. Raises as `measured`."""
        found = _Collected(self.experiment, self._clean_reference, False)
        for piece, photons in self.experiment.path.iterate_photons(states, chunk=CHUNK):
            found.add(self._spots(self.experiment.expected_frames(photons), piece.start))
        return found.measured().shifts

    def of_prisms(self) -> np.ndarray:
        """(T, 2 C) shifts without noise by temperatures that the file gives to the monitor's prisms themselves."""
        job = self.spec.job
        states = []
        for k in range(len(self.spec.course.times)):
            own = {p: f for p, f in job.fields(k).items() if "/monitor/" in p or p.startswith(CENTRAL_PRISM)}
            states.append(self.experiment.thermal.state(own, {}))
        shifts = self.clean(states)
        return np.asarray(shifts - shifts[self.spec.referred])

    def repeated(self, state: State, count: int, seed: int, number: int) -> Measured:
        """Of one state, ``count`` times: reference and state measured anew each time, with another detector's pattern.

        ``number`` is that of the state's time.
        """
        experiment = self.experiment
        photons = experiment.path.expected_photons([state])
        pieces = []
        for k in range(count):
            before, after = (
                mean_frames(experiment.frames_after(what, self.frames, seed + k, which)[0])
                for what, which in ((self.reference, 1), (photons, 0))
            )
            found = _Collected(experiment, self._spots(before, number), False)
            found.add(self._spots(after, number))
            pieces.append(found.measured())
        positions = np.concatenate([one.positions for one in pieces], axis=1)
        every = [one.evidence for one in pieces]
        first, last = (FitStates.joined([getattr(one, name) for one in every]) for name in ("before", "after"))
        covariance = np.concatenate([one.covariance for one in pieces])
        return Measured(positions, covariance, None, SpotEvidence(first, last))

    def gains(self, measured: Measured, numbers: Sequence[int]) -> np.ndarray:
        """(S, 8, 2 C) of the estimator, parameters of the pair per pixel.

        Args:
            measured: S states.
            numbers: of their times.
        """
        stated, spec = self.experiment.disturbances, self.spec
        cameras, (before, after) = self.experiment.cameras, measured.positions
        if stated is None:
            every = LeastSquares().gain(Shifts(before, after, measured.covariance, cameras))
            return np.asarray(every[:, self._own])
        out = []
        for k, number in enumerate(numbers):
            one, span = slice(k, k + 1), stated.since(spec.course.times[number] - spec.reference)
            shifts = Shifts(before[one], after[one], measured.covariance[one], cameras, span)
            out.append(Posterior().gain(shifts)[0, self._own])
        return np.array(out)

    def readings(self, measured: Measured, numbers: Sequence[int]) -> Readings:
        """What each state's own shifts say.

        Args:
            measured: S states.
            numbers: of their times.
        """
        gains = self.gains(measured, numbers)
        noise = gains @ measured.covariance @ np.swapaxes(gains, 1, 2)
        values = np.einsum("spd,sd->sp", gains, measured.shifts)
        stated, total = self.experiment.disturbances, None
        if stated is not None:
            left = []
            for gain, number in zip(gains, numbers, strict=True):
                span = stated.since(self.spec.course.times[number] - self.spec.reference)
                root = (gain @ span.spots - span.parameters[self._own]) @ span.root
                left.append(root @ root.T)
            total = noise + np.array(left)
        return Readings(self.pair, values, noise, total)

    def smoothed(self, measured: Measured, interval: float) -> SmoothedReadings:
        """From the measurements at one interval, at all times.

        Args:
            measured: all times of the course.
            interval: seconds.
        """
        stated, noise = self.experiment.disturbances, measured.noise
        if stated is None or noise is None:
            raise ValueError("smoother: needs stated disturbances and a series")
        at = np.array(self.spec.measured(interval))
        times = np.array(self.spec.course.times)
        with one_blas_thread():
            found = smooth(
                stated, times[at], measured.shifts[at], _Some(noise, at), times, reference=self.spec.reference
            )
        own, late = self._own, found.smoothed
        block = np.ix_(np.arange(len(times)), own, own)
        return SmoothedReadings(
            Readings(self.pair, late.values[:, own], late.noise[block], late.total[block]), found.consistency
        )

    def by_camera(self, gains: np.ndarray, shifts: np.ndarray) -> Mapping[str, np.ndarray]:
        """Camera -> (S, 4) what an estimator makes of shifts.

        Args:
            gains: (S, 8, 2 C) or (8, 2 C).
            shifts: (S, 2 C).
        """
        values = np.einsum("...pd,...d->...p", gains, shifts)
        return {name: values[:, 4 * k : 4 * k + 4] for k, name in enumerate(self.pair)}

    def _spots(self, frames: np.ndarray, first: int | None) -> Judged:
        calibration = self.experiment.calibration
        flat = frames.reshape(-1, *frames.shape[-2:])
        try:
            with one_blas_thread():
                return judged_spots(flat, self.frames, calibration, self.spec.analysis.centroid, cores())
        except SpotError as error:
            raise self._lost(error, self.spec.referred if first is None else first) from error

    def _lost(self, error: SpotError, first: int) -> BenchError:
        state, spot = divmod(error.indices[0], self.experiment.calibration.spots)
        number = min(first + state, len(self.spec.course.times) - 1)
        channel = self.experiment.path.channels[spot].key
        reason = error.reasons[error.indices[0]]
        time = moment(self.spec.course.times[number])
        return BenchError(f"the spot {channel} cannot be measured at {time} ({reason})", ("course",), TOO_FAR)
