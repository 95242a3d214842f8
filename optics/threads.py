"""Threads: this program splits its batches over the cores itself, so the linear algebra under NumPy must not do so too.

OpenBLAS threads that are called from several Python threads at once wait for each other actively; on a busy machine
that costs a factor of ten and more.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let every matrix product inside the ``with`` block run on the thread that calls it."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
