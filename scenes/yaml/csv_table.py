"""Tables of measured numbers from CSV files: heads with units, `time [s], x [mm]`, and one row for each reading.

Columns may stand in any order and in any unit of their kind; numbers come out in SI units. Lines that are empty or
begin with # are left out. A million rows take some seconds. Rows become numbers some thousands at a time, so that a
table takes little more memory than its text and its numbers.
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
"""In a table, in its unit: whatever is worked out of larger ones leaves the range of floating-point numbers."""
LARGEST_TABLE = 1 << 30
"""Bytes."""
_HEAD = re.compile(r"(?P<name>[^\[\]]*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?")
_DELIMITERS = (",", ";", "\t")
_LEAST, _MOST = -np.inf, np.inf


@dataclass(frozen=True)
class Column:
    """A column that a table may have.

    Attributes
    ----------
    name : str
        Its head, without the unit.
    kind : Kind | None
        Of the quantity; its head then ends in a unit in square brackets. None for numbers without a unit.
    text : bool
        Whether it holds names and not numbers.
    needed : bool
        Whether a table without it is refused.
    least, most : float
        Of its numbers, both allowed, SI units.
    whole : bool
        Whether its numbers are whole.
    bare : bool
        Whether the unit may be missing, and numbers are then in the SI unit.
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
        """An example of its head."""
        return self.name if self.kind is None or self.bare else f"{self.name} [{self.kind.units[0]}]"


@dataclass(frozen=True, eq=False)
class Table:
    """What a table holds.

    Attributes
    ----------
    file : str
        Its path, as the user gave it.
    lines : np.ndarray
        (N,) line of each row in the file, counted from 1.
    heads : Mapping[str, str]
        Name of a column -> its head as it stands in the file.
    columns : Mapping[str, np.ndarray]
        Name -> (N,) numbers in SI units, or names; those that the file does not have are missing.
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
        """(N, K) of K columns of numbers."""
        return np.stack([self.columns[name] for name in names], axis=-1)

    def error(
        self,
        row: int,
        name: str,
        problem: str,
        found: str | None = None,
        allowed: str | None = None,
        suggestion: str | None = None,
    ) -> InputError:
        """What is wrong with a cell, or with the whole row for an empty name."""
        key = (self.heads[name],) if name else ()
        return InputError(Issue(problem, self.file, int(self.lines[row]), key, found, allowed, suggestion))


def read_table(path: str | Path, columns: Sequence[Column], least_rows: int = 1) -> Table:
    """A table of a file.

    Parameters
    ----------
    path : str | Path
        Of the file, UTF-8 text with commas, semicolons or tabs between its cells.
    columns : Sequence[Column]
        That it may have; another one is refused.
    least_rows : int
        That it must have.

    Raises
    ------
    InputError
        The file cannot be read, a needed column is missing, a cell holds no number or one that is not allowed; with the
        line and the head of the column.
    """
    file = str(path)
    pieces = _rows(file, table_text(path))
    lines, rows = next(pieces, ([], []))
    allowed = ", ".join(repr(c.head) + ("" if c.needed else " (may be missing)") for c in columns)
    if not rows:
        raise InputError(Issue("an empty table", file, 1, allowed=f"a row of heads: {allowed}"))
    found = _heads(file, lines[0], rows[0], columns, allowed)
    if len(rows) <= least_rows and len(rows) < _TOGETHER:
        text = f"{len(rows) - 1} rows below the heads"
        raise InputError(Issue(text, file, lines[0], allowed=f"{least_rows} or more"))
    heads = [head.strip() for head in rows[0]]
    parts = [_numbers(file, lines[1:], rows[1:], heads, found)]
    parts += [_numbers(file, lines, rows, heads, found) for lines, rows in pieces]
    numbers = np.concatenate([own for own, _ in parts])
    values = {column.name: np.concatenate([own[column.name] for _, own in parts]) for column, _, _ in found}
    return Table(file, numbers, FrozenMap({column.name: heads[k] for column, k, _ in found}), FrozenMap(values))


def _numbers(
    file: str,
    lines: Sequence[int],
    rows: Sequence[Sequence[str]],
    heads: Sequence[str],
    found: Sequence[tuple[Column, int, _Scale]],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Lines of some rows, and their SI numbers or names in the columns that were found."""
    width = len(heads)
    uneven = next((k for k, row in enumerate(rows) if len(row) != width), None)
    if uneven is not None:
        text = f"{len(rows[uneven])} cells under {width} heads"
        allowed = "as many cells as heads, and a point in decimal numbers"
        raise InputError(Issue(text, file, lines[uneven], allowed=allowed))
    numbers, cells = np.array(lines, int), list(zip(*rows, strict=True)) or [()] * width
    return numbers, {
        column.name: _values(file, numbers, heads[k], column, cells[k], scale) for column, k, scale in found
    }


def table_text(path: str | Path, what: str = "a CSV file", most: int = LARGEST_TABLE) -> str:
    """The text of a file of measured numbers.

    Parameters
    ----------
    path : str | Path
        Of the file, UTF-8 text.
    what : str
        It should be, for messages.
    most : int
        Bytes that it may have.

    Raises
    ------
    InputError
        There is none, it cannot be read, is too large or holds other than UTF-8 text.
    """
    return read_text(path, what, most, (Path(path).suffix,))


