"""Finished pieces of a command's work, one appended table of them, from which it goes on after any end."""

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
from twin.framework import durable, owned_files, provenance
from twin.framework.run_folder import RunFolderError, reason

UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, RecursionError)
"""What a line raises that this program has not written, although its checksum is right."""


class Journal:
    """Context manager over a file with a line for each finished piece of work.

    A piece is on the disk (``fsync``) when ``keep`` returns. Every line begins with its own checksum, so that one that
    was half written when the power failed, or was damaged since, is seen and left out. The first line says what the
    work is about, and by which program it is done: numbers of two of them do not mix.

    Parameters
    ----------
    file
        Of the journal, made with the first piece; None keeps nothing.
    about
        All that the results depend on but for the program.
    noun
        What the work is, for messages.
    classes
        Dataclasses that pieces consist of.

    Attributes
    ----------
    known
        Key -> piece, those that the file held and those that were kept since.
    damaged
        Number of lines that are not as they were written.

    Raises
    ------
    RunFolderError
        On entering, the file is about other work, or of another program; then and later, it cannot be used.
    """

    def __init__(self, file: Path | None, about: str, noun: str, classes: Sequence[type[Any]]) -> None:
        self.file, self.noun, self.classes = file, noun, classes
        self.known: dict[str, Any] = {}
        self.damaged = 0
        self._about = hashlib.sha256(about.encode()).hexdigest()
        self._out: BinaryIO | None = None
        self._begun = False

    def __enter__(self) -> Journal:
        """Read what is there."""
        try:
            if self.file is not None and os.path.lexists(self.file):
                self._out = os.fdopen(os.open(self.file, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC), "r+b")
                content = self._out.read()
                # the last line of a process that was killed, or of a failure of the power, has no end
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
        """Close the file."""
        self._close()

    def _close(self) -> None:
        if self._out is not None:
            with suppress(OSError):  # what could not be written has been told
                self._out.close()

    def keep(self, pieces: Mapping[str, Any]) -> None:
        """Keep finished pieces by their keys."""
        if self.file is not None and pieces:
            lines = [{"of": key, "is": _encoded(piece)} for key, piece in pieces.items()]
            try:
                self._write(self.file, lines if self._begun else [self._head(), *lines])
            except OSError as error:
                text = f"{self.file}: {reason(error)}; what it holds is kept, go on with --resume"
                raise RunFolderError(text) from error
        self.known.update(pieces)

    def _write(self, file: Path, lines: Sequence[Any]) -> None:
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
        return {"about": self._about, "versions": provenance.versions(), "sources": provenance.sources()}

    def _check(self, head: Any) -> None:
        """Refuse to go on with other work, or with that of another program."""
        remedy = "begin anew without --resume, or choose another --out"
        try:
            if head["about"] != self._about:
                text = f"{self.file} holds another {self.noun}: what its results depend on differs"
                raise RunFolderError(f"{text}; {remedy}")
            changed = _changes(
                head["versions"], provenance.versions(), lambda *names: "{} was {} and is {}".format(*names)
            )
            changed += _changes(head["sources"], provenance.sources(), lambda name, old, new: name)
        except UNREADABLE:
            raise RunFolderError(f"{self.file} cannot be read; {remedy}") from None
        if changed:
            raise RunFolderError(
                f"{self.file} was begun with another version of the program, whose results would stand beside new ones "
                f"(changed: {owned_files.first_names(changed)}); go on with the program as it was, or {remedy}"
            )


def read_pieces(content: bytes, classes: Sequence[type[Any]]) -> tuple[Any, dict[str, Any], int]:
    """Read the content of a journal.

    Parameters
    ----------
    content : bytes
        Whole lines.
    classes : Sequence[type[Any]]
        Dataclasses that pieces consist of.

    Returns
    -------
    tuple[Any, dict[str, Any], int]
        The first line, None where it is damaged; the pieces by their keys; number of damaged lines.
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
    text = json.dumps(data).encode()
    return b"%s %s\n" % (_checksum(text), text)


def _parsed(line: bytes) -> Any:
    """The data of a line; None when it is not as it was written."""
    check, _, text = line.partition(b" ")
    try:
        return json.loads(text) if check == _checksum(text) else None
    except UNREADABLE:
        return None


def _checksum(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:16].encode()


def _changes(before: Mapping[str, str], now: Mapping[str, str], told: Callable[[str, str, str], str]) -> list[str]:
    pairs = [(name, before.get(name, "not there"), now.get(name, "not there")) for name in sorted({*before, *now})]
    return [told(name, old, new) for name, old, new in pairs if old != new]


def _encoded(value: Any) -> Any:
    """Plain data that hold every bit of a piece."""
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
        return {"array": str(value.dtype), "shape": list(value.shape), "data": data}
    if is_dataclass(value) and not isinstance(value, type):
        return {
            "class": type(value).__name__,
            "with": {f.name: _encoded(getattr(value, f.name)) for f in fields(value)},
        }
    if isinstance(value, Mapping):
        return {"map": {key: _encoded(one) for key, one in value.items()}}
    if isinstance(value, tuple):
        return [_encoded(one) for one in value]
    return float(value) if isinstance(value, np.floating) else value


def _decoded(value: Any, classes: Mapping[str, type[Any]]) -> Any:
    if isinstance(value, list):
        return tuple(_decoded(one, classes) for one in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        flat = np.frombuffer(base64.b64decode(value["data"]), dtype=value["array"])
        return flat.reshape(value["shape"]).copy()
    if "class" in value:
        return classes[value["class"]](**{key: _decoded(one, classes) for key, one in value["with"].items()})
    return FrozenMap({key: _decoded(one, classes) for key, one in value["map"].items()})
