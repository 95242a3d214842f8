"""The axis of a camera: the stop that its entrance pupil asks for, a stated stop, and systems without focus.

Edges in a camera's file: what they may say, what they take of the light, where they may not stand, round trips.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer import Exit

from optics.geometry.aperture import Circle, Edge
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface
from optics.geometry.tree import Motion
from optics.numerics.array_math import UnphysicalError
from optics.raytrace.aim import AimError
from optics.raytrace.assembly import Interaction
from scenes.lens.__main__ import read_prescription
from scenes.lens.camera_reader import Width, camera_of, camera_text
from scenes.lens.camera_writer import batoid_text, prescription_of, zemax_text
from scenes.lens.prescription import LensSurface
from scenes.models.camera_model import AfocalError, CameraModel, check_entrance_pupil, derive_camera
from scenes.models.camera_sharpness import FieldBeams, FocalPlane
from scenes.specs.camera import CameraSpec
from scenes.specs.load import load_camera
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.own_trace import OwnCamera
from tests.twin.study_bench import ROOT
from twin.camera.aberrations import field_curves, through_focus
from twin.camera.camera_optics import RAYS_ACCURACY, CameraOptics
from twin.camera.first_order_data import FIRST_ORDER, first_order_data
from twin.framework import cli

PETZVAL = """
  A: {z: 0 m, radius: 61 mm, light: refracts, index: 1.52}
  B: {z: 9 mm, radius: -240 mm, light: refracts, index: 1}
  STOP: {z: 30 mm, radius: flat, light: passes}
  C: {z: 46 mm, radius: 48 mm, light: refracts, index: 1.52}
  D: {z: 52 mm, radius: -160 mm, light: refracts, index: 1}
"""
CASSEGRAIN = """
  M1: {z: 0 m, radius: -3 m, conic: -1}
  M2: {z: -1.1 m, radius: -1 m, conic: -2.6}
"""


def text_of(
    mirrors: str, stop: str, focal: float, pupil: str, image: float, more: str = "", bias: str = "0 deg"
) -> str:
    return f"""
