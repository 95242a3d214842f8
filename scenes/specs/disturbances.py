"""Disturbances: what is expected to move and to warm up between two measurements of the monitor, and by how much.

The estimator `posterior` and the total sigmas of all others rest on this statement. It is a job's or an instrument's
`disturbances: NAME`, a file of scenes/library/disturbances or of one's own.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.course import Term, moment
from scenes.yaml import units
from scenes.yaml.errors import Problem, names_text, shown, unknown
from scenes.yaml.quantity import Quantity, Vector
from scenes.yaml.spec import Name, Named, Number, Reference, Spec, Text, TitledSpec, short_for

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
FigureSigma = Annotated[float, _spread(units.LENGTH, "100 um")]
Span = Annotated[float, Quantity(units.MOMENT, above_zero=True, largest="1000000 h")]
Correlation = Annotated[Number, Field(ge=-1.0, le=1.0)]


class TemperatureSigmaSpec(Spec):
    """Standard deviations of a body's temperature field; what it does to light is worked out by the thermal model.

    Attributes:
        change: of its temperature at its origin, kelvin.
        gradient: of each component of its gradient in the body's own frame, K/m.
    """

    change: Annotated[float, _spread(units.TEMPERATURE_DIFFERENCE, "100 K")] = 0.0
    gradient: GradientSigma = (0.0, 0.0, 0.0)


class TimeLawSpec(Spec):
    """How a disturbance goes on from one time to another; its correlation between times t and t' is

        white: 1 at the same time, 0 at any other; constant: 1.
        drift D: exp(-|t - t'| / D).  period T: cos(2 pi (t - t') / T).  Both: their product.

    Attributes:
        kind: `white` or `constant`, in place of the others.
        drift: time in which it forgets where it was, seconds.
        period: it comes back with, seconds.
    """

    kind: Literal["white", "constant"] | None = None
    drift: Span | None = None
    period: Span | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "TimeLawSpec":
        given = [self.drift is not None, self.period is not None]
        if (self.kind is not None) == any(given):
            raise Problem(
                "no law of time", self.text, "white, constant, {drift: 6 h}, {period: 95 min}, or the last two"
            )
        return self

    @property
    def text(self) -> str:
        """In words."""
        parts: list[str] = [self.kind or ""]
        parts += [f"drift {moment(self.drift)}"] if self.drift is not None else []
        parts += [f"period {moment(self.period)}"] if self.period is not None else []
        return ", ".join(filter(None, parts)) or "nothing"


BodyPattern = Annotated[str, Field(strict=True, min_length=1, max_length=200)]
BodyPatterns = Annotated[
    tuple[BodyPattern, ...], Field(min_length=1), short_for(None, str, schema=BodyPattern | tuple[BodyPattern, ...])
]
Reason = Annotated[Text, Field(min_length=1)]
FigureSigmas = Annotated[dict[Term, FigureSigma], AfterValidator(FrozenMap)]
TimeLaw = Annotated[TimeLawSpec, short_for("kind", str, schema=Literal["white", "constant"] | TimeLawSpec)]
MOVES = ("shift", "rotate", "scale", "figure", "temperature", "index_gradient")
"""Keys of a cause that hold standard deviations."""


class CorrelationSpec(Spec):
    """Components of one cause that move together.

    Attributes:
        between: their names: `base/forward/M1 shift z`, `NODE rotate x`, `NODE scale`, `NODE figure Z5`, `NODE
            temperature`, `NODE gradient x`, `NODE index_gradient x`.
        correlation: of any two of them.
        matrix: their correlation matrix, in place of one number.
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
        rows, count = self.matrix, len(self.between)
        if rows is None:
            return self
        if len(rows) != count or any(len(row) != count for row in rows):
            found = f"{len(rows)} rows of {', '.join(str(len(row)) for row in rows)}"
            raise Problem("not a matrix of this size", found, f"{count} rows of {count} numbers", within=("matrix",))
        for i, row in enumerate(rows):
            if row[i] != 1.0:
                problem = "a correlation matrix has ones on its diagonal"
                raise Problem(problem, f"{row[i]:g}", "1", within=("matrix", i, i))
            for j in range(i):
                if row[j] != rows[j][i]:
                    found = f"{row[j]:g} and {rows[j][i]:g}"
                    raise Problem("a correlation matrix is symmetric", found, "equal", within=("matrix", i, j))
        return self

    @property
    def table(self) -> tuple[tuple[float, ...], ...]:
        """The matrix."""
        if self.matrix is not None:
            return self.matrix
        count, value = len(self.between), self.correlation
        assert value is not None
        return tuple(tuple(1.0 if i == j else value for j in range(count)) for i in range(count))


