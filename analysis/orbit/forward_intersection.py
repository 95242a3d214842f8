"""Forward intersection of points without ground control, with and without corrections by an on-board monitor.

**Intersection.** Each ray is weighted by the effect of image, attitude and station noise in its image. The covariance
follows from this noise for each point alone: it omits the errors that points exposed within a few attitude readings
share, which `strip_adjustment` models. Neither includes the errors of the calibration, which all points share.

**Correction by the monitor.** The monitor measures how the line of sight has rotated since the calibration (d_alpha
about the camera's Y, d_beta about X, d_gamma about the line of sight) and the change d_f of the principal distance. A
calibrated look vector (x, y, z) in the camera's axes becomes

    Ry(d_alpha) Rx(d_beta) Rz(d_gamma) (x, y f / (f + d_f), z),

which gives the corrected line exactly these four changes as docs/conventions.md defines them: the line of sight is
rotated first about the calibrated camera's Y, then about the rotated X; a longer f makes the angles along the line
smaller. Changes that the four parameters do not describe, such as of distortion, stay uncorrected.

**Interpolation noise.** Attitude and station of an exposure are interpolated between readings at fixed intervals. The
correction at time t is a cubic B-spline sum

    sigma * sum over k of beta(t / h - k) z_k,    readings at whole multiples of h,

which is the cubic spline through its values at the readings, (z_{k-1} + 4 z_k + z_{k+1}) / 6. Independent readings of
unit variance make z a stationary second-order autoregression with the double root -rho, rho = 2 - sqrt 3; its
covariance is 3 (-rho)^n (n + (1 + rho^2) / (1 - rho^2)), and the precision matrix of a segment of it has five
diagonals.

**Third differences** assess an orbit or attitude series (paper 003, Mo et al. 2015, Table 2). A third difference
x[k+3] - 3 x[k+2] + 3 x[k+1] - x[k] removes a smooth motion, up to its third derivative times dt^3, and leaves noise:
white noise with standard deviation s gives it the RMS s sqrt(1 + 9 + 9 + 1) = s sqrt(20), and neighbours correlate by
-15/20. It is blind to a bias, a drift or noise that is slower than a few samples, and data that were smoothed before
look better than they are. The smooth part is not always small: along a circular orbit at 500 km the third derivative is
8.4e-3 m/s^3, so 8 mm at 1 s but 8 m at 10 s.

**CE90 and LE90** are the horizontal radius and the height interval that hold 90 % of the errors, as map standards
define them: of one point by its covariance, of a set of points with different covariances (for a point drawn from the
set), and of a sample of known errors.
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
"""Absolute double root of the autoregression that describes the coefficients of the interpolating cubic spline."""
_NEEDED = 4
"""Number of cubic B-spline coefficients that determine the interpolated value at one time; no series of coefficients is
shorter.
"""


def reading_variance(time: Array, interval: float) -> Array:
    """Return the variance of a cubic spline interpolated between independent readings of unit variance, at n times.

    Readings lie at whole multiples of `interval`, in seconds. The variance, (n,), is 1 at a reading and 0.76 halfway
    between two.
    """
    _, blend = spline_blend(time, interval)
    return np.asarray(np.einsum("ni,ij,nj->n", blend, _covariance(_NEEDED), blend))


def ray_covariance(noise: Noise, rays: Rays, by: Partials, *, shared: bool) -> Array:
    """Return the (n, 2, 2) covariance of image points, in m^2.

    Parameters
    ----------
    noise : Noise
        Standard deviations of the measurements.
    rays : Rays
        Image points, n of them.
    by : Partials
        Derivatives of the collinearity misclosures of these image points.
    shared : bool
        True to include attitude and station noise that neighbouring rays share, as is right for one point alone; False
        to omit the part of it that is modelled by `SharedNoise`.

    Raises
    ------
    CalibrationError
        The noise includes a random walk, and the rays have no times.
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
    """Return the index of the first of the four cubic B-splines that are nonzero at each of n times, and their values.

    The knots lie at whole multiples of `interval`, in seconds. Indices have shape (n,), values (n, 4).
    """
    position = np.asarray(time, np.float64) / interval
    reading = np.floor(position)
    u = position - reading
    values = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 3 * u * (1 + u - u**2) + 1, u**3], axis=-1)
    return np.asarray(reading, np.intp) - 1, np.asarray(values / 6.0, np.float64)


