"""A run folder: written under a temporary name beside its place and renamed when complete; none is ever half there."""

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
from twin.framework import owned_files
from twin.framework.durable import PARTIAL_NAME, ending_later, make_folders, put_in_place, sync_folder, sync_tree
from twin.framework.owned_files import MANIFEST
from twin.framework.provenance import Checksum, Provenance, versions

_WAITING = f".{MANIFEST}{owned_files.PARTIAL}"
"""Name of the manifest until all that it vouches for is on the disk."""


class RunFolderError(Exception):
    """A run folder cannot be made; the message says why and what to do."""


@dataclass(frozen=True)
class Numbered:
    """The first of STEM-001, STEM-002, ... that is free when the folder is put in place.

    Attributes
    ----------
    folder : Path
        Where it shall stand.
    stem : str
        Of its name.
    """

    folder: Path
    stem: str

    def free(self) -> Path:
        """Return the first that does not exist now."""
        every = (self.folder / f"{self.stem}-{number:03d}" for number in count(1))
        return next(path for path in every if not os.path.lexists(path))


def chosen(out: Path | None, stem: str) -> Path | Numbered:
    """The folder that the user chose, else the next free one of that name below ``runs``.

    Parameters
    ----------
    out : Path | None
        Of the option --out, None where it was not given.
    stem : str
        Of the folder's name.
    """
    return out if out is not None else Numbered(Path("runs"), stem)


class RunFolder:
    """Context manager that makes a run folder.

    Inside the ``with`` block write files below ``path``; on success they appear as ``target`` in one rename, on any
    error, and on an interrupt, nothing is left behind. What a killed run left beside the target is removed.

    Parameters
    ----------
    target
        Where the folder shall stand. Of several runs that start together with the same ``Numbered``, each gets a number
        of its own when it is complete.
    force
        Replace an existing run folder, which stands until this one is complete. Only a folder that is empty, or of
        which a run's manifest lists every file as it is, is ever replaced.

    Raises
    ------
    RunFolderError
        The target exists, or cannot be written.
    """

    def __init__(self, target: Path | Numbered, force: bool = False) -> None:
        self._numbered = target if isinstance(target, Numbered) else None
        self.target = target.free() if isinstance(target, Numbered) else Path(target)
        self.force = force
        self.path = self.target
        self._unfinished: owned_files.Unfinished | None = None
        self._made_parents: list[Path] = []
        try:
            self._check_target()
        except OSError as error:
            raise RunFolderError(f"cannot look at the output folder {self.target}: {reason(error)}") from error

    def _check_target(self) -> None:
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
            owned_files.sweep(self.target.parent, remove_replaced)
            if self._numbered is None:
                self._check_target()  # what a killed run had put aside may stand there again
            self._unfinished = owned_files.Unfinished(self.target)
            self.path = self._unfinished.path(owned_files.PARTIAL)
            self.path.mkdir()
        except BaseException as error:
            self._remove()
            if isinstance(error, OSError):
                raise RunFolderError(f"cannot make the output folder {self.target}: {reason(error)}") from error
            raise
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Rename when all went well, else remove."""
        if error is None:
            try:
                self._publish()
                return
            except BaseException as failure:
                self._remove()
                if isinstance(failure, OSError):
                    text = f"cannot put the output folder {self.target} in place: {reason(failure)}"
                    raise RunFolderError(text) from failure
                raise
        self._remove()
        if isinstance(error, OSError):
            raise RunFolderError(f"cannot write to {self.target}: {reason(error)}; nothing was kept") from error

    def _remove(self) -> None:
        """Take back everything that was made."""
        if self._unfinished is not None:
            shutil.rmtree(self._unfinished.path(owned_files.PARTIAL), ignore_errors=True)
            self._unfinished.close()
        with suppress(OSError):  # somebody else has put something there
            for parent in self._made_parents:
                parent.rmdir()

    def _publish(self) -> None:
        assert self._unfinished is not None
        sync_tree(self.path)
        if (self.path / _WAITING).exists():
            os.rename(self.path / _WAITING, self.path / MANIFEST)
            sync_folder(self.path)
        with ending_later():
            if self.force and self.target.exists():
                old = self._unfinished.path(owned_files.OLD)
                put_in_place(self.path, self.target, old)
                with suppress(OSError):  # the next run beside it tries again
                    remove_run(old, self.target)
            else:
                self._claim()
                try:
                    os.rename(self.path, self.target)
                except BaseException:
                    self.target.rmdir()
                    raise
                sync_folder(self.target.parent)
            self._unfinished.close()

    def _claim(self) -> None:
        """Take the target's name with an empty folder, which the rename replaces; only one process can make it."""
        while True:
            try:
                self.target.mkdir()
                return
            except FileExistsError:
                if self._numbered is None:
                    raise
                self.target = self._numbered.free()

    def write_json(self, name: str, data: Any) -> None:
        """Write a JSON file; NaN and infinities are refused, since JSON has none."""
        self.write_text(name, json_text(data))

    def write_text(self, name: str, text: str) -> None:
        """Write a UTF-8 text file."""
        self._place(name).write_text(text, encoding="utf-8")

    def write_bytes(self, name: str, content: bytes | memoryview) -> None:
        """Write a binary file; contents that lie in a file themselves are not held in memory."""
        place = self._place(name)
        if not isinstance(content, memoryview):
            place.write_bytes(content)
            return
        from twin.framework.frame_store import PART, let_go  # with NumPy, and most commands write no frames

        with place.open("wb") as file:
            for start in range(0, len(content), PART):
                file.write(content[start : start + PART])
                let_go(content)

    def write_with(self, name: str, writer: Callable[[Path], None]) -> None:
        """Let ``writer`` make the file of that name."""
        writer(self._place(name))

    def _place(self, name: str) -> Path:
        place = self.path / (_WAITING if name == MANIFEST else name)
        place.parent.mkdir(parents=True, exist_ok=True)
        return place

    def checksums(self) -> dict[str, str]:
        """SHA-256 of every file written so far, by path relative to the folder."""
        return {name: owned_files.digest(self.path / name) for name in owned_files.every_file(self.path)}


