"""Edges of a camera's surfaces as its file gives them: what cuts light beside the stop."""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, model_validator

from optics.geometry.aperture import Circle, Ellipse, Rectangle
from optics.geometry.surface_edge import Edge, EdgeShape, Polygon, Ray
from optics.numerics.frozen_map import FrozenMap
from scenes.yaml.errors import Problem
from scenes.yaml.quantity import PositiveLength, Quantity, Vector, Vector2
from scenes.yaml.spec import Spec
from scenes.yaml.units import ANGLE, LENGTH

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

    Attributes:
        clear: shape inside of which light comes through.
        blocks: shape inside of which light is stopped.
        centre: of the shape; of a ray the middle of its beginning; metres.
        radius: of a circle, metres.
        inner: of a circle, radius of the hole in it, metres.
        half: of a rectangle or an ellipse, half its width along x and along y, metres.
        width: of a ray, a vane that runs without end along x before it is turned, metres.
        turn: of rectangle, ellipse or ray about its centre, right-handed about the surface's z, radians.
        corners: of a polygon, one after the other, metres.
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
    def _one_shape_with_its_sizes(self) -> "SurfaceEdgeSpec":
        if (self.clear is None) == (self.blocks is None):
            found = "neither" if self.clear is None else "both"
            raise Problem("an edge is clear or blocks", found, "clear: SHAPE, or blocks: SHAPE")
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
        """Its kind of shape."""
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
