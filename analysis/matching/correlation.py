"""Search by normalised cross-correlation: where in a window about its predicted place does a template fit best.

The coefficient is that of grey values about their means, so that gain and offset do not matter. It is good to some
tenths of a pixel (parabola through the peak, with its known pull towards whole pixels); least squares matching refines.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.matching.checks import checked_image, checked_places, checked_templates
from analysis.matching.reason import Reason

__all__ = ["LARGEST_REACH", "Peaks", "search"]

Array = NDArray[np.float64]
LARGEST_REACH = 200
# Half-width of the main lobe, px: other peaks count from there.
_LOBE = 3
# Standard deviation below which a patch is even, relative to its largest grey value: float32 sees no more.
_EVEN = 1e-6


@dataclass(frozen=True, eq=False)
class Peaks:
    """Best places.

    Attributes:
        place: (n, 2) row and column of the templates' middles; NaN where nothing was searched.
        value: (n,) coefficient of the best peak, -1 to 1; NaN likewise.
        ratio: (n,) second best local maximum, more than three pixels from the best, over the best; 0 without one,
            1 if the best is not positive.
        reason: (n,) codes of `Reason`: ACCEPTED, TEMPLATE, OUTSIDE, IMAGE, FLAT or BORDER. BORDER also where the
            image's edge cuts the window.
    """

    place: Array
    value: Array
    ratio: Array
    reason: NDArray[np.int8]


def search(image: ArrayLike, templates: ArrayLike, predicted: ArrayLike, reach: int) -> Peaks:
    """Best place of each template within reach of its predicted place.

    Args:
        image: (H, W), any real type.
        templates: (n, k, k), k odd, in the image's geometry.
        predicted: (n, 2) row and column at which their middles are expected; searched from the nearest pixel.
        reach: rows and columns to each side, px.

    Raises:
        ValueError: wrong shapes, reach not 1 to 200 px.
    """
    plane = checked_image(image, "search")
    patch = checked_templates(templates, "search")
    place = checked_places(predicted, len(patch), "search")
    if not 1 <= reach <= LARGEST_REACH:
        raise ValueError(f"search: the reach must be 1 to {LARGEST_REACH} px, found {reach}; improve the prediction")
    count = len(patch)
    found, value, ratio = np.full((count, 2), np.nan), np.full(count, np.nan), np.full(count, np.nan)
    reason = np.zeros(count, np.int8)
    for k in range(count):
        if not (np.isfinite(patch[k]).all() and np.isfinite(place[k]).all()):
            reason[k] = Reason.TEMPLATE
            continue
        found[k], value[k], ratio[k], reason[k] = _best(plane, patch[k], np.rint(place[k]), int(reach))
    return Peaks(found, value, ratio, reason)


def _best(image: NDArray[np.generic], template: Array, middle: Array, reach: int) -> tuple[Array, float, float, Reason]:
    nowhere = np.full(2, np.nan)
    half = template.shape[0] // 2
    last = np.array(image.shape) - 1 - half
    low, high = np.maximum(middle - reach, half), np.minimum(middle + reach, last)
    if np.any(low > high) or np.any(middle < half) or np.any(middle > last):
        return nowhere, np.nan, np.nan, Reason.OUTSIDE
    (top, left), (bottom, right) = (low - half).astype(int), (high + half + 1).astype(int)
    window = image[top:bottom, left:right].astype(np.float64)
    if not np.isfinite(window).all():
        return nowhere, np.nan, np.nan, Reason.IMAGE
    # about the mean, because sums of squares are taken in float32
    window, level = window - window.mean(), template - template.mean()
    if template.std() <= _EVEN * np.abs(template).max() or window.std() <= _EVEN * np.abs(window).max():
        return nowhere, np.nan, np.nan, Reason.FLAT
    scores = (window / window.std()).astype(np.float32), (level / level.std()).astype(np.float32)
    field = cv2.matchTemplate(*scores, cv2.TM_CCOEFF_NORMED)
    # where the window is even, 0 / 0 comes out as anything
    field = np.where(np.abs(field) <= 1.0 + 1e-3, field, 0.0)
    row, column = np.unravel_index(int(np.argmax(field)), field.shape)
    best = float(field[row, column])
    ratio = _second(field, int(row), int(column)) / best if best > 0 else 1.0
    at = low + np.array([row, column])
    if not (0 < row < field.shape[0] - 1 and 0 < column < field.shape[1] - 1):
        return at, best, ratio, Reason.BORDER
    lines = field[row - 1 : row + 2, column], field[row, column - 1 : column + 2]
    at = at + np.array([_vertex(line.astype(np.float64)) for line in lines])
    return at, best, ratio, Reason.ACCEPTED


def _second(field: NDArray[np.float32], row: int, column: int) -> float:
    """Highest local maximum (of 5 x 5) outside of the main lobe; the slope of a wide lobe is none."""
    peak = field >= cv2.dilate(field, np.ones((5, 5), np.uint8))
    peak[max(row - _LOBE, 0) : row + _LOBE + 1, max(column - _LOBE, 0) : column + _LOBE + 1] = False
    return max(float(field[peak].max(initial=0.0)), 0.0)


def _vertex(three: Array) -> float:
    """Of the parabola through three values about the largest, px from the middle one."""
    bend = three[0] - 2.0 * three[1] + three[2]
    return float(0.5 * (three[0] - three[2]) / bend) if bend < 0 else 0.0
