"""Speed of design trade studies: what the engine adds to a state, how two workers share the work, a large study."""

import time

import numpy as np
import psutil
import pytest

from tests.twin.study_bench import write_study
from twin.study.chunk_store import ChunkStore
from twin.study.cluster import local_workers
from twin.study.engine import Engine, Progress
from twin.study.plan import Plan
from twin.study.render_base import BLOCK
from twin.study.setup import resolve_study
from twin.study.task import ONE_THREAD, Task, evaluate

OVERHEAD_MS = 1.0
EFFICIENCY = 0.85
LARGE, LARGE_SECONDS, LARGE_BYTES = 10_000, 200.0, 4 * 2**30


def run_engine(folder, plan, workers, chunk_blocks=4):
    """Seconds from the pilot's end to the last chunk, seconds that workers were busy meanwhile, runs done."""
    store = ChunkStore(folder, plan)
    store.open()
    begun = []
    engine = Engine(plan, store, progress=Progress(start=lambda _: begun.append(time.monotonic())))
    engine.chunk_blocks = chunk_blocks
    engine.run(workers)
    busy = sum(store.read(entry).seconds for first, entry in store.entries.items() if first > 0)
    return time.monotonic() - begun[0], busy, plan.runs - BLOCK


def warm(workers, plan, count):
    """Let every worker build the instrument and compile before anything is timed."""
    task = Task(plan.setup.to_yaml(), "llvm", 0, (tuple(next(plan.runs_of(range(1)))),))
    for future in [
        workers.client.submit(evaluate, task, workers=[address], pure=False)
        for address in workers.client.scheduler_info(n_workers=-1)["workers"]
    ]:
        future.result()
    assert workers.count == count


@pytest.mark.slow
def test_engine_adds_less_than_a_millisecond(tmp_path, benchmark) -> None:
    """Wall time of one worker less the time that it was busy: plan, hand-over, store; at most 1 ms a state."""
    plan = Plan.of(resolve_study(write_study(tmp_path / "in", ("runs: 100", "runs: 525"))))
    with local_workers(1) as workers:
        warm(workers, plan, 1)
        wall, busy, runs = benchmark.pedantic(lambda: run_engine(tmp_path / "out", plan, workers), rounds=1)
    milliseconds = 1e3 * (wall - busy) / runs
    benchmark.extra_info.update(overhead_ms=milliseconds, ms_per_state=1e3 * busy / runs)
    assert milliseconds <= OVERHEAD_MS, milliseconds


@pytest.mark.slow
def test_two_workers_share_the_work(tmp_path, benchmark) -> None:
    """States per second of two workers over twice those of one. Needs two cores that nobody else uses."""
    plan = Plan.of(resolve_study(write_study(tmp_path / "in", ("runs: 100", "runs: 1825"))))
    rate = {}
    for count in (1, 2):
        with local_workers(count) as workers:
            warm(workers, plan, count)
            wall, _, runs = run_engine(tmp_path / f"out{count}", plan, workers)
            rate[count] = runs / wall
    efficiency = rate[2] / (2.0 * rate[1])
    benchmark.extra_info.update(one=rate[1], two=rate[2], efficiency=efficiency)
    benchmark.pedantic(lambda: None, rounds=1)
    assert efficiency >= EFFICIENCY, rate


@pytest.mark.slow
def test_ten_thousand_states(tmp_path, benchmark) -> None:
    """The pair's monitor with nine frames: at most 200 s and 4 GiB in all processes on two cores.

    The states share their noise, so that the frames before are taken and measured once; noise of its own, with frames
    before and after for each state, costs 1.7 times as much.
    """
    changes = (
        ("runs: 100", f"runs: {LARGE}"),
        ("file: job.yaml", "file: perturb"),
        ("responses:", "noise: shared\nresponses:"),
    )
    study = write_study(tmp_path / "in", *changes)
    plan = Plan.of(resolve_study(study))
    store = ChunkStore(tmp_path, plan)
    store.open()
    largest = [0]

    def look(done: int, total: int) -> None:
        own = psutil.Process()
        largest[0] = max(largest[0], sum(p.memory_info().rss for p in (own, *own.children(recursive=True))))

    with local_workers(2) as workers:
        begun = time.monotonic()
        Engine(plan, store, progress=Progress(done=look)).run(workers)
        seconds = time.monotonic() - begun
    benchmark.extra_info.update(seconds=seconds, gib=largest[0] / 2**30, states_per_second=LARGE / seconds)
    benchmark.pedantic(lambda: None, rounds=1)
    assert np.isfinite(store.result().values).all()
    assert set(ONE_THREAD.values()) == {"1"}
    assert largest[0] <= LARGE_BYTES
    assert seconds <= LARGE_SECONDS, seconds
