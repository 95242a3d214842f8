"""Files that twin.new writes: every kind for every telescope is read by its command, and runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from optics.camera.telescope_types import TELESCOPES
from scenes.lens.prescription import MARGIN, first_camera
from scenes.models.camera_model import derive_camera
from scenes.models.camera_sharpness import blur_warnings
from scenes.models.instrument_builder import build_instrument
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.specs.load import load_camera
from scenes.specs.operation import read_operation
from scenes.specs.resolved import resolve, resolve_with
from scenes.specs.tolerance import ToleranceSetup
from scenes.yaml.units import LENGTH, parse_quantity
from scenes.yaml.yaml_file import read_yaml
from tests.tiers import quick
from tests.twin.commands import invoke
from tests.twin.study_bench import ROOT
from twin.asbuilt.__main__ import app as asbuilt_app
from twin.camera.first_order_data import obscuration
from twin.framework.console import parser
from twin.new import __main__ as program
from twin.new.camera_numbers import CameraNumbers, numbers_of
from twin.operate.__main__ import app as operate_app
from twin.render import app as render_app
from twin.show import app as show_app
from twin.study.__main__ import app as study_app
from twin.tolerance.__main__ import app as tolerance_app

KINDS = tuple(program.NEW)
NO_MONITOR = "a monitor needs a camera of mirrors"
SIZES = {"triplet": (0.05, 8.0)}
"""Aperture, metres, and F-number of kinds that are not sharp at 0.4 m and F/8."""


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a camera of every kind, outside of the repository."""
    folder = tmp_path_factory.mktemp("cameras")
    for kind in TELESCOPES:
        text = first_camera(kind, kind, *SIZES.get(kind, (0.4, 8.0)), 650e-9)
        (folder / f"{kind}.yaml").write_text(text, "utf-8")
    return folder


@pytest.mark.parametrize("kind", ["ritchey-chretien", "cassegrain"])
def test_the_primary_of_a_first_design_has_the_hole_that_its_beams_need(kind: str, backend, cameras: Path) -> None:
    spec = load_camera(cameras / f"{kind}.yaml")
    (hole,) = spec.mirrors["M1"].edges or ()
    closed = spec.model_copy(
        update={"mirrors": {**spec.mirrors, "M1": spec.mirrors["M1"].model_copy(update={"edges": None})}}
    )
    needed = obscuration(derive_camera(closed, backend), backend).holes["M1"]
    assert MARGIN * needed == pytest.approx(hole.radius, rel=0.01)  # the beams are traced, the hole is first order
    assert "M1" not in obscuration(derive_camera(spec, backend), backend).holes


def test_files_do_not_repeat_defaults() -> None:
    text = load_camera("ritchey_chretien").file_text("A camera.")
    assert "rows" not in text
    assert "aspheric" not in text
    area = load_camera("ritchey_chretien")
    line = area.line.model_copy(update={"rows": 8})
    assert "rows: 8" in area.model_copy(update={"line": line}).file_text("A camera.")


def new(kind: str, camera: Path | str, out: Path, *more: str):
    return invoke(program.app, kind, "--camera", camera, "--out", out, "--force", *more)


CHECKED = {
    "job": lambda path, backend: _built(resolve(path), backend),
    "tolerance": lambda path, backend: blur_warnings(ToleranceSetup.read(path).base, backend),
    "study": lambda path, backend: _built(resolve(path.with_name(f"{path.stem}_job.yaml")), backend),
    "asbuilt": lambda path, backend: blur_warnings(AsBuiltSetup.read(path).base, backend),
    "instrument": lambda path, backend: _built(resolve_with(path), backend),
    "operation": lambda path, backend: _built(read_operation(path).model, backend),
}
"""Kind -> what reads its file as its command does, builds what it names, and returns warnings."""


def _built(job, backend):
    build_instrument(job.instrument, job.cameras, backend)
    return blur_warnings(job, backend)


@pytest.mark.parametrize("telescope", quick(1, ["ritchey-chretien", "off-axis", "triplet"]))
@pytest.mark.parametrize("kind", KINDS)
def test_a_new_file_is_read_without_a_warning(telescope: str, kind: str, cameras: Path, backend) -> None:
    out = cameras / f"{kind}-{telescope}.yaml"
    done = new(kind, cameras / f"{telescope}.yaml", out)
    if telescope == "triplet" and kind in ("instrument", "operation"):
        assert (done.exit_code, out.exists()) == (2, False)
        assert NO_MONITOR in " ".join(done.stderr.split())
        return
    assert done.exit_code == 0, done.stderr
    assert f"python -m twin.{program.NEW[kind].runs} {out}" in " ".join(done.stdout.split())
    assert tuple(CHECKED[kind](out, backend)) == ()
    shown = invoke(show_app, out, "--json")
    assert json.loads(shown.stdout)["kind"] == kind
    lines = out.read_text("utf-8").splitlines()
    assert sum("#" in line for line in lines) > 0.15 * len(lines)


