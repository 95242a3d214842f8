"""The Earth: ellipsoid, geodetic coordinates, and its rotation between celestial and terrestrial frames.

IAU 2006/2000A precession and nutation, Earth rotation angle and polar motion (IERS Conventions 2010, chapter 5, based
on the celestial intermediate origin), computed by the library ERFA. The celestial pole moves so smoothly that its
coordinates are computed at nodes an hour apart and interpolated by cubic splines; the fastest terms have periods of 5
days and some 1e-8 rad, and the error stays below 1e-15 rad. The angle of rotation is linear in time and is not
interpolated.

The terrestrial frame (ITRS) is taken as WGS84's; they agree to centimetres. Longitude counts east, latitude is
geodetic, heights are above the ellipsoid.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from typing import TYPE_CHECKING, Any

import erfa
import numpy as np
import pyproj
from scipy.interpolate import CubicSpline

if TYPE_CHECKING:
    from scenes.specs.orbit.flight import EarthSpec


DAY = 86400.0
"""Length of a day, in SI seconds."""
RATE = 2.0 * np.pi * 1.00273781191135448 / DAY
"""Rotation rate of the Earth, in rad/s (IERS Conventions 2010, eq. 5.15)."""

_NODE_STEP = 3600.0
"""Interval of the nodes at which the celestial pole is computed for interpolation, in seconds."""
_NODES_AROUND = 3
"""Number of interpolation nodes of the celestial pole beyond each end of the span."""
_DIFFERENCE_STEP = 600.0
"""Half step of the central difference that gives the celestial pole's rate, in seconds."""


@contextmanager
def years_without_announced_leap_seconds() -> Iterator[None]:
    """Suppress ERFA's warning about UTC years for which leap seconds are not announced yet."""
    # ERFA calls a year dubious for which leap seconds are not announced yet; it then assumes none, as is done here.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        yield


def tai_of(epoch: str) -> tuple[float, float]:
    """Return TAI of an instant given in UTC, as a Julian date in two parts, in days.

    Parameters
    ----------
    epoch : str
        ISO 8601 text with its time zone, "2011-03-05T03:05:00Z".

    Raises
    ------
    ValueError
        The text is not ISO 8601 or has no time zone.
    """
    time = datetime.fromisoformat(epoch)
    if time.tzinfo is None:
        raise ValueError(f"{epoch!r} has no time zone; UTC is written with a final Z")
    time = time.astimezone(UTC)
    second = time.second + 1e-6 * time.microsecond
    with years_without_announced_leap_seconds():
        utc = erfa.dtf2d("UTC", time.year, time.month, time.day, time.hour, time.minute, second)
        tai_1, tai_2 = erfa.utctai(*utc)
    return float(tai_1), float(tai_2)


def ut1_of(epoch: str, dut1: float) -> tuple[float, float]:
    """Return UT1 of an instant given in UTC, as a Julian date in two parts, in days.

    Parameters
    ----------
    epoch : str
        ISO 8601 text with its time zone, "2011-03-05T03:05:00Z".
    dut1 : float
        UT1 - UTC, seconds.
    """
    with years_without_announced_leap_seconds():
        ut1_1, ut1_2 = erfa.utcut1(*erfa.taiutc(*tai_of(epoch)), dut1)
    return float(ut1_1), float(ut1_2)


@dataclass(frozen=True, eq=False)
class EarthRotation:
    """Rotation GCRS -> ITRS around an epoch, from `Earth.rotation`; times are SI seconds of TAI from the epoch.

    Attributes
    ----------
    pole : callable
        Function of the time that returns the celestial pole's X and Y and the CIO locator s, radians.
    angle : float
        Earth rotation angle at the epoch, radians.
    polar : ndarray
        Polar motion, TIRS -> ITRS, shape (3, 3).
    """

    pole: Any
    angle: float
    polar: np.ndarray

    def celestial(self, seconds: Any) -> np.ndarray:
        """Return the rotation GCRS -> CIRS, the frame of the pole and origin of date, (..., 3, 3) for times (...)."""
        x, y, s = np.moveaxis(self.pole(np.asarray(seconds, dtype=np.float64)), -1, 0)
        return np.asarray(erfa.c2ixys(x, y, s))

    def matrix(self, seconds: Any) -> np.ndarray:
        """Return the rotation GCRS -> ITRS: x_itrs = matrix @ x_gcrs; (..., 3, 3) for times (...)."""
        t = np.asarray(seconds, dtype=np.float64)
        return np.asarray(erfa.c2tcio(self.celestial(t), self.angle + RATE * t, self.polar))

    def rate(self, seconds: Any) -> np.ndarray:
        """Return the angular velocity of the ITRS against the GCRS in ITRS axes, rad/s, (..., 3) for times (...).

        The motion of the pole (some 1e-11 rad/s) is part of it, so that velocities are the exact derivatives of
        positions.
        """
        t = np.asarray(seconds, dtype=np.float64)
        after, before = (self.celestial(t + step) for step in (_DIFFERENCE_STEP, -_DIFFERENCE_STEP))
        # C' C^T = -[q x] with q the angular velocity of the CIRS in its own axes, without a part about the pole,
        # because its origin does not rotate.
        spin = (after - before) @ np.swapaxes(self.celestial(t), -1, -2) / (2.0 * _DIFFERENCE_STEP)
        x, y = 0.5 * (spin[..., 1, 2] - spin[..., 2, 1]), 0.5 * (spin[..., 2, 0] - spin[..., 0, 2])
        angle = self.angle + RATE * t
        c, s = np.cos(angle), np.sin(angle)
        tirs = np.stack([c * x + s * y, c * y - s * x, np.full_like(x, RATE)], axis=-1)
        return tirs @ self.polar.T


