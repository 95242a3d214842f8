"""Simulated pass over a patch of ground: run, results and export.

The run generates the orbit, the true and the laboratory's camera, images and measured points from a test's file.
simulate.json has the quantities that the user of the images may know. The camera, the orbit with the attitude, and the
georeference are separate artefacts for other software; the true camera and trajectory are only in truth.json. The
export writes the simulated measurements as a folder of tables with a test file that reads them back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.arrays import Array
from analysis.matching.matches import EXPLAINED
from analysis.orbit.calibration_parameters import level_covariance
from optics.geometry.pose import about_axis, rotation_matrix
from optics.numerics.array_math import in_span
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.scene import OrbitSimulateSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.yaml.errors import KeyPath
from twin.framework.procedure import Advance, BenchError, silent, stream
from twin.framework.record import Quantity, Record, described, plain_data
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import LineCamera, LineTimes, changed_payload, line_cameras
from twin.orbit.flight.platform_table import PlatformTable, continuous_quaternions
from twin.orbit.flight.sensor import LightEffects, Sensor
from twin.orbit.flight.trajectory import Trajectory, readings
from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images import image_points
from twin.orbit.images import patch as patch_images
from twin.orbit.images.line_optics import optics_of
from twin.orbit.measured.measurement_tables import TEST_FILE, tested_files
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements, point_names

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import SimulateSetup

_REMEDIES: Mapping[str, tuple[KeyPath, str]] = FrozenMap(
    {
        "span": (("orbit",), "an orbit that is followed longer before and after, or another patch.time"),
        "place": (("patch", "pixel"), "a patch inside the swath of every line"),
        "size": (("patch",), "a smaller patch, or one farther from the ends of the lines"),
        "terrain": (("ground", "terrain"), "less relief, a larger exponent or larger posts"),
    }
)
"""Key of the input file to change, and advice to the user, by the `part` of a PatchError."""


@dataclass(frozen=True, eq=False)
class SimulatedFlight:
    """Simulated pass without its images.

    Attributes
    ----------
    earth : Earth
        Ellipsoid and rotation of the Earth.
    truth : ThreeLineCameraSpec
        True camera.
    trajectory : Trajectory
        True trajectory.
    measured : Trajectory
        Trajectory as the satellite measures it.
    sensors : mapping of str to Sensor
        True sensor of each line, over the whole orbit.
    users : mapping of str to Sensor
        Sensor of each line as the user knows it: the laboratory's camera on the measured trajectory.
    """

    earth: Earth
    truth: ThreeLineCameraSpec
    trajectory: Trajectory
    measured: Trajectory
    sensors: Mapping[str, Sensor]
    users: Mapping[str, Sensor]


@dataclass(frozen=True, eq=False, kw_only=True)
class Simulation(SimulatedFlight):
    """Simulated pass with images, control and measured points.

    Attributes
    ----------
    setup : SimulateSetup
        Test file with camera and detectors.
    seed : int
        Seed of all random numbers.
    lines : mapping of str to ImagedLine
        Rendered lines, by name.
    position : tuple of float
        Longitude and latitude of the patch's middle, radians.
    patch : Patch
        Images and control.
    points : PatchPoints or None
        Points measured in the images; None where none were requested.
    """

    setup: SimulateSetup
    seed: int
    lines: Mapping[str, patch_images.ImagedLine]
    position: tuple[float, float]
    patch: patch_images.Patch
    points: image_points.PatchPoints | None

    @property
    def spec(self) -> OrbitSimulateSpec:
        """Content of the test file of the simulation."""
        return self.setup.test

    @property
    def laboratory(self) -> ThreeLineCameraSpec:
        """Camera as the laboratory measured it before launch."""
        return self.setup.camera


def fly_simulation(setup: SimulateSetup, seed: int) -> SimulatedFlight:
    """Simulate the orbit and the sensors of a pass, without images; for the same seed as in `run_simulation`.

    Raises
    ------
    BenchError
        The orbit is impossible.
    """
    spec, root = setup.test, np.random.SeedSequence(seed)
    trajectory = Trajectory.of_test(spec, root)
    earth = trajectory.orbit.earth
    measured = trajectory.with_errors(spec.errors, int(np.random.default_rng(stream(root, 0)).integers(2**31)))
    truth = changed_payload(spec, setup.camera)
    true, known = line_cameras(truth), line_cameras(setup.camera)
    sensors = {name: _sensor(true[name], trajectory, earth, spec) for name in spec.lines}
    users = {name: _sensor(known[name], measured, earth, spec) for name in spec.lines}
    return SimulatedFlight(earth, truth, trajectory, measured, FrozenMap(sensors), FrozenMap(users))


def run_simulation(setup: SimulateSetup, backend: Backend | None, seed: int, advance: Advance = silent) -> Simulation:
    """Simulate the pass of ``python -m twin.orbit simulate``.

    Nothing is traced, so that the backend is not used.

    Raises
    ------
    BenchError
        The orbit is impossible, a line cannot image the patch, or points cannot be measured.
    """
    spec, root = setup.test, np.random.SeedSequence(seed)
    flight = fly_simulation(setup, seed)
    optics = optics_of(setup.camera, spec.lines, spec.line_time, setup.detectors)
    lines = patch_images.imaged_lines(flight.sensors, flight.users, optics, stream(root, 1))
    looking = _sensor(line_cameras(flight.truth)[spec.patch.line], flight.trajectory, flight.earth, spec)
    position = _patch_position(looking, spec)
    size, parts = (spec.patch.lines, spec.patch.pixels), len(lines) + 1

    def imaged(count: int) -> None:
        advance("images", count, parts)

    imaged(0)
    try:
        done = patch_images.fly_patch(
            lines, position, size, spec.ground, spec.control, stream(root, 2), spec.oversampling, advance=imaged
        )
    except patch_images.PatchError as error:
        key, remedy = _REMEDIES[error.part]
        raise BenchError(str(error), key, remedy) from error
    points = _points(done, spec)
    imaged(parts)
    return Simulation(
        **vars(flight), setup=setup, seed=seed, lines=FrozenMap(lines), position=position, patch=done, points=points
    )


def _points(patch: patch_images.Patch, spec: OrbitSimulateSpec) -> image_points.PatchPoints | None:
    """Return the points measured in a patch; None where the test requests none."""
    if spec.points is None:
        return None
    try:
        return image_points.measure_points(patch, spec.points)
    except image_points.PointsError as error:
        raise BenchError(str(error), ("points",), image_points.POINTS_REMEDY) from error


def _sensor(camera: LineCamera, trajectory: Trajectory, earth: Earth, spec: OrbitSimulateSpec) -> Sensor:
    """Return the sensor of a line's image over the whole orbit."""
    lines = max(int((trajectory.last - trajectory.first) / spec.line_time) - 1, 1)
    effects = LightEffects.of(spec.effects)
    return Sensor(camera, trajectory, earth, spec.line_time, trajectory.first + 0.5 * spec.line_time, lines, effects)


