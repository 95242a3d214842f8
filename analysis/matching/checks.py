"""Checks of what a match is given."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["checked_image", "checked_places", "checked_templates"]

Array = NDArray[np.float64]
# A parabola and a 5 x 5 window within the margins need that much.
_LEAST_TEMPLATE = 11


def checked_image(image: ArrayLike, what: str) -> NDArray[np.generic]:
    """The image as an array (rows, columns) of real numbers; not copied.

    Raises:
        ValueError: not a plane of real grey values, or empty.
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

    Raises:
        ValueError: another shape, or another number than count.
    """
    array = np.asarray(places, np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or (count is not None and len(array) != count):
        wanted = "(n, 2)" if count is None else f"({count}, 2)"
        raise ValueError(f"{what}: need {wanted} places (row, column), found {array.shape}; give one row a point")
    return array


def checked_templates(templates: ArrayLike, what: str) -> Array:
    """Templates (n, k, k) as float64.

    Raises:
        ValueError: not square, k even or below 11.
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
