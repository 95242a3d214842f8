"""Transfer function of a vignetted pupil at evenly spaced frequencies along a direction, by lines along the shift.

On every line of the pupil along the shift, light extends from one edge to the next. The pupil's autocorrelation is the
sum over lines of the autocorrelations along them. These are computed on cells as long as one step of the shift, so that
all shifts together are one Fourier transform of a line; cells that contain an edge get the weights of Gauss' rule
between edge and cell, for every pair of edges. Edges are therefore exact along the lines, wherever they are; shadows
need not be divided into pieces, and no wavefront is extrapolated into the dark.

Across the lines the rule is Fejer's, between the positions where outlines begin, end or have a corner. Where edges of
the two pupils cross, at another position for every shift, the integrand has a kink, and the error falls with the square
of the number of lines. A rule on every third line with other nodes on the cells gives an error estimate, and lines are
added until the error is small.

``optics.waves.optical_transfer`` serves any frequencies and defocus.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise

import numpy as np
from numpy.polynomial import chebyshev, legendre
from scipy.fft import fft, ifft, irfft, next_fast_len, rfft

from optics.geometry.polygon import area
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import cores, one_blas_thread
from optics.numerics.quadrature import PupilNodes, gauss, nodes_for
from optics.waves.edge_shadow import StopOutlines
from optics.waves.optical_transfer import WORST_TRANSFER
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_stack import EVEN_WEIGHT, PupilFunction
from optics.waves.pupil_terms import polynomials, products, smooth_terms

RIM_SIDES = 2048
"""Number of sides of the polygon of equal area that represents a pupil's own edge: within 4e-7 of it."""

LINE_SIDES = 192
"""Number of sides of the polygon of equal area that represents another round edge: within 1e-4 of its radius."""

LINES = (400, 720, 1440, 3240)
"""Numbers of lines across the pupil that are tried in turn until the transfer function's error is small enough."""

CONVERGED = 1e-4
"""Largest change of a transfer function, if only a third of the lines is used, with which there are enough lines.

Its error with all lines is then about a tenth of this change.
"""

FEW_OUTLINES = 2
"""Largest number of outlines, besides the pupil's own edge, for which the smallest number of lines is tried."""

_MIN_LINES = 9
"""Smallest number of lines between two positions where outlines begin or end."""

_CORNER = 0.3
"""Smallest change of direction between two sides of an outline that counts as a corner, radians.

In polygons that represent round outlines it is smaller.
"""

_SHORT_CELLS = 0.005, 0.04
"""Largest lengths of a cell, in radii of the pupil, with which one and two nodes suffice; longer cells get three."""

_SMALL_PHASE = 0.2
"""Largest change of phase over a cell, radians, for which the cell gets no additional node.

Near the cut-off there are few cells without an edge.
"""

_BLOCK_NODES = 2**14
"""Number of nodes processed in one block: some arrays of 200 kB that stay in the cache."""

_APART = 1e-6
"""Smallest distance, in radii of the pupil, between two positions across the pupil for lines to be put between them."""

_LONGEST_CELL = 0.06
"""Largest length of a cell, in radii of the pupil.

A longer step of the shift is divided into several cells, so that the last cell ends little beyond the pupil.
"""


@dataclass(frozen=True, eq=False)
class VignettedPupil:
    """Exit pupil vignetted by edges, in normalised coordinates (complex numbers x + iy, the edge near the unit circle).

    Attributes
    ----------
    pupil : PupilFunction
        Wavefront and own edge of the pupil, without shadows.
    clear : tuple of (V,) ndarray
        Convex polygons of V complex corners, counterclockwise, inside all of which light passes.
    blocked : tuple of (V,) ndarray
        Convex polygons of V complex corners, counterclockwise, inside any of which light is blocked.
    """

    pupil: PupilFunction
    clear: tuple[np.ndarray, ...]
    blocked: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class LineTransfer:
    """Transfer function at M evenly spaced frequencies along one direction.

    Attributes
    ----------
    values : (M,) ndarray
        Complex transfer function, 1 at zero frequency.
    perfect : (M,) ndarray
        Transfer function of the same pupil with a perfect wavefront.
    error : float
        Largest change of either when a third of the lines and other nodes on the cells are used.
    """

    values: np.ndarray
    perfect: np.ndarray
    error: float


