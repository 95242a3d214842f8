"""Data, tables and images in file formats that other programs read.

Tables: CSV has the unit in brackets after the name of a column. Parquet has ``unit`` and ``description`` in each
field's metadata; FITS has the unit as TUNITn, in the spelling of the standard, and the description as TCOMMn.

netCDF: CF takes units from UDUNITS and quantities from its table of standard names, which has few for a camera. A unit
that UDUNITS does not know (pixels, waves, grey values) is a count: its ``units`` are 1, and ``counted_in`` names it.

Files are made in memory, because HDF5 crashes the process without a message when the disk is full.
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
from twin.framework.frame_store import FileBuffer, in_file, mean_of, parts

if TYPE_CHECKING:
    import xarray as xr


import math
import unicodedata
from dataclasses import field

CONVENTIONS = "CF-1.11"
UDUNITS_NAMES: Mapping[str, str] = FrozenMap({"deg": "degree", "mas": "milliarcsec"})
"""Spelling of a unit in UDUNITS for each unit that this program spells differently; units that are neither here nor in
COUNTS are the same in both.
"""
COUNTS = frozenset(("px", "waves", "DN", "photons"))
"""Units of counts (pixels, waves, grey values, photons), which UDUNITS does not know."""
WRITER = "space-camera-twin"


Gridded = tuple[str | tuple[str, ...], Any, Mapping[str, Any]]
"""Axes, values and attributes of a variable, in the form that xarray accepts."""


@dataclass(frozen=True, eq=False)
class GridData:
    """Arrays on named axes for a netCDF file, without importing xarray, which takes longer than writing most files.

    Attributes
    ----------
    variables : mapping
        Variables of real numbers, by name.
    coords : mapping
        Coordinates along each axis, real numbers or texts, by the name of the axis.
    attrs : mapping
        Attributes of the file, including ``title``.
    """

    variables: Mapping[str, Gridded]
    coords: Mapping[str, Gridded]
    attrs: Mapping[str, Any]

    def to_xarray(self) -> xr.Dataset:
        """Return the data as an xarray data set."""
        import xarray as xr

        return xr.Dataset(self.variables, self.coords, self.attrs)


def netcdf(data: xr.Dataset | GridData) -> bytes:
    """Return a data set as the content of a netCDF-4 file with CF-1.11 attributes; equal data give equal bytes.

    Parameters
    ----------
    data : xr.Dataset | GridData
        Data with the attribute ``title``. Every variable has the attribute ``long_name``, and numbers have ``units``;
        without units, 1 is written.

    Returns
    -------
    bytes
        Content of the file.
    """
    if isinstance(data, GridData):
        return _grid_file(data)
    data_set = follow_cf(data)
    # coordinates have no gaps
    view = data_set.to_netcdf(engine="h5netcdf", encoding={name: {"_FillValue": None} for name in data_set.coords})
    content = bytes(view)
    # xarray returns a view of its buffer; without release, freeing the buffer raises an error
    if isinstance(view, memoryview):
        view.release()
    return content


def _grid_file(data: GridData) -> bytes:
    """Return a netCDF-4 file of the data as bytes, the same that xarray would write."""
    import h5netcdf
    import h5py

    variables = [
        *((name, variable, False) for name, variable in data.variables.items()),
        *((*of, True) for of in data.coords.items()),
    ]
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        file.attrs.update(_cf_attributes(data.attrs))
        for _, (dims, values, _), _ in variables:
            for dim, size in zip(_axes(dims), np.shape(values), strict=True):
                if dim not in file.dimensions:
                    file.dimensions[dim] = size
        for name, (dims, values, attrs), coordinate in variables:
            axes, array = _axes(dims), np.asarray(values)
            if array.dtype.kind not in "fU":
                raise TypeError(f"{name}: {array.dtype} values cannot be written; only real numbers and texts can")
            text = array.dtype.kind == "U"
            # coordinates have no gaps
            fill = None if coordinate or text else array.dtype.type(np.nan)
            kind = h5py.string_dtype() if text else array.dtype
            created = file.create_variable(name, axes, dtype=kind, fillvalue=fill)
            created.attrs.update(_units(attrs, not text))
            related = sorted(k for k, (on, *_) in data.coords.items() if k not in axes and set(_axes(on)) <= set(axes))
            if related and not coordinate:
                created.attrs["coordinates"] = " ".join(related)
            created[...] = array.astype(object) if text else array
    return buffer.getvalue()


def _axes(dims: str | tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of a variable's axes as a tuple, also if a single name is given."""
    return (dims,) if isinstance(dims, str) else dims


