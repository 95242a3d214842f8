"""Displacements of the nodes of a finite-element program, as the motion and the change of figure of an optical face.

The nodes' displacements are taken apart in this order, each part by what the one before leaves:

1. the rigid motion and the growth that are nearest to the displacements of the material, by weighted least squares
   with an exact rotation (Umeyama 1991, doi 10.1109/34.88573). A node weighs as the part of the clear aperture that is
   nearer to it than to any other (its Voronoi cell), so that a finer mesh in one place does not count more;
2. the change of sag where the node now stands. The deformed surface goes through the displaced nodes: a node that
   slides along the surface is compared with the nominal surface at its new place, so that no slope is neglected;
3. Zernike terms of that change, from the piston on: the nearest rigid motion of the material leaves the optical surface
   piston and tilts as it slides;
4. the rest as a cubic spline on a grid, with the least bending where there are no nodes.

What the nodes cannot say between them is judged by leaving every second one out: how well the spline of the others
foretells them. A residual that the others do not foretell changes from node to node: the mesh prints through, or is too
coarse.
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

if TYPE_CHECKING:  # every file of a job waits for this module, and none for scipy
    from scipy.sparse import sparray

TERMS = 36
"""Zernike terms by default: to seventh order."""
OFF_SURFACE = 2e-4
"""How far from the nominal surface, in radii of the figure's disk, a node of it may stand: coordinates of seven digits
and the chords of coarse elements stay below, the back of a mirror does not."""
LEAST_NODES = 16
WIDEST_GAP = 4.0
"""Distance from a place of the aperture to its nearest node, in mean spacings of the nodes, that is refused."""
LARGEST_GROWTH = 0.02
LARGEST_FIGURE = 1e-3
"""Largest change of sag, metres: beyond that a table has another unit or another frame than is told."""
PRINTED = 0.3
"""Share of the residual that nodes left out may contradict before it is called the mesh's."""
SEEN = 1e-9
"""Metres rms of sag below which nothing is said of the mesh: 1/300 of a wave of reflected light."""

_LATTICE = 5  # points of the lattice by which cells are measured, along one spacing of the nodes
_FINEST = 1200  # points of it along the aperture at most
_MARGIN = 5  # samples of the grid beyond the aperture: its edges have no slope
_MOST_SAMPLES = 160  # along the longer side of the grid
_BENDING = 1e-6  # weight of a second difference of spline coefficients against a node's residual
_ROUNDING = 1e-14  # metres rms: a residual below is rounding and gets no grid


class NodesError(PhysicalError, ValueError):
    """Nodes that do not describe the face.

    Attributes
    ----------
    allowed
        What to do, in words.
    """

    def __init__(self, problem: str, allowed: str) -> None:
        super().__init__(problem)
        self.allowed = allowed


@dataclass(frozen=True, eq=False)
class NodalDeformation:
    """What the nodes' displacements are for the face, in its own nominal frame.

    Attributes
    ----------
    rotate : tuple[float, float, float]
        Exact rotation vector about the frame's origin, radians.
    shift : tuple[float, float, float]
        Of the frame's origin, metres.
    growth : float
        Relative, of the surface about the origin.
    figure : FrozenMap[int, float]
        Noll index -> metres rms over the disk, of sag along +z; from Z1 on.
    grid : GridFigure | None
        The rest on a grid, None where it is below rounding.
    places : np.ndarray
        x, y of the nodes that were used, where they stand on the moved face, metres, (K, 2).
    weight : np.ndarray
        Of these nodes, share of the clear aperture, (K,).
    change : np.ndarray
        Of sag at the nodes beyond the rigid motion and growth, metres, (K,).
    residual : np.ndarray
        What the Zernike terms leave of it, (K,).
    lost : np.ndarray
        What the grid leaves of that, (K,).
    between : float
        Rms of the error at nodes that are left out, every second one, metres: what the mesh does not know between its
        nodes is less.
    spacing : float
        Mean distance of the nodes, metres.
    others : int
        How many nodes are not used, off the surface or outside of the aperture.
    """

    rotate: tuple[float, float, float]
    shift: tuple[float, float, float]
    growth: float
    figure: FrozenMap[int, float]
    grid: GridFigure | None
    places: np.ndarray
    weight: np.ndarray
    change: np.ndarray
    residual: np.ndarray
    lost: np.ndarray
    between: float
    spacing: float
    others: int = field(default=0)

    def rms(self, values: np.ndarray) -> float:
        """Root of the mean square over the clear aperture of numbers at the nodes (K,)."""
        return float(np.sqrt(np.sum(self.weight * values**2)))

    def range(self, values: np.ndarray) -> float:
        """Highest less lowest in the clear aperture, of numbers at the nodes (K,)."""
        inside = values[self.weight > 0.0]
        return float(np.ptp(inside))

    @property
    def printed_through(self) -> bool:
        """Whether a part of the residual that shows changes from node to node."""
        return self.between > SEEN and self.between > PRINTED * self.rms(self.residual)

    def motion(self) -> Motion:
        """Return the deformation as a motion of the face's body."""
        return Motion(self.rotate, self.shift, figure=self.figure, stretch=self.growth, grid=self.grid)


