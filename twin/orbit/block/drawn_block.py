"""A block of scenes with everything that is measured of it, drawn from stated laws.

The readings of orbit and attitude are a smooth orbit; the true platform departs from them by processes that are drawn
as what they are: readings with a cubic spline through them, sums of steps, amplitudes. The images are those of the
rigorous sensor on the true platform with cameras that have changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from analysis.block import block as known
from analysis.block.error_processes import STEPPED, Law
from analysis.orbit.calibration_parameters import level_covariance, vertical
from analysis.orbit.three_line_model import Rays
from optics.numerics.array_math import covariance_root
from scenes.specs.orbit.adjust import BlockPassSpec, OrbitAdjustSpec, ReadingLawsSpec
from scenes.specs.orbit.flight import AttitudeSpec
from scenes.specs.orbit.setup import AdjustSetup
from twin.framework.procedure import BenchError
from twin.framework.random_streams import stream
from twin.orbit.block.measured_block import (
    MonitorSource,
    camera_sigmas,
    change_covariance,
    law_of,
    monitored_camera,
    seconds_after_the_first,
)
from twin.orbit.calibration.campaign import PassData, line_model, pass_data, passing_orbit
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.light_effects import NO_EFFECTS
from twin.orbit.flight.line_camera import LineTimes, drifted_payload, line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.sensor import Platform, Sensor
from twin.orbit.flight.trajectory import Attitude, Trajectory
from twin.orbit.measured.pass_measurements import ImagePoints, point_names

Course = Callable[[np.ndarray], np.ndarray]
Monitored = dict[str, known.CameraKnowledge] | known.CamerasKnowledge
_BEYOND = 30
"""Readings beyond the ends of a course: a cubic spline forgets its ends by a factor of 0.27 a reading."""
_SPARE = 4.0
"""Places drawn for each point: those that fewer than two scenes see are left out."""
_DAY = 86400.0
_MOST_STEPS = 1e5
"""Of a law with a course in time."""
_PLACES, _IMAGES, _LASER, _TERRAIN, _CONTROL, _COURSES, _CAMERAS, _GROSS = range(8)
"""Streams of the seed."""


@dataclass(frozen=True, eq=False)
class TruePlatform:
    """What the readings depart from, on the readings' own time.

    Attributes
    ----------
    readings : Platform
        a smooth orbit.
    axes : np.ndarray
        (3, 3) body axes in the middle of the pass as columns, ITRS.
    turn : Course
        Of times of the block (n,) to rotation vectors (n, 3), radians. shift: likewise, metres along `axes`.
    begin : float
        Of the readings' time on that of the block, seconds.
    """

    readings: Platform
    axes: np.ndarray
    turn: Course
    shift: Course
    begin: float

    def position(self, seconds: np.ndarray) -> np.ndarray:
        """See `Platform`."""
        found: np.ndarray = self.readings.position(seconds) + self.shift(seconds + self.begin) @ self.axes.T
        return found

    def inertial_velocity(self, seconds: np.ndarray) -> np.ndarray:
        """See `Platform`."""
        return self.readings.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: np.ndarray) -> np.ndarray:
        """See `Platform`."""
        turn = Rotation.from_rotvec(self.turn(seconds + self.begin)).as_matrix()
        return np.asarray(self.readings.body_to_itrs(seconds) @ turn)


@dataclass(frozen=True, eq=False)
class DrawnBlock:
    """A block and its truth.

    Attributes
    ----------
    block : known.Block
        What is known and measured.
    ground : np.ndarray
        (m, 3) true points, ITRS, metres.
    change : Mapping[str, np.ndarray]
        Scene -> (4,) true changes of its camera, radians and metres.
    platforms : Mapping[str, TruePlatform]
        Pass -> the true one.
    gross : Mapping[str, np.ndarray]
        Scene -> (k,) image points that are wrong.
    """

    block: known.Block
    ground: np.ndarray
    change: Mapping[str, np.ndarray]
    platforms: Mapping[str, TruePlatform]
    gross: Mapping[str, np.ndarray]


def drawn_course(law: Law, first: float, last: float, random: np.random.Generator) -> Course:
    """One draw of a law between two times, seconds."""
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
        turn = 2.0 * np.pi * law.frequency
        return lambda t: (
            np.cos(turn * t)[:, None] * amplitude(t)[:, :3] + np.sin(turn * t)[:, None] * amplitude(t)[:, 3:]
        )
    line: Course = make_interp_spline(law.interval * number, sigma * values, k=1)
    return line


def _slow(steps: np.ndarray, law: Law) -> np.ndarray:
    """(k, 3) values of a stationary process of unit size from independent normals (k, 3)."""
    kept = np.exp(-law.interval / law.time)
    values = steps.copy()
    for k in range(1, len(steps)):
        values[k] = kept * values[k - 1] + np.sqrt(1.0 - kept**2) * steps[k]
    return values


def _courses(
    spec: OrbitAdjustSpec, laws: ReadingLawsSpec, begin: Mapping[str, float], seed: np.random.SeedSequence
) -> tuple[dict[str, list[Course]], dict[str, list[Course]], dict[str, np.ndarray]]:
    """Pass -> courses of its attitude and of its station; star tracker -> its constant turn."""
    turns: dict[str, list[Course]] = {name: [] for name in begin}
    shifts: dict[str, list[Course]] = {name: [] for name in begin}
    constants: dict[str, np.ndarray] = {}
    number = 0
    for kept, named in ((turns, laws.attitude), (shifts, laws.orbit)):
        for name, one in named.items():
            term = law_of(name, one)
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
                        f"{name}: more than {_MOST_STEPS:.0e} values of a course; are passes too far apart to share it?"
                    )
                    raise BenchError(problem, ("errors",), "`shared_by: pass`, or a longer interval")
                course = drawn_course(term.law, first, last, random)
                if term.scope == "tracker" and term.law.kind == "constant":
                    constants[scope] = constants.get(scope, np.zeros(3)) + course(np.zeros(1))[0]
                for m in members:
                    kept[m].append(course)
    return turns, shifts, constants


def _summed(parts: list[Course]) -> Course:
    return lambda t: np.asarray(sum((one(t) for one in parts), np.zeros((len(t), 3))))


def _cameras(
    spec: OrbitAdjustSpec, days: np.ndarray, random: np.random.Generator, recorded: known.CamerasKnowledge | None
) -> tuple[dict[str, np.ndarray], dict[str, known.CameraKnowledge], Monitored | None]:
    """Line -> true changes (T, 4), what is expected of them, and what is known after the monitor's readings."""
    if recorded is not None:
        drawn = covariance_root(recorded.covariance) @ random.standard_normal(len(recorded.covariance))
        changes = recorded.mean + drawn.reshape(recorded.mean.shape)
        laws = {line: change_covariance(spec.changes[line], days) for line in spec.lines}
        nothing = np.zeros((len(days), 4))
        before = {line: known.CameraKnowledge(nothing, law) for line, law in laws.items()}
        return dict(zip(recorded.cameras, changes, strict=True)), before, recorded
    true, expected, monitored = {}, {}, {}
    for line in spec.lines:
        law = change_covariance(spec.changes[line], days)
        drawn = covariance_root(law) @ random.standard_normal(len(law))
        true[line] = drawn.reshape(-1, 4)
        expected[line] = known.CameraKnowledge(np.zeros((len(days), 4)), law)
        noise = random.standard_normal(len(drawn))
        if spec.monitor is not None:
            sigma = np.tile(camera_sigmas(spec.monitor), len(days))
            monitored[line] = monitored_camera(law, drawn + sigma * noise, sigma)
    return true, expected, monitored if spec.monitor is not None else None


