"""The old run or the new one stands, never neither: on a full disk, at signals, and when the power fails."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from tests.tiers import quick
from tests.twin.replacing import FILES, Moments, replace_run, replace_study, standing
from tests.twin.study_bench import ROOT, write_study
from twin.run.run_folder import RunFolderError

REPLACE = {"run": replace_run, "study": replace_study}
OLD_MB = NEW_MB = 4.0


@pytest.fixture(autouse=True)
def study_file(tmp_path_factory, monkeypatch) -> None:
    monkeypatch.setenv("TWIN_STUDY", str(write_study(tmp_path_factory.mktemp("in"))))


def hidden(place: Path) -> set[str]:
    return {path.name for path in place.iterdir()} - {"run", "lost+found"}


@pytest.mark.parametrize("kind", quick(1, REPLACE))
def test_a_disk_that_fails_at_any_step(tmp_path, kind) -> None:
    """No room left from some step on, at a few of all steps by default; then room again."""
    place = tmp_path / "disk"
    place.mkdir()
    replace, target = REPLACE[kind], place / "run"
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
        for moment in np.linspace(1, steps, 14 if kind == "run" else 6).astype(int):
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


class Written:
    """Which files and folders below a place have been written since they were last written through."""

    def __init__(self, place: Path) -> None:
        self.place, self.unsynced, self.heard = str(place), set(), []
        self._sync, self._on, self._one = os.fsync, True, threading.RLock()
        sys.addaudithook(self._hear)
        os.fsync = self._fsync

    def _hear(self, event: str, args: tuple) -> None:
        if not self._on or not args or not isinstance(args[0], str | os.PathLike):
            return
        name = os.fspath(args[0])
        if not name.startswith(self.place):
            return
        with self._one:
            self._take(event, name, args)

    def _take(self, event: str, name: str, args: tuple) -> None:
        if event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR):
            self.unsynced |= {name} if os.path.exists(name) else {name, os.path.dirname(name)}
        elif event == "os.mkdir":
            self.unsynced |= {name, os.path.dirname(name)}
        elif event == "os.rename":
            new = os.fspath(args[1])
            # what is given a name that counts, and what is not yet on the disk of it
            if not os.path.basename(new).startswith("."):
                left = {n for n in self.unsynced if n == name or n.startswith(f"{name}/")}
                self.heard.append((new, {n for n in left if os.path.exists(n)}))
            moved = {n for n in self.unsynced if n == name or n.startswith(f"{name}/")}
            self.unsynced = (self.unsynced - moved) | {new + n[len(name) :] for n in moved} | {os.path.dirname(new)}

    def _fsync(self, file: int) -> None:
        self._sync(file)
        with self._one:
            self.unsynced.discard(os.readlink(f"/proc/self/fd/{file}"))

    def end(self) -> None:
        self._on, os.fsync = False, self._sync


@pytest.mark.parametrize("kind", REPLACE)
def test_what_gets_a_name_is_on_the_disk(tmp_path, kind, monkeypatch) -> None:
    """An audit of fsync: a run folder with all below it and every file of a study are written through first."""
    # what changes places in one step is not heard of; by way of a third name it is
    monkeypatch.setattr("twin.run.durable.exchange", lambda first, second: False)
    written = Written(tmp_path)
    try:
        for stem in ("first", "second"):
            REPLACE[kind](tmp_path / "run", stem, 0.01)
    finally:
        written.end()
    assert standing(tmp_path / "run") == "second"
    names = [os.path.basename(new) for new, _ in written.heard]
    assert names.count("run") >= (2 if kind == "run" else 1)
    if kind == "study":
        assert names.count("manifest.json") == 2
        assert "index.txt" not in {os.path.basename(name) for name in written.unsynced}
    for new, left in written.heard:
        # a lock says nothing, and an account is written through line by line
        assert {name for name in left if os.path.basename(name) not in (".lock",)} == set(), new
    assert str(tmp_path) not in written.unsynced


def begin(
    kind: str, target: Path, stem: str, megabytes: float, moment: int, number: int
) -> subprocess.CompletedProcess:
    words = ["-m", "tests.twin.replacing", kind, str(target), stem, str(megabytes), str(moment), str(number)]
    return subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
@pytest.mark.parametrize("kind", REPLACE)
def test_signals_at_ten_moments(tmp_path, kind, number) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    target = place / "run"
    REPLACE[kind](target, "old", 0.1)
    steps = int(begin(kind, target, "again", 0.1, 0, 0).stdout)
    for moment in np.linspace(1, steps, 10).astype(int):
        before = standing(target)
        done = begin(kind, target, f"new {moment}", 0.1, int(moment), number)
        assert done.returncode != 0, done.stderr
        assert standing(target) in (before, f"new {moment}"), (moment, done.stderr)
        if number != signal.SIGKILL and kind == "run":
            assert hidden(place) == set(), (moment, done.stderr)
    REPLACE[kind](target, "last", 0.1)
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


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root")
@pytest.mark.parametrize("kind", REPLACE)
def test_a_full_disk_at_ten_levels(tmp_path, kind) -> None:
    """A file system with room for the old run and some tenths of the new one."""
    seen = []
    for tenths in range(10):
        size = int(1e6 * (1.02 * OLD_MB + 0.1 * tenths * 1.02 * NEW_MB + 0.3))
        with mounted("-t", "tmpfs", "-o", f"size={size}", "tmpfs", at=tmp_path / f"disk{tenths}") as place:
            REPLACE[kind](place / "run", "old", OLD_MB)
            done = begin(kind, place / "run", "new", NEW_MB, 0, 0)
            seen.append(standing(place / "run"))
            assert seen[-1] in ("old", "new"), done.stderr
            assert (done.returncode == 0) == (seen[-1] == "new"), done.stderr
            if kind == "run" or seen[-1] == "new":
                assert hidden(place) == set()
    assert seen[:8] == ["old"] * 8


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mkfs.ext4") is None, reason="needs root and ext4")
@pytest.mark.parametrize("kind", REPLACE)
def test_a_power_cut(tmp_path, kind) -> None:
    """What has reached the disk of a file system at twenty moments: a copy of the device, whose journal is played back.
    ext4 is told not to write through by itself what is renamed.
    """
    device = tmp_path / "device"
    with device.open("wb") as file:
        file.truncate(64 << 20)
    subprocess.run(["mkfs.ext4", "-q", "-F", str(device)], check=True)
    rng, seen = np.random.default_rng(5), []
    options = ["-o", "loop,noauto_da_alloc,commit=300"]
    with mounted(*options, str(device), at=tmp_path / "disk") as place:
        REPLACE[kind](place / "run", "0", 1.0)
        os.sync()
        for n in range(1, 21):
            words = ["-m", "tests.twin.replacing", kind, str(place / "run"), str(n), "1.0", "0", "0"]
            process = subprocess.Popen([sys.executable, *words], cwd=ROOT, stdout=subprocess.DEVNULL)
            # every other time just after both have changed places, which is not yet on the disk then, or is
            begun, inode = {path.name for path in place.iterdir()}, (place / "run").stat().st_ino
            if n % 2:
                while process.poll() is None and {path.name for path in place.iterdir()} == begun:
                    time.sleep(0.001)
                time.sleep(rng.uniform(0.0, 0.25))
            else:
                while process.poll() is None and (place / "run").stat().st_ino == inode:
                    time.sleep(0.0005)
                time.sleep(rng.uniform(0.0, 0.02))
            # held, and what it has begun to write through let to its end: a copy is of one moment
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.1)
            copy = tmp_path / "copy"
            shutil.copyfile(device, copy)
            process.send_signal(signal.SIGCONT)
            process.wait()
            with mounted("-o", "loop", str(copy), at=tmp_path / "after") as after:
                found = standing(after / "run")
                assert found in (str(n - 1), str(n)), (n, [p.name for p in after.iterdir()])
                for other in (*after.glob(".run.*.partial"), *after.glob(".run.next")):
                    if (other / "manifest.json").exists():  # what is not being removed and has a manifest is whole
                        assert standing(other) is not None, other
                seen.append(found == str(n))
    sys.stdout.write(f"{sum(seen)} of {len(seen)} with the new run\n")
    assert 0 < sum(seen) < len(seen)


def start(words: str, target: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", *words.split(), "--out", str(target), "--force", "--quiet"]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


COMMANDS = {
    "render": "twin.render tests/golden/jobs/perturb.yaml",
    "design": "twin.design tests/golden/jobs/design.yaml",
    "uncertainty": "twin.uncertainty gf7_pair --states 4",
    "study": "twin.study {study} --workers 1",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_whole_commands(tmp_path, name) -> None:
    """Each signal at two moments of a command from its start to its end, and a full disk where root may make one."""
    words, place = COMMANDS[name].format(study=os.environ["TWIN_STUDY"]), tmp_path / "disk"
    place.mkdir()
    target = place / "run"
    begun = time.monotonic()
    first = start(words, target)
    _, errors = first.communicate(timeout=600)
    assert first.returncode == 0, errors
    seconds = time.monotonic() - begun
    old = (target / "manifest.json").read_bytes()
    rng = np.random.default_rng(len(name))
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGKILL):
        for part in (rng.uniform(0.2, 0.7), rng.uniform(0.7, 1.0)):
            process = start(words, target)
            time.sleep(part * seconds)
            process.send_signal(number)
            _, errors = process.communicate(timeout=600)
            assert whole(target), (number, part, errors)
            assert process.returncode == 0 or (target / "manifest.json").read_bytes() == old or "kept" not in errors
            assert "Traceback" not in errors, errors
            old = (target / "manifest.json").read_bytes()
    if os.geteuid() == 0:
        size = sum(path.stat().st_size for path in target.rglob("*")) + 4096 * len(list(target.rglob("*")))
        with mounted("-t", "tmpfs", "-o", f"size={int(1.5 * size)}", "tmpfs", at=tmp_path / "small") as small:
            shutil.copytree(target, small / "run")
            process = start(words, small / "run")
            _, errors = process.communicate(timeout=600)
            assert process.returncode != 0
            assert "No space left on device" in errors, errors
            assert (small / "run" / "manifest.json").read_bytes() == old
            assert whole(small / "run")


def whole(target: Path) -> bool:
    from twin.run.run_folder import read_manifest, unlisted

    manifest = read_manifest(target)
    there = manifest is not None and all((target / name).is_file() for name in manifest.sha256)
    return there and unlisted(target) == []
