"""No silent convention: every mistake is found by `check`, or told as one that the points cannot tell."""

import copy
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import twin.orbit.__main__ as command
from scenes.specs.orbit.measurements import OrbitCheckSpec, with_absolute_files
from scenes.specs.orbit.setup import CheckSetup, load_three_line_camera
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.twin import orbit_file_bench as bench
from tests.twin.commands import invoke
from tests.twin.orbit_files import REFUSALS
from twin.orbit.conventions.check_run import DECIDED, Check, _bench, _tried, run_check
from twin.orbit.conventions.pass_readings import TESTED_CONVENTIONS, read_pass, singles_and_pairs

run = partial(invoke, command.app)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("pass")
    return folder, bench.check_files(folder, count=8)


def checked(files: tuple[Path, dict[str, Any]], *changes: tuple[tuple[str, ...], Any]) -> Check:
    """What is found when the file says something else at these keys."""
    folder, data = files
    data = copy.deepcopy(data)
    for keys, value in changes:
        place = data
        for key in keys[:-1]:
            place = place.setdefault(key, {})
        place[keys[-1]] = copy.deepcopy(value)
    spec = with_absolute_files(OrbitCheckSpec.model_validate(data), folder)
    setup = CheckSetup.model_construct(test=spec, camera=load_three_line_camera("th1"))
    return run_check(setup, None, 0)


ATTITUDE = ("platform", "attitude")
FOUND = {
    "swapped quaternion order": (((*ATTITUDE, "scalar"), "first"), "quaternion_scalar", "last"),
    "conjugate quaternion": (((*ATTITUDE, "direction"), "frame_to_body"), "quaternion_turns", "body_to_frame"),
    "UTC for GPS time, lines": ((("lines", "time_scale"), "GPS"), "line_time_scale", "UTC"),
    "UTC for GPS time, attitude": (((*ATTITUDE, "time_scale"), "GPS"), "attitude_time_scale", "UTC"),
    "UTC for GPS time, orbit": ((("platform", "orbit", "time_scale"), "GPS"), "orbit_time_scale", "UTC"),
    "mirrored sample axis": ((("image_points", "first_pixel_sees"), "left"), "first_pixel_sees", "right"),
    "inertial for Earth-fixed": ((("platform", "orbit", "frame"), "GCRS"), "orbit_frame", "ITRS"),
    "another body": (((*ATTITUDE, "body_axes"), ["back", "left", "down"]), "body_axes", ("forward", "right", "down")),
}


@pytest.mark.second
def test_what_is_stated_rightly_stands_and_what_cannot_be_told_is_said(files) -> None:
    """Camera and platform are wrong by what is stated of them. Half a pixel and half a line look like a turn of the
    platform by two arcseconds, and say so.
    """
    found = checked(files)
    assert found.verdict == "confirmed"
    assert found.best.changes == ()
    assert 0.5 < found.best.fit.chi_square / found.best.fit.freedom < 1.6
    open_ones = {name for name, answers in found.answers.items() if sum(a.possible for a in answers) > 1}
    assert open_ones == {"line_moment", "line_origin", "pixel_origin"}
    for name in open_ones:
        assert all(answer.moved < 15.0 for answer in found.answers[name])
    assert found.count > 300


@pytest.mark.second
@pytest.mark.parametrize("what", FOUND)
def test_one_wrong_convention_is_found(files, what: str) -> None:
    """The right convention is named, alone, and far likelier than the stated one."""
    change, question, right = FOUND[what]
    found = checked(files, change)
    assert found.verdict == "another"
    assert found.best.changes == ((question, right),)
    assert found.equally_likely == ()
    stated = found.specified_fit
    assert stated.fit is None or stated.cost - found.best.cost > 100.0 * DECIDED


@pytest.mark.second
def test_an_offset_of_one_second_is_found(files) -> None:
    """Orbit and attitude are 1 s late: the lines' times are found 1 s off."""
    found = checked(files, (("platform", "orbit", "offset"), "+1 s"), ((*ATTITUDE, "offset"), "+1 s"))
    assert found.verdict == "another"
    assert found.best.changes == (("line_time_offset", 1.0),)


