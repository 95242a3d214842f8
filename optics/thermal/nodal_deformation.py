"""Motion and figure change of an optical face from the nodal displacements of a finite-element program.

The nodes' displacements are decomposed in this order, each part from the remainder of the one before:

1. the rigid motion and the scale nearest to the displacements of the material, by weighted least squares with an exact
   rotation (Umeyama 1991, doi 10.1109/34.88573). A node's weight is the part of the clear aperture that is nearer to it
   than to any other (its Voronoi cell), so that a finer mesh in one place does not count more;
2. the change of sag at the node's new position. The deformed surface goes through the displaced nodes: a node that
   slides along the surface is compared with the nominal surface at its new position, so that no slope is neglected;
3. Zernike terms of that change, from piston on: the nearest rigid motion of the material leaves piston and tilts of the
   optical surface as it slides;
4. the remainder as a cubic spline on a grid, with the smallest bending where there are no nodes.

The error between the nodes is estimated by leaving out every second node and predicting it from the spline of the
others. A residual that is not predicted changes from node to node: the mesh prints through, or is too coarse.

Temperatures at the nodes of another program's mesh, interpolated to any point of a body.

Between the nodes the temperature is linear in Delaunay tetrahedra, as in the simplest elements of thermal programs; a
linear field is reproduced to rounding by any mesh. Outside the nodes a point takes the deviation of its nearest node
from the nodes' linear fit. The error between the nodes is estimated by leaving out every second node and predicting it
from the others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.geometry import zernike
from optics.geometry.aperture import Aperture
from optics.geometry.pose import triple
from optics.geometry.surface import GridFigure, Surface
from optics.geometry.tree import Motion
from optics.numerics.array_math import PhysicalError
from optics.numerics.number_tree import FrozenMap
from optics.thermal.heat import Temperature

if TYPE_CHECKING:  # imported late: scipy is slow, and every job imports this module
    from scipy.sparse import sparray

TERMS = 36
"""Default number of Zernike terms, in Noll's order: all to the seventh radial order."""
OFF_SURFACE = 2e-4
"""Largest distance from the nominal surface at which a node counts as on it, in radii of the figure's disk.

Errors of coordinates with seven digits and of the chords of coarse elements are smaller; the back of a mirror is
farther.
"""
MIN_NODES = 16
"""Smallest number of nodes on the clear aperture."""
MAX_GAP = 4.0
"""Largest allowed distance from a point of the aperture to its nearest node, in mean spacings of the nodes."""
MAX_SCALE_CHANGE = 0.02
"""Largest accepted relative expansion of the face; beyond it the displacements probably have another unit."""
MAX_SAG_CHANGE = 1e-3
"""Largest accepted change of sag, metres; beyond it the table probably has another unit or frame than it says."""
PRINTED = 0.3
"""Ratio of the error at left-out nodes to the rms residual above which the residual is attributed to the mesh."""
SEEN = 1e-9
"""Error of sag, metres rms, below which no mesh print-through is reported: 1/300 of a wave in reflected light."""

_LATTICE = 5  # lattice points per node spacing, by which the cells are measured
_FINEST = 1200  # largest number of lattice points along the aperture
_MARGIN = 5  # samples of the grid beyond the aperture, since the spline has zero slope at its edges
_MOST_SAMPLES = 160  # largest number of samples along the longer side of the grid
_BENDING = 1e-6  # weight of a second difference of spline coefficients against a node's residual
_ROUNDING = 1e-14  # metres rms; a smaller residual is rounding and gets no grid


class NodesError(PhysicalError, ValueError):
    """Error: the nodes of a table do not describe the optical face.

    Attributes
    ----------
    allowed : str
        What is allowed, in words.
    """

    def __init__(self, problem: str, allowed: str) -> None:
        super().__init__(problem)
        self.allowed = allowed


