"""Tolerances: ten thousand cameras with nine fields and three compensators, every one traced exactly and adjusted."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from scenes.specs.load import EXAMPLES
from scenes.specs.tolerance import resolve_tolerance
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.workbench import Workbench
from twin.run.memory import largest_memory
from twin.tolerance.merit_models import sensitivities
from twin.tolerance.samples import Workforce, draw_samples
from twin.tolerance.tolerance_bench import ToleranceBench

CAMERAS, QUICK_CAMERAS = 10_000, 400


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds from the start of two workers to the last camera; processor time of a camera; of all derivatives."""
    count = QUICK_CAMERAS if quick else CAMERAS
    with tempfile.TemporaryDirectory() as name:
        setup = resolve_tolerance(EXAMPLES / "tolerance_gf7.yaml")
        camera = ToleranceBench(setup, bench.backend)
        sensitivities(camera)  # compiles
        start = time.process_time()
        sensitivities(camera)
        derived = time.process_time() - start
        start = time.monotonic()
        drawn = draw_samples(setup, camera, bench.backend, count, 1, Workforce(2, None, Path(name) / "journal"))
        spent = time.monotonic() - start
    assert not any(drawn.problems)
    assert np.all(np.isfinite(drawn.values))
    text = f"{count} cameras with nine fields and three compensators, two workers"
    each = 1e3 * drawn.seconds / count
    return Speed(
        (
            Number("seconds", spent, text, "s"),
            Number("camera_ms", each, "  processor time of a camera", "ms"),
            Number("derivatives_ms", 1e3 * derived, f"  first and second derivatives by {len(camera.numbers)}", "ms"),
            Number("memory_mb", 1e-6 * largest_memory(), "  memory of this process", "MB"),
        ),
    )
