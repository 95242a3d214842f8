"""Processes of a study that are killed: at the end every byte is as if nothing had happened."""

import os
import signal

import pytest

from tests.twin.study_bench import alive, children, chunks, same_bytes, start, wait_for, write_study


@pytest.mark.second
def test_killed_workers_and_commands_lose_nothing(tmp_path) -> None:
    """A worker is killed and replaced, then the command itself; gone on with, every byte is as if nobody had killed."""
    path = write_study(tmp_path, ("runs: 100", "runs: 300"))
    folder, whole = tmp_path / "run", tmp_path / "whole"
    process = start(path, "--out", folder, "--workers", 2)
    try:
        wait_for(lambda: chunks(folder) >= 2)
        below = children(process.pid)
        assert len(below) == 2
        os.kill(below[0], signal.SIGKILL)
        wait_for(lambda: chunks(folder) >= 4)
        below = children(process.pid)
        assert process.poll() is None
        process.kill()
        process.wait(10)
        # workers notice that the command is gone
        wait_for(lambda: not any(alive(pid) for pid in below), 30.0)
    finally:
        process.kill()
        process.communicate()
    assert not (folder / "study.nc").exists()
    for out, options in ((folder, ["--resume"]), (whole, [])):
        done = start(path, "--out", out, "--workers", 2, "--quiet", *options)
        errors = done.communicate(timeout=180)[1]  # a warning of memory, where others use it
        assert done.returncode == 0, errors
    assert same_bytes(folder) == same_bytes(whole)
    assert not [*(folder / "chunks").glob("*.partial"), *(folder / "chunks").glob("*.corrupt")]