def _patch_position(sensor: Sensor, spec: OrbitSimulateSpec) -> tuple[float, float]:
    """Return longitude and latitude of the patch's middle, in radians."""
    line = (spec.patch.time - sensor.first_line_time) / sensor.line_time
    line = float(np.clip(line, -0.5, sensor.lines - 0.5))
    point = sensor.ground(np.array([line]), np.array([spec.patch.pixel]), spec.ground.terrain.height)
    longitude, latitude, _ = sensor.earth.geodetic(point[0])
    return float(longitude), float(latitude)


_TRUE_POINTS = 21
"""Number of points along each side of the grid of true ground points."""
_LOOK = (
    "y = (pixel - (pixels - 1)/2) pitch, r^2 = x0^2 + (y - y0)^2, d = k1 r^2 + k2 r^4; the look in camera axes "
    "is along (x0 (1 + d), -(y - y0)(1 + d), f); pixel 0 is the middle of the first"
)
"""Formula of a pixel's line of sight, for readers of camera.json."""


def _line_time(image: patch_images.LineImage, row: int) -> float:
    """Return the time of exposure of a row of the window, in seconds from the epoch."""
    return float(image.measured.time(np.array([image.window.first_line + row]))[0])


LINE: Record[patch_images.LineImage] = Record(
    "Image of one line.",
    Quantity("first_line", lambda image: image.window.first_line, "first line of the window in the line's whole image"),
    Quantity("first_pixel", lambda image: image.window.first_pixel, "first pixel of the window on the line"),
    Quantity("lines", lambda image: image.window.lines, "number of lines"),
    Quantity("pixels", lambda image: image.window.pixels, "number of pixels"),
    Quantity("first_line_time_s", lambda image: _line_time(image, 0), "mid-exposure of the first line, from the epoch"),
    Quantity("last_line_time_s", lambda i: _line_time(i, i.window.lines - 1), "mid-exposure of the last line"),
    Quantity("line_time_s", lambda image: image.measured.line_time, "time from one line to the next"),
    Quantity("mean_dn", lambda image: image.frame.mean(), "mean grey value", "mean [DN]"),
    Quantity("smallest_dn", lambda image: image.frame.min(), "smallest grey value", "smallest [DN]"),
    Quantity("largest_dn", lambda image: image.frame.max(), "largest grey value", "largest [DN]"),
    Quantity("rms_contrast", lambda i: i.frame.std() / i.frame.mean(), "standard deviation over mean", shown="percent"),
    Quantity("saturated_pixels", lambda image: image.saturated, "number of saturated pixels"),
    Quantity("sample_along_line_m", lambda image: image.sample[0], "distance of neighbouring pixels on the ground"),
    Quantity("sample_along_track_m", lambda image: image.sample[1], "distance of neighbouring lines on the ground"),
    Quantity(
        "mtf_nyquist_along_line",
        lambda image: image.nyquist[0],
        "MTF with the pixel at half a cycle per pixel",
        "MTF line",
    ),
    Quantity(
        "mtf_nyquist_along_track",
        lambda image: image.nyquist[1],
        "MTF with the pixel at half a cycle per line",
        "MTF track",
    ),
    Quantity("advance_px_per_line", lambda image: image.motion.advance, "motion of the image across the line"),
    Quantity("drift_px_per_line", lambda image: image.motion.drift, "motion of the image along the line"),
    Quantity("geometry_error_px", lambda image: image.error, "largest error of interpolated positions"),
)


