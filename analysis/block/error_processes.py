"""Error models of attitude and station readings as stochastic processes, with sparse precision matrices.

A correction about (or along) three axes is, at time t,

    sigma_axis * sum over k of b_k(t) z_k,axis,

with unknowns z whose prior is that of the process at unit sigma, the same about every axis:

- `constant`: one z of variance 1. `rate`: one z, times the seconds from the middle of the scope.
- `white`: independent readings at whole multiples of `interval`, interpolated by the cubic spline through them
  (`analysis.orbit.forward_intersection` has the algebra). sigma is that of a reading.
- `walk`: a random walk that is zero at the middle of the scope; sigma is that of its increment over one second.
- `slow`: a first-order Gauss-Markov process of standard deviation sigma and correlation time `time`.
- `orbital`: amplitudes of cosine and sine of 2 pi t / `time`, each of standard deviation sigma.
- `jitter`: the same at `frequency`, each amplitude a slow process of standard deviation sigma and correlation time
  `time`, so that sigma is the root mean square of the oscillation. It is a line of the spectrum of width 1 / (pi time):
  a frequency with the standard deviation s keeps its phase for 1 / (2 pi s).

A random walk, a slow process and amplitudes of jitter have unknowns at whole multiples of `interval` and are linear
between them.

`Corrections` evaluates the corrections of attitude and station of a pass at the times of its observations, linear in
the unknowns. Interpolation coefficients are computed on demand, for a part of the observations at a time: they would
otherwise be most of a block's memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import sparse

from analysis.arrays import Array, Indices, MeasurementError
from analysis.orbit.forward_intersection import spline_blend, spline_precision

Kind = Literal["constant", "rate", "white", "walk", "slow", "orbital", "jitter"]
KINDS: tuple[Kind, ...] = ("constant", "rate", "white", "walk", "slow", "orbital", "jitter")
"""Names of the kinds of error models: stochastic processes and constants of attitude and station errors."""
STEPPED = ("white", "walk", "slow", "jitter")
"""Kinds of error models whose unknowns lie at whole multiples of a time interval."""
_GAP = 18
"""Gap, in intervals, from which on segments of a spline's unknowns are treated as independent; their correlation is
1e-9.
"""
_MOST = 1e5
"""Largest number of intervals from the first to the last observation of a scope; more unknowns could not be adjusted
together.
"""
_PINNED = 1e8
"""Precision of the constraint that a random walk is zero at the middle, relative to that of its increment over an
interval.
"""


class BlockError(MeasurementError, ValueError):
    """Error raised for invalid input of a block adjustment, or for a block that cannot be solved."""


@dataclass(frozen=True)
class Law:
    """Error model of the attitude or of the station.

    Attributes
    ----------
    group : str
        Name of the error model and of its variance component.
    kind : {'constant', 'rate', 'white', 'walk', 'slow', 'orbital', 'jitter'}
        Kind of process; see the module.
    sigma : (3,) tuple of float
        Sigma about or along three axes, in radians or metres; of a rate per second, of a random walk over one second.
    interval : float
        Spacing of the unknowns of `white`, `walk`, `slow` and `jitter`, in seconds.
    time : float
        Correlation time of `slow` and of the amplitudes of `jitter`, or period of `orbital`, in seconds.
    frequency : float
        Frequency of `jitter`, in hertz.
    """

    group: str
    kind: Kind
    sigma: tuple[float, float, float]
    interval: float = 1.0
    time: float = 0.0
    frequency: float = 0.0

    def check(self) -> None:
        """Raise BlockError if a parameter of the error model is missing, negative or not finite."""
        if self.kind not in KINDS:
            raise BlockError(
                f"block: {self.group}: the error model must be one of {', '.join(KINDS)}, found {self.kind!r}"
            )
        if len(self.sigma) != 3 or not np.all(np.isfinite(self.sigma)) or min(self.sigma) < 0:
            raise BlockError(
                f"block: {self.group}: need three sigmas that are finite and not negative, found {self.sigma}"
            )
        if self.kind in STEPPED and not (np.isfinite(self.interval) and self.interval > 0):
            raise BlockError(f"block: {self.group}: the interval must be positive, found {self.interval}")
        if self.kind == "jitter" and not (np.isfinite(self.frequency) and self.frequency > 0):
            raise BlockError(f"block: {self.group}: the frequency must be positive, found {self.frequency}")
        if self.kind in ("slow", "orbital", "jitter") and not (np.isfinite(self.time) and self.time > 0):
            raise BlockError(f"block: {self.group}: correlation time or period must be positive, found {self.time}")

    def spread(self, seconds: float) -> tuple[float, float, float]:
        """Return the standard deviation of the process about (or along) three axes, in rad (or m), at a given time.

        `seconds` is the time from the middle of the scope (the pass, the passes of a star tracker, or the block).
        """
        factor = {"rate": abs(seconds), "walk": float(np.sqrt(abs(seconds)))}.get(self.kind, 1.0)
        a, b, c = (s * factor for s in self.sigma)
        return a, b, c


@dataclass(frozen=True, eq=False)
class Support:
    """Unknowns of one error model in one scope: a pass, all passes of a star tracker, or the block.

    Attributes
    ----------
    law : Law
        Error model.
    numbers : (k,) ndarray of int
        Integers that identify the k unknowns of one axis. An unknown at the time j `interval` has the number j; for
        jitter the cosine's amplitude has 2 j and the sine's 2 j + 1. Models without an interval have 0, or 0 and 1.
    middle : float
        Time at which a rate is zero, in seconds.
    precision : (k, k) csr_matrix
        A-priori precision of the unknowns of one axis.
    """

    law: Law
    numbers: Indices
    middle: float
    precision: sparse.csr_matrix

    @classmethod
    def of(cls, law: Law, times: Array, middle: float | None = None) -> Support:
        """Return the unknowns of an error model on which observations at the given times depend.

        Parameters
        ----------
        law : Law
            Error model.
        times : (n,) ndarray
            Times of the n observations, in seconds.
        middle : float, optional
            Time at which a rate and a random walk are zero, in seconds; the middle of the times by default.

        Raises
        ------
        BlockError
            A parameter of the error model is invalid, or there are no times.
        """
        law.check()
        if not len(times):
            raise BlockError(f"block: {law.group}: no observation depends on it")
        middle = 0.5 * float(times.min() + times.max()) if middle is None else middle
        if law.kind in ("constant", "rate", "orbital"):
            count = 2 if law.kind == "orbital" else 1
            return cls(law, np.arange(count), middle, sparse.csr_matrix(sparse.eye(count)))
        if np.ptp(times) / law.interval > _MOST:
            raise BlockError(f"block: {law.group}: the interval is too short for {np.ptp(times):.3g} s of observations")
        if law.kind == "white":
            first, _ = spline_blend(times, law.interval)
            used = np.unique(first[:, None] + np.arange(4))
            steps = np.diff(used)
            filled = [np.arange(a, a + s) for a, s in zip(used[:-1], np.where(steps < _GAP, steps, 1), strict=True)]
            numbers = np.concatenate([*filled, used[-1:]])
            runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
            parts = [spline_precision(len(run)) for run in runs]
            return cls(law, numbers, middle, sparse.csr_matrix(sparse.block_diag(parts)))
        first = np.asarray(np.floor(times / law.interval), np.intp)
        zero = int(np.round(middle / law.interval))
        ends = [zero] if law.kind == "walk" else []
        numbers = np.unique(np.concatenate([first, first + 1, np.array(ends, np.intp)]))
        step = np.diff(numbers) * law.interval
        if law.kind == "walk":
            precision = _chain(np.ones(len(step)), step)
            pin = int(np.searchsorted(numbers, zero))
            shape = (len(numbers), len(numbers))
            extra = sparse.csr_matrix(([_PINNED / law.interval], ([pin], [pin])), shape=shape)
            return cls(law, numbers, middle, sparse.csr_matrix(precision + extra))
        correlation = np.exp(-step / law.time)
        precision = _chain(correlation, 1.0 - correlation**2).tolil()
        precision[0, 0] += 1.0
        if law.kind == "jitter":
            both = (2 * numbers[:, None] + np.arange(2)).ravel()
            return cls(law, both, middle, sparse.csr_matrix(sparse.kron(precision, sparse.eye(2))))
        return cls(law, numbers, middle, sparse.csr_matrix(precision))

    @property
    def size(self) -> int:
        """Number of unknowns of all three axes.

        They are ordered by number (time), and by axis within a number.
        """
        return 3 * len(self.numbers)

    def blend(self, times: Array) -> tuple[Indices, Array]:
        """Return indices and coefficients of the unknowns of one axis on which the error at each of n times depends.

        Both have shape (n, w), with w unknowns per time.

        At a time far from all observations all coefficients are zero.
        """
        count, law = len(times), self.law
        if law.kind == "constant":
            return np.zeros((count, 1), np.intp), np.ones((count, 1))
        if law.kind == "rate":
            return np.zeros((count, 1), np.intp), (times - self.middle)[:, None]
        if law.kind == "orbital":
            phase = 2.0 * np.pi * times / law.time
            return np.tile(np.arange(2), (count, 1)), np.stack([np.cos(phase), np.sin(phase)], axis=1)
        if law.kind == "white":
            first, values = spline_blend(times, law.interval)
            numbers = first[:, None] + np.arange(4)
        else:
            first = np.asarray(np.floor(times / law.interval), np.intp)
            share = times / law.interval - first
            numbers, values = np.stack([first, first + 1], axis=1), np.stack([1.0 - share, share], axis=1)
            if law.kind == "jitter":
                phase = 2.0 * np.pi * law.frequency * times
                wave = np.stack([np.cos(phase), np.sin(phase)], axis=1)
                numbers, values = 2 * first[:, None] + np.arange(4), np.repeat(values, 2, axis=1) * np.tile(wave, 2)
        position = np.minimum(np.searchsorted(self.numbers, numbers), len(self.numbers) - 1)
        return position, np.where(self.numbers[position] == numbers, values, 0.0)

    def whitened(self) -> Array:
        """Return a square root R of the precision of the k unknowns of one axis: R R' = precision, dense (k, k).

        The whitened unknowns R' z are independent and in order of time.
        """
        return np.asarray(np.linalg.cholesky(self.precision.toarray()[::-1, ::-1])[::-1, ::-1])


def _chain(correlation: Array, variance: Array) -> sparse.csr_matrix:
    """Return the precision (k, k) of a first-order autoregression of k values, without a prior on the first.

    Each value is `correlation` times the one before plus independent noise of the given `variance`.
    """
    count = len(correlation) + 1
    steps = sparse.diags([-correlation, np.ones(count - 1)], [0, 1], shape=(count - 1, count))
    return sparse.csr_matrix(steps.T @ sparse.diags(1.0 / variance) @ steps)


@dataclass(frozen=True, eq=False)
class Part:
    """Contribution of one error model to a correction.

    Attributes
    ----------
    rotates : bool
        True for a rotation of the body, in radians; False for a shift of the station along the axes of the pass, in
        metres.
    first : int
        Column of the first unknown.
    support : Support
        Unknowns of the error model.
    """

    rotates: bool
    first: int
    support: Support

    @cached_property
    def sigma(self) -> Array:
        """Standard deviations of the error model about (or along) the three axes, in radians (or metres)."""
        return np.array(self.support.law.sigma)


@dataclass(frozen=True, eq=False)
class Corrections:
    """Attitude and station corrections at the times of n observations, as linear functions of the unknowns.

    Attributes
    ----------
    parts : tuple of Part
        Contributions of the error models; rotations come first.
    axes : (3, 3) ndarray
        Axes of the pass (along, across, down) as columns, ITRS.
    time : (n,) ndarray
        Times, in seconds.
    """

    parts: tuple[Part, ...]
    axes: Array
    time: Array

    def taken(self, which: Indices) -> Corrections:
        """Return the corrections at the times of k selected observations, given by their indices."""
        return replace(self, time=self.time[which])

    @cached_property
    def _blends(self) -> tuple[tuple[Indices, Array], ...]:
        """Indices and interpolation coefficients, at the n times, of the unknowns of each error model."""
        return tuple(part.support.blend(self.time) for part in self.parts)

    @property
    def columns(self) -> Indices:
        """Indices (n, w), among all unknowns, of the w unknowns on which the corrections at each of n times depend."""
        parts = [np.zeros((len(self.time), 0), np.intp)]
        for part, (number, _) in zip(self.parts, self._blends, strict=True):
            columns = part.first + 3 * number[:, :, None] + np.arange(3)
            parts.append(columns.reshape(len(number), 3 * number.shape[1]))
        return np.concatenate(parts, axis=1)

    def factors(self, rotates: bool) -> tuple[Indices, Array]:
        """Return indices and coefficients of the unknowns for the rotations or, if not `rotates`, for the shifts.

        Both are (n, w, 3) for n times, w unknowns and three axes; coefficients are in radians or metres per unit of the
        unknown.
        """
        count = len(self.time)
        columns, factors = [np.zeros((count, 0, 3), np.intp)], [np.zeros((count, 0, 3))]
        for part, (number, blend) in zip(self.parts, self._blends, strict=True):
            if part.rotates == rotates:
                columns.append(part.first + 3 * number[:, :, None] + np.arange(3))
                factors.append(blend[:, :, None] * part.sigma)
        return np.concatenate(columns, axis=1), np.concatenate(factors, axis=1)

    def at(self, x: Array) -> tuple[Array, Array]:
        """Return the rotations, in rad, and the shifts along the axes of the pass, in m, for values of the unknowns.

        Both are (n, 3) for n times; `x` holds all P unknowns.
        """
        rotation, shift = np.zeros((2, len(self.time), 3))
        for part, (number, blend) in zip(self.parts, self._blends, strict=True):
            unknowns = part.sigma * x[part.first : part.first + part.support.size].reshape(-1, 3)
            value = np.einsum("nw,nwa->na", blend, unknowns[number])
            if part.rotates:
                rotation += value
            else:
                shift += value
        return rotation, shift

    def slopes(self, by_turn: Array, by_station: Array) -> Array:
        """Return the derivatives (n, d, w) of d equations at each of n times with respect to w unknowns.

        The w unknowns of a time are those on which the corrections at that time depend (`columns`).

        Parameters
        ----------
        by_turn : (n, d, 3) ndarray
            Derivatives of the equations with respect to the rotation vector of the body, per radian.
        by_station : (n, d, 3) ndarray
            Derivatives of the equations with respect to the station (position of the satellite), ITRS, per metre.
        """
        count, depth = by_turn.shape[:2]
        widths = [3 * blend.shape[1] for _, blend in self._blends]
        slopes = np.empty((count, depth, sum(widths)))
        along, column = by_station @ self.axes, 0
        for part, (_, blend), width in zip(self.parts, self._blends, widths, strict=True):
            by = (by_turn if part.rotates else along) * part.sigma
            for k in range(blend.shape[1]):
                start = column + 3 * k
                np.multiply(by, blend[:, k, None, None], out=slopes[:, :, start : start + 3])
            column += width
        return slopes


def rotated(rotation: Array, vector: Array) -> Array:
    """Rotate n vectors, or n groups of d vectors, by n small rotation vectors of up to a degree.

    Vectors are (n, 3) or (n, d, 3), rotation vectors (n, 3) in radians.

    The series of the rotation is truncated after the third order; the error is 1e-9 of a degree.
    """
    if vector.ndim == 3:
        rotation = rotation[:, None]
    square = np.sum(rotation**2, axis=-1, keepdims=True)
    product = cross(rotation, vector)
    return np.asarray(vector + (1.0 - square / 6.0) * product + (0.5 - square / 24.0) * cross(rotation, product))


def rotated_back(rotation: Array, vector: Array) -> Array:
    """Rotate n vectors, or n groups of d vectors, by the inverses of n small rotation vectors, in radians."""
    return rotated(-rotation, vector)


def cross(a: Array, b: Array) -> Array:
    """Return the vector product along the last axis, several times faster than numpy's for many short vectors."""
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(a[..., j], b[..., k], out=product[..., i])
        product[..., i] -= a[..., k] * b[..., j]
    return product


def rotation_vector_derivatives(rotation: Array, by_turn: Array) -> Array:
    """Return derivatives with respect to n rotation vectors from those with respect to small added rotations.

    Both have shape (n, d, 3), for d quantities. The input holds derivatives with respect to a further small rotation of
    the rotated body; the conversion is the right Jacobian of the rotation, to second order.
    """
    # t (I - S / 2 + S^2 / 6), where t S = t x turn
    product = cross(by_turn, rotation[:, None])
    return np.asarray(by_turn - 0.5 * product + cross(product, rotation[:, None]) / 6.0)
