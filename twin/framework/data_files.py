"""Data, tables and images in formats that other programs read.

Tables: CSV has the unit in brackets behind the name of a column. Parquet has ``unit`` and ``description`` in each
field's metadata, FITS the unit as TUNITn, in the standard's own spelling, and the description as TCOMMn.

CF knows units by UDUNITS and quantities by its table of standard names, in which a camera has few. A unit that UDUNITS
does not know (pixels, waves, grey values) is a count: its ``units`` are 1, and ``counted_in`` says of what.

They are made in memory: on a full disk HDF5 crashes the process, and nothing says why.
"""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
import tifffile

from optics.numerics.extension_table import ExtensionTable
from optics.numerics.number_tree import FrozenMap
from twin.framework.frame_store import FileRoom, in_file, mean_of, parts

if TYPE_CHECKING:
    import xarray as xr


import math
import unicodedata
from dataclasses import field

CONVENTIONS = "CF-1.11"
SPELT: Mapping[str, str] = FrozenMap({"deg": "degree", "mas": "milliarcsec"})
"""Unit as the program writes it -> as UDUNITS does; all that are in neither mapping are the same."""
COUNTS = frozenset(("px", "waves", "DN", "photons"))
"""Units that count something."""
WRITER = "space-camera-twin"


Gridded = tuple[str | tuple[str, ...], Any, Mapping[str, Any]]
"""Axes, values and attributes of a variable, as xarray takes them."""


@dataclass(frozen=True, eq=False)
class GridData:
    """Arrays on named axes, to be written without xarray, whose import takes longer than most files.

    Attributes
    ----------
    variables : Mapping[str, Gridded]
        Name -> real numbers.
    coords : Mapping[str, Gridded]
        Name -> coordinates of the axes, real numbers or texts.
    attrs : Mapping[str, Any]
        Of all, ``title`` among them.
    """

    variables: Mapping[str, Gridded]
    coords: Mapping[str, Gridded]
    attrs: Mapping[str, Any]

    def to_xarray(self) -> xr.Dataset:
        """The same as a data set."""
        import xarray as xr

        return xr.Dataset(self.variables, self.coords, self.attrs)


def netcdf(data: xr.Dataset | GridData) -> bytes:
    """A data set as the contents of a netCDF-4 file by CF 1.11; the same data give the same bytes.

    Parameters
    ----------
    data : xr.Dataset | GridData
        With ``title`` among its attributes; of every variable ``long_name`` and of numbers ``units``, which are 1 where
        there are none.
    """
    if isinstance(data, GridData):
        return _grid_file(data)
    told = follow_cf(data)
    # coordinates have no gaps
    view = told.to_netcdf(engine="h5netcdf", encoding={name: {"_FillValue": None} for name in told.coords})
    content = bytes(view)
    # xarray hands out a window on its buffer, which complains when it is thrown away with the window still open
    if isinstance(view, memoryview):
        view.release()
    return content


def _grid_file(data: GridData) -> bytes:
    """The file that xarray makes of the same data, to the byte."""
    import h5netcdf
    import h5py

    every = [
        *((name, one, False) for name, one in data.variables.items()),
        *((*of, True) for of in data.coords.items()),
    ]
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        file.attrs.update(_cf_attributes(data.attrs))
        for _, (dims, values, _), _ in every:
            for dim, size in zip(_axes(dims), np.shape(values), strict=True):
                if dim not in file.dimensions:
                    file.dimensions[dim] = size
        for name, (dims, values, attrs), coordinate in every:
            axes, array = _axes(dims), np.asarray(values)
            if array.dtype.kind not in "fU":
                raise TypeError(f"{name}: neither real numbers nor texts: {array.dtype}")
            text = array.dtype.kind == "U"
            # coordinates have no gaps
            fill = None if coordinate or text else array.dtype.type(np.nan)
            kind = h5py.string_dtype() if text else array.dtype
            made = file.create_variable(name, axes, dtype=kind, fillvalue=fill)
            made.attrs.update(_units(attrs, not text))
            of_it = sorted(k for k, (on, *_) in data.coords.items() if k not in axes and set(_axes(on)) <= set(axes))
            if of_it and not coordinate:
                made.attrs["coordinates"] = " ".join(of_it)
            made[...] = array.astype(object) if text else array
    return buffer.getvalue()


def _axes(dims: str | tuple[str, ...]) -> tuple[str, ...]:
    return (dims,) if isinstance(dims, str) else dims


def read_netcdf(content: bytes) -> xr.Dataset:
    """The data set in the bytes of a netCDF file, loaded whole; units of time stay as they are written.

    Raises
    ------
    Exception
        The file is damaged, in whatever way the libraries stumble over it; also where they would only warn.
    """
    import h5py
    import xarray as xr

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # where HDF5 cannot open it, h5netcdf would leave half an object that prints an error of its own later
        with h5py.File(io.BytesIO(content)):
            pass
        # read from memory, since of a damaged file the library leaves the file open
        with xr.open_dataset(io.BytesIO(content), engine="h5netcdf", decode_timedelta=False) as data:
            return data.load()


