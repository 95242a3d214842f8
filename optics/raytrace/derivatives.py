"""Derivatives of a ray trace: Jacobian-vector products (forward mode) and vector-Jacobian products (reverse mode).

One backward pass gives the derivative of a weighted sum of ray coordinates by every number of every system, however
many there are; forward mode (``optics.raytrace.derivatives``) gives all rays' derivatives by one parameter.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from optics.numerics.number_tree import Path, leaves
from optics.raytrace.system import SystemBatch
from optics.raytrace.trace import Rays, Traced, make_rays, rows, trace

SECTION = 1
"""Elements that one kernel differentiates in forward mode. Its code is several times that of a trace, and the time to
compile it grows faster than its length: with six elements in one, the kernels of the main job take twice as long to
compile as one by one, and those of derivatives no less to run."""


@dataclass(frozen=True, eq=False)
class RayTangents:
    """Derivatives of rays at the last element of a sequence, in its own frame.

    Attributes:
        position, direction: (B, N, 3), metres and 1 per unit of the parameter.
        path: optical path, (B, N).
        hits: element index -> derivative of the local hit there, (B, N, 3), for those asked to be kept.
        traced: the rays themselves.
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
    """Trace rays and differentiate them by one parameter each.

    Args:
        backend: where to trace.
        systems: B systems; derivatives that they carry (``assemble(..., step=...)``) are added.
        position: launch points, world, (B, N, 3), metres.
        direction: unit directions, (B, N, 3).
        position_step: derivative of the launch points, broadcastable to (B, N, 3).
        direction_step: derivative of the directions, square to them, broadcastable to (B, N, 3).
        keep: indices of elements whose hits are differentiated too.
    """
    import drjit as dr

    uploaded = systems.upload(backend)
    rays = make_rays(backend, position, direction)
    steps = [
        backend.vector(np.broadcast_to(s, direction.shape).reshape(-1, 3)) for s in (position_step, direction_step)
    ]
    along = dr.zeros(backend.Float, dr.width(rays.position))
    dr.make_opaque(along, rays.path, rays.valid)  # the first kernel is that of the others
    hits: dict[int, Any] = {}
    slopes: dict[int, Any] = {}
    for first in range(0, len(uploaded.structure), SECTION):
        last = min(first + SECTION, len(uploaded.structure))
        dr.enable_grad(rays.position, rays.direction)
        dr.set_grad(rays.position, steps[0])
        dr.set_grad(rays.direction, steps[1])
        dr.enable_grad(rays.path)
        dr.set_grad(rays.path, along)
        own = [i - first for i in keep if first <= i < last]
        traced = trace(backend, uploaded.section(first, last), rays, keep=own, evaluate=False)
        local = traced.local
        met = list(traced.hits.values())
        # interior gradients are kept: a hit on the way is an input of the rays at the end
        dr.forward_to(local.position, local.direction, local.path, met, flags=dr.ADFlag.ClearEdges)
        steps, along = [dr.grad(local.position), dr.grad(local.direction)], dr.grad(local.path)
        at = [dr.grad(vector) for vector in met]
        # one launch for all: each array evaluated by itself would trace everything again in a kernel of its own
        dr.eval(steps, along, at, local.position, local.direction, local.path, local.valid, met)
        hits.update({first + i: dr.detach(vector) for i, vector in traced.hits.items()})
        slopes.update({first + i: slope for i, slope in zip(traced.hits, at, strict=True)})
        place, heading, path = (dr.detach(array) for array in (local.position, local.direction, local.path))
        rays = Rays(place, heading, path, local.valid, systems.count)
    return RayTangents(
        rows(steps[0], systems.count),
        rows(steps[1], systems.count),
        along.numpy().reshape(systems.count, -1),
        {i: rows(slope, systems.count) for i, slope in slopes.items()},
        Traced(rays, None, hits, systems.count),
    )


@dataclass(frozen=True, eq=False)
class RayCotangents:
    """Derivatives of S_b = sum_n w_bn . r_bn, with r the rays at the last element of system b and w given weights.

    Attributes:
        values: per element, path of a number -> dS_b/d(number of system b), (B,), for those that were asked for.
        position: dS_b/d(launch point), (B, N, 3), per metre.
        direction: dS_b/d(launch direction), (B, N, 3); its part along the ray means nothing by itself.
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
    """Trace rays and differentiate a weighted sum of where they end by everything they depend on.

    Args:
        backend: where to trace.
        systems: B systems; derivatives that they carry are left aside.
        position: launch points, world, (B, N, 3), metres.
        direction: unit directions, (B, N, 3).
        weight: of the positions at the last element, in its own frame, broadcastable to (B, N, 3).
        names: per element, paths of the numbers in ``systems.values`` to differentiate by.

    Returns:
        Derivatives; rays that are stopped or lost count as if they went on.
    """
    import drjit as dr

    alone = replace(systems, tangents=None, world_tangents=None)
    uploaded = replace(alone.upload(backend, own=True), differentiable=True)
    wanted = [leaves(numbers)[path] for numbers, own in zip(uploaded.values, names, strict=True) for path in own]
    rays = make_rays(backend, position, direction)
    for variable in (*wanted, rays.position, rays.direction):
        dr.enable_grad(variable)
    end = trace(backend, uploaded, rays, evaluate=False).local.position
    dr.set_grad(end, backend.vector(np.broadcast_to(weight, direction.shape).reshape(-1, 3)))
    dr.enqueue(dr.ADMode.Backward, end)
    dr.traverse(dr.ADMode.Backward)

    slopes = [dr.grad(variable) for variable in (*wanted, rays.position, rays.direction)]
    dr.eval(slopes)  # one launch for all
    at = iter(slope.numpy() for slope in slopes[:-2])
    values = tuple({path: next(at) for path in own} for own in names)
    return RayCotangents(values, rows(slopes[-2], systems.count), rows(slopes[-1], systems.count))
