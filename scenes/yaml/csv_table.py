"""Reader of CSV tables of measured numbers, with units in the heads: `time [s], x [mm]`.

Columns may have any order and any unit of their kind; numbers are returned in SI units. Empty lines and lines that
begin with # are skipped. A million rows take some seconds. Rows are converted to numbers in blocks of some thousands,
so that a table needs little more memory than its text and its numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import LONGEST_SHOWN, InputError, Issue, Problem, names_text, nearest, shown
from scenes.yaml.input_file import read_bytes, read_text
from scenes.yaml.units import TEMPERATURE, Kind, parse_quantity, unit_ratio

LARGEST_NUMBER = 1e100
"""Largest absolute value of a number in a table, in the table's unit: results computed from larger ones would overflow.
"""
LARGEST_TABLE = 1 << 30
"""Largest size of a CSV file, in bytes."""
_HEAD = re.compile(r"(?P<name>[^\[\]]*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?")
_DELIMITERS = (",", ";", "\t")
_LEAST, _MOST = -np.inf, np.inf


@dataclass(frozen=True)
class Column:
    """Column that a table may have.

    Attributes
    ----------
    name : str
        Head of the column, without the unit.
    kind : Kind | None
        Kind of the quantity; the head then ends in a unit in square brackets. None for numbers without a unit.
    text : bool
        True if the cells are names instead of numbers.
    needed : bool
        True if a table without this column is refused.
    least, most : float
        Smallest and largest number allowed, both inclusive, in SI units.
    whole : bool
        True if only whole numbers are allowed.
    bare : bool
        True if the head may omit the unit; the numbers are then in the SI unit.
    """

    name: str
    kind: Kind | None = None
    text: bool = False
    needed: bool = True
    least: float = _LEAST
    most: float = _MOST
    whole: bool = False
    bare: bool = False

    @property
    def head(self) -> str:
        """Head of the column as messages show it, with an example of a unit: `time [s]`."""
        return self.name if self.kind is None or self.bare else f"{self.name} [{self.kind.units[0]}]"


@dataclass(frozen=True, eq=False)
class Table:
    """Contents of a CSV table.

    Attributes
    ----------
    file : str
        Path as the user wrote it.
    lines : np.ndarray
        (N,) line number of each of the N rows in the file, counted from 1.
    heads : Mapping[str, str]
        Name of a column -> its head as written in the file.
    columns : Mapping[str, ndarray]
        Name of a column -> (N,) numbers in SI units, or names; only for columns that the file has.
    """

    file: str
    lines: np.ndarray
    heads: Mapping[str, str]
    columns: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.lines)

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def stacked(self, *names: str) -> np.ndarray:
        """Return columns of numbers side by side, as one array (rows, columns), in SI units."""
        return np.stack([self.columns[name] for name in names], axis=-1)

    def error(
        self,
        row: int,
        name: str,
        problem: str,
        value: str | None = None,
        allowed: str | None = None,
        suggestion: str | None = None,
    ) -> InputError:
        """Return the input error of one cell, or of the whole row if the name of the column is empty."""
        key = (self.heads[name],) if name else ()
        return InputError(Issue(problem, self.file, int(self.lines[row]), key, value, allowed, suggestion))


def read_table(path: str | Path, columns: Sequence[Column], least_rows: int = 1) -> Table:
    """Read a table of a CSV file.

    Parameters
    ----------
    path : str | Path
        Path of the file: UTF-8 text with commas, semicolons or tabs between the cells.
    columns : Sequence[Column]
        Columns that the table may have; any other column is refused.
    least_rows : int
        Smallest number of rows.

    Raises
    ------
    InputError
        The file cannot be read, a needed column is missing, or a cell is not a number or is out of range. The error has
        the line and the head of the column.
    """
    file = str(path)
    pieces = _rows(file, table_text(path))
    lines, rows = next(pieces, ([], []))
    allowed = ", ".join(repr(c.head) + ("" if c.needed else " (may be missing)") for c in columns)
    if not rows:
        raise InputError(Issue("an empty table", file, 1, allowed=f"a row of heads: {allowed}"))
    layout = _heads(file, lines[0], rows[0], columns, allowed)
    if len(rows) <= least_rows and len(rows) < _TOGETHER:
        text = f"{len(rows) - 1} rows below the heads"
        raise InputError(Issue(text, file, lines[0], allowed=f"{least_rows} or more"))
    heads = [head.strip() for head in rows[0]]
    parts = [_numbers(file, lines[1:], rows[1:], heads, layout)]
    parts += [_numbers(file, lines, rows, heads, layout) for lines, rows in pieces]
    numbers = np.concatenate([part for part, _ in parts])
    values = {column.name: np.concatenate([part[column.name] for _, part in parts]) for column, _, _ in layout}
    return Table(file, numbers, FrozenMap({column.name: heads[k] for column, k, _ in layout}), FrozenMap(values))


def _numbers(
    file: str,
    lines: Sequence[int],
    rows: Sequence[Sequence[str]],
    heads: Sequence[str],
    layout: Sequence[tuple[Column, int, _Scale]],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Convert some rows of a table to numbers; return their line numbers, and the columns in SI units."""
    width = len(heads)
    uneven = next((k for k, row in enumerate(rows) if len(row) != width), None)
    if uneven is not None:
        text = f"{len(rows[uneven])} cells under {width} heads"
        allowed = "as many cells as heads, and a point in decimal numbers"
        raise InputError(Issue(text, file, lines[uneven], allowed=allowed))
    numbers, cells = np.array(lines, int), list(zip(*rows, strict=True)) or [()] * width
    return numbers, {
        column.name: _values(file, numbers, heads[k], column, cells[k], scale) for column, k, scale in layout
    }