name: drawn
focal_length: {focal!r} m
entrance_pupil: {pupil}
field_bias: {bias}
field: {{x: 0.05 deg, y: 0.05 deg}}
wavelength: 600 nm
stop: {stop}
{more}
mirrors:{mirrors}
image: {{z: {image!r} m}}
line: {{pixels: 20, pitch: 7 um}}
edge_margin: 1 mm
"""


def camera(backend, *given: object, stated: bool = True, **named: object) -> CameraModel:
    return derive_camera(validate(CameraSpec, parse_yaml(text_of(*given, **named))), backend, stated)  # type: ignore[arg-type]


def own_radius(model: CameraModel, pupil: float) -> float:
    """Where the marginal ray of a beam along the axis meets the stop, by NumPy alone."""
    ray = OwnCamera(model.spec).trace(np.array([[0.0, 0.5 * pupil, -2.0]]), np.array([0.0, 0.0, 1.0]))
    return float(np.hypot(*ray.stop[0]))


@pytest.mark.second
def test_the_stop_is_as_large_as_the_marginal_ray_makes_it(backend) -> None:
    """Behind power that is not where a paraxial ray goes: the beam before the first surface has the stated width."""
    model = camera(backend, PETZVAL, "STOP", 0.055, "26 mm", 0.0797)
    radius = model.apertures["STOP"].bounds[1]
    assert radius == pytest.approx(own_radius(model, 0.026), rel=1e-9)
    near = own_radius(model, 1e-6) * 0.026 / 1e-6
    assert abs(radius / near - 1.0) > 5e-4
    data = FIRST_ORDER(first_order_data(CameraOptics.alone(model, backend)))
    assert data["entrance_pupil_m"] == pytest.approx(0.026, rel=1e-9)


def test_a_stated_stop_decides(backend) -> None:
    """Its entrance pupil is traced, and the stated one nominal, if both are not far apart."""
    more = "stop_diameter: 17 mm"
    model = camera(backend, PETZVAL, "STOP", 0.055, "26 mm", 0.0797, more)
    assert model.apertures["STOP"].bounds[1] == 0.0085
    assert own_radius(model, model.entrance_pupil) == pytest.approx(0.0085, rel=1e-8)
    assert abs(model.entrance_pupil / 0.026 - 1.0) > 0.01
    # its radius in place of its diameter
    with pytest.raises(InputError, match="a stop of this size has an entrance pupil of") as error:
        camera(backend, PETZVAL, "STOP", 0.055, "26 mm", 0.0797, "stop_diameter: 8.5 mm")
    assert error.value.key == ("stop_diameter",)


AFOCAL = {
    "Mersenne": ("\n  M1: {z: 0 m, radius: -4 m, conic: -1}\n  M2: {z: -1.6 m, radius: -0.8 m, conic: -1}", 5.0),
    "Mersenne, 20 um off": (
        "\n  M1: {z: 0 m, radius: -4 m, conic: -1}\n  M2: {z: -1.60002 m, radius: -0.8 m, conic: -1}", 5.0,
    ),
    "Gregory": ("\n  M1: {z: 0 m, radius: -4 m, conic: -1}\n  M2: {z: -2.5 m, radius: 1 m, conic: -1}", 4.0),
    "flat": ("\n  M1: {z: 0 m, radius: flat}", 1.0),
    "window": (
        "\n  M1: {z: 0 m, radius: flat, light: refracts, index: 1.5}"
        "\n  B: {z: 1 cm, radius: flat, light: refracts, index: 1}", 1.0,
    ),
}  # fmt: skip


@pytest.mark.second
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("name", AFOCAL)
def test_afocal_systems_are_no_cameras(backend, name: str, stated: bool) -> None:
    """Also where a stated focal length is that of the image plane's distance, and while a file is made."""
    mirrors, magnification = AFOCAL[name]
    with pytest.raises(InputError, match="the system is afocal, with an angular magnification of") as error:
        camera(backend, mirrors, "M1", 5.0, "0.2 m", 0.5 if name != "flat" else -0.5, stated=stated)
    assert error.value.key == ("mirrors",)
    told = float(str(error.value).partition("magnification of ")[2].partition(":")[0])
    assert told == pytest.approx(magnification, rel=1e-4)


def test_the_pupils_of_a_camera_behind_a_plane_that_light_passes(backend) -> None:
    """The plane is before the launch point of the axial ray; by Lagrange's invariant magnifications are reciprocal."""
    plane = "\n  SHADOW: {z: -6 m, radius: flat, light: passes}"
    paraxial = camera(backend, plane + CASSEGRAIN, "M1", 1.5 * 0.5 / 0.1, "0.3 m", 0.9, stated=False).paraxial
    assert paraxial.entrance_pupil == pytest.approx(0.0, abs=1e-12)
    assert paraxial.exit_magnification * paraxial.angular_magnification == pytest.approx(1.0, rel=1e-9)


