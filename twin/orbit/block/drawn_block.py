"""Simulated block of scenes with all its measurements, drawn from the noise models (error laws) of the file.

The readings of orbit and attitude are those of a smooth orbit; the true platform departs from them by random processes,
each simulated by its definition: random readings interpolated by a cubic spline, random walks (sums of steps), or
oscillations of random amplitude. The images are those of the rigorous sensor on the true platform, with cameras that
have changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from analysis.block import block as model
from analysis.block.error_processes import STEPPED, Law
from analysis.orbit.calibration_parameters import level_covariance, vertical
from analysis.orbit.three_line_model import Rays
from optics.numerics.array_math import covariance_root
from scenes.specs.orbit.adjust import BlockPassSpec, OrbitAdjustSpec, ReadingLawsSpec
from scenes.specs.orbit.flight import AttitudeSpec
from scenes.specs.orbit.setup import AdjustSetup
from twin.framework.procedure import BenchError, stream
from twin.orbit.block.measured_block import (
    MonitorSource,
    camera_sigmas,
    change_covariance,
    law_of,
    monitored_camera,
    seconds_from_first,
)
from twin.orbit.calibration.campaign import PassData, line_model, pass_data, passing_orbit
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.line_camera import LineTimes, drifted_payload, line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.sensor import NO_EFFECTS, Platform, Sensor
from twin.orbit.flight.trajectory import Attitude, Trajectory
from twin.orbit.measured.pass_measurements import ImagePoints, point_names

Course = Callable[[np.ndarray], np.ndarray]
Monitored = dict[str, model.CameraPrior] | model.JointCameraPrior
_BEYOND = 30
"""Number of readings simulated beyond both ends of a time series of errors, because the influence of the ends on a
cubic spline decreases by a factor of 0.27 per reading.
"""
_SPARE = 4.0
"""Number of candidate ground points drawn per required point; those that fewer than two scenes see are dropped."""
_DAY = 86400.0
_MOST_STEPS = 1e5
"""Largest number of values in the simulated time series of one noise model of the file."""
_PLACES, _IMAGES, _LASER, _TERRAIN, _CONTROL, _COURSES, _CAMERAS, _GROSS = range(8)
"""Numbers of the random streams of a block's seed: ground points, image points, laser shots, terrain, control points,
errors over time, cameras, gross errors.
"""


@dataclass(frozen=True, eq=False)
class TruePlatform:
    """True platform of a pass, which departs from the smooth readings by a rotation and a shift.

    Attributes
    ----------
    readings : Platform
        Smooth orbit and attitude that the readings give.
    axes : (3, 3) ndarray
        Body axes in the middle of the pass as columns, ITRS.
    rotation : Course
        Function of n times of the block (n,), in seconds, that returns rotation vectors (n, 3), in radians.
    shift : Course
        Function of n times of the block (n,), in seconds, that returns shifts (n, 3) along `axes`, in metres.
    begin : float
        Time of the block at which the readings' time is zero, in seconds.
    """

    readings: Platform
    axes: np.ndarray
    rotation: Course
    shift: Course
    begin: float

    def position(self, seconds: np.ndarray) -> np.ndarray:
        """Return the true positions at n times on the readings' time scale, (n, 3), ITRS, in metres."""
        position: np.ndarray = self.readings.position(seconds) + self.shift(seconds + self.begin) @ self.axes.T
        return position

    def inertial_velocity(self, seconds: np.ndarray) -> np.ndarray:
        """Return the true inertial velocities at n times on the readings' time scale, (n, 3), ITRS axes, in m/s."""
        return self.readings.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: np.ndarray) -> np.ndarray:
        """Return the true rotations from body to ITRS axes at n times on the readings' time scale, (n, 3, 3)."""
        rotation = Rotation.from_rotvec(self.rotation(seconds + self.begin)).as_matrix()
        return np.asarray(self.readings.body_to_itrs(seconds) @ rotation)


