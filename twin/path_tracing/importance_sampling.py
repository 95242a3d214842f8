"""Directions into which a surface diffuses light or scatters it about the specular direction, drawn for each path.

How many of the paths that leave nominal light are worth following, learned from the first paths of a run.

Paths that turn away at the same place of the nominal way form a class. Some classes bring light to the detectors, such
as reflections inside a prism; others bring none, and may be long. With v the sum of the squared weights that a class
brings and c the surfaces that it meets, the variance of a run in a given time is least where each class is followed
with a probability that goes as sqrt(v / c) (Neyman, 1934, for strata of unequal costs). Those that go on carry more
weight, so that all sums stay the same on average. Paths that miss a surface of the nominal way are all followed: they
carry most of the light, and are short.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np

from optics.materials import fresnel_scatter
from optics.numerics.backend import Backend
from twin.path_tracing.path_families import Event

NEAREST = 1e-6
"""Smallest distance of ``near_distance``, in direction cosines."""


def near_distance(u: Any) -> Any:
    """Distance between ``NEAREST`` and ``scatter.MAX_DISTANCE``, even in its logarithm, from u in [0, 1)."""
    import drjit as dr

    return NEAREST * dr.exp(u * log(fresnel_scatter.MAX_DISTANCE / NEAREST))


def near_density(distance: Any) -> Any:
    """Density of the square of ``near_distance``."""
    import drjit as dr

    return dr.select(distance >= NEAREST, 0.5 / (log(fresnel_scatter.MAX_DISTANCE / NEAREST) * distance * distance), 0.0)


@dataclass(frozen=True, eq=False)
class Leaving:
    """A path that leaves a surface: Dr.Jit arrays.

    Attributes
    ----------
    direction : Any
        Specular or refracted direction; normal: unit, either side.
    index : Any
        Refractive index on the side it leaves to.
    event : Any
        What happened; weight: its weight.
    toward : Any
        Cosine of the arriving direction with ``normal``.
    diffusing : Any
        Whether it is diffused.
    """

    direction: Any
    normal: Any
    index: Any
    event: Any
    weight: Any
    toward: Any
    diffusing: Any


@dataclass(frozen=True, eq=False)
class TableDraw:
    """Measured scattering of the surfaces that paths leave.

    Attributes
    ----------
    tables : Any
        Of the scene; marks: of the paths' finishes.
    cosine : Any
        Of incidence.
    """

    tables: Any
    marks: Sequence[Any]
    cosine: Any


def divide(
    rng: Any, met: Any, specular: Any, share: Any, floor: Any, weight: Any, all_of_it: bool = False
) -> tuple[Any, Any]:
    """Draw which paths are scattered.

    Parameters
    ----------
    rng : Any
        Random numbers.
    met : Any
        Paths that are at a surface.
    specular : Any
        Those of them that are reflected or transmitted.
    share : Any
        Of the light that is scattered.
    floor : Any
        Smallest probability of it where there is some.
    weight : Any
        Of the paths.
    all_of_it : bool
        Whether a surface may scatter all of the light.

    Returns
    -------
    tuple[Any, Any]
        Which are scattered, and the weights.
    """
    import drjit as dr

    chance = dr.select(share > 0.0, dr.maximum(share, floor), 0.0)
    scattering = specular & (rng.next_float64(met) < chance)
    # no path stays plain where all is scattered
    left = dr.maximum(1.0 - chance, 1e-300) if all_of_it else 1.0 - chance
    after = dr.select(scattering, weight * share / chance, weight)
    return scattering, dr.select(specular & ~scattering, weight * (1.0 - share) / left, after)


def spread(
    backend: Backend,
    rng: Any,
    met: Any,
    share: Any,
    lobe: Callable[[Any], Sequence[Any]],
    floor: Any,
    near: Any,
    leaving: Leaving,
    drawn: TableDraw | None = None,
) -> tuple[Any, Any, Any, Any]:
    """Draw the direction of light that is diffused or scattered into the lobe around the specular direction.

    Parameters
    ----------
    backend : Backend
        Array types.
    rng : Any
        Random numbers, drawn from here on.
    met : Any
        Paths that are at a surface.
    share : Any
        Of the light for which a direction is drawn from a lobe.
    lobe : Callable[[Any], Sequence[Any]]
        Looks the lobe of active paths up: scale, exponent, kind, area.
    floor : Any
        Smallest probability of drawing from a lobe that there is.
    near : Any
        Share of the directions that are drawn with ``near_distance``, None for none.
    leaving : Leaving
        The paths as they would go on without.
    drawn : TableDraw | None
        Measured scattering, None where there is none; ``share`` is then theirs.

    Returns
    -------
    tuple[Any, Any, Any, Any]
        Direction, event, weight, and rng.
    """
    import drjit as dr

    specular = met & ~leaving.diffusing
    scattering, weight = divide(rng, met, specular, share, floor, leaving.weight, drawn is not None)

    def turn(direction: Any, event: Any, weight: Any, rng: Any) -> tuple[Any, Any, Any, Any]:
        scale, exponent, kind, area = lobe(scattering)
        u, v, keep = rng.next_float64(), rng.next_float64(), rng.next_float64()
        n = leaving.normal
        up = dr.copysign(1.0, dr.select(leaving.diffusing, -leaving.toward, dr.dot(direction, n)))
        side = n * up
        distance = fresnel_scatter.sample_distance(u, scale, exponent)
        if near is not None:
            by_distance = rng.next_float64() < near
            distance = dr.select(by_distance, near_distance(u), distance)
            # both ways of drawing could have drawn this distance
            x = distance / scale
            plain = dr.exp(-0.5 * exponent * dr.log(dr.fma(x, x, 1.0))) / area
            ours = (1.0 - near) * plain + near * near_density(distance)
            lobed = scattering if drawn is None else scattering & (drawn.marks[1] < 0.5)
            weight = dr.select(lobed, weight * plain / ours, weight)
        kept = keep < fresnel_scatter.acceptance(distance, scale, exponent, kind)
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
        kept = (kept | leaving.diffusing) & (rest > 0.0)
        new = dr.normalize(along + dr.sqrt(dr.maximum(rest, 0.0)) * side)
        if drawn is not None:
            table = (drawn.marks[1] > 0.5) & ~leaving.diffusing
            four = (keep, u, v, rng.next_float64())
            by_table = drawn.tables.draw(drawn.marks, drawn.cosine, direction, side, four, table)
            new = dr.select(table, by_table, new)
            kept |= table
        scattered = dr.select(
            event == int(Event.TRANSMIT), backend.UInt(int(Event.SCATTER_THROUGH)), int(Event.SCATTER)
        )
        event = dr.select(kept & ~leaving.diffusing, scattered, event)
        return dr.select(kept, new, direction), event, weight, rng

    return dr.if_stmt(
        (leaving.direction, leaving.event, weight, rng),
        scattering | (met & leaving.diffusing),
        turn,
        lambda *same: same,
        arg_labels=("direction", "event", "weight", "rng"),
        label="scatter",
        mode="symbolic",
    )


LEAST_KEPT = 0.2
"""Least probability of following a path: what the first paths have not found may be there, and is found with at most
five times the variance."""

PRIOR = 0.1
"""Share of the variance that the classes are thought to have together, each as much, before anything is found."""

AT_ONCE = 0.15
"""Time of a surface of the nominal way, in that of a surface that is met anywhere else, as measured."""


@dataclass(frozen=True, eq=False)
class Thinning:
    """Probability of following paths that turn away from nominal light.

    Attributes
    ----------
    kept : np.ndarray
        By the number of surfaces passed.
    first : int
        Number of the first path that may be left out.
    seed : int
        Of the random numbers; what happens to a path depends on it and on the path's number alone.
    """

    kept: np.ndarray
    first: int
    seed: int

    def chances(self, numbers: np.ndarray, passed: np.ndarray) -> np.ndarray:
        """Probability of following each path that turns away, by its number and the surfaces passed."""
        known = np.minimum(passed, len(self.kept) - 1)
        return np.where((numbers < self.first) | (passed >= len(self.kept)), 1.0, self.kept[known])

    def follows(self, numbers: np.ndarray, chances: np.ndarray) -> np.ndarray:
        """Draw which paths are followed."""
        with np.errstate(over="ignore"):
            # splitmix64 of Steele, Lea and Flood (2014), from another place than the paths' own numbers
            z = (numbers.astype(np.uint64) + np.uint64(self.seed)) * np.uint64(0xD1342543DE82EF95)
            z += np.uint64(0x2545F4914F6CDD1D)
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z ^= z >> np.uint64(31)
        return np.asarray((z >> np.uint64(11)).astype(np.float64) * 2.0**-53 < chances)


@dataclass(frozen=True, eq=False)
class Followed:
    """What a launch has done, path by path.

    Attributes
    ----------
    passed : np.ndarray
        Surfaces of the nominal way, (N,).
    turned : np.ndarray
        Whether the path turned away there, (N,); else it missed the next one or came to the detector.
    steps : np.ndarray
        Surfaces met after that, (N,).
    """

    passed: np.ndarray
    turned: np.ndarray
    steps: np.ndarray


def learn(seen: Sequence[tuple[Followed, np.ndarray, np.ndarray]], seed: int) -> Thinning:
    """Probabilities by what the first paths of a run have brought.

    Parameters
    ----------
    seen : Sequence[tuple[Followed, np.ndarray, np.ndarray]]
        Launches of these paths, numbered from 0: what they have done, numbers of those that brought light off the
        nominal way to a detector, with repetitions, and the weights of that light.
    seed : int
        Of the random numbers that are drawn with them.
    """
    passed, turned, steps = (
        np.concatenate([getattr(done, name) for done, _, _ in seen]) for name in ("passed", "turned", "steps")
    )
    paths, weights = (np.concatenate([one[k] for one in seen]) for k in (1, 2))
    count, classes = len(passed), int(passed.max()) + 1
    brought = np.bincount(paths.astype(np.int64), weights, count) ** 2

    def of_classes(values: np.ndarray) -> np.ndarray:
        return np.bincount(passed[turned], values[turned], classes)

    number, cost, variance = (of_classes(values) for values in (np.ones(count), steps, brought))
    rest = AT_ONCE * passed.sum() + steps.sum() - cost.sum()
    fixed = brought.sum() - variance.sum()
    there = number > 0
    variance = np.where(there, variance + PRIOR * variance.sum() / max(there.sum(), 1), 0.0)
    wish = np.sqrt(variance / np.maximum(cost, 1.0))
    choices = [np.clip(wish / most, LEAST_KEPT, 1.0) for most in np.unique(wish[wish > 0.0])]
    spent = [((variance / kept).sum() + fixed) * ((kept * cost).sum() + rest) for kept in choices]
    kept = choices[int(np.argmin(spent))] if choices else np.ones(classes)
    return Thinning(np.where(there, kept, 1.0), count, seed)
