"""Whose the files in and beside a run's or study's folder are.

In the folder checksums tell: a file that somebody has changed is theirs. Beside it stand hidden names of a folder that
is being made or replaced, ``.NAME.TOKEN.partial`` (a run that is being written), ``.NAME.TOKEN.old`` (what it replaces)
and ``.NAME.TOKEN.lock``, which the process holds locked as long as it lives. The lock is the operating system's and
ends with the process, however that ends; so a name without a held lock is nobody's. A study that is to replace a
folder, and can be resumed, grows in ``.NAME.next`` (`successor`).
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from twin.run import durable

MANIFEST = "manifest.json"
STUDY_STATE = "study_state.json"
"""Says which study a folder belongs to, from the beginning; the manifest is written at the end."""
STUDY_LOCK = ".lock"
"""File in the folder of a study that its command holds locked."""
WRITTEN = ".written"
"""What the study in a folder has written beside its chunks: a line ``CHECKSUM NAME`` for each file, before the file
gets its name. It goes when the manifest says the same.
"""
SUCCEEDS = ".succeeds"
"""File in a study's folder that is to take the place of another: the checksum of that one's manifest, empty where there
is none.
"""

NAMED = 5
"""Files that a message names at most."""
_AT_WORK = re.compile(
    "|".join(map(re.escape, (STUDY_LOCK, WRITTEN, SUCCEEDS)))
    + r"|chunks/(index\.txt|[0-9]+\.npz(\.corrupt)?)|(.*/)?"
    + durable.PARTIAL_NAME
)
"""What a study keeps for itself; chunks have their checksums in their index."""
_BY_NAME = re.compile(rf"{re.escape(STUDY_STATE)}|config\.yaml|report\.html|study\.(nc|csv|parquet|json)")
"""What studies wrote that kept no account of it."""
_LAST = (MANIFEST, STUDY_STATE, WRITTEN)
"""They say whose all else is."""


def first_names(names: Sequence[str], most: int = NAMED) -> str:
    """A list of names for a message: the first of them, and how many more there are.

    Args:
        names: all of them.
        most: how many are named.
    """
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def every_file(folder: Path) -> list[str]:
    """Paths of all that stands in a folder and is not a folder itself, relative to it, in order."""
    out = []
    for place, folders, files in os.walk(folder):
        names = [*files, *(name for name in folders if os.path.islink(os.path.join(place, name)))]
        out += [(Path(place) / name).relative_to(folder).as_posix() for name in names]
    return sorted(out)


def is_study(folder: Path) -> bool:
    """Whether a folder says that it is a study's."""
    try:
        state = json.loads((folder / STUDY_STATE).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(state, dict) and state.get("program") == "twin.study" and "fingerprint" in state


def foreign_files(folder: Path, listed: Mapping[str, str] | None, study: bool | None = None) -> list[str] | None:
    """Files that a run or study did not write, or not with these contents; None in the folder of neither.

    Args:
        folder: to be looked at.
        listed: files of the run and their SHA-256, None where there is no manifest.
        study: whether it is a study's, None to see.

    Raises:
        OSError: a file cannot be read.
    """
    study = is_study(folder) if study is None else study
    if listed is None and not study:
        return None
    known = set(listed.items()) if listed is not None else set()
    account = _account(folder) if study else None
    known |= account or set()
    names = {name for name, _ in known}

    def own(name: str) -> bool:
        if (listed is not None and name == MANIFEST) or (study and _AT_WORK.fullmatch(name)):
            return True
        if name not in names:
            return study and listed is None and account is None and _BY_NAME.fullmatch(name) is not None
        place = folder / name
        return place.is_file() and not place.is_symlink() and (name, digest(place)) in known

    return [name for name in every_file(folder) if not own(name)]


def digest(place: Path) -> str:
    """SHA-256 of a file. Raises OSError."""
    with place.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _account(folder: Path) -> set[tuple[str, str]] | None:
    """Names and checksums of what a study has written, None where it keeps no account of it."""
    try:
        lines = (folder / WRITTEN).read_text("utf-8").splitlines()
    except (OSError, ValueError):
        return None
    return {(name, check) for check, _, name in (line.partition(" ") for line in lines)}


def remove_files(folder: Path, kept: set[str]) -> None:
    """Remove all files of a folder but some, and the folder if that was all. What says whose they are goes last.

    Args:
        folder: to be removed.
        kept: files that stay, paths relative to it.
    """
    names = [name for name in every_file(folder) if name not in kept]
    for name in sorted(names, key=lambda name: (name in _LAST, name)):
        (folder / name).unlink(missing_ok=True)
    for place, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):  # somebody else has put something there
            os.rmdir(place)


def remove_study(folder: Path) -> None:
    """Remove a study's files from its folder, and the folder if that was all. Raises OSError."""
    remove_files(folder, {*(foreign_files(folder, None, study=True) or ())})


def manifest_digest(folder: Path) -> str:
    """SHA-256 of a folder's manifest, empty where it has none. Raises OSError."""
    return digest(folder / MANIFEST) if (folder / MANIFEST).exists() else ""


def succeeds(new: Path, old: Path) -> bool:
    """Whether a study's folder is to take, or has just taken, the place of that other one as it is. Raises OSError.

    Args:
        new: folder of the study.
        old: the folder whose place it takes.
    """
    place = new / SUCCEEDS
    return place.exists() and place.read_text("utf-8") == manifest_digest(old)


