"""Runs the tests against one fault after the other, each worker in a copy of the tree of its own."""

from __future__ import annotations

import json
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Literal

import typer

from tests.mutation.coverage_map import CoverageMap
from tests.mutation.mutants import Mutant
from tests.mutation.warm_pytest import WarmPytest

Fate = Literal["killed", "survived", "uncovered"]
Mode = Literal["round", "first", "every"]
"""When a mutant's tests end: after the round that killed it, at the first test that fails, or never."""
STAGES = ((25.0, 3), (60.0, 10_000), (120.0, 10_000))
"""For each round of tests its seconds at the most (without any fault) and how many cases of one test function.

The last round takes whole files: a fixture that lasts the session or a cached function is run by the first test alone
that asks.
"""
_STARTING = 60
"""Processor seconds that starting pytest and compiling kernels may take, beside ten times what the tests take.

Not time on the clock, for a busy machine must not make a mutant look as if it hung."""


@dataclass(frozen=True)
class Verdict:
    """What became of one mutant.

    Attributes:
        mutant: the fault.
        fate: "killed" by a test that failed or hung, "survived" all that run its lines, "uncovered" where none does.
        killers: every test that failed in the rounds that ran; "time" or the exit code where none can be named.
        tests: how many tests ran at the most.
        seconds: how long it took.
    """

    mutant: Mutant
    fate: Fate
    killers: tuple[str, ...]
    tests: int
    seconds: float

    def as_json(self) -> dict[str, object]:
        """A line of the results' file."""
        return {"key": self.mutant.key, **asdict(self)}


def read_verdicts(file: Path) -> dict[str, Verdict]:
    """The results so far, by the mutants' keys; a later line replaces an earlier one."""
    found: dict[str, Verdict] = {}
    if file.exists():
        for line in file.read_text().splitlines():
            entry = json.loads(line)
            key = entry.pop("key")
            fields = entry.pop("mutant")
            mutant = Mutant(**{**fields, "line": tuple(fields["line"]), "span": tuple(fields["span"])})
            found[key] = Verdict(mutant=mutant, **entry | {"killers": tuple(entry["killers"])})
    return found


def run_campaign(
    root: Path,
    chosen: list[Mutant],
    known: CoverageMap,
    results: Path,
    workers: int,
    most: int = 3,
    mode: Mode = "round",
    last: Collection[str] = (),
    say: bool = True,
) -> None:
    """Try every mutant, in ``most`` rounds of tests, and add a line to the results as soon as its fate is known.

    Tests of ``last`` (files, functions or single cases) have rounds of their own after all others.
    """
    with _copies(root, workers) as copies, ExitStack() as stack, ThreadPoolExecutor(workers) as pool:
        free: queue.SimpleQueue[tuple[Path, WarmPytest]] = queue.SimpleQueue()
        for copy in copies:
            free.put((copy, stack.enter_context(WarmPytest())))

        def work(mutant: Mutant) -> Verdict:
            copy, warm = free.get()
            try:
                return try_mutant(warm, copy, mutant, known, most, mode, last)
            finally:
                free.put((copy, warm))

        started, done = time.monotonic(), 0
        with results.open("a") as stream:
            for future in as_completed([pool.submit(work, mutant) for mutant in chosen]):
                verdict = future.result()
                stream.write(json.dumps(verdict.as_json()) + "\n")
                stream.flush()
                done += 1
                if say:
                    left = (time.monotonic() - started) / done * (len(chosen) - done)
                    where = f"{verdict.mutant.path}:{verdict.mutant.line[0]}"
                    text = f"{done}/{len(chosen)} {verdict.fate} {where}; about {left / 60:.0f} min left"
                    typer.echo(text, err=True)


def try_mutant(
    warm: WarmPytest,
    copy: Path,
    mutant: Mutant,
    known: CoverageMap,
    most: int = 3,
    mode: Mode = "round",
    last: Collection[str] = (),
) -> Verdict:
    """Put a fault into a copy of the tree, run the tests that meet it, quick ones first, and take it out again."""
    started = time.monotonic()
    if not known.covering(mutant.path, mutant.line):
        return Verdict(mutant, "uncovered", (), 0, 0.0)
    file = copy / mutant.path
    source = file.read_bytes()
    file.write_bytes(mutant.applied(source))
    count = 0
    killers: list[str] = []
    try:
        for tests in chain(*(islice(rounds(part, mutant), most) for part in known.parts(last))):
            count += len(tests)
            killers += _killers(warm, copy, tests, sum(known.seconds[name] for name in tests), mode == "first")
            if killers and mode != "every":
                break
    finally:
        file.write_bytes(source)
    fate: Fate = "killed" if killers else "survived"
    return Verdict(mutant, fate, tuple(killers), count, time.monotonic() - started)


def rounds(known: CoverageMap, mutant: Mutant) -> Iterator[list[str]]:
    """Tests of each round, which run together."""
    covering = known.covering(mutant.path, mutant.line)
    files = {name.split("::")[0] for name in covering}
    whole = sorted(
        (name for name in known.seconds if name.split("::")[0] in files), key=lambda name: known.seconds[name]
    )
    ran: set[str] = set()
    for (seconds, cases), names in zip(STAGES, (covering, covering, whole), strict=True):
        tests: list[str] = []
        count: Counter[str] = Counter()
        for name in names:
            function = name.split("[")[0]
            if name in ran or count[function] >= cases:
                continue
            # One test may be longer than the round: the only one that meets the line is not left out for its length.
            if tests and seconds < known.seconds[name]:
                break
            seconds -= known.seconds[name]
            count[function] += 1
            tests.append(name)
        if tests:
            ran |= set(tests)
            yield tests


def _killers(warm: WarmPytest, copy: Path, tests: list[str], seconds: float, first: bool) -> list[str]:
    """Those of the tests that fail, or the first of them."""
    words = ["-q", "-n", "0", "-p", "no:cacheprovider", "--tb=no", "-rfE", "-m", "", *(["-x"] if first else [])]
    limit = _STARTING + int(10.0 * seconds)
    told, arguments = copy / ".told", copy / ".arguments"
    # Arguments in a file: there can be thousands.
    arguments.write_text("\n".join(tests))
    ended = warm.run(copy, [*words, f"@{arguments}"], told, limit)
    if ended in (-signal.SIGXCPU, -signal.SIGKILL):
        return ["time"]
    if ended == 0:
        return []
    failed = [line for line in told.read_text().splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return [line.split(" ", 1)[1].split(" - ")[0] for line in failed] or [f"exit {ended}"]


@contextmanager
def _copies(root: Path, workers: int) -> Iterator[list[Path]]:
    """Copies of the tree without what is made, with byte code that is checked by its source's hash."""
    made = shutil.ignore_patterns(".*", "runs", "build", "dist", "__pycache__", "*.egg-info")
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copies = [Path(folder) / str(number) for number in range(workers)]
        for copy in copies:
            shutil.copytree(root, copy, ignore=made)
            # By time stamps, a fault put in within the second of the last run would go unseen.
            compile_all = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash", "."]
            subprocess.run(compile_all, cwd=copy, check=True, stdout=subprocess.DEVNULL)
        yield copies
