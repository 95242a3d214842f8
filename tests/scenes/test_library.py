"""The files that come with the twin, the user's own files beside them, and the resolved job."""

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

from optics.numerics.number_tree import FrozenMap
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.specs import load
from scenes.specs.camera import CameraSpec
from scenes.specs.orbit.setup import AngleSetup, MonitorSetup, SimulateSetup
from scenes.specs.resolved import FocusSetup, resolve
from scenes.yaml.errors import InputError
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from twin.monitor.truth import LineSight


def test_a_full_well_is_just_below_saturation() -> None:
    detector = load.load_detector("monitor_ccd")
    full = detector.full_well_e * detector.system_gain_dn_per_e + detector.offset_dn
    assert 0.95 * 2**detector.bit_depth < full < 2**detector.bit_depth - 1


def test_own_files_are_found_from_the_file_that_names_them(tmp_path: Path) -> None:
    text = (load.LIBRARY / load.INSTRUMENTS / "gf7_pair.yaml").read_text("utf-8")
    (tmp_path / "own_camera.yaml").write_text(
        (load.LIBRARY / load.CAMERAS / "gf7_conic.yaml").read_text("utf-8"), "utf-8"
    )
    (tmp_path / "own.yaml").write_text(text.replace("camera: gf7", "camera: own_camera.yaml", 1), "utf-8")
    (tmp_path / "job.yaml").write_text("instrument: own.yaml\n", "utf-8")
    job = resolve(tmp_path / "job.yaml")
    assert {name: camera.name for name, camera in job.cameras.items()} == {"own_camera.yaml": "gf7_conic", "gf7": "gf7"}
    assert load.load_instrument(tmp_path / "own.yaml") == job.instrument


CAUSES = """instrument: gf7_pair
disturbances:
  causes:
    mirror_mounts: {together: 0.3, time: {period: 95 min}}
    mirror_figure: {figure: {Z5: 9 nm}}
    new:
      bodies: [base/forward/M1, base/backward/M1]
      shift: 1 um
      correlations:
        - {between: [base/forward/M1 shift x, base/backward/M1 shift y], matrix: [[1, -0.2], [-0.2, 1]]}
      reason: why not
"""


