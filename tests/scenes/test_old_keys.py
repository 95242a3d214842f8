"""Old names of keys: read with a note where they stand, and never beside the new one."""

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import pytest

from docs.renamed import PAGE, page
from scenes.kinds.file_kinds import FILE_KINDS
from scenes.specs.load import LIBRARY, PAYLOADS, SCENES
from scenes.specs.measured.monitor_frames import GeometrySpec
from scenes.specs.orbit.angle import LINES, three_lines, usual_angles
from scenes.specs.orbit.setup import resolve_calibration
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.result_names import RENAMED, by_new_names, key_now
from scenes.specs.study import ResponseSpec
from scenes.yaml import old_keys
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.errors import InputError
from scenes.yaml.old_keys import OldKeys
from scenes.yaml.spec import Spec, validate
from scenes.yaml.units import LENGTH
from scenes.yaml.yaml_file import parse_yaml

PAYLOAD = """\
name: small
pixels: 1000
pitch: 7 um
lines:
  nadir:
    look: 0 deg
    focal_length: 650 mm
  forward: {look: 25 deg, principal_distance: 600 mm}
"""


@pytest.fixture(autouse=True)
def _nothing_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(old_keys, "_TOLD", set())


def every_spec(of: type[Spec] = Spec) -> Iterator[type[Spec]]:
    for one in of.__subclasses__():
        yield one
        yield from every_spec(one)


def test_an_old_key_is_read_with_a_note(capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        camera = validate(ThreeLineCameraSpec, parse_yaml(PAYLOAD, "small.yaml"))
        assert camera.lines["nadir"].principal_distance == 0.65
        assert camera.lines["nadir"].source.line(("principal_distance",)) == 7
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.splitlines() == [
        "note: small.yaml:7: lines.nadir.focal_length: is called 'principal_distance' now; "
        "the old name is read for one version"
    ]


def test_what_is_wrong_under_an_old_key_is_told_with_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError) as caught:
        validate(ThreeLineCameraSpec, parse_yaml(PAYLOAD.replace("650 mm", "650"), "small.yaml"))
    assert (caught.value.line, caught.value.key) == (7, ("lines", "nadir", "principal_distance"))
    assert "focal_length" in capsys.readouterr().err


def test_both_names_are_refused() -> None:
    both = PAYLOAD.replace("    focal_length: 650 mm\n", "    focal_length: 650 mm\n    principal_distance: 650 mm\n")
    with pytest.raises(InputError, match="'focal_length' is the old name of 'principal_distance'") as caught:
        validate(ThreeLineCameraSpec, parse_yaml(both, "small.yaml"))
    assert caught.value.line == 7


def test_several_old_keys_in_one_mapping(capsys: pytest.CaptureFixture[str]) -> None:
    text = "focal_length: 5.5 m\nseparation: 0.24 m\npixel: 12 um\n"
    found = validate(GeometrySpec, parse_yaml(text, "g.yaml"))
    assert (found.principal_distance, found.pitch) == (5.5, 12e-6)
    assert capsys.readouterr().err.count("note: g.yaml:") == 2


def test_new_names_are_keys_and_old_ones_are_not() -> None:
    assert all(issubclass(kind.model, Spec) for kind in FILE_KINDS)  # which imports them
    found = [spec for spec in every_spec() if spec.old_keys and spec.__module__.startswith("scenes.")]
    assert len(found) >= 10
    for spec in found:
        for old, new in spec.old_keys.items():
            assert new in spec.model_fields, (spec, new)
            assert old not in spec.model_fields, (spec, old)


def test_names_of_one_mapping_may_change_within_another(capsys: pytest.CaptureFixture[str]) -> None:
    class Inner(Spec):
        old_keys: ClassVar[OldKeys] = {"b": "y"}
        y: float

    class Outer(Spec):
        old_keys: ClassVar[OldKeys] = {"a": "x"}
        x: tuple[Inner, ...]

    found = validate(Outer, parse_yaml("a:\n  - y: 1.0\n  - b: 2.0\n", "o.yaml"))
    assert [one.y for one in found.x] == [1.0, 2.0]
    assert found.x[1].source.line(("y",)) == 3
    assert [line.partition(": is")[0] for line in capsys.readouterr().err.splitlines()] == [
        "note: o.yaml:1: a",
        "note: o.yaml:3: a[1].b",
    ]


