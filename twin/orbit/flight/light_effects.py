"""Light between the ground and a moving camera: light time, stellar aberration, refraction.

Sizes in an orbit at 500 km: the Earth rotates by 0.8 m (equator) during the light time; aberration is v/c = 25 urad
(5.2 arcsec), 12.7 m on the ground along the track; refraction moves the ground point of a line of sight at 25 degrees
by 1.5 m toward the satellite's nadir.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from twin.orbit.flight.earth import Earth, curvature_radii, east_north_up

if TYPE_CHECKING:
    from scenes.specs.orbit.angle import EffectsSpec, LightEffectsSpec

SPEED_OF_LIGHT = 299_792_458.0
"""Speed of light in vacuum, in m/s."""
EARTH_RATE = 7.292115146706979e-5
"""Rotation rate of the Earth, rad/s: derivative of the Earth rotation angle (IERS Conventions 2010, eq. 5.15)."""
_FIXED_POINT_STEPS = 3


def earth_rotation_velocity(position: np.ndarray) -> np.ndarray:
    """Return the inertial velocity of points that rotate with the Earth, in axes of the ITRS, in m/s.

    The Earth's axis is taken as Z: polar motion (1e-6 rad) changes the velocity by 1 mm/s.

    Parameters
    ----------
    position : ndarray
        Positions in the ITRS, metres, (..., 3).
    """
    return EARTH_RATE * np.stack([-position[..., 1], position[..., 0], np.zeros(position.shape[:-1])], axis=-1)


# Standard atmosphere (ICAO, 1993), dry air.
_PRESSURE_EXPONENT = 5.255879
_LAPSE = 0.0065  # K/m
_TEMPERATURE = 288.15  # K at sea level
_TROPOPAUSE = 11_000.0  # m
_HEIGHT_PER_KELVIN = 8.31446 / (0.0289644 * 9.80665)  # R/(M g), m/K
_LAGUERRE = np.polynomial.laguerre.laggauss(12)


@dataclass(frozen=True)
class LightEffects:
    """Choice of the effects on light that a model includes.

    Attributes
    ----------
    light_time : bool
        Include the rotation of the Earth during the light time.
    aberration : bool
        Include the aberration due to the satellite's inertial velocity.
    refraction : bool
        Include refraction in the standard atmosphere.
    wavelength : float
        Vacuum wavelength for the refraction, metres.
    """

    light_time: bool = True
    aberration: bool = True
    refraction: bool = True
    wavelength: float = 650e-9

    @classmethod
    def of(cls, spec: EffectsSpec | LightEffectsSpec) -> LightEffects:
        """Return the effects on the light that a test's file switches on."""
        return cls(spec.light_time, spec.aberration, spec.refraction, spec.wavelength)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects that are on, as text for reports."""
        on = {"light time": self.light_time, "aberration": self.aberration, "refraction": self.refraction}
        return tuple(name for name, is_on in on.items() if is_on)


NO_EFFECTS = LightEffects(light_time=False, aberration=False, refraction=False)
"""Straight light at infinite speed: no light time, no aberration, no refraction."""


def aberrated(direction: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the apparent directions of sources for a moving observer.

    The Lorentz transformation of a direction, exact (Klioner, AJ 125, 1580 (2003), eq. 10, without gravitation). The
    source appears displaced toward the velocity. With ``-velocity`` the function is its own inverse.

    Parameters
    ----------
    direction : ndarray
        Unit vectors from the observer toward the source in the frame at rest, (N, 3) for N sources.
    velocity : ndarray
        Velocity of the observer in that frame, m/s, broadcastable to (N, 3).

    Returns
    -------
    ndarray
        Unit vectors toward the source in the observer's frame, (N, 3).
    """
    beta = np.broadcast_to(velocity, direction.shape) / SPEED_OF_LIGHT
    shrink = np.sqrt(1.0 - np.sum(beta**2, axis=-1, keepdims=True))
    along = np.sum(direction * beta, axis=-1, keepdims=True)
    apparent = (shrink * direction + (1.0 + along / (1.0 + shrink)) * beta) / (1.0 + along)
    # The formula keeps the length, except for rounding.
    return apparent / np.linalg.norm(apparent, axis=-1, keepdims=True)


