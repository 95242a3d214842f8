"""Dispersion formulas of glass catalogues (AGF files), by their numbers there."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import sqrt
from pathlib import Path

from optics.numerics.frozen_map import FrozenMap
from optics.numerics.physical_error import UnphysicalError

ABBE_LINES = (587.5618e-9, 486.1327e-9, 656.2725e-9)
"""The lines d, F and C, metres, whose indices make an Abbe number: (n_d - 1) / (n_F - n_C)."""


def _powers(c: Sequence[float], w: float, exponents: Sequence[int]) -> float:
    """Index n of n^2 = sum c_k w^e_k."""
    return sqrt(sum(a * w**e for a, e in zip(c, exponents, strict=False)))


def _sellmeier(c: Sequence[float], w: float, start: float = 1.0) -> float:
    """Index n of n^2 = start + sum B w^2 / (w^2 - C) over pairs B, C."""
    w2 = w * w
    return sqrt(start + sum(b * w2 / (w2 - d) for b, d in zip(c[0::2], c[1::2], strict=False) if b))


def _herzberger(c: Sequence[float], w: float) -> float:
    ell = 1.0 / (w * w - 0.028)
    return c[0] + c[1] * ell + c[2] * ell**2 + c[3] * w**2 + c[4] * w**4 + c[5] * w**6


def _sellmeier_2(c: Sequence[float], w: float) -> float:
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
"""Number of a dispersion formula in AGF files -> its name, and the index by coefficients and wavelength in um."""


@dataclass(frozen=True)
class CatalogueGlass:
    """A glass of a catalogue; called with a wavelength (metres) it gives its index.

    Attributes:
        name: as in the catalogue.
        formula: number of its dispersion formula.
        coefficients: of it, for micrometres.
        shortest, longest: between which it holds, metres.
        expansion: linear thermal expansion, 1/K, mean of -30..70 C; None where the catalogue does not say it.
        thermal: Schott's constants of dn/dT, D0, D1, D2, E0, E1 and Lambda_TK, likewise.
        source: where a common glass is from, its maker first; empty for one of a user's catalogue.
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
        """Index against air.

        Raises:
            ValueError: the formula does not hold at that wavelength.
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
                f"{self.name}: no index comes out of its dispersion formula at {wavelength * 1e9:.6g} nm"
            )
        return index


@cache
def common_glasses() -> Mapping[str, CatalogueGlass]:
    """Return glasses of Schott, Ohara, Hoya and CDGM that prescriptions name often, and calcium fluoride, by name.

    The file beside this one names the maker's catalogue for each, as refractiveindex.info has it (CC0), and the
    temperature at which its formula holds. Constants of dn/dT are there where they count from 20 C.
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
