"""Importance sampling: random directions of diffused and scattered light, and random termination of weak paths.

A surface diffuses light or scatters it about the specular direction; the directions are drawn for each path.

The survival probability of paths that leave nominal light is learnt from the first paths of a run (Russian roulette).
Paths that leave the nominal light after the same number of surfaces form a class. Some classes bring light to the
detectors, such as reflections inside a prism; others bring none, and may be long. Let v be the sum of the squared
weights that a class brings and c the number of surfaces that it meets. The variance of a run of given duration is
smallest where each class is followed with a probability proportional to sqrt(v / c) (Neyman, 1934, for strata of
unequal costs). Surviving paths carry more weight, so that all expected sums are unchanged. Paths that miss a surface of
the nominal path are all followed: they carry most of the light, and are short.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np

from optics.materials import fresnel_scatter
from optics.numerics.backend import Backend
from twin.path_tracing.path_families import Event

NEAREST = 1e-6
"""Smallest distance from the specular direction that ``near_distance`` draws, in direction cosines."""


def near_distance(u: Any) -> Any:
    """Draw the distance of a scattered direction from the specular one, in direction cosines, log-uniformly.

    It is between ``NEAREST`` and ``fresnel_scatter.MAX_DISTANCE``; u is a uniform random number in [0, 1).
    """
    import drjit as dr

    return NEAREST * dr.exp(u * log(fresnel_scatter.MAX_DISTANCE / NEAREST))


def near_density(distance: Any) -> Any:
    """Return the density of the squared distance that ``near_distance`` draws, per squared direction cosine."""
    import drjit as dr

    return dr.select(
        distance >= NEAREST, 0.5 / (log(fresnel_scatter.MAX_DISTANCE / NEAREST) * distance * distance), 0.0
    )


@dataclass(frozen=True, eq=False)
class OutgoingPaths:
    """Paths that leave a surface, as Dr.Jit arrays.

    Attributes
    ----------
    direction : Dr.Jit Vector3
        Specular or refracted direction.
    normal : Dr.Jit Vector3
        Unit normal, on either side.
    index : Dr.Jit array
        Refractive index on the side that the path goes to.
    event : Dr.Jit array
        Number of the event at the surface, a value of ``path_families.Event``.
    weight : Dr.Jit array
        Weight of the path.
    toward : Dr.Jit array
        Cosine of the arriving direction with ``normal``.
    diffusing : Dr.Jit mask
        True where the path is diffused.
    """

    direction: Any
    normal: Any
    index: Any
    event: Any
    weight: Any
    toward: Any
    diffusing: Any


@dataclass(frozen=True, eq=False)
class TableSampling:
    """Measured scattering of the surfaces that paths leave.

    Attributes
    ----------
    tables : FinishTables
        Tables of the scene's measured surface finishes.
    marks : Dr.Jit array
        Numbers of the coating table and the scatter table of each path's surface finish, see ``tables.MARKS``.
    cosine : Dr.Jit array
        Cosine of the angle of incidence.
    """

    tables: Any
    marks: Sequence[Any]
    cosine: Any


def sample_scattering(
    rng: Any, met: Any, specular: Any, share: Any, floor: Any, weight: Any, all_of_it: bool = False
) -> tuple[Any, Any]:
    """Draw which paths are scattered, and return them with the weights of all paths.

    Parameters
    ----------
    rng : Dr.Jit random generator
        Random generator.
    met : Dr.Jit mask
        Paths that are at a surface.
    specular : Dr.Jit mask
        Those of them that are reflected or transmitted.
    share : Dr.Jit array
        Share of the light that is scattered.
    floor : Dr.Jit array
        Smallest probability of scattering where the share is not zero.
    weight : Dr.Jit array
        Weights of the paths.
    all_of_it : bool
        True if a surface may scatter all of the light.

    Returns
    -------
    tuple of (Dr.Jit mask, Dr.Jit array)
        Mask of the scattered paths, and the weights.
    """
    import drjit as dr

    chance = dr.select(share > 0.0, dr.maximum(share, floor), 0.0)
    scattering = specular & (rng.next_float64(met) < chance)
    # where all light is scattered, no path remains specular
    left = dr.maximum(1.0 - chance, 1e-300) if all_of_it else 1.0 - chance
    after = dr.select(scattering, weight * share / chance, weight)
    return scattering, dr.select(specular & ~scattering, weight * (1.0 - share) / left, after)


def sample_bsdf(
    backend: Backend,
    rng: Any,
    met: Any,
    share: Any,
    lobe: Callable[[Any], Sequence[Any]],
    floor: Any,
    near: Any,
    leaving: OutgoingPaths,
    drawn: TableSampling | None = None,
) -> tuple[Any, Any, Any, Any]:
    """Draw the direction of light that is diffused, or scattered into the lobe around the specular direction.

    Parameters
    ----------
    backend : Backend
        Array types.
    rng : Dr.Jit random generator
        Random generator.
    met : Dr.Jit mask
        Paths that are at a surface.
    share : Dr.Jit array
        Share of the light whose direction is drawn from a lobe.
    lobe : callable
        Returns scale, exponent, kind and area of the lobe for active paths.
    floor : Dr.Jit array
        Smallest probability of drawing from a lobe that exists.
    near : Dr.Jit array
        Share of the directions that are drawn with ``near_distance``; None if none are.
    leaving : OutgoingPaths
        Paths as they would continue without scattering.
    drawn : TableSampling or None
        Measured scattering, None where there is none; ``share`` is then that of the tables.

    Returns
    -------
    tuple of (Dr.Jit Vector3, Dr.Jit array, Dr.Jit array, Dr.Jit random generator)
        Direction, event, weight and random generator.
    """
    import drjit as dr

    specular = met & ~leaving.diffusing
    scattering, weight = sample_scattering(rng, met, specular, share, floor, leaving.weight, drawn is not None)

    def scatter(direction: Any, event: Any, weight: Any, rng: Any) -> tuple[Any, Any, Any, Any]:
        scale, exponent, kind, area = lobe(scattering)
        u, v, keep = rng.next_float64(), rng.next_float64(), rng.next_float64()
        n = leaving.normal
        up = dr.copysign(1.0, dr.select(leaving.diffusing, -leaving.toward, dr.dot(direction, n)))
        side = n * up
        distance = fresnel_scatter.sample_distance(u, scale, exponent)
        if near is not None:
            by_distance = rng.next_float64() < near
            distance = dr.select(by_distance, near_distance(u), distance)
            # the weight divides by the density of both ways of drawing this distance
            x = distance / scale
            plain = dr.exp(-0.5 * exponent * dr.log(dr.fma(x, x, 1.0))) / area
            ours = (1.0 - near) * plain + near * near_density(distance)
            lobed = scattering if drawn is None else scattering & (drawn.marks[1] < 0.5)
            weight = dr.select(lobed, weight * plain / ours, weight)
        survival = keep < fresnel_scatter.acceptance(distance, scale, exponent, kind)
        distance = dr.select(leaving.diffusing, dr.sqrt(u), distance)
        index = dr.select(leaving.diffusing, 1.0, leaving.index)
        sine, cosine = dr.sincos(2.0 * dr.pi * v)
        sign = dr.copysign(backend.Float(1.0), side.z)
        a = -1.0 / (sign + side.z)
        b = side.x * side.y * a
        e1 = backend.Vector3(1.0 + sign * side.x * side.x * a, sign * b, -sign * side.x)
        e2 = backend.Vector3(b, sign + side.y * side.y * a, -side.y)
        around = index * (direction - dr.dot(direction, side) * side)
        along = dr.select(leaving.diffusing, backend.Vector3(0.0), around)
        along = along + (distance * cosine) * e1 + (distance * sine) * e2
        rest = index * index - dr.dot(along, along)
        survival = (survival | leaving.diffusing) & (rest > 0.0)
        new = dr.normalize(along + dr.sqrt(dr.maximum(rest, 0.0)) * side)
        if drawn is not None:
            table = (drawn.marks[1] > 0.5) & ~leaving.diffusing
            four = (keep, u, v, rng.next_float64())
            by_table = drawn.tables.draw(drawn.marks, drawn.cosine, direction, side, four, table)
            new = dr.select(table, by_table, new)
            survival |= table
        scattered = dr.select(
            event == int(Event.TRANSMIT), backend.UInt(int(Event.SCATTER_THROUGH)), int(Event.SCATTER)
        )
        event = dr.select(survival & ~leaving.diffusing, scattered, event)
        return dr.select(survival, new, direction), event, weight, rng

    return dr.if_stmt(
        (leaving.direction, leaving.event, weight, rng),
        scattering | (met & leaving.diffusing),
        scatter,
        lambda *same: same,
        arg_labels=("direction", "event", "weight", "rng"),
        label="scatter",
        mode="symbolic",
    )


LEAST_SURVIVAL = 0.2
"""Smallest survival probability of a path.

