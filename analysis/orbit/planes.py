"""Planes in which CCD lines photograph at one moment, and their angles.

The equations are (1) to (5), and for the angles (6) and (7), of paper 000 (Liu and Huang 2014).

**Plane.** The station O and the n >= 3 ground points of the strip that one line sees lie in one plane except for their
errors. Three fits have the same interface:

- ``printed``: z = a0 x + a1 y + a2 through O, with eq. 5 as the paper prints it. Its right side has the wrong sign, so
  both slopes come out negated: the normal (-a0, -a1, -1) is the true one rotated by 180 deg about the frame's z axis.
  This rotation is the same for every plane in the frame, hence angles between printed planes are right to rounding,
  while the plane itself misses its points by as much as the camera's height.
- ``corrected``: the same with the right sign. It minimises distances along z, not from the plane. The two agree to
  second order of the noise unless the plane is nearly vertical in the frame: then x - x0 and y - y0 of the strip lie on
  one line, only noise separates them, and the slopes are biased toward zero. `PlaneFit.near_vertical` reports this,
  with a `NearVerticalWarning`; an exactly vertical plane is an error.
- ``tls``: total least squares, the right singular vector of the smallest singular value of the points from O, whitened
  by their sigmas and by the error of O that they share. It does not depend on the frame. With isotropic errors it is
  the maximum-likelihood normal (Van Huffel and Vandewalle, The Total Least Squares Problem, 1991, section 8.4); with
  full covariances Gauss-Helmert steps lead from there to it.

All coordinates are in one Cartesian frame (Earth-fixed, local or orbital), in metres.

**Angles.** alpha is the angle between the forward and the nadir plane, beta that between the nadir and the backward
plane; both are acute and positive. Any other pair of lines, such as the nadir and a high-resolution line, has an angle
in the same way. The paper's form is arccos |a . b|; its rounding error grows as 1/sin(angle) and exceeds angles below
1e-8 rad, so the value used here is atan2(|a x b|, |a . b|), accurate to rounding at every angle.

The sigmas come from first-order propagation. All planes pass through one station, whose error they share, and alpha and
beta share the nadir plane, so their errors are correlated: the result is a joint covariance.

Three different angles are in use. The planes give the **dihedral** angle. The **look** angle is that between the lines
of sight of the lines' centres. They are equal if the CCD lines are parallel and start at the same position across the
track; a line rotated by k about its line of sight makes cos(dihedral) = cos(k) cos(look), a dihedral angle larger by
k^2 / (2 tan(look)). Both are unsigned, so that for nearly parallel lines k and the offset across the track determine
them, and noise folds them at zero. The **along-track** angle is the rotation about the lines' direction that takes one
central ray to the other: signed, zero for lines that look in the same direction, and not folded. It is the part that
determines heights, and for lines far apart it is the look angle.

**Sensitivity.** The station, or all points of one strip, are moved along one axis of the frame by 0-10 m. The change of
the angles comes from exact recomputation and from the linear derivative.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis import statistics
from analysis.arrays import ARCSEC, Array, MeasurementError

Method = Literal["printed", "corrected", "tls"]
METHODS: tuple[Method, ...] = get_args(Method)
_LEAST_SPREAD = 10.0
"""Smallest spread of the points across their line of sight, in sigmas, that determines the rotation of the plane about
the line of sight.
"""
# Eq. 5 counts as nearly vertical if its bias exceeds `_BIAS` sigmas, or if noise makes up more than `_ATTENUATION` of
# its normal matrix.
_BIAS, _ATTENUATION = 0.1, 0.01
_SINGULAR = 1e15
"""Largest condition number of a normal matrix in float64 whose smallest eigenvalue still has a correct digit; a worse
one counts as singular.
"""


class PlaneError(MeasurementError, ValueError):
    """Error raised for points that do not determine a plane, or not in the requested form."""


class NearVerticalWarning(UserWarning):
    """Warning that a plane is so steep in its frame that the fit of z = a0 x + a1 y + a2 is biased."""


@dataclass(frozen=True, eq=False)
class Station:
    """Perspective centre at the moment of exposure.

    Attributes
    ----------
    position : (3,) ndarray
        Coordinates, in metres.
    covariance : (3, 3) ndarray
        Covariance of the coordinates, in m^2; zero if error-free.
    """

    position: Array
    covariance: Array

    @classmethod
    def of(cls, position: ArrayLike, noise: ArrayLike = 0.0) -> Station:
        """Return a station after checking coordinates and covariance.

        Parameters
        ----------
        position : (3,) array_like
            Coordinates, in metres.
        noise : float or (3, 3) array_like
            Standard deviation of each coordinate in metres, or the covariance in m^2.

        Raises
        ------
        PlaneError
            A shape is wrong, a value is not finite, or the covariance is not positive semidefinite.
        """
        coordinates = np.array(position, np.float64)
        if coordinates.shape != (3,) or not np.all(np.isfinite(coordinates)):
            raise PlaneError(f"station: need three finite coordinates, found {position!r}")
        return cls(coordinates, _covariances(noise, 1, "station", definite=False)[0])


@dataclass(frozen=True, eq=False)
class Strip:
    """Ground points, n of them, that one CCD line sees at one moment; errors of different points are independent.

    Attributes
    ----------
    points : (n, 3) ndarray
        Coordinates, in metres.
    covariance : (n, 3, 3) ndarray
        Covariance of each point, in m^2, positive definite.
    """

    points: Array
    covariance: Array

    @classmethod
    def of(cls, points: ArrayLike, noise: ArrayLike) -> Strip:
        """Return a strip of ground points after checking coordinates and covariances.

        Parameters
        ----------
        points : (n, 3) array_like
            Coordinates of the n points, in metres.
        noise : float, (n,), (3, 3) or (n, 3, 3) array_like
            Standard deviation of each coordinate in metres, or the covariance in m^2.

        Raises
        ------
        PlaneError
            A shape is wrong, a value is not finite, or a covariance is not positive definite.
        """
        coordinates = np.array(points, np.float64)
        if coordinates.ndim != 2 or coordinates.shape[1] != 3:
            raise PlaneError(f"strip: points must be (n, 3), found {coordinates.shape}")
        if not np.all(np.isfinite(coordinates)):
            raise PlaneError("strip: coordinates must be finite; exclude points that were not measured")
        return cls(coordinates, _covariances(noise, len(coordinates), "strip", definite=True))

    def shifted(self, shift: ArrayLike) -> Strip:
        """Return the strip with all points moved by `shift` (3,), in metres."""
        return Strip(self.points + np.asarray(shift, np.float64), self.covariance)


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """Plane through a station, fitted to the ground points of one CCD line.

    Attributes
    ----------
    method : {'printed', 'corrected', 'tls'}
        Method of the fit: equation 5 of paper 000 (Liu and Huang 2014) as printed or with the corrected sign, or total
        least squares.
    station : Station
        Station that the plane contains.
    strip : Strip
        Points that the plane was fitted to.
    normal : (3,) ndarray
        Unit normal, z component negative (or zero) like the paper's (a0, a1, -1).
    point_gain : (n, 3, 3) ndarray
        Derivative of the unit normal with respect to the coordinates of each of n points, 1/m, to first order of the
        residuals.
    residual : (n,) ndarray
        Distance of the points from the plane along the normal, in metres.
    chi_square : float
        Chi-square of the residuals with the points' and the station's covariance; n - 2 degrees of freedom.
    condition : float
        Condition number of the normal matrix: that of eq. 5, or for tls that of the rotations about the two directions
        in the plane.
    attenuation : float
        Fraction of the smallest eigenvalue of eq. 5's normal matrix that is due to noise, by which the slope in that
        direction is too small; 0 for tls.
    bias : (3,) ndarray
        Estimated error of the normal caused by the attenuation, in radians; zero for tls.
    """

    method: Method
    station: Station
    strip: Strip
    normal: Array
    point_gain: Array
    residual: Array
    chi_square: float
    condition: float
    attenuation: float
    bias: Array

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of the residuals of n points: n - 2."""
        return len(self.residual) - 2

    @property
    def p_value(self) -> float:
        """p-value of the chi-square; exact for tls, slightly too small for the explicit forms."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    @property
    def station_gain(self) -> Array:
        """Derivative (3, 3) of the unit normal with respect to the station's coordinates, 1/m.

        It is minus the derivative for a common shift of all points.
        """
        return np.asarray(-self.point_gain.sum(axis=0))

    @property
    def point_covariance(self) -> Array:
        """Covariance (3, 3) of the unit normal due to the points' errors alone, in rad^2.

        This part is independent between strips.
        """
        gain = self.point_gain
        return np.asarray(np.einsum("nij,njk,nlk->il", gain, self.strip.covariance, gain))

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of the unit normal due to errors of points and station, in rad^2, of rank two."""
        gain = self.station_gain
        return np.asarray(self.point_covariance + gain @ self.station.covariance @ gain.T)

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """Coefficients a0, a1, a2 (a2 in metres) of the plane's equation z = a0 x + a1 y + a2.

        PlaneError is raised for an exactly vertical plane.
        """
        if self.normal[2] == 0.0:
            raise PlaneError("plane: it is vertical in this frame and has no form z = a0 x + a1 y + a2")
        a0, a1 = (float(v) for v in -self.normal[:2] / self.normal[2])
        x, y, z = (float(v) for v in self.station.position)
        return a0, a1, z - a0 * x - a1 * y

    @property
    def near_vertical(self) -> bool:
        """True if the plane is so steep in its frame that the form z = a0 x + a1 y + a2 is biased; never for tls."""
        shift = float(np.linalg.norm(self.bias))
        along = self.bias / shift if shift > 0 else self.bias
        sigma = float(np.sqrt(along @ self.covariance @ along))
        return self.attenuation > _ATTENUATION or shift > _BIAS * sigma