def table_text(path: str | Path, what: str = "a CSV file", most: int = LARGEST_TABLE) -> str:
    """Read the text of a file of measured numbers.

    Parameters
    ----------
    path : str | Path
        Path of the file, UTF-8 text.
    what : str
        Noun phrase for the expected file, for messages.
    most : int
        Largest size, in bytes.

    Raises
    ------
    InputError
        The file is missing, cannot be read, is too large or is not UTF-8 text.
    """
    return read_text(path, what, most, (Path(path).suffix,))


_TOGETHER = 1 << 16
"""Number of rows converted from text to numbers at a time, which limits the memory."""
_LINE = re.compile(r"[^\r\n]*(?:\r\n?|\n)|[^\r\n]+")


def lines_of(text: str) -> Iterator[str]:
    """Iterate over the lines of a text with their line ends, as a file opened with ``newline=""`` does.

    Parameters
    ----------
    text : str
        The whole text.
    """
    return (match[0] for match in _LINE.finditer(text))


def rows_apart(path: str | Path, most: int) -> list[tuple[int, list[str] | str]]:
    """Return line number and cells of every row of a small table, keeping rows that cannot be read.

    The caller accepts or refuses the rows one by one. Each line is a row: a quotation mark that is never closed
    invalidates its own row alone.

    Parameters
    ----------
    path : str or Path
        Path of the file: UTF-8 text with commas, semicolons or tabs between the cells.
    most : int
        Largest size, in bytes.

    Returns
    -------
    list of (int, list of str or str)
        Line number, counted from 1, and the cells, or a text that says why the row cannot be read.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    text = read_bytes(path, "a CSV file", most, (Path(path).suffix,)).decode("utf-8-sig", "replace")
    rows: list[tuple[int, list[str] | str]] = []
    delimiter = _delimiter(text)
    for number, line in enumerate(lines_of(text), 1):
        if "\0" in line or "\ufffd" in line:
            rows.append((number, "a byte that is not text" if "\0" in line else "not UTF-8 text"))
            continue
        try:
            cells = next(csv.reader([line], delimiter=delimiter, strict=True), [])
        except csv.Error as error:
            rows.append((number, f"not a row of a CSV file: {error}"))
            continue
        if _holds(cells):
            rows.append((number, cells))
    return rows


def _delimiter(text: str) -> str:
    """Return the delimiter of a table: the first of `_DELIMITERS` that occurs in its first row."""
    first = next((row for row in lines_of(text) if row.strip() and not row.lstrip().startswith("#")), "")
    return next((sign for sign in _DELIMITERS if sign in first), ",")


def _holds(row: Sequence[str]) -> bool:
    """Return whether a row has cells with content and is not a comment."""
    return bool(row) and not row[0].lstrip().startswith("#") and any(map(str.strip, row))


def _rows(file: str, text: str) -> Iterator[tuple[list[int], list[list[str]]]]:
    """Yield line numbers and cells of the rows with content, up to ``_TOGETHER`` rows at a time."""
    reader = csv.reader(lines_of(text), delimiter=_delimiter(text), strict=True)
    lines: list[int] = []
    rows: list[list[str]] = []
    try:
        for row in reader:
            if _holds(row):
                lines.append(reader.line_num)
                rows.append(row)
                if len(rows) == _TOGETHER:
                    yield lines, rows
                    lines, rows = [], []
    except csv.Error as error:
        raise InputError(Issue(f"not a CSV file: {error}", file, reader.line_num)) from None
    if rows:
        yield lines, rows


def rows_of(path: str | Path, most: int) -> list[tuple[int, list[str]]]:
    """Return line number, counted from 1, and cells of every row of a small table.

    Empty lines and lines that begin with # are skipped.

    Parameters
    ----------
    path : str | Path
        Path of the file: UTF-8 text with commas, semicolons or tabs between the cells.
    most : int
        Largest size, in bytes.

    Raises
    ------
    InputError
        The file cannot be read, or is not a table.
    """
    pieces = _rows(str(path), table_text(path, most=most))
    return [row for lines, rows in pieces for row in zip(lines, rows, strict=True)]


def _heads(
    file: str, line: int, heads: Sequence[str], columns: Sequence[Column], allowed: str
) -> list[tuple[Column, int, _Scale]]:
    """Return each column of the file with its index and its conversion to the SI unit."""
    known = {column.name: column for column in columns}
    layout: list[tuple[Column, int, _Scale]] = []
    for k, head in enumerate(heads):
        text = head.strip()
        match = _HEAD.fullmatch(text)
        name = "" if match is None else match["name"]
        if match is None or name not in known:
            near = nearest(name, known)
            key, meant = (text[:LONGEST_SHOWN],), near and known[near].head
            raise InputError(Issue("no such column", file, line, key, shown(text), allowed, meant))
        column = known[name]
        if any(column is other for other, _, _ in layout):
            raise InputError(Issue("a second column with this head", file, line, (text,)))
        layout.append((column, k, _scale(file, line, text, column, match["unit"])))
    missing = next((c for c in columns if c.needed and not any(c is other for other, _, _ in layout)), None)
    if missing is not None:
        have = names_text([head.strip() for head in heads])
        raise InputError(Issue(f"no column {missing.head!r}", file, line, value=have, allowed=allowed))
    return layout


_Scale = tuple[float, float]
"""Factor and offset that convert a number in the unit of a head to SI: SI = factor * (number + offset).

