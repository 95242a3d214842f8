"""A run folder appears whole or not at all."""

import hashlib
import json
import os
import re
import resource
import signal
import stat
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.twin.study_bench import ROOT
from twin.framework import durable, run_folder
from twin.framework.durable import MANIFEST, PARTIAL, make_unfinished
from twin.framework.provenance import versions
from twin.framework.run_folder import KeptWork, Numbered, RunFolder, RunFolderError, is_run_folder


def everything(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def a_run(target: Path, text: str = "first", force: bool = False) -> Path:
    with RunFolder(target, force) as folder:
        folder.write_text("a/b.txt", text)
        write_manifest(folder)
    return target


def write_manifest(folder: RunFolder, **other: object) -> None:
    times = {"started_unix_s": 1.5e9, "wall_time_s": 1.0}
    sums = folder.checksums()
    folder.write_json(MANIFEST, {"program": "twin.test", "versions": versions(), **times, "sha256": sums, **other})


def test_a_manifest_refuses_what_it_does_not_know(tmp_path):
    with pytest.raises(ValueError, match="colour, size"), RunFolder(tmp_path / "run") as folder:
        run_folder.write_manifest(folder, "twin.test", 1.5e9, 2.0, seed=3, size=1, colour="red")
    assert everything(tmp_path) == set()


def test_files_appear_at_the_end_and_all_at_once(tmp_path):
    target = tmp_path / "run"
    with RunFolder(target) as folder:
        folder.write_text("text.txt", "ä\n")
        folder.write_json("deep/down/data.json", {"x": [1.5, None]})
        folder.write_with("deep/array.npy", lambda place: np.save(place, np.arange(3)))
        assert not target.exists()
        assert folder.path.parent == tmp_path  # the same file system, so that the rename is one step
        sums = folder.checksums()
    assert everything(tmp_path) == {
        "run",
        "run/text.txt",
        "run/deep",
        "run/deep/array.npy",
        "run/deep/down",
        "run/deep/down/data.json",
    }
    assert set(sums) == {"text.txt", "deep/array.npy", "deep/down/data.json"}
    for name, digest in sums.items():
        assert hashlib.sha256((target / name).read_bytes()).hexdigest() == digest
    assert (target / "text.txt").read_text("utf-8") == "ä\n"
    assert json.loads((target / "deep/down/data.json").read_text()) == {"x": [1.5, None]}


def test_permissions_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        target = a_run(tmp_path / "run")
    finally:
        os.umask(before)
    assert stat.S_IMODE(target.stat().st_mode) == 0o750


def break_off(folder: RunFolder, error: BaseException, act=lambda: None) -> None:
    """Write a file, do something else, and fail."""
    with folder:
        folder.write_text("a/b.txt", "half")
        act()
        raise error


@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt(), SystemExit(3), MemoryError()])
def test_nothing_stays_when_something_goes_wrong(tmp_path, error):
    with pytest.raises(type(error)):
        break_off(RunFolder(tmp_path / "new" / "deeper" / "run"), error)
    assert everything(tmp_path) == set()


def test_parents_that_others_use_stay(tmp_path):
    with pytest.raises(ValueError, match="x"):
        break_off(RunFolder(tmp_path / "new" / "run"), ValueError("x"), (tmp_path / "new" / "other.txt").touch)
    assert everything(tmp_path) == {"new", "new/other.txt"}


def test_a_failing_disk_is_one_sentence(tmp_path):
    def fail(place: Path) -> None:
        place.write_text("half")
        raise OSError(28, "a page of\nlibrary internals", str(place))

    with (
        pytest.raises(RunFolderError, match=r"^cannot write to .*run: No space left on device; nothing was kept$"),
        RunFolder(tmp_path / "run") as folder,
    ):
        folder.write_with("big.bin", fail)
    assert everything(tmp_path) == set()


