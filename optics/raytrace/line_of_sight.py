"""Line of sight, roll and principal distance of a line camera, by exact chief rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.numerics.array_math import inner, product
from optics.numerics.backend import Backend
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.system import SystemBatch
from optics.raytrace.trace import make_rays, require_some, trace


def aim_chief_rays(
    backend: Backend,
    to_stop: SystemBatch,
    points: np.ndarray,
    guess: np.ndarray,
    transverse: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[RayFan, np.ndarray, np.ndarray]:
    """Aim rays of image points at the centre of the stop.

    Args:
        backend: where to trace.
        to_stop: B systems from the image side to the stop (last element).
        points: image points, world, (B, M, 3).
        guess: rough direction from the image to the last mirror, broadcastable to (B, M, 3).
        transverse: direction near which the first transverse axis is taken, (3,).
        start: parameters (B, M, 2) and their Jacobian (B, M, 2, 2) of rays that are near, as this returns them.

    Returns:
        The family of the rays, their parameters (B, M, 2) and Jacobian (B, M, 2, 2).

    Raises:
        AimError: no ray gets there.
    """
    direction = np.broadcast_to(guess, points.shape)
    fan = RayFan(points, direction, transverse_axes(direction, np.broadcast_to(transverse, direction.shape)))
    near, slope = (None, None) if start is None else start
    return fan, *aim(backend, to_stop, fan, np.zeros(2), near, slope)


def chief_rays(
    backend: Backend,
    to_stop: SystemBatch,
    to_object: SystemBatch,
    points: np.ndarray,
    guess: np.ndarray,
    transverse: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Chief rays of image points, traced backward from the image through the centre of the stop.

    Args:
        backend: where to trace.
        to_stop: B systems from the image side to the stop (last element).
        to_object: the same systems on to the first mirror.
        points: image points, world, (B, M, 3).
        guess: rough direction from the image to the last mirror, broadcastable to (B, M, 3).
        transverse: direction near which the first transverse axis is taken, (3,).
        start: as of `aim_chief_rays`.

    Returns:
        Points on the rays after the first mirror, and object-space directions toward the scene, world, (B, M, 3) each.

    Raises:
        AimError, BeamMissedError: light is lost.
    """
    fan, q, _ = aim_chief_rays(backend, to_stop, points, guess, transverse, start)
    position, direction = fan.at(q)
    out = trace(backend, to_object, make_rays(backend, position, direction), world=True)
    assert out.world is not None
    places, leaving, _, valid = out.numpy(out.world)
    require_some(valid, "the imaging path")
    return places, leaving


@dataclass(frozen=True, eq=False)
class LineChange:
    """True change of a line camera against its nominal state, for B states.

    Attributes:
        d_alpha, d_beta: rotation of the line of sight about the nominal camera's Y and X, radians (right-hand rule).
        d_gamma: rotation of the imaged line about the line of sight, radians.
        principal_distance: f = sum(L tan W)/sum(tan^2 W) over the line (paper 004, eq. 3), (B,), metres. L is counted
            in pixels times their nominal pitch, so that f is what the pixels see: a camera that grows with its line
            CCD keeps the angle of a pixel, and so f.
        d_f: its change, metres.
        nominal_distance: principal distance of the nominal state, metres.
    """

    d_alpha: np.ndarray
    d_beta: np.ndarray
    d_gamma: np.ndarray
    principal_distance: np.ndarray
    d_f: np.ndarray
    nominal_distance: float

    @property
    def vector(self) -> np.ndarray:
        """The changes d_alpha, d_beta, d_gamma (radians) and d_f (metres), (B, 4)."""
        return np.stack([self.d_alpha, self.d_beta, self.d_gamma, self.d_f], axis=-1)


def line_tangents(
    sight: np.ndarray, position: np.ndarray, camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the points of a line look, in the tangent plane about each state's own line of sight.

    Args:
        sight: object-space directions of the line's points, world, (S, M, 3); M odd, the middle point is the line's
            centre.
        position: as of `line_change`, (M,), metres.
        camera: as of `line_change`, (3, 3).

    Returns:
        Lines of sight in the camera's axes (S, 3), roll of the imaged line about them (S,), radians, and tangents along
        the imaged line, (S, M), positive as ``position``.
    """
    local = product(sight, camera)
    middle = sight.shape[1] // 2
    axis = local[:, middle]
    # tangent-plane coordinates about each state's own line of sight, its X axis kept square to the nominal Y axis
    forward = axis[:, None]
    across = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    along = np.cross(forward, across)
    depth = np.sum(local * forward, axis=-1)
    x = np.sum(local * across, axis=-1) / depth
    y = np.sum(local * along, axis=-1) / depth
    # a lens inverts: an image point at +L looks toward -tan W
    weight = position / np.sum(position**2)
    roll = np.arctan2(inner(x, weight), -inner(y, weight))
    return axis, roll, -(y * np.cos(roll)[:, None] - x * np.sin(roll)[:, None])


def line_change(sight: np.ndarray, position: np.ndarray, camera: np.ndarray) -> LineChange:
    """Compare perturbed states with the nominal one.

    Args:
        sight: object-space directions of the line's points, world, (1 + B, M, 3); entry 0 is the nominal state; M
        odd, the
            middle point is the line's centre.
        position: coordinate of the points along camera Y on the nominal line CCD, (M,), metres.
        camera: columns = nominal camera axes X, Y, Z in the world, (3, 3); Z is the nominal line of sight.
    """
    axis, roll, tangent = line_tangents(sight, position, camera)
    distance = inner(tangent, position) / np.sum(tangent**2, axis=-1)
    rolled = roll[1:] - roll[0]
    # a camera that images upright has a roll of half a turn, by either sign
    rolled = rolled - 2.0 * np.pi * np.round(rolled / (2.0 * np.pi))
    return LineChange(
        d_alpha=np.arctan2(axis[1:, 0], axis[1:, 2]),
        d_beta=np.arctan2(-axis[1:, 1], np.hypot(axis[1:, 0], axis[1:, 2])),
        d_gamma=rolled,
        principal_distance=distance[1:],
        d_f=distance[1:] - distance[0],
        nominal_distance=float(distance[0]),
    )
