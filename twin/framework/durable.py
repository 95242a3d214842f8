"""Files and folders that outlive a failure of the power, and what waits for a signal that asks the program to end.

A file system may keep what is written in memory for half a minute, and write names before what they stand for. So
whatever is to be relied on is written through (``fsync``) before the name that vouches for it: files before their
folder, a folder before it is renamed, the folder it stands in afterwards.
"""

from __future__ import annotations

import ctypes
import errno
import os
import secrets
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

PARTIAL = ".partial"
"""Ending of a file that is being written."""
PARTIAL_NAME = r"\.[^/]+\.[0-9a-f]{8}\.partial"
"""Pattern of the name of such a file: two processes that write the same file do not share it."""
AT_ONCE = 8
"""Files written through at once: the disk's journal takes many in one go."""
_EXCHANGE, _HERE = 2, -100
"""RENAME_EXCHANGE and AT_FDCWD of renameat2(2)."""
_NO_EXCHANGE = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
_NOT_FOR_FOLDERS = (errno.EINVAL, errno.EOPNOTSUPP, errno.EBADF)
"""What file systems that know no fsync of a folder answer, those of a network for instance."""


def _sync(place: Path, kind: int) -> None:
    file = os.open(place, os.O_RDONLY | kind | os.O_CLOEXEC)
    try:
        os.fsync(file)
    except OSError as error:
        if kind != os.O_DIRECTORY or error.errno not in _NOT_FOR_FOLDERS:
            raise
    finally:
        os.close(file)


def sync_file(place: Path) -> None:
    """Write a file's content through to the disk. Raises OSError."""
    _sync(place, os.O_NOFOLLOW)


def sync_folder(place: Path) -> None:
    """Write the names in a folder through to the disk. Raises OSError."""
    _sync(place, os.O_DIRECTORY)


def sync_tree(place: Path) -> None:
    """Write a folder with all that is below it through to the disk, the files first, itself last. Raises OSError."""
    tree = [(Path(folder), names) for folder, _, names in os.walk(place)]
    files = [folder / name for folder, names in tree for name in names if not (folder / name).is_symlink()]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(sync_file, files))
        list(pool.map(sync_folder, [folder for folder, _ in tree[1:]]))
    sync_folder(place)


def make_folders(place: Path) -> list[Path]:
    """Make a folder and those above it that are missing, so that they outlive a failure of the power.

    Returns
    -------
    list[Path]
        Those that were made, the deepest first.

    Raises
    ------
    OSError
        One cannot be made.
    """
    missing = [folder for folder in (place, *place.parents) if not folder.exists()]
    for folder in reversed(missing):
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)
    return missing


def write_safely(place: Path, content: bytes) -> None:
    """Write a file so that under its name it is whole or not there, whenever the power fails.

    Until then it is a hidden file beside its place with a name as ``PARTIAL_NAME``.

    Parameters
    ----------
    place : Path
        Of the file; its folder is there.
    content : bytes
        Of the file.

    Raises
    ------
    OSError
        The disk is full, or gone.
    """
    write_all_safely([(place, content)])


def write_all_safely(files: Iterable[tuple[Path, bytes]]) -> None:
    """Write several files with their contents as ``write_safely`` does; their folders are there.

    Raises
    ------
    OSError
        The disk is full, or gone; some may be there.
    """
    every = list(files)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(_write_one, every))
    for folder in {place.parent for place, _ in every}:
        sync_folder(folder)


def _write_one(file: tuple[Path, bytes]) -> None:
    place, content = file
    partial = place.with_name(f".{place.name}.{secrets.token_hex(4)}{PARTIAL}")
    try:
        with partial.open("wb") as out:
            out.write(content)
            out.flush()
            os.fsync(out.fileno())
        partial.replace(place)
    except OSError:
        with suppress(OSError):  # its place is wanted for what can be kept
            partial.unlink(missing_ok=True)
        raise


def exchange(first: Path, second: Path) -> bool:
    """Let two folders of one file system change places in one step: at no time is either name without one.

    Returns
    -------
    bool
        Whether it was done; not where the system or the file system does not know it.

    Raises
    ------
    OSError
        One of them is not there, or must not be renamed.
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


def put_in_place(new: Path, target: Path, aside: Path) -> None:
    """Put a folder in the place of another, which then stands aside; ``new`` is written through.

    A program that is killed meanwhile leaves the target as it was, or as it shall be. Only where folders cannot change
    places in one step it may leave none there; both then stand beside it.

    Parameters
    ----------
    new : Path
        What shall stand at ``target``.
    target : Path
        There is a folder.
    aside : Path
        Nothing is there.

    Raises
    ------
    OSError
        It cannot be done; all is as it was.
    """
    if exchange(new, target):
        try:
            os.rename(new, aside)
        except BaseException:
            exchange(new, target)
            raise
    else:
        os.rename(target, aside)
        try:
            os.rename(new, target)
        except BaseException:
            os.rename(aside, target)
            raise
    # what stands aside is removed next, which must not reach the disk before this
    sync_folder(target.parent)


def ending_signals() -> tuple[signal.Signals, ...]:
    """Signals that ask the program to end, Ctrl-C aside. SIGHUP does not when ``nohup`` has started it."""
    asked = (signal.SIGTERM, signal.SIGHUP)
    return tuple(number for number in asked if signal.getsignal(number) != signal.SIG_IGN)


@contextmanager
def _handled(asked: Iterable[int], handler: Callable[[int, object], None]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in asked}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def exit_on_terminate() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the program as an exception, as Ctrl-C does, so that a half-written run folder is
    removed. The exception that leaves the block is the signal's whatever became of it on its way: compiled modules turn
    one that comes while they are imported or call back into their own, and clearing up may fail after it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    got: list[int] = []

    def leave(number: int, frame: object) -> None:
        got.append(number)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        if len(got) == 1:  # a second one must not break off the clearing up
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
    """Heed Ctrl-C and signals that ask to end when the block is over, of what cannot be broken off."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    got: list[int] = []
    with _handled((signal.SIGINT, *ending_signals()), lambda number, frame: got.append(number)):
        yield
    for number in got:
        signal.raise_signal(number)
