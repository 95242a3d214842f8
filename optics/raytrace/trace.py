"""Float64 sequential ray trace on Dr.Jit, with derivatives: positions, directions and optical paths of batched systems.

Curved rays in an index gradient. With r the position on a ray, s the length along it, n the index and d tau = ds / n,
the ray equation d/ds (n dr/ds) = grad n becomes r'' = n grad n. For n = n0 + g . (r - r0), with n0 the index at the
origin r0 of the ray and g the gradient, the index along the ray obeys n'' = |g|^2 n. With d0 the unit direction at the
origin, T0 = n0 d0, a = g . T0 and x = |g| tau,

    n(tau) = n0 cosh x + a/|g| sinh x,

    r(tau) = r0 + T0 tau + g [n0 (cosh x - 1) / |g|^2 + a (sinh x / |g| - tau) / |g|^2],

and the optical path is the integral of n^2 d tau. The hyperbolic functions are evaluated by their power series, which
have no 0/0 at g = 0. (Born and Wolf, Principles of Optics, section 3.2, for the ray equation.)

Derivatives. ``jvp`` gives Jacobian-vector products (forward mode): all rays' derivatives with respect to one parameter.
``vjp`` gives vector-Jacobian products (reverse mode): one backward pass yields the derivative of a weighted sum of ray
coordinates with respect to every number of every system, however many there are.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from threading import local
from typing import Any

import numpy as np

from optics.geometry.sag_terms import check_height
from optics.geometry.surface import SurfaceNumbers, along, level, newton_step
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from optics.numerics.number_tree import Path, leaves, map_leaves
from optics.raytrace.assembly import Interaction
from optics.raytrace.element_numbers import CoordinateNumbers, ElementNumbers, FrameNumbers, IndexNumbers, Structure
from optics.raytrace.system import SystemBatch, UploadedSystems


@dataclass(frozen=True, eq=False)
class GradedRay:
    """Curved ray in an index gradient, as Dr.Jit arrays in the frame of the element that it goes to.

    Its parameter tau is the integral of ds / n along the ray, with s the length and n the index: metres.

    Attributes
    ----------
    origin : Vector3
        Origin, metres.
    tangent : Vector3
        Unit direction at the origin times ``index``.
    index : Float
        Refractive index at the origin.
    gradient : tuple of Float
        Components of the gradient of the index, 1/m.
    along : Float
        Scalar product of gradient and tangent, 1/m.
    square : Float
        Square of the gradient, 1/m^2.
    """

    origin: Any
    tangent: Any
    index: Any
    gradient: tuple[Any, Any, Any]
    along: Any
    square: Any

    @classmethod
    def start(cls, p: Any, d: Any, index_at_zero: Any, gradient: tuple[Any, Any, Any]) -> GradedRay:
        """Return the ray that starts at a point p (metres) along the unit vector d.

        The refractive index is ``index_at_zero`` at the origin of the frame plus the product of ``gradient`` (1/m) and
        position.
        """
        gx, gy, gz = gradient
        index = index_at_zero + gx * p.x + gy * p.y + gz * p.z
        tangent = index * d
        along = gx * tangent.x + gy * tangent.y + gz * tangent.z
        return cls(p, tangent, index, gradient, along, gx * gx + gy * gy + gz * gz)

    def position(self, tau: Any) -> Any:
        """Return the point of the ray at the parameter ``tau``, the integral of length over index, in metres."""
        x2 = self.square * tau * tau
        even = 0.5 * tau * tau * (1.0 + x2 / 12.0 * (1.0 + x2 / 30.0))
        odd = tau * tau * tau / 6.0 * (1.0 + x2 / 20.0 * (1.0 + x2 / 42.0))
        return self._add(self.origin + self.tangent * tau, self.index * even + self.along * odd)

    def slope(self, tau: Any) -> Any:
        """Return the derivative of the position with respect to ``tau``: the index times the unit direction."""
        x2 = self.square * tau * tau
        odd = tau * (1.0 + x2 / 6.0 * (1.0 + x2 / 20.0))
        even = 0.5 * tau * tau * (1.0 + x2 / 12.0 * (1.0 + x2 / 30.0))
        return self._add(self.tangent, self.index * odd + self.along * even)

    def direction(self, tau: Any) -> Any:
        """Return the unit direction of the ray at the parameter ``tau``, the integral of length over index."""
        import drjit as dr

        return dr.normalize(self.slope(tau))

    def optical_path(self, tau: Any) -> Any:
        """Return the optical path from the origin to the parameter ``tau``, in metres.

        It is the integral of the index over the length.
        """
        y = 4.0 * self.square * tau * tau
        first = tau * (1.0 + y / 12.0 * (1.0 + y / 20.0 * (1.0 + y / 42.0)))
        second = tau * tau * (1.0 + y / 12.0 * (1.0 + y / 30.0))
        third = tau * tau * tau / 3.0 * (1.0 + y / 20.0 * (1.0 + y / 42.0))
        n, a = self.index, self.along
        return n * n * first + a * n * second + a * a * third

    def _add(self, vector: Any, amount: Any) -> Any:
        """Return a vector plus ``amount`` times the gradient of the refractive index."""
        gx, gy, gz = self.gradient
        return type(vector)(vector.x + amount * gx, vector.y + amount * gy, vector.z + amount * gz)


def curve_intersection(
    curve: GradedRay, tau: Any, surface: SurfaceNumbers, table: Any, attached: bool, steps: int
) -> Any:
    """Return the parameter ``tau`` at which a curved ray intersects a surface, by Newton's method.

    ``tau`` starts from its value for the straight ray.
    """
    import drjit as dr

    def step(ray: GradedRay, tau: Any, numbers: SurfaceNumbers) -> Any:
        p, slope = ray.position(tau), ray.slope(tau)
        value, nx, ny, nz = level(p.x, p.y, p.z, numbers, table)
        return tau - value / dr.fma(nx, slope.x, dr.fma(ny, slope.y, nz * slope.z))

    numbers, ray = surface, curve
    if attached:
        numbers = map_leaves(dr.detach, surface)
        ray, tau = dr.detach((curve, tau))
    for _ in range(steps):
        tau = step(ray, tau, numbers)
    return step(curve, tau, surface) if attached else tau


NEWTON_STEPS = 3
"""Number of Newton steps from a ray's intersection with the conic to that with the aspheric surface.

