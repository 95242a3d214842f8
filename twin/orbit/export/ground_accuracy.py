"""What errors of camera, orbit and attitude are on the ground: covariances of points over a scene, CE90 and LE90.

The rigorous sensor is asked where pixels see the ground after each error was given a little; these derivatives take the
covariances to the ground. A point of one line has a height from elsewhere. A point that several lines see is
intersected from all of them, weighted by the covariance of its places in the images; the errors of orbit and attitude
are those of the pass, which its lines have in common, and each line has its own interior.

What is estimated of a camera's change in orbit, and what is still uncertain of it: on the ground it is the error of
the exported models, which rational polynomials state as ERR_BIAS and ERR_RAND.

A line is corrected by the estimate. Each of the four numbers of the change is then moved a little, the rigorous sensor
is asked where the same pixels see the ground now, and these derivatives take the covariance of the estimate's error to
the horizontal plane of each point.
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
"""Lines and pixels of an image at which errors are taken; they are smooth."""
_MOVED = 1.0
_TURNED = 1e-6
"""Steps of derivatives, metres and radians: metres on the ground, over which it is straight to 1e-6."""
_RAISED = 10.0
"""Metres."""
_EDGE = 0.5
"""Pixels and lines: half a step, and from the image's edge."""


@dataclass(frozen=True, eq=False)
class CameraUncertainty:
    """What is uncertain of a camera and of its way, as covariances.

    Attributes
    ----------
    platform : Array
        (6, 6) of the position along X, Y, Z of the body, metres, and of turns about X, Y, Z of the body, radians;
        constant over the pass and shared by its lines.
    interior : Array
        (3, 3) of line and pixel, pixels, and of the principal distance, relative; of each line on its own.
    image : Array
        (2, 2) of a point's measured line and pixel, pixels^2; another in every point.
    height : float
        Standard deviation of the heights that points of one line have from elsewhere, metres.
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
        """Independent errors, alike along and about all axes.

        Parameters
        ----------
        position : float
            Standard deviation along each axis, metres.
        attitude : float
            About each axis, radians.
        interior : float
            Of line and pixel, pixels.
        scale : float
            Of the principal distance, relative.
        image : float
            Of a measured line and pixel, pixels.
        height : float
            Of heights from elsewhere, metres.
        """
        platform = np.diag([position**2] * 3 + [attitude**2] * 3)
        return cls(platform, np.diag([interior**2, interior**2, scale**2]), image**2 * np.eye(2), height)


@dataclass(frozen=True, eq=False)
class AccuracyMap:
    """Covariances of points over a scene.

    Attributes
    ----------
    line, pixel : Array
        (N,) of the grid, in the image that it is of.
    longitude, latitude : Array
        (N,) radians; NaN where a line of sight misses the Earth or, of several lines, fewer than two see.
    height : float
        Of the ground above the ellipsoid, metres.
    constant : Array
        (N, 3, 3) to the east, to the north and up, m^2, of what points have in common.
    random : Array
        (N, 3, 3) of what is another in every point: its measured places.
    heights : Array
        (N, 3, 3) of the heights that points of one line have from elsewhere, which move them in plan as well.
    shape : tuple[int, int]
        Of the grid.
    """

    line: Array
    pixel: Array
    longitude: Array
    latitude: Array
    height: float
    constant: Array
    random: Array
    heights: Array
    shape: tuple[int, int]

    @property
    def covariance(self) -> Array:
        """(N, 3, 3) of a point, m^2."""
        return self.constant + self.random + self.heights

    @property
    def ce90(self) -> Array:
        """(N,) radius of the circle that holds 90 % of the horizontal errors, metres."""
        return self._where_seen(lambda c: circular_error(c[:, :2, :2]))

    @property
    def le90(self) -> Array:
        """(N,) half width of the interval that holds 90 % of the vertical errors, metres."""
        return self._where_seen(lambda c: linear_error(c[:, 2, 2]))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N,) where there is a covariance."""
        return np.isfinite(self.longitude)

    def horizontal(self) -> tuple[float, float]:
        """Root mean square errors of a horizontal axis over the scene, metres: of what points have in common, and of
        their measured places; without heights from elsewhere.
        """
        return axis_sigma(self.constant[self.seen, :2, :2]), axis_sigma(self.random[self.seen, :2, :2])

    def _where_seen(self, function) -> Array:  # type: ignore[no-untyped-def]
        found = np.full(len(self.line), np.nan)
        found[self.seen] = function(self.covariance[self.seen])
        return found


