"""Readings and events from tables, row by row, and from run folders.

Implausible readings are refused with a reason.
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
    MOVE,
    QUATERNION,
    RUNS,
    VALUES,
    ReadingColumnSpec,
    ReadingTableSpec,
    TelemetrySpec,
    value_kinds,
)
from scenes.specs.resolved import resolve_on
from scenes.yaml.csv_table import rows_apart
from scenes.yaml.errors import InputError, Issue, Problem, names_text, nearest, shown, unknown
from scenes.yaml.input_file import digest_of, is_file, parse_json, read_json
from scenes.yaml.spec import validate
from scenes.yaml.units import MOMENT, parse_quantity
from scenes.yaml.yaml_file import read_yaml
from twin.framework.cli import InputErrorText
from twin.framework.durable import MANIFEST
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
"""Kind of reading -> file of the run folder that holds it."""
_STATE_KEYS = (
    "cameras",
    "intersection_angle",
    "spots",
    "disturbances",
    "retraced",
    "sigma_holds",
    "centroid",
    "frames",
)
"""Keys of a monitor's result that belong to one state (one moment) of the instrument."""
_IMAGES = (".tiff", ".tif", ".fits", ".fit", ".fts", ".png")
CONFIG = "config.yaml"
LARGEST_READING = 4_000_000
"""Largest size of a stored reading, in characters."""


def kind_of_run(folder: Path) -> str:
    """Return the kind of reading that a run folder holds; empty if it holds none."""
    return next((kind for kind in RUNS if is_file(folder / RESULTS[kind])), "")


def run_entries(path: Path, kind: str, moment: int, history: History, assume_instrument: bool) -> FileContent:
    """Return the readings of a run folder; its errors are returned as a refusal.

    Parameters
    ----------
    path : Path
        Run folder, or the file of results in it.
    kind : str
        Kind of reading; empty for the one that the folder holds.
    moment : int
        Time of the reading, or of the beginning of a series, in microseconds of TAI since 2000.
    history : History
        Record of the instrument in operation.
    assume_instrument : bool
        True to assume that a run which does not name its instrument is of the record's instrument.
    """
    folder = path.parent if path.name in RESULTS.values() else path
    kind = kind or kind_of_run(folder)
    file = folder / RESULTS.get(kind, RESULTS["monitor"])
    manifest = read_manifest(folder)
    digest, frames = "", {}
    items: list[Entry | Refusal]
    try:
        if not kind or manifest is None or not is_file(file):
            allowed = f"a finished run folder with {names_text(RESULTS.values())}"
            raise Problem(f"no reading in {folder}", None, allowed)
        digest, frames = digest_of(file), _image_digests(manifest)
        _require_unchanged(folder, file, digest, manifest)
        _require_instrument(folder, history, assume_instrument and kind != "monitor")
        items = list(_run_readings(kind, read_json(file), moment, digest, frames))
    except (Problem, InputError) as error:
        items = [Refusal(one_line(error))]
    return FileContent(
        str(file), digest or digest_of_data(str(file)), digest_of_data([kind, moment, assume_instrument]), items, frames
    )


def _image_digests(manifest: Manifest) -> dict[str, str]:
    """Return the SHA-256 of the images that a run measured: those that it read, otherwise those that it wrote."""
    read = {name: digest for name, digest in manifest.inputs.items() if name.lower().endswith(_IMAGES)}
    digests = {name: digest for name, digest in manifest.sha256.items() if name.startswith("images/")}
    return read or {name: digest for name, digest in digests.items() if name.endswith((".tiff", ".fits"))}


def _require_unchanged(folder: Path, file: Path, digest: str, manifest: Manifest) -> None:
    """Raise Problem if the results of a run have been altered since it wrote them."""
    known = {file.name: digest}
    known |= {CONFIG: digest_of(folder / CONFIG)} if is_file(folder / CONFIG) else {}
    changed = [name for name, known_digest in known.items() if manifest.sha256.get(name) != known_digest]
    if changed:
        problem = f"{folder}: changed since its run: {names_text(changed)}"
        raise Problem(problem, None, "the folder as the run left it; python -m twin.verify lists the changes")


