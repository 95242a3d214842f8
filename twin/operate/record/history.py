"""The record of one instrument: opened, added to, and read, also as it was; what is in it is never altered."""

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
    opened,
    said,
    url_of,
    writing,
)
from twin.operate.record.taking import Ingest, IngestResult

USED = ("monitor", "temperature")
"""Kinds of entries that change the estimate; events do by what they step."""


class History:
    """The record of one instrument in a database.

    Parameters
    ----------
    place
        Folder or address of the record.
    until
        Of the record as it was: by the times of the readings nothing later is in it, and nothing is added to it but
        what was traced of the instrument; None for the whole record.

    Attributes
    ----------
    url
        Of the database, without its password.
    name
        Of the instrument.
    sha256
        By which the instrument is recognised.
    temperature
        Of the instrument as its file states it, kelvin.
    simulated
        Whether its times are not compared with the computer's clock.
    bodies
        ``warm``, paths of those that have a temperature; ``cameras``, their names.
    """

    def __init__(self, place: str, until: int | None = None) -> None:
        url, self._until = url_of(place), until
        self._engine = opened(url)
        self.url = url.render_as_string(hide_password=True)
        with self.reading() as connection:
            found = schema.version(connection)
            if found == 0:
                raise NotARecord(f"no record in {self.url}; python -m twin.operate init makes one")
            schema.require_version(found)
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
        with database_errors(), self._engine.connect() as connection, connection.begin():
            yield connection

    def ingest(self, given: FileContent, late: bool = False) -> IngestResult:
        """Add what a file holds, all of it in one step: after an interruption all of it is there, or nothing.

        Parameters
        ----------
        given : Given
            The file.
        late : bool
            Whether readings may be older than the newest of their sort and subject in the record.

        Raises
        ------
        RecordFailed
            Nothing was added.
        TypeError
            Into the record as it was.
        """
        if self._until is not None:
            raise TypeError("nothing is taken into a record as it was")
        for attempt in (True, False):
            try:
                with writing(self._engine) as connection:
                    return Ingest(connection, self.simulated, late).ingest(given)
            except IntegrityError as error:  # of databases without a lock: another writer was first
                if not attempt:
                    raise RecordFailed(said(error)) from None
        raise AssertionError

    def decide(self, number: int, included: bool, why: str) -> dict[str, Any]:
        """Exclude an entry from the estimate, or include it whatever speaks against it, by an entry of its own: the
        newest decision on an entry counts.

        Parameters
        ----------
        number : int
            Id of the entry, a reading of the monitor or a temperature.
        included : bool
            Whether it counts from now on.
        why : str
            The reason.

        Returns
        -------
        dict[str, Any]
            ``entry``, ``kind``, ``subject``, ``time_utc``, ``included`` and ``why``.

        Raises
        ------
        Problem
            There is no such reading, or the same was decided before.
        """
        c = ENTRY.c
        with writing(self._engine) as connection:
            row = connection.execute(select(ENTRY).where(c.id == number, c.kind.in_(USED))).mappings().first()
            if row is None:
                allowed = "a reading of the monitor or a temperature; export writes the numbers of all entries"
                raise Problem("no such reading", str(number), allowed)
            own = select(c.content).where(c.kind == DECISION, c.subject == str(number)).order_by(c.id)
            before = [parse_json(one, "the record") for one in connection.execute(own).scalars()]
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
            one = Entry(DECISION, str(number), int(row["time_us"]), content)
            given = FileContent("twin.operate exclude", digest_of_data(content), one.digest, [one], {})
            Ingest(connection, self.simulated, True).write(given, one.digest, None, [(one, one.digest)], {})
        keys = {key: row[key] for key in ("kind", "subject", "time_utc")}
        return {"entry": number, **keys, "included": included, "why": why}

    def entries(self, kind: str = "", after_us: int | None = None) -> Iterator[dict[str, Any]]:
        """Readings and events in the order of time, those of one moment in the order in which they were taken.

        SQLite has no writer while they are read: take what is wanted, and write then.

        Parameters
        ----------
        kind : str
            Of reading; all if empty.
        after_us : int | None
            Those after this time, microseconds of TAI since 2000.

        Yields
        ------
        dict[str, Any]
            ``id``, ``kind``, ``subject``, ``time_us``, ``time_utc``, ``sha256``, ``line``, ``file`` and ``content``,
            which is plain data.
        """
        c = ENTRY.c
        query = select(*c, SOURCE.c.file).join(SOURCE, c.source_id == SOURCE.c.id)
        query = query.where(*_not_after(c.time_us, self._until))
        query = query.where(c.kind == kind) if kind else query
        query = query if after_us is None else query.where(c.time_us > after_us)
        with self.reading() as connection:
            if kind and not (
                after_us is None and self._until is None
            ):  # a look into the index for each subject, and no walk through all
                query = query.where(c.subject.in_(_subjects(connection, kind)))
            yield from map(dict, connection.execute(query.order_by(c.time_us, c.id)).mappings())

    def refusals(self) -> list[dict[str, Any]]:
        """What was refused, in the order in which it was; ``taken_since`` says whether the reading is there by now."""
        there = select(ENTRY.c.id).where(ENTRY.c.sha256 == REFUSED.c.entry).exists()
        query = select(*REFUSED.c, SOURCE.c.file, there.label("taken_since")).join(
            SOURCE, REFUSED.c.source_id == SOURCE.c.id
        )
        with self.reading() as connection:
            return [dict(row) for row in connection.execute(query.order_by(REFUSED.c.id)).mappings()]

    def status(self, every: bool = False) -> dict[str, Any]:
        """Return what the record holds, as plain data.

        Parameters
        ----------
        every : bool
            Whether the digests of all entries are worked out again, and not those of the newest alone.
        """
        with self.reading() as connection:
            streams = [(kind, subject, *_extent(connection, kind, subject)) for kind, subject in _streams(connection)]
            sources = int(connection.execute(select(func.count()).select_from(SOURCE)).scalar_one())
            guarded = schema.guarded(connection)
            checked, altered = schema.altered(connection, None if every else schema.LAST_CHECKED)
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
            "open": sum(not one["taken_since"] for one in refused),
        }

    def store_plan(self, file: str, content: Mapping[str, Any]) -> bool:
        """Keep a plan of operation, which from now on counts.

        Parameters
        ----------
        file : str
            From which it is.
        content : Mapping[str, Any]
            Plain data.

        Returns
        -------
        bool
            Whether it is another one than before.
        """
        digest = digest_of_data(content)
        with writing(self._engine) as connection:
            newest = select(PLAN.c.sha256).order_by(PLAN.c.id.desc()).limit(1)
            if connection.execute(newest).scalar() == digest:
                return False
            # cameras and causes keep their order, which is that of all results
            text = json.dumps(content, allow_nan=False, ensure_ascii=False)
            row = {"sha256": digest, "file": file, "content": text, "kept_utc": utc_text(now())}
            connection.execute(insert(PLAN).values(**row))
        return True

    def plan(self) -> dict[str, Any] | None:
        """The plan that counts: ``sha256``, ``file``, ``content`` and ``kept_utc``; None where none was kept."""
        with self.reading() as connection:
            row = connection.execute(select(PLAN).order_by(PLAN.c.id.desc()).limit(1)).mappings().first()
        return None if row is None else {**row, "content": content_of(dict(row))}

    def first(self, kind: str) -> dict[str, Any] | None:
        """The earliest entry of a kind, as of `entries`; None for none."""
        c = ENTRY.c
        with self.reading() as connection:
            # of each subject by the index, which has it before the time
            rows = [
                connection.execute(
                    select(*c).where(c.kind == kind, c.subject == one).order_by(c.time_us, c.id).limit(1)
                )
                .mappings()
                .one()
                for one in _subjects(connection, kind)
            ]
        return dict(min(rows, key=lambda row: (row["time_us"], row["id"]))) if rows else None

    def subjects(self, kind: str) -> list[str]:
        """Of what there are readings of a kind, in alphabetical order."""
        with self.reading() as connection:
            return _subjects(connection, kind)

    def newest_id(self) -> int:
        """The largest id of an entry; 0 where there is none."""
        with self.reading() as connection:
            return int(connection.execute(select(func.max(ENTRY.c.id))).scalar_one() or 0)

    def came_late(self, after_id: int, until_us: int) -> bool:
        """Whether an entry up to a time was taken after another one.

        Parameters
        ----------
        after_id : int
            The id of that.
        until_us : int
            The time, microseconds of TAI since 2000.
        """
        with self.reading() as connection:
            return _is_newer(connection, after_id, until_us)

    def checkpoint(
        self, plan: str, number: int | None = None, before_us: int | None = None, valid: bool = False
    ) -> Row[Any] | None:
        """The newest of what was kept of an estimate, as a row of the table; None for none.

        Parameters
        ----------
        plan : str
            As of `save_checkpoint`.
        number : int | None
            The one of this number alone; without it none of a negative number, and where a time is asked for none of
            number 0, which is not kept for good.
        before_us : int | None
            The newest before this time, microseconds of TAI since 2000.
        valid : bool
            Only one up to whose time no reading has come since it was kept.
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
        """Where the estimate under a plan stood, in the order of time, as rows of the table.

        Parameters
        ----------
        plan : str
            Digest of all that the estimate rests on besides the readings.
        """
        c = CHECKPOINT.c
        query = select(CHECKPOINT).where(c.plan == plan, *_not_after(c.time_us, self._until))
        with self.reading() as connection:
            return list(connection.execute(query.order_by(c.time_us, c.number)))

    def save_checkpoint(self, plan: str, number: int, time_us: int, entry_id: int, content: bytes) -> bool:
        """Keep where an estimate stands, in place of what was kept under the number.

        Parameters
        ----------
        plan : str
            Digest of all that the estimate rests on besides the readings.
        number : int
            Counts the checkpoints of a plan.
        time_us : int
            Up to which readings are in it.
        entry_id : int
            The largest id that the record had when they were read.
        content : bytes
            The estimate.

        Returns
        -------
        bool
            Whether it is kept; it is not if a reading up to that time has come since.
        """
        if self._until is not None and number >= 0:  # the newest estimate stays where it is
            return False
        row = {"plan": plan, "number": number, "time_us": time_us, "entry_id": entry_id, "content": content}
        with writing(self._engine) as connection:
            if _is_newer(connection, entry_id, time_us):
                return False
            connection.execute(delete(CHECKPOINT).where(CHECKPOINT.c.plan == plan, CHECKPOINT.c.number == number))
            connection.execute(insert(CHECKPOINT).values(**row))
        return True

    def drop_checkpoints(self, plan: str, from_time_us: int) -> int:
        """Remove checkpoints of a plan from a time on; how many there were."""
        if self._until is not None:
            return 0
        c = CHECKPOINT.c
        with writing(self._engine) as connection:
            gone = connection.execute(delete(CHECKPOINT).where(c.plan == plan, c.time_us >= from_time_us))
        return int(gone.rowcount)

    def raise_alarm(self, alarm: Alarm) -> bool:
        """Add an alarm, once.

        Returns
        -------
        bool
            Whether it is new.
        """
        if self._until is not None:  # what was to be told then was told then
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
        """All alarms in the order in which they were raised: ``id``, ``kind``, ``subject``, ``time_us``, ``time_utc``,
        ``raised_utc``, ``text``, ``content``, and ``acknowledged``: ``by``, ``note`` and ``acknowledged_utc``, or None.
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
        """Say who has seen an alarm, and what is done about it.

        Parameters
        ----------
        alarm : int
            Its id.
        by : str
            Name of a person.
        note : str
            What is done.

        Raises
        ------
        Problem
            There is no such alarm, or somebody has said so.
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
    """Entries up to a time that were taken after another one."""
    # few are newer and all are older: the sum keeps databases from a walk through the index of the times
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
    """Sort and subject of all that was read, in order: found by looks into the index, not by a walk through it."""
    c = ENTRY.c
    in_order = select(c.kind, c.subject).order_by(c.kind, c.subject).limit(1)
    found = connection.execute(in_order).first()
    while found is not None:
        yield found.kind, found.subject
        same, next_kind = in_order.where(c.kind == found.kind, c.subject > found.subject), c.kind > found.kind
        found = connection.execute(same).first() or connection.execute(in_order.where(next_kind)).first()


def _subjects(connection: Connection, kind: str) -> list[str]:
    return [subject for own, subject in _streams(connection) if own == kind]


def _extent(connection: Connection, kind: str, subject: str) -> tuple[int, int, int]:
    """How many readings a stream has, the first time and the last one; one query each, which the index answers."""
    c = ENTRY.c
    asked = (func.count(), func.min(c.time_us), func.max(c.time_us))
    own = [select(one).select_from(ENTRY).where(c.kind == kind, c.subject == subject) for one in asked]
    count, first, last = (int(connection.execute(query).scalar_one()) for query in own)
    return count, first, last


def content_of(row: Mapping[str, Any]) -> Any:
    """What a row of `History.entries` holds, plain data."""
    return parse_json(row["content"], "the record")


def bodies_of(job: ResolvedJob) -> dict[str, list[str]]:
    """Paths of the bodies of a job's instrument that have a temperature, and names of its cameras."""
    nodes = build_instrument(job.instrument, job.cameras, load_backend()).nodes
    warm = [path for path, info in nodes.items() if "temperature" in info.allows]
    return {"warm": warm, "cameras": list(job.instrument.cameras)}