@contextmanager
def largest_file(size: int):
    """Files of this process cannot grow beyond ``size``: EFBIG in place of ENOSPC."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


WRITERS = {
    "text": lambda folder, data: folder.write_text("a.txt", "x" * data.nbytes),
    "json": lambda folder, data: folder.write_json("a.json", data.ravel().tolist()),
    "a library": lambda folder, data: folder.write_with("a.csv", lambda place: np.savetxt(place, data)),
    # HDF5 itself must not write to a full disk: closing the file then crashes the process
    "netcdf": lambda folder, data: folder.write_bytes(
        "a.nc", xr.Dataset({"a": (("x", "y"), data)}).to_netcdf(engine="h5netcdf")
    ),
}


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("size", [1000, 100_000])
def test_a_full_disk(tmp_path, writer, size):
    data = np.random.default_rng(1).random((200, 300))
    with (
        pytest.raises(RunFolderError, match=r"cannot write to [^\n]*: File too large; nothing was kept$"),
        largest_file(size),
        RunFolder(tmp_path / "run") as folder,
    ):
        WRITERS[writer](folder, data)
    assert everything(tmp_path) == set()


def test_nan_is_no_json(tmp_path):
    with pytest.raises(ValueError, match="JSON"), RunFolder(tmp_path / "run") as folder:
        folder.write_json("a.json", {"x": float("nan")})
    assert everything(tmp_path) == set()


def test_force_replaces_a_run(tmp_path):
    target = a_run(tmp_path / "run")
    (target / "empty").mkdir()
    a_run(target, "second", force=True)
    assert everything(tmp_path) == {"run", "run/a", "run/a/b.txt", f"run/{MANIFEST}"}
    assert (target / "a/b.txt").read_text() == "second"


def test_force_replaces_an_empty_folder(tmp_path):
    (tmp_path / "run").mkdir()
    a_run(tmp_path / "run", force=True)
    assert is_run_folder(tmp_path / "run")


def test_force_keeps_the_old_run_when_the_new_one_fails(tmp_path):
    target = a_run(tmp_path / "run")
    with pytest.raises(ValueError, match="x"):
        break_off(RunFolder(target, force=True), ValueError("x"))
    assert (target / "a/b.txt").read_text() == "first"
    assert len(list(tmp_path.iterdir())) == 1


def test_force_puts_the_old_run_back_when_the_rename_fails(tmp_path, monkeypatch):
    target = a_run(tmp_path / "run")
    real = os.rename

    def rename(source, end):
        if str(source).endswith(".partial"):
            raise OSError(13, "no")
        real(source, end)

    monkeypatch.setattr(durable, "exchange", lambda first, second: False)
    monkeypatch.setattr(run_folder.os, "rename", rename)
    with pytest.raises(RunFolderError, match="Permission denied"):
        a_run(target, "second", force=True)
    assert (target / "a/b.txt").read_text() == "first"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("put", ["notes.txt", "a/notes.txt", "deep/er/notes.txt", ".hidden"])
def test_force_keeps_what_the_run_did_not_write(tmp_path, put):
    target = a_run(tmp_path / "run")
    (target / put).parent.mkdir(parents=True, exist_ok=True)
    (target / put).write_text("mine")
    with pytest.raises(RunFolderError, match=rf"did not write: {re.escape(put)}; .*--out"):
        RunFolder(target, force=True)
    assert (target / put).read_text() == "mine"
    assert (target / "a/b.txt").read_text() == "first"


def test_a_file_that_was_edited_is_its_editors(tmp_path):
    """It has the name of a file of the run, and other contents; also when it is edited during the run."""
    target = a_run(tmp_path / "run")
    with RunFolder(target, force=True) as folder:
        folder.write_text("a/b.txt", "second")
        write_manifest(folder)
        (target / "a/b.txt").write_text("mine")
    assert (target / "a/b.txt").read_text() == "second"
    assert (target / "a/b.txt.kept").read_text() == "mine"
    (target / "a/b.txt.kept").unlink()
    (target / "a/b.txt").write_text("mine again")
    with pytest.raises(RunFolderError, match=r"did not write: a/b.txt \(changed since\); .*--out"):
        RunFolder(target, force=True)
    assert (target / "a/b.txt").read_text() == "mine again"


def test_files_put_there_during_the_run_are_kept(tmp_path):
    target = a_run(tmp_path / "run")
    with RunFolder(target, force=True) as folder:
        folder.write_text("new.txt", "the run's")
        write_manifest(folder)
        (target / "new.txt").write_text("mine")
        (target / "sub").mkdir()
        (target / "sub" / "late.txt").write_text("mine")
    assert (target / "new.txt").read_text() == "the run's"
    assert (target / "new.txt.kept").read_text() == "mine"
    assert (target / "sub" / "late.txt").read_text() == "mine"
    assert not (target / "a").exists()
    assert everything(tmp_path) == {f"run/{name}" for name in everything(target)} | {"run"}


LOOKS_LIKE = {
    "other program": {"program": "other.tool"},
    "no program": {"program": None},
    "no versions": {"versions": {}},
    "checksums of another kind": {"sha256": ["thesis.txt"]},
    "no checksum": {"sha256": {"thesis.txt": 1}},
    "a path that leaves": {"sha256": {"../thesis.txt": "0" * 64}},
    "an absolute path": {"sha256": {"/thesis.txt": "0" * 64}},
    "a text for a time": {"started_unix_s": "today"},
}


@pytest.mark.parametrize("wrong", LOOKS_LIKE)
def test_a_manifest_that_is_not_ours(tmp_path, wrong):
    with RunFolder(tmp_path / "run") as folder:
        folder.write_text("thesis.txt", "all of it")
        write_manifest(folder, **LOOKS_LIKE[wrong])
    assert not is_run_folder(tmp_path / "run")
    with pytest.raises(RunFolderError, match="is not a run folder"):
        RunFolder(tmp_path / "run", force=True)


@pytest.mark.parametrize(
    "manifest", [None, "", "[]", '{"name": "a web page"}', '{"program": "twin.render", "sha256": {}}', "\xff"]
)
def test_force_replaces_nothing_that_is_not_a_run(tmp_path, manifest):
    """Web applications and browser extensions keep a manifest.json as well."""
    target = tmp_path / "precious"
    target.mkdir()
    (target / "thesis.txt").touch()
    if manifest is not None:
        (target / MANIFEST).write_text(manifest, encoding="latin-1")
    with pytest.raises(RunFolderError, match="is not a run folder"):
        RunFolder(target, force=True)
    assert (target / "thesis.txt").exists()


@pytest.mark.parametrize("force", [False, True])
def test_a_file_or_a_link_in_the_way(tmp_path, force):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(a_run(tmp_path / "run"))
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name in ("file", "link", "dangling"):
        with pytest.raises(RunFolderError, match="is not a folder"):
            RunFolder(tmp_path / name, force)


def test_a_place_that_cannot_be(tmp_path):
    (tmp_path / "file").touch()
    for target in (tmp_path / "file" / "run", tmp_path / ("n" * 300) / "run", tmp_path / ("n" * 250)):
        with pytest.raises(RunFolderError, match=r"^cannot (make|look at) the output folder"), RunFolder(target):
            pytest.fail("the block must not run")
    assert everything(tmp_path) == {"file"}


def test_somebody_else_takes_the_name_meanwhile(tmp_path):
    target = tmp_path / "run"

    def take() -> None:
        target.mkdir()
        (target / "theirs.txt").touch()

    def lose() -> None:
        with RunFolder(target) as folder:
            folder.write_text("a.txt", "mine")
            take()

    with pytest.raises(RunFolderError, match="cannot move the output folder to"):
        lose()
    assert everything(tmp_path) == {"run", "run/theirs.txt"}


def test_the_next_free_number(tmp_path):
    assert Numbered(tmp_path, "job").free() == tmp_path / "job-001"
    (tmp_path / "job-001").mkdir()
    (tmp_path / "job-002").symlink_to(tmp_path / "nowhere")
    assert Numbered(tmp_path, "job").free() == tmp_path / "job-003"


def test_runs_that_start_together_get_a_number_each(tmp_path):
    """All see the same number free when they start; no folder is lost, not even an empty one."""
    runs = [RunFolder(Numbered(tmp_path / "runs", "job")) for _ in range(3)]
    assert {run.target.name for run in runs} == {"job-001"}
    with runs[0] as first, runs[1] as second, runs[2] as third:
        for k, run in enumerate((first, second, third)):
            run.write_text("me.txt", str(k))
        (tmp_path / "runs" / "job-002").mkdir()
    assert sorted(run.target.name for run in runs) == ["job-001", "job-003", "job-004"]
    for k, run in enumerate(runs):
        assert (run.target / "me.txt").read_text() == str(k)
    assert not list((tmp_path / "runs").glob(".*"))


KILLED = """
import os, signal, sys
from pathlib import Path
from twin.framework.run_folder import RunFolder
with RunFolder(Path(sys.argv[1]), force=True) as folder:
    folder.write_text("half.txt", "half")
    {act}
    os.kill(os.getpid(), signal.SIGKILL)