def read_netcdf(content: bytes) -> xr.Dataset:
    """Read a data set from the bytes of a netCDF file into memory; units of time stay as written.

    Raises
    ------
    Exception
        The file is damaged; the type depends on the library that fails. Warnings of the libraries are raised as well.
    """
    import h5py
    import xarray as xr

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # if HDF5 cannot open it, h5netcdf would leave an incomplete object that prints an error later
        with h5py.File(io.BytesIO(content)):
            pass
        # read from memory, since the library leaves a damaged file open
        with xr.open_dataset(io.BytesIO(content), engine="h5netcdf", decode_timedelta=False) as data:
            return data.load()


def follow_cf(data: xr.Dataset) -> xr.Dataset:
    """Return the data set with the attributes that CF requires, and unchanged values."""
    out = data.assign_attrs(_cf_attributes(data.attrs))
    for name in out.variables:
        variable = out.variables[name]
        numbers = variable.dtype.kind in "iufb"
        out[name].attrs = _units(variable.attrs, numbers)
    return out


def _cf_attributes(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the attributes of a file with those that CF requires."""
    version = f"{WRITER} {importlib.metadata.version(WRITER)}"
    # CF requires a history, which begins here; it has no time, so that the same run gives the same bytes
    required = {"Conventions": CONVENTIONS, "source": f"simulation by {version}", "history": f"written by {version}"}
    return {**attributes, **required}


_FORMULA = re.compile(r"[=+\-@\t\r].")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|[+-]?(inf|nan)", re.IGNORECASE)


def _units(attributes: Mapping[Any, Any], numbers: bool) -> dict[str, Any]:
    """Return the attributes of a variable with units that UDUNITS knows; texts have none."""
    rest = {str(key): value for key, value in attributes.items() if key != "units"}
    if not numbers:
        return rest
    unit = str(attributes.get("units", ""))
    counted, _, how = unit.partition(" ")
    if counted in COUNTS:
        return {"units": "1", "counted_in": " ".join(filter(None, (counted, how))), **rest}
    return {"units": UDUNITS_NAMES.get(unit, unit) or "1", **rest}


def csv_table(rows: Iterable[Sequence[Any]]) -> bytes:
    """Return rows, the heads first, as the contents of a CSV file in UTF-8.

    Numbers have all digits, None is an empty cell, and a text that a spreadsheet would take for a formula begins with a
    single quotation mark.
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(_harmless, row) for row in rows)
    return text.getvalue().encode()


def _harmless(cell: Any) -> Any:
    """Return a cell with a quotation mark before a text that a spreadsheet would take for a formula."""
    return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) and not _NUMBER.fullmatch(cell) else cell


SPOT_STEEPNESS = 30.0
"""Steepness of the asinh grey scale (dimensionless) that shows faint diffraction rings beside a spot's core."""

ENLARGE = 4
"""Integer factor by which small pictures of frames are magnified in PNG files."""
LARGEST_ENLARGED = 600
"""Number of rows or columns from which a picture is not magnified."""


class Georeference(Protocol):
    """Interface of an image's georeference, which gives the GeoTIFF tags of the file."""

    def tags(self) -> list[tuple[Any, ...]]:
        """Return tags in the form that tifffile accepts: code, type, count, value, written once per file."""


@dataclass(frozen=True)
class MapGeoreference:
    """Georeference of a map in longitude and latitude, which are linear in column and row.

    Attributes
    ----------
    longitude, latitude : float
        Position of the centre of the first pixel, in degrees.
    per_column, per_row : float
        Longitude per column and latitude per row, in degrees; the latter is negative if rows go south.
    heights : bool
        True if the values are heights above the WGS 84 ellipsoid.
    """

    longitude: float
    latitude: float
    per_column: float
    per_row: float
    heights: bool = False

    def tags(self) -> list[tuple[Any, ...]]:
        """Return the tags of a GeoTIFF (OGC 19-008r4); pixels are areas, the tie point is the first one's corner."""
        scale = (self.per_column, -self.per_row, 0.0)
        tie = (0.0, 0.0, 0.0, self.longitude - 0.5 * self.per_column, self.latitude - 0.5 * self.per_row, 0.0)
        system = 4979 if self.heights else 4326
        keys = (1, 1, 1, 3, 1024, 0, 1, 2, 1025, 0, 1, 1, 2048, 0, 1, system)
        return [(33550, "d", 3, scale, True), (33922, "d", 6, tie, True), (34735, "H", len(keys), keys, True)]


