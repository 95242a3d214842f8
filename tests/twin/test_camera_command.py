"""The commands that judge and that optimise a camera: verdict, numbers by hand, refocusing, what is refused."""

import json
import re
import resource
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from optics.design.merit_function import Operands
from optics.design.optimiser import ActiveConstraint, DesignError, _require_fulfilled, initial_merit
from optics.geometry.aperture import Rectangle
from scenes.models.camera_design import CameraDesignSetup, beams_of, file_with_plane, prescription_of
from scenes.models.camera_model import IMAGE, CameraModel
from scenes.models.camera_sharpness import FIELDS, FocalPlane, sharpness
from scenes.models.monitor_layout import Beam
from scenes.specs.camera import CameraSpec
from scenes.specs.load import EXAMPLES, LIBRARY, load_camera
from scenes.specs.resolved import resolve_camera
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import read_yaml
from tests.scenes.refusals.tables import good
from tests.twin.commands import edited_copy, invoke, refused
from tests.twin.study_bench import REFUSED, TEXTS, refusals, without_mtf_and_many_rays
from tests.twin.test_blurred_cameras import GF7, gf7_with
from twin.camera import camera_plots
from twin.camera.__main__ import app
from twin.camera.aberrations import distortion
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_report import camera_report
from twin.camera.camera_run import aberration_name, perturbed_text, refocus_text, run_camera, verdict
from twin.camera.first_order_data import FIRST_ORDER, detector_beyond_field, first_order_data, obstacles
from twin.camera.refocus import find_focus
from twin.design.__main__ import app as design_app
from twin.design.design_run import ACTIVE_CONSTRAINT, _held_text, run_design
from twin.design.layout_bench import BeamFacts
from twin.design.layout_search import journal_of
from twin.framework.run_folder import RunFolderError


@pytest.fixture(scope="module")
def gf7_alone(backend, gf7) -> CameraOptics:
    return CameraOptics.alone(gf7, backend)


def test_a_camera_without_a_line_is_sampled_at_half_the_cut_off(tmp_path: Path) -> None:
    lines = (LIBRARY / "cameras/ritchey_chretien.yaml").read_text("utf-8").splitlines()
    lines = [line for line in lines if not line.startswith("line:")]
    bare = load_camera(written(tmp_path, lines))
    assert bare.line.pitch == pytest.approx(6.5e-6)  # 650 nm at F/10
    assert bare.line.pixels == round(2 * 5.0 * np.tan(np.radians(0.15)) / 6.5e-6)
    assert "line" not in bare.model_fields_set
    with pytest.raises(InputError, match="rows"):
        load_camera(written(tmp_path, [*lines, "line: {pixels: 100, pitch: 7 um, rows: 0}"]))
    with pytest.raises(InputError, match="wavelength") as missing:
        load_camera(written(tmp_path, [line for line in lines if not line.startswith("wavelength:")]))
    assert len(missing.value.issues) == 1  # what is missing, not what follows from it


def written(folder: Path, lines: list[str]) -> Path:
    """Write the lines of a camera file into a folder, and return its path."""
    file = folder / "camera.yaml"
    file.write_text("\n".join(lines), "utf-8")
    return file


def test_an_area_detector_obstructs_with_its_height(gf7: CameraModel) -> None:
    high = gf7.spec.line.model_copy(update={"rows": 20_001})
    area = obstacles(replace(gf7, spec=gf7.spec.model_copy(update={"line": high})))[IMAGE]
    line = obstacles(gf7)[IMAGE]
    assert isinstance(area, Rectangle)
    assert isinstance(line, Rectangle)
    assert area.half_x == line.half_x
    assert area.half_y == pytest.approx(0.5 * 20_001 * gf7.spec.line.pitch + gf7.spec.edge_margin)
    assert line.half_y < 0.5 * area.half_y


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
    away = (found.positions - found.ideal).reshape(-1, 2)
    np.testing.assert_allclose(away.mean(axis=0), 0.0, atol=1e-12)
    # as drawn: a grid whose departures stay within half of its spacing, and the line's in millimetres and micrometres
    left, right, *_ = camera_plots.distortion_figure(SimpleNamespace(distortion=found)).axes
    reach = np.abs(np.concatenate([line.get_xydata() for line in left.lines])).max(axis=0)
    np.testing.assert_allclose(reach, 1e3 * np.abs(found.ideal).max(axis=(0, 1)), rtol=0.3)
    np.testing.assert_allclose(right.lines[0].get_xydata(), np.stack([1e3 * found.position, 1e6 * found.residual], -1))


