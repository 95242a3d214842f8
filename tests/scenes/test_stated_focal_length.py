"""A camera whose surfaces have another focal length than its file states is refused, with the number that is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from scenes.models.camera_model import derive_camera
from scenes.specs.load import load_camera
from scenes.yaml.errors import InputError
from tests.tiers import quick

GF7 = (Path(__file__).parents[2] / "scenes/library/cameras/gf7.yaml").read_text("utf-8")


def changed(tmp_path: Path, old: str, new: str) -> Path:
    """The library's camera with one number changed."""
    assert GF7.count(old) == 1
    path = tmp_path / "mine.yaml"
    path.write_text(GF7.replace(old, new).replace("name: gf7", "name: mine"), "utf-8")
    return path


WRONG = [
    ("radius: -6.74535927468851 m", "radius: 6.74535927468851 m", "1.367 m", "sign of the radius of M1",
     "mirrors.M1.radius: -6.74535927468851 m"),
    ("z: -2.01593047747168 m", "z: 2.01593047747168 m", "1.471 m", "sign of the z of M2",
     "mirrors.M2.z: -2.01593047747168 m"),
    ("radius: -4.36068001118994 m", "radius: 4.36068001118994 m", "18.81 m", "sign of the radius of M3",
     "mirrors.M3.radius: -4.36068001118994 m"),
    ("z: -2.01593047747168 m", "z: -2.01593047747168 mm", "2.267 m", "mm in place of m", "mirrors.M2.z: -2.0159"),
    ("focal_length: 5.52 m", "focal_length: 5.52 mm", "5.51 m", "mm in place of m", "focal_length: 5.52 m"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "traced", "cause", "line"), quick(1, WRONG))
def test_wrong_number_is_named(tmp_path: Path, backend, old: str, new: str, traced: str, cause: str, line: str) -> None:
    path = changed(tmp_path, old, new)
    with pytest.raises(InputError) as error:
        derive_camera(load_camera(str(path)), backend)
    text = str(error.value)
    assert error.value.key == ("focal_length",)
    assert error.value.line == GF7[: GF7.index("focal_length:")].count("\n") + 1
    assert traced in text
    assert cause in text
    assert error.value.suggestion is not None
    assert error.value.suggestion.startswith(line)


def test_tilt_of_the_wrong_sign_is_named(tmp_path: Path, backend) -> None:
    # turned by -8 deg about x the first mirror leaves 5.42 m, turned by +8 deg 6.9 m
    tilted = "radius: -6.74535927468851 m\n    rotate: [{} deg, 0 deg, 0 deg]"
    right = changed(tmp_path, "radius: -6.74535927468851 m", tilted.format(-8))
    assert derive_camera(load_camera(str(right)), backend).line_principal_distance == pytest.approx(5.45, abs=0.1)
    wrong = changed(tmp_path, "radius: -6.74535927468851 m", tilted.format(8))
    with pytest.raises(InputError, match="sign of the tilt about x of M1") as error:
        derive_camera(load_camera(str(wrong)), backend)
    assert error.value.suggestion == "mirrors.M1.rotate: [-8 deg, 0 arcsec, 0 arcsec]"


def test_a_nominal_focal_length_may_differ_by_some_percent(tmp_path: Path, backend) -> None:
    for length in ("5.1 m", "6.0 m"):
        model = derive_camera(
            load_camera(str(changed(tmp_path, "focal_length: 5.52 m", f"focal_length: {length}"))), backend
        )
        assert model.line_principal_distance == pytest.approx(5.5104, abs=1e-4)


CASSEGRAIN = """
name: mine
focal_length: 4 m
entrance_pupil: 500 mm
field_bias: 0 deg
field: {x: 0.2 deg, y: 0.2 deg}
wavelength: 650 nm
stop: M1
mirrors:
  M1: {z: 0 m, radius: -2 m, conic: -1}
  M2: {z: -0.7 m, radius: -0.8 m, conic: -2.77777777777778}
image: {z: 0.5 m}
line: {pixels: 2000, pitch: 7 um}
"""


def test_a_misplaced_image_plane_is_no_other_focal_length(tmp_path: Path, backend) -> None:
    """Chief rays that are not parallel there meet it 30 % farther out; that is what refocusing is for."""
    path = tmp_path / "mine.yaml"
    path.write_text(CASSEGRAIN.replace("image: {z: 0.5 m}", "image: {z: 0.85 m}"), "utf-8")
    model = derive_camera(load_camera(str(path)), backend)
    assert model.line_principal_distance > 4.0 * 1.15
    # the sign of a mirror's radius is another thing
    path.write_text(CASSEGRAIN.replace("radius: -0.8 m", "radius: 0.8 m"), "utf-8")
    with pytest.raises(InputError, match="sign of the radius of M2"):
        derive_camera(load_camera(str(path)), backend)


def test_no_single_number_is_wrong(tmp_path: Path, backend) -> None:
    with pytest.raises(InputError, match="stated as 9 m") as error:
        derive_camera(load_camera(str(changed(tmp_path, "focal_length: 5.52 m", "focal_length: 9 m"))), backend)
    assert error.value.suggestion is None
    assert "likely" not in str(error.value)