def _require_instrument(folder: Path, history: History, assume_instrument: bool) -> None:
    """Raise Problem or InputError if a run is of a different instrument, or does not name its instrument."""
    data = read_yaml(folder / CONFIG).data if is_file(folder / CONFIG) else None
    model = data.get("model", data) if isinstance(data, Mapping) else None
    instrument = model.get("instrument") if isinstance(model, Mapping) else None
    cameras = model.get("cameras") if isinstance(model, Mapping) else None
    if not isinstance(instrument, Mapping) or not isinstance(cameras, Mapping):
        if assume_instrument:
            return
        problem = f"{folder} does not name its instrument"
        raise Problem(problem, None, "a run whose config.yaml holds the instrument, or --instrument NAME")
    digest = instrument_digest(instrument, {k: v for k, v in cameras.items() if isinstance(v, Mapping)})
    if digest != history.sha256:
        name = instrument.get("name", "without a name")
        problem = f"{folder} is of another instrument, {name} ({digest[:12]})"
        raise Problem(problem, None, f"runs of {history.name} ({history.sha256[:12]})")


def _run_readings(kind: str, data: Any, start: int, digest: str, frames: Mapping[str, str]) -> list[Entry]:
    """Return the reading of a run, or those of a series. Raise Problem if the results are not valid."""
    if not isinstance(data, Mapping):
        raise Problem("no results", None, RESULTS[kind])
    origin = digest_of_data(sorted(frames.values())) if frames else digest
    if kind != "monitor":
        content = {key: value for key, value in data.items() if key != "reference_frames"}
        return [_entry(kind, start, {"sha256": digest, "numbers": content}, origin)]
    states, times = data.get("series") or [data], data.get("times_s") or [0.0]
    if not isinstance(states, list) or not isinstance(times, list) or len(states) != len(times):
        raise Problem("times and states differ in number", None, RESULTS[kind])
    out = []
    for k, (state, seconds) in enumerate(zip(states, times, strict=True)):
        if not isinstance(state, Mapping) or "cameras" not in state or not isinstance(seconds, int | float):
            raise Problem("a state without cameras or without a time", None, RESULTS[kind])
        numbers = {key: state[key] for key in _STATE_KEYS if key in state}
        content = {"sha256": digest, "state": k, "numbers": numbers}
        out.append(_entry(kind, start + round(seconds * MICRO), content, digest_of_data([origin, k])))
    return out


def _entry(kind: str, moment: int, content: Mapping[str, Any], origin: str) -> Entry:
    """Return a reading as an entry; raise Problem if it is too large or has numbers that a record cannot store."""
    try:
        text = canonical(content)
    except ValueError:
        raise Problem("a number that is not finite", None, "finite numbers") from None
    if len(text) > LARGEST_READING:
        raise Problem("too large", f"{len(text)} characters", f"at most {LARGEST_READING}")
    return Entry(kind, kind, moment, parse_json(text, "results"), None, origin)


LARGEST = 1 << 28
"""Largest size of a table, in bytes."""
MOST_DEPARTURE = 100.0
"""Largest plausible difference of a body's temperature from the instrument's, in kelvin.

It is also the limit for temperature changes in a job.
"""
QUATERNION_TOLERANCE = 1e-3
"""Largest difference between a quaternion's length and 1 with which it is accepted."""


def read_telemetry(path: Path, history: History) -> TelemetrySpec:
    """Read the description of tables from a file.

    Parameters
    ----------
    path : Path
        The YAML file.
    history : History
        Record; the tables must be for its instrument.

    Raises
    ------
    InputError
        The file cannot be read, is not valid, or is for a different instrument from the record's.
    """
    spec = validate(TelemetrySpec, read_yaml(path))
    digest = digest_of_job(resolve_on(spec, spec.instrument))
    if digest != history.sha256:
        problem = f"tables of another instrument than the record's ({digest[:12]}, not {history.sha256[:12]})"
        raise spec.error(problem, ("instrument",), value=spec.instrument, allowed=history.name)
    for k, table in enumerate(spec.readings):
        known = {"temperature": history.bodies["warm"], "focus": history.bodies["cameras"]}.get(table.kind)
        for subject in table.columns if known is not None else ():
            if subject not in (known or ()):
                what = "body with a temperature" if table.kind == "temperature" else "camera"
                raise spec.error(unknown(f"no such {what}", subject, known or ()), ("readings", k, "columns", subject))
    return spec


