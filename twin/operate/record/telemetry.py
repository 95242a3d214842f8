"""Readings and events on their way into a record: from tables, row by row, and from run folders. What cannot be true is
refused with its reason.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from scenes.specs.operation import (
    EVENT,
    EVENTS,
    QUATERNION,
    RUNS,
    VALUES,
    ReadingColumnSpec,
    ReadingTableSpec,
    TelemetrySpec,
)
from scenes.specs.resolved import resolve_on
from scenes.yaml.csv_table import rows_apart
from scenes.yaml.errors import InputError, Issue, Problem, names_text, nearest, shown, unknown
from scenes.yaml.input_file import digest_of, is_file, parse_json, read_json
from scenes.yaml.spec import validate
from scenes.yaml.units import MOMENT, parse_quantity
from scenes.yaml.yaml_file import read_yaml
from twin.framework.cli import InputErrorText
from twin.framework.owned_files import MANIFEST
from twin.framework.run_folder import Manifest, is_run_folder, read_manifest
from twin.operate.record.entries import (
    MICRO,
    Entry,
    FileContent,
    Refusal,
    canonical,
    digest_of_data,
    digest_of_job,
    instrument_digest,
    micros,
    micros_after,
    one_line,
)
from twin.operate.record.history import History

RESULTS = {"monitor": "recovered.json", "calibration": "calibration.json", "angle": "angle.json"}
"""Sort of reading -> file of the run folder that holds it."""
_OF_A_STATE = (
    "cameras",
    "intersection_angle",
    "spots",
    "disturbances",
    "retraced",
    "sigma_holds",
    "centroid",
    "frames",
)
"""Keys of a monitor's result that tell of one state."""
_IMAGES = (".tiff", ".tif", ".fits", ".fit", ".fts", ".png")
CONFIG = "config.yaml"
LARGEST_READING = 4_000_000
"""Characters of what is kept of one reading."""


def kind_of_run(folder: Path) -> str:
    """Sort of reading that a run folder holds; empty for none."""
    return next((kind for kind in RUNS if is_file(folder / RESULTS[kind])), "")


def run_entries(place: Path, kind: str, moment: int, history: History, stated: bool) -> FileContent:
    """The readings of a run folder; what is wrong with it stands in their place.

    Parameters
    ----------
    place : Path
        The folder, or the file of results in it.
    kind : str
        Of reading; empty for the one that it holds.
    moment : int
        Of it, or of the beginning of a series, microseconds of TAI since 2000.
    history : History
        The record.
    stated : bool
        Whether somebody says that the run is of the record's instrument, of a run that does not say it itself.
    """
    folder = place.parent if place.name in RESULTS.values() else place
    kind = kind or kind_of_run(folder)
    file = folder / RESULTS.get(kind, RESULTS["monitor"])
    manifest = read_manifest(folder)
    digest, frames = "", {}
    items: list[Entry | Refusal]
    try:
        if not kind or manifest is None or not is_file(file):
            allowed = f"a finished run folder with {names_text(RESULTS.values())}"
            raise Problem(f"no reading in {folder}", None, allowed)
        digest, frames = digest_of(file), _frames(manifest)
        _is_as_written(folder, file, digest, manifest)
        _is_of(folder, history, stated and kind != "monitor")
        items = list(_found(kind, read_json(file), moment, digest, frames))
    except (Problem, InputError) as error:
        items = [Refusal(one_line(error))]
    return FileContent(
        str(file), digest or digest_of_data(str(file)), digest_of_data([kind, moment, stated]), items, frames
    )


def _frames(manifest: Manifest) -> dict[str, str]:
    """Images from which a run found what it found, with their SHA-256: those that it read, else those that it wrote."""
    read = {name: digest for name, digest in manifest.inputs.items() if name.lower().endswith(_IMAGES)}
    own = {name: digest for name, digest in manifest.sha256.items() if name.startswith("images/")}
    return read or {name: digest for name, digest in own.items() if name.endswith((".tiff", ".fits"))}


def _is_as_written(folder: Path, file: Path, digest: str, manifest: Manifest) -> None:
    """Refuse results that are not those that the run wrote. Raises Problem."""
    known = {file.name: digest}
    known |= {CONFIG: digest_of(folder / CONFIG)} if is_file(folder / CONFIG) else {}
    changed = [name for name, own in known.items() if manifest.sha256.get(name) != own]
    if changed:
        problem = f"{folder}: changed since its run: {names_text(changed)}"
        raise Problem(problem, None, "the folder as the run left it; python -m twin.verify tells more")


