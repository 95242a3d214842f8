"""Commands as a user runs them, start of Python included: help, a bad file, the main job with an empty kernel cache and
again.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.number import Limit, Number, Speed
from tests.benchmarks.workbench import Workbench

ROOT = Path(__file__).resolve().parents[2]
COLD_S, WARM_S, START_S = 12.0, 4.0, 2.0
PROGRAMS = (
    *("twin.render", "twin.lab", "twin.orbit", "twin.study", "twin.design", "twin.validate", "twin.compare"),
    *("twin.doctor", "twin.live", "twin.recover", "scenes.schema", "analysis.mtf"),
)
READ = (("twin.render",), ("twin.study",), ("twin.design",), ("twin.lab", "focus"), ("twin.orbit", "angle"))
BAD = "instrument: gf7_pair\nperturb: {base/forward/M2: {shift: [0 um, 0 um, 3 arcsec]}}\nno_such_key: 1\n"
START = Limit(START_S)


def run_job(home: Path, out: Path) -> float:
    """Wall time, seconds; the kernels are kept in HOME."""
    command = [sys.executable, "-m", "twin.render", "scenes/examples/perturb.yaml", "--out", str(out), "--quiet"]
    environment = {**os.environ, "HOME": str(home)}
    begun = time.monotonic()
    subprocess.run(command, cwd=ROOT, env=environment, check=True, timeout=300)
    return time.monotonic() - begun


def _slowest(seconds: dict[str, float]) -> str:
    return max(seconds, key=lambda name: seconds[name])


def start_cpu(words: tuple[str, ...], code: int) -> float:
    """Processor time of a command that ends with this exit code, user and system, seconds; the shorter of two runs.

    Of the wall time a busy machine gives any share.
    """
    spent = []
    for _ in range(2):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run([sys.executable, "-m", *words], cwd=ROOT, capture_output=True, timeout=120, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode == code, (words, done.stderr)
        spent.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return min(spent)


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds of the whole command."""
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        cold = run_job(home, home / "cold")
        assert any((home / ".drjit").iterdir())
        (home / "bad.yaml").write_text(BAD, "utf-8")
        shown = {program: start_cpu((program, "--help"), 0) for program in PROGRAMS}
        refused = {words: start_cpu((*words, str(home / "bad.yaml")), 2) for words in READ}
        unknown = start_cpu(("twin.validate", "--only", "no.such.check"), 2)
        warm = min(run_job(home, home / f"warm{i}") for i in range(1 if quick else 3))
    return Speed(
        (
            Number("help_s", max(shown.values()), f"--help of {_slowest(shown)}: processor time", "s", START),
            Number("bad_s", max(refused.values()), "a bad file, the slowest command: processor time", "s", START),
            Number("unknown_s", unknown, "an unknown check of twin.validate: processor time", "s", START),
            Number("cold_s", cold, "main job, empty kernel cache", "s", Limit(COLD_S)),
            Number("warm_s", warm, "main job, kernels in the cache", "s", Limit(WARM_S)),
        )
    )
