"""Dr.Jit array types for a computation (CPU through LLVM or GPU through CUDA, always float64), memory and threads.

Freed arrays stay with the process, so that the system need not clear the pages of the next ones. By default the C
library requests arrays of more than 128 kB from the system one by one, and returns them. A batch of states allocates
and frees hundreds of them, and the system clears each page anew: a tenth of all processor time.

This program splits its batches over the cores itself, so the linear algebra under NumPy must not do so too. OpenBLAS
threads that are called from several Python threads at once wait for each other actively; on a busy machine that costs a
factor of ten and more.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.numerics.llvm import ensure_llvm

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

ARRAY_BYTES = 32 << 20
"""Size up to which an array is taken from the process's own memory, bytes; the largest value that the GNU C library
takes.
"""
IDLE_BYTES = 256 << 20
"""Free memory that the process keeps before it returns some to the system, bytes."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_MALLOC_VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
"""Environment variables by which a user sets the memory allocation himself."""


@cache
def keep_freed_memory() -> None:
    """Keep up to ``IDLE_BYTES`` bytes of freed memory in this process from now on.

    Nothing is done with another C library than GNU's, or where the environment sets the allocation.
    """
    if sys.platform != "linux" or any(name in os.environ for name in _MALLOC_VARIABLES):
        return
    with suppress(OSError, AttributeError):
        change = ctypes.CDLL("libc.so.6").mallopt
        change(_MMAP_THRESHOLD, ARRAY_BYTES)
        change(_TRIM_THRESHOLD, IDLE_BYTES)


NAMES = ("llvm", "cuda")


class BackendUnavailable(RuntimeError):
    """Error: the machine cannot run the requested backend (no GPU driver, no usable LLVM)."""


@dataclass(frozen=True)
class Backend:
    """Float64 array types of one Dr.Jit backend; the same code runs on either.

    Attributes
    ----------
    name : str
        ``llvm`` or ``cuda``.
    Float : Any
        Differentiable float64 array.
    UInt : Any
        32-bit unsigned index array.
    Bool : Any
        Mask array.
    Vector3 : Any
        Three ``Float`` components.
    """

    name: str
    Float: Any
    UInt: Any
    Bool: Any
    Vector3: Any

    def opaque(self, values: Any, kind: Any = None) -> Any:
        """Upload numbers as kernel *inputs*: n numbers of any shape -> array of width n, by default a ``Float``.

        A Python float used directly would be compiled into the kernel as a literal, and each new value would compile a
        new kernel.
        """
        import drjit as dr

        kind = self.Float if kind is None else kind
        array = kind(_aligned(np.asarray(values, dtype=dr.type_v(kind).name.lower())))
        dr.make_opaque(array)
        return array

    def opaque_each(self, values: Sequence[np.ndarray]) -> list[Any]:
        """Upload many arrays of one size, each as ``opaque`` does, with less overhead than one by one.

        Parameters
        ----------
        values : sequence of ndarray
            Arrays of n numbers each, of any shape.
        """
        import drjit as dr

        if not values:
            return []
        size = values[0].size
        # every row begins at an aligned address, as a separate array would
        stride = -(-size * 8 // _ALIGNMENT) * _ALIGNMENT // 8
        table = _aligned(np.zeros(len(values) * stride)).reshape(len(values), stride)
        out = []
        for row, value in zip(table, values, strict=True):
            row[:size] = value.reshape(-1)
            out.append(self.Float(row[:size]))
        dr.make_opaque(out)
        return out

    def vector(self, values: Any) -> Any:
        """Upload an array (..., 3) of n vectors as a ``Vector3`` of width n."""
        rows = np.asarray(values, dtype=np.float64)
        return self.Vector3(*(self.opaque(rows[..., x]) for x in range(3)))


_ALIGNMENT = 128


def _aligned(values: np.ndarray) -> np.ndarray:
    """Return a flat copy of an array at an aligned address.

    Dr.Jit reads a NumPy array in place and compiles the alignment of its address into the kernel; arrays that are
    aligned by chance only would cause a second kernel of the same code now and then.
    """
    room = np.empty(values.size + _ALIGNMENT // values.itemsize, values.dtype)
    start = (-room.ctypes.data % _ALIGNMENT) // values.itemsize
    aligned = room[start : start + values.size]
    aligned.reshape(values.shape)[...] = values
    return aligned


def load_backend(name: str = "llvm") -> Backend:
    """Return the float64 array types of the Dr.Jit backend ``llvm`` (CPU) or ``cuda`` (GPU).

    Raises
    ------
    BackendUnavailable
        This machine cannot run it; the message gives the reason and the remedy.
    """
    if name not in NAMES:
        raise BackendUnavailable(f"unknown backend {name!r}; choose one of {', '.join(NAMES)}")
    keep_freed_memory()
    ensure_llvm()
    import drjit as dr

    jit = dr.JitBackend.LLVM if name == "llvm" else dr.JitBackend.CUDA
    if not dr.has_backend(jit):
        remedy = (
            "run `python -m twin.doctor` to see which LLVM library is found"
            if name == "llvm"
            else "no CUDA driver was found; use --backend llvm"
        )
        raise BackendUnavailable(f"the {name} backend is not available on this machine: {remedy}")
    types = importlib.import_module(f"drjit.{name}.ad")
    return Backend(name=name, Float=types.Float64, UInt=types.UInt32, Bool=types.Bool, Vector3=types.Array3f64)


@cache
def default_backend() -> Backend:
    """Return the backend of the library's plain functions: this machine's processor.

    Raises
    ------
    BackendUnavailable
        The machine has no usable LLVM.
    """
    return load_backend("llvm")


@cache
def _controller() -> ThreadpoolController:
    """Return the object that sets the number of threads of the BLAS libraries in this process."""
    # imported late, so that a bad input file is reported before anything is computed
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Run every matrix product inside the ``with`` block on the thread that calls it."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


def kernel_threads(count: int) -> None:
    """Set the number of threads of this process's kernels, the calling one included.

    Small kernels are faster on one thread: threads that wait for the next kernel do so actively, and take cores from
    all other work.

    Parameters
    ----------
    count : int
        Number of threads, at least 1.
    """
    import drjit as dr

    if dr.thread_count() != count:
        dr.set_thread_count(count)


@contextmanager
def one_kernel_thread() -> Iterator[None]:
    """Run kernels inside the ``with`` block on the thread that calls them.

    Threads that have run a kernel wait actively for the next one for some milliseconds. Where short kernels alternate
    with other work, this takes more time than the kernels.
    """
    import drjit as dr

    count = dr.thread_count()
    kernel_threads(1)
    try:
        yield
    finally:
        kernel_threads(count)


THREADS_VARIABLE = "TWIN_THREADS"
"""Environment variable with the largest number of cores that ``cores`` returns, for processes that share a machine."""
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMEXPR")
ONE_THREAD = dict.fromkeys((THREADS_VARIABLE, *(f"{name}_NUM_THREADS" for name in _LIBRARIES)), "1")
"""Environment variables with which a worker process and its linear algebra run on one thread."""


def cores() -> int:
    """Return the number of cores that this process may use.

    These are the cores assigned to it, or fewer if the environment variable ``THREADS_VARIABLE`` says so.
    """
    named = os.environ.get(THREADS_VARIABLE, "")
    return min(_assigned_cores(), int(named)) if named.isdecimal() and int(named) > 0 else _assigned_cores()


def _assigned_cores() -> int:
    """Return the number of cores that the system assigns to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
