"""Files of measured wavefronts, recognised by what is in them and not by their names.

Maps in text files: interferograms of CODE V, Grid Sag of Zemax, and plain tables of numbers.

All three list the rows from the top of the picture down; they are turned over here. Lines that begin with ``!`` are
comments of CODE V and Zemax, lines that begin with ``#`` those of a plain table, where they say what the numbers are.

Interferograms of Zygo: MetroPro's binary .dat and Mx's .datx, which is HDF5.

Fringes become metres by the factor of the MetroPro Reference Guide (page 12-6): wavelength times interferometric scale
factor times obliquity factor. Rows are stored from the top of the picture down and are turned over here.

A measured wavefront or surface as a map of metres, the error of files that hold none, and their units.
"""

from __future__ import annotations

import math
import re
import struct
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array, MeasurementError
from analysis.images.image_file import FITS_MAGIC, ImageError, ImageFile, fits_cards

WAVES = "waves"
"""The unit that needs a wavelength."""
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12}
_NAMES = {
    **{name: name for name in _LENGTHS},
    "micron": "um",
    "microns": "um",
    **{f"{name}{end}": unit for name, unit in (("wave", WAVES), ("meter", "m"), ("metre", "m")) for end in ("", "s")},
    **{
        f"{prefix}{name}{end}": unit
        for prefix, unit in (("centi", "cm"), ("milli", "mm"), ("micro", "um"), ("nano", "nm"), ("pico", "pm"))
        for name in ("meter", "metre")
        for end in ("", "s")
    },
}
"""Names of units in files, in small letters, to those used here."""


class MapError(MeasurementError, ValueError):
    """A file that cannot be read as a wavefront, or a map from which a number cannot be had; the message says what to
    change.
    """


@dataclass(frozen=True, eq=False)
class WavefrontMap:
    """A wavefront or a surface on a grid of square pixels.

    Rows and columns are those of a right-handed frame in which the program that wrote the file draws it: x grows with
    the column to the right, y with the row upwards, so that row 0 is the lowest one.

    Attributes
    ----------
    values : Array
        (rows, columns), optical path difference or height in metres with the sign of the file, NaN where nothing was
        measured.
    spacing : float
        Of the pixels, metres; NaN where the file does not say.
    wavelength : float | None
        Metres; None where the file does not say.
    what : str | None
        ``wavefront`` or ``surface`` where the file says; None otherwise.
    scale_factor : float
        Waves per fringe by which the file's program multiplied (0.5 for light that meets the surface twice); it is in
        ``values``.
    obliquity : float
        Factor of oblique light, likewise.
    kind : str
        Of the file, as in ``Zygo MetroPro``.
    notes : tuple[str, ...]
        What a reader should know of how the file was understood, whole sentences.
    """

    values: Array
    spacing: float
    wavelength: float | None
    what: str | None
    scale_factor: float = 1.0
    obliquity: float = 1.0
    kind: str = ""
    notes: tuple[str, ...] = ()

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Where something was measured, (rows, columns)."""
        return np.isfinite(self.values)


def unit_named(path: Path, text: str) -> str:
    """The unit that a file or a user means: ``m``, ``mm``, ``um``, ``nm``, ``pm``, ``cm`` or ``waves``.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    text : str
        Its name.

    Raises
    ------
    MapError
        No such unit.
    """
    # both letters that stand for micro
    name = text.strip().strip("'\"").lower().replace("\N{MICRO SIGN}", "u").replace("\N{GREEK SMALL LETTER MU}", "u")
    if name not in _NAMES:
        raise MapError(f"{path}: there is no unit {text.strip()[:40]!r}; m, mm, um, nm and waves are known")
    return _NAMES[name]


def metres_per(path: Path, unit: str, wavelength: float | None) -> float:
    """Metres in one unit.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    unit : str
        As ``unit_named`` gives it.
    wavelength : float | None
        Metres, None where it is not known.

    Raises
    ------
    MapError
        Waves of an unknown wavelength.
    """
    if unit != WAVES:
        return _LENGTHS[unit]
    if wavelength is None:
        raise MapError(f"{path} is in waves and does not say of which wavelength: state the wavelength")
    return wavelength


def length_from(path: Path, text: str, key: str) -> float:
    """A positive length with its unit, as in ``632.8 nm``, in metres.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    text : str
        Number and unit.
    key : str
        What it is the length of, for the message.

    Raises
    ------
    MapError
        Another text, or not a positive length.
    """
    number, _, unit = text.strip().partition(" ")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not unit.strip() or not math.isfinite(value) or value <= 0.0:
        raise MapError(f"{path}: {key} is {text.strip()[:40]!r}; a positive length with its unit is needed: 632.8 nm")
    named = unit_named(path, unit)
    if named == WAVES:
        raise MapError(f"{path}: {key} is in waves; a length is needed: 632.8 nm")
    return value * _LENGTHS[named]


def agreed(path: Path, key: str, stated: float | None, found: float | None) -> float | None:
    """The one value where file and user both give one.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    key : str
        Of the value, for the message.
    stated : float | None
        By the user, in SI units.
    found : float | None
        In the file.

    Raises
    ------
    MapError
        They differ by more than a millionth.
    """
    if stated is None or found is None:
        return found if stated is None else stated
    if abs(stated - found) > 1e-6 * abs(found):
        raise MapError(f"{path} says {key} {found:.8g} m, stated is {stated:.8g} m: take the statement away")
    return found


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

    Parameters
    ----------
    path : Path
        Of the file.

    Raises
    ------
    MapError
        Too large, or no text.
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

    Parameters
    ----------
    text : str
        Of the file.
    comment : str
        How lines begin that are left out.
    """
    numbered = enumerate(text.splitlines(), 1)
    return [(n, s) for n, s in ((n, line.strip()) for n, line in numbered) if s and not s.startswith(comment)]


