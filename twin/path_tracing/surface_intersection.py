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
from twin.path_tracing.clear_ways import PLACES

REFINEMENTS = 3
"""Newton steps from the triangle to the surface: from below a millimetre to 1e-7 and 1e-13 m and to rounding, also at
grazing incidence."""

EXACT = 1e-12
"""Largest value of the level function, metres, at which a surface is met: some hundred roundings of ten metres."""

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
    way: Any
    ways: bool


@dataclass(frozen=True, eq=False)
class Next:
    """The surfaces that paths meet next: Dr.Jit arrays.

    Attributes
    ----------
    near : Any
        About how far it is; surface: its number.
    hit : Any
        Which paths meet one.
    tried : Any
        Which paths are only thought to meet it, by the way that they take; way: the way after it and where it ends, see
        ``tables.way_table``.
    """

    near: Any
    surface: Any
    hit: Any
    tried: Any
    way: list[Any]


def next_surface(backend: Backend, mi: Any, scene: Any, tables: layout.SceneTables, flight: Flight) -> Next:
    """What paths meet next: the end of a clear way, or what a search finds."""
    import drjit as dr

    p, d, active = flight.position, flight.direction, flight.active
    tried: Any = active & False
    way: list[Any] = []
    near, surface = 0.0 * p.x, 0 * flight.way
    if flight.ways:
        near, tried, way = _end(backend, tables, flight)
        surface = dr.select(tried, way[1] // PLACES, 0)
    search = active & ~tried
    inside = None if flight.body is None else search & (flight.body != 0)
    outside = search if inside is None else search & ~inside

    def look(near: Any, surface: Any, hit: Any) -> tuple[Any, Any, Any]:
        ray = mi.Ray3f(mi.Point3f(dr.fma(d, flight.ahead, p)), mi.Vector3f(d))
        found = scene.ray_intersect_preliminary(ray, coherent=flight.together | ~outside, active=outside)
        hits = found.is_valid() & outside
        surface = dr.select(hits, backend.UInt(found.shape_index), surface)
        return dr.select(outside, backend.Float(found.t) + flight.ahead, near), surface, hit | hits

    near, surface, hit = dr.if_stmt(
        (near, surface, tried), outside, look, lambda *same: same, label="search", mode="symbolic"
    )
    if inside is not None:
        t, face = _nearest_face(backend, tables, p, d, flight.body, inside)
        near, surface, hit = dr.select(inside, t, near), dr.select(inside, face, surface), hit | inside
    return Next(near, surface, hit, tried, way)


def _end(backend: Backend, tables: layout.SceneTables, flight: Flight) -> tuple[Any, Any, list[Any]]:
    """About how far it is to the ends of the ways that paths are on, which paths can meet them, and the ways."""
    import drjit as dr

    p, d = flight.position, flight.direction
    on_one = flight.active & (flight.way != 0)
    x, y, z, after, *normal, code = tables.way(flight.way, on_one)
    v, n = backend.Vector3(x, y, z) - p, backend.Vector3(*normal)
    along = dr.dot(v, d)
    aside = dr.fma(-along, along, dr.dot(v, v))
    # the normal is as long as the reciprocal of the radius
    possible = on_one & (along > 0.0) & (aside * dr.dot(n, n) < 1.0)
    return dr.dot(v, n) / dr.dot(d, n), possible, [backend.UInt(after), backend.UInt(code)]


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

    Attributes
    ----------
    distance : Any
        Along the path.
    x, y : Any
        In the surface's frame.
    normal : Any
        Unit vector in the world, toward +z of the surface.
    cosine : Any
        Of the path's direction with it.
    first, second : Any
        Whether inside the first and the second clear aperture.
    exact : Any
        Whether the surface is there, to rounding.
    kind : Any
        Bits of the surface.
    row : list[Any]
        Numbers of its geometry.
    """

    distance: Any
    x: Any
    y: Any
    normal: Any
    cosine: Any
    first: Any
    second: Any
    exact: Any
    kind: Any
    row: list[Any]

    @property
    def clear(self) -> Any:
        """Whether inside the clear apertures."""
        return self.first | self.second


def locate(
    backend: Backend, tables: layout.SceneTables, form: layout.SurfaceForm, flight: Flight, near: Any, surface: Any
) -> Place:
    """Find exactly where paths meet the surfaces that are about ``near`` away.

    Parameters
    ----------
    backend : Backend
        Array types.
    tables : layout.SceneTables
        Of the scene.
    form : layout.SurfaceForm
        What its surfaces consist of.
    flight : Flight
        The paths; ``active`` are those that meet a surface.
    near : Any
        About how far it is.
    surface : Any
        Its number.
    """
    import drjit as dr

    Vector3 = backend.Vector3
    p, d, active = flight.position, flight.direction, flight.active
    g = tables.geometry(surface, active)
    kind = backend.UInt(g[layout.KIND])
    local = Vector3(
        *(dr.fma(g[3 * a], p.x, dr.fma(g[3 * a + 1], p.y, dr.fma(g[3 * a + 2], p.z, g[9 + a]))) for a in range(3))
    )
    toward = Vector3(*(dr.fma(g[3 * a], d.x, dr.fma(g[3 * a + 1], d.y, g[3 * a + 2] * d.z)) for a in range(3)))
    t = -local.z / toward.z
    x, y = dr.fma(t, toward.x, local.x), dr.fma(t, toward.y, local.y)
    cosine, normal = toward.z, Vector3(g[6], g[7], g[8])
    rest: Any = 0.0 * x
    if not form.flat:
        curved = active & (kind & layout.Kind.CURVED != 0)

        def refine(*plane: Any) -> tuple[Any, ...]:
            shape = tables.surface(surface, form, curved)
            s = near
            for _ in range(REFINEMENTS):
                s = newton_step(local, toward, s, shape, tables.samples, curved)
            u, v, z = along(local, toward, s)
            value, nx, ny, nz = level(u, v, z, shape, tables.samples, curved)
            # the conic's other sheet is no surface
            value = dr.select(nz > 0.0, value, dr.inf)
            unit = dr.rsqrt(dr.fma(nx, nx, dr.fma(ny, ny, nz * nz)))
            nx, ny, nz = nx * unit, ny * unit, nz * unit
            c = dr.fma(nx, toward.x, dr.fma(ny, toward.y, nz * toward.z))
            n = Vector3(*(dr.fma(g[a], nx, dr.fma(g[3 + a], ny, g[6 + a] * nz)) for a in range(3)))
            new = (s, u, v, c, n, value)
            return tuple(dr.select(curved, a, b) for a, b in zip(new, plane, strict=True)) if form.mixed else new

        if form.mixed:
            t, x, y, cosine, normal, rest = dr.if_stmt(
                (t, x, y, cosine, normal, rest),
                curved,
                refine,
                lambda *same: same,
                arg_labels=("distance", "x", "y", "cosine", "normal", "rest"),
                label="curved",
                mode="symbolic",
            )
        else:
            t, x, y, cosine, normal, rest = refine()
    first, size = layout.APERTURES, layout.APERTURE
    within, again = (layout.within(x, y, g[k : k + size]) for k in (first, first + size))
    return Place(t, x, y, normal, cosine, within, again, dr.abs(rest) < EXACT, kind, g)
