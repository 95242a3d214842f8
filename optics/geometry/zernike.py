"""Zernike circle polynomials in Noll's order, unit rms over the disk, as Cartesian polynomials.

Annular Zernike polynomials: orthonormal over a ring, in Noll's order (Mahajan, J. Opt. Soc. Am. 71, 75, 1981).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from math import comb, factorial, isqrt, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optics.numerics.arguments import finite
from optics.numerics.quadrature import disk

MAX_NOLL = 66
"""Highest supported Noll index (all terms to radial order 10); beyond it monomials lose digits."""
RANK_TOLERANCE = 1e-6
"""Limit below which a combination of Zernike terms is excluded from a fit, because the points do not determine it.

It applies to the singular value of the combination relative to the largest one.
"""


def noll_to_nm(index: int) -> tuple[int, int]:
    """Return radial order n and signed azimuthal order m of a Noll index.

    Parameters
    ----------
    index : int
        Noll index, 1 to 66: 1 is piston, 2 tilt x, 3 tilt y, 4 defocus.

    Returns
    -------
    n : int
        Radial order.
    m : int
        Azimuthal order, positive for cosine terms (even indices) and negative for sine terms (Noll, JOSA 66, 207,
        1976).

    Raises
    ------
    ValueError
        The index is out of its range.

    Examples
    --------
    >>> [noll_to_nm(j) for j in (1, 4, 7, 8, 11)]
    [(0, 0), (2, 0), (3, -1), (3, 1), (4, 0)]
    >>> noll_to_nm(0)
    Traceback (most recent call last):
    ...
    ValueError: Noll index 0 is outside 1..66
    """
    if index != int(index) or not 1 <= index <= MAX_NOLL:
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
    """Return the name of a Noll term.

    The direction is that in which the term is largest at the edge: x or y for tilt and coma, otherwise an angle from x.

    Parameters
    ----------
    index : int
        Noll index, 1 to 66.

    Returns
    -------
    str
        Name of the aberration.

    Examples
    --------
    >>> [zernike_name(j) for j in (4, 8, 11)]
    ['defocus', 'coma x', 'spherical aberration']
    >>> zernike_name(13)
    'secondary astigmatism 45 deg'
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
    """Return the Zernike polynomial of a Noll index as terms (a, b, c): the sum of c x^a y^b on the unit disk."""
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
    """Return the value of a Zernike circle polynomial in Noll's order.

    Parameters
    ----------
    index : int
        Noll index j, 1 to 66.
    x, y : array_like
        Unit-disk coordinates, of one shape.

    Returns
    -------
    ndarray
        Z_j, of unit rms over the disk.

    Examples
    --------
    Defocus is sqrt(3) (2 r^2 - 1), and different terms are orthonormal over the disk:

    >>> zernike(4, np.array([0.0, 0.5, 1.0]), np.zeros(3)).round(4)
    array([-1.7321, -0.866 ,  1.7321])
    >>> nodes = pupil_quadrature(6)
    >>> coma, spherical = zernike(8, nodes.x, nodes.y), zernike(11, nodes.x, nodes.y)
    >>> round(float(nodes.share @ coma**2), 12), abs(round(float(nodes.share @ (coma * spherical)), 12))
    (1.0, 0.0)
    """
    x, y = np.asarray(x), np.asarray(y)
    return np.asarray(sum(c * x**a * y**b for a, b, c in cartesian_terms(index)))


def basis(last: int, x: Any, y: Any) -> np.ndarray:
    """Return Z_1..Z_last at N points as columns, shape (N, last).

    Parameters
    ----------
    last : int
        Highest Noll index.
    x, y : (N,) array_like
        Unit-disk coordinates.
    """
    return np.stack([zernike(j, x, y) * np.ones_like(x) for j in range(1, last + 1)], axis=-1)


def gradient_basis(last: int, x: Any, y: Any, axis: int) -> np.ndarray:
    """Return the derivatives of Z_1..Z_last along x (axis 0) or y (axis 1) at N points, shape (N, last).

    Parameters
    ----------
    last : int
        Highest Noll index.
    x, y : (N,) array_like
        Unit-disk coordinates.
    axis : int
        0 for the derivative with respect to x, 1 for y.
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
    """Fit coefficients of Z_1..Z_last by weighted least squares.

    Parameters
    ----------
    last : int
        Highest Noll index.
    x, y : (N,) array_like
        Unit-disk coordinates of N points.
    values : (..., N) array_like
        Values to fit, e.g. optical path differences in metres.
    weights : (N,) array_like, optional
        Quadrature weights; equal by default.

    Returns
    -------
    (..., last) ndarray
        Coefficients in the unit of ``values`` (each is an rms).

    Raises
    ------
    ValueError
        A value is NaN or infinite.

    Examples
    --------
    A surface that is 20 nm rms out of focus with 5 nm rms of astigmatism:

    >>> nodes = pupil_quadrature(6)
    >>> surface = 20e-9 * zernike(4, nodes.x, nodes.y) + 5e-9 * zernike(6, nodes.x, nodes.y)
    >>> (1e9 * fit_zernikes(6, nodes.x, nodes.y, surface, nodes.weight)).round(6) + 0.0
    array([ 0.,  0.,  0., 20.,  0.,  5.])
    """
    known = finite("values", values, "so exclude points without data")
    root = np.sqrt(np.ones_like(x) if weights is None else weights)
    solution, *_ = np.linalg.lstsq(basis(last, x, y) * root[:, None], (known * root).T, rcond=None)
    return np.asarray(solution.T)


def triangle_size(order: int) -> int:
    """Return the number of monomials x^a y^b of degree a + b <= order."""
    return (order + 1) * (order + 2) // 2


def triangle_order(size: int) -> int:
    """Return the degree up to which there are ``size`` monomials x^a y^b, the inverse of ``triangle_size``."""
    order = (isqrt(8 * size + 1) - 3) // 2
    if triangle_size(order) != size:
        raise ValueError(f"{size} is not the number of monomials up to any order")
    return order


def triangle_index(a: int, b: int) -> int:
    """Return the index of the monomial x^a y^b in a list ordered by total degree a + b."""
    d = a + b
    return d * (d + 1) // 2 + b


def triangle_polynomial(x: Any, y: Any, coefficients: Sequence[Any], order: int) -> tuple[Any, Any, Any]:
    """Return a polynomial, the sum of c_ab x^a y^b with a + b <= order, and its derivatives with respect to x and y.

    Parameters
    ----------
    x, y : array
        Points, metres; NumPy or Dr.Jit arrays.
    coefficients : sequence
        Coefficients c_ab in m^(1-a-b), ordered by ``triangle_index``.
    order : int
        Highest degree a + b.

    Returns
    -------
    tuple
        Height, metres, and its derivatives with respect to x and y.
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
    """Return a sum of Zernike polynomials, a_j Z_j(x/radius, y/radius), as coefficients of x^a y^b.

    Parameters
    ----------
    coefficients : mapping of int to number
        Noll index j -> amplitude a_j, metres rms; may be complex.
    order : int
        Highest degree a + b, at least that of the terms.
    radius : float
        Radius of the disk, metres.

    Returns
    -------
    (triangle_size(order),) ndarray
        Coefficients ordered by ``triangle_index``, for x and y in metres from the centre.
    """
    out = np.zeros(triangle_size(order), np.result_type(float, *coefficients.values()))
    for j, amplitude in coefficients.items():
        for a, b, c in cartesian_terms(j):
            out[triangle_index(a, b)] += amplitude * c / radius ** (a + b)
    return out