def is_codev(lines: list[Line]) -> bool:
    """Whether one of the first lines, which may be titles, says that a grid or Zernike terms follow.

    Parameters
    ----------
    lines : list[Line]
        Without comments.
    """
    return any(_CODEV_KEY.match(text) for _, text in lines[:4])


def is_zemax(lines: list[Line]) -> bool:
    """Whether the first line has the five or seven numbers of a Grid Sag file, two sizes before all.

    Parameters
    ----------
    lines : list[Line]
        Without comments.
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

    Parameters
    ----------
    path : Path
        Of the file.
    lines : list[Line]
        Of it, without comments.

    Raises
    ------
    MapError
        Zernike terms, transmissions, a header that is not understood, or another number of points.
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

    Parameters
    ----------
    path : Path
        Of the file.
    lines : list[Line]
        Of it, without comments.

    Raises
    ------
    MapError
        a header or points that are not of this form.
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


def read_table(path: Path, text: str, wavelength: float | None) -> WavefrontMap:
    """A plain table of numbers, separated by commas, semicolons or blanks, ``nan`` where nothing was measured.

    Lines ``# unit: nm``, ``# spacing: 0.1 mm``, ``# wavelength: 632.8 nm`` and ``# what: surface`` before it say what
    it holds; the unit is needed.

    Parameters
    ----------
    path : Path
        Of the file.
    text : str
        Of it.
    wavelength : float | None
        Metres, where the file does not say.

    Raises
    ------
    MapError
        No table, no unit, or a statement that contradicts the file.
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
    named = unit_written(path, found.get("unit"), "a line '# unit: nm' before the numbers")
    what = found.get("what")
    if what is not None and what not in _WHAT:
        raise MapError(f"{path}: what is {what[:40]!r}; wavefront and surface are known")
    spacing = length_from(path, found["spacing"], "spacing") if "spacing" in found else math.nan
    return WavefrontMap(table[::-1] * metres_per(path, named, wavelength), spacing, wavelength, what, kind="text table")


