"""What a record holds: readings and events, each recognised by its content, and what was refused with the reason."""

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
from twin.orbit.measured.clock import Readings, calendar, single_reading, tai_minus_utc

EPOCH_DAY = 51544
"""Modified Julian day from whose beginning in TAI, 2000-01-01, times are counted."""
MICRO = 1_000_000
DECISION = "decision"
"""Kind of an entry by which a person excludes another entry from the estimate, or includes it."""
_NOT_THE_INSTRUMENT = ("description", "disturbances")
"""Keys of an instrument that do not say what it is."""


def canonical(data: Any) -> str:
    """Plain data as the one text that stands for them: sorted keys, no blanks. Raises ValueError: NaN, infinities."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)


def digest_of_data(data: Any) -> str:
    """SHA-256 of the one text of plain data."""
    return hashlib.sha256(canonical(data).encode()).hexdigest()


@dataclass(frozen=True)
class Entry:
    """One reading, or one event.

    Attributes
    ----------
    kind : str
        Of reading, as `scenes.specs.operation` names them.
    subject : str
        Body, star tracker or camera; name of an event; for a run the kind again.
    time : int
        Microseconds of TAI since 2000-01-01T00:00:00 TAI.
    content : Mapping[str, Any]
        What was read, plain data in SI units, or in those that the keys of a run's numbers end in.
    line : int | None
        Of the file, counted from 1; None for a file that is one reading.
    origin : str
        SHA-256 of all that it was found from, such as a monitor's frames, which cannot be of two moments; "" for
        numbers that are what was read.
    """

    kind: str
    subject: str
    time: int
    content: Mapping[str, Any]
    line: int | None = None
    origin: str = ""

    @property
    def digest(self) -> str:
        """SHA-256 by which it is recognised, whatever file it comes in."""
        return digest_of_data([self.kind, self.subject, self.time, self.content])


@dataclass(frozen=True)
class Refusal:
    """What is not taken.

    Attributes
    ----------
    reason : str
        What is wrong with it, and what to do.
    line : int | None
        Of the file; None for all of it.
    entry : Entry | None
        The reading, where it could be read at all.
    """

    reason: str
    line: int | None = None
    entry: Entry | None = None


@dataclass(frozen=True)
class Alarm:
    """Something of which a person has to know.

    Attributes
    ----------
    kind : str
        What is wrong: ``broken``, ``breaks``, ``jump``, ``sensor`` or ``contradiction``.
    subject : str
        Quantity, body or sensor.
    time : int
        To which it belongs, microseconds of TAI since 2000.
    text : str
        a sentence.
    content : Mapping[str, Any]
        The numbers behind it, plain data.
    """

    kind: str
    subject: str
    time: int
    text: str
    content: Mapping[str, Any] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """SHA-256 by which it is recognised: one of a kind and subject at a time, whatever its numbers."""
        return digest_of_data([self.kind, self.subject, self.time])


@dataclass(frozen=True)
class FileContent:
    """What one file holds.

    Attributes
    ----------
    file : str
        Absolute path.
    sha256 : str
        Of it.
    meaning : str
        SHA-256 of what was said of it: columns, or the time of a run.
    items : Sequence[Entry | Refused]
        Readings and refusals in the order of the file.
    frames : Mapping[str, str]
        Other files that it was found from, by path, with their SHA-256.
    """

    file: str
    sha256: str
    meaning: str
    items: Sequence[Entry | Refusal]
    frames: Mapping[str, str]


@cache
def _leap(day: int) -> float:
    return tai_minus_utc(day)


def micros(text: str, scale: str = "UTC", seconds: float = 0.0) -> int:
    """Microseconds of TAI since 2000 of what a clock showed.

    Parameters
    ----------
    text : str
        Date and time, ISO 8601.
    scale : str
        Of the clock.
    seconds : float
        SI seconds that have passed since.

    Raises
    ------
    Problem
        Not such a text.
    """
    one = single_reading(text)
    if scale == "UTC" and one.second[0] < DAY:
        second = float(one.second[0]) + _leap(int(one.day[0]))
        return _count(int(one.day[0]), second + seconds)
    instant = one.instants(scale)
    return _count(int(instant.day[0]), float(instant.second[0]) + seconds)


def micros_after(epoch: str, scale: str, seconds: float) -> int:
    """The same of a clock whose days have 86400 s and that counts seconds from an epoch.

    Parameters
    ----------
    epoch : str
        What it read at 0 s.
    scale : str
        Of the clock.
    seconds : float
        That it counted.

    Raises
    ------
    Problem
        Not a date and time.
    """
    instant = Readings.after(epoch, np.array([seconds])).instants(scale)
    return _count(int(instant.day[0]), float(instant.second[0]))


def _count(day: int, second: float) -> int:
    return (day - EPOCH_DAY) * int(DAY) * MICRO + round(second * MICRO)


def utc_text(time: int) -> str:
    """UTC of a time in microseconds of TAI since 2000, ISO 8601 ending in Z; within a leap second the second is 60."""
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
    """What the computer's clock shows."""
    return micros(datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%f"))


def instrument_digest(instrument: Mapping[str, Any], cameras: Mapping[str, Any]) -> str:
    """SHA-256 of what an instrument is: its geometry and its cameras' prescriptions, without names of other files.

    The data sheet of its CCDs and their exposure are not part of it: a measurement may state others.

    Parameters
    ----------
    instrument : Mapping[str, Any]
        Plain data, as a config.yaml has them.
    cameras : Mapping[str, Any]
        Reference -> plain data of the prescription.
    """
    own = {key: value for key, value in instrument.items() if key not in _NOT_THE_INSTRUMENT}
    monitor = own.get("monitor")
    if isinstance(monitor, Mapping) and isinstance(monitor.get("area_ccd"), Mapping):
        left = {key: value for key, value in monitor["area_ccd"].items() if key not in ("detector", "exposure")}
        own["monitor"] = {**monitor, "area_ccd": left}
    bare = {name: {k: v for k, v in one.items() if k != "description"} for name, one in cameras.items()}
    return digest_of_data({"instrument": own, "cameras": bare})


def digest_of_job(job: ResolvedJob) -> str:
    """SHA-256 of what a job's instrument is."""
    plain = job.plain()
    return instrument_digest(plain["instrument"], plain["cameras"])


def one_line(error: InputError | Issue | Problem) -> str:
    """What is wrong, as one line."""
    if isinstance(error, Problem):
        return str(error.at("")).removeprefix("input: ")
    return "; ".join(str(error).splitlines())
