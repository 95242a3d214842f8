"""Passes over test fields, with a three-line camera that has changed since the laboratory and may drift.

Ground points come from the nadir line's image and terrain of given relief; every line sees them through the rigorous
sensor of `twin.orbit.flight.sensor`, from the true orbit and attitude, with light time, aberration and refraction. The
analysis gets image points, control coordinates and the measured orbit and attitude, and takes the effects on the light
out of the image points by the laboratory's camera (`twin.orbit.calibration.observations`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.orbit.calibration_parameters import level_covariance
from optics.geometry.pose import rotation_matrix
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.flight import OrbitSpec, PassingSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.random_streams import stream
from twin.orbit.calibration.campaign import Campaign, PassTruth, campaign_of, line_model
from twin.orbit.calibration.field_images import FieldImages, Imager
from twin.orbit.calibration.observations import FieldPoints, PassData, light_effects
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.light_effects import NO_EFFECTS
from twin.orbit.flight.line_camera import LineTimes, changed_payload, drifted_payload, line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import TERMS, Trajectory
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import FieldSpec, OrbitCalibrationSpec, PointsSpec
    from scenes.specs.orbit.setup import CalibrationSetup


_DRIFT, _READING = 6, 7
"""Streams of a field's seed. What else is drawn of a field does not change with them."""


def _sample_drift(
    spec: OrbitCalibrationSpec, lines: Sequence[str], seed: np.random.SeedSequence
) -> FrozenMap[str, np.ndarray]:
    """Line -> (4,) true d_alpha, d_beta, d_gamma (radians) and d_f (metres) during one field; empty for no drift.

    The draws of a line are the same whatever their sigmas are.

    Args:
        spec: the test.
        lines: names of the three lines.
        seed: of the field.
    """
    if not spec.drift:
        return FrozenMap({})
    unit = np.random.default_rng(stream(seed, _DRIFT)).standard_normal((len(lines), 4))
    sigma = {name: np.array([*one.angles, one.principal_distance]) for name, one in spec.drift.items()}
    return FrozenMap({name: sigma.get(name, np.zeros(4)) * row for name, row in zip(lines, unit, strict=True)})


def _sample_readings(
    spec: OrbitCalibrationSpec, lines: Sequence[str], drift: Mapping[str, np.ndarray], seed: np.random.SeedSequence
) -> FrozenMap[str, np.ndarray]:
    """Line -> (4,) what the monitor reads, in the same units; empty for no monitor.

    Args:
        spec: the test.
        lines: names of the three lines.
        drift: the true one.
        seed: of the field.
    """
    if spec.monitor is None:
        return FrozenMap({})
    noise = np.random.default_rng(stream(seed, _READING)).standard_normal((len(lines), 4))
    sigma = reading_sigma(spec) * spec.errors.switched_on
    return FrozenMap({name: drift[name] + sigma * row for name, row in zip(lines, noise, strict=True)})


def reading_sigma(spec: OrbitCalibrationSpec) -> np.ndarray:
    """(4,) standard deviation of the monitor's readings of a camera, radians and metres. The test has a monitor."""
    assert spec.monitor is not None
    return np.array([*spec.monitor.angles, spec.monitor.principal_distance])


_LEAST_IMAGE = 0.02
"""Pixels. Image points without errors are given this sigma, for an adjustment needs weights."""
_SPARE = 1.25
"""Candidates for each ground point; those that a line does not see are left out."""
_PICTURES = 5
"""Stream of a field's seed for its images; the others are of what is drawn without them."""
_TIES = 8
"""Stream of a field's seed for the tie points of its strip; `twin.orbit.calibration.campaign` has two before."""
_MARGIN = 6.0
"""Sigmas. No point is taken so near to the end of an image that its measured place could lie outside."""


def fly_fields(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance = silent) -> Campaign:
    """Pass over every field once; image points are drawn or, where the file has a section `images`, measured.

    Raises:
        BenchError: no such orbit, or the lines do not all see enough points.
        CalibrationError: the measured points cannot be used.
    """
    spec, payload = setup.test, setup.camera
    changed = changed_payload(spec, payload)
    earth = Earth.from_spec(spec.earth)
    imager = Imager.of(setup, stream(seed, len(spec.fields)), advance) if spec.images is not None else None
    flown = [
        _pass(name, field, spec, payload, changed, earth, own, imager)
        for (name, field), own in zip(spec.fields.items(), seed.spawn(len(spec.fields)), strict=True)
    ]
    campaign = campaign_of(spec, payload, [one.measurements for one in flown], spec.images is None)
    passes = tuple(
        replace(p, known_truth=one.truth, readings=one.readings) for p, one in zip(campaign.passes, flown, strict=True)
    )
    images = tuple(one.images for one in flown if one.images is not None)
    truth = FrozenMap({k: line_model(changed, k) for k in LINES})
    return replace(campaign, passes=passes, images=images or None, known_truth=truth)


@dataclass(frozen=True, eq=False)
class _Flown:
    """A pass: what was measured of it, what a monitor reads, what became of points in images, and the truth."""

    measurements: PassMeasurements
    readings: Mapping[str, np.ndarray]
    images: FieldImages | None
    truth: PassTruth


