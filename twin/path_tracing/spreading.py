"""Directions into which a surface diffuses light or scatters it about the specular direction, drawn for each path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log
from typing import Any

from optics.materials import scatter
from optics.numerics.backend import Backend
from twin.path_tracing.families import Event

NEAREST = 1e-6
"""Smallest distance of ``near_distance``, in direction cosines."""


def near_distance(u: Any) -> Any:
    """Distance between ``NEAREST`` and ``scatter.WIDEST``, even in its logarithm, from u in [0, 1)."""
    import drjit as dr

    return NEAREST * dr.exp(u * log(scatter.WIDEST / NEAREST))


def near_density(distance: Any) -> Any:
    """Density of the square of ``near_distance``."""
    import drjit as dr

    return dr.select(distance >= NEAREST, 0.5 / (log(scatter.WIDEST / NEAREST) * distance * distance), 0.0)


@dataclass(frozen=True, eq=False)
class Leaving:
    """A path that leaves a surface: Dr.Jit arrays.

    Attributes:
        direction: specular or refracted direction; normal: unit, either side.
        index: refractive index on the side it leaves to.
        event: what happened; weight: its weight.
        toward: cosine of the arriving direction with ``normal``.
        diffusing: whether it is diffused.
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

    Attributes:
        tables: of the scene; marks: of the paths' finishes.
        cosine: of incidence.
    """

    tables: Any
    marks: Sequence[Any]
    cosine: Any


def divide(
    rng: Any, met: Any, specular: Any, share: Any, floor: Any, weight: Any, all_of_it: bool = False
) -> tuple[Any, Any]:
    """Draw which paths are scattered.

    Args:
        rng: random numbers.
        met: paths that are at a surface.
        specular: those of them that are reflected or transmitted.
        share: of the light that is scattered.
        floor: smallest probability of it where there is some.
        weight: of the paths.
        all_of_it: whether a surface may scatter all of the light.

    Returns:
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

    Args:
        backend: array types.
        rng: random numbers, drawn from here on.
        met: paths that are at a surface.
        share: of the light for which a direction is drawn from a lobe.
        lobe: looks the lobe of active paths up: scale, exponent, kind, area.
        floor: smallest probability of drawing from a lobe that there is.
        near: share of the directions that are drawn with ``near_distance``, None for none.
        leaving: the paths as they would go on without.
        drawn: measured scattering, None where there is none; ``share`` is then theirs.

    Returns:
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
        distance = scatter.sample_distance(u, scale, exponent)
        if near is not None:
            by_distance = rng.next_float64() < near
            distance = dr.select(by_distance, near_distance(u), distance)
            # both ways of drawing could have drawn this distance
            x = distance / scale
            plain = dr.exp(-0.5 * exponent * dr.log(dr.fma(x, x, 1.0))) / area
            ours = (1.0 - near) * plain + near * near_density(distance)
            lobed = scattering if drawn is None else scattering & (drawn.marks[1] < 0.5)
            weight = dr.select(lobed, weight * plain / ours, weight)
        kept = keep < scatter.acceptance(distance, scale, exponent, kind)
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