@dataclass(frozen=True, eq=False)
class _Derivatives:
    """Of where pixels (N,) see a height, east and north, metres.

    Attributes
    ----------
    place : Array
        (N, 2, 2) by line and pixel.
    platform : Array
        (N, 2, 6) by the errors of the platform.
    interior : Array
        (N, 2, 3) by those of the interior.
    height : Array
        (N, 2) by the height.
    """

    place: Array
    platform: Array
    interior: Array
    height: Array


def _derivatives(sensor: Sensor, line: Array, pixel: Array, height: float, level: Array) -> _Derivatives:
    def seen(at: Array, which: Array, up: float = height, moved: Array | None = None) -> Array:
        where = sensor
        if moved is not None:
            where = replace(sensor, trajectory=OffsetPlatform(sensor.trajectory, moved[:3], moved[3:]))
        return np.einsum("nij,nj->ni", level, where.ground(at, which, up))

    by_line = (seen(line + _EDGE, pixel) - seen(line - _EDGE, pixel)) / (2.0 * _EDGE)
    by_pixel = (seen(line, pixel + _EDGE) - seen(line, pixel - _EDGE)) / (2.0 * _EDGE)
    columns = []
    for k in range(6):
        step = _MOVED if k < 3 else _TURNED
        move = np.zeros(6)
        move[k] = step
        columns.append((seen(line, pixel, moved=move) - seen(line, pixel, moved=-move)) / (2.0 * step))
    raised = (seen(line, pixel, height + _RAISED) - seen(line, pixel, height - _RAISED)) / (2.0 * _RAISED)
    # a longer principal distance draws what pixels see toward the line's middle
    from_middle = pixel - 0.5 * (sensor.camera.pixels - 1)
    interior = np.stack([by_line, by_pixel, -by_pixel * from_middle[:, None]], axis=-1)
    return _Derivatives(np.stack([by_line, by_pixel], axis=-1), np.stack(columns, axis=-1), interior, raised)


def _grid(sensor: Sensor, first_pixel: int, pixels: int) -> tuple[Array, Array]:
    """Lines and pixels (N,) over an image."""
    line = np.linspace(min(0.0, 0.5 * (sensor.lines - 1)), sensor.lines - 1.0, _GRID[0])
    pixel = np.linspace(first_pixel, first_pixel + pixels - 1.0, _GRID[1])
    at, which = np.meshgrid(line, pixel, indexing="ij")
    return at.ravel(), which.ravel()


def single_accuracy(
    sensor: Sensor, uncertainty: CameraUncertainty, height: float, first_pixel: int = 0, pixels: int | None = None
) -> AccuracyMap:
    """Errors of points of known height that one line locates.

    Parameters
    ----------
    sensor : Sensor
        Of the line; its lines are those of the image.
    uncertainty : CameraUncertainty
        Of camera and way.
    height : float
        Of the ground above the ellipsoid, metres.
    first_pixel : int
        Of the image on the line.
    pixels : int | None
        Of the image; None for the whole line.

    Raises
    ------
    ValueError
        No look meets the Earth.
    """
    line, pixel = _grid(sensor, first_pixel, sensor.camera.pixels if pixels is None else pixels)
    longitude, latitude, level = _places(sensor, line, pixel, height)
    found = _derivatives(sensor, line, pixel, height, level[:, :2])
    constant, random = np.zeros((2, len(line), 3, 3))
    constant[:, :2, :2] = _taken(found.platform, uncertainty.platform) + _taken(found.interior, uncertainty.interior)
    tilt = np.concatenate([found.height, np.ones((len(line), 1))], axis=1)
    heights = uncertainty.height**2 * tilt[:, :, None] * tilt[:, None, :]
    random[:, :2, :2] = _taken(found.place, uncertainty.image)
    return AccuracyMap(line, pixel, longitude, latitude, height, constant, random, heights, _GRID)


