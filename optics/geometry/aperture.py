"""Clear apertures and light-blocking edges of surfaces, in the surface's own x, y frame.

Whether a point lies in an aperture is always decided by the ``contains`` methods of ``DiskNumbers``, ``RingNumbers``,
``RectangleNumbers`` and ``EllipseNumbers``, which work on floats, NumPy arrays and Dr.Jit arrays in kernels.

A surface may have several edges; light passes where all of them let it. ``Edge`` is evaluated with NumPy only, at the
points where traced rays meet the surface; kernels do not use it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np


@dataclass(frozen=True, eq=False)
class DiskNumbers:
    """Numbers of a disk about (x, y): its centre, in metres, and the square of its radius, in m^2."""

    x: Any
    y: Any
    radius_squared: Any

    def contains(self, x: Any, y: Any) -> Any:
        """Return the mask of points x, y (metres) inside the disk, its edge included."""
        dx, dy = x - self.x, y - self.y
        return dx * dx + dy * dy <= self.radius_squared


@dataclass(frozen=True, eq=False)
class RingNumbers:
    """Numbers of a disk with a concentric hole: centre (x, y), in metres, and squares of both radii, in m^2."""

    x: Any
    y: Any
    radius_squared: Any
    hole_squared: Any

    def contains(self, x: Any, y: Any) -> Any:
        """Return the mask of points x, y (metres) inside the ring, both edges included."""
        dx, dy = x - self.x, y - self.y
        r2 = dx * dx + dy * dy
        return (r2 <= self.radius_squared) & (r2 >= self.hole_squared)


@dataclass(frozen=True, eq=False)
class RectangleNumbers:
    """Numbers of a rectangle about (x, y): its centre and half-widths, in metres."""

    x: Any
    y: Any
    half_x: Any
    half_y: Any

    def contains(self, x: Any, y: Any) -> Any:
        """Return the mask of points x, y (metres) inside the rectangle, its edge included."""
        return (abs(x - self.x) <= self.half_x) & (abs(y - self.y) <= self.half_y)


@dataclass(frozen=True, eq=False)
class EllipseNumbers:
    """Numbers of an ellipse about (x, y): its centre and semi-axes, in metres."""

    x: Any
    y: Any
    half_x: Any
    half_y: Any

    def contains(self, x: Any, y: Any) -> Any:
        """Return the mask of points x, y (metres) inside the ellipse, its edge included."""
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
        """Check that the radii are positive and the hole is smaller than the disk."""
        if not 0.0 <= self.inner < self.radius:
            raise ValueError(f"a circular aperture needs 0 <= inner < radius, found {self.inner} and {self.radius}")

    def contains(self, x: Any, y: Any) -> Any:
        """Return the mask of points inside; x and y are NumPy or Dr.Jit arrays, in metres."""
        return self.numbers().contains(x, y)

    def numbers(self, size: Any = 1.0) -> DiskNumbers | RingNumbers:
        """Return the centre and squared radii that ``contains`` needs, for a body scaled by ``size`` (1 is nominal)."""
        x, y, square = size * self.centre[0], size * self.centre[1], (size * self.radius) ** 2
        return RingNumbers(x, y, square, (size * self.inner) ** 2) if self.inner else DiskNumbers(x, y, square)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max), in metres."""
        (cx, cy), r = self.centre, self.radius
        return cx - r, cx + r, cy - r, cy + r

    @property
    def inscribed(self) -> float:
        """Radius of the largest disk about the centre that lies inside the outer edge, in metres."""
        return self.radius

    @property
    def enclosing(self) -> Circle:
        """Smallest circle that encloses the shape: its outer edge."""
        return Circle(self.radius, self.centre)

    def scaled(self, size: float) -> Circle:
        """Return the shape with all lengths multiplied by ``size``, as on a body that expands by this factor."""
        return Circle(size * self.radius, (size * self.centre[0], size * self.centre[1]), size * self.inner)

    def outline(self, points: int = 96) -> np.ndarray:
        """Return a closed outline of the outer edge, shape (points, 2), in metres."""
        t = np.linspace(0.0, 2.0 * np.pi, points)
        return np.stack([self.centre[0] + self.radius * np.cos(t), self.centre[1] + self.radius * np.sin(t)], axis=-1)


