"""Run folders, written under a temporary name and renamed when complete, so that no folder is ever incomplete."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Protocol

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from scenes.yaml.errors import InputError, Issue
from twin.framework import durable
from twin.framework.durable import MANIFEST, PARTIAL_NAME, make_folders, sync_folder
from twin.framework.provenance import Checksum, Provenance, versions

_WAITING = f".{MANIFEST}{durable.PARTIAL}"
"""Temporary name of the manifest until all files that it lists are on the disk."""


class RunFolderError(Exception):
    """Failure to make a run folder; the message gives the reason and the remedy."""


@dataclass(frozen=True)
class Numbered:
    """Path of a run folder with the first free name of STEM-001, STEM-002, ..., chosen when the run is complete.

    Attributes
    ----------
    folder : Path
        Parent folder.
    stem : str
        Stem of the name.
    """

    folder: Path
    stem: str

    def free(self) -> Path:
        """Return the first path that does not exist now."""
        candidates = (self.folder / f"{self.stem}-{number:03d}" for number in count(1))
        return next(path for path in candidates if not os.path.lexists(path))


def chosen(out: Path | None, stem: str) -> Path | Numbered:
    """Return the folder that the user chose, else the next free one of that stem below ``runs``.

    Parameters
    ----------
    out : Path | None
        Value of the option --out; None if it was not used.
    stem : str
        Stem of the folder's name.
    """
    return out if out is not None else Numbered(Path("runs"), stem)


class RunFolder:
    """Context manager that makes a run folder.

    Write files below ``path`` inside the ``with`` block. On success they appear as ``target`` in one rename; on any
    error or interrupt nothing is left behind. Files that a killed run left beside the target are removed.

    Parameters
    ----------
    target
        Path of the folder. Of several runs that start together with the same ``Numbered``, each gets its own number
        when it is complete.
    force
        True to replace an existing run folder, which stays until this one is complete. Only an empty folder, or one
        whose files are all unchanged and listed in a run's manifest, is ever replaced.

    Raises
    ------
    RunFolderError
        The target exists or cannot be written.
    """

    def __init__(self, target: Path | Numbered, force: bool = False) -> None:
        self._numbered = target if isinstance(target, Numbered) else None
        self.target = target.free() if isinstance(target, Numbered) else Path(target)
        self.force = force
        self.path = self.target
        self._lock: int | None = None
        self._made_parents: list[Path] = []
        try:
            self._check_target()
        except OSError as error:
            raise RunFolderError(f"cannot read the output folder {self.target}: {reason(error)}") from error

    def _check_target(self) -> None:
        """Raise RunFolderError if the target exists and must not be replaced."""
        target = self.target
        if not os.path.lexists(target):
            return
        if not target.is_dir() or target.is_symlink():
            raise RunFolderError(f"output {target} exists and is not a folder; choose another with --out")
        if not self.force:
            raise RunFolderError(
                f"output folder {target} exists; choose another with --out, or replace it with --force"
            )
        if any(target.iterdir()):
            others = unlisted(target)
            if others is None:
                raise RunFolderError(
                    f"output folder {target} is not a run folder (it has no {MANIFEST} of a run), so --force does not "
                    "replace it; choose another with --out"
                )
            refuse_others(target, others)

    def __enter__(self) -> RunFolder:
        """Make the temporary folder."""
        try:
            self._made_parents = make_folders(self.target.parent)
            durable.sweep(self.target.parent, remove_run)
            self.path, self._lock = durable.make_unfinished(self.target)
        except BaseException as error:
            self._remove()
            if isinstance(error, OSError):
                raise RunFolderError(f"cannot make the output folder {self.target}: {reason(error)}") from error
            raise
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Rename the folder on success, otherwise remove it."""
        if error is None:
            try:
                self._publish()
                return
            except BaseException as failure:
                self._remove()
                if isinstance(failure, OSError):
                    text = f"cannot move the output folder to {self.target}: {reason(failure)}"
                    raise RunFolderError(text) from failure
                raise
        self._remove()
        if isinstance(error, OSError):
            raise RunFolderError(f"cannot write to {self.target}: {reason(error)}; nothing was kept") from error

    def _remove(self) -> None:
        """Remove the temporary folder and everything in it after a failure."""
        if self._lock is not None:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
        with suppress(OSError):  # another program has put a file there
            for parent in self._made_parents:
                parent.rmdir()

    def _publish(self) -> None:
        """Write the folder through to the disk and rename it to the target."""
        assert self._lock is not None
        durable.sync_tree(self.path)
        if (self.path / _WAITING).exists():
            os.rename(self.path / _WAITING, self.path / MANIFEST)
            sync_folder(self.path)
        with durable.ending_later():
            if self.force and self.target.exists():
                durable.replace_folder(self.path, self.target)
                with suppress(OSError):  # the next run in this folder tries again
                    remove_run(self.path, self.target)
            else:
                self._claim()
                try:
                    os.rename(self.path, self.target)
                except BaseException:
                    self.target.rmdir()
                    raise
                sync_folder(self.target.parent)
            os.close(self._lock)

    def _claim(self) -> None:
        """Reserve the target's name with an empty folder, which the rename replaces; only one process can make it."""
        while True:
            try:
                self.target.mkdir()
                return
            except FileExistsError:
                if self._numbered is None:
                    raise
                self.target = self._numbered.free()

    def write_json(self, name: str, data: Any) -> None:
        """Write a JSON file; NaN and infinities raise ValueError, since JSON has none."""
        self.write_text(name, json_text(data))

    def write_text(self, name: str, text: str) -> None:
        """Write a UTF-8 text file."""
        self._path_of(name).write_text(text, encoding="utf-8")

    def write_bytes(self, name: str, content: bytes | memoryview) -> None:
        """Write a binary file; contents that are in a file themselves are copied in parts."""
        path = self._path_of(name)
        if not isinstance(content, memoryview):
            path.write_bytes(content)
            return
        from twin.framework.frame_store import (
            PART,
            release_memory,
        )  # imported here with NumPy, since most commands write no frames

        with path.open("wb") as file:
            for start in range(0, len(content), PART):
                file.write(content[start : start + PART])
                release_memory(content)

    def write_with(self, name: str, writer: Callable[[Path], None]) -> None:
        """Let a function write a file of the run folder.

        Parameters
        ----------
        name : str
            Path of the file in the run folder.
        writer : callable
            Function that is called with the path of the file to write.
        """
        writer(self._path_of(name))

    def _path_of(self, name: str) -> Path:
        """Return the path of a file in the temporary folder, after making the folders that contain it."""
        path = self.path / (_WAITING if name == MANIFEST else name)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def checksums(self) -> dict[str, str]:
        """Return the SHA-256 of every file written so far, by its path relative to the folder."""
        return {name: durable.digest(self.path / name) for name in durable.files_below(self.path)}


