"""Figures, tables and data of reports and run folders, and numbers as text."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from markupsafe import Markup

from optics.numerics.number_tree import FrozenMap
from twin.framework.data_files import csv_table

MINUS = "\N{MINUS SIGN}"
SAME = 1e-6
"""Below this a number per unit motion (arcsec, um) is rounding and is shown as 0."""
SYMBOLS = {"d_alpha": "Δα", "d_beta": "Δβ", "d_gamma": "Δγ", "d_f": "Δf"}
"""How tables, figures and sentences call the changes of a camera; units stand in brackets: Δα [arcsec], Δf [µm], with
the micro sign. Keys of files are plain letters with the unit at the end: d_alpha_arcsec, d_f_um.
"""
FAR = 3.0
"""Residuals beyond this many sigma are marked."""


def shown_unit(unit: str) -> str:
    """A unit as reports write it, of its name in files: ``µm`` of ``um``, ``%`` of ``percent``."""
    return unit.replace("um", "µm").replace("percent", "%")


def _typeset(text: str) -> str:
    return text.replace("-", MINUS)


def fixed(value: float, decimals: int, sign: bool = False) -> str:
    """A fixed-point number; what rounds to zero has no sign.

    Parameters
    ----------
    value : float
        The number; infinities and NaN become a dash.
    decimals : int
        Digits behind the point.
    sign : bool
        Whether numbers above zero have a plus sign.
    """
    if not math.isfinite(value):
        return "\N{EM DASH}"
    rounded = round(value, decimals) + 0.0
    return _typeset(f"{rounded:+.{decimals}f}" if sign and rounded else f"{rounded:.{decimals}f}")


def decimals_for(sigma: float, digits: int = 2, most: int = 7, default: int = 4) -> int:
    """Decimals that show ``sigma`` with that many digits.

    Parameters
    ----------
    sigma : float
        Standard deviation, in the unit in which numbers are shown.
    digits : int
        Significant digits of it that are to be seen.
    most : int
        Decimals at most.
    default : int
        Decimals where sigma is zero or not finite.
    """
    if not (math.isfinite(sigma) and sigma > 0):
        return default
    return min(max(digits - 1 - math.floor(math.log10(sigma)), 0), most)


def significant(value: float, digits: int = 3, floor: float = SAME, sign: bool = False) -> str:
    """A number with some significant digits, one less where a power of ten is written; below ``floor`` it is 0.

    Parameters
    ----------
    value : float
        The number; infinities and NaN become a dash.
    digits : int
        Significant digits.
    floor : float
        Size below which a number is rounding and is shown as 0.
    sign : bool
        Whether numbers above zero have a plus sign.
    """
    if not math.isfinite(value):
        return "\N{EM DASH}"
    if value == 0.0 or abs(value) < floor:
        return "0"
    value = float(f"{value:.{digits - 1}e}")
    size = math.floor(math.log10(abs(value)))
    if size < -3 or size > 6:
        mantissa, _, exponent = f"{value:{'+' if sign else ''}.{max(digits - 2, 0)}e}".partition("e")
        return _typeset(f"{mantissa}e{int(exponent)}")
    text = f"{value:{'+' if sign else ''}.{max(digits - 1 - size, 0)}f}"
    return _typeset(text)


def plain(value: float, digits: int = 5) -> str:
    """A number that was given, without trailing zeros.

    Parameters
    ----------
    value : float
        The number.
    digits : int
        Significant digits at most.
    """
    return _typeset(f"{value:.{digits}g}")


def residual(value: float, sigma: float) -> float | None:
    """The ratio value / sigma, or None without noise."""
    return value / sigma if sigma > 0 else None


def tick_text(value: float) -> str:
    """A whole number with its sign, for axes."""
    return _typeset(f"{value:+,.0f}").replace(",", "\N{NARROW NO-BREAK SPACE}") if value else "0"


def residual_text(ratio: float | None) -> str:
    """A residual in sigma."""
    if ratio is None:
        return "\N{EM DASH}"
    if abs(ratio) < 10:
        return fixed(ratio, 1, sign=True)
    return _typeset(f"{ratio:+,.0f}").replace(",", "\N{NARROW NO-BREAK SPACE}")


_NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")
_SVG_NAMESPACE = 'xmlns="http://www.w3.org/2000/svg"'

Cell = str | float | int | None


class OwnDecimals(float):
    """A number of a table that is shown with decimals of its own, as in a column whose rows have different units."""

    def __new__(cls, value: float, decimals: int) -> OwnDecimals:
        """The number ``value``, shown with so many decimals."""
        made = super().__new__(cls, value)
        made.decimals = decimals
        return made

    decimals: int


class Marked(str):
    """A text of a table's cell that says more than itself.

    Attributes
    ----------
    below : str
        a second, smaller line.
    look : str
        How it is set off, a class of the style sheet: ``truth``, ``near``, ``far``, ``wrong``, a verdict.
    key : str
        Name by which programs find the cell in a page.
    hint : str
        Shown to who points at the cell.
    """

    def __new__(cls, text: str, below: str = "", look: str = "", key: str = "", hint: str = "") -> Marked:
        """The text ``text`` with what else the cell says."""
        made = super().__new__(cls, text)
        made.below, made.look, made.key, made.hint = below, look, key, hint
        return made

    below: str
    look: str
    key: str
    hint: str


def residual_cell(text: str, ratio: float | None, key: str, hint: str = "") -> Marked:
    """A reading with its departure from the truth in sigma below it, and a mark where that is beyond FAR.

    Parameters
    ----------
    text : str
        The reading.
    ratio : float | None
        Reading minus truth over sigma; None without noise.
    key : str
        Name by which programs find the cell.
    hint : str
        Shown to who points at the cell.
    """
    far = ratio is not None and abs(ratio) > FAR
    return Marked(text, f"{'▲' if far else '●'} {residual_text(ratio)} σ", "far" if far else "near", key, hint)


@dataclass(frozen=True, eq=False)
class Artefact:
    """Something to show beside the checks.

    Attributes
    ----------
    name : str
        Of its file, without ending: small letters, digits, - and _; unique in its group.
    title : str
        Heading in the report; empty for none.
    caption : str
        What it shows, in sentences; words between backticks are shown as code.
    kind : str
        Ending of its file: ``svg``, ``png``, ``csv``, ``json``.
    within : str | None
        File of the run folder that holds it; None for a file of its own, empty if only the page shows it.
    full : Table | None
        Table with all digits that a reader can take away from the page.
    """

    kind: ClassVar[str]
    name: str
    title: str
    caption: str
    within: str | None = field(default=None, kw_only=True)
    full: Table | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Refuse names that are no file names."""
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"artefact name {self.name!r}: only small letters, digits, - and _ can be used")
        self.content()

    @property
    def file(self) -> str:
        """Path of its file in the run folder, empty if it has none."""
        return f"artefacts/{self.name}.{self.kind}" if self.within is None else self.within

    @property
    def handed(self) -> Table | None:
        """What a reader can take away from the page with all digits."""
        return self.full

    @property
    def said(self) -> str:
        """The caption, or what stands in its place."""
        return self.caption

    def content(self) -> bytes:
        """What the file holds."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class SvgFigure(Artefact):
    """A drawing; ``svg`` is one <svg> element, as ``twin.framework.svg.to_svg`` makes it."""

    kind: ClassVar[str] = "svg"
    svg: str

    @property
    def drawing(self) -> Markup:
        """The drawing for a page: made by this program, not by a user."""
        return Markup(self.svg)

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

    kind: ClassVar[str] = "png"
    png: bytes

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

    ``decimals`` are those that the report shows of a column's numbers, None for so many significant ``digits``; the CSV
    holds all digits. ``over``: heads above the heads, each with the number of columns that it spans. ``bands``: row ->
    title of the rows from there on, of a table in parts.
    """

    kind: ClassVar[str] = "csv"
    heads: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    decimals: Sequence[int | None] = ()
    digits: int = 6
    over: Sequence[tuple[str, int]] = ()
    bands: Mapping[int, str] = field(default_factory=FrozenMap)

    @property
    def handed(self) -> Table | None:
        """``full``, or itself if its cells are plain numbers and texts."""
        if self.full is not None or any(isinstance(cell, Marked) for row in self.rows for cell in row):
            return self.full
        return self

    def shown(self) -> list[list[Cell]]:
        """The rows as the report shows them."""
        places = [*self.decimals, *[None] * (len(self.heads) - len(self.decimals))]
        return [
            [
                self._text(cell, place) if isinstance(cell, float) else cell
                for cell, place in zip(row, places, strict=True)
            ]
            for row in self.rows
        ]

    @property
    def cells(self) -> list[list[Marked]]:
        """The rows for a page."""
        return [[cell if isinstance(cell, Marked) else Marked(cell_text(cell)) for cell in row] for row in self.shown()]

    @property
    def words(self) -> list[bool]:
        """Whether a column holds words, which begin at its left, or numbers."""
        columns = [[row[k] for row in self.rows] for k in range(len(self.heads))]
        return [all(isinstance(cell, str) and _is_word(cell) for cell in column) for column in columns]

    def _text(self, value: float, place: int | None) -> str:
        if isinstance(value, OwnDecimals):
            return fixed(value, value.decimals)
        return significant(value, self.digits, floor=0.0) if place is None else fixed(value, place)

    def content(self) -> bytes:
        """The table with all its digits."""
        for row in self.rows:
            if len(row) != len(self.heads):
                raise ValueError(f"artefact {self.name!r}: a row of {len(row)} cells under {len(self.heads)} heads")
        return csv_table([self.heads, *self.rows])

    @property
    def address(self) -> str:
        """The table as a data address: a page can hand it out without a file beside it."""
        return "data:text/csv;charset=utf-8;base64," + base64.b64encode(self.content()).decode("ascii")


