"""Passes over test fields, with a three-line camera that has changed since the laboratory and may drift.

Ground points come from the nadir line's image and terrain of given relief; every line sees them through the rigorous
sensor of `twin.orbit.flight.sensor`, from the true orbit and attitude, with light time, aberration and refraction. The
analysis gets image points, control coordinates and the measured orbit and attitude, and takes the effects on the light
out of the image points by the laboratory's camera (`twin.orbit.calibration.observations`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.orbit.calibration_parameters import CalibrationField, Noise
from analysis.orbit.three_line_model import LineModel, Rays
from optics.geometry.pose import about_axis, rotation_matrix
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.orbit_angle import LINES
from scenes.specs.orbit_spec import OrbitSpec, PassingSpec
from scenes.specs.three_line_camera import ThreeLineCameraSpec
from twin.orbit.calibration.field_images import FieldImages, Imager
from twin.orbit.calibration.observations import FieldPoints, PassData, image_sigma, light_effects
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import LineCamera, line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.payload_changes import changed_payload, drifted_payload
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import TERMS, Attitude, Trajectory
from twin.orbit.measured.pass_measurements import ImagePoints
from twin.run.procedure import Advance, BenchError, silent
from twin.run.random_streams import stream

if TYPE_CHECKING:
    from scenes.specs.orbit_calibration import FieldSpec, OrbitCalibrationSpec, PointsSpec
    from scenes.specs.orbit_setup import CalibrationSetup


_DRIFT, _READING = 6, 7
"""Streams of a field's seed. What else is drawn of a field does not change with them."""


def sample_drift(spec: OrbitCalibrationSpec, seed: np.random.SeedSequence) -> FrozenMap[str, np.ndarray]:
    """Line -> (4,) true d_alpha, d_beta, d_gamma (radians) and d_f (metres) during one field; empty for no drift.

    The draws of a line are the same whatever their sigmas are.

    Args:
        spec: the test.
        seed: of the field.
    """
    if not spec.drift:
        return FrozenMap({})
    unit = np.random.default_rng(stream(seed, _DRIFT)).standard_normal((len(LINES), 4))
    sigma = {name: np.array([*one.angles, one.focal_length]) for name, one in spec.drift.items()}
    return FrozenMap({name: sigma.get(name, np.zeros(4)) * row for name, row in zip(LINES, unit, strict=True)})


def sample_readings(
    spec: OrbitCalibrationSpec, drift: Mapping[str, np.ndarray], seed: np.random.SeedSequence
) -> FrozenMap[str, np.ndarray]:
    """Line -> (4,) what the monitor reads, in the same units; empty for no monitor.

    Args:
        spec: the test.
        drift: the true one.
        seed: of the field.
    """
    if spec.monitor is None:
        return FrozenMap({})
    noise = np.random.default_rng(stream(seed, _READING)).standard_normal((len(LINES), 4))
    sigma = reading_sigma(spec) * spec.errors.switched_on
    return FrozenMap({name: drift[name] + sigma * row for name, row in zip(LINES, noise, strict=True)})


def reading_sigma(spec: OrbitCalibrationSpec) -> np.ndarray:
    """(4,) standard deviation of the monitor's readings of a camera, radians and metres. The test has a monitor."""
    assert spec.monitor is not None
    return np.array([*spec.monitor.angles, spec.monitor.focal_length])


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


