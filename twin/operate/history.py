"""The record of one instrument: opened, added to, and read; what is in it is never altered."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, func, insert, select
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, IntegrityError, NoSuchModuleError

from optics.numerics.backend import load_backend
from scenes.models.instrument_builder import build_instrument
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.json_file import parse_json
from twin.operate import schema
from twin.operate.entries import MICRO, Entry, Given, Refused, canonical, digest_of_data, digest_of_job, now, utc_text
from twin.operate.schema import ENTRY, FRAME, INSTRUMENT, REFUSED, SOURCE, NotARecord
from twin.run.data_files import WRITER
from twin.run.durable import make_folders, sync_folder

FILE = "record.sqlite"
"""Of a record in a folder."""
WAIT = 60.0
"""Seconds that a writer waits for another one."""
_TOGETHER = 500
"""Rows asked for or written at once."""
_LOCK = 7_236_001
"""Number of the lock by which writers on a PostgreSQL server take turns."""
AHEAD = 24 * 3600 * MICRO
"""A reading later than this after the computer's clock comes of a clock that is wrong."""


class RecordFailed(Exception):
    """The database did not do what it was asked: a full disk, a server that is gone. Nothing is half done."""


@dataclass(frozen=True)
class Taken:
    """What became of one file.

    Attributes:
        file: its path.
        new: readings and events that are now in the record.
        known: that were in it already.
        refused: what was not taken: line, reason.
        before: whether the same file had been taken before.
    """

    file: str
    new: int
    known: int
    refused: tuple[tuple[int | None, str], ...]
    before: bool = False


def url_of(place: str) -> URL:
    """Address of the database of a folder, or the address itself.

    Raises:
        NotARecord: not an address that SQLAlchemy knows.
    """
    if "://" not in place:
        return URL.create("sqlite", database=str(Path(place).absolute() / FILE))
    try:
        return make_url(place)
    except (ArgumentError, ValueError):
        raise NotARecord("not an address of a database; write DIALECT://USER@HOST/DATABASE, or a folder") from None


def _engine(url: URL) -> Engine:
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