def _trajectory(spec: OrbitAdjustSpec, name: str, one: BlockPassSpec, earth: Earth) -> Trajectory:
    longitude = spec.area.longitude if one.longitude is None else one.longitude
    latitude = spec.area.latitude if one.latitude is None else one.latitude
    orbit = passing_orbit(one.epoch, spec.span, spec.altitude, longitude, latitude, one.direction)
    roll, pitch, yaw = spec.attitude.offset
    held = AttitudeSpec(nadir=spec.attitude.nadir, steering=spec.attitude.steering)
    attitude = Attitude.from_spec(held.model_copy(update={"offset": (roll + one.roll, pitch, yaw)}))
    try:
        return Trajectory(propagate(orbit, earth), attitude)
    except ValueError as error:
        raise BenchError(str(error), ("passes", name), "a place that a sun-synchronous orbit passes") from error


def draw_block(setup: AdjustSetup, seed: np.random.SeedSequence, monitor: MonitorSource | None = None) -> DrawnBlock:
    """Fly all passes and measure.

    Parameters
    ----------
    setup : AdjustSetup
        What the file says.
    seed : np.random.SeedSequence
        Of all that is drawn.
    monitor : MonitorSource | None
        What a record says of the cameras, from which the true ones are drawn.

    Raises
    ------
    BenchError
        No such orbit, or too few places that two scenes see.
    """
    spec, payload = setup.test, setup.camera
    earth = Earth.from_spec(spec.earth)
    readings = {name: _trajectory(spec, name, one, earth) for name, one in spec.passes.items()}
    epochs = {name: one.epoch for name, one in spec.passes.items()}
    begin = seconds_after_the_first(epochs)
    turns, shifts, constants = _courses(spec, spec.truth or spec.errors, begin, stream(seed, _COURSES))
    days = np.array(list(begin.values())) / _DAY
    recorded = monitor(epochs, spec.lines) if monitor else None
    true, expected, monitored = _cameras(spec, days, np.random.default_rng(stream(seed, _CAMERAS)), recorded)
    platforms = {
        name: TruePlatform(
            path, path.body_to_itrs(np.zeros(1))[0], _summed(turns[name]), _summed(shifts[name]), begin[name]
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
    block = known.Block(
        passes=tuple(known.Pass(name, one.tracker, begin[name]) for name, one in spec.passes.items()),
        scenes=scenes,
        cameras={line: line_model(payload, line) for line in spec.lines},
        known=expected,
        attitude=tuple(law_of(name, one) for name, one in spec.errors.attitude.items()),
        station=tuple(law_of(name, one) for name, one in spec.errors.orbit.items()),
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
    """Places (m, 3), their roles, and scene -> line and pixel of each, NaN where it does not see one."""
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
        problem = f"only {len(good)} of {count} places of the area are seen by two scenes"
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
) -> tuple[tuple[known.Scene, ...], dict[str, np.ndarray]]:
    """Image points with their errors as rays, and scene -> points whose image points are wrong."""
    scenes, gross = [], {}
    for k, (scene, (line, pixel)) in enumerate(seen.items()):
        name, camera = scene.rsplit("/", 1)
        one = data[name]
        random = np.random.default_rng(stream(seed, _IMAGES, k))
        here = np.flatnonzero(np.isfinite(line))
        unit = np.array([1.0 / one.pixels_per_line(camera), 1.0])
        noise = spec.points.image * unit * random.standard_normal((len(here), 2))
        spoilt = np.random.default_rng(stream(seed, _GROSS, k))
        wrong = (spoilt.random(len(here)) < spec.points.gross) & (role[here] == "tie")
        way = spoilt.uniform(0.0, 2.0 * np.pi, len(here))
        noise += wrong[:, None] * spec.points.gross_size * unit * np.stack([np.cos(way), np.sin(way)], axis=1)
        sensor = one.sensors[camera]
        lowest, highest = -0.49, np.array([sensor.lines, sensor.camera.pixels]) - 0.51
        place = np.clip(np.stack([line[here], pixel[here]], axis=1) + noise, lowest, highest)
        spread = np.diag((spec.points.image * unit) ** 2)
        rays = one.rays({camera: ImagePoints.of(here, place[:, 0], place[:, 1], spread)})[camera]
        assert rays.time is not None
        own = np.tile((spec.points.image * one.pitch[camera]) ** 2 * np.eye(2), (len(here), 1, 1))
        moved = Rays(rays.point, rays.image, rays.station, rays.attitude, rays.time + begin[name], own)
        scenes.append(known.Scene(scene, name, camera, moved))
        gross[scene] = here[wrong]
    return tuple(scenes), gross


@dataclass(frozen=True, eq=False)
class _Shots:
    """Laser shots of a pass: times on the readings, true points, what was measured."""

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
    found = []
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
        found.append(_Shots(name, seconds, ground, aim, far + spec.laser.range * random.standard_normal(len(far))))
    return found


def _pointing(spec: OrbitAdjustSpec) -> float:
    """Standard deviation of the place within the beam from which a range comes, about each axis, radians."""
    assert spec.laser is not None
    # an even disk has a standard deviation of half its radius along each axis
    return float(np.hypot(spec.laser.pointing, 0.25 * spec.laser.beam))


def _footprints(
    spec: OrbitAdjustSpec,
    shots: list[_Shots],
    readings: Mapping[str, Trajectory],
    begin: Mapping[str, float],
    first: int,
) -> tuple[known.Footprints, ...]:
    found = []
    for one in shots:
        path = readings[one.of]
        which = first + np.arange(len(one.seconds))
        first += len(one.seconds)
        station, body = path.position(one.seconds), path.body_to_itrs(one.seconds)
        assert spec.laser is not None
        sigma = (spec.laser.range, _pointing(spec))
        when = one.seconds + begin[one.of]
        found.append(known.Footprints(one.of, which, when, station, body, one.aim, one.distance, sigma))
    return tuple(found)


def _known_points(
    spec: OrbitAdjustSpec, ground: np.ndarray, role: np.ndarray, earth: Earth, random: np.random.Generator
) -> known.Points:
    """Control points with their errors, first guesses of the others, names."""
    plan, height = spec.points.control_sigma
    covariance = level_covariance(ground, plan, height)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), random.standard_normal(ground.shape))
    lon, lat, _ = earth.geodetic(ground)
    shift = np.array(spec.datum) @ east_north_up(lon, lat)
    # where the mean height is: what a first intersection gives as well
    rough = earth.ecef(lon, lat, np.full(len(lon), spec.area.height))
    start = np.where((role == "control")[:, None], ground + noise + shift, rough)
    ids = np.array(point_names(role), object)
    return known.Points(ids, start, role, covariance)


def _terrain(
    spec: OrbitAdjustSpec, ground: np.ndarray, role: np.ndarray, random: np.random.Generator
) -> known.Terrain | None:
    if spec.terrain is None:
        return None
    here = np.flatnonzero(role != "control")
    up = vertical(ground[here])
    error = spec.terrain.sigma * random.standard_normal(len(here)) + spec.terrain.common * random.standard_normal()
    place = ground[here] + error[:, None] * up
    return known.Terrain(here, place, up, np.full(len(here), spec.terrain.sigma), spec.terrain.common)


def _angles(
    spec: OrbitAdjustSpec, constants: Mapping[str, np.ndarray], random: np.random.Generator
) -> tuple[known.TrackerAngle, ...]:
    found = []
    for one in spec.angles:
        first, second = (constants.get(name, np.zeros(3)) for name in one.between)
        a, b, c = (first - second + np.array(one.sigma) * random.standard_normal(3)).tolist()
        found.append(known.TrackerAngle(one.between, (a, b, c), one.sigma))
    return tuple(found)
