"""``python -m twin.operate``: the record of one instrument through its life."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.yaml.errors import Problem, nearest
from scenes.yaml.standard_output import FAILURE, Terminal, print_error, print_json, to_stdout
from twin.run import durable
from twin.run.cli import (
    BAD_INPUT,
    INTERRUPTED,
    AsJson,
    InputErrorText,
    Quiet,
    explained,
    print_verdict,
    print_whole,
    result_table,
)

if TYPE_CHECKING:
    from twin.operate.entries import Given
    from twin.operate.history import History
    from twin.operate.taking import Taken

POLL = 10.0
"""Seconds between two looks at what is watched."""
SETTLED = 2.0
"""Seconds for which a file has not changed before a watching command reads it: it may still be written."""

app = typer.Typer(
    add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False, no_args_is_help=True
)
Place = Annotated[
    str,
    typer.Argument(
        metavar="DIR_OR_URL", help="Folder of the record, or address of a database: postgresql://host/name."
    ),
]


@app.callback()
def main() -> None:
    """Keep the record of one instrument in operation: every reading and every event, with its file, its sigma and its
    time. Nothing in it is ever altered, and a reading that is taken twice is recognised.

    For example:

        python -m twin.operate init record gf7_pair
        python -m twin.operate ingest record scenes/examples/telemetry.yaml
        python -m twin.operate status record

    Exit codes: 0 success, 2 bad input or readings that were refused, 1 anything else.
    """


@contextmanager
def _told() -> Iterator[Console]:
    """Errors as one sentence and an exit code."""
    from twin.operate.database import RecordFailed
    from twin.operate.schema import NotARecord

    errors = Console(stderr=True)
    with explained(errors):
        try:
            yield errors
        except NotARecord as error:
            raise InputErrorText(str(error)) from None
        except RecordFailed as error:
            print_error(errors, f"the database cannot do it: {error}; what was not told as taken is not in the record")
            raise typer.Exit(FAILURE) from None


def _tell(errors: Console, as_json: bool, quiet: bool, data: Any, show: Callable[[Console], None]) -> None:
    with to_stdout(errors, "the record is as it was told"):
        if as_json:
            print_json(data)
        elif not quiet:
            show(Terminal())


def _plain(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


@app.command("init")
def init(
    record: Place,
    instrument: Annotated[str, typer.Argument(help="Name of an instrument in the library, or path of its file.")],
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Readings are simulated: their times may be still to come.")
    ] = False,
    plan: Annotated[
        Path | None,
        typer.Option(readable=False, help="Plan of operation that counts from now on; `status` and `forecast` use it."),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Make the record of an instrument, or bring one that an earlier program made up to this one.

    The record states the content of the instrument's file and its cameras' by a hash: readings of another instrument
    are refused. It keeps every plan of operation; the newest counts.

    For example:

        python -m twin.operate init record gf7_pair
        python -m twin.operate init record gf7_pair --plan scenes/examples/operation.yaml

    Exit codes: 0 success, 2 bad input, 1 anything else.
    """
    from scenes.specs.operation import read_operation
    from scenes.specs.resolved import resolve_with
    from twin.operate.history import History, initialised
    from twin.operate.plans import keep_plan, read_plan

    with _told() as errors:
        if plan is not None:  # a mistake in it is told before anything is made
            read_operation(plan)
        passed = initialised(record, resolve_with(instrument), simulated)
        with History(record) as history:
            kept = plan is not None and keep_plan(read_plan(plan, history), plan, history)
            what = f"version {', '.join(map(str, passed))}" if passed else "as it was"
            what += "" if plan is None else f"; the plan {plan} counts" if kept else f"; the plan {plan} counted before"
            text = f"record of {history.name} ({history.sha256[:12]}) in {history.url}: {what}"
            data: dict[str, Any] = {"record": history.url, "instrument": history.name}
            data["instrument_sha256"] = history.sha256
        data |= {"versions": list(passed), "plan": None if plan is None else str(plan.absolute()), "new_plan": kept}
        _tell(errors, as_json, quiet, data, lambda console: _plain(console, text))


