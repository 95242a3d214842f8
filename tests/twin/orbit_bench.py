"""A satellite by formulas, for tests of the sensor model: a circle in space above an evenly turning Earth.

It shares no code with twin.orbit's own orbit, attitude and Earth rotation, and knows the same things in inertial axes.
"""

from dataclasses import dataclass

import numpy as np

RATE = 7.292115146706979e-5
GM = 3.986004418e14


@dataclass(frozen=True)
class CirclePlatform:
    """Position, velocity and attitude on a circle.

    Attributes:
        radius: of the circle, metres.
        inclination: radians.
        argument: from the ascending node at time 0, radians.
        node: longitude of the ascending node at time 0, when the axes of the Earth and of space agree, radians.
        wobble: amplitude of turns about body X, Y and Z, radians; each has a frequency of its own.
        span: times that are known, seconds.
    """

    radius: float = 6378137.0 + 500e3
    inclination: float = np.radians(97.3)
    argument: float = np.radians(140.0)
    node: float = 2.0
    wobble: float = 0.0
    span: tuple[float, float] = (-30.0, 30.0)

    @property
    def mean_motion(self) -> float:
        return float(np.sqrt(GM / self.radius**3))

    def space(self, seconds):
        """Position, velocity, (N, 3), and body axes as columns, (N, 3, 3), in axes that do not turn."""
        t = np.asarray(seconds, dtype=np.float64)
        if not np.all((t >= self.span[0]) & (t <= self.span[1])):
            raise ValueError("time outside the orbit")
        u = self.argument + self.mean_motion * t
        ci, si, cn, sn = np.cos(self.inclination), np.sin(self.inclination), np.cos(self.node), np.sin(self.node)
        p, q = np.array([cn, sn, 0.0]), np.array([-ci * sn, ci * cn, si])
        out = np.cos(u)[..., None] * p + np.sin(u)[..., None] * q
        along = -np.sin(u)[..., None] * p + np.cos(u)[..., None] * q
        axes = np.stack([along, np.cross(-out, along), -out], axis=-1)
        if self.wobble:
            for axis, frequency in enumerate((1.3, 7.1, 31.0)):
                angle = self.wobble * np.sin(2.0 * np.pi * frequency * t + axis)
                axes = axes @ turn(axis, angle)
        return self.radius * out, self.radius * self.mean_motion * along, axes

    def to_earth(self, seconds):
        """Axes of space -> Earth-fixed axes, (N, 3, 3)."""
        return turn(2, -RATE * np.asarray(seconds, dtype=np.float64))

    def position(self, seconds):
        return np.einsum("...ij,...j->...i", self.to_earth(seconds), self.space(seconds)[0])

    def inertial_velocity(self, seconds):
        return np.einsum("...ij,...j->...i", self.to_earth(seconds), self.space(seconds)[1])

    def body_to_itrs(self, seconds):
        return self.to_earth(seconds) @ self.space(seconds)[2]


def turn(axis: int, angle):
    """Right-handed turns about an axis, (..., 3, 3)."""
    angle = np.asarray(angle, dtype=np.float64)
    out = np.zeros((*angle.shape, 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[..., axis, axis] = 1.0
    out[..., i, i] = out[..., j, j] = np.cos(angle)
    out[..., j, i] = np.sin(angle)
    out[..., i, j] = -np.sin(angle)
    return out
