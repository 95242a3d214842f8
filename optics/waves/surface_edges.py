"""The edges of a camera's surfaces on the disk of its stop, as its images see them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np

from optics.geometry.aperture import Edge
from optics.numerics.quadrature import PupilNodes
from optics.waves.edge_shadow import StopOutlines, outlines_on_stop


@dataclass(frozen=True, eq=False)
class SurfaceEdges:
    """Edges of a camera's surfaces as B images see them.

    Attributes
    ----------
    edges : mapping of str to tuple of Edge
        Surface -> its edges, in the order of the light, of every surface that has some.
    places : mapping of str to (B, N, 2) ndarray
        Surface -> points where rays meet it, stopped or not, in its own x and y, metres of nominal size.
    nodes : PupilNodes
        Points of the stop, through which the rays go.
    """

    edges: Mapping[str, tuple[Edge, ...]]
    places: Mapping[str, np.ndarray]
    nodes: PupilNodes

    @cached_property
    def passed(self) -> list[np.ndarray]:
        """Masks (B, N) of the rays that come through each surface and those before it."""
        through = [
            np.all([edge.passes(place[..., 0], place[..., 1]) for edge in self.edges[name]], axis=0)
            for name, place in self.places.items()
        ]
        return list(accumulate(through, np.logical_and))

    def outlines(self, round_sides: int) -> StopOutlines:
        """Return the outlines on the stop, with ``round_sides`` sides for a circle.

        Raises
        ------
        UnphysicalError
            Rays meet a surface at places that no polynomials follow.
        """
        outlines = StopOutlines()
        for (name, place), lit in zip(self.places.items(), [None, *self.passed[:-1]], strict=True):
            outlines += outlines_on_stop(place, self.edges[name], self.nodes, round_sides, lit)
        return outlines
