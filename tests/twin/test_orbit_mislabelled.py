"""Points whose names were exchanged, points of two names, and factors on sigmas of lines, in a calibration on files."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.calibration.adjustment import FarPointsError
from scenes.specs.procedures import PROCEDURES
from tests.tiers import quick
from tests.twin.orbit_files import FIELDS, edit, export, flown, read_back, set_keys, small
from twin.framework.procedure import BenchError
from twin.orbit.calibration.calibration_run import run_calibration
from twin.orbit.calibration.campaign import campaign_of
from twin.orbit.calibration.campaign_adjustment import _factors, mislabelled_points
from twin.orbit.measured.measurement_tables import read_measurements
from twin.orbit.measured.pass_measurements import duplicates


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Exported measurements of two fields of 24 control and 20 check points, screened where they are read."""
    setup = small()
    return export(tmp_path_factory.mktemp("data"), setup, flown(setup)).parent


@pytest.fixture
def file(folder: Path, tmp_path: Path) -> Path:
    """The test file of a copy that is not screened where it is read."""
    shutil.copytree(folder, tmp_path / "data")
    set_keys(tmp_path / "data" / "calibrate.yaml", screening="none")
    return tmp_path / "data" / "calibrate.yaml"


def swapped(place: Path, share: float, table: str, seed: int = 1) -> set[tuple[str, str]]:
    """Exchange names of control points in pairs; field and name of all of them."""
    random, found = np.random.default_rng(seed), set()
    for name in FIELDS:
        control = {row[0] for row in rows_of(place / name / "ground.csv") if row[1] == "control"}

        def change(heads: list[str], rows: list[list[str]], control=control, name=name):
            which = heads.index("camera") if table == "image_points" else heads.index("role")
            groups: dict[str, list[int]] = {}
            for k, row in enumerate(rows):
                if row[0] in control:
                    groups.setdefault(row[which], []).append(k)
            for group in groups.values():
                pairs = random.permutation(group)[: 2 * max(1, round(0.5 * share * len(group)))].reshape(-1, 2)
                for a, b in pairs:
                    rows[a][0], rows[b][0] = rows[b][0], rows[a][0]
                    found.update({(name, rows[a][0]), (name, rows[b][0])})
            return heads, rows

        edit(place / name / f"{table}.csv", change)
    return found


def rows_of(file: Path) -> list[list[str]]:
    return [[cell.strip() for cell in line.split(",")] for line in file.read_text().splitlines()[1:]]


CASES = [(table, share) for share in (0.2, 0.04, 0.4) for table in ("image_points", "ground")]


@pytest.mark.second
@pytest.mark.parametrize(("table", "share"), quick(1, CASES))
def test_exchanged_names_are_found_and_no_others(file: Path, table: str, share: float) -> None:
    """In the images each line has pairs of its own, so that up to three times the share of the points is in one."""
    wrong = swapped(file.parent, share, table)
    with pytest.raises(FarPointsError, match=r"image points of (Beijing|Anhui) do not lie where") as refused:
        read_back(file)
    named = str(refused.value)
    assert any(f"{point} in" in named for _, point in wrong)
    setup = PROCEDURES["orbit calibrate"].resolve(file)
    campaign = campaign_of(setup.test, setup.camera, read_measurements(setup.data, setup.camera), True)
    found = set()
    for one in campaign.passes:
        masks, check = mislabelled_points(campaign, one)
        found |= {(one.name, str(one.control_ids[k])) for n, r in one.control_images.items() for k in r.point[masks[n]]}
        assert not check.any()
    # neighbours within 20 sigmas of an image point, 6 pixels, would be left to robust weights
    assert found == wrong


@pytest.mark.second
def test_check_points_with_exchanged_coordinates_are_found(file: Path) -> None:
    def change(heads, rows):
        checks = [k for k, row in enumerate(rows) if row[1] == "check"]
        rows[checks[0]][0], rows[checks[5]][0] = rows[checks[5]][0], rows[checks[0]][0]
        return heads, rows

    edit(file.parent / FIELDS[0] / "ground.csv", change)
    _, campaign = read_back(file)
    masks, check = mislabelled_points(campaign, campaign.passes[0])
    assert check.sum() == 2
    assert not any(mask.any() for mask in masks.values())


def test_a_refusal_of_a_measured_test_points_to_its_data(file: Path) -> None:
    swapped(file.parent, 0.2, "image_points")
    with pytest.raises(BenchError, match="do not lie where their ground points are") as refused:
        run_calibration(PROCEDURES["orbit calibrate"].resolve(file), None, 0)
    assert refused.value.key == ("data",)
    assert "screening: robust" in refused.value.remedy


def test_one_point_under_two_names_is_said(file: Path) -> None:
    for table in ("ground", "image_points"):
        edit(
            file.parent / FIELDS[0] / f"{table}.csv",
            lambda heads, rows: (heads, [*rows, *(["copy", *row[1:]] for row in rows if row[0] == rows[0][0])]),
        )
    _, campaign = read_back(file)
    one, other = campaign.passes
    assert f"{one.control_ids[0]} = copy" in duplicates(one.control_ids, one.control_ground)
    assert duplicates(other.control_ids, other.control_ground) == ""
    assert duplicates(np.array(["a", "b"], object), np.full((2, 3), np.nan)) == ""


# --- factors on the sigmas of image points ----------------------------------------------------------------------------


LINES = ("forward", "nadir", "backward")


def residuals(rng, count, scale):
    """Standardised residuals of two passes; scale: (pass, line) -> factor."""
    names = ("Beijing", "Anhui")
    found = {p: {k: scale.get((p, k), 1.0) * rng.standard_normal((count, 2)) for k in LINES} for p in names}
    kept = {p: {k: np.ones(count, bool) for k in LINES} for p in names}
    return SimpleNamespace(residual=found), kept


@pytest.mark.second
@pytest.mark.parametrize("count", [12, 60])
def test_good_lines_keep_their_sigmas(count):
    """300 campaigns of six lines: a line stands out by chance in 3e-5 of normal ones; medians of 12 have a tail."""
    rng = np.random.default_rng(count)
    own = [len(set(_factors(*residuals(rng, count, {})).values())) > 1 for _ in range(300)]
    assert np.sum(own) <= (3 if count == 12 else 1)


def test_a_bad_line_has_its_own_factor_and_leaves_the_others_alone():
    """Three times the sigma in one line of six: one factor for all would have been 1.1 for everybody."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        found = _factors(*residuals(rng, 60, {("Anhui", "backward"): 3.0}))
        assert found[("Anhui", "backward")] == pytest.approx(3.0, rel=0.45)
        others = {v for k, v in found.items() if k != ("Anhui", "backward")}
        assert len(others) <= 1
        assert all(v < 1.25 for v in others)


def test_lines_that_are_all_alike_share_a_factor():
    every = {(p, k): 2.0 for p in ("Beijing", "Anhui") for k in LINES}
    found = _factors(*residuals(np.random.default_rng(2), 100, every))
    assert len(set(found.values())) == 1
    assert next(iter(found.values())) == pytest.approx(2.0, rel=0.15)
