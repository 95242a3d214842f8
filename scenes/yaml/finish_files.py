"""Measured finishes: tabular BSDF data in Zemax's text format (.bsdf), and coatings from CSV files.

A .bsdf file:

    Source  Measured
    Symmetry  PlaneSymmetrical
    SpectralContent  Monochrome
    ScatterType  BRDF
    SampleRotation  1
    0
    AngleOfIncidence  2
    0  45
    ScatterAzimuth  3
    0  90  180
    ScatterRadial  4
    0  5  30  90
    Monochrome
    DataBegin
    TIS 0.04
    1.2E-01  ...        one row for each azimuth, one number for each radial angle
    DataEnd

Angles are in degrees; azimuth and radial angle are about the specular direction (`fresnel_scatter`). Empty lines and
lines that begin with # are skipped. A list of numbers may continue on the next line. A coating file is a CSV table:

    wavelength [nm],angle [deg],R [percent],T [percent]
    640,0,0.21,99.7
    640,30,0.25,99.6
    660,0,0.23,99.6

Reflectance and transmittance may be given separately for s and p (Rs and Rp, Ts and Tp); the light is taken as
unpolarised, so that their mean is used. Columns without a unit hold fractions from 0 to 1.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.materials.fresnel_scatter import CoatingTable, ScatterTable
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.csv_table import Column, Table, read_table
from scenes.yaml.errors import InputError, Issue, shown, unknown
from scenes.yaml.input_file import read_text
from scenes.yaml.units import ANGLE, LENGTH, SCALE

ENDING = ".bsdf"
LARGEST = 64 << 20
"""Largest size of a BSDF or coating file, in bytes."""
MOST_ANGLES = {"SampleRotation": 360, "AngleOfIncidence": 181, "ScatterAzimuth": 721, "ScatterRadial": 2000}
TIS_TOLERANCE = 0.25
"""Largest relative difference between the total integrated scatter (TIS) that a file states and the integral of its
table; coarse lists of angles cause differences of this order.
"""
WORDS = {
    "Source": ("Measured",),
    "Symmetry": ("PlaneSymmetrical", "ASymmetrical", "ASymmetrical4D"),
    "SpectralContent": ("Monochrome", "XYZ"),
    "ScatterType": ("BRDF", "BTDF"),
}


@dataclass(frozen=True, eq=False)
class MeasuredScatter:
    """Contents of a BSDF file.

    Attributes
    ----------
    table : ScatterTable
        The BSDF.
    tis : tuple[float, ...]
        Total integrated scatter that the file states, for each of the table's angles of incidence.
    """

    table: ScatterTable
    tis: tuple[float, ...]


class _Lines:
    """Lines of a BSDF file without comments and empty lines, read one after the other."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.rows = [
            (number, line.replace(",", " ").replace(";", " ").split())
            for number, line in enumerate(text.splitlines(), 1)
            if line.strip() and not line.lstrip().startswith("#")
        ]
        self.rows = [(number, cells) for number, cells in self.rows if cells]
        self.at = 0

    @property
    def line(self) -> int:
        """Number of the next line, or of the last one at the end of the file."""
        return self.rows[min(self.at, len(self.rows) - 1)][0] if self.rows else 1

    def error(self, problem: str, key: str = "", value: object = None, allowed: str | None = None) -> InputError:
        text = None if value is None else shown(value)
        return InputError(Issue(problem, self.file, self.line, (key,) if key else (), text, allowed))

    def next(self, key: str, allowed: str | None = None) -> list[str]:
        """Return the cells of the next line, which stays the next one."""
        if self.at >= len(self.rows):
            raise self.error("the file ends too early", key, None, allowed or f"a line that begins with {key}")
        return self.rows[self.at][1]

    def word(self, key: str) -> str:
        """Read the word that follows a key, and return it in the spelling of the format."""
        cells = self._keyed(key)
        known = {word.lower(): word for word in WORDS[key]}
        if len(cells) != 2 or cells[1].lower() not in known:
            raise InputError(
                unknown("not a value of this line", " ".join(cells[1:]), WORDS[key]).at(self.file, self.line, (key,))
            )
        self.at += 1
        return known[cells[1].lower()]

    def angles(self, key: str) -> np.ndarray:
        """Read a number of angles and then the angles, in degrees; return them in radians."""
        cells = self._keyed(key)
        most = MOST_ANGLES[key]
        plain = len(cells) == 2 and cells[1].isascii() and cells[1].isdigit() and len(cells[1]) < 7
        count = int(cells[1]) if plain else 0
        if not 1 <= count <= most:
            raise self.error("not a number of angles", key, " ".join(cells[1:]), f"1 to {most}")
        line = self.at
        self.at += 1
        degrees = np.array(self.numbers(count, key, -360.0, 360.0))
        if not np.all(np.diff(degrees) > 0.0):
            self.at = line + 1
            raise self.error("the angles do not ascend", key, None, "ascending angles in degrees, each once")
        return np.radians(degrees)

    def numbers(self, count: int, key: str, least: float, most: float) -> list[float]:
        """Read `count` numbers from this line and the next ones."""
        out: list[float] = []
        while len(out) < count:
            for cell in self.next(key, f"{count - len(out)} more numbers"):
                value = _number(cell)
                if value is None or not least <= value <= most:
                    what = "not a number" if value is None else "out of range"
                    allowed = f"{count} numbers, of which this is the {len(out) + 1}th" if value is None else None
                    raise self.error(what, key, cell, allowed or f"{least:g} to {most:g}")
                if len(out) == count:
                    raise self.error("more numbers than angles", key, cell, f"{count} numbers")
                out.append(value)
            self.at += 1
        return out

    def _keyed(self, key: str) -> list[str]:
        cells = self.next(key)
        if cells[0].lower() != key.lower():
            line = " ".join(cells)[:60]
            raise self.error("another line is expected here", key, line, f"a line that begins with {key}")
        return cells


