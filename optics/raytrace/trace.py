"""Float64 sequential ray trace on Dr.Jit: positions, directions and optical path lengths through a batch of systems."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from threading import local
from typing import Any

import numpy as np

from optics.geometry.surface import SurfaceNumbers, along, level, newton_step
from optics.numerics.backend import Backend
from optics.numerics.invariants import PhysicalError
from optics.numerics.number_tree import map_leaves
from optics.raytrace.assembly import Interaction
from optics.raytrace.element_numbers import CoordinateNumbers, ElementNumbers, FrameNumbers, IndexNumbers, Structure
from optics.raytrace.graded_ray import GradedRay, meeting
from optics.raytrace.system import SystemBatch, UploadedSystems

NEWTON_STEPS = 3
"""Newton steps from the conic to the asphere. The departure of a mirror from its conic is below 1e-4 m and its slope
below 1e-3, so that each step gains at least six digits; three reach rounding. A ray that has not converged is marked
invalid."""

FURTHER_STEPS = 2
"""Additional Newton steps for a surface with further terms of its sag, and for an aspheric face of a lens, which may
depart by millimetres.
"""

SECTION = 6
"""Elements that one kernel traces where there are many rays, which pass through memory between kernels. The time to
compile it grows faster than its length."""

FEW = 1 << 16
"""Rays below which every element is a kernel of its own: so few stay in the processor's cache. Elements of one
structure then share a kernel wherever they stand in their sequences, and all kernels of the main job together take a
fifth of the time to compile."""

FEWEST_LANES = 32
"""Systems from which each lane of the processor traces one; of more than two threads each has to have half as many. Of
fewer systems a trace element by element takes up to half as much time again, and its kernels, which elements share,
are compiled already: those of lanes take seconds."""

FEWEST_IN_LANES = 1 << 15
"""Rays from which they do: fewer take some milliseconds in any way."""

MOST_RECORDINGS = 16
"""Of one trace in one thread: it is recorded anew where a bundle has other numbers in common, such as a direction."""

CONVERGED = 1e-12
"""Largest distance to the surface of a valid hit, metres."""


class BeamMissedError(PhysicalError, RuntimeError):
    """No ray of a bundle gets through a sequence."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in Dr.Jit arrays: positions and unit directions, optical path, and whether each is still alive.

    Attributes:
        position, direction, path, valid: of width systems * N; a direction that all rays share is of width 1.
        systems: number of systems that the rays are for, system by system; 1: every system gets all of them.
    """

    position: Any
    direction: Any
    path: Any
    valid: Any
    systems: int = 1


@dataclass(frozen=True, eq=False)
class Traced:
    """Rays at the last element of a sequence.

    Attributes:
        local: rays in the last element's own frame, after the interaction.
        world: the same rays in the world frame (position and direction), None unless asked for.
        hits: element index -> local position on that element, for those asked to be kept.
        count: B systems.
    """

    local: Rays
    world: Rays | None
    hits: Mapping[int, Any]
    count: int

    def numpy(self, rays: Rays | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position (B, N, 3), direction (B, N, 3), path (B, N), valid (B, N) of ``local`` (default) or ``world``."""
        rays = self.local if rays is None else rays
        return (
            rows(rays.position, self.count),
            rows(rays.direction, self.count),
            rays.path.numpy().reshape(self.count, -1),
            rays.valid.numpy().reshape(self.count, -1),
        )

    def hit(self, element: int) -> np.ndarray:
        """Local positions (B, N, 3) on an element that was kept, metres."""
        return rows(self.hits[element], self.count)

    def place(self, element: int | None = None) -> np.ndarray:
        """Local x, y (B, N, 2), metres, on the last element or on one that was kept."""
        vector = self.local.position if element is None else self.hits[element]
        return np.moveaxis(np.stack([c.numpy() for c in (vector.x, vector.y)]).reshape(2, self.count, -1), 0, -1)


def rows(vector: Any, count: int) -> np.ndarray:
    """Components of a ``Vector3`` of B * N rays as an array (B, N, 3); in memory one component after the other."""
    return np.moveaxis(np.stack([c.numpy() for c in vector]).reshape(3, count, -1), 0, -1)


