"""Passes over test fields: what a three-line camera that has changed since the laboratory measures of ground points,
drawn with stated noise instead of from images (paper 003).

Ground points come from the nadir line's image and terrain of given relief; every line sees them through the rigorous
sensor of `twin.orbit.sensor`, from the true orbit and attitude. The analysis gets image points, control coordinates and
the measured orbit and attitude. Light time, aberration and refraction are left out: what is known of them is taken from
image points before a calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.orbit.calibration_parameters import CalibrationField, Noise
from analysis.orbit.three_line_model import LineModel, Rays
from optics.frozen_map import FrozenMap
from optics.rotation import about_axis, rotation_matrix
from scenes.orbit_angle import LINES
from scenes.orbit_spec import OrbitSpec, PassingSpec
from scenes.three_line_camera import ThreeLineCameraSpec
from twin.orbit.attitude import Attitude
from twin.orbit.earth import Earth
from twin.orbit.light_effects import NO_EFFECTS
from twin.orbit.line_camera import LineCamera, line_cameras
from twin.orbit.measurement_errors import TERMS
from twin.orbit.orbit import propagate
from twin.orbit.sensor import Sensor
from twin.orbit.trajectory import Trajectory
from twin.trial.bench_error import BenchError

if TYPE_CHECKING:
    from scenes.orbit_calibration import FieldSpec, OrbitCalibrationSpec
    from scenes.orbit_setup import CalibrationSetup

_LEAST_IMAGE = 0.02
"""Pixels. Image points without errors are given this sigma, for an adjustment needs weights."""
_SPARE = 2
"""Candidates for each ground point; those that a line does not see are left out."""


@dataclass(frozen=True, eq=False)
class FieldPass:
    """One pass over one field.

    Attributes:
        name: of the field.
        latitude: of its middle, radians.
        control: what the calibration gets.
        check: line -> image points of the check points.
        check_ground: (m, 3) true coordinates of the check points, ITRS, metres.
        bias: (3,) true roll, pitch, yaw at the field's middle, radians: from measured to true attitude.
        offset: (3,) true minus measured station at the field's middle, along X, Y, Z of the orbital frame, metres.
        trajectory: the true one.
        measured: with the errors of the satellite's data.
    """

    name: str
    latitude: float
    control: CalibrationField
    check: Mapping[str, Rays]
    check_ground: np.ndarray
    bias: np.ndarray
    offset: np.ndarray
    trajectory: Trajectory
    measured: Trajectory


@dataclass(frozen=True, eq=False)
class Campaign:
    """All passes, and the camera before and after launch.

    Attributes:
        spec: the test.
        laboratory: line -> camera as it was measured before launch; what the analysis starts from.
        truth: line -> camera as it is.
        noise: what the analysis is told of the independent errors.
        passes: in the file's order.
    """

    spec: OrbitCalibrationSpec
    laboratory: Mapping[str, LineModel]
    truth: Mapping[str, LineModel]
    noise: Noise
    passes: tuple[FieldPass, ...]


def fly_fields(setup: CalibrationSetup, seed: np.random.SeedSequence) -> Campaign:
    """Pass over every field once.

    Raises:
        BenchError: no such orbit, or the lines do not all see enough points.
    """
    spec, payload = setup.test, setup.camera
    changed = changed_payload(spec, payload)
    cameras = line_cameras(changed)
    earth = Earth.from_spec(spec.earth)
    passes = tuple(
        _pass(name, field, spec, payload.pitch, cameras, earth, stream)
        for (name, field), stream in zip(spec.fields.items(), seed.spawn(len(spec.fields)), strict=True)
    )
    laboratory, truth = (FrozenMap({k: line_model(p, k) for k in LINES}) for p in (payload, changed))
    return Campaign(spec, laboratory, truth, _noise(spec, payload.pitch), passes)


def changed_payload(spec: OrbitCalibrationSpec, payload: ThreeLineCameraSpec) -> ThreeLineCameraSpec:
    """The camera as it is after launch."""
    lines = {}
    for name, line in payload.lines.items():
        if name in spec.changes:
            change = spec.changes[name]
            point = tuple(a + b for a, b in zip(line.principal_point, change.principal_point, strict=True))
            focal = line.focal_length + change.focal_length
            line = line.model_copy(update={"focal_length": focal, "principal_point": point})
        lines[name] = line
    return payload.model_copy(update={"lines": FrozenMap(lines)})


def line_model(payload: ThreeLineCameraSpec, name: str) -> LineModel:
    """A line of the payload as the analysis models it."""
    line = payload.lines[name]
    to_body = about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate))
    return LineModel.of(to_body, (line.focal_length, *line.principal_point), line.position, line.k1, line.k2)


def _noise(spec: OrbitCalibrationSpec, pitch: float) -> Noise:
    """Sigmas as given, root mean square over axes; those of readings, which a spline between them does not exceed."""
    errors = spec.errors
    if not errors.switched_on:
        return Noise(_LEAST_IMAGE * pitch)
    attitude, station = (float(np.sqrt(np.mean(np.square(v)))) for v in (errors.star_tracker.noise, errors.gps.noise))
    return Noise(max(errors.image, _LEAST_IMAGE) * pitch, attitude, station)


def _pass(
    name: str,
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    pitch: float,
    cameras: Mapping[str, LineCamera],
    earth: Earth,
    seed: np.random.SeedSequence,
) -> FieldPass:
    place, image, ground, season, data = (np.random.default_rng(s) for s in seed.spawn(5))
    trajectory = _trajectory(name, field, spec, earth)
    errors = spec.errors
    turn = np.array(errors.star_tracker.bias) + np.array(errors.season) * season.standard_normal(3)
    tracker = errors.star_tracker.model_copy(update={"bias": tuple(turn.tolist())})
    terms = TERMS if errors.switched_on else ("attitude_bias",)
    measured = trajectory.with_errors(
        errors.model_copy(update={"star_tracker": tracker}), int(data.integers(2**31)), terms
    )
    sensors = {k: _sensor(cameras[k], trajectory, earth, spec) for k in LINES}
    points, seen = _points(name, field, spec, sensors, earth, place)
    sigma = errors.image * errors.switched_on
    rays = {}
    for k, (line, pixel) in seen.items():
        seconds = sensors[k].time(line)
        drawn = sigma * image.standard_normal((len(line), 2))
        # an error along the track is put into x: one of a line counts as cos^2 of the look in x
        y = pixel - 0.5 * (cameras[k].pixels - 1)
        rays[k] = Rays.of(
            np.arange(len(line)),
            pitch * (np.column_stack([np.zeros_like(y), y]) + drawn),
            measured.position(seconds),
            measured.body_to_itrs(seconds),
        )
    count = spec.points.control
    spread = errors.control * errors.switched_on
    given = points[:count] + spread * ground.standard_normal((count, 3))
    control = CalibrationField.of(name, {k: r.taken(np.arange(count)) for k, r in rays.items()}, given, spread)
    check = {k: _numbered(r.taken(np.arange(count, len(points)))) for k, r in rays.items()}
    drawn_errors = measured.errors
    assert drawn_errors is not None
    middle = float(earth.geodetic(trajectory.position(0.0))[1])
    shape = np.sin(middle - drawn_errors.reference)
    found = rotation_matrix(drawn_errors.bias + shape * drawn_errors.thermal).T
    return FieldPass(
        name,
        field.latitude,
        control,
        FrozenMap(check),
        points[count:],
        Rotation.from_matrix(found).as_euler("XYZ"),
        -drawn_errors.position(np.array(0.0)),
        trajectory,
        measured,
    )


def _trajectory(name: str, field: FieldSpec, spec: OrbitCalibrationSpec, earth: Earth) -> Trajectory:
    """The true orbit, which passes the field's middle at its epoch, and the true attitude."""
    passing = PassingSpec.model_construct(
        longitude=field.longitude,
        latitude=field.latitude,
        altitude=spec.altitude,
        direction="descending",
        inclination=None,
    )
    orbit = OrbitSpec.model_construct(
        epoch=field.epoch, before=spec.span, after=spec.span, passing=passing, elements=None, state=None
    )
    try:
        return Trajectory(propagate(orbit, earth), Attitude.from_spec(spec.attitude))
    except ValueError as error:
        remedy = "a field that a sun-synchronous orbit passes"
        raise BenchError(str(error), ("fields", name), remedy) from error


