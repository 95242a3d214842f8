"""Selection of points that can be matched well, and their search by normalised cross-correlation.

**Point selection.** The strength of a point is the smaller eigenvalue of the structure tensor (Foerstner and Gülch,
1987; Shi and Tomasi, CVPR 1994) of slightly smoothed grey values: the weight of the worse direction in least squares
matching, per pixel.

**Search.** The correlation coefficient is that of grey values about their means, so that gain and offset do not matter.
The position is accurate to some tenths of a pixel (parabola through the peak, with its known bias towards whole
pixels); least squares matching refines it.

The module also holds what the package shares: the thresholds and the model of a match (`MatchOptions`), validation of
input, the reasons of a verdict (`Reason`), and concatenation of results.
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
from scipy import ndimage
from scipy.interpolate import BSpline, PPoly

from analysis.arrays import Array
from optics.numerics.arguments import check_fields

_LEAST_TEMPLATE = 11
"""Smallest side of a template, in pixels, for a parabola and a 5 x 5 window within the margins."""


def checked_image(image: ArrayLike, what: str) -> NDArray[np.generic]:
    """Return the image as a (rows, columns) array of real numbers, without copying.

    Raises
    ------
    ValueError
        The image is not a plane of real grey values, or is empty.
    """
    array = np.asarray(image)
    if array.ndim != 2 or array.dtype.kind not in "uif" or array.size == 0:
        raise ValueError(
            f"{what}: the image must be a plane of real grey values (rows, columns), found {array.dtype} "
            f"{array.shape}; give one band, without colour"
        )
    return array


def checked_positions(positions: ArrayLike, count: int | None, what: str) -> Array:
    """Return positions (n, 2), row and column, as float64; they may be NaN.

    Parameters
    ----------
    positions : (n, 2) array_like
        Positions, in pixels.
    count : int or None
        Required number n of positions; None for any number.
    what : str
        Name of the positions, for the message.

    Raises
    ------
    ValueError
        The shape is wrong, or the number differs from count.
    """
    array = np.asarray(positions, np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or (count is not None and len(array) != count):
        required = "(n, 2)" if count is None else f"({count}, 2)"
        raise ValueError(
            f"{what}: need {required} positions (row, column), found {array.shape}; give one row per point"
        )
    return array


def checked_templates(templates: ArrayLike, what: str) -> Array:
    """Return n templates of k x k pixels, (n, k, k), as float64.

    Raises
    ------
    ValueError
        The templates are not square, or k is even or below 11.
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
    """Code of the verdict on a match: accepted, or the reason for its rejection; `text` describes it."""

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
        """Description of the verdict in a few words."""
        return _TEXTS[self]


_TEXTS = {
    Reason.ACCEPTED: "accepted",
    Reason.TEMPLATE: "the template or its predicted position is not finite",
    Reason.OUTSIDE: "the template does not fit into the image at its predicted position",
    Reason.IMAGE: "pixels of the image under the template are not finite",
    Reason.SATURATED: "pixels of the image under the template are saturated",
    Reason.FLAT: "too little texture",
    Reason.BORDER: "the best correlation lies on the border of the search window",
    Reason.WEAK: "the correlation is too low",
    Reason.AMBIGUOUS: "another position correlates nearly as well",
    Reason.DIVERGED: "least squares matching did not converge",
    Reason.MOVED: "least squares matching left the correlation's peak",
    Reason.DISTORTED: "the affine change is too large",
    Reason.UNCERTAIN: "the standard deviation is too large",
    Reason.RELIEF: "parts of the window are displaced against each other",
    Reason.UNTESTED: "some windows have steps of displacement, and this one has too little texture to test for one",
    Reason.BLOCKS: "the position is that of the compression blocks, which do not move with the scene",
}


Part = TypeVar("Part")


def concatenated(parts: Sequence[Part]) -> Part:
    """Concatenate the results of several groups of points: dataclasses whose arrays have the points as first axis.

    Dataclasses may contain such dataclasses; there must be at least one.
    """
    columns: dict[str, Any] = {}
    for field in fields(parts[0]):  # type: ignore[arg-type]
        column = [getattr(part, field.name) for part in parts]
        columns[field.name] = concatenated(column) if is_dataclass(column[0]) else np.concatenate(column)
    return type(parts[0])(**columns)


