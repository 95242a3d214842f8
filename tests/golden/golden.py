"""Golden files: a snapshot of each job beside the machine that made it; written anew, or compared with."""

from __future__ import annotations

import hashlib
import json
import platform
import tempfile
import time
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from tests.golden.compare import Comparison, compare, compare_elsewhere
from tests.golden.fields import fields_of, kept_fields, write_fields
from tests.golden.jobs import Job, run
from tests.golden.snapshot import Reader

FOLDER = Path(__file__).parent
PACKAGES = (
    "drjit",
    "h5netcdf",
    "karellen-llvm-core",
    "matplotlib",
    "mitsuba",
    "numpy",
    "opencv-python-headless",
    "pyerfa",
    "pyproj",
    "salib",
    "scikit-fem",
    "scikit-learn",
    "scipy",
    "tifffile",
    "trimesh",
    "xarray",
)
"""Those that numbers, pictures or files come from."""


class NotComparable(Exception):
    """The golden file says nothing about a run here; the message says why."""


def machine() -> dict[str, Any]:
    """What numbers depend on beside the program: kind of processor, and versions."""
    told: dict[str, str] = {}
    try:
        for line in Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines():
            key, _, value = line.partition(":")
            told[key.strip()] = value.strip()
    except OSError:
        told["model name"] = platform.processor()
    kinds = ("vendor_id", "cpu family", "model", "model name", "stepping")
    flags = " ".join(sorted(told.get("flags", "").split()))
    processor = {key: told.get(key, "") for key in kinds}
    processor |= {"architecture": platform.machine(), "flags": hashlib.sha256(flags.encode()).hexdigest()[:16]}
    return {
        "processor": processor,
        "packages": {name: _version(name) for name in PACKAGES},
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


@dataclass(frozen=True)
class Outcome:
    """A job run and compared.

    Attributes:
        job: its name.
        seconds: that it took.
        comparison: with the golden file.
        elsewhere: whether this is another processor than the golden file's, where less is promised.
    """

    job: str
    seconds: float
    comparison: Comparison
    elsewhere: bool

    def lines(self) -> list[str]:
        """What is to be told: the status, then every difference."""
        where = ", on another processor: only what is promised there" if self.elsewhere else ""
        status = f"{self.job}: {self.comparison.status}{where} ({self.seconds:.1f} s)"
        return [status, *(f"  {self.job} / {one}" for one in self.comparison.differences)]


def golden_file(name: str) -> Path:
    """Where a job's golden file is."""
    return FOLDER / f"{name}.json"


def take(job: Job) -> tuple[dict[str, Any], dict[str, Any], float]:
    """A job's snapshot and the fields of its files, as they are after writing and reading; the seconds that it took."""
    with tempfile.TemporaryDirectory(prefix="golden-") as here:
        start = time.perf_counter()
        done = run(job, Path(here))
        seconds = time.perf_counter() - start
        return json.loads(json.dumps(Reader(done).snapshot())), json.loads(json.dumps(fields_of(done.out))), seconds


def write(job: Job) -> tuple[int, float]:
    """Make a golden file anew.

    Returns:
        its size in bytes, and the seconds that the command took.
    """
    snapshot, fields, seconds = take(job)
    write_fields(job.name, fields)
    parts = {"job": job.name, "words": list(job.words), **machine()}
    lines = [f"{json.dumps(key)}: {_compact(value)}" for key, value in parts.items()]
    run_lines = [f"{json.dumps(key)}: {_compact(value)}" for key, value in snapshot.items()]
    text = "{\n" + ",\n".join(lines) + ',\n"run": {\n' + ",\n".join(run_lines) + "\n}\n}\n"
    golden_file(job.name).write_text(text, "utf-8")
    return len(text.encode()), seconds


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)


def check(job: Job) -> Outcome:
    """Run a job and compare it with its golden file.

    Raises:
        NotComparable: there is none, or it was made with other packages, where nothing is promised.
    """
    path = golden_file(job.name)
    if not path.exists():
        raise NotComparable(f"{job.name}: no golden file; python -m tests.golden --write --only {job.name} makes it")
    kept, here = json.loads(path.read_text("utf-8")), machine()
    other = [
        f"{name} {here['packages'][name]} instead of {kept['packages'].get(name)}"
        for name in PACKAGES
        if here["packages"][name] != kept["packages"].get(name)
    ]
    if other:
        raise NotComparable(f"{job.name}: made with other packages: {', '.join(other)}")
    elsewhere = here["processor"] != kept["processor"]
    snapshot, fields, seconds = take(job)
    before = kept["run"]
    found = compare_elsewhere(before, snapshot, job.promised) if elsewhere else compare(before, snapshot)
    same = compare({"fields": kept_fields(job.name)}, {"fields": fields})
    return Outcome(job.name, seconds, Comparison([*found.differences, *same.differences]), elsewhere)
