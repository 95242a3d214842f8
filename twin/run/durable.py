"""Files and folders that outlive a failure of the power, and two folders that change places in one step.

A file system may keep what is written in memory for half a minute, and write names before what they stand for. So
whatever is to be relied on is written through (``fsync``) before the name that vouches for it: files before their
folder, a folder before it is renamed, the folder it stands in afterwards.
"""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

PARTIAL = ".partial"
"""Ending of a file that is being written."""
AT_ONCE = 8
"""Files written through at once: the disk's journal takes many in one go."""
_EXCHANGE, _HERE = 2, -100
"""RENAME_EXCHANGE and AT_FDCWD of renameat2(2)."""
_NO_EXCHANGE = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
_NOT_FOR_FOLDERS = (errno.EINVAL, errno.EOPNOTSUPP, errno.EBADF)
"""What file systems that know no fsync of a folder answer, those of a network for instance."""


def sync_file(place: Path) -> None:
    """Write a file's content through to the disk. Raises OSError."""
    file = os.open(place, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def sync_folder(place: Path) -> None:
    """Write the names in a folder through to the disk. Raises OSError."""
    folder = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno not in _NOT_FOR_FOLDERS:
            raise
    finally:
        os.close(folder)


def sync_tree(place: Path) -> None:
    """Write a folder with all that is below it through to the disk, the files first, itself last. Raises OSError."""
    folders, files = [], []
    for folder, _, names in os.walk(place):
        folders.append(Path(folder))
        files += [path for path in (Path(folder) / name for name in names) if not path.is_symlink()]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        for _ in pool.map(sync_file, files):
            pass
        for _ in pool.map(sync_folder, folders[1:]):
            pass
    sync_folder(place)


def make_folders(place: Path) -> list[Path]:
    """Make a folder and those above it that are missing, so that they outlive a failure of the power.

    Returns:
        Those that were made, the deepest first.

    Raises:
        OSError: one cannot be made.
    """
    made: list[Path] = []
    missing = [folder for folder in (place, *place.parents) if not folder.exists()]
    for folder in reversed(missing):
        folder.mkdir(exist_ok=True)
        made.insert(0, folder)
        sync_folder(folder.parent)
    return made


def write_safely(place: Path, content: bytes) -> None:
    """Write a file so that under its name it is whole or not there, whenever the power fails.

    Until then it is a hidden file beside its place that ends in ``PARTIAL``.

    Raises:
        OSError: the disk is full, or gone.
    """
    write_all_safely([(place, content)])


def write_all_safely(files: Iterable[tuple[Path, bytes]]) -> None:
    """As ``write_safely``, for several files with their contents, whose folders are there.

    Raises:
        OSError: the disk is full, or gone; some may be there.
    """
    given = list(files)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        for _ in pool.map(_write_one, given):
            pass
    for folder in {place.parent for place, _ in given}:
        sync_folder(folder)


def _write_one(file: tuple[Path, bytes]) -> None:
    place, content = file
    partial = place.with_name(f".{place.name}{PARTIAL}")
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

    Returns:
        Whether it was done; not where the system or the file system does not know it.

    Raises:
        OSError: one of them is not there, or must not be renamed.
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

    Args:
        new: what shall stand at ``target``.
        target: there is a folder.
        aside: nothing is there.

    Raises:
        OSError: it cannot be done; all is as it was.
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
