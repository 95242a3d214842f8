"""``python -m twin.operate``: the record of one instrument through its life."""

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
    show_power,
    write_report,
)
from twin.operate.life_commands import judge, simulate
from twin.operate.terminal import (
    Call,
    NewFolder,
    Place,
    PlanFile,
    json_and_quiet,
    line,
    on_record,
    require_new,
    show_table,
    tell,
    told,
    utc_option,
)

if TYPE_CHECKING:
    from twin.operate.record.history import History
    from twin.operate.record.taking import IngestResult

POLL = 10.0
"""Seconds between two looks at what is watched."""

app = cli.program(no_args_is_help=True)


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


@app.command()
@json_and_quiet
def init(
    record: Place,
    options: cli.Options,
    instrument: Annotated[str, typer.Argument(help="Name of an instrument in the library, or path of its file.")],
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Readings are simulated: their times may be still to come.")
    ] = False,
    plan: Annotated[
        Path | None,
        typer.Option(readable=False, help="Plan of operation that counts from now on; `status` and `forecast` use it."),
    ] = None,
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
    from twin.operate.estimate.operation_model import read_plan, store_plan
    from twin.operate.record.history import History, initialise_record

    with told() as errors:
        if plan is not None:  # a mistake in it is told before anything is made
            read_operation(plan)
        passed = initialise_record(record, resolve_with(instrument), simulated)
        with History(record) as history:
            kept = plan is not None and store_plan(read_plan(plan, history), plan, history)
            what = f"version {', '.join(map(str, passed))}" if passed else "as it was"
            what += "" if plan is None else f"; the plan {plan} counts" if kept else f"; the plan {plan} counted before"
            text = f"record of {history.name} ({history.sha256[:12]}) in {history.url}: {what}"
            data = {"record": history.url, "instrument": history.name, "instrument_sha256": history.sha256}
            made = {"versions": list(passed), "plan": None if plan is None else str(plan.absolute()), "new_plan": kept}
        tell(errors, options, data | made, lambda console: line(console, text))


@app.command()
@on_record
def ingest(
    call: Call,
    files: Annotated[
        list[Path],
        typer.Argument(
            readable=False, help="YAML files that say what tables hold, run folders, or folders with some of these."
        ),
    ],
    moment: Annotated[
        str | None,
        typer.Option(
            "--time", help="UTC of a run folder's reading, or of 0 s of its series, where its name does not say it."
        ),
    ] = None,
    instrument: Annotated[
        str | None, typer.Option(help="Instrument of run folders that do not say it, such as those of twin.orbit.")
    ] = None,
    late: Annotated[
        bool, typer.Option("--late", help="Take readings that are older than the newest of their sort.")
    ] = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on looking for new tables and run folders, until Ctrl-C.")
    ] = False,
    page: Annotated[
        Path | None,
        typer.Option(
            "--report",
            metavar="FILE.html",
            readable=False,
            help="Write the daily report to this file, and anew whenever something was taken.",
        ),
    ] = None,
) -> None:
    """Take readings and events into a record: from tables, as a YAML file says what their columns are, and from run
    folders of twin.recover, twin.render and twin.orbit.

    A file is taken in one step. What is in the record already is told and not doubled. What cannot be true is refused
    with its reason, which `status` shows: another instrument, a clock that runs backwards, a unit that does not fit, an
    unknown event. A refusal counts once, also where the file is read again after it has grown. With --watch and
    --report the daily report, which a browser shows, is never older than the record.

    For example:

        python -m twin.operate ingest record scenes/examples/telemetry.yaml
        python -m twin.operate ingest record runs/recover-001 --time 2026-03-05T03:05:00Z
        python -m twin.operate ingest record downlink --watch --report report.html

    Exit codes: 0 success, 2 bad input or something was refused (all else is taken), 1 anything else.
    """
    from twin.operate.record.telemetry import Sources

    listed = call.options.as_json and not watch
    with durable.exit_on_terminate():
        start = None if moment is None else utc_option("--time", moment)
        if page is not None:
            call.planned(None)
        sources = Sources(files, start, _is_stated(instrument, call.history), watch)
        totals, files_told, first = Counter({"new": 0, "known": 0, "refused": 0, "refused_before": 0}), [], ""
        raised: list[str] = []
        stale = page is not None
        try:
            while True:
                before = totals["new"]
                for given in sources.poll(call.history):
                    taken = call.history.ingest(given, late)
                    totals.update(taken.counts)
                    first = first or (f"{taken.file}: {taken.refused[0][1]}" if taken.refused else "")
                    if listed:
                        files_told.append(_taken(taken))
                    else:
                        call.tell(_taken(taken), partial(line, text=_line(taken)))
                if totals["new"] > before or stale:
                    new, stale = _new_alarms(call, page), False
                    raised += new
                    if new and not listed:
                        call.tell({"alarms": new}, partial(line, text="\n".join(new)))
                if not watch:
                    break
                time.sleep(POLL)
        except KeyboardInterrupt:
            if not watch:  # a watching command has no other end
                print_error(call.errors, "interrupted: the files that were told are in the record, the others are not")
                raise typer.Exit(cli.INTERRUPTED) from None
        done = {**totals, "files": files_told, "alarms": raised}
        call.tell(done, partial(print_verdict, verdict=_counted(totals)))
        if refused := totals["refused"] + totals["refused_before"]:
            if call.options.silent:
                print_error(call.errors, f"{refused} refused, the first in {first}")
            raise typer.Exit(BAD_INPUT)


