"""Passes whose orbit, attitude and lines end together, or not: a legal one has a sensor that is right, another one is
refused, and neither is decided by rounding.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.specs.orbit.setup import load_three_line_camera
from tests.hunt.hunt import BAD_REFUSAL, REFUSED, RIGHT, WRONG_READING, Outcome
from tests.twin.orbit_bench import CirclePlatform
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import LineCamera, LineTimes, line_cameras
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.flight.sensor import NO_EFFECTS, Sensor

_AGREE = 1e-3
"""Metres: splines through readings up to 2 s apart are good to 1e-4 m, also half a microsecond beyond their ends."""


def span_hunt(first: int, cases: int) -> Iterator[Outcome]:
    """What becomes of the cases from a first one on."""
    camera = line_cameras(load_three_line_camera("th1"))["nadir"]
    return (_case(number, camera) for number in range(first, first + cases))


def _case(number: int, camera: LineCamera) -> Outcome:
    random = np.random.default_rng([41, number])
    circle = CirclePlatform(span=(-np.inf, np.inf))
    begin = round(float(random.uniform(-1.0, 1.0) * 10.0 ** random.uniform(0.0, 5.0)), 6)
    line_time, lines = round(float(random.uniform(5e-5, 2e-3)), 10), int(random.integers(2, 10_000))
    end = round(begin + lines * line_time, 6)  # as a file writes it
    tables, missing = [], 0.0
    for _ in range(2):
        # beyond an end, with it, or short of it by more than a rounding
        short = -3.0 * 10.0 ** random.uniform(-6.0, -3.0, 2)
        beyond = [random.choice([random.uniform(0.5, 9.0), 0.0, 0.0, one]) for one in short]
        missing = max(missing, *(-one for one in beyond))
        a, b = round(begin - float(beyond[0]), 6), round(end + float(beyond[1]), 6)
        tables.append(np.linspace(a, b, max(12, int((b - a) / 2.0) + 2)))
    turn = Rotation.from_matrix(circle.body_to_itrs(tables[1])).as_quat(canonical=False)
    place = circle.position(tables[0])
    path = TabulatedTrajectory(PlatformTable.of("2017-01-01T00:00:00Z", tables[0], place, None, tables[1], turn))
    text = f"{lines} lines from {begin!r} s, {line_time!r} s each; readings are short of them by {missing:.3g} s"
    times = LineTimes.even(begin + 0.5 * line_time, line_time, lines)
    try:
        sensor = Sensor.of_lines(camera, path, Earth(), times, NO_EFFECTS)
    except ValueError as error:
        # the ends themselves are rounded to half a microsecond
        return Outcome(f"span {number}", REFUSED if missing > 0.0 else BAD_REFUSAL, f"{text}: {error}")
    at = np.array([-0.5, 0.5 * lines - 0.5, lines - 0.5])
    there = Sensor.of_lines(camera, circle, Earth(), times, NO_EFFECTS).ground(at, 100.0)
    right = np.abs(sensor.ground(at, 100.0) - there).max() < _AGREE and missing < 2e-6
    return Outcome(f"span {number}", RIGHT if right else WRONG_READING, text)
