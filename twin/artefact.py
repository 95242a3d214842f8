"""Figures, tables and data that a group of checks adds to the report and to the run folder."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from twin.data_file import csv_table
from twin.report.numbers import fixed

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")
_SVG_NAMESPACE = 'xmlns="http://www.w3.org/2000/svg"'

Cell = str | float | int | None


@dataclass(frozen=True, eq=False)
class Artefact:
    """Something to show beside the checks.

    Attributes:
        name: of its file, without ending: small letters, digits, - and _; unique in its group.
        title: heading in the report.
        caption: what it shows, in sentences.
    """

    name: str
    title: str
    caption: str

    def __post_init__(self) -> None:
        """Refuse names that are no file names."""
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"artefact name {self.name!r}: only small letters, digits, - and _ can be used")
        self.content()

    @property
    def kind(self) -> str:
        """``svg``, ``png``, ``csv`` or ``json``; also the ending of the file."""
        raise NotImplementedError

    def content(self) -> bytes:
        """What the file holds."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class SvgFigure(Artefact):
    """A drawing; ``svg`` is one <svg> element, as ``twin.report.svg.to_svg`` makes it."""

    svg: str

    @property
    def kind(self) -> str:
        """Ending of the file."""
        return "svg"

    def content(self) -> bytes:
        """The drawing as a file of its own."""
        if not self.svg.startswith("<svg"):
            raise ValueError(f"artefact {self.name!r}: not an <svg> element")
        head = self.svg[: self.svg.index(">")]
        svg = self.svg if " xmlns=" in head else self.svg.replace("<svg", f"<svg {_SVG_NAMESPACE}", 1)
        return f'<?xml version="1.0" encoding="utf-8"?>\n{svg}'.encode()


@dataclass(frozen=True, eq=False)
class PngFigure(Artefact):
    """A picture; ``png`` is the file's content."""

    png: bytes

    @property
    def kind(self) -> str:
        """Ending of the file."""
        return "png"

    @property
    def address(self) -> str:
        """The picture as a data address, for a page that needs nothing else."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")

    def content(self) -> bytes:
        """The picture."""
        if not self.png.startswith(b"\x89PNG"):
            raise ValueError(f"artefact {self.name!r}: not a PNG file")
        return self.png


@dataclass(frozen=True, eq=False)
class Table(Artefact):
    """A table for the report, and as CSV; heads carry the units.

    ``decimals`` are those that the report shows of a column's numbers, None for six significant digits; the CSV holds
    all digits.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    decimals: Sequence[int | None] = ()

    def shown(self) -> list[list[Cell]]:
        """The rows as the report shows them."""
        places = [*self.decimals, *[None] * (len(self.heads) - len(self.decimals))]
        return [
            [
                fixed(cell, place) if isinstance(cell, float) and place is not None else cell
                for cell, place in zip(row, places, strict=True)
            ]
            for row in self.rows
        ]

    @property
    def kind(self) -> str:
        """Ending of the file."""
        return "csv"

    def content(self) -> bytes:
        """The table with all its digits."""
        for row in self.rows:
            if len(row) != len(self.heads):
                raise ValueError(f"artefact {self.name!r}: a row of {len(row)} cells under {len(self.heads)} heads")
        return csv_table([self.heads, *self.rows])


@dataclass(frozen=True, eq=False)
class Data(Artefact):
    """Plain data, kept as JSON and named in the report."""

    data: Any

    @property
    def kind(self) -> str:
        """Ending of the file."""
        return "json"

    def content(self) -> bytes:
        """The data; NaN and infinities are refused."""
        return (json.dumps(self.data, indent=2, allow_nan=False) + "\n").encode()
