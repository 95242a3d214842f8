"""Ownership of the files in the folder of a run or study, and of the temporary names beside it.

Inside the folder checksums decide: a file that was changed belongs to the user. Beside it are hidden names of a folder
that is being made or replaced: ``.NAME.TOKEN.partial`` (a run that is being written), ``.NAME.TOKEN.old`` (the run that
it replaces) and ``.NAME.TOKEN.lock``, which the process holds locked as long as it lives. The operating system releases
the lock when the process ends, however it ends; a name without a held lock therefore belongs to no process.
"""

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
"""File that a command holds locked in the folder of its intermediate results for ``--resume``."""

NAMED = 5
"""Largest number of file names that a message lists."""


def first_names(names: Sequence[str], most: int = NAMED) -> str:
    """Return the first names of a list for a message, and how many more there are.

    Parameters
    ----------
    names : sequence of str
        All names.
    most : int
        Largest number of names in the text.
    """
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def files_below(folder: Path) -> list[str]:
    """Return the sorted paths, relative to a folder, of everything below it that is not a folder."""
    out = []
    for folder_path, folders, files in os.walk(folder):
        names = [*files, *(name for name in folders if os.path.islink(os.path.join(folder_path, name)))]
        out += [(Path(folder_path) / name).relative_to(folder).as_posix() for name in names]
    return sorted(out)


def changed_or_added_files(folder: Path, listed: Mapping[str, str]) -> list[str]:
    """Return the files in the folder of a run that the run did not write, or that were changed since.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    listed : mapping of str to str
        Files of the run and their SHA-256.

    Raises
    ------
    OSError
        A file cannot be read.
    """

    def ours(name: str) -> bool:
        return name == MANIFEST or (name in listed and is_as_written(folder / name, {listed[name]}))

    return [name for name in files_below(folder) if not ours(name)]


def is_as_written(path: Path, checksums: Collection[str]) -> bool:
    """Return True if a path is a regular file with one of these SHA-256 checksums. Raises OSError."""
    return path.is_file() and not path.is_symlink() and digest(path) in checksums


def digest(path: Path) -> str:
    """Return the SHA-256 of a file. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_files(folder: Path, kept: set[str]) -> None:
    """Remove all files of a folder except some, and the folder if it is then empty; the manifest goes last.

    Parameters
    ----------
    folder : Path
        Folder to remove.
    kept : set of str
        Paths, relative to the folder, of files that stay.
    """
    names = [name for name in files_below(folder) if name not in kept]
    for name in sorted(names, key=lambda name: (name == MANIFEST, name)):
        (folder / name).unlink(missing_ok=True)
    for subfolder, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):  # another program has put a file there
            os.rmdir(subfolder)


PARTIAL, OLD, LOCK = "partial", "old", "lock"

_NAME = re.compile(rf"\.(?P<name>.+)\.(?P<token>[0-9a-f]{{8}})\.(?:{PARTIAL}|{OLD}|{LOCK})")


def _beside(target: Path, token: str) -> dict[str, Path]:
    """Return the hidden temporary paths beside a target folder, by their ending (PARTIAL, OLD or LOCK)."""
    return {ending: target.with_name(f".{target.name}.{token}.{ending}") for ending in (PARTIAL, OLD, LOCK)}


class Unfinished:
    """Hidden temporary names beside a folder, reserved for this process until ``close``.

    Parameters
    ----------
    target
        Folder that is being made; its parent exists.

    Raises
    ------
    OSError
        Nothing can be written beside the folder.
    """

    def __init__(self, target: Path) -> None:
        lock = None
        while lock is None:  # a process that sweeps the folder may hold the lock of a new file for a moment
            self._names = _beside(target, secrets.token_hex(4))
            lock = locked(self._names[LOCK])
        self._lock = lock

    def path(self, ending: str) -> Path:
        """Return the hidden name with the ending PARTIAL or OLD."""
        return self._names[ending]

    def close(self) -> None:
        """Release the names; nothing may exist under them any more."""
        self._names[LOCK].unlink(missing_ok=True)
        os.close(self._lock)


@contextmanager
def scratch(stem: str) -> Iterator[Path]:
    """Make a temporary folder that only this user can read and that is removed at the end of the block.

    Folders that killed processes of this user left there are removed first.

    Raises
    ------
    OSError
        The folder cannot be made.
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
    """Remove what dead processes of this user left in ``folder``; names of living processes are not touched.

    Partly written folders are removed. A folder that was to be replaced is restored if nothing has taken its place.

    Parameters
    ----------
    folder : Path
        Folder that contains run folders.
    replaced : callable
        Function of the replaced folder and of the one in its place. It removes the former if that is right, and returns
        True if it did.
    """
    try:
        names = {(m["name"], m["token"]) for path in folder.iterdir() if (m := _NAME.fullmatch(path.name))}
    except OSError:  # a folder that cannot be read is reported when it is written to
        return
    for name, token in sorted(names):
        paths = _beside(folder / name, token)
        with suppress(OSError):  # without permission to remove it, it stays
            if any(existing.lstat().st_uid != os.getuid() for existing in paths.values() if os.path.lexists(existing)):
                continue
            if (lock := locked(paths[LOCK], certain=True)) is not None:
                try:
                    _clear(folder / name, paths, replaced)
                finally:
                    os.close(lock)


def _clear(target: Path, paths: dict[str, Path], replaced: Callable[[Path, Path], bool]) -> None:
    """Remove or restore the hidden files and folders that a dead process left beside a target."""
    partial, former = paths[PARTIAL], paths[OLD]
    if partial.is_dir() and not partial.is_symlink():
        if (partial / MANIFEST).exists() and target.exists() and not former.exists():
            # complete: it had been exchanged with the target, or was about to be
            partial.rename(former)
        else:
            shutil.rmtree(partial)
    if former.is_dir() and not former.is_symlink():
        if not os.path.lexists(target):
            former.rename(target)
        elif not replaced(former, target):
            return
    paths[LOCK].unlink(missing_ok=True)


def locked(path: Path, certain: bool = False) -> int | None:
    """Open a file, making it if it is missing, and lock it.

    Parameters
    ----------
    path : Path
        Path of the file.
    certain : bool
        True to return None also if the file system has no locks.

    Returns
    -------
    int | None
        Descriptor of the open file; None if another process holds the lock.

    Raises
    ------
    OSError
        The file cannot be opened.
    """
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if certain or isinstance(error, BlockingIOError):
                os.close(lock)
                return None
        if os.fstat(lock).st_nlink:
            return lock
        os.close(lock)  # its owner has removed the file meanwhile
