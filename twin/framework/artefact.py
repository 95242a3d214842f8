"""Figures, tables and data files of reports and run folders, and the formatting of numbers as text."""

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
"""Absolute value below which a number per unit motion (per arcsec or µm) is taken as rounding error and shown as 0."""
SYMBOLS = {"d_alpha": "Δα", "d_beta": "Δβ", "d_gamma": "Δγ", "d_f": "Δf"}
"""Symbols of the changes of a camera in tables, figures and sentences. The unit follows in brackets, with the micro
sign: Δα [arcsec], Δf [µm]. Keys of files are plain letters with the unit at the end: d_alpha_arcsec, d_f_um.
"""
LONG_TABLE = 20
"""Number of rows above which a page folds a table."""
FAR = 3.0
"""Residuals beyond this many sigma are marked in tables."""


def unit_for_reports(unit: str) -> str:
    """Return a unit as reports spell it, from its name in files: ``µm`` for ``um``, ``%`` for ``percent``."""
    return unit.replace("um", "µm").replace("percent", "%")


def typeset(text: str) -> str:
    """Return a text with typographic minus signs before numbers and in powers of ten; code between backticks is kept.

    A hyphen within a word, a date or a range stays.
    """
    parts = text.split("`")
    parts[::2] = [_POWER.sub(_power_text, _NEGATIVE.sub(MINUS, part)) for part in parts[::2]]
    return "`".join(parts)


_NEGATIVE = re.compile(r"(?<![\w.,)\]\-\N{MINUS SIGN}+/])-(?=\.?\d)")
_POWER = re.compile(r"(?<=\d)e([-+])0*(?=\d)")


def _power_text(power: re.Match[str]) -> str:
    """Return the exponent of a power of ten as reports write it."""
    return f"e{MINUS}" if power[1] == "-" else "e"


def _with_minus(text: str) -> str:
    """Replace the hyphens of a formatted number by typographic minus signs."""
    return text.replace("-", MINUS)


def fixed(value: float, decimals: int, sign: bool = False) -> str:
    """Format a number with a fixed number of decimals; a number that rounds to zero has no sign.

    Parameters
    ----------
    value : float
        Number to format; infinities and NaN become a dash.
    decimals : int
        Digits after the decimal point.
    sign : bool
        True to write a plus sign before positive numbers.

    Returns
    -------
    str
        Formatted number, with a typographic minus sign.
    """
    if not math.isfinite(value):
        return "\N{EM DASH}"
    rounded = round(value, decimals) + 0.0
    return _with_minus(f"{rounded:+.{decimals}f}" if sign and rounded else f"{rounded:.{decimals}f}")


def decimals_for(sigma: float, digits: int = 2, most: int = 7, default: int = 4) -> int:
    """Return the number of decimals that shows a standard deviation with the requested number of significant digits.

    Parameters
    ----------
    sigma : float
        Standard deviation, in the unit in which the numbers are shown.
    digits : int
        Significant digits of sigma to show.
    most : int
        Largest number of decimals.
    default : int
        Number of decimals if sigma is zero or not finite.

    Returns
    -------
    int
        Digits after the decimal point.
    """
    if not (math.isfinite(sigma) and sigma > 0):
        return default
    return min(max(digits - 1 - math.floor(math.log10(sigma)), 0), most)


def significant(value: float, digits: int = 3, floor: float = SAME, sign: bool = False) -> str:
    """Format a number with a number of significant digits.

    Sizes below 1e-3 or from 1e7 are written with a power of ten and one digit less.

    Parameters
    ----------
    value : float
        Number to format; infinities and NaN become a dash.
    digits : int
        Significant digits.
    floor : float
        Absolute value below which the number is rounding error and is shown as 0.
    sign : bool
        True to write a plus sign before positive numbers.

    Returns
    -------
    str
        Formatted number, with a typographic minus sign.
    """
    if not math.isfinite(value):
        return "\N{EM DASH}"
    if value == 0.0 or abs(value) < floor:
        return "0"
    value = float(f"{value:.{digits - 1}e}")
    size = math.floor(math.log10(abs(value)))
    if size < -3 or size > 6:
        mantissa, _, exponent = f"{value:{'+' if sign else ''}.{max(digits - 2, 0)}e}".partition("e")
        return _with_minus(f"{mantissa}e{int(exponent)}")
    text = f"{value:{'+' if sign else ''}.{max(digits - 1 - size, 0)}f}"
    return _with_minus(text)