@pytest.mark.second
def test_the_data_are_those_of_one_state(backend) -> None:
    """Two mirrors by hand, M2 a millimetre nearer to M1 and the image plane 5 mm farther out."""
    f1, f2, apart, place = 1.5, -0.5, 1.1, 0.63
    focal = f1 * f2 / (f1 + f2 - apart)
    model = camera(backend, CASSEGRAIN, "M1", focal, "0.3 m", place)
    optics = CameraOptics.alone(model, backend)
    moved = {"camera/M2": Motion(shift=(0.0, 0.0, 1e-3)), "camera/focal_plane": Motion(shift=(0.0, 0.0, -5e-3))}
    for one, d, image in ((optics, apart, place), (optics.in_state(moved), apart - 1e-3, place + 5e-3)):
        told = FIRST_ORDER(first_order_data(one))
        # a chief ray of slope 1 through M1's vertex, and a ray at height 1
        slope, away = 1.0 + d / -f2, d + image
        power = -1.0 / f1 + (1.0 - d / f1) / -f2
        distance = d + away * slope
        assert told["focal_length_m"] == pytest.approx(-1.0 / power, rel=1e-9)
        assert told["back_focal_length_m"] == pytest.approx(-(1.0 - d / f1) / power, rel=1e-9)
        assert told["f_number"] == pytest.approx(-1.0 / power / 0.3, rel=1e-9)
        assert told["principal_distance_along_line_m"] == pytest.approx(distance, rel=1e-9)
        assert told["plate_scale_arcsec_per_mm"] == pytest.approx(np.degrees(3.6) / distance, rel=1e-9)
        assert told["pixel_arcsec"] == pytest.approx(np.degrees(3600.0) * 7e-6 / distance, rel=1e-9)
        assert told["exit_pupil_before_image_m"] == pytest.approx(distance / slope, rel=1e-9)
        assert told["exit_pupil_m"] == pytest.approx(0.3 / slope, rel=1e-9)
        assert told["image_mm"][0] == pytest.approx(2e3 * distance * np.tan(np.radians(0.05)), rel=1e-4)
        assert told["working_f_number"] == pytest.approx(told["f_number"], rel=5e-3)
        assert told["length_m"] == pytest.approx(d + image, rel=1e-9)


def test_a_state_without_focus_is_said(backend, capsys) -> None:
    """Near afocal as designed, afocal when M2 has moved: one sentence and exit code 2."""
    mirrors = "\n  M1: {z: 0 m, radius: -4 m, conic: -1}\n  M2: {z: -1.61 m, radius: -0.8 m, conic: -1}"
    model = camera(backend, mirrors, "M1", 80.0, "0.2 m", 14.0)
    moved = CameraOptics.alone(model, backend, {"camera/M2": Motion(shift=(0.0, 0.0, 0.01))})
    with pytest.raises(Exit) as left, cli.explained(Console(stderr=True)):
        first_order_data(moved)
    assert left.value.exit_code == 2
    assert "the system is afocal" in capsys.readouterr().err
    with pytest.raises(AfocalError):
        first_order_data(moved)
    for kind, code in ((AimError("the beam is lost"), 2), (UnphysicalError("an MTF of 2"), None)):
        with pytest.raises(Exit if code else UnphysicalError) as left, cli.explained(Console(stderr=True)):
            raise kind
        assert code is None or left.value.exit_code == code


def test_a_stop_whose_rim_other_rays_meet_is_refused() -> None:
    spec = validate(CameraSpec, parse_yaml(text_of(CASSEGRAIN, "M1", 4.0, "300 mm", 0.5)))
    check_entrance_pupil(spec, 0.2975)
    with pytest.raises(
        InputError, match="stop: the rays at the rim of the stop are not those of the stated entrance pupil"
    ):
        check_entrance_pupil(spec, 0.2965)


def test_a_telecentric_image_has_no_place_of_its_pupil(backend) -> None:
    """The stop in the front focus of a lens: no number of a rounding's size is told, and none that is no number."""
    n, r, t = 1.5, 0.1, 0.01
    power = (n - 1.0) * (2.0 / r - (n - 1.0) * t / (n * r * r))
    front = (1.0 - (n - 1.0) * t / (n * r)) / power
    lens = f"""
  STOP: {{z: {-front!r} m, radius: flat, light: passes}}
  A: {{z: 0 m, radius: {r} m, light: refracts, index: {n}}}
  B: {{z: {t} m, radius: {-r} m, light: refracts, index: 1}}
"""
    model = camera(backend, lens, "STOP", 1.0 / power, "8 mm", t + front)
    told = FIRST_ORDER(first_order_data(CameraOptics.alone(model, backend)))
    assert told["exit_pupil_before_image_m"] is None
    assert told["exit_pupil_m"] is None
    assert told["focal_length_m"] == pytest.approx(1.0 / power, rel=1e-9)


