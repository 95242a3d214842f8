"""Temperatures at the nodes of another program's mesh, carried over to any place of a body.

Between the nodes the temperature is linear in Delaunay's tetrahedra, as in the simplest elements of thermal programs;
a linear field is met to rounding by any mesh. Outside of the nodes a place takes the departure of its nearest node from
the nodes' linear fit. What the nodes do not know between them is judged by leaving every second one out: how well the
others foretell them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from optics.geometry.pose import triple
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import LEAST_NODES, NodesError

MOST_WARM_NODES = 200_000
"""More take Delaunay's triangulation minutes."""
FLAT = 1e-6
"""Share of the longest extent: nodes within a layer so thin lie in a plane."""
_JITTER = 1e-7
"""Share of the extents by which nodes are moved before they are triangulated: a lattice leaves its tetrahedra a choice.
"""
_EDGE = 1e-6
"""Barycentric coordinate down to which a place counts as inside of the outermost tetrahedra."""
_MOST_STEPS = 2000


class _Between:
    """Values at nodes, linear in Delaunay's tetrahedra.

    Parameters
    ----------
    nodes
        (N, 3), with extents of about 1.
    values
        At them, (N,).

    Raises
    ------
    QhullError
        The nodes lie in a plane.
    """

    def __init__(self, nodes: np.ndarray, values: np.ndarray) -> None:
        moved = nodes + _JITTER * np.random.default_rng(len(nodes)).uniform(-1.0, 1.0, nodes.shape)
        self.cells = Delaunay(moved)
        self._values, self._tree = values, cKDTree(moved)

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """Values at places (P, 3), not a number outside of the nodes; (P,)."""
        cells = self.cells
        out = np.full(len(places), np.nan)
        at = cells.vertex_to_simplex[self._tree.query(places)[1]]
        going = np.flatnonzero(at >= 0)
        for _ in range(_MOST_STEPS):
            if not len(going):
                break
            corners = cells.points[cells.simplices[at[going]]]
            edges = (corners[:, :3] - corners[:, 3:]).transpose(0, 2, 1)
            three = np.linalg.solve(edges, (places[going] - corners[:, 3])[..., None])[..., 0]
            shares = np.column_stack([three, 1.0 - three.sum(axis=1)])
            # toward the face that the place lies farthest behind: such a walk ends in every Delaunay triangulation
            worst = np.argmin(shares, axis=1)
            least = shares[np.arange(len(going)), worst]
            onward = cells.neighbors[at[going], worst]
            inside = (least >= 0.0) | ((least >= -_EDGE) & (onward < 0))
            found = going[inside]
            out[found] = np.sum(shares[inside] * self._values[cells.simplices[at[found]]], axis=1)
            walking = ~inside & (onward >= 0)
            at[going[walking]] = onward[walking]
            going = going[walking]
        return out


@dataclass(frozen=True)
class Coverage:
    """How well nodes cover places of a body.

    Attributes
    ----------
    outside : float
        Share of the body's volume that lies beyond the outermost nodes by more than their spacing.
    farthest : float
        Distance of the body's place that is farthest from any node, metres.
    """

    outside: float
    farthest: float


