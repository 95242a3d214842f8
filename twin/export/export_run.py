"""What is exported of a run folder, and the report of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analysis.images.image_file import ImageFile
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.input_file import is_file, why_unreadable
from twin.export.fits_frames import Card, detector_cards, expected_fits, frames_fits, read_frames, run_cards
from twin.export.result_tables import result_tables
from twin.run.artefact import Cell, Table
from twin.run.data_files import TABLE_FORMATS, DataTable, MissingPackage, read_netcdf
from twin.run.owned_files import MANIFEST
from twin.run.procedure import Advance
from twin.run.report import Report, Section
from twin.run.run_folder import Manifest, RunFolder, altered, read_manifest

KIND = "files"
NONE = "none"
FRAMES = ("fits", NONE)
"""What may become of frames."""
EXPECTED = {"irradiance.nc": "expected_photons", "course.nc": "expected_photons_course"}
"""Expected images of a run -> name of their file."""
_IMAGES = "images/"


@dataclass(frozen=True)
class ExportedFile:
    """A file that was written.

    Attributes:
        file: in the export's folder.
        source: file, or files, of the run that it was made of.
        what: is in it.
        items: frames of images, rows of a table.
        bytes: its size.
    """

    file: str
    source: str
    what: str
    items: int
    bytes: int


@dataclass(frozen=True, eq=False)
class Exported:
    """All that was written.

    Attributes:
        run: the run's folder.
        manifest: of the run.
        frames, tables: formats that were asked for.
        files: that were written.
        described: the tables, for what their columns say.
        changed: files of the run that are not as their manifest says.
    """

    run: Path
    manifest: Manifest
    frames: str
    tables: str
    files: tuple[ExportedFile, ...]
    described: tuple[DataTable, ...]
    changed: tuple[str, ...]

    @property
    def kind(self) -> str:
        """Kind of the run."""
        return " ".join(filter(None, (self.manifest.program, self.manifest.test)))

    def numbers(self) -> dict[str, Any]:
        """Contents of files.json."""
        tables = {
            table.name: {
                column.name: {"unit": column.unit, "description": column.description} for column in table.columns
            }
            for table in self.described
        }
        return {
            "run": str(self.run),
            "of": self.kind,
            "frames": self.frames,
            "tables": self.tables,
            "files": [vars(one) for one in self.files],
            "columns": tables,
        }


def read_source(folder: Path) -> Manifest:
    """The manifest of a run folder, all files of which are there.

    Raises:
        InputError: no run folder, or files of it are missing.
    """
    manifest = read_manifest(folder)
    if manifest is None:
        problem = "no such folder" if not folder.is_dir() else f"not a run folder: it has no {MANIFEST} of a run"
        raise InputError(Issue(problem, str(folder), allowed="a folder that a command of the twin has written"))
    missing = [name for name in manifest.sha256 if not is_file(folder / name)]
    if missing:
        raise InputError(*(Issue("file of the run is missing", str(folder / name)) for name in missing[:5]))
    return manifest


def export(source: Path, manifest: Manifest, frames: str, tables: str, folder: RunFolder, advance: Advance) -> Exported:
    """Write everything that is asked for.

    Args:
        source: the run's folder.
        manifest: of it.
        frames: one of ``FRAMES``.
        tables: of ``TABLE_FORMATS``, or none.
        folder: open.
        advance: shows how far it is.

    Raises:
        InputError: the run has nothing of what is asked for, a file of it cannot be read, or a package is missing.
    """
    changed = tuple(altered(source, manifest))
    files: list[ExportedFile] = []
    if frames != NONE:
        files += _frames(source, manifest, folder, advance)
    described: list[DataTable] = []
    if tables != NONE:
        with _told(source):
            described = result_tables(source, list(manifest.sha256))
        for k, table in enumerate(described):
            try:
                content = TABLE_FORMATS[tables](table)
            except MissingPackage as error:
                raise InputError(Issue(str(error), found=f"--tables {tables}", allowed="csv, fits")) from None
            files.append(
                _put(folder, f"tables/{table.name}.{tables}", content, _source_of(table), table.title, table.rows)
            )
            advance("tables", k + 1, len(described))
    if not files:
        kind = " ".join(filter(None, (manifest.program, manifest.test)))
        raise InputError(Issue("nothing to export of this run", str(source), found=kind))
    return Exported(source, manifest, frames, tables, tuple(files), tuple(described), changed)


@contextmanager
def _told(place: Path) -> Iterator[None]:
    """What cannot be read in a run folder is bad input."""
    try:
        yield
    except InputError:
        raise
    # readers of spoilt files fail in ways that cannot be foreseen
    except Exception as error:
        problem = f"cannot be read as a file of a run: {why_unreadable(error)}"
        raise InputError(Issue(problem, str(place), allowed="the file as the run wrote it")) from None


def _source_of(table: DataTable) -> str:
    return table.facts.get("file", "*.json")


def _put(folder: RunFolder, file: str, content: bytes, source: str, what: str, items: int) -> ExportedFile:
    folder.write_bytes(file, content)
    return ExportedFile(file, source, what, items, len(content))


def _frames(source: Path, manifest: Manifest, folder: RunFolder, advance: Advance) -> Iterator[ExportedFile]:
    """Recorded frames, then expected images; every file of frames is read back and compared."""
    cards = run_cards(manifest.program, manifest.seed)
    about = _detector(source, manifest)
    pictures = [name for name in manifest.sha256 if name.startswith(_IMAGES) and name.endswith(".tiff")]
    for k, name in enumerate(pictures):
        with _told(source / name):
            recorded = read_frames(source / name)
            known = about if "area CCD" in str(recorded.pages[0].get("camera", "")) else []
            content = frames_fits(recorded, [*known, *cards])
        file = f"{name.removesuffix('.tiff')}.fits"
        yield _put(folder, file, content, name, _what(recorded.pages[0]), len(recorded.frames))
        real = recorded.frames.dtype.kind == "f"
        if not np.array_equal(ImageFile.open(folder.path / file).frames(), recorded.frames, equal_nan=real):
            raise RuntimeError(f"{file} does not hold what was put into it")
        advance("frames", k + 1, len(pictures))
    for name, stem in EXPECTED.items():
        if name in manifest.sha256:
            with _told(source / name):
                data = read_netcdf((source / name).read_bytes())
                content = expected_fits(data, [*about, *cards])
                items = int(np.prod(data["photons"].shape[:-2]))
            yield _put(folder, f"{stem}.fits", content, name, "expected photons per pixel and frame", items)


def _what(page: Mapping[str, Any]) -> str:
    return ", ".join(filter(None, (page.get("camera"), page.get("note")))) or "recorded frames"


def _detector(source: Path, manifest: Manifest) -> list[Card]:
    """FITS cards of the monitor's area CCDs, if the run is a job of the monitor."""
    config = source / "config.yaml"
    if manifest.program != "twin.render" or "config.yaml" not in manifest.sha256:
        return []
    job = resolve(config)
    return [] if job.instrument.monitor is None else detector_cards(job)


