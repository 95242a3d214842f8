"""Materials of mirrors and structures: the numbers that thermo-elastic models need, at room temperature."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from optics.frozen_map import FrozenMap
from optics.names import unknown_name


@dataclass(frozen=True)
class Material:
    """An isotropic material near 20 C.

    Attributes:
        name: as in the catalogue.
        expansion: linear thermal expansion (CTE), 1/K.
        density: kg/m^3.
        youngs_modulus: Pa.
        poisson_ratio: 1.
        conductivity: thermal, W/(m K).
        source: where the numbers come from.
    """

    name: str
    expansion: float
    density: float
    youngs_modulus: float
    poisson_ratio: float
    conductivity: float
    source: str

    def __post_init__(self) -> None:
        """Check that the numbers can be those of a solid."""
        if not (self.density > 0.0 and self.youngs_modulus > 0.0 and self.conductivity > 0.0):
            raise ValueError(f"{self.name}: density, Young's modulus and conductivity must be positive")
        if not -1.0 < self.poisson_ratio < 0.5:
            raise ValueError(f"{self.name}: Poisson's ratio must lie between -1 and 0.5, found {self.poisson_ratio}")

    @property
    def shear_modulus(self) -> float:
        """E / (2 (1 + nu)), Pa."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poisson_ratio))


_ALL = (
    Material(
        "Zerodur",
        0.0,
        2530.0,
        90.3e9,
        0.24,
        1.46,
        "Schott, ZERODUR catalogue; mean CTE 0 +- 0.05e-6/K (expansion class 1, 0..50 C), here its middle",
    ),
    Material(
        "fused silica",
        0.51e-6,
        2200.0,
        72.7e9,
        0.16,
        1.38,
        "Corning HPFS 7980 data sheet; CTE as in the Handbook of Optics",
    ),
    Material("N-BK7", 7.1e-6, 2510.0, 82.0e9, 0.206, 1.114, "Schott data sheet N-BK7; CTE of -30..70 C"),
    Material(
        "SiC", 2.2e-6, 3150.0, 420.0e9, 0.17, 180.0, "sintered SiC-100 (Boostec/Mersen) data sheet, room temperature"
    ),
    Material("Invar", 1.26e-6, 8050.0, 141.0e9, 0.259, 10.4, "Invar 36 as in Yoder, Opto-Mechanical Systems Design"),
    Material(
        "CFRP",
        0.1e-6,
        1650.0,
        110.0e9,
        0.30,
        35.0,
        "typical quasi-isotropic high-modulus laminate, in plane; a design value, real laminates range -1..1e-6/K",
    ),
    Material("aluminium", 23.6e-6, 2700.0, 68.9e9, 0.33, 167.0, "6061-T6, ASM Metals Handbook vol. 2"),
)
MATERIALS: Mapping[str, Material] = FrozenMap({m.name: m for m in _ALL})
"""The catalogue, by name."""


def material(name: str) -> Material:
    """The catalogue's material of that name; a case-insensitive match is enough, and BK7 is N-BK7.

    Raises:
        KeyError: unknown, with the nearest name.
    """
    wanted = {"bk7": "n-bk7", "aluminum": "aluminium"}.get(name.lower(), name.lower())
    for known, entry in MATERIALS.items():
        if known.lower() == wanted:
            return entry
    raise unknown_name("material", name, MATERIALS)
