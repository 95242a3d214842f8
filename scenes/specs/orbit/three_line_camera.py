"""Three-line camera with refractive lenses: an ideal projection with distortion for each line.

No prescription is needed: a line is defined by its interior orientation (principal point, principal distance, radial
distortion) and by its mounting on the base. The files are in scenes/library/payloads.
"""

from typing import Annotated

from pydantic import Field, model_validator

from scenes.specs.course import Rotation
from scenes.specs.detector import PixelPitch
from scenes.specs.instrument import LookAngle
from scenes.specs.orbit.scene import LineImageSpec
from scenes.yaml.errors import Problem
from scenes.yaml.spec import Named, Spec, TitledSpec, Whole, not_empty
from scenes.yaml.unit_fields import PositiveLength, Quantity, Vector, Vector2, Vector3
from scenes.yaml.units import ANGLE, LENGTH, Kind

_PER_LENGTH2 = Kind("an inverse length squared", "1/m^2", ("1/m^2", "1/mm^2"), "0.02 1/m^2")
_PER_LENGTH4 = Kind("an inverse length to the fourth", "1/m^4", ("1/m^4", "1/mm^4"), "1 1/m^4")
LookCoefficient = Annotated[float, Quantity(ANGLE, largest="60 deg")]
LookAngles = Annotated[tuple[LookCoefficient, ...], Field(min_length=1, max_length=10)]
LongestLine = Annotated[Whole, Field(ge=2, le=1_000_000)]


class CcdSpec(Spec):
    """Position or look angles of one CCD of a line that consists of several.

    The position, ``shift`` and ``rotate``, is relative to that of the same pixels on a straight line with the payload's
    pitch. Look angles, ``psi_x`` and ``psi_y``, are coefficients c0, c1, ... of c0 + c1 s + c2 s^2 + ... of the pixel's
    number s, counted from 0 on the whole line; the look is along (tan psi_x, tan psi_y, 1) in the camera's axes. They
    hold for the line's principal_distance and principal_point, relative to which changes are counted, and include the
    distortion.

    Attributes
    ----------
    first : int
        First pixel of the CCD, counted from 0 on the whole line.
    last : int
        Last pixel of the CCD, which still belongs to it.
    shift : tuple[float, float]
        Shift x (flight) and y (along the line) in the focal plane, in metres.
    rotate : float
        Rotation about the line of sight, from +x toward +y, about the CCD's centre, in radians.
    psi_x : tuple[float, ...] | None
        Coefficients of the forward look angle, in radians, radians per pixel, per pixel^2, ...
    psi_y : tuple[float, ...] | None
        Coefficients of the look angle to the right, in radians, radians per pixel, per pixel^2, ...
    """

    first: Annotated[Whole, Field(ge=0)]
    last: Annotated[Whole, Field(ge=0)]
    shift: Annotated[tuple[float, float], Vector(Quantity(LENGTH, largest="50 mm"), 2)] = (0.0, 0.0)
    rotate: Annotated[float, Quantity(ANGLE, largest="1 deg")] = 0.0
    psi_x: LookAngles | None = None
    psi_y: LookAngles | None = None

    @model_validator(mode="after")
    def _check_single_specification(self) -> "CcdSpec":
        if self.last <= self.first:
            raise Problem("a CCD of one pixel or none", f"{self.first} to {self.last}", "a last pixel after the first")
        if (self.psi_x is None) != (self.psi_y is None):
            raise Problem("look angles along one axis only", None, "both psi_x and psi_y")
        if self.psi_x is not None and (any(self.shift) or self.rotate):
            raise Problem("both look angles and a position", None, "psi_x and psi_y, or shift and rotate")
        return self


