"""Optical glasses: refractive index by wavelength and temperature, and dispersion formulas of glass catalogues (AGF).

Dispersion is Sellmeier's formula n^2 - 1 = sum B_i w^2 / (w^2 - C_i), w in micrometres. Temperature enters by Schott's
formula (Hoffmann, Jochs and Westenberger 1990; Hartmann, "Optical Glass", SPIE Press 2014, eq. 3.18 and 3.19)

    dn_abs = (n0^2 - 1) / (2 n0) * (D0 t + D1 t^2 + D2 t^3 + (E0 t + E1 t^2) / (w^2 - w_TK^2)),   t = T - 20 C.

Manufacturers give indices relative to air of 20 C and 1013 hPa (``Glass.index``); in vacuum the index is
``Glass.vacuum_index``.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import sqrt
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from optics.materials.material import TemperatureRange, unknown_name
from optics.numerics.array_math import UnphysicalError
from optics.numerics.number_tree import FrozenMap

REFERENCE_TEMPERATURE = 293.15
"""Temperature of the glass to which the dispersion formulas refer, kelvin (20 C)."""
SCHOTT_RANGE = TemperatureRange.celsius(
    -100.0, 140.0, 'Schott\'s measurements of dn/dT: Hartmann, "Optical Glass", SPIE Press 2014, sec. 3.7'
)


@dataclass(frozen=True)
class ThermalDispersion:
    """Constants of Schott's formula for dn/dT, in the units of its data sheets.

    Attributes
    ----------
    d0, d1, d2 : float
        Constants D0, D1, D2, in 1/K, 1/K^2, 1/K^3.
    e0, e1 : float
        Constants E0, E1, in um^2/K, um^2/K^2.
    lambda_tk : float
        Wavelength constant, um.
    known : TemperatureRange
        Temperatures for which the formula is valid.
    """

    d0: float
    d1: float
    d2: float
    e0: float
    e1: float
    lambda_tk: float
    known: TemperatureRange = SCHOTT_RANGE

    def change(self, index: float, wavelength_m: float, temperature_k: float) -> float:
        """Return the change of the refractive index in vacuum from 20 C to another temperature.

        Parameters
        ----------
        index : float
            Index at 20 C.
        wavelength_m : float
            Wavelength, metres.
        temperature_k : float
            Temperature of the glass, kelvin, inside ``known``.
        """
        t, w2 = temperature_k - REFERENCE_TEMPERATURE, (wavelength_m * 1e6) ** 2
        polynomial = self.d0 * t + self.d1 * t**2 + self.d2 * t**3
        polynomial += (self.e0 * t + self.e1 * t**2) / (w2 - self.lambda_tk**2)
        return (index * index - 1.0) / (2.0 * index) * polynomial

    def slope(self, index: float, wavelength_m: float, temperature_k: float) -> float:
        """Return the derivative of the refractive index in vacuum with respect to temperature, 1/K.

        Parameters
        ----------
        index : float
            Index at 20 C.
        wavelength_m : float
            Wavelength, metres.
        temperature_k : float
            Temperature of the glass, kelvin, inside ``known``.
        """
        t, w2 = temperature_k - REFERENCE_TEMPERATURE, (wavelength_m * 1e6) ** 2
        slope = self.d0 + 2.0 * self.d1 * t + 3.0 * self.d2 * t**2
        slope += (self.e0 + 2.0 * self.e1 * t) / (w2 - self.lambda_tk**2)
        return (index * index - 1.0) / (2.0 * index) * slope


class _IndexByTemperature:
    """Refractive index by wavelength and temperature of a glass with a dispersion formula."""

    name: str

    def _at_reference(self, wavelength_m: float) -> float:
        """Return the index relative to air at 20 C; raise UnphysicalError outside the formula's wavelengths."""
        raise NotImplementedError

    @property
    def _dispersion(self) -> ThermalDispersion | None:
        """Constants of the index's change with temperature (dn/dT); None where they are not known."""
        raise NotImplementedError

    def index(self, wavelength_m: float, temperature_k: float = REFERENCE_TEMPERATURE) -> float:
        """Return the refractive index relative to air of 20 C and 1013 hPa.

        The change with temperature is that of the absolute index (the reference air does not change).

        Parameters
        ----------
        wavelength_m : float
            Wavelength in air, metres.
        temperature_k : float
            Temperature of the glass, kelvin.

        Raises
        ------
        ValueError
            The wavelength or the temperature is outside the formula's range, the temperature is not above 0 K, or the
            glass has no temperature constants and the temperature is not 293.15 K.
        """
        n = self._at_reference(wavelength_m)
        if not 0.0 < temperature_k < float("inf"):
            raise UnphysicalError(f"{self.name}: a temperature must be above 0 K and finite, found {temperature_k} K")
        if temperature_k == REFERENCE_TEMPERATURE:
            return n
        return n + self._constants(temperature_k).change(n, wavelength_m, temperature_k)

    def vacuum_index(self, wavelength_m: float, temperature_k: float = REFERENCE_TEMPERATURE) -> float:
        """Return the absolute refractive index, for glass in vacuum.

        Parameters
        ----------
        wavelength_m : float
            Wavelength in air, metres.
        temperature_k : float
            Temperature of the glass, kelvin.

        Raises
        ------
        ValueError
            The wavelength or the temperature is outside the formula's range, or the glass has no temperature constants
            and the temperature is not 293.15 K.
        """
        at_reference = self.index(wavelength_m)
        change = self.index(wavelength_m, temperature_k) - at_reference
        return at_reference * air_index(wavelength_m) + change

    def dn_dt(self, wavelength_m: float, temperature_k: float = REFERENCE_TEMPERATURE) -> float:
        """Return the derivative of the absolute refractive index with respect to temperature, 1/K.

        Parameters
        ----------
        wavelength_m : float
            Wavelength in air, metres.
        temperature_k : float
            Temperature of the glass, kelvin.

        Raises
        ------
        ValueError
            The wavelength or the temperature is outside the formula's range, or the glass has no temperature constants.
        """
        n = self.index(wavelength_m)
        return self._constants(temperature_k).slope(n, wavelength_m, temperature_k)

    def _constants(self, temperature_k: float) -> ThermalDispersion:
        """Return the constants of dn/dT; raise UnphysicalError where unknown or not valid at the temperature."""
        known = self._dispersion
        if known is None:
            raise UnphysicalError(f"{self.name}: no constants for the change of its index with temperature are known")
        if not known.known.contains(temperature_k, temperature_k):
            raise UnphysicalError(
                f"{self.name}: its index is known from {known.known.text}, not at {temperature_k:.6g} K"
            )
        return known


