"""Base jobs that run one test: those of the laboratory and those in orbit, one run after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optics.aim import AimError
from optics.backend import Backend
from optics.trace import BeamMissedError
from scenes.errors import InputError
from scenes.spec import Spec
from scenes.translate import validate
from scenes.yaml_file import YamlFile
from twin.report.svg import undrawn
from twin.study.base_job import Failure, Outcome, Run
from twin.study.config_tree import Tree, with_values
from twin.trial.bench_error import BenchError
from twin.trial.result import Advance, LabResult, silent

PHYSICS = (InputError, BenchError, AimError, BeamMissedError, ValueError, ArithmeticError)
"""What says that a run cannot be. All errors of the analysis are ValueErrors."""


@dataclass(frozen=True)
class BenchBase:
    """A test as ``twin.trial.command.run_test`` runs it.

    Attributes:
        model: the set-up.
        read: file -> set-up.
        run: set-up, backend, seed and progress -> result.
    """

    model: type[Spec]
    read: Callable[[Path | str], Spec]
    run: Callable[[Any, Backend, int, Advance], LabResult]

    @property
    def block(self) -> int:
        """One: nothing is gained by doing several together, and each is kept as soon as it is done."""
        return 1

    def resolve(self, file: Path | str) -> Spec:
        """Read the test with all it refers to. Raises InputError."""
        return self.read(file)

    def check(self, tree: Tree, backend: Backend) -> None:
        """Nothing more can be told before a run."""

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Outcome of every run, one after the other."""
        return [self._one(tree, run, backend) for run in runs]

    def _one(self, tree: Tree, run: Run, backend: Backend) -> Outcome:
        try:
            setup: Any = validate(self.model, YamlFile("", with_values(tree, run.values), {}))
            with undrawn():
                result = self.run(setup, backend, setup.test.seed if run.seed is None else run.seed, silent)
        except PHYSICS as error:
            return Failure(one_line(error))
        return {result.kind: dict(result.data)}


def one_line(error: Exception) -> str:
    """What went wrong, on one line; an input error without the file it does not have."""
    return "; ".join(line.strip().removeprefix("input: ") for line in str(error).splitlines() if line.strip())
