"""Trade study of an input file: base job, factors and their values, design of experiments, responses, report.

The module also has the samplers, which distribute the runs of a design over the values of the factors.
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
from scenes.specs.perturbation import key_below, motion_of
from scenes.specs.procedures import studied_commands
from scenes.yaml import spec
from scenes.yaml.errors import KeyPath, Problem, key_text, shown, unknown
from scenes.yaml.units import split_quantity, unit_ratio

GRID = "grid"
"""Kind of design of experiments without random numbers: every combination of the values."""


@dataclass(frozen=True)
class Sampler:
    """Sampler: distribution of a design's runs over the unit cube.

    Attributes
    ----------
    title : str
        Name for reports.
    points : callable
        Function from number of runs, number of independent factors and random generator to points of the unit cube,
        (runs, factors) in [0, 1]. A factor takes the value at which its distribution function equals the point's
        coordinate.
    even : bool
        True if the points are more even than independent ones, so that means are more accurate than sigma/sqrt(n).
    """

    title: str
    points: Callable[[int, int, np.random.Generator], np.ndarray]
    even: bool = False


SMALLEST = 2.0**-53
"""Random numbers lie in [SMALLEST, 1 - SMALLEST], where normal quantiles are finite (8.2 sigma)."""


def _latin_hypercube(runs: int, factors: int, generator: np.random.Generator) -> np.ndarray:
    # slow to import (one second), and a worker does not need it
    from scipy.stats import qmc

    return np.asarray(qmc.LatinHypercube(factors, rng=generator).random(runs))


def _sobol(runs: int, factors: int, generator: np.random.Generator) -> np.ndarray:
    from scipy.stats import qmc

    with warnings.catch_warnings():
        # the user chose the number of runs; the points are valid even if it is not a power of two
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
"""Kind of a design -> its sampler. A new sampler is added here, and its name can then be used in a study."""


def unit_cube(kind: str, runs: int, factors: int, seed: int) -> np.ndarray:
    """Return the points of a design of experiments in the open unit cube, (runs, factors).

    Parameters
    ----------
    kind : str
        One of SAMPLERS.
    runs : int
        Number of points.
    factors : int
        Number of coordinates.
    seed : int
        Seed of the random numbers.

    Raises
    ------
    KeyError
        There is no such sampler.
    ValueError
        The sampler returned points outside that cube or of another shape.
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
"""Value as written in the file of the base job or test: a quantity with its unit, a number, a name, true or false."""
Key = Annotated[tuple[Annotated[str, Field(strict=True)] | spec.Whole, ...], Field(min_length=1)]
"""Key path in a file or a result: keys and list indices from the root on."""
MOST_RUNS = 10_000_000
Count = Annotated[spec.Whole, Field(ge=2, le=MOST_RUNS)]
KINDS = ("values", "range", "uniform", "normal", "truncated", "table")
CONTINUOUS = ("range", "uniform", "normal", "truncated")


class NormalSpec(spec.Spec):
    """Normal distribution of a factor.

    Attributes
    ----------
    mean : str | float | int | bool
        Mean, with the unit of the base's value.
    sigma : str | float | int | bool
        Standard deviation, with unit.
    """

    mean: Scalar
    sigma: Scalar


class TruncatedSpec(spec.Spec):
    """Truncated normal distribution of a factor.

    Attributes
    ----------
    mean : str | float | int | bool
        Mean of the normal distribution before truncation, with unit.
    sigma : str | float | int | bool
        Standard deviation of the normal distribution before truncation, with unit.
    limits : tuple[str | float | int | bool, str | float | int | bool]
        Smallest and largest value, with units.
    """

    mean: Scalar
    sigma: Scalar
    limits: tuple[Scalar, Scalar]


class TableSpec(spec.Spec):
    """Column of a table. Columns of one file are varied together, row by row.

    Attributes
    ----------
    file : str
        CSV file with names in its first line, relative to the study's file.
    column : str
        Name of the column.
    values : tuple[str | float | int | bool, ...] | None
        Values of the column, filled in by the program in a study's config.yaml, which then needs no other file.
    """

    file: spec.Reference
    column: spec.Text
    values: tuple[Scalar, ...] | None = None


