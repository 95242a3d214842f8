"""The commands that show an instrument in operation: the daily report, and the page in a browser."""

from __future__ import annotations

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

PORT = 8791
TOKEN, WRITE_TOKEN = "TWIN_OPERATE_TOKEN", "TWIN_OPERATE_WRITE_TOKEN"
"""Environment variables with tokens that stay the same when the server is started again."""
EXTRA = (
    "the page needs starlette, uvicorn and websockets, which are not installed; install them with "
    "`bash setup.sh --live`"
)


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
        from twin.operate.daily_report import daily_report, end_of_day, report_html
        from twin.operate.overview import Overview
        from twin.operate.record.history import History, PastHistory
        from twin.operate.shown_readings import first_time, last_time

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
                overview = Overview.of(own, operation)
                words = ["twin.operate", "report", record, *([] if plan is None else [str(plan)])]
                made = daily_report(own, overview, end)
                page = report_html(made, [*words, *([] if day is None else ["--day", day])])
        try:
            durable.write_safely(out, page)
        except OSError as error:
            print_error(errors, f"--out: {out}: {error.strerror or error}")
            raise typer.Exit(FAILURE) from None
        data = {"report": str(out), "verdict": made.verdict, "warnings": list(made.warnings)}
        tell(errors, as_json, quiet, data, lambda console: _show(console, made.verdict, out))


def _show(console: Console, verdict: str, out: Path) -> None:
    print_verdict(console, verdict)
    line(console, f"report: {out}")


def serve(
    record: Place,
    plan: PlanFile = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="To listen on; 0 takes one that is free.")] = PORT,
    host: Annotated[
        str, typer.Option(help="Address to listen on. Others than this machine can reach it if it is not 127.0.0.1.")
    ] = "127.0.0.1",
    write_token: Annotated[
        bool, typer.Option("--write-token", help="Print a second address, with which alarms can be acknowledged.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Show the instrument in operation as a page in the browser: trends with their bands, jumps and events, predictions
    and whether they came true, alarms, the spots and frames of any reading, and the instrument in three dimensions as
    the estimate has it at any time. When readings are taken into the record, open pages follow.

    Example: `python -m twin.operate serve record`

    The command prints an address; open it in a browser on this machine. The address holds a token: whoever has it can
    read. With --write-token a second address is printed, and who has that can acknowledge alarms, which is all that a
    page can change. The environment variables TWIN_OPERATE_TOKEN and TWIN_OPERATE_WRITE_TOKEN set tokens that stay when
    the command is started again. The command ends with Ctrl-C.

    It needs what the extra `live` installs: bash setup.sh --live

    Exit codes: 0 ended, 2 bad input, 1 anything else.
    """
    require_record(record)
    with told():
        try:
            from twin.operate.serve import OperateServer
            from twin.serving.guard import BadToken, Guard, new_token
            from twin.serving.server import addresses, listen
        except ImportError as error:
            raise InputErrorText(f"{EXTRA} ({error.name})") from None
        from twin.operate.desk import Desk
        from twin.operate.record.history import History
        from twin.operate.shown_readings import last_time

        console = Console(quiet=quiet)
        with History(record) as history:
            if last_time(history) is None:
                raise InputErrorText("the record has no reading of the monitor; ingest takes some")
            try:
                token, write = new_token(TOKEN), new_token(WRITE_TOKEN) if write_token else ""
                listening = listen(host, port)
            except BadToken as error:
                raise InputErrorText(str(error)) from None
            except OSError as error:
                text = f"cannot listen on {host}:{port}: {error.strerror}; choose another --port"
                raise InputErrorText(text) from None
            try:
                operation = operation_of(history, plan, console, quiet)

                def estimate() -> Operation:
                    nonlocal operation
                    operation = operation.again()
                    known_of(operation)
                    return operation

                desk = Desk(history, estimate)
                bound = listening.getsockname()[1]
                for said in addresses(host, bound, f"token={token}"):
                    line(console, said)
                for said in addresses(host, bound, f"token={token}&write={write}") if write else ():
                    line(console, f"to acknowledge alarms, {said}")
                line(console, "Ctrl-C ends it.")
                OperateServer(desk, Guard.of(token, host, bound, write)).run(listening)
            finally:
                listening.close()