def tables_of(spec: TelemetrySpec, table: ReadingTableSpec) -> list[Path]:
    """Return the existing files of a table, sorted by name.

    Raises
    ------
    InputError
        The pattern does not name files.
    """
    folder = Path(spec.source.file).parent
    try:
        return sorted(path.absolute() for path in folder.glob(table.files) if path.is_file())
    except (ValueError, NotImplementedError):
        problem, allowed = "not the name of files", "a path relative to this file, with * and ? for any letters"
        raise table.error(problem, ("files",), value=table.files, allowed=allowed) from None


def read_table_file(table: ReadingTableSpec, path: Path, history: History) -> FileContent:
    """Return the content of one table; a table that cannot be read is refused as a whole."""
    try:
        digest = digest_of(path)
        items, frames = _items(table, path, history)
    except InputError as error:
        items, frames = [Refusal(one_line(issue), issue.line) for issue in error.issues], {}
    except OSError as error:
        digest, items, frames = digest_of_data(str(path)), [Refusal(f"cannot be read: {error.strerror}")], {}
    return FileContent(str(path), digest, digest_of_data(table.plain()), items, frames)


def _items(table: ReadingTableSpec, path: Path, history: History) -> tuple[list[Entry | Refusal], dict[str, str]]:
    """Return the entries and refusals of a table, and the images of the runs that it names."""
    rows = rows_apart(path, LARGEST)
    if not rows:
        raise InputError(Issue("an empty table", str(path), 1, allowed="a header row, and rows below it"))
    if table.form == "keywords":
        return _keyword_items(table, rows, history), {}
    frames: dict[str, str] = {}
    line, cells = rows[0]
    if isinstance(cells, str):
        raise InputError(Issue(cells, str(path), line, allowed="a header row, and rows below it"))
    heads = [head.strip() for head in cells]
    wanted = [table.time, *(head for column in table.columns.values() for head in column.column)]
    wanted += [head for head in (table.name, table.detail) if head is not None]
    for head in wanted:
        if heads.count(head) != 1:
            text = f"{'no' if head not in heads else 'more than one'} column {head!r}"
            raise InputError(Issue(text, str(path), line, (), names_text(heads), None, nearest(head, heads)))
    column_of = {head: heads.index(head) for head in wanted}
    items: list[Entry | Refusal] = []
    for number, cells in rows[1:]:
        if isinstance(cells, str):
            items.append(Refusal(cells, number))
            continue
        if len(cells) != len(heads):
            items.append(Refusal(f"{len(cells)} cells under {len(heads)} heads", number))
            continue
        row = {head: cells[k].strip() for head, k in column_of.items()}
        try:
            moment = _moment(table, row[table.time])
        except Problem as problem:
            items.append(Refusal(f"{table.time}: {one_line(problem)}", number))
            continue
        if table.kind in VALUES or table.kind == MOVE:
            read = (
                (subject, column, [row[head] for head in column.column]) for subject, column in table.columns.items()
            )
            # empty cells are not readings
            items += [
                _entry_or_refusal(_reading, table, history, *item, moment, number) for item in read if any(item[2])
            ]
        elif table.kind == EVENT:
            items.append(_entry_or_refusal(_event, table, row, moment, number))
        else:
            content = run_entries(
                path.parent / row[str(table.name)], table.kind, moment, history, assume_instrument=True
            )
            frames |= content.frames
            items += [replace(item, line=number) for item in content.items]
    return items, frames


def _keyword_items(
    table: ReadingTableSpec, rows: Sequence[tuple[int, list[str] | str]], history: History
) -> list[Entry | Refusal]:
    """Return the readings in lines of the form ``KEYWORD = TIME NUMBER``, or refusals.

    Other keywords are not readings.
    """
    by_keyword = {definition.column[0]: (subject, definition) for subject, definition in table.columns.items()}
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
        items.append(_entry_or_refusal(_reading, table, history, subject, column, [words[1]], moment, number))
    return items


def _entry_or_refusal(make: Callable[..., Entry], *of: Any) -> Entry | Refusal:
    """Return the entry that a function makes, or a refusal if it raises Problem; the last argument is the line."""
    try:
        return make(*of)
    except Problem as problem:
        return Refusal(one_line(problem), of[-1])


