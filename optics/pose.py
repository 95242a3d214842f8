"""A rigid pose: where a body's frame stands in its parent's frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optics.array_math import product, turned


def triple(vector: Any) -> tuple[float, float, float]:
    """A vector (3,) as plain numbers, for immutable values that are compared."""
    x, y, z = vector
    return (float(x), float(y), float(z))


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid transform x_parent = rotation @ x_body + translation.

    Attributes:
        rotation: shape (3, 3), proper orthogonal.
        translation: shape (3,), metres.
    """

    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Copy, freeze and check the arrays."""
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(f"a pose needs shapes (3, 3) and (3,), found {rotation.shape} and {translation.shape}")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12) or np.linalg.det(rotation) < 0:
            raise ValueError("a pose's rotation must be a proper orthogonal matrix")
        rotation.setflags(write=False)
        translation.setflags(write=False)
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    def __eq__(self, other: object) -> bool:
        """Equal when both arrays are bit-equal."""
        return (
            isinstance(other, Pose)
            and np.array_equal(self.rotation, other.rotation)
            and np.array_equal(self.translation, other.translation)
        )

    def __hash__(self) -> int:
        """Hash of the array bytes."""
        return hash((self.rotation.tobytes(), self.translation.tobytes()))

    def apply(self, points: Any) -> np.ndarray:
        """Map points (..., 3) from the body's frame to the parent's, metres."""
        return turned(self.rotation, np.asarray(points)) + self.translation

    def inverse(self) -> Pose:
        """The transform back from the parent's frame to the body's."""
        return Pose(self.rotation.T, -turned(self.rotation.T, self.translation))

    def __matmul__(self, other: Pose) -> Pose:
        """Compose: (a @ b).apply(x) == a.apply(b.apply(x))."""
        return Pose(product(self.rotation, other.rotation), self.apply(other.translation))
