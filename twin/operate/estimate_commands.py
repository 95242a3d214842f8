"""Commands of `twin.operate` on an estimate: forecast, alarms, exclusion of readings, products, daily report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.yaml.standard_output import FAILURE, print_error
from twin.framework import durable
from twin.framework.cli import Force, InputErrorText, print_verdict
from twin.operate.terminal import (
    Call,
    NewFolder,
    PlanFile,
    input_errors,
    on_record,
    print_line,
    require_new,
    show_table,
    utc_option,
)

if TYPE_CHECKING:
    from analysis.monitor.kalman_filter import DetectionPower
    from twin.framework.report import Report
    from twin.operate.estimate.operation_filter import Operation
    from twin.operate.estimate.reported_estimate import Course, FilterResult
    from twin.operate.record.history import History

STEPS = 4
"""Default number of forecast times after the newest reading."""


@on_record
def forecast(
    call: Call,
    plan: PlanFile = None,
    until: Annotated[
        str | None, typer.Option(metavar="UTC", help="End of the forecast. Default: the plan's horizon.")
    ] = None,
    steps: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of evenly spaced times after the newest reading.")
    ] = STEPS,
) -> None:
    """Forecast every quantity with its sigma, the probability that it exceeds its limit, and the first such day.

    A forecast begins at the newest reading. Drifts decay with their correlation times, seasons and trends continue,
    and sigma grows by the time laws of the plan's disturbances.

    Example: `python -m twin.operate forecast record --until 2030-01-01T00:00:00Z`

    Exit codes: 0 success, 2 bad input, 1 anything else.
    """
    from twin.operate.estimate.reported_estimate import name_of, percent
    from twin.operate.record.entries import MICRO

    operation = call.filtered_operation(call.resolve_plan(plan))
    result = operation.filter_readings()
    start, horizon = result.time, round(operation.plan.operation.horizon * MICRO)
    end = start + horizon if until is None else utc_option("--until", until)
    if end <= start:
        raise InputErrorText(f"--until: {until} is not after the newest reading, {result.now.utc[0]}")
    course = operation.forecast([start + round((end - start) * k / steps) for k in range(steps + 1)])
    chances = {s.quantity: course.exceedance(s.quantity, s.limit).tolist() for s in result.requirements}
    requirements = [{**status.to_dict(), "chances": chances[status.quantity]} for status in result.requirements]
    name, warnings = call.history.name, result.warnings
    data = {"record": call.history.url, "instrument": name, **course.to_dict(), "requirements": requirements}

    def show(console: Console) -> None:
        print_verdict(console, f"{name}: forecast from {course.utc[0]} to {course.utc[-1]}")
        _show_course(course, console)
        if chances:
            rows = [[name_of(key, course.quantities), *map(percent, values)] for key, values in chances.items()]
            show_table(console, ("P(exceeded) of", *course.utc), rows, range(1, len(course.utc) + 1))
        show_requirements(result, console)
        for text in warnings:
            print_line(console, f"warning: {text}")

    call.print_result({**data, "warnings": warnings}, show)


@on_record
def alarms(
    call: Call,
    acknowledge: Annotated[int | None, typer.Option(metavar="ID", help="Acknowledge this alarm.")] = None,
    by: Annotated[str | None, typer.Option(metavar="NAME", help="Person who has seen it.")] = None,
    note: Annotated[str, typer.Option(metavar="TEXT", help="Action taken.")] = "",
) -> None:
    """List the alarms of a record, open ones first; or acknowledge one.

    `ingest` and `status` raise an alarm once: for a requirement that is or was violated or may be, a jump, a
    sensor that is dead, stuck or doubtful, and a reading that contradicts the prior. Alarms are never removed.

    Example: `python -m twin.operate alarms record --acknowledge 1 --by Ann --note "safe mode of 5 March"`

    Exit codes: 0 success, whether alarms are open or not, 2 bad input, 1 anything else.
    """
    if acknowledge is not None:
        if not (by and by.strip()):
            raise InputErrorText("--acknowledge needs --by NAME, the person who has seen the alarm")
        with input_errors("--acknowledge"):
            call.history.acknowledge(acknowledge, by.strip(), note)
    elif by is not None or note:
        raise InputErrorText("--by and --note need --acknowledge ID")
    rows = call.history.alarms()
    opened = sum(row["acknowledged"] is None for row in rows)

    def show(console: Console) -> None:
        print_verdict(console, f"{call.history.name}: {_open_text(opened)}, {len(rows)} in all")
        for alarm in sorted(rows, key=lambda alarm: (alarm["acknowledged"] is not None, -alarm["time_us"])):
            print_line(console, alarm_line(alarm))

    call.print_result({"open": opened, "alarms": rows}, show)


@on_record
def exclude(
    call: Call,
    entry: Annotated[int, typer.Argument(metavar="ENTRY", min=1, help="Number of the entry, as `status` shows it.")],
    why: Annotated[str, typer.Option(metavar="TEXT", help="Reason, which is stored in the record.")],
    include: Annotated[
        bool, typer.Option("--include", help="Include it, also if the estimate rejected it as an outlier.")
    ] = False,
) -> None:
    """Exclude a reading from the estimate, or include it, with a reason.

    The record keeps the reading and all decisions; the newest one counts.

    For example:

        python -m twin.operate exclude record 123 --why "cosmic ray on the left spot"
        python -m twin.operate exclude record 123 --include --why "the base was turned on purpose"

    Exit codes: 0 success, 2 bad input (nothing is decided), 1 anything else.
    """
    if not why.strip():
        raise InputErrorText("--why: a decision needs a reason, which the record keeps")
    with input_errors("ENTRY"):
        made = call.history.decide(entry, include, why.strip())
    text = "entry {entry}, {kind} of {subject} at {time_utc}, is ".format(**made)
    text += f"{'included' if include else 'excluded'}: {made['why']}"
    call.print_result(made, lambda console: print_verdict(console, text))


@on_record
def products(
    call: Call,
    plan: PlanFile = None,
    moment: Annotated[
        str | None, typer.Option("--time", metavar="UTC", help="Time of the estimate. Default: that of the scene.")
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(
            readable=False,
            help="Scene whose camera models are wanted: YAML file of a test of intersection angles with the "
            "instrument, or its run folder, with camera, orbit and attitude.",
        ),
    ] = None,
    out: NewFolder = Path("products"),
    force: Force = False,
) -> None:
    """Write the products of the estimate for one time.

    They are models of a scene's cameras at that time (ISD and RPC00B with ERR_BIAS and ERR_RAND), the state of the
    instrument as a job for twin.render (state.yaml), and its uncertainty as a prior for twin.asbuilt (prior.yaml).
    products.json states their period of validity.

    Example: `python -m twin.operate products record --scene scenes/orbit/angle_gf7.yaml --time 2026-03-05T03:05:00Z`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    from optics.numerics.backend import load_backend
    from twin.framework.run_folder import RunFolder
    from twin.operate.products import make_products, product_files, scene_time, summary
    from twin.orbit.export.export_run import read_source

    folder = RunFolder(out, force)
    source = None if scene is None else read_source(scene)
    if moment is not None:
        time = utc_option("--time", moment)
    elif source is not None:
        with input_errors("--scene"):
            time = scene_time(source)
    else:
        raise InputErrorText("no time: give --time UTC, or --scene FILE, which has one")
    operation = call.filtered_operation(call.resolve_plan(plan))
    with input_errors():
        made = make_products(operation, call.history, time, source, load_backend())
    files, numbers = product_files(made)
    call.write_files(folder, files, "products")
    call.print_result(numbers, lambda console: print_line(console, summary(made)))


