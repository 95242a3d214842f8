"""First designs of telescopes: layouts by first-order optics, conic constants by third-order optics.

The layout of two mirrors follows from the focal lengths of primary and system and from the distance of the focus behind
the primary (Schroeder, Astronomical Optics, 2nd ed., 2000, chapter 2). Layouts of three mirrors are similar to two
designs in the ratios of their radii and distances: an anastigmat with its pupil on the axis after Korsch (J. Opt. Soc.
Am. 62, 1291, 1972), and an off-axis one with its stop at the secondary. Conic constants make the first Seidel sums
vanish, which are linear in them. A triplet of lenses is that of `optics.camera.triplet`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optics.camera.image_quality import wavefront
from optics.camera.prescription import MIRROR, Camera, OpticalSurface
from optics.camera.seidel import seidel
from optics.camera.telescope_types import TELESCOPES
from optics.camera.triplet import GLASSES, triplet


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


def _camera(given: Sequence[OpticalSurface], stop: int, aperture: float, wavelength: float) -> Camera:
    """Return the camera of surfaces whose stop is filled by a beam of a diameter on the axis."""
    surfaces = list(given)
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