def initialise_record(place: str, job: ResolvedJob, simulated: bool = False) -> tuple[int, ...]:
    """Make a record where there is none.

    Parameters
    ----------
    place : str
        Folder, or address of a database.
    job : ResolvedJob
        One on the instrument.
    simulated : bool
        Whether times are not compared with the computer's clock.

    Returns
    -------
    tuple[int, ...]
        The version of a new record; nothing where there was one.

    Raises
    ------
    NotARecord
        There is one of another instrument, or of another version.
    RecordFailed
        It cannot be made.
    """
    url = url_of(place)
    folder = Path(str(url.database)).parent if url.get_backend_name() == "sqlite" and "://" not in place else None
    if folder is not None:
        try:
            make_folders(folder)
        except OSError as error:
            raise NotARecord(f"no folder can be made at {folder}: {error.strerror}") from None
    engine, digest = engine_of(url), digest_of_job(job)
    try:
        with writing(engine) as connection:
            found = schema.version(connection)
            if found:
                schema.require_version(found)
            else:
                schema.create(connection)
                program = f"{WRITER} {importlib.metadata.version(WRITER)}"
                made = {"version": schema.VERSION, "made_utc": utc_text(now()), "program": program}
                connection.execute(insert(schema.SCHEMA).values(**made))
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
    finally:
        engine.dispose()
    if folder is not None:
        sync_folder(folder)
    return () if found else (schema.VERSION,)
