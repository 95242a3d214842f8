"""Declared results: a number says once what it is called, its unit, what it means and how it is shown.

A `Record` lists the quantities of one kind of result. What the JSON files of a run folder, the tables of reports, data
tables for other programs and the reference say of them is read off this list. Sources are in SI units. The ending of a
key names the unit in which files have the number, and the record converts it: a length under ``sigma_um`` is a million
times the metres that its source has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from analysis.arrays import ARCMIN, ARCSEC
from optics.numerics.number_tree import FrozenMap
from scenes.specs.study import unit_of
from twin.framework.artefact import Cell, OwnDecimals, Table, shown_unit
from twin.framework.data_files import DataColumn, DataTable

S = TypeVar("S")
T = TypeVar("T")
_PER_SI: Mapping[str, float] = FrozenMap(
    {
        "pm": 1e12,
        "nm": 1e9,
        "um": 1e6,
        "mm": 1e3,
        "m": 1.0,
        "km": 1e-3,
        "us": 1e6,
        "ms": 1e3,
        "min": 1.0 / 60.0,
        "mK": 1e3,
        "mW": 1e3,
    }
    | {"percent": 1e2, "ppm": 1e6, "urad": 1e6, "mrad": 1e3}
)
"""Unit -> how many of it are one of SI; units that are missing here and below are those of the source."""
_SI: Mapping[str, float] = FrozenMap({"arcsec": ARCSEC, "arcmin": ARCMIN, "mas": 1e-3 * ARCSEC})
"""Unit -> its size in radians: a division keeps one rounding."""


def in_unit(value: Any, unit: str) -> Any:
    """A number or an array in SI units as so many of a unit; None and what has no unit stay as they are.

    Parameters
    ----------
    value : Any
        Number, array, sequence or mapping of numbers, or None.
    unit : str
        As `scenes.specs.study.unit_of` reads it off a key; "mm2" and the like are squares, "1/mm" is an inverse.
    """
    if value is None or not unit:
        return value
    if isinstance(value, Mapping):
        return {name: in_unit(one, unit) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [in_unit(one, unit) for one in value]
    if unit == "deg":
        return np.degrees(value)
    if unit in _SI:
        return value / _SI[unit]
    power = (2 if unit.endswith("2") else 1) * (-1 if unit.startswith("1/") else 1)
    factor = _PER_SI.get(unit.removeprefix("1/").removesuffix("2"), 1.0) ** power
    return value if factor == 1.0 else factor * value


@dataclass(frozen=True, eq=False)
class Quantity(Generic[S]):
    """One number, text or array of a result, or a record within it.

    Attributes
    ----------
    key : str
        Its name in files; the ending names the unit.
    of : Callable[[S], Any]
        Source -> value in SI units, or, with a record, what that record is of: one source, a list or a mapping of
        sources, or a mapping of such mappings; None where there is none.
    meaning : str
        What it is, for the reference and for the columns of other programs.
    head : str
        How tables of reports call it, without its unit; empty for the key's words.
    decimals : int | None
        That reports show, None for six significant digits.
    record : Record[Any] | None
        Of what stands below the key.
    where_known : bool
        Files have the key only where the value is not None.
    converted : bool
        Whether the source is in SI units; False where it already is in the unit of the key.
    shown : str
        Unit in which reports have it, empty for that of the key: ``percent`` of a share.
    warning : Callable[[S], str] | None
        Source -> the sentence that warns readers where the value is False; of a verdict on the result.
    """

    key: str
    of: Callable[[S], Any]
    meaning: str = ""
    head: str = ""
    decimals: int | None = None
    record: Record[Any] | None = None
    where_known: bool = False
    converted: bool = True
    shown: str = ""
    warning: Callable[[S], str] | None = None

    @property
    def below(self) -> Record[Any] | None:
        """The record whose quantities stand below the key, also where its rows do; None for a plain value."""
        owner = getattr(self.of, "__self__", None)
        return self.record or (owner if isinstance(owner, Record) else None)

    @property
    def unit(self) -> str:
        """Unit as the program writes it, empty for none."""
        square = self.key.removesuffix("2") if self.key.endswith("m2") else ""
        return f"{unit_of((square,))}2" if square else unit_of((self.key,))

    @property
    def shown_head(self) -> str:
        """Head of a report's column, with its unit in brackets."""
        words, unit = self.head or self.key.removesuffix(f"_{self.unit}").replace("_", " "), self.shown or self.unit
        return f"{words} [{shown_unit(unit)}]" if unit else words

    def shown_value(self, value: Any) -> Any:
        """A value as files have it, in the unit of reports."""
        return in_unit(value, self.shown)

    def value(self, source: S) -> Any:
        """The value as files have it, before it is plain data."""
        found = self.of(source)
        if self.record is None or found is None:
            return in_unit(found, self.unit) if self.converted else found
        if isinstance(found, Mapping):
            return _by_name(self.record, found)
        if isinstance(found, list | tuple):
            return [self.record(one) for one in found]
        return self.record(found)


