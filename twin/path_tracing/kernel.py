"""Loop over the surfaces of a path, recorded once as one Dr.Jit kernel; all numbers of the scene enter as arrays.

In each step a path is traced to the next surface (``surface_intersection``), the surface divides its light, and the
path continues in one of the possible directions. Neighbouring paths are processed together, as many as fit into the
processor's vector registers (a packet of paths). A packet takes as long as its longest path, and each step of it
executes all operations that any of its paths needs; operations for some surfaces only (Newton's method, Fresnel's
formulas, a scatter lobe, a detector) are skipped in packets without such a surface. Sources therefore start neighbours
alike, and paths that leave nominal light (``sequential``) are sorted so that neighbours behave alike. Sorting once
more, after four more steps, would save 9 percent of the packets' steps and cost as much, as measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from optics.materials import fresnel_scatter
from optics.numerics.backend import Backend
from twin.path_tracing import clear_ways
from twin.path_tracing import tables as layout
from twin.path_tracing.importance_sampling import OutgoingPaths, TableSampling, sample_bsdf
from twin.path_tracing.path_families import BITS, FACTOR, OUTSIDE, START, Event
from twin.path_tracing.path_result import Accumulators, Arrival, record
from twin.path_tracing.surface_intersection import Flight, Intersection, locate, next_surface

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
                own = kind >> layout.Kind.BODY_SHIFT & layout.Kind.BODY_MASK
                medium = dr.select(met & through, dr.select(inside, 0, own), medium)
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
