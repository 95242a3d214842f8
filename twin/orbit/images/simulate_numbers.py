"""What a simulated pass leaves for other software, and for the truth alone, as plain data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optics.geometry.pose import about_axis, rotation_matrix
from scenes.specs.orbit_setup import SimulateSetup, resolve_simulate
from scenes.specs.three_line_camera import ThreeLineCameraSpec
from twin.orbit.flight.trajectory import Trajectory, readings
from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images.image_points import CONSENSUS, MatchedLine, PatchPoints, status_text
from twin.orbit.images.patch import LineImage, Patch
from twin.orbit.images.point_judgement import LineJudgement, judged, true_ground
from twin.orbit.images.simulate_run import Simulation, run_simulation
from twin.run.procedure import Procedure
from twin.run.reference_frames import described

_TRUE_POINTS = 21
"""Along each side of the grid of true ground points."""


def simulate_numbers(run: Simulation) -> dict[str, Any]:
    """Contents of simulate.json without its frames: what the user of the images may know."""
    longitude, latitude = run.place
    return {
        "seed": run.seed,
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


def points_data(points: PatchPoints) -> dict[str, Any]:
    """What the user knows, by sort and line."""
    out: dict[str, Any] = {}
    for sort, one in points.sorts.items():
        lines = {name: _matched(line) for name, line in one.lines.items() if name != one.source}
        out[sort] = {"sought": len(one.ground), "in_all_lines": int(one.in_all.sum()), "lines": lines}
    return out


def points_truth(patch: Patch, points: PatchPoints) -> dict[str, Any]:
    """What only the truth knows, by sort and line."""
    out: dict[str, Any] = {}
    for sort, one in points.sorts.items():
        lines = {name: _judged(line) for name, line in judged(patch, one).items()}
        out[sort] = {"itrs_m": true_ground(patch, one).tolist(), "lines": lines}
    return out


def reasons(line: MatchedLine) -> Mapping[str, int]:
    """Why points were not accepted, the most frequent first."""
    count = Counter(int(code) for code in line.status[~line.accepted])
    return {status_text(code): number for code, number in count.most_common()}


def median_way(line: MatchedLine) -> np.ndarray:
    """(2,) from predicted to found, median of the accepted, lines and pixels."""
    return np.asarray(np.median((line.place - line.predicted)[line.accepted], axis=0))


def median_sigma(line: MatchedLine) -> np.ndarray:
    """(2,) of lines and pixels, median of the accepted."""
    return np.asarray(np.median(np.sqrt(np.diagonal(line.covariance[line.accepted], axis1=1, axis2=2)), axis=0))


def _matched(line: MatchedLine) -> dict[str, Any]:
    way, sigma = median_way(line), median_sigma(line)
    return {
        "found": int(np.isfinite(line.place[:, 0]).sum()),
        "matched": int(line.matched.sum()),
        "accepted": int(line.accepted.sum()),
        "rejected_by_consensus": int((line.status == CONSENSUS).sum()),
        "not_accepted": dict(reasons(line)),
        "displacement_lines_px": float(way[0]),
        "displacement_pixels_px": float(way[1]),
        "sigma_lines_px": float(sigma[0]),
        "sigma_pixels_px": float(sigma[1]),
        "consensus_scatter_px": line.scatter,
    }


def _judged(one: LineJudgement) -> dict[str, Any]:
    error = [[float(v) if np.isfinite(v) else None for v in row] for row in one.error]
    return {
        "found": one.found,
        "matched": one.matched,
        "accepted": one.accepted,
        "wrong_found": one.wrong_found,
        "wrong_matched": one.wrong_matched,
        "wrong_accepted": one.wrong_accepted,
        "right_rejected_by_consensus": one.good_lost,
        "rms_lines_px": float(one.rms[0]),
        "rms_pixels_px": float(one.rms[1]),
        "mean_lines_px": float(one.mean[0]),
        "mean_pixels_px": float(one.mean[1]),
        "chi_square": one.chi_square,
        "degrees_of_freedom": one.degrees_of_freedom,
        "error_px": error,
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


SIMULATE = Procedure("simulate", SimulateSetup, resolve_simulate, run_simulation, simulate_numbers)
