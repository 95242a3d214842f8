"""Transfer function of a pupil that edges cut, at even steps of frequency along a direction, by lines along the shift.

Every line of the pupil along the shift is light from one edge to the next. The pupil's autocorrelation is the sum over
lines of the autocorrelations along them. These are worked out on cells as long as one step of the shift, so that all
shifts together are one Fourier transform of a line; the cells that edges cut get the weights of Gauss' rule between
edge and cell, for every pair of edges. Edges are therefore exact along the lines, wherever they stand, and neither are
shadows cut to pieces nor is a wavefront continued into the dark.

Across the lines stands Fejer's rule between the places where outlines begin, end or have a corner. Where edges of the
two pupils cross, which is at another place for every shift, the integrand has a kink, and the error falls with the
square of the number of lines. A third of the lines is a rule of its own; with other nodes on the cells it tells the
error, and lines are added until it is small.

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
from optics.waves.pupil_stack import EVENLY, PupilFunction
from optics.waves.pupil_terms import polynomials, products, smooth_terms

RIM_SIDES = 2048
"""Of the polygon with the area of the pupil that stands for its edge: within 4e-7 of it, to both sides alike."""

LINE_SIDES = 192
"""Of the polygon that stands for a round edge, has its area and is within 1e-4 of its radius of it, to both sides."""

LINES = (400, 720, 1440, 3240)
"""Across the pupil, the first that do."""

SETTLED = 1e-4
"""Change of a transfer function from a third of the lines below which there are enough: they are right to a tenth."""

FEW_OUTLINES = 2
"""Beside the pupil's own edge, for which the fewest lines are tried at all."""

_LEAST = 9
"""Lines between two places where outlines begin or end."""

_CORNER = 0.3
"""Angle by which an outline turns at a corner, radians; that of a round one turns less from side to side."""

_SHORT_CELLS = 0.005, 0.04
"""Lengths of cells up to which one and two nodes do; three for longer ones."""

_TURNS = 0.2
"""Radians of phase over a cell beyond which it gets a further node: near the cut-off little else than cells that edges
cut is left."""

_AT_ONCE = 2**14
"""Nodes worked on together: some arrays of 200 kB that stay in the cache."""

_APART = 1e-6
"""Distance of two places between which there are lines, of the pupil's radius."""

_LONGEST_CELL = 0.06
"""Of the pupil's radius: longer steps of a shift are several cells, which end little beyond the pupil."""


@dataclass(frozen=True, eq=False)
class CutPupil:
    """Exit pupil that edges cut.

    Attributes
    ----------
    pupil : PupilFunction
        Its wavefront and its own edge, without shadows.
    clear : tuple[np.ndarray, ...]
        Light comes through inside of all of these only, convex polygons in p, complex, counterclockwise, (V,).
    blocked : tuple[np.ndarray, ...]
        Light is stopped in any of these, likewise.
    """

    pupil: PupilFunction
    clear: tuple[np.ndarray, ...]
    blocked: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class LineTransfer:
    """Transfer function at even steps of frequency.

    Attributes
    ----------
    values : np.ndarray
        Complex, (M,), 1 at zero frequency.
    perfect : np.ndarray
        Of the same light with a perfect wavefront, (M,).
    error : float
        Largest change of either from a third of the lines and other nodes on the cells.
    """

    values: np.ndarray
    perfect: np.ndarray
    error: float


