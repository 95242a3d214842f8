"""What every command takes of memory and time: for each of them its model, or the reason why it needs none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from scenes.specs.procedures import PROCEDURES, Brief
from scenes.yaml.named import Named

if TYPE_CHECKING:
    from twin.run.cost import Cost

COSTS: Mapping[str, Named | Brief] = {
    "render": Named("twin.main_job.render_cost:render_cost"),
    "uncertainty": Named("twin.uncertainty.coverage_cost:coverage_cost"),
}
"""Command after ``camtwin`` -> its model, a function of what the command was given; the tests' own stand in
`PROCEDURES`.
"""


def every_cost() -> dict[str, Any]:
    """Command after ``camtwin`` -> its model or why it needs none; None where neither has been stated."""
    return {**{name: one.cost for name, one in PROCEDURES.items()}, **COSTS}


def model_of(command: str) -> Callable[..., Cost] | None:
    """Model of what a command takes, imported when it is called; None for one that never takes much.

    Args:
        command: its name after ``camtwin``, as ``orbit simulate``.

    Raises:
        LookupError: the command states neither a model nor a reason.
    """
    found = every_cost().get(command)
    if found is None:
        raise LookupError(f"{command}: neither a model of its cost nor a reason why it needs none")
    return None if isinstance(found, Brief) else found
