"""Zernike terms of circles and rings in Noll's order, the orders of other programs, and terms made orthonormal over any
light.

Angles run from the columns' direction x to the rows' direction y. Terms of Noll have unit rms over the disk (Noll,
J. Opt. Soc. Am. 66, 207, 1976); those of a ring unit rms over it (Mahajan, J. Opt. Soc. Am. 71, 75, 1981).
"""

from __future__ import annotations

from math import isqrt, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import eval_jacobi

from analysis.arrays import Array

HIGHEST_ORDER = 30
"""Radial order of the last supported terms."""
MOST_TERMS = (HIGHEST_ORDER + 1) * (HIGHEST_ORDER + 2) // 2
LAST_FRINGE = 37
"""The last Fringe term: spherical aberration of the twelfth order, which the rule would count as the 49th."""


def noll_to_nm(index: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m, positive of cosine terms and negative of sine terms.

    Args:
        index: of Noll, 1 for piston.
    """
    if not 1 <= index <= MOST_TERMS:
        raise ValueError(f"Noll's terms 1 to {MOST_TERMS} are known, not {index}")
    n = (isqrt(8 * index - 7) - 1) // 2
    place = index - n * (n + 1) // 2 - 1
    m = 2 * ((place + 1) // 2) if n % 2 == 0 else 2 * (place // 2) + 1
    return n, m if index % 2 == 0 else -m


def nm_to_noll(n: int, m: int) -> int:
    """Noll's index of a term.

    Args:
        n: radial order.
        m: azimuthal order, negative of sine terms.
    """
    first = n * (n + 1) // 2 + 1
    return next(j for j in range(first, first + n + 1) if noll_to_nm(j) == (n, m))


def fringe_to_nm(index: int) -> tuple[int, int]:
    """Orders of a term of the Fringe set of the University of Arizona.

    Args:
        index: 1 for piston, up to 37.
    """
    if not 1 <= index <= LAST_FRINGE:
        raise ValueError(f"Fringe terms 1 to {LAST_FRINGE} are known, not {index}")
    if index == LAST_FRINGE:
        return 12, 0
    half = isqrt(index - 1)
    back = (half + 1) ** 2 - index
    m = (back + 1) // 2
    return 2 * half - m, -m if 2 * m - back else m


def ansi_to_nm(index: int) -> tuple[int, int]:
    """Orders of a term of the American standard Z80.28, which is that of the Optical Society.

    Args:
        index: 0 for piston.
    """
    if not 0 <= index < MOST_TERMS:
        raise ValueError(f"ANSI terms 0 to {MOST_TERMS - 1} are known, not {index}")
    n = (isqrt(8 * index + 1) - 1) // 2
    return n, 2 * index - n * (n + 2)


ORDERS = {"noll": noll_to_nm, "fringe": fringe_to_nm, "ansi": ansi_to_nm}
"""Names of orders -> from the index to n and m."""


def edge_value(n: int, m: int) -> float:
    """What a term of unit rms reaches at the edge, where a term of unit peak reaches 1.

    Args:
        n: radial order.
        m: azimuthal order, of either sign.
    """
    return sqrt(n + 1) * (sqrt(2.0) if m else 1.0)


def circle_terms(terms: Any, x: Any, y: Any) -> Array:
    """Terms of unit rms over the disk at points, as columns (N, Z).

    Args:
        terms: indices of Noll, (Z,).
        x: on the unit disk, (N,).
        y: likewise.
    """
    point, square = np.asarray(x) + 1j * np.asarray(y), np.square(x) + np.square(y)
    columns = np.empty((*point.shape, len(terms)))
    powers: dict[int, NDArray[np.complex128]] = {}
    for k, (n, m) in enumerate(noll_to_nm(int(index)) for index in terms):
        order = abs(m)
        if order not in powers:
            powers[order] = point**order
        turning = powers[order].imag if m < 0 else powers[order].real
        # the radial polynomial, without the power of the radius that stands in the turning part
        radial = eval_jacobi((n - order) // 2, 0, order, 2.0 * square - 1.0)
        np.multiply(edge_value(n, m) * radial, turning, out=columns[..., k])
    return columns