def json_text(data: Any) -> str:
    """Return data as JSON text in the layout that the files of all commands have."""
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def _inside(name: str) -> str:
    """Return a relative path, or raise ValueError if it leaves its folder."""
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or ".." in path.parts or path.as_posix() != name or "\0" in name:
        raise ValueError("not a path of a file in the folder")
    return name


class Manifest(BaseModel):
    """Content of manifest.json, in its order; entries with a default are written by some programs only.

    Programs of other people may use the name manifest.json as well.

    Attributes
    ----------
    program : str
        Program that made the folder, ``twin.render``.
    test : str
        Kind of the test, ``focus``.
    gradient : bool
        True if the run computes derivatives of a study's results.
    again : list of str
        Words of the command, without ``python -m``, that repeats the run from its own folder; empty if no command can.
    started_in : str
        Absolute path of the working directory, if words of the command are relative to it.
    versions : dict of str to str
        Versions of the twin and of the packages it uses.
    provenance : Provenance | None
        Source, processor and linear algebra of the run.
    backend : str
        Backend of the ray trace.
    seed : int
        Seed of all random numbers.
    only, fast : str | None, bool
        Checks that were chosen (None for all), and True if they used fewer trials.
    frames : int
        Number of frames per state.
    runs, failed : int
        Number of runs of a study, and of those that failed.
    started_unix_s : float
        Start time, in seconds since the epoch.
    wall_time_s : float
        Duration, in seconds.
    workers : int
        Number of worker processes.
    worst_relative : float | None
        Largest relative difference of derivatives and finite differences; None if none were compared.
    warnings : list of str
        Warnings shown to the user.
    checks : list of dict
        Self-checks of the run, see `twin.framework.provenance.SelfCheck`.
    inputs : dict of str to str
        Checksum of every file that the run read outside its folder, by absolute path.
    sha256 : dict of str to str
        Checksum of every file of the run except the manifest, by path in the folder.
    digest : str | None
        Checksum of all other entries, see `seal`.
    """

    model_config = ConfigDict(extra="allow", strict=True, frozen=True)

    program: Annotated[str, Field(pattern=r"^twin\.[a-z_]+$")]
    test: str = ""
    gradient: bool = False
    again: list[str] = []
    started_in: str = ""
    versions: Annotated[dict[str, str], AfterValidator(lambda named: _ours(named))]
    provenance: Provenance | None = None
    backend: str = ""
    seed: int = 0
    only: str | None = None
    fast: bool = False
    frames: int = 0
    runs: int = 0
    failed: int = 0
    started_unix_s: float
    wall_time_s: float
    workers: int = 0
    worst_relative: float | None = None
    warnings: list[str] = []
    checks: list[dict[str, Any]] = []
    inputs: dict[str, Checksum] = {}
    sha256: dict[Annotated[str, AfterValidator(_inside)], Checksum]
    digest: Checksum | None = None

    @property
    def kind(self) -> str:
        """Name of the program and kind of the test, as one text."""
        return f"{self.program} {self.test}".strip()