Only degrees Celsius have an offset.
"""


def _scale(file: str, line: int, head: str, column: Column, unit: str | None) -> _Scale:
    """Return factor and offset from the unit of a head to the SI unit."""
    if column.kind is None:
        if unit is not None:
            raise InputError(Issue("this column has no unit", file, line, (head,), shown(unit), repr(column.head)))
        return 1.0, 0.0
    if column.bare and unit is None:
        return 1.0, 0.0
    if not unit:
        raise InputError(Issue("a head without a unit", file, line, (head,), allowed=repr(column.head)))
    try:
        si_value = parse_quantity(f"1 {unit.strip()}", column.kind)
        if column.kind == TEMPERATURE and si_value > 2.0:
            return 1.0, parse_quantity(f"0 {unit.strip()}", column.kind)
        return unit_ratio(unit.strip(), column.kind.si), 0.0
    except Problem as problem:
        allowed = names_text(column.kind.units)
        issue = Issue(problem.problem, file, line, (head,), problem.value, allowed, problem.suggestion)
        raise InputError(issue) from None


def _values(file: str, lines: np.ndarray, head: str, column: Column, cells: Sequence[str], scale: _Scale) -> np.ndarray:
    """Return the SI numbers, or the names, of a column."""
    factor, offset = scale

    def wrong(row: int, problem: str, allowed: str | None = None) -> InputError:
        return InputError(Issue(problem, file, int(lines[row]), (head,), shown(cells[row].strip()), allowed))

    if column.text:
        names = [cell.strip() for cell in cells]
        if "" in names:
            raise wrong(names.index(""), "an empty cell", "a name")
        return np.array(names, dtype=object)
    try:
        numbers = np.array(list(map(float, cells)))
    except ValueError:
        row = next(k for k, cell in enumerate(cells) if not _is_number(cell))
        comma = ", with a point and not a comma" if "," in cells[row] else ""
        raise wrong(row, "not a number", f"a number{comma}") from None
    odd = next((k for k, cell in enumerate(cells) if "_" in cell), None)
    if odd is not None:  # float() accepts 1_000, which no table means
        raise wrong(odd, "not a number", "a number")
    finite = np.isfinite(numbers)
    huge = finite & (np.abs(numbers) > LARGEST_NUMBER)
    numbers = np.where(huge, 0.0, numbers) if np.any(huge) else numbers
    numbers = (numbers + offset if offset else numbers) * factor
    for bad, problem in (
        (~finite, "not a finite number"),
        (huge, "larger than any quantity"),
        ((numbers < column.least) | (numbers > column.most), "out of range"),
        (column.whole & (numbers != np.floor(numbers)), "not a whole number"),
    ):
        if np.any(bad):
            row = int(np.argmax(bad))
            raise wrong(row, problem, _range(column, scale) if problem == "out of range" else "a number")
    return numbers


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _range(column: Column, scale: _Scale) -> str:
    """Return the allowed range of a column's numbers in the unit of its head, for messages."""
    factor, offset = scale
    low, high = column.least / factor - offset, column.most / factor - offset
    if np.isinf(high):
        return f"at least {low:g}"
    return f"at most {high:g}" if np.isinf(low) else f"{low:g} to {high:g}"
