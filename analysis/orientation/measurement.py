"""From the frames and readings of a distortion test to interior orientation and distortion (paper 004, section 3).

1. `locate_spots`: energy centroids on the line CCD, L = (column - middle of the line) * pitch.
2. `reduce_sets`: repeated sets to one (W, L) per point, gross errors out by Chauvenet's criterion.
3. `Distortion.measure`: f, p and D = L - c - f tan W + p tan^2 W with a constant c beside eq. (2), which takes up the
   error of the zero of W, and a smooth model of D. What the points scatter about that model beyond their noise is taken
   as one more noise, the same at all points and independent from point to point: the subdivision error of the table
   above all, whose period of arcseconds no calibration follows.

Metres and radians; N points, S sets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from analysis.arrays import Array
from analysis.orientation.interior import InteriorOrientation, fit_interior_orientation
from analysis.spots.centroid import energy_centroid, mean_frames
from analysis.spots.noise import NoiseModel
from analysis.turntable.dividing_error import CalibrationSeries

CALIBRATED = ("constant", "principal_distance", "principal_point")
"""What distortion is counted from: eq. (2) with a constant."""
SMOOTH = (*CALIBRATED, "radial3")
"""The model whose residual tells how well the points fit a smooth curve."""


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots on the line CCD.

    Attributes:
        position: L, (N, S), metres.
        temporal: sigma by noise that is new in each frame, (N, S), metres.
        fixed: sigma by differences of the line's columns, which stay while the spot does, (N, S), metres.
        row: of the spot in its image, (N, S), pixels.
    """

    position: Array
    temporal: Array
    fixed: Array
    row: Array


def locate_spots(
    frames: NDArray[np.uint16],
    column: ArrayLike,
    middle: float,
    pitch: float,
    noise: NoiseModel,
    radius: float,
    offset: ArrayLike = 0.0,
) -> Spots:
    """Energy centroids.

    Args:
        frames: (N, S, frames, H, W).
        column: of the line, where each image begins, (N, S).
        middle: column of the line's middle, where L = 0.
        pitch: metres.
        noise: of one frame; its pattern is one of columns: every row of a TDI line is collected by the same pixels.
        radius: of the centroid's window, pixels.
        offset: energy centroid minus chief ray by the camera's design, (N,), metres; taken off.

    Raises:
        SpotError: a spot is saturated, absent, or too near the edge of its image.
    """
    count, sets, number = frames.shape[:3]
    spots = energy_centroid(mean_frames(frames).reshape(count * sets, *frames.shape[3:]), number, noise, radius)
    assert spots.gain_maps is not None
    assert spots.light_dn is not None
    influence = spots.gain_maps[:, 1]
    gain = np.sum(np.sum(influence * spots.light_dn, axis=1) ** 2, axis=-1) * noise.prnu**2
    dark = np.sum(np.sum(influence, axis=1) ** 2, axis=-1) * noise.dsnu_variance_dn2
    shape = count, sets
    place = (np.asarray(column) + spots.column.reshape(shape) - middle) * pitch
    return Spots(
        position=place - np.broadcast_to(np.asarray(offset, np.float64), (count,))[:, None],
        temporal=pitch * np.sqrt(spots.temporal_covariance[:, 1, 1]).reshape(shape),
        fixed=pitch * np.sqrt(gain + dark).reshape(shape),
        row=spots.row.reshape(shape),
    )


@dataclass(frozen=True, eq=False)
class PointMeans:
    """Sets reduced to one measurement per point.

    Attributes:
        keep: exposures that Chauvenet's criterion keeps, (N, S).
        scatter: sigma of one exposure by the scatter between the sets, or as given if there is one set only, metres.
        sigma: of the mean of each point, without what is common to all sets, (N,), metres.
    """

    keep: NDArray[np.bool_]
    scatter: float
    sigma: Array

    def mean(self, values: Array) -> Array:
        """Mean over the sets that are kept, (N, S) to (N,)."""
        return np.asarray(np.mean(values, axis=1, where=self.keep))


