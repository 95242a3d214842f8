"""Plan of a study: the value of each factor in every run, the values that scale with factors, and the memory needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from scenes.specs.study import GRID, FactorSpec, StudySpec, unit_cube
from scenes.yaml.errors import InputError, KeyPath, Problem, shown
from scenes.yaml.spec import validate
from scenes.yaml.units import split_quantity, unit_ratio, with_unit
from scenes.yaml.yaml_file import YamlFile
from twin.framework.memory import Lowered, require_memory
from twin.study.runs.base_job import Run, Tree, leaf, with_values
from twin.study.runs.setup import StudySetup


def axes_of(study: StudySpec) -> list[tuple[str, ...]]:
    """Return the groups of factors that vary independently of one another.

    A group is a single factor, or the columns of one table, whose values vary together row by row.
    """
    groups: dict[str, list[str]] = {}
    for name, factor in study.factors.items():
        key = f"table {factor.table.file}" if factor.table is not None else f"factor {name}"
        groups.setdefault(key, []).append(name)
    return [tuple(names) for names in groups.values()]


def levels(factor: FactorSpec) -> int:
    """Return the number of values in a factor's list or equidistant range; 0 for a continuous distribution."""
    return (factor.count or 0) if factor.kind == "range" else len(factor.scalars()) if factor.kind in _LISTS else 0


_LISTS = ("values", "table")
"""Kinds of factors whose values are given as a list."""


def run_count(study: StudySpec) -> int:
    """Return the number of runs that follows from a study's design."""
    if study.design.runs is not None:
        return study.design.runs
    count = 1
    for axis in axes_of(study):
        count *= levels(study.factors[axis[0]])
    return count


def draw(study: StudySpec) -> dict[str, np.ndarray]:
    """Return each factor's value in every run, (runs,): numbers in the factor's unit, or indices into its list.

    In a grid, the values of the last group of factors change fastest. Distributions are sampled by the inverse of their
    distribution function, so that low-discrepancy designs keep their uniformity.
    """
    axes = axes_of(study)
    if study.design.kind == GRID:
        sizes = [levels(study.factors[axis[0]]) for axis in axes]
        indices = np.unravel_index(np.arange(run_count(study)), sizes)
        return {
            name: _level(study.factors[name], index) for axis, index in zip(axes, indices, strict=True) for name in axis
        }
    cube = unit_cube(study.design.kind, run_count(study), len(axes), study.design.seed)
    return {name: _quantile(study.factors[name], cube[:, k]) for k, axis in enumerate(axes) for name in axis}


def _level(factor: FactorSpec, index: np.ndarray) -> np.ndarray:
    if factor.kind in _LISTS:
        return index
    if factor.kind != "range":
        raise KeyError(f"a factor of kind {factor.kind!r} cannot be counted")
    low, high = factor.numbers().values
    return np.asarray(np.linspace(low, high, factor.count or 2)[index])


def _quantile(factor: FactorSpec, u: np.ndarray) -> np.ndarray:
    """Return the quantiles of a factor's distribution at probabilities ``u``."""
    # scipy is imported late, so that errors in a study's file are reported quickly
    from scipy.special import ndtr, ndtri

    if factor.kind in _LISTS:
        return np.minimum((u * levels(factor)).astype(np.int64), levels(factor) - 1)
    numbers: Sequence[float] = factor.numbers().values
    if factor.kind == "normal":
        return np.asarray(numbers[0] + numbers[1] * ndtri(u))
    if factor.kind == "truncated":
        mean, sigma, low, high = numbers
        # the inverse is computed in the nearer tail, where it does not lose digits
        a, b = (low - mean) / sigma, (high - mean) / sigma
        if a > FAR or b < -FAR:
            return np.asarray(np.clip(mean + sigma * _far(a, b, u), low, high))
        flip = a > 0.0
        first, last = (ndtr(-b), ndtr(-a)) if flip else (ndtr(a), ndtr(b))
        z = -ndtri(last - u * (last - first)) if flip else ndtri(first + u * (last - first))
        return np.asarray(np.clip(mean + sigma * z, low, high))
    if factor.kind not in ("range", "uniform"):
        raise KeyError(f"a factor of kind {factor.kind!r} has no quantiles")
    low, high = numbers
    return np.asarray(low + u * (high - low))


FAR = 5.0
"""Distance from mean to nearer limit, in sigmas, from which a truncated normal is computed in logarithms.

Beyond it the probability between the limits loses its digits in ordinary arithmetic.
"""


