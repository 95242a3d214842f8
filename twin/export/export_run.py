"""Export of a run folder to FITS and tables, and its report.

Recorded frames and expected images become FITS files whose headers name every quantity with its unit and have no WCS. A
file has the frames as one cube: columns, rows, frames. Row 0 of the CCD is the first row stored (NAXIS2 = 1), column 0
the first pixel in it: positions are those of docs/conventions.md. Grey values are unsigned 16-bit integers as recorded,
in FITS' usual encoding (BZERO 32768).
"""

from __future__ import annotations

import importlib.metadata
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import xarray as xr

from analysis.images.image_file import ImageFile
from scenes.specs.resolved import ResolvedJob, resolve
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.input_file import is_file, why_unreadable
from twin.export.result_tables import result_tables
from twin.framework.artefact import Cell, Table
from twin.framework.data_files import TABLE_FORMATS, WRITER, DataTable, MissingPackage, ascii_text, read_netcdf
from twin.framework.procedure import Advance
from twin.framework.report import Report, Section
from twin.framework.run_folder import Manifest, RunFolder, altered, finished_manifest

Card = tuple[str, str | int | float, str]
"""FITS header card: keyword, value, and comment with the unit in brackets."""
_SCALE, _TIE, _KEYS = 33550, 33922, 34735
_GEODETIC_3D = 4979
_CHECKED = "of the file as it was written"
_COORDINATE_KEYS = (
    "Row 0 is the first row stored (NAXIS2 = 1), column 0 the first pixel of",
    "a row; (0, 0) is the centre of the first pixel. No world coordinates.",
)


@dataclass(frozen=True, eq=False)
class RecordedFrames:
    """Content of a TIFF file of a run.

    Attributes
    ----------
    frames : (N, H, W) ndarray
        Grey values as recorded.
    pages : tuple[Mapping[str, Any], ...]
        Metadata of each page (``FrameFacts.page``).
    georeference : tuple[float, float, float, float] or None
        For a map, (longitude, latitude, per column, per row) of its first pixel's centre in degrees; else None.
    heights : bool
        Whether the values are heights in metres.
    """

    frames: np.ndarray
    pages: tuple[Mapping[str, Any], ...]
    georeference: tuple[float, float, float, float] | None = None
    heights: bool = False


def read_frames(path: Path) -> RecordedFrames:
    """Return the frames of a TIFF file that a run has written.

    Raises
    ------
    ValueError, KeyError
        The file is not one that a run writes.
    """
    with tifffile.TiffFile(path) as file:
        frames = np.stack([page.asarray() for page in file.pages])
        pages = tuple(json.loads(page.description) for page in file.pages)
        tags = {tag.code: tag.value for tag in file.pages[0].tags.values()}
    if frames.ndim != 3 or frames.dtype.kind not in "uif":
        raise ValueError(f"pages of {frames.dtype.name} with {frames.ndim - 1} axes are not recorded frames")
    if not all(isinstance(page, Mapping) for page in pages):
        raise ValueError("the description of a page is not that of a run's frame")
    if _SCALE not in tags:
        return RecordedFrames(frames, pages)
    across, down, _ = tags[_SCALE]
    _, _, _, longitude, latitude, _ = tags[_TIE]
    georeference = (longitude + 0.5 * across, latitude - 0.5 * down, across, -down)
    return RecordedFrames(frames, pages, georeference, tags[_KEYS][-1] == _GEODETIC_3D)


def run_cards(program: str, seed: int) -> list[Card]:
    """Return header cards that identify the run."""
    writer = f"{WRITER} {importlib.metadata.version(WRITER)}"
    return [
        ("CREATOR", writer, "program that wrote this file"),
        ("PROGRAM", program, "command that made the run"),
        ("SEED", seed, "of all random numbers"),
    ]


def detector_cards(job: ResolvedJob) -> list[Card]:
    """Return header cards of the monitor's area CCD, by its data sheet (EMVA 1288), and of its light."""
    detector, light = job.area_detector, job.instrument.autocollimator
    return [
        ("INSTRUME", ascii_text(job.instrument.name), "instrument"),
        ("DETECTOR", ascii_text(detector.name), "data sheet of the area CCD"),
        ("WAVELEN", light.wavelength, "[m] wavelength of the monitor's light"),
        ("GAIN", 1.0 / detector.system_gain_dn_per_e, "[electron/adu] 1 / K of EMVA 1288"),
        ("QE", detector.quantum_efficiency, "[electron/photon] quantum efficiency"),
        ("RDNOISE", detector.dark_noise_e, "[electron] temporal noise in the dark, rms"),
        ("DARKCUR", detector.dark_current_e_per_s, "[electron/s] mean dark current"),
        ("FULLWELL", detector.full_well_e, "[electron] saturation capacity"),
        ("SATURATE", detector.saturation_dn, "[adu] saturation level"),
        ("PEDESTAL", detector.offset_dn, "[adu] grey value without signal"),
        ("BITDEPTH", detector.bit_depth, "[bit] resolution of the converter"),
        ("PRNU", detector.prnu, "[1] relative response of pixels, rms"),
        ("DSNU", detector.dsnu_e, "[electron] dark signal of pixels, rms"),
    ]


