"""Edge-spread function (ESF) as a least-squares curve through pixels at irregular places, and its Fourier transform.

    E(x) = dark + contrast * S(x) + tail * T(x) + sum_k a_k B((x - x_k) / step),        |x_k| < core

S is a smooth unit step (normal distribution, width 0.5 px), T = -x / (x^2 + 1 px^2) the tail, B the cubic B-spline. All
transforms are known in closed form, so that there is no bin, no difference quotient, no window and no cut-off of the
line-spread function to correct for:

- pixels enter at their own places; bins of the usual method (ISO 12233) average places that are not at the bin's centre;
- the derivative of the curve is exact, where a difference of bins multiplies the MTF by a sinc;
- any pupil with a sharp rim makes line-spread tails c / x^2 (the kink of the OTF at zero frequency, slope -4 / (pi f_c)
  for a circle), hence ESF tails c / x. A region of +-32 px cuts off 0.4% of the energy of an F/9 camera with 7 um
  pixels; T carries it to infinity. Asymmetry (coma) falls off faster and stays in the core.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ndtr

__all__ = ["EdgeSpread", "fit_edge_spread"]

Array = NDArray[np.float64]
_STEP_WIDTH = 0.5
_TAIL_WIDTH = 1.0
# Weight of the third differences of the spline against the data. It decides only where pixels leave gaps between the
# sampling phases; it lowers the MTF by 2e-5 at 0.5 cycles/pixel and by 8e-4 at 1 cycle/pixel.
_STIFFNESS = 1e-4


@dataclass(frozen=True, eq=False)
class EdgeSpread:
    """A fitted edge-spread function; x in pixels along the normal, grey values rise with x.

    core: half width of the spline's range, px. oversampling: knots per pixel.
    coefficients: (P,) spline, then dark level, contrast, tail (grey values; the tail's in grey values * px).
    """

    core: float
    oversampling: int
    coefficients: Array
    _inverse: tuple[Array, bool]

    @property
    def dark(self) -> float:
        """Grey value far on the dark side."""
        return float(self.coefficients[-3])

    @property
    def contrast(self) -> float:
        """Grey value far on the bright side minus that on the dark side."""
        return float(self.coefficients[-2])

    def value(self, x: Array) -> Array:
        """Grey values at x, any shape."""
        spline = _spline(x, self.core, self.oversampling, self.coefficients[:-3], 0)
        return spline + self.dark + self.contrast * ndtr(x / _STEP_WIDTH) + self.coefficients[-1] * _tail(x)

    def slope(self, x: Array) -> Array:
        """Line-spread function in grey values per pixel at x, any shape."""
        spline = _spline(x, self.core, self.oversampling, self.coefficients[:-3], 1) * self.oversampling
        step = np.exp(-0.5 * (x / _STEP_WIDTH) ** 2) / (_STEP_WIDTH * np.sqrt(2.0 * np.pi))
        square = x * x
        tail = (square - _TAIL_WIDTH**2) / (square + _TAIL_WIDTH**2) ** 2
        return spline + self.contrast * step + self.coefficients[-1] * tail

    def transform(self, frequency: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Optical transfer function at (F,) cycles/px, (F,), and its derivative by the coefficients, (P, F).

        Integral of the line-spread function times exp(-2 pi i f x), over the contrast.
        """
        omega = 2.0 * np.pi * frequency
        step = 1.0 / self.oversampling
        count = self.coefficients.size - 3
        centre = -self.core + (np.arange(count) + 2.0) * step
        rows = np.empty((count + 3, frequency.size), dtype=np.complex128)
        rows[:count] = (1j * omega * step * np.sinc(frequency * step) ** 4) * np.exp(-1j * np.outer(centre, omega))
        rows[count] = 0.0
        rows[count + 1] = np.exp(-0.5 * (_STEP_WIDTH * omega) ** 2)
        rows[count + 2] = -np.pi * np.abs(omega) * np.exp(-_TAIL_WIDTH * np.abs(omega))
        transfer = (self.coefficients @ rows) / self.contrast
        rows[count + 1] -= transfer
        rows /= self.contrast
        return transfer, rows

    def covariance(self, x: Array, variance: Array) -> Array:
        """Covariance (P, P) of the coefficients when the pixels at x (N,) carry independent noise of variance (N,)."""
        scatter = _normal_matrix(x, variance, self.core, self.oversampling)
        half = cho_solve(self._inverse, scatter, check_finite=False)
        return np.asarray(cho_solve(self._inverse, half.T, check_finite=False))

    def gradient(self, x: float) -> Array:
        """Derivative of the value at one x by the coefficients, (P,)."""
        return _design(np.array([x]), self.core, self.oversampling)[0]


def fit_edge_spread(x: Array, grey: Array, core: float, oversampling: int) -> EdgeSpread:
    """Least-squares curve through the pixels.

    x: (N,) distance from the edge along its normal, px. grey: (N,). core: half width of the spline, px, rounded up to
    whole knots. All pixels have the same weight: weights that follow the shot noise would gain little, and taken from
    the data they would bias the levels.
    """
    core = np.ceil(core * oversampling) / oversampling
    matrix = _normal_matrix(x, None, core, oversampling)
    count = matrix.shape[0] - 3
    density = x.size / (x.max() - x.min()) / oversampling
    # third differences of a spline that is zero outside
    third = np.zeros((count + 3, count))
    at = np.arange(count)
    for offset, weight in enumerate((1.0, -3.0, 3.0, -1.0)):
        third[at + offset, at] = weight
    matrix[:count, :count] += _STIFFNESS * density * (third.T @ third)
    right = np.empty(count + 3)
    cell, basis, inside = _cells(x, core, oversampling, 0)
    index = (cell + np.arange(4)[:, None]).ravel()
    right[:count] = np.bincount(index, (basis * grey[inside]).ravel(), minlength=count + 6)[3:-3]
    right[count:] = _levels(x) @ grey
    inverse = cho_factor(matrix, check_finite=False)
    return EdgeSpread(core, oversampling, cho_solve(inverse, right, check_finite=False), inverse)


def _tail(x: Array) -> Array:
    return np.asarray(-x / (x * x + _TAIL_WIDTH**2))


def _levels(x: Array) -> Array:
    """(3, N): what is not spline."""
    return np.stack([np.ones_like(x), ndtr(x / _STEP_WIDTH), _tail(x)])


def _cells(x: Array, core: float, oversampling: int, derivative: int) -> tuple[NDArray[np.intp], Array, NDArray[np.bool]]:
    """Knot interval (M,) and the four splines that live in it (4, M), for the M of x inside the core; which those are.

    Spline k of interval c is number c + k - 3; numbers outside of the fitted ones have coefficient zero, so that the
    curve and its first two derivatives go over into the tails without a step.
    """
    place = (x + core) * oversampling
    inside = (place >= 0.0) & (place < round(2.0 * core * oversampling))
    place = place[inside]
    cell = place.astype(np.intp)
    u = place - cell
    v = 1.0 - u
    if derivative:
        basis = np.stack([-v * v / 2, u * (1.5 * u - 2), v * (2 - 1.5 * v), u * u / 2])
    else:
        basis = np.stack([v**3 / 6, u * u * (u / 2 - 1) + 2 / 3, v * v * (v / 2 - 1) + 2 / 3, u**3 / 6])
    return cell, basis, inside


def _spline(x: Array, core: float, oversampling: int, coefficients: Array, derivative: int) -> Array:
    cell, basis, inside = _cells(x, core, oversampling, derivative)
    padded = np.zeros(coefficients.size + 6)
    padded[3:-3] = coefficients
    value = np.zeros(x.shape)
    value[inside] = (basis * padded[cell + np.arange(4).reshape(4, *[1] * cell.ndim)]).sum(axis=0)
    return value


def _normal_matrix(x: Array, weight: Array | None, core: float, oversampling: int) -> Array:
    """Sum over pixels of weight * (design row)^T (design row), (P, P)."""
    cell, basis, inside = _cells(x, core, oversampling, 0)
    size = round(2.0 * core * oversampling) + 3
    levels = _levels(x)
    weighted_levels = levels if weight is None else levels * weight
    weighted = basis if weight is None else basis * weight[inside]
    first, second = np.triu_indices(4)
    pair = (cell + first[:, None]) * size + cell + second[:, None]
    upper = np.bincount(pair.ravel(), (weighted[first] * basis[second]).ravel(), minlength=size * size)
    upper = upper.reshape(size, size)[3:-3, 3:-3]
    count = size - 6
    matrix = np.empty((count + 3, count + 3))
    matrix[:count, :count] = upper + np.triu(upper, 1).T
    index = (cell + np.arange(4)[:, None]).ravel()
    for k in range(3):
        column = np.bincount(index, (weighted * levels[k, inside]).ravel(), minlength=size)[3:-3]
        matrix[:count, count + k] = matrix[count + k, :count] = column
    matrix[count:, count:] = weighted_levels @ levels.T
    return matrix


def _design(x: Array, core: float, oversampling: int) -> Array:
    """Design rows (N, P)."""
    cell, basis, inside = _cells(x, core, oversampling, 0)
    rows = np.zeros((x.size, round(2.0 * core * oversampling) + 3))
    rows[np.flatnonzero(inside), cell + np.arange(4)[:, None]] = basis
    return np.concatenate([rows[:, 3:-3], _levels(x).T], axis=1)