def _sensor(camera: LineCamera, trajectory: Trajectory, earth: Earth, spec: OrbitCalibrationSpec) -> Sensor:
    lines = max(int((trajectory.last - trajectory.first) / spec.line_time) - 1, 1)
    return Sensor(camera, trajectory, earth, spec.line_time, trajectory.first + 0.5 * spec.line_time, lines, NO_EFFECTS)


def _points(
    name: str,
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    sensors: Mapping[str, Sensor],
    earth: Earth,
    random: np.random.Generator,
) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Ground points (n, 3), control first, and line -> their image lines and pixels, (n,) each."""
    wanted, nadir = spec.points.control + spec.points.check, sensors["nadir"]
    height = field.height + field.relief * random.uniform(-1.0, 1.0, _SPARE * wanted)
    pixel = random.uniform(spec.points.first, spec.points.last, len(height))
    trajectory = nadir.trajectory
    assert isinstance(trajectory, Trajectory)
    above = float(earth.geodetic(trajectory.position(0.0))[2])
    radius = float(np.linalg.norm(trajectory.position(0.0)))
    speed = float(np.linalg.norm(trajectory.velocity(0.0))) * (1.0 - above / radius)
    reach = 0.5 * spec.points.length / speed
    if reach > 0.99 * spec.span:  # the image ends a line before the orbit
        raise BenchError("the pass is shorter than the field", ("span",), f"more than {reach:.3g} s")
    line = (random.uniform(-reach, reach, len(height)) - nadir.first_line_time) / spec.line_time
    points = nadir.ground(line, pixel, height)
    seen = {k: s.image(points) for k, s in sensors.items()}
    good = np.flatnonzero(np.all([np.isfinite(line) for line, _ in seen.values()], axis=0))[:wanted]
    if len(good) < wanted:
        key = ("span",) if not all(np.any(np.isfinite(line)) for line, _ in seen.values()) else ("points",)
        raise BenchError(
            f"over {name} only {len(good)} of {len(height)} places are seen by all three lines",
            key,
            "a longer pass, and a field inside all three strips",
        )
    return points[good], {k: (line[good], pixel[good]) for k, (line, pixel) in seen.items()}


def _numbered(rays: Rays) -> Rays:
    """The same rays, their points counted from 0."""
    return Rays(rays.point - rays.point.min(), rays.image, rays.station, rays.attitude)