@dataclass(frozen=True)
class Glass(_IndexByTemperature):
    """Optical glass with Sellmeier dispersion.

    Attributes
    ----------
    name : str
        Name in the catalogue.
    b : tuple of float
        Sellmeier coefficients B1, B2, B3.
    c : tuple of float
        Sellmeier coefficients C1, C2, C3, um^2.
    shortest, longest : float
        Range of wavelengths for which the formula is valid, metres.
    source : str
        Source of the numbers.
    thermal : ThermalDispersion, optional
        Constants of dn/dT; None when none are published.
    """

    name: str
    b: tuple[float, float, float]
    c: tuple[float, float, float]
    shortest: float
    longest: float
    source: str
    thermal: ThermalDispersion | None = None

    def _at_reference(self, wavelength_m: float) -> float:
        if not self.shortest <= wavelength_m <= self.longest:
            raise UnphysicalError(
                f"{self.name}: wavelength {wavelength_m * 1e9:.6g} nm is outside the range of its dispersion formula, "
                f"{self.shortest * 1e9:.6g} to {self.longest * 1e9:.6g} nm"
            )
        w2 = (wavelength_m * 1e6) ** 2
        return sqrt(1.0 + sum(b * w2 / (w2 - c) for b, c in zip(self.b, self.c, strict=True)))

    @property
    def _dispersion(self) -> ThermalDispersion | None:
        return self.thermal


@dataclass(frozen=True)
class WarmGlass:
    """Properties of a lens's glass at one wavelength that depend on temperature: its size and its refractive index.

    Attributes
    ----------
    name : str
        Name of the glass.
    expansion : float
        Linear thermal expansion (CTE), 1/K.
    known : TemperatureRange
        Temperatures for which expansion and index are valid.
    index : float
        Index at 20 C and ``wavelength``.
    wavelength : float
        Wavelength, metres.
    thermal : ThermalDispersion
        Constants of dn/dT.
    """

    name: str
    expansion: float
    known: TemperatureRange
    index: float
    wavelength: float
    thermal: ThermalDispersion

    def change(self, start_k: float, end_k: float) -> float:
        """Return the change of the absolute refractive index between two temperatures given in kelvin."""
        start, end = (self.thermal.change(self.index, self.wavelength, t) for t in (start_k, end_k))
        return end - start

    def slope(self, temperature_k: float) -> float:
        """Return the derivative of the absolute refractive index with respect to temperature, 1/K."""
        return self.thermal.slope(self.index, self.wavelength, temperature_k)