@on_record
def report(
    call: Call,
    plan: PlanFile = None,
    day: Annotated[
        str | None,
        typer.Option(metavar="UTC", help="Day of the report, 2028-03-05. Default: that of the newest reading."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="FILE.html", readable=False, help="File of the report.")] = Path(
        "report.html"
    ),
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
) -> None:
    """Write the daily report: one self-contained page, to be stored or sent by mail.

    Its first two sentences state whether the requirements are met and what changed on the day. Then follow every
    quantity with its sigma, its requirement, the probability that it is exceeded and the day from which it may be
    violated; trends, jumps, the quality of the predictions, sensors, alarms, and excluded readings with the reason. The
    report of a past day is the one that would have been written then.

    Example: `python -m twin.operate report record --day 2028-03-05 --out report.html`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    from twin.operate.daily_report import end_of_day
    from twin.operate.overview import reading_span
    from twin.operate.record.history import History

    require_new(out, force)
    first, newest = reading_span(call.history, call.reading_kind)
    if not newest:
        raise InputErrorText(f"the record has no reading of the {call.reading_kind}; ingest some first")
    with input_errors("--day"):
        end = end_of_day(day, newest)
    if end <= first:
        raise InputErrorText(f"--day: the record has no reading of the {call.reading_kind} before the end of {day}")
    operation, _, _ = call.estimate(plan)
    words = [call.location, *([] if plan is None else [str(plan)]), *([] if day is None else ["--day", day])]
    with History(call.location, end) as then:
        history = then if end <= newest else call.history
        if history is then:  # reuses the checkpoints of the whole record before the day's end
            operation = call.filtered_operation(operation.plan, then)
        made = write_report(call, history, operation, end, words, out)
    data = {"report": str(out), "verdict": made.verdict, "warnings": list(made.warnings)}

    def show(console: Console) -> None:
        print_verdict(console, made.verdict, unmet=made.unmet, warned=bool(made.warnings))
        print_line(console, f"report: {out}")

    call.print_result(data, show)


def write_report(
    call: Call, history: History, operation: Operation, end: int, words: Sequence[str], out: Path
) -> Report:
    """Write the daily report of an operation as an HTML file.

    Parameters
    ----------
    call : Call
        Command in progress, with its options and output.
    history : History
        Record of the command, or its state at an earlier time.
    operation : Operation
        Estimate of that record.
    end : int
        End of the day, in microseconds of TAI since 2000.
    words : Sequence[str]
        Command-line arguments of ``twin.operate report`` that reproduce the report.
    out : Path
        File to be written; an existing one is replaced.

    Raises
    ------
    typer.Exit
        The file cannot be written; the error has been printed.
    """
    from twin.framework.page import report_page
    from twin.operate.daily_report import daily_report
    from twin.operate.overview import Overview

    made = daily_report(history, Overview.of(history, operation), end)
    try:
        durable.write_safely(out, report_page(made, ("twin.operate", "report", *words)).encode())
    except OSError as error:
        print_error(call.errors, f"the report {out} cannot be written: {error.strerror or error}")
        raise typer.Exit(FAILURE) from None
    return made


def _open_text(count: int) -> str:
    return "1 alarm is open" if count == 1 else f"{count or 'no'} alarms are open"


def alarm_line(row: Mapping[str, Any]) -> str:
    """Return a line of text on an alarm of the record, with its acknowledgement."""
    seen = row["acknowledged"]
    state = "open" if seen is None else f"seen by {seen['by']}{': ' if seen['note'] else ''}{seen['note']}"
    return f"alarm {row['id']}, {row['time_utc']}, {row['kind']} ({state}): {row['text']}"


def show_headline(history: History, operation: Operation, console: Console) -> None:
    """Print whether the requirements hold, the next violation and the open alarms, the most urgent first.

    Parameters
    ----------
    history : History
        Record of the instrument in operation.
    operation : Operation
        Its estimate.
    console : Console
        The terminal.
    """
    from twin.framework.report import answer
    from twin.operate.overview import Overview

    overview = Overview.of(history, operation)
    verdict, _ = answer(*overview.headline())
    print_verdict(console, verdict, unmet=overview.unmet, warned=bool(overview.filter_result.warnings))


def show_estimate(result: FilterResult, rows: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print the estimate: present values, quality of the predictions, jumps, sensors, excluded entries and alarms.

    Parameters
    ----------
    result : FilterResult
        Result of filtering all readings.
    rows : Sequence[Mapping[str, Any]]
        Alarms of the record.
    console : Console
        The terminal.
    """
    from twin.operate.record.entries import utc_text

    scores = result.scores
    print_line(console, f"estimate at {utc_text(result.time)} from {result.readings_text}")
    _show_course(result.now, console)
    show_requirements(result, console)
    if scores.components:
        first_share, second_share = (
            100.0 * part / scores.components for part in (scores.within_one, scores.within_two)
        )
        text = f"{first_share:.1f} % within one sigma (68.3 % expected), {second_share:.1f} % within two (95.4 %)"
        print_line(console, f"predictions of the readings: {text}; mean log score {scores.log_score:.2f}")
    _show_terms(result, console)
    for text in result.warnings:
        print_line(console, f"warning: {text}")
    for jump in result.jumps:
        print_line(console, f"jump of {jump.body} {jump.summary}")
    bad = [sensor for sensor in result.sensors if sensor.state != "ok"]
    if result.sensors:
        print_line(console, f"sensors: {len(result.sensors) - len(bad)} of {len(result.sensors)} are in order")
    for sensor in bad:
        print_line(console, f"  {sensor.body}: {sensor.state} since {utc_text(sensor.since_us)}: {sensor.reason}")
    if result.excluded:
        what = "excluded from the estimate, or not yet decided" if result.undecided else "excluded from the estimate"
        print_line(console, f"{what}: {len(result.excluded)} of the latest entries; the newest:")
        for time, _, subject, reason in result.excluded[-3:]:
            print_line(console, f"  {utc_text(time)} {subject}: {reason}")
    waiting = [row for row in rows if row["acknowledged"] is None]
    for alarm in waiting[-10:]:
        print_line(console, alarm_line(alarm))
    if waiting:
        print_line(
            console, f"{_open_text(len(waiting))}; python -m twin.operate alarms RECORD --acknowledge ID --by NAME"
        )


