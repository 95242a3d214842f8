"""Record of one instrument in a database: ingest of readings, exclusions, and queries, also for an earlier time.

Entries are never altered.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Row, delete, func, insert, select
from sqlalchemy.exc import IntegrityError

from optics.numerics.backend import load_backend
from scenes.models.instrument_builder import build_instrument
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import Problem, names_text
from scenes.yaml.input_file import parse_json
from twin.framework.data_files import WRITER
from twin.framework.durable import make_folders, sync_folder
from twin.operate.record import NotARecord, RecordFailed, schema
from twin.operate.record.entries import (
    DECISION,
    Alarm,
    Entry,
    FileContent,
    canonical,
    digest_of_data,
    digest_of_job,
    now,
    utc_text,
)
from twin.operate.record.ingest import Ingest, IngestResult
from twin.operate.record.schema import (
    ACKNOWLEDGEMENT,
    ALARM,
    CHECKPOINT,
    ENTRY,
    INSTRUMENT,
    PLAN,
    REFUSED,
    SOURCE,
    database_errors,
    engine_of,
    message_of,
    opened,
    url_of,
    writing,
)

USED = ("monitor", "temperature")
"""Kinds of entries that the estimate uses as observations; events are used as times at which motions may step."""
DECIDED = (*USED, "focus", "move")
"""Kinds of entries that a person may exclude from the estimate."""


class History:
    """Record of one instrument in a database.

    Parameters
    ----------
    place
        Folder or address of the record.
    until
        Time of an earlier state of the record, in microseconds of TAI since 2000: readings after it are hidden, and
        only the traced model can be added. None for the whole record.

    Attributes
    ----------
    url
        Address of the database, without its password.
    name
        Name of the instrument.
    sha256
        SHA-256 that identifies the instrument.
    temperature
        Reference temperature of the instrument, in kelvin.
    simulated
        Whether the readings are simulated, so that their times are not compared with the computer's clock.
    bodies
        ``warm``: paths of the bodies that have a temperature; ``cameras``: names of the cameras.
    """

    def __init__(self, location: str, until: int | None = None) -> None:
        url, self._until = url_of(location), until
        self._engine = opened(url)
        self.url = url.render_as_string(hide_password=True)
        with self.reading() as connection:
            version = schema.version(connection)
            if version == 0:
                raise NotARecord(f"no record in {self.url}; python -m twin.operate init makes one")
            schema.require_version(version)
            row = connection.execute(select(INSTRUMENT)).mappings().one()
        self.name, self.sha256 = str(row["name"]), str(row["sha256"])
        self.temperature, self.simulated = float(row["temperature_k"]), bool(row["simulated"])
        self.bodies: dict[str, list[str]] = parse_json(row["bodies"], "the record")

    def close(self) -> None:
        """Close the database."""
        self._engine.dispose()

    def __enter__(self) -> History:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Open a read transaction, which sees the record at one moment."""
        with database_errors(), self._engine.connect() as connection, connection.begin():
            yield connection

    def ingest(self, content: FileContent, late: bool = False) -> IngestResult:
        """Add the content of a file in one transaction: after an interruption all of it is in the record, or nothing.

        Parameters
        ----------
        content : FileContent
            Content of the file.
        late : bool
            Accept readings older than the newest of their kind and subject in the record.

        Returns
        -------
        IngestResult
            Numbers of new and known entries, and the refusals.

        Raises
        ------
        RecordFailed
            The database failed; nothing was added.
        TypeError
            The record is that of an earlier time.
        """
        if self._until is not None:
            raise TypeError("an earlier state of a record cannot be changed")
        for attempt in (True, False):
            try:
                with writing(self._engine) as connection:
                    return Ingest(connection, self.simulated, late).ingest(content)
            except IntegrityError as error:  # in databases without a lock another writer may be first
                if not attempt:
                    raise RecordFailed(message_of(error)) from None
        raise AssertionError

    def decide(self, number: int, included: bool, why: str) -> dict[str, Any]:
        """Exclude an entry from the estimate or include it again; the newest decision on an entry is valid.

        The decision is stored as an entry itself.

        Parameters
        ----------
        number : int
            Id of the entry, of one of the kinds in `DECIDED`.
        included : bool
            True to use the entry from now on, False to exclude it.
        why : str
            Reason of the decision.

        Returns
        -------
        dict[str, Any]
            ``entry``, ``kind``, ``subject``, ``time_utc``, ``included`` and ``why``.

        Raises
        ------
        Problem
            There is no such reading, or the newest decision is the same.
        """
        c = ENTRY.c
        with writing(self._engine) as connection:
            row = connection.execute(select(ENTRY).where(c.id == number, c.kind.in_(DECIDED))).mappings().first()
            if row is None:
                allowed = (
                    "a reading of the monitor, temperature, focus or move; export writes the numbers of all entries"
                )
                raise Problem("no such reading", str(number), allowed)
            decisions = select(c.content).where(c.kind == DECISION, c.subject == str(number)).order_by(c.id)
            before = [parse_json(decision, "the record") for decision in connection.execute(decisions).scalars()]
            if before and before[-1]["included"] == included:
                text = f"entry {number} is {'included' if included else 'excluded'} already"
                raise Problem(text, None, f"another decision; the reason then: {before[-1]['why']}")
            content = {
                "entry": number,
                "sha256": row["sha256"],
                "included": included,
                "why": why,
                "number": len(before),
            }
            decision = Entry(DECISION, str(number), int(row["time_us"]), content)
            file_content = FileContent("twin.operate exclude", digest_of_data(content), decision.digest, [decision], {})
            Ingest(connection, self.simulated, True).write(
                file_content, decision.digest, None, [(decision, decision.digest)], {}
            )
        keys = {key: row[key] for key in ("kind", "subject", "time_utc")}
        return {"entry": number, **keys, "included": included, "why": why}

    def entries(self, kind: str = "", after_us: int | None = None) -> Iterator[dict[str, Any]]:
        """Yield readings and events in the order of time; those of one time in the order in which they were ingested.

        SQLite cannot be written while they are read: collect the required entries before writing.

        Parameters
        ----------
        kind : str
            Kind of reading; all kinds if empty.
        after_us : int | None
            Yield only entries after this time, in microseconds of TAI since 2000.

        Yields
        ------
        dict[str, Any]
            ``id``, ``kind``, ``subject``, ``time_us``, ``time_utc``, ``sha256``, ``line``, ``file`` and ``content``
            (plain data as text).
        """
        c = ENTRY.c
        query = select(*c, SOURCE.c.file).join(SOURCE, c.source_id == SOURCE.c.id)
        query = query.where(*_not_after(c.time_us, self._until))
        query = query.where(c.kind == kind) if kind else query
        query = query if after_us is None else query.where(c.time_us > after_us)
        with self.reading() as connection:
            if kind and not (
                after_us is None and self._until is None
            ):  # one index lookup for each subject instead of a scan
                query = query.where(c.subject.in_(_subjects(connection, kind)))
            yield from map(dict, connection.execute(query.order_by(c.time_us, c.id)).mappings())

    def refusals(self) -> list[dict[str, Any]]:
        """Return the refusals in the order in which they were recorded.

        The value of ``taken_since`` is True if the refused reading has been ingested since.
        """
        there = select(ENTRY.c.id).where(ENTRY.c.sha256 == REFUSED.c.entry).exists()
        query = select(*REFUSED.c, SOURCE.c.file, there.label("taken_since")).join(
            SOURCE, REFUSED.c.source_id == SOURCE.c.id
        )
        with self.reading() as connection:
            return [dict(row) for row in connection.execute(query.order_by(REFUSED.c.id)).mappings()]

    def status(self, check_all_entries: bool = False) -> dict[str, Any]:
        """Return a summary of the record as plain data: instrument, entries by kind and subject, checks, refusals.

        Parameters
        ----------
        check_all_entries : bool
            True to check the digests of all entries, instead of the newest ones only.
        """
        with self.reading() as connection:
            streams = [
                (kind, subject, *_stream_extent(connection, kind, subject)) for kind, subject in _streams(connection)
            ]
            sources = int(connection.execute(select(func.count()).select_from(SOURCE)).scalar_one())
            guarded = schema.guarded(connection)
            checked, altered = schema.altered(connection, None if check_all_entries else schema.LAST_CHECKED)
        keys = ("file", "line", "reason", "refused_utc")
        refused = [
            {**{key: row[key] for key in keys}, "taken_since": bool(row["taken_since"])} for row in self.refusals()
        ]
        return {
            "record": self.url,
            "version": schema.VERSION,
            "instrument": self.name,
            "instrument_sha256": self.sha256,
            "simulated": self.simulated,
            "guarded": guarded,
            "entries_checked": checked,
            "altered": altered,
            "files": sources,
            "entries": sum(row[2] for row in streams),
            "streams": [
                {"kind": k, "subject": s, "entries": n, "first_utc": utc_text(a), "last_utc": utc_text(b)}
                for k, s, n, a, b in streams
            ],
            "refused": refused,
            "open": sum(not refusal["taken_since"] for refusal in refused),
        }

    def store_plan(self, file: str, content: Mapping[str, Any]) -> bool:
        """Store a plan of operation, which is in force from now on.

        Parameters
        ----------
        file : str
            File that the plan was read from.
        content : Mapping[str, Any]
            Plain data of the plan.

        Returns
        -------
        bool
            True if it differs from the newest stored plan.
        """
        digest = digest_of_data(content)
        with writing(self._engine) as connection:
            newest = select(PLAN.c.sha256).order_by(PLAN.c.id.desc()).limit(1)
            if connection.execute(newest).scalar() == digest:
                return False
            # keep the order of cameras and causes, which is that of all results
            text = json.dumps(content, allow_nan=False, ensure_ascii=False)
            row = {"sha256": digest, "file": file, "content": text, "kept_utc": utc_text(now())}
            connection.execute(insert(PLAN).values(**row))
        return True

    def plan(self) -> dict[str, Any] | None:
        """Return the newest plan (``sha256``, ``file``, ``content`` and ``kept_utc``); None if none is stored."""
        with self.reading() as connection:
            row = connection.execute(select(PLAN).order_by(PLAN.c.id.desc()).limit(1)).mappings().first()
        return None if row is None else {**row, "content": content_of(dict(row))}

    def first(self, kind: str) -> dict[str, Any] | None:
        """Return the earliest entry of a kind, as a mapping like those of `entries`; None if there is none."""
        c = ENTRY.c
        with self.reading() as connection:
            # query each subject by the index, which orders by subject before time
            rows = [
                connection.execute(
                    select(*c).where(c.kind == kind, c.subject == stream_subject).order_by(c.time_us, c.id).limit(1)
                )
                .mappings()
                .one()
                for stream_subject in _subjects(connection, kind)
            ]
        return dict(min(rows, key=lambda row: (row["time_us"], row["id"]))) if rows else None

    def subjects(self, kind: str) -> list[str]:
        """Return the subjects (such as bodies or cameras) of a kind of reading, in alphabetical order."""
        with self.reading() as connection:
            return _subjects(connection, kind)

    def decisions(self) -> dict[int, tuple[bool, str]]:
        """Return the newest decision of a person about each entry, by the entry's id: whether it is used, and why."""
        contents = (content_of(entry) for entry in self.entries(DECISION))
        return {int(decision["entry"]): (bool(decision["included"]), str(decision["why"])) for decision in contents}

    def newest_id(self) -> int:
        """Return the largest id of an entry; 0 if there is none."""
        with self.reading() as connection:
            return int(connection.execute(select(func.max(ENTRY.c.id))).scalar_one() or 0)

    def came_late(self, after_id: int, until_us: int) -> bool:
        """Return whether an entry dated up to a time was ingested after a given other entry.

        Parameters
        ----------
        after_id : int
            Id of the other entry.
        until_us : int
            The time, in microseconds of TAI since 2000.
        """
        with self.reading() as connection:
            return _is_newer(connection, after_id, until_us)

    def checkpoint(
        self, plan: str, number: int | None = None, before_us: int | None = None, valid: bool = False
    ) -> Row[Any] | None:
        """Return the newest checkpoint of an estimate as a row of the table; None if there is none.

        Parameters
        ----------
        plan : str
            Digest of all inputs of the estimate other than the readings.
        number : int | None
            Number of the checkpoint to be returned. None for any; then checkpoints with negative numbers are ignored
            and, if a time is given, also number 0, which is not permanent.
        before_us : int | None
            Time before which the checkpoint must be, in microseconds of TAI since 2000; None for any.
        valid : bool
            True to ignore a checkpoint if a reading dated up to its time was ingested after it was saved.
        """
        c, e = CHECKPOINT.c, ENTRY.c
        if self._until is not None:
            before_us = self._until + 1 if before_us is None else min(before_us, self._until + 1)
        query = select(CHECKPOINT).where(c.plan == plan, _numbered(number, before_us))
        query = query if before_us is None else query.where(c.time_us < before_us)
        if valid:
            query = query.where(~select(e.id).where(*_late(c.entry_id, c.time_us)).exists())
        with self.reading() as connection:
            return connection.execute(query.order_by(c.time_us.desc(), c.number.desc()).limit(1)).first()

    def checkpoints(self, plan: str) -> list[Row[Any]]:
        """Return all checkpoints of an estimate in the order of time, as rows of the table.

        Parameters
        ----------
        plan : str
            Digest of all inputs of the estimate other than the readings.
        """
        c = CHECKPOINT.c
        query = select(CHECKPOINT).where(c.plan == plan, *_not_after(c.time_us, self._until))
        with self.reading() as connection:
            return list(connection.execute(query.order_by(c.time_us, c.number)))

    def save_checkpoint(self, plan: str, number: int, time_us: int, entry_id: int, content: bytes) -> bool:
        """Save the state of an estimate, replacing an earlier one of the same number.

        Parameters
        ----------
        plan : str
            Digest of all inputs of the estimate other than the readings.
        number : int
            Number of the checkpoint.
        time_us : int
            Time of the newest reading used in it, in microseconds of TAI since 2000.
        entry_id : int
            Largest id in the record when the readings were queried.
        content : bytes
            Serialised state.

        Returns
        -------
        bool
            True if it was saved; False if a reading dated up to that time was ingested in the meantime.
        """
        if self._until is not None and number >= 0:  # the newest estimate is not replaced
            return False
        row = {"plan": plan, "number": number, "time_us": time_us, "entry_id": entry_id, "content": content}
        with writing(self._engine) as connection:
            if _is_newer(connection, entry_id, time_us):
                return False
            connection.execute(delete(CHECKPOINT).where(CHECKPOINT.c.plan == plan, CHECKPOINT.c.number == number))
            connection.execute(insert(CHECKPOINT).values(**row))
        return True

    def drop_checkpoints(self, plan: str, from_time_us: int) -> int:
        """Remove the checkpoints of an estimate from a time on, and return their number."""
        if self._until is not None:
            return 0
        c = CHECKPOINT.c
        with writing(self._engine) as connection:
            gone = connection.execute(delete(CHECKPOINT).where(c.plan == plan, c.time_us >= from_time_us))
        return int(gone.rowcount)

    def raise_alarm(self, alarm: Alarm) -> bool:
        """Add an alarm to the record, unless the record has it already.

        Returns
        -------
        bool
            True if the alarm is new.
        """
        if self._until is not None:  # alarms of an earlier time were raised at that time
            return False
        digest = alarm.digest
        row = {"sha256": digest, "kind": alarm.kind, "subject": alarm.subject, "time_us": alarm.time}
        row |= {"text": alarm.text, "content": canonical(alarm.content), "raised_utc": utc_text(now())}
        with writing(self._engine) as connection:
            if connection.execute(select(ALARM.c.id).where(ALARM.c.sha256 == digest)).first() is not None:
                return False
            connection.execute(insert(ALARM).values(**row))
        return True

    def alarms(self) -> list[dict[str, Any]]:
        """Return all alarms in the order in which they were raised.

        Each has ``id``, ``kind``, ``subject``, ``time_us``, ``time_utc``, ``raised_utc``, ``text``, ``content``, and
        ``acknowledged``: ``by``, ``note`` and ``acknowledged_utc``, or None.
        """
        a = ACKNOWLEDGEMENT.c
        query = select(*ALARM.c, a.by, a.note, a.acknowledged_utc).where(*_not_after(ALARM.c.time_us, self._until))
        query = query.join(ACKNOWLEDGEMENT, a.alarm_id == ALARM.c.id, isouter=True).order_by(ALARM.c.id)
        with self.reading() as connection:
            rows = connection.execute(query).mappings().all()
        keys, seen = ("id", "kind", "subject", "time_us", "raised_utc", "text"), ("by", "note", "acknowledged_utc")
        return [
            {key: row[key] for key in keys}
            | {"time_utc": utc_text(row["time_us"]), "content": content_of(dict(row))}
            | {"acknowledged": None if row["by"] is None else {key: row[key] for key in seen}}
            for row in rows
        ]

    def acknowledge(self, alarm: int, by: str, note: str) -> None:
        """Acknowledge an alarm.

        Parameters
        ----------
        alarm : int
            Id of the alarm.
        by : str
            Name of the person.
        note : str
            Action taken.

        Raises
        ------
        Problem
            There is no such alarm, or it is acknowledged already.
        """
        a = ACKNOWLEDGEMENT.c
        with writing(self._engine) as connection:
            known = connection.execute(select(ALARM.c.id).order_by(ALARM.c.id)).scalars().all()
            if alarm not in known:
                allowed = names_text(known[-10:]) if known else "none: no alarm was raised"
                raise Problem("no such alarm", str(alarm), allowed)
            before = connection.execute(select(a.by, a.acknowledged_utc).where(a.alarm_id == alarm)).first()
            if before is not None:
                text = f"alarm {alarm} was acknowledged by {before.by} at {before.acknowledged_utc}"
                raise Problem(text, None, "an alarm is acknowledged once")
            row = {"alarm_id": alarm, "by": by, "note": note, "acknowledged_utc": utc_text(now())}
            connection.execute(insert(ACKNOWLEDGEMENT).values(**row))