@dataclass(frozen=True, eq=False)
class NodalDeformation:
    """Deformation of a face from the nodes' displacements, in its own nominal frame.

    Attributes
    ----------
    rotate : tuple of float
        Exact rotation vector about the frame's origin, radians.
    shift : tuple of float
        Translation of the frame's origin, metres.
    expansion : float
        Relative scale of the surface about the origin.
    figure : FrozenMap of int to float
        Noll index -> amplitude of the change of sag along +z, metres rms over the disk; from Z1 on.
    grid : GridFigure, optional
        Change of sag beyond these terms, on a grid; None where it is below rounding.
    points : (K, 2) ndarray
        Positions x, y of the K nodes used, on the moved face, metres.
    weight : (K,) ndarray
        Fraction of the clear aperture that belongs to each of these nodes.
    change : (K,) ndarray
        Change of sag at the nodes beyond the rigid motion and scale, metres.
    residual : (K,) ndarray
        Change of sag minus the Zernike terms, metres.
    lost : (K,) ndarray
        Residual minus the grid, metres.
    between : float
        Rms error at left-out nodes (every second one), metres; the error of the full mesh between its nodes is smaller.
    spacing : float
        Mean distance of the nodes, metres.
    others : int
        Number of nodes not used, off the surface or outside the aperture.
    """

    rotate: tuple[float, float, float]
    shift: tuple[float, float, float]
    expansion: float
    figure: FrozenMap[int, float]
    grid: GridFigure | None
    points: np.ndarray
    weight: np.ndarray
    change: np.ndarray
    residual: np.ndarray
    lost: np.ndarray
    between: float
    spacing: float
    others: int = field(default=0)

    def rms(self, values: np.ndarray) -> float:
        """Return the root mean square over the clear aperture of values at the K nodes (K,), in their unit."""
        return float(np.sqrt(np.sum(self.weight * values**2)))

    def range(self, values: np.ndarray) -> float:
        """Return the largest minus the smallest of values at the K nodes (K,), within the clear aperture."""
        inside = values[self.weight > 0.0]
        return float(np.ptp(inside))

    @property
    def printed_through(self) -> bool:
        """True when a significant part of the residual changes from node to node (mesh print-through)."""
        return self.between > SEEN and self.between > PRINTED * self.rms(self.residual)

    def motion(self) -> Motion:
        """Return the deformation as a motion of the face's body."""
        return Motion(self.rotate, self.shift, figure=self.figure, expansion=self.expansion, grid=self.grid)


