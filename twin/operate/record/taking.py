"""One file on its way into a record: what of it is new, what is known already, and what cannot be true of it."""

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
"""Root mean square of the differences of spots of the same images, over their sigmas, at most. Those of other images of
the same state differ by 1.4, and of eight coordinates by less than this once in a million; those of the same images
differ where other pixels are left out.
"""
_TOGETHER = 500
"""Rows asked for or written at once."""
AHEAD = 24 * 3600 * MICRO
"""A reading later than this after the computer's clock comes of a clock that is wrong."""


Before = Mapping[tuple[str, str, str], tuple[float, float]]
"""Camera, channel and ``row`` or ``column`` of a spot before -> place and sigma, px."""


@dataclass(frozen=True)
class IngestResult:
    """What became of one file.

    Attributes
    ----------
    file : str
        Its path.
    new : int
        Readings and events that are now in the record.
    known : int
        That were in it already.
    refused : tuple[tuple[int | None, str], ...]
        What was not taken: line, reason.
    before : bool
        Whether the same file had been taken before.
    refused_before : int
        How many of these had been refused before, and are not counted again.
    """

    file: str
    new: int
    known: int
    refused: tuple[tuple[int | None, str], ...]
    before: bool = False
    refused_before: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """How many readings and events were taken, were known, and are refused now and were before."""
        refused = len(self.refused) - self.refused_before
        return {"new": self.new, "known": self.known, "refused": refused, "refused_before": self.refused_before}


