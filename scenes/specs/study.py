"""A design trade study, as its file gives it: base job, factors and the values they take, design, responses, report.

Samplers of studies: how a design spreads its runs over the values of its factors.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from optics.numerics.extension_table import ExtensionTable
from scenes.specs.motion_text import key_below, motion_of
from scenes.specs.procedures import studied
from scenes.yaml.errors import KeyPath, Problem, key_text, shown, unknown
from scenes.yaml.spec import (
    Flag,
    Name,
    Named,
    NothingIsEmpty,
    Number,
    OneOf,
    Reference,
    Seed,
    Spec,
    Text,
    TitledSpec,
    Whole,
)
from scenes.yaml.units import split_quantity, unit_ratio

GRID = "grid"
"""The kind that draws nothing: every combination."""


@dataclass(frozen=True)
class Sampler:
    """How a design spreads its runs.

    Attributes
    ----------
    title : str
        For readers.
    points : Callable[[int, int, np.random.Generator], np.ndarray]
        Number of runs, number of independent factors, generator of all that is drawn -> points of the unit cube, (runs,
        factors) in [0, 1]. A factor takes the value at which its distribution function is the point's coordinate.
    even : bool
        Whether the points lie more evenly than independent ones, so that means are known better than by sigma/sqrt(n).
    """

    title: str
    points: Callable[[int, int, np.random.Generator], np.ndarray]
    even: bool = False


SMALLEST = 2.0**-53
"""Draws lie in [SMALLEST, 1 - SMALLEST], where normal quantiles are finite (8.2 sigma)."""


def _latin_hypercube(runs: int, factors: int, generator: np.random.Generator) -> np.ndarray:
    # takes a second to import, and a worker does not need it
    from scipy.stats import qmc

    return np.asarray(qmc.LatinHypercube(factors, rng=generator).random(runs))


def _sobol(runs: int, factors: int, generator: np.random.Generator) -> np.ndarray:
    from scipy.stats import qmc

    with warnings.catch_warnings():
        # the user chose the number of runs; the points are those of the sequence all the same
        warnings.filterwarnings("ignore", message="The balance properties")
        return np.asarray(qmc.Sobol(factors, scramble=True, rng=generator).random(runs))


def _monte_carlo(runs: int, factors: int, generator: np.random.Generator) -> np.ndarray:
    return generator.random((runs, factors))


_SAMPLERS: dict[str, Sampler] = {
    "latin_hypercube": Sampler("Latin hypercube", _latin_hypercube, even=True),
    "sobol": Sampler("scrambled Sobol sequence", _sobol, even=True),
    "monte_carlo": Sampler("Monte Carlo", _monte_carlo),
}
SAMPLERS = ExtensionTable("samplers", _SAMPLERS, Sampler)
"""Kind of a design that draws -> its sampler. A new one is added here, and its name can be written in a study."""


def unit_cube(kind: str, runs: int, factors: int, seed: int) -> np.ndarray:
    """Points of a design in the open unit cube, (runs, factors).

    Parameters
    ----------
    kind : str
        One of SAMPLERS.
    runs : int
        Number of points.
    factors : int
        Number of coordinates.
    seed : int
        Of what is drawn.

    Raises
    ------
    KeyError
        No such kind.
    ValueError
        The sampler gave no points of that cube.
    """
    generator = np.random.default_rng(np.random.SeedSequence(seed))
    cube = np.asarray(SAMPLERS[kind].points(runs, factors, generator), np.float64)
    if cube.shape != (runs, factors) or not np.all((cube >= 0.0) & (cube <= 1.0)):
        raise ValueError(f"the sampler {kind} must give points {(runs, factors)} in [0, 1], gave {cube.shape}")
    return np.clip(cube, SMALLEST, 1.0 - SMALLEST)


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

    Attributes
    ----------
    mean : Scalar
        Its middle, with the unit of the base's value.
    sigma : Scalar
        Standard deviation.
    """

    mean: Scalar
    sigma: Scalar


class TruncatedSpec(Spec):
    """A normal distribution that is cut off.

    Attributes
    ----------
    mean : Scalar
        Middle of the normal distribution before it is cut.
    sigma : Scalar
        Its standard deviation.
    limits : tuple[Scalar, Scalar]
        Smallest and largest value.
    """

    mean: Scalar
    sigma: Scalar
    limits: tuple[Scalar, Scalar]


