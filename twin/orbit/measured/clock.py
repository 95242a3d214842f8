"""Time scales: conversion of clock readings in UTC, GPS, TAI, TT and others to seconds of atomic time.

A reading is a day and seconds of that day, as the clock shows them. An instant is a time in TAI in two parts, to keep
full precision over decades: whole days since MJD 0 and the remaining SI seconds.

GPS time is 19 s behind TAI and BeiDou time 33 s, permanently; Galileo and QZSS time are treated as GPS time, from which
they differ by nanoseconds only; TT is 32.184 s ahead of TAI. UTC is behind by the leap seconds (IERS Conventions 2010,
chapter 10).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta

import erfa
import numpy as np

from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import Problem, names_text, shown
from twin.orbit.flight.earth import DAY, years_without_announced_leap_seconds

TAI_MINUS: Mapping[str, float] = FrozenMap(
    {"TAI": 0.0, "GPS": 19.0, "GAL": 19.0, "QZS": 19.0, "BDT": 33.0, "TT": -32.184}
)
"""Offset TAI minus scale, in seconds, of every scale with a constant offset; that of UTC changes."""
SCALES = ("UTC", *TAI_MINUS)
"""Names of the time scales that can be read."""
_MJD_ZERO = date(1858, 11, 17).toordinal()
FIRST_DAY, LAST_DAY = date(1972, 1, 1).toordinal() - _MJD_ZERO, date(2100, 1, 1).toordinal() - _MJD_ZERO
"""First and last modified Julian day that is accepted; UTC has had whole leap seconds since the first."""
_FORM = "a date and time such as 2011-03-05T03:05:00.25 or 2011-064T03:05:00.25, 1972 to 2099"


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of a clock: days and seconds of the day, before a time scale is assigned.

    Attributes
    ----------
    day : (N,) ndarray of int for N readings
        Modified Julian days.
    second : (N,) ndarray
        Seconds of the day, from 0 to 86400, within a leap second up to 86401.
    """

    day: np.ndarray
    second: np.ndarray

    def __len__(self) -> int:
        return len(self.day)

    @classmethod
    def after(cls, epoch: str, seconds: np.ndarray) -> Readings:
        """Return readings of a clock whose days all have 86400 s.

        Parameters
        ----------
        epoch : str
            Reading of the clock at 0 s, ISO 8601 text.
        seconds : (N,) ndarray for N readings
            Seconds since then.

        Raises
        ------
        Problem
            The epoch is not a date and time.
        """
        day, second = calendar_reading(epoch)
        whole = np.floor((second + seconds) / DAY)
        return cls(day + whole.astype(np.int64), second + seconds - DAY * whole)

    @classmethod
    def of_texts(cls, texts: Sequence[str]) -> Readings:
        """Parse readings from calendar texts.

        Parameters
        ----------
        texts : sequence of str
            N dates with times of day.

        Raises
        ------
        Problem
            A text is not a date and time; the error's ``within`` holds its index.
        """
        day, second = np.empty(len(texts), np.int64), np.empty(len(texts))
        known: dict[str, int] = {}
        for k, text in enumerate(texts):
            try:
                head, _, clock = text.partition("T")
                number = known.get(head)
                if number is None:
                    number = known[head] = _day_of(head)
                hour, minute, rest = clock.removesuffix("Z").split(":")
                if len(hour) != 2 or len(minute) != 2 or not (hour + minute + rest.replace(".", "", 1)).isdigit():
                    raise ValueError
                seconds = float(rest)
                if int(hour) > 23 or int(minute) > 59 or seconds >= (61.0 if (hour, minute) == ("23", "59") else 60.0):
                    raise ValueError
                day[k], second[k] = number, 3600 * int(hour) + 60 * int(minute) + seconds
            except ValueError:
                raise Problem("not a date and time", shown(text), _FORM, within=(k,)) from None
        return cls(day, second)

    def taken(self, keep: np.ndarray | slice) -> Readings:
        """Return the readings that a mask, slice or array of K indices selects."""
        return Readings(self.day[keep], self.second[keep])

    def instants(self, scale: str) -> Instants:
        """Convert the readings of a clock, in a given time scale, to instants of TAI.

        Raises
        ------
        Problem
            A reading lies in a leap second on a day or in a scale that has none.
        """
        late = self.second >= DAY
        if scale != "UTC":
            if np.any(late):
                found = f"{self.second[late][0]:g} s of the day"
                raise Problem("a leap second, which only UTC has", found, "time_scale UTC")
            return Instants(self.day, self.second + TAI_MINUS[scale])
        days, where = np.unique(self.day, return_inverse=True)
        ahead = np.array([tai_minus_utc(int(day)) for day in days])
        if np.any(late):
            length = np.array([tai_minus_utc(int(day) + 1) for day in days]) - ahead + DAY
            if np.any(self.second >= length[where]):
                row = int(np.argmax(self.second >= length[where]))
                raise Problem("no leap second on this day", calendar(int(self.day[row])), "a second below 60")
        return Instants(self.day, self.second + ahead[where])