def vignetted_pupils(
    pupils: Sequence[PupilFunction],
    u: np.ndarray,
    v: np.ndarray,
    nodes: PupilNodes,
    outlines: StopOutlines,
    bright: np.ndarray,
) -> tuple[VignettedPupil, ...]:
    """Return the pupils with the outlines of edges in them.

    Parameters
    ----------
    pupils : sequence of PupilFunction
        B pupils without shadows.
    u, v : (B, N) ndarray
        Direction cosines along the detector's two axes at N nodes of the stop.
    nodes : PupilNodes
        Nodes of the stop.
    outlines : StopOutlines
        Outlines of the edges on the stop's unit disk, for B images.
    bright : (B, N) ndarray of bool
        Mask of the illuminated nodes; only these determine the positions of the edges.
    """
    degree = pupils[0].eikonal_terms.shape[-1] - 1
    on_stop = products(nodes.x, nodes.y, degree)
    terms = smooth_terms(on_stop, nodes.weight, bright, np.stack([u, v], axis=-1), EVEN_WEIGHT).swapaxes(1, 2)
    edges: list[tuple[list[np.ndarray], list[np.ndarray]]] = [([], []) for _ in pupils]
    for group, kind in enumerate((outlines.clear, outlines.blocked)):
        for polygons in kind:
            full = area(polygons) > SMALLEST
            # beyond the rim there are no rays and polynomials of high degree diverge; p is nearly the stop's coordinate
            within = polygons / np.maximum(np.hypot(polygons[..., 0], polygons[..., 1]), 1.0)[..., None]
            cosines = products(within[..., 0], within[..., 1], degree) @ np.swapaxes(terms, 1, 2)
            for k, pupil in enumerate(pupils):
                if full[k]:
                    position = np.linalg.solve(pupil.axes, (cosines[k] - pupil.centre).T) + (polygons[k] - within[k]).T
                    edges[k][group].append(_counterclockwise(position[0] + 1j * position[1]))
                elif group == 0:
                    raise UnphysicalError(f"an edge blocks all light in the pupil of image {k}")
    return tuple(VignettedPupil(pupil, tuple(c), tuple(b)) for pupil, (c, b) in zip(pupils, edges, strict=True))


