"""Tables of a run's results, every column with its unit and description.

They are spot positions, estimated and true changes of each camera, matched points, every number of the JSON files, and
every table that the run itself stores as CSV.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py

from analysis.monitor import parameters
from optics.numerics.number_tree import FrozenMap
from scenes.specs.study import unit_of
from scenes.yaml.input_file import read_json
from twin.framework.data_files import DataColumn, DataTable
from twin.framework.durable import MANIFEST

POINTS = "artefacts/points.csv"
NUMBERS = "numbers"
"""Name of the exported table that lists every number of the run's JSON files."""
_HEADS = ("schema", "reference_frames")
_OTHER_FILES = (MANIFEST,)
_HEAD = re.compile(r"(?P<name>.*?)\s*\[(?P<unit>[^\[\]]+)\]")


@dataclass(frozen=True)
class Nested:
    """Table within a JSON file: nested mappings by name, with numbers at the innermost level.

    Attributes
    ----------
    name : str
        Name of the table.
    file : str
        File of the run folder.
    key : str
        Key at which the mappings begin.
    levels : tuple[str, ...]
        Meaning of the names of each mapping.
    title : str
        Title of the table.
    """

    name: str
    file: str
    key: str
    levels: tuple[str, ...]
    title: str


NESTED = (
    Nested("spots", "recovered.json", "spots", ("camera", "channel", "state"), "Centres of the spots in the frames"),
    Nested("readings", "recovered.json", "cameras", ("camera", "estimator"), "Readings of each camera by estimator"),
    Nested(
        "angle_readings",
        "recovered.json",
        "intersection_angle",
        ("estimator",),
        "Readings of the angle between two cameras by estimator",
    ),
    Nested(
        "ground_readings", "recovered.json", "ground", ("estimator",), "Readings of errors on the ground by estimator"
    ),
    Nested("true_changes", "truth.json", "cameras", ("camera",), "True changes of the cameras, by the exact trace"),
)
"""Tables within JSON files of runs; new ones are added here."""

DESCRIPTIONS: Mapping[str, tuple[str, str]] = FrozenMap(
    {
        "camera": ("", "name of the camera in the instrument"),
        "channel": ("", "end of the line at which the area CCD is: left is +Y of the focal plane"),
        "state": ("", "before the disturbance or after it"),
        "estimator": ("", "estimator of the reading"),
        "row": ("px", "row of the spot's centre on the area CCD; 0 is the centre of the first"),
        "column": ("px", "column of the spot's centre on the area CCD; 0 is the centre of the first"),
        "row_sigma": ("px", "standard deviation of row"),
        "column_sigma": ("px", "standard deviation of column"),
        "reduced_chi_square": ("", "reduced chi-square of the fit of the spot's shape to all pixels; 1 as calibrated"),
        "core_chi_square": ("", "reduced chi-square of the same fit over the pixels of the spot's core"),
        "sigma_widened": ("", "factor by which the fit widened the standard deviations; 1 for a spot that fits"),
        "principal_distance_mm": ("mm", "principal distance of the nominal camera"),
        "left_plan_rms_m": ("m", "rms error in plan that remains after correction by the reading"),
        "left_height_rms_m": ("m", "rms error in height that remains after correction by the reading"),
        "sort": ("", "kind of the point: control point by the map, or tie point between the lines"),
        "point": ("", "number of the point within its kind"),
        "line_name": ("", "line CCD whose image contains the point"),
        "longitude_deg": ("deg", "longitude of the ground point on WGS 84, east positive"),
        "latitude_deg": ("deg", "geodetic latitude of the ground point on WGS 84"),
        "x_itrs_m": ("m", "X of the ground point, ITRS"),
        "y_itrs_m": ("m", "Y of the ground point, ITRS"),
        "z_itrs_m": ("m", "Z of the ground point, ITRS"),
        "predicted_line": ("px", "line of the point, predicted by camera and platform"),
        "predicted_pixel": ("px", "pixel of the point, predicted by camera and platform"),
        "line": (
            "px",
            "measured line of the point; 0 is the centre of the pass's first line, an image file may begin later",
        ),
        "pixel": ("px", "measured pixel of the line CCD; 0 is the centre of the first pixel"),
        "line_sigma": ("px", "standard deviation of line"),
        "pixel_sigma": ("px", "standard deviation of pixel"),
        "correlation_of_sigmas": ("", "correlation of the errors of line and pixel"),
        "template_correlation": ("", "correlation of the two windows after matching"),
        "accepted": ("", "1 for a point that is matched and consistent with the others"),
        "status": ("", "reason of a rejection; empty for an accepted point"),
    }
)
"""Column -> unit and description, in addition to those of `analysis.monitor.parameters`; other columns have both in
their names.
"""
TITLES: Mapping[str, str] = FrozenMap({POINTS: "Points measured in the images", "study.csv": "Every run of the study"})
"""File of a table that the run stores as CSV -> title of the exported table; other tables are titled by their file."""
_POINT_HEIGHT = ("m", "height of the ground point above the ellipsoid of WGS 84")
_SIGMAS = {
    "_sigma": "standard deviation of {}, from noise and the disturbance prior",
    "_sigma_noise": "standard deviation of {}, from the noise of the images alone",
}


