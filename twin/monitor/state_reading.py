"""One state of an instrument at a time, without what does not change from state to state: for programs that answer a
hand.

The numbers are those of ``python -m twin.render`` for the same state, frames and seed, to the bit.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from analysis.monitor.recovery import MeasuredSpots, judged_spots
from analysis.spots.centroid import mean_frames
from optics.geometry.tree import State
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import Observation, Observing, observe


class StateReader:
    """Reads states of an instrument that is built and calibrated once.

    Args:
        experiment: the instrument, with its job's stated disturbances.
        frames: of each exposure.
        seed: of all noise.
        centroid: as of ``analysis.monitor.recovery.recover``.
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

        Args:
            state: body -> motion, as of ``MonitorExperiment.state``.
            noise: expose frames; else the expected images, (1, C, rows, columns), are measured, and sigmas are those
                that the noise of the frames would give.
            number: of the state, each of which has a random stream of its own; of a course that of the time.
            single: render in single precision, as all times of a course are.

        Raises:
            BeamMissedError, AimError: light is lost on its way, or a spot is not on its CCD; where, is in the message.
            SpotError: a spot cannot be measured.
        """
        experiment = self.experiment

        def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
            if not noise:
                return self._clean_before, experiment.expected_frames(photons)
            return self._before, experiment.frames_after(photons, self.frames, self.seed, numbers)

        how = Observing(record, self.centroid, single=single, frames=None if noise else self.frames)
        return next(observe(experiment, [state], how, [number]))
