"""Observation of states of an instrument: trace rays, render and expose images, and recover the changes from them.

The main job, time series, studies, the live twin, error budgets and random states all use it; their differences are in
`ObservationOptions`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from analysis.arrays import shows
from analysis.monitor.recovery import MeasuredSpots, Recovery, judged_spots, recover_monitor
from analysis.spots.centroid import mean_frames
from analysis.spots.spot_image import SpotError
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.backend import cores, one_blas_thread, one_kernel_thread
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from twin.framework.frame_store import in_file, mean_of
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import Truth

LOST = (AimError, BeamMissedError)
"""Exceptions that mean that the light of a state does not reach the area CCDs."""

Record: TypeAlias = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray | MeasuredSpots, np.ndarray]]
"""Function that exposes the detectors to light: from expected photons and state numbers to frames before and after.

Its arguments are the expected photons (S, C, rows, columns) of S states and C channels, and the state numbers (S,),
which select random streams. It returns two things: the frames before the change, (C, frames, rows, columns) for all
states or (S, C, frames, rows, columns), or else the already measured spots before; and the frames after the change, (S,
C, frames, rows, columns).
"""


@dataclass(frozen=True)
class ObservationOptions:
    """Options of an observation.

    Attributes
    ----------
    record : Record
        Function that exposes the detectors: from expected photons and state numbers to frames before and after.
    centroid : str
        Centroid method of the spots: ``ml`` (maximum likelihood), ``gaussian`` or ``energy``.
    chunk : int
        Number of states processed at once; the last digits of a state's results depend on the others in its chunk.
    single : bool
        True to render in single precision.
    omit : callable | None
        Function that is called with the number and reason of each state that is omitted because its light does not
        arrive or a spot cannot be measured; None to raise the error instead.
    use_prior : bool
        True to use the experiment's prior, and to check results by a ray trace of its motions; False to report standard
        deviations due to noise alone.
    keep_parts : bool
        True to return the contributions to the noise separately, which takes much memory.
    frames : int | None
        Number of frames averaged into each recorded image; None if frames are recorded one by one.
    """

    record: Record
    centroid: str = "ml"
    chunk: int = 40
    single: bool = True
    omit: Callable[[int, str], None] | None = None
    use_prior: bool = True
    keep_parts: bool = False
    frames: int | None = None


@shows()
@dataclass(frozen=True, eq=False)
class Light:
    """Light of S states on the area CCDs before detection, with the true changes of the cameras.

    Attributes
    ----------
    numbers : (S,) ndarray of int
        Numbers of the states, which select random streams.
    placed : PlacedBodies
        Positions of the bodies in the states.
    truth : Truth
        True changes of the cameras.
    photons : (S, C, rows, columns) ndarray
        Expected photons per pixel and frame on the CCDs of C channels.
    """

    numbers: np.ndarray
    placed: PlacedBodies
    truth: Truth
    photons: np.ndarray


@shows()
@dataclass(frozen=True, eq=False)
class Observation:
    """True changes of S states, and their recovery from images.

    Attributes
    ----------
    light : Light
        Light of all states that were recorded.
    measured : ndarray of int
        Indices of the states that could be measured.
    after : ndarray
        Frames of all states of ``light``, as returned by `Record`.
    recovery : Recovery
        Recovered changes of the measured states.
    """

    light: Light
    measured: np.ndarray
    after: np.ndarray
    recovery: Recovery

    @property
    def numbers(self) -> np.ndarray:
        """Numbers of the states that could be measured; a state's number selects its random stream."""
        return self.light.numbers[self.measured]

    @property
    def truth(self) -> Truth:
        """True changes of the cameras in the states that could be measured."""
        return self.light.truth.at(self.measured)


def observe(
    experiment: MonitorExperiment,
    states: Sequence[State],
    how: ObservationOptions,
    numbers: Sequence[int] | np.ndarray | None = None,
) -> Iterator[Observation]:
    """Trace, render, expose and recover states, ``how.chunk`` states at a time.

    Parameters
    ----------
    experiment : MonitorExperiment
        Experiment with the instrument.
    states : sequence of State
        S states to observe.
    how : ObservationOptions
        Options.
    numbers : (S,) array_like of int | None
        Numbers of the states, which select random streams; None to count from 0.

    Yields
    ------
    Observation
        Observations of ``how.chunk`` states without the omitted ones; nothing for a chunk without any measured state.

    Raises
    ------
    BeamMissedError, AimError
        Light is lost, or a spot is not on its CCD.
    SpotError
        A spot cannot be measured.
    """
    state_numbers = np.arange(len(states)) if numbers is None else np.asarray(numbers)
    for first in range(0, len(states), how.chunk):
        chunk_states, chunk_numbers = states[first : first + how.chunk], state_numbers[first : first + how.chunk]
        try:
            light = light_of(experiment, chunk_states, chunk_numbers, how.single)
        except LOST:
            if how.omit is None:
                raise
            reasons = [why_lost(experiment, state) for state in chunk_states]
            for number, why in zip(chunk_numbers.tolist(), reasons, strict=True):
                if why:
                    how.omit(number, why)
            good = [k for k, why in enumerate(reasons) if not why]
            if not good:
                continue
            light = light_of(experiment, [chunk_states[k] for k in good], chunk_numbers[good], how.single)
        observation = read(experiment, light, how)
        if observation is not None:
            yield observation


