"""Simulated truth and measurement at one moment of a pass, for tests of the angles between line cameras.

The measurement has errors of the orbit at the station, and errors of the ground points from matching and aerial
triangulation. Besides these coordinates, the analysis uses only the laboratory's measurement of each line camera before
launch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.orbit.planes import Station, Strip
from optics.geometry.pose import about_axis, rotation_matrix
from optics.geometry.tree import State
from optics.numerics.array_math import covariance_root
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.job_state import motions_of
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.job import JobSpec, PerturbationSpec
from scenes.specs.perturbation import perturbation_issues
from scenes.yaml.errors import InputError
from twin.framework.procedure import BenchError
from twin.monitor.truth import trace_truth
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.line_camera import LineAngles, LineCamera, line_cameras, line_normal, traced_line_cameras
from twin.orbit.flight.sensor import (
    NO_EFFECTS,
    SPEED_OF_LIGHT,
    LightEffects,
    Sensor,
    aberrated,
    rotated_with_earth,
    unrefracted,
)
from twin.orbit.flight.trajectory import Trajectory

if TYPE_CHECKING:
    from scenes.specs.orbit.angle import OrbitAngleSpec
    from scenes.specs.orbit.setup import AngleSetup


@dataclass(frozen=True, eq=False)
class AngleCamera:
    """Line cameras on their common base, before launch and in orbit.

    Attributes
    ----------
    laboratory : Mapping[str, LineCamera]
        Name of the line -> camera as the laboratory measured it before launch, which the analysis knows.
    cameras : Mapping[str, LineCamera]
        Line -> camera as it is in orbit.
    trace : Mapping[str, float]
        Name of the angle -> change of the angle since the laboratory by exact ray trace
        (`twin.monitor.truth.trace_truth`), in radians; only for the two cameras of a pair.
    """

    laboratory: Mapping[str, LineCamera]
    cameras: Mapping[str, LineCamera]
    trace: Mapping[str, float]


def angle_camera(setup: AngleSetup, backend: Backend | None) -> AngleCamera:
    """Return the line cameras before and after the test's changes: rotated for a payload, traced for an instrument.

    Parameters
    ----------
    setup : AngleSetup
        Resolved test file and camera.
    backend : Backend or None
        Backend on which an instrument is traced; a payload needs none.

    Raises
    ------
    InputError
        A change is not possible for this instrument, or a temperature is not possible.
    BenchError
        The changes move the image off the mirrors.
    """
    spec = setup.test
    if setup.camera is not None:
        laboratory = line_cameras(setup.camera)
        rotations = {name: rotation_matrix(change.rotate).T for name, change in spec.perturb.items()}
        changed = {
            name: line.rotated(rotations[name]) if name in rotations else line for name, line in laboratory.items()
        }
        return AngleCamera(FrozenMap(laboratory), FrozenMap(changed), FrozenMap())
    if setup.instrument is None or backend is None:
        raise ValueError("an instrument's lines need a backend to be traced")
    instrument = build_instrument(setup.instrument, setup.cameras, backend)
    state = _changed_state(spec, instrument)
    laboratory = traced_line_cameras(instrument, backend)
    try:
        cameras = traced_line_cameras(instrument, backend, state)
        change = float(trace_truth(instrument, backend, [state]).angle_change[0])
    except (AimError, BeamMissedError) as error:
        raise BenchError(str(error), ("perturb",), "smaller changes, which leave the image on the mirrors") from error
    trace = {name: change for name, pair in setup.angles.items() if len(cameras) == 2 and set(pair) == set(cameras)}
    return AngleCamera(FrozenMap(laboratory), FrozenMap(cameras), FrozenMap(trace))


def _changed_state(spec: OrbitAngleSpec, instrument: Instrument) -> State:
    """Return the state of an instrument after the changes of a test.

    Raises
    ------
    InputError
        A node does not exist or does not allow its change, or a temperature is not possible.
    """
    issues = [
        issue
        for path, change in spec.perturb.items()
        for issue in perturbation_issues(spec, instrument.nodes, path, change, ("perturb", path))
    ]
    if issues:
        raise InputError(*issues)
    job = JobSpec.model_construct(instrument=spec.camera, perturb=PerturbationSpec.of(spec.perturb))
    thermal = ThermalModel(instrument)
    try:
        thermal.check(job.fields())
        return thermal.state(job.fields(), motions_of(job))
    except TemperatureError as error:
        raise spec.error(str(error), ("perturb", error.origin, "temperature"), allowed=error.allowed) from error


_LINE_TIME = 1e-3
"""Time per image line, in seconds; points are seen in the middle of a single line, so that its value hardly matters."""
LEAST_SIGMA = 1e-3
"""Sigma assumed for points that are simulated without errors, in metres, because an adjustment needs weights."""
_LEAST_CONVERGENCE = np.radians(1.0)
"""Smallest angle between lines, in radians, at which heights are intersected: below it, an error of one arcsecond in
the angle changes the height by half a kilometre or more.
"""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measured station and ground points in one Cartesian frame, with each line's interior orientation.

    Attributes
    ----------
    pairs : Mapping[str, tuple[str, str]]
        Angle -> its two lines.
    station : Station
        Measured station, with its covariance.
    strips : Mapping[str, Strip]
        Line -> measured ground points, with their covariances.
    tangent : Mapping[str, (n, 2) ndarray for n points]
        Line -> tangents of the angles between the points' directions and that of the line's centre, across the line (X,
        forward) and along it (Y, to the right), as the laboratory measured them.
    along : Mapping[str, (n,) ndarray]
        Line -> tangent of the angle between each point's direction and that of the line's centre, positive to the
        right.
    look : Mapping[str, float]
        Line -> laboratory's angle of the line's centre from the body's Z about its Y, in radians.
    offset : Mapping[str, (n, 3) ndarray]
        Line -> laboratory's projection centre of each point, in the axes of its tangents, in metres.
    bow : Mapping[str, (n, 3) ndarray]
        Line -> correction of each direction, in the axes of its tangents, that brings it into one plane with the line's
        centre and its middle direction: the image of a mirror camera's line is bent.
    """

    pairs: Mapping[str, tuple[str, str]]
    station: Station
    strips: Mapping[str, Strip]
    tangent: Mapping[str, np.ndarray]
    along: Mapping[str, np.ndarray]
    look: Mapping[str, float]
    offset: Mapping[str, np.ndarray]
    bow: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, laboratory: LineAngles, station: Station, strips: Mapping[str, Strip]) -> Measurement:
        """Combine a measured station and ground points with the laboratory's interior orientation of the lines.

        Parameters
        ----------
        laboratory : LineAngles
            Lines as the laboratory measured them, and the pixels of the points.
        station : Station
            Measured station.
        strips : Mapping[str, Strip]
            Line -> measured ground points, for each line of the angles.
        """
        interiors = {name: _interior(laboratory.cameras[name], laboratory.pixel[name]) for name in strips}
        fields = {
            key: {name: interior[key] for name, interior in interiors.items()} for key in next(iter(interiors.values()))
        }
        return cls(laboratory.pairs, station, strips, **fields)

    @property
    def which(self) -> list[tuple[int, int]]:
        """Pairs of indices into `strips`, in their order: the two lines of each angle."""
        lines = list(self.strips)
        return [(lines.index(a), lines.index(b)) for a, b in self.pairs.values()]

    def in_frame(self, axes: np.ndarray, origin: np.ndarray) -> Measurement:
        """Return the measurement in another frame.

        Parameters
        ----------
        axes : (3, 3) ndarray
            Axes of that frame as rows, in the present one.
        origin : (3,) ndarray
            Origin of that frame in the present one, in metres.
        """
        station = Station((self.station.position - origin) @ axes.T, axes @ self.station.covariance @ axes.T)
        strips = {
            name: Strip((strip.points - origin) @ axes.T, axes @ strip.covariance @ axes.T)
            for name, strip in self.strips.items()
        }
        return replace(self, station=station, strips=strips)


