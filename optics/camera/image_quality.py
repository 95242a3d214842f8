"""Wavefront error, point spread function and MTF of a camera at a point of its field.

Light is blocked by the edges of all surfaces: holes, obscurations, vanes of spiders and rims that vignette. A pupil
whose only edge is a hole about the middle of the stop is integrated exactly; other edges are represented by polygons of
the same area on the stop.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from optics.camera.prescription import Camera
from optics.camera.ray_bundle import (
    Field,
    chief_point,
    direction_of,
    launch_rays,
    light_nodes,
    shadow_pieces,
    trace_stop,
)
from optics.geometry import zernike
from optics.geometry.polygon import covered
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import default_backend
from optics.numerics.quadrature import PupilNodes, disk
from optics.raytrace.first_order import first_order
from optics.waves.diffraction import Grid, PupilField, image
from optics.waves.imaging import fit_part, imaging_rays, path_to_sphere, pupil_field
from optics.waves.optical_transfer import transfer, with_enough_nodes
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_stack import DEGREE, VIGNETTED_RINGS, PupilFunction, fit_pupils

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
    lit = ~covered(pieces, np.stack([nodes.x, nodes.y], axis=-1), SMALLEST)
    return with_enough_nodes(fit_pupils(traced, nodes, DEGREE, pieces, lit)[0], camera.wavelength)


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
