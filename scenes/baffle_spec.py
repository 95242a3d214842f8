"""Baffles as an instrument's file gives them: black plates, boxes, tubes and rings for the path tracer."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from optics.aperture import Rectangle
from optics.pose import Pose
from optics.rotation import rotation_matrix
from scenes.baffle import Plate, box, ring, tube
from scenes.errors import Problem
from scenes.quantity import Quantity, Vector, Vector3
from scenes.spec import Spec
from scenes.units import ANGLE, LENGTH

Size = Annotated[float, Quantity(LENGTH, above_zero=True, largest="10 m")]
_NEEDS = {"plate": ("width", "height"), "box": ("width", "height", "length"), "tube": ("diameter", "length"),
          "ring": ("hole", "diameter")}  # fmt: skip


class BaffleSpec(Spec):
    """A black mechanical part. The wave path does not see it; the path tracer, scene.glb and the picture do.

    Attributes:
        shape: plate (width x height), box (width x height x length, open at +z), tube (diameter, length, open at both
            ends) or ring (diameter, with a round hole).
        body: path of the body that carries it.
        position: in that body's frame, metres: the middle of a plate, a ring, a box's bottom or a tube's lower end.
        rotate: rotation vector in that frame, radians; plates stand square to z, boxes and tubes run along z.
        width: along x, metres.
        height: along y, metres.
        length: along z, metres.
        diameter: metres.
        hole: diameter, metres.
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
    def _has_its_sizes(self) -> "BaffleSpec":
        for name in ("width", "height", "length", "diameter", "hole"):
            given, needed = getattr(self, name) is not None, name in _NEEDS[self.shape]
            if given != needed:
                what = "needs" if needed else "has no"
                allowed = f"for a {self.shape}: {', '.join(_NEEDS[self.shape])}"
                raise Problem(f"a {self.shape} {what} {name}", "it" if given else "nothing", allowed, within=(name,))
        if self.shape == "ring" and not self.hole < self.diameter:  # type: ignore[operator]
            raise Problem(
                "the hole is not smaller than the ring", f"{self.hole:g} m", "a smaller hole", within=("hole",)
            )
        return self

    def plates(self, name: str) -> tuple[Plate, ...]:
        """The part as flat plates of that name."""
        pose = Pose(rotation_matrix(self.rotate), self.position)  # type: ignore[arg-type]
        width, height, length = self.width or 0.0, self.height or 0.0, self.length or 0.0
        radius = 0.5 * (self.diameter or 0.0)
        if self.shape == "box":
            return box(name, self.body, pose, (width, height, length))
        if self.shape == "tube":
            return tube(name, self.body, pose, radius, length)
        if self.shape == "ring":
            return ring(name, self.body, pose, 0.5 * (self.hole or 0.0), radius)
        return (Plate(name, self.body, pose, Rectangle(0.5 * width, 0.5 * height)),)
