"""Errors of readings as processes in time, each with the sparse precision of its unknowns.

A correction about (or along) three axes is, at time t,

    sigma_axis * sum over k of b_k(t) z_k,axis,

with unknowns z whose prior is that of the process at unit size, the same about every axis:

- `constant`: one z of variance 1. `rate`: one, times the seconds from the middle of the scope.
- `white`: readings at whole multiples of `interval`, independent, joined by the cubic spline through them
  (`analysis.orbit.forward_intersection` has the algebra). sigma is that of a reading.
- `walk`: a random walk that is zero at the middle of the scope; sigma is what it gains in a second.
- `slow`: a first-order Gauss-Markov process of standard deviation sigma and correlation time `time`.
- `orbital`: amplitudes of cosine and sine of 2 pi t / `time`, of standard deviation sigma each.
- `jitter`: the same at `frequency`, each amplitude a slow process of standard deviation sigma and correlation time
  `time`, so that sigma is the root mean square of the oscillation. It is a line of the spectrum of width 1 / (pi time):
  a frequency that is known to s keeps its phase for 1 / (2 pi s).

A walk, a slow process and amplitudes of jitter have unknowns at whole multiples of `interval` and are straight lines
between them.

Corrections of attitude and station of a pass at the times of its observations, linear in the unknowns of its laws.

How much of each unknown a time meets is worked out when it is needed, for some of the observations at a time: it would
else be most of what a block takes in memory.
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
STEPPED = ("white", "walk", "slow", "jitter")
"""Laws with unknowns at multiples of an interval."""
_GAP = 18
"""Stretches of a spline's unknowns this far apart correlate by 1e-9 and are kept apart."""
_MOST = 1e5
"""Intervals from the first observation of a scope to the last; unknowns of more could not be adjusted together."""
_PINNED = 1e8
"""Precision of a walk's zero at the middle, in squares of what it gains in an interval."""


class BlockError(MeasurementError, ValueError):
    """Input of a block adjustment that cannot be used, or a block that cannot be solved."""


@dataclass(frozen=True)
class Law:
    """One source of error of attitude or station.

    Attributes
    ----------
    group : str
        Its name, and that of its variance component.
    kind : Kind
        Of process, see the module.
    sigma : tuple[float, float, float]
        About or along three axes, radians or metres; of a rate per second, of a walk in a second.
    interval : float
        Between the unknowns of `white`, `walk`, `slow` and `jitter`, seconds.
    time : float
        Correlation time of `slow` and of the amplitudes of `jitter`, period of `orbital`, seconds.
    frequency : float
        Of `jitter`, hertz.
    """

    group: str
    kind: Kind
    sigma: tuple[float, float, float]
    interval: float = 1.0
    time: float = 0.0
    frequency: float = 0.0

    def check(self) -> None:
        """Raises BlockError for numbers that cannot be used."""
        if self.kind not in KINDS:
            raise BlockError(f"block: {self.group}: a law is one of {', '.join(KINDS)}, found {self.kind!r}")
        if len(self.sigma) != 3 or not np.all(np.isfinite(self.sigma)) or min(self.sigma) < 0:
            raise BlockError(f"block: {self.group}: three sigmas that are finite and not negative, found {self.sigma}")
        if self.kind in STEPPED and not (np.isfinite(self.interval) and self.interval > 0):
            raise BlockError(f"block: {self.group}: the interval must be positive, found {self.interval}")
        if self.kind == "jitter" and not (np.isfinite(self.frequency) and self.frequency > 0):
            raise BlockError(f"block: {self.group}: the frequency must be positive, found {self.frequency}")
        if self.kind in ("slow", "orbital", "jitter") and not (np.isfinite(self.time) and self.time > 0):
            raise BlockError(f"block: {self.group}: correlation time or period must be positive, found {self.time}")

    def spread(self, seconds: float) -> tuple[float, float, float]:
        """Standard deviation (3) of the process at `seconds` from the middle of its scope, radians or metres."""
        grown = {"rate": abs(seconds), "walk": float(np.sqrt(abs(seconds)))}.get(self.kind, 1.0)
        a, b, c = (s * grown for s in self.sigma)
        return a, b, c