PARTIAL, OLD, LOCK = "partial", "old", "lock"

_NAME = re.compile(rf"\.(?P<name>.+)\.(?P<token>[0-9a-f]{{8}})\.(?:{PARTIAL}|{OLD}|{LOCK})")


def successor(target: Path) -> Path:
    """Where a study grows that is to take the place of ``target``; whoever resumes it finds it there. It is nobody's to
    clear away, for hours of work may be in it.
    """
    return target.with_name(f".{target.name}.next")


class Unfinished:
    """Hidden names beside ``target`` that are this process's own until ``close``.

    Args:
        target: the folder that is being made; the one it stands in exists.

    Raises:
        OSError: nothing can be written beside it.
    """

    def __init__(self, target: Path) -> None:
        self._target = target
        self._token, self._lock = self._locked()

    def _locked(self) -> tuple[str, TextIO]:
        while True:
            token = secrets.token_hex(4)
            place = self._beside(token, LOCK)
            lock = place.open("x", encoding="utf-8")
            # whoever sweeps the folder between these lines takes the file for one that a killed process left
            if (
                take_lock(lock) is not False
                and place.exists()
                and os.path.samestat(os.fstat(lock.fileno()), place.stat())
            ):
                return token, lock
            lock.close()

    def _beside(self, token: str, ending: str) -> Path:
        return self._target.with_name(f".{self._target.name}.{token}.{ending}")

    def path(self, ending: str) -> Path:
        """The hidden name with that ending, PARTIAL or OLD."""
        return self._beside(self._token, ending)

    def close(self) -> None:
        """Give the names up; nothing is to stand under them any more."""
        self._beside(self._token, LOCK).unlink(missing_ok=True)
        self._lock.close()


@contextmanager
def scratch(stem: str) -> Iterator[Path]:
    """A folder of this user alone for what ends with the block, where the system has such. What killed processes left
    of theirs under this name goes first; what belongs to a live one, or to somebody else, is not touched.

    Raises:
        OSError: it cannot be made.
    """
    above = Path(tempfile.gettempdir())
    for left in above.glob(f"{stem}-*.{LOCK}"):
        with suppress(OSError):  # somebody else's, or gone meanwhile
            _clear_scratch(left)
    while True:
        folder = above / f"{stem}-{secrets.token_hex(8)}"
        place = _lock_of(folder)
        lock = os.open(place, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        # whoever clears up between these lines takes the file for one that a killed process left
        if take_lock(lock) is not False and place.exists():
            break
        os.close(lock)
    try:
        folder.mkdir(mode=0o700)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        place.unlink(missing_ok=True)
        os.close(lock)


def _lock_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.{LOCK}")


def _clear_scratch(place: Path) -> None:
    """Remove a folder of `scratch` whose lock nobody holds. Raises OSError."""
    lock = os.open(place, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        about, folder = os.fstat(lock), place.with_suffix("")
        if about.st_uid != os.getuid() or not stat.S_ISREG(about.st_mode) or not take_lock(lock):
            return
        if folder.is_dir() and not folder.is_symlink() and folder.lstat().st_uid == os.getuid():
            shutil.rmtree(folder)
        place.unlink(missing_ok=True)
    finally:
        os.close(lock)


def sweep(folder: Path, replaced: Callable[[Path, Path], bool]) -> None:
    """Clear away what dead processes left in ``folder``; what belongs to a live one is not touched.

    What was half written is removed. What was to be replaced is put back when nothing has taken its place.

    Args:
        folder: where runs stand.
        replaced: given what was to be replaced and what has its place now; removes the former, if that is right, and
            returns whether it did.
    """
    try:
        found = {(m["name"], m["token"]) for path in folder.iterdir() if (m := _NAME.fullmatch(path.name))}
    except OSError:  # a folder that cannot be read is told of when it is written to
        return
    for name, token in sorted(found):
        places = {ending: folder / f".{name}.{token}.{ending}" for ending in (PARTIAL, OLD, LOCK)}
        try:
            lock = places[LOCK].open("r+", encoding="utf-8")
        except FileNotFoundError:
            lock = None
        except OSError:  # somebody else's, or no file at all
            continue
        try:
            if lock is None or take_lock(lock):
                _clear(folder / name, places, replaced)
        except OSError:  # not ours to remove; it stays for who may
            pass
        finally:
            if lock is not None:
                lock.close()


def _clear(target: Path, places: dict[str, Path], replaced: Callable[[Path, Path], bool]) -> None:
    if places[PARTIAL].is_dir() and not places[PARTIAL].is_symlink():
        if (places[PARTIAL] / MANIFEST).exists() and target.exists() and not places[OLD].exists():
            # complete: it has changed places with the target, or was about to
            places[PARTIAL].rename(places[OLD])
        else:
            shutil.rmtree(places[PARTIAL])
    if places[OLD].is_dir() and not places[OLD].is_symlink():
        if not (target.exists() or target.is_symlink()):
            places[OLD].rename(target)
        elif not replaced(places[OLD], target):
            return
    places[LOCK].unlink(missing_ok=True)


def take_lock(lock: TextIO | int) -> bool | None:
    """Lock a file and return whether that was done: False when another process has it, None where none can be had."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
