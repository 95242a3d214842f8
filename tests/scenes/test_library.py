"""The files that come with the twin, the user's own files beside them, and the resolved job."""

import copy
import math
import pickle
from pathlib import Path

import pytest

from optics.numerics.frozen_map import FrozenMap
from scenes.models.instrument_builder import build_instrument
from scenes.specs.load import (
    CAMERAS,
    DETECTORS,
    EXAMPLES,
    INSTRUMENTS,
    LIBRARY,
    library_names,
    load_camera,
    load_detector,
    load_instrument,
    load_job,
)
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import dump_yaml, parse_yaml

CAMERA_NAMES = ("gf7", "gf7_conic", "monitor")
# Radius, conic constant, vertex; metres.
MIRRORS = {
    "gf7": [
        (-6.74535927468851, -1.5146420994346, 0.0),
        (-2.65226629663464, -1.78965940473169, -2.01593047747168),
        (-4.36068001118994, -0.448918835734448, 0.147067458984473),
    ],
    "gf7_conic": [
        (-11.85178535, -4.581036949, 0.0),
        (-3.90237429, -0.8906451483, -2.3),
        (-5.797588591, -0.003887453761, 0.0),
    ],
    "monitor": [
        (-9.58178858618494, -1.88256106323586, 0.0),
        (-3.69617798657152, -1.69073840835311, -2.90544449353535),
        (-5.97252346397626, 0.24630894248323, 0.184554234498138),
    ],
}


def test_names() -> None:
    assert set(CAMERA_NAMES) <= set(library_names(CAMERAS))
    assert {"gf7_pair", "monitor_pair"} <= set(library_names(INSTRUMENTS))
    assert "monitor_ccd" in library_names(DETECTORS)


@pytest.mark.parametrize("name", CAMERA_NAMES)
def test_cameras(name: str) -> None:
    camera = load_camera(name)
    assert camera.name == name
    assert list(camera.mirrors) == ["M1", "M2", "M3"]
    assert [(m.radius, m.conic, m.z) for m in camera.mirrors.values()] == MIRRORS[name]
    assert camera.stop == "M2"
    assert camera.field_bias == pytest.approx(math.radians(6))
    assert camera.edge_margin == 0.005
    assert (camera.line.pixels, camera.line.pitch) == (102_400 if name == "monitor" else 32_768, 7e-6)
    # the whole line lies in the field for which the camera was designed
    assert 0.5 * camera.line.pixels * camera.line.pitch < camera.focal_length * math.tan(camera.field.x)


def test_aspheric_terms() -> None:
    camera = load_camera("gf7")
    assert dict(camera.mirrors["M2"].aspheric) == {"A4": -0.000664476944265854, "A6": 0.00567297548549554}
    assert load_camera("monitor").mirrors["M3"].aspheric["A6"] == 3.3291995834447e-05
    assert not load_camera("gf7_conic").mirrors["M1"].aspheric


@pytest.mark.parametrize("name", ["gf7_pair", "monitor_pair"])
def test_instruments(name: str) -> None:
    instrument = load_instrument(name)
    assert instrument.name == name
    assert list(instrument.cameras) == ["forward", "backward"]
    assert instrument.cameras["forward"].look == pytest.approx(math.radians(26))
    assert instrument.cameras["backward"].look == pytest.approx(math.radians(-5))
    assert instrument.monitor.frames == 9
    # The sub-aperture lies inside the entrance pupil, and the area CCD inside the field.
    for mounted in instrument.cameras.values():
        camera = load_camera(mounted.camera)
        reach = math.hypot(*mounted.pupil_offset) + instrument.monitor.return_face.aperture / 2
        assert reach < camera.entrance_pupil / 2
        assert instrument.monitor.field < camera.field.x


def test_a_full_well_is_just_below_saturation() -> None:
    detector = load_detector("monitor_ccd")
    full = detector.full_well_e * detector.system_gain_dn_per_e + detector.offset_dn
    assert 0.95 * 2**detector.bit_depth < full < 2**detector.bit_depth - 1


@pytest.mark.parametrize(
    ("load", "wrong", "right"),
    [
        (load_camera, "gf8", "gf7"),
        (load_instrument, "gf7-pair", "gf7_pair"),
        (load_detector, "monitor_cdd", "monitor_ccd"),
    ],
)
def test_unknown_names(load: object, wrong: str, right: str) -> None:
    with pytest.raises(InputError, match=f"did you mean '{right}'"):
        load(wrong)  # type: ignore[operator]


