"""One slanted edge in several frames: where it stands in each of them, and its MTF with the frames laid over each other
where it moves.

The mean of frames between which the edge moves by d rms has an MTF that is lower by (2 pi f d)^2 / 2 of itself, and
nothing in the mean tells it. So every page is compared with the mean: its place, angle and two levels are
fitted to what it differs by, with the derivatives of the mean's edge-spread function. Differences of pages hold only
noise that is new in each, so that chi-square of places and angles has a known distribution. Pages that do not move are
measured in their mean, as ever. Pages that do are fitted together, each pixel at its own distance from the edge in its
page.

Rounding to whole grey values is noise only while other noise spreads over the steps (`left_over`).
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
from analysis.statistics import chance_beyond

FALSE_ALARM = 1e-4
"""Rate at which pages are aligned although the edge does not move in them."""
MOST_PIXELS = 4_000_000
"""Largest number of pixels of all pages together when they are aligned: the fit needs some 300 bytes for each."""
_STEPS = 30
_SETTLED = 2
"""Steps after which the places of pages are near enough to tell whether they turn, too."""
_DONE = 0.1
"""Steps below so many sigmas end the iteration."""
_LARGEST_STEP = 2.0
_LINE, _LEVELS = slice(0, 2), slice(2, 4)


def left_over(noise: float, step: float) -> float:
    """Rms of what rounding leaves in the mean of arbitrarily many grey values.

    Values with normal noise that are rounded to multiples of a step have a mean whose error is a Fourier series of the
    level over the step, with amplitudes step / (pi k) exp(-2 pi^2 k^2 noise^2 / step^2) (Widrow and Kollar,
    Quantization Noise, 2008, section 9). Over all levels its rms is step / sqrt(12) without noise, 0.04 steps with
    noise of 0.3, 0.002 with 0.5.

    Parameters
    ----------
    noise : float
        Of one value, rms, grey values.
    step : float
        Between possible grey values; 0 for real numbers.
    """
    if step <= 0.0:
        return 0.0
    k = np.arange(1, 2001)
    squares = np.exp(-((2.0 * np.pi * k * noise / step) ** 2)) / (2.0 * (np.pi * k) ** 2)
    return step * math.sqrt(float(np.sum(squares)))


def grey_step(grey: ArrayLike) -> float:
    """Largest power of two of which all grey values are multiples but for a constant; 0 if they are no whole numbers.

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
    """MTF of the one edge that all pages show.

    Parameters
    ----------
    pages : ArrayLike
        (P, H, W) grey values, linear in light; pages that repeat another one to the bit do not count.
    noise : NoiseModel | None
        The detector's model, as in `slanted_edge_mtf`.
    saturation : float | None
        As there; one page that reaches it is enough.
    step : float
        Between the grey values of a page, which are rounded to it; 0 for real numbers.
    even : bool
        The light is known to be even, as in `slanted_edge_mtf`.

    Raises
    ------
    EdgeError
        The region does not show one measurable edge, or pages cannot be laid over each other.
    """
    given = np.asarray(pages)
    if given.ndim != 3 or given.dtype.kind not in "uif":
        raise EdgeError(f"pages must be planes of real grey values (P, H, W), found {given.dtype} {given.shape}")
    kept = different_pages(given)
    same = len(given) - len(kept)
    given = given[kept]
    if saturation is None and noise is not None:
        saturation = noise.saturation_dn
    grey = checked_region(mean_page(given, saturation), saturation)
    every = np.asarray(given, np.float64)
    run = _Run(noise, step, same, even)
    try:
        line = locate_edge(grey)
        up = slanted_edge.rising(grey, line)
        fitted = edge_fit.fit_edge(up, *slanted_edge.rising_line(line, up.shape[1]), even)
        up = up - fitted.light.reshape(up.shape)
        stack = _Stack.of(slanted_edge.rising(every, line), fitted)
        shift = stack.differences(step, up)
        if len(every) == 1 or shift.p_value >= FALSE_ALARM:
            stack = stack.moved(shift.line)
            return run.result(up[None], len(every), line, fitted, stack, shift, aligned=False)
    except EdgeError:
        # an edge that moves far has a mean that shows none
        if len(every) == 1:
            raise
        line = _any_line(every)
        stack = None
    return _aligned(every, line, stack, run)


