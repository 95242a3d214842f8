"""Export of a line sensor as image support data (ISD) of the community sensor model, for Ames Stereo Pipeline and ISIS.

The model is USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL: a station and a rotation over time, both interpolated by Lagrange
polynomials through eight nodes, and one camera with a distortion cubic in its coordinates, constant in time. It does
not model light time, aberration and refraction. The file therefore gets the camera and the attitude that reproduce the
apparent directions: at every node, the directions from the station to the ground positions that the rigorous sensor
sees at one height are compared with one common camera, and the rotation that fits them best is the attitude. Aberration
and light time are nearly the same at all heights and are almost fully included; refraction is included with its value
at that height only.

Conventions of the model: image coordinates count from the corner, the centre of the first pixel is (0.5, 0.5);
quaternions are w, x, y, z and rotate Earth-fixed axes into the camera's; the focal plane is in millimetres, x along the
flight and y along the line; the distortion maps ideal coordinates to real ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import erfa
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from analysis.arrays import Array
from twin.orbit.flight.earth import EQUATORIAL_RADIUS, FLATTENING, tai_of
from twin.orbit.flight.platform_table import continuous_quaternions
from twin.orbit.flight.sensor import Sensor

MODEL = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
"""Name of the community sensor model for line scanners that the files specify."""
_TICK = 2.0**-20
"""Time unit of which times of nodes are whole multiples, in seconds. A float64 holds such ephemeris times (seconds
since the year 2000) exactly, but decimal fractions only to 6e-8 s, a thousandth of a line.
"""
_SPARE = 6
"""Number of nodes of the trajectory beyond either end of the image."""
_FEWEST, _MOST = 64, 8192
_PIXELS = 33
"""Number of positions along the line at which directions are compared; between them, directions are interpolated to
1e-10 of a pixel.
"""
_ROUNDS = 4
"""Number of alternations between fitting the rotations at all nodes and the camera that they share."""
_CUBIC = (0, 2, 5, 9)
"""Indices of the terms 1, y, y^2 and y^3 among the ten coefficients of the sensor model's cubic distortion; a line has
no extent in x, so that the others are zero.
"""


@dataclass(frozen=True, eq=False)
class EffectiveCamera:
    """Camera and trajectory that see by straight rays the ground positions that a sensor sees at one height.

    Attributes
    ----------
    seconds : (N,) ndarray for N nodes
        Evenly spaced times of the nodes, on the trajectory's time scale.
    station : (N, 3) ndarray
        Projection centre, ITRS, in metres.
    velocity : (N, 3) ndarray
        Velocity of the projection centre, in m/s.
    rotation : Rotation
        Rotations from the camera's axes to the ITRS; X along the flight, Y along the line, Z toward the scene.
    focal_length : float
        Focal length, in metres.
    pitch : float
        Pixel pitch, in metres.
    pixels : int
        Number of pixels of the line.
    along : (4,) ndarray
        Coefficients of the powers 0 to 3 of the ideal position y along the line that give the real y, both in
        millimetres.
    across : (4,) ndarray
        Coefficients of the powers 0 to 3 of the ideal y that give the correction to be added to the ideal x of a point
        on the line so that x is 0, in millimetres.
    """

    seconds: Array
    station: Array
    velocity: Array
    rotation: Rotation
    focal_length: float
    pitch: float
    pixels: int
    along: Array
    across: Array

    def looks(self, pixel: Array) -> Array:
        """Return the (K, 3) unit directions of K positions on the line, in camera axes."""
        real = 1e3 * self.pitch * (np.asarray(pixel) - 0.5 * (self.pixels - 1))
        ideal = real.copy()
        slope = self.along[1:] * np.arange(1.0, len(self.along))
        for _ in range(_NEWTON):
            ideal = ideal - (_power(self.along, ideal) - real) / _power(slope, ideal)
        vector = np.stack([-_power(self.across, ideal), ideal, np.full_like(ideal, 1e3 * self.focal_length)], axis=-1)
        return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


_NEWTON = 12
"""Number of Newton steps that invert the lens distortion."""


def _power(coefficients: Array, at: Array) -> Array:
    return np.asarray(np.polynomial.polynomial.polyval(at, coefficients))


@dataclass(frozen=True)
class ModelError:
    """Largest difference of a model from the rigorous sensor over an image at one height.

    Attributes
    ----------
    height_m : float
        Height above the ellipsoid, in metres.
    sample_px : float
        Difference along the lines, in pixels.
    line_px : float
        Difference along the track, in pixels.
    """

    height_m: float
    sample_px: float
    line_px: float

    @property
    def worst_px(self) -> float:
        """Larger of the two differences, in pixels."""
        return max(self.sample_px, self.line_px)


@dataclass(frozen=True, eq=False)
class LineScanner:
    """ISD of a line, and its differences from the rigorous sensor.

    Attributes
    ----------
    isd : Mapping[str, Any]
        Content of the file, plain data.
    camera : EffectiveCamera
        Camera and trajectory that the file describes.
    errors : tuple of ModelError
        Differences at the heights that were requested.
    """

    isd: Mapping[str, Any]
    camera: EffectiveCamera
    errors: tuple[ModelError, ...]


def line_scanner(
    sensor: Sensor,
    name: str,
    epoch: str,
    pitch: float,
    heights: tuple[float, float, float],
    window: tuple[int, int] | None = None,
    notes: tuple[str, ...] = (),
) -> LineScanner:
    """Fit the image support data (ISD) of a line's image, or of a window of it.

    Parameters
    ----------
    sensor : Sensor
        Line camera on its trajectory; its image lines are those of the window, its camera is the whole line.
    name : str
        Name of the line.
    epoch : str
        UTC of the trajectory's second 0, ISO 8601.
    pitch : float
        Pixel pitch, in metres.
    heights : tuple of float
        Lowest, middle and highest ground above the ellipsoid, in metres; the model is fitted at the middle one.
    window : tuple of int, optional
        First pixel of the window on the line, and number of pixels; None for the whole line.
    notes : tuple of str
        Further remarks on the camera, to be written into the file.

    Raises
    ------
    ValueError
        A line of sight misses the Earth, or the trajectory is too rough for `_MOST` nodes.
    """
    camera = _effective_camera(sensor, pitch, heights[1], epoch)
    first, pixels = (0, camera.pixels) if window is None else window
    errors = tuple(_error(sensor, camera, height, (first, pixels)) for height in heights)
    isd = _isd(sensor, camera, name, epoch, heights, (first, pixels), errors)
    isd["notes"] += notes
    return LineScanner(isd, camera, errors)


def _effective_camera(sensor: Sensor, pitch: float, height: float, epoch: str) -> EffectiveCamera:
    """Return the camera that sees by straight rays the ground positions that a sensor sees at one height.

    Parameters
    ----------
    sensor : Sensor
        Line on its trajectory.
    pitch : float
        Pixel pitch, in metres.
    height : float
        Height above the ellipsoid, in metres.
    epoch : str
        UTC of the trajectory's second 0; only its fraction of a second matters.

    Raises
    ------
    ValueError
        A line of sight misses the Earth, or the trajectory is too rough for `_MOST` nodes.
    """
    count = _FEWEST
    while True:
        camera = _fit_camera(sensor, pitch, height, _nodes(sensor, count, epoch))
        if _smooth(camera):
            return camera
        count *= 2
        if count > _MOST:
            raise ValueError(f"{_MOST} nodes of the orbit and the attitude do not follow the trajectory")


def _ephemeris_time(epoch: str) -> tuple[int, float]:
    """Return the ephemeris time of an epoch (UTC), in seconds since noon of 2000-01-01, as integer and fraction.

    It is terrestrial time, which differs from barycentric time by at most 2 ms; only the position of the Sun depends on
    it.
    """
    day, part = tai_of(epoch)
    days = day - erfa.DJ00
    seconds = (days - np.floor(days)) * erfa.DAYSEC + part * erfa.DAYSEC + erfa.TTMTAI
    whole = int(np.floor(seconds))
    return int(np.floor(days)) * int(erfa.DAYSEC) + whole, float(seconds) - whole


def _nodes(sensor: Sensor, count: int, epoch: str) -> Array:
    """Return the times of N nodes, evenly spaced at whole ticks of ephemeris time, in seconds of the trajectory."""
    ends = sensor.time(np.array([-0.5, sensor.lines - 0.5]))
    step = max(np.ceil((ends[1] - ends[0]) / count / _TICK), 1.0) * _TICK
    fraction = _ephemeris_time(epoch)[1]
    first = np.floor((ends[0] + fraction) / _TICK) * _TICK - fraction - _SPARE * step
    times = first + step * np.arange(np.ceil((ends[1] - first) / step) + _SPARE + 1.0)
    return np.asarray(times[_known(sensor, times)])


def _known(sensor: Sensor, times: Array) -> NDArray[np.bool_]:
    """Return the mask of times that the trajectory covers."""

    def known(time: float) -> bool:
        try:
            sensor.trajectory.position(np.array([time]))
        except ValueError:
            return False
        return True

    # times within the image are always covered
    first, last = sensor.time(np.array([-0.5, sensor.lines - 0.5]))
    return np.array([first <= time <= last or known(time) for time in times])


def _fit_camera(sensor: Sensor, pitch: float, height: float, seconds: Array) -> EffectiveCamera:
    line = sensor.camera
    middle = np.array([0.5 * (line.pixels - 1)])
    pixel = 0.5 * (line.pixels - 1) * (1.0 - np.cos(np.pi * np.arange(_PIXELS) / (_PIXELS - 1.0)))
    station, directions = _directions(sensor, seconds, pixel, height)
    look, slope = line.look_and_slope(middle)
    z = look[0]
    y = slope[0] / np.linalg.norm(slope[0])
    axes = np.stack([np.cross(y, z), y, z], axis=-1)
    looks = line.look(pixel) @ axes
    rotations = np.empty((len(seconds), 3, 3))
    for _ in range(_ROUNDS):
        # the rotation that best takes the looks to the directions (Wahba's problem, by singular values)
        u, _, vt = np.linalg.svd(np.einsum("nki,kj->nij", directions, looks))
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        rotations = u @ vt
        looks = np.mean(np.einsum("nij,nki->nkj", rotations, directions), axis=0)
        looks = looks / np.linalg.norm(looks, axis=-1, keepdims=True)
    focal = pitch / float(np.linalg.norm(slope[0]))
    ideal = 1e3 * focal * looks[:, :2] / looks[:, 2:]
    real = 1e3 * pitch * (pixel - middle)
    basis = np.vander(ideal[:, 1], 4, increasing=True)
    scale = np.max(np.abs(basis), axis=0)
    along, across = (np.linalg.lstsq(basis / scale, side, rcond=None)[0] / scale for side in (real, -ideal[:, 0]))
    step = seconds[1] - seconds[0]
    velocity = np.gradient(station, step, axis=0, edge_order=2)
    rotation = Rotation.from_matrix(rotations)
    return EffectiveCamera(seconds, station, velocity, rotation, focal, pitch, line.pixels, along, across)


def _directions(sensor: Sensor, seconds: Array, pixel: Array, height: float) -> tuple[Array, Array]:
    """Return stations (N, 3) at N times, ITRS, and unit directions (N, K, 3) to what K pixels see at a height."""
    count = len(seconds)
    step = float(seconds[1] - seconds[0])
    trajectory = _AtNodes(sensor, seconds)
    nodes = replace(sensor, trajectory=trajectory, line_time=step, first_line_time=float(seconds[0]), lines=count)
    at, which = (v.ravel() for v in np.meshgrid(np.arange(float(count)), pixel, indexing="ij"))
    ground = nodes.ground(at, which, height).reshape(count, len(pixel), 3)
    if not np.all(np.isfinite(ground)):
        raise ValueError("a line of sight misses the Earth")
    middle = np.array([0.5 * (sensor.camera.pixels - 1)])
    to_itrs = sensor.trajectory.body_to_itrs(seconds)
    station = sensor.trajectory.position(seconds) + to_itrs @ sensor.camera.origin(middle)[0]
    arms = ground - station[:, None]
    return station, arms / np.linalg.norm(arms, axis=-1, keepdims=True)


def _lagrange(times: Array, values: Array, at: Array) -> Array:
    """Interpolate K quantities (N, K) at N evenly spaced nodes to M times, as the community sensor model does.

    It uses eight nodes, and fewer near the ends.
    """
    position = (np.asarray(at) - times[0]) / (times[1] - times[0])
    before = np.clip(np.floor(position).astype(int), 0, len(times) - 2)
    half = np.minimum(np.minimum(before + 1, len(times) - 1 - before), 4)
    share = position - before
    offsets = np.arange(-3, 5)
    used = (offsets > -half[:, None]) & (offsets <= half[:, None])
    interpolated = np.zeros((len(position), values.shape[1]))
    for k, offset in enumerate(offsets):
        others = np.delete(np.arange(8), k)
        factors = np.where(used[:, others], (share[:, None] - offsets[others]) / (offset - offsets[others]), 1.0)
        weight = np.where(used[:, k], np.prod(factors, axis=1), 0.0)
        interpolated += weight[:, None] * values[np.clip(before + offset, 0, len(times) - 1)]
    return interpolated


def _quaternions(rotation: Rotation) -> Array:
    """Return continuous quaternions (N, 4), x, y, z, w, of the rotations from the ITRS to the camera at N nodes."""
    return continuous_quaternions(rotation.inv().as_quat(canonical=False))


def _smooth(camera: EffectiveCamera) -> bool:
    """Return True if interpolation between every second node reproduces the other nodes to `_FOLLOWED` pixels.

    The interpolation between all nodes is then more accurate still.
    """
    coarse, between = camera.seconds[::2], camera.seconds[1:-1:2]
    inner = slice(_SPARE, -_SPARE) if len(between) > 4 * _SPARE else slice(None)
    station = _lagrange(coarse, camera.station[::2], between) - camera.station[1:-1:2]
    quaternion = _quaternions(camera.rotation)
    difference = _lagrange(coarse, quaternion[::2], between) - quaternion[1:-1:2]
    angle = 2.0 * np.max(np.linalg.norm(difference[inner], axis=-1))
    shift = np.max(np.linalg.norm(station[inner], axis=-1)) / _NEAREST
    return bool(angle + shift < _FOLLOWED * camera.pitch / camera.focal_length)


_FOLLOWED = 0.01
"""Largest accepted interpolation error of the trajectory between nodes, in pixels."""
_NEAREST = 2e5
"""Height of a satellite, in metres, with which a shift of the station is converted to an angle: a low one, for which
the angle is largest.
"""


def _error(sensor: Sensor, camera: EffectiveCamera, height: float, window: tuple[int, int]) -> ModelError:
    """Compare a camera with the rigorous sensor on an image grid other than that of the fit."""
    line = np.linspace(-0.5, sensor.lines - 0.5, _GRID[0])
    pixel = window[0] + np.linspace(-0.5, window[1] - 0.5, _GRID[1])
    at, which = (v.ravel() for v in np.meshgrid(line, pixel, indexing="ij"))
    ground = sensor.ground(at, which, height)
    if not np.all(np.isfinite(ground)):
        raise ValueError("a line of sight misses the Earth")
    seconds = sensor.time(at)
    now = _image(camera, seconds, ground)
    later = _image(camera, seconds + sensor.line_time, ground)
    # line on which the model sees the point, and sample there by the motion of the image
    lines = now[:, 0] / (now[:, 0] - later[:, 0])
    sample = now[:, 1] + lines * (later[:, 1] - now[:, 1]) - (which - 0.5 * (camera.pixels - 1))
    return ModelError(height, float(np.max(np.abs(sample))), float(np.max(np.abs(lines))))


_GRID = (37, 41)


def _image(camera: EffectiveCamera, seconds: Array, ground: Array) -> Array:
    """Project N ground points at given times: distance from the line and position along it, (N, 2), in pixels."""
    rotation = Rotation.from_quat(_lagrange(camera.seconds, _quaternions(camera.rotation), seconds))
    look = rotation.apply(ground - _lagrange(camera.seconds, camera.station, seconds))
    ideal = 1e3 * camera.focal_length * look[:, :2] / look[:, 2:]
    real = np.stack([ideal[:, 0] + _power(camera.across, ideal[:, 1]), _power(camera.along, ideal[:, 1])], axis=-1)
    return real / (1e3 * camera.pitch)


class _AtNodes:
    """Trajectory tabulated at its nodes only, for a sensor that also asks half a line beyond them, where it may end."""

    def __init__(self, sensor: Sensor, seconds: Array) -> None:
        self._known, self._first, self._last = sensor.trajectory, seconds[0], seconds[-1]

    def position(self, seconds: Array) -> Array:
        return self._known.position(np.clip(seconds, self._first, self._last))

    def inertial_velocity(self, seconds: Array) -> Array:
        return self._known.inertial_velocity(np.clip(seconds, self._first, self._last))

    def body_to_itrs(self, seconds: Array) -> Array:
        return self._known.body_to_itrs(np.clip(seconds, self._first, self._last))


def _isd(
    sensor: Sensor,
    camera: EffectiveCamera,
    name: str,
    epoch: str,
    heights: tuple[float, float, float],
    window: tuple[int, int],
    errors: tuple[ModelError, ...],
) -> dict[str, Any]:
    """Return the content of the image support data (ISD) file, as plain data."""
    whole, fraction = _ephemeris_time(epoch)
    ends = sensor.time(np.array([-0.5, sensor.lines - 0.5]))
    # ephemeris times at whole ticks from a whole second are exact
    middle = round(0.5 * float(ends[0] + ends[1]) + fraction)
    center = float(whole + middle)
    start = float(ends[0]) + fraction - middle
    nodes = (center + np.round((camera.seconds + fraction - middle) / _TICK) * _TICK).tolist()
    first = np.zeros(10)
    first[list(_CUBIC)] = camera.across
    first[1] = 1.0
    second = np.zeros(10)
    second[list(_CUBIC)] = camera.along
    quaternion = np.roll(_quaternions(camera.rotation), 1, axis=1)
    per_mm = 1e-3 / camera.pitch
    return {
        "isis_camera_version": 1,
        "image_identifier": f"{name} {epoch}",
        "name_model": MODEL,
        "name_platform": "space-camera-twin",
        "name_sensor": name,
        "image_lines": sensor.lines,
        "image_samples": window[1],
        "center_ephemeris_time": center,
        "starting_ephemeris_time": center + start,
        "line_scan_rate": [[0.5, start, sensor.line_time]],
        "detector_sample_summing": 1,
        "detector_line_summing": 1,
        "starting_detector_line": 0,
        "starting_detector_sample": window[0],
        "detector_center": {"line": 0.0, "sample": 0.5 * camera.pixels},
        "focal2pixel_lines": [0.0, per_mm, 0.0],
        "focal2pixel_samples": [0.0, 0.0, per_mm],
        "focal_length_model": {"focal_length": 1e3 * camera.focal_length},
        "interpolation_method": "lagrange",
        "optical_distortion": {"transverse": {"x": first.tolist(), "y": second.tolist()}},
        "radii": {
            "semimajor": 1e-3 * EQUATORIAL_RADIUS,
            "semiminor": 1e-3 * EQUATORIAL_RADIUS * (1.0 - FLATTENING),
            "unit": "km",
        },
        "reference_height": {"maxheight": heights[2], "minheight": heights[0], "unit": "m"},
        "instrument_position": {
            "unit": "km",
            "positions": (1e-3 * camera.station).tolist(),
            "velocities": (1e-3 * camera.velocity).tolist(),
            "ephemeris_times": nodes,
            "reference_frame": 1,
        },
        "instrument_pointing": _rotation_record(1, nodes, quaternion, _angular_velocity(camera)),
        "body_rotation": _rotation_record(
            2, nodes, np.tile([1.0, 0.0, 0.0, 0.0], (len(nodes), 1)), np.zeros((len(nodes), 3))
        ),
        "sun_position": {
            "unit": "km",
            "positions": [_sun(sensor, epoch, center).tolist()],
            "velocities": [[0, 0, 0]],
            "ephemeris_times": [center],
            "reference_frame": 1,
        },
        "notes": _notes(sensor, heights, errors),
    }


def _rotation_record(number: int, nodes: list[float], quaternion: Array, rate: Array) -> dict[str, Any]:
    """Return the ISD record of the rotations between frame 1 and frame -``number``, over the nodes."""
    return {
        "quaternions": quaternion.tolist(),
        "ephemeris_times": nodes,
        "angular_velocities": rate.tolist(),
        "reference_frame": 1,
        "time_dependent_frames": [-number, 1],
        "constant_frames": [-number],
        "constant_rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1],
    }


def _angular_velocity(camera: EffectiveCamera) -> Array:
    """Return the angular velocity of the camera relative to Earth-fixed axes, in these axes, (N, 3), in rad/s.

    It is computed at the N nodes of the trajectory.
    """
    step = camera.seconds[1] - camera.seconds[0]
    rate = (camera.rotation[1:] * camera.rotation[:-1].inv()).as_rotvec() / step
    return np.concatenate([rate[:1], 0.5 * (rate[1:] + rate[:-1]), rate[-1:]])


def _sun(sensor: Sensor, epoch: str, center: float) -> Array:
    """Return the position of the Sun at an ephemeris time, ITRS, in kilometres."""
    whole, fraction = _ephemeris_time(epoch)
    seconds = center - whole - fraction
    heliocentric = erfa.epv00(erfa.DJ00, center / erfa.DAYSEC)[0]["p"]
    rotation = sensor.earth.rotation(epoch, seconds, seconds).matrix(seconds)
    return np.asarray(rotation @ (-1e-3 * erfa.DAU * heliocentric))


def _notes(sensor: Sensor, heights: tuple[float, float, float], errors: tuple[ModelError, ...]) -> list[str]:
    """Return notes on conventions, on effects that the model cannot represent, and on its largest differences."""
    on = sensor.effects.names
    carried = (
        f"{', '.join(on)} are included in the attitude and the distortion, exactly at {heights[1]:g} m above the "
        "ellipsoid"
        if on
        else "no effects"
    )
    notes = [
        "Earth-fixed axes are those of the ITRS (WGS84), ephemeris times are terrestrial time; lines and samples count "
        "from the corner of the image, the centre of its first pixel is 0.5, 0.5.",
        f"Light: {carried}.",
    ]
    for error in errors:
        notes.append(
            f"Against the rigorous sensor, largest over the image at {error.height_m:g} m: {error.sample_px:.2g} "
            f"samples, {error.line_px:.2g} lines."
        )
    return notes
