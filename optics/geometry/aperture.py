"""Clear apertures of surfaces and edges that cut light, in the surface's own x, y.

Whether a point lies inside is decided here for all: by the methods ``contains`` of the numbers that an aperture
consists of, which work on floats, NumPy arrays and in kernels.

A surface may have several; light comes through where all let it. Numbers are NumPy arrays: edges are looked at where
traced rays have met their surface, and no kernel knows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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

    @property
    def enclosing(self) -> Circle:
        """Smallest circle that holds the shape: its outer edge."""
        return Circle(self.radius, self.centre)

    def grown(self, size: float) -> Circle:
        """Return this shape on a body that has grown to another size, 1 being the nominal one."""
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
        """Return this shape on a body that has grown to another size, 1 being the nominal one."""
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

    @property
    def enclosing(self) -> Circle:
        """Smallest circle that holds the shape: through its corners."""
        return Circle(float(np.hypot(self.half_x, self.half_y)), self.centre)

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

    @property
    def enclosing(self) -> Circle:
        """Smallest circle that holds the shape: about its longer axis."""
        return Circle(max(self.half_x, self.half_y), self.centre)

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


@dataclass(frozen=True)
class Ray:
    """A strip of a width that begins at a point and runs without end along +x: the vane of a spider.

    Attributes
    ----------
    width : float
        metres.
    centre : tuple[float, float]
        Middle of its beginning, metres.
    """

    width: float
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the size."""
        if not self.width > 0.0:
            raise ValueError(f"a vane needs a width, found {self.width}")

    def contains(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Mask of points inside, the edge included."""
        return np.asarray((x >= self.centre[0]) & (np.abs(y - self.centre[1]) <= 0.5 * self.width))


@dataclass(frozen=True)
class Polygon:
    """A polygon whose sides do not cross.

    Attributes
    ----------
    corners : tuple[tuple[float, float], ...]
        (x, y) one after the other, metres; the last is joined to the first.
    centre : tuple[float, float]
        About which it may be turned.
    """

    corners: tuple[tuple[float, float], ...]
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the corners."""
        if len(self.corners) < 3:
            raise ValueError(f"a polygon needs three corners or more, found {len(self.corners)}")

    def contains(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Mask of points inside, by how often a way along x crosses the sides."""
        inside = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)), dtype=bool)
        last_x, last_y = self.corners[-1]
        for next_x, next_y in self.corners:
            crosses = (last_y > y) != (next_y > y)
            with np.errstate(divide="ignore", invalid="ignore"):
                at = last_x + (y - last_y) * (next_x - last_x) / (next_y - last_y)
            inside ^= crosses & (x < at)
            last_x, last_y = next_x, next_y
        return inside


EdgeShape = Circle | Rectangle | Ellipse | Ray | Polygon


@dataclass(frozen=True)
class Edge:
    """What lets light through inside of a shape, or stops it there.

    Attributes
    ----------
    shape : EdgeShape
        Before its turn.
    blocks : bool
        Light is stopped inside of it; else outside.
    turn : float
        Of the shape about its own centre, right-handed about the surface's z, radians.
    """

    shape: EdgeShape
    blocks: bool = False
    turn: float = 0.0

    def passes(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Whether light comes through at points of the surface, of their shape.

        Parameters
        ----------
        x : np.ndarray
            Of the points in the surface's own frame, metres.
        y : np.ndarray
            Likewise, of the same shape.
        """
        if self.turn:
            cx, cy = self.shape.centre
            c, s = np.cos(self.turn), np.sin(self.turn)
            x, y = cx + c * (x - cx) + s * (y - cy), cy - s * (x - cx) + c * (y - cy)
        return np.asarray(self.shape.contains(x, y)) != self.blocks


def outer_edge(aperture: Aperture | None, edges: Sequence[Edge]) -> Aperture | None:
    """Return the smallest outer edge, but a polygon, that is stated of a surface, else its aperture."""
    stated = [edge.shape for edge in edges if not edge.blocks and isinstance(edge.shape, Aperture)]
    return min(stated, key=lambda shape: shape.enclosing.radius, default=aperture)


def turned_over(edge: Edge) -> Edge:
    """Tell the edge in a frame that is turned about its x by half a turn: y becomes -y."""
    shape = edge.shape
    (x, y) = shape.centre
    if isinstance(shape, Polygon):
        over: EdgeShape = Polygon(tuple((a, -b) for a, b in shape.corners), (x, -y))
    else:
        over = replace(shape, centre=(x, -y))
    return Edge(over, edge.blocks, -edge.turn)
