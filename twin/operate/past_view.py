"""The past of an instrument as its page draws it: what all readings say of many times, worked out once for all of them.

What is known of a time rests on every reading after it. So the page does not ask for each span that is looked at: the
estimate is worked out at times over the whole record in one go, and spans are cut out of them. Of a long record that
takes minutes; then the last weeks, which a new reading changes most, are worked out by themselves with every reading,
and the whole record when somebody looks at it, and anew when that view is a day old.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from twin.operate.overview import DAY, Overview, spread
from twin.operate.record.history import History
from twin.operate.shown_readings import reading_times

LIFE, RECENT = 300, 200
"""Evenly spread times of the whole record, and of the last weeks."""
MOST_READINGS = 400
"""Times of readings among those of a view."""
FEW_READINGS = 200
"""Readings up to which the middles between them are times of a view, too."""
WEEKS = 35 * DAY
"""Of the recent view."""
MANY = 1000
"""Readings from which on the whole record is not worked out with every new one, but once in a day of the record."""


@dataclass(frozen=True, eq=False)
class View:
    """The estimate over a span of the past, and its forecast.

    Attributes:
        times: (T,) microseconds of TAI since 2000, in order.
        values: (T, Q) of all quantities in their units; sigmas: (T, Q) likewise.
        moved: (T, M) means of all stated motions in their units.
        together: motions of one name together, (T,) means and standard deviations.
        now: the newest entry that it knows, microseconds.
    """

    times: np.ndarray
    values: np.ndarray
    sigmas: np.ndarray
    moved: np.ndarray
    together: Mapping[str, tuple[np.ndarray, np.ndarray]]
    now: int

    @classmethod
    def of(cls, history: History, overview: Overview, begin: int, count: int) -> View:
        """Work it out, up to the end of the forecast.

        Args:
            history: the record.
            overview: of it.
            begin: of the span, microseconds of TAI since 2000.
            count: evenly spread times.
        """
        now, end = overview.time, overview.time + overview.horizon
        edges = [at for jump in overview.following.jumps for at in (jump.after_us, jump.until_us)]
        edges += [at for when, *_ in overview.events for at in (when - 1, when)]
        own = [at for at in edges if begin <= at <= now]
        read = reading_times(history, begin, now)
        read = read[:: max(1, -(-len(read) // MOST_READINGS))]
        if len(read) <= FEW_READINGS:  # what is known between two of them is seen
            read = np.concatenate([read, read[:-1] + np.diff(read) // 2])
        parts = [spread(begin, now, count), spread(now, end, count // 3), np.array(own, np.int64), read]
        times = np.unique(np.concatenate(parts))
        course, moved, together = overview.operation.states(times)
        values, sigmas, ahead = course.values.copy(), course.sigmas.copy(), times >= now
        later = overview.operation.forecast(times[ahead])  # as all that is told of now and later
        values[ahead], sigmas[ahead] = later.values, later.sigmas
        return cls(times, values, sigmas, moved, together, now)

    def part(self, begin: int, end: int) -> dict[str, Any]:
        """What lies in a span: ``past``, and ``future``, which is None where the span ends before it; plain data."""
        within = (self.times >= begin) & (self.times <= end)
        past, future = within & (self.times <= self.now), within & (self.times >= self.now)
        return {
            "past": self._course(past),
            "future": self._course(future) if np.count_nonzero(future) > 1 else None,
            "now_us": self.now,
        }

    def _course(self, chosen: np.ndarray) -> dict[str, Any]:
        return {"times": self.times[chosen], "values": self.values[chosen].T, "sigmas": self.sigmas[chosen].T}

    def nearest(self, when: int) -> int:
        """Which of the times is nearest."""
        return int(np.argmin(np.abs(self.times - when)))


class Views:
    """Views of a record, kept while they are good."""

    def __init__(self) -> None:
        self._life: View | None = None
        self._recent: View | None = None

    def over(self, history: History, overview: Overview, begin: int) -> View:
        """One that reaches back to a time.

        Args:
            history: the record.
            overview: of it.
            begin: microseconds of TAI since 2000.
        """
        recent, long = overview.time - WEEKS, overview.following.readings > MANY
        if self._life is not None and self._life.now == overview.time:
            return self._life
        if long and begin >= recent:
            if self._recent is None or self._recent.now != overview.time:
                self._recent = View.of(history, overview, recent, RECENT)
            return self._recent
        if self._life is None or not long or overview.time - self._life.now > DAY:
            self._life = View.of(history, overview, overview.begin, LIFE)
        return self._life
