"""Ray aiming: exact rays through given points of a given element (stop, prism aperture)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from optics.geometry.tree import State
from optics.numerics.array_math import PhysicalError, norm, solve_pairs
from optics.numerics.backend import Backend
from optics.raytrace.assembly import Assembly, Element
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import make_rays, trace

DEFAULT_TOLERANCE = 1e-11
"""Largest distance of an aimed ray from its target, metres."""
MAX_ITERATIONS = 25
"""Number of Newton or Broyden steps after which aiming fails."""


class AimError(PhysicalError, RuntimeError):
    """Error: no ray of the requested kind reaches the target point, or the search for it does not converge."""


@dataclass(frozen=True, eq=False)
class RayFan:
    """N rays in each of B systems that can be aimed, each by two parameters a and b.

    The parameters move the ray's direction or its launch point.

    Attributes
    ----------
    position : (B, N, 3) ndarray
        Launch points in the world frame, metres.
    direction : (B, N, 3) ndarray
        Unit directions in the world frame.
    axes : ndarray
        Two vectors e1, e2 per ray or per system, broadcastable to (B, N, 2, 3).
    moves_position : bool
        True: launch point = position + a e1 + b e2 (a collimated beam); False: direction = normalised (direction + a e1
        + b e2) (a point source).
    """

    position: np.ndarray
    direction: np.ndarray
    axes: np.ndarray
    moves_position: bool = False

    @classmethod
    def toward(cls, position: np.ndarray, direction: np.ndarray, first: ArrayLike = (0.0, 1.0, 0.0)) -> RayFan:
        """Return rays from points (B, N, 3) with directions near a given one, broadcastable to (B, N, 3).

        ``first`` is a vector near which the first transverse axis of every ray is taken.
        """
        along = np.broadcast_to(direction, position.shape)
        return cls(position, along, transverse_axes(along, np.broadcast_to(first, along.shape)))

    def at(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return launch points (metres) and unit directions, (B, N, 3) each, for given parameters (a, b) of each ray.

        ``q`` (B, N, 2) are these parameters, for N rays in each of B systems.
        """
        start = self.position if self.moves_position else self.direction
        # component by component, since each is one block of memory
        moved = np.empty((3, *q.shape[:2]))
        for x in range(3):
            np.multiply(q[..., 0], self.axes[..., 0, x], out=moved[x])
            moved[x] += q[..., 1] * self.axes[..., 1, x]
            moved[x] += start[..., x]
        shape = (*q.shape[:2], 3)
        if self.moves_position:
            return np.moveaxis(moved, 0, -1), np.broadcast_to(self.direction, shape)
        moved /= np.sqrt(moved[0] ** 2 + moved[1] ** 2 + moved[2] ** 2)
        return np.broadcast_to(self.position, shape), np.moveaxis(moved, 0, -1)


