"""What is estimated of a camera's change in orbit, and what is still uncertain of it: on the ground it is the error of
the exported models, which rational polynomials state as ERR_BIAS and ERR_RAND.

A line is corrected by the estimate. Each of the four numbers of the change is then moved a little, the rigorous sensor
is asked where the same pixels see the ground now, and these derivatives take the covariance of the estimate's error to
the horizontal plane of each point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from analysis.arrays import Array
from analysis.orbit.forward_intersection import CalibratedLine
from twin.orbit.export.rational_polynomial import axis_sigma
from twin.orbit.flight.earth import east_north_up
from twin.orbit.flight.line_camera import LineCamera, corrected_line
from twin.orbit.flight.sensor import Sensor

_STEPS = (1e-7, 1e-7, 1e-7, 1e-6)
"""Half steps of d_alpha, d_beta, d_gamma (rad) and d_f (m): centimetres on the ground, over which it is linear to 1e-7
and its coordinates are rounded to 1e-9 m."""
_GRID = (3, 9)
"""Lines and pixels of an image at which errors are taken; they are smooth along a line and hardly change along the
track."""


@dataclass(frozen=True, eq=False)
class EstimatedChange:
    """A camera's change since its calibration.

    Attributes:
        values: (4,) d_alpha, d_beta, d_gamma (rad) and d_f (m).
        constant: (4, 4) covariance of their error, as far as it goes on from image to image.
        random: (4, 4) covariance of what is another in every image.
        notes: on the estimate, for formats that hold remarks.
    """

    values: Array
    constant: Array
    random: Array
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroundSigma:
    """Horizontal error on the ground of points of known height that an image's model locates, root mean square over the
    image; the camera's change alone makes it, and not the orbit or the attitude.

    Attributes:
        height_m: of the points above the ellipsoid.
        bias_m: that other images near in time have as well, of each horizontal axis: ERR_BIAS.
        random_m: likewise of what is another in every image.
        bias_east_m, bias_north_m: the two axes, whose mean square is that of ``bias_m``.
        random_east_m, random_north_m: likewise of ``random_m``.
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

    Args:
        sensor: with the corrected line.
        calibrated: the line without the change.
        values: (4,) of the change.
        height: of the ground above the ellipsoid, metres.

    Raises:
        ValueError: a look misses the Earth.
    """
    line = np.linspace(-0.5, sensor.lines - 0.5, _GRID[0])
    pixel = np.linspace(-0.5, sensor.camera.pixels - 0.5, _GRID[1])
    at, which = (v.ravel() for v in np.meshgrid(line, pixel, indexing="ij"))

    def seen(change: Array) -> Array:
        camera: LineCamera = corrected_line(sensor.camera, calibrated, change)
        return replace(sensor, camera=camera).ground(at, which, height)

    middle = seen(values)
    if not np.all(np.isfinite(middle)):
        raise ValueError("a look misses the Earth")
    longitude, latitude, _ = sensor.earth.geodetic(middle)
    level = east_north_up(longitude, latitude)[:, :2]
    columns = [
        np.einsum("nij,nj->ni", level, seen(values + step) - seen(values - step)) / (2.0 * size)
        for size, step in zip(_STEPS, np.diag(_STEPS), strict=True)
    ]
    return np.stack(columns, axis=-1)


def ground_sigma(sensor: Sensor, calibrated: CalibratedLine, change: EstimatedChange, height: float) -> GroundSigma:
    """What the error of an estimated change is on the ground.

    Args:
        sensor: with the corrected line.
        calibrated: the line without the change.
        change: that is estimated.
        height: of the ground above the ellipsoid, metres.

    Raises:
        ValueError: a look misses the Earth.
    """
    rows = ground_rows(sensor, calibrated, change.values, height)
    spreads = [rows @ covariance @ np.swapaxes(rows, 1, 2) for covariance in (change.constant, change.random)]
    axes = [float(np.sqrt(np.mean(spread[:, k, k]))) for spread in spreads for k in (0, 1)]
    return GroundSigma(height, *map(axis_sigma, spreads), *axes)