def _number(cell: str) -> float | None:
    """Return the finite number in a cell, None for anything else."""
    if "_" in cell:
        return None
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def read_bsdf(path: str | Path) -> MeasuredScatter:
    """Read the table of a BSDF file.

    Raises
    ------
    InputError
        The file cannot be read, is not a BSDF table, or has a kind of table that is not supported; with the line.
    """
    file = str(path)
    lines = _Lines(file, read_text(path, "a BSDF file", LARGEST, (ENDING,)))
    lines.word("Source")
    symmetry = lines.word("Symmetry")
    if lines.word("SpectralContent") != "Monochrome":
        lines.at -= 1
        allowed = "Monochrome: a monitor has one wavelength"
        raise lines.error("a table of three colours (XYZ)", "SpectralContent", "XYZ", allowed)
    if lines.word("ScatterType") != "BRDF":
        lines.at -= 1
        raise lines.error("scattering in transmission", "ScatterType", "BTDF", "BRDF: scattering in reflection")
    rotations = lines.angles("SampleRotation")
    if len(rotations) > 1:
        text = "scattering that depends on the rotation of the sample"
        raise lines.error(text, "SampleRotation", len(rotations), "1: surfaces scatter alike in every orientation")
    incidence = lines.angles("AngleOfIncidence")
    azimuth = lines.angles("ScatterAzimuth")
    radial = lines.angles("ScatterRadial")
    line = lines.line
    if symmetry != "PlaneSymmetrical" and len(azimuth) > 1 and azimuth[-1] < 2.0 * np.pi * (1.0 - 1e-9):
        closed = azimuth[0] == 0.0 and 2.0 * np.pi - azimuth[-1] <= 1.5 * float(np.max(np.diff(azimuth)))
        if not closed:
            allowed = "0 to 360 degrees; the last may be missing"
            raise lines.error("azimuths that do not cover the full circle", "ScatterAzimuth", None, allowed)
    for word in ("Monochrome", "DataBegin"):
        cells = lines.next(word)
        if [cell.lower() for cell in cells] != [word.lower()]:
            raise lines.error("another line is expected here", word, " ".join(cells)[:60], f"the line {word}")
        lines.at += 1
    tis_of_file, blocks = [], []
    for _ in incidence:
        cells = lines.next("TIS")
        value = _number(cells[1]) if len(cells) == 2 and cells[0].lower() == "tis" else None
        if value is None or not 0.0 <= value <= 1.0:
            allowed = f"TIS and a share of 0 to 1 before the values of each of {len(incidence)} angles of incidence"
            raise lines.error("not a TIS", "TIS", " ".join(cells)[:60], allowed)
        tis_of_file.append((lines.line, value))
        lines.at += 1
        blocks.append([lines.numbers(len(radial), "ScatterRadial", 0.0, 1e15) for _ in azimuth])
    cells = lines.next("DataEnd")
    if [cell.lower() for cell in cells] != ["dataend"]:
        raise lines.error("more data than angles", "DataEnd", " ".join(cells)[:60], "the line DataEnd")
    lines.at += 1
    if lines.at < len(lines.rows):
        raise lines.error("lines after the data", "DataEnd", " ".join(lines.rows[lines.at][1])[:60], "nothing more")
    values = np.array(blocks)
    if symmetry != "PlaneSymmetrical" and len(azimuth) > 1 and azimuth[-1] < 2.0 * np.pi * (1.0 - 1e-9):
        azimuth, values = np.append(azimuth, 2.0 * np.pi), np.concatenate([values, values[:, :1]], axis=1)
    try:
        table = ScatterTable(incidence, azimuth, radial, values)
    except ValueError as error:
        raise InputError(Issue(f"not a BSDF: {error}", file, line)) from None
    _agrees(file, table, tis_of_file)
    return MeasuredScatter(table, tuple(value for _, value in tis_of_file))