@dataclass(frozen=True, eq=False)
class DrawnBlock:
    """Simulated block with its truth.

    Attributes
    ----------
    block : analysis.block.block.Block
        Priors and measurements.
    ground : (m, 3) ndarray for m points
        True points, ITRS, in metres.
    change : Mapping[str, ndarray]
        Scene -> (4,) true change of its camera since calibration: rotations d_alpha, d_beta, d_gamma, in radians, and
        change d_f of the principal distance, in metres.
    platforms : Mapping[str, TruePlatform]
        Pass -> true platform.
    gross : Mapping[str, ndarray]
        Scene -> (k,) indices of the k points whose image points have gross errors.
    """

    block: model.Block
    ground: np.ndarray
    change: Mapping[str, np.ndarray]
    platforms: Mapping[str, TruePlatform]
    gross: Mapping[str, np.ndarray]


def draw_course(law: Law, first: float, last: float, random: np.random.Generator) -> Course:
    """Draw a random time series of a noise model between two times, in seconds; return it as a function of time."""
    sigma, middle = np.array(law.sigma), 0.5 * (first + last)
    if law.kind in ("constant", "rate"):
        value = sigma * random.standard_normal(3)
        if law.kind == "rate":
            return lambda t: (t - middle)[:, None] * value
        return lambda t: np.broadcast_to(value, (len(t), 3))
    if law.kind == "orbital":
        a, b = sigma * random.standard_normal((2, 3))
        phase = 2.0 * np.pi / law.time
        return lambda t: np.cos(phase * t)[:, None] * a + np.sin(phase * t)[:, None] * b
    number = np.arange(np.floor(first / law.interval) - _BEYOND, np.floor(last / law.interval) + _BEYOND + 1)
    steps = random.standard_normal((len(number), 3))
    if law.kind == "white":
        spline: Course = make_interp_spline(law.interval * number, sigma * steps, k=3)
        return spline
    if law.kind == "walk":
        values = np.cumsum(steps, axis=0) * np.sqrt(law.interval)
        values = values - values[np.flatnonzero(number == np.round(middle / law.interval))[0]]
    else:
        values = _slow(steps, law)
    if law.kind == "jitter":
        both = np.concatenate([values, _slow(random.standard_normal(steps.shape), law)], axis=1)
        amplitude: Course = make_interp_spline(law.interval * number, np.tile(sigma, 2) * both, k=1)
        omega = 2.0 * np.pi * law.frequency
        return lambda t: (
            np.cos(omega * t)[:, None] * amplitude(t)[:, :3] + np.sin(omega * t)[:, None] * amplitude(t)[:, 3:]
        )
    line: Course = make_interp_spline(law.interval * number, sigma * values, k=1)
    return line


def _slow(steps: np.ndarray, law: Law) -> np.ndarray:
    """Return a stationary first-order (Gauss-Markov) process of unit variance, (k, 3) for k times and three axes.

    Parameters
    ----------
    steps : (k, 3) ndarray
        Independent standard normal numbers.
    law : Law
        Noise model, which gives the interval and the correlation time.
    """
    correlation = np.exp(-law.interval / law.time)
    values = steps.copy()
    for k in range(1, len(steps)):
        values[k] = correlation * values[k - 1] + np.sqrt(1.0 - correlation**2) * steps[k]
    return values