def _is_of(folder: Path, history: History, stated: bool) -> None:
    """Refuse a run of another instrument, or one that does not say of which. Raises Problem, InputError."""
    data = read_yaml(folder / CONFIG).data if is_file(folder / CONFIG) else None
    model = data.get("model", data) if isinstance(data, Mapping) else None
    instrument = model.get("instrument") if isinstance(model, Mapping) else None
    cameras = model.get("cameras") if isinstance(model, Mapping) else None
    if not isinstance(instrument, Mapping) or not isinstance(cameras, Mapping):
        if stated:
            return
        problem = f"{folder} does not say of which instrument it is"
        raise Problem(
            problem, None, "a run whose config.yaml holds the instrument, or --instrument NAME, which says it"
        )
    found = instrument_digest(instrument, {k: v for k, v in cameras.items() if isinstance(v, Mapping)})
    if found != history.sha256:
        name = instrument.get("name", "without a name")
        problem = f"{folder} is of another instrument, {name} ({found[:12]})"
        raise Problem(problem, None, f"runs of {history.name} ({history.sha256[:12]})")


def _found(kind: str, data: Any, moment: int, digest: str, frames: Mapping[str, str]) -> list[Entry]:
    """One reading, or those of a series at its times. Raises Problem."""
    if not isinstance(data, Mapping):
        raise Problem("no results", None, RESULTS[kind])
    origin = digest_of_data(sorted(frames.values())) if frames else digest
    if kind != "monitor":
        content = {key: value for key, value in data.items() if key != "reference_frames"}
        return [_entry(kind, moment, {"sha256": digest, "numbers": content}, origin)]
    states, times = data.get("series") or [data], data.get("times_s") or [0.0]
    if not isinstance(states, list) or not isinstance(times, list) or len(states) != len(times):
        raise Problem("times and states that do not belong together", None, RESULTS[kind])
    out = []
    for k, (state, seconds) in enumerate(zip(states, times, strict=True)):
        if not isinstance(state, Mapping) or "cameras" not in state or not isinstance(seconds, int | float):
            raise Problem("a state without cameras or without a time", None, RESULTS[kind])
        numbers = {key: state[key] for key in _OF_A_STATE if key in state}
        content = {"sha256": digest, "state": k, "numbers": numbers}
        out.append(_entry(kind, moment + round(seconds * MICRO), content, digest_of_data([origin, k])))
    return out


def _entry(kind: str, moment: int, content: Mapping[str, Any], origin: str) -> Entry:
    """A reading of a size and with numbers that a record can hold. Raises Problem."""
    try:
        text = canonical(content)
    except ValueError:
        raise Problem("a number that is not finite", None, "finite numbers") from None
    if len(text) > LARGEST_READING:
        raise Problem("too large", f"{len(text)} characters", f"at most {LARGEST_READING}")
    return Entry(kind, kind, moment, parse_json(text, "results"), None, origin)


LARGEST = 1 << 28
"""Bytes of a table."""
WITHIN = 100.0
"""A body's temperature departs from the instrument's by less, kelvin; so does a change in a job that has no sign."""
UNIT = 1e-3
"""By how much the length of a quaternion may differ from 1."""


def read_telemetry(path: Path, history: History) -> TelemetrySpec:
    """What tables hold, as a file says.

    Raises
    ------
    InputError
        It cannot be read, is not valid, or is of another instrument than the record.
    """
    spec = validate(TelemetrySpec, read_yaml(path))
    digest = digest_of_job(resolve_on(spec, spec.instrument))
    if digest != history.sha256:
        problem = f"tables of another instrument than the record's ({digest[:12]}, not {history.sha256[:12]})"
        raise spec.error(problem, ("instrument",), found=spec.instrument, allowed=history.name)
    for k, table in enumerate(spec.readings):
        known = {"temperature": history.bodies["warm"], "focus": history.bodies["cameras"]}.get(table.kind)
        for subject in table.columns if known is not None else ():
            if subject not in (known or ()):
                what = "body with a temperature" if table.kind == "temperature" else "camera"
                raise spec.error(unknown(f"no such {what}", subject, known or ()), ("readings", k, "columns", subject))
    return spec


def tables_of(spec: TelemetrySpec, table: ReadingTableSpec) -> list[Path]:
    """The files of a table that are there, by name.

    Raises
    ------
    InputError
        Not the name of files.
    """
    folder = Path(spec.source.file).parent
    try:
        return sorted(path.absolute() for path in folder.glob(table.files) if path.is_file())
    except (ValueError, NotImplementedError):
        problem, allowed = "not the name of files", "a path relative to this file, with * and ? for any letters"
        raise table.error(problem, ("files",), found=table.files, allowed=allowed) from None


