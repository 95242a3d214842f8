"""Golden files: a snapshot of each job beside the machine that made it; written anew, or compared with."""

from __future__ import annotations

import json
import os
import platform
import re
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from tests.golden.compare import Comparison, compare
from tests.golden.digest import checksum
from tests.golden.jobs import Job, Runner
from tests.golden.snapshot import Reader

FOLDER = Path(__file__).parent
PACKAGES = (
    "drjit h5netcdf karellen-llvm-core matplotlib mitsuba numpy opencv-python-headless pyerfa pyproj salib scikit-fem"
    " scikit-learn scipy tifffile trimesh xarray"
).split()
"""Those that numbers, pictures or files come from."""


class NotComparable(Exception):
    """The golden file says nothing about a run here; the message says why."""


def machine() -> dict[str, Any]:
    """Return what the last digits depend on beside the program: kind of processor, and versions."""
    place = Path("/proc/cpuinfo")
    told = place.read_text().split("\n\n")[0] if place.exists() else platform.processor()
    kept = sorted(set(re.findall(r"^(?:vendor_id|cpu family|model.*?|stepping|flags)\s*:.*", told, re.M)))
    kernels = [os.environ.get(name, "") for name in ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")]
    return {
        "processor": f"{platform.machine()} {checksum(' '.join([*kept, *kernels]))}",
        "packages": {name: metadata.version(name) for name in PACKAGES},
    }


@dataclass(frozen=True)
class Outcome:
    """A job run and compared.

    Attributes:
        job: its name.
        seconds: that it took.
        comparison: with the golden file.
        elsewhere: in what this machine differs from the golden file's; empty where in nothing.
    """

    job: str
    seconds: float
    comparison: Comparison
    elsewhere: str

    def lines(self) -> list[str]:
        """Return the status, then every difference."""
        status = f"{self.job}: {self.comparison.status}{self.elsewhere} ({self.seconds:.1f} s)"
        return [status, *(f"  {self.job} / {one}" for one in self.comparison.far)]


def golden_file(name: str) -> Path:
    """Return where a job's golden file is."""
    return FOLDER / f"{name}.json"


def take(job: Job, runner: Runner) -> tuple[dict[str, Any], float]:
    """Return a job's snapshot as it is after writing and reading, and the seconds that the job took."""
    done = runner.run(job)
    return json.loads(json.dumps(Reader(done).snapshot())), done.seconds


def write(job: Job, runner: Runner) -> tuple[int, float]:
    """Make a golden file anew.

    Returns:
        its size in bytes, and the seconds that the job took.
    """
    snapshot, seconds = take(job, runner)
    parts = {"job": job.name, "commands": [" ".join(words) for words in job.commands], **machine()}
    lines = [f"{json.dumps(key)}: {_compact(value)}" for key, value in parts.items()]
    run_lines = [f"{json.dumps(key)}: {_compact(value)}" for key, value in snapshot.items()]
    text = "{\n" + ",\n".join(lines) + ',\n"run": {\n' + ",\n".join(run_lines) + "\n}\n}\n"
    golden_file(job.name).write_text(text, "utf-8")
    return len(text.encode()), seconds


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)


def check(job: Job, runner: Runner) -> Outcome:
    """Run a job and compare it with its golden file, on whatever machine.

    Raises:
        NotComparable: there is no golden file.
    """
    path = golden_file(job.name)
    if not path.exists():
        raise NotComparable(f"{job.name}: no golden file; python -m tests.golden --write --only {job.name} makes it")
    kept, here = json.loads(path.read_text("utf-8")), machine()
    other = [
        f"{name} {here['packages'][name]} instead of {old}"
        for name, old in kept["packages"].items()
        if here["packages"].get(name) != old
    ]
    if here["processor"] != kept["processor"]:
        other.insert(0, "another processor")
    snapshot, seconds = take(job, runner)
    told = f"; {', '.join(other)}" if other else ""
    return Outcome(job.name, seconds, compare(job.name, kept["run"], snapshot), told)
