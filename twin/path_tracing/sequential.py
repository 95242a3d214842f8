"""Trace of nominal light, surface by surface in the known order: no loop, no search, and no table lookup by each path.

Most paths of a source follow its nominal family for many surfaces. There the next surface is known, and so are the side
that is met, the glass, and the finish: all paths are computed with the same few numbers, which the kernel reads once. A
path leaves before the first surface where it does anything else: where it misses the clear aperture, takes another
direction, is scattered, or is weak enough for roulette. It is then in the state in which it left the surface before,
its random numbers included; ``kernel.follow`` continues it beside paths that behave alike. Paths are therefore the same
with and without this part.
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
from twin.path_tracing import kernel
from twin.path_tracing import tables as layout
from twin.path_tracing.clear_ways import Patch
from twin.path_tracing.kernel import LearnedRoulette, sample_scattering
from twin.path_tracing.path_families import Event, code, decode, signature
from twin.path_tracing.path_result import Accumulators, Arrival, record

GROUP = 4
"""Number of consecutive surfaces between two tests of whether any path processed together is still active."""

ENDED, MISSED, REDIRECTED = range(3)
"""Reasons why a path has left the nominal path.

They are: absorbed by the detector; does not meet the next surface as nominal light does; takes another direction there
or has reached the last traced surface.
"""

DRAWS_PER_FLOAT64 = 1
"""Number of steps that the random generator takes for one float64."""

_MULTIPLIER = 0x5851F42D4C957F2D
"""Multiplier of the generator PCG32, state <- state * multiplier + increment (O'Neill, 2014)."""


@dataclass(frozen=True, eq=False)
class Step:
    """Surface of the nominal path, with what nominal light does there.

    Attributes
    ----------
    surface : int
        Index of the surface.
    aperture : int
        Index of its clear aperture that is met.
    segment : int
        Index, in ``tables.segment_table``, of the clear segment (with nothing between its ends) that leads to it; 0 if
        there is none.
    code : int
        Number of the event there, see ``path_families.code``.
    detects : bool
        True for the detector at the end.
    front : bool
        True where it is met from +z.
    body : int
        Number of the glass body in which the path arrives; 0 for air or vacuum.
    after : int
        Number of the glass body in which the path leaves.
    clearance : float
        Distance beyond the surface at which the search for the next surface starts, metres.
    form : layout.SurfaceForm
        Components of its shape.
    finish : Finish
        Finish on the side that is met.
    """

    surface: int
    aperture: int
    segment: int
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
        """Event of nominal light at the surface; at the detector, that of light which it does not absorb."""
        return decode(self.code)[1]

    @property
    def row(self) -> int:
        """Index, in the table of finishes, of the finish of the side of the surface that nominal light meets."""
        return layout.ROWS_PER_SURFACE * self.surface + (0 if self.front else 1)

    @property
    def total(self) -> bool:
        """True where nominal light must be totally reflected to continue."""
        return self.event == Event.REFLECT and self.body > 0 and (self.finish.bare or self.finish.transmission > 0.0)

    @property
    def chooses(self) -> bool:
        """True where light that continues has more than one possible direction."""
        f = self.finish
        branches = sum(share > 0.0 for share in (f.reflectance, f.transmission, f.diffuse))
        return not self.total and (f.bare or branches > 1)

    @property
    def absorbed(self) -> float:
        """Fraction of the light that the surface absorbs, if it does not depend on the angle; 0 below rounding."""
        f = self.finish
        share = 0.0 if f.bare else 1.0 - f.reflectance - f.transmission - f.diffuse
        return share if share > 1e-15 else 0.0

    @property
    def ends(self) -> bool:
        """True where the surface absorbs all light, so that every path ends there."""
        return self.absorbed == 1.0

    @property
    def known(self) -> bool:
        """True where nominal light can continue with this finish, and its shares do not come from a measured table."""
        f = self.finish
        share = f.transmission if self.event == Event.TRANSMIT else f.reflectance
        possible = (self.total and not f.diffuse) or f.bare or share > 0.0 or (self.detects and self.ends)
        return possible and not layout.measured(f)


def make_steps(
    scenery: Scenery, line: Sequence[tuple[int, Patch]], codes: Sequence[int], source: np.ndarray
) -> tuple[Step, ...]:
    """Return the surfaces of the nominal path, as far as all paths can be traced through them with the same numbers.

    Parameters
    ----------
    scenery : Scenery
        Surfaces.
    line : sequence of (int, Patch)
        Apertures that nominal light meets, each with the row in ``tables.segment_table`` of the clear segment that
        leads to it; 0 where that is not clear.
    codes : Sequence[int]
        Numbers of the events of nominal light, see ``path_families.code``.
    source : (3,) ndarray
        Middle of the source, world frame, metres.
    """
    out: list[Step] = []
    bodies = layout.glass_bodies(scenery.surfaces)
    glass: str | None = None
    before = source
    for place, (segment, end) in enumerate(line):
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
        step = Step(end.surface, end.aperture, segment, event, detects, front, body, after, s.clearance, form, finish)
        # light in glass stays there up to a face, all segments inside are clear, and glass is met from its front
        sound = (s.solid == glass and segment > 0) if glass is not None else (s.solid is None or front)
        if not sound or not step.known or (through and s.solid is None):
            break
        if detects and not (front and s.detector is not None):
            break
        out.append(step)
        glass, before = onward, end.middle
    return tuple(out)


@dataclass(frozen=True, eq=False)
class NominalPart:
    """Paths at the point where they have left the nominal path, as Dr.Jit arrays.

    Attributes
    ----------
    launch : Launch
        Paths after their last nominal surface; their random generators are ``draws`` steps behind.
    passed : Dr.Jit array
        Number of surfaces that each has passed.
    reason : Dr.Jit array
        Reason why each has left: ``ENDED``, ``MISSED`` or ``REDIRECTED``.
    draws : tuple of int
        Number of steps of the random generator still to be taken, by the surfaces passed.
    """

    launch: kernel.Launch
    passed: Any
    reason: Any
    draws: tuple[int, ...]

    @property
    def arrays(self) -> list[Any]:
        """All arrays of the paths, which Dr.Jit has to evaluate."""
        at = self.launch
        return [at.position, at.direction, at.weight, at.length, at.rng, self.passed, self.reason]


def trace_nominal(
    prepared: kernel.PreparedScene,
    features: kernel.Features,
    limits: kernel.Limits,
    launch: kernel.Launch,
    accumulators: Accumulators,
    steps: Sequence[Step],
) -> NominalPart:
    """Record the trace of paths along nominal light, as far as they follow it; Dr.Jit evaluates it later."""
    import drjit as dr

    backend = prepared.backend
    n = dr.width(launch.position)
    along = _NominalTracer(prepared, features, limits, launch.path, accumulators, steps)
    state: Any = (
        backend.Vector3(launch.position),
        backend.Vector3(launch.direction),
        backend.Float(launch.weight),
        dr.zeros(backend.Float, n),
        launch.rng.state + 0,
        dr.zeros(backend.UInt, n),
        dr.full(backend.UInt, REDIRECTED, n),
        dr.full(backend.Bool, True, n),
    )
    draws = [0]
    for first in range(0, len(steps), GROUP):

        def part(*state: Any, first: int = first) -> tuple[Any, ...]:
            for place in range(first, min(first + GROUP, len(steps))):
                state, left = along.step(place, state, launch.rng, draws[place])
                draws.append(left)
            return state

        state = dr.if_stmt(state, state[-1], part, lambda *same: same, label="nominal", mode="symbolic")
    p, d, weight, length, rng_state, passed, reason, _ = state
    rng = type(launch.rng)(launch.rng)
    rng.state = rng_state
    return NominalPart(
        replace(launch, position=p, direction=d, weight=weight, length=length, rng=rng), passed, reason, tuple(draws)
    )


@dataclass(frozen=True, eq=False)
class _NominalTracer:
    """Scene, limits and accumulators that the trace along the nominal path needs at every surface."""

    prepared: kernel.PreparedScene
    features: kernel.Features
    limits: kernel.Limits
    path: Any
    accumulators: Accumulators
    steps: Sequence[Step]

    def step(self, number: int, state: tuple[Any, ...], rng: Any, pending: int) -> tuple[tuple[Any, ...], int]:
        """Trace the paths to the surface of a step and past it.

        Parameters
        ----------
        number : int
            Index of the step.
        state : tuple of Dr.Jit arrays
            Position, direction, weight, length, state of the random generator, surfaces passed, reason why a path has
            left, and mask of the active paths.
        rng : Dr.Jit random generator
            Random generator of the paths.
        pending : int
            Number of steps that it still has to take.

        Returns
        -------
        tuple of (tuple, int)
            State after the surface, and the number of steps that the generator of continuing paths still has to take.
        """
        import drjit as dr

        backend, features, step = self.prepared.backend, self.features, self.steps[number]
        p, d, weight, length, rng_state, passed, reason, on = state
        numbers: Any = OneSurface(self.prepared, step)
        scene = replace(self.prepared, tables=numbers)
        at, arrives = self._meet(number, numbers, p, d, on)
        before = at.row[layout.INDEX] if step.body else backend.Float(1.0)
        q, longer = dr.fma(d, at.distance, p), dr.fma(at.distance, before, length)
        step_features = replace(features, bare=step.finish.bare and not step.total, measured=False)
        inside = backend.Bool(step.body > 0)
        shared = kernel.shares(scene, step_features, backend.UInt(step.row), arrives, at, inside, before)
        generator = type(rng)(rng)
        generator.state = rng_state
        new_weight, as_nominal = weight * shared.continuing, backend.Bool(True)
        usual = as_nominal
        if features.branching:
            if step.chooses:
                generator.state, pending = advanced(generator.state, rng.inc, pending), 0
                chosen = kernel.choose(shared, weight, self.limits.floors[0], generator, arrives)
                new_weight, usual = chosen.weight, ~chosen.unlikely
                as_nominal = chosen.through if step.event == Event.TRANSMIT else chosen.reflecting
            else:
                pending += DRAWS_PER_FLOAT64
            if step.finish.scatter is not None:
                generator.state, pending = advanced(generator.state, rng.inc, pending), 0
                floor = self.limits.scatter_floors[0]
                scattering, new_weight = sample_scattering(
                    generator, arrives, arrives & as_nominal, shared.scattered, floor, new_weight
                )
                as_nominal = as_nominal & ~scattering
            else:
                pending += DRAWS_PER_FLOAT64
        usual = usual & (new_weight > 0.0)
        if step.total:
            usual = usual & (shared.bent <= 0.0)
        if features.roulette:
            usual = usual & (new_weight >= self.limits.weak)
        continues = arrives if step.ends else arrives & as_nominal & usual
        absorbed, row = shared.absorbed(weight), backend.UInt(step.row)
        if step.absorbed > 0.0:
            dr.scatter_add(self.accumulators.absorbed, absorbed, row, continues)
        if step.detects:
            so_far = dr.uint64_array_t(backend.Float)(signature(s.code for s in self.steps[:number]))
            arrival = Arrival(at.x, at.y, absorbed, longer, so_far, backend.Bool(False), self.path)
            tables, capacity = self.prepared.tables, self.limits.capacity
            record(backend, tables, self.accumulators, capacity, at.kind, continues, arrival, features.keep_nominal)
        # the loop handles paths that do not follow nominal light
        reason = dr.select(on & ~continues & ~(arrives & ~as_nominal), MISSED, reason)
        if step.ends:
            ended = dr.select(continues, ENDED, reason)
            return (p, d, weight, length, rng_state, passed, ended, continues & False), pending
        direction = dr.fma(at.normal, -2.0 * at.cosine, d)
        if step.event == Event.TRANSMIT:
            bent = dr.copysign(shared.bent, at.cosine)
            direction = dr.fma(at.normal, bent - shared.ratio * at.cosine, shared.ratio * d)
        after = (q, direction, new_weight, longer, generator.state, passed + 1)
        new = (
            dr.select(continues, a, b) for a, b in zip(after, (p, d, weight, length, rng_state, passed), strict=True)
        )
        return (*new, reason, continues), pending

    def _meet(self, number: int, numbers: Any, p: Any, d: Any, on: Any) -> tuple[kernel.Intersection, Any]:
        """Return the intersection of paths with a step's surface, and the mask of those that follow nominal light."""
        import drjit as dr

        prepared, backend, step = self.prepared, self.prepared.backend, self.steps[number]
        ahead = numbers.clearance(self.steps[number - 1].surface) if number else backend.Float(0.0)
        if step.segment:
            x, y, z, _, *normal, _ = numbers.segment()
            n = backend.Vector3(*normal)
            near, met = dr.dot(backend.Vector3(x, y, z) - p, n) / dr.dot(d, n), on
        else:
            ray = prepared.mi.Ray3f(prepared.mi.Point3f(dr.fma(d, ahead, p)), prepared.mi.Vector3f(d))
            intersection = prepared.scene.ray_intersect_preliminary(ray, coherent=True, active=on)
            near = backend.Float(intersection.t) + ahead
            met = on & intersection.is_valid() & (backend.UInt(intersection.shape_index) == step.surface)
        flight = kernel.Flight(p, d, None, None, on, None, None, False)
        at = kernel.locate(backend, numbers, step.form, flight, near, backend.UInt(step.surface))
        # a path in the open skips surfaces closer than the start of its search
        least = backend.Float(0.0) if step.body else 0.5 * ahead
        met = met & at.exact & (at.distance > least) & (at.first, at.second)[step.aperture]
        return at, met & (at.cosine < 0.0 if step.front else at.cosine >= 0.0)


def advanced(rng_state: Any, increment: Any, steps: int) -> Any:
    """Return the state of the PCG32 random generator after a number of steps."""
    factor, shift = _jump(steps)
    kind = type(rng_state)
    return rng_state * kind(factor) + increment * kind(shift) if steps else rng_state


def _jump(steps: int) -> tuple[int, int]:
    """Return two factors m and c: after ``steps`` steps, the generator's state is m * state + c * increment."""
    factor, shift = 1, 0
    for _ in range(steps):
        factor, shift = factor * _MULTIPLIER % 2**64, (shift * _MULTIPLIER + 1) % 2**64
    return factor, shift


@dataclass(frozen=True, eq=False)
class OneSurface:
    """Numbers of a single surface that all paths meet, with the interface of ``tables.SceneTables``."""

    prepared: kernel.PreparedScene
    step: Step
    measured: None = None

    @property
    def samples(self) -> Any:
        """Coefficients of the figures on grids of all surfaces."""
        return self.prepared.tables.samples

    def geometry(self, surface: Any, active: Any) -> list[Any]:
        """Return the surface's row of the geometry table (pose, apertures, kind) without its clear segments.

        Numbers that encode a kind are constants of the kernel's code.
        """
        tables = self.prepared.tables
        out = self._numbers(tables.rows, layout.ROW * self.step.surface, layout.SEGMENTS)
        for place in layout.KINDS:
            out[place] = self._literal(tables.host_rows[self.step.surface, place])
        return out

    def clearance(self, surface: int) -> Any:
        """Return the distance beyond any surface at which the search for the next one starts, metres."""
        return self._numbers(self.prepared.tables.rows, layout.ROW * surface + layout.CLEARANCE, 1)[0]

    def finish(self, row: Any, active: Any) -> list[Any]:
        """Return reflectance, transmission, and shares of diffused and of scattered light, of the surface's finish.

        Shares of 0 or 1 are constants of the kernel's code.
        """
        tables, first = self.prepared.tables, layout.FINISH_ROW * self.step.row
        amounts = tables.host_finishes.ravel()[first : first + layout.BLOCK]
        pairs = zip(amounts, self._numbers(tables.finishes, first, layout.BLOCK), strict=True)
        return [self._literal(amount) if amount in (-1.0, 0.0, 1.0) else number for amount, number in pairs]

    def surface(self, number: Any, form: layout.SurfaceForm, active: Any) -> SurfaceNumbers:
        """Return the numbers that describe the shape of the surface."""
        return self.prepared.tables.surface(number, form, True)

    def segment(self) -> list[Any]:
        """Return the numbers of the clear segment that leads to the surface."""
        return self._numbers(self.prepared.tables.segments, layout.SEGMENT * self.step.segment, layout.SEGMENT)

    def _numbers(self, source: Any, first: int, count: int) -> list[Any]:
        """Return ``count`` numbers of a table from index ``first``, read once because it is the same for all paths."""
        import drjit as dr

        backend = self.prepared.backend
        return [dr.gather(backend.Float, source, backend.UInt(first + k)) for k in range(count)]

    def _literal(self, value: float) -> Any:
        return self.prepared.backend.Float(float(value))


@dataclass(frozen=True, eq=False)
class Departures:
    """The N paths of a launch after they have left the nominal path, sorted so that neighbours behave alike.

    Attributes
    ----------
    passed : (N,) ndarray
        Number of surfaces passed by each path of the launch.
    redirected : (N,) ndarray of bool
        True where the path left at a surface.
    chosen : ndarray
        Indices in the launch of the paths that continue.
    probabilities : ndarray
        Survival probabilities with which they were chosen.
    """

    passed: np.ndarray
    redirected: np.ndarray
    chosen: np.ndarray
    probabilities: np.ndarray

    @classmethod
    def of(
        cls,
        steps: Sequence[Step],
        nominal: NominalPart,
        numbers: np.ndarray,
        learned: LearnedRoulette | None,
        again: bool,
    ) -> Departures:
        """Choose the paths that continue after an evaluated nominal part.

        Parameters
        ----------
        steps : Sequence[Step]
            Surfaces of the nominal path.
        nominal : NominalPart
            The paths at the point where they have left the nominal path.
        numbers : (N,) ndarray
            Numbers of the N paths in the run.
        learned : LearnedRoulette or None
            Russian roulette, None to follow all paths.
        again : bool
            The paths are traced again and known to survive.
        """
        passed, reason = nominal.passed.numpy(), nominal.reason.numpy()
        # at the end of a nominal part before the detector, no path has left at a surface
        redirected = (reason == REDIRECTED) & ((passed < len(steps)) | steps[-1].detects)
        goes_on, probabilities = reason != ENDED, np.ones(len(reason))
        if learned is not None:
            selected = np.flatnonzero(redirected)
            probabilities[selected] = learned.survival_probability(numbers[selected], passed[selected])
            if not again:
                goes_on[selected] = learned.survives(numbers[selected], probabilities[selected])
        left = np.flatnonzero(goes_on)
        # 16-bit keys are sorted by radix, without comparisons
        order = np.argsort((passed[left] * (REDIRECTED + 1) + reason[left]).astype(np.uint16), kind="stable")
        chosen = left[order]
        return cls(passed, redirected, chosen, probabilities[chosen])


def continue_paths(backend: Backend, steps: Sequence[Step], nominal: NominalPart, left: Departures) -> kernel.Launch:
    """Return the chosen paths at the point where they have left the nominal path."""
    import drjit as dr

    launch = nominal.launch
    Float, UInt = backend.Float, backend.UInt
    UInt64 = dr.uint64_array_t(Float)
    chosen = backend.opaque(left.chosen, UInt)
    place = dr.gather(UInt, nominal.passed, chosen)

    def by_place(kind: Any, values: Sequence[Any]) -> Any:
        return dr.gather(kind, backend.opaque(values, kind), place)

    codes = [step.code for step in steps]
    jumps = [_jump(draws) for draws in nominal.draws]
    factor, shift = (by_place(UInt64, [jump[k] for jump in jumps]) for k in range(2))
    rng = dr.gather(type(launch.rng), launch.rng, chosen)
    rng.state = rng.state * factor + rng.inc * shift
    return kernel.Launch(
        dr.gather(backend.Vector3, launch.position, chosen),
        dr.gather(backend.Vector3, launch.direction, chosen),
        dr.gather(Float, launch.weight, chosen) / backend.opaque(left.probabilities),
        dr.gather(UInt, launch.path, chosen),
        rng,
        dr.select(
            dr.gather(UInt, nominal.reason, chosen) == REDIRECTED, by_place(UInt, [*(s.segment for s in steps), 0]), 0
        ),
        dr.gather(Float, launch.length, chosen),
        by_place(UInt, [0, *(s.after for s in steps)]),
        by_place(Float, [0.0, *(s.clearance for s in steps)]),
        by_place(UInt64, [signature(codes[:k]) for k in range(len(steps) + 1)]),
        place,
    )