class ScaleSpec(spec.Spec):
    """Number in the base that is multiplied by a power of the ratio of a factor to its base value.

    The number is that of the base, or the one set by another factor. Several factors may scale one number.

    Attributes
    ----------
    key : tuple[str | int, ...]
        Key path in the base's resolved config.yaml of the number or quantity that is scaled.
    power : float
        Exponent of the ratio; 2 for an area if the factor is a diameter.
    """

    key: Key
    power: spec.Number = 1.0


class FactorSpec(spec.Spec):
    """Factor of a study: a number or text of the base that varies, and the values that it takes.

    It has one of key, motion and keys, or scales alone, and exactly one of values, range, uniform, normal, truncated
    and table.

    Attributes
    ----------
    key : tuple[str | int, ...] | None
        Key path in the base's resolved config.yaml: keys and list indices.
    motion : str | None
        Motion below `perturb` of a job, such as `M2 shift z`, instead of its key.
    keys : tuple[tuple[str | int, ...], ...] | None
        Several key paths that all get the same value.
    scales : tuple[ScaleSpec, ...]
        Values that scale with the factor. A factor without key and keys is the ratio itself, 1 for the unchanged base.
    values : tuple[str | float | int | bool, ...] | None
        List of values; designs other than a grid use each of them equally often.
    range : tuple[str | float | int | bool, str | float | int | bool] | None
        Smallest and largest value: evenly spaced in a grid, uniformly distributed in other designs.
    count : int | None
        Number of values of a range in a grid.
    uniform : tuple[str | float | int | bool, str | float | int | bool] | None
        Smallest and largest value of a uniform distribution.
    normal : NormalSpec | None
        Normal distribution of the values: mean and standard deviation.
    truncated : TruncatedSpec | None
        Normal distribution of the values, truncated at two limits.
    table : TableSpec | None
        Column of a CSV file with the values.
    """

    key: Key | None = None
    motion: spec.Text | None = None
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
        """Replace `motion: M2 shift z` by the key of that number in a job."""
        if not isinstance(data, Mapping) or not isinstance(data.get("motion"), str):
            return data
        if "key" in data:
            raise Problem("a factor has either a key or a motion", "both", "motion: M2 shift z")
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
            raise Problem("a factor needs a key, a motion or scales", "no key", allowed)
        kinds = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(kinds) != 1:
            value = ", ".join(kinds) or "none of them"
            raise Problem("a factor needs exactly one kind of values", value, f"one of {', '.join(KINDS)}")
        if self.values is not None and not self.values:
            raise Problem("the factor is empty", "an empty list", "one value or more", within=("values",))
        if self.count is not None and self.kind != "range":
            raise Problem("only a range has a count", f"count with {self.kind}", "range: [a, b]", within=("count",))
        self._check_numbers()
        self._check_scales()
        return self

    @property
    def kind(self) -> str:
        """Key that gives the values, one of KINDS, such as ``range``."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def key_paths(self) -> tuple[KeyPath, ...]:
        """All key paths in the base that get the value of the factor."""
        return self.keys if self.keys is not None else (self.key,) if self.key is not None else ()

    def key_of(self, k: int) -> KeyPath:
        """Return the key path, within this factor, of entry number ``k`` of ``key_paths``."""
        return ("key",) if self.key is not None else ("keys", k)

    @property
    def unit(self) -> str | None:
        """Unit of the factor's numbers, taken from the first one in the file; None without unit."""
        return Numbers.of(self.scalars(), self.kind).unit

    def scalars(self) -> tuple[Any, ...]:
        """Return all values of the factor, or parameters of its distribution, as the file writes them."""
        if self.normal is not None:
            return (self.normal.mean, self.normal.sigma)
        if self.truncated is not None:
            return (self.truncated.mean, self.truncated.sigma, *self.truncated.limits)
        if self.table is not None:
            return self.table.values or ()
        return self.values or self.range or self.uniform or ()

    def numbers(self) -> Numbers:
        """Return all values of the factor, or parameters of its distribution, as numbers in one unit."""
        return Numbers.of(self.scalars(), self.kind)

    def _check_scales(self) -> None:
        """Raise `Problem` unless a factor that scales is a positive number, and a pure number if it has no key."""
        same = next((k for k, scale in enumerate(self.scales) if scale.key in self.key_paths), None)
        if same is not None:
            raise Problem("the factor sets this value itself", None, "another key", within=("scales", same, "key"))
        if not self.scales or self.table is not None:
            return
        numbers = self.numbers()
        if not numbers.numeric:
            raise Problem("not numbers", shown(list(self.scalars())), "numbers, for scales", within=(self.kind,))
        if not self.key_paths and numbers.unit is not None:
            value, allowed = f"a number with {numbers.unit}", "pure numbers: values: [0.5, 1, 2]"
            raise Problem("a factor without a key is a ratio", value, allowed, within=(self.kind,))

    def _check_numbers(self) -> None:
        """Raise `Problem` unless parameters of a distribution are ordered numbers of one kind with a positive sigma."""
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
                value = f"{self.scalars()[-2]} to {self.scalars()[-1]}"
                raise Problem("the range is empty", value, "the smaller value first", within=within)


