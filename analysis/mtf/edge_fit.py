"""Fit of one edge to all pixels of a region: its path, the light on both sides, and its edge-spread function.

The path is a straight line, found by Gauss-Newton steps on all pixels. Its straightness is tested: a curved edge is
followed by Legendre polynomials of the row up to order 5, as ISO 12233:2023 allows, with the highest significant order.
Light that is uneven along or across the edge makes the levels on both sides planes,

    grey = E(x) + (b1 v + b2 c) L(x) + (d1 v + d2 c) (1 - L(x)),        L = (E - dark) / contrast,

v along the edge and c across it. Their four changes are fitted together with the edge-spread function where they are
significant, so that its covariance includes their uncertainty. Without them, a collimator whose light falls by 1 % over
the region lowers the MTF at low frequencies by 0.7 %.

The edge-spread function (ESF) is a least-squares curve through pixels at irregular positions, with a closed-form
Fourier transform:

    E(x) = dark + contrast * S(x) + tail * T(x) + sum_k a_k B((x - x_k) / step),        |x_k| < core

S is a smooth unit step (normal distribution, width 0.5 px), T = -x / (x^2 + 1 px^2) the tail, B the cubic B-spline. All
transforms are known in closed form, so that there is no bin, no difference quotient, no window and no cut-off of the
line-spread function to correct for:

- pixels enter at their own positions; the bins of ISO 12233 average positions that are not at the bin's centre;
- the derivative of the curve is exact, where a difference of bins multiplies the MTF by a sinc;
- any pupil with a sharp rim makes line-spread tails c / x^2 (the kink of the OTF at zero frequency, slope -4 / (pi f_c)
  for a circle), hence ESF tails c / x. A region of +-32 px cuts off 0.4% of the energy of an F/9 camera with 7 um
  pixels; T carries it to infinity. Asymmetry (coma) falls off faster and stays in the core.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ndtr

from analysis.arrays import Array
from analysis.mtf.edge_location import EdgeError
from analysis.statistics import limit_of

_STEP_WIDTH = 0.5
_TAIL_WIDTH = 1.0
# Weight of the third differences of the spline against the data. It matters only where pixels leave gaps between the
# sampling phases; it lowers the MTF by 2e-5 at 0.5 cycles/pixel and by 8e-4 at 1 cycle/pixel.
_STIFFNESS = 1e-4
_FOUR = np.arange(4)[:, None]
_FIRST, _SECOND = (index[:, None] for index in np.triu_indices(4))


@dataclass(frozen=True, eq=False)
class EdgeDesign:
    """Least-squares design matrix of an edge-spread function: one row for each of N pixels, one column per unknown.

    Dimensions: M pixels in the core, K terms of uneven light.

    Attributes
    ----------
    x : (N,) ndarray
        Distance of each pixel from the edge along its normal, px.
    core : float
        Half width of the spline's range, px.
    oversampling : int
        Knots per pixel.
    inside : (M,) ndarray of int
        Indices of the pixels in the core.
    cell, u : (M,) ndarray
        Knot interval of each pixel in the core, and position in the interval, 0 to 1.
    basis : (4, M) ndarray
        Values of the four splines of that interval.
    levels : (K + 3, N) ndarray
        Columns of uneven light, dark level, step and tail.
    """

    x: Array
    core: float
    oversampling: int
    inside: NDArray[np.intp]
    cell: NDArray[np.intp]
    u: Array
    basis: Array
    levels: Array

    @staticmethod
    def of(x: Array, core: float, oversampling: int, light: Array | None = None) -> EdgeDesign:
        """Return the design for pixels at the distances x.

        Dimensions: N pixels, K terms of uneven light.

        Parameters
        ----------
        x : (N,) ndarray
            Distances from the edge, px.
        core : float
            Half width of the spline, px, rounded up to whole knots.
        oversampling : int
            Knots per pixel.
        light : (K, N) ndarray or None
            Columns of uneven light; none by default. They are no part of the edge-spread function.
        """
        half = math.ceil(core * oversampling)
        bin_position = x * oversampling + half
        inside = np.flatnonzero((bin_position >= 0.0) & (bin_position < 2 * half))
        bin_position = bin_position[inside]
        cell = bin_position.astype(np.intp)
        u = bin_position - cell
        v = 1.0 - u
        basis = np.stack([v**3 / 6, u * u * (u / 2 - 1) + 2 / 3, v * v * (v / 2 - 1) + 2 / 3, u**3 / 6])
        extra = 0 if light is None else len(light)
        levels = np.empty((extra + 3, x.size))
        if light is not None:
            levels[:extra] = light
        levels[-3] = 1.0
        levels[-2] = x > 0.0
        # the core is at least 6 px wide on each side, twelve widths of the step
        levels[-2, inside] = ndtr(x[inside] / _STEP_WIDTH)
        levels[-1] = -x / (x * x + _TAIL_WIDTH**2)
        return EdgeDesign(x, half / oversampling, oversampling, inside, cell, u, basis, levels)

    @property
    def spline_count(self) -> int:
        """Number of cubic splines that lie entirely in the core.

        The curve and two derivatives therefore continue smoothly into the tails. Spline k of interval c has number c +
        k - 3; numbers outside of these have the coefficient zero.
        """
        return round(2.0 * self.core * self.oversampling) - 3

    def project(self, grey: Array) -> Array:
        """Return the product of the transposed design matrix with grey values (N,), an array (P,).

        Dimensions: N pixels, P coefficients of the edge-spread function.
        """
        index = (self.cell + _FOUR).ravel()
        spline = np.bincount(index, (self.basis * grey[self.inside]).ravel(), minlength=self.spline_count + 6)
        return np.concatenate([spline[3:-3], self.levels @ grey])

    def normal_matrix(self, weight: Array | None = None) -> Array:
        """Return the normal matrix of the least-squares problem, (P, P), with weights (N,) of the pixels.

        Dimensions: P coefficients of the edge-spread function, N pixels.
        """
        count = self.spline_count
        size = count + 6
        basis = self.basis if weight is None else self.basis * weight[self.inside]
        pair = ((self.cell * (size + 1)) + (_FIRST * size + _SECOND)).ravel()
        upper = np.bincount(pair, (basis[_FIRST[:, 0]] * self.basis[_SECOND[:, 0]]).ravel(), minlength=size * size)
        upper = upper.reshape(size, size)[3:-3, 3:-3]
        matrix = np.empty((count + len(self.levels),) * 2)
        matrix[:count, :count] = upper + np.triu(upper, 1).T
        index = (self.cell + _FOUR).ravel()
        for k, level in enumerate(self.levels[:, self.inside]):
            matrix[:count, count + k] = np.bincount(index, (basis * level).ravel(), minlength=size)[3:-3]
        matrix[count:, :count] = matrix[:count, count:].T
        matrix[count:, count:] = (self.levels if weight is None else self.levels * weight) @ self.levels.T
        return matrix


@dataclass(frozen=True, eq=False)
class EdgeSpread:
    """Fitted edge-spread function: grey value over the distance x along the edge's normal, px, rising with x.

    Dimensions: P coefficients of the edge-spread function.

    Attributes
    ----------
    core : float
        Half width of the spline's range, px.
    oversampling : int
        Knots per pixel.
    coefficients : (P,) ndarray
        Spline, uneven light, then dark level, contrast, tail (grey values; the tail's in grey values * px).
    factor : tuple
        Cholesky factor of the normal matrix of the fit.
    """

    core: float
    oversampling: int
    coefficients: Array
    factor: tuple[Array, bool]

    @property
    def spline_count(self) -> int:
        """Number of splines of the core, whose coefficients come first."""
        return round(2.0 * self.core * self.oversampling) - 3

    @property
    def dark(self) -> float:
        """Grey value far on the dark side."""
        return float(self.coefficients[-3])

    @property
    def contrast(self) -> float:
        """Grey value far on the bright side minus that on the dark side."""
        return float(self.coefficients[-2])

    def design(self, x: Array) -> EdgeDesign:
        """Return the design matrix with the same knots for other distances from the edge, (N,) px.

        Dimensions: N pixels.
        """
        return EdgeDesign.of(x, self.core, self.oversampling)

    def value(self, design: EdgeDesign) -> Array:
        """Return the grey values of the edge-spread function, (N,), at the distances of a design with the same knots.

        Dimensions: N pixels.
        """
        value = self.coefficients[-len(design.levels) :] @ design.levels
        value[design.inside] += (design.basis * self._local(design)).sum(axis=0)
        return np.asarray(value)

    def core_slope(self, design: EdgeDesign) -> Array:
        """Return the derivative of grey value with respect to distance for pixels in the core, (M,) grey values per px.

        Dimensions: M pixels in the core.
        """
        u = design.u
        v = 1.0 - u
        basis = np.stack([-v * v / 2, u * (1.5 * u - 2), v * (2 - 1.5 * v), u * u / 2])
        slope = (basis * self._local(design)).sum(axis=0) * self.oversampling
        return np.asarray(slope + self._level_slope(design.x[design.inside]))

    def slope(self, design: EdgeDesign) -> Array:
        """Return the derivative of grey value with respect to distance for all pixels, (N,) grey values per px.

        Dimensions: N pixels.
        """
        slope = self._level_slope(design.x)
        slope[design.inside] = self.core_slope(design)
        return slope

    def transform(self, frequency: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the optical transfer function, (F,), and its derivatives with respect to the coefficients, (P, F).

        ``frequency`` is along the normal, cycles/px, f in the following. The transfer function is the integral of the
        line-spread function times exp(-2 pi i f x), divided by the contrast.

        Dimensions: F frequencies, P coefficients of the edge-spread function.
        """
        omega = 2.0 * np.pi * frequency
        step = 1.0 / self.oversampling
        count = self.spline_count
        centre = -self.core + (np.arange(count) + 2.0) * step
        rows = np.zeros((self.coefficients.size, frequency.size), dtype=np.complex128)
        rows[:count] = (1j * omega * step * np.sinc(frequency * step) ** 4) * np.exp(-1j * np.outer(centre, omega))
        rows[-2] = np.exp(-0.5 * (_STEP_WIDTH * omega) ** 2)
        rows[-1] = -np.pi * omega * np.exp(-_TAIL_WIDTH * omega)
        transfer = (self.coefficients[:, None] * rows).sum(axis=0) / self.contrast
        rows[-2] -= transfer
        rows /= self.contrast
        return transfer, rows

    def covariance(self, design: EdgeDesign, variance: Array) -> Array:
        """Return the covariance of the coefficients, (P, P), for independent noise of the pixels with variances (N,).

        Dimensions: P coefficients of the edge-spread function, N pixels.
        """
        half = self._solved(design.normal_matrix(variance))
        return self._solved(half.T)

    def _solved(self, right: Array) -> Array:
        """Return the inverse normal matrix times a matrix ``right``, computed eight columns at a time.

        All at once, the linear algebra library would split the work over threads, which on a busy machine wait for each
        other a hundred times longer than the solution takes.
        """
        columns = range(0, right.shape[1], 8)
        return np.hstack([cho_solve(self.factor, right[:, k : k + 8], check_finite=False) for k in columns])

    def _local(self, design: EdgeDesign) -> Array:
        """Return the coefficients of the four B-splines that are nonzero at each pixel of the core, (4, M).

        Dimensions: M pixels in the core.
        """
        padded = np.zeros(self.spline_count + 6)
        padded[3:-3] = self.coefficients[: self.spline_count]
        return np.asarray(padded[design.cell + _FOUR])

    def _level_slope(self, x: Array) -> Array:
        step = np.exp(-0.5 * (x / _STEP_WIDTH) ** 2) / (_STEP_WIDTH * math.sqrt(2.0 * math.pi))
        square = x * x
        tail = (square - _TAIL_WIDTH**2) / (square + _TAIL_WIDTH**2) ** 2
        return np.asarray(self.contrast * step + self.coefficients[-1] * tail)


def fit_edge_spread(design: EdgeDesign, grey: Array) -> EdgeSpread:
    """Fit the edge-spread function to pixels of grey values (N,) at the distances of the design.

    All pixels have the same weight: weights that follow the shot noise would gain little, and if taken from the data
    they would bias the levels.

    Dimensions: N pixels.
    """
    count = design.spline_count
    matrix = design.normal_matrix()
    density = grey.size / float(np.ptp(design.x)) / design.oversampling
    # third differences of a spline that is zero outside
    third = np.zeros((count + 3, count))
    index = np.arange(count)
    for offset, weight in enumerate((1.0, -3.0, 3.0, -1.0)):
        third[index + offset, index] = weight
    matrix[:count, :count] += _STIFFNESS * density * (third.T @ third)
    factor = cho_factor(matrix, check_finite=False)
    return EdgeSpread(
        design.core, design.oversampling, cho_solve(factor, design.project(grey), check_finite=False), factor
    )


# Half width of the spline: in 10-90% widths of the edge, its least value in px, its largest fraction of the plateau.
CORE_WIDTHS, _LEAST_CORE, _LARGEST_CORE_SHARE = 4.0, 6.0, 0.7
# Widest hole between neighbouring sampling phases, px.
_LARGEST_GAP = 0.3
# Gauss-Newton steps of a straight line: in uneven light, which is correlated with the line, and in even light.
_LINE_STEPS = (4, 2)
OVERSAMPLING, COARSE = 4, 2
"""Knots of the edge-spread function per pixel: in the final fit, and in the fits that determine the edge's line.

The latter has fewer, so that it does not follow the noise.
"""
HIGHEST_ORDER = 5
"""Highest order of the polynomial that follows a curved edge, that of ISO 12233:2023."""
FALSE_ALARM = 1e-4
"""Probability that a straight edge is followed by a polynomial."""
LEAST_BEND = 0.005
"""Smallest coefficient of a curved path that is fitted, px: a straight line instead costs 3e-5 of the MTF at Nyquist.
"""
_FOLLOWING_STEPS, _LAST_STEPS = 4, 2


@dataclass(frozen=True, eq=False)
class EdgeRows:
    """Rows across an edge that rises with the column, of one page or of several, and the edge's path through them.

    Dimensions: R rows of pixels, B coefficients of the bend.

    Attributes
    ----------
    offset, slope : (R,) ndarray
        Column of the page's straight line in the middle row of the page, px, and its slope.
    along : (R,) ndarray
        Distance of the row from the middle row, px.
    columns : int
        Number of columns W.
    bend : (B,) ndarray
        Coefficients of the Legendre polynomials of order 2 and up that describe a curved edge, the same for all pages,
        px.
    """

    offset: Array
    slope: Array
    along: Array
    columns: int
    bend: Array

    @staticmethod
    def of(lines: Array, shape: tuple[int, ...], bend: Array) -> EdgeRows:
        """Return the rows of several pages, one page after the other, with the line of each page and the common bend.

        Dimensions: P pages, B coefficients of the bend.

        Parameters
        ----------
        lines : (P, 2) ndarray
            Offset and slope of each page's line.
        shape : tuple of int
            Rows and columns of a page.
        bend : (B,) ndarray
            Coefficients of the Legendre polynomials of order 2 and up that describe a curved edge, px.
        """
        along = np.arange(shape[0]) - (shape[0] - 1) / 2.0
        offset, slope = np.repeat(lines, shape[0], axis=0).T
        return EdgeRows(offset, slope, np.tile(along, len(lines)), shape[1], bend)

    @property
    def half(self) -> float:
        """Distance of the first row from the middle one, px, which is the unit of length of the polynomials."""
        return -float(self.along.min())

    @property
    def path(self) -> Array:
        """Column of the edge in each row, (R,).

        Dimensions: R rows of pixels.
        """
        return np.asarray(self.offset + self.slope * self.along + self._legendre(0))

    @property
    def plateau(self) -> float:
        """Smallest distance along a row from the edge to the nearer side of the region, px."""
        path = self.path
        return float(min(path.min(), self.columns - 1 - path.max()))

    @property
    def middle(self) -> float:
        """Column of the edge in the middle row, mean over the pages, px."""
        return float(self.offset.mean()) + float(legendre.legval(0.0, [0.0, 0.0, *self.bend]))

    def distance(self) -> Array:
        """Return the distance of every pixel from the edge along its normal, (R * W,) px.

        A pixel that is h px to the right of a path with the second derivative p'' and the angle t to the column
        direction is h cos t - p'' h^2 sin^2 t cos^3 t / 2 away from it, to first order in p''.
        """
        angle = np.arctan(self.slope + self._legendre(1))[:, None]
        beside = np.arange(self.columns) - self.path[:, None]
        out = beside * np.cos(angle)
        if self.bend.size:
            out -= 0.5 * self._legendre(2)[:, None] * (beside * np.sin(angle)) ** 2 * np.cos(angle) ** 3
        return np.asarray(out, np.float64).ravel()

    def moved(self, change: Array) -> EdgeRows:
        """Return the rows with the coefficients of the path changed, (1 + order,), px."""
        size = max(self.bend.size, change.size - 2)
        bend = np.pad(self.bend, (0, size - self.bend.size)) + np.pad(change[2:], (0, size + 2 - change.size))
        return replace(self, offset=self.offset + change[0], slope=self.slope + change[1] / self.half, bend=bend)

    def polynomials(self, order: int) -> Array:
        """Return the Legendre polynomials of order 0 to the given one in every row, (order + 1, R)."""
        return np.asarray(legendre.legvander(self.along / self.half, order).T)

    def _legendre(self, derivative: int) -> Array:
        """Return the deviation of the path from a straight line, or its derivative along the edge, in every row, (R,).

        Dimensions: R rows of pixels.
        """
        series = legendre.legder([0.0, 0.0, *self.bend], derivative)
        return np.asarray(legendre.legval(self.along / self.half, series), np.float64) / self.half**derivative


@dataclass(frozen=True, eq=False)
class FittedEdge:
    """Path, edge-spread function and uneven light of an edge, fitted to N pixels.

    Attributes
    ----------
    rows : EdgeRows
        Rows of the region with the path.
    design : EdgeDesign
        Design of all pixels by their distance from the edge, with columns of uneven light if that was fitted.
    spread : EdgeSpread
        Edge-spread function in the middle of the region. Its coefficients of uneven light are zero.
    light : (N,) ndarray
        Contribution of uneven light to the grey values.
    change : (4,) ndarray
        Change of the bright level over the region's length along the edge and over its width, and that of the dark
        level, grey values; empty where the light is even.
    jitter : float
        Variance due to noise of the position of a page's line, mean over the pages, px^2.
    """

    rows: EdgeRows
    design: EdgeDesign
    spread: EdgeSpread
    light: Array
    change: Array
    jitter: float = 0.0

    @property
    def order(self) -> int:
        """Order of the path's polynomial: 1 for a straight line."""
        return 1 + self.rows.bend.size


def fit_edge(rising: Array, offset: float, slope: float, even: bool = False) -> FittedEdge:
    """Fit the path, the edge-spread function and the light of a region.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    rising : (H, W) ndarray
        Grey values, from `slanted_edge.rising`.
    offset : float
        Approximate column of the line in the middle row, px.
    slope : float
        Approximate slope of the line.
    even : bool
        True if the light is known to be even.

    Raises
    ------
    EdgeError
        There are too few sampling phases, or no sharp edge.
    """
    grey = rising.ravel()
    rows = EdgeRows.of(np.array([[offset, slope]]), rising.shape, np.empty(0))
    distance = rows.distance()
    check_phases(distance, len(rising), slope)
    return fit_rows(rows, grey, core_width(distance, grey, rows.plateau), even, _LINE_STEPS[even])


def fit_rows(rows: EdgeRows, grey: Array, core: float, even: bool, line_steps: int = 0) -> FittedEdge:
    """Fit the edge to rows of one page or of several, with a curved path where that is significant.

    Dimensions: N pixels.

    Parameters
    ----------
    rows : EdgeRows
        Rows with their straight lines.
    grey : (N,) ndarray
        Grey values of all pixels of these rows.
    core : float
        Half width of the range of the edge-spread function's spline, px.
    even : bool
        True if the light is known to be even.
    line_steps : int
        Number of Gauss-Newton steps by which the lines are refined.
    """
    fitted = _fitted(rows, None, grey, core, COARSE, True)
    for step in range(line_steps):
        fitted = _fitted(fitted.rows, fitted, grey, core, COARSE, even) if step else fitted
        fitted = _moved(fitted, grey, 1)
    # a region with other structure is rejected later, by its residuals
    with contextlib.suppress(EdgeError):
        core = core if even else core_width(fitted.rows.distance(), grey - fitted.light, fitted.rows.plateau)
    straight = _fitted(fitted.rows, fitted, grey, core, OVERSAMPLING, even)
    order = _chosen_order(straight, grey)
    if order == 1:
        return straight
    fitted = straight
    for step in range(_FOLLOWING_STEPS + _LAST_STEPS):
        core = core_width(fitted.rows.distance(), grey - fitted.light, fitted.rows.plateau)
        fitted = _fitted(fitted.rows, fitted, grey, core, COARSE, even)
        if step == _FOLLOWING_STEPS:
            order = _chosen_order(fitted, grey)
            fitted = replace(fitted, rows=replace(fitted.rows, bend=fitted.rows.bend[: order - 1]))
        else:
            fitted = _moved(fitted, grey, HIGHEST_ORDER if step < _FOLLOWING_STEPS else order)
    core = core_width(fitted.rows.distance(), grey - fitted.light, fitted.rows.plateau)
    return _fitted(fitted.rows, fitted, grey, core, OVERSAMPLING, even)


def _moved(fitted: FittedEdge, grey: Array, order: int) -> FittedEdge:
    """Return the fit after one Gauss-Newton step of the coefficients of the edge's path."""
    return replace(fitted, rows=fitted.rows.moved(_path_step(fitted, grey, order)[0]))


def _fitted(
    rows: EdgeRows, before: FittedEdge | None, grey: Array, core: float, oversampling: int, even: bool
) -> FittedEdge:
    """Return the edge-spread function and the uneven light, fitted for a given path of the edge.

    The terms of uneven light need an edge-spread function; that of the fit ``before`` is used.
    """
    x = rows.distance()
    if even or before is None:
        design = EdgeDesign.of(x, core, oversampling)
        return FittedEdge(rows, design, fit_edge_spread(design, grey), np.zeros(grey.size), np.empty(0))
    last = before.spread
    lift = (last.value(last.design(x)) - last.dark) / last.contrast
    along = np.repeat(rows.along / (2.0 * rows.half), rows.columns)
    across = np.tile(np.arange(rows.columns) / (rows.columns - 1) - 0.5, len(rows.along))
    light = np.stack([along * lift, across * lift, along * (1.0 - lift), across * (1.0 - lift)])
    design = EdgeDesign.of(x, core, oversampling, light)
    spread = fit_edge_spread(design, grey)
    coefficients = spread.coefficients.copy()
    light_slice = slice(spread.spline_count, -3)
    change, coefficients[light_slice] = coefficients[light_slice].copy(), 0.0
    return FittedEdge(rows, design, replace(spread, coefficients=coefficients), change @ light, change)


def path_parts(fitted: FittedEdge, order: int) -> tuple[Array, NDArray[np.intp]]:
    """Return derivatives of grey values with respect to the path's coefficients, and the indices of their pixels.

    The arrays have the shapes (order + 1, M) and (M,). Only pixels in the inner quarter of the core are used: farther
    out the fitted slope is mostly noise and would bias the path.

    Dimensions: M pixels in the core.
    """
    design, rows = fitted.design, fitted.rows
    close = np.abs(design.x[design.inside]) <= fitted.spread.core / CORE_WIDTHS
    near = design.inside[close]
    fall = -fitted.spread.core_slope(design)[close]
    return fall * rows.polynomials(order)[:, near // rows.columns], near


def _path_step(fitted: FittedEdge, grey: Array, order: int) -> tuple[Array, Array]:
    """Return the least-squares change of the path's coefficients, (order + 1,) px, and its standard deviations."""
    parts, near = path_parts(fitted, order)
    inverse = np.linalg.inv(parts @ parts.T)
    rest = (grey - fitted.light - fitted.spread.value(fitted.design))[near]
    change = inverse @ (parts @ rest)
    scatter = float(np.mean((rest - change @ parts) ** 2))
    return change, np.sqrt(scatter * np.diag(inverse))


def _chosen_order(fitted: FittedEdge, grey: Array) -> int:
    """Return the highest order of the path whose coefficient is significant, at least 1."""
    change, sigma = _path_step(fitted, grey, HIGHEST_ORDER)
    bend = np.abs(fitted.rows.moved(change).bend)
    least = math.sqrt(float(limit_of(FALSE_ALARM / len(bend), 1)))
    there = np.flatnonzero(bend > np.maximum(least * sigma[2:], LEAST_BEND))
    return 2 + int(there[-1]) if there.size else 1


def check_phases(distance: Array, rows: int, slope: float) -> None:
    """Raise EdgeError if the pixels' distances from the edge, modulo a pixel, leave a wide gap.

    Dimensions: N pixels.

    Parameters
    ----------
    distance : (N,) ndarray
        Distances of the pixels from the edge, px.
    rows : int
        Number of lines of pixels, for the message.
    slope : float
        Slope of the edge, for the message.
    """
    near = np.sort(distance[np.abs(distance) <= 1.5])
    gap = float(np.diff(near).max()) if near.size > 1 else math.inf
    if gap > _LARGEST_GAP:
        degrees = math.degrees(abs(math.atan(slope)))
        raise EdgeError(
            f"the edge at {degrees:.2f} deg to the pixel grid leaves gaps of {gap:.2f} px between its sampling phases "
            f"in {rows} lines; at most {_LARGEST_GAP} px are allowed: tilt the target by 2 to 10 deg"
            + (" or take a region that is longer along the edge" if 0.2 < degrees < 5 else "")
        )


def core_width(distance: Array, grey: Array, plateau: float) -> float:
    """Return the half width of the spline from the 10-90% width of the edge, px.

    Dimensions: N pixels.

    Parameters
    ----------
    distance : (N,) ndarray
        Distances of the pixels from the edge, px.
    grey : (N,) ndarray
        Values of the pixels.
    plateau : float
        Width of the level area beside the edge on both sides, px.

    Raises
    ------
    EdgeError
        The edge is too wide for the region.
    """
    cell = np.round(2.0 * distance).astype(np.intp)
    low = int(cell.min())
    count = np.bincount(cell - low)
    profile = np.bincount(cell - low, grey) / np.maximum(count, 1)
    middle = -low
    outer = round(2.0 * 0.7 * plateau)
    dark, bright = profile[: middle - outer].mean(), profile[middle + outer :].mean()
    relative = (profile - dark) / (bright - dark)
    right = int(np.argmax(relative[middle:] > 0.9))
    left = int(np.argmax(relative[middle::-1] < 0.1))
    width = (left + right) / 2.0
    largest = _LARGEST_CORE_SHARE * plateau
    if not 0 < 2.0 * width <= largest:
        raise EdgeError(
            f"no sharp edge in the region: grey values rise from 10% to 90% over {width:.0f} px, and only "
            f"{plateau:.0f} px lie beside the edge; take a wider region, or one with a single edge between even areas"
        )
    return min(max(CORE_WIDTHS * width, _LEAST_CORE), largest)
