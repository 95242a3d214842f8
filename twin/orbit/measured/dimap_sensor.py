"""The scene of a DIMAP file as a sensor like all others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scenes.yaml.errors import InputError, Issue
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import polynomial_line
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.dimap_file import DimapPass, read_dimap
from twin.orbit.measured.platform_files import Conventions, PlatformReadings, platform_table

_ITRS = Conventions("ITRS", "UTC", "ITRS", "UTC", scalar="first", turns="body_to_frame")


@dataclass(frozen=True, eq=False)
class DimapScene:
    """A scene.

    Attributes:
        read: what its file says.
        sensor: the rigorous model; line 0 and pixel 0 are the format's row 1 and column 1.
        epoch: UTC from which the sensor's times count.
    """

    read: DimapPass
    sensor: Sensor
    epoch: str


def read_scene(path: str | Path, band: str | None = None, effects: LightEffects | None = None) -> DimapScene:
    """The scene of a DIMAP file.

    Args:
        path: of its file DIM_*.XML.
        band: whose looks are taken; may be left out where all bands have the same.
        effects: what happens to the light; None for refraction where the file says so, and nothing else.

    Raises:
        InputError: it cannot be read, or its orbit or attitude do not reach over the image.
    """
    read = read_dimap(path, band)
    readings = PlatformReadings(read.spanning_orbit(), read.samples(), None)
    table = platform_table(readings, _ITRS)
    trajectory = TabulatedTrajectory(table)
    first = float(read.first_line.instants("UTC").since(table.epoch)[0])
    if effects is None:
        effects = replace(NO_EFFECTS, refraction=read.refracted)
    camera = polynomial_line(read.name, read.pixels, read.forward, read.right)
    try:
        sensor = Sensor(camera, trajectory, Earth(), read.line_time, first, read.lines, effects)
    except ValueError as error:
        raise InputError(Issue(str(error), read.file, None, ("Refined_Model",), None, _REMEDY)) from None
    middle = 0.5 * (read.lines - 1), 0.5 * (read.pixels - 1)
    if not np.all(np.isfinite(sensor.ground(*(np.array([v]) for v in middle)))):
        problem = "the middle of the image does not look at the Earth"
        raise InputError(Issue(problem, read.file, None, ("Attitudes",), None, "quaternions with their scalar first"))
    return DimapScene(read, sensor, table.epoch)


_REMEDY = "ephemeris and attitudes from before the first line to after the last one"
