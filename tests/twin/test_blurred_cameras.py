"""A blurred camera is told about: how many waves, where, in which file, and what would help."""

import re
from pathlib import Path

import numpy as np
import pytest

from optics.numerics.number_tree import FrozenMap
from scenes.models.camera_model import derive_camera
from scenes.models.camera_sharpness import BLURRED, FIELDS, FieldBeams, FocalPlane, blur_warnings, cameras_of, sharpness
from scenes.specs.camera import CameraSpec
from scenes.specs.job import JobSpec
from scenes.specs.load import LIBRARY, library_names, load_camera
from scenes.specs.procedures import PROCEDURES
from scenes.specs.resolved import resolve_job
from tests.oracles.test_reference_cameras import bundle, wavefront_error

pytestmark = pytest.mark.second

GF7 = (LIBRARY / "cameras" / "gf7.yaml").read_text("utf-8")
M2 = "z: -2.01593047747168 m"
STOP = "stop_diameter: 0.23980194283070688 m\n"
EXAMPLES = {"lab focus": "focus", "lab distortion": "distortion", "orbit monitor": "monitor"}


def gf7_with(tmp_path: Path, z: str, name: str = "gf7_moved", focal_length: str = "5.52 m") -> Path:
    """A copy of gf7 with M2 elsewhere and a stop as its entrance pupil asks for; ``focal_length``: that it states."""
    assert M2 in GF7
    assert STOP in GF7
    file = tmp_path / f"{name}.yaml"
    stated = GF7.replace("focal_length: 5.52 m", f"focal_length: {focal_length}")
    file.write_text(stated.replace(M2, f"z: {z}").replace(STOP, ""), "utf-8")
    return file


def with_camera(camera: CameraSpec):
    """A job's set-up with this camera alone."""
    job = resolve_job(JobSpec(instrument="gf7_pair"))
    return job.model_copy(update={"cameras": FrozenMap({"gf7": camera})})


@pytest.mark.parametrize("name", library_names("cameras"))
def test_the_librarys_cameras_are_sharp(backend, camera, name: str) -> None:
    """And as blurred as a full trace of their own fields says."""
    found = sharpness(load_camera(name), backend)
    assert found.worst < 1 / 14
    spec = camera(name).spec
    x, y = found.field[0] * spec.field.x, found.field[1] * spec.field.y
    if any(mirror.edges for mirror in spec.mirrors.values()):  # that trace knows none; see test_camera_instrument
        assert blur_warnings(with_camera(load_camera(name)), backend) == ()
        return
    # three rings follow wavefronts to fifth order; there is a little more
    assert found.worst == pytest.approx(wavefront_error(camera(name), bundle(backend, camera(name), x, y)), rel=2e-3)
    assert blur_warnings(with_camera(load_camera(name)), backend) == ()


@pytest.mark.parametrize(
    ("z", "waves", "left", "words"),
    [
        ("-2.02 m", 6.85, 0.101, r"leaves 0\.1 waves$"),
        ("-2.03 m", 23.5, 0.283, r", but leaves 0\.29 waves: defocus is not the only error$"),
    ],
)
def test_a_blurred_camera(backend, tmp_path, z: str, waves: float, left: float, words: str) -> None:
    file = gf7_with(tmp_path, z)
    camera = load_camera(file)
    (text,) = blur_warnings(with_camera(camera), backend)
    found = sharpness(camera, backend)
    assert found.worst == pytest.approx(waves, rel=5e-3)
    assert f"camera gf7 ({file}) is blurred as designed: its wavefront error is {found.worst:.3g} waves rms" in text
    assert "at field (0, -0.15) deg, more than 0.25; " in text
    assert re.search(words, text)
    shift = float(re.search(rf"python -m twin.camera {file} --refocus moves image\.z by ([-+][\d.]+) mm", text)[1])
    # what it promises is what comes of it
    z_image = camera.image.z + 1e-3 * shift
    moved = camera.model_copy(update={"image": camera.image.model_copy(update={"z": z_image})})
    beams = FieldBeams.trace(derive_camera(moved, backend), backend, FIELDS, 5)
    assert np.max(beams.errors(FocalPlane.of(moved))) == pytest.approx(left, abs=0.01)
    assert FieldBeams.trace(derive_camera(camera, backend), backend, FIELDS, 5).errors(
        FocalPlane(z_image)
    ) == pytest.approx(beams.errors(FocalPlane.of(moved)), rel=1e-6)


def test_a_camera_without_a_focus(backend, tmp_path) -> None:
    """M2 0.7 m too far: the light diverges after M3, and no place of the image helps."""
    (text,) = blur_warnings(with_camera(load_camera(gf7_with(tmp_path, "-2.70 m", focal_length="21.4 m"))), backend)
    problem = r"blurred as designed: its wavefront error is 513 waves rms at field .*; "
    assert re.search(problem + "refocusing does not help: its light has no focus", text)


def test_just_beyond_the_limit(backend, tmp_path) -> None:
    limits = [sharpness(load_camera(gf7_with(tmp_path, z)), backend).worst for z in ("-2.0158 m", "-2.01578 m")]
    assert limits[0] < BLURRED < limits[1]
    texts = [
        blur_warnings(with_camera(load_camera(gf7_with(tmp_path, z))), backend) for z in ("-2.0158 m", "-2.01578 m")
    ]
    assert [len(text) for text in texts] == [0, 1]


def test_every_test_that_has_a_camera_warns(backend, tmp_path) -> None:
    """All but the design, whose start is there to be improved, and tests without a camera's prescription."""
    blurred = load_camera(gf7_with(tmp_path, "-2.02 m"))
    for name, file in EXAMPLES.items():
        procedure = PROCEDURES[name]
        setup = procedure.resolve(file)
        assert cameras_of(setup), name
        assert procedure.judged
        assert blur_warnings(setup, backend) == ()
        update = {"camera": blurred} if hasattr(setup, "camera") else {"cameras": FrozenMap({"gf7": blurred})}
        (text,) = blur_warnings(setup.model_copy(update=update), backend)
        assert "is blurred as designed" in text
    assert not cameras_of(PROCEDURES["orbit calibrate"].resolve("calibrate"))
    assert not cameras_of(PROCEDURES["orbit angle"].resolve("angle"))  # a payload's lines have no mirrors
    assert not PROCEDURES["design camera"].judged
