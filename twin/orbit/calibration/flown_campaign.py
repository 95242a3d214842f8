"""Simulated passes over test fields, with a three-line camera that has changed since the laboratory and may drift.

Ground points are drawn in the nadir line's image, on terrain of given relief. Every line sees them through the rigorous
sensor of `twin.orbit.flight.sensor`, from the true orbit and attitude, with light time, aberration and refraction. The
analysis gets image points, control coordinates and the measured orbit and attitude, and corrects the image points for
the effects on the light with the laboratory's camera (`twin.orbit.calibration.campaign`).

Instead of drawn points, the image points of a field can be measured in rendered images of patches of its ground. Every
patch is rendered through the true sensors, and its points are matched with the data that a user has
(`twin.orbit.images.image_points`). The truth is used only to record wrong matches and for the true coordinates of check
points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.orbit.calibration_parameters import level_covariance
from optics.geometry.pose import rotation_matrix
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.yaml.errors import KeyPath
from twin.framework.procedure import Advance, BenchError, silent, stream
from twin.orbit.calibration.campaign import (
    Campaign,
    FieldImages,
    FieldPoints,
    PassData,
    PassTruth,
    PatchRecord,
    campaign_of,
    line_model,
    pass_data,
    passing_orbit,
)
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.line_camera import LineTimes, changed_payload, drifted_payload, line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.flight.sensor import LightEffects, Sensor
from twin.orbit.flight.trajectory import TERMS, Trajectory
from twin.orbit.images.image_points import POINTS_REMEDY, MatchedPoints, PointsError, measure_points
from twin.orbit.images.line_optics import LineOptics, optics_of
from twin.orbit.images.patch import LineComparison, Patch, PatchError, fly_patch, imaged_lines, judged, true_ground
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements, point_names

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import (
        CalibrationImagesSpec,
        FieldSpec,
        OrbitCalibrationSpec,
        PatchPositionSpec,
        PointsSpec,
    )
    from scenes.specs.orbit.scene import GroundSpec
    from scenes.specs.orbit.setup import CalibrationSetup

_OFFSET = 9000.0
"""Largest offset of a patch from the middle of the real terrain model, east and north, in metres; the model covers 30
km x 32 km.
"""
_LEAST_CONTROL = 6
"""Smallest number of control points of a field that must be matched in every line; the twelve unknowns require three,
the others are redundant.
"""
_REMEDIES: Mapping[str, tuple[KeyPath, str]] = FrozenMap(
    {
        "span": (("span",), "a longer pass, or patches nearer to the field's middle"),
        "place": (("images", "patches"), "a patch inside the swath of every line"),
        "size": (("images", "patches"), "a smaller patch, or one farther from the ends of the lines"),
        "terrain": (("images", "ground", "terrain"), "less relief, a larger exponent or larger posts"),
    }
)


@dataclass(eq=False)
class Imager:
    """Renderer of patches that measures their points and reports its progress.

    Attributes
    ----------
    setup : CalibrationSetup
        Resolved test file and camera.
    spec : CalibrationImagesSpec
        Section `images` of the file.
    optics : Mapping[str, LineOptics]
        Line -> lens and CCD.
    pattern : np.random.SeedSequence
        Seed of the pixels' non-uniformity, the same in all fields.
    advance : Advance
        Callback that is called after each patch.
    done : int
        Number of patches finished.
    """

    setup: CalibrationSetup
    spec: CalibrationImagesSpec
    optics: Mapping[str, LineOptics]
    pattern: np.random.SeedSequence
    advance: Advance
    done: int = field(default=0)

    @classmethod
    def of(cls, setup: CalibrationSetup, pattern: np.random.SeedSequence, advance: Advance) -> Imager:
        """Return the renderer of a test with a section `images`."""
        spec = setup.test.images
        assert spec is not None
        optics = optics_of(setup.camera, tuple(setup.camera.lines), setup.test.line_time, setup.detectors)
        return cls(setup, spec, optics, pattern, advance)

    def measured(
        self,
        field: FieldSpec,
        sensors: Mapping[str, Sensor],
        data: PassData,
        effects: LightEffects,
        seed: np.random.SeedSequence,
    ) -> tuple[FieldPoints, FieldImages]:
        """Render the patches of one field and measure their points.

        Parameters
        ----------
        field : FieldSpec
            Field of the test file.
        sensors : Mapping[str, Sensor]
            True sensors by line.
        data : PassData
            Sensors and camera models that the analysis has.
        effects : LightEffects
            Effects on the light, which the analysis knows as well.
        seed : np.random.SeedSequence
            Seed of the ground, of the control points' errors and of the frames' noise.

        Raises
        ------
        BenchError
            A patch cannot be imaged, its points cannot be measured, or too few points are matched.
        """
        users = {name: replace(sensor, effects=effects) for name, sensor in data.sensors.items()}
        lines = imaged_lines(sensors, users, {name: self.optics[name] for name in sensors}, self.pattern)
        total = len(self.setup.test.fields) * len(self.spec.patches)
        self.advance("patches", self.done, total)
        patches, records = [], []
        for k, patch_spec in enumerate(self.spec.patches):
            patch_seed = stream(seed, k)
            try:
                patch = fly_patch(
                    lines,
                    _middle(patch_spec, sensors["nadir"], field.height),
                    (self.spec.lines, self.spec.pixels),
                    self._ground(field, stream(patch_seed, 1)),
                    self.spec.control,
                    stream(patch_seed, 0),
                    self.spec.oversampling,
                )
                points = measure_points(patch, self.spec.points)
            except PatchError as error:
                key, remedy = _REMEDIES[error.part]
                raise BenchError(f"{data.name}, patch {k + 1}: {error}", key, remedy) from error
            except PointsError as error:
                problem = f"{data.name}, patch {k + 1}: {error}"
                raise BenchError(problem, ("images", "points"), POINTS_REMEDY) from error
            patches.append(patch)
            judgements = {sort: judged(patch, points_of_sort) for sort, points_of_sort in points.sorts.items()}
            records.append(PatchRecord(points, FrozenMap(judgements)))
            self.done += 1
            self.advance("patches", self.done, total)
        return self._collected(data, patches, records)

    def _ground(self, field: FieldSpec, seed: np.random.SeedSequence) -> GroundSpec:
        terrain = self.spec.ground.terrain
        offset = np.random.default_rng(seed).uniform(-_OFFSET, _OFFSET, 2) + terrain.offset
        terrain = terrain.model_copy(update={"height": field.height, "offset": tuple(offset.tolist())})
        return self.spec.ground.model_copy(update={"terrain": terrain})

    def _collected(
        self, data: PassData, patches: list[Patch], records: list[PatchRecord]
    ) -> tuple[FieldPoints, FieldImages]:
        control, check, ties, truth = [], [], [], []
        for patch, record in zip(patches, records, strict=True):
            maps = record.points.control
            assert maps is not None
            control.append(_SelectedPoints.of(maps, maps.in_all & ~maps.check, record.judgements["control"]))
            check.append(_SelectedPoints.of(maps, maps.in_all & maps.check, record.judgements["control"]))
            truth.append(true_ground(patch, maps)[maps.in_all & maps.check])
            if record.points.ties is not None:
                tied = record.points.ties
                ties.append(_SelectedPoints.of(tied, tied.in_all, record.judgements["tie"]))
        control_points, check_points, tie = (_joined(parts, data) for parts in (control, check, ties))
        if control_points.count < _LEAST_CONTROL or check_points.count < 2:
            counts = f"only {control_points.count} control and {check_points.count} check points"
            problem = f"{data.name}: {counts} were matched in every line; {_match_counts(records)}"
            remedy = f"{_LEAST_CONTROL} control and 2 check points or more: {POINTS_REMEDY}"
            raise BenchError(problem, ("images", "points"), remedy)
        # an error in plan is common to all points of a patch: each of n points gets n times the variance
        share = np.sqrt(control_points.count / len(patches))
        sigma = self.spec.control.sigma * share, self.spec.points.height_sigma
        both = control_points.followed_by(tie)
        points = FieldPoints(
            both.images,
            both.ground,
            np.arange(both.count) < control_points.count,
            sigma if min(sigma) > 0.0 else (max(sigma[0], _EXACT), max(sigma[1], _EXACT)),
            check_points.images,
            np.concatenate(truth),
        )
        return points, FieldImages(data.name, tuple(records), patches[0], both.wrong, check_points.wrong)


_EXACT = 1e-3
"""Sigma assumed for control points that are simulated without errors, in metres: an adjustment needs weights."""


@dataclass(frozen=True, eq=False)
class _SelectedPoints:
    """Points of a patch or field that every line sees: image points, ground coordinates, flags of wrong matches."""

    images: Mapping[str, ImagePoints]
    ground: np.ndarray
    wrong: Mapping[str, np.ndarray]

    @property
    def count(self) -> int:
        return len(self.ground)

    @classmethod
    def of(cls, points: MatchedPoints, chosen: np.ndarray, judgements: Mapping[str, LineComparison]) -> _SelectedPoints:
        images, wrong = {}, {}
        number = np.arange(int(chosen.sum()))
        for name, line in points.lines.items():
            images[name] = line.measured(chosen, number)
            wrong[name] = judgements[name].wrong[chosen] if name in judgements else np.zeros(len(number), bool)
        return cls(images, points.ground[chosen], wrong)

    def followed_by(self, other: _SelectedPoints) -> _SelectedPoints:
        images = {
            name: ImagePoints.joined([row, other.images[name].numbered(-self.count)])
            for name, row in self.images.items()
        }
        wrong = {name: np.concatenate([w, other.wrong[name]]) for name, w in self.wrong.items()}
        return _SelectedPoints(images, np.concatenate([self.ground, other.ground]), wrong)


def _joined(parts: list[_SelectedPoints], data: PassData) -> _SelectedPoints:
    none = {name: ImagePoints.of(np.zeros(0, int), [], [], np.zeros((0, 2, 2))) for name in data.sensors}
    whole = _SelectedPoints(none, np.zeros((0, 3)), {name: np.zeros(0, bool) for name in data.sensors})
    for part in parts:
        whole = whole.followed_by(part)
    return whole


def _match_counts(records: list[PatchRecord]) -> str:
    """Return a text with the numbers of points searched for, matched, and consistent with their neighbours, by line."""
    words = []
    for name in records[0].judgements["control"]:
        lines = [r.points.control.lines[name] for r in records if r.points.control is not None]
        sought, matched, accepted = (
            sum(int(np.sum(v)) for v in values)
            for values in zip(*((np.ones(len(x.status)), x.matched, x.accepted) for x in lines), strict=True)
        )
        words.append(f"{name}: {sought} sought, {matched} matched, {accepted} consistent with their neighbours")
    return "; ".join(words)


def _middle(patch: PatchPositionSpec, nadir: Sensor, height: float) -> tuple[float, float]:
    """Return the longitude and latitude of a patch's middle, in radians."""
    at = (0.0 - nadir.first_line_time) / nadir.line_time
    step = nadir.ground(np.array([at, at + 1.0]), np.array([patch.pixel]), height)
    line = at + patch.track / float(np.linalg.norm(step[1] - step[0]))
    if not 0.0 <= line <= nadir.lines - 1.0:
        problem = f"the patch at {patch.track / 1e3:g} km along the track lies beyond the pass"
        raise PatchError(problem, "span")
    point = nadir.ground(np.array([line]), np.array([patch.pixel]), height)
    longitude, latitude, _ = nadir.earth.geodetic(point[0])
    return float(longitude), float(latitude)


