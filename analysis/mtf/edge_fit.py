"""Fit of one edge to all pixels of a region: its path, the light on both sides, and its edge-spread function.

The path is a straight line, found by Gauss-Newton steps on all pixels. What the pixels say against it is tested: a
bowed edge is followed by Legendre polynomials of the row up to order 5, as ISO 12233:2023 allows, with the highest
order that stands out of the noise. Light that is uneven along or across the edge makes the levels on both sides planes,

    grey = E(x) + (b1 v + b2 c) L(x) + (d1 v + d2 c) (1 - L(x)),        L = (E - dark) / contrast,

v along the edge and c across it. Their four changes are fitted together with the edge-spread function where they stand
out of the noise, so that its covariance holds what they cost. A collimator whose light falls by 1 % over the region
otherwise takes 0.7 % off the MTF at low frequencies.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.mtf.edge_location import EdgeError
from analysis.mtf.edge_spread import EdgeDesign, EdgeSpread, fit_edge_spread
from analysis.statistics import limit_of

# Half width of the spline: so many 10-90% widths of the edge, at least so many px, at most this part of the plateau.
CORE_WIDTHS, _LEAST_CORE, _LARGEST_CORE_SHARE = 4.0, 6.0, 0.7
# Widest hole between neighbouring sampling phases, px.
_LARGEST_GAP = 0.3
# Gauss-Newton steps of a straight line in uneven light, which moves with it, and in even light.
_LINE_STEPS = (4, 2)
OVERSAMPLING, COARSE = 4, 2
"""Knots of the edge-spread function per pixel; and while the line is sought, whose slope must not follow the noise."""
HIGHEST_ORDER = 5
"""Highest order of the polynomial that follows a bowed edge: that of ISO 12233:2023."""
FALSE_ALARM = 1e-4
"""Rate at which a straight edge is followed by a polynomial."""
LEAST_BEND = 0.005
"""Smallest coefficient of a bow that is followed, px: a straight line instead costs 3e-5 of the MTF at Nyquist."""
_FOLLOWING_STEPS, _LAST_STEPS = 4, 2


@dataclass(frozen=True, eq=False)
class EdgeRows:
    """Rows across an edge that rises with the column, of one page or of several, and the edge's path through them.

    offset, slope: (R,) column of the page's straight line in the middle row of the page, and its slope.
    along: (R,) distance from the middle row, px.
    columns: number of columns W.
    bend: (B,) coefficients of the Legendre polynomials of order 2 and up that all pages have in common, px.
    """

    offset: Array
    slope: Array
    along: Array
    columns: int
    bend: Array

    @staticmethod
    def of(lines: Array, shape: tuple[int, ...], bend: Array) -> EdgeRows:
        """Return the rows of pages, one page after the other.

        Args:
            lines: offset and slope of each page's line, (P, 2).
            shape: rows and columns of a page.
            bend: as the attribute.
        """
        along = np.arange(shape[0]) - (shape[0] - 1) / 2.0
        offset, slope = np.repeat(lines, shape[0], axis=0).T
        return EdgeRows(offset, slope, np.tile(along, len(lines)), shape[1], bend)

    @property
    def half(self) -> float:
        """Distance of the first row from the middle one, px: the unit of the polynomials."""
        return -float(self.along.min())

    @property
    def path(self) -> Array:
        """Column of the edge in each row, (R,)."""
        return np.asarray(self.offset + self.slope * self.along + self._legendre(0))

    @property
    def plateau(self) -> float:
        """Distance of the edge from the nearer side, along the row, at least, px."""
        path = self.path
        return float(min(path.min(), self.columns - 1 - path.max()))

    @property
    def middle(self) -> float:
        """Column of the edge in the middle row, mean of the pages."""
        return float(self.offset.mean()) + float(legendre.legval(0.0, [0.0, 0.0, *self.bend]))

    def distance(self) -> Array:
        """Return the distance of every pixel from the edge along its normal, (R * W,), px.

        A pixel h to the right of a path with the curvature p'' and the angle t is h cos t - p'' h^2 sin^2 t cos^3 t / 2
        away from it, to the first order of p''.
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
        """Return the bend or its derivative along the edge in every row, (R,)."""
        series = legendre.legder([0.0, 0.0, *self.bend], derivative)
        return np.asarray(legendre.legval(self.along / self.half, series), np.float64) / self.half**derivative


@dataclass(frozen=True, eq=False)
class FittedEdge:
    """Path, edge-spread function and uneven light of an edge, fitted to N pixels.

    rows: with the path.
    design: of all pixels by their distance from the edge; with the columns of uneven light if that was fitted.
    spread: the edge-spread function in the middle of the region. Its coefficients of uneven light are zero.
    light: (N,) what uneven light adds to the grey values.
    change: (4,) change of the bright level over the region's length along the edge and over its width, and that of the
        dark level, grey values; empty where the light is even.
    jitter: mean variance of what noise does to the line of a page, px^2.
    """

    rows: EdgeRows
    design: EdgeDesign
    spread: EdgeSpread
    light: Array
    change: Array
    jitter: float = 0.0

    @property
    def order(self) -> int:
        """Order of the path: 1 of a straight line."""
        return 1 + self.rows.bend.size