def air_index(wavelength_m: float) -> float:
    """Return the refractive index of dry air at 20 C and 1013 hPa (Kohlrausch, Praktische Physik; Schott TIE-19)."""
    w2 = (wavelength_m * 1e6) ** 2
    at_15 = 1e-8 * (6432.8 + 2949810.0 * w2 / (146.0 * w2 - 1.0) + 25540.0 * w2 / (41.0 * w2 - 1.0))
    return 1.0 + at_15 / (1.0 + 3.4785e-3 * 5.0)


def _catalogue() -> Iterator[Glass]:
    """Yield the glasses of ``glasses.csv``, which states the source of every row."""
    with Path(__file__).with_name("glasses.csv").open(encoding="utf-8", newline="") as stream:
        for name, *cells, source in list(csv.reader(stream))[1:]:
            n = [float(cell) for cell in cells if cell]
            thermal = ThermalDispersion(n[8], n[9], n[10], n[11], n[12], n[13]) if n[8:] else None
            yield Glass(name, (n[0], n[1], n[2]), (n[3], n[4], n[5]), n[6], n[7], source, thermal)


GLASSES: Mapping[str, Glass] = FrozenMap({entry.name: entry for entry in _catalogue()})
"""Built-in glasses, by name."""


def glass(name: str) -> Glass:
    """Return the built-in glass of the given name; case does not matter.

    Raises
    ------
    KeyError
        The name is unknown; the message gives the nearest one.
    """
    for known, entry in GLASSES.items():
        if known.lower() == name.lower():
            return entry
    raise unknown_name("glass", name, GLASSES)


ABBE_LINES = (587.5618e-9, 486.1327e-9, 656.2725e-9)
"""Wavelengths of the lines d, F and C, metres, whose indices define the Abbe number (n_d - 1) / (n_F - n_C)."""


def _powers(c: Sequence[float], w: float, exponents: Sequence[int]) -> float:
    """Return the index n at wavelength ``w`` (um) from n^2 = sum of c_k w^e_k, with coefficients c and exponents e."""
    return sqrt(sum(a * w**e for a, e in zip(c, exponents, strict=False)))


def _sellmeier(c: Sequence[float], w: float, start: float = 1.0) -> float:
    """Return the index n at wavelength ``w`` (um) by Sellmeier's formula.

    n^2 = start + sum of B w^2 / (w^2 - C) over the pairs B, C in ``c``.
    """
    w2 = w * w
    return sqrt(start + sum(b * w2 / (w2 - d) for b, d in zip(c[0::2], c[1::2], strict=False) if b))


def _herzberger(c: Sequence[float], w: float) -> float:
    """Return the index at wavelength ``w`` (um) by Herzberger's dispersion formula with coefficients ``c``."""
    ell = 1.0 / (w * w - 0.028)
    return c[0] + c[1] * ell + c[2] * ell**2 + c[3] * w**2 + c[4] * w**4 + c[5] * w**6


def _sellmeier_2(c: Sequence[float], w: float) -> float:
    """Return the index at wavelength ``w`` (um) by the formula "Sellmeier 2" of AGF files with coefficients ``c``."""
    w2 = w * w
    return sqrt(1.0 + c[0] + c[1] * w2 / (w2 - c[2] ** 2) + c[3] / (w2 - c[4] ** 2))


