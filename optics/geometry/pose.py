"""Rotation vectors and rigid transforms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optics.numerics.array_math import matvec, product

_SERIES_LIMIT = 0.25  # |angle|^2 below which the power series is exact to rounding with the terms used
_SERIES_TERMS = 12


def rotation_matrix(vector: Any) -> np.ndarray:
    """Return the matrix of a rotation vector (right-hand rule), by Rodrigues' formula.

    Parameters
    ----------
    vector : (..., 3) array_like
        Rotation vectors, radians. Complex input is differentiated analytically, so that a complex step gives exact
        derivatives (no conjugate or modulus is taken).

    Returns
    -------
    (..., 3, 3) ndarray
        Rotation matrices.
    """
    v = np.asarray(vector)
    v = v.astype(np.result_type(v.dtype, np.float64))
    square = np.sum(v * v, axis=-1)
    sine_ratio, cosine_ratio = _ratios(square)
    zero = np.zeros_like(v[..., 0])
    cross = np.stack(
        [zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero], axis=-1
    ).reshape(*v.shape[:-1], 3, 3)
    outer = v[..., :, None] * v[..., None, :]
    eye = np.eye(3)
    cosine = 1.0 - cosine_ratio * square
    return cosine[..., None, None] * eye + sine_ratio[..., None, None] * cross + cosine_ratio[..., None, None] * outer


def _ratios(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sin(a)/a and (1 - cos a)/a^2 for a rotation angle a (radians) from its square; smooth at a = 0."""
    sine = np.zeros_like(square)
    cosine = np.zeros_like(square)
    for n in range(_SERIES_TERMS, 0, -1):
        sine = 1.0 - square / ((2 * n) * (2 * n + 1)) * (sine if n < _SERIES_TERMS else 1.0)
        cosine = 1.0 - square / ((2 * n + 1) * (2 * n + 2)) * (cosine if n < _SERIES_TERMS else 1.0)
    cosine = 0.5 * cosine
    large = np.abs(square) > _SERIES_LIMIT
    if np.any(large):
        angle = np.sqrt(np.where(large, square, 1.0))
        sine = np.where(large, np.sin(angle) / angle, sine)
        cosine = np.where(large, (1.0 - np.cos(angle)) / angle**2, cosine)
    return sine, cosine


def rotation_vector(matrix: Any) -> np.ndarray:
    """Return the rotation vectors (..., 3), radians, of rotation matrices (..., 3, 3); the angle is below pi."""
    m = np.asarray(matrix, dtype=np.float64)
    axis = 0.5 * np.stack(
        [m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], axis=-1
    )
    sine = np.linalg.norm(axis, axis=-1)
    cosine = 0.5 * (np.trace(m, axis1=-2, axis2=-1) - 1.0)
    angle = np.arctan2(sine, cosine)
    scale = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 1.0)
    return axis * scale[..., None]


def about_axis(axis: int, angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) for an angle in radians about coordinate axis 0, 1 or 2 (right-hand rule)."""
    vector = np.zeros(3)
    vector[axis] = angle
    return rotation_matrix(vector)


def triple(vector: Any) -> tuple[float, float, float]:
    """Return a vector (3,) as a tuple of floats, for immutable values that are compared."""
    x, y, z = vector
    return (float(x), float(y), float(z))


_UNIT = np.eye(3)
_ORTHOGONALITY_TOLERANCE = 1e-12 + 1e-5 * _UNIT
"""Largest allowed difference (3, 3) of a rotation matrix times its transpose from the unit matrix.

Axes must be perpendicular to rounding; their lengths may have the error of a matrix that a file gives in a few digits.
"""


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid transform x_parent = rotation @ x_body + translation.

    Attributes
    ----------
    rotation : (3, 3) ndarray
        Proper orthogonal matrix.
    translation : (3,) ndarray
        Origin of the body in the parent's frame, metres.
    """

    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Copy, freeze and check the arrays."""
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(f"a pose needs shapes (3, 3) and (3,), found {rotation.shape} and {translation.shape}")
        if not np.all(np.abs(rotation @ rotation.T - _UNIT) <= _ORTHOGONALITY_TOLERANCE) or np.linalg.det(rotation) < 0:
            raise ValueError("a pose's rotation must be a proper orthogonal matrix")
        rotation.setflags(write=False)
        translation.setflags(write=False)
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    def __eq__(self, other: object) -> bool:
        """Return True when both arrays are bit-equal."""
        return self is other or (
            isinstance(other, Pose)
            and self.rotation.tobytes() == other.rotation.tobytes()
            and self.translation.tobytes() == other.translation.tobytes()
        )

    def __hash__(self) -> int:
        """Return the hash of the array bytes."""
        return hash((self.rotation.tobytes(), self.translation.tobytes()))

    def apply(self, points: Any) -> np.ndarray:
        """Map points (..., 3) from the body's frame to the parent's, metres."""
        return matvec(self.rotation, np.asarray(points)) + self.translation

    def inverse(self) -> Pose:
        """Return the inverse transform, from the parent's frame to the body's."""
        return Pose(self.rotation.T, -matvec(self.rotation.T, self.translation))

    def __matmul__(self, other: Pose) -> Pose:
        """Compose: (a @ b).apply(x) == a.apply(b.apply(x))."""
        return Pose(product(self.rotation, other.rotation), self.apply(other.translation))