A class of paths (those that left nominal light after the same number of surfaces) from which the first paths brought
nothing to the detectors may still bring light, and is sampled with at most five times the variance.
"""

PRIOR = 0.1
"""Share of the variance that is attributed to all classes of paths in equal parts before anything is learnt.

A class is the paths that leave nominal light after the same number of surfaces.
"""

NOMINAL_COST = 0.15
"""Computing time of a path at a surface of the nominal path, relative to that at any other surface; as measured."""


@dataclass(frozen=True, eq=False)
class LearnedRoulette:
    """Russian roulette of paths that leave nominal light, with learnt survival probabilities.

    Attributes
    ----------
    survival : ndarray
        Survival probability by the number of nominal surfaces passed.
    first : int
        Number of the first path that may be ended.
    seed : int
        Seed of the random numbers; the fate of a path depends on it and on the path's number alone.
    """

    survival: np.ndarray
    first: int
    seed: int

    def survival_probability(self, numbers: np.ndarray, passed: np.ndarray) -> np.ndarray:
        """Return the survival probability of each path, by its number in the run and the nominal surfaces passed.

        ``numbers`` and ``passed`` have one entry per path.
        """
        known = np.minimum(passed, len(self.survival) - 1)
        return np.where((numbers < self.first) | (passed >= len(self.survival)), 1.0, self.survival[known])

    def survives(self, numbers: np.ndarray, survival_probability: np.ndarray) -> np.ndarray:
        """Draw which paths survive, from the seed and the paths' numbers; return a mask."""
        with np.errstate(over="ignore"):
            # splitmix64 of Steele, Lea and Flood (2014), with other constants than those of the paths' random streams
            z = (numbers.astype(np.uint64) + np.uint64(self.seed)) * np.uint64(0xD1342543DE82EF95)
            z += np.uint64(0x2545F4914F6CDD1D)
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z ^= z >> np.uint64(31)
        return np.asarray((z >> np.uint64(11)).astype(np.float64) * 2.0**-53 < survival_probability)