def _covariance(count: int) -> Array:
    """Return the covariance of `count` neighbouring spline coefficients, for independent readings of unit variance."""
    n = np.arange(count)
    return np.asarray(toeplitz(3.0 * (-_RHO) ** n * (n + (1 + _RHO**2) / (1 - _RHO**2))))


def spline_precision(count: int) -> sparse.csr_matrix:
    """Return the precision matrix of four or more neighbouring coefficients of an interpolating cubic spline.

    It is the inverse of their covariance for independent readings of unit variance.

    Its interior is the square of the tridiagonal matrix with (1 4 1) / 6 in each row; two rows at each end differ.
    """
    bands = [np.full(count - abs(k), v / 36.0) for k, v in ((0, 18.0), (1, 8.0), (2, 1.0))]
    matrix = sparse.diags([bands[2], bands[1], bands[0], bands[1], bands[2]], [-2, -1, 0, 1, 2]).tolil()
    corner = np.linalg.inv(_covariance(_NEEDED))
    matrix[:2, :2], matrix[-2:, -2:] = corner[:2, :2], corner[-2:, -2:]
    return sparse.csr_matrix(matrix)


WHITE_GAIN = float(np.sqrt(20.0))
"""Ratio of the RMS of third differences to the standard deviation of white noise."""
_UNEVEN = 1e-3
"""Largest relative deviation of a time step from the median; a larger one is a gap, over which third differences have
another meaning.
"""


@dataclass(frozen=True, eq=False)
class ThirdDifference:
    """Noise level of k sampled quantities, from their third differences.

    Attributes
    ----------
    rms : (k,) ndarray
        RMS of the third differences of each quantity, in its unit, as in Table 2 of paper 003 (Mo et al. 2015).
    white_sigma : (k,) ndarray
        rms / sqrt(20), the standard deviation of one sample if the noise is white.
    """

    rms: Array
    white_sigma: Array


