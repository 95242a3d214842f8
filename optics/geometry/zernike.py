"""Zernike circle polynomials in Noll's order, unit rms over the disk, as Cartesian polynomials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from math import comb, factorial, isqrt, sqrt
from typing import Any

import numpy as np

MAX_NOLL = 66
"""Highest supported Noll index (all terms to radial order 10); beyond it monomials lose digits."""
HELD = 1e-6
"""Share of their size: combinations of terms that show less on an aperture are left out of fits over it."""


def noll_to_nm(index: int) -> tuple[int, int]:
    """Radial order n and signed azimuthal order m of a Noll index (1 = piston, 2 = x tilt, 3 = y tilt, 4 = defocus).

    m > 0 are cosine terms (even j), m < 0 sine terms (odd j) (Noll, JOSA 66, 207, 1976).
    """
    if not 1 <= index <= MAX_NOLL:
        raise ValueError(f"Noll index {index} is outside 1..{MAX_NOLL}")
    n = 0
    first = 1
    while first + n + 1 <= index:
        first += n + 1
        n += 1
    offset = index - first
    m = 2 * ((offset + 1) // 2) if n % 2 == 0 else 2 * (offset // 2) + 1
    return n, (m if index % 2 == 0 else -m) if m else 0


_FAMILIES = ("spherical aberration", "coma", "astigmatism", "trefoil", "tetrafoil", "pentafoil", "hexafoil")
_RANKS = ("", "secondary ", "tertiary ", "quaternary ", "fifth ")


def name(index: int) -> str:
    """What a Noll index is called: ``defocus``, ``coma x``, ``secondary astigmatism 45 deg``.

    The direction is that in which the term is largest at the edge: x and y of tilt and coma, else an angle from x.
    """
    n, signed = noll_to_nm(index)
    m = abs(signed)
    if n == 0:
        return "piston"
    if n == 2 and m == 0:
        return "defocus"
    rank = _RANKS[n // 2 - 2] if m == 0 else _RANKS[(n - m) // 2 - (m == 1)] if n > 1 else ""
    family = "tilt" if n == 1 else _FAMILIES[m] if m < len(_FAMILIES) else f"{m}-foil"
    if m == 0:
        return f"{rank}{family}"
    if m == 1:
        return f"{rank}{family} {'x' if signed > 0 else 'y'}"
    return f"{rank}{family} {0.0 if signed > 0 else 90.0 / m:g} deg"


@cache
def cartesian_terms(index: int) -> tuple[tuple[int, int, float], ...]:
    """Terms (a, b, c) of Z_j(x, y) = sum c x^a y^b on the unit disk."""
    n, signed = noll_to_nm(index)
    m = abs(signed)
    norm = sqrt(n + 1) * (sqrt(2) if m else 1.0)
    # r^m cos(m t) and r^m sin(m t) are the real and imaginary parts of (x + iy)^m
    azimuthal: dict[tuple[int, int], float] = {}
    for k in range(m + 1):
        if (k % 2 == 0) == (signed >= 0):
            sign = (-1) ** (k // 2)
            azimuthal[(m - k, k)] = sign * comb(m, k)
    total: dict[tuple[int, int], float] = {}
    for s in range((n - m) // 2 + 1):
        radial = (-1) ** s * factorial(n - s)
        radial /= factorial(s) * factorial((n + m) // 2 - s) * factorial((n - m) // 2 - s)
        power = (n - m) // 2 - s  # of (x^2 + y^2)
        for k in range(power + 1):
            for (a, b), c in azimuthal.items():
                key = (a + 2 * (power - k), b + 2 * k)
                total[key] = total.get(key, 0.0) + norm * radial * comb(power, k) * c
    return tuple((a, b, c) for (a, b), c in sorted(total.items()) if c != 0.0)


def zernike(index: int, x: Any, y: Any) -> np.ndarray:
    """Value of Z_j at unit-disk coordinates x, y (same shape).

    Parameters
    ----------
    index : int
        Noll's j.
    x : Any
        On the unit disk, any shape.
    y : Any
        Of the same shape.
    """
    x, y = np.asarray(x), np.asarray(y)
    return np.asarray(sum(c * x**a * y**b for a, b, c in cartesian_terms(index)))


def basis(last: int, x: Any, y: Any) -> np.ndarray:
    """Z_1..Z_last at points (N,) as columns, shape (N, last).

    Parameters
    ----------
    last : int
        Highest Noll index.
    x : Any
        On the unit disk, (N,).
    y : Any
        likewise.
    """
    return np.stack([zernike(j, x, y) * np.ones_like(x) for j in range(1, last + 1)], axis=-1)


def gradient_basis(last: int, x: Any, y: Any, axis: int) -> np.ndarray:
    """Derivatives of Z_1..Z_last along x (axis 0) or y (axis 1) at points (N,), shape (N, last).

    Parameters
    ----------
    last : int
        Highest Noll index.
    x : Any
        On the unit disk, (N,).
    y : Any
        likewise.
    axis : int
        0: by x, 1: by y.
    """
    columns = []
    for j in range(1, last + 1):
        column = np.zeros_like(x)
        for a, b, c in cartesian_terms(j):
            if axis == 0 and a > 0:
                column = column + c * a * x ** (a - 1) * y**b
            elif axis == 1 and b > 0:
                column = column + c * b * x**a * y ** (b - 1)
        columns.append(column)
    return np.stack(columns, axis=-1)


def fit(last: int, x: Any, y: Any, values: Any, weights: Any | None = None) -> np.ndarray:
    """Weighted least-squares coefficients of Z_1..Z_last.

    Parameters
    ----------
    last : int
        Highest Noll index.
    x : Any
        Unit-disk coordinates, shape (N,).
    y : Any
        likewise.
    values : Any
        Shape (..., N), e.g. optical path differences in metres.
    weights : Any | None
        Quadrature weights, shape (N,).

    Returns
    -------
    np.ndarray
        Shape (..., last), unit of ``values`` (each coefficient is an rms).
    """
    root = np.sqrt(np.ones_like(x) if weights is None else weights)
    solution, *_ = np.linalg.lstsq(basis(last, x, y) * root[:, None], (np.asarray(values) * root).T, rcond=None)
    return np.asarray(solution.T)


def triangle_size(order: int) -> int:
    """Number of monomials x^a y^b with a + b <= order."""
    return (order + 1) * (order + 2) // 2


def triangle_order(size: int) -> int:
    """Order of which there are ``size`` monomials: the inverse of ``triangle_size``."""
    order = (isqrt(8 * size + 1) - 3) // 2
    if triangle_size(order) != size:
        raise ValueError(f"{size} monomials are not all of some order")
    return order


def triangle_index(a: int, b: int) -> int:
    """Place of x^a y^b in the list ordered by total degree."""
    d = a + b
    return d * (d + 1) // 2 + b


def triangle_polynomial(x: Any, y: Any, coefficients: Sequence[Any], order: int) -> tuple[Any, Any, Any]:
    """Sum of c_ab x^a y^b with a + b <= order, and its two slopes, by nested Horner schemes.

    Parameters
    ----------
    x : Any
        Where, metres, arrays of NumPy or Dr.Jit.
    y : Any
        likewise.
    coefficients : Sequence[Any]
        m^(1-a-b), ordered by ``triangle_index``.
    order : int
        Highest degree a + b.

    Returns
    -------
    tuple[Any, Any, Any]
        Height, metres, and its derivatives by x and y.
    """
    height: Any = 0.0 * x
    slope_x: Any = 0.0 * x
    slope_y: Any = 0.0 * x
    for a in range(order, -1, -1):
        row: Any = 0.0 * x
        row_slope: Any = 0.0 * x
        for b in range(order - a, -1, -1):
            row_slope = row_slope * y + row
            row = row * y + coefficients[triangle_index(a, b)]
        slope_x = slope_x * x + height
        height = height * x + row
        slope_y = slope_y * x + row_slope
    return height, slope_x, slope_y


def monomials(coefficients: Mapping[int, Any], order: int, radius: float) -> np.ndarray:
    """Coefficients of x^a y^b (metres from the centre) of sum a_j Z_j(x/radius, y/radius); shape
    (triangle_size(order),).

    Parameters
    ----------
    coefficients : Mapping[int, Any]
        Noll index j -> a_j, metres rms; complex ones, too.
    order : int
        Highest degree a + b, at least that of the terms.
    radius : float
        Of the disk, metres.
    """
    out = np.zeros(triangle_size(order), np.result_type(float, *coefficients.values()))
    for j, amplitude in coefficients.items():
        for a, b, c in cartesian_terms(j):
            out[triangle_index(a, b)] += amplitude * c / radius ** (a + b)
    return out


@lru_cache(maxsize=256)
def unit_monomials(last: int, order: int, radius: float) -> np.ndarray:
    """``monomials`` of each of Z_1..Z_last with amplitude 1, (last, triangle_size(order)); terms beyond the order: 0.

    Parameters
    ----------
    last : int
        Highest Noll index.
    order : int
        Highest degree a + b.
    radius : float
        Of the disk, metres.
    """
    table = np.zeros((last, triangle_size(order)))
    for j in range(1, last + 1):
        if noll_to_nm(j)[0] <= order:
            table[j - 1] = monomials({j: 1.0}, order, radius)
    table.setflags(write=False)
    return table


def order_of(indices: Any) -> int:
    """Highest radial order among Noll indices, -1 for none."""
    # it never falls along Noll's order
    last = max(indices, default=0)
    return noll_to_nm(last)[0] if last else -1
