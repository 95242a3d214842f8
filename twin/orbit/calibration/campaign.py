"""Passes over test fields with the measurements that an analysis has, simulated or real.

Each pass holds what was measured (`twin.orbit.measured.pass_measurements`): readings of orbit and attitude, line times,
ground and image points. The camera is that of the laboratory. The truth is present only where a simulation knows it,
for comparisons.

The image points are corrected for the effects on the light (light time, aberration, refraction). The adjustment's rays
are straight lines in Earth-fixed axes: the look of a pixel is the direction from which the light seems to come, and the
straight line from the measured station to the ground point that this look really sees is the direction in which the
point lies. The image point is moved from the one to the other. Camera and trajectory are those that the analysis has,
the laboratory's and the measured one: a camera error of 100 m on the ground, 2e-4 rad, changes an aberration of 4
pixels by a thousandth of a pixel. Image points may be drawn or measured in images; the code does not distinguish them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.orbit.calibration_parameters import CalibrationField, Noise
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import INTERIOR, LineModel, Rays
from optics.geometry.pose import about_axis, rotation_matrix
from optics.numerics.array_math import UnphysicalError
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.flight import OrbitSpec, PassingSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import LineTimes, line_cameras, pixel_positions
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import NO_EFFECTS, LightEffects, Platform, Sensor
from twin.orbit.flight.trajectory import MeasurementErrors, Trajectory
from twin.orbit.measured.pass_measurements import ImagePoints, PassMeasurements

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import OrbitCalibrationSpec
    from scenes.specs.orbit.flight import ErrorsSpec
    from scenes.specs.orbit.measurements import MeasuredCalibrationSpec, ReadingErrorsSpec
    from scenes.specs.orbit.three_line_camera import LineCameraSpec
    from twin.orbit.images.image_points import PatchPoints
    from twin.orbit.images.patch import LineComparison, Patch

_DISTORTION_STEPS = 8
"""Number of fixed-point steps that invert the lens distortion; each reduces the error by a factor of the relative
distortion, 1e-3 or less.
"""


def light_shift(
    sensor: Sensor, model: LineModel, line: np.ndarray, pixel: np.ndarray, height: np.ndarray
) -> np.ndarray:
    """Return the displacements that correct measured image points for the effects on the light.

    Parameters
    ----------
    sensor : Sensor
        Line camera as the laboratory measured it, on the measured trajectory, with the effects to correct.
    model : LineModel
        The same line as the adjustment models it.
    line : (n,) ndarray for n points
        Image lines of the points.
    pixel : (n,) ndarray
        Pixels of the points.
    height : (n,) ndarray
        Height of the imaged ground above the ellipsoid, in metres.

    Returns
    -------
    (n, 2) ndarray
        Displacements x and y in the focal plane, in metres, to be added to the measured points.

    Raises
    ------
    ValueError
        A point lies outside the image, or a line of sight misses the Earth.
    """
    if not sensor.effects.names:
        return np.zeros((len(line), 2))
    ground = sensor.ground(line, pixel, height)
    if not np.all(np.isfinite(ground)):
        raise UnphysicalError("a line of sight misses the Earth")
    seconds = sensor.time(line)
    arm = ground - sensor.trajectory.position(seconds)
    geometric = np.einsum("nji,nj->ni", sensor.trajectory.body_to_itrs(seconds), arm) - model.position
    return _image_position(geometric, model) - _image_position(sensor.camera.look(pixel), model)


def _image_position(direction: np.ndarray, model: LineModel) -> np.ndarray:
    """Project n directions (n, 3) in the body frame to the focal plane, (n, 2), in metres from the principal point."""
    a, b, c = (direction @ model.to_body).T
    ideal = -model.interior[0] * np.stack([a / c, b / c], axis=-1)
    distorted = ideal
    for _ in range(_DISTORTION_STEPS):
        square = np.sum(distorted**2, axis=1, keepdims=True)
        distorted = ideal / (1.0 + square * (model.k1 + model.k2 * square))
    return np.asarray(distorted)


_SAME_PHASE = 1e-6
"""Largest offset of the readings' times from multiples of their interval, as a share of the interval, that counts as
zero, because the times are rounded.
"""
_HEIGHTS = (-500.0, 9000.0)
"""Range of heights of land above the ellipsoid, in metres, to which heights are limited here; control points outside of
it are refused by the calibration, not by this module.
"""


@dataclass(frozen=True, eq=False)
class PassData:
    """Sensors and camera models of a pass as the analysis knows them, without any truth.

    Attributes
    ----------
    name : str
        Name of the field.
    sensors : Mapping[str, Sensor]
        Line -> the laboratory's camera on the measured trajectory. The effects of these sensors are not used.
    models : Mapping[str, LineModel]
        Line -> the same camera as the adjustment models it.
    pitch : Mapping[str, float]
        Line -> pixel pitch, in metres.
    height : float
        Mean height of the ground above the ellipsoid, in metres.
    lines : Mapping[str, LineCameraSpec]
        Line -> its section of the payload's file.
    unit : float or None
        Sigma of an image point of weight 1, in metres in the focal plane. Each ray then carries the covariance of its
        image point divided by the square of this sigma; None for rays without covariances.
    """

    name: str
    sensors: Mapping[str, Sensor]
    models: Mapping[str, LineModel]
    pitch: Mapping[str, float]
    height: float
    lines: Mapping[str, LineCameraSpec]
    unit: float | None = None

    def positions(self, name: str, pixel: np.ndarray) -> np.ndarray:
        """Return the positions of n pixels of a line in its focal plane, (n, 2), in metres."""
        return pixel_positions(self.lines[name], pixel, self.sensors[name].camera.pixels, self.pitch[name])

    @property
    def phase(self) -> float:
        """Offset of the attitude readings from whole multiples of their interval, in seconds.

        Readings of the orbit can be offset by up to half their interval as well. The model of the noise that
        neighbouring exposures share neglects this: its variance is then that of another time between two readings.
        """
        path = next(iter(self.sensors.values())).trajectory
        if not isinstance(path, TabulatedTrajectory):
            return 0.0
        time, step = path.table.attitude_time, path.attitude_interval
        # the first interval of a table may differ from the others
        reading = float(time[1 + int(np.argmin(np.abs(np.diff(time[1:]) - step)))]) if len(time) > 2 else float(time[0])
        phase = reading - step * round(reading / step)
        return phase if abs(phase) > _SAME_PHASE * step else 0.0

    @property
    def earth(self) -> Earth:
        """Ellipsoid and rotation of the Earth that the sensors use."""
        return next(iter(self.sensors.values())).earth

    def pixels_per_line(self, name: str) -> float:
        """Return the displacement along the track in the focal plane per image line, at an image's middle, in px.

        It is the distance in the focal plane, at one moment, between the ground points that neighbouring lines see at
        the pass's mean height. Where lines are spaced as pixels are, it is 1 at nadir and about cos^2 of the look angle
        for a line that looks ahead.
        """
        sensor, model = self.sensors[name], self.models[name]
        middle = np.full(2, 0.5 * (sensor.lines - 1))
        pixel = np.full(2, 0.5 * (sensor.camera.pixels - 1))
        ground = sensor.ground(middle + np.array([-0.5, 0.5]), pixel, self.height)
        seconds = sensor.time(middle)
        to_body = np.swapaxes(sensor.trajectory.body_to_itrs(seconds), 1, 2)
        arm = np.einsum("nij,nj->ni", to_body, ground - sensor.trajectory.position(seconds))
        a, _, c = ((arm - model.position) @ model.to_body).T
        x = -float(model.interior[0]) * a / c
        return abs(float(x[1] - x[0])) / self.pitch[name]

    def rays(self, images: Mapping[str, ImagePoints]) -> dict[str, Rays]:
        """Return the rays of image points, by line, not corrected for the effects on the light.

        Raises
        ------
        ValueError
            A line number lies outside the image.
        """
        rays_by_line = {}
        for name, row in images.items():
            sensor = self.sensors[name]
            seconds = sensor.time(row.line)
            image = self.positions(name, row.pixel)
            station, attitude = sensor.trajectory.position(seconds), sensor.trajectory.body_to_itrs(seconds)
            # times relative to the readings, between which the model of shared noise interpolates
            rays = Rays.of(row.point, image, station, attitude, seconds - self.phase)
            spread = None if self.unit is None else self.spread(name, row) / self.unit**2
            rays_by_line[name] = replace(rays, spread=spread)
        return rays_by_line

    def spread(self, name: str, row: ImagePoints) -> np.ndarray:
        """Return the covariances of n image points in the focal plane, (n, 2, 2), in metres^2.

        An error toward a later image line is an error toward a smaller x.
        """
        scale = self.pitch[name] * np.array([-self.pixels_per_line(name), 1.0])
        return row.covariance * scale[:, None] * scale

    def control_field(
        self,
        images: Mapping[str, ImagePoints],
        ground: np.ndarray,
        covariance: float | tuple[float, float] | np.ndarray,
        removed: LightEffects,
        control: np.ndarray | None = None,
    ) -> CalibrationField:
        """Return the control points and their rays, corrected for effects on the light, as input of the calibration.

        Parameters
        ----------
        images : Mapping[str, ImagePoints]
            Line -> image points.
        ground : (m, 3) ndarray for m ground points Given coordinates, ITRS, in metres. covariance : float, tuple of
        float, or (m, 3, 3) ndarray
            Covariances of the coordinates, in m^2 (not used for tie points); or one sigma of each coordinate; or one
            sigma of each axis in plan and one of the height, in metres.
        removed : LightEffects
            Effects on the light that are corrected.
        control : (m,) ndarray of bool, optional
            True for control points, False for tie points; None if all are control points.

        Raises
        ------
        CalibrationError
            Coordinates cannot be used, such as geodetic ones.
        ValueError
            A point lies outside the image.
        """
        # the check of the coordinates comes first: refraction needs a height
        field = CalibrationField.of(self.name, self.rays(images), ground, covariance, control)
        return replace(field, rays=self.corrected(field.rays, images, removed, self._heights(ground)))

    def check_rays(self, images: Mapping[str, ImagePoints], removed: LightEffects, noise: Noise) -> dict[str, Rays]:
        """Return the rays of points without ground control, by line, corrected for effects on the light.

        Refraction depends on the height of the ground: 700 m change it by 8 %. The height is taken from a first
        intersection of the uncorrected rays with the laboratory's camera, whose error is about 100 m.

        Raises
        ------
        CalibrationError
            The rays cannot be intersected.
        ValueError
            A point lies outside the image.
        """
        rays = self.rays(images)
        return self.corrected(rays, images, removed, self._heights(intersect(rays, self.models, noise).ground))

    def corrected(
        self, rays: Mapping[str, Rays], images: Mapping[str, ImagePoints], removed: LightEffects, height: np.ndarray
    ) -> dict[str, Rays]:
        """Return the rays corrected for effects on the light, by line.

        Parameters
        ----------
        rays : Mapping[str, Rays]
            Line -> rays of the image points.
        images : Mapping[str, ImagePoints]
            Line -> image points.
        removed : LightEffects
            Effects on the light that are corrected.
        height : (m,) ndarray for m ground points
            Heights of the ground points above the ellipsoid, in metres; NaN where unknown.

        Raises
        ------
        ValueError
            A point lies outside the image.
        """
        clipped = np.clip(np.where(np.isfinite(height), height, self.height), *_HEIGHTS)
        corrected = {}
        for name, row in images.items():
            sensor = replace(self.sensors[name], effects=removed)
            shift = light_shift(sensor, self.models[name], row.line, row.pixel, clipped[row.point])
            corrected[name] = replace(rays[name], image=rays[name].image + shift)
        return corrected

    def _heights(self, ground: np.ndarray) -> np.ndarray:
        heights = np.full(len(ground), np.nan)
        good = np.all(np.isfinite(ground), axis=1)
        heights[good] = self.earth.geodetic(ground[good])[2]
        return heights


@dataclass(frozen=True, eq=False)
class FieldPoints:
    """Simulated measurements of a field's points.

    Attributes
    ----------
    control_images : Mapping[str, ImagePoints]
        Line -> image points of the control points, followed by those of the tie points.
    control_ground : (n, 3) ndarray for n points
        Given coordinates of control points and first guesses of tie points, ITRS, in metres.
    control : (n,) ndarray of bool
        True for control points.
    sigma : tuple of float
        Standard deviations of the given coordinates, of each axis in plan and of the height, in metres.
    check_images : Mapping[str, ImagePoints]
        Line -> image points of the check points.
    check_ground : (m, 3) ndarray for m check points
        True coordinates of the check points, ITRS, in metres.
    """

    control_images: Mapping[str, ImagePoints]
    control_ground: np.ndarray
    control: np.ndarray
    sigma: tuple[float, float]
    check_images: Mapping[str, ImagePoints]
    check_ground: np.ndarray


def image_sigma(images: Mapping[str, ImagePoints], data: PassData) -> float:
    """Return the root mean square standard deviation of all image points, of x and y in the focal plane, in metres."""
    variances = [np.diagonal(data.spread(name, row), axis1=1, axis2=2) for name, row in images.items()]
    return float(np.sqrt(np.mean(np.concatenate(variances))))


@dataclass(frozen=True, eq=False)
class PassTruth:
    """Truth of a simulated pass.

    Attributes
    ----------
    bias : (3,) ndarray
        True roll, pitch and yaw at the field's middle, in radians, from measured to true attitude.
    offset : (3,) ndarray
        True minus measured station at the field's middle, along X, Y, Z of the orbital frame, in metres.
    trajectory : Trajectory
        True orbit and attitude.
    errors : MeasurementErrors
        Errors of the readings.
    drift : Mapping[str, ndarray]
        Line -> (4,) true changes of its camera: rotations d_alpha, d_beta, d_gamma about the camera's Y, X and line of
        sight, in radians, and change d_f of the principal distance, in metres; empty without drift.
    """

    bias: np.ndarray
    offset: np.ndarray
    trajectory: Trajectory
    errors: MeasurementErrors
    drift: Mapping[str, np.ndarray] = FrozenMap({})

    def bias_at(self, time: float) -> np.ndarray:
        """Return the true attitude bias (roll, pitch, yaw) at a time, (3,), in radians.

        Errors of the readings that vary slowly with time are not part of it.

        Parameters
        ----------
        time : float
            Seconds from the field's middle.
        """
        latitude = self.trajectory.orbit.earth.geodetic(self.trajectory.position(time))[1]
        e = self.errors
        rotation = e.bias + np.sin(latitude - e.reference) * e.thermal + time * e.rate
        return np.asarray(Rotation.from_rotvec(rotation).inv().as_euler("XYZ"))


@dataclass(frozen=True, eq=False)
class PatchRecord:
    """Measured points of one patch, and their matching errors against the truth.

    Attributes
    ----------
    points : PatchPoints
        Measured points.
    judgements : Mapping[str, Mapping[str, LineJudgement]]
        ``control`` (with the check points) or ``tie`` -> line -> comparison with the truth.
    """

    points: PatchPoints
    judgements: Mapping[str, Mapping[str, LineComparison]]


@dataclass(frozen=True, eq=False)
class FieldImages:
    """Image measurements of a field's points, with the matches that the truth shows to be wrong.

    Attributes
    ----------
    name : str
        Name of the field.
    patches : tuple of PatchRecord
        Patches in the file's order.
    shown : Patch
        First patch itself, for a figure.
    wrong : Mapping[str, ndarray]
        Line -> (n,) bool for n points, True where the position of a control or tie point is wrong, by number of the
        point.
    wrong_check : Mapping[str, ndarray]
        Line -> (m,) bool for m check points, True where the position of a check point is wrong.
    screening : Screening or None
        Points that the adjustment rejected; None before the adjustment.
    """

    name: str
    patches: tuple[PatchRecord, ...]
    shown: Patch
    wrong: Mapping[str, np.ndarray]
    wrong_check: Mapping[str, np.ndarray]
    screening: Screening | None = None


@dataclass(frozen=True)
class Screening:
    """Counts of a field's points before and after screening; wrong and right are known from the truth.

    Attributes
    ----------
    entered, left : int
        Image points of control and tie points before and after screening.
    wrong_entered, wrong_left : int
        Wrong image points among them.
    right_lost : int
        Right image points that were rejected.
    check_entered, check_left : int
        Check points before and after the test of their intersection.
    wrong_check_left : int
        Check points that passed the test although their position in a line is wrong.
    """

    entered: int
    left: int
    wrong_entered: int
    wrong_left: int
    right_lost: int
    check_entered: int
    check_left: int
    wrong_check_left: int


@dataclass(frozen=True, eq=False)
class FieldPass:
    """Pass over one field: measurements, points, rays, and the truth where it is known.

    Attributes
    ----------
    measurements : PassMeasurements
        Measurements as they were read or simulated.
    data : PassData
        Sensors and camera models of the pass.
    latitude : float
        Mean latitude of the control points, in radians.
    control_images : Mapping[str, ImagePoints]
        Line -> image points of control points, and of tie points that are used in the calibration.
    control_ground : (n, 3) ndarray for n points
        Given coordinates of control points and, for tie points, those of a first intersection; ITRS, in metres.
    control_covariance : (n, 3, 3) ndarray
        Covariances of the given coordinates, in m^2.
    is_control : (n,) ndarray of bool
        True for control points.
    control_ids : (n,) ndarray
        Names of these points.
    check_images : Mapping[str, ImagePoints]
        Line -> image points of the check points.
    check_ground : (m, 3) ndarray for m check points
        Given coordinates of the check points, ITRS, in metres.
    check_ids : (m,) ndarray
        Names of the check points.
    tie_images : Mapping[str, ImagePoints]
        Line -> image points of tie points that are reserved for the strip; empty if there are none.
    control : CalibrationField
        Control points and rays that the calibration uses.
    check : Mapping[str, Rays]
        Line -> rays of the check points.
    ties : Mapping[str, Rays]
        Line -> rays of the tie points that are reserved for the strip.
    readings : Mapping[str, ndarray]
        Line -> (4,) change of its camera that the monitor measured: rotations d_alpha, d_beta, d_gamma (radians) and
        change d_f of the principal distance (metres); empty without a monitor.
    known_truth : PassTruth or None
        Truth of a simulated pass; None for a measured one.
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
        """Orbit and attitude interpolated between their readings."""
        return TabulatedTrajectory(self.measurements.platform)

    @property
    def truth(self) -> PassTruth:
        """Simulated truth of the pass; raises AssertionError for a measured pass."""
        assert self.known_truth is not None, "the truth of a measured pass is not known"
        return self.known_truth

    @property
    def bias(self) -> np.ndarray:
        """True (3,) roll, pitch and yaw from measured to true attitude, in radians, at the middle of the field."""
        return self.truth.bias

    @property
    def trajectory(self) -> Trajectory:
        """True orbit and attitude of a simulated pass."""
        return self.truth.trajectory

    @property
    def tie_count(self) -> int:
        """Number of tie points, both those used in the calibration and those reserved for the strip."""
        apart = {int(number) for row in self.tie_images.values() for number in row.point}
        return int((~self.is_control).sum()) + len(apart)

    @property
    def middle(self) -> float:
        """Mean time at which control points were seen, in seconds of the trajectory.

        Where it lies in a gap of the readings, it is the time of the point nearest to it.
        """
        sensors = self.data.sensors
        times = np.concatenate([sensors[k].time(r.line) for k, r in self.control_images.items()])
        mean = np.mean(times)
        return float(mean if self.measured.covers(mean) else times[np.argmin(np.abs(times - mean))])

    @property
    def seconds_apart(self) -> float:
        """Mean time from when the first line sees the control points to when the last line does, in seconds."""
        sensors = self.data.sensors
        times = [float(np.mean(sensors[k].time(r.line))) for k, r in self.control_images.items() if len(r.line)]
        return max(times) - min(times)

    @property
    def altitude(self) -> float:
        """Height of the satellite above the ellipsoid in the middle of the pass, in metres."""
        path = self.measured
        return float(self.data.earth.geodetic(path.position(self.middle))[2])

    def without_effects(self, removed: LightEffects, noise: Noise) -> FieldPass:
        """Return the pass with its image points corrected for these effects on the light."""
        field = self.control_images, self.control_ground, self.control_covariance, removed, self.is_control
        check, ties = (
            FrozenMap(self.data.check_rays(images, removed, noise) if images else {})
            for images in (self.check_images, self.tie_images)
        )
        return replace(self, control=self.data.control_field(*field), check=check, ties=ties)