@dataclass(frozen=True, eq=False)
class FieldPass:
    """One pass over one field.

    Attributes:
        name: of the field.
        latitude: of its middle, radians.
        data: what is known of the pass.
        control_images: line -> measured image points of the control points.
        control_ground: (n, 3) their given coordinates, ITRS, metres.
        check_images: line -> measured image points of the check points.
        control: what the calibration gets.
        check: line -> rays of the check points.
        check_ground: (m, 3) true coordinates of the check points, ITRS, metres.
        sigma: of each given coordinate, or of each axis in plan and of the height, metres.
        bias: (3,) true roll, pitch, yaw at the field's middle, radians: from measured to true attitude.
        offset: (3,) true minus measured station at the field's middle, along X, Y, Z of the orbital frame, metres.
        trajectory: the true one.
        measured: with the errors of the satellite's data.
        drift: line -> (4,) true d_alpha, d_beta, d_gamma, d_f of its camera, radians and metres; empty for no drift.
        readings: line -> (4,) what the monitor reads of it; empty for no monitor.
        tie_images: line -> measured image points of the strip's tie points; empty for no strip.
        ties: line -> their rays.
    """

    name: str
    latitude: float
    data: PassData
    control_images: Mapping[str, ImagePoints]
    control_ground: np.ndarray
    check_images: Mapping[str, ImagePoints]
    control: CalibrationField
    check: Mapping[str, Rays]
    check_ground: np.ndarray
    sigma: float | tuple[float, float]
    bias: np.ndarray
    offset: np.ndarray
    trajectory: Trajectory
    measured: Trajectory
    drift: Mapping[str, np.ndarray] = FrozenMap({})
    readings: Mapping[str, np.ndarray] = FrozenMap({})
    tie_images: Mapping[str, ImagePoints] = FrozenMap({})
    ties: Mapping[str, Rays] = FrozenMap({})

    def bias_at(self, time: float) -> np.ndarray:
        """(3,) true roll, pitch, yaw at a time, seconds from the field's middle, radians, without slow errors."""
        errors = self.measured.errors
        assert errors is not None
        latitude = self.trajectory.orbit.earth.geodetic(self.trajectory.position(time))[1]
        turn = errors.bias + np.sin(latitude - errors.reference) * errors.thermal
        return np.asarray(Rotation.from_rotvec(turn).inv().as_euler("XYZ"))

    def shifted(self, datum: tuple[float, float, float]) -> FieldPass:
        """With control points given farther east, north and up, metres; rays stay as they are."""
        lon, lat, _ = self.data.earth.geodetic(self.control_ground.mean(axis=0))
        ground = self.control_ground + np.array(datum) @ east_north_up(lon, lat)
        return replace(self, control_ground=ground, control=replace(self.control, ground=ground))


@dataclass(frozen=True, eq=False)
class Campaign:
    """All passes, and the camera before and after launch.

    Attributes:
        spec: the test.
        laboratory: line -> camera as it was measured before launch; what the analysis starts from.
        truth: line -> camera as it is, without the drift of single fields.
        noise: what the analysis is told of the independent errors.
        passes: in the file's order.
        images: what became of points measured in images, by field; None for drawn ones.
    """

    spec: OrbitCalibrationSpec
    laboratory: Mapping[str, LineModel]
    truth: Mapping[str, LineModel]
    noise: Noise
    passes: tuple[FieldPass, ...]
    images: tuple[FieldImages, ...] | None = None

    @property
    def effects(self) -> LightEffects:
        """On the light."""
        return light_effects(self.spec.effects)

    @property
    def independent(self) -> Campaign:
        """The same measurements, but the analysis counts the noise of attitude and orbit as each exposure's own.

        Estimates are hardly worse and ten times faster; their sigmas are too small where points are exposed within a
        few readings.
        """
        own = replace(self.noise, attitude_interval=None, station_interval=None, slow_interval=None)
        return replace(self, noise=own)

    def without_effects(self, removed: LightEffects) -> Campaign:
        """The same image points with these effects on the light taken out of them.

        Raises:
            CalibrationError: control coordinates that cannot be used, or check points that cannot be intersected.
        """
        passes = tuple(
            replace(
                p,
                control=p.data.control_field(p.control_images, p.control_ground, p.sigma, removed, p.control.control),
                check=FrozenMap(p.data.check_rays(p.check_images, removed, self.noise)),
                ties=FrozenMap(p.data.check_rays(p.tie_images, removed, self.noise) if p.tie_images else {}),
            )
            for p in self.passes
        )
        return replace(self, passes=passes)

    def shifted(self, datum: tuple[float, float, float]) -> Campaign:
        """All control points given farther east, north and up, metres."""
        return replace(self, passes=tuple(p.shifted(datum) for p in self.passes))


def fly_fields(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance = silent) -> Campaign:
    """Pass over every field once; image points are drawn or, where the file has a section `images`, measured.

    Raises:
        BenchError: no such orbit, or the lines do not all see enough points.
        CalibrationError: the measured points cannot be used.
    """
    spec, payload = setup.test, setup.camera
    changed = changed_payload(spec, payload)
    earth = Earth.from_spec(spec.earth)
    laboratory, truth = (FrozenMap({k: line_model(p, k) for k in LINES}) for p in (payload, changed))
    known = line_cameras(payload)
    pitch = FrozenMap({k: payload.pitch_of(k) for k in LINES})
    imager = Imager.of(setup, stream(seed, len(spec.fields)), advance) if spec.images is not None else None
    flown = [
        _pass(name, field, spec, pitch, (known, laboratory), changed, earth, own, imager)
        for (name, field), own in zip(spec.fields.items(), seed.spawn(len(spec.fields)), strict=True)
    ]
    passes, images = tuple(p for p, _ in flown), tuple(i for _, i in flown if i is not None)
    first = passes[0]
    noise = _noise(spec, first.data.unit or image_sigma(first.control_images, first.data))
    campaign = Campaign(spec, laboratory, truth, noise, passes, images or None)
    return campaign.without_effects(campaign.effects if spec.effects.corrected else NO_EFFECTS)


