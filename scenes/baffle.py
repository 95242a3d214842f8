"""Simple mechanical parts for stray light: plates, boxes and tubes of flat plates, on any body of the tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.aperture import Circle, Rectangle
from optics.finish import BLACK, Finish
from optics.pose import Pose
from optics.rotation import about_axis

TUBE_SIDES = 24


@dataclass(frozen=True)
class Plate:
    """A flat plate of no thickness.

    Attributes:
        name: of the part it belongs to; plates of one name are one part in the results.
        body: path of the body that carries it.
        pose: of the plate in that body's frame.
        outline: its edge in the plate's x, y; a ring has a hole.
        finish: of both sides.
    """

    name: str
    body: str
    pose: Pose
    outline: Circle | Rectangle
    finish: Finish = BLACK


def box(
    name: str,
    body: str,
    pose: Pose,
    size: tuple[float, float, float],
    finish: Finish = BLACK,
    open_top: bool = True,
) -> tuple[Plate, ...]:
    """A box whose bottom's middle is the pose's origin and whose walls rise along +z.

    Args:
        name: of the part.
        body: path of the body that carries it.
        pose: in that body's frame.
        size: along x, y, z, metres.
        finish: of all sides.
        open_top: whether the side at +z is left open.
    """
    x, y, z = (0.5 * s for s in size)

    def wall(axis: int, angle: float, place: tuple[float, float, float], half: tuple[float, float]) -> Plate:
        inner = Pose(about_axis(axis, angle), np.array(place))
        return Plate(name, body, pose @ inner, Rectangle(*half), finish)

    quarter = 0.5 * np.pi
    plates = [
        wall(0, 0.0, (0.0, 0.0, 0.0), (x, y)),
        wall(1, quarter, (-x, 0.0, z), (z, y)),
        wall(1, -quarter, (x, 0.0, z), (z, y)),
        wall(0, -quarter, (0.0, -y, z), (x, z)),
        wall(0, quarter, (0.0, y, z), (x, z)),
    ]
    if not open_top:
        plates.append(wall(0, 0.0, (0.0, 0.0, 2.0 * z), (x, y)))
    return tuple(plates)


def tube(
    name: str, body: str, pose: Pose, radius: float, length: float, finish: Finish = BLACK, sides: int = TUBE_SIDES
) -> tuple[Plate, ...]:
    """A tube along +z from the pose's origin, open at both ends, of flat sides that touch the circle of ``radius``."""
    half = radius * float(np.tan(np.pi / sides))
    plates = []
    for k in range(sides):
        turn = about_axis(2, 2.0 * np.pi * k / sides)
        # the plate's z points to the axis, its x along the tube
        inner = Pose(turn @ about_axis(1, -0.5 * np.pi), turn @ np.array([radius, 0.0, 0.5 * length]))
        plates.append(Plate(name, body, pose @ inner, Rectangle(0.5 * length, half), finish))
    return tuple(plates)


def ring(name: str, body: str, pose: Pose, inner: float, outer: float, finish: Finish = BLACK) -> tuple[Plate, ...]:
    """A flat stop with a round hole; radii in metres."""
    return (Plate(name, body, pose, Circle(outer, inner=inner), finish),)
