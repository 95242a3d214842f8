"""Command line of ``python -m twin.operate``: record and estimated state of an instrument in operation."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import time
from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.yaml.errors import InputError
from scenes.yaml.standard_output import BAD_INPUT, print_error
from twin.framework import cli, durable
from twin.framework.cli import InputErrorText, print_verdict
from twin.operate.estimate_commands import (
    alarms,
    exclude,
    forecast,
    products,
    report,
    show_estimate,
    show_headline,
    show_power,
    write_report,
)
from twin.operate.life_commands import judge, simulate
from twin.operate.terminal import (
    Call,
    NewFolder,
    PlanFile,
    RecordLocation,
    errors_reported,
    json_and_quiet,
    on_record,
    print_line,
    print_result,
    show_table,
    utc_option,
)

if TYPE_CHECKING:
    from twin.operate.record.history import History
    from twin.operate.record.ingest import IngestResult

POLL = 10.0
"""Time between two checks of watched files for new readings, in seconds."""

app = cli.program(no_args_is_help=True)


@app.callback()
def main() -> None:
    """Keep the record of one instrument in operation: every reading and event, with its file, sigma and time.

    Entries are never altered, and a reading that is ingested twice is recognised.

    For example:

        python -m twin.operate init record gf7_pair
        python -m twin.operate ingest record scenes/examples/telemetry.yaml
        python -m twin.operate status record

    Exit codes: 0 success, 2 bad input or readings that were refused, 1 anything else.
    """


@app.command()
@json_and_quiet
def init(
    record: RecordLocation,
    options: cli.Options,
    instrument: Annotated[str, typer.Argument(help="Name of an instrument in the library, or path of its file.")],
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Readings are simulated: their times may be in the future.")
    ] = False,
    plan: Annotated[
        Path | None,
        typer.Option(readable=False, help="Plan of operation, in force from now on; `status` and `forecast` use it."),
    ] = None,
) -> None:
    """Create the record of an instrument, or update one of an earlier version of the program.

    The record identifies the instrument by a hash of its file and its cameras' files: readings of another instrument
    are refused. It stores every plan of operation; the newest is in force.

    For example:

        python -m twin.operate init record gf7_pair
        python -m twin.operate init record gf7_pair --plan scenes/examples/operation.yaml

    Exit codes: 0 success, 2 bad input, 1 anything else.
    """
    from scenes.specs.operation import read_operation
    from scenes.specs.resolved import resolve_with
    from twin.operate.estimate.operation_model import read_plan, store_plan
    from twin.operate.record.history import History, initialise_record

    with errors_reported() as errors:
        if plan is not None:  # report errors of the plan before the record is created
            read_operation(plan)
        passed = initialise_record(record, resolve_with(instrument), simulated)
        with History(record) as history:
            kept = plan is not None and store_plan(read_plan(plan, history), plan, history)
            what = f"version {', '.join(map(str, passed))}" if passed else "unchanged"
            what += "" if plan is None else f"; new plan {plan}" if kept else f"; the plan {plan} was in force already"
            text = f"record of {history.name} ({history.sha256[:12]}) in {history.url}: {what}"
            data = {"record": history.url, "instrument": history.name, "instrument_sha256": history.sha256}
            made = {"versions": list(passed), "plan": None if plan is None else str(plan.absolute()), "new_plan": kept}
        print_result(errors, options, data | made, lambda console: print_line(console, text))


@app.command()
@on_record
def ingest(
    call: Call,
    files: Annotated[
        list[Path],
        typer.Argument(
            readable=False, help="YAML files that describe tables, run folders, or folders with some of these."
        ),
    ],
    moment: Annotated[
        str | None,
        typer.Option(
            "--time", help="UTC of a run folder's reading, or of 0 s of its series, if its name does not contain it."
        ),
    ] = None,
    instrument: Annotated[
        str | None, typer.Option(help="Instrument of run folders that do not name it, such as those of twin.orbit.")
    ] = None,
    late: Annotated[
        bool, typer.Option("--late", help="Accept readings that are older than the newest of their kind.")
    ] = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Keep polling for new tables and run folders, until Ctrl-C.")
    ] = False,
    page: Annotated[
        Path | None,
        typer.Option(
            "--report",
            metavar="FILE.html",
            readable=False,
            help="Write the daily report to this file, and again after every ingest.",
        ),
    ] = None,
) -> None:
    """Ingest readings and events into a record.

    They come from tables, whose columns a YAML file describes, and from run folders of twin.recover, twin.render and
    twin.orbit. A file is ingested in one step. Entries that the record has already are reported and not doubled.
    Readings that cannot be true are refused with a reason, which `status` shows: another instrument, a clock that runs
    backwards, a wrong unit, an unknown event. A refusal counts once, also if the file is read again after it has
    grown. With --watch and --report the daily report is always as new as the record.

    For example:

        python -m twin.operate ingest record scenes/examples/telemetry.yaml
        python -m twin.operate ingest record runs/recover-001 --time 2026-03-05T03:05:00Z
        python -m twin.operate ingest record downlink --watch --report report.html

    Exit codes: 0 success, 2 bad input or something was refused (all else is ingested), 1 anything else.
    """
    from twin.operate.record.telemetry import Sources

    listed = call.options.as_json and not watch
    with durable.exit_on_terminate():
        start = None if moment is None else utc_option("--time", moment)
        if page is not None:
            call.resolve_plan(None)
        sources = Sources(files, start, _names_instrument_of_record(instrument, call.history), watch)
        totals, files_reported, first = Counter({"new": 0, "known": 0, "refused": 0, "refused_before": 0}), [], ""
        raised: list[str] = []
        stale = page is not None
        try:
            while True:
                before = totals["new"]
                for content in sources.poll(call.history):
                    taken = call.history.ingest(content, late)
                    totals.update(taken.counts)
                    first = first or (f"{taken.file}: {taken.refused[0][1]}" if taken.refused else "")
                    if listed:
                        files_reported.append(_taken(taken))
                    else:
                        call.print_result(_taken(taken), partial(print_line, text=_line(taken)))
                if totals["new"] > before or stale:
                    new, stale = _new_alarms(call, page), False
                    raised += new
                    if new and not listed:
                        call.print_result({"alarms": new}, partial(print_line, text="\n".join(new)))
                if not watch:
                    break
                time.sleep(POLL)
        except KeyboardInterrupt:
            if not watch:  # Ctrl-C is the normal end of a watching command
                print_error(call.errors, "interrupted: the files reported above are in the record, the others are not")
                raise typer.Exit(cli.INTERRUPTED) from None
        done = {**totals, "files": files_reported, "alarms": raised}
        call.print_result(done, partial(print_verdict, verdict=_counted(totals)))
        if refused := totals["refused"] + totals["refused_before"]:
            if call.options.silent:
                print_error(call.errors, f"{refused} refused, the first in {first}")
            raise typer.Exit(BAD_INPUT)


def _new_alarms(call: Call, page: Path | None) -> list[str]:
    """Return the new alarms of the estimate under the record's plan, and write the report.

    If the estimate fails, its error is printed; the readings have been ingested nevertheless.
    """
    if not call.has_estimate:
        if page is not None:
            print_error(call.errors, f"no report: the record has no reading of the {call.reading_kind}")
        return []
    try:
        operation, _, new = call.estimate()
    except (InputErrorText, InputError) as error:
        print_error(call.errors, f"the readings are in the record, but the estimate cannot be computed: {error}")
        return []
    if page is not None:
        from twin.operate.daily_report import end_of_day
        from twin.operate.overview import reading_span

        write_report(
            call,
            call.history,
            operation,
            end_of_day(None, reading_span(call.history, call.reading_kind)[1]),
            [call.location],
            page,
        )
    return [f"alarm: {alarm.text}" for alarm in new]


def _names_instrument_of_record(instrument: str | None, history: History) -> bool:
    """Return whether --instrument names the record's instrument. Raise InputErrorText if it names another one."""
    from scenes.specs.resolved import resolve_with
    from twin.operate.record.entries import digest_of_job

    if instrument is None:
        return False
    digest = digest_of_job(resolve_with(instrument))
    if digest != history.sha256:
        expected = f"{history.name} ({history.sha256[:12]})"
        raise InputErrorText(f"--instrument: the record is of {expected}, not of {instrument} ({digest[:12]})")
    return True


