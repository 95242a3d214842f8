"""The loop over a path's surfaces, recorded once as one Dr.Jit kernel; all numbers of the scene enter as arrays.

In each step a path flies to the next surface (``surface_intersection``), the surface shares its light out, and the path
goes one of
the ways that there are. Neighbouring paths are worked on together, in packets of the machine's vectors. A packet takes
as long as its longest path, and all that any of its paths needs: what only some surfaces need (Newton's method,
Fresnel's formulas, a lobe, a detector) is computed by packets that need it. Sources let neighbours start alike, and
paths that leave nominal light (``sequential``) are put beside those that do alike. Putting them together once more,
after four more steps, would leave 9 percent fewer steps of packets and take as long as it saves, as measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from optics.materials import fresnel_scatter
from optics.numerics.backend import Backend
from twin.path_tracing import clear_ways
from twin.path_tracing import tables as layout
from twin.path_tracing.importance_sampling import Leaving, TableDraw, spread
from twin.path_tracing.path_families import BITS, FACTOR, OUTSIDE, START, Event
from twin.path_tracing.path_result import Arrival, Sinks, record
from twin.path_tracing.surface_intersection import Flight, Place, locate, next_surface

STEP_BACK = 1e-5
"""How far behind a triangle that is passed over the search goes on, metres."""

STRAY, UNLIKELY, GONE = 1, 2, 8
"""Bits of a path's history: scattered or diffused somewhere; unit of the number of unlikely ways that it has gone, at
most two; escaped to infinity. A path with none of them goes the way of its neighbours."""


@dataclass(frozen=True)
class Features:
    """What decides the kernel's code.

    Attributes
    ----------
    form : layout.SurfaceForm
        What the surfaces' shapes consist of.
    ways : bool
        There are clear ways.
    glass : bool
        There are glass bodies.
    branching : bool
        Some finish does more than one thing with light that goes on.
    bare : bool
        Some glass is bare.
    measured : bool
        Some finish has a table, of its coating or of its scattering.
    roulette : bool
        Weak paths are ended at random.
    near : bool
        Some scattered directions are drawn close to the specular one.
    keep_nominal : bool
        Detections of the nominal family are recorded as well.
    log : bool
        The events of every path are written down.
    """

    form: layout.SurfaceForm
    glass: bool
    branching: bool
    ways: bool = False
    bare: bool = False
    measured: bool = False
    roulette: bool = False
    near: bool = False
    keep_nominal: bool = False
    log: bool = False


@dataclass(frozen=True, eq=False)
class Limits:
    """Numbers of one launch as opaque arrays of width 1.

    Attributes
    ----------
    steps : Any
        Largest number of steps.
    room : Any
        Of the records.
    floors : Sequence[Any]
        Smallest probability of going each of the ways that there are, after none, one, and more unlikely ways; 0: as
        the power goes.
    scatter_floors : Sequence[Any]
        Likewise of drawing a direction from a scatter lobe.
    near : Any
        Share of these directions that are drawn close to the specular one.
    weak : Any
        Weight below which a path may be ended by roulette.
    """

    steps: Any
    room: Any
    floors: Sequence[Any]
    scatter_floors: Sequence[Any]
    near: Any
    weak: Any


@dataclass(frozen=True, eq=False)
class Launch:
    """Paths at their start, or some surfaces after it. Neighbours should be alike.

    Attributes
    ----------
    position, direction : Any
        ``Vector3``.
    weight : Any
        power.
    path : Any
        Number of the path.
    rng : Any
        Its random generator.
    way : Any
        Number of the way that it is on, 0 for none.
    length : Any
        Optical path so far, metres.
    body : Any
        Glass body that it is in, 0 for none.
    ahead : Any
        How far ahead the search for the next surface starts, metres.
    signature : Any
        Of its events so far.
    steps : Any
        How many these are.
    """

    position: Any
    direction: Any
    weight: Any
    path: Any
    rng: Any
    way: Any = 0
    length: Any = 0.0
    body: Any = 0
    ahead: Any = 0.0
    signature: Any = START
    steps: Any = 0


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """What the kernel works with: array types, Mitsuba with its variant set, triangles and tables of one scene."""

    backend: Backend
    mi: Any
    scene: Any
    tables: layout.SceneTables


def follow(prepared: PreparedScene, features: Features, limits: Limits, launch: Launch, sinks: Sinks) -> Any:
    """Follow all paths to their end; nothing is evaluated yet.

    The weight that escapes to infinity and the weight still under way at the step limit go to the sinks as well.

    Returns
    -------
    Any
        Steps that each path has taken from its start on.
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
        dr.zeros(backend.UInt, n) + launch.way,
        dr.zeros(dr.uint64_array_t(backend.Float), n) + launch.signature,
        dr.zeros(backend.UInt, n),  # what has happened to it, in bits
        dr.zeros(backend.UInt, n) + launch.steps,
        dr.full(backend.Bool, True, n),
        launch.rng,
    )
    labels = "position direction weight length body ahead way signature history steps active rng".split()
    body = _step(prepared, features, limits, launch.path, sinks)
    out = dr.while_loop(state, lambda *s: s[10], body, labels=labels, label="paths", mode="symbolic")
    escaped = out[8] & GONE != 0
    dr.scatter_add(sinks.left, out[2], backend.UInt(0), escaped)
    dr.scatter_add(sinks.left, out[2], backend.UInt(1), ~escaped & (out[2] > 0.0))
    return out[9]


