"""A pass in files, once its conventions stand, as the tables that calibrations read."""

from __future__ import annotations

import numpy as np

from optics.numerics.frozen_map import FrozenMap
from scenes.yaml.errors import InputError, Issue
from twin.orbit.conventions.check_run import Check
from twin.orbit.conventions.reading_fit import line_of, line_times, pixel_of
from twin.orbit.flight.line_camera import LineTimes
from twin.orbit.measured.measurement_tables import campaign_files
from twin.orbit.measured.pass_measurements import ImagePoints, PassMeasurements
from twin.orbit.measured.platform_files import platform_table


def exported(run: Check) -> dict[str, str]:
    """Path -> text of a folder of measurements, in the project's own conventions.

    Raises:
        InputError: the stated conventions do not stand.
    """
    if run.verdict != "stands":
        problem = "nothing is exported of a pass whose stated conventions do not stand"
        raise InputError(Issue(problem, run.setup.test.source.file, allowed="conventions that `check` confirms"))
    return campaign_files([measurements(run)], run.setup.camera.plain())


def measurements(run: Check) -> PassMeasurements:
    """The pass as it is stated."""
    readings, meant = run.readings, run.stated
    table = platform_table(readings.platform, meant.platform)
    times, images = {}, {}
    for name, raw in readings.images.items():
        clock = readings.lines[name]
        middle, _ = line_times(clock, meant, table.epoch, clock.line)
        times[name] = LineTimes.of(clock.line - clock.line[0], middle)
        pixels = run.setup.camera.pixels_of(name)
        # a mirrored axis turns the sign of the correlation
        signs = np.array([-1.0 if meant.backward else 1.0, 1.0 if meant.sees == "right" else -1.0])
        spread = raw.covariance * signs[:, None] * signs
        line = line_of(meant, raw, clock) - clock.line[0]
        images[name] = ImagePoints.of(raw.point, line, pixel_of(meant, raw, pixels), spread)
    return PassMeasurements(run.setup.test.name, table, FrozenMap(times), readings.ground.points, FrozenMap(images))