def result_tables(folder: Path, files: Sequence[str]) -> list[DataTable]:
    """Return all tables of a run.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    files : sequence of str
        Its files, relative to it, as its manifest lists them.

    Raises
    ------
    InputError
        A JSON file cannot be read.
    ValueError
        A JSON or CSV file is not one that runs write.
    """
    json_files = [name for name in files if name.endswith(".json") and name not in _OTHER_FILES]
    data = {name: read_json(folder / name) for name in json_files}
    tables = [numbers] if (numbers := _numbers(data)) is not None else []
    tables += [table for nested in NESTED if (table := _nested(nested, data.get(nested.file, {}))) is not None]
    used = {table.name for table in tables}
    for name in files:
        if name.endswith(".csv"):
            stem = Path(name).stem
            label = stem if stem not in used else f"{stem}_table"
            used.add(label)
            table = _kept(label, name, (folder / name).read_text("utf-8"), _described_columns(folder, name, files))
            tables += [table] if table is not None else []
    return tables


def _frames_of(data: Any) -> dict[str, str]:
    """Return the reference frames of quantities, by "frame of QUANTITY", as a JSON file lists them for its numbers."""
    frames = data.get("reference_frames", {}) if isinstance(data, Mapping) else {}
    return {f"frame of {quantity}": str(text) for quantity, text in frames.items()}


# --- numbers ---------------------------------------------------------------------------------------------


def _numbers(data: Mapping[str, Any]) -> DataTable | None:
    """Return a table of every number and text of the JSON files: file, key, value, sigma, unit and text."""
    rows: list[tuple[str, str, float | None, float | None, str, str | None]] = []
    for file, content in data.items():
        for key, sigma, value in _leaves(content):
            key_parts = tuple(part for part in re.split(r"[.\[\]]", key) if part and not part.isdigit())
            number = float(value) if isinstance(value, bool | int | float) else None
            text = None if isinstance(value, int | float) and not isinstance(value, bool) else json.dumps(value)
            text = value if isinstance(value, str) else text
            rows.append((file, key, number, sigma, unit_of(key_parts[-2:]) if number is not None else "", text))
    if not rows:
        return None
    names = ("file", "key", "value", "sigma", "unit", "text")
    descriptions = (
        "file of the run folder",
        "path of keys in the file, outermost first; [k] is item k of a list",
        "number, in the unit of its row; 1 for true, 0 for false",
        "standard deviation that the file states beside it (key_sigma), in the same unit",
        "unit of the number, from its key; empty for dimensionless numbers",
        "texts, true, false and null",
    )
    columns = zip(names, zip(*rows, strict=True), descriptions, strict=True)
    return DataTable(
        NUMBERS,
        "Every number of the run's JSON files",
        tuple(_typed(name, list(values), about, name in ("value", "sigma")) for name, values, about in columns),
    )


def _typed(name: str, values: list[Any], about: str, numbers: bool) -> DataColumn:
    """Return a table column from cells; empty cells of a column of numbers become NaN."""
    if numbers and all(value is None for value in values):
        values = [float("nan")] * len(values)
    return DataColumn.of(name, values, "", about)


def _leaves(data: Any, key: str = "") -> Iterator[tuple[str, float | None, Any]]:
    """Yield (key, sigma, value) of every number or text in nested data.

    A sigma stored beside its number is yielded with it and not on its own.
    """
    if isinstance(data, Mapping):
        for name, value in data.items():
            number = name.removesuffix("_sigma")
            beside = number != name and _is_number(data.get(number)) and _is_number(value)
            if (key or name not in _HEADS) and not beside:
                sigma: Any = data.get(f"{name}_sigma")
                below = f"{key}.{name}" if key else str(name)
                if _is_number(value):
                    yield below, float(sigma) if _is_number(sigma) else None, value
                else:
                    yield from _leaves(value, below)
    elif isinstance(data, list):
        for k, value in enumerate(data):
            yield from _leaves(value, f"{key}[{k}]")
    else:
        yield key, None, data


