"""What a command will take of memory and time: told before it starts where it is much, refused where it is more memory
than there is.

Each subject has a model of its own, a function of the numbers that its file states (pixels, points, states), with rates
that were measured once: bytes are those of the largest resident memory above that of the imported program, seconds
those of one core of the machine whose `PACE_SECONDS` stand here. Both are within a factor of 1.5 of what a run takes
(tests/limits). Time is told on the scale of the machine that is there: `pace` measures how fast it is in the time of a
blink. How far a run is and what is left, the progress says.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from optics.numerics.threads import one_blas_thread
from scenes.yaml.errors import KeyPath
from twin.run.memory import LIMIT, amount_text, free_memory, largest

MUCH_MEMORY, LONG = 2.0 * 2**30, 300.0
"""Bytes and seconds above which a command says beforehand what it takes."""
ORDINARY = 600e6
"""A job that needs no more is never refused, bytes: what is free changes while other processes start, and what a study
gives must not depend on that.
"""
PACE_SECONDS = 0.0027
"""What the calculation of `pace` takes on the machine on which the rates were measured, seconds of one core."""


class Owner(Protocol):
    """Where a number stands: a file's part (`Spec`), or the options of a command."""

    def error(self, problem: str, key: KeyPath, *, found: object, allowed: str) -> Exception:
        """The error that says what is wrong with it, for the caller to raise."""
        ...


@dataclass(frozen=True)
class Lowered:
    """A number of a file or an option with which a command takes less memory.

    Attributes:
        owner, key: the file or the options, and where in it the number stands.
        number: as it is.
        unit: of the number, in words.
        bytes: memory with another number.
        least: that it may be.
    """

    owner: Owner
    key: KeyPath
    number: int
    unit: str
    bytes: Callable[[int], float]
    least: int = 1


@dataclass(frozen=True)
class Cost:
    """What a command takes.

    Attributes:
        bytes: memory, largest resident, above that of the imported program.
        seconds: of one core of the machine of `PACE_SECONDS`.
        lower: what decides most of the memory; None where no number of the file does.
    """

    bytes: float
    seconds: float
    lower: Lowered | None = None

    @property
    def much(self) -> bool:
        """Whether it is said beforehand, on any machine that is not ten times as fast as the one that was measured."""
        return self.bytes > MUCH_MEMORY or self.seconds > 0.1 * LONG


def pace() -> float:
    """How many times as long as on the measured machine this one takes, for one core.

    The least of several tries of linear algebra, of functions of arrays and of Python's own arithmetic, in time of this
    thread alone: other programs on the machine make little of it.
    """
    matrix, numbers = np.full((160, 160), 0.5), np.linspace(0.0, 1.0, 60_000)
    # into memory that is there: what the system takes to clear new memory depends on what the process did before
    product, values, roots = np.empty_like(matrix), np.empty_like(numbers), np.empty_like(numbers)
    least = np.inf
    with one_blas_thread():  # several would wait for each other, and for other programs
        for _ in range(8):
            begun = time.thread_time()
            for _ in range(4):
                np.matmul(matrix, matrix, out=product)
                np.multiply(np.sin(numbers, out=values), numbers, out=values)
                np.add(values, np.sqrt(numbers, out=roots), out=values)
                sum(k * k for k in range(5000))
            least = min(least, time.thread_time() - begun)
    return float(least / PACE_SECONDS)


def require_memory(cost: Cost, own: float = math.inf, own_key: str = "") -> None:
    """See whether a command fits into the memory that is free, and into what its own file lets it have.

    Args:
        cost: of the command.
        own: bytes that its file lets it have.
        own_key: where the file says so.

    Raises:
        InputError, InputErrorText: it does not; at the key or option of what takes most, with the number that fits.
    """
    free = free_memory()
    if cost.bytes <= min(own, max(ORDINARY, free)) or cost.lower is None:
        return
    raise beyond(cost.bytes, min(own, free), cost.lower, own_key=own_key if own < free else "")


def beyond(
    need: float, free: float, lower: Lowered, there: float = 0.0, most_of_it: str = "", own_key: str = ""
) -> Exception:
    """More memory is needed than there is: the error that says so, for the caller to raise.

    Args:
        need: bytes that are needed.
        free: bytes that may be taken.
        lower: the number that could be smaller.
        there: bytes of the need that the process has already, and which are not free any more.
        most_of_it: how much of the need is for what, as a part of the message.
        own_key: where the command's own file says that no more may be taken; empty where the machine does.
    """
    room = free if own_key else max(ORDINARY, free + there)
    most = largest(lambda number: lower.bytes(number) <= room, lower.number, lower.least - 1)
    more = f"more memory (the environment variable {LIMIT}, as 8 GB, says how much may be taken)"
    more = f"a larger {own_key}" if own_key else more
    of_it = f", {most_of_it}," if most_of_it else ","
    return lower.owner.error(
        f"this needs about {amount_text(need)} of memory{of_it} and {amount_text(free)} may be taken",
        lower.key,
        found=lower.number,
        allowed=f"at most {most} {lower.unit}, or {more}" if most >= lower.least else more,
    )


def told(cost: Cost, seconds_text: Callable[[float], str]) -> str:
    """What a command takes, in words; empty where it is not much.

    Args:
        cost: of the command.
        seconds_text: a time for people.
    """
    if not cost.much:
        return ""
    seconds = cost.seconds * pace()
    parts = [f"{amount_text(cost.bytes)} of memory"] if cost.bytes > MUCH_MEMORY else []
    parts += [seconds_text(seconds)] if seconds > LONG else []
    return f"this takes about {' and '.join(parts)}" if parts else ""
