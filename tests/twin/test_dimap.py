"""Scenes of DIMAP files: the rigorous model against the format's formulas anew and against the RPC of the same file,
and what is refused.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenes.specs.orbit.measurements import LineTimesFileSpec, PlatformFilesSpec
from scenes.yaml.errors import InputError
from tests.twin.dimap_bench import Oracle, Scene, clock, write
from twin.orbit.conventions.pass_readings import read_line_clocks
from twin.orbit.flight.earth import east_north_up
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.measured import xml_file
from twin.orbit.measured.dimap_file import read_dimap
from twin.orbit.measured.earth_orientation import Readings
from twin.orbit.measured.orbit_files import OrbitReadings, require_earth_fixed_velocity
from twin.orbit.measured.platform_files import platform_table, read_platform, read_scene

PLEIADES = Scene()
SPOT = Scene(
    profile="S6_SENSOR",
    attitude="samples",
    bands=("P",),
    ylos=(1e-4, 2e-9),
    xlos=(-0.022, 2.2e-6, 1e-12),
    first_column=501,
    period=0.2e-3,
    start=86_399.2,  # over midnight
)
NEO = Scene(
    profile="PNEO_SENSOR",
    version="3.0",
    attitude="samples",
    interval=0.004363,
    ephemeris=(0.3, 8),
    bands=("P",),
    period=43.555e-6,
)
SCENES = {"pleiades": PLEIADES, "spot": SPOT, "neo": NEO}
AGREE = 1e-6
"""Metres: the oracle's polynomial of eight points differs by less from ours of ten, and from a spline through
quaternions 30 ms apart by 1e-12 rad.
"""


def places(scene: Scene, count: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(5)
    row, column = (random.uniform(0.0, n - 1.0, count) for n in (scene.lines, scene.pixels))
    return row, column, random.uniform(-100.0, 4000.0, count)


@pytest.mark.second
@pytest.mark.parametrize("name", SCENES)
def test_the_rigorous_model_is_that_of_the_format(tmp_path: Path, name: str) -> None:
    scene = SCENES[name]
    path = write(tmp_path, scene)
    if scene is SPOT:  # the oracle counts seconds of one day
        early = replace(scene, start=80_000.0)
        path = write(tmp_path, early)
    sensor, oracle = read_scene(path).sensor, Oracle(path)
    row, column, height = places(scene)
    there = np.array([oracle.ground(*one) for one in zip(row, column, height, strict=True)])
    assert np.abs(sensor.ground(row, column, height) - there).max() < AGREE
    back = sensor.image(there)
    np.testing.assert_allclose(back, (row, column), rtol=0, atol=3e-6)  # AGREE in pixels of 0.5 m and more


def test_refraction_is_there_where_the_file_says_so(tmp_path: Path) -> None:
    """At sea level a look of z leaves its straight line by 2.3 m tan z / cos^2 z, toward the satellite; 1 % for the
    exact layers."""
    tilted = replace(PLEIADES, pitch=0.4)
    row, column = np.array([6000.0]), np.array([10_000.0])
    straight = read_scene(write(tmp_path, tilted)).sensor
    for value, on in (("true", True), ("1", True), ("false", False), ("TRUE", True)):
        scene = replace(tilted, settings={"ATMOSPHERIC_REFRACTION_SETTING": value, "LIGHT_SPEED_SETTING": "false"})
        sensor = read_scene(write(tmp_path, scene)).sensor
        assert (sensor.effects.refraction, sensor.effects.aberration, sensor.effects.light_time) == (on, False, False)
        moved = (sensor.ground(row, column) - straight.ground(row, column))[0]
        ground = straight.ground(row, column)[0]
        look = straight.trajectory.position(straight.time(row))[0] - ground
        longitude, latitude, _ = straight.earth.geodetic(ground[None])
        up = east_north_up(longitude, latitude)[0, 2] @ look / np.linalg.norm(look)
        zenith = np.arccos(up)
        wanted = 2.33 * np.tan(zenith) / np.cos(zenith) ** 2 if on else 0.0
        assert np.linalg.norm(moved) == pytest.approx(wanted, rel=0.01)
        assert moved @ look >= 0.0


def test_midnight_within_a_scene_changes_nothing(tmp_path: Path) -> None:
    """Sensors whose times count from another day; the Earth turns alike, as positions are Earth-fixed."""
    row, column, height = places(SPOT)
    for scene in (SPOT, replace(SPOT, attitude="polynomial")):
        late, noon = (read_scene(write(tmp_path, replace(scene, start=s))).sensor for s in (scene.start, 43_000.0))
        # texts of times have nanoseconds, in which the satellite moves by 7 um
        assert np.abs(late.ground(row, column, height) - noon.ground(row, column, height)).max() < 3e-5


def test_an_orbit_that_begins_with_the_image_is_carried_on(tmp_path: Path) -> None:
    """As real files of Pléiades Neo have it: the first point 3 ms after the first line."""
    scene = replace(NEO, lines=4000)
    path = write(tmp_path, scene)
    whole = read_scene(path).sensor
    text = path.read_text()
    points = re.findall(r" *<Point>.*?</Point>\n", text, re.DOTALL)
    # points every 4 ms from 3 ms after the first line on
    seconds = scene.start + 0.003 + 0.0043 * np.arange(60)
    place, speed = scene.orbit(seconds)
    made = "".join(
        f"<Point><LOCATION_XYZ>{' '.join(map(repr, p.tolist()))}</LOCATION_XYZ>"
        f"<VELOCITY_XYZ>{' '.join(map(repr, v.tolist()))}</VELOCITY_XYZ><TIME>{clock(scene, t)}</TIME></Point>\n"
        for t, p, v in zip(seconds, place, speed, strict=True)
    )
    path.write_text(text.replace("".join(points), made))
    found = read_scene(path).sensor
    row = np.array([0.0, 20.0, 68.0, 2000.0])
    away = found.ground(row, 100.0) - whole.ground(row, 100.0)
    # times with nanoseconds make 4 um of position, which a spline 3 ms beyond its first points enlarges tenfold
    assert np.abs(away).max() < 1e-3
    # 200 ms are too much
    for t, p, v in zip(seconds, place, speed, strict=True):
        (q,), (u,) = scene.orbit(np.array([t + 0.197]))
        made = made.replace(clock(scene, t), clock(scene, t + 0.197), 1)
        for old, new in ((p, q), (v, u)):
            made = made.replace(" ".join(map(repr, old.tolist())), " ".join(map(repr, new.tolist())), 1)
    path.write_text(text.replace("".join(points), made))
    with pytest.raises(InputError, match="begins before the ephemeris"):
        read_scene(path)


@pytest.mark.parametrize("name", SCENES)
def test_orbit_and_attitude_of_a_dimap_are_those_of_a_platform(tmp_path: Path, name: str) -> None:
    """Files of a pass take it as they take SP3 and AEM."""
    path = write(tmp_path, SCENES[name])
    spec = PlatformFilesSpec.model_validate(
        {"orbit": {"file": path.name}, "attitude": {"file": path.name, "body_axes": ["forward", "right", "down"]}}
    )
    table = platform_table(*read_platform(spec, tmp_path))
    scene = read_scene(path)
    trajectory = TabulatedTrajectory(table)
    t = scene.sensor.time(np.array([0.0, 100.0, SCENES[name].lines - 1.0]))
    assert scene.epoch == table.epoch
    assert np.array_equal(trajectory.position(t), scene.sensor.trajectory.position(t))
    assert np.array_equal(trajectory.body_to_itrs(t), scene.sensor.trajectory.body_to_itrs(t))


def test_bands(tmp_path: Path) -> None:
    path = write(tmp_path, replace(SPOT, bands=("B0", "B1")))
    read_dimap(path)  # they look alike
    text = path.read_text()
    other = text.replace("<XLOS_0>-0.022<", "<XLOS_0>-0.021<", 1)
    assert other != text
    path.write_text(other)
    with pytest.raises(InputError, match="bands have different look angles"):
        read_dimap(path)
    one, two = (read_dimap(path, band) for band in ("B0", "B1"))
    assert one.right[0] == pytest.approx(two.right[0] - 0.001)
    with pytest.raises(InputError, match="no such band"):
        read_dimap(path, "B7")


def test_a_billion_laughs_and_files_that_are_too_deep_or_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refused where they begin: expanded, the first would have 10^13 letters."""
    monkeypatch.setattr(xml_file, "_MOST_ELEMENTS", 1000)
    laughs = "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(12))
    bad = {
        "entities": f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a0 "ha">{laughs}]><x>&a12;</x>',
        "too deep or too long": "<a>" * 100_000,
        "deep or too long": f"<a>{'<b/>' * 1000}</a>",
    }
    for message, text in bad.items():
        (tmp_path / "DIM.XML").write_text(text)
        with pytest.raises(InputError, match=message):
            read_dimap(tmp_path / "DIM.XML")


