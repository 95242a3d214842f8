"""Errors on the ground due to errors of camera, orbit and attitude: covariances of points over a scene, CE90 and LE90.

The derivatives of the ground positions that pixels see with respect to each error are computed by finite differences of
the rigorous sensor, and propagate the covariances to the ground. A point seen by one line only needs a height from
another source. A point that several lines see is intersected from all of them, weighted by the covariance of its image
positions; the errors of orbit and attitude are those of the pass, which its lines share, and each line has its own
interior orientation.

`ground_sigma` propagates the uncertainty of a camera's change that was estimated in orbit. It is the error of the
exported models on the ground, which files of rational polynomials give as ERR_BIAS and ERR_RAND. A line is corrected
with the estimate; the derivatives with respect to the four elements of the change propagate the covariance of the
estimate's error to the horizontal plane of each point.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.orbit.forward_intersection import CalibratedLine, circular_error, linear_error
from optics.numerics.number_tree import FrozenMap
from twin.orbit.export.rational_polynomial import axis_sigma
from twin.orbit.flight.earth import east_north_up
from twin.orbit.flight.line_camera import LineCamera, corrected_line
from twin.orbit.flight.sensor import OffsetPlatform, Sensor

_GRID = (13, 13)
"""Number of lines and pixels of the grid over an image at which errors are computed; they vary smoothly."""
_SHIFT_STEP = 1.0
"""Step of the derivatives with respect to position, in metres."""
_ROTATION_STEP = 1e-6
"""Step of the derivatives with respect to rotation, in radians: about a metre on the ground, over which the ground
position is linear to 1e-6.
"""
_RAISED = 10.0
"""Step of the derivatives with respect to height, in metres."""
_EDGE = 0.5
"""Half step of the derivatives with respect to line and pixel, in pixels."""


@dataclass(frozen=True, eq=False)
class CameraUncertainty:
    """Covariances of a camera and its trajectory.

    Attributes
    ----------
    platform : (6, 6) ndarray
        Covariance of the position along X, Y, Z of the body, in metres, and of rotations about X, Y, Z of the body, in
        radians; constant over the pass and shared by its lines.
    interior : (3, 3) ndarray
        Covariance of line and pixel, in pixels, and of the relative principal distance; independent for each line.
    image : (2, 2) ndarray
        Covariance of a point's measured line and pixel, in pixels^2; independent for each point.
    height : float
        Standard deviation of the heights that points of one line have from another source, in metres.
    """

    platform: Array
    interior: Array
    image: Array
    height: float

    @classmethod
    def of(
        cls,
        position: float = 0.0,
        attitude: float = 0.0,
        interior: float = 0.0,
        scale: float = 0.0,
        image: float = 0.0,
        height: float = 0.0,
    ) -> CameraUncertainty:
        """Return the covariances of independent errors that are equal along, and about, all axes.

        Parameters
        ----------
        position : float
            Standard deviation along each axis, in metres.
        attitude : float
            Standard deviation about each axis, in radians.
        interior : float
            Standard deviation of line and pixel due to the interior orientation, in pixels.
        scale : float
            Relative standard deviation of the principal distance.
        image : float
            Standard deviation of a measured line and pixel, in pixels.
        height : float
            Standard deviation of heights from another source, in metres.
        """
        platform = np.diag([position**2] * 3 + [attitude**2] * 3)
        return cls(platform, np.diag([interior**2, interior**2, scale**2]), image**2 * np.eye(2), height)


@dataclass(frozen=True, eq=False)
class AccuracyMap:
    """Covariances of points on a grid over a scene.

    Attributes
    ----------
    line, pixel : (N,) ndarray for N grid points
        Image positions of the grid.
    longitude, latitude : (N,) ndarray
        Ground positions, in radians; NaN where a line of sight misses the Earth or fewer than two of several lines see
        the point.
    height : float
        Height of the ground above the ellipsoid, in metres.
    constant : (N, 3, 3) ndarray
        Covariance east, north and up of the errors that points share, in m^2.
    random : (N, 3, 3) ndarray
        Covariance of the errors that are independent from point to point, those of measured image positions, in m^2.
    heights : (N, 3, 3) ndarray
        Covariance due to errors of the heights that points of one line have from another source, which also move them
        in plan, in m^2.
    """

    line: Array
    pixel: Array
    longitude: Array
    latitude: Array
    height: float
    constant: Array
    random: Array
    heights: Array

    @property
    def covariance(self) -> Array:
        """Covariance of all errors of each of N points, east, north and up, (N, 3, 3), in m^2."""
        return self.constant + self.random + self.heights

    @property
    def ce90(self) -> Array:
        """Radius of the circle that holds 90 % of the horizontal errors of each of N points, (N,), in metres."""
        return self._where_seen(lambda c: circular_error(c[:, :2, :2]))

    @property
    def le90(self) -> Array:
        """Half width of the interval that holds 90 % of the vertical errors of each of N points, (N,), in metres."""
        return self._where_seen(lambda c: linear_error(c[:, 2, 2]))

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Mask of the N points that have a covariance, (N,): True where the lines of sight meet the ground."""
        return np.isfinite(self.longitude)

    def horizontal(self) -> tuple[float, float]:
        """Return the root mean square horizontal errors per axis, shared and random, in metres.

        Errors of heights from another source are excluded.
        """
        return axis_sigma(self.constant[self.valid, :2, :2]), axis_sigma(self.random[self.valid, :2, :2])

    def _where_seen(self, function) -> Array:  # type: ignore[no-untyped-def]
        values = np.full(len(self.line), np.nan)
        values[self.valid] = function(self.covariance[self.valid])
        return values


