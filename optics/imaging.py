"""The pupil field of a camera that looks at a far point: what ``optics.diffraction.image`` turns into its image.

The beam is collimated and evenly lit. Rays are aimed at quadrature nodes of the stop, so that its edge is exact in
every state. With p the launch point on the incoming plane wavefront, s the point of the stop and (u, v) the direction
cosines at the detector, power conservation |a|^2 du dv = dp / A makes the amplitude of a node

    a du dv = sqrt(|d(u, v)/dp| / A) * |dp/ds| * ds,    A = sum |dp/ds| ds,

with both Jacobians by forward-mode AD through the trace. Paths count from the incoming wavefront.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optics.aim import RayFan, aim, transverse_axes
from optics.aperture import Circle
from optics.backend import Backend
from optics.diffraction import PupilField
from optics.quadrature import PupilNodes
from optics.system import SystemBatch
from optics.trace import make_rays, require_some, trace
from optics.wavefront import eikonal

AIM_TOLERANCE = 1e-11
"""Distance of a ray from its node on the stop, metres."""


def aim_collimated(
    backend: Backend, to_stop: SystemBatch, direction: np.ndarray, launch: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays of collimated beams that meet given points of the stop.

    Args:
        backend: where to trace.
        to_stop: B systems from the scene to the stop, their last element.
        direction: of the light, world, unit, (3,) or (B, 3).
        launch: a world point of the beam before the first mirror, (3,) or (B, 3), metres; rays start on the plane
            wavefront through it.
        target: stop coordinates, (N, 2), metres.

    Returns:
        Launch points (B, N, 3) and the two axes of the wavefront (B, 2, 3).

    Raises:
        AimError: the beam does not reach the stop.
    """
    count = to_stop.count
    along = np.broadcast_to(direction, (count, 3))[:, None]
    origin = np.broadcast_to(launch, (count, 3))[:, None]
    # any transverse axis will do; the coordinate axis least along the beam is well conditioned
    across = np.eye(3)[np.argmin(np.abs(along), axis=-1)]
    axes = transverse_axes(along, across)
    fan = RayFan(origin, along, axes, moves_position=True)
    middle, slope = aim(backend, to_stop, fan, np.zeros((1, 2)), tolerance=AIM_TOLERANCE)
    near = middle + np.einsum("bnij,pj->bpi", np.linalg.inv(slope), target)
    q, _ = aim(backend, to_stop, fan, target, near, slope, AIM_TOLERANCE)
    return fan.at(q)[0], axes[:, 0]


def imaging_field(
    backend: Backend,
    systems: SystemBatch,
    to_stop: SystemBatch,
    direction: np.ndarray,
    launch: np.ndarray,
    stop: Circle,
    nodes: PupilNodes,
    wavelength: float,
    origin: np.ndarray | None = None,
) -> PupilField:
    """Plane waves at the detector for B systems that image a far point.

    Args:
        backend: where to trace.
        systems: B systems from the scene to the detector, whose x, y are the image's.
        to_stop: the same systems, only as far as the stop.
        direction: of the light, world, unit, (3,) or (B, 3).
        launch: a world point of the beam before the first mirror, (3,) or (B, 3), metres.
        stop: clear aperture of the stop.
        nodes: quadrature over the unit disk.
        wavelength: metres.
        origin: image point about which the field is wanted, in the detector's frame, (3,) or (B, 3), metres; default 0.

    Returns:
        Unit power through the stop if no other aperture cuts the beam; nodes that another aperture stops carry nothing.

    Raises:
        AimError: the beam does not reach the stop.
        BeamMissedError: no ray reaches the detector.
    """
    target = stop.radius * np.stack([nodes.x, nodes.y], axis=-1) + np.array(stop.centre)
    position, axes = aim_collimated(backend, to_stop, direction, launch, target)
    count = len(position)
    heading = np.broadcast_to(np.broadcast_to(direction, (count, 3))[:, None], position.shape)
    traced, hit, turn = _differentiate(backend, systems, len(to_stop.structure) - 1, position, heading, axes)
    place, leaving, path, valid = traced
    require_some(valid, "the imaging path")
    launch_area = stop.radius**2 * nodes.weight / np.abs(np.linalg.det(hit))
    amplitude = np.sqrt(np.abs(np.linalg.det(turn)) / np.sum(launch_area, axis=-1, keepdims=True)) * launch_area * valid
    centre = np.zeros((1, 1, 3)) if origin is None else np.broadcast_to(origin, (count, 3))[:, None]
    phase = eikonal(place, leaving, path, centre)
    return PupilField(leaving[..., 0], leaving[..., 1], phase - phase[:, :1], amplitude, wavelength)


def _differentiate(
    backend: Backend, systems: SystemBatch, stop: int, position: np.ndarray, direction: np.ndarray, axes: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Trace, and differentiate the hit on the stop and the final direction by the launch point: (B, N, 2, 2) each."""
    import drjit as dr

    count, n = position.shape[:2]
    rays = make_rays(backend, np.repeat(position, 2, axis=1), np.repeat(direction, 2, axis=1))
    dr.enable_grad(rays.position)
    tangent = np.broadcast_to(axes[:, None], (count, n, 2, 3))
    dr.set_grad(rays.position, backend.vector(tangent.reshape(-1, 3)))
    out = trace(backend, systems, rays, keep=(stop,), evaluate=False)
    at_stop = out.hits[stop]
    dr.forward_to(out.local.direction, at_stop, flags=dr.ADFlag.ClearEdges)

    def columns(vector: Any) -> np.ndarray:
        gradient = dr.grad(vector)
        rows = np.stack([gradient.x.numpy(), gradient.y.numpy()], axis=-1).reshape(count, n, 2, 2)
        return np.swapaxes(rows, -1, -2)

    hit, turn = columns(at_stop), columns(out.local.direction)
    plain = tuple(a[:, ::2] for a in out.numpy())
    return plain, hit, turn
