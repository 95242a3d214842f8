"""Passes over fields of points as an analysis has them, whoever flew them: a satellite, or the simulation.

Each pass is what was measured (`twin.orbit.measured.pass_measurements`): readings of orbit and attitude, line times,
ground and image points. The camera is that of the laboratory, and the effects on the light are taken out of the image
points by it (`twin.orbit.calibration.observations`). The truth is there where a simulation knows it, for comparisons
alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.orbit.calibration_parameters import CalibrationField, Noise
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import INTERIOR, LineModel, Rays
from optics.geometry.pose import about_axis, rotation_matrix
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from twin.orbit.calibration.observations import PassData, image_sigma, light_effects
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import line_cameras
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import MeasurementErrors, Trajectory
from twin.orbit.measured.pass_measurements import ImagePoints, PassMeasurements

if TYPE_CHECKING:
    from scenes.specs.measured.orbit_data import MeasuredCalibrationSpec, ReadingErrorsSpec
    from scenes.specs.orbit.calibration import OrbitCalibrationSpec
    from scenes.specs.orbit.flight import ErrorsSpec
    from twin.orbit.calibration.field_images import FieldImages


@dataclass(frozen=True, eq=False)
class PassTruth:
    """What a simulation knows of a pass.

    Attributes:
        bias: (3,) true roll, pitch, yaw at the field's middle, radians: from measured to true attitude.
        offset: (3,) true minus measured station at the field's middle, along X, Y, Z of the orbital frame, metres.
        trajectory: the true one.
        errors: of the readings.
        drift: line -> (4,) true d_alpha, d_beta, d_gamma, d_f of its camera, radians and metres; empty for no drift.
    """

    bias: np.ndarray
    offset: np.ndarray
    trajectory: Trajectory
    errors: MeasurementErrors
    drift: Mapping[str, np.ndarray] = FrozenMap({})

    def bias_at(self, time: float) -> np.ndarray:
        """(3,) true roll, pitch, yaw at a time, seconds from the field's middle, radians, without slow errors."""
        latitude = self.trajectory.orbit.earth.geodetic(self.trajectory.position(time))[1]
        turn = (
            self.errors.bias + np.sin(latitude - self.errors.reference) * self.errors.thermal + time * self.errors.rate
        )
        return np.asarray(Rotation.from_rotvec(turn).inv().as_euler("XYZ"))


