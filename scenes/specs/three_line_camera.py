"""A three-line camera of refractive lenses: one ideal projection with distortion for each line, as a file in
scenes/library/payloads gives it.

No prescription is needed: a line is known by its interior orientation (principal point, principal distance, radial
distortion) and by how it is mounted on the base.
"""

from typing import Annotated

from pydantic import AfterValidator, Field

from scenes.specs.detector import PixelPitch
from scenes.specs.instrument import LookAngle
from scenes.specs.orbit_scene import LineImageSpec
from scenes.yaml.errors import Problem
from scenes.yaml.quantity import PositiveLength, Quantity, Vector, Vector2, Vector3
from scenes.yaml.spec import Name, Named, Spec, Text, Whole
from scenes.yaml.units import ANGLE, Kind

_PER_LENGTH2 = Kind("an inverse length squared", "1/m^2", ("1/m^2", "1/mm^2"), "0.02 1/m^2")
_PER_LENGTH4 = Kind("an inverse length to the fourth", "1/m^4", ("1/m^4", "1/mm^4"), "1 1/m^4")
Distortion3 = Annotated[float, Quantity(_PER_LENGTH2, largest="100 1/m^2")]
Distortion5 = Annotated[float, Quantity(_PER_LENGTH4, largest="1e5 1/m^4")]
Misalignment = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="5 deg"))]
LongestLine = Annotated[Whole, Field(ge=2, le=1_000_000)]


class LineCameraSpec(Spec):
    """One line camera: its interior orientation and how it stands on the base.

    The image is the real one, behind the lens: a point of the line at +y sees the scene at -Y. Its look in the camera's
    axes is along (-(x - x0)(1 + d), -(y - y0)(1 + d), f) with d = k1 r^2 + k2 r^4, r from the principal point. Positive
    d means that the point looks further out than an ideal projection (Brown, Photogramm. Eng. 37(8), 1971: the term is
    added to the measured coordinates).

    Attributes:
        look: angle of the camera's Z from the base's +Z, about the base's Y, positive forward (toward +X), radians.
        rotate: misalignment, a rotation vector in the camera's own axes after the look, radians.
        position: of the projection centre in the base frame, metres.
        focal_length: principal distance f, metres.
        principal_point: where the camera's Z meets the focal plane, x (flight) and y (along the line) from the line's
            centre, metres.
        k1: radial distortion of third order, 1/m^2.
        k2: radial distortion of fifth order, 1/m^4.
        pixels: how many; None for as many as the payload says.
        pitch: of its pixels, metres; None for the payload's.
        image: how it forms and records its image; None for the payload's.
    """

    look: LookAngle
    rotate: Misalignment = (0.0, 0.0, 0.0)
    position: Vector3 = (0.0, 0.0, 0.0)
    focal_length: PositiveLength
    principal_point: Vector2 = (0.0, 0.0)
    k1: Distortion3 = 0.0
    k2: Distortion5 = 0.0
    pixels: LongestLine | None = None
    pitch: PixelPitch | None = None
    image: LineImageSpec | None = None


def _some_lines(lines: Named[LineCameraSpec]) -> Named[LineCameraSpec]:
    if not lines:
        raise Problem("no lines", "an empty mapping", "at least one line camera")
    return lines


class ThreeLineCameraSpec(Spec):
    """The payload of a three-line mapping satellite.

    Attributes:
        name: as the file is called.
        description: for people.
        pixels: of each line that does not say its own; pixel 0 is at its -y end.
        pitch: of their pixels, metres.
        lines: by name; normally forward, nadir and aft, in the order in which they see a point on the ground, then
            others such as a high-resolution and a multispectral one.
        image: how lines that do not say it themselves form and record their images; only rendering needs it.
    """

    name: Name
    description: Text = ""
    pixels: LongestLine
    pitch: PixelPitch
    lines: Annotated[Named[LineCameraSpec], AfterValidator(_some_lines)]
    image: LineImageSpec | None = None

    def pixels_of(self, line: str) -> int:
        """How many pixels a line has. KeyError if there is no such line."""
        return self.lines[line].pixels or self.pixels

    def pitch_of(self, line: str) -> float:
        """Pitch of a line's pixels, metres. KeyError if there is no such line."""
        return self.lines[line].pitch or self.pitch

    def image_of(self, line: str) -> LineImageSpec | None:
        """How a line forms its image; None if neither it nor the payload says so. KeyError if there is no such line."""
        return self.lines[line].image or self.image