def _show_course(course: Course, console: Console) -> None:
    """Print a table with one row for each quantity and one column for each time."""
    from twin.operate.estimate.reported_estimate import name_of, with_sigma

    utc = course.utc
    rows = []
    for k, quantity in enumerate(course.quantities):
        cells = zip(course.values[:, k].tolist(), course.sigmas[:, k].tolist(), strict=True)
        name = name_of(quantity.name, course.quantities)
        rows.append([name, *(with_sigma(v, s, quantity.parameter.unit, sign=True) for v, s in cells)])
    show_table(console, ("change of", *utc), rows, range(1, len(utc) + 1))


def _show_terms(result: FilterResult, console: Console) -> None:
    """Print a table of the learned terms and of the commanded moves."""
    from twin.operate.estimate.reported_estimate import with_sigma

    rows = []
    for term in result.terms:
        cells = [
            with_sigma(term.amount, term.sigma, term.unit, True),
            with_sigma(term.prior, term.prior_sigma, term.unit, True),
        ]
        constant, spread = term.time_constant_h, term.time_constant_h_sigma
        days = "" if constant is None or spread is None else with_sigma(constant / 24.0, spread / 24.0, "days")
        rows.append([term.name, *cells, days])
    if rows:
        show_table(console, ("term or move", "amount", "before any reading", "time constant"), rows, (1, 2, 3))
    for term in result.terms:
        if term.note:
            print_line(console, term.note)