def reduce_sets(
    angle: Array, spots: Spots, principal_distance: float, single: float, present: NDArray[np.bool_] | None = None
) -> PointMeans:
    """Find gross errors among the sets and the noise of the means.

    In each set, L - f tan W of a point differs from its mean over the sets by the repeatability of the table and by
    noise, whose sizes the sets themselves tell.

    Args:
        angle: W, (N, S), radians, by the readings.
        spots: as located.
        principal_distance: about, metres.
        single: sigma of one exposure, metres, for a test of one set.
        present: which exposures there are, (N, S), where sets lack points; the others hold any finite numbers. None
            for all.
    """
    rest = spots.position - principal_distance * np.tan(angle)
    # what does not average out while the spot stays on its pixels
    fixed = np.sqrt(np.mean(spots.fixed**2, axis=1, where=True if present is None else present))
    count, sets = rest.shape
    if sets < 2:
        own = np.hypot(single, spots.temporal[:, 0])
        return PointMeans(np.ones(rest.shape, bool), float(np.sqrt(np.mean(own**2))), np.hypot(own, fixed))
    # the comparison of the table with the camera is a calibration series, if one forgets its units
    series = CalibrationSeries(np.arange(count, dtype=float), rest, present=present)
    return PointMeans(series.keep, series.repeatability, np.hypot(series.noise_sigma, fixed))


def _white(fitted: Callable[[float], InteriorOrientation]) -> float:
    """White noise beside the stated one that brings chi-square to its expectation, metres; zero if it is there already.

    The estimator of Paule and Mandel (J. Res. Natl. Bur. Stand. 87, 377 (1982)). Chi-square falls steadily with the
    noise.
    """
    bare = fitted(0.0)
    if bare.degrees_of_freedom == 0 or bare.chi_square <= bare.degrees_of_freedom:
        return 0.0

    def beyond(size: float) -> float:
        fit = fitted(size)
        return fit.chi_square - fit.degrees_of_freedom

    # white noise of sigma s alone leaves chi-square <= sum(residual^2) / s^2, which is N - P at the upper end
    most = float(np.sqrt(np.sum(bare.residual**2) / bare.degrees_of_freedom))
    return float(brentq(beyond, 0.0, most, xtol=1e-11))


@dataclass(frozen=True, eq=False)
class Distortion:
    """Distortion with one kind of angles (as read, or compensated).

    Attributes:
        angle: W of each exposure, (N, S), radians.
        position: L, (N, S), metres.
        means: how sets were reduced.
        fit: of the calibrated terms; its residual is the distortion D of the mean of the sets, (N,), metres.
        smooth: the same with radial distortion; its residual is what is not smooth.
        white: sigma of each point's position beyond the noise that was stated, metres; it is in the noise of both fits.
    """

    angle: Array
    position: Array
    means: PointMeans
    fit: InteriorOrientation
    smooth: InteriorOrientation
    white: float

    @classmethod
    def measure(
        cls, angle: Array, spots: Spots, means: PointMeans, angle_covariance: ArrayLike | None = None
    ) -> Distortion:
        """Fit.

        Args:
            angle: (N, S), radians.
            spots: as located.
            means: how sets are reduced.
            angle_covariance: of the mean angles, (N, N), rad^2: what is common to all sets of a point, without what is
                independent from point to point.

        Raises:
            OrientationError: fewer points than unknowns, or angles that do not determine them.
        """
        where, turned = means.mean(spots.position), means.mean(angle)

        def fitted(terms: tuple[str, ...], white: float) -> InteriorOrientation:
            sigma = np.hypot(means.sigma, white)
            return fit_interior_orientation(where, turned, sigma, terms, angle_covariance=angle_covariance)

        white = _white(lambda size: fitted(SMOOTH, size))
        fit, smooth = fitted(CALIBRATED, white), fitted(SMOOTH, white)
        return cls(angle, spots.position, means, fit, smooth, white)

    @property
    def distortion(self) -> Array:
        """D, (N,), metres."""
        return self.fit.residual

    @property
    def sigma(self) -> Array:
        """Standard deviation of D, (N,), metres."""
        return np.sqrt(np.maximum(np.diagonal(self.fit.residual_covariance), 0.0))

    @property
    def zero(self) -> float:
        """Angle at which the line's middle is imaged, by the constant, radians."""
        return -self.fit.value("constant") / self.fit.value("principal_distance")

    @property
    def rms_over_sets(self) -> Array:
        """RMS of each point's distortion over the sets that are kept, (N,), metres, every set fitted by itself: what
        Table 2 of paper 004 is called.
        """
        out = np.full(self.position.shape, np.nan)
        for s, keep in enumerate(self.means.keep.T):
            out[keep, s] = fit_interior_orientation(
                self.position[keep, s], self.angle[keep, s], self.means.scatter, CALIBRATED
            ).residual
        return np.asarray(np.sqrt(np.mean(out**2, axis=1, where=self.means.keep)))