def json_text(data: Any) -> str:
    """The text of a JSON file, as every command writes it."""
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def _inside(name: str) -> str:
    """A path relative to a folder that stays in it."""
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or ".." in path.parts or path.as_posix() != name or "\0" in name:
        raise ValueError("not the path of a file in the folder")
    return name


class Manifest(BaseModel):
    """All that manifests say, in the order in which they say it; what has a default is said by some programs only.
    Other people's programs call their files manifest.json as well.

    Attributes
    ----------
    program : str
        That made the folder, ``twin.render``.
    test : str
        Kind of the test, ``focus``.
    gradient : bool
        The run differentiates a study.
    again : list[str]
        Words of the command, without ``python -m``, that makes the run again from its own folder; none where no command
        can.
    started_in : str
        Absolute path of the folder where it was typed, if words of it are relative to that.
    versions : dict[str, str]
        Of the twin and of what it uses.
    provenance : Provenance | None
        Source, processor and linear algebra that made it.
    backend : str
        Where it was traced.
    seed : int
        Of all that was drawn.
    only, fast : str | None
        The checks that were chosen, None for all; whether with fewer trials.
    frames : int
        Per state.
    runs, failed : int
        Of a study.
    started_unix_s : float
        When, seconds since the epoch.
    wall_time_s : float
        That it took.
    workers : int
        processes.
    worst_relative : float | None
        Largest relative deviation of derivatives from differences, None where none was compared.
    warnings : list[str]
        What the user was told.
    checks : list[dict[str, Any]]
        What the run checked of itself, as of `twin.framework.provenance.SelfCheck`.
    inputs : dict[str, Checksum]
        Absolute path of every file that the run read and that is not in its folder -> checksum.
    sha256 : dict[str, Checksum]
        Checksum of every file of the run but this one, by its path in the folder.
    digest : Checksum | None
        Checksum of all else that stands here, see `seal`.
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
        """Program, and the kind of a test."""
        return f"{self.program} {self.test}".strip()


def _ours(named: dict[str, str]) -> dict[str, str]:
    if "space-camera-twin" not in named:
        raise ValueError("made by another program")
    return named


class FilesOfRun(Protocol):
    """A folder that a run's files are written into."""

    def write_json(self, name: str, data: Any) -> None:
        """Write plain data."""

    def checksums(self) -> dict[str, str]:
        """SHA-256 of every file of the run so far."""


