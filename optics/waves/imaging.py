"""Pupil fields and wavefronts of a camera that looks at a far point.

The beam is collimated and of uniform irradiance. Rays are aimed at quadrature nodes of the stop, so that its edge is
exact in every state. With p the launch point on the incoming plane wavefront, s the point of the stop and (u, v) the
direction cosines at the detector, power conservation |a|^2 du dv = dp / A makes the amplitude a of a node

    a du dv = sqrt(|d(u, v)/dp| / A) * |dp/ds| * ds,    A = sum |dp/ds| ds,

with A the area of the beam and both Jacobians by forward-mode AD through the trace. Paths count from the incoming
wavefront. The pupil field is what ``optics.waves.diffraction.image`` turns into an image.

Wavefronts of a traced bundle: eikonal at the image point, optical path difference on the exit pupil, Zernike fits.

Numbers of a sampled point spread function, and the diffraction limit of round pupils with a central obscuration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from optics.geometry import zernike
from optics.geometry.aperture import Circle
from optics.numerics.arguments import finite
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.system import SystemBatch
from optics.raytrace.trace import jvp, require_rays
from optics.waves.diffraction import PupilField


def eikonal(position: np.ndarray, direction: np.ndarray, path: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return each ray's eikonal: the optical path to its plane wave through the point ``origin``.

    It is path - direction . (position - origin).

    Parameters
    ----------
    position : (..., N, 3) ndarray
        Points of N rays at which the paths are given, metres (image space, index 1).
    direction : (..., N, 3) ndarray
        Unit directions.
    path : (..., N) ndarray
        Optical paths, metres.
    origin : ndarray
        Image point, broadcastable to (..., 1, 3), metres.

    Returns
    -------
    (..., N) ndarray
        Eikonal, metres.
    """
    return np.asarray(path - np.sum(direction * (position - origin), axis=-1))


def path_to_sphere(
    position: np.ndarray, direction: np.ndarray, path: np.ndarray, origin: np.ndarray, radius: float = np.inf
) -> np.ndarray:
    """Return the optical path of each ray to a sphere about ``origin``, plus the sphere's radius.

    Parameters
    ----------
    position : (..., N, 3) ndarray
        Points of N rays near the image, metres.
    direction : (..., N, 3) ndarray
        Unit directions there.
    path : (..., N) ndarray
        Optical paths to ``position``, metres.
    origin : ndarray
        Image point, broadcastable to (..., 1, 3), metres.
    radius : float
        Radius of the sphere, metres, positive when the exit pupil lies upstream; for an infinite one the result is the
        ``eikonal``.

    Returns
    -------
    (..., N) ndarray
        Optical path, metres.
    """
    offset = position - origin
    along = np.sum(direction * offset, axis=-1)
    # path back to the sphere minus the radius, written so that nothing cancels and an infinite radius is allowed
    term = along**2 - np.sum(offset**2, axis=-1)
    back = along if np.isinf(radius) else along + term / (radius + np.sign(radius) * np.sqrt(radius**2 + term))
    return np.asarray(path - back)


