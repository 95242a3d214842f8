"""The files that come with the twin, the user's own files beside them, and the resolved job.

Files of tests in orbit, of plans of operation and of studies: values, defaults, ways to other files, read back.
"""

import copy
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from optics.geometry.aperture import Circle
from optics.geometry.surface import Surface
from optics.numerics.backend import load_backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.disturbances import disturbance_prior
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.meshes import sheet_mesh
from scenes.specs import load, study
from scenes.specs.camera import CameraSpec
from scenes.specs.load import EXAMPLES, LIBRARY, ORBIT, SCENES, load_camera, load_instrument
from scenes.specs.operation import ENDINGS, OperationSpec, read_operation, resolve_operation
from scenes.specs.orbit import setup as orbit_setup
from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, ErrorsSpec, OrbitSpec, UtcTime, parse_utc
from scenes.specs.orbit.monitor import MotionSpec
from scenes.specs.orbit.setup import AngleSetup, MonitorSetup, SimulateSetup
from scenes.specs.resolved import FocusSetup, resolve
from scenes.specs.study import StudySpec, unit_of
from scenes.yaml.errors import InputError, Problem
from scenes.yaml.spec import Spec, validate
from scenes.yaml.units import parse_quantity
from scenes.yaml.yaml_file import dump_yaml, parse_yaml, read_yaml
from tests.scenes.refusals.tables import good
from tests.tiers import quick
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
    with pytest.raises(InputError, match="has no monitor, so that its changes"):
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


# --- specs ------------------------------------------------------------------------------------------------------------

ARCSEC = math.pi / 648000.0
PASSING, ELEMENTS, STATE = (good(f"orbit by {name}") for name in ("a passing", "elements", "a state"))
ERRORS = good("errors in orbit")
TH1 = (LIBRARY / "payloads/th1.yaml").read_text("utf-8")


def read(model: type[Spec], text: str) -> Spec:
    return validate(model, parse_yaml(text))


@pytest.mark.parametrize(
    ("call", "problem"),
    [
        (lambda spec: spec.index_behind("M1"), "M1 is not a face of a lens"),
        (lambda spec: spec.warm_glass("M1"), "has no thermal properties; give its glass"),
        (lambda spec: sheet_mesh(Surface(2.0), Circle(1.0)), "ends before its clear aperture does"),
        (lambda spec: study.unit_cube("few", 4, 2, 0), r"must give points \(4, 2\)"),
    ],
)
def test_calls_for_what_is_not_there_are_refused(call, problem: str, monkeypatch) -> None:
    few = study.Sampler("few", lambda runs, factors, generator: np.zeros((1, factors)))
    monkeypatch.setitem(study.SAMPLERS, "few", few)
    with pytest.raises(ValueError, match=problem):
        call(load_camera("gf7"))


def write(folder: Path, text: str) -> Path:
    path = folder / "test.yaml"
    path.write_text(text, "utf-8")
    return path


def test_values_are_si() -> None:
    spec = read(OrbitSpec, PASSING)
    assert (spec.epoch, spec.before, spec.after) == ("2011-03-05T03:05:00Z", 300.0, 90.0)
    assert spec.passing.longitude == pytest.approx(math.radians(116), rel=1e-15)
    assert (spec.passing.altitude, spec.passing.direction) == (500e3, "ascending")
    assert spec.plain()["passing"]["altitude"] == "500 km"
    assert read(OrbitSpec, ELEMENTS).elements.node_local_time == 37800.0
    state = read(OrbitSpec, STATE).state
    assert (state.position, state.velocity) == ((6878e3, 0.0, 1.0), (0.0, -960.5, 7500.0))
    earth = read(EarthSpec, "{ut1_utc: -150 ms, polar_motion: [0.1 arcsec, -200 mas]}")
    assert earth.ut1_utc == -0.15
    assert earth.polar_motion == pytest.approx([0.1 * ARCSEC, -0.2 * ARCSEC], rel=1e-15)
    errors = read(ErrorsSpec, ERRORS)
    assert (errors.gps.drift, errors.gps.correlation_time) == ((0.1, 0.0, 0.0), 1800.0)
    assert errors.star_tracker.bias[1] == pytest.approx(-math.radians(0.1), rel=1e-15)


