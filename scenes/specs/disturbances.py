"""Disturbances: motions and temperature changes expected between two measurements of the monitor, with their sigmas.

They are the prior of the estimator `posterior` and of the total sigmas of all others. A job or an instrument refers to
them by `disturbances: NAME`, a file of scenes/library/disturbances or of the user.

An error budget has an instrument, the light of its spots, and the causes whose errors are its lines.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.course import Term, moment
from scenes.specs.instrument import Frames, InstrumentSpec, Tilt
from scenes.specs.perturbation import motion_of
from scenes.yaml import spec, units
from scenes.yaml.csv_table import rows_of
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, shown, unknown
from scenes.yaml.unit_fields import Quantity, Vector

NONE = "none"
"""Value of `disturbances: none`: no disturbances, so that sigmas are those of the noise alone."""


def _spread(kind: units.Kind, largest: str) -> Quantity:
    """Return the field type of a standard deviation: a quantity of a kind with a largest value."""
    return Quantity(kind, smallest=f"0 {kind.units[0]}", largest=largest)


def _something(value: Any) -> Any:
    if value is None:
        raise Problem("the value is empty", "nothing", "a value; omit the key if there is none")
    return value


NOT_EMPTY = BeforeValidator(_something)
"""Validator of an optional key that must not be empty: an empty standard deviation is a forgotten one."""
ShiftSigma = Annotated[tuple[float, float, float], Vector(_spread(units.LENGTH, "10 mm"), alike=True)]
RotateSigma = Annotated[tuple[float, float, float], Vector(_spread(units.ANGLE, "1 deg"), alike=True)]
GradientSigma = Annotated[
    tuple[float, float, float], Vector(_spread(units.TEMPERATURE_GRADIENT, "1000 K/m"), alike=True)
]
IndexSigma = Annotated[tuple[float, float, float], Vector(_spread(units.PER_LENGTH, "1e-2 1/m"), alike=True)]
ScaleSigma = Annotated[float, _spread(units.SCALE, "1 percent")]
RadiusSigma = Annotated[float, _spread(units.SCALE, "1 percent")]
ConicSigma = Annotated[spec.Number, Field(ge=0.0, le=1.0)]
FigureSigma = Annotated[float, _spread(units.LENGTH, "100 um")]
Span = Annotated[float, Quantity(units.MOMENT, above_zero=True, largest="1000000 h")]
Moment = Annotated[float, Quantity(units.MOMENT, smallest="-1000000 h", largest="1000000 h")]
Correlation = Annotated[spec.Number, Field(ge=-1.0, le=1.0)]


class TemperatureSigmaSpec(spec.Spec):
    """Standard deviations of a body's temperature field. The thermal model computes their effect on the light.

    Attributes
    ----------
    change : float
        Standard deviation of the temperature at the body's origin, in kelvin.
    gradient : tuple[float, float, float]
        Standard deviation of each component of the temperature gradient in the body's frame, in K/m.
    """

    change: Annotated[float, _spread(units.TEMPERATURE_DIFFERENCE, "100 K")] = 0.0
    gradient: GradientSigma = (0.0, 0.0, 0.0)


class TimeLawSpec(spec.Spec):
    """Time law of a disturbance in a series of measurements: how its values at different times are related.

    Laws of random processes, by the correlation of the values at two times t and t':

    - white: 1 at the same time, 0 at any other; constant: 1
    - drift D: exp(-|t - t'| / D), with D the value of the key `drift`
    - period P: cos(2 pi (t - t') / P); together with a drift, the product of both

    Laws of functions of the time t with a random amplitude, whose standard deviation is that of the disturbance:

    - trend S: (t - since) / S
    - relaxation R: 1 - exp(-(t - since) / R) from `since` on, 0 before
    - event E: 1 from the time E on, 0 before
    - jump: an event at an unknown time; jump J: one in a time J on average

    A trend can be multiplied by a period (a growing oscillation), an event by drift and period (a disturbance that
    begins at a known time).

    Attributes
    ----------
    kind : {'white', 'constant', 'jump'} | None
        Law without parameter, instead of the other keys: `white`, independent at every time; `constant`; or `jump`, a
        step at an unknown time.
    drift : float | None
        Correlation time, in seconds: the correlation decays exponentially.
    period : float | None
        Period of an oscillation, in seconds.
    trend : float | None
        Time in which a linear trend grows by its standard deviation, in seconds.
    relaxation : float | None
        Time constant of the exponential approach to a new value, in seconds.
    event : float | None
        Time of a step, in seconds.
    jump : float | None
        Mean time between two jumps, in seconds; jumps below the detection threshold contribute to sigma.
    since : float | None
        Time at which a trend or relaxation starts, in seconds; 0 by default.
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
    def _check_single_law(self) -> "TimeLawSpec":
        keys = {name for name in _TIMES if getattr(self, name) is not None}
        if (self.kind is not None) == bool(keys):
            raise Problem("not a time law", self.text, _LAWS)
        if keys - {"drift", "period"} and keys not in _PRODUCTS:
            allowed = "trend alone or with period, relaxation or jump alone, event alone or with drift and period"
            raise Problem("not a time law: these cannot be multiplied", self.text, allowed)
        if self.since is not None and not {"trend", "relaxation"} & keys:
            raise Problem("only trend and relaxation have a start", self.text, "trend or relaxation", within=("since",))
        return self

    @property
    def text(self) -> str:
        """Time law in words, for messages and reports."""
        parts: list[str] = [self.kind or ""]
        for name in (*_TIMES, "since"):
            time = getattr(self, name)
            parts += [f"{name} {moment(time)}"] if time is not None else []
        return ", ".join(filter(None, parts)) or "nothing"


_TIMES = ("drift", "period", "trend", "relaxation", "event", "jump")
"""Keys of `time:` that define a time law."""
_PRODUCTS = (
    *({"trend"}, {"trend", "period"}, {"relaxation"}, {"jump"}),
    *({"event"}, {"event", "drift"}, {"event", "period"}, {"event", "drift", "period"}),
)
"""Combinations of keys of `time:` that are allowed, besides drift with period."""
_LAWS = (
    "white, constant, jump, {drift: 6 h}, {period: 95 min}, {trend: 365 d}, {relaxation: 30 d, since: 0 h}, "
    "{event: 12 h}, {jump: 400 d}"
)
BodyPattern = Annotated[str, Field(strict=True, min_length=1, max_length=200)]
BodyPatterns = Annotated[
    tuple[BodyPattern, ...],
    Field(min_length=1),
    spec.short_for(None, str, schema=BodyPattern | tuple[BodyPattern, ...]),
]
Reason = Annotated[spec.Text, Field(min_length=1)]
FigureSigmas = Annotated[dict[Term, FigureSigma], AfterValidator(FrozenMap)]
TimeLaw = Annotated[TimeLawSpec, spec.short_for("kind", str, schema=Literal["white", "constant", "jump"] | TimeLawSpec)]
MOVES = ("shift", "rotate", "scale", "figure", "radius", "conic", "temperature", "index_gradient")
"""Keys of a cause that hold standard deviations of motions and changes."""


def _check_matrix(rows: tuple[tuple[float, ...], ...], count: int, within: KeyPath = ()) -> None:
    """Raise `Problem` unless rows form a correlation matrix of ``count`` components; eigenvalues are not checked."""
    if len(rows) != count or any(len(row) != count for row in rows):
        value = f"{len(rows)} rows of {names_text(dict.fromkeys(len(row) for row in rows)) or 'nothing'}"
        raise Problem("not a matrix of this size", value, f"{count} rows of {count} numbers", within=within)
    for i, row in enumerate(rows):
        if row[i] != 1.0:
            problem = "a correlation matrix has ones on its diagonal"
            raise Problem(problem, f"{row[i]:g}", "1", within=(*within, i, i))
        for j in range(i):
            if row[j] != rows[j][i]:
                value = f"{row[j]:g} and {rows[j][i]:g}"
                raise Problem("a correlation matrix is symmetric", value, "equal", within=(*within, i, j))


class CorrelationSpec(spec.Spec):
    """Correlated components of a cause.

    Attributes
    ----------
    between : tuple[str, ...]
        Names of the components: `base/forward/M1 shift z`, `NODE rotate x`, `NODE scale`, `NODE figure Z5`, `NODE
        radius`, `NODE conic`, `NODE temperature`, `NODE gradient x`, `NODE index_gradient x`.
    correlation : float | None
        Correlation of any two of them.
    matrix : tuple[tuple[float, ...], ...] | None
        Correlation matrix of the components, instead of one number.
    """

    between: Annotated[tuple[Annotated[str, Field(strict=True)], ...], Field(min_length=2)]
    correlation: Annotated[Correlation | None, NOT_EMPTY] = None
    matrix: tuple[tuple[Correlation, ...], ...] | None = None

    @model_validator(mode="after")
    def _is_a_matrix(self) -> "CorrelationSpec":
        if (self.correlation is None) == (self.matrix is None):
            raise Problem("the correlation must be given once", "correlation and matrix", "one of them")
        if len(set(self.between)) != len(self.between):
            raise Problem("a component is named twice", ", ".join(self.between), "each once", within=("between",))
        if self.matrix is not None:
            _check_matrix(self.matrix, len(self.between), ("matrix",))
        return self

    @property
    def table(self) -> tuple[tuple[float, ...], ...]:
        """Correlation matrix of the components, also where the file gives a single correlation."""
        if self.matrix is not None:
            return self.matrix
        count, value = len(self.between), self.correlation
        assert value is not None
        return tuple(tuple(1.0 if i == j else value for j in range(count)) for i in range(count))


JOINT = "joint"
"""Key of the jointly distributed components, and name of their cause."""
MOST_JOINT = 200
"""Largest number of joint components: a config.yaml holds the matrix of their correlations."""
MOST_JOINT_BYTES = 4 << 20
"""Largest size of a file with the correlations of joint components, in bytes."""
_AXES = ("x", "y", "z")


def component_parts(text: str) -> tuple[str, str, str, str]:
    """Return the parts of a component's name: node, kind, axis or term, and pivot; missing parts are empty.

    Parameters
    ----------
    text : str
        Name of the form ``NODE KIND [AXIS] [about PIVOT]``, as in ``CorrelationSpec``.

    Raises
    ------
    Problem
        The text is not of this form.
    """
    words = text.split()
    if len(words) > 1 and words[1] == "index_gradient":  # a job cannot perturb it, so motion_of does not know it
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
"""Kind of component -> annotation of its standard deviation."""
_PURE: Mapping[str, float] = {"conic": 1.0, "index": 0.1}
"""Kind of component that is a pure number -> its largest standard deviation."""


def _sigma_of(name: str, value: Any) -> float:
    """Return the standard deviation of a component in the SI unit; raise `Problem` for another value."""
    kind = component_parts(name)[1]
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
        raise Problem("too many components", f"{len(value)} of them", f"at most {MOST_JOINT}, the most important ones")
    out: dict[str, float] = {}
    names: dict[tuple[str, str, str], str] = {}
    for name, sigma in value.items():
        try:
            out[name] = _sigma_of(str(name), sigma)
            parts = component_parts(name)[:3]
            if parts in names:
                raise Problem("a component is named twice", shown(name), f"once; it is also named {names[parts]}")
            names[parts] = name
        except Problem as wrong:
            raise wrong.below(name) from None
    return out


def written_sigma(name: str, sigma: float) -> str | float:
    """Return the standard deviation of a component in the form of a file.

    Parameters
    ----------
    name : str
        Name of the component.
    sigma : float
        Standard deviation in the SI unit.
    """
    kind = component_parts(name)[1]
    return sigma if kind in _PURE else _SPREADS[kind].format(sigma)


def _written(value: Mapping[str, float]) -> dict[str, str | float]:
    return {name: written_sigma(name, sigma) for name, sigma in value.items()}


JointSigmas = Annotated[
    dict[str, float],
    BeforeValidator(_components, json_schema_input_type=dict[str, str | float]),
    AfterValidator(FrozenMap),
    PlainSerializer(_written, when_used="json"),
]


class JointSpec(spec.Spec):
    """Components of bodies with a joint distribution: a standard deviation for each and one correlation matrix.

    An example is the remaining uncertainty of an estimate of an instrument's state.

    Attributes
    ----------
    components : dict[str, float]
        Name of a component -> standard deviation with its unit, or a plain number for `conic` and `index`. Names are
        those of `correlations`, and `NODE index`; after a shift, a rotation or a scale, `about PIVOT` selects a pivot
        other than the default, which is the body's centre if it has one, else its origin.
    correlation : tuple[tuple[float, ...], ...] | None
        Correlation matrix with rows in the order of the components; by default they are independent.
    correlation_file : str | None
        CSV file with the matrix and the names of the components as heads, instead of `correlation`.
    time : TimeLawSpec
        Time law of the components in a series of measurements.
    reason : str
        Source of the numbers.
    """

    components: JointSigmas
    correlation: tuple[tuple[Correlation, ...], ...] | None = None
    correlation_file: spec.Reference | None = None
    time: TimeLaw = TimeLawSpec.model_construct(kind="constant")
    reason: Reason

    @model_validator(mode="after")
    def _is_a_matrix(self) -> "JointSpec":
        if self.correlation is not None and self.correlation_file is not None:
            raise Problem("two correlation matrices", "correlation and correlation_file", "one of them")
        if self.correlation is not None:
            _check_matrix(self.correlation, len(self.components), ("correlation",))
        return self

    def with_table(self) -> "JointSpec":
        """Return the specification with the correlation matrix of its file.

        Raises
        ------
        InputError
            The file cannot be read, or is not a correlation matrix of these components.
        """
        assert self.correlation_file is not None
        key = ("correlation_file",)
        path = self.file_at(key, self.correlation_file, Path(self.source.file).parent, "a CSV file")
        rows = rows_of(path, MOST_JOINT_BYTES)
        names = tuple(self.components)
        heads = tuple(cell.strip() for cell in rows[0][1]) if rows else ()
        line = rows[0][0] if rows else None
        if sorted(heads) != sorted(names):
            extra = [head for head in heads if head not in names]
            missing = [name for name in names if name not in heads]
            value = f"{names_text(extra[:3])} among the heads" if extra else f"no column {names_text(missing[:3])}"
            value = value if extra or missing else "a repeated column"
            problem = f"not the components of {self.source.file or 'the file of disturbances'}"
            raise InputError(Issue(problem, str(path), line, (), value, f"their {len(names)} names, each once"))
        order = [heads.index(name) for name in names]
        table = [self._row(path, *row, len(names)) for row in rows[1:]]
        if len(table) != len(names):
            problem, value = "not a matrix of this size", f"{len(table)} rows"
            raise InputError(Issue(problem, str(path), None, (), value, f"a row for each of the {len(names)} heads"))
        matrix = tuple(tuple(table[i][j] for j in order) for i in order)
        try:
            _check_matrix(matrix, len(names))
        except Problem as wrong:
            row, column = (int(k) for k in wrong.within)
            where = f"{names[row]}, {names[column]}"
            at = rows[1 + order[row]][0]
            raise InputError(Issue(wrong.problem, str(path), at, (where,), wrong.value, wrong.allowed)) from None
        return self.model_copy(update={"correlation": matrix, "correlation_file": None})

    @staticmethod
    def _row(path: Path, line: int, cells: list[str], count: int) -> list[float]:
        """Return the numbers in a row of the correlation table; raise `InputError` if one is not a correlation."""
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


class _CauseKeys(spec.Spec):
    """Keys that a cause in a disturbances file may have, all optional."""

    bodies: Annotated[BodyPatterns | None, NOT_EMPTY] = None
    shift: Annotated[ShiftSigma | None, NOT_EMPTY] = None
    rotate: Annotated[RotateSigma | None, NOT_EMPTY] = None
    scale: Annotated[ScaleSigma | None, NOT_EMPTY] = None
    figure: Annotated[FigureSigmas | None, NOT_EMPTY] = None
    radius: Annotated[RadiusSigma | None, NOT_EMPTY] = None
    conic: Annotated[ConicSigma | None, NOT_EMPTY] = None
    temperature: Annotated[TemperatureSigmaSpec | None, NOT_EMPTY] = None
    index_gradient: Annotated[IndexSigma | None, NOT_EMPTY] = None
    pivot: Annotated[spec.Name | None, NOT_EMPTY] = None
    together: Annotated[Correlation | None, NOT_EMPTY] = None
    correlations: Annotated[tuple[CorrelationSpec, ...] | None, NOT_EMPTY] = None
    time: Annotated[TimeLaw | None, NOT_EMPTY] = None
    reason: Annotated[Reason | None, NOT_EMPTY] = None


class CauseSpec(_CauseKeys):
    """Cause of change, such as the launch: its bodies, and the standard deviations of their motions and changes.

    Components are independent unless `together` or `correlations` say otherwise.

    Attributes
    ----------
    bodies : tuple[str, ...]
        Node paths, in which `*` stands for one part of a path or a piece of it (`base/*/M?` are all mirrors), and
        `<camera>` for the name of a camera (`base/<camera>`).
    shift
        Standard deviation of the shift along each axis of the body's frame, in metres.
    rotate
        Standard deviation of the rotation about each axis through the pivot, in radians.
    scale
        Standard deviation of the relative change of scale of a camera and all in it.
    figure
        Zernike term (Noll) -> standard deviation of the surface error, in metres.
    radius
        Standard deviation of the relative change of the vertex radius of curvature of a mirror or face.
    conic
        Standard deviation of the change of its conic constant, a pure number.
    temperature
        Standard deviations of the body's temperature field.
    index_gradient
        Standard deviation of the gradient of the refractive index in a prism from other causes than heat, in 1/m.
    pivot
        Pivot of rotation and scale; by default the body's centre if it has one, else its origin.
    together
        Correlation of the same component of any two of the bodies; by default they are independent.
    correlations : tuple[CorrelationSpec, ...]
        Correlations of single components.
    time : TimeLawSpec
        Time law in a series of measurements.
    reason : str
        Source of the numbers.
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


class CauseChangeSpec(_CauseKeys):
    """Change, made by a job, of a cause in the disturbances file; only the keys given are replaced.

    A cause that the file does not have needs all keys that a cause needs.

    Attributes
    ----------
    bodies, shift, rotate, scale, figure, radius, conic, temperature, index_gradient
        New value of this key, with the meaning and the unit that it has in a cause of the file.
    pivot, together, correlations, time, reason
        New value of this key, with the meaning and the unit that it has in a cause of the file.
    """

    @property
    def set_keys(self) -> Mapping[str, Any]:
        """Key of the cause -> its new value, for the keys that the job sets."""
        return {name: getattr(self, name) for name in self.model_fields_set if getattr(self, name) is not None}

    def apply_to(self, cause: CauseSpec) -> CauseSpec:
        """Return the cause with this change.

        Other keys stay unchanged; figures are merged term by term, and temperatures number by number.
        """
        update = dict(self.set_keys)
        if self.figure is not None and cause.figure is not None:
            update["figure"] = FrozenMap({**cause.figure, **self.figure})
        if self.temperature is not None and cause.temperature is not None:
            changed = {name: getattr(self.temperature, name) for name in self.temperature.model_fields_set}
            update["temperature"] = cause.temperature.model_copy(update=changed)
        return cause.model_copy(update=update)


class DisturbancesSpec(spec.TitledSpec):
    """Disturbances: changes that are expected between the nominal measurement and a later one.

    Attributes
    ----------
    sigmas : float
        Number of standard deviations that each value of the file represents; 3 for a list of 3-sigma values.
    causes : Mapping[str, CauseSpec]
        Name -> cause of change.
    joint : JointSpec | None
        Named components of bodies with a joint distribution, such as the result of an estimate; besides the causes or
        in their place.
    jump_false_alarm : float | None
        Probability that a jump is reported in a series without one, over all its times and all components whose time
        law is `jump`; 0.001 by default.
    """

    sigmas: Annotated[spec.Number, Field(gt=0.0, le=10.0)] = 1.0
    causes: spec.Named[CauseSpec] = Field(default_factory=FrozenMap)
    joint: JointSpec | None = None
    jump_false_alarm: Annotated[spec.Number, Field(gt=0.0, le=0.5)] | None = None

    @model_validator(mode="after")
    def _states_something(self) -> "DisturbancesSpec":
        if not self.causes and self.joint is None:
            raise Problem("there are no disturbances", "no cause", "causes: at least one; or joint", within=("causes",))
        if self.joint is not None and JOINT in self.causes:
            text = "this name is reserved for the components of `joint`"
            raise Problem(text, JOINT, "another name for the cause", within=("causes", JOINT))
        return self

    def with_tables(self) -> "DisturbancesSpec":
        """Return the disturbances with the correlation matrix of the file of `joint`.

        Raises InputError if it is invalid.
        """
        if self.joint is None or self.joint.correlation_file is None:
            return self
        return self.model_copy(update={"joint": self.joint.with_table()})

    def changed(self, changes: "JobDisturbancesSpec") -> "DisturbancesSpec":
        """Return the disturbances with a job's changes.

        Raises
        ------
        InputError
            The job excludes a cause that does not exist, or adds an incomplete one.
        """
        causes = dict(self.causes)
        for k, name in enumerate(changes.without):
            if name not in causes:
                raise changes.error(unknown(f"no such cause in {self.name}", name, self.causes), ("without", k))
            del causes[name]
        for name, change in changes.causes.items():
            if name == JOINT and self.joint is not None:
                text = "the components of `joint` cannot be changed as a cause"
                raise changes.error(text, ("causes", name), allowed="another file of disturbances")
            if name in causes:
                causes[name] = change.apply_to(causes[name])
                continue
            missing = [key for key in ("bodies", "reason") if key not in change.set_keys]
            if missing or not any(key in change.set_keys for key in MOVES):
                new = f"a new one with bodies, a reason and one of {names_text(MOVES)}"
                allowed = f"a change of {names_text(self.causes)}; or {new}"
                problem = unknown(f"no such cause in {self.name}", name, self.causes, allowed=allowed)
                raise changes.error(problem, ("causes", name))
            # the parts are already validated; validating again would require quantities as text
            causes[name] = CauseSpec.model_construct(**change.set_keys)
        if not causes and self.joint is None:
            raise changes.error("no cause is left", ("without",), allowed="`disturbances: none` for none at all")
        return self.model_copy(update={"causes": FrozenMap(causes)})


class JobDisturbancesSpec(spec.Spec):
    """Disturbances on which a job's sigmas are based.

    Attributes
    ----------
    file : str | None
        Name of a file in scenes/library/disturbances, or the path of your file; `none` for no disturbances. By default
        the instrument's.
    causes : Mapping[str, CauseChangeSpec]
        Name -> change of a cause of the file, or an additional cause, with the file's number of standard deviations.
    without : tuple[str, ...]
        Names of the file's causes that are excluded.
    """

    file: spec.Ref | None = None
    causes: spec.Named[CauseChangeSpec] = Field(default_factory=FrozenMap)
    without: tuple[spec.Name, ...] = ()

    @model_validator(mode="after")
    def _each_once(self) -> "JobDisturbancesSpec":
        for k, name in enumerate(self.without):
            if name in self.without[:k]:
                raise Problem("a cause is excluded twice", shown(name), "each once", within=("without", k))
            if name in self.causes:
                text = "a cause is both changed and excluded"
                raise Problem(text, shown(name), "only one of them", within=("without", k))
        return self


def _as_file(value: Any) -> Any:
    """Expand the name of a file, or its content, to the mapping with `file`."""
    return {"file": value} if isinstance(value, str) or (isinstance(value, Mapping) and "name" in value) else value


JobDisturbances = Annotated[
    JobDisturbancesSpec,
    BeforeValidator(_as_file, json_schema_input_type=spec.Reference | JobDisturbancesSpec | DisturbancesSpec),
]
"""Disturbances as a mapping with its keys, the file's name alone, as `disturbances: orbit`, or the content of such a
file.
"""


AngleErrors = Annotated[
    dict[spec.Name, Annotated[dict[spec.Name, Tilt], AfterValidator(FrozenMap)]],
    spec.NothingIsEmpty,
    AfterValidator(FrozenMap),
]


class ErrorBudgetSpec(spec.Spec):
    """Error budget of a monitor, which lists the error that each cause of disturbance contributes.

    Attributes
    ----------
    description : str
        Description for readers; the program does not use it.
    instrument : str
        Instrument, by name or path.
    photons_per_frame : float
        Photons of a spot per frame; few, so that the centroid's noise is a line of the budget.
    frames : int
        Number of frames averaged in a measurement.
    trials : int
        Number of random states for each line of the budget, which is one cause.
    all_together : int
        Number of random states with all causes at once.
    angle_errors : dict[str, dict[str, tuple[float, float]]]
        Prism (prism_180 or prism_0) -> face -> its manufacturing tilt about x and y, in radians.
    disturbances : str
        File of disturbances: one of scenes/library/disturbances or the path of your file. Each of its causes is a line.
    """

    description: spec.Text = ""
    instrument: spec.Ref
    photons_per_frame: Annotated[spec.Number, Field(gt=0.0, le=1e12)]
    frames: Frames = 9
    trials: Annotated[spec.Whole, Field(ge=20, le=100_000)] = 100
    all_together: Annotated[spec.Whole, Field(ge=20, le=100_000)] = 300
    angle_errors: AngleErrors
    disturbances: spec.Ref

    def applied_to(self, instrument: InstrumentSpec) -> InstrumentSpec:
        """Return the instrument with this budget's angle errors and light."""
        monitor = instrument.autocollimator
        changed = {
            prism: getattr(monitor, prism).model_copy(update={"angle_errors": errors})
            for prism, errors in self.angle_errors.items()
        }
        reticle = monitor.reticle.model_copy(update={"photons_per_frame": self.photons_per_frame})
        copied = monitor.model_copy(update={**changed, "reticle": reticle})
        return instrument.model_copy(update={"monitor": copied})