def celestial_pole(epoch: str, first: float, last: float) -> CubicSpline:
    """Return a spline over time of the celestial pole's X and Y and of the locator s (IAU 2006/2000A), in radians.

    Parameters
    ----------
    epoch : str
        UTC, ISO 8601 text.
    first : float
        Start of the span, in seconds from the epoch; the nodes extend some hours beyond it on either side.
    last : float
        End of the span, in seconds from the epoch.
    """
    tai_1, tai_2 = tai_of(epoch)
    half_count = np.ceil(0.5 * (last - first) / _NODE_STEP) + _NODES_AROUND
    nodes = 0.5 * (first + last) + _NODE_STEP * np.arange(-half_count, half_count + 1.0)
    return CubicSpline(nodes, np.stack(erfa.xys06a(tai_1, tai_2 + erfa.TTMTAI / DAY + nodes / DAY), axis=-1))


_WGS84 = pyproj.Geod(ellps="WGS84")
GM = 3.986004415e14
"""Gravitational parameter of the Earth, in m^3/s^2 (EGM96)."""
EQUATORIAL_RADIUS = float(_WGS84.a)
"""Semi-major axis of the WGS84 ellipsoid, in metres."""
FLATTENING = float(_WGS84.f)
"""Flattening of the WGS84 ellipsoid."""
_E2 = FLATTENING * (2.0 - FLATTENING)
"""Squared first eccentricity of the WGS84 ellipsoid."""
_NEWTON_STEPS = 30
_HEIGHT_TOLERANCE = 2e-8
"""Largest height error of an intersection of a ray with a surface of equal height, in metres; rounding of a point 7000
km from the centre is 1e-9 m.
"""


@cache
def _cartesian() -> pyproj.Transformer:
    return pyproj.Transformer.from_pipeline("+proj=cart +ellps=WGS84")


def east_north_up(lon: Any, lat: Any) -> np.ndarray:
    """Return the axes of the local level frame, shape (..., 3, 3): rows east, north and up (the ellipsoid's normal)."""
    lon, lat = np.broadcast_arrays(np.asarray(lon, dtype=np.float64), np.asarray(lat, dtype=np.float64))
    sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    rows = [-sl, cl, np.zeros_like(sl), -sp * cl, -sp * sl, cp, cp * cl, cp * sl, sp]
    return np.stack(rows, axis=-1).reshape(*sl.shape, 3, 3)


