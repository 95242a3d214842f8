"""The command that optimises a camera: errors told by line; the camera of the library, made again."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from scenes.models.camera_design import resolve_design
from scenes.specs.camera import CameraSpec
from scenes.specs.load import EXAMPLES, load_camera
from scenes.yaml.errors import InputError
from scenes.yaml.translate import validate
from scenes.yaml.yaml_file import read_yaml
from twin.design.__main__ import app

EXAMPLE = EXAMPLES / "design_gf7_short.yaml"
SHORT = """\
camera: gf7
name: small
vary:
  image: [z]
envelope: {envelope}
steps: 1
"""


def run(tmp_path: Path, envelope: str):
    file = tmp_path / "small.yaml"
    file.write_text(SHORT.format(envelope=envelope), "utf-8")
    return CliRunner().invoke(app, [str(file), "--out", str(tmp_path / "out"), "--quiet"])


def test_an_envelope_that_cannot_be_had(tmp_path) -> None:
    result = run(tmp_path, "50 percent")
    assert result.exit_code == 2
    assert "small.yaml:5: envelope: no prescription near the start holds all constraints" in result.output.replace(
        "\n", ""
    )
    assert not (tmp_path / "out").exists()


def test_a_run_folder(tmp_path) -> None:
    """Only the focus: nothing gets shorter, and little better; but the camera's file can be read."""
    result = run(tmp_path, "101 percent")
    assert result.exit_code == 0, result.output
    out = tmp_path / "out"
    camera = validate(CameraSpec, read_yaml(out / "artefacts" / "small.yaml"))
    gf7 = load_camera("gf7")
    assert camera.name == "small"
    assert camera.image.z == pytest.approx(gf7.image.z, abs=1e-3)
    assert camera.image.z != gf7.image.z
    assert camera.bands == gf7.bands
    again = resolve_design(out / "config.yaml")
    assert again.camera == gf7
    assert "<svg" in (out / "report.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  M3: [z", "  M4: [z", "vary.M4: no such mirror"),
        ("image: [z]", "image: [radius]", "the image is a plane"),
        ("camera: gf7\n", "camera: gf8\n", "camera: no such name in cameras"),
    ],
)
def test_what_is_wrong_with_a_file(tmp_path, old: str, new: str, message: str) -> None:
    text = EXAMPLE.read_text("utf-8")
    assert old in text
    file = tmp_path / "wrong.yaml"
    file.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(InputError, match=message):
        resolve_design(file)


@pytest.mark.slow
def test_the_example_makes_the_camera_of_the_library(tmp_path) -> None:
    """Radii, places and conics to a thousandth: other roundings stop the search a little elsewhere in a flat valley."""
    result = CliRunner().invoke(app, [str(EXAMPLE), "--out", str(tmp_path / "out"), "--quiet"])
    assert result.exit_code == 0, result.output
    made = validate(CameraSpec, read_yaml(tmp_path / "out" / "artefacts" / "gf7_short.yaml"))
    kept = load_camera("gf7_short")
    assert made.image.z == pytest.approx(kept.image.z, rel=1e-3)
    for name, mirror in made.mirrors.items():
        assert mirror.radius == pytest.approx(kept.mirrors[name].radius, rel=1e-3)
        assert mirror.conic == pytest.approx(kept.mirrors[name].conic, rel=1e-2)
        assert mirror.z == pytest.approx(kept.mirrors[name].z, abs=1e-3)
