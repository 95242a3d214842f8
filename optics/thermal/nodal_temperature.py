"""Temperatures at the nodes of another program's mesh, interpolated to any point of a body.

Between the nodes the temperature is linear in Delaunay tetrahedra, as in the simplest elements of thermal programs; a
linear field is reproduced to rounding by any mesh. Outside the nodes a point takes the deviation of its nearest node
from the nodes' linear fit. The error between the nodes is estimated by leaving out every second node and predicting it
from the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from optics.geometry.pose import triple
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import MIN_NODES, NodesError

MAX_NODES = 200_000
"""Largest number of nodes: the Delaunay triangulation of more takes minutes."""
FLAT = 1e-6
"""Ratio of the thickness of a set of nodes to its longest extent below which the nodes count as coplanar."""
_JITTER = 1e-7
"""Random displacement of nodes, relative to their extents, before they are triangulated.

It makes the Delaunay tetrahedra of a regular lattice unique.
"""
_EDGE = 1e-6
"""Largest distance outside the outermost tetrahedra, in barycentric coordinates, at which a point counts as inside."""
_MOST_STEPS = 2000
"""Largest number of steps from one tetrahedron to the next in the search for the one that contains a point."""


class _Interpolator:
    """Interpolation of values at nodes, linear in Delaunay tetrahedra.

    Parameters
    ----------
    nodes : (N, 3) ndarray
        N nodes, with extents of about 1.
    values : (N,) ndarray
        Values at the nodes.

    Raises
    ------
    QhullError
        The nodes lie in a plane.
    """

    def __init__(self, nodes: np.ndarray, values: np.ndarray) -> None:
        moved = nodes + _JITTER * np.random.default_rng(len(nodes)).uniform(-1.0, 1.0, nodes.shape)
        self.cells = Delaunay(moved)
        self._values, self._tree = values, cKDTree(moved)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the interpolated values (P,) at P points (P, 3); NaN outside the nodes."""
        cells = self.cells
        out = np.full(len(points), np.nan)
        simplex = cells.vertex_to_simplex[self._tree.query(points)[1]]
        active = np.flatnonzero(simplex >= 0)
        for _ in range(_MOST_STEPS):
            if not len(active):
                break
            corners = cells.points[cells.simplices[simplex[active]]]
            edges = (corners[:, :3] - corners[:, 3:]).transpose(0, 2, 1)
            three = np.linalg.solve(edges, (points[active] - corners[:, 3])[..., None])[..., 0]
            shares = np.column_stack([three, 1.0 - three.sum(axis=1)])
            # through the face that the point lies farthest behind: such a walk ends in every Delaunay triangulation
            worst = np.argmin(shares, axis=1)
            least = shares[np.arange(len(active)), worst]
            next_simplex = cells.neighbors[simplex[active], worst]
            inside = (least >= 0.0) | ((least >= -_EDGE) & (next_simplex < 0))
            done = active[inside]
            out[done] = np.sum(shares[inside] * self._values[cells.simplices[simplex[done]]], axis=1)
            walking = ~inside & (next_simplex >= 0)
            simplex[active[walking]] = next_simplex[walking]
            active = active[walking]
        return out


@dataclass(frozen=True)
class Coverage:
    """Coverage of a body's volume by nodes.

    Attributes
    ----------
    outside : float
        Fraction of the body's volume that lies beyond the outermost nodes by more than their spacing.
    farthest : float
        Distance of the body's point that is farthest from any node, metres.
    """

    outside: float
    farthest: float