@pytest.mark.second
@pytest.mark.parametrize(
    ("read", "file"),
    [
        *((AngleSetup.read, f"{load.ORBIT}/{name}.yaml") for name in ("angle", "angle_gf7", "angle_off_axis")),
        *((MonitorSetup.read, f"{load.ORBIT}/{name}.yaml") for name in ("loop", "monitor")),
        *((SimulateSetup.read, f"{load.ORBIT}/simulate.yaml"), (FocusSetup.read, f"{load.LAB}/focus.yaml")),
        *((resolve, "examples/perturb.yaml"), (resolve, CAUSES)),
    ],
)
def test_a_config_reads_back_to_the_same_values(read, file: str, tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(file, "utf-8")
    first = read(tmp_path / "own.yaml" if file == CAUSES else load.SCENES / file)
    (tmp_path / "config.yaml").write_text(first.to_yaml(), "utf-8")
    again = read(tmp_path / "config.yaml")
    assert type(again) is type(first)
    assert again == first
    assert again.model_dump() == first.model_dump()
    assert hash(again) == hash(first)
    assert again.to_yaml() == first.to_yaml()


def test_changes_of_temperature(tmp_path: Path) -> None:
    changes = {"100 K": 100.0, "+250 K": 250.0, " +250 K": 250.0, "-250 K": -250.0, "250 mK": 0.25, "+1000 K": 1000.0}
    path = tmp_path / "perturb.yaml"
    for text, kelvin in changes.items():
        path.write_text(f"instrument: gf7_pair\nperturb:\n  base: {{temperature: '{text}'}}\n", "utf-8")
        job = load.load_job(path)
        assert job.perturb["base"].temperature.change == kelvin
        # what is written is read again
        path.write_text(dump_yaml(job.plain()), "utf-8")
        assert load.load_job(path).perturb["base"].temperature.change == kelvin


def test_a_resolved_job_needs_its_cameras(tmp_path: Path) -> None:
    text = resolve(load.EXAMPLES / "perturb.yaml").to_yaml().replace("\n  gf7:\n", "\n  other:\n")
    config = tmp_path / "config.yaml"
    config.write_text(text, "utf-8")
    with pytest.raises(InputError, match="camera 'gf7' of the instrument is missing"):
        resolve(config)


def specimens() -> list[Spec]:
    found: list[Spec] = [load.load_job(load.EXAMPLES / "perturb.yaml"), resolve(load.EXAMPLES / "perturb.yaml")]
    found += [load.load_camera(name) for name in load.library_names(load.CAMERAS)]
    found += [load.load_instrument(name) for name in load.library_names(load.INSTRUMENTS)]
    found += [load.load_detector(name) for name in load.library_names(load.DETECTORS)]
    return found


@pytest.mark.second
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


@pytest.mark.second
def test_an_equal_instrument_is_built_once_and_that_of_another_file_anew(backend, tmp_path) -> None:
    """Errors name the file that an instrument was read from, and results the order in which it names its parts."""
    first, again = (load.load_instrument("monitor_pair") for _ in range(2))
    cameras = {site.camera: load.load_camera(site.camera) for site in first.cameras.values()}
    built = build_instrument(first, cameras, backend)
    assert build_instrument(again, dict(cameras), backend) is built
    (tmp_path / "own.yaml").write_text(
        f"# mine\n{(load.LIBRARY / load.INSTRUMENTS / 'monitor_pair.yaml').read_text('utf-8')}"
    )
    own = load.load_instrument(tmp_path / "own.yaml")
    assert own == first
    other = build_instrument(own, cameras, backend)
    assert other is not built
    assert other.spec.source.file == str(tmp_path / "own.yaml")
    turned = first.model_copy(update={"cameras": FrozenMap(reversed(first.cameras.items()))})
    assert turned == first
    assert list(build_instrument(turned, cameras, backend).cameras) == list(built.cameras)[::-1]


def test_a_camera_by_itself_has_no_monitor() -> None:
    with pytest.raises(InputError, match="has no monitor, so that no spot tells"):
        _ = load.load_instrument("ritchey_chretien").autocollimator


GF7 = load.load_camera("gf7")


def with_terms(terms: dict[str, float]) -> CameraSpec:
    """gf7 whose third mirror has these aspheric terms."""
    third = GF7.mirrors["M3"].model_copy(update={"aspheric": FrozenMap(terms)})
    return GF7.model_copy(update={"mirrors": FrozenMap({**GF7.mirrors, "M3": third})})


def built(backend, other: CameraSpec) -> Instrument:
    """gf7_pair with another camera for the one that looks backward."""
    spec = load.load_instrument("gf7_pair")
    backward = spec.cameras["backward"].model_copy(update={"camera": "other"})
    spec = spec.model_copy(update={"cameras": FrozenMap({**spec.cameras, "backward": backward})})
    return build_instrument(spec, {"gf7": GF7, "other": other}, backend)


@pytest.mark.second
def test_terms_that_one_camera_lacks_are_zero(backend) -> None:
    """The forward camera, which has no A8, sees what it sees beside its like."""
    terms = dict(GF7.mirrors["M3"].aspheric)
    alone, zero, more = (
        LineSight(built(backend, with_terms(t)), backend).trace([{}])
        for t in (terms, {**terms, "A8": 0.0}, {**terms, "A8": 1e-7})
    )
    np.testing.assert_allclose(zero, alone, rtol=0, atol=1e-15)
    np.testing.assert_allclose(more[0], alone[0], rtol=0, atol=1e-15)
    assert np.max(np.abs(more[1] - alone[1])) > 1e-12


def test_cameras_that_cannot_be_traced_together_are_refused(backend) -> None:
    with pytest.raises(InputError, match=r"cameras: these cameras are too different .*; allowed: cameras with"):
        built(backend, GF7.model_copy(update={"stop": "M1", "stop_diameter": None}))