class History:
    """The record of one instrument in a database.

    Attributes:
        url: of the database, without its password.
        name: of the instrument.
        sha256: by which the instrument is recognised.
        temperature: of the instrument as its file states it, kelvin.
        simulated: whether its times are not compared with the computer's clock.
        bodies: ``warm``, paths of those that have a temperature; ``cameras``, their names.
    """

    def __init__(self, place: str) -> None:
        url = url_of(place)
        self._engine = _opened(url)
        self.url = url.render_as_string(hide_password=True)
        with self.reading() as connection:
            found = schema.version(connection)
            if found == 0:
                raise NotARecord(f"no record in {self.url}; python -m twin.operate init makes one")
            if found != schema.VERSION:
                schema.migrate(connection, found) if found > schema.VERSION else None
                raise NotARecord(
                    f"the record in {self.url} is of version {found}, this program writes {schema.VERSION}; "
                    "python -m twin.operate init with the same instrument brings it up"
                )
            row = connection.execute(select(INSTRUMENT)).mappings().one()
        self.name, self.sha256 = str(row["name"]), str(row["sha256"])
        self.temperature, self.simulated = float(row["temperature_k"]), bool(row["simulated"])
        self.bodies: dict[str, list[str]] = parse_json(row["bodies"], "the record")

    def close(self) -> None:
        """Let go of the database."""
        self._engine.dispose()

    def __enter__(self) -> History:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that sees the record at one moment."""
        with failures_told(), self._engine.connect() as connection, connection.begin():
            yield connection

    def take(self, given: Given, late: bool = False) -> Taken:
        """Add what a file holds, all of it in one step: after an interruption all of it is there, or nothing.

        Args:
            given: the file.
            late: whether readings may be older than the newest of their sort and subject in the record.

        Raises:
            RecordFailed: nothing was added.
        """
        for attempt in (True, False):
            try:
                with writing(self._engine) as connection:
                    return _Taking(self, connection, late).take(given)
            except IntegrityError as error:  # of databases without a lock: another writer was first
                if not attempt:
                    raise RecordFailed(_said(error)) from None
        raise AssertionError

    def entries(self, kind: str = "", subject: str = "") -> Iterator[dict[str, Any]]:
        """Readings and events in the order of time, those of one moment in the order in which they were taken.

        Args:
            kind: of reading; all if empty.
            subject: likewise.

        Yields:
            ``kind``, ``subject``, ``time_us``, ``time_utc``, ``sha256``, ``line``, ``file`` and ``content``, which is
            plain data.
        """
        query = select(*ENTRY.c, SOURCE.c.file).join(SOURCE, ENTRY.c.source_id == SOURCE.c.id)
        query = query.where(ENTRY.c.kind == kind) if kind else query
        query = query.where(ENTRY.c.subject == subject) if subject else query
        with self.reading() as connection:
            yield from map(dict, connection.execute(query.order_by(ENTRY.c.time_us, ENTRY.c.id)).mappings())

    def refusals(self) -> list[dict[str, Any]]:
        """What was refused, in the order in which it was; ``taken_since`` says whether the reading is there by now."""
        there = select(ENTRY.c.id).where(ENTRY.c.sha256 == REFUSED.c.entry).exists()
        query = select(*REFUSED.c, SOURCE.c.file, there.label("taken_since")).join(
            SOURCE, REFUSED.c.source_id == SOURCE.c.id
        )
        with self.reading() as connection:
            return [dict(row) for row in connection.execute(query.order_by(REFUSED.c.id)).mappings()]

    def status(self) -> dict[str, Any]:
        """What the record holds, as plain data."""
        c = ENTRY.c
        counted = select(c.kind, c.subject, func.count(c.id), func.min(c.time_us), func.max(c.time_us))
        with self.reading() as connection:
            streams = connection.execute(counted.group_by(c.kind, c.subject).order_by(c.kind, c.subject)).all()
            sources = int(connection.execute(select(func.count()).select_from(SOURCE)).scalar_one())
            guarded = schema.guarded(connection)
        refused = [
            {
                "file": row["file"],
                "line": row["line"],
                "reason": row["reason"],
                "refused_utc": row["refused_utc"],
                "taken_since": bool(row["taken_since"]),
            }
            for row in self.refusals()
        ]
        return {
            "record": self.url,
            "version": schema.VERSION,
            "instrument": self.name,
            "instrument_sha256": self.sha256,
            "simulated": self.simulated,
            "guarded": guarded,
            "files": sources,
            "entries": sum(row[2] for row in streams),
            "streams": [
                {"kind": k, "subject": s, "entries": n, "first_utc": utc_text(a), "last_utc": utc_text(b)}
                for k, s, n, a, b in streams
            ],
            "refused": refused,
            "open": sum(not one["taken_since"] for one in refused),
        }


class _Taking:
    """One file on its way into the record, in one transaction."""

    def __init__(self, history: History, connection: Connection, late: bool) -> None:
        self.history, self.connection, self.late = history, connection, late
        self.newest: dict[tuple[str, str], int | None] = {}
        self.seen: dict[tuple[str, str], int] = {}

    def take(self, given: Given) -> Taken:
        """Compare what the file holds with the record and add what is new."""
        taking = digest_of_data([given.sha256, given.meaning])
        source = self.connection.execute(select(SOURCE.c.id).where(SOURCE.c.taking == taking)).first()
        entries = [(one, one.digest) for one in given.items if isinstance(one, Entry)]
        known = self._known(ENTRY.c.sha256, [digest for _, digest in entries])
        digests, refused, kept = iter(entries), [], []
        again = 0
        for item in given.items:
            if isinstance(item, Refused):
                refused.append((item, item.entry.digest if item.entry else None))
                continue
            one, digest = next(digests)
            stream = (one.kind, one.subject)
            if digest in known:
                again += 1
            elif reason := self._wrong(one):
                refused.append((Refused(reason, one.line, one), digest))
                continue
            else:
                kept.append((one, digest))
                known.add(digest)
            self.seen[stream] = max(one.time, self.seen.get(stream, one.time))
        before = source is not None
        if kept or refused or not before:
            self._write(given, taking, None if source is None else int(source[0]), kept, refused)
        told = tuple((one.line, one.reason) for one, _ in refused)
        return Taken(given.file, len(kept), again, told, before)

    def _known(self, column: Any, digests: list[str]) -> set[str]:
        found: set[str] = set()
        for k in range(0, len(digests), _TOGETHER):
            query = select(column).where(column.in_(digests[k : k + _TOGETHER]))
            found |= set(self.connection.execute(query).scalars())
        return found

    def _wrong(self, one: Entry) -> str:
        """Why a reading that is new cannot be true of this record; empty where it can."""
        c, stream = ENTRY.c, (one.kind, one.subject)
        if not self.history.simulated and one.time > now() + AHEAD:
            return (
                f"{utc_text(one.time)} is still to come: the clock of the file, its time_scale or its epoch is wrong; "
                "a record of simulated readings is made with init --simulated"
            )
        if one.origin:
            query = select(c.time_utc).where(c.origin == one.origin, c.time_us != one.time).limit(1)
            if (other := self.connection.execute(query).scalar()) is not None:
                return f"found from the same frames as the reading of {other}; give it that time, or its own frames"
        if stream not in self.newest:
            query = select(func.max(c.time_us)).where(c.kind == one.kind, c.subject == one.subject)
            self.newest[stream] = self.connection.execute(query).scalar()
        newest, before = self.newest[stream], self.seen.get(stream)
        if before is not None and one.time < before:
            text = f"the clock runs backwards: {utc_text(one.time)} after {utc_text(before)}"
            return f"{text}; sort the rows, or leave out those before the clock was set"
        if before is not None and one.time == before:
            return f"another reading of {one.subject} at {utc_text(one.time)} in this file; one of them is wrong"
        if newest is not None and one.time <= newest:
            query = select(c.id).where(c.kind == one.kind, c.subject == one.subject, c.time_us == one.time).limit(1)
            if self.connection.execute(query).scalar() is not None:
                return f"the record has other numbers of {one.subject} at {utc_text(one.time)}, which stay"
            if not self.late:
                text = f"{utc_text(one.time)} is before the newest reading of {one.subject}, {utc_text(newest)}"
                return f"{text}: a clock that was set back, or a reading that comes late; --late takes it"
        return ""

    def _write(
        self,
        given: Given,
        taking: str,
        source: int | None,
        kept: list[tuple[Entry, str]],
        refused: list[tuple[Refused, str | None]],
    ) -> None:
        moment = utc_text(now())
        if source is None:
            row = {"file": given.file, "sha256": given.sha256, "taking": taking, "taken_utc": moment}
            written = self.connection.execute(insert(SOURCE).values(**row, rows_read=len(given.items)))
            source = int(written.inserted_primary_key[0])  # type: ignore[index]
            frames = [{"source_id": source, "file": f, "sha256": d} for f, d in given.frames.items()]
            self._insert(FRAME, frames)
        rows = [
            {
                "sha256": digest,
                "kind": one.kind,
                "subject": one.subject,
                "time_us": one.time,
                "time_utc": utc_text(one.time),
                "content": canonical(one.content),
                "source_id": source,
                "line": one.line,
                "origin": one.origin or None,
            }
            for one, digest in kept
        ]
        self._insert(ENTRY, rows)
        told = {
            digest_of_data([taking, one.line, one.reason, entry]): {
                "source_id": source,
                "line": one.line,
                "reason": one.reason,
                "entry": entry,
                "refused_utc": moment,
            }
            for one, entry in refused
        }
        there = self._known(REFUSED.c.sha256, list(told))
        self._insert(REFUSED, [{"sha256": key, **row} for key, row in told.items() if key not in there])

    def _insert(self, table: Any, rows: list[dict[str, Any]]) -> None:
        for k in range(0, len(rows), _TOGETHER):
            self.connection.execute(insert(table), rows[k : k + _TOGETHER])


def content_of(row: Mapping[str, Any]) -> Any:
    """What a row of `History.entries` holds, plain data."""
    return parse_json(row["content"], "the record")


def bodies_of(job: ResolvedJob) -> dict[str, list[str]]:
    """Paths of the bodies of a job's instrument that have a temperature, and names of its cameras."""
    nodes = build_instrument(job.instrument, job.cameras, load_backend()).nodes
    warm = [path for path, info in nodes.items() if "temperature" in info.allows]
    return {"warm": warm, "cameras": list(job.instrument.cameras)}


