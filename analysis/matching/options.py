"""Thresholds and model of a match, checks of what it is given, why a point was not matched, results put together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import IntEnum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array

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

    Args:
        places: (n, 2), px.
        count: n that is asked for, None for any.
        what: what they are, for the message.

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

    Attributes:
        affine: solve for an affine change beside the shift.
        sharpness: solve for a difference in sharpness along rows and columns (second derivatives of the template).
            They also fit what the smoothing of a noisy template leaves; without it the place of image against image
            is drawn towards whole pixels.
        margin: rows and columns at each side of a template that only feed its interpolation, px; also bounds how far
            the fit may go before the template's rim enters it.
        iterations: most Gauss-Newton steps.
        least_correlation: of the fitted, smoothed template and the image; below it WEAK. A guard against the unrelated
            only: white noise of r times the texture's standard deviation in the image alone brings it down to
            1 / sqrt(1 + r^2), and largest_sigma judges what that leaves.
        largest_ratio: of the second best to the best peak of the search; above it AMBIGUOUS.
        largest_move: of the fit from the search's peak along an axis, px.
        largest_distortion: of any element of the affine matrix from the unit matrix.
        largest_sigma: of the place along its worst direction, px; above it UNCERTAIN, or RELIEF where only
            displacements within the window bring it there.
        largest_risk: chance of a step of displacement within a window that passes the test for one; above it UNTESTED.
            The share of windows that fail the test and its power give it (`analysis.matching.window_checks`).
        least_contrast: standard deviation of the image under the template over that of one pixel's noise; a point that
            fails otherwise is called FLAT below it.
        saturation: DN from which a pixel counts as saturated; None: the largest value of an integer type.
    """

    affine: bool = True
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

        Raises:
            ValueError: a value that is not positive and finite, correlation, ratio or risk above 1, a margin
                below 2 px or too small for the largest move.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("affine", "sharpness", "saturation") and not (value > 0 and math.isfinite(value)):
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
        return 4 + 4 * self.affine + 2 * self.sharpness
