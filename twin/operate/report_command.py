"""``python -m twin.operate report``: the daily report, which `ingest` writes anew, too."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from scenes.yaml.errors import Problem
from scenes.yaml.standard_output import FAILURE, print_error
from twin.operate.followed import PlanFile, followed, known_of, operation_of
from twin.operate.terminal import Place, line, require_record, tell, told
from twin.run import durable
from twin.run.cli import AsJson, InputErrorText, Quiet, print_verdict

if TYPE_CHECKING:
    from twin.operate.estimate.operation import Operation
    from twin.operate.record.history import History
    from twin.run.report import Report


def report(
    record: Place,
    plan: PlanFile = None,
    day: Annotated[
        str | None, typer.Option(metavar="UTC", help="Day of the report, 2028-03-05. Default: of the newest reading.")
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="FILE.html", readable=False, help="The report; a file of that name is replaced.")
    ] = Path("report.html"),
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write the daily report: one page that needs no other file, to be kept or to be sent by mail.

    Two sentences say first how the instrument stands against its requirements, and what changed on the day. Then come
    every quantity with its sigma, its requirement, its chance to keep it and the day on which it is expected to break;
    trends, jumps, predictions and whether they came true, sensors, alarms, and what was left out and why. Of a day that
    is past it is the report as it would have been then.

    Example: `python -m twin.operate report record --day 2028-03-05 --out report.html`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    require_record(record)
    with told() as errors:
        from twin.operate.daily_report import end_of_day
        from twin.operate.overview import first_time, last_time
        from twin.operate.record.history import History, PastHistory

        with History(record) as history:
            newest = last_time(history)
            if newest is None:
                raise InputErrorText("the record has no reading of the monitor; ingest takes some")
            try:
                end = end_of_day(day, newest)
            except Problem as problem:
                raise InputErrorText(f"--day: {problem.at('')}".replace("input: ", "")) from None
            if end <= first_time(history):
                raise InputErrorText(f"--day: the record has no reading of the monitor before the end of {day}")
            operation = operation_of(history, plan, errors, quiet)
            known_of(operation)
            with PastHistory(record, end) as then:
                own = then if end <= newest else history
                if own is then:  # it goes on from what was kept of the whole record before the day's end
                    operation = followed(then, operation.plan, errors, quiet)
                words = [record, *([] if plan is None else [str(plan)]), *([] if day is None else ["--day", day])]
                made = write_report(own, operation, end, words, out, errors)
        data = {"report": str(out), "verdict": made.verdict, "warnings": list(made.warnings)}
        tell(errors, as_json, quiet, data, lambda console: _show(console, made.verdict, out))


def write_report(
    history: History, operation: Operation, end: int, words: Sequence[str], out: Path, errors: Console
) -> Report:
    """Write the report of a day.

    Args:
        history: the record.
        operation: the estimate from it.
        end: of the day, microseconds of TAI since 2000.
        words: after ``twin.operate report``, of the command that makes it again.
        out: file, which is replaced.
        errors: where it is said that it cannot be written.

    Raises:
        typer.Exit: it cannot be written.
    """
    from twin.operate.daily_report import daily_report, report_html
    from twin.operate.overview import Overview

    made = daily_report(history, Overview.of(history, operation), end)
    try:
        durable.write_safely(out, report_html(made, ("twin.operate", "report", *words)))
    except OSError as error:
        print_error(errors, f"the report {out} cannot be written: {error.strerror or error}")
        raise typer.Exit(FAILURE) from None
    return made


def _show(console: Console, verdict: str, out: Path) -> None:
    print_verdict(console, verdict)
    line(console, f"report: {out}")