def _sources(found: Any) -> list[Any]:
    """Return the sources of a record: none for None, one, those of a list, or of a mapping and the mappings in it."""
    several = list(found.values()) if isinstance(found, Mapping) else found
    if isinstance(several, list):
        return [source for below in several for source in _sources(below)]
    return [] if found is None else [found]


def _by_name(record: Record[Any], sources: Mapping[str, Any]) -> dict[str, Any]:
    """A record of every source of a mapping; of one whose values are mappings, one level further down."""
    return {k: _by_name(record, one) if isinstance(one, Mapping) else record(one) for k, one in sources.items()}


class Record(Generic[S]):
    """The quantities of one kind of result, in the order in which files have them.

    Called with a source it gives the plain data of a file.

    Attributes
    ----------
    meaning
        What the record is.
    quantities
        Of it, their keys all different.
    """

    def __init__(self, meaning: str, *quantities: Quantity[S]) -> None:
        keys = [one.key for one in quantities]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise ValueError(f"two quantities of one record are called {twice[0]}")
        self.meaning, self.quantities = meaning, quantities

    def __iter__(self) -> Iterator[Quantity[S]]:
        """Iterate over the quantities."""
        return iter(self.quantities)

    def __getitem__(self, key: str) -> Quantity[S]:
        """The quantity of that key."""
        return next(one for one in self.quantities if one.key == key)

    @property
    def headed(self) -> list[str]:
        """Keys of the quantities that have a head for tables."""
        return [one.key for one in self.quantities if one.head]

    def __call__(self, source: S) -> dict[str, Any]:
        """The numbers of one source, as JSON holds them."""
        found = ((one, one.value(source)) for one in self.quantities)
        return {one.key: plain_data(value) for one, value in found if not (one.where_known and value is None)}

    def rows(self, source: S) -> list[dict[str, Any]]:
        """The numbers of a source each of whose quantities is an array of one length, row by row."""
        columns = self(source)
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def warnings(self, source: S) -> Iterator[str]:
        """Yield the warnings of all verdicts of a source that are False, those of the records below it included."""
        for one in self.quantities:
            if one.warning is not None and (verdict := one.of(source)) is not None and not verdict:
                yield one.warning(source)
            if one.record is not None:
                found = one.of(source)
                for below in _sources(list(found) if isinstance(found, tuple) else found):
                    yield from one.record.warnings(below)

    def of_part(self, part: Callable[[T], S]) -> list[Quantity[T]]:
        """Quantities of this record for the record of an object of which this record's source is a part."""

        def through(of: Callable[[S], Any]) -> Callable[[T], Any]:
            return lambda source: of(part(source))

        return [Quantity(**vars(one) | {"of": through(one.of)}) for one in self]

    def flat(self) -> Record[S]:
        """The record of its rows as a table has them: quantities with a head, and those of records that have one."""
        found: list[Quantity[Any]] = []
        for one in self:
            below = () if one.record is None else one.record.flat()
            found += [replace(q, key=f"{one.key}.{q.key}", head=f"{q.head} {one.head}") for q in below if one.head]
            found += [one] if one.head and one.record is None else []
        return Record(self.meaning, *found)

    def _chosen(self, keys: Sequence[str]) -> list[Quantity[S]]:
        return [self[key] for key in keys] if keys else list(self.quantities)

    def table(
        self,
        name: str,
        title: str,
        caption: str,
        rows: Sequence[Mapping[str, Any]] | Mapping[str, Mapping[str, Any]],
        keys: Sequence[str] = (),
        label: str = "",
        digits: int = 6,
    ) -> Table:
        """A table of a report.

        Parameters
        ----------
        name : str
            Of its file.
        title : str
            heading.
        caption : str
            What it shows.
        rows : Sequence[Mapping[str, Any]] | Mapping[str, Mapping[str, Any]]
            As this record gives them, or the record that this one is `flat` of; or by name, which then is the first
            column.
        keys : Sequence[str]
            Of the columns, in their order; all if none are given.
        label : str
            Head of the column of names.
        digits : int
            Significant ones of numbers without decimals of their own.
        """

        def told(row: Mapping[str, Any]) -> list[Cell]:
            return [one.shown_value(_below(row, one.key)) for one in shown]

        shown = self._chosen(keys)
        heads, decimals = [one.shown_head for one in shown], [one.decimals for one in shown]
        if isinstance(rows, Mapping):
            heads, decimals = [label, *heads], [None, *decimals]
            cells: list[list[Cell]] = [[first, *told(row)] for first, row in rows.items()]
        else:
            cells = [told(row) for row in rows]
        return Table(name, title, caption, heads, cells, decimals, digits)

    def lines(
        self, numbers: Mapping[str, Any], keys: Sequence[str] = (), truth: Mapping[str, Any] | None = None
    ) -> list[tuple[Cell, ...]]:
        """Rows of a report's table with a quantity each: head or meaning, value, sigma where one has a sigma, truth.

        Parameters
        ----------
        numbers : Mapping[str, Any]
            As this record gives them; a sigma stands beside its value, under the key with ``_sigma``.
        keys : Sequence[str]
            Of the rows, in their order; all if none are given.
        truth : Mapping[str, Any] | None
            True values by the same keys, None for a table without them.
        """

        def cell(one: Quantity[S], value: Any) -> Cell:
            shown: Cell = one.shown_value(value)
            return OwnDecimals(shown, one.decimals) if isinstance(shown, float) and one.decimals is not None else shown

        chosen = self._chosen(keys)
        parts = [numbers, {one.key: numbers.get(f"{one.key}_sigma") for one in chosen}]
        parts = [*(part for part in parts if any(part.get(one.key) is not None for one in chosen))]
        parts += [] if truth is None else [truth]
        heads = (replace(one, head=one.head or one.meaning).shown_head for one in chosen)
        return [(head, *(cell(one, p.get(one.key)) for p in parts)) for head, one in zip(heads, chosen, strict=True)]

    def data_table(
        self, name: str, title: str, rows: Sequence[Mapping[str, Any]], keys: Sequence[str] = ()
    ) -> DataTable:
        """A table for other programs, whose columns say their unit and meaning; arguments as for `table`."""
        columns = (
            DataColumn.of(one.key, [row.get(one.key) for row in rows], one.unit, one.meaning)
            for one in self._chosen(keys)
        )
        return DataTable(name, title, tuple(columns))


def _below(row: Mapping[str, Any], key: str) -> Any:
    """Return what stands in a row under a key, whose dots lead into the mappings of the row; None for nothing."""
    for name in key.split("."):
        row = (row or {}).get(name)  # type: ignore[assignment]
    return row


def plain_data(value: Any) -> Any:
    """What JSON can hold of a value.

    Parameters
    ----------
    value : Any
        None, a string, a truth value, a number, an array, a sequence, a mapping with strings as keys, or a dataclass,
        whose fields are written in their order; all of them may be nested. Nothing is converted here.

    Returns
    -------
    Any
        Dict, list, str, int, float, bool or None.

    Raises
    ------
    TypeError
        Anything else, a mapping with other keys, a complex number.
    """
    if value is None or isinstance(value, str | bool | np.bool_):
        return bool(value) if isinstance(value, np.bool_) else value
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: plain_data(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        if other := [key for key in value if not isinstance(key, str)]:
            raise TypeError(f"a key that is no text: {other[0]!r}")
        return {str(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain_data(value.tolist())
    if isinstance(value, list | tuple):
        return [plain_data(item) for item in value]
    raise TypeError(f"no plain data: {type(value).__name__}")
