"""Files of a simulated pass: units, defaults, the way to its camera and detectors, and what is said of mistakes."""

import math
from pathlib import Path

import pytest

from scenes.schema import json_schema
from scenes.specs.load import DETECTORS, LIBRARY, ORBIT, PAYLOADS, SCENES
from scenes.specs.orbit.setup import SimulateSetup, load_three_line_camera, resolve_simulate
from scenes.yaml.errors import InputError
from tests.scenes.orbit_files import assert_told, write

EXAMPLE = SCENES / ORBIT / "simulate.yaml"
SMALL = """
name: small
camera: th1
orbit: {epoch: 2011-03-05T03:05:00Z, passing: {longitude: 116 deg, latitude: 40 deg}}
patch: {pixel: 6000}
"""


def test_example() -> None:
    setup = resolve_simulate(EXAMPLE)
    assert setup.camera == load_three_line_camera("th1")
    assert set(setup.detectors) == {"th1_line"}
    test = setup.test
    assert (test.patch.lines, test.patch.pixels, test.oversampling) == (1000, 1000, 3)
    assert test.ground.light.elevation == pytest.approx(math.radians(38.0), rel=1e-15)
    assert test.control.shift == (0.6, -0.4)
    image = setup.camera.image_of("backward")
    assert image is not None
    assert image.wavefront["Z4"] == 20e-9


def test_what_is_not_written(tmp_path: Path) -> None:
    test = resolve_simulate(write(tmp_path, SMALL)).test
    assert test.lines == ("forward", "nadir", "backward")
    assert (test.ground.terrain.kind, test.ground.terrain.relief) == ("real", None)
    assert (test.patch.line, test.patch.lines, test.seed) == ("nadir", 1000, 0)
    assert math.degrees(test.control.light.elevation) == pytest.approx(60.0)


def test_a_camera_and_a_detector_of_ones_own(tmp_path: Path) -> None:
    sheet = (LIBRARY / DETECTORS / "th1_line.yaml").read_text("utf-8").replace("name: th1_line", "name: mine")
    (tmp_path / "mine.yaml").write_text(sheet, "utf-8")
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8").replace("detector: th1_line", "detector: mine.yaml")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    setup = resolve_simulate(write(tmp_path, SMALL.replace("th1", "own.yaml")))
    assert setup.detectors["mine.yaml"].name == "mine"


def test_config_reads_back_to_the_same_values(tmp_path: Path) -> None:
    setup = resolve_simulate(EXAMPLE).with_seed(7)
    again = resolve_simulate(write(tmp_path, setup.to_yaml()))
    assert isinstance(again, SimulateSetup)
    assert again == setup
    assert again.to_yaml() == setup.to_yaml()


def test_schema() -> None:
    assert "ground" in json_schema("orbit_simulate")["properties"]


# change of the small file, key that is named, what is said
PATCH = "patch: {pixel: 6000}"
BAD = {
    "no size": (PATCH, "patch: {pixel: 6000, lines: 0}", "patch.lines", ["16"]),
    "line": (PATCH, f"{PATCH}\nlines: [forward, nadi]", "lines", ["no such line", "did you mean 'nadir'"]),
    "twice": (PATCH, f"{PATCH}\nlines: [nadir, nadir]", "lines", ["each line once"]),
    "patch line": (PATCH, "patch: {pixel: 6000, line: fore}", "patch.line", ["no such line", "forward"]),
    "pixel": (PATCH, "patch: {pixel: 12000}", "patch.pixel", ["outside the line", "11999.5"]),
    "time": (PATCH, "patch: {pixel: 6000, time: 11 min}", "patch.time", ["outside the orbit data"]),
    "change": (PATCH, f"{PATCH}\nperturb: {{back: {{}}}}", "perturb.back", ["no such line"]),
    "relief": (PATCH, f"{PATCH}\nground: {{terrain: {{kind: fractal}}}}", "ground.terrain", ["without relief"]),
    "spacing": (PATCH, f"{PATCH}\nground: {{texture: {{spacing: 0 m}}}}", "ground.texture.spacing", ["0.1 m"]),
}


@pytest.mark.parametrize("case", BAD)
def test_mistakes_are_told(case: str, tmp_path: Path) -> None:
    assert_told(resolve_simulate, tmp_path, SMALL, BAD[case])


def test_an_odd_wavefront_term(tmp_path: Path) -> None:
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8").replace("Z6: 18 nm", "Z8: 18 nm")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    with pytest.raises(InputError, match="shift the image"):
        resolve_simulate(write(tmp_path, SMALL.replace("th1", "own.yaml")))


@pytest.mark.parametrize(
    ("outlines", "said"),
    [
        ("[[[0, 0], [1, 0], [0.2, 0.2], [0, 1]]]", "convex"),
        ("[[[0, 0], [1, 0]]]", "convex"),
        ("[[[0, 0], [1, 0], [0, 1]], [[0.1, 0.1], [1, 0.1], [0.1, 1]]]", "overlap"),
        ("[[[-2, -2], [2, -2], [2, 2], [-2, 2]]]", "covered"),
    ],
)
def test_outlines_before_a_lens(outlines: str, said: str, tmp_path: Path) -> None:
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8")
    text = text.replace("  f_number: 6\n", f"  f_number: 6\n  obstruction: {outlines}\n")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    with pytest.raises(InputError, match=said):
        resolve_simulate(write(tmp_path, SMALL.replace("th1", "own.yaml")))


def test_an_outline_before_a_lens_comes_through_config_yaml(tmp_path: Path) -> None:
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8")
    good = "[[[-0.6, 0.6], [-0.2, 0.6], [-0.2, 1.1], [-0.6, 1.1]]]"
    text = text.replace("  f_number: 6\n", f"  f_number: 6\n  obstruction: {good}\n")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    setup = resolve_simulate(write(tmp_path, SMALL.replace("th1", "own.yaml")))
    image = setup.camera.image_of("nadir")
    assert image is not None
    assert image.obstruction[0][0] == (-0.6, 0.6)
    config = tmp_path / "config.yaml"
    config.write_text(setup.to_yaml(), "utf-8")
    again = resolve_simulate(config).camera.image_of("nadir")
    assert again is not None
    assert again.obstruction == image.obstruction


def test_a_camera_without_images(tmp_path: Path) -> None:
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8")
    first, last = text.index("image:"), text.index("lines:\n")
    (tmp_path / "own.yaml").write_text(text[:first] + text[last:], "utf-8")
    with pytest.raises(InputError, match="does not say how its line forward"):
        resolve_simulate(write(tmp_path, SMALL.replace("th1", "own.yaml")))
