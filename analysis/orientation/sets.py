"""Several sets of one distortion test, each solved by itself as in paper 004, compared point by point (Table 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.orientation.distortion_model import (
    OrientationError,
    distortion,
    principal_distance,
    principal_distance_and_point,
    readings,
)

__all__ = ["DistortionSets", "combine_sets"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DistortionSets:
    """S sets of N points, each with its own principal distance (and point).

    principal_distance, principal_point: (S,) m; the point is zero where eq. (3) was used.
    distortion: (S, N) m, eq. (1).
    The scatter between sets shows only what changes from set to set. An error of the turntable that repeats, its
    dividing error above all, is the same in all sets and part of the mean.
    """

    principal_distance: Array
    principal_point: Array
    distortion: Array

    @property
    def mean(self) -> tuple[float, float]:
        """Mean f and p over the sets, m."""
        return float(np.mean(self.principal_distance)), float(np.mean(self.principal_point))

    @property
    def scatter(self) -> tuple[float, float]:
        """Standard deviations of one set's f and p between the sets, m (S - 1 degrees of freedom)."""
        return float(np.std(self.principal_distance, ddof=1)), float(np.std(self.principal_point, ddof=1))

    @property
    def mean_distortion(self) -> Array:
        """(N,) m, averaged over the sets."""
        return np.asarray(np.mean(self.distortion, axis=0))

    @property
    def rms_distortion(self) -> Array:
        """(N,) m: sqrt(mean D^2) over the sets, what Table 2 of paper 004 is called.

        It holds the mean distortion and the scatter: rms^2 = mean^2 + (S - 1)/S scatter^2.
        """
        return np.asarray(np.sqrt(np.mean(self.distortion**2, axis=0)))

    @property
    def scatter_distortion(self) -> Array:
        """(N,) m: standard deviation of one set's distortion between the sets."""
        return np.asarray(np.std(self.distortion, axis=0, ddof=1))

    @property
    def overall_rms(self) -> float:
        """Rms over all sets and points, m; equal to the rms of `rms_distortion`."""
        return float(np.sqrt(np.mean(self.distortion**2)))


def combine_sets(position: ArrayLike, angle: ArrayLike, fit_principal_point: bool = False) -> DistortionSets:
    """Solve each set by paper 004, eq. (3) (or (2) with `fit_principal_point`) and eq. (1).

    position: (S, N) m. angle: (S, N), or (N,) where every set has the same, rad.
    Raises OrientationError for bad readings, fewer than two sets, angles that are all the same.
    """
    where, turned = readings(position, angle)
    if where.ndim != 2 or len(where) < 2:
        raise OrientationError(
            f"distortion sets: spot positions are {where.shape}; give (S, N) with at least 2 sets to see a scatter"
        )
    spread = np.ptp(turned, axis=-1)
    if np.any(spread == 0):
        raise OrientationError(
            f"distortion sets: all angles of set {int(np.argmin(spread))} are the same; turn the turntable between the"
            " readings"
        )
    if fit_principal_point:
        f, p = principal_distance_and_point(where, turned)
    else:
        f = principal_distance(where, turned)
        p = np.zeros_like(f)
    return DistortionSets(f, p, distortion(where, turned, f, p))