_TOGETHER = 1 << 16
"""Rows that are cells of text at a time."""
_LINE = re.compile(r"[^\r\n]*(?:\r\n?|\n)|[^\r\n]+")


def lines_of(text: str) -> Iterator[str]:
    """The lines of a text with their ends, as a file opened with ``newline=""`` has them, one at a time.

    Parameters
    ----------
    text : str
        whole.
    """
    return (match[0] for match in _LINE.finditer(text))


def rows_apart(path: str | Path, most: int) -> list[tuple[int, list[str] | str]]:
    """Return line and cells of every row of a small table whose rows are taken or refused one by one.

    Each line is a row: a quotation mark that is never closed spoils its own row alone.

    Parameters
    ----------
    path : str or Path
        File, as for `read_table`.
    most : int
        Bytes that it may have.

    Returns
    -------
    list of (int, list of str or str)
        Line, counted from 1, and its cells, or what is wrong with it.

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
            rows.append((number, "a byte that is no text" if "\0" in line else "not UTF-8 text"))
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
    first = next((row for row in lines_of(text) if row.strip() and not row.lstrip().startswith("#")), "")
    return next((sign for sign in _DELIMITERS if sign in first), ",")


def _holds(row: Sequence[str]) -> bool:
    """Return whether a row holds something and is no remark."""
    return bool(row) and not row[0].lstrip().startswith("#") and any(map(str.strip, row))


def _rows(file: str, text: str) -> Iterator[tuple[list[int], list[list[str]]]]:
    """Lines and cells of the rows that hold something, ``_TOGETHER`` at a time."""
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
    """Line, counted from 1, and cells of every row of a small table; empty lines and those that begin with # are left
    out.

    Parameters
    ----------
    path : str | Path
        Of the file, as for ``read_table``.
    most : int
        Bytes that it may have.

    Raises
    ------
    InputError
        It cannot be read, or is no table.
    """
    pieces = _rows(str(path), table_text(path, most=most))
    return [row for lines, rows in pieces for row in zip(lines, rows, strict=True)]


def _heads(
    file: str, line: int, heads: Sequence[str], columns: Sequence[Column], allowed: str
) -> list[tuple[Column, int, _Scale]]:
    """The columns that stand in the file, where, and how their numbers become SI ones."""
    known = {column.name: column for column in columns}
    found: list[tuple[Column, int, _Scale]] = []
    for k, head in enumerate(heads):
        text = head.strip()
        match = _HEAD.fullmatch(text)
        name = "" if match is None else match["name"]
        if match is None or name not in known:
            meant = nearest(name, known)
            issue = Issue(
                "no such column", file, line, (text[:LONGEST_SHOWN],), shown(text), allowed, meant and known[meant].head
            )
            raise InputError(issue)
        column = known[name]
        if any(column is other for other, _, _ in found):
            raise InputError(Issue("another column holds the same", file, line, (text,)))
        found.append((column, k, _scale(file, line, text, column, match["unit"])))
    missing = next((c for c in columns if c.needed and not any(c is other for other, _, _ in found)), None)
    if missing is not None:
        have = names_text([head.strip() for head in heads])
        raise InputError(Issue(f"no column {missing.head!r}", file, line, found=have, allowed=allowed))
    return found


_Scale = tuple[float, float]
"""Factor and offset from a head's unit to the SI unit: SI = factor * (number + offset). Degrees Celsius alone have an
offset."""


def _scale(file: str, line: int, head: str, column: Column, unit: str | None) -> _Scale:
    """From the unit of a head to the SI unit."""
    if column.kind is None:
        if unit is not None:
            raise InputError(Issue("this column has no unit", file, line, (head,), shown(unit), repr(column.head)))
        return 1.0, 0.0
    if column.bare and unit is None:
        return 1.0, 0.0
    if not unit:
        raise InputError(Issue("a head without a unit", file, line, (head,), allowed=repr(column.head)))
    try:
        one = parse_quantity(f"1 {unit.strip()}", column.kind)
        if column.kind == TEMPERATURE and one > 2.0:
            return 1.0, parse_quantity(f"0 {unit.strip()}", column.kind)
        return unit_ratio(unit.strip(), column.kind.si), 0.0
    except Problem as problem:
        allowed = names_text(column.kind.units)
        issue = Issue(problem.problem, file, line, (head,), problem.found, allowed, problem.suggestion)
        raise InputError(issue) from None


def _values(file: str, lines: np.ndarray, head: str, column: Column, cells: Sequence[str], scale: _Scale) -> np.ndarray:
    """SI numbers, or names, of a column."""
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
    if odd is not None:  # Python takes 1_000 for a number
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
    factor, offset = scale
    low, high = column.least / factor - offset, column.most / factor - offset
    if np.isinf(high):
        return f"at least {low:g}"
    return f"at most {high:g}" if np.isinf(low) else f"{low:g} to {high:g}"
