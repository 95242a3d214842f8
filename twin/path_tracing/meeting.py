"""Where paths meet the next surface.

In the open Mitsuba's ``Scene.ray_intersect_preliminary`` (float32, on triangles) says which surface that is; Newton's
method then finds the point on the analytic surface in float64. Inside a glass body no triangles are needed: the body is
convex and its faces are flat, so the next face is the nearest one ahead, exactly, and no path leaks through an edge.
Back in the open a triangle that only rounding puts there (the surface just left, the inside of a glass face, the rim of
a mesh beyond a mirror's edge) is passed over, and the flight goes on behind it. Paths start in the open, outside all
glass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from optics.geometry.surface import along, level, newton_step
from optics.numerics.backend import Backend
from twin.path_tracing import tables as layout

REFINEMENTS = 3
"""Newton steps from the triangle to the surface: from below a millimetre to 1e-7 and 1e-13 m and to rounding, also at
grazing incidence."""

AHEAD = 1e-12
"""Smallest cosine with its normal at which a face of a glass body is met."""


@dataclass(frozen=True, eq=False)
class Flight:
    """Paths on their way: ``Vector3`` position and unit direction, number of the glass body that they are in (None in a
    scene without glass, 0 in the open), how far ahead the search for a surface starts, which of them fly, and which go
    the way of their neighbours.
    """

    position: Any
    direction: Any
    body: Any
    ahead: Any
    active: Any
    together: Any


def next_surface(
    backend: Backend, mi: Any, scene: Any, tables: layout.SceneTables, flight: Flight
) -> tuple[Any, Any, Any]:
    """About how far it is to the next surface, its number, and which paths meet one."""
    import drjit as dr

    p, d, active = flight.position, flight.direction, flight.active
    inside = None if flight.body is None else active & (flight.body != 0)
    outside = active if inside is None else active & ~inside
    ray = mi.Ray3f(mi.Point3f(dr.fma(d, flight.ahead, p)), mi.Vector3f(d))
    found = scene.ray_intersect_preliminary(ray, coherent=flight.together | ~outside, active=outside)
    hit = found.is_valid() & outside
    surface = dr.select(hit, backend.UInt(found.shape_index), 0)
    near = backend.Float(found.t) + flight.ahead
    if inside is not None:
        t, face = _nearest_face(backend, tables, p, d, flight.body, inside)
        near, surface, hit = dr.select(inside, t, near), dr.select(inside, face, surface), hit | inside
    return near, surface, hit


def _nearest_face(
    backend: Backend, tables: layout.SceneTables, p: Any, d: Any, body: Any, inside: Any
) -> tuple[Any, Any]:
    """Distance to and number of the face through which a path leaves its convex glass body, exactly.

    The distance may come out negative by a rounding, where a path meets an edge.
    """
    import drjit as dr

    first = dr.gather(backend.UInt, tables.body_first, body, inside)
    count = dr.gather(backend.UInt, tables.body_faces, body, inside)

    def step(k: Any, gap: Any, toward: Any, face: Any) -> tuple[Any, Any, Any, Any]:
        nx, ny, nz, offset = tables.plane(first + k, k < count)
        this_toward = dr.fma(nx, d.x, dr.fma(ny, d.y, nz * d.z))
        this_gap = offset - dr.fma(nx, p.x, dr.fma(ny, p.y, nz * p.z))
        # gap / toward is the distance; both denominators are positive, and only the last distance is divided out
        nearer = (this_toward > AHEAD) & (this_gap * toward < gap * this_toward)
        gap, toward = dr.select(nearer, this_gap, gap), dr.select(nearer, this_toward, toward)
        return k + 1, gap, toward, dr.select(nearer, first + k, face)

    zero = 0.0 * p.x
    start = (0 * body, zero + 1e300, zero + 1.0, 0 * body)
    out = dr.while_loop(start, lambda k, *_: k < count, step, label="faces", mode="symbolic")
    return out[1] / out[2], out[3]


@dataclass(frozen=True, eq=False)
class Place:
    """Where paths meet their surfaces: Dr.Jit arrays.

    Attributes:
        distance: along the path.
        x, y: in the surface's frame.
        normal: unit vector in the world, toward +z of the surface.
        cosine: of the path's direction with it.
        clear: whether inside the clear apertures.
        kind: bits of the surface.
        row: numbers of its geometry.
    """

    distance: Any
    x: Any
    y: Any
    normal: Any
    cosine: Any
    clear: Any
    kind: Any
    row: list[Any]


def locate(
    backend: Backend, tables: layout.SceneTables, form: layout.SurfaceForm, flight: Flight, near: Any, surface: Any
) -> Place:
    """Find exactly where paths meet the surfaces that are about ``near`` away.

    Args:
        backend: array types.
        tables: of the scene.
        form: what its surfaces consist of.
        flight: the paths; ``active`` are those that meet a surface.
        near: about how far it is.
        surface: its number.
    """
    import drjit as dr

    Vector3 = backend.Vector3
    p, d, active = flight.position, flight.direction, flight.active
    g = tables.geometry(surface, active)
    kind = dr.gather(backend.UInt, tables.kind, surface, active)
    local = Vector3(
        *(dr.fma(g[3 * a], p.x, dr.fma(g[3 * a + 1], p.y, dr.fma(g[3 * a + 2], p.z, g[9 + a]))) for a in range(3))
    )
    toward = Vector3(*(dr.fma(g[3 * a], d.x, dr.fma(g[3 * a + 1], d.y, g[3 * a + 2] * d.z)) for a in range(3)))
    t = -local.z / toward.z
    x, y = dr.fma(t, toward.x, local.x), dr.fma(t, toward.y, local.y)
    cosine, normal = toward.z, Vector3(g[6], g[7], g[8])
    if not form.flat:
        curved = active & (kind & layout.Kind.CURVED != 0)

        def refine(t: Any, x: Any, y: Any, cosine: Any, normal: Any) -> tuple[Any, ...]:
            shape = tables.surface(surface, form, curved)
            s = near
            for _ in range(REFINEMENTS):
                s = newton_step(local, toward, s, shape, tables.samples, curved)
            u, v, z = along(local, toward, s)
            _, nx, ny, nz = level(u, v, z, shape, tables.samples, curved)
            unit = dr.rsqrt(dr.fma(nx, nx, dr.fma(ny, ny, nz * nz)))
            nx, ny, nz = nx * unit, ny * unit, nz * unit
            c = dr.fma(nx, toward.x, dr.fma(ny, toward.y, nz * toward.z))
            n = Vector3(*(dr.fma(g[a], nx, dr.fma(g[3 + a], ny, g[6 + a] * nz)) for a in range(3)))
            new, old = (s, u, v, c, n), (t, x, y, cosine, normal)
            return tuple(dr.select(curved, a, b) for a, b in zip(new, old, strict=True))

        t, x, y, cosine, normal = dr.if_stmt(
            (t, x, y, cosine, normal),
            curved,
            refine,
            lambda *same: same,
            arg_labels=("distance", "x", "y", "cosine", "normal"),
            label="curved",
            mode="symbolic",
        )
    first, size = layout.APERTURES, layout.APERTURE
    clear = layout.within(x, y, g[first : first + size])
    clear |= layout.within(x, y, g[first + size : first + 2 * size])
    return Place(t, x, y, normal, cosine, clear, kind, g)
