"""Adjustments of a camera: the moves of its compensators that make the wavefront error least, and how they are made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Adjustments:
    """Compensators and what they do to the residuals of the wavefront.

    Attributes:
        ranges: SI, (C,); zero leaves a compensator where it is.
        steps: of which they are moved by whole numbers, SI, 0 for any amount, (C,).
        accuracies: standard deviations of their moves, SI, (C,).
        slope: derivatives of the residuals, (R, C), waves per SI unit; 0 where the range is zero.
    """

    ranges: np.ndarray
    steps: np.ndarray
    accuracies: np.ndarray
    slope: np.ndarray

    def best(self, residuals: np.ndarray, moves: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Amounts (S, C) that make linearised residuals (S, R) least, within ranges; others than those that are free
        (C,) stay.
        """
        size = np.where(self.ranges > 0.0, self.ranges, 1.0)
        slope = self.slope * size
        normal = slope.T @ slope
        normal = normal + 1e-12 * np.trace(normal) * np.eye(len(size))
        pull = -residuals @ slope
        start = moves / size
        held = np.broadcast_to(~free | (self.ranges == 0.0), start.shape).copy()
        target = start.copy()
        for _ in range(len(size) + 1):
            # of those that are held the change is known, and the others follow it
            known = np.where(held, target - start, 0.0)
            rest = np.where(held, 0.0, pull - known @ normal)
            mask = ~held
            matrix = normal * mask[:, :, None] * mask[:, None, :] + np.eye(len(size)) * held[:, :, None]
            change = known + np.linalg.solve(matrix, rest[..., None])[..., 0] * mask
            target = np.clip(start + change, -1.0, 1.0)
            beyond = mask & (np.abs(start + change) > 1.0)
            if not beyond.any():
                break
            held |= beyond
        return np.asarray(target * size)

    @property
    def exact(self) -> bool:
        """Whether moves are made as they are wanted, without steps and errors."""
        return not np.any((self.steps > 0.0) | (self.accuracies > 0.0))

    def made(self, residuals: np.ndarray, moves: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Moves as they are made: by whole steps and with errors, one after the other.

        Args:
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
            residuals = residuals + (made - wanted) @ self.slope.T
            wanted = self.best(residuals, made, free)
            residuals = residuals + (wanted - made) @ self.slope.T
        return wanted
