"""Passes over fields of points as an analysis has them, whoever flew them: a satellite, or the simulation.

Each pass is what was measured (`twin.orbit.measured.pass_measurements`): readings of orbit and attitude, line times,
ground and image points. The camera is that of the laboratory, and the effects on the light are taken out of the image
points by it (`twin.orbit.calibration.campaign`). The truth is there where a simulation knows it, for comparisons
alone.

From image points of a pass to what a calibration takes, with the effects on the light taken out.

The adjustment's rays are straight lines in Earth-fixed axes. A pixel's look is where the light seems to come from; the
straight line to the place on the ground that this look really sees, through the measured station, is where the place
is. The image point is moved from the one to the other. Camera and trajectory are those that the analysis has: the
laboratory's and the measured one. The camera's error of 100 m on the ground, 2e-4 rad, changes an aberration of 4
pixels by a thousandth of a pixel.

Image points may be drawn, as `twin.orbit.calibration.campaign` does, or measured in images: nothing here knows which.
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
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import LineTimes, line_cameras, pixel_places
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import Platform, Sensor
from twin.orbit.flight.trajectory import MeasurementErrors, Trajectory
from twin.orbit.measured.pass_measurements import ImagePoints, PassMeasurements

if TYPE_CHECKING:
    from scenes.specs.orbit.angle import EffectsSpec
    from scenes.specs.orbit.calibration import OrbitCalibrationSpec
    from scenes.specs.orbit.flight import ErrorsSpec
    from scenes.specs.orbit.measurements import MeasuredCalibrationSpec, ReadingErrorsSpec
    from scenes.specs.orbit.three_line_camera import LineCameraSpec
    from twin.orbit.images.image_points import PatchPoints
    from twin.orbit.images.patch import LineJudgement, Patch

EFFECTS = ("light_time", "aberration", "refraction")
_DISTORTION_STEPS = 8
"""Fixed-point steps; each makes the error smaller by the distortion, 1e-3 of the image or less."""


def light_effects(spec: EffectsSpec) -> LightEffects:
    """Effects on the light that a file switches on."""
    return LightEffects(spec.light_time, spec.aberration, spec.refraction, spec.wavelength)


def any_effect(effects: LightEffects) -> bool:
    """Whether one of them is on."""
    return any(getattr(effects, name) for name in EFFECTS)


def light_shift(
    sensor: Sensor, model: LineModel, line: np.ndarray, pixel: np.ndarray, height: np.ndarray
) -> np.ndarray:
    """From image points as they are measured to where they would lie if nothing happened to the light.

    Parameters
    ----------
    sensor : Sensor
        The laboratory's line on the measured trajectory, with the effects that are to be taken out.
    model : LineModel
        The same line as the adjustment has it.
    line : np.ndarray
        Of the image points, (n,).
    pixel : np.ndarray
        likewise.
    height : np.ndarray
        Of the ground that they show, above the ellipsoid, metres, (n,).

    Returns
    -------
    np.ndarray
        (n, 2) x and y in the focal plane, metres, to be added.

    Raises
    ------
    ValueError
        a point outside the image, or a look that misses the Earth.
    """
    if sensor.effects == NO_EFFECTS or not any_effect(sensor.effects):
        return np.zeros((len(line), 2))
    ground = sensor.ground(line, pixel, height)
    if not np.all(np.isfinite(ground)):
        raise UnphysicalError("a look misses the Earth")
    seconds = sensor.time(line)
    arm = ground - sensor.trajectory.position(seconds)
    geometric = np.einsum("nji,nj->ni", sensor.trajectory.body_to_itrs(seconds), arm) - model.position
    return _place(geometric, model) - _place(sensor.camera.look(pixel), model)


def _place(direction: np.ndarray, model: LineModel) -> np.ndarray:
    """Image (n, 2) of directions (n, 3) in the body frame, from the principal point, metres."""
    a, b, c = (direction @ model.to_body).T
    ideal = -model.interior[0] * np.stack([a / c, b / c], axis=-1)
    found = ideal
    for _ in range(_DISTORTION_STEPS):
        square = np.sum(found**2, axis=1, keepdims=True)
        found = ideal / (1.0 + square * (model.k1 + model.k2 * square))
    return np.asarray(found)


_SAME_PHASE = 1e-6
"""Phase that counts as zero, as a share of the interval between readings: times of readings are rounded."""
_HEIGHTS = (-500.0, 9000.0)
"""Metres: of land. A control point outside of them is refused by the calibration, not here."""


@dataclass(frozen=True, eq=False)
class PassData:
    """What is known of a pass beside its image points; nothing of it is the truth.

    Attributes
    ----------
    name : str
        Of the field.
    sensors : Mapping[str, Sensor]
        Line -> the laboratory's camera on the measured trajectory. Its effects do not matter.
    models : Mapping[str, LineModel]
        Line -> the same camera as the adjustment has it.
    pitch : Mapping[str, float]
        Line -> of its pixels, metres.
    height : float
        Mean of the ground above the ellipsoid, metres.
    lines : Mapping[str, LineCameraSpec]
        Line -> what the payload's file says of it.
    unit : float | None
        Metres in the focal plane; every ray carries the covariance of its own image point in units of it squared. None:
        rays carry none.
    """

    name: str
    sensors: Mapping[str, Sensor]
    models: Mapping[str, LineModel]
    pitch: Mapping[str, float]
    height: float
    lines: Mapping[str, LineCameraSpec]
    unit: float | None = None

    def places(self, name: str, pixel: np.ndarray) -> np.ndarray:
        """Where pixels (n,) of a line lie in its focal plane, (n, 2), metres."""
        return pixel_places(self.lines[name], pixel, self.sensors[name].camera.pixels, self.pitch[name])

    @property
    def phase(self) -> float:
        """Time of a reading of the attitude from the next whole multiple of their interval, seconds.

        Readings of the orbit are as far from their multiples at most, half of their interval, which shared noise does
        not know: its variance then is that of another place between two readings.
        """
        path = next(iter(self.sensors.values())).trajectory
        if not isinstance(path, TabulatedTrajectory):
            return 0.0
        time, step = path.table.attitude_time, path.attitude_interval
        # a table may begin with an odd end
        reading = float(time[1 + int(np.argmin(np.abs(np.diff(time[1:]) - step)))]) if len(time) > 2 else float(time[0])
        phase = reading - step * round(reading / step)
        return phase if abs(phase) > _SAME_PHASE * step else 0.0

    @property
    def earth(self) -> Earth:
        """The ellipsoid."""
        return next(iter(self.sensors.values())).earth

    def pixels_per_line(self, name: str) -> float:
        """What one image line of the middle of a line's image is in x of the focal plane, pixels.

        It is where the ground that the next line sees, at the pass' mean height, lies in the focal plane at one moment.
        Where lines are spaced as pixels are, 1 at nadir and about cos^2 of the look angle in a line that looks ahead.
        """
        sensor, model = self.sensors[name], self.models[name]
        middle = np.full(2, 0.5 * (sensor.lines - 1))
        ground = sensor.ground(
            middle + np.array([-0.5, 0.5]), np.full(2, 0.5 * (sensor.camera.pixels - 1)), self.height
        )
        seconds = sensor.time(middle)
        to_body = np.swapaxes(sensor.trajectory.body_to_itrs(seconds), 1, 2)
        arm = np.einsum("nij,nj->ni", to_body, ground - sensor.trajectory.position(seconds))
        a, _, c = ((arm - model.position) @ model.to_body).T
        x = -float(model.interior[0]) * a / c
        return abs(float(x[1] - x[0])) / self.pitch[name]

    def rays(self, images: Mapping[str, ImagePoints]) -> dict[str, Rays]:
        """Rays of image points with what happened to the light left in.

        Raises
        ------
        ValueError
            a line outside the image.
        """
        found = {}
        for name, row in images.items():
            sensor = self.sensors[name]
            seconds = sensor.time(row.line)
            image = self.places(name, row.pixel)
            station, attitude = sensor.trajectory.position(seconds), sensor.trajectory.body_to_itrs(seconds)
            # the noise of readings is shared by its own clock, which ticks at the readings
            rays = Rays.of(row.point, image, station, attitude, seconds - self.phase)
            found[name] = rays if self.unit is None else replace(rays, spread=self.spread(name, row) / self.unit**2)
        return found

    def spread(self, name: str, row: ImagePoints) -> np.ndarray:
        """(n, 2, 2) of image points in the focal plane, metres^2. A later line acts as a smaller x."""
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
        """Control points for the calibration.

        Parameters
        ----------
        images : Mapping[str, ImagePoints]
            Line -> their image points.
        ground : np.ndarray
            (m, 3) given coordinates, ITRS, metres.
        covariance : float | tuple[float, float] | np.ndarray
            (m, 3, 3) of the coordinates, m^2, of ties not used; or a sigma of each coordinate, or of each axis in plan
            and of the height, metres.
        removed : LightEffects
            Effects on the light that are taken out.
        control : np.ndarray | None
            (m,) which of them are control, the others are ties; None for all.

        Raises
        ------
        CalibrationError
            Coordinates that cannot be used, such as geodetic ones.
        ValueError
            a point outside the image.
        """
        # the calibration's own check comes first: a place without a height has no refraction
        field = CalibrationField.of(self.name, self.rays(images), ground, covariance, control)
        return replace(field, rays=self.corrected(field.rays, images, removed, self._heights(ground)))

    def check_rays(self, images: Mapping[str, ImagePoints], removed: LightEffects, noise: Noise) -> dict[str, Rays]:
        """Rays of points without ground control.

        Refraction depends on the height of the ground, 8% of it on 700 m. It is taken from a first intersection by the
        laboratory's camera, 100 m wrong, of the rays as they are.

        Raises
        ------
        CalibrationError
            The rays cannot be intersected.
        ValueError
            a point outside the image.
        """
        rays = self.rays(images)
        return self.corrected(rays, images, removed, self._heights(intersect(rays, self.models, noise).ground))

    def corrected(
        self, rays: Mapping[str, Rays], images: Mapping[str, ImagePoints], removed: LightEffects, height: np.ndarray
    ) -> dict[str, Rays]:
        """The rays without these effects.

        Parameters
        ----------
        rays : Mapping[str, Rays]
            Line -> rays of the image points.
        images : Mapping[str, ImagePoints]
            Line -> the image points.
        removed : LightEffects
            Effects on the light that are taken out.
        height : np.ndarray
            Of the ground points, (m,), NaN where not known, metres.

        Raises
        ------
        ValueError
            a point outside the image.
        """
        known = np.clip(np.where(np.isfinite(height), height, self.height), *_HEIGHTS)
        found = {}
        for name, row in images.items():
            sensor = replace(self.sensors[name], effects=removed)
            shift = light_shift(sensor, self.models[name], row.line, row.pixel, known[row.point])
            found[name] = replace(rays[name], image=rays[name].image + shift)
        return found

    def _heights(self, ground: np.ndarray) -> np.ndarray:
        found = np.full(len(ground), np.nan)
        good = np.all(np.isfinite(ground), axis=1)
        found[good] = self.earth.geodetic(ground[good])[2]
        return found


@dataclass(frozen=True, eq=False)
class FieldPoints:
    """What was measured of a field's points.

    Attributes
    ----------
    control_images : Mapping[str, ImagePoints]
        Line -> image points of the control points, and of the tie points after them.
    control_ground : np.ndarray
        (n, 3) given coordinates of control points, first guesses of ties, ITRS, metres.
    control : np.ndarray
        (n,) bool: which are control.
    sigma : tuple[float, float]
        Of given coordinates, of each axis in plan and of the height, metres.
    check_images : Mapping[str, ImagePoints]
        Line -> image points of the check points.
    check_ground : np.ndarray
        (m, 3) true coordinates of the check points, ITRS, metres.
    """

    control_images: Mapping[str, ImagePoints]
    control_ground: np.ndarray
    control: np.ndarray
    sigma: tuple[float, float]
    check_images: Mapping[str, ImagePoints]
    check_ground: np.ndarray


def image_sigma(images: Mapping[str, ImagePoints], data: PassData) -> float:
    """One standard deviation of x and y in the focal plane for all image points, root mean square, metres."""
    variances = [np.diagonal(data.spread(name, row), axis1=1, axis2=2) for name, row in images.items()]
    return float(np.sqrt(np.mean(np.concatenate(variances))))


@dataclass(frozen=True, eq=False)
class PassTruth:
    """What a simulation knows of a pass.

    Attributes
    ----------
    bias : np.ndarray
        (3,) true roll, pitch, yaw at the field's middle, radians: from measured to true attitude.
    offset : np.ndarray
        (3,) true minus measured station at the field's middle, along X, Y, Z of the orbital frame, metres.
    trajectory : Trajectory
        The true one.
    errors : MeasurementErrors
        Of the readings.
    drift : Mapping[str, np.ndarray]
        Line -> (4,) true d_alpha, d_beta, d_gamma, d_f of its camera, radians and metres; empty for no drift.
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
class PatchRecord:
    """One patch and how its points were matched.

    Attributes
    ----------
    points : PatchPoints
        measured.
    judgements : Mapping[str, Mapping[str, LineJudgement]]
        ``control`` (with the check points) or ``tie`` -> line -> against the truth.
    """

    points: PatchPoints
    judgements: Mapping[str, Mapping[str, LineJudgement]]


