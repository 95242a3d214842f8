"""Thresholds and model of a match."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

__all__ = ["MatchOptions"]


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
            The share of windows that fail the test and its power give it (`analysis.matching.window_halves`).
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
