"""Wavefront error, point spread function and MTF of a camera at a point of its field.

Light is blocked by the edges of all surfaces: holes, obscurations, vanes of spiders and rims that vignette. A pupil
whose only edge is a hole about the middle of the stop is integrated exactly; other edges are represented by polygons of
the same area on the stop.

Rays through a camera: launched at points of its stop, traced to its image plane, counted into spots and distortion.

A field is a pair of angles (x, y) in radians: its light travels along (tan x, tan y, 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from optics.camera.prescription import Camera
from optics.geometry import zernike
from optics.geometry.polygon import covered
from optics.numerics.array_math import PhysicalError, UnphysicalError
from optics.numerics.backend import default_backend
from optics.numerics.quadrature import PupilNodes, disk, disk_size, nodes_for
from optics.raytrace.aim import AimError, direction_of
from optics.raytrace.first_order import first_order
from optics.raytrace.trace import make_rays
from optics.raytrace.trace import trace as trace_systems
from optics.waves.diffraction import Grid, PupilField, image
from optics.waves.edge_shadow import IlluminatedStop, SurfaceEdges, converged_shadows
from optics.waves.imaging import aim_collimated, fit_part, imaging_rays, path_to_sphere, pupil_field
from optics.waves.optical_transfer import transfer, with_enough_nodes
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_stack import DEGREE, VIGNETTED_RINGS, PupilFunction, fit_pupils

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
    end, leaving, path, reached = (array[0] for array in traced.numpy(traced.world))
    hits = np.stack([traced.hit(k)[0] for k in range(len(camera.surfaces))], axis=1)
    valid = reached
    for k, element in enumerate(elements[:-1]):
        valid = valid & element.clear(hits[:, k, 0], hits[:, k, 1])
    return TracedRays(end, leaving, path, valid, reached, hits)


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
    outlines = {f"s{k}": s.edges(k != camera.stop, k != camera.stop or ring) for k, s in enumerate(camera.surfaces)}
    edges = {name: outline for name, outline in outlines.items() if outline}
    if not edges:
        return None
    nodes = disk(RINGS)
    hits = trace_stop(camera, field, np.stack([nodes.x, nodes.y], axis=-1)).hits
    crossings = {name: hits[None, :, int(name[1:]), :2] for name in edges}
    pieces, _ = converged_shadows(SurfaceEdges(edges, crossings, nodes).outlines, 1)
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


_STATISTICS_PHASE = 36.0
"""Assumed change of phase from the middle to the rim of the stop, radians, when an rms wavefront error is computed.

