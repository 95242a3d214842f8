"""What a simulated pass leaves beside its images, for other software and for the truth alone: camera, orbit and
attitude, georeference, truth; contents of artefacts/NAME.json without their frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from optics.geometry.pose import about_axis, rotation_matrix
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from twin.orbit.flight.platform_table import joined_quaternions
from twin.orbit.flight.trajectory import Trajectory, readings
from twin.orbit.images.image_points import MatchedPoints
from twin.orbit.images.patch import Patch
from twin.orbit.images.point_judgement import LineJudgement, MatchCounts, counts_of, judged, true_ground
from twin.orbit.images.simulate_numbers import Georeference
from twin.orbit.images.simulate_run import Simulation
from twin.run.plain_data import plain_data
from twin.run.reference_frames import described

Array = NDArray[np.float64]
_TRUE_POINTS = 21
"""Along each side of the grid of true ground points."""
_LOOK = (
    "y = (pixel - (pixels - 1)/2) pitch, r^2 = x0^2 + (y - y0)^2, d = k1 r^2 + k2 r^4; the look in camera axes "
    "is along (x0 (1 + d), -(y - y0)(1 + d), f); pixel 0 is the middle of the first"
)


@dataclass(frozen=True)
class CameraLine:
    """Interior orientation of a line and its mounting in the body."""

    pixels: int
    pitch_m: float
    focal_length_m: float
    principal_point_m: Sequence[float]
    k1_per_m2: float
    k2_per_m4: float
    camera_to_body: Array
    position_m: Sequence[float]

    @classmethod
    def of(cls, camera: ThreeLineCameraSpec, name: str) -> Self:
        """Of one line by name."""
        line = camera.lines[name]
        return cls(
            pixels=camera.pixels_of(name),
            pitch_m=camera.pitch_of(name),
            focal_length_m=line.focal_length,
            principal_point_m=line.principal_point,
            k1_per_m2=line.k1,
            k2_per_m4=line.k2,
            camera_to_body=about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate)),
            position_m=line.position,
        )


def camera_data(camera: ThreeLineCameraSpec) -> dict[str, Any]:
    """Interior orientation and mounting of every line, and how they make a look."""
    lines = {name: CameraLine.of(camera, name) for name in camera.lines}
    return dict(plain_data({"name": camera.name, "look": _LOOK, "lines": lines}))


@dataclass(frozen=True)
class TrajectoryReadings:
    """Orbit and attitude at readings; quaternions (x, y, z, w), neighbours on one side, so that they can be joined."""

    epoch_utc: str
    orbit_s: Array
    position_m: Array
    velocity_m_per_s: Array
    inertial_velocity_m_per_s: Array
    attitude_s: Array
    quaternion: Array

    @classmethod
    def of(cls, trajectory: Trajectory, gps: float, star: float) -> Self:
        """Every ``gps`` and ``star`` seconds."""
        fixes, looks = (_inside(readings(trajectory.first, trajectory.last, step), trajectory) for step in (gps, star))
        turn = joined_quaternions(Rotation.from_matrix(trajectory.body_to_itrs(looks)).as_quat(canonical=False))
        return cls(
            epoch_utc=str(trajectory.orbit.epoch),
            orbit_s=fixes,
            position_m=trajectory.position(fixes),
            velocity_m_per_s=trajectory.velocity(fixes),
            inertial_velocity_m_per_s=trajectory.inertial_velocity(fixes),
            attitude_s=looks,
            quaternion=turn,
        )


def _inside(times: Array, trajectory: Trajectory) -> Array:
    return times[(times >= trajectory.first) & (times <= trajectory.last)]


def trajectory_data(run: Simulation, trajectory: Trajectory) -> dict[str, Any]:
    """Orbit and attitude at the times of the pass's readings; between them the errors of a measured trajectory are the
    cubic spline that `twin.orbit.flight.trajectory` describes.
    """
    errors = run.spec.errors
    numbers = TrajectoryReadings.of(trajectory, errors.gps.interval, errors.star_tracker.interval)
    return dict(plain_data(numbers))


def georeference_data(run: Simulation) -> dict[str, Any]:
    """Of the orthophoto and the elevation model."""
    control = run.patch.control
    rasters = {"orthophoto": Georeference.of(control.orthophoto), "dem": Georeference.of(control.dem)}
    return dict(plain_data(rasters))


@dataclass(frozen=True)
class JudgedNumbers(MatchCounts):
    """Points of one sort in one line against the truth; RMS and mean of those that are not wrong."""

    rms_lines_px: float
    rms_pixels_px: float
    mean_lines_px: float
    mean_pixels_px: float
    chi_square: float
    degrees_of_freedom: int
    error_px: Sequence[Sequence[float | None]]

    @classmethod
    def of(cls, one: LineJudgement) -> Self:
        """Of one line."""
        return cls(
            **counts_of([one]),
            rms_lines_px=float(one.rms[0]),
            rms_pixels_px=float(one.rms[1]),
            mean_lines_px=float(one.mean[0]),
            mean_pixels_px=float(one.mean[1]),
            chi_square=one.chi_square,
            degrees_of_freedom=one.degrees_of_freedom,
            error_px=[[float(v) if np.isfinite(v) else None for v in row] for row in one.error],
        )


@dataclass(frozen=True)
class TruePoints:
    """True places of what the points of one sort show, in the order of points.csv."""

    itrs_m: Array
    lines: Mapping[str, JudgedNumbers]

    @classmethod
    def of(cls, patch: Patch, points: MatchedPoints) -> Self:
        """Of one sort."""
        lines = {name: JudgedNumbers.of(line) for name, line in judged(patch, points).items()}
        return cls(true_ground(patch, points), lines)


@dataclass(frozen=True)
class GroundPoints:
    """True places of a grid of a line's image."""

    line: Array
    pixel: Array
    itrs_m: Array

    @classmethod
    def of(cls, patch: Patch, name: str) -> Self:
        """Of one line by name."""
        image = patch.images[name]
        row, column = _grid(image.frame.shape)
        line, pixel = image.image_point(row, column)
        return cls(line, pixel, patch.true_point(name, row, column))