@pytest.mark.parametrize(
    ("scale", "cameras", "words"),
    [("UTC", ("pan",), ""), ("UTC", ("pan", "ms"), "the times of one line"), ("GPS", ("pan",), "in UTC")],
)
def test_line_times_of_a_scene(tmp_path: Path, scale: str, cameras: tuple[str, ...], words: str) -> None:
    path = write(tmp_path, SPOT)  # over midnight
    spec = LineTimesFileSpec.model_validate({"file": path.name, "time_scale": scale, "moment": "middle"})
    if words:
        with pytest.raises(InputError, match=words):
            read_line_clocks(spec, cameras, tmp_path)
        return
    found, scene = read_line_clocks(spec, cameras, tmp_path)["pan"], read_scene(path)
    moments = found.clock.instants("UTC").since(scene.epoch)
    # the table's seconds of the day have 1e-11 s
    np.testing.assert_allclose(moments, scene.sensor.time(found.line), rtol=0, atol=1e-9)


def against_the_stars(text: str) -> str:
    """A file with velocities that are larger by omega x P, in the same axes."""

    def larger(found: re.Match[str]) -> str:
        place, speed = (np.array(found[k].split(), float) for k in (1, 2))
        speed = speed + np.cross([0.0, 0.0, 7.292115e-5], place)
        return found[0].replace(found[2], " ".join(map(repr, speed.tolist())))

    return re.sub(r"<LOCATION_XYZ[^>]*>([^<]*)</LOCATION_XYZ>\s*<VELOCITY_XYZ[^>]*>([^<]*)<", larger, text)