def frames_fits(recorded: RecordedFrames, cards: Iterable[Card]) -> bytes:
    """Return a FITS file of recorded frames; equal frames give equal bytes.

    Parameters
    ----------
    recorded : RecordedFrames
        The frames.
    cards : iterable of Card
        Header cards in addition to those that the frames provide.
    """
    from astropy.io import fits

    first = recorded.pages[0]
    unit = fits.PrimaryHDU(recorded.frames)
    header: list[Card] = []
    if recorded.heights:
        header.append(("BUNIT", "m", "values are heights above the ellipsoid"))
    elif recorded.georeference is None:
        header.append(("BUNIT", "adu", "values are grey values (DN)"))
    header += [
        ("NFRAMES", len(recorded.frames), "frames in this file, along axis 3"),
        ("AXIS1", "column", "what axis 1 counts"),
        ("AXIS2", "row", "what axis 2 counts"),
        ("AXIS3", "frame", "what axis 3 counts"),
    ]
    if "camera" in first:
        header.append(("CAMERA", ascii_text(first["camera"]), "camera of the CCD"))
    if "note" in first:
        header.append(("NOTE", ascii_text(first["note"]), "remark on the frames"))
    if "pitch_um" in first:
        header.append(("XPIXSZ", first["pitch_um"], "[um] pixel pitch along a row"))
        header.append(("YPIXSZ", first["pitch_um"], "[um] pixel pitch along a column"))
    if "exposure_s" in first:
        header.append(("EXPTIME", first["exposure_s"], "[s] exposure of each frame"))
    if recorded.georeference is not None:
        longitude, latitude, across, down = recorded.georeference
        header += [
            ("LON0", longitude, "[deg] longitude of the first pixel's centre"),
            ("LAT0", latitude, "[deg] latitude of the first pixel's centre"),
            ("DLON", across, "[deg] step of longitude per column"),
            ("DLAT", down, "[deg] step of latitude per row"),
        ]
    _put_cards(unit, [*header, *cards])
    units = [unit]
    if "time_s" in first:
        units.append(_times("FRAMES", "frame", [page["time_s"] for page in recorded.pages]))
    return _bytes(units)


def expected_fits(data: xr.Dataset, cards: Sequence[Card]) -> bytes:
    """Return a FITS file of expected images, in photons per pixel and frame, with an extension per channel.

    Parameters
    ----------
    data : xr.Dataset
        Content of irradiance.nc or course.nc, (state or time, channel, row, column).
    cards : sequence of Card
        Cards of the primary header.
    """
    from astropy.io import fits

    primary = fits.PrimaryHDU()
    _put_cards(primary, list(cards))
    units: list[Any] = [primary]
    for name, variable in data.data_vars.items():
        first = str(variable.dims[0])
        for k, channel in enumerate(data["channel"].values):
            unit = fits.ImageHDU(variable.values[:, k])
            header: list[Card] = [
                ("EXTNAME", f"{channel} {name}", "channel and quantity"),
                ("BUNIT", "photon", "expected, per pixel and frame"),
                ("QUANTITY", ascii_text(str(variable.attrs["long_name"])), "what the values are"),
                ("AXIS1", "column", "what axis 1 counts"),
                ("AXIS2", "row", "what axis 2 counts"),
                ("AXIS3", first, "what axis 3 counts"),
                ("XPIXSZ", round(1e6 * float(data.attrs["pitch_m"]), 9), "[um] pixel pitch along a row"),
                ("YPIXSZ", round(1e6 * float(data.attrs["pitch_m"]), 9), "[um] pixel pitch along a column"),
            ]
            if first == "state":
                header += [(f"STATE{s}", str(state), f"plane {s}") for s, state in enumerate(data["state"].values, 1)]
            _put_cards(unit, header)
            units.append(unit)
    if "time" in data.coords:
        units.append(_times("TIMES", "plane", data["time"].values.tolist()))
    return _bytes(units)


def _times(name: str, counted: str, times: Sequence[float]) -> Any:
    """Return a FITS table of times in seconds, one for each frame or image plane of a cube.

    Parameters
    ----------
    name : str
        Name of the table.
    counted : str
        Name of its first column, which counts the frames or planes.
    times : sequence of float
        The times, in seconds.
    """
    from astropy.io import fits

    columns = [
        fits.Column(counted, "J", array=np.arange(1, len(times) + 1)),
        fits.Column("time", "D", "s", array=np.asarray(times, np.float64)),
    ]
    unit = fits.BinTableHDU.from_columns(columns, name=name)
    unit.header["TCOMM1"] = f"{counted} along axis 3"
    unit.header["TCOMM2"] = "since the beginning of the course"
    return unit


