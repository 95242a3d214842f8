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
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from tests.benchmarks.number import shown
from twin.run.cli import BAD_INPUT, InputErrorText, print_whole

ROOT = Path(__file__).resolve().parents[2]

Numbers = dict[str, float]
Runner = Callable[[Path, str, bool], Numbers | None]


@dataclass(frozen=True)
class Pair:
    """A number of both commits.

    Attributes:
        key: benchmark and number, with a dot between them.
        old, new: of each turn, in the same order.
    """

    key: str
    old: tuple[float, ...]
    new: tuple[float, ...]

    @property
    def ratios(self) -> list[float]:
        """New over old of each turn, ascending; empty where an old one is 0."""
        if 0.0 in self.old:
            return []
        return sorted(new / old for old, new in zip(self.old, self.new, strict=True))

    @property
    def data(self) -> dict[str, Any]:
        """For the JSON."""
        ratios = self.ratios
        both: dict[str, Any] = {"old": list(self.old), "new": list(self.new)}
        if not ratios:
            return both
        return both | {"ratio": {"least": ratios[0], "median": median(ratios), "most": ratios[-1]}}


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
) -> tuple[list[Pair], list[str]]:
    """Both commits' numbers, in turns.

    Args:
        names: of the benchmarks.
        old: sources of the older commit; the new ones are those that run.
        rounds: of both.
        quick: small sizes.
        tell: gets what is about to run.
        run: the benchmark of some sources; another one is for tests.

    Returns:
        The numbers that both have, and remarks on what only one has.
    """
    pairs: list[Pair] = []
    remarks: list[str] = []
    for name in names:
        found: dict[Path, list[Numbers]] = {old: [], ROOT: []}
        order = [where for turn in range(rounds) for where in ((old, ROOT) if turn % 2 == 0 else (ROOT, old))]
        for place, where in enumerate(order):
            tell(f"{name}, {'new' if where == ROOT else 'old'}, {place // 2 + 1} of {rounds}")
            numbers = run(where, name, quick)
            if numbers is None:
                break
            found[where].append(numbers)
        if not found[old]:
            remarks.append(f"{name}: the older commit has no such benchmark")
            continue
        keys = list(found[ROOT][0])
        both = [key for key in keys if all(key in one for some in found.values() for one in some)]
        for key in both:
            before, after = (tuple(one[key] for one in found[where]) for where in (old, ROOT))
            pairs.append(Pair(f"{name}.{key}", before, after))
        if only := [key for key in keys if key not in both]:
            remarks.append(f"{name}: the older commit has no {', '.join(only)}")
    return pairs, remarks


def print_pairs(console: Console, commit: str, pairs: Sequence[Pair], remarks: Sequence[str]) -> None:
    """The table: middle values, and the ratio with its least and largest."""
    table = Table(title=f"Beside {commit[:8]}", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for head, side in (("number", "left"), ("old", "right"), ("new", "right"), ("new / old", "right")):
        table.add_column(head, justify=side, no_wrap=True)  # type: ignore[arg-type]
    for pair in pairs:
        ratios = pair.ratios
        spread = f" ({ratios[0]:.2f} to {ratios[-1]:.2f})" if len(ratios) > 1 else ""
        ratio = f"{median(ratios):.2f}{spread}" if ratios else ""
        table.add_row(pair.key, shown(median(pair.old)), shown(median(pair.new)), ratio)
    print_whole(console, table)
    for line in remarks:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
