"""Earth orientation from tables: UT1, polar motion, celestial pole offsets, and the rotation GCRS -> ITRS.

Between the days of a table, values are interpolated by cubics through the four nearest days (IERS Gazette 13, 1997).
UT1 is interpolated as UT1 - TAI, which has no leap seconds. Diurnal and semidiurnal effects of ocean tides on pole and
UT1, which the tables do not contain, are neglected: some 3 cm on the ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import erfa
import numpy as np

from analysis.arrays import ARCSEC
from optics.numerics.array_math import in_span
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.units import ANGLE, TIME
from twin.orbit.flight.earth import DAY, celestial_pole, tai_of
from twin.orbit.measured.clock import FIRST_DAY, LAST_DAY, calendar, calendar_reading, tai_minus_utc
from twin.orbit.measured.xml_file import first_lines, numbers, text_lines

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
            found = f"{calendar(int(self.mjd[0]))} to {calendar(int(self.mjd[-1]))}"
            needed = f"a table that covers {calendar(int(begin))} to {calendar(int(end))}"
            raise InputError(
                Issue("the table of Earth orientation does not cover the data", self.file, None, (), found, needed)
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
        return np.asarray(erfa.pom00(pole[..., 0], pole[..., 1], 0.0) @ _about_z(erfa.gmst82(self.julian, ut1)))

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
    # The matrix is a rotation by a small angle, whose sine and angle differ by a relative 1e-12.
    lower = np.stack(
        [
            rotation[..., 1, 2] - rotation[..., 2, 1],
            rotation[..., 2, 0] - rotation[..., 0, 2],
            rotation[..., 0, 1] - rotation[..., 1, 0],
        ],
        axis=-1,
    )
    sine = 0.5 * np.linalg.norm(lower, axis=-1, keepdims=True)
    return np.asarray(0.5 * lower * (np.arcsin(sine) / np.maximum(sine, 1e-300)) / (2.0 * _RATE_STEP))


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
        found = f"{len(cells[short])} columns"
        raise InputError(Issue("wrong number of columns", file, lines[short], (), found, f"{len(cells[0])} columns"))
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
        found = f"MJD {mjd[row]:g}, UT1 - UTC {ut1_utc[row]:g} s"
        raise InputError(Issue("implausible Earth orientation", file, lines[row], (), found, "UT1 - UTC within 1 s, a "
                               "pole within 2 arcsec, days of 1972 to 2099"))  # fmt: skip
    ahead = np.array([tai_minus_utc(int(np.floor(day))) for day in mjd])
    return EarthOrientation(file, mjd, ut1_utc - ahead, pole, offsets)


def _about_z(angle: np.ndarray) -> np.ndarray:
    """Return the matrix that rotates axes about Z by an angle, (..., 3, 3)."""
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rows = np.stack([c, s, zero, -s, c, zero, zero, zero, zero + 1.0], axis=-1)
    return np.asarray(rows.reshape(*np.shape(angle), 3, 3))