def third_difference(time: ArrayLike, series: ArrayLike) -> ThirdDifference:
    """Compute the third differences of an evenly sampled series.

    Parameters
    ----------
    time : (n,) array_like
        Times of the n samples, in seconds.
    series : (n,) or (n, k) array_like
        Samples of one quantity or of k, in metres or radians.

    Raises
    ------
    ValueError
        There are fewer than five samples, values are not finite, or the times have gaps.
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
"""Largest number of Gauss-Newton steps of a forward intersection."""
_CONVERGED = 1e-6
"""Largest step of a converged iteration, in metres; coordinates of 6.4e6 m are rounded to 1e-9 m."""
_PARALLEL = 3e-4
"""Smallest angle between two rays that intersect, in radians: one arc minute, a base of 150 m at 500 km."""


@dataclass(frozen=True, eq=False)
class Intersection:
    """Coordinates of m points from forward intersection.

    Attributes
    ----------
    ground : (m, 3) ndarray
        Coordinates, ITRS, in metres; NaN where fewer than two rays see a point.
    covariance : (m, 3, 3) ndarray
        Covariance of each point, in m^2.
    rays : (m,) ndarray of int
        Number of rays that see each point.
    chi_square : (m,) ndarray
        Chi-square of each point's rays, with 2 rays - 3 degrees of freedom.
    """

    ground: Array
    covariance: Array
    rays: NDArray[np.intp]
    chi_square: Array


@dataclass(frozen=True, eq=False)
class CheckErrors:
    """Errors at m check points, intersected minus surveyed.

    Attributes
    ----------
    error : (m, 3) ndarray
        Errors toward east, north and up, in metres; NaN for points that were not intersected.
    plan_rms : float
        RMS of the horizontal error over both axes, in metres.
    height_rms : float
        RMS of the height error, in metres.
    count : int
        Number of points in the RMS values.
    """

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
    """Compute the ground points of one pass by least-squares intersection of the rays of all line cameras.

    Parameters
    ----------
    rays : mapping of str to Rays
        Image points of each line, by its name.
    cameras : mapping of str to LineModel
        Calibrated line cameras in their state during this pass (`LineModel.drifted`), by name.
    noise : Noise
        Standard deviations of image, attitude and station.
    bias : (3,) array_like
        Attitude bias in roll, pitch, yaw, in radians.
    offset : (3,) array_like
        Offset of the station, ITRS, in metres.
    count : int, optional
        Number of points; derived from the rays by default.

    Raises
    ------
    CalibrationError
        No point has two rays, the rays of a point are parallel, or the iteration does not converge.
    """
    rotation, shift, small = bias_rotation(bias), np.asarray(offset, np.float64), np.asarray(bias, np.float64)
    total = count or 1 + max((int(r.point.max()) for r in rays.values() if r.point.size), default=-1)
    counts = np.zeros(max(total, 0), np.intp)
    for row in rays.values():
        np.add.at(counts, row.point, 1)
    intersected = counts >= 2
    if not np.any(intersected):
        raise CalibrationError("forward intersection: no point is seen by two lines")
    ground = _start(rays, cameras, rotation, shift, intersected)
    for _ in range(_STEPS):
        normal, right, square = np.zeros((total, 3, 3)), np.zeros((total, 3)), np.zeros(total)
        for line, row in rays.items():
            used = row.taken(intersected[row.point])
            points = ground[used.point]
            by = partials(cameras[line], used, points, small, shift)
            white = np.linalg.inv(np.linalg.cholesky(ray_covariance(noise, used, by, shared=True)))
            design = white @ by.ground
            miss = np.einsum("nij,nj->ni", white, misclosure(cameras[line], used, points, small, shift))
            np.add.at(normal, used.point, np.swapaxes(design, 1, 2) @ design)
            np.add.at(right, used.point, np.einsum("nij,ni->nj", design, miss))
            np.add.at(square, used.point, np.sum(miss**2, axis=1))
        step = -np.linalg.solve(normal[intersected], right[intersected][..., None])[..., 0]
        ground[intersected] += step
        if np.abs(step).max() < _CONVERGED:
            break
    else:
        raise CalibrationError(f"forward intersection: no convergence, the last step is {np.abs(step).max():.3g} m")
    covariance = np.full((total, 3, 3), np.nan)
    covariance[intersected] = np.linalg.inv(normal[intersected])
    return Intersection(ground, covariance, counts, np.where(intersected, square, np.nan))


def check_errors(intersected: Array, surveyed: ArrayLike) -> CheckErrors:
    """Compare the coordinates of m intersected points with the surveyed ones, both (m, 3), ITRS, in metres.

    Points that were not intersected (NaN) are ignored.

    Raises
    ------
    CalibrationError
        Shapes differ, surveyed coordinates are not finite, or no point was intersected.
    """
    truth = np.asarray(surveyed, np.float64)
    if truth.shape != intersected.shape or not np.all(np.isfinite(truth)):
        raise CalibrationError(f"check points: need {intersected.shape} finite coordinates, found {truth.shape}")
    good = np.isfinite(intersected).all(axis=1)
    if not np.any(good):
        raise CalibrationError("check points: none was intersected")
    error = np.full_like(truth, np.nan)
    error[good] = np.einsum("nij,nj->ni", level_axes(truth[good]), intersected[good] - truth[good])
    square = np.mean(error[good] ** 2, axis=0)
    return CheckErrors(error, float(np.sqrt(square[0] + square[1])), float(np.sqrt(square[2])), int(good.sum()))


def _start(
    rays: Mapping[str, Rays], cameras: Mapping[str, LineModel], rotation: Array, shift: Array, good: NDArray[np.bool_]
) -> Array:
    """Return the position of each ground point that is nearest to its rays, by least squares, ITRS, in metres."""
    normal, right = np.zeros((len(good), 3, 3)), np.zeros((len(good), 3))
    for line, row in rays.items():
        camera = cameras[line]
        look = np.einsum("nij,nj->ni", row.attitude, camera.directions(row.image) @ rotation.T)
        origin = row.station + shift + np.einsum("nij,j->ni", row.attitude, rotation @ camera.position)
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


class IntersectionError(MeasurementError, ValueError):
    """Error raised for points whose rays cannot be intersected."""


@dataclass(frozen=True, eq=False)
class CalibratedLine:
    """Calibrated geometry of a line camera: look direction and origin of the ray of every pixel.

    Attributes
    ----------
    pixels : int
        Number of pixels of the line; pixel coordinates count from 0 at the centre of the first pixel.
    directions : (K, 3) ndarray
        K Chebyshev coefficients over the line, from -0.5 to pixels - 0.5, of a vector along the look direction in the
        body's axes; its length does not matter.
    origins : (J, 3) ndarray
        J Chebyshev coefficients of a point on the ray, body frame, in metres.
    axes : (3, 3) ndarray
        Columns X, Y, Z of the camera in the body: Y along the line, Z the line of sight.
    principal_distance : float
        Principal distance f, in metres.
    """

    pixels: int
    directions: Array
    origins: Array
    axes: Array
    principal_distance: float

    def corrected(self, change: ArrayLike) -> CalibratedLine:
        """Return the calibrated line after a rotation of the camera and a change of its principal distance.

        Parameters
        ----------
        change : (4,) array_like
            d_alpha, d_beta, d_gamma (radians) and d_f (metres) since the calibration.

        Raises
        ------
        ValueError
            The shape is not (4,), a number is not finite, or the principal distance becomes zero or negative.
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
        """Return the unit directions toward the scene of n pixels, (n, 3), in the body's axes."""
        vector = self._series(self.directions, pixel)
        return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))

    def origin(self, pixel: Array) -> Array:
        """Return a point on the ray of each of n pixels, (n, 3), body frame, in metres."""
        return self._series(self.origins, pixel)

    def _series(self, coefficients: Array, pixel: Array) -> Array:
        position = (2.0 * np.asarray(pixel, np.float64) + 1.0) / self.pixels - 1.0
        return np.asarray(np.moveaxis(chebyshev.chebval(position, coefficients), 0, -1))