def _moment(table: ReadingTableSpec, text: str) -> int:
    """Return the time of a row. Raise Problem if it is not valid."""
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
    """Return one reading in SI units. Raise Problem if it is no number, or not plausible."""
    kind, sigma_kind = value_kinds(table.kind, subject)
    sigma = parse_quantity(column.sigma, sigma_kind)
    unit = QUATERNION if column.unit == QUATERNION else kind.si
    if unit == QUATERNION:
        values = [_number(cell) for cell in cells]
        length = math.hypot(*values)
        if not abs(length - 1.0) <= QUATERNION_TOLERANCE:
            allowed = f"1 within {QUATERNION_TOLERANCE:g}; the scalar last"
            raise Problem(f"{subject}: not a unit quaternion", f"length {length:.6g}", allowed)
        values = [value / length for value in values]
    else:
        values = [parse_quantity(f"{cell} {column.unit}", kind) for cell in cells]
    if table.kind == "temperature":
        _require_plausible(subject, values[0], column.unit, history)
    content = {"values": values, "sigma": sigma, "unit": unit}
    if table.kind == MOVE:
        content["time_sigma"] = table.time_sigma
    return Entry(table.kind, subject, moment, content, line)


def _number(cell: str) -> float:
    """Return a cell as a finite number. Raise Problem otherwise."""
    try:
        value = float(cell)
    except ValueError:
        raise Problem("not a number", shown(cell), "a number") from None
    if not math.isfinite(value):
        raise Problem("not a finite number", shown(cell), "a number")
    return value


def _require_plausible(subject: str, kelvin: float, unit: str, history: History) -> None:
    """Raise Problem for a temperature too far from the instrument's, such as of a column in a different unit."""
    off = kelvin - history.temperature
    if abs(off) <= MOST_DEPARTURE:
        return
    meant = {"K": (273.15, "degC"), "degC": (-273.15, "K"), "celsius": (-273.15, "K"), "°C": (-273.15, "K")}.get(unit)
    fits = meant is not None and abs(off + meant[0]) <= MOST_DEPARTURE
    remedy = f"the column is in {meant[1]}, it seems: unit: {meant[1]}" if fits and meant else "the unit of the column"
    raise Problem(
        f"{subject}: {kelvin:.6g} K is {abs(off):.4g} K from the instrument's {history.temperature:.6g} K",
        None,
        f"at most {MOST_DEPARTURE:g} K from it; {remedy}",
    )


def _event(table: ReadingTableSpec, row: dict[str, str], moment: int, line: int) -> Entry:
    """Return the event in a row of a table. Raise Problem if its name is unknown."""
    text = row[str(table.name)]
    name = table.events.get(text, text)
    if name not in EVENTS:
        known = (*table.events, *EVENTS)
        raise unknown(
            "unknown event", text, known, allowed=f"{names_text(known)}; map other names in events: NAME: EVENT"
        )
    detail: dict[str, Any] = {} if table.detail is None else {"detail": row[table.detail]}
    return Entry(EVENT, name, moment, detail, line)


SETTLED = 2.0
"""Time for which a file must be unchanged before a watching command reads it, in seconds.

A file that changed more recently may still be being written.
"""

_TIME = re.compile(r"(\d{4})-?(\d{2})-?(\d{2})T(\d{2})[:-]?(\d{2})[:-]?(\d{2}(?:\.\d+)?)Z")
_YAML = (".yaml", ".yml")
State = tuple[int, ...]


def time_of_name(name: str) -> int | None:
    """Return the UTC in the name of a run folder, in microseconds of TAI since 2000; None if it has none.

    Examples are ``recover-2026-03-05T03-05-00Z`` and ``20260305T030500Z``.
    """
    match = _TIME.search(name)
    if match is None:
        return None
    year, month, day, hour, minute, second = match.groups()
    try:
        return micros(f"{year}-{month}-{day}T{hour}:{minute}:{second}Z")
    except Problem:
        return None


