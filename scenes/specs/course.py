"""Course of a job: temperatures and motions of an instrument over time, from the job's file or a CSV table."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from optics.geometry.tree import Motion
from optics.geometry.zernike import MAX_NOLL
from optics.numerics.array_math import index_of_value
from optics.numerics.number_tree import FrozenMap
from optics.thermal.heat import Temperature
from scenes.yaml import units
from scenes.yaml.csv_table import rows_of
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, shown, unknown
from scenes.yaml.spec import ZERO_IS_NONE, Name, Paths, Reference, Spec, validate
from scenes.yaml.unit_fields import Quantity, Vector
from scenes.yaml.yaml_file import LARGEST_BYTES, YamlFile

TemperatureChange = Annotated[float, Quantity(units.TEMPERATURE_DIFFERENCE, largest="1000 K", unsigned="100 K")]
"""Temperature change, in kelvin. No change of more than 100 K occurs in an instrument at work, so that 250 K without a
sign is probably an absolute temperature.
"""
TemperatureGradient = Annotated[
    tuple[float, float, float], Vector(Quantity(units.TEMPERATURE_GRADIENT, largest="1000 K/m"))
]
Rotation = Annotated[tuple[float, float, float], Vector(Quantity(units.ANGLE, largest="5 deg"))]
Shift = Annotated[tuple[float, float, float], Vector(Quantity(units.LENGTH, largest="100 mm"))]
ScaleChange = Annotated[float, Quantity(units.SCALE, largest="1 percent")]
RadiusChange = Annotated[float, Quantity(units.SCALE, largest="10 percent"), ZERO_IS_NONE]
ConicChange = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1.0, le=1.0), ZERO_IS_NONE]
IndexChange = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-0.1, le=0.1), ZERO_IS_NONE]
AbbeChange = Annotated[float, Quantity(units.SCALE, largest="50 percent"), ZERO_IS_NONE]
_TERM = re.compile(r"Z([1-9][0-9]{0,3})")


def noll(term: str) -> int:
    """Return the Noll index of a figure term: 5 for "Z5".

    Raises
    ------
    Problem
        The term is not one of Z1 .. Z66.
    """
    match = _TERM.fullmatch(term)
    if match is None or int(match[1]) > MAX_NOLL:
        raise Problem("not a Zernike term", shown(term), f"Z1 .. Z{MAX_NOLL} (Noll's numbering)")
    return int(match[1])


def _is_term(term: str) -> str:
    noll(term)
    return term


Term = Annotated[str, AfterValidator(_is_term), WithJsonSchema({"type": "string", "pattern": f"^{_TERM.pattern}$"})]
Moment = Annotated[float, Quantity(units.MOMENT, largest="100000 h")]

NO_MOTION: tuple[float, float, float] = (0.0, 0.0, 0.0)
DEFAULT_PIVOT = "origin"
FEWEST, MOST = 2, 1000
"""Smallest and largest number of times that a course (time series of states) may have."""


def _check_count(times: tuple[float, ...]) -> tuple[float, ...]:
    if not FEWEST <= len(times) <= MOST:
        raise Problem("wrong number of times in a course", f"{len(times)} of them", f"{FEWEST} to {MOST} times")
    return times


def ascending(times: tuple[float, ...]) -> tuple[float, ...]:
    """Return the times, in seconds; raise `Problem` if one of them is not later than the one before it."""
    for k, (before, after) in enumerate(pairwise(times), 1):
        if not after > before:
            raise Problem("the times do not ascend", moment(after), f"a time after {moment(before)}", within=(k,))
    return times


def moment(time: float) -> str:
    """Return a time of a course as its file would write it: "12 min" for 720 s."""
    return units.format_quantity(time, units.MOMENT)


def no_such_time(time: float, times: Sequence[float], allowed: str) -> Problem:
    """Return the problem of a time, in seconds, that is not one of the times of a course."""
    near = min(times, key=lambda candidate: abs(candidate - time))
    return Problem("not one of the course's times", moment(time), allowed, moment(near))


class TemperatureCourse(Spec):
    """Temperature change of a body at each time of the course.

    It is `change` plus the scalar product of `gradient` and the position from the body's origin. It also applies to the
    bodies that it carries without an entry. A quantity that is omitted is zero at all times.

    Attributes
    ----------
    change : tuple[float, ...] | None
        Temperature change at the body's origin at each time, in kelvin; zero by default.
    gradient : tuple[tuple[float, float, float], ...] | None
        Temperature gradient in the body's frame at each time, in K/m; zero by default.
    """

    change: tuple[TemperatureChange, ...] | None = None
    gradient: tuple[TemperatureGradient, ...] | None = None


class MotionCourse(Spec):
    """Motion of a body at each time of the course, as `perturb` has it for a single state.

    Attributes
    ----------
    rotate : tuple[tuple[float, float, float], ...] | None
        Rotation vector in the body's frame about the pivot at each time, in radians; the rotation precedes the shift.
        Zero by default.
    shift : tuple[tuple[float, float, float], ...] | None
        Shift in the body's frame at each time, in metres; zero by default.
    scale : tuple[float, ...] | None
        Relative change of scale of the body and all it carries at each time; zero by default.
    pivot : str
        Name of the body's point that rotation and scale leave in place at all times.
    """

    rotate: tuple[Rotation, ...] | None = None
    shift: tuple[Shift, ...] | None = None
    scale: tuple[ScaleChange, ...] | None = None
    pivot: Name = DEFAULT_PIVOT

    @property
    def series(self) -> Mapping[str, tuple[Any, ...] | None]:
        """Name of a quantity (rotate, shift, scale) -> its values, one for each time; None if the file has none."""
        return {"rotate": self.rotate, "shift": self.shift, "scale": self.scale}

    def at(self, k: int) -> Motion:
        """Return the motion of the body at time number ``k`` of the course, counted from 0."""
        return Motion(
            NO_MOTION if self.rotate is None else self.rotate[k],
            NO_MOTION if self.shift is None else self.shift[k],
            self.pivot,
            0.0 if self.scale is None else self.scale[k],
        )


class CourseSpec(Spec):
    """Series of states of an instrument at given times.

    At each time these temperatures and motions are added to the job's perturbation. A body listed under `temperature`
    has its own temperature at all times, even where the value is 0 K, instead of that of its carrier. Rotation vectors,
    shifts and scales are added, component by component, to those of `perturb` for the same node.

    Attributes
    ----------
    times : tuple[float, ...]
        Ascending times, in seconds. The instrument has no memory, so that only their order affects the images.
    temperature : Mapping[str, TemperatureCourse]
        Node path -> temperature at each time.
    motion : Mapping[str, MotionCourse]
        Node path -> motion at each time.
    table : str | None
        CSV file with times, temperatures and motions, instead of these keys; a path relative to the job's file. Each
        head has quantity and unit: `time [min]`, `base/forward/M2 shift z [um]`, `base/forward/M2 rotate x [arcsec]`,
        `base/forward scale [ppm]`, `base/forward temperature [K]`, `base/forward gradient x [mK/m]`. The key `motion`
        then holds only pivots.
    detail : float | None
        Time whose state is reported in full, like the single state of a job without a course, in seconds; by default
        the last one.
    """

    times: Annotated[tuple[Moment, ...], AfterValidator(_check_count), AfterValidator(ascending)] = ()
    temperature: Paths[TemperatureCourse] = Field(default_factory=FrozenMap)
    motion: Paths[MotionCourse] = Field(default_factory=FrozenMap)
    table: Reference | None = None
    detail: Moment | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "CourseSpec":
        if self.table is not None:
            return self._only_a_table()
        if not self.times:
            raise Problem("'times' is missing", None, "times: [0 min, 12 min], or the table of a CSV file")
        if not (self.temperature or self.motion):
            within = ("temperature",) if "temperature" in self.model_fields_set else ()
            raise Problem("nothing changes", "no nodes", "a node with its temperatures or motions", None, within)
        for path, heat in self.temperature.items():
            self._one_for_each_time(("temperature", path), {"change": heat.change, "gradient": heat.gradient})
        for path, moves in self.motion.items():
            self._one_for_each_time(("motion", path), moves.series)
        if self.detail is not None and index_of_value(self.detail, self.times) is None:
            raise no_such_time(self.detail, self.times, "one of times").below("detail")
        return self

    def _only_a_table(self) -> "CourseSpec":
        for name in ("times", "temperature"):
            if getattr(self, name):
                raise Problem("given in the table already", name, "the table, or what it has, not both", within=(name,))
        for path, moves in self.motion.items():
            for name, values in moves.series.items():
                if values is not None:
                    raise Problem("given in the table already", name, "pivot", within=("motion", path, name))
        return self

    def _one_for_each_time(self, key: KeyPath, series: Mapping[str, tuple[Any, ...] | None]) -> None:
        if all(values is None for values in series.values()):
            *names, last = series
            raise Problem("nothing changes", None, f"{', '.join(names)} or {last}", None, key)
        for name, values in series.items():
            if values is not None and len(values) != len(self.times):
                value, allowed = f"{len(values)} entries", f"{len(self.times)}, as many as there are times"
                raise Problem("not one entry for each time", value, allowed, None, (*key, name))

    @property
    def shown(self) -> int:
        """Number of the time that is reported in full, counted from 0."""
        number = None if self.detail is None else index_of_value(self.detail, self.times)
        return len(self.times) - 1 if number is None else number

    def fields(self, k: int) -> dict[str, Temperature]:
        """Return node path -> temperature change that the course causes at time number ``k``, counted from 0."""
        return {
            path: Temperature(
                table.change[k] if table.change is not None else 0.0,
                table.gradient[k] if table.gradient is not None else (0.0, 0.0, 0.0),
            )
            for path, table in self.temperature.items()
        }

    def motions(self, k: int) -> dict[str, Motion]:
        """Return node path -> motion that the course causes at time number ``k``, counted from 0."""
        return {path: moves.at(k) for path, moves in self.motion.items()}

    def key(self, path: str, k: int) -> tuple[str | int, ...]:
        """Return the key path in the course of a node's temperature at time number ``k``."""
        name = "change" if self.temperature[path].change is not None else "gradient"
        return ("temperature", path, name, k)


