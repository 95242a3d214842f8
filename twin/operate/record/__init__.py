"""The record itself: what it holds, its database, how readings get into it, and its tables for other programs.

Where a record is, and what is wrong with it, stands here: a command tells it before it imports what reads a database.
"""

from __future__ import annotations

from pathlib import Path

FILE = "record.sqlite"
"""Of a record in a folder."""


class NotARecord(Exception):
    """A database that holds no record, or one of another version; the message says what to do."""


class RecordFailed(Exception):
    """The database did not do what it was asked: a full disk, a server that is gone. Nothing is half done."""


def require_file(file: Path) -> None:
    """Refuse the file of a record that is not there.

    Raises
    ------
    NotARecord
        It is not.
    """
    if not file.is_file():
        raise NotARecord(f"no record at {file}; python -m twin.operate init DIR INSTRUMENT makes one")


def file_of(place: str) -> Path | None:
    """The file of a record in a folder; None for the address of a database."""
    return None if "://" in place else Path(place).absolute() / FILE
