"""Adjustments of a camera: the moves of its compensators that make the wavefront error least, and how they are made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def told(slopes: np.ndarray, change: np.ndarray) -> np.ndarray:
    """What slopes (S, R, C) tell of a change of the moves (S, C): of the residuals, (S, R)."""
    return np.asarray((slopes @ change[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class Adjustments:
    """Compensators and what they do to the residuals of the wavefront.

    Attributes:
        ranges: SI, (C,); zero leaves a compensator where it is.
        steps: of which they are moved by whole numbers, SI, 0 for any amount, (C,).
        accuracies: standard deviations of their moves, SI, (C,).
        slope: derivatives of the designed camera's residuals, (R, C), waves per SI unit; 0 where the range is zero.
    """

    ranges: np.ndarray
    steps: np.ndarray
    accuracies: np.ndarray
    slope: np.ndarray

    def best(self, slopes: np.ndarray, residuals: np.ndarray, moves: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Amounts that make linearised residuals least, within ranges.

        Args:
            slopes: of the residuals of each camera, (S, R, C).
            residuals: where the moves are, (S, R).
            moves: SI, (S, C).
            free: compensators that move, (C,); the others stay.

        Returns:
            SI, (S, C).
        """
        size = np.where(self.ranges > 0.0, self.ranges, 1.0)
        slope = slopes * size
        across = np.swapaxes(slope, -1, -2)
        normal = across @ slope
        normal = normal + 1e-12 * np.trace(normal, axis1=-2, axis2=-1)[:, None, None] * np.eye(len(size))
        pull = -(across @ residuals[..., None])[..., 0]
        start = moves / size
        held = np.broadcast_to(~free | (self.ranges == 0.0), start.shape).copy()
        target = start.copy()
        for _ in range(len(size) + 1):
            # of those that are held the change is known, and the others follow it
            known = np.where(held, target - start, 0.0)
            rest = np.where(held, 0.0, pull - (normal @ known[..., None])[..., 0])
            mask = ~held
            matrix = normal * mask[:, :, None] * mask[:, None, :] + np.eye(len(size)) * held[:, :, None]
            change = known + np.linalg.solve(matrix, rest[..., None])[..., 0] * mask
            target = np.clip(start + change, -1.0, 1.0)
            beyond = mask & (np.abs(start + change) > 1.0)
            if not beyond.any():
                break
            held |= beyond
        return np.asarray(target * size)

    def corrected(self, slopes: np.ndarray, change: np.ndarray, miss: np.ndarray) -> np.ndarray:
        """Slopes (S, R, C) that have what a step came to (Broyden's rank-one update); of a camera that stays, as it is.

        Args:
            slopes: before, (S, R, C).
            change: of the moves, SI, (S, C).
            miss: residuals after the step less what the slopes told of them, (S, R).
        """
        size = np.where(self.ranges > 0.0, self.ranges, 1.0)
        step = change / size
        norm = np.sum(step**2, axis=-1)
        way = step / np.where(norm > 0.0, norm, 1.0)[:, None] / size
        return np.asarray(slopes + miss[..., None] * way[:, None])

    @property
    def exact(self) -> bool:
        """Whether moves are made as they are wanted, without steps and errors."""
        return not np.any((self.steps > 0.0) | (self.accuracies > 0.0))

    def made(self, slopes: np.ndarray, residuals: np.ndarray, moves: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Moves as they are made: by whole steps and with errors, one after the other.

        Args:
            slopes: of the residuals, (S, R, C).
            residuals: where ``moves`` are, (S, R).
            moves: that are wanted, SI, (S, C).
            errors: in standard deviations, (S, C).
        """
        free = np.ones(len(self.ranges), dtype=bool)
        wanted, made = moves.copy(), moves.copy()
        for c, (step, accuracy) in enumerate(zip(self.steps, self.accuracies, strict=True)):
            if self.ranges[c] == 0.0:
                continue
            own = wanted[:, c]
            own = np.round(own / step) * step if step else own
            made = wanted.copy()
            made[:, c] = own + accuracy * errors[:, c]
            free[c] = False
            residuals = residuals + told(slopes, made - wanted)
            wanted = self.best(slopes, residuals, made, free)
            residuals = residuals + told(slopes, wanted - made)
        return wanted
