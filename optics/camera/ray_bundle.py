"""Rays through a camera: launched at points of its stop, traced to its image plane, counted into spots and distortion.

A field is a pair of angles (x, y) in radians: its light travels along (tan x, tan y, 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from optics.camera.prescription import Camera
from optics.numerics.array_math import PhysicalError, norm
from optics.numerics.backend import default_backend
from optics.numerics.quadrature import PupilNodes, disk, disk_size, nodes_for
from optics.raytrace.aim import AimError
from optics.raytrace.trace import make_rays
from optics.raytrace.trace import trace as trace_systems
from optics.waves.edge_shadow import IlluminatedStop, SurfaceEdges, converged_shadows
from optics.waves.imaging import aim_collimated

Field = tuple[float, float]
"""Angles (x, y) of a far point, radians."""

RINGS = 12
"""Number of rings of quadrature nodes over the stop.

The mean square of a wavefront error is exact when the error is a polynomial of degree 23 or less in the coordinates of
the stop.
"""

_RIM = 1e-9
"""Distance beyond the rim of the stop, in units of its radius, that counts as rounding of a point on it."""

_MOST_NODES = 4_000_000
"""Largest number of points of the stop through which one beam is traced, which bounds the memory."""


class LightLostError(PhysicalError, ValueError):
    """Error: no light of a field point comes through the camera."""


@dataclass(frozen=True, eq=False)
class TracedRays:
    """N rays on the image plane of a camera.

    Attributes
    ----------
    position : (N, 3) ndarray
        Points on the image plane, metres, in the camera's frame.
    direction : (N, 3) ndarray
        Unit vectors along the light.
    path : (N,) ndarray
        Optical path from the launch points, metres.
    valid : (N,) ndarray of bool
        True for rays that meet every surface within its clear aperture; for the others, position, direction and path
        are meaningless.
    reached : (N,) ndarray of bool
        True for rays that meet every surface and are not totally reflected in glass, inside or outside the clear
        apertures.
    hits : (N, K, 3) ndarray
        Points on each of the K surfaces, metres, in the surface's own frame.
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    valid: np.ndarray
    reached: np.ndarray
    hits: np.ndarray


def direction_of(field: Field) -> np.ndarray:
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


def launch_rays(camera: Camera, field: Field = (0.0, 0.0), pupil: ArrayLike | None = None) -> tuple[np.ndarray, ...]:
    """Aim rays of a far point at points of the aperture stop.

    Parameters
    ----------
    camera : Camera
        Camera whose stop is aimed at.
    field : (float, float)
        Angles x and y of the far point, radians.
    pupil : (N, 2) array_like, optional
        N points of the stop in units of its radius, at most 1 from its middle; by default the 12 rings of 48 points of
        a quadrature.

    Returns
    -------
    tuple of (N, 3) ndarray
        Launch points on one plane wavefront, metres, and unit directions, in the camera's frame.

    Raises
    ------
    ValueError
        The points are not (N, 2), finite and within the stop, or no ray of the field reaches the stop.

    Examples
    --------
    The rim of a stop on the first mirror, along y:

    >>> mirror = OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.4)
    >>> position, direction = launch_rays(Camera([mirror], 550e-9), pupil=[(0, 1), (0, -1)])
    >>> np.round(position, 6) + 0.0
    array([[ 0. ,  0.2, -0.4],
           [ 0. , -0.2, -0.4]])
    >>> direction
    array([[0., 0., 1.],
           [0., 0., 1.]])
    """
    nodes = disk(RINGS)
    points = np.stack([nodes.x, nodes.y], axis=-1) if pupil is None else np.asarray(pupil, float)
    if points.ndim != 2 or points.shape[1] != 2 or not points.size or not np.all(np.isfinite(points)):
        raise ValueError(f"pupil must be finite points of shape (N, 2), N at least 1, got shape {points.shape}")
    farthest = float(np.max(np.hypot(*points.T)))
    if farthest > 1.0 + _RIM:
        raise ValueError(f"pupil must be points within the stop, at most 1 from its middle, got one at {farthest:.6g}")
    return _aimed(camera, field, points)


