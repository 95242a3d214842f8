"""What jitter does to a line's image: where the image lies, and what blurs it.

The charge of a pixel follows the mean motion of the image. A pixel thus sees, all the while that its light is
collected, the place of its line, moved by the jitter of each moment. The mean place is that of the line's sensor with
the jitter in the mean of the collection; the image itself is the mean of images that are taken at the moments of a
Gaussian rule. So every line is displaced and blurred by its own jitter, from slow oscillations to those that are faster
than the collection.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import Jitter, Trajectory
from twin.orbit.images.line_optics import LineOptics
from twin.sensors.line_ccd import Collection

TOLERANCE = 1e-3
"""Pixels: of place and smear by the moments that are taken."""


def _jitter(sensor: Sensor) -> Jitter | None:
    jitter = sensor.trajectory.jitter if isinstance(sensor.trajectory, Trajectory) else None
    return jitter if isinstance(jitter, Jitter) else None


def _with(sensor: Sensor, jitter: Jitter | None) -> Sensor:
    assert isinstance(sensor.trajectory, Trajectory)
    return replace(sensor, trajectory=replace(sensor.trajectory, jitter=jitter))


def _collection(sensor: Sensor, optics: LineOptics) -> Collection:
    return Collection.of(optics.ccd.band.tdi, sensor.line_time)


def collected(sensor: Sensor, optics: LineOptics) -> Sensor:
    """The sensor of a line's image: a place is imaged where its light lies in the mean over its collection."""
    jitter = _jitter(sensor)
    return sensor if jitter is None else _with(sensor, jitter.over(_collection(sensor, optics)))


def steady(sensor: Sensor) -> Sensor:
    """The sensor without its jitter."""
    return sensor if _jitter(sensor) is None else _with(sensor, None)


def exposures(sensor: Sensor, optics: LineOptics) -> list[tuple[float, Sensor]]:
    """Shares of a pixel's light, which sum to 1, and the sensor at the moments that they stand for.

    Raises:
        ValueError: jitter that is too fast and too large.
    """
    jitter = _jitter(sensor)
    if jitter is None:
        return [(1.0, sensor)]
    slope = sensor.camera.look_and_slope(np.array([0.5 * (sensor.camera.pixels - 1)]))[1]
    found = jitter.exposures(_collection(sensor, optics), float(np.linalg.norm(slope)), TOLERANCE)
    return [(share, _with(sensor, one)) for share, one in found]