def _step(
    prepared: PreparedScene, features: Features, limits: Limits, path: Any, sinks: Sinks
) -> Callable[..., tuple[Any, ...]]:
    """The loop's body: one step of every path."""
    import drjit as dr

    backend, tables = prepared.backend, prepared.tables
    Float, UInt = backend.Float, backend.UInt
    UInt64 = dr.uint64_array_t(Float)
    glass = features.glass

    def body(*state: Any) -> tuple[Any, ...]:
        p, d, weight, length, medium, ahead, way, signature, history, steps, active, rng = state
        inside = active & (medium != 0) if glass else active & False
        flight = Flight(p, d, medium if glass else None, ahead, active, history == 0, way, features.ways)
        found = next_surface(backend, prepared.mi, prepared.scene, tables, flight)
        surface = found.surface
        history = dr.select(active & ~found.hit, history | GONE, history)
        active = found.hit
        place = locate(backend, tables, features.form, replace(flight, active=active), found.near, surface)
        front = place.cosine < 0.0
        clear, kind = place.clear, place.kind
        # what is there only by rounding and faceting
        skip = ~clear & (kind & layout.Kind.ENDS != 0)
        again = place.distance <= 0.5 * ahead
        if glass:
            skip |= (again | (~front & (kind & layout.Kind.SOLID != 0))) & ~inside
        else:
            skip |= again
        passed = found.near + STEP_BACK
        wrong: Any = None
        if features.ways:
            arrives = place.exact & (place.distance > 0.0) & dr.select(found.way[1] & 2 == 0, place.first, place.second)
            wrong = found.tried & (skip | ~arrives)
            skip |= wrong
            passed = dr.select(wrong, ahead, passed)
        met = active & ~skip
        ahead = dr.select(met, place.row[layout.CLEARANCE], passed)
        flown = dr.select(met, place.distance, 0.0)
        before = dr.select(inside, place.row[layout.INDEX], 1.0) if glass else Float(1.0)
        p = dr.fma(d, flown, p)
        length = dr.fma(flown, before, length)

        # how the light is shared out
        row = layout.ROWS_PER_SURFACE * surface + dr.select(clear, dr.select(front, UInt(0), 1), 2)
        shared = shares(prepared, features, row, met, place, inside, before)
        going_on = shared.going_on
        stays = shared.stays(weight)
        dr.scatter_add(sinks.absorbed, stays, row, met & (stays > 0.0))
        stray = history & STRAY != 0
        arrival = Arrival(place.x, place.y, stays, length, signature, stray, path)
        record(backend, tables, sinks, limits.room, kind, met & front & clear, arrival, features.keep_nominal)

        # which way this path goes
        turned = dr.fma(place.normal, -2.0 * place.cosine, d)
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
                turned = dr.select(through, refracted, turned)
                own = kind >> layout.Kind.BODY_SHIFT & layout.Kind.BODY_MASK
                medium = dr.select(met & through, dr.select(inside, 0, own), medium)
                out_index = dr.select(medium != 0, place.row[layout.INDEX], 1.0)
            leaving = Leaving(turned, place.normal, out_index, event, onward, place.cosine, diffusing)
            drawn = TableDraw(tables.measured, shared.marks, dr.abs(place.cosine)) if shared.marks else None
            scatter_floor = _by_number(unlikely, limits.scatter_floors)
            near_share = limits.near if features.near else None
            lobe = tables.lobe(row)
            turned, event, onward, rng = spread(
                backend, rng, met, shared.scattered, lobe, scatter_floor, near_share, leaving, drawn
            )
            spreading = event >= int(Event.DIFFUSE)
            # light that is scattered goes on as its power does
            more = dr.select(chosen.unlikely, UInt(UNLIKELY), 0)
            more = dr.select(unlikely < 2, more, 0)
            history = dr.select(met, dr.select(spreading, STRAY + 2 * UNLIKELY, history + more), history)
        else:
            onward = weight * going_on
        if features.ways:
            behind = dr.dot(turned, place.normal) < 0.0
            a, b, c, e = place.row[layout.WAYS : layout.WAYS + clear_ways.PLACES]
            way = UInt(dr.select(place.first, dr.select(behind, b, a), dr.select(behind, e, c)))
            goes_on = found.tried & (behind == (found.way[1] & 1 != 0))
            way = dr.select(met & clear, dr.select(goes_on, found.way[0], way), 0)
        d = dr.select(met, turned, d)
        weight = dr.select(met, onward, weight)
        code = UInt(place.row[layout.PART]) << BITS | (event + dr.select(clear, UInt(0), OUTSIDE))
        signature = dr.select(met, (signature ^ UInt64(code)) * UInt64(FACTOR), signature)
        if features.log:
            dr.scatter(sinks.log, dr.select(met, code, 0), path * limits.steps + steps, active)
        # a path that has met nothing yet where it was thought to tries again
        steps = steps + (dr.select(wrong, UInt(0), 1) if features.ways else 1)
        active &= (weight > 0.0) & (steps < limits.steps)
        if features.roulette:
            weak = active & met & (weight < limits.weak)
            survives = rng.next_float64(weak) * limits.weak < weight
            weight = dr.select(weak, dr.select(survives, limits.weak, 0.0), weight)
            active &= ~weak | survives
        return p, d, weight, length, medium, ahead, way, signature, history, steps, active, rng

    return body


