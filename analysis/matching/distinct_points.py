"""Points of an image that can be matched well in both directions, spread over it.

Strength is the smaller eigenvalue of the structure tensor (Foerstner and Gülch, 1987; Shi and Tomasi, CVPR 1994) of
slightly smoothed grey values: the weight of the worse direction in least squares matching, per pixel.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.matching.checks import checked_image

__all__ = ["distinct_points"]

Array = NDArray[np.float64]
_SMOOTHING = 1.0
# Standard deviation of the Gaussian window of the tensor, px: half of a window of matching.
_WINDOW = 3.0
# Rows that are worked on together, and what a pixel's strength needs about it.
_STRIP, _HALO = 512, 18
# Strength over that of the noise alone.
_LEAST = 2.0


def distinct_points(image: ArrayLike, count: int, *, spacing: float, border: int) -> Array:
    """Well-defined points, spread evenly: the strongest of each cell of a grid first, then the second strongest ...

    Args:
        image: (H, W), any real type; around pixels that are not finite there are no points.
        count: most points.
        spacing: least distance of two points along rows or columns, px.
        border: rows and columns at each side without points; at least half of a template and the reach.

    Returns:
        (n, 2) rows and columns, whole pixels, n <= count; fewer where the image has no more. The same image gives
        the same points.

    Raises:
        ValueError: image not a plane, count or spacing below 1, border negative or so large that nothing is left.
    """
    plane = checked_image(image, "distinct points")
    if count < 1 or not spacing >= 1 or border < 0:
        raise ValueError(
            f"distinct points: count and spacing must be 1 or more and border 0 or more, found {count}, {spacing}, "
            f"{border}"
        )
    height, width = plane.shape
    if min(height, width) <= 2 * border:
        raise ValueError(f"distinct points: a border of {border} px leaves nothing of {plane.shape}; make it smaller")
    strength = np.zeros(plane.shape, np.float32)
    for top in range(0, height, _STRIP):
        first, last = max(top - _HALO, 0), min(top + _STRIP + _HALO, height)
        strip = _strength(plane[first:last])
        strength[top : top + _STRIP] = strip[top - first : top - first + min(_STRIP, height - top)]
    size = 2 * int(np.ceil(spacing)) - 1
    inner = np.zeros(plane.shape, bool)
    inner[border : height - border, border : width - border] = True
    strength[~inner] = 0.0
    peak = (strength > 0) & (strength >= cv2.dilate(strength, np.ones((size, size), np.uint8)))
    place = np.argwhere(peak)
    order = np.argsort(-strength[peak], kind="stable")
    place = _apart(place[order], size // 2)
    cell = max(np.sqrt((height - 2 * border) * (width - 2 * border) / count), 1.0)
    index = ((place - border) // cell).astype(np.intp)
    code = index[:, 0] * (width + 1) + index[:, 1]
    # how many stronger points its cell has
    by_cell = np.argsort(code, kind="stable")
    start = np.r_[True, np.diff(code[by_cell]) != 0] if len(code) else np.zeros(0, bool)
    rank = np.empty(len(code), np.intp)
    position = np.arange(len(code))
    rank[by_cell] = position - np.maximum.accumulate(np.where(start, position, 0))
    return np.asarray(place[np.argsort(rank, kind="stable")[:count]], np.float64)


def _strength(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    """Strength of pixels, 0 where it is not above noise or where pixels are missing."""
    grey = rows.astype(np.float64)
    missing = ~np.isfinite(grey)
    if missing.all():
        return np.zeros(grey.shape, np.float32)
    grey = np.where(missing, grey[~missing].mean(), grey) if missing.any() else grey
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING)
    by_row = 0.5 * cv2.filter2D(smooth, cv2.CV_64F, np.array([[-1.0], [0.0], [1.0]]))
    by_column = 0.5 * cv2.filter2D(smooth, cv2.CV_64F, np.array([[-1.0, 0.0, 1.0]]))
    a, b, c = (cv2.GaussianBlur(x, (0, 0), _WINDOW) for x in (by_row**2, by_row * by_column, by_column**2))
    least = 0.5 * (a + c) - np.hypot(0.5 * (a - c), b)
    checker = np.abs(grey[1:, 1:] - grey[1:, :-1] - grey[:-1, 1:] + grey[:-1, :-1])
    noise = np.zeros_like(least)
    noise[1:, 1:] = cv2.GaussianBlur(checker**2, (0, 0), 2.0 * _WINDOW) / 4.0
    # white noise of unit variance, smoothed: half of r(0) - r(2) of the Gaussian's correlation
    gain = (1.0 - np.exp(-1.0 / _SMOOTHING**2)) / (8.0 * np.pi * _SMOOTHING**2)
    least[least < _LEAST * gain * noise] = 0.0
    if missing.any():
        reach = 2 * _HALO + 1
        least[cv2.dilate(missing.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0] = 0.0
    return least.astype(np.float32)


def _apart(place: NDArray[np.intp], reach: int) -> NDArray[np.intp]:
    """Without the later of two that lie within reach: equal neighbours are both maxima."""
    keep = np.zeros(len(place), bool)
    # maxima are reach apart unless they are equal, so few share a cell of this size
    side = reach + 1
    kept: dict[tuple[int, int], list[int]] = {}
    for k, (row, column) in enumerate(place.tolist()):
        cell = (row // side, column // side)
        near = (j for r in (-1, 0, 1) for c in (-1, 0, 1) for j in kept.get((cell[0] + r, cell[1] + c), ()))
        if any(max(abs(row - place[j, 0]), abs(column - place[j, 1])) <= reach for j in near):
            continue
        keep[k] = True
        kept.setdefault(cell, []).append(k)
    return place[keep]