TIME = "time"
AXES = ("x", "y", "z")
VECTORS = {"rotate": units.ANGLE, "shift": units.LENGTH, "gradient": units.TEMPERATURE_GRADIENT}
"""Quantities with a column for each axis; axes without a column are zero."""
NUMBERS = {"scale": units.SCALE, "temperature": units.TEMPERATURE_DIFFERENCE}
HEAT = {"temperature": "change", "gradient": "gradient"}
"""Name of a quantity in a column head -> its key below ``temperature``; other quantities are below ``motion``."""
HEADS = "'time [min]', 'NODE shift z [um]', 'NODE rotate x [arcsec]', 'NODE scale [ppm]', 'NODE temperature [K]' or "
HEADS += "'NODE gradient x [mK/m]'"

_HEAD = re.compile(r"(?:(?P<node>\S+) +)?(?P<what>[a-z]+)(?: +(?P<axis>[a-z]))? *\[(?P<unit>[^\[\]]+)\]")


@dataclass(frozen=True)
class _Column:
    """Meaning of a column in the table of a course.

    Attributes
    ----------
    what : str
        Quantity in the column: TIME, one of VECTORS, which have an axis, or one of NUMBERS, which have none.
    node : str
        Path of the node, empty for the time.
    axis : int
        Index of the component of a vector, 0 to 2.
    unit : str
        Unit of the numbers.
    """

    what: str
    node: str
    axis: int
    unit: str

    @property
    def path(self) -> KeyPath:
        """Key path in the course, without the index of the time."""
        if self.what == TIME:
            return ("times",)
        return ("temperature", self.node, HEAT[self.what]) if self.what in HEAT else ("motion", self.node, self.what)