@dataclass(frozen=True, eq=False)
class Sightings:
    """Image positions of n points on one line, in the points' order.

    Attributes
    ----------
    pixel : (n,) ndarray
        Positions on the line, in pixels.
    station : (n, 3) ndarray
        Measured position of the body's origin at the exposure times, ITRS, in metres.
    attitude : (n, 3, 3) ndarray
        Measured rotation from the body to ITRS.
    """

    pixel: Array
    station: Array
    attitude: Array


@dataclass(frozen=True, eq=False)
class StereoPoints:
    """Points, n of them, intersected from two rays each.

    Attributes
    ----------
    ground : (n, 3) ndarray
        Coordinates, ITRS, in metres.
    miss : (n,) ndarray
        Smallest distance between the two rays, in metres.
    """

    ground: Array
    miss: Array


def intersect_pair(
    first: CalibratedLine, second: CalibratedLine, seen_first: Sightings, seen_second: Sightings
) -> StereoPoints:
    """Intersect two lines' rays of the same points, minimising the angles by which the rays miss each point.

    Raises
    ------
    IntersectionError
        The numbers of sightings differ, or two rays are parallel.
    """
    if len(seen_first.pixel) != len(seen_second.pixel):
        raise IntersectionError("both lines must see the same points")
    origins, looks = [], []
    for camera, seen in ((first, seen_first), (second, seen_second)):
        looks.append(np.einsum("nij,nj->ni", seen.attitude, camera.look(seen.pixel)))
        origins.append(seen.station + np.einsum("nij,nj->ni", seen.attitude, camera.origin(seen.pixel)))
    return intersect_rays(origins[0], looks[0], origins[1], looks[1])


