"""Memory that a command may take, and the refusal of a job that needs more before anything of it is computed.

A job that can need more than 2 GiB is estimated when it starts, from its numbers of pixels, frames, rays, points and
runs alone (`require_memory`, `twin.monitor.monitor_memory`). Estimates are of the largest resident memory above that of
the started program, and within a factor of 1.5 of what is used (tests/limits).
"""

from __future__ import annotations

import math
import os
import re
import resource
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from scenes.yaml.errors import InputError, Issue, KeyPath, shown

LIMIT = "TWIN_MEMORY"
"""Environment variable with the memory that a command may take, as ``8 GB`` or ``500 MB``, in place of what is free."""

_AMOUNT = re.compile(r"\s*(?P<number>[0-9]{1,6}(\.[0-9]{1,3})?)\s*(?P<unit>MB|GB)\s*")
_UNITS = {"MB": 1e6, "GB": 1e9}
_FREE, _PAGES = Path("/proc/meminfo"), Path("/proc/self/statm")
_GROUP, _GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")

ORDINARY = 600e6
"""A job that needs no more is never refused, bytes: what is free changes while other processes start, and what a study
gives must not depend on that.
"""
STARTED = 290e6
"""Memory of a job of any size beside the imported program: kernels, their compiler, what draws a report, and what the
heap keeps of arrays that are freed; bytes.
"""


def free_memory() -> float:
    """Bytes that this process may still take: those of the environment variable, else what the system has free for it
    and its control group and limits leave; infinite where nobody says.

    Raises
    ------
    InputError
        The variable holds something else.
    """
    named = os.environ.get(LIMIT)
    if named:
        amount = _AMOUNT.fullmatch(named)
        if amount is None:
            problem = f"the environment variable {LIMIT} is no amount of memory"
            raise InputError(Issue(problem, found=shown(named), allowed="a number with MB or GB, as 8 GB"))
        return float(amount["number"]) * _UNITS[amount["unit"]]
    return min(_of_system(), _of_group(), _of_limits())


def _of_system() -> float:
    """What the system says to be free for new work without swapping."""
    try:
        lines = _FREE.read_text("ascii").splitlines()
        return 1024.0 * int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1])
    except (OSError, StopIteration, ValueError):
        return float("inf")


def _of_group() -> float:
    """What the limits of the control group and of those above it leave."""
    least = float("inf")
    try:
        groups = [line.split(":", 2) for line in _GROUP.read_text("utf-8").splitlines()]
    except OSError:
        return least
    for _, controllers, path in (group for group in groups if len(group) == 3):
        if controllers not in ("", "memory"):
            continue
        root, most, used = (
            (_GROUPS, "memory.max", "memory.current")
            if not controllers
            else (_GROUPS / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes")
        )
        place = root / path.lstrip("/")
        for folder in (place, *place.parents):
            if folder != root and root not in folder.parents:
                break
            limit, taken = _number(folder / most), _number(folder / used)
            least = min(least, max(limit - taken, 0.0) if taken < float("inf") else limit)
    return least


def _number(file: Path) -> float:
    try:
        return float(file.read_text("ascii"))
    except (OSError, ValueError):  # no such control group, or ``max``
        return float("inf")


def _of_limits() -> float:
    """What the limit of the process's addresses (``ulimit -v``) leaves."""
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if most == resource.RLIM_INFINITY:
        return float("inf")
    return max(float(most) - _own(0), 0.0)


def _own(which: int) -> float:
    """Bytes of this process: of its addresses (0), or resident (1); 0 where the system does not say."""
    try:
        return float(int(_PAGES.read_text("ascii").split()[which]) * resource.getpagesize())
    except (OSError, ValueError):
        return 0.0


def largest_memory() -> float:
    """Largest resident memory of this process so far, bytes."""
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


PROGRAM = 140e6
"""Resident memory of the imported program, bytes."""


def taken_already() -> float:
    """Resident memory of this process beyond that of the imported program, bytes: kernels of jobs that it did before,
    for instance, which the next job takes over.
    """
    return max(_own(1) - PROGRAM, 0.0)


def amount_text(number: float) -> str:
    """An amount of memory for people: ``3.1 GB``, ``420 MB``."""
    return f"{1e-9 * number:.3g} GB" if number >= 1e9 else f"{1e-6 * number:.3g} MB"


def largest(fits: Callable[[int], bool], most: int, least: int = 0) -> int:
    """The largest whole number that fits, below one that does not.

    Parameters
    ----------
    fits : Callable[[int], bool]
        Whether a number does; if it does, all smaller ones do.
    most : int
        a number that does not.
    least : int
        One below which none is looked for; the result is this where even the next larger one does not fit.
    """
    low, high = least, most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


class Owner(Protocol):
    """Where a number stands: a file's part (`Spec`), or the options of a command."""

    def error(self, problem: str, key: KeyPath, *, found: object, allowed: str) -> Exception:
        """The error that says what is wrong with it, for the caller to raise."""
        ...


@dataclass(frozen=True)
class Lowered:
    """A number of a file or an option with which a job takes less memory.

    Attributes
    ----------
    owner, key : Owner
        The file or the options, and where in it the number stands.
    number : int
        As it is.
    unit : str
        Of the number, in words.
    bytes : Callable[[int], float]
        Memory with another number.
    least : int
        That it may be.
    """

    owner: Owner
    key: KeyPath
    number: int
    unit: str
    bytes: Callable[[int], float]
    least: int = 1


def require_memory(
    lower: Lowered, started: float = STARTED, of_it: str = "", own: float = math.inf, own_key: str = ""
) -> None:
    """See whether a job fits into the memory that is free, and into what its own file lets it have.

    Parameters
    ----------
    lower : Lowered
        The number that decides most of the job's memory.
    started : float
        Bytes beside what ``lower`` counts.
    of_it : str
        How much of the memory is for what, as a part of the message.
    own : float
        Bytes that the job's own file lets it have.
    own_key : str
        Where the file says so.

    Raises
    ------
    InputError, InputErrorText
        It does not; at the key or option, with the number that fits.
    """
    free = free_memory()
    # kernels of an earlier job are not free any more, and are taken over
    room = min(own, max(ORDINARY, free + min(taken_already(), STARTED)))
    need = started + lower.bytes(lower.number)
    if need <= room:
        return
    most = largest(lambda number: started + lower.bytes(number) <= room, lower.number, lower.least - 1)
    more = f"more memory (the environment variable {LIMIT}, as 8 GB, says how much may be taken)"
    if own < free:
        more = f"a larger {own_key}"
    raise lower.owner.error(
        f"this needs about {amount_text(need)} of memory,{f' {of_it},' if of_it else ''} and "
        f"{amount_text(min(own, free))} may be taken",
        lower.key,
        found=lower.number,
        allowed=f"at most {most} {lower.unit}, or {more}" if most >= lower.least else more,
    )
