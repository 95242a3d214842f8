"""Tables whose columns say their unit and what they hold, as CSV, Parquet and FITS.

CSV has the unit in brackets behind the name. Parquet has ``unit`` and ``description`` in each field's metadata, FITS
the unit as TUNITn, in the standard's own spelling, and the description as TCOMMn; both say what the table is.
"""

from __future__ import annotations

import importlib.metadata
import io
import math
import unicodedata
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optics.numerics.frozen_map import FrozenMap
from twin.run.data_files import WRITER, csv_table

__all__ = ["ASCII_SIGNS", "FITS_UNITS", "TABLE_FORMATS", "DataColumn", "DataTable", "MissingPackage", "ascii_text"]

FITS_UNITS: Mapping[str, str] = FrozenMap(
    {
        **{name: name for name in ("arcsec", "arcmin", "mas", "deg", "rad", "urad", "mrad")},
        **{name: name for name in ("pm", "nm", "um", "mm", "m", "km", "us", "ms", "s", "K", "mK", "mW", "W")},
        **{"K/m": "K/m", "m/s": "m/s", "1/m": "m-1", "1/mm": "mm-1", "DN": "adu", "px": "pixel", "photons": "photon"},
    }
)
"""Unit as the program writes it -> as FITS 4.0 does, of those that FITS has."""
ASCII_SIGNS: Mapping[str, str] = FrozenMap(
    {"Δ": "d ", "σ": "sigma", "χ²": "chi2", "µ": "u", "\N{GREEK SMALL LETTER MU}": "u", "α": "alpha", "β": "beta"}
    | {"γ": "gamma", "°": "deg", "±": "+-", "×": "x", "\N{MINUS SIGN}": "-", "…": "..."}
)
"""Signs of reports -> what stands for them where only ASCII may stand."""


class MissingPackage(Exception):
    """A format needs a package that is not installed; the message says which and how to get it."""


@dataclass(frozen=True, eq=False)
class DataColumn:
    """A column.

    Attributes:
        name: of it.
        values: (N,) float64, where NaN is none; int64; or texts, where None is none.
        unit: of the numbers as the program writes it, empty for pure numbers and texts.
        description: what it holds.
    """

    name: str
    values: np.ndarray
    unit: str
    description: str

    @classmethod
    def of(cls, name: str, values: Sequence[Any], unit: str, description: str) -> DataColumn:
        """Of plain values: numbers, whole where all are, or texts; None where there is none."""
        there = [value for value in values if value is not None]
        whole = bool(there) and all(isinstance(value, bool | int) for value in there)
        if whole and len(there) == len(values) and all(-(2**63) <= value < 2**63 for value in there):
            return cls(name, np.array(values, np.int64), unit, description)
        # a float64 would change the digits of larger whole numbers
        exact = not whole or all(abs(value) <= 2**53 for value in there)
        if there and exact and all(isinstance(value, bool | int | float) for value in there):
            numbers = [math.nan if value is None else float(value) for value in values]
            return cls(name, np.array(numbers, np.float64), unit, description)
        texts = np.array([None if value is None else str(value) for value in values], object)
        return cls(name, texts, "", description)

    @property
    def plain(self) -> list[Any]:
        """Its values, None for none."""
        values = self.values.tolist()
        return [None if isinstance(value, float) and math.isnan(value) else value for value in values]


@dataclass(frozen=True, eq=False)
class DataTable:
    """A table.

    Attributes:
        name: of it and of its file.
        title: what it is.
        columns: of one length, their names all different.
        facts: what else is to be known: name -> text.
    """

    name: str
    title: str
    columns: tuple[DataColumn, ...]
    facts: Mapping[str, str] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Refuse columns that make no table."""
        names = [column.name for column in self.columns]
        if len(set(names)) < len(names) or len({len(column.values) for column in self.columns}) != 1:
            raise ValueError(f"table {self.name!r}: columns of one length with different names are needed")

    @property
    def rows(self) -> int:
        """How many."""
        return len(self.columns[0].values)

    def column(self, name: str) -> DataColumn:
        """The column of that name.

        Raises:
            KeyError: there is none.
        """
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(name)


def _csv(table: DataTable) -> bytes:
    heads = [f"{column.name} [{column.unit}]" if column.unit else column.name for column in table.columns]
    return csv_table([heads, *zip(*(column.plain for column in table.columns), strict=True)])


def _parquet(table: DataTable) -> bytes:
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError:
        raise MissingPackage(
            "Parquet needs the package pyarrow, which is not installed: .venv/bin/python -m pip install -e .[parquet]"
        ) from None
    fields, arrays = [], []
    for column in table.columns:
        array = pyarrow.array(column.plain, pyarrow.string()) if column.values.dtype.kind == "O" else None
        array = pyarrow.array(column.values, from_pandas=True) if array is None else array
        about = {"unit": column.unit, "description": column.description}
        fields.append(pyarrow.field(column.name, array.type, metadata=about))
        arrays.append(array)
    facts = {"title": table.title, "written_by": _writer(), **table.facts}
    out = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(fields, metadata=facts)), out)
    return out.getvalue()


def _writer() -> str:
    return f"{WRITER} {importlib.metadata.version(WRITER)}"


def ascii_text(text: str) -> str:
    """A text in the printable characters that FITS takes."""
    for sign, word in ASCII_SIGNS.items():
        text = text.replace(sign, word)
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "backslashreplace").decode()
    return "".join(letter if letter.isprintable() else " " for letter in plain)


def _fits(table: DataTable) -> bytes:
    # takes longer to import than all other formats
    from astropy.io import fits

    columns = []
    for column in table.columns:
        values, sort = column.values, {"f": "D", "i": "K"}.get(column.values.dtype.kind)
        if sort is None:
            values = np.array([ascii_text(value or "") for value in column.plain])
            sort = f"{max(values.dtype.itemsize // 4, 1)}A"
        columns.append(fits.Column(ascii_text(column.name), sort, FITS_UNITS.get(column.unit), array=values))
    primary, unit = fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns, name=ascii_text(table.name))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)  # of long texts, which are continued
        for k, column in enumerate(table.columns, start=1):
            also = f" [{column.unit}]" if column.unit and column.unit not in FITS_UNITS else ""
            unit.header[f"TCOMM{k}"] = ascii_text(column.description + also)
        for header in (primary.header, unit.header):
            header["CREATOR"] = (_writer(), "program that wrote this file")
            header["TITLE"] = ascii_text(table.title)
        for name, text in table.facts.items():
            unit.header.add_comment(ascii_text(f"{name}: {text}"))
    out = io.BytesIO()
    fits.HDUList([primary, unit]).writeto(out)
    return out.getvalue()


TABLE_FORMATS: dict[str, Callable[[DataTable], bytes]] = {"csv": _csv, "parquet": _parquet, "fits": _fits}
"""Ending of a file of a table -> its contents; raises MissingPackage. A new one is added here."""
