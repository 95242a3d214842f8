"""Linear temperature fields on bodies, and how a free body of one material carries what is mounted on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.geometry.pose import Pose, triple
from optics.numerics.array_math import inner


@dataclass(frozen=True)
class Temperature:
    """A change of temperature in a body's frame: change + gradient . r.

    Attributes:
        change: at the body's origin, kelvin.
        gradient: in the body's frame, K/m.
    """

    change: float = 0.0
    gradient: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __add__(self, other: Temperature) -> Temperature:
        x, y, z = (a + b for a, b in zip(self.gradient, other.gradient, strict=True))
        return Temperature(self.change + other.change, (x, y, z))

    def at(self, point: np.ndarray) -> float:
        """Change at a point (3,) of the body's frame, kelvin."""
        return float(self.change + np.dot(self.gradient, point))

    def seen_from(self, child: Pose) -> Temperature:
        """Tell the field in the frame of a body that stands at ``child`` in this one's frame."""
        return Temperature(self.at(child.translation), triple(child.rotation.T @ np.array(self.gradient)))


def carried_motion(expansion: float, gradient: np.ndarray, arm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors and shifts, (..., 3) each, that a gradient gives to what stands at ``arm`` from the fixed point.

    The stress-free displacement of a linear field, u = a ((g . q) q - q^2 g / 2), and its rotation a (g x q); see
    ``optics.thermal.thermo_elastic.free_linear_field``. The uniform part, a dT q, is the body's ``Motion.stretch``.

    Args:
        expansion: a, 1/K.
        gradient: g, K/m, in the body's frame, (3,).
        arm: q, metres, likewise, (..., 3).
    """
    g, q = np.asarray(gradient, np.float64), np.asarray(arm, np.float64)
    turn = np.stack([g[a] * q[..., b] - g[b] * q[..., a] for a, b in ((1, 2), (2, 0), (0, 1))], axis=-1)
    along, square = inner(g, q)[..., None], inner(q, q)[..., None]
    return expansion * turn, expansion * (along * q - 0.5 * square * g)
