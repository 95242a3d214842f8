"""Means over the light of pupils that bodies and edges cut."""

from __future__ import annotations

import numpy as np

from optics.geometry import zernike
from optics.numerics.quadrature import PupilNodes
from optics.waves.pupil_stack import DEGREE
from optics.waves.pupil_terms import products, smooth_terms, to_terms
from scenes.models.shadow import Shadows

CUT_MEAN_DEGREE = 14
"""Degree of the polynomials that continue the wavefront of a beam that edges of surfaces cut."""


class PupilMean:
    """Mean over the free part of each stop, of values at nodes of it.

    Polynomials continue the values into the shadows, where they are taken off. They stand for the rays in the dark of
    edges, too, which may pass the rims of lenses far outside.

    Args:
        nodes: N of the stop.
        shadows: in B stops; None for free beams.
        free: which nodes of each stop light comes through, (B, N); None where rays in the dark are as those in the
            light.
    """

    def __init__(self, nodes: PupilNodes, shadows: Shadows | None, free: np.ndarray | None = None) -> None:
        self._free, self._nodes = free, nodes
        tilts = zernike.basis(3, nodes.x, nodes.y)
        self._share, self._tilts = nodes.share[None], tilts[None]
        self._added: np.ndarray | None = None
        if shadows is None:
            return
        points, weight = shadows.points, shadows.weights
        count = len(points)
        all_weights = np.concatenate([np.broadcast_to(nodes.weight, (count, nodes.count)), -weight], axis=1)
        self._share = all_weights / np.maximum(np.sum(all_weights, axis=1, keepdims=True), _SOME)
        own = zernike.basis(3, points.real.ravel(), points.imag.ravel()).reshape(*points.shape, 3)
        self._tilts = np.concatenate([np.broadcast_to(tilts, (count, *tilts.shape)), own], axis=1)
        degree = DEGREE if free is None else CUT_MEAN_DEGREE
        self._to_terms = to_terms(nodes, degree)
        self._on_stop = products(nodes.x, nodes.y, degree)
        self._added = products(points.real, points.imag, degree)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Mean (B,) of values as ``flat`` gives them."""
        return np.asarray(np.sum(values * self._share, axis=-1))

    def flat(self, values: np.ndarray) -> np.ndarray:
        """Values (B, N) less piston and tilt, (B, N + Q): also at nodes in the shadows."""
        values = values - values[:, :1]
        if self._added is not None:
            if self._free is None:
                terms = values @ self._to_terms.T
            else:
                terms = smooth_terms(self._on_stop, self._nodes.weight, self._free, values[..., None])[..., 0]
                values = np.where(self._free, values, terms @ self._on_stop.T)
            values = np.concatenate([values, np.squeeze(self._added @ terms[..., None], -1)], axis=1)
        weighted = self._tilts * self._share[..., None]
        turned = np.swapaxes(weighted, 1, 2)
        level = np.linalg.solve(turned @ self._tilts, turned @ values[..., None])
        return np.asarray(values - np.squeeze(self._tilts @ level, -1))


_SOME = 1e-3
"""Smallest lit area of a stop, in units of its radius squared, for which a mean is defined."""