def cut_pupils(
    pupils: Sequence[PupilFunction],
    u: np.ndarray,
    v: np.ndarray,
    nodes: PupilNodes,
    outlines: StopOutlines,
    lit: np.ndarray,
) -> tuple[CutPupil, ...]:
    """Pupils with the outlines of edges in them.

    Parameters
    ----------
    pupils : Sequence[PupilFunction]
        B, without shadows.
    u : np.ndarray
        Direction cosines along the detector's first axis at nodes of the stop, (B, N).
    v : np.ndarray
        Likewise along the second.
    nodes : PupilNodes
        Of the stop.
    outlines : StopOutlines
        Of the edges on the stop's unit disk, as B images see them.
    lit : np.ndarray
        Which nodes carry light, (B, N); those alone tell where the edges are seen.
    """
    degree = pupils[0].eikonal_terms.shape[-1] - 1
    on_stop = products(nodes.x, nodes.y, degree)
    terms = smooth_terms(on_stop, nodes.weight, lit, np.stack([u, v], axis=-1), EVENLY).swapaxes(1, 2)
    each: list[tuple[list[np.ndarray], list[np.ndarray]]] = [([], []) for _ in pupils]
    for which, kind in enumerate((outlines.clear, outlines.blocked)):
        for polygons in kind:
            full = area(polygons) > SMALLEST
            # where no rays are followed, polynomials of high degree run away beyond the rim, and p is nearly the stop's
            within = polygons / np.maximum(np.hypot(polygons[..., 0], polygons[..., 1]), 1.0)[..., None]
            cosines = products(within[..., 0], within[..., 1], degree) @ np.swapaxes(terms, 1, 2)
            for k, pupil in enumerate(pupils):
                if full[k]:
                    place = np.linalg.solve(pupil.axes, (cosines[k] - pupil.centre).T) + (polygons[k] - within[k]).T
                    each[k][which].append(_sensed(place[0] + 1j * place[1]))
                elif which == 0:
                    raise UnphysicalError(f"an edge leaves no light in the pupil of image {k}")
    return tuple(CutPupil(pupil, tuple(c), tuple(b)) for pupil, (c, b) in zip(pupils, each, strict=True))


def lit_at(cut: CutPupil, points: np.ndarray) -> np.ndarray:
    """Which points p, complex (N,), of the pupil no edge but its own lets light miss, (N,)."""
    out = np.ones(len(points), bool)
    for polygons, clear in ((cut.clear, True), (cut.blocked, False)):
        for polygon in polygons:
            left, right = _chords(polygon, points.imag)
            out &= ((left <= points.real) & (points.real <= right)) == clear
    return out


def line_transfers(
    cut: Sequence[CutPupil],
    wavelengths: Sequence[float],
    directions: np.ndarray,
    step: float,
    count: int,
    lines: Sequence[int] = (),
) -> list[list[LineTransfer]]:
    """Transfer functions at the frequencies 0, step .. (count - 1) step along some directions.

    Parameters
    ----------
    cut : Sequence[CutPupil]
        Pupils of B images.
    wavelengths : Sequence[float]
        Of their light, metres, B.
    directions : np.ndarray
        Unit vectors in detector x, y, (A, 2).
    step : float
        Of the frequency, cycles/m, positive.
    count : int
        M.
    lines : Sequence[int]
        Across the pupil, tried one after the other; by default those of LINES that this kind of pupil needs.

    Returns
    -------
    list[list[LineTransfer]]
        Of every image those along every direction.

    Raises
    ------
    UnphysicalError
        Even the most lines tell another value than a third of them.
    """
    tasks = [(one, wave, way) for one, wave in zip(cut, wavelengths, strict=True) for way in np.asarray(directions)]

    def told(task: tuple[CutPupil, float, np.ndarray]) -> LineTransfer:
        one, wave, way = task
        return _line_transfer(one, wave, way, step, count, lines)

    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        found = list(pool.map(told, tasks))
    each = len(directions)
    return [found[k : k + each] for k in range(0, len(found), each)]