def read_course(path: Path, named: CourseSpec) -> CourseSpec:
    """Read the course of a table, with the detail and the pivots of the course that refers to it.

    Parameters
    ----------
    path : Path
        CSV file with a row for each time, whose heads have node, quantity, axis and unit.
    named : CourseSpec
        Course that refers to the table.

    Raises
    ------
    InputError
        The table cannot be read; with its line.
    """
    file, rows = str(path), rows_of(path, LARGEST_BYTES)
    if len(rows) < 2:
        line = rows[0][0] if rows else 1
        raise InputError(Issue("a table needs a row of heads and a row for each time", file, line, allowed=HEADS))
    (head_line, heads), body = rows[0], rows[1:]
    columns = [_column(head, file, head_line) for head in heads]
    keys = [(*column.path, column.axis) for column in columns]
    twice = next((head for k, head in enumerate(heads) if keys[k] in keys[:k]), None)
    if twice is not None:
        raise InputError(Issue("a second column with this head", file, head_line, (twice.strip(),)))
    if TIME not in [column.what for column in columns]:
        text, actual = "there is no column of times", names_text(heads)
        raise InputError(Issue(text, file, head_line, value=actual, allowed="time [min]"))
    data: dict[str, Any] = {"times": [None] * len(body), "temperature": {}, "motion": {}}
    lines: dict[KeyPath, int] = {(): head_line, ("temperature",): head_line, ("motion",): head_line}
    for k, (line, cells) in enumerate(body):
        if len(cells) != len(columns):
            text = f"{len(cells)} cells under {len(columns)} heads"
            raise InputError(Issue(text, file, line, allowed="as many cells as heads, with commas between them"))
        for column, cell in zip(columns, cells, strict=True):
            _put(data, lines, column, k, f"{cell.strip()} {column.unit}", (line, len(body)))
            lines.setdefault(column.path[:2], head_line)
    for node, moves in named.motion.items():
        if node not in data["motion"]:
            allowed = names_text(data["motion"]) or "nothing"
            problem = unknown("the table does not move this node", node, data["motion"], allowed=allowed)
            raise named.error(problem, ("motion", node))
        data["motion"][node]["pivot"] = moves.pivot
    if named.detail is not None:
        data["detail"] = named.plain()["detail"]
    return validate(CourseSpec, YamlFile(file, {key: value for key, value in data.items() if value}, lines))