def transverse_axes(direction: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return two unit vectors (..., 2, 3) perpendicular to ``direction`` (..., 3), the first near ``first``."""
    e1 = first - direction * np.sum(first * direction, axis=-1, keepdims=True)
    e1 = e1 / np.linalg.norm(e1, axis=-1, keepdims=True)
    return np.stack([e1, np.cross(direction, e1)], axis=-2)


# values that are not finite end in AimError, without NumPy's warnings
@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def aim(
    backend: Backend,
    systems: SystemBatch,
    fan: RayFan,
    target: np.ndarray,
    start: np.ndarray | None = None,
    jacobian: np.ndarray | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
    step: float = 1e-6,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve for the rays that meet the last element of ``systems`` at ``target``.

    Newton's method with one difference Jacobian per ray, improved by Broyden's rank-one update. A converged ray is not
    changed further, so that its numbers do not depend on the other rays.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    systems : SystemBatch
        B systems that end at the target element; apertures are ignored.
    fan : RayFan
        N rays for each system, with two parameters each that aim them.
    target : ndarray
        Target x, y on that element, metres at its nominal size, broadcastable to (B, N, 2): points of an aperture,
        which expands with its body.
    start : ndarray, optional
        Initial parameters, broadcastable to (B, N, 2); 0 by default.
    jacobian : ndarray, optional
        Initial derivatives of the intersection (x, y) with respect to the parameters, broadcastable to (B, N, 2, 2); by
        default from differences of size ``step``.
    tolerance : float
        Largest distance from the target on the element, metres.
    step : float
        Difference step of the parameters (metres or radians).

    Returns
    -------
    q : (B, N, 2) ndarray
        Parameters of the aimed rays.
    jacobian : (B, N, 2, 2) ndarray
        Derivatives of the intersection with respect to the parameters there.

    Raises
    ------
    AimError
        The iteration does not converge.
    """
    uploaded = systems.upload(backend)

    def hit(q: np.ndarray) -> np.ndarray:
        position, direction = fan.at(q)
        return trace(backend, uploaded, make_rays(backend, position, direction)).xy()

    count = max(systems.count, fan.position.shape[0], fan.direction.shape[0])
    rays = max(fan.position.shape[1], fan.direction.shape[1], np.shape(target)[-2] if np.ndim(target) > 1 else 1)
    shape = (count, rays, 2)
    q = np.array(np.broadcast_to(0.0 if start is None else start, shape), dtype=np.float64)
    goal = np.broadcast_to(target, shape) * systems.size[:, None, None]
    current = hit(q)
    if jacobian is None:
        columns = [(hit(q + step * np.eye(2)[k]) - current) / step for k in range(2)]
        slope = np.stack(columns, axis=-1)
    else:
        slope = np.array(np.broadcast_to(jacobian, (*shape, 2)), dtype=np.float64)
    for _ in range(MAX_ITERATIONS):
        miss = goal - current
        worst = float(np.max(np.abs(miss)))
        if worst <= tolerance:
            return q, slope
        if not np.isfinite(worst):
            break  # also after a step along a singular Jacobian
        moving = np.max(np.abs(miss), axis=-1)[..., None] > tolerance
        change = np.where(moving, solve_pairs(slope, miss), 0.0)
        q = q + change
        moved = hit(q)
        error = (moved - current) - np.einsum("bnij,bnj->bni", slope, change)
        norm = np.sum(change**2, axis=-1)[..., None, None]
        moving = moving[..., None]
        update = error[..., :, None] * change[..., None, :] / np.where(moving, norm, 1.0)
        slope = np.where(moving, slope + update, slope)
        current = moved
    raise AimError(
        f"aiming at the last element did not converge: {float(np.max(np.abs(goal - current))):.3g} m off after "
        f"{MAX_ITERATIONS} steps; the perturbation may move the beam off the mirrors"
    )


def aimed_rays(
    backend: Backend, systems: SystemBatch, start: np.ndarray, guess: np.ndarray, target: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Aim N rays in each of B systems at points of the last element, starting from approximate directions.

    Parameters
    ----------
    backend : Backend
        Backend that traces the rays.
    systems : SystemBatch
        B systems.
    start : (B, N or 1, 3) ndarray
        Start points, metres.
    guess : ndarray
        Approximate unit vectors, broadcastable to (B, N, 3).
    target : (B, N, 2) ndarray
        Points to hit in the last element's x, y, metres.
    tolerance : float
        Largest distance of a hit from its point, metres.

    Returns
    -------
    tuple of ndarray
        Positions (metres) and unit vectors of the rays, (B, N, 3) each.
    """
    fan = RayFan.toward(np.broadcast_to(start, (*target.shape[:2], 3)), guess)
    q, _ = aim(backend, systems, fan, target, tolerance=tolerance)
    return fan.at(q)


def surviving_rays(
    backend: Backend,
    assembly: Assembly,
    names: Sequence[str],
    position: np.ndarray,
    direction: np.ndarray,
    state: State | None = None,
) -> Iterator[tuple[Element, np.ndarray]]:
    """Yield which rays are still valid after each element of a sequence, to find where rays are lost.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    assembly : Assembly
        The instrument.
    names : sequence of str
        Elements in the order in which light meets them.
    position : ndarray
        Positions of N rays in the world frame, metres, broadcastable to (N, 3).
    direction : ndarray
        Unit directions in the world frame, broadcastable to (N, 3).
    state : State, optional
        Perturbed state; nominal by default.

    Yields
    ------
    element : Element
        The element.
    valid : (N,) ndarray of bool
        Mask of the rays that are valid after it.
    """
    rays = make_rays(backend, position, direction)
    for count in range(1, len(names) + 1):
        traced = trace(backend, assemble(assembly, [names[:count]], [state or {}]), rays)
        yield assembly.elements[names[count - 1]], traced.numpy()[3][0]


def direction_of(field: tuple[float, float]) -> np.ndarray:
    """Return the unit vector (3,) along the light of a far point.

    Parameters
    ----------
    field : (float, float)
        Angles x and y of the light from the axis, radians.

    Raises
    ------
    ValueError
        The field is not a pair of angles within pi/2.
    """
    angles = np.asarray(field, float)
    if angles.shape != (2,) or not np.all(np.abs(angles) < 0.5 * np.pi):
        raise ValueError(f"field must be two angles (x, y) in radians between -pi/2 and pi/2, got {field}")
    vector = np.array([np.tan(angles[0]), np.tan(angles[1]), 1.0])
    return np.asarray(vector / norm(vector))
