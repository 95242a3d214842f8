"""Polynomials over a pupil (products of Chebyshev polynomials), and the edge of a pupil and its self-overlap.

Coefficients of the products T_i(x) T_j(y) of Chebyshev polynomials with i + j <= degree are in the order of ``orders``.

Points of the normalised pupil plane are complex numbers p = x + iy. The edge is the image of the stop's rim under a
smooth map; normalised so that its first harmonic is the unit circle it is

    B(a) = exp(ia) + sum_n c_n exp(ina),    a = angle on the stop's rim,

with small complex harmonics c_n.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev

from optics.numerics.array_math import UnphysicalError
from optics.numerics.quadrature import PupilNodes


def orders(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the orders (i, j) of the K Chebyshev products T_i(x) T_j(y) with i + j <= degree, (K,) each."""
    i, j = np.indices((degree + 1, degree + 1))
    keep = i + j <= degree
    return i[keep], j[keep]


def _series(x: np.ndarray, degree: int) -> np.ndarray:
    """Return the Chebyshev polynomials T_0 .. T_degree at P points in each of B pupils, (B, degree + 1, P).

    ``x`` (B, P) are coordinates from -1 to 1.
    """
    out = np.empty((len(x), degree + 1, x.shape[1]))
    out[:, 0], twice = 1.0, 2.0 * x
    if degree:
        out[:, 1] = x
    for n in range(2, degree + 1):
        np.multiply(twice, out[:, n - 1], out=out[:, n])
        out[:, n] -= out[:, n - 2]
    return out


def polynomials(tables: Iterable[np.ndarray], p: np.ndarray) -> list[np.ndarray]:
    """Return sums of the products T_i(x) T_j(y) for several tables of coefficients at the same points.

    Parameters
    ----------
    tables : iterable of (B, D + 1, D + 1) ndarray
        Coefficients of degree D for B pupils.
    p : (B, P) ndarray
        P complex points x + iy of each pupil.

    Returns
    -------
    list of (B, P) ndarray
        Sums for each table.
    """
    tables = tuple(tables)
    x, y = (_series(part, tables[0].shape[-1] - 1) for part in (p.real, p.imag))
    return [np.einsum("bip,bip->bp", table @ y, x) for table in tables]


