"""Forward intersection of points without ground control, also from line cameras corrected by their on-board monitor.

Each ray weighs by what noise of image, attitude and station does in its image. The covariance is that of this noise,
for each point by itself: that points exposed within a few readings of the attitude share errors is not in it, and is
what `strip_adjustment` uses. Errors of the calibration, which all points share, are in neither.

The monitor says how the line of sight has turned since the calibration (d_alpha about the camera's Y, d_beta about X,
d_gamma about the line of sight) and how the principal distance has grown (d_f). A calibrated look (x, y, z) in the
camera's axes becomes

    Ry(d_alpha) Rx(d_beta) Rz(d_gamma) (x, y f / (f + d_f), z),

which gives the corrected line exactly these four changes as docs/conventions.md defines them: the line of sight is
turned first about the calibrated camera's Y, then about the turned X; a longer f makes the angles along the line
smaller. What the four cannot say, such as a change of distortion, stays as it was calibrated.

Noise of an image point by measured attitude and station, of which cubic splines join readings at fixed intervals.

Attitude and station of an exposure are interpolated between readings. The correction at time t is a cubic B-spline sum

    sigma * sum over k of beta(t / h - k) z_k,    readings at whole multiples of h,

which is the cubic spline through its own values at the readings (z_{k-1} + 4 z_k + z_{k+1}) / 6. Readings independent
with unit variance make z a stationary second-order autoregression with the double root -rho, rho = 2 - sqrt 3; its
covariance is 3 (-rho)^n (n + (1 + rho^2) / (1 - rho^2)), and the precision of a stretch of it has five diagonals.

Quality of an orbit or attitude series by its third differences (paper 003, Table 2).

A third difference x[k+3] - 3 x[k+2] + 3 x[k+1] - x[k] removes a smooth motion, up to its third derivative times dt^3,
and leaves noise: of white noise with standard deviation s it has the RMS s sqrt(1 + 9 + 9 + 1) = s sqrt(20), and
neighbours correlate by -15/20. It says nothing of a bias, of a drift or of noise that is slower than a few samples, and
data that were smoothed before look better than they are. The smooth part is not always small: along a circular orbit at
500 km the third derivative is 8.4e-3 m/s^3, so 8 mm at 1 s but 8 m at 10 s.

Errors of points on the ground as map standards count them: circles and intervals that hold a share of them.

CE90 is the radius in plan that holds nine points in ten, LE90 the height that does: of one point by its covariance, of
a set of points with different covariances for a point that is drawn from the set, and of errors that are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.linalg import toeplitz
from scipy.optimize import brentq, elementwise
from scipy.spatial.transform import Rotation
from scipy.special import erf, ndtri

from analysis.arrays import Array, MeasurementError
from analysis.orbit.calibration_parameters import CalibrationError, Noise, vertical
from analysis.orbit.three_line_model import LineModel, Partials, Rays, bias_rotation, misclosure, partials

_RHO = 2.0 - np.sqrt(3.0)
_NEEDED = 4
"""Neighbouring z that one moment needs: no stretch is shorter."""


def reading_variance(time: Array, interval: float) -> Array:
    """(n,) variance of the spline at times (n,) for readings of unit variance: 1 at a reading, 0.76 halfway."""
    _, blend = spline_blend(time, interval)
    return np.asarray(np.einsum("ni,ij,nj->n", blend, _covariance(_NEEDED), blend))


def ray_covariance(noise: Noise, rays: Rays, by: Partials, *, shared: bool) -> Array:
    """(n, 2, 2) covariance of image points, metres^2.

    Parameters
    ----------
    noise : Noise
        Model of the errors.
    rays : Rays
        n image points.
    by : Partials
        Derivatives of their misclosures.
    shared : bool
        With the noise that they share, as for one point alone; otherwise without what SharedNoise carries.
    """
    unit = np.eye(2) if rays.spread is None else rays.spread
    spread = np.broadcast_to(noise.image**2 * unit, (len(rays.point), 2, 2))
    for term in noise.terms:
        part = {"attitude": by.attitude, "station": by.ground}[term.kind]
        variance = np.full(len(rays.point), term.sigma**2)
        if term.walks:
            if rays.time is None:
                raise CalibrationError("calibration: a random walk of the attitude needs the times of all rays")
            since = np.abs(rays.time - np.mean(rays.time)) if len(rays.time) else rays.time
            variance = variance * since * shared
        elif term.interval is not None and rays.time is not None:
            variance = variance * (reading_variance(rays.time, term.interval) if shared else 0.0)
        spread = spread + variance[:, None, None] * (part @ np.swapaxes(part, 1, 2))
    return np.asarray(spread)


def spline_blend(time: Array, interval: float) -> tuple[NDArray[np.intp], Array]:
    """Number (n,) of the first of four cubic B-splines at times, and their values (n, 4)."""
    place = np.asarray(time, np.float64) / interval
    reading = np.floor(place)
    u = place - reading
    values = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 3 * u * (1 + u - u**2) + 1, u**3], axis=-1)
    return np.asarray(reading, np.intp) - 1, np.asarray(values / 6.0, np.float64)


def _covariance(count: int) -> Array:
    """(count, count) of neighbouring z, for readings of unit variance."""
    n = np.arange(count)
    return np.asarray(toeplitz(3.0 * (-_RHO) ** n * (n + (1 + _RHO**2) / (1 - _RHO**2))))


def spline_precision(count: int) -> sparse.csr_matrix:
    """Inverse of `_covariance`, for four or more: inside the square of (1 4 1) / 6, special in two rows at each end."""
    bands = [np.full(count - abs(k), v / 36.0) for k, v in ((0, 18.0), (1, 8.0), (2, 1.0))]
    matrix = sparse.diags([bands[2], bands[1], bands[0], bands[1], bands[2]], [-2, -1, 0, 1, 2]).tolil()
    corner = np.linalg.inv(_covariance(_NEEDED))
    matrix[:2, :2], matrix[-2:, -2:] = corner[:2, :2], corner[-2:, -2:]
    return sparse.csr_matrix(matrix)


WHITE_GAIN = float(np.sqrt(20.0))
# Steps of time that differ by more are gaps: third differences over them mean something else.
_UNEVEN = 1e-3


@dataclass(frozen=True, eq=False)
class ThirdDifference:
    """Quality of one series.

    Attributes
    ----------
    rms : Array
        (k,) of the third differences of each column, as in Table 2.
    white_sigma : Array
        (k,) rms / sqrt(20), standard deviation of one sample if the noise is white.
    """

    rms: Array
    white_sigma: Array


def third_difference(time: ArrayLike, series: ArrayLike) -> ThirdDifference:
    """Third differences of an evenly sampled series.

    Parameters
    ----------
    time : ArrayLike
        (n,) seconds.
    series : ArrayLike
        (n,) or (n, k), metres or radians.

    Raises
    ------
    ValueError
        Fewer than five samples, values that are not finite, gaps.
    """
    t, x = np.asarray(time, np.float64), np.asarray(series, np.float64)
    x = x[:, None] if x.ndim == 1 else x
    if t.ndim != 1 or x.ndim != 2 or len(t) != len(x) or len(t) < 5:
        raise ValueError(f"third differences: need five samples or more, found times {t.shape} and series {x.shape}")
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(x))):
        raise ValueError("third differences: times and values must be finite")
    steps = np.diff(t)
    typical = float(np.median(steps))
    bad = np.flatnonzero(np.abs(steps - typical) > _UNEVEN * abs(typical))
    if typical <= 0 or len(bad):
        where = f"; the step after sample {bad[0]} is {steps[bad[0]]:.6g} s" if len(bad) else ""
        raise ValueError(f"third differences: times must rise evenly, by {typical:.6g} s{where}")
    change = np.diff(x, n=3, axis=0)
    rms = np.sqrt(np.mean(change**2, axis=0))
    return ThirdDifference(rms, rms / WHITE_GAIN)


_STEPS = 10
_CONVERGED = 1e-6  # metres; coordinates of 6.4e6 m are rounded to 1e-9 m
# Two rays at less than one arc minute do not meet: a base of 150 m under 500 km.
_PARALLEL = 3e-4


@dataclass(frozen=True, eq=False)
class Intersection:
    """Intersected points.

    Attributes
    ----------
    ground : Array
        (m, 3) ITRS, metres; NaN where fewer than two rays see a point.
    covariance : Array
        (m, 3, 3).
    rays : NDArray[np.intp]
        (m,) how many see it.
    chi_square : Array
        (m,) of its rays; degrees of freedom 2 rays - 3.
    """

    ground: Array
    covariance: Array
    rays: NDArray[np.intp]
    chi_square: Array


@dataclass(frozen=True, eq=False)
class CheckErrors:
    """Found minus given at check points: error (m, 3) east, north, up; RMS in plan (both axes) and height, metres."""

    error: Array
    plan_rms: float
    height_rms: float
    count: int


def intersect(
    rays: Mapping[str, Rays],
    cameras: Mapping[str, LineModel],
    noise: Noise,
    *,
    bias: ArrayLike = (0.0, 0.0, 0.0),
    offset: ArrayLike = (0.0, 0.0, 0.0),
    count: int | None = None,
) -> Intersection:
    """Points of one pass from the rays of all lines.

    Parameters
    ----------
    rays : Mapping[str, Rays]
        Line -> its image points.
    cameras : Mapping[str, LineModel]
        Line -> calibrated camera, in its state during this pass (`LineModel.drifted`).
    noise : Noise
        Of image, attitude and station.
    bias : ArrayLike
        (3,) roll, pitch, yaw, radians.
    offset : ArrayLike
        (3,) of the station, ITRS, metres.
    count : int | None
        Of points; from the rays where not given.

    Raises
    ------
    CalibrationError
        No point with two rays, rays that are parallel, no convergence.
    """
    turn, shift, small = bias_rotation(bias), np.asarray(offset, np.float64), np.asarray(bias, np.float64)
    total = count or 1 + max((int(r.point.max()) for r in rays.values() if r.point.size), default=-1)
    seen = np.zeros(max(total, 0), np.intp)
    for row in rays.values():
        np.add.at(seen, row.point, 1)
    good = seen >= 2
    if not np.any(good):
        raise CalibrationError("forward intersection: no point is seen by two lines")
    ground = _start(rays, cameras, turn, shift, good)
    for _ in range(_STEPS):
        normal, right, square = np.zeros((total, 3, 3)), np.zeros((total, 3)), np.zeros(total)
        for line, row in rays.items():
            used = row.taken(good[row.point])
            shown = ground[used.point]
            by = partials(cameras[line], used, shown, small, shift)
            white = np.linalg.inv(np.linalg.cholesky(ray_covariance(noise, used, by, shared=True)))
            design = white @ by.ground
            miss = np.einsum("nij,nj->ni", white, misclosure(cameras[line], used, shown, small, shift))
            np.add.at(normal, used.point, np.swapaxes(design, 1, 2) @ design)
            np.add.at(right, used.point, np.einsum("nij,ni->nj", design, miss))
            np.add.at(square, used.point, np.sum(miss**2, axis=1))
        step = -np.linalg.solve(normal[good], right[good][..., None])[..., 0]
        ground[good] += step
        if np.abs(step).max() < _CONVERGED:
            break
    else:
        raise CalibrationError(f"forward intersection: no convergence, the last step is {np.abs(step).max():.3g} m")
    covariance = np.full((total, 3, 3), np.nan)
    covariance[good] = np.linalg.inv(normal[good])
    return Intersection(ground, covariance, seen, np.where(good, square, np.nan))


def check_errors(found: Array, given: ArrayLike) -> CheckErrors:
    """Errors (m, 3) of found points against given ones, ITRS, metres; points that were not found do not count.

    Raises
    ------
    CalibrationError
        Shapes differ, given coordinates are not finite, no points.
    """
    truth = np.asarray(given, np.float64)
    if truth.shape != found.shape or not np.all(np.isfinite(truth)):
        raise CalibrationError(f"check points: need {found.shape} finite coordinates, found {truth.shape}")
    good = np.isfinite(found).all(axis=1)
    if not np.any(good):
        raise CalibrationError("check points: none was intersected")
    error = np.full_like(truth, np.nan)
    error[good] = np.einsum("nij,nj->ni", level_axes(truth[good]), found[good] - truth[good])
    square = np.mean(error[good] ** 2, axis=0)
    return CheckErrors(error, float(np.sqrt(square[0] + square[1])), float(np.sqrt(square[2])), int(good.sum()))


def _start(
    rays: Mapping[str, Rays], cameras: Mapping[str, LineModel], turn: Array, shift: Array, good: NDArray[np.bool_]
) -> Array:
    """Points nearest to their rays as lines in space."""
    normal, right = np.zeros((len(good), 3, 3)), np.zeros((len(good), 3))
    for line, row in rays.items():
        camera = cameras[line]
        look = np.einsum("nij,nj->ni", row.attitude, camera.directions(row.image) @ turn.T)
        origin = row.station + shift + np.einsum("nij,j->ni", row.attitude, turn @ camera.position)
        across = np.eye(3) - look[:, :, None] * look[:, None, :]
        np.add.at(normal, row.point, across)
        np.add.at(right, row.point, np.einsum("nij,nj->ni", across, origin))
    smallest = np.linalg.eigvalsh(normal[good])[:, 0]
    if np.any(smallest < _PARALLEL**2 / 2):
        which = np.flatnonzero(good)[np.argmin(smallest)]
        raise CalibrationError(f"forward intersection: the rays of point {which} are parallel")
    ground = np.full((len(good), 3), np.nan)
    ground[good] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    return ground


"""Radians; two rays at less than one arc minute do not meet."""


class IntersectionError(MeasurementError, ValueError):
    """Points cannot be intersected."""


@dataclass(frozen=True, eq=False)
class CalibratedLine:
    """What a calibration knows of a line camera.

    Attributes
    ----------
    pixels : int
        Of the line; the centre of the first is 0.
    directions : Array
        (K, 3) Chebyshev coefficients over the line, from -0.5 to pixels - 0.5, of a vector along the look in the body's
        axes; its length does not matter.
    origins : Array
        (J, 3) those of a point on the look, body frame, metres.
    axes : Array
        (3, 3) columns X, Y, Z of the camera in the body: Y along the line, Z the line of sight.
    principal_distance : float
        f, metres.
    """

    pixels: int
    directions: Array
    origins: Array
    axes: Array
    principal_distance: float

    def corrected(self, change: ArrayLike) -> CalibratedLine:
        """The line after a change.

        change: (4,) d_alpha, d_beta, d_gamma (rad) and d_f (m) since the calibration.
        Raises ValueError for another shape, numbers that are not finite, and a principal distance of zero or less.
        """
        values = np.asarray(change, np.float64)
        if values.shape != (4,) or not np.all(np.isfinite(values)):
            raise ValueError(f"corrected line: need four finite numbers, found {values!r}")
        distance = self.principal_distance + float(values[3])
        if distance <= 0.0:
            raise ValueError("corrected line: the principal distance must stay positive")
        shrunk = np.diag([1.0, self.principal_distance / distance, 1.0])
        matrix = self.axes @ Rotation.from_euler("YXZ", values[:3]).as_matrix() @ shrunk @ self.axes.T
        return replace(self, directions=self.directions @ matrix.T, principal_distance=distance)

    def look(self, pixel: Array) -> Array:
        """(n, 3) unit directions toward the scene in the body's axes, of pixels (n,)."""
        vector = self._series(self.directions, pixel)
        return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))

    def origin(self, pixel: Array) -> Array:
        """(n, 3) points on the looks, body frame, metres."""
        return self._series(self.origins, pixel)

    def _series(self, coefficients: Array, pixel: Array) -> Array:
        place = (2.0 * np.asarray(pixel, np.float64) + 1.0) / self.pixels - 1.0
        return np.asarray(np.moveaxis(chebyshev.chebval(place, coefficients), 0, -1))