@dataclass(frozen=True, eq=False)
class Instants:
    """Instants of TAI in two parts.

    Attributes
    ----------
    day : (N,) ndarray of int for N instants
        Whole days since MJD 0.
    second : (N,) ndarray
        SI seconds after the start of that day.
    """

    day: np.ndarray
    second: np.ndarray

    def since(self, epoch: str) -> np.ndarray:
        """Return SI seconds from an epoch in UTC (ISO 8601 text) to N instants, (N,); exact to 1e-11 s in a day.

        Leap seconds are counted.
        """
        start = Readings.of_texts([epoch.strip()]).instants("UTC")
        day, second = start.day[0], start.second[0]
        return np.asarray((self.day - day) * DAY + (self.second - second))

    def later(self, seconds: float) -> Instants:
        """Return the instants shifted later by a number of SI seconds."""
        return Instants(self.day, self.second + seconds)


def epoch_before(instants: Instants) -> str:
    """Return UTC of the first of the instants, rounded down to a full second, ISO 8601 text ending in Z."""
    first = np.argmin(instants.day * DAY + instants.second)
    second = float(instants.second[first])
    rough = int(instants.day[first]) + (second - tai_minus_utc(int(instants.day[first]))) / DAY
    day = int(np.floor(rough))
    # Within a leap second, take the second before.
    second = min((int(instants.day[first]) - day) * DAY + second - tai_minus_utc(day), DAY - 1.0)
    return (datetime.fromordinal(day + _MJD_ZERO) + timedelta(seconds=int(second))).strftime("%Y-%m-%dT%H:%M:%SZ")


def tai_minus_utc(day: int) -> float:
    """Return TAI - UTC on a modified Julian day, in seconds.

    Raises
    ------
    Problem
        The day is before 1972 or after 2099.
    """
    if not FIRST_DAY <= day <= LAST_DAY:
        raise Problem("outside the years of this time scale", f"MJD {day}", _FORM)
    when = date.fromordinal(day + _MJD_ZERO)
    with years_without_announced_leap_seconds():
        return float(erfa.dat(when.year, when.month, when.day, 0.0))


def calendar(day: int) -> str:
    """Return the date of a modified Julian day, ISO 8601."""
    return date.fromordinal(day + _MJD_ZERO).isoformat()


def calendar_reading(text: str) -> tuple[int, float]:
    """Return the modified Julian day and second of the day of a date and time.

    Raises
    ------
    Problem
        The text is not a date and time.
    """
    reading = single_reading(text)
    return int(reading.day[0]), float(reading.second[0])


def single_reading(text: str) -> Readings:
    """Parse one date and time.

    Raises
    ------
    Problem
        The text is not a date and time.
    """
    try:
        return Readings.of_texts([text.strip()])
    except Problem as problem:
        raise Problem(problem.problem, problem.found, problem.allowed) from None


def known_scale(name: str) -> str:
    """Return the time scale for a name as files spell it: GPS for GPST, UTC for GLO and GLONASS.

    Raises
    ------
    Problem
        The scale is not supported.
    """
    upper = name.strip().upper()
    scale = {"GPST": "GPS", "GLO": "UTC", "GLONASS": "UTC", "BDS": "BDT", "TDT": "TT"}.get(upper, upper)
    if scale not in SCALES:
        raise Problem("unknown time scale", shown(name), names_text(SCALES))
    return scale


def _day_of(text: str) -> int:
    """Return the modified Julian day of a date such as 2011-03-05 or, with the day of the year, 2011-064.

    Raises ValueError for any other text.
    """
    if len(text) == 8 and text[4] == "-" and text[5:].isdigit() and text[:4].isdigit():
        start = date(int(text[:4]), 1, 1)
        parsed = start + timedelta(days=int(text[5:]) - 1)
        if parsed.year != start.year:
            raise ValueError(text)
    elif len(text) == 10:
        parsed = date.fromisoformat(text)
    else:
        raise ValueError(text)
    day = parsed.toordinal() - _MJD_ZERO
    if not FIRST_DAY <= day < LAST_DAY:
        raise ValueError(text)
    return day
