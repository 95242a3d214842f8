"""Files of the intersection angle test: units, defaults, the way to its camera, and what is said of mistakes."""

import math
from pathlib import Path

import pytest

from scenes.schema import json_schema
from scenes.specs.load import LIBRARY, ORBIT, PAYLOADS, SCENES, load_camera, load_instrument
from scenes.specs.orbit.setup import AngleSetup, load_three_line_camera, resolve_angle
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from tests.scenes.orbit_files import assert_told, write

EXAMPLE = SCENES / ORBIT / "angle.yaml"
SMALL = """
name: small
camera: th1
orbit: {epoch: 2011-03-05T03:05:00Z, passing: {longitude: 116 deg, latitude: 40 deg}}
strips: {points: 3, first: 0, last: 11999}
"""


def test_example() -> None:
    setup = resolve_angle(EXAMPLE)
    assert setup.camera == load_three_line_camera("th1")
    test = setup.test
    assert (test.errors.station, test.errors.points, test.time) == (0.5, 1.5, 0.0)
    assert test.perturb["forward"].rotate[1] == pytest.approx(math.radians(4.0 / 3600.0), rel=1e-15)
    assert test.orbit.passing.direction == "descending"


def test_what_is_not_written(tmp_path: Path) -> None:
    test = resolve_angle(write(tmp_path, SMALL)).test
    assert dict(test.perturb) == {}
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
    "camera": (
        "camera: th1",
        "camera: th2",
        "camera",
        ["no such name in payloads or instruments", "did you mean 'th1'"],
    ),
    "no file": ("camera: th1", "camera: none.yaml", "camera", ["no such file", "none.yaml"]),
    "unit": ("camera: th1", "camera: th1\nerrors: {points: 1.5 s}", "errors.points", ["not of a length"]),
    "sign": ("camera: th1", "camera: th1\nerrors: {station: -1 m}", "errors.station", ["at least 0 m"]),
    "late": ("camera: th1", "camera: th1\ntime: 601 s", "time", ["outside the orbit data", "-10 min and 10 min"]),
    "early": ("camera: th1", "camera: th1\ntime: -11 min", "time", ["outside the orbit data", "longer orbit"]),
    "line": (
        "camera: th1",
        "camera: th1\nperturb: {rear: [0 deg, 0 deg, 0 deg]}",
        "perturb.rear",
        ["no such line", "forward, nadir"],
    ),
    "a shifted line": (
        "camera: th1",
        "camera: th1\nperturb: {backward: {shift: [1 um, 0 um, 0 um]}}",
        "perturb.backward.shift",
        ["does not allow shift", "an instrument of traced cameras"],
    ),
    "a line's pivot": (
        "camera: th1",
        "camera: th1\nperturb: {backward: {rotate: [1 arcsec, 0 arcsec, 0 arcsec], pivot: rear_node}}",
        "perturb.backward.pivot",
        ["has no pivots"],
    ),
    "a turn without unit": (
        "camera: th1",
        "camera: th1\nperturb: {backward: [1, 0, 0]}",
        "perturb.backward",
        ["without a unit"],
    ),
    "an angle's line": (
        "camera: th1",
        "camera: th1\nangles: {alpha: [forward, nadirr]}",
        "angles.alpha",
        ["no such line", "forward, nadir, backward, high_resolution, multispectral", "did you mean 'nadir'"],
    ),
    "one line twice": (
        "camera: th1",
        "camera: th1\nangles: {alpha: [nadir, nadir]}",
        "angles.alpha",
        ["no angle with itself", "two different lines"],
    ),
    "no angles": ("camera: th1", "camera: th1\nangles: {}", "angles", ["no angles", "alpha: [forward, nadir]"]),
}


@pytest.mark.parametrize("case", BAD)
def test_mistakes_are_told(case: str, tmp_path: Path) -> None:
    assert_told(resolve_angle, tmp_path, SMALL, BAD[case])