_DRIFT, _READING = 6, 7
"""Numbers of the random streams of a field's seed for the cameras' drift and the monitor's readings, so that these do
not change the other random numbers.
"""


def _sample_drift(spec: OrbitCalibrationSpec, seed: np.random.SeedSequence) -> FrozenMap[str, np.ndarray]:
    """Draw the true change (4,) of each line camera in one field: d_alpha, d_beta, d_gamma (rad) and d_f (m).

    These are rotations about the camera's Y, X and line of sight, and the change of the principal distance. The result
    is empty for cameras without drift. The random numbers of a line do not depend on the sigmas of the others.

    Parameters
    ----------
    spec : OrbitCalibrationSpec
        Content of the test file.
    seed : np.random.SeedSequence
        Seed of the field.
    """
    if not spec.drift:
        return FrozenMap({})
    unit = np.random.default_rng(stream(seed, _DRIFT)).standard_normal((len(LINES), 4))
    sigma = {name: np.array([*drift.angles, drift.principal_distance]) for name, drift in spec.drift.items()}
    return FrozenMap({name: sigma.get(name, np.zeros(4)) * row for name, row in zip(LINES, unit, strict=True)})


def _sample_readings(
    spec: OrbitCalibrationSpec, drift: Mapping[str, np.ndarray], seed: np.random.SeedSequence
) -> FrozenMap[str, np.ndarray]:
    """Draw the monitor's noisy measurement (4,) of each line camera's change; empty without a monitor.

    The elements are the rotations d_alpha, d_beta, d_gamma, in radians, and the change d_f of the principal distance,
    in metres.
    """
    if spec.monitor is None:
        return FrozenMap({})
    noise = np.random.default_rng(stream(seed, _READING)).standard_normal((len(LINES), 4))
    sigma = reading_sigma(spec) * spec.errors.switched_on
    return FrozenMap({name: drift[name] + sigma * row for name, row in zip(LINES, noise, strict=True)})