def fit_plane(station: Station, strip: Strip, method: Method = "tls") -> PlaneFit:
    """Fit a plane through the station to the ground points of one CCD line.

    The methods are total least squares (tls) and z = a0 x + a1 y + a2 by eq. 5 of paper 000 (Liu and Huang 2014), with
    the printed or the corrected sign.

    Raises
    ------
    PlaneError
        There are fewer than three points, the points lie at one place or on one line through the station (within ten
        sigmas), or an explicit form is requested of an exactly vertical plane.

    Warns
    -----
    NearVerticalWarning
        An explicit form is biased because the plane is nearly vertical.
    """
    if method not in METHODS:
        raise PlaneError(f"plane: method must be one of {', '.join(METHODS)}, found {method!r}")
    arm = strip.points - station.position
    _check_points(arm, strip)
    fit = _total(station, strip, arm) if method == "tls" else _explicit(station, strip, arm, method)
    if fit.near_vertical:
        warnings.warn(
            f"plane: z = a0 x + a1 y + a2 is nearly vertical in this frame (|normal z| = {abs(fit.normal[2]):.2g},"
            f" condition {fit.condition:.2g}): noise is {100 * fit.attenuation:.2g}% of its normal matrix and biases"
            " the plane toward the horizontal; use total least squares or another frame",
            NearVerticalWarning,
            stacklevel=2,
        )
    return fit