@pytest.mark.parametrize(
    ("sharp", "words"),
    [(0, "nowhere in"), (1, "in less than 1 % of"), (90, "in 40 % of"), (224, "in more than 99 % of")],
)
def test_a_small_share_of_the_field_is_not_none(gf7_alone, sharp: int, words: str) -> None:
    """One field of 225 is not "0 %", and all but one are not "100 %"."""
    errors = np.where(np.arange(225) < sharp, 0.05, 0.2).reshape(25, 9)
    run = SimpleNamespace(
        errors=errors, worst=(0.2, (1.0, 0.0)), camera=gf7_alone.model.spec, mtfs=(), limits=(("coma", 0.1),)
    )
    assert verdict(run)[0].startswith(f"Diffraction limited {words} the field: ")


def test_kinds_of_aberration() -> None:
    kinds = {4: "defocus", 5: "astigmatism", 6: "astigmatism", 7: "coma", 9: "trefoil", 11: "spherical aberration"}
    kinds |= {13: "secondary astigmatism", 22: "secondary spherical aberration"}
    assert {term: aberration_name(term) for term in kinds} == kinds


@pytest.mark.second
def test_refocusing_finds_a_focal_plane_that_was_moved(backend) -> None:
    """Of a sharp camera 1 mm out of focus, and 5 mrad out of level: back to where its own best focus is."""
    camera = load_camera("gf7")
    own = find_focus(CameraOptics.alone(camera, backend), tilt=True)
    moved = camera.model_copy(
        update={"image": camera.image.model_copy(update={"z": camera.image.z + 1e-3, "tilt": 5e-3})}
    )
    found = find_focus(CameraOptics.alone(moved, backend), tilt=True)
    assert found.after.z == pytest.approx(own.after.z, abs=1e-6)
    assert found.after.tilt == pytest.approx(own.after.tilt, abs=1e-6)
    assert found.errors_before.max() > 0.3 > found.errors_after.max()
    assert {(-x, y) for x, y in FIELDS} == set(FIELDS)  # both sides count alike
    assert len(set(FIELDS)) == len(found.errors_after)
    assert (
        abs(find_focus(CameraOptics.alone(camera, backend), tilt=False).after.z - camera.image.z) < 3e-6
    )  # it was designed so


def test_the_refocused_file_keeps_all_else(backend, tmp_path) -> None:
    file, made = gf7_with(tmp_path, "-2.02 m"), tmp_path / "gf7_refocused.yaml"
    given = load_camera(file)
    plane = find_focus(CameraOptics.alone(given, backend), tilt=False).after
    made.write_text(file_with_plane(given, plane, "gf7_refocused"), "utf-8")
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


def test_a_telescope_on_its_axis_needs_no_field_bias(tmp_path) -> None:
    text = (LIBRARY / "cameras" / "cassegrain.yaml").read_text("utf-8")
    assert "\nfield_bias: 0 deg\n" in text
    (tmp_path / "own.yaml").write_text(text.replace("\nfield_bias: 0 deg\n", "\n"), "utf-8")
    assert load_camera(tmp_path / "own.yaml") == load_camera("cassegrain")


def test_what_it_refuses(tmp_path) -> None:
    for words, message in REFUSED["cameras"]:
        result = invoke(app, *words, "--out", tmp_path / "out")
        assert result.exit_code == 2, words
        assert re.search(message, " ".join(result.stderr.split())), (words, result.stderr)
        assert not (tmp_path / "out").exists(), words


@pytest.mark.second
def test_an_area_detector_has_its_size_and_may_be_larger_than_the_field(tmp_path, backend, monkeypatch) -> None:
    """0.3 deg by 0.04 deg at 5 m are 26 by 3.5 mm, and 2048 pixels of 7 um 14.3 mm."""
    without_mtf_and_many_rays(monkeypatch)
    spec = load_camera("ritchey_chretien")
    data = first_order_data(CameraOptics.alone(spec, backend))
    assert "detector_mm" not in FIRST_ORDER(data)
    area = spec.line.model_copy(update={"pixels": 2048, "rows": 2048})
    told = replace(data, spec=spec.model_copy(update={"line": area}))
    assert FIRST_ORDER(told)["detector_mm"] == pytest.approx([14.336, 14.336])
    assert "14.34 by 14.34 mm, is larger across the line than the image" in detector_beyond_field(told)
    for line in (spec.line, area.model_copy(update={"rows": 498})):  # 3.486 mm: the image of the field
        assert not detector_beyond_field(replace(data, spec=spec.model_copy(update={"line": line})))
    text = (LIBRARY / "cameras" / "ritchey_chretien.yaml").read_text("utf-8")
    (tmp_path / "own.yaml").write_text(text.replace("{pixels: 3700,", "{pixels: 2048, rows: 2048,"), "utf-8")
    report = camera_report(run_camera(resolve_camera(tmp_path / "own.yaml"), backend))
    assert ("detector", "2048 × 2048 pixels, 14.34 × 14.34 mm") in report.summary.rows
    blocked = float(dict(report.summary.rows)["light blocked by edges"].split()[0])
    vanes = 4 * 4e-3 * (0.25 - 0.0875)  # four of 4 mm from the shadow to the rim
    assert blocked == pytest.approx(100.0 * (np.pi * 0.0875**2 + vanes) / (np.pi * 0.25**2), abs=0.03)
    assert any("is larger across the line" in text for text in report.lead)