@dataclass(frozen=True, eq=False)
class Sightings:
    """Where one line saw points, in the points' order.

    Attributes
    ----------
    pixel : Array
        (n,) places on the line.
    station : Array
        (n, 3) measured position of the body's origin at their times, ITRS, metres.
    attitude : Array
        (n, 3, 3) measured body to ITRS.
    """

    pixel: Array
    station: Array
    attitude: Array


@dataclass(frozen=True, eq=False)
class StereoPoints:
    """Intersected points.

    Attributes
    ----------
    ground : Array
        (n, 3) ITRS, metres.
    miss : Array
        (n,) distance at which the two rays pass each other, metres.
    """

    ground: Array
    miss: Array


def intersect_pair(
    first: CalibratedLine, second: CalibratedLine, seen_first: Sightings, seen_second: Sightings
) -> StereoPoints:
    """Points nearest to their two rays in the sense of angles: each ray's miss counts against its own length.

    Raises
    ------
    IntersectionError
        Different numbers of sightings, rays that are parallel.
    """
    if len(seen_first.pixel) != len(seen_second.pixel):
        raise IntersectionError("both lines must see the same points")
    origins, looks = [], []
    for camera, seen in ((first, seen_first), (second, seen_second)):
        looks.append(np.einsum("nij,nj->ni", seen.attitude, camera.look(seen.pixel)))
        origins.append(seen.station + np.einsum("nij,nj->ni", seen.attitude, camera.origin(seen.pixel)))
    base = origins[1] - origins[0]
    normal = np.cross(looks[0], looks[1])
    square = np.sum(normal**2, axis=-1)
    if np.any(square < _PARALLEL**2):
        raise IntersectionError(f"the rays of point {int(np.argmin(square))} are parallel")
    # each ray's point nearest to the other one; between them, as far from each as its ray is long
    along = [np.sum(np.cross(base, looks[1 - k]) * normal, axis=-1) / square for k in (0, 1)]
    ends = [o + t[:, None] * u for o, t, u in zip(origins, along, looks, strict=True)]
    weight = along[1] ** 2 / (along[0] ** 2 + along[1] ** 2)
    ground = weight[:, None] * ends[0] + (1.0 - weight[:, None]) * ends[1]
    return StereoPoints(np.asarray(ground), np.linalg.norm(ends[1] - ends[0], axis=-1))