def _explicit(station: Station, strip: Strip, arm: Array, method: Method) -> PlaneFit:
    """Fit the plane z = a0 x + a1 y + a2 by eqs. 1 and 5 of paper 000 (Liu and Huang 2014).

    ``method`` selects the sign of eq. 5: "printed", as in the paper, which is a misprint, or "corrected".
    """
    flat = arm[:, :2]
    matrix = flat.T @ flat
    condition = float(np.linalg.cond(matrix))
    if not condition < _SINGULAR:
        raise PlaneError(
            "plane: it is vertical in this frame, so eq. 5 is singular (condition number above 1e15); use total least"
            " squares or another frame"
        )
    slopes = np.linalg.solve(matrix, flat.T @ arm[:, 2])
    length = float(np.sqrt(1.0 + slopes @ slopes))
    normal = np.array([slopes[0], slopes[1], -1.0]) / length
    across = (np.eye(3) - np.outer(normal, normal))[:, :2]
    # the z error of a point is -length * (distance from the plane); `across` / length maps slopes to the normal
    gain = -across @ np.linalg.solve(matrix, flat.T)
    spread = strip.covariance.sum(axis=0) + len(arm) * station.covariance
    noise = np.linalg.solve(matrix, spread[:2, :2])
    shrink = np.linalg.solve(matrix, spread[:2, 2]) - noise @ slopes
    bias = across @ shrink / length
    fitted = normal
    if method == "printed":
        half_rotation = np.array([-1.0, -1.0, 1.0])
        fitted, gain, bias = half_rotation * normal, half_rotation[:, None] * gain, half_rotation * bias
    residual = arm @ fitted
    # a point moves the plane by its distance from the true plane, for the printed one, too
    point_gain = gain.T[:, :, None] * normal
    chi_square = float(residual @ _DistanceNoise.of(station, strip, fitted).weighted(residual))
    attenuation = float(np.max(np.linalg.eigvals(noise).real))
    return PlaneFit(method, station, strip, fitted, point_gain, residual, chi_square, condition, attenuation, bias)


def _total(station: Station, strip: Strip, arm: Array) -> PlaneFit:
    """Fit the plane by total least squares, with Gauss-Helmert steps if the covariances are not isotropic."""
    variance = np.trace(strip.covariance, axis1=1, axis2=2) / 3.0
    shared = float(np.trace(station.covariance)) / 3.0
    normal = np.linalg.svd(_DistanceNoise(variance, shared).white(arm), full_matrices=False)[2][2]
    isotropic = np.array_equal(strip.covariance, variance[:, None, None] * np.eye(3)) and np.array_equal(
        station.covariance, shared * np.eye(3)
    )
    if not isotropic:
        normal = _gauss_helmert(station, strip, arm, normal)
    if normal[2] > 0:
        normal = -normal
    noise = _DistanceNoise.of(station, strip, normal)
    basis = _tangent(normal)
    design = arm @ basis
    matrix = design.T @ noise.weighted(design)
    gain = -basis @ np.linalg.solve(matrix, noise.weighted(design).T)
    point_gain, residual = gain.T[:, :, None] * normal, arm @ normal
    quality = residual, float(residual @ noise.weighted(residual)), float(np.linalg.cond(matrix))
    return PlaneFit("tls", station, strip, normal, point_gain, *quality, 0.0, np.zeros(3))