@pytest.mark.second
def test_a_camera_without_a_focus_cannot_be_refocused(tmp_path, backend) -> None:
    file = gf7_with(tmp_path, "-2.70 m", focal_length="21.4 m")
    result = invoke(app, file, "--refocus", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert re.search(r"gf7_moved.yaml:\d+: mirrors: refocusing is not possible", "".join(result.stderr.split("\n")))
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="no focus after M3"):
        run_camera(resolve_camera(Path(file)), backend, refocus=True)


PERTURBED = ("M2 shift z 30 um", "M2 rotate x 3 arcsec")


@pytest.mark.second
@pytest.mark.parametrize(
    ("camera", "words", "tilt"),
    [
        ("gf7", PERTURBED, False),
        ("gf7", (*PERTURBED, "focal_plane rotate x 10 arcsec", "focal_plane shift z 5 um"), True),
        ("gf7_pair", ("forward/M2 shift z 30 um", "base temperature 2 K"), False),
        ("cassegrain", ("focal_plane shift z 400 um",), False),  # its light comes from the other side
    ],
)
def test_the_printed_motion_refocuses(backend, monkeypatch, camera: str, words: tuple[str, ...], tilt: bool) -> None:
    """Its text, given as a perturbation in place of the focal plane's own one, is the camera that was analysed.

    The text has five digits of a shift of some 50 um, 0.5 nm: far below 1e-5 waves.
    """
    without_mtf_and_many_rays(monkeypatch)
    setup = resolve_camera(camera, "forward" if camera == "gf7_pair" else None)
    found = run_camera(setup.perturbed(words), backend, refocus=True, tilt=tilt)
    moved = found.refocus.words
    assert all("focal_plane" in text for text in moved)
    assert found.refocus.moved == any("focal_plane" in text for text in words)
    others = tuple(text for text in words if "focal_plane" not in text)
    pasted = run_camera(setup.perturbed((*others, *moved)), backend)
    assert pasted.errors == pytest.approx(found.errors, abs=1e-5)
    assert found.refocus.errors_before.max() > 1.2 * found.refocus.errors_after.max()
    assert perturbed_text(found).startswith("Perturbed and refocused: ")
    assert pasted.perturbed.change.vector == pytest.approx(found.perturbed.change.vector, abs=1e-8)
    text = refocus_text(found)
    assert f"(+z points toward the scene, here {'against' if camera == 'cassegrain' else 'along'} the light)" in text
    assert ("in place of the focal plane's own perturbation" in text) == found.refocus.moved


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


# --- the command that optimises a camera: the camera of the library, made again ---------------------------------------


EXAMPLE = EXAMPLES / "design_gf7_short.yaml"


def run(tmp_path: Path, envelope: str, camera: str = "gf7", vary: str = ""):
    file = tmp_path / "small.yaml"
    file.write_text(TEXTS["short"].format(envelope=envelope, vary=vary).replace("gf7", camera), "utf-8")
    return CliRunner().invoke(design_app, [str(file), "--out", str(tmp_path / "out"), "--quiet"])


@pytest.mark.parametrize(
    ("envelope", "clearance", "key", "remedy"),
    [
        ("1 percent", "20 mm", "envelope", "a larger envelope"),
        ("79.8 percent", "20 m", "clearance", "a smaller clearance"),
    ],
)
def test_constraints_that_contradict_the_camera(tmp_path, envelope: str, clearance: str, key: str, remedy: str) -> None:
    """An envelope of 22 mm, a clearance of 20 m: told with the key that asks too much, whatever is lost on the way."""
    changes = ("79.8 percent", envelope), ("20 mm", clearance), ("steps: 8", "steps: 1"), ("starts: 6", "starts: 1")
    file = edited_copy(EXAMPLE, tmp_path, *changes)
    refused(
        lambda _, *words: invoke(design_app, *words),
        "",
        file,
        key,
        ("no prescription near the start fulfils all constraints", remedy),
    )


