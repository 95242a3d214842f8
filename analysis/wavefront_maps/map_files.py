"""Readers of measured wavefronts and surfaces, recognised by the content of the file and not by its name.

- MetroPro's binary .dat and Mx's .datx (HDF5) of Zygo. Fringes become metres by the factor of the MetroPro Reference
  Guide (page 12-6): wavelength times interferometric scale factor times obliquity factor.
- Interferograms of CODE V, Grid Sag of Zemax, and plain tables of numbers, which are text files. Lines that begin with
  ``!`` are comments of CODE V and Zemax, lines that begin with ``#`` those of a plain table, where they state the
  meaning of the numbers.
- FITS images.

All but FITS store the rows from the top of the picture down; they are flipped here. The result is a map in metres
(`WavefrontMap`).
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
"""Unit of values in wavelengths, whose conversion to metres needs the wavelength."""
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12}
"""Size in metres of each unit of length that a file may name."""
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
"""Unit of length, or waves, by each of its names in files, in lower case."""


class MapError(MeasurementError, ValueError):
    """Error raised for a file that cannot be read as a wavefront, or for a map that does not determine a result.

    The message says what to change.
    """


@dataclass(frozen=True, eq=False)
class WavefrontMap:
    """Wavefront or surface on a grid of square pixels.

    Rows and columns are those of the right-handed frame in which the program that wrote the file displays it: x grows
    with the column to the right, y with the row upwards, so that row 0 is the lowest one.

    Attributes
    ----------
    values : (rows, columns) ndarray
        Optical path difference or height in metres, with the sign of the file; NaN where nothing was measured.
    spacing : float
        Pixel spacing, in metres; NaN if the file does not state it.
    wavelength : float or None
        Wavelength, in metres; None if the file does not state it.
    what : str or None
        ``wavefront`` or ``surface``; None if the file does not state it.
    scale_factor : float
        Interferometric scale factor in waves per fringe (0.5 for light that meets the surface twice), which ``values``
        include.
    obliquity : float
        Obliquity factor, which ``values`` include.
    kind : str
        Kind of the file, such as ``Zygo MetroPro``.
    notes : tuple of str
        Sentences on the assumptions made in reading the file.
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
    def illuminated(self) -> NDArray[np.bool_]:
        """Mask (rows, columns) of the measured pixels."""
        return np.isfinite(self.values)


def unit_named(path: Path, text: str) -> str:
    """Return the unit of a text: ``m``, ``mm``, ``um``, ``nm``, ``pm``, ``cm`` or ``waves``.

    Parameters
    ----------
    path : Path
        File, for the message.
    text : str
        Name of the unit.

    Raises
    ------
    MapError
        The unit is unknown.
    """
    # accept both letters that mean micro
    name = text.strip().strip("'\"").lower().replace("\N{MICRO SIGN}", "u").replace("\N{GREEK SMALL LETTER MU}", "u")
    if name not in _NAMES:
        raise MapError(f"{path}: unknown unit {text.strip()[:40]!r}; m, mm, um, nm and waves are known")
    return _NAMES[name]


def metres_per(path: Path, unit: str, wavelength: float | None) -> float:
    """Return the number of metres in one unit.

    Parameters
    ----------
    path : Path
        File, for the message.
    unit : str
        Unit as returned by ``unit_named``.
    wavelength : float or None
        Wavelength, in metres; None if unknown.

    Raises
    ------
    MapError
        The unit is waves, and the wavelength is unknown.
    """
    if unit != WAVES:
        return _LENGTHS[unit]
    if wavelength is None:
        raise MapError(f"{path} is in waves and does not state the wavelength: specify the wavelength")
    return wavelength