"""


def kill_a_run(target: Path, act: str = "") -> None:
    """Another process that is killed while it makes a run folder."""
    done = subprocess.run([sys.executable, "-c", KILLED.format(act=act), str(target)], cwd=ROOT, timeout=60)
    assert done.returncode == -signal.SIGKILL


@pytest.mark.second
def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path):
    kill_a_run(tmp_path / "other")
    assert [path.suffix for path in tmp_path.iterdir()] == [PARTIAL]
    (tmp_path / ".mine.partial").mkdir()
    (tmp_path / ".mine.01234567.partial").touch()
    a_run(tmp_path / "run")
    assert {path.name for path in tmp_path.iterdir()} == {"run", ".mine.partial", ".mine.01234567.partial"}


@pytest.mark.second
def test_what_a_living_run_has_is_left_alone(tmp_path):
    with RunFolder(tmp_path / "run") as folder:
        folder.write_text("a.txt", "mine")
        a_run(tmp_path / "other")
        # another process sees the lock as well
        code = "import sys; from pathlib import Path; from twin.framework.run_folder import RunFolder\n"
        code += "with RunFolder(Path(sys.argv[1])) as f: f.write_text('x', 'y')"
        subprocess.run([sys.executable, "-c", code, str(tmp_path / "third")], cwd=ROOT, timeout=60, check=True)
    assert (tmp_path / "run" / "a.txt").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"run", "other", "third"}


def test_a_run_that_has_changed_places_with_the_old_one(tmp_path):
    """Killed just after that: what stands under the new one's hidden name is the old one, with what was put there."""
    target = a_run(tmp_path / "run")
    act = "from twin.framework import run_folder as r; (folder.target / 'late.txt').write_text('mine'); "
    act += "r.write_manifest(folder, 'twin.test', 1.0, 1.0); "
    act += "os.rename(folder.path / r._WAITING, folder.path / r.MANIFEST); r.durable.replace_folder("
    kill_a_run(target, act + "folder.path, folder.target)")
    assert everything(target) == {"half.txt", MANIFEST}
    a_run(tmp_path / "other")
    assert everything(target) == {"half.txt", MANIFEST, "late.txt"}
    assert {path.name for path in tmp_path.iterdir()} == {"run", "other"}