def test_a_camera_without_light_is_no_start(tmp_path, backend) -> None:
    """The beam passes beside a ball of 50 mm in place of its secondary: told with the camera's file and mirrors."""
    text = good("cassegrain out of focus").replace("radius: -0.8 m, conic: -2.77777777777778", "radius: -50 mm")
    (tmp_path / "axis.yaml").write_text(text, "utf-8")
    file, text = tmp_path / "away.yaml", TEXTS["short"].format(envelope="101 percent", vary="M2: [conic]")
    file.write_text(text.replace("camera: gf7", "camera: axis.yaml"), "utf-8")
    with pytest.raises(InputError, match=r"axis\.yaml:\d+: mirrors: the beams of the design do not pass the camera"):
        run_design(CameraDesignSetup.read(file), backend)


@pytest.mark.second
def test_a_telescope_about_its_axis_is_told_its_clearance(tmp_path) -> None:
    """Its beam passes through its secondary, and the message names the clearance with which it can be designed."""
    (tmp_path / "axis.yaml").write_text(good("cassegrain out of focus"), "utf-8")
    file, text = tmp_path / "on_axis.yaml", TEXTS["short"].format(envelope="101 percent", vary="M2: [conic]")
    file.write_text(text.replace("camera: gf7", "camera: axis.yaml"), "utf-8")
    refused = CliRunner().invoke(design_app, [str(file), "--out", str(tmp_path / "out"), "--quiet"])
    assert refused.exit_code == 2
    told = re.search(r"clearance: -(\d+) mm, as \w+ obscures its own beams", refused.output.replace("\n", " "))
    assert told is not None, refused.output
    # by hand: the beam reaches across the whole primary of 0.25 m, M2 as far to the other side, 77 mm and its edge
    assert 0.25 + 0.06 < 1e-3 * int(told[1]) < 0.25 + 0.1
    file.write_text(file.read_text("utf-8") + f"clearance: -{told[1]} mm\n", "utf-8")
    result = CliRunner().invoke(design_app, [str(file), "--out", str(tmp_path / "out"), "--quiet"])
    assert result.exit_code == 0, result.output


@pytest.mark.second
def test_a_run_folder(tmp_path) -> None:
    """A conic and the focus: nothing gets shorter, and little better; but the camera's file can be read."""
    result = run(tmp_path, "101 percent", vary="M3: [conic]")
    assert result.exit_code == 0, result.output
    out = tmp_path / "out"
    camera = validate(CameraSpec, read_yaml(out / "artefacts" / "small.yaml"))
    gf7 = load_camera("gf7")
    assert camera.name == "small"
    assert 0.0 < abs(camera.image.z - gf7.image.z) < 1e-3
    assert camera.bands == gf7.bands
    assert CameraDesignSetup.read(out / "config.yaml").camera == gf7
    told = json.loads((out / "design.json").read_text("utf-8"))
    assert told["improved"]  # by 0.1 %
    assert told["local_optimum"]


@pytest.mark.second
def test_what_a_report_says_makes_it_again_does(tmp_path, monkeypatch) -> None:
    assert run(tmp_path, "101 percent", vary="M3: [conic]").exit_code == 0
    out = tmp_path / "out"
    page = (out / "report.html").read_text("utf-8")
    command = re.search(r"<pre>(python -m twin.design .*)</pre>", page)[1].split()
    monkeypatch.chdir(out)
    result = CliRunner().invoke(design_app, command[3:])
    assert result.exit_code == 0, result.output
    assert (out / "again" / "design.json").read_bytes() == (out / "design.json").read_bytes()


def test_a_journal_that_cannot_be_kept_is_reported(tmp_path) -> None:
    with pytest.raises(RunFolderError, match="Is a directory"), journal_of(tmp_path, "design"):
        pass
    beam = Beam(*np.ones(9))
    with journal_of(tmp_path / "journal", "design") as journal:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))  # as on a full disk
        try:
            with pytest.raises(RunFolderError, match="the finished work in it is kept, continue with --resume"):
                journal.keep({repr(beam): BeamFacts(beam)})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.second