def _is_number(value: Any) -> bool:
    """Return True for a number that is not a bool."""
    return isinstance(value, int | float) and not isinstance(value, bool)


# --- tables within a file --------------------------------------------------------------------------------


def _nested(nested: Nested, content: Mapping[str, Any]) -> DataTable | None:
    """Return a table within a JSON file; None if it is empty."""
    rows = list(_rows(content.get(nested.key), len(nested.levels)))
    if not rows:
        return None
    names = list(dict.fromkeys(name for _, values_of_row in rows for name in values_of_row))
    columns = [_column(level, [path[k] for path, _ in rows]) for k, level in enumerate(nested.levels)]
    columns += [_column(name, [values_of_row.get(name) for _, values_of_row in rows]) for name in names]
    return DataTable(nested.name, nested.title, tuple(columns), {"file": nested.file, **_frames_of(content)})


def _rows(data: Any, depth: int, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    """Yield (names of the enclosing levels, numbers) of each innermost mapping in nested data."""
    if not isinstance(data, Mapping):
        return
    if depth == 0:
        yield above, {name: value for name, value in data.items() if not isinstance(value, Mapping | list)}
        return
    for name, below in data.items():
        yield from _rows(below, depth - 1, (*above, str(name)))


def _column(name: str, values: Sequence[Any], named: Mapping[str, str] = FrozenMap()) -> DataColumn:
    """Return a column with the unit and the description of its name."""
    head = _HEAD.fullmatch(name)
    stem, unit = (head["name"], head["unit"]) if head is not None else (name, "")
    if stem in named:
        return DataColumn.of(stem, values, unit, named[stem])
    listed = (*parameters.CAMERA_PARAMETERS.values(), parameters.ANGLE, *parameters.GROUND)
    known = {**DESCRIPTIONS, **{quantity.key: (quantity.file_unit, quantity.meaning) for quantity in listed}}
    if stem in known and not unit:
        return DataColumn.of(stem, values, *known[stem])
    for ending, text in _SIGMAS.items():
        base = stem.removesuffix(ending)
        if base != stem and base in known:
            return DataColumn.of(stem, values, known[base][0], text.format(base))
    return DataColumn.of(stem, values, unit or unit_of((stem,)), f"column {stem!r} of the run's own table")


# --- tables that the run keeps ---------------------------------------------------------------------------


def _kept(name: str, file: str, text: str, named: Mapping[str, str]) -> DataTable | None:
    """Return the table that a run stored as a CSV file, with units and descriptions; None if it has no rows."""
    heads, *rows = list(csv.reader(io.StringIO(text))) or [[]]
    if not rows:
        return None
    if any(len(row) != len(heads) for row in rows):
        raise ValueError(f"{file} has rows of different lengths")
    columns: list[DataColumn] = []
    for k, head in enumerate(heads):
        column = _column(head, _cells([row[k] for row in rows]), named)
        if file == POINTS and head == "height_m":
            column = DataColumn.of(head, column.plain, *_POINT_HEIGHT)
        columns.append(replace(column, name=_free(column.name, [other.name for other in columns])))
    return DataTable(name, TITLES.get(file, f"{file} of the run"), tuple(columns), {"file": file})


def _free(name: str, taken: Sequence[str]) -> str:
    """Return a table name that is not in ``taken``: the name itself, or with a number appended."""
    names = (name, *(f"{name} ({k})" for k in range(2, len(taken) + 2)))
    return next(candidate for candidate in names if candidate not in taken)


def _cells(cells: Sequence[str]) -> list[Any]:
    """Return cells as whole numbers or numbers if all of them are, else as texts; an empty cell is None."""
    for sort in (int, float):
        try:
            return [None if cell == "" else sort(cell) for cell in cells]
        except ValueError:
            continue
    return [cell or None for cell in cells]


def _described_columns(folder: Path, name: str, files: Sequence[str]) -> dict[str, str]:
    """Return the descriptions of columns from a netCDF file with the same table, if there is one."""
    beside = f"{name.removesuffix('.csv')}.nc"
    if beside not in files:
        return {}
    with h5py.File(folder / beside) as data:
        return {column: str(data[column].attrs["long_name"]) for column in data if "long_name" in data[column].attrs}
