"""Which tests run which line: measured once.

Each file of tests has a process of its own, so that none profits from another's fixtures.
"""

from __future__ import annotations

import json
import queue
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import coverage
import typer

from tests.mutation.warm_pytest import WarmPytest


def belongs(name: str, tests: Collection[str]) -> bool:
    """Whether a test is among some files, functions or single cases."""
    return not {name, name.split("[")[0], name.split("::")[0]}.isdisjoint(tests)


@dataclass(frozen=True)
class CoverageMap:
    """Lines and the tests that run them.

    Attributes:
        tests: source file -> line -> names of tests; a test named "" stands for the import of the module.
        seconds: test -> how long it takes, with its fixtures; only tests that pass without any fault put in.
    """

    tests: dict[str, dict[int, list[str]]]
    seconds: dict[str, float]

    def covering(self, path: str, lines: tuple[int, int]) -> list[str]:
        """The tests that run one of the lines, the quickest first; for what runs at import, all that run the file.

        A test that is the first of its own file to import the module runs such lines, too, and is not the only one.
        """
        by_line = self.tests.get(path, {})
        names = {name for line in range(lines[0], lines[1] + 1) for name in by_line.get(line, [])}
        if "" in names:
            names = {name for found in by_line.values() for name in found}
        return sorted(names & self.seconds.keys(), key=lambda name: (self.seconds[name], name))

    def parts(self, last: Collection[str]) -> tuple[CoverageMap, CoverageMap]:
        """The map of all tests but some, and that of these."""
        late = {name: seconds for name, seconds in self.seconds.items() if belongs(name, last)}
        rest = {name: seconds for name, seconds in self.seconds.items() if name not in late}
        return replace(self, seconds=rest), replace(self, seconds=late)


def read_map(folder: Path, root: Path) -> CoverageMap:
    """The map from what `measure` left in a folder."""
    tests: dict[str, dict[int, list[str]]] = {}
    seconds: dict[str, float] = {}
    for file in sorted(folder.glob("*.coverage")):
        times = file.with_suffix(".json")
        if not times.exists():
            continue
        seconds |= json.loads(times.read_text())
        data = coverage.CoverageData(basename=str(file))
        data.read()
        for source in data.measured_files():
            by_line = tests.setdefault(Path(source).relative_to(root).as_posix(), {})
            for line, names in data.contexts_by_lineno(source).items():
                by_line.setdefault(line, []).extend(names)
    return CoverageMap(tests, seconds)


def measure(root: Path, files: list[Path], places: tuple[str, ...], folder: Path, workers: int) -> list[Path]:
    """Run files of tests under coverage; those measured before are left out.

    Returns:
        The files for which nothing could be measured.
    """
    folder.mkdir(parents=True, exist_ok=True)
    free: queue.SimpleQueue[WarmPytest] = queue.SimpleQueue()

    def run(file: Path) -> bool:
        target = folder / (file.relative_to(root).as_posix().replace("/", "__") + ".coverage")
        if target.exists() and target.with_suffix(".json").exists():
            return True
        more = {
            "TWIN_COVERED": ",".join(str(root / place) for place in places),
            "TWIN_COVERAGE_FILE": str(target),
        }
        words = ["-q", "-n", "0", "-p", "tests.mutation.coverage_plugin", str(file)]
        warm = free.get()
        try:
            ended = warm.run(root, words, target.with_suffix(".told"), more=more)
        finally:
            free.put(warm)
        done = target.exists() and target.with_suffix(".json").exists()
        # tests that fail without any fault find none
        fails = f"; some of its tests fail, see {target.with_suffix('.told')}" if ended == 1 else ""
        typer.echo(f"{'coverage of' if done else 'NO coverage of'} {file.relative_to(root)}{fails}", err=True)
        return done

    with ExitStack() as stack, ThreadPoolExecutor(workers) as pool:
        for _ in range(workers):
            free.put(stack.enter_context(WarmPytest()))
        done = list(pool.map(run, files))
    return [file for file, good in zip(files, done, strict=True) if not good]
