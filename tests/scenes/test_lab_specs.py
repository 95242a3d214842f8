"""Files of the laboratory's focus test: what they may say, and how they say what is wrong."""

from pathlib import Path

import numpy as np
import pytest

from scenes.models.camera_model import build_camera_under_test
from scenes.specs.camera_tests import FocusTestSpec
from scenes.specs.load import LAB, SCENES, library_names
from scenes.specs.resolved import resolve_focus
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import dump_yaml, parse_yaml

FILE = SCENES / LAB / "focus.yaml"


def changed(folder: Path, old: str, new: str) -> tuple[Path, int]:
    """A copy of the file with one place changed, and the line of that place."""
    text = FILE.read_text("utf-8")
    assert text.count(old) == 1
    path = folder / "own.yaml"
    path.write_text(text.replace(old, new), "utf-8")
    return path, text[: text.index(old)].count("\n") + 1


def test_the_file_and_what_it_refers_to() -> None:
    assert "focus" in library_names(LAB)
    setup = resolve_focus(FILE)
    assert list(setup.camera.bands) == ["P", "B1", "B2", "B3", "B4"]
    assert set(setup.detectors) == {band.detector for band in setup.camera.bands.values()}
    collimator = setup.test.collimator.model
    assert (collimator.focal_length, collimator.radius) == (20.0, 0.4)
    # 10 nm rms, as the comment beside it says
    assert np.sqrt(sum(v**2 for v in collimator.wavefront.values())) == pytest.approx(10e-9, rel=0.02)


def test_it_reads_back(tmp_path: Path) -> None:
    setup = resolve_focus(FILE)
    again = validate(FocusTestSpec, parse_yaml(dump_yaml(setup.test.plain())))
    assert again == setup.test
    assert hash(again) == hash(setup.test)
    config = tmp_path / "config.yaml"
    config.write_text(setup.with_seed(17).to_yaml(), "utf-8")
    read = resolve_focus(config)
    assert read.test == setup.test.model_copy(update={"seed": 17})
    assert read.camera == setup.camera
    assert dict(read.detectors) == dict(setup.detectors)


@pytest.mark.parametrize(
    ("old", "new", "key", "words"),
    [
        ("camera: gf7\n", "camera: gf8\n", "camera", ["no such name", "did you mean 'gf7'"]),
        ("camera: gf7\n", "camera: gf7_conic\n", "camera", ["at one X'", "different offsets"]),
        ("aperture: 0.8 m ", "aperture: 0.8 ", "collimator.aperture", ["without a unit"]),
        ("wavefront: {Z5: 6 nm, Z8", "wavefront: {Z0: 6 nm, Z8", "collimator.wavefront", ["not a Zernike term"]),
        ("angle: 5 deg", "angle: 1 deg", "edge.angle", ["2 deg"]),
        ("angle: 5 deg", "angle: 45 deg", "edge.angle", ["15 deg"]),
        ("region: 64", "region: 16", "edge.region", ["32"]),
        ("fields: [-0.9, -0.45, 0, 0.45, 0.9]", "fields: [0.5, 0.5]", "fields", ["given twice"]),
        ("fields: [-0.9, -0.45, 0, 0.45, 0.9]", "fields: [0.5]", "fields", ["2"]),
        ("fields: [-0.9, -0.45, 0, 0.45, 0.9]", "fields: [0.5, 1.2]", "fields[1]", ["1"]),
        ("white: 60 percent", "white: 60", "white", ["without a unit"]),
        ("step: 0.08 mm", "step: 0.8 mm", "scan.step", ["fewer than six positions", "a smaller step"]),
        ("points: 9", "points: 6", "scan.points", ["7"]),
        ("tilt: 15 deg ", "tilt: 50 deg ", "mount.tilt", ["30 deg"]),
        ("clearance: 1 mm", "clearence: 1 mm", "mount.clearence", ["did you mean 'clearance'"]),
        ("rounds: 1", "rounds: 0", "rounds", ["1"]),
        ("M3: {figure: {Z5: -5 nm, Z9: 20 nm}}", "M3: {temperature: 2 K}", "as_built.M3.temperature", ["not modelled"]),
    ],
)
def test_mistakes(old: str, new: str, key: str, words: list[str], tmp_path: Path) -> None:
    path, line = changed(tmp_path, old, new)
    with pytest.raises(InputError) as caught:
        resolve_focus(path)
    issue = next(i for i in caught.value.issues if str(i).startswith(f"{path}:{line}: {key}"))
    for word in words:
        assert word in str(issue)


def test_a_mirror_that_is_not_there(tmp_path: Path, backend) -> None:
    path, line = changed(tmp_path, "  M3: {figure", "  M4: {figure")
    setup = resolve_focus(path)
    with pytest.raises(InputError) as caught:
        build_camera_under_test(setup.test, setup.camera, backend)
    assert str(caught.value).startswith(f"{path}:{line}: as_built.M4: ")
    assert "M1" in str(caught.value)
    path, line = changed(tmp_path, "  M3: {figure: {Z5: -5 nm, Z9: 20 nm}}", "  focal_plane: {figure: {Z5: 5 nm}}")
    setup = resolve_focus(path)
    with pytest.raises(InputError, match="focal_plane") as caught:
        build_camera_under_test(setup.test, setup.camera, backend)
    assert caught.value.line == line


def test_bands_at_one_place_cannot_tell_a_tilt(tmp_path: Path) -> None:
    setup = resolve_focus(FILE)
    alone = setup.camera.model_copy(update={"bands": type(setup.camera.bands)({"P": setup.camera.bands["P"]})})
    config = tmp_path / "config.yaml"
    config.write_text(setup.model_copy(update={"camera": alone}).to_yaml(), "utf-8")
    with pytest.raises(InputError, match="at one X', so the tilt about the line cannot be told"):
        resolve_focus(config)