def test_where_no_light_comes_along_the_axis(backend) -> None:
    """A flat, and 3 m farther a sphere that light of the axis passes by: about the field's middle, where the powers of
    an oblique mirror, 2 / (R cos i) and 2 cos i / R, have the mean 2 / R.
    """
    mirrors = f"""
  M1: {{z: 0 m, radius: flat}}
  M2: {{z: -3 m, decentre: [0 m, {float(3.0 * np.tan(np.radians(10.0)))!r} m], radius: 0.4 m}}
"""
    model = camera(backend, mirrors, "M1", 0.2, "10 mm", -2.8, bias="10 deg")
    assert not model.axis.on_axis
    assert model.paraxial.focal_length == pytest.approx(0.2, rel=1e-9)
    # a beam that is square to the light and 10 mm wide lights a flat at 10 deg as an ellipse
    assert model.apertures["M1"].bounds[1] == pytest.approx(0.005 / np.sqrt(np.cos(np.radians(10.0))), rel=1e-9)


# --- camera edges -----------------------------------------------------------------------------------------------------

PAGE = (ROOT / "docs/prescriptions.md").read_text("utf-8")
CAMERA = re.search(r"```yaml\n(name: two_mirrors.*?)```", PAGE, re.S)[1]
BARE = re.sub(r"  P1:.*?(?=  M1:)", "", re.sub(r", edges: \[\{.*?\}\]", "", CAMERA), flags=re.S)


def spec_of(text: str) -> CameraSpec:
    return validate(CameraSpec, parse_yaml(text))


@pytest.fixture(scope="module")
def bare(backend) -> CameraOptics:
    return CameraOptics.alone(spec_of(BARE), backend)


@pytest.fixture(scope="module")
def cut(backend) -> CameraOptics:
    return CameraOptics.alone(spec_of(CAMERA), backend)


def with_edges(text: str, surface: str = "M1") -> CameraSpec:
    return spec_of(re.sub(rf"  {surface}: {{", f"  {surface}: {{edges: [{text}], ", BARE))


@pytest.mark.second
def test_edges_take_the_share_of_their_area(backend, cut, bare) -> None:
    """The stop is M1 and light comes square to it: what a disk and three vanes before it take of the middle's beam."""
    assert bare.wavefront().vignetted == 0.0
    disk, vane, stop = 0.05, 0.004, 0.15
    # a vane from the disk's edge to the stop's, less what its ends bend
    expected = (np.pi * disk**2 + 3 * vane * (stop - disk)) / (np.pi * stop**2)
    assert cut.wavefront().vignetted == pytest.approx(expected, abs=1e-3)
    for text, share in (
        ("{clear: circle, radius: 75 mm}", 0.75),
        ("{clear: circle, radius: 1 m, inner: 75 mm}", 0.25),
        ("{clear: rectangle, half: [1 m, 1 m], centre: [1 m, 0 m]}", 0.5),
        ("{blocks: polygon, corners: [[0 m, 0 m], [1 m, 0 m], [0 m, 1 m]]}", 0.25),
        ("{clear: ellipse, half: [150 mm, 75 mm], rotation: 30 deg}", 0.5),
        ("{blocks: circle, radius: 75 mm}, {clear: rectangle, half: [1 m, 1 m], centre: [1 m, 0 m]}", 0.625),
    ):
        optics = CameraOptics.alone(with_edges(text), backend)
        # 10 000 rays spread evenly tell an area to its outline over their distance: 1e-3
        assert optics.wavefront().vignetted == pytest.approx(share, abs=2e-3), text
    with pytest.raises(InputError, match="edges block practically all light"):
        CameraOptics.alone(with_edges("{clear: circle, radius: 5 mm}"), backend).errors([(0.0, 0.0)], 6)


