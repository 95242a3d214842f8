"""Execution of a test: its progress, its seed and random streams, and the errors that name the key to change."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.numerics.array_math import PhysicalError
from scenes.yaml.errors import InputError, Issue, KeyPath

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.procedures import Procedure
    from scenes.specs.resolved import ExperimentSetup
    from twin.framework.run_folder import RunFolder

Advance = Callable[[str, int, int], None]
"""Function called with the part of the work in progress, the number of its steps that are done, and their total."""


WRITE = "write the run folder"
"""Name, in the progress display, of the last part of a command's work: writing the run folder."""


def silent(part: str, done: int, total: int) -> None:
    """Ignore the progress: an ``Advance`` that shows nothing."""


class BenchError(PhysicalError):
    """Failure of a simulated test, with the key in the test's file that should be changed, and the remedy.

    Attributes
    ----------
    key
        Key path in the test's file.
    remedy
        Allowed values of the key.
    """

    def __init__(self, problem: str, key: KeyPath, remedy: str) -> None:
        super().__init__(problem)
        self.key = key
        self.remedy = remedy


def performed(
    procedure: Procedure, setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent
) -> tuple[Any, tuple[str, ...]]:
    """Run a test with one seed and return its results and warnings.

    Parameters
    ----------
    procedure : Procedure
        Test to run.
    setup : ExperimentSetup
        Resolved file of the test.
    backend : Backend
        Backend of the ray trace.
    seed : int
        Seed of all random numbers.
    advance : Advance
        Function that is called with the progress.

    Returns
    -------
    tuple of (Any, tuple of str)
        Results of the run, and warnings about the test's input.

    Raises
    ------
    InputError
        The input is invalid, or the simulated test failed; the error is at the key that can change it, and warnings
        about the input are added since they may give the reason.
    """
    input_warnings: tuple[str, ...] = ()
    if procedure.judged:
        # imported here, so that an error in the file is reported without delay
        from scenes.models.camera_sharpness import blur_warnings

        input_warnings = blur_warnings(setup, backend)
    try:
        return procedure.run(setup, backend, seed, advance), input_warnings
    except BenchError as error:
        problem = setup.test.error(str(error), error.key, allowed=error.remedy)
        raise InputError(*problem.issues, *(Issue(text) for text in input_warnings)) from error
    except InputError as error:
        raise InputError(*error.issues, *(Issue(text) for text in input_warnings)) from error


def seeded(procedure: Procedure, setup: Any, seed: int | None) -> tuple[Any, int, dict[str, Any]]:
    """Return the set-up with the seed that the run uses, that seed, and entries about both for the run folder.

    Parameters
    ----------
    procedure : Procedure
        Test to run.
    setup : Any
        Resolved file of the test.
    seed : int | None
        Seed that replaces the file's; None to keep that.
    """
    number = setup.seed if seed is None else seed
    seeded_setup = setup.with_seed(number)
    drawn = number if procedure.seeded and seeded_setup is not setup else None
    return seeded_setup, number, {"config": seeded_setup.to_yaml(), "named": seeded_setup.plain(), "seed": drawn}


@dataclass(frozen=True)
class Session:
    """Command in progress: its run folder, backend, progress function and start time.

    Attributes
    ----------
    folder : RunFolder
        Open run folder.
    backend : Backend
        Backend of the ray trace.
    advance : Advance
        Function that shows the progress to the user.
    started : float
        Start time, in seconds since the epoch.
    clock : float
        Reading of the monotonic clock at the start, in seconds.
    """

    folder: RunFolder
    backend: Backend
    advance: Advance
    started: float
    clock: float

    @property
    def seconds(self) -> float:
        """Time since the start, in seconds."""
        return time.monotonic() - self.clock


def stream(seed: int | np.random.SeedSequence, *number: int) -> np.random.SeedSequence:
    """Return a numbered random stream of a seed.

    Unlike ``spawn``, this leaves the seed unchanged and can be repeated; streams of streams have longer numbers.

    Parameters
    ----------
    seed : int | np.random.SeedSequence
        Seed of a run, or one of its streams.
    number : int
        Number of the stream; without numbers, the stream of the seed itself.

    Returns
    -------
    np.random.SeedSequence
        Random stream.
    """
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, *number), pool_size=root.pool_size)