class Ingest:
    """One file on its way into the record.

    Parameters
    ----------
    connection
        In the transaction of the one writer of this moment.
    simulated
        Whether times are not compared with the computer's clock.
    late
        Whether readings may be older than the newest of their sort and subject in the record.
    """

    def __init__(self, connection: Connection, simulated: bool, late: bool) -> None:
        self.connection, self.simulated, self.late = connection, simulated, late
        self.newest: dict[tuple[str, str], int | None] = {}
        self.seen: dict[tuple[str, str], int] = {}
        self.first: tuple[str, Before] | None = None

    def ingest(self, given: FileContent) -> IngestResult:
        """Compare what the file holds with the record and add what is new."""
        taking = digest_of_data([given.sha256, given.meaning])
        source = self.connection.execute(select(SOURCE.c.id).where(SOURCE.c.taking == taking)).first()
        entries = [(one, one.digest) for one in given.items if isinstance(one, Entry)]
        known = self._known(ENTRY.c.sha256, [digest for _, digest in entries])
        digests, refused, kept = iter(entries), [], []
        again = 0
        for item in given.items:
            if isinstance(item, Refusal):
                refused.append((item, item.entry.digest if item.entry else None))
                continue
            one, digest = next(digests)
            stream = (one.kind, one.subject)
            if digest in known:
                again += 1
            elif reason := self._wrong(one):
                refused.append((Refusal(reason, one.line, one), digest))
                continue
            else:
                kept.append((one, digest))
                known.add(digest)
                if one.kind == "monitor" and self.first is None:
                    self.first = (utc_text(one.time), _before(one.content))
            self.seen[stream] = max(one.time, self.seen.get(stream, one.time))
        before = source is not None
        fresh = self._fresh(given, refused, before)
        if kept or fresh or not before:
            self.write(given, taking, None if source is None else int(source[0]), kept, fresh)
        told = tuple((one.line, one.reason) for one, _ in refused)
        return IngestResult(given.file, len(kept), again, told, before, len(refused) - len(fresh))

    def _fresh(
        self, given: FileContent, refused: list[tuple[Refusal, str | None]], before: bool
    ) -> dict[str, tuple[Refusal, str | None]]:
        """Return what is refused for the first time, by digest: a reading counts once whatever file it comes in, and a
        row that could not be read once in each file, however the file grows.
        """
        out = {
            digest_of_data([entry] if entry else [given.file, given.meaning, one.line, one.reason]): (one, entry)
            for one, entry in refused
            if entry or not before  # the same file, wherever it lies
        }
        known = self._known(REFUSED.c.sha256, list(out))
        readings = self._known(REFUSED.c.entry, [entry for _, entry in out.values() if entry])
        return {key: own for key, own in out.items() if key not in known and own[1] not in readings}

    def _known(self, column: Any, digests: list[str]) -> set[str]:
        found: set[str] = set()
        for k in range(0, len(digests), _TOGETHER):
            query = select(column).where(column.in_(digests[k : k + _TOGETHER]))
            found |= set(self.connection.execute(query).scalars())
        return found

    def _wrong(self, one: Entry) -> str:
        """Why a reading that is new cannot be true of this record; empty where it can."""
        c, stream = ENTRY.c, (one.kind, one.subject)
        if not self.simulated and one.time > now() + AHEAD:
            return (
                f"{utc_text(one.time)} is still to come: the clock of the file, its time_scale or its epoch is wrong; "
                "a record of simulated readings is made with init --simulated"
            )
        if one.origin:
            query = select(c.time_utc).where(c.origin == one.origin, c.time_us != one.time).limit(1)
            if (other := self.connection.execute(query).scalar()) is not None:
                return f"found from the same frames as the reading of {other}; give it that time, or its own frames"
        if one.kind == "monitor" and (reason := self._other_reference(one)):
            return reason
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

    def _other_reference(self, one: Entry) -> str:
        """Why a reading of the monitor cannot be compared with those of the record; empty where it can."""
        own = _before(one.content)
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
            (own[key][0] - place) / max(sigma, own[key][1]) for key, (place, sigma) in first.items() if key in own
        ]
        apart = math.sqrt(sum(ratio * ratio for ratio in ratios) / len(ratios)) if ratios else 0.0
        if apart <= SAME_IMAGES:
            return ""
        return (
            f"found against other reference images than the reading of {when}, whose spots before are {apart:.2g} "
            "sigma from these; recover the frames against its images before, or begin another record"
        )

    def write(
        self,
        given: FileContent,
        taking: str,
        source: int | None,
        kept: list[tuple[Entry, str]],
        refused: Mapping[str, tuple[Refusal, str | None]],
    ) -> None:
        """Add rows to the record, and drop what was kept of estimates that these change.

        Parameters
        ----------
        given : Given
            What they come from.
        taking : str
            Digest by which that is recognised.
        source : int | None
            Its id; None where the record does not have it yet.
        kept : list[tuple[Entry, str]]
            Entries with their digests.
        refused : Mapping[str, tuple[Refused, str | None]]
            What is not taken for the first time, by its digest, with that of its entry where it has one.
        """
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
        if rows:  # estimates that went past the earliest of them do not hold it
            earliest = min(one.time for one, _ in kept)
            self.connection.execute(delete(CHECKPOINT).where(CHECKPOINT.c.time_us >= earliest))
        told = [
            {
                "sha256": key,
                "source_id": source,
                "line": one.line,
                "reason": one.reason,
                "entry": entry,
                "refused_utc": moment,
            }
            for key, (one, entry) in refused.items()
        ]
        self._insert(REFUSED, told)

    def _insert(self, table: Any, rows: list[dict[str, Any]]) -> None:
        for k in range(0, len(rows), _TOGETHER):
            self.connection.execute(insert(table), rows[k : k + _TOGETHER])


def _before(content: Mapping[str, Any]) -> Before:
    """The spots in the reference images of a reading of the monitor, those that have a sigma."""
    out = {}
    for camera, channels in (content["numbers"].get("spots") or {}).items():
        for channel, spot in channels.items():
            for axis in ("row", "column"):
                place, sigma = (spot.get("before", {}).get(key) for key in (axis, f"{axis}_sigma"))
                if place is not None and sigma:
                    out[camera, channel, axis] = (float(place), float(sigma))
    return out