def _ours(named: dict[str, str]) -> dict[str, str]:
    """Return the versions of a manifest, or raise ValueError if another program made it."""
    if "space-camera-twin" not in named:
        raise ValueError("made by another program")
    return named


class FilesOfRun(Protocol):
    """Interface of a folder into which the files of a run are written."""

    def write_json(self, name: str, data: Any) -> None:
        """Write plain data as a JSON file."""

    def checksums(self) -> dict[str, str]:
        """Return the SHA-256 of every file of the run so far."""


def write_manifest(folder: FilesOfRun, program: str, started: float, seconds: float, **facts: Any) -> None:
    """Write the manifest, which lists every other file of the run, as the last file of a folder.

    Parameters
    ----------
    folder : FilesOfRun
        Open folder.
    program : str
        Program that makes the folder, as the user calls it.
    started : float
        Start time, in seconds since the epoch.
    seconds : float
        Duration, in seconds.
    facts : Any
        Other fields of `Manifest`, in any order.

    Raises
    ------
    ValueError
        `Manifest` has no such field.
    """
    entries = {
        **facts,
        "program": program,
        "versions": versions(),
        "provenance": Provenance.here().model_dump(),
        "started_unix_s": started,
        "wall_time_s": seconds,
        "sha256": folder.checksums(),
    }
    if unknown := sorted(entries.keys() - Manifest.model_fields.keys()):
        raise ValueError(f"a manifest has no fields {', '.join(unknown)}")
    manifest = {key: entries[key] for key in Manifest.model_fields if key in entries}
    folder.write_json(MANIFEST, {**manifest, "digest": seal(manifest)})