def _gauss_helmert(station: Station, strip: Strip, arm: Array, normal: Array) -> Array:
    """Return the maximum-likelihood normal with full covariances.

    The conditions n . (p - O) = 0 are linearised at the adjusted points.
    """
    adjusted = arm
    for _ in range(20):
        basis = _tangent(normal)
        noise = _DistanceNoise.of(station, strip, normal)
        design = adjusted @ basis
        miss = arm @ normal
        step = -np.linalg.solve(design.T @ noise.weighted(design), design.T @ noise.weighted(miss))
        pull = noise.weighted(miss + design @ step)
        # corrections of the points, and of the station that all of them share
        adjusted = arm - np.einsum("nij,j,n->ni", strip.covariance, normal, pull)
        adjusted = adjusted - station.covariance @ normal * pull.sum()
        normal = normal + basis @ step
        normal = normal / np.linalg.norm(normal)
        if np.linalg.norm(step) < 1e-14:  # 2e-9 arcsec
            break
    return np.asarray(normal)


@dataclass(frozen=True, eq=False)
class _DistanceNoise:
    """Covariance of the distances of n points from a plane through the station, in m^2: diag(own) + shared.

    Attributes
    ----------
    independent : (n,) ndarray
        Variances from the points, in m^2.
    shared : float
        Variance from the station, common to all points, in m^2.
    """

    independent: Array
    shared: float

    @classmethod
    def of(cls, station: Station, strip: Strip, normal: Array) -> _DistanceNoise:
        independent = np.einsum("i,nij,j->n", normal, strip.covariance, normal)
        return cls(independent, float(normal @ station.covariance @ normal))

    def weighted(self, rows: Array) -> Array:
        """Return the inverse covariance of the n distances times a vector (n,) or k columns (n, k)."""
        weight = 1.0 / self.independent
        scaled = (rows.T * weight).T
        ratio = self.shared / (1.0 + self.shared * weight.sum())
        return np.asarray(scaled - ratio * np.multiply.outer(weight, scaled.sum(axis=0)))

    def white(self, rows: Array) -> Array:
        """Return k columns, (n, k), whitened by the symmetric root of the inverse covariance of the n distances."""
        unit = self.independent**-0.5
        total = float(unit @ unit)
        scaled = rows * unit[:, None]
        part = (1.0 - (1.0 + self.shared * total) ** -0.5) / total
        return np.asarray(scaled - part * np.outer(unit, unit @ scaled))


def _tangent(normal: Array) -> Array:
    """Return two orthonormal vectors perpendicular to a unit vector, as the columns of a (3, 2) array."""
    return np.asarray(np.linalg.svd(normal[None, :])[2][1:].T)


def _check_points(arm: Array, strip: Strip) -> None:
    """Raise PlaneError if the points do not fix a plane through the station."""
    if len(arm) < 3:
        raise PlaneError(f"plane: need three or more points on the strip, found {len(arm)}")
    distance = np.linalg.norm(arm, axis=1)
    sigma = float(np.sqrt(np.trace(strip.covariance, axis1=1, axis2=2).mean() / 3.0))
    if np.min(distance) <= _LEAST_SPREAD * sigma:
        raise PlaneError("plane: a point lies at the station; is it in the same frame and unit?")
    spread = np.linalg.svd(arm, compute_uv=False)[1] / np.sqrt(len(arm))
    if spread > _LEAST_SPREAD * sigma:
        return
    extent = float(np.max(np.linalg.norm(strip.points - strip.points.mean(axis=0), axis=1)))
    where = "at one place" if extent <= _LEAST_SPREAD * sigma else "on one line through the station"
    raise PlaneError(
        f"plane: all points lie {where}; they spread across the line of sight by {spread:.3g} m, and {_LEAST_SPREAD:g}"
        f" sigmas ({_LEAST_SPREAD * sigma:.3g} m) are needed to fix the rotation of the plane about it"
    )


def _covariances(noise: ArrayLike, count: int, owner: str, definite: bool) -> Array:
    """Return validated covariances of `count` points, (count, 3, 3), in m^2, from sigmas in metres or covariances."""
    values = np.asarray(noise, np.float64)
    if values.ndim == 0 or values.shape == (count,):
        if not np.all(np.isfinite(values)) or np.any(values < 0) or (definite and np.any(values == 0)):
            raise PlaneError(f"{owner}: sigmas must be finite and {'positive' if definite else 'not negative'}")
        return np.asarray(np.broadcast_to(values**2, (count,))[:, None, None] * np.eye(3))
    if values.shape not in ((3, 3), (count, 3, 3)):
        raise PlaneError(
            f"{owner}: noise must be a sigma, ({count},) sigmas, a covariance (3, 3) or ({count}, 3, 3), found"
            f" {values.shape}"
        )
    if not np.all(np.isfinite(values)) or not np.allclose(values, np.swapaxes(values, -1, -2), rtol=1e-9, atol=0):
        raise PlaneError(f"{owner}: a covariance must be finite and symmetric")
    least = np.linalg.eigvalsh(values)[..., 0]
    largest = np.abs(values).max(axis=(-2, -1))
    if np.any(least <= 0) if definite else np.any(least < -1e-12 * largest):
        raise PlaneError(f"{owner}: a covariance must be positive {'definite' if definite else 'semidefinite'}")
    return np.array(np.broadcast_to(values, (count, 3, 3)))


