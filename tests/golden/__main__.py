"""Golden runs: `python -m tests.golden --check [--only NAME]`, `python -m tests.golden --write`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from queue import Queue
from typing import Annotated, TypeVar

import typer

from tests.golden.compare import BITWISE, DIFFERENT
from tests.golden.golden import NotComparable, Outcome, check, write
from tests.golden.jobs import ALL, BY_NAME, Job, Runner

T = TypeVar("T")
app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


def chosen(only: str | None) -> list[Job]:
    """Return the jobs named, all for None."""
    if only is None:
        return list(ALL)
    names = [name.strip() for name in only.split(",")]
    unknown = [name for name in names if name not in BY_NAME]
    if unknown:
        typer.echo(f"error: no such job: {', '.join(unknown)}; there are {', '.join(BY_NAME)}", err=True)
        raise typer.Exit(2)
    return [BY_NAME[name] for name in names]


def each(do: Callable[[Job, Runner], T], jobs: list[Job], workers: int) -> Iterator[T]:
    """Yield what comes of every job, in their order; each worker has a process."""
    free: Queue[Runner] = Queue()

    def done(job: Job) -> T:
        runner = free.get()
        try:
            return do(job, runner)
        finally:
            free.put(runner)

    with ExitStack() as stack:
        for _ in range(workers):
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="golden-", dir="/tmp"))
            free.put(stack.enter_context(Runner(Path(folder))))
        yield from stack.enter_context(ThreadPoolExecutor(workers)).map(done, jobs)


def checked(job: Job, runner: Runner) -> Outcome | NotComparable:
    """Return a job compared, or why it cannot be."""
    try:
        return check(job, runner)
    except NotComparable as problem:
        return problem


@app.command()
def main(
    checking: Annotated[bool, typer.Option("--check", help="Run and compare.")] = False,
    writing: Annotated[bool, typer.Option("--write", help="Run and write the golden files anew.")] = False,
    only: Annotated[str | None, typer.Option(help="Names of jobs, with commas between them.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="How many jobs at once.")] = 1,
    bitwise: Annotated[bool, typer.Option("--bitwise", help="With --check: nothing may differ at all.")] = False,
) -> None:
    """Run every command on a small job and compare all that it computes with what it computed before.

    Compared are exit codes, printed texts, names of files, and what is in them: numbers and texts of JSON, CSV and
    YAML, variables of netCDF, pixels, texts and lines of drawings, tables and prose of reports, geometry of scenes.
    Times, versions, paths and checksums of files are not.

    Examples:

      python -m tests.golden --check                      all jobs; every difference, with both values
      python -m tests.golden --check --only design,schema some of them
      python -m tests.golden --write --only design        after a change that is meant to change numbers

    Any processor and any versions of the packages will do: a number may move by a thousandth of its standard deviation
    or by 1e-7 of itself (tests/golden/compare.py). Other packages are named.

    Exit code: 0 nothing differs by more than that, 1 something does or could not be compared, 2 bad input.
    """
    if checking == writing:
        typer.echo("error: say either --check or --write", err=True)
        raise typer.Exit(2)
    jobs = chosen(only)
    if writing:
        total = 0
        for job, (size, seconds) in zip(jobs, each(write, jobs, workers), strict=True):
            total += size
            typer.echo(f"{job.name}: {size / 1e3:.1f} kB ({seconds:.1f} s)")
        typer.echo(f"{len(jobs)} golden files, {total / 1e6:.2f} MB")
        return
    bad = 0
    for outcome in each(checked, jobs, workers):
        if isinstance(outcome, NotComparable):
            typer.echo(f"not compared: {outcome}")
            bad += 1
            continue
        typer.echo("\n".join(outcome.lines()))
        status = outcome.comparison.status
        bad += status == DIFFERENT or (bitwise and status != BITWISE)
    typer.echo(f"{len(jobs) - bad} of {len(jobs)} jobs as they were")
    raise typer.Exit(1 if bad else 0)


if __name__ == "__main__":
    app()
