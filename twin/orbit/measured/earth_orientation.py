"""Earth orientation from tables: UT1, polar motion, celestial pole offsets, and the rotation GCRS -> ITRS.

Between the days of a table, values are interpolated by cubics through the four nearest days (IERS Gazette 13, 1997).
UT1 is interpolated as UT1 - TAI, which has no leap seconds. Diurnal and semidiurnal effects of ocean tides on pole and
UT1, which the tables do not contain, are neglected: some 3 cm on the ground.

Time scales: conversion of clock readings in UTC, GPS, TAI, TT and others to seconds of atomic time.

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
from pathlib import Path
from typing import Any

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from analysis.arrays import ARCSEC
from optics.numerics.array_math import in_span
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.errors import InputError, Issue, Problem, names_text, shown
from scenes.yaml.units import ANGLE, TIME
from twin.orbit.flight.earth import DAY, celestial_pole, tai_of, years_without_announced_leap_seconds
from twin.orbit.measured.xml_file import first_lines, numbers, text_lines

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
                value = f"{self.second[late][0]:g} s of the day"
                raise Problem("a leap second, which only UTC has", value, "time_scale UTC")
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
        raise Problem(problem.problem, problem.value, problem.allowed) from None


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


def readings(file: str, texts: Sequence[str], lines: Sequence[int]) -> Readings:
    """Parse clock readings from N calendar texts on these lines; raise InputError if one is not a date and time."""
    try:
        return Readings.of_texts(texts)
    except Problem as problem:
        (row,) = problem.within
        raise InputError(
            Issue(problem.problem, file, lines[int(row)], ("time",), problem.value, problem.allowed)
        ) from None


def require_increasing(file: str, clock: Readings, lines: Sequence[int]) -> None:
    """Raise InputError unless each of N clock readings on these lines is later than the one before it."""
    back = (np.diff(clock.day) * 86400.0 + np.diff(clock.second)) <= 0.0
    for row in np.flatnonzero(back)[:1]:
        problem = "a time that is not later than the one before it"
        raise InputError(Issue(problem, file, lines[row + 1], allowed="times in increasing order, each once"))


WHAT = "a table of Earth orientation: finals2000A or C04 as the IERS gives them, or CSV"
"""Description of the file for error messages."""
_RATE_STEP = 1.0
"""Half step of the difference quotient for the rotation rate, in seconds: its error due to rounding is 1e-16 rad/s, and
that of the linear approximation far smaller.
"""
_COLUMNS = (
    Column("mjd", least=FIRST_DAY, most=LAST_DAY),
    Column("ut1_utc", TIME, least=-1.0, most=1.0),
    Column("x_pole", ANGLE, least=-1e-5, most=1e-5),
    Column("y_pole", ANGLE, least=-1e-5, most=1e-5),
    Column("dx", ANGLE, needed=False, least=-1e-7, most=1e-7),
    Column("dy", ANGLE, needed=False, least=-1e-7, most=1e-7),
)


@dataclass(frozen=True, eq=False)
class EarthOrientation:
    """Table of Earth orientation (UT1, polar motion, celestial pole offsets), from `read_earth_orientation`.

    Attributes
    ----------
    file : str
        Path of the file.
    mjd : (K,) ndarray for K days
        Modified Julian dates in UTC, increasing, four or more.
    ut1_tai : (K,) ndarray
        UT1 - TAI, seconds.
    pole : (K, 2) ndarray
        x and y of the pole, radians.
    offsets : (K, 2) ndarray
        Offsets dX and dY of the celestial pole from IAU 2006/2000A, radians.
    """

    file: str
    mjd: np.ndarray
    ut1_tai: np.ndarray
    pole: np.ndarray
    offsets: np.ndarray

    def rotation(self, epoch: str, first: float, last: float) -> TableRotation:
        """Return the Earth's rotation from `first` to `last`, seconds from an epoch in UTC.

        Raises
        ------
        InputError
            The table does not cover the span.
        """
        day, second = calendar_reading(epoch)
        begin, end = (day + (second + t) / DAY for t in (first, last))
        if not np.all(in_span(DAY * (np.array([begin, end]) - day), *(DAY * (self.mjd[[0, -1]] - day)))):
            value = f"{calendar(int(self.mjd[0]))} to {calendar(int(self.mjd[-1]))}"
            needed = f"a table that covers {calendar(int(begin))} to {calendar(int(end))}"
            raise InputError(
                Issue("the table of Earth orientation does not cover the data", self.file, None, (), value, needed)
            )
        return TableRotation(self, epoch, celestial_pole(epoch, first, last))

    def at(self, mjd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return UT1 - TAI (N,), in seconds, and pole and pole offsets (N, 2), in radians, at N dates in UTC."""
        count = len(self.mjd)
        start = np.clip(np.searchsorted(self.mjd, mjd, side="right") - 2, 0, count - 4)
        which = start[..., None] + np.arange(4)
        nodes = self.mjd[which]
        weight = np.ones(which.shape)
        for k in range(4):
            for j in range(4):
                if j != k:
                    weight[..., k] *= (mjd - nodes[..., j]) / (nodes[..., k] - nodes[..., j])
        ut1 = np.sum(weight * self.ut1_tai[which], axis=-1)
        pole, offsets = (np.sum(weight[..., None] * v[which], axis=-2) for v in (self.pole, self.offsets))
        return ut1, pole, offsets