@pytest.mark.second
def test_wavefronts_and_focus_are_of_the_light_that_comes_through(backend, bare) -> None:
    """An aberration of the outer half of the pupil goes with the light there; the sharpness of both ways agrees."""
    stopped = spec_of(BARE.replace("entrance_pupil: 300 mm", "entrance_pupil: 150 mm"))
    masked = with_edges("{clear: circle, radius: 75 mm}")
    for moved in ("z: 300 mm", "z: 300.2 mm"):
        one, other = (CameraOptics.alone(camera_at(spec, moved), backend) for spec in (stopped, masked))
        small, large = one.wavefront((1.0, 0.0)), other.wavefront((1.0, 0.0))
        # of the 10 000 rays over the whole stop a quarter comes through: their edge is right to 0.3 % of the rms
        assert large.rms == pytest.approx(small.rms, rel=3e-3)
        beams = [FieldBeams.trace(o.model, backend, ((1.0, 0.0),), 12) for o in (one, other)]
        errors = [float(b.errors(FocalPlane.of(o.model.spec))[0]) for b, o in zip(beams, (one, other), strict=True)]
        assert errors[1] == pytest.approx(errors[0], rel=3e-3)
        assert large.strehl == pytest.approx(small.strehl, abs=3e-3)
        assert other.spot((1.0, 0.0)).rms == pytest.approx(one.spot((1.0, 0.0)).rms, rel=3e-3)
    assert CameraOptics.alone(masked, backend).wavefront((1.0, 0.0)).rms < 0.5 * bare.wavefront((1.0, 0.0)).rms


