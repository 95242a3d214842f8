"""The command that optimises a camera: errors told by line; the camera of the library, made again."""

import json
import re
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from optics.design.merit_function import Operands
from optics.design.optimiser import DesignError, Held, _require_held, judged
from scenes.models.camera_design import CameraDesignSetup, beams_of, prescription_of
from scenes.models.monitor_layout import Beam
from scenes.specs.camera import CameraSpec
from scenes.specs.load import EXAMPLES, LIBRARY, load_camera
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import read_yaml
from tests.scenes.refusals.tables import good
from tests.twin.commands import edited_copy, invoke, refused
from tests.twin.study_bench import TEXTS, refusals
from twin.design.__main__ import app
from twin.design.design_run import HELD_BY, _held_text, run_design
from twin.design.layout_bench import BeamFacts
from twin.design.layout_search import journal_of
from twin.framework.run_folder import RunFolderError

EXAMPLE = EXAMPLES / "design_gf7_short.yaml"


def run(tmp_path: Path, envelope: str, camera: str = "gf7", vary: str = ""):
    file = tmp_path / "small.yaml"
    file.write_text(TEXTS["short"].format(envelope=envelope, vary=vary).replace("gf7", camera), "utf-8")
    return CliRunner().invoke(app, [str(file), "--out", str(tmp_path / "out"), "--quiet"])


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
        lambda _, *words: invoke(app, *words),
        "",
        file,
        key,
        ("no prescription near the start holds all constraints", remedy),
    )


def test_a_camera_without_light_is_no_start(tmp_path, backend) -> None:
    """The beam passes beside a ball of 50 mm in place of its secondary: told with the camera's file and mirrors."""
    text = good("cassegrain out of focus").replace("radius: -0.8 m, conic: -2.77777777777778", "radius: -50 mm")
    (tmp_path / "axis.yaml").write_text(text, "utf-8")
    file, text = tmp_path / "away.yaml", TEXTS["short"].format(envelope="101 percent", vary="M2: [conic]")
    file.write_text(text.replace("camera: gf7", "camera: axis.yaml"), "utf-8")
    with pytest.raises(InputError, match=r"axis\.yaml:\d+: mirrors: no beams to design with come through"):
        run_design(CameraDesignSetup.read(file), backend)


@pytest.mark.second
def test_a_telescope_about_its_axis_is_told_its_clearance(tmp_path) -> None:
    """Its beam passes through its secondary, and the message names the clearance with which it can be designed."""
    (tmp_path / "axis.yaml").write_text(good("cassegrain out of focus"), "utf-8")
    file, text = tmp_path / "on_axis.yaml", TEXTS["short"].format(envelope="101 percent", vary="M2: [conic]")
    file.write_text(text.replace("camera: gf7", "camera: axis.yaml"), "utf-8")
    refused = CliRunner().invoke(app, [str(file), "--out", str(tmp_path / "out"), "--quiet"])
    assert refused.exit_code == 2
    told = re.search(r"clearance: -(\d+) mm, as \w+ obscures its own beams", refused.output.replace("\n", " "))
    assert told is not None, refused.output
    # by hand: the beam reaches across the whole primary of 0.25 m, M2 as far to the other side, 77 mm and its edge
    assert 0.25 + 0.06 < 1e-3 * int(told[1]) < 0.25 + 0.1
    file.write_text(file.read_text("utf-8") + f"clearance: -{told[1]} mm\n", "utf-8")
    result = CliRunner().invoke(app, [str(file), "--out", str(tmp_path / "out"), "--quiet"])
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
    result = CliRunner().invoke(app, command[3:])
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
            with pytest.raises(RunFolderError, match="what it holds is kept, go on with --resume"):
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
    (held,) = told["held_by"]
    assert held["constraint"] == "principal distance"
    assert held["broken_at_start_m"] == 0.0
    # dz / (2 F)^2 / (4 sqrt 3) at F/9.32; a millimetre of focus goes with some micrometres of principal distance
    off = np.sqrt(np.mean(np.square(told["wfe_rms_waves"]["before"])))
    assert off == pytest.approx(5e-3 / 18.64**2 / (4 * np.sqrt(3)) / 650e-9, rel=0.02)
    assert held["worth_waves_per_mm"] > off
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert re.search(r"Not improved, held by the principal distance \(5.5\d* m; easing it by 1 mm is worth", page)
    assert "is blurred" in page


def test_an_anamorphism_is_a_share(backend) -> None:
    """Of a principal distance of 5 m across the line one of 0.05 m along it less or more is 1 %."""
    one = Held("anamorphism", 0.005, 0.05, 0.4)
    text = _held_text((one,), "old", 5.0)
    assert text == "the anamorphism (0.5 %, which old breaks by 1 %; easing it by 1 % is worth 0.02 waves)"
    row = HELD_BY(one)
    assert (row["limit_m"], row["limit_percent"]) == (None, pytest.approx(0.5))
    assert HELD_BY(replace(one, name="envelope", limit=2.0))["limit_m"] == 2.0
    camera = load_camera("gf7")
    merit, found = judged(backend, prescription_of(camera), (), beams_of(camera), Operands(650e-9, anamorphism=0.005))
    along, across = found.principal_distance, found.distance_across
    with pytest.raises(DesignError, match=r"anamorphism \(off by ") as refused:
        _require_held(merit, found)
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
        result = CliRunner().invoke(app, [str(file), "--out", str(out), "--quiet"])
        assert result.exit_code == 0, result.output
        found.append(json.loads((out / "design.json").read_text("utf-8")))
    errors = [np.sqrt(np.mean(np.square(told["wfe_rms_waves"]["after"]))) for told in found]
    first, *_ = found[0]["held_by"]
    assert first["constraint"] == "clearance of the beams from scene to M1 beside M2"
    assert first["broken_at_start_m"] == pytest.approx(2.75e-3, abs=0.01e-3)
    assert errors[0] - errors[1] == pytest.approx(0.1 * first["worth_waves_per_mm"], rel=0.1)
    assert errors[1] > errors[0] / 2


@pytest.mark.parametrize(("old", "new", "message"), refusals("design"))
def test_what_is_wrong_with_a_file(tmp_path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        CameraDesignSetup.read(edited_copy(EXAMPLE, tmp_path, (old, new)))
