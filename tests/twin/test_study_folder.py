"""The folder of a study: whose it is, what --force may remove from it, and which program may go on with it."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import twin.run.versions
from tests.twin.commands import files
from tests.twin.study_bench import ROOT, write_study
from twin.run.run_folder import Numbered, RunFolder, RunFolderError
from twin.run.versions import source_digest, sources
from twin.study.runs.setup import StudySetup, resolve_study
from twin.study.runs.study_folder import StudyFolder
from twin.study.runs.task import OtherProgramError, Task, evaluate

OWN = {".lock", "config.yaml", "study_state.json", "chunks/index.txt", "chunks/00000.npz"}
"""Files of ``work``."""


@pytest.fixture(scope="module")
def setup(tmp_path_factory) -> StudySetup:
    return resolve_study(write_study(tmp_path_factory.mktemp("in")))


def fresh(setup: StudySetup) -> StudySetup:
    """As a new process sees it."""
    return StudySetup(setup.study, setup.tree)


def work(path: Path | Numbered, setup: StudySetup, **options: bool) -> Path:
    """A study that gets as far as its first chunk."""
    with StudyFolder(path, setup, **options) as folder:
        chunks = folder.path / "chunks"
        chunks.mkdir(exist_ok=True)
        (chunks / "index.txt").write_text("a line\n")
        (chunks / "00000.npz").write_text("a chunk")
    return folder.path


def test_sources_are_all_that_can_compute() -> None:
    """Everything that the program of a worker may import, wherever in a file the import stands."""
    from tests.test_architecture import PACKAGES, imported_modules

    todo, seen = ["twin.study.runs.task", "twin.study.runs.plan"], set()
    while todo:
        name = todo.pop()
        place = ROOT.joinpath(*name.split("."))
        path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if name in seen or not path.is_file():
            continue
        seen.add(name)
        assert path.relative_to(ROOT).as_posix() in sources()
        todo += [other for other in imported_modules(path) if other.split(".")[0] in PACKAGES]
    assert {
        "twin.sensors.area_detector",
        "optics.raytrace.trace",
        "scenes.models.thermal_model",
        "analysis.monitor.recovery",
    } <= seen


@pytest.mark.parametrize("change", ["edited", "new", "gone"])
def test_other_code_is_not_mixed_in(setup, tmp_path, monkeypatch, change) -> None:
    """The detector's quantum efficiency halved in the source between two commands, and the like."""
    path = work(tmp_path / "run", setup)
    before = {name: (path / name).read_bytes() for name in files(path)}
    work(path, fresh(setup), resume=True)  # the same program may
    own = sources()
    other = dict(own)
    if change == "gone":
        del other["twin/sensors/area_detector.py"]
    else:
        other["twin/sensors/area_detector.py" if change == "edited" else "twin/new.py"] = "0" * 16
    monkeypatch.setattr(twin.run.versions, "sources", lambda: other)
    monkeypatch.setattr("twin.study.runs.study_folder.sources", lambda: other)
    named = "twin/new.py" if change == "new" else "twin/sensors/area_detector.py"
    with pytest.raises(RunFolderError, match=rf"another version of the program.*changed: {named}.*--out.*--force"):
        work(path, fresh(setup), resume=True)
    assert {name: (path / name).read_bytes() for name in files(path)} == before
    assert fresh(setup).fingerprint != setup.fingerprint


def test_another_version_of_a_package_is_named(setup, tmp_path, monkeypatch) -> None:
    path = work(tmp_path / "run", setup)
    other = twin.run.versions.versions() | {"numpy": "1.0"}
    for place in (
        "twin.run.versions.versions",
        "twin.study.runs.study_folder.versions",
        "twin.study.runs.setup.versions",
    ):
        monkeypatch.setattr(place, lambda: other)
    with pytest.raises(RunFolderError, match=r"numpy was [0-9.]+ and is 1\.0"):
        work(path, fresh(setup), resume=True)


