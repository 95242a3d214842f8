"""A process that replaces a run in a folder with ``--force`` and is hit at a moment of its writing.

    python -m tests.twin.replacing TARGET STEM MEGABYTES MOMENT SIGNAL

The new one holds STEM in which.txt. At its MOMENT-th step on the disk, counted from 1, the process
gets SIGNAL; 0 for none, and then it prints how many steps there were. It writes as the commands do, what they would
compute at great length aside.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

from twin.framework.durable import exit_on_terminate
from twin.framework.run_folder import RunFolder, is_run_folder, read_manifest, unlisted, write_manifest

STEPS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "ctypes.dlopen", "os.listdir")
FILES = 24


class Moments:
    """Counts the steps of this process on the disk and does something at one of them; while ``armed``.

    Args:
        place: steps elsewhere do not count.
        at: number of the step, 0 for none.
        act: what is done then, before the step.
    """

    def __init__(self, place: Path, at: int, act) -> None:
        self.place, self.at, self.act = str(place), at, act
        self.count, self.armed = 0, False
        self._lock = threading.Lock()
        sys.addaudithook(self._hear)
        self._sync, os.fsync = os.fsync, self._fsync

    def _hear(self, event: str, args: tuple) -> None:
        if self.armed and event in STEPS:
            named = args[0] if args else ""
            if event == "ctypes.dlopen" or (isinstance(named, str | os.PathLike) and self.place in os.fspath(named)):
                self._step()

    def _fsync(self, file: int) -> None:
        if self.armed:
            self._step()
        self._sync(file)

    def _step(self) -> None:
        with self._lock:
            self.count += 1
            now = self.count == self.at
        if now:
            self.act()

    def end(self) -> None:
        """Count no more."""
        self.armed, os.fsync = False, self._sync


def contents(stem: str, megabytes: float) -> dict[str, bytes]:
    """Files of a run, the largest half of all."""
    size = int(megabytes * 0.5e6)
    rest = max(1, size // FILES)
    out = {f"artefacts/part{k}.bin": os.urandom(rest) for k in range(FILES)}
    return {**out, "which.txt": stem.encode(), "frames.bin": os.urandom(size)}


def replace_run(target: Path, stem: str, megabytes: float) -> None:
    """As render, design and uncertainty do."""
    with exit_on_terminate(), RunFolder(target, force=True) as folder:
        for name, content in contents(stem, megabytes).items():
            folder.write_bytes(name, content)
        write_manifest(folder, "twin.test", 1.5e9, 1.0)


def standing(target: Path) -> str | None:
    """What which.txt says of the run at the target, if it is whole: every listed file with its checksum; else None."""
    manifest = read_manifest(target)
    if manifest is None or not is_run_folder(target) or unlisted(target) != []:
        return None
    if not all((target / name).is_file() for name in manifest.sha256):
        return None
    return (target / "which.txt").read_text("utf-8")


def main() -> None:
    """See above."""
    target, stem, megabytes, at, number = sys.argv[1:]
    place = Path(target)
    moments = Moments(place.parent, int(at), lambda: os.kill(os.getpid(), int(number)))
    moments.armed = True
    replace_run(place, stem, float(megabytes))
    moments.end()
    sys.stdout.write(f"{moments.count}\n")


if __name__ == "__main__":
    main()
