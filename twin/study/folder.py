"""The folder of a study: it grows while the study runs, and belongs to one command at a time."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import secrets
import shutil
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from twin.run_folder import MANIFEST, RunFolderError, is_run_folder
from twin.study.chunk_store import FOLDER, INDEX
from twin.study.safe_file import write_safely
from twin.study.setup import StudySetup

IDENTITY = "study_state.json"
"""Says which study a folder belongs to, from the beginning; the manifest is written at the end."""
LOCK = ".lock"
PROGRAM = "twin.study"


class StudyFolder:
    """Context manager that makes or takes up the folder of a study and keeps other commands out of it.

    What stands in it stays when the command is broken off, for --resume. The lock is the operating system's and ends
    with the process, however it ends.

    Args:
        path: of the folder.
        setup: the study.
        resume: go on with what is there.
        force: replace what is there.

    Raises:
        RunFolderError: on entering; the folder exists, belongs to another study or to a running command, or cannot be
            made.
    """

    def __init__(self, path: Path, setup: StudySetup, resume: bool = False, force: bool = False) -> None:
        self.path, self.setup, self.resume, self.force = path, setup, resume, force
        self._locks: list[TextIO] = []
        self._aside: Path | None = None
        self._fresh = False

    def __enter__(self) -> StudyFolder:
        """Make the folder or take it up, and lock it."""
        try:
            self._check()
            if self.path.exists():
                self._take_lock()
                if self.force and not self.resume:
                    self._aside = self.path.with_name(f".{self.path.name}.{secrets.token_hex(4)}.old")
                    self.path.rename(self._aside)
            if not self.path.exists():
                self.path.mkdir(parents=True)
                self._take_lock()
            if (self.path / IDENTITY).exists():
                self._check_identity()
            else:
                self._fresh = True
                self._begin()
        except BaseException as error:
            self._leave()
            if isinstance(error, OSError):
                reason = os.strerror(error.errno) if error.errno else str(error)
                raise RunFolderError(f"cannot use the folder {self.path}: {reason}") from error
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Unlock; when nothing has been done, also remove the folder again, or put back what it was to replace."""
        self._leave()

    def _leave(self) -> None:
        if self._fresh and not (self.path / FOLDER / INDEX).exists() and not self.complete:
            shutil.rmtree(self.path, ignore_errors=True)
            if self._aside is not None:
                self._aside.rename(self.path)
        elif self._aside is not None:
            shutil.rmtree(self._aside, ignore_errors=True)
        self._aside = None
        for lock in self._locks:
            lock.close()
        self._locks = []

    @property
    def complete(self) -> bool:
        """Whether the study has been finished."""
        return (self.path / MANIFEST).exists()

    def _check(self) -> None:
        if not (self.path.exists() or self.path.is_symlink()):
            return
        if not self.path.is_dir():
            raise RunFolderError(f"output {self.path} exists and is not a folder; choose another with --out")
        if not any(path.name != LOCK for path in self.path.iterdir()):
            return
        ours = (self.path / IDENTITY).exists() or is_run_folder(self.path)
        if self.resume:
            if not (self.path / IDENTITY).exists():
                raise RunFolderError(f"{self.path} is not the folder of a study, so there is nothing to resume")
        elif not self.force:
            also = ", go on with it with --resume," if (self.path / IDENTITY).exists() else ""
            raise RunFolderError(
                f"output folder {self.path} exists; choose another with --out{also} or replace it with --force"
            )
        elif not ours:
            raise RunFolderError(
                f"output folder {self.path} is not the folder of a study or run, so --force does not replace it; "
                "choose another with --out"
            )

    def _take_lock(self) -> None:
        lock = (self.path / LOCK).open("a+", encoding="utf-8")
        self._locks.append(lock)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunFolderError(f"another command is working in {self.path}; wait until it has ended") from None

    def _check_identity(self) -> None:
        try:
            found = json.loads((self.path / IDENTITY).read_text("utf-8"))["fingerprint"]
        except (ValueError, KeyError, TypeError):
            raise RunFolderError(f"{self.path / IDENTITY} cannot be read; start again with --force") from None
        if found != self.setup.fingerprint:
            raise RunFolderError(
                f"{self.path} holds another study: its factors, design, base or the program's versions differ; "
                "choose another folder with --out, or replace it with --force"
            )

    def _begin(self) -> None:
        self.write("config.yaml", self.setup.to_yaml().encode())
        facts = {"program": PROGRAM, "name": self.setup.study.name, "fingerprint": self.setup.fingerprint}
        self.write(IDENTITY, (json.dumps(facts, indent=2) + "\n").encode())

    def write(self, name: str, content: bytes) -> None:
        """Write a file so that under its name it is whole or not there."""
        write_safely(self.path / name, content)

    def write_json(self, name: str, data: Any) -> None:
        """Write plain data."""
        self.write(name, (json.dumps(data, indent=2, allow_nan=False) + "\n").encode())

    def checksums(self) -> dict[str, str]:
        """SHA-256 of every file of the result; chunks have their own in their index."""
        out = {}
        for file in sorted(self.path.rglob("*")):
            name = file.relative_to(self.path).as_posix()
            inside = name.split("/")[0] == FOLDER or file.name.startswith(".") or name == MANIFEST
            if file.is_file() and not inside:
                out[name] = hashlib.sha256(file.read_bytes()).hexdigest()
        return out
