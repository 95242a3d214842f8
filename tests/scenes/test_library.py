"""The files that come with the twin, the user's own files beside them, and the resolved job."""

import copy
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
    load_autocollimator_test,
    load_camera,
    load_detector,
    load_instrument,
    load_job,
)
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import dump_yaml, parse_yaml


def test_a_full_well_is_just_below_saturation() -> None:
    detector = load_detector("monitor_ccd")
    full = detector.full_well_e * detector.system_gain_dn_per_e + detector.offset_dn
    assert 0.95 * 2**detector.bit_depth < full < 2**detector.bit_depth - 1


def test_unknown_names() -> None:
    for load, wrong, right in (
        (load_camera, "gf8", "gf7"),
        (load_instrument, "gf7-pair", "gf7_pair"),
        (load_detector, "monitor_cdd", "monitor_ccd"),
        (load_autocollimator_test, "principle_experimnt", "principle_experiment"),
    ):
        with pytest.raises(InputError, match=f"did you mean '{right}'"):
            load(wrong)


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


def test_a_camera_by_itself_has_no_monitor() -> None:
    with pytest.raises(InputError, match="has no monitor, so that no spot tells"):
        _ = load_instrument("ritchey_chretien").autocollimator