def fit_edge(rising: Array, offset: float, slope: float, even: bool = False) -> FittedEdge:
    """Return the path, the edge-spread function and the light of a region.

    Args:
        rising: grey values (H, W), from `slanted_edge.rising`.
        offset: column of the line in the middle row, about.
        slope: of the line, about.
        even: the light is known to be even.

    Raises:
        EdgeError: too few sampling phases, or no sharp edge.
    """
    grey = rising.ravel()
    rows = EdgeRows.of(np.array([[offset, slope]]), rising.shape, np.empty(0))
    distance = rows.distance()
    check_phases(distance, len(rising), slope)
    return fit_rows(rows, grey, core_width(distance, grey, rows.plateau), even, _LINE_STEPS[even])


def fit_rows(rows: EdgeRows, grey: Array, core: float, even: bool, line_steps: int = 0) -> FittedEdge:
    """Return the fit to rows of one page or of several, bowed as far as the edge is.

    Args:
        rows: with their straight lines.
        grey: values (N,) of their pixels.
        core: half width of the spline, px.
        even: the light is known to be even.
        line_steps: Gauss-Newton steps by which the lines are refined.
    """
    fitted = _fitted(rows, None, grey, core, COARSE, True)
    for step in range(line_steps):
        fitted = _fitted(fitted.rows, fitted, grey, core, COARSE, even) if step else fitted
        fitted = _moved(fitted, grey, 1)
    # of a region that holds something else the residuals say more
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
    """Return the fit after a Gauss-Newton step of the path."""
    return replace(fitted, rows=fitted.rows.moved(_path_step(fitted, grey, order)[0]))


def _fitted(
    rows: EdgeRows, before: FittedEdge | None, grey: Array, core: float, oversampling: int, even: bool
) -> FittedEdge:
    """Return edge-spread function and light at a path; the columns of light take the spread of the fit before."""
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
    at = slice(spread.spline_count, -3)
    change, coefficients[at] = coefficients[at].copy(), 0.0
    return FittedEdge(rows, design, replace(spread, coefficients=coefficients), change @ light, change)


def path_parts(fitted: FittedEdge, order: int) -> tuple[Array, NDArray[np.intp]]:
    """Return the derivatives of grey values by the coefficients of the path, (order + 1, M), and the pixels, (M,).

    Only pixels in the inner quarter of the core: farther out the fitted slope is mostly noise and would pull the path.
    """
    design, rows = fitted.design, fitted.rows
    close = np.abs(design.x[design.inside]) <= fitted.spread.core / CORE_WIDTHS
    near = design.inside[close]
    fall = -fitted.spread.core_slope(design)[close]
    return fall * rows.polynomials(order)[:, near // rows.columns], near


def _path_step(fitted: FittedEdge, grey: Array, order: int) -> tuple[Array, Array]:
    """Return the change of the path's coefficients by least squares, (order + 1,), and their sigmas by residuals."""
    parts, near = path_parts(fitted, order)
    inverse = np.linalg.inv(parts @ parts.T)
    rest = (grey - fitted.light - fitted.spread.value(fitted.design))[near]
    change = inverse @ (parts @ rest)
    scatter = float(np.mean((rest - change @ parts) ** 2))
    return change, np.sqrt(scatter * np.diag(inverse))


def _chosen_order(fitted: FittedEdge, grey: Array) -> int:
    """Return the highest order of the path whose coefficient stands out of the noise, at least 1."""
    change, sigma = _path_step(fitted, grey, HIGHEST_ORDER)
    bend = np.abs(fitted.rows.moved(change).bend)
    least = math.sqrt(float(limit_of(FALSE_ALARM / len(bend), 1)))
    there = np.flatnonzero(bend > np.maximum(least * sigma[2:], LEAST_BEND))
    return 2 + int(there[-1]) if there.size else 1


def check_phases(distance: Array, rows: int, slope: float) -> None:
    """EdgeError where the sampling phases leave a wide gap.

    Args:
        distance: of pixels from the edge, (N,), px.
        rows: lines that they lie in, for the message.
        slope: of the edge, likewise.
    """
    near = np.sort(distance[np.abs(distance) <= 1.5])
    gap = float(np.diff(near).max()) if near.size > 1 else math.inf
    if gap > _LARGEST_GAP:
        degrees = math.degrees(abs(math.atan(slope)))
        raise EdgeError(
            f"the edge at {degrees:.2f} deg to the pixel grid leaves gaps of {gap:.2f} px between its sampling phases "
            f"in {rows} lines, at most {_LARGEST_GAP} px will do: tilt the target by 2 to 10 deg"
            + (" or take a region that is longer along the edge" if 0.2 < degrees < 5 else "")
        )


def core_width(distance: Array, grey: Array, plateau: float) -> float:
    """Half width of the spline, from the 10-90% width of the edge, px.

    Args:
        distance: of pixels from the edge, (N,), px.
        grey: their values, (N,).
        plateau: that lies beside the edge on both sides, px.

    Raises:
        EdgeError: the edge is too wide for it.
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