def rounded_down(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that does not exceed a positive number."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(k for k in (1.0, 2.0, 5.0) if k * power <= value * (1.0 + 1e-9))


def plain(value: float, digits: int = 5) -> str:
    """Format an input number without trailing zeros.

    Parameters
    ----------
    value : float
        Number to format.
    digits : int
        Largest number of significant digits.

    Returns
    -------
    str
        Formatted number, with a typographic minus sign.
    """
    return _with_minus(f"{value:.{digits}g}")


def residual(value: float, sigma: float) -> float | None:
    """Return a residual divided by its standard deviation, or None if that is zero."""
    return value / sigma if sigma > 0 else None


def tick_text(value: float) -> str:
    """Format a number at an axis tick as a whole number with a typographic sign."""
    return _with_minus(f"{value:+,.0f}").replace(",", "\N{NARROW NO-BREAK SPACE}") if value else "0"


def residual_text(ratio: float | None) -> str:
    """Format a normalised residual, in sigma; None becomes a dash."""
    if ratio is None:
        return "\N{EM DASH}"
    if abs(ratio) < 10:
        return fixed(ratio, 1, sign=True)
    return _with_minus(f"{ratio:+,.0f}").replace(",", "\N{NARROW NO-BREAK SPACE}")


_NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")
_SVG_NAMESPACE = 'xmlns="http://www.w3.org/2000/svg"'

Cell = str | float | int | None


class DecimalNumber(float):
    """Table number that carries its own number of decimals, for columns whose rows have different units."""

    def __new__(cls, value: float, decimals: int) -> DecimalNumber:
        """Make the number ``value``, shown with ``decimals`` digits after the point."""
        made = super().__new__(cls, value)
        made.decimals = decimals
        return made

    decimals: int


class Marked(str):
    """Text of a table cell, with an optional second line, CSS class, key for programs and tooltip.

    Attributes
    ----------
    below : str
        Second, smaller line.
    look : str
        CSS class of the cell: ``truth``, ``near``, ``far``, ``wrong``, or a verdict.
    key : str
        Name by which programs find the cell in a page.
    hint : str
        Text shown when the reader points at the cell.
    """

    def __new__(cls, text: str, below: str = "", look: str = "", key: str = "", hint: str = "") -> Marked:
        """Make a cell with the text ``text`` and its additions."""
        made = super().__new__(cls, text)
        made.below, made.look, made.key, made.hint = below, look, key, hint
        return made

    below: str
    look: str
    key: str
    hint: str


RESIDUALS = ("near", "far")
"""Styles of cells with a residual below the value."""


def residual_cell(text: str, ratio: float | None, key: str, hint: str = "") -> Marked:
    """Return a cell with a measured value and, below it, its residual in sigma, marked if that exceeds `FAR`.

    Parameters
    ----------
    text : str
        Formatted measured value.
    ratio : float | None
        (measured value - truth) / sigma; None without noise.
    key : str
        Name by which programs find the cell.
    hint : str
        Text shown when the reader points at the cell.
    """
    far = ratio is not None and abs(ratio) > FAR
    return Marked(text, f"{'▲' if far else '●'} {residual_text(ratio)} σ", "far" if far else "near", key, hint)


@dataclass(frozen=True, eq=False)
class Artefact:
    """Figure, table or data file of a report: the base class.

    Attributes
    ----------
    name : str
        Name of the file without its extension: lower-case letters, digits, - and _; unique in its group.
    title : str
        Heading in the report; empty for none.
    caption : str
        Sentences that describe the content; words between backticks are shown as code.
    kind : str
        Extension of the file: ``svg``, ``png``, ``csv``, ``json``.
    within : str | None
        Path, in the run folder, of another file that already contains the artefact; None if it is written to a file of
        its own, empty if it is shown in the page only.
    full : Table | None
        Table with all digits that a reader can download from the page.
    """

    kind: ClassVar[str]
    name: str
    title: str
    caption: str
    within: str | None = field(default=None, kw_only=True)
    full: Table | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Raise ValueError if the name has characters that the name of an artefact's file must not have."""
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"artefact name {self.name!r}: only small letters, digits, - and _ can be used")
        self.content()

    @property
    def file(self) -> str:
        """Path of the file in the run folder; empty if there is none."""
        return f"artefacts/{self.name}.{self.kind}" if self.within is None else self.within

    @property
    def download(self) -> Table | None:
        """Table with all digits that a reader can download from the page, or None."""
        return self.full

    @property
    def long(self) -> bool:
        """True for a table that a page shows only on request."""
        return False

    @property
    def shown_caption(self) -> str:
        """Caption shown in the report; for a figure that could not be drawn, a note instead."""
        return self.caption

    def content(self) -> bytes:
        """Return the content of the artefact's file, as bytes."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class SvgFigure(Artefact):
    """Drawing as one <svg> element, as returned by ``twin.framework.svg.to_svg``."""

    kind: ClassVar[str] = "svg"
    svg: str

    @property
    def drawing(self) -> Markup:
        """Drawing as markup for a page; it needs no escaping, since this program made it."""
        return Markup(self.svg)

    def content(self) -> bytes:
        """Return the drawing as a separate SVG file."""
        if not self.svg.startswith("<svg"):
            raise ValueError(f"artefact {self.name!r}: not an <svg> element")
        head = self.svg[: self.svg.index(">")]
        svg = self.svg if " xmlns=" in head else self.svg.replace("<svg", f"<svg {_SVG_NAMESPACE}", 1)
        return f'<?xml version="1.0" encoding="utf-8"?>\n{svg}'.encode()


@dataclass(frozen=True, eq=False)
class PngFigure(Artefact):
    """Bitmap image; ``png`` is the content of the PNG file."""

    kind: ClassVar[str] = "png"
    png: bytes

    @property
    def address(self) -> str:
        """Image as a data URL, for a self-contained page."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")

    def content(self) -> bytes:
        """Return the content of the PNG file."""
        if not self.png.startswith(b"\x89PNG"):
            raise ValueError(f"artefact {self.name!r}: not a PNG file")
        return self.png


