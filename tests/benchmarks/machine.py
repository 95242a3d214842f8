"""The machine that the numbers belong to, and whether it has other things to do."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from optics.numerics.threads import cores

PACKAGES = ("drjit", "mitsuba", "karellen-llvm-core", "numpy", "scipy", "dask", "batoid", "optiland", "poppy")
BUSY_SHARE = 0.25
"""Load per core, beyond this program's, from which the numbers are worse than the program deserves."""


@dataclass(frozen=True)
class Machine:
    """What ran the benchmarks.

    Attributes:
        processor: model name.
        cores: that this process may use.
        memory_gib: in the machine.
        system, python: names with versions.
        versions: package -> version, ``not installed`` for those that are not.
        load_1min, load_5min: load average before the run.
    """

    processor: str
    cores: int
    memory_gib: float
    system: str
    python: str
    versions: dict[str, str]
    load_1min: float
    load_5min: float

    @classmethod
    def here(cls) -> Machine:
        """This one, now."""
        loads = os.getloadavg()
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
        return cls(
            _processor(),
            cores(),
            round(memory, 1),
            platform.platform(),
            platform.python_version(),
            {package: _version(package) for package in PACKAGES},
            round(loads[0], 2),
            round(loads[1], 2),
        )

    @property
    def busy(self) -> bool:
        """Whether others used it before the run."""
        return self.load_1min > BUSY_SHARE * self.cores

    @property
    def data(self) -> dict[str, Any]:
        """For the JSON."""
        return {**asdict(self), "busy": self.busy}

    @property
    def lines(self) -> tuple[str, ...]:
        """For the terminal."""
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        out = [
            f"machine: {self.processor}, {self.cores} cores, {self.memory_gib:g} GiB, {self.system}",
            f"Python {self.python}, {versions}",
            f"load average before the run: {self.load_1min:g} (1 min), {self.load_5min:g} (5 min)",
        ]
        if self.busy:
            out.append("the machine is busy: times are longer than on an idle one; ratios were taken in turns")
        return tuple(out)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    names = [line for line in info.read_text().splitlines() if line.startswith("model name")] if info.exists() else []
    return names[0].partition(":")[2].strip() if names else platform.processor() or platform.machine()
