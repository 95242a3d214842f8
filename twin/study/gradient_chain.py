"""From traced spots and lines of sight to the numbers of a run, without images and noise; and its derivative."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from analysis.recovery import Recovery, angles, estimates
from optics.tree import State
from scenes.resolved import ResolvedJob
from twin.experiment import MonitorExperiment
from twin.study.monitor_results import monitor_results
from twin.truth import trace_sight, truth_of_sight

SPOT_REACH, SIGHT_REACH = 1.0, 1e-4
"""Steps of the derivative of the formulas, px and 1: so small that what is left of them after Richardson's
extrapolation, to the fifth power, is below rounding, and so large that rounding is below 1e-11."""


@dataclass(frozen=True, eq=False)
class Chain:
    """One instrument and the formulas that its job applies to what is traced.

    Spots are means of rays, which are the energy centroids of the images.

    Attributes:
        resolved: the job.
        experiment: its instrument.
    """

    resolved: ResolvedJob
    experiment: MonitorExperiment

    def spots(self, states: Sequence[State]) -> np.ndarray:
        """Positions (S, C, 2), row and column, px from the first pixel's centre. Raises AimError, BeamMissedError."""
        path = self.experiment.path.coarse
        mean = np.einsum("n,bnk->bk", path.nodes.share, path.rays(states).position[..., 1::-1]) / path.pitch
        middle = 0.5 * (np.array(path.shape) - 1.0)
        return np.swapaxes(mean.reshape(len(path.channels), len(states), 2), 0, 1) + middle

    def sight(self, states: Sequence[State]) -> np.ndarray:
        """Directions of the line CCDs' points, (S, cameras, points, 3). Raises AimError, BeamMissedError."""
        return np.swapaxes(trace_sight(self.experiment.instrument, self.experiment.backend, states), 0, 1)

    @cached_property
    def nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Spots and directions of the unperturbed instrument, (1, ...)."""
        return self.spots([{}]), self.sight([{}])

    @cached_property
    def _axes(self) -> dict[str, np.ndarray]:
        return {name: self.experiment.instrument.camera_axes(name) for name in self.experiment.instrument.cameras}

    def outcome(self, state: State, spots: np.ndarray, sight: np.ndarray) -> dict[str, Any]:
        """``truth`` and ``recovered`` of one state with spots (C, 2) and directions (cameras, points, 3)."""
        start, end = self.nominal[0], spots[None]
        cameras = self.experiment.cameras
        joint = np.zeros((1, len(cameras), 4, 4))
        parameters = estimates(start, end, joint, cameras)
        none = np.zeros_like(end)
        recovery = Recovery(start, end, none, none, joint, parameters, angles(parameters, cameras))
        truth = truth_of_sight(self.experiment.instrument, np.stack([self.nominal[1][0], sight], axis=1), self._axes)
        exposures = self.resolved.frames, self.resolved.job.render.seed
        return monitor_results(self.resolved, self.experiment, state, *exposures, truth, recovery)

    def moved(
        self, state: State, at: tuple[np.ndarray, np.ndarray], spots: np.ndarray, sight: np.ndarray
    ) -> tuple[list[dict[str, Any]], float]:
        """Four outcomes about a state along derivatives of its spots (C, 2) and directions (cameras, points, 3), for
        ``extrapolated``, and the step; ``at``: the state's own spots and directions.
        """
        largest = max(np.abs(spots).max() / SPOT_REACH, np.abs(sight).max() / SIGHT_REACH)
        step = 1.0 / float(largest) if largest > 0.0 else 1.0
        place, line = at
        return [
            self.outcome(state, place + share * step * spots, line + share * step * sight) for share in SHARES
        ], step


SHARES = (1.0, -1.0, 0.5, -0.5)
"""Of a step: where values for ``extrapolated`` are taken."""


def extrapolated(values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Central differences with a step and its half, extrapolated after Richardson, and how far that went.

    Args:
        values: (4, ...) at the base plus ``SHARES`` times the step.
        step: of the whole step.
    """
    wide, narrow = (values[0] - values[1]) / (2.0 * step), (values[2] - values[3]) / step
    return narrow + (narrow - wide) / 3.0, np.abs(narrow - wide) / 3.0
