"""Statistics of the wavefront of a vignetted beam over the part of the stop that edges and bodies do not block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optics.geometry.polygon import covered
from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.waves.edge_shadow import IlluminatedStop, holes
from optics.waves.imaging import PartFit, fit_part
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_terms import products, smooth_terms
from twin.targets.target_path import LineRays, TargetPath

WORST_LIGHT = 5e-3
"""Largest accepted difference between the fractions of light computed from shadows of edges and from traced rays.

10 000 rays give that fraction to 1e-3.
"""

RAYS_ACCURACY = 2e-3
"""Accuracy of results for a vignetted beam if 10 000 rays sample its light, as a fraction of the rms wavefront error.
"""

SHARPEST = 1e-4
"""Rms wavefront error, waves, below which changes are relative to this value, as rounding of paths then dominates."""

_SHADOW_NODES = 6
"""Quadrature nodes along each side of a shadow's box."""

_ASTRAY, _DARK_DEGREE = 2.0, 12
"""Treatment of rays in the shadow that depart far from the wavefront.

The first is the largest accepted departure from the mean wavefront, in units of the peak-to-valley of its illuminated
part. Beyond it, the wavefront in the shadow is replaced by a smooth polynomial, of which the second is the degree.
"""

_FINER_RINGS, _FINER_NODES = 4, 2
"""Additional rings, and additional nodes per side of a shadow, of a finer quadrature that checks the results."""


@dataclass(frozen=True, eq=False)
class VignettedFit:
    """Wavefront statistics of a vignetted beam by exact quadrature.

    Attributes
    ----------
    fit : PartFit
        Statistics of the wavefront.
    light : float
        Fraction of the stop's light that passes.
    hole : float
        Radius of the central hole of an annular pupil, in units of the stop's radius; 0 for a whole pupil, NaN for any
        other.
    accuracy : float
        Change of the rms, relative to it, or of the Strehl ratio with a finer quadrature, whichever is larger.
    """

    fit: PartFit
    light: float
    hole: float
    accuracy: float


def fit_illuminated(
    path: TargetPath,
    state: State,
    direction: np.ndarray,
    rings: int,
    light: float,
    wavefront_error: Callable[[LineRays], np.ndarray],
    terms: int,
) -> VignettedFit | None:
    """Fit a wavefront over the light of a beam by a quadrature that ends at the edges.

    Parameters
    ----------
    path : TargetPath
        Light path of the camera.
    state : State
        State of its assembly, with the refractive indices at the wavelength of the light.
    direction : (1, 3) ndarray
        Direction of the light in the world frame.
    rings : int
        Rings of the quadrature over the whole stop.
    light : float
        Fraction of the stop's light that passes, counted by traced rays.
    wavefront_error : callable
        Function from N rays to their wavefront errors on the reference spheres, (1, N), waves of the light.
    terms : int
        Number of Zernike terms.

    Returns
    -------
    VignettedFit or None
        None if the shadows are not known or disagree with traced rays, if rays in the shadow do not reach the image, or
        if a finer quadrature gives other values.

    Raises
    ------
    AimError, BeamMissedError
        The beam is lost.
    """
    try:
        pieces, error = path.shadows_on_stop(state, direction)
    except UnphysicalError:
        return None
    refinement = (0, 0), (_FINER_RINGS, _FINER_NODES)
    stops = [IlluminatedStop.of(pieces, rings + r, _SHADOW_NODES + n) for r, n in refinement]
    if abs(float(stops[1].light[0]) - light) > WORST_LIGHT:
        return None
    points = [np.stack([stop.x[0], stop.y[0]], axis=-1) for stop in stops]
    all_points = np.concatenate([np.zeros((1, 2)), *points])
    rays = path.rays(state, direction, all_points, edges=False)
    # boxes about shadows extend a little beyond the stop, which vignettes these rays; their paths are valid
    if not np.all(rays.valid[0] | (np.hypot(*all_points.T) > 1.0)):
        return None
    waves = np.split(wavefront_error(rays)[0, 1:], [len(points[0])])
    both = list(zip(stops, waves, strict=True))
    continued = [
        (stop, _tamed(stop, pieces, rings + r, wave)) for (stop, wave), (r, _) in zip(both, refinement, strict=True)
    ]
    for attempt in (both, continued):
        try:
            coarse, fine = (fit_part(stop.x[0], stop.y[0], stop.weight[0], wave, terms) for stop, wave in attempt)
        except UnphysicalError:
            continue
        # shadowed rays that are far off can make the mean square negative
        if not min(coarse.rms, fine.rms) > 0.0:
            continue
        change = max(abs(fine.rms - coarse.rms) / max(fine.rms, SHARPEST), abs(fine.strehl - coarse.strehl))
        if change < RAYS_ACCURACY:
            return VignettedFit(fine, float(stops[1].light[0]), float(holes(pieces)[0]), max(change, error))
    return None


def _tamed(stop: IlluminatedStop, pieces: np.ndarray, rings: int, wave: np.ndarray) -> np.ndarray:
    """Return the wavefront at N nodes, (N,), smoothly continued where rays in the shadow depart far from it.

    Such rays pass outside the rims of lenses. Their contribution to a quadrature cancels, as the whole disk is
    integrated and the shadow is subtracted.
    """
    points = np.stack([stop.x[0], stop.y[0]], axis=-1)
    free = ~covered(pieces, points, SMALLEST)[0]
    middle, spread = np.mean(wave[free]), np.ptp(wave[free])
    if np.all(np.abs(wave[~free] - middle) <= _ASTRAY * spread):
        return wave
    ring_nodes = slice(0, quadrature.disk(rings).count)
    clamped = points / np.maximum(np.hypot(*points.T), 1.0)[:, None]
    table = products(clamped[:, 0], clamped[:, 1], _DARK_DEGREE)
    light_values = free[None, ring_nodes], wave[None, ring_nodes, None]
    terms = smooth_terms(table[ring_nodes], stop.weight[0, ring_nodes], *light_values)
    return np.where(free, wave, table @ terms[0, :, 0])