def test_it_reads_back() -> None:
    attitude = "{nadir: geocentric, steering: yaw, offset: [0.1 deg, 0 deg, -2 arcsec]}"
    earth = "{ut1_utc: -150 ms, polar_motion: [0.1 arcsec, -200 mas]}"
    cases = [*((OrbitSpec, text) for text in (PASSING, ELEMENTS, STATE)), (ErrorsSpec, ERRORS)]
    for model, text in (*cases, (AttitudeSpec, attitude), (EarthSpec, earth)):
        spec = read(model, text)
        again = read(model, dump_yaml(spec.plain()))
        assert again == spec
        assert hash(again) == hash(spec)


def test_times_that_are_read() -> None:
    for text in ("2011-03-05T03:05Z", "2011-03-05T03:05:00Z", " 2011-03-05T03:05:00.123456Z "):
        assert parse_utc(text) == text.strip()
    assert TypeAdapter(UtcTime).json_schema()["examples"] == ["2011-03-05T03:05:00Z"]
    for none in (20110305, None):
        with pytest.raises(Problem, match="not a date and time"):
            parse_utc(none)


@pytest.mark.second
def test_lines_of_a_camera_of_ones_own(tmp_path: Path) -> None:
    """Other lines are no mistake, but then the file says which angles."""
    small = good("angle").replace("th1", "own.yaml")
    (tmp_path / "own.yaml").write_text(TH1.replace("name: th1", "name: own").replace("  backward:", "  rear:"), "utf-8")
    named = small + "angles: {all: [forward, rear]}\n"
    setup = orbit_setup.AngleSetup.read(write(tmp_path, named))
    assert (setup.camera.name, dict(setup.angles)) == ("own", {"all": ("forward", "rear")})
    with pytest.raises(InputError, match=r"perturb.backward.*no such line"):
        orbit_setup.AngleSetup.read(write(tmp_path, named + "perturb: {backward: [0 deg, 0 deg, 0 deg]}"))
    plain = orbit_setup.load_three_line_camera("th1").plain()
    two = {**plain, "lines": {name: plain["lines"][name] for name in ("backward", "nadir")}}
    (tmp_path / "own.yaml").write_text(dump_yaml(two), "utf-8")
    assert dict(orbit_setup.AngleSetup.read(write(tmp_path, small)).angles) == {"alpha": ("backward", "nadir")}


@pytest.mark.second
def test_an_instrument_is_a_camera(tmp_path: Path) -> None:
    """By name or path; a configuration without its camera is refused."""
    setup = orbit_setup.AngleSetup.read(SCENES / ORBIT / "angle_gf7.yaml")
    assert setup.camera is None
    assert setup.instrument == load_instrument("gf7_pair")
    assert dict(setup.cameras) == {"gf7": load_camera("gf7")}
    assert dict(setup.pixels) == {"forward": 32768, "backward": 32768}
    assert setup.test.perturb["base"].temperature.gradient[2] == pytest.approx(0.4)
    text = (LIBRARY / "instruments" / "gf7_pair.yaml").read_text("utf-8").replace("name: gf7_pair", "name: own")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    own = orbit_setup.AngleSetup.read(write(tmp_path, good("angle").replace("th1", "own.yaml")))
    assert (own.camera_name, dict(own.angles)) == ("own", {"alpha": ("forward", "backward")})
    data = parse_yaml(setup.to_yaml()).data
    whole = data.pop("instrument")
    for change, words in (
        ({}, "one camera is needed; found 'neither'"),
        ({"camera": whole}, "camera"),
        ({"instrument": whole, "cameras": {"gf8": data["cameras"]["gf7"]}}, "camera 'gf7' of the instrument's forward"),
    ):
        with pytest.raises(InputError, match=words):
            orbit_setup.AngleSetup.read(write(tmp_path, dump_yaml({**data, **change})))


def test_a_loop(tmp_path: Path) -> None:
    setup = orbit_setup.MonitorSetup.read(write(tmp_path, good("loop")))
    test = setup.test
    assert setup.disturbances.name == "orbit"
    assert test.times == (0.0, 600.0, 1200.0)
    pointing, roll, focus = (test.loop.corrections[name] for name in ("pointing", "roll", "focus"))
    assert pointing.smallest == pytest.approx(0.05 * ARCSEC, rel=1e-12)
    # whole steps alone: 40 of them
    assert pointing.largest == pytest.approx(2.0 * ARCSEC, rel=1e-12)
    assert (roll.mechanism, roll.smallest, roll.largest, roll.band, roll.delay) == (None, None, None, 0.0, 0)
    assert focus.motion == ("forward/focal_plane", "shift", "z", "")
    assert focus.band == pytest.approx(2e-6, rel=1e-12)