@dataclass(frozen=True, eq=False)
class Campaign:
    """All passes of a calibration, and the camera as the laboratory measured it.

    Attributes
    ----------
    spec : OrbitCalibrationSpec or MeasuredCalibrationSpec
        Content of the test file.
    laboratory : Mapping[str, LineModel]
        Line -> camera as it was measured before launch, from which the analysis starts.
    noise : Noise
        Independent errors that the analysis assumes.
    passes : tuple of FieldPass
        Passes in the file's order.
    images : tuple of FieldImages or None
        Points measured in simulated images, by field; None otherwise.
    known_truth : Mapping[str, LineModel] or None
        Line -> true camera, without the drift of single fields; None for measured passes.
    rejected : Mapping[str, Rejected]
        Field -> points that the screening rejected; empty where there was no screening.
    drifts : DetectedDrift or None
        Drift of the attitude that the file does not specify but the residuals show; None where they show none.
    """

    spec: OrbitCalibrationSpec | MeasuredCalibrationSpec
    laboratory: Mapping[str, LineModel]
    noise: Noise
    passes: tuple[FieldPass, ...]
    images: tuple[FieldImages, ...] | None = None
    known_truth: Mapping[str, LineModel] | None = None
    rejected: Mapping[str, Rejected] = FrozenMap({})
    drifts: DetectedDrift | None = None

    @property
    def truth(self) -> Mapping[str, LineModel]:
        """True camera of each line, by name of the line; raises AssertionError for measured passes."""
        assert self.known_truth is not None, "the truth of a measured campaign is not known"
        return self.known_truth

    @property
    def simulated(self) -> OrbitCalibrationSpec:
        """Content of the test file of a simulation; raises AssertionError for measured passes."""
        from scenes.specs.orbit.calibration import OrbitCalibrationSpec

        assert isinstance(self.spec, OrbitCalibrationSpec), "this campaign was measured"
        return self.spec

    @property
    def lines(self) -> tuple[str, ...]:
        """Names of the line cameras, in the payload's order."""
        return tuple(self.laboratory)

    @property
    def inner(self) -> tuple[str, ...]:
        """Names of the unknowns of the interior orientation: f, x and y of every line."""
        return interior_names(self.lines)

    @property
    def reference(self) -> str:
        """Line whose principal point the gauge fixes: the nadir line, or the line that looks down most steeply."""
        if "nadir" in self.laboratory:
            return "nadir"
        return max(self.lines, key=lambda name: float(self.laboratory[name].to_body[2, 2]))

    @property
    def effects(self) -> LightEffects:
        """Effects on the light (light time, aberration, refraction) that the file switches on."""
        return LightEffects.of(self.spec.effects)

    @property
    def independent(self) -> Campaign:
        """Campaign in which the noise of attitude and orbit is independent from exposure to exposure.

        Estimates from it are hardly less accurate and ten times faster to compute; their sigmas are too small where
        points are exposed within a few readings.
        """
        noise = replace(self.noise, attitude_interval=None, station_interval=None, slow_interval=None)
        return replace(self, noise=noise)

    def without_effects(self, removed: LightEffects) -> Campaign:
        """Return the campaign with its image points corrected for these effects on the light.

        Raises
        ------
        CalibrationError
            Control coordinates cannot be used, or check points cannot be intersected.
        """
        return replace(self, passes=tuple(p.without_effects(removed, self.noise) for p in self.passes))


