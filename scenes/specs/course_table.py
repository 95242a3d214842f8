"""A course from a CSV file: one row for each time, heads that name node, quantity, axis and unit."""

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes.specs.course import CourseSpec
from scenes.specs.job import JobSpec, pivot_problem
from scenes.yaml.csv_table import table_text
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown
from scenes.yaml.input_file import is_file, unusable
from scenes.yaml.spec import validate
from scenes.yaml.units import (
    ANGLE,
    LENGTH,
    MOMENT,
    SCALE,
    TEMPERATURE_DIFFERENCE,
    TEMPERATURE_GRADIENT,
    Kind,
    parse_quantity,
)
from scenes.yaml.yaml_file import LARGEST_BYTES, YamlFile

TIME = "time"
AXES = ("x", "y", "z")
VECTORS = {"rotate": ANGLE, "shift": LENGTH, "gradient": TEMPERATURE_GRADIENT}
"""What has a column for each axis; axes without one are zero."""
NUMBERS = {"scale": SCALE, "temperature": TEMPERATURE_DIFFERENCE}
HEAT = {"temperature": "change", "gradient": "gradient"}
"""Name in a head -> key under ``temperature``; the others stand under ``motion``."""
HEADS = "'time [min]', 'NODE shift z [um]', 'NODE rotate x [arcsec]', 'NODE scale [ppm]', 'NODE temperature [K]' or "
HEADS += "'NODE gradient x [mK/m]'"

_HEAD = re.compile(r"(?:(?P<node>\S+) +)?(?P<what>[a-z]+)(?: +(?P<axis>[a-z]))? *\[(?P<unit>[^\[\]]+)\]")


@dataclass(frozen=True)
class _Column:
    """What a column holds.

    Attributes:
        what: TIME, or a name of VECTORS or NUMBERS.
        node: its path, empty for the time.
        axis: 0 to 2 of a vector.
        unit: of its numbers.
    """

    what: str
    node: str
    axis: int
    unit: str

    @property
    def place(self) -> KeyPath:
        """In the course, without the number of the time."""
        if self.what == TIME:
            return ("times",)
        return ("temperature", self.node, HEAT[self.what]) if self.what in HEAT else ("motion", self.node, self.what)


def with_table(job: JobSpec) -> JobSpec:
    """The job with the times, temperatures and motions of its course's table, which is then no longer named.

    Raises:
        InputError: the table cannot be read, with its line.
    """
    if job.course is None or job.course.table is None:
        return job
    path = Path(job.source.file).parent / job.course.table
    if not is_file(path):
        raise job.course.error(unusable(path), ("table",), allowed="a CSV file, relative to this file")
    course = _read(path, job.course)
    problem = pivot_problem(job.perturb, course)
    if problem is not None:
        raise job.course.error(problem.problem, problem.within, found=problem.found, allowed=problem.allowed)
    return job.model_copy(update={"course": course})


def _read(path: Path, named: CourseSpec) -> CourseSpec:
    """The course that a table holds, with the detail and the pivots of the course that names it."""
    file, rows = str(path), list(_rows(path))
    if len(rows) < 2:
        line = rows[0][0] if rows else 1
        raise InputError(Issue("a table has a row of heads and a row for each time", file, line, allowed=HEADS))
    (head_line, heads), body = rows[0], rows[1:]
    columns = [_column(head, file, head_line) for head in heads]
    places = [(*column.place, column.axis) for column in columns]
    twice = next((head for k, head in enumerate(heads) if places[k] in places[:k]), None)
    if twice is not None:
        raise InputError(Issue("another column holds the same", file, head_line, (twice.strip(),)))
    if TIME not in [column.what for column in columns]:
        raise InputError(
            Issue("no column has the times", file, head_line, found=names_text(heads), allowed="time [min]")
        )
    data: dict[str, Any] = {"times": [None] * len(body), "temperature": {}, "motion": {}}
    lines: dict[KeyPath, int] = {(): head_line, ("temperature",): head_line, ("motion",): head_line}
    for k, (line, cells) in enumerate(body):
        if len(cells) != len(columns):
            text = f"{len(cells)} cells under {len(columns)} heads"
            raise InputError(Issue(text, file, line, allowed="as many cells as heads, with commas between them"))
        for column, cell in zip(columns, cells, strict=True):
            _put(data, lines, column, k, f"{cell.strip()} {column.unit}", (line, len(body)))
            lines.setdefault(column.place[:2], head_line)
    for node, moves in named.motion.items():
        if node not in data["motion"]:
            known = names_text(data["motion"]) or "nothing"
            meant = nearest(node, data["motion"])
            raise named.error("the table does not move this node", ("motion", node), allowed=known, suggestion=meant)
        data["motion"][node]["pivot"] = moves.pivot
    if named.detail is not None:
        data["detail"] = named.plain()["detail"]
    return validate(CourseSpec, YamlFile(file, {key: value for key, value in data.items() if value}, lines))


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line, counted from 1, and cells; empty lines and those that begin with # are left out."""
    reader = csv.reader(io.StringIO(table_text(path, most=LARGEST_BYTES), newline=""))
    try:
        for row in reader:
            if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#"):
                yield reader.line_num, row
    except csv.Error as error:
        raise InputError(Issue(f"not a CSV file: {error}", str(path), reader.line_num)) from None


def _column(head: str, file: str, line: int) -> _Column:
    """InputError for a head that says nothing known."""
    match = _HEAD.fullmatch(head.strip())
    if match is None:
        raise InputError(Issue("not the head of a column", file, line, found=shown(head.strip()), allowed=HEADS))
    what, node, axis = match["what"], match["node"] or "", match["axis"]
    known = (*VECTORS, *NUMBERS) if node else (TIME,)
    if what not in known:
        meant = nearest(what, known)
        issue = Issue("no such quantity", file, line, (head.strip(),), shown(what), names_text(known), meant)
        raise InputError(issue)
    if (axis in AXES) is not (what in VECTORS):
        allowed = "an axis: x, y or z" if what in VECTORS else "no axis"
        raise InputError(Issue(f"a column of {what} has {allowed}", file, line, (head.strip(),), allowed=HEADS))
    kind: Kind = MOMENT if what == TIME else (VECTORS | NUMBERS)[what]
    try:
        parse_quantity(f"0 {match['unit'].strip()}", kind)
    except Problem as problem:
        allowed = names_text(kind.units)
        issue = Issue(problem.problem, file, line, (head.strip(),), problem.found, allowed, problem.suggestion)
        raise InputError(issue) from None
    return _Column(what, node, AXES.index(axis) if axis else 0, match["unit"].strip())


def _put(
    data: dict[str, Any], lines: dict[KeyPath, int], column: _Column, k: int, text: str, where: tuple[int, int]
) -> None:
    """Put a cell at its place in the plain data of a course."""
    line, count = where
    if column.what == TIME:
        data["times"][k] = text
        lines["times", k] = line
        return
    section, node, name = (str(part) for part in column.place)
    values = data[section].setdefault(node, {}).setdefault(name, [None] * count)
    if column.what in VECTORS:
        values[k] = values[k] or ["0 " + VECTORS[column.what].si] * len(AXES)
        values[k][column.axis] = text
        lines[section, node, name, k, column.axis] = line
    else:
        values[k] = text
    lines[section, node, name, k] = line
