"""What a test is to whatever runs it: reading its file, running it, its numbers as plain data; and how it fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from optics.numerics.backend import Backend
from scenes.models.camera_sharpness import blur_warnings
from scenes.specs.test_setup import ExperimentSetup
from scenes.yaml.errors import KeyPath

Advance = Callable[[str, int, int], None]
"""Told what is being done, and how many of how many parts of it are."""


def silent(part: str, done: int, total: int) -> None:
    """An ``Advance`` that tells nobody."""


class BenchError(Exception):
    """The test failed on the bench: what happened, which key of its file is to be changed, and how.

    Attributes:
        key: key path in the test's file.
        remedy: what may be there instead.
    """

    def __init__(self, problem: str, key: KeyPath, remedy: str) -> None:
        super().__init__(problem)
        self.key = key
        self.remedy = remedy


Setup = TypeVar("Setup", bound=ExperimentSetup[Any])
Run = TypeVar("Run")


@dataclass(frozen=True)
class Procedure(Generic[Setup, Run]):
    """A test, of whose run a command makes a report and a study takes the numbers.

    No module that a procedure needs draws anything or fills a template.

    Attributes:
        kind: of `twin.run.reference_frames.FRAMES`, for example ``focus``; KIND.json begins with them.
        setup: class of the test with all it refers to; has ``test``, ``with_seed`` and ``to_yaml``.
        resolve: file, or the name of one in the library -> set-up. Raises InputError.
        run: set-up, backend, seed and progress -> everything that was computed. Raises InputError, BenchError.
        numbers: run -> what KIND.json holds, plain data; keys end in their unit.
        warnings: set-up and backend -> what is wrong with what the test is given, beside what its report warns of.
        seeded: whether anything is drawn at random; the command then has an option --seed.
    """

    kind: str
    setup: type[Setup]
    resolve: Callable[[Path | str], Setup]
    run: Callable[[Setup, Backend, int, Advance], Run]
    numbers: Callable[[Run], Mapping[str, Any]]
    warnings: Callable[[Setup, Backend], tuple[str, ...]] = blur_warnings
    seeded: bool = True
