"""The plane in which one CCD line photographs at one moment, from ground points on its strip (paper 000, eqs. 1-5).

The station O and the n >= 3 points of the strip lie in one plane but for their errors. Three fits with one interface:

- ``printed``: z = a0 x + a1 y + a2 through O, with eq. 5 as the paper prints it. Its right side has the wrong sign, so
  both slopes come out negated: the normal (-a0, -a1, -1) is the true one after half a turn about the frame's z axis.
  The half turn is the same for every plane in the frame, hence angles between printed planes are right to rounding,
  while the plane itself misses its points by as much as the camera's height.
- ``corrected``: the same with the right sign. It minimises distances along z, not from the plane. The two agree to
  second order of the noise unless the plane is nearly vertical in the frame: then x - x0 and y - y0 of the strip lie on
  one line, only noise tells them apart, and the slopes are biased toward zero. `PlaneFit.near_vertical` says so, with a
  `NearVerticalWarning`; an exactly vertical plane is an error.
- ``tls``: total least squares, the right singular vector of the smallest singular value of the points from O, whitened
  by their sigmas and by the error of O that they share. The frame plays no part. With isotropic errors it is the
  maximum-likelihood normal (Van Huffel and Vandewalle, The Total Least Squares Problem, 1991, section 8.4); with full
  covariances Gauss-Helmert steps from there lead to it.

All coordinates in one Cartesian frame (Earth-fixed, local or orbital), metres.

Intersection angles of line cameras from the planes in which they photograph (paper 000, eqs. 6-7), and their errors.

alpha is the angle between the forward and the nadir plane, beta between the nadir and the backward plane; both acute
and positive. Any other pair of lines, such as the nadir and a high-resolution line, has an angle in the same way. The
paper's form is arccos |a . b|; its rounding error grows as 1/sin(angle) and swallows angles below
1e-8 rad, so the value used here is atan2(|a x b|, |a . b|), good to rounding at every angle.

The sigmas come from first-order propagation. All planes pass through one station, whose error they share, and alpha
and beta share the nadir plane, so their errors are correlated: the result is a joint covariance.

Three angles bear the name. The planes give the **dihedral** angle. The **look** angle lies between the lines of sight
of the lines' centres. They are equal when the CCD lines are parallel and start at the same place across the track; a
line turned by k about its own line of sight makes cos(dihedral) = cos(k) cos(look), a dihedral angle larger by
k^2 / (2 tan(look)). Both are unsigned, so that for nearly parallel lines k and the offset across the track decide what
they are, and noise folds them at zero. The **along-track** angle is the turn about the lines' direction that takes one
central ray to the other: signed, zero for lines that look the same way, and not folded. It is the part that makes
heights, and for lines far apart the look angle.

One thing at a time, the station or all points of one strip, is moved along one axis of the frame by 0-10 m. The change
of the angles comes by exact recomputation and by the linear derivative.
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
# Points fix the turn of the plane about their line of sight when they spread across it by more than so many sigmas.
_LEAST_SPREAD = 10.0
# Eq. 5 is called nearly vertical when its bias is no longer small beside the sigma, or when noise makes up more than
# this part of its normal matrix.
_BIAS, _ATTENUATION = 0.1, 0.01
# A normal matrix of float64 sums keeps no digit of its smallest eigenvalue beyond this condition number.
_SINGULAR = 1e15


class PlaneError(MeasurementError, ValueError):
    """The points do not determine the plane, or not in the form that was asked for."""


class NearVerticalWarning(UserWarning):
    """The plane is so steep in its frame that z = a0 x + a1 y + a2 is biased."""


@dataclass(frozen=True, eq=False)
class Station:
    """Perspective centre at the moment of exposure. position: (3,) metres. covariance: (3, 3) m^2, zero if exact."""

    position: Array
    covariance: Array

    @classmethod
    def of(cls, position: ArrayLike, noise: ArrayLike = 0.0) -> Station:
        """noise: sigma of each coordinate in metres (a number), or the covariance (3, 3) in m^2. Raises PlaneError."""
        place = np.array(position, np.float64)
        if place.shape != (3,) or not np.all(np.isfinite(place)):
            raise PlaneError(f"station: need three finite coordinates, found {position!r}")
        return cls(place, _covariances(noise, 1, "station", definite=False)[0])


@dataclass(frozen=True, eq=False)
class Strip:
    """Ground points that one CCD line sees at one moment; errors of different points are independent.

    points: (n, 3) metres. covariance: (n, 3, 3) m^2, positive definite.
    """

    points: Array
    covariance: Array

    @classmethod
    def of(cls, points: ArrayLike, noise: ArrayLike) -> Strip:
        """noise: sigma of each coordinate in metres (a number or (n,)), or covariance (3, 3) or (n, 3, 3) in m^2."""
        place = np.array(points, np.float64)
        if place.ndim != 2 or place.shape[1] != 3:
            raise PlaneError(f"strip: points must be (n, 3), found {place.shape}")
        if not np.all(np.isfinite(place)):
            raise PlaneError("strip: coordinates must be finite; leave out points that were not found")
        return cls(place, _covariances(noise, len(place), "strip", definite=True))

    def shifted(self, shift: ArrayLike) -> Strip:
        """The strip with all points moved by `shift` (3,) metres."""
        return Strip(self.points + np.asarray(shift, np.float64), self.covariance)


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """A plane through the station.

    normal: (3,) unit vector, z component negative (or zero) like the paper's (a0, a1, -1).
    point_gain: (n, 3, 3) derivative of the normal with respect to each point, 1/m, to first order of the residuals.
    residual: (n,) distance of the points from the plane along the normal, metres.
    chi_square: of the residuals with the points' and the station's covariance. degrees_of_freedom: n - 2.
    condition: of the normal matrix: eq. 5's, or for tls that of the turns about the two directions in the plane.
    attenuation: part of eq. 5's normal matrix in its weakest direction that is noise, by which the slope there shrinks;
        0 for tls. bias: (3,) estimate of the error of the normal that comes from it, radians; zero for tls.
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
        """Degrees of freedom of the residuals."""
        return len(self.residual) - 2

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one. Exact for tls; the explicit forms leave a little more."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    @property
    def station_gain(self) -> Array:
        """(3, 3) derivative of the normal with respect to the station, 1/m: minus that of all points moved together."""
        return np.asarray(-self.point_gain.sum(axis=0))

    @property
    def point_covariance(self) -> Array:
        """(3, 3) of the normal from the errors of the points alone, rad^2; independent from strip to strip."""
        gain = self.point_gain
        return np.asarray(np.einsum("nij,njk,nlk->il", gain, self.strip.covariance, gain))

    @property
    def covariance(self) -> Array:
        """(3, 3) of the normal, rad^2, of rank two: points and station."""
        gain = self.station_gain
        return np.asarray(self.point_covariance + gain @ self.station.covariance @ gain.T)

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """a0, a1, a2 of z = a0 x + a1 y + a2, a2 by eq. 1. Raises PlaneError for an exactly vertical plane."""
        if self.normal[2] == 0.0:
            raise PlaneError("plane: it is vertical in this frame and has no form z = a0 x + a1 y + a2")
        a0, a1 = (float(v) for v in -self.normal[:2] / self.normal[2])
        x, y, z = (float(v) for v in self.station.position)
        return a0, a1, z - a0 * x - a1 * y

    @property
    def near_vertical(self) -> bool:
        """True when the explicit form is biased by the steepness of the plane in its frame. Never for tls."""
        shift = float(np.linalg.norm(self.bias))
        along = self.bias / shift if shift > 0 else self.bias
        sigma = float(np.sqrt(along @ self.covariance @ along))
        return self.attenuation > _ATTENUATION or shift > _BIAS * sigma


