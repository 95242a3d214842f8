"""Stereo pair along its orbit: true lines, and the ground points that they measure.

Both views of a point, which are half a minute to a minute apart, use the state at the moment midway between them. Light
time, aberration and refraction are omitted: they are assumed to be corrected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from analysis.arrays import ARCSEC
from analysis.orbit.forward_intersection import CalibratedLine, Sightings, check_errors, intersect_pair
from analysis.statistics import rms
from optics.geometry.tree import Motion, State
from optics.numerics.number_tree import FrozenMap
from scenes.specs.course import moment
from twin.framework.procedure import Advance, BenchError, stream
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.orbit.flight.line_camera import LineCamera, calibrated_line, traced_line_cameras
from twin.orbit.flight.sensor import NO_EFFECTS, Platform, Sensor
from twin.orbit.flight.trajectory import Trajectory

if TYPE_CHECKING:
    from scenes.specs.orbit.monitor import OrbitMonitorSpec

TOO_FAR = "temperatures and motions that keep the beams on the mirrors and the spots on their CCDs"
"""Advice to the user in messages where light is lost or a spot cannot be measured."""
HALF_SPAN = 60.0
"""Duration of the orbit before and after each time of the test that the images cover, in seconds; two views 53 degrees
apart from 500 km are 70 s apart.
"""
_SPARE = 2
"""Number of candidates drawn per required ground point; those that one of the lines does not see are dropped."""
_MIDDLE = 1e-3
"""Tolerance, in seconds, with which the two views of a point lie at equal times before and after the time of the test;
a satellite moves 8 m in it.
"""


_STEP = np.array([ARCSEC, ARCSEC, ARCSEC, 10e-6])
"""Steps of the derivatives with respect to a camera's rotations d_alpha, d_beta, d_gamma (rad) and change d_f of the
principal distance (m), over which the intersection is linear to 1e-5.
"""


def motions_at(spec: OrbitMonitorSpec, time: float, only: str | None = None) -> State:
    """Return the motions of the instrument's nodes that the file specifies at a time.

    Parameters
    ----------
    spec : OrbitMonitorSpec
        Content of the test file.
    time : float
        Time, in seconds.
    only : str, optional
        Node to which the motions are limited; all by default.
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
    """Check points of a stereo pair at one time, with their image points in both cameras.

    Attributes
    ----------
    ground : (n, 3) ndarray for n points
        True points, ITRS, in metres.
    exact : tuple of Sightings
        Exact image points in each true camera of the pair, with the true orbit and attitude.
    seen : tuple of Sightings
        Measured image points, with the measured orbit and attitude.
    """

    ground: np.ndarray
    exact: tuple[Sightings, Sightings]
    seen: tuple[Sightings, Sightings]