def test_a_constraint_that_blocks_is_named(tmp_path) -> None:
    """A focal plane 5 mm off its place cannot be moved: the principal distance, which is to stay, would change."""
    gf7 = (LIBRARY / "cameras" / "gf7.yaml").read_text("utf-8")
    z = load_camera("gf7").image.z
    (tmp_path / "off.yaml").write_text(gf7.replace(f"z: {z} m", f"z: {z + 5e-3} m"), "utf-8")
    result = run(tmp_path, "101 percent", camera="./off.yaml")
    assert result.exit_code == 0, result.output
    told = json.loads((tmp_path / "out" / "design.json").read_text("utf-8"))
    assert not told["improved"]
    (held,) = told["active_constraints"]
    assert held["constraint"] == "principal distance"
    assert held["broken_at_start_m"] == 0.0
    # dz / (2 F)^2 / (4 sqrt 3) at F/9.32; a millimetre of focus goes with some micrometres of principal distance
    off = np.sqrt(np.mean(np.square(told["wfe_rms_waves"]["before"])))
    assert off == pytest.approx(5e-3 / 18.64**2 / (4 * np.sqrt(3)) / 650e-9, rel=0.02)
    assert held["sensitivity_waves_per_mm"] > off
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    limited = r"Not improved, limited by the principal distance \(5.5\d* m; easing it by 1 mm reduces the error by"
    assert re.search(limited, page)
    assert "is blurred" in page


def test_an_anamorphism_is_a_share(backend) -> None:
    """Of a principal distance of 5 m across the line one of 0.05 m along it less or more is 1 %."""
    one = ActiveConstraint("anamorphism", 0.005, 0.05, 0.4)
    text = _held_text((one,), "old", 5.0)
    assert text == "the anamorphism (0.5 %, violated by old by 1 %; easing it by 1 % reduces the error by 0.02 waves)"
    row = ACTIVE_CONSTRAINT(one)
    assert (row["limit_m"], row["limit_percent"]) == (None, pytest.approx(0.5))
    assert ACTIVE_CONSTRAINT(replace(one, name="envelope", limit=2.0))["limit_m"] == 2.0
    camera = load_camera("gf7")
    merit, found = initial_merit(
        backend, prescription_of(camera), (), beams_of(camera), Operands(650e-9, anamorphism=0.005)
    )
    along, across = found.principal_distance, found.distance_across
    with pytest.raises(DesignError, match=r"anamorphism \(off by ") as refused:
        _require_fulfilled(merit, found)
    off = float(re.search(r"off by (\S+) %", str(refused.value))[1])
    assert off == pytest.approx(100.0 * (abs(along / across - 1.0) - 0.005), rel=2e-3)


@pytest.mark.second
def test_what_a_constraint_is_worth(tmp_path) -> None:
    """The clearance eased by 0.1 mm: the error falls by what its multiplier says, to the next order."""
    found = []
    for clearance in ("306 mm", "305.9 mm"):
        file = tmp_path / "held.yaml"
        file.write_text(TEXTS["held_back"].format(clearance=clearance), "utf-8")
        out = tmp_path / clearance.split()[0]
        result = CliRunner().invoke(design_app, [str(file), "--out", str(out), "--quiet"])
        assert result.exit_code == 0, result.output
        found.append(json.loads((out / "design.json").read_text("utf-8")))
    errors = [np.sqrt(np.mean(np.square(told["wfe_rms_waves"]["after"]))) for told in found]
    first, *_ = found[0]["active_constraints"]
    assert first["constraint"] == "clearance of the beams from scene to M1 beside M2"
    assert first["broken_at_start_m"] == pytest.approx(2.75e-3, abs=0.01e-3)
    assert errors[0] - errors[1] == pytest.approx(0.1 * first["sensitivity_waves_per_mm"], rel=0.1)
    assert errors[1] > errors[0] / 2


@pytest.mark.parametrize(("old", "new", "message"), refusals("design"))
def test_what_is_wrong_with_a_file(tmp_path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        CameraDesignSetup.read(edited_copy(EXAMPLE, tmp_path, (old, new)))


def test_directions_are_tangential_and_sagittal_only_about_an_axis() -> None:
    """On the axis of a centred camera, T and S are along the line and the track; a field about square is drawn so."""
    for on_axis, first in ((True, "along the line (T, tangential)"), (False, "along the line")):
        axis = SimpleNamespace(on_axis=on_axis)
        run = SimpleNamespace(optics=SimpleNamespace(model=SimpleNamespace(axis=axis)))
        assert camera_plots._directions(run)[0] == first
    figure = Figure()
    square, strip = figure.subplots(1, 2)
    camera_plots._same_scale(square, np.array([-1.0, 1.0]), np.array([-0.9, 0.9]))
    camera_plots._same_scale(strip, np.array([-1.0, 1.0]), np.array([-0.1, 0.1]))
    assert (square.get_aspect(), strip.get_aspect()) == (1.0, "auto")