def read_table_file(table: ReadingTableSpec, path: Path, history: History) -> FileContent:
    """What one table holds; one that cannot be read is refused as a whole."""
    try:
        digest = digest_of(path)
        items, frames = _items(table, path, history)
    except InputError as error:
        items, frames = [Refusal(one_line(one), one.line) for one in error.issues], {}
    except OSError as error:
        digest, items, frames = digest_of_data(str(path)), [Refusal(f"cannot be read: {error.strerror}")], {}
    return FileContent(str(path), digest, digest_of_data(table.plain()), items, frames)


def _items(table: ReadingTableSpec, path: Path, history: History) -> tuple[list[Entry | Refusal], dict[str, str]]:
    rows = rows_apart(path, LARGEST)
    if not rows:
        raise InputError(Issue("an empty table", str(path), 1, allowed="a row of heads, and rows below it"))
    if table.form == "keywords":
        return _keyword_items(table, rows, history), {}
    frames: dict[str, str] = {}
    line, cells = rows[0]
    if isinstance(cells, str):
        raise InputError(Issue(cells, str(path), line, allowed="a row of heads, and rows below it"))
    heads = [head.strip() for head in cells]
    wanted = [table.time, *(head for one in table.columns.values() for head in one.column)]
    wanted += [head for head in (table.name, table.detail) if head is not None]
    for head in wanted:
        if heads.count(head) != 1:
            text = f"{'no' if head not in heads else 'more than one'} column {head!r}"
            raise InputError(Issue(text, str(path), line, (), names_text(heads), None, nearest(head, heads)))
    place = {head: heads.index(head) for head in wanted}
    items: list[Entry | Refusal] = []
    for number, cells in rows[1:]:
        if isinstance(cells, str):
            items.append(Refusal(cells, number))
            continue
        if len(cells) != len(heads):
            items.append(Refusal(f"{len(cells)} cells under {len(heads)} heads", number))
            continue
        row = {head: cells[k].strip() for head, k in place.items()}
        try:
            moment = _moment(table, row[table.time])
        except Problem as problem:
            items.append(Refusal(f"{table.time}: {one_line(problem)}", number))
            continue
        if table.kind in VALUES:
            read = ((one, column, [row[head] for head in column.column]) for one, column in table.columns.items())
            # cells that are empty say nothing
            items += [_tried(_reading, table, history, *one, moment, number) for one in read if any(one[2])]
        elif table.kind == EVENT:
            items.append(_tried(_event, table, row, moment, number))
        else:
            found = run_entries(path.parent / row[str(table.name)], table.kind, moment, history, stated=True)
            frames |= found.frames
            items += [replace(one, line=number) for one in found.items]
    return items, frames


def _keyword_items(
    table: ReadingTableSpec, rows: Sequence[tuple[int, list[str] | str]], history: History
) -> list[Entry | Refusal]:
    """Lines of ``KEYWORD = TIME NUMBER``; other keywords, and lines without a number after a time, are not readings."""
    by_keyword = {one.column[0]: (subject, one) for subject, one in table.columns.items()}
    items: list[Entry | Refusal] = []
    for number, cells in rows:
        if isinstance(cells, str):
            items.append(Refusal(cells, number))
            continue
        keyword, _, rest = ",".join(cells).partition("=")
        words = rest.split()
        if keyword.strip() not in by_keyword:
            continue
        if len(words) != 2:
            items.append(Refusal(f"{keyword.strip()}: not a time and a number; found {shown(rest.strip())}", number))
            continue
        subject, column = by_keyword[keyword.strip()]
        try:
            moment = _moment(table, words[0])
        except Problem as problem:
            items.append(Refusal(one_line(problem), number))
            continue
        items.append(_tried(_reading, table, history, subject, column, [words[1]], moment, number))
    return items


def _tried(make: Callable[..., Entry], *of: Any) -> Entry | Refusal:
    """Return an entry, or why there is none; the last argument is its line."""
    try:
        return make(*of)
    except Problem as problem:
        return Refusal(one_line(problem), of[-1])


def _moment(table: ReadingTableSpec, text: str) -> int:
    """Time of a row. Raises Problem."""
    if table.epoch is None:
        return micros(text, table.time_scale)
    return micros_after(table.epoch, table.time_scale, parse_quantity(f"{text} {table.time_unit}", MOMENT))


