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


def kernel_threads(count: int) -> None:
    """From now on kernels of this process run on so many threads, the calling one among them.

    Small ones are faster on one: threads that wait for the next kernel do so actively, and take their cores from all
    else.

    Args:
        count: number of threads, at least 1.
    """
    import drjit as dr

    if dr.thread_count() != count:
        dr.set_thread_count(count)


@contextmanager
def one_kernel_thread() -> Iterator[None]:
    """Let kernels inside the ``with`` block run on the thread that calls them.

    Threads that have run a kernel look for the next one for some milliseconds, actively. Where short kernels alternate
    with other work, they take more time than the kernels.
    """
    import drjit as dr

    count = dr.thread_count()
    kernel_threads(1)
    try:
        yield
    finally:
        kernel_threads(count)


LIMIT = "TWIN_THREADS"
"""Environment variable that limits ``cores``, for processes that share the machine with others of their kind."""


def cores() -> int:
    """Number of cores that this process may use: those that it is given, or fewer if the variable LIMIT says so."""
    named = os.environ.get(LIMIT, "")
    return min(_given(), int(named)) if named.isdecimal() and int(named) > 0 else _given()


def _given() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