def follow_cf(data: xr.Dataset) -> xr.Dataset:
    """The data set with the attributes that CF asks for; values are the same."""
    out = data.assign_attrs(_cf_attributes(data.attrs))
    for name in out.variables:
        variable = out.variables[name]
        numbers = variable.dtype.kind in "iufb"
        out[name].attrs = _units(variable.attrs, numbers)
    return out


def _cf_attributes(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Attributes of a file with those that CF asks for."""
    version = f"{WRITER} {importlib.metadata.version(WRITER)}"
    # CF wants a history, which begins here; it names no time, so that the same run gives the same bytes
    said = {"Conventions": CONVENTIONS, "source": f"simulation by {version}", "history": f"written by {version}"}
    return {**attributes, **said}


_FORMULA = re.compile(r"[=+\-@\t\r].")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|[+-]?(inf|nan)", re.IGNORECASE)


def _units(attributes: Mapping[Any, Any], numbers: bool) -> dict[str, Any]:
    """Attributes of a variable with units that UDUNITS knows; texts have none."""
    rest = {str(key): value for key, value in attributes.items() if key != "units"}
    if not numbers:
        return rest
    unit = str(attributes.get("units", ""))
    counted, _, how = unit.partition(" ")
    if counted in COUNTS:
        return {"units": "1", "counted_in": " ".join(filter(None, (counted, how))), **rest}
    return {"units": SPELT.get(unit, unit) or "1", **rest}


def csv_table(rows: Iterable[Sequence[Any]]) -> bytes:
    """Return rows, the heads first, as the contents of a CSV file in UTF-8.

    Numbers have all digits, None is an empty cell, and a text that a spreadsheet would take for a formula begins with a
    single quotation mark.
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(_harmless, row) for row in rows)
    return text.getvalue().encode()


def _harmless(cell: Any) -> Any:
    return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) and not _NUMBER.fullmatch(cell) else cell


SPOT_STRETCH = 30.0
"""Steepness of an asinh stretch that shows faint diffraction rings beside a spot's core."""

ENLARGE = 4
LARGEST_ENLARGED = 600
"""Rows or columns from which a picture is shown as large as it is."""


class Placed(Protocol):
    """What says where on the ground the pixels of an image lie."""

    def tags(self) -> list[tuple[Any, ...]]:
        """Tags as tifffile takes them: code, type, count, value, only once in the file."""


@dataclass(frozen=True)
class MapPlace:
    """Where the pixels of a map lie: longitude and latitude are linear in column and row.

    Attributes
    ----------
    longitude, latitude : float
        Of the middle of the first pixel, degrees.
    per_column, per_row : float
        Degrees of longitude and of latitude, the latter below zero where rows go south.
    heights : bool
        Whether the values are heights above the ellipsoid of WGS 84.
    """

    longitude: float
    latitude: float
    per_column: float
    per_row: float
    heights: bool = False

    def tags(self) -> list[tuple[Any, ...]]:
        """Tags of a GeoTIFF (OGC 19-008r4): pixels are areas, the corner of the first is the tie point."""
        scale = (self.per_column, -self.per_row, 0.0)
        tie = (0.0, 0.0, 0.0, self.longitude - 0.5 * self.per_column, self.latitude - 0.5 * self.per_row, 0.0)
        system = 4979 if self.heights else 4326
        keys = (1, 1, 1, 3, 1024, 0, 1, 2, 1025, 0, 1, 1, 2048, 0, 1, system)
        return [(33550, "d", 3, scale, True), (33922, "d", 6, tie, True), (34735, "H", len(keys), keys, True)]


@dataclass(frozen=True)
class FrameFacts:
    """What recorded frames are, for whoever has nothing but their file.

    Attributes
    ----------
    camera : str
        Whose CCD it is, for people: ``forward, left area CCD``; empty if nobody says.
    pitch : float | None
        Of the pixels, metres; None if nobody says, as the others.
    exposure : float | None
        Of each frame, seconds.
    times : tuple[float, ...] | None
        Of each frame in the course, seconds.
    note : str
        What else is to be known.
    place : Placed | None
        Of a map, or of an image from orbit; the TIFF then is a GeoTIFF.
    """

    camera: str = ""
    pitch: float | None = None
    exposure: float | None = None
    times: tuple[float, ...] | None = None
    note: str = ""
    place: Placed | None = None

    def page(self, k: int) -> dict[str, Any]:
        """What is known of frame number ``k``, as plain data."""
        known = {
            "camera": self.camera or None,
            "frame": k + 1,
            "pitch_um": None if self.pitch is None else round(1e6 * self.pitch, 9),
            "exposure_s": self.exposure,
            "time_s": None if self.times is None else self.times[k],
            "note": self.note or None,
        }
        return {key: value for key, value in known.items() if value is not None}


_MODEL, _EXPOSURE_TIME = 272, 33434
_RATIONAL = 10**6
"""Denominator of exposure times in tags."""


