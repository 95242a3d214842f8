"""Record of an instrument: contents, database, ingest of readings, and tables for other programs.

The location of a record, and its errors, are defined here, so that a command can report them before it imports the
database library.
"""

from __future__ import annotations

from pathlib import Path

FILE = "record.sqlite"
"""File name of a record in a folder."""


class NotARecord(Exception):
    """Error of a database that holds no record, or one of a different version; the message gives a remedy."""


class RecordFailed(Exception):
    """Error of a database operation that failed, for example due to a full disk; its transaction was undone."""


def require_file(file: Path) -> None:
    """Raise an error if the file of a record does not exist.

    Raises
    ------
    NotARecord
        The file does not exist.
    """
    if not file.is_file():
        raise NotARecord(f"no record at {file}; python -m twin.operate init DIR INSTRUMENT makes one")


def file_of(location: str) -> Path | None:
    """Return the path of a record's file in a folder; None if the location is the address of a database."""
    return None if "://" in location else Path(location).absolute() / FILE
