"""The benchmarks page: `python -m tests.benchmarks [--only trace,psf] [--quick] [--json]`."""

from __future__ import annotations

import json
import sys
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from scenes.yaml.standard_output import FAILURE
from tests.benchmarks.beside import compared, print_pairs, sources_of
from tests.benchmarks.limits import Limits, Origin
from tests.benchmarks.machine import Machine
from tests.benchmarks.number import Speed
from tests.benchmarks.page import Page
from tests.benchmarks.registry import BENCHMARKS, Benchmark, measured, running_order
from tests.benchmarks.workbench import Workbench
from twin.run.cli import InputErrorText, explained, progress_columns
from twin.run.durable import exit_on_terminate

HELP = """Measure how fast everything is, in one run, and hold it against its limits.

Ratios to other people's software are taken in turns with it, so that a busy machine is busy for both; software that is
not installed is skipped by name (pip install '.[oracles]'). For numbers to quote, let nothing else run.

Times are told as measured, and as they would be on the machine of reference: fixed calculations, which run before,
between and after the turns of a benchmark, say how much slower this one is. Limits (tests/benchmarks/limits.json) and
targets hold for the machine of reference. What the wall clock measures is not judged while other programs run.

Examples:

  python -m tests.benchmarks                        all, some forty minutes on two cores\n
  python -m tests.benchmarks --list                 what there is\n
  python -m tests.benchmarks --only trace,psf       some of it\n
  python -m tests.benchmarks --quick                small sizes: does everything run?\n
  python -m tests.benchmarks --json > speed.json    numbers on stdout, progress on stderr\n
  python -m tests.benchmarks --beside v1.0 --only monitor    an older commit in turns with these sources: ratios\n
  python -m tests.benchmarks --tighten --only monitor,start    limits of what three rounds reach

Exit code: 0 all limits that are judged are met (a quick run judges none), 1 one is missed, 2 bad input.
"""
app = typer.Typer(add_completion=False, rich_markup_mode=None)


def chosen(only: str | None) -> list[Benchmark]:
    """The benchmarks of a list of names, in the page's order.

    Raises:
        InputErrorText: there is none of that name.
    """
    if only is None:
        return list(BENCHMARKS)
    known = [one.name for one in BENCHMARKS]
    names = [name.strip() for name in only.split(",") if name.strip()]
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputErrorText(f"no benchmark {', '.join(unknown) or repr(only)}; choose from {', '.join(known)}")
    return [one for one in BENCHMARKS if one.name in names]


def run(todo: list[Benchmark], quick: bool, errors: Console) -> dict[str, Speed]:
    """Measure one after the other and tell how long it still takes."""
    bench, found = Workbench(), {}
    cost = {one.name: one.quick_seconds if quick else one.seconds for one in todo}
    left = sum(cost.values())
    with Progress(*progress_columns(28), console=errors, disable=not errors.is_terminal, transient=True) as bar:
        task = bar.add_task("benchmarks", total=left)
        for number, one in enumerate(running_order(todo), start=1):
            bar.update(task, description=one.name)
            if not errors.is_terminal:
                errors.print(f"{number}/{len(todo)} {one.name}: {one.text}; about {left:.0f} s left", soft_wrap=True)
            found[one.name] = measured(one, bench, quick)
            left -= cost[one.name]
            bar.advance(task, cost[one.name])
    return {one.name: found[one.name] for one in todo}


def against(
    commit: str, names: list[str], rounds: int, quick: bool, as_json: bool, consoles: tuple[Console, Console]
) -> None:
    """Run an older commit in turns with these sources, and print the ratios."""
    console, errors = consoles

    def tell(text: str) -> None:
        errors.print(text, markup=False, highlight=False, soft_wrap=True)

    with sources_of(commit) as (name, old):
        pairs, remarks = compared(names, old, rounds, quick, tell)
    if as_json:
        numbers = {pair.key: pair.data for pair in pairs}
        data = {"old": name, "numbers": numbers, "notes": remarks, "machine": Machine.here().data, "quick": quick}
        json.dump(data, sys.stdout, indent=2, allow_nan=False)
        sys.stdout.write("\n")
    else:
        print_pairs(console, name, pairs, remarks)


@app.command(help=HELP)
def main(
    only: Annotated[str | None, typer.Option(help="Names with commas between them; see --list.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes, about a second or some each.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout, and nothing else.")] = False,
    beside: Annotated[
        str | None,
        typer.Option(metavar="COMMIT", help="Run these sources and a commit's in turns; no limit is judged."),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Of both, with --beside; of all, with --tighten.")] = 3,
    tighten: Annotated[
        bool, typer.Option("--tighten", help="Set limits to what is reached and 20 %; none becomes wider.")
    ] = False,
    loosen: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Let this limit become wider, as monitor.cpu_ms_per_state.")
    ] = None,
    why: Annotated[str, typer.Option(metavar="TEXT", help="The reason, kept beside the limit.")] = "",
    show: Annotated[bool, typer.Option("--list", help="Print the names and what they measure.")] = False,
) -> None:
    """Measure, print, judge."""
    console, errors = Console(), Console(stderr=True)
    with explained(errors), exit_on_terminate():
        todo = chosen(only)
        if show:
            for one in todo:
                console.print(f"{one.name:12} {one.text}, about {one.seconds:.0f} s", highlight=False, soft_wrap=True)
            return
        if beside is not None:
            against(beside, [one.name for one in todo], rounds, quick, as_json, (console, errors))
            return
        machine = Machine.here()
        if loosen and not (tighten and why):
            raise InputErrorText("--loosen belongs to --tighten, and needs a reason: --why TEXT")
        if tighten and quick:
            raise InputErrorText("limits hold for full sizes: --tighten without --quick")
        turns = [run(todo, quick, errors) for _ in range(rounds if tighten else 1)]
        limits = Limits.read()
        if tighten:
            limits, lines = limits.tightened(turns, Origin.here(machine), dict.fromkeys(loosen or (), why))
            limits.write()
            for line in lines:
                errors.print(line, markup=False, highlight=False, soft_wrap=True)
        page = Page(machine, turns[-1], quick, limits)
    if as_json:
        json.dump(page.data, sys.stdout, indent=2, allow_nan=False)
        sys.stdout.write("\n")
    else:
        page.print(console)
    if page.missed:
        raise typer.Exit(FAILURE)


if __name__ == "__main__":
    app(prog_name="python -m tests.benchmarks")