def _far(a: float, b: float, u: np.ndarray) -> np.ndarray:
    """Return quantiles of a standard normal distribution whose truncation limits are both far in one tail.

    ``a`` and ``b`` are the limits in sigmas, ``u`` the probabilities.
    """
    # as in ``_quantile``
    from scipy.special import log_ndtr, ndtri_exp

    if a > 0.0:
        return -_far(-b, -a, 1.0 - u)
    # both limits below the mean: log of Phi(a) + u (Phi(b) - Phi(a)), taken from the larger one
    first, last = log_ndtr(a), log_ndtr(b)
    return np.asarray(ndtri_exp(last + np.log1p((1.0 - u) * np.expm1(first - last))))


def quantiles(factor: FactorSpec, u: np.ndarray) -> np.ndarray:
    """Return the quantiles of a factor with numerical values at probabilities ``u``.

    For a list of values, a quantile is the smallest value whose cumulative probability reaches ``u``.

    Parameters
    ----------
    factor : FactorSpec
        Factor whose values are numbers.
    u : ndarray
        Probabilities between 0 and 1.
    """
    if factor.kind in _LISTS:
        return np.quantile(np.array(factor.numbers().values, np.float64), u, method="inverted_cdf")
    return _quantile(factor, u)


def extremes(factor: FactorSpec) -> list[float]:
    """Return the limits of a bounded distribution; they are validated in addition to the values of the runs."""
    numbers = factor.numbers().values
    return list(numbers[-2:]) if factor.kind in ("range", "uniform", "truncated") else []


@dataclass(frozen=True, eq=False)
class Scaling:
    """Values of the base job that scale with factors; several factors may scale the same value.

    Attributes
    ----------
    base : dict
        Key path -> number and unit in the base job; an integer where it has one there.
    ratio : dict
        Key path -> multiplier of the number in every run, (runs,).
    """

    base: Mapping[KeyPath, tuple[float | int, str]]
    ratio: Mapping[KeyPath, np.ndarray]

    def apply(self, values: dict[KeyPath, Any], run: int) -> None:
        """Multiply values of a run by their ratios: those that factors have set, and else those of the base job.

        ``values`` maps key paths to values and is changed in place.
        """
        for key, ratio in self.ratio.items():
            number = number_of(values[key]) if key in values else self.base[key]
            values[key] = scaled(number, float(ratio[run]))


def scaled(number: tuple[float | int, str], ratio: float) -> Any:
    """Return a quantity times a ratio, in the notation of a job's file.

    Parameters
    ----------
    number : tuple
        Number and unit, the unit empty for a pure number.
    ratio : float
        Multiplier of the number.
    """
    value = number[0] * ratio
    if number[1]:
        return with_unit(value, number[1])
    # a count stays a whole number, or the schema refuses it
    return int(value) if isinstance(number[0], int) and value == int(value) else value


def ratios(factor: FactorSpec, tree: Tree, values: np.ndarray, unit: str) -> dict[KeyPath, np.ndarray]:
    """Return the multipliers of the values that scale with a factor, by key path, each with the shape of ``values``.

    Parameters
    ----------
    factor : FactorSpec
        Factor with its ``scales``.
    tree : dict
        Plain data of the base job.
    values : ndarray
        Values of the factor.
    unit : str
        Unit of the values, empty for pure numbers.

    Raises
    ------
    Problem
        The factor's value in the base job is zero or no number, or a power is undefined.
    """
    out = {}
    for k, scale in enumerate(factor.scales):
        with np.errstate(all="ignore"):
            multipliers = np.power(np.asarray(values, np.float64) / _nominal(factor, tree, unit), scale.power)
        if not np.all(np.isfinite(multipliers)):
            shortage = f"power {scale.power:g} of a ratio of {values[np.argmin(np.isfinite(multipliers))]:g}"
            raise Problem("no such number", shortage, "values greater than zero", within=("scales", k, "power"))
        out[scale.key] = multipliers
    return out


def _nominal(factor: FactorSpec, tree: Tree, unit: str) -> float:
    """Return the factor's value in the base job, in its own unit; 1 for a factor that is itself a multiplier."""
    if not factor.key_paths:
        return 1.0
    number = number_at(tree, factor.key_paths[0], unit)
    if number == 0.0:
        raise Problem("a ratio to zero is not defined", "zero in the base", "scales in a factor without a key")
    return number


def number_at(base: Tree, key: KeyPath, unit: str) -> float:
    """Return the number that the base job has at a factor's key, in a unit.

    Parameters
    ----------
    base : dict
        Plain data of the base job, without values of factors.
    key : KeyPath
        Key path of the factor.
    unit : str
        Unit of the factor's numbers, empty for pure numbers.

    Raises
    ------
    Problem
        The base job has no value there, or one of a different kind.
    """
    try:
        value = leaf(base, key)
    except Problem:
        value = None
    number = None if value is None else number_in(value, unit)
    if number is None:
        shown_value = "nothing" if value is None else f"{shown(value)} in the base"
        allowed = "a number like the factor's, which the base's file states"
        raise Problem("the base has no number here to start from", shown_value, allowed)
    return number