def between(times: ArrayLike, measured: ArrayLike, values: ArrayLike) -> Array:
    """(T, 4) changes at times (T,) from those (m, 4) measured at ascending times (m,): linear, held beyond the ends.

    Parameters
    ----------
    times : ArrayLike
        (T,), seconds.
    measured : ArrayLike
        (m,), ascending, seconds.
    values : ArrayLike
        (m, 4) changes then.
    """
    wanted, at, known = (np.asarray(v, np.float64) for v in (times, measured, values))
    return np.stack([np.interp(wanted, at, column) for column in known.T], axis=-1)


_SHARE = 0.9
_DIRECTIONS = 0.5 * np.pi * (np.arange(32) + 0.5) / 32
"""Of the mean over a quarter of a circle, 1e-12 of CE90 for axes of any ratio."""
_FARTHEST = 40.0
"""Radius beyond which nothing lies, in standard deviations."""


@dataclass(frozen=True)
class Accuracy:
    """CE90 and LE90, metres, and of how many points."""

    ce90: float
    le90: float
    count: int


def level_axes(points: Array) -> Array:
    """(m, 3, 3) east, north and up as rows, at points (m, 3), ITRS, metres."""
    up = vertical(points)
    east = np.cross([0.0, 0.0, 1.0], up)
    east = east / np.linalg.norm(east, axis=1, keepdims=True)
    return np.stack([east, np.cross(up, east), up], axis=1)