@dataclass(frozen=True)
class FrameFacts:
    """Description of recorded frames, written into their file.

    Attributes
    ----------
    camera : str
        Camera and detector, in words: ``forward, left area CCD``; empty if unknown.
    pitch : float | None
        Pixel pitch, in metres; None if unknown, here and below.
    exposure : float | None
        Exposure time of each frame, in seconds.
    times : tuple of float | None
        Time of each frame from the start of the time series, in seconds.
    note : str
        Further remarks.
    georeference : Georeference | None
        Georeference of a map or an image from orbit; the TIFF is then a GeoTIFF.
    """

    camera: str = ""
    pitch: float | None = None
    exposure: float | None = None
    times: tuple[float, ...] | None = None
    note: str = ""
    georeference: Georeference | None = None

    def page(self, k: int) -> dict[str, Any]:
        """Return the known facts about frame number ``k`` (camera, pitch, exposure, time) as plain data."""
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
"""Denominator of the fractions of a second as which TIFF tags hold exposure times: a resolution of 1 us."""


def tiff(frames: np.ndarray, facts: FrameFacts) -> bytes | memoryview:
    """Return frames as a TIFF file with one page per frame and the facts of each frame in its tags.

    ImageDescription holds all facts as JSON; XResolution and YResolution are pixels per centimetre; Model is the
    camera; ExposureTime is in seconds, as in Exif. Row 0 is the first row of the CCD.

    Parameters
    ----------
    frames : (N, H, W) ndarray of uint16 or float
        Grey values of N frames of H rows and W columns.
    facts : FrameFacts
        Description of the frames.

    Returns
    -------
    bytes or memoryview
        Content of the file.
    """
    # in memory, because on a full disk NumPy's writer does not report why it failed
    stream = FileBuffer(frames.nbytes) if in_file(frames) else io.BytesIO()
    tags: list[tuple[Any, ...]] = []
    if facts.camera:
        tags.append((_MODEL, "s", 0, facts.camera, True))
    if facts.exposure is not None:
        tags.append((_EXPOSURE_TIME, "2I", 1, (round(_RATIONAL * facts.exposure), _RATIONAL), True))
    if facts.georeference is not None:
        tags += facts.georeference.tags()
    scale: dict[str, Any] = {}
    if facts.pitch is not None:
        scale = {"resolution": (1e-2 / facts.pitch,) * 2, "resolutionunit": "CENTIMETER"}
    with tifffile.TiffWriter(stream) as file:
        for k, frame in enumerate(frame for _, part in parts(frames) for frame in part):
            about = json.dumps(facts.page(k))
            texts = {"description": about, "metadata": None, "software": WRITER, "extratags": tags}
            file.write(frame, photometric="minisblack", contiguous=False, **texts, **scale)
    return stream.contents() if isinstance(stream, FileBuffer) else stream.getvalue()


FRAME_FORMATS = ExtensionTable[Callable[[np.ndarray, FrameFacts], bytes | memoryview]]("frame_formats", {"tiff": tiff})
"""Functions that write N frames of H x W grey values, (N, H, W) uint16, and their description, by file extension. New
formats are added here.
"""


def frame_files(
    name: str, frames: np.ndarray, facts: FrameFacts, steepness: float | None = SPOT_STEEPNESS
) -> Iterator[tuple[str, bytes | memoryview]]:
    """Yield path and content of the files that a run folder stores of recorded frames: all formats, and a picture.

    Parameters
    ----------
    name : str
        Name of the frames.
    frames : (N, H, W) ndarray of uint16
        Recorded grey values of N frames of H rows and W columns.
    facts : FrameFacts
        Description of the frames.
    steepness : float | None
        Steepness of the picture's grey scale, see ``preview``.
    """
    for ending, contents in FRAME_FORMATS.items():
        yield f"images/{name}.{ending}", contents(frames, facts)
    yield f"images/{name}.png", preview_png(frames, steepness)


def preview(frames: np.ndarray, steepness: float | None = SPOT_STEEPNESS) -> np.ndarray:
    """Return a magnified 8-bit picture of the mean of N frames of H rows and W columns, (N, H, W).

    ``steepness`` is the steepness of an asinh grey scale; None gives a linear one.
    """
    mean = mean_of(frames) if in_file(frames) else frames.mean(axis=0)
    low, high = (np.percentile(mean, 5) if steepness else mean.min()), mean.max()
    level = np.clip((mean - low) / max(high - low, 1.0), 0.0, 1.0)
    if steepness:
        level = np.arcsinh(steepness * level) / np.arcsinh(steepness)
    factor = ENLARGE if max(mean.shape) < LARGEST_ENLARGED else 1
    return np.kron(np.uint8(np.rint(255.0 * level)), np.ones((factor, factor), np.uint8))


def preview_png(frames: np.ndarray, steepness: float | None = SPOT_STEEPNESS) -> bytes:
    """Return a magnified 8-bit picture of the mean of frames (N, H, W), as the bytes of a PNG file."""
    return bytes(cv2.imencode(".png", preview(frames, steepness))[1].tobytes())


