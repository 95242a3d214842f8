"""Edges in a camera's file: what they may say, what they take of the light, where they may not stand, round trips."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Edge
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface
from optics.numerics.array_math import UnphysicalError
from optics.raytrace.assembly import Interaction
from scenes.lens.__main__ import read_prescription
from scenes.lens.batoid_writer import batoid_text
from scenes.lens.camera_reader import Width, camera_of, camera_text
from scenes.lens.camera_writer import prescription_of
from scenes.lens.prescription import LensSurface
from scenes.lens.zemax_writer import zemax_text
from scenes.models.camera_model import derive_camera
from scenes.models.camera_sharpness import FieldBeams, FocalPlane
from scenes.specs.camera import CameraSpec
from scenes.specs.load import load_camera
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.twin.study_bench import ROOT
from twin.camera.camera_optics import CameraOptics
from twin.camera.cut_wavefront import RAYS_ACCURACY
from twin.camera.field_maps import field_curves, through_focus

PAGE = (ROOT / "docs/prescriptions.md").read_text("utf-8")
CAMERA = re.search(r"```yaml\n(name: two_mirrors.*?)```", PAGE, re.S)[1]
BARE = re.sub(r"  P1:.*?(?=  M1:)", "", re.sub(r", edges: \[\{.*?\}\]", "", CAMERA), flags=re.S)


def camera(text: str) -> CameraSpec:
    return validate(CameraSpec, parse_yaml(text))


@pytest.fixture(scope="module")
def bare(backend) -> CameraOptics:
    return CameraOptics.alone(camera(BARE), backend)


@pytest.fixture(scope="module")
def cut(backend) -> CameraOptics:
    return CameraOptics.alone(camera(CAMERA), backend)


def with_edges(text: str, surface: str = "M1") -> CameraSpec:
    return camera(re.sub(rf"  {surface}: {{", f"  {surface}: {{edges: [{text}], ", BARE))


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
        ("{clear: ellipse, half: [150 mm, 75 mm], turn: 30 deg}", 0.5),
        ("{blocks: circle, radius: 75 mm}, {clear: rectangle, half: [1 m, 1 m], centre: [1 m, 0 m]}", 0.625),
    ):
        optics = CameraOptics.alone(with_edges(text), backend)
        # 10 000 rays spread evenly tell an area to its outline over their distance: 1e-3
        assert optics.wavefront().vignetted == pytest.approx(share, abs=2e-3), text
    with pytest.raises(InputError, match="edges leave no light to speak of"):
        FieldBeams.field_errors(
            derive_camera(with_edges("{clear: circle, radius: 5 mm}"), backend), backend, [(0.0, 0.0)], 6
        )


@pytest.mark.second
def test_wavefronts_and_focus_are_of_the_light_that_comes_through(backend, bare) -> None:
    """An aberration of the outer half of the pupil goes with the light there; the sharpness of both ways agrees."""
    stopped = camera(BARE.replace("entrance_pupil: 300 mm", "entrance_pupil: 150 mm"))
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
    mapped = FieldBeams.field_errors(cut.model, backend, fields, 5)
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
    assert wave.polynomials == "annular Zernike terms, hole 0.5000 of the stop"
    whole = CameraOptics.alone(camera_at(camera(BARE), "z: 300.2 mm"), backend).wavefront()
    assert whole.polynomials == "Zernike circle terms"
    # r^2 over a ring spreads by (1 - e^2) / sqrt 12, over the whole stop by 1 / sqrt 12
    assert wave.parts[3] == pytest.approx(0.75 * whole.parts[3], rel=2e-3)
    assert wave.accuracy < 1e-4
    spider = cut.wavefront((1.0, 0.0))
    assert np.isnan(spider.hole)
    assert spider.polynomials == "terms orthonormal over the light of this pupil"
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
    np.testing.assert_allclose(cut.path.places({}, light), bare.path.places({}, light), rtol=0, atol=1e-14)
    # the light of 0.1 deg at f tan W; the chief ray starts where the hyperboloid of M2 has its other sheet
    np.testing.assert_allclose(cut.path.places({}, light)[0], [np.tan(np.radians(0.1)) / 0.3, 0.0], rtol=0, atol=1e-7)


@pytest.mark.second
def test_light_of_a_cut_pupil_is_that_of_traced_rays(cut, monkeypatch) -> None:
    """Where the two differ there is no MTF: a piece of shadow was lost, or counted twice."""
    (pupil,), (wave,) = cut.pupils([(1.0, 0.0)]), cut.wavefronts([(1.0, 0.0)])
    assert pupil.light == pytest.approx(1.0 - wave.vignetted, abs=1e-3)
    monkeypatch.setattr("twin.camera.camera_optics.WORST_LIGHT", 1e-9)
    with pytest.raises(UnphysicalError, match="traced rays"):
        cut.pupils([(1.0, 0.0)])


def test_instruments_take_no_camera_with_edges() -> None:
    spec = camera(CAMERA)
    with pytest.raises(InputError, match=r"mirrors\.P1\.edges: a camera of an instrument has no edges"):
        spec.require_mirrors("a camera of an instrument")
    load_camera("gf7").require_mirrors("a camera of an instrument")


@pytest.mark.parametrize("kind", [".yaml", ".zmx"])
def test_written_and_read_again_they_stop_the_same_rays(backend, kind, tmp_path: Path) -> None:
    """batoid's file carries all shapes but ellipses; a .zmx one circle, rectangle or ellipse a surface."""
    text = CAMERA.replace("field: {x: 0.1 deg, y: 0.1 deg}", "field: {x: 1 deg, y: 1 deg}")
    if kind == ".zmx":
        text = re.sub(r"      - \{blocks: ray.*\n", "", text)
    model = derive_camera(camera(text), backend)
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
        again = camera(camera_text(made, read))
        assert [len(m.edges or ()) for m in again.mirrors.values()] == [
            len(m.edges or ()) for m in model.spec.mirrors.values()
        ]
        assert made.difference < 1e-12


def test_what_a_zmx_has_no_statement_for_is_refused(backend) -> None:
    with pytest.raises(InputError, match="cannot carry edges beyond a clear aperture"):
        zemax_text(prescription_of(derive_camera(camera(CAMERA), backend)))


def test_clear_apertures_that_stop_nothing_are_left_out(backend, tmp_path: Path) -> None:
    """gf7's own boxes about its beams: read back, the camera has no edges and may stand in an instrument."""
    path = tmp_path / "gf7.zmx"
    path.write_text(zemax_text(prescription_of(derive_camera(load_camera("gf7"), backend))), "utf-8")
    made = camera_of(read_prescription(path), "gf7", backend)
    made.camera.require_mirrors("a camera of an instrument")
    assert any("2 of them stop no light of the field" in str(note) for note in made.notes)


@pytest.mark.second
def test_a_field_with_dark_corners_is_taken_to_be_round(backend, tmp_path: Path) -> None:
    """Fields on both axes, and an edge near the image that lets through no more than the circle of them."""
    spec = camera(CAMERA.replace("field: {x: 0.1 deg, y: 0.1 deg}", "field: {x: 0.7 deg, y: 0.7 deg}"))
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
    assert any("taken to be round" in str(note) for note in made.notes)
    smaller = replace(
        lens, surfaces=(*lens.surfaces[:-2], replace(field_stop, edges=(Edge(Circle(0.01)),)), lens.image)
    )
    with pytest.raises(InputError, match="edges leave no light at the end of the field"):
        camera_of(smaller, "round", backend, Width(0.3))
