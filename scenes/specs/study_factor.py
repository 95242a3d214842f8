"""A factor of a study: which values of the base job it changes, and what values they take."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from scenes.yaml.errors import KeyPath, Problem, shown
from scenes.yaml.spec import Number, Spec, Text, Whole
from scenes.yaml.units import split_quantity, unit_ratio

Scalar = (
    Annotated[bool, Field(strict=True)]
    | Annotated[int, Field(strict=True)]
    | Annotated[float, Field(strict=True, allow_inf_nan=False)]
    | Annotated[str, Field(strict=True, max_length=1000)]
)
"""A value as it stands in the base's file: a quantity with its unit, a number, a name, true or false."""
Key = Annotated[tuple[Annotated[str, Field(strict=True)] | Whole, ...], Field(min_length=1)]
"""Keys and list indices from the root of a tree."""
MOST_RUNS = 10_000_000
Count = Annotated[Whole, Field(ge=2, le=MOST_RUNS)]
KINDS = ("values", "range", "uniform", "normal", "truncated", "table")
CONTINUOUS = ("range", "uniform", "normal", "truncated")


class NormalSpec(Spec):
    """A normal distribution.

    Attributes:
        mean: its middle, with the unit of the base's value.
        sigma: standard deviation.
    """

    mean: Scalar
    sigma: Scalar


class TruncatedSpec(Spec):
    """A normal distribution that is cut off.

    Attributes:
        mean: middle of the normal distribution before it is cut.
        sigma: its standard deviation.
        limits: smallest and largest value.
    """

    mean: Scalar
    sigma: Scalar
    limits: tuple[Scalar, Scalar]


class TableSpec(Spec):
    """A column of a table; columns of one file belong together, row by row.

    Attributes:
        file: CSV with a line of names first, relative to the study's file.
        column: name of the column.
        values: what stands there; a study's config.yaml holds them, so that it needs no other file.
    """

    file: Annotated[str, Field(strict=True, min_length=1, max_length=1000)]
    column: Text
    values: tuple[Scalar, ...] | None = None


class ScaleSpec(Spec):
    """A value that follows a factor: the base's own, or what another factor sets it to, times a power of the factor
    over its value in the base. Several factors may scale one value.

    Attributes:
        key: where it stands in the base's resolved config.yaml; a number or a quantity.
        power: of the ratio, 2 for what grows with an area when the factor is a diameter.
    """

    key: Key
    power: Number = 1.0