@dataclass(frozen=True, eq=False)
class FieldPass:
    """One pass over one field.

    Attributes:
        measurements: as they came.
        data: what is known of the pass beside its points.
        latitude: mean of the control points, radians.
        control_images: line -> image points of control points, and of tie points that calibrate with them.
        control_ground: (n, 3) their given coordinates, of ties those of a first intersection, ITRS, metres.
        control_covariance: (n, 3, 3) of given coordinates, m^2.
        is_control: (n,) which of them are control.
        control_ids: (n,) names.
        check_images: line -> image points of the check points.
        check_ground: (m, 3) given coordinates of the check points, ITRS, metres.
        check_ids: (m,) names.
        tie_images: line -> image points of tie points that are kept apart for the strip; empty for none.
        control: what the calibration gets.
        check: line -> rays of the check points.
        ties: line -> rays of the ties apart.
        readings: line -> (4,) what a monitor reads of its camera; empty for no monitor.
        known_truth: of a simulated pass.
    """

    measurements: PassMeasurements
    data: PassData
    latitude: float
    control_images: Mapping[str, ImagePoints]
    control_ground: np.ndarray
    control_covariance: np.ndarray
    is_control: np.ndarray
    control_ids: np.ndarray
    check_images: Mapping[str, ImagePoints]
    check_ground: np.ndarray
    check_ids: np.ndarray
    tie_images: Mapping[str, ImagePoints]
    control: CalibrationField
    check: Mapping[str, Rays]
    ties: Mapping[str, Rays]
    readings: Mapping[str, np.ndarray] = FrozenMap({})
    known_truth: PassTruth | None = None

    @property
    def name(self) -> str:
        """Name of the field."""
        return self.measurements.name

    @property
    def measured(self) -> TabulatedTrajectory:
        """Orbit and attitude by their readings."""
        return TabulatedTrajectory(self.measurements.platform)

    @property
    def truth(self) -> PassTruth:
        """What a simulation knows of the pass. AssertionError for a measured one."""
        assert self.known_truth is not None, "nobody knows the truth of a measured pass"
        return self.known_truth

    @property
    def bias(self) -> np.ndarray:
        """True bias; see `PassTruth`."""
        return self.truth.bias

    @property
    def trajectory(self) -> Trajectory:
        """The true one."""
        return self.truth.trajectory

    @property
    def tie_count(self) -> int:
        """Number of tie points: those that calibrate, and those that are kept apart for the strip."""
        apart = {int(number) for row in self.tie_images.values() for number in row.point}
        return int((~self.is_control).sum()) + len(apart)

    @property
    def middle(self) -> float:
        """Mean time at which control points were seen, seconds of the trajectory; where that lies in a gap of the
        readings, the time of the point nearest to it.
        """
        sensors = self.data.sensors
        times = np.concatenate([sensors[k].time(r.line) for k, r in self.control_images.items()])
        mean = np.mean(times)
        return float(mean if self.measured.known(mean) else times[np.argmin(np.abs(times - mean))])

    @property
    def seconds_apart(self) -> float:
        """From when the first line sees the control points, in the mean, to when the last does."""
        times = [
            float(np.mean(self.data.sensors[k].time(r.line))) for k, r in self.control_images.items() if len(r.line)
        ]
        return max(times) - min(times)

    @property
    def altitude(self) -> float:
        """Height of the satellite above the ellipsoid in the middle of the pass, metres."""
        path = self.measured
        return float(self.data.earth.geodetic(path.position(self.middle))[2])

    def shifted(self, datum: tuple[float, float, float]) -> FieldPass:
        """The pass with control points given farther east, north and up, metres; rays stay as they are."""
        lon, lat, _ = self.data.earth.geodetic(self.control_ground.mean(axis=0))
        ground = self.control_ground + np.array(datum) @ east_north_up(lon, lat)
        return replace(self, control_ground=ground, control=replace(self.control, ground=ground))

    def later(self, seconds: float) -> FieldPass:
        """The pass with rays of the station and attitude so many seconds later; image points stay as they are.

        Where readings end before that, what lies beyond them is what lies before the exposure, reversed.
        """
        path = self.measured

        def moved(rays: Mapping[str, Rays]) -> FrozenMap[str, Rays]:
            found = {}
            for name, row in rays.items():
                assert row.time is not None
                time = row.time + self.data.phase
                beyond = ~path.known(time + seconds)
                there = time + np.where(beyond, -seconds, seconds)
                station, attitude = path.position(there), path.body_to_itrs(there)
                if np.any(beyond):  # the motion goes on as it came
                    here = path.body_to_itrs(time[beyond])
                    station[beyond] = 2.0 * path.position(time[beyond]) - station[beyond]
                    attitude[beyond] = here @ np.swapaxes(attitude[beyond], 1, 2) @ here
                found[name] = replace(row, station=station, attitude=attitude)
            return FrozenMap(found)

        control = replace(self.control, rays=moved(self.control.rays))
        return replace(self, control=control, check=moved(self.check), ties=moved(self.ties))


