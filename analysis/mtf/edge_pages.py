"""Slanted edge in several frames: its position in each of them, and the MTF of the aligned frames.

The mean of frames between which the edge moves by d rms has an MTF that is lower by the fraction (2 pi f d)^2 / 2 at
the frequency f, which the mean does not show. Every page is therefore compared with the mean: its position, angle and
two levels are fitted to its difference from the mean, with the derivatives of the mean's edge-spread function.
Differences of pages contain only noise that is new in each, so that chi-square of positions and angles has a known
distribution. Pages that do not move are measured in their mean. Pages that do are fitted together, each pixel at its
own distance from the edge in its page.

Rounding to whole grey values is noise only while other noise spreads over the steps (`rounding_residual`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.mtf import edge_fit, slanted_edge
from analysis.mtf.edge_fit import EdgeDesign, EdgeSpread, fit_edge_spread
from analysis.mtf.edge_location import EdgeError, EdgeLine, checked_region, locate_edge
from analysis.mtf.slanted_edge import EdgeMtf
from analysis.spots.noise import NoiseModel
from analysis.statistics import p_value_of

FALSE_ALARM = 1e-4
"""Probability that pages are aligned although the edge does not move in them."""
MOST_PIXELS = 4_000_000
"""Largest total number of pixels of pages that are aligned: the fit needs some 300 bytes for each."""
_STEPS = 30
_SETTLED = 2
"""Iterations after which the positions of pages are accurate enough to test for rotation as well."""
_DONE = 0.1
"""Change of the lines by an iteration step, in their sigmas, below which the iteration ends."""
_LARGEST_STEP = 2.0
_LINE, _LEVELS = slice(0, 2), slice(2, 4)


def rounding_residual(noise: float, step: float) -> float:
    """Return the rms of the rounding error that remains in the mean of arbitrarily many grey values.

    Values with normal noise that are rounded to multiples of a step have a mean whose error is a Fourier series of the
    level over the step, with amplitudes step / (pi k) exp(-2 pi^2 k^2 noise^2 / step^2) (Widrow and Kollar,
    Quantization Noise, 2008, section 9). Over all levels its rms is step / sqrt(12) without noise, 0.04 steps with
    noise of 0.3, 0.002 with 0.5.

    Parameters
    ----------
    noise : float
        Rms noise of one value, grey values.
    step : float
        Step between possible grey values; 0 for real numbers.
    """
    if step <= 0.0:
        return 0.0
    k = np.arange(1, 2001)
    squares = np.exp(-((2.0 * np.pi * k * noise / step) ** 2)) / (2.0 * (np.pi * k) ** 2)
    return step * math.sqrt(float(np.sum(squares)))


def grey_step(grey: ArrayLike) -> float:
    """Return the largest power of two of which all grey values are multiples but for a constant; 0 for real numbers.

    Cameras of 12 bits often fill the upper bits of 16.
    """
    values = np.asarray(grey).ravel()
    if values.dtype.kind == "f" and not (np.all(np.abs(values) < 2.0**53) and np.all(values == np.rint(values))):
        return 0.0
    whole = values.astype(np.int64)
    # an unsigned number of 64 bits that does not fit is in no image
    together = int(np.bitwise_or.reduce(whole - whole.min())) if whole.size else 0
    return float(together & -together) or 1.0


def measure_pages(
    pages: ArrayLike,
    *,
    noise: NoiseModel | None = None,
    saturation: float | None = None,
    step: float = 0.0,
    even: bool = False,
) -> EdgeMtf:
    """Measure the MTF of the one edge that all pages (frames of one scene) show.

    Dimensions: P pages, H rows, W columns.

    Parameters
    ----------
    pages : (P, H, W) array_like
        Grey values, linear in light; identical copies of a page do not count.
    noise : NoiseModel or None
        Noise model of the detector; None to estimate the noise from the residuals.
    saturation : float or None
        Grey value of saturation; one page that reaches it is enough for a refusal.
    step : float
        Step between the grey values of a page, to which they are rounded; 0 for real numbers.
    even : bool
        True if the light is known to be even; otherwise the levels on both sides are fitted as planes.

    Raises
    ------
    EdgeError
        The region does not show one measurable edge, or the pages cannot be aligned.
    """
    array = np.asarray(pages)
    if array.ndim != 3 or array.dtype.kind not in "uif":
        raise EdgeError(f"pages must be planes of real grey values (P, H, W), found {array.dtype} {array.shape}")
    unique = different_pages(array)
    same = len(array) - len(unique)
    array = array[unique]
    if saturation is None and noise is not None:
        saturation = noise.saturation_dn
    grey = checked_region(mean_page(array, saturation), saturation)
    frames = np.asarray(array, np.float64)
    run = _Run(noise, step, same, even, len(frames))
    try:
        line = locate_edge(grey)
        rising_mean = slanted_edge.rising(grey, line)
        fitted = edge_fit.fit_edge(rising_mean, *slanted_edge.rising_line(line, rising_mean.shape[1]), even)
        rising_mean = rising_mean - fitted.light.reshape(rising_mean.shape)
        stack = _Stack.of(slanted_edge.rising(frames, line), fitted)
        shift = stack.differences(step, rising_mean)
        if len(frames) == 1 or shift.p_value >= FALSE_ALARM:
            stack = stack.moved(shift.line)
            return run.result(rising_mean[None], line, fitted, stack, shift, aligned=False)
    except EdgeError:
        # the mean of pages whose edge moves far shows no edge
        if len(frames) == 1:
            raise
        line = _first_line(frames)
        stack = None
    return _aligned(frames, line, stack, run)


@dataclass(frozen=True, eq=False)
class _Run:
    """Options of a measurement: noise model, step of grey values, number of copied pages, and evenness of the light."""

    noise: NoiseModel | None
    step: float
    same: int
    even: bool
    frames: int

    def result(
        self, pages: Array, line: EdgeLine, fitted: edge_fit.FittedEdge, stack: _Stack, shift: _Shift, aligned: bool
    ) -> EdgeMtf:
        """Return the MTF of the mean page, given as (1, H, W), or of P aligned pages (P, H, W).

        ``frames`` is the number of frames averaged into all pages together.

        Dimensions: H rows, W columns.
        """
        count = len(stack.line)
        rounded = [rounding_residual(rms, self.step) for rms in shift.page_noise]
        result = slanted_edge.edge_result(
            pages, line, fitted, self.noise, self.frames // len(pages), slanted_edge.FREQUENCY, (rounded[0], rounded[1])
        )
        position, slope = stack.line.T
        spread = np.sqrt(np.stack([np.diag(matrix) for matrix in shift.covariance]))
        cosine = np.cos(np.arctan(slope)) ** 2
        # the fitted line and the edge at half height differ slightly
        relative = position - position.mean()
        positions = slanted_edge.PagePositions(
            position=result.position + (relative if line.sign > 0 else -relative),
            position_sigma=spread[:, 0],
            angle=line.sign * np.arctan(slope),
            angle_sigma=spread[:, 1] * cosine,
            chi_square=shift.chi_square,
            degrees_of_freedom=2 * (count - 1),
            aligned=aligned,
            same=self.same,
            noise=shift.page_noise,
            rounded=(rounded[0], rounded[1]),
        )
        return replace(result, pages=positions)


@dataclass(frozen=True, eq=False)
class _Shift:
    """Differences of the edge's line and of the grey levels between pages, with a test of their significance.

    Dimensions: P pages.

    Attributes
    ----------
    line : (P, 2) ndarray
        Change of each page's offset and slope.
    levels : (P, 2) ndarray
        Change of each page's dark level and contrast.
    covariance : (P, 2, 2) ndarray
        Covariance of the line due to noise that is new in each page.
    chi_square : float
        Chi-square of all lines being the same.
    page_noise : tuple of float
        Rms noise of one pixel in one page on the dark and on the bright side, fixed pattern included.
    """

    line: Array
    levels: Array
    covariance: Array
    chi_square: float
    page_noise: tuple[float, float]

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square if the edge does not move; 1 for a single page."""
        return float(p_value_of(self.chi_square, 2 * (len(self.line) - 1))) if len(self.line) > 1 else 1.0

    @property
    def rotated(self) -> bool:
        """True if the edge rotates from page to page in addition to being shifted."""
        slope = self.line[:, 1] - self.line[:, 1].mean()
        chi_square = float(np.sum(slope**2 / self.covariance[:, 1, 1]))
        return bool(p_value_of(chi_square, len(slope) - 1) < FALSE_ALARM)