def make_rays(backend: Backend, position: np.ndarray, direction: np.ndarray, path: np.ndarray | None = None) -> Rays:
    """Upload rays given by positions in metres and unit directions, broadcastable to each other.

    Shape (N, 3) or (3,) makes rays that every system gets; (B, N, 3) makes each of B systems its own. A direction (3,)
    is kept as one vector: a trace through conics is held up by the memory that it reads.

    Args:
        backend: where to.
        position: (3,), (N, 3) or (B, N, 3), metres.
        direction: unit vectors, likewise.
        path: optical path so far, metres, one for each ray; 0 by default.
    """
    import drjit as dr

    shared = np.ndim(direction) == 1
    position, direction = np.broadcast_arrays(np.asarray(position, np.float64), np.asarray(direction, np.float64))
    systems = position.shape[0] if position.ndim == 3 else 1
    n = position.size // 3
    start = dr.zeros(backend.Float, n) if path is None else backend.opaque(path)
    valid = dr.full(backend.Bool, True, n)
    if n < FEW:
        dr.make_opaque(start, valid)
    heading = backend.vector(direction.reshape(-1, 3)[:1] if shared else direction)
    return Rays(backend.vector(position), heading, start, valid, systems)


def trace(
    backend: Backend,
    systems: SystemBatch | UploadedSystems,
    rays: Rays,
    keep: Collection[int] = (),
    world: bool = False,
    evaluate: bool = True,
) -> Traced:
    """Send rays, given in the world frame, through each system.

    Args:
        backend: where to compute.
        systems: B systems.
        rays: for these systems, or rays that every system gets.
        keep: indices of elements whose hit points are wanted.
        world: also return the final rays in the world frame.
        evaluate: launch the kernel now (False leaves a graph to build on).

    Returns:
        The rays at the last element. Rays that miss a surface or an aperture, or are totally reflected at a refracting
        surface, are marked invalid; their numbers stay finite but mean nothing.

    Raises:
        ValueError: the rays are for another number of systems.
    """
    import drjit as dr

    uploaded = systems.upload(backend) if isinstance(systems, SystemBatch) else systems
    rays, shared = _spread(backend, rays, uploaded.count)
    differentiable = uploaded.differentiable or dr.grad_enabled(rays.position) or dr.grad_enabled(rays.direction)
    lanes = _lanes(uploaded, dr.width(rays.position)) if evaluate and not differentiable else None
    alone = lanes is None and not differentiable and dr.width(rays.position) < FEW
    section = 1 if alone else SECTION
    how = _Way(backend, uploaded.structure, tuple(sorted(keep)), world, differentiable, evaluate, section, alone)
    if alone and shared is not None:  # else the first element's kernel would be another one
        shared = dr.arange(backend.UInt, dr.width(rays.position)) // shared
        dr.eval(shared)
    stride = None if uploaded.count == 1 else dr.opaque(backend.UInt, uploaded.count)
    start = None if uploaded.first is None else dr.opaque(backend.UInt, uploaded.first * uploaded.count)
    through = _frozen(how, uploaded.form) if evaluate and not differentiable else partial(how.through, uploaded.form)
    (p, d, path, valid), hits, outside = through(
        (uploaded.numbers, uploaded.grids, stride, start, lanes),
        (rays.position, rays.direction, rays.path, rays.valid),
        shared,
    )
    local = Rays(p, d, path, valid, uploaded.count)
    seen = Rays(outside[0], outside[1], path, valid, uploaded.count) if world else None
    return Traced(local, seen, dict(zip(how.keep, hits, strict=True)), uploaded.count)


