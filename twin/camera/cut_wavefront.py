"""Statistics of the wavefront of one beam over the light that edges and bodies leave of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optics.geometry.polygon import covered
from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.numerics.quadrature import PupilNodes
from optics.waves.edge_shadow import IlluminatedStop, holes
from optics.waves.imaging import PartFit, fit_part, fit_wavefront, orthonormal_parts
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_terms import products, smooth_terms
from twin.targets.target_path import LineRays, TargetPath

WORST_LIGHT = 5e-3
"""Share of the light by which shadows of edges and traced rays may differ: 10 000 rays count a share to 1e-3."""

RAYS_ACCURACY = 2e-3
"""What numbers of a cut beam are right to where 10 000 rays stand for its light: as a share of an rms wavefront
error."""

SHARPEST = 1e-4
"""Rms wavefront error of which shares are told, waves; of less there is rounding of paths in it."""

_SHADOW_NODES = 6
"""Along each side of a shadow's box."""

_ASTRAY, _DARK_DEGREE = 2.0, 12
"""Ranges of the light's wavefront beyond which rays in the dark do not count, and degree of what stands for them."""

_FINER_RINGS, _FINER_NODES = 4, 2
"""More of both for the finer quadrature, by which numbers are held."""


@dataclass(frozen=True, eq=False)
class ExactFit:
    """What is known of a cut beam without a raster.

    Attributes
    ----------
    fit : PartFit
        Of its wavefront.
    light : float
        Share of the stop that comes through.
    hole : float
        Of a ring, as of ``Wavefront``.
    accuracy : float
        As of ``Wavefront``.
    """

    fit: PartFit
    light: float
    hole: float
    accuracy: float


def exact_fit(
    path: TargetPath,
    state: State,
    direction: np.ndarray,
    rings: int,
    light: float,
    to_sphere: Callable[[LineRays], np.ndarray],
    terms: int,
) -> ExactFit | None:
    """Fit a wavefront over the light of a beam by a quadrature that ends at the edges.

    Parameters
    ----------
    path : TargetPath
        Of the camera.
    state : State
        Of its assembly.
    direction : np.ndarray
        Of the light, world, (1, 3).
    rings : int
        Of the quadrature over the whole stop.
    light : float
        Share of the stop that traced rays come through.
    to_sphere : Callable[[LineRays], np.ndarray]
        Optical paths of rays to their reference spheres, (1, N), metres.
    terms : int
        Of Zernike.

    Returns
    -------
    ExactFit | None
        None where the shadows are not known or not those of traced rays, rays in what is dark do not come to the image,
        or a finer quadrature tells other numbers.

    Raises
    ------
    AimError, BeamMissedError
        The beam is lost.
    """
    try:
        pieces, error = path.shadows_on_stop(state, direction)
    except UnphysicalError:
        return None
    more = (0, 0), (_FINER_RINGS, _FINER_NODES)
    stops = [IlluminatedStop.of(pieces, rings + r, _SHADOW_NODES + n) for r, n in more]
    if abs(float(stops[1].light[0]) - light) > WORST_LIGHT:
        return None
    points = [np.stack([stop.x[0], stop.y[0]], axis=-1) for stop in stops]
    every = np.concatenate([np.zeros((1, 2)), *points])
    rays = path.rays(state, direction, every, edges=False)
    # boxes about shadows reach a little beyond the stop, which ends these rays; their paths are as of others
    if not np.all(rays.valid[0] | (np.hypot(*every.T) > 1.0)):
        return None
    waves = np.split(-to_sphere(rays)[0, 1:] / path.model.spec.wavelength, [len(points[0])])
    both = list(zip(stops, waves, strict=True))
    tamed = [(stop, _tamed(stop, pieces, rings + r, wave)) for (stop, wave), (r, _) in zip(both, more, strict=True)]
    for tried in (both, tamed):
        try:
            coarse, fine = (fit_part(stop.x[0], stop.y[0], stop.weight[0], wave, terms) for stop, wave in tried)
        except UnphysicalError:
            continue
        # rays in the dark that go astray leave no square above zero
        if not min(coarse.rms, fine.rms) > 0.0:
            continue
        change = max(abs(fine.rms - coarse.rms) / max(fine.rms, SHARPEST), abs(fine.strehl - coarse.strehl))
        if change < RAYS_ACCURACY:
            return ExactFit(fine, float(stops[1].light[0]), float(holes(pieces)[0]), max(change, error))
    return None


def _tamed(stop: IlluminatedStop, pieces: np.ndarray, rings: int, wave: np.ndarray) -> np.ndarray:
    """The wavefront (N,) with a smooth continuation of the light's where rays in the dark go far astray, as those do
    that pass the rims of lenses outside; what it is there is taken off again.
    """
    points = np.stack([stop.x[0], stop.y[0]], axis=-1)
    free = ~covered(pieces, points, SMALLEST)[0]
    middle, spread = np.mean(wave[free]), np.ptp(wave[free])
    if np.all(np.abs(wave[~free] - middle) <= _ASTRAY * spread):
        return wave
    own = slice(0, quadrature.disk(rings).count)
    near = points / np.maximum(np.hypot(*points.T), 1.0)[:, None]
    table = products(near[:, 0], near[:, 1], _DARK_DEGREE)
    known = free[None, own], wave[None, own, None]
    terms = smooth_terms(table[own], stop.weight[0, own], *known)
    return np.where(free, wave, table @ terms[0, :, 0])


def counted_fit(nodes: PupilNodes, weight: np.ndarray, flat: np.ndarray, terms: int, free: bool) -> PartFit:
    """Statistics of a levelled wavefront by the rays that come through.

    Parameters
    ----------
    nodes : PupilNodes
        Of the stop, N.
    weight : np.ndarray
        Of the nodes, 0 where no light comes through, (N,).
    flat : np.ndarray
        The wavefront without piston and tilt, waves, (N,).
    terms : int
        Of Zernike.
    free : bool
        Whether none of the weights is 0.
    """
    fit = fit_wavefront(nodes.x, nodes.y, weight, flat, terms)
    # over a part of the disk the terms share tilt among them; what is level there was taken out before
    rms = fit.rms if free else np.sqrt(np.sum(weight * flat**2) / np.sum(weight))
    phasor = np.sum(weight * np.exp(2j * np.pi * flat)) / np.sum(weight)
    return PartFit(
        np.zeros(3),
        fit.coefficients,
        orthonormal_parts(nodes.x, nodes.y, weight, flat, terms),
        float(rms),
        float(fit.residual_rms),
        float(np.abs(phasor) ** 2),
    )