def true_bias(spec: OrbitCalibrationSpec, latitude: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (n, 3) from measured to true attitude at latitudes (n,), radians, without the season."""
    tracker = spec.errors.star_tracker
    drift = np.array(tracker.thermal.amplitude) * spec.errors.switched_on
    turn = np.array(tracker.bias) + np.sin(latitude - tracker.thermal.reference)[:, None] * drift
    return np.asarray(Rotation.from_rotvec(turn).inv().as_euler("XYZ"))


def _pass(
    name: str,
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    payload: ThreeLineCameraSpec,
    changed: ThreeLineCameraSpec,
    earth: Earth,
    seed: np.random.SeedSequence,
    imager: Imager | None,
) -> _Flown:
    """Fly and measure."""
    pictures, drift = stream(seed, _PICTURES), _sample_drift(spec, LINES, seed)
    readings = _sample_readings(spec, LINES, drift, seed)
    cameras = line_cameras(drifted_payload(changed, drift))
    place, image, ground, season, data = (np.random.default_rng(s) for s in seed.spawn(5))
    trajectory = _trajectory(name, field, spec, earth, seed)
    errors = spec.errors
    turn = np.array(errors.star_tracker.bias) + np.array(errors.season) * season.standard_normal(3)
    tracker = errors.star_tracker.model_copy(update={"bias": tuple(turn.tolist())})
    terms = TERMS if errors.switched_on else ("attitude_bias",)
    measured = trajectory.with_errors(
        errors.model_copy(update={"star_tracker": tracker}), int(data.integers(2**31)), terms
    )
    platform = PlatformTable.sampled(measured, errors.gps.interval, errors.star_tracker.interval)
    effects = light_effects(spec.effects)
    lines = max(int((trajectory.last - trajectory.first) / spec.line_time) - 1, 1)
    times = LineTimes.even(trajectory.first + 0.5 * spec.line_time, spec.line_time, lines)
    sensors = {k: Sensor.of_lines(cameras[k], trajectory, earth, times, effects) for k in LINES}
    known, path = line_cameras(payload), TabulatedTrajectory(platform)
    laboratory = {k: Sensor.of_lines(known[k], path, earth, times, NO_EFFECTS) for k in LINES}
    models = FrozenMap({k: line_model(payload, k) for k in LINES})
    pitch = FrozenMap({k: payload.pitch_of(k) for k in LINES})
    pass_data = PassData(name, FrozenMap(laboratory), models, pitch, field.height)
    images = None
    if imager is None:
        assert spec.points is not None
        points = _simulated_points(field, spec, spec.points, sensors, pass_data, (place, image, ground))
    else:
        points, images = imager.measured(field, sensors, pass_data, effects, pictures)
    ties: Mapping[str, ImagePoints] = {}
    if spec.strip is not None and spec.points is not None:
        tie_points = spec.points.model_copy(
            update={"control": 0, "check": spec.strip.ties, "length": spec.strip.length}
        )
        own = stream(seed, _TIES)
        a, b, c = (np.random.default_rng(s) for s in own.spawn(3))
        try:
            ties = _simulated_points(field, spec, tie_points, sensors, pass_data, (a, b, c)).check_images
        except BenchError as error:
            remedy = "a shorter strip, or a longer pass (`span`)"
            raise BenchError(f"tie points: {error}", ("strip", "length"), remedy) from error
    attitude_errors = measured.errors
    assert attitude_errors is not None
    middle = float(earth.geodetic(trajectory.position(0.0))[1])
    shape = np.sin(middle - attitude_errors.reference)
    found = rotation_matrix(attitude_errors.bias + shape * attitude_errors.thermal).T
    truth = PassTruth(
        Rotation.from_matrix(found).as_euler("XYZ"),
        -attitude_errors.position(np.array(0.0)),
        trajectory,
        attitude_errors,
        drift,
    )
    datum = errors.datum if errors.switched_on else (0.0, 0.0, 0.0)
    told = _measurements_of(name, platform, FrozenMap(dict.fromkeys(LINES, times)), points, ties, datum)
    return _Flown(told, readings, images, truth)


def _measurements_of(
    name: str,
    platform: PlatformTable,
    times: Mapping[str, LineTimes],
    points: FieldPoints,
    ties: Mapping[str, ImagePoints],
    datum: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> PassMeasurements:
    """What was measured of a simulated pass, as files would have it.

    Args:
        name: of the pass.
        platform: readings.
        times: line -> line times.
        points: control, tie and check points.
        ties: line -> image points of further tie points, counted from 0.
        datum: by which control points are given too far east, north and up, metres.
    """
    given, is_control = points.control_ground, points.control
    if any(datum):
        lon, lat, _ = Earth().geodetic(given.mean(axis=0))
        given = given + np.array(datum) @ east_north_up(lon, lat)
    count, checks = len(given), len(points.check_ground)
    more = 1 + max((int(r.point.max()) for r in ties.values() if len(r.point)), default=-1)
    plan, tall = points.sigma if isinstance(points.sigma, tuple) else (points.sigma, points.sigma)
    empty = np.full((count, 3), np.nan)
    itrs = np.concatenate(
        [np.where(is_control[:, None], given, empty), points.check_ground, np.full((more, 3), np.nan)]
    )
    role = np.array(["control" if c else "tie" for c in is_control] + ["check"] * checks + ["tie"] * more, object)
    covariance = np.zeros((len(role), 3, 3))
    covariance[:count][is_control] = level_covariance(given[is_control], plan, tall)
    letter = {"control": "c", "check": "k", "tie": "t"}
    ids = [f"{letter[r]}{k}" for k, r in enumerate(role.tolist())]
    images = {}
    for line, row in points.control_images.items():
        rows = [(row, 0), (points.check_images[line], count)]
        rows += [(ties[line], count + checks)] if line in ties else []
        columns = (np.concatenate([getattr(r, k) for r, _ in rows]) for k in ("line", "pixel", "covariance"))
        images[line] = ImagePoints(np.concatenate([r.point + first for r, first in rows]), *columns)
    ground = GroundPoints.of(ids, itrs, covariance, role)
    return PassMeasurements(name, platform, FrozenMap(dict(times)), ground, FrozenMap(images))


def _simulated_points(
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    wanted: PointsSpec,
    sensors: Mapping[str, Sensor],
    data: PassData,
    random: tuple[np.random.Generator, np.random.Generator, np.random.Generator],
) -> FieldPoints:
    """Places of points, their image points and control coordinates, by three random streams."""
    place, image, ground = random
    points, seen = _points(data.name, field, spec, wanted, sensors, place)
    errors = spec.errors
    sigma, control = (v * errors.switched_on for v in (errors.image, errors.control))
    images = {}
    for k, (line, pixel) in seen.items():
        # sigma is that of x and y in the focal plane
        unit = np.array([1.0 / data.pixels_per_line(k), 1.0])
        noise = sigma * unit * image.standard_normal((len(line), 2))
        spread = np.diag((max(sigma, _LEAST_IMAGE) * unit) ** 2)
        images[k] = ImagePoints.of(np.arange(len(line)), line + noise[:, 0], pixel + noise[:, 1], spread)
    count = wanted.control
    given = points[:count] + control * ground.standard_normal((count, 3))
    control_images = {k: row.taken(np.arange(count)) for k, row in images.items()}
    check_images = {k: row.taken(np.arange(count, len(points))).numbered(count) for k, row in images.items()}
    return FieldPoints(data, control_images, given, np.ones(count, bool), control, check_images, points[count:])


def _trajectory(
    name: str, field: FieldSpec, spec: OrbitCalibrationSpec, earth: Earth, seed: np.random.SeedSequence
) -> Trajectory:
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
        return Trajectory.flown(propagate(orbit, earth), spec.attitude, seed)
    except ValueError as error:
        remedy = "a field that a sun-synchronous orbit passes"
        raise BenchError(str(error), ("fields", name), remedy) from error


def _points(
    name: str,
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    asked: PointsSpec,
    sensors: Mapping[str, Sensor],
    random: np.random.Generator,
) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Ground points (n, 3), control first, and line -> their image lines and pixels, (n,) each."""
    wanted, nadir = asked.control + asked.check, sensors["nadir"]
    height = field.height + field.relief * random.uniform(-1.0, 1.0, int(np.ceil(_SPARE * wanted)))
    pixel = random.uniform(asked.first, asked.last, len(height))
    trajectory = nadir.trajectory
    assert isinstance(trajectory, Trajectory)
    above = float(nadir.earth.geodetic(trajectory.position(0.0))[2])
    radius = float(np.linalg.norm(trajectory.position(0.0)))
    speed = float(np.linalg.norm(trajectory.velocity(0.0))) * (1.0 - above / radius)
    reach = 0.5 * asked.length / speed
    if reach > 0.99 * spec.span:  # the image ends a line before the orbit
        raise BenchError("the pass is shorter than the field", ("span",), f"more than {reach:.3g} s")
    line = (random.uniform(-reach, reach, len(height)) - nadir.first_line_time) / spec.line_time
    points = nadir.ground(line, pixel, height)
    seen = {k: s.image(points) for k, s in sensors.items()}
    edge = _MARGIN * spec.errors.image * spec.errors.switched_on - 0.5
    inside = [
        (line > edge)
        & (line < sensors[k].lines - 1.0 - edge)
        & (at > edge)
        & (at < sensors[k].camera.pixels - 1.0 - edge)
        for k, (line, at) in seen.items()
    ]
    good = np.flatnonzero(np.all(inside, axis=0))[:wanted]
    if len(good) < wanted:
        key = ("span",) if not all(np.any(np.isfinite(line)) for line, _ in seen.values()) else ("points",)
        raise BenchError(
            f"over {name} only {len(good)} of {len(height)} places are seen by all three lines",
            key,
            "a longer pass, and a field inside all three strips",
        )
    return points[good], {k: (line[good], at[good]) for k, (line, at) in seen.items()}