def _late(after_id: Any, until_us: Any) -> tuple[Any, Any]:
    """Return the SQL conditions for entries dated up to a time that were ingested after a given other entry."""
    # few ids are newer, but all times are earlier: the sum prevents a scan of the index of times
    return ENTRY.c.id > after_id, ENTRY.c.time_us + 0 <= until_us


def _is_newer(connection: Connection, after_id: int, until_us: int) -> bool:
    return connection.execute(select(ENTRY.c.id).where(*_late(after_id, until_us)).limit(1)).first() is not None


def _not_after(time: Any, until: int | None) -> list[Any]:
    return [] if until is None else [time <= until]


def _numbered(number: int | None, before_us: int | None) -> Any:
    c = CHECKPOINT.c
    if number is not None:
        return c.number == number
    return c.number >= 0 if before_us is None else c.number > 0


def _streams(connection: Connection) -> Iterator[tuple[str, str]]:
    """Yield the pairs of kind and subject that occur in the record, sorted, by look-ups in the index."""
    c = ENTRY.c
    in_order = select(c.kind, c.subject).order_by(c.kind, c.subject).limit(1)
    stream = connection.execute(in_order).first()
    while stream is not None:
        yield stream.kind, stream.subject
        same, next_kind = in_order.where(c.kind == stream.kind, c.subject > stream.subject), c.kind > stream.kind
        stream = connection.execute(same).first() or connection.execute(in_order.where(next_kind)).first()