def _counted(counts: Mapping[str, int]) -> str:
    """Return a text with the numbers of new, already known and refused entries."""
    text = "{new} taken, {known} known already, {refused} refused".format(**counts)
    return text + (f", {before} refused before" if (before := counts["refused_before"]) else "")


def _line(taken: IngestResult) -> str:
    """Return a text on the result of ingesting a file, with its first refusals."""
    lines = [f"{taken.file}: {_counted(taken.counts)}"]
    shown = [f"  refused{'' if line is None else f', line {line}'}: {reason}" for line, reason in taken.refused[:10]]
    more = len(taken.refused) - len(shown)
    return "\n".join([*lines, *shown, *([f"  and {more} more; status shows all"] if more else [])])


def _taken(taken: IngestResult) -> dict[str, Any]:
    """Return the result of ingesting a file as plain data, for JSON output."""
    refused = [{"line": line, "reason": reason} for line, reason in taken.refused]
    return {"file": taken.file, **taken.counts, "refused": refused, "before": taken.before}


@app.command()
@on_record
def status(
    call: Call,
    plan: PlanFile = None,
    check_all: Annotated[
        bool, typer.Option("--check-all", help="Check the digests of all entries, instead of the newest 500.")
    ] = False,
    strict: cli.Strict = False,
) -> None:
    """Show the contents of a record, its refusals, and the estimated state of the instrument.

    The estimate, under the record's plan of operation or another one, has every quantity with its sigma, requirements,
    jumps, sensors, and the quality of the predictions. New conditions that somebody has to know raise an alarm
    (python -m twin.operate alarms). Warnings name entries that were altered, and a protection that was removed.

    Example: `python -m twin.operate status record scenes/examples/operation.yaml`

    Exit codes: 0 success, whether alarms are open or not, 2 bad input, 3 with --strict if the latest readings
    contradict the prior, 1 anything else.
    """
    estimate_of_record = call.estimate(plan) if plan is not None or call.has_estimate else None
    rows = call.history.alarms()
    opened = sum(row["acknowledged"] is None for row in rows)
    power = () if estimate_of_record is None else estimate_of_record[0].power()
    detection_power = {body_power.body: body_power.plain for body_power in power}
    estimate = (
        None if estimate_of_record is None else {**estimate_of_record[1].to_dict(), "detectable_jumps": detection_power}
    )
    contents = call.history.status(check_all)
    data = {**contents, "warnings": _record_warnings(contents), "estimate": estimate, "open_alarms": opened}

    def show(console: Console) -> None:
        if estimate_of_record is not None:
            show_headline(call.history, estimate_of_record[0], console)
        _show(data, console)
        if estimate_of_record is not None:
            show_estimate(estimate_of_record[1], rows, console)
        elif call.history.plan() is None:
            print_line(console, f"no estimate: {call.without_plan}")
        else:
            print_line(
                console,
                f"no estimate: the record has no reading of the {call.reading_kind}; "
                "python -m twin.operate ingest adds readings",
            )
        if power:
            show_power(power, console)

    call.print_result(data, show)
    if strict:
        cli.end_strictly(call.errors, data)