def intersect_rays(
    first_origin: ArrayLike, first_direction: ArrayLike, second_origin: ArrayLike, second_direction: ArrayLike
) -> StereoPoints:
    """Intersect pairs of rays in the points at which the angles by which the two rays miss them are smallest.

    Parameters
    ----------
    first_origin, second_origin : (n, 3) or (3,) array_like
        Points on the rays, such as the stations, in metres.
    first_direction, second_direction : (n, 3) or (3,) array_like
        Directions of the rays, of any length.

    Returns
    -------
    StereoPoints
        The n points `ground`, (n, 3), in metres, and `miss`, (n,), the distance at which the two rays of each point
        pass each other, in metres.

    Raises
    ------
    ValueError
        Arrays of other shapes, values that are not finite, or parallel rays.

    Examples
    --------
    Rays from two stations, 300 km apart, to a point 500 km below:

    >>> import numpy as np
    >>> import analysis
    >>> stations, point = np.array([[-150e3, 0, 500e3], [150e3, 0, 500e3]]), np.array([10.0, 20.0, 30.0])
    >>> found = analysis.intersect_rays(stations[0], point - stations[0], stations[1], point - stations[1])
    >>> np.round(found.ground, 6), np.round(found.miss, 6)
    (array([[10., 20., 30.]]), array([0.]))

    Rays that pass each other by 2 m across the base meet halfway:

    >>> found = analysis.intersect_rays([-1e5, 1, 5e5], [1, 0, -5], [1e5, -1, 5e5], [-1, 0, -5])
    >>> np.round(found.ground + 0.0, 6), np.round(found.miss, 6)
    (array([[0., 0., 0.]]), array([2.]))
    """
    rays = first_origin, first_direction, second_origin, second_direction
    shaped = np.broadcast_arrays(*(np.atleast_2d(np.asarray(vector, np.float64)) for vector in rays))
    if shaped[0].ndim != 2 or shaped[0].shape[1] != 3 or not np.all(np.isfinite(np.stack(shaped))):
        raise IntersectionError(f"rays need finite origins and directions (n, 3), found {[np.shape(g) for g in rays]}")
    origins = shaped[0], shaped[2]
    looks = [u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300) for u in (shaped[1], shaped[3])]
    base = origins[1] - origins[0]
    normal = np.cross(looks[0], looks[1])
    square = np.sum(normal**2, axis=-1)
    if np.any(square < _PARALLEL**2):
        raise IntersectionError(f"the rays of point {int(np.argmin(square))} are parallel")
    # nearest point of each ray to the other; the result divides their connection in proportion to the rays' lengths
    along = [np.sum(np.cross(base, looks[1 - k]) * normal, axis=-1) / square for k in (0, 1)]
    ends = [o + t[:, None] * u for o, t, u in zip(origins, along, looks, strict=True)]
    weight = along[1] ** 2 / (along[0] ** 2 + along[1] ** 2)
    ground = weight[:, None] * ends[0] + (1.0 - weight[:, None]) * ends[1]
    return StereoPoints(np.asarray(ground), np.linalg.norm(ends[1] - ends[0], axis=-1))