def _per_pixel(raster: Raster) -> Array:
    """Return the grid spacing of a map: radians of longitude per column and of latitude per row (negative)."""
    return raster.spacing / np.array(raster.frame.scale) * np.array([1.0, -1.0])


GEOREFERENCE: Record[Raster] = Record(
    "Georeference of a raster: longitude and latitude are exactly linear in column and row.",
    Quantity("rows", lambda raster: raster.values.shape[0], "number of rows"),
    Quantity("columns", lambda raster: raster.values.shape[1], "number of columns"),
    Quantity("spacing_m", lambda raster: raster.spacing, "spacing of rows and columns on the ground"),
    Quantity(
        "first_longitude_deg",
        lambda raster: raster.frame.longitude + raster.west / raster.frame.scale[0],
        "longitude of the middle of the first column",
    ),
    Quantity(
        "first_latitude_deg",
        lambda raster: raster.frame.latitude + raster.north / raster.frame.scale[1],
        "latitude of the middle of the first row",
    ),
    Quantity("longitude_per_column_deg", lambda raster: _per_pixel(raster)[0], "step from one column to the next"),
    Quantity("latitude_per_row_deg", lambda raster: _per_pixel(raster)[1], "step from one row to the next, negative"),
)
MATCHED: Record[image_points.MatchedLine] = Record(
    "Points of one kind in one line. Shifts, measured minus predicted, and sigmas of the fit, are medians of "
    "the accepted points.",
    Quantity("measured", lambda line: np.isfinite(line.position[:, 0]).sum(), "points with a position from the fit"),
    Quantity("matched", lambda line: line.matched.sum(), "of these, points that passed the thresholds of the matching"),
    Quantity("accepted", lambda line: line.accepted.sum(), "of these, points that agree with their neighbours"),
    Quantity(
        "rejected_by_consensus",
        lambda line: (line.status == image_points.CONSENSUS).sum(),
        "contradicted by neighbours",
    ),
    Quantity("not_accepted", lambda line: line.rejections, "number of points by reason, the most frequent first"),
    Quantity("displacement_lines_px", lambda line: line.median_shift[0], "shift along the track", "shift, track"),
    Quantity("displacement_pixels_px", lambda line: line.median_shift[1], "shift along the line", "shift, line"),
    Quantity("displacement_lines_px_sigma", lambda line: line.median_sigma[0], "1 sigma along track", "σ track"),
    Quantity("displacement_pixels_px_sigma", lambda line: line.median_sigma[1], "1 sigma along line", "σ line"),
    Quantity(
        "consensus_scatter_px",
        lambda line: line.scatter if line.scatter > EXPLAINED else None,
        "scatter of the shifts beyond their covariances; none where these explain it",
    ),
)
POINTS: Record[image_points.MatchedPoints] = Record(
    "Points of one kind; for ties without the line in which they are chosen.",
    Quantity("sought", lambda points: len(points.ground), "number of points"),
    Quantity("in_all_lines", lambda points: points.in_all.sum(), "points accepted in every line"),
    Quantity("lines", lambda points: points.searched_lines, "each line that was searched", record=MATCHED),
)
SIMULATE: Record[Simulation] = Record(
    "simulate.json. Quantities that the user of the images may know.",
    Quantity("seed", lambda run: run.seed, "seed of all random numbers"),
    Quantity("epoch_utc", lambda run: str(run.spec.orbit.epoch), "zero of the times"),
    Quantity("longitude_deg", lambda run: run.position[0], "longitude of the patch's middle"),
    Quantity("latitude_deg", lambda run: run.position[1], "latitude of the patch's middle"),
    Quantity("lines", lambda run: run.patch.images, "image of each line", record=LINE),
    Quantity("orthophoto", lambda run: run.patch.control.orthophoto, "orthophoto", record=GEOREFERENCE),
    Quantity("dem", lambda run: run.patch.control.dem, "georeference of the elevation model", record=GEOREFERENCE),
    Quantity("points", lambda run: run.points and run.points.sorts, "measured points by kind", record=POINTS),
)