@dataclass(frozen=True)
class ControlError:
    """Error in plan of the control at a grid of the orthophoto."""

    row: Array
    column: Array
    east_m: Array
    north_m: Array

    @classmethod
    def of(cls, patch: Patch) -> Self:
        """Of a patch."""
        control = patch.control
        row, column = _grid(control.orthophoto.values.shape)
        east, north = control.error(*control.orthophoto.east_north(row, column))
        return cls(row, column, east, north)


def _grid(shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Rows and columns of a grid over an image."""
    row, column = np.meshgrid(*(np.linspace(0.0, n - 1.0, _TRUE_POINTS) for n in shape), indexing="ij")
    return row.ravel(), column.ravel()


@dataclass(frozen=True)
class SimulateTruth:
    """The camera as it is, the true orbit and attitude, true places, errors of the control."""

    points: Mapping[str, TruePoints] | None
    camera: Mapping[str, Any]
    trajectory: Mapping[str, Any]
    ground_points: Mapping[str, GroundPoints]
    control_error: ControlError

    @classmethod
    def of(cls, run: Simulation) -> Self:
        """Of a pass."""
        patch, points = run.patch, run.points
        return cls(
            points=None if points is None else {s: TruePoints.of(patch, one) for s, one in points.sorts.items()},
            camera=described("camera", camera_data(run.truth)),
            trajectory=described("trajectory", trajectory_data(run, run.trajectory)),
            ground_points={name: GroundPoints.of(patch, name) for name in patch.images},
            control_error=ControlError.of(patch),
        )


def truth_data(run: Simulation) -> dict[str, Any]:
    """What only the truth knows."""
    return dict(plain_data(SimulateTruth.of(run)))