@dataclass(frozen=True)
class DetectedDrift:
    """Attitude drift during the passes that the residuals show but the file does not specify.

    Attributes
    ----------
    rate : tuple of float
        Standard deviations of the rates about body X, Y, Z that the adjustment then assumes, in radians per second.
    walk : float
        Standard deviation of a random walk's increment in one second that the adjustment then assumes, in radians.
    rate_p_value, course_p_value : float
        p-values of the tests for a rate and for slowly varying errors (random walk), from the residuals of an
        adjustment without them.
    """

    rate: tuple[float, float, float]
    walk: float
    rate_p_value: float
    course_p_value: float


@dataclass(frozen=True, eq=False)
class Rejected:
    """Points of a pass that the screening rejected.

    Attributes
    ----------
    entered, left : int
        Image points of control and tie points before and after screening.
    points : tuple of (str, str)
        Names of control and tie points with a rejected image point, and the line camera of that image point.
    check_entered, check_left : int
        Check points before and after the test of their intersection.
    check_points : tuple of str
        Names of the rejected check points.
    factors : Mapping[str, float]
        Line -> factor on the sigmas of its image points, from the remaining residuals; 1 where the sigmas are right.
    """

    entered: int
    left: int
    points: tuple[tuple[str, str], ...]
    check_entered: int
    check_left: int
    check_points: tuple[str, ...]
    factors: Mapping[str, float]

    def after(self, first: Rejected) -> Rejected:
        """Combine the points rejected in two rounds of screening, `first` and this one.

        The factors on the sigmas are those of this round, because those of the first round are 1.
        """
        points, checks = first.points + self.points, first.check_points + self.check_points
        return Rejected(first.entered, self.left, points, first.check_entered, self.check_left, checks, self.factors)