def fit_plane(station: Station, strip: Strip, method: Method = "tls") -> PlaneFit:
    """Plane through the station fitted to the strip's points; see the module for the methods.

    Raises PlaneError for fewer than three points, points that lie at one place or on one line through the station
        (within ten sigmas), and an explicit form of an exactly vertical plane. Warns with NearVerticalWarning.
    """
    if method not in METHODS:
        raise PlaneError(f"plane: method must be one of {', '.join(METHODS)}, found {method!r}")
    arm = strip.points - station.position
    _check_points(arm, strip)
    fit = _total(station, strip, arm) if method == "tls" else _explicit(station, strip, arm, method)
    if fit.near_vertical:
        warnings.warn(
            f"plane: z = a0 x + a1 y + a2 is nearly vertical in this frame (|normal z| = {abs(fit.normal[2]):.2g},"
            f" condition {fit.condition:.2g}): noise is {100 * fit.attenuation:.2g}% of its normal matrix and turns the"
            " plane toward the horizontal; use total least squares or another frame",
            NearVerticalWarning,
            stacklevel=2,
        )
    return fit


def _explicit(station: Station, strip: Strip, arm: Array, method: Method) -> PlaneFit:
    """Eqs. 1 and 5, with the printed or the right sign."""
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
    # slopes answer to z errors -length * (distance from the plane); the normal to slopes by `across` / length
    gain = -across @ np.linalg.solve(matrix, flat.T)
    spread = strip.covariance.sum(axis=0) + len(arm) * station.covariance
    noise = np.linalg.solve(matrix, spread[:2, :2])
    shrink = np.linalg.solve(matrix, spread[:2, 2]) - noise @ slopes
    bias = across @ shrink / length
    seen = normal
    if method == "printed":
        half_turn = np.array([-1.0, -1.0, 1.0])
        seen, gain, bias = half_turn * normal, half_turn[:, None] * gain, half_turn * bias
    residual = arm @ seen
    return PlaneFit(
        method=method,
        station=station,
        strip=strip,
        normal=seen,
        # what moves the plane is how far a point leaves the true plane, also where the printed one lies elsewhere
        point_gain=gain.T[:, :, None] * normal,
        residual=residual,
        chi_square=float(residual @ _DistanceNoise.of(station, strip, seen).weighted(residual)),
        condition=condition,
        attenuation=float(np.max(np.linalg.eigvals(noise).real)),
        bias=bias,
    )