def _column(head: str, file: str, line: int) -> _Column:
    """Return the column of a head; raise `InputError` for an unknown head."""
    match = _HEAD.fullmatch(head.strip())
    if match is None:
        raise InputError(Issue("not the head of a column", file, line, value=shown(head.strip()), allowed=HEADS))
    what, node, axis = match["what"], match["node"] or "", match["axis"]
    known = (*VECTORS, *NUMBERS) if node else (TIME,)
    if what not in known:
        raise InputError(unknown("no such quantity", what, known).at(file, line, (head.strip(),)))
    if (axis in AXES) is not (what in VECTORS):
        allowed = "an axis: x, y or z" if what in VECTORS else "no axis"
        raise InputError(Issue(f"a column of {what} has {allowed}", file, line, (head.strip(),), allowed=HEADS))
    kind: units.Kind = units.MOMENT if what == TIME else (VECTORS | NUMBERS)[what]
    try:
        units.parse_quantity(f"0 {match['unit'].strip()}", kind)
    except Problem as problem:
        problem.allowed = names_text(kind.units)
        raise InputError(problem.at(file, line, (head.strip(),))) from None
    return _Column(what, node, AXES.index(axis) if axis else 0, match["unit"].strip())


def _put(
    data: dict[str, Any], lines: dict[KeyPath, int], column: _Column, k: int, text: str, where: tuple[int, int]
) -> None:
    """Store the number in a cell of the table in the plain data of a course, with its line."""
    line, count = where
    if column.what == TIME:
        data["times"][k] = text
        lines["times", k] = line
        return
    section, node, name = (str(part) for part in column.path)
    values = data[section].setdefault(node, {}).setdefault(name, [None] * count)
    if column.what in VECTORS:
        values[k] = values[k] or ["0 " + VECTORS[column.what].si] * len(AXES)
        values[k][column.axis] = text
        lines[section, node, name, k, column.axis] = line
    else:
        values[k] = text
    lines[section, node, name, k] = line