@dataclass(frozen=True)
class _HalfSizeShape:
    """Shape with half-sizes ``half_x`` and ``half_y`` along x and y about ``centre`` (metres): rectangle or ellipse."""

    half_x: float
    half_y: float
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max), in metres."""
        (cx, cy) = self.centre
        return cx - self.half_x, cx + self.half_x, cy - self.half_y, cy + self.half_y

    @property
    def inscribed(self) -> float:
        """Radius of the largest disk about the centre that lies inside, in metres."""
        return min(self.half_x, self.half_y)

    def scaled(self, size: float) -> Self:
        """Return the shape with all lengths multiplied by ``size``, as on a body that expands by this factor."""
        return type(self)(*self._scaled(size), (size * self.centre[0], size * self.centre[1]))

    def _scaled(self, size: Any) -> tuple[Any, Any]:
        return size * self.half_x, size * self.half_y


@dataclass(frozen=True)
class Rectangle(_HalfSizeShape):
    """Rectangle of half-widths ``half_x``, ``half_y`` about ``centre`` (metres)."""

    def __post_init__(self) -> None:
        """Check that both half-widths are positive."""
        if not (self.half_x > 0.0 and self.half_y > 0.0):
            raise ValueError(
                f"a rectangular aperture needs positive half-widths, found {self.half_x} and {self.half_y}"
            )

    @property
    def enclosing(self) -> Circle:
        """Smallest circle that encloses the shape, through its corners."""
        return Circle(float(np.hypot(self.half_x, self.half_y)), self.centre)

    def contains(self, x: Any, y: Any) -> Any:
        """Return the mask of points inside; x and y are NumPy or Dr.Jit arrays, in metres."""
        return self.numbers().contains(x, y)

    def numbers(self, size: Any = 1.0) -> RectangleNumbers:
        """Return the centre and half-widths that ``contains`` needs, for a body scaled by ``size`` (1 is nominal)."""
        return RectangleNumbers(size * self.centre[0], size * self.centre[1], *self._scaled(size))

    def outline(self, points: int = 96) -> np.ndarray:
        """Return points along the closed outline, shape (n, 2), in metres; n is about ``points``."""
        x0, x1, y0, y1 = self.bounds
        n = max(points // 4, 1)
        s = np.linspace(0.0, 1.0, n, endpoint=False)
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        sides = [corners[i] + s[:, None] * (corners[i + 1] - corners[i]) for i in range(4)]
        return np.concatenate([*sides, corners[:1]])


@dataclass(frozen=True)
class Ellipse(_HalfSizeShape):
    """Ellipse of semi-axes ``half_x``, ``half_y`` about ``centre`` (metres), such as a round beam's footprint."""

    def __post_init__(self) -> None:
        """Check that both semi-axes are positive."""
        if not (self.half_x > 0.0 and self.half_y > 0.0):
            raise ValueError(f"an elliptical aperture needs positive half axes, found {self.half_x} and {self.half_y}")

    @property
    def enclosing(self) -> Circle:
        """Smallest circle that encloses the shape, of the longer semi-axis."""
        return Circle(max(self.half_x, self.half_y), self.centre)

    def contains(self, x: Any, y: Any) -> Any:
        """Return the mask of points inside; x and y are NumPy or Dr.Jit arrays, in metres."""
        return self.numbers().contains(x, y)

    def numbers(self, size: Any = 1.0) -> EllipseNumbers:
        """Return the centre and semi-axes that ``contains`` needs, for a body scaled by ``size`` (1 is nominal)."""
        return EllipseNumbers(size * self.centre[0], size * self.centre[1], *self._scaled(size))

    def outline(self, points: int = 96) -> np.ndarray:
        """Return a closed outline, shape (points, 2), in metres."""
        t = np.linspace(0.0, 2.0 * np.pi, points)
        x, y = self.centre
        return np.stack([x + self.half_x * np.cos(t), y + self.half_y * np.sin(t)], axis=-1)