@dataclass(frozen=True, eq=False)
class Campaign:
    """All passes, and the camera as the laboratory knows it.

    Attributes:
        spec: the test.
        laboratory: line -> camera as it was measured before launch; what the analysis starts from.
        noise: what the analysis is told of the independent errors.
        passes: in the file's order.
        images: what became of points measured in simulated images, by field; None otherwise.
        known_truth: line -> camera as it is, without the drift of single fields; None where nobody knows.
        rejected: field -> what the adjustment has left out; empty where nothing was looked for.
        drifts: what residuals showed of a drift of the attitude that nobody stated; None where they show none.
    """

    spec: OrbitCalibrationSpec | MeasuredCalibrationSpec
    laboratory: Mapping[str, LineModel]
    noise: Noise
    passes: tuple[FieldPass, ...]
    images: tuple[FieldImages, ...] | None = None
    known_truth: Mapping[str, LineModel] | None = None
    rejected: Mapping[str, Rejected] = FrozenMap({})
    drifts: FoundDrift | None = None

    @property
    def truth(self) -> Mapping[str, LineModel]:
        """Line -> camera as it is. AssertionError where nobody knows."""
        assert self.known_truth is not None, "nobody knows the truth of a measured campaign"
        return self.known_truth

    @property
    def simulated(self) -> OrbitCalibrationSpec:
        """The test of a simulation. AssertionError for measurements."""
        from scenes.specs.orbit.calibration import OrbitCalibrationSpec

        assert isinstance(self.spec, OrbitCalibrationSpec), "this campaign was measured"
        return self.spec

    @property
    def lines(self) -> tuple[str, ...]:
        """Line cameras, in the payload's order."""
        return tuple(self.laboratory)

    @property
    def inner(self) -> tuple[str, ...]:
        """Names of the interior's unknowns."""
        return interior_names(self.lines)

    @property
    def reference(self) -> str:
        """The line whose principal point is the gauge: the nadir line, or that which looks down most steeply."""
        if "nadir" in self.laboratory:
            return "nadir"
        return max(self.lines, key=lambda name: float(self.laboratory[name].to_body[2, 2]))

    @property
    def effects(self) -> LightEffects:
        """On the light."""
        return light_effects(self.spec.effects)

    @property
    def independent(self) -> Campaign:
        """The campaign in which each exposure has noise of attitude and orbit of its own.

        Estimates are hardly worse and ten times faster; their sigmas are too small where points are exposed within a
        few readings.
        """
        own = replace(self.noise, attitude_interval=None, station_interval=None, slow_interval=None)
        return replace(self, noise=own)

    def without_effects(self, removed: LightEffects) -> Campaign:
        """The campaign with these effects on the light taken out of its image points.

        Raises:
            CalibrationError: control coordinates that cannot be used, or check points that cannot be intersected.
        """
        passes = tuple(
            replace(
                p,
                control=p.data.control_field(
                    p.control_images, p.control_ground, p.control_covariance, removed, p.is_control
                ),
                check=FrozenMap(p.data.check_rays(p.check_images, removed, self.noise) if p.check_images else {}),
                ties=FrozenMap(p.data.check_rays(p.tie_images, removed, self.noise) if p.tie_images else {}),
            )
            for p in self.passes
        )
        return replace(self, passes=passes)

    def later(self, seconds: float) -> Campaign:
        """All lines exposed so many seconds later than they were."""
        return replace(self, passes=tuple(p.later(seconds) for p in self.passes))

    def shifted(self, datum: tuple[float, float, float]) -> Campaign:
        """All control points given farther east, north and up, metres."""
        return replace(self, passes=tuple(p.shifted(datum) for p in self.passes))


@dataclass(frozen=True)
class FoundDrift:
    """A drift of the attitude during the passes that nobody stated and residuals show.

    Attributes:
        rate: standard deviation of the rates about body X, Y, Z that is assumed since, radians per second.
        walk: likewise of a random walk, what it gains in a second, radians.
        rate_p_value, course_p_value: chance of such residuals without rates, and without errors that change slowly.
    """

    rate: tuple[float, float, float]
    walk: float
    rate_p_value: float
    course_p_value: float


@dataclass(frozen=True, eq=False)
class Rejected:
    """What the adjustment has left out of a pass.

    Attributes:
        entered, left: image points of control and tie points before and after.
        points: names of control and tie points with a rejected image point, and its line camera.
        check_entered, check_left: check points before and after the test of their intersection.
        check_points: names of those that were left out.
        factors: line -> on the sigmas of its image points, by the residuals of those that remain; 1 where they are
            right.
    """

    entered: int
    left: int
    points: tuple[tuple[str, str], ...]
    check_entered: int
    check_left: int
    check_points: tuple[str, ...]
    factors: Mapping[str, float]

    def after(self, first: Rejected) -> Rejected:
        """Return what was left out in two rounds, the first of which had factors of 1."""
        points, checks = first.points + self.points, first.check_points + self.check_points
        return Rejected(first.entered, self.left, points, first.check_entered, self.check_left, checks, self.factors)


def interior_names(lines: Sequence[str]) -> tuple[str, ...]:
    """Names of the unknowns f, x, y of these line cameras."""
    return tuple(f"{line} {name}" for line in lines for name in INTERIOR)


def line_model(payload: ThreeLineCameraSpec, name: str) -> LineModel:
    """A line of the payload as the analysis models it."""
    line = payload.lines[name]
    to_body = about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate))
    half = 0.5 * payload.pixels_of(name) * payload.pitch_of(name)
    return LineModel.of(
        to_body, (line.principal_distance, *line.principal_point), line.position, line.k1, line.k2, half
    )


def campaign_of(
    spec: OrbitCalibrationSpec | MeasuredCalibrationSpec,
    payload: ThreeLineCameraSpec,
    measured: Sequence[PassMeasurements],
    ties_apart: bool,
) -> Campaign:
    """The campaign of measured passes, with the effects on the light taken out where the test says so.

    Args:
        spec: the test.
        payload: as the laboratory knows it.
        measured: the passes.
        ties_apart: whether tie points are kept for the strip, and do not calibrate.

    Raises:
        CalibrationError: points that cannot be used.
    """
    seen = {name for one in measured for name in one.images}
    laboratory = FrozenMap({name: line_model(payload, name) for name in payload.lines if name in seen})
    passes = [_field_pass(one, payload, laboratory, ties_apart) for one in measured]
    unit = image_sigma(passes[0].control_images, passes[0].data)
    noise = _noise_of(spec.errors, unit, [one.measured for one in passes])
    weighed = tuple(replace(p, data=replace(p.data, unit=unit)) for p in passes)
    campaign = Campaign(spec, laboratory, noise, tuple(_with_ties(p, noise) for p in weighed))
    return campaign.without_effects(campaign.effects if spec.effects.corrected else NO_EFFECTS)