def nodal_deformation(
    nodes: Any, displacements: Any, surface: Surface, aperture: Aperture, terms: int = TERMS
) -> NodalDeformation:
    """Decompose the displacements of N nodes into a motion, Zernike terms and a grid.

    Nodes off the surface, such as those inside the body, are ignored. The order of the nodes has no effect.

    Parameters
    ----------
    nodes : (N, 3) array_like
        Nominal positions in the face's frame, metres.
    displacements : (N, 3) array_like
        Displacements, metres.
    surface : Surface
        Nominal shape of the face.
    aperture : Circle, Rectangle or Ellipse
        Clear aperture, which the nodes have to cover.
    terms : int
        Highest Noll index, 3 or more.

    Raises
    ------
    NodesError
        There are too few nodes on the surface, a gap between them, or displacements of another unit.
    """
    if not 3 <= terms <= zernike.MAX_NOLL:
        raise ValueError(f"the terms must end between Z3 and Z{zernike.MAX_NOLL}, found {terms}")
    points, moves = np.asarray(nodes, np.float64), np.asarray(displacements, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != moves.shape:
        raise ValueError(f"nodes and displacements must be (N, 3), found {points.shape} and {moves.shape}")
    if not (np.all(np.isfinite(points)) and np.all(np.isfinite(moves))):
        raise ValueError("nodes and displacements must be finite")
    order = np.lexsort(np.hstack([moves, points]).T)
    points, moves, spacing = _on_face(points[order], moves[order], surface, aperture)
    weight = _cells(points[:, :2], aperture, spacing)
    rotation, shift, size = _similarity(points, moves, weight)
    if abs(size - 1.0) > MAX_SCALE_CHANGE:
        text = f"the nodes' displacements scale the face by {100.0 * (size - 1.0):.3g} %"
        raise NodesError(f"{text}, more than {100.0 * MAX_SCALE_CHANGE:g} %: check their unit", _CHECK)
    # positions of the nodes in the moved frame, and their heights above the nominal surface
    positions = (points + moves - shift) @ rotation
    change = positions[:, 2] - surface.scaled(size).sag(positions[:, 0], positions[:, 1])
    if not np.all(np.isfinite(change)) or np.max(np.abs(change)) > MAX_SAG_CHANGE:
        raise NodesError("the displacements change the sag of the face by more than 1 mm", _CHECK)
    disk = surface.figure_disk(aperture)
    x, y = positions[:, 0], positions[:, 1]
    basis = zernike.basis(terms, (x - disk.centre[0]) / disk.radius, (y - disk.centre[1]) / disk.radius)
    if np.sum(weight > 0.0) < 2 * terms:
        text = f"{int(np.sum(weight > 0.0))} nodes on the clear aperture do not determine {terms} Zernike terms"
        raise NodesError(text, f"{2 * terms} nodes or more, or fewer terms")
    root = np.sqrt(weight)
    # nearly dependent combinations of terms are excluded, as in ``face_change``
    fitted = np.linalg.lstsq(basis * root[:, None], change * root, rcond=zernike.RANK_TOLERANCE)[0]
    residual = change - basis @ fitted
    grid, lost, between = _gridded(positions[:, :2], residual, weight, aperture, spacing)
    from scipy.spatial.transform import Rotation

    figure = FrozenMap({j: float(a) for j, a in enumerate(fitted, 1)})
    rotation_vector = triple(Rotation.from_matrix(rotation).as_rotvec())
    fits = (positions[:, :2], weight, change, residual, lost, between, spacing, len(order) - len(points))
    return NodalDeformation(rotation_vector, triple(shift), size - 1.0, figure, grid, *fits)


_CHECK = "displacements in the unit of the column heads, and nodes in the named frame"


def _on_face(
    points: np.ndarray, moves: np.ndarray, surface: Surface, aperture: Aperture
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the nodes of the surface in and near the aperture, put exactly on it, and their mean spacing."""
    radius = surface.figure_disk(aperture).radius
    x0, x1, y0, y1 = aperture.bounds
    middle, half = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)]), np.array([0.5 * (x1 - x0), 0.5 * (y1 - y0)])
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.abs(points[:, 2] - surface.sag(points[:, 0], points[:, 1]))
        level = distance <= OFF_SURFACE * radius
    near_face = level & np.all(np.abs(points[:, :2] - middle) <= 1.3 * half, axis=1)
    inside = near_face & aperture.contains(points[:, 0], points[:, 1])
    count = int(np.sum(inside))
    if count < MIN_NODES:
        near = float(np.nanmedian(distance)) if np.any(np.isfinite(distance)) else np.inf
        text = f"{count} of {len(points)} nodes lie on the clear aperture of the nominal surface (half of the nodes "
        text += f"are farther than {1e3 * near:.3g} mm from it along z)"
        low, high = points.min(axis=0), points.max(axis=0)
        ranges = ", ".join(f"{1e3 * a:.4g} .. {1e3 * b:.4g}" for a, b in zip(low, high, strict=True))
        box = f"x {1e3 * x0:.4g} .. {1e3 * x1:.4g}, y {1e3 * y0:.4g} .. {1e3 * y1:.4g} mm"
        raise NodesError(
            f"{text}; the nodes span x, y, z = {ranges} mm",
            f"{MIN_NODES} or more within {1e3 * OFF_SURFACE * radius:.2g} mm of it, in {box}: check frame and unit",
        )
    area = (x1 - x0) * (y1 - y0) * _filled(aperture)
    spacing = float(np.sqrt(area / count))
    out = points[near_face].copy()
    out[:, 2] = surface.sag(out[:, 0], out[:, 1])
    return out, moves[near_face], spacing


def _lattice(aperture: Aperture, step: float) -> np.ndarray:
    """Return P points of a lattice in the aperture, (P, 2), metres, that does not line up with any even mesh."""
    x0, x1, y0, y1 = aperture.bounds
    counts = [int(np.clip(np.ceil(side / step), 40, _FINEST)) for side in (x1 - x0, y1 - y0)]
    x, y = (a + (b - a) * (np.arange(n) + 0.5) / n for (a, b), n in zip(((x0, x1), (y0, y1)), counts, strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.asarray(points[aperture.contains(points[:, 0], points[:, 1])])


def _filled(aperture: Aperture) -> float:
    """Return the fraction of the aperture's bounding box that the aperture fills."""
    x0, x1, y0, y1 = aperture.bounds
    step = min(x1 - x0, y1 - y0) / 200.0
    counts = [int(np.ceil(side / step)) for side in (x1 - x0, y1 - y0)]
    return len(_lattice(aperture, step)) / float(np.prod(np.clip(counts, 40, _FINEST)))


def _cells(points: np.ndarray, aperture: Aperture, spacing: float) -> np.ndarray:
    """Return, for each of K positions, the fraction of the aperture that is nearer to it than to the others, (K,).

    Raises
    ------
    NodesError
        A part of the aperture is far from all nodes.
    """
    from scipy.spatial import cKDTree

    lattice = _lattice(aperture, spacing / _LATTICE)
    distance, nearest = cKDTree(points).query(lattice)
    worst = int(np.argmax(distance))
    if distance[worst] > MAX_GAP * spacing:
        x, y = 1e3 * lattice[worst]
        text = f"no node within {1e3 * distance[worst]:.3g} mm of x, y = {x:.4g}, {y:.4g} mm in the clear aperture"
        raise NodesError(text, f"nodes over all of it, at most {1e3 * MAX_GAP * spacing:.2g} mm from any point of it")
    return np.asarray(np.bincount(nearest, minlength=len(points)) / len(lattice))


def _similarity(points: np.ndarray, moves: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the rotation R, shift and size s that best map points p to the displaced points, as s R p + shift.

    The rotation has shape (3, 3), the shift (3,), in metres; the displaced points are ``points`` + ``moves``, and the
    fit is by weighted least squares.
    """
    middle, drift = weight @ points, weight @ moves
    p = points - middle
    q = p + (moves - drift)
    spread = float(np.sum(weight[:, None] * p * p))
    u, s, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weight, q, p))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    size = float(np.sum(s * sign)) / spread
    return rotation, middle + drift - size * rotation @ middle, size


def _gridded(
    positions: np.ndarray, residual: np.ndarray, weight: np.ndarray, aperture: Aperture, spacing: float
) -> tuple[GridFigure | None, np.ndarray, float]:
    """Return the residual on a grid, its remainder at the nodes, and the rms error at left-out nodes."""
    if np.sqrt(np.sum(weight * residual**2)) < _ROUNDING:
        return None, residual, 0.0
    x0, x1, y0, y1 = aperture.bounds
    longer = max(x1 - x0, y1 - y0)
    step = max(spacing, longer / (_MOST_SAMPLES - 2 * _MARGIN - 1))
    counts = [int(np.ceil((b - a) / step)) + 1 + 2 * _MARGIN for a, b in ((x0, x1), (y0, y1))]
    half = [0.5 * step * (n - 1) for n in counts]
    cx, cy = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    bounds = (cx - half[0], cx + half[0], cy - half[1], cy + half[1])
    inner = (np.abs(positions[:, 0] - cx) <= half[0]) & (np.abs(positions[:, 1] - cy) <= half[1])
    spline = _Spline(positions[inner], bounds, (counts[1], counts[0]))
    figure = spline.fit(residual[inner], np.ones(int(inner.sum()), bool))
    remainder = residual - figure.sag(positions[:, 0], positions[:, 1])
    # nodes are sorted by position; a random permutation separates neighbours
    first = np.random.default_rng(0).permutation(int(inner.sum())) % 2 == 0
    missed = np.empty(int(inner.sum()))
    for part in (first, ~first):
        rest = positions[inner][~part]
        missed[~part] = residual[inner][~part] - spline.fit(residual[inner], part).sag(rest[:, 0], rest[:, 1])
    return figure, remainder, float(np.sqrt(np.sum(weight[inner] * missed**2) / np.sum(weight[inner])))


class _Spline:
    """Least-squares fit of a bicubic spline to values at scattered positions, with a small weight on its bending.

    Parameters
    ----------
    points : (K, 2) ndarray
        K positions inside the bounds, metres.
    bounds : tuple of float
        (x_min, x_max, y_min, y_max) of the first and last samples, metres.
    shape : (int, int)
        Number of samples along y and x.
    """

    def __init__(self, points: np.ndarray, bounds: tuple[float, float, float, float], shape: tuple[int, int]) -> None:
        from scipy import sparse

        self._bounds, self._shape = bounds, shape
        rows, columns = shape
        u = (points[:, 0] - bounds[0]) / (bounds[1] - bounds[0]) * (columns - 1)
        v = (points[:, 1] - bounds[2]) / (bounds[3] - bounds[2]) * (rows - 1)
        along, column = _cubic(u, columns)
        across, row = _cubic(v, rows)
        values = (across[:, :, None] * along[:, None, :]).reshape(len(points), 16)
        index = (row[:, :, None] * columns + column[:, None, :]).reshape(len(points), 16)
        number = np.repeat(np.arange(len(points)), 16)
        size = rows * columns
        self._design = sparse.csr_array((values.ravel(), (number, index.ravel())), shape=(len(points), size))
        second_x, second_y = _second(columns), _second(rows)
        plain_x, plain_y = sparse.eye_array(columns), sparse.eye_array(rows)
        twist = sparse.kron(_first(rows), _first(columns))
        bending = [sparse.kron(plain_y, second_x), sparse.kron(second_y, plain_x)]
        self._bending = _BENDING * (sum(b.T @ b for b in bending) + 2.0 * twist.T @ twist)

    def fit(self, values: np.ndarray, used: np.ndarray) -> GridFigure:
        """Return the grid nearest to values at K positions, (K,), of which the mask ``used`` (K,) selects some."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        design = self._design[used]
        normal = sparse.csc_array(design.T @ design + self._bending)
        solved = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        coefficients = solved.solve(design.T @ values[used]).reshape(self._shape)
        return GridFigure(_samples(coefficients), self._bounds)


def _cubic(position: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return, for K positions, weights and indices (K, 4) of the four coefficients of a cubic B-spline there.

    Positions count in samples; at the ends the coefficients are mirrored.
    """
    cell = np.clip(np.floor(position), 0, count - 2).astype(int)
    f = (position - cell)[:, None]
    e = 1.0 - f
    weights = np.hstack(
        [e**3 / 6.0, 2.0 / 3.0 - f**2 * (2.0 - f) / 2.0, 2.0 / 3.0 - e**2 * (2.0 - e) / 2.0, f**3 / 6.0]
    )
    number = np.abs(cell[:, None] + np.arange(-1, 3))
    return weights, np.where(number > count - 1, 2 * (count - 1) - number, number)


def _first(count: int) -> sparray:
    """Return the matrix of differences between successive ones of ``count`` values."""
    from scipy import sparse

    return sparse.diags_array([-np.ones(count - 1), np.ones(count - 1)], offsets=[0, 1], shape=(count - 1, count))


def _second(count: int) -> sparray:
    """Return the matrix of second differences of ``count`` successive values."""
    from scipy import sparse

    ones = np.ones(count - 2)
    return sparse.diags_array([ones, -2.0 * ones, ones], offsets=[0, 1, 2], shape=(count - 2, count))


def _samples(coefficients: np.ndarray) -> np.ndarray:
    """Return the values of a spline with mirrored edges at its samples: the inverse of SciPy's ``spline_filter``."""
    padded = np.pad(coefficients, 1, mode="reflect")
    rows = (padded[:-2] + 4.0 * padded[1:-1] + padded[2:]) / 6.0
    return np.asarray((rows[:, :-2] + 4.0 * rows[:, 1:-1] + rows[:, 2:]) / 6.0)


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
        from scipy.spatial import Delaunay, cKDTree

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
        from scipy.spatial import cKDTree

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
            except RuntimeError:  # QhullError
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
                except RuntimeError:  # QhullError
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