The departure of a mirror from its conic is below 1e-4 m and its slope below 1e-3, so that each step gains at least six
digits; three reach rounding. A ray that has not converged is marked invalid.
"""

FURTHER_STEPS = 2
"""Additional Newton steps for a surface with further sag terms, and for an aspheric face of a lens.

Their departures from the conic may be millimetres.
"""

KERNEL_ELEMENTS = 6
"""Number of elements that one kernel traces where there are many rays, which pass through memory between kernels.

The time to compile a kernel grows faster than its length.
"""

CACHED_RAYS = 1 << 16
"""Number of rays below which every element is a kernel of its own: so few stay in the processor's cache.

Elements of one structure then share a kernel wherever they are in their sequences, and all kernels of the main job
together take a fifth of the time to compile.
"""

MIN_LANE_SYSTEMS = 32
"""Smallest number of systems per two threads for which each SIMD lane of the processor traces all rays of one system.

With fewer systems an element-by-element trace takes up to half as much time again, but its kernels, which elements
share, are compiled already: those of lanes take seconds.
"""

MIN_LANE_RAYS = 1 << 15
"""Smallest number of rays for which each SIMD lane traces one system: fewer take some milliseconds either way."""

MAX_RECORDINGS = 16
"""Largest number of recordings (sequences of instructions kept for replay) of one kind of trace in one thread.

A new one is needed when other arrays of the rays have width 1, such as a direction that all rays share.
"""

CONVERGED = 1e-12
"""Largest distance of a ray's end from the surface, metres, at which its intersection counts as valid."""


class BeamMissedError(PhysicalError, RuntimeError):
    """Error: no ray of a beam passes through a sequence of elements."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in Dr.Jit arrays: positions and unit directions, optical path, and whether each is still valid.

    Attributes
    ----------
    position, direction, path, valid : Dr.Jit arrays
        Arrays of width systems * N for N rays each, lengths in metres; a direction that all rays share has width 1.
    systems : int
        Number of systems that the rays belong to; the arrays hold the rays of one system after the other. With 1, every
        system gets all rays.
    """

    position: Any
    direction: Any
    path: Any
    valid: Any
    systems: int = 1


