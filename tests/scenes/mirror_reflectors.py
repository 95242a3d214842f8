"""Reflectors of a monitor whose mirrors stand each on its own, without a frame: three square to each other and two
parallel ones. They are toys from outside, registered by a test.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from optics.geometry.aperture import Ellipse
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Coating, Face, Solid
from optics.geometry.surface import plane
from optics.geometry.tree import Body
from optics.raytrace.assembly import Element, Interaction
from optics.raytrace.reflectors import Mount, Reflector, ReflectorParts

EDGE, THICKNESS = 0.001, 0.005
"""How far a plate reaches beyond its clear aperture, and its thickness, metres."""

Mirror = tuple[str, np.ndarray, np.ndarray, np.ndarray]
"""Name, normal toward the light, place of the beam's middle and direction of the arriving beam, in the reflector's
frame.
"""


def of_plates(mount: Mount, mirrors: list[Mirror], apex: tuple[float, float, float]) -> ReflectorParts:
    """Each mirror on a plate of its own."""
    middle = np.mean([place for _, _, place, _ in mirrors], axis=0)
    bodies = [Body(mount.path, mount.pose, pivots={"apex": apex, "centre": tuple(map(float, middle))})]
    elements, solids = [], []
    for name, normal, place, arriving in mirrors:
        z = normal / np.linalg.norm(normal)
        x = arriving - (arriving @ z) * z
        x /= np.linalg.norm(x)
        error = Pose(rotation_matrix(np.array([*mount.errors.get(name, (0.0, 0.0)), 0.0])))
        body = f"{mount.path}/{name}"
        bodies.append(Body(body, Pose(np.stack([x, np.cross(z, x), z], axis=-1), place) @ error))
        half = 0.5 * mount.width
        aperture = Ellipse(half / abs(float(arriving @ z)), half)
        elements.append(Element(f"{mount.key}/{name}", body, plane(), Interaction.REFLECT, aperture))
        solids.append(Solid(body, mount.material, plate(body, aperture), transparent=False))
    return ReflectorParts(tuple(bodies), tuple(elements), tuple(solids), 0.0, apex)


def plate(body: str, aperture: Ellipse) -> tuple[Face, ...]:
    """A mirror in z = 0 on a block below it."""
    x, y = aperture.half_x + EDGE, aperture.half_y + EDGE
    quarter = 0.5 * np.pi
    sides = {
        "back": ((np.pi, 0.0, 0.0), (0.0, 0.0, -THICKNESS)),
        "right": ((0.0, quarter, 0.0), (x, 0.0, 0.0)),
        "left": ((0.0, -quarter, 0.0), (-x, 0.0, 0.0)),
        "upper": ((-quarter, 0.0, 0.0), (0.0, y, 0.0)),
        "lower": ((quarter, 0.0, 0.0), (0.0, -y, 0.0)),
    }
    ground = (
        Face(name, body, Coating.GROUND, Pose(rotation_matrix(np.array(turn)), np.array(place)))
        for name, (turn, place) in sides.items()
    )
    return (Face("front", body, Coating.MIRROR), *ground)


def two_plates(mount: Mount) -> ReflectorParts:
    """Two parallel mirrors at 45 deg: the beam goes on, displaced."""
    half = 0.5 * mount.length
    if mount.length < 2.0 * mount.width:
        raise ValueError(f"{mount.path}: the mirrors stand in each other's beams")
    z, x = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    return of_plates(mount, [("first", x - z, -half * x, z), ("second", z - x, half * x, x)], (0.0, 0.0, 0.0))


def aside(width: float) -> float:
    """How far from the ridge of the roof the beam passes: no plate reaches over it."""
    return 0.5 * width + 3.0 * EDGE + THICKNESS


def corner(length: float, width: float) -> tuple[float, float, float]:
    """Where the planes of the three mirrors meet."""
    return (0.0, 0.0, 0.5 * length + 2.0 * width)


def three_plates(mount: Mount) -> ReflectorParts:
    """Three mirrors square to each other, far apart: a slice of a hollow corner cube."""
    x, y = 0.5 * mount.length, mount.hand * aside(mount.width)
    apex = corner(mount.length, mount.width)
    height, root = apex[2] - x, sqrt(2.0)
    up, along, turned = np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.array([0.5, -mount.hand / root, -0.5])
    mirrors = [
        ("mirror", np.array([1.0, 0, -1]), np.array([-x, y, height]), up),
        ("roof_a", np.array([-1.0, -mount.hand * root, -1]), np.array([x - root * abs(y), y, height]), along),
        ("roof_b", np.array([-1.0, mount.hand * root, -1]), np.array([x, -y, height - root * abs(y)]), turned),
    ]
    return of_plates(mount, mirrors, apex)


TWO_PLATES = Reflector(False, ("first", "second"), two_plates, transparent=False)
CORNER = Reflector(True, ("mirror", "roof_a", "roof_b"), three_plates, aside, corner, transparent=False)