def _aimed(camera: Camera, field: Field, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return launch points and directions, (N, 3) each, of rays of a far point toward N points (N, 2) of the stop."""
    rim = camera._aperture
    light, target = direction_of(field), rim.radius * points + np.array(rim.centre)
    try:
        position, _ = aim_collimated(default_backend(), camera._systems[1], light, camera._launch, target)
    except AimError as error:
        raise LightLostError(f"no ray of the field {field} rad reaches surface {camera.stop}, the stop") from error
    return position[0], np.tile(light, (len(points), 1))


def trace(camera: Camera, position: ArrayLike, direction: ArrayLike) -> TracedRays:
    """Trace rays through the surfaces of a camera to its image plane.

    Parameters
    ----------
    camera : Camera
        Camera to trace through.
    position : (N, 3) array_like
        N launch points before the first surface, metres, in the camera's frame.
    direction : (N, 3) or (3,) array_like
        Directions of the light; they need not have unit length.

    Returns
    -------
    TracedRays
        The rays on the image plane.

    Raises
    ------
    ValueError
        The shapes differ from these, or a number is not finite.

    Examples
    --------
    A paraboloid brings light along its axis to its focus, with equal optical paths:

    >>> mirror = OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.4)
    >>> camera = Camera([mirror], wavelength=550e-9)
    >>> rays = trace(camera, [(0, 0, -1), (0, 0.1, -1), (0.2, 0, -1), (0.3, 0, -1)], (0, 0, 1))
    >>> rays.valid
    array([ True,  True,  True, False])
    >>> bool(np.max(np.abs(rays.position[:3, :2])) < 1e-15)
    True
    >>> rays.path[:3].round(12)
    array([3., 3., 3.])
    """
    start, light = np.atleast_2d(np.asarray(position, float)), np.asarray(direction, float)
    if start.ndim != 2 or start.shape[1] != 3 or not start.size or light.shape not in ((3,), start.shape):
        raise ValueError(
            f"position must be (N, 3), N at least 1, and direction (N, 3) or (3,), got {start.shape} and {light.shape}"
        )
    length = np.linalg.norm(light, axis=-1, keepdims=True)
    if not np.all(np.isfinite(start)) or not np.all(np.isfinite(length)) or not np.all(length > 0.0):
        raise ValueError("positions must be finite, and directions finite and not zero")
    system, elements = camera._systems[0], camera._assembly.sequence("image")
    sent = make_rays(default_backend(), start, np.broadcast_to(light / length, start.shape))
    traced = trace_systems(default_backend(), system, sent, keep=range(len(camera.surfaces)), world=True)
    place, leaving, path, reached = (array[0] for array in traced.numpy(traced.world))
    hits = np.stack([traced.hit(k)[0] for k in range(len(camera.surfaces))], axis=1)
    valid = reached
    for k, element in enumerate(elements[:-1]):
        valid = valid & element.clear(hits[:, k, 0], hits[:, k, 1])
    return TracedRays(place, leaving, path, valid, reached, hits)


def trace_stop(camera: Camera, field: Field, points: np.ndarray) -> TracedRays:
    """Trace rays of a far point through given points of the stop, whether or not an edge stops them.

    Parameters
    ----------
    camera : Camera
        Camera to trace through.
    field : (float, float)
        Angles x and y of the far point, radians.
    points : (N, 2) ndarray
        N points of the stop, in units of its radius.

    Raises
    ------
    LightLostError
        A ray within the rim of the stop misses a surface or is totally reflected.
    """
    rays = trace(camera, *_aimed(camera, field, points))
    if not np.all(rays.reached | (np.hypot(*points.T) > 1.0)):
        raise LightLostError(
            f"rays of the field {field} rad miss a surface or are totally reflected in glass; a smaller stop or field "
            "is needed"
        )
    return rays


def shadow_pieces(camera: Camera, field: Field, ring: bool = True) -> np.ndarray | None:
    """Return the polygons that together cover the part of the stop where edges block light, or None if none do.

    Parameters
    ----------
    camera : Camera
        Camera with the edges; the rim of the stop is not one of them.
    field : (float, float)
        Angles x and y of the far point, radians.
    ring : bool
        Include the hole of the stop itself (its ``inner_diameter``).

    Returns
    -------
    (1, K, V, 2) ndarray or None
        K polygons of V corners (x, y), in units of the stop's radius, with a first axis of length 1 (one camera), as
        the functions on batches of polygons expect it.
    """
    every = {f"s{k}": s.edges(k != camera.stop, k != camera.stop or ring) for k, s in enumerate(camera.surfaces)}
    edges = {name: own for name, own in every.items() if own}
    if not edges:
        return None
    nodes = disk(RINGS)
    hits = trace_stop(camera, field, np.stack([nodes.x, nodes.y], axis=-1)).hits
    places = {name: hits[None, :, int(name[1:]), :2] for name in edges}
    pieces, _ = converged_shadows(SurfaceEdges(edges, places, nodes).outlines, 1)
    return pieces if pieces.shape[1] else None


def light_nodes(camera: Camera, field: Field, phase: float) -> PupilNodes:
    """Return quadrature nodes and weights over the part of the stop that light passes.

    Parameters
    ----------
    camera : Camera
        Camera with the stop.
    field : (float, float)
        Angles x and y of the far point, radians.
    phase : float
        Largest change of the integrand's phase from the middle of the stop to its rim, radians; more phase needs more
        nodes.

    Returns
    -------
    PupilNodes
        Nodes in units of the stop's radius; weights may be negative where a shadow is subtracted.

    Raises
    ------
    ValueError
        No light of the field comes through, or the phase needs more nodes than memory allows.
    """
    rings, arms = disk_size(phase)
    if rings * arms > _MOST_NODES:
        raise ValueError(
            f"the phase runs over {phase:.3g} rad in the pupil, which takes more than {_MOST_NODES} rays; "
            "ask for a smaller image or a camera nearer to its focus"
        )
    stop = camera.surfaces[camera.stop]
    if shadow_pieces(camera, field, ring=False) is None:
        return disk(max(rings, RINGS), max(arms, 4 * RINGS), stop.inner_diameter / stop.diameter)
    pieces = shadow_pieces(camera, field)
    assert pieces is not None
    light = IlluminatedStop.of(pieces, max(rings, arms // 4 + 1, RINGS), nodes_for(0.5 * phase, 6))
    if not light.light[0] > 1e-6:
        raise LightLostError(f"edges of the surfaces stop all light of the field {field} rad")
    return PupilNodes(light.x[0], light.y[0], light.weight[0])


def chief_point(camera: Camera, field: Field) -> np.ndarray:
    """Return the point where a field's chief ray meets the image plane, (3,), metres, even if an edge blocks it."""
    return np.asarray(trace_stop(camera, field, np.zeros((1, 2))).position[0])


