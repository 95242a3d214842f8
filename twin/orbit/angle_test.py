"""One moment of a pass, as it truly is and as it is measured: the station, and ground points on the strips that the
three lines see (paper 000, section 1).

The measurement has the errors that the paper discusses: of the orbit at the station, and of the ground points from
matching and aerial triangulation. Beside the coordinates the analysis gets what the laboratory measured of each line
before launch, nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.planes import Station, Strip
from optics.frozen_map import FrozenMap
from optics.rotation import about_axis, rotation_matrix
from scenes.orbit_angle import LINES
from twin.orbit.attitude import Attitude
from twin.orbit.earth import Earth, east_north_up
from twin.orbit.light_effects import (
    NO_EFFECTS,
    SPEED_OF_LIGHT,
    LightEffects,
    aberrated,
    turned_with_earth,
    unrefracted,
)
from twin.orbit.line_camera import LineCamera, dihedral_angle, line_cameras, line_normal, look_angle
from twin.orbit.orbit import propagate
from twin.orbit.sensor import Sensor
from twin.orbit.trajectory import Trajectory
from twin.trial.bench_error import BenchError

if TYPE_CHECKING:
    from scenes.orbit_angle import OrbitAngleSpec
    from scenes.orbit_setup import AngleSetup

PAIRS = {"alpha": ("forward", "nadir"), "beta": ("nadir", "aft")}
"""Angle -> the two lines that it lies between."""
_LINE_TIME = 1e-3
"""Seconds; of an image of one line only its middle is used."""
_LEAST_SIGMA = 1e-3
"""Metres. Points without errors are given this sigma, for an adjustment needs weights."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """What the analysis gets. Coordinates in one Cartesian frame, metres.

    Attributes:
        station: measured, with its covariance.
        strips: line -> measured ground points with their covariance.
        tangent: line -> laboratory's tangents of the points' directions from the line's centre, across the line and
            along it, (n, 2); X forward, Y to the right.
        along: line -> tangent of the angle of each point from the line's centre along the line, (n,).
    """

    station: Station
    strips: Mapping[str, Strip]
    tangent: Mapping[str, np.ndarray]
    along: Mapping[str, np.ndarray]

    def in_frame(self, axes: np.ndarray, origin: np.ndarray) -> Measurement:
        """The same in another frame; axes: its axes as rows in the present one, (3, 3), origin: (3,)."""
        station = Station((self.station.position - origin) @ axes.T, axes @ self.station.covariance @ axes.T)
        strips = {
            name: Strip((strip.points - origin) @ axes.T, axes @ strip.covariance @ axes.T)
            for name, strip in self.strips.items()
        }
        return replace(self, station=station, strips=strips)


@dataclass(frozen=True, eq=False)
class AnglePass:
    """The truth at the moment of exposure; made by `fly`. All coordinates in the ITRS, metres.

    Attributes:
        spec: the test.
        earth: its rotation and ellipsoid.
        trajectory: true orbit and attitude.
        laboratory: line -> camera as it was measured before launch.
        cameras: line -> camera as it is.
        pixel: places of the points on every line, (n,).
        height: line -> heights of its points above the ellipsoid, (n,).
    """

    spec: OrbitAngleSpec
    earth: Earth
    trajectory: Trajectory
    laboratory: Mapping[str, LineCamera]
    cameras: Mapping[str, LineCamera]
    pixel: np.ndarray
    height: Mapping[str, np.ndarray]

    @property
    def station(self) -> np.ndarray:
        """(3,)."""
        return self.trajectory.position(self.spec.time)

    @property
    def velocity(self) -> np.ndarray:
        """Against the stars, (3,), m/s."""
        return self.trajectory.inertial_velocity(self.spec.time)

    @property
    def effects(self) -> LightEffects:
        """Those of the file."""
        e = self.spec.effects
        return LightEffects(e.light_time, e.aberration, e.refraction, e.wavelength)

    @property
    def look(self) -> dict[str, float]:
        """True angles between the lines of sight of the lines' centres, radians."""
        return {name: look_angle(*(self.cameras[k] for k in pair)) for name, pair in PAIRS.items()}

    @property
    def dihedral(self) -> dict[str, float]:
        """True angles between the planes of the lines, radians."""
        return {name: dihedral_angle(*(self.cameras[k] for k in pair)) for name, pair in PAIRS.items()}

    @property
    def nadir_point(self) -> np.ndarray:
        """What the nadir line's centre sees, (3,); origin of the local level frame."""
        middle = np.array([0.5 * (self.cameras["nadir"].pixels - 1)])
        return self._sensor("nadir", NO_EFFECTS).ground(np.zeros(1), middle, self.spec.terrain.height)[0]

    @property
    def local(self) -> np.ndarray:
        """Axes of the local level frame as rows: east, north, up at `nadir_point`, (3, 3)."""
        lon, lat, _ = self.earth.geodetic(self.nadir_point)
        return east_north_up(lon, lat)

    @property
    def orbital(self) -> np.ndarray:
        """Axes of the orbital frame as rows: forward, right, down, (3, 3)."""
        return np.asarray(self.trajectory.orbital_to_itrs(self.spec.time).T)

    @property
    def nadir_line(self) -> np.ndarray:
        """Axes of the nadir line as rows: normal of its plane, along the line, line of sight of its middle, (3, 3)."""
        camera = self.cameras["nadir"]
        x = line_normal(camera)
        z = camera.look(np.array([0.5 * (camera.pixels - 1)]))[0]
        z = z - (z @ x) * x
        z = z / np.linalg.norm(z)
        return np.stack([x, np.cross(z, x), z]) @ self.trajectory.body_to_itrs(self.spec.time).T

    def ground(self, effects: LightEffects) -> dict[str, np.ndarray]:
        """Line -> true ground points, (n, 3), when these effects act on the light.

        Raises:
            BenchError: a look misses the Earth, or the time is too near the end of the orbit.
        """
        points = {
            name: self._sensor(name, effects).ground(np.zeros(1), self.pixel, self.height[name]) for name in LINES
        }
        if not all(np.all(np.isfinite(p)) for p in points.values()):
            raise BenchError("a look misses the Earth", ("attitude",), "an attitude in which all lines see the ground")
        return points

    def measure(
        self,
        points: Mapping[str, np.ndarray],
        seed: np.random.SeedSequence | None,
        corrected: LightEffects = NO_EFFECTS,
        datum: tuple[float, float, float] | None = None,
    ) -> Measurement:
        """Station and points as they are measured.

        Args:
            points: line -> true points, (n, 3).
            seed: of the errors; None for none but the datum's.
            corrected: effects that are taken out of the points.
            datum: shift of all points, east, north, up, metres; None for the file's.
        """
        errors, count = self.spec.errors, len(self.pixel)
        noise = np.zeros((1 + len(LINES) * count, 3))
        if seed is not None:
            noise = np.random.default_rng(seed).standard_normal(noise.shape)
        place = self.station + errors.station * noise[0]
        shift = np.array(errors.datum if datum is None else datum) @ self.local
        found = np.concatenate([points[name] for name in LINES]) + shift + errors.points * noise[1:]
        if corrected.light_time or corrected.aberration or corrected.refraction:
            found = without_effects(found, place, self.velocity, self.earth, corrected)
        sigma = max(errors.points, _LEAST_SIGMA)
        strips = {name: Strip.of(p, sigma) for name, p in zip(LINES, np.split(found, len(LINES)), strict=True)}
        tangents = {name: interior_tangents(self.laboratory[name], self.pixel) for name in LINES}
        return Measurement(
            Station.of(place, errors.station),
            strips,
            {name: both for name, (both, _) in tangents.items()},
            {name: along for name, (_, along) in tangents.items()},
        )

    def height_per_arcsec(self) -> dict[str, float | None]:
        """How far a wrong angle of one arcsecond moves heights that are intersected from its two lines, metres.

        The point below the nadir line's centre is looked up in the other line's image, that line is then turned by 1
        arcsec about the body's Y, and the two rays are intersected; None where the orbit is too short for the other
        line to see the point. No effects on the light.
        """
        point = self.nadir_point
        first = self._ray("nadir", point, 0.0)
        out: dict[str, float | None] = {}
        for angle, (a, b) in PAIRS.items():
            other = a if b == "nadir" else b
            rays = [self._ray(other, point, turn) for turn in (0.0, np.radians(1.0 / 3600.0))]
            if first is None or any(ray is None for ray in rays):
                out[angle] = None
                continue
            heights = [self.earth.geodetic(_nearest(first, ray))[2] for ray in rays if ray is not None]
            out[angle] = float(abs(heights[1] - heights[0]))
        return out

    def _ray(self, name: str, point: np.ndarray, turn: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Station and direction of the look that sees a point, the line turned afterwards; None if none does."""
        first, last = self.trajectory.first, self.trajectory.last
        lines = int((last - first) / _LINE_TIME) - 1
        sensor = Sensor(
            self.cameras[name], self.trajectory, self.earth, _LINE_TIME, first + _LINE_TIME, lines, NO_EFFECTS
        )
        line, pixel = sensor.image(point[None])
        if not np.isfinite(line[0]):
            return None
        seconds = sensor.time(line)[0]
        body = about_axis(1, turn) @ self.cameras[name].look(pixel)[0]
        return self.trajectory.position(seconds), self.trajectory.body_to_itrs(seconds) @ body

    def _sensor(self, name: str, effects: LightEffects) -> Sensor:
        try:
            return Sensor(self.cameras[name], self.trajectory, self.earth, _LINE_TIME, self.spec.time, 1, effects)
        except ValueError as error:
            raise BenchError(str(error), ("time",), "a time inside the orbit, or a longer orbit") from error


def fly(setup: AngleSetup, seed: np.random.SeedSequence) -> AnglePass:
    """Put the satellite into its orbit and draw the terrain.

    Raises:
        BenchError: there is no such orbit.
    """
    spec = setup.test
    earth = Earth.from_spec(spec.earth)
    try:
        orbit = propagate(spec.orbit, earth)
    except ValueError as error:
        raise BenchError(str(error), ("orbit",), "an orbit that exists and stays above the ground") from error
    laboratory = {name: camera for name, camera in line_cameras(setup.camera).items() if name in LINES}
    cameras = {
        name: replace(camera, directions=camera.directions @ rotation_matrix(spec.changes.get(name, (0.0,) * 3)).T)
        for name, camera in laboratory.items()
    }
    pixel = np.linspace(spec.strips.first, spec.strips.last, spec.strips.points)
    above = float(earth.geodetic(orbit.itrs(spec.time)[0])[2]) - spec.terrain.height
    height = {
        name: _terrain(spec, above * _spread(laboratory[name], pixel), np.random.default_rng(stream))
        for name, stream in zip(LINES, seed.spawn(len(LINES)), strict=True)
    }
    trajectory = Trajectory(orbit, Attitude.from_spec(spec.attitude))
    return AnglePass(spec, earth, trajectory, FrozenMap(laboratory), FrozenMap(cameras), pixel, FrozenMap(height))


def interior_tangents(camera: LineCamera, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is known of a line's interior: directions of its pixels (N,) from the direction of its centre.

    Returns:
        Tangents across (forward) and along (to the right) in the body's axes pitched to the centre, (N, 2); tangent of
        the angle from the centre within the line, positive to the right, (N,).
    """
    centre = camera.look(np.array([0.5 * (camera.pixels - 1)]))[0]
    seen = camera.look(pixel)
    pitched = seen @ about_axis(1, np.arctan2(centre[0], centre[2]))
    turn = np.linalg.norm(np.cross(centre, seen), axis=-1) / (seen @ centre)
    return pitched[:, :2] / pitched[:, 2:], np.copysign(turn, seen[:, 1] - centre[1])


def without_effects(
    points: np.ndarray, station: np.ndarray, velocity: np.ndarray, earth: Earth, effects: LightEffects
) -> np.ndarray:
    """Where ground points (N, 3) would lie on the lines of sight that see them, if nothing happened to the light.

    Args:
        points: ITRS, metres.
        station: (3,), metres.
        velocity: of the satellite against the stars in axes of the ITRS, (3,), m/s.
        earth: the ellipsoid.
        effects: to take out.

    Returns:
        (N, 3), at the distances of the points.
    """
    source = points
    way = np.linalg.norm(source - station, axis=-1) / SPEED_OF_LIGHT * effects.light_time
    place = turned_with_earth(np.broadcast_to(station, source.shape), way)
    if effects.refraction:
        source = unrefracted(source, place, earth, effects.wavelength)
    arm = turned_with_earth(source - place, -way)
    if effects.aberration:
        arm = aberrated(arm / np.linalg.norm(arm, axis=-1, keepdims=True), velocity)
        arm = arm * np.linalg.norm(points - station, axis=-1, keepdims=True)
    return np.asarray(station + arm)


def _spread(camera: LineCamera, pixel: np.ndarray) -> np.ndarray:
    """Places on flat ground along the strip, (N,), in heights of the satellite."""
    look = camera.look(pixel)
    return np.asarray(look[:, 1] / look[:, 2])


def _terrain(spec: OrbitAngleSpec, place: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Heights (N,) at places along a strip, metres: a normal process with a Gaussian correlation."""
    away = (place[:, None] - place) / spec.terrain.length
    values, vectors = np.linalg.eigh(np.exp(-0.5 * away**2))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(spec.terrain.height + spec.terrain.relief * (root @ random.standard_normal(len(place))))


def _nearest(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The point nearest to two rays, (3,)."""
    weights = [np.eye(3) - np.outer(d, d) for _, d in (a, b)]
    return np.linalg.solve(weights[0] + weights[1], weights[0] @ a[0] + weights[1] @ b[0])