class _CauseWords(Spec):
    """What may be said of a cause."""

    bodies: Annotated[BodyPatterns | None, STATED] = None
    shift: Annotated[ShiftSigma | None, STATED] = None
    rotate: Annotated[RotateSigma | None, STATED] = None
    scale: Annotated[ScaleSigma | None, STATED] = None
    figure: Annotated[FigureSigmas | None, STATED] = None
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

    Attributes:
        bodies: node paths; `*` stands for one part of a path or a piece of it (`base/*/M?` are all mirrors),
            `<camera>` for the name of a camera (`base/<camera>`).
        shift: of the bodies in their own frames, metres.
        rotate: about the pivot, radians.
        scale: relative growth of a camera and all in it.
        figure: Zernike term (Noll) -> of the surface error, metres.
        temperature: of the bodies' temperature fields.
        index_gradient: of the refractive index in a prism, 1/m, other than by heat.
        pivot: of turns and growth; by default the body's centre if it has one, else its origin.
        together: correlation of the same component of any two of the bodies.
        correlations: of single components.
        time: how it goes on in a series of measurements.
        reason: where the numbers come from.
    """

    bodies: BodyPatterns
    correlations: tuple[CorrelationSpec, ...] = ()
    time: TimeLaw = TimeLawSpec(kind="white")
    reason: Reason

    @model_validator(mode="after")
    def _moves_something(self) -> "CauseSpec":
        if all(getattr(self, name) is None for name in MOVES):
            raise Problem("a cause without any standard deviation", "none", f"at least one of {', '.join(MOVES)}")
        return self


class CauseChangeSpec(_CauseWords):
    """What a job says of a cause in place of the disturbances file, number by number; a cause that the file does not
    have needs all that a cause needs.

    Attributes:
        bodies, shift, rotate, scale, figure, temperature, index_gradient: as of a cause.
        pivot, together, correlations, time, reason: as of a cause.
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

    Attributes:
        name: as the file is called.
        description: for people.
        sigmas: how many standard deviations every number of the file is; 3 for a list of 3-sigma values.
        causes: by name.
    """

    sigmas: Annotated[Number, Field(gt=0.0, le=10.0)] = 1.0
    causes: Annotated[Named[CauseSpec], Field(min_length=1)]

    def changed(self, changes: "JobDisturbancesSpec") -> "DisturbancesSpec":
        """Return the statement with a job's changes made.

        Raises:
            InputError: it leaves out a cause that is not there, or adds one that is not complete.
        """
        causes = dict(self.causes)
        for k, name in enumerate(changes.without):
            if name not in causes:
                raise changes.error(unknown(f"no such cause in {self.name}", name, self.causes), ("without", k))
            del causes[name]
        for name, change in changes.causes.items():
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
        if not causes:
            raise changes.error("no cause is left", ("without",), allowed="`disturbances: none` for none at all")
        return self.model_copy(update={"causes": FrozenMap(causes)})


class JobDisturbancesSpec(Spec):
    """Which disturbances a job's sigmas rest on.

    Attributes:
        file: name of a file in scenes/library/disturbances, or path of one's own; the instrument's by default; `none`
            for none at all.
        causes: what is to be said instead of, or besides, the causes of the file, in as many standard deviations as
            the file's own numbers.
        without: causes of the file that are left out.
    """

    file: Reference | None = None
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


JobDisturbances = Annotated[JobDisturbancesSpec, short_for("file", str, schema=Reference | JobDisturbancesSpec)]
"""With its keys, or the file's name alone: `disturbances: orbit`."""