def orthonormal_rows(x: np.ndarray, y: np.ndarray, weight: np.ndarray, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix from values on a part of the unit disk to Zernike terms made orthonormal over it.

    The terms are made orthonormal one after the other (Gram-Schmidt, as for annular pupils: Mahajan, J. Opt. Soc. Am.
    71, 75, 1981). Over the whole disk they are the Zernike terms themselves. Over a part of it fitted coefficients are
    not contributions to the rms: two terms that are similar there may each be larger than the whole.

    Parameters
    ----------
    x, y : (N,) ndarray
        Pupil coordinates of N points near the unit disk.
    weight : (N,) ndarray
        Quadrature weights with a positive sum; negative where shadows are subtracted.
    last : int
        Highest Noll index.

    Returns
    -------
    rows : (last, N) ndarray
        Matrix from values at the points to their means with the orthonormal terms.
    root : (last, last) ndarray
        Lower triangular matrix from the orthonormal terms to the Zernike terms.

    Raises
    ------
    UnphysicalError
        The terms are not positive definite over the quadrature: too few nodes, or almost no area.
    """
    basis, share = zernike.basis(last, x, y), weight / np.sum(weight)
    independent = UnphysicalError(f"{last} Zernike terms are not independent over the light that comes through")
    if np.all(share >= 0.0):
        q, r = np.linalg.qr(basis * np.sqrt(share)[:, None])
        if len(r) < last or not np.min(np.abs(np.diag(r))) > DEPENDENT:
            raise independent
        sign = np.sign(np.diag(r))[:, None]
        return sign * q.T * np.sqrt(share), (sign * r).T
    try:
        root = np.linalg.cholesky(basis.T @ (share[:, None] * basis))
    except np.linalg.LinAlgError as error:
        raise independent from error
    return np.linalg.solve(root, basis.T * share), root


DEPENDENT = 1e-12
"""Rms of the part of a Zernike term that the terms before it do not explain, below which it is rounding."""


@dataclass(frozen=True, eq=False)
class PartFit:
    """Fit of Zernike terms to a wavefront over a part of the unit disk, after removal of piston and tilt.

    Attributes
    ----------
    level : (3,) ndarray
        Piston and the two tilts that were removed, coefficients of Z1 to Z3, in the unit of the path differences
        (waves).
    coefficients : (last,) ndarray
        Least-squares coefficients of the Zernike terms in Noll's order, waves rms over the whole disk; terms that are
        similar over the part are correlated.
    parts : (last,) ndarray
        Contributions of the terms to the rms, waves, after they are made orthonormal over the part one after the other.
    rms : float
        Rms of the path differences without piston and tilt, waves.
    residual_rms : float
        Rms of the path differences minus the fit, waves.
    strehl : float
        Strehl ratio: squared modulus of the mean of exp(2 pi i times the path difference in waves).
    """

    level: np.ndarray
    coefficients: np.ndarray
    parts: np.ndarray
    rms: float
    residual_rms: float
    strehl: float


def fit_part(x: np.ndarray, y: np.ndarray, weight: np.ndarray, difference: np.ndarray, last: int = 28) -> PartFit:
    """Fit Z1..Z_last to a wavefront over a part of the unit disk, or all of it.

    The quadrature weights may be negative, where shadows are subtracted.

    Parameters
    ----------
    x, y : (N,) ndarray
        Pupil coordinates of N rays near the unit disk.
    weight : (N,) ndarray
        Area weights, with a positive sum.
    difference : (N,) ndarray
        Optical path differences, waves.
    last : int
        Highest Noll index.

    Raises
    ------
    UnphysicalError
        The terms are not positive definite over the quadrature: too few nodes, or almost no area.
    """
    share = weight / np.sum(weight)
    basis = zernike.basis(last, x, y)
    rows, root = orthonormal_rows(x, y, weight, 3)
    level = np.linalg.solve(root.T, rows @ difference)
    flat = difference - basis[:, :3] @ level
    rows, root = orthonormal_rows(x, y, weight, last)
    parts = rows @ flat
    coefficients = np.linalg.solve(root.T, parts)
    square = float(share @ flat**2)
    residual = float(share @ (flat - basis @ coefficients) ** 2)
    phasor = share @ np.exp(2j * np.pi * flat)
    rms, rest = (float(np.sqrt(max(mean_square, 0.0))) for mean_square in (square, residual))
    return PartFit(level, coefficients, parts, rms, rest, float(abs(phasor) ** 2))


AIM_TOLERANCE = 1e-12
"""Largest distance of an aimed ray from its node on the stop, metres."""


def aim_collimated(
    backend: Backend,
    to_stop: SystemBatch,
    direction: np.ndarray,
    launch: np.ndarray,
    target: np.ndarray,
    first: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Aim rays of collimated beams at given points of the stop.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    to_stop : SystemBatch
        B systems from the scene to the stop, their last element.
    direction : (3,) or (B, 3) ndarray
        Unit direction of the light in the world frame.
    launch : (3,) or (B, 3) ndarray
        World point of the beam before the first mirror, metres; rays start on the plane wavefront through it.
    target : (N, 2) or (B, N, 2) ndarray
        Stop coordinates of N rays, common or of each system, metres at its nominal size.
    first : (3,) ndarray, optional
        World vector near which the first axis of the wavefront lies, not along the beam; by default the coordinate axis
        least aligned with it, which is not the same for all directions.

    Returns
    -------
    launched : (B, N, 3) ndarray
        Launch points in the world frame, metres.
    axes : (B, 2, 3) ndarray
        The two axes of the wavefront.

    Raises
    ------
    AimError
        The beam does not reach the stop.
    """
    count = to_stop.count
    along = np.broadcast_to(direction, (count, 3))[:, None]
    origin = np.broadcast_to(launch, (count, 3))[:, None]
    # for aiming any transverse axis will do; the coordinate axis least along the beam is well conditioned
    least = np.eye(3)[np.argmin(np.abs(along), axis=-1)]
    across = least if first is None else np.broadcast_to(first, along.shape)
    axes = transverse_axes(along, across)
    fan = RayFan(origin, along, axes, moves_position=True)
    middle, slope = aim(backend, to_stop, fan, np.zeros((1, 2)), tolerance=AIM_TOLERANCE)
    subscripts = "bnij,pj->bpi" if target.ndim == 2 else "bnij,bpj->bpi"
    initial = middle + np.einsum(subscripts, np.linalg.inv(slope), target)
    q, _ = aim(backend, to_stop, fan, target, initial, slope, AIM_TOLERANCE)
    return fan.at(q)[0], axes[:, 0]


@dataclass(frozen=True, eq=False)
class ImagingRays:
    """Rays of collimated beams at the detector of B systems, N nodes of the stop each.

    Attributes
    ----------
    position, direction : (B, N, 3) ndarray
        Positions (metres) and unit directions in the detector's frame.
    path : (B, N) ndarray
        Optical path from the incoming wavefront, metres.
    amplitude : (B, N) ndarray
        Amplitude times area in direction cosines (a du dv of the module's formula); 0 where another aperture blocks the
        ray.
    launched : (B, N, 3) ndarray
        Points of the incoming wavefront in the world frame, metres.
    launch_area : (B, N) ndarray
        Area of the incoming wavefront that belongs to each node, m^2.
    axes : (B, 2, 3) ndarray
        Axes of the wavefront in the world frame.
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    amplitude: np.ndarray
    launched: np.ndarray
    launch_area: np.ndarray
    axes: np.ndarray


def imaging_rays(
    backend: Backend,
    systems: SystemBatch,
    to_stop: SystemBatch,
    direction: np.ndarray,
    launch: np.ndarray,
    stop: Circle,
    nodes: PupilNodes,
    first: np.ndarray | None = None,
) -> ImagingRays:
    """Trace the beams of B systems that image a far point.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    systems : SystemBatch
        B systems from the scene to the detector.
    to_stop : SystemBatch
        The same systems, only as far as the stop.
    direction : (3,) or (B, 3) ndarray
        Unit direction of the light in the world frame.
    launch : (3,) or (B, 3) ndarray
        World point of the beam before the first mirror, metres.
    stop : Circle
        Clear aperture of the stop.
    nodes : PupilNodes
        N nodes of a quadrature over the unit disk.
    first : (3,) ndarray, optional
        World vector near which the first axis of the wavefront lies; by default the coordinate axis least aligned with
        the beam.

    Raises
    ------
    AimError
        The beam does not reach the stop.
    BeamMissedError
        No ray reaches the detector.
    """
    target = stop.radius * np.stack([nodes.x, nodes.y], axis=-1) + np.array(stop.centre)
    launched, axes = aim_collimated(backend, to_stop, direction, launch, target, first)
    count = len(launched)
    heading = np.broadcast_to(np.broadcast_to(direction, (count, 3))[:, None], launched.shape)
    stop_index = len(to_stop.structure) - 1
    # every ray twice, once for each axis of the wavefront along which its launch point is moved
    twice, heading = (np.repeat(array, 2, axis=1) for array in (launched, heading))
    moves = np.broadcast_to(axes[:, None], (*launched.shape[:2], 2, 3)).reshape(twice.shape)
    out = jvp(backend, systems, twice, heading, moves, keep=(stop_index,))
    hit, step = (
        np.swapaxes(step[..., :2].reshape(*launched.shape[:2], 2, 2), -1, -2)
        for step in (out.hits[stop_index], out.direction)
    )
    position, leaving, path, valid = (array[:, ::2] for array in out.traced.numpy())
    require_rays(valid, "the imaging path")
    launch_area = (to_stop.size[:, None] * stop.radius) ** 2 * nodes.weight / np.abs(np.linalg.det(hit))
    amplitude = np.sqrt(np.abs(np.linalg.det(step)) / np.sum(launch_area, axis=-1, keepdims=True)) * launch_area * valid
    return ImagingRays(position, leaving, path, amplitude, launched, launch_area, axes)


def pupil_field(
    rays: ImagingRays,
    wavelength: float,
    origin: np.ndarray | None = None,
    incoming: Callable[[np.ndarray], np.ndarray] | None = None,
) -> PupilField:
    """Return the plane waves at the detector that traced beams form.

    Parameters
    ----------
    rays : ImagingRays
        B traced beams of N rays each.
    wavelength : float
        Wavelength, metres.
    origin : (3,) or (B, 3) ndarray, optional
        Image point about which the field is computed, in the detector's frame, metres; 0 by default.
    incoming : callable, optional
        Optical path of the incoming beam beyond that of a plane wave, (B, N) metres, at transverse coordinates (B, N,
        2) from the middle of the entrance pupil along the two axes of ``aim_collimated``.

    Returns
    -------
    PupilField
        Field of unit power through the stop if no other aperture vignettes the beam; nodes that another aperture blocks
        have zero amplitude.
    """
    centre = np.zeros((1, 1, 3)) if origin is None else np.broadcast_to(origin, (len(rays.path), 3))[:, None]
    leaving = rays.direction
    phase = eikonal(rays.position, leaving, rays.path, centre)
    if incoming is not None:
        area, launched = rays.launch_area, rays.launched
        middle = np.einsum("bn,bnx->bx", area, launched) / np.sum(area, axis=-1, keepdims=True)
        phase = phase + incoming(np.einsum("bnx,bkx->bnk", launched - middle[:, None], rays.axes))
    return PupilField(leaving[..., 0], leaving[..., 1], phase - phase[:, :1], rays.amplitude, wavelength)


def _checked(psf: ArrayLike, step: float) -> np.ndarray:
    """Return the samples of an image as an array; raise ValueError unless their sum and the step are positive."""
    samples = np.asarray(psf, float)
    if samples.ndim != 2 or not np.all(np.isfinite(samples)) or not np.sum(samples) > 0.0:
        raise ValueError(f"psf must be finite, of shape (rows, columns) and of positive sum, got {samples.shape}")
    if not 0.0 < step < np.inf:
        raise ValueError(f"step must be positive, in metres, got {step}")
    return samples


def encircled_energy(
    psf: ArrayLike, step: float, radius: ArrayLike, centre: tuple[float, float] | None = None
) -> np.ndarray:
    """Compute the energy of an image within circles.

    Parameters
    ----------
    psf : (R, C) array_like
        Samples of the irradiance, 1/m^2: R rows along y, C columns along x. If it integrates to 1, as that of `psf`
        does over the whole plane, energies are shares of all light; else divide by the total.
    step : float
        Distance between samples, metres.
    radius : (M,) array_like
        Radii of M circles, metres.
    centre : (float, float), optional
        Centre x, y from the middle of the grid, metres; by default the centroid of the samples.

    Returns
    -------
    (M,) ndarray
        Energy within each circle.

    Raises
    ------
    ValueError
        The samples are not two-dimensional or finite, or a circle reaches beyond them.

    Notes
    -----
    The Fourier series of the samples is integrated over the disk exactly: a disk of radius r has the transform r J1(2
    pi f r) / f. No pixel is cut by the circle.

    Examples
    --------
    Of the Airy pattern 83.8 % falls within the first dark ring and 91.0 % within the second:

    >>> camera = Camera([OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.2)], 500e-9)
    >>> unit = 500e-9 * camera.f_number
    >>> image = psf(camera, 0.25 * unit, 65)
    >>> encircled_energy(image, 0.25 * unit, [1.2197 * unit, 2.2331 * unit]).round(3)
    array([0.838, 0.91 ])
    """
    # an import of the library waits for no scipy
    from scipy.special import j1

    def disks(radii: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        frequency = np.hypot(fx, fy)
        frequency[0, 0] = 1.0
        out = radii * j1(2.0 * np.pi * frequency * radii) / frequency
        out[:, 0, 0] = np.pi * radii[:, 0, 0] ** 2
        return np.asarray(out)

    return _energy(psf, step, radius, centre, "radii", disks)


def ensquared_energy(
    psf: ArrayLike, step: float, half_width: ArrayLike, centre: tuple[float, float] | None = None
) -> np.ndarray:
    """Compute the energy of an image within squares whose sides are along x and y.

    Parameters
    ----------
    psf : (R, C) array_like
        Samples of the irradiance, 1/m^2, as for `encircled_energy`.
    step : float
        Distance between samples, metres.
    half_width : (M,) array_like
        Half the sides of M squares, metres: half the pitch for the energy in a pixel.
    centre : (float, float), optional
        Centre x, y from the middle of the grid, metres; by default the centroid of the samples.

    Returns
    -------
    (M,) ndarray
        Energy within each square.

    Raises
    ------
    ValueError
        The samples are not two-dimensional or finite, or a square reaches beyond them.

    Notes
    -----
    The Fourier series of the samples is integrated over the square exactly.

    Examples
    --------
    >>> camera = Camera([OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.2)], 500e-9)
    >>> unit = 500e-9 * camera.f_number
    >>> image = psf(camera, 0.25 * unit, 65)
    >>> ensquared_energy(image, 0.25 * unit, [0.5 * unit, 2.0 * unit]).round(3)
    array([0.528, 0.911])
    """

    def squares(half: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        return np.asarray(4.0 * half**2 * np.sinc(2.0 * half * fx) * np.sinc(2.0 * half * fy))

    return _energy(psf, step, half_width, centre, "half widths", squares)


def _energy(
    psf: ArrayLike,
    step: float,
    size: ArrayLike,
    centre: tuple[float, float] | None,
    name: str,
    transform: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Integrate an image over areas of M sizes, whose Fourier transform at frequencies fx, fy a function returns."""
    samples, sizes = _checked(psf, step), np.atleast_1d(np.asarray(size, float))
    rows, columns = samples.shape
    x, y = (step * (np.arange(n) - 0.5 * (n - 1)) for n in (columns, rows))
    if centre is None:
        total = np.sum(samples)
        centre = (float(np.sum(samples * x) / total), float(np.sum(samples * y[:, None]) / total))
    room = min(0.5 * step * columns - abs(centre[0]), 0.5 * step * rows - abs(centre[1]))
    if sizes.ndim != 1 or not np.all((sizes >= 0.0) & (sizes <= room)):
        raise ValueError(f"{name} must be of shape (M,), not negative and at most {room:.4g} m, where the samples end")
    fx, fy = np.fft.fftfreq(columns, step), np.fft.fftfreq(rows, step)[:, None]
    spectrum = np.fft.fft2(samples) / samples.size
    spectrum *= np.exp(2j * np.pi * (fx * (centre[0] - x[0]) + fy * (centre[1] - y[0])))
    return np.asarray(np.sum(spectrum.real * transform(sizes[:, None, None], fx, fy), axis=(1, 2)))


