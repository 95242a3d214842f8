"""Memory available to a command, and refusal of a job that needs more before anything is computed.

A job that can need more than 2 GiB is estimated at its start, from its numbers of pixels, frames, rays, points and runs
(`require_memory`, `twin.monitor.monitor_experiment`). Estimates are of the largest resident memory above that of the
started program, and are within a factor of 1.5 of the memory used (tests/limits).
"""

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
"""Environment variable with the memory that a command may use, as ``8 GB`` or ``500 MB``; without it, the free memory.
"""

_AMOUNT = re.compile(r"\s*(?P<number>[0-9]{1,6}(\.[0-9]{1,3})?)\s*(?P<unit>MB|GB)\s*")
_UNITS = {"MB": 1e6, "GB": 1e9}
_FREE, _PAGES = Path("/proc/meminfo"), Path("/proc/self/statm")
_GROUP, _GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")

ORDINARY = 600e6
"""Memory below which a job is never refused, in bytes: the free memory changes while other processes start, and results
of a study must not depend on that.
"""
STARTED = 290e6
"""Memory of a job of any size beside the imported program, in bytes: kernels, their compiler, plotting, and freed
arrays that the heap keeps.
"""


def free_memory() -> float:
    """Return the memory that this process may still use, in bytes.

    It is the value of the environment variable, or else the smallest of the system's free memory and what the control
    group and process limits leave; infinite if none of them is known.

    Raises
    ------
    InputError
        The environment variable is not an amount of memory.
    """
    named = os.environ.get(LIMIT)
    if named:
        amount = _AMOUNT.fullmatch(named)
        if amount is None:
            problem = f"the environment variable {LIMIT} is not an amount of memory"
            raise InputError(Issue(problem, value=shown(named), allowed="a number with MB or GB, as 8 GB"))
        return float(amount["number"]) * _UNITS[amount["unit"]]
    return min(_of_system(), _of_group(), _of_limits())


def _of_system() -> float:
    """Return the memory that the system reports as available without swapping, in bytes."""
    try:
        lines = _FREE.read_text("ascii").splitlines()
        return 1024.0 * int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1])
    except (OSError, StopIteration, ValueError):
        return float("inf")


def _of_group() -> float:
    """Return the memory that the limits of the control group and its parents leave, in bytes."""
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
        start = root / path.lstrip("/")
        for folder in (start, *start.parents):
            if folder != root and root not in folder.parents:
                break
            limit, taken = _number(folder / most), _number(folder / used)
            least = min(least, max(limit - taken, 0.0) if taken < float("inf") else limit)
    return least


def _number(file: Path) -> float:
    """Return the number in a file of a control group; infinite without a limit."""
    try:
        return float(file.read_text("ascii"))
    except (OSError, ValueError):  # there is no such control group, or it has no limit (``max``)
        return float("inf")


def _of_limits() -> float:
    """Return the memory that the limit of the address space (``ulimit -v``) still allows, in bytes."""
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if most == resource.RLIM_INFINITY:
        return float("inf")
    return max(float(most) - _process_memory(0), 0.0)


def _process_memory(which: int) -> float:
    """Return the address space (0) or resident memory (1) of this process, in bytes; 0 if unknown."""
    try:
        return float(int(_PAGES.read_text("ascii").split()[which]) * resource.getpagesize())
    except (OSError, ValueError):
        return 0.0


def largest_memory() -> float:
    """Return the largest resident memory of this process so far, in bytes."""
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


PROGRAM = 140e6
"""Resident memory of the imported program, in bytes."""


def reusable_memory() -> float:
    """Return the resident memory of this process beyond that of the imported program, in bytes.

    It includes kernels of earlier jobs, for instance, which the next job reuses.
    """
    return max(_process_memory(1) - PROGRAM, 0.0)


def amount_text(number: float) -> str:
    """Format an amount of memory given in bytes: ``3.1 GB``, ``420 MB``."""
    return f"{1e-9 * number:.3g} GB" if number >= 1e9 else f"{1e-6 * number:.3g} MB"


def largest(fits: Callable[[int], bool], most: int, least: int = 0) -> int:
    """Find by bisection the largest whole number that satisfies a condition.

    Parameters
    ----------
    fits : callable
        Condition on a number; if it holds for a number, it holds for all smaller ones.
    most : int
        Number for which the condition does not hold.
    least : int
        Lower bound; it is returned if the condition does not hold for the next larger number.

    Returns
    -------
    int
        Largest number that satisfies the condition.
    """
    low, high = least, most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


class Owner(Protocol):
    """Interface of the source of a number: a part of a file (`Spec`), or the options of a command."""

    def error(self, problem: str, key: KeyPath, *, value: object, allowed: str) -> Exception:
        """Return an error that names the number and its allowed values, for the caller to raise."""
        ...


@dataclass(frozen=True)
class Lowered:
    """Number, in a file or an option, that the user can lower to reduce the memory of a job.

    Attributes
    ----------
    owner : Owner
        File or options that contain the number.
    key : KeyPath
        Path of the number in the file or options.
    number : int
        Present value.
    unit : str
        Unit of the number, in words, such as frames or runs.
    bytes : callable
        Function of the number that returns the memory of the job, in bytes.
    least : int
        Smallest allowed value.
    """

    owner: Owner
    key: KeyPath
    number: int
    unit: str
    bytes: Callable[[int], float]
    least: int = 1


def require_memory(
    lower: Lowered, started: float = STARTED, shares: str = "", file_limit: float = math.inf, limit_key: str = ""
) -> None:
    """Raise an error if a job does not fit into the free memory or the limit of its own file.

    Parameters
    ----------
    lower : Lowered
        Number that determines most of the job's memory.
    started : float
        Memory beside that of ``lower``, in bytes.
    shares : str
        Text for the message that says what takes which part of the memory.
    file_limit : float
        Memory that the job's own file allows, in bytes.
    limit_key : str
        Key of the file with this limit.

    Raises
    ------
    InputError, InputErrorText
        The job does not fit; the message has the key or option and the largest number that fits.
    """
    free = free_memory()
    # kernels of an earlier job are no longer free memory, but are reused
    room = min(file_limit, max(ORDINARY, free + min(reusable_memory(), STARTED)))
    need = started + lower.bytes(lower.number)
    if need <= room:
        return
    most = largest(lambda number: started + lower.bytes(number) <= room, lower.number, lower.least - 1)
    more = f"more memory (the environment variable {LIMIT}, for instance 8 GB, sets how much may be used)"
    if file_limit < free:
        more = f"a larger {limit_key}"
    raise lower.owner.error(
        f"this needs about {amount_text(need)} of memory,{f' {shares},' if shares else ''} and "
        f"{amount_text(min(file_limit, free))} may be used",
        lower.key,
        value=lower.number,
        allowed=f"at most {most} {lower.unit}, or {more}" if most >= lower.least else more,
    )
