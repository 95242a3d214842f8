"""Database tables of a record, and the access to the database.

The tables have a version, and triggers that prevent every change of a row. Only one process at a time writes to a
database, and its failures are raised as `RecordFailed`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Connection,
    Engine,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    RowMapping,
    String,
    Table,
    Text,
    UniqueConstraint,
    create_engine,
    event,
    func,
    inspect,
    select,
    text,
)
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, IntegrityError, NoSuchModuleError

from twin.operate.record import NotARecord, RecordFailed, file_of, require_file
from twin.operate.record.entries import digest_of_data, utc_text

VERSION = 4
"""Version of the database tables, raised with each change of their columns."""
LAST_CHECKED = 500
"""Number of the newest entries whose digests are checked at every status; checking all of them takes too long."""
_METADATA = MetaData()
_NUMBER = BigInteger().with_variant(Integer(), "sqlite")
"""Column type of row ids; SQLite numbers rows automatically only if their type is INTEGER."""


def _table(name: str, *columns: Any) -> Table:
    return Table(name, _METADATA, Column("id", _NUMBER, primary_key=True, autoincrement=True), *columns)


def _digest(name: str, **more: Any) -> Column[Any]:
    return Column(name, String(64), **more)


SCHEMA = _table(
    "record_schema",
    Column("version", Integer, nullable=False, unique=True),
    Column("made_utc", String(32), nullable=False),
    Column("program", Text, nullable=False),
)
"""Table of the versions of the database tables, one row for each version that the record has had."""
INSTRUMENT = _table(
    "instrument",
    Column("name", Text, nullable=False),
    _digest("sha256", nullable=False, unique=True),
    Column("temperature_k", Text, nullable=False),
    Column("simulated", Boolean, nullable=False),
    Column("bodies", Text, nullable=False),
    Column("plain", Text, nullable=False),
)
"""Table with a single row, the instrument of the record."""
SOURCE = _table(
    "source",
    Column("file", Text, nullable=False),
    _digest("sha256", nullable=False),
    _digest("taking", key="ingest", nullable=False, unique=True),
    Column("taken_utc", String(32), nullable=False),
    Column("rows_read", Integer, nullable=False),
)
"""Table of ingested files, one row each.

