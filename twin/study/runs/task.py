"""What a worker process does: evaluate whole blocks of a study, on one thread."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from optics.numerics.backend import ONE_THREAD, Backend, kernel_threads, load_backend
from scenes.yaml.errors import InputError
from twin.run.memory import largest_memory
from twin.run.provenance import source_digest
from twin.study.runs.base_job import BlockResult, Failure, Run
from twin.study.runs.setup import StudySetup, study_from_text


@dataclass(frozen=True)
class Task:
    """A chunk: whole blocks of a study, with all that a worker needs for them.

    Attributes:
        config: text of the study's config.yaml.
        source: checksum of the program's source files, which the worker's must have too.
        backend: where to trace.
        first: number of the first block.
        blocks: runs of each.
    """

    config: str
    source: str
    backend: str
    first: int
    blocks: tuple[tuple[Run, ...], ...]


@dataclass(frozen=True, eq=False)
class Pilot:
    """What the first block tells about a study.

    Attributes:
        result: of the block; its seconds are those of a second evaluation, with everything compiled and calibrated.
        sample: all results of the first run that did not fail, None if all did.
        start_seconds: what the first evaluation took longer.
        memory: largest that the worker's process has been, bytes.
        refusal: why the study cannot be run at all.
    """

    result: BlockResult
    sample: Mapping[str, Any] | None
    start_seconds: float
    memory: float
    refusal: InputError | None = None


_ALONE = threading.Lock()
"""A worker that has several threads still evaluates one chunk at a time: Dr.Jit's state belongs to the process."""


def evaluate(task: Task) -> list[BlockResult]:
    """Results of a chunk, block by block. A fault of the program is raised with the runs' numbers in its notes."""
    with _ALONE:
        setup, backend = _prepared(task)
        return [_block(setup, backend, runs)[0] for runs in task.blocks]


def pilot(task: Task) -> Pilot:
    """Evaluate one block, twice: the first time the instrument is built and kernels are compiled.

    The second evaluation gives the same numbers; it is the one that is timed and kept.
    """
    with _ALONE:
        start = time.monotonic()
        setup, backend = _prepared(task)
        try:
            setup.job.check(setup.tree, backend)
        except InputError as error:
            return Pilot(BlockResult.of([], setup.study.responses), None, 0.0, 0.0, setup.blamed(error))
        result, sample = _block(setup, backend, task.blocks[0])
        first = time.monotonic() - start
        if first > 0.5 and result.seconds < LONGEST_REPEAT:
            result, sample = _block(setup, backend, task.blocks[0])
        return Pilot(result, sample, max(0.0, first - result.seconds), largest_memory())


LONGEST_REPEAT = 4.0
"""A block that took longer is not evaluated again for the sake of its time."""


def _block(setup: StudySetup, backend: Backend, runs: Sequence[Run]) -> tuple[BlockResult, Mapping[str, Any] | None]:
    start = time.monotonic()
    try:
        outcomes = setup.job.evaluate(setup.tree, runs, backend)
    except Exception as error:
        error.add_note(f"in runs {runs[0].number} to {runs[-1].number}")
        raise
    sample = next((outcome for outcome in outcomes if not isinstance(outcome, Failure)), None)
    return BlockResult.of(outcomes, setup.study.responses, time.monotonic() - start), sample


class OtherProgramError(Exception):
    """The worker does not run the program that the study was started with."""


def _prepared(task: Task) -> tuple[StudySetup, Backend]:
    if task.source != source_digest():
        raise OtherProgramError("the worker has other source files than the command: changed since it was started?")
    _one_thread()
    return _setup(task.config), load_backend(task.backend)


@lru_cache(maxsize=2)
def _setup(config: str) -> StudySetup:
    return study_from_text(config)


def _one_thread() -> None:
    """Let this process do everything on the thread that asks for it; workers are as many as there are cores.

    For workers that somebody else has started the environment comes too late, so the libraries are told as well; again
    for every chunk, since some are loaded only when they are needed.
    """
    from threadpoolctl import ThreadpoolController

    from optics.numerics.llvm import ensure_llvm

    os.environ.update(ONE_THREAD)
    ensure_llvm()
    import cv2
    import scipy.linalg  # noqa: F401 (it brings linear algebra of its own, which is then limited with the rest)

    ThreadpoolController().limit(limits=1)
    cv2.setNumThreads(1)
    kernel_threads(1)