def statements(path: Path, text: str, keys: tuple[str, ...]) -> dict[str, str]:
    """What lines ``# key: value`` of a table say; other comments may stand beside them.

    Parameters
    ----------
    path : Path
        Of the file, for messages.
    text : str
        Of it.
    keys : tuple[str, ...]
        That mean something.

    Raises
    ------
    MapError
        a key that is stated twice.
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


def unit_written(path: Path, found: str | None, remedy: str) -> str:
    """Return the unit that a file gives.

    Parameters
    ----------
    path : Path
        Of the file, for messages.
    found : str | None
        In the file.
    remedy : str
        How the file could say it, for the message.

    Raises
    ------
    MapError
        None, or one that is not known.
    """
    if found is None:
        raise MapError(f"{path} does not say its unit: add {remedy}")
    return unit_named(path, found)


def _grid(where: str, sizes: list[int]) -> tuple[int, int]:
    if len(sizes) != 2 or min(sizes) < 2 or math.prod(sizes) > MOST_POINTS:
        raise MapError(f"{where}: a grid of {' x '.join(map(str, sizes))} points; 2 to {MOST_POINTS} in all are read")
    return sizes[0], sizes[1]


def _check_points(path: Path, numbers: Array, count: int, rows: int, columns: int) -> None:
    if count != rows * columns:
        raise MapError(f"{path} has {count} points, its header says {columns} x {rows}: it is cut off or added to")
    if not np.isfinite(numbers).all():
        raise MapError(f"{path}: a point is not a finite number; files mark points without data in another way")


METROPRO_MAGIC = b"\x88\x1b\x03"
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_HEADERS = {0x6F: 834, 0x70: 834, 0x71: 4096}
"""Last byte of the magic number -> smallest size of the header of that format."""
_STEPS = {0: 4096, 1: 32768, 2: 131072}
"""Phase resolution of the header -> counts per fringe."""
_INVALID = 2147483640
_LARGEST_WAVELENGTH = 1e-3
_FIELDS = {
    "header_size": (">I", 6),
    "frame_width": (">H", 52),
    "frame_height": (">H", 54),
    "frames": (">H", 56),
    "width": (">H", 68),
    "height": (">H", 70),
    "scale_factor": (">f", 164),
    "wavelength": (">f", 168),
    "obliquity": (">f", 176),
    "spacing": (">f", 184),
    "resolution": (">H", 218),
    "sign": (">H", 232),
    "codev_type": (">H", 298),
}
"""What is used of the header: form and place."""


def is_metropro(start: bytes) -> bool:
    """Whether a file that starts so is MetroPro's."""
    return start[:3] == METROPRO_MAGIC and start[3:4] != b"" and start[3] in _HEADERS