def _subjects(connection: Connection, kind: str) -> list[str]:
    return [subject for stream_kind, subject in _streams(connection) if stream_kind == kind]


def _stream_extent(connection: Connection, kind: str, subject: str) -> tuple[int, int, int]:
    """Return the number of readings of one kind and subject, and the first and last of their times.

    Each value is one query that the index of the table answers.
    """
    c = ENTRY.c
    aggregates = (func.count(), func.min(c.time_us), func.max(c.time_us))
    queries = [
        select(aggregate).select_from(ENTRY).where(c.kind == kind, c.subject == subject) for aggregate in aggregates
    ]
    count, first, last = (int(connection.execute(query).scalar_one()) for query in queries)
    return count, first, last


def content_of(row: Mapping[str, Any]) -> Any:
    """Return the content of a row of `History.entries`, which is JSON text, as nested mappings and lists."""
    return parse_json(row["content"], "the record")


def bodies_of(job: ResolvedJob) -> dict[str, list[str]]:
    """Return the bodies of a job's instrument that have a temperature (``warm``), and its cameras."""
    nodes = build_instrument(job.instrument, job.cameras, load_backend()).nodes
    warm = [path for path, info in nodes.items() if "temperature" in info.allows]
    return {"warm": warm, "cameras": list(job.instrument.cameras)}