@dataclass(frozen=True, eq=False)
class _Stack:
    """Pages (P, H, W) without uneven light, the edge rising in their rows, with their common edge-spread function.

    Each page has a line, offset and slope (P, 2), and levels (P, 2); all share one bend (B,), as in
    `edge_fit.EdgeRows`. ``light`` (H, W) is the uneven light that was subtracted.

    Dimensions: P pages, H rows, W columns, B coefficients of the bend.
    """

    pages: Array
    line: Array
    spread: EdgeSpread
    levels: Array
    bend: Array
    light: Array

    @classmethod
    def of(cls, pages: Array, fitted: edge_fit.FittedEdge) -> _Stack:
        """Return the stack of all pages with the line and the levels of their mean, and its uneven light subtracted."""
        line = np.tile([fitted.rows.offset.mean(), fitted.rows.slope.mean()], (len(pages), 1))
        levels = np.tile([fitted.spread.dark, fitted.spread.contrast], (len(pages), 1))
        light = fitted.light.reshape(pages.shape[1:])
        return cls(pages - light, line, fitted.spread, levels, fitted.rows.bend, light)

    def moved(self, line: Array) -> _Stack:
        """Return the stack of the same pages with their lines changed by the given amounts."""
        return replace(self, line=self.line + line)

    @property
    def along(self) -> Array:
        """Distances of the rows from the middle one, (H,) px.

        Dimensions: H rows.
        """
        rows = self.pages.shape[1]
        return np.arange(rows) - (rows - 1) / 2.0

    def distance(self) -> Array:
        """Return the distance of all pixels from the edge in their page, along its normal, (P, H, W) px.

        Dimensions: P pages, H rows, W columns.
        """
        return edge_fit.EdgeRows.of(self.line, self.pages.shape[1:], self.bend).distance().reshape(self.pages.shape)

    @property
    def levelled(self) -> Array:
        """Pages scaled to the levels of the edge-spread function, (P, H, W).

        Dimensions: P pages, H rows, W columns.
        """
        dark, contrast = self.levels[:, :1, None], self.levels[:, 1:, None]
        return np.asarray(self.spread.dark + (self.pages - dark) * (self.spread.contrast / contrast))

    def differences(self, step: float, mean: Array | None = None) -> _Shift:
        """Fit the change of each page's line and levels by least squares.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        step : float
            Step between the grey values of a page.
        mean : (H, W) ndarray or None
            Mean of all pages, which replaces the model; errors that pixels have in all pages alike then cancel.
        """
        pages = self.pages if mean is not None else self.levelled
        count, x = len(pages), self.distance()
        line, levels = np.zeros((count, 2)), np.zeros((count, 2))
        inverse, square = [], np.zeros((2, 2))
        designs = []
        # the variance of a difference from the mean of P pages is reduced by (P - 1) / P
        variance_share = (count - 1) / count if mean is not None and count > 1 else 1.0
        sums = np.zeros(2)
        for p, page in enumerate(pages):
            design = self.spread.design(x[p].ravel())
            value = self.spread.value(design)
            fall = np.zeros(page.size)
            close = np.abs(design.x[design.inside]) <= self.spread.core / edge_fit.CORE_WIDTHS
            fall[design.inside[close]] = -self.spread.core_slope(design)[close]
            fall *= math.cos(math.atan(self.line[p, 1]))
            along = np.repeat(self.along, page.shape[1])
            lift = (value - self.spread.dark) / self.spread.contrast
            parts = np.stack([fall, fall * along, np.ones(page.size), lift])
            rest = page.ravel() - (mean.ravel() if mean is not None else value)
            normal = np.linalg.inv(np.einsum("in,jn->ij", parts, parts))
            solution = normal @ (parts @ rest)
            line[p], levels[p] = solution[_LINE], solution[_LEVELS]
            sides = design.x < -self.spread.core, design.x > self.spread.core
            for k, side in enumerate(sides):
                square[k] += float(np.sum((rest - solution @ parts)[side] ** 2)), max(np.count_nonzero(side) - 1.5, 1.0)
                sums[k] += float(np.sum((page.ravel() - value)[side] ** 2))
            inverse.append(normal)
            designs.append(parts)
        noise = [math.sqrt(total / number) for total, (_, number) in zip(sums, square, strict=True)]
        # on an even side the rounding error may be invisible, but not on the edge
        least = 1e-12 * self.spread.contrast**2
        dark, bright = (
            max(total / (number * variance_share), least, rounding_residual(rms, step) ** 2)
            for (total, number), rms in zip(square, noise, strict=True)
        )
        covariance = np.empty((count, 2, 2))
        for p, parts in enumerate(designs):
            variance = np.maximum(dark + (bright - dark) * parts[3], 0.1 * min(dark, bright))
            spread = inverse[p] @ np.einsum("in,jn->ij", parts * variance, parts) @ inverse[p]
            covariance[p] = spread[_LINE, _LINE]
        apart = line - line.mean(axis=0)
        chi_square = float(np.sum(apart * np.linalg.solve(covariance, apart[..., None])[..., 0]))
        return _Shift(line, levels, covariance, chi_square, (noise[0], noise[1]))


