"""Rows on measured data of others: skipped without data, with a note for other files, and as expected on the data."""

import os
import shutil
from pathlib import Path

import pytest

import twin.validate as command
from tests.twin.commands import invoke
from twin.validation import registry
from twin.validation.check import SKIPPED
from twin.validation.measured_data import notes, published
from twin.validation.row_names import names_in_files
from twin.validation.runner import run_checks

REAL = Path(os.environ.get("TWIN_REAL", Path(__file__).parents[3] / "shared" / "real"))
needed = pytest.mark.skipif(
    not REAL.is_dir(),
    reason="measured data are read from ../shared/real beside a checkout, or the folder TWIN_REAL names",
)


def results(backend, only, folder):
    return run_checks(registry.select(registry.GROUPS, only), backend, 1, only, real=folder).results


def test_rows_without_data_are_skipped_with_a_sentence(backend, tmp_path):
    validation = run_checks(registry.select(registry.GROUPS, "real"), backend, 1, "real", real=tmp_path)
    assert {r.verdict for r in validation.results} == {SKIPPED}
    assert validation.unexpected == ()
    assert len(validation.results) == sum(name.startswith("real.") for name in names_in_files()) >= 25
    assert all("--real or TWIN_REAL names the folder" in r.how for r in validation.results)


def test_the_papers_alone_run_by_default():
    assert not any(selection.group.prefix.startswith("real") for selection in registry.select(registry.GROUPS, None))


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    result = invoke(command.app, "--real", tmp_path / "none")
    assert result.exit_code == 2
    assert "no such folder" in result.stderr


def test_the_command_skips_what_is_not_there(tmp_path):
    result = invoke(command.app, "--real", tmp_path, "--only", "real.oem", "--json")
    assert result.exit_code == 0
    assert '"skipped"' in result.stdout


def test_other_files_are_named(tmp_path):
    for name in ("oem/LEO_10s.oem", "oem/mine.oem"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("CCSDS")
    text = notes(tmp_path, sorted(tmp_path.rglob("*.oem")))
    assert "LEO_10s.oem is another file than the published one: its SHA-256 begins with" in text
    assert "oem/mine.oem is none of the published files" in text
    assert all(len(checksum) == 64 and place.startswith("https://") for checksum, place in published().values())


@needed
def test_published_files_are_those_of_the_folder():
    here = [path for path in (REAL / name for name in published()) if path.is_file()]
    assert here
    assert notes(REAL, here) == ""


@needed
@pytest.mark.second
@pytest.mark.parametrize("only", ["real.edges", "real.pleiades", "real.spot6", "real.oem"])
def test_rows_on_files(only, backend, tmp_path):
    expected = {c.id: c.expected for group in registry.GROUPS for c in group.checks}
    found = results(backend, only, REAL)
    assert [(r.id, r.how) for r in found if r.verdict not in (expected[r.id], SKIPPED)] == []


@needed
@pytest.mark.second
def test_another_selection_of_frames(backend, tmp_path):
    """Two of the lights alone, so that there are no stars: their rows are skipped, the others hold."""
    (tmp_path / "chandra").mkdir()
    for k in (0, 2):
        name = f"chandra/test_level0_{k}.fits.gz"
        if not (REAL / name).is_file():
            pytest.skip(f"{name} is not there")
        shutil.copy(REAL / name, tmp_path / name)
    verdicts = {r.id: r.verdict for r in results(backend, "real.spots", tmp_path)}
    assert verdicts["real.spots.stars"] == SKIPPED
    assert "refuted" not in (verdicts["real.spots.fiducials"], verdicts["real.spots.successive"])