Aperture = Circle | Rectangle | Ellipse


@dataclass(frozen=True)
class Ray:
    """Half-infinite strip along +x: one vane of a spider.

    Attributes
    ----------
    width : float
        Width of the strip, metres.
    centre : tuple of float
        (x, y) of the middle of the strip's end, metres.
    """

    width: float
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Check that the width is positive."""
        if not self.width > 0.0:
            raise ValueError(f"a vane needs a width, found {self.width}")

    def contains(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the mask of points x, y (metres) inside the strip, its edge included."""
        return np.asarray((x >= self.centre[0]) & (np.abs(y - self.centre[1]) <= 0.5 * self.width))


@dataclass(frozen=True)
class Polygon:
    """Polygon whose sides do not cross.

    Attributes
    ----------
    corners : tuple of (float, float)
        Corners (x, y) in order, metres; the last is joined to the first.
    centre : tuple of float
        (x, y) of the point about which an edge rotates the polygon, metres.
    """

    corners: tuple[tuple[float, float], ...]
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Check that there are three corners or more."""
        if len(self.corners) < 3:
            raise ValueError(f"a polygon needs three corners or more, found {len(self.corners)}")

    def contains(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the mask of points x, y (metres) inside, by the parity of the sides that a line along x crosses."""
        inside = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)), dtype=bool)
        last_x, last_y = self.corners[-1]
        for next_x, next_y in self.corners:
            crosses = (last_y > y) != (next_y > y)
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing_x = last_x + (y - last_y) * (next_x - last_x) / (next_y - last_y)
            inside ^= crosses & (x < crossing_x)
            last_x, last_y = next_x, next_y
        return inside


EdgeShape = Circle | Rectangle | Ellipse | Ray | Polygon


@dataclass(frozen=True)
class Edge:
    """Edge of a surface that passes or blocks the light inside a shape.

    Attributes
    ----------
    shape : Circle, Rectangle, Ellipse, Ray or Polygon
        The shape before it is rotated.
    blocks : bool
        True when light is blocked inside the shape; False when it is blocked outside.
    rotation : float
        Rotation of the shape about its own centre, right-handed about the surface's z, radians.
    """

    shape: EdgeShape
    blocks: bool = False
    rotation: float = 0.0

    def passes(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the mask of points of the surface at which light passes.

        Parameters
        ----------
        x, y : ndarray
            Coordinates of the points in the surface's own frame, metres, of one shape.

        Returns
        -------
        ndarray of bool
            Mask of the shape of ``x``.
        """
        if self.rotation:
            cx, cy = self.shape.centre
            c, s = np.cos(self.rotation), np.sin(self.rotation)
            x, y = cx + c * (x - cx) + s * (y - cy), cy - s * (x - cx) + c * (y - cy)
        return np.asarray(self.shape.contains(x, y)) != self.blocks


def outer_edge(aperture: Aperture | None, edges: Sequence[Edge]) -> Aperture | None:
    """Return the smallest outer edge given for a surface (polygons excluded), or its aperture if there is none."""
    apertures = [edge.shape for edge in edges if not edge.blocks and isinstance(edge.shape, Aperture)]
    return min(apertures, key=lambda shape: shape.enclosing.radius, default=aperture)


def flipped_y(edge: Edge) -> Edge:
    """Return the edge in a frame rotated by 180 deg about its x axis: y becomes -y."""
    shape = edge.shape
    (x, y) = shape.centre
    if isinstance(shape, Polygon):
        flipped: EdgeShape = Polygon(tuple((a, -b) for a, b in shape.corners), (x, -y))
    else:
        flipped = replace(shape, centre=(x, -y))
    return Edge(flipped, edge.blocks, -edge.rotation)
