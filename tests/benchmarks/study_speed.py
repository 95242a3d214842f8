"""Design trade studies: what the engine adds to a state, how two workers share the work."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from tests.benchmarks.number import Limit, Number, Speed
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
OVERHEAD_MS = 1.0
EFFICIENCY = 0.85


def run_engine(folder: Path, plan: Plan, workers: Workers, chunk_blocks: int = 4) -> tuple[float, float, int]:
    """Seconds from the pilot's end to the last chunk, seconds that workers were busy meanwhile, runs done."""
    store = ChunkStore(folder, plan)
    store.open()
    begun: list[float] = []
    engine = Engine(plan, store, progress=Progress(start=lambda _: begun.append(time.monotonic())))
    engine.chunk_blocks = chunk_blocks
    engine.run(workers)
    busy = sum(store.read(entry).seconds for first, entry in store.entries.items() if first > 0)
    return time.monotonic() - begun[0], busy, plan.runs - BLOCK


def warm(workers: Workers, plan: Plan, count: int) -> None:
    """Let every worker build the instrument and compile before anything is timed."""
    task = Task(plan.setup.to_yaml(), source_digest(), "llvm", 0, (tuple(next(plan.runs_of(range(1)))),))
    for future in [
        workers.client.submit(evaluate, task, workers=[address], pure=False)
        for address in workers.client.scheduler_info(n_workers=-1)["workers"]
    ]:
        future.result()
    assert workers.count == count


def measure(bench: Workbench, quick: bool) -> Speed:
    """States per second of two workers; the engine's own time: wall time of one worker less that it was busy."""
    numbers, rate = [], {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        study = write_study(folder / "in", ("runs: 100", f"runs: {QUICK_RUNS if quick else RUNS}"))
        plan = Plan.of(resolve_study(study))
        for count in (1, 2):
            with local_workers(count) as workers:
                warm(workers, plan, count)
                wall, busy, runs = run_engine(folder / f"out{count}", plan, workers)
            rate[count] = runs / wall
            if count == 1:
                overhead = 1e3 * (wall - busy) / runs
                numbers.append(
                    Number("overhead_ms_per_state", overhead, "  the engine's own time", "ms", Limit(OVERHEAD_MS))
                )
    first = Number("states_per_s", rate[2], "study of a small monitor, two workers", "states/s")
    one = Number("one_worker_states_per_s", rate[1], "  one worker", "states/s")
    shared = Number(
        "efficiency", rate[2] / (2.0 * rate[1]), "  two workers over twice one", "", Limit(EFFICIENCY, True)
    )
    return Speed((first, one, *numbers, shared), ("study: two workers' share needs two cores that nobody else uses",))
