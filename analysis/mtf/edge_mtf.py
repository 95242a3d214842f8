"""What a slanted edge gives: MTF along its normal with sigmas, the edge's place and angle, its spread function."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from analysis.mtf.edge_location import Axis

__all__ = ["EdgeMtf", "PagePlaces"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PagePlaces:
    """Where the edge stands in each of P pages, frames of one image.

    position, position_sigma: (P,) in the region's middle, px, as `EdgeMtf.position`; sigma by what is new in each page.
    angle, angle_sigma: (P,) rad, as `EdgeMtf.angle`; all the same where pages do not turn.
    chi_square, degrees_of_freedom: of places and angles of all pages being the same.
    aligned: they are not, so that the pages were laid over each other before they were measured together.
    same: pages that another one repeats to the bit and that do not count.
    noise: (2,) of one pixel in one page on the dark and on the bright side, rms, grey values.
    rounded: (2,) rms of what rounding leaves in these levels, however many pixels and pages there are, grey values.
    """

    position: Array
    position_sigma: Array
    angle: Array
    angle_sigma: Array
    chi_square: float
    degrees_of_freedom: int
    aligned: bool
    same: int
    noise: tuple[float, float]
    rounded: tuple[float, float]

    @property
    def drift(self) -> float:
        """Rms of the positions about their mean, px."""
        return float(np.std(self.position))


@dataclass(frozen=True, eq=False)
class EdgeMtf:
    """MTF along the normal of one edge.

    axis: "x" for a near-vertical edge (MTF along rows), "y" for a near-horizontal one (MTF along columns).
    frequency: (F,) cycles/pixel along the normal.
    mtf: (F,) modulus of the transfer function, 1 at frequency 0, not corrected for noise_bias.
    transfer: (F,) complex transfer function, phase counted from the edge's position.
    sigma_along, sigma_across: (F,) standard deviation of transfer along itself, and square to that.
    sigma: (F,) standard deviation of mtf from noise, with the share of the angle's uncertainty.
    noise_bias: (F,) how much noise lengthens mtf on the average, >= 0, from the measured mtf (`rice.measured_bias`).
        Its mean over repeats is right to 0.03 sigma_across where the true MTF is three of them, to 0.09 down to 0.6,
        and too small where there is hardly a signal, by up to half of one.
    angle, angle_sigma: rad, against the grid: column (row) = position + tan(angle) (row (column) - middle).
    position, position_sigma: column (axis "x") or row (axis "y") of the edge's half height in the region's middle, px.
    curvature, curvature_sigma: second derivative of the edge's column (row) by its row (column), 1/px; a straight edge
        was used all the same.
    place, esf, lsf: (S,) px along the normal from the dark side to the bright, 16 to a pixel, as far as there are
        pixels on both sides; grey values; line-spread function, 1/px, integral 1.
    pixel_place, pixel_grey: (N,) all pixels, projected, as used.
    dark, bright: grey values far from the edge, tails accounted for.
    noise_dark, noise_bright: rms noise of one pixel there.
    core: half width of the spline, px; beyond it the edge-spread function is level + tail / x.
    pages: of what was measured from several frames by `edge_pages.measure_pages`.
    """

    axis: Axis
    frequency: Array
    mtf: Array
    transfer: NDArray[np.complex128]
    sigma_along: Array
    sigma_across: Array
    sigma: Array
    noise_bias: Array
    angle: float
    angle_sigma: float
    position: float
    position_sigma: float
    curvature: float
    curvature_sigma: float
    place: Array
    esf: Array
    lsf: Array
    pixel_place: Array
    pixel_grey: Array
    dark: float
    bright: float
    noise_dark: float
    noise_bright: float
    core: float
    pages: PagePlaces | None = None

    @property
    def frequency_along_axis(self) -> Array:
        """(F,) cycles/pixel along the row (axis "x") or column (axis "y"): what ISO 12233 plots."""
        return self.frequency * math.cos(self.angle)

    def at(self, frequency: float) -> tuple[float, float]:
        """MTF and sigma at one frequency along the normal, cycles/pixel; cubic between the samples.

        Raises:
            ValueError: the frequency is outside of the measured ones.
        """
        if not self.frequency[0] <= frequency <= self.frequency[-1]:
            raise ValueError(
                f"frequency {frequency} lies outside of {self.frequency[0]:g} to {self.frequency[-1]:g} cycles/pixel"
            )
        value = CubicSpline(self.frequency, self.mtf)(frequency)
        return float(value), float(np.interp(frequency, self.frequency, self.sigma))

    def frequency_at(self, value: float) -> tuple[float, float]:
        """Lowest frequency, cycles/pixel, where the MTF falls through the value, and sigma; (nan, nan) if nowhere."""
        below = np.flatnonzero((self.mtf[1:] < value) & (self.mtf[:-1] >= value))
        if below.size == 0:
            return math.nan, math.nan
        curve = CubicSpline(self.frequency, self.mtf)
        low, high = self.frequency[below[0]], self.frequency[below[0] + 1]
        roots = curve.solve(value, extrapolate=False)
        root = float(roots[(roots >= low) & (roots <= high)][0])
        return root, float(np.interp(root, self.frequency, self.sigma) / abs(curve(root, 1)))