def own_instrument(folder: Path, camera: str = "own_camera.yaml", detector: str = "monitor_ccd") -> Path:
    """An instrument, its camera and a job in a folder of the user's; returns the job's path."""
    text = (LIBRARY / INSTRUMENTS / "gf7_pair.yaml").read_text("utf-8")
    text = text.replace("camera: gf7", f"camera: {camera}", 1).replace("detector: monitor_ccd", f"detector: {detector}")
    (folder / "own_camera.yaml").write_text((LIBRARY / CAMERAS / "gf7_conic.yaml").read_text("utf-8"), "utf-8")
    (folder / "own.yaml").write_text(text, "utf-8")
    job = folder / "job.yaml"
    job.write_text("instrument: own.yaml\n", "utf-8")
    return job


def test_own_files_are_found_from_the_file_that_names_them(tmp_path: Path) -> None:
    job = resolve(own_instrument(tmp_path))
    assert {name: camera.name for name, camera in job.cameras.items()} == {"own_camera.yaml": "gf7_conic", "gf7": "gf7"}
    assert load_instrument(tmp_path / "own.yaml") == job.instrument


def test_wrong_references_are_told_at_their_line(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"own\.yaml:4: cameras\.forward\.camera: no such name in cameras.*did you mean 'gf7'"
    ):
        resolve(own_instrument(tmp_path, camera="gf77"))
    with pytest.raises(InputError, match=r"own\.yaml:4: cameras\.forward\.camera: no such file"):
        resolve(own_instrument(tmp_path, camera="elsewhere.yaml"))
    with pytest.raises(InputError, match=r"own\.yaml:11: monitor\.area_ccd\.detector: .*did you mean 'monitor_ccd'"):
        resolve(own_instrument(tmp_path, detector="monitor_cc"))


def test_a_resolved_job_reads_back_to_the_same_bits(tmp_path: Path) -> None:
    resolved = resolve(EXAMPLES / "perturb.yaml")
    config = tmp_path / "config.yaml"
    config.write_text(resolved.to_yaml(), "utf-8")
    again = resolve(config)
    assert again == resolved
    assert again.model_dump() == resolved.model_dump()
    assert again.to_yaml() == resolved.to_yaml()
    assert again.job.source.line(("perturb", "base/forward/M2")) is not None
    assert resolved.frames == 9


def test_a_resolved_job_needs_its_cameras(tmp_path: Path) -> None:
    text = resolve(EXAMPLES / "perturb.yaml").to_yaml().replace("\n  gf7:\n", "\n  other:\n")
    config = tmp_path / "config.yaml"
    config.write_text(text, "utf-8")
    with pytest.raises(InputError, match="camera 'gf7' of the instrument is missing"):
        resolve(config)


def specimens() -> list[Spec]:
    found: list[Spec] = [load_job(EXAMPLES / "perturb.yaml"), resolve(EXAMPLES / "perturb.yaml")]
    found += [load_camera(name) for name in library_names(CAMERAS)]
    found += [load_instrument(name) for name in library_names(INSTRUMENTS)]
    found += [load_detector(name) for name in library_names(DETECTORS)]
    return found


@pytest.mark.parametrize("spec", specimens(), ids=lambda spec: f"{type(spec).__name__}-{getattr(spec, 'name', '')}")
def test_every_specification_is_a_value(spec: Spec) -> None:
    for twin in (
        pickle.loads(pickle.dumps(spec)),
        copy.deepcopy(spec),
        validate(type(spec), parse_yaml(dump_yaml(spec.plain()))),
    ):
        assert twin == spec
        assert hash(twin) == hash(spec)
        assert repr(twin) == repr(spec)
    field = next(iter(type(spec).model_fields))
    with pytest.raises(ValueError, match="frozen"):
        setattr(spec, field, None)


def test_mappings_cannot_be_changed() -> None:
    camera = load_camera("gf7")
    with pytest.raises(TypeError, match="cannot be changed"):
        camera.mirrors["M4"] = camera.mirrors["M1"]
    with pytest.raises(TypeError, match="cannot be changed"):
        camera.mirrors.clear()


def test_an_equal_instrument_is_built_once_and_that_of_another_file_anew(backend, tmp_path) -> None:
    """Errors name the file that an instrument was read from, and results the order in which it names its parts."""
    first, again = (load_instrument("monitor_pair") for _ in range(2))
    cameras = {site.camera: load_camera(site.camera) for site in first.cameras.values()}
    built = build_instrument(first, cameras, backend)
    assert build_instrument(again, dict(cameras), backend) is built
    (tmp_path / "own.yaml").write_text(f"# mine\n{(LIBRARY / INSTRUMENTS / 'monitor_pair.yaml').read_text('utf-8')}")
    own = load_instrument(tmp_path / "own.yaml")
    assert own == first
    other = build_instrument(own, cameras, backend)
    assert other is not built
    assert other.spec.source.file == str(tmp_path / "own.yaml")
    turned = first.model_copy(update={"cameras": FrozenMap(reversed(first.cameras.items()))})
    assert turned == first
    assert list(build_instrument(turned, cameras, backend).cameras) == list(built.cameras)[::-1]