class TableSpec(Spec):
    """A column of a table; columns of one file belong together, row by row.

    Attributes
    ----------
    file : Reference
        CSV with a line of names first, relative to the study's file.
    column : Text
        Name of the column.
    values : tuple[Scalar, ...] | None
        What stands there; a study's config.yaml holds them, so that it needs no other file.
    """

    file: Reference
    column: Text
    values: tuple[Scalar, ...] | None = None


class ScaleSpec(Spec):
    """A value that follows a factor: the base's own, or what another factor sets it to, times a power of the factor
    over its value in the base. Several factors may scale one value.

    Attributes
    ----------
    key : Key
        Where it stands in the base's resolved config.yaml; a number or a quantity.
    power : Number
        Of the ratio, 2 for what grows with an area when the factor is a diameter.
    """

    key: Key
    power: Number = 1.0


class FactorSpec(Spec):
    """What is changed and how: one of key and keys, or scales alone, and exactly one of values, range, uniform, normal,
    truncated and table.

    Attributes
    ----------
    key : Key | None
        Where in the base's resolved config.yaml, keys and list indices.
    motion : Text | None
        In place of the key of a number below `perturb` of a job, `M2 shift z`.
    keys : tuple[Key, ...] | None
        Several such places that all get the same value.
    scales : tuple[ScaleSpec, ...]
        Values that follow the factor; one without key and keys is itself the ratio, 1 for the base as it is.
    values : tuple[Scalar, ...] | None
        a list of values; a design that draws takes each as often as the others.
    range : tuple[Scalar, Scalar] | None
        Smallest and largest value, evenly spaced in a grid and evenly spread in designs that draw.
    count : Count | None
        Number of values of a range in a grid.
    uniform : tuple[Scalar, Scalar] | None
        Smallest and largest value of a uniform distribution.
    normal : NormalSpec | None
        a normal distribution.
    truncated : TruncatedSpec | None
        a normal distribution within limits.
    table : TableSpec | None
        a column of a CSV file.
    """

    key: Key | None = None
    motion: Text | None = None
    keys: Annotated[tuple[Key, ...], Field(min_length=1)] | None = None
    scales: tuple[ScaleSpec, ...] = ()
    values: tuple[Scalar, ...] | None = None
    range: tuple[Scalar, Scalar] | None = None
    count: Count | None = None
    uniform: tuple[Scalar, Scalar] | None = None
    normal: NormalSpec | None = None
    truncated: TruncatedSpec | None = None
    table: TableSpec | None = None

    @model_validator(mode="before")
    @classmethod
    def _motion_is_a_key(cls, data: Any) -> Any:
        """`motion: M2 shift z` stands for the key of that number in a job."""
        if not isinstance(data, Mapping) or not isinstance(data.get("motion"), str):
            return data
        if "key" in data:
            raise Problem("a factor has a key or a motion", "both", "motion: M2 shift z")
        node, kind, axis, quantity, pivot = motion_of(data["motion"])
        if quantity or pivot:
            text = "a factor's motion has no amount and no pivot"
            raise Problem(text, shown(quantity or pivot), "motion: M2 shift z", within=("motion",))
        rest = {key: value for key, value in data.items() if key != "motion"}
        return {**rest, "key": ["job", "perturb", node, *key_below(kind, axis)]}

    @model_validator(mode="after")
    def _is_one_thing(self) -> FactorSpec:
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

    def numbers(self) -> Numbers:
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
                problem = "a standard deviation is greater than zero"
                raise Problem(problem, allowed="another sigma", within=(self.kind, "sigma"))
        if self.kind != "normal":
            low, high = numbers.values[-2:]
            if not low < high:
                within = (self.kind, "limits") if self.kind == "truncated" else (self.kind,)
                found = f"{self.scalars()[-2]} to {self.scalars()[-1]}"
                raise Problem("the range is empty", found, "the smaller value first", within=within)


