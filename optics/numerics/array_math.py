"""The few functions that the same formula needs on NumPy arrays and on Dr.Jit arrays, and products of small matrices
that are the same on every processor.

NumPy's ``@``, ``dot``, ``norm`` of one vector and ``linalg`` hand even a 3 x 3 matrix to BLAS or LAPACK, which sum in
an order, and round at places, that differ from processor to processor. Geometry that all light depends on is not to
move by that: an image of 10 m of path shows 1e-15 m of it in its last digits.

Whether times and image coordinates lie inside a span, decided in one way for the whole program.

Ends of spans are sums and differences of decimal numbers, which meet to rounding and not to the last bit. An orbit that
ends with the last line of an image covers the image.

What numbers of a result must be, whatever the instrument; held at run time, so that nonsense is an error.

What physics forbids, as against faults of the program: light that is lost, parts that have no room.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

    Parameters
    ----------
    value : ArrayLike
        Seconds, lines or pixels, shape (...); NaN lies in no span.
    first : ArrayLike
        Lower end, broadcastable to (...); may be infinite.
    last : ArrayLike
        Upper end, likewise.

    Returns
    -------
    NDArray[np.bool_]
        Shape (...).
    """
    v, a, b = (np.asarray(one, np.float64) for one in (value, first, last))
    return np.asarray((v >= a - ROUNDING - _DIGITS * np.abs(a)) & (v <= b + ROUNDING + _DIGITS * np.abs(b)))


def number_of(value: float, values: Sequence[float]) -> int | None:
    """Return the number of the entry, from 0, that a value equals to rounding; None where there is none."""
    nearest = min(range(len(values)), key=lambda k: abs(values[k] - value), default=None)
    return None if nearest is None or not in_span(value, values[nearest], values[nearest]) else nearest


class PhysicalError(Exception):
    """What was asked for cannot be, in nature or with this instrument, though each of its numbers is allowed.

    The base of all errors that say so. Who runs many jobs counts such a one as failed; any other error is a fault of
    the program, whose numbers are not to be relied on.
    """


class UnphysicalError(PhysicalError, ValueError):
    """A value that cannot be, with the others; the message says which and why."""


def hold_within(what: str, values: np.ndarray | float, low: float, high: float, rounding: float) -> None:
    """Hold values between bounds.

    Parameters
    ----------
    what : str
        They are, for the message.
    values : np.ndarray | float
        Any shape; NaN where nothing is known.
    low : float
        smallest.
    high : float
        largest.
    rounding : float
        By which they may leave the bounds.

    Raises
    ------
    UnphysicalError
        One lies outside, or is infinite.
    """
    every = np.asarray(values, dtype=np.float64)
    known = every[~np.isnan(every)]
    off = np.maximum(low - known, known - high)
    if np.any(off > rounding):
        worst = float(known[int(np.argmax(off))])
        raise UnphysicalError(
            f"{what} came out as {worst:.6g}, which cannot be: it lies between {low:g} and {high:g}, to {rounding:g}"
        )


def hold_below(what: str, values: np.ndarray | float, bounds: np.ndarray | float, than: str, rounding: float) -> None:
    """Hold values below others.

    Parameters
    ----------
    what : str
        They are, for the message.
    values : np.ndarray | float
        Any shape; NaN where nothing is known.
    bounds : np.ndarray | float
        Of a shape that broadcasts.
    than : str
        What the bounds are.
    rounding : float
        By which values may exceed them.

    Raises
    ------
    UnphysicalError
        One exceeds its bound.
    """
    if (worst := _worst_beyond(values, bounds, rounding, lambda apart: apart)) is not None:
        own, most = worst
        raise UnphysicalError(
            f"{what} came out as {own:.6g}, which cannot be: it is at most {than}, {most:.6g}, to {rounding:g}"
        )


def hold_equal(what: str, values: np.ndarray | float, others: np.ndarray | float, to: str, apart: float) -> None:
    """Hold values to what another way tells.

    Parameters
    ----------
    what : str
        They are, for the message.
    values : np.ndarray | float
        Any shape; NaN where nothing is known.
    others : np.ndarray | float
        Of a shape that broadcasts.
    to : str
        What the others are.
    apart : float
        By which the two may differ.

    Raises
    ------
    UnphysicalError
        Two differ by more.
    """
    if (worst := _worst_beyond(values, others, apart, np.abs)) is not None:
        own, second = worst
        raise UnphysicalError(
            f"{what} came out as {own:.6g}, but {to} as {second:.6g}: they differ by more than {apart:g}"
        )


def _worst_beyond(
    values: np.ndarray | float, others: np.ndarray | float, limit: float, measure: Callable[[np.ndarray], np.ndarray]
) -> tuple[float, float] | None:
    """The value and its other whose difference, as ``measure`` takes it, exceeds the limit most; None where none
    does. Pairs with a NaN are not known and count as within it.
    """
    own, second = np.broadcast_arrays(np.asarray(values, dtype=np.float64), np.asarray(others, dtype=np.float64))
    with np.errstate(invalid="ignore"):
        off = np.where(np.isnan(own) | np.isnan(second), -np.inf, measure(own - second))
    if not np.any(off > limit):
        return None
    k = int(np.argmax(off))
    return float(own.flat[k]), float(second.flat[k])


def covariance_root(covariance: np.ndarray) -> np.ndarray:
    """G (M, M) with G G' = covariance (M, M), positive semidefinite: standard deviations times the symmetric root of
    the correlations, so that numbers without correlations are drawn by themselves, each in its unit.

    It changes little where the covariance does, whatever its rank. Eigenvectors alone do not: those of equal
    eigenvalues are what rounding makes of them, and every processor would draw other numbers.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / safe / safe[:, None])
    return np.asarray(sigma[:, None] * ((vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T))
