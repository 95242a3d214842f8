"""Points that can be matched well, and their search by normalised cross-correlation.

Strength is the smaller eigenvalue of the structure tensor (Foerstner and Gülch, 1987; Shi and Tomasi, CVPR 1994) of
slightly smoothed grey values: the weight of the worse direction in least squares matching, per pixel.

The coefficient is that of grey values about their means, so that gain and offset do not matter. It is good to some
tenths of a pixel (parabola through the peak, with its known pull towards whole pixels); least squares matching refines.

Thresholds and model of a match, checks of what it is given, why a point was not matched, results put together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import IntEnum
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array

# A parabola and a 5 x 5 window within the margins need that much.
_LEAST_TEMPLATE = 11


def checked_image(image: ArrayLike, what: str) -> NDArray[np.generic]:
    """The image as an array (rows, columns) of real numbers; not copied.

    Raises
    ------
    ValueError
        Not a plane of real grey values, or empty.
    """
    array = np.asarray(image)
    if array.ndim != 2 or array.dtype.kind not in "uif" or array.size == 0:
        raise ValueError(
            f"{what}: the image must be a plane of real grey values (rows, columns), found {array.dtype} "
            f"{array.shape}; give one band, without colour"
        )
    return array


def checked_places(places: ArrayLike, count: int | None, what: str) -> Array:
    """Places (n, 2) row and column as float64; they may be NaN.

    Parameters
    ----------
    places : ArrayLike
        (n, 2), px.
    count : int | None
        n that is asked for, None for any.
    what : str
        What they are, for the message.

    Raises
    ------
    ValueError
        Another shape, or another number than count.
    """
    array = np.asarray(places, np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or (count is not None and len(array) != count):
        wanted = "(n, 2)" if count is None else f"({count}, 2)"
        raise ValueError(f"{what}: need {wanted} places (row, column), found {array.shape}; give one row a point")
    return array


def checked_templates(templates: ArrayLike, what: str) -> Array:
    """Templates (n, k, k) as float64.

    Raises
    ------
    ValueError
        Not square, k even or below 11.
    """
    array = np.asarray(templates, np.float64)
    if (
        array.ndim != 3
        or array.shape[1] != array.shape[2]
        or array.shape[1] % 2 == 0
        or array.shape[1] < _LEAST_TEMPLATE
    ):
        raise ValueError(
            f"{what}: need templates (n, k, k) with k odd and {_LEAST_TEMPLATE} or more, so that they have a middle "
            f"pixel; found {array.shape}"
        )
    return array


class Reason(IntEnum):
    """Code of a verdict; `text` says it in words."""

    ACCEPTED = 0
    TEMPLATE = 1
    OUTSIDE = 2
    IMAGE = 3
    SATURATED = 4
    FLAT = 5
    BORDER = 6
    WEAK = 7
    AMBIGUOUS = 8
    DIVERGED = 9
    MOVED = 10
    DISTORTED = 11
    UNCERTAIN = 12
    RELIEF = 13
    UNTESTED = 14
    BLOCKS = 15

    @property
    def text(self) -> str:
        """Reason in words."""
        return _TEXTS[self]


_TEXTS = {
    Reason.ACCEPTED: "accepted",
    Reason.TEMPLATE: "the template or its predicted place is not finite",
    Reason.OUTSIDE: "the template does not fit into the image at its predicted place",
    Reason.IMAGE: "pixels of the image under the template are not finite",
    Reason.SATURATED: "pixels of the image under the template are saturated",
    Reason.FLAT: "too little texture",
    Reason.BORDER: "the best correlation lies on the border of the search window",
    Reason.WEAK: "the correlation is too low",
    Reason.AMBIGUOUS: "another place correlates nearly as well",
    Reason.DIVERGED: "least squares matching did not converge",
    Reason.MOVED: "least squares matching left the correlation's peak",
    Reason.DISTORTED: "the affine change is too large",
    Reason.UNCERTAIN: "the standard deviation is too large",
    Reason.RELIEF: "parts of the window are displaced against each other",
    Reason.UNTESTED: "windows have steps of displacement here, and this one is too weak to show one",
    Reason.BLOCKS: "compression left little but its blocks, which do not move with the scene",
}


Part = TypeVar("Part")


def joined(parts: Sequence[Part]) -> Part:
    """One after the other: dataclasses of arrays (n, ...) and of such dataclasses; at least one."""
    columns: dict[str, Any] = {}
    for field in fields(parts[0]):  # type: ignore[arg-type]
        column = [getattr(part, field.name) for part in parts]
        columns[field.name] = joined(column) if is_dataclass(column[0]) else np.concatenate(column)
    return type(parts[0])(**columns)


@dataclass(frozen=True)
class MatchOptions:
    """What least squares matching solves for, and what is accepted.

    Attributes
    ----------
    sharpness : bool
        Solve for a difference in sharpness along rows and columns (second derivatives of the template). They also fit
        what the smoothing of a noisy template leaves; without it the place of image against image is drawn towards
        whole pixels.
    margin : int
        Rows and columns at each side of a template that only feed its interpolation, px; also bounds how far the fit
        may go before the template's rim enters it.
    iterations : int
        Most Gauss-Newton steps.
    least_correlation : float
        Of the fitted, smoothed template and the image; below it WEAK. A guard against the unrelated only: white noise
        of r times the texture's standard deviation in the image alone brings it down to 1 / sqrt(1 + r^2), and
        largest_sigma judges what that leaves.
    largest_ratio : float
        Of the second best to the best peak of the search; above it AMBIGUOUS.
    largest_move : float
        Of the fit from the search's peak along an axis, px.
    largest_distortion : float
        Of any element of the affine matrix from the unit matrix.
    largest_sigma : float
        Of the place along its worst direction, px; above it UNCERTAIN, or RELIEF where only displacements within the
        window bring it there.
    largest_risk : float
        Chance of a step of displacement within a window that passes the test for one; above it UNTESTED. The share of
        windows that fail the test and its power give it (`analysis.matching.window_checks`).
    least_contrast : float
        Standard deviation of the image under the template over that of one pixel's noise; a point that fails otherwise
        is called FLAT below it.
    saturation : float | None
        DN from which a pixel counts as saturated; None: the largest value of an integer type.

    Examples
    --------
    Place, affine matrix, offset and gain are eight unknowns; two more describe a difference in sharpness:

    >>> import analysis
    >>> analysis.MatchOptions(largest_sigma=0.1).parameters, analysis.MatchOptions(sharpness=False).parameters
    (10, 8)
    """

    sharpness: bool = True
    margin: int = 3
    iterations: int = 20
    least_correlation: float = 0.3
    largest_ratio: float = 0.9
    largest_move: float = 1.5
    largest_distortion: float = 0.2
    largest_sigma: float = 0.2
    largest_risk: float = 0.01
    least_contrast: float = 2.0
    saturation: float | None = None

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises
        ------
        ValueError
            a value that is not positive and finite, correlation, ratio or risk above 1, a margin below 2 px or too
            small for the largest move.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("sharpness", "saturation") and not (value > 0 and math.isfinite(value)):
                raise ValueError(f"match options: {field.name} must be positive and finite, found {value}")
        for name in ("least_correlation", "largest_ratio", "largest_risk"):
            if getattr(self, name) > 1.0:
                raise ValueError(f"match options: {name} must not exceed 1, found {getattr(self, name)}")
        if self.margin < 2 or self.largest_move > self.margin - 0.5:
            raise ValueError(
                f"match options: a margin of {self.margin} px does not hold the fit's way of {self.largest_move:g} px: "
                "take at least 2 px and half a pixel more than the way"
            )

    @property
    def parameters(self) -> int:
        """Unknowns of a fit: place, affine matrix, offset, gain, sharpness."""
        return 8 + 2 * self.sharpness


_SMOOTHING = 1.0
# Standard deviation of the Gaussian window of the tensor, px: half of a window of matching.
_WINDOW = 3.0
# Rows that are worked on together, and what a pixel's strength needs about it.
_STRIP, _HALO = 512, 18
# Strength over that of the noise alone.
_LEAST = 2.0


def distinct_points(image: ArrayLike, count: int, *, spacing: float, border: int) -> Array:
    """Well-defined points, spread evenly: the strongest of each cell of a grid first, then the second strongest ...

    Parameters
    ----------
    image : ArrayLike
        (H, W), any real type; around pixels that are not finite there are no points.
    count : int
        Most points.
    spacing : float
        Least distance of two points along rows or columns, px.
    border : int
        Rows and columns at each side without points; at least half of a template and the reach.

    Returns
    -------
    Array
        (n, 2) rows and columns, whole pixels, n <= count; fewer where the image has no more. The same image gives the
        same points.

    Raises
    ------
    ValueError
        Image not a plane, count or spacing below 1, border negative or so large that nothing is left.

    Examples
    --------
    Nine points of a random texture, at least 30 px apart and 25 px from the border:

    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> import analysis
    >>> rng = np.random.default_rng(4)
    >>> image = 1000 + 800 * gaussian_filter(rng.standard_normal((200, 200)), 2.0)
    >>> points = analysis.distinct_points(image, 9, spacing=30, border=25)
    >>> points.shape, bool(points.min() >= 25), bool(points.max() <= 174)
    ((9, 2), True, True)
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
    """The places without the later of two that lie within reach, since equal neighbours are both maxima."""
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


