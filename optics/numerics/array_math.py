"""Small array functions: matrix products equal on every processor, functions for NumPy and Dr.Jit, range checks.

NumPy's ``@``, ``dot``, ``norm`` of one vector and ``linalg`` hand even a 3 x 3 matrix to BLAS or LAPACK, whose order of
summation and rounding differ from processor to processor. The geometry that all light depends on must not depend on
that: an image formed over 10 m of path shows 1e-15 m of it in its last digits.

``in_span`` decides for the whole program whether times and image coordinates lie inside a span. Ends of spans are sums
and differences of decimal numbers, which agree to rounding and not to the last bit: an orbit that ends with the last
line of an image covers the image.

``check_range``, ``check_at_most`` and ``check_close`` check results against physical bounds at run time, so that an
impossible result is an error. ``PhysicalError`` marks what physics forbids (light that is lost, parts that do not fit),
as against faults of the program.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def _is_numpy(x: Any) -> bool:
    """Return True for a Python or NumPy number or array, False for a Dr.Jit array."""
    return isinstance(x, int | float | np.ndarray | np.generic)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return products of M x K with K x N matrices, (..., M, K) and (..., K, N), with a fixed order of summation."""
    return np.asarray(np.einsum("...ij,...jk->...ik", a, b))


def matvec(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return products of M x K matrices (..., M, K) with vectors (..., K), with a fixed order of summation."""
    return np.asarray(np.einsum("...ij,...j->...i", matrix, vector))


def inner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return scalar products of pairs of vectors with K components (..., K), with a fixed order of summation."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def norm(vector: np.ndarray) -> np.ndarray:
    """Return lengths of vectors with K components (..., K), with a fixed order of summation."""
    return np.asarray(np.sqrt(inner(vector, vector)))


def determinant(matrix: np.ndarray) -> np.ndarray:
    """Return determinants of 2 x 2 matrices (..., 2, 2)."""
    return np.asarray(matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0])


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Return inverses of 2 x 2 matrices (..., 2, 2) by Cramer's rule; not finite where they are singular."""
    (a, b), (c, d) = np.moveaxis(np.asarray(matrix), (-2, -1), (0, 1))
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(adjugate / determinant(matrix)[..., None, None])


def solve_pairs(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solutions (..., 2) of systems of two linear equations, (..., 2, 2) and (..., 2), by Cramer's rule.

    They are not finite where a matrix is singular.
    """
    (a, b), (c, d) = np.moveaxis(matrix, (-2, -1), (0, 1))
    x, y = np.moveaxis(right, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None])


def sqrt(x: Any) -> Any:
    """Return the square root of a number, NumPy or Dr.Jit array."""
    if _is_numpy(x):
        return np.sqrt(x)
    import drjit as dr

    return dr.sqrt(x)


def exp(x: Any) -> Any:
    """Return the exponential of a number, NumPy or Dr.Jit array."""
    if _is_numpy(x):
        return np.exp(x)
    import drjit as dr

    return dr.exp(x)


def log(x: Any) -> Any:
    """Return the natural logarithm of a number, NumPy or Dr.Jit array."""
    if _is_numpy(x):
        return np.log(x)
    import drjit as dr

    return dr.log(x)


def select(mask: Any, a: Any, b: Any) -> Any:
    """Return ``a`` where the mask is true, ``b`` elsewhere."""
    if isinstance(mask, bool | np.ndarray | np.generic):
        return np.where(mask, a, b)
    import drjit as dr

    return dr.select(mask, a, b)


ROUNDING = 1e-6
"""Tolerance of ``in_span``, in seconds, lines or pixels: files write times to the microsecond.

A low satellite moves by 8 mm in a microsecond, over which a curve through its measured positions is smooth, so that the
tolerance costs no accuracy.
"""
_DIGITS = 1e-15
"""Relative tolerance of ``in_span`` for an end far from zero: about nine units in the last place of float64."""


def in_span(value: ArrayLike, first: ArrayLike, last: ArrayLike) -> NDArray[np.bool_]:
    """Return whether values lie between two ends, to rounding; both ends belong to the span.

    Parameters
    ----------
    value : (...) array_like
        Seconds, lines or pixels; NaN lies in no span.
    first : array_like
        Lower end, broadcastable to (...); may be infinite.
    last : array_like
        Upper end, broadcastable to (...); may be infinite.

    Returns
    -------
    (...) ndarray of bool
        True where a value lies in the span.
    """
    v, a, b = (np.asarray(x, np.float64) for x in (value, first, last))
    return np.asarray((v >= a - ROUNDING - _DIGITS * np.abs(a)) & (v <= b + ROUNDING + _DIGITS * np.abs(b)))


def index_of_value(value: float, values: Sequence[float]) -> int | None:
    """Return the index of the entry of ``values`` that is equal to ``value`` to rounding; None if there is none."""
    nearest = min(range(len(values)), key=lambda k: abs(values[k] - value), default=None)
    return None if nearest is None or not in_span(value, values[nearest], values[nearest]) else nearest


class PhysicalError(Exception):
    """Base of the errors for requests that nature or the instrument cannot fulfil, although each number is allowed.

    Callers that run many jobs count such an error as a failed job; any other error is a fault of the program, whose
    numbers must not be relied on.
    """


class UnphysicalError(PhysicalError, ValueError):
    """Error: a value is physically impossible together with the others; the message says which value and why."""


def check_range(name: str, values: np.ndarray | float, low: float, high: float, tolerance: float) -> None:
    """Raise UnphysicalError if any value lies outside a physical range.

    Parameters
    ----------
    name : str
        Name of the quantity, for the message.
    values : ndarray or float
        Values of any shape; NaN for unknown ones, which pass.
    low : float
        Smallest possible value.
    high : float
        Largest possible value.
    tolerance : float
        Tolerance at both ends.

    Raises
    ------
    UnphysicalError
        A value lies outside the range, or is infinite.
    """
    array = np.asarray(values, dtype=np.float64)
    known = array[~np.isnan(array)]
    excess = np.maximum(low - known, known - high)
    if np.any(excess > tolerance):
        worst = float(known[int(np.argmax(excess))])
        raise UnphysicalError(
            f"{name}: {worst:.6g} is outside the physical range {low:g} to {high:g} (tolerance {tolerance:g})"
        )


def check_at_most(
    name: str, values: np.ndarray | float, bounds: np.ndarray | float, bound_name: str, tolerance: float
) -> None:
    """Raise UnphysicalError if any value exceeds its bound.

    Parameters
    ----------
    name : str
        Name of the quantity, for the message.
    values : ndarray or float
        Values of any shape; NaN for unknown ones, which pass.
    bounds : ndarray or float
        Upper bounds, of a shape that broadcasts.
    bound_name : str
        Name of the bounds, for the message.
    tolerance : float
        Tolerance above the bounds.

    Raises
    ------
    UnphysicalError
        A value exceeds its bound.
    """
    if (worst := _worst_beyond(values, bounds, tolerance, lambda apart: apart)) is not None:
        value, bound = worst
        raise UnphysicalError(f"{name}: {value:.6g} exceeds {bound_name}, {bound:.6g} (tolerance {tolerance:g})")


def check_close(
    name: str, values: np.ndarray | float, others: np.ndarray | float, other_name: str, tolerance: float
) -> None:
    """Raise UnphysicalError if values differ from an independent computation of them.

    Parameters
    ----------
    name : str
        Name of the quantity, for the message.
    values : ndarray or float
        Values of any shape; NaN for unknown ones, which pass.
    others : ndarray or float
        Values to compare with, of a shape that broadcasts.
    other_name : str
        Name of the other values, for the message.
    tolerance : float
        Largest allowed difference.

    Raises
    ------
    UnphysicalError
        Two values differ by more.
    """
    if (worst := _worst_beyond(values, others, tolerance, np.abs)) is not None:
        value, other = worst
        raise UnphysicalError(f"{name}: {value:.6g} differs from {other_name}, {other:.6g}, by more than {tolerance:g}")


def _worst_beyond(
    values: np.ndarray | float, others: np.ndarray | float, limit: float, measure: Callable[[np.ndarray], np.ndarray]
) -> tuple[float, float] | None:
    """Return the pair (value, other) whose difference exceeds the limit most, or None if none exceeds it.

    ``measure`` is a function of the differences (value - other) whose result is compared with the limit. A pair with a
    NaN counts as within the limit.
    """
    value, other = np.broadcast_arrays(np.asarray(values, dtype=np.float64), np.asarray(others, dtype=np.float64))
    with np.errstate(invalid="ignore"):
        excess = np.where(np.isnan(value) | np.isnan(other), -np.inf, measure(value - other))
    if not np.any(excess > limit):
        return None
    k = int(np.argmax(excess))
    return float(value.flat[k]), float(other.flat[k])


def covariance_root(covariance: np.ndarray) -> np.ndarray:
    """Return a matrix G (M, M) with G G' = covariance, to draw M correlated random numbers as G times independent ones.

    The covariance (M, M) is positive semidefinite. G is the standard deviations times the symmetric root of the
    correlation matrix, so that uncorrelated numbers are drawn independently, each in its unit. It depends continuously
    on the covariance, whatever its rank. Eigenvectors alone do not: those of equal eigenvalues are determined by
    rounding, and every processor would draw other numbers.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / safe / safe[:, None])
    return np.asarray(sigma[:, None] * ((vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T))
