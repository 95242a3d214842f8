"""Files of the intersection angle test: units, defaults, the way to its camera, and what is said of mistakes."""

import math
import re
from pathlib import Path

import pytest

from scenes.errors import InputError
from scenes.load import LIBRARY, ORBIT, PAYLOADS, load_three_line_camera
from scenes.orbit_setup import AngleSetup, resolve_angle
from scenes.schema import json_schema

EXAMPLE = LIBRARY / ORBIT / "angle.yaml"
SMALL = """
name: small
camera: th1
orbit: {epoch: 2011-03-05T03:05:00Z, passing: {longitude: 116 deg, latitude: 40 deg}}
strips: {points: 3, first: 0, last: 11999}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "test.yaml"
    path.write_text(text, "utf-8")
    return path


def test_example() -> None:
    setup = resolve_angle(EXAMPLE)
    assert setup.camera == load_three_line_camera("th1")
    test = setup.test
    assert (test.errors.station, test.errors.points, test.time) == (0.5, 1.5, 0.0)
    assert test.changes["forward"][1] == pytest.approx(math.radians(4.0 / 3600.0), rel=1e-15)
    assert test.orbit.passing.direction == "descending"


def test_what_is_not_written(tmp_path: Path) -> None:
    test = resolve_angle(write(tmp_path, SMALL)).test
    assert dict(test.changes) == {}
    assert (test.errors.station, test.errors.points, test.errors.datum) == (0.5, 1.5, (0.0, 0.0, 0.0))
    effects = test.effects
    assert (effects.light_time, effects.aberration, effects.refraction, effects.corrected) == (True,) * 4
    assert (test.passes, test.seed, test.terrain.relief) == (200, 0, 0.0)


def test_a_camera_of_ones_own_beside_the_file(tmp_path: Path) -> None:
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8").replace("name: th1", "name: own")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    setup = resolve_angle(write(tmp_path, SMALL.replace("th1", "own.yaml")))
    assert setup.camera.name == "own"


def test_config_reads_back_to_the_same_values(tmp_path: Path) -> None:
    setup = resolve_angle(EXAMPLE).with_seed(7)
    again = resolve_angle(write(tmp_path, setup.to_yaml()))
    assert isinstance(again, AngleSetup)
    assert again == setup
    assert again.test.seed == 7
    assert again.to_yaml() == setup.to_yaml()


# change of the small file, key that is named, what is said
BAD = {
    "two points": ("points: 3", "points: 2", "strips.points", ["too few points", "2 on each strip", "3 or more"]),
    "no points": ("points: 3", "points: 0", "strips.points", ["too few points", "3 or more"]),
    "backward": ("first: 0", "first: 11999", "strips.last", ["no length", "after the first"]),
    "past the end": ("last: 11999", "last: 11999.6", "strips.last", ["outside the line", "11999.5", "th1"]),
    "before the begin": ("first: 0", "first: -1", "strips.first", ["outside the line", "-0.5 to 11999.5"]),
    "camera": ("camera: th1", "camera: th2", "camera", ["no such name in payloads", "did you mean 'th1'"]),
    "no file": ("camera: th1", "camera: none.yaml", "camera", ["no such file", "none.yaml"]),
    "unit": ("camera: th1", "camera: th1\nerrors: {points: 1.5 s}", "errors.points", ["not of a length"]),
    "sign": ("camera: th1", "camera: th1\nerrors: {station: -1 m}", "errors.station", ["at least 0 m"]),
    "late": ("camera: th1", "camera: th1\ntime: 601 s", "time", ["outside the orbit data", "-10 min and 10 min"]),
    "early": ("camera: th1", "camera: th1\ntime: -11 min", "time", ["outside the orbit data", "longer orbit"]),
    "line": (
        "camera: th1",
        "camera: th1\nchanges: {backward: [0 deg, 0 deg, 0 deg]}",
        "changes.backward",
        ["no such line", "forward, nadir"],
    ),
    "unknown key": ("camera: th1", "camera: th1\npass: 3", "pass", ["did you mean 'passes'"]),
}


@pytest.mark.parametrize("case", BAD)
def test_mistakes_are_told(case: str, tmp_path: Path) -> None:
    old, new, key, words = BAD[case]
    assert SMALL.count(old) == 1
    path = write(tmp_path, SMALL.replace(old, new))
    with pytest.raises(InputError) as caught:
        resolve_angle(path)
    found = re.search(rf"{re.escape(str(path))}:(\d+): {re.escape(key)}", str(caught.value))
    assert found, caught.value
    assert key.split(".")[-1] in path.read_text("utf-8").splitlines()[int(found[1]) - 1]
    for word in words:
        assert word in str(caught.value)


def test_a_camera_without_the_lines(tmp_path: Path) -> None:
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8").replace("  aft:", "  rear:")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    with pytest.raises(InputError, match=r"no aft line.*forward, nadir"):
        resolve_angle(write(tmp_path, SMALL.replace("th1", "own.yaml")))


def test_schemas_for_editors() -> None:
    angle, camera = json_schema("orbit_angle"), json_schema("three_line_camera")
    assert {"camera", "orbit", "strips"} <= set(angle["required"])
    assert "metres" not in angle["$defs"]["AngleErrorsSpec"]["properties"]["points"]["description"]
    assert {"pixels", "pitch", "lines"} <= set(camera["required"])