def nodal_deformation(
    nodes: Any, displacements: Any, surface: Surface, aperture: Aperture, terms: int = TERMS
) -> NodalDeformation:
    """Take the displacements of nodes apart into a motion, Zernike terms and a grid.

    Nodes off the surface, as those inside of the body, are left out. The order of the nodes is of no effect.

    Parameters
    ----------
    nodes : Any
        Where they stand in the face's nominal frame, metres, (N, 3).
    displacements : Any
        Metres, (N, 3).
    surface : Surface
        The face's nominal shape.
    aperture : Aperture
        The clear aperture, which the nodes have to cover.
    terms : int
        Highest Noll index, 3 or more.

    Raises
    ------
    NodesError
        Too few nodes on the surface, a gap between them, or displacements of another unit.
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
    turn, shift, size = _similarity(points, moves, weight)
    if abs(size - 1.0) > LARGEST_GROWTH:
        raise NodesError(f"the nodes' displacements grow the face by {100.0 * (size - 1.0):.3g} percent", _CHECK)
    # where the nodes stand in the moved frame, and how far above the nominal surface there
    places = (points + moves - shift) @ turn
    change = places[:, 2] - surface.grown(size).sag(places[:, 0], places[:, 1])
    if not np.all(np.isfinite(change)) or np.max(np.abs(change)) > LARGEST_FIGURE:
        raise NodesError("the displacements bend the face by more than 1 mm", _CHECK)
    disk = surface.figure_disk(aperture)
    x, y = places[:, 0], places[:, 1]
    basis = zernike.basis(terms, (x - disk.centre[0]) / disk.radius, (y - disk.centre[1]) / disk.radius)
    if np.sum(weight > 0.0) < 2 * terms:
        text = f"{int(np.sum(weight > 0.0))} nodes on the clear aperture do not determine {terms} Zernike terms"
        raise NodesError(text, f"{2 * terms} nodes or more, or fewer terms")
    root = np.sqrt(weight)
    # terms that hardly differ on the aperture are not told apart, as in ``face_change``
    fitted = np.linalg.lstsq(basis * root[:, None], change * root, rcond=zernike.HELD)[0]
    residual = change - basis @ fitted
    grid, lost, between = _gridded(places[:, :2], residual, weight, aperture, spacing)
    from scipy.spatial.transform import Rotation

    return NodalDeformation(
        triple(Rotation.from_matrix(turn).as_rotvec()),
        triple(shift),
        size - 1.0,
        FrozenMap({j: float(a) for j, a in enumerate(fitted, 1)}),
        grid,
        places[:, :2],
        weight,
        change,
        residual,
        lost,
        between,
        spacing,
        len(order) - len(points),
    )


_CHECK = "displacements in the unit of their heads, and nodes in the frame that is named"


def _on_face(
    points: np.ndarray, moves: np.ndarray, surface: Surface, aperture: Aperture
) -> tuple[np.ndarray, np.ndarray, float]:
    """Nodes of the surface in and about the aperture, put exactly on it, and their mean spacing."""
    radius = surface.figure_disk(aperture).radius
    x0, x1, y0, y1 = aperture.bounds
    middle, half = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)]), np.array([0.5 * (x1 - x0), 0.5 * (y1 - y0)])
    with np.errstate(over="ignore", invalid="ignore"):
        away = np.abs(points[:, 2] - surface.sag(points[:, 0], points[:, 1]))
        level = away <= OFF_SURFACE * radius
    here = level & np.all(np.abs(points[:, :2] - middle) <= 1.3 * half, axis=1)
    inside = here & aperture.contains(points[:, 0], points[:, 1])
    count = int(np.sum(inside))
    if count < LEAST_NODES:
        near = float(np.nanmedian(away)) if np.any(np.isfinite(away)) else np.inf
        text = f"{count} of {len(points)} nodes stand on the clear aperture of the nominal surface (half of the nodes "
        text += f"are farther than {1e3 * near:.3g} mm from it along z)"
        low, high = points.min(axis=0), points.max(axis=0)
        ranges = ", ".join(f"{1e3 * a:.4g} .. {1e3 * b:.4g}" for a, b in zip(low, high, strict=True))
        box = f"x {1e3 * x0:.4g} .. {1e3 * x1:.4g}, y {1e3 * y0:.4g} .. {1e3 * y1:.4g} mm"
        raise NodesError(
            f"{text}; theirs are x, y, z = {ranges} mm",
            f"{LEAST_NODES} or more within {1e3 * OFF_SURFACE * radius:.2g} mm of it, in {box}: check frame and unit",
        )
    area = (x1 - x0) * (y1 - y0) * _filled(aperture)
    spacing = float(np.sqrt(area / count))
    out = points[here].copy()
    out[:, 2] = surface.sag(out[:, 0], out[:, 1])
    return out, moves[here], spacing


def _lattice(aperture: Aperture, step: float) -> np.ndarray:
    """Places in the aperture, (P, 2), metres. Their number along a side is odd to that of any even mesh."""
    x0, x1, y0, y1 = aperture.bounds
    counts = [int(np.clip(np.ceil(side / step), 40, _FINEST)) for side in (x1 - x0, y1 - y0)]
    x, y = (a + (b - a) * (np.arange(n) + 0.5) / n for (a, b), n in zip(((x0, x1), (y0, y1)), counts, strict=True))
    every = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.asarray(every[aperture.contains(every[:, 0], every[:, 1])])


def _filled(aperture: Aperture) -> float:
    """Share of the aperture's box that it fills."""
    x0, x1, y0, y1 = aperture.bounds
    step = min(x1 - x0, y1 - y0) / 200.0
    counts = [int(np.ceil(side / step)) for side in (x1 - x0, y1 - y0)]
    return len(_lattice(aperture, step)) / float(np.prod(np.clip(counts, 40, _FINEST)))