def interior_names(lines: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the interior unknowns: principal distance f and principal point x, y of each line."""
    return tuple(f"{line} {name}" for line in lines for name in INTERIOR)


def line_model(payload: ThreeLineCameraSpec, name: str) -> LineModel:
    """Return the analysis's camera model of one line of the payload, as the laboratory measured it."""
    line = payload.lines[name]
    to_body = about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate))
    half = 0.5 * payload.pixels_of(name) * payload.pitch_of(name)
    return LineModel.of(
        to_body, (line.principal_distance, *line.principal_point), line.position, line.k1, line.k2, half
    )


def passing_orbit(
    epoch: str,
    span: float,
    altitude: float,
    longitude: float,
    latitude: float,
    direction: Literal["descending", "ascending"] = "descending",
) -> OrbitSpec:
    """Return the orbit that passes over a ground position at its epoch.

    Parameters
    ----------
    epoch : str
        Time of the passage, UTC.
    span : float
        Time for which the orbit is propagated before and after the epoch, in seconds.
    altitude : float
        Altitude of the orbit, in metres.
    longitude, latitude : float
        Ground position, in radians.
    direction : {'descending', 'ascending'}
        Direction of the pass.
    """
    passing = PassingSpec.model_construct(
        longitude=longitude, latitude=latitude, altitude=altitude, direction=direction, inclination=None
    )
    return OrbitSpec.model_construct(epoch=epoch, before=span, after=span, passing=passing, elements=None, state=None)


