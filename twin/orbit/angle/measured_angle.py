"""Intersection angles from a measured pass: image points, their ground points, orbit and attitude.

Lines see ground points at many moments, but a plane passes through one station. The vector from the station S_i at a
point's own moment to its ground point G_i, corrected for the effects on the light, is therefore transferred in the body
frame to one moment with station S: S + R R_i' (G_i - S_i), where R_i and R are the attitudes (body to Earth-fixed axes)
at the two moments. Biases of the attitude rotate all these vectors alike and do not change the angles; errors that
differ from moment to moment are included in the sigmas of the points.

A simulated test can be written as such measurements, a folder of tables with a test file that reads them back.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.orbit.planes import AngleError, PlaneError, Station, Strip
from analysis.orbit.resection import ResectionError
from optics.numerics.array_math import in_span
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.angle import LEAST_POINTS, usual_angles
from scenes.specs.orbit.setup import AnyAngle, MeasuredAngleSetup
from scenes.yaml.errors import names_text, nearest
from scenes.yaml.units import MOMENT, format_quantity
from twin.framework.procedure import Advance, BenchError, silent
from twin.orbit.angle.angle_flight import LEAST_SIGMA, Measurement, without_effects
from twin.orbit.angle.angle_run import AngleRun, PassAngles, SimulatedAngleRun, estimate_angles, run_angle
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import LineAngles, LineCamera, LineTimes, line_cameras
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.flight.sensor import EARTH_RATE, NO_EFFECTS, LightEffects, Sensor
from twin.orbit.measured.measurement_tables import read_measurements, tested_files
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.measurements import ReadingErrorsSpec


def run_angle_test(setup: AnyAngle, backend: Backend | None, seed: int, advance: Advance = silent) -> AngleRun:
    """Run a test on measurements or on a simulation: ``python -m twin.orbit angle``.

    Raises
    ------
    InputError, BenchError
        Files cannot be used, or the angles cannot be determined.
    """
    if isinstance(setup, MeasuredAngleSetup):
        return run_measured_angle(setup, seed, advance)
    return run_angle(setup, backend, seed, advance)


@one_blas_thread()
def run_measured_angle(setup: MeasuredAngleSetup, seed: int = 0, advance: Advance = silent) -> AngleRun:
    """Read the measurements and estimate the angles.

    Parameters
    ----------
    setup : MeasuredAngleSetup
        Resolved test file and camera.
    seed : int
        Not used, because nothing is simulated.
    advance : Advance
        Callback that reports the progress.

    Raises
    ------
    InputError
        Files cannot be used, or a line of an angle has no points.
    BenchError
        The points do not determine the angles.
    """
    passes = []
    for measured in read_measurements(setup.data, setup.camera, advance, needed={}):
        try:
            passes.append(_measured_angles(setup, measured))
        except (PlaneError, AngleError, ResectionError, ValueError) as error:
            remedy = "more points on each line, spread over its length, and the right conventions"
            raise BenchError(f"{measured.name}: {error}", ("data",), remedy) from error
    return AngleRun(setup=setup, seed=seed, passes=tuple(passes))


def _measured_angles(setup: MeasuredAngleSetup, measured: PassMeasurements) -> PassAngles:
    """Estimate the angles of one pass.

    Parameters
    ----------
    setup : MeasuredAngleSetup
        Resolved test file and camera.
    measured : PassMeasurements
        Measurements of the pass.

    Raises
    ------
    InputError
        A line of an angle has no points.
    PlaneError, AngleError, ResectionError
        The points do not determine the angles.
    ValueError
        Orbit or attitude are not known at a moment.
    """
    test = setup.test
    has_coordinates = measured.ground.role != "tie"
    points = {name: row.taken(has_coordinates[row.point]) for name, row in measured.images.items()}
    enough = tuple(name for name in setup.camera.lines if name in points and len(points[name].point) >= LEAST_POINTS)
    pairs = _pairs(setup, measured, enough)
    used = [name for name in enough if any(name in pair for pair in pairs.values())]
    path = TabulatedTrajectory(measured.platform)
    seconds = {name: measured.line_times[name].at(points[name].line) for name in used}
    moment = float(np.mean(seconds[next(iter(pairs.values()))[1]])) if test.time is None else test.time
    if not path.covers(moment):
        allowed = (
            f"a moment within the readings of {measured.name}, {path.first:.9g} s to {path.last:.9g} s, and in no gap"
        )
        raise test.error("no orbit or attitude at this time", ("time",), value=f"{moment:g} s", allowed=allowed)
    removed = LightEffects.of(test.effects) if test.effects.corrected else NO_EFFECTS
    pixel = FrozenMap({name: points[name].pixel for name in used})
    laboratory = LineAngles(FrozenMap(line_cameras(setup.camera)), FrozenMap(pairs), pixel)
    strips = {
        name: _strip(measured, points[name], laboratory.cameras[name], path, (name, moment), removed, test.errors)
        for name in used
    }
    noise = test.errors.gps
    sigma = float(np.sqrt(np.mean(np.square(noise.noise)) + np.mean(np.square(noise.drift))))
    measurement = Measurement.of(laboratory, Station.of(path.position(moment), sigma), strips)
    ids = FrozenMap({name: measured.ground.ids[points[name].point] for name in used})
    span = FrozenMap({k: (float(np.min(t) - moment), float(np.max(t) - moment)) for k, t in seconds.items()})
    return PassAngles(measured.name, moment, laboratory, ids, span, measurement, estimate_angles(measurement))


def _pairs(
    setup: MeasuredAngleSetup, measured: PassMeasurements, enough: tuple[str, ...]
) -> Mapping[str, tuple[str, str]]:
    """Return the two lines of each angle by its name; raise InputError if a line is not in `enough`."""
    test = setup.test
    pairs = test.angles or usual_angles(enough)
    seen = f"{names_text(enough) or 'no line'} of {setup.camera.name} {'has' if len(enough) == 1 else 'have'}"
    has = f"{seen} {LEAST_POINTS} points or more in {measured.name}"
    if pairs is None:
        allowed = "`angles:` with a name and two lines for each, as alpha: [forward, nadir]"
        raise test.error("the lines of the angles are not stated", ("angles",), value=has, allowed=allowed)
    for angle, pair in pairs.items():
        for k, line in enumerate(pair):
            if line not in enough:
                key, meant = ("angles", angle, k), nearest(line, enough)
                raise test.error("this line has no points", key, value=line, allowed=has, suggestion=meant)
    return pairs


def _strip(
    measured: PassMeasurements,
    points: ImagePoints,
    camera: LineCamera,
    path: TabulatedTrajectory,
    line_and_moment: tuple[str, float],
    removed: LightEffects,
    errors: ReadingErrorsSpec,
) -> Strip:
    """Return a line's ground points as it would see them at the moment of the angles, with their full covariances."""
    name, moment = line_and_moment
    earth = Earth()
    times = measured.line_times[name]
    seconds = times.at(points.line)
    ground, spread = measured.ground.itrs[points.point], measured.ground.covariance[points.point]
    station, axes = path.position(seconds), path.body_to_itrs(seconds)
    corrected = ground
    if removed != NO_EFFECTS:
        corrected = without_effects(ground, station, path.inertial_velocity(seconds), earth, removed)
    arm = corrected - station
    carried = path.body_to_itrs(moment) @ np.swapaxes(axes, 1, 2)
    # errors of the image points on the ground, by the ground size of a line and a pixel
    sensor = Sensor.of_lines(camera, path, earth, times, NO_EFFECTS)
    height = earth.geodetic(ground)[2]
    last = (sensor.lines - 1.0, sensor.camera.pixels - 1.0)
    line, pixel = (np.clip(v, 0.0, end) - 0.25 for v, end in zip((points.line, points.pixel), last, strict=True))
    ends = (sensor.ground(line + 0.5 * (k == 0), pixel + 0.5 * (k == 1), height) for k in (0, 1))
    slope = 2.0 * (np.stack(list(ends), axis=-1) - sensor.ground(line, pixel, height)[..., None])
    spread = spread + slope @ points.covariance @ np.swapaxes(slope, 1, 2)
    spread = spread + LEAST_SIGMA**2 * np.eye(3)
    square = np.sum(arm**2, axis=1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    attitude_variance, position_variance = _shared(seconds - moment, path, errors)
    spread = spread + attitude_variance[:, None, None] * square + position_variance[:, None, None] * np.eye(3)
    return Strip.of(
        path.position(moment) + np.einsum("nij,nj->ni", carried, arm), carried @ spread @ np.swapaxes(carried, 1, 2)
    )


def _shared(offset: np.ndarray, path: TabulatedTrajectory, errors: ReadingErrorsSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return each point's variances of attitude (rad^2) and station (m^2), relative to the moment of the angles.

    Points whose attitude or station comes from the same reading of orbit or attitude share its error: each of n such
    points gets n times the variance, so that their mean has the correct one. Points that share the reading at the
    moment of the angles have the error of that moment, which does not change the angles.

    Parameters
    ----------
    offset : (n,) ndarray
        Times of the n points from the moment, in seconds.
    path : TabulatedTrajectory
        Trajectory that gives the intervals of the readings.
    errors : ReadingErrorsSpec
        Errors of the readings.

    Returns
    -------
    tuple of (n,) ndarray
        Variance of the attitude and variance of the station, for each point.
    """
    tracker, gps = errors.star_tracker, errors.gps
    attitude = _of_readings(offset, tracker.interval or path.attitude_interval, tracker.noise)
    attitude = attitude + _of_readings(offset, tracker.slow.interval, tracker.slow.noise)
    return attitude, _of_readings(offset, gps.interval or path.orbit_interval, gps.noise)


def _of_readings(offset: np.ndarray, interval: float, sigma: tuple[float, float, float]) -> np.ndarray:
    number = np.round(offset / interval).astype(int)
    _, which, count = np.unique(number, return_inverse=True, return_counts=True)
    return float(np.mean(np.square(sigma))) * count[which] * np.minimum(np.abs(offset) / interval, 1.0)


TEST_FILE = "angle.yaml"
_LINE_TIME = 1e-3
"""Time per image line, in seconds: all points are exported in the one image line at the moment of the angles, and the
lines before and after it only define the time scale.
"""
_SPAN, _READINGS = 20.0, 41
"""Time for which orbit and attitude are exported before and after the moment of the angles, in seconds, and number of
readings in it; one reading is at the moment.
"""
_IMAGE_SIGMA = 1e-6
"""Sigma of exported image points, in pixels, nearly zero: the ground points carry the errors, but a table's sigmas must
be positive.
"""


def angle_exported(run: AngleRun) -> dict[str, str]:
    """Return the files of the reported pass, path -> text, with the random errors that were drawn for it.

    Raises
    ------
    InputError
        The measurements were read from files, or the lines are those of an instrument, which no payload file describes.
    """
    test = run.setup.test
    if not isinstance(run, SimulatedAngleRun):
        text = "measurements are files already; --export writes those of a simulation"
        raise test.error(text, ("data",), allowed="the file of a simulated test")
    if run.setup.camera is None:
        text = "the lines of an instrument are traced; no payload file has the directions of their pixels"
        raise test.error(text, ("camera",), value=str(test.camera), allowed="a payload to export measurements of")
    spec = run.flight.spec
    plain = spec.plain()
    return tested_files(
        [_measurements(run)],
        run.setup.camera.plain(),
        spec,
        TEST_FILE,
        angles={name: list(pair) for name, pair in run.flight.pairs.items()},
        time=format_quantity(spec.time, MOMENT),
        effects=plain["effects"],
        errors={"gps": {"noise": [plain["errors"]["station"]] * 3}, "star_tracker": {"noise": ["0 arcsec"] * 3}},
    )


def _measurements(run: SimulatedAngleRun) -> PassMeasurements:
    """Return the measurements of the reported pass, not corrected for the effects on the light."""
    flight, spec = run.flight, run.flight.spec
    raw = flight.measure(flight.ground(flight.effects), run.shown, NO_EFFECTS)
    station = raw.station.position
    path, moment = flight.trajectory, spec.time
    step = 2.0 * _SPAN / (_READINGS - 1)
    around = moment + step * (np.arange(_READINGS) - _READINGS // 2)
    times = around[in_span(around, path.first, path.last)]
    if len(times) < 5:
        end = 0.9 * min(moment - path.first, path.last - moment)
        times = moment + end * np.linspace(-1.0, 1.0, 5)
    shift = station - path.position(moment)
    # aberration depends on the inertial velocity, which an error of the position does not change
    velocity = path.velocity(times) - np.cross([0.0, 0.0, EARTH_RATE], shift)
    quaternion = Rotation.from_matrix(path.body_to_itrs(times)).as_quat(canonical=False)
    platform = PlatformTable.of(str(path.orbit.epoch), times, path.position(times) + shift, velocity, times, quaternion)
    line_times = LineTimes.of([0.0, 1.0, 2.0], moment + _LINE_TIME * np.array([-1.0, 0.0, 1.0]))
    ids = [f"{name}_{k}" for name in flight.lines for k in range(len(flight.pixel[name]))]
    ground = GroundPoints.of(
        ids,
        np.concatenate([raw.strips[name].points for name in flight.lines]),
        # the analysis adds LEAST_SIGMA to all points
        max(spec.errors.points**2 - LEAST_SIGMA**2, 0.0) * np.eye(3),
        "control",
    )
    images, first = {}, 0
    for name in flight.lines:
        pixel = flight.pixel[name]
        images[name] = ImagePoints.of(
            first + np.arange(len(pixel)), np.ones(len(pixel)), pixel, _IMAGE_SIGMA**2 * np.eye(2)
        )
        first += len(pixel)
    return PassMeasurements(spec.name, platform, dict.fromkeys(flight.lines, line_times), ground, images)