def tiff(frames: np.ndarray, facts: FrameFacts) -> bytes | memoryview:
    """Frames (N, H, W) as a TIFF file of N pages, each with what is known of it in its tags.

    ImageDescription holds all as JSON; XResolution and YResolution are pixels per centimetre; Model is the camera,
    ExposureTime in seconds as in Exif. Row 0 is the first of the CCD.

    Parameters
    ----------
    frames : np.ndarray
        uint16 or float (N, H, W).
    facts : FrameFacts
        What is known of them.
    """
    # made in memory: on a full disk NumPy's writer does not say why it failed
    stream = FileRoom(frames.nbytes) if in_file(frames) else io.BytesIO()
    tags: list[tuple[Any, ...]] = []
    if facts.camera:
        tags.append((_MODEL, "s", 0, facts.camera, True))
    if facts.exposure is not None:
        tags.append((_EXPOSURE_TIME, "2I", 1, (round(_RATIONAL * facts.exposure), _RATIONAL), True))
    if facts.place is not None:
        tags += facts.place.tags()
    scale: dict[str, Any] = {}
    if facts.pitch is not None:
        scale = {"resolution": (1e-2 / facts.pitch,) * 2, "resolutionunit": "CENTIMETER"}
    with tifffile.TiffWriter(stream) as file:
        for k, frame in enumerate(frame for _, some in parts(frames) for frame in some):
            about = json.dumps(facts.page(k))
            file.write(
                frame,
                photometric="minisblack",
                contiguous=False,
                description=about,
                metadata=None,
                software=WRITER,
                extratags=tags,
                **scale,
            )
    return stream.contents() if isinstance(stream, FileRoom) else stream.getvalue()


FRAME_FORMATS = ExtensionTable[Callable[[np.ndarray, FrameFacts], bytes | memoryview]]("frame_formats", {"tiff": tiff})
"""Ending of a file of recorded frames -> its contents, of frames uint16 (N, H, W) and what is known of them. A new one
is added here.
"""


def frame_files(
    name: str, frames: np.ndarray, facts: FrameFacts, stretch: float | None = SPOT_STRETCH
) -> Iterator[tuple[str, bytes | memoryview]]:
    """(file, contents) of everything that a run folder has of recorded frames: all formats, and a picture to look at.

    Parameters
    ----------
    name : str
        Of the frames.
    frames : np.ndarray
        uint16 (N, H, W).
    facts : FrameFacts
        What is known of them.
    stretch : float | None
        Of the picture, see ``preview``.
    """
    for ending, contents in FRAME_FORMATS.items():
        yield f"images/{name}.{ending}", contents(frames, facts)
    yield f"images/{name}.png", preview_png(frames, stretch)


def preview(frames: np.ndarray, stretch: float | None = SPOT_STRETCH) -> np.ndarray:
    """Eight-bit picture of the mean of frames (N, H, W), enlarged; ``stretch`` None keeps grey values in proportion."""
    mean = mean_of(frames) if in_file(frames) else frames.mean(axis=0)
    low, high = (np.percentile(mean, 5) if stretch else mean.min()), mean.max()
    level = np.clip((mean - low) / max(high - low, 1.0), 0.0, 1.0)
    if stretch:
        level = np.arcsinh(stretch * level) / np.arcsinh(stretch)
    factor = ENLARGE if max(mean.shape) < LARGEST_ENLARGED else 1
    return np.kron(np.uint8(np.rint(255.0 * level)), np.ones((factor, factor), np.uint8))


def preview_png(frames: np.ndarray, stretch: float | None = SPOT_STRETCH) -> bytes:
    """``preview`` as a PNG file."""
    return bytes(cv2.imencode(".png", preview(frames, stretch))[1].tobytes())


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

    Attributes
    ----------
    name : str
        Of it.
    values : np.ndarray
        (N,) float64, where NaN is none; int64; or texts, where None is none.
    unit : str
        Of the numbers as the program writes it, empty for pure numbers and texts.
    description : str
        What it holds.
    """

    name: str
    values: np.ndarray
    unit: str
    description: str

    @classmethod
    def of(cls, name: str, values: Sequence[Any], unit: str, description: str) -> DataColumn:
        """Make a column of plain values: numbers, whole where all are, or texts; None where there is none."""
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
        """The values as plain data, None where there is none."""
        values = self.values.tolist()
        return [None if isinstance(value, float) and math.isnan(value) else value for value in values]


@dataclass(frozen=True, eq=False)
class DataTable:
    """A table.

    Attributes
    ----------
    name : str
        Of it and of its file.
    title : str
        What it is.
    columns : tuple[DataColumn, ...]
        Of one length, their names all different.
    facts : Mapping[str, str]
        What else is to be known: name -> text.
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

        Raises
        ------
        KeyError
            There is none.
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


TABLE_FORMATS = ExtensionTable[Callable[[DataTable], bytes]](
    "table_formats", {"csv": _csv, "parquet": _parquet, "fits": _fits}
)
"""Ending of a file of a table -> its contents; raises MissingPackage. A new one is added here."""
