"""Ingest of one file into a record: new entries, known entries, and refusals of implausible ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select

from scenes.yaml.input_file import parse_json
from twin.operate.record.entries import MICRO, Entry, FileContent, Refusal, canonical, digest_of_data, now, utc_text
from twin.operate.record.schema import CHECKPOINT, ENTRY, FRAME, REFUSED, SOURCE

SAME_IMAGES = 0.2
"""RMS difference of spot positions, in sigmas, up to which two readings count as measured in the same images.

Spots in different images of the same state differ by 1.4 sigmas on average, and with eight coordinates by less than
this limit with a probability of 1e-6; spots measured in the same images differ only where different pixels are
excluded.
"""
_BATCH = 500
"""Number of rows in one query or insert of the database."""
AHEAD = 24 * 3600 * MICRO
"""Largest time by which a reading may be later than the computer's clock, in microseconds; later ones are refused."""


Before = Mapping[tuple[str, str, str], tuple[float, float]]
"""Camera, channel and ``row`` or ``column`` of a spot in the reference images -> position and sigma, in pixels."""


@dataclass(frozen=True)
class IngestResult:
    """Result of the ingest of one file.

    Attributes
    ----------
    file : str
        Path of the file.
    new : int
        Number of readings and events added to the record.
    known : int
        Number of readings and events that the record had already.
    refused : tuple[tuple[int | None, str], ...]
        Line and reason of every refusal.
    before : bool
        True if the same file was ingested before.
    refused_before : int
        Number of the refusals that were recorded before and are not counted again.
    """

    file: str
    new: int
    known: int
    refused: tuple[tuple[int | None, str], ...]
    before: bool = False
    refused_before: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of new and known entries, of new refusals and of earlier ones."""
        refused = len(self.refused) - self.refused_before
        return {"new": self.new, "known": self.known, "refused": refused, "refused_before": self.refused_before}


class Ingest:
    """Ingest of one file into the record.

    Parameters
    ----------
    connection
        Connection in the transaction of the record's only writer.
    simulated
        True if the readings are simulated, so that their times are not compared with the computer's clock.
    late
        True to accept readings older than the newest of their kind and subject in the record.
    """

    def __init__(self, connection: Connection, simulated: bool, late: bool) -> None:
        self.connection, self.simulated, self.late = connection, simulated, late
        self.newest: dict[tuple[str, str], int | None] = {}
        self.seen: dict[tuple[str, str], int] = {}
        self.first: tuple[str, Before] | None = None

    def ingest(self, content: FileContent) -> IngestResult:
        """Compare the content of the file with the record and add what is new."""
        source_digest = digest_of_data([content.sha256, content.meaning])
        source = self.connection.execute(select(SOURCE.c.id).where(SOURCE.c.ingest == source_digest)).first()
        entries = [(item, item.digest) for item in content.items if isinstance(item, Entry)]
        known = self._present(ENTRY.c.sha256, [digest for _, digest in entries])
        digests, refused, new_entries = iter(entries), [], []
        again = 0
        for item in content.items:
            if isinstance(item, Refusal):
                refused.append((item, item.entry.digest if item.entry else None))
                continue
            new_entry, digest = next(digests)
            stream = (new_entry.kind, new_entry.subject)
            if digest in known:
                again += 1
            elif reason := self._refusal_reason(new_entry):
                refused.append((Refusal(reason, new_entry.line, new_entry), digest))
                continue
            else:
                new_entries.append((new_entry, digest))
                known.add(digest)
                if new_entry.kind == "monitor" and self.first is None:
                    self.first = (utc_text(new_entry.time), _before(new_entry.content))
            self.seen[stream] = max(new_entry.time, self.seen.get(stream, new_entry.time))
        before = source is not None
        fresh = self._new_refusals(content, refused, before)
        if new_entries or fresh or not before:
            self.write(content, source_digest, None if source is None else int(source[0]), new_entries, fresh)
        refusals_made = tuple((refusal.line, refusal.reason) for refusal, _ in refused)
        return IngestResult(content.file, len(new_entries), again, refusals_made, before, len(refused) - len(fresh))

    def _new_refusals(
        self, content: FileContent, refused: list[tuple[Refusal, str | None]], before: bool
    ) -> dict[str, tuple[Refusal, str | None]]:
        """Return the refusals that the record does not have yet, by digest.

        A refused reading counts once, in whatever file it is, and an unreadable row once in each file, also if the file
        grows.
        """
        out = {
            digest_of_data(
                [entry] if entry else [content.file, content.meaning, new_refusal.line, new_refusal.reason]
            ): (new_refusal, entry)
            for new_refusal, entry in refused
            if entry or not before  # the same file at any path
        }
        known = self._present(REFUSED.c.sha256, list(out))
        readings = self._present(REFUSED.c.entry, [entry for _, entry in out.values() if entry])
        return {key: refusal for key, refusal in out.items() if key not in known and refusal[1] not in readings}

    def _present(self, column: Any, digests: list[str]) -> set[str]:
        """Return those of the given digests that a column of the database contains."""
        present: set[str] = set()
        for k in range(0, len(digests), _BATCH):
            query = select(column).where(column.in_(digests[k : k + _BATCH]))
            present |= set(self.connection.execute(query).scalars())
        return present

    def _refusal_reason(self, entry: Entry) -> str:
        """Return the reason why a new reading is implausible for this record; empty if it is plausible."""
        c, stream = ENTRY.c, (entry.kind, entry.subject)
        if not self.simulated and entry.time > now() + AHEAD:
            return (
                f"{utc_text(entry.time)} is in the future: the clock of the file, its time_scale or epoch is wrong; "
                "a record of simulated readings is made with init --simulated"
            )
        if entry.origin:
            query = select(c.time_utc).where(c.origin == entry.origin, c.time_us != entry.time).limit(1)
            if (other := self.connection.execute(query).scalar()) is not None:
                return f"measured in the same frames as the reading of {other}; give it that time, or its own frames"
        if entry.kind == "monitor" and (reason := self._reference_conflict(entry)):
            return reason
        if stream not in self.newest:
            query = select(func.max(c.time_us)).where(c.kind == entry.kind, c.subject == entry.subject)
            self.newest[stream] = self.connection.execute(query).scalar()
        newest, before = self.newest[stream], self.seen.get(stream)
        if before is not None and entry.time < before:
            text = f"the clock runs backwards: {utc_text(entry.time)} after {utc_text(before)}"
            return f"{text}; sort the rows, or remove those before the clock was set"
        if before is not None and entry.time == before:
            wrong = "two moves of a day need different times" if entry.kind == "move" else "one of them is wrong"
            return f"another reading of {entry.subject} at {utc_text(entry.time)} in this file; {wrong}"
        if newest is not None and entry.time <= newest:
            query = (
                select(c.id).where(c.kind == entry.kind, c.subject == entry.subject, c.time_us == entry.time).limit(1)
            )
            if self.connection.execute(query).scalar() is not None:
                return f"the record has another reading of {entry.subject} at {utc_text(entry.time)}, which is kept"
            if not self.late:
                text = f"{utc_text(entry.time)} is before the newest reading of {entry.subject}, {utc_text(newest)}"
                return f"{text}: a clock that was set back, or a reading that comes late; --late takes it"
        return ""

    def _reference_conflict(self, entry: Entry) -> str:
        """Return the reason why a monitor reading cannot be compared with those of the record; empty if it can."""
        spots = _before(entry.content)
        if self.first is None:
            c = ENTRY.c
            query = (
                select(c.time_utc, c.content)
                .where(c.kind == "monitor", c.subject == "monitor")
                .order_by(c.time_us, c.id)
                .limit(1)
            )
            row = self.connection.execute(query).first()
            if row is None:
                return ""
            self.first = (str(row.time_utc), _before(parse_json(row.content, "the record")))
        when, first = self.first
        ratios = [
            (spots[key][0] - position) / max(sigma, spots[key][1])
            for key, (position, sigma) in first.items()
            if key in spots
        ]
        apart = math.sqrt(sum(ratio * ratio for ratio in ratios) / len(ratios)) if ratios else 0.0
        if apart <= SAME_IMAGES:
            return ""
        return (
            f"measured against other reference images than the reading of {when}: their spots differ by {apart:.2g} "
            "sigma; recover the frames against its reference images, or begin another record"
        )

    def write(
        self,
        content: FileContent,
        source_digest: str,
        source: int | None,
        new_entries: list[tuple[Entry, str]],
        refused: Mapping[str, tuple[Refusal, str | None]],
    ) -> None:
        """Add rows to the record, and drop the checkpoints that they invalidate.

        Parameters
        ----------
        content : FileContent
            File from which the rows come.
        source_digest : str
            Digest of the file and of the description with which it was read.
        source : int | None
            Id of the file's row; None if the record does not have it yet.
        new_entries : list[tuple[Entry, str]]
            New entries with their digests.
        refused : Mapping[str, tuple[Refusal, str | None]]
            Digest -> new refusal, and the digest of its entry if it has one.
        """
        moment = utc_text(now())
        if source is None:
            row = {"file": content.file, "sha256": content.sha256, "ingest": source_digest, "taken_utc": moment}
            written = self.connection.execute(insert(SOURCE).values(**row, rows_read=len(content.items)))
            source = int(written.inserted_primary_key[0])  # type: ignore[index]
            frames = [{"source_id": source, "file": f, "sha256": d} for f, d in content.frames.items()]
            self._insert(FRAME, frames)
        rows = [
            {
                "sha256": digest,
                "kind": entry.kind,
                "subject": entry.subject,
                "time_us": entry.time,
                "time_utc": utc_text(entry.time),
                "content": canonical(entry.content),
                "source_id": source,
                "line": entry.line,
                "origin": entry.origin or None,
            }
            for entry, digest in new_entries
        ]
        self._insert(ENTRY, rows)
        if rows:  # checkpoints after the earliest new entry do not contain it
            earliest = min(entry.time for entry, _ in new_entries)
            self.connection.execute(delete(CHECKPOINT).where(CHECKPOINT.c.time_us >= earliest))
        refusals_made = [
            {
                "sha256": key,
                "source_id": source,
                "line": refusal.line,
                "reason": refusal.reason,
                "entry": entry,
                "refused_utc": moment,
            }
            for key, (refusal, entry) in refused.items()
        ]
        self._insert(REFUSED, refusals_made)

    def _insert(self, table: Any, rows: list[dict[str, Any]]) -> None:
        for k in range(0, len(rows), _BATCH):
            self.connection.execute(insert(table), rows[k : k + _BATCH])


def _before(content: Mapping[str, Any]) -> Before:
    """Return positions and sigmas of a monitor reading's spots in its reference images, where they have a sigma."""
    out = {}
    for camera, channels in (content["numbers"].get("spots") or {}).items():
        for channel, spot in channels.items():
            for axis in ("row", "column"):
                position, sigma = (spot.get("before", {}).get(key) for key in (axis, f"{axis}_sigma"))
                if position is not None and sigma:
                    out[camera, channel, axis] = (float(position), float(sigma))
    return out