def _total(station: Station, strip: Strip, arm: Array) -> PlaneFit:
    """Total least squares; Gauss-Helmert steps where the covariances are not isotropic."""
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
    residual = arm @ normal
    return PlaneFit(
        method="tls",
        station=station,
        strip=strip,
        normal=normal,
        point_gain=gain.T[:, :, None] * normal,
        residual=residual,
        chi_square=float(residual @ noise.weighted(residual)),
        condition=float(np.linalg.cond(matrix)),
        attenuation=0.0,
        bias=np.zeros(3),
    )


def _gauss_helmert(station: Station, strip: Strip, arm: Array, normal: Array) -> Array:
    """Maximum-likelihood normal with full covariances: conditions n . (p - O) = 0 linearised at the adjusted points."""
    adjusted = arm
    for _ in range(20):
        basis = _tangent(normal)
        noise = _DistanceNoise.of(station, strip, normal)
        design = adjusted @ basis
        miss = arm @ normal
        step = -np.linalg.solve(design.T @ noise.weighted(design), design.T @ noise.weighted(miss))
        pull = noise.weighted(miss + design @ step)
        # corrections of the points, and of the station that all arms share
        adjusted = arm - np.einsum("nij,j,n->ni", strip.covariance, normal, pull)
        adjusted = adjusted - station.covariance @ normal * pull.sum()
        normal = normal + basis @ step
        normal = normal / np.linalg.norm(normal)
        if np.linalg.norm(step) < 1e-14:  # 2e-9 arcsec
            break
    return np.asarray(normal)