def initialised(place: str, job: ResolvedJob, simulated: bool = False) -> tuple[int, ...]:
    """Make a record, or bring one of an earlier version up to this one.

    Args:
        place: folder, or address of a database.
        job: one on the instrument.
        simulated: whether times are not compared with the computer's clock.

    Returns:
        Versions that the record has passed: this one of a new record, none where nothing was to be done.

    Raises:
        NotARecord: there is one of another instrument, or of a later version.
        RecordFailed: it cannot be made.
    """
    url = url_of(place)
    folder = Path(str(url.database)).parent if url.get_backend_name() == "sqlite" and "://" not in place else None
    if folder is not None:
        try:
            make_folders(folder)
        except OSError as error:
            raise NotARecord(f"no folder can be made at {folder}: {error.strerror}") from None
    engine, digest = _engine(url), digest_of_job(job)
    try:
        with writing(engine) as connection:
            found = schema.version(connection)
            passed = schema.migrate(connection, found) if found else (schema.VERSION,)
            if not found:
                schema.create(connection)
                row = {"name": job.instrument.name, "sha256": digest, "simulated": simulated}
                row |= {"temperature_k": repr(job.instrument.temperature), "bodies": canonical(bodies_of(job))}
                row |= {"plain": canonical(job.plain()["instrument"])}
                connection.execute(insert(INSTRUMENT).values(**row))
            own = connection.execute(select(INSTRUMENT)).mappings().one()
            if own["sha256"] != digest:
                raise NotARecord(
                    f"the record is of {own['name']} ({own['sha256'][:12]}), not of {job.instrument.name} "
                    f"({digest[:12]}): what an instrument is does not change in its record; make another record"
                )
            program = f"{WRITER} {importlib.metadata.version(WRITER)}"
            rows = [{"version": one, "made_utc": utc_text(now()), "program": program} for one in passed]
            if rows:
                connection.execute(insert(schema.SCHEMA), rows)
    finally:
        engine.dispose()
    if folder is not None:
        sync_folder(folder)
    return passed


def _opened(url: URL) -> Engine:
    """The database of a record that is there."""
    if url.get_backend_name() == "sqlite" and not Path(str(url.database)).is_file():
        raise NotARecord(f"no record at {url.database}; python -m twin.operate init DIR INSTRUMENT makes one")
    return _engine(url)


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
        raise RecordFailed(_said(error)) from None


def _said(error: DBAPIError) -> str:
    return " ".join(str(error.orig).split())
