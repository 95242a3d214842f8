"""Rigorous model of a line sensor in orbit: from pixel and time to the ground and back.

Nothing is interpolated along the track, so that no smoothness of attitude or orbit is assumed.

The two directions are implemented independently, each from the physics: `ground` intersects a pixel's line of sight
with the surface of a height, `image` searches the line and the pixel on which the light from a point falls. The round
trip therefore tests both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from optics.geometry.pose import rotation_matrix
from optics.numerics.array_math import in_span
from twin.orbit.flight import light_effects
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.light_effects import SPEED_OF_LIGHT, LightEffects, aberrated, rotated_with_earth
from twin.orbit.flight.line_camera import LineCamera, LineTimes

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
            point = light_effects.refracted(point, station, self.earth, self.effects.wavelength)
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
                source = light_effects.unrefracted(source, left_station, self.earth, self.effects.wavelength)
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