@dataclass(frozen=True)
class Numbers:
    """Values of a factor as numbers.

    Attributes
    ----------
    values : tuple of float
        The numbers in the common unit.
    numeric : bool
        True if the values are numbers, with or without a unit.
    unit : str | None
        Unit of all of them; None without unit.
    whole : bool
        True if all are written as whole numbers.
    """

    values: tuple[float, ...]
    numeric: bool
    unit: str | None
    whole: bool

    @classmethod
    def of(cls, scalars: tuple[Any, ...], kind: str) -> Numbers:
        """Return the values of a factor as numbers.

        Raises
        ------
        Problem
            Only some have a unit, or the units measure different kinds of quantity.
        """
        parts = [split_quantity(scalar) for scalar in scalars]
        plain = [isinstance(s, int | float) and not isinstance(s, bool) for s in scalars]
        if not any(part is not None for part in parts):
            whole = all(isinstance(s, int) for s in scalars)
            return cls(tuple(map(float, scalars)) if all(plain) else (), all(plain) and bool(scalars), None, whole)
        first = next(part for part in parts if part is not None)[1]
        numbers = []
        for scalar, part in zip(scalars, parts, strict=True):
            if part is None:
                allowed = f"a number with {first}"
                raise Problem("a value without a unit among quantities", shown(scalar), allowed, within=(kind,))
            number, unit = part
            try:
                # a division gives exactly 0.3 for 300 mm / (1000 mm/m); a product with 0.001 would not
                numbers.append(number if unit == first else number / unit_ratio(first, unit))
            except Problem as problem:
                raise Problem(problem.problem, problem.value, problem.allowed, within=(kind,)) from None
        return cls(tuple(numbers), True, first, False)


class DesignSpec(spec.Spec):
    """Design of experiments: the combinations of the factors' values that are run.

    Attributes
    ----------
    kind : str
        Design: grid, every combination; latin_hypercube or sobol, evenly distributed over all factors; monte_carlo,
        independent random draws.
    runs : int | None
        Number of runs; a grid has as many as there are combinations.
    seed : int
        Seed of the random values of the factors, and of the noise of every run.
    """

    kind: Annotated[str, spec.OneOf(lambda: (GRID, *SAMPLERS))] = GRID
    runs: Annotated[spec.Whole, Field(ge=1, le=MOST_RUNS)] | None = None
    seed: spec.Seed = 0

    @model_validator(mode="after")
    def _has_runs(self) -> DesignSpec:
        if self.kind == GRID and self.runs is not None:
            raise Problem("a grid has as many runs as combinations", f"runs: {self.runs}", "no runs", within=("runs",))
        if self.kind != GRID and self.runs is None:
            raise Problem(f"a design of kind {self.kind} needs its number of runs", None, "runs: 1000")
        return self


_MEMORY = re.compile(r"[0-9]{1,6}(\.[0-9]{1,3})? ?(MB|GB)")


def _amount(text: str) -> str:
    if not _MEMORY.fullmatch(text):
        raise Problem("not an amount of memory", shown(text), "a number with MB or GB: 4 GB")
    return text


class LimitsSpec(spec.Spec):
    """Limits on the resources of a study.

    Attributes
    ----------
    runs : int
        Number of runs beyond which the study needs --yes.
    memory : str
        Memory of all processes together, with the unit MB or GB.
    """

    runs: Annotated[spec.Whole, Field(ge=1, le=MOST_RUNS)] = 20_000
    memory: Annotated[str, Field(strict=True), AfterValidator(_amount)] = "4 GB"

    @property
    def bytes(self) -> float:
        """Largest memory of all processes together, in bytes."""
        return float(self.memory[:-2]) * (1e9 if self.memory.endswith("GB") else 1e6)