@dataclass(frozen=True)
class MatchOptions:
    """Model of least squares matching and acceptance thresholds.

    Attributes
    ----------
    sharpness : bool
        True to estimate a difference in sharpness along rows and columns (second derivatives of the template). These
        terms also fit what the smoothing of a noisy template leaves; without them, positions of image against image are
        biased towards whole pixels.
    margin : int
        Rows and columns at each side of a template that serve only its interpolation, in pixels; also limits how far
        the fit may move before the template's rim enters it.
    iterations : int
        Largest number of Gauss-Newton steps.
    least_correlation : float
        Smallest correlation of the image with the fitted, smoothed template; below it the verdict is WEAK. It guards
        only against unrelated windows: white noise of r times the texture's standard deviation in the image alone
        lowers the correlation to 1 / sqrt(1 + r^2), and largest_sigma judges the rest.
    largest_ratio : float
        Largest ratio of the second best to the best peak of the search; above it the verdict is AMBIGUOUS.
    largest_move : float
        Largest shift of the fit from the search's peak along an axis, in pixels.
    largest_distortion : float
        Largest difference of any element of the affine matrix from the unit matrix.
    largest_sigma : float
        Largest standard deviation of the position along its worst direction, in pixels; above it the verdict is
        UNCERTAIN, or RELIEF if only displacements within the window raise it above.
    largest_risk : float
        Largest probability of a step of displacement within a window that passes the test for steps; above it the
        verdict is UNTESTED. It follows from the share of windows that fail the test and from the test's power
        (`analysis.matching.window_checks`).
    least_contrast : float
        Smallest ratio of the standard deviation of the image under the template to the noise of one pixel; a point that
        is rejected and lies below it has the verdict FLAT.
    saturation : float or None
        Grey value in DN from which a pixel counts as saturated; None for the largest value of an integer type.

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
        """Raise ValueError if an option is out of range.

        Raises
        ------
        ValueError
            A value is not positive and finite, a correlation, ratio or risk exceeds 1, or the margin is below 2 px or
            too small for the largest move.
        """
        check_fields(self)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("sharpness", "saturation") and not (value > 0 and math.isfinite(value)):
                raise ValueError(f"match options: {field.name} must be positive and finite, found {value}")
        for name in ("least_correlation", "largest_ratio", "largest_risk"):
            if getattr(self, name) > 1.0:
                raise ValueError(f"match options: {name} must not exceed 1, found {getattr(self, name)}")
        if self.margin < 2 or self.largest_move > self.margin - 0.5:
            raise ValueError(
                f"match options: a margin of {self.margin} px is too small for a move of {self.largest_move:g} px: "
                "take at least 2 px, and half a pixel more than the move"
            )

    @property
    def parameters(self) -> int:
        """Number of unknowns of a fit.

        They are 2 of the position, 4 of the affine matrix, offset, gain and, if a difference in sharpness is fitted, 2
        more.
        """
        return 8 + 2 * self.sharpness


_SMOOTHING = 1.0
"""Standard deviation of the Gaussian that smooths grey values before the structure tensor, in pixels."""
_WINDOW = 3.0
"""Standard deviation of the Gaussian window of the structure tensor, in pixels: half of a matching window."""
# Number of rows that are processed together, and the rim that the strength of a pixel depends on.
_STRIP, _HALO = 512, 18
_LEAST = 2.0
"""Smallest strength (smaller eigenvalue of the structure tensor) of a selected point, relative to that of noise alone.
"""


def distinct_points(image: ArrayLike, count: int, *, spacing: float, border: int) -> Array:
    """Return well-defined points of an image, spread evenly over it, the strongest of each cell of a grid first.

    Parameters
    ----------
    image : (H, W) array_like
        Image of H rows and W columns, of any real type. Close to pixels that are not finite there are no points.
    count : int
        Largest number of points.
    spacing : float
        Smallest distance of two points along rows or columns, in pixels.
    border : int
        Number of rows and columns at each side without points; at least half of a window and the search radius.

    Returns
    -------
    (n, 2) ndarray
        Rows and columns, whole pixels; n is at most `count`, fewer if the image has no more. The same image gives the
        same points.

    Raises
    ------
    ValueError
        An image that is not a plane, a count or spacing below 1, or a border that is negative or leaves nothing.

    Notes
    -----
    The strength is the smaller eigenvalue of the structure tensor: Shi and Tomasi, Proc. CVPR, 593 (1994).

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
        raise ValueError(
            f"distinct points: a border of {border} px leaves nothing of the image {plane.shape}; reduce it"
        )
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
    points = np.argwhere(peak)
    order = np.argsort(-strength[peak], kind="stable")
    points = _apart(points[order], size // 2)
    cell = max(np.sqrt((height - 2 * border) * (width - 2 * border) / count), 1.0)
    index = ((points - border) // cell).astype(np.intp)
    code = index[:, 0] * (width + 1) + index[:, 1]
    # number of stronger points in the same cell
    by_cell = np.argsort(code, kind="stable")
    start = np.r_[True, np.diff(code[by_cell]) != 0] if len(code) else np.zeros(0, bool)
    rank = np.empty(len(code), np.intp)
    position = np.arange(len(code))
    rank[by_cell] = position - np.maximum.accumulate(np.where(start, position, 0))
    return np.asarray(points[np.argsort(rank, kind="stable")[:count]], np.float64)


def _strength(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return the smaller eigenvalue of the structure tensor at each pixel, 0 where noise explains it.

    It is 0 near missing pixels, too.
    """
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
        size = 2 * _HALO + 1
        least[cv2.dilate(missing.astype(np.uint8), np.ones((size, size), np.uint8)) > 0] = 0.0
    return least.astype(np.float32)


def _apart(points: NDArray[np.intp], distance: int) -> NDArray[np.intp]:
    """Return the points without those closer than `distance` pixels, along rows and columns, to an earlier one."""
    keep = np.zeros(len(points), bool)
    # maxima are at least `distance` apart unless they are equal, so few share a cell of this size
    side = distance + 1
    cells: dict[tuple[int, int], list[int]] = {}
    for k, (row, column) in enumerate(points.tolist()):
        cell = (row // side, column // side)
        neighbours = (j for r in (-1, 0, 1) for c in (-1, 0, 1) for j in cells.get((cell[0] + r, cell[1] + c), ()))
        if any(max(abs(row - points[j, 0]), abs(column - points[j, 1])) <= distance for j in neighbours):
            continue
        keep[k] = True
        cells.setdefault(cell, []).append(k)
    return points[keep]


LARGEST_RADIUS = 200
"""Largest half width of a search window, in pixels."""
_LOBE = 3
"""Half width of the main lobe of the correlation around its best peak, in pixels; peaks beyond it are separate
candidates.
"""
_EVEN = 1e-6
"""Relative standard deviation below which a patch counts as uniform, the resolution of float32."""


@dataclass(frozen=True, eq=False)
class Peaks:
    """Best positions of n templates in an image, found by normalised cross-correlation.

    Attributes
    ----------
    position : (n, 2) ndarray
        Row and column of the templates' middles; NaN where nothing was searched.
    value : (n,) ndarray
        Correlation coefficient of the best peak, -1 to 1; NaN where nothing was searched.
    ratio : (n,) ndarray
        Ratio of the second best local maximum, more than three pixels from the best, to the best; 0 if there is none, 1
        if the best is not positive.
    reason : (n,) ndarray of int8
        Codes of `Reason`: ACCEPTED, TEMPLATE, OUTSIDE, IMAGE, FLAT or BORDER. BORDER also where the image's edge cuts
        the window.
    """

    position: Array
    value: Array
    ratio: Array
    reason: NDArray[np.int8]


def search(image: ArrayLike, templates: ArrayLike, predicted: ArrayLike, radius: int) -> Peaks:
    """Return the best position of each template within the radius around its predicted position.

    Parameters
    ----------
    image : (H, W) array_like
        Image of H rows and W columns, of any real type.
    templates : (n, k, k) array_like
        Templates of k x k pixels, n of them, in the image's geometry; k odd.
    predicted : (n, 2) array_like
        Expected row and column of their middles; the search starts from the nearest pixel.
    radius : int
        Half width of the search window along rows and columns, in pixels.

    Raises
    ------
    ValueError
        A shape is wrong, or radius is not 1 to 200 px.
    """
    plane = checked_image(image, "search")
    windows = checked_templates(templates, "search")
    expected = checked_positions(predicted, len(windows), "search")
    if not 1 <= radius <= LARGEST_RADIUS:
        raise ValueError(f"search: the radius must be 1 to {LARGEST_RADIUS} px, found {radius}; improve the prediction")
    count = len(windows)
    positions, value, ratio = np.full((count, 2), np.nan), np.full(count, np.nan), np.full(count, np.nan)
    reason = np.zeros(count, np.int8)
    for k in range(count):
        if not (np.isfinite(windows[k]).all() and np.isfinite(expected[k]).all()):
            reason[k] = Reason.TEMPLATE
            continue
        positions[k], value[k], ratio[k], reason[k] = _best(plane, windows[k], np.rint(expected[k]), int(radius))
    return Peaks(positions, value, ratio, reason)


def _best(
    image: NDArray[np.generic], template: Array, middle: Array, radius: int
) -> tuple[Array, float, float, Reason]:
    """Return position, coefficient and peak ratio of the best match of one template, and the verdict."""
    no_position = np.full(2, np.nan)
    half = template.shape[0] // 2
    last = np.array(image.shape) - 1 - half
    low, high = np.maximum(middle - radius, half), np.minimum(middle + radius, last)
    if np.any(low > high) or np.any(middle < half) or np.any(middle > last):
        return no_position, np.nan, np.nan, Reason.OUTSIDE
    (top, left), (bottom, right) = (low - half).astype(int), (high + half + 1).astype(int)
    window = image[top:bottom, left:right].astype(np.float64)
    if not np.isfinite(window).all():
        return no_position, np.nan, np.nan, Reason.IMAGE
    # about the mean, because sums of squares are taken in float32
    window, level = window - window.mean(), template - template.mean()
    if template.std() <= _EVEN * np.abs(template).max() or window.std() <= _EVEN * np.abs(window).max():
        return no_position, np.nan, np.nan, Reason.FLAT
    scores = (window / window.std()).astype(np.float32), (level / level.std()).astype(np.float32)
    correlation = cv2.matchTemplate(*scores, cv2.TM_CCOEFF_NORMED)
    # in a uniform window 0 / 0 gives arbitrary values
    correlation = np.where(np.abs(correlation) <= 1.0 + 1e-3, correlation, 0.0)
    row, column = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
    best = float(correlation[row, column])
    ratio = _second(correlation, int(row), int(column)) / best if best > 0 else 1.0
    position = low + np.array([row, column])
    if not (0 < row < correlation.shape[0] - 1 and 0 < column < correlation.shape[1] - 1):
        return position, best, ratio, Reason.BORDER
    lines = correlation[row - 1 : row + 2, column], correlation[row, column - 1 : column + 2]
    position = position + np.array([_vertex(line.astype(np.float64)) for line in lines])
    return position, best, ratio, Reason.ACCEPTED


def _second(correlation: NDArray[np.float32], row: int, column: int) -> float:
    """Return the highest local maximum (of 5 x 5) outside the main lobe; the slope of a wide lobe is not a maximum."""
    peak = correlation >= cv2.dilate(correlation, np.ones((5, 5), np.uint8))
    peak[max(row - _LOBE, 0) : row + _LOBE + 1, max(column - _LOBE, 0) : column + _LOBE + 1] = False
    return max(float(correlation[peak].max(initial=0.0)), 0.0)


def _vertex(values: Array) -> float:
    """Return the vertex of the parabola through three neighbouring values, in pixels from the middle one."""
    curvature = values[0] - 2.0 * values[1] + values[2]
    return float(0.5 * (values[0] - values[2]) / curvature) if curvature < 0 else 0.0


_DEGREE = 5
"""Degree of the splines."""
_SPLINE_HALO = 22
"""Width of the border around a patch that its spline uses, in pixels: the prefilter's response decays by a factor of
0.43 per pixel, so what is omitted is 1e-8.
"""
_SUPPORT = 3
"""Number of knots at each side that a spline value depends on directly."""
_RIM = 10
"""Width of a rim about a template that continues its slope, in pixels: a plain mirror has a kink that the prefilter
spreads inwards.
"""


def resampled(image: ArrayLike, rows: ArrayLike, columns: ArrayLike, *, smoothing: float = 0.0) -> Array:
    """Return the grey values of an image at any positions by quintic splines.

    An image with finer pixels than the grid must be low-passed first to avoid aliasing: a smoothing of about 0.3 to 0.5
    times the ratio of the pixel sizes corresponds to pixel and optics of the coarser one.

    Parameters
    ----------
    image : (H, W) array_like
        Image of H rows and W columns, of any real type; NaN marks missing pixels.
    rows : (..., k, l) array_like
        Rows of the samples. Each array of k rows and l columns is one patch and is cut out with a halo, so that only
        the patches and not the image are filtered.
    columns : (..., k, l) array_like
        Columns of the samples.
    smoothing : float
        Standard deviation of a Gaussian low-pass in pixels of the image; 0 for none.

    Returns
    -------
    (..., k, l) ndarray of float64
        Grey values; NaN outside the image and next to missing pixels.

    Raises
    ------
    ValueError
        The image is not a plane, rows and columns have different shapes or no patches, or smoothing is negative.
    """
    plane = checked_image(image, "resampling")
    row, column = np.asarray(rows, np.float64), np.asarray(columns, np.float64)
    if row.shape != column.shape or row.ndim < 2:
        raise ValueError(
            f"resampling: rows {row.shape} and columns {column.shape} must be grids of one shape (..., k, l)"
        )
    if not (smoothing >= 0 and np.isfinite(smoothing)):
        raise ValueError(f"resampling: smoothing must be 0 or a positive number of pixels, found {smoothing}")
    patches = (-1, *row.shape[-2:])
    out = np.full(row.reshape(patches).shape, np.nan)
    for sample, r, c in zip(out, row.reshape(patches), column.reshape(patches), strict=True):
        _fill(sample, plane, r, c, smoothing)
    return out.reshape(row.shape)


def _fill(sample: Array, image: NDArray[np.generic], row: Array, column: Array, smoothing: float) -> None:
    """Fill an array with the grey values of an image at given rows and columns, all of one patch."""
    height, width = image.shape
    # NaN compares false
    inside = (row >= 0) & (row <= height - 1) & (column >= 0) & (column <= width - 1)
    if not inside.any():
        return
    halo = _SPLINE_HALO + int(np.ceil(5.0 * smoothing))
    top, left = (max(int(x[inside].min()) - halo, 0) for x in (row, column))
    bottom, right = (int(x[inside].max()) + halo + 2 for x in (row, column))
    crop = np.asarray(image[top:bottom, left:right], np.float64)
    positions = np.stack([row[inside] - top, column[inside] - left])
    missing = ~np.isfinite(crop)
    if missing.all():
        return
    if missing.any():
        crop = np.where(missing, crop[~missing].mean(), crop)
    if smoothing:
        crop = ndimage.gaussian_filter(crop, smoothing, mode="mirror", truncate=5.0)
    value = ndimage.map_coordinates(crop, positions, order=_DEGREE, mode="mirror")
    if missing.any():
        radius = _SUPPORT + int(np.ceil(3.0 * smoothing))
        near = ndimage.binary_dilation(missing, np.ones((2 * radius + 1, 2 * radius + 1)))
        value[near[tuple(np.rint(positions).astype(np.intp))]] = np.nan
    sample[inside] = value


def low_passed(templates: Array, smoothing: float) -> Array:
    """Return n templates (n, k, k) after a Gaussian low-pass of RMS radius `smoothing`, in pixels.

    The templates are continued beyond their edges with the slope that they have there.
    """
    if not smoothing:
        return templates
    margin = int(np.ceil(4.0 * smoothing))
    wide = np.pad(templates, ((0, 0), (margin, margin), (margin, margin)), mode="reflect", reflect_type="odd")
    wide = ndimage.gaussian_filter(wide, (0.0, smoothing, smoothing), truncate=4.0)
    return np.asarray(wide[:, margin:-margin, margin:-margin])


class SplineStack:
    """Quintic splines through n templates of k x k finite values, evaluated at separate positions in each."""

    def __init__(self, templates: Array) -> None:
        count, self.size = templates.shape[0], templates.shape[1]
        knots = np.pad(templates, ((0, 0), (_RIM, _RIM), (_RIM, _RIM)), mode="reflect", reflect_type="odd")
        for axis in (1, 2):
            knots = ndimage.spline_filter1d(knots, _DEGREE, axis=axis, mode="mirror")
        self._knots = np.ascontiguousarray(knots)
        self._stride = self.size + 2 * _RIM
        self._first = np.arange(count) * self._stride**2

    def __call__(self, row: Array, column: Array, which: NDArray[np.intp], *, order: int) -> Array:
        """Return values and derivatives at positions in the templates.

        Parameters
        ----------
        row : (m, p) ndarray
            Rows of p positions in each of m groups, in pixels of the template; clipped to it.
        column : (m, p) ndarray
            Columns in pixels of the template; clipped to it.
        which : (m,) ndarray of int
            Index of the template of each group of positions.
        order : int
            Highest derivative, 1 to 4.

        Returns
        -------
        (3, 6, 10 or 15, m, p) ndarray
            Value; first derivatives with respect to row and column; second derivatives (row row, row column, column
            column); third derivatives (row row row, row row column, row column column, column column column); and so
            on, per pixel to the power of the order.
        """
        weights, base = [], np.broadcast_to(self._first[which][:, None], row.shape)
        for position, step in ((row, self._stride), (column, 1)):
            position = np.clip(position, 0.0, self.size - 1.0)
            knot = np.minimum(np.floor(position), self.size - 2.0)
            base = base + (knot.astype(np.intp) + _RIM - _DEGREE // 2) * step
            weights.append(_weights(position - knot, order))
        down, across = weights
        kinds = [(total - k, k) for total in range(order + 1) for k in range(total + 1)]
        out = np.zeros((len(kinds), *row.shape))
        flat = self._knots.ravel()
        for a in range(_DEGREE + 1):
            line = np.zeros((order + 1, *row.shape))
            for b in range(_DEGREE + 1):
                line += across[:, b] * flat.take(base + (a * self._stride + b))
            for value, (by_row, by_column) in zip(out, kinds, strict=True):
                value += down[by_row, a] * line[by_column]
        return out


def _weights(fraction: Array, orders: int) -> Array:
    """Return the weights of the six knots around a position between pixels, and their derivatives.

    `fraction` is the part of the position beyond a whole pixel; the result is (orders + 1, 6, ...), for the knots from
    -2 to +3.
    """
    powers = np.ones((_DEGREE + 1, *fraction.shape))
    for k in range(_DEGREE):
        np.multiply(powers[k], fraction, out=powers[k + 1])
    pieces = _PIECES[: orders + 1]
    flat = pieces.reshape(-1, _DEGREE + 1) @ powers.reshape(_DEGREE + 1, -1)
    return np.asarray(flat.reshape(*pieces.shape[:2], *fraction.shape))


def _pieces() -> Array:
    """Return the polynomial coefficients of the quintic B-spline and its derivatives.

    The axes of the (5, 6, 6) array are the order of the derivative, the knot, and the power of the fraction of a pixel.
    """
    basis = PPoly.from_spline(BSpline.basis_element(np.arange(_DEGREE + 2.0), extrapolate=False))
    table = np.zeros((5, _DEGREE + 1, _DEGREE + 1))
    start = np.searchsorted(basis.x, np.arange(_DEGREE + 1.0), side="right") - 1
    for order in range(5):
        # highest power first; at position j + f, knot j + m uses the piece (degree + 1) / 2 - m
        rising = basis.derivative(order).c[::-1][:, start[::-1]] if order else basis.c[::-1][:, start[::-1]]
        table[order, :, : len(rising)] = rising.T
    return table


_PIECES = _pieces()
"""Polynomial coefficients of the quintic B-spline and its derivatives: order of derivative, knot, power."""
