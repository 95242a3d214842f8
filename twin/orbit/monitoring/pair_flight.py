"""A stereo pair along its orbit: lines as they truly are, and points that they measure on the ground.

Both views of a point, which are half a minute to a minute apart, are those of the state at the moment midway between
them. Light time, aberration and refraction are left out: they are taken as corrected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from analysis.arrays import ARCSEC
from analysis.orbit.forward_intersection import CalibratedLine, Sightings, check_errors, intersect_pair
from optics.geometry.tree import Motion, State
from optics.numerics.number_tree import FrozenMap
from scenes.specs.course import moment
from twin.framework.procedure import Advance, BenchError
from twin.framework.random_streams import stream
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.light_effects import NO_EFFECTS
from twin.orbit.flight.line_camera import LineCamera, calibrated_line, traced_line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.sensor import Platform, Sensor
from twin.orbit.flight.trajectory import Trajectory

if TYPE_CHECKING:
    from scenes.specs.orbit.monitor import OrbitMonitorSpec

TOO_FAR = "temperatures and motions that keep the beams on the mirrors and the spots on their CCDs"
"""Remedy where light is lost or a spot cannot be measured."""
HALF_SPAN = 60.0
"""Seconds of the orbit to either side of a time of the course that its images take; two views 53 degrees apart from 500
km are 70 s apart."""
_SPARE = 2
"""Candidates for each ground point; those that a line does not see are left out."""
_MIDDLE = 1e-3
"""Seconds to which the two views are brought to equal times before and after; a satellite goes 8 m."""


_STEP = np.array([ARCSEC, ARCSEC, ARCSEC, 10e-6])
"""Steps of the derivatives, rad and m: over them the intersection is linear to 1e-5."""


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def moves_at(spec: OrbitMonitorSpec, time: float, only: str | None = None) -> State:
    """Motions of the file at a time.

    Parameters
    ----------
    spec : OrbitMonitorSpec
        The test.
    time : float
        seconds.
    only : str | None
        Node that alone moves; all by default.
    """
    moves = {}
    for path, motion in spec.motion.items():
        if only in (None, path):
            share = motion.share(time)
            rotate, shift = ((share * v[0], share * v[1], share * v[2]) for v in (motion.rotate, motion.shift))
            moves[path] = Motion(rotate, shift, motion.pivot)
    return moves


@dataclass(frozen=True, eq=False)
class View:
    """Check points at one time.

    Attributes
    ----------
    ground : np.ndarray
        (n, 3) true, ITRS, metres.
    exact : tuple[Sightings, Sightings]
        Of each camera of the pair, as it truly is, with the true orbit and attitude.
    seen : tuple[Sightings, Sightings]
        As measured.
    """

    ground: np.ndarray
    exact: tuple[Sightings, Sightings]
    seen: tuple[Sightings, Sightings]


@dataclass(frozen=True, eq=False)
class CaseErrors:
    """Errors at the check points over T times.

    Attributes
    ----------
    plan : np.ndarray
        (T,) RMS, both axes, metres; height: (T,) likewise.
    bias : np.ndarray
        (T,) mean of the height errors, found minus true.
    camera : np.ndarray
        (T,) the same less that of the true cameras at the same image points, orbit and attitude: what the cameras alone
        do.
    camera_plan : np.ndarray
        (T,) RMS over the points of what the cameras alone do in plan; camera_height: likewise in height.
    """

    plan: np.ndarray
    height: np.ndarray
    bias: np.ndarray
    camera: np.ndarray
    camera_plan: np.ndarray
    camera_height: np.ndarray

    @property
    def plan_rms(self) -> float:
        """RMS error in plan over all times, metres."""
        return rms(self.plan)

    @property
    def height_rms(self) -> float:
        """RMS error in height over all times, metres."""
        return rms(self.height)

    @property
    def camera_height_rms(self) -> float:
        """RMS of what the cameras alone do in height over all times, metres."""
        return rms(self.camera_height)

    @property
    def worst(self) -> float:
        """Largest RMS in height of one time, metres."""
        return float(self.height.max())


@dataclass(frozen=True, eq=False)
class PairFlight:
    """A stereo pair at T times of its orbit.

    Attributes
    ----------
    pair : tuple[str, str]
        Names of the two cameras.
    times : np.ndarray
        (T,) seconds from the orbit's epoch.
    lines : tuple[Mapping[str, LineCamera], ...]
        Of each time: camera -> its line as it truly is.
    calibrated : Mapping[str, CalibratedLine]
        Camera -> its line as calibrated, which the ground knows.
    views : tuple[View, ...]
        Check points of each time.
    """

    pair: tuple[str, str]
    times: np.ndarray
    lines: tuple[Mapping[str, LineCamera], ...]
    calibrated: Mapping[str, CalibratedLine]
    views: tuple[View, ...]

    def true_line(self, camera: str, k: int) -> CalibratedLine:
        """A camera as it truly is at time number k, in the analysis's form: for comparison only."""
        return in_analysis(self.lines[k][camera], self.calibrated[camera])

    def true_pair(self, k: int) -> list[CalibratedLine]:
        """Both cameras as they truly are at time number k."""
        return [self.true_line(name, k) for name in self.pair]

    def point_errors(self, changes: Mapping[str, np.ndarray]) -> np.ndarray:
        """Errors (T, n, 3) of the points by calibrated cameras that are corrected by changes (T, 4) of each, metres."""
        every = [[self.calibrated[n].corrected(changes[n][k]) for n in self.pair] for k in range(len(self.times))]
        return np.array([point_errors(pair, view) for pair, view in zip(every, self.views, strict=True)])

    @cached_property
    def true_errors(self) -> np.ndarray:
        """Errors (T, n, 3) of the points by the true cameras, metres: of image points, orbit and attitude."""
        return np.array([point_errors(self.true_pair(k), view) for k, view in enumerate(self.views)])

    def case(self, changes: Mapping[str, np.ndarray]) -> CaseErrors:
        """Errors with the cameras corrected by changes; as of `point_errors`."""
        return case_errors(self.point_errors(changes), self.true_errors)

    @property
    def true_case(self) -> CaseErrors:
        """Errors with the true cameras."""
        return case_errors(self.true_errors, self.true_errors)

    @cached_property
    def slopes(self) -> Mapping[str, np.ndarray]:
        """Camera -> (T, 4) slopes of the mean height by d_alpha, d_beta, d_gamma and d_f that the analysis is told,
        m/rad and m/m: central differences of the intersection of exact image points.
        """
        return FrozenMap({name: self._slopes(i) for i, name in enumerate(self.pair)})

    def _slopes(self, i: int) -> np.ndarray:
        """(T, 4) of camera number i of the pair."""
        table = np.empty((len(self.views), 4))
        for k, view in enumerate(self.views):
            for j, step in enumerate(_STEP):
                ends = []
                for sign in (1.0, -1.0):
                    both = [self.calibrated[n] for n in self.pair]
                    both[i] = both[i].corrected(sign * step * np.eye(4)[j])
                    ends.append(float(point_errors(both, view, exact_data=True)[:, 2].mean()))
                table[k, j] = (ends[0] - ends[1]) / (2.0 * step)
        return table


