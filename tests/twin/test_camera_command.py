"""The command that judges a camera: its verdict, its numbers by hand, refocusing, the files it takes and refuses."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scenes.models.camera_design import file_with_plane
from scenes.models.camera_sharpness import FIELDS, FocalPlane, sharpness
from scenes.specs.camera import CameraSpec
from scenes.specs.load import LIBRARY, load_camera
from scenes.specs.resolved import resolve_camera
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import read_yaml
from tests.twin.commands import invoke
from tests.twin.study_bench import REFUSED
from tests.twin.test_blurred_cameras import GF7, gf7_with
from twin.camera.__main__ import app
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_plots import distortion_figure
from twin.camera.camera_run import find_focus, kind_of, run_camera
from twin.camera.field_maps import distortion


@pytest.fixture(scope="module")
def gf7_alone(backend, gf7) -> CameraOptics:
    return CameraOptics.alone(gf7, backend)


def test_distortion_is_that_of_the_papers_formula(gf7_alone) -> None:
    found = distortion(gf7_alone)
    t = np.tan(found.angle)
    assert found.line_distance == pytest.approx(5.51199976, abs=1e-7)  # tests of the truth: 5.511999
    assert np.sum(found.residual * t) == pytest.approx(0.0, abs=1e-15)  # least squares leaves nothing along its column
    np.testing.assert_allclose(found.residual, -found.residual[::-1], atol=1e-12)  # symmetric
    assert np.max(np.abs(found.residual)) == pytest.approx(19.28e-6, abs=0.01e-6)
    # the principal point of the field is on the parent axis, where a perfect camera's is: 5.51 m * tan(6 deg) off
    assert found.point[0] == pytest.approx(0.0, abs=1e-9)
    assert found.point[1] == pytest.approx(-found.distance * np.tan(np.deg2rad(6.0)), rel=2e-3)
    assert found.rms < found.largest < 1e-3
    away = (found.places - found.ideal).reshape(-1, 2)
    np.testing.assert_allclose(away.mean(axis=0), 0.0, atol=1e-12)
    # as drawn: a grid whose departures stay within half of its spacing, and the line's in millimetres and micrometres
    left, right, *_ = distortion_figure(SimpleNamespace(distortion=found)).axes
    reach = np.abs(np.concatenate([line.get_xydata() for line in left.lines])).max(axis=0)
    np.testing.assert_allclose(reach, 1e3 * np.abs(found.ideal).max(axis=(0, 1)), rtol=0.3)
    np.testing.assert_allclose(right.lines[0].get_xydata(), np.stack([1e3 * found.position, 1e6 * found.residual], -1))


def test_kinds_of_aberration() -> None:
    kinds = {4: "defocus", 5: "astigmatism", 6: "astigmatism", 7: "coma", 9: "trefoil", 11: "spherical aberration"}
    kinds |= {13: "secondary astigmatism", 22: "secondary spherical aberration"}
    assert {term: kind_of(term) for term in kinds} == kinds


@pytest.mark.second
def test_refocusing_finds_a_focal_plane_that_was_moved(backend) -> None:
    """Of a sharp camera 1 mm out of focus, and 5 mrad out of level: back to where its own best focus is."""
    camera = load_camera("gf7")
    own = find_focus(camera, backend, tilt=True)
    moved = camera.model_copy(
        update={"image": camera.image.model_copy(update={"z": camera.image.z + 1e-3, "tilt": 5e-3})}
    )
    found = find_focus(moved, backend, tilt=True)
    assert found.after.z == pytest.approx(own.after.z, abs=1e-6)
    assert found.after.tilt == pytest.approx(own.after.tilt, abs=1e-6)
    assert found.errors_before.max() > 0.3 > found.errors_after.max()
    assert {(-x, y) for x, y in FIELDS} == set(FIELDS)  # both sides count alike
    assert len(set(FIELDS)) == len(found.errors_after)
    assert abs(find_focus(camera, backend, tilt=False).after.z - camera.image.z) < 3e-6  # it was designed so


def test_the_refocused_file_keeps_all_else(backend, tmp_path) -> None:
    file, made = gf7_with(tmp_path, "-2.02 m"), tmp_path / "gf7_refocused.yaml"
    given = load_camera(file)
    made.write_text(file_with_plane(given, find_focus(given, backend, tilt=False).after, "gf7_refocused"), "utf-8")
    before, after = file.read_text("utf-8"), made.read_text("utf-8")
    comments = [line for line in before.splitlines() if line.lstrip().startswith("#")]
    assert comments
    assert [line for line in after.splitlines() if line.lstrip().startswith("#")] == comments
    start, camera = load_camera(file), load_camera(made)
    assert camera.name == "gf7_refocused"
    assert camera.model_copy(update={"name": start.name, "image": start.image}) == start
    assert sharpness(camera, backend).worst == pytest.approx(0.101, abs=2e-3)


def test_a_refocused_file_finds_its_data_sheets(tmp_path) -> None:
    folder = tmp_path / "own"
    folder.mkdir()
    (folder / "sheet.yaml").write_text((LIBRARY / "detectors" / "gf7_pan.yaml").read_text("utf-8"), "utf-8")
    file = folder / "mine.yaml"
    file.write_text(GF7.replace("detector: gf7_pan", "detector: ./sheet.yaml"), "utf-8")
    text = file_with_plane(load_camera(file), FocalPlane(-2.1, 1e-4), "other")
    (tmp_path / "other.yaml").write_text(text, "utf-8")
    made = load_camera(tmp_path / "other.yaml")
    assert made.bands["P"].detector == str(folder / "sheet.yaml")
    assert (made.image.z, made.image.tilt) == (-2.1, 1e-4)
    # and back to a plane square to the axis
    (tmp_path / "other.yaml").write_text(file_with_plane(made, FocalPlane(-2.2), "back"), "utf-8")
    assert load_camera(tmp_path / "other.yaml").image.tilt is None


def test_files_that_it_takes(tmp_path) -> None:
    alone = resolve_camera("gf7")
    assert alone.camera == load_camera("gf7")
    assert resolve_camera(LIBRARY / "cameras" / "gf7.yaml").camera == alone.camera
    mounted = resolve_camera("gf7_pair", "backward")
    assert mounted.mounted == "backward"
    for setup in (alone, mounted):
        config = tmp_path / "config.yaml"
        config.write_text(setup.to_yaml(), "utf-8")
        assert resolve_camera(config) == setup
    design = tmp_path / "design.yaml"
    design.write_text("test: {name: a}\ncamera:\n" + "".join(f"  {line}\n" for line in GF7.splitlines()), "utf-8")
    assert resolve_camera(design).camera == alone.camera
    study = tmp_path / "study.yaml"
    both = "".join(f"      {line}\n" for line in GF7.splitlines())
    study.write_text(f"study: {{}}\nbase:\n  cameras:\n    one:\n{both}    two:\n{both}", "utf-8")
    found = resolve_camera(study, "two").camera
    assert found == alone.camera
    assert found.source.prefix == ("base", "cameras", "two")
    assert isinstance(validate(CameraSpec, read_yaml(LIBRARY / "cameras" / "gf7.yaml")), CameraSpec)


def test_what_it_refuses(tmp_path) -> None:
    for words, message in REFUSED["cameras"]:
        result = invoke(app, *words, "--out", tmp_path / "out")
        assert result.exit_code == 2, words
        assert re.search(message, " ".join(result.stderr.split())), (words, result.stderr)
        assert not (tmp_path / "out").exists(), words


@pytest.mark.second
def test_a_camera_without_a_focus_cannot_be_refocused(tmp_path, backend) -> None:
    file = gf7_with(tmp_path, "-2.70 m", focal_length="21.4 m")
    result = invoke(app, file, "--refocus", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert re.search(r"gf7_moved.yaml:\d+: mirrors: refocusing cannot help", "".join(result.stderr.split("\n")))
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="no focus after M3"):
        run_camera(resolve_camera(Path(file)), backend, refocus=True)


def test_tilt_is_an_option(tmp_path, monkeypatch) -> None:
    """The word of earlier versions is read, and told how it is written."""
    asked = []

    def run(setup, backend, seed, advance, refocus, tilt):
        asked.append((refocus, tilt))
        raise InputError(Issue("enough"))

    monkeypatch.setattr("twin.camera.camera_run.run_camera", run)
    for words, turned, noted in (("", False, False), ("--tilt", True, False), ("tilt", True, True)):
        done = invoke(app, "gf7", "--refocus", *words.split(), "--out", str(tmp_path / "run"))
        assert asked.pop() == (True, turned)
        assert ("is written --refocus --tilt" in done.stderr) == noted
