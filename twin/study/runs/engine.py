"""Runs the blocks of a study that are not there yet: a pilot first, then chunks, a few at a time on every worker."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from scenes.specs.study import NOISE, TOTAL
from scenes.yaml.errors import KeyPath, Problem, key_text
from twin.run import cluster
from twin.run.provenance import source_digest
from twin.study.runs import base_job, chunk_store, task
from twin.study.runs.plan import Plan
from twin.study.runs.setup import StudySetup

CHUNK_SECONDS = 6.0
"""How long a worker is to be busy with a chunk: what is lost when it dies, against what handing over costs."""
LARGEST_CHUNK = 40
"""Blocks in a chunk at most."""
AHEAD = 2
"""Chunks that are handed over for each worker: one being computed, the others waiting."""


@dataclass(frozen=True)
class Estimate:
    """What is known before a study starts.

    Attributes:
        runs, blocks, chunks: how many are to be done, the pilot's among them.
        there: runs that were there already.
        seconds: that it will take, pilot excluded; None when nobody knows.
        memory: that all processes will need, bytes.
        workers: worker processes.
        state_seconds: that a worker needs for a run.
    """

    runs: int
    blocks: int
    chunks: int
    there: int
    seconds: float | None
    memory: float
    workers: int
    state_seconds: float


@dataclass(eq=False)
class Progress:
    """What the engine tells while it works; every member may be replaced.

    Attributes:
        start: the estimate, once the pilot is done.
        done: number of runs that are there, of how many.
        warn: something the user should know.
    """

    start: Callable[[Estimate], None] = lambda estimate: None
    done: Callable[[int, int], None] = lambda done, total: None
    warn: Callable[[str], None] = lambda text: None


class IncompleteError(Exception):
    """Some runs could not be computed although everything else was; the message names them."""


class ProgramFault(Exception):
    """The program failed in a run, which says nothing of the run; the message names it and the error.

    Attributes:
        trace: the worker's traceback, as text.
    """

    def __init__(self, message: str, trace: str) -> None:
        super().__init__(message)
        self.trace = trace


@dataclass(eq=False)
class Engine:
    """Runs a study.

    Attributes:
        plan: all its runs.
        store: finished chunks.
        backend: where to trace.
        progress: what is told meanwhile.
        chunk_blocks: blocks in a chunk, None to choose by the pilot's time.
        computed: number of runs that this engine has computed.
        seconds: that it took for them.
    """

    plan: Plan
    store: chunk_store.ChunkStore
    backend: str = "llvm"
    progress: Progress = field(default_factory=Progress)
    chunk_blocks: int | None = None
    computed: int = 0
    seconds: float = 0.0

    def run(self, workers: cluster.Workers, own_memory: float = 0.0) -> None:
        """Compute whatever is missing.

        Args:
            workers: who computes.
            own_memory: of this process, bytes, for the estimate.

        Raises:
            InputError: the base cannot be run as it is, or a response's key leads nowhere in its results.
            IncompleteError: workers died again and again in some runs; the others are there.
            ProgramFault: any error but those that say that a run cannot be; what is done is there.
            ClusterError: the scheduler is gone.
            OSError: a chunk cannot be written.
        """
        started = time.monotonic()
        missing = self.store.missing
        there = self.store.runs
        config = self.plan.setup.to_yaml()
        if not missing:
            return
        first = self._pilot(workers, config, missing[0])
        left = missing[1:]
        each = first.result.seconds / max(1, len(self.plan.block(missing[0])))
        size = self.chunk_blocks or _chunk_size(len(left), first.result.seconds, workers.count)
        chunks = list(_chunks(left, size))
        count = max(1, workers.count)
        runs = sum(len(self.plan.block(block)) for block in missing)
        rest = runs - len(self.plan.block(missing[0]))
        slowest = -(-len(chunks) // count) * size * first.result.seconds if chunks else 0.0
        seconds = min(slowest, each * rest / count + first.result.seconds * size) + first.start_seconds * (count > 1)
        memory, limit = own_memory + count * first.memory, self.plan.setup.study.limits
        if memory > limit.bytes:
            self.progress.warn(
                f"the processes need about {1e-9 * memory:.1f} GB, more than the study's {limit.memory}; use fewer "
                "--workers"
            )
        self.progress.start(Estimate(runs, len(missing), len(chunks) + 1, there, seconds, memory, count, each))
        self.progress.done(self.store.runs, self.plan.runs)
        self._all(workers, config, chunks)
        self.seconds = time.monotonic() - started

    def _pilot(self, workers: cluster.Workers, config: str, block: int) -> task.Pilot:
        """Do the first block and see whether the results hold what is asked for."""
        workers.submit(task.pilot, self._task(config, range(block, block + 1)))
        future = workers.next_finished()
        if future.status != "finished":
            error = future.exception()
            runs = _runs_text([self.plan.block(block)])
            if cluster.killed(error):
                raise IncompleteError(f"the workers died in the first block, {runs}")
            raise _fault(future)
        first: task.Pilot = future.result()
        if first.refusal is not None:
            raise first.refusal
        if first.sample is not None:
            check_responses(self.plan.setup, first.sample)
        else:
            self.progress.warn(f"all runs of the first block fail: {first.result.messages[0]}")
        self.store.write(block, [first.result])
        self.computed += len(first.result.messages)
        return first

    def _all(self, workers: cluster.Workers, config: str, chunks: list[range]) -> None:
        """Compute chunks, never more than a few ahead. One in which workers die is cut into blocks to find which; a
        block is blamed only when it is alone, for the scheduler suspects all that a worker had before it when it died.
        """
        waiting = list(reversed(chunks))
        suspects: list[range] = []
        alone: set[int] = set()
        running: dict[Any, tuple[range, Any]] = {}
        bad: list[range] = []
        while waiting or running or suspects:
            if not waiting and not running:
                waiting.append(suspects.pop(0))
                alone.add(waiting[0].start)
            while waiting and len(running) < AHEAD * max(1, workers.count):
                blocks = waiting.pop()
                future = workers.submit(task.evaluate, self._task(config, blocks))
                running[future.key] = (blocks, future)
            future = workers.next_finished()
            blocks, _ = running.pop(future.key, (range(0), None))
            if not blocks:
                continue
            if future.status == "finished":
                self.store.write(blocks.start, future.result())
                self.computed += sum(len(self.plan.block(block)) for block in blocks)
                self.progress.done(self.store.runs, self.plan.runs)
                continue
            error = future.exception()
            if not cluster.killed(error):
                raise _fault(future)
            if len(blocks) > 1:
                waiting.extend(range(block, block + 1) for block in reversed(blocks))
                continue
            if blocks.start not in alone:
                suspects.append(blocks)
                continue
            bad.append(self.plan.block(blocks.start))
        if bad:
            raise IncompleteError(f"not computed: {_runs_text(bad)} (the workers died)")

    def _task(self, config: str, blocks: range) -> task.Task:
        return task.Task(
            config,
            source_digest(),
            self.backend,
            blocks.start,
            tuple(tuple(runs) for runs in self.plan.runs_of(blocks)),
        )


def check_responses(setup: StudySetup, sample: Any) -> None:
    """Check that the results hold every response of a study.

    Args:
        setup: the study.
        sample: results of one run, by file.

    Raises:
        InputError: one that they do not, with what there is.
    """
    for name, response in setup.study.responses.items():
        asked = {"key": response.key, "sigma": response.sigma, "noise": response.noise, "minus": response.minus}
        for key, path in asked.items():
            if path is None:
                continue
            try:
                base_job.check_response(sample, path)
            except Problem as problem:
                place: KeyPath = ("responses", name, key)
                text = f"the results of {setup.study.base.command!r} do not have this: {problem.problem}"
                restated = Problem(text, problem.found, problem.allowed, problem.suggestion, problem.within)
                raise setup.error(restated, place) from None
            if key == "noise":
                _check_noise(setup, sample, name, path)


def _check_noise(setup: StudySetup, sample: Any, name: str, path: KeyPath) -> None:
    """Check that the noise of a response is not a total standard deviation beside which that of noise stands.

    Raises:
        InputError: it is.
    """
    place = max((k for k, part in enumerate(path) if isinstance(part, str)), default=0)
    named = str(path[place])
    own = (*path[:place], f"{named.removesuffix(TOTAL)}{NOISE}", *path[place + 1 :])
    if named.endswith(NOISE):
        return
    try:
        base_job.leaf(sample, own)
    except Problem:
        return
    text = "not the noise alone, which stands beside it"
    raise setup.error(Problem(text, key_text(path), key_text(own)), ("responses", name, "noise"))


def fit_workers(wanted: int, memory: float, least: float) -> int:
    """Number of workers that are wanted and fit into the memory, one at least.

    Args:
        wanted: number of workers.
        memory: that they may take, bytes.
        least: that one takes, bytes.
    """
    return max(1, min(wanted, int(memory // least)))


def _chunk_size(blocks: int, block_seconds: float, workers: int) -> int:
    """Blocks in a chunk: some seconds of work, but at least a few chunks for each worker."""
    by_time = int(CHUNK_SECONDS / max(block_seconds, 1e-3))
    by_share = blocks // (4 * max(1, workers))
    return max(1, min(by_time, by_share, LARGEST_CHUNK))


def _chunks(blocks: Sequence[int], size: int) -> list[range]:
    """Consecutive blocks in pieces of at most ``size``."""
    out: list[range] = []
    for block in blocks:
        if out and out[-1].stop == block and len(out[-1]) < size:
            out[-1] = range(out[-1].start, block + 1)
        else:
            out.append(range(block, block + 1))
    return out


def _runs_text(parts: Sequence[range]) -> str:
    return "runs " + ", ".join(f"{part.start}-{part.stop - 1}" for part in parts)


def _fault(future: Any) -> Exception:
    """What is raised for a task that has failed otherwise than by the death of its worker."""
    error = future.exception()
    notes = " ".join(getattr(error, "__notes__", ()))
    text = f"{type(error).__name__}: {error} {notes}".strip()
    if isinstance(error, task.OtherProgramError):
        return IncompleteError(text)
    trace = "".join(traceback.format_exception(type(error), error, future.traceback()))
    return ProgramFault(f"the program failed: {text}", trace)
