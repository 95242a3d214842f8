"""What commands show of an estimate: how the instrument stands now, the forecast, and the alarms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.yaml.errors import Problem
from twin.operate.followed import PlanFile, followed, known_of, operation_of, plan_of
from twin.operate.terminal import Place, line, require_record, tell, told
from twin.run.cli import AsJson, InputErrorText, Quiet, print_verdict, print_whole, result_table

if TYPE_CHECKING:
    from analysis.monitor.series_filter import Power
    from twin.operate.estimate.following import Course, Following
    from twin.operate.estimate.operation import Operation
    from twin.operate.record.entries import Alarm
    from twin.operate.record.history import History

STEPS = 4
"""Columns of a forecast after the first, now."""


def forecast(
    record: Place,
    plan: PlanFile = None,
    until: Annotated[
        str | None, typer.Option(metavar="UTC", help="End of the forecast. Default: the plan's horizon.")
    ] = None,
    steps: Annotated[int, typer.Option(min=1, max=1000, help="Times of it, evenly spaced.")] = STEPS,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Tell what is expected of every quantity until the horizon, with sigmas, and when a requirement will break.

    A forecast begins at the newest reading. Drift is forgotten with its time, seasons and trends go on, and sigma grows
    as the plan's laws of time say.

    Example: `python -m twin.operate forecast record --until 2030-01-01T00:00:00Z`

    Exit codes: 0 success, 2 bad input, 1 anything else.
    """
    require_record(record)
    from twin.operate.record.history import History

    with told() as errors, History(record) as history:
        operation = operation_of(history, plan, errors, quiet)
        following = operation.follow()
        end = _end(until, following.time, operation.plan.operation.horizon)
        times = [following.time + round((end - following.time) * k / steps) for k in range(steps + 1)]
        course = operation.forecast(times)
        requirements = [one.to_dict() for one in following.breaks]
        data = {"record": history.url, "instrument": history.name, **course.to_dict(), "requirements": requirements}
        data["warnings"] = following.warnings

        def show(console: Console) -> None:
            print_verdict(console, f"{history.name}: forecast from {course.utc[0]} to {course.utc[-1]}")
            _show_course(course, console)
            show_requirements(following, console)
            for text in following.warnings:
                line(console, f"warning: {text}")

        tell(errors, as_json, quiet, data, show)


def _end(until: str | None, start: int, horizon: float) -> int:
    """Microseconds of the end of a forecast. Raises InputErrorText: it is not after its beginning."""
    from twin.operate.record.entries import MICRO, utc_text
    from twin.operate.record.sources import moment_said

    if until is None:
        return start + round(horizon * MICRO)
    end = moment_said("--until", until)
    if end <= start:
        raise InputErrorText(f"--until: {until} is not after the newest reading, {utc_text(start)}")
    return end


