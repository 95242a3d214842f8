"""Bars in several frames: measured in their mean unless they move from frame to frame, which lowers it.

Phases of single pages are those of their differences from the mean, which hold only noise that is new in each.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from analysis.mtf.bar_contrast import BarError, BarMtf, measure_bars
from analysis.mtf.edge_mtf import EdgeMtf
from analysis.mtf.edge_pages import different_pages, left_over, mean_page

__all__ = ["measure_bar_pages", "page_warnings"]

Array = NDArray[np.float64]
FALSE_ALARM = 1e-4
"""Of pages being refused in which the bars do not move."""
_ROUGH = 0.3
"""Noise of a pixel over the step of its grey values below which rounding is no noise: a tenth of it stays."""


def measure_bar_pages(
    region: Array,
    dark: Array,
    bright: Array,
    frequency: ArrayLike | None = None,
    *,
    saturation: float | None = None,
    offset: float = 0.0,
    step: float = 0.0,
) -> BarMtf:
    """MTF from the bars that fill a region in all pages.

    Args:
        region: (P, H, W) grey values, linear in light; pages that repeat another one to the bit do not count.
        dark: pages (Q, ...) with the level of the spaces, as in `bar_contrast.measure_bars`.
        bright: likewise with that of the bars.
        frequency: as there.
        saturation: as there; one page that reaches it is enough.
        offset: as there.
        step: between the grey values of a page, which are rounded to it; 0 for real numbers.

    Raises:
        BarError: as `measure_bars`, and bars that move from page to page.
    """
    kept = different_pages(region)
    pages, patches = region[kept], [patch[different_pages(patch)] for patch in (dark, bright)]
    mean = mean_page(pages, saturation)
    low, high = (mean_page(patch, saturation) for patch in patches)
    # sums of huge real numbers may overflow; what is not finite is refused below
    with np.errstate(over="ignore", invalid="ignore"):
        noise = [float(np.sqrt(np.mean(np.var(patch.reshape(len(patch), -1), axis=1)))) for patch in patches]
        own = math.inf if len(pages) == 1 else float(np.sqrt(np.mean(np.var(pages, axis=0, ddof=1))))
    rounding = [left_over(rms, step) if math.isfinite(rms) else 0.0 for rms in (own, *noise)]

    def measured(left: float) -> BarMtf:
        return measure_bars(
            mean,
            low,
            high,
            frequency,
            saturation=saturation,
            offset=offset,
            rounding=(left, rounding[1], rounding[2]),
        )

    found = measured(rounding[0])
    if len(pages) == 1:
        own = _scatter(mean, found)
        if left_over(own, step) > own:
            found = measured(left_over(own, step))
    else:
        _check_drift(pages, mean, found, step)
    return replace(found, page_noise=(own, noise[0], noise[1]), same=len(region) - len(pages))


def _waves(shape: tuple[int, ...], found: BarMtf) -> Array:
    """1, and the fundamental with its derivative by the phase, of unit amplitude, (3, N)."""
    place = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2.0 for n in shape), indexing="ij")).reshape(2, -1)
    phase = 2.0 * np.pi * (found.frequency @ place) + found.phase
    return np.stack([np.ones(phase.size), np.cos(phase), -np.sin(phase)])


def _scatter(mean: Array, found: BarMtf) -> float:
    """Rms of what the fundamental leaves in a page, at most; harmonics are in it."""
    waves = _waves(mean.shape, found)
    value = mean.ravel()
    rest = value - np.linalg.lstsq(waves.T, value, rcond=None)[0] @ waves
    return float(np.sqrt(np.mean(rest**2)))


def _check_drift(pages: Array, mean: Array, found: BarMtf, step: float) -> None:
    """BarError unless all pages have the same phase."""
    waves = _waves(mean.shape, found)
    inverse = np.linalg.inv(waves @ waves.T)
    rest = (pages - mean).reshape(len(pages), -1)
    parts = rest @ waves.T @ inverse
    freedom = (rest.shape[1] - 3) * (len(pages) - 1)
    noise = math.sqrt(float(np.sum((rest - parts @ waves) ** 2)) / freedom)
    noise = max(noise, left_over(noise, step), 1e-12 * found.amplitude)
    phase = parts[:, 2] / found.amplitude
    sigma = noise * math.sqrt(inverse[2, 2]) / found.amplitude
    if stats.chi2.sf(float(np.sum((phase / sigma) ** 2)), len(pages) - 1) < FALSE_ALARM:
        moved = float(np.std(phase)) / (2.0 * math.pi * found.cycles_per_pixel)
        raise BarError(
            f"the bars move by {moved:.2g} px rms from page to page (sigma of a page"
            f" {sigma / (2.0 * math.pi * found.cycles_per_pixel):.1g} px), which lowers the MTF of their mean by about"
            f" {min(0.5 * float(np.var(phase)), 1.0):.1%}: measure single pages, or hold the target still"
        )


def page_warnings(found: EdgeMtf | BarMtf, step: float) -> list[str]:
    """What pages, compared with each other and with the step of their grey values, warn of.

    Args:
        found: by `measure_bar_pages` or `edge_pages.measure_pages`.
        step: between the grey values of a page; 0 for real numbers.
    """
    if isinstance(found, EdgeMtf):
        assert found.pages is not None
        same, noise = found.pages.same, min(found.pages.noise)
    else:
        assert found.page_noise is not None
        same, noise = found.same, min(found.page_noise)
    out = []
    if same:
        out.append(f"{same} pages repeat another one to the bit and do not count: were they copied?")
    if noise < _ROUGH * step:
        out.append(
            f"the noise of {noise:.2g} in a pixel is below {_ROUGH:g} of the step of {step:g} between grey values,"
            " so that rounding does not average out over pixels and pages; sigma holds it. A higher gain helps"
        )
    if isinstance(found, EdgeMtf) and found.pages is not None and found.pages.aligned:
        pages = found.pages
        apart = np.abs(pages.position - np.mean(pages.position))
        out.append(
            f"the edge moves from page to page, by {pages.drift:.2g} px rms and {float(apart.max()):.2g} px at most"
            f" (chi-square {pages.chi_square:.4g} for {pages.degrees_of_freedom} degrees of freedom): the pages were"
            " laid over each other, so that the MTF is that of a single page"
        )
    return out