def camera_data(camera: ThreeLineCameraSpec) -> dict[str, Any]:
    """Return the interior orientation and mounting of every line, with the formula of a pixel's line of sight."""
    lines = {
        name: {
            "pixels": camera.pixels_of(name),
            "pitch_m": camera.pitch_of(name),
            "principal_distance_m": line.principal_distance,
            "principal_point_m": line.principal_point,
            "k1_per_m2": line.k1,
            "k2_per_m4": line.k2,
            "camera_to_body": about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate)),
            "position_m": line.position,
        }
        for name, line in camera.lines.items()
    }
    return {"name": camera.name, "look": _LOOK, "lines": plain_data(lines)}


def trajectory_data(run: Simulation, path: Trajectory) -> dict[str, Any]:
    """Return orbit and attitude at the times of the pass's readings, for a JSON file.

    Between the readings the errors of a measured trajectory are the cubic spline that `twin.orbit.flight.trajectory`
    describes. Quaternions are (x, y, z, w), with continuous signs so that they can be interpolated.
    """
    errors = run.spec.errors
    times = (readings(path.first, path.last, of.interval) for of in (errors.gps, errors.star_tracker))
    fixes, looks = (t[in_span(t, path.first, path.last)] for t in times)
    quaternion = Rotation.from_matrix(path.body_to_itrs(looks)).as_quat(canonical=False)
    data = {
        "epoch_utc": str(path.orbit.epoch),
        "orbit_s": fixes,
        "position_m": path.position(fixes),
        "velocity_m_per_s": path.velocity(fixes),
        "inertial_velocity_m_per_s": path.inertial_velocity(fixes),
        "attitude_s": looks,
        "quaternion": continuous_quaternions(quaternion),
    }
    return {key: plain_data(value) for key, value in data.items()}