UNITS = {
    **{name: name for name in ("arcsec", "arcmin", "mas", "deg", "rad", "urad", "mrad")},
    **{name: name for name in ("pm", "nm", "um", "mm", "m", "km")},
    **{name: name for name in ("us", "ms", "s", "K", "mK", "percent", "ppm", "waves", "px", "DN", "mW", "W")},
    "K_per_m": "K/m",
    "k_per_m": "K/m",
    "m_per_s": "m/s",
}
"""Last word of a result's key, such as `um` in `d_f_um` -> unit."""


class BaseSpec(spec.Spec):
    """Base of a study: the job or test that every run changes.

    Attributes
    ----------
    command : str
        Command that runs it, such as `render` for `python -m twin.render`.
    file : str
        File of the job or test, or the config.yaml of one of its runs, relative to the study's file; for lab and orbit
        also a name in the library.
    """

    command: Annotated[str, spec.OneOf(studied_commands)]
    file: spec.Reference


TOTAL, NOISE = "_sigma", "_sigma_noise"
"""Suffixes of the keys and columns of standard deviations: the total one, and the one due to image noise alone."""


class ResponseSpec(spec.Spec):
    """Response: a number that is stored for every run.

    Attributes
    ----------
    key : tuple[str | int, ...]
        Key path in the results: the JSON file of the run folder without .json, then its keys and list indices.
    unit : str | None
        Unit of the number; by default read from the suffix of its key.
    sigma : tuple[str | int, ...] | None
        Key path of its total standard deviation, if the results have one; for readings of the monitor it covers noise
        and motions that the spots cannot separate.
    noise : tuple[str | int, ...] | None
        Key path of its standard deviation due to the noise of a run alone, which differs from run to run; for readings
        of the monitor the key that ends in ``_sigma_noise``.
    minus : tuple[str | int, ...] | None
        Key path of a number that is subtracted, such as the true value, so that the response is an error.
    """

    key: Key
    unit: spec.Text | None = None
    sigma: Key | None = None
    noise: Key | None = None
    minus: Key | None = None

    @model_validator(mode="after")
    def _is_of_one_unit(self) -> ResponseSpec:
        for name, key in (("minus", self.minus), ("sigma", self.sigma), ("noise", self.noise)):
            if key is not None and unit_of(key) != unit_of(self.key):
                value = f"{unit_of(key) or 'no unit'} and {unit_of(self.key) or 'no unit'}"
                raise Problem("two units in one response", value, "keys that end in the same unit", within=(name,))
        return self

    @property
    def units(self) -> str:
        """Unit of the response; empty for a number without unit."""
        return self.unit if self.unit is not None else unit_of(self.key)

    @property
    def sigma_keys(self) -> dict[str, KeyPath]:
        """Suffix of a result column, total or noise -> key path of the standard deviation that it holds."""
        sigmas = {TOTAL: self.sigma, NOISE: self.noise}
        return {ending: key for ending, key in sigmas.items() if key is not None}


class ThresholdSpec(spec.Spec):
    """Requirement on a response, in the response's unit.

    The report gives the fraction of runs that meet it.

    Attributes
    ----------
    response : str
        Name of the response.
    at_most : float | None
        Largest value that meets the requirement.
    at_least : float | None
        Smallest value that meets the requirement.
    magnitude : bool
        True to judge the absolute value of the response.
    """

    response: spec.Name
    at_most: spec.Number | None = None
    at_least: spec.Number | None = None
    magnitude: spec.Flag = False

    @model_validator(mode="after")
    def _asks_something(self) -> ThresholdSpec:
        if self.at_most is None and self.at_least is None:
            raise Problem("a requirement without a limit", None, "at_most: 1.0, or at_least: 0.2")
        return self


class ParetoSpec(spec.Spec):
    """Pareto front of two competing responses, or of a factor and a response.

    Attributes
    ----------
    x : str
        Name of a factor or response.
    y : str
        Name of a factor or response.
    best_x : {'min', 'max'}
        Direction of improvement of x: `min` if smaller is better, `max` if larger is better.
    best_y : {'min', 'max'}
        Direction of improvement of y: `min` if smaller is better, `max` if larger is better.
    """

    x: spec.Name
    y: spec.Name
    best_x: Literal["min", "max"] = "min"
    best_y: Literal["min", "max"] = "min"


