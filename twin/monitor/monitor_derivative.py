"""Derivatives of the monitor's spots and images by motions of any body, by forward-mode AD through the whole path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optics.geometry.tree import AT_REST, COMPLEX_STEP, PlacedBodies, State
from optics.numerics.array_math import inverse, turned
from optics.numerics.backend import Backend
from optics.raytrace.aim import transverse_axes
from optics.raytrace.derivatives import RayTangents, jvp
from optics.raytrace.system import SystemBatch, assemble
from optics.waves.diffraction import PupilTangent, image_derivative
from twin.monitor.monitor_beams import MonitorBeams
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.motions import FIGURE_TERMS, ElementaryMotion, pivot_states


def size_steps(placed: PlacedBodies, bodies: Sequence[str]) -> np.ndarray:
    """Derivative of the sizes of C bodies by the steps of M states, (C, M)."""
    return np.stack([placed.scale[:, placed.index[body]].imag for body in bodies]) / COMPLEX_STEP


def ray_tangents(path: MonitorBeams, motions: Sequence[ElementaryMotion]) -> tuple[RayTangents, np.ndarray]:
    """Push motions forward through the traced path, about the unperturbed instrument; rays stay on their nodes.

    Returns:
        Derivatives for C channels x M motions (channel-major), in each CCD's frame, per radian, metre or unit, and
        those of the CCDs' sizes, (C*M,).

    The motions of the bodies are differentiated by a complex step in the rigid-body tree, the trace by Dr.Jit.
    """
    states, steps = _of_one_structure(path, pivot_states(motions)), [motion.step for motion in motions]
    placed = path.instrument.assembly.place(states, steps)
    source = np.concatenate([placed.translation[:, placed.index[c.reticle_body]].imag for c in path.channels])
    nominal, m = path.nominal, len(motions)
    direction = np.repeat(nominal.direction, m, axis=0)
    position = np.broadcast_to(np.repeat(nominal.position, m, axis=0), direction.shape)
    position_step = source[:, None] / COMPLEX_STEP

    def push(sequence: str, direction_step: np.ndarray | float) -> RayTangents:
        names = [f"{channel.key}/{sequence}" for channel in path.channels]
        systems = assemble(path.instrument.assembly, names, states, steps, placed)
        return jvp(path.backend, systems, position, direction, position_step, direction_step)

    drift = push("outgoing", 0.0).position[..., :2]
    outgoing = assemble(path.instrument.assembly, [f"{channel.key}/outgoing" for channel in path.channels])
    start = np.broadcast_to(nominal.position, nominal.direction.shape)
    axes, slopes = hit_slopes(path.backend, outgoing, start, nominal.direction)
    faces = size_steps(placed, [channel.face_body for channel in path.channels]).reshape(-1, 1, 1)
    q_step = turned(np.repeat(inverse(slopes), m, axis=0), faces * path.targets(m) - drift)
    sizes = size_steps(placed, [channel.ccd_body for channel in path.channels]).ravel()
    return push("monitor", np.einsum("bnk,bnkx->bnx", q_step, np.repeat(axes, m, axis=0))), sizes


def _of_one_structure(path: MonitorBeams, states: list[State]) -> list[State]:
    """The same states, of which the first names the highest figure term of every mirror, as none: so the derivatives by
    any motions take one and the same kernel, which is by far the longest to compile.
    """
    if not states:
        return states
    first, term = dict(states[0]), max(FIGURE_TERMS)
    for element in path.instrument.assembly.elements.values():
        if not element.surface.is_plane:
            motion = first.get(element.body, AT_REST)
            first[element.body] = replace(motion, figure={term: 0.0, **motion.figure})
    return [first, *states[1:]]


def hit_slopes(
    backend: Backend, systems: SystemBatch, position: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Exact derivative of where rays meet the last element by the directions in which they start.

    Args:
        backend: where to trace.
        systems: B systems that carry no derivative.
        position: launch points, world, (B, N, 3), metres.
        direction: unit directions, (B, N, 3).

    Returns:
        Two unit vectors square to each direction, (B, N, 2, 3), and d(hit x, y)/d(turn toward each), (B, N, 2, 2),
        metres per radian.
    """
    axes = transverse_axes(direction, np.broadcast_to([0.0, 1.0, 0.0], direction.shape))
    place, heading = np.repeat(position, 2, axis=1), np.repeat(direction, 2, axis=1)
    pushed = jvp(backend, systems, place, heading, 0.0, axes.reshape(len(direction), -1, 3))
    return axes, np.swapaxes(pushed.position[..., :2].reshape(*direction.shape[:2], 2, 2), -1, -2)


def spot_jacobian(path: MonitorBeams, motions: Sequence[ElementaryMotion]) -> np.ndarray:
    """Derivative of every spot's position by elementary motions.

    The position is the mean of the rays over the aperture, which is the energy centroid of the diffraction image.

    Args:
        path: the monitor.
        motions: M elementary motions.

    Returns:
        (C, 2, M): row and column, pixels per radian, metre or unit.
    """
    tangents, sizes = ray_tangents(path.coarse, motions)
    place = tangents.traced.numpy()[0]
    # a place is counted in pixels, which grow with the chip
    moved = tangents.position - sizes[:, None, None] * place
    mean = np.einsum("n,bnk->bk", path.coarse.nodes.share, moved[..., 1::-1])
    return np.asarray(mean.reshape(len(path.channels), len(motions), 2).swapaxes(1, 2)) / path.pitch


def photon_derivative(path: MonitorPath, motions: Sequence[ElementaryMotion]) -> np.ndarray:
    """Derivative of the expected photons per pixel and frame by elementary motions: AD from the YAML to the pixels.

    Args:
        path: the monitor.
        motions: M elementary motions.

    Returns:
        (M, C, rows, columns), photons per radian, metre or unit.
    """
    tangents, sizes = ray_tangents(path, motions)
    count = len(motions)
    rays = path.rays([{}])
    field = path.field_of(rays)
    # per nominal length of the chip, see ``PupilField.in_lengths_of``
    grown = tangents.direction + sizes[:, None, None] * np.repeat(rays.direction, count, axis=0)
    u_step, v_step = grown[..., 0], grown[..., 1]
    # eikonal = path - d . position with the CCD's centre as the origin
    position, direction = (np.repeat(a, count, axis=0) for a in (rays.position, rays.direction))
    eikonal_step = tangents.path - np.sum(tangents.direction * position + direction * tangents.position, axis=-1)
    u, v, amplitude = (np.repeat(a, count, axis=0) for a in (field.u, field.v, field.amplitude))
    ratio = path.area_ratio(u, v)
    ratio_step = path.area_ratio(u_step, v) + path.area_ratio(u, v_step)
    step = PupilTangent(u_step, v_step, eikonal_step, amplitude * 0.5 * ratio_step / ratio)
    reach = path.response.reach
    y, x = (path.grid(axis, reach) for axis in (0, 1))
    derivative = image_derivative(field.repeated(count), step, x, y)
    photons = path.response.apply(derivative)
    photons = path.light_per_pixel[:, None, None, None] * photons.reshape(len(path.channels), count, *photons.shape[1:])
    return np.asarray(photons.swapaxes(0, 1))
