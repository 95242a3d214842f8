"""What a manifest says of where a run was made."""

import importlib.metadata
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tifffile

from twin.framework import provenance
from twin.framework.provenance import Provenance, SelfCheck, checks_in, inputs_in

ROOT = Path(__file__).resolve().parents[2]


def digest_with(root: Path) -> str:
    code = "from twin.framework.provenance import program_digest; print(program_digest())"
    ran = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    return ran.stdout.strip()


@pytest.mark.second
def test_the_digest_is_of_all_files_and_follows_each(tmp_path):
    """Copies without what Git, editors and Python leave have the same one; a line of the library changes it."""
    for package in provenance.SOURCES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "twin/framework/notes.txt~").write_text("an editor's")
    assert digest_with(tmp_path) == provenance.program_digest()
    sheet = tmp_path / "scenes/library/detectors/monitor_ccd.yaml"
    sheet.write_text(sheet.read_text("utf-8") + "\n", "utf-8")
    assert digest_with(tmp_path) != provenance.program_digest()


def test_what_rounds_numbers_is_named():
    here = Provenance.here()
    assert len(here.processor) > len(", x86_64")
    assert here.cores >= 1
    assert here.simd
    assert [one.name for one in here.blas].count("openblas") >= 1
    assert all(one.kernels and one.threads >= 1 for one in here.blas)
    assert Provenance.model_validate_json(here.model_dump_json()) == here


def test_every_package_that_the_program_asks_for_is_named():
    """Those in pyproject.toml, whose numbers matter in `versions`, the others in the provenance."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    # what was installed before the last change of pyproject.toml asks for fewer
    known = {re.match(r"[A-Za-z0-9._-]+", line)[0] for line in importlib.metadata.requires("space-camera-twin")}
    asked = {re.match(r"[A-Za-z0-9._-]+", line)[0] for line in project["dependencies"]} & known
    assert len(asked) > 25
    assert asked <= {*provenance.versions(), *provenance.other_packages()}
    assert provenance.versions()["numpy"] == np.__version__
    assert provenance.other_packages()["tifffile"] == tifffile.__version__


def test_inputs_are_the_files_that_a_set_up_names(tmp_path):
    (tmp_path / "pass").mkdir()
    for name in ("frames.tiff", "pass/orbit.csv", "pass/lines.csv"):
        (tmp_path / name).write_text(name)
    tree = {"frames": {"a/left": [str(tmp_path / "frames.tiff")]}, "data": str(tmp_path / "pass"), "n": 3}
    tree |= {"name": "/no such file", "text": "/\0", "long": "/" + 5000 * "x", "relative": "pyproject.toml"}
    found = inputs_in(tree, [tmp_path / "frames.tiff"])
    assert list(found) == [str(tmp_path / name) for name in ("frames.tiff", "pass/lines.csv", "pass/orbit.csv")]
    (tmp_path / "frames.tiff").write_text("others")
    again = inputs_in(tree)
    assert [name for name in found if found[name] != again[name]] == [str(tmp_path / "frames.tiff")]


def test_a_check_holds_up_to_its_limit():
    assert SelfCheck("sum", 1.0, 1.0).holds is True
    assert SelfCheck("sum", 1.1, 1.0).holds is False
    assert SelfCheck("sum", float("nan"), 1.0).holds is False
    assert SelfCheck("sum", 1.0, None).to_dict()["holds"] is None


def test_chi_squares_and_what_converged_are_found_in_numbers():
    fits = [{"chi_square": 3.0, "chi_square_limit": 2.0}, {"check_chi_square": 1.0}]
    numbers = {"fit": {"chi_square": 4.0, "converged": False}, "lines": fits, "worst_relative": 1e-9, "chi_square_x": 1}
    found = {check.name: (check.value, check.holds) for check in checks_in(numbers)}
    assert found == {
        "fit.chi_square": (4.0, None),
        "fit.converged": (1.0, False),
        "lines[0].chi_square": (3.0, False),
        "lines[1].check_chi_square": (1.0, None),
        "worst_relative": (1e-9, None),
    }
