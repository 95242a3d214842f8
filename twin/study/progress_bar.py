"""How far a study is: the bar of the command and of a script, and the line by which a study in a process of its own
tells it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console
    from rich.progress import Progress

Told = Callable[[int, int], None]
"""What is told that so many runs of so many are there."""


def bar_of(console: Console, silent: bool = False) -> Progress:
    """The bar of a study, drawn where the console is a terminal or a notebook, and gone at its end.

    Args:
        console: where it is drawn.
        silent: whether none is drawn.
    """
    # it is not needed to run a study
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("runs"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(elapsed_when_finished=False),
        console=console,
        disable=silent or not (console.is_terminal or console.is_jupyter),
        transient=True,
    )


@contextmanager
def shown_bar() -> Iterator[Told]:
    """A bar on stderr, or in the notebook's cell, while the block lasts."""
    from rich.console import Console

    with bar_of(Console(stderr=True)) as bar:
        task = bar.add_task("runs", total=None, rate="")
        yield lambda done, total: bar.update(task, completed=done, total=total)


def tell_through(descriptor: int) -> Told:
    """What writes the numbers into a pipe, a line each time; a reader that is gone ends nothing.

    Args:
        descriptor: of the pipe, inherited; processes that this one starts do not get it.
    """
    os.set_inheritable(descriptor, False)

    def told(done: int, total: int) -> None:
        with suppress(OSError):
            os.write(descriptor, f"{done} {total}\n".encode())

    return told


def tell_all(lines: Iterable[str], told: Told) -> None:
    """Tell what comes out of such a pipe, until its other end is closed."""
    for line in lines:
        done, total = line.split()
        told(int(done), int(total))
