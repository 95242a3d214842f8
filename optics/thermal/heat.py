"""Linear temperature fields on bodies, and the motions that a free body gives to what is mounted on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.geometry.pose import Pose, triple
from optics.numerics.array_math import inner, matvec


@dataclass(frozen=True)
class Temperature:
    """Change of temperature that is linear in position: ``change`` + ``gradient`` . r at r in the body's frame.

    Attributes
    ----------
    change : float
        Change at the body's origin, kelvin.
    gradient : tuple of float
        Gradient in the body's frame, K/m.
    """

    change: float = 0.0
    gradient: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __add__(self, other: Temperature) -> Temperature:
        x, y, z = (a + b for a, b in zip(self.gradient, other.gradient, strict=True))
        return Temperature(self.change + other.change, (x, y, z))

    def at(self, point: np.ndarray) -> float:
        """Return the change of temperature at a point (3,) of the body's frame (metres), in kelvin."""
        return float(self.change + inner(np.array(self.gradient), point))

    def seen_from(self, child: Pose) -> Temperature:
        """Return the same field in the frame of another body, whose pose in this body's frame is ``child``."""
        return Temperature(self.at(child.translation), triple(matvec(child.rotation.T, np.array(self.gradient))))


@dataclass(frozen=True, eq=False)
class Temperatures:
    """Changes of temperature of one body in S states, each linear in position.

    Attributes
    ----------
    change : (S,) ndarray
        Change at the body's origin, kelvin.
    gradient : (S, 3) ndarray
        Gradient in the body's frame, K/m.
    """

    change: np.ndarray
    gradient: np.ndarray

    @classmethod
    def of(cls, fields: Sequence[Temperature]) -> Temperatures:
        """Combine the temperature fields of S states, one for each, into one object."""
        return cls(np.array([f.change for f in fields]), np.array([f.gradient for f in fields]).reshape(-1, 3))

    def __add__(self, other: Temperatures) -> Temperatures:
        return Temperatures(self.change + other.change, self.gradient + other.gradient)

    def __getitem__(self, states: np.ndarray) -> Temperatures:
        """Return the temperature fields of some of the states, given by their indices."""
        return Temperatures(self.change[states], self.gradient[states])

    def at(self, point: np.ndarray) -> np.ndarray:
        """Return the change of temperature at a point (3,) of the body's frame in each of S states, (S,), kelvin."""
        return np.asarray(self.change + inner(self.gradient, point))

    def seen_from(self, child: Pose) -> Temperatures:
        """Return the same fields in the frame of another body, whose pose in this body's frame is ``child``."""
        return Temperatures(self.at(child.translation), matvec(child.rotation.T, self.gradient))


def carried_motion(expansion: float, gradient: np.ndarray, arm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation vectors and shifts that a temperature gradient in a body gives to a part mounted on it.

    With q the part's position from the fixed point, g the gradient, a the expansion and T the uniform change, the
    displacement without stress is u = a ((g . q) q - q^2 g / 2), and its rotation a (g x q); see
    ``optics.thermal.thermo_elastic.free_linear_field``. The uniform part of the displacement, a T q, is the body's
    ``Motion.expansion``.

    Parameters
    ----------
    expansion : float
        Thermal expansion a, 1/K.
    gradient : (..., 3) ndarray
        Gradient g in the body's frame, K/m.
    arm : (..., 3) ndarray
        Position q relative to the fixed point, in the body's frame, metres.

    Returns
    -------
    rotation : (..., 3) ndarray
        Rotation vectors, radians.
    shift : (..., 3) ndarray
        Displacements, metres.
    """
    g, q = np.asarray(gradient, np.float64), np.asarray(arm, np.float64)
    rotation = np.empty(np.broadcast_shapes(g.shape, q.shape))
    for c, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
        rotation[..., c] = g[..., a] * q[..., b] - g[..., b] * q[..., a]
    along, square = inner(g, q)[..., None], inner(q, q)[..., None]
    return expansion * rotation, expansion * (along * q - 0.5 * square * g)
