"""Which tests run which line: measured once, in one run of all tests."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import coverage

from tests.mutation.fork_server import PACKAGES


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

    def of_tests(self, stays: Callable[[str], bool]) -> CoverageMap:
        """The map of some of the tests."""
        return CoverageMap(self.tests, {name: seconds for name, seconds in self.seconds.items() if stays(name)})


def read_map(folder: Path) -> CoverageMap:
    """The map from what `measure` left in a folder, whatever tree it was measured in."""
    tests: dict[str, dict[int, list[str]]] = {}
    seconds: dict[str, float] = {}
    for times in folder.glob("*.json"):
        for name, value in json.loads(times.read_text()).items():
            # Workers tell of their own tests, the one that started them of all.
            seconds[name] = max(seconds.get(name, 0.0), value)
    for file in sorted(folder.glob("*.coverage")):
        data = coverage.CoverageData(basename=str(file))
        data.read()
        for source in data.measured_files():
            by_line = tests.setdefault(_below(source), {})
            for line, names in data.contexts_by_lineno(source).items():
                by_line.setdefault(line, []).extend(names)
    return CoverageMap(tests, seconds)


def _below(source: str) -> str:
    """The path from the project's folder: from its outermost package on."""
    parts = Path(source).parts
    first = min(
        k for k, part in enumerate(parts) if part in PACKAGES and (Path(*parts[: k + 1]) / "__init__.py").exists()
    )
    return Path(*parts[first:]).as_posix()


def measure(root: Path, folder: Path, workers: int, files: Iterable[str] = ()) -> int:
    """Run the tests under coverage, by default all; returns pytest's exit code."""
    folder.mkdir(parents=True, exist_ok=True)
    # A test that measures is a worker's own, whose number would be taken for that of a worker here.
    outer = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
    environment = outer | {"TWIN_COVERAGE_OUT": str(folder.resolve()), "PYTHONPATH": str(root)}
    words = ["-q", "-n", str(workers), "-m", "", "--tb=line", "-p", "tests.mutation.coverage_plugin", *files]
    return subprocess.run([sys.executable, "-m", "pytest", *words], cwd=root, env=environment).returncode
