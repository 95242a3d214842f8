"""Linear thermo-elasticity: thermal deformation of a body of one isotropic material, and changes of its faces.

Small strains: stress = lambda tr(e) 1 + 2 mu e - (3 lambda + 2 mu) a T 1, with e the symmetric gradient of the
displacement u (metres), T the change of temperature (kelvin) and a the expansion (1/K). u minimises the elastic energy,
in which Young's modulus is only a factor as long as all loads are thermal. Elements are quadratic (scikit-fem:
hexahedra of 27 nodes, tetrahedra of 10), so on straight-edged cells the displacement of a free body whose T is linear
in position is exact to rounding. Rotations are small: vectors in radians, right-handed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, assert_never

import numpy as np
from scipy.linalg import qr
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from skfem import CellBasis, ElementHex2, ElementTetP2, MeshHex2, MeshTet1

from optics.geometry import zernike
from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface
from optics.materials.material import Material
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.numerics.number_tree import FrozenMap

_INSIDE = 1e-9  # largest distance outside a cell, in cells, at which it is accepted at once
_NEAR = 1e-3  # largest distance at which it is accepted if no cell contains the point: a curved face or rim
_BEYOND = 0.02  # largest distance outside the mesh, in cells, to which its field is extrapolated
_CANDIDATES = ((12, _INSIDE), (150, _NEAR))  # numbers of nearest cells to try, until the distance is reached


@dataclass(frozen=True, eq=False)
class Displacement:
    """Displacement field of a body, given at the N nodes of a mesh.

    Attributes
    ----------
    nodes : (N, 3) ndarray
        Nodes, metres.
    values : (N, 3) ndarray
        Displacements at the nodes, metres.
    finder : Finder
        Search for the cells of points.
    """

    nodes: np.ndarray
    values: np.ndarray
    finder: Finder

    def at(self, points: Any) -> np.ndarray:
        """Return the displacement at P points (P, 3) of the body, by the elements' own shape functions; metres, (P, 3).

        Points outside the mesh by up to 2 % of a cell are extrapolated, as a curved face deviates from its cells.

        Raises
        ------
        ValueError
            A point lies farther outside.
        """
        dofs, shape = self.finder.shapes(np.asarray(points, np.float64))
        return np.asarray(np.einsum("pi,pix->px", shape, self.values[dofs]))


class Displaced(Protocol):
    """Interface of a body whose displacement is known at every point."""

    def at(self, points: Any) -> np.ndarray:
        """Return the displacement at P points (P, 3) of the body, metres, (P, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Formula:
    """Displacement given everywhere by a formula.

    Attributes
    ----------
    field : callable
        P points (P, 3) in metres -> displacements (P, 3) in metres.
    """

    field: Callable[[np.ndarray], np.ndarray]

    def at(self, points: Any) -> np.ndarray:
        """Return the displacement at P points (P, 3) by the formula, metres, (P, 3)."""
        return self.field(np.asarray(points, np.float64))


class Finder:
    """Search for the cell of a point, and its shape functions there."""

    def __init__(self, mesh: MeshHex2 | MeshTet1, element: Any, dofs: np.ndarray):
        self._element, self._dofs = element, dofs
        self._geometry = mesh.elem()
        self._corners = mesh.doflocs.T[mesh.dofs.element_dofs.T]  # (cells, J, 3)
        self._simplex = isinstance(mesh, MeshTet1)
        self._tree = cKDTree(np.mean(self._corners, axis=1))
        # cached: load cases of one body are sampled at the same faces, one after the other
        self._last: tuple[bytes, tuple[np.ndarray, np.ndarray]] | None = None

    def shapes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the I nodes of the cell that contains each of P points, and their shape functions at the point.

        Both have the shape (P, I); the nodes are given by their indices.
        """
        if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
            raise ValueError(f"points must be finite and of shape (P, 3), found shape {points.shape}")
        key = points.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, self._search(points)
        return self._last[1]

    def _search(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return indices of nodes and shape functions at points by a search among the nearest cells.

        The result is that of ``shapes``.
        """
        best = np.full(len(points), np.inf)
        cell = np.zeros(len(points), int)
        reference = np.zeros_like(points)
        for count, enough in _CANDIDATES:
            pending = np.flatnonzero(best > enough)
            _, near = self._tree.query(points[pending], np.arange(1, min(count, self._tree.n) + 1))
            for column in near.T:
                unlocated = best[pending] > _INSIDE
                if not np.any(unlocated):
                    break
                rows, tried = pending[unlocated], column[unlocated]
                local = self._local(points[rows], tried)
                outside = np.max(np.maximum(-local, local - 1.0), axis=1)
                if self._simplex:
                    outside = np.maximum(outside, np.sum(local, axis=1) - 1.0)
                better = outside < best[rows]
                chosen = rows[better]
                best[chosen], cell[chosen], reference[chosen] = outside[better], tried[better], local[better]
        if len(points) and np.max(best) > _BEYOND:
            raise UnphysicalError(f"the point {points[int(np.argmax(best))].tolist()} m lies outside of the body")
        return self._dofs[:, cell].T, np.stack(
            [self._element.lbasis(reference.T, i)[0] for i in range(len(self._dofs))], axis=-1
        )

    def _local(self, points: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Return the coordinates of P points (P, 3) within given cells (P,); infinite where Newton's method fails.

        They are coordinates of the element's reference shape, the unit cube or tetrahedron.
        """
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
        # a point far from a cell may have no reference coordinates; the iteration's result is then meaningless
        failed = np.max(np.abs(step), axis=1, keepdims=True) > 1e-8
        return x if self._simplex else np.where(failed, np.inf, x)


def rigid_modes(points: np.ndarray) -> np.ndarray:
    """Return the displacements of P points (P, 3) due to unit shifts along and rotations about the axes, (6, 3 P)."""
    shifts = np.broadcast_to(np.eye(3)[:, None, :], (3, len(points), 3))
    rotations = np.cross(np.eye(3)[:, None, :], points[None])
    return np.concatenate([shifts, rotations]).reshape(6, -1)


@dataclass(frozen=True)
class FaceChange:
    """Motion and change of figure of an optical face, in the face's own nominal frame.

    Attributes
    ----------
    rotate : tuple of float
        Small rotation vector about the frame's origin, radians.
    shift : tuple of float
        Translation of the frame's origin, metres.
    figure : mapping of int to float
        Noll index -> amplitude of the change of sag along +z, metres rms over the disk; from Z4 on.
    residual_rms : float
        Rms over the aperture of the change of sag that rotate, shift and figure do not describe, metres.
    """

    rotate: tuple[float, float, float]
    shift: tuple[float, float, float]
    figure: Mapping[int, float]
    residual_rms: float


def face_change(
    displacement: Displaced, surface: Surface, aperture: Aperture, pose: Pose, terms: int = 15
) -> FaceChange:
    """Return the rigid motion and change of figure of a face, by least squares over its aperture.

    First the rigid motion nearest to the displacement u of the material is subtracted. The remainder changes the sag at
    fixed x, y by u_z - s_x u_x - s_y u_y (first order in u), with s_x and s_y the slopes of the surface. Zernike terms
    from Z4 on are fitted to it, together with the piston and tilts that a further rigid motion of this surface makes,
    which are then added to the rigid motion. For a plane, rotate, shift and figure together thus describe the whole
    normal displacement except the residual.

    The disk of the terms is that of the surface's Zernike figure, else the aperture's circle, else the circle around
    the rectangle, as in the ray trace. On a narrow rectangle some combinations of terms are nearly dependent; those
    whose size on the aperture is less than 1e-6 of their coefficients are excluded, and the others are valid only
    inside of it.

    Parameters
    ----------
    displacement : Displaced
        Displacement of the body.
    surface : Surface
        Nominal shape of the face.
    aperture : Circle, Rectangle or Ellipse
        Part of the face to analyse, which must lie on the body.
    pose : Pose
        Pose of the face's frame in the mesh's.
    terms : int
        Highest Noll index, 3 for no Zernike terms.

    Raises
    ------
    ValueError
        The aperture extends beyond the body, or ``terms`` is below 3.
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
    further = sag_change(modes[2:5]).T * scale[2:5]  # piston and two tilts, scaled like the terms
    columns = np.concatenate([further, z], axis=1)
    fitted = np.linalg.lstsq(columns * root[:, None], change * root, rcond=zernike.RANK_TOLERANCE)[0]
    rigid[2:5] += fitted[:3] * scale[2:5]
    residual = change - columns @ fitted
    return FaceChange(
        (float(rigid[3]), float(rigid[4]), float(rigid[5])),
        (float(rigid[0]), float(rigid[1]), float(rigid[2])),
        FrozenMap({j: float(a) for j, a in zip(range(4, terms + 1), fitted[3:], strict=True)}),
        float(np.sqrt(np.sum(weight * residual**2))),
    )


def _samples(aperture: Aperture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return P quadrature nodes x, y over an aperture, metres, and the weights of a mean over it, (P,) each."""
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


Field = Callable[[np.ndarray], Any]
"""Function of position: P points (P, 3) in metres -> values (P,), e.g. changes of temperature."""


@dataclass(frozen=True, eq=False)
class Kinematic:
    """Kinematic support by three balls in cone, groove and flat (3-2-1), which holds the body without stress.

    Point 0 is fixed, point 1 moves only along the line from 0 to 1, point 2 only in the plane of the three.

    Attributes
    ----------
    points : (3, 3) ndarray
        Support points in or on the body, metres; they need not be nodes.
    """

    points: np.ndarray

    def __post_init__(self) -> None:
        """Copy and freeze the points, and check that they are three that do not lie on a line."""
        points = np.array(self.points, np.float64)
        if points.shape != (3, 3) or not np.all(np.isfinite(points)):
            raise ValueError(f"a kinematic support needs three finite points (3, 3), found shape {points.shape}")
        if _on_a_line(points):
            raise UnphysicalError("the three points of a kinematic support lie on a line")
        points.setflags(write=False)
        object.__setattr__(self, "points", points)

    def released(self, motion: np.ndarray) -> np.ndarray:
        """Return the six displacement components that the support holds at zero, metres, from those of its points.

        They are those of point 0 in all directions, of point 1 perpendicular to the line from 0 to 1, and of point 2
        perpendicular to the plane; ``motion`` (3, 3) are the displacements of the three points, metres.
        """
        along = self.points[1] - self.points[0]
        along = along / np.linalg.norm(along)
        normal = np.cross(along, self.points[2] - self.points[0])
        normal = normal / np.linalg.norm(normal)
        across = np.cross(normal, along)
        return np.array([*motion[0], across @ motion[1], normal @ motion[1], normal @ motion[2]])


@dataclass(frozen=True, eq=False)
class Bonded:
    """Part of the body's surface bonded to a stiff foundation that expands independently.

    The bonded nodes, at r, move by expansion * change * (r - about).

    Attributes
    ----------
    where : callable
        N nodes (N, 3) in metres -> mask of the bonded ones, (N,) bool.
    expansion : float
        Thermal expansion of the foundation, 1/K.
    change : float
        Temperature change of the foundation, kelvin.
    about : tuple of float
        Fixed point of the foundation, metres.
    """

    where: Field
    expansion: float = 0.0
    change: float = 0.0
    about: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check that expansion, temperature change and fixed point are finite."""
        if not np.all(np.isfinite([self.expansion, self.change, *self.about])):
            raise ValueError("a foundation needs a finite expansion, temperature change and fixed point")


Support = Kinematic | Bonded


class ElasticBody:
    """Mesh of one material with its stiffness matrix; factorisations are cached for further load cases.

    Attributes
    ----------
    nodes : (N, 3) ndarray
        All N nodes of the quadratic elements, metres.
    points : (P, 3) ndarray
        P quadrature points at which loads are evaluated, metres.
    volumes : (P,) ndarray
        Volumes that the quadrature points represent, m^3.
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
        self.points = self._points.reshape(-1, 3)
        # uniform within a cell, since Gauss weights of tetrahedra may be negative
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
        """Return the displacement of the body for each of several changes of temperature.

        Load cases on supports that hold the same nodes share one factorisation, and so do all kinematic supports.

        Parameters
        ----------
        temperatures : sequence of callable
            Changes of temperature in kelvin, each a function of P points, (P, 3) -> (P,).
        support : Kinematic or Bonded, or a sequence of them
            One support for all, or one for each load case.

        Raises
        ------
        ValueError
            A temperature is not finite or of another shape, a bond holds too few nodes, or a kinematic point lies
            outside the body.
        """
        supports = [support] * len(temperatures) if isinstance(support, Kinematic | Bonded) else list(support)
        out = []
        for temperature, case in zip(temperatures, supports, strict=True):
            load = self._load(temperature)
            match case:
                case Bonded():
                    bonded = self._bonded_nodes(case)
                    moved = case.expansion * case.change * (self.nodes[bonded] - np.asarray(case.about))
                    fixed = (3 * bonded[:, None] + np.arange(3)).ravel()
                    values = self._solved(load, fixed, moved.ravel())
                case Kinematic():
                    # thermal loads are in equilibrium, so any six components may be fixed to solve; the support's
                    # constraints are applied afterwards
                    modes = rigid_modes(self.nodes)
                    fixed = np.sort(qr(modes, mode="r", pivoting=True)[1][:6])
                    values = self._supported(self._solved(load, fixed, np.zeros(6)), case)
                case _:
                    assert_never(case)
            out.append(Displacement(self.nodes, values, self._finder))
        return tuple(out)

    def _load(self, temperature: Field) -> np.ndarray:
        """Return the thermal forces at the N nodes divided by Young's modulus, (3 N,), m^2."""
        points = self.points
        change = np.asarray(temperature(points), np.float64)
        if change.shape != (len(points),):
            raise ValueError(f"a temperature field needs one value for each of {len(points)} points: {change.shape}")
        if not np.all(np.isfinite(change)):
            point = points[int(np.argmin(np.isfinite(change)))]
            raise ValueError(f"the temperature change is not finite at {point.tolist()} m")
        bulk = self._material.expansion / (1.0 - 2.0 * self._material.poisson_ratio)  # (3 lambda + 2 mu) a / E
        forces = bulk * np.einsum("eiq,eq->ei", self._weighted, change.reshape(self._points.shape[:2]))
        return np.bincount(self._dofs.ravel(), forces.ravel(), 3 * len(self.nodes))

    def _bonded_nodes(self, support: Bonded) -> np.ndarray:
        """Return the indices of the nodes that a bond holds."""
        chosen = np.flatnonzero(np.asarray(support.where(self.nodes), bool))
        if len(chosen) < 3 or _on_a_line(self.nodes[chosen]):
            raise UnphysicalError(f"a bonded support needs three nodes that are not on a line; it has {len(chosen)}")
        return chosen

    def _solved(self, load: np.ndarray, fixed: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the displacements (N, 3) of N nodes, metres, due to a load, with some components prescribed.

        ``load`` (3 N,) are forces divided by Young's modulus, m^2; ``fixed`` are the indices of the prescribed
        components and ``values`` their displacements, metres.
        """
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
        """Return nodal displacements plus the rigid motion that makes them satisfy a kinematic support."""
        at_points = Displacement(self.nodes, values, self._finder).at(support.points)
        modes = rigid_modes(support.points).reshape(6, 3, 3)
        matrix = np.stack([support.released(mode) for mode in modes], axis=-1)
        amount = np.linalg.solve(matrix, -support.released(at_points))
        return values + np.einsum("k,kx->x", amount, rigid_modes(self.nodes)).reshape(-1, 3)


def free_linear_field(
    expansion: float, change: float, gradient: Any, about: Any = (0.0, 0.0, 0.0)
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the exact displacement of a free body whose change of temperature is linear in position.

    At r the temperature changes by T = change + g . q, with q = r - about and g the gradient, and the displacement is u
    = a change q + a ((g . q) q - q^2 g / 2), with a the expansion. Its strain is a T in all directions, so there is no
    stress in any shape of body. Of all rigid motions the one is chosen that leaves ``about`` fixed without rotation;
    elsewhere the body rotates by a (g x q).

    Parameters
    ----------
    expansion : float
        Thermal expansion a, 1/K.
    change : float
        Change of temperature at ``about``, kelvin.
    gradient : (3,) array_like
        Gradient g, K/m.
    about : (3,) array_like
        Fixed point, metres.

    Returns
    -------
    callable
        P points (P, 3) in metres -> displacements (P, 3) in metres.
    """
    g, origin = np.asarray(gradient, np.float64), np.asarray(about, np.float64)

    def displacement(points: np.ndarray) -> np.ndarray:
        q = np.asarray(points, np.float64) - origin
        square = np.sum(q * q, axis=-1, keepdims=True)
        return np.asarray(expansion * (change * q + (q @ g)[..., None] * q - 0.5 * square * g))

    return displacement


def _on_a_line(points: np.ndarray) -> bool:
    """Return True when P points (P, 3) lie on one line, within 1e-6 of their extent."""
    spread = np.linalg.svd(points - np.mean(points, axis=0), compute_uv=False)
    return bool(spread[1] <= 1e-6 * spread[0])
