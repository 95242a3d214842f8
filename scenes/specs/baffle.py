"""What cuts light beside the stop: baffles (plates, boxes, tubes and rings) as an instrument's file gives them, and
edges of surfaces as a camera's does.
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
from scenes.yaml.spec import Spec, one_given
from scenes.yaml.unit_fields import PositiveLength, Quantity, Vector, Vector2, Vector3
from scenes.yaml.units import ANGLE, LENGTH

TUBE_SIDES = 24


@dataclass(frozen=True)
class Plate:
    """A flat plate of no thickness.

    Attributes
    ----------
    name : str
        Of the part it belongs to; plates of one name are one part in the results.
    body : str
        Path of the body that carries it.
    pose : Pose
        Of the plate in that body's frame.
    outline : Circle | Rectangle
        Its edge in the plate's x, y; a ring has a hole.
    finish : Finish
        Of both sides.
    """

    name: str
    body: str
    pose: Pose
    outline: Circle | Rectangle
    finish: Finish = BLACK


def box(name: str, body: str, pose: Pose, size: tuple[float, float, float]) -> tuple[Plate, ...]:
    """A box, open at +z, whose bottom's middle is the pose's origin and whose walls rise along +z.

    Parameters
    ----------
    name : str
        Of the part.
    body : str
        Path of the body that carries it.
    pose : Pose
        In that body's frame.
    size : tuple[float, float, float]
        Along x, y, z, metres.
    """
    x, y, z = (0.5 * s for s in size)

    def wall(axis: int, angle: float, place: tuple[float, float, float], half: tuple[float, float]) -> Plate:
        inner = Pose(about_axis(axis, angle), np.array(place))
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
    """A tube along +z from the pose's origin, open at both ends, of flat sides that touch the circle of ``radius``."""
    half = radius * float(np.tan(np.pi / TUBE_SIDES))
    plates = []
    for k in range(TUBE_SIDES):
        turn = about_axis(2, 2.0 * np.pi * k / TUBE_SIDES)
        # the plate's z points to the axis, its x along the tube
        inner = Pose(turn @ about_axis(1, -0.5 * np.pi), turn @ np.array([radius, 0.0, 0.5 * length]))
        plates.append(Plate(name, body, pose @ inner, Rectangle(0.5 * length, half)))
    return tuple(plates)


def ring(name: str, body: str, pose: Pose, inner: float, outer: float) -> tuple[Plate, ...]:
    """A flat stop with a round hole; radii in metres."""
    return (Plate(name, body, pose, Circle(outer, inner=inner)),)


Size = Annotated[float, Quantity(LENGTH, above_zero=True, largest="10 m")]
_NEEDS = {"plate": ("width", "height"), "box": ("width", "height", "length"), "tube": ("diameter", "length"),
          "ring": ("hole", "diameter")}  # fmt: skip


class BaffleSpec(Spec):
    """A black mechanical part. The wave path does not see it; the path tracer, scene.glb and the picture do.

    Attributes
    ----------
    shape : Literal['plate', 'box', 'tube', 'ring']
        Plate (width x height), box (width x height x length, open at +z), tube (diameter, length, open at both ends) or
        ring (diameter, with a round hole).
    body : str
        Path of the body that carries it.
    position : Vector3
        In that body's frame, metres: the middle of a plate, a ring, a box's bottom or a tube's lower end.
    rotate : tuple[float, float, float]
        Rotation vector in that frame, radians; plates stand square to z, boxes and tubes run along z.
    width : Size | None
        Along x, metres.
    height : Size | None
        Along y, metres.
    length : Size | None
        Along z, metres.
    diameter : Size | None
        metres.
    hole : Size | None
        Diameter, metres.
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
            given, needed = getattr(self, name) is not None, name in _NEEDS[self.shape]
            if given != needed:
                what = "needs" if needed else "has no"
                allowed = f"for a {self.shape}: {', '.join(_NEEDS[self.shape])}"
                raise Problem(f"a {self.shape} {what} {name}", "it" if given else "nothing", allowed, within=(name,))
        if self.shape == "ring" and not self.hole < self.diameter:  # type: ignore[operator]
            problem = "the hole is not smaller than the ring"
            raise Problem(problem, f"{self.hole:g} m", "a smaller hole", within=("hole",))
        return self

    def plates(self, name: str) -> tuple[Plate, ...]:
        """The part as flat plates of that name."""
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
        "rectangle": (("half",), ("turn",)),
        "ellipse": (("half",), ("turn",)),
        "ray": (("width",), ("turn",)),
        "polygon": (("corners",), ()),
    }
)
"""Shape -> the sizes that it needs, and those that it may have; all but a polygon may have a centre."""


class SurfaceEdgeSpec(Spec):
    """An edge of a surface, in the surface's own x and y; one of ``clear`` and ``blocks`` says what it does.

    Attributes
    ----------
    clear : Shape | None
        Shape inside of which light comes through.
    blocks : Shape | None
        Shape inside of which light is stopped.
    centre : Vector2 | None
        Of the shape; of a ray the middle of its beginning; metres.
    radius : PositiveLength | None
        Of a circle, metres.
    inner : PositiveLength | None
        Of a circle, radius of the hole in it, metres.
    half : Half | None
        Of a rectangle or an ellipse, half its width along x and along y, metres.
    width : PositiveLength | None
        Of a ray, a vane that runs without end along x before it is turned, metres.
    turn : float | None
        Of rectangle, ellipse or ray about its centre, right-handed about the surface's z, radians.
    corners : tuple[Vector2, ...] | None
        Of a polygon, one after the other, metres.
    """

    clear: Shape | None = None
    blocks: Shape | None = None
    centre: Vector2 | None = None
    radius: PositiveLength | None = None
    inner: PositiveLength | None = None
    half: Half | None = None
    width: PositiveLength | None = None
    turn: Annotated[float, Quantity(ANGLE, largest="360 deg")] | None = None
    corners: Annotated[tuple[Vector2, ...], Field(min_length=3, max_length=1000)] | None = None

    @model_validator(mode="after")
    def _one_shape_with_its_sizes(self) -> SurfaceEdgeSpec:
        one_given(self, ("clear", "blocks"), "an edge is clear or blocks", "clear: SHAPE, or blocks: SHAPE")
        needed, possible = SIZES[self.shape]
        places = () if self.shape == "polygon" else ("centre",)
        for name in ("centre", "radius", "inner", "half", "width", "turn", "corners"):
            given = getattr(self, name) is not None
            if given and name not in (*needed, *possible, *places):
                names = ", ".join((*needed, *possible, *places))
                raise Problem(f"a {self.shape} has no {name}", name, names, within=(name,))
            if name in needed and not given:
                raise Problem(f"a {self.shape} needs its {name}", "nothing", name)
        if self.radius is not None and self.inner is not None and not self.inner < self.radius:
            raise Problem("the hole is not within the circle", allowed="inner less than radius", within=("inner",))
        return self

    @property
    def shape(self) -> str:
        """The kind of shape."""
        return self.clear or self.blocks or ""

    def to_edge(self) -> Edge:
        """What cuts the light."""
        centre = self.centre or (0.0, 0.0)
        made: EdgeShape
        if self.radius is not None:
            made = Circle(self.radius, centre, self.inner or 0.0)
        elif self.half is not None:
            made = (Rectangle if self.shape == "rectangle" else Ellipse)(*self.half, centre)
        elif self.width is not None:
            made = Ray(self.width, centre)
        else:
            made = Polygon(self.corners or ())
        return Edge(made, self.blocks is not None, self.turn or 0.0)
