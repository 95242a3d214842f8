"""One observation: states of an instrument are traced, rendered, exposed and recovered.

Whatever asks for images of states takes this way: the main job, courses, studies, the live twin, error budgets, random
states. What differs from use to use is said by an `Observing`.
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
from analysis.spots.spot_positions import SpotError
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.backend import cores, one_blas_thread, one_kernel_thread
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from twin.framework.frame_store import in_file, mean_of
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import Truth

LOST = (AimError, BeamMissedError)
"""What says that the light of a state is lost."""

Record: TypeAlias = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray | MeasuredSpots, np.ndarray]]
"""Exposes the detectors, by random streams of its own. From expected photons (S, C, rows, columns) and numbers (S,) of
states to what is recorded before, (C, frames, rows, columns) for all states or (S, C, frames, rows, columns), or spots
before that are measured already; and after, (S, C, frames, rows, columns).
"""


@dataclass(frozen=True)
class Observing:
    """How states are observed.

    Attributes
    ----------
    record : Record
        Exposes the detectors.
    centroid : str
        As of ``analysis.monitor.recovery.recover_monitor``.
    chunk : int
        States that are done at once; the last digits of a state depend on which they are.
    single : bool
        Render in single precision.
    leave : Callable[[int, str], None] | None
        Told of each state that is lost, by its number, and why: its light does not arrive, or a spot cannot be
        measured. It is then left out; with None the error is raised.
    stated : bool
        Know what the experiment states to move, and trace its motions again; else there is noise alone.
    keep_parts : bool
        Of the noise, which are large.
    frames : int | None
        Of which each recorded image is the mean; None where frames are recorded one by one.
    """

    record: Record
    centroid: str = "ml"
    chunk: int = 40
    single: bool = True
    leave: Callable[[int, str], None] | None = None
    stated: bool = True
    keep_parts: bool = False
    frames: int | None = None


@shows()
@dataclass(frozen=True, eq=False)
class Light:
    """What comes of S states to the area CCDs.

    Attributes
    ----------
    numbers : np.ndarray
        (S,) of the states.
    placed : PlacedBodies
        Their bodies.
    truth : Truth
        Of them.
    photons : np.ndarray
        Expected photons per pixel and frame, (S, C, rows, columns).
    """

    numbers: np.ndarray
    placed: PlacedBodies
    truth: Truth
    photons: np.ndarray


@shows()
@dataclass(frozen=True, eq=False)
class Observation:
    """What S states do and what their images say.

    Attributes
    ----------
    light : Light
        Of all states that were recorded.
    measured : np.ndarray
        (S,) which of these could be measured.
    after : np.ndarray
        What was recorded of all of ``light``, as of `Record`.
    recovery : Recovery
        Of those that were measured.
    """

    light: Light
    measured: np.ndarray
    after: np.ndarray
    recovery: Recovery

    @property
    def numbers(self) -> np.ndarray:
        """(S,) of the states that were measured."""
        return self.light.numbers[self.measured]

    @property
    def truth(self) -> Truth:
        """Truth of the states that were measured."""
        return self.light.truth.at(self.measured)


def observe(
    experiment: MonitorExperiment,
    states: Sequence[State],
    how: Observing,
    numbers: Sequence[int] | np.ndarray | None = None,
) -> Iterator[Observation]:
    """Trace, render, expose and recover states, piece by piece.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    states : Sequence[State]
        To be observed.
    how : Observing
        The policies.
    numbers : Sequence[int] | np.ndarray | None
        Of the states, by which random streams are chosen; None to count from 0.

    Yields
    ------
    Observation
        Observations of ``how.chunk`` states, without those that are left out; none of a piece that is lost as a whole.

    Raises
    ------
    BeamMissedError, AimError
        Light is lost on its way, or a spot is not on its CCD.
    SpotError
        a spot cannot be measured.
    """
    every = np.arange(len(states)) if numbers is None else np.asarray(numbers)
    for first in range(0, len(states), how.chunk):
        some, own = states[first : first + how.chunk], every[first : first + how.chunk]
        try:
            light = light_of(experiment, some, own, how.single)
        except LOST:
            if how.leave is None:
                raise
            reasons = [why_lost(experiment, state) for state in some]
            for number, why in zip(own.tolist(), reasons, strict=True):
                if why:
                    how.leave(number, why)
            good = [k for k, why in enumerate(reasons) if not why]
            if not good:
                continue
            light = light_of(experiment, [some[k] for k in good], own[good], how.single)
        found = read(experiment, light, how)
        if found is not None:
            yield found


def light_of(
    experiment: MonitorExperiment,
    states: Sequence[State],
    numbers: np.ndarray,
    single: bool = True,
    photons: np.ndarray | None = None,
) -> Light:
    """Trace and render states together.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    states : Sequence[State]
        S states.
    numbers : np.ndarray
        (S,) of these.
    single : bool
        Render in single precision.
    photons : np.ndarray | None
        (S, C, rows, columns) of the states, where they are rendered already.

    Raises
    ------
    BeamMissedError, AimError
        Light is lost on its way, or a spot is not on its CCD.
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
    """Where the light of a state is lost; empty where it is not."""
    try:
        light_of(experiment, [state], np.zeros(1, int))
    except LOST as error:
        return str(error)
    return ""


