"""Rigorous model of a line sensor in orbit: from pixel and time to the ground and back.

Nothing is interpolated along the track, so that no smoothness of attitude or orbit is assumed.

The two directions are implemented independently, each from the physics: `ground` intersects a pixel's line of sight
with the surface of a height, `image` searches the line and the pixel on which the light from a point falls. The round
trip therefore tests both.

Light between the ground and a moving camera: light time, stellar aberration, refraction.

Sizes in an orbit at 500 km: the Earth rotates by 0.8 m (equator) during the light time; aberration is v/c = 25 urad
(5.2 arcsec), 12.7 m on the ground along the track; refraction moves the ground point of a line of sight at 25 degrees
by 1.5 m toward the satellite's nadir.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from optics.geometry.pose import rotation_matrix
from optics.numerics.array_math import in_span
from twin.orbit.flight.earth import Earth, curvature_radii, east_north_up
from twin.orbit.flight.line_camera import LineCamera, LineTimes

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


_MOST_STEPS = 30
"""Largest number of Newton steps of the search for the line and pixel that see a ground point."""
_ARRIVED = 1e-7
"""Length of a Newton step, in pixels and lines, below which the search for the image of a ground point ends.

Each step is a thousand times smaller than the one before, so that the remaining error is far smaller.
"""


class Platform(Protocol):
    """Interface of a trajectory: Earth-fixed motion (ITRS axes) at N times in seconds.

    Each method raises ValueError for a time that the trajectory does not cover.
    """

    def position(self, seconds: np.ndarray) -> np.ndarray:
        """Return the position of the body's origin at N times, (N, 3), ITRS, in metres."""

    def inertial_velocity(self, seconds: np.ndarray) -> np.ndarray:
        """Return the velocity relative to the stars at N times, (N, 3), in axes of the ITRS, in m/s."""

    def body_to_itrs(self, seconds: np.ndarray) -> np.ndarray:
        """Return matrices whose columns are the body axes X, Y, Z in the ITRS at N times, (N, 3, 3)."""


@dataclass(frozen=True, eq=False)
class OffsetPlatform:
    """Trajectory with a constant offset of position and attitude in body axes.

    Attributes
    ----------
    base : Platform
        Trajectory without the offset.
    shift : (3,) ndarray
        Offset of position in body axes, metres.
    rotation : (3,) ndarray
        Rotation vector of the offset of attitude in body axes, radians.
    """

    base: Platform
    shift: np.ndarray
    rotation: np.ndarray

    def position(self, seconds: np.ndarray) -> np.ndarray:
        """Return the shifted positions at N times, (N, 3), in metres."""
        at = self.base.position(seconds)
        return at + self.base.body_to_itrs(seconds) @ self.shift if np.any(self.shift) else at

    def inertial_velocity(self, seconds: np.ndarray) -> np.ndarray:
        """Return the velocities relative to the stars at N times, (N, 3), in m/s; the offset does not change them."""
        return self.base.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: np.ndarray) -> np.ndarray:
        """Return the rotated body axes at N times as columns, (N, 3, 3)."""
        return np.asarray(self.base.body_to_itrs(seconds) @ rotation_matrix(self.rotation))