def between(times: ArrayLike, measured: ArrayLike, values: ArrayLike) -> Array:
    """Interpolate measured camera changes linearly in time; they are constant outside the measured times.

    Parameters
    ----------
    times : (T,) array_like
        Times of the result, T of them, in seconds.
    measured : (m,) array_like
        Ascending times of the m measured changes, in seconds.
    values : (m, 4) array_like
        Measured changes of the camera: d_alpha, d_beta, d_gamma (radians) and d_f (metres).
    """
    target, at, known = (np.asarray(v, np.float64) for v in (times, measured, values))
    return np.stack([np.interp(target, at, column) for column in known.T], axis=-1)


_SHARE = 0.9
"""Fraction of the errors that lie within CE90 (horizontally) and LE90 (in height)."""
_DIRECTIONS = 0.5 * np.pi * (np.arange(32) + 0.5) / 32
"""Angles of the midpoint rule over a quarter circle, accurate to 1e-12 of CE90 for any ratio of the axes."""
_FARTHEST = 40.0
"""Upper end of the interval in which the radius of a 90 % error is searched, in standard deviations."""


@dataclass(frozen=True)
class Accuracy:
    """90 % errors of a set of ground points in plan and height.

    Attributes
    ----------
    ce90 : float
        Horizontal radius that holds 90 % of the errors, in metres.
    le90 : float
        Half width of the height interval that holds 90 % of the errors, in metres.
    count : int
        Number of points.
    """

    ce90: float
    le90: float
    count: int


def level_axes(points: Array) -> Array:
    """Return the east, north and up axes at m points (m, 3) as rows, (m, 3, 3); points and axes are in ITRS."""
    up = vertical(points)
    east = np.cross([0.0, 0.0, 1.0], up)
    east = east / np.linalg.norm(east, axis=1, keepdims=True)
    return np.stack([east, np.cross(up, east), up], axis=1)


def linear_error(variance: ArrayLike, probability: float = _SHARE) -> Array:
    """Return the half width of the zero-centred interval that holds a given fraction of normally distributed errors.

    For a probability of 0.9 it is LE90.

    Parameters
    ----------
    variance : array_like
        Variances, of any shape.
    probability : float
        Share of the errors within the interval, between 0 and 1.

    Returns
    -------
    ndarray
        Half widths in the unit of the standard deviation; for 0.9 they are 1.645 sigma.

    Raises
    ------
    ValueError
        A negative variance, or a probability out of range.

    Examples
    --------
    LE90 of a height with a standard deviation of 2 m is 1.645 x 2 m:

    >>> import analysis
    >>> round(float(analysis.linear_error(2.0**2)), 3)
    3.29
    """
    variances = np.asarray(variance, np.float64)
    if not 0.0 < probability < 1.0 or not np.all(variances >= 0.0):
        raise ValueError(f"linear error: need variances >= 0 and a probability between 0 and 1, found {probability}")
    return np.asarray(float(ndtri(0.5 + 0.5 * probability)) * np.sqrt(variances))


def circular_error(covariance: ArrayLike, probability: float = _SHARE) -> Array:
    """Return the radius of the zero-centred circle that holds a given fraction of normal errors in the plane.

    For a probability of 0.9 it is CE90: 2.146 sigma for a circular covariance, 1.645 sigma for a degenerate one (along
    a line).

    Parameters
    ----------
    covariance : (..., 2, 2) array_like
        Covariance of the errors.
    probability : float
        Fraction of the errors within the circle, between 0 and 1.

    Returns
    -------
    (...) ndarray
        Radius, in the unit of the square root of the covariance.

    Raises
    ------
    ValueError
        The share is not between 0 and 1, or a covariance has a negative variance.

    Examples
    --------
    CE90 of 1 m in each axis is 2.146 m; of an error along one direction alone it is 1.645 m:

    >>> import numpy as np
    >>> import analysis
    >>> np.round(analysis.circular_error([np.eye(2), np.diag([1.0, 0.0])]), 3)
    array([2.146, 1.645])
    >>> round(float(analysis.circular_error(np.eye(2), 0.5)), 4)
    1.1774
    """
    values = _axes(covariance, probability)
    longer = np.sqrt(values[..., 1])
    ratio = np.divide(values[..., 0], values[..., 1], out=np.ones_like(longer), where=longer > 0.0)

    def missing(radius: Array, short: Array) -> Array:
        return probability - _within(radius, np.stack([short, np.ones_like(short)], axis=-1))

    root = elementwise.find_root(missing, (np.zeros_like(ratio), np.full_like(ratio, _FARTHEST)), args=(ratio,))
    return np.asarray(longer * root.x)