def in_analysis(line: LineCamera, like: CalibratedLine) -> CalibratedLine:
    """A traced line in the analysis's form, with the axes and principal distance of another."""
    return calibrated_line(line, like.axes, like.principal_distance)


def traced_pair(experiment: MonitorExperiment, state: State, pair: tuple[str, str]) -> Mapping[str, LineCamera]:
    """Camera of the pair -> its line as it truly is in a state. Raises AimError, BeamMissedError: light is lost."""
    traced = traced_line_cameras(experiment.instrument, experiment.backend, state)
    return FrozenMap({name: traced[name] for name in pair})


def point_errors(cameras: Sequence[CalibratedLine], view: View, exact_data: bool = False) -> np.ndarray:
    """Errors (n, 3) east, north, up of points that two cameras intersect, metres.

    Parameters
    ----------
    cameras : Sequence[CalibratedLine]
        The two, as the analysis takes them.
    view : View
        The points.
    exact_data : bool
        With exact image points, orbit and attitude.

    Raises
    ------
    IntersectionError
        Rays that are parallel.
    """
    seen = view.exact if exact_data else view.seen
    return check_errors(intersect_pair(cameras[0], cameras[1], *seen).ground, view.ground).error


def case_errors(found: np.ndarray, true: np.ndarray) -> CaseErrors:
    """Errors of a case.

    Parameters
    ----------
    found : np.ndarray
        (T, n, 3) errors east, north, up of the points, metres.
    true : np.ndarray
        (T, n, 3) those by the true cameras with the same image points, orbit and attitude.
    """
    alone = found - true
    return CaseErrors(
        plan=np.sqrt(np.mean(np.sum(found[..., :2] ** 2, axis=-1), axis=1)),
        height=np.sqrt(np.mean(found[..., 2] ** 2, axis=1)),
        bias=found[..., 2].mean(axis=1),
        camera=alone[..., 2].mean(axis=1),
        camera_plan=np.sqrt(np.mean(np.sum(alone[..., :2] ** 2, axis=-1), axis=1)),
        camera_height=np.sqrt(np.mean(alone[..., 2] ** 2, axis=1)),
    )


