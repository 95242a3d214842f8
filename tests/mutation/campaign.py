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
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import pytest
import typer

from tests.mutation.coverage_map import CoverageMap
from tests.mutation.fork_server import ForkServer
from tests.mutation.mutants import Mutant

Fate = Literal["killed", "survived", "uncovered"]
STAGES = ((6.0, 2, False), (30.0, 4, True), (30.0, 8, False))
"""For each round of tests its seconds at the most (without any fault), how many cases of one test function, and whether
they are golden runs, which compare all numbers of a command and come before the many tests that compare a few."""
GOLDEN = "tests/golden/"
_STARTING = 40
"""Processor seconds that starting and compiling kernels may take, beside five times what the tests take.

Not time on the clock, for a busy machine must not make a mutant look as if it hung."""


@dataclass(frozen=True)
class Verdict:
    """What became of one mutant.

    Attributes:
        mutant: the fault.
        fate: "killed" by a test that failed or hung, "survived" all that run its lines, "uncovered" where none does.
        killers: the tests that failed; "time" or the exit code where none can be named.
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


def run_campaign(root: Path, chosen: list[Mutant], known: CoverageMap, results: Path, workers: int) -> None:
    """Try every mutant and add a line to the results as soon as its fate is known."""
    with _copies(root, workers) as copies, ExitStack() as stack, ThreadPoolExecutor(workers) as pool:
        free: queue.SimpleQueue[ForkServer] = queue.SimpleQueue()
        servers = [stack.enter_context(ForkServer(copy)) for copy in copies]
        known = known.of_tests(_collected(servers[0]).__contains__)
        for server in servers:
            free.put(server)

        def work(mutant: Mutant) -> Verdict:
            server = free.get()
            try:
                return try_mutant(server, mutant, known)
            finally:
                free.put(server)

        started, done = time.monotonic(), 0
        with results.open("a") as stream:
            for future in as_completed([pool.submit(work, mutant) for mutant in chosen]):
                verdict = future.result()
                stream.write(json.dumps(verdict.as_json()) + "\n")
                stream.flush()
                done += 1
                left = (time.monotonic() - started) / done * (len(chosen) - done)
                where = f"{verdict.mutant.path}:{verdict.mutant.line[0]}"
                typer.echo(f"{done}/{len(chosen)} {verdict.fate} {where}; about {left / 60:.0f} min left", err=True)


def try_mutant(server: ForkServer, mutant: Mutant, known: CoverageMap) -> Verdict:
    """Put a fault into the server's tree, run the tests that meet it, quick ones first, and take it out again."""
    started = time.monotonic()
    if not known.covering(mutant.path, mutant.line):
        return Verdict(mutant, "uncovered", (), 0, 0.0)
    file = server.tree / mutant.path
    source = file.read_bytes()
    file.write_bytes(mutant.applied(source))
    count = 0
    killers: list[str] = []
    try:
        for tests in rounds(known, mutant):
            count += len(tests)
            killers = _killers(server, mutant.path, tests, sum(known.seconds[name] for name in tests))
            if killers:
                break
    finally:
        file.write_bytes(source)
    fate: Fate = "killed" if killers else "survived"
    return Verdict(mutant, fate, tuple(killers), count, time.monotonic() - started)


def rounds(known: CoverageMap, mutant: Mutant) -> Iterator[list[str]]:
    """Yield the tests of each round, which run together.

    Of a fixture that several tests of a file share only the first is seen to run its lines, so that in the last round
    the others of these files follow.
    """
    covering = known.covering(mutant.path, mutant.line)
    # Hundreds of cases pass a condition; those that meet it run the next line as well, and come first.
    meeting = set(known.covering(mutant.path, (mutant.line[1] + 1, mutant.line[1] + 1)))
    covering.sort(key=lambda name: name not in meeting)
    files = {name.split("::")[0] for name in covering if not name.startswith(GOLDEN)}
    beside = sorted(known.seconds.keys() - set(covering), key=lambda name: (known.seconds[name], name))
    beside = [name for name in beside if name.split("::")[0] in files]
    ran: set[str] = set()
    for seconds, cases, golden in STAGES:
        tests: list[str] = []
        count: Counter[str] = Counter()
        for name in [*covering, *beside] if ran and not golden else covering:
            function = name.split("[")[0]
            if name in ran or count[function] >= cases or name.startswith(GOLDEN) != golden:
                continue
            # One test may be longer than the round: the only one that meets the line is not left out for its length.
            if tests and seconds < known.seconds[name]:
                continue
            seconds -= known.seconds[name]
            count[function] += 1
            tests.append(name)
        if tests:
            ran |= set(tests)
            yield tests


def _killers(server: ForkServer, path: str, tests: list[str], seconds: float) -> list[str]:
    """The first of the tests that fails."""
    words = ["-q", "-n", "0", "-p", "no:cacheprovider", "--tb=no", "-rfE", "-m", "", "-x"]
    told, arguments = server.tree / ".told", server.tree / ".arguments"
    # Arguments in a file: there can be thousands.
    arguments.write_text("\n".join(tests))
    ended = server.run([*words, f"@{arguments}"], told, _STARTING + int(5.0 * seconds), path)
    if ended in (-signal.SIGXCPU, -signal.SIGKILL):
        return ["time"]
    if ended == 0:
        return []
    if ended in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
        # A fault that hinders the import of a test's file ends as an error of collection, which is another code.
        raise RuntimeError(f"pytest found no such tests: {told.read_text(errors='replace')[-500:]}")
    failed = [line for line in told.read_text(errors="replace").splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return [line.split(" ", 1)[1].split(" - ")[0] for line in failed] or [f"exit {ended}"]


def _collected(server: ForkServer) -> set[str]:
    """The names of all tests that there are now."""
    told = server.tree / ".told"
    server.run(["--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", ""], told, 600)
    return {line for line in told.read_text(errors="replace").splitlines() if "::" in line}


@contextmanager
def _copies(root: Path, workers: int) -> Iterator[list[Path]]:
    """Copies of the tree without what is made, with byte code that is checked by its source's hash."""
    hidden = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info")

    def made(folder: str, names: list[str]) -> set[str]:
        """What is not source: hidden files, and the folders of results at the top."""
        return {*hidden(folder, names), *({"runs", "build", "dist"} if Path(folder) == root else ())}

    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copies = [Path(folder) / str(number) for number in range(workers)]
        for copy in copies:
            shutil.copytree(root, copy, ignore=made)
            # By time stamps, a fault put in within the second of the last run would go unseen.
            compile_all = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash", "."]
            subprocess.run(compile_all, cwd=copy, check=True, stdout=subprocess.DEVNULL)
        yield copies