class Numbers(tuple[float, ...]):
    """Values of a factor.

    Attributes
    ----------
    numeric : bool
        Whether they are numbers, with or without a unit.
    unit : str | None
        Of all of them; None without.
    values
        The numbers in that unit.
    whole : bool
        Whether all are whole numbers, written so.
    """

    numeric: bool
    unit: str | None
    whole: bool

    @property
    def values(self) -> tuple[float, ...]:
        """The numbers."""
        return tuple(self)

    @classmethod
    def of(cls, scalars: tuple[Any, ...], kind: str) -> Numbers:
        """Numbers that stand in a factor.

        Raises
        ------
        Problem
            Some have a unit and others not, or the units measure different things.
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
                allowed = f"a number with {first}"
                raise Problem("not a quantity among quantities", shown(scalar), allowed, within=(kind,))
            number, unit = part
            try:
                # dividing keeps 300 mm / (1000 mm/m) at 0.3 where a product would not
                numbers.append(number if unit == first else number / unit_ratio(first, unit))
            except Problem as problem:
                raise Problem(problem.problem, problem.found, problem.allowed, within=(kind,)) from None
        out = cls(numbers)
        out.numeric, out.unit, out.whole = True, first, False
        return out


class DesignSpec(Spec):
    """Which combinations of the factors' values are run.

    Attributes
    ----------
    kind : str
        Grid, every combination; latin_hypercube and sobol, evenly spread over all factors; monte_carlo, drawn
        independently.
    runs : Whole | None
        Number of runs; a grid has as many as there are combinations.
    seed : Seed
        Of what is drawn, and of the noise of every run.
    """

    kind: Annotated[str, OneOf(lambda: (GRID, *SAMPLERS))] = GRID
    runs: Annotated[Whole, Field(ge=1, le=MOST_RUNS)] | None = None
    seed: Seed = 0

    @model_validator(mode="after")
    def _has_runs(self) -> DesignSpec:
        if self.kind == GRID and self.runs is not None:
            found = f"runs: {self.runs}"
            raise Problem("a grid has as many runs as combinations", found, "no runs", within=("runs",))
        if self.kind != GRID and self.runs is None:
            raise Problem(f"a design of kind {self.kind} needs its number of runs", None, "runs: 1000")
        return self


_MEMORY = re.compile(r"[0-9]{1,6}(\.[0-9]{1,3})? ?(MB|GB)")


def _amount(text: str) -> str:
    if not _MEMORY.fullmatch(text):
        raise Problem("not an amount of memory", shown(text), "a number with MB or GB: 4 GB")
    return text


class LimitsSpec(Spec):
    """What a study may use.

    Attributes
    ----------
    runs : Whole
        More than these are run only with --yes.
    memory : str
        Of all processes together, with its unit MB or GB.
    """

    runs: Annotated[Whole, Field(ge=1, le=MOST_RUNS)] = 20_000
    memory: Annotated[str, Field(strict=True), AfterValidator(_amount)] = "4 GB"

    @property
    def bytes(self) -> float:
        """The memory, bytes."""
        return float(self.memory[:-2]) * (1e9 if self.memory.endswith("GB") else 1e6)


UNITS = {
    **{name: name for name in ("arcsec", "arcmin", "mas", "deg", "rad", "urad", "mrad")},
    **{name: name for name in ("pm", "nm", "um", "mm", "m", "km")},
    **{name: name for name in ("us", "ms", "s", "K", "mK", "percent", "ppm", "waves", "px", "DN", "mW", "W")},
    "K_per_m": "K/m",
    "k_per_m": "K/m",
    "m_per_s": "m/s",
}
"""Ending of a result's key -> unit."""


class BaseSpec(Spec):
    """The job that every run of the study changes.

    Attributes
    ----------
    command : str
        What runs it, as `python -m twin.COMMAND`.
    file : Reference
        Its file, or the config.yaml of one of its runs, relative to the study's file; for lab and orbit also a name in
        the library.
    """

    command: Annotated[str, OneOf(studied)]
    file: Reference


TOTAL, NOISE = "_sigma", "_sigma_noise"
"""Endings of standard deviations: of all that is stated, and of that what noise does; in results and of columns."""


