"""Entries of a record: readings and events, identified by their content, and refusals with their reasons."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import Any

import numpy as np

from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import InputError, Issue, Problem
from twin.orbit.flight.earth import DAY
from twin.orbit.measured.earth_orientation import Readings, calendar, single_reading, tai_minus_utc

EPOCH_DAY = 51544
"""Modified Julian day of 2000-01-01; times count from its beginning in TAI."""
MICRO = 1_000_000
"""Microseconds in a second."""
DECISION = "decision"
"""Kind of an entry by which a person excludes another entry from the estimate, or includes it."""
_NOT_THE_INSTRUMENT = ("description", "disturbances")
"""Keys of an instrument's file that are not included in the SHA-256 that identifies the instrument."""


def canonical(data: Any) -> str:
    """Return plain data as its canonical JSON text, with sorted keys and no blanks.

    Raises
    ------
    ValueError
        The data contain NaN or an infinity.
    """
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)


def digest_of_data(data: Any) -> str:
    """Return the SHA-256 of the canonical text of plain data."""
    return hashlib.sha256(canonical(data).encode()).hexdigest()


@dataclass(frozen=True)
class Entry:
    """Entry of a record: one reading of the monitor or of a sensor, or one event.

    Attributes
    ----------
    kind : str
        Kind of reading, as named in `scenes.specs.operation`.
    subject : str
        Body, star tracker or camera; for an event its name, for a run its kind.
    time : int
        Microseconds of TAI since 2000-01-01T00:00:00 TAI.
    content : Mapping[str, Any]
        Plain data of the reading, in SI units or in the units given by the ends of the keys.
    line : int | None
        Line of the file, counted from 1; None for a file that is a single reading.
    origin : str
        SHA-256 of the images that the reading was measured in, which cannot belong to two times; empty for a reading
        that is itself the measurement.
    """

    kind: str
    subject: str
    time: int
    content: Mapping[str, Any]
    line: int | None = None
    origin: str = ""

    @property
    def digest(self) -> str:
        """SHA-256 that identifies the entry, independent of the file that contains it."""
        return digest_of_data([self.kind, self.subject, self.time, self.content])


@dataclass(frozen=True)
class Refusal:
    """Row of a table, or file, that was refused by a record, with the reason.

    Attributes
    ----------
    reason : str
        Text of the error, and its remedy.
    line : int | None
        Line of the file; None for the whole file.
    entry : Entry | None
        The reading, if it could be read.
    """

    reason: str
    line: int | None = None
    entry: Entry | None = None


@dataclass(frozen=True)
class Alarm:
    """Alarm of an operation: a condition that a person has to know of.

    Attributes
    ----------
    kind : str
        ``broken``, ``breaks``, ``jump``, ``sensor`` or ``contradiction``.
    subject : str
        Quantity, body or sensor.
    time : int
        Time of the condition, in microseconds of TAI since 2000.
    text : str
        Description, one sentence.
    content : Mapping[str, Any]
        Numbers of the condition, plain data.
    """

    kind: str
    subject: str
    time: int
    text: str
    content: Mapping[str, Any] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """SHA-256 that identifies the alarm by its kind, subject and time, independent of its numbers."""
        return digest_of_data([self.kind, self.subject, self.time])


@dataclass(frozen=True)
class FileContent:
    """Readings and refusals found in one file.

    Attributes
    ----------
    file : str
        Absolute path.
    sha256 : str
        SHA-256 of the file.
    meaning : str
        SHA-256 of the description with which the file was read: columns of a table, or time of a run.
    items : Sequence[Entry | Refusal]
        Entries and refusals in the order of the file.
    frames : Mapping[str, str]
        Path of every image that the readings were measured in -> its SHA-256.
    """

    file: str
    sha256: str
    meaning: str
    items: Sequence[Entry | Refusal]
    frames: Mapping[str, str]


@cache
def _leap(day: int) -> float:
    """Return TAI minus UTC on a Modified Julian day, in seconds."""
    return tai_minus_utc(day)


