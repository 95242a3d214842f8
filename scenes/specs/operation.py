"""A plan of operation: what is expected of an instrument over years, what events do to it, and what it has to keep.

The estimate of `twin.operate` follows a record under such a plan.

What can happen to an instrument in operation, by the names that tables, records and plans use; and the tables of
readings that it sends down.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.disturbances import NONE, DisturbancesSpec
from scenes.specs.load import DISTURBANCES, INSTRUMENTS, placed
from scenes.specs.resolved import ResolvedJob, resolve_on
from scenes.yaml.errors import Problem, names_text, nearest, shown, unknown
from scenes.yaml.spec import Name, Number, Paths, Ref, Reference, Spec, Text, Whole, not_empty, short_for, validate
from scenes.yaml.unit_fields import ClockReading, Quantity, TimeScale
from scenes.yaml.units import ANGLE, LENGTH, MOMENT, SCALE, TEMPERATURE, TEMPERATURE_DIFFERENCE, Kind, parse_quantity
from scenes.yaml.yaml_file import read_yaml

Event = Literal["safe_mode", "heater_set_point", "refocus", "eclipse_season_begins", "eclipse_season_ends"]
EVENTS: tuple[str, ...] = get_args(Event)
"""What can happen to an instrument, other than being read."""


ENDINGS: Mapping[str, tuple[Kind, str]] = FrozenMap(
    {
        "arcsec": (ANGLE, "arcsec"),
        "um": (LENGTH, "um"),
        "mm": (LENGTH, "mm"),
        "m": (LENGTH, "m"),
        "nm": (LENGTH, "nm"),
        "ppm": (SCALE, "ppm"),
        "percent": (SCALE, "percent"),
    }
)
"""Ending of a quantity's key -> what it measures, and the unit in which it is given."""
MOST_REQUIREMENTS, MOST_CAUSES = 100, 100
Span = Annotated[float, Quantity(MOMENT, above_zero=True, largest="1000000 h")]
Causes = Annotated[
    tuple[Name, ...], short_for(None, str, schema=Name | tuple[Name, ...]), Field(min_length=1, max_length=MOST_CAUSES)
]


def _known_events(value: Mapping[str, tuple[Name, ...]]) -> FrozenMap[str, tuple[Name, ...]]:
    for name, causes in value.items():
        if name not in EVENTS:
            raise unknown("no such event", name, EVENTS, within=(name,))
        for k, cause in enumerate(causes):
            if cause in causes[:k]:
                raise Problem("a cause is named twice", shown(cause), "each once", within=(name, k))
    return FrozenMap(value)


class RequirementSpec(Spec):
    """What one quantity has to keep.

    Attributes
    ----------
    quantity : Text
        `GROUP KEY`: a camera with `d_alpha_arcsec`, `d_beta_arcsec`, `d_gamma_arcsec` or `d_f_um`; `intersection_angle
        change_arcsec`; `ground along_m`, `across_m` or `height_m`.
    limit : Text
        That the size of its change must not exceed, with its unit.
    probability : Number
        With which it has to keep it at every time.
    """

    quantity: Text
    limit: Text
    probability: Annotated[Number, Field(ge=0.5, lt=1.0)] = 0.95

    @model_validator(mode="after")
    def _is_one(self) -> RequirementSpec:
        if len(self.quantity.split()) != 2:
            raise Problem(
                "not a quantity",
                shown(self.quantity),
                "GROUP KEY: intersection_angle change_arcsec",
                within=("quantity",),
            )
        if self.key.rpartition("_")[2] not in ENDINGS:
            allowed = f"a key that ends in its unit: {names_text(f'_{one}' for one in ENDINGS)}"
            raise Problem("a quantity without a unit", shown(self.key), allowed, within=("quantity",))
        try:
            value = parse_quantity(self.limit, self._kind[0])
        except Problem as problem:
            raise problem.below("limit") from None
        if not value > 0.0:
            raise Problem("not greater than zero", shown(self.limit), self._kind[0].allowed, within=("limit",))
        return self

    @property
    def group(self) -> str:
        """A camera, ``intersection_angle`` or ``ground``."""
        return self.quantity.split()[0]

    @property
    def key(self) -> str:
        """Which of its readings; ends in its unit."""
        return self.quantity.split()[1]

    @property
    def name(self) -> str:
        """Group and key with one blank between them."""
        return f"{self.group} {self.key}"

    @property
    def largest(self) -> float:
        """The limit in the unit in which the key ends."""
        kind, unit = self._kind
        return parse_quantity(self.limit, kind) / parse_quantity(f"1 {unit}", kind)

    @property
    def _kind(self) -> tuple[Kind, str]:
        return ENDINGS[self.key.rpartition("_")[2]]