def _noise_of(errors: ErrorsSpec | ReadingErrorsSpec, image: float, paths: Sequence[TabulatedTrajectory] = ()) -> Noise:
    """Sigmas of readings as given, root mean square over axes, and their intervals.

    Args:
        errors: of the readings.
        image: unit of the image points, metres.
        paths: their tables, for intervals that are not given.
    """
    if not getattr(errors, "switched_on", True):
        return Noise(image)
    tracker, gps = errors.star_tracker, errors.gps
    attitude, station, slow = (
        float(np.sqrt(np.mean(np.square(v)))) for v in (tracker.noise, gps.noise, tracker.slow.noise)
    )
    between = (
        tracker.interval or float(np.median([p.attitude_interval for p in paths])),
        gps.interval or float(np.median([p.orbit_interval for p in paths])),
    )
    walk = float(np.sqrt(np.mean(np.square(tracker.walk))))
    return Noise(image, attitude, station, *between, slow, tracker.slow.interval, walk, between[0])


def _field_pass(
    one: PassMeasurements, payload: ThreeLineCameraSpec, models: Mapping[str, LineModel], ties_apart: bool
) -> FieldPass:
    """Sort the points of a pass; rays are made later, when the effects on the light are taken out."""
    earth, cameras, path = Earth(), line_cameras(payload), TabulatedTrajectory(one.platform)
    sensors = {
        name: Sensor.of_lines(cameras[name], path, earth, one.line_times[name], NO_EFFECTS) for name in one.images
    }
    role = one.ground.role
    rays = np.zeros(len(role), int)
    for row in one.images.values():
        np.add.at(rays, row.point, 1)
    known = (role == "control") & (rays > 0)
    _, latitude, height = earth.geodetic(one.ground.itrs[known])
    pitch = {name: payload.pitch_of(name) for name in one.images}
    own = FrozenMap({name: models[name] for name in one.images})
    data = PassData(one.name, FrozenMap(sensors), own, FrozenMap(pitch), float(np.mean(height)), lines=payload.lines)
    check = (role == "check") & (rays > 1)
    tie = (role == "tie") & (rays > 1)
    # control points first, ties after them
    calibrating = np.concatenate([np.flatnonzero(known), np.flatnonzero(tie & (not ties_apart))])
    where = one.ground.taken(calibrating)
    checks = np.flatnonzero(check)
    empty = CalibrationField(one.name, {}, where.itrs, where.covariance, where.role == "control")
    return FieldPass(
        measurements=one,
        data=data,
        latitude=float(np.mean(latitude)),
        control_images=_numbered(one.images, calibrating, len(role)),
        control_ground=where.itrs,
        control_covariance=where.covariance,
        is_control=where.role == "control",
        control_ids=where.ids,
        check_images=_numbered(one.images, checks, len(role)) if len(checks) else FrozenMap({}),
        check_ground=one.ground.itrs[checks],
        check_ids=one.ground.ids[checks],
        tie_images=_numbered(one.images, np.flatnonzero(tie), len(role))
        if ties_apart and np.any(tie)
        else FrozenMap({}),
        control=empty,
        check=FrozenMap({}),
        ties=FrozenMap({}),
    )


def _numbered(images: Mapping[str, ImagePoints], chosen: np.ndarray, count: int) -> FrozenMap[str, ImagePoints]:
    """Line -> image points of the chosen ground points, which are counted anew from 0."""
    number = np.full(count, -1)
    number[chosen] = np.arange(len(chosen))
    found = {}
    for name, row in images.items():
        some = row.taken(number[row.point] >= 0)
        found[name] = replace(some, point=number[some.point])
    return FrozenMap(found)


def _with_ties(one: FieldPass, noise: Noise) -> FieldPass:
    """First coordinates of the tie points, by the laboratory's camera."""
    tie = ~one.is_control
    if not np.any(tie):
        return one
    rays = one.data.rays(one.control_images)
    found = intersect(rays, one.data.models, noise, count=len(tie)).ground
    return replace(one, control_ground=np.where(tie[:, None], found, one.control_ground))