def _by_number(number: Any, values: Sequence[Any]) -> Any:
    """The value after none, one, and more."""
    import drjit as dr

    return dr.select(number == 0, values[0], dr.select(number == 1, values[1], values[2]))


@dataclass(frozen=True, eq=False)
class Shares:
    """What becomes of light that meets a surface: Dr.Jit arrays.

    Attributes
    ----------
    reflected, transmitted, diffused : Any
        shares.
    scattered : Any
        Share of what is reflected or transmitted for which a scattered direction is drawn.
    ratio, bent : Any
        Refractive index before over that behind, and cosine of the angle of refraction, 0 for total reflection; None
        where there is no glass.
    marks : Sequence[Any]
        Of measured finishes.
    """

    reflected: Any
    transmitted: Any
    diffused: Any
    scattered: Any
    ratio: Any
    bent: Any
    marks: Sequence[Any]

    @property
    def going_on(self) -> Any:
        """Share that is not absorbed."""
        return self.reflected + self.transmitted + self.diffused

    def stays(self, weight: Any) -> Any:
        """Absorbed part of a weight."""
        import drjit as dr

        return dr.select(self.going_on < 1.0 - 1e-15, weight * (1.0 - self.going_on), 0.0)


@dataclass(frozen=True, eq=False)
class Choice:
    """Which way paths go at a surface: Dr.Jit arrays.

    Attributes
    ----------
    reflecting, through, diffusing : Any
        masks.
    weight : Any
        With which they go on.
    unlikely : Any
        Whether a floor made the way more likely than its share of the light.
    """

    reflecting: Any
    through: Any
    diffusing: Any
    weight: Any
    unlikely: Any


def choose(shared: Shares, weight: Any, floor: Any, rng: Any, met: Any) -> Choice:
    """Draw which way paths go that are at a surface, each by its share of the light and at least by ``floor``."""
    import drjit as dr

    going_on = shared.going_on
    whole = dr.select(going_on > 0.0, 1.0 / going_on, 0.0)
    parts = (shared.reflected, shared.transmitted, shared.diffused)
    chances = [dr.select(s > 0.0, dr.maximum(s * whole, floor), 0.0) for s in parts]
    every = chances[0] + chances[1] + chances[2]
    u = rng.next_float64(met) * every
    reflecting = u < chances[0]
    through = ~reflecting & (u < chances[0] + chances[1])
    diffusing = ~reflecting & ~through & (chances[2] > 0.0)
    share = dr.select(reflecting, parts[0], dr.select(through, parts[1], parts[2]))
    chance = dr.select(reflecting, chances[0], dr.select(through, chances[1], chances[2]))
    onward = dr.select(chance > 0.0, weight * share * every / chance, 0.0)
    return Choice(reflecting, through, diffusing, onward, share * whole < floor)


def shares(
    prepared: PreparedScene, features: Features, row: Any, met: Any, place: Place, inside: Any, before: Any
) -> Shares:
    """Look the finish of each path's row up."""
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
        # a coating is measured from the side of air
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
        # beyond the critical angle all is reflected, of bare glass, too
        transmitted = dr.select(total, 0.0, transmitted)
        reflected = dr.select(total & ~opaque, 1.0, reflected)
        if features.bare:
            some = met & bare & ~total

            def fresnel(reflected: Any, transmitted: Any) -> tuple[Any, Any]:
                plain = fresnel_scatter.reflectance(incidence, before, after)
                return dr.select(some, plain, reflected), dr.select(some, 1.0 - plain, transmitted)

            reflected, transmitted = dr.if_stmt(
                (reflected, transmitted), some, fresnel, lambda *same: same, label="fresnel", mode="symbolic"
            )
    return Shares(reflected, transmitted, diffused, scattered, ratio, bent, marks)
