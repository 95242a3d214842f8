"""Computation of the missing blocks of a study (groups of consecutive runs) by worker processes.

The first block is timed to estimate the duration of the study. A worker evaluates whole blocks on one thread. A block
counts as finished only when it has been written to the study's journal, a file from which an interrupted study is
continued.
"""

import os
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from optics.numerics.backend import ONE_THREAD, Backend, kernel_threads, load_backend
from scenes.specs.study import NOISE, TOTAL
from scenes.yaml.errors import InputError, KeyPath, Problem, key_text
from twin.framework import cluster
from twin.framework.cli import Incomplete, time_text
from twin.framework.journal import Journal
from twin.framework.memory import largest_memory
from twin.framework.provenance import source_digest
from twin.study.runs import base_job
from twin.study.runs.base_job import BlockResult, Failure, Run
from twin.study.runs.plan import Plan
from twin.study.runs.setup import StudySetup, study_from_text

BLOCKS = "blocks.journal"
"""File name of the journal (finished blocks of runs) in the folder of a study."""
LONGEST_REPEAT = 4.0
"""Duration of the first block, in seconds, above which it is not evaluated a second time for a better time estimate."""
_ALONE = threading.Lock()
"""Lock that makes a worker with several threads evaluate one block at a time.

The library Dr.Jit has one state for the whole process.
"""


class OtherProgramError(Exception):
    """Error that a worker runs a different version of the program from the one the study was started with."""


@dataclass(frozen=True)
class Task:
    """Block of a study with everything that a worker needs for it.

    Attributes
    ----------
    config : str
        Text of the study's config.yaml.
    source : str
        Checksum of the program's source files, which the worker must have too.
    backend : str
        Array backend of the ray trace.
    runs : tuple of Run
        Runs of the block.
    """

    config: str
    source: str
    backend: str
    runs: tuple[Run, ...]


@dataclass(frozen=True, eq=False)
class Pilot:
    """First block of a study, evaluated to estimate time and memory and to check the study.

    Attributes
    ----------
    result : BlockResult
        Result of the block; its computing time is that of a second evaluation, with everything compiled and calibrated.
    sample : dict or None
        All results of the first run that did not fail; None if all runs failed.
    start_seconds : float
        Time by which the first evaluation took longer than the second.
    memory : float
        Peak memory of the worker's process, bytes.
    refusal : InputError or None
        Reason why the study cannot be run at all.
    """

    result: BlockResult
    sample: Mapping[str, Any] | None
    start_seconds: float
    memory: float
    refusal: InputError | None = None


def evaluate(task: Task) -> BlockResult:
    """Return the results of a block of runs; an error of the program itself gets the runs' numbers as a note."""
    with _ALONE:
        return _block(*_prepared(task), task.runs)[0]


def pilot(task: Task) -> Pilot:
    """Evaluate one block twice: the first time the instrument is built and kernels are compiled.

    The second evaluation gives the same numbers; it is timed and kept.
    """
    with _ALONE:
        start = time.monotonic()
        setup, backend = _prepared(task)
        try:
            setup.job.check(setup.tree, backend)
        except InputError as error:
            return Pilot(BlockResult.of([], setup.study.responses), None, 0.0, 0.0, setup.blamed(error))
        result, sample = _block(setup, backend, task.runs)
        first = time.monotonic() - start
        if first > 0.5 and result.seconds < LONGEST_REPEAT:
            result, sample = _block(setup, backend, task.runs)
        return Pilot(result, sample, max(0.0, first - result.seconds), largest_memory())


def _block(setup: StudySetup, backend: Backend, runs: Sequence[Run]) -> tuple[BlockResult, Mapping[str, Any] | None]:
    start = time.monotonic()
    try:
        outcomes = setup.job.evaluate(setup.tree, runs, backend)
    except Exception as error:
        error.add_note(f"in runs {runs[0].number} to {runs[-1].number}")
        raise
    sample = next((outcome for outcome in outcomes if not isinstance(outcome, Failure)), None)
    return BlockResult.of(outcomes, setup.study.responses, time.monotonic() - start), sample


def _prepared(task: Task) -> tuple[StudySetup, Backend]:
    if task.source != source_digest():
        raise OtherProgramError("the worker has other source files than the command: changed since it was started?")
    _limit_threads()
    return _setup(task.config), load_backend(task.backend)


@lru_cache(maxsize=2)
def _setup(config: str) -> StudySetup:
    return study_from_text(config)


