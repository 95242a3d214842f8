"""Loop over the surfaces of a path, recorded once as one Dr.Jit kernel; all numbers of the scene enter as arrays.

In each step a path is traced to the next surface (``surface_intersection``), the surface divides its light, and the
path continues in one of the possible directions. Neighbouring paths are processed together, as many as fit into the
processor's vector registers (a packet of paths). A packet takes as long as its longest path, and each step of it
executes all operations that any of its paths needs; operations for some surfaces only (Newton's method, Fresnel's
formulas, a scatter lobe, a detector) are skipped in packets without such a surface. Sources therefore start neighbours
alike, and paths that leave nominal light (``sequential``) are sorted so that neighbours behave alike. Sorting once
more, after four more steps, would save 9 percent of the packets' steps and cost as much, as measured.

Intersections of paths with the next surface.

Outside glass, Mitsuba's ``Scene.ray_intersect_preliminary`` (float32, on triangles) finds the surface; Newton's method
then finds the point on the analytic surface in float64. Inside a glass body no triangles are needed: the body is convex
and its faces are flat, so the next face is the nearest one ahead, exactly, and no path leaks through an edge. Outside
glass again, a triangle that is hit by rounding only (of the surface just left, the inside of a glass face, the rim of a
mesh beyond a mirror's edge) is skipped, and the search continues behind it. Paths start outside all glass.

Importance sampling: random directions of diffused and scattered light, and random termination of weak paths.

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
from dataclasses import dataclass, replace
from math import log
from typing import Any

import numpy as np

from optics.geometry.surface import along, level, newton_step
from optics.materials import fresnel_scatter
from optics.numerics.backend import Backend
from twin.path_tracing import clear_ways
from twin.path_tracing import tables as layout
from twin.path_tracing.clear_ways import EXITS
from twin.path_tracing.path_families import BITS, FACTOR, OUTSIDE, START, Event
from twin.path_tracing.path_result import Accumulators, Arrival, record

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
    redirected : (N,) ndarray of bool
        True where the path left the nominal path at a surface; False where it missed the next one or reached the
        detector.
    steps : (N,) ndarray
        Number of surfaces that the path met after it left the nominal path.
    """

    passed: np.ndarray
    redirected: np.ndarray
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
    passed, redirected, steps = (
        np.concatenate([getattr(done, name) for done, _, _ in launches]) for name in ("passed", "redirected", "steps")
    )
    paths, weights = (np.concatenate([launch[k] for launch in launches]) for k in (1, 2))
    count, classes = len(passed), int(passed.max()) + 1
    brought = np.bincount(paths.astype(np.int64), weights, count) ** 2

    def of_classes(values: np.ndarray) -> np.ndarray:
        return np.bincount(passed[redirected], values[redirected], classes)

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


STEP_BACK = 1e-5
"""Distance behind a triangle hit by rounding only at which the search for the next surface continues, in metres."""

STRAY, UNLIKELY, GONE = 1, 2, 8
"""Bits of a path's history; a path without any of them behaves like its neighbours.

STRAY: it was scattered somewhere. UNLIKELY: unit of the number, at most two, of unlikely directions that it took. GONE:
it has escaped to infinity.
"""