def pass_data(
    name: str,
    payload: ThreeLineCameraSpec,
    platform: Platform,
    times: Mapping[str, LineTimes],
    height: float,
    unit: float | None = None,
) -> PassData:
    """Return the sensors and camera models of a pass, from the laboratory's camera and the platform's readings.

    Parameters
    ----------
    name : str
        Name of the pass.
    payload : ThreeLineCameraSpec
        Camera as the laboratory measured it.
    platform : Platform
        Orbit and attitude as they were read.
    times : Mapping[str, LineTimes]
        Line camera -> exposure times of its lines.
    height : float
        Mean height of the ground above the ellipsoid, in metres.
    unit : float, optional
        Sigma of an image point of weight 1, in metres; None for points of equal weight.
    """
    cameras, earth = line_cameras(payload), Earth()
    sensors = {line: Sensor.of_lines(cameras[line], platform, earth, at, NO_EFFECTS) for line, at in times.items()}
    models = {line: line_model(payload, line) for line in times}
    pitch = {line: payload.pitch_of(line) for line in times}
    return PassData(name, FrozenMap(sensors), FrozenMap(models), FrozenMap(pitch), height, payload.lines, unit)


def campaign_of(
    spec: OrbitCalibrationSpec | MeasuredCalibrationSpec,
    payload: ThreeLineCameraSpec,
    measured: Sequence[PassMeasurements],
    ties_apart: bool,
) -> Campaign:
    """Return the campaign of measured passes, corrected for effects on the light where the test asks for it.

    Parameters
    ----------
    spec : OrbitCalibrationSpec or MeasuredCalibrationSpec
        Content of the test file.
    payload : ThreeLineCameraSpec
        Camera as the laboratory measured it.
    measured : sequence of PassMeasurements
        Measurements of the passes.
    ties_apart : bool
        True to reserve tie points for the strip, so that they are not used in the calibration.

    Raises
    ------
    CalibrationError
        Points cannot be used.
    """
    seen = {name for row in measured for name in row.images}
    laboratory = FrozenMap({name: line_model(payload, name) for name in payload.lines if name in seen})
    passes = [_field_pass(row, payload, ties_apart) for row in measured]
    unit = image_sigma(passes[0].control_images, passes[0].data)
    noise = _noise_of(spec.errors, unit, [row.measured for row in passes])
    weighed = tuple(replace(p, data=replace(p.data, unit=unit)) for p in passes)
    campaign = Campaign(spec, laboratory, noise, tuple(_with_ties(p, noise) for p in weighed))
    return campaign.without_effects(campaign.effects if spec.effects.corrected else NO_EFFECTS)