@dataclass(frozen=True, eq=False)
class Table(Artefact):
    """Table of a report, also written as CSV; the column heads include the units.

    Attributes
    ----------
    heads : sequence of str
        Column heads.
    rows : sequence of sequences of Cell
        Rows of the table.
    decimals : sequence of int or None
        Digits after the point that the report shows in each column; None for ``digits`` significant digits. The CSV has
        all digits.
    digits : int
        Significant digits of columns without ``decimals``.
    over : sequence of (str, int)
        Second row of heads above the heads, each with the number of columns that it spans.
    bands : mapping of int to str
        Row number -> title of the part of the table that begins there.
    """

    kind: ClassVar[str] = "csv"
    heads: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    decimals: Sequence[int | None] = ()
    digits: int = 6
    over: Sequence[tuple[str, int]] = ()
    bands: Mapping[int, str] = field(default_factory=FrozenMap)

    @property
    def download(self) -> Table | None:
        """Table with all digits for download: ``full`` if there is one, or this table if its cells are plain."""
        if self.full is not None or any(isinstance(cell, Marked) for row in self.rows for cell in row):
            return self.full
        return self

    def shown(self) -> list[list[Cell]]:
        """Return the rows as the report shows them: numbers as text with the decimals of their columns."""
        decimals_by_column = [*self.decimals, *[None] * (len(self.heads) - len(self.decimals))]
        return [
            [
                self._text(cell, decimals) if isinstance(cell, float) else cell
                for cell, decimals in zip(row, decimals_by_column, strict=True)
            ]
            for row in self.rows
        ]

    @property
    def long(self) -> bool:
        """True if the table has more than `LONG_TABLE` rows, unless its texts are what the page is about."""
        texts = any(isinstance(cell, Marked) and "how" in cell.look for row in self.rows for cell in row)
        return len(self.rows) > LONG_TABLE and not texts

    @property
    def cells(self) -> list[list[Marked]]:
        """Rows as the text of cells with their styles, for an HTML page."""
        return [[cell if isinstance(cell, Marked) else Marked(cell_text(cell)) for cell in row] for row in self.shown()]

    @property
    def words(self) -> list[bool]:
        """For each column, True if it holds words (aligned left) and False if it holds numbers."""
        columns = [[row[k] for row in self.rows] for k in range(len(self.heads))]
        return [all(isinstance(cell, str) and _is_word(cell) for cell in column) for column in columns]

    def _text(self, value: float, decimals: int | None) -> str:
        if isinstance(value, DecimalNumber):
            return fixed(value, value.decimals)
        return significant(value, self.digits, floor=0.0) if decimals is None else fixed(value, decimals)

    def content(self) -> bytes:
        """Return the table as CSV with all digits."""
        for row in self.rows:
            if len(row) != len(self.heads):
                raise ValueError(f"artefact {self.name!r}: a row of {len(row)} cells under {len(self.heads)} heads")
        return csv_table([self.heads, *self.rows])

    @property
    def address(self) -> str:
        """Table as a data URL of CSV, so that a page can offer it without a second file."""
        return "data:text/csv;charset=utf-8;base64," + base64.b64encode(self.content()).decode("ascii")


