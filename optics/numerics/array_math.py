"""The few functions that the same formula needs on NumPy arrays and on Dr.Jit arrays, and products of small matrices
that are the same on every processor.

NumPy's ``@``, ``dot``, ``norm`` of one vector and ``linalg`` hand even a 3 x 3 matrix to BLAS or LAPACK, which sum in
an order, and round at places, that differ from processor to processor. Geometry that all light depends on is not to
move by that: an image of 10 m of path shows 1e-15 m of it in its last digits.

Whether times and image coordinates lie inside a span, decided in one way for the whole program.

Ends of spans are sums and differences of decimal numbers, which meet to rounding and not to the last bit. An orbit that
ends with the last line of an image covers the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def _is_numpy(x: Any) -> bool:
    return isinstance(x, int | float | np.ndarray | np.generic)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Matrix product of stacks (..., M, K) and (..., K, N), summed over K in one order everywhere."""
    return np.asarray(np.einsum("...ij,...jk->...ik", a, b))


def turned(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Matrices (..., M, K) times vectors (..., K), summed over K in one order everywhere."""
    return np.asarray(np.einsum("...ij,...j->...i", matrix, vector))


def inner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products of vectors (..., K), summed in one order everywhere."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def norm(vector: np.ndarray) -> np.ndarray:
    """Lengths of vectors (..., K), summed in one order everywhere."""
    return np.asarray(np.sqrt(inner(vector, vector)))


def determinant(matrix: np.ndarray) -> np.ndarray:
    """Determinants of 2 x 2 matrices (..., 2, 2)."""
    return np.asarray(matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0])


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverses of 2 x 2 matrices (..., 2, 2) by Cramer's rule; not finite where they are singular."""
    (a, b), (c, d) = np.moveaxis(np.asarray(matrix), (-2, -1), (0, 1))
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(adjugate / determinant(matrix)[..., None, None])


def sqrt(x: Any) -> Any:
    """Square root."""
    if _is_numpy(x):
        return np.sqrt(x)
    import drjit as dr

    return dr.sqrt(x)


def exp(x: Any) -> Any:
    """Exponential."""
    if _is_numpy(x):
        return np.exp(x)
    import drjit as dr

    return dr.exp(x)


def log(x: Any) -> Any:
    """Natural logarithm."""
    if _is_numpy(x):
        return np.log(x)
    import drjit as dr

    return dr.log(x)


def select(mask: Any, a: Any, b: Any) -> Any:
    """``a`` where the mask is true, ``b`` elsewhere."""
    if isinstance(mask, bool | np.ndarray | np.generic):
        return np.where(mask, a, b)
    import drjit as dr

    return dr.select(mask, a, b)


ROUNDING = 1e-6
"""Seconds, lines or pixels by which a value may lie outside a span, as files write times to the microsecond. A low
satellite moves by 8 mm in it, over which a curve through its readings goes on smoothly: rounding costs no accuracy.
"""
_DIGITS = 1e-15
"""Relative rounding of an end far from zero, nine units in the last place."""


def in_span(value: ArrayLike, first: ArrayLike, last: ArrayLike) -> NDArray[np.bool_]:
    """Return whether values lie between two ends, to rounding; both ends belong to the span.

    Args:
        value: seconds, lines or pixels, shape (...); NaN lies in no span.
        first: lower end, broadcastable to (...); may be infinite.
        last: upper end, likewise.

    Returns:
        Shape (...).
    """
    v, a, b = (np.asarray(one, np.float64) for one in (value, first, last))
    return np.asarray((v >= a - ROUNDING - _DIGITS * np.abs(a)) & (v <= b + ROUNDING + _DIGITS * np.abs(b)))


def number_of(value: float, values: Sequence[float]) -> int | None:
    """Return the number of the entry, from 0, that a value equals to rounding; None where there is none."""
    nearest = min(range(len(values)), key=lambda k: abs(values[k] - value), default=None)
    return None if nearest is None or not in_span(value, values[nearest], values[nearest]) else nearest
