"""The old run or the new one stands, never neither: on a full disk, at signals, and when the power fails."""

import errno
import os
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from tests.twin.replacing import FILES, Moments, replace_run, standing
from tests.twin.study_bench import ROOT
from twin.framework.run_folder import RunFolderError


def hidden(place: Path) -> set[str]:
    return {path.name for path in place.iterdir()} - {"run", "lost+found"}


def test_a_disk_that_fails_at_any_step(tmp_path) -> None:
    """No room left from some step on, at a few of all steps by default; then room again."""
    place = tmp_path / "disk"
    place.mkdir()
    replace, target = replace_run, place / "run"
    full = [False]

    def fail() -> None:
        full[0] = True
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    moments = Moments(place, 0, fail)
    try:
        replace(target, "0", 0.01)
        moments.armed = True
        replace(target, "1", 0.01)
        moments.armed = False
        steps = moments.count
        assert steps > 2 * FILES
        for moment in np.linspace(1, steps, 14).astype(int):
            before = standing(target)
            moments.count, moments.at, moments.armed = 0, int(moment), True
            with suppress(RunFolderError, OSError):
                replace(target, f"new {moment}", 0.01)
            moments.armed = False
            assert standing(target) in (before, f"new {moment}"), moment
            moments.at = 0
    finally:
        moments.end()
    replace(target, "last", 0.01)
    assert standing(target) == "last"
    assert hidden(place) == set()


def begin(target: Path, stem: str, megabytes: float, moment: int, number: int) -> subprocess.CompletedProcess:
    words = ["-m", "tests.twin.replacing", str(target), stem, str(megabytes), str(moment), str(number)]
    return subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.second
def test_signals_at_three_moments(tmp_path) -> None:
    """A signal each at the begin, the middle and the end of a command's steps on the disk."""
    place = tmp_path / "disk"
    place.mkdir()
    target = place / "run"
    replace_run(target, "old", 0.1)
    steps = int(begin(target, "again", 0.1, 0, 0).stdout)
    moments = np.linspace(1, 0.9 * steps, 3).astype(int).tolist()  # the number of steps varies a little
    for moment, number in zip(moments, (signal.SIGTERM, signal.SIGHUP, signal.SIGKILL), strict=True):
        before = standing(target)
        done = begin(target, f"new {moment}", 0.1, moment, number)
        assert done.returncode != 0, done.stderr
        assert standing(target) in (before, f"new {moment}"), (moment, done.stderr)
        if number != signal.SIGKILL:
            assert hidden(place) == set(), (moment, done.stderr)
    replace_run(target, "last", 0.1)
    assert standing(target) == "last"
    assert hidden(place) == set()


@contextmanager
def mounted(*words: str, at: Path):
    """A file system of its own; skipped where that is not allowed."""
    at.mkdir(exist_ok=True)
    done = subprocess.run(["mount", *words, str(at)], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"nothing can be mounted here: {done.stderr.strip()}")
    try:
        yield at
    finally:
        subprocess.run(["umount", str(at)], check=True)
