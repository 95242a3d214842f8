"""Commands as a user runs them, start of Python included: help, completion, a bad file, the main job with an empty
kernel cache and again.

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

from tests.benchmarks.number import Number, Speed
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from twin.run.console import PROGRAMS as ALL_PROGRAMS

ROOT = Path(__file__).resolve().parents[2]
START = pace(start=1.0)
COLD, WARM = pace(compile=0.7, start=0.3), pace(start=0.5, python=0.3, arithmetic=0.2)
COLD_S, WARM_S, HELP_S = 6.0, 2.5, 0.5
"""Wanted: of the clock for the main job, with an empty and a filled cache, and processor time of help."""
PROGRAMS = tuple(module for module, _ in ALL_PROGRAMS.values())
READ = (
    *(("twin.render",), ("twin.study",), ("twin.design", "camera"), ("twin.design", "monitor"), ("twin.lab", "focus")),
    *(("twin.orbit", "angle"), ("twin.orbit", "adjust"), ("twin.camera",), ("twin.live",), ("twin.recover",)),
    *(("twin.uncertainty",), ("twin.tolerance",), ("twin.asbuilt", "estimate"), ("twin.operate", "status")),
)
"""Commands that are given a file they cannot read, and a record that is not one."""
BAD = "instrument: gf7_pair\nperturb: {base/forward/M2: {shift: [0 um, 0 um, 3 arcsec]}}\nno_such_key: 1\n"
COMPLETION = {"_CAMTWIN_COMPLETE": "complete_bash", "COMP_WORDS": "camtwin render --", "COMP_CWORD": "2"}
"""What a shell asks for after ``camtwin render --`` and the tabulator."""


def user(home: Path) -> dict[str, str]:
    """Environment of a user with this home, whose Python keeps compiled modules there."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
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


def _slowest(seconds: dict[str, float]) -> str:
    return max(seconds, key=lambda name: seconds[name])


def start_cpu(words: tuple[str, ...], code: int, environment: dict[str, str]) -> float:
    """Processor time of Python with these arguments, which ends with this exit code, user and system, seconds; the
    shortest of three runs, of which the first compiles the modules.

    Of the wall time a busy machine gives any share.
    """
    spent = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, *words]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, timeout=120, check=False)
        spent.append(_spent_since(before))
        assert done.returncode == code, (words, done.stderr)
    return min(spent)


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds of the whole command."""
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        run_job(home, home / "first")  # Python compiles the modules
        shutil.rmtree(home / ".drjit")
        bench.look()
        cold, cold_cpu = run_job(home, home / "cold")
        assert any((home / ".drjit").iterdir())
        (home / "bad.yaml").write_text(BAD, "utf-8")
        place = user(home)
        bench.look()
        shown = {program: start_cpu(("-m", program, "--help"), 0, place) for program in PROGRAMS}
        asked = ("-c", "from twin.run.console import main; main()")
        completed = start_cpu(asked, 0, {**place, **COMPLETION})
        imported = start_cpu(("-c", "import twin"), 0, place)
        bench.look()
        refused = {words: start_cpu(("-m", *words, str(home / "bad.yaml")), 2, place) for words in READ}
        unknown = start_cpu(("-m", "twin.validate", "--only", "no.such.check"), 2, place)
        again = []
        for i in range(1 if quick else 3):
            bench.look()
            again.append(run_job(home, home / f"warm{i}"))
    warm, warm_cpu = (min(one[k] for one in again) for k in (0, 1))
    slowest = f"--help of {_slowest(shown)}: processor time"
    bad = "a bad file, the slowest command: processor time"
    unknown_check = "an unknown check of twin.validate: processor time"
    return Speed(
        (
            Number("help_s", max(shown.values()), slowest, "s", START, limited=True, target=HELP_S),
            Number("completion_s", completed, "completion of an option: processor time", "s", START, limited=True),
            Number("import_s", imported, "import twin: processor time", "s", START, limited=True),
            Number("bad_s", max(refused.values()), bad, "s", START, limited=True),
            Number("unknown_s", unknown, unknown_check, "s", START, limited=True),
            Number("cold_s", cold, "main job, empty kernel cache", "s", COLD, limited=True, target=COLD_S, clock=True),
            Number("cold_cpu_s", cold_cpu, "  processor time", "s", COLD, limited=True),
            Number(
                "warm_s", warm, "main job, kernels in the cache", "s", WARM, limited=True, target=WARM_S, clock=True
            ),
            Number("warm_cpu_s", warm_cpu, "  processor time", "s", WARM, limited=True),
        )
    )
