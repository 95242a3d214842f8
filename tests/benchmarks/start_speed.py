"""The main job as a user runs it, start of Python included: with an empty kernel cache, and again."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.number import Limit, Number, Speed
from tests.benchmarks.workbench import Workbench

ROOT = Path(__file__).resolve().parents[2]
COLD_S, WARM_S = 25.0, 8.0


def run_job(home: Path, out: Path) -> float:
    """Wall time, seconds; the kernels are kept in HOME."""
    command = [sys.executable, "-m", "twin.render", "scenes/examples/perturb.yaml", "--out", str(out), "--quiet"]
    environment = {**os.environ, "HOME": str(home)}
    begun = time.monotonic()
    subprocess.run(command, cwd=ROOT, env=environment, check=True, timeout=300)
    return time.monotonic() - begun


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds of the whole command."""
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        cold = run_job(home, home / "cold")
        assert any((home / ".drjit").iterdir())
        warm = min(run_job(home, home / f"warm{i}") for i in range(1 if quick else 3))
    return Speed(
        (
            Number("cold_s", cold, "main job, empty kernel cache", "s", Limit(COLD_S)),
            Number("warm_s", warm, "main job, kernels in the cache", "s", Limit(WARM_S)),
        )
    )