@dataclass(frozen=True)
class _Way:
    """What the instructions of a trace depend on; all else is numbers that they read.

    Attributes:
        backend: where to compute.
        structure: of the elements.
        keep: elements whose hit points are wanted, ascending.
        world: whether the final rays in the world frame are.
        differentiable: whether numbers or rays carry derivatives.
        evaluate: whether kernels are launched.
        section: elements of a kernel.
        alone: whether all elements of one structure share a kernel; ``section`` is 1.
    """

    backend: Backend
    structure: tuple[Structure, ...]
    keep: tuple[int, ...]
    world: bool
    differentiable: bool
    evaluate: bool
    section: int
    alone: bool

    def through(self, form: Any, numbers: Any, rays: Any, shared: Any) -> Any:
        """Rays after the last element, hit points, and the former in the world frame.

        Args:
            form: as of ``UploadedSystems``.
            numbers: likewise, the grids, how many systems there are, as an array of width 1 or None for one; where the
                numbers begin, likewise or None for the beginning; and the systems' own places, (B,), where each takes
                its rays one after the other, else None.
            rays: position, direction, path and whether they are alive.
            shared: rays of each system, as an array of width 1; the system of each ray where elements are ``alone``;
                None for a single system.
        """
        table, grids, stride, start, systems = numbers
        own = self._system(rays[0], shared) if systems is None else systems
        lookup = _Lookup(self.backend, table, stride, start, own, form[0][0].frame.x.shift)
        hits: list[Any] = []
        outside: list[Any] = []
        for first in range(0, len(self.structure), self.section):
            leg = range(first, min(first + self.section, len(self.structure)))
            last = leg.stop == len(self.structure)
            elements = [lookup(form[0][i]) for i in leg]
            pose = lookup(form[1]) if self.world and last else None
            if systems is not None:
                rays = self._one_by_one(leg, elements, pose, grids, rays, (systems, shared), hits, outside)
                continue
            rays = self._along(leg, elements, grids, rays, hits)
            if last:
                rays = self._at_end(rays, pose, outside)
            self._launch(leg, form, lookup, rays, hits, outside)
        return rays, hits, tuple(outside) if self.world else None

    def _system(self, position: Any, shared: Any) -> Any:
        """The system of each ray; None for a single system."""
        import drjit as dr

        return shared if shared is None or self.alone else dr.arange(self.backend.UInt, dr.width(position)) // shared

    def _launch(self, leg: range, form: Any, lookup: _Lookup, rays: Any, hits: list[Any], outside: list[Any]) -> None:
        """Launch the kernel of a leg, where kernels are launched at its end."""
        import drjit as dr

        last = leg.stop == len(self.structure)
        if self.alone or not (self.differentiable or last):
            lookup.go_on((form[1] if last else form[0][leg.stop].frame).x.shift)
            dr.eval(*rays, lookup.place)
        if last and self.evaluate:
            dr.eval(*rays, hits, outside)

    def _at_end(self, rays: Any, pose: FrameNumbers | None, outside: list[Any]) -> Any:
        """Rays at the last element; with its pose also, into ``outside``, in the world."""
        import drjit as dr

        p, d, path, valid = rays
        d = d + dr.zeros(self.backend.Float, dr.width(p))  # nothing may have turned a shared direction
        if pose is not None:
            to_world = pose.coordinates
            outside += [
                self.backend.Vector3(
                    *(c.turn[0] * p.x + c.turn[1] * p.y + c.turn[2] * p.z + c.shift for c in to_world)
                ),
                self.backend.Vector3(*(c.turn[0] * d.x + c.turn[1] * d.y + c.turn[2] * d.z for c in to_world)),
            ]
        return p, d, path, valid

    def _along(self, leg: range, elements: Sequence[ElementNumbers], grids: Any, rays: Any, hits: list[Any]) -> Any:
        """Rays after some elements, of each the hit points into ``hits`` where they are kept."""
        import drjit as dr

        backend, differentiable = self.backend, self.differentiable
        p, d, path, valid = rays
        for i, element in zip(leg, elements, strict=True):
            structure, table = self.structure[i], grids[i]
            surface = element.surface
            p, d = _into_frame(backend, p, d, element.frame)
            steps = _steps(surface, structure.interaction)
            t, ok = _distance(p, d, surface, table, differentiable, steps)
            if element.before.gradient is None:
                p = backend.Vector3(dr.fma(t, d.x, p.x), dr.fma(t, d.y, p.y), dr.fma(t, d.z, p.z))
                path = dr.fma(element.before.index, t, path)
            else:
                curve = GradedRay.start(p, d, element.before.index, element.before.gradient)
                tau = meeting(curve, t / curve.index, surface, table, differentiable, steps)
                p, d, path = curve.position(tau), curve.direction(tau), path + curve.optical_path(tau)
                ok = _reached(p, surface, table)
            valid = valid & ok
            if element.aperture is not None:
                valid = valid & element.aperture.contains(p.x, p.y)
            if structure.interaction is not Interaction.PASS:
                d, ok = _redirect(backend, p, d, element, structure.interaction, table)
                valid = valid & ok
            if i in self.keep:
                hits.append(p)
        return p, d, path, valid

    def _one_by_one(
        self,
        leg: range,
        elements: Sequence[ElementNumbers],
        pose: FrameNumbers | None,
        grids: Any,
        rays: Any,
        owned: tuple[Any, Any],
        hits: list[Any],
        outside: list[Any],
    ) -> Any:
        """A leg along which each lane of the processor takes all rays of one system, one after the other.

        It reads the system's numbers once. Where each lane has a ray of its own, it looks up all of them, which takes
        more time than the rays.

        Args:
            leg: of the elements.
            elements: their numbers, each (B,).
            pose: of the last element where rays in the world are wanted at its end, likewise.
            grids: as of ``through``.
            rays: likewise.
            owned: the systems' own places, and the rays of each.
            hits: to which hit points are added.
            outside: likewise rays in the world.
        """
        import drjit as dr

        systems, shared = owned
        first = systems * shared
        kept = sum(i in self.keep for i in leg)
        made = self._room(rays[0].x, 2 + kept + 2 * (pose is not None))

        def ray(place: Any) -> tuple[Any, ...]:
            at = first + place
            mine = tuple(array if dr.width(array) == 1 else dr.gather(type(array), array, at) for array in rays)
            own_hits: list[Any] = []
            own_outside: list[Any] = []
            end = self._along(leg, elements, grids, mine, own_hits)
            if leg.stop == len(self.structure):
                end = self._at_end(end, pose, own_outside)
            for target, value in zip(made, (*end, *own_hits, *own_outside), strict=True):
                dr.scatter(target, value, at)
            return (place + 1,)

        (ended,) = dr.while_loop(
            (dr.zeros(self.backend.UInt, dr.width(systems)),), lambda place: place < shared, ray, mode="symbolic"
        )
        dr.eval(made, ended)
        hits += made[4 : 4 + kept]
        outside += made[4 + kept :]
        return tuple(made[:4])

    def _room(self, like: Any, vectors: int) -> list[Any]:
        """Arrays of the size of another one, for position, direction, path and whether rays are alive, and further
        vectors, whatever that size was when this was recorded: their contents, which are written over, come from it.
        """
        import drjit as dr

        numbers = [like - float(k) for k in range(3 * vectors + 1)]
        room: list[Any] = [self.backend.Vector3(*numbers[3 * k : 3 * k + 3]) for k in range(vectors)]
        room[2:2] = [numbers[-1], like > 0.0]
        dr.eval(room)
        return room


