"""Clear apertures of surfaces, in the surface's own x, y.

Whether a point lies inside is decided here for all: by the methods ``contains`` of the numbers that an aperture
consists of, which work on floats, NumPy arrays and in kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np


@dataclass(frozen=True, eq=False)
class DiskNumbers:
    """A disk about (x, y), metres, with the square of its radius, m^2."""

    x: Any
    y: Any
    radius_squared: Any

    def contains(self, x: Any, y: Any) -> Any:
        """Mask of points inside, the edge included."""
        dx, dy = x - self.x, y - self.y
        return dx * dx + dy * dy <= self.radius_squared


@dataclass(frozen=True, eq=False)
class RingNumbers:
    """A disk with a concentric hole, whose radius squared is ``hole_squared``, m^2."""

    x: Any
    y: Any
    radius_squared: Any
    hole_squared: Any

    def contains(self, x: Any, y: Any) -> Any:
        """Mask of points inside, both edges included."""
        dx, dy = x - self.x, y - self.y
        r2 = dx * dx + dy * dy
        return (r2 <= self.radius_squared) & (r2 >= self.hole_squared)


@dataclass(frozen=True, eq=False)
class RectangleNumbers:
    """A rectangle about (x, y) with its half-widths, metres."""

    x: Any
    y: Any
    half_x: Any
    half_y: Any

    def contains(self, x: Any, y: Any) -> Any:
        """Mask of points inside, the edge included."""
        return (abs(x - self.x) <= self.half_x) & (abs(y - self.y) <= self.half_y)


@dataclass(frozen=True, eq=False)
class EllipseNumbers:
    """An ellipse about (x, y) with its half axes, metres."""

    x: Any
    y: Any
    half_x: Any
    half_y: Any

    def contains(self, x: Any, y: Any) -> Any:
        """Mask of points inside, the edge included."""
        u, v = (x - self.x) / self.half_x, (y - self.y) / self.half_y
        return u * u + v * v <= 1.0


ApertureNumbers = DiskNumbers | RingNumbers | RectangleNumbers | EllipseNumbers


@dataclass(frozen=True)
class Circle:
    """Disk of ``radius`` about ``centre`` (metres), with an optional concentric hole of radius ``inner``."""

    radius: float
    centre: tuple[float, float] = (0.0, 0.0)
    inner: float = 0.0

    def __post_init__(self) -> None:
        """Check the sizes."""
        if not 0.0 <= self.inner < self.radius:
            raise ValueError(f"a circular aperture needs 0 <= inner < radius, found {self.inner} and {self.radius}")

    def contains(self, x: Any, y: Any) -> Any:
        """Mask of points inside; NumPy or Dr.Jit arrays."""
        return self.numbers().contains(x, y)

    def numbers(self, size: Any = 1.0) -> DiskNumbers | RingNumbers:
        """What decides on a body of that size (1 is the nominal one, or an array)."""
        x, y, square = size * self.centre[0], size * self.centre[1], (size * self.radius) ** 2
        return RingNumbers(x, y, square, (size * self.inner) ** 2) if self.inner else DiskNumbers(x, y, square)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max, metres."""
        (cx, cy), r = self.centre, self.radius
        return cx - r, cx + r, cy - r, cy + r

    @property
    def inscribed(self) -> float:
        """Radius of the largest disk about the centre that lies inside the outer edge, metres."""
        return self.radius

    def grown(self, size: float) -> Circle:
        """The same on a body of another size, 1 being the nominal one."""
        return Circle(size * self.radius, (size * self.centre[0], size * self.centre[1]), size * self.inner)

    def outline(self, points: int = 96) -> np.ndarray:
        """Closed outline, shape (points, 2), metres."""
        t = np.linspace(0.0, 2.0 * np.pi, points)
        return np.stack([self.centre[0] + self.radius * np.cos(t), self.centre[1] + self.radius * np.sin(t)], axis=-1)


@dataclass(frozen=True)
class _TwoHalves:
    """What has two half sizes, ``half_x`` and ``half_y``, about ``centre`` (metres)."""

    half_x: float
    half_y: float
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max, metres."""
        (cx, cy) = self.centre
        return cx - self.half_x, cx + self.half_x, cy - self.half_y, cy + self.half_y

    @property
    def inscribed(self) -> float:
        """Radius of the largest disk about the centre that lies inside, metres."""
        return min(self.half_x, self.half_y)

    def grown(self, size: float) -> Self:
        """The same on a body of another size, 1 being the nominal one."""
        return type(self)(*self._scaled(size), (size * self.centre[0], size * self.centre[1]))

    def _scaled(self, size: Any) -> tuple[Any, Any]:
        return size * self.half_x, size * self.half_y


@dataclass(frozen=True)
class Rectangle(_TwoHalves):
    """Rectangle of half-widths ``half_x``, ``half_y`` about ``centre`` (metres)."""

    def __post_init__(self) -> None:
        """Check the sizes."""
        if not (self.half_x > 0.0 and self.half_y > 0.0):
            raise ValueError(
                f"a rectangular aperture needs positive half-widths, found {self.half_x} and {self.half_y}"
            )

    def contains(self, x: Any, y: Any) -> Any:
        """Mask of points inside; NumPy or Dr.Jit arrays."""
        return self.numbers().contains(x, y)

    def numbers(self, size: Any = 1.0) -> RectangleNumbers:
        """What decides on a body of that size (1 is the nominal one, or an array)."""
        return RectangleNumbers(size * self.centre[0], size * self.centre[1], *self._scaled(size))

    def outline(self, points: int = 96) -> np.ndarray:
        """Closed outline, shape (n, 2), metres."""
        x0, x1, y0, y1 = self.bounds
        n = max(points // 4, 1)
        s = np.linspace(0.0, 1.0, n, endpoint=False)
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        sides = [corners[i] + s[:, None] * (corners[i + 1] - corners[i]) for i in range(4)]
        return np.concatenate([*sides, corners[:1]])


@dataclass(frozen=True)
class Ellipse(_TwoHalves):
    """Ellipse of half axes ``half_x``, ``half_y`` about ``centre`` (metres): a round beam on a slanted face."""

    def __post_init__(self) -> None:
        """Check the sizes."""
        if not (self.half_x > 0.0 and self.half_y > 0.0):
            raise ValueError(f"an elliptical aperture needs positive half axes, found {self.half_x} and {self.half_y}")

    def contains(self, x: Any, y: Any) -> Any:
        """Mask of points inside; NumPy or Dr.Jit arrays."""
        return self.numbers().contains(x, y)

    def numbers(self, size: Any = 1.0) -> EllipseNumbers:
        """What decides on a body of that size (1 is the nominal one, or an array)."""
        return EllipseNumbers(size * self.centre[0], size * self.centre[1], *self._scaled(size))

    def outline(self, points: int = 96) -> np.ndarray:
        """Closed outline, shape (points, 2), metres."""
        t = np.linspace(0.0, 2.0 * np.pi, points)
        x, y = self.centre
        return np.stack([x + self.half_x * np.cos(t), y + self.half_y * np.sin(t)], axis=-1)


Aperture = Circle | Rectangle | Ellipse