def _agrees(file: str, table: ScatterTable, tis_of_file: Sequence[tuple[int, float]]) -> None:
    """Raise `InputError` if the integral of a BSDF table differs from the total scatter that its file states."""
    for (line, value), angle in zip(tis_of_file, table.incidence, strict=True):
        total = table.total(float(angle))
        if abs(total - value) > TIS_TOLERANCE * max(total, value):
            text = f"the table scatters {total:.4g} of the light at {np.degrees(angle):g} deg, not the stated TIS"
            allowed = f"the integral of f cos over the hemisphere, to {100 * TIS_TOLERANCE:.0f} %"
            raise InputError(Issue(text, file, line, ("TIS",), shown(value), allowed))


SHARES = ("R", "Rs", "Rp", "T", "Ts", "Tp")
COLUMNS = (
    Column("wavelength", LENGTH, least=1e-8, most=1e-4),
    Column("angle", ANGLE, least=0.0, most=0.5 * np.pi * (1.0 + 1e-12)),
    *(Column(name, SCALE, needed=False, least=0.0, most=1.0 + 1e-12, bare=True) for name in SHARES),
)
OVER = 5e-3
"""Largest allowed excess over 1 of the sum of measured reflectance and transmittance.

If there is an excess, the transmittance is reduced.
"""


@dataclass(frozen=True, eq=False)
class MeasuredCoating:
    """Contents of a coating file: wavelength in metres -> coating, by ascending wavelength."""

    by_wavelength: Mapping[float, CoatingTable]

    def at(self, wavelength: float) -> CoatingTable:
        """Return the coating at a wavelength in metres, interpolated linearly between the neighbouring wavelengths.

        Raises
        ------
        ValueError
            The wavelength lies outside the table.
        """
        known = np.array(list(self.by_wavelength))
        near = 1e-9 * wavelength
        if not known[0] - near <= wavelength <= known[-1] + near:
            ends = f"{1e9 * known[0]:.6g} to {1e9 * known[-1]:.6g} nm"
            raise ValueError(f"{1e9 * wavelength:.6g} nm is outside {ends}")
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
    """Read the coating of a file.

    Raises
    ------
    InputError
        The file cannot be read, a column is missing or occurs twice, or a row is not possible; with line and column.
    """
    table = read_table(path, COLUMNS)
    reflected = _mean(table, "R")
    if reflected is None:
        heads = ", ".join(table.heads.values())
        raise InputError(Issue("no reflectance", table.file, 1, value=heads, allowed="R, or Rs and Rp"))
    through = _mean(table, "T")
    if through is not None:
        over = reflected + through > 1.0 + OVER
        if np.any(over):
            row = int(np.argmax(over))
            actual = f"{reflected[row]:.4g} and {through[row]:.4g}"
            raise table.error(row, "", "more light leaves than arrives", actual, "R + T of 1 at most")
        through = np.minimum(through, 1.0 - reflected)
    wavelength, angle = table["wavelength"], np.minimum(table["angle"], 0.5 * np.pi)
    first_rows: dict[tuple[float, float], int] = {}
    for row, pair in enumerate(zip(wavelength.tolist(), angle.tolist(), strict=True)):
        first_row = first_rows.setdefault(pair, row)
        if first_row != row:
            text = f"repeats the wavelength and angle of line {table.lines[first_row]}"
            raise table.error(row, "angle", text, allowed="each pair once")
    out = {}
    for value in np.unique(wavelength):
        rows = np.flatnonzero(wavelength == value)
        rows = rows[np.argsort(angle[rows])]
        out[float(value)] = CoatingTable(angle[rows], reflected[rows], None if through is None else through[rows])
    return MeasuredCoating(FrozenMap(out))


def _mean(table: Table, name: str) -> np.ndarray | None:
    """Return the column of R or T for unpolarised light, or the mean of those for s and p; None without either."""
    s, p = f"{name}s", f"{name}p"
    if name in table:
        both = next((other for other in (s, p) if other in table), None)
        if both is not None:
            raise table.error(0, both, f"{name} and {both} at once", None, f"{name}, or {s} and {p}")
        return table[name]
    if s in table and p in table:
        return np.asarray(0.5 * (table[s] + table[p]))
    alone = next((other for other in (s, p) if other in table), None)
    if alone is not None:
        raise table.error(0, alone, "one polarisation without the other", None, f"{name}, or {s} and {p}")
    return None