class FactorSpec(Spec):
    """What is changed and how: one of key and keys, or scales alone, and exactly one of values, range, uniform, normal,
    truncated and table.

    Attributes:
        key: where in the base's resolved config.yaml, keys and list indices.
        keys: several such places that all get the same value.
        scales: values that follow the factor; one without key and keys is itself the ratio, 1 for the base as it is.
        values: a list of values; a design that draws takes each as often as the others.
        range: smallest and largest value, evenly spaced in a grid and evenly spread in designs that draw.
        count: number of values of a range in a grid.
        uniform: smallest and largest value of a uniform distribution.
        normal: a normal distribution.
        truncated: a normal distribution within limits.
        table: a column of a CSV file.
    """

    key: Key | None = None
    keys: Annotated[tuple[Key, ...], Field(min_length=1)] | None = None
    scales: tuple[ScaleSpec, ...] = ()
    values: tuple[Scalar, ...] | None = None
    range: tuple[Scalar, Scalar] | None = None
    count: Count | None = None
    uniform: tuple[Scalar, Scalar] | None = None
    normal: NormalSpec | None = None
    truncated: TruncatedSpec | None = None
    table: TableSpec | None = None

    @model_validator(mode="after")
    def _is_one_thing(self) -> "FactorSpec":
        if self.key is not None and self.keys is not None:
            raise Problem("a factor has either a key or keys", "both", "key: [...], or keys: [[...], [...]]")
        if self.key is None and self.keys is None and not self.scales:
            allowed = "key: [...], keys: [[...], [...]], or scales: [{key: [...]}]"
            raise Problem("a factor changes something", "no key", allowed)
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            found = ", ".join(given) or "none of them"
            raise Problem("a factor takes its values from one thing", found, f"one of {', '.join(KINDS)}")
        if self.values is not None and not self.values:
            raise Problem("the factor is empty", "an empty list", "one value or more", within=("values",))
        if self.count is not None and self.kind != "range":
            raise Problem("only a range has a count", f"count with {self.kind}", "range: [a, b]", within=("count",))
        self._check_numbers()
        self._check_scales()
        return self

    @property
    def kind(self) -> str:
        """Which of KINDS it is."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def places(self) -> tuple[KeyPath, ...]:
        """All places that get the value."""
        return self.keys if self.keys is not None else (self.key,) if self.key is not None else ()

    def key_of(self, k: int) -> KeyPath:
        """Where in the factor the place number k stands."""
        return ("key",) if self.key is not None else ("keys", k)

    @property
    def unit(self) -> str | None:
        """The unit in which the numbers of a quantity are given, the first one that is written; None without unit."""
        return Numbers.of(self.scalars(), self.kind).unit

    def scalars(self) -> tuple[Any, ...]:
        """All values or parameters, as they are written."""
        if self.normal is not None:
            return (self.normal.mean, self.normal.sigma)
        if self.truncated is not None:
            return (self.truncated.mean, self.truncated.sigma, *self.truncated.limits)
        if self.table is not None:
            return self.table.values or ()
        return self.values or self.range or self.uniform or ()

    def numbers(self) -> "Numbers":
        """All values or parameters as numbers in one unit."""
        return Numbers.of(self.scalars(), self.kind)

    def _check_scales(self) -> None:
        """What scales is a number greater than zero, and a pure number if it scales by itself."""
        own = next((k for k, scale in enumerate(self.scales) if scale.key in self.places), None)
        if own is not None:
            raise Problem("the factor sets this value itself", None, "another key", within=("scales", own, "key"))
        if not self.scales or self.table is not None:
            return
        numbers = self.numbers()
        if not numbers.numeric:
            raise Problem("not numbers", shown(list(self.scalars())), "numbers, since it scales", within=(self.kind,))
        if not self.places and numbers.unit is not None:
            found, allowed = f"a number with {numbers.unit}", "pure numbers: values: [0.5, 1, 2]"
            raise Problem("a factor without a key is a ratio", found, allowed, within=(self.kind,))

    def _check_numbers(self) -> None:
        """Parameters of a distribution are numbers of one kind, in order and not negative where they must not be."""
        numbers = self.numbers()
        if self.kind not in CONTINUOUS:
            return
        if not numbers.numeric:
            raise Problem("not numbers", shown(list(self.scalars())), "quantities or numbers", within=(self.kind,))
        if self.kind in ("normal", "truncated"):
            if not numbers.values[1] > 0.0:
                raise Problem(
                    "a standard deviation is greater than zero", allowed="another sigma", within=(self.kind, "sigma")
                )
        if self.kind != "normal":
            low, high = numbers.values[-2:]
            if not low < high:
                within = (self.kind, "limits") if self.kind == "truncated" else (self.kind,)
                found = f"{self.scalars()[-2]} to {self.scalars()[-1]}"
                raise Problem("the range is empty", found, "the smaller value first", within=within)


class Numbers(tuple[float, ...]):
    """Values of a factor.

    Attributes:
        numeric: whether they are numbers, with or without a unit.
        unit: of all of them; None without.
        values: the numbers in that unit.
        whole: whether all are whole numbers, written so.
    """

    numeric: bool
    unit: str | None
    whole: bool

    @property
    def values(self) -> tuple[float, ...]:
        """The numbers."""
        return tuple(self)

    @classmethod
    def of(cls, scalars: tuple[Any, ...], kind: str) -> "Numbers":
        """Numbers that stand in a factor.

        Raises:
            Problem: some have a unit and others not, or the units measure different things.
        """
        parts = [split_quantity(scalar) for scalar in scalars]
        plain = [isinstance(s, int | float) and not isinstance(s, bool) for s in scalars]
        if not any(part is not None for part in parts):
            out = cls(float(s) for s in scalars) if all(plain) else cls()
            out.numeric, out.unit = all(plain) and bool(scalars), None
            out.whole = all(isinstance(s, int) for s in scalars)
            return out
        first = next(part for part in parts if part is not None)[1]
        numbers = []
        for scalar, part in zip(scalars, parts, strict=True):
            if part is None:
                raise Problem(
                    "not a quantity among quantities", shown(scalar), f"a number with {first}", within=(kind,)
                )
            number, unit = part
            try:
                # dividing keeps 300 mm / (1000 mm/m) at 0.3 where a product would not
                numbers.append(number if unit == first else number / unit_ratio(first, unit))
            except Problem as problem:
                raise Problem(problem.problem, problem.found, problem.allowed, within=(kind,)) from None
        out = cls(numbers)
        out.numeric, out.unit, out.whole = True, first, False
        return out