_threads = local()


def _frozen(way: _Way, form: Any) -> Any:
    """The instructions of a trace, recorded when they run for the first time and launched without Python after that.

    A recording is of one thread.
    """
    import drjit as dr

    known = getattr(_threads, "known", None)
    if known is None:
        known = _threads.known = {}
    found = known.get(way)
    if found is None:
        recorded = partial(way.through, form)

        # what a frozen function closes over is compared at each call; a default is not
        @dr.freeze(limit=MOST_RECORDINGS, warn_after=10 * MOST_RECORDINGS)
        def through(numbers: Any, rays: Any, shared: Any, run: Any = recorded) -> Any:
            return run(numbers, rays, shared)

        found = known[way] = through
    return found


def require_some(valid: np.ndarray, what: str) -> None:
    """Raise BeamMissedError when some system of ``valid`` (B, N) has no valid ray at all."""
    alive = np.asarray(np.any(valid.reshape(len(valid), -1), axis=1))
    if not alive.all():
        raise BeamMissedError(
            f"no ray gets through {what} in {int((~alive).sum())} of {len(alive)} cases; the perturbation moves the "
            "beam off a mirror or an aperture"
        )


def _spread(backend: Backend, rays: Rays, count: int) -> tuple[Rays, Any]:
    """Bring rays to full width; how many each system has, as an array of width 1, or None for a single system."""
    import drjit as dr

    if count == 1:
        return rays, None
    width = dr.width(rays.position)
    if rays.systems not in (1, count):
        raise ValueError(f"rays for {rays.systems} systems cannot go through {count}")
    if rays.systems != 1:
        return rays, dr.opaque(backend.UInt, width // count)
    ray = dr.arange(backend.UInt, count * width) % dr.opaque(backend.UInt, width)
    rays = Rays(
        dr.gather(backend.Vector3, rays.position, ray),
        rays.direction if dr.width(rays.direction) == 1 else dr.gather(backend.Vector3, rays.direction, ray),
        dr.gather(backend.Float, rays.path, ray),
        dr.gather(backend.Bool, rays.valid, ray),
    )
    return rays, dr.opaque(backend.UInt, width)


def _lanes(systems: UploadedSystems, rays: int) -> Any:
    """The systems' own places, (B,), where systems and rays are enough to fill the lanes of all threads; else None."""
    import drjit as dr

    backend, threads = systems.backend, dr.thread_count()
    fewest = max(2, FEWEST_LANES * max(2, threads) // 2)
    if backend.name != "llvm" or systems.count < fewest or rays < FEWEST_IN_LANES:
        return None
    lanes = dr.arange(backend.UInt, systems.count)
    dr.make_opaque(lanes)
    return lanes


class _Lookup:
    """Numbers of each ray's or lane's system, element after element.

    The row at which they begin goes along with the rays from kernel to kernel. Were it written into a kernel, no two
    elements could share one.

    Args:
        backend: of the rays.
        numbers: as of ``UploadedSystems``.
        stride: how many systems there are, as an array of width 1; None for a single one.
        start: where the first element's numbers begin, likewise; None for the beginning.
        system: of each ray, or of each lane; None for a single one.
        row: at which the numbers of the first element begin.
    """

    def __init__(self, backend: Backend, numbers: Any, stride: Any, start: Any, system: Any, row: int) -> None:
        self._number, self._count = backend.Float, backend.UInt
        self._numbers, self._stride, self._system, self._row = numbers, stride, system, row
        self.place = None if isinstance(numbers, tuple) else system if start is None else system + start

    def __call__(self, form: Any) -> Any:
        """Numbers of a form with their rows."""
        import drjit as dr

        if self.place is not None:
            return map_leaves(lambda row: dr.gather(self._number, self._numbers, self._after(row)), form)
        if self._system is None:
            return map_leaves(lambda row: self._numbers[row], form)
        return map_leaves(lambda row: dr.gather(self._number, self._numbers[row], self._system), form)

    def go_on(self, row: int) -> None:
        """Let the numbers begin at another row."""
        if self.place is not None:
            self.place, self._row = self._after(row), row

    def _after(self, row: int) -> Any:
        return self.place + self._count(row - self._row) * self._stride


def _into_frame(backend: Backend, p: Any, d: Any, frame: FrameNumbers) -> tuple[Any, Any]:
    import drjit as dr

    def point(c: CoordinateNumbers) -> Any:
        return dr.fma(c.turn[0], p.x, dr.fma(c.turn[1], p.y, dr.fma(c.turn[2], p.z, c.shift)))

    def vector(c: CoordinateNumbers) -> Any:
        return dr.fma(c.turn[0], d.x, dr.fma(c.turn[1], d.y, c.turn[2] * d.z))

    return backend.Vector3(*map(point, frame.coordinates)), backend.Vector3(*map(vector, frame.coordinates))


def _distance(p: Any, d: Any, surface: SurfaceNumbers, table: Any, differentiable: bool, steps: int) -> tuple[Any, Any]:
    """Path from p along d to the surface (may be negative) and whether it exists."""
    import drjit as dr

    if surface.curvature is None:
        ok = dr.abs(d.z) > 1e-12
        t = -p.z / dr.select(ok, d.z, 1.0)
        if surface.is_conic:
            return t, ok
    else:
        c, q = surface.curvature, 1.0 + surface.conic
        a = c * dr.fma(d.x, d.x, dr.fma(d.y, d.y, q * d.z * d.z))
        b = c * dr.fma(p.x, d.x, dr.fma(p.y, d.y, q * p.z * d.z)) - d.z
        e = c * dr.fma(p.x, p.x, dr.fma(p.y, p.y, q * p.z * p.z)) - 2.0 * p.z
        discriminant = b * b - a * e
        ok = discriminant >= 0.0
        root = dr.sqrt(dr.select(ok, discriminant, 1.0))
        # of the two crossings the one on the vertex sheet: the denominator keeps d.z's sign and does not cancel, but
        # for rays that start beyond the centre, or near the other sheet of a hyperboloid; there the root's other form
        # does not
        turn = dr.copysign(root, d.z)
        near = b * turn > 0.0
        t = dr.select(near, -(b + turn) / dr.select(near, a, 1.0), e / dr.select(near, 1.0, turn - b))
        if surface.is_conic:
            return t, ok & (q * c * dr.fma(t, d.z, p.z) < 1.0)
    numbers = surface
    origin, direction = p, d
    if differentiable:
        # solve without derivatives; one attached step from the solution carries the exact derivative (implicit
        # functions)
        numbers = map_leaves(dr.detach, surface)
        origin, direction, t = dr.detach(p), dr.detach(d), dr.detach(t)
    for _ in range(steps):
        t = newton_step(origin, direction, t, numbers, table)
    if differentiable:
        t = newton_step(p, d, t, surface, table)
    return t, ok & _on_sheet(level(*along(origin, direction, t), numbers, table))


def _steps(surface: SurfaceNumbers, interaction: Interaction) -> int:
    """Newton steps from the conic to the surface."""
    lens = bool(surface.even) and interaction is Interaction.REFRACT
    return NEWTON_STEPS + (FURTHER_STEPS if surface.terms or lens else 0)


def _reached(p: Any, surface: SurfaceNumbers, table: Any) -> Any:
    """Whether p lies on the surface's sheet through the vertex."""
    return _on_sheet(level(p.x, p.y, p.z, surface, table))


def _on_sheet(found: tuple[Any, Any, Any, Any]) -> Any:
    """Whether a point with that level and gradient lies on the sheet: level / nz is its height to first order."""
    import drjit as dr

    value, _, _, nz = found
    return (nz > 0.0) & (dr.abs(value) < CONVERGED * nz)


def _redirect(
    backend: Backend, p: Any, d: Any, element: ElementNumbers, interaction: Interaction, table: Any
) -> tuple[Any, Any]:
    """Direction after reflection or refraction (Snell), and whether it exists."""
    import drjit as dr

    _, nx, ny, nz = level(p.x, p.y, p.z, element.surface, table)
    square = dr.fma(nx, nx, dr.fma(ny, ny, nz * nz))
    along = dr.fma(nx, d.x, dr.fma(ny, d.y, nz * d.z))
    before, after = _index_at(p, element.before), _index_at(p, element.after)
    if interaction in (Interaction.REFLECT, Interaction.TOTAL):
        beyond: Any = True
        if interaction is Interaction.TOTAL:
            beyond = before * before * (1.0 - along * along / square) > 1.0
        f = -2.0 * along / square
        return backend.Vector3(dr.fma(f, nx, d.x), dr.fma(f, ny, d.y), dr.fma(f, nz, d.z)), beyond
    if interaction is not Interaction.REFRACT:
        raise ValueError(f"the trace knows no interaction {interaction}")
    norm = dr.rsqrt(square)
    cosine = along * norm
    ratio = before / after
    sine2 = ratio * ratio * (1.0 - cosine * cosine)
    ok = sine2 <= 1.0
    cosine_after = dr.copysign(dr.sqrt(dr.select(ok, 1.0 - sine2, 0.0)), cosine)
    f = (cosine_after - ratio * cosine) * norm
    return backend.Vector3(dr.fma(f, nx, ratio * d.x), dr.fma(f, ny, ratio * d.y), dr.fma(f, nz, ratio * d.z)), ok


def _index_at(p: Any, medium: IndexNumbers) -> Any:
    """Refractive index at a point of the surface."""
    import drjit as dr

    if medium.gradient is None:
        return medium.index
    gx, gy, gz = medium.gradient
    return dr.fma(gx, p.x, dr.fma(gy, p.y, dr.fma(gz, p.z, medium.index)))
