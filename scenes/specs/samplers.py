"""Samplers of studies: how a design spreads its runs over the values of its factors."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

GRID = "grid"
"""The kind that draws nothing: every combination."""


@dataclass(frozen=True)
class Sampler:
    """How a design spreads its runs.

    Attributes:
        title: for readers.
        points: number of runs, number of independent factors, generator of all that is drawn -> points of the unit
            cube, (runs, factors) in [0, 1]. A factor takes the value at which its distribution function is the point's
            coordinate.
        even: whether the points lie more evenly than independent ones, so that means are known better than by
            sigma/sqrt(n).
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


SAMPLERS: dict[str, Sampler] = {
    "latin_hypercube": Sampler("Latin hypercube", _latin_hypercube, even=True),
    "sobol": Sampler("scrambled Sobol sequence", _sobol, even=True),
    "monte_carlo": Sampler("Monte Carlo", _monte_carlo),
}
"""Kind of a design that draws -> its sampler. A new one is added here, and its name can be written in a study."""


def unit_cube(kind: str, runs: int, factors: int, seed: int) -> np.ndarray:
    """Points of a design in the open unit cube, (runs, factors).

    Args:
        kind: one of SAMPLERS.
        runs: number of points.
        factors: number of coordinates.
        seed: of what is drawn.

    Raises:
        KeyError: no such kind.
        ValueError: the sampler gave no points of that cube.
    """
    generator = np.random.default_rng(np.random.SeedSequence(seed))
    cube = np.asarray(SAMPLERS[kind].points(runs, factors, generator), np.float64)
    if cube.shape != (runs, factors) or not np.all((cube >= 0.0) & (cube <= 1.0)):
        raise ValueError(f"the sampler {kind} must give points {(runs, factors)} in [0, 1], gave {cube.shape}")
    return np.clip(cube, SMALLEST, 1.0 - SMALLEST)
