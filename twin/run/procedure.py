"""What a test is to whatever runs it: reading its file, running it, its numbers as plain data; and how it fails."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

from optics.numerics.backend import Backend
from optics.numerics.physical_error import PhysicalError
from scenes.specs.resolved import ExperimentSetup
from scenes.yaml.errors import InputError, Issue, KeyPath

if TYPE_CHECKING:
    from twin.run.report import Report
    from twin.run.run_folder import RunFolder

Advance = Callable[[str, int, int], None]
"""Told what is being done, and how many of how many parts of it are."""


WRITE = "write the run folder"
"""Name of the last part of a command's work."""


def silent(part: str, done: int, total: int) -> None:
    """An ``Advance`` that tells nobody."""


class BenchError(PhysicalError):
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
        judged: whether the user is warned of cameras among what the test is given that are blurred as designed.
        seeded: whether anything is drawn at random; the command then has an option --seed.
    """

    kind: str
    setup: type[Setup]
    resolve: Callable[[Path | str], Setup]
    run: Callable[[Setup, Backend, int, Advance], Run]
    numbers: Callable[[Run], Mapping[str, Any]]
    judged: bool = True
    seeded: bool = True

    def performed(
        self, setup: Setup, backend: Backend, seed: int, advance: Advance = silent
    ) -> tuple[Run, tuple[str, ...]]:
        """Run it, and what the user should know of what it was given.

        Raises:
            InputError: also for what fails on the bench, at the key that can change it; with what is wrong with what
                the test was given, which may be the reason.
        """
        given: tuple[str, ...] = ()
        if self.judged:
            # a command is told of a bad file before this is imported
            from scenes.models.camera_sharpness import blur_warnings

            given = blur_warnings(setup, backend)
        try:
            return self.run(setup, backend, seed, advance), given
        except BenchError as error:
            told = setup.test.error(str(error), error.key, allowed=error.remedy)
            raise InputError(*told.issues, *(Issue(text) for text in given)) from error
        except InputError as error:
            raise InputError(*error.issues, *(Issue(text) for text in given)) from error


Test: TypeAlias = "tuple[Procedure[Any, Run], Callable[[Run], Report]]"
"""A test, and what makes the report of its run. A command imports them when it has read the file: its help and what is
wrong with a file wait for neither.
"""


@dataclass(frozen=True)
class Session:
    """A command at work.

    Attributes:
        folder: its run folder, open.
        backend: where to trace.
        advance: shows the user how far it is.
        started: seconds since the epoch.
        clock: reading of the monotonic clock then.
    """

    folder: RunFolder
    backend: Backend
    advance: Advance
    started: float
    clock: float

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self.clock