@dataclass(frozen=True, eq=False)
class _DistanceNoise:
    """Errors of the points' distances from a plane through the station: covariance diag(own) + shared, m^2.

    own: (n,) variances from the points. shared: variance from the station, common to all.
    """

    own: Array
    shared: float

    @classmethod
    def of(cls, station: Station, strip: Strip, normal: Array) -> _DistanceNoise:
        own = np.einsum("i,nij,j->n", normal, strip.covariance, normal)
        return cls(own, float(normal @ station.covariance @ normal))

    def weighted(self, rows: Array) -> Array:
        """Inverse covariance times (n,) or (n, k), by the Sherman-Morrison formula."""
        weight = 1.0 / self.own
        scaled = (rows.T * weight).T
        ratio = self.shared / (1.0 + self.shared * weight.sum())
        return np.asarray(scaled - ratio * np.multiply.outer(weight, scaled.sum(axis=0)))

    def white(self, rows: Array) -> Array:
        """Symmetric-root form of the inverse covariance times (n, k): rows with independent unit errors."""
        unit = self.own**-0.5
        total = float(unit @ unit)
        scaled = rows * unit[:, None]
        part = (1.0 - (1.0 + self.shared * total) ** -0.5) / total
        return np.asarray(scaled - part * np.outer(unit, unit @ scaled))


def _tangent(normal: Array) -> Array:
    """(3, 2) orthonormal columns square to a unit vector."""
    return np.asarray(np.linalg.svd(normal[None, :])[2][1:].T)


def _check_points(arm: Array, strip: Strip) -> None:
    """PlaneError when the points do not fix a plane through the station."""
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
        f" sigmas ({_LEAST_SPREAD * sigma:.3g} m) are needed to tell how the plane is turned about it"
    )


def _covariances(noise: ArrayLike, count: int, owner: str, definite: bool) -> Array:
    """(count, 3, 3) from sigmas or covariances."""
    given = np.asarray(noise, np.float64)
    if given.ndim == 0 or given.shape == (count,):
        if not np.all(np.isfinite(given)) or np.any(given < 0) or (definite and np.any(given == 0)):
            raise PlaneError(f"{owner}: sigmas must be finite and {'positive' if definite else 'not negative'}")
        return np.asarray(np.broadcast_to(given**2, (count,))[:, None, None] * np.eye(3))
    if given.shape not in ((3, 3), (count, 3, 3)):
        raise PlaneError(
            f"{owner}: noise must be a sigma, ({count},) sigmas, a covariance (3, 3) or ({count}, 3, 3), found"
            f" {given.shape}"
        )
    if not np.all(np.isfinite(given)) or not np.allclose(given, np.swapaxes(given, -1, -2), rtol=1e-9, atol=0):
        raise PlaneError(f"{owner}: a covariance must be finite and symmetric")
    least = np.linalg.eigvalsh(given)[..., 0]
    largest = np.abs(given).max(axis=(-2, -1))
    if np.any(least <= 0) if definite else np.any(least < -1e-12 * largest):
        raise PlaneError(f"{owner}: a covariance must be positive {'definite' if definite else 'semidefinite'}")
    return np.array(np.broadcast_to(given, (count, 3, 3)))


# Below so many sigmas an angle, which cannot be negative, is no longer normally distributed.
_FOLDED = 3.0


class AngleError(MeasurementError, ValueError):
    """Planes or rays have no angle that could be told."""