@app.command("ingest")
def ingest(
    record: Place,
    files: Annotated[
        list[Path],
        typer.Argument(
            readable=False,
            help="YAML files that say what tables hold, folders with such files, or run folders (with --time).",
        ),
    ],
    moment: Annotated[
        str | None, typer.Option("--time", help="UTC of a run folder's reading, or of 0 s of its series.")
    ] = None,
    instrument: Annotated[
        str | None, typer.Option(help="Instrument of run folders that do not say it, such as those of twin.orbit.")
    ] = None,
    late: Annotated[
        bool, typer.Option("--late", help="Take readings that are older than the newest of their sort.")
    ] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Go on looking for new tables, until Ctrl-C.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Take readings and events into a record: from tables, as a YAML file says what their columns are, and from run
    folders of twin.recover, twin.render and twin.orbit.

    A file is taken in one step. What is in the record already is told and not doubled. What cannot be true is refused
    with its reason, which `status` shows: another instrument, a clock that runs backwards, a unit that does not fit, an
    unknown event.

    For example:

        python -m twin.operate ingest record scenes/examples/telemetry.yaml
        python -m twin.operate ingest record runs/recover-001 --time 2026-03-05T03:05:00Z

    Exit codes: 0 success, 2 bad input or something was refused (all else is taken), 1 anything else.
    """
    from twin.operate.history import History

    with _told() as errors, durable.exit_on_terminate(), History(record) as history:
        start = _moment(moment)
        stated = _is_stated(instrument, history)
        seen: dict[str, tuple[int, int]] = {}
        totals, told, first = Counter({"new": 0, "known": 0, "refused": 0}), [], ""
        try:
            while True:
                for given in _given(files, start, stated, history, seen if watch else None):
                    taken = history.take(given, late)
                    totals.update(new=taken.new, known=taken.known, refused=len(taken.refused))
                    first = first or (f"{taken.file}: {taken.refused[0][1]}" if taken.refused else "")
                    if watch or not as_json:
                        _tell(errors, as_json, quiet, _taken(taken), partial(_plain, text=_line(taken)))
                    else:
                        told.append(_taken(taken))
                if not watch:
                    break
                time.sleep(POLL)
        except KeyboardInterrupt:
            if not watch:  # a watching command has no other end
                print_error(errors, "interrupted: the files that were told are in the record, the others are not")
                raise typer.Exit(INTERRUPTED) from None
        text = f"{totals['new']} taken, {totals['known']} known already, {totals['refused']} refused"
        _tell(errors, as_json, quiet, {**totals, "files": told}, partial(print_verdict, verdict=text))
        if totals["refused"]:
            if quiet or as_json:
                print_error(errors, f"{totals['refused']} refused, the first in {first}")
            raise typer.Exit(BAD_INPUT)


def _moment(text: str | None) -> int | None:
    from twin.operate.entries import micros, one_line

    if text is None:
        return None
    try:
        return micros(text)
    except Problem as problem:
        raise InputErrorText(f"--time: {one_line(problem)}") from None


def _is_stated(instrument: str | None, history: History) -> bool:
    """Whether run folders are said to be of the record's instrument. Raises InputErrorText: of another one."""
    from scenes.specs.resolved import resolve_with
    from twin.operate.entries import digest_of_job

    if instrument is None:
        return False
    digest = digest_of_job(resolve_with(instrument))
    if digest != history.sha256:
        own = f"{history.name} ({history.sha256[:12]})"
        raise InputErrorText(f"--instrument: the record is of {own}, not of {instrument} ({digest[:12]})")
    return True


def _given(
    files: list[Path], moment: int | None, stated: bool, history: History, seen: dict[str, tuple[int, int]] | None
) -> Iterator[Given]:
    """What the files that were named hold now; of what is watched only what has changed since it was seen."""
    from twin.operate.run_readings import run_entries
    from twin.operate.telemetry import read_table_file, read_telemetry, tables_of
    from twin.run.run_folder import is_run_folder

    for place in files:
        if is_run_folder(place if place.is_dir() else place.parent) and place.suffix not in (".yaml", ".yml"):
            if moment is None:
                raise InputErrorText(f"{place}: a run folder does not say when it was read; --time UTC does")
            if seen is None or not _is_seen(place, seen):
                yield run_entries(place, "", moment, history, stated)
            continue
        described = sorted(place.glob("*.yaml")) if place.is_dir() else [place]
        if not described:
            raise InputErrorText(f"{place}: neither a run folder nor one with a YAML file that says what tables hold")
        for file in described:
            spec = read_telemetry(file, history)
            for table in spec.readings:
                for path in tables_of(spec, table):
                    if seen is None or not _is_seen(path, seen):
                        yield read_table_file(table, path, history)


def _is_seen(path: Path, seen: dict[str, tuple[int, int]]) -> bool:
    """Whether a file is as it was when it was read, or may still be written."""
    state = path.stat()
    now = (state.st_mtime_ns, state.st_size)
    if seen.get(str(path)) == now or time.time() - state.st_mtime < SETTLED:
        return True
    seen[str(path)] = now
    return False


def _line(taken: Taken) -> str:
    lines = [f"{taken.file}: {taken.new} taken, {taken.known} known already, {len(taken.refused)} refused"]
    shown = [f"  refused{'' if line is None else f', line {line}'}: {reason}" for line, reason in taken.refused[:10]]
    more = len(taken.refused) - len(shown)
    return "\n".join([*lines, *shown, *([f"  and {more} more; status shows all"] if more else [])])


def _taken(one: Taken) -> dict[str, Any]:
    refused = [{"line": line, "reason": reason} for line, reason in one.refused]
    return {"file": one.file, "new": one.new, "known": one.known, "refused": refused, "before": one.before}


@app.command("status")
def status(record: Place, as_json: AsJson = False, quiet: Quiet = False) -> None:
    """Tell what a record holds: readings by sort and body with their first and last time, and what was refused and why.

    Example: `python -m twin.operate status record`

    Exit codes: 0 success, 2 bad input, 1 anything else.
    """
    from twin.operate.history import History

    with _told() as errors, History(record) as history:
        data = history.status()
        _tell(errors, as_json, quiet, data, lambda console: _show(data, console))


def _show(data: dict[str, Any], console: Console) -> None:
    name, entries, opened = data["instrument"], data["entries"], data["open"]
    print_verdict(
        console, f"{name}: {entries} readings and events of {data['files']} files; {opened} refused and not taken"
    )
    if not data["guarded"]:
        _plain(console, "warning: this kind of database does not itself refuse to alter rows; only the program does")
    table = result_table()
    for head in ("kind", "of", "entries", "first [UTC]", "last [UTC]"):
        table.add_column(head, justify="right" if head == "entries" else "left")
    for one in data["streams"]:
        table.add_row(one["kind"], one["subject"], str(one["entries"]), one["first_utc"], one["last_utc"])
    print_whole(console, table)
    for one in data["refused"]:
        line = "" if one["line"] is None else f":{one['line']}"
        since = " (taken since)" if one["taken_since"] else ""
        _plain(console, f"refused{since}: {one['file']}{line}: {one['reason']}")


@app.command("export")
def export(
    record: Place,
    tables: Annotated[str, typer.Option(help="Format of the tables: csv, parquet or fits.")] = "csv",
    out: Annotated[Path, typer.Option(readable=False, help="Folder for them; it must not be there yet.")] = Path(
        "tables"
    ),
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a record as tables that other programs read, one for each sort of reading; every column says its unit.

    Example: `python -m twin.operate export record --tables parquet --out record-tables`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    from twin.operate.history import History
    from twin.operate.record_tables import tables as all_tables
    from twin.run.data_files import TABLE_FORMATS, MissingPackage

    with _told() as errors, History(record) as history:
        if tables not in TABLE_FORMATS:
            near = nearest(tables, TABLE_FORMATS)
            meant = f"; did you mean {near!r}?" if near else ";"
            raise InputErrorText(f"--tables: no such format, {tables!r}{meant} allowed: {', '.join(TABLE_FORMATS)}")
        if out.exists():
            raise InputErrorText(f"--out: {out} is there already; name a folder that is not")
        try:
            made = [(f"{one.name}.{tables}", TABLE_FORMATS[tables](one), one.rows) for one in all_tables(history)]
            durable.make_folders(out)
            durable.write_all_safely((out / name, content) for name, content, _ in made)
        except MissingPackage as error:
            raise InputErrorText(str(error)) from None
        except OSError as error:
            print_error(errors, f"{out}: {error.strerror or error}; what is there is not all of the record")
            raise typer.Exit(FAILURE) from None
        data = {"out": str(out), "tables": [{"file": name, "rows": rows} for name, _, rows in made]}
        text = "\n".join(f"{out / name}: {rows} rows" for name, _, rows in made)
        _tell(errors, as_json, quiet, data, lambda console: _plain(console, text or "the record is empty"))


if __name__ == "__main__":
    app()
