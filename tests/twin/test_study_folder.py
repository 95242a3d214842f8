"""The folder of a study: whose it is, what --force may remove from it, and which program may go on with it."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import twin.run.durable
import twin.run.provenance
from tests.twin.commands import files
from tests.twin.study_bench import write_study
from twin.run.durable import exchange
from twin.run.provenance import source_digest, sources
from twin.run.run_folder import Numbered, RunFolder, RunFolderError, is_run_folder, unlisted, write_manifest
from twin.study.runs.setup import StudySetup, resolve_study
from twin.study.runs.study_folder import StudyFolder
from twin.study.runs.task import OtherProgramError, Task, evaluate

OWN = {".lock", ".written", "config.yaml", "study_state.json", "chunks/index.txt", "chunks/00000.npz"}
"""Files of ``work``."""


@pytest.fixture(scope="module")
def setup(tmp_path_factory) -> StudySetup:
    return resolve_study(write_study(tmp_path_factory.mktemp("in")))


def fresh(setup: StudySetup) -> StudySetup:
    """As a new process sees it."""
    return replace(setup)


def work(path: Path | Numbered, setup: StudySetup, **options: bool) -> Path:
    """A study that gets as far as its first chunk."""
    with StudyFolder(path, setup, **options) as folder:
        chunks = folder.path / "chunks"
        chunks.mkdir(exist_ok=True)
        (chunks / "index.txt").write_text("a line\n")
        (chunks / "00000.npz").write_text("a chunk")
    return folder.path


def finish(path: Path, setup: StudySetup, report: str = "found", **options: bool) -> Path:
    """A study that gets to its end."""
    with StudyFolder(path, setup, **options) as folder:
        (folder.path / "chunks").mkdir(exist_ok=True)
        (folder.path / "chunks" / "index.txt").write_text("a line\n")
        folder.begin_results()
        folder.write_all({"report.html": report.encode(), "artefacts/a.csv": b"1,2"})
        write_manifest(folder, "twin.study", 1.5e9, 1.0)
    return path


def is_whole(path: Path, report: str) -> bool:
    """Whether a finished study stands there with all its files as they were written."""
    return is_run_folder(path) and unlisted(path) == [] and (path / "report.html").read_text() == report


@pytest.mark.second
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
    monkeypatch.setattr(twin.run.provenance, "sources", lambda: other)
    monkeypatch.setattr("twin.study.runs.study_folder.sources", lambda: other)
    named = "twin/new.py" if change == "new" else "twin/sensors/area_detector.py"
    with pytest.raises(RunFolderError, match=rf"another version of the program.*changed: {named}.*--out.*--force"):
        work(path, fresh(setup), resume=True)
    assert {name: (path / name).read_bytes() for name in files(path)} == before
    assert fresh(setup).fingerprint != setup.fingerprint


def test_another_version_of_a_package_is_named(setup, tmp_path, monkeypatch) -> None:
    path = work(tmp_path / "run", setup)
    other = twin.run.provenance.versions() | {"numpy": "1.0"}
    for place in (
        "twin.run.provenance.versions",
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
    monkeypatch.setattr(twin.run.provenance, "ROOT", tmp_path)
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
    (path / "chunks" / ".00002.npz.0123abcd.partial").touch()
    finish(path, setup, force=True)
    assert files(path) == OWN - {".written", "chunks/00000.npz"} | {"manifest.json", "report.html", "artefacts/a.csv"}
    assert [place.name for place in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("exchange", [True, False])
def test_what_is_replaced_stands_until_the_new_study_is_complete(setup, tmp_path, monkeypatch, exchange) -> None:
    """Broken off after its first chunk, as by a full disk or a signal; then gone on with."""
    if not exchange:  # a file system that does not know it
        monkeypatch.setattr(twin.run.durable, "exchange", lambda first, second: False)
    path = finish(tmp_path / "run", setup, "old")
    work(path, setup, force=True)
    assert is_whole(path, "old")
    assert files(tmp_path / ".run.next") == OWN | {".succeeds"}
    with pytest.raises(RunFolderError, match=r"run exists, and what was begun .*\.run\.next; .*--resume.*--force"):
        work(path, setup)
    work(path, setup, resume=True)
    assert is_whole(path, "old")
    finish(path, setup, "new", resume=True)
    assert is_whole(path, "new")
    assert [place.name for place in tmp_path.iterdir()] == ["run"]


def test_a_whole_study_that_cannot_be_put_in_place_stays(setup, tmp_path) -> None:
    """Its place was taken meanwhile by what is no folder."""
    path = finish(tmp_path / "run", setup, "old")
    with StudyFolder(path, setup, force=True) as folder:
        write_manifest(folder, "twin.study", 1.5e9, 1.0)
        shutil.rmtree(path)
        path.symlink_to("nowhere")
        with pytest.raises(RunFolderError, match=r"complete in .*\.run\.next and cannot be put in place .*--resume"):
            folder.__exit__()
        folder._working = False
    assert is_run_folder(tmp_path / ".run.next")


def test_force_drops_what_was_begun_to_replace_a_run(setup, tmp_path) -> None:
    path = finish(tmp_path / "run", setup, "old")
    work(path, setup, force=True)
    (tmp_path / ".run.next" / "chunks" / "00007.npz").touch()
    work(path, setup, force=True)
    assert files(tmp_path / ".run.next") == OWN | {".succeeds"}
    (tmp_path / ".run.next" / "notes.txt").write_text("mine")
    with pytest.raises(RunFolderError, match=r"\.run\.next also holds .*notes.txt"):
        work(path, setup, force=True)
    assert is_whole(path, "old")


def test_a_run_that_came_meanwhile_is_not_replaced(setup, tmp_path) -> None:
    """--force was said of another one."""
    path = finish(tmp_path / "run", setup, "old")
    work(path, setup, force=True)
    with RunFolder(path, force=True) as folder:
        folder.write_text("render.txt", "newer")
        write_manifest(folder, "twin.render", 1.6e9, 1.0)
    with pytest.raises(RunFolderError, match="another run than the one that"):
        finish(path, setup, "new", resume=True)
    assert (path / "render.txt").read_text() == "newer"
    assert (tmp_path / ".run.next" / "chunks" / "00000.npz").exists()


class Killed(BaseException):
    """Stands in for SIGKILL: nothing is cleared up."""


@pytest.mark.parametrize("at", ["durable.put_in_place", "run_folder.remove_run"])
def test_killed_while_it_is_put_in_place(setup, tmp_path, monkeypatch, at) -> None:
    """Just before both change places, and just after: a whole study stands there, and --resume comes to the end."""
    path = finish(tmp_path / "run", setup, "old")

    def kill(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(f"twin.run.{at}", kill)
        with pytest.raises(Killed):
            finish(path, setup, "new", force=True)
    assert is_whole(path, "old" if at == "durable.put_in_place" else "new")
    finish(path, setup, "newer", resume=True)
    assert is_whole(path, "newer")
    assert [place.name for place in tmp_path.iterdir()] == ["run"]


def test_killed_between_the_change_of_places_and_the_next_name(setup, tmp_path) -> None:
    path = finish(tmp_path / "run", setup, "old")
    work(path, setup, force=True)
    with StudyFolder(path, setup, resume=True) as folder:
        write_manifest(folder, "twin.study", 1.5e9, 1.0)
        assert exchange(path, folder.path)
        folder._working = False
    assert is_run_folder(tmp_path / ".run.next")
    finish(path, setup, "new", resume=True)
    assert is_whole(path, "new")
    assert [place.name for place in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("folder", [RunFolder, StudyFolder])
def test_a_report_that_was_edited_is_its_editors(setup, tmp_path, folder) -> None:
    """It has the name of a file of the study, and other contents."""
    path = finish(tmp_path / "run", setup)
    (path / "report.html").write_text("found, and my notes")
    with pytest.raises(RunFolderError, match=r"did not write: report\.html \(changed since\); "):
        RunFolder(path, force=True) if folder is RunFolder else work(path, setup, force=True)
    with pytest.raises(RunFolderError, match=r"changed since: report\.html; --resume writes them anew"):
        work(path, setup, resume=True)
    assert (path / "report.html").read_text() == "found, and my notes"


def test_what_a_broken_off_end_has_written_is_the_studys(setup, tmp_path) -> None:
    """Killed between the report and the manifest, also of a study that had been finished."""
    path = finish(tmp_path / "run", setup)
    with StudyFolder(path, setup, resume=True) as folder:
        folder.begin_results()
        folder.write("study.csv", b"1,2")
    assert unlisted(path) == []
    (path / "study.csv").write_text("mine")
    (path / "report.html").write_text("mine")
    assert unlisted(path) == ["report.html", "study.csv"]
    with (path / ".written").open("a") as account:
        account.write("half a li")
    with StudyFolder(path, setup, resume=True) as folder:
        folder.write("study.csv", b"3,4")
    assert unlisted(path) == ["report.html"]


@pytest.mark.parametrize("put", ["notes.txt", "chunks/notes.txt", "study.txt", ".notes", "chunks/1.npz.bak"])
def test_force_keeps_what_the_study_did_not_write(setup, tmp_path, put) -> None:
    path = work(tmp_path / "run", setup)
    (path / put).write_text("mine")
    with pytest.raises(RunFolderError, match=rf"did not write: {re.escape(put)}; "):
        work(path, setup, force=True)
    with pytest.raises(RunFolderError, match=rf"did not write: {re.escape(put)}; "):
        RunFolder(path, force=True)
    assert (path / put).read_text() == "mine"


@pytest.mark.parametrize("complete", [False, True])
def test_files_put_there_during_the_study_are_kept(setup, tmp_path, complete) -> None:
    path = finish(tmp_path / "run", setup)
    with StudyFolder(path, setup, force=True) as folder:
        (path / "notes.txt").write_text("mine")
        (path / "report.html").write_text("edited")
        if complete:
            folder.write("report.html", b"new")
            write_manifest(folder, "twin.study", 1.5e9, 1.0)
    assert (path / "notes.txt").read_text() == "mine"
    assert (path / ("report.html.kept" if complete else "report.html")).read_text() == "edited"
    assert (path / "artefacts").exists() != complete
    assert [place.name for place in tmp_path.iterdir()] == ["run"]


def test_a_state_that_is_not_ours(setup, tmp_path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "study.csv").write_text("somebody's")
    for words, options in (("--force does not replace it", {"force": True}), ("nothing to resume", {"resume": True})):
        with pytest.raises(RunFolderError, match=words):
            work(path, setup, **options)
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


SIGMA = "[recovered, cameras, forward, model, d_f_um_sigma]"
DF = f"  df: {{key: [recovered, cameras, forward, model, d_f_um], sigma: {SIGMA}}}\n"
TRUE = "  true_df: {key: [truth, cameras, forward, d_f_um]}\n"


def test_words_may_be_others_when_a_study_is_gone_on_with(setup, tmp_path) -> None:
    """Names, units and what the report shows change no run."""
    path = work(tmp_path / "run", setup)
    more = ("name: study", "name: renamed\ndescription: all of it\nreport: {sobol: true}\nlimits: {runs: 999}")
    unit = (TRUE, "  is: {key: [truth, cameras, forward, d_f_um], unit: mm}\n")
    words = resolve_study(write_study(tmp_path / "words", more, unit))
    assert words.content == setup.content
    work(path, words, resume=True)


@pytest.mark.parametrize("change", [(f"{DF}{TRUE}", f"{TRUE}{DF}"), ("seed: 3", "seed: 4"), (f", sigma: {SIGMA}", "")])
def test_what_makes_other_numbers_may_not(setup, tmp_path, change) -> None:
    """Also responses in another order: a chunk keeps them by their places."""
    path = work(tmp_path / "run", setup)
    other = resolve_study(write_study(tmp_path / "other", change))
    with pytest.raises(RunFolderError, match="holds another study"):
        work(path, other, resume=True)


def test_a_file_and_a_folder_in_use_are_no_place_for_a_study(setup, tmp_path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunFolderError, match="exists and is not a folder"):
        work(tmp_path / "file", setup)
    with (
        StudyFolder(tmp_path / "run", setup),
        pytest.raises(RunFolderError, match=r"another command is working in .*run; wait"),
    ):
        work(tmp_path / "run", setup, resume=True)
