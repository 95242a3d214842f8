"""The doctor, and that a crashing child cannot take it with it."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from packaging.requirements import Requirement

from optics.numerics.extension_table import GROUPS, PREFIX, Entry
from optics.numerics.llvm import VARIABLE, LibraryMissing, ensure_llvm, find_llvm
from twin import doctor
from twin.framework import doctor_probe

ROOT = Path(__file__).resolve().parents[2]


def run(*arguments: str, **variables: str) -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, **variables}
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=120, check=False)


@pytest.mark.second
def test_this_machine_is_ready() -> None:
    result = run("-m", "twin.doctor", "--quick", "--json")
    report = json.loads(result.stdout)
    failed = [check for check in report["checks"] if check["status"] == "failed"]
    assert result.returncode == 0, failed
    assert report["ok"]
    names = [check["name"] for check in report["checks"]]
    assert {"Python", "system", "libatomic", "LLVM", "kernel", "render llvm_ad_mono", "mitsuba"} <= set(names)
    assert len(names) > 15


@pytest.mark.second
def test_a_missing_library_is_reported_and_fails() -> None:
    result = run("-m", "twin.doctor", "--quick", **{VARIABLE: "/no/such/libLLVM.so"})
    assert result.returncode == 1
    assert "not ready" in result.stdout
    assert "/no/such/libLLVM.so" in result.stdout.replace("\n", "")
    assert "Traceback" not in result.stdout + result.stderr


ABORTS = "import os, sys; sys.stderr.write('LLVM ERROR: Cannot select: fmaximum\\n'); sys.stderr.flush(); os.abort()"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("-c", "import os; os.abort()"), "crashed with SIGABRT"),
        (("-c", ABORTS), "needs LLVM 17 or newer.*Cannot select"),
        (("-c", "import time; time.sleep(60)"), "no answer after 1 s"),
        (("-c", "raise SystemExit(3)"), "exit code 3 without a result"),
        (("-m", "twin.framework.doctor_probe", "render", "no_such_variant"), "no_such_variant"),
    ],
)
def test_a_child_that_fails_is_told(words: tuple[str, ...], told: str) -> None:
    with pytest.raises(RuntimeError, match=told):
        doctor.run_probe(list(words), timeout_s=1.0 if "sleep" in words[1] else 60.0)


def test_the_answer_of_a_child_is_its_last_line() -> None:
    assert doctor.run_probe(["-c", """print('a note'); print('{"result": {"cores": 2}}')"""]) == {"cores": 2}


def test_every_dependency_is_asked_for_in_a_range_that_is_here() -> None:
    asked = {one.name: one.specifier for one in doctor.requirements()}
    assert len(asked) > 10
    assert asked["mitsuba"].contains("3.9.1")
    assert not asked["mitsuba"].contains("3.8.0")
    assert {check.status for check in doctor._versions()} == {"ok"}


def test_a_version_out_of_its_range_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = [Requirement("numpy>=99,<100"), Requirement("no-such-package>=1")]
    monkeypatch.setattr(doctor, "requirements", lambda: wanted)
    other, missing = doctor._versions()
    assert (other.status, missing.status) == ("note", "failed")
    assert "<100,>=99" in other.detail


def test_llvm_is_the_one_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    assert ensure_llvm() == find_llvm()
    assert os.environ[VARIABLE] == str(find_llvm())


def test_a_users_llvm_is_respected(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    own = tmp_path / "libLLVM.so"
    own.touch()
    monkeypatch.setenv(VARIABLE, str(own))
    assert ensure_llvm() == own
    monkeypatch.setenv(VARIABLE, str(tmp_path / "missing.so"))
    with pytest.raises(LibraryMissing, match=VARIABLE):
        ensure_llvm()


@pytest.mark.second
def test_drjit_imported_too_early_is_told() -> None:
    """Either drjit found a usable LLVM by itself, or importing optics after it says what to do."""
    code = "import drjit; drjit.has_backend(drjit.JitBackend.LLVM); import optics"
    environment = {key: value for key, value in os.environ.items() if key != VARIABLE}
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=environment, timeout=60, check=False
    )
    assert result.returncode == 0 or "import optics first" in result.stderr


def test_every_check_says_what_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the twin cannot run without has failed; what it can do without, or differs, is a note."""

    def fail(*words: object) -> None:
        raise RuntimeError("gone")

    def no_library(name: str) -> None:
        raise OSError(name)

    assert (doctor._python().status, doctor._libatomic().status) == ("ok", "ok")
    monkeypatch.setattr(doctor, "OLDEST_PYTHON", (99, 1))
    assert (doctor._python().status, "needs 99.1 or newer" in doctor._python().detail) == ("failed", True)
    monkeypatch.setattr("ctypes.CDLL", no_library)
    assert (doctor._libatomic().status, doctor._llvm().status) == ("failed", "failed")
    with pytest.raises(LibraryMissing, match="apt install libatomic1"):
        ensure_llvm()
    monkeypatch.setattr(doctor_probe, "ULPS", -1.0)
    with pytest.raises(RuntimeError, match="the kernel's results differ from numpy's by"):
        doctor_probe.kernel()
    dark = SimpleNamespace(set_variant=str, load_dict=dict, render=lambda *words, **how: np.zeros((16, 16, 1)))
    monkeypatch.setitem(sys.modules, "mitsuba", dark)
    with pytest.raises(RuntimeError, match=r"radiance 1 was rendered as 0 \.\. 0"):
        doctor_probe.render()
    monkeypatch.setattr(doctor, "run_probe", fail)
    assert (doctor._probe("kernel", [], str).status, doctor._gpu().status) == ("failed", "note")
    for found, status in (({"available": False}, "note"), ({"version": "12", "compute_capability": "9.0"}, "ok")):
        monkeypatch.setattr(doctor, "run_probe", lambda words, found=found: {"available": True, **found})
        assert doctor._gpu().status == status


def test_extensions_are_listed_and_a_misspelt_group_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """An entry of a group that no table has is never read; nothing else would say so."""
    made = [Entry("toy", "1.0", f"{PREFIX}{group}", "half", "toy:Half") for group in ("estimators", "estimator", "xyz")]
    monkeypatch.setattr("optics.numerics.extension_table.entries", lambda: tuple(made))
    good, near, far = doctor._extensions()
    page = Path(doctor.__file__).parents[1] / "docs/architecture.md"
    assert all(f"| `{group}` |" in page.read_text("utf-8") for group in GROUPS)  # where to add
    assert (good.status, near.status, far.status) == ("ok", "note", "note")
    assert near.detail.endswith(f"no such group of entry points; did you mean {PREFIX}estimators?")
    assert "allowed: camera_parameters, centroids" in far.detail
