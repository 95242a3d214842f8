"""First-order (parabasal) quantities about a chief ray, by derivatives of the exact trace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.numerics.array_math import determinant, inverse, product
from optics.numerics.backend import Backend
from optics.raytrace.derivatives import jvp
from optics.raytrace.system import SystemBatch


@dataclass(frozen=True, eq=False)
class RayMatrix:
    """Derivatives of one ray of each of B systems with respect to its launch, in transverse coordinates.

    Attributes:
        image_by_position, image_by_angle: d(x, y on the last element)/d(launch), (B, 2, 2), 1 and m/rad.
        direction_by_position, direction_by_angle: d(direction x, y on the last element)/d(launch), (B, 2, 2).
        stop_by_position, stop_by_angle: the same for the hit on the stop, (B, 2, 2).
    """

    image_by_position: np.ndarray
    image_by_angle: np.ndarray
    direction_by_position: np.ndarray
    direction_by_angle: np.ndarray
    stop_by_position: np.ndarray
    stop_by_angle: np.ndarray


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """First-order quantities of B systems about their chief rays.

    Attributes:
        scale: d(image x, y)/d(object angle about the two launch axes) with the stop point held, (B, 2, 2), metres per
            radian: the local focal length along each axis, off-diagonal terms are rotation and anamorphism.
        focal_length: sqrt|det scale|, (B,), metres.
        entrance_magnification: d(stop x, y)/d(launch x, y), (B, 2, 2).
        exit_pupil_distance: from the image upstream along the chief ray, mean over both axes, (B,), metres; negative
            when the pupil lies downstream, large when the image space is telecentric.
    """

    scale: np.ndarray
    focal_length: np.ndarray
    entrance_magnification: np.ndarray
    exit_pupil_distance: np.ndarray


def ray_matrix(
    backend: Backend, systems: SystemBatch, stop: int, position: np.ndarray, direction: np.ndarray, axes: np.ndarray
) -> RayMatrix:
    """Differentiate one ray per system by forward-mode AD.

    Args:
        backend: where to trace.
        systems: B systems.
        stop: index of the stop in the sequence.
        position: launch points, world, (B, 3).
        direction: unit directions, (B, 3).
        axes: two launch axes square to the direction, (B, 2, 3).
    """
    zero = np.zeros_like(axes)
    out = jvp(
        backend,
        systems,
        np.repeat(position[:, None], 4, axis=1),
        np.repeat(direction[:, None], 4, axis=1),
        np.concatenate([axes, zero], axis=1),
        np.concatenate([zero, axes], axis=1),
        keep=(stop,),
    )
    # columns are launch steps, rows x and y
    image, angle, hit = (np.swapaxes(step[..., :2], 1, 2) for step in (out.position, out.direction, out.hits[stop]))
    return RayMatrix(image[..., :2], image[..., 2:], angle[..., :2], angle[..., 2:], hit[..., :2], hit[..., 2:])


def first_order(matrix: RayMatrix) -> FirstOrder:
    """Chief-ray quantities from the ray matrix: neighbouring fields through the same stop point."""
    follow = -product(inverse(matrix.stop_by_position), matrix.stop_by_angle)
    scale = matrix.image_by_angle + product(matrix.image_by_position, follow)
    turn = matrix.direction_by_angle + product(matrix.direction_by_position, follow)
    focal_length = np.sqrt(np.abs(determinant(scale)))
    # two chief rays cross where image step - s * direction step vanishes, s measured upstream
    distance = np.sum(scale * turn, axis=(-1, -2)) / np.maximum(np.sum(turn * turn, axis=(-1, -2)), 1e-30)
    return FirstOrder(scale, focal_length, matrix.stop_by_position, distance)
