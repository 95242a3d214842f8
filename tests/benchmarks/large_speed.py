"""A study of ten thousand states: the pair's monitor with nine frames, two workers.

The states share their noise, so that the frames before are taken and measured once; noise of its own, with frames
before and after for each state, costs more.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import processor_s
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from tests.twin.study_bench import write_study
from twin.run.cluster import local_workers
from twin.study.runs.chunk_store import ChunkStore
from twin.study.runs.engine import Engine, Progress
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study

RUNS, QUICK_RUNS = 10_000, 200
WANTED_S = 50.0
"""Of the wall clock, for all of them on two cores."""
PACE = pace(python=0.4, arithmetic=0.4, memory=0.2)


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds for all states, start of the workers and compilation not included; memory of all processes together."""
    runs = QUICK_RUNS if quick else RUNS
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
    wanted = None if quick else WANTED_S
    return Speed(
        (
            Number(
                "states_per_s",
                runs / seconds,
                f"study of {runs} monitor states, nine frames",
                "states/s",
                PACE,
                True,
                clock=True,
            ),
            Number("seconds", seconds, "  all of them", "s", PACE, limited=True, target=wanted, clock=True),
            Number("cpu_ms_per_state", 1e3 * spent / runs, "  processor time of a state", "ms", PACE, limited=True),
            Number("memory_gib", largest[0] / 2**30, "  memory of all processes", "GiB", limited=True),
        )
    )