def _courses(
    spec: OrbitAdjustSpec, laws: ReadingLawsSpec, begin: Mapping[str, float], seed: np.random.SeedSequence
) -> tuple[dict[str, list[Course]], dict[str, list[Course]], dict[str, np.ndarray]]:
    """Draw errors of attitude and station over time in each pass, and the constant rotation of each star tracker."""
    attitudes: dict[str, list[Course]] = {name: [] for name in begin}
    stations: dict[str, list[Course]] = {name: [] for name in begin}
    constants: dict[str, np.ndarray] = {}
    number = 0
    for courses, named in ((attitudes, laws.attitude), (stations, laws.orbit)):
        for name, law_spec in named.items():
            term = law_of(name, law_spec)
            scopes: dict[str, list[str]] = {}
            for of, single in spec.passes.items():
                scope = {"pass": of, "tracker": single.tracker, "block": ""}[term.scope]
                scopes.setdefault(scope, []).append(of)
            for scope, members in scopes.items():
                first = min(begin[m] for m in members) - spec.span
                last = max(begin[m] for m in members) + spec.span
                random = np.random.default_rng(stream(seed, number))
                number += 1
                if (last - first) / term.law.interval > _MOST_STEPS and term.law.kind in STEPPED:
                    problem = (
                        f"{name}: a course has more than {_MOST_STEPS:.0e} values; are passes too far apart to share "
                        "it?"
                    )
                    raise BenchError(problem, ("errors",), "`shared_by: pass`, or a longer interval")
                course = draw_course(term.law, first, last, random)
                if term.scope == "tracker" and term.law.kind == "constant":
                    constants[scope] = constants.get(scope, np.zeros(3)) + course(np.zeros(1))[0]
                for m in members:
                    courses[m].append(course)
    return attitudes, stations, constants


def _summed(parts: list[Course]) -> Course:
    return lambda t: np.asarray(sum((part(t) for part in parts), np.zeros((len(t), 3))))


def _cameras(
    spec: OrbitAdjustSpec, days: np.ndarray, random: np.random.Generator, recorded: model.JointCameraPrior | None
) -> tuple[dict[str, np.ndarray], dict[str, model.CameraPrior], Monitored | None]:
    """Draw the true changes of each line's camera, (T, 4) for T passes.

    The four changes are the rotations d_alpha, d_beta, d_gamma about the camera's Y, X and line of sight (rad), and the
    change d_f of the principal distance (m). They are returned with their prior distributions before and after the
    monitor's readings.
    """
    if recorded is not None:
        drawn = covariance_root(recorded.covariance) @ random.standard_normal(len(recorded.covariance))
        changes = recorded.mean + drawn.reshape(recorded.mean.shape)
        laws = {line: change_covariance(spec.changes[line], days) for line in spec.lines}
        nothing = np.zeros((len(days), 4))
        before = {line: model.CameraPrior(nothing, law) for line, law in laws.items()}
        return dict(zip(recorded.cameras, changes, strict=True)), before, recorded
    true, expected, monitored = {}, {}, {}
    for line in spec.lines:
        law = change_covariance(spec.changes[line], days)
        drawn = covariance_root(law) @ random.standard_normal(len(law))
        true[line] = drawn.reshape(-1, 4)
        expected[line] = model.CameraPrior(np.zeros((len(days), 4)), law)
        noise = random.standard_normal(len(drawn))
        if spec.monitor is not None:
            sigma = np.tile(camera_sigmas(spec.monitor), len(days))
            monitored[line] = monitored_camera(law, drawn + sigma * noise, sigma)
    return true, expected, monitored if spec.monitor is not None else None


def _trajectory(spec: OrbitAdjustSpec, name: str, pass_spec: BlockPassSpec, earth: Earth) -> Trajectory:
    longitude = spec.area.longitude if pass_spec.longitude is None else pass_spec.longitude
    latitude = spec.area.latitude if pass_spec.latitude is None else pass_spec.latitude
    orbit = passing_orbit(pass_spec.epoch, spec.span, spec.altitude, longitude, latitude, pass_spec.direction)
    roll, pitch, yaw = spec.attitude.offset
    held = AttitudeSpec(nadir=spec.attitude.nadir, steering=spec.attitude.steering)
    attitude = Attitude.from_spec(held.model_copy(update={"offset": (roll + pass_spec.roll, pitch, yaw)}))
    try:
        return Trajectory(propagate(orbit, earth), attitude)
    except ValueError as error:
        raise BenchError(str(error), ("passes", name), "a place that a sun-synchronous orbit passes") from error


