"""Files and folders that were named, and what they hold now: tables that a YAML file describes, and run folders."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from scenes.specs.operation import RUNS, ReadingTableSpec
from scenes.yaml.csv_table import rows_apart
from scenes.yaml.errors import InputError, Problem
from scenes.yaml.input_file import is_file
from twin.operate.record.entries import Given, Refused, digest_of_data, micros, one_line
from twin.operate.record.history import History
from twin.operate.record.run_readings import run_entries
from twin.operate.record.telemetry import LARGEST, read_table_file, read_telemetry, tables_of
from twin.run.cli import InputErrorText
from twin.run.owned_files import MANIFEST
from twin.run.run_folder import is_run_folder

SETTLED = 2.0
"""Seconds for which a file has not changed before a watching command reads it: it may still be written."""

_TIME = re.compile(r"(\d{4})-?(\d{2})-?(\d{2})T(\d{2})[:-]?(\d{2})[:-]?(\d{2}(?:\.\d+)?)Z")
_YAML = (".yaml", ".yml")
State = tuple[int, ...]


def moment_said(option: str, text: str) -> int:
    """Microseconds of TAI since 2000 of a UTC that a command was given.

    Args:
        option: with its dashes.
        text: after it.

    Raises:
        InputErrorText: not a date and time.
    """
    try:
        return micros(text)
    except Problem as problem:
        raise InputErrorText(f"{option}: {one_line(problem)}") from None


def time_of_name(name: str) -> int | None:
    """Microseconds of TAI since 2000 of the UTC in the name of a run folder, ``recover-2026-03-05T03-05-00Z`` or
    ``20260305T030500Z``; None where there is none.
    """
    found = _TIME.search(name)
    if found is None:
        return None
    year, month, day, hour, minute, second = found.groups()
    try:
        return micros(f"{year}-{month}-{day}T{hour}:{minute}:{second}Z")
    except Problem:
        return None


@dataclass
class Sources:
    """What was named to be taken into a record.

    Attributes:
        places: YAML files, run folders, folders with some of these.
        moment: of a run folder that is named itself, microseconds; None where its name says it.
        stated: whether run folders that do not say it are of the record's instrument.
        watching: whether it is looked at more than once, and then only what has changed since is read.
        seen: path -> how it was when it was read.
    """

    places: Sequence[Path]
    moment: int | None
    stated: bool
    watching: bool = False
    seen: dict[str, State] = field(default_factory=dict)

    def look(self, history: History) -> Iterator[Given]:
        """What they hold now; of what is watched only what has changed since the last look.

        Raises:
            InputErrorText: nothing is there, or a run folder that was named has no time.
            InputError: a YAML file is not valid.
        """
        for place in self.places:
            if place.suffix not in _YAML and is_run_folder(place if place.is_dir() else place.parent):
                yield from self._run(place, self.moment, history)
                continue
            described = sorted(place.glob("*.yaml")) if place.is_dir() else [place]
            runs = sorted(one for one in place.iterdir() if is_run_folder(one)) if place.is_dir() else []
            if not described and not runs and not (self.watching and place.is_dir()):
                raise InputErrorText(
                    f"{place}: neither a run folder nor one with a YAML file that says what tables hold"
                )
            named: set[Path] = set()
            for file in described:
                yield from self._tables(file, history, named)
            for run in runs:
                if (run / MANIFEST).resolve() not in named:  # the time of others stands in a table
                    yield from self._run(run, None, history)

    def _tables(self, file: Path, history: History, named: set[Path]) -> Iterator[Given]:
        """What the tables hold that a YAML file describes; the run folders that they name are added to ``named``."""
        spec = read_telemetry(file, history)
        for table in spec.readings:
            for path in tables_of(spec, table):
                own = _runs_named(table, path) if table.kind in RUNS else []
                named |= {one.resolve() for one in own}
                if not self._is_seen(path, own):
                    yield read_table_file(table, path, history)

    def _run(self, place: Path, moment: int | None, history: History) -> Iterator[Given]:
        folder = place if place.is_dir() else place.parent
        moment = time_of_name(folder.name) if moment is None else moment
        if moment is None and place in self.places:
            raise InputErrorText(f"{place}: a run folder does not say when it was read; --time UTC does, or its name")
        if self._is_seen(folder / MANIFEST):
            return
        if moment is None:
            reason = (
                "a run folder does not say when it was read; put the UTC into its name, recover-2026-03-05T03-05-00Z"
            )
            yield Given(str(folder), digest_of_data(str(folder)), "", [Refused(f"{folder.name}: {reason}")], {})
        else:
            yield run_entries(place, "", moment, history, self.stated)

    def _is_seen(self, path: Path, named: Sequence[Path] = ()) -> bool:
        """Whether a watched file, and the run folders that it names, are as they were when it was read, or may still be
        written.
        """
        if not self.watching:
            return False
        states = [one.stat() for one in (path, *named)]
        now = tuple(number for state in states for number in (state.st_mtime_ns, state.st_size))
        if self.seen.get(str(path)) == now or any(time.time() - state.st_mtime < SETTLED for state in states):
            return True
        self.seen[str(path)] = now
        return False


def _runs_named(table: ReadingTableSpec, path: Path) -> list[Path]:
    """Manifests of the run folders that a table names and that are finished."""
    try:
        heads, *rows = [cells for _, cells in rows_apart(path, LARGEST) if not isinstance(cells, str)]
        column = [head.strip() for head in heads].index(str(table.name))
    except (InputError, OSError, ValueError):
        return []
    named = (path.parent / cells[column].strip() / MANIFEST for cells in rows if len(cells) > column)
    return [one for one in named if is_file(one)]