@dataclass
class Sources:
    """Files and folders to ingest into a record.

    Attributes
    ----------
    paths : Sequence[Path]
        Paths of YAML files, run folders, and folders that contain such files and folders.
    moment : int | None
        Time of the run folders named directly, in microseconds of TAI since 2000; None if their names contain it.
    assume_instrument : bool
        True to assume that run folders which do not name their instrument are of the record's instrument.
    watching : bool
        True if the sources are checked repeatedly and only changed ones are read.
    seen : dict[str, State]
        Path -> modification time and size when it was read.
    """

    paths: Sequence[Path]
    moment: int | None
    assume_instrument: bool
    watching: bool = False
    seen: dict[str, State] = field(default_factory=dict)

    def poll(self, history: History) -> Iterator[FileContent]:
        """Yield the content of the files; of watched sources only of those changed since the last poll.

        Raises
        ------
        InputErrorText
            A path does not exist, or a named run folder has no time.
        InputError
            A YAML file is not valid.
        """
        for path in self.paths:
            if path.suffix not in _YAML and is_run_folder(path if path.is_dir() else path.parent):
                yield from self._run(path, self.moment, history)
                continue
            described = sorted(path.glob("*.yaml")) if path.is_dir() else [path]
            runs = sorted(filter(_may_be_read, path.iterdir())) if path.is_dir() else []
            if not described and not runs and not (self.watching and path.is_dir()):
                raise InputErrorText(
                    f"{path}: neither a run folder nor a folder with a YAML file that describes tables"
                )
            named: set[Path] = set()
            for file in described:
                yield from self._tables(file, history, named)
            for run in runs:
                if (run / MANIFEST).resolve() not in named:  # a table gives the times of the named ones
                    yield from self._run(run, None, history)

    def _tables(self, file: Path, history: History, named: set[Path]) -> Iterator[FileContent]:
        """Yield the content of the tables described by a YAML file; add the run folders that they name to ``named``."""
        spec = read_telemetry(file, history)
        for table in spec.readings:
            for path in tables_of(spec, table):
                runs = _runs_named(table, path) if table.kind in RUNS else []
                named |= {run.resolve() for run in runs}
                if not self._is_unchanged(path, runs):
                    yield read_table_file(table, path, history)

    def _run(self, path: Path, moment: int | None, history: History) -> Iterator[FileContent]:
        """Yield the readings of a run folder, unless it is unchanged since the last poll."""
        folder = path if path.is_dir() else path.parent
        moment = time_of_name(folder.name) if moment is None else moment
        if moment is None and path in self.paths:
            raise InputErrorText(f"{path}: the run folder has no time; give --time UTC, or put the UTC into its name")
        if self._is_unchanged(folder / MANIFEST):
            return
        if moment is None:
            reason = "the run folder has no time; put the UTC into its name: recover-2026-03-05T03-05-00Z"
            yield FileContent(str(folder), digest_of_data(str(folder)), "", [Refusal(f"{folder.name}: {reason}")], {})
        else:
            yield run_entries(path, "", moment, history, self.assume_instrument)

    def _is_unchanged(self, path: Path, named: Sequence[Path] = ()) -> bool:
        """Return whether a watched file, or a run folder it names, is unchanged or may still be written."""
        if not self.watching:
            return False
        states = [file.stat() for file in (path, *named)]
        now = tuple(number for state in states for number in (state.st_mtime_ns, state.st_size))
        if self.seen.get(str(path)) == now or any(time.time() - state.st_mtime < SETTLED for state in states):
            return True
        self.seen[str(path)] = now
        return False


def _may_be_read(folder: Path) -> bool:
    """Return whether a path is a run folder, and not one of products or tables of a record."""
    manifest = read_manifest(folder)
    return manifest is not None and (manifest.program, manifest.test) not in _WRITTEN


_WRITTEN = (("twin.operate", "products"), ("twin.operate", "export"))
"""Program and command whose folders hold no readings."""


def _runs_named(table: ReadingTableSpec, path: Path) -> list[Path]:
    """Return the paths of the manifests of the finished run folders that a table names."""
    try:
        heads, *rows = [cells for _, cells in rows_apart(path, LARGEST) if not isinstance(cells, str)]
        column = [head.strip() for head in heads].index(str(table.name))
    except (InputError, OSError, ValueError):
        return []
    named = (path.parent / cells[column].strip() / MANIFEST for cells in rows if len(cells) > column)
    return [run for run in named if is_file(run)]