def test_a_monitored_orbit(tmp_path: Path) -> None:
    setup = orbit_setup.MonitorSetup.read(SCENES / ORBIT / "monitor.yaml")
    assert (setup.pair, setup.test.step, setup.test.reference_index) == (("forward", "backward"), 300.0, 0)
    test = orbit_setup.MonitorSetup.read(write(tmp_path, good("monitor"))).test
    assert test.apply == ("d_alpha", "d_beta", "d_gamma", "d_f")
    assert test.compared == (300.0, 600.0, 1200.0)
    assert test.errors.gps.noise == (0.0, 0.0, 0.0)
    assert (test.errors.star_tracker.bias, test.errors.image) == ((0.0, 0.0, 0.0), 0.3)
    # from the reference to both sides
    assert [test.measured(step) for step in (600.0, 300.0, 1200.0)] == [[1, 3], [0, 1, 2, 3, 4], [1]]
    text = (LIBRARY / "instruments" / "gf7_pair.yaml").read_text("utf-8")
    kept = [row for row in text.splitlines() if not row.lstrip().startswith("backward")]
    (tmp_path / "own.yaml").write_text("\n".join(kept), "utf-8")
    with pytest.raises(InputError, match=r"not a stereo pair.*forward in gf7_pair.*two cameras"):
        orbit_setup.MonitorSetup.read(write(tmp_path, good("monitor").replace("gf7_pair", "own.yaml")))


def test_a_motion_is_a_step_a_ramp_or_a_swing() -> None:
    def shares(times: tuple[float, ...], duration: float = 0.0, period: float | None = None) -> list[float]:
        motion = MotionSpec.model_construct(rotate=(0.0, 1e-6, 0.0), begin=10.0, duration=duration, period=period)
        return [motion.share(time) for time in times]

    assert shares((9.9, 10.0, 1e4)) == [0.0, 1.0, 1.0]
    assert shares((0.0, 15.0, 40.0), duration=20.0) == [0.0, 0.25, 1.0]
    assert shares((10.0, 20.0, 40.0), period=40.0) == pytest.approx([0.0, 1.0, -1.0])


@pytest.mark.second
def test_a_payload_of_ones_own_comes_through_config_yaml(tmp_path: Path) -> None:
    """Its detector is found beside it; an outline before the lens is kept."""
    sheet = (LIBRARY / "detectors/th1_line.yaml").read_text("utf-8").replace("name: th1_line", "name: mine")
    (tmp_path / "mine.yaml").write_text(sheet, "utf-8")
    text = TH1.replace("detector: th1_line", "detector: mine.yaml")
    text = text.replace("f_number: 6\n", "f_number: 6\n  obstruction: [[[-0.6, 0.6], [-0.2, 0.6], [-0.2, 1.1]]]\n")
    (tmp_path / "own.yaml").write_text(text, "utf-8")
    setup = orbit_setup.SimulateSetup.read(write(tmp_path, good("simulate").replace("th1", "own.yaml")))
    assert setup.detectors["mine.yaml"].name == "mine"
    image = setup.camera.image_of("nadir")
    assert image.obstruction[0][0] == (-0.6, 0.6)
    again = orbit_setup.SimulateSetup.read(write(tmp_path, setup.to_yaml())).camera.image_of("nadir")
    assert again.obstruction == image.obstruction


SHORT = "instrument: gf7_pair\ndisturbances: in_service\n"


def written(folder: Path, text: str) -> Path:
    file = folder / "plan.yaml"
    file.write_text(text, "utf-8")
    return file


@pytest.mark.second
def test_the_example_says_its_limits_in_the_units_of_its_quantities() -> None:
    setup = read_operation(EXAMPLES / "operation.yaml")
    limits = {(one.group, one.key): (one.largest, one.probability) for one in setup.operation.requirements}
    assert limits == {
        ("intersection_angle", "change_arcsec"): (pytest.approx(2.0), 0.99),
        ("forward", "d_f_um"): (pytest.approx(60.0), 0.95),
        ("ground", "height_m"): (10.0, 0.95),
    }
    assert {cause for causes in setup.operation.events.values() for cause in causes} <= set(setup.disturbances.causes)
    again = OperationSpec.model_validate(setup.operation.plain())
    assert again == setup.operation
    assert resolve_operation(again).model.plain() == setup.model.plain()


