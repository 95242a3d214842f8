"""A pass of th1 over 40 N 116 E for tests of its images, and grounds by formulas."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from scenes.specs.load import load_detector
from scenes.specs.orbit.flight import OrbitSpec
from scenes.specs.orbit.setup import load_three_line_camera
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import Attitude, Jitter, Trajectory
from twin.orbit.images.line_optics import LineOptics, optics_of
from twin.orbit.images.patch import ImagedLine, imaged_lines

LINES = ("forward", "nadir", "backward")
LINE_TIME = 0.7e-3
PLACE = (np.radians(116.0), np.radians(40.0))


@dataclass(frozen=True)
class Ground:
    """Apparent reflectance by a formula."""

    formula: Callable

    def __call__(self, east, north):
        return self.formula(east, north)


@cache
def lines() -> dict[str, ImagedLine]:
    """The three lines with light time, aberration and refraction; the user knows them exactly."""
    earth = Earth()
    passing = {"longitude": "116 deg", "latitude": "40 deg", "altitude": "500 km"}
    spec = {"epoch": "2011-03-05T03:05:00Z", "before": "45 s", "after": "45 s", "passing": passing}
    orbit = propagate(OrbitSpec.model_validate(spec), earth)
    trajectory = Trajectory(orbit, Attitude(yaw_steering=True, offset=(1e-4, -1.7e-4, 7e-5)))
    count = int(90.0 / LINE_TIME) - 1
    cameras = line_cameras(load_three_line_camera("th1"))
    sensors = {k: Sensor(cameras[k], trajectory, earth, LINE_TIME, -45.0 + 0.5 * LINE_TIME, count) for k in LINES}
    return imaged_lines(sensors, sensors, optics(), np.random.SeedSequence(1))


@cache
def optics() -> dict[str, LineOptics]:
    return optics_of(load_three_line_camera("th1"), LINES, LINE_TIME, {"th1_line": load_detector("th1_line")})


def lost() -> Sensor:
    """The nadir line turned so far that it looks past the Earth."""
    nadir = lines()["nadir"].sensor
    return replace(nadir, trajectory=replace(nadir.trajectory, attitude=Attitude(offset=(0.0, 1.4, 0.0))))


def shaken() -> Sensor:
    """The nadir line for 100 lines of a body that shakes a hundred times from line to line."""
    nadir, jitter = lines()["nadir"].sensor, Jitter(np.array([1.37e5]), np.full((1, 3), 1e-3), np.zeros((1, 3)))
    return replace(nadir, trajectory=replace(nadir.trajectory, jitter=jitter), first_line_time=0.0, lines=100)
