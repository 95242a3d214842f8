"""Annular Zernike polynomials: orthonormal over a ring, in Noll's order (Mahajan, J. Opt. Soc. Am. 71, 75, 1981)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from optics.geometry.zernike import noll_to_nm, zernike
from optics.numerics.quadrature import disk


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