def read(experiment: MonitorExperiment, light: Light, how: Observing) -> Observation | None:
    """Expose and recover states; None where all are left out since their spots cannot be measured.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    light : Light
        Of the states.
    how : Observing
        The policies.

    Raises
    ------
    SpotError
        a spot cannot be measured.
    """
    before, after = how.record(light.photons, light.numbers)
    images, count = after, how.frames
    if in_file(after):
        # what recover would do with the frames, a part of them at a time
        images, count = mean_of(after), after.shape[-3]
        before = mean_of(before) if isinstance(before, np.ndarray) else before
    channels = experiment.path.channels
    good = np.arange(len(after))
    while len(good):
        whole = len(good) == len(after)
        first = before
        if isinstance(before, np.ndarray) and before.ndim == images.ndim and not whole:
            first = before[good]
        try:
            with one_blas_thread(), one_kernel_thread():
                recovery = recover_monitor(
                    first,
                    images if whole else images[good],
                    experiment.calibration,
                    how.centroid,
                    cores() if len(good) > 1 else 1,
                    experiment.disturbances if how.stated else None,
                    how.keep_parts,
                    experiment.motion_models if how.stated else None,
                    count,
                )
            return Observation(light, good, after, recovery)
        except SpotError as error:
            if how.leave is None:
                raise
            lost: dict[int, str] = {}
            for index in error.indices:
                state, spot = divmod(index, len(channels))
                lost.setdefault(state, f"{channels[spot].key}: {error.reasons[index]}")
            for state, why in lost.items():
                how.leave(int(light.numbers[good[state]]), f"a spot cannot be measured ({why})")
            good = np.delete(good, list(lost))
    return None


def one_detector(experiment: MonitorExperiment, frames: int, seed: int, stray: np.ndarray | float = 0.0) -> Record:
    """Every state is exposed by the same detectors, against one nominal measurement.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    frames : int
        Of each exposure.
    seed : int
        Of the detectors and of all noise; each state has a stream of its own.
    stray : np.ndarray | float
        Photons beside those of the nominal spots.
    """
    before = experiment.frames_before(frames, seed, stray)
    return lambda photons, numbers: (before, experiment.frames_after(photons, frames, seed, numbers))


class StateReader:
    """Reads states of an instrument that is built and calibrated once.

    Parameters
    ----------
    experiment
        The instrument, with its job's stated disturbances.
    frames
        Of each exposure.
    seed
        Of all noise.
    centroid
        As of ``analysis.monitor.recovery.recover_monitor``.
    """

    def __init__(self, experiment: MonitorExperiment, frames: int, seed: int, centroid: str = "ml") -> None:
        self.experiment, self.frames, self.seed, self.centroid = experiment, frames, seed, centroid

    @cached_property
    def before(self) -> np.ndarray:
        """Frames of the unperturbed instrument, uint16 (C, frames, rows, columns)."""
        return self.experiment.frames_before(self.frames, self.seed)

    @cached_property
    def _before(self) -> MeasuredSpots:
        return judged_spots(mean_frames(self.before), self.frames, self.experiment.calibration, self.centroid)

    @cached_property
    def _clean_before(self) -> MeasuredSpots:
        clean = self.experiment.expected_frames(self.experiment.nominal_photons)
        return judged_spots(clean, self.frames, self.experiment.calibration, self.centroid)

    def read(self, state: State, noise: bool = True, number: int = 0, single: bool = False) -> Observation:
        """Trace, render and recover a state.

        Parameters
        ----------
        state : State
            Body -> motion, as of ``MonitorExperiment.state``.
        noise : bool
            Expose frames; else the expected images, (1, C, rows, columns), are measured, and sigmas are those that the
            noise of the frames would give.
        number : int
            Of the state, each of which has a random stream of its own; of a course that of the time.
        single : bool
            Render in single precision, as all times of a course are.

        Raises
        ------
        BeamMissedError, AimError
            Light is lost on its way, or a spot is not on its CCD; where, is in the message.
        SpotError
            a spot cannot be measured.
        """
        experiment = self.experiment

        def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
            if not noise:
                return self._clean_before, experiment.expected_frames(photons)
            return self._before, experiment.frames_after(photons, self.frames, self.seed, numbers)

        how = Observing(record, self.centroid, single=single, frames=None if noise else self.frames)
        return next(observe(experiment, [state], how, [number]))
