"""Zernike terms in Noll's order, orders of other programs, and tables of coefficients in metres.

**Terms.** Angles run from the columns' direction x to the rows' direction y. Noll's terms have unit RMS over the disk
(Noll, J. Opt. Soc. Am. 66, 207, 1976).

**Tables** are CSV text of one of two forms. A long one has a column with indices and one with coefficients; a wide one
has a row for each field and a column for each term, ``Z4``, ``Z5``..., and possibly other text columns, which are kept.
Lines ``# order: fringe``, ``# normalised: peak``, ``# unit: waves`` and ``# wavelength: 632.8 nm`` state the meaning of
the coefficients; the unit may also be in the head of the columns, as in ``Z4 [nm]``.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isqrt, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import eval_jacobi

from analysis.arrays import Array
from analysis.wavefront_maps import map_files

HIGHEST_ORDER = 30
"""Highest radial order of the supported terms."""
MOST_TERMS = (HIGHEST_ORDER + 1) * (HIGHEST_ORDER + 2) // 2
"""Number of Zernike terms up to the highest radial order, and largest supported index."""
LAST_FRINGE = 37
"""Last Fringe index: spherical aberration of the twelfth order, which the general rule would count as the 49th term."""


def noll_to_nm(index: int) -> tuple[int, int]:
    """Return radial order n and azimuthal order m, positive for cosine terms and negative for sine terms.

    Parameters
    ----------
    index : int
        Noll's index, 1 for piston.
    """
    if not 1 <= index <= MOST_TERMS:
        raise ValueError(f"Noll's terms 1 to {MOST_TERMS} are known, not {index}")
    n = (isqrt(8 * index - 7) - 1) // 2
    position = index - n * (n + 1) // 2 - 1
    m = 2 * ((position + 1) // 2) if n % 2 == 0 else 2 * (position // 2) + 1
    return n, m if index % 2 == 0 else -m


def nm_to_noll(n: int, m: int) -> int:
    """Return Noll's index of a Zernike term.

    Parameters
    ----------
    n : int
        Radial order.
    m : int
        Azimuthal order, negative for sine terms.

    Returns
    -------
    int
        Noll's index, 1 for piston.

    Raises
    ------
    ValueError
        Orders of no term, or above 30.

    Examples
    --------
    Defocus, the two comas and primary spherical aberration (Noll, J. Opt. Soc. Am. 66, 207 (1976)):

    >>> import analysis
    >>> [analysis.nm_to_noll(n, m) for n, m in ((2, 0), (3, -1), (3, 1), (4, 0))]
    [4, 7, 8, 11]
    """
    if not (0 <= n <= HIGHEST_ORDER and abs(m) <= n and (n - m) % 2 == 0):
        raise ValueError(f"Zernike terms have 0 <= n <= {HIGHEST_ORDER}, |m| <= n and n - m even, found {n}, {m}")
    first = n * (n + 1) // 2 + 1
    return next(j for j in range(first, first + n + 1) if noll_to_nm(j) == (n, m))


def fringe_to_nm(index: int) -> tuple[int, int]:
    """Return the orders of a term of the Fringe set (University of Arizona).

    Parameters
    ----------
    index : int
        Fringe index, 1 for piston, up to 37.

    Returns
    -------
    n, m : int
        Radial and azimuthal order; m is negative for sine terms.

    Raises
    ------
    ValueError
        An index out of range.

    Examples
    --------
    Defocus, coma along x and y, and spherical aberration are the Fringe terms 4, 7, 8 and 9:

    >>> import analysis
    >>> [analysis.fringe_to_nm(index) for index in (4, 7, 8, 9)]
    [(2, 0), (3, 1), (3, -1), (4, 0)]
    >>> analysis.nm_to_noll(*analysis.fringe_to_nm(9))
    11
    """
    if not 1 <= index <= LAST_FRINGE:
        raise ValueError(f"Fringe terms 1 to {LAST_FRINGE} are known, not {index}")
    if index == LAST_FRINGE:
        return 12, 0
    half = isqrt(index - 1)
    back = (half + 1) ** 2 - index
    m = (back + 1) // 2
    return 2 * half - m, -m if 2 * m - back else m


def ansi_to_nm(index: int) -> tuple[int, int]:
    """Return the orders of a term in the order of ANSI Z80.28, which is also that of OSA.

    Parameters
    ----------
    index : int
        ANSI index, 0 for piston.

    Returns
    -------
    n, m : int
        Radial and azimuthal order; m is negative for sine terms.

    Raises
    ------
    ValueError
        An index out of range.

    Examples
    --------
    Defocus and spherical aberration are the ANSI terms 4 and 12:

    >>> import analysis
    >>> analysis.ansi_to_nm(4), analysis.ansi_to_nm(12)
    ((2, 0), (4, 0))
    """
    if not 0 <= index < MOST_TERMS:
        raise ValueError(f"ANSI terms 0 to {MOST_TERMS - 1} are known, not {index}")
    n = (isqrt(8 * index + 1) - 1) // 2
    return n, 2 * index - n * (n + 2)


ORDERS = {"noll": noll_to_nm, "fringe": fringe_to_nm, "ansi": ansi_to_nm}
"""Functions that convert an index to radial order n and azimuthal order m, by the name of the ordering."""


def edge_value(n: int, m: int) -> float:
    """Return the largest value at the edge of the disk of a Zernike term of unit RMS.

    It converts coefficients of terms that reach 1 at the edge to those of terms of unit RMS.

    Parameters
    ----------
    n : int
        Radial order.
    m : int
        Azimuthal order, of either sign.
    """
    return sqrt(n + 1) * (sqrt(2.0) if m else 1.0)


def circle_terms(terms: Any, x: Any, y: Any) -> Array:
    """Return the values of Z Zernike terms, of unit RMS over the disk, at N points, as (N, Z).

    Parameters
    ----------
    terms : sequence of int
        Noll's indices of the Z terms.
    x : (N,) array_like
        x on the unit disk.
    y : (N,) array_like
        y on the unit disk.
    """
    point, square = np.asarray(x) + 1j * np.asarray(y), np.square(x) + np.square(y)
    columns = np.empty((*point.shape, len(terms)))
    powers: dict[int, NDArray[np.complex128]] = {}
    for k, (n, m) in enumerate(noll_to_nm(int(index)) for index in terms):
        order = abs(m)
        if order not in powers:
            powers[order] = point**order
        azimuthal = powers[order].imag if m < 0 else powers[order].real
        # radial polynomial without the power of the radius, which the azimuthal part includes
        radial = eval_jacobi((n - order) // 2, 0, order, 2.0 * square - 1.0)
        np.multiply(edge_value(n, m) * radial, azimuthal, out=columns[..., k])
    return columns


ORDER_NAMES = {"noll": "noll", "fringe": "fringe", "ansi": "ansi", "osa": "ansi", "osa/ansi": "ansi"}
"""Names of orderings of Zernike terms in files, and the keys of `ORDERS` that they mean."""
NORMALISATIONS = {"rms": True, "peak": False}
"""Normalisations: True for unit RMS over the disk, False for unit peak, terms that reach 1 at the edge."""
_INDEX = ("index", "j", "term")
_COEFFICIENT = ("coefficient", "value", "c")
_TERM = re.compile(r"[zZ]\s?_?(\d{1,4})")
_HEAD = re.compile(r"([^\[\]]*?)\s*(?:\[([^\[\]]*)\])?")
_DELIMITERS = ",;\t"
_MOST_CHARACTERS = 10_000_000


@dataclass(frozen=True, eq=False)
class ZernikeTable:
    """Zernike coefficients of F wavefronts, for instance at F field points, read from a file.

    Attributes
    ----------
    terms : (Z,) tuple of int
        Noll's indices of the Z terms, ascending.
    coefficients : (F, Z) ndarray
        Coefficients of terms of unit RMS over the disk, in metres, with the file's sign.
    others : mapping of str to tuple of str
        Other columns of a wide table, (F,) texts each, by name.
    wavelength : float or None
        Wavelength, in metres; None if neither file nor user states it.
    notes : tuple of str
        Sentences on how the table was understood.
    """

    terms: tuple[int, ...]
    coefficients: Array
    others: Mapping[str, tuple[str, ...]]
    wavelength: float | None
    notes: tuple[str, ...]


def read_zernikes(path: Path, *, wavelength: float | None = None) -> ZernikeTable:
    """Read Zernike coefficients from a CSV table and convert them to Noll's terms in metres.

    Parameters
    ----------
    path : Path
        File to read.
    wavelength : float, optional
        Wavelength, in metres, if the file does not state it.

    Raises
    ------
    MapError
        There is no such table, or its meaning is missing or contradictory; the message says what to write.
    """
    path = Path(path)
    if not path.is_file():
        raise map_files.MapError(f"{path} is no file" if path.exists() else f"there is no file {path}")
    try:
        text = map_files.text_of(path)
    except OSError as error:
        raise map_files.MapError(f"{path} cannot be read: {error.strerror or 'input/output error'}") from error
    if len(text) > _MOST_CHARACTERS:
        raise map_files.MapError(f"{path} is too long for a table of Zernike coefficients: {len(text)} characters")
    statements = map_files.statements(path, text, ("order", "normalised", "unit", "wavelength"))
    order = _keyword(path, "order", statements.get("order"), ORDER_NAMES)
    scaled = _keyword(path, "normalised", statements.get("normalised"), NORMALISATIONS)
    file_wavelength = (
        map_files.length_from(path, statements["wavelength"], "wavelength") if "wavelength" in statements else None
    )
    wavelength = map_files.agreed(path, "wavelength", wavelength, file_wavelength)
    indices, table, others, in_head = _table(path, text)
    units = {text_unit for text_unit in (statements.get("unit"), *in_head) if text_unit}
    if len(units) > 1:
        raise map_files.MapError(f"{path} states more than one unit: {', '.join(sorted(units))[:60]}")
    unit = map_files.unit_written(path, units.pop() if units else None, "a line '# unit: nm'")
    metres = map_files.metres_per(path, unit, wavelength)
    terms, scales = [], []
    for index in indices:
        try:
            n, m = ORDERS[order](index)
        except ValueError as error:
            raise map_files.MapError(f"{path}: {error}") from None
        terms.append(nm_to_noll(n, m))
        scales.append(metres if scaled else metres / edge_value(n, m))
    sequence = np.argsort(terms)
    if len(set(terms)) != len(terms):
        repeated = next(index for index in indices if indices.count(index) > 1)
        raise map_files.MapError(f"{path} has term {repeated} more than once")
    coefficients = table * np.array(scales)
    if not np.isfinite(coefficients).all():
        raise map_files.MapError(f"{path}: a coefficient is not a finite number")
    size = "unit rms" if scaled else "unit peak"
    return ZernikeTable(
        terms=tuple(terms[k] for k in sequence),
        coefficients=coefficients[:, sequence],
        others=others,
        wavelength=wavelength,
        notes=(f"{len(terms)} terms in the order {order}, of {size}, in {unit}.",),
    )


def _keyword(path: Path, key: str, value: str | None, known: Mapping[str, Any]) -> Any:
    """Return the meaning of the value of a header key such as ``order``; raise MapError for an unknown value."""
    if value is None:
        raise map_files.MapError(
            f"{path} does not state its {key}: add a line '# {key}: {next(iter(known))}' ({', '.join(known)})"
        )
    if value.strip().lower() not in known:
        raise map_files.MapError(f"{path}: {key} is {value[:40]!r}; {', '.join(known)} are known")
    return known[value.strip().lower()]


def _table(path: Path, text: str) -> tuple[list[int], Array, dict[str, tuple[str, ...]], set[str | None]]:
    """Return Z term indices, coefficients of F wavefronts (F, Z), other columns and units of a CSV table."""
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and line.strip()[0] != "#"]
    if not lines:
        raise map_files.MapError(f"{path} holds no table")
    delimiter = next((candidate for candidate in _DELIMITERS if candidate in lines[0][1]), ",")
    try:
        rows = [(n, [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]) for n, line in lines]
    except csv.Error as error:
        raise map_files.MapError(f"{path} is not a table: {error}") from error
    matches = [_HEAD.fullmatch(cell) for cell in rows[0][1]]
    heads = [(m[1].strip(), m[2]) if m else ("", None) for m in matches]
    body = rows[1:]
    for n, cells in body:
        if len(cells) != len(heads):
            raise map_files.MapError(f"{path}, line {n}: {len(cells)} cells, the head of the table has {len(heads)}")
    if not body:
        raise map_files.MapError(f"{path} holds no row below the head of its table")
    names = [name.lower() for name, _ in heads]
    at_index = [k for k, name in enumerate(names) if name in _INDEX]
    at_value = [k for k, name in enumerate(names) if name in _COEFFICIENT]
    if len(at_index) == 1 and len(at_value) == 1:
        indices = [_whole(path, n, cells[at_index[0]]) for n, cells in body]
        values = [_real(path, n, cells[at_value[0]]) for n, cells in body]
        return indices, np.array([values]), {}, {heads[at_value[0]][1]}
    wide = {k: match for k, name in enumerate(names) if (match := _TERM.fullmatch(name))}
    if not wide:
        raise map_files.MapError(
            f"{path}, line {rows[0][0]}: the head names neither terms (Z4, Z5) nor the columns index and coefficient"
        )
    table = np.array([[_real(path, n, cells[k]) for k in wide] for n, cells in body])
    others = {rows[0][1][k]: tuple(cells[k] for _, cells in body) for k in range(len(heads)) if k not in wide}
    return [int(match[1]) for match in wide.values()], table, others, {heads[k][1] for k in wide}


def _whole(path: Path, line: int, cell: str) -> int:
    """Return the index of a Zernike term in a table cell; raise MapError if it is not a whole number."""
    match = _TERM.fullmatch(cell) or re.fullmatch(r"([0-9]{1,4})", cell)
    if match is None:
        raise map_files.MapError(f"{path}, line {line}: {cell[:40]!r} is not the index of a term")
    return int(match[1])


def _real(path: Path, line: int, cell: str) -> float:
    """Return the coefficient in a table cell; raise MapError if it is not a finite number."""
    try:
        value = float(cell.replace("_", "?"))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise map_files.MapError(f"{path}, line {line}: {cell[:40]!r} is not a coefficient")
    return value