def spot_radius(camera: Camera, field: Field = (0.0, 0.0)) -> float:
    """Return the rms radius of the geometrical spot about its centroid, in metres.

    Parameters
    ----------
    camera : Camera
        Camera whose image plane the spot lies on.
    field : (float, float)
        Angles x and y of the far point, radians.

    Returns
    -------
    float
        Rms distance of the rays from their centroid, metres; the light is spread evenly over the stop.

    Raises
    ------
    ValueError
        No light of the field comes through.

    Examples
    --------
    The tangential coma of a paraboloid is 3 theta / (16 F^2); its rms spot is sqrt(2/3)/3 = 0.272 of that:

    >>> mirror = OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.2)
    >>> camera = Camera([mirror], wavelength=550e-9)
    >>> theta = 1e-3
    >>> coma = 3 * theta / (16 * camera.f_number**2) * camera.focal_length
    >>> round(spot_radius(camera, (0, theta)) / coma, 2)
    0.27
    >>> bool(spot_radius(camera) < 1e-15)
    True
    """
    nodes = light_nodes(camera, field, 0.0)
    rays = trace_stop(camera, field, np.stack([nodes.x, nodes.y], axis=-1))
    offset = rays.position[:, :2] - nodes.share @ rays.position[:, :2]
    return float(np.sqrt(max(nodes.share @ np.sum(offset**2, axis=-1), 0.0)))


def distortion(camera: Camera, fields: ArrayLike) -> np.ndarray:
    """Return the distortion of chief rays, relative to the image without distortion.

    Parameters
    ----------
    camera : Camera
        Camera with a focal length.
    fields : (F, 2) array_like
        Angles x and y of F far points, radians; none on the axis, where distortion is not defined.

    Returns
    -------
    (F,) ndarray
        (r - f tan w) / (f tan w), with r the distance of the chief ray from that of the axis on the image plane, f the
        focal length and w the angle from the axis; positive for a pincushion.

    Raises
    ------
    ValueError
        The fields have another shape or lie on the axis, no light reaches the stop, or the camera is afocal.

    Examples
    --------
    With the stop on a single mirror chief rays go on under the angle of incidence, so that there is none:

    >>> mirror = OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.2)
    >>> bool(np.max(np.abs(distortion(Camera([mirror], 550e-9), [(0, 0.01), (0.02, 0)]))) < 1e-12)
    True
    """
    angles = np.asarray(fields, float)
    if angles.ndim != 2 or angles.shape[1] != 2 or not np.all(np.any(angles != 0.0, axis=-1)):
        raise ValueError(f"fields must be (F, 2) angles off the axis, got {np.asarray(fields).tolist()}")
    if camera.is_afocal:
        raise ValueError("the camera is afocal: distortion needs a focal length")
    middle = chief_point(camera, (0.0, 0.0))
    radius = np.array([np.linalg.norm(chief_point(camera, (x, y)) - middle) for x, y in angles])
    ideal = camera.focal_length * np.hypot(*np.tan(angles.T))
    return np.asarray(radius / ideal - 1.0)