@dataclass(frozen=True, eq=False)
class Traced:
    """Rays of B systems at the last element of a sequence.

    Attributes
    ----------
    local : Rays
        Rays in the last element's own frame, after the interaction.
    world : Rays, optional
        The same rays in the world frame (position and direction); None unless requested.
    hits : mapping of int to Vector3
        Element index -> local intersection with that element, for those requested.
    count : int
        Number of systems B.
    """

    local: Rays
    world: Rays | None
    hits: Mapping[int, Any]
    count: int

    def numpy(self, rays: Rays | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return position (B, N, 3), direction (B, N, 3), path (B, N) and valid (B, N) of N rays in B systems.

        They are NumPy arrays, in metres, of ``rays``, by default ``local``.
        """
        rays = self.local if rays is None else rays
        return (
            rows(rays.position, self.count),
            rows(rays.direction, self.count),
            rays.path.numpy().reshape(self.count, -1),
            rays.valid.numpy().reshape(self.count, -1),
        )

    def hit(self, element: int) -> np.ndarray:
        """Return the intersections (B, N, 3) of N rays in B systems with a requested element, in its frame, metres."""
        return rows(self.hits[element], self.count)

    def xy(self, element: int | None = None) -> np.ndarray:
        """Return x, y (B, N, 2) of N rays in B systems, metres, on the last element or on a requested one.

        They are in the element's own frame.
        """
        vector = self.local.position if element is None else self.hits[element]
        return np.moveaxis(np.stack([c.numpy() for c in (vector.x, vector.y)]).reshape(2, self.count, -1), 0, -1)


def rows(vector: Any, count: int) -> np.ndarray:
    """Return the components of N rays' vectors in each of B systems (a ``Vector3``) as an array (B, N, 3).

    The array is stored component by component.
    """
    return np.moveaxis(np.stack([c.numpy() for c in vector]).reshape(3, count, -1), 0, -1)


def make_rays(backend: Backend, position: np.ndarray, direction: np.ndarray, path: np.ndarray | None = None) -> Rays:
    """Upload rays given by positions in metres and unit directions, broadcastable to each other.

    Shape (N, 3), or (3,) for one ray, makes N rays that every system gets; (B, N, 3) makes each of B systems its own. A
    direction (3,) is kept as one vector: a trace through conics is limited by the memory that it reads.

    Parameters
    ----------
    backend : Backend
        Backend to upload to.
    position : (3,), (N, 3) or (B, N, 3) ndarray
        Positions, metres.
    direction : (3,), (N, 3) or (B, N, 3) ndarray
        Unit directions.
    path : ndarray, optional
        Optical path so far of each ray, metres; 0 by default.
    """
    import drjit as dr

    shared = np.ndim(direction) == 1
    position, direction = np.broadcast_arrays(np.asarray(position, np.float64), np.asarray(direction, np.float64))
    systems = position.shape[0] if position.ndim == 3 else 1
    n = position.size // 3
    start = dr.zeros(backend.Float, n) if path is None else backend.opaque(path)
    valid = dr.full(backend.Bool, True, n)
    if n < CACHED_RAYS:
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
    """Trace rays, given in the world frame, through each system.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    systems : SystemBatch or UploadedSystems
        B systems.
    rays : Rays
        Rays for these systems, or rays that every system gets.
    keep : collection of int
        Indices of elements whose intersections are requested.
    world : bool
        True to return the final rays in the world frame, too.
    evaluate : bool
        True to launch the kernel now; False leaves a graph to build on.

    Returns
    -------
    Traced
        Rays at the last element. Rays that miss a surface or an aperture, or are totally reflected at a refracting
        surface, are marked invalid; their numbers stay finite but are meaningless.

    Raises
    ------
    ValueError
        The rays are for another number of systems, or there are none.
    EntryPointError
        A sag term of another distribution cannot become part of a kernel.
    """
    import drjit as dr

    if not dr.width(rays.position):
        raise ValueError("there are no rays to trace: at least one position and direction are needed")
    uploaded = systems.upload(backend) if isinstance(systems, SystemBatch) else systems
    for kind in {kind for element in uploaded.structure for kind in element.terms}:
        check_height(kind, backend)
    rays, shared = _full_width(backend, rays, uploaded.count)
    differentiable = uploaded.differentiable or dr.grad_enabled(rays.position) or dr.grad_enabled(rays.direction)
    lanes = _lanes(uploaded, dr.width(rays.position)) if evaluate and not differentiable else None
    alone = lanes is None and not differentiable and dr.width(rays.position) < CACHED_RAYS
    section = 1 if alone else KERNEL_ELEMENTS
    plan = _TracePlan(backend, uploaded.structure, tuple(sorted(keep)), world, differentiable, evaluate, section, alone)
    if alone and shared is not None:  # so that all elements share one kernel
        shared = dr.arange(backend.UInt, dr.width(rays.position)) // shared
        dr.eval(shared)
    stride = None if uploaded.count == 1 else dr.opaque(backend.UInt, uploaded.count)
    start = None if uploaded.first is None else dr.opaque(backend.UInt, uploaded.first * uploaded.count)
    through = (
        _recorded(plan, uploaded.form) if evaluate and not differentiable else partial(plan.through, uploaded.form)
    )
    (p, d, path, valid), hits, outside = through(
        (uploaded.numbers, uploaded.grids, stride, start, lanes),
        (rays.position, rays.direction, rays.path, rays.valid),
        shared,
    )
    local = Rays(p, d, path, valid, uploaded.count)
    outside_rays = Rays(outside[0], outside[1], path, valid, uploaded.count) if world else None
    return Traced(local, outside_rays, dict(zip(plan.keep, hits, strict=True)), uploaded.count)


@dataclass(frozen=True)
class _TracePlan:
    """Properties of a trace that determine its instructions; all others are numbers that the instructions read.

    Attributes
    ----------
    backend : Backend
        Backend of the trace.
    structure : tuple of Structure
        Structure of each element.
    keep : tuple of int
        Elements whose intersections are requested, ascending.
    world : bool
        True when the final rays are requested in the world frame, too.
    differentiable : bool
        True when numbers or rays carry derivatives.
    evaluate : bool
        True when kernels are launched; False when only their graph is built.
    section : int
        Number of elements that one kernel traces.
    alone : bool
        True when each element is a kernel of its own, shared by all elements of its structure; ``section`` is then 1.
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
        """Return the rays after the last element, the requested intersections, and the rays in the world frame.

        Parameters
        ----------
        form : tuple
            For each element, its numbers, each replaced by its row in the table of numbers.
        numbers : tuple
            Table of numbers; spline coefficients of grid figures; number of systems, as an array of width 1, or None
            for one; position of the first element's numbers in the table, likewise, or None for 0; and the indices of
            the B systems (B,) if the rays of each are traced one after the other, else None.
        rays : tuple
            Position, direction, path and validity.
        shared : UInt
            Number of rays of each system, as an array of width 1; the system of each ray where elements are ``alone``;
            None for a single system.
        """
        table, grids, stride, start, systems = numbers
        system = self._system(rays[0], shared) if systems is None else systems
        lookup = _Lookup(self.backend, table, stride, start, system, form[0][0].frame.x.shift)
        hits: list[Any] = []
        outside: list[Any] = []
        for first in range(0, len(self.structure), self.section):
            leg = range(first, min(first + self.section, len(self.structure)))
            last = leg.stop == len(self.structure)
            elements = [lookup(form[0][i]) for i in leg]
            pose = lookup(form[1]) if self.world and last else None
            if systems is not None:
                rays = self._along_in_lanes(leg, elements, pose, grids, rays, (systems, shared), hits, outside)
                continue
            rays = self._along(leg, elements, grids, rays, hits)
            if last:
                rays = self._at_end(rays, pose, outside)
            self._launch(leg, form, lookup, rays, hits, outside)
        return rays, hits, tuple(outside) if self.world else None

    def _system(self, position: Any, shared: Any) -> Any:
        """Return the index of the system that each ray belongs to; None for a single system."""
        import drjit as dr

        return shared if shared is None or self.alone else dr.arange(self.backend.UInt, dr.width(position)) // shared

    def _launch(self, leg: range, form: Any, lookup: _Lookup, rays: Any, hits: list[Any], outside: list[Any]) -> None:
        """Launch the kernel that traces a range ``leg`` of elements, if the plan launches kernels (``evaluate``)."""
        import drjit as dr

        last = leg.stop == len(self.structure)
        if self.alone or not (self.differentiable or last):
            lookup.advance((form[1] if last else form[0][leg.stop].frame).x.shift)
            dr.eval(*rays, lookup.index)
        if last and self.evaluate:
            dr.eval(*rays, hits, outside)

    def _at_end(self, rays: Any, pose: FrameNumbers | None, outside: list[Any]) -> Any:
        """Return the rays at the last element; with its pose, also append them in the world frame to ``outside``."""
        import drjit as dr

        p, d, path, valid = rays
        d = d + dr.zeros(self.backend.Float, dr.width(p))  # gives a shared direction full width
        if pose is not None:
            to_world = pose.coordinates
            outside += [
                self.backend.Vector3(*(c.row[0] * p.x + c.row[1] * p.y + c.row[2] * p.z + c.shift for c in to_world)),
                self.backend.Vector3(*(c.row[0] * d.x + c.row[1] * d.y + c.row[2] * d.z for c in to_world)),
            ]
        return p, d, path, valid

    def _along(self, leg: range, elements: Sequence[ElementNumbers], grids: Any, rays: Any, hits: list[Any]) -> Any:
        """Return the rays after the elements of the range ``leg``, and append requested intersections to ``hits``."""
        import drjit as dr

        backend, differentiable = self.backend, self.differentiable
        p, d, path, valid = rays
        for i, element in zip(leg, elements, strict=True):
            structure, table = self.structure[i], grids[i]
            surface = element.surface
            p, d = _to_frame(backend, p, d, element.frame)
            steps = _steps(surface, structure.interaction)
            t, ok = _distance(p, d, surface, table, differentiable, steps)
            if element.before.gradient is None:
                p = backend.Vector3(dr.fma(t, d.x, p.x), dr.fma(t, d.y, p.y), dr.fma(t, d.z, p.z))
                path = dr.fma(element.before.index, t, path)
            else:
                curve = GradedRay.start(p, d, element.before.index, element.before.gradient)
                tau = curve_intersection(curve, t / curve.index, surface, table, differentiable, steps)
                p, d, path = curve.position(tau), curve.direction(tau), path + curve.optical_path(tau)
                ok = _on_surface(p, surface, table)
            valid = valid & ok
            if element.aperture is not None:
                valid = valid & element.aperture.contains(p.x, p.y)
            if structure.interaction is not Interaction.PASS:
                d, ok = _redirect(backend, p, d, element, structure.interaction, table)
                valid = valid & ok
            if i in self.keep:
                hits.append(p)
        return p, d, path, valid

    def _along_in_lanes(
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
        """Trace rays along some elements such that each SIMD lane takes all rays of one system, one after the other.

        A lane reads its system's numbers once. Where each lane has a ray of its own, it looks up all of them, which
        takes more time than the rays.

        Parameters
        ----------
        leg : range
            Indices of the elements.
        elements : sequence of ElementNumbers
            Numbers of the elements, one value for each of B systems, (B,).
        pose : FrameNumbers, optional
            Pose of the last element, where rays in the world frame are requested at its end.
        grids : tuple
            Spline tables of grid figures, per element.
        rays : tuple
            Position, direction, path and validity.
        owned : tuple
            Indices of the systems, and the number of rays of each.
        hits : list
            List to which intersections are appended.
        outside : list
            List to which rays in the world frame are appended.
        """
        import drjit as dr

        systems, shared = owned
        first = systems * shared
        kept = sum(i in self.keep for i in leg)
        arrays = self._allocated(rays[0].x, 2 + kept + 2 * (pose is not None))

        def ray(lane: Any) -> tuple[Any, ...]:
            index = first + lane
            mine = tuple(array if dr.width(array) == 1 else dr.gather(type(array), array, index) for array in rays)
            ray_hits: list[Any] = []
            ray_outside: list[Any] = []
            end = self._along(leg, elements, grids, mine, ray_hits)
            if leg.stop == len(self.structure):
                end = self._at_end(end, pose, ray_outside)
            for target, value in zip(arrays, (*end, *ray_hits, *ray_outside), strict=True):
                dr.scatter(target, value, index)
            return (lane + 1,)

        (ended,) = dr.while_loop(
            (dr.zeros(self.backend.UInt, dr.width(systems)),), lambda lane: lane < shared, ray, mode="symbolic"
        )
        dr.eval(arrays, ended)
        hits += arrays[4 : 4 + kept]
        outside += arrays[4 + kept :]
        return tuple(arrays[:4])

    def _allocated(self, like: Any, vectors: int) -> list[Any]:
        """Return arrays of the size of ``like`` for position, direction, path, validity and further vectors.

        Their contents, which are overwritten, are computed from ``like``, so that their size follows it in every replay
        of the recording.
        """
        import drjit as dr

        numbers = [like - float(k) for k in range(3 * vectors + 1)]
        room: list[Any] = [self.backend.Vector3(*numbers[3 * k : 3 * k + 3]) for k in range(vectors)]
        room[2:2] = [numbers[-1], like > 0.0]
        dr.eval(room)
        return room


_threads = local()


def _recorded(plan: _TracePlan, form: Any) -> Any:
    """Return the function that traces by a plan; it is recorded when it first runs, and then replayed without Python.

    A recording belongs to one thread.
    """
    import drjit as dr

    recordings = getattr(_threads, "known", None)
    if recordings is None:
        recordings = _threads.known = {}
    function = recordings.get(plan)
    if function is None:
        recorded = partial(plan.through, form)

        # variables in a closure are compared at each call of a frozen function, default arguments are not
        @dr.freeze(limit=MAX_RECORDINGS, warn_after=10 * MAX_RECORDINGS)
        def through(numbers: Any, rays: Any, shared: Any, run: Any = recorded) -> Any:
            return run(numbers, rays, shared)

        function = recordings[plan] = _without_collection(through)
    return function


def _without_collection(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls another one while Python does not collect cyclic garbage.

    Garbage may hold arrays with NumPy's memory. Dr.Jit cannot record that such memory is freed: it throws an exception
    in a destructor, which ends the process.
    """

    def call(*arguments: Any) -> Any:
        collecting = gc.isenabled()
        gc.disable()
        try:
            return function(*arguments)
        finally:
            if collecting:
                gc.enable()

    return call


def require_rays(valid: np.ndarray, name: str) -> None:
    """Raise BeamMissedError when one of B systems has no valid ray.

    ``valid`` (B, N) is the mask of N rays each, and ``name`` is what the error calls the beam.
    """
    alive = np.asarray(np.any(valid.reshape(len(valid), -1), axis=1))
    if not alive.all():
        raise BeamMissedError(
            f"no ray passes through {name} in {int((~alive).sum())} of {len(alive)} cases; the perturbation moves the "
            "beam off a mirror or an aperture"
        )


def _full_width(backend: Backend, rays: Rays, count: int) -> tuple[Rays, Any]:
    """Return the rays repeated for ``count`` systems, and the number of rays per system as an array of width 1.

    The number is None for a single system.
    """
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
    """Return the indices of B systems, (B,), if each SIMD lane is to trace all rays of one system; else None."""
    import drjit as dr

    backend, threads = systems.backend, dr.thread_count()
    fewest = max(2, MIN_LANE_SYSTEMS * max(2, threads) // 2)
    if backend.name != "llvm" or systems.count < fewest or rays < MIN_LANE_RAYS:
        return None
    lanes = dr.arange(backend.UInt, systems.count)
    dr.make_opaque(lanes)
    return lanes


class _Lookup:
    """Lookup of the numbers of each ray's or lane's system, element after element.

    The numbers form a table with a row for each number and a column for each system. The row at which they begin is
    passed along with the rays from kernel to kernel. If it were written into a kernel, no two elements could share one.

    Parameters
    ----------
    backend : Backend
        Backend of the rays.
    numbers : Dr.Jit arrays
        Numbers of all systems, one array per row or all rows in one array, as in ``UploadedSystems.numbers``.
    stride : UInt, optional
        Number of systems, as an array of width 1; None for a single one.
    start : UInt, optional
        Position of the first element's numbers in the table, as an array of width 1; None for 0.
    system : UInt, optional
        System of each ray or lane; None for a single one.
    row : int
        Row at which the numbers of the first element begin.
    """

    def __init__(self, backend: Backend, numbers: Any, stride: Any, start: Any, system: Any, row: int) -> None:
        self._number, self._count = backend.Float, backend.UInt
        self._numbers, self._stride, self._system, self._row = numbers, stride, system, row
        self.index = None if isinstance(numbers, tuple) else system if start is None else system + start

    def __call__(self, form: Any) -> Any:
        """Return the numbers whose rows in the table are given by ``form``, for each ray or lane."""
        import drjit as dr

        if self.index is not None:
            return map_leaves(lambda row: dr.gather(self._number, self._numbers, self._after(row)), form)
        if self._system is None:
            return map_leaves(lambda row: self._numbers[row], form)
        return map_leaves(lambda row: dr.gather(self._number, self._numbers[row], self._system), form)

    def advance(self, row: int) -> None:
        """Set the row of the table at which the numbers of the next element begin."""
        if self.index is not None:
            self.index, self._row = self._after(row), row

    def _after(self, row: int) -> Any:
        """Return the position in memory of a row's number, for each ray or lane."""
        return self.index + self._count(row - self._row) * self._stride


def _to_frame(backend: Backend, p: Any, d: Any, frame: FrameNumbers) -> tuple[Any, Any]:
    """Return positions p (metres) and unit directions d transformed into an element's frame."""
    import drjit as dr

    def point(c: CoordinateNumbers) -> Any:
        return dr.fma(c.row[0], p.x, dr.fma(c.row[1], p.y, dr.fma(c.row[2], p.z, c.shift)))

    def vector(c: CoordinateNumbers) -> Any:
        return dr.fma(c.row[0], d.x, dr.fma(c.row[1], d.y, c.row[2] * d.z))

    return backend.Vector3(*map(point, frame.coordinates)), backend.Vector3(*map(vector, frame.coordinates))


def _distance(p: Any, d: Any, surface: SurfaceNumbers, table: Any, differentiable: bool, steps: int) -> tuple[Any, Any]:
    """Return the distance from p along d to the surface, metres (may be negative), and whether they intersect."""
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
        # of the two intersections, take the one on the vertex sheet. The denominator keeps d.z's sign and does not
        # cancel, except for rays that start beyond the centre, or near the other sheet of a hyperboloid; the other
        # form of the root does not cancel there.
        signed_root = dr.copysign(root, d.z)
        near = b * signed_root > 0.0
        t = dr.select(near, -(b + signed_root) / dr.select(near, a, 1.0), e / dr.select(near, 1.0, signed_root - b))
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
    """Return the number of Newton steps from the intersection with the conic to that with the surface."""
    lens = bool(surface.even) and interaction is Interaction.REFRACT
    return NEWTON_STEPS + (FURTHER_STEPS if surface.terms or lens else 0)


def _on_surface(p: Any, surface: SurfaceNumbers, table: Any) -> Any:
    """Return whether points p lie on the surface, on the sheet of the conic that goes through the vertex."""
    return _on_sheet(level(p.x, p.y, p.z, surface, table))


def _on_sheet(level_and_gradient: tuple[Any, Any, Any, Any]) -> Any:
    """Return whether a point lies on the surface's sheet through the vertex, from its level function and gradient.

    The level divided by the gradient's z component is the point's height above the surface to first order.
    """
    import drjit as dr

    value, _, _, nz = level_and_gradient
    return (nz > 0.0) & (dr.abs(value) < CONVERGED * nz)


def _redirect(
    backend: Backend, p: Any, d: Any, element: ElementNumbers, interaction: Interaction, table: Any
) -> tuple[Any, Any]:
    """Return the direction of rays after reflection or refraction (Snell's law), and whether it exists.

    It does not exist for light that is totally reflected where it should be refracted, or the reverse.
    """
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
        raise ValueError(f"the trace does not support the interaction {interaction}")
    norm = dr.rsqrt(square)
    cosine = along * norm
    ratio = before / after
    sine2 = ratio * ratio * (1.0 - cosine * cosine)
    ok = sine2 <= 1.0
    cosine_after = dr.copysign(dr.sqrt(dr.select(ok, 1.0 - sine2, 0.0)), cosine)
    f = (cosine_after - ratio * cosine) * norm
    return backend.Vector3(dr.fma(f, nx, ratio * d.x), dr.fma(f, ny, ratio * d.y), dr.fma(f, nz, ratio * d.z)), ok


def _index_at(p: Any, medium: IndexNumbers) -> Any:
    """Return the refractive index at a point of the surface."""
    import drjit as dr

    if medium.gradient is None:
        return medium.index
    gx, gy, gz = medium.gradient
    return dr.fma(gx, p.x, dr.fma(gy, p.y, dr.fma(gz, p.z, medium.index)))


DIFFERENTIATED = 1
"""Number of elements that one kernel differentiates in forward mode.

Its code is several times that of a trace, and the time to compile it grows faster than its length: with six elements in
one, the kernels of the main job take twice as long to compile as one by one, and those of derivatives no less to run.
"""


@dataclass(frozen=True, eq=False)
class RayTangents:
    """Derivatives with respect to one parameter of N rays in B systems at the last element, in its own frame.

    Attributes
    ----------
    position, direction : (B, N, 3) ndarray
        Derivatives, in metres and 1 per unit of the parameter.
    path : (B, N) ndarray
        Derivative of the optical path, metres per unit of the parameter.
    hits : mapping of int to ndarray
        Element index -> derivative of the local intersection, (B, N, 3), for those requested.
    traced : Traced
        The rays themselves.
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    hits: Mapping[int, np.ndarray]
    traced: Traced


def jvp(
    backend: Backend,
    systems: SystemBatch,
    position: np.ndarray,
    direction: np.ndarray,
    position_step: np.ndarray | float = 0.0,
    direction_step: np.ndarray | float = 0.0,
    keep: Collection[int] = (),
) -> RayTangents:
    """Trace rays and differentiate each with respect to one parameter (forward mode).

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    systems : SystemBatch
        B systems; derivatives that they carry (``assemble(..., step=...)``) are added.
    position : (B, N, 3) ndarray
        Launch points of N rays per system in the world frame, metres.
    direction : (B, N, 3) ndarray
        Unit directions in the world frame.
    position_step : ndarray or float
        Derivative of the launch points, broadcastable to (B, N, 3).
    direction_step : ndarray or float
        Derivative of the directions, perpendicular to them, broadcastable to (B, N, 3).
    keep : collection of int
        Indices of elements whose intersections are differentiated, too.
    """
    import drjit as dr

    uploaded = systems.upload(backend)
    rays = make_rays(backend, position, direction)
    steps = [
        backend.vector(np.broadcast_to(s, direction.shape).reshape(-1, 3)) for s in (position_step, direction_step)
    ]
    path_step = dr.zeros(backend.Float, dr.width(rays.position))
    dr.make_opaque(path_step, rays.path, rays.valid)  # so that the first element shares the kernel of the others
    hits: dict[int, Any] = {}
    slopes: dict[int, Any] = {}
    for first in range(0, len(uploaded.structure), DIFFERENTIATED):
        last = min(first + DIFFERENTIATED, len(uploaded.structure))
        dr.enable_grad(rays.position, rays.direction)
        dr.set_grad(rays.position, steps[0])
        dr.set_grad(rays.direction, steps[1])
        dr.enable_grad(rays.path)
        dr.set_grad(rays.path, path_step)
        requested = [i - first for i in keep if first <= i < last]
        traced = trace(backend, uploaded.section(first, last), rays, keep=requested, evaluate=False)
        local = traced.local
        intersections = list(traced.hits.values())
        # interior gradients are kept: an intermediate intersection is an input of the final rays
        dr.forward_to(local.position, local.direction, local.path, intersections, flags=dr.ADFlag.ClearEdges)
        steps, path_step = [dr.grad(local.position), dr.grad(local.direction)], dr.grad(local.path)
        gradients = [dr.grad(vector) for vector in intersections]
        # one launch for all: each array evaluated by itself would trace everything again in a kernel of its own
        dr.eval(steps, path_step, gradients, local.position, local.direction, local.path, local.valid, intersections)
        hits.update({first + i: dr.detach(vector) for i, vector in traced.hits.items()})
        slopes.update({first + i: slope for i, slope in zip(traced.hits, gradients, strict=True)})
        end, heading, path = (dr.detach(array) for array in (local.position, local.direction, local.path))
        rays = Rays(end, heading, path, local.valid, systems.count)
    return RayTangents(
        rows(steps[0], systems.count),
        rows(steps[1], systems.count),
        path_step.numpy().reshape(systems.count, -1),
        {i: rows(slope, systems.count) for i, slope in slopes.items()},
        Traced(rays, None, hits, systems.count),
    )


@dataclass(frozen=True, eq=False)
class RayCotangents:
    """Derivatives of a weighted sum of ray positions at the last element, one sum for each of B systems.

    The sum of a system is over its N rays, each position times its weight vector.

    Attributes
    ----------
    values : tuple of mapping of Path to ndarray
        Per element, path of a number -> derivative of each system's sum with respect to that number of the system,
        (B,), for those requested.
    position : (B, N, 3) ndarray
        Derivative with respect to the launch point, per metre.
    direction : (B, N, 3) ndarray
        Derivative with respect to the launch direction; its component along the ray is meaningless by itself.
    """

    values: tuple[Mapping[Path, np.ndarray], ...]
    position: np.ndarray
    direction: np.ndarray


def vjp(
    backend: Backend,
    systems: SystemBatch,
    position: np.ndarray,
    direction: np.ndarray,
    weight: np.ndarray,
    names: Sequence[Collection[Path]],
) -> RayCotangents:
    """Trace rays and differentiate a weighted sum of their final positions with respect to all inputs (reverse mode).

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    systems : SystemBatch
        B systems; derivatives that they carry are ignored.
    position : (B, N, 3) ndarray
        Launch points of N rays per system in the world frame, metres.
    direction : (B, N, 3) ndarray
        Unit directions in the world frame.
    weight : ndarray
        Weights of the positions at the last element, in its own frame, broadcastable to (B, N, 3).
    names : sequence of collection of Path
        Per element, paths of the numbers in ``systems.values`` with respect to which the sum is differentiated.

    Returns
    -------
    RayCotangents
        Derivatives; rays that are blocked or lost count as if they continued.
    """
    import drjit as dr

    plain = replace(systems, tangents=None, world_tangents=None)
    uploaded = replace(plain.upload(backend, separate=True), differentiable=True)
    wanted = [leaves(numbers)[path] for numbers, paths in zip(uploaded.values, names, strict=True) for path in paths]
    rays = make_rays(backend, position, direction)
    for variable in (*wanted, rays.position, rays.direction):
        dr.enable_grad(variable)
    end = trace(backend, uploaded, rays, evaluate=False).local.position
    dr.set_grad(end, backend.vector(np.broadcast_to(weight, direction.shape).reshape(-1, 3)))
    dr.enqueue(dr.ADMode.Backward, end)
    dr.traverse(dr.ADMode.Backward)

    slopes = [dr.grad(variable) for variable in (*wanted, rays.position, rays.direction)]
    dr.eval(slopes)  # one launch for all
    gradients = iter(slope.numpy() for slope in slopes[:-2])
    values = tuple({path: next(gradients) for path in paths} for paths in names)
    return RayCotangents(values, rows(slopes[-2], systems.count), rows(slopes[-1], systems.count))
