"""Hunt for spoilt files that a command takes wrongly: `python -m tests.robustness [N] [FIRST] [KIND]`.

N spoilt files (500), beginning with number FIRST of every case (0), of one KIND of file only. They come one after the
other in processes that begin anew now and then; one that crashes is a finding, and the next goes on.

One mutant again, with its files kept in a folder:

    python -m tests.robustness --case lab-focus --number 17 --keep /tmp/mutant
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tests.robustness.case import Case
from tests.robustness.cases import cases
from tests.robustness.spoilt_run import Outcome, mutant, run_mutant, write_files

BATCH = 400
"""Mutants of one process."""
ENDS = ("refused", "built", "ran", "told", "bad")


def numbers(count: int, first: int, table: Mapping[str, Case]) -> list[tuple[str, int]]:
    """Which mutants make ``count``: spread over the cases by their weights, beginning with number ``first`` of each.

    One of every case comes after the other, so that a part of them is of all kinds, too.
    """
    total = sum(case.weight for case in table.values())
    own = {name: max(1, -(-int(1e6 * count * case.weight / total) // 1_000_000)) for name, case in table.items()}
    return [(name, first + k) for k in range(max(own.values())) for name in table if k < own[name]]


@dataclass
class Tally:
    """What came of many mutants."""

    ends: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    seconds: Counter[str] = field(default_factory=Counter)
    bad: list[Outcome] = field(default_factory=list)
    slowest: float = 0.0

    @property
    def codes(self) -> Counter[str]:
        """All kinds together."""
        return sum(self.ends.values(), Counter())

    @property
    def count(self) -> int:
        """Of mutants."""
        return sum(self.codes.values())

    def add(self, one: Outcome) -> None:
        """Count one."""
        self.ends[one.kind][one.end] += 1
        self.seconds[one.kind] += one.seconds
        self.slowest = max(self.slowest, one.seconds)
        if one.wrong:
            self.bad.append(one)

    def table(self) -> str:
        """Kinds and what became of them."""
        head = f"{'kind of file':32s}" + "".join(f"{end:>9s}" for end in (*ENDS, "CPU s"))
        rows = [
            f"{kind:32s}" + "".join(f"{ends[end]:9d}" for end in ENDS) + f"{self.seconds[kind]:9.1f}"
            for kind, ends in sorted(self.ends.items())
        ]
        return "\n".join([head, *rows])


def run_many(which: Sequence[tuple[str, int]], root: Path, table: Mapping[str, Case]) -> Tally:
    """Many mutants in this process, one after the other."""
    tally = Tally()
    for name, number in which:
        tally.add(run_mutant(table[name], number, root))
    return tally


def work(bases: Path) -> None:
    """What a process of a campaign does: mutants from stdin, outcomes to stdout."""
    told = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    table = cases(bases)
    with tempfile.TemporaryDirectory(prefix="spoilt-") as root:
        for name, number in json.loads(sys.stdin.read()):
            told.write(json.dumps([name, number]) + "\n")
            told.flush()
            told.write(json.dumps(asdict(run_mutant(table[name], number, Path(root)))) + "\n")
            told.flush()


def batch(which: Sequence[tuple[str, int]], bases: Path, table: Mapping[str, Case]) -> Iterator[Outcome]:
    """Outcomes of mutants run in a process of their own, and in further ones after a crash."""
    left = list(which)
    # one thread each: the matrices are small
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    while left:
        command = [sys.executable, "-m", "tests.robustness", "--work", str(bases)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(left))
        process.stdin.close()
        begun: tuple[str, int] | None = None
        for line in process.stdout:
            found = json.loads(line)
            if isinstance(found, list):
                begun = (found[0], found[1])
                continue
            begun = None
            left.pop(0)
            yield Outcome(**found)
        code = process.wait()
        if begun is not None:
            name, number = left.pop(0)
            how = mutant(table[name], number).how
            yield Outcome(name, table[name].kind, number, how, "", None, "", 0.0, f"the process ended with {code}")
        elif left and code:
            raise RuntimeError(f"no mutant could be run: exit code {code}")


def campaign(which: Sequence[tuple[str, int]], bases: Path, table: Mapping[str, Case], processes: int) -> Tally:
    """Many mutants in several processes; those that are bad are printed as they come."""
    tally, lock = Tally(), threading.Lock()
    batches = [which[k : k + BATCH] for k in range(0, len(which), BATCH)]

    def one_after_the_other() -> None:
        while True:
            with lock:
                if not batches:
                    return
                own = batches.pop(0)
            for outcome in batch(own, bases, table):
                with lock:
                    tally.add(outcome)
                    if outcome.wrong:
                        print(f"BAD {outcome}\n", flush=True)
            with lock:
                print(f"{tally.count} of {len(which)}: {dict(tally.codes)}", flush=True)

    threads = [threading.Thread(target=one_after_the_other) for _ in range(processes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return tally


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=500)
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("kind", nargs="?", help="only this kind of file, or this case")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument(
        "--bases", type=Path, help="folder that keeps the run folders that are opened, for the next time"
    )
    parser.add_argument("--case", help="only this case")
    parser.add_argument("--number", type=int, help="only this mutant of it")
    parser.add_argument("--keep", type=Path, help="write the mutant's files there")
    parser.add_argument("--whole", action="store_true", help="with --number: let the command run to its end")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options.work)
        return 0
    with tempfile.TemporaryDirectory(prefix="spoilt-") as name:
        bases = (options.bases or Path(name) / "bases").absolute()
        table = cases(bases)
        if options.number is not None:
            case = table[options.case]
            if options.keep:
                options.keep.mkdir(parents=True)
                write_files(case, options.keep, mutant(case, options.number).content)
            one = run_mutant(case, options.number, Path(name), depth="whole" if options.whole else "")
            print(f"{one}\ncode {one.code}")
            return bool(one.wrong)
        wanted = (options.kind, options.case)
        table = {k: case for k, case in table.items() if wanted == (None, None) or {k, case.kind} & set(wanted)}
        began = time.monotonic()
        tally = campaign(numbers(options.count, options.first, table), bases, table, options.processes)
        print(tally.table())
        took, spent = time.monotonic() - began, sum(tally.seconds.values())
        each = f"{spent / max(tally.count, 1):.2f} s each, slowest {tally.slowest:.1f} s"
        print(f"{tally.count} spoilt files of {len(tally.ends)} kinds in {took:.0f} s, {spent:.0f} s of CPU, {each}")
        print(dict(tally.codes))
        return bool(tally.bad)


if __name__ == "__main__":
    sys.exit(main())
