"""The Dr.Jit array types that a computation runs on: CPU through LLVM or GPU through CUDA, always float64."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.numerics.heap import keep_freed_memory
from optics.numerics.llvm import ensure_llvm

NAMES = ("llvm", "cuda")


class BackendUnavailable(RuntimeError):
    """The machine cannot run the asked-for backend (no GPU driver, no usable LLVM)."""


@dataclass(frozen=True)
class Backend:
    """Float64 array types of one Dr.Jit backend; the same code runs on either.

    Attributes:
        name: ``llvm`` or ``cuda``.
        Float: differentiable float64 array.
        UInt: 32-bit unsigned index array.
        Bool: mask array.
        Vector3: three ``Float`` components.
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
        """Upload many arrays of one size, each as `opaque` does; much less work than one by one.

        Args:
            values: arrays of n numbers each, of any shape.
        """
        import drjit as dr

        if not values:
            return []
        size = values[0].size
        # every row begins at an aligned address, as each array by itself would
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
    """Flat copy of an array at an aligned address.

    Dr.Jit reads a NumPy array in place and compiles the alignment of its address into the kernel; arrays that are
    aligned only by chance would make a second kernel of the same code now and then.
    """
    room = np.empty(values.size + _ALIGNMENT // values.itemsize, values.dtype)
    start = (-room.ctypes.data % _ALIGNMENT) // values.itemsize
    aligned = room[start : start + values.size]
    aligned.reshape(values.shape)[...] = values
    return aligned


def load_backend(name: str = "llvm") -> Backend:
    """Return the backend of that name.

    Raises:
        BackendUnavailable: when this machine cannot run it, with the reason and the remedy.
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
