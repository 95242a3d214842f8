"""Intersections of paths with the next surface.

Outside glass, Mitsuba's ``Scene.ray_intersect_preliminary`` (float32, on triangles) finds the surface; Newton's method
then finds the point on the analytic surface in float64. Inside a glass body no triangles are needed: the body is convex
and its faces are flat, so the next face is the nearest one ahead, exactly, and no path leaks through an edge. Outside
glass again, a triangle that is hit by rounding only (of the surface just left, the inside of a glass face, the rim of a
mesh beyond a mirror's edge) is skipped, and the search continues behind it. Paths start outside all glass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from optics.geometry.surface import along, level, newton_step
from optics.numerics.backend import Backend
from twin.path_tracing import tables as layout
from twin.path_tracing.clear_ways import EXITS

REFINEMENTS = 3
"""Number of Newton steps from a ray's intersection with a surface's triangles to that with the true surface.

The error falls from below a millimetre to 1e-7 m, 1e-13 m and to rounding, also at grazing incidence.
"""

EXACT = 1e-12
"""Largest residual of a surface's equation (``optics.geometry.surface.level``), metres, where it counts as met.

It is some hundred rounding errors of a length of ten metres.
"""

AHEAD = 1e-12
"""Smallest cosine between a ray and the normal of a face at which the ray leaves a glass body through that face."""


@dataclass(frozen=True, eq=False)
class Flight:
    """Paths between surfaces, as Dr.Jit arrays.

    Attributes
    ----------
    position, direction : Dr.Jit Vector3
        Position, metres, and unit direction, ``Vector3``.
    body : Dr.Jit array
        Number of the glass body that they are in: None in a scene without glass, 0 outside of glass.
    ahead : Dr.Jit array
        Distance ahead at which the search for a surface starts, metres.
    active : Dr.Jit mask
        Mask of the active paths.
    coherent : Dr.Jit mask
        Mask of the paths that were neither scattered nor took an unlikely direction, and so behave like their
        neighbours.
    segment : Dr.Jit array
        Index of the clear segment of each path; 0 if it is on none.
    segments : bool
        The scene has clear segments.
    """

    position: Any
    direction: Any
    body: Any
    ahead: Any
    active: Any
    coherent: Any
    segment: Any
    segments: bool


@dataclass(frozen=True, eq=False)
class NextSurface:
    """Surfaces that paths meet next, as Dr.Jit arrays.

    Attributes
    ----------
    near : Dr.Jit array
        Approximate distance, metres.
    surface : Dr.Jit array
        Index of the surface.
    hit : Dr.Jit mask
        Mask of the paths that meet one.
    expected : Dr.Jit mask
        Mask of the paths that meet it if they hit the aperture at the end of their clear segment; no search was made.
    segment : list of Dr.Jit arrays
        Index of the segment after it, and code of its end, see ``tables.segment_table``.
    """

    near: Any
    surface: Any
    hit: Any
    expected: Any
    segment: list[Any]


def next_surface(backend: Backend, mi: Any, scene: Any, tables: layout.SceneTables, flight: Flight) -> NextSurface:
    """Return the surfaces that paths meet next: the end of a clear segment, or the result of a search."""
    import drjit as dr

    p, d, active = flight.position, flight.direction, flight.active
    expected: Any = active & False
    segment: list[Any] = []
    near, surface = 0.0 * p.x, 0 * flight.segment
    if flight.segments:
        near, expected, segment = _end(backend, tables, flight)
        surface = dr.select(expected, segment[1] // EXITS, 0)
    search = active & ~expected
    inside = None if flight.body is None else search & (flight.body != 0)
    outside = search if inside is None else search & ~inside

    def look(near: Any, surface: Any, hit: Any) -> tuple[Any, Any, Any]:
        ray = mi.Ray3f(mi.Point3f(dr.fma(d, flight.ahead, p)), mi.Vector3f(d))
        intersection = scene.ray_intersect_preliminary(ray, coherent=flight.coherent | ~outside, active=outside)
        hits = intersection.is_valid() & outside
        surface = dr.select(hits, backend.UInt(intersection.shape_index), surface)
        return dr.select(outside, backend.Float(intersection.t) + flight.ahead, near), surface, hit | hits

    near, surface, hit = dr.if_stmt(
        (near, surface, expected), outside, look, lambda *same: same, label="search", mode="symbolic"
    )
    if inside is not None:
        t, face = _nearest_face(backend, tables, p, d, flight.body, inside)
        near, surface, hit = dr.select(inside, t, near), dr.select(inside, face, surface), hit | inside
    return NextSurface(near, surface, hit, expected, segment)


def _end(backend: Backend, tables: layout.SceneTables, flight: Flight) -> tuple[Any, Any, list[Any]]:
    """Return approximate distances to the ends of clear segments, which paths can meet them, and the segments.

    A clear segment is a stretch of path with no surface in between. Distances are in metres.
    """
    import drjit as dr

    p, d = flight.position, flight.direction
    on_one = flight.active & (flight.segment != 0)
    x, y, z, after, *normal, code = tables.segment(flight.segment, on_one)
    v, n = backend.Vector3(x, y, z) - p, backend.Vector3(*normal)
    along = dr.dot(v, d)
    aside = dr.fma(-along, along, dr.dot(v, v))
    # the length of the normal is the reciprocal of the radius
    possible = on_one & (along > 0.0) & (aside * dr.dot(n, n) < 1.0)
    return dr.dot(v, n) / dr.dot(d, n), possible, [backend.UInt(after), backend.UInt(code)]


def _nearest_face(
    backend: Backend, tables: layout.SceneTables, p: Any, d: Any, body: Any, inside: Any
) -> tuple[Any, Any]:
    """Return distance and index of the face through which a path leaves its convex glass body, exactly.

    The distance may be negative by a rounding error, where a path meets an edge.
    """
    import drjit as dr

    first = dr.gather(backend.UInt, tables.body_first, body, inside)
    count = dr.gather(backend.UInt, tables.body_faces, body, inside)

    def step(k: Any, gap: Any, toward: Any, face: Any) -> tuple[Any, Any, Any, Any]:
        nx, ny, nz, offset = tables.plane(first + k, k < count)
        this_toward = dr.fma(nx, d.x, dr.fma(ny, d.y, nz * d.z))
        this_gap = offset - dr.fma(nx, p.x, dr.fma(ny, p.y, nz * p.z))
        # gap / toward is the distance; both denominators are positive, and the division is done once at the end
        nearer = (this_toward > AHEAD) & (this_gap * toward < gap * this_toward)
        gap, toward = dr.select(nearer, this_gap, gap), dr.select(nearer, this_toward, toward)
        return k + 1, gap, toward, dr.select(nearer, first + k, face)

    zero = 0.0 * p.x
    start = (0 * body, zero + 1e300, zero + 1.0, 0 * body)
    out = dr.while_loop(start, lambda k, *_: k < count, step, label="faces", mode="symbolic")
    return out[1] / out[2], out[3]


@dataclass(frozen=True, eq=False)
class Intersection:
    """Intersections of paths with their surfaces, as Dr.Jit arrays.

    Attributes
    ----------
    distance : Dr.Jit array
        Distance along the path, metres.
    x, y : Dr.Jit array
        Coordinates in the surface's frame, metres.
    normal : Dr.Jit Vector3
        Unit normal in the world frame, toward +z of the surface.
    cosine : Dr.Jit array
        Cosine of the path's direction with the normal.
    first, second : Dr.Jit mask
        True inside the first and the second clear aperture.
    exact : Dr.Jit mask
        True where the surface is met, to rounding.
    kind : Dr.Jit array
        Bits of the surface's kind.
    row : list of Dr.Jit arrays
        Numbers that describe the surface in the geometry table.
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
        """True inside the clear apertures."""
        return self.first | self.second


def locate(
    backend: Backend, tables: layout.SceneTables, form: layout.SurfaceForm, flight: Flight, near: Any, surface: Any
) -> Intersection:
    """Compute the exact intersection of paths with the surfaces at a distance of about ``near``.

    Parameters
    ----------
    backend : Backend
        Array types.
    tables : layout.SceneTables
        Tables of the scene.
    form : layout.SurfaceForm
        Components of its surfaces' shapes.
    flight : Flight
        Paths; ``active`` are those that meet a surface.
    near : Dr.Jit array
        Approximate distance, metres.
    surface : Dr.Jit array
        Index of the surface.
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
            # the other sheet of the conic is not part of the surface
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
    return Intersection(t, x, y, normal, cosine, within, again, dr.abs(rest) < EXACT, kind, g)