@dataclass(frozen=True, eq=False)
class Support:
    """The unknowns of one law in one scope: a pass, all passes of a star tracker, or the block.

    Attributes
    ----------
    law : Law
        which.
    numbers : Indices
        (k,) of the unknowns of one axis: multiples of the interval where there is one, else 0, 1; of jitter twice the
        multiple for the cosine, and one more for the sine.
    middle : float
        Time at which a rate vanishes, seconds.
    precision : sparse.csr_matrix
        (k, k) sparse, of the unknowns of one axis.
    """

    law: Law
    numbers: Indices
    middle: float
    precision: sparse.csr_matrix

    @classmethod
    def of(cls, law: Law, times: Array, middle: float | None = None) -> Support:
        """The unknowns that observations meet.

        Parameters
        ----------
        law : Law
            Of the process.
        times : Array
            Of the observations, (n,), seconds.
        middle : float | None
            Where a rate and a walk are zero, seconds; None for the middle of the times.

        Raises
        ------
        BlockError
            Numbers of the law that cannot be used, or no times.
        """
        law.check()
        if not len(times):
            raise BlockError(f"block: {law.group}: no observation meets it")
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
        kept = np.exp(-step / law.time)
        precision = _chain(kept, 1.0 - kept**2).tolil()
        precision[0, 0] += 1.0
        if law.kind == "jitter":
            both = (2 * numbers[:, None] + np.arange(2)).ravel()
            return cls(law, both, middle, sparse.csr_matrix(sparse.kron(precision, sparse.eye(2))))
        return cls(law, numbers, middle, sparse.csr_matrix(precision))

    @property
    def size(self) -> int:
        """Unknowns: three axes of each number, an axis after the other, then the next number."""
        return 3 * len(self.numbers)

    def blend(self, times: Array) -> tuple[Indices, Array]:
        """Which numbers (n, w) of an axis' unknowns each time meets, counted from 0, and by how much (n, w).

        A time far from all observations meets nothing.
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
            wanted = first[:, None] + np.arange(4)
        else:
            first = np.asarray(np.floor(times / law.interval), np.intp)
            share = times / law.interval - first
            wanted, values = np.stack([first, first + 1], axis=1), np.stack([1.0 - share, share], axis=1)
            if law.kind == "jitter":
                phase = 2.0 * np.pi * law.frequency * times
                wave = np.stack([np.cos(phase), np.sin(phase)], axis=1)
                wanted, values = 2 * first[:, None] + np.arange(4), np.repeat(values, 2, axis=1) * np.tile(wave, 2)
        where = np.minimum(np.searchsorted(self.numbers, wanted), len(self.numbers) - 1)
        return where, np.where(self.numbers[where] == wanted, values, 0.0)

    def whitened(self) -> Array:
        """(k, k) dense root R of the precision, R R' = precision: R' z are independent and in order of time."""
        return np.asarray(np.linalg.cholesky(self.precision.toarray()[::-1, ::-1])[::-1, ::-1])


def _chain(kept: Array, gained: Array) -> sparse.csr_matrix:
    """(k, k) precision of z_n+1 = kept_n z_n + noise of variance gained_n, without that of the first."""
    count = len(kept) + 1
    steps = sparse.diags([-kept, np.ones(count - 1)], [0, 1], shape=(count - 1, count))
    return sparse.csr_matrix(steps.T @ sparse.diags(1.0 / gained) @ steps)


@dataclass(frozen=True, eq=False)
class Part:
    """One law's share of a correction.

    Attributes
    ----------
    turns : bool
        Whether it turns the body, radians; else it shifts the station along the axes of the pass, metres.
    first : int
        Of its unknowns, three axes of each number.
    support : Support
        Of the law.
    """

    turns: bool
    first: int
    support: Support

    @cached_property
    def sigma(self) -> Array:
        """(3,) of the axes."""
        return np.array(self.support.law.sigma)


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections at the times of n observations.

    Attributes
    ----------
    parts : tuple[Part, ...]
        Of the laws; those that turn come first.
    axes : Array
        (3, 3) axes of the pass (along, across, down) as columns, ITRS.
    time : Array
        (n,) seconds.
    """

    parts: tuple[Part, ...]
    axes: Array
    time: Array

    def taken(self, which: Indices) -> Corrections:
        """At some of the observations, (k,)."""
        return replace(self, time=self.time[which])

    @cached_property
    def _blends(self) -> tuple[tuple[Indices, Array], ...]:
        return tuple(one.support.blend(self.time) for one in self.parts)

    @property
    def columns(self) -> Indices:
        """(n, w) unknowns of all parts."""
        every = [np.zeros((len(self.time), 0), np.intp)]
        for one, (number, _) in zip(self.parts, self._blends, strict=True):
            columns = one.first + 3 * number[:, :, None] + np.arange(3)
            every.append(columns.reshape(len(number), 3 * number.shape[1]))
        return np.concatenate(every, axis=1)

    def factors(self, turns: bool) -> tuple[Indices, Array]:
        """Unknowns (n, w, 3) of the turns or of the shifts, and their coefficients (n, w, 3), SI."""
        count = len(self.time)
        columns, factors = [np.zeros((count, 0, 3), np.intp)], [np.zeros((count, 0, 3))]
        for one, (number, blend) in zip(self.parts, self._blends, strict=True):
            if one.turns == turns:
                columns.append(one.first + 3 * number[:, :, None] + np.arange(3))
                factors.append(blend[:, :, None] * one.sigma)
        return np.concatenate(columns, axis=1), np.concatenate(factors, axis=1)

    def at(self, x: Array) -> tuple[Array, Array]:
        """Turns (n, 3), radians, and shifts (n, 3) along the axes of the pass, metres, with unknowns x (P,)."""
        turn, shift = np.zeros((2, len(self.time), 3))
        for one, (number, blend) in zip(self.parts, self._blends, strict=True):
            own = one.sigma * x[one.first : one.first + one.support.size].reshape(-1, 3)
            value = np.einsum("nw,nwa->na", blend, own[number])
            if one.turns:
                turn += value
            else:
                shift += value
        return turn, shift

    def slopes(self, by_turn: Array, by_station: Array) -> Array:
        """(n, d, w) derivatives of d rows by the unknowns.

        Parameters
        ----------
        by_turn : Array
            Derivatives by the rotation vector, (n, d, 3), 1/rad.
        by_station : Array
            By the station, ITRS, (n, d, 3), 1/m.
        """
        count, depth = by_turn.shape[:2]
        widths = [3 * blend.shape[1] for _, blend in self._blends]
        found = np.empty((count, depth, sum(widths)))
        along, done = by_station @ self.axes, 0
        for one, (_, blend), width in zip(self.parts, self._blends, widths, strict=True):
            by = (by_turn if one.turns else along) * one.sigma
            for k in range(blend.shape[1]):
                place = done + 3 * k
                np.multiply(by, blend[:, k, None, None], out=found[:, :, place : place + 3])
            done += width
        return found