@dataclass(frozen=True, eq=False)
class PlaneAngles:
    """Angles between pairs of planes.

    values: (m,) acute angles by atan2, radians. printed: (m,) the same by the paper's arccos.
    covariance: (m, m) rad^2, points and station.
    gradient: (m, k, 3) derivative of each angle with respect to the unit normals of the k planes.
    folded: (m,) the angle is below three sigmas; its sigma then says little, for it cannot be negative.
    """

    values: Array
    printed: Array
    covariance: Array
    gradient: Array
    folded: NDArray[np.bool_]

    @property
    def sigma(self) -> Array:
        """(m,) radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def angles_between(planes: Sequence[PlaneFit], pairs: Sequence[tuple[int, int]]) -> PlaneAngles:
    """Acute angles between pairs of planes through one station, with their joint covariance.

    pairs: indices into `planes`. Raises AngleError when planes belong to different stations or methods, or coincide.
    """
    for plane in planes[1:]:
        if plane.method != planes[0].method:
            raise AngleError(f"angles: a {planes[0].method} and a {plane.method} plane have no angle in common")
    station = _common_station(planes)
    normals = np.array([plane.normal for plane in planes])
    values, printed = np.empty(len(pairs)), np.empty(len(pairs))
    gradient = np.zeros((len(pairs), len(planes), 3))
    for row, (i, j) in enumerate(pairs):
        a, b = normals[i], normals[j]
        dot, sine = float(a @ b), float(np.linalg.norm(np.cross(a, b)))
        if sine < 1e-14:
            raise AngleError("angles: two planes coincide; their angle has no direction to change in")
        values[row] = np.arctan2(sine, abs(dot))
        printed[row] = np.arccos(min(abs(dot), 1.0))
        # a step of one normal toward the other closes the angle
        side = np.copysign(1.0, dot)
        gradient[row, i] = -(side * b - abs(dot) * a) / sine
        gradient[row, j] = -(side * a - abs(dot) * b) / sine
    covariance = _propagated(gradient, planes, station)
    folded = values < _FOLDED * np.sqrt(np.diag(covariance))
    return PlaneAngles(values, printed, covariance, gradient, folded)


def _common_station(planes: Sequence[PlaneFit]) -> Station:
    """Through which all planes were fitted. Raises AngleError for several."""
    first = planes[0].station
    for plane in planes[1:]:
        same = np.array_equal(plane.station.position, first.position)
        if not (same and np.array_equal(plane.station.covariance, first.covariance)):
            raise AngleError("angles: the planes must be fitted through one and the same station")
    return first


def _propagated(gradient: Array, planes: Sequence[PlaneFit], station: Station) -> Array:
    """(m, m) covariance of what depends on the planes' normals, by `gradient` (m, k, 3), and on their station."""
    points = np.array([plane.point_covariance for plane in planes])
    shared = np.einsum("mki,kij->mj", gradient, np.array([plane.station_gain for plane in planes]))
    own = np.einsum("mki,kij,lkj->ml", gradient, points, gradient)
    return np.asarray(own + shared @ station.covariance @ shared.T)


def intersection_angles(forward: PlaneFit, nadir: PlaneFit, backward: PlaneFit) -> PlaneAngles:
    """Angles alpha (forward, nadir) and beta (nadir, backward), eqs. 6 and 7, in this order. Raises AngleError."""
    return angles_between((forward, nadir, backward), ((0, 1), (1, 2)))


def off_axis_angle(line: PlaneFit, nadir: PlaneFit) -> PlaneAngles:
    """Off-axis angle of another line (high-resolution, multispectral) against the nadir line, (1,); unsigned.

    The paper's outlook. Both planes must belong to the same moment, hence the same station. Raises AngleError.
    """
    return angles_between((line, nadir), ((0, 1),))


def look_angle(ray_a: ArrayLike, ray_b: ArrayLike) -> Array:
    """Angle between two lines of sight (..., 3) of any length, radians, 0 to pi."""
    a, b = np.asarray(ray_a, np.float64), np.asarray(ray_b, np.float64)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


