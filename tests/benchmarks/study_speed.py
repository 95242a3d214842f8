"""Design trade studies: what the engine adds to a state, how two workers share the work."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import processor_s
from tests.benchmarks.workbench import Workbench
from tests.twin.study_bench import write_study
from twin.run.cluster import Workers, local_workers
from twin.run.provenance import source_digest
from twin.study.runs.chunk_store import ChunkStore
from twin.study.runs.engine import Engine, Progress
from twin.study.runs.plan import Plan
from twin.study.runs.render_base import BLOCK
from twin.study.runs.setup import resolve_study
from twin.study.runs.task import Task, evaluate

RUNS, QUICK_RUNS = 1825, 125
LARGE, QUICK_LARGE = 10_000, 200
"""States of the pair's monitor with nine frames, which share their noise: the frames before are taken once."""


def run_engine(folder: Path, plan: Plan, workers: Workers, chunk_blocks: int = 4) -> tuple[float, float, int]:
    """Seconds from the pilot's end to the last chunk; meanwhile, processor time of this process, and runs done."""
    store = ChunkStore(folder, plan)
    store.open()
    begun: list[tuple[float, float]] = []

    def start(_: object) -> None:
        begun.append((time.monotonic(), time.process_time()))

    engine = Engine(plan, store, progress=Progress(start=start))
    engine.chunk_blocks = chunk_blocks
    engine.run(workers)
    return time.monotonic() - begun[0][0], time.process_time() - begun[0][1], plan.runs - BLOCK


def warm(workers: Workers, plan: Plan, count: int) -> None:
    """Let every worker build the instrument and compile before anything is timed."""
    task = Task(plan.setup.to_yaml(), source_digest(), "llvm", 0, (tuple(next(plan.runs_of(range(1)))),))
    for future in [
        workers.client.submit(evaluate, task, workers=[address], pure=False)
        for address in workers.client.scheduler_info(n_workers=-1)["workers"]
    ]:
        future.result()
    assert workers.count == count


def measure_large(quick: bool) -> tuple[Number, ...]:
    """Seconds for all states, start of the workers and compilation not included; memory of all processes together."""
    runs = QUICK_LARGE if quick else LARGE
    changes = (("runs: 100", f"runs: {runs}"), ("file: job.yaml", "file: perturb"))
    largest = [0]

    def look(done: int, total: int) -> None:
        own = psutil.Process()
        largest[0] = max(largest[0], sum(p.memory_info().rss for p in (own, *own.children(recursive=True))))

    with tempfile.TemporaryDirectory() as name:
        study = write_study(Path(name) / "in", *changes, ("responses:", "noise: shared\nresponses:"))
        plan = Plan.of(resolve_study(study))
        store = ChunkStore(Path(name), plan)
        store.open()
        with local_workers(2) as workers:
            begun, spent = time.monotonic(), processor_s()
            Engine(plan, store, progress=Progress(done=look)).run(workers)
            seconds, spent = time.monotonic() - begun, processor_s() - spent
        assert np.isfinite(store.result().values).all()
    return (
        Number("large_s", seconds, f"study of {runs} monitor states, nine frames, two workers", "s"),
        Number("large_cpu_ms_per_state", 1e3 * spent / runs, "  processor time of a state", "ms"),
        Number("large_memory_gib", largest[0] / 2**30, "  memory of all processes", "GiB"),
    )


def measure(bench: Workbench, quick: bool) -> Speed:
    """States per second of two workers; the processor time of the engine itself, which is that of this process."""
    numbers, rate = [], {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        study = write_study(folder / "in", ("runs: 100", f"runs: {QUICK_RUNS if quick else RUNS}"))
        plan = Plan.of(resolve_study(study))
        for count in (1, 2):
            with local_workers(count) as workers:
                warm(workers, plan, count)
                wall, own, runs = run_engine(folder / f"out{count}", plan, workers)
            rate[count] = runs / wall
            if count == 1:
                text = "  the engine itself: processor time"
                numbers.append(Number("overhead_ms_per_state", 1e3 * own / runs, text, "ms"))
    first = Number("states_per_s", rate[2], "study of a small monitor, two workers", "states/s")
    one = Number("one_worker_states_per_s", rate[1], "  one worker", "states/s")
    shared = Number("efficiency", rate[2] / (2.0 * rate[1]), "  two workers over twice one")
    return Speed((*measure_large(quick), first, one, *numbers, shared))