def cell_text(value: Cell) -> str:
    """Format a table cell, with at most six digits."""
    if value is None:
        return ""
    if isinstance(value, str):
        return typeset(value)
    return plain(value) if isinstance(value, int) else significant(value, 6, floor=0.0)


def _is_word(cell: str) -> bool:
    """Return True for a cell that holds words rather than a number."""
    return not isinstance(cell, Marked) or not cell.look or cell.look.startswith(("text", "verdict"))


@dataclass(frozen=True, eq=False)
class Data(Artefact):
    """Plain data, written as JSON and listed in the report."""

    kind: ClassVar[str] = "json"
    data: Any

    def content(self) -> bytes:
        """Return the data as JSON; NaN and infinities raise ValueError."""
        return (json.dumps(self.data, indent=2, allow_nan=False) + "\n").encode()


@dataclass(frozen=True, eq=False)
class Text(Artefact):
    """Paragraph of a report: its text is ``caption``, followed by a list of ``points``."""

    kind: ClassVar[str] = "txt"
    points: Sequence[str] = ()

    def content(self) -> bytes:
        """Return the paragraph and its list of points as UTF-8 text."""
        return "\n".join([self.caption, *self.points, ""]).encode()


@dataclass(frozen=True, eq=False)
class Piece(Artefact):
    """Part of a report's page in HTML that this program has generated, with all texts of the user in it escaped."""

    kind: ClassVar[str] = "html"
    markup: Markup

    def content(self) -> bytes:
        """Return the HTML of this part as UTF-8 bytes."""
        return self.markup.encode()


@dataclass(frozen=True, eq=False)
class Undrawn(Artefact):
    """Note that replaces a figure that could not be drawn.

    Attributes
    ----------
    why : str
        Text of the error.
    """

    kind: ClassVar[str] = "txt"
    why: str

    def content(self) -> bytes:
        """Return the note as a text file."""
        return f"{self.note}\n".encode()

    @property
    def note(self) -> str:
        """Note with the title of the missing figure and the error."""
        return f"the figure {self.title!r} could not be drawn: {self.why}"

    @property
    def shown_caption(self) -> str:
        """Note about the missing figure as a sentence, instead of a caption."""
        return f"{self.note[0].upper()}{self.note[1:]}."


@dataclass(frozen=True, eq=False)
class CameraFile(Data):
    """Camera specification as a YAML file that can be added to the library; ``data`` is its text."""

    kind: ClassVar[str] = "yaml"

    def content(self) -> bytes:
        """Return the YAML text of the camera as bytes."""
        return str(self.data).encode()


@dataclass(frozen=True, eq=False)
class CsvFile(CameraFile):
    """Table that other files refer to, written beside the page; ``data`` is its CSV text."""

    kind: ClassVar[str] = "csv"