@lru_cache(maxsize=256)
def unit_monomials(last: int, order: int, radius: float) -> np.ndarray:
    """Return the coefficients of x^a y^b of each Zernike polynomial Z_1..Z_last with amplitude 1.

    Terms of a degree beyond ``order`` are 0.

    Parameters
    ----------
    last : int
        Highest Noll index.
    order : int
        Highest degree a + b.
    radius : float
        Radius of the disk, metres.

    Returns
    -------
    (last, triangle_size(order)) ndarray
        Read-only table of coefficients.
    """
    table = np.zeros((last, triangle_size(order)))
    for j in range(1, last + 1):
        if noll_to_nm(j)[0] <= order:
            table[j - 1] = monomials({j: 1.0}, order, radius)
    table.setflags(write=False)
    return table


def order_of(indices: Any) -> int:
    """Return the highest radial order among Noll indices; -1 if there are none."""
    # the radial order never decreases with the Noll index
    last = max(indices, default=0)
    return noll_to_nm(last)[0] if last else -1


@lru_cache(maxsize=512)
def _circle_terms(index: int, inner: float) -> tuple[tuple[int, float], ...]:
    """Return the Zernike circle polynomials that add up to an annular one: pairs of Noll index and factor.

    ``index`` is the Noll index and ``inner`` the inner radius of the ring relative to the outer one.
    """
    n, m = noll_to_nm(index)
    same = [j for j in range(1, index + 1) if noll_to_nm(j)[1] == m]
    nodes = disk(n + 2, 4 * n + 8, inner)
    table = np.stack([zernike(j, nodes.x, nodes.y) * np.ones_like(nodes.x) for j in same], axis=-1)
    root = np.linalg.cholesky(table.T @ (nodes.share[:, None] * table))
    last = np.linalg.solve(root.T, np.eye(len(same))[-1])
    return tuple(zip(same, last.tolist(), strict=True))


def annular_zernike(index: int, x: ArrayLike, y: ArrayLike, inner: float) -> np.ndarray:
    """Compute the annular Zernike polynomial of a Noll index.

    Parameters
    ----------
    index : int
        Noll index, 1 to 66.
    x, y : array_like
        Points in units of the outer radius, of one shape.
    inner : float
        Inner radius of the ring in units of the outer one, 0 to less than 1.

    Returns
    -------
    ndarray
        Values of unit rms over the ring, of the shape of ``x``.

    Raises
    ------
    ValueError
        The index or the inner radius is out of its range.

    Notes
    -----
    Circle polynomials of one azimuthal order made orthonormal over the ring one after the other (Gram and Schmidt), as
    Mahajan defines them (J. Opt. Soc. Am. 71, 75, 1981).

    Examples
    --------
    Defocus over a ring is sqrt(3) (2 r^2 - 1 - e^2) / (1 - e^2):

    >>> r = np.array([0.5, 0.75, 1.0])
    >>> annular_zernike(4, r, 0 * r, inner=0.5).round(4)
    array([-1.7321, -0.2887,  1.7321])

    Without a hole they are Zernike's circle polynomials; with one they are still orthonormal:

    >>> bool(np.allclose(annular_zernike(11, r, r / 2, 0.0), zernike(11, r, r / 2)))
    True
    >>> ring = pupil_quadrature(8, inner=0.5)
    >>> values = [annular_zernike(j, ring.x, ring.y, 0.5) for j in (1, 4, 11)]
    >>> np.round((ring.share * values) @ np.transpose(values), 12) + 0.0
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    if not 0.0 <= inner < 1.0:
        raise ValueError(f"inner must be at least 0 and less than 1, got {inner}")
    x, y = np.asarray(x, float), np.asarray(y, float)
    return np.asarray(sum(factor * zernike(j, x, y) for j, factor in _circle_terms(index, float(inner))))