@dataclass(frozen=True, eq=False)
class Sensor:
    """Line camera on a trajectory, with the exposure times of its image's lines.

    Image coordinates are (line, pixel), real numbers; the centre of the first line's first pixel is (0, 0) and the
    image extends from -0.5 to lines - 0.5 and to pixels - 0.5.

    Attributes
    ----------
    camera : LineCamera
        Geometry of the line.
    trajectory : Platform
        Position, velocity and attitude over time.
    earth : Earth
        Ellipsoid and its orientation.
    line_time : float
        Time from one line to the next, seconds.
    first_line_time : float
        Middle of the exposure of line 0, seconds of the trajectory.
    lines : int
        Number of lines of the image.
    effects : LightEffects
        Choice of light time, aberration and refraction.
    times : LineTimes or None
        Table of exposure times; None for lines at a constant interval.

    Raises
    ------
    ValueError
        The image begins or ends outside of the trajectory's times.
    """

    camera: LineCamera
    trajectory: Platform
    earth: Earth
    line_time: float
    first_line_time: float
    lines: int
    effects: LightEffects = field(default_factory=LightEffects)
    times: LineTimes | None = None

    def __post_init__(self) -> None:
        if not self.line_time > 0.0 or self.lines < 1:
            raise ValueError("an image needs at least one line and a line time above zero")
        self.trajectory.position(self.time(np.array([-0.5, self.lines - 0.5])))

    @classmethod
    def of_lines(
        cls, camera: LineCamera, trajectory: Platform, earth: Earth, times: LineTimes, effects: LightEffects
    ) -> Sensor:
        """Return the sensor whose lines, counted from 0, were exposed at the times of a table.

        Raises
        ------
        ValueError
            The image begins or ends outside of the trajectory's times.
        """
        lines = int(times.line[-1]) + 1
        return cls(camera, trajectory, earth, times.line_time, float(times.time[0]), lines, effects, times)

    def time(self, line: np.ndarray) -> np.ndarray:
        """Return the times of exposure of N lines, (N,), in seconds of the trajectory."""
        if self.times is not None:
            return self.times.at(line)
        return self.first_line_time + np.asarray(line, dtype=np.float64) * self.line_time

    def ground(self, line: np.ndarray, pixel: np.ndarray, height: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the ground points that pixels see on the surface of a given height.

        Parameters
        ----------
        line : ndarray
            Line coordinate, broadcastable to (N,) for N points.
        pixel : ndarray
            Pixel coordinate, broadcastable to (N,).
        height : ndarray or float
            Height above the ellipsoid, metres, broadcastable to (N,).

        Returns
        -------
        (N, 3) ndarray
            Points in the ITRS, metres; NaN where the line of sight misses the Earth.

        Raises
        ------
        ValueError
            A line or a pixel lies outside the image.
        """
        line, pixel, height = (np.ravel(a) for a in np.broadcast_arrays(line, pixel, height))
        self._require_inside(line)
        seconds = self.time(line)
        to_itrs = self.trajectory.body_to_itrs(seconds)
        look = np.einsum("nij,nj->ni", to_itrs, self.camera.look(pixel))
        station = self._station(seconds, to_itrs, pixel)
        if self.effects.aberration:
            look = aberrated(look, -self.trajectory.inertial_velocity(seconds))
        point = self.earth.intersect(station, look, height)
        if self.effects.light_time:
            # Heights do not change as the Earth rotates: the point is expressed in the Earth-fixed axes of the moment
            # at which its light left.
            delay = np.linalg.norm(point - station, axis=-1) / SPEED_OF_LIGHT
            point, station = rotated_with_earth(point, delay), rotated_with_earth(station, delay)
        if self.effects.refraction:
            point = refracted(point, station, self.earth, self.effects.wavelength)
        return point

    def image(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the image coordinates of ground points.

        Newton's method finds the line and pixel for which the two components of the light's direction perpendicular to
        the pixel's line of sight vanish.

        Parameters
        ----------
        point : (N, 3) ndarray for N points
            Points in the ITRS, metres.

        Returns
        -------
        tuple of ndarray
            Line and pixel, (N,) each; both NaN for a point outside the image (the mask of those inside is
            ``np.isfinite(line)``), for a NaN, and for a point that is hidden behind the Earth.
        """
        point = np.asarray(point, dtype=np.float64).reshape(-1, 3)
        line, pixel = np.full(len(point), np.nan), np.full(len(point), np.nan)
        moving = np.flatnonzero(np.all(np.isfinite(point), axis=-1))
        line[moving], pixel[moving] = 0.5 * (self.lines - 1), 0.5 * (self.camera.pixels - 1)
        lowest, highest = np.full(2, -0.5), np.array([self.lines, self.camera.pixels]) - 0.5
        arrived = np.zeros(len(point), dtype=bool)
        for _ in range(_MOST_STEPS):
            if not len(moving):
                break
            here = np.stack([line[moving], pixel[moving]], axis=-1)
            step = self._step(point[moving], *here.T)
            # A position that would leave the image is held at its border; one that stays there is imaged outside.
            there = np.clip(here + step, lowest, highest)
            line[moving], pixel[moving] = there.T
            close = np.max(np.abs(step), axis=-1) <= _ARRIVED
            arrived[moving[close]] = True
            moving = moving[~close & np.any(there != here, axis=-1) & np.all(np.isfinite(there), axis=-1)]
        seen = np.flatnonzero(arrived)
        arrived[seen] = self._faces(point[seen], line[seen])
        return np.where(arrived, line, np.nan), np.where(arrived, pixel, np.nan)

    def _step(self, point: np.ndarray, line: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Return the Newton step of line and pixel for N points, (N, 2)."""
        look, slope = self.camera.look_and_slope(pixel)
        rate = np.linalg.norm(slope, axis=-1)
        along = slope / rate[:, None]
        across = np.cross(look, along)
        ahead = np.where(line + 1.0 <= self.lines - 0.5, 1.0, -1.0) * min(1.0, 0.5 * self.lines)
        arrivals = [self._arrival(point, at, pixel) for at in (line, line + ahead)]
        here, there = (
            np.stack([np.sum(a * along, axis=-1), np.sum(a * across, axis=-1)], axis=-1)
            / np.sum(a * look, axis=-1, keepdims=True)
            for a in arrivals
        )
        by_line = (there - here) / ahead[:, None]
        line_step = -here[:, 1] / by_line[:, 1]
        return np.stack([line_step, (here[:, 0] + by_line[:, 0] * line_step) / rate], axis=-1)

    def _arrival(self, point: np.ndarray, line: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Return unit directions from which light of N points reaches the camera at a line, body frame, (N, 3)."""
        seconds = self.time(line)
        to_itrs = self.trajectory.body_to_itrs(seconds)
        station = self._station(seconds, to_itrs, pixel)
        source = point
        if self.effects.refraction or self.effects.light_time:
            delay = np.zeros(len(point))
            if self.effects.light_time:
                delay = np.linalg.norm(source - station, axis=-1) / SPEED_OF_LIGHT
            left_station = rotated_with_earth(station, delay)
            if self.effects.refraction:
                source = unrefracted(source, left_station, self.earth, self.effects.wavelength)
            if self.effects.light_time:
                delay = np.linalg.norm(source - left_station, axis=-1) / SPEED_OF_LIGHT
                source = rotated_with_earth(source, -delay)
        direction = source - station
        direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        if self.effects.aberration:
            direction = aberrated(direction, self.trajectory.inertial_velocity(seconds))
        return np.einsum("nij,ni->nj", to_itrs, direction)

    def _station(self, seconds: np.ndarray, to_itrs: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Return the origins of N pixels' rays in the ITRS, (N, 3), in metres."""
        return self.trajectory.position(seconds) + np.einsum("nij,nj->ni", to_itrs, self.camera.origin(pixel))

    def _faces(self, point: np.ndarray, line: np.ndarray) -> np.ndarray:
        """Return whether N points see the satellite above their horizon, (N,) bool."""
        lon, lat, _ = self.earth.geodetic(point)
        outward = east_north_up(lon, lat)[:, 2]
        return np.sum((self.trajectory.position(self.time(line)) - point) * outward, axis=-1) > 0.0

    def _require_inside(self, line: np.ndarray) -> None:
        """Raise ValueError if a line lies outside the image."""
        if not np.all(in_span(line, -0.5, self.lines - 0.5)):
            raise ValueError(f"a line lies outside the image, which extends from -0.5 to {self.lines - 0.5}")