def test_folders_that_cannot_change_places_in_one_step(tmp_path, monkeypatch):
    """On a file system that does not know it: by way of a third name. One that is not there is an error."""
    with pytest.raises(FileNotFoundError):
        durable.exchange(tmp_path, tmp_path / "none")
    monkeypatch.setattr(durable, "exchange", lambda first, second: False)
    target = a_run(tmp_path / "run")
    a_run(target, "second", force=True)
    assert (target / "a/b.txt").read_text() == "second"
    assert {path.name for path in tmp_path.iterdir()} == {"run"}


def test_a_complete_run_that_was_not_put_in_its_place_goes_only_if_that_is_taken(tmp_path):
    """Killed just before; nothing is removed while its process lives, or is the last copy of a run."""
    unfinished, lock = make_unfinished(tmp_path / "run")
    a_run(tmp_path / "new").rename(unfinished / "below")
    for path in list((unfinished / "below").iterdir()):
        path.rename(unfinished / path.name)
    (unfinished / "below").rmdir()
    a_run(tmp_path / "run", "second")
    assert unfinished.exists()
    os.close(lock)
    (tmp_path / "run").rename(tmp_path / "away")
    a_run(tmp_path / "other")
    assert unfinished.exists()
    (tmp_path / "away").rename(tmp_path / "run")
    a_run(tmp_path / "third")
    assert {path.name for path in tmp_path.iterdir()} == {"run", "other", "third"}
    assert (tmp_path / "run/a/b.txt").read_text() == "second"