FITS_UNITS: Mapping[str, str] = FrozenMap(
    {
        **{name: name for name in ("arcsec", "arcmin", "mas", "deg", "rad", "urad", "mrad")},
        **{name: name for name in ("pm", "nm", "um", "mm", "m", "km", "us", "ms", "s", "K", "mK", "mW", "W")},
        **{"K/m": "K/m", "m/s": "m/s", "1/m": "m-1", "1/mm": "mm-1", "DN": "adu", "px": "pixel", "photons": "photon"},
    }
)
"""Spelling of each unit in FITS 4.0, by its spelling in this program, for the units that FITS has."""
ASCII_SIGNS: Mapping[str, str] = FrozenMap(
    {"Δ": "d ", "σ": "sigma", "χ²": "chi2", "µ": "u", "\N{GREEK SMALL LETTER MU}": "u", "α": "alpha", "β": "beta"}
    | {"γ": "gamma", "°": "deg", "±": "+-", "×": "x", "\N{MINUS SIGN}": "-", "…": "..."}
)
"""Replacement of each sign used in reports where only ASCII is allowed."""


class MissingPackage(Exception):
    """Missing package of a file format; the message names it and how to install it."""


@dataclass(frozen=True, eq=False)
class DataColumn:
    """Column of a data table, with unit and description.

    Attributes
    ----------
    name : str
        Name of the column.
    values : (N,) ndarray
        Values as float64 (NaN is missing), int64, or texts (None is missing).
    unit : str
        Unit of the numbers as the program writes it; empty for pure numbers and texts.
    description : str
        Meaning of the values.
    """

    name: str
    values: np.ndarray
    unit: str
    description: str

    @classmethod
    def of(cls, name: str, values: Sequence[Any], unit: str, description: str) -> DataColumn:
        """Make a column from plain values: numbers (integers if all are) or texts; None is missing."""
        known = [value for value in values if value is not None]
        whole = bool(known) and all(isinstance(value, bool | int) for value in known)
        if whole and len(known) == len(values) and all(-(2**63) <= value < 2**63 for value in known):
            return cls(name, np.array(values, np.int64), unit, description)
        # float64 would change the digits of larger integers
        exact = not whole or all(abs(value) <= 2**53 for value in known)
        if known and exact and all(isinstance(value, bool | int | float) for value in known):
            numbers = [math.nan if value is None else float(value) for value in values]
            return cls(name, np.array(numbers, np.float64), unit, description)
        texts = np.array([None if value is None else str(value) for value in values], object)
        return cls(name, texts, "", description)

    @property
    def plain(self) -> list[Any]:
        """Values as plain data; None is missing."""
        values = self.values.tolist()
        return [None if isinstance(value, float) and math.isnan(value) else value for value in values]


@dataclass(frozen=True, eq=False)
class DataTable:
    """Table with units and descriptions of its columns, to be written in formats of other programs.

    Attributes
    ----------
    name : str
        Name of the table and of its file.
    title : str
        Title of the table.
    columns : tuple of DataColumn
        Columns of one length with different names.
    facts : mapping of str to str
        Further facts about the table, texts by name.
    """

    name: str
    title: str
    columns: tuple[DataColumn, ...]
    facts: Mapping[str, str] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Raise ValueError if lengths of columns differ or names repeat."""
        names = [column.name for column in self.columns]
        if len(set(names)) < len(names) or len({len(column.values) for column in self.columns}) != 1:
            raise ValueError(f"table {self.name!r}: columns must have the same length and different names")

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.columns[0].values)

    def column(self, name: str) -> DataColumn:
        """Return the column of that name.

        Raises
        ------
        KeyError
            No column has this name.
        """
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(name)


def _csv(table: DataTable) -> bytes:
    """Return a table as CSV, with units in the heads."""
    heads = [f"{column.name} [{column.unit}]" if column.unit else column.name for column in table.columns]
    return csv_table([heads, *zip(*(column.plain for column in table.columns), strict=True)])


def _parquet(table: DataTable) -> bytes:
    """Return a table as a Parquet file."""
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
    """Return the name and version of this program."""
    return f"{WRITER} {importlib.metadata.version(WRITER)}"


def ascii_text(text: str) -> str:
    """Return a text in the printable ASCII characters that FITS allows."""
    for sign, word in ASCII_SIGNS.items():
        text = text.replace(sign, word)
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "backslashreplace").decode()
    return "".join(letter if letter.isprintable() else " " for letter in plain)


def _fits(table: DataTable) -> bytes:
    """Return a table as a FITS file with one binary table."""
    # imported here, since this takes longer than for all other formats
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
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)  # about long texts, which are continued
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
"""Functions that write a table, by file extension of the format; they may raise MissingPackage. New formats are added
here.
"""
