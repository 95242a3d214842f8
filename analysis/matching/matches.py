"""Matching of templates in an image: search, least squares, thresholds."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.matching.correlation import MatchOptions, Reason, checked_image, checked_places, checked_templates, search
from analysis.matching.least_squares import least_squares
from analysis.matching.window_checks import FALSE_ALARM, risk

# Side of a block of a JPEG file, px, and lines of an image in which its blocks are looked for.
_BLOCK, _BLOCK_LINES = 8, 512
# Ratio of steps between blocks to those within from which places are those of the blocks. JPEG of quality 30 to 95: 1.0
# to 2.0 where the texture passes and sigmas hold, 2.3 to 4.3 where places lock to whole pixels.
_BLOCKY = 2.2


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched points.

    Attributes:
        place: (n, 2) row and column of the templates' middles in the image; NaN where least squares matching gave none.
        covariance: (n, 2, 2) px^2, of noise and of displacements within the window; see
            `analysis.matching.least_squares`.
        correlation: (n,) of the image with the fitted template; of the search where there is no fit; NaN if neither.
        ratio: (n,) second best to best peak of the search.
        accepted: (n,) bool.
        reason: (n,) codes of `Reason`.
    """

    place: Array
    covariance: Array
    correlation: Array
    ratio: Array
    accepted: NDArray[np.bool_]
    reason: NDArray[np.int8]

    @property
    def sigma(self) -> Array:
        """(n,) standard deviation along the worst direction, px; NaN without a fit."""
        return _worst(self.covariance)

    @property
    def texts(self) -> tuple[str, ...]:
        """(n,) reasons in words."""
        return tuple(Reason(int(code)).text for code in self.reason)

    @property
    def text(self) -> str:
        """How many were accepted, and why the others were not, the most frequent reason first."""
        count = Counter(text for text in self.texts if text != Reason.ACCEPTED.text)
        parts = [f"{int(self.accepted.sum())} of {len(self.accepted)} accepted"]
        return "; ".join(parts + [f"{number} x {text}" for text, number in count.most_common()])


def match(
    image: ArrayLike, templates: ArrayLike, predicted: ArrayLike, *, reach: int, options: MatchOptions | None = None
) -> Matches:
    """Find templates in an image, each near its predicted place.

    Args:
        image: (H, W), any real type.
        templates: (n, k, k), k odd, resampled into the image's geometry (`resampled`); NaN makes a point unusable.
        predicted: (n, 2) row and column at which their middles are expected.
        reach: how far the prediction may be off along rows and columns, px.
        options: model and thresholds.

    Raises:
        ValueError: wrong shapes, reach out of range, a template too small for its margin.
    """
    plane = checked_image(image, "match")
    patch = checked_templates(templates, "match")
    expected = checked_places(predicted, len(patch), "match")
    chosen = options or MatchOptions()
    peaks = search(plane, patch, expected, reach)
    fits = least_squares(plane, patch, peaks.place, chosen)
    # points without a peak have no start, which the fit calls a bad template
    reason = np.where(peaks.reason != 0, peaks.reason, fits.reason).astype(np.int8)
    weak = np.where(np.isfinite(fits.correlation), fits.correlation, peaks.value) < chosen.least_correlation
    reason[_open(reason) & weak] = Reason.WEAK
    reason[(reason == 0) & (peaks.ratio > chosen.largest_ratio)] = Reason.AMBIGUOUS
    good = reason == Reason.ACCEPTED
    noise, relief = fits.covariances(good)
    covariance = noise + relief
    # NaN compares false
    reason[(reason == 0) & ~(_worst(noise) <= chosen.largest_sigma)] = Reason.UNCERTAIN
    reason[(reason == 0) & ~(_worst(covariance) <= chosen.largest_sigma)] = Reason.RELIEF
    # windows that noise of the template makes unknown still tell whether windows here have steps
    silent = good & ~np.isfinite(_worst(noise))
    reason = _without_steps(reason, silent, *fits.steps(good), chosen)
    reason[_open(reason) & (reason != 0) & (fits.contrast < chosen.least_contrast)] = Reason.FLAT
    if _block_ratio(plane) > _BLOCKY:
        reason[_open(reason)] = Reason.BLOCKS
    return Matches(
        place=fits.place,
        covariance=covariance,
        correlation=np.where(np.isfinite(fits.correlation), fits.correlation, peaks.value),
        ratio=peaks.ratio,
        accepted=reason == Reason.ACCEPTED,
        reason=reason,
    )


def _block_ratio(plane: NDArray[np.generic]) -> float:
    """Return how much larger steps between neighbours are at one in eight of them, along rows and columns: about 1
    where no compression has cut the image into blocks.

    The median over all steps of a phase, of their mean sizes over up to 512 lines, so that stripes of the scene count
    little; the smaller ratio of the two directions.
    """
    ratios = []
    for lines in (plane, plane.T):
        size = np.abs(np.diff(lines[:: max(len(lines) // _BLOCK_LINES, 1)].astype(np.float64), axis=1))
        seen = np.isfinite(size)
        mean = np.where(seen, size, 0.0).sum(axis=0)[seen.any(axis=0)] / seen.sum(axis=0)[seen.any(axis=0)]
        if len(mean) < 5 * _BLOCK:
            return 1.0
        phases = np.array([np.median(mean[k::_BLOCK]) for k in range(_BLOCK)])
        ratios.append(float(phases.max() / max(float(np.median(phases)), 1e-300)))
    return min(ratios)


def _without_steps(
    reason: NDArray[np.int8], silent: NDArray[np.bool_], chance: Array, power: Array, options: MatchOptions
) -> NDArray[np.int8]:
    """Verdicts after the test for steps of the displacement within windows; the silent are only counted."""
    tested = reason == Reason.ACCEPTED
    # NaN compares false
    step = tested & ~(chance >= FALSE_ALARM)
    counted = tested | silent
    share = float(np.sum(step | (silent & (chance < FALSE_ALARM)))) / max(int(counted.sum()), 1)
    weak = tested & ~step & ~(risk(share, power) <= options.largest_risk)
    return np.where(step, Reason.RELIEF, np.where(weak, Reason.UNTESTED, reason)).astype(np.int8)


def _open(reason: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Verdicts that another one may explain better: fitted, or tried to."""
    return (reason == Reason.ACCEPTED) | (reason >= Reason.BORDER)


def _worst(covariance: Array) -> Array:
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray(np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b)))