@dataclass(frozen=True, eq=False)
class _Derivatives:
    """Derivatives of the ground positions, east and north, in metres, that N pixels see at a fixed height.

    Attributes
    ----------
    image : (N, 2, 2) ndarray
        Derivatives with respect to line and pixel, in m per pixel.
    platform : (N, 2, 6) ndarray
        Derivatives with respect to position (m/m) and rotation (m/rad) of the platform.
    interior : (N, 2, 3) ndarray
        Derivatives with respect to line and pixel (m per pixel) and the relative principal distance (m).
    height : (N, 2) ndarray
        Derivatives with respect to the height, in m/m.
    """

    image: Array
    platform: Array
    interior: Array
    height: Array


def _derivatives(sensor: Sensor, line: Array, pixel: Array, height: float, level: Array) -> _Derivatives:
    def seen(at: Array, which: Array, up: float = height, moved: Array | None = None) -> Array:
        moved_sensor = sensor
        if moved is not None:
            moved_sensor = replace(sensor, trajectory=OffsetPlatform(sensor.trajectory, moved[:3], moved[3:]))
        return np.einsum("nij,nj->ni", level, moved_sensor.ground(at, which, up))

    by_line = (seen(line + _EDGE, pixel) - seen(line - _EDGE, pixel)) / (2.0 * _EDGE)
    by_pixel = (seen(line, pixel + _EDGE) - seen(line, pixel - _EDGE)) / (2.0 * _EDGE)
    columns = [
        (seen(line, pixel, moved=step) - seen(line, pixel, moved=-step)) / (2.0 * step.max())
        for step in np.diag([_SHIFT_STEP] * 3 + [_ROTATION_STEP] * 3)
    ]
    raised = (seen(line, pixel, height + _RAISED) - seen(line, pixel, height - _RAISED)) / (2.0 * _RAISED)
    # a longer principal distance moves the ground positions of pixels toward the line's middle
    from_middle = pixel - 0.5 * (sensor.camera.pixels - 1)
    interior = np.stack([by_line, by_pixel, -by_pixel * from_middle[:, None]], axis=-1)
    return _Derivatives(np.stack([by_line, by_pixel], axis=-1), np.stack(columns, axis=-1), interior, raised)