_FOLDED = 3.0
"""Ratio of an unsigned angle to its sigma below which its distribution is cut off at zero and no longer normal."""


class AngleError(MeasurementError, ValueError):
    """Error raised for planes or rays that determine no angle."""


@dataclass(frozen=True, eq=False)
class PlaneAngles:
    """Angles between m pairs of k planes.

    Attributes
    ----------
    values : (m,) ndarray
        Acute angles by atan2, in radians.
    printed : (m,) ndarray
        Acute angles by the arccos of paper 000 (Liu and Huang 2014), in radians.
    covariance : (m, m) ndarray
        Covariance from points and station, in rad^2.
    gradient : (m, k, 3) ndarray
        Derivative of each of the m angles, in radians, with respect to the unit normals of the k planes.
    folded : (m,) ndarray of bool
        True for an angle below three sigmas; its sigma is unreliable, because the angle cannot be negative.
    """

    values: Array
    printed: Array
    covariance: Array
    gradient: Array
    folded: NDArray[np.bool_]

    @property
    def sigma(self) -> Array:
        """Standard deviations of the m angles, (m,), in radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def angles_between(planes: Sequence[PlaneFit], pairs: Sequence[tuple[int, int]]) -> PlaneAngles:
    """Return the acute angles between pairs of planes through one station, with their joint covariance.

    Parameters
    ----------
    planes : sequence of PlaneFit
        Planes fitted by one method through one station.
    pairs : sequence of (int, int)
        Indices into `planes`.

    Raises
    ------
    AngleError
        The planes belong to different stations or methods, or two planes coincide.
    """
    for plane in planes[1:]:
        if plane.method != planes[0].method:
            raise AngleError(
                f"angles: a plane of method {planes[0].method} cannot be compared with one of {plane.method}"
            )
    station = _common_station(planes)
    normals = np.array([plane.normal for plane in planes])
    values, printed = np.empty(len(pairs)), np.empty(len(pairs))
    gradient = np.zeros((len(pairs), len(planes), 3))
    for row, (i, j) in enumerate(pairs):
        a, b = normals[i], normals[j]
        dot, sine = float(a @ b), float(np.linalg.norm(np.cross(a, b)))
        if sine < 1e-14:
            raise AngleError("angles: two planes coincide; the derivative of their angle is undefined")
        values[row] = np.arctan2(sine, abs(dot))
        printed[row] = np.arccos(min(abs(dot), 1.0))
        # moving one normal toward the other reduces the angle
        side = np.copysign(1.0, dot)
        gradient[row, i] = -(side * b - abs(dot) * a) / sine
        gradient[row, j] = -(side * a - abs(dot) * b) / sine
    covariance = _propagated(gradient, planes, station)
    folded = values < _FOLDED * np.sqrt(np.diag(covariance))
    return PlaneAngles(values, printed, covariance, gradient, folded)


def _common_station(planes: Sequence[PlaneFit]) -> Station:
    """Return the station through which all planes were fitted; raise AngleError for several."""
    first = planes[0].station
    for plane in planes[1:]:
        same = np.array_equal(plane.station.position, first.position)
        if not (same and np.array_equal(plane.station.covariance, first.covariance)):
            raise AngleError("angles: the planes must be fitted through one and the same station")
    return first


def _propagated(gradient: Array, planes: Sequence[PlaneFit], station: Station) -> Array:
    """Return the covariance of m quantities from their derivatives with respect to the unit normals of k planes.

    Derivatives `gradient` are (m, k, 3), the covariance (m, m).
    """
    points = np.array([plane.point_covariance for plane in planes])
    shared = np.einsum("mki,kij->mj", gradient, np.array([plane.station_gain for plane in planes]))
    from_points = np.einsum("mki,kij,lkj->ml", gradient, points, gradient)
    return np.asarray(from_points + shared @ station.covariance @ shared.T)


def intersection_angles(forward: PlaneFit, nadir: PlaneFit, backward: PlaneFit) -> PlaneAngles:
    """Return the angles alpha (forward, nadir) and beta (nadir, backward), eqs. 6 and 7, in this order.

    Raises
    ------
    AngleError
        The planes belong to different stations or methods, or two planes coincide.
    """
    return angles_between((forward, nadir, backward), ((0, 1), (1, 2)))


def off_axis_angle(line: PlaneFit, nadir: PlaneFit) -> PlaneAngles:
    """Return the unsigned off-axis angle (1,) of another line (such as multispectral) against the nadir line.

    The paper names it in its outlook. Both planes must belong to the same moment, hence the same station.

    Raises
    ------
    AngleError
        The planes belong to different stations or methods, or coincide.
    """
    return angles_between((line, nadir), ((0, 1),))


def look_angle(ray_a: ArrayLike, ray_b: ArrayLike) -> Array:
    """Return the angle between two lines of sight (..., 3) of any length, in radians, 0 to pi."""
    a, b = np.asarray(ray_a, np.float64), np.asarray(ray_b, np.float64)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def intersection_angle(
    first: ArrayLike, second: ArrayLike, station: ArrayLike, *, sigma: ArrayLike, station_sigma: float = 0.0
) -> tuple[float, float]:
    """Return the angle between the planes in which two line cameras see the ground, with its standard deviation.

    Each plane runs through the station and is fitted to the ground points of one line by total least squares.

    Parameters
    ----------
    first, second : (n, 3) array_like
        Ground points that each line sees at the moment of the station, in metres, at least three.
    station : (3,) array_like
        Perspective centre at that moment, in metres, in the same frame.
    sigma : float or array_like
        Standard deviation of the coordinates of the points, in metres: a number, or (n,) if both have n points.
    station_sigma : float
        Standard deviation of each coordinate of the station, in metres.

    Returns
    -------
    angle, sigma : float
        Acute angle between the planes, and its standard deviation, in radians.

    Raises
    ------
    ValueError
        Fewer than three points, points on one line through the station, coincident planes, values that are not finite.

    Notes
    -----
    Liu and Huang, Infrared and Laser Engineering 43(10) (2014), equations 5 to 7. `fit_plane` and `angles_between`
    of this module give the fits and the joint covariance of several angles.

    Examples
    --------
    Two lines that look 25 deg ahead and straight down from 500 km, with points known to 0.1 m over a 60 km swath:

    >>> import numpy as np
    >>> import analysis
    >>> across = np.linspace(-30e3, 30e3, 21)
    >>> ahead = 500e3 * np.tan(np.radians(25.0))
    >>> first = np.column_stack([np.full(21, ahead), across, np.zeros(21)])
    >>> second = np.column_stack([np.zeros(21), across, np.zeros(21)])
    >>> angle, sigma = analysis.intersection_angle(first, second, [0, 0, 500e3], sigma=0.1)
    >>> round(float(np.degrees(angle)), 6), round(float(np.degrees(sigma) * 3600), 3)
    (25.0, 0.012)
    """
    centre = Station.of(station, station_sigma)
    planes = [fit_plane(centre, Strip.of(points, sigma)) for points in (first, second)]
    angles = angles_between(planes, [(0, 1)])
    return float(angles.values[0]), float(angles.sigma[0])


@dataclass(frozen=True, eq=False)
class LineFrame:
    """Line of sight and direction of one CCD line.

    Attributes
    ----------
    central : (3,) ndarray
        Unit vector along the line of sight of the line's centre.
    side : (3,) ndarray
        Unit vector along the line in the direction in which the tangents rise, perpendicular to `central`.
    plane : PlaneFit
        Plane fitted to the line's points.
    variance : float
        Variance of the central ray out of the plane, in rad^2, in addition to that of the plane.
    """

    central: Array
    side: Array
    plane: PlaneFit
    variance: float

    @property
    def forward(self) -> Array:
        """Unit vector perpendicular to line of sight and CCD line, the vector product side x central.

        It points ahead if the tangents rise to the right of the track.
        """
        return np.asarray(np.cross(self.side, self.central))


def line_frame(plane: PlaneFit, tangent: ArrayLike, bend: float = 0.0) -> LineFrame:
    """Return the line of sight of a CCD line's centre and the line's direction, from plane and interior orientation.

    Parameters
    ----------
    plane : PlaneFit
        Plane fitted to the line's points. The method "printed" (the paper's equations as printed) is not allowed: its
        plane does not contain the points.
    tangent : (n,) array_like
        Tangent of the angle of each of the plane's n points from the line of sight along the CCD line, from its pixel
        number and the interior orientation; either sense of counting.
    bend : float
        Standard deviation, in radians, by which the ends of a line that was straight in the laboratory may have bent
        out of its plane since. The bend is estimated with this sigma as its prior, and the central ray follows it. 0:
        no bend.

    Raises
    ------
    AngleError
        The method is "printed", the tangents are not (n,) finite numbers, or they do not match the points.
    """
    if plane.method == "printed":
        raise AngleError("central ray: the printed plane does not contain its points")
    station: Station = plane.station
    strip: Strip = plane.strip
    w = np.asarray(tangent, np.float64)
    if w.shape != (len(strip.points),) or not np.all(np.isfinite(w)):
        raise AngleError(f"central ray: need {len(strip.points)} finite tangents, found {w.shape}")
    arm = strip.points - station.position
    middle = arm.mean(axis=0)
    middle = middle - (middle @ plane.normal) * plane.normal
    middle = middle / np.linalg.norm(middle)
    side = np.cross(plane.normal, middle)
    measured, interior = np.arctan2(arm @ side, arm @ middle), np.arctan(w)
    spread = interior - interior.mean()
    slope = float(spread @ (measured - measured.mean()) / (spread @ spread)) if np.any(spread) else 0.0
    if abs(abs(slope) - 1.0) > 0.1:
        raise AngleError(
            f"central ray: the angle between the points from their coordinates is {abs(slope):.3g} times that from the"
            " given tangents (1 is expected); check the tangents"
        )
    # the sigma of a point's angle is its sigma over its distance
    weight = np.sum(arm**2, axis=1) / np.trace(strip.covariance, axis1=1, axis2=2)
    rotation = float(np.sum(weight * (measured - np.copysign(1.0, slope) * interior)) / np.sum(weight))
    central = np.cos(rotation) * middle + np.sin(rotation) * side
    side = np.copysign(1.0, slope) * np.cross(plane.normal, central)
    if bend <= 0.0 or not np.any(spread):
        return LineFrame(central, side, plane, 0.0)
    off, variance = _off_plane(plane, arm, interior, bend)
    return LineFrame(np.cos(off) * central + np.sin(off) * plane.normal, side, plane, variance)


def _off_plane(plane: PlaneFit, arm: Array, interior: Array, bend: float) -> tuple[float, float]:
    """Return the angle by which a bent line's central ray leaves the fitted plane, in radians, and its variance."""
    distance = np.linalg.norm(arm, axis=1)
    spread = np.sqrt(np.einsum("i,nij,j->n", plane.normal, plane.strip.covariance, plane.normal)) / distance
    columns = np.column_stack([np.cos(interior), np.sin(interior), (interior / np.abs(interior).max()) ** 2])
    design = columns / spread[:, None]
    square = design.T @ design
    rigid = np.linalg.inv(square[:2, :2])[0, 0]
    square[2, 2] += bend**-2
    inverse = np.linalg.inv(square)
    off = inverse @ design.T @ (plane.residual / distance / spread)
    return float(off[0]), float(inverse[0, 0] - rigid)


