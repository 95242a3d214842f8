"""The loop over a path's surfaces, recorded once as one Dr.Jit kernel; all numbers of the scene enter as arrays.

In each step a path flies to the next surface. In the open Mitsuba's ``Scene.ray_intersect_preliminary`` (float32, on
triangles) says which surface that is; Newton's method then finds the point on the analytic surface in float64. Inside a
glass body no triangles are needed: the body is convex and its faces are flat, so the next face is the nearest one
ahead, exactly, and no path leaks through an edge. Back in the open a triangle that only rounding puts there (the
surface just left, the inside of a glass face, the rim of a mesh beyond a mirror's edge) is passed over, and the flight
goes on behind it. Paths start in the open, outside all glass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from optics.geometry.surface import along, level, newton_step
from optics.materials import finish, scatter
from optics.numerics.backend import Backend
from twin.path_tracing import tables as layout
from twin.path_tracing.families import BITS, FACTOR, OUTSIDE, START, Event
from twin.path_tracing.sinks import Arrival, Sinks, record


def _nearest_face(
    backend: Backend, tables: layout.SceneTables, p: Any, d: Any, body: Any, inside: Any
) -> tuple[Any, Any]:
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


REFINEMENTS = 3
"""Newton steps from the triangle to the surface: from below a millimetre to 1e-7 and 1e-13 m and to rounding, also at
grazing incidence."""

STEP_BACK = 1e-5
"""How far behind a triangle that is passed over the search goes on, metres."""


@dataclass(frozen=True)
class Features:
    """What decides the kernel's code.

    Attributes:
        form: what the surfaces' shapes consist of.
        glass: there are glass bodies.
        branching: some finish does more than one thing with light that goes on.
        measured: some finish has a table, of its coating or of its scattering.
        roulette: weak paths are ended at random.
        keep_nominal: detections of the nominal family are recorded as well.
        log: the events of every path are written down.
    """

    form: layout.SurfaceForm
    glass: bool
    branching: bool
    measured: bool = False
    roulette: bool = False
    keep_nominal: bool = False
    log: bool = False


@dataclass(frozen=True, eq=False)
class Limits:
    """Numbers of one launch as opaque arrays of width 1.

    Attributes:
        steps: largest number of steps.
        room: of the records.
        floor: smallest probability of going each of the ways that there are; 0: as the power goes.
        scatter_floor: smallest probability of drawing a direction from a scatter lobe.
        weak: weight below which a path may be ended by roulette.
    """

    steps: Any
    room: Any
    floor: Any
    scatter_floor: Any
    weak: Any


@dataclass(frozen=True, eq=False)
class Launch:
    """Paths at their start: ``Vector3`` position and direction, weight, number of the path, random generator."""

    position: Any
    direction: Any
    weight: Any
    path: Any
    rng: Any


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """What the kernel works with: array types, Mitsuba with its variant set, triangles and tables of one scene."""

    backend: Backend
    mi: Any
    scene: Any
    tables: layout.SceneTables


def follow(prepared: PreparedScene, features: Features, limits: Limits, launch: Launch, sinks: Sinks) -> None:
    """Follow all paths to their end; nothing is evaluated yet.

    The weight that escapes to infinity and the weight still under way at the step limit go to the sinks as well.
    """
    import drjit as dr

    backend = prepared.backend
    n = dr.width(launch.position)
    UInt64 = dr.uint64_array_t(backend.Float)
    state = (
        backend.Vector3(launch.position),
        backend.Vector3(launch.direction),
        backend.Float(launch.weight),
        dr.zeros(backend.Float, n),  # optical path
        dr.zeros(backend.UInt, n),  # glass body that the path is in, 0 for none
        dr.zeros(backend.Float, n),  # how far ahead the search for the next surface starts
        dr.full(UInt64, START, n),
        dr.zeros(backend.UInt, n),  # 1 when scattered or diffused somewhere
        dr.zeros(backend.UInt, n),  # steps
        dr.full(backend.Bool, True, n),
        dr.zeros(backend.Float, n),  # escaped
        launch.rng,
    )
    labels = tuple("position direction weight length body ahead signature stray steps active escaped rng".split())
    body = _step(prepared, features, limits, launch.path, sinks)
    out = dr.while_loop(state, lambda *s: s[9], body, labels=labels, label="paths", mode="symbolic")
    alive = (out[8] >= limits.steps) & (out[10] == 0.0)
    dr.scatter_add(sinks.left, out[10], backend.UInt(0), out[10] > 0.0)
    dr.scatter_add(sinks.left, out[2], backend.UInt(1), alive)


def _step(
    prepared: PreparedScene, features: Features, limits: Limits, index: Any, sinks: Sinks
) -> Callable[..., tuple[Any, ...]]:
    """The loop's body: one step of every path."""
    import drjit as dr

    backend, tables, mi = prepared.backend, prepared.tables, prepared.mi
    Float, UInt, Vector3 = backend.Float, backend.UInt, backend.Vector3
    UInt64 = dr.uint64_array_t(Float)
    glass = features.glass

    def body(*state: Any) -> tuple[Any, ...]:
        p, d, weight, length, medium, ahead, signature, stray, steps, active, escaped, rng = state
        inside = medium != 0
        # which surface, and about how far away
        outside = active & ~inside if glass else active
        ray = mi.Ray3f(mi.Point3f(dr.fma(d, ahead, p)), mi.Vector3f(d))
        found = prepared.scene.ray_intersect_preliminary(ray, coherent=False, active=outside)
        hit = found.is_valid() & outside
        surface = dr.select(hit, UInt(found.shape_index), 0)
        near = Float(found.t) + ahead
        if glass:
            inside &= active
            t, face = _nearest_face(backend, tables, p, d, medium, inside)
            near, surface, hit = dr.select(inside, t, near), dr.select(inside, face, surface), hit | inside
        escaped = dr.select(active & ~hit, weight, escaped)
        active = hit

        # where exactly, in the surface's own frame
        g = tables.geometry(surface, active)
        kind = dr.gather(UInt, tables.kind, surface, active)
        local = Vector3(
            *(dr.fma(g[3 * a], p.x, dr.fma(g[3 * a + 1], p.y, dr.fma(g[3 * a + 2], p.z, g[9 + a]))) for a in range(3))
        )
        toward = Vector3(*(dr.fma(g[3 * a], d.x, dr.fma(g[3 * a + 1], d.y, g[3 * a + 2] * d.z)) for a in range(3)))
        if features.form.flat:
            t = -local.z / toward.z
            x, y = dr.fma(t, toward.x, local.x), dr.fma(t, toward.y, local.y)
            cosine, normal = toward.z, Vector3(g[6], g[7], g[8])
        else:
            t, shape = near, tables.surface(surface, g, features.form, active)
            for _ in range(REFINEMENTS):
                t = newton_step(local, toward, t, shape, tables.samples, active)
            x, y, z = along(local, toward, t)
            _, nx, ny, nz = level(x, y, z, shape, tables.samples, active)
            unit = dr.rsqrt(dr.fma(nx, nx, dr.fma(ny, ny, nz * nz)))
            nx, ny, nz = nx * unit, ny * unit, nz * unit
            cosine = dr.fma(nx, toward.x, dr.fma(ny, toward.y, nz * toward.z))
            normal = Vector3(*(dr.fma(g[a], nx, dr.fma(g[3 + a], ny, g[6 + a] * nz)) for a in range(3)))
        front = cosine < 0.0
        first, size = layout.APERTURES, layout.APERTURE
        clear = layout.within(x, y, g[first : first + size])
        if glass:
            clear |= layout.within(x, y, g[first + size : first + 2 * size])
        # what is there only by rounding and faceting
        skip = ~clear & (kind & layout.Kind.ENDS != 0)
        again = t <= 0.5 * ahead
        if glass:
            skip |= (again | (~front & (kind & layout.Kind.SOLID != 0))) & ~inside
        else:
            skip |= again
        met = active & ~skip
        ahead = dr.select(met, g[layout.CLEARANCE], near + STEP_BACK)

        flown = dr.select(met, t, 0.0)
        before = dr.select(inside, g[layout.INDEX], 1.0) if glass else Float(1.0)
        p = dr.fma(d, flown, p)
        length = dr.fma(flown, before, length)

        # how the light is shared out
        row = layout.ROWS_PER_SURFACE * surface + dr.select(clear, dr.select(front, UInt(0), 1), 2)
        f = tables.finish(row, met)
        reflected, transmitted, diffused = f[0], f[1], f[3]
        incidence = dr.abs(cosine)
        if glass:
            after = dr.select(inside, 1.0, g[layout.INDEX])
            bent = finish.cosine_after(incidence, before, after)
        marks: list[Any] = []
        if features.measured:
            assert tables.measured is not None
            marks = tables.measured.of(row, met)
            # a coating is measured from the side of air
            coat = tables.measured.shares(marks, dr.select(inside, bent, incidence) if glass else incidence, met)
            reflected = dr.select(marks[0] > 0.5, coat[0], reflected)
            transmitted = dr.select(marks[0] > 0.5, coat[1], transmitted)
            scattered = tables.measured.total(marks, incidence, met)
            reflected = dr.select(marks[2] > 0.5, scattered, reflected)
            f[4] = dr.select(marks[1] > 0.5, dr.minimum(scattered / dr.maximum(reflected, 1e-300), 1.0), f[4])
        if glass:
            total = bent <= 0.0
            bare, opaque = f[2] > 0.5, (f[2] <= 0.5) & (transmitted <= 0.0)
            plain = finish.reflectance(incidence, before, after)
            transmitted = dr.select(bare, 1.0 - plain, dr.select(total, 0.0, transmitted))
            reflected = dr.select(bare, plain, dr.select(total & ~opaque, 1.0, reflected))
        going_on = reflected + transmitted + diffused
        stays = dr.select(going_on < 1.0 - 1e-15, weight * (1.0 - going_on), 0.0)
        dr.scatter_add(sinks.absorbed, stays, row, met & (stays > 0.0))
        arrival = Arrival(x, y, stays, length, signature, stray != 0, index)
        record(backend, tables, sinks, limits.room, kind, met & front & clear, arrival, features.keep_nominal)

        # which way this path goes
        turned = dr.fma(normal, -2.0 * cosine, d)
        event = UInt(0) + 0 * surface
        if features.branching:
            whole = dr.select(going_on > 0.0, 1.0 / going_on, 0.0)
            shares = (reflected, transmitted, diffused)
            chances = [dr.select(s > 0.0, dr.maximum(s * whole, limits.floor), 0.0) for s in shares]
            every = chances[0] + chances[1] + chances[2]
            u = rng.next_float64() * every
            reflecting = u < chances[0]
            through = ~reflecting & (u < chances[0] + chances[1])
            diffusing = ~reflecting & ~through & (chances[2] > 0.0)
            share = dr.select(reflecting, reflected, dr.select(through, transmitted, diffused))
            chance = dr.select(reflecting, chances[0], dr.select(through, chances[1], chances[2]))
            onward = dr.select(chance > 0.0, weight * share * every / chance, 0.0)
            event = dr.select(
                reflecting, UInt(int(Event.REFLECT)), dr.select(through, UInt(int(Event.TRANSMIT)), int(Event.DIFFUSE))
            )
            out_index = Float(1.0)
            if glass:
                ratio = before / after
                cosine_after = dr.copysign(bent, cosine)
                refracted = dr.fma(normal, cosine_after - ratio * cosine, ratio * d)
                turned = dr.select(through, refracted, turned)
                own = kind >> layout.Kind.BODY_SHIFT & layout.Kind.BODY_MASK
                medium = dr.select(met & through, dr.select(inside, 0, own), medium)
                out_index = dr.select(medium != 0, g[layout.INDEX], 1.0)
            leaving = Leaving(turned, normal, out_index, event, onward, cosine, diffusing)
            drawn = None if not marks else TableDraw(tables.measured, marks, incidence)
            turned, event, onward, rng = spread(backend, rng, met, f[4:8], limits.scatter_floor, leaving, drawn)
            stray = dr.select(met & (event >= int(Event.DIFFUSE)), 1, stray)
        else:
            onward = weight * going_on
        d = dr.select(met, turned, d)
        weight = dr.select(met, onward, weight)
        code = UInt(g[layout.PART]) << BITS | (event + dr.select(clear, UInt(0), OUTSIDE))
        signature = dr.select(met, (signature ^ UInt64(code)) * UInt64(FACTOR), signature)
        if features.log:
            dr.scatter(sinks.log, dr.select(met, code, 0), index * limits.steps + steps, active)
        steps = steps + 1
        active &= (weight > 0.0) & (steps < limits.steps)
        if features.roulette:
            weak = active & met & (weight < limits.weak)
            survives = rng.next_float64() * limits.weak < weight
            weight = dr.select(weak, dr.select(survives, limits.weak, 0.0), weight)
            active &= ~weak | survives
        return p, d, weight, length, medium, ahead, signature, stray, steps, active, escaped, rng

    return body
