"""The monitor's prisms as an instrument's file gives them."""

from typing import Annotated

from pydantic import AfterValidator, Field

from optics.frozen_map import FrozenMap
from optics.glass import GLASSES, glass
from scenes.errors import Problem, names_text, nearest, shown
from scenes.quantity import PositiveLength, Quantity, Vector, Vector3
from scenes.spec import Name, NothingIsEmpty, Spec, name_in
from scenes.units import ANGLE, LENGTH

Tilt = Annotated[tuple[float, float], Vector(Quantity(ANGLE, largest="1 deg"), 2)]


GlassName = Annotated[str, Field(strict=True), name_in("glass", GLASSES, glass)]
"""A glass of the catalogue in optics/glass.py."""


PRISM_180_FACES = ("window", "mirror", "roof_a", "roof_b")
PRISM_0_FACES = ("entry", "mirror_a", "mirror_b", "exit")


def _faces_of(known: tuple[str, ...]) -> AfterValidator:
    """Refuse angle errors of faces that a prism does not have."""

    def check(errors: dict[str, tuple[float, float]]) -> FrozenMap[str, tuple[float, float]]:
        for name in errors:
            if name not in known:
                raise Problem("no such face", shown(name), names_text(known), nearest(name, known), (name,))
        return FrozenMap(errors)

    return AfterValidator(check)


class Prism180Spec(Spec):
    """The lateral-transfer prism: three mutually perpendicular faces send the beam back parallel to itself.

    Attributes:
        material: its glass.
        distance: from the camera's origin to its window, along the line of sight, metres.
        width: of the clear apertures across the beam, metres; somewhat more than the return face's.
        tilt: turn about its own x and y from where its faces stand square to the beam, about its null point, radians.
            It leaves the beam's direction alone and sends the reflections off its faces past the area CCD.
        angle_errors: face -> tilt about the face's own x and y, radians, as made. Faces: window, mirror, roof_a,
            roof_b.
    """

    material: GlassName
    distance: PositiveLength
    width: PositiveLength
    tilt: Tilt = (0.0, 0.0)
    angle_errors: Annotated[dict[Name, Tilt], NothingIsEmpty, _faces_of(PRISM_180_FACES)] = Field(
        default_factory=FrozenMap
    )


class Prism0Spec(Spec):
    """The rhomboid: two parallel reflecting faces displace the beam and keep its direction.

    Attributes:
        material: its glass.
        distance: from the return face to its centre, along the beam, metres.
        shift: by how much it displaces the beam, toward the central prism, metres.
        width: of the clear apertures across the beam, metres.
        tilt: turn about its own x and y from where its faces stand square to the beam, about its middle, radians.
        angle_errors: face -> tilt, as for the 180-deg prism. Faces: entry, mirror_a, mirror_b, exit.
    """

    material: GlassName
    distance: PositiveLength
    shift: PositiveLength
    width: PositiveLength
    tilt: Tilt = (0.0, 0.0)
    angle_errors: Annotated[dict[Name, Tilt], NothingIsEmpty, _faces_of(PRISM_0_FACES)] = Field(
        default_factory=FrozenMap
    )


class CentralPrismSpec(Spec):
    """The central prism, the common reference of all cameras: a block with one mirror facet per channel, which meet in
    its apex.

    Attributes:
        position: of the apex in the base frame, metres.
        material: of the block.
        spread: how far from the apex the beams meet their facets, along the base's X and Y, metres.
        height: of the block below the apex, metres.
    """

    position: Vector3
    material: GlassName
    spread: Annotated[tuple[float, float], Vector(Quantity(LENGTH, above_zero=True, largest="10 m"), 2)]
    height: PositiveLength