@dataclass(frozen=True, eq=False)
class AlongTrackAngles:
    """Signed angles along the track between m pairs of lines.

    Attributes
    ----------
    values : (m,) ndarray
        Angles, in radians.
    covariance : (m, m) ndarray
        Covariance of the angles, in rad^2.
    """

    values: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations of the m angles, (m,), in radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def along_track_angle(central_a: ArrayLike, side_a: ArrayLike, central_b: ArrayLike, side_b: ArrayLike) -> float:
    """Return the signed angle, in radians, between the central rays of two lines, about their mean direction.

    It takes the second line's central ray to the first's: positive where the first looks ahead of the second, with the
    lines' directions pointing to the right of the track.

    Parameters
    ----------
    central_a : (3,) array_like
        Central ray of the first line, unit vector.
    side_a : (3,) array_like
        Direction of the first line, unit vector.
    central_b : (3,) array_like
        Central ray of the second line, unit vector.
    side_b : (3,) array_like
        Direction of the second line, unit vector.

    Raises
    ------
    AngleError
        The lines run in opposite directions.
    """
    first, second = np.asarray(central_a, np.float64), np.asarray(central_b, np.float64)
    axis = np.asarray(side_a, np.float64) + np.asarray(side_b, np.float64)
    length = float(np.linalg.norm(axis))
    if length < 1.0:
        raise AngleError(
            "along-track angle: the lines run in opposite directions; are pixels counted in the same direction?"
        )
    axis = axis / length
    return float(np.arctan2(axis @ np.cross(second, first), first @ second - (first @ axis) * (second @ axis)))