def reading_sigma(spec: OrbitCalibrationSpec) -> np.ndarray:
    """Return the (4,) standard deviations of the monitor's readings of a camera's change.

    The elements belong to three rotations, in radians, and the principal distance, in metres. The test must have a
    monitor.
    """
    assert spec.monitor is not None
    return np.array([*spec.monitor.angles, spec.monitor.principal_distance])


_LEAST_IMAGE = 0.02
"""Sigma assumed for image points that are simulated without errors, in pixels: an adjustment needs weights."""
_SPARE = 1.25
"""Number of candidates drawn per required ground point; those that a line does not see are dropped."""
_PICTURES = 5
"""Number of the random stream of a field's seed for its images, separate from the draws of fields without images."""
_TIES = 8
"""Number of the random stream of a field's seed for the tie points of its strip; `_DRIFT` and `_READING` are the two
numbers before it.
"""
_MARGIN = 6.0
"""Smallest distance of a point from the edge of an image, in sigmas, so that its measured position cannot lie outside.
"""


def fly_fields(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance = silent) -> Campaign:
    """Simulate one pass over every field; image points are drawn or, where the file has a section `images`, measured.

    Raises
    ------
    BenchError
        No such orbit exists, or the lines do not all see enough points.
    CalibrationError
        The measured points cannot be used.
    """
    spec, payload = setup.test, setup.camera
    changed = changed_payload(spec, payload)
    earth = Earth.from_spec(spec.earth)
    imager = Imager.of(setup, stream(seed, len(spec.fields)), advance) if spec.images is not None else None
    flown = [
        _pass(name, field, spec, payload, changed, earth, field_seed, imager)
        for (name, field), field_seed in zip(spec.fields.items(), seed.spawn(len(spec.fields)), strict=True)
    ]
    measured, readings, pictures, truths = zip(*flown, strict=True)
    campaign = campaign_of(spec, payload, measured, spec.images is None)
    passes = tuple(
        replace(flight, known_truth=truth, readings=reading)
        for flight, truth, reading in zip(campaign.passes, truths, readings, strict=True)
    )
    images = tuple(images for images in pictures if images is not None)
    truth = FrozenMap({k: line_model(changed, k) for k in LINES})
    return replace(campaign, passes=passes, images=images or None, known_truth=truth)