def _reading(
    table: ReadingTableSpec,
    history: History,
    subject: str,
    column: ReadingColumnSpec,
    cells: Sequence[str],
    moment: int,
    line: int,
) -> Entry:
    """One reading in SI units. Raises Problem: no number, or one that such a body cannot have."""
    kind, of_sigma = VALUES[table.kind]
    sigma = parse_quantity(column.sigma, of_sigma)
    unit = QUATERNION if column.unit == QUATERNION else kind.si
    if unit == QUATERNION:
        values = [_number(cell) for cell in cells]
        length = math.hypot(*values)
        if not abs(length - 1.0) <= UNIT:
            allowed = f"1 within {UNIT:g}; the scalar last"
            raise Problem(f"{subject}: not a quaternion of a turn", f"length {length:.6g}", allowed)
        values = [value / length for value in values]
    else:
        values = [parse_quantity(f"{cell} {column.unit}", kind) for cell in cells]
    if table.kind == "temperature":
        _is_warm_enough(subject, values[0], column.unit, history)
    return Entry(table.kind, subject, moment, {"values": values, "sigma": sigma, "unit": unit}, line)


def _number(cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise Problem("not a number", shown(cell), "a number") from None
    if not math.isfinite(value):
        raise Problem("not a finite number", shown(cell), "a number")
    return value


def _is_warm_enough(subject: str, kelvin: float, unit: str, history: History) -> None:
    """Refuse a temperature that is none of this instrument, as of a column in another unit. Raises Problem."""
    off = kelvin - history.temperature
    if abs(off) <= WITHIN:
        return
    meant = {"K": (273.15, "degC"), "degC": (-273.15, "K"), "celsius": (-273.15, "K"), "°C": (-273.15, "K")}.get(unit)
    fits = meant is not None and abs(off + meant[0]) <= WITHIN
    remedy = f"the column is in {meant[1]}, it seems: unit: {meant[1]}" if fits and meant else "the unit of the column"
    raise Problem(
        f"{subject}: {kelvin:.6g} K is {abs(off):.4g} K from the instrument's {history.temperature:.6g} K",
        None,
        f"at most {WITHIN:g} K from it; {remedy}",
    )


def _event(table: ReadingTableSpec, row: dict[str, str], moment: int, line: int) -> Entry:
    """One event. Raises Problem: of a name that is not known."""
    found = row[str(table.name)]
    name = table.events.get(found, found)
    if name not in EVENTS:
        known = (*table.events, *EVENTS)
        raise unknown(
            "unknown event", found, known, allowed=f"{names_text(known)}; others stand in events: NAME: EVENT"
        )
    detail: dict[str, Any] = {} if table.detail is None else {"detail": row[table.detail]}
    return Entry(EVENT, name, moment, detail, line)


SETTLED = 2.0
"""Seconds for which a file has not changed before a watching command reads it: it may still be written."""

_TIME = re.compile(r"(\d{4})-?(\d{2})-?(\d{2})T(\d{2})[:-]?(\d{2})[:-]?(\d{2}(?:\.\d+)?)Z")
_YAML = (".yaml", ".yml")
State = tuple[int, ...]


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

    Attributes
    ----------
    places : Sequence[Path]
        YAML files, run folders, folders with some of these.
    moment : int | None
        Of a run folder that is named itself, microseconds; None where its name says it.
    stated : bool
        Whether run folders that do not say it are of the record's instrument.
    watching : bool
        Whether it is looked at more than once, and then only what has changed since is read.
    seen : dict[str, State]
        Path -> how it was when it was read.
    """

    places: Sequence[Path]
    moment: int | None
    stated: bool
    watching: bool = False
    seen: dict[str, State] = field(default_factory=dict)

    def look(self, history: History) -> Iterator[FileContent]:
        """What they hold now; of what is watched only what has changed since the last look.

        Raises
        ------
        InputErrorText
            Nothing is there, or a run folder that was named has no time.
        InputError
            a YAML file is not valid.
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

    def _tables(self, file: Path, history: History, named: set[Path]) -> Iterator[FileContent]:
        """What the tables hold that a YAML file describes; the run folders that they name are added to ``named``."""
        spec = read_telemetry(file, history)
        for table in spec.readings:
            for path in tables_of(spec, table):
                own = _runs_named(table, path) if table.kind in RUNS else []
                named |= {one.resolve() for one in own}
                if not self._is_seen(path, own):
                    yield read_table_file(table, path, history)

    def _run(self, place: Path, moment: int | None, history: History) -> Iterator[FileContent]:
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
            yield FileContent(str(folder), digest_of_data(str(folder)), "", [Refusal(f"{folder.name}: {reason}")], {})
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
