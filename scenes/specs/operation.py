"""Plan of operation, under which `twin.operate` estimates an instrument's state from its record over years.

The plan has the expected disturbances, the effects of events and the requirements. The module also has the names of
events in tables, records and plans, and the description of tables of readings (telemetry).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.disturbances import NONE, DisturbancesSpec
from scenes.specs.load import DISTURBANCES, INSTRUMENTS, portable_reference
from scenes.specs.resolved import ResolvedJob, resolve_on
from scenes.yaml.errors import Problem, names_text, nearest, shown, unknown
from scenes.yaml.spec import Name, Number, Paths, Ref, Reference, Spec, Text, Whole, not_empty, short_for, validate
from scenes.yaml.unit_fields import ClockReading, Quantity, TimeScale
from scenes.yaml.units import ANGLE, LENGTH, MOMENT, SCALE, TEMPERATURE, TEMPERATURE_DIFFERENCE, Kind, parse_quantity
from scenes.yaml.yaml_file import read_yaml

Event = Literal["safe_mode", "heater_set_point", "refocus", "eclipse_season_begins", "eclipse_season_ends"]
EVENTS: tuple[str, ...] = get_args(Event)
"""Names of the events that a record of operation may contain, besides readings."""


_UNITS = ((ANGLE, ("arcsec",)), (LENGTH, ("um", "mm", "m", "nm")), (SCALE, ("ppm", "percent")))
ENDINGS: Mapping[str, tuple[Kind, str]] = FrozenMap({unit: (kind, unit) for kind, units in _UNITS for unit in units})
"""Suffix of a quantity's key, such as `arcsec` -> kind of quantity and its unit."""
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
    """Requirement on one quantity in operation.

    Attributes
    ----------
    quantity : str
        Quantity as `GROUP KEY`. For a camera, its name with `d_alpha_arcsec`, `d_beta_arcsec` or `d_gamma_arcsec`
        (change of the rotation about the camera's Y, about its X, about the line of sight) or `d_f_um` (change of the
        principal distance); `intersection_angle change_arcsec`; or `ground along_m`, `ground across_m`, `ground
        height_m` (shift of a ground point along the track, across it, in height).
    limit : str
        Largest absolute value of its change, with unit.
    probability : float
        Probability with which the limit must be met at every time.
    """

    quantity: Text
    limit: Text
    probability: Annotated[Number, Field(ge=0.5, lt=1.0)] = 0.95

    @model_validator(mode="after")
    def _check_quantity(self) -> RequirementSpec:
        if len(self.quantity.split()) != 2:
            raise Problem(
                "not a quantity",
                shown(self.quantity),
                "GROUP KEY: intersection_angle change_arcsec",
                within=("quantity",),
            )
        if self.key.rpartition("_")[2] not in ENDINGS:
            allowed = f"a key that ends in its unit: {names_text(f'_{ending}' for ending in ENDINGS)}"
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
        """Group of the quantity: name of a camera, ``intersection_angle`` or ``ground``."""
        return self.quantity.split()[0]

    @property
    def key(self) -> str:
        """Key of the estimated quantity, such as ``d_alpha_arcsec``, which ends in its unit."""
        return self.quantity.split()[1]

    @property
    def name(self) -> str:
        """Full name of the quantity: group and key, separated by a space."""
        return f"{self.group} {self.key}"

    @property
    def largest(self) -> float:
        """Largest absolute value allowed, as a number in the unit in which the key ends."""
        kind, unit = self._kind
        return parse_quantity(self.limit, kind) / parse_quantity(f"1 {unit}", kind)

    @property
    def _kind(self) -> tuple[Kind, str]:
        return ENDINGS[self.key.rpartition("_")[2]]