@pytest.mark.second
@pytest.mark.parametrize("telescope", ["korsch", "triplet"])
def test_a_new_budget_runs(telescope: str, cameras: Path, tmp_path: Path) -> None:
    """The requirement of a budget leaves room for the design, and the range of the compensator for its limits."""
    camera = cameras / f"{telescope}.yaml"
    budget = tmp_path / "budget.yaml"
    assert new("tolerance", camera, budget, "--samples", "20").exit_code == 0
    done = invoke(tolerance_app, budget, "--out", tmp_path / "tolerance", "--workers", "1", "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    # at an optimum slopes vanish; the process of the tests may be large
    assert not [text for text in found["warnings"] if "linear model" not in text and "processes need" not in text]


@pytest.mark.second
def test_a_new_study_runs(cameras: Path, tmp_path: Path) -> None:
    study = tmp_path / "study.yaml"
    assert new("study", cameras / "triplet.yaml", study, "--runs", "4").exit_code == 0
    done = invoke(study_app, study, "--out", tmp_path / "study", "--workers", "1", "--json")
    assert done.exit_code == 0, done.stderr
    assert "failed" in done.stdout


@pytest.mark.second
def test_a_study_judges_the_wavefront_error_that_its_comment_gives(cameras: Path, tmp_path: Path) -> None:
    """The worst field: 0.0094 waves by few rays, 0.0092 by the main job on its line; the mean is 0.0055."""
    out = tmp_path / "study.yaml"
    assert new("study", cameras / "ritchey-chretien.yaml", out).exit_code == 0
    study = read_yaml(out).data
    key, threshold = study["responses"]["wavefront"]["key"], study["report"]["thresholds"]["sharp"]
    folder = tmp_path / "job"
    assert invoke(render_app, tmp_path / "study_job.yaml", "--out", folder).exit_code == 0
    found = json.loads((folder / f"{key[0]}.json").read_text("utf-8"))
    for name in key[1:]:
        found = found[name]
    comment = float(out.read_text("utf-8").rsplit("the design has ", 1)[1].split()[0])
    assert found == pytest.approx(comment, rel=0.05)
    assert threshold["response"] == "wavefront"


@pytest.mark.second
def test_measurements_and_a_plan_run(cameras: Path, tmp_path: Path) -> None:
    """The telemetry of a simulated life names the whole instrument, so that it can be ingested again."""
    camera = cameras / "ritchey-chretien.yaml"
    built, plan = tmp_path / "built.yaml", tmp_path / "plan.yaml"
    assert new("asbuilt", camera, built).exit_code == 0
    done = invoke(asbuilt_app, "estimate", built, "--out", tmp_path / "built", "--json")
    assert done.exit_code == 0, done.stderr
    assert new("operation", camera, plan).exit_code == 0
    life = tmp_path / "life"
    when = ("--from", "2027-01-01T00:00:00Z", "--days", "4", "--every", "2d")
    assert invoke(operate_app, "simulate", plan, life, *when).exit_code == 0
    again = invoke(operate_app, "ingest", life, life / "simulated" / "telemetry.yaml")
    assert again.exit_code == 0, again.stderr
    assert invoke(operate_app, "status", life).exit_code == 0


def numbers(name: str, folder: Path) -> CameraNumbers:
    return numbers_of(str(folder / f"{name}.yaml"), folder)


def test_numbers_follow_from_first_order_optics(cameras: Path) -> None:
    """Schroeder, Astronomical Optics: M2 moves the focus by m^2 + 1 of its despace, M1's focal length by m^2."""
    n = numbers("ritchey-chretien", cameras)
    m = 8.0 / (8.0 / 3.0)
    assert n._defocus(n.moved[0], 1e-6) == pytest.approx(1e-6 * (m**2 + 1.0), rel=1e-4)
    assert n._image({}, {"M1": 1e-6}) - n._image({}) == pytest.approx(m**2 * 1e-6 * 0.4 * 8.0 / 3.0, rel=1e-4)
    assert n.focus_sigma == "21 um"  # a quarter of 2 lambda F^2
    assert n.requirement == "0.0714"
    assert not n.upright
    assert numbers("korsch", cameras).upright
    limits = n._all_defocus("10 um")
    assert parse_quantity(n.focus_range("focal_plane", "10 um"), LENGTH) == pytest.approx(2.0 * limits, rel=0.05)
    through_m2 = parse_quantity(n.focus_range("M2", "10 um"), LENGTH)
    assert through_m2 == pytest.approx(2.0 * limits / (m**2 + 1.0), rel=0.05)


def test_the_paraxial_focus_of_a_triplet_is_that_of_its_file(cameras: Path) -> None:
    """The image plane is at the best focus, within the depth of focus of the paraxial one; a lens is two bodies."""
    n = numbers("triplet", cameras)
    assert n._image({}) == pytest.approx(n.camera.image.z, abs=n._depth)
    assert [(one.label, one.bodies) for one in n.elements] == [
        (f"L{k}", (f"L{k}_front", f"L{k}_back")) for k in (1, 2, 3)
    ]


def test_a_design_without_margin_gets_a_requirement_that_it_can_meet(cameras: Path, tmp_path: Path) -> None:
    text = (cameras / "ritchey-chretien.yaml").read_text("utf-8").replace("image: {z: 200 mm}", "image: {z: 200.15 mm}")
    (tmp_path / "ritchey-chretien.yaml").write_text(text, "utf-8")
    n = numbers("ritchey-chretien", tmp_path)
    assert float(n.requirement) ** 2 == pytest.approx(0.0714**2 + n.worst**2, rel=0.02)


def test_without_a_file_it_prints_and_asks_in_a_terminal_only(cameras: Path, monkeypatch) -> None:
    camera = cameras / "cassegrain.yaml"
    printed = invoke(program.app, "tolerance", "--camera", camera).stdout
    assert "limit: 10 um" in printed
    monkeypatch.setattr(program, "_is_terminal", lambda: True)
    asked = invoke(program.app, "tolerance", "--tilt", "7 arcsec", input=f"{camera}\n3 um\n\n\n\n\n\n")
    assert asked.exit_code == 0, asked.stderr
    assert "Limit of decentres and despaces of mirrors and lenses [10 um]:" in asked.stderr
    assert "tilts [" not in asked.stderr
    assert "limit: 3 um" in asked.stdout
    assert "limit: 7 arcsec" in asked.stdout


def test_an_answer_that_is_not_allowed_is_asked_for_again(cameras: Path, tmp_path: Path, monkeypatch) -> None:
    """Good answers stay; what is wrong is said below its question; the file is the last question."""
    monkeypatch.setattr(program, "_is_terminal", lambda: True)
    camera, out = cameras / "cassegrain.yaml", tmp_path / "new.yaml"
    words = ["gf8", camera, "3 um", "5 apples", "4 arcsec", "", "", "M7", "M2", "many", "30", "new.txt", out]
    asked = invoke(program.app, "tolerance", input="".join(f"{word}\n" for word in words))
    assert asked.exit_code == 0, asked.stderr
    said = asked.stderr
    assert said.count("Error: ") == 5
    for question, problem in (
        ("Camera or instrument", "did you mean 'gf7'?"),
        ("Limit of their tilts", "unknown unit 'apples'"),
        ("Body that is refocused", "allowed: focal_plane, M1, M2"),
        ("Number of cameras", "found 'many'"),
        (program._FILE, "allowed: .yaml, .yml"),
    ):
        wrong, right = said.split(question)[1:]
        assert problem in wrong
        assert "Error" not in right.split("]:")[0]
    text = out.read_text("utf-8")
    assert all(part in text for part in ("limit: 3 um", "limit: 4 arcsec", "M2 shift z, range", "samples: 30"))


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["job"], "which camera is it for?"),
        (["job", "--camera", "gf8"], "did you mean 'gf7'?"),
        (["job", "--camera", "gf7", "--out", "job.txt"], "unknown suffix of an output file"),
        (["job", "--camera", "gf7", "--out", "no_such_folder/job.yaml"], "there is no such folder"),
        (["tolerance", "--camera", "gf7", "--decentre", "10 apples"], "--decentre: unknown unit 'apples'"),
        (["study", "--camera", "gf7", "--tilt", "five"], "--tilt: not a quantity with its unit"),
        (
            ["tolerance", "--camera", "gf7", "--compensator", "M7"],
            "--compensator: there is no such body; found M7, allowed: focal_plane, M1, M2, M3",
        ),
        (["tolerance", "--camera", "gf7", "--samples", "many"], "--samples: "),
        (["instrument", "--camera", "gf7_pair"], "a new monitor is for a camera"),
    ],
)
def test_what_cannot_be_is_refused(words: list[str], problem: str) -> None:
    done = invoke(program.app, *words)
    assert (done.exit_code, done.stdout) == (2, "")
    assert problem in " ".join(done.stderr.split())


def test_a_file_is_kept_and_other_words_of_a_path_are_quoted(cameras: Path, tmp_path: Path) -> None:
    odd = tmp_path / "my: camera #1.yaml"
    odd.write_bytes((cameras / "cassegrain.yaml").read_bytes())
    out = tmp_path / "job.yaml"
    assert invoke(program.app, "job", "--camera", odd, "--out", out).exit_code == 0
    assert resolve(out).instrument.name == "cassegrain"
    again = invoke(program.app, "job", "--camera", odd, "--out", out)
    assert (again.exit_code, "the file exists" in again.stderr) == (2, True)


def test_pages_list_every_kind() -> None:
    page, commands = ((ROOT / "docs" / name).read_text("utf-8") for name in ("camera.md", "commands.md"))
    assert [kind for kind in TELESCOPES if f"`{kind}`" not in page] == []
    assert [kind for kind in KINDS if kind not in commands] == []
    assert set(KINDS) | {"camera"} == set(parser("twin.new").commands)