def turned(turn: Array, vector: Array) -> Array:
    """(n, 3) vectors turned by rotation vectors (n, 3) of up to a degree; of d vectors (n, d, 3) each likewise.

    The series of the rotation to the third order, which leaves out 1e-9 of a degree.
    """
    if vector.ndim == 3:
        turn = turn[:, None]
    square = np.sum(turn**2, axis=-1, keepdims=True)
    once = cross(turn, vector)
    return np.asarray(vector + (1.0 - square / 6.0) * once + (0.5 - square / 24.0) * cross(turn, once))


def turned_back(turn: Array, vector: Array) -> Array:
    """Vectors turned by the inverse of rotations, see `turned`."""
    return turned(-turn, vector)


def cross(a: Array, b: Array) -> Array:
    """Vector product along the last axis; several times faster than numpy's for many short vectors."""
    found = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(a[..., j], b[..., k], out=found[..., i])
        found[..., i] -= a[..., k] * b[..., j]
    return found


def by_rotation_vector(turn: Array, by_turn: Array) -> Array:
    """(n, d, 3) derivatives by the rotation vectors (n, 3), from those by a small turn of the turned body.

    It is the right Jacobian of the rotation, to the second order.
    """
    # t (I - S / 2 + S^2 / 6), where t S = t x turn
    once = cross(by_turn, turn[:, None])
    return np.asarray(by_turn - 0.5 * once + cross(once, turn[:, None]) / 6.0)
