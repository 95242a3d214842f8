"""The benchmarks: `python -m tests.benchmarks [--only trace,psf] [--quick] [--json] [--beside COMMIT]`."""

from __future__ import annotations

import json
import os
import platform
import sys
from importlib import import_module
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from optics.numerics.backend import cores
from tests.benchmarks.beside import compared, print_pairs, ratios, sources_of
from tests.benchmarks.workbench import Speed, Workbench, shown
from twin.framework.cli import InputErrorText, explained, print_whole
from twin.framework.durable import exit_on_terminate
from twin.framework.provenance import Provenance

BENCHMARKS = {
    "study": ("a study of ten thousand states", 300),
    "trace": ("sequential trace beside batoid and optiland", 52),
    "psf": ("image of a far point beside poppy", 8),
    "monitor": ("a batch of states of the monitor", 40),
    "growth": ("how processor time grows with states, pixels, bodies and frames", 500),
    "record": ("one reading more in the record of an instrument", 340),
    "block": ("a block of a hundred scenes with a million tie points", 600),
    "live": ("the live twin: from a state that is sent to the server's answer", 30),
    "start": ("help, the main job with an empty and a filled cache", 90),
}
"""Name -> what is measured, by ``measure`` of the module NAME_speed, and seconds that it takes on two cores. `study`
comes first: it counts this process's memory, which then holds nothing of the others."""
HELP = """Measure how fast everything is.

Ratios to other people's software are taken in turns with it, so that a busy machine is busy for both; software that is
not installed is skipped by name (pip install '.[oracles]'). Times alone say little on a machine that others use, too:
compare sources with --beside.

Examples:

  python -m tests.benchmarks                        all, some forty minutes on two cores\n
  python -m tests.benchmarks --list                 what there is\n
  python -m tests.benchmarks --only trace,psf       some of it\n
  python -m tests.benchmarks --quick                small sizes: does everything run?\n
  python -m tests.benchmarks --json > speed.json    numbers on stdout, progress on stderr\n
  python -m tests.benchmarks --beside v1.0 --only monitor    an older commit in turns with these sources: ratios

Exit code: 0 measured, 2 bad input.
"""
app = typer.Typer(add_completion=False, rich_markup_mode=None)


def chosen(only: str | None) -> list[str]:
    """Return the names of a list with commas, in the order of BENCHMARKS.

    Raises:
        InputErrorText: there is none of that name.
    """
    names = list(BENCHMARKS) if only is None else [name.strip() for name in only.split(",") if name.strip()]
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown or not names:
        raise InputErrorText(f"no benchmark {', '.join(unknown) or repr(only)}; choose from {', '.join(BENCHMARKS)}")
    return [name for name in BENCHMARKS if name in names]


def print_speeds(console: Console, speeds: dict[str, Speed]) -> None:
    """Print all numbers as a table, with the remarks below it."""
    table = Table(title="Speed", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for head, side in (("what", "left"), ("measured", "right"), ("unit", "left")):
        table.add_column(head, justify=side, no_wrap=True)  # type: ignore[arg-type]
    for speed in speeds.values():
        for number in speed.numbers:
            table.add_row(number.text, shown(number.value), number.unit)
        table.add_section()
    print_whole(console, table)
    for note in (note for speed in speeds.values() for note in speed.notes):
        console.print(note, markup=False, highlight=False, soft_wrap=True)


@app.command(help=HELP)
def main(
    only: Annotated[str | None, typer.Option(help="Names with commas between them; see --list.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes, some seconds each.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout, and nothing else.")] = False,
    beside: Annotated[
        str | None, typer.Option(metavar="COMMIT", help="Run these sources and a commit's in turns: ratios.")
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Of both, with --beside.")] = 3,
    show: Annotated[bool, typer.Option("--list", help="Print the names and what they measure.")] = False,
) -> None:
    """Measure and print."""
    console, errors = Console(), Console(stderr=True)
    here = Provenance.here()
    where = {"processor": here.processor, "cores": cores(), "system": platform.platform(), "load": os.getloadavg()[0]}

    def tell(text: str) -> None:
        errors.print(text, markup=False, highlight=False, soft_wrap=True)

    with explained(errors), exit_on_terminate():
        todo = chosen(only)
        if show:
            for name in todo:
                console.print(f"{name:12} {BENCHMARKS[name][0]}, about {BENCHMARKS[name][1]} s", highlight=False)
            return
        if beside is not None:
            with sources_of(beside) as (name, old):
                pairs, notes = compared(todo, old, rounds, quick, tell)
            data = {"old": name, "numbers": pairs, "ratios": {key: ratios(turns) for key, turns in pairs.items()}}
            data |= {"notes": notes, "machine": where, "quick": quick}
        else:
            bench, speeds = Workbench(), {}
            for name in todo:
                tell(f"{name}: {BENCHMARKS[name][0]}")
                speeds[name] = import_module(f"tests.benchmarks.{name}_speed").measure(bench, quick)
            notes = [note for speed in speeds.values() for note in speed.notes]
            data = {name: speed.data for name, speed in speeds.items()}
            data |= {"machine": where, "quick": quick, "notes": notes}
    if as_json:
        json.dump(data, sys.stdout, indent=2, allow_nan=False)
        sys.stdout.write("\n")
    elif beside is not None:
        print_pairs(console, data["old"], pairs, notes)
    else:
        print_speeds(console, speeds)
        console.print(where, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    app(prog_name="python -m tests.benchmarks")
