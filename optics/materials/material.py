"""Structural and optical materials near room temperature: properties for thermo-elastic models, with their sources.

"Checked" in a source means that the number was compared with the named source again; the others are as quoted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches

from optics.numerics.number_tree import FrozenMap


class UnknownNameError(KeyError, ValueError):
    """Name that is not in a catalogue; the message lists the names that are allowed."""

    __str__ = ValueError.__str__


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """Return the error for an unknown name, whose message gives the nearest known name and lists all known ones.

    ``kind`` says what is named, e.g. a glass.
    """
    names = sorted(known)
    by_lower = {n.lower(): n for n in names}
    near = get_close_matches(name.lower(), by_lower, n=1, cutoff=0.4)
    hint = f"; did you mean {by_lower[near[0]]!r}?" if near else ""
    return UnknownNameError(f"unknown {kind} {name!r}{hint} (known: {', '.join(names)})")


ZERO_CELSIUS = 273.15
"""Temperature of 0 C, in kelvin."""


@dataclass(frozen=True)
class TemperatureRange:
    """Range of temperatures for which a material's data are valid.

    Attributes
    ----------
    coldest, hottest : float
        Ends of the range, kelvin.
    source : str
        Reason for these limits.
    """

    coldest: float
    hottest: float
    source: str

    @classmethod
    def celsius(cls, coldest: float, hottest: float, source: str) -> TemperatureRange:
        """Return the range between two temperatures in degrees Celsius."""
        return cls(ZERO_CELSIUS + coldest, ZERO_CELSIUS + hottest, source)

    def holds(self, coldest: float, hottest: float) -> bool:
        """Return True when the range from ``coldest`` to ``hottest`` (kelvin) lies inside."""
        return self.coldest <= coldest and hottest <= self.hottest

    @property
    def text(self) -> str:
        """Range as text, in kelvin and degrees Celsius."""
        low, high = self.coldest - ZERO_CELSIUS, self.hottest - ZERO_CELSIUS
        return f"{self.coldest:.6g} K to {self.hottest:.6g} K ({low:.4g} to {high:.4g} degC)"


@dataclass(frozen=True)
class Material:
    """Isotropic material near 20 C.

    Attributes
    ----------
    name : str
        Name in the catalogue.
    expansion : float
        Linear thermal expansion (CTE), 1/K.
    density : float
        Density, kg/m^3.
    youngs_modulus : float
        Young's modulus, Pa.
    poisson_ratio : float
        Poisson's ratio.
    conductivity : float
        Thermal conductivity, W/(m K).
    source : str
        Source of the numbers.
    known : TemperatureRange
        Temperatures for which the constant expansion is valid: within some 10 % of it, or within the differences
        between manufacturers' data sheets.
    """

    name: str
    expansion: float
    density: float
    youngs_modulus: float
    poisson_ratio: float
    conductivity: float
    source: str
    known: TemperatureRange

    def __post_init__(self) -> None:
        """Check that the numbers are possible for a solid."""
        if not (self.density > 0.0 and self.youngs_modulus > 0.0 and self.conductivity > 0.0):
            raise ValueError(f"{self.name}: density, Young's modulus and conductivity must be positive")
        if not -1.0 < self.poisson_ratio < 0.5:
            raise ValueError(f"{self.name}: Poisson's ratio must lie between -1 and 0.5, found {self.poisson_ratio}")


_ALL = (
    Material(
        "Zerodur",
        0.0,
        2530.0,
        90.3e9,
        0.24,
        1.46,
        "Schott, ZERODUR catalogue. CTE is the middle of the makers' class: 0 +- 0.05e-6/K in class 1, mean of 0..50 C "
        "(checked against Schott's table of classes; down to 0 +- 0.007e-6/K can be had). Other sheets give E = 91 GPa",
        TemperatureRange.celsius(
            -50.0, 100.0, "Schott's curves stay within 0.1e-6/K of zero there (not checked); its classes are of 0..50 C"
        ),
    ),
    Material(
        "fused silica",
        0.52e-6,
        2201.0,
        72.7e9,
        0.16,
        1.38,
        "Corning HPFS 7980: CTE (5..35 C) and density checked against Corning's Zemax catalogue, E and Poisson's ratio "
        "from its data sheet. Heraeus states 0.51e-6/K. Conductivity: makers state 1.30 (Corning) to 1.38 (Heraeus)",
        TemperatureRange.celsius(
            -100.0, 200.0, "Corning's means of -100..200 C and of 0..200 C, 0.48 and 0.57e-6/K (not checked)"
        ),
    ),
    Material(
        "N-BK7",
        7.1e-6,
        2510.0,
        82.0e9,
        0.206,
        1.114,
        "Schott data sheet N-BK7; CTE of -30..70 C; CTE and density checked against Schott's Zemax catalogue",
        TemperatureRange.celsius(-30.0, 70.0, "Schott's CTE is the mean of that range"),
    ),
    Material(
        "SiC",
        2.2e-6,
        3150.0,
        420.0e9,
        0.17,
        180.0,
        "sintered SiC-100 (Boostec/Mersen) data sheet, room temperature; not checked. Sintered SiC "
        "in general: E 370..490 GPa, Poisson's ratio 0.14..0.21, density 3000..3200 kg/m^3",
        TemperatureRange.celsius(0.0, 50.0, "room temperature; its CTE grows by half a per cent in 1 K (not checked)"),
    ),
    Material(
        "Invar",
        1.26e-6,
        8050.0,
        141.0e9,
        0.259,
        10.4,
        "Invar 36 as in Yoder, Opto-Mechanical Systems Design; CarTech's sheet has the density and 10 W/(m K). CTE "
        "depends on the heat treatment: the fit of NIST's cryogenic data base gives 0.94e-6/K at 20 C (E 152 GPa, "
        "13.8 W/(m K)), ASTM F1684 allows 1.2..2.7e-6/K over 30..150 C",
        TemperatureRange.celsius(-50.0, 150.0, "makers' sheets differ by more than the CTE changes by there"),
    ),
    Material(
        "Ti-6Al-4V",
        8.6e-6,
        4430.0,
        113.8e9,
        0.342,
        6.7,
        "annealed, ASM/MatWeb and Allvac: CTE of 20..100 C; makers' sheets differ by 4 % in CTE and 7 % in E and k",
        TemperatureRange.celsius(-50.0, 100.0, "CTE of 20..100 C; at -50 C it is some 6 % less (not checked)"),
    ),
    Material(
        "CFRP",
        0.1e-6,
        1650.0,
        110.0e9,
        0.30,
        35.0,
        "typical quasi-isotropic high-modulus laminate, in plane; a design value, real laminates range -1..1e-6/K",
        TemperatureRange.celsius(-100.0, 100.0, "laminates differ by more than the CTE changes by there"),
    ),
    Material(
        "aluminium",
        23.6e-6,
        2700.0,
        68.9e9,
        0.33,
        167.0,
        "6061-T6, ASM Metals Handbook vol. 2; CTE of 20..100 C",
        TemperatureRange.celsius(-50.0, 100.0, "CTE of 20..100 C; at -50 C it is some 8 % less (not checked)"),
    ),
    Material(
        "alumina",
        5.4e-6,
        3700.0,
        320.0e9,
        0.23,
        24.0,
        "96 % alumina of circuit boards, Kyocera A-476 (density, E, k checked). Kyocera's CTE of 7.2e-6/K is the mean "
        "of 40..400 C; at 20 C it is 5.4e-6 +- 0.8e-6/K (Touloukian et al., Thermophysical Properties of Matter 13, "
        "not checked)",
        TemperatureRange.celsius(0.0, 50.0, "at 20 C with its +- 0.8e-6/K, by which it changes in some 30 K"),
    ),
    Material(
        "AlN",
        3.0e-6,
        3260.0,
        325.0e9,
        0.22,
        170.0,
        "aluminium nitride of circuit boards, makers' sheets (density 3250..3300, E 320..331 GPa, k 170..175 checked). "
        "Their CTE of 4.5..4.6e-6/K is the mean of 20..400 C; at 20 C it is 2.6..3.3e-6/K (after Slack and Bartram, "
        "J. Appl. Phys. 46, 89 (1975); not checked)",
        TemperatureRange.celsius(0.0, 50.0, "at 20 C with what sources differ by, by which it changes in some 30 K"),
    ),
)
MATERIALS: Mapping[str, Material] = FrozenMap({m.name: m for m in _ALL})
"""Built-in materials, by name."""
_OTHER_NAMES: Mapping[str, str] = FrozenMap(
    {"bk7": "n-bk7", "aluminum": "aluminium", "titanium": "ti-6al-4v", "al2o3": "alumina", "aluminium nitride": "aln"}
)


def material(name: str) -> Material:
    """Return the built-in material of the given name; case does not matter, and BK7 is N-BK7.

    Raises
    ------
    KeyError
        The name is unknown; the message gives the nearest one.
    """
    wanted = _OTHER_NAMES.get(name.lower(), name.lower())
    for known, entry in MATERIALS.items():
        if known.lower() == wanted:
            return entry
    raise unknown_name("material", name, MATERIALS)