def _put_cards(unit: Any, cards: Sequence[Card]) -> None:
    """Write header cards into a FITS header-data unit, and for images also the pixel convention."""
    for keyword, value, about in cards:
        unit.header[keyword] = (value, about)
    if unit.data is not None:
        for line in _COORDINATE_KEYS:
            unit.header.add_comment(line)


def _bytes(units: Sequence[Any]) -> bytes:
    """Return the bytes of a FITS file made of these header-data units."""
    from astropy.io import fits

    for unit in units:
        # Replace astropy's comment, which is the time of day, so that equal data give equal bytes.
        unit.add_checksum(when=_CHECKED)
    out = io.BytesIO()
    fits.HDUList(list(units)).writeto(out)
    return out.getvalue()


KIND = "files"
NONE = "none"
FRAMES = ("fits", NONE)
"""Formats of exported frames: FITS, or none."""
EXPECTED = {"irradiance.nc": "expected_photons", "course.nc": "expected_photons_course"}
"""File of expected images in a run -> stem of the exported file."""
_IMAGES = "images/"


@dataclass(frozen=True)
class ExportedFile:
    """File that was written.

    Attributes
    ----------
    file : str
        Path in the export's folder.
    source : str
        File, or files, of the run from which it was made.
    what : str
        Description of its content.
    items : int
        Number of frames, or of rows of a table.
    bytes : int
        Size of the file.
    """

    file: str
    source: str
    what: str
    items: int
    bytes: int


@dataclass(frozen=True, eq=False)
class Exported:
    """All files that were written.

    Attributes
    ----------
    run : Path
        The run's folder.
    manifest : Manifest
        Manifest of the run.
    frames, tables : str
        Requested formats.
    files : tuple[ExportedFile, ...]
        Files that were written.
    described : tuple[DataTable, ...]
        The tables, for the descriptions of their columns.
    changed : tuple[str, ...]
        Files of the run that differ from their checksum in the manifest.
    """

    run: Path
    manifest: Manifest
    frames: str
    tables: str
    files: tuple[ExportedFile, ...]
    described: tuple[DataTable, ...]
    changed: tuple[str, ...]

    def numbers(self) -> dict[str, Any]:
        """Return the contents of files.json: the files written, with their columns and sources."""
        tables = {
            table.name: {entry.name: {"unit": entry.unit, "description": entry.description} for entry in table.columns}
            for table in self.described
        }
        return {
            "run": str(self.run),
            "of": self.manifest.kind,
            "frames": self.frames,
            "tables": self.tables,
            "files": [vars(entry) for entry in self.files],
            "columns": tables,
        }


def read_source(folder: Path) -> Manifest:
    """Return the manifest (list of files and settings) of a run folder after checking that its files exist.

    Raises
    ------
    InputError
        The folder is not a run folder, or files of it are missing.
    """
    manifest = finished_manifest(folder)
    missing = [name for name in manifest.sha256 if not is_file(folder / name)]
    if missing:
        raise InputError(*(Issue("file of the run is missing", str(folder / name)) for name in missing[:5]))
    return manifest


def export(source: Path, manifest: Manifest, frames: str, tables: str, folder: RunFolder, advance: Advance) -> Exported:
    """Write the frames and tables of a run that the user requested, in the requested formats.

    Parameters
    ----------
    source : Path
        The run's folder.
    manifest : Manifest
        Manifest of the run.
    frames : str
        Format of frames, one of ``FRAMES``.
    tables : str
        Format of tables, one of ``TABLE_FORMATS``, or none.
    folder : RunFolder
        Open folder to write into.
    advance : Advance
        Callback that shows the progress.

    Raises
    ------
    InputError
        The run has no frames or tables to export, a file of it cannot be read, or a package is missing.
    """
    changed = tuple(altered(source, manifest))
    files: list[ExportedFile] = []
    if frames != NONE:
        files += _frames(source, manifest, folder, advance)
    described: list[DataTable] = []
    if tables != NONE:
        with _reading_errors(source):
            described = result_tables(source, list(manifest.sha256))
        for k, table in enumerate(described):
            made_of = table.facts.get("file", "*.json")
            try:
                content = TABLE_FORMATS[tables](table)
            except MissingPackage as error:
                raise InputError(Issue(str(error), value=f"--tables {tables}", allowed="csv, fits")) from None
            files.append(_put(folder, f"tables/{table.name}.{tables}", content, made_of, table.title, table.rows))
            advance("tables", k + 1, len(described))
    if not files:
        raise InputError(Issue("this run has nothing to export", str(source), value=manifest.kind))
    return Exported(source, manifest, frames, tables, tuple(files), tuple(described), changed)


