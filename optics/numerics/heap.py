"""Memory that arrays leave stays with the process, so that the next ones need not be cleared by the system.

The C library takes arrays of more than 128 kB from the system one by one, and gives them back. A batch of states makes
and leaves hundreds of them, and the system clears each page anew: a tenth of all processor time.
"""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
from functools import cache

KEPT = 32 << 20
"""Bytes up to which an array comes from the process's own memory; the most that the GNU C library takes."""
IDLE = 256 << 20
"""Bytes that may lie idle before the process gives some back."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_SAID = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
"""Environment variables by which a user says it himself."""


@cache
def keep_freed_memory() -> None:
    """Keep up to ``IDLE`` bytes of freed memory in this process from now on; nothing is done with another C library
    than GNU's, or where the environment says otherwise.
    """
    if sys.platform != "linux" or any(name in os.environ for name in _SAID):
        return
    with suppress(OSError, AttributeError):
        change = ctypes.CDLL("libc.so.6").mallopt
        change(_MMAP_THRESHOLD, KEPT)
        change(_TRIM_THRESHOLD, IDLE)