@pytest.mark.second
def test_every_table_tells_one_wavefront_error_of_a_cut_beam(backend, cut) -> None:
    """Wavefronts, map over the field, curves along the line and through focus; no part of it is above the whole."""
    fields = ((-1.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    waves = cut.wavefronts(fields, points=3)
    rms = np.array([wave.rms for wave in waves])
    # maps over the field and through focus trace the same rays, one to the image and one to the focal plane: rounding
    # of metres of path; these 10 000 are right to what they stand for in a wavefront, too
    close = {"rtol": 1e-6, "atol": 1e-8}
    mapped = cut.errors(fields, 5)
    np.testing.assert_allclose(mapped, rms, rtol=RAYS_ACCURACY)
    np.testing.assert_allclose(field_curves(cut, False, 3).error[[0, 2]], rms[:2], **close)
    focus = through_focus(cut, fields, False)
    np.testing.assert_allclose(focus.error[:, len(focus.defocus) // 2], mapped, **close)
    assert all(wave.accuracy < 1e-4 for wave in waves)
    for wave in waves:
        assert np.sum(wave.parts**2) + wave.residual**2 == pytest.approx(wave.rms**2, rel=1e-9)


def test_parts_of_a_whole_pupil_are_its_coefficients(bare) -> None:
    wave = bare.wavefront((1.0, 1.0))
    np.testing.assert_allclose(wave.parts[3:], wave.coefficients[3:], rtol=0, atol=1e-9 * wave.rms)


def test_a_ring_has_annular_terms_and_a_spider_its_own(cut, backend) -> None:
    """Defocus over the ring that an edge of M1 leaves is that of the whole stop times 1 - e^2."""
    ring = CameraOptics.alone(camera_at(with_edges("{blocks: circle, radius: 75 mm}"), "z: 300.2 mm"), backend)
    wave = ring.wavefront()
    assert wave.hole == pytest.approx(0.5, abs=1e-4)
    assert wave.polynomials == "annular Zernike terms, obscuration ratio 0.5000"
    whole = CameraOptics.alone(camera_at(spec_of(BARE), "z: 300.2 mm"), backend).wavefront()
    assert whole.polynomials == "Zernike circle terms"
    # r^2 over a ring spreads by (1 - e^2) / sqrt 12, over the whole stop by 1 / sqrt 12
    assert wave.parts[3] == pytest.approx(0.75 * whole.parts[3], rel=2e-3)
    assert wave.accuracy < 1e-4
    spider = cut.wavefront((1.0, 0.0))
    assert np.isnan(spider.hole)
    assert spider.polynomials == "terms orthonormal over the illuminated part of this pupil"
    assert list(spider.orthonormal_terms) == list(spider.terms)


def test_where_no_polygons_follow_the_edges_rays_stand_for_the_light(cut, monkeypatch) -> None:
    exact = cut.wavefront((1.0, 0.0))

    def refused(*given):
        raise UnphysicalError("no polygons")

    monkeypatch.setattr(type(cut.path), "shadows_on_stop", refused)
    counted = cut.wavefront((1.0, 0.0))
    assert counted.accuracy == RAYS_ACCURACY > exact.accuracy
    assert counted.rms == pytest.approx(exact.rms, rel=RAYS_ACCURACY)
    assert counted.vignetted == pytest.approx(exact.vignetted, abs=1e-3)


def camera_at(spec: CameraSpec, image: str) -> CameraSpec:
    plain = {**spec.plain(), "image": {"z": image.removeprefix("z: ")}}
    return CameraSpec.model_validate(plain)


def test_rays_without_edges_are_as_they_were(bare, cut) -> None:
    """Edges stop rays and do nothing else: places and paths are those of the camera without, to rounding."""
    fields = [(0.0, 0.0), (1.0, -1.0)]
    points = np.random.default_rng(2).uniform(-0.7, 0.7, (50, 2))
    one, other = bare.rays(fields, points), cut.rays(fields, points)
    np.testing.assert_allclose(other.position, one.position, rtol=0, atol=1e-14)
    # the baffle's light sets out farther away, all of a beam by as much
    np.testing.assert_allclose(np.diff(other.path), np.diff(one.path), rtol=0, atol=1e-14)
    assert one.valid.all()
    assert not other.valid.all()


def test_a_chief_ray_that_is_stopped_is_still_the_beams_middle(bare, cut) -> None:
    assert not cut.rays([(0.0, 0.0)], np.array([[0.0, 0.0], [0.5, 0.1]])).valid[0, 0]
    light = cut.directions([(1.0, 0.0)])
    np.testing.assert_allclose(cut.path.positions({}, light), bare.path.positions({}, light), rtol=0, atol=1e-14)
    # the light of 0.1 deg at f tan W; the chief ray starts where the hyperboloid of M2 has its other sheet
    np.testing.assert_allclose(cut.path.positions({}, light)[0], [np.tan(np.radians(0.1)) / 0.3, 0.0], 0, 1e-7)


@pytest.mark.second
def test_light_of_a_cut_pupil_is_that_of_traced_rays(cut, monkeypatch) -> None:
    """Where the two differ there is no MTF: a piece of shadow was lost, or counted twice."""
    (pupil,), (wave,) = cut.pupils([(1.0, 0.0)]), cut.wavefronts([(1.0, 0.0)])
    assert pupil.light == pytest.approx(1.0 - wave.vignetted, abs=1e-3)
    monkeypatch.setattr("twin.camera.camera_optics.WORST_LIGHT", 1e-9)
    with pytest.raises(UnphysicalError, match="traced rays"):
        cut.pupils([(1.0, 0.0)])


def test_instruments_take_no_camera_with_edges() -> None:
    spec = spec_of(CAMERA)
    with pytest.raises(InputError, match=r"mirrors\.P1\.edges: a camera of an instrument cannot have explicit edges"):
        spec.require_mirrors("a camera of an instrument")
    load_camera("gf7").require_mirrors("a camera of an instrument")


@pytest.mark.parametrize("kind", [".yaml", ".zmx"])
def test_written_and_read_again_they_stop_the_same_rays(backend, kind, tmp_path: Path) -> None:
    """batoid's file carries all shapes but ellipses; a .zmx one circle, rectangle or ellipse a surface."""
    text = CAMERA.replace("field: {x: 0.1 deg, y: 0.1 deg}", "field: {x: 1 deg, y: 1 deg}")
    if kind == ".zmx":
        text = re.sub(r"      - \{blocks: ray.*\n", "", text)
    model = derive_camera(spec_of(text), backend)
    lens = prescription_of(model)
    path = tmp_path / f"two{kind}"
    path.write_text(zemax_text(lens) if kind == ".zmx" else batoid_text(lens)[0], "utf-8")
    read = read_prescription(path, (), None if kind == ".zmx" else 650e-9)
    x, y = np.random.default_rng(4).uniform(-0.2, 0.2, (2, 20_000))

    def passes(surface: LensSurface) -> np.ndarray:
        # batoid's frames are turned over twice, and so are these
        return np.all([edge.passes(x, y) for edge in surface.every_edge], axis=0)

    assert len(read.surfaces) == len(lens.surfaces)
    for one, other in zip(lens.surfaces[:-1], read.surfaces[:-1], strict=True):
        assert np.array_equal(passes(one), passes(other)), one.name
        assert not passes(one).all()
    if kind == ".zmx":
        made = camera_of(read, "again", backend, Width(0.3))
        again = spec_of(camera_text(made, read))
        assert [len(m.edges or ()) for m in again.mirrors.values()] == [
            len(m.edges or ()) for m in model.spec.mirrors.values()
        ]
        assert made.difference < 1e-12


def test_what_a_zmx_has_no_statement_for_is_refused(backend) -> None:
    with pytest.raises(InputError, match="cannot represent edges other than a clear aperture"):
        zemax_text(prescription_of(derive_camera(spec_of(CAMERA), backend)))


def test_clear_apertures_that_stop_nothing_are_left_out(backend, tmp_path: Path) -> None:
    """gf7's own boxes about its beams: read back, the camera has no edges and may stand in an instrument."""
    path = tmp_path / "gf7.zmx"
    path.write_text(zemax_text(prescription_of(derive_camera(load_camera("gf7"), backend))), "utf-8")
    made = camera_of(read_prescription(path), "gf7", backend)
    made.camera.require_mirrors("a camera of an instrument")
    assert any("2 of them block no light of the field" in str(note) for note in made.notes)


@pytest.mark.second
def test_a_field_with_dark_corners_is_taken_to_be_round(backend, tmp_path: Path) -> None:
    """Fields on both axes, and an edge near the image that lets through no more than the circle of them."""
    spec = spec_of(CAMERA.replace("field: {x: 0.1 deg, y: 0.1 deg}", "field: {x: 0.7 deg, y: 0.7 deg}"))
    path = tmp_path / "round.yaml"
    path.write_text(batoid_text(prescription_of(derive_camera(spec, backend)))[0], "utf-8")
    half = np.radians(1.0)
    axes = ((0.0, 0.0), (half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half))
    lens = replace(read_prescription(path, (), 650e-9), fields=axes)
    # 0.1 m before the image light of 1 deg is 52 mm from the axis, and that of its corners 74 mm
    there, edge = Pose(np.eye(3), np.array([0.0, 0.0, 0.2])), (Edge(Circle(0.06)),)
    field_stop = LensSurface("field", there, Surface(), Interaction.PASS, edges=edge)
    lens = replace(lens, surfaces=(*lens.surfaces[:-1], field_stop, lens.image))
    made = camera_of(lens, "round", backend, Width(0.3))
    assert made.camera.field.x == pytest.approx(half / np.sqrt(2.0), rel=1e-9)
    assert any("treated as round" in str(note) for note in made.notes)
    smaller = replace(
        lens, surfaces=(*lens.surfaces[:-2], replace(field_stop, edges=(Edge(Circle(0.01)),)), lens.image)
    )
    with pytest.raises(InputError, match="edges block all light at the end of the field"):
        camera_of(smaller, "round", backend, Width(0.3))
