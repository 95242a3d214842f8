"""Quadrature rules: sample points and weights for integrals over a pupil or an interval."""

from dataclasses import dataclass
from functools import cache

import numpy as np


@dataclass(frozen=True, eq=False)
class PupilNodes:
    """Quadrature rule of N nodes over the unit disk or the square [-1, 1]^2.

    Attributes
    ----------
    x, y : (N,) ndarray
        Coordinates of the nodes.
    weight : (N,) ndarray
        Area weights, which sum to the area (pi or 4).
    """

    x: np.ndarray
    y: np.ndarray
    weight: np.ndarray

    @property
    def share(self) -> np.ndarray:
        """Weights of a mean over the pupil, one for each of the N nodes, (N,); they sum to 1."""
        return np.asarray(self.weight / np.sum(self.weight))

    @property
    def count(self) -> int:
        """Number of nodes."""
        return len(self.x)


@cache
def disk(rings: int, arms: int | None = None, inner: float = 0.0, rotation: float = 0.0) -> PupilNodes:
    """Return Gauss quadrature over the unit disk (annulus): Gauss-Legendre in r^2, equal arms in azimuth.

    Exact for polynomials of degree below min(4 * rings, arms); integrals of smooth wavefronts converge exponentially,
    with no error from a jagged edge.

    Parameters
    ----------
    rings : int
        Number of radial nodes.
    arms : int, optional
        Number of azimuthal nodes, by default 4 * rings.
    inner : float
        Radius of a central hole, 0 to less than 1.
    rotation : float
        Rotation of all arms, in steps from one arm to the next. With half a step, an integrand whose structure in
        azimuth is too fine gets the opposite error.

    Returns
    -------
    PupilNodes
        Arrays ``x``, ``y`` and ``weight``, which sums to the area; ``share`` are weights of a mean.

    Raises
    ------
    ValueError
        The hole is not smaller than the disk.

    Examples
    --------
    The mean of r^2 over a ring is (1 + e^2) / 2:

    >>> ring = pupil_quadrature(3, inner=0.5)
    >>> round(float(ring.weight.sum() / np.pi), 12), round(float(ring.share @ (ring.x**2 + ring.y**2)), 12)
    (0.75, 0.625)
    """
    if not 0.0 <= inner < 1.0:
        raise ValueError(f"inner must be at least 0 and less than 1, got {inner}")
    arms = 4 * rings if arms is None else arms
    s, w = gauss(rings)
    low = inner**2
    r2 = low + (1.0 - low) * 0.5 * (s + 1.0)
    angle = 2.0 * np.pi * (np.arange(arms) + 0.5 + rotation) / arms
    r = np.sqrt(r2)[:, None]
    weight = np.broadcast_to((w * 0.25 * (1.0 - low))[:, None] * (2.0 * np.pi / arms), (rings, arms))
    return _frozen((r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel(), weight.ravel())


@cache
def even_disk(count: int) -> PupilNodes:
    """Return points spread evenly over the unit disk, of equal weight, for integrands that hard edges cut.

    They lie on Fermat's spiral, each rotated by the golden angle from the one before (Vogel, Mathematical Biosciences
    44, 179, 1979): no edge follows a line of many points, as one does along the rings of ``disk``. An edge changes the
    fraction of the points on one side of it by some count^(-3/4).
    """
    k = np.arange(count)
    r, angle = np.sqrt((k + 0.5) / count), np.pi * (3.0 - np.sqrt(5.0)) * k
    return _frozen(r * np.cos(angle), r * np.sin(angle), np.full(count, np.pi / count))


def circle(count: int) -> np.ndarray:
    """Return points evenly spaced around the unit circle, the first at (1, 0), (count, 2)."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def disk_for(phase: float) -> PupilNodes:
    """Return quadrature nodes over the disk, enough for images of a smooth wavefront.

    Parameters
    ----------
    phase : float
        Largest phase, radians, from the middle to the edge of the pupil at any image point of interest: 2 pi NA r /
        wavelength for points up to r from the spot's centre, with NA the numerical aperture.

    Returns
    -------
    PupilNodes
        The smallest rule that keeps the image of a clear disk within 1e-6 of its peak at all these points (determined
        by comparison with the Airy pattern for phases from 12 to 80).
    """
    return disk(*disk_size(phase))


def second_disk_for(phase: float) -> PupilNodes:
    """Return a rule whose images differ from those of ``disk_for`` wherever one of the two has too few nodes.

    It has two rings more, so that all rings have other radii, and its arms lie between those of the first rule:
    structure too fine in azimuth gets the opposite error, structure too fine along the radius a different one.

    Parameters
    ----------
    phase : float
        Largest phase from the middle to the edge of the pupil, radians.
    """
    rings, arms = disk_size(phase)
    return disk(rings + 2, arms, rotation=0.5)


def disk_size(phase: float) -> tuple[int, int]:
    """Return the numbers of rings and of azimuthal arms of the rule ``disk_for``.

    Parameters
    ----------
    phase : float
        Largest phase from the middle to the edge of the pupil, radians.
    """
    arms = int(np.ceil(phase)) + 10
    return int(np.ceil(0.25 * phase)) + 3, arms + arms % 2


def _frozen(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> PupilNodes:
    """Return the nodes with read-only copies of the arrays."""
    arrays = [np.array(a) for a in (x, y, weight)]
    for array in arrays:
        array.setflags(write=False)
    return PupilNodes(*arrays)


@cache
def gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss-Legendre points and weights on [-1, 1], (count,) each, read-only."""
    points, weights = np.polynomial.legendre.leggauss(count)
    for array in (points, weights):
        array.setflags(write=False)
    return points, weights


def gauss_of(points: np.ndarray, weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gauss rule for weighted sums over given points.

    With n points it is exact for polynomials of degree below 2 n, however rough the weights are (Golub and Welsch,
    Mathematics of Computation 23, 221 (1969); the recurrence by Lanczos steps, each orthogonalised against all before).

    Parameters
    ----------
    points : (N,) ndarray
        N different points.
    weights : (N,) ndarray
        Positive weights.
    count : int
        Number n of points of the rule, reduced to N if larger.

    Returns
    -------
    points : (n,) ndarray
        Points of the rule, ascending.
    weights : (n,) ndarray
        Weights of the rule, with the same sum as the given ones.
    """
    points, weights = np.asarray(points, float), np.asarray(weights, float)
    count = min(count, len(points))
    middle, half = 0.5 * (points.max() + points.min()), 0.5 * float(np.ptp(points)) or 1.0
    x = (points - middle) / half
    rows = np.zeros((count, len(x)))
    diagonal, off_diagonal = np.zeros(count), np.zeros(count)
    vector = np.sqrt(weights / np.sum(weights))
    for k in range(count):
        rows[k] = vector
        vector = x * vector
        diagonal[k] = rows[k] @ vector
        for _ in range(2):
            vector = vector - (rows[: k + 1] @ vector) @ rows[: k + 1]
        off_diagonal[k] = np.linalg.norm(vector)
        vector = vector / (off_diagonal[k] or 1.0)
    nodes, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(off_diagonal[:-1], 1) + np.diag(off_diagonal[:-1], -1))
    return middle + half * nodes, np.sum(weights) * vectors[0] ** 2


def nodes_for(span: float, least: int) -> int:
    """Return the number of Gauss nodes needed to integrate exp(i phase) with a smooth amplitude over an interval.

    The phase varies by +-``span`` radians. Gauss' rule for a linear phase needs span / 2 nodes, plus a number that
    grows like the cube root of the span; with these it is accurate to 1e-8 for spans up to 100. ``least`` is the number
    of nodes for a constant phase. At F/9 and 450 nm the transfer function of a camera with 0.1 waves of aberration is
    then accurate to 3e-8 within 2 mm of its focus (7 waves at the edge), and to 3e-7 at 5 mm.
    """
    return least + int(np.ceil(0.5 * span + 2.0 * span ** (1 / 3)))