def true_bias(spec: OrbitCalibrationSpec, latitude: np.ndarray) -> np.ndarray:
    """Return the true attitude bias (roll, pitch, yaw) at n latitudes, (n, 3), in radians, without season.

    The bias is the rotation from measured to true attitude; its random seasonal part is not included.
    """
    tracker = spec.errors.star_tracker
    drift = np.array(tracker.thermal.amplitude) * spec.errors.switched_on
    rotation = np.array(tracker.bias) + np.sin(latitude - tracker.thermal.reference)[:, None] * drift
    return np.asarray(Rotation.from_rotvec(rotation).inv().as_euler("XYZ"))


def _pass(
    name: str,
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    payload: ThreeLineCameraSpec,
    changed: ThreeLineCameraSpec,
    earth: Earth,
    seed: np.random.SeedSequence,
    imager: Imager | None,
) -> tuple[PassMeasurements, Mapping[str, np.ndarray], FieldImages | None, PassTruth]:
    """Simulate a pass: its measurements, the monitor's readings, the points measured in images, and the truth."""
    pictures, drift = stream(seed, _PICTURES), _sample_drift(spec, seed)
    readings = _sample_readings(spec, drift, seed)
    cameras = line_cameras(drifted_payload(changed, drift))
    rng_position, rng_image, rng_ground, rng_season, rng_data = (np.random.default_rng(s) for s in seed.spawn(5))
    trajectory = _trajectory(name, field, spec, earth, seed)
    errors = spec.errors
    rotation = np.array(errors.star_tracker.bias) + np.array(errors.season) * rng_season.standard_normal(3)
    tracker = errors.star_tracker.model_copy(update={"bias": tuple(rotation.tolist())})
    terms = TERMS if errors.switched_on else ("attitude_bias",)
    measured = trajectory.with_errors(
        errors.model_copy(update={"star_tracker": tracker}), int(rng_data.integers(2**31)), terms
    )
    platform = PlatformTable.sampled(measured, errors.gps.interval, errors.star_tracker.interval)
    effects = LightEffects.of(spec.effects)
    lines = max(int((trajectory.last - trajectory.first) / spec.line_time) - 1, 1)
    times = LineTimes.even(trajectory.first + 0.5 * spec.line_time, spec.line_time, lines)
    sensors = {k: Sensor.of_lines(cameras[k], trajectory, earth, times, effects) for k in LINES}
    path, at = TabulatedTrajectory(platform), dict.fromkeys(LINES, times)
    pass_info = pass_data(name, payload, path, at, field.height)
    images = None
    if imager is None:
        assert spec.points is not None
        points = _simulated_points(field, spec, spec.points, sensors, pass_info, (rng_position, rng_image, rng_ground))
    else:
        points, images = imager.measured(field, sensors, pass_info, effects, pictures)
    ties: Mapping[str, ImagePoints] = {}
    if spec.strip is not None and spec.points is not None:
        tie_points = spec.points.model_copy(
            update={"control": 0, "check": spec.strip.ties, "length": spec.strip.length}
        )
        tie_seed = stream(seed, _TIES)
        a, b, c = (np.random.default_rng(s) for s in tie_seed.spawn(3))
        try:
            ties = _simulated_points(field, spec, tie_points, sensors, pass_info, (a, b, c)).check_images
        except BenchError as error:
            remedy = "a shorter strip, or a longer pass (`span`)"
            raise BenchError(f"tie points: {error}", ("strip", "length"), remedy) from error
    attitude_errors = measured.errors
    assert attitude_errors is not None
    middle = float(earth.geodetic(trajectory.position(0.0))[1])
    shape = np.sin(middle - attitude_errors.reference)
    to_true = rotation_matrix(attitude_errors.bias + shape * attitude_errors.thermal).T
    truth = PassTruth(
        Rotation.from_matrix(to_true).as_euler("XYZ"),
        -attitude_errors.position(np.array(0.0)),
        trajectory,
        attitude_errors,
        drift,
    )
    datum = errors.datum if errors.switched_on else (0.0, 0.0, 0.0)
    measured_pass = _measurements_of(name, platform, times, points, ties, datum)
    return measured_pass, readings, images, truth