def georeference_data(run: Simulation) -> dict[str, Any]:
    """Return the georeference of orthophoto and elevation model, as plain data for a JSON file."""
    control = run.patch.control
    return {"orthophoto": GEOREFERENCE(control.orthophoto), "dem": GEOREFERENCE(control.dem)}


def _errors(judgement: patch_images.LineComparison) -> list[list[float | None]]:
    """Return the image errors of every point (line, pixel), measured minus true; None where not measured."""
    return [[float(v) if np.isfinite(v) else None for v in row] for row in judgement.error]


MATCH_COUNTS = {
    "measured": "points with a measured position, before any is rejected",
    "matched": "points that passed the thresholds of the matching",
    "accepted": "points that also passed the consensus",
    "wrong_measured": "wrong ones among all measured points",
    "wrong_matched": "wrong ones among those that passed the matching",
    "wrong_accepted": "wrong ones among those that passed the consensus",
    "right_rejected_by_consensus": "right matches that the consensus rejected",
}
"""Meaning of each count of matched points in one line, by its result key."""

COMPARED: Record[patch_images.LineComparison] = Record(
    "Points of one kind in one line compared with the truth; RMS and mean of those that are not wrong.",
    *(Quantity(key, attrgetter(key), meaning) for key, meaning in MATCH_COUNTS.items()),
    Quantity("rms_lines_px", lambda c: c.rms[0], "root mean square error along the track", "RMS track"),
    Quantity("rms_pixels_px", lambda c: c.rms[1], "root mean square error along the line", "RMS line"),
    Quantity("mean_lines_px", lambda comparison: comparison.mean[0], "mean error along the track", "mean track"),
    Quantity("mean_pixels_px", lambda comparison: comparison.mean[1], "mean error along the line", "mean line"),
    Quantity("chi_square", lambda comparison: comparison.chi_square, "of their errors under their covariances", "χ²"),
    Quantity("degrees_of_freedom", lambda comparison: comparison.degrees_of_freedom, "two for each point"),
    Quantity("error_px", _errors, "measured minus true, lines and pixels, of each point"),
)
TRUE_POINTS: Record[tuple[patch_images.Patch, image_points.MatchedPoints]] = Record(
    "True ground positions of the points of one kind, in the order of points.csv.",
    Quantity("itrs_m", lambda of: patch_images.true_ground(*of), "ITRS coordinates"),
    Quantity("lines", lambda of: patch_images.judged(*of), "each line that was searched", record=COMPARED),
)


