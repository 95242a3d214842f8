"""Commands as a user runs them, start of Python included: help, and the main job with an empty kernel cache and again.

Python's own cache of compiled modules is there, as from a user's second start on.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.workbench import Number, Speed, Workbench
from twin.framework.console import PROGRAMS as ALL_PROGRAMS
from twin.monitor.calibration_cache import VARIABLE

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = tuple(module for module, _ in ALL_PROGRAMS.values())


def user(home: Path) -> dict[str, str]:
    """Environment of a user with this home, whose Python keeps compiled modules there."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONDONTWRITEBYTECODE", VARIABLE)}
    return {**kept, "HOME": str(home), "PYTHONPYCACHEPREFIX": str(home / "compiled")}


def run_job(home: Path, out: Path) -> tuple[float, float]:
    """Wall time and processor time, seconds; the kernels are kept in HOME."""
    command = [sys.executable, "-m", "twin.render", "scenes/examples/perturb.yaml", "--out", str(out), "--quiet"]
    begun, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, cwd=ROOT, env=user(home), check=True, timeout=900)
    return time.monotonic() - begun, _spent_since(before)


def _spent_since(before: resource.struct_rusage) -> float:
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def start_cpu(words: tuple[str, ...], environment: dict[str, str]) -> float:
    """Return the processor time of Python with these arguments, user and system, seconds; the shortest of three runs,
    of which the first compiles the modules. Of the wall time a busy machine gives any share.
    """
    spent = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [sys.executable, *words], cwd=ROOT, env=environment, capture_output=True, timeout=120, check=True
        )
        spent.append(_spent_since(before))
    return min(spent)


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds of the whole command."""
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        run_job(home, home / "first")  # Python compiles the modules
        for cache in (".drjit", ".cache"):
            shutil.rmtree(home / cache)
        cold, cold_cpu = run_job(home, home / "cold")
        assert any((home / ".drjit").iterdir())
        place = user(home)
        shown = {program: start_cpu(("-m", program, "--help"), place) for program in PROGRAMS}
        imported = start_cpu(("-c", "import twin"), place)
        again = [run_job(home, home / f"warm{i}") for i in range(1 if quick else 3)]
    warm, warm_cpu = (min(one[k] for one in again) for k in (0, 1))
    slowest = f"--help of {max(shown, key=shown.__getitem__)}: processor time"
    return Speed(
        (
            Number("help_s", max(shown.values()), slowest, "s"),
            Number("import_s", imported, "import twin: processor time", "s"),
            Number("cold_s", cold, "main job, empty caches", "s"),
            Number("cold_cpu_s", cold_cpu, "  processor time", "s"),
            Number("warm_s", warm, "main job, kernels and calibration in the caches", "s"),
            Number("warm_cpu_s", warm_cpu, "  processor time", "s"),
        )
    )
