"""The estimate that a command asks for: under a plan that is named, or under the one that the record keeps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from twin.run.cli import InputErrorText, Standing, heartbeat

if TYPE_CHECKING:
    from scenes.specs.operation import OperationSetup
    from twin.operate.estimate.following import Following
    from twin.operate.estimate.operation import Operation
    from twin.operate.record.entries import Alarm
    from twin.operate.record.history import History

PlanFile = Annotated[
    Path | None,
    typer.Argument(metavar="[PLAN.yaml]", readable=False, help="Plan of operation. Default: that of the record."),
]


def plan_of(history: History, plan: Path | None) -> OperationSetup | None:
    """The plan in a file, or that of the record; None where the record keeps none. Raises InputError."""
    from twin.operate.estimate.operation_model import kept_plan, read_plan

    return kept_plan(history) if plan is None else read_plan(plan, history)


def operation_of(history: History, plan: Path | None, errors: Console, quiet: bool = False) -> Operation:
    """The estimate of a record under a plan, with all readings; how far it is is told now and then.

    Args:
        history: the record.
        plan: file; None for the plan that the record keeps.
        errors: where it is told.
        quiet: whether it is not.

    Raises:
        InputError: the plan cannot be read, or is of another instrument.
        InputErrorText: there is no plan, or no reading of the monitor.
    """
    return followed(history, planned(history, plan), errors, quiet)


def planned(history: History, plan: Path | None) -> OperationSetup:
    """Return the plan in a file, or that of the record. Raises InputErrorText: the record keeps none."""
    setup = plan_of(history, plan)
    if setup is None:
        raise InputErrorText(
            f"the record keeps no plan of operation; name one, or keep one: python -m twin.operate init RECORD "
            f"{history.name} --plan FILE"
        )
    return setup


def followed(history: History, setup: OperationSetup, errors: Console, quiet: bool = False) -> Operation:
    """The same of a plan that was read."""
    from scenes.yaml.errors import Problem
    from twin.operate.estimate.operation import Operation
    from twin.operate.record.entries import one_line

    standing = Standing("follow the record")
    try:
        with heartbeat(errors, standing.__str__, quiet):
            made = Operation(history, setup, lambda done, of: standing.advance("readings", done, of))
            made.follow()
    except Problem as problem:
        raise InputErrorText(f"{history.url}: {one_line(problem)}") from None
    return made


def known_of(operation: Operation) -> tuple[Following, list[Alarm]]:
    """What is known after all readings, and the alarms that are new, which are then in the record."""
    from twin.operate.estimate.alarms import raise_alarms

    following = operation.follow()
    return following, raise_alarms(operation.history, operation.plan.operation, following)
