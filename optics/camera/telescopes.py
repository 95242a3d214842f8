"""First designs of telescopes: layouts by first-order optics, conic constants by third-order optics.

The layout of two mirrors follows from the focal lengths of primary and system and from the distance of the focus behind
the primary (Schroeder, Astronomical Optics, 2nd ed., 2000, chapter 2). Layouts of three mirrors are similar to two
designs in the ratios of their radii and distances: an anastigmat with its pupil on the axis after Korsch (J. Opt. Soc.
Am. 62, 1291, 1972), and an off-axis one with its stop at the secondary. Conic constants make the first Seidel sums
vanish, which are linear in them. A triplet of lenses is that of `optics.camera.telescopes`.

First design of a Cooke triplet: curvatures and air spaces by least squares of real rays, for one focal length.

The start is a triplet of F/5 in the glasses N-SK16 and F2 that design programs ship as an example. Its third-order and
chromatic sums are small. Curvatures, air spaces and focus then minimise the ray errors of the wanted aperture, field
and wavelength, so that higher orders balance. Lengths are in focal lengths; the focal length is exact at every step.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from optics.camera.image_quality import wavefront
from optics.camera.prescription import MIRROR, Camera, OpticalSurface, paraxial_ray, seidel
from optics.camera.telescope_types import TELESCOPES
from optics.materials.glass import refractive_index

GLASSES: tuple[str | float, ...] = ("N-SK16", 1.0, "F2", 1.0, "N-SK16", 1.0)
"""Medium behind each of the six faces."""
STOP = 3
"""Index of the face that is the stop: the rear of the flint lens."""
_RADII = np.array([0.440272, -8.71521, -0.444266, 0.405838, 1.593672, -0.367907])
_GAPS = np.array([0.065179, 0.120151, 0.020000, 0.095008, 0.059042])
"""Radii of the faces and distances between them of the start, in focal lengths."""
_AIR = (1, 3)
"""Indices of the air spaces in ``_GAPS``."""
_COLOURS = np.array([1.0 / 1.12, 1.0, 1.12])
"""Wavelengths of the rays over the design wavelength; the outer two are brought together."""
_COLOUR_WEIGHT = 0.1
"""Weight of a ray error between the outer wavelengths, in squares 0.01 of one at the design wavelength."""
_FIELDS = np.array([0.0, 0.7, 1.0])
"""Fields of the rays over the half field."""


def triplet(
    focal_length: float, f_number: float, wavelength: float, half_field: float
) -> tuple[np.ndarray, np.ndarray]:
    """Design a Cooke triplet in vacuum.

    Parameters
    ----------
    focal_length : float
        Focal length, metres, exact in paraxial rays.
    f_number : float
        Focal length over the diameter of the entrance pupil.
    wavelength : float
        Design wavelength, metres.
    half_field : float
        Half angle of the field, radians.

    Returns
    -------
    (6,) and (6,) ndarray
        Radii of the faces, and distances to the next face or the image, metres.

    Raises
    ------
    ValueError
        A glass has no index at the wavelengths.
    """
    indices = np.array([_indices(wavelength * colour) for colour in _COLOURS])
    angles = half_field * _FIELDS
    rings, spokes = np.sqrt([1 / 6, 1 / 2, 5 / 6, 1.0]), np.pi * np.arange(-2, 3) / 4
    pupil = 0.5 / f_number * (rings[:, None, None] * np.stack([np.cos(spokes), np.sin(spokes)], axis=-1)).reshape(-1, 2)
    scale = 0.5 * focal_length / (f_number * wavelength)

    def errors(values: np.ndarray) -> np.ndarray:
        """Ray errors in waves of path, about the mean position of the design wavelength at each field."""
        curvatures, gaps = _unit_lens(values, indices[1])
        start = np.zeros((len(_FIELDS), len(pupil), 3))
        along = np.stack([np.zeros(len(angles)), np.sin(angles), np.cos(angles)], axis=-1)[:, None, :]
        start[..., :2], start[..., 2] = pupil, _entrance_pupil(curvatures, gaps, indices[1])
        start = start - (start[..., 2:] + 0.5) / along[..., 2:] * along  # half a focal length before the lens
        spots = _traced(curvatures, gaps, indices, start, np.broadcast_to(along, start.shape))
        middle = np.stack([np.zeros(len(angles)), spots[1, ..., 1].mean(axis=-1)], axis=-1)
        colour = _COLOUR_WEIGHT * (spots[2] - spots[0])
        return (scale * np.stack([spots[1] - middle[:, None, :], colour])).ravel()

    first = np.array([*(1.0 / _RADII), *_GAPS[list(_AIR)], 0.0])
    size = np.array([*np.full(6, 1.0), 0.05, 0.05, 1e-3])
    low, high = np.array([*np.full(6, -8.0), 0.04, 0.04, -0.1]), np.array([*np.full(6, 8.0), 0.3, 0.3, 0.1])
    fit = least_squares(errors, first, x_scale=size, bounds=(low, high), max_nfev=_STEPS, xtol=1e-10, ftol=1e-8)
    curvatures, gaps = _unit_lens(fit.x, indices[1])
    return focal_length / curvatures, focal_length * gaps


_STEPS = 150
"""Largest number of least-squares steps."""


def _indices(wavelength: float) -> np.ndarray:
    """Return the index before the first face and behind each face, (7,)."""
    behind = (
        1.0 if not isinstance(name, str) else float(refractive_index(name, wavelength, "vacuum")) for name in GLASSES
    )
    return np.array([1.0, *behind])


def _unit_lens(values: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return curvatures and distances, the last to the image, of a lens of focal length 1 from the variables."""
    curvatures, gaps = values[:6], _GAPS.copy()
    gaps[list(_AIR)] = values[6:8]
    heights, slopes = paraxial_ray(curvatures, gaps, index, 1.0, 0.0)
    power = -slopes[-1]
    return curvatures / power, np.array([*(power * gaps), heights[-1] + values[8]])