def _limit_threads() -> None:
    """Limit the numerical libraries of this process to one thread, since there are as many workers as cores.

    For workers started outside this program the environment variables come too late, so the libraries are limited
    directly, and again for every block, since some are loaded only when they are needed.
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


def journal_of(setup: StudySetup, file: Path | None, noun: str = "study") -> Journal:
    """Return the journal of a study, the file that holds its finished blocks of runs.

    Parameters
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    file : Path or None
        File of the journal, None to store nothing.
    noun : str
        Word for the study in messages.
    """
    return Journal(file, setup.content, noun, (BlockResult,))


@dataclass(eq=False)
class Engine:
    """Computation of the blocks (groups of consecutive runs) of a study that its journal does not hold yet.

    Attributes
    ----------
    plan : Plan
        All runs.
    journal : Journal
        Open journal of the study's finished blocks.
    backend : str
        Array backend of the ray trace.
    advance : callable
        Function that receives the numbers of finished and of all runs.
    notify : callable
        Function that receives the estimate of time and memory after the first block.
    warn : callable
        Function that receives warnings.
    computed : int
        Number of runs that this engine has computed.
    seconds : float
        Computing time of these runs.
    """

    plan: Plan
    journal: Journal
    backend: str = "llvm"
    advance: Callable[[int, int], None] = lambda done, total: None
    notify: Callable[[str], None] = lambda text: None
    warn: Callable[[str], None] = lambda text: None
    computed: int = 0
    seconds: float = 0.0

    def __post_init__(self) -> None:
        """Warn about corrupt lines of the journal."""
        if damaged := self.journal.damaged:
            lines = "1 line of it is" if damaged == 1 else f"{damaged} lines of it are"
            self.warn(f"{self.journal.file}: {lines} corrupt; what it held is computed again")

    def _known(self, block: int) -> BlockResult | None:
        """Return the results of a block of runs if the journal of finished blocks holds them, else None."""
        result = self.journal.known.get(str(block))
        shape = len(self.plan.block(block)), len(self.plan.setup.study.responses)
        return result if isinstance(result, BlockResult) and result.fits(shape) else None

    @property
    def missing(self) -> list[int]:
        """Numbers of the blocks whose results are not in the journal yet, in order."""
        return [block for block in range(self.plan.blocks) if self._known(block) is None]

    def result(self) -> BlockResult:
        """Return the results of all runs, in order; no block may be missing."""
        return BlockResult.joined([known for block in range(self.plan.blocks) if (known := self._known(block))])

    def run(self, workers: cluster.Workers, main_memory: float = 0.0) -> None:
        """Compute all missing blocks.

        Parameters
        ----------
        workers : cluster.Workers
            Worker processes.
        main_memory : float
            Memory of this process, bytes, for the estimate.

        Raises
        ------
        InputError
            The base job cannot be run as it is, or the key of a response does not exist in its results.
        Incomplete
            Workers died repeatedly in some runs, or the program failed; finished blocks are kept.
        ClusterError
            The scheduler is gone.
        RunFolderError
            A block cannot be written to the journal.
        """
        started = time.monotonic()
        missing = self.missing
        if not missing:
            return
        there = self.plan.runs - self._runs(missing)
        first = self._first(workers, missing[0])
        self._estimate(first, missing, there, max(1, workers.count), main_memory)
        self.advance(there + self.computed, self.plan.runs)
        suspects = self._all(workers, missing[1:], there)
        # a block is blamed only when it is alone, for the scheduler suspects all that a worker had when it died
        if bad := [block for suspect in suspects for block in self._all(workers, [suspect], there)]:
            parts = ", ".join(f"{runs.start}-{runs.stop - 1}" for runs in map(self.plan.block, bad))
            raise Incomplete(f"not computed: runs {parts} (the workers died)")
        self.seconds = time.monotonic() - started

    def _runs(self, blocks: Sequence[int]) -> int:
        return sum(len(self.plan.block(block)) for block in blocks)

    def _estimate(self, first: Pilot, missing: Sequence[int], there: int, workers: int, main_memory: float) -> None:
        """Report the estimated time and memory of the study, from its first block."""
        runs = self._runs(missing)
        seconds_per_run = first.result.seconds / len(first.result.messages)
        seconds = -(-(len(missing) - 1) // workers) * first.result.seconds + first.start_seconds * (workers > 1)
        memory, limit = main_memory + workers * first.memory, self.plan.setup.study.limits
        if memory > limit.bytes:
            self.warn(
                f"the processes need about {1e-9 * memory:.1f} GB, more than the study's {limit.memory}; use fewer "
                "--workers"
            )
        self.notify(
            f"{runs} runs{f' ({there} already done)' if there else ''} in {len(missing)} blocks on {workers} "
            f"worker{'s' if workers > 1 else ''}; about {time_text(seconds)}, {1e-9 * memory:.1f} GB; "
            f"{1e3 * seconds_per_run:.3g} ms a run"
        )

    def _first(self, workers: cluster.Workers, block: int) -> Pilot:
        """Compute the first block of runs and check that its results contain all responses."""
        ((_, future),) = next(workers.each(pilot, [self.task(block)]))
        if future.status != "finished":
            if cluster.killed(future.exception()):
                runs = self.plan.block(block)
                raise Incomplete(f"the workers died in the first block, runs {runs.start}-{runs.stop - 1}")
            raise _fault(future)
        first: Pilot = future.result()
        if first.refusal is not None:
            raise first.refusal
        if first.sample is not None:
            check_responses(self.plan.setup, first.sample)
        else:
            self.warn(f"all runs of the first block fail: {first.result.messages[0]}")
        self._keep({block: first.result})
        return first

    def _all(self, workers: cluster.Workers, blocks: Sequence[int], there: int) -> list[int]:
        """Compute blocks and return those in which workers died."""
        failed = []
        for finished in workers.each(evaluate, map(self.task, blocks)):
            self._keep({blocks[k]: future.result() for k, future in finished if future.status == "finished"})
            self.advance(there + self.computed, self.plan.runs)
            for k, future in finished:
                if future.status != "finished":
                    if not cluster.killed(future.exception()):
                        raise _fault(future)
                    failed.append(blocks[k])
        return failed

    def _keep(self, results: Mapping[int, BlockResult]) -> None:
        self.journal.keep({str(block): result for block, result in results.items()})
        self.computed += self._runs([*results])

    def task(self, block: int) -> Task:
        """Return the block of runs with that number, and everything that a worker needs to compute it."""
        runs = tuple(self.plan.run(number) for number in self.plan.block(block))
        return Task(self.plan.config, source_digest(), self.backend, runs)


def _fault(future: Any) -> Incomplete:
    """Return the error to raise for a task that failed for another reason than the death of its worker."""
    error = future.exception()
    notes = " ".join(getattr(error, "__notes__", ()))
    text = f"{type(error).__name__}: {error} {notes}".strip()
    if isinstance(error, OtherProgramError):
        return Incomplete(text)
    trace = "".join(traceback.format_exception(type(error), error, future.traceback()))
    return Incomplete(f"the program failed: {text}", trace)


def check_responses(setup: StudySetup, sample: Any) -> None:
    """Raise InputError if the results lack a response of a study.

    Parameters
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    sample : dict
        Results of one run, by file.

    Raises
    ------
    InputError
        A response is missing; the error lists what exists.
    """
    for name, response in setup.study.responses.items():
        asked = {"key": response.key, "sigma": response.sigma, "noise": response.noise, "minus": response.minus}
        for key, path in asked.items():
            if path is None:
                continue
            try:
                base_job.check_response(sample, path)
            except Problem as problem:
                key_path: KeyPath = ("responses", name, key)
                text = f"the results of {setup.study.base.command!r} do not have this: {problem.problem}"
                restated = Problem(text, problem.value, problem.allowed, problem.suggestion, problem.within)
                raise setup.error(restated, key_path) from None
            if key == "noise":
                _check_noise(setup, sample, name, path)


def _check_noise(setup: StudySetup, sample: Any, name: str, path: KeyPath) -> None:
    """Raise InputError if a response's ``noise`` key names a total sigma although the results hold the noise's own.

    Raises
    ------
    InputError
        The key names a total standard deviation.
    """
    index = max((k for k, part in enumerate(path) if isinstance(part, str)), default=0)
    named = str(path[index])
    noise_path = (*path[:index], f"{named.removesuffix(TOTAL)}{NOISE}", *path[index + 1 :])
    if named.endswith(NOISE):
        return
    try:
        base_job.leaf(sample, noise_path)
    except Problem:
        return
    text = "not the standard deviation by noise alone, which is beside it"
    raise setup.error(Problem(text, key_text(path), key_text(noise_path)), ("responses", name, "noise"))