def _new_alarms(call: Call, page: Path | None) -> list[str]:
    """Return the alarms that the estimate under the record's plan raises with what was taken, after the report is
    written. What keeps it from being worked out is printed, and is no fault of what was taken.
    """
    if not call.has_estimate:
        if page is not None:
            print_error(call.errors, "no report: no reading of the monitor is in the record")
        return []
    try:
        operation, _, new = call.estimate()
    except (InputErrorText, InputError) as error:
        print_error(call.errors, f"what was taken is in the record, and the estimate cannot be worked out: {error}")
        return []
    if page is not None:
        from twin.operate.daily_report import end_of_day
        from twin.operate.overview import span_of

        write_report(call, call.history, operation, end_of_day(None, span_of(call.history)[1]), [call.place], page)
    return [f"alarm: {one.text}" for one in new]


def _is_stated(instrument: str | None, history: History) -> bool:
    """Whether run folders are said to be of the record's instrument. Raises InputErrorText: of another one."""
    from scenes.specs.resolved import resolve_with
    from twin.operate.record.entries import digest_of_job

    if instrument is None:
        return False
    digest = digest_of_job(resolve_with(instrument))
    if digest != history.sha256:
        own = f"{history.name} ({history.sha256[:12]})"
        raise InputErrorText(f"--instrument: the record is of {own}, not of {instrument} ({digest[:12]})")
    return True


def _counted(counts: Mapping[str, int]) -> str:
    text = "{new} taken, {known} known already, {refused} refused".format(**counts)
    return text + (f", {before} refused before" if (before := counts["refused_before"]) else "")


def _line(taken: IngestResult) -> str:
    lines = [f"{taken.file}: {_counted(taken.counts)}"]
    shown = [f"  refused{'' if line is None else f', line {line}'}: {reason}" for line, reason in taken.refused[:10]]
    more = len(taken.refused) - len(shown)
    return "\n".join([*lines, *shown, *([f"  and {more} more; status shows all"] if more else [])])


def _taken(one: IngestResult) -> dict[str, Any]:
    refused = [{"line": line, "reason": reason} for line, reason in one.refused]
    return {"file": one.file, **one.counts, "refused": refused, "before": one.before}