class OperationSpec(Spec):
    """Plan of operation: the expected changes of an instrument and the requirements on it over its mission.

    Attributes
    ----------
    instrument : str
        Instrument of the record: a name in scenes/library/instruments, or the path of your file.
    disturbances : str
        Expected disturbances over years with their time laws: a name in scenes/library/disturbances, or the path of
        your file.
    events : dict[str, tuple[str, ...]]
        Event of the record -> causes of the disturbances file whose motions then change by a step with their standard
        deviations. An event without causes has no effect.
    coefficients : float
        Relative standard deviation of the computed thermal response of each body with a temperature sensor.
    mission : float
        Duration of the mission, in seconds, to which `jump_false_alarm` of the disturbances refers.
    window : int
        Number of readings after a jump within which it is searched for.
    horizon : float
        Time from the last reading up to which the state is forecast, in seconds.
    requirements : tuple[RequirementSpec, ...]
        Requirements; each quantity occurs once.
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
        names = [requirement.name for requirement in self.requirements]
        for k, name in enumerate(names):
            if name in names[:k]:
                text = "a quantity has two requirements"
                raise Problem(text, shown(name), "one of them", within=("requirements", k, "quantity"))
        return self


class OperationSetup(Spec):
    """Plan of operation with the content of all files to which it refers.

    Attributes
    ----------
    operation : OperationSpec
        The plan.
    model : ResolvedJob
        The instrument, with the plan's disturbances.
    """

    operation: OperationSpec
    model: ResolvedJob

    @property
    def disturbances(self) -> DisturbancesSpec:
        """Expected disturbances of the instrument over the mission."""
        assert self.model.disturbances is not None  # a plan requires them
        return self.model.disturbances


def read_operation(path: str | Path) -> OperationSetup:
    """Read a plan of operation with the content of its references.

    Raises
    ------
    InputError
        A file cannot be read or is not valid, or an event refers to a cause that does not exist.
    """
    return resolve_operation(validate(OperationSpec, read_yaml(path)))


def resolve_operation(spec: OperationSpec) -> OperationSetup:
    """Return a plan of operation with the content of all files to which it refers.

    Raises
    ------
    InputError
        A file cannot be read or is not valid, or an event refers to a cause that does not exist.
    """
    update: dict[str, str] = {}
    for key, folder, others in (("instrument", INSTRUMENTS, ("cameras",)), ("disturbances", DISTURBANCES, ())):
        reference = getattr(spec, key)
        if reference == NONE:
            problem, allowed = "a plan of operation needs disturbances", "the name of a file of disturbances"
            raise spec.error(problem, (key,), found=reference, allowed=allowed)
        update[key] = portable_reference(folder, reference, spec, (key,), others)
    spec = spec.model_copy(update=update)
    setup = OperationSetup.model_construct(operation=spec, model=resolve_on(spec, spec.instrument, spec.disturbances))
    known = setup.disturbances.causes
    for event, causes in spec.events.items():
        for k, cause in enumerate(causes):
            if cause not in known:
                unknown_cause = unknown(f"no such cause in {setup.disturbances.name}", cause, known)
                raise spec.error(unknown_cause, ("events", event, k))
    return setup


VALUES: Mapping[str, tuple[Kind, Kind]] = FrozenMap(
    {"temperature": (TEMPERATURE, TEMPERATURE_DIFFERENCE), "attitude": (ANGLE, ANGLE), "focus": (LENGTH, LENGTH)}
)
"""Kind of reading that is a number in a table -> kinds of quantity (which fix the units) of the number and of its
sigma.
"""
RUNS = ("monitor", "calibration", "angle")
"""Kinds of reading that are run folders, to which a row of a table refers."""
EVENT = "event"
QUATERNION = "quaternion"
"""Unit of an attitude whose four columns are a quaternion."""
Heads = Annotated[tuple[Text, ...], short_for(None, str, schema=Text | tuple[Text, ...]), Field(min_length=1)]


class ReadingColumnSpec(Spec):
    """Columns of one body, star tracker or camera in a table of readings.

    Attributes
    ----------
    column : tuple[str, ...]
        Head of the column, or list of the heads of the components: three angles of an attitude, or the four numbers of
        its quaternion, the scalar last.
    unit : str
        Unit of the numbers; `quaternion` for a quaternion.
    sigma : str
        Standard deviation of each number, with unit; for a quaternion that of the angle about each axis.
    """

    column: Heads
    unit: Text
    sigma: Text


class ReadingTableSpec(Spec):
    """Tables of readings of one format, with a row for each time.

    Attributes
    ----------
    kind : str
        Content of a row: `temperature` of bodies, `attitude` of star trackers, `focus` of cameras; `monitor`,
        `calibration` or `angle` for a row that refers to a run folder; or `event`.
    files : str
        Paths of the tables, relative to this file; `*` and `?` are wildcards.
    form : {'csv', 'keywords'}
        Format: `csv` with the heads in the first row, or `keywords`, lines of `KEYWORD = TIME NUMBER` as in CCSDS
        messages.
    time : str
        Head of the column of times.
    time_scale : {'UTC', 'GPS', 'TAI', 'TT', 'GAL', 'QZS', 'BDT'}
        Time scale of the times in the tables.
    epoch : str | None
        Date and time, in that time scale, at which the times are 0, if the column has numbers instead of dates.
    time_unit : str
        Unit of the times, if the column has numbers instead of dates.
    columns : Mapping[str, ReadingColumnSpec]
        Body, star tracker or camera -> its columns, for kinds with numbers.
    name : str | None
        Head of the column with the event or the run folder, whose path is relative to the table.
    detail : str | None
        Head of the column with details of an event.
    events : Mapping[str, str]
        Name of an event in the table -> kind of event.
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
            raise Problem(f"no column with the {self.kind}", None, "name: HEAD", within=("name",))
        if not numbers and (self.columns or self.form != "csv"):
            key = "columns" if self.columns else "form"
            raise Problem(f"a table of kind {self.kind} has no {key}", None, "name: HEAD", within=(key,))
        _measures(self.time_unit, MOMENT, ("time_unit",))
        for subject, columns in self.columns.items():
            _is_measured(self.kind, columns, ("columns", subject))
            if self.form == "keywords" and len(columns.column) > 1:
                problem = "several keywords for one reading"
                raise Problem(problem, names_text(columns.column), "one keyword", within=("columns", subject, "column"))
        return self


