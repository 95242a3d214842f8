"""A displacement field on quadratic finite elements, at any point of the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from skfem import MeshHex2, MeshTet1

_INSIDE = 1e-9  # how far outside of a cell, in cells, a point may lie for that cell to be taken at once
_NEAR = 1e-3  # the same for a cell to be taken when none of the nearest cells holds the point: a curved face or rim
_BEYOND = 0.02  # how far outside of the mesh, in cells, its field is still continued
_CANDIDATES = ((12, _INSIDE), (150, _NEAR))  # how many cells to try, by distance, for points not yet placed so well


@dataclass(frozen=True, eq=False)
class Displacement:
    """Displacement field of a body.

    Attributes:
        nodes: metres, shape (N, 3).
        values: at the nodes, metres, shape (N, 3).
        finder: the cells.
    """

    nodes: np.ndarray
    values: np.ndarray
    finder: Finder

    def at(self, points: Any) -> np.ndarray:
        """Displacement at points (P, 3) of the body, by the elements' own shape functions; metres, (P, 3).

        Points outside of the mesh by up to 2 % of a cell are continued, as a curved face departs from its cells.

        Raises:
            ValueError: a point lies farther outside.
        """
        dofs, shape = self.finder.shapes(np.asarray(points, np.float64))
        return np.asarray(np.einsum("pi,pix->px", shape, self.values[dofs]))


class Finder:
    """Which cell a point lies in and the shape functions there."""

    def __init__(self, mesh: MeshHex2 | MeshTet1, element: Any, dofs: np.ndarray):
        self._element, self._dofs = element, dofs
        self._geometry = mesh.elem()
        self._corners = mesh.doflocs.T[mesh.dofs.element_dofs.T]  # (cells, J, 3)
        self._simplex = isinstance(mesh, MeshTet1)
        self._tree = cKDTree(np.mean(self._corners, axis=1))
        # load cases of one body are sampled at the same faces, one after the other
        self._last: tuple[bytes, tuple[np.ndarray, np.ndarray]] | None = None

    def shapes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (P, I) of the nodes of each point's cell and their shape functions there (P, I)."""
        if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
            raise ValueError(f"points must be finite and of shape (P, 3), found shape {points.shape}")
        key = points.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, self._found(points)
        return self._last[1]

    def _found(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As ``shapes``, by a search."""
        best = np.full(len(points), np.inf)
        cell = np.zeros(len(points), int)
        place = np.zeros_like(points)
        for count, enough in _CANDIDATES:
            left = np.flatnonzero(best > enough)
            _, near = self._tree.query(points[left], np.arange(1, min(count, self._tree.n) + 1))
            for column in near.T:
                going = best[left] > _INSIDE
                if not np.any(going):
                    break
                some, tried = left[going], column[going]
                local = self._local(points[some], tried)
                outside = np.max(np.maximum(-local, local - 1.0), axis=1)
                if self._simplex:
                    outside = np.maximum(outside, np.sum(local, axis=1) - 1.0)
                better = outside < best[some]
                chosen = some[better]
                best[chosen], cell[chosen], place[chosen] = outside[better], tried[better], local[better]
        if len(points) and np.max(best) > _BEYOND:
            raise ValueError(f"the point {points[int(np.argmax(best))].tolist()} m lies outside of the body")
        return self._dofs[:, cell].T, np.stack(
            [self._element.lbasis(place.T, i)[0] for i in range(len(self._dofs))], axis=-1
        )

    def _local(self, points: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Coordinates of points (P, 3) in the reference cells of ``cells`` (P,), by Newton; infinite where it fails."""
        corners = self._corners[cells]
        x = np.full_like(points, 0.25 if self._simplex else 0.5)
        for _ in range(1 if self._simplex else 8):
            terms = [self._geometry.lbasis(x.T, j) for j in range(corners.shape[1])]
            position = sum(np.asarray(v)[:, None] * corners[:, j] for j, (v, _) in enumerate(terms))
            slope = sum(corners[:, j, :, None] * np.asarray(d).T.reshape(-1, 1, 3) for j, (_, d) in enumerate(terms))
            step = np.linalg.solve(slope, (points - position)[..., None])[..., 0]
            x = x + step if self._simplex else np.clip(x + step, -0.5, 1.5)
            if np.max(np.abs(step)) < 1e-12:
                break
        # a point far from a cell may have no place in it; where the clipped iteration then stops means nothing
        failed = np.max(np.abs(step), axis=1, keepdims=True) > 1e-8
        return x if self._simplex else np.where(failed, np.inf, x)


def rigid_modes(points: np.ndarray) -> np.ndarray:
    """Displacements of points (P, 3) by three unit shifts and three unit rotations about the origin, (6, 3 P)."""
    shifts = np.broadcast_to(np.eye(3)[:, None, :], (3, len(points), 3))
    turns = np.cross(np.eye(3)[:, None, :], points[None])
    return np.concatenate([shifts, turns]).reshape(6, -1)