FORMULAS: FrozenMap[int, tuple[str, Callable[[Sequence[float], float], float]]] = FrozenMap(
    {
        1: ("Schott", lambda c, w: _powers(c, w, (0, 2, -2, -4, -6, -8))),
        2: ("Sellmeier 1", lambda c, w: _sellmeier(c[:6], w)),
        3: ("Herzberger", _herzberger),
        4: ("Sellmeier 2", _sellmeier_2),
        5: ("Conrady", lambda c, w: c[0] + c[1] / w + c[2] / w**3.5),
        6: ("Sellmeier 3", lambda c, w: _sellmeier(c[:8], w)),
        7: ("Handbook 1", lambda c, w: sqrt(c[0] + c[1] / (w * w - c[2]) - c[3] * w * w)),
        8: ("Handbook 2", lambda c, w: sqrt(c[0] + c[1] * w * w / (w * w - c[2]) - c[3] * w * w)),
        9: ("Sellmeier 4", lambda c, w: _sellmeier(c[1:5], w, c[0])),
        10: ("Extended 1", lambda c, w: _powers(c, w, (0, 2, -2, -4, -6, -8, -10, -12))),
        11: ("Sellmeier 5", lambda c, w: _sellmeier(c[:10], w)),
        12: ("Extended 2", lambda c, w: _powers(c, w, (0, 2, -2, -4, -6, -8, 4, 6))),
        13: ("Extended 3", lambda c, w: _powers(c, w, (0, 2, 4, -2, -4, -6, -8, -10, -12))),
    }
)
"""Number of a dispersion formula in AGF files -> its name, and the index as a function of coefficients and wavelength
in um.
"""


@dataclass(frozen=True)
class CatalogueGlass(_IndexByTemperature):
    """Glass of a catalogue; called with a wavelength (metres) it returns its index.

    Attributes
    ----------
    name : str
        Name in the catalogue.
    formula : int
        Number of its dispersion formula.
    coefficients : tuple of float
        Coefficients of the formula, for wavelengths in micrometres.
    shortest, longest : float
        Range of wavelengths for which the formula is valid, metres.
    expansion : float, optional
        Linear thermal expansion, 1/K, mean of -30..70 C; None where the catalogue does not give it.
    thermal : tuple of float, optional
        Schott's constants of dn/dT, D0, D1, D2, E0, E1 and Lambda_TK; None where the catalogue does not give them.
    source : str
        Source of a common glass, its manufacturer first; empty for a glass of a user's catalogue.
    """

    name: str
    formula: int
    coefficients: tuple[float, ...]
    shortest: float
    longest: float
    expansion: float | None = None
    thermal: tuple[float, ...] | None = None
    source: str = ""

    def __call__(self, wavelength: float) -> float:
        """Return the refractive index relative to air at a wavelength, metres.

        Raises
        ------
        ValueError
            The formula is not valid at that wavelength.
        """
        if not self.shortest <= wavelength <= self.longest:
            raise UnphysicalError(
                f"{self.name}: {wavelength * 1e9:.6g} nm is outside the range of its dispersion formula, "
                f"{self.shortest * 1e9:.6g} to {self.longest * 1e9:.6g} nm"
            )
        try:
            index = FORMULAS[self.formula][1](self.coefficients, wavelength * 1e6)
        except (ValueError, ZeroDivisionError, OverflowError):
            index = 0.0
        if not 1.0 <= index <= 10.0:
            raise UnphysicalError(
                f"{self.name}: its dispersion formula gives no valid index at {wavelength * 1e9:.6g} nm"
            )
        return index

    def _at_reference(self, wavelength_m: float) -> float:
        return self(wavelength_m)

    @property
    def _dispersion(self) -> ThermalDispersion | None:
        if not self.thermal:
            return None
        d0, d1, d2, e0, e1, lambda_tk = self.thermal
        return ThermalDispersion(d0, d1, d2, e0, e1, lambda_tk)


@cache
def common_glasses() -> Mapping[str, CatalogueGlass]:
    """Return glasses of Schott, Ohara, Hoya and CDGM that prescriptions name often, and calcium fluoride, by name.

    The file ``common_glasses.csv`` names the manufacturer's catalogue for each, as published by refractiveindex.info
    (CC0), and the temperature of its formula. Constants of dn/dT are included where they refer to 20 C.
    """
    out = {}
    with Path(__file__).with_name("common_glasses.csv").open(encoding="utf-8", newline="") as stream:
        for name, source, formula, shortest, longest, expansion, coefficients, constants in list(csv.reader(stream))[
            1:
        ]:
            numbers, thermal = (tuple(map(float, part.split())) for part in (coefficients, constants))
            ends = (1e-6 * float(shortest), 1e-6 * float(longest))
            expands = 1e-6 * float(expansion) if expansion else None
            out[name] = CatalogueGlass(
                name, int(formula), (*numbers, *[0.0] * 6), *ends, expands, thermal or None, source
            )
    return FrozenMap(out)