def _grid(sensor: Sensor, first_pixel: int, pixels: int) -> tuple[Array, Array]:
    """Return the lines and pixels of a grid of N points over an image, (N,) each."""
    line = np.linspace(min(0.0, 0.5 * (sensor.lines - 1)), sensor.lines - 1.0, _GRID[0])
    pixel = np.linspace(first_pixel, first_pixel + pixels - 1.0, _GRID[1])
    at, which = np.meshgrid(line, pixel, indexing="ij")
    return at.ravel(), which.ravel()


def single_accuracy(
    sensor: Sensor, uncertainty: CameraUncertainty, height: float, first_pixel: int = 0, pixels: int | None = None
) -> AccuracyMap:
    """Compute the errors of points of known height that one line locates.

    Parameters
    ----------
    sensor : Sensor
        Sensor of the line; its lines are those of the image.
    uncertainty : CameraUncertainty
        Uncertainty of camera and trajectory.
    height : float
        Height of the ground above the ellipsoid, in metres.
    first_pixel : int
        First pixel of the image on the line.
    pixels : int, optional
        Number of pixels of the image; None for the whole line.

    Raises
    ------
    ValueError
        No line of sight meets the Earth.
    """
    line, pixel = _grid(sensor, first_pixel, sensor.camera.pixels if pixels is None else pixels)
    longitude, latitude, level = _ground_positions(sensor, line, pixel, height)
    derivatives = _derivatives(sensor, line, pixel, height, level[:, :2])
    constant, random = np.zeros((2, len(line), 3, 3))
    constant[:, :2, :2] = _propagate(derivatives.platform, uncertainty.platform)
    constant[:, :2, :2] += _propagate(derivatives.interior, uncertainty.interior)
    tilt = np.concatenate([derivatives.height, np.ones((len(line), 1))], axis=1)
    heights = uncertainty.height**2 * tilt[:, :, None] * tilt[:, None, :]
    random[:, :2, :2] = _propagate(derivatives.image, uncertainty.image)
    return AccuracyMap(line, pixel, longitude, latitude, height, constant, random, heights)


def intersected_accuracy(
    sensors: Mapping[str, Sensor],
    uncertainty: CameraUncertainty,
    height: float,
    first_pixel: int = 0,
    pixels: int | None = None,
) -> AccuracyMap:
    """Compute the errors of points that are intersected from several lines of one pass.

    Parameters
    ----------
    sensors : Mapping[str, Sensor]
        Line -> its sensor; the grid covers the image of the first sensor.
    uncertainty : CameraUncertainty
        Uncertainty of camera and trajectory; heights from another source are not used.
    height : float
        Height of the ground above the ellipsoid, in metres.
    first_pixel : int
        First pixel of the first sensor's image on its line.
    pixels : int, optional
        Number of pixels of that image; None for the whole line.

    Raises
    ------
    ValueError
        There are fewer than two lines, no line of sight meets the Earth, or the images do not overlap.
    """
    if len(sensors) < 2:
        raise ValueError("an intersection needs two lines or more")
    first = next(iter(sensors.values()))
    line, pixel = _grid(first, first_pixel, first.camera.pixels if pixels is None else pixels)
    longitude, latitude, level = _ground_positions(first, line, pixel, height)
    ground = first.ground(line, pixel, height)
    count = len(line)
    weight = np.linalg.inv(uncertainty.image if np.any(uncertainty.image) else np.eye(2))
    normal, platform = np.zeros((count, 3, 3)), np.zeros((count, 3, 6))
    parts: list[tuple[NDArray[np.bool_], Array, Array]] = []
    views = np.zeros(count, dtype=int)
    for sensor in sensors.values():
        at, which = (line, pixel) if sensor is first else sensor.image(ground)
        inside = (at >= 0.0) & (at <= sensor.lines - 1.0) & (which >= 0.0) & (which <= sensor.camera.pixels - 1.0)
        if not np.any(inside):
            continue
        part = _derivatives(sensor, at[inside], which[inside], height, level[inside, :2])
        to_image = np.linalg.inv(part.image)
        # derivatives of image position by ground position, and by the errors there
        level_part = np.tile(np.eye(2), (len(part.height), 1, 1))
        by_ground = to_image @ np.concatenate([level_part, -part.height[:, :, None]], axis=2)
        weighted = np.swapaxes(by_ground, 1, 2) @ weight
        normal[inside] += weighted @ by_ground
        platform[inside] += weighted @ to_image @ part.platform
        parts.append((inside, weighted @ to_image @ part.interior, weighted))
        views += inside
    good = views >= 2
    if not np.any(good):
        raise ValueError("the images do not overlap on the ground")
    inverse = np.full((count, 3, 3), np.nan)
    inverse[good] = np.linalg.inv(normal[good])
    constant = _propagate(inverse @ platform, uncertainty.platform)
    random = np.zeros((count, 3, 3))
    for inside, interior, weighted in parts:
        constant[inside] += _propagate(inverse[inside] @ interior, uncertainty.interior)
        random[inside] += _propagate(inverse[inside] @ weighted, uncertainty.image)
    mask = np.where(good, 0.0, np.nan)
    return AccuracyMap(line, pixel, longitude + mask, latitude + mask, height, constant, random, np.zeros_like(random))