class NodalTemperature:
    """Change of temperature of a body, given at N nodes and interpolated between them.

    Attributes
    ----------
    points : (N, 3) ndarray
        Nodes without repetitions, metres.
    values : (N,) ndarray
        Change of temperature at the nodes, kelvin.
    linear : Temperature
        Least-squares linear field, every node with the same weight.
    spacing : float
        Cube root of the volume that the nodes span, divided by their number, metres; 0 for coplanar nodes.
    flat : bool
        True when the nodes lie in a plane or on a line; they then have a linear fit only.
    """

    def __init__(self, points: Any, values: Any) -> None:
        """Sort and triangulate the nodes; their order has no effect.

        Parameters
        ----------
        points : (N, 3) array_like
            N nodes, metres.
        values : (N,) array_like
            Change of temperature at the nodes, kelvin.

        Raises
        ------
        NodesError
            There are too few nodes, or too many.
        """
        nodes, temperatures = np.asarray(points, np.float64), np.asarray(values, np.float64)
        if nodes.ndim != 2 or nodes.shape[1] != 3 or temperatures.shape != nodes.shape[:1]:
            raise ValueError(
                f"nodes must be (N, 3) and temperatures (N,), found {nodes.shape} and {temperatures.shape}"
            )
        if not (np.all(np.isfinite(nodes)) and np.all(np.isfinite(temperatures))):
            raise ValueError("nodes and temperatures must be finite")
        self.points, first = np.unique(nodes, axis=0, return_index=True)
        self.values = temperatures[first]
        count = len(self.points)
        if not MIN_NODES <= count <= MAX_NODES:
            text = f"{count} different nodes"
            raise NodesError(text, f"{MIN_NODES} to {MAX_NODES} nodes, all of this body")
        self._middle = self.points.mean(axis=0)
        # bodies are often thin with nodes in layers; equal extents along all axes give well-shaped tetrahedra
        extent = np.ptp(self.points, axis=0)
        self._scale = np.where(extent > 0.0, extent, 1.0)
        scaled = self._placed(self.points)
        solved, _, rank, _ = np.linalg.lstsq(np.column_stack([np.ones(count), scaled]), self.values, rcond=FLAT)
        self.flat = int(rank) < 4
        slope = solved[1:] / self._scale
        self.linear = Temperature(float(solved[0] - slope @ self._middle), triple(slope))
        self._deviations = self.values - self._linear_at(self.points)
        self._tree = cKDTree(self.points)
        self.spacing = 0.0
        self._leave_out_error: float | None = None
        self._inside: _Interpolator | None = None
        if not self.flat:
            try:
                self._inside = _Interpolator(scaled, self._deviations)
            except QhullError:
                self.flat = True
                return
            corners = scaled[self._inside.cells.simplices]
            volume = float(np.sum(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))) / 6.0 * np.prod(self._scale))
            self.spacing = (volume / count) ** (1.0 / 3.0)

    def _placed(self, points: np.ndarray) -> np.ndarray:
        """Return points (metres) relative to the nodes' mean position, in units of the nodes' extents."""
        return np.asarray((points - self._middle) / self._scale)

    def _linear_at(self, points: np.ndarray) -> np.ndarray:
        """Return the change of temperature at points according to the nodes' linear fit, kelvin."""
        return np.asarray(self.linear.change + points @ np.array(self.linear.gradient))

    @property
    def departures(self) -> np.ndarray:
        """Deviations of the N nodes' values from the linear fit, (N,), kelvin."""
        return self._deviations

    def departure(self) -> float:
        """Return the largest deviation of a node from the linear fit, in kelvin."""
        return float(np.max(np.abs(self._deviations)))

    def at(self, points: Any) -> np.ndarray:
        """Return the change of temperature at P points, (P,), in kelvin.

        Parameters
        ----------
        points : (P, 3) array_like
            Points in the frame of the nodes, metres.
        """
        scaled = np.asarray(points, np.float64)
        rest = self._inside_rest(scaled)
        beyond = np.isnan(rest)
        if np.any(beyond):
            rest[beyond] = self._deviations[self._tree.query(scaled[beyond])[1]]
        return self._linear_at(scaled) + rest

    def _inside_rest(self, scaled: np.ndarray) -> np.ndarray:
        """Return the interpolated deviation from the nodes' linear fit at points, kelvin; NaN outside the nodes.

        ``scaled`` are the points relative to the nodes' mean position, in units of the nodes' extents.
        """
        if self._inside is None:
            return np.full(len(scaled), np.nan)
        return self._inside(self._placed(scaled))

    def coverage(self, points: Any, weights: Any) -> Coverage:
        """Return how well the nodes cover a body's volume, which P points with their volumes represent.

        Parameters
        ----------
        points : (P, 3) array_like
            Points in the body, metres.
        weights : (P,) array_like
            Volume that each point represents, m^3.
        """
        scaled, share = np.asarray(points, np.float64), np.asarray(weights, np.float64)
        distance = self._tree.query(scaled)[0]
        beyond = np.isnan(self._inside_rest(scaled)) & (distance > self.spacing)
        return Coverage(float(np.sum(share[beyond]) / np.sum(share)), float(np.max(distance)))

    @property
    def between(self) -> float:
        """Rms error of the interpolation at left-out nodes (every second one), kelvin; computed once.

        The remaining nodes have twice the volume each; this is some 1.6 times the error of all nodes where the field is
        smooth.
        """
        if self._leave_out_error is None:
            excluded = np.arange(len(self.points)) % 2 == 1
            errors = np.zeros(0)
            if not self.flat:
                scaled = self._placed(self.points)
                try:
                    predicted = _Interpolator(scaled[~excluded], self._deviations[~excluded])(scaled[excluded])
                    errors = (predicted - self._deviations[excluded])[np.isfinite(predicted)]
                except QhullError:
                    errors = self._deviations[excluded]
            self._leave_out_error = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
        return self._leave_out_error


def linear_part(points: Any, values: Any, weights: Any) -> tuple[Temperature, np.ndarray]:
    """Return the linear field nearest to temperatures at P points by weighted least squares, and the remainder.

    Parameters
    ----------
    points : (P, 3) array_like
        Points, metres, not in a plane.
    values : (P,) array_like
        Temperatures, kelvin.
    weights : (P,) array_like
        Weights of the squares.

    Returns
    -------
    field : Temperature
        The linear field.
    remainder : (P,) ndarray
        Values minus the field, kelvin.
    """
    positions, heat, root = np.asarray(points), np.asarray(values), np.sqrt(np.asarray(weights))
    middle, scale = positions.mean(axis=0), np.ptp(positions, axis=0)
    level = float(np.mean(heat))  # subtracted first, so that a uniform temperature stays exactly uniform
    matrix = np.column_stack([np.ones(len(positions)), (positions - middle) / scale])
    solved = np.linalg.lstsq(matrix * root[:, None], (heat - level) * root, rcond=None)[0]
    slope = solved[1:] / scale
    field = Temperature(float(level + solved[0] - slope @ middle), triple(slope))
    return field, heat - level - matrix @ solved
