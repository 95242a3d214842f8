"""Disturbances: what is expected to move and to warm up between two measurements of the monitor, and by how much.

The estimator `posterior` and the total sigmas of all others rest on this statement. It is a job's or an instrument's
`disturbances: NAME`, a file of scenes/library/disturbances or of one's own.

An error budget: an instrument, the light of its spots, and the causes whose errors are its lines.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.course import Term, moment
from scenes.specs.instrument import Frames, InstrumentSpec, Tilt
from scenes.specs.motion_text import motion_of
from scenes.yaml import units
from scenes.yaml.csv_table import rows_of
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, shown, unknown
from scenes.yaml.spec import (
    Name,
    Named,
    NothingIsEmpty,
    Number,
    Ref,
    Reference,
    Spec,
    Text,
    TitledSpec,
    Whole,
    short_for,
)
from scenes.yaml.unit_fields import Quantity, Vector

NONE = "none"
"""`disturbances: none`: nothing is stated, and sigmas are those of the noise alone."""


def _spread(kind: units.Kind, largest: str) -> Quantity:
    """A standard deviation."""
    return Quantity(kind, smallest=f"0 {kind.units[0]}", largest=largest)


def _something(value: Any) -> Any:
    if value is None:
        raise Problem("nothing stands here", "nothing", "a value; leave the key out where there is none")
    return value


STATED = BeforeValidator(_something)
"""Validator of a key that may be left out, and not be empty: an empty standard deviation is a forgotten one."""
ShiftSigma = Annotated[tuple[float, float, float], Vector(_spread(units.LENGTH, "10 mm"), alike=True)]
RotateSigma = Annotated[tuple[float, float, float], Vector(_spread(units.ANGLE, "1 deg"), alike=True)]
GradientSigma = Annotated[
    tuple[float, float, float], Vector(_spread(units.TEMPERATURE_GRADIENT, "1000 K/m"), alike=True)
]
IndexSigma = Annotated[tuple[float, float, float], Vector(_spread(units.PER_LENGTH, "1e-2 1/m"), alike=True)]
ScaleSigma = Annotated[float, _spread(units.SCALE, "1 percent")]
RadiusSigma = Annotated[float, _spread(units.SCALE, "1 percent")]
ConicSigma = Annotated[Number, Field(ge=0.0, le=1.0)]
FigureSigma = Annotated[float, _spread(units.LENGTH, "100 um")]
Span = Annotated[float, Quantity(units.MOMENT, above_zero=True, largest="1000000 h")]
Moment = Annotated[float, Quantity(units.MOMENT, smallest="-1000000 h", largest="1000000 h")]
Correlation = Annotated[Number, Field(ge=-1.0, le=1.0)]


class TemperatureSigmaSpec(Spec):
    """Standard deviations of a body's temperature field; what it does to light is worked out by the thermal model.

    Attributes
    ----------
    change : float
        Of its temperature at its origin, kelvin.
    gradient : GradientSigma
        Of each component of its gradient in the body's own frame, K/m.
    """

    change: Annotated[float, _spread(units.TEMPERATURE_DIFFERENCE, "100 K")] = 0.0
    gradient: GradientSigma = (0.0, 0.0, 0.0)


class TimeLawSpec(Spec):
    """How a disturbance goes on from one time to another; its correlation between times t and t' is

        white: 1 at the same time, 0 at any other; constant: 1.
        drift D: exp(-|t - t'| / D).  period T: cos(2 pi (t - t') / T).  Both: their product.

    The others are an amplitude of unknown size; the standard deviation is that of its size:

        trend S: (t - since) / S.  relaxation R: 1 - exp(-(t - since) / R) from `since` on, 0 before.
        event E: 1 from E on, 0 before.  jump: an event at a time that nobody knows; jump T: one in T on average.

    A trend can be multiplied by a period, a swing that grows; an event by drift and period: what sets in at a moment.

    Attributes
    ----------
    kind : Literal['white', 'constant', 'jump'] | None
        `white`, `constant` or `jump`, in place of the others.
    drift : Span | None
        Time in which it forgets where it was, seconds.
    period : Span | None
        It comes back with, seconds.
    trend : Span | None
        Time in which it grows by its standard deviation, seconds.
    relaxation : Span | None
        Time constant with which it goes to a new value, seconds.
    event : Moment | None
        When it steps, seconds.
    jump : Span | None
        Mean time between two jumps, seconds; what is too small to be found then counts in sigma.
    since : Moment | None
        When a trend or relaxation starts, seconds; 0 by default.
    """

    kind: Literal["white", "constant", "jump"] | None = None
    drift: Span | None = None
    period: Span | None = None
    trend: Span | None = None
    relaxation: Span | None = None
    event: Moment | None = None
    jump: Span | None = None
    since: Moment | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "TimeLawSpec":
        given = {name for name in _TIMES if getattr(self, name) is not None}
        if (self.kind is not None) == bool(given):
            raise Problem("no law of time", self.text, _LAWS)
        if given - {"drift", "period"} and given not in _PRODUCTS:
            allowed = "trend alone or with period, relaxation or jump alone, event alone or with drift and period"
            raise Problem("no law of time: these do not multiply", self.text, allowed)
        if self.since is not None and not {"trend", "relaxation"} & given:
            raise Problem("nothing starts then", self.text, "since beside trend or relaxation", within=("since",))
        return self

    @property
    def text(self) -> str:
        """In words."""
        parts: list[str] = [self.kind or ""]
        for name in (*_TIMES, "since"):
            time = getattr(self, name)
            parts += [f"{name} {moment(time)}"] if time is not None else []
        return ", ".join(filter(None, parts)) or "nothing"


_TIMES = ("drift", "period", "trend", "relaxation", "event", "jump")
"""Keys of a law that make it one."""
_PRODUCTS = (
    *({"trend"}, {"trend", "period"}, {"relaxation"}, {"jump"}),
    *({"event"}, {"event", "drift"}, {"event", "period"}, {"event", "drift", "period"}),
)
"""Which of them go together, beside drift and period."""
_LAWS = (
    "white, constant, jump, {drift: 6 h}, {period: 95 min}, {trend: 365 d}, {relaxation: 30 d, since: 0 h}, "
    "{event: 12 h}, {jump: 400 d}"
)
BodyPattern = Annotated[str, Field(strict=True, min_length=1, max_length=200)]
BodyPatterns = Annotated[
    tuple[BodyPattern, ...], Field(min_length=1), short_for(None, str, schema=BodyPattern | tuple[BodyPattern, ...])
]
Reason = Annotated[Text, Field(min_length=1)]
FigureSigmas = Annotated[dict[Term, FigureSigma], AfterValidator(FrozenMap)]
TimeLaw = Annotated[TimeLawSpec, short_for("kind", str, schema=Literal["white", "constant", "jump"] | TimeLawSpec)]
MOVES = ("shift", "rotate", "scale", "figure", "radius", "conic", "temperature", "index_gradient")
"""Keys of a cause that hold standard deviations."""


def _check_matrix(rows: tuple[tuple[float, ...], ...], count: int, within: KeyPath = ()) -> None:
    """Refuse rows that are no correlation matrix of ``count`` components but for its eigenvalues. Raises Problem."""
    if len(rows) != count or any(len(row) != count for row in rows):
        found = f"{len(rows)} rows of {names_text(dict.fromkeys(len(row) for row in rows)) or 'nothing'}"
        raise Problem("not a matrix of this size", found, f"{count} rows of {count} numbers", within=within)
    for i, row in enumerate(rows):
        if row[i] != 1.0:
            problem = "a correlation matrix has ones on its diagonal"
            raise Problem(problem, f"{row[i]:g}", "1", within=(*within, i, i))
        for j in range(i):
            if row[j] != rows[j][i]:
                found = f"{row[j]:g} and {rows[j][i]:g}"
                raise Problem("a correlation matrix is symmetric", found, "equal", within=(*within, i, j))


class CorrelationSpec(Spec):
    """Components of one cause that move together.

    Attributes
    ----------
    between : tuple[str, ...]
        Their names: `base/forward/M1 shift z`, `NODE rotate x`, `NODE scale`, `NODE figure Z5`, `NODE radius`, `NODE
        conic`, `NODE temperature`, `NODE gradient x`, `NODE index_gradient x`.
    correlation : Correlation | None
        Of any two of them.
    matrix : tuple[tuple[Correlation, ...], ...] | None
        Their correlation matrix, in place of one number.
    """

    between: Annotated[tuple[Annotated[str, Field(strict=True)], ...], Field(min_length=2)]
    correlation: Annotated[Correlation | None, STATED] = None
    matrix: tuple[tuple[Correlation, ...], ...] | None = None

    @model_validator(mode="after")
    def _is_a_matrix(self) -> "CorrelationSpec":
        if (self.correlation is None) == (self.matrix is None):
            raise Problem("how much do they move together?", "correlation and matrix", "one of correlation and matrix")
        if len(set(self.between)) != len(self.between):
            raise Problem("a component is named twice", ", ".join(self.between), "each once", within=("between",))
        if self.matrix is not None:
            _check_matrix(self.matrix, len(self.between), ("matrix",))
        return self

    @property
    def table(self) -> tuple[tuple[float, ...], ...]:
        """The matrix."""
        if self.matrix is not None:
            return self.matrix
        count, value = len(self.between), self.correlation
        assert value is not None
        return tuple(tuple(1.0 if i == j else value for j in range(count)) for i in range(count))


JOINT = "joint"
"""Key of components that go together, and what their cause is called."""
MOST_JOINT = 200
"""Components that go together: a config.yaml holds the matrix of their correlations."""
MOST_JOINT_BYTES = 4 << 20
"""Of a table of their correlations."""
_AXES = ("x", "y", "z")


def component_named(text: str) -> tuple[str, str, str, str]:
    """The parts of a component's name: node, kind, axis or term, and pivot; parts that are not there are empty.

    Parameters
    ----------
    text : str
        ``NODE KIND [AXIS] [about PIVOT]``, as the names of ``CorrelationSpec``.

    Raises
    ------
    Problem
        It is not of this form.
    """
    words = text.split()
    if len(words) > 1 and words[1] == "index_gradient":  # no perturbation of a job
        if len(words) != 3 or words[2] not in _AXES:
            raise Problem("not a component", shown(text), "NODE index_gradient x, y or z")
        return words[0], words[1], words[2], ""
    node, kind, axis, amount, pivot = motion_of(text)
    if amount:
        raise Problem("a component has no amount in its name", shown(amount), shown(text.partition(f" {amount}")[0]))
    return node, kind, axis, pivot


_SPREADS: Mapping[str, Quantity] = {
    "shift": _spread(units.LENGTH, "10 mm"),
    "rotate": _spread(units.ANGLE, "1 deg"),
    "scale": _spread(units.SCALE, "1 percent"),
    "radius": _spread(units.SCALE, "1 percent"),
    "figure": _spread(units.LENGTH, "100 um"),
    "temperature": _spread(units.TEMPERATURE_DIFFERENCE, "100 K"),
    "gradient": _spread(units.TEMPERATURE_GRADIENT, "1000 K/m"),
    "index_gradient": _spread(units.PER_LENGTH, "1e-2 1/m"),
}
"""Kind of component -> its standard deviation."""
_PURE: Mapping[str, float] = {"conic": 1.0, "index": 0.1}
"""Kind that is a pure number -> its largest standard deviation."""


def _sigma_of(name: str, value: Any) -> float:
    """A standard deviation of a component, SI. Raises Problem."""
    kind = component_named(name)[1]
    if kind not in _PURE:
        return _SPREADS[kind].parse(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= _PURE[kind]:
        allowed = f"a plain number from 0 to {_PURE[kind]:g}"
        raise Problem(f"not a standard deviation of a change of the {kind}", shown(value), allowed)
    return float(value)


def _components(value: Any) -> Any:
    if not isinstance(value, Mapping) or not value:
        raise Problem("no components", shown(value), '{"base/forward/M2 shift z": 3 um, ...}')
    if len(value) > MOST_JOINT:
        raise Problem("too many components", f"{len(value)} of them", f"at most {MOST_JOINT}, those that matter most")
    out: dict[str, float] = {}
    said: dict[tuple[str, str, str], str] = {}
    for name, sigma in value.items():
        try:
            out[name] = _sigma_of(str(name), sigma)
            parts = component_named(name)[:3]
            if parts in said:
                raise Problem("a component is named twice", shown(name), f"once; it is {said[parts]} as well")
            said[parts] = name
        except Problem as wrong:
            raise wrong.below(name) from None
    return out


def written_sigma(name: str, sigma: float) -> str | float:
    """A standard deviation of a component, SI, as a file has it.

    Parameters
    ----------
    name : str
        Of the component.
    sigma : float
        Its standard deviation.
    """
    kind = component_named(name)[1]
    return sigma if kind in _PURE else _SPREADS[kind].format(sigma)


def _written(value: Mapping[str, float]) -> dict[str, str | float]:
    return {name: written_sigma(name, sigma) for name, sigma in value.items()}


JointSigmas = Annotated[
    dict[str, float],
    BeforeValidator(_components, json_schema_input_type=dict[str, str | float]),
    AfterValidator(FrozenMap),
    PlainSerializer(_written, when_used="json"),
]


class JointSpec(Spec):
    """Components of bodies that go together, with a standard deviation each and one matrix of correlations: for example
    what an estimate of an instrument's state leaves unknown.

    Attributes
    ----------
    components : JointSigmas
        Name -> standard deviation with its unit, a plain number for `conic` and `index`. Names are those of
        `correlations`, also `NODE index`; after a shift, a turn or a scale, `about PIVOT` names another pivot than the
        body's centre, or its origin where it has none.
    correlation : tuple[tuple[Correlation, ...], ...] | None
        Their correlation matrix, rows in the order of the components; independent without it.
    correlation_file : Reference | None
        a CSV file with the matrix in its place, and the names of the components as heads.
    time : TimeLaw
        How they go on in a series of measurements.
    reason : Reason
        Where the numbers come from.
    """

    components: JointSigmas
    correlation: tuple[tuple[Correlation, ...], ...] | None = None
    correlation_file: Reference | None = None
    time: TimeLaw = TimeLawSpec.model_construct(kind="constant")
    reason: Reason

    @model_validator(mode="after")
    def _is_a_matrix(self) -> "JointSpec":
        if self.correlation is not None and self.correlation_file is not None:
            raise Problem("two matrices of correlations", "correlation and correlation_file", "one of them")
        if self.correlation is not None:
            _check_matrix(self.correlation, len(self.components), ("correlation",))
        return self

    def with_table(self) -> "JointSpec":
        """The same with the matrix of its file in it.

        Raises
        ------
        InputError
            The file cannot be read, or is no correlation matrix of these components.
        """
        assert self.correlation_file is not None
        key = ("correlation_file",)
        path = self.file_at(key, self.correlation_file, Path(self.source.file).parent, "a CSV file")
        rows = rows_of(path, MOST_JOINT_BYTES)
        names = tuple(self.components)
        heads = tuple(cell.strip() for cell in rows[0][1]) if rows else ()
        line = rows[0][0] if rows else None
        if sorted(heads) != sorted(names):
            strange = [head for head in heads if head not in names]
            missing = [name for name in names if name not in heads]
            found = f"{names_text(strange[:3])} among the heads" if strange else f"no column {names_text(missing[:3])}"
            found = found if strange or missing else "a column that stands twice"
            problem = f"not the components of {self.source.file or 'the file of disturbances'}"
            raise InputError(Issue(problem, str(path), line, (), found, f"their {len(names)} names, each once"))
        order = [heads.index(name) for name in names]
        table = [self._row(path, *row, len(names)) for row in rows[1:]]
        if len(table) != len(names):
            problem, found = "not a matrix of this size", f"{len(table)} rows"
            raise InputError(Issue(problem, str(path), None, (), found, f"a row for each of the {len(names)} heads"))
        matrix = tuple(tuple(table[i][j] for j in order) for i in order)
        try:
            _check_matrix(matrix, len(names))
        except Problem as wrong:
            row, column = (int(k) for k in wrong.within)
            where = f"{names[row]}, {names[column]}"
            at = rows[1 + order[row]][0]
            raise InputError(Issue(wrong.problem, str(path), at, (where,), wrong.found, wrong.allowed)) from None
        return self.model_copy(update={"correlation": matrix, "correlation_file": None})

    @staticmethod
    def _row(path: Path, line: int, cells: list[str], count: int) -> list[float]:
        """A row of correlations. Raises InputError."""
        allowed = f"{count} numbers from -1 to 1"
        if len(cells) != count:
            raise InputError(Issue("not a row of this table", str(path), line, (), f"{len(cells)} cells", allowed))
        out = []
        for cell in cells:
            try:
                value = float(cell)
            except ValueError:
                value = math.nan
            if not -1.0 <= value <= 1.0:
                raise InputError(Issue("not a correlation", str(path), line, (), shown(cell), allowed))
            out.append(value)
        return out


class _CauseWords(Spec):
    """What may be said of a cause."""

    bodies: Annotated[BodyPatterns | None, STATED] = None
    shift: Annotated[ShiftSigma | None, STATED] = None
    rotate: Annotated[RotateSigma | None, STATED] = None
    scale: Annotated[ScaleSigma | None, STATED] = None
    figure: Annotated[FigureSigmas | None, STATED] = None
    radius: Annotated[RadiusSigma | None, STATED] = None
    conic: Annotated[ConicSigma | None, STATED] = None
    temperature: Annotated[TemperatureSigmaSpec | None, STATED] = None
    index_gradient: Annotated[IndexSigma | None, STATED] = None
    pivot: Annotated[Name | None, STATED] = None
    together: Annotated[Correlation | None, STATED] = None
    correlations: Annotated[tuple[CorrelationSpec, ...] | None, STATED] = None
    time: Annotated[TimeLaw | None, STATED] = None
    reason: Annotated[Reason | None, STATED] = None


class CauseSpec(_CauseWords):
    """One cause of change: its bodies and the standard deviation of each component of each of their motions. Components
    are independent of each other unless it says otherwise.

    Attributes
    ----------
    bodies : BodyPatterns
        Node paths; `*` stands for one part of a path or a piece of it (`base/*/M?` are all mirrors), `<camera>` for the
        name of a camera (`base/<camera>`).
    shift
        Of the bodies in their own frames, metres.
    rotate
        About the pivot, radians.
    scale
        Relative growth of a camera and all in it.
    figure
        Zernike term (Noll) -> of the surface error, metres.
    radius
        Relative, of the vertex radius of curvature of a mirror or face.
    conic
        Of its conic constant, a pure number.
    temperature
        Of the bodies' temperature fields.
    index_gradient
        Of the refractive index in a prism, 1/m, other than by heat.
    pivot
        Of turns and growth; by default the body's centre if it has one, else its origin.
    together
        Correlation of the same component of any two of the bodies.
    correlations : tuple[CorrelationSpec, ...]
        Of single components.
    time : TimeLaw
        How it goes on in a series of measurements.
    reason : Reason
        Where the numbers come from.
    """

    bodies: BodyPatterns
    correlations: tuple[CorrelationSpec, ...] = ()
    time: TimeLaw = TimeLawSpec.model_construct(kind="white")
    reason: Reason

    @model_validator(mode="after")
    def _moves_something(self) -> "CauseSpec":
        if all(getattr(self, name) is None for name in MOVES):
            raise Problem("a cause without any standard deviation", "none", f"at least one of {', '.join(MOVES)}")
        return self


class CauseChangeSpec(_CauseWords):
    """What a job says of a cause in place of the disturbances file, number by number; a cause that the file does not
    have needs all that a cause needs.

    Attributes
    ----------
    bodies, shift, rotate, scale, figure, radius, conic, temperature, index_gradient
        As of a cause.
    pivot, together, correlations, time, reason
        As of a cause.
    """

    @property
    def given(self) -> Mapping[str, Any]:
        """What it says."""
        return {name: getattr(self, name) for name in self.model_fields_set if getattr(self, name) is not None}

    def made_to(self, cause: CauseSpec) -> CauseSpec:
        """The cause with this change; what it does not say stays, of figures term by term and of temperatures number
        by number.
        """
        update = dict(self.given)
        if self.figure is not None and cause.figure is not None:
            update["figure"] = FrozenMap({**cause.figure, **self.figure})
        if self.temperature is not None and cause.temperature is not None:
            own = {name: getattr(self.temperature, name) for name in self.temperature.model_fields_set}
            update["temperature"] = cause.temperature.model_copy(update=own)
        return cause.model_copy(update=update)


class DisturbancesSpec(TitledSpec):
    """What is expected to change between the nominal measurement and a later one.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    sigmas : Number
        How many standard deviations every number of the file is; 3 for a list of 3-sigma values.
    causes : Named[CauseSpec]
        By name.
    joint : JointSpec | None
        Components of bodies, each by its name, that go together as an estimate of them does; besides the causes, or in
        their place.
    jump_false_alarm : Number | None
        Chance that a series in which nothing jumps has a jump reported, over all its times and all components whose law
        in time is `jump`; 0.001 by default.
    """

    sigmas: Annotated[Number, Field(gt=0.0, le=10.0)] = 1.0
    causes: Named[CauseSpec] = Field(default_factory=FrozenMap)
    joint: JointSpec | None = None
    jump_false_alarm: Annotated[Number, Field(gt=0.0, le=0.5)] | None = None

    @model_validator(mode="after")
    def _states_something(self) -> "DisturbancesSpec":
        if not self.causes and self.joint is None:
            raise Problem("nothing is stated to move", "no cause", "causes: at least one; or joint", within=("causes",))
        if self.joint is not None and JOINT in self.causes:
            text = "the components of the file's own `joint` are called so"
            raise Problem(text, JOINT, "another name of the cause", within=("causes", JOINT))
        return self

    def with_tables(self) -> "DisturbancesSpec":
        """The statement with the correlations of the file that its `joint` names. Raises InputError: it is none."""
        if self.joint is None or self.joint.correlation_file is None:
            return self
        return self.model_copy(update={"joint": self.joint.with_table()})

    def changed(self, changes: "JobDisturbancesSpec") -> "DisturbancesSpec":
        """Return the statement with a job's changes made.

        Raises
        ------
        InputError
            It leaves out a cause that is not there, or adds one that is not complete.
        """
        causes = dict(self.causes)
        for k, name in enumerate(changes.without):
            if name not in causes:
                raise changes.error(unknown(f"no such cause in {self.name}", name, self.causes), ("without", k))
            del causes[name]
        for name, change in changes.causes.items():
            if name == JOINT and self.joint is not None:
                text = "the components of the file's `joint` stand one by one, and not by causes"
                raise changes.error(text, ("causes", name), allowed="another file of disturbances")
            if name in causes:
                causes[name] = change.made_to(causes[name])
                continue
            missing = [key for key in ("bodies", "reason") if key not in change.given]
            if missing or not any(key in change.given for key in MOVES):
                new = f"a new one with bodies, a reason and one of {names_text(MOVES)}"
                allowed = f"a change of {names_text(self.causes)}; or {new}"
                wrong = unknown(f"no such cause in {self.name}", name, self.causes, allowed=allowed)
                raise changes.error(wrong, ("causes", name))
            # of checked parts: to validate them again would ask for quantities as text
            causes[name] = CauseSpec.model_construct(**change.given)
        if not causes and self.joint is None:
            raise changes.error("no cause is left", ("without",), allowed="`disturbances: none` for none at all")
        return self.model_copy(update={"causes": FrozenMap(causes)})


class JobDisturbancesSpec(Spec):
    """Which disturbances a job's sigmas rest on.

    Attributes
    ----------
    file : Ref | None
        Name of a file in scenes/library/disturbances, or path of one's own; the instrument's by default; `none` for
        none at all.
    causes : Named[CauseChangeSpec]
        What is to be said instead of, or besides, the causes of the file, in as many standard deviations as the file's
        own numbers.
    without : tuple[Name, ...]
        Causes of the file that are left out.
    """

    file: Ref | None = None
    causes: Named[CauseChangeSpec] = Field(default_factory=FrozenMap)
    without: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _each_once(self) -> "JobDisturbancesSpec":
        for k, name in enumerate(self.without):
            if name in self.without[:k]:
                raise Problem("a cause is left out twice", shown(name), "each once", within=("without", k))
            if name in self.causes:
                text = "a cause is both changed and left out"
                raise Problem(text, shown(name), "one of both", within=("without", k))
        return self


def _as_file(value: Any) -> Any:
    """A file's name, or what it says, stands for the file."""
    return {"file": value} if isinstance(value, str) or (isinstance(value, Mapping) and "name" in value) else value