@dataclass(frozen=True)
class Features:
    """Features of a scene and its sampling that determine the kernel's code.

    Attributes
    ----------
    form : layout.SurfaceForm
        Components of the surfaces' shapes.
    glass : bool
        True if there are glass bodies.
    branching : bool
        True if some surface finish does more than reflect and absorb light.
    segments : bool
        True if there are clear segments.
    bare : bool
        True if some glass is uncoated.
    measured : bool
        True if some surface finish has a table of its coating or its scattering.
    roulette : bool
        True if paths of low weight are ended at random.
    near : bool
        True if some scattered directions are drawn close to the specular one.
    keep_nominal : bool
        True if detections of the nominal light are recorded one by one, too, and not only those of ghosts and stray
        light.
    log : bool
        True if the events of every path are recorded.
    """

    form: layout.SurfaceForm
    glass: bool
    branching: bool
    segments: bool = False
    bare: bool = False
    measured: bool = False
    roulette: bool = False
    near: bool = False
    keep_nominal: bool = False
    log: bool = False


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of one launch, as opaque arrays of width 1.

    Attributes
    ----------
    steps : Dr.Jit array
        Largest number of steps.
    capacity : Dr.Jit array
        Number of detections that can be recorded.
    floors : sequence of Dr.Jit arrays
        Smallest probability of each possible direction (reflected, transmitted, diffused) for paths that have taken no,
        one, and more unlikely directions before; 0: probabilities are proportional to power.
    scatter_floors : sequence of Dr.Jit arrays
        Smallest probability of drawing a direction from a scatter lobe, for paths that have taken no, one, and more
        unlikely directions before.
    near : Dr.Jit array
        Share of these directions that are drawn close to the specular one.
    weak : Dr.Jit array
        Weight below which a path may be ended by roulette.
    """

    steps: Any
    capacity: Any
    floors: Sequence[Any]
    scatter_floors: Sequence[Any]
    near: Any
    weak: Any


@dataclass(frozen=True, eq=False)
class Launch:
    """Paths at their start, or after some surfaces. Neighbours should be alike.

    Attributes
    ----------
    position, direction : Dr.Jit Vector3
        Position, metres, and unit direction, ``Vector3``.
    weight : Dr.Jit array
        Power of the path.
    path : Dr.Jit array
        Number of the path.
    rng : Dr.Jit random generator
        Random generator of the path.
    segment : Dr.Jit array
        Index of the clear segment that it is on; 0 if it is on none.
    length : Dr.Jit array
        Optical path length so far, metres.
    body : Dr.Jit array
        Number of the glass body that it is in; 0 outside of glass.
    ahead : Dr.Jit array
        Distance ahead at which the search for the next surface starts, metres.
    signature : Dr.Jit array
        Hash of its events so far (surfaces met and what happened there), which identifies its family of paths.
    steps : Dr.Jit array
        Number of these events.
    """

    position: Any
    direction: Any
    weight: Any
    path: Any
    rng: Any
    segment: Any = 0
    length: Any = 0.0
    body: Any = 0
    ahead: Any = 0.0
    signature: Any = START
    steps: Any = 0


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """Scene as the kernel needs it: array types, Mitsuba with its variant set, triangles and tables of numbers."""

    backend: Backend
    mi: Any
    scene: Any
    tables: layout.SceneTables


def follow(
    prepared: PreparedScene, features: Features, limits: Limits, launch: Launch, accumulators: Accumulators
) -> Any:
    """Record the trace of all paths to their end; Dr.Jit evaluates it later.

    The weight that escapes to infinity and the weight still under way at the step limit are accumulated as well.

    Returns
    -------
    Dr.Jit array
        Number of steps of each path from its start.
    """
    import drjit as dr

    backend = prepared.backend
    n = dr.width(launch.position)
    state: Any = (
        backend.Vector3(launch.position),
        backend.Vector3(launch.direction),
        backend.Float(launch.weight),
        dr.zeros(backend.Float, n) + launch.length,
        dr.zeros(backend.UInt, n) + launch.body,
        dr.zeros(backend.Float, n) + launch.ahead,
        dr.zeros(backend.UInt, n) + launch.segment,
        dr.zeros(dr.uint64_array_t(backend.Float), n) + launch.signature,
        dr.zeros(backend.UInt, n),  # history, in bits
        dr.zeros(backend.UInt, n) + launch.steps,
        dr.full(backend.Bool, True, n),
        launch.rng,
    )
    labels = "position direction weight length body ahead segment signature history steps active rng".split()
    body = _step(prepared, features, limits, launch.path, accumulators)
    out = dr.while_loop(state, lambda *s: s[10], body, labels=labels, label="paths", mode="symbolic")
    escaped = out[8] & GONE != 0
    dr.scatter_add(accumulators.left, out[2], backend.UInt(0), escaped)
    dr.scatter_add(accumulators.left, out[2], backend.UInt(1), ~escaped & (out[2] > 0.0))
    return out[9]


def _step(
    prepared: PreparedScene, features: Features, limits: Limits, path: Any, accumulators: Accumulators
) -> Callable[..., tuple[Any, ...]]:
    """Return the function that traces one step of every path, the body of the kernel's loop."""
    import drjit as dr

    backend, tables = prepared.backend, prepared.tables
    Float, UInt = backend.Float, backend.UInt
    UInt64 = dr.uint64_array_t(Float)
    glass = features.glass

    def body(*state: Any) -> tuple[Any, ...]:
        p, d, weight, length, medium, ahead, segment, signature, history, steps, active, rng = state
        inside = active & (medium != 0) if glass else active & False
        flight = Flight(p, d, medium if glass else None, ahead, active, history == 0, segment, features.segments)
        following = next_surface(backend, prepared.mi, prepared.scene, tables, flight)
        surface = following.surface
        history = dr.select(active & ~following.hit, history | GONE, history)
        active = following.hit
        place = locate(backend, tables, features.form, replace(flight, active=active), following.near, surface)
        front = place.cosine < 0.0
        clear, kind = place.clear, place.kind
        # surfaces that are hit only because of rounding or faceting are skipped
        skip = ~clear & (kind & layout.Kind.ENDS != 0)
        again = place.distance <= 0.5 * ahead
        if glass:
            skip |= (again | (~front & (kind & layout.Kind.SOLID != 0))) & ~inside
        else:
            skip |= again
        passed = following.near + STEP_BACK
        wrong: Any = None
        if features.segments:
            arrives = (
                place.exact
                & (place.distance > 0.0)
                & dr.select(following.segment[1] & 2 == 0, place.first, place.second)
            )
            wrong = following.expected & (skip | ~arrives)
            skip |= wrong
            passed = dr.select(wrong, ahead, passed)
        met = active & ~skip
        ahead = dr.select(met, place.row[layout.CLEARANCE], passed)
        flown = dr.select(met, place.distance, 0.0)
        before = dr.select(inside, place.row[layout.INDEX], 1.0) if glass else Float(1.0)
        p = dr.fma(d, flown, p)
        length = dr.fma(flown, before, length)

        # division of the light
        row = layout.ROWS_PER_SURFACE * surface + dr.select(clear, dr.select(front, UInt(0), 1), 2)
        shared = shares(prepared, features, row, met, place, inside, before)
        continuing = shared.continuing
        absorbed = shared.absorbed(weight)
        dr.scatter_add(accumulators.absorbed, absorbed, row, met & (absorbed > 0.0))
        stray = history & STRAY != 0
        arrival = Arrival(place.x, place.y, absorbed, length, signature, stray, path)
        record(
            backend, tables, accumulators, limits.capacity, kind, met & front & clear, arrival, features.keep_nominal
        )

        # direction in which the path continues
        outgoing = dr.fma(place.normal, -2.0 * place.cosine, d)
        event = UInt(0) + 0 * surface
        if features.branching:
            unlikely = history // UNLIKELY & 3
            floor = _by_number(unlikely, limits.floors)
            chosen = choose(shared, weight, floor, rng, met)
            reflecting, through, diffusing = chosen.reflecting, chosen.through, chosen.diffusing
            onward = chosen.weight
            event = dr.select(
                reflecting, UInt(int(Event.REFLECT)), dr.select(through, UInt(int(Event.TRANSMIT)), int(Event.DIFFUSE))
            )
            out_index = Float(1.0)
            if glass:
                ratio = shared.ratio
                cosine_after = dr.copysign(shared.bent, place.cosine)
                refracted = dr.fma(place.normal, cosine_after - ratio * place.cosine, ratio * d)
                outgoing = dr.select(through, refracted, outgoing)
                body = kind >> layout.Kind.BODY_SHIFT & layout.Kind.BODY_MASK
                medium = dr.select(met & through, dr.select(inside, 0, body), medium)
                out_index = dr.select(medium != 0, place.row[layout.INDEX], 1.0)
            leaving = OutgoingPaths(outgoing, place.normal, out_index, event, onward, place.cosine, diffusing)
            drawn = TableSampling(tables.measured, shared.marks, dr.abs(place.cosine)) if shared.marks else None
            scatter_floor = _by_number(unlikely, limits.scatter_floors)
            near_share = limits.near if features.near else None
            lobe = tables.lobe(row)
            outgoing, event, onward, rng = sample_bsdf(
                backend, rng, met, shared.scattered, lobe, scatter_floor, near_share, leaving, drawn
            )
            scattering = event >= int(Event.DIFFUSE)
            # after scattering, directions are drawn in proportion to power
            more = dr.select(chosen.unlikely, UInt(UNLIKELY), 0)
            more = dr.select(unlikely < 2, more, 0)
            history = dr.select(met, dr.select(scattering, STRAY + 2 * UNLIKELY, history + more), history)
        else:
            onward = weight * continuing
        if features.segments:
            behind = dr.dot(outgoing, place.normal) < 0.0
            a, b, c, e = place.row[layout.SEGMENTS : layout.SEGMENTS + clear_ways.EXITS]
            segment = UInt(dr.select(place.first, dr.select(behind, b, a), dr.select(behind, e, c)))
            goes_on = following.expected & (behind == (following.segment[1] & 1 != 0))
            segment = dr.select(met & clear, dr.select(goes_on, following.segment[0], segment), 0)
        d = dr.select(met, outgoing, d)
        weight = dr.select(met, onward, weight)
        code = UInt(place.row[layout.PART]) << BITS | (event + dr.select(clear, UInt(0), OUTSIDE))
        signature = dr.select(met, (signature ^ UInt64(code)) * UInt64(FACTOR), signature)
        if features.log:
            dr.scatter(accumulators.log, dr.select(met, code, 0), path * limits.steps + steps, active)
        # a path that missed the end of its clear segment searches from the same position
        steps = steps + (dr.select(wrong, UInt(0), 1) if features.segments else 1)
        active &= (weight > 0.0) & (steps < limits.steps)
        if features.roulette:
            weak = active & met & (weight < limits.weak)
            survives = rng.next_float64(weak) * limits.weak < weight
            weight = dr.select(weak, dr.select(survives, limits.weak, 0.0), weight)
            active &= ~weak | survives
        return p, d, weight, length, medium, ahead, segment, signature, history, steps, active, rng

    return body


