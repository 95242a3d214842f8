"""Spans of orbit, attitude and lines that do not end together, and ends that meet to rounding."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from optics.numerics.array_math import ROUNDING, in_span, number_of
from scenes.specs.course import CourseSpec
from scenes.specs.orbit.measurements import PlatformFilesSpec
from scenes.specs.orbit.setup import load_three_line_camera
from scenes.yaml.errors import InputError
from tests.twin import orbit_file_bench as bench
from tests.twin.orbit_bench import CirclePlatform
from twin.orbit.flight.line_camera import LinePiece, line_cameras
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.measured.clock import Readings
from twin.orbit.measured.platform_files import platform_table, read_platform

CASES = 10_000


def grids(count: int = CASES) -> tuple[np.ndarray, ...]:
    """Spans (N, 2) of decimal ends, lines of an even image in each, its line time, and instants (N,) of their begins.

    Ends are known to the microsecond, as files write them, up to a year from the epoch.
    """
    random = np.random.default_rng(11)
    first = np.round(random.uniform(-1.0, 1.0, count) * 10.0 ** random.uniform(0.0, 7.5, count), 6)
    lines = random.integers(1, 200_000, count)
    line_time = np.round(random.uniform(2e-5, 1e-2, count), 12)
    return first, first + lines * line_time, lines, line_time


def test_no_grid_leaves_its_own_span_by_rounding() -> None:
    """Lines, halves of lines, shares of the span and texts of instants, each summed in another order than the ends."""
    first, last, lines, line_time = grids()
    random = np.random.default_rng(12)
    middle = first + 0.5 * line_time  # of the first line
    for number in (np.full(CASES, -0.5), lines - 0.5, (lines * random.uniform(0.0, 1.0, CASES)) - 0.5):
        assert in_span(middle + number * line_time, first, last).all()
    tick = (last - first) / 1000.0
    for k in (0.0, 1000.0, 317.0):
        assert in_span((first + 0.5 * tick) + (k - 0.5) * tick, first, last).all()
    # UTC texts of microseconds, by TAI and back, from an epoch on another day
    epoch = "2016-12-30T23:59:59.125Z"
    clock = Readings.after(epoch[:-1], first)
    texts = Readings(clock.day, np.round(clock.second, 6)).instants("TAI").later(0.0)
    assert in_span(texts.since(epoch) - texts.since(epoch)[0] + first[0], first, first).all()
    # what is really outside stays outside, and so does what is no number
    for away in (first - 2.0 * ROUNDING - 1e-14 * np.abs(first), last + 2.0 * ROUNDING + 1e-14 * np.abs(last)):
        assert not in_span(away, first, last).any()
    assert not in_span(np.nan, -np.inf, np.inf)
    assert in_span(1e300, -np.inf, np.inf)


def platform(orbit: np.ndarray, attitude: np.ndarray, circle: CirclePlatform) -> TabulatedTrajectory:
    """Readings of a circle at times (N,) and (M,), seconds."""
    turn = Rotation.from_matrix(circle.body_to_itrs(attitude)).as_quat(canonical=False)
    table = PlatformTable.of("2017-01-01T00:00:00Z", orbit, circle.position(orbit), None, attitude, turn)
    return TabulatedTrajectory(table)


def test_a_gap_keeps_its_ends_to_rounding() -> None:
    circle = CirclePlatform()
    time = np.concatenate([np.arange(-10.0, 0.0, 0.5), 4.0 + np.arange(0.0, 6.0, 0.5)])
    path = platform(np.arange(-10.0, 11.0), time, circle)
    assert path.known(np.array([-0.5, -0.5 + 1e-9, 4.0 - 1e-9, 4.0])).all()
    assert not path.known(np.array([-0.499, 2.0, 3.999])).any()


def test_a_pixel_at_the_end_of_a_line_belongs_to_the_chip_that_ends_there() -> None:
    """Chips have offsets: a pixel that rounding leaves outside all of them would look elsewhere by these."""
    camera = line_cameras(load_three_line_camera("th1"))["nadir"]
    chip = replace(camera, pieces=())
    shifted = replace(chip, pieces=(LinePiece(0, chip.pixels - 1, chip.directions + np.array([1e-3, 0.0, 0.0])),))
    ends = np.array([-0.5, chip.pixels - 0.5])
    rounded = ends + np.array([-1e-9, 1e-9])
    assert np.abs(shifted.look(rounded) - shifted.look(ends)).max() < 1e-15
    with pytest.raises(ValueError, match="a pixel outside the line"):
        chip.look(ends + np.array([-1e-3, 0.0]))


def test_times_of_a_course_are_named_in_any_unit() -> None:
    """1.1 h is 66 min, but for the last bit."""
    times = ["0 min", "66 min", "132 min"]
    temperature = {"base": {"change": ["0 K", "1 K", "2 K"]}}
    for text in ("1.1 h", "66 min", "3960 s"):
        course = CourseSpec.model_validate({"times": times, "temperature": temperature, "detail": text})
        assert course.shown == 1
    assert number_of(1.1 * 3600.0, course.times) == 1
    with pytest.raises(ValidationError, match="not one of the course's times"):
        CourseSpec.model_validate({"times": times, "temperature": temperature, "detail": "66.1 min"})


def test_attitude_against_the_orbit_may_be_longer_than_it(tmp_path: Path) -> None:
    """Angles from 60 s before to 60 s after, an orbit of which 20 s at either end are missing."""
    t = np.arange(-60.0, 60.0 + 1e-9, 0.25)
    angles = np.zeros((3, len(t))).tolist()
    heads = ("date_time", "roll [deg]", "pitch [deg]", "yaw [deg]")
    bench.csv(tmp_path / "a.csv", heads, [bench.calendar(s) for s in t], *angles)
    bench.orbit_csv(tmp_path / "whole.csv")
    head, *rows = (tmp_path / "whole.csv").read_text().splitlines()
    (tmp_path / "short.csv").write_text("\n".join([head, *rows[20:-20]]) + "\n")
    (tmp_path / "none.csv").write_text("\n".join([head, *rows[:3]]) + "\n")

    turn = {"file": "a.csv", "time_scale": "UTC", "frame": "orbital", "nadir": "geodetic", "steering": "yaw"}
    turn |= {"sequence": "xyz", "body_axes": ["forward", "right", "down"]}

    def read(name: str) -> PlatformTable:
        data = {"orbit": {"file": name, "frame": "ITRS", "time_scale": "UTC"}, "attitude": turn}
        return platform_table(*read_platform(PlatformFilesSpec.model_validate(data), tmp_path), bench.EPOCH)

    short, whole = (TabulatedTrajectory(read(f"{name}.csv")) for name in ("short", "whole"))
    assert (short.first, short.last) == pytest.approx((-40.0, 40.0), abs=1e-6)
    inner = np.linspace(-39.0, 39.0, 50)
    # splines of positions 1 s apart feel their ends by 1e-6 m
    assert np.abs(short.body_to_itrs(inner) - whole.body_to_itrs(inner)).max() < 1e-9
    head, *rows = (tmp_path / "a.csv").read_text().splitlines()
    (tmp_path / "a.csv").write_text("\n".join([head, *rows[100:]]) + "\n")
    with pytest.raises(InputError, match="attitude at times without orbit"):
        read("none.csv")