def along_track_angles(lines: Sequence[LineFrame], pairs: Sequence[tuple[int, int]]) -> AlongTrackAngles:
    """Return the signed angles between pairs of lines seen from one station, with their joint covariance.

    A plane that rotates about its line's direction moves its central ray by the same angle; rotations within a plane
    count only by the angle between the two lines, and are omitted from the covariance.

    Parameters
    ----------
    lines : sequence of LineFrame
        Lines seen from one station.
    pairs : sequence of (int, int)
        Indices into `lines`.

    Raises
    ------
    AngleError
        The lines belong to different stations, or run in opposite directions.
    """
    planes = [line.plane for line in lines]
    station = _common_station(planes)
    gradient = np.zeros((len(pairs), len(lines), 3))
    values, sign = np.empty(len(pairs)), np.zeros((len(pairs), len(lines)))
    for row, (i, j) in enumerate(pairs):
        a, b = lines[i], lines[j]
        values[row] = along_track_angle(a.central, a.side, b.central, b.side)
        for k, direction in ((i, 1.0), (j, -1.0)):
            line = lines[k]
            # rotating the plane forward moves the forward-pointing normal away from the central ray
            gradient[row, k] = -direction * line.central * np.copysign(1.0, line.plane.normal @ line.forward)
            sign[row, k] = direction
    variances = np.array([line.variance for line in lines])
    covariance = _propagated(gradient, planes, station) + (sign * variances) @ sign.T
    return AlongTrackAngles(values, covariance)


