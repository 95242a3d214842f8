"""What a simulated pass leaves for other software, and for the truth alone, as plain data."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optics.geometry.pose import about_axis, rotation_matrix
from scenes.specs.three_line_camera import ThreeLineCameraSpec
from twin.orbit.flight.trajectory import Trajectory, readings
from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images.patch import LineImage
from twin.orbit.images.point_report import points_data, points_truth
from twin.orbit.images.simulate_run import Simulation
from twin.run.reference_frames import described

_TRUE_POINTS = 21
"""Along each side of the grid of true ground points."""


def to_dict(run: Simulation, seed: int) -> dict[str, Any]:
    """simulate.json: what the user of the images may know."""
    longitude, latitude = run.place
    return {
        "seed": seed,
        "epoch_utc": str(run.spec.orbit.epoch),
        "longitude_deg": float(np.degrees(longitude)),
        "latitude_deg": float(np.degrees(latitude)),
        "lines": {name: _line(image) for name, image in run.patch.images.items()},
        "orthophoto": georeference(run.patch.control.orthophoto),
        "dem": georeference(run.patch.control.dem),
        "points": points_data(run.points) if run.points is not None else None,
    }


def _line(image: LineImage) -> dict[str, Any]:
    window, sensor = image.window, image.measured
    first = sensor.time(np.array([window.first_line, window.first_line + window.lines - 1]))
    return {
        "first_line": window.first_line,
        "first_pixel": window.first_pixel,
        "lines": window.lines,
        "pixels": window.pixels,
        "first_line_time_s": float(first[0]),
        "last_line_time_s": float(first[1]),
        "line_time_s": sensor.line_time,
        "mean_dn": float(image.frame.mean()),
        "smallest_dn": int(image.frame.min()),
        "largest_dn": int(image.frame.max()),
        "rms_contrast": float(image.frame.std() / image.frame.mean()),
        "saturated_pixels": image.saturated,
        "sample_along_line_m": image.sample[0],
        "sample_along_track_m": image.sample[1],
        "mtf_nyquist_along_line": image.nyquist[0],
        "mtf_nyquist_along_track": image.nyquist[1],
        "advance_px_per_line": image.motion.advance,
        "drift_px_per_line": image.motion.drift,
        "geometry_error_px": image.error,
    }


def georeference(raster: Raster) -> dict[str, Any]:
    """Where a raster's pixels lie, exactly: longitude and latitude are linear in column and row."""
    frame = raster.frame
    per_longitude, per_latitude = frame.scale
    return {
        "rows": raster.values.shape[0],
        "columns": raster.values.shape[1],
        "spacing_m": raster.spacing,
        "first_longitude_deg": float(np.degrees(frame.longitude + raster.west / per_longitude)),
        "first_latitude_deg": float(np.degrees(frame.latitude + raster.north / per_latitude)),
        "longitude_per_column_deg": float(np.degrees(raster.spacing / per_longitude)),
        "latitude_per_row_deg": float(-np.degrees(raster.spacing / per_latitude)),
    }


def trajectory_data(trajectory: Trajectory, gps: float, star: float) -> dict[str, Any]:
    """Orbit and attitude at readings, every `gps` and `star` seconds; between them the errors of a measured trajectory
    are the cubic spline that `twin.orbit.flight.trajectory` describes.
    """
    fixes, looks = (_inside(readings(trajectory.first, trajectory.last, step), trajectory) for step in (gps, star))
    turn = Rotation.from_matrix(trajectory.body_to_itrs(looks)).as_quat(canonical=False)
    # neighbours lie on one side, so that they can be joined
    flip = np.cumprod(np.where(np.sum(turn[1:] * turn[:-1], axis=-1) < 0.0, -1.0, 1.0))
    turn[1:] *= flip[:, None]
    return {
        "epoch_utc": str(trajectory.orbit.epoch),
        "orbit_s": fixes.tolist(),
        "position_m": trajectory.position(fixes).tolist(),
        "velocity_m_per_s": trajectory.velocity(fixes).tolist(),
        "inertial_velocity_m_per_s": trajectory.inertial_velocity(fixes).tolist(),
        "attitude_s": looks.tolist(),
        "quaternion": turn.tolist(),
    }


def camera_data(camera: ThreeLineCameraSpec) -> dict[str, Any]:
    """Interior orientation and mounting of every line."""
    lines = {}
    for name, line in camera.lines.items():
        to_body = about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate))
        lines[name] = {
            "pixels": camera.pixels_of(name),
            "pitch_m": camera.pitch_of(name),
            "focal_length_m": line.focal_length,
            "principal_point_m": list(line.principal_point),
            "k1_per_m2": line.k1,
            "k2_per_m4": line.k2,
            "camera_to_body": to_body.tolist(),
            "position_m": list(line.position),
        }
    return {
        "name": camera.name,
        "look": (
            "y = (pixel - (pixels - 1)/2) pitch, r^2 = x0^2 + (y - y0)^2, d = k1 r^2 + k2 r^4; the look in camera axes "
            "is along (x0 (1 + d), -(y - y0)(1 + d), f); pixel 0 is the middle of the first"
        ),
        "lines": lines,
    }


def truth_data(run: Simulation) -> dict[str, Any]:
    """truth.json: the camera as it is, the true orbit and attitude, true places of a grid of each image, errors in plan
    of the control at a grid of its own; of measured points, in the order of points.csv, the true places of what they
    show and errors in the images.
    """
    errors, control, patch = run.spec.errors, run.patch.control, run.patch
    points = {}
    for name, image in patch.images.items():
        sides = [np.linspace(0.0, n - 1.0, _TRUE_POINTS) for n in image.frame.shape]
        row, column = (v.ravel() for v in np.meshgrid(*sides, indexing="ij"))
        line, pixel = image.image_point(row, column)
        points[name] = {
            "line": line.tolist(),
            "pixel": pixel.tolist(),
            "itrs_m": patch.true_point(name, row, column).tolist(),
        }
    raster = control.orthophoto
    sides = [np.linspace(0.0, n - 1.0, _TRUE_POINTS) for n in raster.values.shape]
    row, column = (v.ravel() for v in np.meshgrid(*sides, indexing="ij"))
    east, north = control.error(*raster.east_north(row, column))
    return {
        "points": points_truth(patch, run.points) if run.points is not None else None,
        "camera": described("camera", camera_data(run.truth)),
        "trajectory": described(
            "trajectory", trajectory_data(run.trajectory, errors.gps.interval, errors.star_tracker.interval)
        ),
        "ground_points": points,
        "control_error": {
            "row": row.tolist(),
            "column": column.tolist(),
            "east_m": east.tolist(),
            "north_m": north.tolist(),
        },
    }


def _inside(times: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    return times[(times >= trajectory.first) & (times <= trajectory.last)]