def initialise_record(location: str, job: ResolvedJob, simulated: bool = False) -> tuple[int, ...]:
    """Create the record of an instrument if there is none.

    Parameters
    ----------
    location : str
        Folder, or address of a database.
    job : ResolvedJob
        Job of the instrument.
    simulated : bool
        Whether the readings are simulated, so that their times are not compared with the computer's clock.

    Returns
    -------
    tuple[int, ...]
        Version of the new record; empty if a record existed.

    Raises
    ------
    NotARecord
        There is a record of a different instrument, or of a different version.
    RecordFailed
        The record cannot be created.
    """
    url = url_of(location)
    folder = Path(str(url.database)).parent if url.get_backend_name() == "sqlite" and "://" not in location else None
    if folder is not None:
        try:
            make_folders(folder)
        except OSError as error:
            raise NotARecord(f"no folder can be made at {folder}: {error.strerror}") from None
    engine, digest = engine_of(url), digest_of_job(job)
    try:
        with writing(engine) as connection:
            version = schema.version(connection)
            if version:
                schema.require_version(version)
            else:
                schema.create(connection)
                program = f"{WRITER} {importlib.metadata.version(WRITER)}"
                made = {"version": schema.VERSION, "made_utc": utc_text(now()), "program": program}
                connection.execute(insert(schema.SCHEMA).values(**made))
                row = {"name": job.instrument.name, "sha256": digest, "simulated": simulated}
                row |= {"temperature_k": repr(job.instrument.temperature), "bodies": canonical(bodies_of(job))}
                row |= {"plain": canonical(job.plain()["instrument"])}
                connection.execute(insert(INSTRUMENT).values(**row))
            instrument = connection.execute(select(INSTRUMENT)).mappings().one()
            if instrument["sha256"] != digest:
                raise NotARecord(
                    f"the record is of {instrument['name']} ({instrument['sha256'][:12]}), not of "
                    f"{job.instrument.name} ({digest[:12]}); a record has one instrument: make another record"
                )
    finally:
        engine.dispose()
    if folder is not None:
        sync_folder(folder)
    return () if version else (schema.VERSION,)