@dataclass(frozen=True, eq=False, kw_only=True)
class AnglePass(LineAngles):
    """Simulated truth at the moment of exposure, from `fly`; all coordinates in the ITRS, in metres.

    The cameras are those in orbit, after the changes since launch, so that the angles are the true ones.

    Attributes
    ----------
    spec : OrbitAngleSpec
        Content of the test file.
    earth : Earth
        Rotation and ellipsoid of the Earth.
    trajectory : Trajectory
        True orbit and attitude.
    laboratory : Mapping[str, LineCamera]
        Line -> camera as it was measured before launch.
    trace : Mapping[str, float]
        Name of the angle -> change of the angle since the laboratory by exact ray trace
        (`twin.monitor.truth.trace_truth`), in radians; empty for lines that are not the two cameras of a traced pair.
    height : Mapping[str, (n,) ndarray for n points]
        Line -> heights of its points above the ellipsoid, in metres.
    """

    spec: OrbitAngleSpec
    earth: Earth
    trajectory: Trajectory
    laboratory: Mapping[str, LineCamera]
    trace: Mapping[str, float]
    height: Mapping[str, np.ndarray]

    @property
    def lines(self) -> tuple[str, ...]:
        """Names of the lines that an angle uses, in the order of the camera's file."""
        return tuple(self.pixel)

    @property
    def reference(self) -> str:
        """Name of the line camera with zero look angle in a resection: the second line of the file's first angle."""
        return next(iter(self.pairs.values()))[1]

    @property
    def station(self) -> np.ndarray:
        """True position of the satellite, (3,), in metres."""
        return self.trajectory.position(self.spec.time)

    @property
    def velocity(self) -> np.ndarray:
        """True inertial velocity of the satellite, (3,), in m/s."""
        return self.trajectory.inertial_velocity(self.spec.time)

    @property
    def effects(self) -> LightEffects:
        """Effects on the light (light time, aberration, refraction) that the test's file switches on."""
        return LightEffects.of(self.spec.effects)

    @property
    def before_launch(self) -> LineAngles:
        """Angles between the line cameras as the laboratory measured them before launch."""
        return LineAngles(self.laboratory, self.pairs, self.pixel)

    @property
    def middle_point(self) -> np.ndarray:
        """Ground point that the reference line's centre sees, (3,); origin of the local level frame."""
        middle = np.array([0.5 * (self.cameras[self.reference].pixels - 1)])
        return self._sensor(self.reference, NO_EFFECTS).ground(np.zeros(1), middle, self.spec.terrain.height)[0]

    @property
    def local(self) -> np.ndarray:
        """Axes of the local level frame as rows: east, north, up at `middle_point`, (3, 3)."""
        lon, lat, _ = self.earth.geodetic(self.middle_point)
        return east_north_up(lon, lat)

    @property
    def orbital(self) -> np.ndarray:
        """Axes of the orbital frame as rows: forward, right, down, (3, 3)."""
        return np.asarray(self.trajectory.orbital_to_itrs(self.spec.time).T)

    @property
    def line_axes(self) -> np.ndarray:
        """Axes of the reference line as rows, (3, 3).

        They are the normal of its plane, the direction along the line, and the line of sight of its middle.
        """
        camera = self.cameras[self.reference]
        x = line_normal(camera)
        z = camera.look(np.array([0.5 * (camera.pixels - 1)]))[0]
        z = z - (z @ x) * x
        z = z / np.linalg.norm(z)
        return np.stack([x, np.cross(z, x), z]) @ self.trajectory.body_to_itrs(self.spec.time).T

    def ground(self, effects: LightEffects) -> dict[str, np.ndarray]:
        """Return the true ground points that each line sees under given effects on the light, ITRS, in metres.

        Parameters
        ----------
        effects : LightEffects
            Effects on the light (light time, aberration, refraction) that are switched on.

        Returns
        -------
        dict of str to (n, 3) ndarray for n points
            Line -> ground points.

        Raises
        ------
        BenchError
            A line of sight misses the Earth, or the time is too near the end of the orbit.
        """
        points = {
            name: self._sensor(name, effects).ground(np.zeros(1), self.pixel[name], self.height[name])
            for name in self.lines
        }
        if not all(np.all(np.isfinite(p)) for p in points.values()):
            raise BenchError(
                "a line of sight misses the Earth", ("attitude",), "an attitude in which all lines see the ground"
            )
        return points

    def measure(
        self,
        points: Mapping[str, np.ndarray],
        seed: np.random.SeedSequence | None,
        corrected: LightEffects = NO_EFFECTS,
        datum: tuple[float, float, float] | None = None,
    ) -> Measurement:
        """Simulate the measurement of the station and the points.

        Parameters
        ----------
        points : Mapping[str, (n, 3) ndarray for n points]
            Line -> true points, ITRS, in metres.
        seed : np.random.SeedSequence or None
            Seed of the random errors; None for points without errors other than the shift of the datum.
        corrected : LightEffects
            Effects on the light for which the analysis corrects the points.
        datum : tuple of float, optional
            Shift of all points east, north and up, in metres; None for the shift in the test's file.
        """
        errors, lines = self.spec.errors, self.lines
        noise = np.zeros((1 + sum(len(points[name]) for name in lines), 3))
        if seed is not None:
            noise = np.random.default_rng(seed).standard_normal(noise.shape)
        position = self.station + errors.station * noise[0]
        shift = np.array(errors.datum if datum is None else datum) @ self.local
        measured = np.concatenate([points[name] for name in lines]) + shift + errors.points * noise[1:]
        if corrected.names:
            measured = without_effects(measured, position, self.velocity, self.earth, corrected)
        sigma = max(errors.points, LEAST_SIGMA)
        strips = {name: Strip.of(p, sigma) for name, p in zip(lines, np.split(measured, len(lines)), strict=True)}
        return Measurement.of(self.before_launch, Station.of(position, errors.station), strips)

    def height_per_arcsec(self) -> dict[str, float | None]:
        """Return, by angle, the error of intersected heights for an error of 1 arcsec in that angle, in metres.

        The point that the centre of the reference line sees (or the centre of the second line, where the reference is
        not one of the angle's two lines) is located in the other line's image. That line is then rotated by 1 arcsec
        about the body's Y axis, and the two rays are intersected, without effects on the light. The value is None where
        the orbit is too short for the other line to see the point, and for lines so nearly parallel that they give no
        heights.
        """
        heights_by_angle: dict[str, float | None] = {}
        look = self.look
        for angle, (a, b) in self.pairs.items():
            heights_by_angle[angle] = None
            if look[angle] < _LEAST_CONVERGENCE:
                continue
            base, other = (a, b) if a == self.reference else (b, a)
            middle = np.array([0.5 * (self.cameras[base].pixels - 1)])
            point = self._sensor(base, NO_EFFECTS).ground(np.zeros(1), middle, self.spec.terrain.height)[0]
            first = self._ray(base, point, 0.0)
            rays = [self._ray(other, point, rotation) for rotation in (0.0, np.radians(1.0 / 3600.0))]
            if first is None or any(ray is None for ray in rays):
                continue
            heights = [self.earth.geodetic(_nearest(first, ray))[2] for ray in rays if ray is not None]
            heights_by_angle[angle] = float(abs(heights[1] - heights[0]))
        return heights_by_angle

    def _ray(self, name: str, point: np.ndarray, rotation: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the ray of the pixel that sees a point, after a rotation of the line; None if no pixel sees it.

        The ray is a pair of (3,) arrays, projection centre in metres and direction; the rotation is in radians.
        """
        first, last = self.trajectory.first, self.trajectory.last
        lines = int((last - first) / _LINE_TIME) - 1
        sensor = Sensor(
            self.cameras[name], self.trajectory, self.earth, _LINE_TIME, first + _LINE_TIME, lines, NO_EFFECTS
        )
        line, pixel = sensor.image(point[None])
        if not np.isfinite(line[0]):
            return None
        seconds = sensor.time(line)[0]
        body = about_axis(1, rotation) @ self.cameras[name].look(pixel)[0]
        axes = self.trajectory.body_to_itrs(seconds)
        return self.trajectory.position(seconds) + axes @ self.cameras[name].origin(pixel)[0], axes @ body

    def _sensor(self, name: str, effects: LightEffects) -> Sensor:
        try:
            return Sensor(self.cameras[name], self.trajectory, self.earth, _LINE_TIME, self.spec.time, 1, effects)
        except ValueError as error:
            raise BenchError(str(error), ("time",), "a time inside the orbit, or a longer orbit") from error


def fly(setup: AngleSetup, camera: AngleCamera, seed: np.random.SeedSequence) -> AnglePass:
    """Simulate the pass: propagate the orbit and draw the terrain.

    Parameters
    ----------
    setup : AngleSetup
        Resolved test file and camera.
    camera : AngleCamera
        Lines of the camera, from `angle_camera`.
    seed : np.random.SeedSequence
        Seed of the terrain.

    Raises
    ------
    BenchError
        No such orbit exists.
    """
    spec = setup.test
    trajectory = Trajectory.of_test(spec, seed)
    earth = trajectory.orbit.earth
    used = [name for name in setup.pixels if any(name in pair for pair in setup.angles.values())]
    share = (np.linspace(spec.strips.first, spec.strips.last, spec.strips.points) + 0.5) / setup.usual_pixels
    pixel = {name: share * setup.pixels[name] - 0.5 for name in used}
    above = float(earth.geodetic(trajectory.position(spec.time))[2]) - spec.terrain.height
    height = {
        name: _terrain(spec, above * _spread(camera.laboratory[name], pixel[name]), np.random.default_rng(stream))
        for name, stream in zip(used, seed.spawn(len(used)), strict=True)
    }
    return AnglePass(
        cameras=camera.cameras,
        pairs=FrozenMap(setup.angles),
        pixel=FrozenMap(pixel),
        spec=spec,
        earth=earth,
        trajectory=trajectory,
        laboratory=camera.laboratory,
        trace=camera.trace,
        height=FrozenMap(height),
    )


def _interior(camera: LineCamera, pixel: np.ndarray) -> dict[str, Any]:
    """Return the interior orientation of N pixels (N,) of a line, as the fields of a `Measurement`.

    Tangents are counted across the line (forward) and along it (to the right), in the body's axes rotated about Y to
    the line's centre; the angle within the line is positive to the right.
    """
    centre = camera.look(np.array([0.5 * (camera.pixels - 1)]))[0]
    looks = camera.look(pixel)
    look = float(np.arctan2(centre[0], centre[2]))
    pitch = about_axis(1, look)
    pitched = looks @ pitch
    tangent = np.linalg.norm(np.cross(centre, looks), axis=-1) / (looks @ centre)
    normal = line_normal(camera, pixel)
    normal = normal - (normal @ centre) * centre
    normal = normal / np.linalg.norm(normal)
    return {
        "tangent": pitched[:, :2] / pitched[:, 2:],
        "along": np.copysign(tangent, looks[:, 1] - centre[1]),
        "look": look,
        "offset": camera.origin(pixel) @ pitch,
        "bow": -np.outer(looks @ normal, normal @ pitch),
    }


def without_effects(
    points: np.ndarray, station: np.ndarray, velocity: np.ndarray, earth: Earth, effects: LightEffects
) -> np.ndarray:
    """Correct N ground points for effects on the light, as if their lines of sight were straight.

    Parameters
    ----------
    points : (N, 3) ndarray
        Ground points in the ITRS, in metres.
    station : (3,) ndarray
        Position of the satellite, in metres.
    velocity : (3,) ndarray
        Inertial velocity of the satellite in axes of the ITRS, in m/s.
    earth : Earth
        Ellipsoid.
    effects : LightEffects
        Effects on the light to correct.

    Returns
    -------
    (N, 3) ndarray
        Corrected points, ITRS, in metres, at unchanged distances from the satellite.
    """
    source = points
    delay = np.linalg.norm(source - station, axis=-1) / SPEED_OF_LIGHT * effects.light_time
    position = rotated_with_earth(np.broadcast_to(station, source.shape), delay)
    if effects.refraction:
        source = unrefracted(source, position, earth, effects.wavelength)
    arm = rotated_with_earth(source - position, -delay)
    if effects.aberration:
        arm = aberrated(arm / np.linalg.norm(arm, axis=-1, keepdims=True), velocity)
        arm = arm * np.linalg.norm(points - station, axis=-1, keepdims=True)
    return np.asarray(station + arm)


def _spread(camera: LineCamera, pixel: np.ndarray) -> np.ndarray:
    """Return the across-track positions on flat ground that N pixels see, divided by the flying height, (N,)."""
    look = camera.look(pixel)
    return np.asarray(look[:, 1] / look[:, 2])


def _terrain(spec: OrbitAngleSpec, position: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Draw heights at N positions along a strip, (N,), in metres: a Gaussian process with a Gaussian correlation."""
    distance = (position[:, None] - position) / spec.terrain.length
    unit = covariance_root(np.exp(-0.5 * distance**2)) @ random.standard_normal(len(position))
    return np.asarray(spec.terrain.height + spec.terrain.relief * unit)


def _nearest(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the (3,) point nearest to two rays, each given as origin and direction, in metres."""
    weights = [np.eye(3) - np.outer(d, d) for _, d in (a, b)]
    return np.linalg.solve(weights[0] + weights[1], weights[0] @ a[0] + weights[1] @ b[0])