def circle_of_points(covariance: Array) -> float:
    """Return the radius, in metres, that holds 90 % of the horizontal errors of a whole set of points (CE90).

    The errors are normal with covariances (m, 2, 2) of the m points, in m^2; every point counts alike.
    """
    values = _axes(covariance, _SHARE)

    def missing(radius: float) -> float:
        return float(np.mean(_within(radius, values))) - _SHARE

    return float(brentq(missing, 0.0, _FARTHEST * float(np.sqrt(values.max())), xtol=1e-9))


def interval_of_points(variance: Array) -> float:
    """Return the half width, in metres, that holds 90 % of the height errors of a whole set of points (LE90).

    The errors are normal with variances (m,) of the m points, in m^2; every point counts alike.
    """
    sigma = np.sqrt(np.maximum(variance, 1e-300))

    def missing(size: float) -> float:
        return float(np.mean(erf(size / sigma / np.sqrt(2.0)))) - _SHARE

    return float(brentq(missing, 0.0, _FARTHEST * float(sigma.max()), xtol=1e-9))


def predicted(points: Array, covariance: Array) -> Accuracy:
    """Return the 90 % errors in plan and height (CE90, LE90) that the covariances of m points predict.

    Points (m, 3) are in metres and covariances (m, 3, 3) in m^2, ITRS.
    """
    axes = level_axes(points)
    level = axes @ covariance @ np.swapaxes(axes, 1, 2)
    return Accuracy(circle_of_points(level[:, :2, :2]), interval_of_points(level[:, 2, 2]), len(points))


def realised(points: Array, error: Array) -> Accuracy:
    """Return the 90 % errors in plan and height (CE90, LE90) of m points as sample quantiles of their actual errors.

    Points and errors, both (m, 3), are in ITRS, in metres.
    """
    level = np.einsum("nij,nj->ni", level_axes(points), error)
    plan, height = np.linalg.norm(level[:, :2], axis=1), np.abs(level[:, 2])
    return Accuracy(float(np.quantile(plan, _SHARE)), float(np.quantile(height, _SHARE)), len(points))


def _axes(covariance: ArrayLike, share: float) -> Array:
    """Return the (..., 2) variances along the principal axes of horizontal error ellipses, the smaller first."""
    if not 0.0 < share < 1.0:
        raise ValueError("a share lies between 0 and 1")
    values = np.linalg.eigvalsh(np.asarray(covariance, np.float64))
    if not np.all(values >= -1e-12 * np.abs(values[..., -1:])):
        raise ValueError("a covariance has no negative variances")
    return np.asarray(np.maximum(values, 0.0))


def _within(radius: ArrayLike, variances: Array) -> Array:
    """Return the fraction of two-dimensional normal errors, given by variances along two axes, within circles.

    In units of the axes the errors are isotropic: directions are uniform, and the length follows a Rayleigh
    distribution. In the direction with angle phi from the first axis, the circle of radius R becomes an ellipse of
    radius R / sqrt(a cos^2 phi + b sin^2 phi), for variances a and b along the axes.
    """
    along = variances[..., :1] * np.sin(_DIRECTIONS) ** 2 + variances[..., 1:] * np.cos(_DIRECTIONS) ** 2
    square = np.asarray(radius, np.float64)[..., None] ** 2
    return np.asarray(np.mean(-np.expm1(-0.5 * square / np.maximum(along, 1e-300)), axis=-1))