def _measurements_of(
    name: str,
    platform: PlatformTable,
    times: LineTimes,
    points: FieldPoints,
    ties: Mapping[str, ImagePoints],
    datum: tuple[float, float, float],
) -> PassMeasurements:
    """Return the measurements of a simulated pass, in the form in which they are written to files.

    Parameters
    ----------
    name : str
        Name of the pass.
    platform : PlatformTable
        Readings of orbit and attitude.
    times : LineTimes
        Exposure times, the same for every line.
    points : FieldPoints
        Control, tie and check points.
    ties : Mapping[str, ImagePoints]
        Line -> image points of further tie points, numbered from 0.
    datum : tuple of float
        Error of the control points' datum east, north and up, in metres.
    """
    coordinates, is_control = points.control_ground, points.control
    if any(datum):
        lon, lat, _ = Earth().geodetic(coordinates.mean(axis=0))
        coordinates = coordinates + np.array(datum) @ east_north_up(lon, lat)
    count, checks = len(coordinates), len(points.check_ground)
    more = 1 + max((int(r.point.max()) for r in ties.values() if len(r.point)), default=-1)
    control_ground = np.where(is_control[:, None], coordinates, np.nan)
    itrs = np.concatenate([control_ground, points.check_ground, np.full((more, 3), np.nan)])
    role = np.array(["control" if c else "tie" for c in is_control] + ["check"] * checks + ["tie"] * more, object)
    covariance = np.zeros((len(role), 3, 3))
    covariance[:count][is_control] = level_covariance(coordinates[is_control], *points.sigma)
    images = {}
    for line, row in points.control_images.items():
        parts = [row, points.check_images[line].numbered(-count)]
        parts += [ties[line].numbered(-count - checks)] if line in ties else []
        images[line] = ImagePoints.joined(parts)
    ground = GroundPoints.of(point_names(role), itrs, covariance, role)
    return PassMeasurements(name, platform, FrozenMap(dict.fromkeys(LINES, times)), ground, FrozenMap(images))


