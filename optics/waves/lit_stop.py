"""The part of a stop that light comes through: a quadrature over it, and whether it is a ring.

Of a smooth integrand the whole disk is integrated by Gauss' rule, and what shadows take is taken off again, each of
them by a rule of its own that ends at their sides. So edges leave no raster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.numerics import quadrature
from optics.waves.edge_shadow import nodes_in_shadows

ROUND = 1e-4
"""By how much the second moment of a shadow may exceed that of a disk about the stop's middle with its area: of all
shapes it has the least."""


@dataclass(frozen=True, eq=False)
class LitStop:
    """Quadratures over the light of F beams.

    Attributes:
        x, y: nodes, in units of the stop's radius, (F, N).
        weight: of the area, (F, N); negative in shadows, 0 for what only fills the rows.
    """

    x: np.ndarray
    y: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, pieces: np.ndarray, rings: int, count: int) -> LitStop:
        """The stop without shadows.

        Args:
            pieces: convex polygons on the unit disk that do not overlap, (F, K, V, 2).
            rings: of the rule over the whole stop.
            count: nodes along each side of a shadow's box.
        """
        nodes = quadrature.disk(rings)
        points, dark, _ = nodes_in_shadows(pieces, count)
        whole = (len(pieces), nodes.count)
        x, y = (
            np.concatenate([np.broadcast_to(own, whole), taken], axis=1)
            for own, taken in ((nodes.x, points.real), (nodes.y, points.imag))
        )
        return cls(x, y, np.concatenate([np.broadcast_to(nodes.weight, whole), -dark], axis=1))

    @property
    def light(self) -> np.ndarray:
        """Share of the stop that light comes through, (F,)."""
        return np.asarray(np.sum(self.weight, axis=1) / np.pi)


def holes(pieces: np.ndarray) -> np.ndarray:
    """Radius of the hole of each stop whose shadow is one disk about its middle, in units of the stop's, (F,); 0 where
    there is no shadow, NaN where it is another.

    Args:
        pieces: convex polygons that do not overlap, (F, K, V, 2).
    """
    points, weight, _ = nodes_in_shadows(pieces, 4)
    taken = np.sum(weight, axis=1)
    moment = np.sum(weight * np.abs(points) ** 2, axis=1)
    least = taken**2 / (2.0 * np.pi)
    is_round = moment <= (1.0 + ROUND) * least
    return np.asarray(np.where(is_round, np.sqrt(np.maximum(taken, 0.0) / np.pi), np.nan))