def _line_transfer(
    cut: CutPupil, wavelength: float, direction: np.ndarray, step: float, count: int, lines: Sequence[int]
) -> LineTransfer:
    """``line_transfers`` of one image along one direction."""
    way = complex(cut.pupil.normalised(*direction))
    pitch, turn = wavelength * step * abs(way), way / abs(way)
    every = int(np.ceil(pitch / _LONGEST_CELL))
    pitch, count = pitch / every, (count - 1) * every + 1
    tables, outlines = _turned_tables(cut.pupil, turn), _turned(cut, turn)
    wave, error = 2.0 * np.pi / wavelength, np.inf
    nodes = _first_nodes(pitch, wave * pitch * _steepest(tables[0]))
    many = len(cut.clear) + len(cut.blocked) > FEW_OUTLINES
    for number in lines or LINES[int(many) :]:
        rows = _Lines.across(*outlines, number)
        fine = _autocorrelation(rows, tables, wave, pitch, count, nodes)
        coarse = _autocorrelation(rows.third(), tables, wave, pitch, count, nodes + 1)
        error = max(float(np.max(np.abs(a - b))) for a, b in zip(fine, coarse, strict=True))
        if error < SETTLED:
            break
        nodes += 1
    if not error < WORST_TRANSFER:
        raise UnphysicalError(
            f"the transfer function of a pupil that edges cut still changes by {error:.2g} with further lines (at most "
            f"{WORST_TRANSFER:g}): its wavefront is too steep"
        )
    return LineTransfer(fine[0][::every], fine[1][::every], error)


def _sensed(polygon: np.ndarray) -> np.ndarray:
    """A polygon (V,), complex, counterclockwise."""
    turned = np.sum((np.conj(polygon) * np.roll(polygon, -1)).imag) < 0.0
    return polygon[::-1] if turned else polygon


def _turned(cut: CutPupil, turn: complex) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Clear outlines, the pupil's own edge first, and blocked ones, with ``turn`` along x."""
    angle = 2.0 * np.pi * np.arange(RIM_SIDES) / RIM_SIDES
    rim = _sensed(np.sqrt(angle[1] / np.sin(angle[1])) * cut.pupil.edge.boundary(angle)[0])
    back = np.conj(turn)
    return [back * p for p in (rim, *cut.clear)], [back * p for p in cut.blocked]


def _turned_tables(pupil: PupilFunction, turn: complex) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of eikonal and amplitude as polynomials in coordinates whose x is ``turn``, (D + 1, D + 1) each."""
    count = len(pupil.eikonal_terms)
    node, to_table = _chebyshev_nodes(count)
    points = (node[:, None] + 1j * node).reshape(1, -1) * turn
    first, second = (
        to_table @ values.reshape(count, count) @ to_table.T
        for values in polynomials((pupil.eikonal_terms[None], pupil.amplitude_terms[None]), points)
    )
    return first, second


@cache
def _chebyshev_nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Chebyshev's nodes, (count,), and the matrix from values there to coefficients."""
    node = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    matrix = chebyshev.chebvander(node, count - 1).T * (2.0 / count)
    matrix[0] *= 0.5
    return node, matrix


def _first_nodes(pitch: float, turn: float) -> int:
    """Nodes on cells of a length, over which the phase runs by up to ``turn`` radians: where these do not do, more
    follow.
    """
    more = nodes_for(turn, 0) if turn > 1.0 else int(turn > _TURNS)
    return int(np.searchsorted(_SHORT_CELLS, pitch)) + 1 + more


def _steepest(table: np.ndarray) -> float:
    """Largest derivative along x, over the unit disk, of a polynomial with coefficients (D + 1, D + 1)."""
    axis = np.linspace(-1.0, 1.0, 33)
    slope = chebyshev.chebgrid2d(axis, axis, chebyshev.chebder(table, axis=0))
    inside = np.hypot(axis[:, None], axis) <= 1.0
    return float(np.max(np.abs(slope), where=inside, initial=0.0))


