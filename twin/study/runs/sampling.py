"""Designs: which values of its factors every run gets, and values of the base that follow a factor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scenes.specs.study import GRID, FactorSpec, StudySpec, unit_cube
from scenes.yaml.errors import KeyPath, Problem, shown
from scenes.yaml.units import split_quantity, unit_ratio, with_unit
from twin.study.runs.base_job import Tree, leaf


def axes_of(study: StudySpec) -> list[tuple[str, ...]]:
    """Factors that vary independently: each alone, but columns of one table together, row by row."""
    groups: dict[str, list[str]] = {}
    for name, factor in study.factors.items():
        key = f"table {factor.table.file}" if factor.table is not None else f"factor {name}"
        groups.setdefault(key, []).append(name)
    return [tuple(names) for names in groups.values()]


def levels(factor: FactorSpec) -> int:
    """Number of values of a factor that can be counted; 0 for a distribution."""
    return (factor.count or 0) if factor.kind == "range" else len(factor.scalars()) if factor.kind in _LISTS else 0


_LISTS = ("values", "table")


def run_count(study: StudySpec) -> int:
    """Number of runs."""
    if study.design.runs is not None:
        return study.design.runs
    count = 1
    for axis in axes_of(study):
        count *= levels(study.factors[axis[0]])
    return count


def draw(study: StudySpec) -> dict[str, np.ndarray]:
    """What every run takes of each factor: (runs,) numbers in the factor's unit, or of lists the index of the value.

    The last axis of a grid changes fastest. Distributions are reached by the inverse of their distribution function, so
    that evenly spread designs stay so.
    """
    axes = axes_of(study)
    if study.design.kind == GRID:
        sizes = [levels(study.factors[axis[0]]) for axis in axes]
        places = np.unravel_index(np.arange(run_count(study)), sizes)
        return {
            name: _level(study.factors[name], place) for axis, place in zip(axes, places, strict=True) for name in axis
        }
    cube = unit_cube(study.design.kind, run_count(study), len(axes), study.design.seed)
    return {name: _quantile(study.factors[name], cube[:, k]) for k, axis in enumerate(axes) for name in axis}


def _level(factor: FactorSpec, place: np.ndarray) -> np.ndarray:
    if factor.kind in _LISTS:
        return place
    if factor.kind != "range":
        raise KeyError(f"a factor of kind {factor.kind!r} cannot be counted")
    low, high = factor.numbers().values
    return np.asarray(np.linspace(low, high, factor.count or 2)[place])


def _quantile(factor: FactorSpec, u: np.ndarray) -> np.ndarray:
    """Values of a factor where its distribution function is ``u``."""
    # a bad file of a study is told before scipy is imported
    from scipy.special import ndtr, ndtri

    if factor.kind in _LISTS:
        return np.minimum((u * levels(factor)).astype(np.int64), levels(factor) - 1)
    numbers: Sequence[float] = factor.numbers().values
    if factor.kind == "normal":
        return np.asarray(numbers[0] + numbers[1] * ndtri(u))
    if factor.kind == "truncated":
        mean, sigma, low, high = numbers
        # the inverse is taken in the nearer tail, where it has digits
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
"""Limits that all lie further out, in sigmas: there the share of the normal distribution between them has no digits,
its logarithm does."""


def _far(a: float, b: float, u: np.ndarray) -> np.ndarray:
    """Quantiles of a normal distribution of sigma 1 between limits far in one of its tails."""
    # as in ``_quantile``
    from scipy.special import log_ndtr, ndtri_exp

    if a > 0.0:
        return -_far(-b, -a, 1.0 - u)
    # both limits below the mean: log of Phi(a) + u (Phi(b) - Phi(a)), taken from the larger one
    first, last = log_ndtr(a), log_ndtr(b)
    return np.asarray(ndtri_exp(last + np.log1p((1.0 - u) * np.expm1(first - last))))


def quantiles(factor: FactorSpec, u: np.ndarray) -> np.ndarray:
    """Where the distribution function of a factor of numbers is ``u``; of a list the least of its values where that is
    reached.

    Args:
        factor: whose values are numbers.
        u: shares between 0 and 1.
    """
    if factor.kind in _LISTS:
        return np.quantile(np.array(factor.numbers().values, np.float64), u, method="inverted_cdf")
    return _quantile(factor, u)


def extremes(factor: FactorSpec) -> list[float]:
    """Numbers of a distribution at which the base's limits are tried; the plan's own values matter beside them."""
    numbers = factor.numbers().values
    return list(numbers[-2:]) if factor.kind in ("range", "uniform", "truncated") else []


@dataclass(frozen=True, eq=False)
class Scaling:
    """All values of a study that are scaled; several factors may scale one of them.

    Attributes:
        base: place -> number and unit as the base has them; the number is whole where the base's is.
        ratio: place -> (runs,) what the number is multiplied by.
    """

    base: Mapping[KeyPath, tuple[float | int, str]]
    ratio: Mapping[KeyPath, np.ndarray]

    def apply(self, values: dict[KeyPath, Any], run: int) -> None:
        """Scale what factors have set in a run, and add what they have not, as it stands in the base's tree."""
        for place, ratio in self.ratio.items():
            number = number_of(values[place]) if place in values else self.base[place]
            values[place] = scaled(number, float(ratio[run]))


