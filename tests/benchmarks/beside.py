"""The benchmarks of an older commit beside those of the sources at hand: whole processes in turns, and their ratios.

Two runs at different times on a shared machine compare its neighbours. Here each benchmark runs once with the old
sources and once with the new ones, one after the other, and again in the opposite order; a ratio is that of two
neighbouring runs, and what is told is the middle of them with the least and the largest.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from rich import box
from rich.console import Console
from rich.table import Table

from scenes.yaml.standard_output import BAD_INPUT
from tests.benchmarks.workbench import shown
from twin.framework.cli import InputErrorText, print_whole

ROOT = Path(__file__).resolve().parents[2]

Numbers = dict[str, float]
Runner = Callable[[Path, str, bool], Numbers | None]


Turns = list[tuple[float, float]]
"""A number of both commits, old and new, in each turn."""


def ratios(turns: Turns) -> list[float]:
    """Return new over old of each turn, ascending; nothing where an old one is 0."""
    return sorted(new / old for old, new in turns) if all(old for old, _ in turns) else []


@contextmanager
def sources_of(commit: str) -> Iterator[tuple[str, Path]]:
    """A commit's full name and its sources in a folder of their own, as long as the context lasts.

    Raises:
        InputErrorText: there is no such commit, or this is no checkout.
    """
    found = _git("rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}")
    if found.returncode:
        raise InputErrorText(f"no commit {commit} in {ROOT}; --beside needs git and a checkout with its history")
    name = found.stdout.strip()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "old"
        made = _git("worktree", "add", "--detach", str(place), name)
        if made.returncode:
            raise InputErrorText(f"the sources of {commit} cannot be written: {made.stderr.strip()}")
        try:
            yield name, place
        finally:
            _git("worktree", "remove", "--force", str(place))


def _git(*arguments: str) -> subprocess.CompletedProcess[str]:
    """What git says; where there is none, as of a command that fails."""
    try:
        return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        return subprocess.CompletedProcess(["git", *arguments], 127, stdout="", stderr=str(error))


def numbers_of(sources: Path, name: str, quick: bool) -> Numbers | None:
    """What a benchmark finds in a process with the given sources; None where they have no benchmark of that name.

    Raises:
        InputErrorText: it broke down.
    """
    command = [sys.executable, "-m", "tests.benchmarks", "--json", "--only", name, *(["--quick"] if quick else [])]
    environment = os.environ | {"PYTHONPATH": str(sources)}
    done = subprocess.run(command, cwd=sources, env=environment, capture_output=True, text=True, check=False)
    if done.returncode == BAD_INPUT:
        return None
    try:
        found = json.loads(done.stdout)[name]
    except (ValueError, KeyError) as error:
        end = "\n".join(done.stderr.strip().splitlines()[-3:])
        raise InputErrorText(f"the benchmark {name} of {sources} ended with {done.returncode}: {end}") from error
    return {key: float(value) for key, value in found.items()}


def compared(
    names: Sequence[str], old: Path, rounds: int, quick: bool, tell: Callable[[str], None], run: Runner = numbers_of
) -> tuple[dict[str, Turns], list[str]]:
    """Return both commits' numbers, in turns, and remarks on what only one has.

    Args:
        names: of the benchmarks.
        old: sources of the older commit; the new ones are those that run.
        rounds: of both.
        quick: small sizes.
        tell: gets what is about to run.
        run: the benchmark of some sources; another one is for tests.
    """
    pairs: dict[str, Turns] = {}
    remarks: list[str] = []
    for name in names:
        for turn in range(rounds):
            found: dict[Path, Numbers | None] = {}
            for where in (old, ROOT) if turn % 2 == 0 else (ROOT, old):
                tell(f"{name}, {'new' if where == ROOT else 'old'}, {turn + 1} of {rounds}")
                found[where] = run(where, name, quick)
                if found[where] is None:
                    break
            before, after = found[old], found.get(ROOT)
            if before is None or after is None:
                remarks.append(f"{name}: the older commit has no such benchmark")
                break
            for key in after:
                if key in before:
                    pairs.setdefault(f"{name}.{key}", []).append((before[key], after[key]))
                elif turn == 0:
                    remarks.append(f"{name}: the older commit has no {key}")
    return pairs, remarks


def print_pairs(console: Console, commit: str, pairs: dict[str, Turns], remarks: Sequence[str]) -> None:
    """Print the table: middle values, and the ratio with its least and largest."""
    table = Table(title=f"Beside {commit[:8]}", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for head, side in (("number", "left"), ("old", "right"), ("new", "right"), ("new / old", "right")):
        table.add_column(head, justify=side, no_wrap=True)  # type: ignore[arg-type]
    for key, turns in pairs.items():
        every = ratios(turns)
        spread = f" ({every[0]:.2f} to {every[-1]:.2f})" if len(every) > 1 else ""
        old, new = (shown(median(side)) for side in zip(*turns, strict=True))
        table.add_row(key, old, new, f"{median(every):.2f}{spread}" if every else "")
    print_whole(console, table)
    for line in remarks:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