def length_from(path: Path, text: str, key: str) -> float:
    """Return a positive length with its unit, such as ``632.8 nm``, in metres.

    Parameters
    ----------
    path : Path
        File, for the message.
    text : str
        Number and unit.
    key : str
        Name of the length, for the message.

    Raises
    ------
    MapError
        The text is not a positive length with a unit.
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


def agreed(path: Path, key: str, specified: float | None, in_file: float | None) -> float | None:
    """Return a value that file or user specifies; raise MapError if both specify it differently.

    Parameters
    ----------
    path : Path
        File, for the message.
    key : str
        Name of the value, for the message.
    specified : float or None
        Value specified by the user, SI units.
    in_file : float or None
        Value in the file.

    Raises
    ------
    MapError
        The values differ by more than a millionth.
    """
    if specified is None or in_file is None:
        return in_file if specified is None else specified
    if abs(specified - in_file) > 1e-6 * abs(in_file):
        raise MapError(
            f"{path} states {key} {in_file:.8g} m, but {specified:.8g} m is specified: remove the specification"
        )
    return in_file


MOST_BYTES = 100_000_000
"""Largest size of a text file that is read, in bytes."""
MOST_POINTS = 20_000_000
"""Largest number of points of a map that is read."""
_ZEMAX_UNITS = {0: 1e-3, 1: 1e-2, 2: 25.4e-3, 3: 1.0}
"""Size, in metres, of the unit that each unit flag of a Zemax Grid Sag file means."""
_CODEV_NO_DATA = -32768
"""Integer value that marks missing data in CODE V files whose header does not define another by the keyword NDA."""
_CODEV_DATA = ("WFR", "SUR", "FIL")
_CODEV_KEY = re.compile(r"\b(GRD|ZFR|ZRN)\s+\d+", re.IGNORECASE)
_HEADER_LINE = re.compile(r"#\s*([\w ]+?)\s*[:=]\s*(.*)")
_WHAT = ("wavefront", "surface")

Line = tuple[int, str]
"""Line of a text file: its number, counted from 1, and its text."""


def text_of(path: Path) -> str:
    """Return the text of a file in UTF-8, UTF-16 with byte order mark, or Latin-1.

    Parameters
    ----------
    path : Path
        File to read.

    Raises
    ------
    MapError
        The file is too large, or is not a text file.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise MapError(
            f"{path} has {size * 1e-6:.0f} MB, at most {MOST_BYTES * 1e-6:.0f} MB are read: save a smaller map"
        )
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    if b"\0" in data:
        raise MapError(
            f"{path} is not a wavefront file of a known format: MetroPro .dat, .datx, CODE V INT, Zemax Grid Sag, FITS"
            " and text tables are read"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def lines_of(text: str, comment: str) -> list[Line]:
    """Return the non-empty lines that are not comments, with their numbers.

    Parameters
    ----------
    text : str
        Text of the file.
    comment : str
        Start of a comment line.
    """
    numbered = enumerate(text.splitlines(), 1)
    return [(n, s) for n, s in ((n, line.strip()) for n, line in numbered) if s and not s.startswith(comment)]


def is_codev(lines: list[Line]) -> bool:
    """Return True if one of the first lines, after possible titles, is a CODE V header of a grid or Zernike terms.

    Parameters
    ----------
    lines : list of (int, str)
        Lines of the file without comments.
    """
    return any(_CODEV_KEY.match(text) for _, text in lines[:4])


def is_zemax(lines: list[Line]) -> bool:
    """Return True if the first line has the five or seven numbers of the header of a Zemax Grid Sag file.

    Parameters
    ----------
    lines : list of (int, str)
        Lines of the file without comments.
    """
    first = lines[0][1].split() if lines else []
    if len(first) not in (5, 7) or not all(re.fullmatch(r"[0-9]{1,9}", word) for word in first[:2]):
        return False
    # a plain table has as many columns in the second line, and a number of rows unrelated to its first two numbers
    like_a_table = len(lines) > 1 and len(lines[1][1].split()) == len(first)
    return not like_a_table or len(lines) == int(first[0]) * int(first[1]) + 1


def _numbers(path: Path, lines: Iterable[Line], split: str = r"\s+") -> tuple[Array, list[int]]:
    """Return all numbers in some lines as one array, and how many each line holds; MapError for other text."""
    numbers, widths = array("d"), []
    for number, text in lines:
        words = re.split(split, text.strip(" \t,;"))
        for word in words:
            try:
                # reject 1_000, which only Python reads as a number
                numbers.append(float(word.replace("_", "?")))
            except ValueError:
                raise MapError(f"{path}, line {number}: {word[:40]!r} is not a number") from None
        widths.append(len(words))
    return np.array(numbers), widths


def read_codev(path: Path, lines: list[Line]) -> WavefrontMap:
    """Read a CODE V interferogram file that holds a grid of integers.

    The header gives SSZ, the integer that corresponds to one wave, and WVL, the wavelength in micrometres.

    Parameters
    ----------
    path : Path
        File to read, for messages.
    lines : list of (int, str)
        Lines of the file without comments.

    Raises
    ------
    MapError
        The file holds Zernike terms or transmissions, the header is not understood, or the number of points is wrong.
    """
    header_index = next(k for k, (_, text) in enumerate(lines) if _CODEV_KEY.match(text))
    number, header = lines[header_index]
    where = f"{path}, line {number}"
    words = header.upper().split()
    sizes: list[int] = []
    kind = ""
    values: dict[str, float] = {}
    while words:
        word = words.pop(0)
        if word in ("ZFR", "ZRN"):
            raise MapError(
                f"{where}: the file holds Zernike terms ({word}), not a grid: write them as a table of terms"
            )
        needed = 2 if word == "GRD" else 1 if word in ("WVL", "SSZ", "NDA", "XSC") else 0
        if not needed and word not in (*_CODEV_DATA, "NNB"):
            raise MapError(f"{where}: {word[:40]!r} is not understood; GRD, WFR, SUR, WVL, SSZ, NDA, XSC, NNB are")
        arguments, words = words[:needed], words[needed:]
        try:
            numbers = [float(number_text) for number_text in arguments]
        except ValueError:
            numbers = []
        if len(numbers) < needed or not all(map(math.isfinite, numbers)):
            raise MapError(f"{where}: {needed} number(s) are needed after {word}, found {' '.join(arguments)[:40]!r}")
        if word == "GRD":
            sizes = [int(number_text) if number_text == int(number_text) else 0 for number_text in numbers]
        elif word in _CODEV_DATA:
            kind = word
        elif needed:
            values[word] = numbers[0]
    if kind == "FIL":
        raise MapError(f"{where}: the file holds transmissions (FIL), not a wavefront: use a file with WFR or SUR")
    if not kind:
        raise MapError(f"{where} states neither WFR (wavefront) nor SUR (surface)")
    for key, meaning in (("WVL", "the wavelength in micrometres"), ("SSZ", "the number of counts in a wave")):
        if not values.get(key, 0.0) > 0.0:
            raise MapError(f"{where}: {key}, {meaning}, is missing or not positive")
    if abs(values.get("XSC", 1.0) - 1.0) > 1e-6:
        raise MapError(f"{where}: its pixels are not square (XSC {values['XSC']:g}): resample the map to square ones")
    columns, rows = _grid(where, sizes)
    counts, _ = _numbers(path, lines[header_index + 1 :])
    _check_points(path, counts, len(counts), rows, columns)
    counts = counts.reshape(rows, columns)
    no_data = values.get("NDA", _CODEV_NO_DATA)
    metres = values["WVL"] * 1e-6 / values["SSZ"]
    note = f"NDA is not stated; {_CODEV_NO_DATA} was used for missing data, as in CODE V."
    notes = () if "NDA" in values else (note,)
    return WavefrontMap(
        values=np.where(counts == no_data, np.nan, counts * metres)[::-1],
        spacing=math.nan,
        wavelength=values["WVL"] * 1e-6,
        what="wavefront" if kind == "WFR" else "surface",
        kind="CODE V INT",
        notes=notes,
    )


def read_zemax(path: Path, lines: list[Line]) -> WavefrontMap:
    """Read a surface from a Zemax Grid Sag file.

    The first line holds sizes, steps and unit; then there is a line per point, sag before its slopes.

    A Grid Phase file has the same form and holds radians; it cannot be distinguished from one of sags.

    Parameters
    ----------
    path : Path
        File to read, for messages.
    lines : list of (int, str)
        Lines of the file without comments.

    Raises
    ------
    MapError
        Header or points do not have this form.
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
            f"{where}: steps {step_x:g} and {step_y:g} are not square pixels: resample the map to square ones"
        )
    points, widths = _numbers(path, lines[1:])
    if len(set(widths)) != 1 or widths[0] not in (1, 4, 5):
        raise MapError(f"{path}: each line has to hold sag, three derivatives and no-data flag, or the sag alone")
    _check_points(path, points, len(widths), rows, columns)
    table = points.reshape(rows * columns, widths[0])
    measured = table[:, 4] == 0.0 if table.shape[1] == 5 else np.ones(len(table), bool)
    values = np.where(measured, table[:, 0] * unit, np.nan).reshape(rows, columns)[::-1]
    notes = ["Read as sag. A Grid Phase file has the same form but holds radians."]
    if any(shift):
        notes.append("The shift of the grid that the file states (xdec, ydec) is not used.")
    return WavefrontMap(values, step_x * unit, None, "surface", kind="Zemax Grid Sag", notes=tuple(notes))


def read_table(path: Path, text: str, wavelength: float | None) -> WavefrontMap:
    """Read a plain table of numbers, separated by commas, semicolons or blanks, with ``nan`` for missing points.

    Lines ``# unit: nm``, ``# spacing: 0.1 mm``, ``# wavelength: 632.8 nm`` and ``# what: surface`` before it state its
    meaning; the unit is required.

    Parameters
    ----------
    path : Path
        File to read, for messages.
    text : str
        Text of the file.
    wavelength : float or None
        Wavelength, in metres, if the file does not state it.

    Raises
    ------
    MapError
        The file holds no table or no unit, or the wavelength contradicts the file.
    """
    header = statements(path, text, ("unit", "spacing", "wavelength", "what"))
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
    in_file = length_from(path, header["wavelength"], "wavelength") if "wavelength" in header else None
    wavelength = agreed(path, "wavelength", wavelength, in_file)
    unit = unit_written(path, header.get("unit"), "a line '# unit: nm' before the numbers")
    what = header.get("what")
    if what is not None and what not in _WHAT:
        raise MapError(f"{path}: what is {what[:40]!r}; wavefront and surface are known")
    spacing = length_from(path, header["spacing"], "spacing") if "spacing" in header else math.nan
    return WavefrontMap(table[::-1] * metres_per(path, unit, wavelength), spacing, wavelength, what, kind="text table")


def statements(path: Path, text: str, keys: tuple[str, ...]) -> dict[str, str]:
    """Return the values of the header lines ``# key: value`` of a text table; other comments are ignored.

    Parameters
    ----------
    path : Path
        File, for messages.
    text : str
        Text of the file.
    keys : tuple of str
        Known keys.

    Raises
    ------
    MapError
        A key occurs twice.
    """
    values: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        match = _HEADER_LINE.fullmatch(line.strip())
        if match is None or (key := match[1].lower()) not in keys:
            continue
        if key in values:
            raise MapError(f"{path}, line {number}: {key} is stated twice")
        values[key] = match[2].strip()
    return values


def unit_written(path: Path, unit: str | None, remedy: str) -> str:
    """Return the unit specified in a file; raise MapError if it is missing or unknown.

    Parameters
    ----------
    path : Path
        File, for messages.
    unit : str or None
        Unit in the file.
    remedy : str
        How the file could state it, for the message.

    Raises
    ------
    MapError
        The unit is missing or unknown.
    """
    if unit is None:
        raise MapError(f"{path} does not state its unit: add {remedy}")
    return unit_named(path, unit)


def _grid(where: str, sizes: list[int]) -> tuple[int, int]:
    """Return the numbers of rows and columns of a grid from a file; raise MapError if they are out of range."""
    if len(sizes) != 2 or min(sizes) < 2 or math.prod(sizes) > MOST_POINTS:
        raise MapError(f"{where}: a grid of {' x '.join(map(str, sizes))} points; 2 to {MOST_POINTS} in all are read")
    return sizes[0], sizes[1]


def _check_points(path: Path, numbers: Array, count: int, rows: int, columns: int) -> None:
    """Raise MapError if a file has a wrong number of points, or a point that is not finite."""
    if count != rows * columns:
        raise MapError(
            f"{path} has {count} points, but its header states {columns} x {rows}: it is truncated or extended"
        )
    if not np.isfinite(numbers).all():
        raise MapError(f"{path}: a point is not a finite number; files mark points without data in another way")


METROPRO_MAGIC = b"\x88\x1b\x03"
"""First bytes of MetroPro files, which precede the byte that gives the header format."""
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
"""First bytes of HDF5 files."""
_HEADERS = {0x6F: 834, 0x70: 834, 0x71: 4096}
"""Smallest header size, in bytes, of each MetroPro header format; the key is the last byte of the magic number."""
_STEPS = {0: 4096, 1: 32768, 2: 131072}
"""Number of integer counts per fringe for each value of the header's phase resolution in MetroPro files."""
_INVALID = 2147483640
"""Integer count from which on a point of a Zygo file is marked as not measured."""
_LARGEST_WAVELENGTH = 1e-3
"""Largest plausible wavelength, in metres."""
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
"""Format (as in Python's struct) and byte offset of the fields of a MetroPro header that are read."""


def is_metropro(start: bytes) -> bool:
    """Return True if the first bytes of a file are MetroPro's."""
    return start[:3] == METROPRO_MAGIC and start[3:4] != b"" and start[3] in _HEADERS


def read_metropro(path: Path) -> WavefrontMap:
    """Read a MetroPro file with any of its three header formats.

    A truncated file is rejected, not filled up with zeros, which would be measured values.

    Parameters
    ----------
    path : Path
        File to read.

    Raises
    ------
    MapError
        The file holds no phase, its header is invalid, or it is truncated.
    """
    data = path.read_bytes()
    if len(data) < _HEADERS[data[3]]:
        raise MapError(f"{path} is truncated in its header: copy it again from the interferometer")
    head: dict[str, Any] = {key: struct.unpack_from(form, data, offset)[0] for key, (form, offset) in _FIELDS.items()}
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
    single_frame_start = head["header_size"] + 2 * head["frame_width"] * head["frame_height"]
    # some programs write a frame although their frame count is zero
    start = single_frame_start if not head["frames"] and len(data) >= single_frame_start + 4 * rows * columns else start
    if len(data) < start + 4 * rows * columns or head["header_size"] < _HEADERS[data[3]]:
        raise MapError(
            f"{path} is truncated or damaged: its header states {rows} x {columns} points from byte {start} on, the"
            f" file has {len(data)} bytes; copy it again"
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
    """Return the sentence that reports the interferometric scale factor used, in waves per fringe."""
    return f"The interferometric scale factor of the file, {scale:.6g} waves per fringe, is in the values."


def read_datx(path: Path, wavelength: float | None = None) -> WavefrontMap:
    """Read an Mx file, in its present layout (``Data/Surface``) or its first one (``Measurement/Surface``).

    Parameters
    ----------
    path : Path
        File to read.
    wavelength : float, optional
        Wavelength, in metres, if the file does not state it.

    Raises
    ------
    MapError
        The file is HDF5 of another kind, or damaged.
    """
    try:
        return _datx(path, wavelength)
    except MapError:
        raise
    # the errors of the library for a damaged file are neither documented nor meant for users
    except Exception as error:
        raise MapError(f"{path} cannot be read as a .datx file: it is damaged; copy it again") from error


def _datx(path: Path, specified: float | None) -> WavefrontMap:
    """Read an Mx file without handling the errors of the HDF5 library."""
    # imported for such a file only
    import h5py

    with h5py.File(path, "r") as file:
        surfaces = list(_surfaces(file))
        if not surfaces:
            raise MapError(f"{path} is HDF5, but not a .datx file of Zygo: it has neither Data/Surface nor Measurement")
        surface = surfaces[0]
        shape = surface.shape
        if len(shape) != 2 or 0 in shape or surface.dtype.kind not in "iuf":
            raise MapError(f"{path}: its surface is not a map of numbers (shape {shape}, type {surface.dtype})")
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
    wavelength = wave if usable else specified
    if not isinstance(unit, str) or not unit:
        raise MapError(f"{path} does not state the unit of its surface; save it from Mx in fringes or nanometres")
    if unit.lower() == "fringes":
        if not (math.isfinite(scale) and scale > 0.0 and math.isfinite(obliquity) and obliquity > 0.0):
            raise MapError(f"{path} is in fringes and has no usable interferometric scale factor or obliquity factor")
        if wavelength is None:
            raise MapError(f"{path} is in fringes and does not state the wavelength: specify the wavelength")
        values = stored * obliquity * scale * wavelength
        notes = [_of_scale(scale)]
    else:
        values = stored * metres_per(path, unit_named(path, unit), wavelength)
        scale = obliquity = 1.0
        notes = [f"The file is in {unit}; no scale factor was applied."]
    if len(surfaces) > 1:
        notes.append(f"The file has {len(surfaces)} surfaces, of which the first was read.")
    return WavefrontMap(values, spacing, wavelength, None, scale, obliquity, "Zygo datx", tuple(notes))


def _surfaces(file: Any) -> Iterator[Any]:
    """Yield the HDF5 data sets of an Mx file that hold surfaces, in the order of their names."""
    import h5py

    for name in ("Data/Surface", "Measurement/Surface"):
        node = _member(file, name)
        if isinstance(node, h5py.Dataset):
            yield node
        elif isinstance(node, h5py.Group):
            members = (_member(node, key) for key in sorted(node))
            yield from (member for member in members if isinstance(member, h5py.Dataset))


def _member(node: Any, name: str) -> Any:
    """Return an HDF5 group or data set by its name, or None if there is none; links are refused.

    Raises
    ------
    MapError
        The name, or a part of it, is a link.
    """
    import h5py

    for part in name.split("/"):
        if not isinstance(node, h5py.Group):
            return None
        if isinstance(node.get(part, getlink=True), h5py.ExternalLink | h5py.SoftLink):
            raise MapError(
                f"{node.file.filename}: {part} is a link to another place; save it as one file, without links"
            )
        node = node.get(part)
    return node


def _attributes(file: Any, surface: Any) -> dict[str, Any]:
    """Return scalar and text attributes of an HDF5 surface, supplemented by those of its measurement."""
    import h5py

    general = _member(file, "Measurement/Attributes")
    attributes: dict[str, Any] = {}
    for holder in (general, surface):
        if isinstance(holder, h5py.Group | h5py.Dataset):
            for key, value in holder.attrs.items():
                first = np.asarray(value).reshape(-1)[:1]
                if first.size and first.dtype.kind in "OSUiuf":
                    scalar = first[0]
                    attributes[key] = scalar.decode("utf-8", "replace") if isinstance(scalar, bytes) else scalar
    # attribute names of the first layout
    for old, new in (("Interf Scale Factor", "Interferometric Scale Factor"), ("Obliquity", "Obliquity Factor")):
        if old in attributes:
            attributes.setdefault(new, attributes[old])
    return attributes


def _number(keys: dict[str, Any], key: str, otherwise: float) -> float:
    """Return the number under a key of a file's attributes, or a default if it is missing or a text."""
    value = keys.get(key, otherwise)
    return otherwise if isinstance(value, str) else float(value)


def _spacing(surface: Any) -> float:
    """Return the pixel spacing, in metres, of a surface in an Mx file, from its attribute for the x axis.

    The attribute holds category, unit and parameters; the spacing is the second parameter.
    """
    try:
        category, _, parameters = surface.attrs["X Converter"][0]
        spacing = float(parameters[1])
    except (KeyError, IndexError, TypeError, ValueError):
        return math.nan
    name = category.decode("utf-8", "replace") if isinstance(category, bytes) else str(category)
    return spacing if name == "LateralCat" and math.isfinite(spacing) and spacing > 0.0 else math.nan


_PUPIL_SCALE = ("PUPLSCAL", "PIXELSCL", "PIXSCALE")
"""FITS keys with metres per pixel of pupils, as POPPY writes and reads them."""
_LARGEST_PIXEL, _LARGEST = 1.0, 10.0
"""Largest plausible pixel size in a pupil, and largest plausible wavefront error, both in metres.

Beyond them a unit is wrong or a file is damaged.
"""


def read_map(path: Path, *, wavelength: float | None = None) -> WavefrontMap:
    """Read a map from a file of MetroPro, Mx, CODE V, Zemax, FITS, or from a text table.

    Parameters
    ----------
    path : Path
        File to read.
    wavelength : float, optional
        Wavelength, in metres, for files in waves that do not state it.

    Raises
    ------
    MapError
        The file cannot be read; the message gives the reason and the remedy.
    """
    path = Path(path)
    if path.is_dir():
        raise MapError(f"{path} is a folder, not a file of a wavefront")
    if not path.exists():
        raise MapError(f"there is no file {path}")
    if not path.is_file():  # reading it could block or never end
        raise MapError(f"{path} is a device, a pipe or a socket, not a file of a wavefront")
    try:
        with path.open("rb") as file:
            start = file.read(16)
        with np.errstate(over="ignore", invalid="ignore"):  # checked below
            wavefront_map = _read(path, start, wavelength)
    except OSError as error:
        raise MapError(f"{path} cannot be read: {error.strerror or 'input/output error'}") from error
    largest = np.max(np.abs(wavefront_map.values), where=~np.isnan(wavefront_map.values), initial=0.0)
    if largest > _LARGEST:
        raise MapError(
            f"{path} holds values of up to {largest:.3g} m, which is too large for a wavefront: check its unit"
        )
    if not np.isfinite(wavefront_map.values).any():
        raise MapError(f"{path} holds no measured point: all {wavefront_map.values.size} points are missing")
    agreed(path, "wavelength", wavelength, wavefront_map.wavelength)
    # keep a specified wavelength also if the file did not need it
    return (
        wavefront_map
        if wavefront_map.wavelength is not None or wavelength is None
        else replace(wavefront_map, wavelength=wavelength)
    )


def _read(path: Path, start: bytes, wavelength: float | None) -> WavefrontMap:
    """Read a map with the reader that matches the first bytes of the file."""
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
    """Read a wavefront or surface from an image of a FITS file; its row 0, displayed lowest, is row 0 of the map."""
    try:
        image = ImageFile.open(path, choose="")
        if len(image.header.pages) != 1:
            raise MapError(f"{path} has {len(image.header.pages)} images: save one of them as a file of its own")
        (values,) = image.frames()
        header = fits_cards(path, image.header.pages[0])
    except ImageError as error:
        raise MapError(str(error)) from error
    written = header.get("BUNIT")
    unit = unit_written(path, str(written) if written else None, "the key BUNIT")
    scale = next((float(header[key]) for key in _PUPIL_SCALE if isinstance(header.get(key), int | float)), math.nan)
    in_metres = "arc" not in str(header.get("PIXUNIT", "meter")).lower() and 0.0 < scale < _LARGEST_PIXEL
    metres = metres_per(path, unit, wavelength)
    values = np.asarray(values, dtype=np.float64) * metres
    return WavefrontMap(
        values=values,
        spacing=scale if in_metres else math.nan,
        wavelength=wavelength,
        what="wavefront" if str(header.get("EXTNAME", "")).upper() == "OPD" else None,
        kind="FITS",
        notes=("Zeros of a FITS file count as measured; write NaN where no light is.",),
    )