def scaled(number: tuple[float | int, str], ratio: float) -> Any:
    """Number and unit, times a ratio, as they stand in a tree.

    Args:
        number: number and unit, the unit empty for a pure number.
        ratio: that the number is multiplied by.
    """
    value = number[0] * ratio
    if number[1]:
        return with_unit(value, number[1])
    # a count stays a whole number, or the schema refuses it
    return int(value) if isinstance(number[0], int) and value == int(value) else value


def ratios(factor: FactorSpec, tree: Tree, values: np.ndarray, unit: str) -> dict[KeyPath, np.ndarray]:
    """What the values that follow a factor are multiplied by: place -> array like ``values``.

    Args:
        factor: with its ``scales``.
        tree: of the base.
        values: of the factor.
        unit: of them, empty for pure numbers.

    Raises:
        Problem: the factor's value in the base is none that anything can be compared with, or a power does not exist.
    """
    out = {}
    for k, scale in enumerate(factor.scales):
        with np.errstate(all="ignore"):
            found = np.power(np.asarray(values, np.float64) / _nominal(factor, tree, unit), scale.power)
        if not np.all(np.isfinite(found)):
            shortage = f"power {scale.power:g} of a ratio of {values[np.argmin(np.isfinite(found))]:g}"
            raise Problem("no such number", shortage, "values greater than zero", within=("scales", k, "power"))
        out[scale.key] = found
    return out


def _nominal(factor: FactorSpec, tree: Tree, unit: str) -> float:
    """The factor's value in the base, in its own unit; 1 for a factor that is itself the ratio."""
    if not factor.places:
        return 1.0
    number = number_at(tree, factor.places[0], unit)
    if number == 0.0:
        raise Problem("nothing to compare it with", "zero in the base", "scales in a factor without a key")
    return number


def number_at(base: Tree, place: KeyPath, unit: str) -> float:
    """Return the number that the base has at the place of a factor, in a unit.

    Args:
        base: the base's own tree, without values of factors.
        place: of the factor.
        unit: of the factor's numbers, empty for pure numbers.

    Raises:
        Problem: the base has no value there, or none of that kind.
    """
    try:
        value = leaf(base, place)
    except Problem:
        value = None
    number = None if value is None else number_in(value, unit)
    if number is None:
        found = "nothing" if value is None else f"{shown(value)} in the base"
        allowed = "a number like the factor's, which the base's file states"
        raise Problem("the base has no number here to start from", found, allowed)
    return number


def number_in(value: Any, unit: str) -> float | None:
    """The number of a value in a unit; None where it is no number of that kind.

    Args:
        value: as it stands in a tree.
        unit: of the same dimension, empty for pure numbers.
    """
    parts = split_quantity(value)
    if parts is not None:
        return parts[0] * unit_ratio(parts[1], unit) if unit else None
    return None if unit or isinstance(value, bool) or not isinstance(value, int | float) else float(value)


def number_of(value: Any) -> tuple[float | int, str]:
    """Number and unit of a value of the tree, the unit empty for a pure number.

    Raises:
        Problem: it has none.
    """
    parts = split_quantity(value)
    if parts is not None:
        return parts
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Problem("not a number", shown(value), "a key that leads to a number or a quantity")
    return value, ""
