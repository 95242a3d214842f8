"""Maps in text files: interferograms of CODE V, Grid Sag of Zemax, and plain tables of numbers.

All three list the rows from the top of the picture down; they are turned over here. Lines that begin with ``!`` are
comments of CODE V and Zemax, lines that begin with ``#`` those of a plain table, where they say what the numbers are.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from analysis.arrays import Array
from analysis.wavefront_maps.wavefront_map import MapError, WavefrontMap, agreed, length_from, metres_per, unit_named

MOST_BYTES = 100_000_000
MOST_POINTS = 20_000_000
_ZEMAX_UNITS = {0: 1e-3, 1: 1e-2, 2: 25.4e-3, 3: 1.0}
"""Unit flag of a Grid Sag file -> metres."""
_CODEV_NO_DATA = -32768
_CODEV_DATA = ("WFR", "SUR", "FIL")
_CODEV_KEY = re.compile(r"\b(GRD|ZFR|ZRN)\s+\d+", re.IGNORECASE)
_STATEMENT = re.compile(r"#\s*([\w ]+?)\s*[:=]\s*(.*)")
_WHAT = ("wavefront", "surface")

Line = tuple[int, str]
"""Number in the file, from 1, and text."""


def text_of(path: Path) -> str:
    """The text of a file in UTF-8, UTF-16 with its mark, or Latin-1.

    Args:
        path: of the file.

    Raises:
        MapError: too large, or no text.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise MapError(f"{path} has {size * 1e-6:.0f} MB, more than {MOST_BYTES * 1e-6:.0f}: save a smaller map")
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    if b"\0" in data:
        raise MapError(
            f"{path} is no file of a wavefront that is known: MetroPro .dat, .datx, CODE V INT, Zemax Grid Sag, FITS"
            " and text tables are read"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def lines_of(text: str, comment: str) -> list[Line]:
    """Lines that say something, with their numbers.

    Args:
        text: of the file.
        comment: how lines begin that are left out.
    """
    numbered = enumerate(text.splitlines(), 1)
    return [(n, s) for n, s in ((n, line.strip()) for n, line in numbered) if s and not s.startswith(comment)]


def is_codev(lines: list[Line]) -> bool:
    """Whether one of the first lines, which may be titles, says that a grid or Zernike terms follow.

    Args:
        lines: without comments.
    """
    return any(_CODEV_KEY.match(text) for _, text in lines[:4])


def is_zemax(lines: list[Line]) -> bool:
    """Whether the first line has the five or seven numbers of a Grid Sag file, two sizes before all.

    Args:
        lines: without comments.
    """
    first = lines[0][1].split() if lines else []
    if len(first) not in (5, 7) or not all(re.fullmatch(r"[0-9]{1,9}", one) for one in first[:2]):
        return False
    # a plain table of so many columns goes on with as many, and has not just so many rows as two of its numbers say
    like_a_table = len(lines) > 1 and len(lines[1][1].split()) == len(first)
    return not like_a_table or len(lines) == int(first[0]) * int(first[1]) + 1


def _numbers(path: Path, lines: Iterable[Line], split: str = r"\s+") -> tuple[Array, list[int]]:
    """All numbers of lines in a row, and how many each line has. Raises MapError at the first text that is none."""
    out, widths = array("d"), []
    for number, text in lines:
        words = re.split(split, text.strip(" \t,;"))
        for one in words:
            try:
                # Python reads 1_000 as a number, no other program does
                out.append(float(one.replace("_", "?")))
            except ValueError:
                raise MapError(f"{path}, line {number}: {one[:40]!r} is no number") from None
        widths.append(len(words))
    return np.array(out), widths


def read_codev(path: Path, lines: list[Line]) -> WavefrontMap:
    """An interferogram of CODE V with a grid: whole numbers of which SSZ make one wave of WVL micrometres.

    Args:
        path: of the file.
        lines: of it, without comments.

    Raises:
        MapError: Zernike terms, transmissions, a header that is not understood, or another number of points.
    """
    place = next(k for k, (_, text) in enumerate(lines) if _CODEV_KEY.match(text))
    number, header = lines[place]
    where = f"{path}, line {number}"
    words = header.upper().split()
    sizes: list[int] = []
    kind = ""
    values: dict[str, float] = {}
    while words:
        word = words.pop(0)
        if word in ("ZFR", "ZRN"):
            raise MapError(f"{where}: the file holds Zernike terms ({word}), no grid: write them as a table of terms")
        wanted = 2 if word == "GRD" else 1 if word in ("WVL", "SSZ", "NDA", "XSC") else 0
        if not wanted and word not in (*_CODEV_DATA, "NNB"):
            raise MapError(f"{where}: {word[:40]!r} is not understood; GRD, WFR, SUR, WVL, SSZ, NDA, XSC, NNB are")
        taken, words = words[:wanted], words[wanted:]
        try:
            found = [float(one) for one in taken]
        except ValueError:
            found = []
        if len(found) < wanted or not all(map(math.isfinite, found)):
            raise MapError(f"{where}: {wanted} number(s) are needed after {word}, found {' '.join(taken)[:40]!r}")
        if word == "GRD":
            sizes = [int(one) if one == int(one) else 0 for one in found]
        elif word in _CODEV_DATA:
            kind = word
        elif wanted:
            values[word] = found[0]
    if kind == "FIL":
        raise MapError(f"{where}: the file holds transmissions (FIL), no wavefront: give one with WFR or SUR")
    if not kind:
        raise MapError(f"{where} says neither WFR (wavefront) nor SUR (surface)")
    for key, meaning in (("WVL", "the wavelength in micrometres"), ("SSZ", "the number of counts in a wave")):
        if not values.get(key, 0.0) > 0.0:
            raise MapError(f"{where}: {key}, {meaning}, is missing or not positive")
    if abs(values.get("XSC", 1.0) - 1.0) > 1e-6:
        raise MapError(f"{where}: its pixels are not square (XSC {values['XSC']:g}): resample the map to square ones")
    columns, rows = _grid(where, sizes)
    counts, _ = _numbers(path, lines[place + 1 :])
    _check_points(path, counts, len(counts), rows, columns)
    counts = counts.reshape(rows, columns)
    no_data = values.get("NDA", _CODEV_NO_DATA)
    metres = values["WVL"] * 1e-6 / values["SSZ"]
    notes = () if "NDA" in values else (f"NDA is not stated; {_CODEV_NO_DATA} was taken for no data, as CODE V does.",)
    return WavefrontMap(
        values=np.where(counts == no_data, np.nan, counts * metres)[::-1],
        spacing=math.nan,
        wavelength=values["WVL"] * 1e-6,
        what="wavefront" if kind == "WFR" else "surface",
        kind="CODE V INT",
        notes=notes,
    )


def read_zemax(path: Path, lines: list[Line]) -> WavefrontMap:
    """A Grid Sag file of Zemax: sizes, steps and unit in its first line, then a line a point, sag before its slopes.

    A Grid Phase file looks the same and holds radians; it cannot be told from one of sags.

    Args:
        path: of the file.
        lines: of it, without comments.

    Raises:
        MapError: a header or points that are not of this form.
    """
    where = f"{path}, line {lines[0][0]}"
    nx, ny, step_x, step_y, flag, *shift = _numbers(path, [lines[0]])[0]
    columns, rows = _grid(where, [int(nx), int(ny)])
    if flag not in _ZEMAX_UNITS:
        raise MapError(f"{where}: unit flag {flag:g} is not known; 0 (mm), 1 (cm), 2 (inch) and 3 (m) are")
    unit = _ZEMAX_UNITS[int(flag)]
    step_x, step_y = abs(step_x), abs(step_y)
    if not (0.0 < step_x < math.inf and abs(step_x - step_y) <= 1e-6 * step_x):
        raise MapError(
            f"{where}: steps {step_x:g} and {step_y:g} are no square pixels: resample the map to square ones"
        )
    points, widths = _numbers(path, lines[1:])
    if len(set(widths)) != 1 or widths[0] not in (1, 4, 5):
        raise MapError(f"{path}: each line has to hold sag, three derivatives and no-data flag, or the sag alone")
    _check_points(path, points, len(widths), rows, columns)
    table = points.reshape(rows * columns, widths[0])
    measured = table[:, 4] == 0.0 if table.shape[1] == 5 else np.ones(len(table), bool)
    values = np.where(measured, table[:, 0] * unit, np.nan).reshape(rows, columns)[::-1]
    notes = ["Read as sag. A Grid Phase file looks alike and would hold radians."]
    if any(shift):
        notes.append("The shift of the grid that the file states (xdec, ydec) is not used.")
    return WavefrontMap(values, step_x * unit, None, "surface", kind="Zemax Grid Sag", notes=tuple(notes))


def read_table(path: Path, text: str, unit: str | None, wavelength: float | None) -> WavefrontMap:
    """A plain table of numbers, separated by commas, semicolons or blanks, ``nan`` where nothing was measured.

    Lines ``# unit: nm``, ``# spacing: 0.1 mm``, ``# wavelength: 632.8 nm`` and ``# what: surface`` before it say what
    it holds; the unit is needed.

    Args:
        path: of the file.
        text: of it.
        unit: where the file does not say.
        wavelength: metres, likewise.

    Raises:
        MapError: no table, no unit, or a statement that contradicts the file.
    """
    found = statements(path, text, ("unit", "spacing", "wavelength", "what"))
    lines = lines_of(text, "#")
    if not lines:
        raise MapError(f"{path} holds no numbers")
    numbers, widths = _numbers(path, lines, r"\s*[,;]\s*|\s+")
    if len(set(widths)) != 1 or len(widths) < 2 or widths[0] < 2:
        line = next((n for (n, _), width in zip(lines, widths, strict=True) if width != widths[0]), lines[0][0])
        raise MapError(f"{path}, line {line}: a map has at least two rows, all with as many columns as the first")
    table = numbers.reshape(len(widths), widths[0])
    if np.isinf(table).any():
        raise MapError(f"{path} holds an infinite number; write nan where nothing was measured")
    wavelength = agreed(
        path,
        "wavelength",
        wavelength,
        length_from(path, found["wavelength"], "wavelength") if "wavelength" in found else None,
    )
    named = unit_agreed(path, unit, found.get("unit"), "a line '# unit: nm' before the numbers")
    what = found.get("what")
    if what is not None and what not in _WHAT:
        raise MapError(f"{path}: what is {what[:40]!r}; wavefront and surface are known")
    spacing = length_from(path, found["spacing"], "spacing") if "spacing" in found else math.nan
    return WavefrontMap(table[::-1] * metres_per(path, named, wavelength), spacing, wavelength, what, kind="text table")


def statements(path: Path, text: str, keys: tuple[str, ...]) -> dict[str, str]:
    """What lines ``# key: value`` of a table say; other comments may stand beside them.

    Args:
        path: of the file, for messages.
        text: of it.
        keys: that mean something.

    Raises:
        MapError: a key that is stated twice.
    """
    out: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        match = _STATEMENT.fullmatch(line.strip())
        if match is None or (key := match[1].lower()) not in keys:
            continue
        if key in out:
            raise MapError(f"{path}, line {number}: {key} is stated a second time")
        out[key] = match[2].strip()
    return out


def unit_agreed(path: Path, stated: str | None, found: str | None, remedy: str) -> str:
    """The one unit where file and user may both give one.

    Args:
        path: of the file, for messages.
        stated: by the user.
        found: in the file.
        remedy: how the file could say it, for the message.

    Raises:
        MapError: none, two, or one that is not known.
    """
    names = {unit_named(path, one) for one in (stated, found) if one is not None}
    if not names:
        raise MapError(f"{path} does not say its unit: state the unit, or add {remedy}")
    if len(names) > 1:
        raise MapError(f"{path} says unit {found}, stated is {stated}: take the statement away")
    return names.pop()


def _grid(where: str, sizes: list[int]) -> tuple[int, int]:
    if len(sizes) != 2 or min(sizes) < 2 or math.prod(sizes) > MOST_POINTS:
        raise MapError(f"{where}: a grid of {' x '.join(map(str, sizes))} points; 2 to {MOST_POINTS} in all are read")
    return sizes[0], sizes[1]


def _check_points(path: Path, numbers: Array, count: int, rows: int, columns: int) -> None:
    if count != rows * columns:
        raise MapError(f"{path} has {count} points, its header says {columns} x {rows}: it is cut off or added to")
    if not np.isfinite(numbers).all():
        raise MapError(f"{path}: a point is not a finite number; files mark points without data in another way")
