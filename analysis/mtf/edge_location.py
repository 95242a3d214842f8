"""Location of a straight edge in a region of an image: direction, sub-pixel position and angle.

This is the first half of the slanted-edge method (ISO 12233): rows across the edge, the centroid of each row's
derivative in a window, a robust straight line through the centroids. Coordinates: (row, column), the centre of the
region's first pixel is (0, 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array, MeasurementError
from analysis.statistics import robust_sigma

Axis = Literal["x", "y"]
# Smallest region: along the edge, and across it.
LEAST_ALONG, LEAST_ACROSS = 20, 32
# Least distance of the line from the region's sides, px: tails and plateaus must be visible.
LEAST_MARGIN = 10.0
# Contrast over the noise of one pixel below which centroids of single rows mean nothing.
LEAST_CONTRAST = 5.0
# |t| of the plane's slope below which there is no edge; the false-alarm rate is about 1 in 1e8 regions.
_LEAST_SLOPE_T = 6.0
LARGEST_GREY = 1e50
"""Largest grey value. Above it, and for differences below its inverse, fourth powers approach the limits of double
precision.
"""
# Fraction of pixels with the same extreme value above which they are a clipped plateau.
_CLIPPED_SHARE = 0.05
# Angle above which the edge is neither near-vertical nor near-horizontal.
LARGEST_GREY_ANGLE = math.radians(40.0)
_HALF_WINDOWS = (8.0, 6.0, 6.0)
_NOT_FOLLOWED = (
    "the edge cannot be followed through the region: in many lines there is no rise where the others have it (two "
    "edges, a corner, or an edge that leaves the region); choose a region with one straight edge"
)


class EdgeError(MeasurementError, ValueError):
    """Error raised for a region without one measurable edge; the message says what is wrong and what to change."""


@dataclass(frozen=True)
class EdgeLine:
    """Straight edge, near-vertical (axis "x") or near-horizontal (axis "y").

    Attributes
    ----------
    axis : {"x", "y"}
        Axis along which the MTF is measured: "x" is across a near-vertical edge, along a row; "y" is across a
        near-horizontal edge, along a column.
    angle : float
        Angle of the edge to the pixel grid, rad: column = position + tan(angle) (row - middle row) for axis "x", and
        row = position + tan(angle) (column - middle column) for axis "y".
    position : float
        Column (row) of the edge in the middle of the region, px.
    sign : int
        +1 if grey values rise with column (row), -1 if they fall.
    """

    axis: Axis
    angle: float
    position: float
    sign: int


def checked_region(region: ArrayLike, saturation: float | None) -> Array:
    """Return the region as float64 (H, W) after all checks that do not need the edge to be found.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    region : array_like
        Grey values, (H, W).
    saturation : float or None
        Grey value from which the detector is saturated; without it a plateau of equal extreme values counts as clipped.
        Infinity switches the check off (noise-free computed images).

    Raises
    ------
    EdgeError
        The region is not a plane of real finite numbers, is too small, or is saturated.
    """
    allowed = f"{LEAST_ACROSS} px across the edge and {LEAST_ALONG} px along it, better 64 x 64"
    return grey_plane(region, (LEAST_ALONG, LEAST_ACROSS), allowed, saturation, EdgeError)


def grey_plane(
    region: ArrayLike, least: tuple[int, int], allowed: str, saturation: float | None, error: type[ValueError]
) -> Array:
    """Return a region as float64 (H, W); raise ``error`` if it cannot be measured.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    region : array_like
        Grey values, (H, W).
    least : (int, int)
        Smallest shorter and smallest longer side, px.
    allowed : str
        Description of the smallest region.
    saturation : float or None
        As for `checked_region`.
    error : type
        Class of the errors.
    """
    array = np.asarray(region)
    if array.ndim != 2 or array.dtype.kind not in "uif":
        raise error(f"the region must be a plane of real grey values (H, W), found {array.dtype} {array.shape}")
    if min(array.shape) < least[0] or max(array.shape) < least[1]:
        raise error(f"the region of {array.shape[0]} x {array.shape[1]} px is too small: take at least {allowed}")
    grey = np.ascontiguousarray(array, dtype=np.float64)
    fault = grey_fault(grey, saturation)
    if fault:
        raise error(fault)
    return grey


def grey_fault(grey: Array, saturation: float | None) -> str:
    """Return the fault of grey values (H, W) that no fit can use; an empty text if there is none.

    Faults are values that are not finite, too large or too small to compute with, all equal, saturated, or accumulated
    at their extremes.

    Dimensions: H rows, W columns.
    """
    advice = "lower the exposure or the light"
    bad = int(np.count_nonzero(~np.isfinite(grey)))
    if bad:
        return f"{bad} pixels of the region are not finite (NaN or infinity): repair them or move the region"
    if saturation is not None and np.any(grey >= saturation):
        count = int(np.count_nonzero(grey >= saturation))
        return f"{count} pixels reach the saturation level of {saturation:g}: {advice}"
    low, high = float(grey.min()), float(grey.max())
    if low == high:
        return "no structure in the region: all pixels have the same value; move the region onto the target"
    if max(abs(low), abs(high)) > LARGEST_GREY or high - low < 1.0 / LARGEST_GREY:
        return f"grey values from {low:g} to {high:g} cannot be computed with: scale the image, say to 0 ... 1"
    if saturation is not None:
        return ""
    for side, values in (("highest", grey), ("lowest", -grey)):
        extreme = values.max()
        count = int(np.count_nonzero(values == extreme))
        if count < _CLIPPED_SHARE * grey.size:
            continue
        others = values[values < extreme]
        # noise makes a maximum rarer than its neighbour; clipping makes it more frequent
        if count > 2 * np.count_nonzero(values == others.max()):
            return (
                f"{count} pixels share the {side} value {abs(extreme):g}: the "
                + ("bright side is saturated" if side == "highest" else "dark side is cut off at the black level")
                + f"; {advice if side == 'highest' else 'raise the offset'}. If the image is computed without noise, "
                "give a saturation level above it"
            )
    return ""


def pixel_noise(residual: Array) -> float:
    """Return a robust estimate of the rms noise of one pixel from residuals (H, W).

    It uses the checkerboard differences (a - b - c + d) / 2 of the pixels a, b, c, d in each 2 x 2 square. Straight
    edges of small tilt and slow shading cancel in that difference. The residual has the shape (H, W).

    Dimensions: H rows, W columns.
    """
    checker = residual[1:, 1:] - residual[1:, :-1] - residual[:-1, 1:] + residual[:-1, :-1]
    return 0.5 * robust_sigma(checker)


def locate_edge(grey: Array) -> EdgeLine:
    """Return a first line through the one edge in grey values (H, W) as from `checked_region`.

    The line is good to some hundredths of a pixel; `analysis.mtf.slanted_edge` refines it on all pixels together.

    Dimensions: H rows, W columns.

    Raises
    ------
    EdgeError
        There is no edge, more than one, or one that is too weak, near 45 degrees, or not inside the region.
    """
    axis, sign = _direction(grey)
    across = grey if axis == "x" else grey.T
    _check_shape(across.shape, axis)
    rising = across if sign > 0 else across[:, ::-1]
    rows, columns = rising.shape
    offset, slope = _coarse_line(rising)
    offset, slope = _refined(rising, offset, slope)
    angle = math.atan(slope)
    if abs(angle) > LARGEST_GREY_ANGLE:
        raise EdgeError(
            f"the edge runs at {math.degrees(abs(angle)):.0f} deg, near 45 deg, where it is neither vertical nor "
            "horizontal: tilt the target by 2 to 10 deg against rows or columns"
        )
    # the offset belongs to the middle row; the margin is that of the first or the last row
    half_width = abs(slope) * (rows - 1) / 2.0
    margin = min(offset - half_width, columns - 1 - offset - half_width)
    if margin < LEAST_MARGIN:
        where = "leaves the region" if margin < 0 else f"comes within {margin:.1f} px of the region's side"
        raise EdgeError(
            f"the edge {where}: at least {LEAST_MARGIN:g} px must be left on both sides of it in every line; centre "
            "the region on the edge, or make it wider or shorter"
        )
    if sign < 0:
        offset, angle = columns - 1 - offset, -angle
    return EdgeLine(axis, angle, offset, sign)


def _check_shape(shape: tuple[int, ...], axis: Axis) -> None:
    along, across = shape
    if along < LEAST_ALONG or across < LEAST_ACROSS:
        kind = "near-vertical" if axis == "x" else "near-horizontal"
        raise EdgeError(
            f"the region has {across} px across the {kind} edge and {along} px along it: take at least {LEAST_ACROSS} "
            f"px across and {LEAST_ALONG} px along"
        )


def _direction(grey: Array) -> tuple[Axis, int]:
    """Return the axis across the edge and whether grey values rise along it (+1) or fall (-1).

    The axis is that of the steeper slope of a plane fitted to the grey values.
    """
    rows, columns = grey.shape
    row, column = np.arange(rows) - (rows - 1) / 2.0, np.arange(columns) - (columns - 1) / 2.0
    centred = grey - grey.mean()
    slope_y = float((row @ centred).sum() / (columns * (row @ row)))
    slope_x = float((centred @ column).sum() / (rows * (column @ column)))
    left = centred - slope_y * row[:, None] - slope_x * column
    rms = math.sqrt(float(np.mean(left * left)))
    steep_x, steep_y = slope_x * math.sqrt(rows * (column @ column)), slope_y * math.sqrt(columns * (row @ row))
    if max(abs(steep_x), abs(steep_y)) <= _LEAST_SLOPE_T * rms:
        noise = pixel_noise(grey)
        blocks = _blocks(grey)
        if float(np.ptp(blocks)) > 10.0 * noise / 4.0 + 1e-9 * float(np.abs(grey).max()):
            raise EdgeError(
                "no single edge in the region: there is structure, but one side is not brighter than the other (two "
                "edges of a bar?); choose a region with one edge between two even areas"
            )
        raise EdgeError("no edge in the region: it is even apart from noise; move the region onto the edge")
    # the slopes, not their significance: the region need not be square
    if abs(slope_x) * columns >= abs(slope_y) * rows:
        return "x", 1 if slope_x > 0 else -1
    return "y", 1 if slope_y > 0 else -1


def _blocks(grey: Array) -> Array:
    """Return the mean grey values of all complete blocks of 4 x 4 px of a region."""
    rows, columns = grey.shape[0] // 4, grey.shape[1] // 4
    whole = grey[: rows * 4, : columns * 4].reshape(rows, 4, columns, 4)
    return np.asarray(whole.mean(axis=(1, 3)))


def _coarse_line(rising: Array) -> tuple[float, float]:
    """Return the column of the edge in the middle row and its slope, from the steepest position of bands of rows."""
    rows, columns = rising.shape
    height = max(2, rows // 12)
    bands = rows // height
    band = rising[: bands * height].reshape(bands, height, columns).mean(axis=1)
    total = np.cumsum(np.pad(band, ((0, 0), (1, 0))), axis=1)
    box = 4
    mean = total[:, box:] - total[:, :-box]
    rise = mean[:, box:] - mean[:, :-box]
    column = rise.argmax(axis=1) + box - 0.5
    centre = np.arange(bands) * height + (height - 1) / 2.0 - (rows - 1) / 2.0
    first, second = np.triu_indices(bands, 1)
    slope = float(np.median((column[second] - column[first]) / (centre[second] - centre[first])))
    return float(np.median(column - slope * centre)), slope


def _refined(rising: Array, offset: float, slope: float) -> tuple[float, float]:
    """Return offset (px) and slope of the line through the centroids of the rows' derivatives near another line."""
    rows, columns = rising.shape
    row = np.arange(rows) - (rows - 1) / 2.0
    rise = rising[:, 1:] - rising[:, :-1]
    position = np.arange(columns - 1) + 0.5
    line = offset + slope * row
    _check_contrast(rising, line)
    for half in _HALF_WINDOWS:
        distance = position - line[:, None]
        window = np.cos(np.clip(distance, -half, half) * (np.pi / 2.0 / half)) ** 2
        weight = window * rise
        total = weight.sum(axis=1)
        strong = total > 0.2 * max(float(np.median(total)), 0.0)
        if np.count_nonzero(strong) < 0.7 * rows:
            raise EdgeError(_NOT_FOLLOWED)
        centroid = np.where(strong, (weight * distance).sum(axis=1) / np.where(strong, total, 1.0), 0.0)
        step = _huber_line(row[strong], centroid[strong])
        offset, slope = offset + step[0], slope + step[1]
        line = offset + slope * row
    return offset, slope