def _entrance_pupil(curvatures: np.ndarray, gaps: np.ndarray, index: np.ndarray) -> float:
    """Return the position of the paraxial entrance pupil behind the first face."""
    # a ray through the middle of the stop, back to the first face
    backward = curvatures[STOP - 1 :: -1], -gaps[STOP - 2 :: -1], index[STOP::-1]
    heights, slopes = paraxial_ray(*backward, -float(gaps[STOP - 1]), 1.0)
    return float(-heights[-1] / slopes[-1])


def _traced(
    curvatures: np.ndarray, gaps: np.ndarray, indices: np.ndarray, start: np.ndarray, along: np.ndarray
) -> np.ndarray:
    """Trace rays, (fields, rays, 3), at three wavelengths to the image: positions (wavelengths, fields, rays, 2)."""
    at, direction = np.broadcast_to(start, (3, *start.shape)), np.broadcast_to(along, (3, *along.shape))
    for k, curvature in enumerate(curvatures):
        half = curvature * np.sum(at * direction, axis=-1) - direction[..., 2]
        beyond = curvature * np.sum(at * at, axis=-1) - 2.0 * at[..., 2]
        at = at + (beyond / (np.sqrt(half**2 - curvature * beyond) - half))[..., None] * direction
        normal = np.array([0.0, 0.0, 1.0]) - curvature * at
        ratio = (indices[:, k] / indices[:, k + 1])[:, None, None]
        before = np.sum(normal * direction, axis=-1)
        after = np.sqrt(1.0 - ratio**2 * (1.0 - before**2))
        direction = ratio[..., None] * direction + (after - ratio * before)[..., None] * normal
        at = at - np.array([0.0, 0.0, gaps[k]])
    return np.asarray((at - (at[..., 2] / direction[..., 2])[..., None] * direction)[..., :2])


def _two_mirrors(aperture: float, f_number: float, primary: float, behind: float) -> list[tuple[float, float]]:
    """Return radii and distances of a primary and a convex secondary whose focus lies ``behind`` the primary."""
    first = primary * aperture
    magnification = f_number / primary
    distance = (magnification * first - behind) / (magnification + 1.0)
    inward, outward = first - distance, distance + behind
    return [(-2.0 * first, -distance), (-2.0 * inward * outward / (outward - inward), outward)]


