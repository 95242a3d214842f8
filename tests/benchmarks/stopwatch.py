"""Time of some work: wall time, and processor time of all threads."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import psutil


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
