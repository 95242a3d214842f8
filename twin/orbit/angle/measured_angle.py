"""Intersection angles from a measured pass: its image points, the ground points that they show, orbit and attitude.

Lines see ground points at many moments, but a plane goes through one station. So each arm from the station of its own
moment to its ground point, freed of the effects on the light, is carried along in the body: from body axes then into
those of one moment, S + R R_i' (G_i - S_i). Biases of the attitude turn all arms alike and leave the angles as they
are; what differs from moment to moment is in the sigmas of the points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.angles import AngleError
from analysis.orbit.planes import PlaneError, Station, Strip
from analysis.orbit.resection import ResectionError
from optics.numerics.frozen_map import FrozenMap
from optics.numerics.threads import one_blas_thread
from scenes.specs.measured.orbit_data_setup import AnyAngle, MeasuredAngleSetup
from scenes.specs.orbit.angle import LEAST_POINTS, usual_angles
from scenes.yaml.errors import names_text, nearest
from twin.orbit.angle.angle_flight import INTERIOR, LEAST_SIGMA, Measurement, interior, without_effects
from twin.orbit.angle.angle_run import AngleRun, PassAngles, estimated, run_angle
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import LineCamera, line_cameras
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.measurement_tables import read_measurements
from twin.orbit.measured.pass_measurements import ImagePoints, PassMeasurements
from twin.run.procedure import Advance, BenchError, silent

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.measured.orbit_data import ReadingErrorsSpec


@dataclass(frozen=True, eq=False)
class _Tested:
    """Lines and angles before there is an estimate."""

    lines: tuple[str, ...]
    pairs: Mapping[str, tuple[str, str]]

    @property
    def reference(self) -> str:
        return next(iter(self.pairs.values()))[1]


def run_angle_test(setup: AnyAngle, backend: Backend | None, seed: int, advance: Advance = silent) -> AngleRun:
    """On measurements, or on a simulation: ``python -m twin.orbit angle``.

    Raises:
        InputError, BenchError: as `run_angle` and `run_measured_angle`.
    """
    if isinstance(setup, MeasuredAngleSetup):
        return run_measured_angle(setup, seed, advance)
    return run_angle(setup, backend, seed, advance)


@one_blas_thread()
def run_measured_angle(setup: MeasuredAngleSetup, seed: int = 0, advance: Advance = silent) -> AngleRun:
    """Read and estimate; nothing is drawn, so that the seed is not used.

    Raises:
        InputError: files that cannot be used, or angles of lines that have no points.
        BenchError: the points do not determine the angles.
    """
    passes = []
    for one in read_measurements(setup.data, setup.camera, advance, needed={}):
        try:
            passes.append(measured_angles(setup, one))
        except (PlaneError, AngleError, ResectionError, ValueError) as error:
            remedy = "more points on each line, spread over its length, and the right conventions"
            raise BenchError(f"{one.name}: {error}", ("data",), remedy) from error
    return AngleRun(setup=setup, seed=seed, passes=tuple(passes))


def measured_angles(setup: MeasuredAngleSetup, one: PassMeasurements) -> PassAngles:
    """Angles of one pass.

    Args:
        setup: the test.
        one: the pass.

    Raises:
        InputError: angles of lines that have no points.
        PlaneError, AngleError, ResectionError: the points do not determine them.
        ValueError: a moment at which orbit or attitude are not known.
    """
    test = setup.test
    given = one.ground.role != "tie"
    points = {name: row.taken(given[row.point]) for name, row in one.images.items()}
    enough = tuple(name for name in setup.camera.lines if name in points and len(points[name].point) >= LEAST_POINTS)
    pairs = _pairs(setup, one, enough)
    used = [name for name in enough if any(name in pair for pair in pairs.values())]
    tested = _Tested(tuple(used), pairs)
    path = TabulatedTrajectory(one.platform)
    seconds = {name: one.line_times[name].at(points[name].line) for name in used}
    moment = float(np.mean(seconds[tested.reference])) if test.time is None else test.time
    if not path.known(moment):
        allowed = f"a moment within the readings of {one.name}, {path.first:.9g} s to {path.last:.9g} s, and in no gap"
        raise test.error("orbit or attitude are not known then", ("time",), found=f"{moment:g} s", allowed=allowed)
    e = test.effects
    removed = LightEffects(e.light_time, e.aberration, e.refraction, e.wavelength) if e.corrected else NO_EFFECTS
    laboratory = {name: camera for name, camera in line_cameras(setup.camera).items() if name in used}
    strips = {
        name: _strip(one, points[name], laboratory[name], path, (name, moment), removed, test.errors) for name in used
    }
    inside = {name: interior(laboratory[name], points[name].pixel) for name in used}
    noise = test.errors.gps
    sigma = float(np.sqrt(np.mean(np.square(noise.noise)) + np.mean(np.square(noise.drift))))
    measurement = Measurement(
        Station.of(path.position(moment), sigma),
        strips,
        **{key: {name: each[key] for name, each in inside.items()} for key in INTERIOR},
    )
    return PassAngles(
        one.name,
        moment,
        FrozenMap(pairs),
        FrozenMap(laboratory),
        FrozenMap({name: points[name].pixel for name in used}),
        FrozenMap({name: one.ground.ids[points[name].point] for name in used}),
        FrozenMap({k: (float(np.min(t) - moment), float(np.max(t) - moment)) for k, t in seconds.items()}),
        measurement,
        estimated(measurement, tested),
    )


def _pairs(setup: MeasuredAngleSetup, one: PassMeasurements, enough: tuple[str, ...]) -> Mapping[str, tuple[str, str]]:
    """Angle -> its two lines, which have enough points. InputError otherwise."""
    test = setup.test
    pairs = test.angles or usual_angles(enough)
    seen = f"{names_text(enough) or 'no line'} of {setup.camera.name} {'has' if len(enough) == 1 else 'have'}"
    has = f"{seen} {LEAST_POINTS} points or more in {one.name}"
    if pairs is None:
        allowed = "`angles:` with a name and two lines for each, as alpha: [forward, nadir]"
        raise test.error("which lines the angles lie between is not said", ("angles",), found=has, allowed=allowed)
    for angle, pair in pairs.items():
        for k, line in enumerate(pair):
            if line not in enough:
                key, meant = ("angles", angle, k), nearest(line, enough)
                raise test.error("a line without points", key, found=line, allowed=has, suggestion=meant)
    return pairs


def _strip(
    one: PassMeasurements,
    points: ImagePoints,
    camera: LineCamera,
    path: TabulatedTrajectory,
    place: tuple[str, float],
    removed: LightEffects,
    errors: ReadingErrorsSpec,
) -> Strip:
    """Ground points of a line as it would see them at the moment, with what is uncertain in that."""
    name, moment = place
    earth = Earth()
    times = one.line_times[name]
    seconds = times.at(points.line)
    ground, spread = one.ground.itrs[points.point], one.ground.covariance[points.point]
    station, axes = path.position(seconds), path.body_to_itrs(seconds)
    seen = ground
    if removed != NO_EFFECTS:
        seen = without_effects(ground, station, path.inertial_velocity(seconds), earth, removed)
    arm = seen - station
    carried = path.body_to_itrs(moment) @ np.swapaxes(axes, 1, 2)
    # image: what a line and a pixel are on the ground
    sensor = Sensor.of_lines(camera, path, earth, times, NO_EFFECTS)
    height = earth.geodetic(ground)[2]
    last = (sensor.lines - 1.0, sensor.camera.pixels - 1.0)
    low = [np.clip(v, 0.0, end) - 0.25 for v, end in zip((points.line, points.pixel), last, strict=True)]
    slopes = [
        2.0
        * (
            sensor.ground(low[0] + 0.5 * (k == 0), low[1] + 0.5 * (k == 1), height)
            - sensor.ground(low[0], low[1], height)
        )
        for k in (0, 1)
    ]
    slope = np.stack(slopes, axis=-1)
    spread = spread + slope @ points.covariance @ np.swapaxes(slope, 1, 2)
    spread = spread + LEAST_SIGMA**2 * np.eye(3)
    square = np.sum(arm**2, axis=1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    turned, moved = _shared(seconds - moment, path, errors)
    spread = spread + turned[:, None, None] * square + moved[:, None, None] * np.eye(3)
    return Strip.of(
        path.position(moment) + np.einsum("nij,nj->ni", carried, arm), carried @ spread @ np.swapaxes(carried, 1, 2)
    )


def _shared(away: np.ndarray, path: TabulatedTrajectory, errors: ReadingErrorsSpec) -> tuple[np.ndarray, np.ndarray]:
    """Variances (n,) of attitude, rad^2, and of the station, m^2, against those of the moment.

    Points of one reading err alike: each of n is given n times the variance, so that their mean has the right one. A
    point of the moment's own reading errs like the moment, which leaves the angles as they are.

    Args:
        away: times of the points from the moment, (n,), seconds.
        path: for the intervals of the readings.
        errors: of the readings.
    """
    tracker, gps = errors.star_tracker, errors.gps
    turn = _of_readings(away, tracker.interval or path.attitude_interval, tracker.noise)
    turn = turn + _of_readings(away, tracker.slow.interval, tracker.slow.noise)
    return turn, _of_readings(away, gps.interval or path.orbit_interval, gps.noise)


def _of_readings(away: np.ndarray, interval: float, sigma: tuple[float, float, float]) -> np.ndarray:
    number = np.round(away / interval).astype(int)
    _, which, count = np.unique(number, return_inverse=True, return_counts=True)
    return float(np.mean(np.square(sigma))) * count[which] * np.minimum(np.abs(away) / interval, 1.0)