def _record_warnings(held: dict[str, Any]) -> list[str]:
    """Return the warnings about altered entries and missing protection of the record."""
    out = [*held["altered"]]
    if not held["guarded"] and held["record"].startswith("sqlite"):
        out.append(
            "the triggers that protect the record were removed or changed; status --check-all checks all entries"
        )
    elif not held["guarded"]:
        out.append("this kind of database does not protect its rows; only the program refuses to alter them")
    return out


def _show(data: dict[str, Any], console: Console) -> None:
    """Print the contents of a record, its warnings and its refusals."""
    name, entries, opened = data["instrument"], data["entries"], data["open"]
    print_verdict(console, f"{name}: {entries} readings and events from {data['files']} files; {opened} refused")
    for text in data["warnings"]:
        print_line(console, f"warning: {text}")
    rows = ([str(value) for value in row.values()] for row in data["streams"])
    show_table(console, ("kind", "subject", "entries", "first [UTC]", "last [UTC]"), rows, (2,))
    for row in data["refused"]:
        at = "" if row["line"] is None else f":{row['line']}"
        since = " (taken since)" if row["taken_since"] else ""
        print_line(console, f"refused{since}: {row['file']}{at}: {row['reason']}")


@app.command()
@on_record
def export(
    call: Call,
    tables: Annotated[str, typer.Option(help="Format of the tables: csv, parquet or fits.")] = "csv",
    out: NewFolder = Path("tables"),
    force: cli.Force = False,
) -> None:
    """Write a record as tables for other programs, one for each kind of reading; column heads contain the units.

    Example: `python -m twin.operate export record --tables parquet --out record-tables`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    from twin.framework.data_files import TABLE_FORMATS, MissingPackage
    from twin.framework.run_folder import RunFolder
    from twin.operate.record.record_tables import tables as all_tables

    cli.require_one_of("--tables", tables, TABLE_FORMATS)
    folder = RunFolder(out, force)
    try:
        made = [
            (f"{table.name}.{tables}", TABLE_FORMATS[tables](table), table.rows) for table in all_tables(call.history)
        ]
    except MissingPackage as error:
        raise InputErrorText(str(error)) from None
    call.write_files(folder, {name: content for name, content, _ in made}, "export")
    data = {"out": str(out), "tables": [{"file": name, "rows": rows} for name, _, rows in made]}
    text = "\n".join(f"{out / name}: {rows} rows" for name, _, rows in made)
    call.print_result(data, lambda console: print_line(console, text or "the record is empty"))


for command in (forecast, alarms, exclude, products, simulate, judge, report):
    app.command()(command)


if __name__ == "__main__":
    app()
