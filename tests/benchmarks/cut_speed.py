"""MTF at nine fields of telescopes with obscured pupils, and of the same telescopes without their edges, in turns."""

from __future__ import annotations

import numpy as np

from scenes.models.camera_model import derive_camera
from scenes.specs.load import load_camera
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import Work, in_turns
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from twin.camera.camera_optics import CameraOptics

TELESCOPES, QUICK_TELESCOPES = ("ritchey_chretien", "cassegrain", "korsch"), ("korsch",)
FIELDS = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
ROUNDS = 7
PACE = pace(python=0.5, arithmetic=0.5)
WANTED = 2.0
"""Processor time of the obscured pupils over that of the free ones. By pieces of shadows it was 28, 18 and 5."""


def measure(bench: Workbench, quick: bool) -> Speed:
    """Times of both, and their ratio."""
    numbers = []
    for name in QUICK_TELESCOPES if quick else TELESCOPES:
        spec = load_camera(name)
        mirrors = {key: mirror.model_copy(update={"edges": None}) for key, mirror in spec.mirrors.items()}
        bare = derive_camera(spec.model_copy(update={"mirrors": mirrors}), bench.backend)
        cut, free = CameraOptics.alone(spec, bench.backend), CameraOptics.alone(bare, bench.backend)
        assert cut.model.edges
        assert not free.model.edges
        works = {
            "cut": Work(lambda _, cut=cut: cut.mtfs(FIELDS)),
            "free": Work(lambda _, free=free: free.mtfs(FIELDS)),
        }
        in_turns(works, 1)  # compiles
        spent = in_turns(works, 1 if quick else ROUNDS, bench.look)
        dark, open_ = (spent[kind].result for kind in ("cut", "free"))
        # the obscuration lowers the contrast of all but the highest frequencies
        assert all(np.max(b.limit - a.limit) > 0.03 for a, b in zip(dark, open_, strict=True))
        a, b = spent["cut"], spent["free"]
        numbers += [
            Number(
                f"{name}_cpu_ms", 1e3 * a.cpu_s, f"MTF of {name} at {len(FIELDS)} fields, processor time", "ms", PACE
            ),
            Number(f"{name}_free_cpu_ms", 1e3 * b.cpu_s, "  without its edges", "ms", PACE),
            Number(f"{name}_ratio_wall", a.wall_s / b.wall_s, "  obscured over free, wall time"),
            Number(
                f"{name}_ratio_free",
                a.cpu_s / b.cpu_s,
                "  obscured over free, processor time",
                limited=True,
                target=WANTED,
            ),
        ]
    return Speed(tuple(numbers))
