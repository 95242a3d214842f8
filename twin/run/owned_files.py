"""Whose the files in a run's or study's folder are: by their checksums, so that what somebody has changed is theirs."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

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

_AT_WORK = re.compile(
    "|".join(map(re.escape, (STUDY_LOCK, WRITTEN, SUCCEEDS)))
    + r"|chunks/(index\.txt|[0-9]+\.npz(\.corrupt)?)|(.*/)?\.[^/]+\.partial"
)
"""What a study keeps for itself; chunks have their checksums in their index."""
_BY_NAME = re.compile(rf"{re.escape(STUDY_STATE)}|config\.yaml|report\.html|study\.(nc|csv|parquet|json)")
"""What studies wrote that kept no account of it."""
_LAST = (MANIFEST, STUDY_STATE, WRITTEN)
"""They say whose all else is."""


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
    """Whether a study's folder is to take, or has just taken, the place of that other one as it is. Raises OSError."""
    place = new / SUCCEEDS
    return place.exists() and place.read_text("utf-8") == manifest_digest(old)
