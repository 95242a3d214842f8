"""What a simulated measurement of intersection angles was made from, as a folder of tables with a test file that reads
them back.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.yaml.units import MOMENT, format_quantity
from scenes.yaml.yaml_file import dump_yaml
from twin.orbit.angle.angle_flight import LEAST_SIGMA
from twin.orbit.angle.angle_run import AngleRun, SimulatedAngleRun
from twin.orbit.flight.light_effects import EARTH_RATE, NO_EFFECTS
from twin.orbit.flight.line_camera import LineTimes
from twin.orbit.flight.platform_table import PlatformTable
from twin.orbit.measured.measurement_tables import CAMERA_FILE, campaign_files
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements

TEST_FILE = "angle.yaml"
_LINE_TIME = 1e-3
"""Seconds. All points are seen in the one line of the moment, which one on either side gives a time."""
_SPAN, _READINGS = 20.0, 41
"""Seconds before and after the moment, as far as the orbit goes, and readings in them; one is at the moment."""
_IMAGE_SIGMA = 1e-6
"""Pixels: the errors of the points are those on the ground, and a table's sigmas must be positive."""


def angle_exported(run: AngleRun) -> dict[str, str]:
    """Path -> text of the files: the pass that is shown, with the errors that were drawn for it.

    Raises:
        InputError: the measurements are files already, or the lines are an instrument's, which no payload's file says.
    """
    test = run.setup.test
    if not isinstance(run, SimulatedAngleRun):
        text = "measurements are files already; --export writes those of a simulation"
        raise test.error(text, ("data",), allowed="the file of a simulated test")
    if run.setup.camera is None:
        text = "the lines of an instrument are traced, and no payload's file says where their pixels look"
        raise test.error(text, ("camera",), found=str(test.camera), allowed="a payload to export measurements of")
    files = campaign_files([_measurements(run)], run.setup.camera.plain())
    return files | {TEST_FILE: dump_yaml(_test(run))}


def _measurements(run: SimulatedAngleRun) -> PassMeasurements:
    """The shown pass before anything was taken out of its points."""
    flight, spec = run.flight, run.flight.spec
    raw = flight.measure(flight.ground(flight.effects), run.shown, NO_EFFECTS)
    station = raw.station.position
    path, moment = flight.trajectory, spec.time
    step = 2.0 * _SPAN / (_READINGS - 1)
    around = moment + step * (np.arange(_READINGS) - _READINGS // 2)
    times = around[(around >= path.first) & (around <= path.last)]
    if len(times) < 5:
        end = 0.9 * min(moment - path.first, path.last - moment)
        times = moment + end * np.linspace(-1.0, 1.0, 5)
    moved = station - path.position(moment)
    # aberration goes by the velocity against the stars, which an error of the place does not change
    velocity = path.velocity(times) - np.cross([0.0, 0.0, EARTH_RATE], moved)
    turn = Rotation.from_matrix(path.body_to_itrs(times)).as_quat(canonical=False)
    platform = PlatformTable.of(str(path.orbit.epoch), times, path.position(times) + moved, velocity, times, turn)
    line_times = LineTimes.of([0.0, 1.0, 2.0], moment + _LINE_TIME * np.array([-1.0, 0.0, 1.0]))
    ids = [f"{name}_{k}" for name in flight.lines for k in range(len(flight.pixel[name]))]
    ground = GroundPoints.of(
        ids,
        np.concatenate([raw.strips[name].points for name in flight.lines]),
        # the analysis adds its least sigma to all points
        max(spec.errors.points**2 - LEAST_SIGMA**2, 0.0) * np.eye(3),
        "control",
    )
    images, first = {}, 0
    for name in flight.lines:
        pixel = flight.pixel[name]
        images[name] = ImagePoints.of(
            first + np.arange(len(pixel)), np.ones(len(pixel)), pixel, _IMAGE_SIGMA**2 * np.eye(2)
        )
        first += len(pixel)
    return PassMeasurements(spec.name, platform, dict.fromkeys(flight.lines, line_times), ground, images)


def _test(run: SimulatedAngleRun) -> dict[str, Any]:
    """The test file: the same angles, moment, effects and sigmas."""
    spec = run.flight.spec
    plain = spec.plain()
    return {
        "name": spec.name,
        "description": spec.description,
        "camera": f"./{CAMERA_FILE}",
        "data": ".",
        "angles": {name: list(pair) for name, pair in run.flight.pairs.items()},
        "time": format_quantity(spec.time, MOMENT),
        "effects": plain["effects"],
        "errors": {
            "gps": {"noise": [plain["errors"]["station"]] * 3},
            "star_tracker": {"noise": ["0 arcsec"] * 3},
        },
    }
