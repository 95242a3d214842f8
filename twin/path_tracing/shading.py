"""Pieces of the path tracer's loop: the nearest face ahead inside a glass body, scattering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from optics.materials import scatter
from optics.numerics.backend import Backend
from twin.path_tracing.families import Event
from twin.path_tracing.tables import SceneTables


def nearest_face(backend: Backend, tables: SceneTables, p: Any, d: Any, body: Any, inside: Any) -> tuple[Any, Any]:
    """Distance to and number of the face through which a path leaves its convex glass body, exactly.

    The distance may come out negative by a rounding, where a path meets an edge.
    """
    import drjit as dr

    first = dr.gather(backend.UInt, tables.body_first, body, inside)
    count = dr.gather(backend.UInt, tables.body_faces, body, inside)

    def step(k: Any, best: Any, face: Any) -> tuple[Any, Any, Any]:
        nx, ny, nz, offset = tables.plane(first + k, k < count)
        toward = dr.fma(nx, d.x, dr.fma(ny, d.y, nz * d.z))
        gap = offset - dr.fma(nx, p.x, dr.fma(ny, p.y, nz * p.z))
        ahead = toward > 1e-12
        t = dr.select(ahead, gap / toward, dr.inf)
        nearer = t < best
        return k + 1, dr.select(nearer, t, best), dr.select(nearer, first + k, face)

    start = (dr.zeros(backend.UInt, 1) + 0 * body, backend.Float(dr.inf) + 0.0 * p.x, 0 * body)
    _, best, face = dr.while_loop(start, lambda k, best, face: k < count, step, label="faces", mode="symbolic")
    return best, face


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


def spread(
    backend: Backend,
    rng: Any,
    met: Any,
    lobe: Sequence[Any],
    floor: Any,
    leaving: Leaving,
    drawn: TableDraw | None = None,
) -> tuple[Any, Any, Any, Any]:
    """Draw the direction of light that is diffused or scattered into the lobe around the specular direction.

    Args:
        backend: array types.
        rng: random numbers, drawn from here on.
        met: paths that are at a surface.
        lobe: share, scale, exponent, kind.
        floor: smallest probability of drawing from a lobe that there is.
        leaving: the paths as they would go on without.
        drawn: measured scattering, None where there is none; ``lobe`` then has its share.

    Returns:
        Direction, event, weight, and rng.
    """
    import drjit as dr

    share = lobe[0]
    chance = dr.select(share > 0.0, dr.maximum(share, floor), 0.0)
    scattering = met & ~leaving.diffusing & (rng.next_float64() < chance)
    plain = met & ~leaving.diffusing & ~scattering
    weight = dr.select(scattering, leaving.weight * share / chance, leaving.weight)
    # no path stays plain where all is scattered
    # a table may scatter all
    left = 1.0 - chance if drawn is None else dr.maximum(1.0 - chance, 1e-300)
    weight = dr.select(plain, leaving.weight * (1.0 - share) / left, weight)

    def turn(direction: Any, event: Any, rng: Any) -> tuple[Any, Any, Any]:
        u, v, keep = rng.next_float64(), rng.next_float64(), rng.next_float64()
        n = leaving.normal
        up = dr.copysign(1.0, dr.select(leaving.diffusing, -leaving.toward, dr.dot(direction, n)))
        side = n * up
        distance = scatter.sample_distance(u, lobe[1], lobe[2])
        kept = keep < scatter.acceptance(distance, lobe[1], lobe[2], lobe[3])
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
        return dr.select(kept, new, direction), event, rng

    direction, event, rng = dr.if_stmt(
        (leaving.direction, leaving.event, rng),
        scattering | (met & leaving.diffusing),
        turn,
        lambda direction, event, rng: (direction, event, rng),
        arg_labels=("direction", "event", "rng"),
        label="scatter",
        mode="symbolic",
    )
    return direction, event, weight, rng