@dataclass(frozen=True, eq=False)
class LineFrame:
    """Where one line looks; unit vectors (3,).

    central: along the line of sight of its centre. side: along the line, the way in which the tangents rise; square
        to `central`. plane: the fit. variance: of the central ray out of the plane, rad^2, beside the plane's own.
    """

    central: Array
    side: Array
    plane: PlaneFit
    variance: float

    @property
    def forward(self) -> Array:
        """Side x central, which looks ahead where the tangents rise to the right of the track."""
        return np.asarray(np.cross(self.side, self.central))


def line_frame(plane: PlaneFit, tangent: ArrayLike, bend: float = 0.0) -> LineFrame:
    """The line of sight of a CCD line's centre and the line's direction, from the plane and the interior orientation.

    Raises AngleError for bad tangents.

    Parameters
    ----------
    plane : PlaneFit
        Fitted to the line.
    tangent : ArrayLike
        (n,) tangent of the angle of each point from the line of sight along the CCD line, from its pixel number and the
        interior orientation; either sense of counting.
    bend : float
        How far the ends of a line that the laboratory knows as straight may have bent out of its plane since, one
        sigma, radians. The bend is estimated with this sigma as its prior, and the central ray follows it. 0: not.
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
    seen, interior = np.arctan2(arm @ side, arm @ middle), np.arctan(w)
    spread = interior - interior.mean()
    slope = float(spread @ (seen - seen.mean()) / (spread @ spread)) if np.any(spread) else 0.0
    if abs(abs(slope) - 1.0) > 0.1:
        raise AngleError(
            f"central ray: the points open {abs(slope):.3g} times the angle that their tangents say; wrong tangents?"
        )
    # a point's angle is good to its sigma over its distance
    weight = np.sum(arm**2, axis=1) / np.trace(strip.covariance, axis1=1, axis2=2)
    turn = float(np.sum(weight * (seen - np.copysign(1.0, slope) * interior)) / np.sum(weight))
    central = np.cos(turn) * middle + np.sin(turn) * side
    side = np.copysign(1.0, slope) * np.cross(plane.normal, central)
    if bend <= 0.0 or not np.any(spread):
        return LineFrame(central, side, plane, 0.0)
    off, variance = _off_plane(plane, arm, interior, bend)
    return LineFrame(np.cos(off) * central + np.sin(off) * plane.normal, side, plane, variance)


def _off_plane(plane: PlaneFit, arm: Array, interior: Array, bend: float) -> tuple[float, float]:
    """Angle of the central ray out of the plane when the line may be bent, and what its variance grows by."""
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
    """Signed angles along the track between pairs of lines. values: (m,) radians. covariance: (m, m) rad^2."""

    values: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """(m,) radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def along_track_angle(central_a: ArrayLike, side_a: ArrayLike, central_b: ArrayLike, side_b: ArrayLike) -> float:
    """Turn about the mean direction of two lines that takes the second's central ray to the first's, radians.

    Unit vectors (3,). Positive where the first looks ahead of the second, sides pointing to the right of the track.
    Raises AngleError for lines that run in opposite directions.

    Parameters
    ----------
    central_a : ArrayLike
        Central ray of the first line, unit, (3,).
    side_a : ArrayLike
        Direction of the first line, unit, (3,).
    central_b : ArrayLike
        Of the second line, likewise.
    side_b : ArrayLike
        likewise.
    """
    first, second = np.asarray(central_a, np.float64), np.asarray(central_b, np.float64)
    axis = np.asarray(side_a, np.float64) + np.asarray(side_b, np.float64)
    length = float(np.linalg.norm(axis))
    if length < 1.0:
        raise AngleError("along-track angle: the lines run in opposite directions; are pixels counted alike?")
    axis = axis / length
    return float(np.arctan2(axis @ np.cross(second, first), first @ second - (first @ axis) * (second @ axis)))