def mtf_from_psf(psf: ArrayLike, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the MTF along x and along y from samples of a point spread function.

    Parameters
    ----------
    psf : (R, C) array_like
        Irradiance: R rows along y, C columns along x.
    step : float
        Distance between samples, metres.

    Returns
    -------
    frequency : (M,) ndarray
        M frequencies from 0 to half the sampling frequency, cycles per metre.
    along_x, along_y : (M,) ndarray
        Modulation of patterns that vary along x and along y, 1 at zero frequency.

    Raises
    ------
    ValueError
        The samples are not two-dimensional or finite, or sum to 0.

    Notes
    -----
    Light beyond the samples is missing: where it is a share e of all, the MTF comes out too high by about that share.

    Examples
    --------
    A Gaussian image of standard deviation s has the MTF exp(-2 (pi f s)^2):

    >>> x = np.arange(-20, 21) * 1e-6
    >>> image = np.exp(-0.5 * (x**2 + x[:, None] ** 2) / 4e-6**2)
    >>> frequency, along_x, along_y = mtf_from_psf(image, 1e-6)
    >>> bool(np.max(np.abs(along_x - np.exp(-2 * (np.pi * frequency * 4e-6) ** 2))) < 1e-5)
    True
    """
    samples = _checked(psf, step)
    size = max(samples.shape)
    lines = (np.abs(np.fft.rfft(samples.sum(axis=axis), size)) for axis in (0, 1))
    along_x, along_y = (line / line[0] for line in lines)
    return np.fft.rfftfreq(size, step), along_x, along_y


def annular_mtf(frequency: ArrayLike, wavelength: float, f_number: float, obscuration: float = 0.0) -> np.ndarray:
    """Compute the MTF of a perfect round pupil with a central obscuration.

    Parameters
    ----------
    frequency : array_like
        Spatial frequencies, cycles per metre, any shape; their sign has no meaning.
    wavelength : float
        Wavelength of the light, metres.
    f_number : float
        Focal length over the diameter of the pupil.
    obscuration : float
        Diameter of the obscuration over that of the pupil, 0 to less than 1.

    Returns
    -------
    ndarray
        Modulation, of the shape of ``frequency``.

    Raises
    ------
    ValueError
        A number is out of its range.

    Notes
    -----
    The overlap of the ring with itself, in areas common to two circles (O'Neill, J. Opt. Soc. Am. 46, 285, 1956).

    Examples
    --------
    A central obscuration costs contrast at low frequencies:

    >>> cutoff = 1 / (500e-9 * 8)
    >>> annular_mtf([0, 0.25 * cutoff, 0.5 * cutoff, cutoff], 500e-9, 8).round(3)
    array([1.   , 0.685, 0.391, 0.   ])
    >>> annular_mtf([0.25 * cutoff, 0.5 * cutoff], 500e-9, 8, obscuration=0.5).round(3)
    array([0.377, 0.224])
    """
    if not (wavelength > 0.0 and f_number > 0.0 and 0.0 <= obscuration < 1.0):
        raise ValueError(
            f"wavelength and f_number must be positive and 0 <= obscuration < 1, got {wavelength}, {f_number} and "
            f"{obscuration}"
        )
    shift = 2.0 * wavelength * f_number * np.abs(finite("frequency", frequency, "in cycles per metre"))

    def common(first: float, second: float) -> np.ndarray:
        """Area common to circles of two radii about centres ``shift`` apart."""
        apart = np.clip(shift, abs(first - second), first + second)
        apart = np.where(apart == 0.0, 1e-300, apart)
        parts = []
        for radius, other in ((first, second), (second, first)):
            near = (apart**2 + radius**2 - other**2) / (2.0 * apart)
            angle = np.arccos(np.clip(near / radius, -1.0, 1.0))
            parts.append(radius**2 * (angle - 0.5 * np.sin(2.0 * angle)))
        return np.asarray(parts[0] + parts[1])

    overlap = common(1.0, 1.0)
    if obscuration:
        overlap = overlap - 2.0 * common(1.0, obscuration) + common(obscuration, obscuration)
    return np.asarray(overlap / (np.pi * (1.0 - obscuration**2)))