def number_in(value: Any, unit: str) -> float | None:
    """Return a value of a job's plain data as a number in a unit; None if it is not a number of that dimension.

    Parameters
    ----------
    value : str, float, int or other plain value
        Value in a job's plain data.
    unit : str
        Unit, empty for pure numbers.
    """
    parts = split_quantity(value)
    if parts is not None:
        return parts[0] * unit_ratio(parts[1], unit) if unit else None
    return None if unit or isinstance(value, bool) or not isinstance(value, int | float) else float(value)


def number_of(value: Any) -> tuple[float | int, str]:
    """Return number and unit of a value in a job's plain data; the unit is empty for a pure number.

    Raises
    ------
    Problem
        The value is not a number.
    """
    parts = split_quantity(value)
    if parts is not None:
        return parts
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Problem("not a number", shown(value), "a key that leads to a number or a quantity")
    return value, ""


@dataclass(frozen=True, eq=False)
class Column:
    """Values of one factor in all runs of a study.

    Attributes
    ----------
    name : str
        Name of the factor.
    unit : str
        Unit of the numbers; empty for pure numbers and for texts.
    values : (runs,) ndarray
        Values: float64, int64, bool or text.
    """

    name: str
    unit: str
    values: np.ndarray

    def cell(self, run: int) -> Any:
        """Return the factor's value in a run in the notation of a job's file."""
        value = self.values[run].item()
        return with_unit(value, self.unit) if self.unit else value


