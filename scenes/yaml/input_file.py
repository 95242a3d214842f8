"""Bytes and text of files that nobody has vetted: every file that a user names is read by one of these.

JSON that nobody has vetted: results in run folders, points of other programs.
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
"""Levels of mappings and lists in a file."""
_UNITS = ((10**9, "GB"), (10**6, "MB"), (10**3, "kB"), (1, "bytes"))


def read_bytes(path: str | Path, what: str, most: int, ends: Sequence[str]) -> bytes:
    """What a file holds.

    Parameters
    ----------
    path : str | Path
        Of the file.
    what : str
        It should be, for messages.
    most : int
        Bytes that it may have.
    ends : Sequence[str]
        Of names of the files beside it that may have been meant where there is none.

    Raises
    ------
    InputError
        There is none, it cannot be read or is too large.
    """
    file = str(path)
    # A device or a pipe could be endless or block.
    wrong = no_file(Path(path))
    if wrong == MISSING:
        meant = file_beside(Path(path), ends)
        raise InputError(Issue(wrong, file, suggestion=meant and str(Path(path).with_name(meant))))
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
    """The text of a file, UTF-8 with or without a mark; arguments as `read_bytes`.

    Raises
    ------
    InputError
        As `read_bytes`, and where it holds other than UTF-8 text.
    """
    content = read_bytes(path, what, most, ends)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        problem = f"not UTF-8 text: byte 0x{content[error.start]:02x}"
        raise InputError(Issue(problem, str(path), line)) from None


def why_unreadable(error: BaseException) -> str:
    """What a library's error tells a user about a damaged file, in at most 200 characters of one line.

    Libraries stumble over damaged files in ways that they do not foresee. A text that speaks of the inside of the
    program, such as the shapes of its arrays, helps nobody and is left out.
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
    """Whether there is a file; there is none of a name that no file can have."""
    return no_file(path) is None


def no_file(path: Path) -> str | None:
    """Why a path is not that of a regular file, found without opening it; None where it is.

    Parameters
    ----------
    path : Path
        Of what may be missing, or of a kind that could be endless or block: a device, a pipe.

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
    """Why a path is not that of a regular file, with the path, for a message at the key of the file that names it; of a
    path that is not a file's.
    """
    wrong = no_file(path) or MISSING
    return f"{wrong}: {path}" if wrong == MISSING else f"{path} {wrong}"


def digest_of(path: Path) -> str:
    """SHA-256 of a file that was read."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def file_beside(path: Path, ends: Sequence[str] = ()) -> str | None:
    """Name of the file in the same folder that was probably meant; None where none comes near.

    Parameters
    ----------
    path : Path
        Of a file that is not there.
    ends : Sequence[str]
        Of names that may have been meant; by default any.
    """
    try:
        names = sorted(place.name for place in path.parent.iterdir() if not ends or place.suffix in ends)
    except (OSError, ValueError):
        return None
    return nearest(path.name, names)


LARGEST_JSON = 500_000_000
"""Bytes of a file; a study of a million runs and twenty responses has a hundredth of it."""
MOST_DIGITS = 300
"""Most digits of a whole number, so that it is a finite floating-point number, too."""


def read_json(path: str | Path) -> Any:
    """Plain data of a JSON file.

    Raises
    ------
    InputError
        The file cannot be read, is too large or not JSON.
    """
    return parse_json(read_text(path, "a JSON file", LARGEST_JSON, (".json",)), str(path))


def parse_json(text: str, file: str) -> Any:
    """Plain data of JSON; `file` is what messages call it. NaN and infinities are taken, as Python writes them.

    Raises
    ------
    InputError
        It is not JSON, is nested deeper than YAML may be, or has whole numbers that no computation takes.
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
        level = [one for held in level for one in (held.values() if isinstance(held, dict) else held)]
        level = [one for one in level if isinstance(one, dict | list)]
        if not level:
            return data
    raise InputError(_too_deep(file))


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def _too_deep(file: str) -> Issue:
    return Issue("nested too deeply", file, allowed=f"at most {DEEPEST} levels")