def _check_contrast(rising: Array, line: Array) -> None:
    side = np.arange(rising.shape[1]) - line[:, None]
    right, left = rising[side > 4.0], rising[side < -4.0]
    if min(right.size, left.size) < 20:
        raise EdgeError("the edge lies at the region's side or leaves it: centre the region on the edge")
    contrast, noise = float(np.median(right) - np.median(left)), pixel_noise(rising)
    if contrast < LEAST_CONTRAST * noise:
        if float(np.ptp(_blocks(rising))) > LEAST_CONTRAST * noise:
            raise EdgeError(_NOT_FOLLOWED)
        raise EdgeError(
            f"the contrast of {contrast:.3g} is only {max(contrast, 0.0) / noise:.1f} times the noise of a pixel of "
            f"{noise:.3g}; {LEAST_CONTRAST:g} times is needed: average more frames or give more light"
        )


def _huber_line(x: Array, y: Array) -> tuple[float, float]:
    """Return offset and slope of a straight line that is fitted robustly to points.

    Residuals beyond 1.5 robust sigmas have less weight (Huber).
    """
    weight = np.ones_like(x)
    for _ in range(3):
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        slope = float((weight * (x - mean_x)) @ (y - mean_y) / ((weight * (x - mean_x)) @ (x - mean_x)))
        offset = float(mean_y - slope * mean_x)
        residual = np.abs(y - offset - slope * x)
        limit = 1.5 * robust_sigma(residual) + 1e-9
        weight = np.minimum(1.0, limit / np.maximum(residual, limit))
    return offset, slope
