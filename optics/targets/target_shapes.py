"""Test targets as vector shapes: knife edge, bar group, star, pinhole, and those of a camera's windows.

A target lies in its own plane, in metres about the origin. ``Target.mapped`` maps it into an image plane, where columns
count along x and rows along y. Levels are transmittances, 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from optics.geometry.vector_shape import BEND_TOLERANCE, Disk, HalfPlane, PointMap, Polygon, Shape
from optics.numerics.extension_table import ExtensionTable


@dataclass(frozen=True, eq=False)
class Target:
    """Plane of uniform transmittance with shapes on it.

    Attributes
    ----------
    background : float
        Transmittance where there is no shape, 0 to 1.
    parts : tuple of (float, Shape)
        (transmittance that the shape adds to the background, shape); shapes must not overlap (not checked).

    Raises
    ------
    ValueError
        A transmittance is outside 0 to 1.
    """

    background: float
    parts: tuple[tuple[float, Shape], ...]

    def __post_init__(self) -> None:
        """Check that every transmittance lies between 0 and 1."""
        object.__setattr__(self, "parts", tuple((float(level), shape) for level, shape in self.parts))
        for level in (self.background, *(self.background + level for level, _ in self.parts)):
            if not 0.0 <= level <= 1.0:
                raise ValueError(f"transmittances of a target lie between 0 and 1, found {level}")

    def mapped(self, point_map: PointMap, tolerance: float = BEND_TOLERANCE) -> Target:
        """Return the target under a smooth map of N points (N, 2) -> (N, 2), metres, such as a camera's chief rays.

        Parameters
        ----------
        point_map : callable
            The map.
        tolerance : float
            Largest distance of a new outline from the mapped one, metres; half-planes keep straight edges, the tangents
            at their points.

        Raises
        ------
        ValueError
            The map is not finite at a shape, or too rough for the tolerance.
        """
        shapes = (
            shape.mapped(point_map) if isinstance(shape, HalfPlane) else shape.mapped(point_map, tolerance)
            for _, shape in self.parts
        )
        return Target(self.background, tuple((part[0], shape) for part, shape in zip(self.parts, shapes, strict=True)))


def slanted_edge(angle: float, direction: Literal["x", "y"] = "y") -> Target:
    """Return a knife edge through the origin, bright on one side, for the slanted-edge method (ISO 12233).

    Parameters
    ----------
    angle : float
        Rotation of the edge from its axis, from +x toward +y, radians, below 45 degrees either way.
    direction : {'x', 'y'}
        Axis that the edge follows at angle 0: "y" for a profile along x (bright toward +x), "x" for a profile along y
        (bright toward +y).
    """
    if not abs(angle) < 0.25 * np.pi:
        raise ValueError(f"a slanted edge needs an angle below 45 degrees, found {np.degrees(angle):g}")
    normal_angle = angle if _is_y(direction) else angle + 0.5 * np.pi
    return Target(0.0, ((1.0, HalfPlane(np.zeros(2), np.array([np.cos(normal_angle), np.sin(normal_angle)]))),))


def bar_group(frequency: float, bars: int, length: float, angle: float = 0.0) -> Target:
    """Return bright bars on dark, each half a period wide, about the origin.

    Parameters
    ----------
    frequency : float
        Spatial frequency along the bars' normal, cycles/m.
    bars : int
        Number of bright bars.
    length : float
        Length of a bar, metres.
    angle : float
        Angle of the bars' normal from +x toward +y, radians.
    """
    if not (np.isfinite(frequency) and frequency > 0.0):
        raise ValueError(f"bars need a positive frequency in cycles/m, found {frequency}")
    if bars < 1 or bars != int(bars):
        raise ValueError(f"a bar group needs a whole number of bars, 1 or more, found {bars}")
    if not (np.isfinite(length) and length > 0.0):
        raise ValueError(f"bars need a positive length, found {length}")
    normal = np.array([np.cos(angle), np.sin(angle)])
    along = np.array([-normal[1], normal[0]])
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    upright = corners[:, :1] * 0.25 / frequency * normal + corners[:, 1:] * 0.5 * length * along
    middles = (np.arange(int(bars)) - 0.5 * (bars - 1)) / frequency
    return Target(0.0, tuple((1.0, Polygon(middle * normal + upright)) for middle in middles))


def siemens_star(spokes: int, radius: float, inner: float = 0.0) -> Target:
    """Return bright spokes on dark about the origin, of the same angular width as the gaps.

    The first spoke lies along +x. At a distance r from the middle (metres) the star has the frequency spokes / (2 pi
    r), cycles/m. The ends of the spokes are chords.

    Parameters
    ----------
    spokes : int
        Number of bright spokes, 2 or more.
    radius : float
        Distance of the outer corners from the middle, metres.
    inner : float
        Radius at which the spokes begin, metres; 0: they meet in the middle.
    """
    if spokes < 2:
        raise ValueError(f"a Siemens star needs two spokes or more, found {spokes}")
    if not 0.0 <= inner < radius:
        raise ValueError(f"a Siemens star needs 0 <= inner < radius, found {inner} and {radius}")
    angle = 2.0 * np.pi / spokes * (np.arange(spokes)[:, None] + np.array([-0.25, 0.25]))
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ends = np.zeros((spokes, 1, 2)) if inner == 0.0 else inner * rim[:, ::-1]
    return Target(0.0, tuple((1.0, Polygon(corners)) for corners in np.concatenate([radius * rim, ends], axis=1)))


def pinhole(diameter: float) -> Target:
    """Return a bright disk on dark at the origin; diameter in metres."""
    if not (np.isfinite(diameter) and diameter > 0.0):
        raise ValueError(f"a pinhole needs a positive diameter, found {diameter}")
    return Target(0.0, ((1.0, Disk(np.zeros(2), 0.5 * diameter)),))


SPOKES = 36
"""Number of bright spokes of a window's Siemens star."""
STAR_SHARE = 0.9
"""Radius of a window's Siemens star relative to half the window's side.

The Nyquist frequency lies 11.5 pixels from its middle.
"""

PINHOLE = 1.0
"""Diameter of the image of a window's pinhole target, pixels."""


def star_target(pitch: float, region: int) -> Target:
    """Return the Siemens star for a window of ``region`` x ``region`` pixels of ``pitch`` metres each."""
    return siemens_star(SPOKES, 0.5 * STAR_SHARE * region * pitch)


def pinhole_target(pitch: float, region: int) -> Target:
    """Return the pinhole for a window of ``region`` x ``region`` pixels of ``pitch`` metres each."""
    return pinhole(PINHOLE * pitch)


TARGETS = ExtensionTable[Callable[[float, int], Target]]("targets", {"star": star_target, "pinhole": pinhole_target})
"""Targets of finite shapes about the middle of a window, by name.

Each is a function of the pixel pitch, in metres on the nominal image, and the window's side, in pixels. The cameras of
a job can image them in addition to the edges and bars, whose MTF the job measures itself. A new target is added here.
"""


def _is_y(direction: str) -> bool:
    """Return True for the direction "y", False for "x"; raise ValueError for another."""
    if direction not in ("x", "y"):
        raise ValueError(f'the direction is "x" or "y", found {direction!r}')
    return direction == "y"
