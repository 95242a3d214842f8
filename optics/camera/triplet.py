"""First design of a Cooke triplet: curvatures and air spaces by least squares of real rays, for one focal length.

The start is a triplet of F/5 in the glasses N-SK16 and F2 that design programs ship as an example. Its third-order and
chromatic sums are small. Curvatures, air spaces and focus then minimise the ray errors of the wanted aperture, field
and wavelength, so that higher orders balance. Lengths are in focal lengths; the focal length is exact at every step.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from optics.camera.seidel import paraxial_ray
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
    found = least_squares(errors, first, x_scale=size, bounds=(low, high), max_nfev=_STEPS, xtol=1e-10, ftol=1e-8)
    curvatures, gaps = _unit_lens(found.x, indices[1])
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
    at, way = np.broadcast_to(start, (3, *start.shape)), np.broadcast_to(along, (3, *along.shape))
    for k, curvature in enumerate(curvatures):
        half = curvature * np.sum(at * way, axis=-1) - way[..., 2]
        beyond = curvature * np.sum(at * at, axis=-1) - 2.0 * at[..., 2]
        at = at + (beyond / (np.sqrt(half**2 - curvature * beyond) - half))[..., None] * way
        normal = np.array([0.0, 0.0, 1.0]) - curvature * at
        ratio = (indices[:, k] / indices[:, k + 1])[:, None, None]
        before = np.sum(normal * way, axis=-1)
        after = np.sqrt(1.0 - ratio**2 * (1.0 - before**2))
        way = ratio[..., None] * way + (after - ratio * before)[..., None] * normal
        at = at - np.array([0.0, 0.0, gaps[k]])
    return np.asarray((at - (at[..., 2] / way[..., 2])[..., None] * way)[..., :2])