def _noise_of(errors: ErrorsSpec | ReadingErrorsSpec, image: float, paths: Sequence[TabulatedTrajectory] = ()) -> Noise:
    """Return the noise model of the readings: sigmas, as the RMS over the axes, and reading intervals.

    Parameters
    ----------
    errors : ErrorsSpec or ReadingErrorsSpec
        Sigmas of the readings in the file.
    image : float
        Sigma of an image point of weight 1, in metres.
    paths : sequence of TabulatedTrajectory
        Tables of readings, for intervals that the file does not give.
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


def _field_pass(measured: PassMeasurements, payload: ThreeLineCameraSpec, ties_apart: bool) -> FieldPass:
    role = measured.ground.role
    rays = np.zeros(len(role), int)
    for row in measured.images.values():
        np.add.at(rays, row.point, 1)
    is_control = (role == "control") & (rays > 0)
    _, latitude, height = Earth().geodetic(measured.ground.itrs[is_control])
    times = {name: measured.line_times[name] for name in measured.images}
    data = pass_data(measured.name, payload, TabulatedTrajectory(measured.platform), times, float(np.mean(height)))
    check = (role == "check") & (rays > 1)
    tie = (role == "tie") & (rays > 1)
    # control points first, followed by tie points
    calibrating = np.concatenate([np.flatnonzero(is_control), np.flatnonzero(tie & (not ties_apart))])
    where = measured.ground.taken(calibrating)
    checks = np.flatnonzero(check)
    empty = CalibrationField(measured.name, {}, where.itrs, where.covariance, where.role == "control")
    return FieldPass(
        measurements=measured,
        data=data,
        latitude=float(np.mean(latitude)),
        control_images=_numbered(measured.images, calibrating, len(role)),
        control_ground=where.itrs,
        control_covariance=where.covariance,
        is_control=where.role == "control",
        control_ids=where.ids,
        check_images=_numbered(measured.images, checks, len(role)),
        check_ground=measured.ground.itrs[checks],
        check_ids=measured.ground.ids[checks],
        tie_images=_numbered(measured.images, np.flatnonzero(tie & ties_apart), len(role)),
        control=empty,
        check=FrozenMap({}),
        ties=FrozenMap({}),
    )


def _numbered(images: Mapping[str, ImagePoints], chosen: np.ndarray, count: int) -> FrozenMap[str, ImagePoints]:
    """Return the image points of the chosen ground points by line, with the points renumbered from 0; none if empty."""
    if not len(chosen):
        return FrozenMap({})
    number = np.full(count, -1)
    number[chosen] = np.arange(len(chosen))
    images_by_line = {}
    for name, row in images.items():
        selected = row.taken(number[row.point] >= 0)
        images_by_line[name] = replace(selected, point=number[selected.point])
    return FrozenMap(images_by_line)


def _with_ties(flight: FieldPass, noise: Noise) -> FieldPass:
    """Return the pass with initial coordinates of its tie points, intersected with the laboratory's camera."""
    tie = ~flight.is_control
    if not np.any(tie):
        return flight
    rays = flight.data.rays(flight.control_images)
    ground = intersect(rays, flight.data.models, noise, count=len(tie)).ground
    return replace(flight, control_ground=np.where(tie[:, None], ground, flight.control_ground))
