"""Bench of the benchmarks: their models, made once, their stopwatch, and the numbers that they find.

Times are wall time, and processor time of all threads.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.util import find_spec
from typing import Any

import psutil

from optics.numerics.backend import Backend, load_backend
from scenes.models.camera_model import CameraModel, derive_camera
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.specs.job import JobSpec
from scenes.specs.load import load_camera, load_instrument
from scenes.specs.resolved import resolve_job
from twin.monitor.monitor_experiment import MonitorExperiment


class Workbench:
    """Backend, cameras, instruments and experiments of the library; kernels stay compiled."""

    def __init__(self) -> None:
        self.camera = cache(self._camera)
        self.instrument = cache(self._instrument)
        self.experiment = cache(self._experiment)

    @cached_property
    def backend(self) -> Backend:
        """The processor's."""
        return load_backend("llvm")

    def _camera(self, name: str) -> CameraModel:
        return derive_camera(load_camera(name), self.backend)

    def _instrument(self, name: str) -> Instrument:
        spec = load_instrument(name)
        stems = {site.camera for site in spec.cameras.values()}
        return build_instrument(spec, {stem: load_camera(stem) for stem in stems}, self.backend)

    def _experiment(self, name: str) -> MonitorExperiment:
        return MonitorExperiment(resolve_job(JobSpec(instrument=name)), self.backend)


def installed(peer: str) -> bool:
    """Whether somebody else's package is there."""
    return find_spec(peer) is not None


def absent(peer: str) -> str:
    """The remark in its place."""
    return f"{peer} not installed (extra `oracles`): no comparison with it"


@dataclass(frozen=True)
class Work:
    """What is timed.

    Attributes:
        do: gets what ``prepare`` made.
        prepare: makes fresh input, outside the time (some software changes its input in place).
        repeats: times in a row per turn; short work needs more for a fair chance of an undisturbed one.
    """

    do: Callable[[Any], Any]
    prepare: Callable[[], Any] = lambda: None
    repeats: int = 1


@dataclass(frozen=True)
class Spent:
    """What some repeats of a work took.

    Attributes:
        wall_s, cpu_s: least wall time and least processor time, seconds.
        threads: most processor time per wall time, the threads that worked when nothing else kept them.
        result: the last one.
    """

    wall_s: float
    cpu_s: float
    threads: float
    result: Any


def timed(work: Work) -> Spent:
    """The least times over the repeats."""
    wall: list[float] = []
    cpu: list[float] = []
    result = None
    for _ in range(work.repeats):
        given = work.prepare()
        begun, used = time.perf_counter(), time.process_time()
        result = work.do(given)
        wall.append(time.perf_counter() - begun)
        cpu.append(time.process_time() - used)
    return Spent(min(wall), min(cpu), max(c / w for c, w in zip(cpu, wall, strict=True)), result)


def in_turns(works: Mapping[str, Work], rounds: int) -> dict[str, Spent]:
    """Least times of several works, taken in turns, so that a busy machine is busy for all of them.

    Args:
        works: name -> work.
        rounds: of all works.
    """
    best: dict[str, Spent] = {}
    for _ in range(rounds):
        for name, work in works.items():
            now, old = timed(work), best.get(name)
            if old is not None:
                wall, cpu = min(now.wall_s, old.wall_s), min(now.cpu_s, old.cpu_s)
                now = Spent(wall, cpu, max(now.threads, old.threads), now.result)
            best[name] = now
    return best


def processor_s() -> float:
    """Processor time of this process and of all that it started, those that have ended included, seconds."""
    own = psutil.Process()
    spent = 0.0
    for process in (own, *own.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):
            times = process.cpu_times()
            spent += times.user + times.system + times.children_user + times.children_system
    return spent


@dataclass(frozen=True)
class Number:
    """One measured number.

    Attributes:
        key: name in the JSON, which ends in the unit; a ratio or a count has none.
        value: the number.
        text: what it is, for the table.
        unit: for the table.
    """

    key: str
    value: float
    text: str
    unit: str = ""


@dataclass(frozen=True)
class Speed:
    """The numbers of one benchmark, and remarks that belong beside them."""

    numbers: tuple[Number, ...]
    notes: tuple[str, ...] = ()

    @property
    def data(self) -> dict[str, float]:
        """Key -> value."""
        return {number.key: number.value for number in self.numbers}


def shown(value: float) -> str:
    """Return a number with three digits; powers of ten where it is tiny."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    digits = 2 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):,.{max(digits, 0)}f}"