def cell_text(value: Cell) -> str:
    """A cell of a table, with at most six digits."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return plain(value) if isinstance(value, int) else significant(value, 6, floor=0.0)


def _is_word(cell: str) -> bool:
    return not isinstance(cell, Marked) or not cell.look or cell.look.startswith(("text", "verdict"))


@dataclass(frozen=True, eq=False)
class Data(Artefact):
    """Plain data, kept as JSON and named in the report."""

    kind: ClassVar[str] = "json"
    data: Any

    def content(self) -> bytes:
        """The data; NaN and infinities are refused."""
        return (json.dumps(self.data, indent=2, allow_nan=False) + "\n").encode()


@dataclass(frozen=True, eq=False)
class Text(Artefact):
    """Words of a report beside its figures and tables: ``caption`` is a paragraph, ``points`` are a list below it."""

    kind: ClassVar[str] = "txt"
    points: Sequence[str] = ()

    def content(self) -> bytes:
        """The words."""
        return "\n".join([self.caption, *self.points, ""]).encode()


@dataclass(frozen=True, eq=False)
class Piece(Artefact):
    """A part of a page that this program wrote, with all texts of users escaped in it."""

    kind: ClassVar[str] = "html"
    markup: Markup

    def content(self) -> bytes:
        """The part."""
        return self.markup.encode()


@dataclass(frozen=True, eq=False)
class Undrawn(Artefact):
    """A note in the place of a figure that could not be drawn.

    Attributes
    ----------
    why : str
        The error.
    """

    kind: ClassVar[str] = "txt"
    why: str

    def content(self) -> bytes:
        """The note."""
        return f"{self.note}\n".encode()

    @property
    def note(self) -> str:
        """What is missing, and why."""
        return f"the figure {self.title!r} could not be drawn: {self.why}"

    @property
    def said(self) -> str:
        """The note as a sentence."""
        return f"{self.note[0].upper()}{self.note[1:]}."


@dataclass(frozen=True, eq=False)
class CameraFile(Data):
    """A camera as a file of the library; ``data`` is its YAML text."""

    kind: ClassVar[str] = "yaml"

    def content(self) -> bytes:
        """The file."""
        return str(self.data).encode()


@dataclass(frozen=True, eq=False)
class CsvFile(CameraFile):
    """A table that other files name, kept beside the page; ``data`` is its text."""

    kind: ClassVar[str] = "csv"
