"""Rays through a prescription for its merit, with exact derivatives by everything that may vary.

Every field's beam is a circle of the entrance pupil's diameter about the ray that meets the vertex of the stop. Where
that chief ray starts follows from the implicit function theorem, all else from forward-mode AD through the trace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optics.design.design_variables import BIAS, Prescription, Variable
from optics.geometry.tree import COMPLEX_STEP
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import RayFan, aim
from optics.raytrace.derivatives import jvp
from optics.raytrace.system import assemble
from optics.raytrace.trace import BeamMissedError, make_rays, trace

LAUNCH_DISTANCE = 9.0
"""How far before the prescription's origin beams start, metres: well before every mirror."""


@dataclass(frozen=True, eq=False)
class Beams:
    """The beams that a prescription is evaluated by.

    Attributes:
        fields: angles x, y about the field bias, radians, (F, 2).
        diameter: of the entrance pupil, metres.
        nodes: quadrature over the pupil.
        rim: number of rays around the edge of each beam.
    """

    fields: np.ndarray
    diameter: float
    nodes: PupilNodes
    rim: int = 24

    @property
    def pupil(self) -> np.ndarray:
        """Pupil coordinates of a beam's rays, (N, 2): the chief ray, the nodes, the rim."""
        angle = 2.0 * np.pi * np.arange(self.rim) / self.rim
        nodes = np.stack([self.nodes.x, self.nodes.y], axis=-1)
        return np.concatenate([np.zeros((1, 2)), nodes, np.stack([np.cos(angle), np.sin(angle)], axis=-1)])


