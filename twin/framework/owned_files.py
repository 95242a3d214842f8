"""The owner of each file in and beside the folder of a run or study.

In the folder checksums decide: a file that somebody has changed is theirs. Beside it are hidden names of a folder that
is being made or replaced, ``.NAME.TOKEN.partial`` (a run that is being written), ``.NAME.TOKEN.old`` (what it replaces)
and ``.NAME.TOKEN.lock``, which the process holds locked as long as it lives. The lock is the operating system's and
ends with the process, however that ends; so a name without a held lock is nobody's.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

MANIFEST = "manifest.json"
KEPT_LOCK = ".lock"
"""File that a command holds locked in the folder of what it keeps for ``--resume``."""

NAMED = 5
"""Files that a message names at most."""


def first_names(names: Sequence[str], most: int = NAMED) -> str:
    """A list of names for a message: the first of them, and how many more there are.

    Parameters
    ----------
    names : Sequence[str]
        All of them.
    most : int
        How many are named.
    """
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def every_file(folder: Path) -> list[str]:
    """Paths of all that stands in a folder and is not a folder itself, relative to it, in order."""
    out = []
    for place, folders, files in os.walk(folder):
        names = [*files, *(name for name in folders if os.path.islink(os.path.join(place, name)))]
        out += [(Path(place) / name).relative_to(folder).as_posix() for name in names]
    return sorted(out)


def foreign_files(folder: Path, listed: Mapping[str, str]) -> list[str]:
    """Files in the folder of a run that it did not write, or not with these contents.

    Parameters
    ----------
    folder : Path
        To be looked at.
    listed : Mapping[str, str]
        Files of the run and their SHA-256.

    Raises
    ------
    OSError
        a file cannot be read.
    """

    def ours(name: str) -> bool:
        return name == MANIFEST or (name in listed and is_as_written(folder / name, {listed[name]}))

    return [name for name in every_file(folder) if not ours(name)]


def is_as_written(place: Path, checksums: Collection[str]) -> bool:
    """Whether a file, and no link or folder, has one of these SHA-256. Raises OSError."""
    return place.is_file() and not place.is_symlink() and digest(place) in checksums


def digest(place: Path) -> str:
    """SHA-256 of a file. Raises OSError."""
    with place.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_files(folder: Path, kept: set[str]) -> None:
    """Remove all files of a folder but some, and the folder if that was all. What says whose they are goes last.

    Parameters
    ----------
    folder : Path
        To be removed.
    kept : set[str]
        Files that stay, paths relative to it.
    """
    names = [name for name in every_file(folder) if name not in kept]
    for name in sorted(names, key=lambda name: (name == MANIFEST, name)):
        (folder / name).unlink(missing_ok=True)
    for place, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):  # somebody else has put something there
            os.rmdir(place)


PARTIAL, OLD, LOCK = "partial", "old", "lock"

_NAME = re.compile(rf"\.(?P<name>.+)\.(?P<token>[0-9a-f]{{8}})\.(?:{PARTIAL}|{OLD}|{LOCK})")


def _beside(target: Path, token: str) -> dict[str, Path]:
    return {ending: target.with_name(f".{target.name}.{token}.{ending}") for ending in (PARTIAL, OLD, LOCK)}


class Unfinished:
    """Hidden names beside ``target`` that are this process's own until ``close``.

    Parameters
    ----------
    target
        The folder that is being made; the one it stands in exists.

    Raises
    ------
    OSError
        Nothing can be written beside it.
    """

    def __init__(self, target: Path) -> None:
        lock = None
        while lock is None:  # whoever sweeps the folder may hold the lock of a new file for a moment
            self._names = _beside(target, secrets.token_hex(4))
            lock = locked(self._names[LOCK])
        self._lock = lock

    def path(self, ending: str) -> Path:
        """The hidden name with that ending, PARTIAL or OLD."""
        return self._names[ending]

    def close(self) -> None:
        """Give the names up; nothing is to stand under them any more."""
        self._names[LOCK].unlink(missing_ok=True)
        os.close(self._lock)


@contextmanager
def scratch(stem: str) -> Iterator[Path]:
    """A folder of this user alone for what ends with the block, where the system has such. What killed processes of
    this user left there goes first.

    Raises
    ------
    OSError
        It cannot be made.
    """
    target = Path(tempfile.gettempdir()) / stem
    sweep(target.parent)
    names = Unfinished(target)
    folder = names.path(PARTIAL)
    try:
        folder.mkdir(mode=0o700)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        names.close()


def sweep(folder: Path, replaced: Callable[[Path, Path], bool] = lambda former, new: False) -> None:
    """Clear away what dead processes of this user left in ``folder``; what belongs to a live one is not touched.

    What was half written is removed. What was to be replaced is put back when nothing has taken its place.

    Parameters
    ----------
    folder : Path
        Where runs stand.
    replaced : Callable[[Path, Path], bool]
        Given what was to be replaced and what has its place now; removes the former, if that is right, and returns
        whether it did.
    """
    try:
        names = {(m["name"], m["token"]) for path in folder.iterdir() if (m := _NAME.fullmatch(path.name))}
    except OSError:  # a folder that cannot be read is told of when it is written to
        return
    for name, token in sorted(names):
        places = _beside(folder / name, token)
        with suppress(OSError):  # not ours to remove; it stays for who may
            if any(place.lstat().st_uid != os.getuid() for place in places.values() if os.path.lexists(place)):
                continue
            if (lock := locked(places[LOCK], certain=True)) is not None:
                try:
                    _clear(folder / name, places, replaced)
                finally:
                    os.close(lock)


def _clear(target: Path, places: dict[str, Path], replaced: Callable[[Path, Path], bool]) -> None:
    partial, former = places[PARTIAL], places[OLD]
    if partial.is_dir() and not partial.is_symlink():
        if (partial / MANIFEST).exists() and target.exists() and not former.exists():
            # complete: it has changed places with the target, or was about to
            partial.rename(former)
        else:
            shutil.rmtree(partial)
    if former.is_dir() and not former.is_symlink():
        if not os.path.lexists(target):
            former.rename(target)
        elif not replaced(former, target):
            return
    places[LOCK].unlink(missing_ok=True)


def locked(place: Path, certain: bool = False) -> int | None:
    """Open a file, made where it is missing, and lock it.

    Parameters
    ----------
    place : Path
        Of the file.
    certain : bool
        Also None where the file system has no locks.

    Returns
    -------
    int | None
        The open file; None when another process has it.

    Raises
    ------
    OSError
        It cannot be opened.
    """
    while True:
        lock = os.open(place, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if certain or isinstance(error, BlockingIOError):
                os.close(lock)
                return None
        if os.fstat(lock).st_nlink:
            return lock
        os.close(lock)  # its owner has removed it meanwhile
