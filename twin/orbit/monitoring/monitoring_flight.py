"""A monitored stereo pair along its orbit: temperatures, readings, and points it measures on the ground.

Both views of a point, which are half a minute to a minute apart, are those of the state at the course's time, midway
between them. Light time, aberration and refraction are left out: they are taken as corrected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.forward_intersection import CalibratedLine, Sightings
from analysis.units import ARCSEC
from optics.geometry.tree import Motion, State, compose
from optics.numerics.backend import Backend
from optics.numerics.frozen_map import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from optics.thermal.deformation import Temperature
from scenes.models.job_state import motions_of
from scenes.models.thermal_model import TemperatureError
from scenes.specs.course import moment
from scenes.specs.instrument import BASE
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import Truth
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.light_effects import NO_EFFECTS
from twin.orbit.flight.line_camera import LineCamera, calibrated_line, look_angle, traced_line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import Trajectory
from twin.orbit.monitoring.monitor_series import TOO_FAR, MonitorSeries, Readings, SmoothedReadings
from twin.run.procedure import Advance, BenchError
from twin.run.random_streams import stream

if TYPE_CHECKING:
    from scenes.specs.orbit.loop import OrbitLoopSpec
    from scenes.specs.orbit.monitor import OrbitMonitorSpec
    from scenes.specs.orbit.setup import MonitorSetup


def states_of(
    experiment: MonitorExperiment,
    spec: OrbitMonitorSpec,
    numbers: Sequence[int] | None = None,
    only: tuple[str, str] | None = None,
) -> list[State]:
    """States at times of the course.

    Args:
        experiment: the instrument.
        spec: the test.
        numbers: of the times, all by default.
        only: "temperature" or "motion", and the node of the course that alone has one; the others of the course have
            temperatures of 0 K, so that nothing is inherited. What `perturb` says stays.

    Raises:
        InputError: a temperature at or below 0 K at some time, or one at which a glass's index is not known.
    """
    job, bodies = spec.job, {body.path: body for body in experiment.instrument.assembly.tree.bodies}
    out: list[State] = []
    for k in range(len(spec.course.times)) if numbers is None else numbers:
        time, fields = spec.course.times[k], job.fields(k)
        if only is not None:
            fields = {path: field if only == ("temperature", path) else Temperature() for path, field in fields.items()}
        try:
            experiment.thermal.check(fields)
            state = experiment.thermal.state(fields, motions_of(job))
        except TemperatureError as error:
            own = error.origin in spec.course.temperature
            key = ("course", *spec.course.key(error.origin, k)) if own else ("perturb", error.origin, "temperature")
            raise spec.error(f"{error} at {moment(time)}", key, allowed=error.allowed) from error
        moves = {}
        for path, motion in spec.motion.items():
            if only is None or only == ("motion", path):
                share = motion.share(time)
                rotate, shift = ((share * v[0], share * v[1], share * v[2]) for v in (motion.rotate, motion.shift))
                moves[path] = Motion(rotate, shift, motion.pivot)
        out.append(compose(state, moves, bodies))
    return out


HALF_SPAN = 60.0
"""Seconds of the orbit to either side of a time of the course that its images take; two views 53 degrees apart from 500
km are 70 s apart."""
_SPARE = 2
"""Candidates for each ground point; those that a line does not see are left out."""
_MIDDLE = 1e-3
"""Seconds to which the two views are brought to equal times before and after; a satellite goes 8 m."""


@dataclass(frozen=True, eq=False)
class View:
    """Check points at one time.

    Attributes:
        ground: (n, 3) true, ITRS, metres.
        exact: of each camera of the pair, as it truly is, with the true orbit and attitude.
        seen: as measured.
    """

    ground: np.ndarray
    exact: tuple[Sightings, Sightings]
    seen: tuple[Sightings, Sightings]


@dataclass(frozen=True, eq=False)
class Cause:
    """One entry of the file alone, all others without effect.

    Attributes:
        what: temperature or motion.
        path: of the node.
        truth: camera -> (4,) true changes since the reference.
        error: camera -> (4,) what the monitor says, without noise, minus the truth.
    """

    what: str
    path: str
    truth: Mapping[str, np.ndarray]
    error: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class MonitorFlight:
    """Truth and measurements at T times.

    Attributes:
        spec: the test.
        pair: names of the two cameras.
        looks: their nominal look angles, radians.
        times: (T,) seconds from the orbit's epoch.
        truth: camera -> (T, 4) true d_alpha, d_beta, d_gamma (rad) and d_f (m) since the reference.
        angle: (T,) true angle between the lines of sight, radians.
        lines: of each time: camera -> its line as it truly is.
        calibrated: camera -> its line at the reference, which the ground knows.
        causes: what each temperature and motion of the file does alone at time `worst`, without noise.
        estimator: by which the monitor's shifts are read.
        monitored: what the monitor says of the cameras' changes since the reference.
        smoothed: seconds -> what all its measurements at this interval say together; empty where nothing is stated to
            move.
        clean: camera -> (T, 4) as monitored, from expected images without noise.
        prisms: camera -> (T, 4) what temperatures that the file gives to prisms alone make it say, without noise.
        views: of each time.
        repeated: what the monitor says at time `worst`, measured again and again.
        worst: number of the time with the largest change of the angle.
        turned: camera -> its line at the reference when the whole camera is turned by 1 arcsec about its Y.
        doubts: where the monitor's sigmas do not hold, for its spots are not as calibrated.
    """

    spec: OrbitMonitorSpec
    pair: tuple[str, str]
    looks: tuple[float, float]
    times: np.ndarray
    truth: Mapping[str, np.ndarray]
    angle: np.ndarray
    lines: tuple[Mapping[str, LineCamera], ...]
    calibrated: Mapping[str, CalibratedLine]
    estimator: str
    monitored: Readings
    smoothed: Mapping[float, SmoothedReadings]
    clean: Mapping[str, np.ndarray]
    prisms: Mapping[str, np.ndarray]
    views: tuple[View, ...]
    repeated: Readings
    worst: int
    causes: tuple[Cause, ...]
    turned: Mapping[str, LineCamera]
    doubts: tuple[str, ...] = ()

    def true_line(self, camera: str, k: int) -> CalibratedLine:
        """A camera as it truly is at time number k, in the analysis's form: for comparison only."""
        return in_analysis(self.lines[k][camera], self.calibrated[camera])


