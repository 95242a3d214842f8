"""Tolerances: ten thousand cameras with nine fields and three compensators, every one traced exactly and adjusted."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from scenes.specs.tolerance import resolve_tolerance
from scenes.yaml.yaml_file import dump_yaml
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.workbench import Workbench
from twin.run.memory import largest_memory
from twin.tolerance.merit_models import sensitivities
from twin.tolerance.samples import Workforce, draw_samples
from twin.tolerance.tolerance_bench import ToleranceBench

CAMERAS, QUICK_CAMERAS = 10_000, 400
MOTIONS = ("shift x", "shift y", "shift z", "rotate x", "rotate y", "radius")
LIMITS = {"shift": "10 um", "rotate": "5 arcsec", "radius": "20 ppm"}
BUDGET = {
    "instrument": "gf7",
    "tolerances": {
        f"{mirror}_{motion.replace(' ', '_')}": {"motion": f"{mirror} {motion}", "limit": LIMITS[motion.split()[0]]}
        for mirror in ("M1", "M2", "M3")
        for motion in MOTIONS
    },
    "compensators": {
        "focus": {"motion": "focal_plane shift z", "range": "1 mm"},
        "turn_x": {"motion": "M2 rotate x", "range": "2 arcmin"},
        "turn_y": {"motion": "M2 rotate y", "range": "2 arcmin"},
    },
    "merits": {
        "wavefront": {"kind": "wavefront", "at_most": 0.0714},
        "mtf": {"kind": "mtf", "at_least": 0.38},
        "principal_distance": {"kind": "principal_distance", "at_most": "0.5 mm"},
    },
}


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds from the start of two workers to the last camera; processor time of a camera; of all derivatives."""
    count = QUICK_CAMERAS if quick else CAMERAS
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "budget.yaml"
        file.write_text(dump_yaml(BUDGET), "utf-8")
        setup = resolve_tolerance(file)
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
