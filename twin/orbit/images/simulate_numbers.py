"""The quantities of a simulated pass: simulate.json, and what artefacts/NAME.json hold for other software and as truth.

simulate.json has what the user of the images may know. The camera, orbit and attitude, and the georeference are files
of their own; the camera and the trajectory as they truly are stand in truth.json alone.
"""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.arrays import Array
from optics.geometry.pose import about_axis, rotation_matrix
from optics.numerics.array_math import in_span
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from twin.framework.quantity import Quantity, Record
from twin.framework.reference_frames import described
from twin.orbit.flight.platform_table import joined_quaternions
from twin.orbit.flight.trajectory import Trajectory, readings
from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images import point_judgement
from twin.orbit.images.image_points import CONSENSUS, MatchedLine, MatchedPoints
from twin.orbit.images.patch import LineImage, Patch
from twin.orbit.images.simulate_run import Simulation

_TRUE_POINTS = 21
"""Along each side of the grid of true ground points."""
_LOOK = (
    "y = (pixel - (pixels - 1)/2) pitch, r^2 = x0^2 + (y - y0)^2, d = k1 r^2 + k2 r^4; the look in camera axes "
    "is along (x0 (1 + d), -(y - y0)(1 + d), f); pixel 0 is the middle of the first"
)


def _line_time(image: LineImage, row: int) -> float:
    return float(image.measured.time(np.array([image.window.first_line + row]))[0])


LINE: Record[LineImage] = Record(
    "One line's image.",
    Quantity("first_line", lambda image: image.window.first_line, "of the window in the line's whole image"),
    Quantity("first_pixel", lambda image: image.window.first_pixel, "of the window on the line"),
    Quantity("lines", lambda image: image.window.lines, "how many"),
    Quantity("pixels", lambda image: image.window.pixels, "how many"),
    Quantity("first_line_time_s", lambda image: _line_time(image, 0), "middle of its exposure, from the epoch"),
    Quantity("last_line_time_s", lambda image: _line_time(image, image.window.lines - 1), "the same of the last line"),
    Quantity("line_time_s", lambda image: image.measured.line_time, "from one line to the next"),
    Quantity("mean_dn", lambda image: image.frame.mean(), "mean grey value"),
    Quantity("smallest_dn", lambda image: image.frame.min(), "smallest grey value"),
    Quantity("largest_dn", lambda image: image.frame.max(), "largest grey value"),
    Quantity("rms_contrast", lambda image: image.frame.std() / image.frame.mean(), "standard deviation over mean"),
    Quantity("saturated_pixels", lambda image: image.saturated, "at the end of the detector's range"),
    Quantity("sample_along_line_m", lambda image: image.sample[0], "distance of two pixels on the ground"),
    Quantity("sample_along_track_m", lambda image: image.sample[1], "distance of two lines on the ground"),
    Quantity("mtf_nyquist_along_line", lambda image: image.nyquist[0], "at half a cycle per pixel"),
    Quantity("mtf_nyquist_along_track", lambda image: image.nyquist[1], "at half a cycle per line"),
    Quantity("advance_px_per_line", lambda image: image.motion.advance, "motion of the image across the line"),
    Quantity("drift_px_per_line", lambda image: image.motion.drift, "motion of the image along the line"),
    Quantity("geometry_error_px", lambda image: image.error, "largest of places that the renderer interpolates"),
)


def _per_pixel(raster: Raster) -> Array:
    """Radians of longitude per column and of latitude per row, which go to the south."""
    return raster.spacing / np.array(raster.frame.scale) * np.array([1.0, -1.0])