def test_velocities_against_the_stars_are_recognised(tmp_path: Path) -> None:
    """The model is that of the same orbit; rounding of the rate of the Earth is 1e-10 m/s."""
    path = write(tmp_path, PLEIADES)
    usual = read_dimap(path)
    path.write_text(against_the_stars(path.read_text()))
    found = read_dimap(path)
    assert (usual.inertial_velocity, found.inertial_velocity) == (False, True)
    assert np.abs(found.orbit.velocity - usual.orbit.velocity).max() < 1e-4
    # half of it is neither
    halved = re.sub(r"(<VELOCITY_XYZ[^>]*>)(\S+)", lambda m: m[1] + repr(0.9 * float(m[2])), path.read_text())
    path.write_text(halved)
    with pytest.raises(InputError, match="not the velocity of these positions"):
        read_dimap(path)


def test_velocities_of_other_files_are_not_those_against_the_stars() -> None:
    """Positions 1 s to 15 min apart: what is right never looks like the other, and the other is named."""
    for step in (1.0, 10.0, 60.0, 300.0, 900.0):
        t = PLEIADES.start + step * np.arange(12.0)
        place, speed = PLEIADES.orbit(t)
        clock_readings = Readings(np.full(12, 58000), t)
        for velocity, wrong in ((speed, False), (speed + np.cross([0.0, 0.0, 7.292115e-5], place), step < 500.0)):
            orbit = OrbitReadings("a.sp3", clock_readings, place, velocity, "ITRS", "UTC")
            if wrong:
                with pytest.raises(InputError, match=r"inertial.*omega x P"):
                    require_earth_fixed_velocity(orbit)
            else:
                require_earth_fixed_velocity(orbit)