def draw_block(setup: AdjustSetup, seed: np.random.SeedSequence, monitor: MonitorSource | None = None) -> DrawnBlock:
    """Simulate all passes and their measurements.

    Parameters
    ----------
    setup : AdjustSetup
        Resolved test file and camera.
    seed : np.random.SeedSequence
        Seed of all random numbers.
    monitor : MonitorSource, optional
        Source of the cameras' priors from a record of the monitor; the true cameras are drawn from them.

    Raises
    ------
    BenchError
        No such orbit exists, or too few points are seen by two scenes.
    """
    spec, payload = setup.test, setup.camera
    earth = Earth.from_spec(spec.earth)
    readings = {name: _trajectory(spec, name, spec_of, earth) for name, spec_of in spec.passes.items()}
    epochs = {name: spec_of.epoch for name, spec_of in spec.passes.items()}
    begin = seconds_from_first(epochs)
    attitudes, stations, constants = _courses(spec, spec.truth or spec.errors, begin, stream(seed, _COURSES))
    days = np.array(list(begin.values())) / _DAY
    recorded = monitor(epochs, spec.lines) if monitor else None
    true, expected, monitored = _cameras(spec, days, np.random.default_rng(stream(seed, _CAMERAS)), recorded)
    platforms = {
        name: TruePlatform(
            path, path.body_to_itrs(np.zeros(1))[0], _summed(attitudes[name]), _summed(stations[name]), begin[name]
        )
        for name, path in readings.items()
    }
    lines = int((2.0 * spec.span - spec.line_time) / spec.line_time) - 1
    times = LineTimes.even(-spec.span + 0.5 * spec.line_time, spec.line_time, lines)
    sensors, data, change = {}, {}, {}
    for k, name in enumerate(spec.passes):
        changed = line_cameras(drifted_payload(payload, {line: true[line][k] for line in spec.lines}))
        for line in spec.lines:
            sensors[f"{name}/{line}"] = Sensor.of_lines(changed[line], platforms[name], earth, times, NO_EFFECTS)
            change[f"{name}/{line}"] = true[line][k]
        at = dict.fromkeys(spec.lines, times)
        data[name] = pass_data(name, payload, readings[name], at, spec.area.height, 1.0)
    ground, role, seen = _points(setup, sensors, earth, np.random.default_rng(stream(seed, _PLACES)))
    shots = _shots(spec, platforms, earth, stream(seed, _LASER))
    first = len(ground)
    if shots:
        ground = np.concatenate([ground, *(s.ground for s in shots)])
        role = np.concatenate([role, np.full(len(ground) - first, "tie", object)])
        seen = {k: sensor.image(ground) for k, sensor in sensors.items()}
    scenes, gross = _scenes(spec, data, seen, role, begin, seed)
    footprints = _footprints(spec, shots, readings, begin, first)
    points = _known_points(spec, ground, role, earth, np.random.default_rng(stream(seed, _CONTROL)))
    angles = _angles(spec, constants, np.random.default_rng(stream(seed, _CAMERAS, 1)))
    block = model.Block(
        passes=tuple(model.Pass(name, spec_of.tracker, begin[name]) for name, spec_of in spec.passes.items()),
        scenes=scenes,
        cameras={line: line_model(payload, line) for line in spec.lines},
        known=expected,
        attitude=tuple(law_of(name, spec_of) for name, spec_of in spec.errors.attitude.items()),
        station=tuple(law_of(name, spec_of) for name, spec_of in spec.errors.orbit.items()),
        image=1.0,
        points=points,
        monitored=monitored,
        footprints=footprints,
        terrain=_terrain(spec, ground, role[:first], np.random.default_rng(stream(seed, _TERRAIN))),
        angles=angles,
    )
    return DrawnBlock(block, ground, change, platforms, gross)


Seen = Mapping[str, tuple[np.ndarray, np.ndarray]]


