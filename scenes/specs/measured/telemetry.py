"""Tables of readings that an instrument in operation sends down, and what their columns are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.measured.pass_files import ClockReading, TimeScale
from scenes.specs.operation import Event
from scenes.yaml.errors import Problem, names_text, nearest
from scenes.yaml.spec import Paths, Reference, Spec, Text, not_empty, short_for
from scenes.yaml.units import ANGLE, LENGTH, MOMENT, TEMPERATURE, TEMPERATURE_DIFFERENCE, Kind, parse_quantity

VALUES: Mapping[str, tuple[Kind, Kind]] = FrozenMap(
    {"temperature": (TEMPERATURE, TEMPERATURE_DIFFERENCE), "attitude": (ANGLE, ANGLE), "focus": (LENGTH, LENGTH)}
)
"""Sort of reading that is numbers in a table -> what they measure, and what their sigmas do."""
RUNS = ("monitor", "calibration", "angle")
"""Sorts of reading that a run folder holds, which a row of a table names."""
EVENT = "event"
QUATERNION = "quaternion"
"""Unit of an attitude whose four columns are a quaternion."""
Heads = Annotated[tuple[Text, ...], short_for(None, str, schema=Text | tuple[Text, ...]), Field(min_length=1)]


class ReadingColumnSpec(Spec):
    """The columns of one body, star tracker or camera.

    Attributes:
        column: head of its column, or the list of the heads of its components: three angles of an attitude, or the four
            numbers of its quaternion, the scalar last.
        unit: of the numbers; `quaternion` of a quaternion.
        sigma: standard deviation of each of them, with its unit; of a quaternion the angle about each axis.
    """

    column: Heads
    unit: Text
    sigma: Text


class ReadingTableSpec(Spec):
    """Tables of one form, with a row for each moment.

    Attributes:
        kind: what a row is: `temperature` of bodies, `attitude` of star trackers, `focus` of cameras; `monitor`,
            `calibration` or `angle`, whose row names a run folder; or `event`.
        files: of the tables, relative to this file; `*` and `?` stand for any letters.
        form: `csv`, whose first row has the heads; or `keywords`, lines of `KEYWORD = TIME NUMBER` as CCSDS has them.
        time: head of the column of times.
        time_scale: what the clock shows.
        epoch: reading of that clock at 0, where the column has numbers and not dates.
        time_unit: of those numbers.
        columns: body, star tracker or camera -> its columns, for sorts that are numbers.
        name: head of the column with the run folder or the event, relative to the table.
        detail: head of the column that says more of an event.
        events: name of an event in the table -> what it is.
    """

    kind: Literal["temperature", "attitude", "focus", "monitor", "calibration", "angle", "event"]
    files: Reference
    form: Literal["csv", "keywords"] = "csv"
    time: Text = "time"
    time_scale: TimeScale = "UTC"
    epoch: ClockReading | None = None
    time_unit: Text = "s"
    columns: Paths[ReadingColumnSpec] = Field(default_factory=FrozenMap)
    name: Text | None = None
    detail: Text | None = None
    events: Paths[Event] = Field(default_factory=FrozenMap)

    @model_validator(mode="after")
    def _has_its_columns(self) -> ReadingTableSpec:
        numbers = self.kind in VALUES
        if numbers and not self.columns:
            raise Problem(f"no columns of a table of kind {self.kind}", None, "columns: {BODY: {column: HEAD, ...}}")
        if not numbers and self.name is None:
            raise Problem(f"no column that says which {self.kind}", None, "name: HEAD", within=("name",))
        if not numbers and (self.columns or self.form != "csv"):
            key = "columns" if self.columns else "form"
            raise Problem(f"a table of kind {self.kind} has no {key}", None, "name: HEAD", within=(key,))
        _measures(self.time_unit, MOMENT, ("time_unit",))
        for subject, one in self.columns.items():
            _is_measured(self.kind, one, ("columns", subject))
            if self.form == "keywords" and len(one.column) > 1:
                problem = "several keywords of one reading"
                raise Problem(problem, names_text(one.column), "one keyword", within=("columns", subject, "column"))
        return self


def _is_measured(kind: str, one: ReadingColumnSpec, where: tuple[str, ...]) -> None:
    """Refuse columns whose number, unit or sigma are not those of a sort of reading. Raises Problem."""
    value, sigma = VALUES[kind]
    count = {QUATERNION: 4}.get(one.unit, 3) if kind == "attitude" else 1
    if len(one.column) != count:
        text = f"{len(one.column)} columns of one {kind}"
        raise Problem(text, names_text(one.column), f"{count} of them", within=(*where, "column"))
    if not (kind == "attitude" and one.unit == QUATERNION):
        _measures(one.unit, value, (*where, "unit"))
    try:
        known = parse_quantity(one.sigma, sigma)
    except Problem as problem:
        raise problem.below(*where, "sigma") from None
    if not known > 0.0:
        raise Problem("not greater than zero", one.sigma, sigma.allowed, within=(*where, "sigma"))


def _measures(unit: str, kind: Kind, where: tuple[str, ...]) -> None:
    try:
        parse_quantity(f"1 {unit}", kind)
    except Problem as problem:
        meant = problem.suggestion or nearest(unit, kind.units)
        raise Problem(problem.problem, repr(unit), names_text(kind.units), meant, within=where) from None


class TelemetrySpec(Spec):
    """What the tables of an instrument's readings hold.

    Attributes:
        instrument: that was read: name of an instrument in scenes/library/instruments, or path of an own file.
        readings: the tables.
    """

    instrument: Reference
    readings: Annotated[tuple[ReadingTableSpec, ...], Field(max_length=100), not_empty("no tables", "a list of tables")]
