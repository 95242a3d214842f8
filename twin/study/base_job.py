"""The jobs that a study can vary: how each is read and run, and what a run of it gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from optics.backend import Backend
from scenes.errors import KeyPath
from scenes.spec import Spec
from twin.study.config_tree import Tree


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
