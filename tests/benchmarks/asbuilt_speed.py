"""One instrument as built: nine wavefronts and sixty motions, estimated on the exact trace."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from scenes.specs.asbuilt import resolve_asbuilt
from scenes.yaml.yaml_file import dump_yaml
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from twin.asbuilt.asbuilt_bench import AsBuiltBench

PACE = pace(python=0.6, arithmetic=0.4)
FIGURES = {f"Z{j}": "5 nm" for j in range(5, 17)}
PRIOR = {
    "name": "sixty",
    "causes": {
        "mirrors": {"bodies": "base/gf7/M?", "shift": "100 um", "rotate": "20 arcsec", "reason": "speed"},
        "plane": {"bodies": "base/gf7/focal_plane", "shift": "300 um", "rotate": "60 arcsec", "reason": "speed"},
        "figures": {"bodies": "base/gf7/M?", "figure": FIGURES, "reason": "speed"},
    },
}
FIELDS = [[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]
TEST = {
    "instrument": "gf7",
    "prior": "./sixty.yaml",
    "measurements": {"wavefronts": {"interferometer": {"fields": FIELDS, "sigma": "5 nm"}}},
    "merits": {"wavefront": {"kind": "wavefront", "at_most": 0.0714}},
    "simulate": {},
}
REPEATS = 5


def measure(bench: Workbench, quick: bool) -> Speed:
    """Processor time from measured wavefronts to a settled estimate; derivatives over one forward trace."""
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "sixty.yaml").write_text(dump_yaml(PRIOR), "utf-8")
        file = Path(name) / "asbuilt.yaml"
        file.write_text(dump_yaml(TEST), "utf-8")
        built = AsBuiltBench(resolve_asbuilt(file), bench.backend)
    rng = np.random.default_rng(1)
    data = built.measured(built.draw(rng, "normal"), rng)
    found = built.estimate(data)  # compiles
    spent = []
    for _ in range(1 if quick else REPEATS):
        bench.look()
        start = time.process_time()
        found = built.estimate(data)
        spent.append(time.process_time() - start)
    assert found.converged
    count = len(built.parameters.labels)
    one, all_of = (
        min(_seconds(work) for _ in range(REPEATS))
        for work in (lambda: built.predict(found.mean[None]), lambda: built.slope(found.mean))
    )
    text = f"{len(FIELDS)} fields, {count} motions, {found.steps} steps: processor time"
    return Speed(
        (
            Number("cpu_s", min(spent), text, "s", PACE, limited=True),
            Number("slope_traces", all_of / one, "  derivatives, in forward traces of one state", limited=True),
            Number("slope_ms", 1e3 * all_of, "  processor time of the derivatives", "ms", PACE),
        )
    )


def _seconds(work: object) -> float:
    assert callable(work)
    start = time.process_time()
    work()
    return time.process_time() - start