@pytest.mark.second
@pytest.mark.parametrize("instrument", quick(1, ["gf7_pair", "gf7_pair_two"]))
def test_in_service_finds_its_bodies_in_both_instruments(instrument: str, tmp_path: Path) -> None:
    """Every cause has bodies, and the causes share a few laws of time, each of which an estimate carries along."""
    setup = read_operation(written(tmp_path, SHORT.replace("gf7_pair", instrument)))
    built = build_instrument(setup.model.instrument, setup.model.cameras, load_backend())
    stated = disturbance_prior(setup.model, built)
    assert stated is not None
    assert {one.cause for one in stated.components} == set(setup.disturbances.causes)
    assert len({law.text for law in stated.laws}) == 6


def test_own_files_are_found_from_the_plans_folder(tmp_path: Path) -> None:
    cause = "{bodies: base/<camera>, rotate: 1 arcsec, time: {drift: 4800 h}, reason: a test}"
    (tmp_path / "own.yaml").write_text(f"name: own\ncauses:\n  mount: {cause}\n")
    setup = read_operation(written(tmp_path, SHORT.replace("in_service", "own.yaml")))
    assert setup.operation.disturbances == str(tmp_path / "own.yaml")
    assert list(setup.disturbances.causes) == ["mount"]


def test_every_ending_measures_one_of_its_unit() -> None:
    for kind, unit in ENDINGS.values():
        assert parse_quantity(f"1 {unit}", kind) > 0.0


TEXT = """name: study
base: {command: render, file: perturb}
factors:
  a: {key: [job, x], range: [0 um, 0.003 mm], count: 3}
  b: {keys: [[y, 1], [z]], values: [9, 16]}
responses:
  r: {key: [truth, d_f_um], sigma: [truth, d_f_um_sigma]}
  s: {key: [truth, share], unit: percent}
report: {scatter: [[a, r]], thresholds: {good: {response: r, at_most: 2}}}
"""


def read_study(text: str) -> StudySpec:
    return validate(StudySpec, parse_yaml(text, "study.yaml"))


def test_what_it_says() -> None:
    study = read_study(TEXT)
    assert study.factors["a"].unit == "um"
    assert study.factors["a"].numbers().values == (0.0, 3.0)
    assert study.factors["a"].key_paths == (("job", "x"),)
    assert study.factors["b"].key_paths == (("y", 1), ("z",))
    assert study.factors["b"].numbers().whole
    assert study.responses["r"].units == "um"
    assert study.responses["s"].units == "percent"
    assert read_study(dump_yaml(study.plain())) == study


@pytest.mark.second
@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("study_*.yaml")), ids=lambda file: file.stem)
def test_the_examples_are_valid(file) -> None:
    study = validate(StudySpec, read_yaml(file))
    assert study.name == file.stem
    assert study.description
    # what is called noise is the noise's own sigma, not the total one, in which it is a thousandth
    said = [one.noise for one in study.responses.values() if one.noise is not None]
    said += [one.key for name, one in study.responses.items() if name.endswith("_noise")]
    assert all(str(key[-1]).endswith("_sigma_noise") for key in said)
    assert all(one.noise is not None for one in study.responses.values() if one.sigma is not None)


UNITS = {
    "focus.fields.0.error_um": "um", "recovered.change_arcsec_sigma": "arcsec", "focus.shims_um.2": "um",
    "recovered.change_arcsec_sigma_noise": "arcsec", "monitor.gradient_K_per_m": "K/m",
    "temperature.linear_gradient_k_per_m": "K/m", "monitor.height_m_per_arcsec": "m/arcsec",
    "angle.height_m_per_arcsec.alpha": "m/arcsec", "quality.cameras.forward.defocus_um.centre": "um",
    "quality.cameras.forward.wfe_rms_waves_focus_removed.1": "waves",
    "block.cameras.scene.d_alpha_arcsec_sigma_before": "arcsec", "block.cameras.scene.d_f_um_true": "um",
    "simulate.lines.drift_px_per_line": "", "optics.nyquist_per_mm": "1/mm", "turntable.rejected": "", "x.m": "",
    "defocus_um.centre": "um", "optics.plate_scale_arcsec_per_mm_sigma": "arcsec/mm", "orbit.velocity_m_per_s": "m/s",
}  # fmt: skip


def test_units_of_results() -> None:
    for key, unit in UNITS.items():
        assert unit_of(tuple(int(part) if part.isdigit() else part for part in key.split("."))) == unit, key
