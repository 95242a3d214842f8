"""What of an orbit's file may be joined: segments, usable times, steps that are too wide, older versions."""

import re
from pathlib import Path

import numpy as np
import pytest

import tests.twin.orbit_file_bench as bench
from scenes.yaml.errors import InputError
from tests.twin.test_platform_files import CSV_ATTITUDE, EARTH, read
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.measured.clock import Readings
from twin.orbit.measured.orbit_files import OrbitReadings, Segment, known_frame, read_oem, read_sp3

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
    with pytest.raises(InputError, match=r"between the readings are not known.*400 s") as error:
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
        ("OBJECT_ID = 2010-040A", "OBJECT_ID = 1999-001A", "which satellite is not said"),
        ("TIME_SYSTEM = UTC", "TIME_SYSTEM = GPS", "segments with different TIME_SYSTEM"),
    ):
        (tmp_path / "a.oem").write_text(whole.replace(old, new, 1))
        with pytest.raises(InputError, match=words):
            read_oem(tmp_path / "a.oem")
    with pytest.raises(InputError, match="fewer than two places of L51"):
        read_sp3(bench.sp3(tmp_path / "a.sp3", step=200.0), "L51")


def test_usable_times_are_kept_to(tmp_path: Path) -> None:
    bench.attitude_csv(tmp_path / "attitude.csv")
    segments(tmp_path / "a.oem", f"USEABLE_STOP_TIME = {bench.calendar(5.0, 'UTC')}")
    path = TabulatedTrajectory(read(tmp_path, {"file": "a.oem"}, CSV_ATTITUDE, earth=EARTH))
    assert path.last == pytest.approx(5.0, abs=1e-6)
    assert np.all(path.known([4.0, 4.99]))
    assert not np.any(path.known([5.5, 7.0]))


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