# what commands keep beside their run folder


def chunk(place: Path) -> Path:
    """Write what a run of the engine keeps."""
    file = place / "samples.journal"
    file.write_bytes(b"numbers")
    return file


def test_a_folder_of_the_user_is_refused_and_stays(tmp_path: Path) -> None:
    """A folder of that name that holds anything else is not touched, also with --resume and beside work of ours."""
    own = tmp_path / "out.samples" / "samples.journal"
    own.parent.mkdir(parents=True)
    own.write_text("my own data")
    for resume in (False, True):
        with (
            KeptWork(tmp_path / "out", "out", "samples", resume) as kept,
            pytest.raises(RunFolderError, match=r"files that this program did not write: samples\.journal"),
        ):
            kept.begin()
    assert own.read_text() == "my own data"
    (tmp_path / "x.samples").write_text("a file")
    for place, said in (
        ("x", "is needed for the intermediate results"),
        ("x.samples/below", "cannot use .*: Not a directory"),
    ):
        with KeptWork(tmp_path / place, "x", "samples", False) as kept, pytest.raises(RunFolderError, match=said):
            kept.begin()


def test_what_is_kept_goes_and_a_file_put_there_meanwhile_stays(tmp_path: Path) -> None:
    """The end of a run removes what the run kept; without --resume what a broken run left goes first."""
    with KeptWork(tmp_path / "out", "out", "samples", False) as kept:
        file = chunk(kept.begin())
    with KeptWork(tmp_path / "out", "out", "samples", True) as kept:
        kept.begin()
        assert file.exists()
    with KeptWork(tmp_path / "out", "out", "samples", False) as kept:
        kept.begin()
        assert not file.exists()
        chunk(tmp_path / "out.samples")
        (tmp_path / "out.samples" / "notes.txt").write_text("mine")
        kept.finish()
    assert [path.name for path in (tmp_path / "out.samples").rglob("*")] == ["notes.txt"]
    with KeptWork(tmp_path / "next", "next", "samples", False) as kept:
        chunk(kept.begin())
        kept.finish()
    assert not (tmp_path / "next.samples").exists()


def test_two_commands_of_one_name_do_not_share_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With --out the second command is refused; without, each has a folder of its own, and removes that alone."""
    monkeypatch.chdir(tmp_path)
    with (
        KeptWork(Path("out"), "job", "search", False) as first,
        KeptWork(Path("out"), "job", "search", False) as second,
    ):
        file = chunk(first.begin())
        with pytest.raises(RunFolderError, match="in use by another command"):
            second.begin()
        assert file.exists()
    with KeptWork(None, "job", "search", False) as first, KeptWork(None, "job", "search", False) as second:
        places = first.begin(), second.begin()
        assert [place.as_posix() for place in places] == ["runs/job.search", "runs/job.2.search"]
        file = chunk(places[0])
        second.finish()
        assert file.exists()
        assert not places[1].exists()


def test_a_file_half_written_by_another_process_is_not_taken_over(tmp_path: Path) -> None:
    """Two processes that write one file have hidden names of their own, and a file of the user's is not one of them."""
    mine = tmp_path / ".a.html.partial"
    mine.write_text("mine")
    durable.write_safely(tmp_path / "a.html", b"whole")
    assert (mine.read_text(), (tmp_path / "a.html").read_bytes()) == ("mine", b"whole")
