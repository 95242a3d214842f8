"""Forward-mode derivatives of a traced bundle: launch steps, and whatever a ``SystemBatch`` carries, pushed through."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from optics.backend import Backend
from optics.system import SystemBatch
from optics.trace import Traced, make_rays, rows, trace


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


def push_forward(
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

    rays = make_rays(backend, position, direction)
    for variable, step in ((rays.position, position_step), (rays.direction, direction_step)):
        dr.enable_grad(variable)
        dr.set_grad(variable, backend.vector(np.broadcast_to(step, direction.shape).reshape(-1, 3)))
    traced = trace(backend, systems, rays, keep=keep, evaluate=False)
    local = traced.local
    # interior gradients are kept: a hit on the way is an input of the rays at the end
    dr.forward_to(local.position, local.direction, local.path, list(traced.hits.values()), flags=dr.ADFlag.ClearEdges)

    vectors = (local.position, local.direction, *traced.hits.values())
    slopes, path = [dr.grad(vector) for vector in vectors], dr.grad(local.path)
    # one launch for all: each array evaluated by itself would trace everything again in a kernel of its own
    dr.eval(slopes, path, vectors, local.path, local.valid)
    at_position, at_direction, *at_hits = (rows(slope, traced.count) for slope in slopes)
    return RayTangents(
        at_position,
        at_direction,
        path.numpy().reshape(traced.count, -1),
        dict(zip(traced.hits, at_hits, strict=True)),
        traced,
    )