@dataclass(frozen=True, eq=False)
class FieldImages:
    """What became of a field's points.

    Attributes
    ----------
    name : str
        Of the field.
    patches : tuple[PatchRecord, ...]
        One by one.
    shown : Patch
        The first patch itself, for a figure.
    wrong : Mapping[str, np.ndarray]
        Line -> (n,) whether the place of a control or tie point is wrong, by number of the point.
    wrong_check : Mapping[str, np.ndarray]
        Line -> (m,) likewise for check points.
    screening : Screening | None
        What the adjustment has left out; None before it.
    """

    name: str
    patches: tuple[PatchRecord, ...]
    shown: Patch
    wrong: Mapping[str, np.ndarray]
    wrong_check: Mapping[str, np.ndarray]
    screening: Screening | None = None


@dataclass(frozen=True)
class Screening:
    """What the adjustment has left out of a field; counts are of image points, by truth where wrong or right.

    Attributes
    ----------
    entered, left : int
        Image points of control and tie points before and after.
    wrong_entered, wrong_left : int
        Wrong ones among them.
    right_lost : int
        Right ones that were left out.
    check_entered, check_left : int
        Check points before and after the test of their intersection.
    wrong_check_left : int
        Of these, with a wrong place in a line.
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
    """One pass over one field.

    Attributes
    ----------
    measurements : PassMeasurements
        As they came.
    data : PassData
        What is known of the pass beside its points.
    latitude : float
        Mean of the control points, radians.
    control_images : Mapping[str, ImagePoints]
        Line -> image points of control points, and of tie points that calibrate with them.
    control_ground : np.ndarray
        (n, 3) their given coordinates, of ties those of a first intersection, ITRS, metres.
    control_covariance : np.ndarray
        (n, 3, 3) of given coordinates, m^2.
    is_control : np.ndarray
        (n,) which of them are control.
    control_ids : np.ndarray
        (n,) names.
    check_images : Mapping[str, ImagePoints]
        Line -> image points of the check points.
    check_ground : np.ndarray
        (m, 3) given coordinates of the check points, ITRS, metres.
    check_ids : np.ndarray
        (m,) names.
    tie_images : Mapping[str, ImagePoints]
        Line -> image points of tie points that are kept apart for the strip; empty for none.
    control : CalibrationField
        What the calibration gets.
    check : Mapping[str, Rays]
        Line -> rays of the check points.
    ties : Mapping[str, Rays]
        Line -> rays of the ties apart.
    readings : Mapping[str, np.ndarray]
        Line -> (4,) what a monitor reads of its camera; empty for no monitor.
    known_truth : PassTruth | None
        Of a simulated pass.
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

    Attributes
    ----------
    spec : OrbitCalibrationSpec | MeasuredCalibrationSpec
        The test.
    laboratory : Mapping[str, LineModel]
        Line -> camera as it was measured before launch; what the analysis starts from.
    noise : Noise
        What the analysis is told of the independent errors.
    passes : tuple[FieldPass, ...]
        In the file's order.
    images : tuple[FieldImages, ...] | None
        What became of points measured in simulated images, by field; None otherwise.
    known_truth : Mapping[str, LineModel] | None
        Line -> camera as it is, without the drift of single fields; None where nobody knows.
    rejected : Mapping[str, Rejected]
        Field -> what the adjustment has left out; empty where nothing was looked for.
    drifts : FoundDrift | None
        What residuals showed of a drift of the attitude that nobody stated; None where they show none.
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

        Raises
        ------
        CalibrationError
            Control coordinates that cannot be used, or check points that cannot be intersected.
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

    Attributes
    ----------
    rate : tuple[float, float, float]
        Standard deviation of the rates about body X, Y, Z that is assumed since, radians per second.
    walk : float
        Likewise of a random walk, what it gains in a second, radians.
    rate_p_value, course_p_value : float
        Chance of such residuals without rates, and without errors that change slowly.
    """

    rate: tuple[float, float, float]
    walk: float
    rate_p_value: float
    course_p_value: float


@dataclass(frozen=True, eq=False)
class Rejected:
    """What the adjustment has left out of a pass.

    Attributes
    ----------
    entered, left : int
        Image points of control and tie points before and after.
    points : tuple[tuple[str, str], ...]
        Names of control and tie points with a rejected image point, and its line camera.
    check_entered, check_left : int
        Check points before and after the test of their intersection.
    check_points : tuple[str, ...]
        Names of those that were left out.
    factors : Mapping[str, float]
        Line -> on the sigmas of its image points, by the residuals of those that remain; 1 where they are right.
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