def linear_error(variance: ArrayLike, share: float = _SHARE) -> Array:
    """Half width (...) of the interval about zero that holds a share of normal errors of these variances (...); LE90
    for 0.9, 1.645 sigma.
    """
    return np.asarray(float(ndtri(0.5 + 0.5 * share)) * np.sqrt(variance))


def circular_error(covariance: ArrayLike, share: float = _SHARE) -> Array:
    """Radius of the circle about zero that holds a share of normal errors in the plane; CE90 for 0.9.

    A round covariance has 2.146 sigma, one along a line 1.645 sigma.

    Parameters
    ----------
    covariance : ArrayLike
        (..., 2, 2).
    share : float
        Of the errors, between 0 and 1.

    Returns
    -------
    Array
        (...), in the unit of the covariance's root.

    Raises
    ------
    ValueError
        a share that is none, a covariance that is none.
    """
    values = _axes(covariance, share)
    longer = np.sqrt(values[..., 1])
    ratio = np.divide(values[..., 0], values[..., 1], out=np.ones_like(longer), where=longer > 0.0)

    def missing(radius: Array, short: Array) -> Array:
        return share - _within(radius, np.stack([short, np.ones_like(short)], axis=-1))

    found = elementwise.find_root(missing, (np.zeros_like(ratio), np.full_like(ratio, _FARTHEST)), args=(ratio,))
    return np.asarray(longer * found.x)