def write_manifest(folder: FilesOfRun, program: str, started: float, seconds: float, **facts: Any) -> None:
    """Write the manifest, which lists every other file of the run; the last thing that is done in a folder.

    Parameters
    ----------
    folder : FilesOfRun
        open.
    program : str
        That makes it, as the user calls it.
    started : float
        Seconds since the epoch.
    seconds : float
        That it took.
    facts : Any
        Others that `Manifest` knows, in any order.

    Raises
    ------
    ValueError
        a fact that it does not know.
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
        raise ValueError(f"no fact of a manifest: {', '.join(unknown)}")
    manifest = {key: entries[key] for key in Manifest.model_fields if key in entries}
    folder.write_json(MANIFEST, {**manifest, "digest": seal(manifest)})


def seal(manifest: Mapping[str, Any]) -> str:
    """SHA-256 of what a manifest says but for its ``digest``: of its JSON with sorted keys and without blanks."""
    content = {key: value for key, value in manifest.items() if key != "digest"}
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def altered(folder: Path, manifest: Manifest) -> list[str]:
    """Files of a run that are not as it wrote them: other bytes, gone, or a link or folder in their place.

    Parameters
    ----------
    folder : Path
        Of the run.
    manifest : Manifest
        Of it.

    Raises
    ------
    OSError
        One cannot be read.
    """
    return [name for name, known in manifest.sha256.items() if not owned_files.is_as_written(folder / name, {known})]


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of a run, None when the folder has none."""
    try:
        return Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    except (OSError, ValueError):  # of pydantic too; a name with a NUL is none of a folder
        return None


def finished_manifest(folder: Path) -> Manifest:
    """The manifest of a finished run. Raises InputError: the folder has none."""
    manifest = read_manifest(folder)
    if manifest is None:
        problem = "no such folder" if not folder.is_dir() else f"not a run folder: it has no {MANIFEST} of a run"
        raise InputError(Issue(problem, str(folder), allowed="a folder that a command of the twin has written"))
    return manifest


def is_run_folder(folder: Path) -> bool:
    """Whether a folder holds the manifest of a run."""
    return read_manifest(folder) is not None


def unlisted(folder: Path) -> list[str] | None:
    """Files in the folder of a run that it did not write, or not like this; None when it is none. Raises OSError."""
    manifest = read_manifest(folder)
    return None if manifest is None else owned_files.foreign_files(folder, manifest.sha256)


def refuse_others(folder: Path, others: Sequence[str]) -> None:
    """Refuse to replace a folder with files in it that no run put there, or that were changed since.

    Parameters
    ----------
    folder : Path
        That is to be replaced.
    others : Sequence[str]
        Files in it that are not the run's own.

    Raises
    ------
    RunFolderError
        There are some.
    """
    if not others:
        return
    manifest = read_manifest(folder)
    changed = set(manifest.sha256 if manifest is not None else ())
    named = owned_files.first_names([f"{name} (changed since)" if name in changed else name for name in others])
    raise RunFolderError(
        f"output folder {folder} also holds what the run did not write: {named}; --force removes only the run's own "
        "files, so move these away or choose another folder with --out"
    )


def remove_run(old: Path, new: Path) -> None:
    """Remove the replaced folder of a run; files that were put into it or changed meanwhile move to the new one.

    Parameters
    ----------
    old : Path
        The replaced folder, under another name.
    new : Path
        What stands in its place.
    """
    others = unlisted(old)
    for name in owned_files.every_file(old) if others is None else others:
        place = new / name
        while os.path.lexists(place):
            place = place.with_name(f"{place.name}.kept")
        place.parent.mkdir(parents=True, exist_ok=True)
        (old / name).rename(place)
    owned_files.remove_files(old, set())


def remove_replaced(old: Path, new: Path) -> bool:
    """Remove what a killed process had replaced, if what it had in its place is complete.

    Parameters
    ----------
    old : Path
        What was to be replaced, under another name.
    new : Path
        What stands in its place.
    """
    if not is_run_folder(new):
        return False
    remove_run(old, new)
    return True


