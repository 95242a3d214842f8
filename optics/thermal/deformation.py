"""Displacement fields of heated bodies, and what they do to the faces."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, assert_never

import numpy as np
from scipy.spatial import cKDTree
from skfem import MeshHex2, MeshTet1

from optics.geometry import zernike
from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface
from optics.numerics import quadrature
from optics.numerics.frozen_map import FrozenMap
from optics.numerics.invariants import UnphysicalError

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


class Displaced(Protocol):
    """A body of which every point's displacement is known."""

    def at(self, points: Any) -> np.ndarray:
        """Displacement at points (P, 3) of the body, metres, (P, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Formula:
    """A displacement that a formula gives everywhere.

    Attributes:
        field: points (P, 3) in metres -> displacements (P, 3) in metres.
    """

    field: Callable[[np.ndarray], np.ndarray]

    def at(self, points: Any) -> np.ndarray:
        """Displacement at points (P, 3), metres, (P, 3)."""
        return self.field(np.asarray(points, np.float64))


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
        """Shape functions as ``shapes`` gives them, found by a search."""
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
            raise UnphysicalError(f"the point {points[int(np.argmax(best))].tolist()} m lies outside of the body")
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


@dataclass(frozen=True)
class FaceChange:
    """How an optical face moved and changed, in the face's own nominal frame.

    Attributes:
        rotate: small rotation vector about the frame's origin, radians.
        shift: of the frame's origin, metres.
        figure: Noll index -> metres rms over the disk, change of sag along +z; from Z4 on.
        residual_rms: what rotate, shift and figure leave of the change of sag, rms over the aperture, metres.
    """

    rotate: tuple[float, float, float]
    shift: tuple[float, float, float]
    figure: Mapping[int, float]
    residual_rms: float


def face_change(
    displacement: Displaced, surface: Surface, aperture: Aperture, pose: Pose, terms: int = 15
) -> FaceChange:
    """Rigid motion and change of figure of a face, by least squares over its aperture.

    First the rigid motion nearest to the displacement of the material is taken off. What is left changes the sag at
    fixed x, y by u_z - s_x u_x - s_y u_y (first order in u); into it Zernike terms from Z4 on are fitted, together with
    the piston and tilts that a further rigid motion of this surface makes, which then go to the rigid motion. Of a
    plane, rotate, shift and figure together thus hold the whole normal displacement but the residual.

    The disk of the terms is that of the surface's Zernike figure, else the aperture's circle, else the circle around
    the rectangle, as in the ray trace. On a narrow rectangle some combinations of terms hardly differ; those that
    show on the aperture by less than 1e-6 of their coefficients are left out, and the others serve only inside of it.

    Args:
        displacement: of the body.
        surface: the face's nominal shape.
        aperture: the part of it to look at, which must lie on the body.
        pose: of the face's frame in the mesh's.
        terms: highest Noll index, 3 for none.

    Raises:
        ValueError: the aperture reaches beyond the body, or ``terms`` is below 3.
    """
    if not 3 <= terms <= zernike.MAX_NOLL:
        raise ValueError(f"a face's terms must end between Z3 and Z{zernike.MAX_NOLL}, found {terms}")
    x, y, weight = _samples(aperture)
    disk = surface.figure_disk(aperture)
    radius, centre = disk.radius, disk.centre
    points = np.stack([x, y, surface.sag(x, y)], axis=-1)
    moved = displacement.at(pose.apply(points)) @ pose.rotation
    root = np.sqrt(weight)
    modes = rigid_modes(points).reshape(6, -1, 3)
    scale = np.array([1.0, 1.0, 1.0, 1.0 / radius, 1.0 / radius, 1.0 / radius])
    matrix = (modes * root[:, None]).reshape(6, -1).T
    rigid = np.linalg.lstsq(matrix * scale, (moved * root[:, None]).ravel(), rcond=None)[0] * scale
    rest = moved - np.einsum("k,kpx->px", rigid, modes)
    # differences over 1e-5 of the aperture: slopes to about 1e-10, far below what a displacement needs
    h = 1e-5 * radius
    slope = np.stack([surface.sag(x + h, y) - surface.sag(x - h, y), surface.sag(x, y + h) - surface.sag(x, y - h)])
    slope = slope / (2.0 * h)

    def sag_change(u: np.ndarray) -> np.ndarray:
        return np.asarray(u[..., 2] - slope[0] * u[..., 0] - slope[1] * u[..., 1])

    change = sag_change(rest)
    z = zernike.basis(terms, (x - centre[0]) / radius, (y - centre[1]) / radius)[:, 3:]
    further = sag_change(modes[2:5]).T * scale[2:5]  # piston and two tilts, of the size of the terms
    columns = np.concatenate([further, z], axis=1)
    fitted = np.linalg.lstsq(columns * root[:, None], change * root, rcond=zernike.HELD)[0]
    rigid[2:5] += fitted[:3] * scale[2:5]
    residual = change - columns @ fitted
    return FaceChange(
        (float(rigid[3]), float(rigid[4]), float(rigid[5])),
        (float(rigid[0]), float(rigid[1]), float(rigid[2])),
        FrozenMap({j: float(a) for j, a in zip(range(4, terms + 1), fitted[3:], strict=True)}),
        float(np.sqrt(np.sum(weight * residual**2))),
    )


def _samples(aperture: Aperture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quadrature nodes x, y over an aperture and weights of a mean, each shape (P,)."""
    match aperture:
        case Circle():
            nodes = quadrature.disk(10, inner=aperture.inner / aperture.radius)
            half = (aperture.radius, aperture.radius)
            u, v, weight = nodes.x, nodes.y, nodes.share
        case Ellipse():
            nodes = quadrature.disk(10)
            half = (aperture.half_x, aperture.half_y)
            u, v, weight = nodes.x, nodes.y, nodes.share
        case Rectangle():
            s, w = quadrature.gauss(16)
            half = (aperture.half_x, aperture.half_y)
            u, v, weight = np.tile(s, 16), np.repeat(s, 16), np.outer(w, w).ravel() / 4.0
        case _:
            assert_never(aperture)
    return aperture.centre[0] + half[0] * u, aperture.centre[1] + half[1] * v, weight