def true_bias(spec: OrbitCalibrationSpec, latitude: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (n, 3) from measured to true attitude at latitudes (n,), radians, without the season."""
    tracker = spec.errors.star_tracker
    drift = np.array(tracker.thermal.amplitude) * spec.errors.switched_on
    turn = np.array(tracker.bias) + np.sin(latitude - tracker.thermal.reference)[:, None] * drift
    return np.asarray(Rotation.from_rotvec(turn).inv().as_euler("XYZ"))


def line_model(payload: ThreeLineCameraSpec, name: str) -> LineModel:
    """A line of the payload as the analysis models it."""
    line = payload.lines[name]
    to_body = about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate))
    return LineModel.of(to_body, (line.focal_length, *line.principal_point), line.position, line.k1, line.k2)


def _noise(spec: OrbitCalibrationSpec, image: float) -> Noise:
    """Sigmas of readings as given, root mean square over axes, and their intervals."""
    errors = spec.errors
    if not errors.switched_on:
        return Noise(image)
    tracker, gps = errors.star_tracker, errors.gps
    attitude, station, slow = (
        float(np.sqrt(np.mean(np.square(v)))) for v in (tracker.noise, gps.noise, tracker.slow.noise)
    )
    return Noise(image, attitude, station, tracker.interval, gps.interval, slow, tracker.slow.interval)


def _pass(
    name: str,
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    pitch: Mapping[str, float],
    known: tuple[Mapping[str, LineCamera], Mapping[str, LineModel]],
    changed: ThreeLineCameraSpec,
    earth: Earth,
    seed: np.random.SeedSequence,
    imager: Imager | None,
) -> tuple[FieldPass, FieldImages | None]:
    """Fly and measure; rays are made later, when the effects on the light are taken out."""
    pictures, drift = stream(seed, _PICTURES), sample_drift(spec, seed)
    readings = sample_readings(spec, drift, seed)
    cameras = line_cameras(drifted_payload(changed, drift))
    place, image, ground, season, data = (np.random.default_rng(s) for s in seed.spawn(5))
    trajectory = _trajectory(name, field, spec, earth)
    errors = spec.errors
    turn = np.array(errors.star_tracker.bias) + np.array(errors.season) * season.standard_normal(3)
    tracker = errors.star_tracker.model_copy(update={"bias": tuple(turn.tolist())})
    terms = TERMS if errors.switched_on else ("attitude_bias",)
    measured = trajectory.with_errors(
        errors.model_copy(update={"star_tracker": tracker}), int(data.integers(2**31)), terms
    )
    effects = light_effects(spec.effects)
    sensors = {k: _sensor(cameras[k], trajectory, earth, spec, effects) for k in LINES}
    laboratory = {k: _sensor(known[0][k], measured, earth, spec, NO_EFFECTS) for k in LINES}
    pass_data = PassData(name, FrozenMap(laboratory), known[1], pitch, field.height)
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
    given = points.control_ground
    one = FieldPass(
        name,
        field.latitude,
        points.data,
        FrozenMap(points.control_images),
        given,
        FrozenMap(points.check_images),
        CalibrationField.of(name, points.data.rays(points.control_images), given, points.sigma, points.control),
        FrozenMap(points.data.rays(points.check_images)),
        points.check_ground,
        points.sigma,
        Rotation.from_matrix(found).as_euler("XYZ"),
        -attitude_errors.position(np.array(0.0)),
        trajectory,
        measured,
        drift,
        readings,
        FrozenMap(ties),
    )
    return (one.shifted(errors.datum) if errors.switched_on and any(errors.datum) else one), images


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


def _sensor(
    camera: LineCamera, trajectory: Trajectory, earth: Earth, spec: OrbitCalibrationSpec, effects: LightEffects
) -> Sensor:
    lines = max(int((trajectory.last - trajectory.first) / spec.line_time) - 1, 1)
    return Sensor(camera, trajectory, earth, spec.line_time, trajectory.first + 0.5 * spec.line_time, lines, effects)


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