def reason(error: OSError) -> str:
    """Why a file cannot be, in a few words; HDF5 puts a page into strerror."""
    return os.strerror(error.errno) if error.errno else str(error)


JOURNAL = ".journal"
"""Ending of a file with finished pieces of work, `twin.framework.journal`."""
_KEPT = re.compile(rf"{re.escape(owned_files.KEPT_LOCK)}|[^/]+{re.escape(JOURNAL)}|{PARTIAL_NAME}")
"""Files that commands keep there."""


class KeptWork:
    """Context manager over the folder ``OUT.ENDING``, in which a command keeps its work beside its run folder for
    ``--resume``, and which nobody else uses until the block ends.

    Without ``--out`` a command that runs beside another one of the same name takes ``STEM.2.ENDING``, and so on. Files
    that no command of this program keeps there are never removed; a folder that holds some is refused.

    Parameters
    ----------
    out
        The run folder that the user chose, None for one below ``runs``.
    stem
        Name of the run folder where the user chose none.
    ending
        What is kept, ``samples`` for instance.
    resume
        Go on with what is there.
    force
        Else remove what is there; where this is false, refuse to begin anew.
    command
        Words of the command that goes on, without ``--resume``.
    """

    def __init__(
        self, out: Path | None, stem: str, ending: str, resume: bool, force: bool = True, command: str = ""
    ) -> None:
        self._first = Path("runs") / stem if out is None else out
        self._chosen, self._ending, self._resume, self._force = out is not None, ending, resume, force
        self._command = command or "the same command"
        self._place: Path | None = None
        self._lock: int | None = None

    def __enter__(self) -> KeptWork:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Let others use the folder; where a bad input ends the command before anything was kept, remove it."""
        if self._lock is not None:
            if kind is not None and self._place and owned_files.every_file(self._place) == [owned_files.KEPT_LOCK]:
                self.finish()
            os.close(self._lock)

    def begin(self) -> Path:
        """Make or take up the folder, and return it.

        Raises
        ------
        RunFolderError
            Another command uses the folder that the user chose, it holds files of somebody else, or it cannot be made.
        """
        try:
            for number in count(1):
                place = self._first.with_name(f"{self._first.name}{'' if number == 1 else f'.{number}'}.{self._ending}")
                self._refuse_others(place)
                make_folders(place)
                self._lock = owned_files.locked(place / owned_files.KEPT_LOCK)
                if self._lock is not None:
                    break
                if self._chosen:
                    text = f"{place} is in use by another command; wait until it has ended, or choose another --out"
                    raise RunFolderError(text)
            if not (self._resume or self._force) and owned_files.every_file(place) != [owned_files.KEPT_LOCK]:
                raise RunFolderError(
                    f"{place} holds what is done of a run that was broken off; go on with it with --resume, begin anew "
                    "with --force, or choose another --out"
                )
            self._place = place
            if not self._resume:
                owned_files.remove_files(place, {owned_files.KEPT_LOCK})
        except OSError as error:
            raise RunFolderError(f"cannot use {place}: {reason(error)}") from error
        return place

    def left(self) -> str:
        """What is left of a run that was broken off, for a message."""
        if self._place is None or not self._place.exists():
            return "nothing was kept"
        return f"what is done is kept, go on with: {self._command} --resume"

    def finish(self) -> None:
        """Remove what was kept: its results stand in the run folder."""
        if self._place is not None:
            others = {name for name in owned_files.every_file(self._place) if not _KEPT.fullmatch(name)}
            owned_files.remove_files(self._place, others)

    def _refuse_others(self, place: Path) -> None:
        if not os.path.lexists(place):
            return
        if place.is_symlink() or not place.is_dir():
            raise RunFolderError(f"{place} is in the way of what is kept for --resume; choose another --out")
        names = owned_files.every_file(place)
        known = owned_files.KEPT_LOCK in names
        if others := [name for name in names if not (known and _KEPT.fullmatch(name))]:
            named = owned_files.first_names(others)
            text = f"{place} holds files that this program did not write: {named}; move it, or choose another --out"
            raise RunFolderError(text)