def _simulated_points(
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    wanted: PointsSpec,
    sensors: Mapping[str, Sensor],
    data: PassData,
    random: tuple[np.random.Generator, np.random.Generator, np.random.Generator],
) -> FieldPoints:
    """Draw ground points, their image points and the control coordinates, from three random streams."""
    random_positions, image, ground = random
    points, seen = _points(data.name, field, spec, wanted, sensors, random_positions)
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
    coordinates = points[:count] + control * ground.standard_normal((count, 3))
    control_images = {k: row.taken(np.arange(count)) for k, row in images.items()}
    check_images = {k: row.taken(np.arange(count, len(points))).numbered(count) for k, row in images.items()}
    is_control = np.ones(count, bool)
    return FieldPoints(control_images, coordinates, is_control, (control, control), check_images, points[count:])


def _trajectory(
    name: str, field: FieldSpec, spec: OrbitCalibrationSpec, earth: Earth, seed: np.random.SeedSequence
) -> Trajectory:
    """Return the true orbit, which passes over the field's middle at its epoch, and the true attitude."""
    orbit = passing_orbit(field.epoch, spec.span, spec.altitude, field.longitude, field.latitude)
    try:
        return Trajectory.flown(propagate(orbit, earth), spec.attitude, seed)
    except ValueError as error:
        remedy = "a field that a sun-synchronous orbit passes"
        raise BenchError(str(error), ("fields", name), remedy) from error


def _points(
    name: str,
    field: FieldSpec,
    spec: OrbitCalibrationSpec,
    counts: PointsSpec,
    sensors: Mapping[str, Sensor],
    random: np.random.Generator,
) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Draw n ground points (n, 3), control points first; return them with image lines and pixels (n,) by line."""
    wanted, nadir = counts.control + counts.check, sensors["nadir"]
    height = field.height + field.relief * random.uniform(-1.0, 1.0, int(np.ceil(_SPARE * wanted)))
    pixel = random.uniform(counts.first, counts.last, len(height))
    trajectory = nadir.trajectory
    assert isinstance(trajectory, Trajectory)
    above = float(nadir.earth.geodetic(trajectory.position(0.0))[2])
    radius = float(np.linalg.norm(trajectory.position(0.0)))
    speed = float(np.linalg.norm(trajectory.velocity(0.0))) * (1.0 - above / radius)
    half_time = 0.5 * counts.length / speed
    if half_time > 0.99 * spec.span:  # the image is a line shorter than the orbit
        raise BenchError("the pass is shorter than the field", ("span",), f"more than {half_time:.3g} s")
    line = (random.uniform(-half_time, half_time, len(height)) - nadir.first_line_time) / spec.line_time
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
        problem = f"over {name} only {len(good)} of {len(height)} candidate points are seen by all three lines"
        raise BenchError(problem, key, "a longer pass, and a field inside all three strips")
    return points[good], {k: (line[good], at[good]) for k, (line, at) in seen.items()}