def _grid(shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return rows and columns of a grid over an image."""
    row, column = np.meshgrid(*(np.linspace(0.0, n - 1.0, _TRUE_POINTS) for n in shape), indexing="ij")
    return row.ravel(), column.ravel()


def _true_grid(patch: patch_images.Patch, name: str) -> dict[str, Any]:
    """Return the true ground points that a grid of positions in a line's image sees."""
    row, column = _grid(patch.images[name].frame.shape)
    line, pixel = patch.images[name].image_point(row, column)
    return {"line": line, "pixel": pixel, "itrs_m": patch.true_point(name, row, column)}


def _control_error(patch: patch_images.Patch) -> dict[str, Any]:
    """Return the orthophoto's error in plan, map minus true, east and north, in metres, at a grid of its pixels."""
    photo = patch.control.orthophoto
    row, column = _grid(photo.values.shape)
    east, north = patch.control.error(*photo.east_north(row, column))
    return {"row": row, "column": column, "east_m": east, "north_m": north}


TRUTH: Record[Simulation] = Record(
    "Truth of a pass, unknown to an analysis.",
    Quantity(
        "points",
        lambda run: run.points and {sort: (run.patch, group) for sort, group in run.points.sorts.items()},
        "true ground positions by kind, and the measured points compared with them",
        record=TRUE_POINTS,
    ),
    Quantity("camera", lambda run: described("camera", camera_data(run.truth)), "true camera"),
    Quantity("trajectory", lambda run: described("trajectory", trajectory_data(run, run.trajectory)), "true path"),
    Quantity(
        "ground_points",
        lambda run: {name: _true_grid(run.patch, name) for name in run.patch.images},
        "true ground positions of a grid of each line's image",
    ),
    Quantity("control_error", lambda run: _control_error(run.patch), "error in plan at a grid of the orthophoto"),
)


_EXACT = 1e-3
"""Sigma written for control points that are simulated without errors, in metres."""


def simulation_exported(run: Simulation) -> dict[str, str]:
    """Return the files of one pass over a patch whose points were measured in its images, path -> text.

    Raises
    ------
    InputError
        The test measures no points.
    """
    spec = run.spec
    if run.points is None or run.points.control is None or spec.points is None:
        allowed = "`points:` with control and check points"
        raise spec.error("only measured points can be exported as tables", ("points",), allowed=allowed)
    errors = spec.errors
    plain = spec.plain()
    platform = PlatformTable.sampled(run.measured, errors.gps.interval, errors.star_tracker.interval)
    lines = max(int((run.measured.last - run.measured.first) / spec.line_time) - 1, 1)
    times = LineTimes.even(run.measured.first + 0.5 * spec.line_time, spec.line_time, lines)
    known = run.points.control
    sorts = [known] if run.points.ties is None else [known, run.points.ties]
    role = np.concatenate([np.where(known.check, "check", "control"), *(["tie"] * len(s.ground) for s in sorts[1:])])
    ground = np.concatenate([known.ground, *(np.full((len(s.ground), 3), np.nan) for s in sorts[1:])])
    covariance = np.zeros((len(role), 3, 3))
    # One error in plan moves all points of a patch, so each of n gets n times the variance.
    share = float(np.sqrt(max(int(np.sum(known.in_all & ~known.check)), 1)))
    plan, tall = max(spec.control.sigma * share, _EXACT), max(spec.points.height_sigma, _EXACT)
    covariance[: len(known.ground)] = level_covariance(known.ground, plan, tall)
    images = {}
    for name in known.lines:
        good = [np.flatnonzero(sort.lines[name].accepted) for sort in sorts]
        parts = [sort.lines[name].measured(rows, rows) for sort, rows in zip(sorts, good, strict=True)]
        images[name] = ImagePoints.joined([parts[0], *(part.numbered(-len(known.ground)) for part in parts[1:])])
    points = GroundPoints.of(point_names(role), ground, covariance, role.astype(object))
    measured = PassMeasurements(spec.name, platform, dict.fromkeys(known.lines, times), points, images)
    gps, tracker = plain["errors"]["gps"], plain["errors"]["star_tracker"]
    return tested_files(
        [measured],
        run.laboratory.plain(),
        spec,
        TEST_FILE,
        schemes=[[spec.name]],
        effects={**plain["effects"], "corrected": True},
        errors={
            "gps": {key: gps[key] for key in ("noise", "drift", "interval")},
            "star_tracker": {key: tracker[key] for key in ("noise", "slow", "interval")},
        },
    )
