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
from scenes.yaml.spec import (
    Name,
    Named,
    Number,
    Paths,
    Ref,
    Reference,
    Spec,
    Text,
    Whole,
    not_empty,
    short_for,
    validate,
)
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


class AmountSpec(Spec):
    """Amount of a term before any reading, in the unit of its motion.

    Attributes
    ----------
    value, sigma : str
        Amount and its standard deviation, with unit.
    """

    value: Text
    sigma: Text

    def si(self, kind: Kind) -> tuple[float, float]:
        """Return the amount and its standard deviation in SI units; raise Problem if they are not of the kind."""
        out = []
        for key in ("value", "sigma"):
            try:
                out.append(parse_quantity(getattr(self, key), kind))
            except Problem as problem:
                raise problem.below(key) from None
        if out[1] < 0.0:
            raise Problem("less than zero", shown(self.sigma), "a standard deviation", within=("sigma",))
        return out[0], out[1]


class TimeConstantSpec(Spec):
    """Time constant of a decay or a lag.

    Attributes
    ----------
    value : float
        Time constant before any reading, in seconds.
    sigma : float
        Its relative standard deviation (of its natural logarithm); 0 percent for a known one.
    """

    value: Span
    sigma: Annotated[float, Quantity(SCALE, smallest="0 percent", largest="200 percent")]


class TermSpec(Spec):
    """Term of a motion: a known function of time whose amount, and time constant, the readings determine.

    With `decay` it is a decay, with `per` a slope, with `input` the effect of a measured input, otherwise a constant.

    Attributes
    ----------
    motion : str
        Motion as in the disturbances, BODY shift AXIS, BODY rotate AXIS or BODY scale, such as `base/forward/M2 shift
        z`. A cause of the disturbances must have it.
    amount : AmountSpec
        Constant, amount of a decay at its date, change in the time `per`, or change per kelvin of the input.
    since : str | None
        UTC from which a decay or slope counts; by default the first reading. A slope is zero before.
    decay : TimeConstantSpec | None
        Time constant T of a decay exp(-(t - since) / T).
    per : float | None
        Time in which a slope changes the motion by its amount, in seconds.
    input : str | None
        Name of the input in the record's readings of kind `input`.
    reference : float
        Temperature at which the input has no effect, in kelvin.
    window : float | None
        Length of the window, ending at the reading, over which the input is averaged, in seconds.
    relative : bool
        True if the effect follows the input's newest sample minus its mean over `window`.
    lag : TimeConstantSpec | None
        Time constant of a first-order lag with which the input acts.
    gap : float
        Age of the newest sample above which the input counts as not measured, in seconds.
    """

    motion: Text
    amount: AmountSpec
    since: ClockReading | None = None
    decay: TimeConstantSpec | None = None
    per: Span | None = None
    input: Name | None = None
    reference: Annotated[float, Quantity(TEMPERATURE)] = 273.15
    window: Span | None = None
    relative: bool = False
    lag: TimeConstantSpec | None = None
    gap: Span = 3600.0

    @property
    def kind(self) -> Kind:
        """Kind of quantity of the amount."""
        return motion_kind(self.motion)

    @model_validator(mode="after")
    def _is_one_kind(self) -> TermSpec:
        kinds = [key for key in ("decay", "per", "input") if getattr(self, key) is not None]
        if len(kinds) > 1:
            raise Problem(
                "two kinds of term", names_text(kinds), "one of them, or none for a constant", within=(kinds[1],)
            )
        for key in ("window", "relative", "lag"):
            if getattr(self, key) and not self.input:
                raise Problem(f"{key} without an input", None, "input: NAME", within=(key,))
        if self.relative and self.window is None:
            raise Problem(
                "relative to no mean", None, "window: the time over which the mean is taken", within=("relative",)
            )
        if self.window is not None and self.lag is not None:
            raise Problem("a window and a lag", None, "one of them; two terms for both", within=("lag",))
        if self.since is not None and not (self.decay or self.per):
            raise Problem("a date of a term that is none", None, "a term with decay or per", within=("since",))
        try:
            self.amount.si(motion_kind(self.motion))
        except Problem as problem:
            raise problem if problem.within == ("motion",) else problem.below("amount") from None
        return self


def motion_kind(motion: str) -> Kind:
    """Return the kind of quantity of a motion, from its name such as `base/forward/M2 shift z`.

    Raises
    ------
    Problem
        The name is not of this form.
    """
    words = motion.split()
    kind = {"shift": LENGTH, "rotate": ANGLE, "scale": SCALE}.get(words[1]) if len(words) > 1 else None
    if kind is None or len(words) != (2 if words[1] == "scale" else 3):
        allowed = "BODY shift AXIS, BODY rotate AXIS or BODY scale"
        raise Problem("not a motion", shown(motion), allowed, within=("motion",))
    return kind