GEOREFERENCE: Record[Raster] = Record(
    "Where a raster's pixels lie, exactly: longitude and latitude are linear in column and row.",
    Quantity("rows", lambda raster: raster.values.shape[0], "how many"),
    Quantity("columns", lambda raster: raster.values.shape[1], "how many"),
    Quantity("spacing_m", lambda raster: raster.spacing, "of rows and columns on the ground"),
    Quantity(
        "first_longitude_deg",
        lambda raster: raster.frame.longitude + raster.west / raster.frame.scale[0],
        "of the middle of the first column",
    ),
    Quantity(
        "first_latitude_deg",
        lambda raster: raster.frame.latitude + raster.north / raster.frame.scale[1],
        "of the middle of the first row",
    ),
    Quantity("longitude_per_column_deg", lambda raster: _per_pixel(raster)[0], "from one column to the next"),
    Quantity("latitude_per_row_deg", lambda raster: _per_pixel(raster)[1], "from one row to the next, negative"),
)
MATCHED: Record[MatchedLine] = Record(
    "Points of one sort in one line. Displacements from where the line is known to have the points, and sigmas of the "
    "fit, are medians of the accepted.",
    Quantity("found", lambda line: np.isfinite(line.place[:, 0]).sum(), "places that a fit gave"),
    Quantity("matched", lambda line: line.matched.sum(), "of these, places that matching let pass"),
    Quantity("accepted", lambda line: line.accepted.sum(), "of these, places that the neighbours agree with"),
    Quantity("rejected_by_consensus", lambda line: (line.status == CONSENSUS).sum(), "that the neighbours contradict"),
    Quantity("not_accepted", lambda line: line.lost, "reason -> number of points, the most frequent first"),
    Quantity("displacement_lines_px", lambda line: line.moved[0], "found minus predicted, along the track"),
    Quantity("displacement_pixels_px", lambda line: line.moved[1], "found minus predicted, along the line"),
    Quantity("displacement_lines_px_sigma", lambda line: line.usual_sigma[0], "standard deviation along the track"),
    Quantity("displacement_pixels_px_sigma", lambda line: line.usual_sigma[1], "standard deviation along the line"),
    Quantity("consensus_scatter_px", lambda line: line.scatter, "of the displacements beyond their covariances"),
)
POINTS: Record[MatchedPoints] = Record(
    "Points of one sort; ties are chosen in one line, which is left out.",
    Quantity("sought", lambda points: len(points.ground), "how many"),
    Quantity("in_all_lines", lambda points: points.in_all.sum(), "accepted in every line"),
    Quantity("lines", lambda points: points.sought_in, "every line that was searched", record=MATCHED),
)
SIMULATE: Record[Simulation] = Record(
    "simulate.json. What the user of the images may know.",
    Quantity("seed", lambda run: run.seed, "of all random numbers"),
    Quantity("epoch_utc", lambda run: str(run.spec.orbit.epoch), "from which times count"),
    Quantity("longitude_deg", lambda run: run.place[0], "of the patch's middle"),
    Quantity("latitude_deg", lambda run: run.place[1], "of the patch's middle"),
    Quantity("lines", lambda run: run.patch.images, "every line's image", record=LINE),
    Quantity("orthophoto", lambda run: run.patch.control.orthophoto, "grey values of the map", record=GEOREFERENCE),
    Quantity("dem", lambda run: run.patch.control.dem, "the elevation model", record=GEOREFERENCE),
    Quantity(
        "points", lambda run: run.points and run.points.sorts, "sort -> points measured in the images", record=POINTS
    ),
)


def camera_data(camera: ThreeLineCameraSpec) -> dict[str, Any]:
    """Interior orientation and mounting of every line, and how they make a look."""
    line: Record[str] = Record(
        "Interior orientation of a line and its mounting in the body.",
        Quantity("pixels", camera.pixels_of),
        Quantity("pitch_m", camera.pitch_of),
        Quantity("principal_distance_m", lambda name: camera.lines[name].principal_distance),
        Quantity("principal_point_m", lambda name: camera.lines[name].principal_point),
        Quantity("k1_per_m2", lambda name: camera.lines[name].k1),
        Quantity("k2_per_m4", lambda name: camera.lines[name].k2),
        Quantity(
            "camera_to_body",
            lambda name: about_axis(1, camera.lines[name].look) @ rotation_matrix(np.array(camera.lines[name].rotate)),
        ),
        Quantity("position_m", lambda name: camera.lines[name].position),
    )
    return {"name": camera.name, "look": _LOOK, "lines": {name: line(name) for name in camera.lines}}