def intersected_accuracy(
    sensors: Mapping[str, Sensor],
    uncertainty: CameraUncertainty,
    height: float,
    first_pixel: int = 0,
    pixels: int | None = None,
) -> AccuracyMap:
    """Errors of points that several lines of one pass see and that are intersected from them.

    Parameters
    ----------
    sensors : Mapping[str, Sensor]
        Line -> its sensor; the grid is that of the first one's image.
    uncertainty : CameraUncertainty
        Of camera and way; heights from elsewhere are not used.
    height : float
        Of the ground above the ellipsoid, metres.
    first_pixel : int
        Of the first one's image on its line.
    pixels : int | None
        Of it; None for the whole line.

    Raises
    ------
    ValueError
        Fewer than two lines, no look meets the Earth, images that nowhere show the same ground.
    """
    if len(sensors) < 2:
        raise ValueError("an intersection takes two lines or more")
    first = next(iter(sensors.values()))
    line, pixel = _grid(first, first_pixel, first.camera.pixels if pixels is None else pixels)
    longitude, latitude, level = _places(first, line, pixel, height)
    ground = first.ground(line, pixel, height)
    count = len(line)
    weight = np.linalg.inv(uncertainty.image if np.any(uncertainty.image) else np.eye(2))
    normal, platform = np.zeros((count, 3, 3)), np.zeros((count, 3, 6))
    own: list[tuple[NDArray[np.bool_], Array, Array]] = []
    views = np.zeros(count, dtype=int)
    for sensor in sensors.values():
        at, which = (line, pixel) if sensor is first else sensor.image(ground)
        held = (at >= 0.0) & (at <= sensor.lines - 1.0) & (which >= 0.0) & (which <= sensor.camera.pixels - 1.0)
        if not np.any(held):
            continue
        part = _derivatives(sensor, at[held], which[held], height, level[held, :2])
        to_image = np.linalg.inv(part.place)
        # a point's place in the image by its place on the ground, and by the errors at that place
        by_ground = to_image @ np.concatenate(
            [np.tile(np.eye(2), (int(np.sum(held)), 1, 1)), -part.height[:, :, None]], axis=2
        )
        turned = np.swapaxes(by_ground, 1, 2) @ weight
        normal[held] += turned @ by_ground
        platform[held] += turned @ to_image @ part.platform
        own.append((held, turned @ to_image @ part.interior, turned))
        views += held
    good = views >= 2
    if not np.any(good):
        raise ValueError("the images nowhere show the same ground")
    inverse = np.full((count, 3, 3), np.nan)
    inverse[good] = np.linalg.inv(normal[good])
    constant = _taken(inverse @ platform, uncertainty.platform)
    random = np.zeros((count, 3, 3))
    for held, interior, turned in own:
        constant[held] += _taken(inverse[held] @ interior, uncertainty.interior)
        random[held] += _taken(inverse[held] @ turned, uncertainty.image)
    nowhere = np.where(good, 0.0, np.nan)
    none = np.zeros_like(random)
    return AccuracyMap(line, pixel, longitude + nowhere, latitude + nowhere, height, constant, random, none, _GRID)


def _places(sensor: Sensor, line: Array, pixel: Array, height: float) -> tuple[Array, Array, Array]:
    """Longitude and latitude (N,) that pixels see, and the level frame there (N, 3, 3)."""
    ground = sensor.ground(line, pixel, height)
    if not np.any(np.isfinite(ground)):
        raise ValueError("no look meets the Earth")
    longitude, latitude, _ = sensor.earth.geodetic(ground)
    return longitude, latitude, east_north_up(longitude, latitude)


def _taken(rows: Array, covariance: ArrayLike) -> Array:
    """(N, K, K) covariances of what has these derivatives (N, K, P)."""
    return np.asarray(rows @ np.asarray(covariance) @ np.swapaxes(rows, 1, 2))