@dataclass(frozen=True, eq=False)
class Plan:
    """All runs of a study.

    Attributes
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    columns : tuple[Column, ...]
        Values of every factor, in the study's order.
    """

    setup: StudySetup
    columns: tuple[Column, ...]

    @classmethod
    def of(cls, setup: StudySetup) -> Plan:
        """Return the plan of a study.

        Raises
        ------
        InputError
            A factor takes a value that the base job's schema does not allow.
        """
        sampled = draw(setup.study)
        plan = cls(setup, tuple(_column(setup, name, values) for name, values in sampled.items()))
        plan.check()
        return plan

    @cached_property
    def config(self) -> str:
        """Text of the study's config.yaml."""
        return self.setup.to_yaml()

    @property
    def runs(self) -> int:
        """Number of runs of the study."""
        return run_count(self.setup.study)

    @property
    def blocks(self) -> int:
        """Number of blocks of runs that are evaluated together."""
        return -(-self.runs // self.setup.job.block)

    def block(self, number: int) -> range:
        """Return the numbers of the runs that belong to a block."""
        size = self.setup.job.block
        return range(number * size, min((number + 1) * size, self.runs))

    @cached_property
    def scaling(self) -> Scaling:
        """Values of the base job that scale with factors, and their multipliers in every run.

        Raises
        ------
        InputError
            A value is not a number, or a power is undefined.
        """
        base: dict[KeyPath, tuple[float | int, str]] = {}
        ratio: dict[KeyPath, np.ndarray] = {}
        for column in self.columns:
            factor = self.setup.study.factors[column.name]
            for k, scale in enumerate(factor.scales):
                try:
                    base[scale.key] = number_of(leaf(self.setup.tree, scale.key))
                except Problem as problem:
                    raise self.setup.error(problem, ("factors", column.name, "scales", k, "key")) from None
            for key, multipliers in self._ratios(column, column.values).items():
                ratio[key] = ratio[key] * multipliers if key in ratio else multipliers
        return Scaling(base, ratio)

    def _ratios(self, column: Column, values: np.ndarray) -> dict[KeyPath, np.ndarray]:
        factor = self.setup.study.factors[column.name]
        try:
            return ratios(factor, self.setup.base, values, column.unit) if factor.scales else {}
        except Problem as problem:
            raise self.setup.error(problem, ("factors", column.name)) from None

    @cached_property
    def seeds(self) -> np.ndarray | None:
        """Seed of every run, (runs,) int64; None if all runs have the base job's seed."""
        if self.setup.study.noise == "shared":
            return None
        seed = self.setup.study.design.seed
        words = (np.random.SeedSequence(seed, spawn_key=(i,)).generate_state(1, np.uint64)[0] for i in range(self.runs))
        return np.array([int(word) >> 1 for word in words], np.int64)

    def run(self, number: int) -> Run:
        """Return one run: its number, its values for the base job, and its seed."""
        factors = self.setup.study.factors
        values = {key: c.cell(number) for c in self.columns for key in factors[c.name].key_paths}
        self.scaling.apply(values, number)
        return Run(number, tuple(values.items()), None if self.seeds is None else int(self.seeds[number]))

    def check(self) -> None:
        """Validate each factor's smallest and largest value, and every text, in the base job, one factor at a time.

        The schema's limits are intervals, so that values between two valid ones are valid. Combinations that are
        impossible are found when they are run, and fail individually.

        Raises
        ------
        InputError
            A value is invalid; the error is placed at the factor's line.
        """
        for column in self.columns:
            factor = self.setup.study.factors[column.name]
            for value in _telling(column, extremes(factor)):
                cell = with_unit(value, column.unit) if column.unit else value
                multipliers = self._ratios(column, np.array([value]))
                follow = [(key, scaled(self.scaling.base[key], float(ratio[0]))) for key, ratio in multipliers.items()]
                self._check_value(column.name, [*((key, cell) for key in factor.key_paths), *follow])

    def _check_value(self, name: str, values: list[tuple[Any, Any]]) -> None:
        tree = with_values(self.setup.tree, values)
        try:
            validate(self.setup.job.model, YamlFile("", tree, {}))
        except InputError as error:
            factor, issue = self.setup.study.factors[name], error.issues[0]
            problem = Problem(issue.problem, issue.value, issue.allowed, issue.suggestion)
            raise self.setup.error(problem, ("factors", name, factor.kind)) from None


def _column(setup: StudySetup, name: str, sampled: np.ndarray) -> Column:
    factor = setup.study.factors[name]
    numbers = factor.numbers()
    if factor.kind not in ("values", "table"):
        return Column(name, numbers.unit or "", _like(setup, name, sampled))
    if numbers.numeric:
        listed = np.array(numbers.values, np.float64)
        # larger whole numbers are not exact in float64; the base job refuses them
        whole = numbers.whole and bool(np.all(np.abs(listed) < 2.0**53))
        return Column(name, numbers.unit or "", (listed.astype(np.int64) if whole else listed)[sampled])
    scalars = factor.scalars()
    if all(isinstance(value, bool) for value in scalars):
        return Column(name, "", np.array(scalars, bool)[sampled])
    if not all(isinstance(value, str) for value in scalars):
        problem = Problem("values of different types", None, "all numbers, all quantities, or all texts")
        raise setup.error(problem, ("factors", name, factor.kind))
    return Column(name, "", np.array(scalars, np.str_)[sampled])


def _like(setup: StudySetup, name: str, sampled: np.ndarray) -> np.ndarray:
    """Return a factor's pure numbers as integers if all are whole and the base job has an integer there."""
    factor = setup.study.factors[name]
    node = leaf(setup.tree, factor.key_paths[0]) if factor.key_paths else None
    whole = isinstance(node, int) and not isinstance(node, bool) and factor.unit is None
    return sampled.astype(np.int64) if whole and np.all(sampled == np.rint(sampled)) else sampled


def _telling(column: Column, limits: list[float]) -> list[Any]:
    """Return the values of a factor that must be validated: all texts and switches, smallest and largest number.

    ``limits`` are the limits of a bounded distribution.
    """
    if column.values.dtype.kind in "US":
        return list(dict.fromkeys(column.values.tolist()))
    if column.values.dtype.kind == "b":
        return sorted(set(column.values.tolist()))
    low, high = column.values.min().item(), column.values.max().item()
    if column.values.dtype.kind == "f" and limits:
        low, high = min(low, *limits), max(high, *limits)
    return [low, high]


STARTED = 110e6
"""Memory in bytes for writing the report of a study of any size, in addition to the imported program."""
CELL = 120.0
"""Memory in bytes for each number of a run: computation, data set and text table together."""
_KEPT = 5
"""Number of bookkeeping columns of every study: number, failed, message, doubt, seed."""


def study_bytes(setup: StudySetup, runs: int) -> float:
    """Return the memory of the process that collects the results, in addition to the imported program, in bytes.

    Parameters
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    runs : int
        Number of runs.
    """
    responses = setup.study.responses.values()
    columns = _KEPT + len(setup.study.factors) + sum(1 + len(response.sigma_keys) for response in responses)
    return STARTED + CELL * columns * runs


def require_study_memory(setup: StudySetup) -> None:
    """Raise InputError if the results of all runs exceed the free memory or the limit of the study.

    The computing time is estimated from a first block of runs before the others begin (`twin.study.runs.blocks`).

    Parameters
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.

    Raises
    ------
    InputError
        The results do not fit; the error gives the number of runs that would.
    """
    study, runs = setup.study, run_count(setup.study)
    key: KeyPath = ("factors",) if study.design.kind == GRID else ("design", "runs")
    lower = Lowered(study, key, runs, "runs", lambda n: study_bytes(setup, n))
    require_memory(lower, started=0.0, file_limit=study.limits.bytes, limit_key="limits.memory")