def _by_number(number: Any, values: Sequence[Any]) -> Any:
    """Return the first of three values where ``number`` is 0, the second where it is 1, else the third."""
    import drjit as dr

    return dr.select(number == 0, values[0], dr.select(number == 1, values[1], values[2]))


@dataclass(frozen=True, eq=False)
class Shares:
    """Division of the light that meets a surface, as Dr.Jit arrays.

    Attributes
    ----------
    reflected, transmitted, diffused : Dr.Jit array
        Shares of the light.
    scattered : Dr.Jit array
        Share of the reflected or transmitted light for which a scattered direction is drawn.
    ratio, bent : Dr.Jit array
        Refractive index before over that behind, and cosine of the angle of refraction, 0 for total reflection; None
        without glass.
    marks : sequence of Dr.Jit arrays
        Numbers of the coating and scatter tables of measured surface finishes, see ``tables.MARKS``.
    """

    reflected: Any
    transmitted: Any
    diffused: Any
    scattered: Any
    ratio: Any
    bent: Any
    marks: Sequence[Any]

    @property
    def continuing(self) -> Any:
        """Share of the light that is not absorbed."""
        return self.reflected + self.transmitted + self.diffused

    def absorbed(self, weight: Any) -> Any:
        """Return the absorbed part of a weight."""
        import drjit as dr

        return dr.select(self.continuing < 1.0 - 1e-15, weight * (1.0 - self.continuing), 0.0)


