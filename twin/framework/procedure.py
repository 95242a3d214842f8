"""A test being run: how far it is, and how it fails."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from optics.numerics.array_math import PhysicalError
from scenes.yaml.errors import InputError, Issue, KeyPath

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.procedures import Procedure
    from scenes.specs.resolved import ExperimentSetup
    from twin.framework.run_folder import RunFolder

Advance = Callable[[str, int, int], None]
"""Told what is being done, and how many of how many parts of it are."""


WRITE = "write the run folder"
"""Name of the last part of a command's work."""


def silent(part: str, done: int, total: int) -> None:
    """An ``Advance`` that tells nobody."""


class BenchError(PhysicalError):
    """The test failed on the bench: what happened, which key of its file is to be changed, and how.

    Attributes
    ----------
    key
        Key path in the test's file.
    remedy
        What may be there instead.
    """

    def __init__(self, problem: str, key: KeyPath, remedy: str) -> None:
        super().__init__(problem)
        self.key = key
        self.remedy = remedy


def performed(
    procedure: Procedure, setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent
) -> tuple[Any, tuple[str, ...]]:
    """Run a test.

    Parameters
    ----------
    procedure : Procedure
        The test.
    setup : ExperimentSetup[Any]
        What its file says.
    backend : Backend
        Where to trace.
    seed : int
        Of all that is drawn.
    advance : Advance
        Told of the progress.

    Returns
    -------
    tuple[Any, tuple[str, ...]]
        Everything that was computed, and what the user should know of what the test was given.

    Raises
    ------
    InputError
        Also for what fails on the bench, at the key that can change it; with what is wrong with what the test was
        given, which may be the reason.
    """
    given: tuple[str, ...] = ()
    if procedure.judged:
        # a command is told of a bad file before this is imported
        from scenes.models.camera_sharpness import blur_warnings

        given = blur_warnings(setup, backend)
    try:
        return procedure.run(setup, backend, seed, advance), given
    except BenchError as error:
        told = setup.test.error(str(error), error.key, allowed=error.remedy)
        raise InputError(*told.issues, *(Issue(text) for text in given)) from error
    except InputError as error:
        raise InputError(*error.issues, *(Issue(text) for text in given)) from error


def seeded(procedure: Procedure, setup: Any, seed: int | None) -> tuple[Any, int, dict[str, Any]]:
    """Return a set-up with the seed of its run, this seed, and what a run folder states of both.

    Parameters
    ----------
    procedure : Procedure
        The test.
    setup : Any
        What its file says.
    seed : int | None
        In place of the file's; None for that.
    """
    number = setup.seed if seed is None else seed
    made = setup.with_seed(number)
    drawn = number if procedure.seeded and made is not setup else None
    return made, number, {"config": made.to_yaml(), "named": made.plain(), "seed": drawn}


@dataclass(frozen=True)
class Session:
    """A command at work.

    Attributes
    ----------
    folder : RunFolder
        Its run folder, open.
    backend : Backend
        Where to trace.
    advance : Advance
        Shows the user how far it is.
    started : float
        Seconds since the epoch.
    clock : float
        Reading of the monotonic clock then.
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
