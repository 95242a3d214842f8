"""Kinds of telescopes of which `optics.camera.telescopes.first_design` makes a first design; help texts list them."""

import math
from dataclasses import dataclass

KORSCH = ((-2.5 / 6, -0.9375 / 6), (-2.5 / 18, 2.39583333333333 / 6), (-1.25 / 6, -1.375 / 6))
"""Radius and distance to the next vertex, in focal lengths, of three mirrors: flat Petzval surface, F/2.5 at F/12."""
OFF_AXIS = ((-2.14706, -0.416667), (-0.706952, 0.416667), (-1.050288, -0.945003))
"""Radii and distances, like ``KORSCH``, with the stop at the secondary, a flat field and a far exit pupil.

The vertices of the first and the third mirror coincide.
"""
OFF_AXIS_BIAS = math.radians(55.2)
"""Field angle of the off-axis layout times its F-number, radians: beams and mirrors pass beside each other."""


@dataclass(frozen=True)
class TelescopeType:
    """Kind of telescope that `first_design` makes.

    Attributes
    ----------
    title : str
        Name for the description of a camera.
    conics : tuple of float or None
        Conic constant of each mirror; None where a Seidel sum determines it.
    ratios : tuple, optional
        Radii and distances of three mirrors in focal lengths; without them the layout is that of one or two mirrors.
    bias : float
        Angle of the field's middle from the axis times the F-number, radians.
    stop : int
        Index of the surface that is the stop.
    lenses : bool
        Whether it is a triplet of lenses.
    """

    title: str
    conics: tuple[float | None, ...]
    ratios: tuple[tuple[float, float], ...] = ()
    bias: float = 0.0
    stop: int = 0
    lenses: bool = False


TELESCOPES = {
    "prime-focus": TelescopeType("Paraboloid with its prime focus", (None,)),
    "cassegrain": TelescopeType("Classical Cassegrain telescope", (-1.0, None)),
    "dall-kirkham": TelescopeType("Dall-Kirkham telescope", (None, 0.0)),
    "ritchey-chretien": TelescopeType("Ritchey-Chretien telescope", (None, None)),
    "korsch": TelescopeType("Three-mirror anastigmat after Korsch", (None, None, None), KORSCH, math.radians(6.0)),
    "off-axis": TelescopeType("Off-axis three-mirror anastigmat", (None,) * 3, OFF_AXIS, OFF_AXIS_BIAS, 1),
    "triplet": TelescopeType("Cooke triplet of lenses", (), stop=3, lenses=True),
}
"""Kinds of telescopes by name."""