class FocusSpec(Spec):
    """Readings of focus that an estimate uses in place of a monitor's spots.

    Attributes
    ----------
    camera : str
        Camera whose readings of kind `focus` are used.
    motion : str
        Shift whose amount the readings give, such as `base/telescope/M2 shift z`. The disturbances may only have this
        motion, since readings of focus cannot separate others from it.
    """

    camera: Name
    motion: Text


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
    focus : FocusSpec | None
        Readings of focus to be used in place of a monitor's spots.
    terms : dict[str, TermSpec]
        Name -> term of a motion that is learned: a constant, slope, decay, or the effect of an input.
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
    focus: FocusSpec | None = None
    terms: Named[TermSpec] = Field(default_factory=FrozenMap)
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
            raise spec.error(problem, (key,), value=reference, allowed=allowed)
        update[key] = portable_reference(folder, reference, spec, (key,), others)
    spec = spec.model_copy(update=update)
    setup = OperationSetup.model_construct(operation=spec, model=resolve_on(spec, spec.instrument, spec.disturbances))
    if spec.focus is not None and spec.focus.camera not in setup.model.instrument.cameras:
        no_camera = unknown("no such camera", spec.focus.camera, setup.model.instrument.cameras)
        raise spec.error(no_camera, ("focus", "camera"))
    known = setup.disturbances.causes
    for event, causes in spec.events.items():
        for k, cause in enumerate(causes):
            if cause not in known:
                unknown_cause = unknown(f"no such cause in {setup.disturbances.name}", cause, known)
                raise spec.error(unknown_cause, ("events", event, k))
    return setup


VALUES: Mapping[str, tuple[Kind, Kind]] = FrozenMap(
    {
        "temperature": (TEMPERATURE, TEMPERATURE_DIFFERENCE),
        "attitude": (ANGLE, ANGLE),
        "focus": (LENGTH, LENGTH),
        "input": (TEMPERATURE, TEMPERATURE_DIFFERENCE),
    }
)
"""Kind of reading that is a number in a table -> kinds of quantity (which fix the units) of the number and of its
sigma.
"""
MOVE = "move"
"""Kind of a commanded move, a number whose kind of quantity depends on the motion."""


def value_kinds(kind: str, subject: str) -> tuple[Kind, Kind]:
    """Return the kinds of quantity of a reading or move in a table, and of its sigma; raise Problem for no motion."""
    return (motion_kind(subject),) * 2 if kind == MOVE else VALUES[kind]


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
        Standard deviation of each number, with unit; for a quaternion that of the angle about each axis. It is zero for
        a move of exactly known size.
    """

    column: Heads
    unit: Text
    sigma: Text


class ReadingTableSpec(Spec):
    """Tables of readings of one format, with a row for each time.

    Attributes
    ----------
    kind : str
        Content of a row: `temperature` of bodies, `attitude` of star trackers, `focus` of cameras, `input` for the
        temperatures that a plan's terms name, `move` for commanded moves; `monitor`, `calibration` or `angle` for a row
        that refers to a run folder; or `event`.
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
    time_sigma : float
        Standard deviation of the times of moves, in seconds.
    columns : Mapping[str, ReadingColumnSpec]
        Body, star tracker, camera, input, or motion that is commanded (`base/forward/M2 shift z`) -> its columns, for
        kinds with numbers.
    name : str | None
        Head of the column with the event or the run folder, whose path is relative to the table.
    detail : str | None
        Head of the column with details of an event.
    events : Mapping[str, str]
        Name of an event in the table -> kind of event.
    """

    kind: Literal["temperature", "attitude", "focus", "input", "move", "monitor", "calibration", "angle", "event"]
    files: Reference
    form: Literal["csv", "keywords"] = "csv"
    time: Text = "time"
    time_scale: TimeScale = "UTC"
    epoch: ClockReading | None = None
    time_unit: Text = "s"
    time_sigma: Annotated[float, Quantity(MOMENT, smallest="0 s", largest="1000 h")] = 0.0
    columns: Paths[ReadingColumnSpec] = Field(default_factory=FrozenMap)
    name: Text | None = None
    detail: Text | None = None
    events: Paths[Event] = Field(default_factory=FrozenMap)

    @model_validator(mode="after")
    def _has_its_columns(self) -> ReadingTableSpec:
        numbers = self.kind in VALUES or self.kind == MOVE
        if self.time_sigma and self.kind != MOVE:
            raise Problem(f"a table of kind {self.kind} has no time_sigma", None, "kind: move", within=("time_sigma",))
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
    try:
        value, sigma = value_kinds(kind, where[-1])
    except Problem as problem:
        raise Problem(problem.problem, problem.value, problem.allowed, within=where) from None
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
    if not known > 0.0 and not (kind == MOVE and known == 0.0):
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
