"""Paper 001's own arithmetic of errors: (12), and Table 5 from Table 4 by the factors of Table 1, as printed."""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt

import numpy as np

from analysis import monitoring
from analysis.monitoring import MonitorGeometry
from twin.error_budget import BudgetLine

FRAMES = 9
"""Averaged in one measurement, (12)."""


def frame_mean(error: float, frames: int = FRAMES) -> float:
    """The random error of a mean of frames from that of a single one, (12)'s first term."""
    return error / sqrt(frames)


def root_sum(errors: Mapping[str, float]) -> float:
    """(12): the root of the sum of squares of Table 3's lines, the centroid's over the frames."""
    return sqrt(sum((frame_mean(e) if name == "centroid" else e) ** 2 for name, e in errors.items()))


def root_sum_of_squares(lines: Mapping[str, BudgetLine]) -> tuple[float, float]:
    """(12) of simulated lines and its standard deviation, radians."""
    total = root_sum({name: line.three_sigma for name, line in lines.items()})
    weight = {name: frame_mean(1.0) ** 2 if name == "centroid" else 1.0 for name in lines}
    sigma = sqrt(sum((weight[n] * line.three_sigma * line.sigma) ** 2 for n, line in lines.items())) / total
    return total, sigma


def propagated(spot: float, geometry: MonitorGeometry, estimator: str = "paper_single") -> dict[str, float]:
    """Table 5 from Table 4: errors of the parameters from that of one coordinate of one spot, all independent.

    Args:
        spot: as an angle, radians.
        geometry: of the camera.
        estimator: whose factors; (2), (3), (5), (7) or, as ``paper_joint``, Table 1's last column.

    Returns:
        d_alpha, d_beta, d_gamma in radians and d_f in metres.
    """
    pixels = spot * geometry.focal_length_m / geometry.pixel_m
    factors = np.sqrt(np.sum(monitoring.coefficients(estimator, geometry) ** 2, axis=1))
    return dict(zip(("d_alpha", "d_beta", "d_gamma", "d_f"), (float(v) for v in factors * pixels), strict=True))