@dataclass(frozen=True, eq=False)
class Choice:
    """Directions that paths take at a surface, as Dr.Jit arrays.

    Attributes
    ----------
    reflecting, through, diffusing : Dr.Jit mask
        Masks of the paths.
    weight : Dr.Jit array
        Weight with which they continue.
    unlikely : Dr.Jit mask
        True where the smallest probability (floor) made the direction more likely than its share of the light.
    """

    reflecting: Any
    through: Any
    diffusing: Any
    weight: Any
    unlikely: Any


def choose(shared: Shares, weight: Any, floor: Any, rng: Any, met: Any) -> Choice:
    """Draw whether paths at a surface are reflected, transmitted or diffused.

    Each possibility has the probability of its share of the light, but at least ``floor``. ``met`` is the mask of the
    paths that are at a surface.
    """
    import drjit as dr

    continuing = shared.continuing
    whole = dr.select(continuing > 0.0, 1.0 / continuing, 0.0)
    parts = (shared.reflected, shared.transmitted, shared.diffused)
    chances = [dr.select(s > 0.0, dr.maximum(s * whole, floor), 0.0) for s in parts]
    total = chances[0] + chances[1] + chances[2]
    u = rng.next_float64(met) * total
    reflecting = u < chances[0]
    through = ~reflecting & (u < chances[0] + chances[1])
    diffusing = ~reflecting & ~through & (chances[2] > 0.0)
    share = dr.select(reflecting, parts[0], dr.select(through, parts[1], parts[2]))
    chance = dr.select(reflecting, chances[0], dr.select(through, chances[1], chances[2]))
    onward = dr.select(chance > 0.0, weight * share * total / chance, 0.0)
    return Choice(reflecting, through, diffusing, onward, share * whole < floor)


