"""Orbits and attitudes from files of other people's formats: the same pass from each, clocks, what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes.specs.orbit.measurements import PlatformFilesSpec
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


def test_a_message_in_xml_is_the_same(tmp_path: Path) -> None:
    bench.attitude_csv(tmp_path / "attitude.csv")
    bench.oem_xml(tmp_path / "a.xml")
    is_the_pass(read(tmp_path, {"file": "a.xml"}, CSV_ATTITUDE, earth=EARTH), 2e-7, 1e-7, 1e-14)
