"""Parts that block light besides the stop: baffles of an instrument, and edges of a camera's surfaces.

Baffles are plates, boxes, tubes and rings; every baffle is a set of flat plates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, assert_never

import numpy as np
from pydantic import Field, model_validator

from optics.geometry.aperture import Circle, Edge, EdgeShape, Ellipse, Polygon, Ray, Rectangle
from optics.geometry.pose import Pose, about_axis, rotation_matrix
from optics.materials.fresnel_scatter import BLACK, Finish
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import Problem
from scenes.yaml.spec import Spec, require_one
from scenes.yaml.unit_fields import PositiveLength, Quantity, Vector, Vector2, Vector3
from scenes.yaml.units import ANGLE, LENGTH

TUBE_SIDES = 24


@dataclass(frozen=True)
class Plate:
    """Flat plate of zero thickness.

    Attributes
    ----------
    name : str
        Name of the part to which the plate belongs; plates with one name are one part in the results.
    body : str
        Path of the body that carries the plate.
    pose : Pose
        Pose of the plate in that body's frame.
    outline : Circle | Rectangle
        Edge of the plate in its x, y; a ring has a hole.
    finish : Finish
        Finish of both sides.
    """

    name: str
    body: str
    pose: Pose
    outline: Circle | Rectangle
    finish: Finish = BLACK


def box(name: str, body: str, pose: Pose, size: tuple[float, float, float]) -> tuple[Plate, ...]:
    """Return the plates of a box that is open at +z.

    Parameters
    ----------
    name : str
        Name of the part.
    body : str
        Path of the body that carries the box.
    pose : Pose
        Pose in that body's frame. The origin is the centre of the bottom; the walls rise along +z.
    size : tuple[float, float, float]
        Size along x, y, z, in metres.
    """
    x, y, z = (0.5 * s for s in size)

    def wall(axis: int, angle: float, centre: tuple[float, float, float], half: tuple[float, float]) -> Plate:
        inner = Pose(about_axis(axis, angle), np.array(centre))
        return Plate(name, body, pose @ inner, Rectangle(*half))

    quarter = 0.5 * np.pi
    return (
        wall(0, 0.0, (0.0, 0.0, 0.0), (x, y)),
        wall(1, quarter, (-x, 0.0, z), (z, y)),
        wall(1, -quarter, (x, 0.0, z), (z, y)),
        wall(0, -quarter, (0.0, -y, z), (x, z)),
        wall(0, quarter, (0.0, y, z), (x, z)),
    )


def tube(name: str, body: str, pose: Pose, radius: float, length: float) -> tuple[Plate, ...]:
    """Return the plates of a tube along +z from the pose's origin, open at both ends.

    Its flat sides touch the circle of ``radius``, in metres.
    """
    half = radius * float(np.tan(np.pi / TUBE_SIDES))
    plates = []
    for k in range(TUBE_SIDES):
        rotation = about_axis(2, 2.0 * np.pi * k / TUBE_SIDES)
        # rotate each plate so that its z points to the axis and its x along the tube
        pose_in_tube = Pose(rotation @ about_axis(1, -0.5 * np.pi), rotation @ np.array([radius, 0.0, 0.5 * length]))
        plates.append(Plate(name, body, pose @ pose_in_tube, Rectangle(0.5 * length, half)))
    return tuple(plates)


def ring(name: str, body: str, pose: Pose, inner: float, outer: float) -> tuple[Plate, ...]:
    """Return the plate of a flat stop with a round hole; radii in metres."""
    return (Plate(name, body, pose, Circle(outer, inner=inner)),)


Size = Annotated[float, Quantity(LENGTH, above_zero=True, largest="10 m")]
_NEEDS = {"plate": ("width", "height"), "box": ("width", "height", "length"), "tube": ("diameter", "length"),
          "ring": ("hole", "diameter")}  # fmt: skip


class BaffleSpec(Spec):
    """Black mechanical part that blocks light: plate, box, tube or ring.

    The path tracer, scene.glb and the picture include it; the wavefront calculation does not.

    Attributes
    ----------
    shape : {'plate', 'box', 'tube', 'ring'}
        Shape of the part: plate (width x height), box (width x height x length, open at +z), tube (diameter, length,
        open at both ends) or ring (diameter, with a round hole).
    body : str
        Path of the body that carries the part.
    position : tuple[float, float, float]
        Position in that body's frame, in metres: the centre of a plate, of a ring, of a box's bottom or of a tube's
        lower end.
    rotate : tuple[float, float, float]
        Rotation vector in that body's frame, in radians. Without rotation, plates are perpendicular to z, and boxes and
        tubes extend along z.
    width : float | None
        Size along x, in metres, of a plate or a box.
    height : float | None
        Size along y, in metres, of a plate or a box.
    length : float | None
        Size along z, in metres, of a box or a tube.
    diameter : float | None
        Outer diameter of a tube or a ring, in metres.
    hole : float | None
        Diameter of the round hole in a ring, in metres.
    """

    shape: Literal["plate", "box", "tube", "ring"]
    body: Annotated[str, Field(strict=True, min_length=1)]
    position: Vector3
    rotate: Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="360 deg"))] = (0.0, 0.0, 0.0)
    width: Size | None = None
    height: Size | None = None
    length: Size | None = None
    diameter: Size | None = None
    hole: Size | None = None

    @model_validator(mode="after")
    def _has_its_sizes(self) -> BaffleSpec:
        for name in ("width", "height", "length", "diameter", "hole"):
            present, needed = getattr(self, name) is not None, name in _NEEDS[self.shape]
            if present != needed:
                what = "needs" if needed else "has no"
                allowed = f"for a {self.shape}: {', '.join(_NEEDS[self.shape])}"
                raise Problem(f"a {self.shape} {what} {name}", "it" if present else "nothing", allowed, within=(name,))
        if self.shape == "ring" and not self.hole < self.diameter:  # type: ignore[operator]
            problem = "the hole is not smaller than the ring"
            raise Problem(problem, f"{self.hole:g} m", "a smaller hole", within=("hole",))
        return self

    def plates(self, name: str) -> tuple[Plate, ...]:
        """Return the baffle as flat plates that all have the given name."""
        pose = Pose(rotation_matrix(self.rotate), self.position)  # type: ignore[arg-type]
        width, height, length = self.width or 0.0, self.height or 0.0, self.length or 0.0
        radius = 0.5 * (self.diameter or 0.0)
        match self.shape:
            case "box":
                return box(name, self.body, pose, (width, height, length))
            case "tube":
                return tube(name, self.body, pose, radius, length)
            case "ring":
                return ring(name, self.body, pose, 0.5 * (self.hole or 0.0), radius)
            case "plate":
                return (Plate(name, self.body, pose, Rectangle(0.5 * width, 0.5 * height)),)
            case _:
                assert_never(self.shape)


Shape = Literal["circle", "rectangle", "ellipse", "ray", "polygon"]
Half = Annotated[tuple[float, float], Vector(Quantity(LENGTH, above_zero=True), 2)]
SIZES: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = FrozenMap(
    {
        "circle": (("radius",), ("inner",)),
        "rectangle": (("half",), ("rotation",)),
        "ellipse": (("half",), ("rotation",)),
        "ray": (("width",), ("rotation",)),
        "polygon": (("corners",), ()),
    }
)
"""Shape -> its required sizes and its optional ones; every shape but a polygon may also have a centre."""


class SurfaceEdgeSpec(Spec):
    """Edge of an optical surface, in the surface's own x and y.

    Either ``clear`` or ``blocks`` has its shape; the keys below are its sizes.

    Attributes
    ----------
    clear : {'circle', 'rectangle', 'ellipse', 'ray', 'polygon'} | None
        Shape that transmits light inside and blocks it outside.
    blocks : {'circle', 'rectangle', 'ellipse', 'ray', 'polygon'} | None
        Shape that blocks light inside.
    centre : tuple[float, float] | None
        Centre of the shape, in metres; of a ray the middle of its start. By default the surface's vertex.
    radius : float | None
        Radius of a circle, in metres.
    inner : float | None
        Radius of the hole in a circle, in metres; by default no hole.
    half : tuple[float, float] | None
        Half widths of a rectangle or an ellipse along x and y, in metres.
    width : float | None
        Width of a ray, a vane that extends without end along x before its rotation, in metres.
    rotation : float | None
        Rotation of a rectangle, an ellipse or a ray about its centre, right-handed about the surface's z, in radians;
        zero by default.
    corners : tuple[tuple[float, float], ...] | None
        Corners of a polygon in sequence, in metres.
    """

    clear: Shape | None = None
    blocks: Shape | None = None
    centre: Vector2 | None = None
    radius: PositiveLength | None = None
    inner: PositiveLength | None = None
    half: Half | None = None
    width: PositiveLength | None = None
    rotation: Annotated[float, Quantity(ANGLE, largest="360 deg")] | None = None
    corners: Annotated[tuple[Vector2, ...], Field(min_length=3, max_length=1000)] | None = None

    @model_validator(mode="after")
    def _one_shape_with_its_sizes(self) -> SurfaceEdgeSpec:
        require_one(self, ("clear", "blocks"), "an edge is clear or blocks", "clear: SHAPE, or blocks: SHAPE")
        needed, possible = SIZES[self.shape]
        centred = () if self.shape == "polygon" else ("centre",)
        for name in ("centre", "radius", "inner", "half", "width", "rotation", "corners"):
            present = getattr(self, name) is not None
            if present and name not in (*needed, *possible, *centred):
                names = ", ".join((*needed, *possible, *centred))
                raise Problem(f"a {self.shape} has no {name}", name, names, within=(name,))
            if name in needed and not present:
                raise Problem(f"a {self.shape} needs its {name}", "nothing", name)
        if self.radius is not None and self.inner is not None and not self.inner < self.radius:
            raise Problem("the hole is not within the circle", allowed="inner less than radius", within=("inner",))
        return self

    @property
    def shape(self) -> str:
        """Shape of the edge, such as ``circle``, whether it transmits or blocks light inside."""
        return self.clear or self.blocks or ""

    def to_edge(self) -> Edge:
        """Return the edge that the ray trace uses."""
        centre = self.centre or (0.0, 0.0)
        shape: EdgeShape
        if self.radius is not None:
            shape = Circle(self.radius, centre, self.inner or 0.0)
        elif self.half is not None:
            shape = (Rectangle if self.shape == "rectangle" else Ellipse)(*self.half, centre)
        elif self.width is not None:
            shape = Ray(self.width, centre)
        else:
            shape = Polygon(self.corners or ())
        return Edge(shape, self.blocks is not None, self.rotation or 0.0)