@pytest.mark.second
def test_half_a_pixel_is_found_where_camera_and_platform_are_known_well_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Told as open above; with a platform known to 0.02 arcsec and lines to 0.02 px, as after a calibration, it is
    not.
    """
    monkeypatch.setattr(bench, "interior_and_bias", lambda: (np.zeros(3), 0.0))
    data = bench.check_files(tmp_path, count=30)
    small = {"attitude": "0.02 arcsec", "position": "0.05 m", "interior": 0.02, "scale": 0.0, "time": "0 s"}
    data["uncertainty"] = small
    assert checked((tmp_path, data)).best.changes == ()
    found = checked((tmp_path, data), (("image_points", "centre"), "half"))
    assert found.verdict == "another"
    # the file's half pixel is one of lines, too, which is the same as a time of the line's begin: both are listed
    both = [dict(found.best.changes), *map(dict, found.equally_likely)]
    assert {"pixel_origin": 0.0, "line_origin": 0.0} in both
    assert {"pixel_origin": 0.0, "line_moment": "start"} in both
    assert all(one["pixel_origin"] == 0.0 for one in both)


@pytest.mark.second
def test_two_wrong_conventions_at_once_are_found(files) -> None:
    """Order of the quaternion and time scale of the lines, both named."""
    both = [FOUND[name] for name in ("swapped quaternion order", "UTC for GPS time, lines")]
    found = checked(files, *(change for change, _, _ in both))
    assert found.verdict == "another"
    assert dict(found.best.changes) == {question: right for _, question, right in both}


@pytest.mark.second
def test_what_no_reading_explains_is_said(files) -> None:
    """The platform is wrong by 40 arcsec, and stated to be good to a tenth of one."""
    small = {"attitude": "0.1 arcsec", "position": "0.1 m", "interior": 0.1, "scale": 0.0, "time": "0 s"}
    assert checked(files, (("uncertainty",), small)).verdict == "none"


@pytest.mark.second
def test_gross_errors_do_not_hide_a_convention(tmp_path: Path) -> None:
    data = bench.check_files(tmp_path, count=25, seed=4, wrong=0.1)
    found = checked((tmp_path, data), FOUND["conjugate quaternion"][0])
    assert found.best.changes == (("quaternion_turns", "body_to_frame"),)
    assert found.verdict == "another"
    assert sum(map(len, found.wrong.values())) > 0


@pytest.mark.second
def test_what_is_exported_is_the_pass_that_was_read() -> None:
    """The shipped pass over Beijing goes through these readers and out again: the same numbers as by the tables' own
    reader, to rounding of times (1e-11 s, 1e-7 m).
    """
    from scenes.specs.load import SCENES
    from scenes.specs.orbit.setup import CheckSetup, MeasuredCalibrationSetup
    from twin.orbit.conventions.check_run import exported, measurements
    from twin.orbit.flight.platform_table import TabulatedTrajectory
    from twin.orbit.measured.earth_orientation import Readings
    from twin.orbit.measured.measurement_tables import read_measurements

    folder = SCENES / "orbit/measured"
    found = run_check(CheckSetup.read(folder / "check.yaml"), None, 0)
    assert "camera.yaml" in exported(found)
    mine = measurements(found)
    setup = MeasuredCalibrationSetup.read(folder / "calibrate.yaml")
    theirs = next(one for one in read_measurements(setup.data, setup.camera) if one.name == "Beijing")
    later = Readings.of_texts([theirs.platform.epoch]).instants("UTC").since(mine.platform.epoch)[0]
    a, b = TabulatedTrajectory(mine.platform), TabulatedTrajectory(theirs.platform)
    t = np.linspace(b.first + 1.0, b.last - 1.0, 50)
    np.testing.assert_allclose(a.position(t + later), b.position(t), rtol=0, atol=1e-6)
    np.testing.assert_allclose(a.body_to_itrs(t + later), b.body_to_itrs(t), rtol=0, atol=1e-12)
    assert list(mine.ground.ids) == list(theirs.ground.ids[theirs.ground.role != "tie"])
    np.testing.assert_allclose(mine.ground.itrs, theirs.ground.itrs, rtol=0, atol=2e-9)
    np.testing.assert_allclose(mine.ground.covariance, theirs.ground.covariance, rtol=0, atol=1e-12)
    for name, row in theirs.images.items():
        here = mine.images[name]
        order, there = np.argsort(here.point, kind="stable"), np.argsort(row.point, kind="stable")
        for key in ("point", "line", "pixel", "covariance"):
            np.testing.assert_allclose(getattr(here, key)[order], getattr(row, key)[there], rtol=0, atol=1e-9)
        lines = np.linspace(0.0, row.line.max(), 9)
        np.testing.assert_allclose(
            mine.line_times[name].at(lines), theirs.line_times[name].at(lines) + later, rtol=0, atol=1e-10
        )


def test_every_question_is_asked_with_every_other() -> None:
    every = list(singles_and_pairs(dict.fromkeys(list(TESTED_CONVENTIONS)[:4], (1, 2))))
    assert every[0] == ()
    assert [sum(len(one) == k for one in every) for k in (1, 2)] == [8, 24]
    assert len(set(every)) == len(every)


@pytest.mark.second
def test_the_command_says_that_another_reading_is_right(files, tmp_path: Path) -> None:
    folder, data = files
    path = folder / "check.yaml"
    wrong = copy.deepcopy(data)
    wrong["platform"]["attitude"]["scalar"] = "first"
    path.write_text(dump_yaml({**wrong, "points": 4}))
    result = run("check", path, "--out", tmp_path / "wrong")
    assert result.exit_code == 3
    assert "scalar of the quaternion last" in result.stdout
    result = run("check", path, "--out", tmp_path / "again", "--export", tmp_path / "data")
    assert result.exit_code == 2
    assert "nothing is exported" in result.stderr
    assert not (tmp_path / "data").exists()


GCP = (("ground",), {"file": "points.gcp", "crs": "EPSG:4979", "sigma_axes": "enu"})


@pytest.fixture(scope="module")
def gcp(files: tuple[Path, dict[str, Any]]) -> tuple[Path, dict[str, Any]]:
    """The same points in the .gcp of the Ames Stereo Pipeline, which holds ground points and image points."""
    folder, _ = files
    ground = [row.split(",") for row in (folder / "ground.csv").read_text().splitlines()[1:]]
    images: dict[str, list[str]] = {}
    for row in (folder / "image_points.csv").read_text().splitlines()[1:]:
        point, camera, line, pixel, line_sigma, pixel_sigma = row.split(",")
        images.setdefault(point, []).append(f"{camera}.tif {pixel} {line} {pixel_sigma} {line_sigma}")
    rows = [f"{name} {a} {b} {h} 1 1 1 {' '.join(images[name])}" for name, a, b, h in ground]
    for name, found in (
        ("points", rows),
        ("other", [row.replace("nadir.tif", "down.tif") for row in rows]),
        ("none", [" ".join(row.split()[:7]) for row in rows]),
    ):
        (folder / f"{name}.gcp").write_text("\n".join(found) + "\n")
    return files


@pytest.mark.second
def test_places_in_images_of_a_gcp_file(gcp: tuple[Path, dict[str, Any]]) -> None:
    table, found = checked(gcp), checked(gcp, GCP, (("image_points", "file"), "points.gcp"))
    assert found.verdict == table.verdict == "confirmed"
    assert found.best.fit.chi_square == pytest.approx(table.best.fit.chi_square, rel=1e-9)


@pytest.mark.parametrize(
    ("ground", "images", "words"),
    [
        ("other.gcp", "other.gcp", r"none of the camera's lines.*'down.tif'"),
        ("points.gcp", "other.gcp", r"another \.gcp file"),
        ("none.gcp", "none.gcp", r"a \.gcp file without images"),
    ],
)
def test_a_gcp_file_without_the_images_is_refused(gcp, ground: str, images: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        checked(gcp, GCP, (("ground", "file"), ground), (("image_points", "file"), images))


@pytest.mark.parametrize(("name", "old", "new", "why"), REFUSALS["impossible"])
def test_a_reading_that_cannot_be_says_why(files, tmp_path: Path, name: str, old: str, new: str, why: str) -> None:
    folder, data = files
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(re.sub(old, new, text, flags=re.M))
    assert (tmp_path / name).read_text() != text
    spec = with_absolute_files(OrbitCheckSpec.model_validate(data), tmp_path)
    setup = CheckSetup.model_construct(test=spec, camera=load_three_line_camera("th1"))
    readings, stated = read_pass(spec, setup.camera, Path())
    assert why in _tried(_bench(setup, readings, stated), ()).why