class OperationSpec(Spec):
    """How the state of an instrument is followed in operation.

    Attributes
    ----------
    instrument : Ref
        Name of an instrument in scenes/library/instruments, or path of an own file; that of the record.
    disturbances : Ref
        What is expected to move over years, with its laws of time: name of a file in scenes/library/disturbances, or
        path of an own one.
    events : dict[str, Causes]
        Event of the record -> causes of the disturbances file whose motions step then by their standard deviations. An
        event without causes steps nothing.
    coefficients : float
        Standard deviation of what heat does to light, of each body with a sensor, over the computed value.
    mission : Span
        Life over which the disturbances' `jump_false_alarm` counts.
    window : Whole
        Readings for which a jump is looked for after it has come.
    horizon : Span
        How far a forecast reaches.
    requirements : tuple[RequirementSpec, ...]
        What has to be kept; no quantity twice.
    """

    instrument: Ref
    disturbances: Ref
    events: Annotated[dict[str, Causes], AfterValidator(_known_events)] = Field(default_factory=FrozenMap)
    coefficients: Annotated[float, Quantity(SCALE, smallest="0 percent", largest="1000 percent")] = 0.3
    mission: Span = 87_600.0 * 3600.0
    window: Annotated[Whole, Field(ge=2, le=10_000)] = 60
    horizon: Span = 720.0 * 3600.0
    requirements: Annotated[tuple[RequirementSpec, ...], Field(max_length=MOST_REQUIREMENTS)] = ()

    @model_validator(mode="after")
    def _each_once(self) -> OperationSpec:
        names = [one.name for one in self.requirements]
        for k, name in enumerate(names):
            if name in names[:k]:
                text = "a quantity has two requirements"
                raise Problem(text, shown(name), "one of them", within=("requirements", k, "quantity"))
        return self


class OperationSetup(Spec):
    """A plan with all it refers to, so that one text says under what a record was followed.

    Attributes
    ----------
    operation : OperationSpec
        The plan.
    model : ResolvedJob
        The instrument, with what the plan states to move.
    """

    operation: OperationSpec
    model: ResolvedJob

    @property
    def disturbances(self) -> DisturbancesSpec:
        """What is expected to move."""
        assert self.model.disturbances is not None  # a plan names them
        return self.model.disturbances


def read_operation(path: str | Path) -> OperationSetup:
    """Read a plan of operation and all it refers to.

    Raises
    ------
    InputError
        Any of the files cannot be read or is not valid, or an event steps a cause that is not there.
    """
    return resolve_operation(validate(OperationSpec, read_yaml(path)))


def resolve_operation(spec: OperationSpec) -> OperationSetup:
    """A plan with all it refers to, whose references hold from anywhere. Raises InputError as `read_operation`."""
    update: dict[str, str] = {}
    for key, place, others in (("instrument", INSTRUMENTS, ("cameras",)), ("disturbances", DISTURBANCES, ())):
        reference = getattr(spec, key)
        if reference == NONE:
            problem, allowed = "a plan needs what is expected to move", "the name of a file of disturbances"
            raise spec.error(problem, (key,), found=reference, allowed=allowed)
        update[key] = placed(place, reference, spec, (key,), others)
    spec = spec.model_copy(update=update)
    setup = OperationSetup.model_construct(operation=spec, model=resolve_on(spec, spec.instrument, spec.disturbances))
    known = setup.disturbances.causes
    for event, causes in spec.events.items():
        for k, cause in enumerate(causes):
            if cause not in known:
                wrong = unknown(f"no such cause in {setup.disturbances.name}", cause, known)
                raise spec.error(wrong, ("events", event, k))
    return setup


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

    Attributes
    ----------
    column : Heads
        Head of its column, or the list of the heads of its components: three angles of an attitude, or the four numbers
        of its quaternion, the scalar last.
    unit : Text
        Of the numbers; `quaternion` of a quaternion.
    sigma : Text
        Standard deviation of each of them, with its unit; of a quaternion the angle about each axis.
    """

    column: Heads
    unit: Text
    sigma: Text


class ReadingTableSpec(Spec):
    """Tables of one form, with a row for each moment.

    Attributes
    ----------
    kind : str
        What a row is: `temperature` of bodies, `attitude` of star trackers, `focus` of cameras; `monitor`,
        `calibration` or `angle`, whose row names a run folder; or `event`.
    files : Reference
        Of the tables, relative to this file; `*` and `?` stand for any letters.
    form : Literal['csv', 'keywords']
        `csv`, whose first row has the heads; or `keywords`, lines of `KEYWORD = TIME NUMBER` as CCSDS has them.
    time : Text
        Head of the column of times.
    time_scale : TimeScale
        What the clock shows.
    epoch : ClockReading | None
        Reading of that clock at 0, where the column has numbers and not dates.
    time_unit : Text
        Of those numbers.
    columns : Paths[ReadingColumnSpec]
        Body, star tracker or camera -> its columns, for sorts that are numbers.
    name : Text | None
        Head of the column with the run folder or the event, relative to the table.
    detail : Text | None
        Head of the column that says more of an event.
    events : Paths[Event]
        Name of an event in the table -> what it is.
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

    Attributes
    ----------
    instrument : Ref
        That was read: name of an instrument in scenes/library/instruments, or path of an own file.
    readings : tuple[ReadingTableSpec, ...]
        The tables.
    """

    instrument: Ref
    readings: Annotated[tuple[ReadingTableSpec, ...], Field(max_length=100), not_empty("no tables", "a list of tables")]