def seal(manifest: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a manifest without its ``digest``, from its JSON with sorted keys and without blanks."""
    content = {key: value for key, value in manifest.items() if key != "digest"}
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def altered(folder: Path, manifest: Manifest) -> list[str]:
    """Return the files of a run that are not as it wrote them: changed, missing, or replaced by a link or folder.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    manifest : Manifest
        Manifest of the run.

    Raises
    ------
    OSError
        A file cannot be read.
    """
    return [name for name, known in manifest.sha256.items() if not durable.is_as_written(folder / name, {known})]


def read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of a run, or None if the folder has none."""
    try:
        return Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    except (OSError, ValueError):  # pydantic's errors too, and paths with a NUL
        return None


def finished_manifest(folder: Path) -> Manifest:
    """Return the manifest of a finished run. Raises InputError if the folder has none."""
    manifest = read_manifest(folder)
    if manifest is None:
        problem = "no such folder" if not folder.is_dir() else f"not a run folder: it has no {MANIFEST} of a run"
        raise InputError(Issue(problem, str(folder), allowed="a folder that a command of the twin has written"))
    return manifest


def is_run_folder(folder: Path) -> bool:
    """Return True if a folder holds the manifest of a run."""
    return read_manifest(folder) is not None


def unlisted(folder: Path) -> list[str] | None:
    """Return the files in a run folder that the run did not write, or that were changed; None if it is no run folder.

    Raises OSError.
    """
    manifest = read_manifest(folder)
    return None if manifest is None else durable.changed_or_added_files(folder, manifest.sha256)


def refuse_others(folder: Path, others: Sequence[str]) -> None:
    """Raise RunFolderError if a folder to be replaced has files that no run put there, or that were changed since.

    Parameters
    ----------
    folder : Path
        Folder to be replaced.
    others : sequence of str
        Files in it that are not the run's own.

    Raises
    ------
    RunFolderError
        There are such files.
    """
    if not others:
        return
    manifest = read_manifest(folder)
    changed = set(manifest.sha256 if manifest is not None else ())
    named = durable.first_names([f"{name} (changed since)" if name in changed else name for name in others])
    raise RunFolderError(
        f"output folder {folder} also holds files that the run did not write: {named}; --force removes only its own "
        "files, so move these away or choose another folder with --out"
    )


def remove_run(old: Path, new: Path) -> None:
    """Remove the replaced folder of a run; files that were added or changed meanwhile move to the new one.

    Parameters
    ----------
    old : Path
        Replaced folder, under another name.
    new : Path
        Folder in its place.
    """
    others = unlisted(old)
    for name in durable.files_below(old) if others is None else others:
        path = new / name
        while os.path.lexists(path):
            path = path.with_name(f"{path.name}.kept")
        path.parent.mkdir(parents=True, exist_ok=True)
        (old / name).rename(path)
    durable.remove_files(old, set())


def reason(error: OSError) -> str:
    """Return the reason of a file error in a few words; HDF5 puts a whole page into strerror."""
    return os.strerror(error.errno) if error.errno else str(error)


JOURNAL = ".journal"
"""Extension of a file with finished pieces of work, see `twin.framework.durable`."""
_KEPT = re.compile(rf"{re.escape(durable.KEPT_LOCK)}|[^/]+{re.escape(JOURNAL)}|{PARTIAL_NAME}")
"""Pattern of the names of files that commands keep in a folder of intermediate results."""


class KeptWork:
    """Context manager over the folder ``OUT.ENDING``, in which a command keeps intermediate results for ``--resume``.

    The folder is locked until the block ends. Without ``--out``, a command that runs beside another of the same name
    takes ``STEM.2.ENDING``, and so on. Files that commands of this program do not keep there are never removed; a
    folder that holds such files is refused.

    Parameters
    ----------
    out
        Run folder that the user chose; None for one below ``runs``.
    stem
        Name of the run folder if the user chose none.
    ending
        Kind of the results, ``samples`` for instance.
    resume
        True to continue with existing results.
    force
        Without ``resume``: True to remove existing results, False to refuse to start if there are any.
    command
        Words of the command that continues, without ``--resume``.
    """

    def __init__(
        self, out: Path | None, stem: str, ending: str, resume: bool, force: bool = True, command: str = ""
    ) -> None:
        self._first = Path("runs") / stem if out is None else out
        self._chosen, self._ending, self._resume, self._force = out is not None, ending, resume, force
        self._command = command or "the same command"
        self._path: Path | None = None
        self._lock: int | None = None

    def __enter__(self) -> KeptWork:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Unlock the folder; if an invalid input ended the command before anything was kept, remove it."""
        if self._lock is not None:
            if kind is not None and self._path and durable.files_below(self._path) == [durable.KEPT_LOCK]:
                self.finish()
            os.close(self._lock)

    def begin(self) -> Path:
        """Make or reopen the folder, lock it, and return its path.

        Raises
        ------
        RunFolderError
            Another command uses the folder that the user chose, it holds other files, or it cannot be made.
        """
        try:
            for number in count(1):
                path = self._first.with_name(f"{self._first.name}{'' if number == 1 else f'.{number}'}.{self._ending}")
                self._refuse_others(path)
                make_folders(path)
                self._lock = durable.locked(path / durable.KEPT_LOCK)
                if self._lock is not None:
                    break
                if self._chosen:
                    text = f"{path} is in use by another command; wait until it has ended, or choose another --out"
                    raise RunFolderError(text)
            if not (self._resume or self._force) and durable.files_below(path) != [durable.KEPT_LOCK]:
                raise RunFolderError(
                    f"{path} holds the finished part of an interrupted run; continue it with --resume, start again "
                    "with --force, or choose another --out"
                )
            self._path = path
            if not self._resume:
                durable.remove_files(path, {durable.KEPT_LOCK})
        except OSError as error:
            raise RunFolderError(f"cannot use {path}: {reason(error)}") from error
        return path

    def left(self) -> str:
        """Return the message on which intermediate results of an interrupted run are kept, and how to continue."""
        if self._path is None or not self._path.exists():
            return "nothing was kept"
        return f"finished work is kept, continue with: {self._command} --resume"

    def finish(self) -> None:
        """Remove the intermediate results; the final ones are in the run folder."""
        if self._path is not None:
            others = {name for name in durable.files_below(self._path) if not _KEPT.fullmatch(name)}
            durable.remove_files(self._path, others)

    def _refuse_others(self, path: Path) -> None:
        """Raise RunFolderError if the path is not a folder of intermediate results."""
        if not os.path.lexists(path):
            return
        if path.is_symlink() or not path.is_dir():
            raise RunFolderError(f"{path} is needed for the intermediate results of --resume; choose another --out")
        names = durable.files_below(path)
        known = durable.KEPT_LOCK in names
        if others := [name for name in names if not (known and _KEPT.fullmatch(name))]:
            named = durable.first_names(others)
            text = f"{path} holds files that this program did not write: {named}; move it, or choose another --out"
            raise RunFolderError(text)