def micros(text: str, scale: str = "UTC", seconds: float = 0.0) -> int:
    """Convert the reading of a clock to microseconds of TAI since 2000.

    Parameters
    ----------
    text : str
        Date and time, ISO 8601.
    scale : str
        Time scale of the clock.
    seconds : float
        SI seconds to add.

    Raises
    ------
    Problem
        The text is not a date and time.
    """
    reading = single_reading(text)
    if scale == "UTC" and reading.second[0] < DAY:
        second = float(reading.second[0]) + _leap(int(reading.day[0]))
        return _count(int(reading.day[0]), second + seconds)
    instant = reading.instants(scale)
    return _count(int(instant.day[0]), float(instant.second[0]) + seconds)


def micros_after(epoch: str, scale: str, seconds: float) -> int:
    """Convert seconds that a clock counts from an epoch to microseconds of TAI since 2000.

    All days of the clock have 86400 s.

    Parameters
    ----------
    epoch : str
        Date and time of the clock at 0 s.
    scale : str
        Time scale of the clock.
    seconds : float
        Seconds counted by the clock.

    Raises
    ------
    Problem
        The epoch is not a date and time.
    """
    instant = Readings.after(epoch, np.array([seconds])).instants(scale)
    return _count(int(instant.day[0]), float(instant.second[0]))


def _count(day: int, second: float) -> int:
    """Convert a Modified Julian day and second of the day, both TAI, to microseconds since 2000."""
    return (day - EPOCH_DAY) * int(DAY) * MICRO + round(second * MICRO)


def utc_text(time: int) -> str:
    """Return a time in microseconds of TAI since 2000 as UTC, ISO 8601 with Z; the second of a leap second is 60."""
    whole = EPOCH_DAY + (time - 40 * MICRO) // (int(DAY) * MICRO)
    for day in (whole + 1, whole):
        start = (day - EPOCH_DAY) * int(DAY) * MICRO + round(_leap(day) * MICRO)
        if time >= start:
            break
    rest = time - start
    leap = max(rest - (int(DAY) * MICRO - 1), 0) if rest >= int(DAY) * MICRO else 0
    clock = datetime(2000, 1, 1) + timedelta(microseconds=min(rest, int(DAY) * MICRO - 1))
    text = clock.strftime("%H:%M:%S.%f")
    if leap:
        text = f"23:59:60.{leap - 1:06d}"
    return f"{calendar(day)}T{text.rstrip('0').rstrip('.')}Z"


def now() -> int:
    """Return the time of the computer's clock, in microseconds of TAI since 2000."""
    return micros(datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%f"))


def instrument_digest(instrument: Mapping[str, Any], cameras: Mapping[str, Any]) -> str:
    """Return the SHA-256 that identifies an instrument: its geometry and its cameras' prescriptions.

    Descriptions, disturbances, and the data sheet and exposure of its CCDs are not included, because they may differ
    between measurements.

    Parameters
    ----------
    instrument : Mapping[str, Any]
        Plain data of the instrument, as in a config.yaml.
    cameras : Mapping[str, Any]
        Name of a camera's file -> plain data of the prescription.
    """
    described = {key: value for key, value in instrument.items() if key not in _NOT_THE_INSTRUMENT}
    monitor = described.get("monitor")
    if isinstance(monitor, Mapping) and isinstance(monitor.get("area_ccd"), Mapping):
        left = {key: value for key, value in monitor["area_ccd"].items() if key not in ("detector", "exposure")}
        described["monitor"] = {**monitor, "area_ccd": left}
    bare = {name: {k: v for k, v in camera.items() if k != "description"} for name, camera in cameras.items()}
    return digest_of_data({"instrument": described, "cameras": bare})


def digest_of_job(job: ResolvedJob) -> str:
    """Return the SHA-256 that identifies a job's instrument."""
    plain = job.plain()
    return instrument_digest(plain["instrument"], plain["cameras"])


def one_line(error: InputError | Issue | Problem) -> str:
    """Return the text of an error, with its place in the file, as one line."""
    if isinstance(error, Problem):
        return str(error.at("")).removeprefix("input: ")
    return "; ".join(str(error).splitlines())
