"""What a job is to a study, and those that run one test, one run after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from analysis.measurement_error import MeasurementError
from optics.numerics.backend import Backend
from optics.numerics.physical_error import PhysicalError
from scenes.specs.procedures import Procedure
from scenes.yaml.errors import InputError, KeyPath
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import YamlFile
from twin.run.procedure import silent
from twin.study.runs.config_tree import Tree, with_values


@dataclass(frozen=True)
class Run:
    """One run of a study.

    Attributes:
        number: from 0.
        values: (place, value) of everything the factors change in the base's tree.
        seed: of its noise; None for the base's own.
    """

    number: int
    values: tuple[tuple[KeyPath, Any], ...]
    seed: int | None


@dataclass(frozen=True)
class Failure:
    """A run that cannot be: light is lost, or its values do not go together.

    Attributes:
        message: why, one line.
    """

    message: str


Outcome = Mapping[str, Any] | Failure
"""Results by file, as the run folder's JSON files without .json hold them; or why there are none."""


class BaseJob(Protocol):
    """A command that a study can vary."""

    @property
    def model(self) -> type[Spec]:
        """What its config.yaml describes."""

    @property
    def block(self) -> int:
        """Consecutive runs that are always evaluated together, whoever does it."""

    def resolve(self, file: Path | str) -> Spec:
        """Read its file, or the name of one in the library, with all it refers to. Raises InputError."""

    def check(self, tree: Tree, backend: Backend) -> None:
        """What can only be told with the job built; called once, in a worker, before the study. Raises InputError."""

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Outcome of every run. The numbers may depend on which runs are done together, but on nothing else."""


PHYSICS = (InputError, PhysicalError, MeasurementError)
"""What says that a run cannot be: its values do not go together, light is lost, a fit finds no end. Any other error is
a fault of the program and stops the study.
"""


@dataclass(frozen=True)
class ProcedureBase:
    """A test, one run after the other; only its numbers are made.

    Attributes:
        procedure: the test.
    """

    procedure: Procedure

    @property
    def model(self) -> type[Spec]:
        """The test's set-up."""
        return self.procedure.model

    @property
    def block(self) -> int:
        """One: nothing is gained by doing several together, and each is kept as soon as it is done."""
        return 1

    def resolve(self, file: Path | str) -> Spec:
        """Read the test with all it refers to. Raises InputError."""
        setup: Any = self.procedure.resolve(file)
        if not isinstance(setup, self.model):
            text = "measurements cannot be varied; a study needs a simulated bench"
            raise setup.test.error(text, ("measured",), allowed="the file of a simulated test")
        return setup

    def check(self, tree: Tree, backend: Backend) -> None:
        """Nothing more can be told before a run."""

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Outcome of every run, one after the other."""
        return [self._one(tree, run, backend) for run in runs]

    def _one(self, tree: Tree, run: Run, backend: Backend) -> Outcome:
        try:
            setup: Any = validate(self.model, YamlFile("", with_values(tree, run.values), {}))
            done = self.procedure.run(setup, backend, setup.test.seed if run.seed is None else run.seed, silent)
            numbers = self.procedure.numbers(done)
        except PHYSICS as error:
            return Failure(one_line(error))
        return {self.procedure.kind: dict(numbers)}


def one_line(error: Exception) -> str:
    """What went wrong, on one line; an input error without the file it does not have."""
    if not str(error).strip():
        return type(error).__name__
    return "; ".join(line.strip().removeprefix("input: ") for line in str(error).splitlines() if line.strip())