def maps_of(
    sensors: Mapping[str, tuple[Sensor, int, int]], uncertainty: CameraUncertainty, height: float
) -> dict[str, AccuracyMap]:
    """The map of each line by itself and, of several whose images overlap, of points that are intersected, `together`.

    Parameters
    ----------
    sensors : Mapping[str, tuple[Sensor, int, int]]
        Line -> its sensor, and first pixel and number of pixels of its image.
    uncertainty : CameraUncertainty
        Of camera and way.
    height : float
        Of the ground above the ellipsoid, metres.

    Raises
    ------
    ValueError
        No look meets the Earth.
    """
    found = {name: single_accuracy(one, uncertainty, height, at, count) for name, (one, at, count) in sensors.items()}
    if len(sensors) > 1 and np.any(uncertainty.image):
        _, at, count = next(iter(sensors.values()))
        try:
            found[TOGETHER] = intersected_accuracy(
                FrozenMap({name: one for name, (one, _, _) in sensors.items()}), uncertainty, height, at, count
            )
        except ValueError:
            pass  # images of different ground; each line has its own map
    return found


TOGETHER = "together"
"""Name of the map of intersected points."""


_STEPS = (1e-7, 1e-7, 1e-7, 1e-6)
"""Half steps of d_alpha, d_beta, d_gamma (rad) and d_f (m): centimetres on the ground, over which it is linear to 1e-7
and its coordinates are rounded to 1e-9 m."""
_CHANGE_GRID = (3, 9)
"""Lines and pixels of an image at which errors are taken; they are smooth along a line and hardly change along the
track."""


@dataclass(frozen=True, eq=False)
class EstimatedChange:
    """A camera's change since its calibration.

    Attributes
    ----------
    values : Array
        (4,) d_alpha, d_beta, d_gamma (rad) and d_f (m).
    constant : Array
        (4, 4) covariance of their error, as far as it goes on from image to image.
    random : Array
        (4, 4) covariance of what is another in every image.
    notes : tuple[str, ...]
        On the estimate, for formats that hold remarks.
    """

    values: Array
    constant: Array
    random: Array
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroundSigma:
    """Horizontal error on the ground of points of known height that an image's model locates, root mean square over the
    image; the camera's change alone makes it, and not the orbit or the attitude.

    Attributes
    ----------
    height_m : float
        Of the points above the ellipsoid.
    bias_m : float
        That other images near in time have as well, of each horizontal axis: ERR_BIAS.
    random_m : float
        Likewise of what is another in every image.
    bias_east_m, bias_north_m : float
        The two axes, whose mean square is that of ``bias_m``.
    random_east_m, random_north_m : float
        Likewise of ``random_m``.
    """

    height_m: float
    bias_m: float
    random_m: float
    bias_east_m: float
    bias_north_m: float
    random_east_m: float
    random_north_m: float


def ground_rows(sensor: Sensor, calibrated: CalibratedLine, values: Array, height: float) -> Array:
    """Derivatives of where pixels over an image see the ground by their camera's change, (N, 2, 4): east and north in
    metres per rad and per metre of principal distance.

    Parameters
    ----------
    sensor : Sensor
        With the corrected line.
    calibrated : CalibratedLine
        The line without the change.
    values : Array
        (4,) of the change.
    height : float
        Of the ground above the ellipsoid, metres.

    Raises
    ------
    ValueError
        a line of sight misses the Earth.
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
    """Return the error of an estimated change on the ground.

    Parameters
    ----------
    sensor : Sensor
        With the corrected line.
    calibrated : CalibratedLine
        The line without the change.
    change : EstimatedChange
        That is estimated.
    height : float
        Of the ground above the ellipsoid, metres.

    Raises
    ------
    ValueError
        a line of sight misses the Earth.
    """
    rows = ground_rows(sensor, calibrated, change.values, height)
    spreads = [rows @ covariance @ np.swapaxes(rows, 1, 2) for covariance in (change.constant, change.random)]
    axes = [float(np.sqrt(np.mean(spread[:, k, k]))) for spread in spreads for k in (0, 1)]
    return GroundSigma(height, *map(axis_sigma, spreads), *axes)