class NodalTemperature:
    """A change of temperature that is known at nodes.

    Attributes
    ----------
    points
        Nodes without repetitions, metres, (N, 3).
    values
        Change of temperature there, kelvin, (N,).
    linear
        Their least-squares linear field, every node with the same weight.
    spacing
        Edge of a cube that has as many nodes as the volume that they span, metres; 0 for nodes in a plane.
    flat
        Whether the nodes lie in a plane or on a line; they then have a linear fit only.
    """

    def __init__(self, points: Any, values: Any) -> None:
        """Sort and triangulate the nodes; their order is of no effect.

        Parameters
        ----------
        points : Any
            Nodes, metres, (N, 3).
        values : Any
            Change of temperature there, kelvin, (N,).

        Raises
        ------
        NodesError
            Too few nodes, or too many.
        """
        given, heat = np.asarray(points, np.float64), np.asarray(values, np.float64)
        if given.ndim != 2 or given.shape[1] != 3 or heat.shape != given.shape[:1]:
            raise ValueError(f"nodes must be (N, 3) and temperatures (N,), found {given.shape} and {heat.shape}")
        if not (np.all(np.isfinite(given)) and np.all(np.isfinite(heat))):
            raise ValueError("nodes and temperatures must be finite")
        self.points, first = np.unique(given, axis=0, return_index=True)
        self.values = heat[first]
        count = len(self.points)
        if not LEAST_NODES <= count <= MOST_WARM_NODES:
            text = f"{count} different nodes"
            raise NodesError(text, f"{LEAST_NODES} to {MOST_WARM_NODES}: those of this body alone")
        self._middle = self.points.mean(axis=0)
        # a body is often thin and its nodes stand in layers: tetrahedra are of good shape where all sides are alike
        extent = np.ptp(self.points, axis=0)
        self._scale = np.where(extent > 0.0, extent, 1.0)
        place = self._placed(self.points)
        solved, _, rank, _ = np.linalg.lstsq(np.column_stack([np.ones(count), place]), self.values, rcond=FLAT)
        self.flat = int(rank) < 4
        slope = solved[1:] / self._scale
        self.linear = Temperature(float(solved[0] - slope @ self._middle), triple(slope))
        self._rest = self.values - self._linear_at(self.points)
        self._tree = cKDTree(self.points)
        self.spacing = 0.0
        self._between: float | None = None
        self._inside: _Between | None = None
        if not self.flat:
            try:
                self._inside = _Between(place, self._rest)
            except QhullError:
                self.flat = True
                return
            corners = place[self._inside.cells.simplices]
            volume = float(np.sum(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))) / 6.0 * np.prod(self._scale))
            self.spacing = (volume / count) ** (1.0 / 3.0)

    def _placed(self, points: np.ndarray) -> np.ndarray:
        return np.asarray((points - self._middle) / self._scale)

    def _linear_at(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(self.linear.change + points @ np.array(self.linear.gradient))

    @property
    def departures(self) -> np.ndarray:
        """Departures of the nodes from the linear fit, kelvin, (N,)."""
        return self._rest

    def departure(self) -> float:
        """Largest departure of a node from the linear fit, kelvin."""
        return float(np.max(np.abs(self._rest)))

    def at(self, points: Any) -> np.ndarray:
        """Change of temperature at places (P, 3), kelvin, (P,).

        Parameters
        ----------
        points : Any
            Metres, in the frame of the nodes.
        """
        places = np.asarray(points, np.float64)
        rest = self._inside_rest(places)
        beyond = np.isnan(rest)
        if np.any(beyond):
            rest[beyond] = self._rest[self._tree.query(places[beyond])[1]]
        return self._linear_at(places) + rest

    def _inside_rest(self, places: np.ndarray) -> np.ndarray:
        """Departure from the linear fit, not a number outside of the nodes."""
        if self._inside is None:
            return np.full(len(places), np.nan)
        return self._inside(self._placed(places))

    def coverage(self, points: Any, weights: Any) -> Coverage:
        """How well the nodes cover places (P, 3) of a body, metres, that stand for parts (P,) of its volume.

        Parameters
        ----------
        points : Any
            Metres, (P, 3).
        weights : Any
            Volumes, (P,).
        """
        places, share = np.asarray(points, np.float64), np.asarray(weights, np.float64)
        distance = self._tree.query(places)[0]
        beyond = np.isnan(self._inside_rest(places)) & (distance > self.spacing)
        return Coverage(float(np.sum(share[beyond]) / np.sum(share)), float(np.max(distance)))

    @property
    def between(self) -> float:
        """Rms of the error at nodes that are left out, every second one, kelvin; worked out once.

        The others have twice the volume each; this is some 1.6 times the error of all nodes where the field is smooth.
        """
        if self._between is None:
            left = np.arange(len(self.points)) % 2 == 1
            errors = np.zeros(0)
            if not self.flat:
                place = self._placed(self.points)
                try:
                    told = _Between(place[~left], self._rest[~left])(place[left])
                    errors = (told - self._rest[left])[np.isfinite(told)]
                except QhullError:
                    errors = self._rest[left]
            self._between = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
        return self._between


def linear_part(points: Any, values: Any, weights: Any) -> tuple[Temperature, np.ndarray]:
    """The linear field nearest to temperatures by weighted least squares, and what it leaves.

    Parameters
    ----------
    points : Any
        Metres, (P, 3), not in a plane.
    values : Any
        Kelvin, (P,).
    weights : Any
        Of the squares, (P,).

    Returns
    -------
    tuple[Temperature, np.ndarray]
        The field, and values less the field, kelvin, (P,).
    """
    places, heat, root = np.asarray(points), np.asarray(values), np.sqrt(np.asarray(weights))
    middle, scale = places.mean(axis=0), np.ptp(places, axis=0)
    level = float(np.mean(heat))  # taken off first, so that an even temperature stays even to its last bit
    matrix = np.column_stack([np.ones(len(places)), (places - middle) / scale])
    solved = np.linalg.lstsq(matrix * root[:, None], (heat - level) * root, rcond=None)[0]
    slope = solved[1:] / scale
    field = Temperature(float(level + solved[0] - slope @ middle), triple(slope))
    return field, heat - level - matrix @ solved
