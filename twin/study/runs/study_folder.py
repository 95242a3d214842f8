"""The folder of a study: it grows while the study runs, and belongs to one command at a time."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TextIO

from pydantic import BaseModel, ConfigDict, ValidationError

from twin.run.run_folder import (
    MANIFEST,
    NAMED,
    STUDY_LOCK,
    STUDY_STATE,
    Numbered,
    RunFolderError,
    refuse_others,
    remove_replaced,
    remove_run,
    remove_study,
    unlisted,
)
from twin.run.unfinished import OLD, Unfinished, sweep
from twin.run.versions import sources, versions
from twin.study.runs.chunk_store import FOLDER, INDEX, write_safely
from twin.study.runs.setup import StudySetup

PROGRAM = "twin.study"


class StudyState(BaseModel):
    """What the folder of a study says of it from its beginning.

    Attributes:
        program: PROGRAM.
        name: of the study.
        fingerprint: of all that its numbers depend on.
        content: of these, its factors, design and base.
        versions: of the packages that compute.
        sources: source files of the program that computes -> checksum.
    """

    model_config = ConfigDict(strict=True, frozen=True)

    program: Literal["twin.study"]
    name: str
    fingerprint: str
    content: str
    versions: dict[str, str]
    sources: dict[str, str]

    @classmethod
    def of(cls, setup: StudySetup) -> StudyState:
        """Of a study run by this program."""
        return cls(
            program="twin.study",
            name=setup.study.name,
            fingerprint=setup.fingerprint,
            content=setup.content,
            versions=versions(),
            sources=sources(),
        )


def _differences(
    before: Mapping[str, str], now: Mapping[str, str], message: Callable[[str, str, str], str]
) -> list[str]:
    names = sorted({*before, *now})
    pairs = [(name, before.get(name, "not there"), now.get(name, "not there")) for name in names]
    return [message(name, old, new) for name, old, new in pairs if old != new]


class StudyFolder:
    """Context manager that makes or takes up the folder of a study and keeps other commands out of it.

    What stands in it stays when the command is broken off, for --resume. The lock is the operating system's and ends
    with the process, however it ends.

    Args:
        path: of the folder. Of several studies that start together with the same ``Numbered``, each gets a number of
            its own.
        setup: the study.
        resume: go on with what is there.
        force: replace what is there.

    Raises:
        RunFolderError: on entering; the folder exists, belongs to another study or to a running command, holds files
            that it is not to lose, or cannot be made.
    """

    def __init__(self, path: Path | Numbered, setup: StudySetup, resume: bool = False, force: bool = False) -> None:
        self._numbered = path if isinstance(path, Numbered) else None
        self.path = path.free() if isinstance(path, Numbered) else path
        self.setup, self.resume, self.force = setup, resume, force
        self._locks: list[TextIO] = []
        self._aside: Unfinished | None = None
        self._fresh = False

    def __enter__(self) -> StudyFolder:
        """Make the folder or take it up, and lock it."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            sweep(self.path.parent, remove_replaced)
            if self._numbered is None:
                self._check()
            if self._numbered is None and self.path.exists():
                self._take_lock()
                if self.force and not self.resume:
                    self._aside = Unfinished(self.path)
                    self.path.rename(self._aside.path(OLD))
            if self._numbered is not None or not self.path.exists():
                self._make()
                self._take_lock()
            if (self.path / STUDY_STATE).exists():
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
        nothing_done = self._fresh and not (self.path / FOLDER / INDEX).exists() and not self.complete
        if nothing_done:
            remove_study(self.path)
        if self._aside is not None:
            old = self._aside.path(OLD)
            if old.exists() and self.path.exists() and not nothing_done:
                remove_run(old, self.path)
            elif old.exists():
                if self.path.exists():  # what somebody put there meanwhile
                    remove_run(self.path, old)
                old.rename(self.path)
            self._aside.close()
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
        if not any(path.name != STUDY_LOCK for path in self.path.iterdir()):
            return
        others = unlisted(self.path)
        if self.resume:
            if not (self.path / STUDY_STATE).exists():
                raise RunFolderError(f"{self.path} is not the folder of a study, so there is nothing to resume")
        elif not self.force:
            also = ", go on with it with --resume," if (self.path / STUDY_STATE).exists() else ""
            raise RunFolderError(
                f"output folder {self.path} exists; choose another with --out{also} or replace it with --force"
            )
        elif others is None:
            raise RunFolderError(
                f"output folder {self.path} is not the folder of a study or run, so --force does not replace it; "
                "choose another with --out"
            )
        else:
            refuse_others(self.path, others)

    def _make(self) -> None:
        """Make the folder; of several commands only one can."""
        while True:
            try:
                self.path.mkdir()
                return
            except FileExistsError:
                if self._numbered is None:
                    raise
                self.path = self._numbered.free()

    def _take_lock(self) -> None:
        lock = (self.path / STUDY_LOCK).open("a+", encoding="utf-8")
        self._locks.append(lock)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunFolderError(f"another command is working in {self.path}; wait until it has ended") from None

    def _check_identity(self) -> None:
        """Refuse to go on with what another study, or another program, has begun: their numbers do not mix."""
        try:
            found = StudyState.model_validate_json((self.path / STUDY_STATE).read_bytes())
        except ValidationError:
            text = f"{self.path / STUDY_STATE} cannot be read, or is of an older version; start again with --force"
            raise RunFolderError(text) from None
        own = StudyState.of(self.setup)
        remedy = "start again in another folder with --out, or replace this one with --force"
        if found.content != own.content:
            text = f"{self.path} holds another study: its factors, design or base differ; {remedy}"
            raise RunFolderError(text)
        changed = [
            *_differences(found.versions, own.versions, lambda name, old, new: f"{name} was {old} and is {new}"),
            *_differences(found.sources, own.sources, lambda name, old, new: name),
        ]
        if changed or found.fingerprint != own.fingerprint:
            named = ", ".join(changed[:NAMED]) + (f" and {len(changed) - NAMED} more" if len(changed) > NAMED else "")
            raise RunFolderError(
                f"{self.path} was begun with another version of the program, whose numbers would stand beside new ones "
                f"(changed: {named}); go on with the program as it was, or {remedy}"
            )

    def _begin(self) -> None:
        self.write("config.yaml", self.setup.to_yaml().encode())
        self.write(STUDY_STATE, (StudyState.of(self.setup).model_dump_json(indent=2) + "\n").encode())

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
