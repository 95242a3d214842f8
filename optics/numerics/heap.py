"""Memory that arrays leave stays with the process, so that the next ones need not be cleared by the system.

The C library takes arrays of more than 128 kB from the system one by one, and gives them back. A batch of states makes
and leaves hundreds of them, and the system clears each page anew: a tenth of all processor time.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache

KEPT = 32 << 20
"""Bytes up to which an array comes from the process's own memory; the most that the GNU C library takes."""
IDLE = 256 << 20
"""Bytes that may lie idle before the process gives some back."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_SAID = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
"""Environment variables by which a user says it himself."""


@cache
def keep_freed_memory() -> bool:
    """Keep up to ``IDLE`` bytes of freed memory in this process from now on.

    Returns:
        Whether it is so: False with another C library than GNU's, or where the environment says otherwise.
    """
    if sys.platform != "linux" or any(name in os.environ for name in _SAID):
        return False
    try:
        change = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    return bool(change(_MMAP_THRESHOLD, KEPT)) and bool(change(_TRIM_THRESHOLD, IDLE))
