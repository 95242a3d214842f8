"""Orbits and attitudes from files of other people's formats: the same pass from each, clocks, spans, segments."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from optics.numerics.array_math import ROUNDING, in_span, index_of_value
from scenes.specs.course import CourseSpec
from scenes.specs.orbit.measurements import PlatformFilesSpec
from scenes.specs.orbit.setup import load_three_line_camera
from scenes.yaml.errors import InputError, Problem
from tests.twin import orbit_file_bench as bench
from tests.twin.orbit_bench import CirclePlatform
from twin.orbit.flight.line_camera import LinePiece, line_cameras
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.measured.earth_orientation import (
    Readings,
    constant_orientation,
    epoch_before,
    known_scale,
    read_earth_orientation,
    tai_minus_utc,
)
from twin.orbit.measured.orbit_files import OrbitReadings, Segment, known_frame, read_oem, read_sp3
from twin.orbit.measured.platform_files import platform_table, read_platform

ARCSEC = np.pi / 648000.0
EARTH = {
    "ut1_utc": f"{bench.EARTH.dut1} s",
    "polar_motion": [f"{v / ARCSEC!r} arcsec" for v in bench.EARTH.polar_motion],
}
TURN = {"scalar": "last", "direction": "body_to_frame", "body_axes": bench.AXES}
CSV_ORBIT = {"file": "orbit.csv", "frame": "ITRS", "time_scale": "UTC"}
CSV_ATTITUDE = {"file": "attitude.csv", "frame": "ITRS", "time_scale": "UTC", **TURN}


def read(folder: Path, orbit: dict[str, Any], attitude: dict[str, Any], **more: Any) -> PlatformTable:
    spec = PlatformFilesSpec.model_validate({"orbit": orbit, "attitude": attitude, **more})
    return platform_table(*read_platform(spec, folder), bench.EPOCH)


def is_the_pass(table: PlatformTable, metres: float, speed: float, turn: float) -> None:
    path = bench.trajectory()
    t, looks = np.round(table.orbit_time, 6), np.round(table.attitude_time, 6)
    np.testing.assert_allclose(table.orbit_time, t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(table.position, path.position(t), rtol=0, atol=metres)
    np.testing.assert_allclose(table.velocity, path.velocity(t), rtol=0, atol=speed)
    found = Rotation.from_quat(table.quaternion).as_matrix()
    np.testing.assert_allclose(found, path.body_to_itrs(looks), rtol=0, atol=turn)


def test_tables_of_the_simulation_come_back_bit_for_bit(tmp_path: Path) -> None:
    bench.orbit_csv(tmp_path / "orbit.csv")
    bench.attitude_csv(tmp_path / "attitude.csv")
    table = read(tmp_path, CSV_ORBIT, CSV_ATTITUDE)
    here = bench.sampled()
    assert np.array_equal(table.position, here.position)
    assert np.array_equal(table.velocity, here.velocity)
    is_the_pass(table, 0.0, 0.0, 1e-15)


@pytest.mark.second
@pytest.mark.parametrize("scale", ["UTC", "GPS", "TAI", "TT", "BDT"])
@pytest.mark.parametrize("kind", ["oem", "sp3", "csv"])
def test_every_format_and_time_scale_is_the_same_pass(tmp_path: Path, kind: str, scale: str) -> None:
    """SP3 has millimetres and 1e-7 m/s; the others all digits. Inertial frames take rounding of some 1e-16 of 7000 km,
    and the rate of rotation from differences 1e-14 of it.
    """
    path = tmp_path / f"orbit.{kind}"
    orbit: dict[str, Any] = {"file": path.name}
    if kind == "oem":
        bench.oem(path, "GCRF", scale)
    elif kind == "sp3":
        bench.sp3(path, scale)
        orbit["satellite"] = "L51"
    else:
        bench.orbit_csv(path, "GCRS", scale)
        orbit |= {"frame": "GCRS", "time_scale": scale}
    bench.aem(tmp_path / "a.aem", "GPS")
    table = read(tmp_path, orbit, {"file": "a.aem", "body_axes": bench.AXES}, earth=EARTH)
    is_the_pass(table, 6e-4 if kind == "sp3" else 2e-7, 1e-7, 1e-12)


@pytest.mark.parametrize("direction", ["A2B", "B2A"])
@pytest.mark.parametrize("first", [False, True])
def test_an_aem_says_itself_how_its_quaternions_are_meant(tmp_path: Path, direction: str, first: bool) -> None:
    bench.orbit_csv(tmp_path / "orbit.csv")
    bench.aem(tmp_path / "a.aem", "TAI", direction, first)
    is_the_pass(read(tmp_path, CSV_ORBIT, {"file": "a.aem", "body_axes": bench.AXES}, earth=EARTH), 0.0, 0.0, 1e-12)


@pytest.mark.parametrize("scalar", ["last", "first"])
@pytest.mark.parametrize("turns", ["body_to_frame", "frame_to_body"])
def test_quaternions_of_tables_in_every_convention(tmp_path: Path, scalar: str, turns: str) -> None:
    bench.orbit_csv(tmp_path / "orbit.csv")
    order = "xyzw" if scalar == "last" else "wxyz"
    bench.attitude_csv(tmp_path / "attitude.csv", order=order, inverse=turns == "frame_to_body")
    attitude = {**CSV_ATTITUDE, "scalar": scalar, "direction": turns}
    is_the_pass(read(tmp_path, CSV_ORBIT, attitude), 0.0, 0.0, 1e-14)


def test_a_body_that_looks_up(tmp_path: Path) -> None:
    """x back, y right, z up in the file: its quaternions belong to these axes."""
    bench.orbit_csv(tmp_path / "orbit.csv")
    t = np.arange(-60.0, 60.1, 0.25)
    turned = Rotation.from_quat(bench.quaternions(t)) * Rotation.from_matrix(np.diag([-1.0, 1.0, -1.0]))
    q = turned.as_quat()
    heads = ("date_time", "q1", "q2", "q3", "q4")
    bench.csv(tmp_path / "attitude.csv", heads, list(map(bench.calendar, t)), *q.T.tolist())
    is_the_pass(read(tmp_path, CSV_ORBIT, {**CSV_ATTITUDE, "body_axes": ["back", "right", "up"]}), 0.0, 0.0, 1e-14)


@pytest.mark.parametrize("sequence", ["xyz", "zyx", "yxz"])
def test_roll_pitch_and_yaw_against_the_orbital_frame(tmp_path: Path, sequence: str) -> None:
    """The law of the simulation, with turns of degrees about axes in the stated sequence."""
    bench.orbit_csv(tmp_path / "orbit.csv")
    path, t = bench.trajectory(), np.arange(-50.0, 50.1, 1.0)
    rest = np.swapaxes(path.orbital_to_itrs(t), 1, 2) @ path.body_to_itrs(t)
    angles = Rotation.from_matrix(rest).as_euler(sequence.upper(), degrees=True)
    roll, pitch, yaw = (angles[:, sequence.index(axis)] for axis in "xyz")
    heads = ("date_time", "roll [deg]", "pitch [deg]", "yaw [deg]")
    bench.csv(tmp_path / "attitude.csv", heads, list(map(bench.calendar, t)), *(v.tolist() for v in (roll, pitch, yaw)))
    attitude = {
        **{"file": "attitude.csv", "frame": "orbital", "time_scale": "UTC", "sequence": sequence},
        **{"nadir": "geodetic", "steering": "yaw", "body_axes": bench.AXES},
    }
    # the orbital frame of readings 1 s apart, joined by a spline
    is_the_pass(read(tmp_path, CSV_ORBIT, attitude), 0.0, 0.0, 1e-9)


def test_seconds_from_an_epoch_count_leap_seconds_as_stated(tmp_path: Path) -> None:
    """From 2009 to 2011 there is none, from 2008 one; a GPS clock has none at all."""
    for epoch, before in (("2009-01-01T00:00:00Z", 0.0), ("2008-01-01T00:00:00Z", 1.0)):
        start = Readings.of_texts([epoch]).instants("UTC")
        t = Readings.of_texts([bench.EPOCH]).instants("UTC").since(epoch)[0] + np.arange(-60.0, 61.0)
        assert start.since(epoch)[0] == 0.0
        for said, drop in (("counted", 0.0), ("skipped", before)):
            columns = [*(map(repr, c) for c in bench.sampled().position.T.tolist())]
            bench.csv(tmp_path / "orbit.csv", ("time [s]", "x [m]", "y [m]", "z [m]"), (t - drop).tolist(), *columns)
            bench.attitude_csv(tmp_path / "attitude.csv")
            orbit = {**CSV_ORBIT, "epoch": epoch, "leap_seconds": said}
            table = read(tmp_path, orbit, CSV_ATTITUDE)
            # 1e9 s in one float64 are known to 1e-7 s
            np.testing.assert_allclose(table.orbit_time, np.arange(-60.0, 61.0), rtol=0, atol=2e-7)
            if before:
                with pytest.raises(InputError, match="leap seconds lie between"):
                    read(tmp_path, {**CSV_ORBIT, "epoch": epoch}, CSV_ATTITUDE)


def test_clocks_across_a_leap_second() -> None:
    texts = ["2016-12-31T23:59:59.5", "2016-12-31T23:59:60.5", "2017-01-01T00:00:00.5"]
    utc = Readings.of_texts(texts).instants("UTC")
    np.testing.assert_allclose(np.diff(utc.since("2016-12-31T00:00:00Z")), 1.0, rtol=0, atol=1e-9)
    with pytest.raises(Problem, match="no leap second on this day"):
        Readings.of_texts(["2016-12-30T23:59:60.5"]).instants("UTC")
    with pytest.raises(Problem, match="only UTC has"):
        Readings.of_texts(texts).instants("GPS")
    for text in ("2011-366T00:00:00", "1960-01-01T00:00:00", "2011-3-05T00:00:00"):
        with pytest.raises(Problem, match="not a date and time"):
            Readings.of_texts([text])
    assert epoch_before(utc) == "2016-12-31T23:59:59Z"
    assert tai_minus_utc(57753) == 36.0
    assert tai_minus_utc(57754) == 37.0
    same = Readings.of_texts(["2011-064T03:05:00"]).instants("UTC").since(bench.EPOCH)
    assert same[0] == 0.0
    assert (known_scale("gpst"), known_scale("GLO")) == ("GPS", "UTC")


@pytest.mark.second
def test_iers_tables_and_their_forms(tmp_path: Path) -> None:
    """C04 and finals2000A (of astropy's package) tell the same to the errors that they state, and so does CSV."""
    data = pytest.importorskip("astropy_iers_data")
    finals, c04 = read_earth_orientation(data.IERS_A_FILE), read_earth_orientation(data.IERS_B_FILE)
    days = np.array([55625.3, 57753.9, 59000.73])
    a, b = finals.at(days), c04.at(days)
    np.testing.assert_allclose(a[0], b[0], rtol=0, atol=5e-5)
    np.testing.assert_allclose(a[1], b[1], rtol=0, atol=3e-4 * ARCSEC)
    np.testing.assert_allclose(a[2], b[2], rtol=0, atol=5e-4 * ARCSEC)
    part = (finals.mjd > 55620) & (finals.mjd < 55632)
    columns = [v[part] for v in (finals.mjd, finals.ut1_tai, finals.pole, finals.offsets)]
    rows = [
        (float(m), float(u + tai_minus_utc(int(m))), *map(float, p / ARCSEC), *map(float, 1e3 * d / ARCSEC))
        for m, u, p, d in zip(*columns, strict=True)
    ]
    heads = ("mjd", "ut1_utc [s]", "x_pole [arcsec]", "y_pole [arcsec]", "dx [mas]", "dy [mas]")
    table = read_earth_orientation(bench.csv(tmp_path / "eop.csv", heads, *zip(*rows, strict=True)))
    for one, other in zip(table.at(days[:1]), finals.at(days[:1]), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11)
    with pytest.raises(InputError, match="does not cover the data"):
        table.rotation("2015-01-01T00:00:00Z", 0.0, 10.0)


def test_a_constant_earth_is_the_one_of_the_simulation() -> None:
    t = np.linspace(-50.0, 50.0, 11)
    table = constant_orientation(bench.EPOCH, bench.EARTH.dut1, bench.EARTH.polar_motion).rotation(bench.EPOCH, -60, 60)
    np.testing.assert_allclose(table.matrix(t), bench.EARTH.to_itrs(t, bench.EPOCH), rtol=0, atol=2e-14)


# --- what is refused --------------------------------------------------------------------------------------


def test_a_message_in_xml_is_the_same(tmp_path: Path) -> None:
    bench.attitude_csv(tmp_path / "attitude.csv")
    bench.oem_xml(tmp_path / "a.xml")
    is_the_pass(read(tmp_path, {"file": "a.xml"}, CSV_ATTITUDE, earth=EARTH), 2e-7, 1e-7, 1e-14)


# --- spans of orbit, attitude and lines that do not end together ------------------------------------------------------


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
    assert path.covers(np.array([-0.5, -0.5 + 1e-9, 4.0 - 1e-9, 4.0])).all()
    assert not path.covers(np.array([-0.499, 2.0, 3.999])).any()


def test_a_pixel_at_the_end_of_a_line_belongs_to_the_chip_that_ends_there() -> None:
    """Chips have offsets: a pixel that rounding leaves outside all of them would look elsewhere by these."""
    camera = line_cameras(load_three_line_camera("th1"))["nadir"]
    chip = replace(camera, pieces=())
    shifted = replace(chip, pieces=(LinePiece(0, chip.pixels - 1, chip.directions + np.array([1e-3, 0.0, 0.0])),))
    ends = np.array([-0.5, chip.pixels - 0.5])
    rounded = ends + np.array([-1e-9, 1e-9])
    assert np.abs(shifted.look(rounded) - shifted.look(ends)).max() < 1e-15
    with pytest.raises(ValueError, match="a pixel lies outside the line"):
        chip.look(ends + np.array([-1e-3, 0.0]))


def test_times_of_a_course_are_named_in_any_unit() -> None:
    """1.1 h is 66 min, but for the last bit."""
    times = ["0 min", "66 min", "132 min"]
    temperature = {"base": {"change": ["0 K", "1 K", "2 K"]}}
    for text in ("1.1 h", "66 min", "3960 s"):
        course = CourseSpec.model_validate({"times": times, "temperature": temperature, "detail": text})
        assert course.shown == 1
    assert index_of_value(1.1 * 3600.0, course.times) == 1
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


# --- what of an orbit's file may be joined ----------------------------------------------------------------------------


RADIUS, RATE = 6.878e6, 1.1068e-3


def circle(step: float, noise: float = 0.0, span: float = 3000.0) -> TabulatedTrajectory:
    time = np.arange(-span, span + 1e-9, step)
    place = RADIUS * np.stack([np.cos(RATE * time), np.sin(RATE * time), 0.0 * time], axis=-1)
    place += noise * np.random.default_rng(1).standard_normal(place.shape)
    unit = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    return TabulatedTrajectory(PlatformTable.of("2011-03-05T03:04:00Z", time, place, None, time[[0, -1]], unit))


@pytest.mark.parametrize("step", [10.0, 60.0, 200.0, 300.0, 400.0])
def test_the_error_of_interpolation_is_that_of_the_orbit(step: float) -> None:
    """Against the circle halfway between readings, to a factor of 3 where it matters: it is an order of magnitude."""
    path = circle(step, span=20 * step)
    middle = np.arange(-5.5 * step, 5.6 * step, step)
    exact = RADIUS * np.stack([np.cos(RATE * middle), np.sin(RATE * middle), 0.0 * middle], axis=-1)
    error = float(np.sqrt(np.mean(np.sum((path.position(middle) - exact) ** 2, axis=1))))
    if error > 3e-3:
        assert path.interpolation_error == pytest.approx(error, rel=2.0)
        assert path.interpolation_error > error / 3.0
    else:
        assert path.interpolation_error < 3e-3


@pytest.mark.parametrize("noise", [0.05, 1.0, 10.0])
def test_noise_of_the_readings_is_no_error_of_interpolation(noise: float) -> None:
    assert circle(1.0, noise, 300.0).interpolation_error == 0.0
    assert circle(30.0, noise).interpolation_error == 0.0


def test_steps_that_are_too_wide_are_refused(tmp_path: Path) -> None:
    """A second apart is fine; 400 s between readings of a low orbit are metres."""
    bench.attitude_csv(tmp_path / "attitude.csv")
    bench.sp3(tmp_path / "a.sp3")
    assert TabulatedTrajectory(read(tmp_path, {"file": "a.sp3", "satellite": "L51"}, CSV_ATTITUDE)).first == -60.0
    time = np.arange(-6000.0, 6001.0, 400.0)
    place = RADIUS * np.stack([np.cos(RATE * time), np.sin(RATE * time), 0.0 * time], axis=-1)
    texts = [bench.calendar(float(t), "UTC") for t in time]
    bench.csv(
        tmp_path / "wide.csv",
        ("date_time", "x [m]", "y [m]", "z [m]"),
        texts,
        *(map(repr, c) for c in place.T.tolist()),
    )
    wide = {"file": "wide.csv", "frame": "ITRS", "time_scale": "UTC"}
    with pytest.raises(InputError, match=r"between the readings are too uncertain.*400 s") as error:
        read(tmp_path, wide, CSV_ATTITUDE)
    assert "0.01 m" in str(error.value)


def segments(path: Path, usable: str = "") -> Path:
    """Two segments of an OEM that meet in the pass's middle, the second 100 m off as after a manoeuvre."""
    lines = bench.oem(path).read_text("utf-8").splitlines()
    begin = next(k for k, line in enumerate(lines) if line.startswith("COMMENT states"))
    head, rows = lines[3 : begin + 1], lines[begin + 1 :]
    half = len(rows) // 2 + 20
    moved = []
    for row in rows[half:]:
        cells = row.split()
        moved.append(" ".join([cells[0], repr(float(cells[1]) + 0.1), *cells[2:]]))
    told = [*head[:-2], *([usable] if usable else []), *head[-2:]]
    path.write_text("\n".join([*lines[:3], *told, *rows[: half + 1], *head, *moved]) + "\n", "utf-8")
    return path


def test_nothing_is_interpolated_from_one_segment_to_the_next(tmp_path: Path) -> None:
    bench.attitude_csv(tmp_path / "attitude.csv")
    readings = read_oem(segments(tmp_path / "a.oem"))
    assert len(readings.segments) == 2
    assert readings.segments[1].first == readings.segments[0].last + 1
    table = read(tmp_path, {"file": "a.oem"}, CSV_ATTITUDE, earth=EARTH)
    path = TabulatedTrajectory(table)
    # the first segment has most of the attitude; the pass ends where it does
    whole = bench.sampled("ITRS", 1.0)
    assert len(table.orbit_time) == readings.segments[0].last + 1
    inside = (whole.seconds >= path.first) & (whole.seconds <= path.last)
    assert np.abs(path.position(whole.seconds[inside]) - whole.position[inside]).max() < 1e-3
    with pytest.raises(ValueError, match="outside of"):
        path.position(path.last + 0.5)


def test_segments_that_are_not_of_one_orbit_are_refused(tmp_path: Path) -> None:
    """Two satellites of which none is named, two time scales; and an SP3 file of one place."""
    whole = segments(tmp_path / "a.oem").read_text("utf-8")
    for old, new, words in (
        ("OBJECT_ID = 2010-040A", "OBJECT_ID = 1999-001A", "the satellite is not specified"),
        ("TIME_SYSTEM = UTC", "TIME_SYSTEM = GPS", "segments with different TIME_SYSTEM"),
    ):
        (tmp_path / "a.oem").write_text(whole.replace(old, new, 1))
        with pytest.raises(InputError, match=words):
            read_oem(tmp_path / "a.oem")
    with pytest.raises(InputError, match="fewer than two positions of L51"):
        read_sp3(bench.sp3(tmp_path / "a.sp3", step=200.0), "L51")


def test_usable_times_are_kept_to(tmp_path: Path) -> None:
    bench.attitude_csv(tmp_path / "attitude.csv")
    segments(tmp_path / "a.oem", f"USEABLE_STOP_TIME = {bench.calendar(5.0, 'UTC')}")
    path = TabulatedTrajectory(read(tmp_path, {"file": "a.oem"}, CSV_ATTITUDE, earth=EARTH))
    assert path.last == pytest.approx(5.0, abs=1e-6)
    assert np.all(path.covers([4.0, 4.99]))
    assert not np.any(path.covers([5.5, 7.0]))


def test_older_and_unfinished_files_of_sp3(tmp_path: Path) -> None:
    whole = read_sp3(bench.sp3(tmp_path / "d.sp3"), "L51")
    text = (tmp_path / "d.sp3").read_text("utf-8")
    old = tmp_path / "a.sp3"
    old.write_text(
        text.replace("#d", "#a")
        .replace("G01", "  1")
        .replace("L51", " 51")
        .replace("%c M  cc GPS", "%c cc cc ccc")
        .replace("IGS20", "IER97"),
        "utf-8",
    )
    for name in ("51", "G51"):
        found = read_sp3(old, name)
        assert (found.scale, found.frame) == ("GPS", "ITRS")
        assert np.array_equal(found.position, whole.position)
    alone = re.sub(r"^[PV]G01.*\n", "", text.replace("+    2   G01L51", "+    1   L51"), flags=re.M)
    (tmp_path / "one.sp3").write_text(alone, "utf-8")
    assert np.array_equal(read_sp3(tmp_path / "one.sp3", None).position, whole.position)
    unfinished = tmp_path / "u.sp3"
    unfinished.write_text(text.replace("EOF\n", ""), "utf-8")
    assert np.array_equal(read_sp3(unfinished, "L51").position, whole.position)
    cut = text.replace("EOF\n", "").splitlines()[:-6]
    unfinished.write_text("\n".join(cut) + "\n", "utf-8")
    with pytest.raises(InputError, match=r"ends early.* of \d+ epochs"):
        read_sp3(unfinished, "L51")


@pytest.mark.parametrize("name", ["ECF", "IER97", "ITR97", "IGS14", "IGb08", "IGc20", "WGS84"])
def test_frames_as_sp3_spells_them(name: str) -> None:
    assert known_frame(name, "a.sp3") == "ITRS"


def test_a_cut_orbit_keeps_what_is_left_of_its_segments() -> None:
    clock, place = Readings(np.full(90, 55625), np.arange(90.0)), np.zeros((90, 3))
    orbit = OrbitReadings("a.oem", clock, place, None, segments=(Segment(0, 49), Segment(50, 79), Segment(80, 89)))
    assert [(part.first, part.last) for part in orbit.taken(slice(40, 70)).segments] == [(0, 9), (10, 29)]