def light_of(
    experiment: MonitorExperiment,
    states: Sequence[State],
    numbers: np.ndarray,
    single: bool = True,
    photons: np.ndarray | None = None,
) -> Light:
    """Trace and render states together: return their expected photons and the cameras' true changes.

    Parameters
    ----------
    experiment : MonitorExperiment
        Experiment with the instrument.
    states : sequence of State
        S states.
    numbers : (S,) ndarray of int
        Numbers of the states.
    single : bool
        True to render in single precision.
    photons : (S, C, rows, columns) ndarray | None
        Expected photons for S states and C channels, if already rendered.

    Raises
    ------
    BeamMissedError, AimError
        Light is lost, or a spot is not on its CCD.
    """
    with one_blas_thread(), one_kernel_thread():
        placed = experiment.instrument.assembly.place(states)
        truth = experiment.sight.truth(states, placed)
        if photons is None and len(states) == 1:
            photons = experiment.path.photons_of(states[0], placed, single)[None]
        elif photons is None:
            photons = experiment.path.expected_photons(states, chunk=len(states), single=single)
    return Light(numbers, placed, truth, photons)


def why_lost(experiment: MonitorExperiment, state: State) -> str:
    """Return the reason why the light of a state does not reach the area CCDs; empty if it does."""
    try:
        light_of(experiment, [state], np.zeros(1, int))
    except LOST as error:
        return str(error)
    return ""


def read(experiment: MonitorExperiment, light: Light, how: ObservationOptions) -> Observation | None:
    """Expose the area CCDs to the light of states and recover the changes; None if no state can be measured.

    Parameters
    ----------
    experiment : MonitorExperiment
        Experiment with the instrument.
    light : Light
        Light of the states.
    how : ObservationOptions
        Options.

    Raises
    ------
    SpotError
        A spot cannot be measured.
    """
    before, after = how.record(light.photons, light.numbers)
    images, count = after, how.frames
    if in_file(after):
        # the mean that the recovery would take, computed in parts
        images, count = mean_of(after), after.shape[-3]
        before = mean_of(before) if isinstance(before, np.ndarray) else before
    channels = experiment.path.channels
    good, calibration = np.arange(len(after)), experiment.calibration
    prior, models = (experiment.disturbances, experiment.motion_models) if how.use_prior else (None, None)
    while len(good):
        whole = len(good) == len(after)
        first = before
        if isinstance(before, np.ndarray) and before.ndim == images.ndim and not whole:
            first = before[good]
        try:
            with one_blas_thread(), one_kernel_thread():
                threads, after_images = cores() if len(good) > 1 else 1, images if whole else images[good]
                options = calibration, how.centroid, threads, prior, how.keep_parts, models, count
                recovery = recover_monitor(first, after_images, *options)
            return Observation(light, good, after, recovery)
        except SpotError as error:
            if how.omit is None:
                raise
            lost: dict[int, str] = {}
            for index in error.indices:
                state, spot = divmod(index, len(channels))
                lost.setdefault(state, f"{channels[spot].key}: {error.reasons[index]}")
            for state, why in lost.items():
                how.omit(int(light.numbers[good[state]]), f"a spot cannot be measured ({why})")
            good = np.delete(good, list(lost))
    return None


def shared_detector(experiment: MonitorExperiment, frames: int, seed: int) -> Record:
    """Return a `Record` function that exposes all states with the same detectors.

    Changes are relative to one measurement of the nominal state.

    Parameters
    ----------
    experiment : MonitorExperiment
        Experiment with the instrument.
    frames : int
        Number of frames of each exposure.
    seed : int
        Seed of the detectors and all noise; each state has its own random stream.
    """
    before = experiment.frames_before(frames, seed)
    return lambda photons, numbers: (before, experiment.frames_after(photons, frames, seed, numbers))


class StateReader:
    """Observation of single states with an instrument that is built and calibrated once.

    Parameters
    ----------
    experiment
        Experiment with the instrument and its job's prior.
    frames
        Number of frames of each exposure.
    seed
        Seed of all noise.
    centroid
        Centroid method of the spots: ``ml`` (maximum likelihood), ``gaussian`` or ``energy``.
    """

    def __init__(self, experiment: MonitorExperiment, frames: int, seed: int, centroid: str = "ml") -> None:
        self.experiment, self.frames, self.seed, self.centroid = experiment, frames, seed, centroid

    @cached_property
    def before(self) -> np.ndarray:
        """Frames of the unperturbed instrument, uint16 (C, frames, rows, columns).

        Dimensions: C channels.
        """
        return self.experiment.frames_before(self.frames, self.seed)

    @cached_property
    def _before(self) -> MeasuredSpots:
        return judged_spots(mean_frames(self.before), self.frames, self.experiment.calibration, self.centroid)

    @cached_property
    def _clean_before(self) -> MeasuredSpots:
        clean = self.experiment.expected_frames(self.experiment.nominal_photons)
        return judged_spots(clean, self.frames, self.experiment.calibration, self.centroid)

    def read(self, state: State, noise: bool = True, number: int = 0, single: bool = False) -> Observation:
        """Trace and render one state, expose it, and recover the cameras' changes from its images.

        Parameters
        ----------
        state : State
            Body -> motion, as returned by ``MonitorExperiment.state``.
        noise : bool
            True to expose frames. False to measure the expected images, (1, C, rows, columns) for C channels; sigmas
            are those that the noise of the frames would cause.
        number : int
            Number of the state, which selects its random stream; in a time series, the number of the time.
        single : bool
            True to render in single precision, as for all times of a time series.

        Raises
        ------
        BeamMissedError, AimError
            Light is lost, or a spot is not on its CCD; the message says where.
        SpotError
            A spot cannot be measured.
        """
        experiment = self.experiment

        def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
            if not noise:
                return self._clean_before, experiment.expected_frames(photons)
            return self._before, experiment.frames_after(photons, self.frames, self.seed, numbers)

        how = ObservationOptions(record, self.centroid, single=single, frames=None if noise else self.frames)
        return next(observe(experiment, [state], how, [number]))
