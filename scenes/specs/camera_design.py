"""What is to be optimised of a camera's prescription, and under which constraints."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from scenes.yaml.errors import Problem
from scenes.yaml.quantity import Length, Quantity
from scenes.yaml.spec import Name, Named, Reference, Seed, Spec, Text, Whole
from scenes.yaml.units import SCALE

IMAGE = "image"
Vary = Literal["radius", "conic", "A4", "A6", "A8", "z"]


class CameraDesignSpec(Spec):
    """What is to be optimised.

    The focal length along the line, the entrance pupil, the field and its bias stay as they are.

    Attributes:
        camera: prescription to start from, by name or path.
        name: of the new camera.
        description: of the new camera, for people.
        vary: mirror, or ``image`` -> what of it varies.
        envelope: extent along the parent axis over all mirrors and the image, relative to the start's; the largest.
        clearance: least distance of every beam, in the plane of symmetry, from the edge of every mirror and of the
            focal plane that it passes, metres.
        anamorphism: by how much the focal length along the line may differ from that across it, a share of the latter;
            free where it is left out.
        steps: in which the envelope is brought from the start's to the goal's.
        starts: how many: the camera itself with the envelope shortened in steps, the same at once, and others drawn
            about it. One start finds one local optimum.
        seed: of the starts that are drawn.
    """

    camera: Reference
    name: Name
    description: Text = ""
    vary: Annotated[Named[tuple[Vary, ...]], Field(min_length=1)]
    envelope: Annotated[float, Quantity(SCALE, above_zero=True, largest="200 percent")] | None = None
    clearance: Length = 0.02
    anamorphism: Annotated[float, Quantity(SCALE, above_zero=True, largest="100 percent")] | None = None
    steps: Annotated[Whole, Field(ge=1, le=100)] = 8
    starts: Annotated[Whole, Field(ge=1, le=1000)] = 2
    seed: Seed = 0

    @model_validator(mode="after")
    def _image_moves_only_along_z(self) -> "CameraDesignSpec":
        for name, quantities in self.vary.items():
            wrong = [q for q in quantities if name == IMAGE and q != "z"]
            if wrong:
                raise Problem("the image is a plane", wrong[0], "z", within=("vary", name))
        return self
