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
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from analysis.arrays import Array
from analysis.measurement_error import MeasurementError

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
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom))

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