def _ground_positions(sensor: Sensor, line: Array, pixel: Array, height: float) -> tuple[Array, Array, Array]:
    """Return longitude and latitude (N,), in radians, that N pixels see, and east-north-up axes there (N, 3, 3)."""
    ground = sensor.ground(line, pixel, height)
    if not np.any(np.isfinite(ground)):
        raise ValueError("no line of sight meets the Earth")
    longitude, latitude, _ = sensor.earth.geodetic(ground)
    return longitude, latitude, east_north_up(longitude, latitude)


def _propagate(rows: Array, covariance: ArrayLike) -> Array:
    """Propagate a covariance of P errors by derivatives (N, K, P) to K quantities at N points, (N, K, K)."""
    return np.asarray(rows @ np.asarray(covariance) @ np.swapaxes(rows, 1, 2))


def accuracy_maps(
    sensors: Mapping[str, tuple[Sensor, int, int]], uncertainty: CameraUncertainty, height: float
) -> dict[str, AccuracyMap]:
    """Compute the accuracy map of each line and that of points intersected from all lines, `together`.

    The map of intersected points needs several lines whose images overlap.

    Parameters
    ----------
    sensors : Mapping[str, tuple[Sensor, int, int]]
        Line -> its sensor, and first pixel and number of pixels of its image.
    uncertainty : CameraUncertainty
        Uncertainty of camera and trajectory.
    height : float
        Height of the ground above the ellipsoid, in metres.

    Raises
    ------
    ValueError
        No line of sight meets the Earth.
    """
    maps = {name: single_accuracy(of, uncertainty, height, at, count) for name, (of, at, count) in sensors.items()}
    if len(sensors) > 1 and np.any(uncertainty.image):
        _, at, count = next(iter(sensors.values()))
        lines = FrozenMap({name: sensor for name, (sensor, _, _) in sensors.items()})
        try:
            maps[TOGETHER] = intersected_accuracy(lines, uncertainty, height, at, count)
        except ValueError:
            pass  # images of different ground; each line has its own map
    return maps


TOGETHER = "together"
"""Key, among the names of lines, of the accuracy map of points intersected from all lines."""


_STEPS = (1e-7, 1e-7, 1e-7, 1e-6)
"""Half steps of the derivatives with respect to a camera's rotations d_alpha, d_beta, d_gamma (rad) and change d_f of
the principal distance (m): centimetres on the ground, over which the ground position is linear to 1e-7, while its
coordinates are rounded to 1e-9 m.
"""
_CHANGE_GRID = (3, 9)
"""Number of lines and pixels of the grid over an image at which errors due to a camera's change are computed; they are
smooth along a line and hardly change along the track.
"""


