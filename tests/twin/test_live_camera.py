"""The design of a camera on the live page: the knobs make what twin.camera reads from a file with these numbers."""

from __future__ import annotations

import json

import numpy as np
import pytest

from scenes.lens.prescription import first_camera
from scenes.specs.load import LIBRARY, load_camera
from scenes.specs.resolved import resolve_camera
from scenes.yaml.errors import InputError
from twin.camera.camera_optics import CameraOptics
from twin.camera.colour import spectral_psfs
from twin.camera.first_order_data import FIRST_ORDER, first_order_data
from twin.live.camera_design import MOST_BLUR, RANGE_WAVES, changed_camera, image_width, point_image
from twin.live.computer import RequestHandler, camera_file, course_text
from twin.live.live_bench import LiveBench
from twin.live.messages import AskedState, AskedView
from twin.live.source import read_source
from twin.scripting.instrument_twin import InstrumentTwin

pytestmark = pytest.mark.drawn

KNOBS = {"design/M1 radius": 0.01, "design/M2 conic": 0.02, "design/M2 thickness": 0.1, "field x": 0.05}


def bench_of(what) -> LiveBench:
    return LiveBench(InstrumentTwin.of(read_source(str(what)).resolved))


@pytest.fixture(scope="module")
def gf7() -> LiveBench:
    """Off-axis, with even aspheres, its stop at the second mirror."""
    return bench_of("gf7")


@pytest.fixture(scope="module")
def vignetted() -> LiveBench:
    return bench_of("ritchey_chretien")


def asked(knobs=None, **other) -> AskedState:
    return AskedState(n=1, knobs=knobs or {}, **{"quality": False, **other})


def optics_of(file, backend) -> CameraOptics:
    """The camera as twin.camera analyses its file."""
    return CameraOptics.alone(resolve_camera(file).camera, backend)


def agrees(told, optics: CameraOptics, field) -> None:
    """The page's numbers are those of twin.camera, to the rounding of traces in another order."""
    first = FIRST_ORDER(first_order_data(optics))
    assert told["layout"]["focal_length_m"] == pytest.approx(first["focal_length_m"], rel=1e-9)
    assert told["layout"]["f_number"] == pytest.approx(first["f_number"], rel=1e-9)
    wave, spot = optics.wavefronts([field], by_rays=True)[0], optics.spot(field)
    assert told["wavefront"]["rms_waves"] == pytest.approx(wave.rms, rel=1e-6, abs=1e-9)
    assert told["spot"]["rms_um"] == pytest.approx(1e6 * spot.rms, rel=1e-6)
    if wave.rms < MOST_BLUR:
        assert told["mtf"]["along"] == pytest.approx(optics.mtf(field).at(optics.nyquist)[0], abs=2e-4)


@pytest.mark.second
@pytest.mark.parametrize("camera", ["gf7", "vignetted"])
def test_knobs_at_zero_change_nothing(camera, request, backend):
    bench = request.getfixturevalue(camera)
    told, _ = bench.state(asked())
    zero, _ = bench.state(asked(dict.fromkeys(bench.design.knobs, 0.0)))
    assert json.dumps(zero["optics"]) == json.dumps(told["optics"])
    assert (
        bench.perturbed(asked(dict.fromkeys(bench.design.knobs, 0.0))).resolved.cameras == bench.twin.resolved.cameras
    )
    agrees(told["optics"], optics_of(bench.design.name, backend), (0.0, 0.0))


@pytest.mark.second
@pytest.mark.parametrize(("camera", "radius"), [("gf7", "-6.74535927468851 m"), ("korsch", "-2.5 m")])
def test_a_radius_has_the_wavefront_of_a_file_with_it(camera, radius, backend, tmp_path):
    """The primary with a radius larger by one per cent, at a field point; korsch then has twice its focal length."""
    text = (LIBRARY / "cameras" / f"{camera}.yaml").read_text("utf-8")
    number = float(radius.split()[0])
    assert text.count(radius) == 1
    text = text.replace(radius, f"{1.01 * number!r} m")
    if camera == "korsch":
        text = text.replace("focal_length: 6 m", "focal_length: 12.22 m")
    file = tmp_path / "changed.yaml"
    file.write_text(text, "utf-8")
    bench = bench_of(camera)
    half = bench.knobs["field x"].limit
    told, _ = bench.state(asked({"design/M1 radius": 1.0, "field x": 0.5 * half}))
    agrees(told["optics"], optics_of(file, backend), (0.5, 0.0))
    assert told["optics"]["mtf"] == told["optics"]["psf"] == {"problem": "image quality is computed up to 10 waves rms"}


@pytest.mark.second
@pytest.mark.parametrize("camera", ["gf7", "vignetted"])
def test_a_saved_camera_gives_the_same_numbers(camera, request, backend, tmp_path):
    bench = request.getfixturevalue(camera)
    told, images = bench.state(asked(KNOBS))
    assert images is None
    assert told["pictures"]["wavefront"].shape == (1, 49, 49)
    text = camera_file(bench, asked({**KNOBS, f"base/{bench.design.name}/M2 shift x": 5.0}))
    assert "design/M1 radius 0.01 percent; design/M2 conic 0.02; design/M2 thickness 0.1 mm" in text
    assert "Motions and temperatures of bodies are not part" in text
    file = tmp_path / "camera.yaml"
    file.write_text(text, "utf-8")
    optics = optics_of(file, backend)
    agrees(told["optics"], optics, (0.05 / bench.knobs["field x"].limit, 0.0))
    again = bench_of(file)
    repeated, _ = again.state(asked({"field x": 0.05}))
    assert repeated["optics"]["wavefront"]["rms_waves"] == pytest.approx(
        told["optics"]["wavefront"]["rms_waves"], rel=1e-9
    )
    with pytest.raises(ValueError, match="not another design"):
        course_text(bench, [(0.0, asked()), (1.0, asked(KNOBS))])