def passing_orbit(
    epoch: str,
    span: float,
    altitude: float,
    longitude: float,
    latitude: float,
    direction: Literal["descending", "ascending"] = "descending",
) -> OrbitSpec:
    """Return the orbit that passes a place at its epoch, followed for a span before and after; SI units."""
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
    """Return what is known of a pass: its lines by the laboratory's camera and the readings of the platform.

    Parameters
    ----------
    name : str
        Of the pass.
    payload : ThreeLineCameraSpec
        Camera as the laboratory measured it.
    platform : Platform
        Orbit and attitude as they were read.
    times : Mapping[str, LineTimes]
        Line camera -> when its lines were exposed.
    height : float
        Of the ground above the ellipsoid, metres.
    unit : float | None
        Sigma of an image point of weight 1, metres; None for points that weigh alike.
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
    """The campaign of measured passes, with the effects on the light taken out where the test says so.

    Parameters
    ----------
    spec : OrbitCalibrationSpec | MeasuredCalibrationSpec
        The test.
    payload : ThreeLineCameraSpec
        As the laboratory knows it.
    measured : Sequence[PassMeasurements]
        The passes.
    ties_apart : bool
        Whether tie points are kept for the strip, and do not calibrate.

    Raises
    ------
    CalibrationError
        Points that cannot be used.
    """
    seen = {name for one in measured for name in one.images}
    laboratory = FrozenMap({name: line_model(payload, name) for name in payload.lines if name in seen})
    passes = [_field_pass(one, payload, ties_apart) for one in measured]
    unit = image_sigma(passes[0].control_images, passes[0].data)
    noise = _noise_of(spec.errors, unit, [one.measured for one in passes])
    weighed = tuple(replace(p, data=replace(p.data, unit=unit)) for p in passes)
    campaign = Campaign(spec, laboratory, noise, tuple(_with_ties(p, noise) for p in weighed))
    return campaign.without_effects(campaign.effects if spec.effects.corrected else NO_EFFECTS)


def _noise_of(errors: ErrorsSpec | ReadingErrorsSpec, image: float, paths: Sequence[TabulatedTrajectory] = ()) -> Noise:
    """Sigmas of readings as given, root mean square over axes, and their intervals.

    Parameters
    ----------
    errors : ErrorsSpec | ReadingErrorsSpec
        Of the readings.
    image : float
        Unit of the image points, metres.
    paths : Sequence[TabulatedTrajectory]
        Their tables, for intervals that are not given.
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


def _field_pass(one: PassMeasurements, payload: ThreeLineCameraSpec, ties_apart: bool) -> FieldPass:
    role = one.ground.role
    rays = np.zeros(len(role), int)
    for row in one.images.values():
        np.add.at(rays, row.point, 1)
    known = (role == "control") & (rays > 0)
    _, latitude, height = Earth().geodetic(one.ground.itrs[known])
    times = {name: one.line_times[name] for name in one.images}
    data = pass_data(one.name, payload, TabulatedTrajectory(one.platform), times, float(np.mean(height)))
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