@dataclass(frozen=True, eq=False)
class EstimatedChange:
    """Estimated change of a camera since its calibration.

    Attributes
    ----------
    values : (4,) ndarray
        Rotations d_alpha, d_beta, d_gamma (rad) and change d_f of the principal distance (m).
    constant : (4, 4) ndarray
        Covariance of the part of the values' error that persists from image to image.
    random : (4, 4) ndarray
        Covariance of the part of their error that is independent in every image.
    notes : tuple of str
        Remarks on the estimate, for export formats that allow remarks.
    """

    values: Array
    constant: Array
    random: Array
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroundSigma:
    """Horizontal error of ground points of known height, due to the error of a camera's estimated change alone.

    Orbit and attitude do not contribute. Values are root mean squares over the image.

    Attributes
    ----------
    height_m : float
        Height of the points above the ellipsoid, in metres.
    bias_m : float
        Error per horizontal axis that is shared with images near in time, in metres (ERR_BIAS of rational polynomials).
    random_m : float
        Error per horizontal axis that is independent in every image, in metres (ERR_RAND of rational polynomials).
    bias_east_m, bias_north_m : float
        Shared errors of the two axes, in metres, whose root mean square is ``bias_m``.
    random_east_m, random_north_m : float
        Independent errors of the two axes, in metres, whose root mean square is ``random_m``.
    """

    height_m: float
    bias_m: float
    random_m: float
    bias_east_m: float
    bias_north_m: float
    random_east_m: float
    random_north_m: float


def ground_rows(sensor: Sensor, calibrated: CalibratedLine, values: Array, height: float) -> Array:
    """Return derivatives of N ground positions, east and north, with respect to a camera's change, (N, 2, 4).

    The N points form a grid over the image. Derivatives are in metres per radian for the rotations d_alpha, d_beta and
    d_gamma, and in metres per metre for the change d_f of the principal distance.

    Parameters
    ----------
    sensor : Sensor
        Sensor with the corrected line.
    calibrated : CalibratedLine
        Line without the change.
    values : (4,) ndarray
        Values of the change.
    height : float
        Height of the ground above the ellipsoid, in metres.

    Raises
    ------
    ValueError
        A line of sight misses the Earth.
    """
    line = np.linspace(-0.5, sensor.lines - 0.5, _CHANGE_GRID[0])
    pixel = np.linspace(-0.5, sensor.camera.pixels - 0.5, _CHANGE_GRID[1])
    at, which = (v.ravel() for v in np.meshgrid(line, pixel, indexing="ij"))

    def seen(change: Array) -> Array:
        camera: LineCamera = corrected_line(sensor.camera, calibrated, change)
        return replace(sensor, camera=camera).ground(at, which, height)

    middle = seen(values)
    if not np.all(np.isfinite(middle)):
        raise ValueError("a line of sight misses the Earth")
    longitude, latitude, _ = sensor.earth.geodetic(middle)
    level = east_north_up(longitude, latitude)[:, :2]
    columns = [
        np.einsum("nij,nj->ni", level, seen(values + step) - seen(values - step)) / (2.0 * size)
        for size, step in zip(_STEPS, np.diag(_STEPS), strict=True)
    ]
    return np.stack(columns, axis=-1)


def ground_sigma(sensor: Sensor, calibrated: CalibratedLine, change: EstimatedChange, height: float) -> GroundSigma:
    """Return the horizontal error on the ground due to the error of a camera's estimated change.

    Parameters
    ----------
    sensor : Sensor
        Sensor with the corrected line.
    calibrated : CalibratedLine
        Line without the change.
    change : EstimatedChange
        Estimated change.
    height : float
        Height of the ground above the ellipsoid, in metres.

    Raises
    ------
    ValueError
        A line of sight misses the Earth.
    """
    rows = ground_rows(sensor, calibrated, change.values, height)
    spreads = [rows @ covariance @ np.swapaxes(rows, 1, 2) for covariance in (change.constant, change.random)]
    axes = [float(np.sqrt(np.mean(spread[:, k, k]))) for spread in spreads for k in (0, 1)]
    return GroundSigma(height, *map(axis_sigma, spreads), *axes)