class ResponseSpec(Spec):
    """A number that is kept of every run.

    Attributes
    ----------
    key : Key
        Where in the results: the run folder's JSON file without .json, then its keys and list indices.
    unit : Text | None
        Of the number; read from the ending of its key if it is not given.
    sigma : Key | None
        Where its standard deviation stands, if the results have one: of all that is stated, for readings of the monitor
        noise and motions that the spots cannot separate.
    noise : Key | None
        Where its standard deviation by the noise of the run alone stands, which differs from run to run; for readings
        of the monitor the key that ends in ``_sigma_noise``.
    minus : Key | None
        Where a number stands that is subtracted: an error is what is recovered minus what is true.
    """

    key: Key
    unit: Text | None = None
    sigma: Key | None = None
    noise: Key | None = None
    minus: Key | None = None

    @model_validator(mode="after")
    def _is_of_one_unit(self) -> ResponseSpec:
        for name, key in (("minus", self.minus), ("sigma", self.sigma), ("noise", self.noise)):
            if key is not None and unit_of(key) != unit_of(self.key):
                found = f"{unit_of(key) or 'no unit'} and {unit_of(self.key) or 'no unit'}"
                raise Problem("two units in one response", found, "keys that end in the same unit", within=(name,))
        return self

    @property
    def units(self) -> str:
        """The unit, empty for a pure number."""
        return self.unit if self.unit is not None else unit_of(self.key)

    @property
    def stated(self) -> dict[str, KeyPath]:
        """Ending of a column of the result -> where the standard deviation in it stands."""
        given = {TOTAL: self.sigma, NOISE: self.noise}
        return {ending: key for ending, key in given.items() if key is not None}


class ThresholdSpec(Spec):
    """A requirement on a response, in the response's unit: the report tells the share of runs that meet it.

    Attributes
    ----------
    response : Name
        Its name.
    at_most : Number | None
        Largest value that is good.
    at_least : Number | None
        Smallest value that is good.
    magnitude : Flag
        Judge the size of the response, without its sign.
    """

    response: Name
    at_most: Number | None = None
    at_least: Number | None = None
    magnitude: Flag = False

    @model_validator(mode="after")
    def _asks_something(self) -> ThresholdSpec:
        if self.at_most is None and self.at_least is None:
            raise Problem("the requirement asks nothing", None, "at_most: 1.0, or at_least: 0.2")
        return self


class ParetoSpec(Spec):
    """Two responses, or a factor and a response, that compete; `max` in place of `min` where more is better.

    Attributes
    ----------
    x : Name
        Name of a factor or response.
    y : Name
        Name of a factor or response.
    best_x : Literal['min', 'max']
        Whether small or large x is wanted.
    best_y : Literal['min', 'max']
        Whether small or large y is wanted.
    """

    x: Name
    y: Name
    best_x: Literal["min", "max"] = "min"
    best_y: Literal["min", "max"] = "min"


class StudyReportSpec(Spec):
    """What the report shows beside the table of the responses.

    Attributes
    ----------
    histograms : tuple[Name, ...] | None
        Responses whose distribution is drawn; all when it is not given.
    scatter : tuple[tuple[Name, Name], ...]
        Pairs of names, of a factor or response along x and of one along y.
    pareto : tuple[ParetoSpec, ...]
        Pairs whose best compromises are sought.
    sobol : Flag
        Whether variance-based sensitivity indices are estimated.
    thresholds : Named[ThresholdSpec]
        By name, requirements on responses.
    """

    histograms: tuple[Name, ...] | None = None
    scatter: tuple[tuple[Name, Name], ...] = ()
    pareto: tuple[ParetoSpec, ...] = ()
    sobol: Flag = False
    thresholds: Named[ThresholdSpec] = Field(default_factory=dict, validate_default=True)

    def names(self) -> list[tuple[KeyPath, str, bool]]:
        """(where it stands, name, whether it must be a response) of everything the report mentions."""
        out: list[tuple[KeyPath, str, bool]] = [
            (("histograms", k), name, True) for k, name in enumerate(self.histograms or ())
        ]
        out += [(("scatter", k, i), name, False) for k, pair in enumerate(self.scatter) for i, name in enumerate(pair)]
        for k, pair in enumerate(self.pareto):
            out += [(("pareto", k, "x"), pair.x, False), (("pareto", k, "y"), pair.y, False)]
        return out + [(("thresholds", key, "response"), t.response, True) for key, t in self.thresholds.items()]