def test_a_camera_without_the_lines(tmp_path: Path) -> None:
    """Other lines are no mistake, but then the file says which angles; and one line has none."""
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8")
    (tmp_path / "own.yaml").write_text(text.replace("  backward:", "  rear:"), "utf-8")
    small = SMALL.replace("th1", "own.yaml")
    with pytest.raises(InputError, match=r"camera: .*not said.*forward, nadir, rear.*`angles:`"):
        resolve_angle(write(tmp_path, small))
    setup = resolve_angle(write(tmp_path, small + "angles: {all: [forward, rear]}\n"))
    assert dict(setup.angles) == {"all": ("forward", "rear")}
    with pytest.raises(InputError, match=r"perturb.backward.*no such line"):
        resolve_angle(
            write(tmp_path, small + "angles: {all: [forward, rear]}\nperturb: {backward: [0 deg, 0 deg, 0 deg]}")
        )
    (tmp_path / "own.yaml").write_text(dump_yaml(_with_lines("nadir")), "utf-8")
    with pytest.raises(InputError, match=r"camera: an angle needs two lines.*nadir in th1.*two lines or more"):
        resolve_angle(write(tmp_path, small))
    (tmp_path / "own.yaml").write_text(dump_yaml(_with_lines("backward", "nadir")), "utf-8")
    assert dict(resolve_angle(write(tmp_path, small)).angles) == {"alpha": ("backward", "nadir")}


def _with_lines(*names: str) -> dict:
    """th1 with some of its lines."""
    plain = load_three_line_camera("th1").plain()
    return {**plain, "lines": {name: plain["lines"][name] for name in names}}


def test_usual_angles_are_filled_in() -> None:
    assert dict(resolve_angle(EXAMPLE).angles) == {"alpha": ("forward", "nadir"), "beta": ("nadir", "backward")}
    setup = resolve_angle(SCENES / ORBIT / "angle_off_axis.yaml")
    assert setup.angles["multispectral"] == ("multispectral", "nadir")
    assert (setup.pixels["high_resolution"], setup.pixels["multispectral"], setup.usual_pixels) == (30000, 6000, 12000)


def test_an_instrument_is_a_camera(tmp_path: Path) -> None:
    """By name or path; and the config.yaml holds it whole."""
    setup = resolve_angle(SCENES / ORBIT / "angle_gf7.yaml")
    assert setup.camera is None
    assert setup.instrument == load_instrument("gf7_pair")
    assert dict(setup.cameras) == {"gf7": load_camera("gf7")}
    assert dict(setup.pixels) == {"forward": 32768, "backward": 32768}
    assert setup.test.perturb["base"].temperature.gradient[2] == pytest.approx(0.4)
    again = resolve_angle(write(tmp_path, setup.to_yaml()))
    assert again == setup
    assert again.to_yaml() == setup.to_yaml()
    text = (LIBRARY / "instruments" / "gf7_pair.yaml").read_text("utf-8").replace("name: gf7_pair", "name: own")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    own = resolve_angle(write(tmp_path, SMALL.replace("th1", "own.yaml")))
    assert own.camera_name == "own"
    assert dict(own.angles) == {"alpha": ("forward", "backward")}


def test_a_config_without_its_camera(tmp_path: Path) -> None:
    text = resolve_angle(SCENES / ORBIT / "angle_gf7.yaml").to_yaml()
    for old, new, words in (
        ("\ninstrument:\n", "\ncamera:\n", "camera"),
        ("cameras:\n  gf7:", "cameras:\n  gf8:", "camera 'gf7' of the instrument's forward is missing"),
    ):
        assert text.count(old) == 1
        with pytest.raises(InputError, match=words):
            resolve_angle(write(tmp_path, text.replace(old, new)))
    data = parse_yaml(text).data
    del data["instrument"]
    with pytest.raises(InputError, match="one camera is tested; found 'neither'"):
        resolve_angle(write(tmp_path, dump_yaml(data)))


def test_schemas_for_editors() -> None:
    angle, camera = json_schema("orbit_angle"), json_schema("three_line_camera")
    assert {"camera", "orbit", "strips"} <= set(angle["required"])
    assert "metres" not in angle["$defs"]["AngleErrorsSpec"]["properties"]["points"]["description"]
    assert {"pixels", "pitch", "lines"} <= set(camera["required"])
