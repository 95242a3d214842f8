"""Old names where programs and older runs have them: factors of studies, scripts, comparisons, golden runs."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from scenes.specs.orbit.calibration import OrbitCalibrationSpec
from scenes.specs.result_names import RENAMED, new_name
from scenes.yaml import old_keys
from tests.golden.renamed import fields_of_now, name_now, names_of_now
from twin.compare import run_differences
from twin.scripting.procedures import _merged
from twin.study.runs.base_job import key_now
from twin.study.runs.setup import resolve_study

STUDY = """\
name: old
base: {command: orbit calibrate, file: calibrate}
factors:
  f: {key: [test, changes, forward, focal_length], values: [0 um, 90 um]}
  both:
    keys: [[test, changes, aft, focal_length], [camera, lines, nadir, focal_length]]
    values: [650 mm]
responses:
  height: {key: [calibration, metres_per_arcsec]}
"""


def test_factors_of_a_study_may_name_old_keys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(old_keys, "_TOLD", set())
    (tmp_path / "study.yaml").write_text(STUDY.replace("changes, aft", "changes, nadir"), "utf-8")
    setup = resolve_study(tmp_path / "study.yaml")
    assert setup.study.factors["f"].key == ("test", "perturb", "forward", "principal_distance")
    assert setup.study.factors["both"].keys == (
        ("test", "perturb", "nadir", "principal_distance"),
        ("camera", "lines", "nadir", "principal_distance"),
    )
    assert setup.study.responses["height"].key == ("calibration", "height_m_per_arcsec")
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 4
    assert all(line.startswith(f"note: {tmp_path / 'study.yaml'}:") for line in told)
    new = "is called 'test.perturb.forward.principal_distance' now"
    assert any(f":4: factors.f.test.changes.forward.focal_length: {new}" in line for line in told)


def test_keys_that_stay_stay() -> None:
    key = ("test", "fields", "Beijing", "latitude")
    assert key_now(OrbitCalibrationSpec, key[1:]) == key[1:]
    assert key_now(OrbitCalibrationSpec, ("changes",)) == ("perturb",)
    assert key_now(OrbitCalibrationSpec, ("changes", "nadir", "focal_length", 0))[2:] == ("principal_distance", 0)


def test_scripts_may_give_old_keys() -> None:
    base = {"perturb": {"forward": {"principal_distance": "1 um", "principal_point": ["0 um", "0 um"]}}, "seed": 1}
    merged = _merged(base, {"changes": {"forward": {"focal_length": "2 um"}}}, OrbitCalibrationSpec)
    assert merged == {
        "perturb": {"forward": {"principal_distance": "2 um", "principal_point": ["0 um", "0 um"]}},
        "seed": 1,
    }


def test_older_run_folders_are_compared_by_the_names_of_now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = SimpleNamespace(sha256={"monitor.json": "0"})
    monkeypatch.setattr(run_differences, "read_manifest", lambda folder: listed)
    data = {"schema": "monitor 3", "metres_per_arcsec": 3.9, "smoothing": {"height_sigma_m": [1.0, 2.0]}}
    (tmp_path / "monitor.json").write_text(json.dumps(data), "utf-8")
    found = run_differences.read_run(tmp_path)
    assert found.numbers["monitor.json", "height_m_per_arcsec"] == 3.9
    assert {key for _, key in [*found.numbers, *found.series] if "sigma" in key} <= {
        "smoothing.height_m_sigma",
        "smoothing.height_m_sigma[0]",
        "smoothing.height_m_sigma[1]",
    }


def test_golden_files_of_an_older_version_are_held_against_the_names_of_now() -> None:
    old = {
        "exit": 0,
        "stdout": {"schema": "monitor 3", "metres_per_arcsec": 3.9},
        "tables/spots.csv": {"head": ["side", "sigma_row [px]"], "rows": [["left", 0.1]]},
        "monitor.json": {"propagation": {"height_sigma_m": [1.0]}},
        "config.yaml": {"sigma_row": 1},
    }
    assert names_of_now(old) == {
        "exit": 0,
        "stdout": {"schema": "monitor 3", "height_m_per_arcsec": 3.9},
        "tables/spots.csv": {"head": ["channel", "row_sigma [px]"], "rows": [["left", 0.1]]},
        "monitor.json": {"propagation": {"height_m_sigma_noise": [1.0]}},
        "config.yaml": {"sigma_row": 1},
    }
    fields = {
        "monitor.json": {"fields": {"propagation.height_sigma_m[]": "number", "{a.b|side}.x[]": "text"}},
        "tables/spots.csv": {"columns": ["side", "sigma_row [px]"]},
    }
    assert fields_of_now(fields) == {
        "monitor.json": {"fields": {"propagation.height_m_sigma_noise[]": "number", "{a.b|side}.x[]": "text"}},
        "tables/spots.csv": {"columns": ["channel", "row_sigma [px]"]},
    }


def test_the_golden_check_reads_the_table_that_users_read() -> None:
    for one in RENAMED:
        for file in one.files or ("",):
            old, new = one.old.replace("*", "alpha"), one.new.replace("*", "alpha")
            assert name_now(old.split("."), file) == new == new_name(old.split("."), file)