class StudySpec(TitledSpec):
    """A design trade study.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    base : BaseSpec
        The job that is varied.
    factors : Named[FactorSpec]
        By name, what varies in it.
    design : DesignSpec
        Which combinations are run.
    noise : Literal['own', 'shared']
        Own, every run has noise of its own; shared, all have that of the base job's seed.
    responses : Named[ResponseSpec]
        By name, what is kept of each run.
    limits : LimitsSpec
        What the study may use.
    report : StudyReportSpec
        What the report shows.
    """

    base: BaseSpec
    factors: Annotated[Named[FactorSpec], Field(min_length=1)]
    design: Annotated[DesignSpec, NothingIsEmpty] = DesignSpec.model_construct()
    noise: Literal["own", "shared"] = "own"
    responses: Annotated[Named[ResponseSpec], Field(min_length=1)]
    limits: Annotated[LimitsSpec, NothingIsEmpty] = LimitsSpec.model_construct()
    report: Annotated[StudyReportSpec, NothingIsEmpty] = StudyReportSpec.model_construct()

    @model_validator(mode="after")
    def _fits_together(self) -> StudySpec:
        taken: dict[Any, str] = {}
        for name, factor in self.factors.items():
            for k, place in enumerate(factor.places):
                if place in taken:
                    text = f"the factor {taken[place]} already changes this value"
                    within = ("factors", name, *factor.key_of(k))
                    raise Problem(text, key_text(place), "every value changed by one factor", within=within)
                taken[place] = name
            self._check_design(name, factor)
        clash = self._clash()
        if clash is not None:
            text = f"{clash!r} would name two columns of the result"
            raise Problem(text, None, "another name", within=("responses",))
        names = (*self.factors, *self.responses)
        for key, name, response in self.report.names():
            among = tuple(self.responses) if response else names
            if name not in among:
                what = "no such response" if response else "no such factor or response"
                raise unknown(what, name, among, ("report", *key))
        return self

    def _check_design(self, name: str, factor: FactorSpec) -> None:
        if self.design.kind != GRID:
            if factor.count is not None:
                text = f"a design of kind {self.design.kind} draws the values of a range"
                raise Problem(text, f"count: {factor.count}", "no count", within=("factors", name, "count"))
        elif factor.kind in ("uniform", "normal", "truncated"):
            *others, last = SAMPLERS
            kinds = f"{', '.join(others)} or {last}" if others else last
            allowed = f"values, or range with count; or a design of kind {kinds}"
            text = "a grid needs values that can be counted"
            raise Problem(text, factor.kind, allowed, within=("factors", name, factor.kind))
        elif factor.kind == "range" and factor.count is None:
            text = "a range in a grid needs the number of its values"
            raise Problem(text, None, "count: 5", within=("factors", name))

    def _clash(self) -> str | None:
        """A name that two columns of the result would have."""
        stated = [f"{name}{ending}" for name, one in self.responses.items() for ending in one.stated]
        names = ["run", "failed", "message", "seed", *self.factors, *self.responses, *stated]
        return next((name for name in names if names.count(name) > 1), None)


_UNIT_WORDS = frozenset(UNITS) | {"m2", "mm2", "um2"}
"""Words that end what a key says of its unit."""


def unit_of(key: KeyPath) -> str:
    """Return the unit that a result's key says, empty if it says none: "um" for d_f_um, d_f_um_sigma_noise and other
    keys whose last words, after the unit, say which number it is (d_f_um_true), "m/arcsec" for height_m_per_arcsec,
    "1/mm" for nyquist_per_mm. A name below such a key has its unit: "um" for defocus_um, centre.
    """
    *above, last = [str(part) for part in key if isinstance(part, str)] or [""]
    words = last.removesuffix(NOISE).removesuffix(TOTAL).split("_")
    while "per" not in words and len(words) > 1 and words[-1] not in _UNIT_WORDS:
        words.pop()
    last = "_".join(words)
    endings = [ending for ending in UNITS if last.endswith(f"_{ending}")]
    if not endings:
        return unit_of(tuple(above[-1:])) if above else ""
    ending = max(endings, key=len)
    first = last.removesuffix(f"_{ending}")
    if not first.endswith("_per"):
        return UNITS[ending]
    return f"{unit_of(('_' + first.removesuffix('_per'),)) or 1}/{UNITS[ending]}"