def export_report(done: Exported) -> Report:
    """What was written, and what the tables' columns say."""
    images = [one for one in done.files if not one.file.startswith("tables/")]
    tables = [one for one in done.files if one.file.startswith("tables/")]
    said = []
    if images:
        count = sum(one.items for one in images)
        said.append(
            f"{len(images)} files with {count} images as {done.frames.upper()}, read back and the same to the bit"
        )
    if tables:
        said.append(f"{len(tables)} tables with {sum(one.items for one in tables)} rows as {_spelt(done.tables)}")
    rows: list[list[Cell]] = [[one.file, one.source, one.what, one.items, 1e-3 * one.bytes] for one in done.files]
    heads = ("file", "of", "what", "images or rows", "size [kB]")
    columns: list[list[Cell]] = [
        [table.name, column.name, column.unit, column.description]
        for table in done.described
        for column in table.columns
    ]
    sections = []
    if columns:
        told = Table(
            "columns", "Columns of the tables", "As the files say.", ("table", "column", "unit", "holds"), columns
        )
        sections.append(Section("Columns", (), (told,), folded=1))
    warnings = [
        f"{name} is not as its run wrote it: it has another checksum than the manifest says" for name in done.changed
    ]
    return Report(
        title=f"Files of {done.run}",
        verdict=f"Of the run of {done.kind} in {done.run}: {'; '.join(said)}.",
        lead=(),
        facts=(("run", str(done.run)), ("command", done.kind), ("frames", done.frames), ("tables", done.tables)),
        summary=Table(
            "files", "Files", "Of the export, and what of the run each was made of.", heads, rows, (None,) * 4 + (1,)
        ),
        sections=tuple(sections),
        warnings=tuple(warnings),
    )


def _spelt(ending: str) -> str:
    return {"parquet": "Parquet"}.get(ending, ending.upper())