def show_power(powers: Sequence[DetectionPower], console: Console) -> None:
    """Print a table of the smallest detectable jump of each body, in units of its prior standard deviation."""
    heads = ("smallest detectable jump, in stated sigmas", *(key.replace("_", " ") for key in powers[0].plain))
    sizes = (
        [power.body, *("none" if size is None else f"{size:.2g}" for size in power.plain.values())] for power in powers
    )
    show_table(console, heads, sizes, ())


def show_requirements(result: FilterResult, console: Console) -> None:
    """Print a table with one row for each requirement."""
    from twin.framework.artefact import plain
    from twin.operate.estimate.reported_estimate import name_of, percent
    from twin.operate.record.entries import utc_text

    if not result.requirements:
        return
    rows = []
    for requirement in result.requirements:
        later = "now" if not requirement.holds_now else "not within the horizon"
        rows.append(
            [
                name_of(requirement.quantity, result.now.quantities),
                f"{plain(requirement.limit)} {requirement.unit}",
                percent(requirement.chance_now),
                percent(1.0 - requirement.probability),
                "yes" if requirement.holds_now else "no",
                utc_text(requirement.breaks_us)[:10]
                if requirement.holds_now and requirement.breaks_us is not None
                else later,
            ]
        )
    heads = ("requirement on", "limit", "P(exceeded)", "allowed", "holds now", "may be violated from")
    show_table(console, heads, rows, (1, 2, 3, 5))
