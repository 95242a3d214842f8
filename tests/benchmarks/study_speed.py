"""Design trade studies: many states by two workers."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from tests.benchmarks.workbench import Number, Speed, Workbench, processor_s
from tests.twin.study_bench import write_study
from twin.framework.cluster import local_workers
from twin.study.runs.blocks import BLOCKS, Engine, journal_of
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study

STATES, QUICK_STATES = 10_000, 200
"""States of the pair's monitor with nine frames, which share their noise: the frames before are taken once."""


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds for all states, start of the workers and compilation not included; memory of all processes together."""
    runs = QUICK_STATES if quick else STATES
    changes = (("runs: 100", f"runs: {runs}"), ("file: job.yaml", "file: perturb"))
    largest = [0]

    def look(done: int, total: int) -> None:
        own = psutil.Process()
        largest[0] = max(largest[0], sum(p.memory_info().rss for p in (own, *own.children(recursive=True))))

    with tempfile.TemporaryDirectory() as name:
        study = write_study(Path(name) / "in", *changes, ("responses:", "noise: shared\nresponses:"))
        plan = Plan.of(resolve_study(study))
        with local_workers(2) as workers, journal_of(plan.setup, Path(name) / BLOCKS) as journal:
            begun, spent = time.monotonic(), processor_s()
            engine = Engine(plan, journal, advance=look)
            engine.run(workers)
            seconds, spent = time.monotonic() - begun, processor_s() - spent
        assert np.isfinite(engine.result().values).all()
    what = f"study of {runs} monitor states, nine frames, two workers"
    return Speed(
        (
            Number("large_s", seconds, what, "s"),
            Number("large_cpu_ms_per_state", 1e3 * spent / runs, "  processor time of a state", "ms"),
            Number("large_memory_gib", largest[0] / 2**30, "  memory of all processes", "GiB"),
        )
    )