def rotated_with_earth(vectors: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Rotate vectors in Earth-fixed axes eastward with the Earth for a time.

    Parameters
    ----------
    vectors : ndarray
        Vectors in the ITRS, (N, 3) for N vectors.
    seconds : ndarray
        Duration, seconds, (N,); negative values rotate westward.

    Returns
    -------
    ndarray
        Rotated vectors, (N, 3). A point that is fixed in space moves by ``-seconds`` in Earth-fixed axes. The axis is
        Z: polar motion (1e-6 rad) changes the rotation in a light time by 1e-13 rad, below a micrometre.
    """
    angle = EARTH_RATE * seconds
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def standard_refractivity(wavelength: float) -> float:
    """Return the refractivity n - 1 of dry air at 15 degC and 1013.25 hPa (Peck and Reeder 1972, eq. 2).

    The source is JOSA 62, 958 (1972).

    Parameters
    ----------
    wavelength : float
        Vacuum wavelength, metres; the formula holds from 230 nm to 1690 nm.
    """
    square = (1e-6 / wavelength) ** 2
    return 1e-8 * (8060.51 + 2480990.0 / (132.274 - square) + 17455.7 / (39.32957 - square))


def refractive_shift(zenith: np.ndarray, height: np.ndarray, radius: np.ndarray, wavelength: float) -> np.ndarray:
    """Return the shift due to refraction of the ground point of a line of sight, toward the satellite's nadir.

    In a spherically layered atmosphere p = n r sin z, with refractive index n, distance r from the Earth's centre and
    zenith angle z, is constant along the ray (Bouguer's invariant; Noerdlinger, ISPRS J. 54, 360 (1999)), and in space
    p belongs to the straight line. The angle at the Earth's centre between satellite and point is the integral of p
    dr/(r sqrt(n^2 r^2 - p^2)), so the ray arrives nearer to the nadir than the straight line by

        r0 integral_{r0}^{inf} (p/r) [1/sqrt(r^2 - p^2) - 1/sqrt(n^2 r^2 - p^2)] dr  ~  tan z sec^2 z integral (n-1) dh.

    n - 1 falls off exponentially above the point, with density and scale height (R T/(M g)) of the standard atmosphere
    at the point's height. The column of air, the only quantity that matters for small z, therefore agrees with the
    pressure at the point (integral of n - 1: 2.33 m at sea level). The integral is evaluated by 12-point Gauss-Laguerre
    quadrature.

    Parameters
    ----------
    zenith : ndarray
        Angle z of the straight line at the ground from the vertical, radians, (N,) for N points, at most 80 degrees.
    height : ndarray
        Height of the point above sea level, metres, broadcastable to (N,).
    radius : ndarray
        Radius of curvature of the ellipsoid, metres, broadcastable to (N,).
    wavelength : float
        Vacuum wavelength, metres.

    Returns
    -------
    ndarray
        Shift along the surface, metres, (N,).
    """
    temperature = _TEMPERATURE - _LAPSE * np.minimum(height, _TROPOPAUSE)
    scale_height = _HEIGHT_PER_KELVIN * temperature
    pressure = (temperature / _TEMPERATURE) ** _PRESSURE_EXPONENT
    pressure = pressure * np.exp(-np.maximum(height - _TROPOPAUSE, 0.0) / scale_height)
    at_ground = standard_refractivity(wavelength) * pressure * _TEMPERATURE / temperature
    nodes, weights = _LAGUERRE
    start = np.asarray(radius + height)[..., None]
    r = start + np.asarray(scale_height)[..., None] * nodes
    p = start * np.sin(zenith)[..., None]
    decay = np.asarray(at_ground)[..., None]
    n = 1.0 + decay * np.exp(-nodes)
    straight, bent = np.sqrt(r**2 - p**2), np.sqrt((n * r) ** 2 - p**2)
    # The difference of the two roots is written without cancellation, and without the factor exp(-x) of the weights.
    integrand = p * r * decay * (n + 1.0) / (straight * bent * (straight + bent))
    return (radius + height) * scale_height * np.sum(weights * integrand, axis=-1)


def refracted(point: np.ndarray, station: np.ndarray, earth: Earth, wavelength: float) -> np.ndarray:
    """Return the points at which refracted lines of sight meet the ground.

    Parameters
    ----------
    point : ndarray
        Points at which the straight continuation of the line of sight from space reaches the height of the ground,
        ITRS, metres, (N, 3) for N points.
    station : ndarray
        Positions of the satellite when the light left the ground, ITRS, metres, (N, 3).
    earth : Earth
        Ellipsoid that gives the vertical at the point; the atmosphere is layered about its mean sphere there.
    wavelength : float
        Vacuum wavelength, metres.

    Returns
    -------
    ndarray
        Points at the same height, nearer to the point below the satellite, ITRS, metres, (N, 3).
    """
    lon, lat, height = earth.geodetic(point)
    vertical = east_north_up(lon, lat)[..., 2, :]
    look = station - point
    look = look / np.linalg.norm(look, axis=-1, keepdims=True)
    horizontal = look - vertical * np.sum(look * vertical, axis=-1, keepdims=True)
    sine = np.linalg.norm(horizontal, axis=-1)
    radius = np.sqrt(np.multiply(*curvature_radii(lat)))
    shift = refractive_shift(np.arcsin(np.minimum(sine, 1.0)), height, radius, wavelength)
    scale = np.divide(shift, sine, out=np.zeros_like(sine), where=sine > 0.0)
    drop = 0.5 * shift**2 / (radius + height)  # the level surface falls away from its tangent plane
    return point + scale[..., None] * horizontal - drop[..., None] * vertical


def unrefracted(point: np.ndarray, station: np.ndarray, earth: Earth, wavelength: float) -> np.ndarray:
    """Return the points that lines of sight would reach without refraction, if refracted ones meet `point`.

    This is the inverse of `refracted`, computed by fixed-point steps. Each reduces the error by the ratio of the shift
    to the satellite's distance, 3e-6 at 500 km.
    """
    straight = point
    for _ in range(_FIXED_POINT_STEPS):
        straight = point + (straight - refracted(straight, station, earth, wavelength))
    return straight