@contextmanager
def _reading_errors(path: Path) -> Iterator[None]:
    """Raise InputError for any failure to read a file of a run folder."""
    try:
        yield
    except InputError:
        raise
    # Readers of corrupted files fail with arbitrary exceptions.
    except Exception as error:
        problem = f"cannot be read as a file of a run: {why_unreadable(error)}"
        raise InputError(Issue(problem, str(path), allowed="the file as the run wrote it")) from None


def _put(folder: RunFolder, file: str, content: bytes, source: str, what: str, items: int) -> ExportedFile:
    """Write a file and return its entry."""
    folder.write_bytes(file, content)
    return ExportedFile(file, source, what, items, len(content))


def _frames(source: Path, manifest: Manifest, folder: RunFolder, advance: Advance) -> Iterator[ExportedFile]:
    """Write recorded frames, then expected images; every file of frames is read back and compared."""
    cards = run_cards(manifest.program, manifest.seed)
    detector = _detector(source, manifest)
    pictures = [name for name in manifest.sha256 if name.startswith(_IMAGES) and name.endswith(".tiff")]
    for k, name in enumerate(pictures):
        with _reading_errors(source / name):
            recorded = read_frames(source / name)
            camera_cards = detector if "area CCD" in str(recorded.pages[0].get("camera", "")) else []
            content = frames_fits(recorded, [*camera_cards, *cards])
        file = f"{name.removesuffix('.tiff')}.fits"
        yield _put(folder, file, content, name, _what(recorded.pages[0]), len(recorded.frames))
        real = recorded.frames.dtype.kind == "f"
        if not np.array_equal(ImageFile.open(folder.path / file).frames(), recorded.frames, equal_nan=real):
            raise RuntimeError(f"{file} does not contain the frames written to it")
        advance("frames", k + 1, len(pictures))
    for name, stem in EXPECTED.items():
        if name in manifest.sha256:
            with _reading_errors(source / name):
                data = read_netcdf((source / name).read_bytes())
                content = expected_fits(data, [*detector, *cards])
                items = int(np.prod(data["photons"].shape[:-2]))
            yield _put(folder, f"{stem}.fits", content, name, "expected photons per pixel and frame", items)


def _what(page: Mapping[str, Any]) -> str:
    """Return a description of frames, camera and note, from the metadata of a TIFF page."""
    return ", ".join(filter(None, (page.get("camera"), page.get("note")))) or "recorded frames"


def _detector(source: Path, manifest: Manifest) -> list[Card]:
    """Return FITS cards of the monitor's area CCDs if the run is a job with a monitor, else an empty list."""
    config = source / "config.yaml"
    if manifest.program != "twin.render" or "config.yaml" not in manifest.sha256:
        return []
    job = resolve(config)
    return [] if job.instrument.monitor is None else detector_cards(job)


def export_report(done: Exported) -> Report:
    """Return the report: the files written, and the descriptions of the tables' columns."""
    images = [item for item in done.files if not item.file.startswith("tables/")]
    tables = [item for item in done.files if item.file.startswith("tables/")]
    parts = []
    if images:
        count = sum(item.items for item in images)
        parts.append(f"{len(images)} files with {count} images as {done.frames.upper()}, identical when read back")
    if tables:
        kind = {"parquet": "Parquet"}.get(done.tables, done.tables.upper())
        parts.append(f"{len(tables)} tables with {sum(item.items for item in tables)} rows as {kind}")
    rows: list[list[Cell]] = [[item.file, item.source, item.what, item.items, 1e-3 * item.bytes] for item in done.files]
    heads = ("file", "source", "content", "images or rows", "size [kB]")
    columns: list[list[Cell]] = [
        [table.name, column.name, column.unit, column.description]
        for table in done.described
        for column in table.columns
    ]
    sections = []
    if columns:
        column_table = Table(
            "columns", "Columns of the tables", "As in the files.", ("table", "column", "unit", "description"), columns
        )
        sections.append(Section("Columns", (), (column_table,), folded=1))
    warnings = [
        f"{name} has changed since its run: its checksum differs from that in the manifest" for name in done.changed
    ]
    return Report(
        title=f"Export of {done.run}",
        verdict=f"Exported the run of {done.manifest.kind} in {done.run}: {'; '.join(parts)}.",
        lead=(),
        facts=(
            ("run", str(done.run)),
            ("command", done.manifest.kind),
            ("frames", done.frames),
            ("tables", done.tables),
        ),
        summary=Table(
            "files", "Files", "Files of the export, and their sources in the run.", heads, rows, (None,) * 4 + (1,)
        ),
        sections=tuple(sections),
        warnings=tuple(warnings),
    )