def circle_of_points(covariance: Array) -> float:
    """Radius that holds a share of points with covariances (m, 2, 2) in plan; see `circular_error`."""
    values = _axes(covariance, _SHARE)

    def missing(radius: float) -> float:
        return float(np.mean(_within(radius, values))) - _SHARE

    return float(brentq(missing, 0.0, _FARTHEST * float(np.sqrt(values.max())), xtol=1e-9))


def interval_of_points(variance: Array) -> float:
    """Distance, metres, that holds the share of points with variances (m,), m^2."""
    sigma = np.sqrt(np.maximum(variance, 1e-300))

    def missing(size: float) -> float:
        return float(np.mean(erf(size / sigma / np.sqrt(2.0)))) - _SHARE

    return float(brentq(missing, 0.0, _FARTHEST * float(sigma.max()), xtol=1e-9))


def predicted(points: Array, covariance: Array) -> Accuracy:
    """By covariances (m, 3, 3), ITRS, of points (m, 3)."""
    axes = level_axes(points)
    level = axes @ covariance @ np.swapaxes(axes, 1, 2)
    return Accuracy(circle_of_points(level[:, :2, :2]), interval_of_points(level[:, 2, 2]), len(points))


def realised(points: Array, error: Array) -> Accuracy:
    """By errors (m, 3), ITRS, metres, of points (m, 3): quantiles of the sample."""
    level = np.einsum("nij,nj->ni", level_axes(points), error)
    plan, height = np.linalg.norm(level[:, :2], axis=1), np.abs(level[:, 2])
    return Accuracy(float(np.quantile(plan, _SHARE)), float(np.quantile(height, _SHARE)), len(points))


def _axes(covariance: ArrayLike, share: float) -> Array:
    """(..., 2) variances along the axes of the ellipses, the shorter first."""
    if not 0.0 < share < 1.0:
        raise ValueError("a share lies between 0 and 1")
    values = np.linalg.eigvalsh(np.asarray(covariance, np.float64))
    if not np.all(values >= -1e-12 * np.abs(values[..., -1:])):
        raise ValueError("a covariance has no negative variances")
    return np.asarray(np.maximum(values, 0.0))


def _within(radius: ArrayLike, variances: Array) -> Array:
    """(...) share of normal errors with variances (..., 2) along two axes that lie within radii (...).

    In units of the axes the errors are round: directions are alike, and in each the length is Rayleigh's. The ellipse
    that the circle becomes has the radius R / sqrt(a cos^2 + b sin^2) there.
    """
    along = variances[..., :1] * np.sin(_DIRECTIONS) ** 2 + variances[..., 1:] * np.cos(_DIRECTIONS) ** 2
    square = np.asarray(radius, np.float64)[..., None] ** 2
    return np.asarray(np.mean(-np.expm1(-0.5 * square / np.maximum(along, 1e-300)), axis=-1))
