"""How few samples of a wave are enough: its values on an even grid from others that stand as far apart as its aperture
allows.

Along one detector axis the field of a beam is a sum of exp(i q x) with |q| no more than the half width of the beam's
directions. Such a function is known on a whole stretch from little more samples than its Nyquist number, if they reach
somewhat beyond the stretch's ends (Slepian and Pollak, Bell Syst. Tech. J. 40, 43, 1961; here by least squares over all
q of the band). A spot that its pixels sample well needs half or a third as many columns and rows as there are pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

LONGEST = 256
"""Points of a grid for which samples are worked out; longer ones are cut, since the work grows with the cube."""

_BEYOND, _BEYOND_IF_LOOSE = 4.0, 3.0
"""Nyquist distances by which samples reach beyond each end."""

_TIGHT, _LOOSE = 2e-12, 1e-8
"""Largest error of a wave of the band."""

_OVER = 1.35
_MORE, _MORE_IF_LOOSE = 22, 14
"""Number of samples that is tried first: so many times the Nyquist number, and so many more."""

_WIDER = 1.1
"""Ladder of bands for which samples are worked out."""

_WORTH = 0.8
"""Share of the points from which it is as well to take them all."""

_STEEPEST = 2.5
"""Largest band, radians from one point to the next; beyond it the points themselves are too few."""


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """Samples of a field along one axis, even and symmetric about the middle of the points.

    Attributes:
        step: between two samples, in steps of the points.
        weights: of the samples (an even number M) in each of the N points, (N, M).
    """

    step: float
    weights: np.ndarray

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.weights.shape[1]

    @classmethod
    def of(cls, points: int, band: float, loose: bool) -> FieldSamples | None:
        """Samples for a grid of points, or None where they would not be fewer than the points.

        Args:
            points: N of the grid, at most ``LONGEST``.
            band: largest |q|, radians from one point to the next.
            loose: right to 1e-8 of the sum of all waves' amplitudes, else to 2e-12.
        """
        if not 0.0 < band < _STEEPEST:
            return None
        rung = int(np.ceil(np.log(band) / np.log(_WIDER)))
        return _samples(points, rung, loose)


@lru_cache(maxsize=64)
def _samples(points: int, rung: int, loose: bool) -> FieldSamples | None:
    band = _WIDER**rung
    nyquist, beyond = np.pi / band, _BEYOND_IF_LOOSE if loose else _BEYOND
    first = _OVER * points / nyquist + (_MORE_IF_LOOSE if loose else _MORE)
    reach = 0.5 * (points - 1) + beyond * min(nyquist, 0.25 * points)
    for count in range(2 * int(np.ceil(0.5 * first)), int(_WORTH * points) + 1, 2):
        step = 2.0 * reach / (count - 1)
        # even and odd functions of the band, dense at its ends
        nodes = (np.arange(2 * count) + 0.5) / (4 * count)
        known, wanted = _waves(points, count, step, band * np.cos(np.pi * nodes))
        weights = np.linalg.lstsq(known, wanted, rcond=1e-15)[0]
        between = band * np.cos(np.pi * (np.arange(2 * count) / (4 * count)))
        seen, true = _waves(points, count, step, between)
        if np.max(np.abs(seen @ weights - true)) <= (_LOOSE if loose else _TIGHT):
            weights = np.ascontiguousarray(weights.T)
            weights.setflags(write=False)
            return FieldSamples(step, weights)
    return None


def _waves(points: int, count: int, step: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosines and sines of frequencies at the samples and at the points."""
    even = step * (np.arange(count) - 0.5 * (count - 1)), np.arange(points) - 0.5 * (points - 1)
    first, then = (np.concatenate([np.cos(q[:, None] * x), np.sin(q[:, None] * x)]) for x in even)
    return first, then
