"""Journal of finished parts of a command's work, an append-only file from which an interrupted command continues."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from optics.numerics.number_tree import FrozenMap
from twin.framework import durable, provenance
from twin.framework.run_folder import RunFolderError, reason

UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, RecursionError)
"""Exceptions raised on reading a line that has a right checksum but was not written by this program."""


class Journal:
    """Journal of a command's work: a file with one line for each finished part (piece) of it, as a context manager.

    A piece is on the disk (``fsync``) when ``keep`` returns. Every line begins with its own checksum, so that a line
    that was partly written at a power failure, or damaged later, is detected and skipped. The first line identifies the
    work and the program version, because results of two versions must not be mixed.

    Parameters
    ----------
    file
        File of the journal, made with the first piece; None keeps nothing.
    about
        Text of everything except the program that the results depend on.
    noun
        Name of the work in messages.
    classes
        Dataclasses that occur in pieces.

    Attributes
    ----------
    known
        Key -> piece, read from the file or kept since.
    damaged
        Number of damaged lines.

    Raises
    ------
    RunFolderError
        On entry: the file belongs to other work or another version of the program. At any time: the file cannot be
        used.
    """

    def __init__(self, file: Path | None, about: str, noun: str, classes: Sequence[type[Any]]) -> None:
        self.file, self.noun, self.classes = file, noun, classes
        self.known: dict[str, Any] = {}
        self.damaged = 0
        self._about = hashlib.sha256(about.encode()).hexdigest()
        self._out: BinaryIO | None = None
        self._begun = False

    def __enter__(self) -> Journal:
        """Open the file and read its pieces."""
        try:
            if self.file is not None and os.path.lexists(self.file):
                self._out = os.fdopen(os.open(self.file, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC), "r+b")
                content = self._out.read()
                # after a kill or a power failure the last line may be incomplete
                whole = content[: content.rfind(b"\n") + 1]
                self._out.seek(len(whole))
                self._out.truncate()
                head, self.known, self.damaged = read_pieces(whole, self.classes)
                self._begun = bool(whole)
                if whole:
                    self._check(head)
        except OSError as error:
            self._close()
            raise RunFolderError(f"cannot use {self.file}: {reason(error)}") from error
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Close the journal's file."""
        self._close()

    def _close(self) -> None:
        if self._out is not None:
            with suppress(OSError):  # a failure to write has been reported
                self._out.close()

    def keep(self, pieces: Mapping[str, Any]) -> None:
        """Append finished parts of the work with their keys, and write them through to the disk."""
        if self.file is not None and pieces:
            lines = [{"of": key, "is": _encoded(piece)} for key, piece in pieces.items()]
            try:
                self._write(self.file, lines if self._begun else [self._head(), *lines])
            except OSError as error:
                text = f"{self.file}: {reason(error)}; the finished work in it is kept, continue with --resume"
                raise RunFolderError(text) from error
        self.known.update(pieces)

    def _write(self, file: Path, lines: Sequence[Any]) -> None:
        """Append lines to the journal and write them through to the disk."""
        if self._out is None:
            durable.make_folders(file.parent)
            self._out = file.open("xb")
        self._out.write(b"".join(map(_line, lines)))
        self._out.flush()
        os.fsync(self._out.fileno())
        if not self._begun:
            durable.sync_folder(file.parent)
            self._begun = True

    def _head(self) -> dict[str, Any]:
        """Return the content of the first line: a description of the work and the versions of the program."""
        return {"about": self._about, "versions": provenance.versions(), "sources": provenance.sources()}

    def _check(self, head: Any) -> None:
        """Raise RunFolderError if the journal belongs to other work or another version of the program."""
        remedy = "start again without --resume, or choose another --out"
        try:
            if head["about"] != self._about:
                text = f"{self.file} holds another {self.noun}: the inputs of its results differ"
                raise RunFolderError(f"{text}; {remedy}")
            changed = _changes(
                head["versions"], provenance.versions(), lambda *names: "{} was {} and is {}".format(*names)
            )
            changed += _changes(head["sources"], provenance.sources(), lambda name, old, new: name)
        except UNREADABLE:
            raise RunFolderError(f"{self.file} cannot be read; {remedy}") from None
        if changed:
            raise RunFolderError(
                f"{self.file} was started with another version of the program, and results of two versions do not mix "
                f"(changed: {durable.first_names(changed)}); continue with the former version, or {remedy}"
            )


def read_pieces(content: bytes, classes: Sequence[type[Any]]) -> tuple[Any, dict[str, Any], int]:
    """Read the finished parts of work from the content of a journal.

    Parameters
    ----------
    content : bytes
        Complete lines.
    classes : sequence of type
        Dataclasses that occur in pieces.

    Returns
    -------
    tuple
        The first line (None if it is damaged), the pieces by their keys, and the number of damaged lines.
    """
    lines = [_parsed(line) for line in content.split(b"\n")[:-1]]
    known: dict[str, Any] = {}
    damaged = 0
    named = {cls.__name__: cls for cls in classes}
    for line in lines[1:]:
        try:
            known[line["of"]] = _decoded(line["is"], named)
        except UNREADABLE:
            damaged += 1
    return lines[0] if lines else None, known, damaged


def _line(data: Any) -> bytes:
    """Return data as a line of the journal, preceded by its checksum."""
    text = json.dumps(data).encode()
    return b"%s %s\n" % (_checksum(text), text)


def _parsed(line: bytes) -> Any:
    """Return the data of a line, or None if it is damaged."""
    check, _, text = line.partition(b" ")
    try:
        return json.loads(text) if check == _checksum(text) else None
    except UNREADABLE:
        return None


def _checksum(text: bytes) -> bytes:
    """Return the first 16 hexadecimal digits of a line's SHA-256."""
    return hashlib.sha256(text).hexdigest()[:16].encode()


def _changes(before: Mapping[str, str], now: Mapping[str, str], describe: Callable[[str, str, str], str]) -> list[str]:
    """Return a description of each entry (such as a package version) that differs between two mappings."""
    pairs = [(name, before.get(name, "missing"), now.get(name, "missing")) for name in sorted({*before, *now})]
    return [describe(name, old, new) for name, old, new in pairs if old != new]


def _encoded(value: Any) -> Any:
    """Return a result as plain data for JSON that preserve every bit of its numbers."""
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
        return {"array": str(value.dtype), "shape": list(value.shape), "data": data}
    if is_dataclass(value) and not isinstance(value, type):
        return {
            "class": type(value).__name__,
            "with": {f.name: _encoded(getattr(value, f.name)) for f in fields(value)},
        }
    if isinstance(value, Mapping):
        return {"map": {key: _encoded(item) for key, item in value.items()}}
    if isinstance(value, tuple):
        return [_encoded(item) for item in value]
    return float(value) if isinstance(value, np.floating) else value


def _decoded(value: Any, classes: Mapping[str, type[Any]]) -> Any:
    """Return the result that was encoded as plain data, as dataclasses and arrays again."""
    if isinstance(value, list):
        return tuple(_decoded(item, classes) for item in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        flat = np.frombuffer(base64.b64decode(value["data"]), dtype=value["array"])
        return flat.reshape(value["shape"]).copy()
    if "class" in value:
        return classes[value["class"]](**{key: _decoded(item, classes) for key, item in value["with"].items()})
    return FrozenMap({key: _decoded(item, classes) for key, item in value["map"].items()})