def read_metropro(path: Path) -> WavefrontMap:
    """A file of MetroPro, of any of its three header formats.

    A short file is not filled up with zeros, which would be measured values.

    Parameters
    ----------
    path : Path
        Of the file.

    Raises
    ------
    MapError
        No phase in it, a header that cannot be, or a file that is cut off.
    """
    data = path.read_bytes()
    if len(data) < _HEADERS[data[3]]:
        raise MapError(f"{path} is cut off in its header: copy it again from the interferometer")
    head: dict[str, Any] = {key: struct.unpack_from(form, data, place)[0] for key, (form, place) in _FIELDS.items()}
    rows, columns = head["height"], head["width"]
    if not rows or not columns:
        raise MapError(f"{path} holds no phase map, only intensities: save the measurement with its phase data")
    for key in ("scale_factor", "wavelength", "obliquity"):
        if not (math.isfinite(head[key]) and head[key] > 0.0):
            raise MapError(f"{path} is damaged: its header has {key.replace('_', ' ')} {head[key]:.6g}")
    if head["wavelength"] > _LARGEST_WAVELENGTH:
        raise MapError(f"{path} is damaged: its header has wavelength {head['wavelength']:.6g} m")
    if head["resolution"] not in _STEPS:
        raise MapError(f"{path} is damaged: its header has phase resolution {head['resolution']}; 0, 1 and 2 exist")
    if rows * columns > MOST_POINTS:
        raise MapError(f"{path} has {rows} x {columns} points, more than {MOST_POINTS}: save a smaller part of it")
    start = head["header_size"] + 2 * head["frame_width"] * head["frame_height"] * head["frames"]
    one = head["header_size"] + 2 * head["frame_width"] * head["frame_height"]
    # some programs count no frame and write one
    start = one if not head["frames"] and len(data) >= one + 4 * rows * columns else start
    if len(data) < start + 4 * rows * columns or head["header_size"] < _HEADERS[data[3]]:
        raise MapError(
            f"{path} is cut off or damaged: its header wants {rows} x {columns} points from byte {start} on, the file"
            f" has {len(data)} bytes; copy it again"
        )
    counts = np.frombuffer(data, ">i4", rows * columns, start).reshape(rows, columns)[::-1]
    metres = head["wavelength"] * head["scale_factor"] * head["obliquity"] / _STEPS[head["resolution"]]
    values = np.where(counts >= _INVALID, np.nan, counts * metres)
    notes = [_of_scale(head["scale_factor"])]
    if head["sign"]:
        notes.append(
            "The header says that the sign of the data is inverted. Programs differ on whether the stored values are"
            " inverted already: state the sign, or check it."
        )
    spacing = head["spacing"] if math.isfinite(head["spacing"]) and head["spacing"] > 0.0 else math.nan
    return WavefrontMap(
        values=values,
        spacing=spacing,
        wavelength=head["wavelength"],
        what="surface" if head["codev_type"] == 1 else None,
        scale_factor=head["scale_factor"],
        obliquity=head["obliquity"],
        kind="Zygo MetroPro",
        notes=tuple(notes),
    )


def _of_scale(scale: float) -> str:
    return f"The interferometric scale factor of the file, {scale:.6g} waves per fringe, is in the values."


def read_datx(path: Path, wavelength: float | None = None) -> WavefrontMap:
    """A file of Mx, in its present layout (``Data/Surface``) or its first one (``Measurement/Surface``).

    Parameters
    ----------
    path : Path
        Of the file.
    wavelength : float | None
        Metres, where the file does not say.

    Raises
    ------
    MapError
        HDF5 of another kind, or damaged.
    """
    try:
        return _datx(path, wavelength)
    except MapError:
        raise
    # what the library finds wrong with a spoilt file cannot be foreseen, nor is it said in words for a user
    except Exception as error:
        raise MapError(f"{path} cannot be read as a .datx file: it is damaged; copy it again") from error