def curvature_radii(lat: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the ellipsoid's radii of curvature along the meridian (M) and across it (N), in m, at latitudes (...)."""
    square = 1.0 - _E2 * np.sin(lat) ** 2
    return EQUATORIAL_RADIUS * (1.0 - _E2) / square**1.5, EQUATORIAL_RADIUS / np.sqrt(square)


@dataclass(frozen=True)
class Earth:
    """WGS84 ellipsoid with its orientation at an epoch: UT1 and polar motion.

    Attributes
    ----------
    dut1 : float
        UT1 - UTC at the epoch, seconds.
    polar_motion : tuple of float
        x and y of the pole, radians (x toward Greenwich, y toward 90 degrees west).
    """

    dut1: float = 0.0
    polar_motion: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def from_spec(cls, spec: EarthSpec) -> Earth:
        """Return the Earth with the UT1 and polar motion of the `earth` section of an input file."""
        return cls(spec.ut1_utc, spec.polar_motion)

    def rotation(self, epoch: str, first: float, last: float) -> EarthRotation:
        """Compute the Earth's rotation from `first` to `last`, for many look-ups.

        UT1 is taken to run at a constant rate from the epoch, also over a leap second.

        Parameters
        ----------
        epoch : str
            UTC, ISO 8601 text.
        first : float
            Start of the span, in seconds from the epoch.
        last : float
            End of the span, in seconds from the epoch.
        """
        tai_1, tai_2 = tai_of(epoch)
        polar = np.asarray(erfa.pom00(*self.polar_motion, erfa.sp00(tai_1, tai_2 + erfa.TTMTAI / DAY)))
        polar.setflags(write=False)
        angle = float(erfa.era00(*ut1_of(epoch, self.dut1)))
        return EarthRotation(celestial_pole(epoch, first, last), angle, polar)

    def to_itrs(self, seconds: Any, epoch: str) -> np.ndarray:
        """Return the rotation GCRS -> ITRS at times counted from an epoch.

        Parameters
        ----------
        seconds : array_like
            SI seconds from the epoch, shape (...).
        epoch : str
            UTC, ISO 8601 text.

        Returns
        -------
        ndarray
            Shape (..., 3, 3); x_itrs = matrix @ x_gcrs.
        """
        t = np.asarray(seconds, dtype=np.float64)
        return self.rotation(epoch, float(np.min(t)), float(np.max(t))).matrix(t)

    def ecef(self, lon: Any, lat: Any, height: Any = 0.0) -> np.ndarray:
        """Return the Earth-fixed coordinates of points on or above the ellipsoid.

        Parameters
        ----------
        lon : array_like
            Longitude, radians east, shape (...).
        lat : array_like
            Geodetic latitude, radians, shape (...).
        height : array_like
            Height above the ellipsoid, metres.

        Returns
        -------
        ndarray
            Shape (..., 3), ITRS, metres.
        """
        lon, lat, h = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (lon, lat, height)))
        normal = curvature_radii(lat)[1]
        across = (normal + h) * np.cos(lat)
        return np.stack([across * np.cos(lon), across * np.sin(lon), (normal * (1.0 - _E2) + h) * np.sin(lat)], axis=-1)

    def geodetic(self, ecef: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return longitude, latitude (radians) and height (metres) of points (..., 3) in the ITRS; NaN stays NaN.

        PROJ's inverse is one step of Bowring's method: accurate to a micrometre near the ground, but only to 2 mm at a
        height of 500 km. One Newton step with the exact forward formula, in the local level frame, reduces the error to
        rounding.
        """
        p = np.asarray(ecef, dtype=np.float64)
        start = _cartesian().transform(p[..., 0], p[..., 1], p[..., 2], radians=True, direction="INVERSE")
        lon, lat, h = (np.asarray(a) for a in start)
        rest = np.einsum("...ij,...j->...i", east_north_up(lon, lat), p - self.ecef(lon, lat, h))
        # PROJ's longitude is exact, so the remaining error lies in the meridian.
        return lon, lat + rest[..., 1] / (curvature_radii(lat)[0] + h), h + rest[..., 2]

    def intersect(self, origin: Any, direction: Any, height: Any = 0.0) -> np.ndarray:
        """Return the first points at which descending rays reach a geodetic height.

        The surface of equal height is not an ellipsoid; the intersection is found by Newton steps on the geodetic
        height along the ray, starting at the ellipsoid whose semi-axes are both enlarged by the height.

        Parameters
        ----------
        origin : array_like
            Origins of the rays above that height, ITRS, metres, shape (..., 3).
        direction : array_like
            Directions of the rays, of any length, shape (..., 3).
        height : array_like
            Height above the ellipsoid, metres, shape (...).

        Returns
        -------
        ndarray
            Shape (..., 3), ITRS, metres; NaN where the ray misses, or meets the surface only behind its origin.
        """
        o, d, h = (np.asarray(a, dtype=np.float64) for a in (origin, direction, height))
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        shape = np.broadcast_shapes(o.shape[:-1], d.shape[:-1], h.shape)
        o, d, h = np.broadcast_to(o, (*shape, 3)), np.broadcast_to(d, (*shape, 3)), np.broadcast_to(h, shape)
        along = _nearer_root(o, d, h)
        for _ in range(_NEWTON_STEPS):
            lon, lat, reached = self.geodetic(o + along[..., None] * d)
            slope = np.sum(east_north_up(lon, lat)[..., 2, :] * d, axis=-1)
            excess = reached - h
            far = np.abs(excess) > _HEIGHT_TOLERANCE
            if not np.any(far):
                break
            with np.errstate(divide="ignore", invalid="ignore"):
                along = np.where(far, along - excess / slope, along)
        good = (np.abs(excess) <= _HEIGHT_TOLERANCE) & (slope < 0.0) & (along > 0.0)
        return np.where(good[..., None], o + along[..., None] * d, np.nan)


def _nearer_root(o: np.ndarray, d: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return the distances (...) along rays from origins `o` in directions `d` to the enlarged ellipsoid.

    Both semi-axes are enlarged by the height `h`, in metres. The distance is NaN where a ray clearly misses the
    ellipsoid. Where it misses by less than this ellipsoid can differ from the surface of height `h`, the distance to
    the ray's nearest point is returned.
    """
    axes = EQUATORIAL_RADIUS * np.array([1.0, 1.0, 1.0 - FLATTENING]) + h[..., None]
    p, q = o / axes, d / axes
    a, b, c = np.sum(q * q, axis=-1), np.sum(p * q, axis=-1), np.sum(p * p, axis=-1) - 1.0
    square = b * b - a * c
    # Near the root the quantity is a squared relative distance times a.
    square = np.where(square < -1e-6 * a, np.nan, np.maximum(square, 0.0))
    return np.asarray((-b - np.sqrt(square)) / a)