def _is_measured(kind: str, columns: ReadingColumnSpec, where: tuple[str, ...]) -> None:
    """Raise `Problem` for columns whose number, unit or sigma do not fit a kind of reading."""
    value, sigma = VALUES[kind]
    count = {QUATERNION: 4}.get(columns.unit, 3) if kind == "attitude" else 1
    if len(columns.column) != count:
        text = f"{len(columns.column)} columns for one {kind}"
        raise Problem(text, names_text(columns.column), f"{count} of them", within=(*where, "column"))
    if not (kind == "attitude" and columns.unit == QUATERNION):
        _measures(columns.unit, value, (*where, "unit"))
    try:
        known = parse_quantity(columns.sigma, sigma)
    except Problem as problem:
        raise problem.below(*where, "sigma") from None
    if not known > 0.0:
        raise Problem("not greater than zero", columns.sigma, sigma.allowed, within=(*where, "sigma"))


def _measures(unit: str, kind: Kind, where: tuple[str, ...]) -> None:
    try:
        parse_quantity(f"1 {unit}", kind)
    except Problem as problem:
        near = problem.suggestion or nearest(unit, kind.units)
        raise Problem(problem.problem, repr(unit), names_text(kind.units), near, within=where) from None


class TelemetrySpec(Spec):
    """Telemetry: description of the tables of an instrument's readings.

    Attributes
    ----------
    instrument : str
        Instrument that sent the readings: a name in scenes/library/instruments, or the path of your file.
    readings : tuple[ReadingTableSpec, ...]
        Tables of readings.
    """

    instrument: Ref
    readings: Annotated[tuple[ReadingTableSpec, ...], Field(max_length=100), not_empty("no tables", "a list of tables")]