def _points(
    setup: AdjustSetup, sensors: Mapping[str, Sensor], earth: Earth, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Seen]:
    """Draw m ground points (m, 3), ITRS, in metres, with their roles (control, check or tie point).

    They are returned with the image line and pixel of each point in each scene, NaN where it is not seen.
    """
    spec = setup.test
    area, wanted = spec.area, spec.points.control + spec.points.tie + spec.points.check
    count = int(np.ceil(_SPARE * wanted))
    middle = earth.ecef(area.longitude, area.latitude, area.height)
    axes = east_north_up(area.longitude, area.latitude)
    level = np.stack([random.uniform(-0.5, 0.5, count) * v for v in (area.east, area.north)], axis=1)
    lon, lat, _ = earth.geodetic(middle + level @ axes[:2])
    ground = earth.ecef(lon, lat, area.height + area.relief * random.uniform(-1.0, 1.0, count))
    seen = {k: sensor.image(ground) for k, sensor in sensors.items()}
    views = np.sum([np.isfinite(line) for line, _ in seen.values()], axis=0)
    good = np.flatnonzero(views >= 2)[:wanted]
    if len(good) < wanted:
        problem = f"only {len(good)} of {count} candidate points of the area are seen by two scenes"
        raise BenchError(problem, ("area",), "an area inside the strips of two scenes or more, and a longer `span`")
    role = np.repeat(
        np.array(["control", "tie", "check"], object), [spec.points.control, spec.points.tie, spec.points.check]
    )
    return ground[good], role, {k: (line[good], pixel[good]) for k, (line, pixel) in seen.items()}


def _scenes(
    spec: OrbitAdjustSpec,
    data: Mapping[str, PassData],
    seen: Seen,
    role: np.ndarray,
    begin: Mapping[str, float],
    seed: np.random.SeedSequence,
) -> tuple[tuple[model.Scene, ...], dict[str, np.ndarray]]:
    """Return the scenes with the rays of their noisy image points, and the gross errors by scene."""
    scenes, gross = [], {}
    for k, (scene, (line, pixel)) in enumerate(seen.items()):
        name, camera = scene.rsplit("/", 1)
        pass_info = data[name]
        random = np.random.default_rng(stream(seed, _IMAGES, k))
        visible = np.flatnonzero(np.isfinite(line))
        unit = np.array([1.0 / pass_info.pixels_per_line(camera), 1.0])
        noise = spec.points.image * unit * random.standard_normal((len(visible), 2))
        random_gross = np.random.default_rng(stream(seed, _GROSS, k))
        wrong = (random_gross.random(len(visible)) < spec.points.gross) & (role[visible] == "tie")
        direction = random_gross.uniform(0.0, 2.0 * np.pi, len(visible))
        noise += (
            wrong[:, None] * spec.points.gross_size * unit * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        )
        sensor = pass_info.sensors[camera]
        lowest, highest = -0.49, np.array([sensor.lines, sensor.camera.pixels]) - 0.51
        position = np.clip(np.stack([line[visible], pixel[visible]], axis=1) + noise, lowest, highest)
        spread = np.diag((spec.points.image * unit) ** 2)
        rays = pass_info.rays({camera: ImagePoints.of(visible, position[:, 0], position[:, 1], spread)})[camera]
        assert rays.time is not None
        covariance = np.tile((spec.points.image * pass_info.pitch[camera]) ** 2 * np.eye(2), (len(visible), 1, 1))
        moved = Rays(rays.point, rays.image, rays.station, rays.attitude, rays.time + begin[name], covariance)
        scenes.append(model.Scene(scene, name, camera, moved))
        gross[scene] = visible[wrong]
    return tuple(scenes), gross


@dataclass(frozen=True, eq=False)
class _Shots:
    """Laser shots of a pass: times, true ground points, measured directions of the beam, and distances."""

    of: str
    seconds: np.ndarray
    ground: np.ndarray
    aim: np.ndarray
    distance: np.ndarray