class LineCameraSpec(Spec):
    """Line camera: its interior orientation and its mounting on the base.

    The image is the real one, behind the lens: a point of the line at +y sees the scene at -Y. Its line of sight in the
    camera's axes is along (-(x - x0)(1 + d), -(y - y0)(1 + d), f), where (x, y) is the point on the focal plane, (x0,
    y0) the principal point, f the principal distance, and d = k1 r^2 + k2 r^4 the distortion at the distance r from the
    principal point. Positive d means that the point looks further out than an ideal projection (Brown, Photogramm. Eng.
    37(8), 1971: the term is added to the measured coordinates).

    Attributes
    ----------
    look : float
        Look angle: angle of the camera's Z from the base's +Z about the base's Y, positive forward (toward +X), in
        radians.
    rotate : tuple[float, float, float]
        Misalignment: rotation vector in the camera's axes after the look angle, in radians.
    position : tuple[float, float, float]
        Position of the projection centre in the base frame, in metres.
    principal_distance : float
        Principal distance f, in metres.
    principal_point : tuple[float, float]
        Principal point, where the camera's Z meets the focal plane: x (flight) and y (along the line) from the line's
        centre, in metres.
    k1 : float
        Radial distortion of third order, in 1/m^2.
    k2 : float
        Radial distortion of fifth order, in 1/m^4.
    pixels : int | None
        Number of pixels; by default that of the payload.
    pitch : float | None
        Pixel pitch, in metres; by default that of the payload.
    image : LineImageSpec | None
        Image formation and recording; by default that of the payload.
    ccds : tuple[CcdSpec, ...]
        CCDs of the line, from pixel 0 on; by default a single straight line.
    """

    look: LookAngle
    rotate: Rotation = (0.0, 0.0, 0.0)
    position: Vector3 = (0.0, 0.0, 0.0)
    principal_distance: PositiveLength
    principal_point: Vector2 = (0.0, 0.0)
    k1: Annotated[float, Quantity(_PER_LENGTH2, largest="100 1/m^2")] = 0.0
    k2: Annotated[float, Quantity(_PER_LENGTH4, largest="1e5 1/m^4")] = 0.0
    pixels: LongestLine | None = None
    pitch: PixelPitch | None = None
    image: LineImageSpec | None = None
    ccds: tuple[CcdSpec, ...] = ()

    @property
    def by_look_angles(self) -> bool:
        """True if a CCD of the line is defined by look angles."""
        return any(ccd.psi_x is not None for ccd in self.ccds)

    @model_validator(mode="after")
    def _is_distorted_once(self) -> "LineCameraSpec":
        if self.by_look_angles and (self.k1 or self.k2):
            problem = "look angles already include the distortion"
            raise Problem(problem, f"k1 {self.k1:g} 1/m^2, k2 {self.k2:g} 1/m^4", "neither", within=("k1",))
        return self


class ThreeLineCameraSpec(TitledSpec):
    """Payload of a three-line mapping satellite.

    Attributes
    ----------
    pixels : int
        Number of pixels of each line without an entry; pixel 0 is at the line's -y end.
    pitch : float
        Pixel pitch of each line without an entry, in metres.
    lines : Mapping[str, LineCameraSpec]
        Name -> line camera; usually forward, nadir and backward, in the order in which they image a point on the
        ground, then others such as a high-resolution and a multispectral one.
    image : LineImageSpec | None
        Image formation and recording of each line without an entry; only needed for rendering.
    """

    pixels: LongestLine
    pitch: PixelPitch
    lines: Annotated[Named[LineCameraSpec], not_empty("no lines", "at least one line camera")]
    image: LineImageSpec | None = None

    @model_validator(mode="after")
    def _ccds_make_lines(self) -> "ThreeLineCameraSpec":
        for name, line in self.lines.items():
            following = 0
            for k, ccd in enumerate(line.ccds):
                if ccd.first != following:
                    value = f"pixel {ccd.first} where {following} is the next"
                    allowed = "each pixel of the line on one CCD, in order"
                    key = ("lines", name, "ccds", k, "first")
                    raise Problem("CCDs leave a gap or overlap", value, allowed, within=key)
                following = ccd.last + 1
            if line.ccds and following != self.pixels_of(name):
                value = f"{following} pixels of {self.pixels_of(name)}"
                allowed = "each pixel on one CCD"
                raise Problem("CCDs do not make up the line", value, allowed, within=("lines", name, "ccds"))
        return self

    def pixels_of(self, line: str) -> int:
        """Return the number of pixels of a line. Raises KeyError if there is no such line."""
        return self.lines[line].pixels or self.pixels

    def pitch_of(self, line: str) -> float:
        """Return the pixel pitch of a line, in metres. Raises KeyError if there is no such line."""
        return self.lines[line].pitch or self.pitch

    def image_of(self, line: str) -> LineImageSpec | None:
        """Return the image formation of a line; None if it is not defined. Raises KeyError if there is no such line."""
        return self.lines[line].image or self.image