def _datx(path: Path, stated: float | None) -> WavefrontMap:
    # imported for such a file only
    import h5py

    with h5py.File(path, "r") as file:
        found = list(_surfaces(file))
        if not found:
            raise MapError(f"{path} is HDF5, but no .datx file of Zygo: it has neither Data/Surface nor Measurement")
        surface = found[0]
        shape = surface.shape
        if len(shape) != 2 or 0 in shape or surface.dtype.kind not in "iuf":
            raise MapError(f"{path}: its surface is no map of numbers (shape {shape}, type {surface.dtype})")
        if math.prod(shape) > MOST_POINTS:
            raise MapError(f"{path} has {shape[0]} x {shape[1]} points, more than {MOST_POINTS}: save a part of it")
        if surface.external is not None or surface.is_virtual:
            raise MapError(f"{path}: its surface lies in another file; save it as one file")
        keys = _attributes(file, surface)
        stored = np.asarray(surface[()], dtype=np.float64)[::-1]
        limit = _number(keys, "No Data", float(_INVALID))
        stored = np.where(~np.isfinite(stored) | (stored >= limit), np.nan, stored)
        unit = keys.get("Unit", "")
        scale = _number(keys, "Interferometric Scale Factor", math.nan)
        obliquity = _number(keys, "Obliquity Factor", 1.0)
        wave = _number(keys, "Wavelength", math.nan)
        spacing = _spacing(surface)
    usable = math.isfinite(wave) and 0.0 < wave < _LARGEST_WAVELENGTH
    wavelength = wave if usable else stated
    if not isinstance(unit, str) or not unit:
        raise MapError(f"{path} does not say the unit of its surface; save it from Mx in fringes or nanometres")
    if unit.lower() == "fringes":
        if not (math.isfinite(scale) and scale > 0.0 and math.isfinite(obliquity) and obliquity > 0.0):
            raise MapError(f"{path} is in fringes and has no usable interferometric scale factor or obliquity factor")
        if wavelength is None:
            raise MapError(f"{path} is in fringes and does not say of which wavelength: state the wavelength")
        values = stored * obliquity * scale * wavelength
        notes = [_of_scale(scale)]
    else:
        values = stored * metres_per(path, unit_named(path, unit), wavelength)
        scale = obliquity = 1.0
        notes = [f"The file is in {unit}; no scale factor was applied."]
    if len(found) > 1:
        notes.append(f"The file has {len(found)} surfaces, of which the first was read.")
    return WavefrontMap(values, spacing, wavelength, None, scale, obliquity, "Zygo datx", tuple(notes))


def _surfaces(file: Any) -> Iterator[Any]:
    """Data sets of surfaces, in the order of their names."""
    import h5py

    for name in ("Data/Surface", "Measurement/Surface"):
        place = _held(file, name)
        if isinstance(place, h5py.Dataset):
            yield place
        elif isinstance(place, h5py.Group):
            held = (_held(place, key) for key in sorted(place))
            yield from (one for one in held if isinstance(one, h5py.Dataset))


def _held(place: Any, name: str) -> Any:
    """Return the group or data set of a name, None for none; links lead to other places, and are refused unfollowed.

    Raises
    ------
    MapError
        The name, or a part of it, is a link.
    """
    import h5py

    for part in name.split("/"):
        if not isinstance(place, h5py.Group):
            return None
        if isinstance(place.get(part, getlink=True), h5py.ExternalLink | h5py.SoftLink):
            raise MapError(
                f"{place.file.filename}: {part} is a link to another place; save it as one file, without links"
            )
        place = place.get(part)
    return place


def _attributes(file: Any, surface: Any) -> dict[str, Any]:
    """Scalars and texts among the attributes of the surface and, where these lack one, of the measurement."""
    import h5py

    general = _held(file, "Measurement/Attributes")
    out: dict[str, Any] = {}
    for holder in (general, surface):
        if isinstance(holder, h5py.Group | h5py.Dataset):
            for key, value in holder.attrs.items():
                first = np.asarray(value).reshape(-1)[:1]
                if first.size and first.dtype.kind in "OSUiuf":
                    one = first[0]
                    out[key] = one.decode("utf-8", "replace") if isinstance(one, bytes) else one
    # names of the first layout
    for old, new in (("Interf Scale Factor", "Interferometric Scale Factor"), ("Obliquity", "Obliquity Factor")):
        if old in out:
            out.setdefault(new, out[old])
    return out


def _number(keys: dict[str, Any], key: str, otherwise: float) -> float:
    value = keys.get(key, otherwise)
    return otherwise if isinstance(value, str) else float(value)


def _spacing(surface: Any) -> float:
    """Metres per pixel by the converter of x: category, unit, and parameters, the second of which it is."""
    try:
        category, _, parameters = surface.attrs["X Converter"][0]
        spacing = float(parameters[1])
    except (KeyError, IndexError, TypeError, ValueError):
        return math.nan
    name = category.decode("utf-8", "replace") if isinstance(category, bytes) else str(category)
    return spacing if name == "LateralCat" and math.isfinite(spacing) and spacing > 0.0 else math.nan