def different_pages(pages: NDArray[np.generic]) -> list[int]:
    """Return the indices of the pages that are not equal to an earlier page."""
    first_of: dict[bytes, int] = {}
    for number, page in enumerate(pages):
        first_of.setdefault(np.ascontiguousarray(page).tobytes(), number)
    return sorted(first_of.values())


def mean_page(pages: NDArray[np.generic], saturation: float | None) -> Array:
    """Return the mean (H, W) of pages (P, H, W); a pixel that is saturated in one page gets that level at least.

    Dimensions: H rows, W columns, P pages.
    """
    # sums of huge real numbers may overflow; values that are not finite are refused by the measurement
    with np.errstate(over="ignore", invalid="ignore"):
        mean = np.asarray(pages.mean(axis=0), np.float64)
        if saturation is None:
            return mean
        return np.where(np.any(np.asarray(pages, np.float64) >= saturation, axis=0), np.maximum(mean, saturation), mean)


def _first_line(pages: Array) -> EdgeLine:
    """Return the edge's line in the first page that shows one; raise that page's EdgeError if none does."""
    failure: EdgeError | None = None
    for page in pages:
        try:
            return locate_edge(page)
        except EdgeError as error:
            failure = failure or error
    assert failure is not None
    raise failure


def _page_lines(pages: Array, line: EdgeLine) -> Array | None:
    """Return offset (px) and slope of the edge in each page alone, (P, 2); None if a page does not show the edge.

    Dimensions: P pages.
    """
    out = []
    for page in pages:
        try:
            page_line = locate_edge(page)
        except EdgeError:
            return None
        if (page_line.axis, page_line.sign) != (line.axis, line.sign):
            return None
        out.append(slanted_edge.rising_line(page_line, slanted_edge.rising(page, line).shape[1]))
    return np.array(out)