def _chords(polygon: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both ends, (N,) each, of the chords of a convex counterclockwise polygon (V,) at y (N,); where there is none the
    left end is infinite and the right one minus that.
    """
    around = np.roll(polygon, -int(np.argmin(polygon.imag)))
    top = int(np.argmax(around.imag))
    rising, falling = around[: top + 1], np.concatenate([around[top:], around[:1]])[::-1]
    right, left = (np.interp(y, np.maximum.accumulate(part.imag), part.real) for part in (rising, falling))
    within = (y > around[0].imag) & (y < around[top].imag) & (left < right)
    return np.where(within, left, np.inf), np.where(within, right, -np.inf)


@dataclass(frozen=True, eq=False)
class _Lines:
    """N lines along the shift, and where light begins and ends on them.

    Attributes
    ----------
    y : np.ndarray
        Of the lines, (N,).
    weight : np.ndarray
        Of the rule across them, (N,).
    coarse : np.ndarray
        Of that on a third of the lines, 0 for the others, (N,).
    begins, ends : np.ndarray
        Of the light, (N, K) each; places alike where there is none.
    lit : np.ndarray
        Whether there is some, (N, K).
    low, high : float
        Between which all lines lie along x.
    """

    y: np.ndarray
    weight: np.ndarray
    coarse: np.ndarray
    begins: np.ndarray
    ends: np.ndarray
    lit: np.ndarray
    low: float
    high: float

    @classmethod
    def across(cls, clear: Sequence[np.ndarray], blocked: Sequence[np.ndarray], number: int) -> _Lines:
        """Some ``number`` lines across what clear outlines leave, the first of which is the pupil's own edge."""
        parts = [_rule(a, b, number) for a, b in _between(clear, blocked)]
        y, weight, coarse = (np.concatenate(part) for part in zip(*parts, strict=True))
        chords = [_chords(polygon, y) for polygon in clear]
        start = np.max([left for left, _ in chords], axis=0)
        stop = np.min([right for _, right in chords], axis=0)
        used = stop > start
        y, weight, coarse, start, stop = (a[used] for a in (y, weight, coarse, start, stop))
        dark = [_chords(polygon, y) for polygon in blocked]
        left, right = (np.array([chord[k] for chord in dark]).reshape(len(dark), len(y)).T for k in (0, 1))
        right = np.where(right > left, right, np.inf)  # what a line does not meet lies behind its end
        order = np.argsort(left, axis=1)
        left, right = (np.take_along_axis(ends, order, axis=1) for ends in (left, right))
        # light begins where the shadows before end, and ends where the next one begins
        begins = np.maximum.accumulate(np.concatenate([start[:, None], right], axis=1), axis=1)
        ends = np.minimum(np.concatenate([left, stop[:, None]], axis=1), stop[:, None])
        lit = ends > begins
        most = max(int(np.max(np.sum(lit, axis=1), initial=0)), 1)
        first = np.argsort(~lit, axis=1, kind="stable")[:, :most]
        begins, ends, lit = (np.take_along_axis(a, first, axis=1) for a in (begins, ends, lit))
        rim = clear[0].real
        begins, ends = (np.where(lit, a, start[:, None]) for a in (begins, ends))
        return cls(y, weight, coarse, begins, ends, lit, float(np.min(rim)), float(np.max(rim)))

    def third(self) -> _Lines:
        """The third of the lines that is a rule of its own."""
        some = self.coarse != 0.0
        y, weight, begins, ends, lit = (a[some] for a in (self.y, self.coarse, self.begins, self.ends, self.lit))
        return _Lines(y, weight, weight, begins, ends, lit, self.low, self.high)


def _between(clear: Sequence[np.ndarray], blocked: Sequence[np.ndarray]) -> list[tuple[float, float]]:
    """Stretches of y between the places where outlines begin, end or have a corner."""
    rim = clear[0].imag
    low, high = float(np.min(rim)), float(np.max(rim))
    places = [low, high]
    for polygon in (*clear[1:], *blocked):
        before, after = polygon - np.roll(polygon, 1), np.roll(polygon, -1) - polygon
        sharp = np.abs(np.angle(after * np.conj(before))) > _CORNER
        places += [float(np.min(polygon.imag)), float(np.max(polygon.imag)), *polygon.imag[sharp].tolist()]
    some = np.unique(np.clip(places, low, high))
    some = some[np.concatenate([[True], np.diff(some) > _APART])]
    return [(float(a), float(b)) for a, b in pairwise(some)]


def _rule(low: float, high: float, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fejer's rule over a stretch that gets its share of ``number`` lines over [-1, 1]: places, weights, and weights of
    the rule on every third place.
    """
    count = max(_LEAST, 3 * int(np.ceil(number * (high - low) / 6.0)))
    half = 0.5 * (high - low)
    coarse = np.zeros(count)
    coarse[1::3] = half * _fejer(count // 3)
    angle = np.pi * (np.arange(count) + 0.5) / count
    return 0.5 * (low + high) - half * np.cos(angle), half * _fejer(count), coarse


@lru_cache(maxsize=256)
def _fejer(count: int) -> np.ndarray:
    """Weights of Fejer's first rule on [-1, 1], whose places are the cosines of odd multiples of pi / 2 count."""
    angle = np.pi * (np.arange(count) + 0.5) / count
    order = np.arange(1, count // 2 + 1)
    return np.asarray((2.0 / count) * (1.0 - 2.0 * np.cos(2.0 * np.outer(angle, order)) @ (1.0 / (4.0 * order**2 - 1))))


@cache
def _cell_weights(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss' places and weights on a cell [0, 1], (I,) each, and polynomials, coefficients of Legendre's over [-1, 1]
    (I + 1, I), of the integrals of Lagrange's from a place to the cell's end.
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
    """Autocorrelations at shifts 0 .. (count - 1) ``pitch`` along x with the wavefront and without, of 1 at 0.

    Parameters
    ----------
    rows : _Lines
        lines.
    tables : tuple[np.ndarray, np.ndarray]
        Eikonal and amplitude in their coordinates.
    wave : float
        Number, 1/m.
    pitch : float
        Length of a cell.
    count : int
        Of shifts.
    nodes : int
        On a cell.
    """
    place, weight, rest = _cell_weights(nodes)
    cells = int((rows.high - rows.low) / pitch) + 2
    x = rows.low + pitch * (place[:, None] + np.arange(cells))
    last = len(tables[0]) - 1
    along, across = chebyshev.chebvander(x.ravel(), last).T, chebyshev.chebvander(rows.y, last)
    size = next_fast_len(cells + count)
    with_wave, without = np.zeros(size), np.zeros(size // 2 + 1)
    at_edges, at_edges_with = [], []
    edges = _Edges.of(rows, pitch, cells, rest)
    some = max(1, _AT_ONCE // (nodes * cells))
    for start in range(0, len(rows.y), some):
        block = slice(start, start + some)
        path, light = ((across[block] @ table.T) @ along for table in tables)
        light = light.reshape(-1, nodes, cells)
        counted, own = edges.counted(start, len(light), cells, weight)
        phase, values = (wave * path).reshape(light.shape), np.empty(light.shape, complex)
        np.multiply(light, np.cos(phase), out=values.real)
        np.multiply(light, np.sin(phase), out=values.imag)
        at_edges.append(light.ravel()[own])
        at_edges_with.append(values.ravel()[own])
        every = np.outer(rows.weight[block], weight).ravel()
        for total, spectrum in (
            (with_wave, fft(values * counted, size, axis=-1)),
            (without, rfft(light * counted, size, axis=-1)),
        ):
            squares = np.square(spectrum.reshape(len(every), -1).view(float))
            total += (every @ squares).reshape(-1, 2).sum(axis=-1)
    first, second, step, more = edges.pairs(rows.weight, count, weight)
    light, values = np.concatenate(at_edges, axis=1), np.concatenate(at_edges_with, axis=1)
    real = np.bincount(step, np.sum(more * light[:, first] * light[:, second], axis=0), count)
    product = np.sum(more * values[:, first] * np.conj(values[:, second]), axis=0)
    both = np.bincount(step, product.real, count) + 1j * np.bincount(step, product.imag, count)
    found, perfect = ifft(with_wave)[:count] + both, irfft(without, size)[:count] + real
    return found / found[0].real, perfect / perfect[0]


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges of light on lines, P of them, line by line.

    Attributes
    ----------
    row : np.ndarray
        Their lines.
    cell : np.ndarray
        In which they stand.
    bent : np.ndarray
        Where in the cell, from 0 to 1.
    sign : np.ndarray
        1 where light begins, -1 where it ends.
    behind : np.ndarray
        Weights of the cell's nodes behind them, (I, P).
    rest : np.ndarray
        From which ``behind`` comes, as ``_cell_weights`` gives it.
    """

    row: np.ndarray
    cell: np.ndarray
    bent: np.ndarray
    sign: np.ndarray
    behind: np.ndarray
    rest: np.ndarray

    @classmethod
    def of(cls, rows: _Lines, pitch: float, cells: int, rest: np.ndarray) -> _Edges:
        """Those of lines."""
        there = np.concatenate([rows.lit, rows.lit], axis=1)
        row, number = np.nonzero(there)
        sign = np.where(number < rows.lit.shape[1], 1.0, -1.0)
        place = (np.concatenate([rows.begins, rows.ends], axis=1)[there] - rows.low) / pitch
        cell = np.clip(np.floor(place).astype(int), 0, cells - 2)
        return cls(row, cell, place - cell, sign, _rest(place - cell, rest), rest)

    def counted(self, start: int, lines: int, cells: int, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What of each node of some lines counts, (lines, I, cells): steps up and down at the edges, and in their cells
        the share behind the edge; and where in these the nodes of edges' cells are, (I, P).
        """
        some = slice(*np.searchsorted(self.row, [start, start + lines]))
        at, many, nodes = (self.row[some] - start) * cells + self.cell[some], lines * cells, len(weight)
        sign, out = self.sign[some], np.empty((lines, nodes, cells))
        for i, behind in enumerate(self.behind[:, some] / weight[:, None]):
            here = np.bincount(at, sign * behind, many)
            here[1:] += np.bincount(at, sign * (1.0 - behind), many)[:-1]
            np.cumsum(here.reshape(lines, cells), axis=1, out=out[:, i])
        first = (self.row[some] - start) * (nodes * cells) + self.cell[some]
        return out, first + cells * np.arange(nodes)[:, None]

    def pairs(
        self, lines: np.ndarray, count: int, weight: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Two edges of a line whose cells meet at a shift: what both leave is not the product of their shares.

        Parameters
        ----------
        lines : np.ndarray
            Weights of the lines.
        count : int
            Of shifts, in cells.
        weight : np.ndarray
            Of the nodes of a cell.

        Returns
        -------
        tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
            Numbers of both and the shift, (Q,) each, and what the nodes of the cells weigh more, (I, Q).
        """
        first, second = _same_rows(self.row)
        step = self.cell[first] - self.cell[second]
        near = (step >= 0) & (step < count)
        first, second, step = first[near], second[near], step[near]
        share = self.behind / weight[:, None]
        more = _rest(np.maximum(self.bent[first], self.bent[second]), self.rest)
        more -= self.behind[:, first] * share[:, second]
        return first, second, step, more * (self.sign[first] * self.sign[second] * lines[self.row[first]])


def _rest(place: np.ndarray, polynomials_of_rest: np.ndarray) -> np.ndarray:
    """Weights of a cell's nodes behind places (P,) from 0 to 1 in it, (I, P)."""
    return np.asarray(polynomials_of_rest.T @ legendre.legvander(2.0 * place - 1.0, len(polynomials_of_rest) - 1).T)


def _same_rows(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All ordered pairs of things that are of one row, by the rows of all, (P,), ascending."""
    many = np.bincount(row)
    start = np.cumsum(many) - many
    own = many[row]
    first = np.repeat(np.arange(len(row)), own)
    second = np.arange(len(first)) - np.repeat(np.cumsum(own) - own, own) + np.repeat(start[row], own)
    return first, second