@app.command()
@on_record
def status(
    call: Call,
    plan: PlanFile = None,
    check_all: Annotated[
        bool, typer.Option("--check-all", help="Compare every entry with its digest, not the newest 500 alone.")
    ] = False,
    strict: cli.Strict = False,
) -> None:
    """Tell what a record holds, what was refused and why; and, under its plan of operation or another one, how the
    instrument stands: every quantity with its sigma, requirements, jumps, sensors, whether predictions came true.

    What is new and has to be known is raised as an alarm (python -m twin.operate alarms). A warning says where entries
    are not as they were taken, or what guards them was changed.

    Example: `python -m twin.operate status record scenes/examples/operation.yaml`

    Exit codes: 0 success, whether alarms are open or not, 2 bad input, 3 with --strict where the last readings
    contradict what is stated, 1 anything else.
    """
    found = call.estimate(plan) if plan is not None or call.has_estimate else None
    rows = call.history.alarms()
    opened = sum(row["acknowledged"] is None for row in rows)
    power = () if found is None else found[0].power()
    jumps_found = {one.body: one.plain for one in power}
    estimate = None if found is None else {**found[1].to_dict(), "jumps_found": jumps_found}
    held = call.history.status(check_all)
    data = {**held, "warnings": _record_warnings(held), "estimate": estimate, "open_alarms": opened}

    def show(console: Console) -> None:
        _show(data, console)
        if found is not None:
            show_estimate(found[1], rows, console)
        if power:
            show_power(power, console)

    call.tell(data, show)
    if strict:
        cli.end_strictly(call.errors, data)


def _record_warnings(held: dict[str, Any]) -> list[str]:
    """Return what a reader of a record's status has to know of the record itself."""
    out = [*held["altered"]]
    if not held["guarded"] and held["record"].startswith("sqlite"):
        out.append("what guards the record against alterations was removed or changed; status --check-all compares all")
    elif not held["guarded"]:
        out.append("this kind of database does not itself refuse to alter rows; only the program does")
    return out


def _show(data: dict[str, Any], console: Console) -> None:
    name, entries, opened = data["instrument"], data["entries"], data["open"]
    print_verdict(
        console, f"{name}: {entries} readings and events of {data['files']} files; {opened} refused and not taken"
    )
    for text in data["warnings"]:
        line(console, f"warning: {text}")
    rows = ([str(value) for value in one.values()] for one in data["streams"])
    show_table(console, ("kind", "of", "entries", "first [UTC]", "last [UTC]"), rows, (2,))
    for one in data["refused"]:
        at = "" if one["line"] is None else f":{one['line']}"
        since = " (taken since)" if one["taken_since"] else ""
        line(console, f"refused{since}: {one['file']}{at}: {one['reason']}")


@app.command()
@on_record
def export(
    call: Call,
    tables: Annotated[str, typer.Option(help="Format of the tables: csv, parquet or fits.")] = "csv",
    out: NewFolder = Path("tables"),
) -> None:
    """Write a record as tables that other programs read, one for each sort of reading; every column says its unit.

    Example: `python -m twin.operate export record --tables parquet --out record-tables`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    from twin.framework.data_files import TABLE_FORMATS, MissingPackage
    from twin.operate.record.record_tables import tables as all_tables

    cli.require_one_of("--tables", tables, TABLE_FORMATS)
    require_new(out)
    try:
        made = [
            (f"{table.name}.{tables}", TABLE_FORMATS[tables](table), table.rows) for table in all_tables(call.history)
        ]
    except MissingPackage as error:
        raise InputErrorText(str(error)) from None
    call.write_new(out, {name: content for name, content, _ in made}, "record")
    data = {"out": str(out), "tables": [{"file": name, "rows": rows} for name, _, rows in made]}
    text = "\n".join(f"{out / name}: {rows} rows" for name, _, rows in made)
    call.tell(data, lambda console: line(console, text or "the record is empty"))


for command in (forecast, alarms, exclude, products, simulate, judge, report):
    app.command()(command)


if __name__ == "__main__":
    app()