def shares(
    prepared: PreparedScene, features: Features, row: Any, met: Any, place: Intersection, inside: Any, before: Any
) -> Shares:
    """Return the reflected, transmitted, diffused and scattered shares of light at the surface that each path meets."""
    import drjit as dr

    tables, glass = prepared.tables, features.glass
    reflected, transmitted, diffused, scattered = tables.finish(row, met)
    incidence = dr.abs(place.cosine)
    after: Any = None
    ratio: Any = None
    bent: Any = None
    if glass:
        after = dr.select(inside, 1.0, place.row[layout.INDEX])
        ratio = dr.select(inside, place.row[layout.INDEX], place.row[layout.INVERSE])
        bent = fresnel_scatter.cosine_after(incidence, ratio, 1.0)
    marks: list[Any] = []
    if features.measured:
        assert tables.measured is not None
        marks = tables.measured.of(row, met)
        # coatings are measured from the side of air
        coat = tables.measured.shares(marks, dr.select(inside, bent, incidence) if glass else incidence, met)
        reflected = dr.select(marks[0] > 0.5, coat[0], reflected)
        transmitted = dr.select(marks[0] > 0.5, coat[1], transmitted)
        total = tables.measured.total(marks, incidence, met)
        reflected = dr.select(marks[2] > 0.5, total, reflected)
        scattered = dr.select(marks[1] > 0.5, dr.minimum(total / dr.maximum(reflected, 1e-300), 1.0), scattered)
    if glass:
        bare = reflected < 0.0
        reflected = dr.select(bare, 0.0, reflected)
        total = bent <= 0.0
        opaque = ~bare & (transmitted <= 0.0)
        # beyond the critical angle all light is reflected, by bare glass as well
        transmitted = dr.select(total, 0.0, transmitted)
        reflected = dr.select(total & ~opaque, 1.0, reflected)
        if features.bare:
            uncoated = met & bare & ~total

            def fresnel(reflected: Any, transmitted: Any) -> tuple[Any, Any]:
                plain = fresnel_scatter.reflectance(incidence, before, after)
                return dr.select(uncoated, plain, reflected), dr.select(uncoated, 1.0 - plain, transmitted)

            reflected, transmitted = dr.if_stmt(
                (reflected, transmitted), uncoated, fresnel, lambda *same: same, label="fresnel", mode="symbolic"
            )
    return Shares(reflected, transmitted, diffused, scattered, ratio, bent, marks)
