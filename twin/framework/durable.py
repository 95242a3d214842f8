"""Writing of files and folders that survive a power failure, and handling of signals that end the program.

A file system may keep written data in memory for half a minute, and may write names before the data they refer to. Data
that must be reliable is therefore written through (``fsync``) before the name that vouches for it: files before their
folder, a folder before it is renamed, and its parent folder afterwards.

Inside the folder of a run or study checksums decide who owns a file: one that was changed belongs to the user. Beside
it is a hidden folder, ``.NAME.TOKEN.partial``: the run that is being written or, while it is removed, the run that was
replaced. The process holds it locked as long as it lives. The operating system releases the lock when the process
ends, however it ends.
"""

import ctypes
import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import signal
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

PARTIAL = ".partial"
"""Extension of the temporary name of a file or run folder that is being written."""
PARTIAL_NAME = r"\.[^/]+\.[0-9a-f]{8}\.partial"
"""Pattern of the name of a file that is being written; its random token keeps two processes that write the same file
apart.
"""
AT_ONCE = 8
"""Number of files written through at once: the disk's journal takes many in one step."""
_EXCHANGE, _HERE = 2, -100
"""Constants of the Linux system call renameat2: RENAME_EXCHANGE, exchange two names, and AT_FDCWD, the working
directory.
"""
_NO_EXCHANGE = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
_NOT_FOR_FOLDERS = (errno.EINVAL, errno.EOPNOTSUPP, errno.EBADF)
"""Error numbers of file systems that have no fsync of a folder, for instance those of a network."""


def _sync(path: Path, kind: int) -> None:
    """Write a file or folder through to the disk."""
    file = os.open(path, os.O_RDONLY | kind | os.O_CLOEXEC)
    try:
        os.fsync(file)
    except OSError as error:
        if kind != os.O_DIRECTORY or error.errno not in _NOT_FOR_FOLDERS:
            raise
    finally:
        os.close(file)


def sync_file(path: Path) -> None:
    """Write the content of a file through to the disk. Raises OSError."""
    _sync(path, os.O_NOFOLLOW)


def sync_folder(path: Path) -> None:
    """Write the names in a folder through to the disk. Raises OSError."""
    _sync(path, os.O_DIRECTORY)


def sync_tree(path: Path) -> None:
    """Write a folder and everything below it through to the disk, the folder itself last. Raises OSError."""
    tree = [(Path(folder), names) for folder, _, names in os.walk(path)]
    files = [folder / name for folder, names in tree for name in names if not (folder / name).is_symlink()]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(sync_file, files))
        list(pool.map(sync_folder, [folder for folder, _ in tree[1:]]))
    sync_folder(path)


def make_folders(path: Path) -> list[Path]:
    """Make a folder and its missing parents so that they survive a power failure.

    Returns
    -------
    list of Path
        Folders that were made, the deepest first.

    Raises
    ------
    OSError
        A folder cannot be made.
    """
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    for folder in reversed(missing):
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)
    return missing


def write_safely(path: Path, content: bytes) -> None:
    """Write a file so that it is complete or absent under its name, even after a power failure.

    Until it is complete it is a hidden file in the same folder with a name as in ``PARTIAL_NAME``.

    Parameters
    ----------
    path : Path
        Path of the file; its folder exists.
    content : bytes
        Content of the file.

    Raises
    ------
    OSError
        The disk is full or missing.
    """
    write_all_safely([(path, content)])


def write_all_safely(files: Iterable[tuple[Path, bytes]]) -> None:
    """Write several files as ``write_safely`` does; their folders exist.

    Raises
    ------
    OSError
        The disk is full or missing; some of the files may have been written.
    """
    pending = list(files)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(_write_file, pending))
    for folder in {path.parent for path, _ in pending}:
        sync_folder(folder)


def _write_file(file: tuple[Path, bytes]) -> None:
    """Write one file through to the disk under a temporary name and rename it."""
    path, content = file
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PARTIAL}")
    try:
        with partial.open("wb") as out:
            out.write(content)
            out.flush()
            os.fsync(out.fileno())
        partial.replace(path)
    except OSError:
        with suppress(OSError):  # frees the space for data that can be kept
            partial.unlink(missing_ok=True)
        raise


def exchange(first: Path, second: Path) -> bool:
    """Exchange the names of two folders of one file system atomically.

    Returns
    -------
    bool
        True if done; False if the operating system or the file system does not support it.

    Raises
    ------
    OSError
        A folder is missing or must not be renamed.
    """
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    if rename(_HERE, os.fsencode(first), _HERE, os.fsencode(second), _EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _NO_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(second))


def replace_folder(new: Path, target: Path) -> None:
    """Replace a folder by another, already written through, under whose name the former one then is.

    A program that is killed meanwhile leaves the target either old or new. Only where folders cannot be exchanged
    atomically it may leave no target; both folders then exist beside it.

    Parameters
    ----------
    new : Path
        Folder to put at ``target``.
    target : Path
        Existing folder to replace.

    Raises
    ------
    OSError
        The replacement failed; nothing has changed.
    """
    if not exchange(new, target):
        aside = new.with_suffix(".old")
        os.rename(target, aside)
        try:
            os.rename(new, target)
        except BaseException:
            os.rename(aside, target)
            raise
        os.rename(aside, new)
    # the former target is removed next, which must not reach the disk before this
    sync_folder(target.parent)


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that end the program, except Ctrl-C; without SIGHUP if ``nohup`` started it."""
    asked = (signal.SIGTERM, signal.SIGHUP)
    return tuple(number for number in asked if signal.getsignal(number) != signal.SIG_IGN)


@contextmanager
def _handled(asked: Iterable[int], handler: Callable[[int, object], None]) -> Iterator[None]:
    """Install a handler for some signals inside the ``with`` block, and restore the former handlers afterwards."""
    before = {number: signal.signal(number, handler) for number in asked}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def exit_on_terminate() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise an exception, as Ctrl-C does, so that a partial run folder is removed.

    The exception that leaves the block is always the one that the signal raised: compiled modules turn one that arrives
    while they are imported or call back into an exception of their own, and clean-up may fail after it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    got: list[int] = []

    def leave(number: int, frame: object) -> None:
        got.append(number)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        if len(got) == 1:  # a second signal must not interrupt the clean-up
            raise SystemExit(128 + number)

    interrupt = (signal.SIGINT,) if signal.getsignal(signal.SIGINT) is signal.default_int_handler else ()
    with _handled((*ending_signals(), *interrupt), leave):
        try:
            yield
        except BaseException as error:
            if got:
                raise (KeyboardInterrupt() if got[0] == signal.SIGINT else SystemExit(128 + got[0])) from error
            raise


@contextmanager
def ending_later() -> Iterator[None]:
    """Delay Ctrl-C and ending signals until the end of the block, for work that must not be interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    got: list[int] = []
    with _handled((signal.SIGINT, *ending_signals()), lambda number, frame: got.append(number)):
        yield
    for number in got:
        signal.raise_signal(number)


# ownership of files and of temporary names

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


_NAME = re.compile(rf"\.(?P<name>.+)\.[0-9a-f]{{8}}\{PARTIAL}")


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
        path = target.with_name(f".{target.name}.{secrets.token_hex(4)}{PARTIAL}")
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