def _cells(places: np.ndarray, aperture: Aperture, spacing: float) -> np.ndarray:
    """Share of the aperture that is nearer to each place than to the others, (K,).

    Raises
    ------
    NodesError
        a part of the aperture is far from all.
    """
    from scipy.spatial import cKDTree

    lattice = _lattice(aperture, spacing / _LATTICE)
    distance, nearest = cKDTree(places).query(lattice)
    worst = int(np.argmax(distance))
    if distance[worst] > WIDEST_GAP * spacing:
        x, y = 1e3 * lattice[worst]
        text = f"no node within {1e3 * distance[worst]:.3g} mm of x, y = {x:.4g}, {y:.4g} mm in the clear aperture"
        raise NodesError(text, f"nodes over all of it, at most {1e3 * WIDEST_GAP * spacing:.2g} mm from any place")
    return np.asarray(np.bincount(nearest, minlength=len(places)) / len(lattice))


def _similarity(points: np.ndarray, moves: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation (3, 3), shift (3,) and size s of p -> s R p + shift nearest to points + moves, by weighted squares."""
    middle, drift = weight @ points, weight @ moves
    p = points - middle
    q = p + (moves - drift)
    spread = float(np.sum(weight[:, None] * p * p))
    u, s, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weight, q, p))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = (u * sign) @ vt
    size = float(np.sum(s * sign)) / spread
    return turn, middle + drift - size * turn @ middle, size


def _gridded(
    places: np.ndarray, residual: np.ndarray, weight: np.ndarray, aperture: Aperture, spacing: float
) -> tuple[GridFigure | None, np.ndarray, float]:
    """The residual on a grid, what that leaves at the nodes, and the rms error at nodes left out."""
    if np.sqrt(np.sum(weight * residual**2)) < _ROUNDING:
        return None, residual, 0.0
    x0, x1, y0, y1 = aperture.bounds
    longer = max(x1 - x0, y1 - y0)
    step = max(spacing, longer / (_MOST_SAMPLES - 2 * _MARGIN - 1))
    counts = [int(np.ceil((b - a) / step)) + 1 + 2 * _MARGIN for a, b in ((x0, x1), (y0, y1))]
    half = [0.5 * step * (n - 1) for n in counts]
    cx, cy = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    bounds = (cx - half[0], cx + half[0], cy - half[1], cy + half[1])
    inner = (np.abs(places[:, 0] - cx) <= half[0]) & (np.abs(places[:, 1] - cy) <= half[1])
    spline = _Spline(places[inner], bounds, (counts[1], counts[0]))
    figure = spline.fit(residual[inner], np.ones(int(inner.sum()), bool))
    lost = residual - figure.sag(places[:, 0], places[:, 1])
    # the numbers of the nodes come from their sorted places; a draw takes neighbours apart
    first = np.random.default_rng(0).permutation(int(inner.sum())) % 2 == 0
    missed = np.empty(int(inner.sum()))
    for part in (first, ~first):
        rest = places[inner][~part]
        missed[~part] = residual[inner][~part] - spline.fit(residual[inner], part).sag(rest[:, 0], rest[:, 1])
    return figure, lost, float(np.sqrt(np.sum(weight[inner] * missed**2) / np.sum(weight[inner])))


class _Spline:
    """Least squares of a bicubic spline to values at scattered places, with a little weight on its bending.

    Parameters
    ----------
    places
        (K, 2), metres, inside of the bounds.
    bounds
        x_min, x_max, y_min, y_max of the first and last samples, metres.
    shape
        Samples along y and x.
    """

    def __init__(self, places: np.ndarray, bounds: tuple[float, float, float, float], shape: tuple[int, int]) -> None:
        from scipy import sparse

        self._bounds, self._shape = bounds, shape
        rows, columns = shape
        u = (places[:, 0] - bounds[0]) / (bounds[1] - bounds[0]) * (columns - 1)
        v = (places[:, 1] - bounds[2]) / (bounds[3] - bounds[2]) * (rows - 1)
        along, column = _cubic(u, columns)
        across, row = _cubic(v, rows)
        values = (across[:, :, None] * along[:, None, :]).reshape(len(places), 16)
        index = (row[:, :, None] * columns + column[:, None, :]).reshape(len(places), 16)
        number = np.repeat(np.arange(len(places)), 16)
        size = rows * columns
        self._design = sparse.csr_array((values.ravel(), (number, index.ravel())), shape=(len(places), size))
        one_x, one_y = _second(columns), _second(rows)
        plain_x, plain_y = sparse.eye_array(columns), sparse.eye_array(rows)
        twist = sparse.kron(_first(rows), _first(columns))
        bending = [sparse.kron(plain_y, one_x), sparse.kron(one_y, plain_x)]
        self._bending = _BENDING * (sum(b.T @ b for b in bending) + 2.0 * twist.T @ twist)

    def fit(self, values: np.ndarray, used: np.ndarray) -> GridFigure:
        """The grid nearest to values (K,) at the places that are used (K,)."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        design = self._design[used]
        normal = sparse.csc_array(design.T @ design + self._bending)
        solved = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        coefficients = solved.solve(design.T @ values[used]).reshape(self._shape)
        return GridFigure(_samples(coefficients), self._bounds)


def _cubic(place: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights (K, 4) of a cubic B-spline's coefficients at places in samples, and their numbers (K, 4), mirrored."""
    cell = np.clip(np.floor(place), 0, count - 2).astype(int)
    f = (place - cell)[:, None]
    e = 1.0 - f
    weights = np.hstack(
        [e**3 / 6.0, 2.0 / 3.0 - f**2 * (2.0 - f) / 2.0, 2.0 / 3.0 - e**2 * (2.0 - e) / 2.0, f**3 / 6.0]
    )
    number = np.abs(cell[:, None] + np.arange(-1, 3))
    return weights, np.where(number > count - 1, 2 * (count - 1) - number, number)


def _first(count: int) -> sparray:
    from scipy import sparse

    return sparse.diags_array([-np.ones(count - 1), np.ones(count - 1)], offsets=[0, 1], shape=(count - 1, count))


def _second(count: int) -> sparray:
    from scipy import sparse

    ones = np.ones(count - 2)
    return sparse.diags_array([ones, -2.0 * ones, ones], offsets=[0, 1, 2], shape=(count - 2, count))


def _samples(coefficients: np.ndarray) -> np.ndarray:
    """Values of a spline with mirrored edges at its samples: the inverse of SciPy's ``spline_filter``."""
    padded = np.pad(coefficients, 1, mode="reflect")
    rows = (padded[:-2] + 4.0 * padded[1:-1] + padded[2:]) / 6.0
    return np.asarray((rows[:, :-2] + 4.0 * rows[:, 1:-1] + rows[:, 2:]) / 6.0)
