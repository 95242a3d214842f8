"""Linear temperature fields on bodies, and how a free body of one material carries what is mounted on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.geometry.pose import Pose, triple
from optics.numerics.array_math import inner, turned


@dataclass(frozen=True)
class Temperature:
    """A change of temperature in a body's frame: change + gradient . r.

    Attributes
    ----------
    change : float
        At the body's origin, kelvin.
    gradient : tuple[float, float, float]
        In the body's frame, K/m.
    """

    change: float = 0.0
    gradient: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __add__(self, other: Temperature) -> Temperature:
        x, y, z = (a + b for a, b in zip(self.gradient, other.gradient, strict=True))
        return Temperature(self.change + other.change, (x, y, z))

    def at(self, point: np.ndarray) -> float:
        """Change at a point (3,) of the body's frame, kelvin."""
        return float(self.change + inner(np.array(self.gradient), point))

    def seen_from(self, child: Pose) -> Temperature:
        """Tell the field in the frame of a body that stands at ``child`` in this one's frame."""
        return Temperature(self.at(child.translation), triple(turned(child.rotation.T, np.array(self.gradient))))


@dataclass(frozen=True, eq=False)
class Temperatures:
    """Changes of temperature of one body in S states.

    Attributes
    ----------
    change : np.ndarray
        At the body's origin, kelvin, (S,).
    gradient : np.ndarray
        In the body's frame, K/m, (S, 3).
    """

    change: np.ndarray
    gradient: np.ndarray

    @classmethod
    def of(cls, fields: Sequence[Temperature]) -> Temperatures:
        """From the fields of the states, one by one."""
        return cls(np.array([f.change for f in fields]), np.array([f.gradient for f in fields]).reshape(-1, 3))

    def __add__(self, other: Temperatures) -> Temperatures:
        return Temperatures(self.change + other.change, self.gradient + other.gradient)

    def __getitem__(self, states: np.ndarray) -> Temperatures:
        """Those of some states, by their numbers."""
        return Temperatures(self.change[states], self.gradient[states])

    def at(self, point: np.ndarray) -> np.ndarray:
        """Changes at a point (3,) of the body's frame, kelvin, (S,)."""
        return np.asarray(self.change + inner(self.gradient, point))

    def seen_from(self, child: Pose) -> Temperatures:
        """Tell the fields in the frame of a body that stands at ``child`` in this one's frame."""
        return Temperatures(self.at(child.translation), turned(child.rotation.T, self.gradient))


def carried_motion(expansion: float, gradient: np.ndarray, arm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors and shifts, (..., 3) each, that a gradient gives to what stands at ``arm`` from the fixed point.

    The stress-free displacement of a linear field, u = a ((g . q) q - q^2 g / 2), and its rotation a (g x q); see
    ``optics.thermal.thermo_elastic.free_linear_field``. The uniform part, a dT q, is the body's ``Motion.stretch``.

    Parameters
    ----------
    expansion : float
        a, 1/K.
    gradient : np.ndarray
        g, K/m, in the body's frame, (..., 3).
    arm : np.ndarray
        q, metres, likewise, (..., 3).
    """
    g, q = np.asarray(gradient, np.float64), np.asarray(arm, np.float64)
    turn = np.empty(np.broadcast_shapes(g.shape, q.shape))
    for c, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
        turn[..., c] = g[..., a] * q[..., b] - g[..., b] * q[..., a]
    along, square = inner(g, q)[..., None], inner(q, q)[..., None]
    return expansion * turn, expansion * (along * q - 0.5 * square * g)