@dataclass(frozen=True, eq=False)
class PathHistory:
    """History of the N paths of a launch.

    Attributes
    ----------
    passed : (N,) ndarray
        Number of surfaces of the nominal path that were passed.
    turned : (N,) ndarray of bool
        True where the path left the nominal path at a surface; False where it missed the next one or reached the
        detector.
    steps : (N,) ndarray
        Number of surfaces that the path met after it left the nominal path.
    """

    passed: np.ndarray
    turned: np.ndarray
    steps: np.ndarray


def learn_survival(launches: Sequence[tuple[PathHistory, np.ndarray, np.ndarray]], seed: int) -> LearnedRoulette:
    """Return survival probabilities learnt from the first paths of a run.

    Parameters
    ----------
    launches : sequence of (PathHistory, ndarray, ndarray)
        Launches of these paths, numbered from 0: histories, numbers of the paths that brought light to a detector off
        the nominal path (with repetitions), and the weights of that light.
    seed : int
        Seed of the random numbers that decide survival.
    """
    passed, turned, steps = (
        np.concatenate([getattr(done, name) for done, _, _ in launches]) for name in ("passed", "turned", "steps")
    )
    paths, weights = (np.concatenate([one[k] for one in launches]) for k in (1, 2))
    count, classes = len(passed), int(passed.max()) + 1
    brought = np.bincount(paths.astype(np.int64), weights, count) ** 2

    def of_classes(values: np.ndarray) -> np.ndarray:
        return np.bincount(passed[turned], values[turned], classes)

    number, cost, variance = (of_classes(values) for values in (np.ones(count), steps, brought))
    rest = NOMINAL_COST * passed.sum() + steps.sum() - cost.sum()
    fixed = brought.sum() - variance.sum()
    present = number > 0
    variance = np.where(present, variance + PRIOR * variance.sum() / max(present.sum(), 1), 0.0)
    ideal = np.sqrt(variance / np.maximum(cost, 1.0))
    choices = [np.clip(ideal / most, LEAST_SURVIVAL, 1.0) for most in np.unique(ideal[ideal > 0.0])]
    costs = [((variance / survival).sum() + fixed) * ((survival * cost).sum() + rest) for survival in choices]
    survival = choices[int(np.argmin(costs))] if choices else np.ones(classes)
    return LearnedRoulette(np.where(present, survival, 1.0), count, seed)