def in_analysis(line: LineCamera, like: CalibratedLine) -> CalibratedLine:
    """A traced line in the analysis's form, with the axes and principal distance of another."""
    return calibrated_line(line, like.axes, like.principal_distance)


def fly_monitored(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance) -> MonitorFlight:
    """Trace, render, measure, look down.

    Raises:
        InputError: an unknown node or an impossible temperature.
        BenchError: the test cannot be carried out as its file says.
    """
    spec, pair = setup.test, setup.pair
    ground_seed, monitor_seed = np.random.SeedSequence(seed).spawn(2)
    number = int(np.random.default_rng(monitor_seed).integers(2**31))
    parts = 6
    advance("monitor", 0, parts)
    experiment = MonitorExperiment(setup.resolved, backend)
    spec.check_nodes(experiment.instrument.nodes)
    states = states_of(experiment, spec)
    advance("monitor", 1, parts)
    instrument, reference = experiment.instrument, states[spec.referred]
    try:
        lines = tuple(_lines(experiment, state, pair) for state in states)
        turned = {name: _lines(experiment, _turned(experiment, reference, name), pair)[name] for name in pair}
        advance("monitor", 2, parts)
        angle = np.array([look_angle(line[pair[0]], line[pair[1]]) for line in lines])
        worst = int(np.argmax(np.abs(angle - angle[spec.referred])))
        # before the images, which take longer
        views = look_down(spec, spec.course.times, pair, lines, ground_seed, advance)
        monitor = MonitorSeries(experiment, spec, reference, pair)
        noisy, clean = monitor.measured(states, number)
        truth, distance = _changes(clean.truth, spec.referred)
        used = noisy if spec.errors.switched_on and spec.errors.monitor else clean
        gains = monitor.gains(used, range(len(states)))
        advance("monitor", 3, parts)
        prisms = monitor.of_prisms()
        advance("monitor", 4, parts)
        repeated = monitor.repeated(states[worst], spec.repeats, number + 1, worst)
        advance("monitor", 5, parts)
        causes = _causes(experiment, spec, monitor, worst, gains[worst])
        advance("monitor", 6, parts)
    except (AimError, BeamMissedError) as error:
        raise BenchError(f"the instrument cannot be rendered: {error}", ("course",), TOO_FAR) from error
    calibrated = {}
    for name in pair:
        calibrated[name] = calibrated_line(lines[spec.referred][name], experiment.sight.axes[name], distance[name])
    smoothed = {}
    if experiment.disturbances is not None:
        smoothed = {interval: monitor.smoothed(used, interval) for interval in {spec.interval, *spec.compared}}
    return MonitorFlight(
        spec,
        pair,
        (instrument.spec.cameras[pair[0]].look, instrument.spec.cameras[pair[1]].look),
        np.array(spec.course.times),
        FrozenMap({name: truth[name] for name in pair}),
        angle,
        lines,
        FrozenMap(calibrated),
        monitor.estimator,
        monitor.readings(used, range(len(states))),
        FrozenMap(smoothed),
        FrozenMap(monitor.by_camera(gains, clean.shifts)),
        FrozenMap(monitor.by_camera(gains, prisms)),
        views,
        monitor.readings(repeated, [worst] * spec.repeats),
        worst,
        causes,
        FrozenMap(turned),
        used.doubts(spec.course.times, [channel.key for channel in experiment.path.channels]),
    )


