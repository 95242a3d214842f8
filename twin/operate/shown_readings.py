"""Return single readings of the monitor as the report shows them: the first and last times, and evenly chosen ones."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Select, func, select

from twin.operate.record.history import History, content_of
from twin.operate.record.schema import ENTRY, SOURCE

KIND = "monitor"
_TOGETHER = 400
"""Rows asked for at once."""


def _rows() -> Select[Any]:
    return select(*ENTRY.c, SOURCE.c.file).join(SOURCE, ENTRY.c.source_id == SOURCE.c.id).where(ENTRY.c.kind == KIND)


def first_time(history: History) -> int:
    """Time of the first reading of the monitor, microseconds of TAI since 2000; 0 without any."""
    with history.reading() as connection:
        found = connection.execute(select(func.min(ENTRY.c.time_us)).where(ENTRY.c.kind == KIND)).scalar()
    return int(found or 0)


def last_time(history: History) -> int | None:
    """Time of the newest reading of the monitor, microseconds of TAI since 2000; None without any."""
    with history.reading() as connection:
        found = connection.execute(select(func.max(ENTRY.c.time_us)).where(ENTRY.c.kind == KIND)).scalar()
    return None if found is None else int(found)


def readings(history: History, begin: int, end: int, most: int) -> list[dict[str, Any]]:
    """Readings of the monitor in a span, in the order of time; evenly chosen if there are more than ``most``.

    Args:
        history: the record.
        begin: microseconds of TAI since 2000.
        end: likewise; both ends belong to the span.
        most: readings.

    Returns:
        Rows as `History.entries` yields them, with ``content`` as plain data.
    """
    c = ENTRY.c
    query = select(c.id).where(c.kind == KIND, c.time_us >= begin, c.time_us <= end).order_by(c.time_us, c.id)
    with history.reading() as connection:
        found = list(connection.execute(query).scalars())
        step = max(1, -(-len(found) // most))
        chosen = found[::-1][::step][::-1]  # the newest is always among them
        rows: list[dict[str, Any]] = []
        for k in range(0, len(chosen), _TOGETHER):
            part = connection.execute(_rows().where(c.id.in_(chosen[k : k + _TOGETHER])).order_by(c.time_us, c.id))
            rows += map(dict, part.mappings())
    return [{**row, "content": content_of(row)} for row in rows]
