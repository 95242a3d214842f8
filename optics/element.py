"""An optical element: a surface on a body, what light does there, and its clear aperture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

from optics.aperture import Aperture
from optics.surface import Surface


class Interaction(Enum):
    """What happens to a ray at a surface."""

    REFLECT = "reflect"
    REFRACT = "refract"
    PASS = "pass"
    TOTAL = "total"
    """Total reflection inside glass; a ray that is not beyond the critical angle is lost."""


@dataclass(frozen=True)
class Element:
    """One surface in the assembly.

    Attributes:
        name: unique name, e.g. ``forward/M1``.
        body: path of the rigid body that carries it; the surface's frame is the body's frame.
        surface: its shape.
        interaction: reflect, refract or pass.
        aperture: clear aperture in the surface's x, y; None is unlimited.
        index_after: refractive index on the side the light goes to (the index before is that of the element before
            it); for surfaces that are not faces of a solid.
        solid: path of the glass body whose face this is, behind it (on its -z side). A refracted ray enters it when it
            comes from outside and leaves it when it comes from inside; the index is the assembly's for that solid.
    """

    name: str
    body: str
    surface: Surface
    interaction: Interaction
    aperture: Aperture | None = None
    index_after: float = 1.0
    solid: str | None = None

    def with_aperture(self, aperture: Aperture | None) -> Element:
        """The same element with another aperture."""
        return replace(self, aperture=aperture)
