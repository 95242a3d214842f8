"""The way of nominal light, surface by surface in the known order: no loop, no search, and no table that paths read.

Most paths of a source follow its nominal family for many surfaces. There the surface that comes next is known, and so
are the side that is met, the glass, and the finish: all paths are computed with the same few numbers, which the kernel
reads once. A path leaves before the first surface where it does anything else: where it misses the clear aperture,
goes another way, is scattered, or is weak enough for roulette. It is as it was when it left the surface before, its
random numbers included; ``kernel.follow`` takes it up there, beside paths that do alike. So paths are the same with
and without this part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.geometry.surface import SurfaceNumbers
from optics.materials.fresnel_scatter import Finish
from optics.numerics.backend import Backend
from scenes.models.scenery import Scenery
from twin.path_tracing import tables as layout
from twin.path_tracing.clear_ways import Patch
from twin.path_tracing.importance_sampling import Thinning, divide
from twin.path_tracing.kernel import Features, Launch, Limits, PreparedScene, choose, shares
from twin.path_tracing.path_families import Event, code, decode, signature
from twin.path_tracing.path_result import Arrival, Sinks, record
from twin.path_tracing.surface_intersection import Flight, Place, locate

GROUP = 4
"""Surfaces in a row that a packet passes without asking whether any of its paths is still there."""

ENDED, MISSED, TURNED = range(3)
"""Why a path has left: the detector has absorbed it, it does not meet the next surface as usual, it goes another way
there or has come to the end."""

WORDS = 1
"""Steps of the random generator that a float64 takes."""

_MULTIPLIER = 0x5851F42D4C957F2D
"""Of the generator PCG32, state <- state * multiplier + increment (O'Neill, 2014)."""


@dataclass(frozen=True, eq=False)
class Step:
    """One surface of the way of nominal light.

    Attributes
    ----------
    surface : int
        Its number; aperture: the one of its clear apertures that is met.
    way : int
        Number of the clear way that leads to it, as in ``tables.way_table``, 0 for none.
    code : int
        Of the event there.
    detects : bool
        Whether it is the detector at the end.
    front : bool
        Whether it is met from +z.
    body : int
        Number of the glass body in which the path arrives, 0 in the open; after: in which it leaves.
    clearance : float
        How far beyond it a leaving path looks for the next surface, metres.
    form : layout.SurfaceForm
        Its shape; finish: on the side that is met.
    """

    surface: int
    aperture: int
    way: int
    code: int
    detects: bool
    front: bool
    body: int
    after: int
    clearance: float
    form: layout.SurfaceForm
    finish: Finish

    @property
    def event(self) -> Event:
        """What happens to nominal light, at the detector to what it does not absorb."""
        return decode(self.code)[1]

    @property
    def row(self) -> int:
        """Of its finish."""
        return layout.ROWS_PER_SURFACE * self.surface + (0 if self.front else 1)

    @property
    def total(self) -> bool:
        """Whether light has to be reflected totally in order to go on."""
        return self.event == Event.REFLECT and self.body > 0 and (self.finish.bare or self.finish.transmission > 0.0)

    @property
    def chooses(self) -> bool:
        """Whether light that goes on can go more than one way."""
        f = self.finish
        ways = sum(share > 0.0 for share in (f.reflectance, f.transmission, f.diffuse))
        return not self.total and (f.bare or ways > 1)

    @property
    def stays(self) -> float:
        """Share of the light that stays here, where it does not depend on the angle; below a rounding nothing does."""
        f = self.finish
        share = 0.0 if f.bare else 1.0 - f.reflectance - f.transmission - f.diffuse
        return share if share > 1e-15 else 0.0

    @property
    def ends(self) -> bool:
        """Whether no light goes on."""
        return self.stays == 1.0

    @property
    def known(self) -> bool:
        """Whether the finish lets nominal light do what it does, without a table."""
        f = self.finish
        share = f.transmission if self.event == Event.TRANSMIT else f.reflectance
        possible = (self.total and not f.diffuse) or f.bare or share > 0.0 or (self.detects and self.ends)
        return possible and not layout.measured(f)


def steps_of(
    scenery: Scenery, line: Sequence[tuple[int, Patch]], codes: Sequence[int], source: np.ndarray
) -> tuple[Step, ...]:
    """The steps along nominal light that all paths can take in the same way.

    Parameters
    ----------
    scenery : Scenery
        The surfaces.
    line : Sequence[tuple[int, Patch]]
        Numbers of the ways to the apertures that nominal light meets, see ``Step``, and these apertures.
    codes : Sequence[int]
        Of the family's events.
    source : np.ndarray
        Where its middle is, world, metres, (3,).
    """
    out: list[Step] = []
    bodies = layout.glass_bodies(scenery.surfaces)
    glass: str | None = None
    before = source
    for place, (way, end) in enumerate(line):
        s = scenery.surfaces[end.surface]
        detects = place == len(codes)
        event = code(scenery.parts.index(s.part), Event.REFLECT) if detects else codes[place]
        front = bool((end.middle - before) @ end.normal < 0.0)
        finish = s.front if front else s.back
        body = 0 if glass is None else bodies.index(glass) + 1
        form = layout.SurfaceForm.of([s])
        through = decode(event)[1] == Event.TRANSMIT
        onward = (None if glass is not None else s.solid) if through else glass
        after = 0 if onward is None else bodies.index(onward) + 1
        step = Step(end.surface, end.aperture, way, event, detects, front, body, after, s.clearance, form, finish)
        # light in glass stays there up to one of its faces, all ways inside are clear, and glass is met from its front
        sound = (s.solid == glass and way > 0) if glass is not None else (s.solid is None or front)
        if not sound or not step.known or (through and s.solid is None):
            break
        if detects and not (front and s.detector is not None):
            break
        out.append(step)
        glass, before = onward, end.middle
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Paths where they have left the nominal way: Dr.Jit arrays.

    Attributes
    ----------
    launch : Launch
        As they were after the last surface; their random numbers are ``draws`` behind.
    passed : Any
        How many surfaces each has passed.
    why : Any
        ``ENDED``, ``MISSED`` or ``TURNED``.
    draws : tuple[int, ...]
        Steps of the random generator that are still to be taken, by the surfaces passed.
    """

    launch: Launch
    passed: Any
    why: Any
    draws: tuple[int, ...]

    @property
    def arrays(self) -> list[Any]:
        """All that is to be evaluated."""
        at = self.launch
        return [at.position, at.direction, at.weight, at.length, at.rng, self.passed, self.why]


def pass_along(
    prepared: PreparedScene, features: Features, limits: Limits, launch: Launch, sinks: Sinks, steps: Sequence[Step]
) -> Stretch:
    """Take paths along nominal light as far as they follow it; nothing is evaluated yet."""
    import drjit as dr

    backend = prepared.backend
    n = dr.width(launch.position)
    along = _Along(prepared, features, limits, launch.path, sinks, steps)
    state: Any = (
        backend.Vector3(launch.position),
        backend.Vector3(launch.direction),
        backend.Float(launch.weight),
        dr.zeros(backend.Float, n),
        launch.rng.state + 0,
        dr.zeros(backend.UInt, n),
        dr.full(backend.UInt, TURNED, n),
        dr.full(backend.Bool, True, n),
    )
    draws = [0]
    for first in range(0, len(steps), GROUP):

        def some(*state: Any, first: int = first) -> tuple[Any, ...]:
            for place in range(first, min(first + GROUP, len(steps))):
                state, left = along.step(place, state, launch.rng, draws[place])
                draws.append(left)
            return state

        state = dr.if_stmt(state, state[-1], some, lambda *same: same, label="nominal", mode="symbolic")
    p, d, weight, length, words, passed, why, _ = state
    rng = type(launch.rng)(launch.rng)
    rng.state = words
    return Stretch(
        replace(launch, position=p, direction=d, weight=weight, length=length, rng=rng), passed, why, tuple(draws)
    )


@dataclass(frozen=True, eq=False)
class _Along:
    """What all steps need."""

    prepared: PreparedScene
    features: Features
    limits: Limits
    path: Any
    sinks: Sinks
    steps: Sequence[Step]

    def step(self, place: int, state: tuple[Any, ...], rng: Any, pending: int) -> tuple[tuple[Any, ...], int]:
        """One surface.

        Parameters
        ----------
        place : int
            Of the step.
        state : tuple[Any, ...]
            Position, direction, weight, length, state of the random generator, surfaces passed, why a path has left,
            and which are on their way.
        rng : Any
            The paths' random generator.
        pending : int
            Steps that it still has to take.

        Returns
        -------
        tuple[tuple[Any, ...], int]
            The state after it and the steps that the generator of paths that go on still has to take.
        """
        import drjit as dr

        backend, features, step = self.prepared.backend, self.features, self.steps[place]
        p, d, weight, length, words, passed, why, on = state
        numbers: Any = OneSurface(self.prepared, step)
        here = replace(self.prepared, tables=numbers)
        at, arrives = self._meet(place, numbers, p, d, on)
        before = at.row[layout.INDEX] if step.body else backend.Float(1.0)
        q, longer = dr.fma(d, at.distance, p), dr.fma(at.distance, before, length)
        known = replace(features, bare=step.finish.bare and not step.total, measured=False)
        inside = backend.Bool(step.body > 0)
        shared = shares(here, known, backend.UInt(step.row), arrives, at, inside, before)
        drawn = type(rng)(rng)
        drawn.state = words
        onward, follows = weight * shared.going_on, backend.Bool(True)
        usual = follows
        if features.branching:
            if step.chooses:
                drawn.state, pending = advanced(drawn.state, rng.inc, pending), 0
                chosen = choose(shared, weight, self.limits.floors[0], drawn, arrives)
                onward, usual = chosen.weight, ~chosen.unlikely
                follows = chosen.through if step.event == Event.TRANSMIT else chosen.reflecting
            else:
                pending += WORDS
            if step.finish.scatter is not None:
                drawn.state, pending = advanced(drawn.state, rng.inc, pending), 0
                floor = self.limits.scatter_floors[0]
                scattering, onward = divide(drawn, arrives, arrives & follows, shared.scattered, floor, onward)
                follows = follows & ~scattering
            else:
                pending += WORDS
        usual = usual & (onward > 0.0)
        if step.total:
            usual = usual & (shared.bent <= 0.0)
        if features.roulette:
            usual = usual & (onward >= self.limits.weak)
        goes = arrives if step.ends else arrives & follows & usual
        stays, row = shared.stays(weight), backend.UInt(step.row)
        if step.stays > 0.0:
            dr.scatter_add(self.sinks.absorbed, stays, row, goes)
        if step.detects:
            so_far = dr.uint64_array_t(backend.Float)(signature(s.code for s in self.steps[:place]))
            arrival = Arrival(at.x, at.y, stays, longer, so_far, backend.Bool(False), self.path)
            tables, room = self.prepared.tables, self.limits.room
            record(backend, tables, self.sinks, room, at.kind, goes, arrival, features.keep_nominal)
        # the loop decides what becomes of a path that is not as usual
        why = dr.select(on & ~goes & ~(arrives & ~follows), MISSED, why)
        if step.ends:
            return (p, d, weight, length, words, passed, dr.select(goes, ENDED, why), goes & False), pending
        turned = dr.fma(at.normal, -2.0 * at.cosine, d)
        if step.event == Event.TRANSMIT:
            bent = dr.copysign(shared.bent, at.cosine)
            turned = dr.fma(at.normal, bent - shared.ratio * at.cosine, shared.ratio * d)
        after = (q, turned, onward, longer, drawn.state, passed + 1)
        new = (dr.select(goes, a, b) for a, b in zip(after, (p, d, weight, length, words, passed), strict=True))
        return (*new, why, goes), pending

    def _meet(self, place: int, numbers: Any, p: Any, d: Any, on: Any) -> tuple[Place, Any]:
        """Where paths meet the surface of a step, and which of them meet it as nominal light does."""
        import drjit as dr

        prepared, backend, step = self.prepared, self.prepared.backend, self.steps[place]
        ahead = numbers.clearance(self.steps[place - 1].surface) if place else backend.Float(0.0)
        if step.way:
            x, y, z, _, *normal, _ = numbers.way()
            n = backend.Vector3(*normal)
            near, there = dr.dot(backend.Vector3(x, y, z) - p, n) / dr.dot(d, n), on
        else:
            ray = prepared.mi.Ray3f(prepared.mi.Point3f(dr.fma(d, ahead, p)), prepared.mi.Vector3f(d))
            found = prepared.scene.ray_intersect_preliminary(ray, coherent=True, active=on)
            near = backend.Float(found.t) + ahead
            there = on & found.is_valid() & (backend.UInt(found.shape_index) == step.surface)
        flight = Flight(p, d, None, None, on, None, None, False)
        at = locate(backend, numbers, step.form, flight, near, backend.UInt(step.surface))
        # a path in the open passes over what is nearer than it looks
        least = backend.Float(0.0) if step.body else 0.5 * ahead
        there = there & at.exact & (at.distance > least) & (at.first, at.second)[step.aperture]
        return at, there & (at.cosine < 0.0 if step.front else at.cosine >= 0.0)


def advanced(words: Any, increment: Any, steps: int) -> Any:
    """State of a random generator some steps later."""
    factor, shift = _jump(steps)
    kind = type(words)
    return words * kind(factor) + increment * kind(shift) if steps else words


def _jump(steps: int) -> tuple[int, int]:
    """Factors of the state and of the increment in the state some steps later."""
    factor, shift = 1, 0
    for _ in range(steps):
        factor, shift = factor * _MULTIPLIER % 2**64, (shift * _MULTIPLIER + 1) % 2**64
    return factor, shift


@dataclass(frozen=True, eq=False)
class OneSurface:
    """Numbers of the surface of a step, which all paths meet, in the place of ``tables.SceneTables``."""

    prepared: PreparedScene
    step: Step
    measured: None = None

    @property
    def samples(self) -> Any:
        """Coefficients of grid figures."""
        return self.prepared.tables.samples

    def geometry(self, surface: Any, active: Any) -> list[Any]:
        """The row of the surface without ways; what says of which kind something is belongs to the kernel's code."""
        tables = self.prepared.tables
        out = self._numbers(tables.rows, layout.ROW * self.step.surface, layout.WAYS)
        for place in layout.KINDS:
            out[place] = self._literal(tables.host_rows[self.step.surface, place])
        return out

    def clearance(self, surface: int) -> Any:
        """Of any surface."""
        return self._numbers(self.prepared.tables.rows, layout.ROW * surface + layout.CLEARANCE, 1)[0]

    def finish(self, row: Any, active: Any) -> list[Any]:
        """Shares of the finish; whether they are nothing or all belongs to the kernel's code."""
        tables, first = self.prepared.tables, layout.FINISH_ROW * self.step.row
        amounts = tables.host_finishes.ravel()[first : first + layout.BLOCK]
        found = zip(amounts, self._numbers(tables.finishes, first, layout.BLOCK), strict=True)
        return [self._literal(amount) if amount in (-1.0, 0.0, 1.0) else number for amount, number in found]

    def surface(self, number: Any, form: layout.SurfaceForm, active: Any) -> SurfaceNumbers:
        """The surface's shape."""
        return self.prepared.tables.surface(number, form, True)

    def way(self) -> list[Any]:
        """Of the step."""
        return self._numbers(self.prepared.tables.ways, layout.WAY * self.step.way, layout.WAY)

    def _numbers(self, source: Any, first: int, count: int) -> list[Any]:
        """Numbers at a place that is the same for all paths: the kernel reads them once."""
        import drjit as dr

        backend = self.prepared.backend
        return [dr.gather(backend.Float, source, backend.UInt(first + k)) for k in range(count)]

    def _literal(self, value: float) -> Any:
        return self.prepared.backend.Float(float(value))


@dataclass(frozen=True, eq=False)
class Left:
    """Paths that have left the nominal way, those beside each other that do alike.

    Attributes
    ----------
    passed : np.ndarray
        Surfaces passed by each path of the launch, (N,).
    turned : np.ndarray
        Whether it turned away there, (N,).
    chosen : np.ndarray
        Places in the launch of the paths that go on.
    chances : np.ndarray
        With which they were chosen.
    """

    passed: np.ndarray
    turned: np.ndarray
    chosen: np.ndarray
    chances: np.ndarray

    @classmethod
    def of(
        cls, steps: Sequence[Step], stretch: Stretch, numbers: np.ndarray, thinning: Thinning | None, again: bool
    ) -> Left:
        """Choose among the paths of a stretch that is evaluated.

        Parameters
        ----------
        steps : Sequence[Step]
            Of the nominal way.
        stretch : Stretch
            The paths.
        numbers : np.ndarray
            Of the paths in the run, (N,).
        thinning : Thinning | None
            How many are followed, None for all.
        again : bool
            They are known to be followed.
        """
        passed, why = stretch.passed.numpy(), stretch.why.numpy()
        # at the end of a way that does not end at a detector nothing has turned away
        turned = (why == TURNED) & ((passed < len(steps)) | steps[-1].detects)
        goes_on, chances = why != ENDED, np.ones(len(why))
        if thinning is not None:
            some = np.flatnonzero(turned)
            chances[some] = thinning.chances(numbers[some], passed[some])
            if not again:
                goes_on[some] = thinning.follows(numbers[some], chances[some])
        left = np.flatnonzero(goes_on)
        # sorting 16 bits takes no comparisons
        order = np.argsort((passed[left] * (TURNED + 1) + why[left]).astype(np.uint16), kind="stable")
        chosen = left[order]
        return cls(passed, turned, chosen, chances[chosen])


def go_on(backend: Backend, steps: Sequence[Step], stretch: Stretch, left: Left) -> Launch:
    """The chosen paths where they have left the nominal way."""
    import drjit as dr

    launch = stretch.launch
    Float, UInt = backend.Float, backend.UInt
    UInt64 = dr.uint64_array_t(Float)
    chosen = backend.opaque(left.chosen, UInt)
    place = dr.gather(UInt, stretch.passed, chosen)

    def by_place(kind: Any, values: Sequence[Any]) -> Any:
        return dr.gather(kind, backend.opaque(values, kind), place)

    codes = [step.code for step in steps]
    jumps = [_jump(draws) for draws in stretch.draws]
    factor, shift = (by_place(UInt64, [jump[k] for jump in jumps]) for k in range(2))
    rng = dr.gather(type(launch.rng), launch.rng, chosen)
    rng.state = rng.state * factor + rng.inc * shift
    return Launch(
        dr.gather(backend.Vector3, launch.position, chosen),
        dr.gather(backend.Vector3, launch.direction, chosen),
        dr.gather(Float, launch.weight, chosen) / backend.opaque(left.chances),
        dr.gather(UInt, launch.path, chosen),
        rng,
        dr.select(dr.gather(UInt, stretch.why, chosen) == TURNED, by_place(UInt, [*(s.way for s in steps), 0]), 0),
        dr.gather(Float, launch.length, chosen),
        by_place(UInt, [0, *(s.after for s in steps)]),
        by_place(Float, [0.0, *(s.clearance for s in steps)]),
        by_place(UInt64, [signature(codes[:k]) for k in range(len(steps) + 1)]),
        place,
    )