def look_down(
    spec: OrbitMonitorSpec,
    pair: tuple[str, str],
    lines: Sequence[Mapping[str, LineCamera]],
    seed: np.random.SeedSequence,
    advance: Advance,
) -> tuple[View, ...]:
    """Check points at every time, as both lines see them.

    Parameters
    ----------
    spec : OrbitMonitorSpec
        Of orbit, attitude, ground and errors.
    pair : tuple[str, str]
        The two cameras.
    lines : Sequence[Mapping[str, LineCamera]]
        Of each of the T times: camera -> its line as it truly is.
    seed : np.random.SeedSequence
        Of places and errors.
    advance : Advance
        Told of the progress.

    Raises
    ------
    BenchError
        No such orbit, or not enough points that both lines see.
    """
    flown, out = fly(spec, seed), []
    for k, line in enumerate(lines):
        out.append(_view(spec, spec.times[k], [line[name] for name in pair], flown, stream(seed, k + 1)))
        advance("ground", k + 1, len(lines))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Flown:
    """Orbit and attitude.

    Attributes
    ----------
    earth : Earth
        Below them.
    true : Trajectory
        As they are; measured: as the satellite says.
    """

    earth: Earth
    true: Trajectory
    measured: Trajectory


def fly(spec: OrbitMonitorSpec, seed: np.random.SeedSequence) -> Flown:
    """Orbit and attitude of a test, the same for the same seed.

    Raises
    ------
    BenchError
        No such orbit.
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
    spec: OrbitMonitorSpec, time: float, cameras: Sequence[LineCamera], flown: Flown, seed: np.random.SeedSequence
) -> View:
    """Points at a time."""
    place, image = (np.random.default_rng(stream(seed, k)) for k in range(2))
    true, earth = flown.true, flown.earth
    ground = spec.ground
    begin, lines = time - HALF_SPAN, int(2.0 * HALF_SPAN / spec.line_time)
    try:
        sensors = [Sensor(c, true, earth, spec.line_time, begin, lines, NO_EFFECTS) for c in cameras]
    except ValueError as error:
        remedy = "an orbit that goes on for a minute before the first and after the last time"
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
        exact.append(sightings(sensor, true, row[good], column[good]))
        offsets = noise * image.standard_normal((2, len(good)))
        noisy.append(sightings(sensor, flown.measured, row[good] + offsets[0], column[good] + offsets[1]))
    return View(points[good], (exact[0], exact[1]), (noisy[0], noisy[1]))


def second_view(sensors: Sequence[Sensor], time: float, pixel: float, height: float) -> float:
    """When the second line sees a point that the first sees as long before ``time`` (or after it), seconds.

    Parameters
    ----------
    sensors : Sequence[Sensor]
        Of the two lines.
    time : float
        Between their views, seconds.
    pixel : float
        Of the second line.
    height : float
        Of the point, metres.

    Raises
    ------
    BenchError
        The first line does not see what the second sees.
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


def sightings(sensor: Sensor, trajectory: Platform, row: np.ndarray, column: np.ndarray) -> Sightings:
    """Image points with orbit and attitude of a trajectory at the times of their lines."""
    seconds = sensor.time(row)
    return Sightings(column, trajectory.position(seconds), trajectory.body_to_itrs(seconds))