def test_sources_change_with_the_files(tmp_path, monkeypatch) -> None:
    for name in ("optics/a.py", "twin/b.py", "twin/validation/c.py", "scenes/d.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    monkeypatch.setattr(twin.run.versions, "ROOT", tmp_path)
    read = sources.__wrapped__
    first = read()
    assert set(first) == {"optics/a.py", "twin/b.py"}
    (tmp_path / "twin/b.py").write_text("x = 2\n")
    assert read()["twin/b.py"] != first["twin/b.py"]
    assert read()["optics/a.py"] == first["optics/a.py"]


def test_a_worker_with_other_code_computes_nothing(setup) -> None:
    """Files that are edited while a study runs: a worker that is started afterwards refuses its task."""
    with pytest.raises(OtherProgramError, match="other source files"):
        evaluate(Task(setup.to_yaml(), "0" * 64, "llvm", 0, ()))
    assert evaluate(Task(setup.to_yaml(), source_digest(), "llvm", 0, ())) == []


def test_force_replaces_an_unfinished_study(setup, tmp_path) -> None:
    path = work(tmp_path / "run", setup)
    (path / "chunks" / "00001.npz.corrupt").touch()
    (path / "chunks" / ".00002.npz.partial").touch()
    (path / "study.nc").touch()
    work(path, setup, force=True)
    assert files(path) == OWN


@pytest.mark.parametrize("put", ["notes.txt", "chunks/notes.txt", "study.txt", ".notes", "chunks/1.npz.bak"])
def test_force_keeps_what_the_study_did_not_write(setup, tmp_path, put) -> None:
    path = work(tmp_path / "run", setup)
    (path / put).write_text("mine")
    with pytest.raises(RunFolderError, match=rf"did not write: {re.escape(put)}; "):
        work(path, setup, force=True)
    with pytest.raises(RunFolderError, match=rf"did not write: {re.escape(put)}; "):
        RunFolder(path, force=True)
    assert (path / put).read_text() == "mine"


def test_files_put_there_during_the_study_are_kept(setup, tmp_path) -> None:
    path = work(tmp_path / "run", setup)
    with StudyFolder(path, setup, force=True):
        # nothing is done: the old study comes back
        (path / "notes.txt").write_text("mine")
    assert files(path) == {*OWN, "notes.txt"}
    assert [place.name for place in tmp_path.iterdir()] == ["run"]


def test_a_state_that_is_not_ours(setup, tmp_path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "study_state.json").write_text(json.dumps({"program": "other", "fingerprint": "x"}))
    (path / "study.csv").write_text("somebody's")
    with pytest.raises(RunFolderError, match="not the folder of a study"):
        work(path, setup, force=True)
    for text in ("", "[]", "{}", '{"program": "twin.study", "fingerprint": 1}', "[" * 100_000):
        (path / "study_state.json").write_text(text)
        with pytest.raises(RunFolderError, match="cannot be read"):
            work(path, setup, resume=True)
    assert (path / "study.csv").read_text() == "somebody's"


def test_studies_that_start_together_get_a_number_each(setup, tmp_path) -> None:
    first, second = (StudyFolder(Numbered(tmp_path / "runs", "study"), setup) for _ in range(2))
    assert first.path == second.path
    with first, second:
        for k, study in enumerate((first, second)):
            study.write("study.csv", str(k).encode())
            (study.path / "chunks").mkdir()
            (study.path / "chunks" / "index.txt").touch()
    assert (first.path.name, second.path.name) == ("study-001", "study-002")
    assert (first.path / "study.csv").read_text() == "0"
    assert (second.path / "study.csv").read_text() == "1"


KILLED = """
import os, signal, sys
from pathlib import Path
from twin.study.runs.study_folder import StudyFolder
from twin.study.runs.setup import resolve_study
with StudyFolder(Path(sys.argv[1]), resolve_study(sys.argv[2]), force=True):
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_study_that_a_killed_command_was_replacing_is_not_lost(setup, tmp_path) -> None:
    """It stays aside while the new one is not finished, and goes when it is."""
    path = work(tmp_path / "run", setup)
    file = write_study(tmp_path / "in")
    done = subprocess.run([sys.executable, "-c", KILLED, str(path), str(file)], cwd=ROOT, timeout=120)
    assert done.returncode == -signal.SIGKILL
    aside = next(tmp_path.glob(".run.*.old"))
    assert (aside / "chunks" / "00000.npz").exists()
    work(path, setup, resume=True)
    assert aside.exists()
    times = {"started_unix_s": 1.5e9, "wall_time_s": 1.0}
    manifest = {"program": "twin.study", "versions": twin.run.versions.versions(), **times, "sha256": {}}
    (path / "manifest.json").write_text(json.dumps(manifest))
    work(tmp_path / "other", setup)
    assert {place.name for place in tmp_path.iterdir()} == {"run", "other", "in"}
    assert os.path.exists(path / "chunks" / "00000.npz")
