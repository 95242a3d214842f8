"""Readings and events of an instrument's tables, row by row; a row that cannot be true is refused with its reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from scenes.specs.operation import EVENT, EVENTS, QUATERNION, VALUES, ReadingColumnSpec, ReadingTableSpec, TelemetrySpec
from scenes.specs.resolved import resolve_on
from scenes.yaml.csv_table import rows_apart
from scenes.yaml.errors import InputError, Issue, Problem, names_text, nearest, shown, unknown
from scenes.yaml.input_file import digest_of
from scenes.yaml.spec import validate
from scenes.yaml.units import MOMENT, parse_quantity
from scenes.yaml.yaml_file import read_yaml
from twin.operate.record.entries import (
    Entry,
    Given,
    Refused,
    digest_of_data,
    digest_of_job,
    micros,
    micros_after,
    one_line,
)
from twin.operate.record.history import History
from twin.operate.record.run_readings import run_entries

LARGEST = 1 << 28
"""Bytes of a table."""
WITHIN = 100.0
"""A body's temperature departs from the instrument's by less, kelvin; so does a change in a job that has no sign."""
UNIT = 1e-3
"""By how much the length of a quaternion may differ from 1."""


def read_telemetry(path: Path, history: History) -> TelemetrySpec:
    """What tables hold, as a file says.

    Raises:
        InputError: it cannot be read, is not valid, or is of another instrument than the record.
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

    Raises:
        InputError: not the name of files.
    """
    folder = Path(spec.source.file).parent
    try:
        return sorted(path.absolute() for path in folder.glob(table.files) if path.is_file())
    except (ValueError, NotImplementedError):
        problem, allowed = "not the name of files", "a path relative to this file, with * and ? for any letters"
        raise table.error(problem, ("files",), found=table.files, allowed=allowed) from None


def read_table_file(table: ReadingTableSpec, path: Path, history: History) -> Given:
    """What one table holds; one that cannot be read is refused as a whole."""
    try:
        digest = digest_of(path)
        items, frames = _items(table, path, history)
    except InputError as error:
        items, frames = [Refused(one_line(one), one.line) for one in error.issues], {}
    except OSError as error:
        digest, items, frames = digest_of_data(str(path)), [Refused(f"cannot be read: {error.strerror}")], {}
    return Given(str(path), digest, digest_of_data(table.plain()), items, frames)


def _items(table: ReadingTableSpec, path: Path, history: History) -> tuple[list[Entry | Refused], dict[str, str]]:
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
    items: list[Entry | Refused] = []
    for number, cells in rows[1:]:
        if isinstance(cells, str):
            items.append(Refused(cells, number))
            continue
        if len(cells) != len(heads):
            items.append(Refused(f"{len(cells)} cells under {len(heads)} heads", number))
            continue
        row = {head: cells[k].strip() for head, k in place.items()}
        try:
            moment = _moment(table, row[table.time])
        except Problem as problem:
            items.append(Refused(f"{table.time}: {one_line(problem)}", number))
            continue
        if table.kind in VALUES:
            items += _values(table, row, moment, number, history)
        elif table.kind == EVENT:
            items.append(_told(partial(_event, table, row, moment, number), number))
        else:
            found = run_entries(path.parent / row[str(table.name)], table.kind, moment, history, stated=True)
            frames |= found.frames
            items += [replace(one, line=number) for one in found.items]
    return items, frames


def _keyword_items(
    table: ReadingTableSpec, rows: Sequence[tuple[int, list[str] | str]], history: History
) -> list[Entry | Refused]:
    """Lines of ``KEYWORD = TIME NUMBER``; other keywords, and lines without a number after a time, are not readings."""
    by_keyword = {one.column[0]: (subject, one) for subject, one in table.columns.items()}
    items: list[Entry | Refused] = []
    for number, cells in rows:
        if isinstance(cells, str):
            items.append(Refused(cells, number))
            continue
        keyword, _, rest = ",".join(cells).partition("=")
        words = rest.split()
        if keyword.strip() not in by_keyword:
            continue
        if len(words) != 2:
            items.append(Refused(f"{keyword.strip()}: not a time and a number; found {shown(rest.strip())}", number))
            continue
        subject, column = by_keyword[keyword.strip()]
        try:
            moment = _moment(table, words[0])
        except Problem as problem:
            items.append(Refused(one_line(problem), number))
            continue
        items.append(_told(partial(_reading, table, subject, column, [words[1]], moment, number, history), number))
    return items


def _told(make: Callable[[], Entry], line: int) -> Entry | Refused:
    try:
        return make()
    except Problem as problem:
        return Refused(one_line(problem), line)


def _moment(table: ReadingTableSpec, text: str) -> int:
    """Time of a row. Raises Problem."""
    if table.epoch is None:
        return micros(text, table.time_scale)
    return micros_after(table.epoch, table.time_scale, parse_quantity(f"{text} {table.time_unit}", MOMENT))


def _values(
    table: ReadingTableSpec, row: dict[str, str], moment: int, line: int, history: History
) -> list[Entry | Refused]:
    """What a row says of each body; cells that are empty say nothing."""
    items: list[Entry | Refused] = []
    for subject, column in table.columns.items():
        cells = [row[head] for head in column.column]
        if any(cells):
            items.append(_told(partial(_reading, table, subject, column, cells, moment, line, history), line))
    return items


def _reading(
    table: ReadingTableSpec,
    subject: str,
    column: ReadingColumnSpec,
    cells: Sequence[str],
    moment: int,
    line: int,
    history: History,
) -> Entry:
    """One reading in SI units. Raises Problem: no number, or one that such a body cannot have."""
    kind, of_sigma = VALUES[table.kind]
    sigma = parse_quantity(column.sigma, of_sigma)
    if column.unit == QUATERNION:
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
    return Entry(table.kind, subject, moment, {"values": values, "sigma": sigma, "unit": _si(column, kind.si)}, line)


def _si(column: ReadingColumnSpec, si: str) -> str:
    return QUATERNION if column.unit == QUATERNION else si


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