def alarms(
    record: Place,
    acknowledge: Annotated[
        int | None, typer.Option(metavar="ID", help="Say that somebody has seen this alarm.")
    ] = None,
    by: Annotated[str | None, typer.Option(metavar="NAME", help="Who has seen it.")] = None,
    note: Annotated[str, typer.Option(metavar="TEXT", help="What is done about it.")] = "",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """List the alarms of a record, those first that nobody has acknowledged; or acknowledge one.

    `ingest` and `status` raise an alarm once: a requirement that does not hold or is expected to break, a jump, a
    sensor that is dead, stuck or doubtful, a reading that contradicts what is stated. No alarm is ever removed.

    Example: `python -m twin.operate alarms record --acknowledge 1 --by Ann --note "safe mode of 5 March"`

    Exit codes: 0 success, whether alarms are open or not, 2 bad input, 1 anything else.
    """
    require_record(record)
    from twin.operate.record.entries import one_line
    from twin.operate.record.history import History

    with told() as errors, History(record) as history:
        if acknowledge is not None:
            if not (by and by.strip()):
                raise InputErrorText("--acknowledge: who has seen the alarm? --by NAME")
            try:
                history.acknowledge(acknowledge, by.strip(), note)
            except Problem as problem:
                raise InputErrorText(f"--acknowledge: {one_line(problem)}") from None
        elif by is not None or note:
            raise InputErrorText("--by and --note: which alarm? --acknowledge ID")
        rows = history.alarms()
        opened = sum(one["acknowledged"] is None for one in rows)
        data = {"open": opened, "alarms": rows}

        def show(console: Console) -> None:
            print_verdict(console, f"{history.name}: {_open_text(opened)}, {len(rows)} in all")
            for one in sorted(rows, key=lambda one: (one["acknowledged"] is not None, -one["time_us"])):
                line(console, alarm_line(one))

        tell(errors, as_json, quiet, data, show)


def exclude(
    record: Place,
    entry: Annotated[int, typer.Argument(metavar="ENTRY", min=1, help="Number of the entry, as status says.")],
    why: Annotated[str, typer.Option(metavar="TEXT", help="The reason, which the record keeps.")],
    include: Annotated[
        bool, typer.Option("--include", help="Include it again, or although the estimate left it out as a bad one.")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Exclude a reading from the estimate, or include it, with the reason. The record keeps the reading and all
    decisions; the newest counts.

    For example:

        python -m twin.operate exclude record 123 --why "cosmic ray on the left spot"
        python -m twin.operate exclude record 123 --include --why "the base was turned on purpose"

    Exit codes: 0 success, 2 bad input (nothing is decided), 1 anything else.
    """
    require_record(record)
    from twin.operate.record.entries import one_line
    from twin.operate.record.history import History

    with told() as errors, History(record) as history:
        if not why.strip():
            raise InputErrorText("--why: a decision needs a reason, which the record keeps")
        try:
            made = history.decide(entry, include, why.strip())
        except Problem as problem:
            raise InputErrorText(f"ENTRY: {one_line(problem)}") from None
        text = "entry {entry}, {kind} of {subject} at {time_utc}, is ".format(**made)
        text += f"{'included' if include else 'excluded'}: {made['why']}"
        tell(errors, as_json, quiet, made, lambda console: print_verdict(console, text))


def _open_text(count: int) -> str:
    return "1 alarm is open" if count == 1 else f"{count or 'no'} alarms are open"


def alarm_line(row: Mapping[str, Any]) -> str:
    """An alarm of the record, with who has seen it."""
    seen = row["acknowledged"]
    state = "open" if seen is None else f"seen by {seen['by']}{': ' if seen['note'] else ''}{seen['note']}"
    return f"alarm {row['id']}, {row['time_utc']}, {row['kind']} ({state}): {row['text']}"


def estimate_of(
    errors: Console, history: History, plan: Path | None = None, quiet: bool = False
) -> tuple[Operation, Following, list[Alarm]] | None:
    """The estimate under a plan, what it says, and the alarms that are new, which are then in the record; None where
    there is no plan or nothing to follow.

    Args:
        errors: where it is told how far it is.
        history: the record.
        plan: file; None for the plan that the record keeps.
        quiet: whether that is not told.
    """
    setup = plan_of(history, plan)
    if setup is None or (plan is None and history.first("monitor") is None):
        return None
    operation = followed(history, setup, errors, quiet)
    return (operation, *known_of(operation))


def show_estimate(following: Following, rows: Sequence[Mapping[str, Any]], console: Console) -> None:
    """The head of the estimate: now, predictions and whether they came true, jumps, sensors, what was left out, alarms.

    Args:
        following: what is known after all readings.
        rows: alarms of the record.
        console: the terminal.
    """
    from twin.operate.estimate.alarms import sized
    from twin.operate.record.entries import utc_text

    scores, count = following.scores, following.readings
    print_verdict(console, f"estimate at {utc_text(following.time)} from {count} readings of the monitor")
    _show_course(following.now, console)
    show_requirements(following, console)
    if scores.components:
        one, two = (100.0 * part / scores.components for part in (scores.within_one, scores.within_two))
        text = f"{one:.1f} % within one sigma (68.3 % expected), {two:.1f} % within two (95.4 %)"
        line(console, f"predictions before the readings came: {text}; mean log score {scores.log_score:.2f}")
    for text in following.warnings:
        line(console, f"warning: {text}")
    for jump in following.jumps:
        between = f"between {utc_text(jump.after_us)} and {utc_text(jump.until_us)}"
        sizes = ", ".join(f"{name.removeprefix(f'{jump.body} ')} {sized(z, s, u)}" for name, u, z, s in jump.sizes)
        line(console, f"jump of {jump.body} {between}: {sizes}")
    bad = [one for one in following.sensors if one.state != "ok"]
    if following.sensors:
        line(console, f"sensors: {len(following.sensors) - len(bad)} of {len(following.sensors)} are as they should be")
    for sensor in bad:
        line(console, f"  {sensor.body}: {sensor.state} since {utc_text(sensor.since_us)}: {sensor.reason}")
    if following.left_out:
        line(console, f"left out of the estimate: {len(following.left_out)} of the last readings and more; the newest")
        for time, _, subject, reason in following.left_out[-3:]:
            line(console, f"  {utc_text(time)} {subject}: {reason}")
    waiting = [one for one in rows if one["acknowledged"] is None]
    for alarm in waiting[-10:]:
        line(console, alarm_line(alarm))
    if waiting:
        line(console, f"{_open_text(len(waiting))}; python -m twin.operate alarms RECORD --acknowledge ID --by NAME")


def _show_course(course: Course, console: Console) -> None:
    """A row for each quantity, a column for each time."""
    from twin.operate.estimate.alarms import name_of, sized

    table = result_table()
    table.add_column("change of")
    for time in course.utc:
        table.add_column(time, justify="right")
    for k, one in enumerate(course.quantities):
        cells = zip(course.values[:, k].tolist(), course.sigmas[:, k].tolist(), strict=True)
        unit = one.parameter.unit
        table.add_row(name_of(f"{one.group} {one.key}", course.quantities), *(sized(v, s, unit) for v, s in cells))
    print_whole(console, table)


def show_power(found: Sequence[Power], console: Console) -> None:
    """A row for each body: the smallest jumps that are found, over the stated sizes."""
    table = result_table()
    for head in ("smallest jump found, over the stated", *(key.replace("_", " ") for key in found[0].plain)):
        table.add_column(head)
    for one in found:
        table.add_row(one.body, *("none" if size is None else f"{size:.2g}" for size in one.plain.values()))
    print_whole(console, table)


def show_requirements(following: Following, console: Console) -> None:
    """A row for each requirement."""
    from twin.operate.estimate.alarms import name_of, percent
    from twin.operate.record.entries import utc_text
    from twin.run.artefact import plain

    if not following.breaks:
        return
    table = result_table()
    for head in ("has to keep", "limit", "chance beyond", "allowed", "holds now", "expected to break"):
        table.add_column(head, justify="left" if head in ("has to keep", "holds now") else "right")
    for one in following.breaks:
        later = "now" if not one.holds_now else "not in the horizon"
        table.add_row(
            name_of(one.quantity, following.now.quantities),
            f"{plain(one.limit)} {one.unit}",
            percent(one.chance_now),
            percent(1.0 - one.probability),
            "yes" if one.holds_now else "no",
            utc_text(one.breaks_us) if one.holds_now and one.breaks_us is not None else later,
        )
    print_whole(console, table)