def _shots(
    spec: OrbitAdjustSpec, platforms: Mapping[str, TruePlatform], earth: Earth, seed: np.random.SeedSequence
) -> list[_Shots]:
    if spec.laser is None:
        return []
    shots = []
    for k, (name, platform) in enumerate(platforms.items()):
        random = np.random.default_rng(stream(seed, k))
        speed = float(np.linalg.norm(np.diff(platform.position(np.array([0.0, 1.0])), axis=0)))
        half = min(0.4 * spec.area.north / speed, 0.9 * spec.span)
        seconds = np.linspace(-half, half, spec.laser.footprints)
        height = spec.area.height + spec.area.relief * random.uniform(-1.0, 1.0, len(seconds))
        station, body = platform.position(seconds), platform.body_to_itrs(seconds)
        ground = earth.intersect(station, body[:, :, 2], height)
        far = np.linalg.norm(ground - station, axis=1)
        pointing = _pointing(spec)
        aim = np.array([0.0, 0.0, 1.0]) + pointing * random.standard_normal((len(seconds), 3)) * [1.0, 1.0, 0.0]
        aim = aim / np.linalg.norm(aim, axis=1, keepdims=True)
        shots.append(_Shots(name, seconds, ground, aim, far + spec.laser.range * random.standard_normal(len(far))))
    return shots


def _pointing(spec: OrbitAdjustSpec) -> float:
    """Return the standard deviation of the direction of a laser range, about each axis, in radians.

    It combines the pointing error with the position of the echo within the beam.
    """
    assert spec.laser is not None
    # an even disk has a standard deviation of half its radius along each axis
    return float(np.hypot(spec.laser.pointing, 0.25 * spec.laser.beam))


def _footprints(
    spec: OrbitAdjustSpec,
    shots: list[_Shots],
    readings: Mapping[str, Trajectory],
    begin: Mapping[str, float],
    first: int,
) -> tuple[model.Footprints, ...]:
    footprints = []
    for shot in shots:
        path = readings[shot.of]
        which = first + np.arange(len(shot.seconds))
        first += len(shot.seconds)
        station, body = path.position(shot.seconds), path.body_to_itrs(shot.seconds)
        assert spec.laser is not None
        sigma = (spec.laser.range, _pointing(spec))
        when = shot.seconds + begin[shot.of]
        footprints.append(model.Footprints(shot.of, which, when, station, body, shot.aim, shot.distance, sigma))
    return tuple(footprints)


def _known_points(
    spec: OrbitAdjustSpec, ground: np.ndarray, role: np.ndarray, earth: Earth, random: np.random.Generator
) -> model.Points:
    """Return the ground points with names: control points with random errors, first coordinates of the others."""
    plan, height = spec.points.control_sigma
    covariance = level_covariance(ground, plan, height)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), random.standard_normal(ground.shape))
    lon, lat, _ = earth.geodetic(ground)
    shift = np.array(spec.datum) @ east_north_up(lon, lat)
    # first coordinates at the mean height, as accurate as a first intersection
    rough = earth.ecef(lon, lat, np.full(len(lon), spec.area.height))
    start = np.where((role == "control")[:, None], ground + noise + shift, rough)
    ids = np.array(point_names(role), object)
    return model.Points(ids, start, role, covariance)


def _terrain(
    spec: OrbitAdjustSpec, ground: np.ndarray, role: np.ndarray, random: np.random.Generator
) -> model.Terrain | None:
    if spec.terrain is None:
        return None
    free = np.flatnonzero(role != "control")
    up = vertical(ground[free])
    error = spec.terrain.sigma * random.standard_normal(len(free)) + spec.terrain.common * random.standard_normal()
    position = ground[free] + error[:, None] * up
    return model.Terrain(free, position, up, np.full(len(free), spec.terrain.sigma), spec.terrain.common)


def _angles(
    spec: OrbitAdjustSpec, constants: Mapping[str, np.ndarray], random: np.random.Generator
) -> tuple[model.TrackerAngle, ...]:
    angles = []
    for angle_spec in spec.angles:
        first, second = (constants.get(name, np.zeros(3)) for name in angle_spec.between)
        a, b, c = (first - second + np.array(angle_spec.sigma) * random.standard_normal(3)).tolist()
        angles.append(model.TrackerAngle(angle_spec.between, (a, b, c), angle_spec.sigma))
    return tuple(angles)