``ingest`` (in the file: ``taking``) is the digest of the file and of the description with which it was read.
"""
FRAME = _table(
    "frame",
    Column("source_id", _NUMBER, ForeignKey("source.id"), nullable=False, index=True),
    Column("file", Text, nullable=False),
    _digest("sha256", nullable=False),
)
"""Table of the images (recorded frames of a monitor) in which the readings of a source file were measured."""
ENTRY = _table(
    "entry",
    _digest("sha256", nullable=False, unique=True),
    Column("kind", String(32), nullable=False),
    Column("subject", String(200), nullable=False),
    Column("time_us", BigInteger, nullable=False),
    Column("time_utc", String(32), nullable=False),
    Column("content", Text, nullable=False),
    Column("source_id", _NUMBER, ForeignKey("source.id"), nullable=False),
    Column("line", Integer),
    _digest("origin"),
    Index("entry_stream", "kind", "subject", "time_us"),
    Index("entry_origin", "origin"),
    Index("entry_time", "time_us", "id"),
)
"""Table of readings and events, one row each, with the fields of `twin.operate.record.entries.Entry`."""
REFUSED = _table(
    "refused",
    _digest("sha256", nullable=False, unique=True),
    Column("source_id", _NUMBER, ForeignKey("source.id"), nullable=False),
    Column("line", Integer),
    Column("reason", Text, nullable=False),
    _digest("entry"),
    Column("refused_utc", String(32), nullable=False),
    Index("refused_entry", "entry"),
)
"""Table of refused readings and table rows; ``entry`` is the digest of the reading, if it could be read."""
PLAN = _table(
    "plan",
    _digest("sha256", nullable=False),
    Column("file", Text, nullable=False),
    Column("content", Text, nullable=False),
    Column("kept_utc", String(32), nullable=False),
)
"""Table of the plans of operation under which the record was filtered; the newest is in force."""
ALARM = _table(
    "alarm",
    _digest("sha256", nullable=False, unique=True),
    Column("kind", String(32), nullable=False),
    Column("subject", String(200), nullable=False),
    Column("time_us", BigInteger, nullable=False),
    Column("raised_utc", String(32), nullable=False),
    Column("text", Text, nullable=False),
    Column("content", Text, nullable=False),
    Index("alarm_stream", "kind", "subject", "time_us"),
)
"""Table of alarms, one row each, with the fields of `twin.operate.record.entries.Alarm`."""
ACKNOWLEDGEMENT = _table(
    "acknowledgement",
    Column("alarm_id", _NUMBER, ForeignKey("alarm.id"), nullable=False, unique=True),
    Column("by", Text, nullable=False),
    Column("note", Text, nullable=False),
    Column("acknowledged_utc", String(32), nullable=False),
)
"""Table of the acknowledgements of alarms, one row each."""
CHECKPOINT = _table(
    "checkpoint",
    _digest("plan", nullable=False),
    Column("number", Integer, nullable=False),
    Column("time_us", BigInteger, nullable=False),
    Column("entry_id", _NUMBER, nullable=False),
    Column("content", LargeBinary, nullable=False),
    UniqueConstraint("plan", "number"),
    Index("checkpoint_time", "time_us"),
)
"""Table of saved states of estimates. They are derived from the entries, and are the only rows that may change."""
_DERIVED = (CHECKPOINT.name,)


def _triggers(table: Table) -> dict[str, str]:
    """Return name and SQL of the triggers that prevent altering, removing and replacing rows in SQLite.

    INSERT OR REPLACE removes rows without firing a trigger on DELETE. A trigger before INSERT therefore checks whether
    rows would be removed.
    """
    out, name = {}, table.name
    for what in ("UPDATE", "DELETE"):
        body = f"BEGIN SELECT RAISE(ABORT, 'a record is never altered: {what} of {name}'); END"
        out[f"{name}_no_{what.lower()}"] = f"CREATE TRIGGER {name}_no_{what.lower()} BEFORE {what} ON {name} {body}"
    same = " OR ".join(f"{c.name} = NEW.{c.name}" for c in table.columns if c.primary_key or c.unique)
    body = f"BEGIN SELECT RAISE(ABORT, 'a record is never altered: REPLACE of {name}'); END"
    there = f"WHEN EXISTS (SELECT 1 FROM {name} WHERE {same})"
    out[f"{name}_no_replace"] = f"CREATE TRIGGER {name}_no_replace BEFORE INSERT ON {name} {there} {body}"
    return out


def _guard(connection: Connection, table: Table) -> None:
    """Create the triggers that prevent changes of a table's rows, in SQLite or PostgreSQL.

    In other databases only the program prevents changes.
    """
    if connection.dialect.name == "sqlite":
        for sql in _triggers(table).values():
            connection.execute(text(sql))
    elif connection.dialect.name == "postgresql":
        for what in ("UPDATE", "DELETE", "TRUNCATE"):
            connection.execute(
                text(
                    f"CREATE TRIGGER {table.name}_no_{what.lower()} BEFORE {what} ON {table.name} "
                    "FOR EACH STATEMENT EXECUTE FUNCTION record_refuses()"
                )
            )


def guarded(connection: Connection) -> bool:
    """Return whether the database itself prevents changes of the record's rows."""
    if connection.dialect.name == "sqlite":
        rows = connection.execute(text("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'"))
        there = {name: " ".join(sql.split()) for name, sql in rows}
        expected = [_triggers(table) for table in _METADATA.sorted_tables if table.name not in _DERIVED]
        return there == {name: sql for triggers in expected for name, sql in triggers.items()}
    if connection.dialect.name != "postgresql":
        return False
    query = (
        "SELECT count(*) FROM pg_trigger WHERE tgname LIKE '%\\_no\\_%' "
        "AND tgrelid IN (SELECT oid FROM pg_class WHERE pg_table_is_visible(oid))"
    )
    return int(connection.execute(text(query)).scalar_one()) >= 2 * (len(_METADATA.tables) - len(_DERIVED))


def altered(connection: Connection, newest: int | None) -> tuple[int, list[str]]:
    """Compare entries (the newest ones, or all) with their digests; return their number and the errors found."""
    c = ENTRY.c
    rows = connection.execute(select(*c).order_by(c.id.desc()).limit(newest)).mappings().all()
    wrong = [
        f"entry {row['id']}, {row['kind']} of {row['subject']} at {row['time_utc']}, was altered after its ingest"
        for row in rows
        if _digest_of(row) != row["sha256"] or row["time_utc"] != utc_text(row["time_us"])
    ]
    if connection.dialect.name == "sqlite":  # its ids have no gaps
        held, last = connection.execute(select(func.count(), func.max(c.id)).select_from(ENTRY)).one()
        if held != (last or 0):
            missing = (last or 0) - held
            wrong.append(f"{missing} {'entry has' if missing == 1 else 'entries have'} been removed")
    return len(rows), wrong[::-1]