def trajectory_data(run: Simulation, path: Trajectory) -> dict[str, Any]:
    """Orbit and attitude at the times of the pass's readings; between them the errors of a measured trajectory are the
    cubic spline that `twin.orbit.flight.trajectory` describes.

    Quaternions are (x, y, z, w); neighbours lie on one side, so that they can be joined.
    """
    errors = run.spec.errors
    fixes, looks = (
        times[in_span(times, path.first, path.last)]
        for times in (readings(path.first, path.last, one.interval) for one in (errors.gps, errors.star_tracker))
    )
    found: Record[Trajectory] = Record(
        "Orbit and attitude at readings.",
        Quantity("epoch_utc", lambda path: str(path.orbit.epoch)),
        Quantity("orbit_s", lambda path: fixes),
        Quantity("position_m", lambda path: path.position(fixes)),
        Quantity("velocity_m_per_s", lambda path: path.velocity(fixes)),
        Quantity("inertial_velocity_m_per_s", lambda path: path.inertial_velocity(fixes)),
        Quantity("attitude_s", lambda path: looks),
        Quantity(
            "quaternion",
            lambda path: joined_quaternions(Rotation.from_matrix(path.body_to_itrs(looks)).as_quat(canonical=False)),
        ),
    )
    return found(path)


def georeference_data(run: Simulation) -> dict[str, Any]:
    """Where the pixels of orthophoto and elevation model lie."""
    control = run.patch.control
    return {"orthophoto": GEOREFERENCE(control.orthophoto), "dem": GEOREFERENCE(control.dem)}


def _errors(one: point_judgement.LineJudgement) -> list[list[float | None]]:
    return [[float(v) if np.isfinite(v) else None for v in row] for row in one.error]


JUDGED: Record[point_judgement.LineJudgement] = Record(
    "Points of one sort in one line against the truth; RMS and mean of those that are not wrong.",
    *(Quantity(key, attrgetter(key)) for key in point_judgement.counts_of(())),
    Quantity("rms_lines_px", lambda one: one.rms[0], "root mean square error along the track"),
    Quantity("rms_pixels_px", lambda one: one.rms[1], "root mean square error along the line"),
    Quantity("mean_lines_px", lambda one: one.mean[0], "mean error along the track"),
    Quantity("mean_pixels_px", lambda one: one.mean[1], "mean error along the line"),
    Quantity("chi_square", lambda one: one.chi_square, "of their errors over their covariances"),
    Quantity("degrees_of_freedom", lambda one: one.degrees_of_freedom, "two for each place"),
    Quantity("error_px", _errors, "found minus true, lines and pixels, of every point"),
)
TRUE_POINTS: Record[tuple[Patch, MatchedPoints]] = Record(
    "True places of what the points of one sort show, in the order of points.csv.",
    Quantity("itrs_m", lambda of: point_judgement.true_ground(*of), "ITRS"),
    Quantity("lines", lambda of: point_judgement.judged(*of), "every line that was searched", record=JUDGED),
)


def _grid(shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Rows and columns of a grid over an image."""
    row, column = np.meshgrid(*(np.linspace(0.0, n - 1.0, _TRUE_POINTS) for n in shape), indexing="ij")
    return row.ravel(), column.ravel()


def _true_grid(patch: Patch, name: str) -> dict[str, Any]:
    """True places of a grid of a line's image."""
    row, column = _grid(patch.images[name].frame.shape)
    line, pixel = patch.images[name].image_point(row, column)
    return {"line": line, "pixel": pixel, "itrs_m": patch.true_point(name, row, column)}


def _control_error(patch: Patch) -> dict[str, Any]:
    """Error in plan of the control at a grid of the orthophoto."""
    photo = patch.control.orthophoto
    row, column = _grid(photo.values.shape)
    east, north = patch.control.error(*photo.east_north(row, column))
    return {"row": row, "column": column, "east_m": east, "north_m": north}


TRUTH: Record[Simulation] = Record(
    "What only the truth of a pass knows.",
    Quantity(
        "points",
        lambda run: run.points and {sort: (run.patch, one) for sort, one in run.points.sorts.items()},
        "sort -> true places, and the measured ones against them",
        record=TRUE_POINTS,
    ),
    Quantity("camera", lambda run: described("camera", camera_data(run.truth)), "as it is"),
    Quantity("trajectory", lambda run: described("trajectory", trajectory_data(run, run.trajectory)), "the true one"),
    Quantity(
        "ground_points",
        lambda run: {name: _true_grid(run.patch, name) for name in run.patch.images},
        "line -> true places of a grid of its image",
    ),
    Quantity("control_error", lambda run: _control_error(run.patch), "error in plan at a grid of the orthophoto"),
)