def _aligned(pages: Array, line: EdgeLine, stack: _Stack | None, run: _Run) -> EdgeMtf:
    """Measure an edge that moves between the pages (P, H, W), by fitting all pages together.

    Dimensions: P pages, H rows, W columns.
    """
    if pages.size > MOST_PIXELS:
        raise EdgeError(
            f"the edge moves between the pages, and {len(pages)} of {pages[0].size} pixels are too many to be aligned;"
            f" at most {MOST_PIXELS} in all are possible: take a smaller region, or fewer pages"
        )
    upright = slanted_edge.rising(pages, line)
    lines = _page_lines(pages, line)
    if lines is None and stack is None:
        raise EdgeError(
            "the edge moves so far between the pages that their mean does not show it, and single pages are too noisy"
            " to show where it is: measure fewer pages, or give more light"
        )
    if lines is None:
        assert stack is not None
        lines = stack.line
    if stack is None:
        stack = _Stack.of(upright, edge_fit.fit_edge(upright[0], float(lines[0, 0]), float(lines[0, 1]), run.even))
    # light and bend of the mean are accurate enough to align the pages
    flat = upright - stack.light
    # one slope for all unless they rotate
    start = np.column_stack([lines[:, 0], np.full(len(upright), lines[:, 1].mean())])
    left, right = (np.median(part, axis=(1, 2)) for part in (flat[..., :8], flat[..., -8:]))
    levels = np.column_stack([left, right - left])
    turning = False
    current = _fitted(flat, start, levels, stack.bend)
    for number in range(_STEPS):
        shift = current.differences(run.step)
        change = shift.line.copy()
        if not turning:
            change[:, 1] = change[:, 1].mean()
        change[:, 0] = np.clip(change[:, 0], -_LARGEST_STEP, _LARGEST_STEP)
        gain = current.levels[:, 1] / current.spread.contrast
        new = current.levels + shift.levels * gain[:, None]
        significance = np.abs(change) / np.sqrt(np.diagonal(shift.covariance, axis1=1, axis2=2))
        current = _fitted(flat, current.line + change, new, stack.bend)
        if not turning and number >= _SETTLED and shift.rotated:
            turning = True
        elif number >= _SETTLED and np.max(significance) < _DONE:
            break
    else:
        raise EdgeError(
            "the pages cannot be aligned: the edge does not have the same shape in them; measure single pages"
        )
    rows, grey, core = _levelled(upright, current.line, current.levels, stack.bend)
    fitted = edge_fit.fit_rows(rows, grey, core, run.even)
    lines = np.column_stack([fitted.rows.offset, fitted.rows.slope])[:: upright.shape[1]]
    levels = np.tile([fitted.spread.dark, fitted.spread.contrast], (len(upright), 1))
    even = (grey - fitted.light).reshape(upright.shape)
    final = _Stack(even, lines, fitted.spread, levels, fitted.rows.bend, stack.light)
    sigma = np.stack([np.diag(matrix) for matrix in shift.covariance])
    normal = np.cos(np.arctan(final.line[:, 1])) ** 2
    jitter = normal * (sigma[:, 0] + turning * sigma[:, 1] * np.mean(final.along**2))
    fitted = replace(fitted, jitter=float(np.mean(jitter)))
    chi = final.differences(run.step)
    # chi-square of the differences between the lines
    apart = final.line - final.line.mean(axis=0)
    square = float(np.sum(apart * np.linalg.solve(chi.covariance, apart[..., None])[..., 0]))
    return run.result(final.levelled, line, fitted, final, replace(chi, chi_square=square), aligned=True)


