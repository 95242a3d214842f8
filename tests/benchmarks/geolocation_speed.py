"""Geolocation grid: ground points of all pixels of a long image, all effects on."""

from __future__ import annotations

import math
import time

import numpy as np

from scenes.specs.orbit.flight import OrbitSpec
from scenes.specs.orbit.setup import load_three_line_camera
from tests.benchmarks.number import Limit, Number, Speed
from tests.benchmarks.workbench import Workbench
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.sensor import GeolocationGrid, Sensor
from twin.orbit.flight.trajectory import Trajectory

LINES, QUICK_LINES, PIXELS = 10_000, 400, 12_000
LIMIT_S = 10.0


def forward_sensor() -> Sensor:
    """th1's forward camera over 40 N 116 E."""
    earth = Earth()
    passing = {"longitude": "116 deg", "latitude": "40 deg", "altitude": "500 km"}
    orbit = propagate(OrbitSpec.model_validate({"epoch": "2012-06-01T03:00:00Z", "passing": passing}), earth)
    camera = line_cameras(load_three_line_camera("th1"))["forward"]
    return Sensor(camera, Trajectory(orbit), earth, 0.7e-3, 0.0, LINES)


def whole_image(model: Sensor, lines: int) -> int:
    """Numbers made, block by block; nothing is kept."""
    grid = GeolocationGrid.prepare(model)
    blocks = grid.blocks(np.arange(lines), np.arange(PIXELS))
    return sum(points.size for _, points in blocks if math.isfinite(points[0, 0, 0]))


def measure(bench: Workbench, quick: bool) -> Speed:
    """Points per second, the grid's preparation included."""
    model, lines = forward_sensor(), QUICK_LINES if quick else LINES
    begun = time.perf_counter()
    count = whole_image(model, lines)
    seconds = time.perf_counter() - begun
    assert count == 3 * lines * PIXELS
    return Speed(
        (
            Number("points_per_s", lines * PIXELS / seconds, f"geolocation, {lines} x {PIXELS} pixels", "points/s"),
            Number("seconds", seconds, "  all of them", "s", Limit(LIMIT_S)),
        )
    )
