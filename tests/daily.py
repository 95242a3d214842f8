"""Random cases: those that once failed or were chosen, which are kept, and new ones every day.

A case is known by its number, from which all of it is drawn. The numbers of a day begin with ``first_of_today()``,
which pytest prints in its header; RANDOM_CASES=NUMBER repeats the cases of another day.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Protocol


class Outcome(Protocol):
    """What became of a case."""

    @property
    def end(self) -> str:
        """What became of it in a word."""

    @property
    def wrong(self) -> str:
        """What must not be; empty if all is well."""


def first_of_today() -> int:
    """Return the number of the day's first case."""
    return int(os.environ.get("RANDOM_CASES", 0)) or 1000 * datetime.now(UTC).toordinal()


def numbers(kept: Sequence[int], new: int) -> list[int]:
    """Return numbers of cases: the kept ones and so many new ones of the day."""
    first = first_of_today()
    return [*kept, *range(first, first + new)]


def require_good(outcomes: Iterable[Outcome]) -> Counter[str]:
    """Return what became of cases, of which none may be wrong."""
    every = list(outcomes)
    wrong = [str(one) for one in every if one.wrong]
    assert not wrong, f"keep these cases in the test's list (today's begin with {first_of_today()}):\n" + "\n".join(
        wrong
    )
    return Counter(one.end for one in every)


def report(outcomes: Iterable[Outcome]) -> int:
    """Print wrong outcomes as they come, and what became of all; return how many are wrong."""
    import typer

    counts: Counter[str] = Counter()
    bad = 0
    for one in outcomes:
        counts[one.end] += 1
        if one.wrong:
            bad += 1
            typer.echo(f"{one}\n")
    typer.echo(f"{counts.total()} cases: {dict(counts)}")
    return bad
