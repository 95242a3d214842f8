"""What commands keep beside their run folder: whose it is, and that nothing of anybody else goes."""

from __future__ import annotations

from pathlib import Path

import pytest

from twin.run.durable import write_safely
from twin.run.kept_work import KeptWork
from twin.run.run_folder import RunFolderError


def chunk(place: Path) -> Path:
    """Write what a run of the engine keeps."""
    file = place / "samples" / "chunks" / "00000.npz"
    file.parent.mkdir(parents=True, exist_ok=True)
    (file.parent / "index.txt").write_text("00000.npz\n")
    file.write_bytes(b"numbers")
    return file


def test_a_folder_of_the_user_is_refused_and_stays(tmp_path: Path) -> None:
    """A folder of that name that holds anything else is not touched, also with --resume and beside work of ours."""
    own = tmp_path / "out.samples" / "chunks" / "index.txt"
    own.parent.mkdir(parents=True)
    own.write_text("my own data")
    for resume in (False, True):
        with (
            KeptWork(tmp_path / "out", "out", "samples", resume) as kept,
            pytest.raises(RunFolderError, match=r"files that this program did not write: chunks/index\.txt"),
        ):
            kept.begin()
    assert own.read_text() == "my own data"
    (tmp_path / "x.samples").write_text("a file")
    for place, said in (("x", "is in the way"), ("x.samples/below", "cannot use .*: Not a directory")):
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
    write_safely(tmp_path / "a.html", b"whole")
    assert (mine.read_text(), (tmp_path / "a.html").read_bytes()) == ("mine", b"whole")
