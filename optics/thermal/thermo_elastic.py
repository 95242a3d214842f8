"""Linear thermo-elasticity: how a body of one isotropic material deforms when its temperature changes.

Small strains: stress = lambda tr(e) 1 + 2 mu e - (3 lambda + 2 mu) a T 1, with e the symmetric gradient of the
displacement u (metres), T the change of temperature (kelvin) and a the expansion (1/K). u minimises the elastic energy,
in which Young's modulus is only a factor as long as all loads are thermal. Elements are quadratic (scikit-fem:
hexahedra of 27 nodes, tetrahedra of 10), so on straight-edged cells the displacement of a body that is free and whose T
is linear in place comes out exact to rounding. Rotations are small: vectors in radians, right-handed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, assert_never

import numpy as np
from scipy.linalg import qr
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu
from skfem import CellBasis, ElementHex2, ElementTetP2, MeshHex2, MeshTet1

from optics.materials.material import Material
from optics.numerics.invariants import UnphysicalError
from optics.thermal.deformation import Displacement, Finder, rigid_modes

Field = Callable[[np.ndarray], Any]
"""Something at points: (P, 3) metres -> (P,)."""


@dataclass(frozen=True, eq=False)
class Kinematic:
    """Three balls in cone, groove and flat (3-2-1): they hold the body without stress.

    Point 0 stays where it is, point 1 moves only along the line from 0 to 1, point 2 only in the plane of the three.

    Attributes:
        points: in or on the body, metres, shape (3, 3); they need not be nodes.
    """

    points: np.ndarray

    def __post_init__(self) -> None:
        """Copy, freeze and check."""
        points = np.array(self.points, np.float64)
        if points.shape != (3, 3) or not np.all(np.isfinite(points)):
            raise ValueError(f"a kinematic support needs three finite points (3, 3), found shape {points.shape}")
        if _on_a_line(points):
            raise UnphysicalError("the three points of a kinematic support lie on a line")
        points.setflags(write=False)
        object.__setattr__(self, "points", points)

    def released(self, motion: np.ndarray) -> np.ndarray:
        """The six components of displacements (3 points, 3) that this support forbids, metres, shape (6,)."""
        along = self.points[1] - self.points[0]
        along = along / np.linalg.norm(along)
        normal = np.cross(along, self.points[2] - self.points[0])
        normal = normal / np.linalg.norm(normal)
        across = np.cross(normal, along)
        return np.array([*motion[0], across @ motion[1], normal @ motion[1], normal @ motion[2]])


@dataclass(frozen=True, eq=False)
class Bonded:
    """A part of the body's surface glued to a stiff foundation that expands by itself.

    The glued nodes move by expansion * change * (r - about).

    Attributes:
        where: nodes (N, 3) in metres -> which of them are glued, (N,) bool.
        expansion: of the foundation, 1/K.
        change: of the foundation's temperature, kelvin.
        about: the point of the foundation that stays, metres, shape (3,).
    """

    where: Field
    expansion: float = 0.0
    change: float = 0.0
    about: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not np.all(np.isfinite([self.expansion, self.change, *self.about])):
            raise ValueError("a foundation needs a finite expansion, temperature change and fixed point")


Support = Kinematic | Bonded


class ElasticBody:
    """A mesh of one material with its stiffness; factorisations are kept for further load cases.

    Attributes:
        nodes: all nodes of the quadratic elements, metres, shape (N, 3).
        places: at which loads are taken, metres, (P, 3); volumes: that they stand for, m^3, (P,).
    """

    def __init__(self, mesh: MeshHex2 | MeshTet1, material: Material):
        hexahedra = isinstance(mesh, MeshHex2)
        element = ElementHex2() if hexahedra else ElementTetP2()
        # exact stiffness on straight-edged cells: 3 x 3 x 3 Gauss points, or degree 4 on tetrahedra
        basis = CellBasis(mesh, element, intorder=5 if hexahedra else 4)
        self.nodes = np.ascontiguousarray(basis.doflocs.T)
        self._material = material
        self._finder = Finder(mesh, element, basis.element_dofs)
        self._points = np.moveaxis(np.asarray(basis.global_coordinates()), 0, -1)  # (cells, Q, 3)
        self.places = self._points.reshape(-1, 3)
        # evenly within a cell: Gauss' weights of tetrahedra may be negative
        self.volumes = np.repeat(np.mean(basis.dx, axis=1), self._points.shape[1])
        gradient = np.stack([np.asarray(b[0].grad) for b in basis.basis]).transpose(2, 0, 1, 3)  # (cells, I, 3, Q)
        cells, local, _, _ = gradient.shape
        self._weighted = (gradient * basis.dx[:, None, None, :]).reshape(cells, 3 * local, -1)
        pairs = self._weighted @ gradient.reshape(cells, 3 * local, -1).transpose(0, 2, 1)
        pairs = pairs.reshape(cells, local, 3, local, 3)  # integral of d_a phi_i d_b phi_j at [i, a, j, b]
        # Lame's constants in units of Young's modulus
        nu = material.poisson_ratio
        lame, shear = nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), 0.5 / (1.0 + nu)
        stiffness = lame * pairs + shear * pairs.transpose(0, 1, 4, 3, 2)
        both = shear * np.einsum("eiaja->eij", pairs)
        for a in range(3):
            stiffness[:, :, a, :, a] += both
        self._dofs = (3 * basis.element_dofs.T[:, :, None] + np.arange(3)).reshape(cells, -1)
        size = (cells, 3 * local, 3 * local)
        rows, columns = np.broadcast_to(self._dofs[:, :, None], size), np.broadcast_to(self._dofs[:, None, :], size)
        total = (3 * len(self.nodes), 3 * len(self.nodes))
        self._stiffness = coo_matrix((stiffness.ravel(), (rows.ravel(), columns.ravel())), total).tocsr()
        self._factors: dict[bytes, tuple[np.ndarray, Any]] = {}

    def solve_many(
        self, temperatures: Sequence[Field], support: Support | Sequence[Support]
    ) -> tuple[Displacement, ...]:
        """One displacement for each temperature change.

        Load cases on supports that hold the same nodes share one factorisation, and so do all kinematic supports.

        Args:
            temperatures: changes of temperature in kelvin, points (P, 3) -> (P,).
            support: one for all, or one for each load case.

        Raises:
            ValueError: a temperature is not finite or of another shape, a bond holds too few nodes, or a kinematic
                point lies outside of the body.
        """
        supports = [support] * len(temperatures) if isinstance(support, Kinematic | Bonded) else list(support)
        out = []
        for temperature, held in zip(temperatures, supports, strict=True):
            load = self._load(temperature)
            match held:
                case Bonded():
                    glued = self._glued(held)
                    moved = held.expansion * held.change * (self.nodes[glued] - np.asarray(held.about))
                    fixed = (3 * glued[:, None] + np.arange(3)).ravel()
                    values = self._solved(load, fixed, moved.ravel())
                case Kinematic():
                    # thermal loads are in balance, so any six components may be held to solve; the support's own come
                    # after
                    modes = rigid_modes(self.nodes)
                    fixed = np.sort(qr(modes, mode="r", pivoting=True)[1][:6])
                    values = self._supported(self._solved(load, fixed, np.zeros(6)), held)
                case _:
                    assert_never(held)
            out.append(Displacement(self.nodes, values, self._finder))
        return tuple(out)

    def _load(self, temperature: Field) -> np.ndarray:
        """Thermal forces over Young's modulus, shape (3 N,)."""
        points = self.places
        change = np.asarray(temperature(points), np.float64)
        if change.shape != (len(points),):
            raise ValueError(f"a temperature field needs one value for each of {len(points)} points: {change.shape}")
        if not np.all(np.isfinite(change)):
            where = points[int(np.argmin(np.isfinite(change)))]
            raise ValueError(f"the temperature change is not finite at {where.tolist()} m")
        bulk = self._material.expansion / (1.0 - 2.0 * self._material.poisson_ratio)  # (3 lambda + 2 mu) a / E
        forces = bulk * np.einsum("eiq,eq->ei", self._weighted, change.reshape(self._points.shape[:2]))
        return np.bincount(self._dofs.ravel(), forces.ravel(), 3 * len(self.nodes))

    def _glued(self, support: Bonded) -> np.ndarray:
        """Numbers of the nodes that a bond holds."""
        chosen = np.flatnonzero(np.asarray(support.where(self.nodes), bool))
        if len(chosen) < 3 or _on_a_line(self.nodes[chosen]):
            raise UnphysicalError(
                f"a bonded support needs three nodes that are not on a line; it holds {len(chosen)} nodes"
            )
        return chosen

    def _solved(self, load: np.ndarray, fixed: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Nodal displacements (N, 3) with the components ``fixed`` held at ``values``."""
        key = fixed.tobytes()
        if key not in self._factors:
            free = np.setdiff1d(np.arange(len(load)), fixed)
            # symmetric and definite: an ordering for A + A' and no pivoting halve SuperLU's fill
            matrix = self._stiffness[free][:, free].tocsc()
            options = {"SymmetricMode": True}
            self._factors[key] = free, splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        free, factor = self._factors[key]
        out = np.zeros(len(load))
        out[fixed] = values
        for _ in range(2):  # the second pass refines: thin bodies are ill conditioned
            out[free] += factor.solve((load - self._stiffness @ out)[free])
        return out.reshape(-1, 3)

    def _supported(self, values: np.ndarray, support: Kinematic) -> np.ndarray:
        """Move a deformation rigidly to where the support lets it be."""
        at_points = Displacement(self.nodes, values, self._finder).at(support.points)
        modes = rigid_modes(support.points).reshape(6, 3, 3)
        matrix = np.stack([support.released(mode) for mode in modes], axis=-1)
        amount = np.linalg.solve(matrix, -support.released(at_points))
        return values + np.einsum("k,kx->x", amount, rigid_modes(self.nodes)).reshape(-1, 3)


def free_linear_field(
    expansion: float, change: float, gradient: Any, about: Any = (0.0, 0.0, 0.0)
) -> Callable[[np.ndarray], np.ndarray]:
    """Exact displacement of a free body whose temperature changes by T = change + gradient . (r - about).

    u = a change q + a ((g . q) q - q^2 g / 2) with q = r - about. Its strain is a T in all directions, so there is no
    stress in any shape of body. Of all rigid motions the one is chosen that leaves ``about`` in place and unturned;
    elsewhere the body turns by the rotation a (g x q).

    Args:
        expansion: a, 1/K.
        change: kelvin at ``about``.
        gradient: g, K/m, shape (3,).
        about: metres, shape (3,).

    Returns:
        Points (P, 3) in metres -> displacements (P, 3) in metres.
    """
    g, origin = np.asarray(gradient, np.float64), np.asarray(about, np.float64)

    def displacement(points: np.ndarray) -> np.ndarray:
        q = np.asarray(points, np.float64) - origin
        square = np.sum(q * q, axis=-1, keepdims=True)
        return np.asarray(expansion * (change * q + (q @ g)[..., None] * q - 0.5 * square * g))

    return displacement


def _on_a_line(points: np.ndarray) -> bool:
    """True when points (P, 3) span no plane, within 1e-6 of their extent."""
    spread = np.linalg.svd(points - np.mean(points, axis=0), compute_uv=False)
    return bool(spread[1] <= 1e-6 * spread[0])
