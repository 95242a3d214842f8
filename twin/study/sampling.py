"""Designs: which values of its factors every run of a study gets. A pure function of the study and its seed."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr, ndtri

from scenes.study import StudySpec
from scenes.study_factor import FactorSpec

SMALLEST = 2.0**-53
"""Draws lie in [SMALLEST, 1 - SMALLEST], where normal quantiles are finite (8.2 sigma)."""


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
    if study.design.kind == "grid":
        sizes = [levels(study.factors[axis[0]]) for axis in axes]
        places = np.unravel_index(np.arange(run_count(study)), sizes)
        return {
            name: _level(study.factors[name], place) for axis, place in zip(axes, places, strict=True) for name in axis
        }
    cube = unit_cube(study.design.kind, run_count(study), len(axes), study.design.seed)
    return {name: _quantile(study.factors[name], cube[:, k]) for k, axis in enumerate(axes) for name in axis}


def unit_cube(kind: str, runs: int, dimensions: int, seed: int) -> np.ndarray:
    """Points of a design in the unit cube, (runs, dimensions)."""
    # takes a second to import, and a worker does not need it
    from scipy.stats import qmc

    generator = np.random.default_rng(np.random.SeedSequence(seed))
    if kind == "latin_hypercube":
        cube = qmc.LatinHypercube(dimensions, rng=generator).random(runs)
    elif kind == "sobol":
        with warnings.catch_warnings():
            # the user chose the number of runs; the points are those of the sequence all the same
            warnings.filterwarnings("ignore", message="The balance properties")
            cube = qmc.Sobol(dimensions, scramble=True, rng=generator).random(runs)
    else:
        cube = generator.random((runs, dimensions))
    return np.clip(np.asarray(cube, np.float64), SMALLEST, 1.0 - SMALLEST)


def _level(factor: FactorSpec, place: np.ndarray) -> np.ndarray:
    if factor.kind in _LISTS:
        return place
    low, high = factor.numbers().values
    return np.asarray(np.linspace(low, high, factor.count or 2)[place])


def _quantile(factor: FactorSpec, u: np.ndarray) -> np.ndarray:
    """Values of a factor where its distribution function is ``u``."""
    if factor.kind in _LISTS:
        return np.minimum((u * levels(factor)).astype(np.int64), levels(factor) - 1)
    numbers: Sequence[float] = factor.numbers().values
    if factor.kind == "normal":
        return np.asarray(numbers[0] + numbers[1] * ndtri(u))
    if factor.kind == "truncated":
        mean, sigma, low, high = numbers
        # the inverse is taken in the nearer tail, where it has digits
        a, b = (low - mean) / sigma, (high - mean) / sigma
        flip = a > 0.0
        first, last = (ndtr(-b), ndtr(-a)) if flip else (ndtr(a), ndtr(b))
        z = -ndtri(last - u * (last - first)) if flip else ndtri(first + u * (last - first))
        return np.asarray(np.clip(mean + sigma * z, low, high))
    low, high = numbers
    return np.asarray(low + u * (high - low))


def extremes(factor: FactorSpec) -> list[float]:
    """Numbers of a distribution at which the base's limits are tried; the plan's own values matter beside them."""
    numbers = factor.numbers().values
    return list(numbers[-2:]) if factor.kind in ("range", "uniform", "truncated") else []