def unvignetted_at(vignetted: VignettedPupil, points: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of N pupil points, complex, that no edge except the pupil's own blocks.

    Points are in normalised coordinates, in which the pupil's edge is near the unit circle.
    """
    out = np.ones(len(points), bool)
    for polygons, clear in ((vignetted.clear, True), (vignetted.blocked, False)):
        for polygon in polygons:
            left, right = _chords(polygon, points.imag)
            out &= ((left <= points.real) & (points.real <= right)) == clear
    return out


def line_transfers(
    vignetted: Sequence[VignettedPupil],
    wavelengths: Sequence[float],
    directions: np.ndarray,
    step: float,
    count: int,
    lines: Sequence[int] = (),
) -> list[list[LineTransfer]]:
    """Return transfer functions at the frequencies 0, step .. (count - 1) step along A directions.

    Parameters
    ----------
    vignetted : sequence of VignettedPupil
        Pupils of B images.
    wavelengths : sequence of float
        Wavelength of each image, metres.
    directions : (A, 2) ndarray
        Unit vectors in detector x, y.
    step : float
        Step of the frequency, cycles/m, positive.
    count : int
        Number M of frequencies.
    lines : sequence of int
        Numbers of lines across the pupil, tried one after the other; by default those of LINES that this kind of pupil
        needs.

    Returns
    -------
    list of list of LineTransfer
        For every image the transfer functions along every direction.

    Raises
    ------
    UnphysicalError
        Even with the largest number of lines the result differs from that of a third of them.
    """
    tasks = [(p, wave, unit) for p, wave in zip(vignetted, wavelengths, strict=True) for unit in np.asarray(directions)]

    def computed(task: tuple[VignettedPupil, float, np.ndarray]) -> LineTransfer:
        pupil, wave, direction = task
        return _line_transfer(pupil, wave, direction, step, count, lines)

    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        transfers = list(pool.map(computed, tasks))
    per_image = len(directions)
    return [transfers[k : k + per_image] for k in range(0, len(transfers), per_image)]


def _line_transfer(
    vignetted: VignettedPupil, wavelength: float, direction: np.ndarray, step: float, count: int, lines: Sequence[int]
) -> LineTransfer:
    """Return the transfer function of one image along one direction, with as many lines as its error requires."""
    shift = complex(vignetted.pupil.normalised(*direction))
    pitch, unit = wavelength * step * abs(shift), shift / abs(shift)
    cells_per_step = int(np.ceil(pitch / _LONGEST_CELL))
    pitch, count = pitch / cells_per_step, (count - 1) * cells_per_step + 1
    tables, outlines = _rotated_tables(vignetted.pupil, unit), _rotated(vignetted, unit)
    wave, error = 2.0 * np.pi / wavelength, np.inf
    nodes = _first_nodes(pitch, wave * pitch * _steepest(tables[0]))
    many = len(vignetted.clear) + len(vignetted.blocked) > FEW_OUTLINES
    for number in lines or LINES[int(many) :]:
        rows = _Lines.across(*outlines, number)
        fine = _autocorrelation(rows, tables, wave, pitch, count, nodes)
        coarse = _autocorrelation(rows.third(), tables, wave, pitch, count, nodes + 1)
        error = max(float(np.max(np.abs(a - b))) for a, b in zip(fine, coarse, strict=True))
        if error < CONVERGED:
            break
        nodes += 1
    if not error < WORST_TRANSFER:
        raise UnphysicalError(
            f"the transfer function of a vignetted pupil still changes by {error:.2g} with more lines (at most "
            f"{WORST_TRANSFER:g}): its wavefront is too steep"
        )
    return LineTransfer(fine[0][::cells_per_step], fine[1][::cells_per_step], error)


def _counterclockwise(polygon: np.ndarray) -> np.ndarray:
    """Return a polygon of V complex corners, (V,), in counterclockwise order."""
    clockwise = np.sum((np.conj(polygon) * np.roll(polygon, -1)).imag) < 0.0
    return polygon[::-1] if clockwise else polygon


def _rotated(vignetted: VignettedPupil, unit: complex) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the clear and the blocked outlines of a pupil, rotated so that the direction ``unit`` is along x.

    The pupil's own edge is the first of the clear outlines.
    """
    angle = 2.0 * np.pi * np.arange(RIM_SIDES) / RIM_SIDES
    rim = _counterclockwise(np.sqrt(angle[1] / np.sin(angle[1])) * vignetted.pupil.edge.boundary(angle)[0])
    back = np.conj(unit)
    return [back * p for p in (rim, *vignetted.clear)], [back * p for p in vignetted.blocked]


def _rotated_tables(pupil: PupilFunction, unit: complex) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients of eikonal and amplitude in coordinates whose x axis has the direction ``unit``.

    They are (D + 1, D + 1) each, for polynomials of degree D.
    """
    count = len(pupil.eikonal_terms)
    node, to_table = _chebyshev_nodes(count)
    points = (node[:, None] + 1j * node).reshape(1, -1) * unit
    first, second = (
        to_table @ values.reshape(count, count) @ to_table.T
        for values in polynomials((pupil.eikonal_terms[None], pupil.amplitude_terms[None]), points)
    )
    return first, second


@cache
def _chebyshev_nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` Chebyshev nodes, and the matrix that turns values there into Chebyshev coefficients."""
    node = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    matrix = chebyshev.chebvander(node, count - 1).T * (2.0 / count)
    matrix[0] *= 0.5
    return node, matrix


def _first_nodes(pitch: float, phase: float) -> int:
    """Return the number of Gauss nodes to start with on a cell of length ``pitch`` (radii of the pupil).

    ``phase`` is the largest change of the wavefront's phase over the cell, radians.
    """
    more = nodes_for(phase, 0) if phase > 1.0 else int(phase > _SMALL_PHASE)
    return int(np.searchsorted(_SHORT_CELLS, pitch)) + 1 + more


def _steepest(table: np.ndarray) -> float:
    """Return the largest derivative along x, over the unit disk, of a polynomial of degree D.

    ``table`` (D + 1, D + 1) are its coefficients.
    """
    axis = np.linspace(-1.0, 1.0, 33)
    slope = chebyshev.chebgrid2d(axis, axis, chebyshev.chebder(table, axis=0))
    inside = np.hypot(axis[:, None], axis) <= 1.0
    return float(np.max(np.abs(slope), where=inside, initial=0.0))


def _chords(polygon: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of the chords that a convex polygon cuts out of N lines of constant y, (N,) each.

    ``polygon`` (V,) are its V complex corners, counterclockwise. Where a line misses it, the left end is infinite and
    the right one minus infinite.
    """
    around = np.roll(polygon, -int(np.argmin(polygon.imag)))
    top = int(np.argmax(around.imag))
    rising, falling = around[: top + 1], np.concatenate([around[top:], around[:1]])[::-1]
    right, left = (np.interp(y, np.maximum.accumulate(part.imag), part.real) for part in (rising, falling))
    within = (y > around[0].imag) & (y < around[top].imag) & (left < right)
    return np.where(within, left, np.inf), np.where(within, right, -np.inf)


@dataclass(frozen=True, eq=False)
class _Lines:
    """N lines across a pupil, parallel to the shift, and the positions where light begins and ends on them.

    Lengths are in radii of the pupil; the shift is along x.

    Attributes
    ----------
    y : (N,) ndarray
        Positions of the lines.
    weight : (N,) ndarray
        Weights of the rule across them.
    coarse : (N,) ndarray
        Weights of a coarser rule that uses every third line, for an error estimate; 0 for the other lines.
    begins, ends : (N, K) ndarray
        Ends of up to K illuminated intervals on each line; both equal where there is none.
    bright : (N, K) ndarray of bool
        True where there is an interval.
    low, high : float
        Limits of all lines along x.
    """

    y: np.ndarray
    weight: np.ndarray
    coarse: np.ndarray
    begins: np.ndarray
    ends: np.ndarray
    bright: np.ndarray
    low: float
    high: float

    @classmethod
    def across(cls, clear: Sequence[np.ndarray], blocked: Sequence[np.ndarray], number: int) -> _Lines:
        """Return about ``number`` lines across the clear outlines, the first of which is the pupil's own edge."""
        parts = [_rule(a, b, number) for a, b in _between(clear, blocked)]
        y, weight, coarse = (np.concatenate(part) for part in zip(*parts, strict=True))
        chords = [_chords(polygon, y) for polygon in clear]
        start = np.max([left for left, _ in chords], axis=0)
        stop = np.min([right for _, right in chords], axis=0)
        used = stop > start
        y, weight, coarse, start, stop = (a[used] for a in (y, weight, coarse, start, stop))
        dark = [_chords(polygon, y) for polygon in blocked]
        left, right = (np.array([chord[k] for chord in dark]).reshape(len(dark), len(y)).T for k in (0, 1))
        right = np.where(right > left, right, np.inf)  # shadows that a line does not meet are put behind its end
        order = np.argsort(left, axis=1)
        left, right = (np.take_along_axis(ends, order, axis=1) for ends in (left, right))
        # light begins where the shadows before end, and ends where the next one begins
        begins = np.maximum.accumulate(np.concatenate([start[:, None], right], axis=1), axis=1)
        ends = np.minimum(np.concatenate([left, stop[:, None]], axis=1), stop[:, None])
        bright = ends > begins
        width = max(int(np.max(np.sum(bright, axis=1), initial=0)), 1)
        first = np.argsort(~bright, axis=1, kind="stable")[:, :width]
        begins, ends, bright = (np.take_along_axis(a, first, axis=1) for a in (begins, ends, bright))
        rim = clear[0].real
        begins, ends = (np.where(bright, a, start[:, None]) for a in (begins, ends))
        return cls(y, weight, coarse, begins, ends, bright, float(np.min(rim)), float(np.max(rim)))

    def third(self) -> _Lines:
        """Return every third line, with the weights of the coarser quadrature rule on these lines."""
        used = self.coarse != 0.0
        y, weight, begins, ends, bright = (a[used] for a in (self.y, self.coarse, self.begins, self.ends, self.bright))
        return _Lines(y, weight, weight, begins, ends, bright, self.low, self.high)


def _between(clear: Sequence[np.ndarray], blocked: Sequence[np.ndarray]) -> list[tuple[float, float]]:
    """Return intervals of y between the positions where outlines begin, end or have a corner."""
    rim = clear[0].imag
    low, high = float(np.min(rim)), float(np.max(rim))
    positions = [low, high]
    for polygon in (*clear[1:], *blocked):
        before, after = polygon - np.roll(polygon, 1), np.roll(polygon, -1) - polygon
        sharp = np.abs(np.angle(after * np.conj(before))) > _CORNER
        positions += [float(np.min(polygon.imag)), float(np.max(polygon.imag)), *polygon.imag[sharp].tolist()]
    distinct = np.unique(np.clip(positions, low, high))
    distinct = distinct[np.concatenate([[True], np.diff(distinct) > _APART])]
    return [(float(a), float(b)) for a, b in pairwise(distinct)]


def _rule(low: float, high: float, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Fejer's rule over the interval from ``low`` to ``high``: positions, weights, and coarser weights.

    The interval gets its part of ``number`` lines over [-1, 1]. The coarser weights are those of the rule on every
    third position.
    """
    count = max(_MIN_LINES, 3 * int(np.ceil(number * (high - low) / 6.0)))
    half = 0.5 * (high - low)
    coarse = np.zeros(count)
    coarse[1::3] = half * _fejer(count // 3)
    angle = np.pi * (np.arange(count) + 0.5) / count
    return 0.5 * (low + high) - half * np.cos(angle), half * _fejer(count), coarse


@lru_cache(maxsize=256)
def _fejer(count: int) -> np.ndarray:
    """Return the weights of Fejer's first rule on [-1, 1].

    Its nodes are the cosines of odd multiples of pi / (2 count).
    """
    angle = np.pi * (np.arange(count) + 0.5) / count
    order = np.arange(1, count // 2 + 1)
    return np.asarray((2.0 / count) * (1.0 - 2.0 * np.cos(2.0 * np.outer(angle, order)) @ (1.0 / (4.0 * order**2 - 1))))


@cache
def _cell_weights(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return I = ``count`` Gauss nodes and weights on a cell [0, 1], (I,) each, and polynomials for parts of the cell.

    The value of polynomial i at a position is the weight of node i in the integral from this position to the cell's
    end. The polynomials are Legendre coefficients over [-1, 1], (I + 1, I).
    """
    node, weight = gauss(count)
    order = np.arange(count)
    lagrange = (order[:, None] + 0.5) * legendre.legvander(node, count - 1).T * weight
    primitive = legendre.legint(lagrange, lbnd=-1.0, axis=0)
    rest = -0.5 * primitive
    rest[0] += 0.5 * weight
    return 0.5 * (node + 1.0), 0.5 * weight, rest


def _autocorrelation(
    rows: _Lines, tables: tuple[np.ndarray, np.ndarray], wave: float, pitch: float, count: int, nodes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pupil's autocorrelations with and without the wavefront at evenly spaced shifts along x, 1 at 0.

    The shifts are 0 to (count - 1) times ``pitch``.

    Parameters
    ----------
    rows : _Lines
        Lines along the shift.
    tables : (ndarray, ndarray)
        Polynomial coefficients of eikonal and amplitude in their coordinates.
    wave : float
        Wave number, 1/m.
    pitch : float
        Length of a cell, in radii of the pupil.
    count : int
        Number of shifts.
    nodes : int
        Number of nodes on a cell.
    """
    position, weight, rest = _cell_weights(nodes)
    cells = int((rows.high - rows.low) / pitch) + 2
    x = rows.low + pitch * (position[:, None] + np.arange(cells))
    last = len(tables[0]) - 1
    along, across = chebyshev.chebvander(x.ravel(), last).T, chebyshev.chebvander(rows.y, last)
    size = next_fast_len(cells + count)
    with_wave, without = np.zeros(size), np.zeros(size // 2 + 1)
    at_edges, at_edges_with = [], []
    edges = _Edges.of(rows, pitch, cells, rest)
    block_lines = max(1, _BLOCK_NODES // (nodes * cells))
    for start in range(0, len(rows.y), block_lines):
        block = slice(start, start + block_lines)
        path, light = ((across[block] @ table.T) @ along for table in tables)
        light = light.reshape(-1, nodes, cells)
        share, edge_nodes = edges.counted(start, len(light), cells, weight)
        phase, values = (wave * path).reshape(light.shape), np.empty(light.shape, complex)
        np.multiply(light, np.cos(phase), out=values.real)
        np.multiply(light, np.sin(phase), out=values.imag)
        at_edges.append(light.ravel()[edge_nodes])
        at_edges_with.append(values.ravel()[edge_nodes])
        line_weights = np.outer(rows.weight[block], weight).ravel()
        for total, spectrum in (
            (with_wave, fft(values * share, size, axis=-1)),
            (without, rfft(light * share, size, axis=-1)),
        ):
            squares = np.square(spectrum.reshape(len(line_weights), -1).view(float))
            total += (line_weights @ squares).reshape(-1, 2).sum(axis=-1)
    first, second, step, extra = edges.pairs(rows.weight, count, weight)
    light, values = np.concatenate(at_edges, axis=1), np.concatenate(at_edges_with, axis=1)
    real = np.bincount(step, np.sum(extra * light[:, first] * light[:, second], axis=0), count)
    product = np.sum(extra * values[:, first] * np.conj(values[:, second]), axis=0)
    both = np.bincount(step, product.real, count) + 1j * np.bincount(step, product.imag, count)
    transfer, perfect = ifft(with_wave)[:count] + both, irfft(without, size)[:count] + real
    return transfer / transfer[0].real, perfect / perfect[0]


@dataclass(frozen=True, eq=False)
class _Edges:
    """P positions ("edges") where light begins or ends on the lines across a pupil, ordered by line.

    Each line is divided into cells of equal length with I Gauss nodes each.

    Attributes
    ----------
    row : (P,) ndarray of int
        Index of the line of each edge.
    cell : (P,) ndarray of int
        Index of the cell that contains it.
    bent : (P,) ndarray
        Position in the cell, from 0 to 1.
    sign : (P,) ndarray
        1 where light begins, -1 where it ends.
    behind : (I, P) ndarray
        Weights of the cell's nodes in the integral from the edge to the cell's end.
    rest : (I + 1, I) ndarray
        Polynomials of ``_cell_weights`` that give ``behind`` as a function of the edge's position.
    """

    row: np.ndarray
    cell: np.ndarray
    bent: np.ndarray
    sign: np.ndarray
    behind: np.ndarray
    rest: np.ndarray

    @classmethod
    def of(cls, rows: _Lines, pitch: float, cells: int, rest: np.ndarray) -> _Edges:
        """Return the positions where light begins or ends on lines divided into cells of length ``pitch``."""
        valid = np.concatenate([rows.bright, rows.bright], axis=1)
        row, number = np.nonzero(valid)
        sign = np.where(number < rows.bright.shape[1], 1.0, -1.0)
        position = (np.concatenate([rows.begins, rows.ends], axis=1)[valid] - rows.low) / pitch
        cell = np.clip(np.floor(position).astype(int), 0, cells - 2)
        return cls(row, cell, position - cell, sign, _rest(position - cell, rest), rest)

    def counted(self, start: int, lines: int, cells: int, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the weight of light at every node of some lines, relative to Gauss' weight, and the nodes near edges.

        Where a cell has no edge the relative weight is 1 in light and 0 in the dark; in a cell with edges it is the
        weight of the node in the integral over the illuminated part, divided by that over the whole cell.

        Parameters
        ----------
        start : int
            Index of the first line.
        lines : int
            Number of lines.
        cells : int
            Number of cells of a line.
        weight : (I,) ndarray
            Weights of the I nodes of a cell.

        Returns
        -------
        (lines, I, cells) ndarray
            Relative weights.
        (I, P) ndarray of int
            Indices, in the flattened first result, of the nodes of cells that contain the P edges of these lines.
        """
        rows = slice(*np.searchsorted(self.row, [start, start + lines]))
        cell_index, size, nodes = (self.row[rows] - start) * cells + self.cell[rows], lines * cells, len(weight)
        sign, out = self.sign[rows], np.empty((lines, nodes, cells))
        for i, behind in enumerate(self.behind[:, rows] / weight[:, None]):
            steps = np.bincount(cell_index, sign * behind, size)
            steps[1:] += np.bincount(cell_index, sign * (1.0 - behind), size)[:-1]
            np.cumsum(steps.reshape(lines, cells), axis=1, out=out[:, i])
        first = (self.row[rows] - start) * (nodes * cells) + self.cell[rows]
        return out, first + cells * np.arange(nodes)[:, None]

    def pairs(
        self, lines: np.ndarray, count: int, weight: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return corrections of the autocorrelation for two edges of one line that lie in the same cell after a shift.

        The weights of the light common to both copies of the line are not the products of the weights of each.

        Parameters
        ----------
        lines : ndarray
            Quadrature weights of the lines.
        count : int
            Number of shifts, in steps of one cell.
        weight : (I,) ndarray
            Weights of the I nodes of a cell.

        Returns
        -------
        first, second : (Q,) ndarray of int
            Indices of the two edges of Q pairs.
        step : (Q,) ndarray of int
            Shift, in cells, at which their cells coincide.
        more : (I, Q) ndarray
            Weights of the cell's nodes to be added to the products.
        """
        first, second = _same_rows(self.row)
        step = self.cell[first] - self.cell[second]
        near = (step >= 0) & (step < count)
        first, second, step = first[near], second[near], step[near]
        share = self.behind / weight[:, None]
        extra = _rest(np.maximum(self.bent[first], self.bent[second]), self.rest)
        extra -= self.behind[:, first] * share[:, second]
        return first, second, step, extra * (self.sign[first] * self.sign[second] * lines[self.row[first]])


def _rest(position: np.ndarray, polynomials_of_rest: np.ndarray) -> np.ndarray:
    """Return the weights of a cell's I nodes in the integrals from P positions to the cell's end, (I, P).

    ``position`` (P,) runs from 0 to 1 in the cell; ``polynomials_of_rest`` are those of ``_cell_weights``.
    """
    return np.asarray(polynomials_of_rest.T @ legendre.legvander(2.0 * position - 1.0, len(polynomials_of_rest) - 1).T)


def _same_rows(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all ordered pairs of items with the same value in ``row``, as two arrays of item indices.

    ``row`` (P,) is ascending, for P items; an item is also paired with itself.
    """
    counts = np.bincount(row)
    start = np.cumsum(counts) - counts
    many = counts[row]
    first = np.repeat(np.arange(len(row)), many)
    second = np.arange(len(first)) - np.repeat(np.cumsum(many) - many, many) + np.repeat(start[row], many)
    return first, second
