"""Hunt for corrupted files that a command takes wrongly: `python -m tests.robustness [N] [FIRST] [KIND]`.

N files (500), beginning with number FIRST of every case (0), of one KIND of file or one case only. They come one after
the other in this process; the case that runs is shown, so that a crash tells which it was.

One of them again, with its files kept in a folder:

    python -m tests.robustness 1 17 lab-focus --keep /tmp/mutant
"""

from __future__ import annotations

import argparse
import faulthandler
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tests.daily import report
from tests.robustness.case import Case
from tests.robustness.cases import cases
from tests.robustness.spoilt_run import Outcome, mutant, run_mutant, write_files


def spread(count: int, first: int, table: Mapping[str, Case]) -> list[tuple[str, int]]:
    """Return which mutants make ``count``: spread over the cases by their weights, from number ``first`` of each.

    One of every case comes after the other, so that a part of them is of all kinds, too.
    """
    total = sum(case.weight for case in table.values())
    own = {name: max(1, -(-int(1e6 * count * case.weight / total) // 1_000_000)) for name, case in table.items()}
    return [(name, first + k) for k in range(max(own.values())) for name in table if k < own[name]]


def run_many(
    which: Sequence[tuple[str, int]], root: Path, table: Mapping[str, Case], depth: str = ""
) -> Iterator[Outcome]:
    """Yield what becomes of many mutants in this process, one after the other."""
    for name, number in which:
        print(f"{name} {number}", file=sys.stderr, end="      \r")
        yield run_mutant(table[name], number, root, depth=depth)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=500)
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("kind", nargs="?", help="only this kind of file, or this case")
    parser.add_argument("--bases", type=Path, help="folder that keeps the run folders that are opened, for next time")
    parser.add_argument("--keep", type=Path, help="write the mutant's files there")
    parser.add_argument("--whole", action="store_true", help="let the commands run to their ends")
    options = parser.parse_args()
    faulthandler.enable()
    with tempfile.TemporaryDirectory(prefix="corrupted-") as name:
        table = cases((options.bases or Path(name) / "bases").absolute())
        table = {k: case for k, case in table.items() if options.kind in (None, k, case.kind)}
        if options.keep:
            options.keep.mkdir(parents=True)
            case = table[options.kind]
            write_files(case, options.keep, mutant(case, options.first).content)
        which = spread(options.count, options.first, table)
        return bool(report(run_many(which, Path(name), table, "whole" if options.whole else "")))


if __name__ == "__main__":
    sys.exit(main())
