"""The folder of a study: it grows while the study runs, and belongs to one command at a time."""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, TextIO

from pydantic import BaseModel, ConfigDict, ValidationError

from twin.run import durable, owned_files, run_folder
from twin.run.provenance import sources, versions
from twin.run.run_folder import Numbered, RunFolderError
from twin.study.runs.chunk_store import FOLDER, INDEX
from twin.study.runs.setup import StudySetup

PROGRAM = "twin.study"


class _StudyState(BaseModel):
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
    def of(cls, setup: StudySetup) -> _StudyState:
        """State of a study that this program runs."""
        return cls(
            program="twin.study",
            name=setup.study.name,
            fingerprint=setup.fingerprint,
            content=setup.content,
            versions=versions(),
            sources=sources(),
        )


def _begun(waiting: Path) -> str:
    """Says that a study has been begun that was to replace a folder."""
    return f", and what was begun to replace it is in {waiting}" if waiting.exists() else ""


def _differences(
    before: Mapping[str, str], now: Mapping[str, str], message: Callable[[str, str, str], str]
) -> list[str]:
    names = sorted({*before, *now})
    pairs = [(name, before.get(name, "not there"), now.get(name, "not there")) for name in names]
    return [message(name, old, new) for name, old, new in pairs if old != new]


class StudyFolder:
    """Context manager that makes or takes up the folder of a study and keeps other commands out of it.

    What stands in it stays when the command is broken off, for --resume. The lock is the operating system's and ends
    with the process, however it ends. What it is to replace stands until it is complete: until then it grows beside it
    (`successor`).

    Args:
        target: where the folder shall stand. Of several studies that start together with the same ``Numbered``, each
            gets a number of its own.
        setup: the study.
        resume: go on with what is there.
        force: replace what is there.

    Attributes:
        path: where it is written.

    Raises:
        RunFolderError: on entering; the folder exists, belongs to another study or to a running command, holds files
            that it is not to lose, or cannot be made. On leaving; it is complete and cannot be put in place.
    """

    def __init__(self, target: Path | Numbered, setup: StudySetup, resume: bool = False, force: bool = False) -> None:
        self._numbered = target if isinstance(target, Numbered) else None
        self.target = target.free() if isinstance(target, Numbered) else target
        self.path = self.target
        self.setup, self.resume, self.force = setup, resume, force
        self._locks: list[TextIO] = []
        self._fresh = self._working = False

    def __enter__(self) -> StudyFolder:
        """Make the folder or take it up, and lock it."""
        try:
            durable.make_folders(self.target.parent)
            owned_files.sweep(self.target.parent, run_folder.remove_replaced)
            if self._numbered is None:
                self._choose()
            if self._numbered is not None or not self.path.exists():
                self._make()
                self._fresh = True
            self._take_lock(self.path)
            for left in owned_files.every_file(self.path):
                if re.fullmatch(f"(.*/)?{durable.PARTIAL_NAME}", left):
                    (self.path / left).unlink(missing_ok=True)
            if (self.path / owned_files.STUDY_STATE).exists():
                self._check_identity()
            else:
                self._fresh = True
                self._begin()
            self._working = True
        except BaseException as error:
            self._leave()
            if isinstance(error, OSError):
                raise RunFolderError(f"cannot use the folder {self.target}: {run_folder.reason(error)}") from error
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Unlock; a complete study is put in place, one of which nothing has been done is removed."""
        self._leave()

    def _leave(self) -> None:
        try:
            if self._fresh and not self.resumable:
                owned_files.remove_study(self.path)
            elif self._working and self.complete:
                (self.path / owned_files.WRITTEN).unlink(missing_ok=True)
                if self.path != self.target:
                    self._put_in_place()
        finally:
            for lock in self._locks:
                lock.close()
            self._locks = []

    def _put_in_place(self) -> None:
        try:
            with durable.ending_later():
                if not self.target.exists():
                    self.path.rename(self.target)
                    durable.sync_folder(self.target.parent)
                else:
                    self._check_succession()
                    beside = owned_files.Unfinished(self.target)
                    try:
                        durable.put_in_place(self.path, self.target, beside.path(owned_files.OLD))
                        with suppress(OSError):  # the next run beside it tries again
                            run_folder.remove_run(beside.path(owned_files.OLD), self.target)
                    finally:
                        beside.close()
                (self.target / owned_files.SUCCEEDS).unlink(missing_ok=True)
                self.path = self.target
        except OSError as error:
            text = f"the study is complete in {self.path} and cannot be put in place of {self.target}"
            raise RunFolderError(f"{text}: {run_folder.reason(error)}; try again with --resume") from error

    @property
    def complete(self) -> bool:
        """Whether the study has been finished."""
        return (self.path / owned_files.MANIFEST).exists()

    @property
    def resumable(self) -> bool:
        """Whether --resume has something to go on with."""
        return any(place.exists() for place in (self.path / FOLDER / INDEX, self.path / owned_files.MANIFEST))

    def _choose(self) -> None:
        """Check what is there, and choose where to work: in the target itself, or in what is to take its place."""
        waiting = owned_files.successor(self.target)
        if waiting.exists() and self.target.exists() and owned_files.succeeds(self.target, waiting):
            # killed when the two had just changed places
            run_folder.remove_run(waiting, self.target)
            (self.target / owned_files.SUCCEEDS).unlink(missing_ok=True)
        if waiting.exists() and not (waiting / owned_files.STUDY_STATE).exists():
            # killed before it had begun
            self._take_lock(waiting)
            owned_files.remove_study(waiting)
        if self._only_begun():
            self._take_lock(self.target)
            owned_files.remove_study(self.target)
        there = self._holds_something()
        if not there and not waiting.exists():
            return
        if self.resume:
            self.path = waiting if waiting.exists() else self.target
            self._check_resumed()
        elif not self.force:
            study = waiting.exists() or (self.target / owned_files.STUDY_STATE).exists()
            also = ", go on with it with --resume," if study else ""
            raise RunFolderError(
                f"output folder {self.target} exists{_begun(waiting)}; choose another with --out{also} or replace it "
                "with --force"
            )
        else:
            self._check_replaced(waiting)
            if waiting.exists():
                self._take_lock(waiting)
                # with what its manifest lists, if it was complete and only had to be put in place
                owned_files.remove_files(waiting, {*(run_folder.unlisted(waiting) or ())})
            if there:
                self.path = waiting
        if self.path == waiting and owned_files.is_study(self.target):
            self._take_lock(self.target)

    def _only_begun(self) -> bool:
        """Return whether a study was killed, or the power failed, before its folder said whose it is."""
        names = (owned_files.STUDY_STATE, owned_files.MANIFEST)
        return (
            (self.target / owned_files.WRITTEN).is_file()
            and not any((self.target / name).exists() for name in names)
            and owned_files.foreign_files(self.target, None, study=True) == []
        )

    def _holds_something(self) -> bool:
        """Whether there is anything at the target but a folder with nothing in it."""
        if not (self.target.exists() or self.target.is_symlink()):
            return False
        if not self.target.is_dir():
            raise RunFolderError(f"output {self.target} exists and is not a folder; choose another with --out")
        return any(path.name != owned_files.STUDY_LOCK for path in self.target.iterdir())

    def _check_resumed(self) -> None:
        """What is gone on with must be a study's, and its results as it wrote them, for they are written anew."""
        if not (self.path / owned_files.STUDY_STATE).exists():
            raise RunFolderError(f"{self.path} is not the folder of a study, so there is nothing to resume")
        if self.path != self.target and self.target.exists():
            self._check_succession()
        manifest = run_folder.read_manifest(self.path)
        own = {*manifest.sha256} if manifest is not None else set()
        if changed := sorted(own & {*(run_folder.unlisted(self.path) or ())}):
            raise RunFolderError(
                f"{self.path} holds files that were changed since: {owned_files.first_names(changed)}; --resume writes "
                "them anew, so move or rename them"
            )

    def _check_replaced(self, waiting: Path) -> None:
        """--force removes what runs and studies wrote, and nothing else."""
        for place in (self.target, waiting):
            if not place.exists() or not any(place.iterdir()):
                continue
            others = run_folder.unlisted(place)
            if others is None:
                raise RunFolderError(
                    f"output folder {place} is not the folder of a study or run, so --force does not replace it; "
                    "choose another with --out"
                )
            run_folder.refuse_others(place, others)

    def _check_succession(self) -> None:
        """Replace only what --force was said of."""
        if not owned_files.succeeds(self.path, self.target):
            raise RunFolderError(
                f"{self.target} holds another run than the one that the study in {self.path} was to replace; move one "
                "of them away"
            )

    def _make(self) -> None:
        """Make the folder; of several commands only one can."""
        while True:
            try:
                self.path.mkdir()
                break
            except FileExistsError:
                if self._numbered is None:
                    raise
                self.path = self.target = self._numbered.free()
        durable.sync_folder(self.path.parent)
        if self.path != self.target:
            durable.write_safely(self.path / owned_files.SUCCEEDS, owned_files.manifest_digest(self.target).encode())

    def _take_lock(self, folder: Path) -> None:
        lock = (folder / owned_files.STUDY_LOCK).open("a+", encoding="utf-8")
        self._locks.append(lock)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunFolderError(f"another command is working in {self.target}; wait until it has ended") from None

    def _check_identity(self) -> None:
        """Refuse to go on with what another study, or another program, has begun: their numbers do not mix."""
        try:
            found = _StudyState.model_validate_json((self.path / owned_files.STUDY_STATE).read_bytes())
        except ValidationError:
            raise RunFolderError(
                f"{self.path / owned_files.STUDY_STATE} cannot be read, or is of an older version; start again with "
                "--force"
            ) from None
        own = _StudyState.of(self.setup)
        remedy = "start again in another folder with --out, or replace this one with --force"
        if found.content != own.content:
            text = f"{self.path} holds another study: its factors, design or base differ; {remedy}"
            raise RunFolderError(text)
        changed = [
            *_differences(found.versions, own.versions, lambda name, old, new: f"{name} was {old} and is {new}"),
            *_differences(found.sources, own.sources, lambda name, old, new: name),
        ]
        if changed or found.fingerprint != own.fingerprint:
            named = owned_files.first_names(changed)
            raise RunFolderError(
                f"{self.path} was begun with another version of the program, whose numbers would stand beside new ones "
                f"(changed: {named}); go on with the program as it was, or {remedy}"
            )

    def _begin(self) -> None:
        self.write("config.yaml", self.setup.to_yaml().encode())
        self.write(owned_files.STUDY_STATE, (_StudyState.of(self.setup).model_dump_json(indent=2) + "\n").encode())

    def write(self, name: str, content: bytes) -> None:
        """Write a file so that under its name it is whole or not there."""
        self.write_all({name: content})

    def write_all(self, files: Mapping[str, bytes]) -> None:
        """Write several files at once, each whole or not there, by their paths in the folder.

        Raises:
            OSError: the disk is full, or gone; some may be there.
        """
        lines = [f"{hashlib.sha256(content).hexdigest()} {name}\n" for name, content in files.items()]
        if [*files] != [owned_files.MANIFEST]:
            self._account(lines)
        for folder in {(self.path / name).parent for name in files}:
            durable.make_folders(folder)
        durable.write_all_safely((self.path / name, content) for name, content in files.items())

    def _account(self, lines: Sequence[str]) -> None:
        """Keep account of what is written next."""
        with (self.path / owned_files.WRITTEN).open("a", encoding="utf-8") as account:
            # a line that was half written when the power failed is ended
            account.writelines(["\n", *lines])
            account.flush()
            os.fsync(account.fileno())

    def begin_results(self) -> None:
        """Results are written anew: until their manifest is, the folder is not a complete study's."""
        manifest = run_folder.read_manifest(self.path)
        if manifest is not None:
            self._account([f"{check} {name}\n" for name, check in manifest.sha256.items()])
        (self.path / owned_files.MANIFEST).unlink(missing_ok=True)
        durable.sync_folder(self.path)

    def remove(self, names: Sequence[str]) -> None:
        """Remove files that the study has written; what somebody has put there or changed stays."""
        others = {*(owned_files.foreign_files(self.path, None) or ())}
        for name in names:
            if name not in others:
                (self.path / name).unlink(missing_ok=True)

    def write_json(self, name: str, data: Any) -> None:
        """Write plain data."""
        self.write(name, run_folder.json_text(data).encode())

    def checksums(self) -> dict[str, str]:
        """SHA-256 of every file of the result; chunks have their own in their index."""
        out = {}
        for file in sorted(self.path.rglob("*")):
            name = file.relative_to(self.path).as_posix()
            inside = name.split("/")[0] == FOLDER or file.name.startswith(".") or name == owned_files.MANIFEST
            if file.is_file() and not inside:
                out[name] = owned_files.digest(file)
        return out
