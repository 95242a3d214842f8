"""Reader of bytes, text and JSON of untrusted files.

Every file to which a user refers is read by one of these functions.
"""

import hashlib
import json
import re
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scenes.yaml.errors import InputError, Issue, nearest

DEEPEST = 32
"""Largest number of nested levels of mappings and lists in a file."""
_UNITS = ((10**9, "GB"), (10**6, "MB"), (10**3, "kB"), (1, "bytes"))


def read_bytes(path: str | Path, what: str, most: int, ends: Sequence[str]) -> bytes:
    """Read the bytes of a file.

    Parameters
    ----------
    path : str | Path
        Path of the file.
    what : str
        Noun phrase for the expected file, for messages.
    most : int
        Largest size, in bytes.
    ends : Sequence[str]
        Suffixes of files in the same folder that may be suggested if the file is missing.

    Raises
    ------
    InputError
        The file is missing, cannot be read or is too large.
    """
    file = str(path)
    # A device or a pipe could be endless or block.
    wrong = no_file(Path(path))
    if wrong == MISSING:
        near = file_beside(Path(path), ends)
        raise InputError(Issue(wrong, file, suggestion=near and str(Path(path).with_name(near))))
    if wrong is not None:
        raise InputError(Issue(wrong, file, allowed=what))
    try:
        with Path(path).open("rb") as stream:
            content = stream.read(most + 1)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(Issue(f"cannot be read: {reason or error}", file)) from None
    if len(content) > most:
        size = next(f"{most // unit} {name}" for unit, name in _UNITS if most >= unit)
        raise InputError(Issue("too large", file, allowed=f"at most {size}"))
    return content


def read_text(path: str | Path, what: str, most: int, ends: Sequence[str]) -> str:
    """Read the text of a file, UTF-8 with or without byte order mark.

    Parameters
    ----------
    path : str | Path
        Path of the file.
    what : str
        Noun phrase for the expected file, for messages.
    most : int
        Largest size, in bytes.
    ends : Sequence[str]
        Suffixes of files in the same folder that may be suggested if the file is missing.

    Raises
    ------
    InputError
        The file is missing, cannot be read, is too large or is not UTF-8 text.
    """
    content = read_bytes(path, what, most, ends)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        problem = f"not UTF-8 text: byte 0x{content[error.start]:02x}"
        raise InputError(Issue(problem, str(path), line)) from None


def why_unreadable(error: BaseException) -> str:
    """Return the message of a library's error about a damaged file, on one line of at most 200 characters.

    Libraries fail on damaged files in ways that they do not foresee. A text about the program's internals, such as
    shapes of arrays, does not help a user and is replaced by "it is damaged".
    """
    inside = isinstance(
        error, LookupError | AttributeError | TypeError | AssertionError | OverflowError | Warning | SystemExit
    )
    text = re.sub(r"\s+", " ", str(error)).strip()[:200]
    inside = inside or any(word in text for word in ("broadcast", "unpack", "ufunc"))
    return "it is damaged" if inside or not text else text


MISSING = "no such file"
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def is_file(path: Path) -> bool:
    """Return whether a path is that of a regular file; False also for a name that no file can have."""
    return no_file(path) is None


def no_file(path: Path) -> str | None:
    """Return why a path is not that of a regular file, without opening it; None if it is one.

    Parameters
    ----------
    path : Path
        Path that may be missing, or a device or pipe, which could be endless or block.

    Returns
    -------
    str | None
        MISSING, "is a directory, not a regular file", "cannot be read: ..." and the like.
    """
    try:
        mode = stat.S_IFMT(path.stat().st_mode)
    except FileNotFoundError:
        return MISSING
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        return f"cannot be read: {reason or error}"
    return None if mode == stat.S_IFREG else f"is {_KINDS.get(mode, 'something else')}, not a regular file"


def unusable(path: Path) -> str:
    """Return the message, with the path, for a path that is not that of a regular file.

    It is shown at the key of the file that has the path.
    """
    wrong = no_file(path) or MISSING
    return f"{wrong}: {path}" if wrong == MISSING else f"{path} {wrong}"


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a readable file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def file_beside(path: Path, ends: Sequence[str] = ()) -> str | None:
    """Return the name of the file in the same folder that was probably meant; None if none is near.

    Parameters
    ----------
    path : Path
        Path of a missing file.
    ends : Sequence[str]
        Suffixes of the files that may be meant; any by default.
    """
    try:
        names = sorted(entry.name for entry in path.parent.iterdir() if not ends or entry.suffix in ends)
    except (OSError, ValueError):
        return None
    return nearest(path.name, names)


LARGEST_JSON = 500_000_000
"""Largest size of a JSON file, in bytes; a study of a million runs with twenty responses has a hundredth of it."""
MOST_DIGITS = 300
"""Largest number of digits of a whole number, so that it is also a finite floating-point number."""


def read_json(path: str | Path) -> Any:
    """Read plain data from a JSON file.

    Raises
    ------
    InputError
        The file cannot be read, is too large or is not JSON.
    """
    return parse_json(read_text(path, "a JSON file", LARGEST_JSON, (".json",)), str(path))


def parse_json(text: str, file: str) -> Any:
    """Return plain data of JSON text; `file` is its name in messages.

    NaN and infinities are read as Python writes them.

    Raises
    ------
    InputError
        The text is not JSON, is nested deeper than YAML may be, or has a whole number that is too large.
    """
    try:
        data = json.loads(text, parse_int=_whole)
    except json.JSONDecodeError as error:
        raise InputError(Issue(f"not JSON: {error.msg}", file, error.lineno)) from None
    except RecursionError:
        raise InputError(_too_deep(file)) from None
    except ValueError as error:
        raise InputError(Issue(f"not JSON: {error}", file)) from None
    level = [data] if isinstance(data, dict | list) else []
    for _ in range(DEEPEST):
        level = [value for items in level for value in (items.values() if isinstance(items, dict) else items)]
        level = [value for value in level if isinstance(value, dict | list)]
        if not level:
            return data
    raise InputError(_too_deep(file))


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def _too_deep(file: str) -> Issue:
    return Issue("nested too deeply", file, allowed=f"at most {DEEPEST} levels")
