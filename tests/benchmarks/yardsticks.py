"""How fast the machine is while a benchmark runs: fixed calculations that use nothing of the project.

A processor that is shared with others, or another one, makes all work slower, each kind of work by a factor of its own.
So each kind has a yardstick here, which is taken before, between and after the turns of a benchmark, and a time is
told twice: as it was measured, and as it would be on the machine whose yardsticks `limits.json` states. The second is
the first over the slowness, the mean of the yardsticks' ratios with the shares that the number states (`Pace`).
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Any

import numpy as np

from optics.numerics.llvm import ensure_llvm
from optics.numerics.threads import one_blas_thread, one_kernel_thread

FMA_WIDTH, FMA_CHAINS, FMA_LENGTH = 1 << 14, 8, 64
FMA_FLOPS = 2.0 * FMA_WIDTH * FMA_CHAINS * FMA_LENGTH
"""Operations of `fused_multiplies`, all of them in registers."""
COPIED = 1 << 23
COPY_BYTES = 2.0 * 8.0 * COPIED
"""Read and written by `copy`: no cache holds so much."""
COMPILED = """
import time
import drjit as dr
from drjit.llvm import Float64
dr.set_thread_count(1)
value = start = dr.opaque(Float64, 0.5, 16)
for k in range(400):
    value = dr.sqrt(dr.fma(value, value, 0.1 * k)) / (1.0 + value)
begun = time.process_time()
dr.eval(value)
dr.sync_thread()
print(time.process_time() - begun)
"""
"""A kernel of 1200 operations; in a home without a cache LLVM compiles it."""


@dataclass(frozen=True)
class Yardstick:
    """One kind of work.

    Attributes:
        name, text: for the page.
        prepared: makes what takes the yardstick, once or several times: seconds of processor time of one.
    """

    name: str
    text: str
    prepared: Callable[[], Callable[[], float]]


def fused_multiplies() -> Callable[[], None]:
    """What computes `FMA_FLOPS` on one core; compiled already."""
    ensure_llvm()
    import drjit as dr
    from drjit.llvm import Float64

    start, factor = dr.opaque(Float64, 0.5, FMA_WIDTH), dr.opaque(Float64, 0.999, FMA_WIDTH)

    def multiply() -> None:
        values = [start + 0.01 * k for k in range(FMA_CHAINS)]
        for _ in range(FMA_LENGTH):
            values = [dr.fma(value, factor, start) for value in values]
        dr.eval(sum(values[1:], values[0]))
        dr.sync_thread()

    multiply()
    return multiply


def copy() -> Callable[[], None]:
    """What copies `COPY_BYTES`, half of them read; the memory is there already."""
    source = np.ones(COPIED)
    target = np.zeros_like(source)
    return lambda: np.copyto(target, source)


class _Line:
    def __init__(self, slope: float, level: float) -> None:
        self.slope = slope
        self.level = level

    def at(self, place: float) -> float:
        return self.slope * place + self.level


def interpreted() -> None:
    """Objects, calls and dictionaries, and arrays so small that NumPy's calls are most of the work."""
    values: dict[int, float] = {}
    for k in range(8000):
        values[k % 100] = _Line(k, 1.0).at(k)
    small = np.arange(12.0).reshape(3, 4)
    for _ in range(1000):
        np.sum(small @ small.T + 1.0)


def processor_time(work: Callable[[], object], times: int = 1) -> float:
    """Seconds of processor time of some work, the mean of some times."""
    begun = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - begun) / times


def _arithmetic() -> Callable[[], float]:
    multiply = fused_multiplies()

    def take() -> float:
        with one_kernel_thread():
            return processor_time(multiply, 30)

    return take


def _python() -> Callable[[], float]:
    def take() -> float:
        with one_blas_thread():
            return processor_time(interpreted, 3)

    return take


def _start() -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", "import numpy"], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def _compile() -> float:
    with tempfile.TemporaryDirectory() as home:
        place = {**os.environ, "HOME": home}
        done = subprocess.run([sys.executable, "-c", COMPILED], env=place, check=True, capture_output=True, text=True)
    return float(done.stdout)


YARDSTICKS = {
    one.name: one
    for one in (
        Yardstick("python", "Python objects and small arrays", _python),
        # the memory of the copy is given back between looks, so that a benchmark that counts memory does not count it
        Yardstick("memory", "a copy of 64 MiB", lambda: lambda: processor_time(copy(), 2)),
        Yardstick("arithmetic", "fused multiply-adds in registers", _arithmetic),
        Yardstick("start", "a process that imports NumPy", lambda: _start),
        Yardstick("compile", "a kernel of 1200 operations compiled by LLVM", lambda: _compile),
    )
}
INSIDE = ("python", "memory", "arithmetic")
"""Yardsticks that take some hundredths of a second in this process."""
OUTSIDE = ("start", "compile")
"""Yardsticks that take processes of their own, and a second."""


@dataclass(frozen=True)
class Pace:
    """What a number scales with.

    Attributes:
        shares: yardstick -> share of the time that is such work on the machine of reference; their sum is 1.
    """

    shares: Mapping[str, float]

    def slowness(self, now: Mapping[str, float], reference: Mapping[str, float]) -> float:
        """How many times as long as on the machine of reference such work takes.

        Args:
            now, reference: yardstick -> seconds here and there.
        """
        return sum(share * now[name] / reference[name] for name, share in self.shares.items())

    @property
    def text(self) -> str:
        """For the page."""
        if len(self.shares) == 1:
            return next(iter(self.shares))
        return " ".join(f"{name} {share:.0%}" for name, share in self.shares.items())


def pace(**shares: float) -> Pace:
    """Of shares by the yardsticks' names.

    Raises:
        ValueError: there is no such yardstick, or the sum is not 1.
    """
    if unknown := shares.keys() - YARDSTICKS.keys():
        raise ValueError(f"no yardstick {', '.join(sorted(unknown))}")
    if abs(sum(shares.values()) - 1.0) > 1e-9:
        raise ValueError(f"shares of {shares} make {sum(shares.values()):g}, not 1")
    return Pace(shares)


class Watch:
    """Yardsticks that are taken again and again while a benchmark runs."""

    def __init__(self, names: Sequence[str]) -> None:
        self._takes = {name: YARDSTICKS[name].prepared() for name in names}
        self._taken: dict[str, list[float]] = {name: [] for name in names}

    def look(self, _: Any = None) -> None:
        """Take each yardstick once."""
        for name, take in self._takes.items():
            self._taken[name].append(take())

    @property
    def seconds(self) -> dict[str, float]:
        """Yardstick -> the mean of those that were taken: work takes long enough for good and bad moments."""
        return {name: mean(taken) for name, taken in self._taken.items() if taken}
