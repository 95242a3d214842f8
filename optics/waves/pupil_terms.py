"""Polynomials over a pupil: products of Chebyshev's, their values, their slopes and fits of them.

Coefficients of the products T_i(x) T_j(y) with i + j <= degree stand in the order of ``orders``.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev

from optics.numerics.quadrature import PupilNodes


def orders(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Orders (i, j) with i + j <= degree, (K,) each."""
    i, j = np.indices((degree + 1, degree + 1))
    keep = i + j <= degree
    return i[keep], j[keep]


def _series(x: np.ndarray, degree: int) -> np.ndarray:
    """T_0 .. T_degree of x (B, P), shape (B, degree + 1, P)."""
    out = np.empty((len(x), degree + 1, x.shape[1]))
    out[:, 0], twice = 1.0, 2.0 * x
    if degree:
        out[:, 1] = x
    for n in range(2, degree + 1):
        np.multiply(twice, out[:, n - 1], out=out[:, n])
        out[:, n] -= out[:, n - 2]
    return out


def polynomials(tables: Iterable[np.ndarray], p: np.ndarray) -> list[np.ndarray]:
    """Sums of T_i(x) T_j(y) at the same points.

    Args:
        tables: their coefficients, each (B, D + 1, D + 1).
        p: points x + iy, complex (B, P).

    Returns:
        For each table the sums, (B, P).
    """
    tables = tuple(tables)
    x, y = (_series(part, tables[0].shape[-1] - 1) for part in (p.real, p.imag))
    return [np.einsum("bip,bip->bp", table @ y, x) for table in tables]


def products(x: np.ndarray, y: np.ndarray, degree: int) -> np.ndarray:
    """Products T_i(x) T_j(y) of Chebyshev's polynomials with i + j <= degree at points of any shape, (..., K).

    Args:
        x: in [-1, 1], any shape.
        y: of the same shape.
        degree: highest i + j.
    """
    tx, ty = chebyshev.chebvander(x, degree), chebyshev.chebvander(y, degree)
    out = np.empty((*np.shape(x), (degree + 1) * (degree + 2) // 2))
    first = 0
    for i in range(degree + 1):  # in the order of ``orders``
        count = degree + 1 - i
        np.multiply(tx[..., i : i + 1], ty[..., :count], out=out[..., first : first + count])
        first += count
    return out


@lru_cache(maxsize=8)
def to_terms(nodes: PupilNodes, degree: int) -> np.ndarray:
    """From values at nodes of the stop to coefficients of ``products``, by least squares, (K, N).

    Raises:
        ValueError: too few nodes for the degree.
    """
    root = np.sqrt(nodes.weight)
    stop = products(nodes.x, nodes.y, degree) * root[:, None]
    if nodes.count < stop.shape[1] or np.linalg.matrix_rank(stop) < stop.shape[1]:
        raise ValueError(f"{nodes.count} nodes do not determine polynomials of degree {degree}; trace more")
    return np.asarray(np.linalg.pinv(stop) * root)


TAME_DEGREE, STIFFNESS = 8, 1e-6
"""Of the polynomials that go on into the dark, and the weight there of the squares of their coefficients, times their
orders beyond a plane's, of the squares over the light."""

FAINTLY = 1e-6
"""Weight of a node in the dark, of one in the light, for what those leave of a wavefront."""


def smooth_terms(
    design: np.ndarray, weight: np.ndarray, lit: np.ndarray, values: np.ndarray, faintly: float = FAINTLY
) -> np.ndarray:
    """Coefficients of ``products`` through values where there is light, that stay near them where there is none.

    Polynomials of a low degree that do not run away are fitted to the light first. All others add what these leave of
    it, and nothing in the dark. Rays there, of which some pass the rims of lenses far outside, have no part in it.

    Args:
        design: ``products`` at the nodes, (N, K) or (B, N, K).
        weight: of the nodes, (N,).
        lit: where there is light, (B, N).
        values: (B, N, C); whatever stands where there is no light.
        faintly: weight of nodes in the dark; the larger it is the less the polynomials add there.

    Returns:
        (B, K, C).
    """
    i, j = orders(round(np.sqrt(2.0 * design.shape[-1] + 0.25) - 1.5))
    tame = i + j <= TAME_DEGREE
    known = np.where(lit[..., None], values, 0.0)
    few = design[..., tame]
    stiff = STIFFNESS * np.sum(weight) * np.diag(np.maximum(i + j - 1.0, 0.0)[tame] ** 2)
    turned = np.swapaxes(few * (weight * lit)[..., None], 1, 2)
    first = np.linalg.solve(turned @ few + stiff, turned @ known)
    left = np.where(lit[..., None], known - few @ first, 0.0)
    turned = np.swapaxes(design * (weight * np.where(lit, 1.0, faintly))[..., None], 1, 2)
    out = np.linalg.solve(turned @ design, turned @ left)
    out[:, tame] += first
    return np.asarray(out)


def slopes(nodes: PupilNodes, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of ``products`` along x and along y at the nodes, (N, K) each."""
    i, j = orders(degree)
    derive = chebyshev.chebder(np.eye(degree + 1), axis=0)
    tx, ty = (chebyshev.chebvander(c, degree) for c in (nodes.x, nodes.y))
    dx, dy = tx[:, :-1] @ derive, ty[:, :-1] @ derive
    return dx[:, i] * ty[:, j], tx[:, i] * dy[:, j]