def along_track_angles(lines: Sequence[LineFrame], pairs: Sequence[tuple[int, int]]) -> AlongTrackAngles:
    """Signed angles between pairs of lines seen from one station, with their joint covariance.

    A plane that turns about its line's direction moves its central ray by as much; turns within a plane count only by
    the angle between the two lines, and are left out of the covariance. pairs: indices into `lines`. Raises AngleError,
    for several stations, too.
    """
    planes = [line.plane for line in lines]
    station = _common_station(planes)
    gradient = np.zeros((len(pairs), len(lines), 3))
    values, sign = np.empty(len(pairs)), np.zeros((len(pairs), len(lines)))
    for row, (i, j) in enumerate(pairs):
        a, b = lines[i], lines[j]
        values[row] = along_track_angle(a.central, a.side, b.central, b.side)
        for k, way in ((i, 1.0), (j, -1.0)):
            line = lines[k]
            # the normal that looks ahead turns away from the central ray when the plane turns ahead
            gradient[row, k] = -way * line.central * np.copysign(1.0, line.plane.normal @ line.forward)
            sign[row, k] = way
    own = np.array([line.variance for line in lines])
    covariance = _propagated(gradient, planes, station) + (sign * own) @ sign.T
    return AlongTrackAngles(values, covariance)


def height_error(
    angle_error: ArrayLike, slant_range: ArrayLike, convergence: ArrayLike, zenith: ArrayLike = 0.0
) -> Array:
    """Error of intersected heights when a look angle is taken wrong by `angle_error`, metres, to first order.

    The wrong ray passes the ground point at slant_range * angle_error and so meets the other ray, at the angle
    `convergence` on the ground, farther along by that over sin(convergence); `zenith`: zenith angle of the other ray.
    For a camera at height H over flat ground, against nadir: H * angle_error / (sin a cos a). Radians, metres.

    Parameters
    ----------
    angle_error : ArrayLike
        Of the look angle, radians, any shape.
    slant_range : ArrayLike
        To the ground point, metres.
    convergence : ArrayLike
        Angle between the rays on the ground, radians.
    zenith : ArrayLike
        Zenith angle of the other ray, radians.
    """
    along = np.asarray(slant_range) * np.asarray(angle_error) / np.sin(np.asarray(convergence, np.float64))
    return np.asarray(along * np.cos(np.asarray(zenith, np.float64)))


AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Answer of m dihedral angles to a move of one thing along one axis.

    angles: their names. what: "station", or the line whose points move. axis: "x", "y" or "z". amount: (k,) metres.
    change: (m, k) by recomputation, radians. slope: (m,) linear derivatives at zero, rad/m.
    """

    angles: tuple[str, ...]
    what: str
    axis: str
    amount: Array
    change: Array
    slope: Array

    def to_dict(self) -> dict[str, Any]:
        """what, axis, and the linear answer to 10 m in arcseconds."""
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
    """Rows for the station and the points of each strip, each along x, y, z of the coordinates' frame.

    Raises PlaneError and AngleError.

    Parameters
    ----------
    station : Station
        From which the strips are seen.
    strips : Mapping[str, Strip]
        Line -> its points.
    pairs : Mapping[str, tuple[str, str]]
        Angle -> the two lines that it lies between.
    method : Method
        Of the planes' fit.
    amounts : ArrayLike | None
        (k,) metres, first 0; 0 to 10 m in steps of 1 m by default.
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
        moved = list(range(len(order))) if what == "station" else [order.index(what)]
        sign = 1.0 if what == "station" else -1.0
        derivative = sign * np.einsum(
            "mki,kij->mj", start.gradient[:, moved], np.array([fits[k].station_gain for k in moved])
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
    """The planes after a move; only what moved is fitted anew."""
    if what == "station":
        place = Station(station.position + shift, station.covariance)
        return [fit_plane(place, strip, method) for strip in strips.values()]
    return [
        fit_plane(station, strip.shifted(shift), method) if name == what else fit
        for (name, strip), fit in zip(strips.items(), fits, strict=True)
    ]
