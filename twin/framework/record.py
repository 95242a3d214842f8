"""Declared results: the name, unit, meaning and format of a number are defined once.

A `Record` lists the quantities of one kind of result. The JSON files of a run folder, tables of reports, data tables
for other programs and the reference are all made from this list. The source of a record is the object (a fit, a
camera's changes) from which its numbers are taken; they are in SI units. The ending of a key names the unit in files,
and the record converts to it: a length with the key ``sigma_um`` is written as 1e6 times its value in metres.

Every JSON file of a run begins with ``schema`` (its kind and version) and ``reference_frames``, the reference of its
positions, velocities, directions, angles and times, and of tables or images beside it that cannot state their own.
netCDF files have the latter among their attributes. Axes and signs are those of docs/conventions.md.

The file reference_frames.json has, for every kind of file, the version of its keys (increased when keys are removed,
renamed or change their meaning), and quantity -> reference. A word in braces stands for one of the file's phrases.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib.resources import files
from typing import Any, Generic, TypeVar

import numpy as np

from analysis.arrays import ARCMIN, ARCSEC
from optics.numerics.number_tree import FrozenMap
from scenes.specs.procedures import PROCEDURES
from scenes.specs.study import unit_of
from twin.framework.artefact import Cell, DecimalNumber, Table, unit_for_reports
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
"""Number of units in one SI unit, by the name of the unit; units that are missing here and below are not converted."""
_SI: Mapping[str, float] = FrozenMap({"arcsec": ARCSEC, "arcmin": ARCMIN, "mas": 1e-3 * ARCSEC})
"""Size of each unit of angle in radians; a division by it rounds only once."""


def in_unit(value: Any, unit: str) -> Any:
    """Convert a number or an array from SI units to another unit; None and values without a unit are unchanged.

    Parameters
    ----------
    value : Any
        Number, array, sequence or mapping of numbers, or None.
    unit : str
        Unit as `scenes.specs.study.unit_of` reads it from a key; "mm2" and the like are squares, "1/mm" is an inverse.

    Returns
    -------
    Any
        Converted value.
    """
    if value is None or not unit:
        return value
    if isinstance(value, Mapping):
        return {name: in_unit(item, unit) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [in_unit(item, unit) for item in value]
    if unit == "deg":
        return np.degrees(value)
    if unit in _SI:
        return value / _SI[unit]
    power = (2 if unit.endswith("2") else 1) * (-1 if unit.startswith("1/") else 1)
    factor = _PER_SI.get(unit.removeprefix("1/").removesuffix("2"), 1.0) ** power
    return value if factor == 1.0 else factor * value


@dataclass(frozen=True, eq=False)
class Quantity(Generic[S]):
    """Number, text or array of a result, or a record within it.

    Attributes
    ----------
    key : str
        Name in files; the ending names the unit.
    of : callable
        Function of the source, the object of which the record lists numbers, that returns the value in SI units. With
        ``record``: the source of that record, a list or mapping of sources, or a mapping of such mappings. None if
        there is no value.
    meaning : str
        Description for the reference and for columns of other programs.
    head : str
        Name in tables of reports, without unit; empty to use the words of the key.
    decimals : int | None
        Digits after the point in reports; None for six significant digits.
    record : Record | None
        Record below the key.
    where_known : bool
        True if files have the key only where the value is not None.
    converted : bool
        True if the source is in SI units, False if it is already in the unit of the key.
    shown : str
        Unit in reports, empty for that of the key: ``percent`` for a fraction.
    warning : callable | None
        Function of the source that returns the warning to print if the value, a verdict on the result, is False.
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
        """Record of the quantities nested below the key; None for a plain value."""
        owner = getattr(self.of, "__self__", None)
        return self.record or (owner if isinstance(owner, Record) else None)

    @property
    def unit(self) -> str:
        """Unit in files as the program writes it, from the ending of the key; empty for a number without unit."""
        square = self.key.removesuffix("2") if self.key.endswith("m2") else ""
        return f"{unit_of((square,))}2" if square else unit_of((self.key,))

    @property
    def shown_head(self) -> str:
        """Column head in reports, with the unit in brackets."""
        words, unit = self.head or self.key.removesuffix(f"_{self.unit}").replace("_", " "), self.shown or self.unit
        return f"{words} [{unit_for_reports(unit)}]" if unit else words

    def shown_value(self, value: Any) -> Any:
        """Convert a value from the unit of files to that of reports."""
        return in_unit(value, self.shown)

    def value(self, source: S) -> Any:
        """Return the value of a source in the unit of files, not yet converted to plain data."""
        value = self.of(source)
        if self.record is None or value is None:
            return in_unit(value, self.unit) if self.converted else value
        if isinstance(value, Mapping):
            return _by_name(self.record, value)
        if isinstance(value, list | tuple):
            return [self.record(item) for item in value]
        return self.record(value)