def _levelled(upright: Array, lines: Array, levels: Array, bend: Array) -> tuple[edge_fit.EdgeRows, Array, float]:
    """Return all rows of all pages, their grey values scaled to the mean levels, and the half width of the spline.

    The grey values have the shape (N,), the half width is in px.

    Dimensions: N pixels.
    """
    dark, contrast = levels.mean(axis=0)
    if np.any(levels[:, 1] < 0.1 * contrast) or contrast <= 0.0:
        page = int(np.argmin(levels[:, 1]))
        raise EdgeError(f"page {page}, not counting copies, shows no edge; exclude it")
    grey = (dark + (upright - levels[:, :1, None]) * (contrast / levels[:, 1:, None])).ravel()
    rows = edge_fit.EdgeRows.of(lines, upright.shape[1:], bend)
    if rows.plateau < 10.0:
        raise EdgeError(
            "the edge moves so far between the pages that it comes within 10 px of the region's side: take a wider"
            " region, or fewer pages"
        )
    distance = rows.distance()
    edge_fit.check_phases(distance, len(rows.along), float(lines[:, 1].mean()))
    return rows, grey, edge_fit.core_width(distance, grey, rows.plateau)


def _fitted(upright: Array, lines: Array, levels: Array, bend: Array) -> _Stack:
    """Return the edge-spread function of all pages, each at its own line and with its own levels."""
    rows, grey, core = _levelled(upright, lines, levels, bend)
    spread = fit_edge_spread(EdgeDesign.of(rows.distance(), core, edge_fit.COARSE), grey)
    # levels of the pages against those of the fit
    dark, contrast = levels.mean(axis=0)
    gain = levels[:, 1] / contrast
    page_levels = np.column_stack([levels[:, 0] + (spread.dark - dark) * gain, spread.contrast * gain])
    return _Stack(upright, lines, spread, page_levels, bend, np.zeros(upright.shape[1:]))
