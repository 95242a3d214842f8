"""Ownership of the files in the folder of a run or study, and of the temporary names beside it.

Inside the folder checksums decide: a file that was changed belongs to the user. Beside it is a hidden folder,
``.NAME.TOKEN.partial``: the run that is being written or, while it is removed, the run that was replaced. The process
holds it locked as long as it lives. The operating system releases the lock when the process ends, however it ends.
"""

import fcntl
import hashlib
import os
import re
import secrets
import shutil
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


PARTIAL = "partial"
"""Extension of the hidden name of a run folder that is being written."""
_NAME = re.compile(rf"\.(?P<name>.+)\.[0-9a-f]{{8}}\.{PARTIAL}")


def make_unfinished(target: Path) -> tuple[Path, int]:
    """Make a hidden folder beside a target folder, locked by this process.

    Returns
    -------
    tuple of Path and int
        Path of the folder, and the descriptor that holds the lock.

    Raises
    ------
    OSError
        Nothing can be written beside the target.
    """
    while True:
        path = target.with_name(f".{target.name}.{secrets.token_hex(4)}.{PARTIAL}")
        path.mkdir()
        with suppress(FileNotFoundError):  # a process that sweeps the folder has removed it before it was locked
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            with suppress(OSError):  # a file system without locks
                fcntl.flock(lock, fcntl.LOCK_EX)
            if os.fstat(lock).st_nlink:
                return path, lock
            os.close(lock)


def sweep(folder: Path, remove_replaced: Callable[[Path, Path], None]) -> None:
    """Remove hidden run folders that dead processes of this user left in ``folder``.

    One that is complete is the run that its target replaced, or was about to replace it; without a target it stays.

    Parameters
    ----------
    folder : Path
        Folder that contains run folders.
    remove_replaced : callable
        Function that removes a complete hidden folder; the second argument is its target.
    """
    with suppress(OSError):  # a folder that cannot be read is reported when it is written to
        for path in sorted(folder.iterdir()):
            if (match := _NAME.fullmatch(path.name)) is not None:
                with suppress(OSError), _lock_of_dead(path):
                    target = folder / match["name"]
                    if not (path / MANIFEST).exists():
                        shutil.rmtree(path)
                    elif target.exists():
                        remove_replaced(path, target)


@contextmanager
def _lock_of_dead(path: Path) -> Iterator[None]:
    """Lock a hidden folder of this user. Raises OSError if it is another's, or a process holds it."""
    lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(lock).st_uid != os.getuid():
            raise PermissionError(str(path))
        yield
    finally:
        os.close(lock)


def locked(path: Path) -> int | None:
    """Open a file, making it if it is missing, and lock it.

    Parameters
    ----------
    path : Path
        Path of the file.

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
            if isinstance(error, BlockingIOError):
                os.close(lock)
                return None
        if os.fstat(lock).st_nlink:
            return lock
        os.close(lock)  # its owner has removed the file meanwhile