It determines the number of quadrature nodes: twelve rings, enough to integrate the square of a smooth wavefront error.
"""


Spectrum = Mapping[float, float]
"""Wavelength, metres -> its weight in the light."""


@dataclass(frozen=True, eq=False)
class Wavefront:
    """Wavefront error of a camera at one field point, piston and tilt removed.

    Attributes
    ----------
    x, y : (N,) ndarray
        N points of the stop in units of its radius.
    weight : (N,) ndarray
        Quadrature weights of a mean over the part of the stop that light passes, which sum to 1; negative where the
        part that an edge blocks is subtracted.
    error : (N,) ndarray
        Wavefront error, metres, positive where the wavefront is ahead of the reference sphere.
    coefficients : (J,) ndarray
        Coefficients of J terms in Noll's order that are orthonormal over the light, metres rms: Zernike's over a clear
        pupil, annular ones over a ring. Their squares and that of the residual add up to the square of ``rms``.
    rms : float
        Root mean square of the error, metres.
    residual_rms : float
        Root mean square of the error that remains after the terms are subtracted, metres.
    strehl : float
        Strehl ratio: intensity at the reference point over that of the same light without error.
    light : float
        Fraction of the stop's area that light passes, 0 to 1.
    """

    x: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    error: np.ndarray
    coefficients: np.ndarray
    rms: float
    residual_rms: float
    strehl: float
    light: float


def _chief(camera: Camera, field: Field) -> tuple[np.ndarray, float]:
    """Return the chief ray's point on the image plane, (3,), and the distance from it back to the exit pupil, metres.

    The chief ray passes through the middle of the stop.
    """
    if camera.is_afocal:
        raise UnphysicalError("the camera is afocal: parallel light leaves it parallel, so that it makes no image")
    launch, direction = (array[0] for array in launch_rays(camera, field, np.zeros((1, 2))))
    distance = first_order(camera._matrix(launch, direction)).exit_pupil_distance
    return chief_point(camera, field), float(distance[0])


def wavefront(camera: Camera, field: Field = (0.0, 0.0), terms: int = 28) -> Wavefront:
    """Compute the wavefront error against the sphere about the image of the chief ray.

    Parameters
    ----------
    camera : Camera
        Camera in the light of its wavelength.
    field : (float, float)
        Angles x and y of the far point, radians.
    terms : int
        Number of Zernike terms, 3 to 66.

    Returns
    -------
    Wavefront
        The error at points of the stop that light passes, its Zernike coefficients and statistics. Defocus is part of
        it.

    Raises
    ------
    ValueError
        No light of the field comes through, or the number of terms is out of its range.

    Notes
    -----
    The reference sphere passes through the middle of the exit pupil. The statistics are those of a Gauss quadrature,
    which ends at the edges of the light.

    Examples
    --------
    A mirror whose figure is wrong by 1/28 wave rms has a wavefront error of 1/14 wave and, by Marechal's rule, a Strehl
    ratio of 0.8:

    >>> from dataclasses import replace
    >>> wave = 550e-9
    >>> bent = OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.4, figure={11: wave / 28})
    >>> error = wavefront(Camera([bent], wave))
    >>> round(error.rms / wave * 14, 2), round(error.strehl, 2)
    (1.0, 0.82)
    >>> zernike_name(int(np.argmax(np.abs(error.coefficients))) + 1)
    'spherical aberration'

    Over a ring the coefficients are means of the error times annular Zernike terms:

    >>> ring = replace(bent, inner_diameter=0.1, figure={})
    >>> error = wavefront(Camera([ring], wave), field=(0.0, 2e-3))
    >>> coma = annular_zernike(7, error.x, error.y, inner=0.25)
    >>> bool(abs(error.weight @ (error.error * coma) - error.coefficients[6]) < 1e-15)
    True

    At the rim, at r from the axis, a spherical mirror of radius R is ahead of its paraxial sphere by r^4 / (4 R^3) of
    path, and the Zernike term of spherical aberration is 1 / (6 sqrt(5)) of that:

    >>> sphere = OpticalSurface(-4.0, -2.0, 0.0, "mirror", diameter=0.2)
    >>> w040 = 0.1**4 / (4 * 4.0**3)
    >>> round(float(wavefront(Camera([sphere], wave)).coefficients[10] / (w040 / (6 * 5**0.5))), 2)
    1.0
    """
    if not 3 <= terms <= zernike.MAX_NOLL:
        raise ValueError(f"terms must be between 3 and {zernike.MAX_NOLL}, got {terms}")
    nodes = light_nodes(camera, field, _STATISTICS_PHASE)
    origin, radius = _chief(camera, field)
    points = np.concatenate([np.zeros((1, 2)), np.stack([nodes.x, nodes.y], axis=-1)])
    rays = trace_stop(camera, field, points)
    path = path_to_sphere(rays.position, rays.direction, rays.path, origin, radius)
    error = -(path[1:] - path[0]) / camera.wavelength
    fit = fit_part(nodes.x, nodes.y, nodes.weight, error, terms)
    flat = error - zernike.basis(3, nodes.x, nodes.y) @ fit.level
    wave, light = camera.wavelength, float(np.sum(nodes.weight) / np.pi)
    sizes = wave * flat, wave * fit.parts, wave * fit.rms, wave * fit.residual_rms
    return Wavefront(nodes.x, nodes.y, nodes.share, *sizes, fit.strehl, light)


@dataclass(frozen=True, eq=False)
class Fans:
    """Rays through two diameters of the stop, along x and along y, at a point of the field.

    Attributes
    ----------
    pupil : (N,) ndarray
        Coordinates of the N rays of a fan, in units of the stop's radius.
    transverse : (2, 2, N) ndarray
        Positions on the image plane minus that of the chief ray, metres: fan (x, y), direction (x, y), ray; nan where
        edges stop the ray.
    path : (2, N) ndarray
        Wavefront error against the chief ray, metres, positive where the wavefront is ahead: fan, ray; nan as above.
    """

    pupil: np.ndarray
    transverse: np.ndarray
    path: np.ndarray


def ray_fans(camera: Camera, field: Field = (0.0, 0.0), pupil: ArrayLike | None = None) -> Fans:
    """Trace the ray fans and the fans of optical path difference (OPD) at a point of the field.

    Parameters
    ----------
    camera : Camera
        Camera in the light of its wavelength.
    field : (float, float)
        Angles x and y of the far point, radians.
    pupil : (N,) array_like, optional
        Coordinates along each diameter of the stop, from -1 to 1; by default 41 in equal steps.

    Returns
    -------
    Fans
        Positions and wavefront errors of the rays; the reference sphere is that of `wavefront`, with tilt.

    Raises
    ------
    ValueError
        The coordinates are not (N,) and within the stop, or no light of the field comes through.

    Examples
    --------
    A spherical mirror with its image plane at the paraxial focus has the transverse aberration (y / R)^2 y / 2:

    >>> sphere = OpticalSurface(-4.0, -2.0, 0.0, "mirror", diameter=0.2)
    >>> fans = ray_fans(Camera([sphere], 550e-9), pupil=[-1, 0, 0.4, 1])
    >>> (fans.transverse[1, 1] / (0.1**3 / 4.0**2 / 2)).round(2) + 0.0
    array([ 1.  ,  0.  , -0.06, -1.  ])
    """
    shares = np.linspace(-1.0, 1.0, 41) if pupil is None else np.asarray(pupil, float)
    if shares.ndim != 1 or not shares.size or not np.all(np.abs(shares) <= 1.0):
        raise ValueError(f"pupil must be coordinates of shape (N,) from -1 to 1, got shape {shares.shape}")
    origin, radius = _chief(camera, field)
    inside = (1.0 - _RIM) * shares[:, None]  # rounding would put rays of the rim beyond it
    rays = trace_stop(camera, field, np.concatenate([np.zeros((1, 2)), *(inside * axis for axis in np.eye(2))]))
    place = camera._image_pose.inverse().apply(rays.position)[:, :2]
    path = path_to_sphere(rays.position, rays.direction, rays.path, origin, radius)
    ahead, step = path[0] - path[1:], place[1:] - place[0]
    ahead[~rays.valid[1:]], step[~rays.valid[1:]] = np.nan, np.nan
    return Fans(shares, np.moveaxis(step.reshape(2, -1, 2), 2, 1), ahead.reshape(2, -1))


def _colours(camera: Camera, spectrum: Spectrum | None) -> list[tuple[Camera, float]]:
    """Return pairs of the camera at a wavelength of a spectrum and the weight of that wavelength; weights sum to 1."""
    shares = {camera.wavelength: 1.0} if spectrum is None else spectrum
    total = sum(shares.values())
    if not total > 0.0 or min(shares.values()) < 0.0:
        raise ValueError("a spectrum must have weights that are not negative, and one that is positive")
    return [(camera.at(wavelength), share / total) for wavelength, share in shares.items()]


def _field_at(camera: Camera, field: Field, nodes: PupilNodes, origin: np.ndarray) -> PupilField:
    """Return the plane waves whose interference gives the light's amplitude near a point of the image plane.

    There is one wave for each node of the stop, ``origin`` (3,) is the point, metres in the camera's frame, and the
    total power is 1.
    """
    imaging, to_stop = camera._systems
    rays = imaging_rays(
        default_backend(), imaging, to_stop, direction_of(field), camera._launch, camera._aperture, nodes
    )
    return pupil_field(rays, camera.wavelength, camera._image_pose.inverse().apply(origin))


def psf(
    camera: Camera, step: float, count: int = 129, field: Field = (0.0, 0.0), spectrum: Spectrum | None = None
) -> np.ndarray:
    """Compute the point spread function on the image plane by diffraction.

    Parameters
    ----------
    camera : Camera
        Camera whose wavelength is used by default.
    step : float
        Distance between samples, metres.
    count : int
        Number of samples along each axis; the chief ray's image point is in the middle of the grid.
    field : (float, float)
        Angles x and y of the far point, radians.
    spectrum : mapping of float to float, optional
        Wavelength in metres -> its weight in the light, ``{camera.wavelength: 1.0}`` by default; the grid is about the
        chief ray of ``camera.wavelength`` for all of them.

    Returns
    -------
    (N, N) ndarray
        With N = ``count``: irradiance, 1/m^2, of unit power through the pupil; rows along y, columns along x. Times
        ``step**2`` it sums to the share of the light that falls on the grid.

    Raises
    ------
    ValueError
        The grid is not positive, no light of the field comes through, or the image is too far out of focus.

    Notes
    -----
    The sum over plane waves from all points of the pupil is a matrix Fourier transform (Soummer et al., Opt. Express
    15, 15935, 2007) from the nodes of a Gauss quadrature, without a pixel raster in the pupil.

    Examples
    --------
    The image of a perfect circular pupil is the Airy pattern, whose peak is pi / (4 lambda^2 N^2) for unit power and
    whose first dark ring has the radius 1.22 lambda N:

    >>> camera = Camera([OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.2)], 500e-9)
    >>> pixel = 0.1 * 500e-9 * camera.f_number
    >>> image = psf(camera, pixel, 41)
    >>> round(float(image.max()) * 4 / np.pi * (500e-9 * camera.f_number) ** 2, 2)
    1.0
    >>> x = pixel * (np.arange(41) - 20)
    >>> bool(np.max(np.abs(image[20] / image.max() - airy(x, 500e-9, camera.f_number))) < 2e-3)
    True
    >>> int(np.argmin(image[20, 20:])) / 10
    1.2
    """
    if not 0.0 < step < np.inf or count < 1:
        raise ValueError(f"step must be positive, in metres, and count at least 1, got {step} and {count}")
    origin, _ = _chief(camera, field)
    grid = Grid(-0.5 * (count - 1) * step, step, int(count))
    out = np.zeros((count, count))
    for colour, share in _colours(camera, spectrum):
        # how far the phase runs over the pupil: in the corners of the image, and of the wavefront error
        path = 0.55 / colour.f_number * np.sqrt(0.5) * step * count + np.ptp(wavefront(colour, field, 3).error)
        nodes = light_nodes(colour, field, float(2.0 * np.pi / colour.wavelength * path))
        out += share * image(_field_at(colour, field, nodes, origin), grid, grid)[0]
    return out


def _pupil(camera: Camera, field: Field, origin: np.ndarray) -> PupilFunction:
    """Return the exit pupil as seen from a point ``origin`` (3,) of the image plane, without the parts edges block."""
    pieces = shadow_pieces(camera, field)
    nodes = disk(VIGNETTED_RINGS if pieces is not None else 12)
    traced = _field_at(camera, field, nodes, origin)
    if pieces is None:
        return fit_pupils(traced, nodes)[0]
    illuminated = ~covered(pieces, np.stack([nodes.x, nodes.y], axis=-1), SMALLEST)
    return with_enough_nodes(fit_pupils(traced, nodes, DEGREE, pieces, illuminated)[0], camera.wavelength)


def mtf(
    camera: Camera,
    frequency: ArrayLike,
    field: Field = (0.0, 0.0),
    azimuth: float = 0.0,
    spectrum: Spectrum | None = None,
) -> np.ndarray:
    """Compute the modulation transfer function on the image plane.

    Parameters
    ----------
    camera : Camera
        Camera whose wavelength is used by default.
    frequency : (M,) array_like
        M spatial frequencies, cycles per metre; their sign has no meaning.
    field : (float, float)
        Angles x and y of the far point, radians.
    azimuth : float
        Direction in which the pattern varies, from x toward y, radians.
    spectrum : mapping of float to float, optional
        Wavelength in metres -> its weight in the light, ``{camera.wavelength: 1.0}`` by default.

    Returns
    -------
    (M,) ndarray
        Modulation, 1 at zero frequency and 0 beyond the cut-off.

    Raises
    ------
    ValueError
        The frequencies are not (M,) and finite, or no light of the field comes through.

    Notes
    -----
    The autocorrelation of the pupil (Hopkins, Proc. R. Soc. A 231, 91, 1955) is integrated over the exact overlap; with
    edges in the beam it is right to about 1e-3.

    Examples
    --------
    At half its cut-off 1 / (lambda N) a perfect circular pupil has an MTF of 0.391:

    >>> camera = Camera([OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.2)], 500e-9)
    >>> cutoff = 1 / (500e-9 * camera.f_number)
    >>> mtf(camera, [0, 0.5 * cutoff, 1.01 * cutoff]).round(3)
    array([1.   , 0.391, 0.   ])
    """
    cycles = np.atleast_1d(np.asarray(frequency, float))
    if cycles.ndim != 1 or not np.all(np.isfinite(cycles)):
        raise ValueError(f"frequency must be finite and of shape (M,), got shape {np.shape(frequency)}")
    origin, _ = _chief(camera, field)
    both = cycles[:, None] * np.array([np.cos(azimuth), np.sin(azimuth)])
    total = np.zeros(len(both), complex)
    for colour, share in _colours(camera, spectrum):
        total += share * transfer(_pupil(colour, field, origin), both, colour.wavelength, np.zeros(1))[0]
    return np.asarray(np.abs(total))