class StudyReportSpec(spec.Spec):
    """Content of the report beside the table of the responses.

    Attributes
    ----------
    histograms : tuple[str, ...] | None
        Responses with a histogram; by default all.
    scatter : tuple[tuple[str, str], ...]
        Scatter plots: pairs of names of factors or responses, [along x, along y].
    pareto : tuple[ParetoSpec, ...]
        Pareto fronts of two responses, or of a factor and a response.
    sobol : bool
        True to estimate variance-based (Sobol) sensitivity indices.
    thresholds : Mapping[str, ThresholdSpec]
        Name -> requirement on a response.
    """

    histograms: tuple[spec.Name, ...] | None = None
    scatter: tuple[tuple[spec.Name, spec.Name], ...] = ()
    pareto: tuple[ParetoSpec, ...] = ()
    sobol: spec.Flag = False
    thresholds: spec.Named[ThresholdSpec] = Field(default_factory=dict, validate_default=True)

    def names(self) -> list[tuple[KeyPath, str, bool]]:
        """Return (key path, name, whether it must be a response) for every factor or response that the report names."""
        out: list[tuple[KeyPath, str, bool]] = [
            (("histograms", k), name, True) for k, name in enumerate(self.histograms or ())
        ]
        out += [(("scatter", k, i), name, False) for k, pair in enumerate(self.scatter) for i, name in enumerate(pair)]
        for k, pair in enumerate(self.pareto):
            out += [(("pareto", k, "x"), pair.x, False), (("pareto", k, "y"), pair.y, False)]
        return out + [(("thresholds", key, "response"), t.response, True) for key, t in self.thresholds.items()]


class StudySpec(spec.TitledSpec):
    """Trade study: a job or a test repeated with factors that vary.

    Attributes
    ----------
    base : BaseSpec
        Job or test that is varied.
    factors : Mapping[str, FactorSpec]
        Name -> factor: a number or text of the base, and the values that it takes.
    design : DesignSpec
        Design of experiments: the combinations of the factors' values that are run.
    noise : {'own', 'shared'}
        Noise of the runs: `own`, independent in every run, or `shared`, that of the base job's seed in all runs.
    responses : Mapping[str, ResponseSpec]
        Name -> number that is stored for each run.
    limits : LimitsSpec
        Limits on the resources of the study.
    report : StudyReportSpec
        Figures, sensitivity indices and requirements in the report.
    """

    base: BaseSpec
    factors: Annotated[spec.Named[FactorSpec], Field(min_length=1)]
    design: Annotated[DesignSpec, spec.NothingIsEmpty] = DesignSpec.model_construct()
    noise: Literal["own", "shared"] = "own"
    responses: Annotated[spec.Named[ResponseSpec], Field(min_length=1)]
    limits: Annotated[LimitsSpec, spec.NothingIsEmpty] = LimitsSpec.model_construct()
    report: Annotated[StudyReportSpec, spec.NothingIsEmpty] = StudyReportSpec.model_construct()

    @model_validator(mode="after")
    def _fits_together(self) -> StudySpec:
        factors: dict[Any, str] = {}
        for name, factor in self.factors.items():
            for k, key_path in enumerate(factor.key_paths):
                if key_path in factors:
                    text = f"the factor {factors[key_path]} already changes this value"
                    within = ("factors", name, *factor.key_of(k))
                    raise Problem(text, key_text(key_path), "each value changed by one factor only", within=within)
                factors[key_path] = name
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
            text = "a grid needs a finite number of values"
            raise Problem(text, factor.kind, allowed, within=("factors", name, factor.kind))
        elif factor.kind == "range" and factor.count is None:
            text = "a range in a grid needs the number of its values"
            raise Problem(text, None, "count: 5", within=("factors", name))

    def _clash(self) -> str | None:
        """Return a name that two columns of the result would have, or None."""
        sigmas = [f"{name}{ending}" for name, response in self.responses.items() for ending in response.sigma_keys]
        names = ["run", "failed", "message", "seed", *self.factors, *self.responses, *sigmas]
        return next((name for name in names if names.count(name) > 1), None)


_UNIT_WORDS = frozenset(UNITS) | {"m2", "mm2", "um2"}
"""Words at the end of a key that belong to its unit."""


def unit_of(key: KeyPath) -> str:
    """Return the unit that the name of a result's key contains; empty if it contains none.

    Words after the unit are skipped: "um" for d_f_um, d_f_um_sigma_noise and d_f_um_true; "m/arcsec" for
    height_m_per_arcsec, "1/mm" for nyquist_per_mm. A name without a unit has that of the key above it: "um" for the key
    path defocus_um, centre.
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