def find_glass(name: str) -> Glass | CatalogueGlass:
    """Return the glass of a name, of all that are known.

    Parameters
    ----------
    name : str
        Name of a glass, as `glass_names` lists them; case does not matter.

    Returns
    -------
    Glass or CatalogueGlass
        Its methods ``index``, ``vacuum_index`` and ``dn_dt`` take a wavelength in air (metres) and a temperature
        (kelvin, 293.15 by default).

    Raises
    ------
    ValueError
        The glass is not known; the message lists those that are.

    Examples
    --------
    The index of fused silica rises by 8 parts in a million per kelvin:

    >>> silica = glass("fused silica")
    >>> round(silica.index(587.5618e-9), 5), round(silica.vacuum_index(587.5618e-9), 5)
    (1.45846, 1.45886)
    >>> round(1e6 * silica.dn_dt(587.5618e-9), 1)
    8.3
    >>> try:
    ...     glass("N-BK8")
    ... except ValueError as error:
    ...     print(str(error).partition(" (")[0])
    unknown glass 'N-BK8'; did you mean 'N-BK7'?
    """
    glasses: dict[str, Glass | CatalogueGlass] = {**GLASSES, **common_glasses()}
    for known, entry in glasses.items():
        if known.lower() == name.lower():
            return entry
    raise unknown_name("glass", name, glasses)


def refractive_index(
    glass: str,
    wavelength: ArrayLike,
    medium: Literal["air", "vacuum"] = "air",
    temperature: float = REFERENCE_TEMPERATURE,
) -> np.ndarray:
    """Compute the refractive index of a named glass.

    Parameters
    ----------
    glass : str
        Name of a glass, as `glass_names` lists them; case does not matter.
    wavelength : array_like
        Wavelengths in air, metres, any shape.
    medium : {"air", "vacuum"}
        Medium relative to which the index is given: air of 20 C and 1013 hPa, as in manufacturers' data, or vacuum.
    temperature : float
        Temperature of the glass, kelvin; other than 293.15 K only where the change of the index is known.

    Returns
    -------
    ndarray
        Refractive index, of the shape of ``wavelength``.

    Raises
    ------
    ValueError
        The glass is not known, or its formula does not hold at a wavelength or at the temperature.

    Examples
    --------
    >>> float(refractive_index("N-BK7", 587.5618e-9).round(5))
    1.5168
    >>> refractive_index("fused silica", [486.1e-9, 656.3e-9]).round(5)
    array([1.46313, 1.45637])
    >>> float(refractive_index("F2", 587.5618e-9, medium="vacuum").round(5))
    1.62048
    >>> refractive_index("N-BK7", 10e-6)
    Traceback (most recent call last):
    ...
    optics.numerics.array_math.UnphysicalError: N-BK7: wavelength 10000 nm is outside the range of its dispersion \
formula, 300 to 2500 nm
    """
    if medium not in ("air", "vacuum"):
        raise ValueError(f"medium must be 'air' or 'vacuum', got {medium!r}")
    entry, waves = find_glass(glass), np.asarray(wavelength, float)
    index = entry.index if medium == "air" else entry.vacuum_index
    return np.array([index(float(w), temperature) for w in waves.flat]).reshape(waves.shape)


def glass_names() -> tuple[str, ...]:
    """Return the names of the glasses whose refractive index is known.

    Returns
    -------
    tuple of str
        Names in alphabetical order.

    Examples
    --------
    >>> "N-BK7" in glass_names(), len(glass_names())
    (True, 31)
    """
    return tuple(sorted({**GLASSES, **common_glasses()}))


def abbe_number(glass: str) -> float:
    """Compute the Abbe number (n_d - 1) / (n_F - n_C) of a named glass.

    Parameters
    ----------
    glass : str
        Name of a glass, as `glass_names` lists them.

    Returns
    -------
    float
        Abbe number at the lines d, F and C.

    Raises
    ------
    ValueError
        The glass is not known.

    Examples
    --------
    >>> round(abbe_number("N-BK7"), 2), round(abbe_number("F2"), 2)
    (64.17, 36.37)
    """
    d, f, c = refractive_index(glass, ABBE_LINES)
    return float((d - 1.0) / (f - c))