JobDisturbances = Annotated[
    JobDisturbancesSpec,
    BeforeValidator(_as_file, json_schema_input_type=Reference | JobDisturbancesSpec | DisturbancesSpec),
]
"""With its keys, the file's name alone, as `disturbances: orbit`, or what such a file says."""


AngleErrors = Annotated[
    dict[Name, Annotated[dict[Name, Tilt], AfterValidator(FrozenMap)]], NothingIsEmpty, AfterValidator(FrozenMap)
]


class ErrorBudgetSpec(Spec):
    """An error budget.

    Attributes
    ----------
    description : Text
        For people.
    instrument : Ref
        Which, by name or path.
    photons_per_frame : Number
        Light of one spot in one frame; weak, as noise of the centroid is a line.
    frames : Frames
        Averaged in one measurement.
    trials : Whole
        Number of random states for each line.
    all_together : Whole
        Number of random states with all causes at once.
    angle_errors : AngleErrors
        Prism (prism_180 or prism_0) -> face -> tilt about its x and y, as made.
    disturbances : Ref
        What changes, and by how much: a file of scenes/library/disturbances or of one's own. Each of its causes is a
        line.
    """

    description: Text = ""
    instrument: Ref
    photons_per_frame: Annotated[Number, Field(gt=0.0, le=1e12)]
    frames: Frames = 9
    trials: Annotated[Whole, Field(ge=20, le=100_000)] = 100
    all_together: Annotated[Whole, Field(ge=20, le=100_000)] = 300
    angle_errors: AngleErrors
    disturbances: Ref

    def applied_to(self, instrument: InstrumentSpec) -> InstrumentSpec:
        """The instrument with this budget's angle errors and light."""
        monitor = instrument.autocollimator
        changed = {
            prism: getattr(monitor, prism).model_copy(update={"angle_errors": errors})
            for prism, errors in self.angle_errors.items()
        }
        reticle = monitor.reticle.model_copy(update={"photons_per_frame": self.photons_per_frame})
        copied = monitor.model_copy(update={**changed, "reticle": reticle})
        return instrument.model_copy(update={"monitor": copied})