def first_design(
    kind: str,
    aperture: float,
    f_number: float,
    wavelength: float,
    primary_f_number: float | None = None,
    behind: float | None = None,
    half_field: float = np.radians(0.5),
) -> Camera:
    """Design a telescope to begin with: its focal length is exact, its conics cancel third-order aberrations.

    Parameters
    ----------
    kind : str
        Name in ``TELESCOPES``.
    aperture : float
        Diameter of the entrance pupil, metres.
    f_number : float
        Focal length over the aperture.
    wavelength : float
        Design wavelength, metres.
    primary_f_number : float, optional
        F-number of the primary of two mirrors; by default a third of that of the telescope, within 1.5 and 3.
    behind : float, optional
        Distance of the focus behind the primary of two mirrors, metres; by default half of the aperture.
    half_field : float
        Half angle of the field over which a triplet is corrected, radians.

    Returns
    -------
    Camera
        Surfaces in the order of the light, centred on one axis; the stop is that of the kind.

    Raises
    ------
    ValueError
        The kind is not known, or no such layout exists.

    Notes
    -----
    The three-mirror anastigmats are used beside their axis, at the field angle ``bias`` of their type over the
    F-number. For the off-axis one, where higher orders count, conics and focus then minimise the traced
    wavefront error there.
    """
    if kind not in TELESCOPES:
        raise ValueError(f"there is no telescope {kind!r}; there are {', '.join(TELESCOPES)}")
    if not (aperture > 0.0 and 0.5 <= f_number <= 1000.0):
        raise ValueError(f"aperture must be positive and the F-number 0.5 to 1000, got {aperture} m and {f_number}")
    what, focal = TELESCOPES[kind], f_number * aperture
    if what.lenses:
        radii, gaps = triplet(focal, f_number, wavelength, half_field)
        faces = zip(radii.tolist(), gaps.tolist(), GLASSES, strict=True)
        lens = [OpticalSurface(radius, gap, material=behind) for radius, gap, behind in faces]
        return _camera(lens, what.stop, aperture, wavelength)
    primary = min(max(f_number / 3.0, 1.5), 3.0) if primary_f_number is None else primary_f_number
    back = 0.5 * aperture if behind is None else behind
    if what.ratios:
        rows = [(focal * radius, focal * gap) for radius, gap in what.ratios]
    elif len(what.conics) == 1:
        rows = [(-2.0 * focal, -focal)]
    elif not 0.0 < primary < f_number:
        raise ValueError(f"the F-number of the primary must lie between 0 and {f_number:g}, got {primary}")
    elif not 0.0 <= back < focal - primary * aperture:
        raise ValueError(f"the focus can lie 0 to {focal - primary * aperture:g} m behind the primary, got {back}")
    else:
        rows = _two_mirrors(aperture, f_number, primary, back)
    mirrors = [
        OpticalSurface(radius, gap, conic or 0.0, MIRROR)
        for (radius, gap), conic in zip(rows, what.conics, strict=True)
    ]
    camera = _camera(mirrors, what.stop, aperture, wavelength)
    if what.ratios:  # the ratios are rounded
        scale = focal / camera.focal_length
        mirrors = [replace(m, radius=scale * m.radius, thickness=scale * m.thickness) for m in mirrors]
        camera = _camera(mirrors, what.stop, aperture, wavelength).refocused()
    free = [k for k, conic in enumerate(what.conics) if conic is None]
    camera = _corrected(camera, free)
    return _optimised(camera, what.bias / f_number) if what.stop else camera


def _camera(prescription: Sequence[OpticalSurface], stop: int, aperture: float, wavelength: float) -> Camera:
    """Return the camera of surfaces whose stop is filled by a beam of a diameter on the axis."""
    surfaces = list(prescription)
    surfaces[stop] = replace(surfaces[stop], diameter=aperture)
    camera = Camera(surfaces, wavelength, stop)
    surfaces[stop] = replace(surfaces[stop], diameter=aperture**2 / camera.entrance_pupil_diameter)
    return Camera(surfaces, wavelength, stop)


def _with(camera: Camera, free: Sequence[int], conics: Sequence[float], shift: float = 0.0) -> Camera:
    """Return a camera with other conic constants of some mirrors, and its image plane shifted along the light."""
    surfaces = list(camera.surfaces)
    for k, conic in zip(free, conics, strict=True):
        surfaces[k] = replace(surfaces[k], conic=float(conic))
    last = surfaces[-1]
    surfaces[-1] = replace(last, thickness=last.thickness + shift * float(np.sign(last.thickness)))
    return replace(camera, surfaces=surfaces)


def _corrected(camera: Camera, free: Sequence[int]) -> Camera:
    """Return a camera whose first Seidel sums, as many as it has free conics, vanish."""
    count = len(free)

    def sums(conics: np.ndarray) -> np.ndarray:
        return np.asarray(seidel(_with(camera, free, list(conics)), 0.01).sums.sum(axis=0)[:count])

    level = sums(np.zeros(count))
    slopes = np.stack([sums(unit) - level for unit in np.eye(count)], axis=-1)
    return _with(camera, free, list(np.linalg.solve(slopes, -level)))


def _optimised(camera: Camera, bias: float) -> Camera:
    """Return a camera whose conics and focus minimise the wavefront error about a field angle of y, radians."""
    fields = [(0.2 * bias * x, bias * (1.0 + 0.02 * y)) for x, y in ((0.0, -1.0), (0.0, 1.0), (0.5, 0.0), (1.0, 0.0))]
    free = range(len(camera.surfaces))
    values = np.array([*(surface.conic for surface in camera.surfaces), 0.0])
    steps = np.array([*np.full(len(free), 1e-4), 1e-6 * camera.focal_length])

    def errors(at: np.ndarray) -> np.ndarray:
        changed = _with(camera, free, list(at[:-1]), float(at[-1]))
        return np.concatenate([wavefront(changed, field).coefficients[3:] for field in fields])

    for _ in range(_ROUNDS):
        level = errors(values)
        slopes = np.stack([errors(values + step) - level for step in np.diag(steps)], axis=-1)
        values = values - steps * np.linalg.lstsq(slopes, level, rcond=None)[0]
    return _with(camera, free, list(values[:-1]), float(values[-1]))


_ROUNDS = 4
"""Steps of Gauss and Newton: wavefront errors are nearly linear in conics and focus."""
