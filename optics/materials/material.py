"""Structural and optical materials near room temperature: properties for thermo-elastic models, with their sources.

"Checked" in a source means that the number was compared with the named source again; the others are as quoted.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

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

    def contains(self, coldest: float, hottest: float) -> bool:
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


def _catalogue() -> Iterator[Material]:
    """Yield the materials of ``materials.csv``, which states the source of every row and of its temperatures."""
    with Path(__file__).with_name("materials.csv").open(encoding="utf-8", newline="") as stream:
        for name, *numbers, source, coldest, hottest, why in list(csv.reader(stream))[1:]:
            known = TemperatureRange.celsius(float(coldest), float(hottest), why)
            expansion, density, modulus, ratio, conductivity = map(float, numbers)
            yield Material(name, expansion, density, modulus, ratio, conductivity, source, known)


MATERIALS: Mapping[str, Material] = FrozenMap({entry.name: entry for entry in _catalogue()})
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