LARGEST_REACH = 200
# Half-width of the main lobe, px: other peaks count from there.
_LOBE = 3
# Standard deviation below which a patch is even, relative to its largest grey value: float32 sees no more.
_EVEN = 1e-6


@dataclass(frozen=True, eq=False)
class Peaks:
    """Best places.

    Attributes
    ----------
    place : Array
        (n, 2) row and column of the templates' middles; NaN where nothing was searched.
    value : Array
        (n,) coefficient of the best peak, -1 to 1; NaN likewise.
    ratio : Array
        (n,) second best local maximum, more than three pixels from the best, over the best; 0 without one, 1 if the
        best is not positive.
    reason : NDArray[np.int8]
        (n,) codes of `Reason`: ACCEPTED, TEMPLATE, OUTSIDE, IMAGE, FLAT or BORDER. BORDER also where the image's edge
        cuts the window.
    """

    place: Array
    value: Array
    ratio: Array
    reason: NDArray[np.int8]


def search(image: ArrayLike, templates: ArrayLike, predicted: ArrayLike, reach: int) -> Peaks:
    """Best place of each template within reach of its predicted place.

    Parameters
    ----------
    image : ArrayLike
        (H, W), any real type.
    templates : ArrayLike
        (n, k, k), k odd, in the image's geometry.
    predicted : ArrayLike
        (n, 2) row and column at which their middles are expected; searched from the nearest pixel.
    reach : int
        Rows and columns to each side, px.

    Raises
    ------
    ValueError
        Wrong shapes, reach not 1 to 200 px.
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
    """Vertex of the parabola through three values about the largest, px from the middle one."""
    bend = three[0] - 2.0 * three[1] + three[2]
    return float(0.5 * (three[0] - three[2]) / bend) if bend < 0 else 0.0