def _digest_of(row: RowMapping) -> str:
    try:
        content = json.loads(row["content"])
    except ValueError:
        return ""
    return digest_of_data([row["kind"], row["subject"], row["time_us"], content])


def create(connection: Connection) -> None:
    """Create all tables of this version, with their triggers."""
    _METADATA.create_all(connection)
    if connection.dialect.name == "postgresql":
        connection.execute(
            text(
                "CREATE OR REPLACE FUNCTION record_refuses() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
                "RAISE EXCEPTION 'a record is never altered: % of %', TG_OP, TG_TABLE_NAME; END $$"
            )
        )
    for table in _METADATA.sorted_tables:
        if table.name not in _DERIVED:
            _guard(connection, table)


def version(connection: Connection) -> int:
    """Return the version of the record in a database; 0 if there is none."""
    if not inspect(connection).has_table(SCHEMA.name):
        return 0
    return int(connection.execute(select(func.max(SCHEMA.c.version))).scalar_one() or 0)


def require_version(version: int) -> None:
    """Raise NotARecord if a different version of the program made the record."""
    if version != VERSION:
        raise NotARecord(
            f"the record has version {version}, this program needs {VERSION}; use the program that made it"
        )


WAIT = 60.0
"""Time that a writer waits for a second writer to finish, in seconds."""
_LOCK = 7_236_001
"""Number of the advisory lock that PostgreSQL grants to one writer at a time."""


def url_of(location: str) -> URL:
    """Return the address of the database of a folder, or the given address.

    Raises
    ------
    NotARecord
        SQLAlchemy does not know this address.
    """
    if (file := file_of(location)) is not None:
        return URL.create("sqlite", database=str(file))
    try:
        return make_url(location)
    except (ArgumentError, ValueError):
        raise NotARecord("not an address of a database; write DIALECT://USER@HOST/DATABASE, or a folder") from None


def engine_of(url: URL) -> Engine:
    """Return the SQLAlchemy engine that connects to a database.

    Raises
    ------
    NotARecord
        No driver for it is installed.
    """
    more: dict[str, Any] = {"connect_args": {"timeout": WAIT}} if url.get_backend_name() == "sqlite" else {}
    try:
        engine = create_engine(url, **more)
    except NoSuchModuleError:
        raise NotARecord(f"no such kind of database: {url.drivername}; allowed: sqlite, postgresql") from None
    except ModuleNotFoundError as error:
        raise NotARecord(
            f"the driver {error.name} of this database is not installed; for PostgreSQL: "
            ".venv/bin/python -m pip install -e .[postgres]"
        ) from None
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _on_connect)
        event.listen(engine, "begin", _on_begin)
    return engine


def _on_connect(connection: Any, record: object) -> None:
    """Configure a connection so that SQLAlchemy begins the transactions.

    Each transaction is written to the disk, with its folder, before it ends.
    """
    connection.isolation_level = None
    for pragma in ("journal_mode = DELETE", "synchronous = EXTRA", "foreign_keys = ON", "trusted_schema = OFF"):
        connection.execute(f"PRAGMA {pragma}").close()


def _on_begin(connection: Connection) -> None:
    """Begin a transaction; a writer locks the database first, so that the rows that it reads stay current."""
    writing = connection.get_execution_options().get("writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def opened(url: URL) -> Engine:
    """Return the SQLAlchemy engine of an existing record, after a check of its version."""
    if url.get_backend_name() == "sqlite":
        require_file(Path(str(url.database)))
    return engine_of(url)


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """Open a transaction that writes to the record and excludes all other writers."""
    with database_errors(), engine.connect().execution_options(writing=True) as connection, connection.begin():
        if engine.dialect.name == "postgresql":
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_LOCK})")
        yield connection


@contextmanager
def database_errors() -> Iterator[None]:
    """Raise RecordFailed for errors of the database, except integrity errors."""
    try:
        yield
    except IntegrityError:
        raise
    except DBAPIError as error:
        raise RecordFailed(message_of(error)) from None


def message_of(error: DBAPIError) -> str:
    """Return the message of a database error on one line."""
    return " ".join(str(error.orig).split())