def _sources(sources: Any) -> list[Any]:
    """Return the objects that a record describes as a list, from None, one object, a list or nested mappings."""
    several = list(sources.values()) if isinstance(sources, Mapping) else sources
    if isinstance(several, list):
        return [source for nested in several for source in _sources(nested)]
    return [] if sources is None else [sources]


def _by_name(record: Record[Any], sources: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record's numbers for every object of a nested mapping, under the same names."""
    return {
        k: _by_name(record, source) if isinstance(source, Mapping) else record(source) for k, source in sources.items()
    }


class Record(Generic[S]):
    """Quantities of one kind of result, in the order in which files list them.

    Calling a record with a source returns the plain data of a file.

    Attributes
    ----------
    meaning
        Description of the record.
    quantities
        Quantities with different keys.
    """

    def __init__(self, meaning: str, *quantities: Quantity[S]) -> None:
        keys = [quantity.key for quantity in quantities]
        if repeated := [key for key in keys if keys.count(key) > 1]:
            raise ValueError(f"two quantities of a record have the key {repeated[0]}")
        self.meaning, self.quantities = meaning, quantities

    def __iter__(self) -> Iterator[Quantity[S]]:
        """Iterate over the quantities."""
        return iter(self.quantities)

    def __getitem__(self, key: str) -> Quantity[S]:
        """Return the quantity of that key."""
        return next(quantity for quantity in self.quantities if quantity.key == key)

    @property
    def headed(self) -> list[str]:
        """Keys of the quantities that have a column head of their own, and so appear in tables of reports."""
        return [quantity.key for quantity in self.quantities if quantity.head]

    def __call__(self, source: S) -> dict[str, Any]:
        """Return the numbers of one source, the object that the record describes, as plain data for a JSON file."""
        values = ((quantity, quantity.value(source)) for quantity in self.quantities)
        return {
            quantity.key: plain_data(value)
            for quantity, value in values
            if not (quantity.where_known and value is None)
        }

    def rows(self, source: S) -> list[dict[str, Any]]:
        """Return the numbers of a source as rows; each of its quantities is an array of the same length."""
        columns = self(source)
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def warnings(self, source: S) -> Iterator[str]:
        """Yield the warnings of all verdicts of a source that are False, including those of nested records."""
        for quantity in self.quantities:
            if quantity.warning is not None and (verdict := quantity.of(source)) is not None and not verdict:
                yield quantity.warning(source)
            if quantity.record is not None:
                nested = quantity.of(source)
                for below in _sources(list(nested) if isinstance(nested, tuple) else nested):
                    yield from quantity.record.warnings(below)

    def of_part(self, part: Callable[[T], S]) -> list[Quantity[T]]:
        """Return the record's quantities as quantities of a larger object, which has this record's source as a part.

        Parameters
        ----------
        part : callable
            Function from the larger object to the source of this record.
        """

        def through(of: Callable[[S], Any]) -> Callable[[T], Any]:
            return lambda source: of(part(source))

        return [Quantity(**vars(quantity) | {"of": through(quantity.of)}) for quantity in self]

    def flat(self) -> Record[S]:
        """Return the record of the rows of a table.

        It has the quantities with a column head, including those of nested records that have one.
        """
        quantities: list[Quantity[Any]] = []
        for quantity in self:
            nested = () if quantity.record is None else quantity.record.flat()
            quantities += [
                replace(q, key=f"{quantity.key}.{q.key}", head=f"{q.head} {quantity.head}")
                for q in nested
                if quantity.head
            ]
            quantities += [quantity] if quantity.head and quantity.record is None else []
        return Record(self.meaning, *quantities)

    def _chosen(self, keys: Sequence[str]) -> list[Quantity[S]]:
        """Return the quantities of the given keys, or all if there are none."""
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
        """Return a report's table with the quantities of the record as columns.

        Parameters
        ----------
        name : str
            Name of the file.
        title : str
            Heading.
        caption : str
            Description of the content.
        rows : sequence or mapping of mappings
            Rows as this record, or the record that this one is `flat` of, returns them; a mapping adds its keys as the
            first column.
        keys : sequence of str
            Keys of the columns, in their order; all if empty.
        label : str
            Head of the column of names.
        digits : int
            Significant digits of numbers without decimals of their own.
        """

        def cells_of(row: Mapping[str, Any]) -> list[Cell]:
            return [quantity.shown_value(_below(row, quantity.key)) for quantity in shown]

        shown = self._chosen(keys)
        heads, decimals = [quantity.shown_head for quantity in shown], [quantity.decimals for quantity in shown]
        if isinstance(rows, Mapping):
            heads, decimals = [label, *heads], [None, *decimals]
            cells: list[list[Cell]] = [[first, *cells_of(row)] for first, row in rows.items()]
        else:
            cells = [cells_of(row) for row in rows]
        return Table(name, title, caption, heads, cells, decimals, digits)

    def lines(
        self, numbers: Mapping[str, Any], keys: Sequence[str] = (), truth: Mapping[str, Any] | None = None
    ) -> list[tuple[Cell, ...]]:
        """Return rows of a report's table with one quantity each: head or meaning, value, sigma if there is one, truth.

        Parameters
        ----------
        numbers : mapping
            Numbers as this record returns them; the sigma of a value has its key with ``_sigma``.
        keys : sequence of str
            Keys of the rows, in their order; all if empty.
        truth : mapping | None
            True values by the same keys; None for a table without them.
        """

        def cell(quantity: Quantity[S], value: Any) -> Cell:
            shown: Cell = quantity.shown_value(value)
            return (
                DecimalNumber(shown, quantity.decimals)
                if isinstance(shown, float) and quantity.decimals is not None
                else shown
            )

        chosen = self._chosen(keys)
        parts = [numbers, {quantity.key: numbers.get(f"{quantity.key}_sigma") for quantity in chosen}]
        parts = [*(part for part in parts if any(part.get(quantity.key) is not None for quantity in chosen))]
        parts += [] if truth is None else [truth]
        heads = (replace(quantity, head=quantity.head or quantity.meaning).shown_head for quantity in chosen)
        return [
            (head, *(cell(quantity, p.get(quantity.key)) for p in parts))
            for head, quantity in zip(heads, chosen, strict=True)
        ]

    def data_table(
        self, name: str, title: str, rows: Sequence[Mapping[str, Any]], keys: Sequence[str] = ()
    ) -> DataTable:
        """Return a table for other programs, with the units and descriptions of its columns.

        The parameters are those of `table`.
        """
        columns = (
            DataColumn.of(quantity.key, [row.get(quantity.key) for row in rows], quantity.unit, quantity.meaning)
            for quantity in self._chosen(keys)
        )
        return DataTable(name, title, tuple(columns))


def _below(row: Mapping[str, Any], key: str) -> Any:
    """Return a value of nested mappings by a key with dots, such as ``fit.sigma``; None if there is none."""
    for name in key.split("."):
        row = (row or {}).get(name)  # type: ignore[assignment]
    return row


def plain_data(value: Any) -> Any:
    """Convert a value to plain data that JSON can hold.

    Parameters
    ----------
    value : Any
        None, string, truth value, number, array, sequence, mapping with string keys, or dataclass (its fields are
        written in their order), all possibly nested. Units are not converted.

    Returns
    -------
    Any
        Dict, list, str, int, float, bool or None.

    Raises
    ------
    TypeError
        The value has another type, a mapping has other keys, or a number is complex.
    """
    if value is None or isinstance(value, str | bool | np.bool_):
        return bool(value) if isinstance(value, np.bool_) else value
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {attribute.name: plain_data(getattr(value, attribute.name)) for attribute in fields(value)}
    if isinstance(value, Mapping):
        if other := [key for key in value if not isinstance(key, str)]:
            raise TypeError(f"a key must be a text: {other[0]!r}")
        return {str(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain_data(value.tolist())
    if isinstance(value, list | tuple):
        return [plain_data(item) for item in value]
    raise TypeError(f"cannot be converted to plain data: {type(value).__name__}")


# reference frames

_FIRST = 2
"""Version of the keys of a test that defines its reference frames itself (not in reference_frames.json)."""
_READ = json.loads((files(__package__) / "reference_frames.json").read_text("utf-8"))
_VERSIONS: Mapping[str, int] = FrozenMap({kind: content["version"] for kind, content in _READ["files"].items()})
FRAMES: Mapping[str, Mapping[str, str]] = FrozenMap(
    {
        kind: {quantity: text.format_map(_READ["phrases"]) for quantity, text in content["frames"].items()}
        for kind, content in _READ["files"].items()
    }
)
"""Description of the reference frame of each quantity, by kind of file and quantity."""


def described(kind: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of a file preceded by its schema and reference frames.

    Parameters
    ----------
    kind : str
        Kind of the file.
    data : mapping
        Content of the file, plain data.

    Raises
    ------
    KeyError
        The kind has no entry in `FRAMES` and is no test with its own `frames`.
    """
    if (frames := FRAMES.get(kind)) is None:
        frames = {procedure.kind: procedure.frames for procedure in PROCEDURES.values()}[kind]
    return {"schema": f"{kind} {_VERSIONS.get(kind, _FIRST)}", "reference_frames": dict(frames), **data}


def frames_text(kind: str) -> str:
    """Return the reference frames of a kind of file in one line, for an attribute."""
    return "; ".join(f"{quantity}: {frame}" for quantity, frame in FRAMES[kind].items())