@dataclass(frozen=True, eq=False)
class TableRotation:
    """Rotation GCRS -> ITRS from a table; interface of `twin.orbit.flight.earth.EarthRotation`.

    Attributes
    ----------
    table : EarthOrientation
        Table of Earth orientation.
    epoch : str
        UTC from which times are counted in SI seconds, ISO 8601 text.
    celestial_pole : callable
        Function of the time that returns the celestial pole's X and Y and the CIO locator s according to IAU
        2006/2000A, radians.
    """

    table: EarthOrientation
    epoch: str
    celestial_pole: Any

    def orientation_parameters(self, seconds: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return UT1 (...), days, and polar motion and celestial pole offsets (..., 2), radians, at times (...).

        UT1 is the second part of a Julian date whose first part is `julian`.
        """
        t = np.asarray(seconds, dtype=np.float64)
        day, second = calendar_reading(self.epoch)
        tai = second + tai_minus_utc(day) + t
        ut1_tai, pole, offsets = self.table.at(day + (second + t) / DAY)
        return (tai + ut1_tai) / DAY, pole, offsets

    @property
    def julian(self) -> float:
        """First part of the Julian date of the epoch, days."""
        return 2400000.5 + calendar_reading(self.epoch)[0]

    def matrix(self, seconds: Any) -> np.ndarray:
        """Return the rotation GCRS -> ITRS: x_itrs = matrix @ x_gcrs; (..., 3, 3) for times (...)."""
        t = np.asarray(seconds, dtype=np.float64)
        ut1, pole, offsets = self.orientation_parameters(t)
        x, y, s = np.moveaxis(self.celestial_pole(t), -1, 0)
        celestial = erfa.c2ixys(x + offsets[..., 0], y + offsets[..., 1], s)
        return np.asarray(erfa.c2tcio(celestial, erfa.era00(self.julian, ut1), self._polar(t, pole)))

    def teme_to_itrs(self, seconds: Any) -> np.ndarray:
        """Return the rotation from true equator, mean equinox (TEME) to ITRS, (..., 3, 3) for times (...).

        It uses Greenwich mean sidereal time of 1982 and polar motion (Vallado et al., AIAA 2006-6753, appendix C).
        """
        ut1, pole, _ = self.orientation_parameters(seconds)
        return np.asarray(
            erfa.pom00(pole[..., 0], pole[..., 1], 0.0) @ erfa.rz(erfa.gmst82(self.julian, ut1), np.eye(3))
        )

    def _polar(self, t: np.ndarray, pole: np.ndarray) -> np.ndarray:
        """Return polar motion, the rotation TIRS -> ITRS, (..., 3, 3)."""
        tai_1, tai_2 = tai_of(self.epoch)
        return np.asarray(erfa.pom00(pole[..., 0], pole[..., 1], erfa.sp00(tai_1, tai_2 + (t + erfa.TTMTAI) / DAY)))


def angular_velocity(matrix: Any, seconds: np.ndarray) -> np.ndarray:
    """Return the angular velocity of the axes to which a rotation transforms, in these axes, (N, 3), in rad/s.

    Parameters
    ----------
    matrix : callable
        Function of N times (N,), in seconds, that returns rotation matrices (N, 3, 3).
    seconds : (N,) ndarray
        Times, seconds.
    """
    rotation = matrix(seconds + _RATE_STEP) @ np.swapaxes(matrix(seconds - _RATE_STEP), -1, -2)
    return np.asarray(-Rotation.from_matrix(rotation).as_rotvec() / (2.0 * _RATE_STEP))


def constant_orientation(epoch: str, ut1_utc: float, pole: tuple[float, float]) -> EarthOrientation:
    """Return a table over a week of constant polar motion and uniform UT1, without celestial pole offsets.

    Parameters
    ----------
    epoch : str
        UTC, ISO 8601 text.
    ut1_utc : float
        UT1 - UTC at the epoch, seconds; UT1 is taken to run at a constant rate from there, also over a leap second.
    pole : tuple of float
        x and y of the pole, radians.
    """
    day, _ = calendar_reading(epoch)
    mjd = day + np.arange(-3.0, 5.0)
    ones = np.ones((len(mjd), 1))
    return EarthOrientation(
        "", mjd, ones[:, 0] * (ut1_utc - tai_minus_utc(day)), ones * np.array(pole), 0.0 * mjd[:, None] * np.ones(2)
    )


def read_earth_orientation(path: str | Path) -> EarthOrientation:
    """Read a table of Earth orientation.

    Parameters
    ----------
    path : str or Path
        File finals2000A (all, data or daily), C04 (14 or 20), or CSV with columns mjd, ut1_utc [s], x_pole [arcsec],
        y_pole [arcsec] and optionally dx [mas] and dy [mas].

    Raises
    ------
    InputError
        The file cannot be read, or holds fewer than four days.
    """
    file, start = str(path), list(first_lines(path, WHAT, 400))
    if any("mjd" in line.lower() and not line.startswith("#") and "," in line for line in start):
        table = read_table(path, _COLUMNS, 4)
        zero = np.zeros(len(table))
        offsets = np.stack([table[n] if n in table else zero for n in ("dx", "dy")], axis=-1)
        lines = [int(v) for v in table.lines]
        return _checked(file, lines, table["mjd"], table["ut1_utc"], table.stacked("x_pole", "y_pole"), offsets)
    rows = [(k + 1, line) for k, line in enumerate(text_lines(path, WHAT)) if line.strip() and not line.startswith("#")]
    data = [(k, line) for k, line in rows if line.split()[0].isdigit() and len(line.split()[0]) == 4]
    return _c04(file, data) if data and len(data[0][1].split()) in (16, 21) else _finals(file, rows)


def _c04(file: str, rows: list[tuple[int, str]]) -> EarthOrientation:
    """Parse the rows of an Earth orientation table of the IERS series C04."""
    cells = [line.split() for _, line in rows]
    lines = [k for k, _ in rows]
    columns = [4, 5, 6, 7, 8, 9] if len(cells[0]) == 21 else [3, 4, 5, 6, 8, 9]
    short = next((k for k, row in enumerate(cells) if len(row) != len(cells[0])), None)
    if short is not None:
        value = f"{len(cells[short])} columns"
        raise InputError(Issue("wrong number of columns", file, lines[short], (), value, f"{len(cells[0])} columns"))
    heads = ("MJD", "x", "y", "UT1-UTC", "dX", "dY")
    table = numbers(file, [[row[k] for k in columns] for row in cells], lines, heads)
    late = table[:, 0] >= FIRST_DAY
    lines = [k for k, valid in zip(lines, late, strict=True) if valid]
    table = table[late]
    return _checked(file, lines, table[:, 0], table[:, 3], table[:, 1:3] * ARCSEC, table[:, 4:6] * ARCSEC)


_FINAL = {"x": (134, 144), "y": (144, 154), "UT1-UTC": (154, 165), "dX": (165, 175), "dY": (175, 185)}
"""Character columns of the final values (Bulletin B) in finals2000A, by quantity; recent days have only those of
Bulletin A.
"""
_FINALS = {"MJD": (7, 15), "x": (18, 27), "y": (37, 46), "UT1-UTC": (58, 68), "dX": (97, 106), "dY": (116, 125)}
"""Character columns of Bulletin A in finals2000A, by quantity."""


def _finals(file: str, rows: list[tuple[int, str]]) -> EarthOrientation:
    """Parse the rows of a finals2000A table: values of Bulletin B if the file has them, otherwise of Bulletin A.

    Days without a prediction of pole and UT1 are omitted.
    """
    cells, lines = [], []
    for k, line in rows:
        columns = [line[a:b].strip() for a, b in _FINALS.values()]
        if len(line) < 68 and len(line) > 15 and line[15:].strip():
            raise InputError(Issue("a truncated line", file, k, (), f"{len(line)} characters", WHAT))
        if len(line) < 15:
            raise InputError(Issue("not a line of this table", file, k, (), repr(line[:40]), WHAT))
        final = [line[a:b].strip() for a, b in _FINAL.values()]
        columns[1:] = final if all(final) else columns[1:]
        if all(columns[1:4]):
            cells.append([text or "0" for text in columns])
            lines.append(k)
    table = numbers(file, cells, lines, tuple(_FINALS))
    return _checked(file, lines, table[:, 0], table[:, 3], table[:, 1:3] * ARCSEC, table[:, 4:6] * 1e-3 * ARCSEC)


def _checked(
    file: str, lines: list[int], mjd: np.ndarray, ut1_utc: np.ndarray, pole: np.ndarray, offsets: np.ndarray
) -> EarthOrientation:
    """Return the table, or raise InputError if its days or values are not plausible."""
    if len(mjd) < 4:
        raise InputError(Issue("too few days", file, None, (), f"{len(mjd)} days", "four days or more"))
    for row in (*np.flatnonzero(np.diff(mjd) <= 0.0)[:1] + 1, *np.flatnonzero(np.diff(mjd) > 10.0)[:1] + 1):
        problem = "days that do not increase, or a gap of more than ten"
        raise InputError(Issue(problem, file, lines[row], (), f"MJD {mjd[row]:g}", "days in order"))
    far = (np.abs(ut1_utc) > 1.0) | np.any(np.abs(pole) > 1e-5, axis=1) | (mjd < FIRST_DAY) | (mjd > LAST_DAY)
    for row in np.flatnonzero(far)[:1]:
        value = f"MJD {mjd[row]:g}, UT1 - UTC {ut1_utc[row]:g} s"
        raise InputError(Issue("implausible Earth orientation", file, lines[row], (), value, "UT1 - UTC within 1 s, a "
                               "pole within 2 arcsec, days of 1972 to 2099"))  # fmt: skip
    ahead = np.array([tai_minus_utc(int(np.floor(day))) for day in mjd])
    return EarthOrientation(file, mjd, ut1_utc - ahead, pole, offsets)
