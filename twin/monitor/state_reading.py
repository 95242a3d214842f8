"""One state of an instrument at a time, without what does not change from state to state: for programs that answer a
hand.

The numbers are those of ``python -m twin.render`` for the same state, frames and seed, to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from analysis.monitor.recovery import Recovery, judged_spots, recovery_of
from analysis.monitor.spot_evidence import SpotEvidence
from analysis.spots.centroid import mean_frames
from analysis.spots.fit_state import FitStates
from analysis.spots.spot_positions import SpotPositions, difference_covariance
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.threads import one_blas_thread
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import Truth

__all__ = ["StateReader", "StateReading"]


@dataclass(frozen=True, eq=False)
class StateReading:
    """What one state does and what its images say.

    Attributes:
        placed: bodies of this one state.
        truth: of it.
        photons: expected photons per pixel and frame, (C, rows, columns).
        frames: uint16 (C, frames, rows, columns); None without noise.
        recovery: of this one state; without noise its sigmas are those that the noise of the frames would give.
    """

    placed: PlacedBodies
    truth: Truth
    photons: np.ndarray
    frames: np.ndarray | None
    recovery: Recovery


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
    def _spots_before(self) -> tuple[SpotPositions, FitStates]:
        return self._spots(mean_frames(self.before))

    @cached_property
    def _clean_before(self) -> tuple[SpotPositions, FitStates]:
        return self._spots(self.experiment.expected_frames(self.experiment.nominal_photons))

    def read(self, state: State, noise: bool = True, number: int = 0, single: bool = False) -> StateReading:
        """Trace, render and recover a state.

        Args:
            state: body -> motion, as of ``MonitorExperiment.state``.
            noise: expose frames; else the expected images are measured.
            number: of the state, each of which has a random stream of its own; of a course that of the time.
            single: render in single precision, as all times of a course are.

        Raises:
            BeamMissedError, AimError: light is lost on its way, or a spot is not on its CCD; where, is in the message.
            SpotError: a spot cannot be measured.
        """
        experiment = self.experiment
        with one_blas_thread():
            placed = experiment.instrument.assembly.place([state])
            truth = experiment.sight.truth([state], placed)
            photons = experiment.path.photons_of(state, placed, single)[None]
            frames = experiment.frames_after(photons, self.frames, self.seed, number)[0] if noise else None
            mean = experiment.expected_frames(photons[0]) if frames is None else mean_frames(frames)
            first, fits = self._clean_before if frames is None else self._spots_before
            second, more = self._spots(mean)
            calibration, stated = experiment.calibration, experiment.disturbances
            spread = difference_covariance(first, second, calibration.noise)
            evidence = SpotEvidence(fits, more)
            again = experiment.motion_models
            recovery = recovery_of(first, second, spread, calibration, stated, evidence=evidence, motions=again)
        return StateReading(placed, truth, photons[0], frames, recovery)

    def _spots(self, mean: np.ndarray) -> tuple[SpotPositions, FitStates]:
        """Of mean frames or expected images (C, rows, columns), grey values."""
        return judged_spots(mean, self.frames, self.experiment.calibration, self.centroid)