@dataclass(frozen=True, eq=False)
class _Run:
    """What is asked for."""

    noise: NoiseModel | None
    step: float
    same: int
    even: bool

    def result(
        self,
        pages: Array,
        frames: int,
        line: EdgeLine,
        fitted: edge_fit.FittedEdge,
        stack: _Stack,
        shift: _Shift,
        aligned: bool,
    ) -> EdgeMtf:
        """Result of pages (1, H, W), their mean, or (P, H, W), aligned; each page is the mean of some frames."""
        count = len(stack.line)
        rounded = [left_over(rms, self.step) for rms in shift.page_noise]
        found = slanted_edge.edge_result(
            pages, line, fitted, self.noise, frames // len(pages), slanted_edge.FREQUENCY, (rounded[0], rounded[1])
        )
        place, slope = stack.line.T
        spread = np.sqrt(np.stack([np.diag(one) for one in shift.covariance]))
        cosine = np.cos(np.arctan(slope)) ** 2
        # the line is that of the fit, the edge at half height a little beside it
        own = place - place.mean()
        places = slanted_edge.PagePlaces(
            position=found.position + (own if line.sign > 0 else -own),
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
        return replace(found, pages=places)


@dataclass(frozen=True, eq=False)
class _Shift:
    """What pages differ by.

    Attributes
    ----------
    line : Array
        Change of each page's offset and slope, (P, 2).
    levels : Array
        Of its dark level and contrast, (P, 2).
    covariance : Array
        Of the line by noise that is new in each page, (P, 2, 2).
    chi_square : float
        Of all lines being the same.
    page_noise : tuple[float, float]
        Of one pixel in one page on the dark and on the bright side, fixed pattern included, rms.
    """

    line: Array
    levels: Array
    covariance: Array
    chi_square: float
    page_noise: tuple[float, float]

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square; 1 for a single page."""
        return float(chance_beyond(self.chi_square, 2 * (len(self.line) - 1))) if len(self.line) > 1 else 1.0

    @property
    def turned(self) -> bool:
        """The pages turn against each other, too."""
        slope = self.line[:, 1] - self.line[:, 1].mean()
        chi_square = float(np.sum(slope**2 / self.covariance[:, 1, 1]))
        return bool(chance_beyond(chi_square, len(slope) - 1) < FALSE_ALARM)


@dataclass(frozen=True, eq=False)
class _Stack:
    """Pages (P, H, W) without uneven light, the edge rising in their rows, with a line for each, (P, 2) offset and
    slope, one edge-spread function and one bend, (B,) as `edge_fit.EdgeRows` has it. Of the levels (2,) each page has
    its own, (P, 2). light: (H, W), what was taken off.
    """

    pages: Array
    line: Array
    spread: EdgeSpread
    levels: Array
    bend: Array
    light: Array

    @classmethod
    def of(cls, pages: Array, fitted: edge_fit.FittedEdge) -> _Stack:
        """Return all pages at the place and the levels of their mean, the light of that taken off."""
        line = np.tile([fitted.rows.offset.mean(), fitted.rows.slope.mean()], (len(pages), 1))
        levels = np.tile([fitted.spread.dark, fitted.spread.contrast], (len(pages), 1))
        light = fitted.light.reshape(pages.shape[1:])
        return cls(pages - light, line, fitted.spread, levels, fitted.rows.bend, light)

    def moved(self, line: Array) -> _Stack:
        """Stack of the same pages with its lines changed by the given amounts."""
        return replace(self, line=self.line + line)

    @property
    def along(self) -> Array:
        """Rows from the middle one, (H,)."""
        rows = self.pages.shape[1]
        return np.arange(rows) - (rows - 1) / 2.0

    def distance(self) -> Array:
        """Distance of all pixels from the edge in their page, along its normal, (P, H, W), px."""
        return edge_fit.EdgeRows.of(self.line, self.pages.shape[1:], self.bend).distance().reshape(self.pages.shape)

    @property
    def levelled(self) -> Array:
        """Pages with the levels of the edge-spread function, (P, H, W)."""
        dark, contrast = self.levels[:, :1, None], self.levels[:, 1:, None]
        return np.asarray(self.spread.dark + (self.pages - dark) * (self.spread.contrast / contrast))

    def differences(self, step: float, mean: Array | None = None) -> _Shift:
        """Line and levels of each page against those it has, by least squares.

        Parameters
        ----------
        step : float
            Between the grey values of a page.
        mean : Array | None
            Of all pages (H, W), which takes the place of the model; what pixels have in all pages alike then drops out.
        """
        pages = self.pages if mean is not None else self.levelled
        count, x = len(pages), self.distance()
        line, levels = np.zeros((count, 2)), np.zeros((count, 2))
        inverse, square = [], np.zeros((2, 2))
        every = []
        # of a difference from the mean of P pages (P - 1) / P is left
        left = (count - 1) / count if mean is not None and count > 1 else 1.0
        own = np.zeros(2)
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
            found = normal @ (parts @ rest)
            line[p], levels[p] = found[_LINE], found[_LEVELS]
            sides = design.x < -self.spread.core, design.x > self.spread.core
            for k, side in enumerate(sides):
                square[k] += float(np.sum((rest - found @ parts)[side] ** 2)), max(np.count_nonzero(side) - 1.5, 1.0)
                own[k] += float(np.sum((page.ravel() - value)[side] ** 2))
            inverse.append(normal)
            every.append(parts)
        noise = [math.sqrt(total / number) for total, (_, number) in zip(own, square, strict=True)]
        # on an even side rounding may hide what it does on the edge
        least = 1e-12 * self.spread.contrast**2
        dark, bright = (
            max(total / (number * left), least, left_over(rms, step) ** 2)
            for (total, number), rms in zip(square, noise, strict=True)
        )
        covariance = np.empty((count, 2, 2))
        for p, parts in enumerate(every):
            variance = np.maximum(dark + (bright - dark) * parts[3], 0.1 * min(dark, bright))
            spread = inverse[p] @ np.einsum("in,jn->ij", parts * variance, parts) @ inverse[p]
            covariance[p] = spread[_LINE, _LINE]
        apart = line - line.mean(axis=0)
        chi_square = float(np.sum(apart * np.linalg.solve(covariance, apart[..., None])[..., 0]))
        return _Shift(line, levels, covariance, chi_square, (noise[0], noise[1]))


def different_pages(pages: NDArray[np.generic]) -> list[int]:
    """Numbers of the pages that no page before them is equal to."""
    seen: dict[bytes, int] = {}
    for number, page in enumerate(pages):
        seen.setdefault(np.ascontiguousarray(page).tobytes(), number)
    return sorted(seen.values())


def mean_page(pages: NDArray[np.generic], saturation: float | None) -> Array:
    """Mean (H, W) of pages (P, H, W); a pixel that is saturated in one page is put at that level at least."""
    # sums of huge real numbers may overflow; what is not finite is refused where it is measured
    with np.errstate(over="ignore", invalid="ignore"):
        mean = np.asarray(pages.mean(axis=0), np.float64)
        if saturation is None:
            return mean
        return np.where(np.any(np.asarray(pages, np.float64) >= saturation, axis=0), np.maximum(mean, saturation), mean)


def _any_line(pages: Array) -> EdgeLine:
    """The line in the first page that shows one. EdgeError, of the first, if none does."""
    failure: EdgeError | None = None
    for page in pages:
        try:
            return locate_edge(page)
        except EdgeError as error:
            failure = failure or error
    assert failure is not None
    raise failure


def _own_lines(pages: Array, line: EdgeLine) -> Array | None:
    """Lines (P, 2) as each page shows them alone, or None where one of them does not."""
    out = []
    for page in pages:
        try:
            found = locate_edge(page)
        except EdgeError:
            return None
        if (found.axis, found.sign) != (line.axis, line.sign):
            return None
        out.append(slanted_edge.rising_line(found, slanted_edge.rising(page, line).shape[1]))
    return np.array(out)


def _aligned(pages: Array, line: EdgeLine, stack: _Stack | None, run: _Run) -> EdgeMtf:
    """The edge of pages (P, H, W) in which it moves, all of them fitted together."""
    if pages.size > MOST_PIXELS:
        raise EdgeError(
            f"the edge moves between the pages, and {len(pages)} of {pages[0].size} pixels are too many to be laid over"
            f" each other, {MOST_PIXELS} in all are possible: take a smaller region, or fewer pages"
        )
    up = slanted_edge.rising(pages, line)
    lines = _own_lines(pages, line)
    if lines is None and stack is None:
        raise EdgeError(
            "the edge moves so far between the pages that their mean does not show it, and single pages are too noisy"
            " to show where it is: measure fewer pages, or give more light"
        )
    if lines is None:
        assert stack is not None
        lines = stack.line
    if stack is None:
        stack = _Stack.of(up, edge_fit.fit_edge(up[0], float(lines[0, 0]), float(lines[0, 1]), run.even))
    # what the mean shows of light and bend is near enough to lay the pages over each other
    flat = up - stack.light
    # one slope for all unless they turn
    start = np.column_stack([lines[:, 0], np.full(len(up), lines[:, 1].mean())])
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
        own = np.abs(change) / np.sqrt(np.diagonal(shift.covariance, axis1=1, axis2=2))
        current = _fitted(flat, current.line + change, new, stack.bend)
        if not turning and number >= _SETTLED and shift.turned:
            turning = True
        elif number >= _SETTLED and np.max(own) < _DONE:
            break
    else:
        raise EdgeError(
            "the pages cannot be laid over each other: the edge does not look alike in them; measure single pages"
        )
    rows, grey, core = _levelled(up, current.line, current.levels, stack.bend)
    fitted = edge_fit.fit_rows(rows, grey, core, run.even)
    lines = np.column_stack([fitted.rows.offset, fitted.rows.slope])[:: up.shape[1]]
    levels = np.tile([fitted.spread.dark, fitted.spread.contrast], (len(up), 1))
    even = (grey - fitted.light).reshape(up.shape)
    final = _Stack(even, lines, fitted.spread, levels, fitted.rows.bend, stack.light)
    sigma = np.stack([np.diag(one) for one in shift.covariance])
    normal = np.cos(np.arctan(final.line[:, 1])) ** 2
    jitter = normal * (sigma[:, 0] + turning * sigma[:, 1] * np.mean(final.along**2))
    fitted = replace(fitted, jitter=float(np.mean(jitter)))
    chi = final.differences(run.step)
    # of pages that differ: how far the lines stand apart
    apart = final.line - final.line.mean(axis=0)
    square = float(np.sum(apart * np.linalg.solve(chi.covariance, apart[..., None])[..., 0]))
    return run.result(final.levelled, len(up), line, fitted, final, replace(chi, chi_square=square), aligned=True)


def _levelled(up: Array, lines: Array, levels: Array, bend: Array) -> tuple[edge_fit.EdgeRows, Array, float]:
    """Return the rows of all pages, their grey values with the mean levels (N,), and the half width of the spline."""
    dark, contrast = levels.mean(axis=0)
    if np.any(levels[:, 1] < 0.1 * contrast) or contrast <= 0.0:
        page = int(np.argmin(levels[:, 1]))
        raise EdgeError(f"page {page} of those that are not repeated shows no edge; leave it out")
    grey = (dark + (up - levels[:, :1, None]) * (contrast / levels[:, 1:, None])).ravel()
    rows = edge_fit.EdgeRows.of(lines, up.shape[1:], bend)
    if rows.plateau < 10.0:
        raise EdgeError(
            "the edge moves so far between the pages that it comes within 10 px of the region's side: take a wider"
            " region, or fewer pages"
        )
    distance = rows.distance()
    edge_fit.check_phases(distance, len(rows.along), float(lines[:, 1].mean()))
    return rows, grey, edge_fit.core_width(distance, grey, rows.plateau)


def _fitted(up: Array, lines: Array, levels: Array, bend: Array) -> _Stack:
    """Return the edge-spread function of all pages, each at its own line and with its own levels."""
    rows, grey, core = _levelled(up, lines, levels, bend)
    spread = fit_edge_spread(EdgeDesign.of(rows.distance(), core, edge_fit.COARSE), grey)
    # levels of the pages against those of the fit
    dark, contrast = levels.mean(axis=0)
    gain = levels[:, 1] / contrast
    own = np.column_stack([levels[:, 0] + (spread.dark - dark) * gain, spread.contrast * gain])
    return _Stack(up, lines, spread, own, bend, np.zeros(up.shape[1:]))