def test_results_by_the_names_of_now() -> None:
    old = {
        "schema": "monitor 3",
        "metres_per_arcsec": 3.9,
        "propagation": {"height_sigma_m": [1.0], "height_total_sigma_m": [2.0], "sigma_m": 3.0},
        "smoothing": {"height_sigma_m": [4.0], "intervals": [{"height_sigma_rms_m": 5.0}]},
    }
    assert by_new_names(old) == {
        "schema": "monitor 3",
        "height_m_per_arcsec": 3.9,
        "propagation": {"height_m_sigma_noise": [1.0], "height_m_sigma": [2.0], "sigma_m": 3.0},
        "smoothing": {"height_m_sigma": [4.0], "intervals": [{"height_sigma_rms_m": 5.0}]},
    }
    assert by_new_names({"focal_length_m": 1.0}, "optics.json") == {"focal_length_m": 1.0}
    assert by_new_names({"focal_length_m": 1.0}, "camera.json") == {"principal_distance_m": 1.0}
    assert by_new_names([{"beta_sigma_arcsec": 1.0}]) == [{"beta_arcsec_sigma": 1.0}]


def test_new_names_stay() -> None:
    """Otherwise a file of now would be read as another one."""
    for one in RENAMED:
        for file in one.files or ("",):
            *above, _ = one.old.split(".")
            tree: dict[str, object] = {one.new.replace("*", "alpha"): 1.0}
            for key in reversed(above):
                tree = {key: tree}
            assert by_new_names(tree, file) == tree, one


def test_a_study_may_ask_for_an_old_key(capsys: pytest.CaptureFixture[str]) -> None:
    text = "key: [monitor, metres_per_arcsec]\n"
    found = validate(ResponseSpec, parse_yaml(text, "study.yaml"))
    assert found.key == ("monitor", "height_m_per_arcsec")
    assert found.units == "m/arcsec"
    assert "note: study.yaml:1: key: is called 'height_m_per_arcsec' now" in capsys.readouterr().err
    assert key_now(("truth", "cameras", 0, "d_f_um")) == ("truth", "cameras", 0, "d_f_um")


def test_a_payload_with_an_old_line_is_one_of_three_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its line keeps the name that the user's files and tables have for it."""
    text = (LIBRARY / PAYLOADS / "th1.yaml").read_text("utf-8")
    (tmp_path / "own.yaml").write_text(text.replace("  backward:", "  aft:"), "utf-8")
    test = (SCENES / "orbit/calibrate.yaml").read_text("utf-8").replace("camera: th1", "camera: own.yaml")
    (tmp_path / "calibrate.yaml").write_text(test.replace("  backward:", "  aft:"), "utf-8")
    setup = resolve_calibration(tmp_path / "calibrate.yaml")
    assert three_lines(setup.camera.lines) == ("forward", "nadir", "aft")
    assert "own.yaml:22: lines.aft: is called 'backward' now" in capsys.readouterr().err
    assert usual_angles(("forward", "nadir", "aft")) == {"alpha": ("forward", "nadir"), "beta": ("nadir", "aft")}
    assert three_lines(("forward", "nadir", "backward", "aft")) == LINES
    (tmp_path / "calibrate.yaml").write_text(test, "utf-8")
    with pytest.raises(InputError, match=r"perturb.backward: no such line.*forward, nadir, aft"):
        resolve_calibration(tmp_path / "calibrate.yaml")


def test_an_old_head_of_a_table_is_read_with_a_note(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = (Column("line_sigma", old="sigma_line"), Column("x_sigma", LENGTH, needed=False, old="sigma_x"))
    path = tmp_path / "points.csv"
    path.write_text("sigma_line,sigma_x [mm]\n0.5,2\n", "utf-8")
    table = read_table(path, columns)
    assert (table["line_sigma"][0], table["x_sigma"][0]) == (0.5, 2e-3)
    assert table.heads["x_sigma"] == "sigma_x [mm]"
    told = capsys.readouterr().err
    assert f"note: {path}:1: sigma_line: is called 'line_sigma' now" in told
    assert "is called 'x_sigma' now" in told
    path.write_text("sigma_line,line_sigma\n0.5,0.5\n", "utf-8")
    with pytest.raises(InputError, match="another column holds the same"):
        read_table(path, columns)


def test_the_note_to_users_is_the_tables() -> None:
    assert PAGE.read_text("utf-8") == page(), "python -m docs.renamed"
