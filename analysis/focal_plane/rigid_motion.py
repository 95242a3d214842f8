"""Rigid motion of a focal-plane assembly about the origin O' of its own frame O'-X'Y'Z' (paper 004, section 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

__all__ = ["RigidMotion"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """Rotation about O' and then a shift, both in the frame from before the motion.

    rotation: (3,) rotation vector, radians, right-handed. shift: (3,) metres.
    covariance: (6, 6) of rotation and shift together, rad and m; zero when nothing is known of it.
    """

    rotation: Array
    shift: Array
    covariance: Array

    @classmethod
    def of(cls, rotation: ArrayLike, shift: ArrayLike, covariance: ArrayLike | None = None) -> RigidMotion:
        """The motion, with its input checked. Raises ValueError for wrong shapes or numbers that are not finite."""
        turn, move = np.asarray(rotation, np.float64), np.asarray(shift, np.float64)
        spread = np.zeros((6, 6)) if covariance is None else np.asarray(covariance, np.float64)
        if turn.shape != (3,) or move.shape != (3,) or spread.shape != (6, 6):
            raise ValueError(
                "rigid motion: rotation and shift must be (3,), covariance (6, 6), found"
                f" {turn.shape}, {move.shape}, {spread.shape}"
            )
        if not (np.all(np.isfinite(turn)) and np.all(np.isfinite(move)) and np.all(np.isfinite(spread))):
            raise ValueError("rigid motion: rotation, shift and covariance must be finite")
        return cls(turn, move, spread)

    @property
    def matrix(self) -> Array:
        """(3, 3) rotation matrix."""
        return np.asarray(Rotation.from_rotvec(self.rotation).as_matrix())

    @property
    def line_turn(self) -> float:
        """Angle, radians, by which the projection of the line CCD (the Y' axis) turns in the X'Y' plane, about +Z'."""
        line = self.matrix[:, 1]
        return float(np.arctan2(-line[0], line[1]))

    def moved(self, point: ArrayLike) -> Array:
        """Points (..., 3), metres, after the motion."""
        return np.asarray(np.asarray(point, np.float64) @ self.matrix.T + self.shift)

    def displacement(self, point: ArrayLike) -> Array:
        """How far points (..., 3) go, metres."""
        return self.moved(point) - np.asarray(point, np.float64)