@dataclass(frozen=True, eq=False)
class CaseErrors:
    """Errors at the check points over T times, in metres.

    Attributes
    ----------
    plan, height : (T,) ndarray
        RMS errors in plan (both axes) and in height.
    bias : (T,) ndarray
        Mean of the height errors, intersected minus true.
    camera : (T,) ndarray
        Mean height error due to the cameras alone: the difference from that of the true cameras with the same image
        points, orbit and attitude.
    camera_plan, camera_height : (T,) ndarray
        RMS over the points of the errors due to the cameras alone, in plan and in height.
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
        """RMS of the height errors due to the cameras alone over all times, in metres."""
        return rms(self.camera_height)

    @property
    def worst(self) -> float:
        """Largest of the RMS errors in height at the single times, in metres."""
        return float(self.height.max())


@dataclass(frozen=True, eq=False)
class PairFlight:
    """Stereo pair at T times of its orbit.

    Attributes
    ----------
    pair : tuple of str
        Names of the two cameras.
    times : (T,) ndarray
        Seconds from the orbit's epoch.
    lines : tuple of Mapping[str, LineCamera]
        True line of each camera, for each time.
    calibrated : Mapping[str, CalibratedLine]
        Camera -> its line as calibrated, which the processing uses.
    views : tuple of View
        Check points of each time.
    """

    pair: tuple[str, str]
    times: np.ndarray
    lines: tuple[Mapping[str, LineCamera], ...]
    calibrated: Mapping[str, CalibratedLine]
    views: tuple[View, ...]

    def true_line(self, camera: str, k: int) -> CalibratedLine:
        """Return a camera's true line at time index k, as the analysis models lines, for comparisons only."""
        return in_calibrated_form(self.lines[k][camera], self.calibrated[camera])

    def true_pair(self, k: int) -> list[CalibratedLine]:
        """Return the true lines of both cameras at time index k."""
        return [self.true_line(name, k) for name in self.pair]

    def point_errors(self, changes: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return errors of n points with calibrated cameras corrected by changes (T, 4), (T, n, 3), in metres.

        The errors are intersected minus true coordinates, east, north and up, at T times; changes are in rad and m.
        """
        corrected = [[self.calibrated[n].corrected(changes[n][k]) for n in self.pair] for k in range(len(self.times))]
        return np.array([point_errors(pair, view) for pair, view in zip(corrected, self.views, strict=True)])

    @cached_property
    def true_errors(self) -> np.ndarray:
        """Errors of n points with the true cameras at T times, due to image points and platform, (T, n, 3), in m."""
        return np.array([point_errors(self.true_pair(k), view) for k, view in enumerate(self.views)])

    def case(self, changes: Mapping[str, np.ndarray]) -> CaseErrors:
        """Return the errors with calibrated cameras corrected by changes (T, 4) at T times, in rad and m."""
        return case_errors(self.point_errors(changes), self.true_errors)

    @property
    def true_case(self) -> CaseErrors:
        """Errors at the check points with the true cameras, which are due to image points, orbit and attitude."""
        return case_errors(self.true_errors, self.true_errors)

    @cached_property
    def slopes(self) -> Mapping[str, np.ndarray]:
        """Derivatives of the mean height with respect to the correction of each camera, (T, 4) at T times.

        The corrections are the rotations d_alpha, d_beta, d_gamma (derivatives in m/rad) and the change d_f of the
        principal distance (in m/m). The derivatives are central differences of the intersection of exact image points.
        """
        return FrozenMap({name: self._slopes(i) for i, name in enumerate(self.pair)})

    def _slopes(self, i: int) -> np.ndarray:
        """Return derivatives (T, 4) of mean heights at T times to camera `i`'s correction, in m/rad and m/m."""
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


def in_calibrated_form(line: LineCamera, like: CalibratedLine) -> CalibratedLine:
    """Convert a traced line to the analysis's camera model, with the axes and principal distance of `like`."""
    return calibrated_line(line, like.axes, like.principal_distance)


def traced_pair(experiment: MonitorExperiment, state: State, pair: tuple[str, str]) -> Mapping[str, LineCamera]:
    """Trace the lines of the pair in a state; may raise AimError or BeamMissedError if light is lost."""
    traced = traced_line_cameras(experiment.instrument, experiment.backend, state)
    return FrozenMap({name: traced[name] for name in pair})


def point_errors(cameras: Sequence[CalibratedLine], view: View, exact_data: bool = False) -> np.ndarray:
    """Return the errors east, north, up of n points that two cameras intersect, (n, 3), in metres.

    Parameters
    ----------
    cameras : sequence of CalibratedLine
        The two lines, as the analysis uses them.
    view : View
        Check points.
    exact_data : bool
        True for exact image points, orbit and attitude.

    Raises
    ------
    IntersectionError
        Rays are parallel.
    """
    seen = view.exact if exact_data else view.seen
    return check_errors(intersect_pair(cameras[0], cameras[1], *seen).ground, view.ground).error


def case_errors(errors: np.ndarray, true: np.ndarray) -> CaseErrors:
    """Return RMS and mean of the errors of n points at T times: total errors, and those due to the cameras alone.

    Parameters
    ----------
    errors : (T, n, 3) ndarray
        Errors east, north, up of the points, in metres.
    true : (T, n, 3) ndarray
        Errors with the true cameras and the same image points, orbit and attitude, in metres.
    """
    all_errors, by_cameras = (
        (np.sqrt(np.mean(np.sum(e[..., :2] ** 2, axis=-1), axis=1)), np.sqrt(np.mean(e[..., 2] ** 2, axis=1)))
        for e in (errors, errors - true)
    )
    bias, camera = (e[..., 2].mean(axis=1) for e in (errors, errors - true))
    return CaseErrors(*all_errors, bias, camera, *by_cameras)


def view_check_points(
    spec: OrbitMonitorSpec,
    pair: tuple[str, str],
    lines: Sequence[Mapping[str, LineCamera]],
    seed: np.random.SeedSequence,
    advance: Advance,
) -> tuple[View, ...]:
    """Draw check points at every time, and compute their image points in both lines.

    Parameters
    ----------
    spec : OrbitMonitorSpec
        Content of the test file: orbit, attitude, ground and errors.
    pair : tuple of str
        Names of the two cameras.
    lines : sequence of Mapping[str, LineCamera]
        True line of each camera, for each of the T times.
    seed : np.random.SeedSequence
        Seed of the points and of the errors.
    advance : Advance
        Callback that reports the progress.

    Raises
    ------
    BenchError
        No such orbit exists, or too few points are seen by both lines.
    """
    flown, views = fly(spec, seed), []
    for k, line in enumerate(lines):
        views.append(_view(spec, spec.times[k], [line[name] for name in pair], flown, stream(seed, k + 1)))
        advance("ground", k + 1, len(lines))
    return tuple(views)


def fly(spec: OrbitMonitorSpec, seed: np.random.SeedSequence) -> tuple[Trajectory, Trajectory]:
    """Simulate the orbit and attitude of a test, reproducibly for a given seed: true, and as the satellite measures.

    Raises
    ------
    BenchError
        No such orbit exists.
    """
    true = Trajectory.of_test(spec, seed)
    if not spec.errors.switched_on:
        return true, true
    return true, true.with_errors(spec.errors, int(np.random.default_rng(stream(seed, 0)).integers(2**31)))


def _view(
    spec: OrbitMonitorSpec,
    time: float,
    cameras: Sequence[LineCamera],
    flown: tuple[Trajectory, Trajectory],
    seed: np.random.SeedSequence,
) -> View:
    """Draw the check points of one time, and compute their exact and measured image points."""
    random_ground, random_image = (np.random.default_rng(stream(seed, k)) for k in range(2))
    true, measured = flown
    earth = true.orbit.earth
    ground = spec.ground
    begin, lines = time - HALF_SPAN, int(2.0 * HALF_SPAN / spec.line_time)
    try:
        sensors = [Sensor(c, true, earth, spec.line_time, begin, lines, NO_EFFECTS) for c in cameras]
    except ValueError as error:
        remedy = "an orbit that goes on for a minute before the first and after the last time"
        raise BenchError(f"{error} around {moment(time)}", ("orbit", "after"), remedy) from error
    at = second_view(sensors, time, 0.5 * (ground.first + ground.last), ground.height)
    wanted = ground.points
    height = ground.height + ground.relief * random_ground.uniform(-1.0, 1.0, _SPARE * wanted)
    pixel = random_ground.uniform(ground.first, ground.last, len(height))
    speed = float(np.linalg.norm(true.velocity(time))) * float(
        np.linalg.norm(earth.ecef(0.0, 0.0)) / np.linalg.norm(true.position(time))
    )
    half_time = 0.5 * ground.length / speed
    line = (at + random_ground.uniform(-half_time, half_time, len(height)) - begin) / spec.line_time
    inside = (line > 0.0) & (line < lines - 1.0)
    points = sensors[1].ground(line[inside], pixel[inside], height[inside])
    seen = [s.image(points) for s in sensors]
    good = np.flatnonzero(np.all([np.isfinite(row) for row, _ in seen], axis=0))[:wanted]
    if len(good) < wanted:
        problem = f"at {moment(time)} only {len(good)} of {len(height)} candidate points are seen by both lines"
        remedy = "points inside both strips: nearer to the line's middle, or attitude {steering: yaw}"
        raise BenchError(problem, ("ground",), remedy)
    noise = spec.errors.image * spec.errors.switched_on
    exact, noisy = [], []
    for sensor, (row, column) in zip(sensors, seen, strict=True):
        exact.append(sightings(sensor, true, row[good], column[good]))
        offsets = noise * random_image.standard_normal((2, len(good)))
        noisy.append(sightings(sensor, measured, row[good] + offsets[0], column[good] + offsets[1]))
    return View(points[good], (exact[0], exact[1]), (noisy[0], noisy[1]))


def second_view(sensors: Sequence[Sensor], time: float, pixel: float, height: float) -> float:
    """Return the time, in seconds, at which the second line sees a point, for views symmetric about ``time``.

    The first line sees the point as long before ``time`` as the second sees it after, or the reverse.

    Parameters
    ----------
    sensors : sequence of Sensor
        Sensors of the two lines.
    time : float
        Time midway between their views, in seconds.
    pixel : float
        Pixel of the second line.
    height : float
        Height of the point, in metres.

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
    """Return image points together with the position and attitude of a trajectory at the times of their lines."""
    seconds = sensor.time(row)
    return Sightings(column, trajectory.position(seconds), trajectory.body_to_itrs(seconds))
