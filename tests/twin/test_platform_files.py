"""Orbits and attitudes from files of other people's formats: the same pass from each, clocks, what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes.specs.measured.pass_files import PlatformFilesSpec
from scenes.yaml.errors import InputError, Problem
from tests.twin import orbit_file_bench as bench
from twin.orbit.flight.platform_table import PlatformTable
from twin.orbit.measured.clock import Readings, epoch_before, known_scale, tai_minus_utc
from twin.orbit.measured.earth_orientation import constant_orientation, read_earth_orientation
from twin.orbit.measured.platform_files import platform_table, read_platform

ARCSEC = np.pi / 648000.0
EARTH = {
    "ut1_utc": f"{bench.EARTH.dut1} s",
    "polar_motion": [f"{v / ARCSEC!r} arcsec" for v in bench.EARTH.polar_motion],
}
TURN = {"scalar": "last", "turns": "body_to_frame", "body_axes": bench.AXES}
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
    attitude = {**CSV_ATTITUDE, "scalar": scalar, "turns": turns}
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
    with pytest.raises(InputError, match="ends before the data"):
        table.rotation("2015-01-01T00:00:00Z", 0.0, 10.0)


def test_a_constant_earth_is_the_one_of_the_simulation() -> None:
    t = np.linspace(-50.0, 50.0, 11)
    table = constant_orientation(bench.EPOCH, bench.EARTH.dut1, bench.EARTH.polar_motion).rotation(bench.EPOCH, -60, 60)
    np.testing.assert_allclose(table.matrix(t), bench.EARTH.to_itrs(t, bench.EPOCH), rtol=0, atol=2e-14)


# --- what is refused --------------------------------------------------------------------------------------


def edited(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


WRONG = [
    ("oem", "CENTER_NAME = EARTH", "CENTER_NAME = MARS", "another body", 7),
    ("oem", "REF_FRAME = GCRF", "REF_FRAME = MOD", "frame that cannot be read", 8),
    ("oem", "TIME_SYSTEM = UTC", "TIME_SYSTEM = TDB", "time scale that cannot be read", 9),
    ("oem", "TIME_SYSTEM = UTC\n", "", "no TIME_SYSTEM"),
    ("oem", "META_STOP\n", "", "ends early|key = value"),
    ("oem", "META_START\n", "", "before META_START|no data"),
    ("oem", "2011-03-05T03:04:30", "2011-03-05T03:04:61", "not a date and time"),
    ("oem", "2011-03-05T03:04:30", "2011-13-05T03:04:30", "not a date and time"),
    ("oem", "2011-03-05T03:04:30", "2011-03-05T03:01:30", "not later"),
    ("oem", "2011-03-05T03:04:30.000000 ", "2011-03-05T03:04:30.000000 x", "not a number|another length"),
    ("oem", "2011-03-05T03:04:30.000000 ", "2011-03-05T03:04:30.000000 1 2 ", "another length"),
    ("oem", "2011-03-05T03:04:30.000000 ", "2011-03-05T03:04:30.000000 nan 1 1 1 1 1\n# ", "not a finite number"),
    ("oem", "COMMENT states", "COMMENT s\nCOVARIANCE_START", "ends early|no data"),
    ("oem", "CCSDS_OEM_VERS", "CCSDS_AEM_VERS", "of another kind", 1),
    ("aem", "ATTITUDE_TYPE = QUATERNION", "ATTITUDE_TYPE = SPIN", "another type"),
    ("aem", "ATTITUDE_DIR = A2B", "ATTITUDE_DIR = AB", "no such direction"),
    ("aem", "QUATERNION_TYPE = LAST", "QUATERNION_TYPE = MIDDLE", "no such type"),
    ("aem", "REF_FRAME_B = SC_BODY_1", "REF_FRAME_B = EME2000", "must be the body's"),
    ("aem", "REF_FRAME_A = ICRF", "REF_FRAME_A = RTN", "frame that cannot be read"),
    ("aem", "REF_FRAME_A = ICRF\n", "", "no REF_FRAME_A"),
    ("aem", "TIME_SYSTEM = UTC", "TIME_SYSTEM = MET", "time scale that cannot be read"),
    ("aem", "DATA_START\n", "DATA_START\n2011-03-05T03:04:00.000000 0 0 0\n", "another length"),
    ("aem", "DATA_START\n", "DATA_START\n2011-03-05T03:03:59.000000 1 1 0 0\n", "not a quaternion"),
    ("aem", "DATA_START\n", "DATA_START\n2011-03-05T03:03:59.000000 a 1 0 0\n", "not a number"),
    ("aem", "DATA_START\n", "DATA_START\n2011-03-05T03:09:59.000000 0 1 0 0\n", "not later"),
    ("aem", "DATA_START\n", "DATA_START\n2011-03-05 0 1 0 0\n", "not a date and time"),
    ("sp3", "%c M  cc GPS", "%c M  cc XYZ", "time scale that cannot be read"),
    ("sp3", "%c", "%x", "no line %c|time scale"),
    ("sp3", "ORBIT IGS20", "ORBIT J200Q", "frame that cannot be read"),
    ("sp3", "*  2011  3  5  3  4 20", "*  2011  3  5  3  x 20", "not an epoch"),
    ("sp3", "*  2011  3  5  3  4 20", "*  2011  3 35  3  4 20", "not a date and time"),
    ("sp3", "*  2011  3  5  3  4 20", "*  2010  3  5  3  4 20", "not later"),
    ("sp3", "PL51", "PL51   abc        ", "not a number"),
    ("sp3", "PL51", "PL51     12.000000", "no place of a satellite"),
    ("sp3", "VL51", "VX51", "velocities are missing"),
    ("sp3", "PL51", "PL51\n", "not a number"),
    ("sp3", "PL51", "PL51   1e200      ", "larger than any quantity"),
    ("sp3", "*  2011  3  5  3  4 15.00000000\n", "", "a record before the first epoch"),
]
"""Format, text that becomes another one, what is told, and the line where it is that of the text."""


@pytest.mark.parametrize("case", WRONG, ids=[f"{case[0]}-{k}" for k, case in enumerate(WRONG)])
def test_a_file_of_another_format_that_is_wrong(tmp_path: Path, case: tuple[Any, ...]) -> None:
    kind, old, new, told, *line = case
    bench.orbit_csv(tmp_path / "orbit.csv")
    bench.attitude_csv(tmp_path / "attitude.csv")
    edited(getattr(bench, kind)(tmp_path / f"a.{kind}"), old, new)
    file = {"file": f"a.{kind}", **{"sp3": {"satellite": "L51"}, "aem": {"body_axes": bench.AXES}}.get(kind, {})}
    with pytest.raises(InputError, match=told) as error:
        read(tmp_path, CSV_ORBIT if kind == "aem" else file, file if kind == "aem" else CSV_ATTITUDE, earth=EARTH)
    assert error.value.file.endswith(f"a.{kind}")
    assert line in ([], [error.value.line])
    assert kind == "sp3" or "allowed" in str(error.value)


def test_of_several_satellites_one_must_be_named(tmp_path: Path) -> None:
    bench.attitude_csv(tmp_path / "attitude.csv")
    bench.sp3(tmp_path / "a.sp3")
    with pytest.raises(InputError, match=r"which satellite is not said; found G01, L51"):
        read(tmp_path, {"file": "a.sp3"}, CSV_ATTITUDE)
    with pytest.raises(InputError, match=r"no such satellite; did you mean 'L51'"):
        read(tmp_path, {"file": "a.sp3", "satellite": "L52"}, CSV_ATTITUDE)


CSV = [
    ({"frame": None}, {}, "the frame of the positions is not said"),
    ({"time_scale": None}, {}, "the time scale of the orbit is not said"),
    ({"epoch": "2011-03-05T00:00:00"}, {}, "an epoch for times of the day"),
    ({"frame": "GCRS"}, {}, "without Earth orientation"),
    ({"file": "nothing.csv"}, {}, "no such file"),
    ({"file": "."}, {}, "not a regular file"),
    ({}, {"scalar": None}, "where the scalar stands is not said"),
    ({}, {"turns": None}, "what is turned is not said"),
    ({}, {"frame": None}, "that the body is turned against is not said"),
    ({}, {"frame": "orbital"}, "which orbital frame"),
    ({}, {"file": "orbit.csv"}, "no such column"),
    ({"file": "attitude.csv"}, {}, "no such column"),
    ({"file": "a.aem"}, {}, "message of another kind"),
    ({}, {"file": "a.oem"}, "message of another kind"),
    ({"file": "p.oem", "frame": "ITRS"}, {}, "said differently by the file"),
    ({"file": "p.oem", "frame": None, "satellite": "X"}, {}, "no such satellite"),
    ({"file": "untimed.csv"}, {}, "times are not said once"),
    ({"file": "seconds.csv"}, {}, "times in seconds without their epoch"),
    ({"file": "seconds.csv", "epoch": "2099-12-31T23:59:59"}, {}, "outside the years of this time scale"),
    ({"file": "seconds.csv", "epoch": "2011-03-05T03:05:00"}, {}, "velocities are not complete"),
    ({"file": "leap.csv", "time_scale": "GPS"}, {}, "only UTC has"),
    ({}, {"file": "leap.csv"}, "not one complete set of columns|no such column"),
]


@pytest.mark.parametrize(("orbit", "attitude", "told"), CSV)
def test_a_table_of_which_something_is_not_said(
    tmp_path: Path, orbit: dict[str, Any], attitude: dict[str, Any], told: str
) -> None:
    bench.orbit_csv(tmp_path / "orbit.csv")
    bench.attitude_csv(tmp_path / "attitude.csv")
    bench.oem(tmp_path / "p.oem")
    place = "x [m],y [m],z [m]"
    for name, text in {
        "a.aem": "CCSDS_AEM_VERS = 1.0\n",
        "a.oem": "CCSDS_OEM_VERS = 2.0\n",
        "untimed.csv": f"{place}\n7e6,0,0\n7e6,0,1\n",
        "seconds.csv": f"time [s],{place},vx [m/s]\n0,7e6,0,0,1\n9e5,7e6,0,1,1\n",
        "leap.csv": f"date_time,{place}\n2016-12-31T23:59:59,7e6,0,0\n2016-12-31T23:59:60,7e6,0,1\n",
    }.items():
        (tmp_path / name).write_text(text)
    for base, change in ((CSV_ORBIT, orbit), (CSV_ATTITUDE, attitude)):
        change |= {k: v for k, v in base.items() if k not in change}
    asked = [{k: v for k, v in one.items() if v is not None} for one in (orbit, attitude)]
    with pytest.raises(InputError, match=told):
        read(tmp_path, *asked)


ROWS = [
    (b"x [m]", b"x [deg]", "unit of a length|not a length|deg"),
    (b"x [m]", b"u [m]", "no such column"),
    (b"vz [m/s]", b"vz [m]", "vz"),
    (b"2011-03-05T03:04:10.000000", b"2011-03-05T03:04:10,000000", "cells"),
    (b"2011-03-05T03:04:10.000000", b"yesterday", "not a date and time"),
    (b"2011-03-05T03:04:10.000000", b"2011-03-05T03:04:09.000000", "not later"),
    (b"2011-03-05T03:04:10.000000", b"", "empty cell"),
    (b"2011-03-05T03:04:10.000000,", b"2011-03-05T03:04:10.000000,1", "no place of a satellite|not a number"),
    (b"2011-03-05T03:04:10.000000,", b"2011-03-05T03:04:10.000000,nan", "not a number|finite"),
    (b"2011-03-05T03:04:10.000000,", b"2011-03-05T03:04:10.000000,1,", "cells"),
    (b"2011-03-05T03:04:10.000000,", b"\xff,", "UTF-8"),
    (b"2011-03-05T03:04:10.000000,", b"\0,", "date and time|zero byte"),
]


@pytest.mark.parametrize(("old", "new", "told"), ROWS)
def test_an_orbit_table_that_is_wrong(tmp_path: Path, old: bytes, new: bytes, told: str) -> None:
    bench.attitude_csv(tmp_path / "attitude.csv")
    path = bench.orbit_csv(tmp_path / "orbit.csv")
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    with pytest.raises(InputError, match=told) as error:
        read(tmp_path, CSV_ORBIT, CSV_ATTITUDE)
    assert error.value.line in (1, 12)


C04 = "2011   3   5   0  55625.00" + "   0.1   0.1   0.2" + "   0.1" * 12 + " 0.1\n"
EOP = [
    ("not numbers at all and long enough to hold a date and what not, so that columns exist\n", "not a number|few"),
    ("", "too few days"),
    ("mjd,ut1_utc [s],x_pole [arcsec],y_pole [arcsec]\n55625,0.1,0.1,0.1\n", "1 rows"),
    ("mjd,ut1_utc [s],x_pole [arcsec]\n55625,0.1,0.1\n", "no column"),
    ("mjd,ut1_utc [s],x_pole [arcsec],y_pole [arcsec]\n" + "55625,0.1,0.1,0.1\n" * 5, "do not rise"),
    ("mjd,ut1_utc [s],x_pole [arcsec],y_pole [arcsec]\n" + "".join(f"{55625 + k},3,0,0\n" for k in range(5)), "range"),
    ("mjd,ut1_utc [s],x_pole [deg],y_pole [deg]\n" + "".join(f"{55625 + k},0,1,0\n" for k in range(5)), "range"),
    ("mjd,ut1_utc [s],x_pole [s],y_pole [s]\n" + "55625,0,1,0\n" * 5, "unit"),
    ("mjd,ut1_utc [s],x_pole [arcsec],y_pole [arcsec]\n" + "".join(f"{k},0,0,0\n" for k in range(5)), "range"),
    ("2011   3   5   0  55625.00\n" * 5, "few|columns|line|number"),
    ("\xff\n", "few|line"),
    (C04 * 4 + C04.replace(" 0.1\n", "\n"), "a row of another length"),
    ("".join(C04.replace("55625", f"5562{k}").replace("0.2", "3.0") for k in range(5)), "not Earth orientation"),
    ("mjd,ut1_utc [s],x_pole [arcsec],y_pole [arcsec]\n" + "".join(f"556{k}5,0,0,0\n" for k in "2468"), "gap"),
]


@pytest.mark.parametrize(("text", "told"), EOP)
def test_a_table_of_earth_orientation_that_is_wrong(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "eop.txt").write_text(text, "utf-8")
    with pytest.raises(InputError, match=told) as error:
        read_earth_orientation(tmp_path / "eop.txt")
    assert error.value.file.endswith("eop.txt")


def test_a_message_in_xml_is_the_same(tmp_path: Path) -> None:
    bench.attitude_csv(tmp_path / "attitude.csv")
    s = bench.sampled("GCRS", 10.0)
    states = "".join(
        f"<stateVector><EPOCH>{bench.calendar(t)}</EPOCH>"
        + "".join(f"<{n}>{float(v)!r}</{n}>" for n, v in zip(("X", "Y", "Z"), r / 1e3, strict=True))
        + "".join(f"<{n}_DOT>{float(v)!r}</{n}_DOT>" for n, v in zip("XYZ", w / 1e3, strict=True))
        + "</stateVector>"
        for t, r, w in zip(s.seconds, s.position, s.velocity, strict=True)
    )
    meta = "<OBJECT_ID>A</OBJECT_ID><CENTER_NAME>EARTH</CENTER_NAME><REF_FRAME>GCRF</REF_FRAME>"
    text = (
        f'<?xml version="1.0"?><oem id="CCSDS_OEM_VERS" version="2.0"><body><segment><metadata>{meta}'
        f"<TIME_SYSTEM>UTC</TIME_SYSTEM></metadata><data>{states}</data></segment></body></oem>"
    )
    (tmp_path / "a.xml").write_text(text)
    is_the_pass(read(tmp_path, {"file": "a.xml"}, CSV_ATTITUDE, earth=EARTH), 2e-7, 1e-7, 1e-14)
    other = text.replace("<X>", "<Q>").replace("</X>", "</Q>")
    for bad in (text[:-20], text.replace("<oem", "<!DOCTYPE oem><oem", 1), other):
        (tmp_path / "a.xml").write_text(bad)
        with pytest.raises(InputError):
            read(tmp_path, {"file": "a.xml"}, CSV_ATTITUDE, earth=EARTH)