def products(x: np.ndarray, y: np.ndarray, degree: int) -> np.ndarray:
    """Return the K products T_i(x) T_j(y) with i + j <= degree at points of any shape, (..., K).

    T_i is the Chebyshev polynomial of order i.

    Parameters
    ----------
    x, y : ndarray
        Coordinates in [-1, 1], of one shape.
    degree : int
        Highest i + j.
    """
    tx, ty = chebyshev.chebvander(x, degree), chebyshev.chebvander(y, degree)
    out = np.empty((*np.shape(x), (degree + 1) * (degree + 2) // 2))
    first = 0
    for i in range(degree + 1):  # in the order of ``orders``
        count = degree + 1 - i
        np.multiply(tx[..., i : i + 1], ty[..., :count], out=out[..., first : first + count])
        first += count
    return out


@lru_cache(maxsize=8)
def to_terms(nodes: PupilNodes, degree: int) -> np.ndarray:
    """Return the matrix (K, N) from values at N nodes of the stop to K least-squares coefficients of ``products``.

    Raises
    ------
    ValueError
        There are too few nodes for the degree.
    """
    root = np.sqrt(nodes.weight)
    stop = products(nodes.x, nodes.y, degree) * root[:, None]
    if nodes.count < stop.shape[1] or np.linalg.matrix_rank(stop) < stop.shape[1]:
        raise ValueError(f"{nodes.count} nodes do not determine polynomials of degree {degree}; trace more")
    return np.asarray(np.linalg.pinv(stop) * root)


BASE_DEGREE, STIFFNESS = 8, 1e-6
"""Degree of the polynomials by which a wavefront is continued into the dark part of a pupil, and strength of smoothing.

The strength is the penalty, relative to the squared residuals in the light, on the squares of coefficients times their
orders, except those of a plane.
"""

DARK_WEIGHT = 1e-6
"""Weight of a dark node relative to an illuminated one, for the remainder of a wavefront."""


def smooth_terms(
    design: np.ndarray, weight: np.ndarray, bright: np.ndarray, values: np.ndarray, dark_weight: float = DARK_WEIGHT
) -> np.ndarray:
    """Return coefficients of ``products`` fitted to values in the light, and continued smoothly into the dark.

    Polynomials of a low degree with a penalty on their size are fitted to the light first. All polynomials are then
    fitted to the remainder in the light, and to zero in the dark. Rays in the dark, some of which pass the rims of
    lenses far outside, have no influence.

    Parameters
    ----------
    design : (N, K) or (B, N, K) ndarray
        K ``products`` at N nodes, common to all B pupils or of each.
    weight : (N,) ndarray
        Weights of the nodes.
    bright : (B, N) ndarray of bool
        Mask of the illuminated nodes.
    values : (B, N, C) ndarray
        C quantities to fit; ignored where there is no light.
    dark_weight : float
        Weight of dark nodes; the larger it is, the less the higher polynomials contribute there.

    Returns
    -------
    (B, K, C) ndarray
        Coefficients.
    """
    i, j = orders(round(np.sqrt(2.0 * design.shape[-1] + 0.25) - 1.5))
    base = i + j <= BASE_DEGREE
    bright_values = np.where(bright[..., None], values, 0.0)
    base_design = design[..., base]
    penalty = STIFFNESS * np.sum(weight) * np.diag(np.maximum(i + j - 1.0, 0.0)[base] ** 2)
    transposed = np.swapaxes(base_design * (weight * bright)[..., None], 1, 2)
    first = np.linalg.solve(transposed @ base_design + penalty, transposed @ bright_values)
    remainder = np.where(bright[..., None], bright_values - base_design @ first, 0.0)
    transposed = np.swapaxes(design * (weight * np.where(bright, 1.0, dark_weight))[..., None], 1, 2)
    out = np.linalg.solve(transposed @ design, transposed @ remainder)
    out[:, base] += first
    return np.asarray(out)


def slopes(nodes: PupilNodes, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of K ``products`` along x and along y at N nodes, (N, K) each."""
    i, j = orders(degree)
    derive = chebyshev.chebder(np.eye(degree + 1), axis=0)
    tx, ty = (chebyshev.chebvander(c, degree) for c in (nodes.x, nodes.y))
    dx, dy = tx[:, :-1] @ derive, ty[:, :-1] @ derive
    return dx[:, i] * ty[:, j], tx[:, i] * dy[:, j]


WORST_BEND = 0.3
"""Largest allowed departure of an edge from an ellipse: the sum of n^2 |c_n| over its complex harmonics c_n, n their
order.

Up to it the edge is convex and the iterations for its chords converge.
"""

_ITERATIONS = 60
_CLOSE = 1e-13
"""Tolerance of the length of a chord, whose largest value is 2: a thousand rounding errors."""


@dataclass(frozen=True, eq=False)
class PupilEdge:
    """Smooth convex pupil edge that is nearly the unit circle, or S such edges, one for each of S shifts.

    A shift displaces a copy of the pupil, whose overlap with the pupil gives the optical transfer function at one
    frequency; edge number k is that of the pupil to which shift number k applies. Coordinates are in radii of the stop.

    Attributes
    ----------
    harmonics : (2H + 1,) or (2H + 1, S) ndarray
        Complex coefficients c_n, n = -H to H, of the edge's points x + iy = sum c_n exp(i n a), with a the angle on the
        stop's rim, in radians; c_1 is 1, c_0 and c_-1 are 0.

    Raises
    ------
    ValueError
        The edge is too far from an ellipse: sum n^2 |c_n| exceeds 1 + ``WORST_BEND``.
    """

    harmonics: np.ndarray

    def __post_init__(self) -> None:
        last = len(self.harmonics) // 2
        bend = float(np.max(np.arange(-last, last + 1) ** 2 @ np.abs(self.harmonics)) - 1.0)
        if bend > WORST_BEND:
            raise UnphysicalError(
                f"the pupil's edge is too far from an ellipse: sum n^2 |c_n| = {bend:.2g} > {WORST_BEND}"
            )

    def boundary(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return complex edge points at angles (radians) of the stop's rim, and their derivatives (per radian).

        They have the angles' shape; for S edges (S, ...).
        """
        last = len(self.harmonics) // 2
        phasor = np.exp(1j * angle)
        harmonics = self.harmonics
        if harmonics.ndim > 1:
            harmonics = harmonics.reshape(*harmonics.shape, *(1,) * (phasor.ndim - 1))
        point, slope, power = harmonics[last] + 0.0 * phasor, 0.0 * phasor, phasor
        for n in range(1, last + 1):
            plus, minus = harmonics[last + n] * power, harmonics[last - n] * np.conj(power)
            point += plus + minus
            slope += 1j * n * (plus - minus)
            power = power * phasor
        return point, slope

    def extent(self, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the length of the longest chord along each direction, and its half angle on the stop's rim, radians.

        Directions are in radians, in normalised coordinates. A longer shift leaves no overlap of the pupil with itself:
        this is the cut-off.
        """
        half = np.full(np.shape(direction), 0.5 * np.pi)
        mean = np.asarray(direction) + 0.5 * np.pi
        back = np.exp(-1j * np.asarray(direction))
        for _ in range(_ITERATIONS):
            mean, _ = self._chord(direction, mean, half)
            right, left = (self.boundary(mean + side * half)[1] * back for side in (-1.0, 1.0))
            # d(length)/d(offset) of the chord; Newton's step with the circle's second derivative
            step = -0.5 * (right.real / right.imag - left.real / left.imag)
            half = half + step
            if np.all(np.abs(step) < 1e-9):  # the length is at its maximum: its own error is the square
                break
        return self._chord(direction, mean, half)[1], half

    def _chord(self, direction: np.ndarray, mean: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the chord along ``direction`` between the edge's angles mean - half and mean + half.

        With B(a) the edge point at angle a, c_n the harmonics, m the mean and d the half angle, B(m - d) - B(m + d) = 2
        sin d exp(i direction) H, H = -i exp(-i direction) sum c_n exp(inm) sin(nd) / sin d. A given d in [0, pi] (from
        the tangent chord on one side to that on the other) has one m with real H; it is well conditioned also where the
        chord shrinks to a point.

        Parameters
        ----------
        direction : (S,) ndarray
            Directions of S chords, radians.
        mean : (S,) ndarray
            Initial mean angles, radians.
        half : (S,) ndarray
            Half angles d, radians.

        Returns
        -------
        mean : (S,) ndarray
            Mean angles m, radians.
        length : (S,) ndarray
            Lengths, in radii of the pupil, negative for negative ``half``.
        """
        last = len(self.harmonics) // 2
        factor = -1j * np.exp(-1j * np.asarray(direction))
        cos = np.cos(half)
        for _ in range(_ITERATIONS):
            phasor = np.exp(1j * mean)
            value, slope = np.zeros_like(phasor), np.zeros_like(phasor)
            power, ratio, before = phasor, np.ones_like(cos), np.zeros_like(cos)
            for n in range(1, last + 1):
                plus, minus = self.harmonics[last + n] * power, self.harmonics[last - n] * np.conj(power)
                value += ratio * (plus - minus)
                slope += (1j * n) * ratio * (plus + minus)
                power = power * phasor
                ratio, before = 2.0 * cos * ratio - before, ratio  # sin(nd)/sin d: Chebyshev's second kind
            value, slope = factor * value, factor * slope
            step = value.imag / slope.imag
            mean = mean - step
            if np.all(np.abs(step) < 1e-7):  # Newton: the next error is its square
                break
        return mean, 2.0 * np.sin(half) * (value.real - step * slope.real)

    def corners(self, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where the edges of two copies of the pupil, shifted against each other by s, intersect.

        Parameters
        ----------
        shift : (S,) ndarray
            S normalised complex shifts s.

        Returns
        -------
        a, b : (2, S) ndarray
            Angles on the stop's rim of both intersections, on the two copies: the edge points at a and b differ by s.
        inside : (S,) ndarray of bool
            True where the copies overlap.
        """
        direction, size = np.angle(shift), np.abs(shift)
        longest, middle = self.extent(direction)
        inside = size < longest
        want = np.arccos(np.minimum(size / longest, 1.0))
        out = []
        for sign in (-1.0, 1.0):
            angle, mean = want.copy(), direction + 0.5 * np.pi
            for _ in range(_ITERATIONS):
                half = middle + sign * angle
                mean, length = self._chord(direction, mean, half)
                if np.all((np.abs(length - size) < _CLOSE) | ~inside):
                    break
                angle = angle + want - np.arccos(np.clip(length / longest, -1.0, 1.0))
            out.append((mean - half, mean + half))
        return np.stack([a for a, _ in out]), np.stack([b for _, b in out]), inside

    def overlap(
        self,
        shift: np.ndarray,
        right: np.ndarray,
        left: np.ndarray,
        across: tuple[np.ndarray, np.ndarray],
        along: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a quadrature over the overlap of the pupil shifted by -s/2 and by +s/2.

        The region lies between two arcs of the edge that meet in the corners. Straight lines between points of equal
        parameter t on the arcs sweep it smoothly, so that Gauss' rules in t and along the lines converge exponentially.

        Parameters
        ----------
        shift : (S,) ndarray
            S normalised complex shifts s.
        right : (2, S) ndarray
            Angles a of ``corners``.
        left : (2, S) ndarray
            Angles b of ``corners``.
        across : (ndarray, ndarray)
            I points and weights in t over [-1, 1], (I,) each.
        along : (ndarray, ndarray)
            J points and weights on the lines over [-1, 1], (J,) each.

        Returns
        -------
        points : (S, I * J) ndarray
            Complex points c, such that c - s/2 and c + s/2 are in the pupil.
        weight : (S, I * J) ndarray
            Area weights, in normalised coordinates.
        """
        t = across[0]
        arcs = []
        for ends, side in ((right, -0.5), (left, 0.5)):
            speed = 0.5 * (ends[1] - ends[0])
            point, slope = self.boundary(0.5 * (ends[0] + ends[1])[:, None] + speed[:, None] * t)
            arcs.append((point + side * shift[:, None], slope * speed[:, None]))
        (a, da), (b, db) = arcs
        share = 0.5 * (1.0 + along[0])
        span = (a - b)[..., None]
        points = b[..., None] + span * share
        speed = db[..., None] + (da - db)[..., None] * share
        area = 0.5 * np.abs(speed.real * span.imag - speed.imag * span.real)
        weight = area * (across[1][:, None] * along[1])
        return points.reshape(len(shift), -1), weight.reshape(len(shift), -1)