_PUPIL_SCALE = ("PUPLSCAL", "PIXELSCL", "PIXSCALE")
"""Keys of FITS files of pupils with metres per pixel, as POPPY writes and reads them."""
_LARGEST_PIXEL, _LARGEST = 1.0, 10.0
"""Metres; beyond them a unit is wrong or a file is damaged."""


def read_map(path: Path, *, wavelength: float | None = None) -> WavefrontMap:
    """The map in a file of MetroPro, Mx, CODE V, Zemax, FITS, or in a text table.

    Parameters
    ----------
    path : Path
        Of the file.
    wavelength : float | None
        Metres, for files in waves that do not say it.

    Raises
    ------
    MapError
        a file that is not read, with what is wrong and what to do.
    """
    path = Path(path)
    if path.is_dir():
        raise MapError(f"{path} is a folder, not a file of a wavefront")
    if not path.exists():
        raise MapError(f"there is no file {path}")
    if not path.is_file():  # it could be endless, or block
        raise MapError(f"{path} is a device, a pipe or a socket, not a file of a wavefront")
    try:
        with path.open("rb") as file:
            start = file.read(16)
        with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is told below
            found = _read(path, start, wavelength)
    except OSError as error:
        raise MapError(f"{path} cannot be read: {error.strerror or 'input/output error'}") from error
    largest = np.max(np.abs(found.values), where=~np.isnan(found.values), initial=0.0)
    if largest > _LARGEST:
        raise MapError(
            f"{path} holds values of up to {largest:.3g} m, which no wavefront has: check its unit and scale"
        )
    if not np.isfinite(found.values).any():
        raise MapError(f"{path} holds no measured point: all of its {found.values.size} points are without data")
    agreed(path, "wavelength", wavelength, found.wavelength)
    # a stated wavelength also counts where it was not needed
    return found if found.wavelength is not None or wavelength is None else replace(found, wavelength=wavelength)


def _read(path: Path, start: bytes, wavelength: float | None) -> WavefrontMap:
    if start.startswith(FITS_MAGIC):
        return _fits(path, wavelength)
    if not start:
        raise MapError(f"{path} is empty")
    if is_metropro(start):
        return read_metropro(path)
    if start.startswith(HDF5_MAGIC):
        return read_datx(path, wavelength)
    text = text_of(path)
    lines = lines_of(text, "!")
    if is_codev(lines):
        return read_codev(path, lines)
    return read_zemax(path, lines) if is_zemax(lines) else read_table(path, text, wavelength)


def _fits(path: Path, wavelength: float | None) -> WavefrontMap:
    """An image of a FITS file; row 0 of it, which FITS viewers draw lowest, is that of the map."""
    try:
        image = ImageFile.open(path, choose="")
        if len(image.header.pages) != 1:
            raise MapError(f"{path} has {len(image.header.pages)} images: save one of them as a file of its own")
        (values,) = image.frames()
        header = fits_cards(path, image.header.pages[0])
    except ImageError as error:
        raise MapError(str(error)) from error
    written = header.get("BUNIT")
    named = unit_written(path, str(written) if written else None, "the key BUNIT")
    scale = next((float(header[key]) for key in _PUPIL_SCALE if isinstance(header.get(key), int | float)), math.nan)
    in_metres = "arc" not in str(header.get("PIXUNIT", "meter")).lower() and 0.0 < scale < _LARGEST_PIXEL
    metres = metres_per(path, named, wavelength)
    values = np.asarray(values, dtype=np.float64) * metres
    return WavefrontMap(
        values=values,
        spacing=scale if in_metres else math.nan,
        wavelength=wavelength,
        what="wavefront" if str(header.get("EXTNAME", "")).upper() == "OPD" else None,
        kind="FITS",
        notes=("Zeros of a FITS file count as measured; write NaN where no light is.",),
    )
