"""Mutators of tables: cells, rows, columns and heads of a CSV file."""

from __future__ import annotations

import random
import re
from collections.abc import Callable

from tests.robustness.nasty import NUMBERS, TEXTS, UNITS

Rows = list[list[str]]
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")


def _table(change: Callable[[Rows, random.Random], None]) -> Callable[[bytes, random.Random], bytes]:
    """A change of cells as a change of a file. Comments and quotes are cells like others."""

    def changed(content: bytes, chance: random.Random) -> bytes:
        rows = [line.split(",") for line in content.decode().split("\n")]
        change(rows, chance)
        return "\n".join(",".join(row) for row in rows).encode("utf-8", "surrogatepass")

    changed.__name__ = change.__name__
    return changed


def _cell(rows: Rows, chance: random.Random) -> tuple[int, int]:
    row = chance.randrange(1, len(rows))
    return row, chance.randrange(len(rows[row]))


def cell(rows: Rows, chance: random.Random) -> None:
    """Other cells, of numbers most of all."""
    for _ in range(chance.choice((1, 1, 3, 20))):
        row, column = _cell(rows, chance)
        rows[row][column] = chance.choice((*NUMBERS, *NUMBERS, *TEXTS))


def scaled(rows: Rows, chance: random.Random) -> None:
    """Cells, or all of a column, are multiplied: valid and extreme."""
    factor = chance.choice((-1.0, 0.0, 1e-12, 1e-6, 1e-3, 0.5, 0.999, 1.001, 2.0, 1e3, 1e6, 1e12, 1e200))
    row, column = _cell(rows, chance)
    which = range(1, len(rows)) if chance.random() < 0.5 else (row,)
    for k in which:
        if column < len(rows[k]) and _NUMBER.fullmatch(rows[k][column].strip()):
            rows[k][column] = repr(float(rows[k][column]) * factor)


def constant(rows: Rows, chance: random.Random) -> None:
    """All of a column is what stands in one of its rows."""
    row, column = _cell(rows, chance)
    for k in range(1, len(rows)):
        if column < len(rows[k]):
            rows[k][column] = rows[row][column]


def shifted(rows: Rows, chance: random.Random) -> None:
    """A number is added to all of a column."""
    _, column = _cell(rows, chance)
    more = chance.choice((-1e9, -360.0, -1.0, 1e-9, 1.0, 90.0, 360.0, 1e9))
    for k in range(1, len(rows)):
        if column < len(rows[k]) and _NUMBER.fullmatch(rows[k][column].strip()):
            rows[k][column] = repr(float(rows[k][column]) + more)


def few_rows(rows: Rows, chance: random.Random) -> None:
    """Of the rows a few are left, or none."""
    del rows[1 + chance.choice((0, 0, 1, 2, 3, 4, 6, 10)) :]


def lost_rows(rows: Rows, chance: random.Random) -> None:
    """Some rows are missing."""
    rows[1:] = [row for row in rows[1:] if chance.random() < 0.8]


def doubled_rows(rows: Rows, chance: random.Random) -> None:
    """Rows stand twice, or very often."""
    first = chance.randrange(1, len(rows))
    rows[first:first] = rows[first : first + chance.choice((1, 3, 30))] * chance.choice((1, 1, 3, 50))


def other_order(rows: Rows, chance: random.Random) -> None:
    """Rows in another order."""
    body = rows[1:]
    rows[1:] = body[::-1] if chance.random() < 0.5 else chance.sample(body, len(body))


def ragged(rows: Rows, chance: random.Random) -> None:
    """Rows with cells too many or too few."""
    for _ in range(chance.choice((1, 1, 4))):
        row = rows[chance.randrange(len(rows))]
        if chance.random() < 0.5:
            row.append(chance.choice(NUMBERS))
        else:
            row.pop()


def lost_column(rows: Rows, chance: random.Random) -> None:
    """A column is missing."""
    at = chance.randrange(len(rows[0]))
    for row in rows:
        if at < len(row):
            del row[at]


def doubled_column(rows: Rows, chance: random.Random) -> None:
    """A column stands twice."""
    at = chance.randrange(len(rows[0]))
    for row in rows:
        if at < len(row):
            row.append(row[at])


def exchanged_columns(rows: Rows, chance: random.Random) -> None:
    """Two columns have each other's heads."""
    a, b = chance.randrange(len(rows[0])), chance.randrange(len(rows[0]))
    rows[0][a], rows[0][b] = rows[0][b], rows[0][a]


def head(rows: Rows, chance: random.Random) -> None:
    """Another head, or another unit in it."""
    at = chance.randrange(len(rows[0]))
    if "[" in rows[0][at] and chance.random() < 0.7:
        rows[0][at] = re.sub(r"\[.*?\]", lambda _: f"[{chance.choice(UNITS)}]", rows[0][at])
    else:
        rows[0][at] = chance.choice(TEXTS)


def separated(rows: Rows, chance: random.Random) -> None:
    """Other separators, decimal commas, quotes."""
    sort = chance.randrange(4)
    for row in rows:
        if sort == 0:
            row[:] = [chance.choice((";", "\t", "|")).join(row)]
        elif sort == 1:
            row[:] = [one.replace(".", ",") for one in row]
        elif sort == 2:
            row[:] = [f'"{one}"' for one in row]
        elif row:
            row[0] = chance.choice(("#", '"', " ", "")) + row[0]


TABLES = tuple(
    _table(one)
    for one in (
        *(cell, cell, cell, scaled, scaled, scaled, constant, shifted, few_rows, lost_rows, doubled_rows),
        *(other_order, ragged, lost_column, doubled_column, exchanged_columns, head, separated),
    )
)