@dataclass(frozen=True, eq=False)
class DesignRays:
    """Traced beams, F fields of N rays each, and derivatives by V variables (a first axis of that size).

    Attributes:
        position, direction: on the image in its own frame, (F, N, 3).
        path: optical path from the incoming wavefront through the prescription's origin, (F, N), metres.
        points: launch points, hits on each surface and the image, prescription frame, (K + 1, F, N, 3).
        d_position, d_direction, d_path, d_points: derivatives, (V, ...) each; None if not asked for.
        d_bias: of the field bias, (V,).
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    points: np.ndarray
    d_position: np.ndarray | None = None
    d_direction: np.ndarray | None = None
    d_path: np.ndarray | None = None
    d_points: np.ndarray | None = None
    d_bias: np.ndarray | None = None


def beam_axes(fields: np.ndarray, bias: complex) -> tuple[np.ndarray, np.ndarray]:
    """Direction (F, 3) in which light of the fields travels, and two axes of its wavefront (F, 2, 3), the first near x.

    ``bias`` may be complex, for a complex step.
    """
    x, y = fields[:, 0], fields[:, 1] + bias
    along = np.stack([np.tan(x) + 0.0 * y, np.tan(y), np.ones_like(y)], axis=-1)
    along = along / np.sqrt(np.sum(along * along, axis=-1, keepdims=True))
    first = np.array([1.0, 0.0, 0.0]) - along * along[:, :1]
    first = first / np.sqrt(np.sum(first * first, axis=-1, keepdims=True))
    second = np.stack([along[:, i - 2] * first[:, i - 1] - along[:, i - 1] * first[:, i - 2] for i in range(3)], -1)
    return along, np.stack([first, second], axis=1)


def trace_beams(
    backend: Backend, prescription: Prescription, beams: Beams, variables: Sequence[Variable] | None = None
) -> DesignRays:
    """Trace all beams, and differentiate them if variables are given.

    Raises:
        AimError: a chief ray does not reach the stop.
        BeamMissedError: a beam is lost.
    """
    assembly = prescription.assembly
    along, axes = beam_axes(beams.fields, prescription.field_bias)
    count = len(along)
    to_stop = assemble(assembly, ["to_stop"]).take(np.zeros(count, dtype=int))
    fan = RayFan(-LAUNCH_DISTANCE * along[:, None], along[:, None], axes[:, None], moves_position=True)
    chief = fan.at(aim(backend, to_stop, fan, np.zeros((1, 2)))[0])[0][:, 0]
    reach = 0.5 * beams.diameter * beams.pupil
    launch = chief[:, None] + np.einsum("nk,fkx->fnx", reach, axes)
    heading = np.broadcast_to(along[:, None], launch.shape)
    phase = np.einsum("fnx,fx->fn", launch, along)

    imaging = assemble(assembly, ["imaging"])
    shape = launch.shape
    keep = range(len(prescription.names))
    traced = trace(backend, imaging, make_rays(backend, launch.reshape(-1, 3), heading.reshape(-1, 3)), keep=keep)
    position, direction, path, valid = (a[0] for a in traced.numpy())
    if not valid.all():
        raise BeamMissedError("a part of a beam misses a surface of the prescription")
    hits = np.stack([traced.hit(i)[0] for i in keep])
    points = np.einsum("kij,knj->kni", imaging.world.rotation[0], hits) + imaging.world.translation[0][:, None]
    points = np.concatenate([launch[None], points.reshape(len(hits), *shape)])
    rays = DesignRays(position.reshape(shape), direction.reshape(shape), path.reshape(shape[:2]) + phase, points)
    return rays if variables is None else _differentiated(backend, prescription, beams, variables, rays, chief)


def _differentiated(
    backend: Backend,
    prescription: Prescription,
    beams: Beams,
    variables: Sequence[Variable],
    rays: DesignRays,
    chief: np.ndarray,
) -> DesignRays:
    """The rays with their derivatives."""
    along, axes = beam_axes(beams.fields, prescription.field_bias)
    turned = beam_axes(beams.fields, prescription.field_bias + 1j * COMPLEX_STEP)
    biased = np.array([v.quantity == BIAS for v in variables], dtype=float)
    along_step, axes_step = (np.multiply.outer(biased, a.imag / COMPLEX_STEP) for a in turned)  # (V, F, ...)
    count, fields = len(variables), len(along)

    # the chief ray's start is c = -L d + a e1 + b e2 with a, b such that it meets the vertex of the stop
    place = np.einsum("fx,fkx->fk", chief, axes)
    fixed = -LAUNCH_DISTANCE * along_step + np.einsum("fk,vfkx->vfx", place, axes_step)
    single = assemble(prescription.assembly, ["to_stop"])
    twice = np.repeat(chief, 2, axis=0)[None], np.repeat(along, 2, axis=0)[None]
    slopes = jvp(backend, single, *twice, axes.reshape(1, -1, 3)).position[0, :, :2]
    slopes = np.swapaxes(slopes.reshape(fields, 2, 2), -1, -2)
    to_stop = prescription.tangents(variables, "to_stop")
    every = np.broadcast_to(chief, (count, fields, 3)), np.broadcast_to(along, (count, fields, 3))
    drift = jvp(backend, to_stop, *every, fixed, along_step).position[..., :2]
    moved = -np.linalg.solve(np.broadcast_to(slopes, (count, fields, 2, 2)), drift[..., None])[..., 0]
    chief_step = fixed + np.einsum("vfk,fkx->vfx", moved, axes)

    reach = 0.5 * beams.diameter * beams.pupil
    launch = rays.points[0]
    launch_step = chief_step[:, :, None] + np.einsum("nk,vfkx->vfnx", reach, axes_step)
    shape = launch_step.shape
    heading = np.broadcast_to(along[:, None], launch.shape)
    heading_step = np.broadcast_to(along_step[:, :, None], shape)
    systems = prescription.tangents(variables, "imaging")
    keep = range(len(prescription.names))
    flat = (count, -1, 3)
    pushed = jvp(
        backend,
        systems,
        np.broadcast_to(launch, shape).reshape(flat),
        np.broadcast_to(heading, shape).reshape(flat),
        launch_step.reshape(flat),
        heading_step.reshape(flat),
        keep=keep,
    )
    assert systems.world_tangents is not None
    rotation, rotation_step = (np.swapaxes(p.rotation, 0, 1) for p in (systems.world, systems.world_tangents))
    origin_step = np.swapaxes(systems.world_tangents.translation, 0, 1)
    hits = np.stack([pushed.traced.hit(k) for k in keep])
    hit_steps = np.stack([pushed.hits[k] for k in keep])
    points = np.einsum("kvij,kvnj->kvni", rotation, hit_steps) + np.einsum("kvij,kvnj->kvni", rotation_step, hits)
    points = np.swapaxes((points + origin_step[:, :, None]).reshape(len(hits), *shape), 0, 1)
    phase = np.einsum("vfnx,fx->vfn", launch_step, along) + np.einsum("fnx,vfx->vfn", launch, along_step)
    return replace(
        rays,
        d_position=pushed.position.reshape(shape),
        d_direction=pushed.direction.reshape(shape),
        d_path=pushed.path.reshape(shape[:3]) + phase,
        d_points=np.concatenate([launch_step[:, None], points], axis=1),
        d_bias=biased,
    )
