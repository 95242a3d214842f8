"""Measured coatings from CSV files: reflectance, and if need be transmittance, over wavelength and angle of incidence.

    wavelength [nm],angle [deg],R [percent],T [percent]
    640,0,0.21,99.7
    640,30,0.25,99.6
    660,0,0.23,99.6

Shares may be told for s and p apart (Rs and Rp, Ts and Tp): light here is unpolarised, and takes their mean. Heads
without a unit hold shares of 0 to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.materials.coating_table import CoatingTable
from optics.numerics.frozen_map import FrozenMap
from scenes.yaml.csv_table import Column, Table, read_table
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.units import ANGLE, LENGTH, SCALE

SHARES = ("R", "Rs", "Rp", "T", "Ts", "Tp")
COLUMNS = (
    Column("wavelength", LENGTH, least=1e-8, most=1e-4),
    Column("angle", ANGLE, least=0.0, most=0.5 * np.pi * (1.0 + 1e-12)),
    *(Column(name, SCALE, needed=False, least=0.0, most=1.0 + 1e-12, bare=True) for name in SHARES),
)
OVER = 5e-3
"""By which measured reflectance and transmittance may exceed 1 together; the transmittance is then lowered."""


@dataclass(frozen=True, eq=False)
class MeasuredCoating:
    """What a file holds: at each wavelength a coating, metres -> table, wavelengths ascending."""

    by_wavelength: Mapping[float, CoatingTable]

    def at(self, wavelength: float) -> CoatingTable:
        """The coating at a wavelength in metres, linear between the two beside it.

        Raises:
            ValueError: the wavelength lies outside of the table.
        """
        known = np.array(list(self.by_wavelength))
        near = 1e-9 * wavelength
        if not known[0] - near <= wavelength <= known[-1] + near:
            ends = f"{1e9 * known[0]:.6g} to {1e9 * known[-1]:.6g} nm"
            raise ValueError(f"{1e9 * wavelength:.6g} nm lie outside of {ends}")
        k = int(np.clip(np.searchsorted(known, wavelength), 1, max(len(known) - 1, 1)))
        low = self.by_wavelength[float(known[k - 1])]
        if len(known) == 1:
            return low
        high = self.by_wavelength[float(known[k])]
        w = float(np.clip((wavelength - known[k - 1]) / (known[k] - known[k - 1]), 0.0, 1.0))
        angles = np.union1d(low.angles, high.angles)

        def mean(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            return (1.0 - w) * np.interp(angles, low.angles, a) + w * np.interp(angles, high.angles, b)

        through = None
        if low.transmittance is not None and high.transmittance is not None:
            through = mean(low.transmittance, high.transmittance)
        return CoatingTable(angles, mean(low.reflectance, high.reflectance), through)


def read_coating(path: str | Path) -> MeasuredCoating:
    """The coating of a file.

    Raises:
        InputError: it cannot be read, a column is missing or twice there, or a row cannot be, with line and column.
    """
    table = read_table(path, COLUMNS)
    reflected = _mean(table, "R")
    if reflected is None:
        heads = InputError(
            Issue("no reflectance", table.file, 1, found=", ".join(table.heads.values()), allowed="R, or Rs and Rp")
        )
        raise heads
    through = _mean(table, "T")
    if through is not None:
        over = reflected + through > 1.0 + OVER
        if np.any(over):
            row = int(np.argmax(over))
            found = f"{reflected[row]:.4g} and {through[row]:.4g}"
            raise table.error(row, "", "more light leaves than arrives", found, "R + T of 1 at most")
        through = np.minimum(through, 1.0 - reflected)
    wavelength, angle = table["wavelength"], np.minimum(table["angle"], 0.5 * np.pi)
    seen: dict[tuple[float, float], int] = {}
    for row, place in enumerate(zip(wavelength.tolist(), angle.tolist(), strict=True)):
        other = seen.setdefault(place, row)
        if other != row:
            text = f"the wavelength and angle that line {table.lines[other]} has"
            raise table.error(row, "angle", text, allowed="each pair once")
    out = {}
    for value in np.unique(wavelength):
        own = np.flatnonzero(wavelength == value)
        own = own[np.argsort(angle[own])]
        out[float(value)] = CoatingTable(angle[own], reflected[own], None if through is None else through[own])
    return MeasuredCoating(FrozenMap(out))


def _mean(table: Table, name: str) -> np.ndarray | None:
    """Of unpolarised light: the column itself, or the mean of those for s and p; None where there is neither."""
    s, p = f"{name}s", f"{name}p"
    if name in table:
        both = next((other for other in (s, p) if other in table), None)
        if both is not None:
            raise table.error(0, both, f"another column than {name} for the same", None, f"{name}, or {s} and {p}")
        return table[name]
    if s in table and p in table:
        return np.asarray(0.5 * (table[s] + table[p]))
    alone = next((other for other in (s, p) if other in table), None)
    if alone is not None:
        raise table.error(0, alone, "one polarisation without the other", None, f"{name}, or {s} and {p}")
    return None