def _changes(truths: Sequence[Truth], reference: int) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Camera -> (T, 4) true changes since the reference, and camera -> principal distance there.

    The trace refers changes to the nominal camera; their differences are those between two states but for products of
    two arcseconds, 1e-11 rad.
    """
    out, distance = {}, {}
    for name in truths[0].cameras:
        every = [one.cameras[name] for one in truths]
        values = np.concatenate([change.vector for change in every])
        out[name] = values - values[reference]
        distance[name] = float(np.concatenate([c.principal_distance for c in every])[reference])
    return out, distance


def _causes(
    experiment: MonitorExperiment, spec: OrbitMonitorSpec, monitor: MonitorSeries, worst: int, gain: np.ndarray
) -> tuple[Cause, ...]:
    """What each temperature of the course and each motion does from the reference to time number ``worst``, at which
    the estimator has this gain (8, 2 C).
    """
    named = [("temperature", path) for path in spec.course.temperature] + [("motion", path) for path in spec.motion]
    states = [s for what, path in named for s in states_of(experiment, spec, (spec.referred, worst), (what, path))]
    found = monitor.clean(states)
    truth, _ = _changes(found.truth, 0)
    estimates = monitor.by_camera(gain, found.shifts)
    out = []
    for k, (what, path) in enumerate(named):
        true, read = ({n: v[n][2 * k + 1] - v[n][2 * k] for n in monitor.pair} for v in (truth, estimates))
        error = {n: read[n] - true[n] for n in monitor.pair}
        out.append(Cause(what, path, FrozenMap(true), FrozenMap(error)))
    return tuple(out)


def _lines(experiment: MonitorExperiment, state: State, pair: tuple[str, str]) -> Mapping[str, LineCamera]:
    traced = traced_line_cameras(experiment.instrument, experiment.backend, state)
    return FrozenMap({name: traced[name] for name in pair})


def _turned(experiment: MonitorExperiment, state: State, camera: str) -> State:
    """The state with a whole camera turned by 1 arcsec about its Y."""
    bodies = {body.path: body for body in experiment.instrument.assembly.tree.bodies}
    return compose(state, {f"{BASE}/{camera}": Motion((0.0, ARCSEC, 0.0))}, bodies)


def look_down(
    spec: OrbitMonitorSpec | OrbitLoopSpec,
    times: Sequence[float],
    pair: tuple[str, str],
    lines: Sequence[Mapping[str, LineCamera]],
    seed: np.random.SeedSequence,
    advance: Advance,
) -> tuple[View, ...]:
    """Check points at every time, as both lines see them.

    Args:
        spec: of orbit, attitude, ground and errors.
        times: T of them, seconds from the orbit's epoch.
        pair: the two cameras.
        lines: of each time: camera -> its line as it truly is.
        seed: of places and errors.
        advance: told of the progress.

    Raises:
        BenchError: no such orbit, or not enough points that both lines see.
    """
    flown, out = fly(spec, seed), []
    for k, line in enumerate(lines):
        out.append(_view(spec, times[k], [line[name] for name in pair], flown, stream(seed, k + 1)))
        advance("ground", k + 1, len(lines))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Flown:
    """Orbit and attitude.

    Attributes:
        earth: below them.
        true: as they are; measured: as the satellite says.
    """

    earth: Earth
    true: Trajectory
    measured: Trajectory


def fly(spec: OrbitMonitorSpec | OrbitLoopSpec, seed: np.random.SeedSequence) -> Flown:
    """Orbit and attitude of a test, the same for the same seed.

    Raises:
        BenchError: no such orbit.
    """
    earth = Earth.from_spec(spec.earth)
    try:
        true = Trajectory.flown(propagate(spec.orbit, earth), spec.attitude, seed)
    except ValueError as error:
        raise BenchError(str(error), ("orbit",), "an orbit that exists") from error
    measured = true
    if spec.errors.switched_on:
        measured = true.with_errors(spec.errors, int(np.random.default_rng(stream(seed, 0)).integers(2**31)))
    return Flown(earth, true, measured)


def _view(
    spec: OrbitMonitorSpec | OrbitLoopSpec,
    time: float,
    cameras: Sequence[LineCamera],
    flown: Flown,
    seed: np.random.SeedSequence,
) -> View:
    """Points at a time."""
    place, image = (np.random.default_rng(stream(seed, k)) for k in range(2))
    true, earth = flown.true, flown.earth
    ground = spec.ground
    begin, lines = time - HALF_SPAN, int(2.0 * HALF_SPAN / spec.line_time)
    try:
        sensors = [Sensor(c, true, earth, spec.line_time, begin, lines, NO_EFFECTS) for c in cameras]
    except ValueError as error:
        remedy = "an orbit that goes on for a minute before the first and after the last time of the course"
        raise BenchError(f"{error} around {moment(time)}", ("orbit", "after"), remedy) from error
    at = second_view(sensors, time, 0.5 * (ground.first + ground.last), ground.height)
    wanted = ground.points
    height = ground.height + ground.relief * place.uniform(-1.0, 1.0, _SPARE * wanted)
    pixel = place.uniform(ground.first, ground.last, len(height))
    speed = float(np.linalg.norm(true.velocity(time))) * float(
        np.linalg.norm(earth.ecef(0.0, 0.0)) / np.linalg.norm(true.position(time))
    )
    reach = 0.5 * ground.length / speed
    line = (at + place.uniform(-reach, reach, len(height)) - begin) / spec.line_time
    inside = (line > 0.0) & (line < lines - 1.0)
    points = sensors[1].ground(line[inside], pixel[inside], height[inside])
    seen = [s.image(points) for s in sensors]
    good = np.flatnonzero(np.all([np.isfinite(row) for row, _ in seen], axis=0))[:wanted]
    if len(good) < wanted:
        problem = f"at {moment(time)} only {len(good)} of {len(height)} places are seen by both lines"
        remedy = "places inside both strips: nearer to the line's middle, or attitude {steering: yaw}"
        raise BenchError(problem, ("ground",), remedy)
    noise = spec.errors.image * spec.errors.switched_on
    exact, noisy = [], []
    for sensor, (row, column) in zip(sensors, seen, strict=True):
        exact.append(_sightings(sensor, true, row[good], column[good]))
        offsets = noise * image.standard_normal((2, len(good)))
        noisy.append(_sightings(sensor, flown.measured, row[good] + offsets[0], column[good] + offsets[1]))
    return View(points[good], (exact[0], exact[1]), (noisy[0], noisy[1]))


def second_view(sensors: Sequence[Sensor], time: float, pixel: float, height: float) -> float:
    """When the second line sees a point that the first sees as long before ``time`` (or after it), seconds.

    Args:
        sensors: of the two lines.
        time: between their views, seconds.
        pixel: of the second line.
        height: of the point, metres.

    Raises:
        BenchError: the first line does not see what the second sees.
    """
    at = time
    for _ in range(20):
        line = (at - sensors[1].first_line_time) / sensors[1].line_time
        point = sensors[1].ground(np.array([line]), np.array([pixel]), height)
        row, _ = sensors[0].image(point)
        if not np.isfinite(row[0]):
            break
        off = 0.5 * (at + float(sensors[0].time(row)[0])) - time
        at -= off
        if abs(off) < _MIDDLE:
            return at
    problem = f"at {moment(time)} the first line does not see what the second sees within {HALF_SPAN:g} s"
    raise BenchError(problem, ("cameras",), "two cameras whose strips overlap, and attitude {steering: yaw}")


def _sightings(sensor: Sensor, trajectory: Trajectory, row: np.ndarray, column: np.ndarray) -> Sightings:
    seconds = sensor.time(row)
    return Sightings(column, trajectory.position(seconds), trajectory.body_to_itrs(seconds))