def height_error(
    angle_error: ArrayLike, slant_range: ArrayLike, convergence: ArrayLike, zenith: ArrayLike = 0.0
) -> Array:
    """Return the first-order error of intersected heights caused by an error of a look angle, in metres.

    The erroneous ray passes the ground point at the distance slant_range x angle_error, and so meets the other ray
    higher or lower. For a camera at height H over flat ground, against a nadir line: H angle_error / (sin a cos a).

    Parameters
    ----------
    angle_error : array_like
        Error of the look angle, in radians, of any shape.
    slant_range : array_like
        Distance of the ground point, in metres.
    convergence : array_like
        Angle between the rays on the ground, in radians.
    zenith : array_like
        Zenith angle of the other ray, in radians.

    Returns
    -------
    ndarray
        Error of the height, in metres.

    Examples
    --------
    One arcsecond of the angle between a line at 25 deg and the nadir line, from 500 km, is 6.3 m in height:

    >>> import numpy as np
    >>> import analysis
    >>> look, arcsec = np.radians(25.0), np.pi / 648000
    >>> round(float(analysis.height_error(arcsec, 500e3 / np.cos(look), look)), 2)
    6.33
    """
    along = np.asarray(slant_range) * np.asarray(angle_error) / np.sin(np.asarray(convergence, np.float64))
    return np.asarray(along * np.cos(np.asarray(zenith, np.float64)))


AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Response of m dihedral angles to a displacement of the station or of one strip along one axis.

    Attributes
    ----------
    angles : tuple of str
        Names of the angles.
    what : str
        "station", or the line whose points are moved.
    axis : {'x', 'y', 'z'}
        Axis of the displacement.
    amount : (k,) ndarray
        The k displacements, in metres.
    change : (m, k) ndarray
        Change of each of the m angles for each displacement, by repeating the fit, in radians.
    slope : (m,) ndarray
        Derivative of each angle with respect to the displacement, at zero displacement, in rad/m.
    """

    angles: tuple[str, ...]
    what: str
    axis: str
    amount: Array
    change: Array
    slope: Array

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary: what is moved, the axis, and the linear change of each angle for 10 m, in arcseconds."""
        answers = {
            f"{name}_arcsec_per_10m": float(s) * 10.0 / ARCSEC + 0.0
            for name, s in zip(self.angles, self.slope, strict=True)
        }
        return {"what": self.what, "axis": self.axis, **answers}


def sensitivity(
    station: Station,
    strips: Mapping[str, Strip],
    pairs: Mapping[str, tuple[str, str]],
    *,
    method: Method = "tls",
    amounts: ArrayLike | None = None,
) -> tuple[Sensitivity, ...]:
    """Return the sensitivity of the angles to the station and to the points of each strip, along x, y and z.

    Parameters
    ----------
    station : Station
        Station from which the strips are seen.
    strips : mapping of str to Strip
        Points of each line, by its name.
    pairs : mapping of str to (str, str)
        Two lines of each angle, by its name.
    method : {'printed', 'corrected', 'tls'}
        Method of the plane fit.
    amounts : (k,) array_like, optional
        Displacements, k of them, in metres, rising from 0; 0 to 10 m in steps of 1 m by default.

    Raises
    ------
    ValueError
        The displacements are not three or more rising numbers from 0.
    PlaneError
        A plane cannot be fitted.
    AngleError
        Two planes coincide.
    """
    steps = np.linspace(0.0, 10.0, 11) if amounts is None else np.asarray(amounts, np.float64)
    if steps.ndim != 1 or len(steps) < 3 or steps[0] != 0 or not np.all(np.diff(steps) > 0):
        raise ValueError("sensitivity: amounts must be three or more rising numbers, the first of them 0")
    order = list(strips)
    index = [(order.index(a), order.index(b)) for a, b in pairs.values()]
    fits = [fit_plane(station, strip, method) for strip in strips.values()]
    start = angles_between(fits, index)
    rows = []
    for what in ("station", *strips):
        indices = list(range(len(order))) if what == "station" else [order.index(what)]
        sign = 1.0 if what == "station" else -1.0
        derivative = sign * np.einsum(
            "mki,kij->mj", start.gradient[:, indices], np.array([fits[k].station_gain for k in indices])
        )
        for k, axis in enumerate(AXES):
            shifts = steps[:, None] * np.eye(3)[k]
            values = [angles_between(_moved(station, strips, fits, what, s, method), index).values for s in shifts]
            change = np.array(values).T - start.values[:, None]
            rows.append(Sensitivity(tuple(pairs), what, axis, steps, change, derivative[:, k]))
    return tuple(rows)


def _moved(
    station: Station, strips: Mapping[str, Strip], fits: list[PlaneFit], what: str, shift: Array, method: Method
) -> list[PlaneFit]:
    """Return the planes after a displacement, fitting again only those that it affects."""
    if what == "station":
        moved = Station(station.position + shift, station.covariance)
        return [fit_plane(moved, strip, method) for strip in strips.values()]
    return [
        fit_plane(station, strip.shifted(shift), method) if name == what else fit
        for (name, strip), fit in zip(strips.items(), fits, strict=True)
    ]