def test_a_distance_moves_what_follows():
    """Longer from M1 to M2 is toward -z, against the light before; M3 and the image move with M2.

    Changed numbers have 15 digits, so that they can be read in the saved file; all others are as they were.
    """
    spec = load_camera("korsch")
    made = changed_camera(spec, {"design/M1 thickness": 2.0, "design/M3 thickness": -1.0, "design/M2 radius": 10.0})
    moved = {name: made.mirrors[name].z - mirror.z for name, mirror in spec.mirrors.items()}
    assert moved == pytest.approx({"baffle": 0.0, "M1": 0.0, "M2": -2e-3, "M3": -2e-3}, abs=3e-15)
    # from M3 the light goes back to the image, which is nearer by a millimetre
    assert made.image.z - spec.image.z == pytest.approx(-2e-3 + 1e-3, abs=3e-15)
    assert made.mirrors["M2"].radius == pytest.approx(1.1 * spec.mirrors["M2"].radius, rel=1e-14)
    assert changed_camera(spec, {}).mirrors == spec.mirrors
    with pytest.raises(InputError, match="M2 would be on the other side of M1"):
        changed_camera(spec, {"design/M1 thickness": -1000.0})


@pytest.mark.second
@pytest.mark.parametrize(
    ("knobs", "cause"),
    [
        ({"design/M1 thickness": -5000.0}, "other side of M1"),
        ({"design/M1 conic": 90.0}, "does not reach the image"),
        ({"field x": 9.0}, "up to 1.25 deg"),
        ({"design/M9 conic": 1.0}, "no such knob"),
        ({"design/M1 radius": 51.0}, "up to 50 percent"),
    ],
)
def test_an_impossible_design_says_why_and_the_next_one_is_good(gf7, knobs, cause):
    before, _ = gf7.state(asked(KNOBS))
    told, _ = gf7.state(asked(knobs))
    assert "optics" not in told
    assert cause in " ".join(told["causes"])
    assert "/" not in told["causes"][0].split(":")[0] or "design" in told["causes"][0]
    after, _ = gf7.state(asked(KNOBS))
    assert after["optics"] == before["optics"]


@pytest.mark.second
@pytest.mark.parametrize("kind", ["ritchey-chretien", "korsch"])
def test_sliders_of_a_first_design_are_useful(kind, tmp_path):
    """Every end of a slider changes the wavefront by no more than some waves, and most by about ``RANGE_WAVES``."""
    file = tmp_path / "first.yaml"
    file.write_text(first_camera(kind, "first", 0.5, 10.0, 650e-9), "utf-8")
    bench = bench_of(file)
    change = []
    for knob in bench.design.knobs.values():
        told, _ = bench.state(asked({knob.name: knob.extent}))
        assert "problem" not in told, told
        change.append(told["optics"]["wavefront"]["rms_waves"])
    assert max(change) < 2.0 * RANGE_WAVES
    assert np.count_nonzero(np.array(change) > 0.3 * RANGE_WAVES) >= 5


@pytest.mark.second
def test_a_point_image_is_that_of_twin_camera(backend):
    """Of the clear pupil, whose rule is exact, within a per cent of the peak; beside vanes between rays, within two."""
    for name, field, tolerance in (("gf7", (0.8, -0.5), 0.01), ("ritchey_chretien", (0.0, 0.0), 0.02)):
        optics = CameraOptics.alone(changed_camera(load_camera(name), {"design/M1 conic": 0.002}), backend)
        spot = optics.spot(field)
        full = spectral_psfs(optics, [field], np.array([optics.wavelength]), np.ones(1))[0]
        image = point_image(optics, field, spot, full.position)
        assert np.max(np.abs(image / np.max(image) - full.values / np.max(full.values))) < tolerance
        assert image_width(spot) < full.position[-1]
        with pytest.raises(ValueError, match="only a sharper image"):
            point_image(optics, field, spot, 100.0 * full.position)


@pytest.mark.second
def test_pictures_quality_and_files_follow_the_design():
    answers = RequestHandler("gf7", "llvm", lambda part: None)
    assert list(answers.opened.greeting["nodes"])[:3] == ["field", "design", "design/M1"]
    nominal, changed = (answers.bench.state(asked(knobs, quality=True))[0] for knobs in ({}, KNOBS))
    assert changed["quality"]["cameras"]["gf7"]["wfe_rms_waves"] > nominal["quality"]["cameras"]["gf7"]["wfe_rms_waves"]
    svg = [
        json.loads(answers.handle("view", AskedView(n=1, state=asked(knobs), view="wavefront", camera="gf7")))["svg"]
        for knobs in ({}, KNOBS)
    ]
    assert svg[0] != svg[1]
    saved = json.loads(answers.handle("camera", asked(KNOBS)))
    assert (saved["name"], "problem" in saved) == ("camera.yaml", False)
    message = answers.handle("state", (asked(KNOBS), None))
    head = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
    assert set(head["images"]) == {"wavefront", "psf", "before"}


def test_a_changed_camera_has_numbers_without_float_noise(vignetted: LiveBench) -> None:
    """-3 m (1 + 0.012 / 100) is -3.00036 m, and the float beside it without rounding."""
    spec = load_camera("ritchey_chretien")
    changed = changed_camera(spec, {"design/M1 radius": 0.012, "design/M1 thickness": 0.3})
    assert (changed.mirrors["M1"].radius, changed.mirrors["M2"].z, changed.image.z) == (-3.00036, -1.0503, 0.44961)
