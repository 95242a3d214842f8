"""Edges of surfaces that cut light: of mirrors and lenses, holes, obscurations and spiders, in the surface's own x, y.

A surface may have several; light comes through where all let it. Numbers are NumPy arrays: edges are looked at where
traced rays have met their surface, and no kernel knows them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optics.geometry.aperture import Circle, Ellipse, Rectangle

__all__ = ["Edge", "EdgeShape", "Polygon", "Ray", "turned_over"]


@dataclass(frozen=True)
class Ray:
    """A strip of a width that begins at a point and runs without end along +x: the vane of a spider.

    Attributes:
        width: metres.
        centre: middle of its beginning, metres.
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

    Attributes:
        corners: (x, y) one after the other, metres; the last is joined to the first.
        centre: about which it may be turned.
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

    Attributes:
        shape: before its turn.
        blocks: light is stopped inside of it; else outside.
        turn: of the shape about its own centre, right-handed about the surface's z, radians.
    """

    shape: EdgeShape
    blocks: bool = False
    turn: float = 0.0

    def passes(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Whether light comes through at points of the surface, of their shape.

        Args:
            x: of the points in the surface's own frame, metres.
            y: likewise, of the same shape.
        """
        if self.turn:
            cx, cy = self.shape.centre
            c, s = np.cos(self.turn), np.sin(self.turn)
            x, y = cx + c * (x - cx) + s * (y - cy), cy - s * (x - cx) + c * (y - cy)
        return np.asarray(self.shape.contains(x, y)) != self.blocks


def turned_over(edge: Edge) -> Edge:
    """The same edge told in a frame that is turned about its x by half a turn: y becomes -y."""
    shape = edge.shape
    (x, y) = shape.centre
    if isinstance(shape, Polygon):
        over: EdgeShape = Polygon(tuple((a, -b) for a, b in shape.corners), (x, -y))
    else:
        over = replace(shape, centre=(x, -y))
    return Edge(over, edge.blocks, -edge.turn)
