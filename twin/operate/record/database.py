"""The database of a record: found by its address, opened, written by one writer at a time, its failures told."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, IntegrityError, NoSuchModuleError

from twin.operate.record.place import NotARecord, RecordFailed, file_of, require_file

WAIT = 60.0
"""Seconds that a writer waits for another one."""
_LOCK = 7_236_001
"""Number of the lock by which writers on a PostgreSQL server take turns."""


def url_of(place: str) -> URL:
    """Address of the database of a folder, or the address itself.

    Raises:
        NotARecord: not an address that SQLAlchemy knows.
    """
    if (file := file_of(place)) is not None:
        return URL.create("sqlite", database=str(file))
    try:
        return make_url(place)
    except (ArgumentError, ValueError):
        raise NotARecord("not an address of a database; write DIALECT://USER@HOST/DATABASE, or a folder") from None


def engine_of(url: URL) -> Engine:
    """What speaks to a database. Raises NotARecord: nothing that is installed does."""
    more: dict[str, Any] = {"connect_args": {"timeout": WAIT}} if url.get_backend_name() == "sqlite" else {}
    try:
        engine = create_engine(url, **more)
    except NoSuchModuleError:
        raise NotARecord(f"no such kind of database: {url.drivername}; sqlite or postgresql") from None
    except ModuleNotFoundError as error:
        raise NotARecord(
            f"{error.name} is not installed, which speaks to this database; for PostgreSQL: "
            ".venv/bin/python -m pip install -e .[postgres]"
        ) from None
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _on_connect)
        event.listen(engine, "begin", _on_begin)
    return engine


def _on_connect(connection: Any, record: object) -> None:
    """SQLAlchemy begins transactions, not the driver; each is on the disk, with its folder, before it is over."""
    connection.isolation_level = None
    for pragma in ("journal_mode = DELETE", "synchronous = EXTRA", "foreign_keys = ON", "trusted_schema = OFF"):
        connection.execute(f"PRAGMA {pragma}").close()


def _on_begin(connection: Connection) -> None:
    """A writer takes its turn before it reads what it is going to compare with."""
    writing = connection.get_execution_options().get("writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def opened(url: URL) -> Engine:
    """The database of a record that is there."""
    if url.get_backend_name() == "sqlite":
        require_file(Path(str(url.database)))
    return engine_of(url)


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """A transaction of the one writer of this moment."""
    with failures_told(), engine.connect().execution_options(writing=True) as connection, connection.begin():
        if engine.dialect.name == "postgresql":
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_LOCK})")
        yield connection


@contextmanager
def failures_told() -> Iterator[None]:
    """What a database says when it cannot do what it should. Raises RecordFailed."""
    try:
        yield
    except IntegrityError:
        raise
    except DBAPIError as error:
        raise RecordFailed(said(error)) from None


def said(error: DBAPIError) -> str:
    """What a database says of a failure, on one line."""
    return " ".join(str(error.orig).split())
